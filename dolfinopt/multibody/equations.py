"""What of a machine differs between plane and space, as a table of functions: the plane's.

Inverse dynamics and its derivatives are one code, see `dimension`; here is where the end-effector
is, and what sizes are compared by. The table in space is `multibody.spatial.equations.SPACE`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from dolfinopt.multibody.end_effector import (
    deviation,
    end_effector,
    end_effector_gradient,
    interface_place,
)
from dolfinopt.multibody.inverse_dynamics import largest_change
from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals


@dataclass(frozen=True)
class Equations:
    """Functions of a mechanism; d is 2 in the plane, 3 in space.

    Attributes:
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

    end_effector: Callable[..., np.ndarray]
    deviation: Callable[..., np.ndarray]
    end_effector_gradient: Callable[
        ..., tuple[np.ndarray, np.ndarray | None, list[dict[str, np.ndarray]]]
    ]
    rotations: Callable[..., np.ndarray]
    softness: Callable[[Sequence[ShapeIntegrals]], float]
    levers: Callable[..., np.ndarray]
    largest_change: Callable[..., float]


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
    end_effector=end_effector,
    deviation=deviation,
    end_effector_gradient=_end_effector_gradient,
    rotations=_rotations,
    softness=_softness,
    levers=_levers,
    largest_change=largest_change,
)
