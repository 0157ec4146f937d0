"""A machine linearised about its motion at one instant: A, B, C, D, and the poles.

The equations of motion r(y, y', y'', t) = u, with y the free rigid coordinates, those of the arms
and of motors behind springs, give M dy'' + D dy' + K dy = du with the derivatives of r at the
simulated motion. In a closed loop g(y) = 0 the motion has fewer coordinates z,

    dy = N dz,   N = (1, S) of independent and dependent coordinates,   S = -G_d^-1 G_i,

G = dg/dy, and N moves with it: dy' = N dz' + N' dz, dy'' = N dz'' + 2 N' dz' + N'' dz. The
multipliers drop out of N^T times the equations. States are x = (dz, dz').
Source: Shabana, Dynamics of Multibody Systems (2020), ch. 3; Tisseur & Meerbergen (2001),
doi:10.1137/S0036144500381988, for the derivative of the poles.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.dynamics.build import build_system
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.measured import LOOP_STEP_SHARE, POLE_STENCIL, POLE_STEP
from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.errors import InputError
from dolfinopt.multibody.kinematics import end_effector_gradient
from dolfinopt.multibody.ranks import rank
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.machine import Control

GIVE_MASS = (
    "give motors behind springs a rotor_inertia, carts before a bearing a cart_mass, and bearings "
    "no stiffness about their joint's own axis: gear_stiffness is the spring there"
)
WRENCH = {2: ("fx", "fy", "mz"), 3: ("fx", "fy", "fz", "mx", "my", "mz")}


@dataclass(frozen=True, eq=False)
class StateSpace:
    """dx' = A dx + B du, dy = C dx + D du about a motion at one instant.

    Attributes:
        time: the instant, s.
        A, B, C, D: (n, n), (n, m), (p, n), (p, m).
        states, inputs, outputs: their names.
        input_units, output_units: N, N m; m, rad.
        closed: whether the control acts; otherwise the drives' forces are free inputs.
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
    """M dy'' + D dy' + K dy = du of a machine at one instant.

    Attributes:
        system: with free rigid coordinates.
        t: the instant (1,), s.
        rates: y, y', y'' (1, S).
        K, D, M: (S, S) over all unknowns, those of multipliers included.
    """

    system: MachineSystem
    t: np.ndarray
    rates: tuple[np.ndarray, np.ndarray, np.ndarray]
    K: np.ndarray
    D: np.ndarray
    M: np.ndarray


def linearised(system: MachineSystem, t: float, rates: tuple[np.ndarray, ...]) -> Linearised:
    """Return the derivatives of a machine's equations at an instant t, s; rates (1, S) each."""
    at, (y, yd, ydd) = np.array([t]), rates
    matrix = system.at(at).linearise(y, yd, ydd).dense()[0]
    K, D, M = np.split(matrix, 3, axis=1)
    return Linearised(system, at, (y, yd, ydd), K, D, M)


def free_machine(trajectory: Trajectory, t: float) -> Linearised:
    """Return the machine at an instant of its motion, all its drives free where none controls it.

    Raises:
        InputError: the instant is not within the motion.
    """
    scene, problem = trajectory.scene, trajectory.problem
    if not 0.0 <= t <= scene.motion.horizon:
        raise InputError(
            f"--state-space {t:g}: expected an instant from 0 to motion.horizon = "
            f"{scene.motion.horizon:g} [s]"
        )
    seen = trajectory.at(np.array([t]))
    if isinstance(problem, MachineSystem) and scene.control is not None:
        return linearised(problem, t, seen.unknowns)
    bodies = list(problem.mechanism.bodies[: len(scene.arms)])  # bearings follow from the scene
    system = build_system(_without_gains(scene), bodies)
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


def _without_gains(scene: Scene) -> Scene:
    """Return the scene with drives on all driven coordinates whose forces nothing asks for."""
    none = (0.0,) * len(scene.driven)
    control = Control(feed_forward="none", stiffness=none, damping=none)
    return scene.model_copy(update={"control": control})


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
    one = free_machine(trajectory, t)
    system, scene = one.system, trajectory.scene
    N, Nd, Ndd = null_space(one)
    M, D = N.T @ one.M @ N, N.T @ (2.0 * one.M @ Nd + one.D @ N)
    K = N.T @ (one.M @ Ndd + one.D @ Nd + one.K @ N)
    drives, wrench = _driven(system), _wrench(one)
    b = N.T @ np.hstack([drives, wrench])
    accelerations = _solved(M, np.hstack([-K, -D, b]), scene)
    n = len(M)
    A = np.vstack([np.eye(n, 2 * n, n), accelerations[:, : 2 * n]])
    B = np.vstack([np.zeros_like(b), accelerations[:, 2 * n :]])
    place = wrench[:, : scene.dimension].T
    bent = np.zeros_like(place)
    bent[:, system.elastic_columns] = place[:, system.elastic_columns]
    outputs = np.vstack([drives.T, place, bent]) @ N
    C = np.hstack([outputs, np.zeros_like(outputs)])
    names = coordinate_names(system, scene)
    kept = [names[int(np.flatnonzero(column == 1.0)[0])] for column in N.T]
    free = scene.driven
    units = [scene.rigid_units[name] for name in free]
    axes = "xyz"[: scene.dimension]
    wrench_units = [*["N"] * scene.dimension, *["N m"] * (wrench.shape[1] - scene.dimension)]
    return StateSpace(
        time=t,
        A=A,
        B=B,
        C=C,
        D=np.zeros((len(C), B.shape[1])),
        states=(*kept, *(f"{name} rate" for name in kept)),
        inputs=(*free, *(f"tool {name}" for name in WRENCH[scene.dimension])),
        outputs=(*free, *(f"tool {a}" for a in axes), *(f"deflection {a}" for a in axes)),
        input_units=(*("N" if unit == "m" else "N m" for unit in units), *wrench_units),
        output_units=(*units, *["m"] * (2 * scene.dimension)),
        closed=scene.control is not None,
    )


def _solved(M: np.ndarray, right: np.ndarray, scene: Scene) -> np.ndarray:
    """Return M^-1 right; M may be singular where a motor behind a spring has no inertia."""
    scale = 1.0 / np.sqrt(np.abs(np.diag(M)) + np.finfo(float).tiny)
    scaled = scale[:, None] * M * scale
    if not np.isfinite(scaled).all() or np.linalg.cond(scaled) > 1e14:
        raise InputError(
            f"{scene.source}: --state-space: a coordinate has no mass, so that its acceleration is "
            f"not determined; {GIVE_MASS}"
        )
    found: np.ndarray = scale[:, None] * np.linalg.solve(scaled, scale[:, None] * right)
    return found


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
    columns = system.drive_columns[system.drives.driven]
    found = np.zeros((system.num_coordinates, len(columns)))
    found[columns, np.arange(len(columns))] = 1.0
    return found


def _wrench(one: Linearised) -> np.ndarray:
    """Return what unit forces and moments on the end-effector are on every unknown (S, d + r)."""
    system, (motion, q, _) = one.system, _moving(one)
    d, r = system.mechanism.dim.d, system.mechanism.dim.r
    found = np.zeros((system.num_coordinates, d + r))
    for k, unit in enumerate(np.eye(d + r)):
        parts = unit[None, :d], unit[None, d:]
        by_q, by_rigid, _ = end_effector_gradient(system.mechanism, motion, q, *parts)
        found[: system.ends[1], k] = np.hstack([by_rigid[:, system.drives.free], by_q])[0]
    return found


def _moving(one: Linearised) -> tuple[RigidMotion, np.ndarray, np.ndarray]:
    """Return the rigid motion, and elastic coordinates and their rates (1, N)."""
    instants = one.system.at(one.t)
    q, qd, _ = (instants.split(x)[1] for x in one.rates)
    return instants.motion(*one.rates), q, qd


# -- closed loops: the motions that constraints leave ----------------------------------------------


def null_space(one: Linearised) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return N (S, n) and its first and second rate along the motion, see above.

    Columns are unit vectors of the independent coordinates, dependent ones follow. Without a loop
    N is the identity.
    """
    system = one.system
    _, moving, last = system.ends
    size = system.num_coordinates
    if system.loops is None:
        return np.eye(size), np.zeros((size, size)), np.zeros((size, size))
    every = np.concatenate([np.arange(moving), np.arange(last, size)])
    rates = _independent(*_constraint_rates(one))
    G, Gd, Gdd = np.zeros((3, len(rates[0]), size))
    G[:, :moving], Gd[:, :moving], Gdd[:, :moving] = rates
    dependent = _dependent(system, G)
    independent = np.setdiff1d(every, dependent)
    own = G[:, dependent]
    N, Nd, Ndd = np.zeros((3, size, len(independent)))
    N[independent, np.arange(len(independent))] = 1.0
    S = -np.linalg.solve(own, G[:, independent])
    Sd = -np.linalg.solve(own, Gd[:, independent] + Gd[:, dependent] @ S)
    left = Gdd[:, independent] + 2.0 * Gd[:, dependent] @ Sd + Gdd[:, dependent] @ S
    N[dependent], Nd[dependent], Ndd[dependent] = S, Sd, -np.linalg.solve(own, left)
    return N, Nd, Ndd


def _independent(G: np.ndarray, Gd: np.ndarray, Gdd: np.ndarray) -> list[np.ndarray]:
    """Return as many combinations of the constraints as are independent, and their rates."""
    scaled = G / np.abs(G).max(axis=0, initial=1e-300)
    rows = np.linalg.svd(scaled)[0][:, : rank(scaled)].T
    return [rows @ x for x in (G, Gd, Gdd)]


def _dependent(system: MachineSystem, G: np.ndarray) -> np.ndarray:
    """Return as many coordinates as G has rows that follow from the others."""
    # Joints without a drive first; loops that rigid arms would lock take elastic coordinates, too.
    joints = np.flatnonzero(~system.drives.driven)
    if len(joints) == len(G):
        return joints
    from scipy.linalg import qr

    elastic = np.arange(*system.ends[:2])
    left = np.linalg.qr(G[:, joints], mode="complete")[0][:, len(joints) :]
    order = qr(left.T @ G[:, elastic], mode="r", pivoting=True)[1]
    return np.concatenate([joints, elastic[order[: len(G) - len(joints)]]])


def _constraint_rates(one: Linearised) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return G = dg/dy (m, R + N) and its first and second rate along the motion."""
    # The first by the constraints' Hessian; the second by differences of the first along the
    # motion's own parabola, of fourth order.
    system, instants = one.system, one.system.at(one.t)
    motion = instants.motion(*one.rates)
    q, qd, qdd = (instants.split(x)[1] for x in one.rates)
    loops, columns = system.loops, system.columns
    assert loops is not None

    def at(h: float) -> tuple[np.ndarray, np.ndarray]:
        moved = replace(motion, q=motion.q + h * motion.qd + 0.5 * h * h * motion.qdd)
        speeds = np.hstack([motion.qd + h * motion.qdd, qd + h * qdd])
        here = loops.at(system.mechanism, moved.q, q + h * qd + 0.5 * h * h * qdd)
        turned = [here.hessian(unit[None])[0] @ speeds[0] for unit in np.eye(loops.count)]
        return here.jacobian[0][:, columns], np.array(turned)[:, columns]

    fastest = np.abs(np.hstack([motion.qd, qd])).max() + np.sqrt(np.abs(motion.qdd).max())
    h = LOOP_STEP_SHARE / max(float(fastest), 1e-3)
    (ahead, behind), (far, back) = ((at(s)[1], at(-s)[1]) for s in (h, 2.0 * h))
    second = (8.0 * (ahead - behind) - (far - back)) / (12.0 * h)
    return *at(0.0), second


# -- the poles of a machine without a loop, and their derivatives ----------------------------------


@dataclass(frozen=True, eq=False)
class Poles:
    """Solutions of (lambda^2 M + lambda D + K) v = 0 of a machine at one instant, P of them.

    Attributes:
        one: the machine.
        values: (P,) complex, 1/s, those above the real axis or on it.
        right, left: (S, P) v, and w with w^T (lambda^2 M + lambda D + K) = 0 and
            w^T (2 lambda M + D) v = 1.
    """

    one: Linearised
    values: np.ndarray
    right: np.ndarray
    left: np.ndarray

    def gradient(self, by_values: np.ndarray) -> tuple[np.ndarray, list[ShapeIntegrals]]:
        """Differentiate a real function of the poles.

        dlambda = -w^T (lambda^2 dM + lambda dD + dK) v: the derivative of w . r along the
        displacement v, its rate lambda v and acceleration lambda^2 v, by all that r depends on. It
        is taken by central differences along that direction of the residual's own derivatives.

        Args:
            by_values: (P,) complex, dJ = Re(sum by_values dlambda).

        Returns:
            By the system's coordinates and their rates (3, 1, S), and by every body's integrals.
        """
        # With no pole one of no weight: what follows has an instant at least.
        used = np.flatnonzero(by_values) if by_values.any() else np.zeros(1, dtype=int)
        S, system = len(self.right), self.one.system
        weights = -by_values[used] * self.left[:, used]  # (S, k)
        v, s = self.right[:, used], self.values[used]
        direction = np.stack([v, s * v, s * s * v])  # (3, S, k)
        along = np.concatenate([direction.real, direction.imag], axis=2)
        multipliers = np.concatenate([weights.real, -weights.imag], axis=1)
        size = self._size(along[0])
        steps = POLE_STEP / np.where(size > 0.0, size, 1.0)
        moved, rows = [], []
        for offset, share in POLE_STENCIL:
            moved.append(along * (offset * steps))
            rows.append(multipliers * (share / steps))
        change = np.concatenate(moved, axis=2).transpose(0, 2, 1)  # (3, n, S)
        rates = [x + dx for x, dx in zip(self.one.rates, change, strict=True)]
        every = np.concatenate(rows, axis=1).T.copy()
        instants = system.at(np.repeat(self.one.t, len(every)))
        tangent = instants.linearise(*rates)
        by_rates = np.stack([x.sum(axis=0) for x in tangent.transposed(every)])
        return by_rates.reshape(3, 1, S), system.body_gradient(
            instants, rates[0], rates[1], rates[2], every
        )

    def _size(self, displaced: np.ndarray) -> np.ndarray:
        """Return how far columns of displacements (S, k) move or turn frames, m or rad."""
        R, moving, _ = self.one.system.ends
        sizes = [np.abs(displaced[:R]).max(axis=0, initial=0.0)]
        mechanism = self.one.system.mechanism
        for body, part in zip(mechanism.bodies, mechanism.slices, strict=True):
            own = displaced[R:moving][part]
            sizes.append(np.abs(body.outboard @ own).max(axis=0, initial=0.0))
        sizes.append(np.abs(displaced[self.one.system.ends[2] :]).max(axis=0, initial=0.0))
        return np.max(sizes, axis=0)


def poles_of(one: Linearised) -> Poles:
    """Return the poles of a machine without a loop.

    Raises:
        InputError: a coordinate has no mass.
    """
    from scipy.linalg import eig

    assert one.system.loops is None
    n = len(one.M)
    # In the units of every coordinate's own mass the pencil is scaled well.
    scale = 1.0 / np.sqrt(np.abs(np.diag(one.M)) + np.finfo(float).tiny)
    K, D, M = (scale[:, None] * x * scale for x in (one.K, one.D, one.M))
    if np.linalg.cond(M) > 1e14:
        raise InputError(
            f"a coordinate has no mass, so that its poles are not determined; {GIVE_MASS}"
        )
    bottom = -np.linalg.solve(M, np.hstack([K, D]))
    A = np.vstack([np.eye(n, 2 * n, n), bottom])
    values, left, right = eig(A, left=True, right=True)
    above = np.flatnonzero(values.imag >= 0.0)
    values, v = values[above], right[:n, above]
    w = np.linalg.solve(M.T, np.conj(left[n:, above]))  # of (lambda^2 M + lambda D + K)^T
    norm = np.einsum("ip,ip->p", w, 2.0 * values * (M @ v) + D @ v)
    return Poles(one, values, scale[:, None] * v, scale[:, None] * w / norm)
