"""How near a motion comes to the limits that a scene states of its joints."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dolfinopt.dynamics.build import Trajectory
from dolfinopt.dynamics.measured import FILE_ROUNDING


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
    for k, joint in enumerate(trajectory.scene.movable):
        unit, force = ("m", "N") if joint.type == "prismatic" else ("rad", "N m")
        if joint.position_limits is not None:
            (lower, upper), q = joint.position_limits, trajectory.motion.q[:, k]
            sides = (lower - q, lower), (q - upper, upper)
            over, limit = max(sides, key=lambda side: float(side[0].max()))
            worst = int(np.argmax(over))
            excess = over[worst] / (max(upper - lower, abs(limit)) or 1.0)
            at = float(trajectory.t[worst])
            met = bool(excess <= FILE_ROUNDING)
            yield JointLimit(joint.name, "position", limit, float(q[worst]), at, unit, met)
        for quantity, bound, values, of in (
            ("velocity", joint.velocity_limit, trajectory.motion.qd, f"{unit}/s"),
            ("effort", joint.effort_limit, trajectory.joint_forces, force),
        ):
            if bound is not None:
                size = np.abs(values[:, k])
                worst = int(np.argmax(size))
                at, met = (
                    float(trajectory.t[worst]),
                    bool(size[worst] <= bound * (1.0 + FILE_ROUNDING)),
                )
                yield JointLimit(joint.name, quantity, bound, float(size[worst]), at, of, met)
