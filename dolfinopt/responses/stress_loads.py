"""Along a motion: the coefficients of every arm's static fields, whose sum is its displacement.

u = V (q - K_r^-1 P c) + Z c, see `fem.stress`. In a scenario with another material, stiffness times
k, mass times m and Young's modulus times e, what belongs to the arm's own inertia is m / k times as
large, what comes from outboard 1 / k times, and stress e times that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.dynamics.adjoint import add_gradients
from dolfinopt.dynamics.load_coefficients import load_counts, load_gradient
from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.multibody.shape_integrals import SPACE, STIFFENING, ShapeIntegrals
from dolfinopt.responses.response import by_owner
from dolfinopt.responses.scenarios import cotangents_of_scene, factors
from dolfinopt.scene.load import Scene


@dataclass(frozen=True, eq=False)
class ArmLoads:
    """What loads one arm of the chain along one motion.

    Attributes:
        place: of the arm in the chain.
        motion: number among `motions_of`.
        coefficients: (n, q + 7 + 2 q) of `LoadFields.columns`.
    """

    place: int
    motion: int
    coefficients: np.ndarray


def motions_of(trajectory: Trajectory) -> tuple[Trajectory, ...]:
    """Return what a limit holds for: the scenarios, or the motion where there are none."""
    return trajectory.scenarios or (trajectory,)


def arm_loads(scene: Scene, motions: Sequence[Trajectory]) -> dict[int, list[ArmLoads]]:
    """Return the loads of every arm with a design, by the index of the arm that owns it."""
    found: dict[int, list[ArmLoads]] = {owner: [] for owner in scene.cell_counts}
    for number, motion in enumerate(motions):
        for place, owner in enumerate(scene.owners):
            if owner is not None:
                found[owner].append(ArmLoads(place, number, _coefficients(scene, motion, place)))
    return found


def load_matrix(body: ShapeIntegrals) -> np.ndarray:
    """Return P = V' L (q, 7 + 2 q), in space (q, 18 + 9 q): every load's part in the modes."""
    if len(body.W) == len(SPACE):
        q, (of_X, of_modes) = body.num_modes, (body.W[:, 1:, 0], body.W[:, 1:, 1:])
        elastic = of_modes.swapaxes(0, 1).reshape(q, -1)
        return np.hstack([body.C.T, of_X.T, body.outboard.T, elastic])
    columns = [body.C.T, body.r[:, None], body.j[:, None], body.outboard.T, body.M, body.G]
    return np.hstack(columns)


def loads_gradient(
    scene: Scene, motion: Trajectory, by_arm: Mapping[int, tuple[np.ndarray, np.ndarray]]
) -> dict[int, ShapeIntegrals]:
    """Differentiate a function of one motion's `ArmLoads.coefficients` by all designs' bodies.

    Args:
        scene: nominal, whose bodies the derivatives are by.
        motion: of it, or of one of its scenarios.
        by_arm: by place in the chain, instants (k,) and derivatives (k, q + 7 + 2 q) there.

    Returns:
        By the index of the arm that owns the design.
    """
    mechanism, problem = motion.mechanism, motion.problem
    instants = np.unique(np.concatenate([where for where, _ in by_arm.values()]))
    by_q = np.zeros((len(instants), mechanism.num_coordinates))
    by_c, own = [], []
    for place, (part, body) in enumerate(zip(mechanism.slices, mechanism.bodies, strict=True)):
        by_loads = np.zeros((len(instants), load_counts(body).total))
        by_P, by_K = np.zeros((body.num_modes, by_loads.shape[1])), np.zeros_like(body.K)
        if place in by_arm:
            where, by = by_arm[place]
            rows, q = np.searchsorted(instants, where), body.num_modes
            by = by * _scale(scene, motion.scene, place, body)
            c, P = motion.load_coefficients[place][where], load_matrix(body)
            z = -np.linalg.solve(body.K, by[:, :q].T)
            by_q[rows, part] = by[:, :q]
            by_loads[rows] = by[:, q:] + z.T @ P
            by_P, by_K = z @ c, -z @ np.linalg.solve(body.K, P @ c.T).T
        by_c.append(by_loads)
        own.append(_integrals(body, by_P, by_K))
    t = motion.t[instants]
    rates = (motion.unknowns[0][instants], motion.unknowns[1][instants])
    through = load_gradient(problem, t, (*rates, motion.unknowns[2][instants]), by_c)
    through.by_rates[0] += motion.by_unknowns(by_q)
    followed = motion.adjoint.gradient(t, through.by_rates)
    total = add_gradients(add_gradients(followed, through.by_bodies), own)
    if motion.scene is not scene:
        total = [
            cotangents_of_scene(by, factors(scene, motion.scene, index), 1.0)
            for index, by in enumerate(total)
        ]
    return by_owner(scene, total)


def _coefficients(scene: Scene, motion: Trajectory, place: int) -> np.ndarray:
    mechanism = motion.mechanism
    body, c = mechanism.bodies[place], motion.load_coefficients[place]
    modal = motion.q_e[:, mechanism.slices[place]]
    modal = modal - np.linalg.solve(body.K, load_matrix(body) @ c.T).T
    return np.hstack([modal, c]) * _scale(scene, motion.scene, place, body)


def _scale(scene: Scene, other: Scene, place: int, body: ShapeIntegrals) -> np.ndarray:
    """Return what an arm's columns are multiplied by in another scene (q + 7 + 2 q,)."""
    counts, q = load_counts(body), body.num_modes
    scale = np.ones(q + counts.total)
    if other is scene:
        return scale
    owner = scene.owners[place]
    assert owner is not None
    f = factors(scene, other, owner)
    scale[q:] = f.mass / f.stiffness
    outboard = q + counts.frame
    scale[outboard : outboard + counts.outboard] = 1.0 / f.stiffness
    young = other.material_of(owner).young_modulus / scene.material_of(owner).young_modulus
    return young * scale


def _integrals(body: ShapeIntegrals, by_P: np.ndarray, by_K: np.ndarray) -> ShapeIntegrals:
    """Return the derivatives by a body from those by P and K."""
    q = body.num_modes
    w, W = np.zeros_like(body.w), np.zeros_like(body.W)
    if len(W) == len(SPACE):
        b = len(body.outboard)
        outboard = by_P[:, 12 : 12 + b].T
        w[:, 1:], W[:, 1:, 0] = by_P[:, :3].T, by_P[:, 3:12].T
        W[:, 1:, 1:] = by_P[:, 12 + b :].reshape(q, 9, q).swapaxes(0, 1)
    else:
        outboard = by_P[:, 4:7].T
        w[:, 1:] = by_P[:, :2].T
        W[1, 1:, 0], W[0, 0, 1:] = by_P[:, 2], by_P[:, 3]
        W[0, 1:, 1:], W[1, 1:, 1:] = by_P[:, 7 : 7 + q], by_P[:, 7 + q :]
    zero = {
        key: np.zeros_like(getattr(body, key))
        for key in ("D", "outboard_point", "further_points", *STIFFENING)
    }
    return replace(body, mass=0.0, w=w, W=W, K=by_K, outboard=outboard, **zero)
