"""Elastic coordinates of a machine in space whose joints are prescribed, as a `System`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dolfinopt.dynamics.elastic_system import PrescribedSystem
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.spatial.body_gradient import body_gradient
from dolfinopt.multibody.spatial.inverse_dynamics import elastic_residual
from dolfinopt.multibody.spatial.mechanism import SpatialMechanism
from dolfinopt.multibody.spatial.motion import JointMotion
from dolfinopt.multibody.spatial.tangent import SpatialTangent, linearise


@dataclass(frozen=True, eq=False)
class SpatialInstants:
    """A spatial machine and its prescribed motion at n instants."""

    mechanism: SpatialMechanism
    motion: JointMotion

    def __len__(self) -> int:
        """Return n."""
        return len(self.motion.q)

    def __getitem__(self, part: slice | np.ndarray) -> SpatialInstants:
        """Return it at some of the instants."""
        return SpatialInstants(self.mechanism, self.motion[part])

    def residual(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> np.ndarray:
        """Return the elastic residual (n, N)."""
        return elastic_residual(self.mechanism, self.motion, q, qd, qdd)

    def linearise(
        self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray, keep: np.ndarray | None = None
    ) -> SpatialTangent:
        """Return its derivative by the coordinates `keep`, or all."""
        return linearise(self.mechanism, self.motion, q, qd, qdd, keep)


@dataclass(frozen=True)
class SpatialSystem(PrescribedSystem):
    """That of a tree of bodies in space."""

    mechanism: SpatialMechanism
    motion: Callable[[np.ndarray], JointMotion]

    def at(self, t: np.ndarray) -> SpatialInstants:
        """Return mechanism and motion at instants t (n,), s."""
        return SpatialInstants(self.mechanism, self.motion(t))

    def describe(self, q: np.ndarray) -> str:
        """Say how far the links' ends turn in a motion q (n, N)."""
        angle = float(interface_rotations(self.mechanism, q).max(initial=0.0))
        return f"the links' ends turn by {angle:.2g} rad"

    def body_gradient(
        self,
        t: np.ndarray,
        q: np.ndarray,
        qd: np.ndarray,
        qdd: np.ndarray,
        multipliers: np.ndarray,
    ) -> list[ShapeIntegrals]:
        """Return the derivative of sum_n multipliers_n . residual_n by every body's integrals."""
        return body_gradient(self.mechanism, self.motion(t), q, qd, qdd, multipliers)


def interface_rotations(mechanism: SpatialMechanism, q: np.ndarray) -> np.ndarray:
    """Return the largest rotation of every body's outboard interfaces (bodies,), rad."""
    found = []
    for part, body in zip(mechanism.slices, mechanism.bodies, strict=True):
        vectors = (q[:, part] @ body.outboard.T).reshape(-1, 6)[:, 3:]
        found.append(np.linalg.norm(vectors, axis=1).max(initial=0.0))
    return np.array(found)
