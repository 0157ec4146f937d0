"""Where the seconds went and how often the costly things were done."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields


@dataclass
class Counts:
    """How often the costly steps ran, over all arms.

    Attributes:
        forms: whose kernels give the cells' matrices, stresses and their derivatives.
        assemblies: of a stiffness or a mass matrix.
        factorisations, solves: of and with the stiffness of an arm's interior.
        eigenproblems: of an arm.
        reductions: of an arm to a basis.
        simulations: of a motion.
        newton_iterations: of the simulations.
        adjoints: backward integrations of a motion.
        energy_fields: whose energy was taken cell by cell, for gradients.
    """

    forms: int = 0
    assemblies: int = 0
    factorisations: int = 0
    solves: int = 0
    eigenproblems: int = 0
    reductions: int = 0
    simulations: int = 0
    newton_iterations: int = 0
    adjoints: int = 0
    energy_fields: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


@dataclass
class Profile:
    """Seconds by phase and counts of one run on one rank.

    Attributes:
        seconds: wall-clock time by phase, s; a phase within another one counts for itself only,
            so that their sum is the time spent in phases.
        counts: see `Counts`.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    counts: Counts = field(default_factory=Counts)
    _running: list[str] = field(default_factory=list, repr=False)  # innermost last
    _since: float = field(default=0.0, repr=False)  # what the innermost has not been given yet, s

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Add the time spent in the block, without the phases inside it, to phase `name`."""
        self._credit()
        self._running.append(name)
        try:
            yield
        finally:
            self._credit()
            self._running.pop()

    def _credit(self) -> None:
        """Give the time since the last change of phase to the innermost one."""
        now = time.perf_counter()
        if self._running:
            name = self._running[-1]
            self.seconds[name] = self.seconds.get(name, 0.0) + now - self._since
        self._since = now
