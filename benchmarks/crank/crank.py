"""The flexible slider-crank `crank.f` of the IVP test set, through bodies of its matrices.

A rigid crank turns with 150 rad/s, a rod with two sine modes and a quadratic axial element in the
frame of its chord drives a slider; no damping. Source: Simeon (1996),
doi:10.1080/13873959608837026; Mazzia & Magherini, Test Set for Initial Value Problem Solvers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.collocation import Solution
from dolfinopt.dynamics.drives import Drives
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.system import Preconditioner, State
from dolfinopt.multibody.body import Constants
from dolfinopt.multibody.closures import Along, Loops, Tie
from dolfinopt.multibody.kinematics import end_effector
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, rigid_bar, rigid_body
from dolfinopt.multibody.tree import Joint, Mechanism

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


def values(records: Path | None = None, steps: int = STEPS) -> dict[str, float]:
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
