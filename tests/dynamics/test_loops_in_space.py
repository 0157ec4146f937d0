"""Machines in space with closed loops: references, balances, forces, gradients, ranks.

`reference/README.md` says what the tables are.
"""

from dataclasses import replace

import numpy as np
import pytest
from bodies import beam
from loops import (
    BOOM_TABLE,
    FOOT,
    HEAD,
    LUG,
    SOFT,
    boom,
    closed,
    double_four_bar,
    five_bar,
    flexible,
    flexible_slider_crank,
    free,
    hinge,
    spatial_slider_crank,
    started,
    weightless,
)
from machines import apart, gaps, imbalance, machine, reference
from mpi4py import MPI
from scipy.integrate import solve_ivp

import dolfinopt as do
from dolfinopt.dynamics import radau
from dolfinopt.dynamics.build import desired_motion, largest_stiffness_change
from dolfinopt.dynamics.known_forces import feed_forward
from dolfinopt.exchange.in_space import in_space
from dolfinopt.multibody.kinematics import Posed
from dolfinopt.multibody.shape_integrals import rigid_spatial_body
from dolfinopt.parallel import on_root

WORLD = MPI.COMM_WORLD
GRAVITY = 9.81  # m/s2
CONTROL = {"stiffness": [1e6, 1e8], "damping": [1e4, 1e5]}
SPRING = boom()["closures"][0] | {"stiffness": 1e7, "damping": 1e4}


def compliant_boom():
    """Return the boom with a bearing and a gear that give way, and friction."""
    tree = boom()
    slew, luff = tree["joints"]
    slew |= {"gear_stiffness": 1e5, "gear_damping": 50.0, "friction": [1.0, 0.5]}
    luff |= {"bearing_stiffness": [2e7, 2e7, 2e7, 1e5, 1e5, 0.0],
             "bearing_damping": [2e3, 2e3, 2e3, 10.0, 10.0, 0.0]}  # fmt: skip
    return tree


def free_motion(system, steps, t):
    """Return rigid coordinates and rates of rigid arms at t, and the largest gap at steps' ends."""
    grid = np.linspace(0.0, system.breakpoints[-1], steps + 1)
    solution = radau.on_grid(system, grid, 1e-8, 4)
    y, yd = solution.sample(t), solution.sample(t, 1)
    motion = system.at(t).state(y, yd, yd).motion
    z = solution.sample(grid)
    q = system.at(grid).state(z, z, z).motion.q
    assert system.loops is not None
    gap = system.loops.at(system.mechanism, q, np.zeros((len(q), 0))).gap
    return motion.q, motion.qd, float(np.abs(gap).max())


@pytest.mark.serial
def test_double_four_bar(tmp_path):
    """All bars turn as one pendulum does, through positions where the linkage is singular."""
    # Of Exudyn's table positions are off by its steps, 5e-7 m; here 500 steps leave 1e-7.
    tree, bodies = double_four_bar()
    table = f"t,joint0\n0,{0.5 * np.pi}\n1,1.5\n"
    system = started(free(tmp_path, tree, table, bodies), -1.0)
    assert system.loops is not None
    assert (system.loops.count, system.num_redundant) == (10, 6)
    expected = reference("double_four_bar")
    t = expected["t"]
    q, qd, gap = free_motion(system, 500, t)
    assert gap < 1e-12  # m; measured 4e-14
    # 3 m L2 / 3 + 2 m L2 of inertia, and gravity on 3 m L / 2 + 2 m L: 3.5 / 3 of g / L.

    def pendulum(_, z):
        return [z[1], -3.5 / 3.0 * GRAVITY * np.cos(z[0])]

    start = [0.5 * np.pi, -1.0]
    exact = solve_ivp(pendulum, (0, 10), start, "DOP853", t, rtol=1e-12, atol=1e-12).y
    assert np.abs(q[:, 0] - exact[0]).max() < 2e-7
    assert np.abs(qd[:, 0] - exact[1]).max() < 1e-6
    tip, rate = np.exp(1j * q[:, 0]), qd[:, 0]
    assert np.abs(tip - expected["tip_x"] - 1j * expected["tip_y"]).max() < 3e-6
    velocity = expected["tip_velocity_x"] + 1j * expected["tip_velocity_y"]
    assert np.abs(1j * rate * tip - velocity).max() < 2e-5
    energy = 1.5 * rate**2 + 3.5 * GRAVITY * tip.imag
    assert np.ptp(energy) < 1e-6  # J, of 36


@pytest.mark.serial
def test_spatial_slider_crank(tmp_path):
    """Ball, universal joint and slider: positions as Exudyn has them to its own error."""
    tree, bodies = spatial_slider_crank()
    system = started(free(tmp_path, tree, "t,turn\n0,0\n1,0.5\n", bodies), 6.0)
    expected = reference("spatial_slider_crank")
    q, qd, gap = free_motion(system, 400, expected["t"])
    assert gap < 1e-12  # m
    assert np.abs(q[:, 1] - expected["slider_position"]).max() < 5e-8  # m; measured 2e-8
    assert np.abs(qd[:, 1] - expected["slider_velocity"]).max() < 2e-5  # m/s; measured 1e-5
    assert np.abs(qd[:, 0] - expected["crank_rate"]).max() < 1.5e-3  # of 28 rad/s; measured 7e-4


@pytest.mark.slow
@pytest.mark.serial
def test_flexible_slider_crank(tmp_path):
    """Out of the plane, too: the rod is beside the crank, and bends and twists it."""
    expected = reference("flexible_slider_crank_in_space")
    trajectory, system = machine(do.Model(flexible_slider_crank(tmp_path)).simulate())
    assert system.loops is not None
    assert (system.loops.count, system.num_redundant) == (5, 3)
    assert np.allclose(trajectory.t, expected["t"])
    end = Posed(trajectory.mechanism, trajectory.q_r, trajectory.q_e).interface(0, 0)[0]
    assert apart(trajectory.q_r[:, 2], expected["piston_displacement"]) < 1e-4
    assert apart(trajectory.motion.qd[:, 0], expected["crank_rate"]) < 3e-4
    assert apart(end[2], expected["crank_end_z"]) < 1e-2  # of 1 um
    force = np.linalg.norm(trajectory.closure_force[:, :3], axis=1)
    parts = [expected[f"pin_force_{one}"] for one in ("on_rod_along", "across", "z")]
    assert apart(force, np.linalg.norm(parts, axis=0)) < 1e-2


@pytest.mark.serial
@pytest.mark.parametrize(
    ("tree", "table", "changes"),
    [
        (boom(), BOOM_TABLE, {"simulation": {"stiffening": True}}),
        (boom(), BOOM_TABLE, {"closures": [SPRING]}),
        (compliant_boom(), "t,slew,cylinder\n0,0,1.0\n0.4,0.2,1.1\n", {"control": CONTROL}),
        (five_bar(), "t,a,b\n0,2.0,1.1\n0.5,1.6,0.8\n",
         SOFT | {"motion": {"horizon": 0.5, "gravity": [0, -9.81, 2.0]},
                 "simulation": {"tolerance": 1e-2}}),
    ],
    ids=["stiffened", "spring", "compliant", "five-bar"],
)  # fmt: skip
def test_energy_and_gaps(tmp_path, tree, table, changes):
    result = do.Model(closed(tmp_path, table, tree, **changes)).simulate()
    assert imbalance(result) < 1e-8  # measured 3e-10 at most, with a tolerance of 1e-4
    # Pins give way out of the plane by 1e-6 of the softest arm; measured 2e-10, 3e-12 of others.
    assert np.abs(gaps(result)).max() < 1e-9  # m


@pytest.mark.serial
def test_forces_of_a_cylinder(tmp_path):
    """At rest by the lever of boom and load; the drive's force is that of the closure."""
    scene = closed(tmp_path, BOOM_TABLE, boom(), control=CONTROL)
    trajectory, system = machine(do.Model(scene).simulate())
    desired = trajectory.desired[:1]
    luff = desired.q[0, 1]
    head, foot = complex(HEAD[0], HEAD[2]), complex(FOOT[0], FOOT[2])
    lug = head + complex(*LUG[:2]) * np.exp(1j * luff)
    along = (lug - foot) / abs(lug - foot)
    lever = (np.conj(lug - head) * along).imag
    body = system.mechanism.bodies[1]
    centre = body.w[:2, 0] @ [1.0, 1j] / body.mass
    moment = body.mass * (centre * np.exp(1j * luff)).real + 100.0 * 2.0 * np.cos(luff)
    ahead = feed_forward(system, desired)[0][0]
    cylinder = list(scene.rigid_units).index("cylinder")
    assert ahead[list(system.drives.free).index(cylinder)] == pytest.approx(
        GRAVITY * moment / lever, rel=1e-10
    )
    # Multipliers are of lower order than what the law of the drive is made of: measured 1.3e-4.
    force = trajectory.closure_force[:, 0]
    assert force == pytest.approx(trajectory.joint_forces[:, cylinder], rel=4e-4)


@pytest.mark.serial
def test_a_spring_gives_way(tmp_path):
    """Of a cylinder with stiffness the oil's column is shorter by force over stiffness."""
    spring = SPRING | {"damping": 0.0}
    fine = {"tolerance": 1e-6}  # of positions: multipliers are of lower order
    scene = closed(tmp_path, BOOM_TABLE, boom(), closures=[spring], simulation=fine)
    trajectory, _ = machine(do.Model(scene).simulate())
    shorter = trajectory.desired.q[:, 2] - trajectory.q_r[:, 2]
    assert shorter == pytest.approx(trajectory.closure_force[:, 0] / 1e7, rel=1e-4)


@pytest.mark.skipif(WORLD.size == 1, reason="needs more than one rank")
def test_same_design_on_any_number_of_ranks(shared_tmp_path):
    scene = closed(shared_tmp_path, BOOM_TABLE, boom())
    together = do.optimize(scene)
    alone = on_root(WORLD, lambda: do.optimize(scene, world=MPI.COMM_SELF).x_phys)
    for k in together.x_phys:
        np.testing.assert_allclose(together.x_phys[k], alone[k], rtol=0, atol=1e-8)


@pytest.mark.serial
def test_stiffening_sees_the_forces_of_closures(tmp_path):
    """A weightless bar between a drive and a mass that only a pin holds to it: F / buckling load.

    That of a clamped column whose deflection is cubic, 4/3 (13 - 2 sqrt 31) E I / l^2 = 2.486
    instead of Euler's 2.467.
    """
    pin = {"name": "pull", "kind": "pin", "between": ["bar", "trailer"], "axis": [0, 0, 1]}
    slide = {"type": "prismatic", "parent": "ground", "axis": [1, 0, 0]}
    tree = {
        "name": "pulled bar",
        "arms": [weightless("driver"), flexible("bar", 0.5), weightless("trailer")],
        "joints": [
            {"name": "push", "child": "driver", **slide},
            hinge("swing", "driver", "bar", passive=True),
            {"name": "follow", "child": "trailer", "passive": True, **slide},
        ],
        "closures": [pin],
        "motion": {"initial_joints": [0.0, 0.0, 0.5]},
    }
    scene = closed(tmp_path, "t,push\n0,0\n1,0.4\n", tree)
    bending, length, mass = 15.0, 0.5, 3.0  # N m2, m, kg
    column = beam(length, 0.0, bending)
    u = (np.arange(240) + 0.5) / 240
    slopes = np.stack([(6.0 * u - 3.0 * u**2) / (2.0 * length), u])  # of its modes across
    plane = replace(
        column.body(), K=column.K[:2, :2], D=0.0 * column.K[:2, :2], w=np.zeros((2, 3)),
        W=np.zeros((2, 3, 3)), outboard=column.outboard[:, :2], K0=np.zeros((4, 2, 2)),
        K0_outboard=np.stack([slopes @ slopes.T * length / 240, *np.zeros((2, 2, 2))]),
    )  # fmt: skip
    none = np.zeros(3)
    bodies = [
        rigid_spatial_body(0.0, none, np.zeros(6)),
        in_space(plane),
        rigid_spatial_body(mass, none, np.zeros(6)),
    ]
    t = np.linspace(0.0, 1.0, 41)
    force = mass * np.abs(desired_motion(scene)(t).qdd[:, 0]).max()
    limit = 4.0 / 3.0 * (13.0 - 2.0 * np.sqrt(31.0)) * bending / length**2
    assert force > 1.0
    assert largest_stiffness_change(scene, bodies, t) == pytest.approx(force / limit, rel=1e-4)
