"""One design under several scenarios: bodies, objectives and gradients."""

import json

import numpy as np
import pytest
from mpi4py import MPI
from remainders import build, wave
from runs import TWO_ARM

import dolfinopt as do
from dolfinopt.multibody.shape_integrals import TABLE, of_material
from dolfinopt.responses.response import bodies_in, combined
from dolfinopt.scene.load import pose_scenarios

WORLD = MPI.COMM_WORLD
MATERIAL = ("material.density=3100.0", "material.young_modulus=50e9")
DAMPING = "damping.stiffness_proportional=1e-3"
PATH = ("motion.flattening=0.5", "motion.horizon=2.5", "payload.mass=8")

# All scenarios share their steps: coordinates differ by the tolerance, their squares by twice that.
SIMULATED = 2e-4


def scenarios(*changes, weights=(1.0,) * 9):
    """Return the override that poses scenarios."""
    pairs = zip(changes, weights)
    rows = [f"{{changes={json.dumps(list(one))}, weight={weight:g}}}" for one, weight in pairs]
    return f"scenarios=[{', '.join(rows)}]"


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize("method", ["craig-bampton", "modal", "krylov", "balanced"])
def test_scaled_bodies_are_those_reduced_anew(method):
    """Denser, stiffer, more damped: all integrals scale, whatever the basis."""
    # The Gramian weighs with the damping and a band of frequencies, so that its basis changes with
    # the material: the same to rounding only where both stay.
    changes = (*MATERIAL, DAMPING)
    if method == "balanced":
        changes = ("material.density=5400.0", "material.young_modulus=140e9")
    here = build(f"reduction.method={method}", "reduction.coordinates=5", scenarios(changes))
    there = build(f"reduction.method={method}", "reduction.coordinates=5", *changes)
    x = here.fields(wave)
    (other,) = pose_scenarios(here.scene)
    for k, arm in here.arms.items():
        body = bodies_in(here.scene, other, {0: arm.reduce(x[k]), 1: arm.reduce(x[k])})[k]
        anew = there.arms[k].reduce(x[k])
        # Modes are normalised to the mass: another density is another length of theirs.
        size = np.sqrt(np.diag(anew.K) / np.diag(body.K))
        every = np.append(1.0, size)  # of the reference position, then of the modes
        factors = {"mass": 1.0, "w": every, "W": np.outer(every, every), "outboard": size}
        factors |= dict.fromkeys("KD", np.outer(size, size))
        for name, factor in factors.items():
            expected = getattr(anew, name)
            # Eigenvectors are right to 1e-10, see reduction.basis.
            close = 1e-8 * np.abs(expected).max()
            np.testing.assert_allclose(getattr(body, name) * factor, expected, atol=close)


@pytest.mark.serial  # ranks have no part in it
def test_a_body_without_change_stays():
    arm = build().arms
    for k, one in arm.items():
        body = one.reduce(np.full(one.mesh.num_cells, 0.3 + 0.1 * k))
        same = of_material(body, 1.0, 1.0, one.scene.damping.stiffness_proportional)
        for integral in TABLE:
            name = integral.name
            assert np.array_equal(getattr(same, name), getattr(body, name))


@pytest.mark.parametrize("kind", ["esl", pytest.param("deviation", marks=pytest.mark.serial)])
def test_figures_are_those_of_the_scenes_alone(kind):
    """Each scenario is what its scene gives alone; the objective is their weighted sum."""
    changes = [PATH, (DAMPING,)]
    kept = f"objective.kind={kind}"
    several = build(kept, scenarios(*changes, weights=[1.0, 0.25]))
    found, trajectory = several.evaluate(several.fields(wave))
    alone = []
    for one in [(), *changes]:
        built = build(kept, *one)
        alone.append(built.evaluate(built.fields(wave))[0])
    assert found.max_deviation == pytest.approx(alone[0].max_deviation, rel=SIMULATED)
    for mine, theirs in zip(found.scenarios, alone[1:], strict=True):
        assert mine.objective == pytest.approx(theirs.objective, rel=SIMULATED)
        assert mine.compliance == pytest.approx(theirs.compliance, rel=SIMULATED)
        assert mine.max_deviation == pytest.approx(theirs.max_deviation, rel=SIMULATED)
    total = alone[1].objective + 0.25 * alone[2].objective
    assert found.objective == pytest.approx(total, rel=SIMULATED)
    if WORLD.rank == 0:
        assert len(trajectory.scenarios) == 2 and len(trajectory.solutions) == 3


def test_one_reduction_for_all_scenarios():
    """Factorisations, eigenproblems and solves do not depend on how many scenarios there are."""
    counts = []
    for changes in ([], [PATH, MATERIAL, (DAMPING,), ("payload.mass=4",)]):
        built = build(*([scenarios(*changes)] if changes else []))
        built.evaluate(built.fields(wave))
        counted = built.profile.counts
        counts.append((counted.assemblies, counted.factorisations, counted.solves))
    assert counts[0] == counts[1]


@pytest.mark.serial  # ranks have no part in it
def test_weights_scale_the_worst_case():
    uses = scenarios(PATH, MATERIAL, weights=[2.0, 1.0])
    scene = do.load_scene(TWO_ARM, [uses, "objective.scenarios=worst"])
    value, slopes = combined(scene, [1.0, 1e-3])
    assert value == pytest.approx(2.0, rel=1e-12) and slopes[0] == pytest.approx(2.0, rel=1e-12)
