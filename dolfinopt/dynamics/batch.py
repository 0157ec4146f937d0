"""Several systems, one after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from dolfinopt.dynamics import radau
from dolfinopt.dynamics.collocation import Solution
from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.dynamics.measured import BATCH_NEWTON_SHARE
from dolfinopt.errors import ConvergenceError
from dolfinopt.profiling import Profile


def integrate(
    systems: Sequence[ElasticSystem],
    tolerance: float,
    stages: int,
    profile: Profile,
    guesses: Sequence[Solution | None],
    goal: float = BATCH_NEWTON_SHARE,
) -> list[Solution | ConvergenceError]:
    """Solve every system by `radau.integrate`; one that cannot be solved has its error."""
    return [
        attempted(radau.integrate, system, tolerance, stages, profile, guess)
        for system, guess in zip(systems, guesses, strict=True)
    ]


def attempted(solve: Callable[..., Solution], *arguments: Any) -> Solution | ConvergenceError:
    """Return what `solve` finds, or its error."""
    try:
        return solve(*arguments)
    except ConvergenceError as error:
        return error
