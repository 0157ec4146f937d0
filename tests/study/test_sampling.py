"""Many samples of one design: what each gives, and that it is done once, on any number of ranks."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from runs import TWO_ARM
from studies import write_uniform

import dolfinopt as do
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.study import simulate, uncertainty
from dolfinopt.study.simulate import scales_bodies, with_sample
from dolfinopt.study.store import run_cases
from dolfinopt.study.uncertainty import sample_cases, sample_texts

WORLD, SELF = MPI.COMM_WORLD, MPI.COMM_SELF
SMALL = ("arms.cells=[12,3]", "simulation.sample=0.01", "simulation.tolerance=1e-2")
FINE = ("simulation.tolerance=1e-6", "motion.horizon=2.2")
CHUNK = 6


@pytest.fixture(autouse=True)
def _small_chunks(monkeypatch):
    monkeypatch.setattr(uncertainty, "CHUNK", CHUNK)


def scene(*overrides):
    return do.load_scene(TWO_ARM, [*SMALL, *overrides])


def masses(count):
    return 6.0 + 0.3 * np.sin(np.arange(count, dtype=float))


def payloads(count, *overrides, design=None):
    """Return cases of samples of the payload's mass."""
    samples = sample_texts(["payload.mass"], masses(count)[:, None])
    return sample_cases(scene(*overrides), samples, "it", design)


def respond(cases, folder, comm=WORLD):
    """Return what came of all samples (3, 1 + n), how many were computed, and all messages."""
    outcomes = run_cases(cases, folder, comm, shown=False)
    found = [outcomes[case] for case in cases]
    arrays = np.concatenate([np.stack([*one.samples.values()]) for one in found], axis=1)
    return arrays, outcomes.computed, {k: v for o in found for k, v in o.messages.items()}


@pytest.mark.serial  # ranks: test_ranks_do_not_matter
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
    samples = sample_texts([*changes], np.array([[*changes.values()]]))
    assert scales_bodies(base, changes) == scaling
    cases = sample_cases(base, samples, "", None)
    found, computed, failures = respond(cases, shared_tmp_path)
    assert computed == 2 and not failures
    figures = []
    for texts in ((), (f"{key}={value}" for key, value in changes.items())):
        other = scene(*FINE, *texts)
        partition = do.partition_arms(SELF, other.cell_counts)
        arms = do.build_arms(other, partition, do.Profile())
        x = {k: arm.uniform(0.5) for k, arm in arms.items()}
        expected, _ = do.evaluate(other, partition, arms, x, do.Profile())
        figures.append((expected.compliance, expected.max_deviation, expected.max_deviation_time))
    # Both are right to the tolerance in the coordinates; some of it is lost in their squares.
    np.testing.assert_allclose(found.T, figures, rtol=1e-5)
    assert np.abs(figures[1][0] / figures[0][0] - 1.0) > 1e-4  # it does matter


def test_what_is_known_is_not_done_again(shared_tmp_path):
    """Further samples are added to complete chunks, whose bits stay."""
    count = 2 * CHUNK - 1  # and the scene itself: two chunks
    first, computed, _ = respond(payloads(count), shared_tmp_path)
    assert computed == 2 * CHUNK and first.shape == (3, 2 * CHUNK)
    again, computed, _ = respond(payloads(count), shared_tmp_path)
    assert computed == 0
    np.testing.assert_array_equal(first, again)
    more, computed, _ = respond(payloads(count + 3), shared_tmp_path)
    assert computed == 3
    np.testing.assert_array_equal(first, more[:, : 2 * CHUNK])
    # Another name is the same scene; another value is not, nor is another design.
    assert respond(payloads(count, 'name="other"'), shared_tmp_path)[1] == 0
    few, full = CHUNK - 1, write_uniform(shared_tmp_path / "full.npz", (12, 3), 1.0)
    assert respond(payloads(few, "motion.flattening=0.9"), shared_tmp_path)[1] == CHUNK
    assert respond(payloads(few, design=full), shared_tmp_path)[1] == CHUNK


def test_damaged_chunks_are_done_again(shared_tmp_path):
    first, *_ = respond(payloads(CHUNK + 1), shared_tmp_path)
    WORLD.barrier()  # all have read them
    if WORLD.rank == 0:
        files = sorted((shared_tmp_path / "cases").glob("*/summary.json"))
        assert len(files) == 2
        files[0].write_bytes(files[0].read_bytes()[:100])
        files[1].write_bytes(b"")
    WORLD.barrier()
    again, computed, _ = respond(payloads(CHUNK + 1), shared_tmp_path)
    assert computed == CHUNK + 2
    np.testing.assert_array_equal(first, again)


@pytest.mark.serial
def test_an_interruption_costs_a_chunk(tmp_path, monkeypatch):
    """Ctrl-C in the third chunk: two are kept, and the end is the same."""
    count = 3 * CHUNK - 1
    honest, calls = simulate.simulate_batch, []

    def interrupted(scenes, *others):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return honest(scenes, *others)

    monkeypatch.setattr(simulate, "simulate_batch", interrupted)
    with pytest.raises(KeyboardInterrupt):
        respond(payloads(count), tmp_path / "a", SELF)
    found, computed, _ = respond(payloads(count), tmp_path / "a", SELF)
    assert computed == CHUNK
    expected, computed, _ = respond(payloads(count), tmp_path / "b", SELF)
    assert computed == 3 * CHUNK
    np.testing.assert_array_equal(found, expected)


@pytest.mark.skipif(WORLD.size == 1, reason="compares one rank with several")
def test_ranks_do_not_matter(tmp_path, shared_tmp_path):
    """The same bits, whoever does a chunk, of two designs."""
    count, full = 2 * CHUNK + 1, write_uniform(shared_tmp_path / "full.npz", (12, 3), 1.0)
    cases = payloads(count - 1) + payloads(count - 1, design=full)
    alone, *_ = respond(cases, tmp_path / "alone", SELF)
    together, computed, _ = respond(cases, shared_tmp_path / "all")
    assert computed == 2 * count
    np.testing.assert_array_equal(alone, together)
    assert (alone[0, :count] != alone[0, count:]).all()


@pytest.mark.serial
def test_failures_are_told_and_tried_again(tmp_path, monkeypatch):
    honest = simulate.simulate_batch

    def failing(scenes, *others):
        return [
            ConvergenceError("too heavy") if scene.payload.mass > 6.25 else one
            for scene, one in zip(scenes, honest(scenes, *others), strict=True)
        ]

    cases = payloads(CHUNK - 1)
    heavy = np.flatnonzero(masses(CHUNK - 1) > 6.25) + 1
    assert 0 < len(heavy) < CHUNK - 1
    with monkeypatch.context() as patch:
        patch.setattr(simulate, "simulate_batch", failing)
        found, _, failures = respond(cases, tmp_path, SELF)
    assert list(failures) == list(heavy) and {*failures.values()} == {"too heavy"}
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(found[0])), heavy)
    found, computed, failures = respond(cases, tmp_path, SELF)
    assert computed == CHUNK and not failures and np.isfinite(found).all()


def test_a_sample_out_of_reach_is_one_line():
    assert with_sample(scene(), (), 0) == scene()
    with pytest.raises(InputError, match=r"--random, sample 2 \(motion.radius=5.0\)") as caught:
        with_sample(scene(), ("motion.radius=5.0",), 2)
    assert "\n" not in str(caught.value)
