"""What loads every body of a spatial machine: its frame's acceleration, and from outboard."""

from __future__ import annotations

import numpy as np

from dolfinopt.multibody.inverse_dynamics import Rates
from dolfinopt.multibody.spatial.inverse_dynamics import Link, inward_pass, outward_pass
from dolfinopt.multibody.spatial.kinematics import Load
from dolfinopt.multibody.spatial.mechanism import SpatialMechanism
from dolfinopt.multibody.spatial.motion import JointMotion
from dolfinopt.multibody.spatial.rotations import ONE


def body_loads(links: list[Link], outboard: list[Load | None]) -> list[np.ndarray]:
    """Return p = (a, A_ab, force, moment) (n, 18) of every body.

    The moment is what works on the rotation vector of the interface.
    """
    found = []
    for link, load in zip(links, outboard, strict=True):
        count = len(link.body.a)
        pull = np.zeros((count, 6))
        if load is not None:
            assert link.interface is not None
            flexible = link.body.is_flexible
            pull = link.interface.conjugate(load) if flexible else np.hstack(load)
        found.append(np.hstack([link.body.a, link.body.A.reshape(count, 9), pull]))
    return found


def load_coefficients(
    mechanism: SpatialMechanism, motion: JointMotion, rates: Rates
) -> list[np.ndarray]:
    """Return c (n, 18 + 9 q) of every body: what loads its nodes, as inertia acts.

    c = -(a, A_ab, force, moment, A_ab q + 2 Omega_ab qd + delta_ab qdd), ab before the modes.
    """
    links = outward_pass(mechanism, motion, rates)
    found = []
    for link, p in zip(links, body_loads(links, inward_pass(mechanism, links).outboard)):
        q, qd, qdd = (x[:, None, None] for x in link.body.rates)
        A, Omega = link.body.A[..., None], link.body.Omega[..., None]
        elastic = A * q + 2.0 * Omega * qd + ONE[:, :, None] * qdd
        found.append(-np.hstack([p, elastic.reshape(len(p), -1)]))
    return found
