"""What a run says at its end: converged or not, feasible or not, in which units."""

import numpy as np
import pytest
from mpi4py import MPI
from remainders import built_of
from runs import QUICK, TWO_ARM, overrides, quick, run, summary_of
from scipy.integrate import trapezoid

import dolfinopt as do
from dolfinopt.optimization.residual import kkt_residual as residual
from dolfinopt.output.design import ArmView, read_history, write_fields
from dolfinopt.parallel import on_root
from dolfinopt.responses import response
from dolfinopt.responses.constraints import Limit, violated, worst_limits

WORLD = MPI.COMM_WORLD


def compliance_problem():
    """Springs c / x with a limit on sum x: the optimum has x = sqrt(c / l), cut off at bounds."""
    n = 200
    c = np.random.default_rng(0).uniform(1e-3, 1.0, n)
    xmin, xmax, limit = np.full(n, 0.2), np.ones(n), 0.7 * n
    low, high = 1e-6, 1e3
    for _ in range(200):
        middle = np.sqrt(low * high)
        x = np.clip(np.sqrt(c / middle), xmin, xmax)
        low, high = (middle, high) if x.sum() > limit else (low, middle)
    return c, x, xmin, xmax, limit, middle


def test_no_residual_at_an_optimum():
    c, x, xmin, xmax, limit, multiplier = compliance_problem()
    assert ((x == 1.0).any() and (x == 0.2).any()) and ((x > 0.2) & (x < 1.0)).sum() > 50
    constraint = np.array([x.sum() / limit - 1.0])
    gradient = np.full((1, len(x)), 1.0 / limit)
    found = residual(x, -c / x**2, constraint, gradient, xmin, xmax)
    assert found.rms < 1e-9
    # Of the objective scaled to a root mean square of 1, in units of the range.
    rms = np.sqrt(np.mean((0.8 * c / x**2) ** 2))
    assert found.multipliers[0] == pytest.approx(multiplier * limit / rms, rel=1e-6)
    # The same in any unit, and with a repeated and an inactive constraint beside it.
    more = np.append(np.append(constraint, constraint), -0.3)
    rows = np.vstack([gradient, gradient, -np.ones(len(x))])
    scaled = residual(x, -1e9 * c / x**2, more, np.array([[1e6], [1.0], [1.0]]) * rows, xmin, xmax)
    assert scaled.rms < 1e-9 and scaled.multipliers[2] < 1e-6 * multiplier * limit / rms


def test_residual_grows_with_the_distance():
    c, x, xmin, xmax, limit, _ = compliance_problem()
    inside = (x > 0.25) & (x < 0.95)
    d = np.where(inside, np.random.default_rng(1).uniform(-1.0, 1.0, len(x)), 0.0)
    d[inside] -= d[inside].mean()
    found = []
    for step in (1e-3, 1e-2):
        moved = x + step * d
        slope = -c / moved**2
        row = np.full((1, len(x)), 1.0 / limit)
        found.append(residual(moved, slope, np.zeros(1), row, xmin, xmax).rms)
    assert found[1] == pytest.approx(10.0 * found[0], rel=0.1)


def test_residual_of_what_no_multiplier_balances():
    """|L| / |df0dx| = 1 without constraints, however large; a gradient into a bound is none."""
    n = 50
    x, low, high = np.full(n, 0.5), np.zeros(n), np.ones(n)
    slope = np.where(np.arange(n) % 2, 1.0, -1.0) * 1e-7
    none = np.zeros(0), np.zeros((0, n))

    def of(*problem):
        return residual(*problem).rms

    assert of(x, slope, *none, low, high) == pytest.approx(1.0, rel=1e-9)
    assert of(np.where(slope > 0.0, 0.0, 1.0), slope, *none, low, high) == 0.0
    # Multipliers are not negative: a constraint that points the other way is no help.
    row = slope[None]
    assert of(x, slope, np.zeros(1), row, low, high) == pytest.approx(1.0, rel=1e-9)
    assert of(x, slope, np.zeros(1), -row, low, high) < 1e-12
    assert of(x, np.zeros(n), *none, low, high) == 0.0


def test_residual_of_a_gradient_that_lives_in_few_cells():
    """One cell in a thousand has a gradient that nothing balances: it is not small for that."""
    n = 4000
    x, low, high = np.full(n, 0.5), np.zeros(n), np.ones(n)
    slope = np.where(np.arange(n) % 1000 == 0, -1.0, -1e-6)
    found = residual(x, slope, np.zeros(0), np.zeros((0, n)), low, high)
    assert found.rms == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize(
    ("left", "least", "most"), [(1e-5, 0.0, 1e-3), (0.02, 1e-3, 0.05), (2.0, 0.5, 1.0)]
)
def test_residual_of_a_limit_that_is_not_reached(left, least, most):
    """A limit counts the less the farther it is: its multiplier times what is left of it."""
    n = 100
    x, low, high = np.full(n, 0.5), np.zeros(n), np.ones(n)
    slope = np.full(n, -1.0)
    rows = np.full((1, n), 1.0 / n)  # full ranges of all cells bring it from 0 to 1
    found = residual(x, slope, np.array([-left]), rows, low, high)
    assert least <= found.rms <= most


@pytest.mark.slow
def test_a_resting_design_is_a_stationary_one():
    """The residual falls by orders of magnitude on the way, and is in file and result alike."""
    result = do.optimize(quick("objective.kind=static", iterations=200))
    assert result.converged and result.kkt < 1e-2 and not result.violated
    if WORLD.rank == 0:
        best = result.history[result.best_iteration]
        assert result.history[0].kkt > 0.1 and best.kkt == pytest.approx(result.kkt, rel=1e-3)


@pytest.mark.skipif(WORLD.size == 1, reason="needs more than one rank")
def test_residual_has_the_same_bits_on_any_number_of_ranks():
    together = do.optimize(quick("constraints.tip_deflection=1e-4", iterations=2))
    alone = do.optimize(quick("constraints.tip_deflection=1e-4", iterations=2), world=MPI.COMM_SELF)
    assert together.kkt == alone.kkt
    assert together.limits == alone.limits


@pytest.mark.parametrize(
    ("bound", "words"),
    [
        ("constraints.tip_deflection=1e-9", ["tip deflection of arm1", "of 1e-06 mm: "]),
        ("constraints.first_frequency=80", ["first frequency of arm2", "of at least 80 Hz: "]),
    ],
)
def test_an_infeasible_end_has_status_1_and_one_line(bound, words, shared_tmp_path, capsys):
    """That of a ConvergenceError; the files are there all the same, and name the constraint."""
    folder = shared_tmp_path / "out"
    asked = overrides(*QUICK, "optimizer.max_iterations=2", "objective.kind=static", bound)
    with pytest.raises(do.ConvergenceError) as caught:
        run("optimize", TWO_ARM, *asked, "--no-plots", "--out", folder)
    message = str(caught.value)
    assert "\n" not in message
    assert all(word in message for word in words)
    said = capsys.readouterr().out
    assert ("minimised compliance under static loads" in said) == (WORLD.rank == 0)
    summary = summary_of(folder)
    assert summary["converged"] is False
    name = words[0].replace(" of ", " ").replace(" ", "_")
    one = summary["constraints"][name]
    assert one["met"] is False and one["limit"] == float(bound.partition("=")[2])
    assert f"{one['value'] * (1e3 if one['unit'] == 'm' else 1.0):.5g} of " in message
    rows = read_history(folder / "history.csv")
    assert rows[-1].constraints[name] == pytest.approx(one["value"], rel=1e-9)
    assert [row.iteration for row in rows] == [0, 1, 2] and np.isfinite(rows[-1].kkt)


def test_the_last_lines_say_what_was_minimised(shared_tmp_path, capsys):
    def last_lines(command, *changes):
        out = ["--no-plots", "--out", shared_tmp_path / changes[-1]]
        run(command, TWO_ARM, *overrides(*QUICK, *changes), *out)
        said = capsys.readouterr().out
        return said[said.find("two-arm manipulator: ") :]

    line = last_lines("optimize", "optimizer.max_iterations=1", "objective.kind=eigenfrequency")
    if WORLD.rank == 0:
        assert "minimised squared longest periods" in line
        assert " s2 (first frequency of arm1" in line
        assert "N m" not in line
    line = last_lines("simulate", "objective.kind=deviation")
    if WORLD.rank == 0:
        assert ": simulated, " in line and "  p-mean of the deviation" in line
        assert "iterations" not in line


def test_sentences_tell_a_value_from_its_limit():
    limit = Limit("first_frequency", "arm2", 60.4321, 80.0, "Hz", least=True)
    assert limit.usage == "first frequency of arm2 60.432 of at least 80 Hz: 132.4 %"
    assert not limit.met and violated([limit]) == limit.usage
    assert Limit("stress", "", 90.12e6, 90e6, "Pa").usage == "stress 90.12 of 90 MPa: 100.1 %"
    assert Limit("stress", "", 90.08e6, 90e6, "Pa").usage == "stress 90.1 of 90 MPa: 100 %"
    assert Limit("first_frequency", "arm2", 79.95, 80.0, "Hz", least=True).met  # to 1e-3
    both = worst_limits([[limit], [Limit("first_frequency", "arm2", 90.0, 80.0, "Hz", least=True)]])
    assert both == (limit,)
    assert Limit("volume_fraction", "", 0.6, 0.5, "-").usage == "volume fraction 0.6 of 0.5: 120 %"


def test_robust_designs_take_the_scene_s_exponent(monkeypatch):
    """Eroded, nominal and dilated are combined with objective.exponent."""
    asked = []
    original = response.worst_of

    def noted(values, exponent, least):
        asked.append((len(values), exponent))
        return original(values, exponent, least)

    monkeypatch.setattr("dolfinopt.optimization.problem.worst_of", noted)
    robust = ["design.projection=robust", "objective.exponent=7", "objective.kind=static"]
    do.optimize(quick(*robust, iterations=1))
    assert asked and set(asked) == {(3, 7.0)}


def test_machine_figures(shared_tmp_path):
    """Masses, drives and settling are those of the trajectory; every figure has its unit."""
    asked = overrides(*QUICK, "motion.horizon=2.5", "payload.mass=3")
    run("simulate", TWO_ARM, *asked, "--no-plots", "--out", shared_tmp_path)
    summary = summary_of(shared_tmp_path)
    with np.load(shared_tmp_path / "trajectory.npz") as data:
        t, deviation, forces = data["t"], data["deviation"], data["joint_forces"]
    after = np.hypot(*deviation[t >= 1.9 - 1e-9].T)
    assert summary["settling"] == pytest.approx(after.max(), rel=1e-12)
    assert 0.0 < summary["settling"] < summary["max_deviation"]
    for k, name in enumerate(("cart", "arm1", "arm2")):
        assert summary["drive_peak"][name] == pytest.approx(np.abs(forces[:, k]).max())
        rms = np.sqrt(trapezoid(forces[:, k] ** 2, t) / t[-1])
        assert summary["drive_rms"][name] == pytest.approx(rms, rel=1e-9)
    # Half of 2700 kg/m3 on 1 x 0.06 x 0.01 m3.
    assert summary["mass"]["arm2"] == pytest.approx(0.81, rel=1e-5)
    units = summary["units"]
    for key in ("compliance", "settling", "mass", "first_frequency", "drive_peak", "objective"):
        assert key in summary and units[key]
    assert units["drive_peak"] == {"cart": "N", "arm1": "N m", "arm2": "N m"}
    assert summary["kkt"] is None and summary["stop_reason"] == "simulated"
    assert summary["constraints"]["volume_fraction_arm1"]["met"]


def test_settling_of_a_horizon_that_ends_with_the_motion():
    built = built_of(quick(iterations=1))
    _, trajectory = built.evaluate(built.uniform())
    if trajectory is not None:
        assert trajectory.settling == pytest.approx(np.hypot(*trajectory.deviation[-1]))


SQUARES = np.array(
    [[[0, 0], [1, 0], [1, 1], [0, 1]], [[1, 0], [2, 0], [2, 1], [1, 1]]], dtype=float
)
TRIANGLES = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], dtype=float)


@pytest.mark.serial
@pytest.mark.parametrize("shapes", [[SQUARES], [TRIANGLES], [SQUARES, TRIANGLES]])
def test_designs_open_in_other_programs(shapes, tmp_path):
    """PyVista reads the file with the reader of ParaView, and meshio with its own."""
    meshio, pyvista = pytest.importorskip("meshio"), pytest.importorskip("pyvista")
    views = [
        ArmView(f"arm{k}", corners, corners.mean(axis=1), np.array([0.25, 1.0]), np.zeros(0))
        for k, corners in enumerate(shapes)
    ]
    write_fields(tmp_path, views)
    density = np.tile([0.25, 1.0], len(shapes))
    arm = np.repeat(np.arange(len(shapes)), 2)
    area = sum(2.0 if corners is SQUARES else 1.0 for corners in shapes)
    grid = pyvista.read(tmp_path / "design.vtu")
    np.testing.assert_array_equal(grid.cell_data["density"], density)
    np.testing.assert_array_equal(grid.cell_data["arm"], arm)
    assert grid.compute_cell_sizes().cell_data["Area"].sum() == pytest.approx(area)
    mesh = meshio.read(tmp_path / "design.vtu")
    np.testing.assert_array_equal(np.concatenate(mesh.cell_data["density"]), density)
    assert {block.type for block in mesh.cells} <= {"quad", "triangle"}
    assert sum(len(block.data) for block in mesh.cells) == 2 * len(shapes)


def test_history_of_a_run_without_constraints_column(shared_tmp_path):
    """Rows of an earlier version, without residual and constraints, can still be read."""

    def written():
        path = shared_tmp_path / "history.csv"
        header = "iteration,objective,max_deviation,grayness,volume_fraction,change,seconds\n"
        path.write_text(header + "0,1.0,2.0,0.5,0.5,0,0.1\n")
        return read_history(path)

    (row,) = on_root(WORLD, written)
    assert row.objective == 1.0 and np.isnan(row.kkt) and row.constraints == {}
