"""What loads the bodies of a machine that moves, and how much it stiffens or softens them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dolfinopt.multibody.closures import Loops
from dolfinopt.multibody.newton_euler import (
    NOTHING,
    Link,
    interface_coefficients,
    inverse_dynamics,
    inward_pass,
    outward_pass,
)
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import Rates, ShapeIntegrals
from dolfinopt.multibody.tree import Mechanism, Site

# -- what loads every body: its frame's acceleration, and from outboard ------------------------


def body_loads(
    mechanism: Mechanism,
    motion: RigidMotion,
    rates: Rates,
    pull: Mapping[Site, np.ndarray] = NOTHING,
) -> list[np.ndarray]:
    """Return what loads every body in the order of its K0 and K0_outboard (n, P).

    In the plane (a_x, a_y, wd, -w^2, F_x, F_y, T), in space (a, A_ab, force, moment). The moment is
    what works on the rotation vector of the interface. Of several interfaces force and moment of
    one stand behind those of the other.

    Args:
        mechanism, motion, rates: as for `inverse_dynamics`.
        pull: see `inward_pass`.
    """
    return [p for _, p in _loaded_links(mechanism, motion, rates, pull)]


def _loaded_links(
    mechanism: Mechanism, motion: RigidMotion, rates: Rates, pull: Mapping[Site, np.ndarray]
) -> list[tuple[Link, np.ndarray]]:
    links = outward_pass(mechanism, motion, rates, pull)
    result = []
    for link, loads in zip(links, inward_pass(mechanism, links, pull=pull).outboard, strict=True):
        pulls = interface_coefficients(link, loads) if link.body.is_flexible else loads
        p, order = link.body.load_coefficients(pulls), link.body.dim.loads
        result.append((link, np.concatenate([p[order], p[len(order) :]]).T))
    return result


def is_loaded_at_rest(mechanism: Mechanism, motion: RigidMotion) -> bool:
    """Return whether anything loads the bodies while they are not deformed."""
    rest = np.zeros((len(motion.q), mechanism.num_coordinates))
    return any(p.any() for p in body_loads(mechanism, motion, (rest, rest, rest)))


def load_coefficients(
    mechanism: Mechanism,
    motion: RigidMotion,
    rates: Rates,
    pull: Mapping[Site, np.ndarray] = NOTHING,
) -> list[np.ndarray]:
    """Return c (n, P + g q) of every body: what loads its nodes, as inertia acts.

    In the plane (n, 7 + 2 q), in space (n, 18 + 9 q); m/s2, 1/s2, N, N m and modes per s2.

    c = -(p, alpha_c z + beta_c z' + trace_c z''), p of `body_loads`, c before the modes, z being
    the displacement along them, see `body`. `pull` is that of `body_loads`.
    """
    result = []
    for link, p in _loaded_links(mechanism, motion, rates, pull):
        elastic = link.body.accelerations.reshape(-1, len(p))
        result.append(-np.hstack([p, elastic.T]))
    return result


# -- how much the loads of a motion stiffen or soften the arms, before anything is simulated -----


@dataclass(frozen=True)
class Stiffening:
    """Whether bodies have geometric stiffness, and why.

    Attributes:
        estimate: largest relative change of an arm's stiffness along the motion; None in space
            where the scene itself says whether it counts.
        on: whether it is taken into account.
    """

    estimate: float | None
    on: bool


def largest_change(
    mechanism: Mechanism,
    motion: RigidMotion,
    loops: Loops | None = None,
    dependent: np.ndarray | None = None,
) -> float:
    """Return the largest |eigenvalue| of K^-1 sum_p p K0_p over arms and instants.

    The loads p are those of the machine with rigid arms on the desired motion.

    Args:
        mechanism: bodies with geometric stiffness.
        motion: at n instants.
        loops: closures; or None.
        dependent: rigid coordinates that follow from them.
    """
    rigid, none = mechanism.rigid, np.zeros((len(motion.q), 0))
    pull: Mapping[Site, np.ndarray] = {}
    if loops is not None and dependent is not None:
        forces = inverse_dynamics(rigid, motion, none, none, none)[1]
        here = loops.at(rigid, motion.q, none)
        pull = here.interface_loads(here.closing(forces, dependent))
    loads = body_loads(rigid, motion, (none, none, none), pull)
    return max(map(stiffness_change, mechanism.bodies, loads), default=0.0)


def stiffness_change(body: ShapeIntegrals, p: np.ndarray) -> float:
    """Return the largest |eigenvalue| of K^-1 sum_p p K0_p of a body under loads p (n, loads)."""
    if body.num_modes == 0 or not body.is_stiffened:
        return 0.0
    inverse = np.linalg.inv(np.linalg.cholesky(body.K))
    K0 = inverse @ np.concatenate([body.K0, body.K0_outboard]) @ inverse.T
    values = np.linalg.eigvalsh(np.tensordot(p, K0, 1))
    return float(np.abs(values).max(initial=0.0))
