"""The flexible slider-crank `crank.f` of the IVP test set, through bodies of its matrices.

Source: Simeon (1996), doi:10.1080/13873959608837026; Mazzia & Magherini, Test Set for Initial Value
Problem Solvers. A rigid crank turns with 150 rad/s, a rod with two sine modes and a quadratic axial
element in the frame of its chord drives a slider; no damping.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.collocation import Solution
from dolfinopt.dynamics.machine_system import MachineModes, MachineSystem
from dolfinopt.dynamics.system import State, Unchanged
from dolfinopt.multibody.closures import Loops
from dolfinopt.multibody.kinematics import end_effector
from dolfinopt.multibody.mechanism import Closure, Drives, plane_chain
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, plane_body, rigid_bar

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
    M, K, G = np.zeros((3, 4, 4))
    M[0, 0] = M[1, 1] = 0.5
    M[2:, 2:] = [[8.0, 1.0], [1.0, 2.0]]
    K[0, 0], K[1, 1] = np.array([1.0 / 24.0, 2.0 / 3.0]) * PI**4 * (HEIGHT / ROD) ** 2
    K[2:, 2:] = np.array([[16.0, -8.0], [-8.0, 7.0]]) / 3.0
    G[0, 2], G[0, 3], G[1, 3] = 16.0 / PI**3, 1.0 / PI - 8.0 / PI**3, -0.5 / PI
    return plane_body(
        mass=ROD_MASS,
        moment=np.array([0.5 * ROD_MASS * ROD, 0.0]),
        inertia=ROD_INERTIA,
        C=mass * np.array([[0.0, 0.0, 2.0 / 3.0, 1.0 / 6.0], [2.0 / PI, 0.0, 0.0, 0.0]]),
        j=mass * ROD * np.array([0.0, 0.0, 1.0 / 3.0, 1.0 / 6.0]),
        r=mass * ROD * np.array([1.0 / PI, -0.5 / PI, 0.0, 0.0]),
        M=mass * M,
        G=mass * (G - G.T),
        K=YOUNG * area / ROD * K,
        D=np.zeros((4, 4)),
        outboard=np.array([[0.0, 0.0, 0.0, 1.0], np.zeros(4), [-PI / ROD, 2.0 * PI / ROD, 0, 0]]),
        outboard_point=np.array([ROD, 0.0]),
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

    def preconditioner(self) -> MachineModes | Unchanged:
        """Return the rod's vibrations, the start in their coordinates."""
        modes = super().preconditioner()
        q, qd = (modes.to_modes(x) for x in self.start)
        assert isinstance(modes, MachineModes) and isinstance(modes.system, Crank)
        return replace(modes, system=replace(modes.system, start=(q, qd)))


def crank(body: ShapeIntegrals) -> Crank:
    """Return the machine with its "smooth" start; unknowns: the joint's deviation, q, mu."""
    q = np.array([0.0, 0.0, 1.03339863e-5, 1.69327969e-5])
    qd = np.array([0.444896105, 0.463434311e-2, -0.178591076e-5, -0.268938672e-5])
    slower = CRANK * SPEED * (1.0 / ROD - 1.0 / (ROD + q[3]))  # by the closure
    arms = rigid_bar(CRANK, HEIGHT, CRANK_MASS, CRANK_INERTIA - 0.25 * CRANK_MASS * CRANK**2), body
    none = np.zeros(1)
    drives = Drives(np.array([2]), none, none, np.full(1, np.inf), np.array([False]))
    loops = Loops.of_plane(Closure.slider(0j, 1.0 + 0j), (1, 0))
    return Crank(
        plane_chain(arms, SLIDER_MASS, 0.0, (0.0, 0.0), 0.0),
        desired,
        (0.0, END),
        drives,
        loops,
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


def values(steps: int = STEPS) -> dict[str, float]:
    """Return the motion at the end, SI units, and the largest bending with its instant."""
    system = crank(rod())
    solution = solved(system, steps, STAGES)
    y, yd, ydd = unknowns(system, solution)
    instants = system.at(np.array([END]))
    motion = instants.motion(y, yd, ydd)
    place = end_effector(system.mechanism, motion, y[:, 1:5])[0]
    t = np.linspace(0.0, END, 4001)
    bending = np.abs(solution.sample(t)[:, 1])
    return {
        "angle of the rod": float(motion.q[0, 1:].sum()),
        "slider": float(place[0]),
        **{f"q{k + 1}": float(y[0, 1 + k]) for k in range(4)},
        "force across the line": float(-ydd[0, 5]),
        "moment of the crank": float(-instants.forces(y, yd, ydd)[0, 1]),
        "largest bending": float(bending.max()),
        "its instant": float(t[bending.argmax()]),
    }
