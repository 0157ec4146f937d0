"""Machines: control, slider-crank, four-bar; their references, and balances."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from runs import ROOT, TWO_ARM, by_root, scene

import dolfinopt as do
from dolfinopt.dynamics.build import Trajectory
from dolfinopt.dynamics.collocation import Solution
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.system import relative_error
from dolfinopt.model import SimulationResult
from dolfinopt.multibody.dimension import product
from dolfinopt.multibody.kinematics import Posed
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.tangent import linearise
from dolfinopt.scene.load import Scene, scene_from_dict

Tree = dict[str, Any]
REFERENCE = Path(__file__).parents[2] / "benchmarks" / "reference"
GAINS = {"stiffness": [2e5, 2e4, 2e4], "damping": [2e4, 600.0, 600.0]}


def controlled(*changes: str) -> Scene:
    """Return the two-arm machine under feedback control, with "key.path=value" changed."""
    quick = ["arms.cells=[16,2]", "simulation.sample=0.01", "simulation.tolerance=1e-3"]
    gains = [f"control.{key}={value}" for key, value in GAINS.items()]
    return do.load_scene(TWO_ARM, [*quick, *gains, *changes])


CRANK = {"name": "crank", "rigid": True, "length": 0.15, "height": 0.02, "thickness": 0.01,
         "mass": 0.0, "inertia": 0.0}  # fmt: skip
ROD = {"name": "rod", "length": 0.3, "height": 0.012, "thickness": 0.01, "cells": [16, 2],
       "passive": 0.0}  # fmt: skip
LOOP: Tree = {
    "name": "slider-crank",
    "material": {"young_modulus": 210e9, "poisson_ratio": 0.3, "density": 7850.0},
    "interpolation": {"law": "two-material", "penalty": 3.0, "floor": 1e-3},
    "arms": [CRANK, ROD],
    "motion": {"path": "rotation", "base": "fixed", "joint_height": 0.0, "speed": 60.0,
               "duration": 0.05, "horizon": 0.1},
    "closure": {"kind": "slider"},
    "payload": {"mass": 0.5},
    "damping": {"stiffness_proportional": 2e-5},
    "reduction": {"coordinates": 4},
    "simulation": {"sample": 1e-3, "tolerance": 1e-3},
    "objective": {"kind": "integral_compliance", "gradient": "exact"},
    "design": {"initial": 0.5, "filter_radius": 0.0},
    "optimizer": {"max_iterations": 2},
}  # fmt: skip
FOUR_BAR: Tree = LOOP | {
    "name": "four-bar",
    "arms": [CRANK | {"length": 0.1}, ROD | {"name": "coupler", "length": 0.28},
             ROD | {"name": "rocker", "length": 0.25}],
    "closure": {"kind": "pin", "point": [0.25, 0.0], "side": -1},
    "payload": {"mass": 0.0},
}  # fmt: skip


def with_keys(tree: Tree, changes: Mapping[str, Any]) -> Tree:
    """Return a scene with other keys; those of a table beside what it has."""
    new = copy.deepcopy(tree)
    for key, value in changes.items():
        new[key] = {**(new.get(key) or {}), **value} if isinstance(value, Mapping) else value
    return new


def loop_tree(kind: str = "slider", **tables: Any) -> Tree:
    """Return the slider-crank's ("slider") or the four-bar's ("pin") scene, tables changed."""
    return with_keys(LOOP if kind == "slider" else FOUR_BAR, tables)


def loop(kind: str = "slider", **tables: Any) -> Scene:
    """Return the scene of `loop_tree`."""
    return scene_from_dict(loop_tree(kind, **tables))


# -- machines of benchmarks/reference -------------------------------------------------------------


def reference(name: str) -> dict[str, np.ndarray]:
    """Return the columns of a table of `benchmarks/reference` by name, without units."""
    file = REFERENCE / f"{name}.csv"
    with file.open(encoding="ascii") as lines:
        names = [column.split("[")[0].strip() for column in next(lines).split(",")]
    return dict(zip(names, np.loadtxt(file, delimiter=",", skiprows=1).T, strict=True))


def two_arm(*overrides: str, **changes: Any) -> Tree:
    """Return the two-arm scene with keys changed, then tables."""
    return with_keys(scene(*overrides).to_tree(), changes)


def held_link(
    folder: Path, link: Tree, gravity: list[float], changes: Sequence[str] = (), **tables: Any
) -> Scene:
    """Return one link of 1 m without weight that a joint holds, in space if its cells are."""
    (folder / "table.csv").write_text("t,link\n0,0\n1,0.001\n")  # a static start
    tree: Tree = {
        "name": "link",
        "material": {"young_modulus": 70e9, "poisson_ratio": 0.3, "density": 1e-3},
        "arms": [{"name": "link", "length": 1.0} | link],
        "motion": {"path": "joints", "file": "table.csv", "horizon": 1.0, "gravity": gravity},
        "simulation": {"sample": 0.01},
    }
    if len(gravity) == 2:
        tree["motion"] |= {"base": "fixed"}
    else:
        tree["joints"] = [{"name": "link", "type": "revolute", "parent": "ground",
                           "child": "link", "axis": [0, 0, 1]}]  # fmt: skip
    return do.scene_from_dict(with_keys(tree, tables), str(folder / "scene.toml"), changes)


def small_two_arm(joints: Tree | None = None, **changes: Any) -> Tree:
    """Return the controlled machine on few cells, its arms with keys of their joints."""
    cells = ("arms.cells=[16,3]", "reduction.coordinates=3", "motion.horizon=1.9")
    tree = two_arm(*cells, control=GAINS, simulation={"stiffening": True, "tolerance": 1e-5})
    for arm in tree["arms"]:
        arm |= joints or {}
    return with_keys(tree, changes)


def slider_crank(height: float, cells: tuple[int, int] = (60, 4), **changes: Any) -> Tree:
    """Return the slider-crank of the reference: steel rod of `height`, m, 2 turns in 0.1 s."""
    tree = with_keys(LOOP, {
        "motion": {"speed": 150.0},
        "closure": {"side": 1},
        "reduction": {"coordinates": 8},
        "simulation": {"stiffening": True, "sample": 2e-4, "tolerance": 1e-4},
        "design": {"volume_fraction": 1.0, "initial": 1.0},
        "objective": {"kind": "integral_compliance"},
    })  # fmt: skip
    tree["arms"][1] |= {"height": height, "cells": list(cells)}
    return with_keys(tree, changes)


def four_bar(cells: tuple[int, int] = (60, 4), **changes: Any) -> Tree:
    """Return the four-bar of `benchmarks/reference`, of aluminium."""
    tree = slider_crank(0.010, cells)
    crank, bar = tree["arms"]
    tree["material"] = {"young_modulus": 70e9, "poisson_ratio": 0.33, "density": 2700.0}
    tree["arms"] = [
        dict(crank, length=0.1),
        dict(bar, name="coupler", length=0.28, joint_mass=0.05),
        dict(bar, name="rocker", length=0.25, joint_mass=0.0),  # not the arm's before
    ]
    tree["motion"] |= {"speed": 100.0, "duration": 0.08, "horizon": 0.2}
    tree["simulation"] |= {"sample": 4e-4}
    tree["closure"], tree["payload"] = FOUR_BAR["closure"], {"mass": 0.0}
    return with_keys(tree, changes)


def simulated(tree: Tree) -> SimulationResult:
    """Return the simulation of a scene's initial design."""
    return do.Model(scene_from_dict(tree)).simulate()


def trajectory_of(one: Scene) -> Trajectory:
    """Return what a scene's initial design does."""
    found = do.Model(one).simulate().trajectory
    assert found is not None
    return found


def machine(result: SimulationResult) -> tuple[Trajectory, MachineSystem]:
    """Return the trajectory of a simulated machine every `simulation.sample`, and its system."""
    assert result.trajectory is not None
    return result.trajectory.sampled, result.trajectory.problem


def mid_deflection(result: SimulationResult, arm: int) -> np.ndarray:
    """Return an arm's deflection halfway (n,), m: left normal of the chord between its joints."""
    trajectory, _ = machine(result)
    mechanism = trajectory.mechanism
    view = result.views[[one.name for one in result.views].index(result.scene.arms[arm].name)]
    corners, modes = view.corners.reshape(-1, 2), view.modes.reshape(-1, 2, view.modes.shape[-1])
    middle = 0.5 * mechanism.bodies[arm].outboard_point
    node = int(np.argmin(np.hypot(*(corners - middle).T)))
    assert np.allclose(corners[node], middle)
    q = trajectory.q_e[:, mechanism.slices[arm]]
    place = complex(*middle) + q @ (modes[node, 0] + 1j * modes[node, 1])
    x, y = Posed(mechanism, trajectory.q_r, trajectory.q_e).section(arm, 0).place
    chord = x + 1j * y
    return (np.conj(chord / np.abs(chord)) * place).imag


def distance(problem: Any, one: Solution, other: Solution, count: int = 1000) -> float:
    """Return the relative distance of two solutions in the norm of `tolerance`, largest in time."""
    t = np.linspace(0.0, problem.breakpoints[-1], count + 1)
    q = other.sample(t)
    return relative_error(problem.mechanism, one.sample(t) - q, q)


def apart(found: np.ndarray, expected: np.ndarray) -> float:
    """Return the largest difference over time, of the largest value expected."""
    return float(np.abs(found - expected).max() / np.abs(expected).max())


def imbalance(result: SimulationResult) -> float:
    """Return how much of the drives' work is not energy, of the largest energy that is stored."""
    trajectory = result.trajectory
    assert trajectory is not None
    grid = trajectory.solution.time_grid
    nodes, weights = np.polynomial.legendre.leggauss(6)
    h = np.diff(grid)[:, None]
    t = grid[:-1, None] + 0.5 * h * (nodes + 1.0)
    power = _power(trajectory, t.ravel())
    work = np.cumsum((0.5 * h * weights * power.reshape(t.shape)).sum(axis=1))
    stored = sum(energies(trajectory, grid))
    return float(np.abs(work - (stored[1:] - stored[0])).max() / np.abs(stored).max())


def check_energy(result: SimulationResult, most: float) -> None:
    """Assert that the drives' work is energy, each kind of which counts."""
    trajectory = result.trajectory
    assert trajectory is not None
    parts = [np.ptp(one) for one in energies(trajectory, trajectory.t)]
    assert min(parts) > 1e-4 * max(parts)
    assert imbalance(result) < most


def states(
    trajectory: Trajectory, t: np.ndarray
) -> tuple[RigidMotion, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return rigid motion, elastic coordinates with derivatives, and the drives' forces at t."""
    state = trajectory.at(t).state
    return state.motion, *state.elastic, state.forces()


def _power(trajectory: Trajectory, t: np.ndarray) -> np.ndarray:
    """Return the drives' power less what dampers and friction take (n,), W."""
    mechanism = trajectory.mechanism
    motion, _, qd, _, forces = states(trajectory, t)
    speeds, parts = motion.qd.copy(), drive_trains(trajectory, t)
    speeds[:, parts.columns] = parts.speeds
    power = (forces * speeds).sum(axis=1) - parts.dissipated
    for part, body in zip(mechanism.slices, mechanism.bodies, strict=True):
        power -= np.einsum("ni,ij,nj->n", qd[:, part], body.D, qd[:, part])
    if mechanism.friction is not None:
        power -= (mechanism.friction.force(motion.qd) * motion.qd).sum(axis=1)
    return power


@dataclass(frozen=True, eq=False)
class DriveTrains:
    """Gears and motors: rigid coordinates, motors' speeds (n, M), power lost and energy (n,)."""

    columns: np.ndarray
    speeds: np.ndarray
    dissipated: np.ndarray
    strain: np.ndarray


def drive_trains(trajectory: Trajectory, t: np.ndarray) -> DriveTrains:
    """Return what gears and motors do: under control by themselves, or on the desired motion."""
    system, state = trajectory.problem, trajectory.at(t).state
    drives, springs, (y, yd, _) = system.drives, system.drives.springs, state.rates
    if len(springs.joints):  # under control
        own, k, c, friction = springs.joints, springs.stiffness, springs.damping, springs.friction
        speeds = state.motor_rates[0]
        twist, rate = (x[:, own] - x[:, system.motor_columns] for x in (y, yd))
    else:
        own = np.flatnonzero(drives.driven & (drives.stiffness > 0.0))
        if trajectory.scene.control is not None:
            own = own[:0]
        k, c = drives.stiffness[own], drives.damping[own]
        friction = None if drives.friction is None else drives.friction.of(own)
        speeds = state.instants.desired.qd[:, drives.free[own]]
        twist, rate = y[:, own], yd[:, own]
    lost = rate**2 @ c
    if friction is not None:
        lost = lost + (friction.force(speeds) * speeds).sum(axis=1)
    return DriveTrains(drives.free[own], speeds, lost, 0.5 * twist**2 @ k)


def energies(trajectory: Trajectory, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return kinetic energy by the mass matrix, strain energy, gravity's potential, (n,) J."""
    motion, q, qd, qdd, _ = states(trajectory, t)
    mechanism = trajectory.mechanism
    rigid = np.arange(mechanism.num_rigid + len(mechanism.motor_joints))
    tangent = linearise(mechanism, motion, q, qd, qdd, None, rigid).dense()
    size = tangent.shape[1]
    motors = [] if motion.motors is None else [motion.motors[0]]
    speeds = np.concatenate([motion.qd, *motors, qd], axis=1)
    kinetic = 0.5 * np.einsum("ni,nij,nj->n", speeds, tangent[:, :, 2 * size :], speeds)
    strain, moment = np.zeros(len(t)), np.zeros((mechanism.dim.d, len(t)))  # first of all masses
    posed, d = Posed(mechanism, motion.q, q), mechanism.dim.d
    for k, (part, body) in enumerate(zip(mechanism.slices, mechanism.bodies, strict=True)):
        e = q[:, part]
        strain += 0.5 * np.einsum("ni,ij,nj->n", e, body.K, e)
        own = body.w[:, :1] + body.w[:, 1:] @ e.T
        if body.is_stiffened:
            own = own - 0.5 * np.einsum("ni,pij,nj->pn", e, body.K0[:d], e)
        _, place, R = posed.body(k)
        moment += body.mass * place + product(R, own)
    for site, load in mechanism.loads.items():
        place, R = posed.interface(*site)
        moment += load.mass * place + product(R, load.c)
    potential = -(mechanism.gravity * moment).sum(axis=0)
    parts = drive_trains(trajectory, t)
    return kinetic, strain + parts.strain, potential


def plane_frames(
    mechanism: Any, q_r: np.ndarray, q: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return origins of a plane chain's frames, its end last, and rotations, (n,) complex."""
    posed, bodies = Posed(mechanism, q_r, q), range(len(mechanism.bodies))
    places = [posed.body(k)[1] for k in bodies] + [posed.interface(*mechanism.end)[0]]
    turns = [posed.body(k)[2] for k in bodies]
    return [x + 1j * y for x, y in places], [R[0, 0] + 1j * R[1, 0] for R in turns]


def gaps(result: SimulationResult) -> np.ndarray:
    """Return the violation of a loop's constraints at all stages (n, m), m."""
    trajectory, _ = machine(result)
    grid, nodes = trajectory.solution.time_grid, trajectory.solution.nodes
    t = (grid[:-1, None] + np.diff(grid)[:, None] * nodes).ravel()
    closed = trajectory.at(t).state.closed
    assert closed is not None
    return closed.gap


def fork() -> dict:
    """Return a link that carries a rigid hand on its end, a slide and the payload on its side."""
    turned = [0.0, 0.0, 0.5 * np.pi]
    rigid = {"rigid": True, "length": 0.2, "inertia": [0.01, 0.02, 0.02, 0, 0, 0]}
    side = {"name": "side", "point": [0.29, 0.02, 0.0], "radius": 0.01}
    return {
        "material": {"young_modulus": 70e9, "poisson_ratio": 0.33, "density": 2700.0},
        "arms": [
            {"name": "link", "length": 0.5, "height": 0.04, "thickness": 0.02, "cells": [6, 2, 2],
             "passive": 0.05, "interfaces": [side]},
            {"name": "hand", "mass": 1.0, **rigid},
            {"name": "slider", "mass": 0.5, **rigid},
        ],
        "joints": [
            {"name": "swing", "type": "revolute", "parent": "ground", "child": "link",
             "axis": [0.2, 0.1, 1]},
            {"name": "wrist", "type": "fixed", "parent": "link", "child": "hand", "rpy": turned},
            {"name": "slide", "type": "prismatic", "parent": "link", "child": "slider",
             "parent_interface": "side", "axis": [1, 0, 0], "rpy": turned},
        ],
        "motion": {"path": "joints", "file": "table.csv", "horizon": 0.2, "gravity": [0, 0, -9.81]},
        "payload": {"mass": 1.0, "offset": [0, 0.05, 0], "arm": "link", "interface": "side"},
        "damping": {"stiffness_proportional": 1e-4},
        "reduction": {"coordinates": 12},
        "simulation": {"sample": 0.005, "tolerance": 1e-3, "stiffening": True},
        "design": {"volume_fraction": 0.6},  # solid cells are half of it
        "objective": {"load_cases": 6},
    }  # fmt: skip


def demo_machine(name: str, changes: Sequence[str], folder: Path, *, one_arm: bool) -> Scene:
    """Return a demo with keys changed, or one arm alone; without a name the fork (collective)."""
    told = [change.replace("FOLDER", str(folder)) for change in changes]
    if not name:
        by_root(lambda: (folder / "table.csv").write_text("t,swing,slide\n0,0,0\n0.2,1,0.1\n"))
        return scene_from_dict(fork(), str(folder / "fork.toml"), told)
    path = ROOT / "demos" / f"{name}.toml"
    if not one_arm:
        return do.load_scene(path, told)
    tree = do.load_scene(path).to_tree()
    return scene_from_dict(tree | {"arms": tree["arms"][:1]}, str(path), told)
