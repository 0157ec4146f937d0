"""Seconds by phase: each is counted once."""

import pytest

from dolfinopt import profiling as profile
from dolfinopt.profiling import Profile

pytestmark = pytest.mark.serial  # one rank shows all there is


def test_nested_phases_share_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """An inner phase stops the clock of the outer one, also where it ends by an error."""
    now = 0.0
    monkeypatch.setattr(profile.time, "perf_counter", lambda: now)
    found = Profile()
    with found.phase("outer"):
        now += 1.0
        with found.phase("inner"):
            now += 10.0
            with found.phase("outer"):  # of the same name again
                now += 100.0
        now += 1000.0
        with pytest.raises(ZeroDivisionError), found.phase("inner"):
            now += 10_000.0
            raise ZeroDivisionError
        now += 100_000.0
    now += 7.0  # in no phase
    with found.phase("later"):
        now += 3.0
    assert found.seconds == {"outer": 101_101.0, "inner": 10_010.0, "later": 3.0}
