"""Straight members beside the design: the search, who wins, the command, what is refused."""

import json
import math
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
import pytest
from mpi4py import MPI
from runs import ROOT, TWO_ARM, by_root, overrides, refusal, run
from studies import COARSE, column, rows_of, write_uniform

import dolfinopt as do
from dolfinopt.mesh.hollow import FLAT_BAR, SOLID_BAR
from dolfinopt.responses.constraints import EXCESS
from dolfinopt.scene.schema import file_digest
from dolfinopt.scene.tables.joints import Interface
from dolfinopt.study.cases import Runner
from dolfinopt.study.sections import (
    LEAST,
    WORTH,
    Members,
    ahead,
    lightest,
    sections_of,
    study_sections,
    verdict,
)

SPATIAL = ROOT / "demos" / "spatial_arm.toml"
WORLD = MPI.COMM_WORLD
DEVIATION = 0.05  # m, that slender bars hold
alone = pytest.mark.serial


@dataclass
class Found:
    """An outcome with some limited values, all at most 1."""

    values: dict
    mass: float = 1.0
    objective: float = 1.0
    failure: str = ""
    least: set = field(default_factory=set)

    @property
    def summary(self):
        limits = {}
        for name, value in self.values.items():
            bound = "least" if name in self.least else "largest"
            limits[name] = {"value": value, "limit": 1.0, "unit": "m", "met": value <= 1.0}
            limits[name]["bound"] = bound
        return {"constraints": limits, "designed_mass": self.mass}


def search(members, values):
    """Run the search on a function of the shares; return its answer and all that it asked."""
    asked, done, steps = [], None, lightest(members)
    while True:
        try:
            wanted = steps.send(done)
        except StopIteration as end:
            return end.value, asked
        asked += wanted
        done = {shares: values(shares) for shares in wanted}


class Bars(Members):
    """Members whose cases are their shares alone."""

    def case(self, shares):
        return shares


@pytest.fixture(scope="module")
def bars(tmp_path_factory):
    return Bars(do.load_scene(TWO_ARM), "solid bar", FLAT_BAR, tmp_path_factory.mktemp("m"))


@pytest.mark.parametrize("share", [0.013, 0.11, 0.6, 0.99])
def test_one_size_lies_on_its_limit(bars, share):
    """Steep as bending is, and with failures where the bar is too thin to be simulated."""
    one = replace(bars, scene=do.load_scene(TWO_ARM, ["arms.arm2.design=arm1"]))

    def values(shares):
        fails = shares[0] < 0.5 * share
        return Found({"deviation": (share / shares[0]) ** 3}, failure="broke" * fails)

    (found, holds), asked = search(one, values)
    assert holds and -EXCESS <= 3.0 * math.log(share / found[0]) <= 0.0
    assert len(asked) <= 15


def test_several_sizes_are_the_lightest(bars):
    """min s1 + s2 with c1 / s1^3 + c2 / s2^3 <= 1: s is proportional to c^(1/4) (Lagrange)."""
    c = np.array([0.05, 0.004])
    ratio = c**0.25
    best = ratio * (c / ratio**3).sum() ** (1.0 / 3.0)
    (found, holds), asked = search(
        bars, lambda shares: Found({"deviation": float((c / np.array(shares) ** 3).sum())})
    )
    assert holds and -EXCESS <= np.log((c / np.array(found) ** 3).sum()) <= 0.0
    # What the next set of power laws has to be worth; mass is flat about the best sizes.
    assert sum(found) == pytest.approx(best.sum(), rel=WORTH)
    assert found == pytest.approx(best, rel=0.05)
    assert len(asked) <= 50


def test_lower_limits_and_what_rises_with_the_mass(bars):
    """A frequency is held from a size on, drives up to one: the least size between them."""

    def values(shares):
        s = math.prod(shares) ** 0.5  # alike at s1 = s2 alone: the least s1 + s2
        return Found({"first_frequency": 2.0 * s, "effort": 1.25 * s}, least={"first_frequency"})

    (found, holds), _ = search(bars, values)
    assert holds and found == pytest.approx((0.5, 0.5), rel=2.0 * EXCESS)


def test_none_holds_and_members_of_the_same_mass(bars):
    """Then the full height is the answer; where nothing can be simulated, there is none."""
    (found, holds), _ = search(bars, lambda shares: Found({"deviation": 2.0 / min(shares)}))
    assert found == (1.0, 1.0) and not holds
    assert search(bars, lambda shares: Found({}, failure="broke"))[0] is None
    (found, holds), _ = search(bars, lambda shares: Found({"deviation": 0.5}))
    assert found == (LEAST, LEAST) and holds
    shares = bars.of_mass({"arm1": 0.81, "arm2": 0.162})  # 1.62 kg is all of an arm
    assert shares == pytest.approx((0.5, 0.1), rel=1e-6)
    assert bars.total_mass(shares) == pytest.approx(0.972, rel=1e-6)
    assert bars.of_mass({"arm1": 0.81, "arm2": 1.7}) is None


def row(kind, mass, deviation=0.9, lightest=False, objective=1.0):
    values = {} if deviation is None else {"deviation": deviation}
    outcome = Found(values, mass, objective)
    made = "lightest" if lightest else "same mass"
    return {"section": kind, "made": made, "mass [kg]": mass, "failure": "", "outcome": outcome}


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([row("design", 2.88), row("round tube", 2.5, lightest=True),
          row("rectangular tube", 2.23, lightest=True)],
         "rectangular tube that holds the limits weighs 2.23 kg, the design 2.88 kg: the "
         "rectangular tube wins."),
        ([row("design", 1.2), row("solid bar", 2.8, lightest=True)], "1.2 kg: the design wins."),
        ([row("design", 1.2), row("solid bar", 1.1)],  # lighter, but holds by chance
         "No straight member within the arms' envelope holds the limits, the design weighs 1.2 kg: "
         "the design wins."),
        ([row("design", 1.0, 1.1), row("solid bar", 2.8, lightest=True)],
         "the design 1 kg (deviation 10 % over its limit): the solid bar wins."),
        ([row("design", 1.0, 1.005), row("solid bar", 2.8, lightest=True)],
         "the design 1 kg (deviation 0.5 % over its limit): the design wins."),
        ([row("design", 1.0, 1.1), row("solid bar", 2.8, 1.2)], "nobody wins."),
        ([row("design", 1.0, None, objective=3.0), row("round tube", 1.0, None, objective=2.0)],
         "of 2 N m, the design 3 N m: the round tube wins."),
        ([row("design", 1.0, None, objective=1.5), row("round tube", 1.0, None, objective=2.0)],
         "of 2 N m, the design 1.5 N m: the design wins."),
        ([row("design", 1.0, None)], "No straight member within the arms' envelope has"),
    ],
)  # fmt: skip
def test_the_sentence(rows, said):
    assert said in verdict(do.load_scene(TWO_ARM), pd.DataFrame(rows))


def test_bars_in_the_plane(shared_tmp_path, capsys):
    """The lightest bar holds its limit with equality; bars are box arms of density 1."""
    design = write_uniform(shared_tmp_path / "made.npz", (12, 3), 0.5)
    scene = [*COARSE, "objective.kind=mass", "objective.gradient=exact",
             f"constraints.deviation={DEVIATION}"]  # fmt: skip
    words = ["compare", TWO_ARM, "sections", "--design", design, "--no-plots", "--out",
             shared_tmp_path / "o", *overrides(*scene)]  # fmt: skip
    run(*words)
    said = capsys.readouterr().out
    rows = rows_of(shared_tmp_path / "o" / "sections.csv")
    assert [one["section"] for one in rows] == ["design", "solid bar", "solid bar"]
    assert [one["made"] for one in rows] == ["made", "lightest", "same mass"]
    mass, deviation = column(rows, "mass [kg]"), column(rows, "maximal deviation [mm]")
    assert 1e3 * DEVIATION * (1.0 - EXCESS) <= deviation[1] <= 1e3 * DEVIATION
    assert rows[1][f"deviation <= {DEVIATION} m"].endswith(" met")
    assert mass[2] == pytest.approx(mass[0], rel=1e-6)
    named, _, texts = rows[2]["sizes [mm]"].partition(": ")
    assert named == "height x thickness"
    sizes = [float(one.split()[1]) for one in texts.split(", ")]
    assert sizes == pytest.approx([30.0, 30.0], rel=1e-3)  # half the density, four digits
    winner = "design" if mass[0] < mass[1] and "not met" not in str(rows[0]) else "solid bar"
    assert f"the {winner} wins." in said or WORLD.rank > 0
    box = [*scene, "arms.height=0.03", "design.initial=1.0", "design.volume_fraction=1.0",
           "design.filter_radius=0.0"]  # fmt: skip
    made = do.Model(do.load_scene(TWO_ARM, box), comm=MPI.COMM_SELF).simulate()
    assert column(rows, "compliance [N m]")[2] == pytest.approx(made.compliance, rel=1e-5)
    # A killed run goes on: what is missing alone is computed, and nothing of a finished one.
    first = (shared_tmp_path / "o" / "sections.csv").read_bytes()
    by_root(lambda: next((shared_tmp_path / "o" / "cases").glob("*/summary.json")).unlink())
    for count in (1, 0):
        run(*words)
        assert f"{count} cases computed" in capsys.readouterr().out or WORLD.rank > 0
        assert (shared_tmp_path / "o" / "sections.csv").read_bytes() == first


@alone
@pytest.mark.slow
def test_tubes_in_space(tmp_path, capsys):
    """All four kinds of the same mass; a tube that no wall makes so heavy is told."""
    scene = overrides("arms.link1.cells=[24,4,2]", "arms.link2.cells=[24,4,2]",
                      "design.initial=0.3", "design.volume_fraction=0.31", "payload.mass=1.0",
                      "optimizer.max_iterations=1", "simulation.sample=0.01")  # fmt: skip
    run("compare", SPATIAL, "sections", *scene, "--out", tmp_path)
    rows = rows_of(tmp_path / "sections.csv")
    kinds = [one["section"] for one in rows]
    assert kinds == ["design", "solid bar", "rectangular tube", "round tube", "I section"]
    # The walls are found to 1e-9, the meshes have their sections' area.
    assert column(rows, "mass [kg]") == pytest.approx(column(rows, "mass [kg]")[0], rel=1e-6)
    deviation = dict(zip(kinds, column(rows, "maximal deviation [mm]"), strict=True))
    assert deviation["rectangular tube"] < 0.5 * deviation["solid bar"]
    assert "the rectangular tube wins" in capsys.readouterr().out
    runner = Runner(tmp_path / "a", MPI.COMM_SELF)
    bar, tube, *_, walls = runner.follow(ahead(do.load_scene(SPATIAL, scene[1::2]), runner.folder))
    value = [float(line.split("load cases ")[1].split()[0]) for line in (bar, tube)]
    assert value[1] < 0.5 * value[0] and "hollow" in walls
    assert (tmp_path / "sections_deviation.png").exists()


def test_a_bar_takes_the_place_of_a_mesh_file(tmp_path):
    """Straight from axis to axis, in cells of about the height's; the file's groups are gone."""
    meshed = do.load_scene(ROOT / "demos" / "two_arm_bores.toml")
    made = Members(meshed, "solid bar", FLAT_BAR, tmp_path).case((0.5, 0.25)).scene
    for arm, old, share in zip(made.arms, meshed.arms, (0.5, 0.25), strict=True):
        assert arm.mesh is None and arm.length == old.length and len(arm.cells) == 2
        assert arm.height == pytest.approx(share * old.height, rel=1e-12)
    assert made.design.is_solid
    solid = do.load_scene(SPATIAL)
    made = Members(solid, "solid bar", SOLID_BAR, tmp_path).case((0.5, 0.5)).scene
    assert made.arms[1].cells == solid.arms[1].cells
    assert (made.arms[1].height, made.arms[1].thickness) == pytest.approx((0.02, 0.01), rel=1e-12)


def test_arms_that_no_member_replaces(shared_tmp_path):
    """Links with several ends, and machines without a designed arm."""
    scene = do.load_scene(SPATIAL)
    column, link, other = scene.arms
    side = Interface(name="side", point=(0.1, 0.0, 0.0), radius=0.01)
    branched = link.unchecked_copy({"interfaces": (side,)})
    rigid = [one.unchecked_copy({"rigid": True}) for one in (link, other)]
    runner = Runner(shared_tmp_path / "o", WORLD)
    for arms, words in (
        ((column, branched, other), ("arms.link1.interfaces", "one outboard interface")),
        ((column, *rigid), ("expected arms with a design",)),
    ):
        changed = scene.unchecked_copy({"arms": arms})
        refusal(lambda: next(study_sections(changed, (), runner.folder)), *words)  # noqa: B023
        assert runner.follow(ahead(changed, runner.folder)) == []
    assert not (shared_tmp_path / "o").exists()


@alone
def test_beside_a_run(tmp_path):
    """A run's folder has the table of its own design alone."""
    (tmp_path / "design.npz").write_bytes(b"densities")
    folder = tmp_path / "sections"
    folder.mkdir()
    assert sections_of(tmp_path) is None
    (folder / "sections.md").write_text("The tube wins.\n\n| a |\n")
    (folder / "sections.csv").write_text("section,mass [kg]\ndesign,\ntube,2.5\n")
    for digest, found in (("other", False), (file_digest(tmp_path / "design.npz"), True)):
        question = {"question": {"designs": [digest]}}
        (folder / "sections.json").write_text(json.dumps(question))
        table = sections_of(tmp_path)
        assert (table is not None) == found
    assert table.title == "The tube wins."
    assert table.frame.astype(str).to_numpy().tolist() == [["design", ""], ["tube", "2.5"]]
