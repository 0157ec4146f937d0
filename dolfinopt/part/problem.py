"""What is minimised and limited in the optimisation of parts, with derivatives by their forms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from mpi4py import MPI
from scipy.spatial import cKDTree

from dolfinopt.part.check import STRESS, Simulated, simulate_parts
from dolfinopt.part.mesh import FINE, TURN, BodyMesh, PlateMesh
from dolfinopt.part.part import Part, PartMesh
from dolfinopt.part.plane.free_sides import FreeSides
from dolfinopt.part.stress import OutlineStress
from dolfinopt.profiling import Profile
from dolfinopt.responses.constraints import EXCESS, Limit, limits_of
from dolfinopt.responses.evaluation import analysis_of, constraint_gradients, gradient
from dolfinopt.responses.products import by_nodes
from dolfinopt.responses.response import Analysis, objective_of
from dolfinopt.responses.stress import arm_loads, maxima, motions_of
from dolfinopt.scene.load import Scene

RESERVE = 2e-3  # relative, of every limit: what a finer mesh adds hardly matters then
PLACE_EXPONENT = 20.0  # of the p-mean over the nodes of one place
NEAR = -0.2  # of the stress of a place: from there on a finer mesh is asked
ALLOWED = 0.05  # excess of a limit that a state may have for a better objective on the way

Place = tuple[int, int]  # number of an arm, and of a piece of its outline


@dataclass(frozen=True, eq=False)
class State:
    """Outlines, their meshes and what the machine does with them.

    Attributes:
        outlines, bodies: by the arm's place in the chain.
        simulated: the machine.
        limits: of the scene, but for the volume's, and that of the stress by places.
        smooth, held: (k,) smooth value of each of them, and its limit, tightened and scaled so that
            the true value is limited.
        shares: relative constraints of the volumes.
        places: relative constraint of the stress of every fillet and side.
        means: p-mean, Pa, of the stress of each of them, which it follows while a mesh does.
        owners: (n,) number of the place of every node of the arms' meshes; -1: none.
    """

    outlines: Mapping[int, FreeSides]
    bodies: Mapping[int, Any]
    simulated: Simulated
    limits: tuple[Limit, ...]
    smooth: np.ndarray
    held: np.ndarray
    shares: np.ndarray
    places: Mapping[Place, float] = field(default_factory=dict)
    means: Mapping[Place, float] = field(default_factory=dict)
    owners: Mapping[int, np.ndarray] = field(default_factory=dict)

    @property
    def values(self) -> np.ndarray:
        """What is minimised, and the relative constraints by their true values (1 + m,)."""
        return np.append(self.against(self.held), self._worst)

    @property
    def _worst(self) -> list[float]:
        return [max(self.places.values())] if self.places else []

    def against(self, held: np.ndarray) -> np.ndarray:
        """Return the same by smooth values and the smooth limits of another state."""
        sign = -1.0 if objective_of(self.simulated.scene).turned else 1.0
        objective = sign * self.simulated.evaluation.objective
        return np.concatenate([[objective], self.smooth / held - 1.0, self.shares])

    @property
    def rank(self) -> tuple[float, float]:
        """What orders states, best first: feasible ones by their objective, else by excess."""
        excess, value = self.values[1:].max(initial=0.0), self.values[0]
        return max(excess - ALLOWED, 0.0), value + abs(value) * max(excess - EXCESS, 0.0)

    @property
    def mass(self) -> float:
        """Of the parts, kg."""
        bodies = self.simulated.trajectory.mechanism.bodies
        return float(sum(bodies[k].mass for k in self.bodies))

    @property
    def released(self) -> State:
        """The same without the machine's matrices, which take a GB of a solid."""
        return replace(self, simulated=replace(self.simulated, arms={}))

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
        turns: (n,) of all pieces of an arm's sides along a side of their mesh, rad.
        stiffening: whether bodies have geometric stiffness; None: as the scene states.
    """

    scene: Scene
    parts: Mapping[int, Any]
    tightened: Mapping[str, float]
    local: Mapping[Place, float] = field(default_factory=dict)
    turns: Mapping[int, np.ndarray] = field(default_factory=dict)
    stiffening: bool | None = None

    def every(self, outlines: Mapping[int, FreeSides]) -> dict[int, FreeSides]:
        """Return the outlines with those of arms that repeat them."""
        found = dict(outlines)
        for k, pattern in self.scene.patterns.items():
            found[k] = outlines[pattern].scaled(self.parts[k], self._factors(k))
        return {k: found[k] for k in sorted(found)}

    def parts_of(self, outlines: Mapping[int, FreeSides]) -> dict[int, Part]:
        """Return the parts of all arms with these outlines."""
        return {k: one.current for k, one in self.every(outlines).items()}

    def _factors(self, k: int) -> np.ndarray:
        """Return the sizes of an arm over those of the one whose design it repeats."""
        one, other = self.scene.arms[k], self.scene.arms[self.scene.patterns.get(k, k)]
        return np.array([one.length / other.length, one.height / other.height])

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
            bodies = {k: one.meshed(self.turns.get(k)) for k, one in every.items()}
        parts = {k: one.current for k, one in every.items()}
        changes: dict[str, Any] = {"objective": {"gradient": "exact"}}
        if self.stiffening is not None:
            changes["simulation"] = {"stiffening": self.stiffening}
        if self.scene.constraints.limits.keys() - {STRESS}:
            changes["constraints"] = {STRESS: None}  # of parts it is that of the outline
        simulated = simulate_parts(self.scene, parts, bodies, *start, **changes)
        found, rows = simulated.evaluation, []
        limits = limits_of(simulated.scene, found)
        for one, value, limit in zip(limits, found.constraints, found.smooth_limits, strict=True):
            if one.quantity not in ("volume_fraction", STRESS):
                rows.append((one, (1.0 + value) * limit, limit / self._factor(one)))
        limit, owners = self.scene.constraints.limit(STRESS), dict[int, np.ndarray]()
        places, means = dict[Place, float](), dict[Place, float]()
        if limit is not None:
            places, means, owners = self._places(simulated, every, bodies, limit)
        known, smooths, held = zip(*rows, strict=True) if rows else ((), (), ())
        shares = [share for share, _ in self._volumes(outlines)]
        smooth, most, areas = (np.array(one, dtype=float) for one in (smooths, held, shares))
        given = outlines, bodies, simulated, tuple(known), smooth, most, areas
        return State(*given, places, means, owners)

    def _places(
        self,
        simulated: Simulated,
        every: Mapping[int, FreeSides],
        bodies: Mapping[int, Any],
        limit: float,
    ) -> tuple[dict[Place, float], dict[Place, float], dict[int, np.ndarray]]:
        """Return the relative constraint and p-mean of every place, and the places of all nodes."""
        scene, found, means, owners = simulated.scene, dict[Place, float](), {}, {}
        motions = motions_of(simulated.trajectory)
        factor = self._factor(Limit(STRESS, "", 0.0, limit, "Pa")) / limit
        for k, loads in arm_loads(scene, motions).items():
            state, part = simulated.arms[k].current, every[k].current
            points = part.stress(state, state.load_fields)
            motion = [one.coefficients for one in loads]
            each = [maxima(MPI.COMM_SELF, points.A, a)[0] for a in motion]
            stress = np.max(each, axis=0)
            means_of = points.means(motion, self._exponent)
            face = _face(bodies[k])
            near = cKDTree(face.points[face.sides[:, 0]]).query(points.places[:, :2])[1]
            counts = part.regular(points.places, scene.objective.stress_margin)
            owners[k] = np.where(counts & (points.weights > 0.0), face.owners[near], -1)
            for piece in np.unique(owners[k][owners[k] >= 0]).tolist():
                here, key = owners[k] == piece, (k, piece)
                means[key] = means_of(here)
                as_found = float(stress[here].max()) * factor / means[key]
                found[key] = means[key] * self.local.get(key, as_found) - 1.0
        return found, means, owners

    def stress_slopes(self, state: State, keys: Sequence[Place]) -> list[np.ndarray]:
        """Return the derivatives (n,) of `State.places` of some places."""
        found = []
        for key in keys:
            stress, analysis = self._place_stress(state, key)
            (row,) = stress.gradients(analysis)
            scale = (1.0 + state.places[key]) / state.means[key]
            found.append(self._by_x(state, [{k: scale * g for k, g in row.items()}])[0])
        return found

    def _place_stress(self, state: State, key: Place) -> tuple[OutlineStress, Analysis]:
        nodes, one = {key[0]: state.owners[key[0]] == key[1]}, state.simulated
        parts = self.parts_of(state.outlines)
        given = one.scene, one.partition, one.arms, one.trajectory, Profile(), by_nodes
        options = one.scene.objective.unchecked_copy({"stress_exponent": self._exponent})
        return OutlineStress(options, parts, nodes), analysis_of(*given)

    def calibrated(self, state: State) -> tuple[Problem, State]:
        """Return the problem that knows what finer meshes say, and a state on new meshes."""
        plain = replace(self, local={}, turns=_turns(state, FINE))
        fresh = plain.evaluated(state.outlines, {}, state.solutions)
        if max(fresh.places.values(), default=-1.0) < NEAR:
            return plain, fresh
        finest = replace(plain, turns=_turns(fresh, 0.5 * FINE))
        fine = finest.evaluated(state.outlines, {}, fresh.solutions).places
        places = {
            key: fine.get(key, value) if value > NEAR else value
            for key, value in fresh.places.items()
        }
        local = {key: (1.0 + value) / fresh.means[key] for key, value in places.items()}
        return replace(plain, local=local), replace(fresh, places=places)

    def limits_of(self, state: State) -> tuple[Limit, ...]:
        """Return the scene's limits, but for the volume's, with what a state makes of them."""
        limit = self.scene.constraints.limit(STRESS)
        if limit is None or not state.places:
            return state.limits
        stress = Limit(STRESS, "", 0.0, limit, "Pa")
        true = (1.0 + max(state.places.values())) * limit / self._factor(stress)
        return (*state.limits, replace(stress, value=true))

    def _factor(self, one: Limit) -> float:
        return self.tightened.get(one.name, 1.0 + RESERVE)

    @property
    def _exponent(self) -> float:
        return max(self.scene.objective.stress_exponent, PLACE_EXPONENT)

    def _volumes(self, outlines: Mapping[int, FreeSides]) -> list[tuple[float, np.ndarray]]:
        """Return volume over its limit, less 1, and its derivatives (n,), of every such limit."""
        share = self.scene.design.volume_fraction
        if share is None:
            return []
        sizes, most, slopes, first = [], [], [], 0
        count = sum(one.count for one in outlines.values())
        for one in outlines.values():
            domain, row = one.part.domain, np.zeros(count)
            row[first : first + one.count] = domain.thickness * one.area_by_x()
            first += one.count
            sizes.append(domain.thickness * one.sides.shape.area)
            # What the densities have: sides may have begun a little above the limit.
            most.append(domain.thickness * max(share * domain.whole, domain.volume))
            slopes.append(row)
        if self.scene.design.shared_volume:
            sizes, most, slopes = [sum(sizes)], [sum(most)], [np.sum(slopes, axis=0)]
        return [(s / m - 1.0, row / m) for s, m, row in zip(sizes, most, slopes, strict=True)]

    def slopes(self, state: State) -> np.ndarray:
        """Return the derivatives (1 + m, n) of the values by the variables x of all outlines."""
        if not state.simulated.arms:  # they were released
            state = self.evaluated(state.outlines, state.bodies, state.solutions)
        one = state.simulated
        given = one.scene, one.partition, one.arms, one.trajectory
        sign = -1.0 if objective_of(self.scene).turned else 1.0
        rows = [{k: sign * g for k, g in gradient(*given, Profile(), by=by_nodes).items()}]
        every = limits_of(one.scene, one.evaluation)
        found = constraint_gradients(*given, measured=one.evaluation.responses, by=by_nodes)
        for limit, row in zip(every, found, strict=True):
            if limit.quantity not in ("volume_fraction", STRESS):
                rows.append({k: self._factor(limit) * g for k, g in row.cells.items()})
        volumes = [row for _, row in self._volumes(state.outlines)]
        return np.vstack([self._by_x(state, rows), *volumes])

    def _by_x(self, state: State, rows: list[dict[int, np.ndarray]]) -> np.ndarray:
        """Return derivatives (m, n) by x from those by the nodes of the arms' meshes."""
        found = {k: np.zeros((len(rows), one.count)) for k, one in state.outlines.items()}
        every = self.every(state.outlines)
        for k, body in state.bodies.items():
            some = [number for number, row in enumerate(rows) if k in row]
            if not some:
                continue
            mesh = state.simulated.arms[k].mesh
            order = cKDTree(mesh.mesh.geometry.x[:, : mesh.dim]).query(body.points)[1]
            by_nodes = np.array([rows[number][k][order] for number in some])
            found[self.scene.patterns.get(k, k)][some] += every[k].by_x(body, by_nodes)
        return np.hstack([*found.values()])


def _turns(state: State, fine: float) -> dict[int, np.ndarray]:
    """Return the turns (n,) of all pieces along a side of a mesh, fine where stress is near."""
    found = {}
    for k, body in state.bodies.items():
        found[k] = np.full(len(_face(body).shape.pieces), TURN)
        near = [piece for (j, piece), value in state.places.items() if j == k and value > NEAR]
        found[k][near] = fine
    return found


def _face(mesh: Any) -> BodyMesh:
    """Return the triangles of a plate's mesh, in the plane or in space."""
    return mesh.face if isinstance(mesh, PlateMesh) else mesh
