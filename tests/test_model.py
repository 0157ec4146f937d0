"""dolfinopt.Model: the same figures as the functions below it, on any number of ranks."""

import importlib.util
import pickle

import numpy as np
import pytest
from mpi4py import MPI
from runs import ROOT as FOLDER
from runs import TWO_ARM, refusal

import dolfinopt as do
from dolfinopt import Model
from dolfinopt.arms.arm import stiffening_of

WORLD = MPI.COMM_WORLD
ROOT = WORLD.rank == 0
SMALL = "arms.cells=[24,4]", "simulation.sample=0.01", "optimizer.max_iterations=2"


@pytest.fixture(scope="module")
def model():
    return Model(TWO_ARM, *SMALL)


@pytest.fixture(scope="module")
def result(model):
    return model.optimize()


def test_simulate_is_evaluate(model):
    """The initial design by name, by default, and by the functions give the same bits."""
    scene = do.load_scene(TWO_ARM, SMALL)
    partition = do.partition_arms(WORLD, scene.cell_counts)
    arms = do.build_arms(scene, partition, profile := do.Profile())
    x_phys = {k: arm.uniform(0.5) for k, arm in arms.items()}
    evaluation, _ = do.evaluate(scene, partition, arms, x_phys, profile)
    assert model.simulate().evaluation == evaluation
    found = model.simulate(model.uniform(0.5))
    assert found.evaluation == evaluation
    assert found.objective == evaluation.objective
    assert found.compliance == pytest.approx(found.objective, rel=1e-14)  # summed otherwise
    frame = found.to_frame()
    if ROOT:
        # Every 10 ms; the evaluation looks every millisecond.
        assert 0.999 * found.max_deviation < frame["deviation"].max() <= found.max_deviation
        assert frame.index[-1] == pytest.approx(scene.motion.horizon)
        assert list(found.design) == ["arm1", "arm2"]
    else:
        assert frame is None and found.design == {}


def test_a_design_comes_back_in_the_order_it_was_given(model):
    x = {name: 0.3 + 0.4 * points[:, 0] for name, points in model.centroids.items()}
    found = model.simulate(x)
    again = model.simulate(found)
    for name, values in x.items():
        assert np.array_equal(found.design[name], values)
        assert np.array_equal(again.design[name], values)
    assert again.evaluation == found.evaluation


def test_arms_are_meshed_once(monkeypatch):
    """Optimisation and simulation share mesh, operators and solver, and nothing of a design."""
    from dolfinopt.arms import arm as arms

    meshed = []

    def counted(comm, arm, pattern=None):
        meshed.append(arm.name)
        return arm_mesh(comm, arm, pattern)

    arm_mesh = arms.arm_mesh
    monkeypatch.setattr(arms, "arm_mesh", counted)
    quick = (*SMALL, "simulation.stiffening=auto", "reduction.coordinates=auto")
    plain, used = Model(TWO_ARM, *quick), Model(TWO_ARM, *quick)
    first = plain.optimize()
    mine = WORLD.allgather(len(meshed))
    assert sum(mine) == max(2, WORLD.size)  # two arms; ranks beyond them share one
    before = used.simulate(used.uniform(0.9)).evaluation  # which decides for another design
    again = used.optimize()
    assert sum(WORLD.allgather(len(meshed))) == 2 * sum(mine)
    assert again.evaluation == first.evaluation and again.iterations == first.iterations
    for name, values in first.design.items():
        np.testing.assert_array_equal(again.design[name], values)
    assert used.simulate(used.uniform(0.9)).evaluation == before
    assert sum(WORLD.allgather(len(meshed))) == 2 * sum(mine)


def test_optimize_has_history_design_and_pictures(result):
    assert result.iterations == 2
    assert not result.converged
    assert "max_iterations = 2" in result.stop_reason
    if not ROOT:
        assert result.history is None and result.plot() is None
        return
    history = result.history
    assert list(history.index) == [0, 1, 2]
    assert history["objective"].iloc[-1] == result.objective < history["objective"].iloc[0]
    assert history["max_deviation"].iloc[-1] == result.max_deviation
    assert result._repr_png_()[:8] == b"\x89PNG\r\n\x1a\n"
    for figure in (result.plot_history(), result.plot_machine()):
        assert figure.axes
    curves = result.plot_deviation().axes[0].lines
    assert max(curves[1].get_ydata()) == pytest.approx(1e3 * result.max_deviation)


def test_study_is_a_table(model, result):
    frame = model.study("payload.mass=2,6", designs=[result])
    assert len(frame) == 2
    compliance = [name for name in frame if "compliance" in name]
    assert len(compliance) == 1
    small, nominal = frame[compliance[0]]
    assert small < nominal
    assert nominal == pytest.approx(result.compliance, rel=model.scene.simulation.tolerance)


def test_scenes_from_dictionaries_and_scenes():
    data = do.load_scene(TWO_ARM).to_tree() if ROOT else {}
    model = Model(data, "payload.mass=4")
    assert model.scene.payload.mass == 4.0
    assert Model(model.scene, "payload.mass=5").scene.payload.mass == 5.0
    assert "arm1" in repr(model)


@pytest.mark.parametrize(
    ("x", "words"),
    [
        ({"arm1": np.zeros(96)}, ["arm1, arm2"]),
        ({"arm1": np.zeros(95), "arm2": np.zeros(96)}, ["arm 'arm1'", "(96,)", "(95,)"]),
        ({"arm1": np.full(96, 2.0), "arm2": np.zeros(96)}, ["arm 'arm1' = 2 at cell 0"]),
    ],
)
def test_designs_that_do_not_fit_are_refused_on_all_ranks(model, x, words):
    refusal(lambda: model.simulate(x), *words)


def test_bad_arguments_are_refused(model):
    refusal(lambda: model.gradient(kind="fast"), "'fast'", "esl, exact")
    refusal(lambda: model.uniform(1.5), "density")
    refusal(lambda: Model(TWO_ARM, "payload.masse=4"), "payload.masse", "payload.mass")


def test_changes_as_a_mapping():
    """Values keep their types, NumPy's and tables included; strings as before."""
    model = Model(TWO_ARM, {
        "payload.mass": np.float64(4.0), "arms.arm1.cells": np.array([24, 4]),
        "design.shared_volume": True, "name": 'a "name"', "constraints.mass": 1e-6,
        "scenarios": [{"changes": ["payload.mass=5"]}],
    }, "arms.arm2.cells=[24,4]")  # fmt: skip
    scene = model.scene
    assert (scene.payload.mass, scene.arms[0].cells, scene.name) == (4.0, (24, 4), 'a "name"')
    assert scene.design.shared_volume is True and scene.constraints.mass == 1e-6
    assert len(scene.scenarios) == 1
    refusal(lambda: Model(TWO_ARM, {"payload.masse": 4}), "payload.masse", "payload.mass")


def test_values_and_gradients_by_name():
    """Central differences; a limit's smooth value is differentiated, its scale is held."""
    model = Model(TWO_ARM, *SMALL, {
        "objective.kind": "mass", "constraints.deviation": 0.02, "constraints.first_frequency": 9.0,
    })  # fmt: skip
    x = model.uniform(0.6)
    at = model.evaluate(x)
    assert {"objective", "deviation", "first_frequency_arm2"} <= at.values.keys()
    assert at.values.keys() == at.gradients.keys()
    found = model.simulate(x)
    assert at.values["objective"] == found.objective
    assert at.values["deviation"] == pytest.approx(found.max_deviation / 0.02 - 1.0, rel=1e-12)
    rng, h = np.random.default_rng(3), 1e-4
    way = {name: rng.uniform(-1.0, 1.0, one.shape) for name, one in x.items()}
    up, down = (
        model.evaluate({name: x[name] + sign * h * way[name] for name in x}).values
        for sign in (1.0, -1.0)
    )
    for name in ("objective", "first_frequency_arm1"):
        slope = sum(float(g @ way[arm]) for arm, g in at.gradients[name].items())
        slope = WORLD.bcast(slope, root=0)
        assert (up[name] - down[name]) / (2.0 * h) == pytest.approx(slope, rel=1e-5, abs=1e-9)


def test_stiffening_is_decided_for_each_design():
    """Its estimate is that of the design, whatever the model has simulated before."""
    used, fresh = (Model(TWO_ARM, *SMALL) for _ in range(2))
    used.simulate(used.uniform(0.4))
    found = [
        stiffening_of(one._arms()[1]) for one in (used, fresh) if one.simulate(one.uniform(1.0))
    ]
    assert found[0] == found[1]


def test_a_design_to_begin_with(model):
    """The first row of the history is the design given; the callback sees every row."""
    x = {name: 0.3 + 0.4 * points[:, 0] for name, points in model.centroids.items()}
    rows = []
    found = model.optimize(x0=x, callback=rows.append)
    assert [row.iteration for row in rows] == ([0, 1, 2] if ROOT else [])
    if ROOT:
        assert found.history["volume_fraction"].iloc[0] == pytest.approx(0.5, rel=1e-3)
        assert found.history["objective"].iloc[0] != model.optimize().history["objective"].iloc[0]
    else:
        model.optimize()


def test_results_are_saved_and_pickled(model, result, shared_tmp_path):
    """What was pickled saves the same design, and a model that was simulates the same."""
    copy = pickle.loads(pickle.dumps(result))
    copy.save(shared_tmp_path / "run")
    WORLD.barrier()
    names = {path.name for path in (shared_tmp_path / "run").iterdir()}
    assert {"design.npz", "summary.json", "trajectory.npz"} <= names
    refusal(lambda: result.save(shared_tmp_path / "run"), "overwrite")
    assert model.simulate(shared_tmp_path / "run" / "design.npz").evaluation == (
        model.simulate(result).evaluation
    )
    if WORLD.size == 1:
        again = pickle.loads(pickle.dumps(model))
        assert again.simulate(result).evaluation == model.simulate(result).evaluation


def test_a_notebook_shows_picture_and_figures(model, result):
    found = model.simulate()
    assert found.warnings == ()
    html = result._repr_html_()
    if ROOT:
        assert html.startswith('<img src="data:image/png;base64,') and "largest deviation" in html
        assert sum(found.mass.values()) == pytest.approx(2 * 2700.0 * 0.06 * 0.01 * 0.5, rel=0.05)
    else:
        assert html is None


def test_the_algorithm_on_one_page_is_optimize():
    """demos/demo_algorithm.py, of public parts, has the same history."""
    path = FOLDER / "demos" / "demo_algorithm.py"
    spec = importlib.util.spec_from_file_location("demo_algorithm", path)
    demo = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(demo)
    told = [*demo.SETTINGS, "arms.cells=[30,4]", "optimizer.max_iterations=10"]
    history = demo.main(told)
    result = do.optimize(do.load_scene(TWO_ARM, told))
    if ROOT:
        rows = [row.objective for row in result.rows]
        np.testing.assert_allclose(history, rows, rtol=1e-9)


def test_a_machine_a_thousandth_as_large_has_the_same_design():
    """Lengths times s, E times s^2, mass times s^3, times kept: defaults follow the arms."""
    s = 1e-3
    found = []
    for scale in (1.0, s):
        data = {
            "material": {
                "young_modulus": 70e9 * scale**2, "poisson_ratio": 0.33, "density": 2700.0,
            },
            "arms": [
                {"name": "arm1", "length": scale, "height": 0.06 * scale,
                 "thickness": 0.01 * scale, "cells": [24, 4]},
                {"name": "arm2"},
            ],
            "motion": {"path": "arc", "duration": 1.9},
            "payload": {"mass": 6.0 * scale**3},
            "damping": {"stiffness_proportional": 2e-4},
            "optimizer": {"max_iterations": 8},
        }  # fmt: skip
        model = Model(data)
        assert model.scene.motion.radius == pytest.approx(scale)
        assert model.scene.motion.joint_height == pytest.approx(-0.5 * scale)
        assert model.scene.design.filter_radius == pytest.approx(0.0075 * scale)
        found.append(model.optimize())
    large, small = found
    assert small.objective == pytest.approx(s**5 * large.objective, rel=1e-9)
    for name, x in large.design.items():
        np.testing.assert_allclose(small.design[name], x, atol=1e-6)
