"""Many samples of one design: what each gives, and that it is done once, on any number of ranks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

import dolfinopt as do
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.study import sampling
from dolfinopt.study.sampling import Samples, posed, respond

WORLD, SELF = MPI.COMM_WORLD, MPI.COMM_SELF
SCENE = Path(__file__).parents[2] / "demos" / "two_arm.toml"
SMALL = ("arms.cells=[12,3]", "simulation.sample=0.01", "simulation.tolerance=1e-2")
FINE = ("simulation.tolerance=1e-6", "motion.horizon=2.2")
INITIAL = [("initial", None)]
CHUNK = 6


@pytest.fixture(autouse=True)
def _small_chunks(monkeypatch):
    monkeypatch.setattr(sampling, "CHUNK", CHUNK)


def scene(*overrides):
    return do.load_scene(SCENE, [*SMALL, *overrides])


def payloads(count, *overrides):
    """Return samples of the payload's mass."""
    values = 6.0 + 0.3 * np.sin(np.arange(count, dtype=float))
    return Samples(scene(*overrides), ("payload.mass",), values[:, None])


def arrays(found):
    return np.stack([found.compliance, found.max_deviation, found.max_deviation_time])


@pytest.mark.parametrize(
    ("changes", "scaling"),
    [
        ({"payload.mass": 7.0, "motion.duration": 2.1}, True),
        ({"material.density": 3000.0, "damping.stiffness_proportional": 1e-3}, True),
        ({"arms.arm2.young_modulus": 60e9, "arms.arm1.thickness": 0.012}, True),
        ({"arms.thickness": 0.009}, True),
        ({"material.poisson_ratio": 0.2, "payload.mass": 7.0}, False),
        ({"interpolation.penalty": 4.0}, False),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, dict) else "",
)
def test_samples_are_scenes_by_themselves(changes, scaling, shared_tmp_path):
    """Whether bodies are scaled or reduced anew: as `evaluate` has it, arms built for it alone."""
    base = scene(*FINE)
    samples = Samples(base, tuple(changes), np.array([list(changes.values())]))
    assert samples.scaling == scaling
    [found], computed = respond(samples, INITIAL, shared_tmp_path, WORLD, shown=False)
    assert computed == 2 and not found.failures
    figures = []
    for texts in ((), (f"{key}={value}" for key, value in changes.items())):
        other = scene(*FINE, *texts)
        partition = do.partition_arms(SELF, other.cell_counts)
        arms = do.build_arms(other, partition, do.Profile())
        x = {k: arm.uniform(0.5) for k, arm in arms.items()}
        expected, _ = do.evaluate(other, partition, arms, x, do.Profile())
        figures.append((expected.compliance, expected.max_deviation, expected.max_deviation_time))
    # Both are right to the tolerance in the coordinates; some of it is lost in their squares.
    np.testing.assert_allclose(arrays(found).T, figures, rtol=1e-5)
    assert np.abs(figures[1][0] / figures[0][0] - 1.0) > 1e-4  # it does matter


def test_what_is_known_is_not_done_again(shared_tmp_path):
    """Further samples are added to complete chunks, whose bits stay."""
    count = 2 * CHUNK - 1  # and the scene itself: two chunks
    [first], computed = respond(payloads(count), INITIAL, shared_tmp_path, WORLD, shown=False)
    assert computed == 2 * CHUNK and len(first.compliance) == 2 * CHUNK
    [again], computed = respond(payloads(count), INITIAL, shared_tmp_path, WORLD, shown=False)
    assert computed == 0
    np.testing.assert_array_equal(arrays(first), arrays(again))
    [more], computed = respond(payloads(count + 3), INITIAL, shared_tmp_path, WORLD, shown=False)
    assert computed == 3
    np.testing.assert_array_equal(arrays(first), arrays(more)[:, : 2 * CHUNK])
    # Another name is the same scene; another value is not, nor is another design.
    named = replace(payloads(count), scene=scene('name="other"'))
    assert respond(named, INITIAL, shared_tmp_path, WORLD, shown=False)[1] == 0
    few = payloads(CHUNK - 1)
    other = replace(few, scene=scene("motion.flattening=0.9"))
    assert respond(other, INITIAL, shared_tmp_path, WORLD, shown=False)[1] == CHUNK
    designs = [("full", _full(shared_tmp_path))]
    assert respond(few, designs, shared_tmp_path, WORLD, shown=False)[1] == CHUNK


def test_damaged_chunks_are_done_again(shared_tmp_path):
    [first], _ = respond(payloads(CHUNK + 1), INITIAL, shared_tmp_path, WORLD, shown=False)
    WORLD.barrier()  # all have read them
    if WORLD.rank == 0:
        files = sorted((shared_tmp_path / "samples").glob("*.npz"))
        assert len(files) == 2
        files[0].write_bytes(files[0].read_bytes()[:100])
        files[1].write_bytes(b"")
    WORLD.barrier()
    [again], computed = respond(payloads(CHUNK + 1), INITIAL, shared_tmp_path, WORLD, shown=False)
    assert computed == CHUNK + 2
    np.testing.assert_array_equal(arrays(first), arrays(again))


@pytest.mark.serial
def test_an_interruption_costs_a_chunk(tmp_path, monkeypatch):
    """Ctrl-C in the third chunk: two are kept, and the end is the same."""
    count = 3 * CHUNK - 1
    honest, calls = sampling._response, []

    def interrupted(trajectory):
        calls.append(1)
        if len(calls) == 2 * CHUNK + 5:
            raise KeyboardInterrupt
        return honest(trajectory)

    monkeypatch.setattr(sampling, "_response", interrupted)
    with pytest.raises(KeyboardInterrupt):
        respond(payloads(count), INITIAL, tmp_path / "a", SELF, shown=False)
    [found], computed = respond(payloads(count), INITIAL, tmp_path / "a", SELF, shown=False)
    assert computed == CHUNK
    [expected], computed = respond(payloads(count), INITIAL, tmp_path / "b", SELF, shown=False)
    assert computed == 3 * CHUNK
    np.testing.assert_array_equal(arrays(found), arrays(expected))


@pytest.mark.skipif(WORLD.size == 1, reason="compares one rank with several")
def test_ranks_do_not_matter(tmp_path, shared_tmp_path):
    """The same bits, whoever does a chunk, of two designs."""
    samples = payloads(2 * CHUNK)
    designs = [*INITIAL, ("full", _full(shared_tmp_path))]
    alone, _ = respond(samples, designs, tmp_path / "alone", SELF, shown=False)
    together, computed = respond(samples, designs, shared_tmp_path / "all", WORLD, shown=False)
    assert computed == 2 * (2 * CHUNK + 1)
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_array_equal(arrays(one), arrays(other))
    assert not np.array_equal(arrays(alone[0]), arrays(alone[1]))


def _full(folder):
    """Write a design of solid arms."""
    path = folder / "full.npz"
    if WORLD.rank == 0:
        x, y = np.meshgrid((np.arange(12) + 0.5) / 12.0, (np.arange(3) - 1) * 0.02)
        centroid = np.stack([x.ravel(), y.ravel()], axis=1)
        arms = {f"arm{k}/centroid": centroid for k in (1, 2)}
        np.savez(path, **arms, **{f"arm{k}/density": np.ones(36) for k in (1, 2)})
    WORLD.barrier()
    return path


@pytest.mark.serial
def test_failures_are_told_and_tried_again(tmp_path, monkeypatch):
    honest = sampling.simulate_batch

    def failing(scenes, *others):
        return [
            ConvergenceError("too heavy") if scene.payload.mass > 6.25 else one
            for scene, one in zip(scenes, honest(scenes, *others), strict=True)
        ]

    samples = payloads(CHUNK - 1)
    heavy = np.flatnonzero(samples.values[:, 0] > 6.25) + 1
    assert 0 < len(heavy) < CHUNK - 1
    with monkeypatch.context() as patch:
        patch.setattr(sampling, "simulate_batch", failing)
        [found], _ = respond(samples, INITIAL, tmp_path, SELF, shown=False)
    assert list(found.failures) == list(heavy)
    assert set(found.failures.values()) == {"too heavy"}
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(found.compliance)), heavy)
    [found], computed = respond(samples, INITIAL, tmp_path, SELF, shown=False)
    assert computed == CHUNK and not found.failures and np.isfinite(arrays(found)).all()


def test_a_sample_out_of_reach_is_one_line():
    samples = Samples(scene(), ("motion.radius",), np.array([[1.0], [5.0]]))
    assert posed(samples, 0) == samples.scene
    with pytest.raises(InputError, match=r"--random, sample 2 \(motion.radius=5.0\)") as caught:
        posed(samples, 2)
    assert "\n" not in str(caught.value)
