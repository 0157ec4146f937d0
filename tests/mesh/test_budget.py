"""What does not fit the memory is refused before it is meshed."""

from __future__ import annotations

import math
import re
import subprocess
import sys
from types import SimpleNamespace

import pytest
from mpi4py import MPI
from runs import ROOT, TWO_ARM
from solids import solid_scene

from dolfinopt.arms.arm import build_arms
from dolfinopt.errors import InputError
from dolfinopt.fem import interior
from dolfinopt.fem.interior import InteriorSystem
from dolfinopt.mesh import budget
from dolfinopt.mesh.budget import check_budget, free_memory
from dolfinopt.parallel import partition_arms
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Arm, load_scene, scene_from_dict

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize(
    "override",
    ["arms.cells=[100000,100000]", ["arms.mesh=meshes/arm_bores.geo", "arms.mesh_size=1e-6"]],
)
def test_what_exceeds_the_memory_is_refused(override):
    scene = load_scene(TWO_ARM, [override] if isinstance(override, str) else override)
    for attempt in (
        lambda: check_budget(COMM, scene),
        lambda: build_arms(scene, partition_arms(COMM, scene.cell_counts), Profile()),
    ):
        with pytest.raises(InputError) as caught:
            attempt()
        assert re.search(
            r"two_arm.toml: about \S+ cells need \S+ GB of memory, where \S+ GB are free, and "
            r"\S+ days for every iteration; take fewer arms.cells",
            str(caught.value),
        )


@pytest.mark.parametrize(("free", "fits"), [(2.6e9, True), (2.0e9, False)])
def test_estimate_is_what_was_measured(monkeypatch, free, fits):
    """2.28 GB beyond the libraries for two arms of 1600 x 96 cells on one rank."""
    monkeypatch.setattr(budget, "free_memory", lambda: free + budget.PROCESS * (COMM.size - 1))
    scene = load_scene(TWO_ARM, ["arms.cells=[1600,96]"])
    if fits:
        check_budget(COMM, scene)
        return
    with pytest.raises(InputError, match=re.escape("about 3.07e+05 cells need 2.")):
        check_budget(COMM, scene)


@pytest.mark.parametrize(("free", "fits"), [(3.4e9, True), (2.6e9, False)])
def test_quadratic_elements_count_their_nodes(monkeypatch, free, fits):
    """As many nodes as of four times the cells, and 1.3 times the memory."""
    monkeypatch.setattr(budget, "free_memory", lambda: free + budget.PROCESS * (COMM.size - 1))
    scene = load_scene(TWO_ARM, ["arms.cells=[800,48]", "arms.element=quadratic"])
    if fits:
        check_budget(COMM, scene)
        return
    with pytest.raises(InputError, match=re.escape("about 7.68e+04 cells need 3.")):
        check_budget(COMM, scene)


@pytest.mark.serial
@pytest.mark.parametrize(("free", "fits"), [(9.5e9, True), (8e9, False)])
def test_solids_with_conjugate_gradients(monkeypatch, free, fits):
    """8.2 GB for a link of 996 000 degrees of freedom on one rank."""
    monkeypatch.setattr(budget, "free_memory", lambda: free)
    scene = solid_scene(cells=(360, 36, 24))
    if fits:
        check_budget(COMM, scene)
        return
    with pytest.raises(InputError, match=re.escape("about 3.11e+05 cells need 9.02 GB")):
        check_budget(COMM, scene)


@pytest.mark.serial
@pytest.mark.parametrize(
    ("keys", "gigabytes"),
    [  # of 16 755 cells; the estimate of their number is 19 200
        (["simulation.stiffening=auto"], 3.25),
        (["simulation.stiffening=false"], 1.04),
        (["simulation.stiffening=true", "arms.0.element=linear"], 0.46),
    ],
)
def test_cells_of_files_that_are_all_different_count_as_measured(
    monkeypatch, tmp_path, keys, gigabytes
):
    """Tetrahedra of a bar 0.5 x 0.04 x 0.02 m with sides of 5 mm; the estimate is on the safe side.

    Cells of 2 mm, 15.6 times as many: few enough of none.
    """
    (tmp_path / "bar.step").write_text("")
    demo = load_scene(ROOT / "demos" / "spatial_arm.toml").to_tree()
    arm = next(a for a in demo["arms"] if a["cells"] and not a["rigid"])
    at = demo["arms"].index(arm)
    for one in demo["arms"]:
        one["rigid"] = one is not arm
        one["design"] = None
    size = {"length": 0.5, "height": 0.04, "thickness": 0.02, "cells": None, "extruded": False}
    mesh = {"mesh": str(tmp_path / "bar.step"), "mesh_size": 2e-3, "cell_shape": "tetrahedron"}
    demo["arms"][at] = arm | size | mesh
    scene = scene_from_dict(demo, overrides=[key.replace("arms.0", f"arms.{at}") for key in keys])
    assert scene.cell_counts == {at: 300_000}
    needed = gigabytes * 1e9 / 16_755 * 300_000
    for share, fits in ((0.95, False), (1.3, True)):
        monkeypatch.setattr(budget, "free_memory", lambda share=share: share * needed)
        if fits:
            check_budget(COMM, scene)
        else:
            with pytest.raises(InputError, match="of memory"):
                check_budget(COMM, scene)


def test_cells_of_files_are_estimated():
    keys = {"name": "a", "length": 1.0, "height": 0.06, "thickness": 0.01}
    assert Arm(**keys, mesh="a.step").n_cells == 2400  # a twelfth of the height
    assert Arm(**keys, mesh="a.step", mesh_size=1e-3).n_cells == 60_000
    triangles = Arm(**keys, mesh="a.geo", mesh_size=1e-3, cell_shape="triangle")
    assert triangles.n_cells == 120_000
    assert Arm(**keys, mesh="a.geo").n_cells == 0
    assert Arm(**keys, cells=(7, 3)).n_cells == 21


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


@pytest.mark.serial
def test_free_memory(tmp_path):
    proc, cgroup = tmp_path / "proc", tmp_path / "cgroup"
    assert free_memory(proc, cgroup) == math.inf
    write(proc / "meminfo", "MemTotal: 8000000 kB\nMemAvailable:    4000000 kB\n")
    assert free_memory(proc, cgroup) == 4000000 * 1024
    write(proc / "self" / "cgroup", "0::/outer/inner\n")
    assert free_memory(proc, cgroup) == 4000000 * 1024
    for folder, limit, used in (("outer", "3000", "1000"), ("outer/inner", "max", "500")):
        write(cgroup / folder / "memory.max", f"{limit}\n")
        write(cgroup / folder / "memory.current", f"{used}\n")
        write(cgroup / folder / "memory.stat", "anon 5\ninactive_file 100\n")
    assert free_memory(proc, cgroup) == 2100
    write(proc / "self" / "cgroup", "9:cpu:/a\n4:memory:/host/path\n")
    write(cgroup / "memory" / "memory.limit_in_bytes", "1000")
    write(cgroup / "memory" / "memory.usage_in_bytes", "1200")
    write(cgroup / "memory" / "memory.stat", "total_inactive_file 50\n")
    assert free_memory(proc, cgroup) == 0


@pytest.mark.serial
def test_command_ends_before_it_writes(tmp_path):
    words = [sys.executable, "-m", "dolfinopt", "optimize", TWO_ARM, "--out", tmp_path / "out"]
    words += ["--set", "arms.cells=[100000,100000]"]
    run = subprocess.run(list(map(str, words)), capture_output=True, text=True)
    assert run.returncode == 2 and not (tmp_path / "out").exists()
    assert len(run.stderr.splitlines()) == 1 and "GB are free" in run.stderr


@pytest.mark.serial
def test_arms_on_several_ranks_share_the_memory(monkeypatch):
    """A factor of 1.5 GB where 4 GB are free: by factors on one rank, beside five others not."""
    arm = SimpleNamespace(_T=SimpleNamespace(comm=MPI.COMM_SELF, num_dofs=100_000))
    monkeypatch.setattr(interior, "free_memory", lambda: 4e9)
    for ranks, short in ((1, False), (6, True)):
        monkeypatch.setenv("OMPI_COMM_WORLD_LOCAL_SIZE", str(ranks))
        assert InteriorSystem._memory_is_short(arm) is short
