"""Responses as users of the package write them: one class, registered, as objective or limit."""

import numpy as np
import pytest
from declared import withdrawn
from remainders import beside_volume, build, limit_rates, wave
from runs import TWO_ARM

import dolfinopt as do
from dolfinopt.parallel import on_all_ranks, together
from dolfinopt.responses.motion import Deviation
from dolfinopt.responses.response import (
    Measured,
    Response,
    constraints_of,
    find,
    find_limited,
    needs,
    p_norm,
    p_norm_of_lengths,
    response,
    worst_of,
)
from dolfinopt.scene.tables.responses import DECLARED, objective_kinds


class Roughness(Response):
    """Integral of (x - x0)^2 over every design's cells, m2: least where x is x0 everywhere."""

    level = 0.3

    def measure(self, analysis):
        with together(analysis.partition.world):
            mine = {
                k: float(one.mesh.area @ (one.x_phys - self.level) ** 2)
                for k, one in analysis.designs.items()
            }
        found = on_all_ranks(analysis.partition, mine)
        values = tuple(found.values())
        return Measured(
            self.name, tuple(analysis.scene.arms[k].name for k in found), values, values
        )

    def gradients(self, analysis):
        return [
            {
                k: 2.0 * one.mesh.area * (one.x_phys - self.level) * float(k == owner)
                for k, one in analysis.designs.items()
            }
            for owner in analysis.scene.cell_counts
        ]


class MeanSquare(Deviation):
    """Integral of |e|^2 over the horizon, m2 s."""

    def value(self, y, weights):
        return float(weights @ (y**2).sum(axis=1))

    def gradient(self, y, weights):
        return 2.0 * weights[:, None] * y

    def extreme(self, trajectory):
        return self.of_motion(trajectory)


@pytest.fixture(autouse=True, scope="module")
def _declared():
    """Declare both; leave the scenes of other tests without these words."""
    with withdrawn():
        response(
            "roughness",
            label="distance from even filling",
            unit="m2",
            needs=frozenset(),
            limit="upper limit of the distance from even filling [m2]",
        )(Roughness)
        squared = "upper limit of the squared deviation [m2 s]"
        response("mean_square", unit="m2 s", limit=squared)(MeanSquare)
        yield


QUICK = "arms.cells=[24,4]", "simulation.sample=0.01", "reduction.coordinates=3"


@pytest.mark.serial
def test_a_new_response_is_minimised():
    """The optimiser finds what is known: x0 everywhere; nothing but the result is simulated."""
    words = [*QUICK, "optimizer.max_iterations=60", "objective.kind=roughness"]
    scene = do.load_scene(TWO_ARM, words)
    result = do.optimize(scene)  # no limit is active: there is no gradient left to be balanced
    for k, x in result.x_phys.items():
        # The filter smooths away what is left at the solid ends, if any.
        free = ~result.arms[k].mesh.passive
        np.testing.assert_allclose(x[free], Roughness.level, atol=2e-3)
    assert result.counts.simulations == 0


@pytest.mark.serial
def test_a_new_response_is_a_limit():
    """Of the stiffest design that is nearly even: the limit is met and in its row's name."""
    options = [*QUICK, "optimizer.max_iterations=60", "objective.kind=static"]
    limit, options = 2e-4, [*options, "design.initial=0.4"]
    scene = do.load_scene(TWO_ARM, options)
    limited = do.load_scene(TWO_ARM, [*options, f"constraints.roughness={limit}"])
    free, kept = do.optimize(scene), do.optimize(limited)
    values = {one.name: one for one in kept.limits}
    assert set(values) == {
        *(f"volume_fraction_{arm.name}" for arm in scene.arms),
        *(f"roughness_{arm.name}" for arm in scene.arms),
    }
    for arm in scene.arms:
        one = values[f"roughness_{arm.name}"]
        assert one.unit == "m2" and one.met
        assert one.value == pytest.approx(limit, rel=0.02)  # active
    assert kept.evaluation.objective > 1.05 * free.evaluation.objective
    assert kept.evaluation.values_of("roughness") == tuple(
        values[f"roughness_{arm.name}"].value for arm in scene.arms
    )


@pytest.mark.serial
@pytest.mark.parametrize("name", ["deviation", "mean_square"])
def test_an_objective_of_the_motion_is_a_limit(name):
    """The same class on the other side: value over limit less 1, with the gradient of that."""
    built = build(*QUICK, "objective.kind=static", "objective.gradient=exact",
                  "motion.horizon=1.9", "simulation.tolerance=1e-7",
                  f"constraints.{name}=0.01")  # fmt: skip
    assert needs(built.scene, "motion")
    evaluation, _ = built.evaluate(built.fields(wave))
    own = evaluation.responses[-1]
    assert own.response == name
    assert beside_volume(evaluation) == pytest.approx((own.values[0] / 0.01 - 1.0,), rel=1e-12)
    # Steps at which what is left of the time error, 1e-7, stays below the remainders.
    assert limit_rates(built, (4e-2, 1e-2)) == pytest.approx([2.0], abs=0.2)


def test_limits_are_found_by_their_keys():
    """One response, one class, whatever its limit is called."""
    built = build("constraints.first_frequency=3.0", "constraints.tip_deflection=1e-6")
    names = [one.response.name for one in constraints_of(built.scene)]
    assert names == ["volume_fraction", "eigenfrequency", "tip_deflection"]
    assert find_limited("compliance") is find("esl")


@pytest.mark.parametrize("scale", [1e-150, 1.0, 1e150])
@pytest.mark.parametrize("exponent", [2.0, 20.0, 200.0])
def test_p_norm(scale, exponent):
    """Between the largest value and its bound, derivative by differences; no over- or underflow."""
    rng = np.random.default_rng(3)
    values = scale * rng.uniform(0.5, 1.0, 5)
    value, by_values = p_norm(values, exponent)
    assert values.max() <= value <= values.max() * 5.0 ** (1.0 / exponent) * (1.0 + 1e-15)
    assert by_values @ values == pytest.approx(value, rel=1e-13)  # of degree one
    weights = rng.uniform(0.0, 1.0, 5)
    weights /= weights.sum()
    mean, _ = p_norm(values, exponent, weights)
    assert mean <= values.max()
    h = 1e-6 * scale
    for k in range(5):
        for w, derivative in ((1.0, by_values), (weights, p_norm(values, exponent, weights)[1])):
            there, back = (p_norm(values + s * h * np.eye(5)[k], exponent, w)[0] for s in (1, -1))
            assert derivative[k] == pytest.approx((there - back) / (2.0 * h), abs=1e-7)
    vectors = values[:, None] * [0.6, 0.8]
    vectors[0] = 0.0
    norm, by_vectors = p_norm_of_lengths(vectors, exponent)
    lengths, by_lengths = p_norm(np.hypot(*vectors.T), exponent)
    assert norm == pytest.approx(lengths, rel=1e-14)
    assert by_vectors[1:] @ [0.6, 0.8] == pytest.approx(by_lengths[1:], rel=1e-12)
    assert not by_vectors[0].any()


def test_p_norm_of_nothing():
    assert p_norm(np.zeros(3), 20.0)[0] == 0.0
    assert not p_norm(np.zeros(3), 20.0)[1].any()
    assert p_norm_of_lengths(np.zeros((3, 2)), 20.0)[0] == 0.0


def test_the_least_made_smooth():
    """At most the least value, derivative by differences; a single value is itself."""
    values = [3.0, 2.0, 2.2]
    least, slopes = worst_of(values, 20.0, least=True)
    assert 2.0 * 3.0 ** (-1.0 / 20.0) <= least <= 2.0
    for k in range(3):
        there, back = (
            worst_of([v + s * 1e-6 * (i == k) for i, v in enumerate(values)], 20.0, least=True)[0]
            for s in (1.0, -1.0)
        )
        assert slopes[k] == pytest.approx((there - back) / 2e-6, rel=1e-6)
    for values, least, slopes in (([3.0], 3.0, [1.0]), ([3.0, 0.0], 0.0, [0.0, 0.0])):
        value, by_values = worst_of(values, 20.0, least=True)
        assert value == least and list(by_values) == slopes


@pytest.mark.parametrize("name", objective_kinds())
def test_responses_stand_in_the_files_that_are_imported_for_them(name):
    assert find(name).declared is DECLARED[name]
