"""What a scene does not need is not done: scene by scene, by the counters of `profile.Counts`.

What they cannot tell, imports and files, is looked at itself. That a part of the program does
nothing twice is tested where that part is.
"""

import ast
import subprocess
import sys
from functools import cache

import numpy as np
import pytest
from mpi4py import MPI
from remainders import build, wave
from runs import ROOT, TWO_ARM, environment, summary_of
from runs import overrides as set_keys
from runs import run as run_command

from dolfinopt.fem import interior
from dolfinopt.output import run_folder as results

WORLD = MPI.COMM_WORLD
# Coarse in space and time: what is counted depends on neither.
QUICK = ("arms.cells=[12,2]", "motion.horizon=2.0", "simulation.sample=0.01",
         "simulation.tolerance=1e-2")  # fmt: skip
ITERATIONS = 2
ARMS, DESIGNS = 2, ITERATIONS + 1  # the last one's gradient tells how far it is from an optimum


@pytest.fixture(scope="module")
def run(folder):
    """Run a command on the small scene with overrides; return its folder. Once for each."""
    made = []

    @cache
    def once(command, *overrides, design=None):
        made.append(folder / str(len(made)))
        line = [command, str(TWO_ARM), "--no-plots", "--out", str(made[-1])]
        line += ["--design", str(design)] if design else []
        line += set_keys(*QUICK, f"optimizer.max_iterations={ITERATIONS}", *overrides)
        run_command(*line)
        return made[-1]

    return once


def counts(folder):
    """Return the counters of a run."""
    return summary_of(folder)["counts"]


EACH = ARMS * DESIGNS  # once for every design of every arm
ONCE = {"assemblies": 2 * EACH, "factorisations": EACH, "reductions": EACH}  # stiffness and mass
# Once a run: whether loads stiffen the arms is estimated by a body with constraint modes, 3 solves,
# and the static fields of its other loads.
LOADS = 7 * ARMS
STILL = {"simulations": 0, "newton_iterations": 0, "adjoints": 0, "reductions": 0}
ONE_ARM = {key: value // ARMS for key, value in ONCE.items()}
SHARED, RIGID = "arms.arm2.design=arm1", "arms.arm1.rigid=true"
EXACT, PERIOD = "objective.gradient=exact", "objective.kind=eigenfrequency"
SOLVED = STILL | {"factorisations": EACH, "eigenproblems": EACH}
EVERYTHING = (EXACT, "constraints.first_frequency=1.0", "constraints.tip_deflection=1.0")
STATIC = STILL | {"assemblies": EACH, "factorisations": EACH, "solves": 3 * EACH}
STATIC |= {"eigenproblems": 0}

CASES = {
    # Nothing twice for one design: a factor an arm and design; frozen loads need no adjoint.
    (): {**ONCE, "eigenproblems": EACH, "simulations": DESIGNS, "adjoints": 0},
    # With everything a scene may ask for the factor is the same; modes are those of the basis, and
    # with what the arm carries. The exact gradient comes after ten iterations at the earliest.
    EVERYTHING: {**ONCE, "eigenproblems": 2 * EACH, "simulations": DESIGNS, "adjoints": 0},
    # q = 3: no eigenproblem, three solves for the constraint modes.
    ("reduction.coordinates=3",): {**ONCE, "eigenproblems": 0, "solves": 3 * EACH + LOADS},
    ("reduction.coordinates=3", EXACT): {**ONCE, "eigenproblems": 0, "solves": 3 * EACH + LOADS},
    ("reduction.method=krylov",): {**ONCE, "eigenproblems": 0, "solves": 4 * EACH + LOADS},
    # Static: no simulation, no basis, no mass matrix, whatever the damping, payload and motion.
    ("objective.kind=static",): STATIC,
    ("objective.kind=static", "constraints.tip_deflection=1.0", EXACT): STATIC,
    # Eigenfrequency: mass, but no simulation and no basis. Three modes of every arm have elastic
    # and kinetic energy, and only the outer arm is carried, as two fields (mass and inertia).
    (PERIOD,): {**SOLVED, "assemblies": 2 * EACH, "energy_fields": (2 * 3 * ARMS + 2) * DESIGNS},
    # Bounded as well as maximised: the same modes.
    (PERIOD, "constraints.first_frequency=1.0"): SOLVED,
    # A shared design: all that concerns one arm alone once.
    (SHARED,): {**ONE_ARM, "eigenproblems": DESIGNS, "simulations": DESIGNS},
    (SHARED, EXACT): {**ONE_ARM, "eigenproblems": DESIGNS, "adjoints": 0},
    (SHARED, "objective.kind=static"): {**STILL, "assemblies": DESIGNS, "solves": 3 * DESIGNS},
    # The two arms carry different things.
    (SHARED, PERIOD): {**SOLVED, "assemblies": 2 * DESIGNS, "factorisations": DESIGNS},
    # A rigid arm has nothing to assemble.
    (RIGID,): {**ONE_ARM, "eigenproblems": DESIGNS, "simulations": DESIGNS},
}


# What ranks add up, and designs that belong to one of them.
ON_RANKS = [(), EVERYTHING, (SHARED, EXACT), (RIGID,)]


@pytest.mark.parametrize(
    "overrides",
    [pytest.param(o, marks=() if o in ON_RANKS else pytest.mark.serial) for o in CASES],
    ids=" ".join,
)
def test_only_what_the_scene_needs(run, overrides):
    found = counts(run("optimize", *overrides))
    expected = CASES[overrides]
    assert {key: found[key] for key in expected} == expected


SPATIAL = ROOT / "demos" / "spatial_arm.toml"
ONE_LOAD, TIP = "objective.loads=[[0,1,0,0,0,0]]", "constraints.tip_deflection=1.0"


@pytest.mark.serial
@pytest.mark.parametrize(
    ("width", "overrides", "most"),
    [
        (10**9, (ONE_LOAD,), 1),
        (0, (ONE_LOAD, TIP), 2),  # one adjoint, unless the link deflects as it is loaded
        # The interior's modes need its own factor.
        (10**9, (ONE_LOAD, "constraints.first_frequency=1.0"), 6),
    ],
    ids=["one load", "deflection", "frequency"],
)
def test_static_loads_of_solids(tmp_path, monkeypatch, width, overrides, most):
    """In space a solve a load, where nothing else is asked for, not one a constraint mode."""
    for bound in ("WIDEST", "WIDEST_OF_STATICS"):
        monkeypatch.setattr(interior, bound, width)
    line = ["optimize", str(SPATIAL), "--no-plots", "--out", str(tmp_path / "out")]
    kept = ("arms.link1.cells=[6,2,2]", "arms.link2.cells=[6,2,2]", "arms.passive=0.08",
            "simulation.sample=0.05", "simulation.tolerance=1e-2", "objective.load_cases=3",
            "objective.kind=static", f"optimizer.max_iterations={ITERATIONS}")  # fmt: skip
    line += set_keys(*kept, *overrides)
    run_command(*line, world=MPI.COMM_SELF)
    found = counts(tmp_path / "out")
    assert found["factorisations"] == EACH and found["reductions"] == 0
    if most < 6:
        # A box is solved without its matrix.
        assert found["assemblies"] == EACH * bool(width) and found["eigenproblems"] == 0
        assert EACH <= found["solves"] <= most * EACH
    else:
        assert found["solves"] >= most * EACH


def test_a_simulation_needs_no_gradient(run):
    found = counts(run("simulate", EXACT))
    assert found["adjoints"] == found["energy_fields"] == 0
    assert found["factorisations"] == ARMS and found["simulations"] == 1


@pytest.mark.parametrize("kind", ["static", "eigenfrequency"])
def test_nothing_moves_unless_asked(kind):
    """No simulation and no reduced model without `simulated`; with it the same objective."""
    built = build(f"objective.kind={kind}")
    x = built.fields(wave)
    still, trajectory = built.evaluate(x)
    assert trajectory is None and np.isnan([still.max_deviation, still.compliance]).all()
    assert all(arm.basis is None for arm in built.arms.values())
    moved, trajectory = built.evaluate(x, simulated=True)
    assert (trajectory is None) == (WORLD.rank != 0)
    assert moved.objective == still.objective and moved.max_deviation > 0.0


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize("gradient", ["esl", "exact"])
def test_load_cases_cost_nothing(run, gradient):
    """From as many as coordinates on their number changes no count but Newton's iterations."""
    kept = ("reduction.coordinates=3", f"objective.gradient={gradient}")
    few, many = (
        counts(run("optimize", *kept, f"objective.load_cases={cases}")) for cases in (3, 200)
    )
    del few["newton_iterations"], many["newton_iterations"]
    assert few == many
    if gradient == "esl":
        assert few["energy_fields"] == 3 * EACH


@cache
def warm_and_cold(run, *overrides):
    """Return what the second design, a small step on, takes in an optimisation, and by itself."""
    small = (*overrides, "optimizer.move=0.02", "simulation.tolerance=1e-5")
    first = counts(run("optimize", *small, "optimizer.max_iterations=0"))
    folder = run("optimize", *small, "optimizer.max_iterations=1")
    both = counts(folder)
    cold = counts(run("simulate", *small, design=folder / "design.npz"))
    return {key: both[key] - first[key] for key in both}, cold


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize(
    "overrides",
    [(), ("reduction.method=modal", "arms.cells=[50,4]"), ("reduction.coordinates=6",)],
    ids=" ".join,
)
def test_modes_and_trajectory_start_from_the_last_designs(run, overrides):
    """Half of Newton's iterations or fewer: from cold it takes a second grid, too."""
    warm, cold = warm_and_cold(run, *overrides)
    assert warm["factorisations"] == cold["factorisations"] == ARMS
    assert 3 * ARMS < warm["solves"] < cold["solves"]
    assert warm["simulations"] == cold["simulations"] == 1
    if not overrides:
        assert 0 < 2 * warm["newton_iterations"] <= cold["newton_iterations"]


# Prints which of the modules it is told are there in the end, whatever the command does.
LOADED = """
import sys
names, sys.argv[1:] = sys.argv[1].split(), sys.argv[2:]
try:
    {}
except SystemExit:
    pass
print([name for name in names if name in sys.modules])
"""
MAIN = "from dolfinopt.cli import main; main()"
DRAW = {"pyvista", "vtkmodules.vtkRenderingCore", "matplotlib", "PIL"}
SOLVE = {"dolfinx", "ufl", "slepc4py", "scipy", "gmsh"}


def loaded(names, code, *arguments):
    """Return which modules a process of its own has imported at its end."""
    line = [sys.executable, "-c", LOADED.format(code), " ".join(names), *map(str, arguments)]
    done = subprocess.run(line, capture_output=True, text=True, env=environment(), timeout=60)
    assert done.returncode == 0, done.stderr
    return set(ast.literal_eval(done.stdout.splitlines()[-1]))


@pytest.mark.serial
def test_model_imports_nothing_of_studies_pictures_and_space():
    """And the package nothing at all."""
    assert loaded(DRAW | SOLVE | {"numpy", "mpi4py"}, "import dolfinopt") == set()
    others = DRAW | {"gmsh", "pandas", "scipy.stats", "dolfinopt.motion.follower"}
    assert loaded(others | {"dolfinx"}, "from dolfinopt import Model") == {"dolfinx"}


# What can be answered before MPI and PETSc are loaded, which takes a second.
WORDS = [
    [], ["--help"], ["--version"], ["optimize", "--help"], ["optimise", TWO_ARM],
    ["optimize", TWO_ARM, "--nonsense"], ["simulate"], ["gradient", TWO_ARM, "--kind", "fast"],
    ["optimize", TWO_ARM, "--set", "payload.mas=1"], ["simulate", "nowhere.toml"],
    ["simulate", TWO_ARM, "--set", "payload.mass=-1"],
]  # fmt: skip
ONE_BY_ONE = """
from dolfinopt.cli import main
for line in {!r}:
    sys.argv[1:] = line
    try:
        main()
    except SystemExit:
        pass
"""


@pytest.mark.serial
def test_words_and_completion_need_no_solver(monkeypatch):
    names = DRAW | SOLVE | {"petsc4py", "mpi4py", "numpy", "click"}
    lines = [[str(word) for word in words] for words in WORDS]
    assert loaded(names, ONE_BY_ONE.format(lines).replace("\n", "\n    ")) == {"click"}
    completion = {"_DOLFINOPT_COMPLETE": "bash_complete", "COMP_WORDS": "dolfinopt opt"}
    for name, value in (completion | {"COMP_CWORD": "1"}).items():
        monkeypatch.setenv(name, value)
    assert loaded(names, MAIN) == {"click"}


@pytest.mark.serial
def test_without_plots_nothing_that_draws_is_imported(tmp_path):
    """Nor anything of other commands: statistics, studies, exports."""
    others = {"plots.design", "plots.curves", "study.studies", "exchange.standard_input"}
    others = {"scipy.stats", *(f"dolfinopt.{name}" for name in others)}
    line = ["optimize", TWO_ARM, "--no-plots", "--out", tmp_path / "out"]
    line += set_keys(*QUICK, "optimizer.max_iterations=1")
    known = {"dolfinx", "pyvista"}  # which writes design.vtu
    assert loaded(DRAW | others | {"dolfinx"}, MAIN, *line) == known


@pytest.mark.slow
@pytest.mark.serial
def test_plane_pictures_need_no_renderer(tmp_path):
    line = ["simulate", TWO_ARM, "--out", tmp_path / "out", *set_keys(*QUICK)]
    assert loaded(DRAW, MAIN, *line) == {"matplotlib", "PIL", "pyvista"}
    line = ["plot", tmp_path / "out", "--animation"]
    assert loaded(DRAW, MAIN, *line) == {"matplotlib", "PIL"}
    assert (tmp_path / "out" / "motion.gif").exists()


def test_nothing_is_drawn_exported_or_gathered_unless_asked(run, monkeypatch):
    """Designs are gathered when they are written, once, not in every iteration."""
    gathered = []
    gather_views = results.gather_views

    def spy(*arguments):
        gathered.append(arguments)
        return gather_views(*arguments)

    monkeypatch.setattr(results, "gather_views", spy)
    folder = run("optimize", "optimizer.max_iterations=3")
    assert len(gathered) == 1
    kinds = {path.suffix for path in folder.iterdir()}
    assert kinds == {".json", ".npz", ".csv", ".vtu"}
