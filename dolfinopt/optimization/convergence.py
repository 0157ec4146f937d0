"""When the iterations end, and how that is said."""

from __future__ import annotations

from typing import Literal

import numpy as np

from dolfinopt.scene.load import Scene
from dolfinopt.units import NOT_MET

# A change above this part of the move limit was cut off by it and tells nothing about convergence.
MOVING = 0.5
# Grayness above which a projection has not done its work: as if 2 % of the cells stood at 1/2.
GREY = 0.02
# A step is too long that leaves a constraint at so many times its value before, or of its limit.
LEAP = 2.0
# A run whose iterations are spent while it exceeds limits by no more than this share goes on with
# steps so much shorter, for so many at most: limits that follow the design settle as steps do.
NEARLY, LANDING, LAST = 0.05, 0.1, 8

Ending = Literal["", "converged", "infeasible", "limit"]


def small_change(scene: Scene) -> float:
    """Return the change of the design variables up to which a design counts as converged."""
    return min(scene.optimizer.tolerance, MOVING * scene.optimizer.move)


def ending(
    scene: Scene, iteration: int, change: float, kkt: float, violated: str, complete: bool
) -> Ending:
    """Return why the iterations end here, "" where they go on.

    Args:
        scene: with the tolerances.
        iteration: design updates made.
        change: largest change of a design variable in the last one.
        kkt: Karush-Kuhn-Tucker residual of the design.
        violated: the constraints that it does not meet, "" if it meets all.
        complete: whether the continuation of the projection has come to its end.
    """
    rests = iteration > 0 and change <= small_change(scene) and complete
    if rests and violated:
        return "infeasible"  # no step mends it: MMA would take it
    if rests and kkt <= scene.optimizer.kkt_tolerance:
        return "converged"
    return "limit" if iteration >= scene.optimizer.max_iterations else ""


def leaps(before: np.ndarray, after: np.ndarray) -> bool:
    """Return whether a step makes things so much worse that its forecast was worth nothing.

    Args:
        before, after: (m,) relative constraints, value / limit - 1.
    """
    return bool((1.0 + after > LEAP * (1.0 + np.maximum(before, 0.0))).any())


def stop_reason(
    scene: Scene, end: str, change: float, kkt: float, violated: str, grayness: float
) -> str:
    """Say in words why the iterations ended, and which constraints are not met.

    Args:
        scene, change, kkt: as for `ending`.
        violated: as for `ending`, and what conflicts with them.
        end: what that returned.
        grayness: of the design.
    """
    options = scene.optimizer
    reason = f"largest change {change:.3g} <= {small_change(scene):g}"
    if end == "converged":
        reason += f", residual {kkt:.2g} <= {options.kkt_tolerance:g}"
    elif end == "limit":
        reason = f"optimizer.max_iterations = {options.max_iterations}"
    if violated:
        reason += f"{NOT_MET}{violated}"
    if scene.design.projection and grayness > GREY:
        reason += f"; the projected design is still grey ({grayness:.2g})"
    return reason
