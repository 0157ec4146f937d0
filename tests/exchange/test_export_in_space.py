"""`dolfinopt export` of a machine in space, and scenes that take its files."""

import io
from contextlib import redirect_stdout

import numpy as np
import pytest
from bodies import beam
from mpi4py import MPI
from readers import check_npz, read_as_mbdyn_does
from runs import ROOT, overrides, refusal, run, tomllib

import dolfinopt as do
from dolfinopt.cli.shared import doubts_of_files
from dolfinopt.exchange.sid import read_sid, write_sid
from dolfinopt.multibody.shape_integrals import in_space, rigid_bar
from dolfinopt.multibody.standard_input import load_body, to_sid

COMM = MPI.COMM_WORLD
DEMO = ROOT / "demos" / "spatial_arm.toml"
CELLS = {"link1": [8, 2, 2], "link2": [6, 2, 2]}
LENGTHS = {"link1": 0.5, "link2": 0.45}
COARSE = overrides(*(f"arms.{name}.cells={cells}" for name, cells in CELLS.items()))
SETTINGS = overrides("simulation.stiffening=true", "arms.column.mass=2.0")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of the links' files, the same on all ranks; what was told."""
    out = COMM.bcast(tmp_path_factory.mktemp("space") / "bodies")
    with redirect_stdout(io.StringIO()) as told:
        run("export", DEMO, *COARSE, *SETTINGS, "--out", out)
    return out, told.getvalue()


def test_files_of_every_link(folder):
    """Masses and inertias of boxes of half density; the geometric stiffness of all loads."""
    out, told = folder
    kinds = (".sid", ".sid.npz", ".fem")
    assert {path.name for path in out.iterdir()} == {f"{n}{k}" for n in CELLS for k in kinds}
    if COMM.rank == 0:
        assert "column: not exported, it is rigid: 2 kg, centre (0, 0, 0) m" in told
        assert "6 coordinates, 2 nodes, geometric stiffness" in told
    for name, length in LENGTHS.items():
        path = out / f"{name}.sid"
        body = load_body(path, 3, length)
        groups = read_as_mbdyn_does(path.with_suffix(".fem").read_text())
        check_npz(out / f"{name}.sid.npz", read_sid(path))
        mass = 0.6 * 2700.0 * length * 0.04 * 0.02
        assert body.mass == groups[12][0] == pytest.approx(mass, rel=1e-5)  # void: 1e-6 of solid
        assert groups[12][1:4] == pytest.approx([0.5 * length, 0.0, 0.0], abs=1e-9)
        sizes = np.array([length, 0.04, 0.02]) ** 2
        expected = np.diag(mass / 12.0 * (sizes.sum() - sizes))
        assert np.abs(groups[12][4:].reshape(3, 3) - expected).max() < 1e-5 * expected.max()
        assert body.K0.shape == (12, 6, 6) and body.K0_outboard.shape == (6, 6, 6)
        assert [load for load, _ in groups[19]] == list(range(1, 19))
        data = read_sid(path)
        assert np.array_equal(groups[9], data.Me.M0) and np.array_equal(groups[10], body.K)
        assert np.abs(body.M - groups[9]).max() < 1e-12 * np.abs(groups[9]).max()
        assert [node.name for node in data.nodes] == ["1", "2"]


@pytest.mark.skipif(COMM.size == 1, reason="one rank")
def test_files_are_the_same_on_any_number_of_ranks(folder, shared_tmp_path):
    if COMM.rank == 0:
        run("export", DEMO, *COARSE, *SETTINGS, "--out", shared_tmp_path, world=MPI.COMM_SELF)
        for path in shared_tmp_path.iterdir():
            if path.suffix != ".npz":  # archives hold the time of day
                assert path.read_bytes() == (folder[0] / path.name).read_bytes(), path.name


def meshed():
    """Return the demo as a dictionary, coarse and short, every arm with all of its keys."""
    scene = tomllib.loads(DEMO.read_text())
    scene["motion"]["file"] = str(DEMO.with_suffix(".csv"))
    scene["simulation"] = {"stiffening": True, "sample": 0.02}
    for arm in scene["arms"][1:]:
        arm |= {"cells": CELLS[arm["name"]], "height": 0.04, "thickness": 0.02}
    return scene


@pytest.mark.serial
def test_motion_with_a_link_of_a_file(folder):
    """The machine moves as with the link's mesh, but for what the inertia of its modes stiffens."""
    expected = do.Model(meshed()).simulate().trajectory.deviation
    scene = meshed()
    scene["arms"][1] = {"name": "link1", "sid": str(folder[0] / "link1.sid")}
    found = do.Model(scene).simulate().trajectory.deviation
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()  # measured 3e-5


@pytest.mark.serial
def test_links_of_files_that_cannot_be(folder, tmp_path):
    """Stiffness that cannot be left out; bodies that do not bend, or in the plane alone."""
    scene = meshed()
    scene["simulation"]["stiffening"] = False
    scene["arms"][2] = {"name": "link2", "sid": str(folder[0] / "link2.sid")}
    refusal(lambda: do.Model(scene), "link2.sid", "geometric stiffness")
    write_sid(tmp_path / "bar.sid", to_sid(in_space(rigid_bar(0.45, 0.04, 0.9))))
    scene["arms"][2]["sid"] = str(tmp_path / "bar.sid")
    refusal(lambda: do.Model(scene), "bar.sid", "nelastq = 0", "rigid = true, mass")
    write_sid(tmp_path / "beam.sid", to_sid(in_space(beam().body())))
    scene = meshed()
    scene = meshed()
    scene["arms"][2] = {"name": "link2", "sid": str(tmp_path / "beam.sid")}
    stiffening, plane = doubts_of_files(do.scene_from_dict(scene))
    assert "beam.sid" in stiffening and "geometric stiffness" in stiffening
    assert "'link2'" in plane and "rigid" in plane
