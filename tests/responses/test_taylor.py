"""Every response that a scene knows by a word has the exact gradient of what it says."""

from __future__ import annotations

import numpy as np
import pytest
from remainders import build, wave

from dolfinopt.optimization.gradient_check import taylor_test
from dolfinopt.scene.tables.objective import EXACT_ONLY, NEEDS, Constraints

QUICK = (
    "simulation.sample=0.01",
    "motion.horizon=2.2",
    "design.filter_radius=0.05",
    "objective.gradient=exact",
)
# Ranks: test_every_option_gives_the_same_bits_on_any_number_of_ranks.
pytestmark = pytest.mark.serial
# Limits whose word means another response as objective are tested by that one.


@pytest.mark.slow
@pytest.mark.parametrize("name", list(NEEDS))
@pytest.mark.usefixtures("three_steps")
def test_remainders_fall_with_the_square_of_the_step(name: str) -> None:
    """Through filter, reduction, simulation and response; new ones are tested by their word alone.

    Mass is linear in the densities of this law: nothing remains.
    """
    built = build(*QUICK, cells=(24, 4))
    objective = built.scene.objective.model_copy(update={"kind": name})
    scene = built.scene.model_copy(update={"objective": objective, "constraints": Constraints()})
    test = taylor_test(scene, built.partition, built.arms, built.fields(wave), built.profile)
    rates = [row.rate for row in test.rows]
    if name == "mass":
        assert rates == [np.inf] * len(rates)
    else:
        # One direction of four may hardly change a response: what remains is rounding.
        told = [rate for rate in rates if np.isfinite(rate)]
        assert len(told) >= 3 and told == pytest.approx([2.0] * len(told), abs=0.1), test
    frozen = "motion" in NEEDS[name] and name not in EXACT_ONLY
    assert np.isfinite(test.angle) == frozen
