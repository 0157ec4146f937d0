"""Studies of machines under control and with closed loops: sweeps, comparisons, random values."""

import pytest
from mpi4py import MPI
from runs import ROOT, overrides, run
from studies import rows_of

import dolfinopt as do

WORLD, SELF = MPI.COMM_WORLD, MPI.COMM_SELF
CONTROLLED = ROOT / "demos" / "controlled_two_arm.toml"
SLIDER_CRANK = ROOT / "demos" / "slider_crank.toml"
SMALL = {
    CONTROLLED: ["arms.cells=[20,3]", "optimizer.max_iterations=1", "simulation.sample=0.01",
                 "motion.horizon=2.0"],
    SLIDER_CRANK: ["arms.rod.cells=[24,4]", "optimizer.max_iterations=1",
                   "simulation.sample=1e-3", "motion.horizon=0.06"],
}  # fmt: skip
TOLERANCE = 1e-4  # of the coordinates, whose square is the compliance


def small(path, *changes):
    return do.load_scene(path, [*SMALL[path], *changes])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("machines") if WORLD.rank == 0 else None
    return WORLD.bcast(path, root=0)


@pytest.mark.serial
@pytest.mark.parametrize(
    ("path", "key", "values"),
    [
        (CONTROLLED, "control.stiffness_factor", ("0.1", "1")),
        (SLIDER_CRANK, "motion.speed", ("100", "150")),
    ],
    ids=["gains", "speed"],
)
def test_sweep(path, key, values, folder):
    """Every row is a simulation by itself: nothing of another row's gains or speed is kept."""
    run("sweep", path, "--vary", f"{key}={','.join(values)}", *overrides(*SMALL[path]), "--out",
        folder)  # fmt: skip
    rows = rows_of(folder / f"{key}.csv")
    found = []
    for row, value in zip(rows, values, strict=True):
        model = do.Model(small(path, f"{key}={value}"), comm=SELF)
        alone = model.simulate()
        got = float(row["initial design: compliance [N m]"])
        assert got == pytest.approx(alone.compliance, rel=4.0 * TOLERANCE)
        found.append(got)
    assert abs(found[1] - found[0]) > 0.05 * found[0]


@pytest.mark.serial
def test_random_gain_and_speed(folder):
    for path, key, law in (
        (CONTROLLED, "control.stiffness_factor", "normal:1:0.05"),
        (SLIDER_CRANK, "motion.speed", "normal:150:3"),
    ):
        run("uncertainty", path, "--random", f"{key}={law}", "--samples", 10, "--no-plots",
            *overrides(*SMALL[path]), "--out", folder)  # fmt: skip
        rows = rows_of(folder / f"uncertainty_{key}.csv")
        assert len(rows) == 10
        assert len({row["initial design: compliance [N m]"] for row in rows}) == 10


@pytest.mark.slow
@pytest.mark.parametrize("path", [CONTROLLED, SLIDER_CRANK], ids=lambda path: path.stem)
def test_compare_objectives(path, folder):
    """Every objective goes with feedback control and closed loops."""
    quick = overrides(*SMALL[path], "simulation.tolerance=1e-2")
    # Of the controlled arms pictures are those of the two-arm scene, see test_study.
    drawn = ["--no-plots"] if path == CONTROLLED else []
    run("compare", path, "objectives", *quick, *drawn, "--out", folder / path.stem)
    rows = rows_of(folder / path.stem / "objective.csv")
    compliance = {row["objective"]: float(row["compliance [N m]"]) for row in rows}
    for name in ("dynamic loads (esl)", "compliance over the horizon, exact gradient"):
        assert compliance[name] < compliance["initial design"]
