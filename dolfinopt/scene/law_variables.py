"""The motion's law as design variables: coefficients of its shape, and its duration.

The duration is one where it is the objective; the rest behind the motion gets longer with it.
"""

from __future__ import annotations

import numpy as np

from dolfinopt.scene.duration import least_duration
from dolfinopt.scene.schema import Scene
from dolfinopt.scene.tables.motion import SHAPE_LIMIT

LAW = -1  # in place of an arm's index: the law's variables
DURATION_RANGE = 0.25, 2.0  # shares of the stated one
MARGIN = 1e-4  # by which it stays above the limits', for differences by the duration


def law_names(scene: Scene) -> tuple[str, ...]:
    """Return the names of the law's n variables, as files have them."""
    shape = tuple(f"shape {k + 1}" for k in range(len(scene.motion.coefficients)))
    return (*shape, "duration") if scene.objective.kind == "duration" else shape


def law_values(scene: Scene) -> np.ndarray:
    """Return the law's variables (n,): shares of the way, and s."""
    motion, names = scene.motion, law_names(scene)
    return np.array([*motion.coefficients, motion.duration][: len(names)])


def law_bounds(scene: Scene) -> np.ndarray:
    """Return the least and the largest values (2, n) for a scene as it is stated."""
    low, high = scene.motion.duration * np.array(DURATION_RANGE)
    low = max(low, (1.0 + MARGIN) * (least_duration(scene.motion)[0] or 0.0))
    count, n = len(scene.motion.coefficients), len(law_names(scene))
    return np.array([[*[-SHAPE_LIMIT] * count, low][:n], [*[SHAPE_LIMIT] * count, high][:n]])


def with_law(scene: Scene, values: np.ndarray) -> Scene:
    """Return a scene whose law has these variables (n,)."""
    motion, count = scene.motion, len(scene.motion.coefficients)
    changes: dict[str, object] = {"shape": tuple(map(float, values[:count]))} if count else {}
    if len(values) > count:
        duration = float(values[-1])
        horizon = duration * (motion.horizon / motion.duration)
        changes |= {"duration": duration, "horizon": max(duration, horizon)}
    return scene.unchecked_copy({"motion": motion.unchecked_copy(changes)}) if changes else scene
