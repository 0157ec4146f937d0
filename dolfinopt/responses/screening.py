"""The largest of very many lengths |A_e a_n| over points e and instants n, looking at few instants.

A_e are three rows at a point, the columns' stress there, and a_n the columns' coefficients along a
motion. |A_e a| is a convex function of a and even, so what lies between two instants is bounded by
them: with a_n = (1 - s) a_i + s a_j + d

    |A_e a_n| <= (1 - s) |A_e a_i| + s |A_e a_j| + sum_k |d_k| max_e |A_e,k|,

and of a smooth motion d is small. Only where this bound exceeds the largest value found so far are
further instants looked at; so none that is larger is missed, whatever the motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from mpi4py import MPI

# Part of the largest length up to which directions in which the coefficients hardly vary are
# bounded, not computed.
NEGLIGIBLE = 1e-4
SINGULAR = 1e-13  # relative square below which a combination of columns counts as none
MAPPED = 1e-3  # of the largest length, the error of a map of all points
COARSE = 200  # instants, at most, at which all points are looked at first
POINTS, INSTANTS = 2048, 64  # of one block, so that it stays in the cache
BATCH = 16  # instants that are looked at before the bound is compared again


@dataclass(frozen=True, eq=False)
class Screened:
    """What was found at the instants that were looked at.

    Attributes:
        largest: max |A_e a_n| over all points and all instants.
        instant: n where it is.
        point: e where it is, on this rank; -1 where another rank has it.
        coarse: instants of the first pass, evenly spaced.
        values: (len(coarse),) largest length over all points of all ranks at each of them.
        looked_at: number of instants that were looked at.
    """

    largest: float
    instant: int
    point: int
    coarse: np.ndarray
    values: np.ndarray
    looked_at: int


def screen(comm: MPI.Comm, A: np.ndarray, a: np.ndarray, coarse: np.ndarray) -> Screened:
    """Find the largest |A_e a_n| (collective on `comm`).

    Args:
        comm: ranks that share the points.
        A: (3, n_points, m) of this rank's points, in space (5, ...); there may be none.
        a: (n, m) the same on all ranks.
        coarse: ascending instants to begin with, the first and the last one among them.
    """
    few = _condense(comm, A, a)
    values = np.full(len(a), -np.inf)
    values[coarse] = few.lengths(comm, coarse)
    bounds = few.between(coarse, values)
    open_ = np.setdiff1d(np.arange(len(a)), coarse)
    open_ = open_[np.argsort(-bounds[open_], kind="stable")]
    best = float(np.max(values[coarse]))
    done = 0
    while done < len(open_) and bounds[open_[done]] > best:
        batch = open_[done : done + BATCH]
        values[batch] = few.lengths(comm, batch)
        best = max(best, float(np.max(values[batch])))
        done += len(batch)
    # Of those whose bounds overlap within what was neglected the largest is found in full.
    close = np.flatnonzero(values + few.rest >= np.max(values - few.rest))
    full = _largest_by_instant(comm, A, a[close])
    instant = int(close[np.argmax(full)])
    return Screened(
        float(full.max()),
        instant,
        _point_of(comm, A, a[instant]),
        coarse,
        values[coarse],
        len(coarse) + done,
    )


def maxima(comm: MPI.Comm, A: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return max_n |A_e a_n| (n_points,) of every point, and its n (collective on `comm`).

    Right to `MAPPED` times the largest of all; of instants no more are looked at than that takes.
    """
    few, count = _condense(comm, A, a), A.shape[1]
    instants = every(len(a))
    enough = MAPPED * float(few.lengths(comm, instants).max(initial=0.0))
    while True:
        apart = few.apart(instants)
        crowded = np.unique(np.searchsorted(instants, np.flatnonzero(apart > enough)))
        halves = (instants[crowded - 1] + instants[crowded]) // 2
        wider = np.union1d(instants, halves)
        if len(wider) == len(instants):
            break
        instants = wider
    by_point, when = np.full(count, -1.0), np.zeros(count, dtype=int)
    for first in range(0, len(instants), INSTANTS):
        part = instants[first : first + INSTANTS]
        for start in range(0, count, POINTS):
            here = slice(start, start + POINTS)
            squares = _squares(few.B[:, here], few.y[part])
            worst = squares.argmax(axis=1)
            values = squares[np.arange(len(worst)), worst]
            larger = values > by_point[here]
            by_point[here][larger], when[here][larger] = values[larger], part[worst[larger]]
    return np.sqrt(np.maximum(by_point, 0.0)), when


def every(count: int, most: int = COARSE) -> np.ndarray:
    """Return at most about `most` instants of `count`, evenly spaced, and the last one."""
    step = max(1, -(-count // most))
    return np.unique(np.append(np.arange(0, count, step), count - 1))


@dataclass(frozen=True, eq=False)
class _Condensed:
    """|A_e a_n| is |B_e y_n| but for `rest`.

    Attributes:
        B: (3, n_points, r).
        y: (n, r).
        rest: (n,) at most what is left out.
        norms: (r,) max_e |B_e,k|.
    """

    B: np.ndarray
    y: np.ndarray
    rest: np.ndarray
    norms: np.ndarray

    def lengths(self, comm: MPI.Comm, instants: np.ndarray) -> np.ndarray:
        """Return the largest length over all points at these instants (collective)."""
        return _largest_by_instant(comm, self.B, self.y[instants])

    def between(self, known: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return upper bounds (n,) from the values at the instants `known`, ends included."""
        i, j, s = self._beside(known)
        ends = (1.0 - s) * (values[i] + self.rest[i]) + s * (values[j] + self.rest[j])
        return ends + self.apart(known) + self.rest

    def apart(self, known: np.ndarray) -> np.ndarray:
        """Return sum_k |d_k| max_e |B_e,k| (n,) of what is not linear between the known."""
        i, j, s = self._beside(known)
        apart = self.y - (1.0 - s)[:, None] * self.y[i] - s[:, None] * self.y[j]
        return np.abs(apart) @ self.norms

    def _beside(self, known: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the known instants before and after every one, and where between them it is."""
        n = np.arange(len(self.y))
        right = np.minimum(np.maximum(np.searchsorted(known, n), 1), len(known) - 1)
        i, j = known[np.maximum(right - 1, 0)], known[right]
        return i, j, (n - i) / np.maximum(j - i, 1)


def _condense(comm: MPI.Comm, A: np.ndarray, a: np.ndarray) -> _Condensed:
    """Return the directions in which A a_n varies along the motion, the strongest first.

    By the singular values of a in the metric of A'A, so that columns that cancel do no harm.
    """
    flat = A.reshape(-1, A.shape[2])
    gram = comm.allreduce(flat.T @ flat)
    scale = np.sqrt(np.diagonal(gram))
    scale = np.where(scale > 0.0, scale, 1.0)
    gram /= np.outer(scale, scale)
    values, vectors = np.linalg.eigh(0.5 * (gram + gram.T))
    if comm.size > 1:  # processors may round differently
        values, vectors = comm.bcast((values, vectors), root=0)
    kept = values > SINGULAR * values[-1]
    root = np.sqrt(values[kept])
    inside = (a * scale) @ vectors
    _, _, directions = np.linalg.svd(inside[:, kept] * root, full_matrices=False)
    if comm.size > 1:
        directions = comm.bcast(directions, root=0)
    y = (inside[:, kept] * root) @ directions.T
    B = A @ ((vectors[:, kept] / root) @ directions.T / scale[:, None])
    norms = _norms(comm, B)
    sizes = np.abs(y) * norms
    behind = np.cumsum(sizes[:, ::-1], axis=1)[:, ::-1]  # of a direction and all behind it
    enough = NEGLIGIBLE * behind.max(initial=0.0)
    few = int(np.count_nonzero(behind.max(axis=0, initial=0.0) > enough))
    # No point has more than the sum over all points.
    rest = np.abs(inside[:, ~kept]) @ np.sqrt(np.maximum(values[~kept], 0.0))
    if few < sizes.shape[1]:
        rest = rest + behind[:, few]
    return _Condensed(np.ascontiguousarray(B[:, :, :few]), y[:, :few], rest, norms[:few])


def _norms(comm: MPI.Comm, A: np.ndarray) -> np.ndarray:
    """Return max_e |A_e,k| (m,) of every column (collective)."""
    squares = np.einsum("cek,cek->ek", A, A)
    return _max(comm, np.sqrt(squares.max(axis=0, initial=0.0)))


def _largest_by_instant(comm: MPI.Comm, A: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return max_e |A_e a_n| (n,) (collective)."""
    out = np.zeros(len(a))
    for first in range(0, len(a), INSTANTS):
        part = slice(first, first + INSTANTS)
        for start in range(0, A.shape[1], POINTS):
            squares = _squares(A[:, start : start + POINTS], a[part])
            np.maximum(out[part], squares.max(axis=0), out=out[part])
    return np.sqrt(_max(comm, out))


def _squares(A: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return |A_e a_n|^2 (n_points, n)."""
    parts = A @ a.T
    np.multiply(parts, parts, out=parts)
    for part in parts[1:]:
        parts[0] += part
    return parts[0]


def _point_of(comm: MPI.Comm, A: np.ndarray, a: np.ndarray) -> int:
    """Return the point where |A_e a| is largest, -1 on ranks that do not have it (collective)."""
    lengths = np.square(A @ a).sum(axis=0)
    own = float(lengths.max(initial=-1.0))
    if comm.size > 1:
        owner = comm.allreduce((own, -comm.rank), op=MPI.MAX)
        if -owner[1] != comm.rank:
            return -1
    return int(np.argmax(lengths))


def _max(comm: MPI.Comm, values: np.ndarray) -> np.ndarray:
    if comm.size > 1:
        comm.Allreduce(MPI.IN_PLACE, values, op=MPI.MAX)
    return values
