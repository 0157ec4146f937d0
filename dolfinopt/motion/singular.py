"""Singular positions: where closures, or a path, leave joints undetermined.

G by the unknowns must keep its rank, and with a path also the closures' G by the passive joints,
for forces. Its smallest singular value is judged by that of a usual pose. Between samples a, b a
transversal passage changes the sign of det(G_a' G_b), which by Cauchy and Binet is that of
det(Q' G_a) det(Q' G_b), Q a basis of the rows' range, whatever the number of rows; poses that only
touch one are minima of the singular value.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import bisect, minimize_scalar

from dolfinopt.errors import InputError
from dolfinopt.motion.measured import SINGULAR_SHARE
from dolfinopt.motion.start import Start
from dolfinopt.motion.task import Task

Samples = tuple[np.ndarray, np.ndarray, np.ndarray]  # instants (n,), poses and rates (n, R)


class BranchLost(Exception):
    """Samples lie on two branches of a loop: they are too far apart."""


@dataclass(frozen=True, eq=False)
class Regularity:
    """How far poses of a task are from singular ones."""

    task: Task
    start: Start

    def check(self, samples: Samples) -> None:
        """Raise where a sample is singular, or the motion passes a singular position between.

        Raises:
            InputError: names instant, closure, joints and remedy.
            BranchLost: samples must be closer.
        """
        t, q, _ = samples
        sizes = self.sizes(q).min(axis=1)
        if (wrong := np.flatnonzero(sizes < SINGULAR_SHARE)).size:
            raise self.refusal(q[wrong[0]], float(t[wrong[0]]))
        for i, j, crossed in self._suspects(samples):
            if crossed:
                self._check_crossing(samples, i, j)
            else:
                self._check_minimum(samples, i, j)

    def sizes(self, q: np.ndarray) -> np.ndarray:
        """Return smallest singular values at poses (n, R) over those of a usual pose (n, m)."""
        return self._sizes(q) / self._usual

    @cached_property
    def _usual(self) -> np.ndarray:
        return self._sizes(self.start.usual[None])[0]

    def _sizes(self, q: np.ndarray) -> np.ndarray:
        every = [np.linalg.svd(G, compute_uv=False)[:, -1] for G, _ in self._matrices(q)]
        return np.stack(every, axis=1)

    def _matrices(self, q: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the m matrices (n, k, u) that must stay regular, with their columns."""
        task = self.task
        G = task.constraints.at(q).rows(self._turned)
        found = [(G[:, :, task.unknown], task.unknown)]
        if task.constraints.has_path and len(task.passive):
            found.append((G[:, : task.constraints.loops.count, task.passive], task.passive))
        return found

    @cached_property
    def _turned(self) -> bool:
        return self.task.target(np.zeros(1)).turning is not None

    # -- between samples -------------------------------------------------------------------------

    def _suspects(self, samples: Samples) -> list[tuple[int, int, bool]]:
        """Return samples behind which a singular position may lie, the matrix, if it is passed."""
        t, q, qd = samples
        matrices, sizes, h = self._matrices(q), self.sizes(q), 1e-4 * np.diff(t)[:, None]
        crossed = np.stack(
            [np.linalg.det(G[:-1].swapaxes(1, 2) @ G[1:]) < 0.0 for G, _ in matrices], axis=1
        )
        falls = self.sizes(q[:-1] + h * qd[:-1]) < sizes[:-1]
        rises = self.sizes(q[1:] - h * qd[1:]) < sizes[1:]
        low = np.minimum(sizes[:-1], sizes[1:]) < 0.3
        places = np.argwhere(crossed | (falls & rises & low))
        return [(int(i), int(j), bool(crossed[i, j])) for i, j in places]

    def _check_crossing(self, samples: Samples, i: int, j: int) -> None:
        """Raise at the passage between samples i and i + 1, told apart from a jump of branch."""
        t = samples[0]
        first = self._matrices(samples[1][i : i + 1])[j][0][0]

        def sign(instant: float) -> float:
            there = self._matrices(self._near(samples, instant)[None])[j][0][0]
            return 1.0 if np.linalg.det(first.T @ there) > 0.0 else -1.0

        instant = bisect(sign, t[i], t[i + 1], xtol=1e-5 * (t[i + 1] - t[i]), rtol=1e-12)
        pose = self._near(samples, instant)
        target = self.task.target(np.array([instant]))
        apart = np.abs(self.task.constraints.error(pose[None], target)).max()
        is_open = apart > SINGULAR_SHARE**2 * self.task.constraints.reach + self.start.misfit
        if is_open or self.sizes(pose[None]).min() > 10.0 * SINGULAR_SHARE:
            raise BranchLost
        raise self.refusal(pose, instant)

    def _check_minimum(self, samples: Samples, i: int, j: int) -> None:
        """Raise where the smallest singular value between samples i and i + 1 is too small."""
        t = samples[0]
        found = minimize_scalar(
            lambda instant: self.sizes(self._near(samples, instant)[None])[0, j],
            bounds=(t[i], t[i + 1]),
            method="bounded",
        )
        if found.fun < SINGULAR_SHARE:
            raise self.refusal(self._near(samples, found.x), float(found.x))

    def _near(self, samples: Samples, instant: float) -> np.ndarray:
        """Return the pose (R,) at an instant, as samples have it where Newton's method fails."""
        target = self.task.target(np.array([instant]))
        q = self.task.with_given(CubicHermiteSpline(*samples)(np.array([instant])), target)
        try:
            other = self.task.newton(q, target)[0]
        except np.linalg.LinAlgError:
            return q[0]
        moved = np.abs(other - q).max() / self.task.constraints.units.max()
        return other[0] if moved < 0.05 else q[0]

    def refusal(self, q: np.ndarray, t: float) -> InputError:
        """Return which closure leaves which joints undetermined at a pose (R,), and when."""
        task, words = self.task, self.task.words
        G, columns = self._matrices(q[None])[int(np.argmin(self.sizes(q[None])[0]))]
        null = np.abs(np.linalg.svd(G[0])[2][-1])
        joints = task.called(columns[null > 0.1 * null.max()])
        loops = task.constraints.loops
        acting = np.array(loops.by_tie(np.abs(G[0, : loops.count] * null).max(axis=1, initial=0.0)))
        by_path = task.constraints.has_path and not (acting > SINGULAR_SHARE).any()
        if by_path or not loops.ties:
            return InputError(
                f"{words.source}: motion: at t = {t:.4g} s the machine is in a singular position, "
                f"where rates of joints ({joints}) have no bounds; change {words.motion}, or "
                'prescribe the joints, motion.path = "joints"'
            )
        ties = ", ".join(
            tie.name
            for tie, size in zip(loops.ties, acting, strict=True)
            if size >= SINGULAR_SHARE * acting.max()
        )
        return InputError(
            f"{words.source}: closures: at t = {t:.4g} s the loop of {ties} is at a dead centre, a "
            f"singular position: joints {joints} are undetermined there; drive one of them, or "
            f"change {words.motion} or the arms' lengths"
        )
