"""Where the bodies of a machine are at many instants, in the plane and in space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from dolfinopt.multibody.closures import Loops
from dolfinopt.multibody.kinematics import Posed
from dolfinopt.multibody.shape_integrals import linear_part
from dolfinopt.multibody.tree import Mechanism
from dolfinopt.output.design import ArmView

POSES = 5
MOVING = ("q_e", "origin", "rotation", "outboard", "held", "end", "tied")


@dataclass(frozen=True, eq=False)
class Poses:
    """A machine at n instants; b bodies in its order, bearings, which are points, left out.

    Attributes:
        mechanism: the machine.
        loops: its closures; none of an open one.
        parents: of every body, or `GROUND`.
        q_e: (n, N) elastic coordinates.
        origin: (n, b, d) of every body's frame, where its joint is, m.
        rotation: (n, b + 1, d, d) from every body's frame to the world's; then the end-effector's.
        outboard: (n, b, d) of every body's first outboard interface, m.
        held: (n, b, d) of the interface that every body hangs on, m; on the ground its frame.
        end: (n, d) of the end-effector, m.
        tied: (n, k, 2, d) of both frames of the k closures, m.
    """

    mechanism: Mechanism
    loops: Loops
    parents: Sequence[int]
    q_e: np.ndarray
    origin: np.ndarray
    rotation: np.ndarray
    outboard: np.ndarray
    held: np.ndarray
    end: np.ndarray
    tied: np.ndarray

    def at(self, instants: Sequence[int] | np.ndarray) -> Poses:
        """Return some of the instants."""
        moving = {name: getattr(self, name)[instants] for name in MOVING}
        return replace(self, **moving)

    @property
    def size(self) -> float:
        """Length of the links to the end-effector together, m."""
        return self.mechanism.reach

    @property
    def traced(self) -> np.ndarray:
        """Path (n, d), m, of the end-effector; where that is pinned, of the joint before it."""
        moves = np.ptp(self.end, axis=0).max() > 1e-3 * self.size
        return self.end if moves else self.origin[:, self.mechanism.end[0]]

    @property
    def payload(self) -> float:
        """Mass at the end-effector, kg."""
        load = self.mechanism.loads.get(self.mechanism.end)
        return 0.0 if load is None else float(load.body.mass)

    def skeleton(self, n: int) -> np.ndarray:
        """Return the joints from the ground to the end-effector (m, d), m, at an instant."""
        way = [i for i, _ in self.mechanism.way if i < self.mechanism.num_arms]
        joints = [place for i in way for place in (self.held[n, i], self.origin[n, i])]
        return np.array([*joints[1:], self.end[n]])

    def material(self, points: np.ndarray, modes: np.ndarray, body: int, n: int) -> np.ndarray:
        """Return points (..., d) of a body with modes (..., d, q) where they are, m."""
        e = self.q_e[n, self.mechanism.slices[body]]
        moved = points + modes @ e[: modes.shape[-1]]
        return moved @ self.rotation[n, body].T + self.origin[n, body]

    def sites(self, body: int, n: int) -> list[np.ndarray]:
        """Return the places (d,), m, of a body that something is fixed to."""
        places = [self.outboard[n, body]]
        places += [self.held[n, k] for k, parent in enumerate(self.parents) if parent == body]
        for tie, ends in zip(self.loops.ties, self.tied[n], strict=True):
            pairs = zip((tie.a, tie.b), ends, strict=True)
            places += [place for site, place in pairs if site is not None and site[0] == body]
        return places

    def reached(self, views: Sequence[ArmView]) -> np.ndarray:
        """Return points (m, d), m, that bound what is seen at all instants."""
        d = self.end.shape[1]
        points = [self.origin, self.outboard, self.held, self.tied, self.end]
        for i, view in enumerate(views):
            if not view.designed:
                continue
            low, high = view.corners.min(axis=(0, 1)), view.corners.max(axis=(0, 1))
            box = np.einsum("nij,pj->npi", self.rotation[:, i], box_corners(low, high))
            points.append(self.origin[:, None, i] + box)
        return np.concatenate([each.reshape(-1, d) for each in points])


def body_poses(
    mechanism: Mechanism, q_r: np.ndarray, q_e: np.ndarray, loops: Loops | None = None
) -> Poses:
    """Return where all bodies are.

    Args:
        mechanism: b bodies besides bearings.
        q_r: (n, joints) rigid coordinates; rad or m.
        q_e: (n, N) elastic coordinates; interfaces move linearly with them, as material does.
        loops: closures, or None.
    """
    linear = replace(mechanism, bodies=tuple(map(linear_part, mechanism.bodies)))
    posed, joints, bodies = Posed(linear, q_r, q_e), mechanism.joints, range(mechanism.num_arms)
    # A bearing hangs where the joint that it holds would without it.
    hung = [joint if joint.parent < len(bodies) else joints[joint.parent] for joint in joints]
    hung = hung[: len(bodies)]
    loops, d = loops or Loops(), len(mechanism.gravity)

    def over_time(values: Sequence[np.ndarray], width: Sequence[int]) -> np.ndarray:
        full = [v if v.ndim > len(width) else v[..., None] for v in values]
        every = [np.broadcast_to(v, (*width, len(q_r))) for v in full]
        return np.moveaxis(np.stack(every), -1, 0)

    end, end_rotation = posed.interface(*mechanism.end)
    return Poses(
        mechanism,
        loops,
        [joint.parent for joint in hung],
        q_e,
        over_time([posed.body(i)[1] for i in bodies], (d,)),
        over_time([*(posed.body(i)[2] for i in bodies), end_rotation], (d, d)),
        over_time([posed.interface(i, 0)[0] for i in bodies], (d,)),
        over_time([posed.interface(item.parent, item.interface)[0] for item in hung], (d,)),
        end.T,
        loops.at(linear, q_r, q_e).places if loops.ties else np.zeros((len(q_r), 0, 2, d)),
    )


def box_corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the corners (2^d, d) of a box."""
    return np.array([*product(*zip(low, high, strict=True))])


# -- instants ------------------------------------------------------------------------------------


def even_instants(count: int, wanted: int) -> np.ndarray:
    """Return the numbers of at most `wanted` of `count` instants, evenly, both ends in."""
    return np.unique(np.round(np.linspace(0, count - 1, wanted)).astype(int))


def poses_along(points: np.ndarray, shares: np.ndarray, longest: float = np.inf) -> np.ndarray:
    """Return the indices of points (n, d) at shares of the length of their path.

    Fewer where the path is short of points or of no length; `longest` ends it.
    """
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)])
    end = min(length[-1], longest) * (1.0 - 1e-9)
    return np.unique(np.searchsorted(length, end * shares))


def shown_poses(poses: Poses) -> np.ndarray:
    """Return the instants of `POSES` poses evenly along the path; of a plane loop in one turn.

    Those of a loop begin half a pose after the start, which often is a dead centre.
    """
    shares = np.linspace(0.0, 1.0, POSES)
    if not poses.loops.ties or poses.end.shape[1] > 2:
        return poses_along(poses.end, shares)
    crank = float(np.linalg.norm(poses.outboard[0, 0] - poses.origin[0, 0]))
    return poses_along(poses.outboard[:, 0], shares[:-1] + 0.5 * shares[1], 2.0 * np.pi * crank)
