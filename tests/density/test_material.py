"""Interpolation laws: published values, slopes against the complex step, and local modes."""

import numpy as np
import pytest
from mpi4py import MPI
from runs import demo

from dolfinopt.density.interpolation import LAWS, SWITCH, interpolate

pytestmark = pytest.mark.serial  # ranks have no part in it

BOTH_SIDES = SWITCH * (1.0 + np.array([-1e-3, -1e-9, -2e-16, 0.0, 2e-16, 1e-9, 1e-3]))
X = np.sort(np.concatenate([np.linspace(0.0, 1.0, 101), BOTH_SIDES]))
FLOOR = 1e-6
ROUNDING = 4e-15  # a handful of operations on numbers of order one (penalty <= 5)


def values(x, law, penalty=3.0, floor=FLOOR):
    return interpolate(np.atleast_1d(np.asarray(x, dtype=float)), law, penalty, floor)


# -- values ----------------------------------------------------------------------------------


@pytest.mark.parametrize("floor", [1e-9, 1e-6, 0.1])
@pytest.mark.parametrize("penalty", [1.0, 3.0, 4.5])
@pytest.mark.parametrize("law", sorted(LAWS))
def test_every_law_joins_void_and_solid(law, penalty, floor):
    ends = values([0.0, 1.0], law, penalty, floor)
    void = floor if law == "two-material" else floor**2
    assert ends.stiffness == pytest.approx([void, 1.0], rel=ROUNDING)
    # Equal ratios of stiffness to mass at both ends: perfect void has no slow local modes.
    assert ends.mass == pytest.approx([void, 1.0], rel=ROUNDING)


@pytest.mark.parametrize(
    ("law", "x", "stiffness", "mass"),
    [
        ("two-material", 0.5, 0.125 + 0.875e-6, 0.5 + 0.5e-6),
        ("simp", 0.5, 0.125, 0.5),
        ("simp", 1e-3, 1e-9, 1e-3),
        ("pedersen", 0.5, 0.125, 0.5),
        ("pedersen", 0.05, 0.05 / 100.0, 0.05),
        ("pedersen", 1e-3, 1e-5, 1e-3),
        ("du-olhoff", 0.5, 0.125, 0.5),
        ("du-olhoff", 0.05, 0.05**3, 6e5 * 0.05**6 - 5e6 * 0.05**7),
        ("ramp", 0.5, 0.5 / 2.5, 0.5),
        ("ramp", 1e-3, 1e-3 / 3.997, 1e-3),
    ],
)
def test_published_values(law, x, stiffness, mass):
    """With penalty 3; the trace of a second material adds floor^2 = 1e-12."""
    at = values(x, law)
    assert at.stiffness == pytest.approx([stiffness], rel=ROUNDING, abs=1.01 * FLOOR**2)
    assert at.mass == pytest.approx([mass], rel=ROUNDING, abs=1.01 * FLOOR**2)


# -- slopes ----------------------------------------------------------------------------------


@pytest.mark.parametrize("law", sorted(LAWS))
@pytest.mark.parametrize("penalty", [1.0, 2.0, 3.0, 4.5])
def test_slopes_are_the_derivatives(law, penalty):
    # f(x + ih) = f + ih f' exactly up to rounding: no difference is taken. From 0, where x^p has
    # a branch point, plain evaluation of the limit serves.
    step = 1e-30
    floor = 1e-3
    at = interpolate(X, law, penalty, floor)
    shifted = interpolate(X[1:] + 1j * step, law, penalty, floor)
    # NumPy's complex power goes through exp(p log x): p |log x| units in the last place. Du and
    # Olhoff's slope is a difference of 36 and 35.
    rounding = (300 if law == "du-olhoff" else 10) * ROUNDING
    assert np.abs(shifted.stiffness.imag / step - at.stiffness_slope[1:]).max() < rounding
    assert np.abs(shifted.mass.imag / step - at.mass_slope[1:]).max() < rounding
    at_zero = interpolate(np.array([0.0, 1e-12]), law, penalty, floor)
    # The limit's error is of order 1e-12 (p >= 2) or rounding of the values over 1e-12 (p = 1).
    for value, slope in ((at_zero.stiffness, at.stiffness_slope), (at_zero.mass, at.mass_slope)):
        assert np.diff(value)[0] / 1e-12 == pytest.approx(slope[0], abs=1e-6)


# -- in a scene ------------------------------------------------------------------------------


def test_local_modes_of_a_frame_with_void(shared_tmp_path):
    """Classic SIMP's lowest modes live in the windows; the other laws' are the frame's."""
    spectra = demo("demo_localised_modes").main(shared_tmp_path, (40, 6), (1e-3, 1e-2, 0.0))
    if MPI.COMM_WORLD.rank > 0:
        assert spectra == []
        return
    found = {(one.law, one.void): one for one in spectra}
    simp = found["simp", 1e-3]
    assert simp.frequency[-1] < found["du-olhoff", 1e-3].frequency[0]  # all below the frame's first
    assert (simp.strain > 0.99).all() and (simp.kinetic > 0.99).all()
    assert found["simp", 1e-2].local.sum() >= 2
    for void in (1e-3, 1e-2):
        for law in ("pedersen", "du-olhoff", "ramp"):
            assert not found[law, void].local.any()
    # Two-material does as far as its floor is not small beside x^3.
    assert not found["two-material", 1e-3].local.any()
    assert found["two-material", 1e-2].local.any()
    # All of them agree about the frame alone. Two-material's windows are as stiff as 1e-6 of solid,
    # which adds 0.41 % to one frequency.
    for law in LAWS:
        assert not found[law, 0.0].local.any()
        assert found[law, 0.0].frequency == pytest.approx(found["simp", 0.0].frequency, rel=5e-3)
    assert (shared_tmp_path / "localised_modes.png").stat().st_size > 10_000
