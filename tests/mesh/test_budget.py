"""What does not fit the memory is refused before it is meshed."""

import math
from types import SimpleNamespace

import pytest
from mpi4py import MPI
from runs import TWO_ARM, overrides, refusal, run
from solids import solid_scene

from dolfinopt.arms.arm import build_arms
from dolfinopt.errors import InputError
from dolfinopt.fem import interior
from dolfinopt.mesh import budget
from dolfinopt.mesh.budget import check_budget, free_memory
from dolfinopt.parallel import partition_arms
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Arm, read_scene

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize(
    "changes",
    [["arms.cells=[100000,100000]"], ["arms.mesh=meshes/arm_bores.geo", "arms.mesh_size=1e-6"]],
)
def test_what_exceeds_the_memory_is_refused(changes, shared_tmp_path):
    scene = read_scene(TWO_ARM, changes)
    out = shared_tmp_path / "out"
    for attempt in (
        lambda: check_budget(COMM, scene),
        lambda: build_arms(scene, partition_arms(COMM, scene.cell_counts), Profile()),
        lambda: run("optimize", TWO_ARM, "--out", out, *overrides(*changes)),
    ):
        refusal(attempt, "two_arm.toml", "GB of memory", "GB are free", "arms.cells")
    assert not out.exists()


@pytest.mark.parametrize(
    ("make", "low", "high", "words"),
    [
        # 2.28 GB beyond the libraries for two arms of 1600 x 96 cells on one rank.
        (lambda: read_scene(TWO_ARM, ["arms.cells=[1600,96]"]), 2.0, 2.6, "3.07e+05 cells"),
        # As many nodes as of four times the cells, and 1.3 times the memory.
        (lambda: read_scene(TWO_ARM, ["arms.cells=[800,48]", "arms.element=quadratic"]),
         2.0, 3.4, "7.68e+04 cells"),
        # By conjugate gradients 8.2 GB for a link of 996 000 degrees of freedom.
        pytest.param(lambda: solid_scene(cells=(360, 36, 24)), 8.0, 9.5, "3.11e+05 cells",
                     marks=pytest.mark.serial),  # ranks share it otherwise
    ],
    ids=["plane", "quadratic", "solid"],
)  # fmt: skip
def test_estimate_is_what_was_measured(monkeypatch, make, low, high, words):
    scene = make()
    room = budget.RANK_BYTES * (COMM.size - 1)
    monkeypatch.setattr(budget, "free_memory", lambda: 1e9 * high + room)
    check_budget(COMM, scene)
    monkeypatch.setattr(budget, "free_memory", lambda: 1e9 * low + room)
    refusal(lambda: check_budget(COMM, scene), words)


@pytest.mark.serial
@pytest.mark.parametrize(
    ("stiffening", "element", "gigabytes"),  # of 16 755 cells; the estimate of their number: 19 200
    [("auto", "quadratic", 1.74), (False, "quadratic", 1.26), (True, "linear", 0.46)],
)
def test_cells_of_files_count_as_measured(monkeypatch, tmp_path, stiffening, element, gigabytes):
    """Tetrahedra of a bar, all different; 15.6 times as many, few enough of none."""
    (tmp_path / "bar.step").write_text("")
    mesh = {"mesh": str(tmp_path / "bar.step"), "mesh_size": 2e-3, "cell_shape": "tetrahedron"}
    scene = solid_scene(cells=None, stiffening=stiffening, element=element, **mesh)
    assert scene.cell_counts == {0: 300_000}
    needed = gigabytes * 1e9 / 16_755 * 300_000
    monkeypatch.setattr(budget, "free_memory", lambda: 1.3 * needed)
    check_budget(COMM, scene)
    monkeypatch.setattr(budget, "free_memory", lambda: 0.95 * needed)
    refusal(lambda: check_budget(COMM, scene), "of memory")


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
def test_arms_on_several_ranks_share_the_memory(monkeypatch):
    """A factor of 1.5 GB where 4 GB are free: fits on one rank, beside five others not."""
    layout = SimpleNamespace(comm=MPI.COMM_SELF, num_rows=100_000, name="link")
    monkeypatch.setattr(interior, "free_memory", lambda: 4e9)
    interior._check_factor(layout)
    monkeypatch.setenv("OMPI_COMM_WORLD_LOCAL_SIZE", "6")
    with pytest.raises(InputError, match=r"takes about 1\.5 GB"):
        interior._check_factor(layout)
