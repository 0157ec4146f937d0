"""Robots, rigid and on bearings, against Pinocchio (Carpentier et al. 2019).

doi:10.1109/SII.2019.8700380.
"""

import numpy as np
import pytest
from bodies import spatial_mechanism

from dolfinopt.multibody.newton_euler import inverse_dynamics
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.rotations import roll_pitch_yaw
from dolfinopt.multibody.shape_integrals import inertia_tensor, rigid_spatial_body
from dolfinopt.multibody.tree import GROUND, Joint, bearing_body, with_bearings

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


@pytest.mark.parametrize("soft", [False, True], ids=["rigid", "on bearings"])
@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_forces_of_robots(name, soft):
    """Each bearing as three prismatic joints and a revolute one: forces on all of them."""
    rng, gravity = np.random.default_rng(3), (0.3, -0.2, -9.81)
    model, indices = pin.Model(), []
    bodies, joints, bearings, movable = [], [], {}, 0
    own_rows, spring_rows = [], []  # Pinocchio's places of the robot's joints and of the bearings'

    def joint(kind, axis, above, place, rows):
        made = pin.JointModelRevoluteUnaligned
        if kind == "prismatic":
            made = pin.JointModelPrismaticUnaligned
        index = model.addJoint(above, made(np.array(axis, dtype=float)), place, str(model.njoints))
        rows.append(model.joints[index].idx_v)
        return index, pin.SE3.Identity()

    for i, (kind, parent, axis, origin, rpy) in enumerate(ROBOTS[name]):
        mass, centre, inertia = uneven_box(rng)
        R, turn, origin = roll_pitch_yaw(rpy), i % 3, np.array(origin)
        bodies.append(rigid_spatial_body(mass, centre, inertia))
        coordinate = None if kind == "fixed" else movable
        movable += kind != "fixed"
        axis = np.array(axis, dtype=float)
        joints.append(Joint(str(i), kind, parent, coordinate, axis, origin, R))
        last, place = 0 if parent == GROUND else indices[parent], pin.SE3(R, origin)
        if soft:
            stiffness = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
            stiffness[3 + turn] = 4.0
            bearings[i] = bearing_body(stiffness, 0.1 * stiffness, 3)
            for along in np.eye(3):
                last, place = joint("prismatic", along, last, place, spring_rows)
            last, place = joint("revolute", np.eye(3)[turn], last, place, spring_rows)
        if kind != "fixed":
            last, place = joint(kind, axis, last, place, own_rows)
        indices.append(last)
        model.appendBodyToJoint(last, pin.Inertia(mass, centre, inertia_tensor(inertia)), place)
    model.gravity.linear = np.array(gravity)
    machine = spatial_mechanism(bodies, joints, {}, gravity, (len(bodies) - 1, 0))
    if soft:
        machine = with_bearings(machine, bearings)
    rates = rng.normal(size=(3, 20, model.nv))
    own, springs = rates[..., own_rows], rates[..., np.array(spring_rows, dtype=int)]
    rows, forces = inverse_dynamics(machine, RigidMotion(*own), *springs)
    inertia = rows - springs[0] @ machine.stiffness() - 0.1 * springs[1] @ machine.stiffness()
    data = model.createData()
    expected = np.array([pin.rnea(model, data, *row) for row in zip(*rates)])
    assert np.abs(forces - expected[:, own_rows]).max() < 1e-9
    assert np.abs(inertia - expected[:, np.array(spring_rows, dtype=int)]).max(initial=0.0) < 1e-9
