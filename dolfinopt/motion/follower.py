"""Joints of rigid links that follow closures and a path, at any instant, in plane and space.

From the start samples are followed by a predictor of second order and Newton's method; four times
as many by Newton's method from their Hermite spline, which singular positions are looked for in.
At any instant Newton's method sets out from the spline; rates solve the differentiated equations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from dolfinopt.errors import InputError
from dolfinopt.motion.constraints import Target
from dolfinopt.motion.measured import SAMPLES, TURN_LIMIT
from dolfinopt.motion.singular import BranchLost, Regularity, Samples
from dolfinopt.motion.start import Start, nearest, start_of, unreached
from dolfinopt.motion.task import Task
from dolfinopt.paths import Values

LEAST_STEP = 1e-6  # of the motion: behind a shorter step there is no continuation
REFINED = 4  # instants a sample at which singular positions are looked for


@dataclass(frozen=True, eq=False)
class Follower:
    """See the module."""

    task: Task

    @cached_property
    def start(self) -> Start:
        """Where it begins."""
        return start_of(self.task)

    @cached_property
    def _regularity(self) -> Regularity:
        return Regularity(self.task, self.start)

    @cached_property
    def table(self) -> CubicHermiteSpline:
        """All coordinates over time, to some 1e-5.

        Raises:
            InputError: the motion cannot be followed, or passes a singular position.
        """
        for turn in (TURN_LIMIT, TURN_LIMIT / 8.0, TURN_LIMIT / 64.0):
            try:
                return self._followed(turn)
            except BranchLost:
                continue
        raise InputError(
            f"{self.task.words.source}: closures: two branches of the loop come so close that they "
            f"are not told apart; change {self.task.words.motion} or the arms' lengths"
        )

    def at(self, t: np.ndarray) -> Values:
        """Return all coordinates and two derivatives (n, R) at instants t (n,), s.

        Raises:
            InputError: the motion cannot be followed, or passes a singular position.
        """
        task, table = self.task, self.table
        if len(t) == 0:
            none = np.zeros((0, len(task.names)))
            return none, none, none
        target = task.target(t)
        q = task.with_given(table(np.clip(t, 0.0, task.end)), target)
        q = task.newton(q, target)[0]
        off = np.linalg.norm(task.constraints.error(q, target), axis=1)
        wrong = np.flatnonzero(~(off <= self.start.tolerance(task.constraints.reach)))
        if wrong.size:
            raise self._lost(q[wrong[0]], float(t[wrong[0]]))
        return q, *task.rates(q, target)

    # -- samples -----------------------------------------------------------------------------

    def _followed(self, turn: float) -> CubicHermiteSpline:
        """Return samples between which no coordinate changes by more than `turn`."""
        lost: list[InputError] = []
        t, q, qd = (np.array(x) for x in zip(*self._samples(turn, lost), strict=True))
        if len(t) > 1:
            fine = np.interp(np.arange(REFINED * (len(t) - 1) + 1) / REFINED, np.arange(len(t)), t)
            target = self.task.target(fine)
            q = self.task.with_given(CubicHermiteSpline(t, q, qd)(fine), target)
            q, _, G = self.task.newton(q, target)
            t, qd = fine, self.task.velocity(G, target)
        self._regularity.check((t, q, qd))
        if lost:
            raise lost[0]
        return CubicHermiteSpline(t, q, qd)

    def _samples(
        self, turn: float, lost: list[InputError]
    ) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
        """Yield instants, poses and rates (R,); put into `lost` why they end before the motion."""
        task = self.task
        units, end = task.constraints.units[task.unknown], task.end
        instants, way = self._way
        self._regularity.check(self._first)
        t, q, qd = (x[0] for x in self._first)
        yield t, q, qd
        step, bent = end / SAMPLES, np.zeros_like(qd)
        while t < end * (1.0 - 1e-12):
            farthest = float(np.interp(np.interp(t, instants, way) + turn, way, instants))
            ahead = min(t + step, end, max(farthest, t + LEAST_STEP * end))
            target, h = task.target(np.array([ahead])), ahead - t
            guess = task.with_given((q + h * qd + 0.5 * h * h * bent)[None], target)
            found = self._reached(guess, target, q, turn)
            if found is None:
                step = 0.25 * h
                if step < LEAST_STEP * end:
                    lost.append(self._lost(q, ahead))
                    return
                continue
            rate = task.velocity(found[1], target)[0]
            bent = (rate - qd) / h
            t, q, qd = ahead, found[0], rate
            yield t, q, qd
            fastest = float(np.abs(qd[task.unknown] / units).max(initial=1e-9))
            step = min(2.0 * h, end / SAMPLES, 0.8 * turn / fastest)

    @cached_property
    def _first(self) -> Samples:
        """The start as a sample."""
        q, zero = self.start.q[None], np.zeros(1)
        self._regularity.check((zero, q, np.zeros_like(q)))
        target = self.task.target(zero)
        return zero, q, self.task.velocity(self.task.newton(q, target)[2], target)

    @cached_property
    def _way(self) -> tuple[np.ndarray, np.ndarray]:
        """Dense instants, and how far what is prescribed has moved until then, rad or the reach."""
        task = self.task
        t = np.linspace(0.0, task.end, task.resolution)
        target, units = task.target(t), task.constraints.units
        parts = [target.joints[0] / units[task.given], target.place[0] / task.constraints.reach]
        moved = np.abs(np.diff(np.hstack(parts), axis=0)).max(axis=1, initial=0.0)
        # A way that stops has no instant of its own: a slope that steps never feel.
        return t, np.append(0.0, np.cumsum(moved + 1e-9))

    def _reached(
        self, guess: np.ndarray, target: Target, before: np.ndarray, turn: float
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the pose (R,) of a step and G there, or None where Newton's method went astray."""
        task = self.task
        try:
            q, last, G = task.newton(guess, target, 1e-5)
        except np.linalg.LinAlgError:
            return None
        units = task.constraints.units[task.unknown]
        moved, off = (np.abs((q[0] - x)[task.unknown] / units).max() for x in (before, guess[0]))
        # Not a number is not good.
        good = np.abs(last).max() < 1e-5 and moved <= turn and off <= 0.5 * turn
        return (q[0], G) if good else None

    @property
    def _rough(self) -> float:
        """Distance that a sample may be off, m: steps of 1e-5 leave less than their square."""
        reach = self.task.constraints.reach
        return 1e-8 * reach + self.start.tolerance(reach)

    def _lost(self, before: np.ndarray, t: float) -> InputError:
        """Return why there is no pose at t near one (R,): out of reach, or a singular position."""
        task = self.task
        for instant in (min(t + task.end / SAMPLES / REFINED, task.end), t):
            target = task.target(np.array([instant]))
            q = task.with_given(before[None], target)[0]
            q, off = nearest(task, q, target, task.unknown)
            if off > self._rough:
                return unreached(task, instant, q, target)
        return self._regularity.refusal(before, t)
