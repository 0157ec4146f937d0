"""Machines in space with closed loops: small scenes, and rigid ones whose motion is free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from machines import with_keys
from runs import by_root

from dolfinopt.dynamics.build import build_system
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.rotations import roll_pitch_yaw
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, rigid_spatial_body
from dolfinopt.scene.load import Scene, scene_from_dict

Tree = dict[str, Any]
UP = [0, 0, 1]
QUARTER = 0.5 * np.pi
STEEL = {"young_modulus": 2.1e11, "poisson_ratio": 0.3, "density": 7850.0}
SECTION = {"height": 0.01, "thickness": 0.01}  # m
SOFT: Tree = {  # tables of designs that bend well, and of their gradients
    "interpolation": {"law": "two-material", "penalty": 3.0, "floor": 1e-3},
    "objective": {"kind": "integral_compliance", "gradient": "exact", "load_cases": 6},
    "reduction": {"coordinates": 6},
    "damping": {"stiffness_proportional": 1e-4},
    "design": {"initial": 0.6, "volume_fraction": 0.6, "filter_radius": 0.0},
    "simulation": {"tolerance": 1e-4},
}


def bar(name: str, length: float, **keys: Any) -> Tree:
    """Return a rigid arm."""
    return {"name": name, "rigid": True, "length": length, **SECTION, **keys}


def weightless(name: str, *interfaces: Sequence[Any]) -> Tree:
    """Return a rigid arm of no mass that joins joints, with interfaces (name, point)."""
    found = {"name": name, "rigid": True, "length": 0.0, "mass": 0.0, "inertia": [0] * 6}
    if interfaces:
        found["interfaces"] = [{"name": one, "point": list(point)} for one, point in interfaces]
    return found


def flexible(name: str, length: float, **keys: Any) -> Tree:
    """Return an arm of a few cells."""
    return {"name": name, "length": length, **SECTION, "cells": [4, 2, 2], "passive": 0.0, **keys}


def hinge(name: str, parent: str, child: str, **keys: Any) -> Tree:
    """Return a revolute joint about z."""
    return {"name": name, "type": "revolute", "parent": parent, "child": child, "axis": UP, **keys}


def closed(folder: Path, table: str, tree: Tree, **changes: Any) -> Scene:
    """Return a scene whose motion is a table of joints (collective)."""
    name = f"{tree['name'].replace(' ', '_')}.csv"
    by_root(lambda: (folder / name).write_text(table))
    base = {"material": STEEL, "payload": {"mass": 0.0}, "simulation": {"sample": 0.01}}
    motion = {"path": "joints", "file": name, "horizon": 1.0}
    whole = with_keys(base | {"motion": motion}, tree)
    return scene_from_dict(with_keys(whole, changes), str(folder / "scene.toml"))


# -- kinematics in closed form -------------------------------------------------------------------


def four_bar(kind: str = "pin") -> Tree:
    """Return crank, coupler and a flexible rocker about z, closed with the ground."""
    foot = {"name": "foot", "kind": kind, "between": ["rocker", "ground"], "point": [0.25, 0, 0]}
    return {
        "name": "four-bar",
        "arms": [bar("crank", 0.1), bar("coupler", 0.28), flexible("rocker", 0.25)],
        "joints": [
            hinge("turn", "ground", "crank"),
            hinge("knee", "crank", "coupler", passive=True),
            hinge("rock", "coupler", "rocker", passive=True),
        ],
        "closures": [foot | ({"axis": UP} if kind == "pin" else {})],
        "motion": {"initial_joints": [0.5, 0.5, -2.0]},
    }


def guided_crank() -> Tree:
    """Return crank, flexible rod and a block that a slider guides along the ground's x axis."""
    return {
        "name": "guided crank",
        "arms": [bar("crank", 0.1), flexible("rod", 0.28), weightless("block")],
        "joints": [
            hinge("turn", "ground", "crank"),
            hinge("knee", "crank", "rod", passive=True),
            hinge("wrist", "rod", "block", passive=True),
        ],
        "closures": [{"name": "guide", "kind": "slider", "between": ["block", "ground"],
                      "axis": [1, 0, 0]}],
        "motion": {"initial_joints": [0.5, -0.6, 0.1]},
    }  # fmt: skip


def crossed_crank() -> Tree:
    """Return the slider-crank of `spatial_slider_crank` whose universal joint closes the loop."""
    turns = [("about x", [1, 0, 0]), ("about y", [0, 1, 0]), ("about z", UP)]
    joints = [
        hinge("turn", "ground", "crank", origin=[0, 0.1, 0.12], axis=[1, 0, 0]),
        {"name": "slide", "type": "prismatic", "parent": "ground", "child": "slider",
         "axis": [1, 0, 0], "passive": True},
    ]  # fmt: skip
    arms = [weightless("crank", ("pin", (0.0, 0.0, 0.08))), weightless("slider")]
    below: dict[str, str] = {"parent": "crank", "parent_interface": "pin"}
    for k, (name, axis) in enumerate(turns):
        child = "rod" if k == 2 else f"carrier {k}"
        arms.append(flexible("rod", 0.3) if k == 2 else weightless(child))
        joints.append({"name": name, "type": "revolute", "child": child, "axis": axis,
                       "passive": True, **below})  # fmt: skip
        below = {"parent": child}
    cross = {"name": "cross", "kind": "universal", "between": ["rod", "slider"],
             "axis": [0, 1, 0], "cross_axis": [0, 0, 1]}  # fmt: skip
    start = [0, 0.2, 0.0, 0.73, -0.46]
    return {"name": "crossed crank", "arms": arms, "joints": joints, "closures": [cross],
            "motion": {"initial_joints": start}, "payload": {"arm": "rod"}}  # fmt: skip


def five_bar() -> Tree:
    """Return two cranks 0.3 m apart that hold a tool by two flexible links."""
    return {
        "name": "five-bar",
        "arms": [bar("left", 0.2), flexible("left link", 0.3), bar("right", 0.2),
                 flexible("right link", 0.3)],
        "joints": [
            hinge("a", "ground", "left"),
            hinge("a2", "left", "left link", passive=True),
            hinge("b", "ground", "right", origin=[0.3, 0, 0]),
            hinge("b2", "right", "right link", passive=True),
        ],
        "closures": [{"name": "tool", "kind": "pin", "between": ["right link", "left link"],
                      "axis": UP}],
        "motion": {"initial_joints": [2.0, -1.0, 1.1, 1.0]},
        "payload": {"mass": 1.0, "arm": "left link"},
    }  # fmt: skip


def parallelogram() -> Tree:
    """Return a palletiser's forearm whose hand a rod keeps level: crank, coupler, flexible rod."""
    turned = {"rpy": [QUARTER, 0, 0]}
    return {
        "name": "parallelogram",
        "arms": [flexible("arm", 0.8),
                 bar("hand", 0.2, interfaces=[{"name": "pin", "point": [0.0, 0.1, 0.0]}])],
        "joints": [
            hinge("shoulder", "ground", "arm", **turned),
            hinge("wrist", "arm", "hand", passive=True),
        ],
        "closures": [{"name": "rod", "kind": "rod", "between": ["hand.pin", "ground"],
                      "point": [0.0, 0.0, 0.1], "length": 0.8}],
        "motion": {"initial_joints": [0.3, -0.25], "gravity": [0, 0, -9.81]},
        "payload": {"mass": 5.0},
    }  # fmt: skip


FOOT, HEAD, LUG = (0.3, 0.0, 0.2), (0.0, 0.0, 1.0), (0.75, -0.075, 0.0)  # m


def boom(**changes: Any) -> Tree:
    """Return a crane: a column that slews, and a flexible boom on a cylinder."""
    return with_keys(SOFT | {
        "name": "boom",
        "arms": [
            weightless("column", ("head", HEAD), ("foot", FOOT)),
            flexible("boom", 2.0, height=0.15, thickness=0.08, cells=[8, 2, 2], passive=0.1,
                     interfaces=[{"name": "lug", "point": list(LUG), "radius": 0.13}]),
        ],
        "joints": [
            hinge("slew", "ground", "column"),
            hinge("luff", "column", "boom", parent_interface="head", rpy=[QUARTER, 0, 0],
                  passive=True),
        ],
        "closures": [{"name": "cylinder", "kind": "rod", "between": ["boom.lug", "column.foot"]}],
        "motion": {"initial_joints": [0, 0.5], "gravity": [0, 0, -9.81], "horizon": 1.2},
        "payload": {"mass": 100.0},
        "reduction": {"coordinates": 12},
        "optimizer": {"max_iterations": 2},
    }, changes)  # fmt: skip


BOOM_TABLE = "t,slew,cylinder\n0,0,1.0\n1,0.5,1.25\n"

BASE, PLATE, UPPER, LOWER, SPREAD = 0.2, 0.05, 0.2, 0.45, 0.04  # m, of the delta


def delta() -> Tree:
    """Return three flexible upper arms that carry a plate by six rods; it moves as these let it."""
    slides = [("x", [1, 0, 0]), ("y", [0, 1, 0]), ("z", UP)]
    turns = [("rx", [1, 0, 0]), ("ry", [0, 1, 0]), ("rz", UP)]
    arms, joints, ends, closures = [], [], [], []
    for k in range(3):
        angle, side = 2.0 * np.pi * k / 3.0, 0.5 * SPREAD
        c, s = np.cos(angle), np.sin(angle)
        arms.append(flexible(f"upper{k}", UPPER + 0.06, cells=[13, 2, 2], thickness=SPREAD,
                             interfaces=[{"name": f"rod{i}", "radius": 0.013,
                                          "point": [UPPER, 0.0, (2 * i - 1) * side]}
                                         for i in (0, 1)]))  # fmt: skip
        # About the tangent of the base's circle: at zero outwards, positive downwards.
        joints.append(hinge(f"drive{k}", "ground", f"upper{k}", rpy=[-QUARTER, 0, angle],
                            origin=[BASE * c, BASE * s, 0.0]))  # fmt: skip
        for i in (0, 1):
            # The arm's z is the base's tangent: (s, -c, 0) for this roll and yaw.
            away = (2 * i - 1) * side
            point = [PLATE * c - away * s, PLATE * s + away * c, 0.0]
            ends.append((f"p{k}{i}", point))
            closures.append({"name": f"rod{k}{i}", "kind": "rod", "length": LOWER,
                             "between": [f"plate.p{k}{i}", f"upper{k}.rod{i}"]})  # fmt: skip
    below = "ground"
    for name, axis in slides + turns:
        child = "plate" if name == "rz" else f"carrier {name}"
        arms.append(weightless(child, *ends) if name == "rz" else weightless(child))
        kind = "prismatic" if len(name) == 1 else "revolute"
        joints.append({"name": name, "type": kind, "parent": below, "child": child, "axis": axis,
                       "passive": True})  # fmt: skip
        below = child
    start = [0.5, 0.5, 0.5, 0, 0, -0.4, 0, 0, 0]
    return {
        "name": "delta", "arms": arms, "joints": joints, "closures": closures,
        "motion": {"initial_joints": start}, "payload": {"mass": 0.5},
    }  # fmt: skip


def flexible_slider_crank(folder: Path) -> Scene:
    """Return the machine of `flexible_slider_crank_in_space.csv`: 0.5 N m on a free crank."""
    wide, last = 0.01, 0.02  # m, s
    text = f"t,turn\n0,0.5\n{last},0.5\n"
    by_root(lambda: (folder / "torque.csv").write_text(text))
    slide = {"name": "slide", "type": "prismatic", "parent": "ground", "child": "piston",
             "origin": [0, 0.11, -wide], "axis": [0, 1, 0], "passive": True}  # fmt: skip
    tree = {
        "name": "slider-crank in space",
        "material": {"young_modulus": 70e9, "poisson_ratio": 0.33, "density": 2710.0},
        "arms": [flexible("crank", 0.03, cells=[9, 3, 3]), flexible("rod", 0.08, cells=[24, 3, 3]),
                 weightless("piston") | {"mass": 0.1}],
        "joints": [hinge("turn", "ground", "crank", rpy=[0, 0, QUARTER]),
                   hinge("knee", "crank", "rod", origin=[0, 0, -wide], passive=True), slide],
        "closures": [{"name": "pin", "kind": "pin", "between": ["rod", "piston"], "axis": UP}],
        "control": {"feed_forward": "none", "stiffness": [0.0], "damping": [0.0],
                    "forces": str(folder / "torque.csv")},
        "motion": {"initial_joints": [0, 0, 0], "duration": last, "horizon": last},
        "payload": {"mass": 0.0, "arm": "rod"},
        "damping": {"stiffness_proportional": 1e-5},
        "reduction": {"coordinates": 12},
        "simulation": {"tolerance": 5e-3, "sample": 1e-4, "stiffening": False},
        "design": {"volume_fraction": 1.0, "initial": 1.0},
    }  # fmt: skip
    return closed(folder, f"t,turn\n0,0\n{last},1e-3\n", tree)


# -- rigid machines that move freely -------------------------------------------------------------


def free(folder: Path, tree: Tree, table: str, bodies: list[ShapeIntegrals]) -> MachineSystem:
    """Return a machine of rigid bodies whose driven joints are let go at the table's start."""
    control = {"feed_forward": "none", "stiffness": [0.0], "damping": [0.0]}
    return build_system(closed(folder, table, tree, control=control), bodies)


def started(system: MachineSystem, rate: float) -> MachineSystem:
    """Return it begun with a rate of its first joint, the others such that loops stay closed."""
    q = system.motion(np.zeros(1)).q
    assert system.loops is not None
    J = system.loops.at(system.mechanism, q, np.zeros((1, 0))).jacobian[0]
    rates = np.append(rate, np.linalg.lstsq(J[:, 1:], -rate * J[:, 0], rcond=None)[0])

    def motion(t: np.ndarray) -> RigidMotion:
        still = np.zeros((len(t), len(rates)))
        return RigidMotion(q + np.outer(t, rates), still + rates, still)

    return replace(system, motion=motion)


def double_four_bar() -> tuple[Tree, list[ShapeIntegrals]]:
    """Return IFToMM's double four-bar: five rods of 1 m and 1 kg, three of them upright."""
    names, down = ("bar1", "top1", "bar2", "top2"), -QUARTER
    rods = [bar(name, 1.0) for name in names] + [flexible("bar3", 1.0)]
    parents = ("ground", "bar1", "top1", "top1", "top2")
    joints = [
        hinge(f"joint{k}", parent, one["name"], passive=k > 0)
        for k, (parent, one) in enumerate(zip(parents, rods, strict=True))
    ]
    closures = [
        {"name": f"foot{k}", "kind": "pin", "between": [f"bar{k + 1}", "ground"], "axis": UP,
         "point": [float(k), 0, 0]}
        for k in (1, 2)
    ]  # fmt: skip
    motion = {"initial_joints": [QUARTER, down, down, 0.0, down], "gravity": [0, -9.81, 0],
              "horizon": 10.0}  # fmt: skip
    tree = {"name": "double four-bar", "arms": rods, "joints": joints, "closures": closures,
            "motion": motion}  # fmt: skip
    rod = rigid_spatial_body(1.0, (0.5, 0, 0), (0, 1 / 12, 1 / 12, 0, 0, 0), (1, 0, 0))
    return tree, [rod] * 5


def spatial_slider_crank() -> tuple[Tree, list[ShapeIntegrals]]:
    """Return IFToMM's spatial slider-crank: the rod on a universal joint and a ball."""
    pin, slider = np.array([0.0, 0.1, 0.2]), np.array([0.2, 0.0, 0.0])  # m
    along = (pin - slider) / 0.3
    rpy = (0.0, float(-np.arcsin(along[2])), float(np.arctan2(along[1], along[0])))
    across = np.cross([1.0, 0.0, 0.0], along)
    tree = {
        "name": "spatial slider-crank",
        "arms": [bar("crank", 0.08), weightless("slider"), weightless("cross"),
                 flexible("rod", 0.3)],
        "joints": [
            hinge("turn", "ground", "crank", origin=[0, 0.1, 0.12], rpy=[0, -QUARTER, 0],
                  axis=[0, 0, -1]),
            {"name": "slide", "type": "prismatic", "parent": "ground", "child": "slider",
             "axis": [1, 0, 0], "passive": True},
            hinge("tilt", "slider", "cross", axis=[1, 0, 0], passive=True),
            hinge("roll", "cross", "rod", rpy=list(rpy), passive=True,
                  axis=list(roll_pitch_yaw(rpy).T @ across)),
        ],
        "closures": [{"name": "ball", "kind": "ball", "between": ["rod", "crank"]}],
        "motion": {"initial_joints": [0, 0.21, 0.01, 0], "gravity": [0, 0, -9.81],
                   "horizon": 2.0},
    }  # fmt: skip
    none = (0.0, 0.0, 0.0)
    bodies = [
        rigid_spatial_body(0.12, (0.04, 0, 0), (1e-5, 1e-4, 1e-4, *none), (0.08, 0, 0)),
        rigid_spatial_body(2.0, none, (1e-4, 1e-4, 1e-4, *none)),
        rigid_spatial_body(0.0, none, (*none, *none)),
        rigid_spatial_body(0.5, (0.15, 0, 0), (4e-4, 4e-3, 4e-3, *none), (0.3, 0, 0)),
    ]
    return tree, bodies


# -- loops with more equations than rigid arms need ----------------------------------------------

WIDE = {"height": 0.03, "thickness": 0.03, "joint_mass": 0.0, "joint_inertia": 0.0}  # m, kg
FLEXED = {
    "material": {"young_modulus": 210e9, "poisson_ratio": 0.3, "density": 2700.0},
    "motion": {"gravity": [0, 0, -9.81]},
    "damping": {"stiffness_proportional": 1e-4},
    "design": {"initial": 1.0, "volume_fraction": 1.0},
    "simulation": {"tolerance": 1e-3, "stiffening": False},
}


def stiff(name: str, length: float, mass: float, **keys: Any) -> Tree:
    """Return a rigid arm of a uniform bar's inertia."""
    small, large = 1e-4 * mass, mass * (length**2 / 12.0 + 1e-4)
    return {"name": name, "rigid": True, "length": length, "mass": mass, **WIDE, **keys,
            "centre": [0.5 * length, 0, 0], "inertia": [small, large, large, 0, 0, 0]}  # fmt: skip


def steel(name: str, length: float) -> Tree:
    """Return a flexible arm of few cells."""
    return {"name": name, "length": length, "cells": [16, 2, 2], "density": 5000.0, **WIDE}


def bennett(longer: float = 0.0) -> Tree:
    """Return Bennett's linkage, its rocker of steel: four bars that only their twists let move."""
    a, b = np.radians(40.0), np.radians(70.0)
    long = 0.2 * float(np.sin(b) / np.sin(a))
    twisted = {"rpy": [float(-a - b), 0, 0], "axis": [0, float(-np.sin(a)), float(np.cos(a))]}
    pin = {"name": "pin", "kind": "pin", "between": ["rocker", "ground"], "point": [-long, 0, 0]}
    return FLEXED | {
        "name": "Bennett",
        "arms": [stiff("crank", 0.2, 1.0), stiff("coupler", long, 1.2),
                 steel("rocker", 0.2 + longer)],
        "joints": [
            hinge("j1", "ground", "crank"),
            hinge("j2", "crank", "coupler", passive=True, rpy=[float(a), 0, 0]),
            hinge("j3", "coupler", "rocker", passive=True, rpy=[float(b), 0, 0]),
        ],
        "closures": [pin | twisted],
        "motion": FLEXED["motion"] | {"initial_joints": [0.5, 2.9, -0.4]},
        "payload": {"arm": "rocker", "mass": 0.3},
    }  # fmt: skip


def cranks(longer: float = 0.0, apart: float = 0.0, start: float = 1.0) -> Tree:
    """Return a parallelogram with three cranks, the middle one of steel, pins `apart` of a line."""
    between = [{"name": "mid", "point": [0.2, apart, 0]}]
    return FLEXED | {
        "name": "three cranks",
        "arms": [stiff("one", 0.2, 1.0), stiff("coupler", 0.4, 1.2, interfaces=between),
                 steel("two", 0.2 + longer), stiff("three", 0.2, 1.0)],
        "joints": [
            hinge("j1", "ground", "one"),
            hinge("j2", "one", "coupler", passive=True),
            hinge("j3", "ground", "two", passive=True, origin=[0.2, apart, 0]),
            hinge("j4", "ground", "three", passive=True, origin=[0.4, 0, 0]),
        ],
        "closures": [
            {"name": f"pin {name}", "kind": "pin", "between": [name, end], "axis": UP}
            for name, end in (("two", "coupler.mid"), ("three", "coupler"))
        ],
        "motion": FLEXED["motion"] | {"initial_joints": [start, -start, start, start]},
        "payload": {"arm": "coupler", "mass": 0.3},
    }  # fmt: skip


def rhombus(crank: float = 0.2, start: float = 0.5) -> Tree:
    """Return crank, coupler of 0.4 m and a rocker of 0.2 m to a pin 0.4 m from the crank's."""
    pin = {"name": "pin", "kind": "pin", "between": ["rocker", "ground"], "point": [0.4, 0, 0]}
    return FLEXED | {
        "name": "rhombus",
        "arms": [stiff("crank", crank, 1.0), stiff("coupler", 0.4, 1.2), steel("rocker", 0.2)],
        "joints": [
            hinge("j1", "ground", "crank"),
            hinge("j2", "crank", "coupler", passive=True),
            hinge("j3", "coupler", "rocker", passive=True),
        ],
        "closures": [pin | {"axis": UP}],
        "motion": FLEXED["motion"] | {"initial_joints": [start, -start, np.pi + start]},
        "payload": {"arm": "rocker", "mass": 0.3},
    }  # fmt: skip


def driven_slider() -> Tree:
    """Return a slider that drives a crank by a rod, both in line at the start."""
    slide = {"name": "slide", "type": "prismatic", "parent": "ground", "child": "slider",
             "axis": [1, 0, 0]}  # fmt: skip
    return FLEXED | {
        "name": "driven slider",
        "arms": [weightless("slider") | {"mass": 0.5}, steel("rod", 0.25),
                 stiff("crank", 0.1, 0.3)],
        "joints": [slide, hinge("wrist", "slider", "rod", passive=True),
                   hinge("shaft", "ground", "crank", passive=True)],
        "closures": [{"name": "pin", "kind": "pin", "between": ["rod", "crank"], "axis": UP}],
        "motion": FLEXED["motion"] | {"initial_joints": [0.35, np.pi, 0.0]},
        "payload": {"arm": "rod", "mass": 0.1},
    }  # fmt: skip
