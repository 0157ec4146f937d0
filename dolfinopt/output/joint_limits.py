"""How near a motion comes to the limits that a scene states of its joints."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dolfinopt.dynamics.build import Trajectory
from dolfinopt.dynamics.measured import FILE_ROUNDING
from dolfinopt.output.trajectory import FORCE_OF


@dataclass(frozen=True)
class JointLimit:
    """How near a motion comes to one of a joint's limits.

    Attributes:
        joint: its name.
        quantity: "position", "velocity" or "effort".
        limit: of the coordinate, or of the absolute value.
        value: where it is nearest to the limit or farthest beyond it.
        instant: of that, s.
        unit: of limit and value.
        met: whether it stays within the limit.
    """

    joint: str
    quantity: str
    limit: float
    value: float
    instant: float
    unit: str
    met: bool

    @property
    def sentence(self) -> str:
        """E.g. "elbow 3.2 of 3.1416 rad at 1.2 s"."""
        used = f"{self.joint} {self.value:.4g} of {self.limit:.4g} {self.unit}"
        return f"{used} at {self.instant:.3g} s"


def joint_limits(trajectory: Trajectory) -> Iterator[JointLimit]:
    """Yield how a motion stands to every limit of position, velocity and effort."""
    motion, forces = trajectory.motion, trajectory.joint_forces
    for k, joint in enumerate(trajectory.scene.movable):
        unit = trajectory.scene.rigid_units[joint.name]
        for quantity, bounds, values, of in (
            ("position", joint.position_limits, motion.q, unit),
            ("velocity", joint.velocity_limit, motion.qd, f"{unit}/s"),
            ("effort", joint.effort_limit, forces, FORCE_OF[unit]),
        ):
            if bounds is None:
                continue
            lower, upper = bounds if isinstance(bounds, tuple) else (-bounds, bounds)
            x = values[:, k]
            over = np.maximum(lower - x, x - upper)
            worst = int(np.argmax(over))
            value = float(x[worst])
            limit = lower if value - lower < upper - value else upper
            scale = max(upper - lower, abs(limit)) if quantity == "position" else upper
            if quantity != "position":  # of the absolute value
                value, limit = abs(value), upper
            met = bool(over[worst] <= FILE_ROUNDING * (scale or 1.0))
            at = float(trajectory.t[worst])
            yield JointLimit(joint.name, quantity, limit, value, at, of, met)
