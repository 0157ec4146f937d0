"""Machines of the field's benchmark that no scene holds: the slider-crank, and a measured UR10e."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.signal import butter, filtfilt

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.collocation import Solution
from dolfinopt.dynamics.drives import Drives
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.system import Preconditioner, State
from dolfinopt.errors import InputError
from dolfinopt.exchange.urdf.file import read_robot
from dolfinopt.exchange.urdf.robot import scene_bodies
from dolfinopt.multibody.body import Constants
from dolfinopt.multibody.closures import Along, Loops, Tie
from dolfinopt.multibody.kinematics import end_effector
from dolfinopt.multibody.newton_euler import inverse_dynamics
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import (
    ShapeIntegrals,
    rigid_bar,
    rigid_body,
    rigid_spatial_body,
)
from dolfinopt.multibody.tree import GROUND, Joint, Mechanism

# -- the flexible slider-crank `crank.f` of the IVP test set, through bodies of its matrices
#
# Source: Simeon (1996), doi:10.1080/13873959608837026; Mazzia & Magherini, Test Set for Initial
# Value Problem Solvers. A rigid crank turns with 150 rad/s, a rod with two sine modes and a
# quadratic axial element in the frame of its chord drives a slider; no damping.

CRANK, ROD = 0.15, 0.30  # m
CRANK_MASS, ROD_MASS, SLIDER_MASS = 0.36, 0.151104, 0.075552  # kg
CRANK_INERTIA, ROD_INERTIA = 0.002727, 0.0045339259  # about their first joints, kg m2
YOUNG, HEIGHT, DENSITY = 2e11, 0.008, 7870.0  # Pa, m, kg/m3
SPEED, END = 150.0, 0.1  # rad/s, s
PI = np.pi

STEPS, STAGES = 3200, 5  # fewer leave axial vibrations of the undamped rod in the multipliers


def rod() -> ShapeIntegrals:
    """Return the rod; its axial mass is the file's, which is 15 times that of the element."""
    area, mass = HEIGHT**2, DENSITY * HEIGHT**2 * ROD
    M, K, G, none = np.zeros((4, 4, 4))
    M[0, 0] = M[1, 1] = 0.5
    M[2:, 2:] = [[8.0, 1.0], [1.0, 2.0]]
    K[0, 0], K[1, 1] = np.array([1.0 / 24.0, 2.0 / 3.0]) * PI**4 * (HEIGHT / ROD) ** 2
    K[2:, 2:] = np.array([[16.0, -8.0], [-8.0, 7.0]]) / 3.0
    G[0, 2], G[0, 3], G[1, 3] = 16.0 / PI**3, 1.0 / PI - 8.0 / PI**3, -0.5 / PI
    C = mass * np.array([[0.0, 0.0, 2.0 / 3.0, 1.0 / 6.0], [2.0 / PI, 0.0, 0.0, 0.0]])
    j = mass * ROD * np.array([[0.0, 0.0, 1.0 / 3.0, 1.0 / 6.0]])
    r = mass * ROD * np.array([[1.0 / PI, -0.5 / PI, 0.0, 0.0]])
    second = np.block([[np.full((1, 1), ROD_INERTIA), j], [j.T, mass * M]])
    turning = np.block([[np.zeros((1, 1)), 0.0 - r], [r.T, mass * (G - G.T)]])
    return ShapeIntegrals(
        mass=ROD_MASS,
        w=np.column_stack([[0.5 * ROD_MASS * ROD, 0.0], C]),
        W=np.array([second, turning]),
        K=YOUNG * area / ROD * K,
        D=none,
        outboard=np.array([[0.0, 0.0, 0.0, 1.0], np.zeros(4), [-PI / ROD, 2.0 * PI / ROD, 0, 0]]),
        outboard_point=np.array([ROD, 0.0]),
        K0=np.zeros((0, 4, 4)),
        K0_outboard=np.zeros((0, 4, 4)),
        further_points=np.zeros((0, 2)),
    )


def desired(t: np.ndarray) -> RigidMotion:
    """Return crank and rigid rod (n, 3): cart, angle of the crank, angle between both."""
    angle, zero = SPEED * t, np.zeros_like(t)
    sine = -CRANK / ROD * np.sin(angle)
    cosine = np.sqrt(1.0 - sine**2)
    rate = -CRANK * SPEED * np.cos(angle) / (ROD * cosine)
    growth = (CRANK * SPEED**2 * np.sin(angle) + ROD * sine * rate**2) / (ROD * cosine)
    return RigidMotion(
        np.stack([zero, angle, np.arcsin(sine) - angle], axis=1),
        np.stack([zero, zero + SPEED, rate - SPEED], axis=1),
        np.stack([zero, zero, growth], axis=1),
    )


@dataclass(frozen=True, eq=False)
class Crank(MachineSystem):
    """A machine that begins with a given motion."""

    start: State = (np.zeros(0), np.zeros(0))

    def initial_state(self) -> State:
        """Return it."""
        return self.start

    def preconditioner(self) -> Preconditioner:
        """Return the rod's vibrations, the start in their coordinates."""
        modes = super().preconditioner()
        q, qd = (modes.to_modes(x) for x in self.start)
        return replace(modes, system=replace(modes.system, start=(q, qd)))


def crank(body: ShapeIntegrals) -> Crank:
    """Return the machine with its "smooth" start; unknowns: the joint's deviation, q, mu."""
    q = np.array([0.0, 0.0, 1.03339863e-5, 1.69327969e-5])
    qd = np.array([0.444896105, 0.463434311e-2, -0.178591076e-5, -0.268938672e-5])
    slower = CRANK * SPEED * (1.0 / ROD - 1.0 / (ROD + q[3]))  # by the closure
    arms = rigid_bar(CRANK, HEIGHT, CRANK_MASS, CRANK_INERTIA - 0.25 * CRANK_MASS * CRANK**2), body
    none = np.zeros(1)
    drives = Drives(np.array([2]), none, none, np.full(1, np.inf), np.array([False]))
    across = np.array([[0.0, 1.0]])
    loops = Loops((Tie("slider", (1, 0), None, np.zeros(2), np.eye(2), tuple(map(Along, across))),))
    flat = np.ones(1), np.zeros(2), np.eye(2)
    mechanism = Mechanism(
        bodies=arms,
        joints=tuple(Joint(f"joint {k}", "revolute", k - 1, k + 1, *flat) for k in range(2)),
        loads={(1, 0): Constants(rigid_body(SLIDER_MASS, np.zeros(2), 0.0, np.zeros(2)))},
        gravity=np.zeros((2, 1)),
        end=(1, 0),
        origin=np.zeros(2),
        cart=0.0,
    )
    return Crank(
        mechanism,
        desired,
        (0.0, END),
        drives,
        loops,
        start=(np.array([[0.0, *q, 0.0]]), np.array([[slower, *qd, 0.0]])),
    )


def solved(system: Crank, steps: int, stages: int) -> Solution:
    """Return the motion on equal steps."""
    return radau.on_grid(system, np.linspace(0.0, END, steps + 1), 1e-8, stages)


def unknowns(system: Crank, solution: Solution) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return them and their derivatives at the end, each (1, 6)."""
    y, yd, ydd = (solution.sample(np.array([END]), k) for k in range(3))
    return y, yd, ydd


def crank_values(steps: int = STEPS) -> dict[str, float]:
    """Return the motion at the end, SI units, and the largest bending with its instant."""
    system = crank(rod())
    solution = solved(system, steps, STAGES)
    y, yd, ydd = unknowns(system, solution)
    state = system.at(np.array([END])).state(y, yd, ydd)
    motion = state.motion
    place = end_effector(system.mechanism, motion, y[:, 1:5])[0]
    bending = np.abs(solution.sample(np.linspace(0.0, END, 4001))[:, 1])
    return {
        "angle of the rod": float(motion.q[0, 1:].sum()),
        "slider": float(place[0]),
        **{f"q{k + 1}": float(y[0, 1 + k]) for k in range(4)},
        "force across the line": float(-ydd[0, 5]),
        "moment of the crank": float(-state.forces()[0, 1]),
        "largest bending": float(bending.max()),
    }


# -- a UR10e: joint torques of one record predicted from the parameters that another gives
#
# Rigid links move as recorded; joint torques are linear in the 10 inertial parameters of each link,
# the reflected inertia of each motor and three of friction (viscous, Coulomb, offset). Least
# squares over one record gives them, and the torques of another one are predicted. Torques are
# motor currents times drive gains. Source: Mamedov & Mikhel (2020),
# doi:10.3389/frobt.2020.571574, and the records beside it; gains: Gaz, Magrini & De Luca (2018),
# doi:10.1016/j.mechatronics.2018.01.002.

UR10E = "URe/urdf/ur10e.urdf"
# Rows, from 1, of the records that are used: in the others the robot stands still.
LEARNT = ("dataset_ur10e/identification_data/ur-20_02_10-30sec_12harm.csv", 635, 3510)
PREDICTED = ("dataset_ur10e/validation_data/ur-20_01_17-ptp_10_points.csv", 700, 4200)
GAINS = np.array([14.87, 13.26, 11.13, 10.62, 11.03, 11.47])  # N m/A
ORDER, CUTOFF = 5, 0.15  # Butterworth's, of speeds and accelerations; over half the sampling rate
CURRENT_CUTOFF = 0.2  # of the currents from which parameters are found
GRAVITY = (0.0, 0.0, -9.81)  # m/s2
COLUMNS = 19  # t, then six angles, speeds and currents
TINY = 1e-10  # singular values, over the largest, of parameters that have no effect


def read_record(file: Path, first: int, last: int) -> tuple[RigidMotion, np.ndarray, np.ndarray]:
    """Return motion of the joints and torques (n, 6), N m, measured and filtered, of some rows.

    Speeds are filtered, accelerations their differences. InputError: there is no such file, or it
    is another one.
    """
    try:
        table = np.loadtxt(file, delimiter=",", skiprows=first - 1, max_rows=last - first + 1)
    except (OSError, ValueError):
        table = np.empty(0)
    if table.ndim != 2 or len(table) != last - first + 1 or table.shape[1] < COLUMNS:
        raise InputError(
            f"--records: {file}: expected a record of t, six angles, speeds and currents in "
            f"{last} rows"
        )
    t, q, qd, current = np.split(table[:, :COLUMNS], [1, 7, 13], axis=1)

    def smooth(values: np.ndarray, cutoff: float) -> np.ndarray:
        return np.asarray(filtfilt(*butter(ORDER, cutoff), values, axis=0))

    qd, qdd = smooth(qd, CUTOFF), np.zeros_like(q)
    qdd[1:-1] = (qd[2:] - qd[:-2]) / (t[2:] - t[:-2])
    motion = RigidMotion(q, qd, smooth(qdd, CUTOFF))
    return motion, GAINS * current, GAINS * smooth(current, CURRENT_CUTOFF)


def machine(file: Path) -> Mechanism:
    """Return the robot of a URDF file, all links rigid."""
    robot = read_robot(file)
    found = scene_bodies(robot, (), robot.movable[-1].child)
    links = [body.link for body in found]
    moving = [body.link for body in found if body.joint.moves]
    joints = [
        Joint(
            body.joint.name,
            "revolute" if body.joint.moves else "fixed",
            links.index(body.parent) if body.parent in links else GROUND,
            moving.index(body.link) if body.joint.moves else None,
            body.axis / np.linalg.norm(body.axis),
            body.pose[:3, 3],
            body.pose[:3, :3],
        )
        for body in found
    ]
    bodies = [rigid_spatial_body(1.0, np.zeros(3), np.zeros(6)) for _ in found]
    down, end = np.array(GRAVITY)[:, None], (len(found) - 1, 0)
    return Mechanism(tuple(bodies), tuple(joints), {}, down, end, np.zeros(3))


def regressor(mechanism: Mechanism, motion: RigidMotion) -> np.ndarray:
    """Return the torques (n, joints, parameters) of unit parameters, those of the friction last.

    Of every link the mass, its first (3) and its second moments (6) about the frame's origin.
    """
    n, count = motion.q.shape
    none, columns = np.zeros((n, 0)), []
    pairs = np.array([(a, b) for a in range(3) for b in range(a, 3)])
    empty = [replace(one, mass=0.0, w=0 * one.w, W=0 * one.W) for one in mechanism.bodies]
    for k, link in enumerate(empty):
        second = np.zeros((6, 3, 3))
        second[range(6), pairs[:, 0], pairs[:, 1]] = second[range(6), pairs[:, 1], pairs[:, 0]] = 1
        units = [replace(link, mass=1.0)]
        units += [replace(link, w=w[:, None]) for w in np.eye(3)]
        units += [replace(link, W=W.reshape(9, 1, 1)) for W in second]
        for unit in units:
            changed = replace(mechanism, bodies=(*empty[:k], unit, *empty[k + 1 :]))
            columns.append(inverse_dynamics(changed, motion, none, none, none)[1])
    for by in (motion.qdd, motion.qd, np.sign(motion.qd), np.ones((n, count))):
        columns += [by * one for one in np.eye(count)]
    return np.stack(columns, axis=2)


def ur10e_values(records: Path | None) -> dict[str, float]:
    """Return the share of each joint's torque that is not predicted, |measured - predicted|.

    Over |measured|, of the record `PREDICTED` with the parameters of the record `LEARNT`; `records`
    is a checkout of the repository with both and the robot. InputError: a file of it is missing.
    """
    assert records is not None
    mechanism = machine(records / UR10E)
    learnt, tested = (read_record(records / file, *rows) for file, *rows in (LEARNT, PREDICTED))
    rows = regressor(mechanism, learnt[0])
    count = rows.shape[2]
    found = np.linalg.lstsq(rows.reshape(-1, count), learnt[2].ravel(), rcond=TINY)[0]
    off = tested[1] - regressor(mechanism, tested[0]) @ found
    shares = np.linalg.norm(off, axis=0) / np.linalg.norm(tested[1], axis=0)
    return {f"joint {k}": float(one) for k, one in enumerate(shares, start=1)}
