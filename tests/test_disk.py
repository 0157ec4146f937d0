"""Disks that are full, and file systems without locks: one line, and nothing half-written."""

import errno
import fcntl
import io
import os
import re
import subprocess
import zipfile

import click
import numpy as np
import pytest
from mpi4py import MPI
from runs import ROOT, TWO_ARM, command, environment, overrides, refusal, run

import dolfinopt as do
from dolfinopt import disk
from dolfinopt.cli.studies import _write_question
from dolfinopt.data import paper_scene
from dolfinopt.disk import append_text, working_in, write_text
from dolfinopt.errors import InputError, OutputError
from dolfinopt.mesh import compat
from dolfinopt.output import checkpoint
from dolfinopt.parallel import abort_together
from dolfinopt.scene.load import read_scene
from dolfinopt.study.cases import Case, run_cases
from dolfinopt.study.uncertainty import sample_cases

ROUGH = ("arms.cells=[12,3]", "simulation.sample=0.01", "simulation.tolerance=1e-2")
COMM, SELF = MPI.COMM_WORLD, MPI.COMM_SELF
COARSE = ("arms.cells=[12,3]", "design.filter_radius=0.2", "optimizer.max_iterations=2")


def full(*arguments, **options):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.fixture
def small_files():
    """Let files of this process grow to no more than 4 kB, as on a disk with no more room."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize(
    "write",
    [
        lambda path: write_text(path, 5000 * "x"),
        lambda path: disk.write_arrays(path, {"a": np.arange(5000.0)}),
        lambda path: append_text(path, 5000 * "x"),
    ],
    ids=["text", "arrays", "append"],
)
def test_what_does_not_fit_leaves_what_was_there(write, tmp_path, small_files):
    path = tmp_path / "file"
    write_text(path, "before\n")
    not_written(lambda: write(path), "file", "File too large", "make room")
    assert path.read_text() == "before\n"
    assert [one.name for one in tmp_path.iterdir()] == ["file"]


def not_written(write, *words):
    with pytest.raises(OutputError) as caught:
        write()
    assert all(word in str(caught.value) for word in words)


@pytest.mark.parametrize("step", ["open", "fsync", "replace"])
def test_every_step_of_writing(step, tmp_path, monkeypatch):
    path = tmp_path / "file"
    write_text(path, "before\n")
    if step == "open":
        monkeypatch.setattr(disk, "open", full, raising=False)
    else:
        monkeypatch.setattr(os, step, full)
    not_written(lambda: write_text(path, "after\n"), "No space left on device")
    monkeypatch.undo()
    assert path.read_text() == "before\n" and len(list(tmp_path.iterdir())) == 1
    words = "a: ", "Not a directory", "a folder"
    not_written(lambda: disk.make_folder(path / "a"), *words)


def test_errors_of_a_format_are_not_the_disks(tmp_path):
    def write(stream):
        raise OSError("no such format")

    with pytest.raises(OSError, match="no such format"):
        disk.write_atomically(tmp_path / "picture", write)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.serial
@pytest.mark.parametrize("after", [0, 2, 3, 5])
def test_a_full_disk_ends_a_run_in_one_line(after, tmp_path, monkeypatch, capsys):
    """Whichever file does not fit: status 1, no results, and a checkpoint one can go on."""
    sync, calls = os.fsync, []

    def fsync(number):
        calls.append(number)
        if len(calls) > after:
            full()
        sync(number)

    words = ["optimize", paper_scene(), *overrides(*COARSE), "--out", tmp_path, "--no-plots"]
    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(SystemExit) as ending, abort_together(SELF):
        run(*words, world=SELF)
    monkeypatch.undo()
    assert ending.value.code == 1
    told = capsys.readouterr().err
    (line,) = re.findall(r"^dolfinopt: (?!warning: ).*$", told, re.M)
    assert "No space left on device" in line and "make room" in line and "Traceback" not in told
    assert {path.name for path in tmp_path.iterdir()} <= {"history.csv", checkpoint.NAME}
    if after > 0:
        checkpoint.check(tmp_path, read_scene(paper_scene(), COARSE))


@pytest.mark.serial  # it starts a process
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_standard_output_without_room(tmp_path):
    line = command("simulate", paper_scene(), "--no-plots", "--out", tmp_path)
    line += overrides(*COARSE[:2])
    with open("/dev/full", "w") as nowhere:
        done = subprocess.run(line, stdout=nowhere, stderr=subprocess.PIPE, text=True, timeout=120)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "standard output: No space left on device" in done.stderr.splitlines()[-1]


def without(number):
    def lock(*arguments):
        raise OSError(number, os.strerror(number))

    return lock


def test_a_file_system_without_locks_is_told(tmp_path, monkeypatch, capsys):
    """That is not a lock which another holds."""
    for number in disk.ABSENT:
        monkeypatch.setattr(fcntl, "lockf", without(number))
        with working_in(tmp_path):
            (line,) = capsys.readouterr().err.splitlines()
        assert f"has no locks ({os.strerror(number)}); continuing without" in line
    for number in disk.HELD:
        monkeypatch.setattr(fcntl, "lockf", without(number))
        with pytest.raises(InputError, match="another run works in this folder"):
            working_in(tmp_path).__enter__()
    monkeypatch.setattr(fcntl, "lockf", without(errno.EIO))
    with pytest.raises(OutputError, match="Input/output error"):
        working_in(tmp_path).__enter__()


def test_studies_without_locks(shared_tmp_path, monkeypatch, capsys):
    """It hung: a lock that is missing was taken for one that somebody holds."""
    monkeypatch.setattr(fcntl, "lockf", without(errno.ENOTSUP))
    scene = read_scene(paper_scene(), COARSE)
    outcomes = run_cases([Case(scene)], shared_tmp_path, COMM, shown=False)
    assert outcomes.computed == 1 and not outcomes.failures
    samples = sample_cases(scene, [(), ("payload.mass=5.0",), ("payload.mass=7.0",)], "", None)
    assert run_cases(samples, shared_tmp_path, COMM, shown=False).computed == 3
    assert capsys.readouterr().err.count("continuing without") == 2 * (COMM.rank == 0)


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize(("name", "value"), [("NUMERICS", -1), ("__version__", "0.0.0")])
def test_results_of_another_program_are_computed_anew(name, value, tmp_path, monkeypatch):
    scene = read_scene(paper_scene(), COARSE)

    def computed():
        samples = sample_cases(scene, [(), ("payload.mass=5.0",)], "", None)
        return run_cases([Case(scene), *samples], tmp_path, SELF, shown=False).computed

    assert computed() == 3
    assert computed() == 0
    with monkeypatch.context() as other:
        other.setattr(f"dolfinopt.version.{name}", value)
        assert computed() == 3
        checkpoint.begin(tmp_path, scene)
    with pytest.raises(InputError, match="another version of dolfinopt wrote this checkpoint"):
        checkpoint.check(tmp_path, scene)
    assert computed() == 0  # those of this program are still there


def npz_with_header(path, arrays, name, shape):
    """Write an .npz in which one array's header tells of a shape that the file does not hold."""
    with zipfile.ZipFile(path, "w") as archive:
        for key, value in arrays.items():
            stream = io.BytesIO()
            if key == name:
                header = {"descr": "<f8", "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(stream, header)
            else:
                np.lib.format.write_array(stream, value)
            archive.writestr(f"{key}.npy", stream.getvalue())


@pytest.fixture(scope="module")
def design(tmp_path_factory):
    """The arrays of a design.npz."""
    folder = tmp_path_factory.mktemp("design")
    run("simulate", TWO_ARM, *overrides(*ROUGH), "--no-plots", "--out", folder)
    with np.load(folder / "design.npz") as data:
        return dict(data)


@pytest.mark.serial
@pytest.mark.parametrize(
    ("kind", "word"),
    [("npy", ".npz file"), ("8 TiB", ".npz file"), ("complex", "complex128"), ("text", "<U3"),
     ("pipe", "no regular file")],
)  # fmt: skip
def test_designs_that_are_none(design, tmp_path, kind, word):
    path = tmp_path / "design.npz"
    if kind == "npy":
        np.lib.format.write_array(path.open("wb"), np.zeros(3))
    elif kind == "8 TiB":
        npz_with_header(path, design, "arm1/density", (2**40,))
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        change = {"complex": lambda x: x + 1j, "text": lambda x: np.full(x.shape, "0.5")}[kind]
        np.savez(path, **design | {"arm1/density": change(design["arm1/density"])})
    line = ["simulate", TWO_ARM, *overrides(*ROUGH), "--design", path, "--out", tmp_path / "o"]
    refusal(lambda: run(*line), str(path), word)
    assert not (tmp_path / "o").exists()


@pytest.mark.serial
def test_densities_from_python(design):
    """Rounding beyond 1 does no harm; complex numbers and more than rounding are refused."""
    model = do.Model(TWO_ARM, *ROUGH)
    full = {name: np.ones(36) for name in ("arm1", "arm2")}
    expected = model.simulate(full).compliance
    assert model.simulate({k: x + 1e-12 for k, x in full.items()}).compliance == expected
    for x, word in ((1.0 + 1e-6, "lie in"), (-0.1, "lie in"), (1.0 + 1j, "complex128")):
        wrong = full | {"arm2": np.full(36, x)}
        refusal(lambda: model.simulate(wrong), "arm 'arm2'", word)  # noqa: B023


@pytest.mark.serial
def test_edited_checkpoints(tmp_path):
    words = ("optimize", TWO_ARM, *overrides(*ROUGH), "--no-plots", "--out", tmp_path)
    run(*words, "--set", "optimizer.max_iterations=1")
    path = tmp_path / checkpoint.NAME
    with np.load(path) as data:
        arrays = dict(data)
    for key in ("memory", "another"):
        np.savez(path, **arrays | {key: np.zeros((2, 2, 2))})
        line = *words, "--set", "optimizer.max_iterations=2", "--resume"
        refusal(lambda: run(*line), checkpoint.NAME, "cannot read")  # noqa: B023


def test_a_pipe_is_no_scene_and_a_device_no_folder_for_forms(tmp_path, monkeypatch):
    """Opening a pipe would wait for ever."""
    path = tmp_path / f"{COMM.rank}.toml"
    os.mkfifo(path)
    refusal(lambda: read_scene(path), str(path), "no regular file")
    monkeypatch.setenv("XDG_CACHE_HOME", "/dev/null")
    compat.check_form_cache.cache_clear()
    refusal(compat.check_form_cache, "/dev/null", "XDG_CACHE_HOME")
    compat.check_form_cache.cache_clear()


@pytest.mark.serial
@pytest.mark.parametrize("name", ["pydantic", "scipy"])
def test_a_package_that_is_missing_is_named(tmp_path, name):
    """Before MPI is started, and after."""
    text = f"raise ModuleNotFoundError('No module named {name}', name={name!r})\n"
    (tmp_path / f"{name}.py").write_text(text)
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    line = command("simulate", TWO_ARM, "--out", tmp_path / "o")
    env = environment() | {"PYTHONPATH": path}
    done = subprocess.run(line, env=env, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1 and done.stderr.count("\n") == 1
    assert name in done.stderr and "not installed" in done.stderr


def test_question_on_a_full_disk(tmp_path, small_files):
    question = {"scene": 5000 * "x"}
    not_written(lambda: _write_question(tmp_path, "sweep", question, []), "sweep.json")
    assert not list(tmp_path.iterdir())


def test_an_empty_path_is_refused():
    for option in ("--out", "--design"):
        with pytest.raises(click.UsageError, match="expected a path, found nothing"):
            run("simulate", TWO_ARM, option, "")
