"""How much work simulations may take: attempts that need not succeed end early."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

import numpy as np

from dolfinopt.errors import ConvergenceError


class GivenUp(ConvergenceError):
    """A simulation that no other steps would save: whoever can try others does not."""


@dataclass
class Work:
    """Newton iterations times time steps.

    Attributes:
        most: that may be done.
        done: so far, of all simulations.
    """

    most: float = np.inf
    done: float = 0.0

    def add(self, amount: float) -> None:
        """Count some work.

        Raises:
            GivenUp: it is more than may be done.
        """
        self.done += amount
        if self.done > self.most:
            raise GivenUp(
                f"the simulation takes more than {self.most:.3g} Newton iterations times time "
                "steps: the arms deform beyond small-deflection theory"
            )


_WORK: ContextVar[Work | None] = ContextVar("work", default=None)


@contextmanager
def counted(most: float = np.inf) -> Iterator[Work]:
    """Count the work of simulations within, and end them where it is more than `most`."""
    work = Work(most)
    token = _WORK.set(work)
    try:
        yield work
    finally:
        _WORK.reset(token)


def spend(amount: float) -> None:
    """Count work where somebody wants it counted, see `Work.add`."""
    if (work := _WORK.get()) is not None:
        work.add(amount)
