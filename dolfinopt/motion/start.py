"""The joints at t = 0: least squares from a guess, and whether the right joints are passive.

With G = dg/dq of the closures, p the passive coordinates and R all of them: rank G - rank G_p
driven coordinates are held, too few are passive; p - rank G_p passive ones are undetermined, too
many; k - rank G equations follow from the others. Null vectors name the coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from dolfinopt.errors import InputError
from dolfinopt.motion.constraints import Target
from dolfinopt.motion.measured import (
    FITS_SHARE,
    MISFIT_FACTOR,
    REACHED_SHARE,
    SINGULAR_SHARE,
    STARTS,
)
from dolfinopt.motion.task import Task
from dolfinopt.multibody.measured import RANK_SHARE
from dolfinopt.multibody.ranks import rank


@dataclass(frozen=True, eq=False)
class Start:
    """Where the motion begins.

    Attributes:
        q: (R,) closed pose at t = 0.
        usual: (R,) a closed pose nearby that is not singular, unless all are.
        redundant: number of closures' equations that follow from the others for rigid links.
        misfit: by which links leave the closures open at best, m; 0 by rounding.
        tolerance: distance up to which a pose counts as reached, m.
    """

    q: np.ndarray
    usual: np.ndarray
    redundant: int
    misfit: float
    tolerance: float


def nearest(
    task: Task, q: np.ndarray, target: Target, free: np.ndarray, rows: slice = slice(None)
) -> tuple[np.ndarray, float]:
    """Return the pose (R,) near q where some equations fit best, and how far off they are, m.

    Args:
        task: equations.
        q: (R,).
        target: at one instant.
        free: coordinates that move.
        rows: equations that count.
    """
    constraints = task.constraints
    units = constraints.units[free]

    def pose(x: np.ndarray) -> np.ndarray:
        out = q[None].copy()
        out[0, free] += x * units
        return out

    def padded(x: np.ndarray) -> np.ndarray:  # as many equations as unknowns, for MINPACK
        return np.pad(x, [(0, max(len(free) - len(x), 0)), *[(0, 0)] * (x.ndim - 1)])

    def error(x: np.ndarray) -> np.ndarray:
        return padded(-constraints.at(pose(x)).error(target)[0, rows] / constraints.reach)

    def jacobian(x: np.ndarray) -> np.ndarray:
        return padded(constraints.at(pose(x)).rows()[0, rows][:, free])

    if len(free) == 0:
        off = np.linalg.norm(constraints.at(q[None]).error(target)[0, rows])
        return q, float(off)
    result = least_squares(
        error,
        np.zeros(len(free)),
        jacobian,
        method="lm",
        **dict.fromkeys(("xtol", "ftol", "gtol"), np.finfo(float).eps),
    )
    return pose(result.x)[0], float(np.linalg.norm(result.fun)) * constraints.reach


def start_of(task: Task) -> Start:
    """Return the start near the guess.

    Raises:
        InputError: the number of passive joints is wrong, or no pose reaches the path's start.
    """
    target, constraints = task.target(np.zeros(1)), task.constraints
    reach, count = constraints.reach, constraints.loops.count
    q, off = _nearest_of_many(task, target)
    every = np.arange(len(q))
    pose, misfit = nearest(task, q, target, every, slice(count))
    if misfit > FITS_SHARE * reach:
        raise unreached(task, 0.0, pose, target)
    share = max(RANK_SHARE, MISFIT_FACTOR * misfit / reach)
    usual = _usual(task, pose, target, misfit, share)
    G = constraints.at(usual[None]).rows()[0]
    _check(task, G[:count], share)
    redundant = count - rank(G[:count], share)
    tolerance = REACHED_SHARE * reach
    if not redundant or misfit <= tolerance:
        misfit = 0.0
    tolerance += MISFIT_FACTOR * misfit
    if off > tolerance:
        raise unreached(task, 0.0, q, target)
    if len(null := _null_vectors(G[:, task.unknown])):
        turned = ", or the orientation (motion.rpy; roll, pitch, yaw or rx, ry, rz)"
        raise InputError(
            f"{task.source}: motion: path and closures leave {len(null)} of the joints "
            f"undetermined ({_called(task, task.unknown, null)}); prescribe {len(null)} of them by "
            f"columns of the table{'' if constraints.turned else turned}, or all of them, "
            'motion.path = "joints"'
        )
    return Start(q, usual, redundant, misfit, tolerance)


def _nearest_of_many(task: Task, target: Target) -> tuple[np.ndarray, float]:
    """Return the pose near the guess that is reached first, and how far off it is, m."""
    guess = task.with_given(task.guess[None], target)[0]
    random, enough = np.random.default_rng(0), REACHED_SHARE * task.constraints.reach
    turning = task.unknown[~task.constraints.slides[task.unknown]]
    best, least = guess, (np.inf, 0.0, np.inf)
    for k in range(STARTS):  # the first as stated, the others around it at random
        shifted = guess.copy()
        away = random.uniform(-task.width, task.width, len(task.unknown))
        shifted[task.unknown] += (k > 0) * away * task.constraints.units[task.unknown]
        if task.side:
            shifted[-1] = 2.0 * np.pi * (k + 0.5) / STARTS
        q, off = nearest(task, shifted, target, task.unknown)
        q[turning] -= 2.0 * np.pi * np.round((q[turning] - guess[turning]) / (2.0 * np.pi))
        if (size := (max(off, enough), _off_branch(task, q), off)) < least:
            best, least = q, size
        if least[:2] == (enough, 0.0):
            break
    return best, least[2]


def _off_branch(task: Task, q: np.ndarray) -> float:
    """Return how far a pose (R,) is from the asked for branch: the stretched one of its side."""
    angle = float(np.angle(np.exp(1j * q[-1])))
    wrong = angle * task.side < -1e-9
    return np.round(abs(angle) + 2.0 * np.pi * wrong, 9) if task.side else 0.0


def _usual(task: Task, pose: np.ndarray, target: Target, misfit: float, share: float) -> np.ndarray:
    """Return a closed pose (R,) that is not singular, unless all are.

    A special pose would miscount, and so would an open one: the start is moved along the closures,
    with all coordinates free, whatever drives ask for.
    """
    constraints, free = task.constraints, np.arange(len(pose))
    closing = slice(constraints.loops.count)
    G = constraints.at(pose[None]).rows()[0, closing]
    moves = _null_vectors(G, max(share, SINGULAR_SHARE))
    random, usual, largest = np.random.default_rng(1), pose, -1.0
    for size in 0.5 ** np.arange(1, 5):
        moved = pose + size * constraints.units * (random.uniform(-1, 1, len(moves)) @ moves)
        other, off = nearest(task, moved, target, free, closing)
        at = constraints.at(other[None]).rows()[0]
        least = min(_least(at[closing][:, task.passive]), _least(at[:, task.unknown]))
        if off < 2.0 * misfit + REACHED_SHARE * constraints.reach and least > largest:
            usual, largest = other, least
    return usual


def _least(G: np.ndarray) -> float:
    return float(np.linalg.svd(G, compute_uv=False).min(initial=1.0))


def _null_vectors(G: np.ndarray, share: float = RANK_SHARE) -> np.ndarray:
    """Return orthonormal x (m, u) with G x = 0; see `ranks.rank`."""
    vectors: np.ndarray = np.linalg.svd(G)[2][rank(G, share) :]
    return vectors


# -- what is refused -------------------------------------------------------------------------


def _called(task: Task, places: np.ndarray, vectors: np.ndarray) -> str:
    """Return names of coordinates that vectors (m, u) move."""
    return task.called(places[np.abs(vectors).max(axis=0, initial=0.0) > SINGULAR_SHARE])


def _check(task: Task, G: np.ndarray, share: float) -> None:
    """Raise where the number of passive joints is wrong; the one check of all paths."""
    ties = ", ".join(tie.name for tie in task.constraints.loops.ties)
    where = f"{task.source}: closures ({ties})"
    own, driven = G[:, task.passive], np.setdiff1d(np.arange(G.shape[1]), task.passive)
    if missing := rank(G, share) - rank(own, share):
        held = _called(task, driven, _null_vectors(own.T, share) @ G[:, driven])
        raise InputError(
            f"{where}: they hold {missing} of the driven coordinates: give {missing} more of the "
            f"joints passive = true, among {held}, or leave out a closure"
        )
    if len(loose := _null_vectors(own, share)):
        raise InputError(
            f"{where}: they leave {len(loose)} of the passive joints undetermined: drive "
            f"{len(loose)} of {_called(task, task.passive, loose)}, without passive = true, or "
            "take another kind of closure"
        )


def unreached(task: Task, t: float, q: np.ndarray, target: Target) -> InputError:
    """Return which closure stays open, or how far the end-effector is off, at pose q (R,)."""
    error, loops = task.constraints.at(q[None]).error(target)[0], task.constraints.loops
    gaps, (place, turn) = loops.by_tie(error[: loops.count]), np.split(error[loops.count :], [3])
    if max(gaps, default=0.0) > 0.1 * np.abs(error).max():
        worst = int(np.argmax(gaps))
        what = f"closures: at t = {t:.4g} s the loop of {loops.ties[worst].name} cannot be closed"
        off, remedy = f"{gaps[worst]:.4g} m", "its point, the arms' lengths, or "
    else:
        where = ", ".join(f"{x:.6g}" for x in target.place[0][0])
        what = f"motion: at t = {t:.4g} s the end-effector cannot be at ({where}) m"
        off, remedy = f"{np.linalg.norm(place):.4g} m", ""
        if len(turn):
            what += " turned as it is to be"
            off += f" and {np.linalg.norm(turn) / task.constraints.reach:.4g} rad"
    start = "motion.initial_joints, " if t == 0.0 else ""
    return InputError(
        f"{task.source}: {what}: the joints that follow ({task.called(task.unknown)}) leave it "
        f"{off} off at best; change {start}{remedy}{task.keys}"
    )
