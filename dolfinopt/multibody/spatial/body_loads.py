"""What loads every body of a spatial machine: its frame's acceleration, and from outboard."""

from __future__ import annotations

import numpy as np

from dolfinopt.multibody.modal_displacement import Rates
from dolfinopt.multibody.spatial.inverse_dynamics import Link, inward_pass, outward_pass
from dolfinopt.multibody.spatial.kinematics import Load
from dolfinopt.multibody.spatial.mechanism import SpatialMechanism
from dolfinopt.multibody.spatial.motion import JointMotion
from dolfinopt.multibody.spatial.rotations import ONE


def body_loads(links: list[Link], outboard: list[dict[int, Load]]) -> list[np.ndarray]:
    """Return p = (a, A_ab, force, moment) (n, 18) of every body.

    The moment is what works on the rotation vector of the interface. Of several interfaces force
    and moment of one stand behind those of the other.
    """
    found = []
    for link, loads in zip(links, outboard, strict=True):
        count = len(link.body.a)
        pull = np.zeros((count, len(link.body.constants.B)))
        for s, load in loads.items():
            flexible, interface = link.body.is_flexible, link.interfaces[s]
            own = interface.conjugate(load) if flexible else np.hstack(load)
            pull[:, interface.rows_of] = own
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
