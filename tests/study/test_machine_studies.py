"""Studies of machines under control and with closed loops: sweeps, comparisons, random values."""

import pytest
from mpi4py import MPI
from runs import ROOT, overrides, run
from studies import rows_of

import dolfinopt as do

CONTROLLED = ROOT / "demos" / "controlled_two_arm.toml"
SLIDER_CRANK = ROOT / "demos" / "slider_crank.toml"
TOLERANCE = 1e-3  # of the coordinates, whose square is the compliance
SMALL = {
    CONTROLLED: ["arms.cells=[12,3]", "optimizer.max_iterations=1", "simulation.sample=0.01",
                 "motion.horizon=2.0", f"simulation.tolerance={TOLERANCE}"],
    SLIDER_CRANK: ["arms.rod.cells=[24,4]", "optimizer.max_iterations=1",
                   "simulation.sample=1e-3", "motion.horizon=0.06",
                   f"simulation.tolerance={TOLERANCE}"],
}  # fmt: skip
pytestmark = pytest.mark.serial


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "key", "values", "law"),
    [
        (CONTROLLED, "control.stiffness_factor", ("0.1", "1"), "normal:1:0.05"),
        (SLIDER_CRANK, "motion.speed", ("100", "150"), "normal:150:3"),
    ],
    ids=["gains", "speed"],
)
def test_swept_and_random(path, key, values, law, tmp_path):
    """Every row is a simulation by itself: nothing of another row's gains or speed is kept."""
    more = ["--no-plots", *overrides(*SMALL[path]), "--out", tmp_path]
    run("sweep", path, "--vary", f"{key}={','.join(values)}", *more)
    found = []
    for row, value in zip(rows_of(tmp_path / f"{key}.csv"), values, strict=True):
        scene = do.load_scene(path, [*SMALL[path], f"{key}={value}"])
        alone = do.Model(scene, comm=MPI.COMM_SELF).simulate()
        found.append(float(row["initial design: compliance [N m]"]))
        assert found[-1] == pytest.approx(alone.compliance, rel=4.0 * TOLERANCE)
    assert abs(found[1] - found[0]) > 0.05 * found[0]
    made = tmp_path / "made.npz"
    next((tmp_path / "cases").glob("*/history.csv")).with_name("design.npz").rename(made)
    run("uncertainty", path, "--random", f"{key}={law}", "--samples", 10, "--design", made, *more)
    rows = rows_of(tmp_path / f"uncertainty_{key}.csv")
    assert len({row["made: compliance [N m]"] for row in rows}) == 10


@pytest.mark.slow
@pytest.mark.parametrize("path", [CONTROLLED, SLIDER_CRANK], ids=lambda path: path.stem)
def test_compare_objectives(path, tmp_path):
    """Objectives of the motion, of stress and of the drives go with control and closed loops."""
    kinds = ["esl", "compliance", "stress"]
    more = [*overrides(*SMALL[path]), "--no-plots", "--out", tmp_path]
    run("compare", path, "objectives", *kinds, *more)
    rows = rows_of(tmp_path / "objective.csv")
    compliance = {row["objective"]: float(row["compliance [N m]"]) for row in rows}
    assert list(compliance) == ["initial design", "esl", "compliance", "stress"]
    assert max(compliance["esl"], compliance["compliance"]) < compliance["initial design"]
