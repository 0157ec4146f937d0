"""Work-precision diagrams: what they measure is right, kept, drawn and told."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from dolfinopt.bench import Plan, bench, common, diagrams, peers, whole
from dolfinopt.bench import mesh as meshes
from dolfinopt.bench import time as times
from dolfinopt.bench.beams import exudyn_available, exudyn_tip
from dolfinopt.bench.common import Diagram, Goal, curves, fitted_exponent
from dolfinopt.bench.statics import StaticArm, dolfinx_iteration, pymoto_iteration
from dolfinopt.dynamics import generalized_alpha, radau
from dolfinopt.dynamics.build import build_mechanism
from dolfinopt.dynamics.collocation import even_steps
from dolfinopt.dynamics.elastic_system import ElasticSystem, modes_of
from dolfinopt.errors import InputError
from dolfinopt.multibody.inverse_dynamics import inverse_dynamics
from dolfinopt.multibody.motion import breakpoints, rigid_motion
from dolfinopt.paper.reproduction import load_paper
from dolfinopt.profiling import Profile
from dolfinopt.study.tables import Panel
from dolfinopt.study.variants import changed

pytestmark = pytest.mark.serial  # a bench runs on one rank and starts others itself


@pytest.fixture(scope="module")
def problem():
    """The paper's motion with coarse uniform arms."""
    scene = load_paper(overrides=("arms.cells=[20,2]",))
    arms = common.arms_of(scene)
    x_phys = {k: arm.uniform(0.5) for k, arm in arms.items()}
    mechanism = build_mechanism(scene, common.bodies_of(scene, arms, x_phys))
    return ElasticSystem(mechanism, partial(rigid_motion, scene=scene), breakpoints(scene))


@pytest.fixture(scope="module")
def reference(problem):
    """What the problem's solutions are measured against."""
    return times.find_reference(problem, 1e-7)


# -- elements --------------------------------------------------------------------------------


def test_elements_that_do_not_lock():
    """A slender solid arm of few cells against beam theory: E I and Cowper's shear."""
    scene = changed(load_paper(), "simulation.tolerance=1e-2")
    E, nu, h, t = 70e9, 0.33, 0.06, 0.01
    shear = (12 + 11 * nu) / (10 * (1 + nu)) * 2 * (1 + nu) / (E * h * t)
    # The rigid end leaves no shear at a free one, but its moment is free: a cantilever.
    right = 1.0 / (3 * E * t * h**3 / 12) + shear
    error = {
        e.name: meshes.respond(scene, e, (50, 3)).compliance / right - 1.0 for e in meshes.ELEMENTS
    }
    # A clamped end does not let the section warp: 0.1 % of the compliance.
    assert all(abs(error[n]) < 3e-3 for n in ("QM6, incompatible modes", "Q2", "P2 triangles"))
    assert error["Q1"] < -0.03 and error["P1 triangles"] < -0.2  # they lock


def test_graded_reference():
    """The reference's grid covers the arm, and halving it shows its error to be of 1e-5."""
    grid = meshes.grid_arm(1.0, 0.06, (12, 4), graded=True)
    assert grid.area.sum() == pytest.approx(0.06, rel=1e-12)
    assert grid.area.min() < 1e-2 * grid.area.max()  # the corners
    scene = changed(load_paper(), "simulation.tolerance=1e-2")
    coarse, fine = (meshes.respond(scene, meshes.FINER, n) for n in ((15, 2), (30, 4)))
    uniform = meshes.respond(scene, meshes.ELEMENTS[2], (60, 4))
    # Uniform cells of the same height lose a tenth of a percent at the corners.
    assert abs(coarse.compliance / fine.compliance - 1.0) < 3e-4
    assert 3e-5 < abs(uniform.compliance / fine.compliance - 1.0) < 1e-3


# -- motion ----------------------------------------------------------------------------------


def test_accelerations_solve_the_rows(problem):
    size = problem.mechanism.num_coordinates
    rng = np.random.default_rng(1)
    q, qd = 1e-3 * rng.normal(size=size), 1e-2 * rng.normal(size=size)
    qdd = times.accelerations(problem, 0.7, q, qd)
    motion = problem.motion(np.array([0.7]))
    rows = inverse_dynamics(problem.mechanism, motion, q[None], qd[None], qdd[None])[0]
    at_rest = inverse_dynamics(problem.mechanism, motion, q[None], qd[None], 0 * qdd[None])[0]
    assert np.abs(rows).max() < 1e-11 * np.abs(at_rest).max()


def test_jacobian_is_the_derivative_of_accelerations(problem):
    problem = modes_of(problem).system
    size = problem.mechanism.num_coordinates
    rng = np.random.default_rng(2)
    y, d = 1e-3 * rng.normal(size=2 * size), rng.normal(size=2 * size)
    exact = times.jacobian(problem, 0.7, y) @ d

    def rate(step):
        q, qd = np.split(y + step * d, 2)
        return np.concatenate([qd, times.accelerations(problem, 0.7, q, qd)])

    central = (rate(1e-5) - rate(-1e-5)) / 2e-5
    np.testing.assert_allclose(central, exact, rtol=1e-6, atol=1e-6 * np.abs(exact).max())


def test_scipy_and_radau_agree(problem, reference):
    """Two independent paths through the same rows; the errors fall with the tolerance."""
    modes = modes_of(problem)
    found = times.scipy_motion(modes.system, "Radau", 1e-4, reference.t, (0.1, 10.0))
    assert max(reference.errors(modes.from_modes(found))) < 3e-2
    ours = [
        radau.integrate(problem, tolerance, 3, Profile()).sample(reference.t)
        for tolerance in (1e-3, 1e-5)
    ]
    errors = [reference.errors(q)[0] for q in ours]
    assert errors[0] < 1e-3 and errors[1] < 1e-5  # the tolerances


def test_newmark_is_of_second_order(problem, reference):
    errors = [
        reference.errors(
            generalized_alpha.on_grid(problem, even_steps(problem, n), 1e-8, 1.0).sample(
                reference.t
            )
        )[0]
        for n in (400, 800)
    ]
    assert fitted_exponent([400, 800], errors) == pytest.approx(-2.0, abs=0.4)


def test_fastest_interpolates():
    rows = [("d", 4, "Radau, 3 stages", "", s, e, e) for s, e in ((1.0, 1e-3), (100.0, 1e-5))]
    assert times.fastest(rows, "Radau")[1] == pytest.approx(10.0)
    assert times.fastest(rows, "SciPy") is None


def test_superiority_at_the_same_error():
    """SciPy's seconds at our error, or a bound where no method got there."""

    def row(method, seconds, error):
        return ("d", 4, method, "", seconds, error, error)

    ours = row("Radau, 3 stages", 0.1, 1e-5)
    slow = [row("SciPy BDF", 1.0, 1e-3), row("SciPy BDF", 100.0, 1e-7)]
    assert times.superiority([ours, *slow], ours) == (pytest.approx(100.0), True)
    # One that stopped at 3 s, short of the error, takes more than that: a bound.
    short = row("SciPy LSODA", 3.0, 1e-4)
    assert times.superiority([ours, *slow, short], ours) == (pytest.approx(30.0), False)
    late = row("SciPy LSODA", 20.0, 1e-4)
    assert times.superiority([ours, *slow, late], ours) == (pytest.approx(100.0), True)


# -- peers -----------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [dolfinx_iteration, pymoto_iteration])
def test_static_iterations(make):
    """Compliance of a slender uniform arm by beam theory; its slope by differences."""
    iterate = make(StaticArm(1.0, 0.06, 0.01, (100, 12), 70e9, 0.33))
    if iterate is None:
        pytest.skip("not installed")
    x = np.full(1200, 0.5)
    compliance, slope = iterate(x)
    # Q1 cells twice as long as high are up to 3 % too stiff; the floor adds 1e-5.
    beam = 1.0 / (3 * 70e9 * 0.5**3 * 0.01 * 0.06**3 / 12)
    assert compliance == pytest.approx(beam, rel=0.04)
    d = np.random.default_rng(3).normal(size=1200)
    central = (iterate(x + 1e-4 * d)[0] - iterate(x - 1e-4 * d)[0]) / 2e-4
    assert slope @ d == pytest.approx(central, rel=1e-4)


def test_exudyn_moves_alike():
    """Geometrically exact beams against cubic elements: within a percent of the deviation."""
    if not exudyn_available():
        pytest.skip("not installed")
    scene = load_paper()
    right = peers._simulated(scene, meshes.FINER, (15, 2))
    found = exudyn_tip(scene, 8, 1500)
    # Steps of 2 ms: 1.8e-3 was seen.
    assert peers.place_error(right, found[:, 0], found[:, 1:]) < 5e-3


def test_goals_of_iterations():
    """Ratios at 400 x 24 cells in one run: CPU seconds on one rank, the wall clock on two."""
    plain, one, two = (
        (peers.ITERATION, name, "400 x 24", 9600, cpu, wall, math.nan)
        for name, cpu, wall in (
            (peers.PLAIN, 0.05, 0.06),
            (peers.DYNAMIC, 0.10, 0.11),
            (peers.TWO_RANKS, 0.20, 0.12),
        )
    )
    found = [goal.measured for goal in peers._goals([plain, one, two])]
    assert found == [pytest.approx(2.0), pytest.approx(2.0)]
    assert all(math.isnan(goal.measured) for goal in peers._goals([one, two]))


def test_goals_of_whole_iterations():
    rows = [
        (ranks, n, count, 1e-6 * n**1.2, *(0.1,) * 6, elapsed, 300.0)
        for ranks, n, count, elapsed in (
            (1, 2400, 10, 1.0),
            (1, 38400, 10, 1.0),
            (1, 153600, 10, 1.0),
            (2, 2400, 400, 18.0),
        )
    ]
    rows[2] = (*rows[2][:3], 1e3, *rows[2][4:])  # beyond what the exponent is fitted to
    exponent, demo = (goal.measured for goal in whole._goals(rows))
    assert exponent == pytest.approx(1.2) and demo == 18.0
    assert all(math.isnan(goal.measured) for goal in whole._goals([]))


# -- the bench -------------------------------------------------------------------------------


def _toy(measure):
    return Diagram(
        "toy",
        "A toy",
        ("method", "seconds [s]", "error [-]"),
        measure,
        lambda rows: (Panel("toy", "time [s]", "error [-]", curves(rows, 0, 1, 2)),),
        lambda rows: [f"{len(rows)} points"],
    )


def test_bench_writes_and_goes_on(tmp_path):
    """An ended bench does not measure again what it has, unless the plan differs."""
    calls = []

    def measure(plan, tell):
        tell("now")
        calls.append(plan.quick)
        return [("a", np.float64(1.0), 1e-2), ("a", 10.0, 1e-4), ("b", 1.0, float("nan"))]

    scene, told = load_paper(), []
    for quick in (True, True, False):
        bench(Plan(scene, quick), tmp_path, told.append, (_toy(measure),))
    assert calls == [True, False] and told == ["toy: now"] * 2
    assert {p.name for p in tmp_path.iterdir()} == {"toy.json", "toy.csv", "toy.png", "bench.md"}
    assert (tmp_path / "toy.csv").read_text().splitlines()[1] == "a,1,0.01"
    text = (tmp_path / "bench.md").read_text()
    assert "- 3 points" in text and "toy.png" in text


def test_rows_of_another_source_are_measured_anew(tmp_path, monkeypatch):
    """Neither rows of an older source nor of another peer's version stand beside today's."""
    calls = []
    toy = _toy(lambda *_: calls.append(1) or [("a", 1.0, 1.0)])
    toy = replace(toy, panels=lambda rows: (), uses=("a-package",))

    def again():
        bench(Plan(load_paper(), True), tmp_path, print, (toy,))
        return len(calls)

    assert again() == 1 and again() == 1
    monkeypatch.setattr(common, "source", lambda: "another")
    assert again() == 2 and again() == 2
    monkeypatch.setattr(common, "_version", lambda package: "9.9")
    assert again() == 3


def test_source_is_what_the_files_hold(tmp_path):
    (tmp_path / "sub").mkdir()
    digests = set()
    for name, text in (("a.py", "1"), ("sub/b.py", "1"), ("sub/b.py", "2"), ("c.txt", "3")):
        (tmp_path / name).write_text(text)
        digests.add(common.source.__wrapped__(tmp_path))
    assert len(digests) == 3  # c.txt is no source


def test_ended_bench_keeps_what_is_finished(tmp_path):
    def ended(plan, tell):
        raise KeyboardInterrupt

    toy = _toy(lambda *_: [("a", 1.0, 1e-2)])
    toy = replace(toy, goals=lambda rows: [Goal("error [-]", 0.1, float(rows[0][2]))])
    late = replace(_toy(ended), name="late")
    finished = []
    with pytest.raises(KeyboardInterrupt):
        bench(Plan(load_paper(), True), tmp_path, print, (toy, late), done=finished.append)
    assert len(finished) == 1 and (tmp_path / "toy.png").exists()
    text = (tmp_path / "bench.md").read_text()
    assert "Not finished: late" in text and "partial" in text
    table = [line.split("|")[1:4] for line in text.splitlines() if "at most 0.1" in line]
    assert [[cell.strip() for cell in row] for row in table] == [
        ["error [-]: at most 0.1", "0.01", "yes"]
    ]


def test_goals_are_met_or_not_or_not_measured():
    assert Goal("a", 2.0, 2.0).cells()[1:] == ("2", "yes")
    assert Goal("a", 2.0, 2.1, remark="why").cells()[1:] == ("2.1 (why)", "no")
    assert Goal("a", 50.0, 60.0, least=True).cells() == ("a: at least 50", "60", "yes")
    assert Goal("a", 50.0, 40.0, least=True).cells()[2] == "no"
    assert Goal("a", 50.0, math.nan).cells()[1:] == ("not measured", "")


def test_cut_off_file_is_measured_anew(tmp_path):
    (tmp_path / "toy.json").write_text('{"stamp": [')
    bench(Plan(load_paper(), True), tmp_path, print, (_toy(lambda *_: [("a", 1.0, 1.0)]),))
    assert "a,1,1" in (tmp_path / "toy.csv").read_text()


def test_curves_leave_out_what_a_logarithm_cannot_show():
    lines = curves([("a", 1.0, 2.0), ("a", 2.0, 0.0), ("b", 1.0, float("nan"))], 0, 1, 2)
    assert [(one.label, list(one.y)) for one in lines] == [("a", [2.0])]


def test_every_diagram_labels_its_axes_with_units():
    names = [one.name for one in diagrams()]
    assert names[:5] == ["time", "peers", "whole", "mesh", "reduction"]
    for one in diagrams():
        one.goals([])  # nothing measured is no failure
        for panel in one.panels([(1,) * len(one.columns)]):
            assert panel.x_label.endswith("]") and panel.y_label.endswith("]")


def test_bench_refuses_ranks():
    from dolfinopt.cli import commands

    class Two:
        size, rank = 2, 0

    with pytest.raises(InputError, match="without mpirun"):
        commands.main(["bench"], standalone_mode=False, obj=Two())
