"""When the iterations end, and how that is said."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum

from dolfinopt.optimization.measured import REACHED_LIMIT_SHARE, WINDOW
from dolfinopt.optimization.state import Best, Progress
from dolfinopt.responses.constraints import Limit
from dolfinopt.scene.load import Scene


class StopCode(Enum):
    """Why the iterations ended; the values stand in summary.json."""

    SIMULATED = "simulated"  # there were none
    SETTLED = "settled"  # the best design gains no more
    INFEASIBLE = "infeasible"  # no design keeps the limits, and the violation falls no more
    STUCK = "stuck"  # no step from the last design has a motion
    ITERATIONS = "iterations"  # all are spent


def stop_code(
    scene: Scene, iteration: int, progress: Progress, best: Best, stuck: str
) -> StopCode | None:
    """Return why the iterations end here, None where they go on.

    A run ends where its best design gained at most `optimizer.tolerance` in `WINDOW` iterations of
    one projection, or in three times as many while no design keeps all limits, and where no step
    leads on. It is looked at four times a window, so that rounding does not change their number.

    Args:
        scene: with the tolerance and the largest number of iterations.
        iteration: design updates made.
        progress: of the iterations.
        best: the best design so far.
        stuck: why no step leads on, "" where one does.
    """
    feasible = best.excess == 0.0
    if stuck:
        gains_nothing = feasible and iteration - best.iteration >= WINDOW
        return StopCode.SETTLED if gains_nothing else StopCode.STUCK
    if iteration and iteration % (WINDOW // 4) == 0:
        if progress.gain(WINDOW if feasible else 3 * WINDOW) <= scene.optimizer.tolerance:
            return StopCode.SETTLED if feasible else StopCode.INFEASIBLE
    return StopCode.ITERATIONS if iteration >= scene.optimizer.max_iterations else None


def ending(
    scene: Scene, code: StopCode, progress: Progress, kept: bool, stuck: str, returned: str
) -> str:
    """Say in words why the iterations ended.

    Args:
        scene, progress, stuck: as for `stop_code`.
        code: what that returned.
        kept: whether the design meets all limits.
        returned: which design is returned, "" for the last one.
    """
    tolerance, options = 100.0 * scene.optimizer.tolerance, scene.optimizer
    gain = 100.0 * progress.gain(WINDOW)
    reason = {
        StopCode.SETTLED: f"finished: at most {tolerance:g} % gained in {WINDOW} iterations",
        StopCode.INFEASIBLE: f"stopped: the limits are not met, and their violation fell by at "
        f"most {tolerance:g} % in {3 * WINDOW} iterations",
        StopCode.STUCK: f"stopped: no step leads on ({stuck})",
        StopCode.ITERATIONS: f"stopped after optimizer.max_iterations = {options.max_iterations}",
    }[code]
    if code is StopCode.ITERATIONS and kept and gain < 100.0:
        reason += f", {gain:.2g} % gained in the last {WINDOW}"
    return f"{reason}; {returned}" if returned else reason


def conflicts(code: StopCode, limits: Sequence[Limit], solid: Sequence[Limit] = ()) -> str:
    """Say what holds back the limits that a design does not meet; "" if it meets all.

    Where no step lessens their violation any more, they conflict with those that are reached. All
    of the volume is no limit that could be relaxed, but that of a solid arm.

    Args:
        code: why the iterations ended.
        limits: of the design.
        solid: of solid arms, as far as they were looked at.
    """
    missed = {limit.name for limit in limits if not limit.met}
    if not missed:
        return ""
    if code is StopCode.ITERATIONS:
        beyond = [item.usage for item in solid if not item.met and item.name in missed]
        if beyond:
            return f"solid arms do not keep it either ({', '.join(beyond)}): relax it"
        return "let the optimisation go on (optimizer.max_iterations)"
    *rest, last = sorted(
        limit.words
        for limit in limits
        if limit.excess >= -REACHED_LIMIT_SHARE
        and not (limit.quantity == "volume_fraction" and limit.limit >= 1.0)
    )
    if rest:
        return f"{', '.join(rest)} and {last} conflict: relax one of them"
    return "no design near this one keeps it, whatever its material: relax it"
