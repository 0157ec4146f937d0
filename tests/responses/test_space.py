"""The yaw-pitch-pitch chain of solid links: its deviation, gradients of responses, its files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from mpi4py import MPI
from runs import ROOT, overrides, run

import dolfinopt as do
from dolfinopt.arms.arm import uniform_design
from dolfinopt.optimization.gradient_check import taylor_test

pytestmark = pytest.mark.serial
DEMO = ROOT / "demos" / "spatial_arm.toml"
COARSE = ("arms.link1.cells=[8,2,2]", "arms.link2.cells=[8,2,2]", "arms.passive=0.06",
          "simulation.sample=0.01", "objective.load_cases=6",
          "simulation.stiffening=false")  # fmt: skip
SOLID = ("design.initial=1.0", "design.volume_fraction=1.0")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of a simulation of solid links."""
    out = tmp_path_factory.mktemp("space") / "run"
    cells = ("arms.link1.cells=[24,4,2]", "arms.link2.cells=[24,4,2]")
    changes = overrides(*SOLID, *cells, "simulation.sample=0.002")
    run("simulate", DEMO, "--out", out, "--no-plots", *changes)
    return out


def test_deviation_of_the_demo(folder):
    """Within 1 % of nonlinear beams with rigid end faces, 18.62 mm; the demo's own cells 18.72 mm.

    Without stiffening, which nonlinear beams have, it would be 18.85 mm there.
    """
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["max_deviation"] == pytest.approx(18.62e-3, rel=0.01)
    assert summary["max_deviation"] == pytest.approx(18.763e-3, rel=1e-4)
    assert summary["max_deviation_time"] == pytest.approx(0.416, abs=0.003)
    assert summary["mass"] == pytest.approx({"column": 0.0, "link1": 1.08, "link2": 0.972})
    assert set(summary["drive_peak"]) == {"yaw", "shoulder", "elbow"}
    assert len(summary["stress"]["place"]) == 3
    assert summary["units"]["drive_peak"] == dict.fromkeys(("yaw", "shoulder", "elbow"), "N m")


def test_files_in_space(folder):
    with np.load(folder / "trajectory.npz") as found:
        assert found["q_r"].shape == found["joint_forces"].shape == (301, 3)
        assert found["deviation"].shape == (301, 3)
        assert found["q_r"][-1] == pytest.approx([1.6, 1.1, -0.5])
        deviation = found["deviation"]
    table = np.genfromtxt(folder / "trajectory.csv", delimiter=",", names=True)
    assert np.abs(table["deviation_z"] - deviation[:, 2]).max() < 1e-9
    assert table["q_r_elbow"][0] == -1.9
    with np.load(folder / "design.npz") as found:
        assert found["link1/centroid"].shape == (24 * 4 * 2, 3)
    pyvista = pytest.importorskip("pyvista")
    grid = pyvista.read(folder / "design.vtu")
    assert grid.n_cells == 2 * 192 and set(grid.celltypes) == {12}
    assert grid.volume == pytest.approx(0.95 * 0.04 * 0.02, rel=1e-9)
    # Of places that are equal but for rounding the map's largest is the one that is told.
    told = json.loads((folder / "summary.json").read_text())["stress"]
    worst = int(np.argmax(grid["stress"]))
    assert grid["stress"][worst] == pytest.approx(told["value"], rel=1e-9)
    assert grid.cell_centers().points[worst] == pytest.approx(told["place"], abs=1e-6)


@pytest.mark.parametrize("stiffening", ["false", "auto"])
def test_no_geometric_stiffness_is_built_where_none_is_asked_for(monkeypatch, stiffening):
    """It takes two thirds of the memory of tetrahedra; the estimate of "auto" needs it."""
    from dolfinopt.arms import design_state
    from dolfinopt.arms.arm import stiffening_of

    built = []

    def counted(arm):
        built.append(arm)
        return unit_loads(arm)

    unit_loads = design_state.unit_loads
    monkeypatch.setattr(design_state, "unit_loads", counted)
    scene = do.load_scene(DEMO, (*COARSE, f"simulation.stiffening={stiffening}"))
    partition, profile = do.partition_arms(MPI.COMM_SELF, scene.cell_counts), do.Profile()
    arms = do.build_arms(scene, partition, profile)
    x_phys = uniform_design(scene, partition, arms, 0.5)
    _, trajectory = do.evaluate(scene, partition, arms, x_phys, profile)
    do.gradient(scene, partition, arms, trajectory, profile)
    assert bool(built) == (stiffening == "auto")
    assert (stiffening_of(arms).estimate is None) == (stiffening == "false")


SCENARIOS = (
    "scenarios=[{changes=['payload.mass=2']}, {changes=['material.young_modulus=60e9', "
    "'material.density=2500.0'], weight=2.0}]",
)
CONTROL = ("control.stiffness=[2e4,2e4,2e4]", "control.damping=[600.0,600.0,600.0]")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "control"),
    [
        ("deviation", SCENARIOS),
        ("effort", CONTROL),
        ("stress", ("simulation.stiffening=true",)),
        ("tip_deflection", ()),
        ("eigenfrequency", ()),
    ],
)
def test_exact_gradient_in_space(kind, control, monkeypatch):
    """Taylor's remainders fall by the order 2.00 along directions without any symmetry."""
    monkeypatch.setattr("dolfinopt.optimization.gradient_check.STEPS", (2.5e-3, 6.25e-4))
    # Instants that come and go beneath the cut would make small steps of the p-mean.
    monkeypatch.setattr("dolfinopt.responses.stress.NEGLIGIBLE", 0.0)
    limited = ("constraints.deviation=0.1",) if kind == "effort" else ()
    scene = do.load_scene(DEMO, (*COARSE, *control, f"objective.kind={kind}", *limited))
    profile = do.Profile()
    partition = do.partition_arms(MPI.COMM_SELF, scene.cell_counts)
    arms = do.build_arms(scene, partition, profile)
    x = uniform_design(scene, partition, arms, 0.5)
    found = taylor_test(scene, partition, arms, x, profile)
    rates = {row.direction: row.rate for row in found.rows}
    assert rates["random"] == pytest.approx(2.0, abs=0.02), rates
    assert rates["smooth"] == pytest.approx(2.0, abs=0.02), rates


def forked(folder):
    """Return a link that carries a rigid hand on its end, a slide and the payload on its side."""
    (folder / "table.csv").write_text("t,swing,slide\n0,0,0\n0.2,1,0.1\n")
    turned = [0.0, 0.0, 0.5 * np.pi]
    data = {
        "material": {"young_modulus": 70e9, "poisson_ratio": 0.33, "density": 2700.0},
        "arms": [
            {"name": "link", "length": 0.5, "height": 0.04, "thickness": 0.02, "cells": [6, 2, 2],
             "passive": 0.05,
             "interfaces": [{"name": "side", "point": [0.29, 0.02, 0.0], "radius": 0.01}]},
            {"name": "hand", "rigid": True, "length": 0.2, "mass": 1.0,
             "inertia": [0.01, 0.02, 0.02, 0, 0, 0]},
            {"name": "slider", "rigid": True, "length": 0.2, "mass": 0.5,
             "inertia": [0.01, 0.02, 0.02, 0, 0, 0]},
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
        "objective": {"load_cases": 6},
    }  # fmt: skip
    return do.scene_from_dict(data, str(folder / "fork.toml"))


def test_exact_gradient_of_a_fork(tmp_path, monkeypatch):
    """Of where the payload on the second interface is, and of the frequency with all it carries."""
    monkeypatch.setattr("dolfinopt.optimization.gradient_check.STEPS", (2.5e-3, 6.25e-4))
    scene = forked(tmp_path)
    partition = do.partition_arms(MPI.COMM_SELF, scene.cell_counts)
    for kind in ("deviation", "eigenfrequency"):
        objective = scene.objective.model_copy(update={"kind": kind})
        other = scene.model_copy(update={"objective": objective})
        arms = do.build_arms(other, partition, do.Profile())
        x = uniform_design(other, partition, arms, 0.5)
        found = taylor_test(other, partition, arms, x, do.Profile())
        rates = [row.rate for row in found.rows if row.direction in ("random", "smooth")]
        assert rates == pytest.approx([2.0, 2.0], abs=0.02), kind
