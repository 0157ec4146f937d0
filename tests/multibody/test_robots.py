"""Rigid robots against Pinocchio (Carpentier et al. 2019, doi:10.1109/SII.2019.8700380)."""

from __future__ import annotations

import numpy as np
import pytest

from dolfinopt.multibody.inverse_dynamics import inverse_dynamics
from dolfinopt.multibody.machine import (
    GROUND,
    Joint,
    inertia_tensor,
    rigid_spatial_body,
    roll_pitch_yaw,
    spatial_mechanism,
)
from dolfinopt.multibody.motion import RigidMotion

pin = pytest.importorskip("pinocchio")
pytestmark = pytest.mark.serial
QUARTER = 0.5 * np.pi

# Per joint: kind, parent, axis, origin, rpy; the bodies are uneven boxes.
YAW_PITCH_PITCH = [
    ("revolute", GROUND, (0, 0, 1), (0, 0, 0), (0, 0, 0)),
    ("revolute", 0, (0, 0, 1), (0, 0, 0.1), (QUARTER, 0, 0)),
    ("revolute", 1, (0, 0, 1), (0.5, 0, 0), (0, 0, 0)),
]
SIX_AXES = [
    ("revolute", GROUND, (0, 0, 1), (0, 0, 0.4), (0, 0, 0)),
    ("revolute", 0, (0, 1, 0), (0.1, 0, 0.05), (0, 0.3, 0)),
    ("revolute", 1, (0, -1, 0), (0, 0, 0.6), (0, 0, 0.2)),
    ("revolute", 2, (1, 0, 0), (0.2, 0, 0.1), (0.1, 0, 0)),
    ("revolute", 3, (0, 1, 0), (0.5, 0, 0), (0, 0, 0)),
    ("revolute", 4, (0.6, 0, 0.8), (0.1, 0, 0), (0.3, -0.2, 0.1)),
]
SCARA_WITH_CAMERA = [  # the camera's arm branches off the first link
    ("revolute", GROUND, (0, 0, 1), (0, 0, 0.3), (0, 0, 0)),
    ("revolute", 0, (0, 0, 1), (0.3, 0, 0), (0, 0, 0)),
    ("prismatic", 1, (0, 0, -1), (0.25, 0, 0), (0, 0, 0)),
    ("revolute", 2, (0, 0, 1), (0, 0, -0.1), (0, 0, 0)),
    ("revolute", 0, (0, 1, 0), (0.1, 0, 0.1), (0.2, 0, 0)),
    ("fixed", 4, (1, 0, 0), (0, 0, 0.1), (0, 0.5, 0)),
]
ROBOTS = {"yaw-pitch-pitch": YAW_PITCH_PITCH, "six axes": SIX_AXES, "scara": SCARA_WITH_CAMERA}


def uneven_box(rng):
    """Return mass, centre and inertia (6,) of a body that may be."""
    points, masses = rng.normal(scale=0.1, size=(6, 3)), rng.uniform(0.1, 1.0, size=6)
    centre = masses @ points / masses.sum()
    r = points - centre
    tensor = np.einsum("n,nab->ab", masses, (r**2).sum(1)[:, None, None] * np.eye(3)) - (
        np.einsum("n,na,nb->ab", masses, r, r)
    )
    six = [tensor[i] for i in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    return float(masses.sum()), centre, np.array(six)


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_rigid_robot(name):
    rng = np.random.default_rng(2)
    model, indices = pin.Model(), []
    bodies, joints, movable = [], [], 0
    for i, (kind, parent, axis, origin, rpy) in enumerate(ROBOTS[name]):
        mass, centre, inertia = uneven_box(rng)
        axis, R = np.array(axis, dtype=float), roll_pitch_yaw(rpy)
        bodies.append(rigid_spatial_body(mass, centre, inertia))
        coordinate = None if kind == "fixed" else movable
        movable += kind != "fixed"
        joints.append(Joint(str(i), kind, parent, coordinate, axis, np.array(origin), R))
        place = pin.SE3(R, np.array(origin))
        own = pin.Inertia(mass, centre, inertia_tensor(inertia))
        above = 0 if parent == GROUND else indices[parent]
        if kind == "fixed":
            model.appendBodyToJoint(above, own, place)
            indices.append(above)
            continue
        made = pin.JointModelPrismaticUnaligned if kind == "prismatic" else (
            pin.JointModelRevoluteUnaligned
        )  # fmt: skip
        indices.append(model.addJoint(above, made(axis), place, str(i)))
        model.appendBodyToJoint(indices[-1], own, pin.SE3.Identity())
    model.gravity.linear = np.array([0.3, -0.2, -9.81])
    machine = spatial_mechanism(bodies, joints, {}, (0.3, -0.2, -9.81), (len(bodies) - 1, 0))
    q, qd, qdd = rng.normal(size=(3, 20, movable))
    none = np.zeros((20, 0))
    found = inverse_dynamics(machine, RigidMotion(q, qd, qdd), none, none, none)[1]
    data = model.createData()
    expected = np.array([pin.rnea(model, data, *row) for row in zip(q, qd, qdd)])
    assert np.abs(found - expected).max() < 1e-10
