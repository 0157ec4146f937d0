"""Derivatives of what drives prescribed joints in space, see `drive_forces`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dolfinopt.multibody.inverse_dynamics import Rates
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.spatial.body_gradient import body_gradient
from dolfinopt.multibody.spatial.mechanism import SpatialMechanism
from dolfinopt.multibody.spatial.motion import JointMotion
from dolfinopt.multibody.spatial.tangent import SpatialTangent, linearise


@dataclass(frozen=True, eq=False)
class SpatialForces:
    """Forces of inverse dynamics along a given motion; q, qd, qdd (n, N) are elastic."""

    mechanism: SpatialMechanism
    motion: JointMotion
    rates: Rates

    @cached_property
    def tangent(self) -> SpatialTangent:
        """By joints and elastic coordinates."""
        every = np.arange(self.mechanism.num_joints)
        return linearise(self.mechanism, self.motion, *self.rates, None, every)

    def gradient(self, weights: np.ndarray) -> tuple[np.ndarray, list[ShapeIntegrals]]:
        """Return the derivative of sum_n weights_n . forces_n, see `DriveForces.gradient`."""
        none = np.zeros_like(self.rates[0])
        rows = np.concatenate([weights, none], axis=1)
        by_rates = np.stack(self.tangent.transposed(rows))[:, :, weights.shape[1] :]
        return by_rates, body_gradient(self.mechanism, self.motion, *self.rates, none, weights)
