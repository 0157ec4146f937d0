"""Joint motions under which the bending arms carry the tip along its path: servo constraints.

Corrections r_F = sum_k B_k(t) c_k of some joints, splines of degree 5, are such that the tip h of
the flexible machine stays on the path y of the rigid one:

    min over c   1/2 sum_i w_i |P_i (h(t_i, c) - y(t_i))|^2 + c' R c / 2,

R of their accelerations, P on the directions in which these joints can move the tip, by
Gauss-Newton steps. The columns dh/dc follow from the linearised
collocation equations, all right sides at once, so that nothing is integrated backwards in time: the
internal dynamics of a flexible arm are unstable (non-minimum phase), their bounded solution begins
before the motion does, within `lead`. Source: Seifried, Dynamics of Underactuated Multibody Systems
(2014), doi:10.1007/978-3-319-01228-5; Bastos, Seifried & Bruels (2013),
doi:10.1007/s11044-012-9318-6.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations, pairwise

import numpy as np

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.adjoint import Adjoint, add_gradients
from dolfinopt.dynamics.collocation import (
    Solution,
    end_gain,
    lagrange,
    radau_iia,
    stage_values,
    stages_of,
)
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.measured import (
    CURVATURE_STEPS,
    CURVED_SHARE,
    EXACT,
    FINEST_KNOTS,
    FIRST_SPACING,
    FORCE_INTERVAL,
    GAUSS_NEWTON_STEPS,
    JOINT_DIFFERENCE,
    KNOT_GROWTH,
    LEFT_AIM,
    OF_REDUNDANT,
    REGULARISATION,
    SINGULAR_TIP,
    SPLINE_DEGREE,
    TIP_INSTANTS,
)
from dolfinopt.dynamics.newton_matrix import matrix_of
from dolfinopt.dynamics.system import unchanged
from dolfinopt.dynamics.tables import LoadedMotion, Table, stage_instants
from dolfinopt.dynamics.time_grid import first_grid
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.multibody.kinematics import end_effector, end_effector_gradient, lengths
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, add_integrals
from dolfinopt.profiling import Profile
from dolfinopt.scene.tables.machine import FeedForward as Asked
from dolfinopt.scene.tables.motion import Simulation

# -- corrections -----------------------------------------------------------------------------

Functions = tuple[Callable[[np.ndarray], np.ndarray], ...]


@dataclass(frozen=True, eq=False)
class Splines:
    """Splines of degree 5 whose rates and accelerations vanish at both ends.

    Attributes:
        knots: (m,) ascending, the first 0 and the last the horizon, s.
    """

    knots: np.ndarray

    def of(self, coefficients: np.ndarray) -> Functions:
        """Return the curve of coefficients (p, F) and two derivatives, functions of t (n,), s."""
        from scipy.interpolate import BSpline  # takes as long to import as NumPy

        ends = self.knots[[0, -1]]
        knots = np.concatenate(
            [np.repeat(ends[0], SPLINE_DEGREE), self.knots, np.repeat(ends[1], SPLINE_DEGREE)]
        )
        # The first three coefficients are equal, and so are the last three.
        tied = np.repeat(coefficients, [3, *[1] * (self.count - 2), 3], axis=0)
        spline = BSpline(knots, tied, SPLINE_DEGREE)
        return spline, spline.derivative(1), spline.derivative(2)

    @cached_property
    def _every(self) -> Functions:
        return self.of(np.eye(self.count))

    @property
    def count(self) -> int:
        """Number p of coefficients of a joint."""
        return len(self.knots) + SPLINE_DEGREE - 5

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return all splines, their rates and accelerations (3, n, p) at instants t (n,), s."""
        return np.stack([function(t) for function in self._every])


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

    @cached_property
    def _curve(self) -> Functions:
        return self.splines.of(self.coefficients)

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return corrections, rates and accelerations (3, n, F)."""
        return np.stack([function(t) for function in self._curve])


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


def with_known_forces(machine: MachineSystem, feed_forward: FeedForward) -> MachineSystem:
    """Return a controlled machine whose drives know the forces of the prescribed, corrected one."""
    drives, horizon = machine.drives, machine.breakpoints[-1]
    t = np.linspace(0.0, horizon, int(np.ceil(horizon / FORCE_INTERVAL)) + 1)
    rates = (feed_forward.solution.sample(t, k) for k in range(3))
    forces = feed_forward.machine.at(t).state(*rates).forces()[:, drives.free]
    if drives.table is not None:
        forces = forces + drives.table(t)
    return replace(machine, drives=replace(drives, table=Table(t, forces * drives.driven)))


def graded_knots(breakpoints: tuple[float, ...], spacing: float) -> np.ndarray:
    """Return knots (m,) at most `spacing` apart, s, closer beside the breakpoints.

    There a motion's jerk jumps, and the internal dynamics answer within milliseconds.
    """
    knots = [np.array(breakpoints[:1])]
    for begin, end in pairwise(breakpoints):
        half = 0.5 * (end - begin)
        steps = np.minimum(
            spacing, spacing / FINEST_KNOTS * KNOT_GROWTH ** np.arange(int(half / spacing) + 20)
        )
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
        slopes = end_effector_gradient(machine.mechanism, motion, q, weights)
        by_q.append(slopes[0])
        by_rigid.append(slopes[1])
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


def tip_by_joints(machine: MachineSystem, t: np.ndarray) -> np.ndarray:
    """Return the tip's Jacobian of rigid arms (n, d, R) at instants (n,), s, over the reach.

    Joints that follow in closed loops follow.
    """
    motion, none = machine.motion(t), np.zeros((len(t), machine.mechanism.num_coordinates))
    J = tip_jacobians(machine, motion, none)[1]
    if machine.loops is not None:
        dependent = machine.drives.dependent
        G = machine.loops.at(machine.rigid, motion.q, none[:, :0]).jacobian
        J = J - J[:, :, dependent] @ np.linalg.pinv(G[:, :, dependent]) @ G[:, :, : J.shape[2]]
    return np.asarray(J / machine.mechanism.levers)


def directions(machine: MachineSystem, joints: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the projections (n, d, d) on where joints can move the tip, on the desired motion.

    Across them, as where a planar machine sags out of its plane, there is nothing to be had: a
    five-bar's motors would leave its path by 14 mm for 2 mm of sag.

    Args:
        machine: with or without corrections.
        joints: (F,) rigid coordinates.
        t: (n,) s.
    """
    desired = replace(machine, motion=machine.path or machine.motion)
    J = tip_by_joints(desired, t)[:, :, joints]
    return np.asarray(J @ np.linalg.pinv(J))


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
    stages = stages_of(unchanged(machine), method, solution.time_grid)
    q, qd = stage_values(stages, solution.q, solution.qd, solution.a)
    instants = machine.at_stages(solution.time_grid, method.c)
    state = instants.state(*(x.reshape(-1, S) for x in (q, qd, solution.a)))
    n, s = solution.a.shape[:2]
    basis = splines.at(stage_instants(solution.time_grid, method.c))
    loads = state.by_command(joints).reshape(n * s, -1, 3) @ basis.swapaxes(0, 1)
    loads = loads.reshape(n * s, S, len(joints), -1).swapaxes(2, 3).reshape(n * s, S, -1)
    loads = np.concatenate([loads, state.residual()[:, :, None]], axis=2)
    matrix = matrix_of(stages, instants.linearise(*state.rates), np.arange(S))
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
    weights = lagrange(solution.nodes, tau, -2) * (h * h)[:, None]
    by_a = (by_y[:, :, None] * weights[:, None, :, None]).reshape(*by_y.shape[:2], -1)
    by_first = np.concatenate([by_y, by_y * (h * tau)[:, None, None]], axis=2)
    out = np.empty((len(t), by_y.shape[1], y.shape[2]))
    for k in np.unique(step):
        here = step == k
        out[here] = by_first[here] @ y[k] + by_a[here] @ a[k]
    return out


def internal_rates(feed_forward: FeedForward) -> np.ndarray | None:
    """Return the eigenvalues (2 N,) of what the arms may still do while the tip is held, 1/s.

    At rest at t = 0, of a machine on a prescribed motion that closes no loop. With r_F = P q that
    keep the tip, P = -H_F^-1 H_q, (K + K_F P) q + (D + D_F P) q' + (M + M_F P) q'' = 0: those with
    positive real part are unstable, and begin before the motion.
    """
    machine, corrections = feed_forward.machine, feed_forward.corrections
    if not machine.is_prescribed:
        return None
    y = machine.initial_state()[0]
    none = np.zeros_like(y)
    state = machine.at(np.zeros(1)).state(y, none, none)
    by_q, by_rigid = tip_jacobians(machine, state.motion, y)
    P = -np.linalg.pinv(by_rigid[0][:, corrections.joints]) @ by_q[0]
    own = np.split(state.instants.linearise(*state.rates).dense()[0], 3, axis=1)
    by_joints = state.by_command(corrections.joints)[0]
    K, D, M = (x + by_joints[:, :, k] @ P for k, x in enumerate(own))
    inverse, size = np.linalg.inv(M), len(M)
    zero, identity = np.zeros((size, size)), np.eye(size)
    return np.asarray(np.linalg.eigvals(np.block([[zero, identity], [-inverse @ K, -inverse @ D]])))


# -- least squares ---------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class FeedForward:
    """Corrections of a machine's joints, and its motion with them.

    Attributes:
        plain: without them.
        machine: that moves with them.
        solution: its motion.
        corrections: of its joints.
        redundant: whether more joints are corrected than the tip has directions.
        has_curvature: whether the coefficients follow the bodies by second derivatives, too.
        regularity: least singular value of the tip's Jacobian by these joints, over the reach.
        before, left: largest distance of the tip from its path, m: without them, as far as they can
            take it away, and with them.
    """

    plain: MachineSystem
    machine: MachineSystem
    solution: Solution
    corrections: Corrections
    redundant: bool
    has_curvature: bool
    regularity: float
    before: float
    left: float

    @cached_property
    def _squares(self) -> LeastSquares:
        return least_squares(self.machine, self.solution, self.corrections, self.redundant)

    @cached_property
    def _adjoint(self) -> Adjoint:
        return Adjoint(self.machine, self.solution)

    def gradient(self, by_coefficients: np.ndarray) -> list[ShapeIntegrals]:
        """Return the derivative by every body of J through the coefficients, dJ/dc (p, F).

        The coefficients follow the bodies, as G = J_c' W e + R c stays zero. With the multipliers
        mu of (J_c' W J_c + R + S) mu = dJ/dc, S = sum_i (W e)_i d2h_i/dc2,

            dJ = -mu . dG = -(W J_c mu) . dh - d/d eps [ (W e) . dh(c + eps mu) ],

        an adjoint of this motion and, where the tip is not exactly on its path or joints are more
        than needed, those of two motions beside it.
        """
        squares = self._squares
        change = np.linalg.solve(squares.normal, by_coefficients.ravel())
        further: list[ShapeIntegrals] = []
        if self.has_curvature:
            first = np.linalg.norm(change)
            for _ in range(CURVATURE_STEPS):
                curved, further = self._curvature(change)
                change = np.linalg.solve(squares.normal, by_coefficients.ravel() + curved)
            if np.linalg.norm(change) > 2.0 * first:
                raise ConvergenceError(
                    "feed-forward: the tip stays too far off its path for a gradient of the "
                    "corrections; raise feed_forward.lead, or correct other joints"
                )
        weights = -squares.weights * (squares.by_coefficients @ change)
        result = self._follow(self.machine, self.solution, weights)[0]
        return add_gradients(result, further) if further else result

    def _curvature(self, change: np.ndarray) -> tuple[np.ndarray, list[ShapeIntegrals]]:
        """Return -S mu (p F,) and -d/d eps of the bodies' derivative, by central differences."""
        squares, corrections = self._squares, self.corrections
        mu = change.reshape(corrections.coefficients.shape)
        eps = JOINT_DIFFERENCE / np.abs(corrections.splines.at(squares.t)[0] @ mu).max()
        weights = squares.weights * squares.gap / (2.0 * eps)
        sides = []
        for sign in (1.0, -1.0):
            moved_by = replace(corrections, coefficients=corrections.coefficients + sign * eps * mu)
            moved = corrected(self.plain, moved_by)
            grid, stages = self.solution.time_grid, len(self.solution.nodes)
            solution = radau.on_grid(moved, grid, EXACT, stages, self.solution)
            sides.append(self._follow(moved, solution, -sign * weights))
        (plus, by_plus), (minus, by_minus) = sides
        return (by_plus + by_minus).ravel(), add_gradients(plus, minus)

    def _follow(
        self, machine: MachineSystem, solution: Solution, weights: np.ndarray
    ) -> tuple[list[ShapeIntegrals], np.ndarray]:
        """Return the derivative of sum weights . tip (n d,) by bodies and coefficients (p, F)."""
        t, corrections = self._squares.t, self.corrections
        adjoint = self._adjoint if machine is self.machine else Adjoint(machine, solution)
        by_q, by_rigid, own = tip_gradient(machine, solution, t, weights.reshape(len(t), -1))
        multipliers = adjoint.multipliers(t, by_q)
        bodies = adjoint.by_bodies(*multipliers)
        by_motion = np.stack([by_rigid, *np.zeros((2, *by_rigid.shape))])
        by = by_coefficients(corrections, adjoint, multipliers, t, by_motion)
        return [add_integrals(a, b) for a, b in zip(bodies, own, strict=True)], by


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
    by_command, first = adjoint.by_command(joints)
    by_stage = np.einsum("ns,nsfk->knf", rows, by_command)
    own = by_motion[:, :, joints]
    total = np.tensordot(splines.at(at), by_stage, ((0, 1), (0, 1)))
    total += np.tensordot(splines.at(t), own, ((0, 1), (0, 1)))
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
    """The linearised problem of the corrections: min |W^1/2 P (J c + gap)|^2 + c' R c.

    Attributes:
        t: (n,) instants at which the tip counts, s.
        along: (n, d, d) where joints can move it, see `directions`.
        weights: (n d,) W.
        by_coefficients: J (n d, p F), along.
        gap: (n d,) m, along.
        normal: J' W J + R.
        roughness: R (p F, p F): of the corrections' accelerations, and of their size.
    """

    t: np.ndarray
    along: np.ndarray
    weights: np.ndarray
    by_coefficients: np.ndarray
    gap: np.ndarray
    normal: np.ndarray
    roughness: np.ndarray

    def left(self, off: np.ndarray) -> np.ndarray:
        """Return the part of distances from the path (n, d) that joints can take away, m."""
        return np.asarray((self.along @ off[:, :, None])[:, :, 0])

    def step(self, coefficients: np.ndarray) -> np.ndarray:
        """Return coefficients (p, F) that are best by the linearised problem."""
        c = coefficients.ravel()
        right = self.by_coefficients.T @ (self.weights * self.gap) + self.roughness @ c
        return (c - np.linalg.solve(self.normal, right)).reshape(coefficients.shape)


def least_squares(
    machine: MachineSystem, solution: Solution, corrections: Corrections, redundant: bool
) -> LeastSquares:
    """Return the linearised problem about a motion with corrections, see `FeedForward`."""
    knots = corrections.splines.knots
    t = np.sort(np.concatenate([knots, 0.5 * (knots[1:] + knots[:-1])]))
    answer = tip_response(machine, solution, corrections, t)
    along = directions(machine, corrections.joints, t)
    off = off_path(machine, solution, t) + answer.forced
    gap = (along @ off[:, :, None]).ravel()
    J = (along @ answer.by_coefficients).reshape(len(gap), -1)
    weights = np.repeat(np.gradient(t), len(gap) // len(t))
    normal = J.T @ (weights[:, None] * J)
    share = OF_REDUNDANT if redundant else REGULARISATION
    roughness = share * np.trace(normal) * _roughness(corrections, t, redundant)
    return LeastSquares(t, along, weights, J, gap, normal + roughness, roughness)


def _roughness(corrections: Corrections, t: np.ndarray, redundant: bool) -> np.ndarray:
    """Return the matrix (p F, p F) of the integral of squared accelerations, of trace 1.

    Joints in surplus may share a constant offset, which has none: there their size counts as much.
    """
    bends = corrections.splines.at(t)[2]
    squares = bends.T @ (np.gradient(t)[:, None] * bends)
    squares /= np.trace(squares)
    if redundant:
        squares += np.eye(len(squares)) / len(squares)
    roughness = np.kron(squares, np.eye(len(corrections.joints)))
    return np.asarray(roughness / np.trace(roughness))


def at_rest(machine: MachineSystem, tolerance: float, stages: int) -> Solution:
    """Return the undeformed machine on its first steps: where Gauss-Newton begins."""
    grid = first_grid(machine, tolerance, stages)
    q = np.repeat(machine.initial_state()[0], len(grid) - 1, axis=0)
    a = np.zeros((len(q), stages, q.shape[1]))
    return Solution(grid, radau_iia(stages).c, q, np.zeros_like(q), a, np.inf, 0)


def feed_forward_of(
    machine: MachineSystem,
    asked: Asked,
    path: tuple[float, float],
    options: Simulation,
    profile: Profile,
    start: Solution | None = None,
) -> FeedForward:
    """Return the corrections of a machine.

    The knots are as close as it takes to leave `LEFT_AIM` of what joints can take away; or as they
    are asked for.

    Args:
        machine: without corrections.
        asked: joints and spacing, or None for either.
        path: its beginning and end, s.
        options: tolerance.
        profile: counts Newton iterations.
        start: solution of a nearby design, or None.

    Raises:
        ConvergenceError: a motion with corrections cannot be simulated.
        InputError: at some instant no joints move the tip along its path.
    """
    joints, regularity, redundant = joints_of(machine, asked.joints, path[0])
    spacing = asked.spacing or FIRST_SPACING * (path[1] - path[0])
    stages = radau.stages_for(options.tolerance)
    run = partial(radau.integrate, tolerance=options.tolerance, stages=stages, profile=profile)
    first = at_rest(machine, options.tolerance, stages)
    before, last, guess = 0.0, np.inf, start
    while True:
        splines = Splines(graded_knots(machine.breakpoints, spacing))
        none = np.zeros((splines.count, len(joints)))
        corrections, moved, solution = Corrections(joints, splines, none), machine, first
        steps = GAUSS_NEWTON_STEPS * (2 if redundant else 1)
        for number in range(1 + steps):
            if number < steps:
                squares = least_squares(moved, solution, corrections, redundant)
                gap = squares.gap.reshape(len(squares.t), -1)
                before = before or float(lengths(gap).max())  # that of the first, at rest
            else:  # what is left is answered by the same derivatives
                off = off_path(moved, solution, squares.t)
                squares = replace(squares, gap=squares.left(off).ravel())
            corrections = replace(corrections, coefficients=squares.step(corrections.coefficients))
            moved = corrected(machine, corrections)
            solution = guess = run(moved, guess=guess)
        off = off_path(moved, solution, squares.t)
        left = float(lengths(squares.left(off)).max())
        if asked.spacing or left <= LEFT_AIM * before or left > 0.5 * last:
            break
        spacing, last = 0.5 * spacing, left
    curved, rest = redundant or left > CURVED_SHARE * before, float(lengths(off).max())
    return FeedForward(
        machine, moved, solution, corrections, redundant, curved, regularity, before, rest
    )


def joints_of(
    machine: MachineSystem, asked: Sequence[str] | None, begin: float
) -> tuple[np.ndarray, float, bool]:
    """Return the rigid coordinates that are corrected, how well they move the tip, and a surplus.

    Args:
        machine: without corrections.
        asked: names of the coordinates; None: those that move the tip best.
        begin: of the path, s.

    Raises:
        InputError: they do not move it along every component of its path.
    """
    names = list(machine.names.units)
    every = np.sort([names.index(name) for name in machine.names.driven])
    t = np.linspace(0.0, machine.breakpoints[-1], TIP_INSTANTS)
    J = tip_by_joints(machine, t)
    needed = min(int(np.linalg.matrix_rank(J[:, :, every]).max()), len(every))
    if asked is None:
        joints = max(
            combinations(every, needed), key=lambda combination: least(J, combination, needed).min()
        )
    else:
        joints = tuple(sorted(names.index(name) for name in asked))
    if len(joints) < needed:
        raise InputError(
            f"{machine.names.source}: feed_forward.joints: expected at least {needed} joints, as "
            "many as the tip has directions"
        )
    values = least(J, joints, needed)
    worst = int(values.argmin())
    if values[worst] < SINGULAR_TIP:
        moved = ", ".join(names[k] for k in joints)
        raise InputError(
            f"{machine.names.source}: feed_forward.joints: {moved} cannot move the tip along its "
            f"path at t = {t[worst] - begin:.4g} s; choose other joints, or a path that keeps away "
            "from that position"
        )
    return np.array(joints), float(values[worst]), len(joints) > needed


def least(J: np.ndarray, joints: tuple[int, ...], needed: int) -> np.ndarray:
    """Return the least singular value (n,) of so many of the tip's Jacobian by some joints."""
    sizes = np.linalg.svd(J[:, :, list(joints)], compute_uv=False)
    return np.asarray(sizes[:, needed - 1])
