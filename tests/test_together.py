"""Whatever fails on one rank alone fails on all: none waits for ever, wherever it happens."""

import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from remainders import build
from runs import TWO_ARM, by_root, environment, overrides

import dolfinopt as do
from dolfinopt.arms import arm, design_state
from dolfinopt.errors import ConvergenceError, InputError, OthersFailed
from dolfinopt.fem import elasticity, tensors
from dolfinopt.mesh import arm_mesh as mesh
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.optimization.gradient_check import taylor_test
from dolfinopt.output import checkpoint, design, run_folder, summary
from dolfinopt.output.run_folder import simulated, write_result
from dolfinopt.parallel import RaisedElsewhere, _pickled, on_root, together
from dolfinopt.responses import evaluation, frequency, motion, order_selection, static
from dolfinopt.responses import order_selection as coordinates
from dolfinopt.scene.load import read_scene
from dolfinopt.study import cases as computing
from dolfinopt.study import studies as study
from dolfinopt.study.cases import Case, Runner, run_cases
from dolfinopt.study.uncertainty import sample_cases

COMM = MPI.COMM_WORLD
LONE = min(1, COMM.size - 1)  # the rank that fails; with two arms it has one of them
ON_RANKS = pytest.mark.skipif(COMM.size == 1, reason="needs two ranks")
COARSE = ("arms.cells=[12,3]", "design.filter_radius=0.2", "optimizer.max_iterations=2")


class Unusual(Exception):
    """What no code catches."""


class Awkward(ConvergenceError):
    """Cannot be pickled: its constructor wants two arguments and it holds a function."""

    def __init__(self, text, action):
        super().__init__(f"{text}!")
        self.action = action


@pytest.mark.parametrize("kind", [InputError, np.linalg.LinAlgError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("rank", [0, COMM.size - 1])
def test_one_ranks_exception_is_raised_on_all(kind, rank):
    with together(COMM):
        value = 3
    assert value == 3  # nothing happens to good work
    with pytest.raises(kind) as raised, together(COMM):
        if COMM.rank == rank:
            raise kind(f"on rank {rank}")
    assert str(raised.value) == f"on rank {rank}"
    if COMM.rank != rank:
        assert isinstance(raised.value.__cause__, RaisedElsewhere)
        assert "test_together.py" in str(raised.value.__cause__)
    COMM.Barrier()  # all are at the same place: nothing is left over


@pytest.mark.parametrize("kind", [InputError, np.linalg.LinAlgError, KeyboardInterrupt, SystemExit])
def test_any_exception_of_the_root_is_raised_on_all(kind):
    def fail():
        raise kind("at the root")

    with pytest.raises(kind, match=r"^at the root$"):
        on_root(COMM, fail)
    if COMM.size > 1:  # on one rank nothing is sent
        with pytest.raises((pickle.PicklingError, AttributeError)):
            on_root(COMM, lambda: lambda: None)
    COMM.Barrier()


def test_the_first_of_several_is_raised_and_a_failure_before_those_who_gave_up():
    with pytest.raises(ValueError, match=r"^of rank 0$"), together(COMM):
        raise ValueError(f"of rank {COMM.rank}")
    with pytest.raises(Unusual), together(COMM):
        raise Unusual("why") if COMM.rank == COMM.size - 1 else OthersFailed("given up")


def test_an_exception_that_cannot_be_sent_arrives_as_its_nearest_relative():
    with pytest.raises(ConvergenceError, match=r"^stuck!$") as raised, together(COMM):
        if COMM.rank == LONE:
            raise Awkward("stuck", lambda: None)
    assert type(raised.value) is (Awkward if COMM.rank == LONE else ConvergenceError)

    class Local(InputError):
        pass

    sent = pickle.loads(_pickled(Local("no")))
    assert type(sent) is InputError and str(sent) == "no"


def test_parts_of_the_ranks_agree_first():
    """As an arm's ranks do: the others hear of it at the end of the outer block."""
    part = COMM.Split(COMM.rank // 2, COMM.rank)
    after = []
    with pytest.raises(Unusual, match=r"^lost$"), together(COMM):
        with together(part):
            if COMM.rank == LONE:
                raise Unusual("lost")
        after.append(part.allreduce(1))  # would wait for ever where one rank is missing
    assert bool(after) == (COMM.rank // 2 != LONE // 2)
    part.Free()


def test_an_abandoned_generator_does_not_meet_anybody():
    def numbers():
        with together(COMM):
            yield 1

    if COMM.rank == 0:
        generator = numbers()
        next(generator)
        generator.close()
    assert COMM.allreduce(1) == COMM.size


def coarse(*overrides):
    """Return the two-arm scene in few cells."""
    return read_scene(TWO_ARM, (*COARSE, *overrides))


def fail_on(monkeypatch, rank, owner, name, after=0):
    """Let a function fail on one rank, from its call number `after` on."""
    whole, calls = getattr(owner, name), [0]

    def failing(*arguments, **options):
        calls[0] += 1
        if COMM.rank == rank and calls[0] > after:
            raise Unusual(name)
        return whole(*arguments, **options)

    monkeypatch.setattr(owner, name, failing)


# What the work needs first, with overrides of its scene; the work itself is returned.


def building(_, *overrides):
    return lambda: build(*COARSE, *overrides)


def evaluating(_, *overrides):
    built = build(*COARSE, *overrides)
    x = built.uniform()
    return lambda: built.evaluate(x)


def gradients(_, *overrides):
    built = build(*COARSE, *overrides)
    _, trajectory = built.evaluate(built.uniform())
    return lambda: (built.gradient(trajectory), built.constraint_gradients())


def choosing(_):
    built = build(*COARSE, "reduction.coordinates=auto", "reduction.tolerance=0.1")
    x = built.uniform()
    return lambda: do.choose_coordinates(*built.place, x, built.profile)


def optimising(folder):
    scene = coarse("design.projection=heaviside", "design.continuation=1")
    return lambda: do.optimize(scene, folder, world=COMM)


def resuming(folder):
    do.optimize(coarse(), folder, world=COMM)
    return lambda: do.optimize(coarse(), folder, resume=True, world=COMM)


def writing(folder):
    built = build(*COARSE)
    x = built.uniform()
    result = simulated(design.Designed(*built.place, x), built.profile)
    return lambda: write_result(folder, result, 1.0)


def writing_designs(folder):
    result = do.optimize(coarse(), world=COMM)
    return lambda: write_result(folder, result, 1.0)


def writing_gradients(folder):
    built = build(*COARSE)
    x = built.uniform()
    return lambda: design.write_gradient(folder / "g.npz", *built.place, x, 1.0)


def reading_designs(folder):
    built = build(*COARSE)
    found = do.gather_views(*built.place, built.uniform())
    by_root(lambda: design.write_design(folder, found, built.place[0]))
    return lambda: design.read_design(folder / "design.npz", built.partition, built.arms)


def taylor(_):
    built = build(*COARSE)
    x = built.uniform()
    return lambda: taylor_test(Evaluator(*built.place, built.profile), x)


EXACT, STATIC = "objective.gradient=exact", "objective.kind=static"
PERIOD, TIP = "objective.kind=eigenfrequency", "constraints.tip_deflection=1.0"
FREQUENCY = "constraints.first_frequency=1.0"
PLACES = [
    (building, LONE, mesh, "snap"),
    (building, LONE, mesh, "build_model", "arms.1.mesh=meshes/arm.geo"),
    (building, LONE, mesh, "_arm_mesh", "arms.1.mesh=meshes/arm.geo"),
    (building, LONE, tensors, "compile_together"),
    (building, LONE, arm, "Substructure"),
    (evaluating, LONE, design_state, "interpolate"),
    (evaluating, LONE, design_state, "shape_integrals"),
    (evaluating, LONE, static, "static_response", STATIC),
    (evaluating, LONE, static, "static_response", TIP),
    (evaluating, LONE, design_state, "shape_integrals", PERIOD),
    (evaluating, LONE, design_state, "loaded_modes", FREQUENCY),
    (evaluating, LONE, frequency, "p_norm", PERIOD),
    (evaluating, 0, evaluation, "simulate"),
    (evaluating, 0, evaluation, "_motion"),
    (gradients, LONE, motion, "esl_gradient"),
    (gradients, 0, motion.MotionResponse, "_frozen_moments"),
    (gradients, LONE, motion, "exact_gradient", EXACT),
    (gradients, 0, motion.MotionResponse, "cotangents", EXACT),
    (gradients, LONE, static, "tip_gradient", STATIC),
    (gradients, LONE, frequency, "period_gradient", PERIOD),
    (gradients, LONE, frequency, "rigid_gradient", PERIOD),
    (gradients, LONE, static, "tip_gradient", TIP),
    (gradients, LONE, frequency, "period_gradient", FREQUENCY),
    (choosing, LONE, arm.Arm, "state"),
    (choosing, LONE, order_selection, "shape_integrals"),
    (choosing, 0, coordinates, "_distance"),
    (optimising, LONE, arm.Arm, "physical_designs"),
    (optimising, LONE, arm.Arm, "backward", 1),  # the first call passes
    (optimising, 0, checkpoint, "write_history"),
    (optimising, 0, checkpoint, "append_history", 1),
    (optimising, 0, checkpoint, "write_arrays", 0),
    (optimising, 0, checkpoint, "write_arrays", 1),
    (optimising, LONE, checkpoint, "_of_arm"),
    (resuming, LONE, checkpoint, "_match"),
    (writing, LONE, arm.Arm, "volume_fraction"),
    (writing, 0, design, "_views"),
    (writing, 0, run_folder, "write_design"),
    (writing, 0, run_folder, "write_trajectory"),
    (writing, 0, summary, "versions"),
    (writing, 0, run_folder, "write_summary"),
    (writing_designs, 0, run_folder, "write_fields"),
    (writing_gradients, 0, design, "write_arrays"),
    (reading_designs, LONE, design, "_fit"),
    (taylor, LONE, arm.Arm, "physical_designs"),
    (taylor, LONE, arm.Arm, "backward"),
]


@ON_RANKS
@pytest.mark.parametrize(
    ("prepare", "rank", "owner", "name", "more"),
    [(*place[:4], place[4:]) for place in PLACES],
    ids=lambda part: getattr(part, "__name__", str(part)),
)
def test_what_fails_on_one_rank(prepare, rank, owner, name, more, monkeypatch, shared_tmp_path):
    work = prepare(shared_tmp_path, *(one for one in more if isinstance(one, str)))
    fail_on(monkeypatch, rank, owner, name, sum(one for one in more if isinstance(one, int)))
    with pytest.raises(Unusual, match=f"^{name}$"):
        work()
    COMM.Barrier()


def test_what_is_told_of_an_iteration():
    def report(row):
        if row.iteration == 1:
            raise Unusual("told")

    with pytest.raises(Unusual, match=r"^told$"):
        do.optimize(coarse(), world=COMM, report=report)
    COMM.Barrier()


@ON_RANKS
@pytest.mark.parametrize(
    ("owner", "name"),
    [(mesh, "snap"), (tensors, "compile_together"), (elasticity, "NodePairs"),
     (design_state, "interpolate")],
)  # fmt: skip
def test_a_shared_arm(owner, name, monkeypatch):
    """The ranks of an arm meet in between: none is left in a collective of the arm."""
    monkeypatch.setattr("dolfinopt.parallel.SPLIT_CELLS", 1)
    # The last rank shares its arm with others from three ranks on.
    fail_on(monkeypatch, COMM.size - 1, owner, name)
    with pytest.raises(Unusual, match=f"^{name}$"):
        evaluating(None, "arms.1.rigid=true")()
    COMM.Barrier()


def payloads(*overrides):
    scenes = (coarse(*overrides, f"payload.mass={m}") for m in (4, 5, 6))
    return [Case(scene, "optimize", label=f"{k}") for k, scene in enumerate(scenes)]


@ON_RANKS
@pytest.mark.parametrize(("place", "name"), [(computing, "_optimise"), (computing._Place, "read")])
def test_cases(place, name, monkeypatch, shared_tmp_path):
    """A rank that fails ends the others' work, too; what they have finished stays."""
    fail_on(monkeypatch, LONE, place, name)
    with pytest.raises(Unusual, match=f"^{name}$"):
        run_cases(payloads(), shared_tmp_path, COMM, shown=False)
    COMM.Barrier()
    monkeypatch.undo()
    assert not run_cases(payloads(), shared_tmp_path, COMM, shown=False).failures


@ON_RANKS
def test_a_failed_rank_stops_the_others(monkeypatch, shared_tmp_path):
    """An optimisation that would go on for long ends in the iteration in which it hears of it."""
    long = payloads("optimizer.max_iterations=100000", "optimizer.tolerance=1e-300")
    fail_on(monkeypatch, LONE, computing, "_optimise")
    with pytest.raises(Unusual):
        run_cases(long, shared_tmp_path, COMM, shown=False)
    COMM.Barrier()


@ON_RANKS
def test_samples(monkeypatch, shared_tmp_path):
    samples = [(), *((f"payload.mass={mass}",) for mass in np.linspace(4.0, 6.0, 60))]
    fail_on(monkeypatch, LONE, computing, "_sample")
    with pytest.raises(Unusual, match=r"^_sample$"):
        run_cases(sample_cases(coarse(), samples, "", None), shared_tmp_path, COMM, shown=False)
    COMM.Barrier()


@ON_RANKS
def test_tables(monkeypatch, shared_tmp_path):
    fail_on(monkeypatch, 0, study, "results_of")
    steps = study.study(coarse(), None, ["payload.mass=5,6"], [])
    with pytest.raises(Unusual, match=r"^results_of$"):
        Runner(shared_tmp_path, COMM, False).follow(steps)
    COMM.Barrier()


# What fails, on which rank, in which command; the other places above end in the same two handlers.
COMMANDS = {
    "mesh": ("dolfinopt.mesh.arm_mesh", "snap", 1, "simulate"),
    "checkpoint": ("dolfinopt.output.checkpoint", "write_arrays", 0, "optimize"),
}
SCRIPT = """
import sys
from importlib import import_module
sys.argv = {arguments!r}
module = import_module({module!r})
from mpi4py import MPI
def fail(*arguments, **options):
    raise {error}
if MPI.COMM_WORLD.rank == {rank}:
    module.{name} = fail
from dolfinopt.cli import main
main()
"""


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.skipif(shutil.which("mpirun") is None, reason="no mpirun")
@pytest.mark.parametrize(
    ("place", "kind"), [("checkpoint", "ConvergenceError"), ("mesh", "ZeroDivisionError")]
)
def test_commands(place, kind, tmp_path):
    """All ranks end by themselves, with one message: nobody has to be aborted."""
    module, name, rank, command = COMMANDS[place]
    arguments = ["dolfinopt", command, str(TWO_ARM), "--no-plots", "--out"]
    arguments += [str(tmp_path / "o"), *overrides(*COARSE)]
    error = f"__import__('dolfinopt').{kind}('lost')" if "Conv" in kind else f"{kind}('lost')"
    script = SCRIPT.format(arguments=arguments, module=module, name=name, rank=rank, error=error)
    line = ["mpirun", "-n", "2", sys.executable, "-c", script]
    run = subprocess.run(line, capture_output=True, text=True, timeout=120, env=environment())
    assert run.returncode == 1, run.stderr
    assert "MPI_ABORT" not in run.stderr, run.stderr
    line = "dolfinopt: lost" if "Conv" in kind else "ZeroDivisionError: lost"
    own = [one for one in run.stderr.splitlines() if one == line]
    assert len(own) >= 1 and (len(own) == 1 or "Conv" not in kind)
    assert not list(Path(tmp_path / "o").glob(".*"))
