"""MBDyn's modal element: its format, forces by its numbers, lumped nodes; the command `export`."""

import os
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bodies import random_cloud, stiffened
from mpi4py import MPI
from readers import mbdyn_forces, mbdyn_stiffening, random_state, read_as_mbdyn_does
from remainders import substructure
from runs import TWO_ARM, tomllib

from dolfinopt import Model
from dolfinopt.cli import commands
from dolfinopt.exchange.in_space import in_space, plate_moments
from dolfinopt.exchange.mbdyn import fem_text, lumped_nodes, modal_element, write_fem
from dolfinopt.exchange.standard_input import load_body
from dolfinopt.fem.geometric_stiffness import unit_loads
from dolfinopt.multibody.body import BodyMotion, Constants
from dolfinopt.multibody.shape_integrals import shape_integrals
from dolfinopt.reduction import Options, craig_bampton

COMM = MPI.COMM_WORLD
LENGTH, HEIGHT, THICKNESS = 1.2, 0.3, 0.02  # m


def reduced(cells, comm=MPI.COMM_SELF, uneven=False, stiffened=False, element="linear"):
    """Return the body, the same in space, and its nodes, which are None but on the first rank."""
    arm = substructure((LENGTH, HEIGHT, THICKNESS), cells, comm, element)
    mesh, x = arm.mesh, np.ones(arm.mesh.num_cells)
    if uneven:
        place = np.round(mesh.centroid, 9)
        x = 0.5 + 0.4 * np.sin(30.0 * place[:, 0] + 170.0 * place[:, 1])
    elastic = arm.at(70e9 * x**3, 2700.0 * x)
    basis = craig_bampton(elastic, Options(4))
    body = shape_integrals(elastic, basis, 2e-4, unit_loads(elastic) if stiffened else None)
    lifted = in_space(body, plate_moments(elastic, basis, THICKNESS))
    return body, lifted, lumped_nodes(elastic, basis, THICKNESS)


@pytest.fixture(scope="module")
def parts():
    return reduced((8, 3), uneven=True)


@pytest.fixture(scope="module")
def stiff_parts():
    return reduced((8, 3), uneven=True, stiffened=True)


@pytest.fixture(scope="module")
def cloud():
    """Point masses in space without any symmetry."""
    return random_cloud(np.random.default_rng(1), 4, 3)


@pytest.fixture(scope="module")
def stiff_cloud(cloud):
    """Their body with geometric stiffness by all 18 loads, but not by the modes' inertia."""
    body = stiffened(np.random.default_rng(2), cloud.body())
    return replace(body, along_modes=np.zeros((0, 4, 4)))


@pytest.fixture(scope="module")
def elements(parts, stiff_parts, cloud, stiff_cloud):
    return {
        "plane": modal_element(*parts[1:]),
        "stiff plane": modal_element(*stiff_parts[1:]),
        "linear space": modal_element(cloud.body()),
        "space": modal_element(stiff_cloud),
    }


@pytest.mark.parametrize(
    ("kind", "loads"),
    [("plane", []), ("stiff plane", [3, 9, 10, 11, 13, 14, 18]), ("space", range(1, 19))],
)
def test_round_trip_is_exact(tmp_path, elements, kind, loads):
    written = elements[kind]
    write_fem(tmp_path / "a.fem", written)
    groups = read_as_mbdyn_does((tmp_path / "a.fem").read_text())
    found = groups.get(19, [])
    assert [load for load, _ in found] == list(loads) == list(written.stiffening)
    for (_, matrix), expected in zip(found, written.stiffening.values(), strict=True):
        assert np.array_equal(matrix, expected)
    assert np.array_equal(groups[8].transpose(1, 2, 0), written.modes)
    for group, name in ((9, "M"), (10, "K"), (13, "D")):
        assert np.array_equal(groups[group], getattr(written.body, name)), name
    assert np.array_equal(np.column_stack([groups[k] for k in (5, 6, 7)]), written.points)
    centre, inertia = written.body.inertia_about_centre()
    assert np.array_equal(groups[12], [written.body.mass, *centre, *inertia.ravel()])
    if kind == "plane":
        # MBDyn warns of matrices that are not symmetric.
        assert all(np.array_equal(groups[group], groups[group].T) for group in (9, 10))
        assert sorted(groups) == [1, 2, 5, 6, 7, 8, 9, 10, 11, 12, 13]
        assert groups[1] == (9 * 4 + 2, 4)
        assert groups[2] == [str(k) for k in range(1, 39)]
        # MBDyn warns of masses that differ by direction.
        assert np.array_equal(groups[11], written.lumped)
        assert np.array_equal(groups[11][:, [0, 0]], groups[11][:, 1:3])
    if kind == "space":
        for group, expected in written.invariants.items():
            assert np.array_equal(groups[group], expected), group


ROUNDING = 1e-12


def assert_close(found, expected):
    assert np.abs(found - expected).max() < ROUNDING * max(1.0, np.abs(expected).max())


@pytest.mark.parametrize("stiff", [False, True])
def test_forces_of_mbdyn(cloud, stiff_cloud, stiff):
    """MBDyn's equations with the file's numbers: rows of any body, forces of a linear one."""
    body = stiff_cloud if stiff else cloud.body()
    groups = read_as_mbdyn_does(fem_text(modal_element(body)))
    assert sorted(groups) == [1, 2, *range(5, 11), *range(12, 19), *[19] * stiff]
    s = random_state(np.random.default_rng(6), 4)
    force, moment, rows = mbdyn_forces(groups, s)
    frame = tuple(x[:, None] for x in (s.a, s.w, s.g))
    rates = np.stack([s.q, s.qd, s.qdd], axis=1)[:, :, None]
    expected = BodyMotion(Constants(body), frame, rates)
    assert_close(rows, expected.rows({})[:, 0])
    if not stiff:  # motion of the second order is not in the format
        assert_close(force, expected.load[:3, 0])
        assert_close(moment, expected.load[3:, 0])


def test_mbdyn_stiffens_by_loads_outboard(stiff_cloud):
    """A load on the interface stiffens as in the package, in which it acts from outside."""
    groups = read_as_mbdyn_does(fem_text(modal_element(stiff_cloud)))
    load, still = np.random.default_rng(8).normal(size=(2, 3)), np.zeros(3)
    found = mbdyn_stiffening(groups, still, still, still, *load)
    assert_close(found, -np.tensordot(load.ravel(), stiff_cloud.K0_outboard, 1))


@pytest.mark.parametrize("stiff", [False, True])
def test_several_interfaces(stiff):
    """A node each, behind the inboard joint; loads on all of them stiffen."""
    rng = np.random.default_rng(9)
    body = random_cloud(rng, 4, 3, 2).body()
    body = stiffened(rng, body) if stiff else body
    element = modal_element(body)
    assert np.array_equal(element.points, [np.zeros(3), *body.points])
    assert np.array_equal(np.concatenate(element.modes[1:]), body.outboard)
    assert list(element.stiffening) == list(range(1, 25 if stiff else 1))
    outboard = [element.stiffening[load] for load in range(13, 25 if stiff else 13)]
    assert np.array_equal(np.reshape(outboard, body.K0_outboard.shape), body.K0_outboard)


def invariants(element):
    """Return what MBDyn makes of the lumped masses (its technical manual's invariants)."""
    m, p, phi = element.lumped[:, 0], element.points, element.modes[:, :3]
    second = np.einsum("n,ni,nj->ij", m, p, p)
    J = np.trace(second) * np.eye(3) - second + np.diag(element.lumped[:, 3:].sum(axis=0))
    return {
        "mass": m.sum(),
        "moment": m @ p,
        "J": J,
        "Inv3": np.einsum("n,nik->ik", m, phi),
        "Inv4": np.einsum("n,nik->ik", m, np.cross(p[:, :, None], phi, axis=1)),
        "Inv5": np.einsum("n,nikl->ikl", m, np.cross(phi[:, :, :, None], phi[:, :, None], axis=1)),
        "M": np.einsum("n,nik,nil->kl", m, phi, phi),
    }


SMALL = ["--set", "arms.cells=[20,3]", "--set", "arms.arm2.length=0.8"]


def export(folder, *arguments, world=COMM):
    command = ["export", TWO_ARM, *SMALL, *arguments, "--out", folder]
    commands.main([str(word) for word in command], standalone_mode=False, obj=world)
    world.barrier()


@pytest.mark.parametrize(
    ("stiffening", "duration", "on"),
    [("true", 1.9, True), ("false", 0.9, False), ("auto", 6.0, False), ("auto", 0.9, True)],
)
def test_export_with_geometric_stiffness(shared_tmp_path, stiffening, duration, on):
    """Where the scene says so, or its motion; a scene that takes the file's arm moves the same."""
    value = stiffening if stiffening != "auto" else '"auto"'
    fast = ["--set", f"motion.duration={duration}", "--set", f"simulation.stiffening={value}"]
    fast += ["--set", f"motion.horizon={max(duration, 3.0)}"]
    export(shared_tmp_path / "out", *fast)
    for arm in ("arm1", "arm2"):
        path = shared_tmp_path / "out" / f"{arm}.sid"
        assert load_body(path, 2).is_stiffened == on
        groups = read_as_mbdyn_does(path.with_suffix(".fem").read_text())
        assert len(groups.get(19, [])) == 7 * on


@pytest.mark.serial
@pytest.mark.parametrize("stiffening", [True, False])
def test_motion_of_exported_arms(tmp_path, stiffening):
    """Arms from stiffened files move as the designed ones; as linear ones if the scene says so."""
    export(tmp_path, "--set", "simulation.stiffening=true")
    designed = tomllib.loads(Path(TWO_ARM).read_text())
    designed["simulation"]["stiffening"] = stiffening
    designed["motion"]["duration"] = 1.2
    taken = deepcopy(designed)
    for scene in (designed, taken):
        scene["arms"][1] = dict(scene["arms"][0], name="arm2", length=0.8)
    for arm in designed["arms"]:
        arm["cells"] = [20, 3]
    for arm in taken["arms"]:
        arm["sid"] = str(tmp_path / f"{arm['name']}.sid")
        del arm["cells"], arm["passive"]
    for k in (0, 1):  # one arm must be designed
        mixed = deepcopy(designed)
        mixed["arms"][k] = taken["arms"][k]
        found, expected = (Model(scene).simulate().trajectory for scene in (mixed, designed))
        scale = np.abs(expected.deviation).max()
        # Files do not hold what the inertia of the modes stiffens: 3e-4 in so fast a motion.
        near = 1e-3 if stiffening else 1e-6
        assert np.abs(found.deviation - expected.deviation).max() < near * scale


def test_export_is_the_same_on_any_number_of_ranks(shared_tmp_path):
    export(shared_tmp_path / "all")
    if COMM.rank == 0:
        export(shared_tmp_path / "one", world=MPI.COMM_SELF)
        for name in os.listdir(shared_tmp_path / "all"):
            if not name.endswith(".npz"):  # archives hold the time of day
                ours, theirs = (shared_tmp_path / side / name for side in ("all", "one"))
                assert ours.read_bytes() == theirs.read_bytes(), name
    COMM.barrier()


def test_export_of_a_design(shared_tmp_path):
    """The file's densities, not the initial ones; an arm that shares a design has the same body."""
    shared = ["--set", "arms.arm2.length=1.0", "--set", 'arms.arm2.design="arm1"']
    if COMM.rank == 0:
        x = (np.arange(20) + 0.5) / 20
        place = np.stack(np.meshgrid(x, [-0.02, 0.0, 0.02], indexing="ij"), axis=2).reshape(-1, 2)
        density = np.where(place[:, 0] < 0.5, 1.0, 0.2)
        arms = ("arm1", "arm2")
        arrays = {f"{arm}/centroid": place for arm in arms}
        np.savez(shared_tmp_path / "d.npz", **arrays, **{f"{arm}/density": density for arm in arms})
    COMM.barrier()
    export(shared_tmp_path / "out", "--design", shared_tmp_path / "d.npz", *shared)
    bodies = [load_body(shared_tmp_path / "out" / f"{arm}.sid", 2) for arm in ("arm1", "arm2")]
    # x = 0.2 weighs a fifth: the two-material law's mass is linear.
    assert bodies[0].mass == pytest.approx(2700.0 * 0.06 * 0.01 * 0.6, rel=1e-5)
    assert bodies[0].w[0, 0] / bodies[0].mass == pytest.approx((0.125 + 0.075) / 0.6, rel=1e-5)
    assert np.array_equal(bodies[0].K, bodies[1].K)


def test_rigid_arms_are_left_out(shared_tmp_path, capsys):
    export(shared_tmp_path / "out", "--set", "arms.arm1.rigid=true")
    assert {path.stem.split(".")[0] for path in (shared_tmp_path / "out").iterdir()} == {"arm2"}
    if COMM.rank == 0:
        assert "arm1: not exported" in capsys.readouterr().out
