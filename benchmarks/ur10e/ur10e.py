"""A UR10e: joint torques of one record predicted from the parameters that another gives.

Rigid links move as recorded; joint torques are linear in the 10 inertial parameters of each link,
the reflected inertia of each motor and three of friction (viscous, Coulomb, offset). Least squares
over one record gives them, and the torques of another one are predicted. Torques are motor currents
times drive gains. Source: Mamedov & Mikhel (2020), doi:10.3389/frobt.2020.571574, and the records
beside it; gains: Gaz, Magrini & De Luca (2018), doi:10.1016/j.mechatronics.2018.01.002.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.signal import butter, filtfilt

from dolfinopt.errors import InputError
from dolfinopt.exchange.urdf.file import read_robot
from dolfinopt.exchange.urdf.robot import scene_bodies
from dolfinopt.multibody.newton_euler import inverse_dynamics
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import rigid_spatial_body
from dolfinopt.multibody.tree import GROUND, Joint, Mechanism

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
            f"{file}: expected a record of t, six angles, speeds and currents in {last} rows"
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


def values(records: Path | None) -> dict[str, float]:
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
