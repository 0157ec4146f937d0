"""First natural frequency of every flexible arm, whichever mode it belongs to."""

from __future__ import annotations

from dolfinopt.responses.eigenfrequency import Eigenfrequency
from dolfinopt.responses.response import register


@register
class FirstFrequency(Eigenfrequency):
    """The longest period even where `objective.follow` follows a mode: a limit is for all."""

    name = "first_frequency"

    @property
    def follow(self) -> bool:
        """False: the lowest mode counts."""
        return False
