"""What the certificate says of designs by equivalent static loads: closed forms, and scenes.

Stolpe, Verbart & Rojas-Labanda (2018), doi:10.1007/s00158-017-1884-0, show by two-bar trusses that
iterations with equivalent static loads may come to rest where the dynamic problem has no optimum.
Their data were not at hand: the truss here is another one, whose points of rest have a closed form.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from mpi4py import MPI
from runs import QUICK, TWO_ARM, assert_same_bits, overrides, quick, run, shell, summary_of

import dolfinopt as do
from dolfinopt.disk import finite
from dolfinopt.optimization import certificate, loop
from dolfinopt.optimization.certificate import Certificate, judge
from dolfinopt.optimization.iterate import Iterate
from dolfinopt.optimization.mma import initial_state, mma_step
from dolfinopt.optimization.problem import Problem

WORLD = MPI.COMM_WORLD

NO_ROWS = np.zeros(0, dtype=int)


@dataclass(frozen=True)
class TwoBars:
    """Two bars at right angles hold a mass; a harmonic force F cos(w t) works along each of them.

    The bars' stiffnesses k are the design, k_1 + k_2 <= 2 the material; the mass is 1 without them.
    In steady state the displacements have the amplitudes u_i = F_i / (k_i - w2) and are largest at
    once; the objective is the compliance u' K u then, c = sum_i k_i u_i^2. So

        exact:         dc/dk_i = -u_i^2 (k_i + w2) / (k_i - w2),
        frozen loads:  dc/dk_i = -u_i^2.

    With the loads k_i u_i held the least compliance has k_i in proportion to them. That rests where
    u_1 = u_2, k_i = w2 + (2 - 2 w2) F_i / (F_1 + F_2); there the exact derivatives differ.

    Attributes:
        force: F_i.
        w2: square of the frequency.
    """

    force: np.ndarray
    w2: float

    def amplitudes(self, k: np.ndarray) -> np.ndarray:
        return self.force / (k - self.w2)

    def compliance(self, k: np.ndarray) -> float:
        return float(k @ self.amplitudes(k) ** 2)

    def exact(self, k: np.ndarray) -> np.ndarray:
        return -(self.amplitudes(k) ** 2) * (k + self.w2) / (k - self.w2)

    def frozen(self, k: np.ndarray) -> np.ndarray:
        return -(self.amplitudes(k) ** 2)

    def rest(self) -> np.ndarray:
        """Return where iterations with frozen loads rest."""
        return self.w2 + (2.0 - 2.0 * self.w2) * self.force / self.force.sum()

    def problem(self, k: np.ndarray, gradient: np.ndarray) -> Problem:
        material = np.array([0.5 * k.sum() - 1.0]), np.full((1, 2), 0.5)
        return Problem(self.compliance(k), gradient, *material, (), np.zeros(1, dtype=int))

    def iterated(self, k: np.ndarray, count: int) -> np.ndarray:
        """Return what `count` optima for the loads of the design before lead to."""
        for _ in range(count):
            loads = np.abs(k * self.amplitudes(k))
            k = 2.0 * loads / loads.sum()
        return k

    def judged(self, k: np.ndarray, gradient: np.ndarray | None = None) -> Certificate:
        """Return that of k, by the exact gradient or another one."""
        problem = self.problem(k, self.exact(k) if gradient is None else gradient)
        bounds = np.full(2, 0.1), np.full(2, 1.9)
        return judge(k, *bounds, problem, self.frozen(k))

    def improved(self, k: np.ndarray, count: int) -> list[tuple[np.ndarray, Problem]]:
        """Return the designs of `count` steps with the exact gradient."""
        state, found = initial_state(k), []
        for _ in range(count):
            at = self.problem(k, self.exact(k))
            k, state = mma_step(k, at.df0dx, at.f, at.dfdx, 0.1, 1.9, state, move=0.05)
            found.append((k, self.problem(k, self.exact(k))))
        return found


FORCE = np.array([2.0, 1.0])


@pytest.mark.serial
@pytest.mark.parametrize("w2", [0.1, 0.3, 0.4])
def test_two_bars_rest_where_no_optimum_is(w2):
    """Frozen loads converge, and by their own gradient to an optimum; it is none."""
    bars = TwoBars(FORCE, w2)
    k = bars.iterated(np.array([1.1, 0.9]), 200)
    np.testing.assert_allclose(k, bars.rest(), rtol=1e-9)
    assert bars.judged(k, bars.frozen(k)).kkt < 1e-9
    # u_1 = u_2 there: the exact derivatives are as g_i = (k_i + w2) / (k_i - w2).
    g = (k + w2) / (k - w2)
    found = bars.judged(k)
    assert found.kkt == pytest.approx(abs(g[0] - g[1]) / np.sqrt(2.0 * g @ g), rel=1e-7)
    assert found.kkt > 0.03
    slope = np.degrees(np.arctan2(g[1], g[0]))
    assert found.gradient_angle == pytest.approx(abs(slope - 45.0), rel=1e-7)
    assert found.gradient_ratio == pytest.approx(np.sqrt(2.0 / (g @ g)), rel=1e-7)
    # Going on with the exact gradient ends in an optimum, which the certificate confirms.
    steps = bars.improved(k, 60)
    assert bars.judged(steps[-1][0]).kkt < 1e-6
    best = min(one.f0 for _, one in steps)
    grid = np.linspace(w2 + 0.01, 2.0 - w2 - 0.01, 20001)
    least = min(bars.compliance(np.array([one, 2.0 - one])) for one in grid)
    assert best == pytest.approx(least, rel=1e-6)
    assert bars.compliance(k) > 1.001 * best


@pytest.mark.serial  # ranks have no part in it
def test_two_bars_in_slow_motion():
    """Without inertia nothing is lost by freezing the loads."""
    bars = TwoBars(FORCE, 1e-9)
    found = bars.judged(bars.rest())
    # The exact derivatives are as 1 + 2 w2 / k_i: by 1.5 w2 apart, k being 4/3 and 2/3.
    assert found.kkt < 1e-8
    assert found.gradient_angle == pytest.approx(
        np.degrees(0.75e-9), rel=1e-6
    )  # rounding: 1e-16 / 1e-9
    assert found.gradient_ratio == pytest.approx(1.0, abs=1e-6)
    assert found.sentence.startswith("optimality check with the exact gradient: residual ")


@pytest.mark.serial  # ranks have no part in it
def test_two_bars_above_resonance():
    """Stiffness brings the bars nearer to resonance: frozen loads ask for what is worst."""
    bars = TwoBars(FORCE, 1.5)
    k = bars.rest()
    np.testing.assert_allclose(k, [5.0 / 6.0, 7.0 / 6.0])
    found = bars.judged(k)
    assert found.gradient_angle == pytest.approx(180.0 - (np.degrees(np.arctan2(8.0, 3.5)) - 45.0))
    assert found.kkt == pytest.approx(1.0, rel=1e-9)  # nothing balances it
    assert bars.judged(k, bars.frozen(k)).kkt < 1e-9
    steps = bars.improved(k, 60)
    np.testing.assert_allclose(steps[-1][0], 0.1, atol=1e-6)
    # The optimum is less than half as compliant.
    assert bars.compliance(k) > 2.0 * min(one.f0 for _, one in steps)


@pytest.mark.serial  # ranks have no part in it
def test_variables_at_bounds_have_no_part_in_the_angle():
    exact, frozen = np.array([1.0, 0.0, 5.0, 7.0]), np.array([1.0, 1.0, -5.0, -7.0])
    x, low, high = np.array([0.5, 0.5, 0.0, 1.0]), np.zeros(4), np.ones(4)
    problem = Problem(1.0, exact, np.zeros(0), np.zeros((0, 4)), (), NO_ROWS)
    found = judge(x, low, high, problem, frozen)
    assert found.gradient_angle == pytest.approx(45.0) and found.gradient_ratio == pytest.approx(
        np.sqrt(2.0)
    )
    held = judge(x, x, x, problem, frozen)
    assert np.isnan(held.gradient_angle) and held.kkt == 0.0
    alone = judge(x, low, high, problem, None)
    assert np.isnan(alone.gradient_angle) and alone.kkt == found.kkt


LIGHT = "payload.mass=0.2"

POSED = {
    "plain": [],
    "deviation": ["objective.kind=deviation"],
    "frequency": ["constraints.first_frequency=20"],
    "shared volume": ["design.shared_volume=true"],
    # Denser than one half: cut there, nothing is left of a uniform design.
    "heaviside": ["design.projection=heaviside", "design.initial=0.6"],
    "robust": ["design.projection=robust", "design.initial=0.6"],
    "robust member": ["design.projection=robust", "design.initial=0.6", "arms.cells=[160,10]",
                      "design.filter_radius=0.0075", "design.minimum_member=0.02"],
    "scenarios": ["scenarios=[{changes=['payload.mass=1']}, {changes=['payload.mass=3']}]"],
    "worst": [
        "scenarios=[{changes=['payload.mass=1']}, {changes=['payload.mass=3']}]",
        "objective.scenarios=worst",
    ],
    "control": ["control.stiffness=[2e5, 2e4, 2e4]", "control.damping=[2e4, 600.0, 600.0]"],
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.serial  # ranks: test_same_certificate_on_any_number_of_ranks
@pytest.mark.parametrize("posed", POSED)
def test_residual_is_of_the_problem_as_posed(posed, monkeypatch):
    """The certificate of frozen loads is the exact run's residual; both tell the same angle."""
    monkeypatch.setattr(loop, "begins_with_frozen_loads", lambda scene: False)
    esl = do.optimize(quick(LIGHT, *POSED[posed]))
    exact = do.optimize(quick(LIGHT, "objective.gradient=exact", *POSED[posed]))
    # The design has the same bits, so its motion has; adjoints come from the same solution.
    assert esl.certificate.kkt == pytest.approx(exact.kkt, rel=1e-9)
    assert exact.certificate.kkt == pytest.approx(exact.kkt, rel=1e-12)
    assert abs(esl.kkt - exact.kkt) > 1e-4
    assert esl.certificate.gradient_angle == pytest.approx(
        exact.certificate.gradient_angle, rel=1e-7
    )
    assert 1.0 < esl.certificate.gradient_angle < 180.0
    assert esl.certificate.gradient_ratio == pytest.approx(
        exact.certificate.gradient_ratio, rel=1e-7
    )
    assert esl.certificate.seconds > 0.0


@pytest.mark.serial  # ranks have no part in it
def test_limits_of_the_motion_have_frozen_loads():
    """The objective, a mass, has no loads to freeze; the residual is of limits by the motion."""
    posed = ["objective.kind=mass", "constraints.deviation=0.05", "design.initial=0.6"]
    esl = do.optimize(quick(LIGHT, *posed))
    exact = do.optimize(quick(LIGHT, "objective.gradient=exact", *posed))
    assert esl.certificate.kkt == pytest.approx(exact.kkt, rel=1e-9)
    assert np.isnan(esl.certificate.gradient_angle)


@pytest.mark.parametrize("kind", ["static", "eigenfrequency"])
def test_without_motion_the_gradient_is_exact(kind):
    result = do.optimize(quick(f"objective.kind={kind}", iterations=2))
    assert result.certificate.kkt == result.kkt
    loose = do.optimize(quick(f"objective.kind={kind}", "optimizer.kkt_tolerance=10", iterations=0))
    assert loose.certificate.stationary and not result.certificate.stationary
    assert np.isnan(result.certificate.gradient_angle)
    expected = f"optimality check with the exact gradient: residual {result.kkt:.2g}"
    assert result.certificate.sentence == expected


@pytest.mark.serial  # ranks have no part in it
def test_no_exact_gradient_is_told():
    change = "reduction.method=balanced"
    reason = 'reduction.method = "balanced" has no adjoint'
    found = do.optimize(quick(change, "simulation.tolerance=0.1")).certificate
    assert np.isnan(found.kkt) and found.missing == reason and reason in found.sentence
    assert finite(found.to_dict())["kkt"] is None
    # Of objectives without motion it is there all the same.
    assert do.optimize(quick(change, "objective.kind=static")).certificate.missing == ""


def test_failing_gradient_does_not_lose_the_design(monkeypatch):
    def failing(*_):
        raise do.ConvergenceError("the adjoint cannot be solved")

    monkeypatch.setattr(certificate, "_problem_by", failing)
    result = do.optimize(quick(iterations=1))
    assert result.iterations == 1
    expected = "no exact gradient to judge the design by: the adjoint cannot be solved"
    assert result.certificate.sentence == expected


@pytest.mark.serial
def test_the_exact_gradient_takes_over_where_frozen_loads_gain_no_more():
    """As soon as the best design gained at most 1 % in ten iterations.

    With 0.2 kg the loads are the arms' own: frozen, they end half as compliant again.
    """
    result = do.optimize(quick(LIGHT, "objective.gradient=exact", iterations=36))
    k = result.exact_from
    best = np.minimum.accumulate([row.objective for row in result.history])
    gains = best[:-10] / best[10:] - 1.0
    assert k == 10 + int(np.argmax(gains <= 0.01)) < result.iterations
    frozen = do.optimize(quick(LIGHT, iterations=36))
    assert [row.objective for row in result.history[: k + 1]] == [
        row.objective for row in frozen.history[: k + 1]
    ]
    assert frozen.certificate.kkt > 0.1 and frozen.certificate.gradient_angle > 20.0
    assert frozen.exact_from is None and not result.violated
    assert frozen.evaluation.objective > 1.3 * result.evaluation.objective


class Killed(Exception):
    """Stands for a kill."""


@pytest.mark.parametrize("kept", [0, 2])
def test_interrupted_iterations_with_the_exact_gradient_go_on(shared_tmp_path, monkeypatch, kept):
    """The end has the same bits."""
    monkeypatch.setattr(loop, "WINDOW", 4)
    monkeypatch.setattr(loop, "FROZEN_GAIN", 10.0)  # at once
    monkeypatch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
    asked = quick(LIGHT, "objective.gradient=exact", iterations=6)
    whole = do.optimize(asked)
    assert (whole.iterations, whole.exact_from) == (6, 2)
    update = Iterate.step

    def counted(one):
        if one.iteration == 2 + kept:
            raise Killed
        update(one)

    with monkeypatch.context() as patch:
        patch.setattr(Iterate, "step", counted)
        with pytest.raises(Killed):
            do.optimize(asked, shared_tmp_path)
    again = do.optimize(asked, shared_tmp_path, resume=True)
    assert replace(again.certificate, seconds=0.0) == replace(whole.certificate, seconds=0.0)
    assert_same_bits(again, whole)


def test_summary_and_screen(shared_tmp_path):
    words = overrides(*QUICK, LIGHT, "optimizer.max_iterations=1")
    words = [*words, "--verbose"]
    if WORLD.size > 1:
        run("optimize", TWO_ARM, *words, "--no-plots", "--out", shared_tmp_path / "out")
        return
    done = shell("optimize", TWO_ARM, *words, "--no-plots", "--out", shared_tmp_path / "out")
    assert done.returncode == 0, done.stderr
    summary = summary_of(shared_tmp_path / "out")
    found = summary["certificate"]
    assert f"  {found['sentence']}\n" in done.stdout
    assert found["feasible"] and found["missing"] == "" and summary["iterations"] == 1
    assert 0.02 < found["kkt"] < 10.0 and not found["stationary"]
    assert summary["units"]["certificate"]["gradient_angle"] == "degree"


@pytest.mark.skipif(WORLD.size == 1, reason="needs more than one rank")
def test_same_certificate_on_any_number_of_ranks():
    asked = quick(LIGHT, iterations=1)
    together, alone = do.optimize(asked), do.optimize(asked, world=MPI.COMM_SELF)
    found, expected = together.certificate, alone.certificate
    assert found.kkt == pytest.approx(expected.kkt, rel=1e-7)
    assert found.gradient_angle == pytest.approx(expected.gradient_angle, rel=1e-7)
    assert together.evaluation.objective == pytest.approx(alone.evaluation.objective, rel=1e-7)
