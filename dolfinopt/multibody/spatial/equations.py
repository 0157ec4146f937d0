"""The equations of machines in space, see `multibody.equations`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dolfinopt.multibody.equations import Equations
from dolfinopt.multibody.inverse_dynamics import body_loads, stiffness_change
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, rigid_part
from dolfinopt.multibody.spatial.end_effector import deviation, end_effector, end_effector_gradient
from dolfinopt.multibody.spatial.mechanism import SpatialMechanism


def _end_effector_gradient(
    mechanism: SpatialMechanism,
    motion: RigidMotion,
    q: np.ndarray,
    weights: np.ndarray,
    rigid: bool,
) -> tuple[np.ndarray, np.ndarray | None, list[dict[str, np.ndarray]]]:
    return end_effector_gradient(mechanism, motion, q, weights)


def _rotations(mechanism: SpatialMechanism, q: np.ndarray) -> np.ndarray:
    found = []
    for part, body in zip(mechanism.slices, mechanism.bodies, strict=True):
        vectors = (q[:, part] @ body.outboard.T).reshape(-1, 6)[:, 3:]
        found.append(np.linalg.norm(vectors, axis=1).max(initial=0.0))
    return np.array(found)


def _softness(bodies: Sequence[ShapeIntegrals]) -> float:
    found = [0.0]
    for body in bodies:
        if body.num_modes:
            for B in body.outboard.reshape(-1, 6, body.num_modes)[:, :3]:
                soft = B @ np.linalg.solve(body.K, B.T)
                found.append(float(np.linalg.eigvalsh(0.5 * (soft + soft.T))[-1]))
    return max(found)


def _levers(mechanism: SpatialMechanism) -> np.ndarray:
    bodies, joints = mechanism.bodies, mechanism.joints
    reach = sum(float(np.linalg.norm(one.points, axis=1).max()) for one in bodies)
    reach += sum(float(np.linalg.norm(one.origin)) for one in joints)
    slides = [joints[i].kind == "prismatic" for i in mechanism.tree.movable]
    return np.where(slides, 1.0, reach)


def _largest_change(mechanism: SpatialMechanism, motion: RigidMotion, closure: None) -> float:
    rigid = replace(mechanism, bodies=tuple(map(rigid_part, mechanism.bodies)))
    none = np.zeros((len(motion.q), 0))
    loads = body_loads(rigid, motion, (none, none, none))
    pairs = zip(mechanism.bodies, loads, strict=True)
    return max((stiffness_change(body, p) for body, p in pairs), default=0.0)


SPACE = Equations(
    end_effector=end_effector,
    deviation=deviation,
    end_effector_gradient=_end_effector_gradient,
    rotations=_rotations,
    softness=_softness,
    levers=_levers,
    largest_change=_largest_change,
)
