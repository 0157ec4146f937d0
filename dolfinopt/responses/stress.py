"""Von Mises stress of the arms along the motion."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from mpi4py import MPI

from dolfinopt.arms.design_state import DesignState
from dolfinopt.dynamics.adjoint import add_gradients
from dolfinopt.dynamics.feed_forward import FeedForward
from dolfinopt.dynamics.load_gradient import load_counts, load_gradient
from dolfinopt.dynamics.trajectory import Followed, Trajectory
from dolfinopt.fem.stress import LoadFields
from dolfinopt.fem.tensors import element_centre
from dolfinopt.multibody.dimension import DIMENSIONS
from dolfinopt.multibody.shape_integrals import STIFFENING, ShapeIntegrals
from dolfinopt.parallel import Partition, gather_arms, on_all_ranks, on_root, together
from dolfinopt.responses.measured import (
    BOUND_BATCH_INSTANTS,
    CHUNK_INSTANTS,
    CHUNK_POINTS,
    COARSE_INSTANTS,
    MAP_ERROR_SHARE,
    NEGLIGIBLE_COLUMNS_SHARE,
    NEGLIGIBLE_DIRECTION_SHARE,
    NEGLIGIBLE_POWER_SHARE,
    P_MEAN_STRIDE,
)
from dolfinopt.responses.products import By, Products, StressProduct
from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    Response,
    by_owner,
    cotangents_of_scene,
    factors,
    response,
)
from dolfinopt.responses.sensitivity import exact_gradient, pairs_at_interfaces
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

    def coefficients(self, loads: ArmLoads) -> np.ndarray:
        """Return those (n, m) of `LoadFields.columns`."""
        return np.asarray(loads.coefficients @ self.fields.to_columns)

    def power_sum(self, a: np.ndarray, unit: float, exponent: float) -> float:
        """Return sum_n sum_e weight_e (s_en / unit)^p over this rank's cells; a is (n, m)."""
        total = 0.0
        for part in _runs(len(a)):
            squares = np.square(self.A @ (a[part] / unit).T).sum(axis=0)
            total += float(np.sum(self.weights @ _power(squares, 0.5 * exponent)))
        return total

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
    out, square, left = None, x, int(exponent)
    while left:
        if left & 1:
            out = square if out is None else out * square
        left >>= 1
        if left:
            square = square * square
    assert out is not None
    return out


def _runs(count: int) -> list[slice]:
    return [slice(first, first + CHUNK_INSTANTS) for first in range(0, count, CHUNK_INSTANTS)]


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
    """

    place: int
    motion: int
    coefficients: np.ndarray


def every_instant(loads: Sequence[ArmLoads]) -> np.ndarray:
    """Return the coefficients (n, m) of all instants of all motions."""
    return np.concatenate([one.coefficients for one in loads])


def motions_of(trajectory: Trajectory) -> tuple[Trajectory, ...]:
    """Return what a limit holds for: the scenarios, or the motion where there are none."""
    return trajectory.scenarios or (trajectory,)


def arm_loads(scene: Scene, motions: Sequence[Trajectory]) -> dict[int, list[ArmLoads]]:
    """Return the loads of every arm with a design, by the index of the arm that owns it."""
    found: dict[int, list[ArmLoads]] = {owner: [] for owner in scene.cell_counts}
    for number, motion in enumerate(motions):
        for place, owner in enumerate(scene.owners):
            if owner is not None:
                found[owner].append(ArmLoads(place, number, _coefficients(scene, motion, place)))
    return found


def load_matrix(body: ShapeIntegrals) -> np.ndarray:
    """Return P = V' L (q, 7 + 2 q), in space (q, 18 + 9 q): every load's part in the modes."""
    d, q = len(body.w), body.num_modes
    frame = np.concatenate([body.w[:, 1:], body.W[:, 1:, 0]])[DIMENSIONS[d].loads]
    elastic = body.W[:, 1:, 1:].swapaxes(0, 1).reshape(q, -1)
    return np.hstack([frame.T, body.outboard.T, elastic])


def loads_gradient(
    scene: Scene,
    motion: Trajectory,
    by_arm: Mapping[int, tuple[np.ndarray, np.ndarray]],
    nominal: FeedForward | None = None,
) -> tuple[dict[int, ShapeIntegrals], np.ndarray | None]:
    """Differentiate a function of one motion's `ArmLoads.coefficients` by all designs' bodies.

    Args:
        scene: nominal, whose bodies the derivatives are by.
        motion: of it, or of one of its scenarios.
        by_arm: by place in the chain, instants (k,) and derivatives (k, q + 7 + 2 q) there.
        nominal: feed-forward whose part is left to whoever adds up the scenarios.

    Returns:
        By the index of the arm that owns the design; by the coefficients of the feed-forward.
    """
    mechanism, problem = motion.mechanism, motion.problem
    instants = np.unique(np.concatenate([where for where, _ in by_arm.values()]))
    by_q = np.zeros((len(instants), mechanism.num_coordinates))
    by_c, own = [], []
    for place, (part, body) in enumerate(zip(mechanism.slices, mechanism.bodies, strict=True)):
        by_loads = np.zeros((len(instants), load_counts(body).total))
        by_P, by_K = np.zeros((body.num_modes, by_loads.shape[1])), np.zeros_like(body.K)
        if place in by_arm:
            where, by = by_arm[place]
            rows, q = np.searchsorted(instants, where), body.num_modes
            by = by * _scale(scene, motion.scene, place, body)
            c, P = motion.load_coefficients[place][where], load_matrix(body)
            z = -np.linalg.solve(body.K, by[:, :q].T)
            by_q[rows, part] = by[:, :q]
            by_loads[rows] = by[:, q:] + z.T @ P
            by_P, by_K = z @ c, -z @ np.linalg.solve(body.K, P @ c.T).T
        by_c.append(by_loads)
        own.append(_integrals(body, by_P, by_K))
    t = motion.t[instants]
    y, yd, ydd = (x[instants] for x in motion.unknowns)
    by_rates, by_motion, by_bodies = load_gradient(problem, t, (y, yd, ydd), by_c)
    by_rates[0] += motion.by_unknowns(by_q)
    followed = motion.followed(t, by_rates, by_motion)
    if motion.feed_forward is not nominal:
        followed = Followed(followed.through(motion.feed_forward))
    total = add_gradients(add_gradients(followed.bodies, by_bodies), own)
    if motion.scene is not scene:
        total = [
            cotangents_of_scene(by, factors(scene, motion.scene, index), 1.0)
            for index, by in enumerate(total[: len(scene.arms)])
        ]
    return by_owner(scene, total), followed.by_coefficients


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


def _integrals(body: ShapeIntegrals, by_P: np.ndarray, by_K: np.ndarray) -> ShapeIntegrals:
    """Return the derivatives by a body from those by P and K."""
    d, q = len(body.w), body.num_modes
    w, W = np.zeros_like(body.w), np.zeros_like(body.W)
    ends = np.cumsum([d + len(W), len(body.outboard)])
    frame, outboard, elastic = np.split(by_P.T, ends)
    w[:, 1:], W[:, 1:, 0] = np.split(frame[DIMENSIONS[d].loads], [d])
    W[:, 1:, 1:] = elastic.reshape(len(W), q, q).swapaxes(1, 2)
    zero = {
        key: np.zeros_like(getattr(body, key))
        for key in ("D", "outboard_point", "further_points", *STIFFENING)
    }
    return replace(body, mass=0.0, w=w, W=W, K=by_K, outboard=outboard, **zero)


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
        found = next(iter(self._found(analysis).values()), None)
        sums: _Sums = analysis.partition.world.bcast(found and found.sums, root=0)
        return Measured(self.name, ("",), (sums.largest,), (sums.smooth,))

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of the p-mean, see `objective.gradient` (collective)."""
        found, p = self._found(analysis), self.options.stress_exponent
        partition, parts = analysis.partition, {}
        with together(partition.world):
            for k, one in found.items():
                parts[k] = _gradient_of_arm(one, analysis.designs[k], p)
        if self.options.gradient == "esl":
            with together(partition.world):
                row = {}
                for k, one in parts.items():
                    row[k] = _esl_gradient(one, analysis.designs[k], found[k].cells, analysis.by)
                return [row]
        through = {}
        with together(partition.world), analysis.profile.phase("gradient"):
            for k, one in parts.items():
                if len(one.a):
                    through[k] = found[k].cells.fields.gradient(one.a, one.by_u)
        mine = {k: parts[k].by_loads(each.by_a) for k, each in through.items()}
        by_body = bodies_by_loads(analysis, mine)
        with together(partition.world):
            row = {}
            for k, one in parts.items():
                row[k] = exact_gradient(
                    analysis.designs[k], by_body[k], through.get(k), analysis.by, one.beside
                )
            return [row]

    def points_of(self, index: int, state: DesignState, fields: LoadFields) -> PointStress:
        """Return the stress of an arm's design where it counts (collective on the arm's ranks).

        Args:
            index: of the arm.
            state: its design.
            fields: of its loads.
        """
        return cell_stress(state, fields, self.options.stress_margin)

    def _found(self, analysis: Analysis) -> dict[int, _Found]:
        """Return what is known of this rank's designs (collective)."""
        return self.once(analysis, lambda: self._evaluate(analysis))

    def _evaluate(self, analysis: Analysis) -> dict[int, _Found]:
        """Screen all motions for the largest stress, and sum powers (collective)."""
        partition, trajectory = analysis.partition, analysis.trajectory
        p = self.options.stress_exponent

        def loads() -> dict[int, list[ArmLoads]]:
            assert trajectory is not None
            return arm_loads(analysis.scene, motions_of(trajectory))

        by_owner: dict[int, list[ArmLoads]] = on_root(partition.world, loads)
        cells: dict[int, PointStress] = {}
        seen: dict[int, list[_Chosen]] = {}
        weights: dict[int, float] = {}
        largest = 0.0
        with together(partition.world):
            for k, state in analysis.designs.items():
                fields = state.load_fields_of(every_instant(by_owner[k]))
                cells[k] = self.points_of(k, state, fields)
                with analysis.profile.phase("stress"):
                    seen[k], own = _screened(partition, cells[k], by_owner[k])
                    area = partition.comm.allreduce(float(cells[k].weights.sum()))
                weights[k] = area * sum(len(one.instants) for one in seen[k])
                largest = max(largest, own)
        largest = max(partition.world.allgather(largest))
        # Of the instants that are summed: the largest of all samples may lie between them.
        summed = [float(one.values.max(initial=0.0)) for each in seen.values() for one in each]
        cut = NEGLIGIBLE_POWER_SHARE ** (1.0 / p) * max(
            partition.world.allgather(max(summed, default=0.0))
        )
        chosen = {k: [one.above(cut) for one in each] for k, each in seen.items()}
        sums = {k: 0.0 for k in chosen}
        with together(partition.world), analysis.profile.phase("stress"):
            for k, each in chosen.items() if largest else ():
                fields = cells[k].fields
                mine = sum(
                    cells[k].power_sum(one.a @ fields.to_columns, largest, p) for one in each
                )
                sums[k] = partition.comm.allreduce(mine)
        total = sum(on_all_ranks(partition, sums).values())
        weight = sum(on_all_ranks(partition, weights).values())
        smooth = largest * (total / weight) ** (1.0 / p) if total else 0.0
        found = _Sums(largest, smooth, total, weight)
        return {k: _Found(one, chosen[k], found) for k, one in cells.items()}


def _screened(
    partition: Partition, cells: PointStress, loads: Sequence[ArmLoads]
) -> tuple[list[_Chosen], float]:
    """Return every motion's evenly spaced instants, and the largest stress of all (collective)."""
    found, largest = [], 0.0
    for one in loads:
        coarse = every(len(one.coefficients))
        screened = screen(partition.comm, cells.A, cells.coefficients(one), coarse)
        largest = max(largest, screened.largest)
        instants, values = coarse[::P_MEAN_STRIDE], screened.values[::P_MEAN_STRIDE]
        found.append(_Chosen(one, instants, values, len(instants)))
    return found, largest


@dataclass(frozen=True, eq=False)
class _Chosen:
    """Instants of one arm along one motion."""

    loads: ArmLoads  # of all instants
    instants: np.ndarray  # (k,) of them
    values: np.ndarray  # (k,) largest stress of the arm there, Pa
    count: int  # of the instants among which they were chosen

    @property
    def a(self) -> np.ndarray:
        """Coefficients (k, m) there."""
        return self.loads.coefficients[self.instants]

    def above(self, limit: float) -> _Chosen:
        """Return those whose stress is not smaller."""
        kept = self.values >= limit
        return _Chosen(self.loads, self.instants[kept], self.values[kept], self.count)


@dataclass(frozen=True)
class _Sums:
    """What is known of all designs together."""

    largest: float  # Pa
    smooth: float  # Pa
    # (total / weight)^(1/p) is smooth / largest
    total: float
    weight: float


@dataclass(frozen=True, eq=False)
class _Found:
    """What is known of one design."""

    cells: PointStress
    chosen: Sequence[_Chosen]
    sums: _Sums


@dataclass(frozen=True, eq=False)
class _ArmGradient:
    """Derivatives of the p-mean by one design; k instants of all motions count."""

    chosen: Sequence[_Chosen]  # which instants
    a: np.ndarray  # (k, m) there, see `LoadFields.split`
    # See `PointStress.through`.
    by_u: np.ndarray
    beside: Products

    def by_loads(self, by_a: np.ndarray) -> list[ByLoads]:
        """Return derivatives (k, m) by the coefficients, one entry for every one of `chosen`."""
        ends = np.cumsum([len(one.instants) for one in self.chosen])[:-1]
        return [
            (one.loads.motion, one.loads.place, one.instants, by)
            for one, by in zip(self.chosen, np.split(by_a, ends), strict=True)
        ]


def _gradient_of_arm(found: _Found, state: DesignState, p: float) -> _ArmGradient:
    """Differentiate by what one arm's stress is made of (collective on the arm's ranks)."""
    cells, chosen, sums = found.cells, found.chosen, found.sums
    a = np.concatenate([one.a for one in chosen])
    by_logs, by_weights = np.zeros((2, len(cells.weights)))
    with state.elastic.profile.phase("stress"):
        if sums.total:
            factor = float(sums.total ** (1.0 / p - 1.0) * sums.weight ** (-1.0 / p))
            columns = a @ cells.fields.to_columns
            by, by_logs = cells.power_sum_gradient(columns, sums.largest, p)
            by *= factor
            by_logs *= factor
            # Of total / weight, to the power 1 / p: a point's part in either is its weight times a
            # sum.
            counts = cells.weights > 0.0
            np.divide(by_logs, cells.weights, out=by_weights, where=counts)
            by_weights -= sums.smooth / sums.weight * sum(one.count for one in chosen)
            by_weights *= counts / p
        else:
            by = np.zeros((*cells.A.shape[:2], len(a)))
        by_u, beside = cells.through(state, a, by, by_logs, by_weights)
        return _ArmGradient(chosen, a, by_u, beside if len(a) else replace(beside, stress=None))


# Of one arm along one motion: number of the motion, place in the chain, instants (k,), and
# derivatives (k, m) by `ArmLoads.coefficients` there.
ByLoads = tuple[int, int, np.ndarray, np.ndarray]


def bodies_by_loads(
    analysis: Analysis, mine: Mapping[int, Sequence[ByLoads]]
) -> dict[int, ShapeIntegrals]:
    """Return the derivatives by the bodies of all designs, on all ranks (collective).

    Args:
        analysis: with the trajectory.
        mine: of this rank's arms.
    """
    partition, profile = analysis.partition, analysis.profile
    by_arm = gather_arms(partition, mine)

    def followed() -> dict[int, ShapeIntegrals]:
        assert analysis.trajectory is not None
        total: dict[int, ShapeIntegrals] = {}
        by_coefficients, nominal = [], analysis.trajectory.feed_forward
        for number, motion in enumerate(motions_of(analysis.trajectory)):
            own = {
                place: (where, by)
                for each in by_arm.values()
                for which, place, where, by in each
                if which == number and len(where)
            }
            if not own:  # no instant of this scenario counts
                continue
            profile.counts.adjoints += 1
            with profile.phase("adjoint"):
                found, by = loads_gradient(analysis.scene, motion, own, nominal)
            if by is not None:
                by_coefficients.append(by)
            total = {k: total[k] + by if k in total else by for k, by in found.items()}
        if by_coefficients and nominal is not None:
            through = by_owner(analysis.scene, nominal.gradient(np.sum(by_coefficients, axis=0)))
            total = {k: by + through[k] for k, by in total.items()}
        return total

    by_body: dict[int, ShapeIntegrals] = on_root(partition.world, followed)
    return by_body


def _esl_gradient(part: _ArmGradient, state: DesignState, cells: PointStress, by: By) -> np.ndarray:
    """Return the derivative by the design of one arm, all loads of its instants frozen."""
    # With K u_n = f_n held, dJ = dJ/dx - sum_n lambda_n . dK u_n, K lambda_n = dJ/du_n.
    arm = state.elastic
    if not len(part.a):
        return by(state, part.beside)
    with arm.profile.phase("gradient"):
        u = cells.fields.displacements(part.a)
        adjoint = arm.static_response(*arm.restrict(part.by_u))
        pairs = ((-adjoint, u),)
        interfaces = partial(pairs_at_interfaces, arm, pairs, direct=((part.by_u, u),))
        return by(state, part.beside + Products(stiffness=pairs, interfaces=interfaces))


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
        batch = open_[done : done + BOUND_BATCH_INSTANTS]
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

    Right to `MAP_ERROR_SHARE` times the largest of all; of instants no more are looked at than that
    takes.
    """
    few, count = _condense(comm, A, a), A.shape[1]
    instants = every(len(a))
    enough = MAP_ERROR_SHARE * float(few.lengths(comm, instants).max(initial=0.0))
    while True:
        apart = few.apart(instants)
        crowded = np.unique(np.searchsorted(instants, np.flatnonzero(apart > enough)))
        halves = (instants[crowded - 1] + instants[crowded]) // 2
        wider = np.union1d(instants, halves)
        if len(wider) == len(instants):
            break
        instants = wider
    by_point, when = np.full(count, -1.0), np.zeros(count, dtype=int)
    for run in _runs(len(instants)):
        part = instants[run]
        for start in range(0, count, CHUNK_POINTS):
            here = slice(start, start + CHUNK_POINTS)
            squares = _squares(few.B[:, here], few.y[part])
            worst = squares.argmax(axis=1)
            values = squares[np.arange(len(worst)), worst]
            larger = values > by_point[here]
            by_point[here][larger], when[here][larger] = values[larger], part[worst[larger]]
    return np.sqrt(np.maximum(by_point, 0.0)), when


def every(count: int, most: int = COARSE_INSTANTS) -> np.ndarray:
    """Return at most about `most` instants of `count`, evenly spaced, and the last one."""
    step = max(1, -(-count // most))
    return np.unique(np.append(np.arange(0, count, step), count - 1))


@dataclass(frozen=True, eq=False)
class _Condensed:
    """|A_e a_n| is |B_e y_n| but for `rest`."""

    B: np.ndarray  # (3, n_points, r)
    y: np.ndarray  # (n, r)
    rest: np.ndarray  # (n,) at most what is left out
    norms: np.ndarray  # (r,) max_e |B_e,k|

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
    """Return the directions in which A a_n varies along the motion, the strongest first."""
    # By the singular values of a in the metric of A'A, so that columns that cancel do no harm.
    flat = A.reshape(-1, A.shape[2])
    gram = comm.allreduce(flat.T @ flat)
    scale = np.sqrt(np.diagonal(gram))
    scale = np.where(scale > 0.0, scale, 1.0)
    gram /= np.outer(scale, scale)
    values, vectors = np.linalg.eigh(0.5 * (gram + gram.T))
    if comm.size > 1:  # processors may round differently
        values, vectors = comm.bcast((values, vectors), root=0)
    kept = values > NEGLIGIBLE_COLUMNS_SHARE * values[-1]
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
    enough = NEGLIGIBLE_DIRECTION_SHARE * behind.max(initial=0.0)
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
    for part in _runs(len(a)):
        for start in range(0, A.shape[1], CHUNK_POINTS):
            squares = _squares(A[:, start : start + CHUNK_POINTS], a[part])
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
