"""A machine linearised about its motion at one instant: A, B, C, D, the poles, their derivatives.

The equations of motion r(y, y', y'', t) = u, with y the free rigid coordinates, those of the arms
and of motors behind springs, give M dy'' + D dy' + K dy = du with the derivatives of r at the
simulated motion. In a closed loop g(y) = 0 the motion has fewer coordinates z,

    dy = N dz,   N = (1, S) of independent and dependent coordinates,   G_d S = -G_i,   G = dg/dy,

and N moves with it: dy' = N dz' + N' dz, dy'' = N dz'' + 2 N' dz' + N'' dz. The multipliers drop
out of N^T times the equations. Of redundant equations G_d has more rows than columns. States are
x = (dz, dz').
Source: Shabana, Dynamics of Multibody Systems (2020), ch. 3; Tisseur & Meerbergen (2001),
doi:10.1137/S0036144500381988, for the derivative of the poles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinopt.dynamics.build import build_system
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.measured import POLE_STEP
from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.errors import InputError
from dolfinopt.multibody.closures import ClosedLoops
from dolfinopt.multibody.kinematics import end_effector_gradient
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, add_integrals
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.machine import Control

WRENCH = {2: ("fx", "fy", "mz"), 3: ("fx", "fy", "fz", "mx", "my", "mz")}
# Differences of sixth order: a function's value and first two derivatives from those at OFFSETS.
OFFSETS = np.arange(-3.0, 4.0)
POWERS = np.vander(OFFSETS, 3, increasing=True) / [1.0, 1.0, 2.0]
DIFFERENCES = np.linalg.inv(np.vander(OFFSETS, increasing=True))[:3] * [[1.0], [1.0], [2.0]]
ROUNDING = np.sqrt(np.finfo(float).eps)  # of singular values, of which a rank is judged


@dataclass(frozen=True, eq=False)
class StateSpace:
    """dx' = A dx + B du, dy = C dx + D du about a motion at one instant.

    Attributes:
        time: the instant, s.
        A, B, C, D: (n, n), (n, m), (p, n), (p, m).
        states, inputs, outputs: their names.
        input_units, output_units: N, N m; m, rad.
        closed: whether the control acts; otherwise the drives' forces are free inputs.
        accurate_below: frequency below which the poles hold 1 %, Hz; nan where it is not known.
    """

    time: float
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    closed: bool
    accurate_below: float = np.nan

    @property
    def poles(self) -> np.ndarray:
        """Eigenvalues of A, 1/s, slowest first; of a pair the one above the real axis first."""
        found = np.linalg.eigvals(self.A).astype(complex)
        return found[np.lexsort((-found.imag, np.round(np.abs(found), 9)))]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all of it as arrays by name, as files have it; frequencies in Hz."""
        found = {key: np.asarray(value) for key, value in vars(self).items()}
        poles = self.poles
        return found | {
            "poles": poles,
            "frequencies": np.abs(poles) / (2.0 * np.pi),
            "damping_ratios": damping_ratios(poles),
        }


def damping_ratios(poles: np.ndarray) -> np.ndarray:
    """Return -Re / |pole|; of a pole at zero 0."""
    size = np.abs(poles)
    return np.divide(-poles.real, size, out=np.zeros_like(size), where=size > 0.0)


@dataclass(frozen=True, eq=False)
class Linearised:
    """M dy'' + D dy' + K dy = du of a machine at one instant, and the motions that loops leave.

    Attributes:
        system: with free rigid coordinates.
        t: the instant (1,), s.
        rates: y, y', y'' (3, S).
        K, D, M: (S, S) over all unknowns, those of multipliers included.
    """

    system: MachineSystem
    t: np.ndarray
    rates: np.ndarray
    K: np.ndarray
    D: np.ndarray
    M: np.ndarray

    @cached_property
    def motion(self) -> np.ndarray:
        """All coordinates of the mechanism, their rates and accelerations (3, C)."""
        instants, parts = self.system.at(self.t), self.rates[:, None]
        rigid = instants.motion(*parts)
        elastic = [instants.split(x)[1] for x in parts]
        return np.hstack([np.concatenate([rigid.q, rigid.qd, rigid.qdd]), np.concatenate(elastic)])

    def loops(self, poses: np.ndarray) -> ClosedLoops:
        """Return the closed loops at poses (n, C)."""
        assert self.system.loops is not None
        rigid = self.system.mechanism.num_rigid
        return self.system.loops.at(self.system.mechanism, poses[:, :rigid], poses[:, rigid:])

    @cached_property
    def time_step(self) -> float:
        """Time in which the motion goes as far as differences need, s."""
        rigid = self.system.mechanism.num_rigid
        speed, rate = self._size(self.motion[1:, :rigid].T, self.motion[1:, rigid:].T)
        return float(POLE_STEP / max(speed + np.sqrt(rate), POLE_STEP))

    @cached_property
    def to_rates(self) -> tuple[np.ndarray, np.ndarray]:
        """Weights (7, 3) that move coordinates by rates, (3, 7) that differentiate, in time."""
        powers = self.time_step ** np.arange(3.0)
        return POWERS * powers, DIFFERENCES / powers[:, None]

    @cached_property
    def constraints(self) -> np.ndarray:
        """G = dg/dy and its first and second rate along the motion (3, m, S)."""
        _, moving, last = self.system.ends
        found = np.zeros((3, last - moving, self.system.num_coordinates))
        if self.system.loops is not None:
            move, differentiate = self.to_rates
            G = self.loops(move @ self.motion).jacobian[:, :, self.system.columns]
            found[:, :, :moving] = np.tensordot(differentiate, G, 1)
        return found

    @cached_property
    def dependent(self) -> np.ndarray:
        """As many unknowns as G has independent rows, which follow from the others."""
        # Joints without a drive first; loops that rigid arms would lock take elastic coordinates.
        from scipy.linalg import qr

        R, moving, _ = self.system.ends
        joints, G = np.flatnonzero(~self.system.drives.driven), self.constraints[0, :, :moving]
        scale = np.abs(G[:, R:]).max(initial=0.0) or 1.0
        sizes = np.linalg.svd(np.hstack([G[:, :R], G[:, R:] / scale]), compute_uv=False)
        rank = int((sizes > ROUNDING * sizes.max(initial=0.0)).sum())
        if rank <= len(joints):
            return joints
        left = np.linalg.qr(G[:, joints], mode="complete")[0][:, len(joints) :]
        order = qr(left.T @ G[:, R:], mode="r", pivoting=True)[1]
        return np.concatenate([joints, R + order[: rank - len(joints)]])

    @cached_property
    def independent(self) -> np.ndarray:
        """The others (n,), without multipliers."""
        _, moving, last = self.system.ends
        every = np.arange(self.system.num_coordinates)
        return np.setdiff1d(every, [*range(moving, last), *self.dependent])

    @cached_property
    def directions(self) -> np.ndarray:
        """N, N' and N'' (3, S, n), see the module; the identity without a loop."""
        d, i = self.dependent, self.independent
        found = np.zeros((3, self.system.num_coordinates, len(i)))
        found[0, i, np.arange(len(i))] = 1.0
        G, Gd, Gdd = self.constraints
        N, Nd, Ndd = found
        inverse = np.linalg.pinv(G[:, d])
        N[d] = -inverse @ G @ N
        Nd[d] = -inverse @ Gd @ N
        Ndd[d] = -inverse @ (Gdd @ N + 2.0 * Gd @ Nd)
        return found

    @cached_property
    def reduced(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stiffness, damping and mass (n, n) of the independent coordinates."""
        N, Nd, Ndd = self.directions
        K = self.M @ Ndd + self.D @ Nd + self.K @ N
        return N.T @ K, N.T @ (2.0 * self.M @ Nd + self.D @ N), N.T @ self.M @ N

    def accelerations(self, forces: np.ndarray) -> np.ndarray:
        """Return those of the independent coordinates by forces on them, (n, k) both.

        Raises:
            InputError: a coordinate has no mass.
        """
        M = self.reduced[2]
        scale = 1.0 / np.sqrt(np.abs(np.diag(M)) + np.finfo(float).tiny)
        scaled = scale[:, None] * M * scale
        if not np.isfinite(scaled).all() or np.linalg.cond(scaled) > 1e14:
            raise InputError(
                f"linearised at {self.t[0]:g} s a coordinate has no mass, so that its acceleration "
                "is not determined; give motors behind springs a rotor_inertia, carts before a "
                "bearing a cart_mass, and bearings no stiffness about their joint's own axis: "
                "gear_stiffness is the spring there"
            )
        found: np.ndarray = scale[:, None] * np.linalg.solve(scaled, scale[:, None] * forces)
        return found

    @cached_property
    def A(self) -> np.ndarray:
        """The matrix (2 n, 2 n) of dx' = A dx."""
        K, D, _ = self.reduced
        return np.vstack([np.eye(len(K), 2 * len(K), len(K)), -self.accelerations(np.hstack([K, D]))])

    def size(self, displaced: np.ndarray) -> np.ndarray:
        """Return how far columns of displacements (S, k) move or turn frames, m or rad."""
        R, moving, last = self.system.ends
        rigid = np.concatenate([displaced[:R], displaced[last:]])
        return self._size(rigid, displaced[R:moving])

    def _size(self, rigid: np.ndarray, elastic: np.ndarray) -> np.ndarray:
        mechanism = self.system.mechanism
        parts = zip(mechanism.bodies, mechanism.slices, strict=True)
        moved = [rigid, *(body.outboard @ elastic[part] for body, part in parts)]
        return np.abs(np.concatenate(moved)).max(axis=0, initial=0.0)


def linearised(system: MachineSystem, t: float, rates: tuple[np.ndarray, ...]) -> Linearised:
    """Return the derivatives of a machine's equations at an instant t, s; rates (1, S) each."""
    at = np.array([t])
    matrix = system.at(at).linearise(*rates).dense()[0]
    return Linearised(system, at, np.concatenate(rates), *np.split(matrix, 3, axis=1))


def check_instant(scene: Scene, t: float) -> None:
    """Raise `InputError` when an instant, s, is not within the motion."""
    if not 0.0 <= t <= scene.motion.horizon:
        raise InputError(
            f"--state-space {t:g}: expected an instant from 0 to motion.horizon = "
            f"{scene.motion.horizon:g} [s]"
        )


def free_machine(trajectory: Trajectory, t: float) -> Linearised:
    """Return the machine at an instant of its motion, all its drives free where none controls it.

    Raises:
        InputError: the instant is not within the motion.
    """
    scene, problem = trajectory.scene, trajectory.problem
    check_instant(scene, t)
    seen = trajectory.at(np.array([t]))
    if isinstance(problem, MachineSystem) and scene.control is not None:
        return linearised(problem, t, seen.unknowns)
    bodies = list(problem.mechanism.bodies[: len(scene.arms)])  # bearings follow from the scene
    # Drives on all driven coordinates, whose forces nothing asks for.
    none = (0.0,) * len(scene.driven)
    control = Control(feed_forward="none", stiffness=none, damping=none)
    system = build_system(scene.model_copy(update={"control": control}), bodies)
    assert isinstance(system, MachineSystem)
    # Drives that nothing controls are where the motion has them; so are motors before springs.
    rates = np.zeros((3, 1, system.num_coordinates))
    R, moving, last = system.ends
    motion, desired = seen.motion, seen.desired
    pairs = ((motion.q, desired.q), (motion.qd, desired.qd), (motion.qdd, desired.qdd))
    for k, (actual, wanted) in enumerate(pairs):
        rates[k, :, :R] = (actual - wanted)[:, system.drives.free]
        rates[k, :, R:moving] = seen.unknowns[k][:, problem.elastic_columns]
    if isinstance(problem, MachineSystem):
        rates[2, :, moving:last] = problem.at(seen.t).split(seen.unknowns[2])[2]
    return linearised(system, t, tuple(rates))


def state_space(trajectory: Trajectory, t: float) -> StateSpace:
    """Return a simulated machine linearised at an instant of its motion.

    Inputs are the drives' forces, in a closed loop those that are added to the control's, and force
    and moment on the end-effector in the world's directions. Outputs are the drives' coordinates,
    of joints behind springs the motors'; the end-effector's displacement; and the part of it that
    the arms' deformation makes, the rigid coordinates held.

    Args:
        trajectory: of a machine with or without control.
        t: the instant, s.

    Raises:
        InputError: the instant is not within the motion, or a coordinate has no mass.
    """
    one, scene = free_machine(trajectory, t), trajectory.scene
    system, N = one.system, one.directions[0]
    drives, wrench = _driven(system), _wrench(one)
    b = N.T @ np.hstack([drives, wrench])
    place = wrench[:, : scene.dimension].T
    bent = np.zeros_like(place)
    bent[:, system.elastic_columns] = place[:, system.elastic_columns]
    outputs = np.vstack([drives.T, place, bent]) @ N
    names = coordinate_names(system, scene)
    kept = [names[k] for k in one.independent]
    free = scene.driven
    units = [scene.rigid_units[name] for name in free]
    axes = "xyz"[: scene.dimension]
    wrench_units = [*["N"] * scene.dimension, *["N m"] * (wrench.shape[1] - scene.dimension)]
    return StateSpace(
        time=t,
        A=one.A,
        B=np.vstack([np.zeros_like(b), one.accelerations(b)]),
        C=np.hstack([outputs, np.zeros_like(outputs)]),
        D=np.zeros((len(outputs), b.shape[1])),
        states=(*kept, *(f"{name} rate" for name in kept)),
        inputs=(*free, *(f"tool {name}" for name in WRENCH[scene.dimension])),
        outputs=(*free, *(f"tool {a}" for a in axes), *(f"deflection {a}" for a in axes)),
        input_units=(*("N" if unit == "m" else "N m" for unit in units), *wrench_units),
        output_units=(*units, *["m"] * (2 * scene.dimension)),
        closed=scene.control is not None,
    )


def coordinate_names(system: MachineSystem, scene: Scene) -> list[str]:
    """Return the names of all unknowns of a machine."""
    rigid = list(scene.rigid_units)
    names = [rigid[int(k)] for k in system.drives.free]
    arms = [arm.name for arm in scene.arms]
    bearings = [joint.name for joint in system.mechanism.joints[len(arms) :]]
    for name, part in zip([*arms, *bearings], system.mechanism.slices, strict=True):
        names += [f"{name} q{k + 1}" for k in range(part.stop - part.start)]
    names += [f"multiplier {k + 1}" for k in range(system.ends[2] - system.ends[1])]
    joints = system.drives.free[system.drives.springs.joints]
    return names + [f"motor of {rigid[int(k)]}" for k in joints]


def _driven(system: MachineSystem) -> np.ndarray:
    """Return what a unit force of every drive is on every unknown (S, drives)."""
    return np.eye(system.num_coordinates)[:, system.drive_columns[system.drives.driven]]


def _wrench(one: Linearised) -> np.ndarray:
    """Return what unit forces and moments on the end-effector are on every unknown (S, d + r)."""
    system, instants = one.system, one.system.at(one.t)
    motion, q = instants.motion(*one.rates[:, None]), instants.split(one.rates[:1])[1]
    d, r = system.mechanism.dim.d, system.mechanism.dim.r
    found = np.zeros((system.num_coordinates, d + r))
    for k, unit in enumerate(np.eye(d + r)):
        parts = unit[None, :d], unit[None, d:]
        by_q, by_rigid, _ = end_effector_gradient(system.mechanism, motion, q, *parts)
        found[: system.ends[1], k] = np.hstack([by_rigid[:, system.drives.free], by_q])[0]
    return found


# -- poles and their derivatives -------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Poles:
    """Solutions of w^T N^T (M p'' + D p' + K p) = 0 for all w of a machine, P of them.

    p = N v, p' = lambda p + N' v and p'' = lambda^2 p + 2 lambda N' v + N'' v are a vibration's
    displacements, rates and accelerations; the latter hold the multipliers' changes, too.

    Attributes:
        one: the machine.
        values: lambda (P,) complex, 1/s, those above the real axis or on it.
        vibrations: p, p', p'' (3, S, P).
        left: N w (S, P), w being scaled so that w^T d(N^T (M p'' + D p' + K p)) / dlambda = 1.
        constraint_weights: (3, m, P) of g, g' and g'': what their derivatives, changed, make of
            lambda through N.
    """

    one: Linearised
    values: np.ndarray
    vibrations: np.ndarray
    left: np.ndarray
    constraint_weights: np.ndarray

    def gradient(self, by_values: np.ndarray) -> tuple[np.ndarray, list[ShapeIntegrals]]:
        """Differentiate a real function of the poles.

        dlambda = -d(left . r + constraint_weights . (g, g', g'')), each linearised along the
        vibration, by all that they depend on: central differences along it of their derivatives.

        Args:
            by_values: (P,) complex, dJ = Re(sum by_values dlambda).

        Returns:
            By the system's coordinates and their rates (3, 1, S), and by every body's integrals.
        """
        # With no pole one of no weight: what follows has an instant at least.
        used = np.flatnonzero(by_values) if by_values.any() else np.zeros(1, dtype=int)
        S, system = len(self.left), self.one.system
        along = _real_parts(self.vibrations[:, :, used])
        left = _real_parts(-by_values[used] * self.left[:, used], conjugate=True)
        held = _real_parts(-by_values[used] * self.constraint_weights[:, :, used], conjugate=True)
        reach = self.one.to_rates[0][-1] @ np.stack([self.one.size(np.abs(x)) for x in along])
        steps = POLE_STEP / np.where(reach > 0.0, reach, 1.0)
        offsets = np.multiply.outer(OFFSETS, steps)  # (7, k)
        shares = np.multiply.outer(DIFFERENCES[1], 1.0 / steps)
        change = (along[..., None, :] * offsets).reshape(3, S, -1).transpose(0, 2, 1)
        rows = (left[:, None, :] * shares).reshape(S, -1).T.copy()
        rates = self.one.rates[:, None] + change
        instants = system.at(np.repeat(self.one.t, len(rows)))
        tangent = instants.linearise(*rates)
        by_rates = np.stack([x.sum(axis=0) for x in tangent.transposed(rows)])
        by_bodies = system.body_gradient(instants, *rates, rows)
        if system.loops is not None:
            held = (held[:, :, None, :] * shares).reshape(*held.shape[:2], -1)
            own, parts = self._by_constraints(change, held.transpose(0, 2, 1))
            by_rates[:, : system.ends[1]] += own
            by_bodies = [add_integrals(a, b) for a, b in zip(by_bodies, parts, strict=True)]
        return by_rates[:, None], by_bodies

    def _by_constraints(
        self, change: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
        """Return the derivatives of sum_kn weights_kn . d^k g_n / dt^k, by rates (3, R + N), bodies.

        Args:
            change: (3, n, S) of the rates, of every motion along which g is differentiated.
            weights: (3, n, m).
        """
        one, columns, moving = self.one, self.one.system.columns, self.one.system.ends[1]
        move, differentiate = one.to_rates
        poses = np.repeat((move @ one.motion)[:, None], change.shape[1], axis=1)
        poses[:, :, columns] += np.tensordot(move, change[:, :, :moving], 1)
        here = one.loops(poses.reshape(-1, poses.shape[2]))
        by_gap = np.tensordot(differentiate.T, weights, 1).reshape(-1, weights.shape[2])
        by_pose = np.einsum("nm,nmc->nc", by_gap, here.jacobian)[:, columns]
        by_rates = move.T @ by_pose.reshape(len(move), -1, moving).sum(axis=1)
        none = np.zeros_like(by_gap), np.zeros((len(by_gap), poses.shape[2]))
        return by_rates, here.gradient(by_gap, *none)


def _real_parts(x: np.ndarray, conjugate: bool = False) -> np.ndarray:
    """Return the real parts (..., 2 P) of x (..., P) and of what is left: Re(a b) by products."""
    return np.concatenate([x.real, -x.imag if conjugate else x.imag], axis=-1)


def poles_of(one: Linearised) -> Poles:
    """Return the poles of a machine.

    Raises:
        InputError: a coordinate has no mass.
    """
    from scipy.linalg import eig

    _, D, M = one.reduced
    n, (_, moving, last) = len(M), one.system.ends
    values, left, right = eig(one.A, left=True, right=True)
    above = np.flatnonzero(values.imag >= 0.0)
    values, v = values[above], right[:n, above]
    w = np.linalg.solve(M.T, np.conj(left[n:, above]))
    w = w / np.einsum("ip,ip->p", w, 2.0 * values * (M @ v) + D @ v)
    N, Nd, Ndd = one.directions
    p, W = N @ v, N @ w
    vibrations = np.stack([p, values * p + Nd @ v, values**2 * p + 2.0 * values * (Nd @ v) + Ndd @ v])
    forces = one.K @ vibrations[0] + one.D @ vibrations[1] + one.M @ vibrations[2]
    rows = np.setdiff1d(np.arange(len(N)), np.arange(moving, last))
    vibrations[2, moving:last] = -np.linalg.pinv(one.M[rows, moving:last]) @ forces[rows]
    # W weighs changes of p, p' and p'' of the dependent coordinates, which changes of G make.
    G, Gd, Gdd = one.constraints[:, :, one.dependent].swapaxes(1, 2)
    K, D, M = (x[:, one.dependent].T @ W for x in (one.K, one.D, one.M))
    inverse = np.linalg.pinv(G)
    third = inverse @ M
    second = inverse @ (D - 2.0 * Gd @ third)
    first = inverse @ (K - Gd @ second - Gdd @ third)
    return Poles(one, values, vibrations, W, -np.stack([first, second, third]))
