"""Parts in the moving machine, beside the densities that they were made of."""

import json
from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI
from parts import folder_with, frame
from runs import TWO_ARM, run, summary_of

import dolfinopt as do
from dolfinopt import Model
from dolfinopt.cli.shared import scene_of
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.output.design import canonical_order
from dolfinopt.part import check as checks
from dolfinopt.part.buckling import LeastBuckling, lowest_buckling
from dolfinopt.part.check import check_parts, crisp, simulate_parts
from dolfinopt.part.part import make_parts, mesh_parts

pytestmark = pytest.mark.serial

SMALL = ("arms.cells=[100,6]", "simulation.sample=0.005", "constraints.stress=13e6",
         "design.erosion=0.25")  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of a run with its parts, and their check."""
    folder = folder_with(tmp_path_factory.mktemp("check") / "run", frame, *SMALL)
    scene = scene_of(folder)
    parts = make_parts(scene, folder)
    return folder, parts, check_parts(scene, folder, parts, mesh_parts(parts))


def test_table_has_the_figures_of_all_forms(made):
    table = made[2].table()
    assert list(table.columns[:4]) == ["unit", "density", "crisp", "part"]
    assert {"mass", "first_frequency_arm1", "compliance", "deviation", "settling", "stress",
            "drive_peak_cart", "drive_peak_arm1"} <= set(table.index)  # fmt: skip
    assert table.loc["compliance", "unit"] == "N m" and table.loc["stress", "unit"] == "Pa"
    # The design is crisp already.
    known = table.drop(index="buckling")
    assert known["crisp"].to_numpy() == pytest.approx(known["density"].to_numpy(), rel=1e-6)
    assert table.loc["mass", "part"] == pytest.approx(table.loc["mass", "density"], rel=5e-4)
    for name in ("compliance", "deviation", "first_frequency_arm1"):
        assert table.loc[name, "part"] == pytest.approx(table.loc[name, "density"], rel=0.03)


def test_part_is_converged_and_says_what_it_loses(made):
    check = made[2]
    assert check.converged
    assert 0.0 < abs(check.refinement["compliance"]) < 5e-3
    assert abs(check.refinement["stress"]) < 0.15
    change = 100.0 * (check.part.values["compliance"] / check.density.values["compliance"] - 1.0)
    assert f"{abs(change):.2g} % {'stiffer' if change < 0 else 'softer'}" in check.loss
    assert "deviation" in check.loss and "\n" not in check.loss


def test_part_without_a_coarse_mesh_tells_that_its_error_is_not_known(made):
    check = replace(made[2], coarse=None, stress_change=float("nan"))
    assert np.isnan(check.refinement["compliance"]) and not check.converged
    assert check.to_dict()["check"]["refinement"]["compliance"] is None
    assert not any("refinement" in note for note in check.notes)
    (warning,) = (text for text in check.warnings if "mesh" in text)
    assert "not known" in warning and "part.minimum_member" in warning


def test_buckling_of_the_part_stands_in_the_table(made):
    check = made[2]
    row = check.table().loc["buckling"]
    assert row["unit"] == "-" and np.isnan(row["density"]) and np.isnan(row["crisp"])
    assert row["part"] == check.part.buckling.factor > checks.SAFE
    # On sides half as long: 199.2 on 2854 triangles, 197.8 on 4055, 197.7 on 10939.
    folder, parts, _ = made
    fine = simulate_parts(scene_of(folder), parts, {k: part.mesh(0.5) for k, part in parts.items()})
    finer = lowest_buckling(fine.arms, fine.trajectory, check.part.buckling)
    assert row["part"] == pytest.approx(finer.factor, rel=5e-3)
    values = check.to_dict()["table"]["buckling"]
    assert values == {"unit": "-", "density": None, "crisp": None, "part": row["part"]}
    assert not any("buckles" in text for text in check.warnings)
    weak = replace(check.part, buckling=LeastBuckling(1.2345, 0, 0.5))
    (warning,) = [text for text in replace(check, part=weak).warnings if "buckles" in text]
    assert warning.startswith("arm1 buckles at 1.23 times its loads at 0.500 s")
    assert "\n" not in warning


def test_model_checks_parts_of_a_design(made):
    folder, _, check = made
    model = do.Model(scene_of(folder), comm=MPI.COMM_SELF)
    with np.load(folder / "design.npz") as data:
        order = canonical_order(data["arm1/centroid"])
        design = {"arm1": data["arm1/density"][order]}
    found = model.check_parts(design)
    assert found.part.values == pytest.approx(check.part.values, rel=1e-6)
    assert found.table().shape == check.table().shape


def test_stiffening_is_that_of_the_run(made, tmp_path):
    """Decided anew, a softer form of the arms might be simulated as another machine."""
    summary = summary_of(made[0])
    for on in (True, False):
        asked = summary["scene"] | {"simulation": summary["scene"]["simulation"]}
        asked["simulation"] |= {"stiffening": "auto"}
        text = json.dumps(summary | {"stiffening": {"on": on, "estimate": 0.01}, "scene": asked})
        (tmp_path / "summary.json").write_text(text)
        assert scene_of(tmp_path).simulation.stiffening is on
    assert scene_of(made[0]).simulation.stiffening is False  # as the scene states


def test_limits_are_those_of_the_outline(made):
    check = made[2]
    (limit,) = check.part.limits
    assert limit.quantity == "stress" and limit.value == check.part.values["stress"]
    assert not limit.met
    assert any("misses a limit: stress" in text for text in check.warnings)
    x, y = check.part.stress.place
    assert 0.0 < x < 1.0 and abs(y) <= 0.03 + 1e-6


def test_command_prints_and_keeps_the_table(made, capsys, tmp_path):
    folder, _, check = made
    run("part", folder, "--out", tmp_path / "part")
    printed = capsys.readouterr().out
    assert check.loss in printed and "first frequency arm1" in printed
    assert "limit missed: stress" in printed
    found = json.loads((tmp_path / "part" / "part.json").read_text())
    values = {name: row["part"] for name, row in found["table"].items()}
    assert values == pytest.approx(check.part.values, rel=1e-6)
    assert found["check"]["loss"] == check.loss and found["check"]["converged"]
    assert not found["check"]["limits"]["stress"]["met"]
    for name in ("part.png", "deviation.png", "stress.png"):
        assert (tmp_path / "part" / name).stat().st_size > 5000
    # The scene of the parts is the machine of the table.
    out = tmp_path / "out"
    run("simulate", tmp_path / "part" / "part.toml", "--no-plots", "--out", out)
    summary = summary_of(out)
    assert summary["compliance"] == pytest.approx(check.part.values["compliance"], rel=1e-6)
    assert summary["max_deviation"] == pytest.approx(check.part.values["deviation"], rel=1e-6)


def test_part_that_cannot_be_simulated_has_files_all_the_same(made, monkeypatch, capsys, tmp_path):
    def fail(*_, **__):
        raise ConvergenceError("too weak")

    monkeypatch.setattr(checks, "simulate_parts", fail)
    run("part", made[0], "--out", tmp_path / "part", "--no-plots")
    assert "the machine with the parts cannot be compared: too weak" in capsys.readouterr().err
    found = json.loads((tmp_path / "part" / "part.json").read_text())
    assert "table" not in found and (tmp_path / "part" / "arm1.step").exists()


def test_crisp_design_keeps_the_volume():
    x, area = np.array([0.0, 0.2, 0.55, 0.7, 1.0]), np.array([1.0, 1.0, 1.0, 1.0, 0.5])
    cut = crisp(x, area)
    assert cut.tolist() == [0.0, 0.0, 0.0, 1.0, 1.0]  # 1.5 of 1.95 m2, nearer than 2.5
    assert crisp(np.array([1.0, 1.0]), np.ones(2)).tolist() == [1.0, 1.0]
    same = crisp(np.array([0.5, 0.5, 1.0]), np.ones(3))
    assert same.tolist() in ([0.0, 0.0, 1.0], [1.0, 1.0, 1.0])


def test_crisp_design_that_void_alone_holds_is_not_simulated(made, monkeypatch):
    """A gap of one column between two halves: told by its cells, without a motion."""
    folder, scene = made[0], scene_of(made[0])
    _, arms = checks._built(scene)
    x = {k: (np.abs(arm.mesh.centroid[:, 0] - 0.4) > 0.011) * 1.0 for k, arm in arms.items()}
    assert not arms[0].substructure.joins(x[0] > 0.0)
    assert arms[0].substructure.joins(np.ones(arms[0].mesh.num_cells, dtype=bool))
    simulated = []

    def column(one):
        simulated.append(one)
        return None

    monkeypatch.setattr(checks, "crisp", lambda *_: x[0])
    monkeypatch.setattr(checks, "_design_column", column)
    monkeypatch.setattr(checks, "_simulated", lambda *given: given)
    checks.design_columns(scene, folder)
    assert len(simulated) == 1


def test_crisp_design_that_is_far_less_stiff_is_left_out(made, monkeypatch):
    monkeypatch.setattr(checks, "WEAK", 2.0)
    density, none = checks.design_columns(scene_of(made[0]), made[0])
    assert density is not None and none is None


# -- parts from Python  ---------------------------------------------------------------------------


FEW = ("arms.cells=[20, 4]", "optimizer.max_iterations=2", "simulation.sample=0.01")


def test_result_and_files_hold_what_was_projected(tmp_path):
    """Its projection is monotone: denser cells were denser before."""
    model = Model(TWO_ARM, *FEW, "design.projection=robust")
    result = model.optimize()
    assert result.filtered.keys() == result.design.keys()
    for name, x_phys in result.design.items():
        order = np.argsort(result.filtered[name])
        assert (np.diff(x_phys[order]) >= -1e-12).all()
        assert np.ptp(x_phys) > 0.1
    model._design_file(result, tmp_path / "design.npz")
    with np.load(tmp_path / "design.npz") as data:
        np.testing.assert_array_equal(data["arm2/filtered"], result.filtered["arm2"])


def test_parts_of_a_design(tmp_path):
    model = Model(TWO_ARM, *FEW)
    design = {}
    for name, points in model.centroids.items():
        x, y = points.T
        design[name] = 1.0 * ((np.abs(y) > 0.015) | (np.abs(x - 0.5) < 0.06))
    parts = model.make_parts(design, tmp_path / "parts", tolerance=1e-3)
    for part in parts.values():
        assert part.shape.area == pytest.approx(part.domain.volume, rel=1e-4)
        assert len(part.shape.loops) == 3
    assert (tmp_path / "parts" / "arm2.step").exists()
    with pytest.raises(InputError, match="holds results already"):
        model.make_parts(design, tmp_path / "parts")
