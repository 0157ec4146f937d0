"""States of one arm: computed once, unmoved by later ones."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from runs import TWO_ARM

import dolfinopt as do
from dolfinopt.arms.arm import Arm

pytestmark = pytest.mark.serial  # ranks have no part in it


def small_arm() -> Arm:
    scene = do.load_scene(TWO_ARM, ["arms.cells=[16,3]"])
    return Arm(scene, 0, MPI.COMM_SELF, do.Profile())


def test_a_state_is_computed_once_and_lasts() -> None:
    arm = small_arm()
    counts = arm.profile.counts
    x, other = arm.uniform(0.5), arm.uniform(0.7)
    state = arm.state(x)
    assert arm.state(x.copy()) is state is arm.current
    assert counts.assemblies == 0 and not state.is_reduced  # nothing before it is asked for
    assert state.body is arm.reduce(x) is state.body
    assert (counts.assemblies, counts.factorisations, counts.reductions) == (2, 1, 1)
    K = state.elastic.constraint_modes().stiffness.copy()
    arm.reduce(other)
    assert counts.factorisations == 2
    assert state.body.K is not arm.current.body.K  # the older one keeps what it has
    assert np.array_equal(state.elastic.constraint_modes().stiffness, K)
    assert counts.factorisations == 2
    # Solves with its matrix need the factor, which gave way to the newer one's.
    right = np.ones((state.elastic.num_interior, 1))
    u = state.elastic.solve(right)
    assert counts.factorisations == 3
    field = state.elastic.expand(u, np.zeros((3, 1)))
    residual = state.elastic.restrict(state.elastic.stiffness_times(field))[0] - right
    assert np.abs(residual).max() < 1e-8  # of forces of 1 N
    with pytest.raises(ValueError, match="read-only"):
        state.x_phys[0] = 0.0


def test_what_states_share() -> None:
    """Another order or scene reduces anew only where it must; the factor at hand serves all."""
    arm = small_arm()
    counts = arm.profile.counts
    x = arm.uniform(0.5)
    body = arm.reduce(x)
    changes = ("arms.cells=[16,3]", "damping.stiffness_proportional=1e-3")
    damped = arm.under(do.load_scene(TWO_ARM, changes))
    assert damped.basis is arm.basis
    assert np.allclose(damped.reduce(x).D, 5.0 * body.D, rtol=1e-12)
    assert counts.reductions == 1
    arm.set_order(6)
    assert arm.basis is None and arm.reduce(x).num_modes == 6
    assert damped.reduce(x).num_modes == 4
    assert (counts.reductions, counts.factorisations, counts.assemblies) == (2, 1, 2)


def test_an_arm_without_a_design_says_so() -> None:
    arm = small_arm()
    assert arm.basis is None
    with pytest.raises(RuntimeError, match=r"no design yet: call state"):
        _ = arm.current
