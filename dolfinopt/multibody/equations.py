"""The equations of a machine as a table of functions: those of the plane, and in space the same.

What simulates, differentiates and judges a machine knows nothing else of its mechanism, so it is
written once. The table in space is `multibody.spatial.equations.SPACE`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dolfinopt.multibody.end_effector import (
    deviation,
    end_effector,
    end_effector_gradient,
    interface_place,
)
from dolfinopt.multibody.inverse_dynamics import (
    body_loads,
    elastic_residual,
    inverse_dynamics,
    largest_change,
    load_coefficients,
)
from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.tangent import body_gradient, linearise


@dataclass(frozen=True)
class Equations:
    """Functions of a mechanism; d is 2 in the plane, 3 in space.

    Attributes:
        residual: (mechanism, motion, q, qd, qdd): elastic residual (n, N).
        forces: the same: elastic residual, and forces (n, R) of all rigid coordinates.
        linearise: (mechanism, motion, q, qd, qdd, keep, rigid): a `Linearisation` of both.
        body_gradient: (mechanism, motion, q, qd, qdd, multipliers, of_forces): derivative by every
            body's integrals.
        load_coefficients: (mechanism, motion, (q, qd, qdd)): what loads every body.
        is_loaded_at_rest: (mechanism, motion): whether anything may load undeformed bodies.
        end_effector: (mechanism, motion, q): its place (n, d), m.
        deviation: the same: flexible minus rigid place (n, d), m.
        end_effector_gradient: (mechanism, motion, q, weights, rigid): by the elastic coordinates,
            by the rigid ones if `rigid` is true, by every body.
        rotations: (mechanism, q): largest rotation of every body's interfaces (bodies,), rad.
        softness: (bodies): largest static deflection of a body by a unit force across it, m/N.
        levers: (mechanism): deflection of the end by unit rigid coordinates (R,), m.
        largest_change: (mechanism, motion, closure): largest relative change of a body's stiffness
            by the loads of the motion with rigid bodies.
    """

    residual: Callable[..., np.ndarray]
    forces: Callable[..., tuple[np.ndarray, np.ndarray]]
    linearise: Callable[..., Any]
    body_gradient: Callable[..., list[ShapeIntegrals]]
    load_coefficients: Callable[..., list[np.ndarray]]
    is_loaded_at_rest: Callable[..., bool]
    end_effector: Callable[..., np.ndarray]
    deviation: Callable[..., np.ndarray]
    end_effector_gradient: Callable[
        ..., tuple[np.ndarray, np.ndarray | None, list[dict[str, np.ndarray]]]
    ]
    rotations: Callable[..., np.ndarray]
    softness: Callable[[Sequence[ShapeIntegrals]], float]
    levers: Callable[..., np.ndarray]
    largest_change: Callable[..., float]


def _is_loaded_at_rest(mechanism: Mechanism, motion: RigidMotion) -> bool:
    rest = np.zeros((len(motion.q), mechanism.num_coordinates))
    return any(p.any() for p, _ in body_loads(mechanism, motion, (rest, rest, rest)))


def _end_effector_gradient(
    mechanism: Mechanism, motion: RigidMotion, q: np.ndarray, weights: np.ndarray, rigid: bool
) -> tuple[np.ndarray, np.ndarray | None, list[dict[str, np.ndarray]]]:
    by_q, by_bodies = end_effector_gradient(mechanism, motion, q, weights)
    if not rigid:
        return by_q, None, by_bodies
    jacobian = interface_place(mechanism, motion, q).jacobian[:, : motion.q.shape[1]]
    w = weights[:, 0] - 1j * weights[:, 1]
    return by_q, (w[:, None] * jacobian).real, by_bodies


def _rotations(mechanism: Mechanism, q: np.ndarray) -> np.ndarray:
    parts = zip(mechanism.slices, mechanism.bodies, strict=True)
    found = [np.abs(q[:, part] @ body.outboard[2]).max(initial=0.0) for part, body in parts]
    return np.array(found)


def _softness(bodies: Sequence[ShapeIntegrals]) -> float:
    """Return that of the arms' ends, m/N."""
    # Or a third of the arm's length squared times the end's rotation by a unit moment, which is the
    # same of a cantilever, and not zero of an arm whose frame is its chord.
    found = [0.0]
    for body in bodies:
        if body.num_modes:
            soft = body.outboard @ np.linalg.solve(body.K, body.outboard.T)
            square = float(body.outboard_point @ body.outboard_point)
            found += [float(soft[1, 1]), float(soft[2, 2]) * square / 3.0]
    return max(found)


def _levers(mechanism: Mechanism) -> np.ndarray:
    reach = sum(float(np.hypot(*body.outboard_point)) for body in mechanism.bodies)
    return np.array([1.0, *[reach] * len(mechanism.bodies)])


PLANE = Equations(
    residual=elastic_residual,
    forces=inverse_dynamics,
    linearise=linearise,
    body_gradient=body_gradient,
    load_coefficients=load_coefficients,
    is_loaded_at_rest=_is_loaded_at_rest,
    end_effector=end_effector,
    deviation=deviation,
    end_effector_gradient=_end_effector_gradient,
    rotations=_rotations,
    softness=_softness,
    levers=_levers,
    largest_change=largest_change,
)
