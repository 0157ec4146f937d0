"""Joints of rigid links that follow closures and a path, at any instant, in plane and space.

From the start samples are followed by a predictor of second order and Newton's method; steps that
go astray or pass a singular position are halved. Four times as many samples, by Newton's method
from their Hermite spline, show positions that only touch a singular one.
At any instant Newton's method sets out from the spline; rates solve the differentiated equations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from dolfinopt.errors import InputError
from dolfinopt.motion.measured import SAMPLES, TURNS_LIMIT
from dolfinopt.motion.singular import Regularity, Samples
from dolfinopt.motion.start import Start, nearest, start_of, unreached
from dolfinopt.motion.task import Task
from dolfinopt.scene.laws import Values


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
        samples = self._samples()
        t = samples[0]
        if len(t) > 1:
            # Four instants a sample, at which singular positions are looked for.
            fine = np.interp(np.arange(4 * len(t) - 3) / 4, np.arange(len(t)), t)
            target = self.task.target(fine)
            q = self.task.with_given(CubicHermiteSpline(*samples)(fine), target)
            q = self.task.newton(q, target)[0]
            samples = fine, q, self.task.rates(q, target)[0]
        self._regularity.check(samples)
        return CubicHermiteSpline(*samples)

    def at(self, t: np.ndarray) -> Values:
        """Return all coordinates and two derivatives (n, R) at instants t (n,), s.

        Raises:
            InputError: the motion cannot be followed, or passes a singular position.
        """
        task, table = self.task, self.table
        target = task.target(t)
        q = task.with_given(table(np.clip(t, 0.0, task.end)), target)
        q = task.newton(q, target)[0]
        off = np.linalg.norm(task.constraints.at(q).error(target), axis=1)
        wrong = np.flatnonzero(~(off <= self.start.tolerance))
        if wrong.size:
            raise self._lost(q[wrong[0]], float(t[wrong[0]]))
        return q, *task.rates(q, target)[:2]

    def _samples(self) -> Samples:
        """Return poses that follow each other.

        A step that Newton's method does not confirm, or that passes a singular position, is halved.
        """
        task, q, t = self.task, self.start.q, 0.0
        self._regularity.check((np.zeros(1), q[None], q[None]))
        qd, qdd, G = task.rates(q[None], task.target(np.zeros(1)))
        samples, ahead = [(t, q, qd[0])], list(map(float, self._instants[:0:-1]))
        while ahead:
            h = ahead[-1] - t
            result = self._reached(q + h * qd[0] + 0.5 * h * h * qdd[0], ahead[-1], G)
            if result is not None:
                t, (q, qd, qdd, G) = ahead.pop(), result
                samples.append((t, q, qd[0]))
            elif h > 1e-6 * task.end:  # behind a shorter step there is no continuation
                ahead.append(t + 0.5 * h)
            else:
                raise self._lost(q, ahead[-1])
        instants, poses, rates = map(np.array, zip(*samples, strict=True))
        return instants, poses, rates

    @cached_property
    def _instants(self) -> np.ndarray:
        """Instants between which neither much time passes nor what is prescribed moves far."""
        task = self.task
        t = np.linspace(0.0, task.end, task.resolution)
        target, units = task.target(t), task.constraints.units
        parts = [target.joints[0] / units, target.place[0] / task.constraints.reach]
        moved = np.abs(np.diff(np.hstack(parts), axis=0)).max(axis=1, initial=0.0)
        turns = float(moved.sum() / (2.0 * np.pi))
        if turns > TURNS_LIMIT:
            raise InputError(
                f"{task.source}: motion: what is prescribed of the closed loops moves by "
                f"{turns:.3g} turns: expected at most {TURNS_LIMIT}; slow it or shorten "
                "motion.horizon"
            )
        way = SAMPLES * np.append(0.0, np.cumsum(moved / (2.0 * np.pi) + 1.0 / len(moved)))
        return np.interp(np.linspace(0.0, way[-1], int(np.ceil(way[-1])) + 1), way, t)

    def _reached(
        self, guess: np.ndarray, t: float, before: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
        """Return pose (R,), rates, accelerations and G at t, or None where the step is too long."""
        task, enough = self.task, 1e-5
        target = task.target(np.array([t]))
        near = task.with_given(guess[None], target)
        try:
            q, last = task.newton(near, target, enough)
            qd, qdd, G = task.rates(q, target)
        except np.linalg.LinAlgError:
            return None
        off = np.abs((q - near) / task.constraints.units).max()
        # Not a number is not good.
        good = np.abs(last).max() < enough and off <= 0.5 / SAMPLES
        return (q[0], qd, qdd, G) if good and self._regularity.on_one_side(before, G) else None

    def _lost(self, before: np.ndarray, t: float) -> InputError:
        """Return why there is no pose at t near one (R,): out of reach, or a singular position."""
        task = self.task
        # Steps of 1e-5 leave less than their square.
        rough = 1e-8 * task.constraints.reach + self.start.tolerance
        for instant in (min(t + 0.01 * task.end, task.end), t):
            target = task.target(np.array([instant]))
            q = task.with_given(before[None], target)[0]
            q, off = nearest(task, q, target, task.unknown)
            if off > rough:
                return unreached(task, instant, q, target)
        return self._regularity.refusal(before, t)
