"""What is minimised and limited in the optimisation of parts, with derivatives by their forms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI
from scipy.linalg import block_diag
from scipy.spatial import cKDTree

from dolfinopt.part.check import STRESS, Simulated, simulate_parts
from dolfinopt.part.mesh import PlateMesh
from dolfinopt.part.plane.free_sides import FreeSides
from dolfinopt.part.stress import HOT, CornerStress, OutlineStress
from dolfinopt.responses.constraints import Limit, limits_of
from dolfinopt.responses.evaluation import constraint_gradients, objective_gradient
from dolfinopt.responses.response import objective_of
from dolfinopt.responses.stress import arm_loads, maxima, motions_of
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.part.part import Part, PartMesh

RESERVE = 2e-3  # relative, of every limit: what a finer mesh adds hardly matters then
PLACE_EXPONENT = 20.0  # of the p-mean over the nodes of one place
NEAR = -0.2  # of the stress of a place: from there on a finer mesh is asked

Place = tuple[int, int]  # number of an arm, and of a piece of its outline


@dataclass(frozen=True, eq=False)
class State:
    """Outlines, their meshes and what the machine does with them.

    Attributes:
        outlines, bodies: by the arm's place in the chain.
        simulated: the machine.
        smooth, held: (k,) smooth value of each limit of the scene, but for the volume's and that of
            the stress, and the limit, tightened and scaled so that the true value is limited.
        shares: relative constraints of the volumes.
        places: relative constraint of the stress of every fillet and side.
        means: p-mean, Pa, of the stress of each of them, which it follows while a mesh does.
        stress: of the arms' meshes.
        owners: (n,) number of the place of every node of them; -1: none.
        peaks: (n, d) nodes of the arms' meshes where a finer mesh is worth it, m.
    """

    outlines: Mapping[int, FreeSides]
    bodies: Mapping[int, Any]
    simulated: Simulated
    smooth: np.ndarray
    held: np.ndarray
    shares: np.ndarray
    places: Mapping[Place, float] = field(default_factory=dict)
    means: Mapping[Place, float] = field(default_factory=dict)
    stress: Mapping[int, CornerStress] = field(default_factory=dict)
    owners: Mapping[int, np.ndarray] = field(default_factory=dict)
    peaks: Mapping[int, np.ndarray] = field(default_factory=dict)

    @property
    def values(self) -> np.ndarray:
        """What is minimised, and the relative constraints by their true values (1 + m,)."""
        return np.append(self.against(self.held), self.worst)

    @property
    def worst(self) -> float:
        """The largest of `places`, -1 without any."""
        return max(self.places.values(), default=-1.0)

    def against(self, held: np.ndarray) -> np.ndarray:
        """Return the same by smooth values and the smooth limits of another state."""
        sign = -1.0 if objective_of(self.simulated.scene).turned else 1.0
        objective = sign * self.simulated.evaluation.objective
        return np.concatenate([[objective], self.smooth / held - 1.0, self.shares])

    @property
    def excess(self) -> float:
        """The largest relative violation of a limit, 0 where all are met."""
        return float(self.values[1:].max(initial=0.0))

    @property
    def mass(self) -> float:
        """Of the parts, kg."""
        bodies = self.simulated.trajectory.mechanism.bodies
        return float(sum(bodies[k].mass for k in self.bodies))

    @property
    def solutions(self) -> Any:
        """Its motion, from which that of a state nearby is found."""
        return self.simulated.trajectory.solutions


@dataclass(frozen=True, eq=False)
class Problem:
    """What is minimised and limited.

    Attributes:
        scene: of the run.
        parts: as they were, of the arms that repeat another's design, too.
        tightened: factor by the name of a limit, by which its value counts more.
        local: stress of a place on a finer mesh, over its limit, by the p-mean on this one, 1/Pa.
        finer: places of every arm where its mesh is finer, see `PlanePart.mesh`.
        stiffening: whether bodies have geometric stiffness; None: as the scene states.
    """

    scene: Scene
    parts: Mapping[int, Any]
    tightened: Mapping[str, float]
    local: Mapping[Place, float] = field(default_factory=dict)
    finer: Mapping[int, Sequence[np.ndarray]] = field(default_factory=dict)
    stiffening: bool | None = None

    def every(self, outlines: Mapping[int, FreeSides]) -> dict[int, FreeSides]:
        """Return the outlines with those of arms that repeat them."""
        result = dict(outlines)
        for k, pattern in self.scene.patterns.items():
            result[k] = outlines[pattern].scaled(self.parts[k], self._factors(k))
        return {k: result[k] for k in sorted(result)}

    def parts_of(self, outlines: Mapping[int, FreeSides]) -> dict[int, Part]:
        """Return the parts of all arms with these outlines, as they are drawn."""
        every = self.every({k: item.drawn() for k, item in outlines.items()})
        return {k: item.current for k, item in every.items()}

    def _factors(self, k: int) -> np.ndarray:
        """Return the sizes of an arm over those of the one whose design it repeats."""
        arm, other = self.scene.arms[k], self.scene.arms[self.scene.patterns.get(k, k)]
        return np.array([arm.length / other.length, arm.height / other.height])

    def evaluated(
        self, outlines: Mapping[int, FreeSides], bodies: Mapping[int, PartMesh], *start: Any
    ) -> State:
        """Return what the machine does; on meshes that are made anew where none are given.

        Raises:
            InputError: an outline cannot be meshed.
            ConvergenceError: the machine cannot be simulated.
        """
        every = self.every(outlines)
        if not bodies:
            bodies = {k: item.meshed(self.finer.get(k, ())) for k, item in every.items()}
        parts = {k: item.current for k, item in every.items()}
        changes: dict[str, Any] = {"objective": {"gradient": "exact"}}
        if self.stiffening is not None:
            changes["simulation"] = {"stiffening": self.stiffening}
        if self.scene.constraints.limits.keys() - {STRESS}:
            changes["constraints"] = {STRESS: None}  # of parts it is that of the outline
        simulated = simulate_parts(self.scene, parts, bodies, *start, **changes)
        result, rows = simulated.evaluation, []
        limits = limits_of(simulated.scene, result)
        for item, value, limit in zip(
            limits, result.constraints, result.smooth_limits, strict=True
        ):
            if item.quantity not in ("volume_fraction", STRESS):
                rows.append(((1.0 + value) * limit, limit / self._factor(item)))
        smooth, held = np.array(rows).reshape(-1, 2).T
        state = State(outlines, bodies, simulated, smooth, held, self._volumes(outlines)[0])
        limit = self.scene.constraints.limit(STRESS)
        return state if limit is None else self._with_places(state, every, limit)

    def _with_places(self, state: State, every: Mapping[int, FreeSides], limit: float) -> State:
        """Return a state with the relative constraint and p-mean of every place."""
        scene, motions = state.simulated.scene, motions_of(state.simulated.trajectory)
        places, means, owners, stresses = dict[Place, float](), {}, {}, {}
        corners = dict[int, CornerStress]()
        factor = self._factor(Limit(STRESS, "", 0.0, limit, "Pa")) / limit
        for k, loads in arm_loads(scene, motions).items():
            now, part = state.simulated.arms[k].current, every[k].current
            points = corners[k] = part.stress(now)
            motion = [load.coefficients for load in loads]
            stress = np.max([maxima(MPI.COMM_SELF, points.A, a)[0] for a in motion], axis=0)
            means_of = points.means(motion, self._exponent)
            body = state.bodies[k]
            face = body.face if isinstance(body, PlateMesh) else body
            near = cKDTree(face.points[face.sides[:, 0]]).query(points.places[:, :2])[1]
            counts = part.regular(points.places, scene.objective.stress_margin)
            owners[k] = np.where(counts & (points.weights > 0.0), face.owners[near], -1)
            stresses[k] = points.places, np.where(counts, stress, 0.0)
            for piece in np.unique(owners[k][owners[k] >= 0]).tolist():
                here, key = owners[k] == piece, (k, piece)
                means[key] = means_of(here)
                as_is = float(stress[here].max()) * factor / means[key]
                places[key] = means[key] * self.local.get(key, as_is) - 1.0
        largest = max(float(stress.max()) for _, stress in stresses.values())
        peaks = {
            k: at[stress > HOT * stress.max()]
            for k, (at, stress) in stresses.items()
            if stress.max() > HOT * largest
        }
        return replace(
            state, places=places, means=means, stress=corners, owners=owners, peaks=peaks
        )

    def stress_slopes(self, state: State, keys: Sequence[Place]) -> list[np.ndarray]:
        """Return the derivatives (n,) of `State.places` of some places."""
        return list(self._by_x(state, [self._by_stress(state, *key) for key in keys]))

    def _by_stress(self, state: State, arm: int, piece: int) -> dict[int, np.ndarray]:
        """Return the derivatives of `State.places` of one place by the nodes of all arms."""
        run = state.simulated
        options = run.scene.objective.unchecked_copy({"stress_exponent": self._exponent})
        points = {
            k: item.counted((state.owners[k] == piece) & (k == arm))
            for k, item in state.stress.items()
        }
        response = OutlineStress(options, lambda k, _: points[k])
        (row,) = response.gradients(run.analysis)
        scale = (1.0 + state.places[arm, piece]) / state.means[arm, piece]
        return {k: scale * g for k, g in row.items()}

    def calibrated(self, state: State) -> tuple[Problem, State]:
        """Return the problem that knows what finer meshes say, and a state on new meshes.

        They are refined as those of the check, twice where stress comes near its limit. The first
        one is that of the state; of the second one the stress of every place counts.
        """
        problem = replace(self, local={}, finer={})
        fine = problem.evaluated(state.outlines, {}, state.solutions)
        if fine.worst < NEAR:
            return problem, fine
        for _ in range(2):
            fresh, plain = fine, problem
            finer = {k: (*plain.finer.get(k, ()), places) for k, places in fresh.peaks.items()}
            problem = replace(plain, finer={**plain.finer, **finer})
            fine = problem.evaluated(state.outlines, {}, fresh.solutions)
        places = {key: fine.places.get(key, value) for key, value in fresh.places.items()}
        local = {key: (1.0 + value) / fresh.means[key] for key, value in places.items()}
        return replace(plain, local=local), replace(fresh, places=places)

    def tighter(self, missed: Sequence[Limit]) -> Problem:
        """Return the problem with limits that are tighter by twice what finer meshes miss."""
        # Lower limits count by their squares, as those of frequencies.
        tightened = {
            item.name: self._factor(item) * (1.0 + 2.0 * item.excess) ** (2 if item.least else 1)
            for item in missed
        }
        return replace(self, tightened={**self.tightened, **tightened})

    def _factor(self, limit: Limit) -> float:
        return self.tightened.get(limit.name, 1.0 + RESERVE)

    @property
    def _exponent(self) -> float:
        return max(self.scene.objective.stress_exponent, PLACE_EXPONENT)

    def _volumes(self, outlines: Mapping[int, FreeSides]) -> tuple[np.ndarray, np.ndarray]:
        """Return volumes over their limits, less 1, (k,) and their derivatives (k, n)."""
        share, rows, slopes = self.scene.design.volume_fraction, [], []
        for outline in outlines.values():
            domain, sides, t = outline.part.domain, outline.sides, outline.part.domain.thickness
            # What the densities have: sides may have begun a little above the limit.
            most = max((share or 0.0) * domain.full_volume, domain.volume)
            rows.append([t * sides.shape.area, t * most])
            slopes.append(t * sides.area_by_q() @ sides.ties)
        every = np.hstack([rows, block_diag(*slopes)])
        if self.scene.design.shared_volume:
            every = every.sum(axis=0, keepdims=True)
        if share is None:
            every = every[:0]
        return every[:, 0] / every[:, 1] - 1.0, every[:, 2:] / every[:, 1:2]

    def slopes(self, state: State) -> np.ndarray:
        """Return the derivatives (1 + m, n) of the values by the variables x of all outlines."""
        simulated = state.simulated
        sign = -1.0 if objective_of(self.scene).turned else 1.0
        rows = [{k: sign * g for k, g in objective_gradient(simulated.analysis).items()}]
        every = limits_of(simulated.scene, simulated.evaluation)
        result = constraint_gradients(simulated.analysis, simulated.evaluation.responses)
        for limit, row in zip(every, result, strict=True):
            if limit.quantity not in ("volume_fraction", STRESS):
                rows.append({k: self._factor(limit) * g for k, g in row.items()})
        return np.vstack([self._by_x(state, rows), self._volumes(state.outlines)[1]])

    def _by_x(self, state: State, rows: list[dict[int, np.ndarray]]) -> np.ndarray:
        """Return derivatives (m, n) by x from those by the nodes of the arms' meshes."""
        result = {k: np.zeros((len(rows), outline.count)) for k, outline in state.outlines.items()}
        every = self.every(state.outlines)
        for k, body in state.bodies.items():
            some = [number for number, row in enumerate(rows) if k in row]
            if not some:
                continue
            mesh = state.simulated.arms[k].mesh
            order = cKDTree(mesh.mesh.geometry.x[:, : mesh.dim]).query(body.points)[1]
            by_nodes = np.array([rows[number][k][order] for number in some])
            result[self.scene.patterns.get(k, k)][some] += every[k].by_x(body, by_nodes)
        return np.hstack([*result.values()])
