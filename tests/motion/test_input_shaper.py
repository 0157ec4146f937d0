"""Input shapers against the exact response of an oscillator to steps."""

import numpy as np
import pytest

from dolfinopt.motion.input_shaper import EI_VIBRATION, input_shaper

FREQUENCY, DAMPING = 40.0, 0.05  # rad/s, -


def left(kind, ratio=1.0, damping=DAMPING):
    """Return what an oscillator at ratio times the frequency keeps of an unshaped step's vibration.

    Its phasor just after the last part of the step, over that of a whole step at that instant.
    """
    shaper = input_shaper(kind, FREQUENCY, DAMPING if damping else 0.0)
    w = ratio * FREQUENCY
    pole = -damping * w + 1j * w * np.sqrt(1.0 - damping**2)
    ages = shaper.longer - shaper.delays
    return float(abs(shaper.amplitudes @ np.exp(pole * ages)) / abs(np.exp(pole * shaper.longer)))


@pytest.mark.parametrize("kind", ["zv", "zvd"])
def test_nothing_vibrates_at_the_frequency(kind):
    assert left(kind) < 1e-12


def test_zvd_is_flat_and_zv_is_not():
    """Off the frequency ZV leaves in proportion, ZVD the square."""
    near, far = (np.array([left(kind, 1.0 + x) for kind in ("zv", "zvd")]) for x in (0.01, 0.02))
    assert np.log2(far / near) == pytest.approx([1.0, 2.0], abs=0.05)


def test_ei_leaves_its_share_and_has_a_wide_band():
    assert left("ei", damping=0.0) == pytest.approx(EI_VIBRATION)
    band = [left("ei", 1.0 + x, damping=0.0) for x in np.linspace(-0.19, 0.19, 39)]
    assert max(band) < 1.05 * EI_VIBRATION  # ZVD: 0.087
    assert left("zvd", 1.19, damping=0.0) > 1.5 * EI_VIBRATION


def test_a_shaped_command_begins_and_ends_with_the_command():
    shaper, t = input_shaper("zvd", FREQUENCY, DAMPING), np.linspace(0.0, 2.0, 41)
    found = shaper.shaped(lambda t: np.stack([np.minimum(t, 1.0), np.cos(t)], axis=1), t)
    assert shaper.amplitudes.sum() == pytest.approx(1.0)
    assert found[0] == pytest.approx([0.0, 1.0]) and found[-1, 0] == pytest.approx(1.0)
