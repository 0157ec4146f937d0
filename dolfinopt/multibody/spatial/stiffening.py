"""How much the loads of a motion in space stiffen or soften the links, before it is simulated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dolfinopt.multibody.shape_integrals import rigid_part
from dolfinopt.multibody.spatial.body_loads import body_loads
from dolfinopt.multibody.spatial.inverse_dynamics import inward_pass, outward_pass
from dolfinopt.multibody.spatial.mechanism import SpatialMechanism
from dolfinopt.multibody.spatial.motion import JointMotion
from dolfinopt.multibody.stiffening import stiffness_change


def largest_change(mechanism: SpatialMechanism, motion: JointMotion) -> float:
    """Return the largest |eigenvalue| of K^-1 sum_p p K0_p over links and instants.

    The loads p are those of the machine with rigid links on the desired motion.

    Args:
        mechanism: bodies with geometric stiffness.
        motion: at n instants.
    """
    rigid = replace(mechanism, bodies=tuple(map(rigid_part, mechanism.bodies)))
    none = np.zeros((len(motion.q), 0))
    links = outward_pass(rigid, motion, (none, none, none))
    loads = body_loads(links, inward_pass(rigid, links).outboard)
    pairs = zip(mechanism.bodies, loads, strict=True)
    return max((stiffness_change(body, p) for body, p in pairs), default=0.0)
