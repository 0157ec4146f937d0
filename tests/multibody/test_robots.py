"""Robots, rigid and on bearings, against Pinocchio (Carpentier et al. 2019).

doi:10.1109/SII.2019.8700380.
"""

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
from dolfinopt.multibody.mechanism import bearing_body, with_bearings
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


@pytest.mark.parametrize("name", ["six axes", "scara"])
def test_bearings_are_joints_of_their_own(name):
    """Each bearing as three prismatic joints and a revolute one: forces on all of them."""
    rng = np.random.default_rng(3)
    model, indices = pin.Model(), []
    bodies, joints, bearings, movable = [], [], {}, 0
    own_rows, spring_rows = [], []  # Pinocchio's places of the robot's joints and of the bearings'
    for i, (kind, parent, axis, origin, rpy) in enumerate(ROBOTS[name]):
        mass, centre, inertia = uneven_box(rng)
        axis, R, turn = np.array(axis, dtype=float), roll_pitch_yaw(rpy), i % 3
        bodies.append(rigid_spatial_body(mass, centre, inertia))
        coordinate = None if kind == "fixed" else movable
        movable += kind != "fixed"
        joints.append(Joint(str(i), kind, parent, coordinate, axis, np.array(origin), R))
        stiffness = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
        stiffness[3 + turn] = 4.0
        bearings[i] = bearing_body(stiffness, 0.1 * stiffness, 3)
        last, place = 0 if parent == GROUND else indices[parent], pin.SE3(R, np.array(origin))
        unit = np.eye(3)
        for k in range(4):
            along = unit[k] if k < 3 else unit[turn]
            made = pin.JointModelPrismaticUnaligned if k < 3 else pin.JointModelRevoluteUnaligned
            last = model.addJoint(last, made(along), place, f"{i} {k}")
            spring_rows.append(model.joints[last].idx_v)
            place = pin.SE3.Identity()
        if kind != "fixed":
            made = pin.JointModelPrismaticUnaligned if kind == "prismatic" else (
                pin.JointModelRevoluteUnaligned
            )  # fmt: skip
            last = model.addJoint(last, made(axis), place, str(i))
            own_rows.append(model.joints[last].idx_v)
        indices.append(last)
        model.appendBodyToJoint(last, pin.Inertia(mass, centre, inertia_tensor(inertia)), place)
    model.gravity.linear = np.array([0.3, -0.2, -9.81])
    rigid = spatial_mechanism(bodies, joints, {}, (0.3, -0.2, -9.81), (len(bodies) - 1, 0))
    machine = with_bearings(rigid, bearings)
    rates = rng.normal(size=(3, 20, model.nv))
    own, springs = rates[..., own_rows], rates[..., spring_rows]
    rows, forces = inverse_dynamics(machine, RigidMotion(*own), *springs)
    inertia = rows - springs[0] @ machine.stiffness() - 0.1 * springs[1] @ machine.stiffness()
    data = model.createData()
    expected = np.array([pin.rnea(model, data, *row) for row in zip(*rates)])
    assert np.abs(forces - expected[:, own_rows]).max() < 1e-9
    assert np.abs(inertia - expected[:, spring_rows]).max() < 1e-9
