"""The command line: files, exit status, and one line for whatever the user got wrong."""

import re
import shutil
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
from machines import controlled, loop
from mpi4py import MPI
from runs import (
    ROOT,
    TWO_ARM,
    by_root,
    contents,
    environment,
    overrides,
    refusal,
    run,
    shell,
    summary_of,
)
from scipy.io import loadmat

import dolfinopt as do
from dolfinopt.cli.shared import in_words, progress
from dolfinopt.disk import RUN
from dolfinopt.optimization.state import HistoryRow
from dolfinopt.output.folders import RUN_FILES
from dolfinopt.part.folder import toml_text
from dolfinopt.progress import log, show_slow_work

TINY = overrides("arms.cells=[12,3]", "simulation.sample=0.01", "simulation.tolerance=1e-2")
SMALL = overrides("arms.cells=[40,4]", "simulation.sample=0.005")
WORLD = MPI.COMM_WORLD


@pytest.fixture(scope="module")
def optimised(folder):
    """A short optimisation's folder, with pictures."""
    out = folder / "out"
    run("optimize", TWO_ARM, *SMALL, "--set", "optimizer.max_iterations=3", "--out", out)
    return out


@pytest.mark.serial  # ranks have no part in it
def test_pictures_are_drawn_anew(optimised):
    """The same again, the animation on request only; they are part of the time one waited."""
    seconds = summary_of(optimised)["seconds"]
    assert seconds["pictures"] > 0.0
    assert seconds["total"] >= sum(s for name, s in seconds.items() if name != "total")
    again = shutil.copytree(optimised, optimised.parent / "animated")
    for name in ("stress.png", "design.png"):
        (again / name).unlink()
    run("plot", again, "--animation")
    assert (again / "motion.gif").stat().st_size > 10_000
    assert (again / "stress.png").stat().st_size > 5_000
    assert (again / "design.png").read_bytes() == (optimised / "design.png").read_bytes()


def test_optimize_writes_every_file(optimised):
    """And --overwrite knows them all; the design has a density at every cell's centroid."""
    expected = """checkpoint.npz design.npz design.png design.vtu deviation.png
        history.csv history.png machine.png stress.png summary.json trajectory.csv trajectory.npz
        budget.csv"""
    assert {path.name for path in optimised.iterdir()} == set(expected.split()) <= set(RUN_FILES)
    with np.load(optimised / "design.npz") as design:
        arrays = {f"arm{k}/{v}" for k in (1, 2) for v in ("centroid", "density")}
        assert set(design.files) == {"units", *arrays}
        assert design["units"].tolist() == ["centroid: m", "density: -"]
        centroid, density = design["arm1/centroid"], design["arm1/density"]
    assert centroid.shape == (160, 2) and density.shape == (160,)
    assert 0.0 <= density.min() and density.max() <= 1.0
    # Half a cell from the ends and edges.
    np.testing.assert_allclose(centroid.min(axis=0), [0.0125, -0.0225], atol=1e-12)
    np.testing.assert_allclose(centroid.max(axis=0), [0.9875, 0.0225], atol=1e-12)


def test_trajectory_files(optimised):
    with np.load(optimised / "trajectory.npz") as data:
        shapes = {key: data[key].shape for key in data.files}
        deviation, compliance, t = data["deviation"], data["compliance"], data["t"]
        q_r, q_e, forces = data["q_r"], data["q_e"], data["joint_forces"]
        units = dict(text.split(": ", 1) for text in data["units"].tolist())
    assert units["deviation"] == "m" and units["joint_forces"] == "N, N m, N m"
    assert set(units) == set(shapes) - {"units"}
    columns = {"q_r": 3, "q_e": 8, "deviation": 2, "compliance": 2, "joint_forces": 3}
    columns |= {"initial_deviation": 2}
    shaped = {k: (601, n) for k, n in columns.items()} | {"t": (601,), "rotation": (601,)}
    assert shapes == shaped | {"units": (8,)}
    lines = (optimised / "trajectory.csv").read_text().splitlines()
    assert lines[0].startswith("t,deviation_x,deviation_y,deviation,compliance,q_r_cart,")
    table = np.genfromtxt(optimised / "trajectory.csv", delimiter=",", names=True)
    np.testing.assert_allclose(table["t"], t, atol=1e-12)
    # Ten digits are written.
    np.testing.assert_allclose(table["deviation_x"], deviation[:, 0], atol=1e-11)
    np.testing.assert_allclose(table["deviation_y"], deviation[:, 1], atol=1e-11)
    np.testing.assert_allclose(table["compliance"], compliance.sum(axis=1), atol=1e-9)
    np.testing.assert_allclose(table["compliance_arm2"], compliance[:, 1], atol=1e-9)
    for k, name in enumerate(("cart", "arm1", "arm2")):
        np.testing.assert_allclose(table[f"q_r_{name}"], q_r[:, k], rtol=1e-9)
        np.testing.assert_allclose(table[f"joint_force_{name}"], forces[:, k], atol=1e-7)
    np.testing.assert_allclose(table["q_e_arm2_4"], q_e[:, 7], atol=1e-9)
    units = summary_of(optimised)["units"]["trajectory.csv"]
    assert list(units) == lines[0].split(",")
    assert units["joint_force_cart"] == "N" and units["joint_force_arm2"] == "N m"


def test_history_ends_in_the_summary(optimised):
    lines = (optimised / "history.csv").read_text().splitlines()
    header = "iteration,objective,max_deviation,grayness,volume_fraction,change,seconds,kkt,"
    header += "merit,volume_fraction_arm1,volume_fraction_arm2,"
    header += "multiplier_volume_fraction_arm1,multiplier_volume_fraction_arm2"
    assert lines[0] == header
    assert [int(line.split(",")[0]) for line in lines[1:]] == [0, 1, 2, 3]
    summary = summary_of(optimised)
    best = lines[1 + summary["best_iteration"]]
    last = dict(zip(header.split(","), map(float, best.split(",")), strict=True))
    assert last["objective"] == min(float(line.split(",")[1]) for line in lines[1:])
    # Simulated again, from another motion: to a tenth of simulation.tolerance.
    assert last["objective"] == pytest.approx(summary["compliance"], rel=1e-5)
    for key in ("objective", "max_deviation", "kkt"):
        assert last[key] == pytest.approx(summary[key], rel=1e-5)
    assert last["grayness"] == pytest.approx(summary["grayness"], rel=1e-9)
    assert summary["iterations"] == 3 and summary["converged"] is False
    assert "max_iterations" in summary["stop_reason"]
    assert 1e-2 < summary["kkt"] < 1.0  # far from an optimum after three iterations
    for name, one in summary["constraints"].items():
        assert one["value"] == pytest.approx(last[name], rel=1e-9)
        assert (one["limit"], one["unit"], one["met"]) == (0.5, "-", True)


def test_simulate_reproduces_the_last_design(optimised, shared_tmp_path):
    design = optimised / "design.npz"
    run("simulate", TWO_ARM, *SMALL, "--design", design, "--out", shared_tmp_path, "--no-plots")
    ours, theirs = map(summary_of, (shared_tmp_path, optimised))
    assert list(theirs["first_frequency"]) == ["arm1", "arm2"]
    # Both simulations are right to simulation.tolerance = 1e-4, on grids of their own.
    for key, error in (("compliance", 2e-4), ("max_deviation", 2e-4), ("first_frequency", 1e-9)):
        assert ours[key] == pytest.approx(theirs[key], rel=error)
    assert not list(shared_tmp_path.glob("*.png"))


@pytest.mark.serial
def test_a_project_can_be_moved(tmp_path):
    """Scene, mesh and run folder together: it resumes and draws; another mesh is refused."""
    there, here = tmp_path / "there", tmp_path / "here"
    there.mkdir()
    shutil.copy(ROOT / "meshes" / "arm_bores.geo", there / "own.geo")
    text = (ROOT / "demos" / "two_arm_bores.toml").read_text()
    text = re.sub(r'mesh = ".*?"', 'mesh = "own.geo"', text)
    (there / "scene.toml").write_text(text)
    small = ["--set", "arms.mesh_size=0.02", "--set", "simulation.sample=0.005", "--no-plots"]
    run("optimize", there / "scene.toml", *small, "--out", there / "results" / "run",
        "--set", "optimizer.max_iterations=1")  # fmt: skip
    assert {"summary.json", "checkpoint.npz"} <= set(contents(there / "results" / "run"))
    shutil.copytree(there, here)
    shutil.rmtree(there)
    resume = ["optimize", here / "scene.toml", *small, "--out", here / "results" / "run",
              "--resume", "--set", "optimizer.max_iterations=2"]  # fmt: skip
    run(*resume)
    assert len((here / "results" / "run" / "history.csv").read_text().splitlines()) == 4
    assert summary_of(here / "results" / "run")["scene"]["arms"][0]["mesh"] == "../../own.geo"
    run("plot", here / "results" / "run")
    # The run's folder alone finds the mesh where it was.
    shutil.copytree(here / "results" / "run", tmp_path / "elsewhere" / "deep" / "run")
    run("plot", tmp_path / "elsewhere" / "deep" / "run")
    with open(here / "own.geo", "a") as stream:
        stream.write("// another\n")
    refusal(lambda: run(*resume), "content of the file arms.arm1.mesh has changed")


@pytest.mark.parametrize(
    ("words", "kind"),
    [
        ([], "esl"),
        (["--set", "objective.gradient=exact"], "exact"),
        (["--set", "objective.gradient=exact", "--kind", "esl"], "esl"),
    ],
)
def test_the_scene_decides_which_gradient(shared_tmp_path, capsys, words, kind):
    def written(name, *more):
        out = shared_tmp_path / "deep" / name
        run("gradient", TWO_ARM, *TINY, *more, "--out", out)
        with np.load(out) as data:
            arrays = {f"arm{k}/{v}" for k in (1, 2) for v in ("centroid", "gradient")}
            assert set(data.files) == {"objective", "units", *arrays} and data["objective"] > 0.0
            return data["arm1/gradient"]

    expected = {one: written(f"{one}.npz", "--kind", one) for one in ("esl", "exact")}
    capsys.readouterr()
    np.testing.assert_array_equal(written("g.npz", *words), expected[kind])
    assert not np.allclose(expected["esl"], expected["exact"], rtol=0.1)
    assert (expected["esl"] < 0.0).all()  # under frozen loads more material is always stiffer
    if WORLD.rank == 0:
        assert f"{kind} gradient in" in capsys.readouterr().out


USED = {
    "optimize": ["optimize", TWO_ARM, "--set", "optimizer.max_iterations=1", "--no-plots"],
    "simulate": ["simulate", TWO_ARM, "--no-plots"],
    "export": ["export", TWO_ARM],
    "gradient": ["gradient", TWO_ARM],
}


@pytest.mark.parametrize("name", USED)
def test_results_are_replaced_only_when_asked(shared_tmp_path, name):
    """A used folder is refused; --overwrite removes what the program itself has left there."""
    folder = shared_tmp_path / "o"
    line = [*USED[name], *TINY, "--out", folder / "g.npz" if name == "gradient" else folder]
    run(*line)
    before = contents(folder)
    message = refusal(lambda: run(*line), "holds results already", "--overwrite")
    assert ("--resume" in message) == (name == "optimize")
    assert contents(folder) == before
    stale = ("design.png", "motion.gif", "notes.txt", "mine.png")
    by_root(lambda: [(folder / one).write_bytes(b"old") for one in stale])
    run(*line, "--overwrite")
    # The user's own, and pictures beside the files of commands that draw none.
    kept = stale if name in ("export", "gradient") else stale[2:]
    assert set(contents(folder)) == {*before, *kept}


@pytest.mark.serial
def test_a_run_that_cannot_begin_leaves_the_old_results(shared_tmp_path):
    """--overwrite removes nothing before the arms are built; a new folder is not left."""
    folder, mesh = shared_tmp_path / "o", shared_tmp_path / "bad.geo"
    line = ["optimize", TWO_ARM, "--set", "optimizer.max_iterations=1", "--no-plots"]
    run(*line, *TINY, "--out", folder)
    before = contents(folder)
    mesh.write_text("x = = 1;\n")
    line += ["--set", f"arms.mesh={mesh}", "--out"]
    refusal(lambda: run(*line, folder, "--overwrite"), "bad.geo")
    assert contents(folder) == before
    new = shared_tmp_path / "new"
    refusal(lambda: run(*line, new), "bad.geo")
    assert not new.exists()


HOLDER = """
import pathlib, sys
from dolfinopt.disk import working_in
with working_in(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.readline()
"""


@pytest.mark.serial
@pytest.mark.parametrize("command", ["optimize", "simulate"])
def test_one_run_at_a_time_in_a_folder(optimised, tmp_path, command):
    """Two runs with --overwrite, or --resume, wrote one history between them."""
    folder = shutil.copytree(optimised, tmp_path / "o")
    before = set(contents(folder))
    line = [command, TWO_ARM, *SMALL, "--out", folder, "--no-plots"]
    line += ["--set", "optimizer.max_iterations=3"]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    other = subprocess.Popen([sys.executable, "-c", HOLDER, folder], **pipes)
    assert other.stdout.readline() == "held\n"
    for how in ("--overwrite", *(["--resume"] if command == "optimize" else [])):
        refusal(lambda: run(*line, how), "another run", "wait")  # noqa: B023
    assert set(contents(folder)) == before | {RUN}
    other.kill()  # whoever is killed holds nothing any more
    other.communicate()
    run(*line, "--overwrite")
    assert RUN not in contents(folder)


@pytest.mark.serial
def test_python_does_not_replace_results_either(tmp_path):
    model = do.Model(TWO_ARM, *TINY[1::2], "optimizer.max_iterations=1")
    model.optimize(tmp_path)
    before = (tmp_path / "history.csv").read_bytes()
    for again in (model.optimize, partial(do.optimize, model.scene)):
        refusal(lambda: again(tmp_path), "holds results already")  # noqa: B023
    assert (tmp_path / "history.csv").read_bytes() == before
    assert model.optimize(tmp_path, overwrite=True).iterations == 1
    refusal(lambda: model.optimize(tmp_path, overwrite=True, resume=True), "only one")


@pytest.mark.serial
@pytest.mark.parametrize("command", ["optimize", "simulate"])
def test_files_that_the_scene_reads_stay(tmp_path, command):
    table = tmp_path / "trajectory.csv"
    table.write_text("t, x, y\n0, -0.9, 0\n1, 0, 0.5\n1.9, 0.9, 0\n")
    before = contents(tmp_path)
    line = [command, TWO_ARM, *TINY, *overrides("motion.path=points", f"motion.file={table}")]
    refusal(lambda: run(*line, "--out", tmp_path, "--overwrite"), "trajectory.csv", "motion.file")
    assert contents(tmp_path) == before


@pytest.mark.parametrize("how", ["--overwrite", "--resume"])
def test_a_run_that_is_killed_leaves_nothing_old(shared_tmp_path, monkeypatch, how):
    """No summary of an earlier run stands beside a new history, which `plot` would mix."""
    from dolfinopt.optimization import iterate

    folder = shared_tmp_path / "o"
    line = ["optimize", TWO_ARM, *TINY, "--no-plots", "--out", folder, "--set"]
    run(*line, "optimizer.max_iterations=1")
    by_root(lambda: (folder / "design.png").write_bytes(b"old"))

    def killed(*_):
        raise RuntimeError("killed")

    monkeypatch.setattr(iterate.Iterate, "step", killed)
    with pytest.raises(RuntimeError, match="killed"):
        run(*line, "optimizer.max_iterations=3", how)
    WORLD.barrier()
    assert set(contents(folder)) == {"checkpoint.npz", "history.csv"}
    refusal(lambda: run("plot", folder), "summary.json")


# Words of the command line (OUT: its folder), and words of the message.
BAD = [
    ("optimize SCENE --set payload.mas=1", "payload.mas payload.mass"),
    ('optimize SCENE --set payload.mass="six"', "payload.mass six number"),
    ("optimize SCENE --set motion.radius=5", "at t = shoulder 5"),
    ("optimize OUT/no.toml", "no.toml"),
    ("optimize OUT", "OUT"),
    ("optimize SCENE --out /proc/nowhere/o", "/proc/nowhere/o --out"),
    ("optimize SCENE --resume", "checkpoint.npz --resume"),
    ("simulate SCENE --design OUT/no.npz", "no.npz"),
    ("simulate SCENE --design SCENE", "SCENE .npz"),
    ("plot OUT", "summary.json"),
    ("gradient SCENE --out OUT", "OUT --out"),
    ("optimize SCENE --nonsense", "--nonsense"),
    ("optimise SCENE", "optimise"),
]


@pytest.mark.parametrize(("line", "words"), BAD)
def test_bad_input_is_one_line(line, words, shared_tmp_path):
    def filled(text):
        places = {"SCENE": str(TWO_ARM), "OUT": str(shared_tmp_path)}
        return [re.sub("SCENE|OUT", lambda m: places[m[0]], word) for word in text.split()]

    arguments = filled(line)
    if len(arguments) > 2 or arguments[0] == "optimize":
        arguments += SMALL
        if "--out" not in arguments:
            arguments += ["--out", shared_tmp_path / "o"]
    refusal(lambda: run(*arguments), *filled(words))
    WORLD.barrier()
    assert not list(shared_tmp_path.iterdir())  # nothing written


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.pop("arm2/density"), ["arm2/density", "missing"]),
        (lambda d: d.update({"arm1/density": d["arm1/density"][:-1]}), ["shape"]),
        (lambda d: d.update({"arm1/density": d["arm1/density"] + 1.0}), ["[0, 1]"]),
        (lambda d: d.update({"arm1/density": d["arm1/density"] * np.nan}), ["nan"]),
        (lambda d: d.update({"arm1/centroid": 2.0 * d["arm1/centroid"]}), ["covers"]),
        (lambda d: d.update({"arm1/centroid": d["arm1/centroid"][:, ::-1]}), ["covers"]),
    ],
)
def test_design_that_does_not_fit(optimised, shared_tmp_path, change, words):
    with np.load(optimised / "design.npz") as data:
        arrays = {key: data[key] for key in data.files}
    change(arrays)
    path, out = shared_tmp_path / "bad.npz", shared_tmp_path / "o"
    by_root(lambda: np.savez(path, **arrays))
    line = ["simulate", TWO_ARM, *SMALL, "--design", path, "--out", out]
    refusal(lambda: run(*line), str(path), *words)
    assert not out.exists()


def test_resume_of_another_scene(optimised):
    line = ["optimize", TWO_ARM, *SMALL, "--set", "payload.mass=7", "--out", optimised, "--resume"]
    refusal(lambda: run(*line), "payload.mass = 6.0", "7.0")


@pytest.mark.serial
@pytest.mark.parametrize("ranks", [0, 2])
@pytest.mark.parametrize(
    ("words", "status", "parts"),
    [
        ([], 0, ["Usage: dolfinopt", "optimize", "simulate", "gradient", "plot"]),
        (["optimize", "--help"], 0, ["Usage: dolfinopt optimize"]),
        (["--version"], 0, ["dolfinopt"]),
        (["optimise", TWO_ARM], 2, ["did you mean optimize?", "(see dolfinopt --help)"]),
        (["optimize", TWO_ARM, "--ot", "x"], 2, ["--ot", "(see dolfinopt optimize --help)"]),
        (["gradient"], 2, ["SCENE", "(see dolfinopt gradient --help)"]),
        (["optimize", TWO_ARM, "--set", "payload.mas=1"], 2, ["unknown key payload.mas;"]),
    ],
)  # fmt: skip
def test_exit_status_and_streams(words, status, parts, ranks):
    """Help with status 0, or one line and status 2, once: from the process, and through mpirun."""
    done = shell(*words, ranks=ranks)
    assert done.returncode == status and "Traceback" not in done.stderr
    assert not (done.stdout if status else done.stderr)
    told = done.stdout if status == 0 else done.stderr
    assert told.count(parts[0]) == 1 and all(part in told for part in parts)
    if status:
        [line] = [one for one in told.splitlines() if parts[0] in one]
        assert line.startswith("dolfinopt: ") and (ranks or told == line + "\n")


@pytest.mark.serial
def test_without_petsc_one_line_says_how_to_get_it(tmp_path):
    # As if it were not installed.
    code = "import sys; sys.modules['petsc4py'] = None; from dolfinopt.cli import main; main()"
    line = [sys.executable, "-c", code, "simulate", str(TWO_ARM), "--out", str(tmp_path / "o")]
    done = subprocess.run(line, capture_output=True, text=True, env=environment(), timeout=60)
    assert done.returncode == 1 and done.stdout == ""
    [line] = done.stderr.splitlines()
    assert "petsc4py" in line and "conda install" in line
    assert not (tmp_path / "o").exists()


@pytest.mark.serial
@pytest.mark.parametrize("stiffening", ["false", "true"])
def test_arm_of_a_file_without_geometric_stiffness(tmp_path, capsys, stiffening):
    """A scene that asks for it hears that the file has none; a file that has it is no news."""
    small = overrides("arms.cells=[20,3]", f"simulation.stiffening={stiffening}")
    run("export", TWO_ARM, *small, "--out", tmp_path / "bodies")
    arm2 = f'name = "arm2"\nsid = "{tmp_path}/bodies/arm2.sid"'
    (tmp_path / "scene.toml").write_text(TWO_ARM.read_text().replace('name = "arm2"', arm2))
    asked = overrides("arms.arm1.cells=[20,3]", "simulation.stiffening=true")
    capsys.readouterr()
    run("export", tmp_path / "scene.toml", *asked, "--out", tmp_path / "out")
    told = capsys.readouterr().err
    assert ("arm2.sid holds no geometric stiffness" in told) == (stiffening == "false")


# -- what is shown while an optimisation runs, and the time it says to have taken  ----------------


@pytest.mark.serial
def test_lines_while_an_optimisation_runs(capsys, monkeypatch):
    monkeypatch.setattr("dolfinopt.progress.SILENT", 0.0)
    for name, value in (("handlers", []), ("propagate", True), ("level", 0)):  # as before, after it
        monkeypatch.setattr(log, name, value)
    show_slow_work()
    say = progress(MPI.COMM_SELF, "optimize")
    say(in_words(HistoryRow(7, 2.5, 0.0075, 0.3, 0.5, 0.2, 1.0), 400))
    assert "dolfinopt: optimize: 7/400 objective 2.5 dev 7.5 mm" in capsys.readouterr().err


# -- the commands on controlled machines and closed loops  ----------------------------------------


QUICK = ["--set", "simulation.tolerance=1e-3"]


@pytest.fixture
def write_scene(write):
    """Return what writes a scene's file on the root; it returns its path."""
    return lambda scene: write("machine.toml", toml_text({"name": scene.name} | scene.to_tree()))


SCENES = {"slider": loop, "pin": lambda: loop("pin"), "control": controlled}


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.parametrize("kind", SCENES)
def test_simulate_draws_and_plot_draws_again(kind, shared_tmp_path, write_scene):
    path, out = write_scene(SCENES[kind]()), shared_tmp_path / "out"
    film = ["--animation"] if kind == "pin" else []
    run("simulate", path, *QUICK, "--out", out)
    pictures = {"design.png", "machine.png", "drives.png", "stress.png"}
    pictures |= set() if film else {"deviation.png"}
    assert {name for name in contents(out) if name.endswith(("png", "gif"))} == pictures
    summary = summary_of(out)
    assert summary["converged"] and summary["ranks"] == WORLD.size
    by_root((out / "drives.png").unlink)
    run("plot", out, *film)
    assert (out / "drives.png").stat().st_size > 5000
    assert (out / "motion.gif").exists() == bool(film)


def test_state_space_of_a_run_and_of_a_scene(shared_tmp_path, capsys, write_scene):
    """Both files hold the same matrices, with names, whatever the ranks; refusals write nothing."""
    path, out = write_scene(controlled()), shared_tmp_path / "run"
    run("simulate", path, *QUICK, "--out", out, "--no-plots")
    run("export", out, "state-space", 3.0)
    run("export", path, *QUICK, "--state-space", 3.0, "--out", shared_tmp_path / "scene")
    folders = (out / "state-space", shared_tmp_path / "scene")
    first, second = (np.load(one / "state_space.npz") for one in folders)
    for key in first.files:  # numbers to rounding: where arrays lie in memory may tell
        a, b = first[key], second[key]
        if a.dtype.kind in "fc":
            assert np.allclose(a, b, rtol=1e-9, atol=1e-12 * np.abs(a).max(initial=0.0))
        else:
            assert np.array_equal(a, b)
    matlab = loadmat(folders[0] / "state_space.mat")
    for key in "ABCD":
        assert np.array_equal(matlab[key], first[key])
    assert [str(one[0]) for one in matlab["inputs"][:, 0]] == list(first["inputs"])
    assert first["A"].shape == (len(first["states"]),) * 2
    if WORLD.rank == 0:
        told = capsys.readouterr().out
        assert "with its control, at 3 s: 22 states, 6 inputs, 7 outputs" in told
        assert f"poles below {float(first['accurate_below']):.4g} Hz hold 1 %" in told
    for words, expected in (
        ([path, "state-space", 5.0], "motion.horizon = 3"),
        ([path, "state-space"], "an instant"),
        ([path, "--below", 100.0], "state-space, not with bodies"),
        ([out, "state-space", 1.0, "--set", "payload.mass=2"], "--set"),
        ([out], "add robot or state-space"),
    ):
        line = ["export", *words, "--out", shared_tmp_path / "none"]
        refusal(lambda line=line: run(*line), expected)
    assert not (shared_tmp_path / "none").exists()


@pytest.mark.slow
@pytest.mark.serial
def test_gradient_of_machines_is_checked(shared_tmp_path, capsys, write_scene):
    """Control's gradient: tests/responses/test_gradients.py."""
    tight = ["--set", "simulation.tolerance=1e-4", "--set", "objective.kind=integral_compliance"]
    out = shared_tmp_path / "gradient.npz"
    run("gradient", write_scene(loop()), *tight, "--kind", "exact", "--check", "--out", out)
    if WORLD.rank == 0:
        table = [line for line in capsys.readouterr().out.splitlines() if "e-" in line]
        rates = [float(line.split()[-1]) for line in table if line.split()[-1][0].isdigit()]
        assert len(rates) == 2
        np.testing.assert_allclose(rates, 2.0, atol=0.05)


def test_a_table_without_a_column_leaves_no_folder(shared_tmp_path, write, write_scene):
    write("drive.csv", "t,cart\n0,0\n1,1")
    line = ["simulate", write_scene(controlled()), "--set", "control.forces=drive.csv", "--out"]
    refusal(lambda: run(*line, shared_tmp_path / "out"), "drive.csv: line 1", "column 'arm1'")
    WORLD.barrier()
    assert not (shared_tmp_path / "out").exists()
