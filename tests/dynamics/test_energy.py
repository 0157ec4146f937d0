"""The drives' work under gravity: what is not stored as energy is what damping took."""

from __future__ import annotations

import numpy as np
import pytest
from reference_machines import (
    GAINS,
    Tree,
    energies,
    four_bar,
    imbalance,
    simulated,
    slider_crank,
    two_arm,
    with_keys,
)

pytestmark = pytest.mark.serial  # the trajectory belongs to one rank

# Ten times the earth's in the loops, whose speed leaves little to it.
EARTH, STRONG = {"gravity": [0.0, -9.81]}, {"gravity": [0.0, -98.1]}


def arms(stiffening: bool, **changes: object) -> Tree:
    """Return the two-arm machine on few cells, motors at its joints, under gravity."""
    overrides = ("arms.cells=[20,3]", "reduction.coordinates=3", "motion.horizon=2.2")
    simulation = {"stiffening": stiffening, "tolerance": 1e-6}
    tree = two_arm(*overrides, motion=EARTH, simulation=simulation)
    for arm in tree["arms"]:
        arm |= {"joint_mass": 0.5, "joint_inertia": 0.01}
    return with_keys(tree, changes)


def loop(tree: Tree) -> Tree:
    """Return a closed loop of soft bars under gravity."""
    tree["material"]["young_modulus"] *= 0.1
    keys = {"simulation": {"tolerance": 1e-6}, "reduction": {"coordinates": 3}}
    return with_keys(tree, {**keys, "motion": {**STRONG, "horizon": 0.1}})


SCENES = {
    "prescribed": lambda: arms(False),
    "prescribed, stiffened": lambda: arms(True),
    "controlled": lambda: arms(False, control=GAINS),
    "controlled, stiffened": lambda: arms(True, control=GAINS),
    "slider": lambda: loop(slider_crank(0.012, (20, 3))),
    "pin": lambda: loop(four_bar((20, 3))),
}


@pytest.mark.parametrize("kind", SCENES)
def test_work_under_gravity_is_energy(kind: str) -> None:
    """Drive work = kinetic + strain + potential energy + what damping took."""
    result = simulated(SCENES[kind]())
    trajectory = result.trajectory
    assert trajectory is not None
    parts = [np.ptp(one) for one in energies(trajectory, trajectory.t)]
    assert min(parts) > 1e-4 * max(parts)  # each of them counts
    assert imbalance(result) < 1e-8  # measured 2e-11 at most
