"""Singular positions: where closures, or a path, leave joints undetermined.

G by the unknowns must keep its rank, and with a path also the closures' G by the passive joints,
for forces. Its smallest singular value is judged by that of a usual pose. Between poses a, b a
transversal passage changes the sign of det(G_a' G_b), which by Cauchy and Binet is that of
det(Q' G_a) det(Q' G_b), Q a basis of the rows' range, whatever the number of rows: no step passes
it. Poses that only touch one are minima of the singular value.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import minimize_scalar

from dolfinopt.errors import InputError
from dolfinopt.motion.measured import SINGULAR_SHARE
from dolfinopt.motion.start import Start
from dolfinopt.motion.task import Task

Samples = tuple[np.ndarray, np.ndarray, np.ndarray]  # instants (n,), poses and rates (n, R)


@dataclass(frozen=True, eq=False)
class Regularity:
    """How far poses of a task are from singular ones."""

    task: Task
    start: Start

    def check(self, samples: Samples) -> None:
        """Raise where a sample is singular, or a pose between samples.

        Raises:
            InputError: names instant, closure, joints and remedy.
        """
        t, q, _ = samples
        sizes = self.sizes(q)
        if (wrong := np.flatnonzero(sizes.min(axis=1) < SINGULAR_SHARE)).size:
            raise self.refusal(q[wrong[0]], float(t[wrong[0]]))
        for i, j in self._suspects(samples, sizes):
            near = CubicHermiteSpline(*samples)
            result = minimize_scalar(
                lambda t, j=j, near=near: self.sizes(near(t)[None])[0, j],
                bounds=t[i : i + 2],
                method="bounded",
            )
            if result.fun < SINGULAR_SHARE:
                raise self.refusal(near(result.x), float(result.x))

    def on_one_side(self, a: np.ndarray, b: np.ndarray) -> bool:
        """Return whether two poses, by their G (1, k, R), have no singular position between."""
        pairs = zip(self._matrices(a), self._matrices(b), strict=True)
        return all(np.linalg.det(item[0].T @ other[0]) > 0.0 for (item, _), (other, _) in pairs)

    def sizes(self, q: np.ndarray) -> np.ndarray:
        """Return smallest singular values at poses (n, R) over those of a usual pose (n, m)."""
        every = np.concatenate([self.start.usual[None], q])
        matrices = self._matrices(self.task.constraints.at(every).rows())
        least = [np.linalg.svd(G, compute_uv=False)[:, -1] for G, _ in matrices]
        return (np.stack(least, axis=1) / np.array(least)[:, 0])[1:]

    def _matrices(self, G: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the m parts (n, k, u) of G that must stay regular, with their columns."""
        task = self.task
        result = [(G[:, :, task.unknown], task.unknown)]
        if task.constraints.has_path and len(task.passive):
            result.append((G[:, : task.constraints.loops.count, task.passive], task.passive))
        return result

    # -- between samples -------------------------------------------------------------------------

    def _suspects(self, samples: Samples, sizes: np.ndarray) -> list[tuple[int, int]]:
        """Return samples behind which a singular value has a minimum, and which value."""
        t, q, qd = samples
        h = 1e-4 * np.diff(t)[:, None]
        falls = self.sizes(q[:-1] + h * qd[:-1]) < sizes[:-1]
        rises = self.sizes(q[1:] - h * qd[1:]) < sizes[1:]
        low = np.minimum(sizes[:-1], sizes[1:]) < 0.3
        return [(int(i), int(j)) for i, j in np.argwhere(falls & rises & low)]

    def refusal(self, q: np.ndarray, t: float) -> InputError:
        """Return which closure leaves which joints undetermined at a pose (R,), and when."""
        task = self.task
        matrices = self._matrices(task.constraints.at(q[None]).rows())
        G, columns = matrices[int(np.argmin(self.sizes(q[None])[0]))]
        null = np.abs(np.linalg.svd(G[0])[2][-1])
        joints = task.called(columns[null > 0.1 * null.max()])
        loops = task.constraints.loops
        acting = np.array(loops.by_tie(np.abs(G[0, : loops.count] * null).max(axis=1, initial=0.0)))
        what, remedy = "motion: the machine", 'prescribe the joints, motion.path = "joints"'
        if loops.ties and ((acting > SINGULAR_SHARE).any() or not task.constraints.has_path):
            names = [tie.name for tie in loops.ties]
            those = np.flatnonzero(acting >= SINGULAR_SHARE * acting.max())
            what = f"closures: the loop of {', '.join(names[k] for k in those)}"
            remedy = "drive one of them, or change the arms' lengths"
        return InputError(
            f"{task.source}: {what} is at a dead centre, a singular position, at t = {t:.4g} s: "
            f"joints {joints} are undetermined there; {remedy}, or change {task.keys}"
        )
