"""Joint motions under which the bending arms carry the tip along its path: servo constraints.

Corrections r_F = sum_k B_k(t) c_k of some joints, splines of degree 5, are such that the tip h of
the flexible machine stays on the path y of the rigid one:

    min over c   1/2 sum_i w_i |h(t_i, c) - y(t_i)|^2 + rho/2 |c|^2,

by Gauss-Newton steps. The columns dh/dc follow from the linearised collocation equations, all
right sides at once, so that nothing is integrated backwards in time: the internal dynamics of a
flexible arm are unstable (non-minimum phase), their bounded solution begins before the motion does,
within `lead`. Source: Seifried, Dynamics of Underactuated Multibody Systems (2014),
doi:10.1007/978-3-319-01228-5; Bastos, Seifried & Bruels (2013), doi:10.1007/s11044-012-9318-6.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, pairwise

import numpy as np

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.adjoint import Adjoint
from dolfinopt.dynamics.collocation import (
    Solution,
    end_gain,
    lagrange_integrals,
    radau_iia,
    stage_values,
    stages_of,
)
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.newton_matrix import matrix_of
from dolfinopt.dynamics.system import Unchanged
from dolfinopt.dynamics.tables import LoadedMotion, stage_instants
from dolfinopt.dynamics.time_grid import first_grid
from dolfinopt.errors import InputError
from dolfinopt.multibody.kinematics import end_effector, end_effector_gradient, lengths
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, add_integrals
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Scene

DEGREE = 5
FINEST = 16.0  # times closer are knots beside breakpoints, where steps grow by
GROWTH = 1.5
FIRST_SPACING = 0.02  # of the motion's duration
SPACINGS_LIMIT = 4
AIM = 1e-4  # of the deviation without corrections
STEPS = 2  # of Gauss-Newton: the first leaves 4e-3 of it on two_arm, the second 1e-5
REGULARISATION = 1e-12  # of the mean of the normal matrix's diagonal
SINGULAR = 1e-3  # least singular value of the tip's Jacobian, over the reach
INSTANTS = 121  # at which it is looked at


# -- corrections -----------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Splines:
    """Splines of degree 5 whose rates and accelerations vanish at both ends.

    Attributes:
        knots: (m,) ascending, the first 0 and the last the horizon, s.
    """

    knots: np.ndarray

    @cached_property
    def _every(self) -> tuple[Callable[[np.ndarray], np.ndarray], ...]:
        from scipy.interpolate import BSpline  # takes as long to import as NumPy

        ends = self.knots[[0, -1]]
        knots = np.concatenate([np.repeat(ends[0], DEGREE), self.knots, np.repeat(ends[1], DEGREE)])
        # The first three coefficients are equal, and so are the last three.
        count = len(self.knots) + DEGREE - 1
        tie = np.repeat(np.eye(count - 4), [3, *[1] * (count - 6), 3], axis=0)
        spline = BSpline(knots, tie, DEGREE)
        return spline, spline.derivative(1), spline.derivative(2)

    @property
    def count(self) -> int:
        """Number p of coefficients of a joint."""
        return len(self.knots) + DEGREE - 5

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return all splines, their rates and accelerations (3, n, p) at instants t (n,), s."""
        return np.stack([one(t) for one in self._every])


@dataclass(frozen=True, eq=False)
class Corrections:
    """What some joints turn beside their desired motion.

    Attributes:
        joints: (F,) rigid coordinates.
        splines: p of them.
        coefficients: (p, F), rad, m.
    """

    joints: np.ndarray
    splines: Splines
    coefficients: np.ndarray

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return corrections, rates and accelerations (3, n, F)."""
        return self.splines.at(t) @ self.coefficients


@dataclass(frozen=True, eq=False)
class CorrectedMotion:
    """A motion and corrections of it, at given instants."""

    motion: Callable[[np.ndarray], RigidMotion]
    corrections: Corrections

    def __call__(self, t: np.ndarray) -> RigidMotion:
        """Return the corrected motion at instants t (n,), s."""
        desired, joints = self.motion(t), self.corrections.joints
        rates = [desired.q.copy(), desired.qd.copy(), desired.qdd.copy()]
        for x, change in zip(rates, self.corrections.at(t), strict=True):
            x[:, joints] += change
        q, qd, qdd = rates
        return replace(desired, q=q, qd=qd, qdd=qdd)


def corrected(machine: MachineSystem, corrections: Corrections) -> MachineSystem:
    """Return a machine that moves with corrections, its tip's path unchanged."""
    motion = machine.motion
    if isinstance(motion, LoadedMotion):
        moved = replace(motion, motion=CorrectedMotion(motion.motion, corrections))
        return replace(machine, motion=moved, path=motion)
    return replace(machine, motion=CorrectedMotion(motion, corrections), path=motion)


def graded_knots(breakpoints: tuple[float, ...], spacing: float) -> np.ndarray:
    """Return knots (m,) at most `spacing` apart, s, closer beside the breakpoints.

    There a motion's jerk jumps, and the internal dynamics answer within milliseconds.
    """
    knots = [np.array(breakpoints[:1])]
    for begin, end in pairwise(breakpoints):
        half = 0.5 * (end - begin)
        steps = np.minimum(spacing, spacing / FINEST * GROWTH ** np.arange(int(half / spacing) + 20))
        near = np.cumsum(steps)
        near = near[near < half]
        near = near * (half / near[-1]) if len(near) else np.array([half])
        knots += [begin + near, end - near[-2::-1], np.array([end])]
    return np.concatenate(knots)


# -- the tip ---------------------------------------------------------------------------------


def tip_jacobians(
    machine: MachineSystem, motion: RigidMotion, q: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the tip's derivatives by elastic (n, d, N) and rigid coordinates (n, d, R)."""
    d = machine.mechanism.dim.d
    by_q, by_rigid = [], []
    for axis in np.eye(d):
        weights = np.tile(axis, (len(q), 1))
        one = end_effector_gradient(machine.mechanism, motion, q, weights)
        by_q.append(one[0])
        by_rigid.append(one[1])
    return np.stack(by_q, axis=1), np.stack(by_rigid, axis=1)


def path_of(machine: MachineSystem, t: np.ndarray) -> np.ndarray:
    """Return where the tip of rigid arms is on the desired motion (n, d), m."""
    desired = (machine.path or machine.motion)(t)
    none = np.zeros((len(t), machine.mechanism.num_coordinates))
    return end_effector(machine.mechanism, desired, none)


def off_path(machine: MachineSystem, solution: Solution, t: np.ndarray) -> np.ndarray:
    """Return how far the tip is off its path (n, d), m."""
    rates = [solution.sample(t, k) for k in range(3)]
    state = machine.at(t).state(*rates)
    return end_effector(machine.mechanism, state.motion, state.elastic[0]) - path_of(machine, t)


def regular_joints(
    machine: MachineSystem, candidates: np.ndarray, count: int | None
) -> tuple[np.ndarray, float, float]:
    """Return the joints that move the tip best, how well, and where they do it worst.

    Of all sets of as many joints as the path has components, or of `count`, the one whose Jacobian
    of the tip has the largest least singular value, over the reach, at the worst of some instants;
    joints that follow in closed loops follow.

    Returns:
        Joints (F,), that value [-] and its instant, s.
    """
    t = np.linspace(0.0, machine.breakpoints[-1], INSTANTS)
    motion, none = machine.motion(t), np.zeros((len(t), machine.mechanism.num_coordinates))
    J = tip_jacobians(machine, motion, none)[1]
    if machine.loops is not None:
        dependent = machine.drives.dependent
        G = machine.loops.at(machine.rigid, motion.q, none[:, :0]).jacobian
        follows = np.linalg.pinv(G[:, :, dependent]) @ G[:, :, : J.shape[2]]
        J = J - J[:, :, dependent] @ follows
    J = J / machine.mechanism.levers
    rank = min(np.linalg.matrix_rank(J[:, :, candidates]).max(), len(candidates))

    def values(joints: tuple[int, ...]) -> np.ndarray:
        sizes = np.linalg.svd(J[:, :, list(joints)], compute_uv=False)
        return sizes[:, min(rank, len(joints)) - 1]

    best = max(combinations(candidates, count or rank), key=lambda one: values(one).min())
    worst = int(values(best).argmin())
    return np.array(best), float(values(best)[worst]), float(t[worst])


# -- linearised motion -----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TipResponse:
    """What the tip does at instants t when corrections change.

    Attributes:
        by_coefficients: (n, d, p F) columns.
        forced: (n, d) what the residual that is left still moves it by.
    """

    by_coefficients: np.ndarray
    forced: np.ndarray


def tip_response(
    machine: MachineSystem, solution: Solution, corrections: Corrections, t: np.ndarray
) -> TipResponse:
    """Return the tip's answer by the linearised collocation equations, all columns at once."""
    joints, splines = corrections.joints, corrections.splines
    method, S = radau_iia(len(solution.nodes)), machine.num_coordinates
    stages = stages_of(Unchanged(machine), method, solution.time_grid)
    q, qd = stage_values(stages, solution.q, solution.qd, solution.a)
    state = stages.instants.state(*(x.reshape(-1, S) for x in (q, qd, solution.a)))
    n, s = solution.a.shape[:2]
    basis = splines.at(stage_instants(solution.time_grid, method.c))
    loads = np.einsum("nrfk,knp->nrpf", state.by_command(joints), basis)
    loads = np.concatenate([loads.reshape(n * s, S, -1), state.residual()[:, :, None]], axis=2)
    matrix = matrix_of(stages, stages.instants.linearise(*state.rates), np.arange(S))
    forced = -(matrix.inverse @ loads.reshape(n, s * S, -1))
    gain = end_gain(stages, forced.reshape(n, s, S, -1))
    y = np.zeros((n, 2 * S, forced.shape[2]))
    y[0, :S, :-1] = start_response(machine, solution.q[0], corrections)
    for k in range(n - 1):
        y[k + 1] = matrix.transfer[k] @ y[k] + gain[k]
    a = forced + matrix.answer.reshape(n, s * S, -1) @ y
    rates = [solution.sample(t, k) for k in range(3)]
    here = machine.at(t).state(*rates)
    by_q, by_rigid = tip_jacobians(machine, here.motion, here.elastic[0])
    by_y = np.zeros((*by_q.shape[:2], S))
    by_y[:, :, : machine.ends[0]] = by_rigid[:, :, machine.drives.free]
    by_y[:, :, machine.elastic_columns] = by_q
    moved = _sampled(solution, t, by_y, y, a)
    own = np.einsum("ndf,np->ndpf", by_rigid[:, :, joints], splines.at(t)[0])
    return TipResponse(moved[:, :, :-1] + own.reshape(*own.shape[:2], -1), moved[:, :, -1])


def start_response(machine: MachineSystem, y: np.ndarray, corrections: Corrections) -> np.ndarray:
    """Return the change of the equilibrium at t = 0 by the coefficients (S, p F)."""
    first = corrections.splines.at(np.zeros(1))[0, 0]
    by_joint = machine.start_by_command(y, corrections.joints)
    return np.einsum("sf,p->spf", by_joint, first).reshape(len(by_joint), -1)


def _sampled(
    solution: Solution, t: np.ndarray, by_y: np.ndarray, y: np.ndarray, a: np.ndarray
) -> np.ndarray:
    """Return by_y . change (m, d, columns) at instants t of coordinates that change.

    Args:
        solution: S coordinates.
        t: (m,) s.
        by_y: (m, d, S).
        y: (n, 2 S, columns) at the steps' beginnings.
        a: (n, s S, columns) accelerations.
    """
    step = np.clip(np.searchsorted(solution.time_grid, t, side="left") - 1, 0, len(a) - 1)
    h = np.diff(solution.time_grid)[step]
    tau = (t - solution.time_grid[step]) / h
    weights = lagrange_integrals(solution.nodes, tau)[2] * (h * h)[:, None]
    by_a = (by_y[:, :, None] * weights[:, None, :, None]).reshape(*by_y.shape[:2], -1)
    by_first = np.concatenate([by_y, by_y * (h * tau)[:, None, None]], axis=2)
    out = np.empty((len(t), by_y.shape[1], y.shape[2]))
    for k in np.unique(step):
        here = step == k
        out[here] = by_first[here] @ y[k] + by_a[here] @ a[k]
    return out


# -- least squares ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class FeedForward:
    """Corrections of a machine's joints, and its motion with them.

    Attributes:
        machine: that moves with them.
        solution: its motion.
        corrections: of its joints.
        regularity: least singular value of the tip's Jacobian by these joints, over the reach.
        before, left: largest distance of the tip from its path without and with them, m.
    """

    machine: MachineSystem
    solution: Solution
    corrections: Corrections
    regularity: float
    before: float
    left: float

    @cached_property
    def _squares(self) -> LeastSquares:
        return least_squares(self.machine, self.solution, self.corrections)

    @cached_property
    def _adjoint(self) -> Adjoint:
        return Adjoint(self.machine, self.solution)

    def gradient(self, by_coefficients: np.ndarray) -> list[ShapeIntegrals]:
        """Return the derivative by every body of J through the coefficients, dJ/dc (p, F).

        The coefficients follow the bodies: J_c' W (J_c dc + dh) = 0, hence
        dJ = -dJ/dc (J_c' W J_c)^-1 J_c' W dh, one adjoint of this motion.
        """
        squares = self._squares
        change = np.linalg.solve(squares.normal, by_coefficients.ravel())
        moved = squares.weights * (squares.by_coefficients @ change)
        weights = -moved.reshape(len(squares.t), -1)
        by_q, _, by_bodies = tip_gradient(self.machine, self.solution, squares.t, weights)
        multipliers = self._adjoint.multipliers(squares.t, by_q)
        followed = self._adjoint.by_bodies(*multipliers)
        return [add_integrals(a, own) for a, own in zip(followed, by_bodies, strict=True)]


def by_coefficients(
    corrections: Corrections,
    adjoint: Adjoint,
    multipliers: tuple[np.ndarray, np.ndarray],
    t: np.ndarray,
    by_motion: np.ndarray,
) -> np.ndarray:
    """Return dJ/dc (p, F) through a motion that these corrections move.

    Args:
        corrections: of the motion.
        adjoint: of the motion.
        multipliers: of J, see `Adjoint.multipliers`.
        t: (m,) instants, s.
        by_motion: (3, m, R) dJ there by rigid coordinates, their rates and accelerations, held.
    """
    joints, splines, (rows, by_start) = corrections.joints, corrections.splines, multipliers
    solution = adjoint.solution
    at = stage_instants(solution.time_grid, solution.nodes)
    by_stage = np.einsum("ns,nsfk->knf", rows, adjoint.state.by_command(joints))
    own = by_motion[:, :, joints]
    total = np.einsum("knp,knf->pf", splines.at(at), by_stage)
    total += np.einsum("knp,knf->pf", splines.at(t), own)
    first = adjoint.system.start_by_command(solution.q[0], joints)
    return total + np.outer(splines.at(np.zeros(1))[0, 0], by_start @ first)


def tip_gradient(
    machine: MachineSystem, solution: Solution, t: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[dict[str, np.ndarray]]]:
    """Return the gradient of sum weights . tip (n, d) by unknowns (n, S), joints (n, R), bodies."""
    state = machine.at(t).state(*(solution.sample(t, k) for k in range(3)))
    q = state.elastic[0]
    by_q, by_rigid, bodies = end_effector_gradient(machine.mechanism, state.motion, q, weights)
    by = np.zeros((len(t), machine.num_coordinates))
    by[:, machine.elastic_columns] = by_q
    by[:, : machine.ends[0]] = by_rigid[:, machine.drives.free]
    return by, by_rigid, bodies


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """The linearised problem of the corrections: min |W^1/2 (J c + gap)|^2 + rho |c|^2.

    Attributes:
        t: (n,) instants at which the tip counts, s.
        weights: (n d,) W.
        by_coefficients: J (n d, p F).
        gap: (n d,) m.
        normal: J' W J + rho.
    """

    t: np.ndarray
    weights: np.ndarray
    by_coefficients: np.ndarray
    gap: np.ndarray
    normal: np.ndarray
    rho: float

    def step(self, coefficients: np.ndarray) -> np.ndarray:
        """Return coefficients (p, F) that are best by the linearised problem."""
        c = coefficients.ravel()
        right = self.by_coefficients.T @ (self.weights * self.gap) + self.rho * c
        return (c - np.linalg.solve(self.normal, right)).reshape(coefficients.shape)


def least_squares(
    machine: MachineSystem, solution: Solution, corrections: Corrections
) -> LeastSquares:
    """Return the linearised problem about a motion with corrections."""
    knots = corrections.splines.knots
    t = np.sort(np.concatenate([knots, 0.5 * (knots[1:] + knots[:-1])]))
    answer = tip_response(machine, solution, corrections, t)
    gap = (off_path(machine, solution, t) + answer.forced).ravel()
    J = answer.by_coefficients.reshape(len(gap), -1)
    weights = np.repeat(np.gradient(t), len(gap) // len(t))
    normal = J.T @ (weights[:, None] * J)
    rho = REGULARISATION * np.trace(normal) / len(normal)
    normal[np.diag_indices(len(normal))] += rho
    return LeastSquares(t, weights, J, gap, normal, rho)


def at_rest(machine: MachineSystem, tolerance: float, stages: int) -> Solution:
    """Return the undeformed machine on its first steps: where Gauss-Newton begins."""
    grid = first_grid(machine, tolerance, stages)
    q = np.repeat(machine.initial_state()[0], len(grid) - 1, axis=0)
    a = np.zeros((len(q), stages, q.shape[1]))
    return Solution(grid, radau_iia(stages).c, q, np.zeros_like(q), a, np.inf, 0)


def feed_forward_of(
    machine: MachineSystem, scene: Scene, profile: Profile, start: Solution | None = None
) -> FeedForward:
    """Return the corrections of a scene's machine.

    The knots are as close as it takes to leave `AIM` of the deviation, or as the scene has them.

    Raises:
        ConvergenceError: a motion with corrections cannot be simulated.
        InputError: at some instant no joints move the tip along its path.
    """
    joints, regularity = joints_of(machine, scene)
    options, asked = scene.simulation, scene.feed_forward.spacing
    spacing = asked or FIRST_SPACING * scene.motion.duration
    first = at_rest(machine, options.tolerance, options.stages)
    before = tip_error_at_rest(machine, first)
    found, last = None, None
    for _ in range(1 if asked else SPACINGS_LIMIT):
        splines = Splines(graded_knots(machine.breakpoints, spacing))
        none = np.zeros((splines.count, len(joints)))
        corrections, moved, solution = Corrections(joints, splines, none), machine, first
        for _ in range(STEPS):
            squares = least_squares(moved, solution, corrections)
            coefficients = squares.step(corrections.coefficients)
            corrections = replace(corrections, coefficients=coefficients)
            moved = corrected(machine, corrections)
            start = solution if np.isfinite(solution.error) else start
            solution = radau.integrate(moved, options.tolerance, options.stages, profile, start)
        left = float(lengths(off_path(moved, solution, squares.t)).max())
        found = FeedForward(moved, solution, corrections, regularity, before, left)
        if left <= AIM * before or (last is not None and left > 0.5 * last):
            break
        spacing, last = 0.5 * spacing, left
    assert found is not None
    return found


def tip_error_at_rest(machine: MachineSystem, solution: Solution) -> float:
    """Return the largest distance of the tip from its path without corrections, m, linearised."""
    t = solution.time_grid
    nothing = Corrections(np.zeros(0, dtype=int), Splines(t), np.zeros((len(t), 0)))
    answer = tip_response(machine, solution, nothing, t)
    return float(lengths(off_path(machine, solution, t) + answer.forced).max())


def joints_of(machine: MachineSystem, scene: Scene) -> tuple[np.ndarray, float]:
    """Return the rigid coordinates that are corrected, and how well they move the tip.

    Raises:
        InputError: they do not move it along every component of its path.
    """
    names, driven = list(scene.rigid_units), scene.feed_forward.joints
    candidates = [names.index(name) for name in driven or scene.driven]
    joints, least, t = regular_joints(machine, np.sort(candidates), None if driven is None else len(driven))
    if least < SINGULAR:
        moved = ", ".join(names[k] for k in joints)
        raise InputError(
            f"{scene.source}: feed_forward.joints: {moved} cannot move the tip along its path at "
            f"t = {t - scene.lead:.4g} s; choose other joints, or a path that keeps away from "
            "that position"
        )
    return joints, least
