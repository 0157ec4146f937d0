"""Von Mises stress of the arms along the motion."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import product
from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinopt.arms.design_state import DesignState
from dolfinopt.dynamics.build import Trajectory
from dolfinopt.dynamics.load_gradient import load_counts, load_gradient
from dolfinopt.dynamics.trajectory import Followed
from dolfinopt.fem.stress import DisplacementGradient, LoadFields
from dolfinopt.fem.tensors import element_centre
from dolfinopt.multibody.dimension import DIMENSIONS
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, add_integrals
from dolfinopt.parallel import gather_arms, on_root, sum_over_arms, together
from dolfinopt.responses.measured import (
    BLOCK_SIZE,
    COARSE_INSTANTS,
    MAP_ERROR_SHARE,
    NEGLIGIBLE_POWER_SHARE,
)
from dolfinopt.responses.motion import motions_of, over_motions
from dolfinopt.responses.products import Products, StressProduct
from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    Response,
    factors,
    response,
)
from dolfinopt.responses.sensitivity import exact_gradient, of_pairs
from dolfinopt.scene.law_variables import LAW
from dolfinopt.scene.load import Scene

# -- von Mises stress at the element centres of one design, relaxed for intermediate density -----
#
# s_en = x_e^(1/2) |A_e a_n| of cell e at instant n: stress of the solid material under the strain
# of the cell, less the less there is of it, so that void has none (qp relaxation). Source: Bruggi
# (2008), doi:10.1007/s00158-007-0203-6; Le, Norato, Bruns, Ha & Tortorelli (2010),
# doi:10.1007/s00158-009-0440-y.


@dataclass(frozen=True, eq=False)
class PointStress(ABC):
    """Stress at some points of one design by the coefficients of its load fields.

    Attributes:
        fields: of the design's loads.
        A: (3, n_points, m) components whose length is the stress, Pa per coefficient of
            `LoadFields.columns`; zero at points that do not count.
        weights: (n_points,) of those that count in the p-mean.
    """

    fields: LoadFields
    A: np.ndarray
    weights: np.ndarray

    def power_sum(self, a: np.ndarray, unit: float, exponent: float) -> float:
        """Return sum_n sum_e weight_e (s_en / unit)^p over this rank's cells; a is (n, m)."""
        return sum(
            float(np.sum(self.weights[here] @ _power(squares, 0.5 * exponent)))
            for here, _, squares in _blocks(self.A, a / unit)
        )

    def power_sum_gradient(
        self, a: np.ndarray, unit: float, exponent: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Differentiate `power_sum` over p, times unit: sum weight (s / unit)^(p-1) ds.

        Returns:
            By the components (3, n_points, n); by the logarithms of s, all instants together
            (n_points,); of this rank's points.
        """
        e = self.A @ (a / unit).T
        squares = np.square(e).sum(axis=0)
        factor = self.weights[:, None] * _power(squares, 0.5 * exponent - 1.0)
        e *= factor
        squares *= factor
        return e, unit * squares.sum(axis=1)  # dJ . s

    @abstractmethod
    def through(
        self,
        state: DesignState,
        a: np.ndarray,
        by: np.ndarray,
        by_logs: np.ndarray,
        by_weights: np.ndarray,
    ) -> tuple[np.ndarray, Products]:
        """Follow derivatives by the stress to the design.

        Args:
            state: the design.
            a: (n, m) see `LoadFields.split`.
            by: (3, n_points, n) by the components of the stress.
            by_logs: (n_points,) by the logarithms of the stress.
            by_weights: (n_points,).

        Returns:
            The derivatives by the displacements (n_nodes, d, n), contributions of this rank's
            cells, and by what else the stress depends on.
        """


@dataclass(frozen=True, eq=False)
class CellStress(PointStress):
    """Relaxed stress of one design at its element centres; weights are areas, m2.

    Attributes:
        root: (n_cells,) x^(1/2).
    """

    root: np.ndarray

    def through(
        self,
        state: DesignState,
        a: np.ndarray,
        by: np.ndarray,
        by_logs: np.ndarray,
        by_weights: np.ndarray,
    ) -> tuple[np.ndarray, Products]:
        """Follow derivatives by the stress to the design, see `PointStress`."""
        x = state.share
        by_stress = state.solid.modulus * self.root[:, None] * by
        operator = state.elastic.substructure.stress_operator
        by_u = self.fields.stress_transposed(operator, by_stress)
        centre = element_centre(state.elastic.operators.cell)
        by_x = np.divide(0.5 * by_logs, x, out=np.zeros_like(x), where=x > 0.0)
        stress = StressProduct(centre, by_stress, partial(self.fields.displacements, a))
        return by_u, Products(densities=by_x, volumes=by_weights, stress=stress)


def cell_stress(state: DesignState, fields: LoadFields, margin: float = 0.0) -> CellStress:
    """Return the stress of a design at its element centres (collective on the arm's ranks).

    Args:
        state: of the arm.
        fields: of its loads.
        margin: cells closer than this to an interface do not count, m.
    """
    substructure = state.elastic.substructure
    with state.elastic.profile.phase("stress"):
        root, weights = np.sqrt(state.share), state.mesh.area.copy()
        if margin > 0.0:
            weights[substructure.interface_distance < margin] = 0.0
        A = fields.stress(substructure.stress_operator)
        A *= (state.solid.modulus * root * (weights > 0.0))[:, None]
        return CellStress(fields, A, weights, root)


def _power(x: np.ndarray, exponent: float) -> np.ndarray:
    """Return x^exponent of x >= 0; small whole exponents by multiplication, ten times as fast."""
    if exponent != int(exponent) or not 1 <= exponent <= 32:
        return x**exponent
    half, odd = divmod(int(exponent), 2)
    if not half:
        return x
    square = _power(x * x, half)
    return square * x if odd else square


# -- along a motion: the coefficients of every arm's static fields, whose sum is its
# displacement
#
# u = V (q - K_r^-1 P c) + Z c, see `fem.stress`. In a scenario with another material, stiffness
# times k, mass times m and Young's modulus times e, what belongs to the arm's own inertia is m / k
# times as large, what comes from outboard 1 / k times, and stress e times that.


@dataclass(frozen=True, eq=False)
class ArmLoads:
    """What loads one arm of the chain along one motion.

    Attributes:
        place: of the arm in the chain.
        motion: number among `motions_of`.
        coefficients: (n, q + 7 + 2 q) of modes and loads, see `LoadFields.split`.
        stiffer: Young's modulus in the motion's scene over the nominal one.
        instants: (n,) of the motion.
    """

    place: int
    motion: int
    coefficients: np.ndarray
    stiffer: float
    instants: np.ndarray

    def at(self, chosen: np.ndarray | list[int]) -> ArmLoads:
        """Return those at some of the instants."""
        own = self.coefficients[chosen], self.instants[chosen]
        return replace(self, coefficients=own[0], instants=own[1])


def every_instant(loads: Sequence[ArmLoads]) -> np.ndarray:
    """Return the coefficients (n, m) of all instants of all motions."""
    return np.concatenate([load.coefficients for load in loads])


def arm_loads(scene: Scene, motions: Sequence[Trajectory]) -> dict[int, list[ArmLoads]]:
    """Return the loads of every arm with a design, by the index of the arm that owns it."""
    result: dict[int, list[ArmLoads]] = {owner: [] for owner in scene.cell_counts}
    for number, motion in enumerate(motions):
        for place, owner in enumerate(scene.owners):
            if owner is not None:
                stiffer = motion.scene.material_of(owner).modulus / scene.material_of(owner).modulus
                a = _coefficients(scene, motion, place)
                result[owner].append(ArmLoads(place, number, a, stiffer, np.arange(len(a))))
    return result


def load_matrix(body: ShapeIntegrals) -> np.ndarray:
    """Return P = V' L (q, 7 + 2 q), in space (q, 18 + 9 q): every load's part in the modes."""
    d, q = len(body.w), body.num_modes
    frame = np.concatenate([body.w[:, 1:], body.W[:, 1:, 0]])[DIMENSIONS[d].loads]
    elastic = body.W[:, 1:, 1:].swapaxes(0, 1).reshape(q, -1)
    return np.hstack([frame.T, body.outboard.T, elastic])


def loads_gradient(scene: Scene, motion: Trajectory, by_arms: Sequence[ArmLoads]) -> Followed:
    """Differentiate a function of one motion's `ArmLoads.coefficients` by all bodies.

    Args:
        scene: nominal, whose arms have the fields that the coefficients are of.
        motion: of it, or of one of its scenarios.
        by_arms: the function's derivatives in place of the coefficients.
    """
    mechanism = motion.mechanism
    instants = np.unique(np.concatenate([arm.instants for arm in by_arms]))
    by_q = np.zeros((len(instants), mechanism.num_coordinates))
    by_c = [np.zeros((len(instants), load_counts(body).total)) for body in mechanism.bodies]
    own: list[list[dict[str, np.ndarray]]] = [[] for _ in mechanism.bodies]
    for arm in by_arms:
        k, rows = arm.place, np.searchsorted(instants, arm.instants)
        body = mechanism.bodies[k]
        by = arm.coefficients * _scale(scene, motion.scene, k, body)
        by_modes, by_loads = np.split(by, [body.num_modes], axis=1)
        c, P = motion.load_coefficients[k][arm.instants], load_matrix(body)
        z = -np.linalg.solve(body.K, by_modes.T)
        by_q[rows, mechanism.slices[k]] += by_modes
        by_c[k][rows] += by_loads + z.T @ P
        own[k].append(_by_integrals(body, z @ c))
        own[k].append({"K": -z @ np.linalg.solve(body.K, P @ c.T).T})
    y, yd, ydd = (x[instants] for x in motion.unknowns)
    t, is_corrected = motion.t[instants], motion.feed_forward is not None
    given = motion.problem, t, (y, yd, ydd), by_c, is_corrected
    by_rates, by_motion, by_bodies = load_gradient(*given)
    by_rates[0] += motion.by_unknowns(by_q)

    def value(moved: Trajectory) -> float:
        return sum(
            float(np.vdot(by.coefficients, _coefficients(scene, moved, by.place)[by.instants]))
            for by in by_arms
        )

    followed = motion.followed(t, by_rates, by_motion, value)
    parts = zip(followed.bodies, by_bodies, own, strict=True)
    return replace(followed, bodies=[reduce(add_integrals, more, a + b) for a, b, more in parts])


def _coefficients(scene: Scene, motion: Trajectory, place: int) -> np.ndarray:
    mechanism = motion.mechanism
    body, c = mechanism.bodies[place], motion.load_coefficients[place]
    modal = motion.q_e[:, mechanism.slices[place]]
    modal = modal - np.linalg.solve(body.K, load_matrix(body) @ c.T).T
    return np.hstack([modal, c]) * _scale(scene, motion.scene, place, body)


def _scale(scene: Scene, other: Scene, place: int, body: ShapeIntegrals) -> np.ndarray:
    """Return what an arm's columns are multiplied by in another scene (q + 7 + 2 q,)."""
    counts, q = load_counts(body), body.num_modes
    scale = np.ones(q + counts.total)
    if other is scene:
        return scale
    owner = scene.owners[place]
    assert owner is not None
    f = factors(scene, other, owner)
    scale[q:] = f.mass / f.stiffness
    outboard = q + counts.frame
    scale[outboard : outboard + counts.outboard] = 1.0 / f.stiffness
    young = other.material_of(owner).modulus / scene.material_of(owner).modulus
    return young * scale


def _by_integrals(body: ShapeIntegrals, by_P: np.ndarray) -> dict[str, np.ndarray]:
    """Return the derivatives by a body's integrals from those by `load_matrix`."""
    d, q = len(body.w), body.num_modes
    w, W = np.zeros_like(body.w), np.zeros_like(body.W)
    ends = np.cumsum([d + len(W), len(body.outboard)])
    frame, outboard, elastic = np.split(by_P.T, ends)
    w[:, 1:], W[:, 1:, 0] = np.split(frame[DIMENSIONS[d].loads], [d])
    W[:, 1:, 1:] = elastic.reshape(len(W), q, q).swapaxes(1, 2)
    return {"w": w, "W": W, "outboard": outboard}


# -- von Mises stress of the arms along the motion -----------------------------------------------


@response("stress")
class Stress(Response):
    """p-mean over cells and instants of the relaxed von Mises stress at element centres, Pa.

    (sum_en A_e s_en^p / sum_en A_e)^(1/p) with the areas A_e of the cells of all arms, at up to
    100 evenly spaced instants of every scenario, with `objective.stress_exponent`. The true value
    is the largest s_en of all instants. Displacements are those of mode acceleration, see
    `fem.stress`.
    """

    def measure(self, analysis: Analysis) -> Measured:
        """Return largest stress and p-mean over all arms and scenarios (collective)."""
        result = next(iter(self._found(analysis).values()), None)
        sums: PowerSum = analysis.partition.world.bcast(result and result.sums, root=0)
        return Measured(self.name, ("",), (sums.largest,), (sums.smooth,))

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of the p-mean, see `objective.gradient` (collective)."""
        result, parts = self._found(analysis), {}
        with together(analysis.partition.world):
            for k, item in result.items():
                state = analysis.designs[k]
                by_u, products = _by_displacements(item, state)
                if not len(every_instant(item.loads)):
                    parts[k] = ArmGradient([], None, (replace(products, stress=None),))
                elif self.options.gradient == "esl":
                    parts[k] = ArmGradient([], None, (products, _frozen_loads(item, state, by_u)))
                else:
                    with analysis.profile.phase("gradient"):
                        displaced = item.points.fields.gradient(every_instant(item.loads), by_u)
                    parts[k] = ArmGradient(item.by_loads(displaced.by_a), displaced, (products,))
        return [through_motions(analysis, parts)]

    def points_of(self, index: int, state: DesignState, fields: LoadFields) -> PointStress:
        """Return the stress of an arm's design where it counts (collective on the arm's ranks).

        Args:
            index: of the arm.
            state: its design.
            fields: of its loads.
        """
        return cell_stress(state, fields, self.options.stress_margin)

    def _found(self, analysis: Analysis) -> dict[int, StressedDesign]:
        """Return what is known of this rank's designs (collective)."""
        return self.once(analysis, lambda: self._evaluate(analysis))

    def _evaluate(self, analysis: Analysis) -> dict[int, StressedDesign]:
        """Screen all motions for the largest stress, and sum powers (collective)."""
        partition, p = analysis.partition, self.options.stress_exponent
        world = partition.world
        by_owner = on_root(world, lambda: arm_loads(analysis.scene, motions_of(analysis.motion)))
        points: dict[int, PointStress] = {}
        screened: dict[int, list[Screened]] = {}
        with together(world):
            for k, state in analysis.designs.items():
                points[k] = self.points_of(k, state, state.load_fields)
                with analysis.profile.phase("stress"):
                    own = partial(screen, partition.comm, points[k].A)
                    screened[k] = [own(item.coefficients) for item in by_owner[k]]
        each = [(item.largest, item.summed.max()) for own in screened.values() for item in own]
        # The largest of all may lie between the instants that are summed.
        largest, summed = np.max(world.allgather(np.max([(0.0, 0.0), *each], axis=0)), axis=0)
        cut, sums = NEGLIGIBLE_POWER_SHARE ** (1.0 / p) * summed, {}
        counts = {k: sum(len(item.summed) for item in own) for k, own in screened.items()}
        with together(world), analysis.profile.phase("stress"):
            for k, point in points.items():
                pairs = zip(by_owner[k], screened[k], strict=True)
                by_owner[k] = [
                    loads.at(instants.counted[instants.summed >= cut]) for loads, instants in pairs
                ]
                a = every_instant(by_owner[k])
                total = point.power_sum(a, largest, p) if largest else 0.0
                sums[k] = np.array([total, point.weights.sum() * counts[k]])
        total, weight = sum_over_arms(partition, sums)
        result = PowerSum(largest, float(total), float(weight), p)
        return {
            k: StressedDesign(item, by_owner[k], counts[k], result) for k, item in points.items()
        }


@dataclass(frozen=True)
class PowerSum:
    """What is known of all designs together.

    Attributes:
        largest: stress, Pa.
        total, weight: sums of weight (s / largest)^exponent, and of the weights.
        exponent: p.
    """

    largest: float
    total: float
    weight: float
    exponent: float

    @property
    def smooth(self) -> float:
        """The p-mean, Pa."""
        if not self.total:
            return 0.0
        return self.largest * (self.total / self.weight) ** (1.0 / self.exponent)


@dataclass(frozen=True, eq=False)
class StressedDesign:
    """What is known of one design: stress at its points, and what is summed.

    Attributes:
        points: of the design.
        loads: of the instants that count, of how many.
        sums: of all designs.
    """

    points: PointStress
    loads: Sequence[ArmLoads]
    count: int
    sums: PowerSum

    def by_loads(self, by_a: np.ndarray) -> list[ArmLoads]:
        """Return derivatives by all coefficients (k, m) in place of these."""
        ends = np.cumsum([len(load.instants) for load in self.loads])[:-1]
        pairs = zip(self.loads, np.split(by_a, ends), strict=True)
        return [replace(load, coefficients=by) for load, by in pairs if len(by)]


def _by_displacements(stressed: StressedDesign, state: DesignState) -> tuple[np.ndarray, Products]:
    """Differentiate by displacements of one arm, and by what else its stress is made of."""
    points, sums, a = stressed.points, stressed.sums, every_instant(stressed.loads)
    by, by_logs = np.zeros((*points.A.shape[:2], len(a))), np.zeros(len(points.weights))
    by_weights = np.zeros_like(by_logs)
    with state.elastic.profile.phase("stress"):
        if sums.total:
            p, counts = sums.exponent, points.weights > 0.0
            factor = sums.total ** (1.0 / p - 1.0) * sums.weight ** (-1.0 / p)
            by, by_logs = points.power_sum_gradient(a, sums.largest, p)
            by *= factor
            by_logs *= factor
            # Of total / weight, to the power 1 / p: a point's part in either is its weight
            # times a sum.
            np.divide(by_logs, points.weights, out=by_weights, where=counts)
            by_weights -= sums.smooth / sums.weight * stressed.count
            by_weights *= counts / p
        by_u, products = points.through(state, a, by, by_logs, by_weights)
    return by_u, products


def _frozen_loads(stressed: StressedDesign, state: DesignState, by_u: np.ndarray) -> Products:
    """Return what carries a change of the stiffness to displacements under held loads."""
    # With K u_n = f_n held, dJ = -sum_n lambda_n . dK u_n, K lambda_n = dJ/du_n.
    arm = state.elastic
    with arm.profile.phase("gradient"):
        u = stressed.points.fields.displacements(every_instant(stressed.loads))
        pairs = ((-arm.static_response(*arm.restrict(by_u)), u),)
        return of_pairs(arm, pairs, direct=((by_u, u),))


# -- gradients of functions of the loads of arms along motions -----------------------------------


@dataclass(frozen=True, eq=False)
class ArmGradient:
    """Derivatives of a function of one design and of what loads it.

    Attributes:
        by_loads: in place of the coefficients, of every arm that has the design, along every
            motion; none where no load counts.
        displaced: by displacements, whose coefficients these loads are; None where none counts.
        beside: by the design itself, the sum of what these carry.
    """

    by_loads: Sequence[ArmLoads]
    displaced: DisplacementGradient | None
    products: tuple[Products, ...]


def through_motions(analysis: Analysis, mine: Mapping[int, ArmGradient]) -> CellGradient:
    """Follow derivatives of this rank's arms through the motions to all designs (collective)."""
    partition, designs = analysis.partition, analysis.designs
    by_arm = gather_arms(partition, {k: item.by_loads for k, item in mine.items()})

    def followed() -> dict[int, Any]:
        every = [item for each in by_arm.values() for item in each]

        def of_motion(number: int, motion: Trajectory) -> Followed | None:
            own = [item for item in every if item.motion == number]
            return loads_gradient(analysis.scene, motion, own) if own else None

        return over_motions(analysis, of_motion)

    by_body = on_root(partition.world, followed)
    row = {}
    with together(partition.world):
        for k, item in mine.items():
            by = [analysis.by(designs[k], each) for each in item.products]
            if k in by_body:
                by.append(exact_gradient(designs[k], by_body[k], item.displaced, analysis.by))
            row[k] = np.sum(by, axis=0)
    return row | {LAW: by_body[LAW]} if LAW in by_body else row


# -- the largest of very many lengths |A_e a_n| over points e and instants n, looking at few
# instants
#
# A_e are three rows at a point, the columns' stress there, and a_n the columns' coefficients along
# a motion. |A_e a| is a convex function of a and even, so what lies between two instants is bounded
# by them: with a_n = (1 - s) a_i + s a_j + d
#
#     |A_e a_n| <= (1 - s) |A_e a_i| + s |A_e a_j| + sum_k |d_k| max_e |A_e,k|,
#
# and of a smooth motion d is small. Only where this bound exceeds the largest value found so far
# are further instants looked at; so none that is larger is missed, whatever the motion.


@dataclass(frozen=True, eq=False)
class Screened:
    """The largest |A_e a_n| of all, its instant n, and point e on this rank, -1 on others.

    And the largest at every second one of the evenly spaced instants, which may be summed.
    """

    largest: float
    instant: int
    point: int
    counted: np.ndarray
    summed: np.ndarray


def screen(comm: MPI.Comm, A: np.ndarray, a: np.ndarray) -> Screened:
    """Find the largest |A_e a_n| (collective on `comm`).

    Args:
        comm: ranks that share the points.
        A: (3, n_points, m) of this rank's points, in space (5, ...); there may be none.
        a: (n, m) the same on all ranks.
    """
    coarse, n = every(len(a)), np.arange(len(a))
    values = np.full(len(a), -np.inf)
    values[coarse] = _largest_by_instant(comm, A, a[coarse])
    bounds = np.interp(n, coarse, values[coarse]) + _off_straight(comm, A, a, coarse)
    left = np.flatnonzero(bounds > values.max())
    values[left] = _largest_by_instant(comm, A, a[left])
    instant = int(values.argmax())
    point, counted = _point_of(comm, A, a[instant]), coarse[::2]
    return Screened(float(values[instant]), instant, point, counted, values[counted])


def maxima(comm: MPI.Comm, A: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return max_n |A_e a_n| (n_points,) of every point, and its n (collective on `comm`).

    Right to `MAP_ERROR_SHARE` times the largest of all; of instants no more are looked at than that
    takes.
    """
    instants = every(len(a))
    enough = MAP_ERROR_SHARE * _largest_by_instant(comm, A, a[instants]).max(initial=0.0)
    off = np.flatnonzero(_off_straight(comm, A, a, instants) > enough)
    instants = np.union1d(instants, off)
    largest, when = np.full(A.shape[1], -1.0), np.zeros(A.shape[1], dtype=int)
    for here, part, squares in _blocks(A, a[instants]):
        worst = squares.argmax(axis=1)
        values = squares[np.arange(len(worst)), worst]
        larger = values > largest[here]
        largest[here][larger] = values[larger]
        when[here][larger] = instants[part][worst[larger]]
    return np.sqrt(np.maximum(largest, 0.0)), when


def every(count: int) -> np.ndarray:
    """Return about `COARSE_INSTANTS` of `count` at most, evenly spaced, and the last one."""
    step = max(1, -(-count // COARSE_INSTANTS))
    return np.unique(np.append(np.arange(0, count, step), count - 1))


def _off_straight(comm: MPI.Comm, A: np.ndarray, a: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return sum_k |d_k| max_e |A_e,k| (n,) of what is not straight between the known instants."""
    sizes = np.sqrt(_max(comm, np.square(A).sum(axis=0).max(axis=0, initial=0.0)))
    n = np.arange(len(a))
    straight = np.column_stack([np.interp(n, known, column[known]) for column in a.T])
    return np.abs(a - straight) @ sizes


def _blocks(A: np.ndarray, a: np.ndarray) -> Iterator[tuple[slice, slice, np.ndarray]]:
    """Yield |A_e a_n|^2 of some points at some instants, and which they are."""
    parts, places = (
        [slice(first, first + BLOCK_SIZE) for first in range(0, count, BLOCK_SIZE)]
        for count in (len(a), A.shape[1])
    )
    for part, here in product(parts, places):
        yield here, part, np.square(A[:, here] @ a[part].T).sum(axis=0)


def _largest_by_instant(comm: MPI.Comm, A: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return max_e |A_e a_n| (n,) (collective)."""
    out = np.zeros(len(a))
    for _, part, squares in _blocks(A, a):
        np.maximum(out[part], squares.max(axis=0), out=out[part])
    return np.sqrt(_max(comm, out))


def _point_of(comm: MPI.Comm, A: np.ndarray, a: np.ndarray) -> int:
    """Return the point where |A_e a| is largest, -1 on ranks that do not have it (collective)."""
    lengths = np.square(A @ a).sum(axis=0)
    own = float(lengths.max(initial=-1.0))
    owner = comm.allreduce((own, -comm.rank), op=MPI.MAX)
    return int(lengths.argmax()) if -owner[1] == comm.rank else -1


def _max(comm: MPI.Comm, values: np.ndarray) -> np.ndarray:
    if comm.size > 1:
        comm.Allreduce(MPI.IN_PLACE, values, op=MPI.MAX)
    return values
