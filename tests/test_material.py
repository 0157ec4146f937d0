"""Interpolation laws: their ends, and their slopes against the complex step."""

from __future__ import annotations

import numpy as np
import pytest

from dolfinopt.material import LAWS, interpolate

X = np.linspace(0.0, 1.0, 101)
ROUNDING = 4e-15  # a handful of operations on numbers of order one (penalty <= 5)


@pytest.mark.parametrize("floor", [1e-9, 1e-6, 0.1])
@pytest.mark.parametrize("penalty", [1.0, 3.0, 4.5])
def test_two_material_law_joins_the_weak_and_the_solid_material(penalty, floor):
    ends = interpolate(np.array([0.0, 1.0]), "two-material", penalty, floor)
    assert ends.stiffness == pytest.approx([floor, 1.0], rel=ROUNDING)
    # Equal ratios of stiffness to mass at both ends: void has no slow local modes.
    assert ends.mass == pytest.approx([floor, 1.0], rel=ROUNDING)


def test_two_material_law_in_the_middle():
    half = interpolate(np.array([0.5]), "two-material", 3.0, 1e-6)
    assert half.stiffness == pytest.approx([0.125 + 0.875e-6], rel=ROUNDING)
    assert half.mass == pytest.approx([0.5 + 0.5e-6], rel=ROUNDING)


@pytest.mark.parametrize("law", sorted(LAWS))
@pytest.mark.parametrize("penalty", [1.0, 2.0, 3.0, 4.5])
def test_slopes_are_the_derivatives(law, penalty):
    # f(x + ih) = f + ih f' exactly up to rounding: no difference is taken. From 0, where x^p has
    # a branch point, plain evaluation of the limit serves.
    step = 1e-30
    floor = 1e-3
    values = interpolate(X, law, penalty, floor)
    shifted = interpolate(X[1:] + 1j * step, law, penalty, floor)
    # NumPy's complex power goes through exp(p log x): p |log x| units in the last place.
    rounding = 10 * ROUNDING
    assert np.abs(shifted.stiffness.imag / step - values.stiffness_slope[1:]).max() < rounding
    assert np.abs(shifted.mass.imag / step - values.mass_slope[1:]).max() < rounding
    at_zero = interpolate(np.array([0.0, 1e-12]), law, penalty, floor)
    # The limit's error is of order 1e-12 (p >= 2) or rounding of the values over 1e-12 (p = 1).
    difference = np.diff(at_zero.stiffness)[0] / 1e-12
    assert difference == pytest.approx(values.stiffness_slope[0], abs=1e-6)


@pytest.mark.parametrize("law", sorted(LAWS))
def test_more_material_is_stiffer_and_heavier(law):
    values = interpolate(X, law, 3.0, 1e-6)
    assert (np.diff(values.stiffness) > 0.0).all()
    assert (np.diff(values.mass) > 0.0).all()


def test_input_is_left_alone():
    x = X.copy()
    interpolate(x, "two-material", 3.0, 1e-6)
    assert np.array_equal(x, X)


def test_unknown_law():
    with pytest.raises(KeyError, match="no-such-law"):
        interpolate(X, "no-such-law", 3.0, 1e-6)
