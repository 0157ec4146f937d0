"""Shape optimisation of the parts: the scene's objective within its limits, on their own mesh.

Variables are the normal moves of the free outlines' control points (`free_outline`), the machine is
that of the parts on meshes along their curves, and gradients are those by the places of the nodes
(`responses.products`). A step minimises the method of moving asymptotes' approximation of
the merit f0 + c sum_i max(0, f_i) within a trust region, and is taken if the merit falls as
promised, see `optimization.mma`. What was found is judged on a finer mesh; limits that are
not kept there are tightened by what is missing, and the iterations go on.
Source: Allaire, Jouve & Toader (2004), doi:10.1016/j.jcp.2003.09.032.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import ceil
from typing import Any, ClassVar, Protocol, cast

import numpy as np
from scipy.optimize import nnls
from scipy.spatial import cKDTree

from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.optimization.measured import LIMIT_PRICE
from dolfinopt.optimization.mma import MMAState, initial_state, mma_step
from dolfinopt.part.check import STRESS, Simulated, part_column, refined, simulate_parts
from dolfinopt.part.folder import Forms, Saved
from dolfinopt.part.merit import judge_step, merit
from dolfinopt.part.part import Meshes, Part, PartMesh, mesh_parts
from dolfinopt.part.plane.free_outline import FreeOutline, free_outline
from dolfinopt.part.plane.layouts import Strut, struts_of, trusses_of, without
from dolfinopt.part.plane.part import PlanePart, with_splines
from dolfinopt.part.solid.free_surface import free_form
from dolfinopt.part.solid.part import SolidPart
from dolfinopt.part.stress import OutlineStress
from dolfinopt.profiling import Profile
from dolfinopt.responses.constraints import EXCESS, Limit, limits_of
from dolfinopt.responses.evaluation import analysis_of, constraint_gradients, gradient
from dolfinopt.responses.products import by_nodes
from dolfinopt.responses.response import Analysis, objective_of
from dolfinopt.scene.load import Scene

ITERATIONS = 80  # default, at most, from every start
FIRST = 0.75  # of them, before a finer mesh has judged
FARTHEST = 0.2  # cells that a control point moves in a step, at most
LEAST_RADIUS = 0.02  # of the trust region, of FARTHEST, below which no step is looked for
SETTLED, PATIENCE = 1e-3, 6  # relative fall of the objective in so many steps that ends a round
SIDES = 1.0  # of the triangles over those of the fine mesh
ROUNDS = 6  # of iterations, each with limits tightened by what the finer mesh showed
HALVED = 2  # times that sides are halved where the finer mesh found stress to be largest
RESERVE = 2e-3  # relative, of every limit: what a finer mesh adds hardly matters then
STRESS_EXPONENT = 16.0  # at least: peaks are at fillets, not all along
FIRST, WIDEST = 0.5, 1.0  # first and largest distance of the asymptotes, ranges of a variable
TRIALS = 30  # struts of an arm that are left out in trial, at most
GAIN = 1e-4  # relative, of the objective, that leaving out a strut must promise
TRUSSES = "trusses"  # what the names of starts that are no densities begin with
PRUNINGS = 3  # times that struts are left out from one start
ACTIVE = 0.02  # relative distance up to which a limit counts where struts are judged

Tell = Callable[[str], None]
Keep = Callable[[Sequence[Saved]], None]


@dataclass(frozen=True, eq=False)
class Found:
    """What the search from one start found.

    Attributes:
        start: what it began with.
        parts: by their place in the chain.
        iterations: steps taken.
        value: of the objective, on fine meshes.
        limits: of the scene, on the fine meshes.
        ending: why it ended.
    """

    start: str
    parts: dict[int, Part]
    iterations: int
    value: float
    limits: tuple[Limit, ...]
    ending: str

    @property
    def sentence(self) -> str:
        """What came out, in one line."""
        missed = [one.sentence for one in self.limits if not one.met]
        kept = "; ".join(missed) if missed else "all limits kept"
        return f"{self.iterations} iterations ({self.ending}), objective {self.value:.4g}, {kept}"

    def to_dict(self) -> dict[str, Any]:
        """Return its entry of part.json."""
        names = ("start", "iterations", "value", "ending")
        met = all(one.met for one in self.limits)
        return {name: getattr(self, name) for name in names} | {"limits_met": met}


@dataclass(frozen=True, eq=False)
class Optimized:
    """What the shape optimisation made of the parts.

    Attributes:
        best: of all starts.
        others: what came of the other starts.
        meshes: of the best parts.
        before: objective of the parts before, on fine meshes.
        interrupted: whether it was ended from outside.
    """

    best: Found
    others: tuple[Found, ...]
    meshes: Meshes
    before: float
    interrupted: bool

    @property
    def parts(self) -> dict[int, Part]:
        """The optimised parts."""
        return self.best.parts

    @property
    def sentences(self) -> list[str]:
        """What it brought, a line for every start, the one that is kept first."""
        first = f"shape optimisation, objective {self.before:.4g} before: from {self.best.start}"
        rest = [f"not kept: from {one.start}: {one.sentence}" for one in self.others]
        return [f"{first}: {self.best.sentence}", *rest]

    def to_dict(self) -> dict[str, Any]:
        """Return its entry of part.json."""
        one = self.best
        return {
            "iterations": one.iterations,
            "before": self.before,
            "after": one.value,
            "ending": one.ending,
            "start": one.start,
            "others": [other.to_dict() for other in self.others],
        }


def optimize_parts(
    scene: Scene,
    parts: Mapping[int, Part],
    iterations: int = ITERATIONS,
    tell: Tell = print,
    starts: int = 0,
    keep: Keep | None = None,
    known: Sequence[Saved] = (),
) -> Optimized:
    """Return parts that are better by the scene's objective and keep its limits.

    On this rank alone. Lines, arcs, interfaces, bores and what stays solid stay where they are.
    Of several starts the best one that keeps the limits counts. KeyboardInterrupt ends the search;
    what is best so far is returned.

    Args:
        scene: of the run.
        parts: by their place in the chain.
        iterations: at most, from every start.
        tell: gets a line an iteration.
        starts: trusses from which to begin, besides the parts themselves.
        keep: is given where the searches are, after every step.
        known: where those of an earlier call were, with which they go on.

    Raises:
        ConvergenceError: the machine with the parts cannot be simulated.
        InputError: parts have no free curves.
    """
    owned = {k: part for k, part in parts.items() if k not in scene.patterns}
    value, limits, _ = _judged(scene, dict(parts))
    given = Found("the parts themselves", dict(parts), 0, value, limits, "as they were")
    outlines = {k: _free(scene, k, part) for k, part in owned.items()}
    if not any(one.count for one in outlines.values()):
        raise InputError("--optimize: the parts have no free curves: nothing can move")
    found: list[Found] = []
    interrupted = False
    saved = {one.start: one for one in known}

    def kept(one: Saved) -> None:
        saved[one.start] = one
        if keep is not None:
            keep(tuple(saved.values()))

    for number in range(1 + starts):
        name = f"{TRUSSES} {number}" if number else "the densities' parts"
        descent = None
        try:
            if number:
                plates = {k: one for k, one in owned.items() if isinstance(one, PlanePart)}
                trusses = trusses_of(plates, number - 1)
                outlines = {k: _free(scene, k, part) for k, part in trusses.items()}
            if starts:
                tell(f"from {name}")
            begun = Problem(scene, parts, {}), outlines, iterations, tell
            descent = Descent(*begun, number, kept, saved.get(number))
            found.append(descent.found(name))
        except (ConvergenceError, InputError) as error:  # the parts as they were remain
            tell(f"from {name}: {error}")
        except KeyboardInterrupt:
            interrupted = True
            if descent is not None:
                tell("interrupted: the best so far is judged and kept; once more gives it up")
                found.append(descent.so_far(name))
            break
    best = min([given, *found], key=lambda one: _rank(scene, one.value, one.limits))
    others = tuple(one for one in found if one is not best)
    return Optimized(best, others, mesh_parts(best.parts), value, interrupted)


def _free(scene: Scene, k: int, part: Part) -> FreeForm:
    """Return what moves of a part; it is no thinner where other arms repeat it smaller."""
    repeating = [scene.arms[j] for j, pattern in scene.patterns.items() if pattern == k]
    one = scene.arms[k]
    sizes = [s for a in repeating for s in (a.length / one.length, a.height / one.height)]
    if isinstance(part, PlanePart):
        return free_outline(with_splines(part), scene.design.minimum_gap, min([1.0, *sizes]))
    if not isinstance(part, SolidPart):
        raise InputError(
            f"--optimize: the wall of arm {part.name!r} is what dolfinopt optimize has moved "
            "already (arms.hollow); leave it out"
        )
    return free_form(part, SIDES)


def _rank(scene: Scene, value: float, limits: tuple[Limit, ...]) -> tuple[float, float]:
    """Return what orders designs, best first: feasible ones by their objective, else by excess."""
    excess = max((0.0 if one.met else one.excess for one in limits), default=0.0)
    return excess, -value if objective_of(scene).turned else value


def _tightened(fine: Limit, coarse: Limit) -> float:
    """Return by how much a limit counts more on the coarse mesh, so that the fine one keeps it."""
    if fine.least:
        return (coarse.value / fine.value) ** 2 * (1.0 + RESERVE)
    return fine.value / coarse.value * (1.0 + RESERVE)


Judgement = tuple[float, tuple[Limit, ...], dict[int, list[np.ndarray]]]


def _judged(scene: Scene, parts: dict[int, Part]) -> Judgement:
    """Return objective, limits and the places of largest stress of parts on refined meshes."""
    refine = any(one.REFINEMENTS for one in parts.values())
    meshes, coarse = mesh_parts(parts, refine), None
    if meshes.coarse:  # by what it differs they are refined
        coarse, _ = part_column(scene, simulate_parts(scene, parts, meshes.coarse), parts)
    state, column, stress, *_ = refined(scene, parts, meshes.fine, coarse)
    hot: dict[int, list[np.ndarray]] = {k: [] for k in parts}
    for place, one in stress.items():
        owner = scene.owners[place]
        if scene.constraints.limit("stress") is not None and owner is not None and len(one.hot):
            hot[owner] += HALVED * [one.hot]
    return state.evaluation.objective, column.limits, hot


# -- from one start ----------------------------------------------------------------------------


class Descent:
    """Searches from one start: steps, struts left out, limits tightened by a finer mesh.

    Attributes:
        problem: with limits as tight as the finer mesh asks for.
        state: the best of the searches that have ended.
        search: that goes on.
        done: steps taken in those that have ended.
        best: of what finer meshes have judged, and `forms` its outlines.
    """

    def __init__(
        self,
        problem: Problem,
        outlines: Mapping[int, FreeForm],
        iterations: int,
        tell: Tell,
        number: int = 0,
        keep: Callable[[Saved], None] = lambda _: None,
        known: Saved | None = None,
    ):
        """Begin at outlines, or where a search from them is known to have been."""
        self.iterations, self.tell, self.number, self.keep = iterations, tell, number, keep
        self.known, self.done = known, 0
        self.best, self.forms = cast(Found | None, None), cast(Mapping[int, FreeForm], {})
        if known is not None:
            problem = replace(problem, tightened=known.tightened)
            outlines, self.forms = _restored(outlines, known.forms), _restored(outlines, known.best)
            self.done = known.done
        self.problem, self.state = problem, problem.evaluated(outlines, {})
        self.search = Search(problem, self.state)

    def found(self, start: str) -> Found:
        """Search to the end, and return the best of what finer meshes have judged."""
        if self.known is not None and self.forms:  # by an earlier call
            now, self.state = self.state, replace(self.state, outlines=self.forms)
            found, _ = self._judged(start, self.known.ending)
            if self.known.ending:
                return found
            self.state = now
        for _ in range(ROUNDS):
            ending = self._searched()
            found, limits = self._judged(start, ending)
            kept = all(one.met for one in limits)
            if self.done >= self.iterations or (kept and not self.search.spent):
                break
            self._tighten(limits)
        self._keep(ending)
        return replace(found, ending=ending)

    def _keep(self, ending: str = "") -> None:
        """Say where the search is."""
        state = min(self.state, self.search.best, key=lambda one: one.rank)
        forms, best = (
            {k: one.arrays for k, one in some.items()} for some in (state.outlines, self.forms)
        )
        done = self.done + self.search.steps
        self.keep(Saved(self.number, done, ending, self.problem.tightened, forms, best))

    def _told(self, line: str) -> None:
        """Tell of a step, which is kept first."""
        self._keep()
        self.tell(line)

    def so_far(self, start: str) -> Found:
        """Return the best so far of a search that was interrupted."""
        self.state = min(self.state, self.search.best, key=lambda one: one.rank)
        self.done += self.search.steps
        return replace(self._judged(start, "")[0], ending="interrupted")

    def _judged(self, start: str, ending: str) -> tuple[Found, tuple[Limit, ...]]:
        """Return the best of what is judged, the state now among it, and the state's limits."""
        # Curves, or walls, that all but touch cannot be meshed: then those before them are judged.
        problem: Exception | None = None
        for outlines in (self.state.outlines, *reversed(self.search.passed)):
            scene, made = self.problem.scene, self.problem.parts_of(outlines)
            try:
                value, limits, hot = _judged(scene, made)
            except (ConvergenceError, InputError) as error:
                problem = error
                continue
            self.state = replace(self.state, outlines=outlines)
            break
        else:
            if self.best is None:
                assert problem is not None
                raise problem
            return replace(self.best, iterations=self.done), self.best.limits
        self.problem = replace(self.problem, hot=hot)
        found = Found(start, made, self.done, value, limits, ending)
        if self.best is not None:
            known = self.best
            worse = _rank(scene, value, limits) >= _rank(scene, known.value, known.limits)
            found = replace(known, iterations=self.done) if worse else found
        if found.parts is made:
            self.forms = outlines
        self.best = found
        return found, limits

    def _tighten(self, limits: tuple[Limit, ...]) -> None:
        """Go on with meshes that are finer where stress is largest, and with tighter limits."""
        self.state = self.problem.evaluated(self.state.outlines, {}, self.state.solutions)
        loop = {one.name: one for one in self.state.limits}
        missing = {one.name: _tightened(one, loop[one.name]) for one in limits if not one.met}
        if not missing:
            return
        self.tell("tightened by what the finer mesh shows: " + ", ".join(missing))
        self.problem = replace(self.problem, tightened={**self.problem.tightened, **missing})
        self.state = self.problem.evaluated(self.state.outlines, {}, self.state.solutions)

    def _searched(self) -> str:
        """Go from the state to the best one that steps lead to; return why it ended."""
        self.search = Search(self.problem, self.state)
        self.state = self.state.released
        # Limits that a finer mesh has tightened are a few per cent, and no matter of layout.
        first = self.best is None
        most = ceil(FIRST * self.iterations) if first else self.iterations
        for number in range(1 + PRUNINGS):
            search = self.search
            ending = search.run(most - self.done, self._told, self.done)
            self.done, search.steps = self.done + search.steps, 0
            if number and not search.best.rank < self.state.rank:
                self.tell("no better without these struts: they stay")
                break
            self.state = search.best
            if not first or self.done >= most or number == PRUNINGS:
                break
            thinner = self._without_struts()
            if thinner is None:
                break
            self.search = Search(self.problem, thinner)
        return ending

    def _without_struts(self) -> State | None:
        """Return the state without struts that weigh more than they bring; None: all do."""
        # What they bring is told by the Lagrangian: of each by itself, then of those that promise
        # most together, as long as every further one gains.
        state, price = self.state, self.problem.prices(self.state)
        gain = GAIN * abs(state.values[0])
        promised: list[tuple[float, int, int, Strut]] = []
        plates = {k: o for k, o in state.outlines.items() if isinstance(o, FreeOutline)}
        for k, outline in plates.items():
            for strut in struts_of(outline)[:TRIALS]:
                tried = self._tried({**state.outlines, k: without(outline, [strut])})
                if tried is not None:
                    change = (tried.against(state.held) - state.values) @ price
                    promised.append((change, k, len(promised), strut))
        found, least = None, 0.0
        gone: dict[int, list[Strut]] = {k: [] for k in state.outlines}
        for change, k, _, strut in sorted(promised, key=lambda one: one[:3]):
            if change > -gain or not all(strut.beside.isdisjoint(o.beside) for o in gone[k]):
                continue
            more = {**gone, k: [*gone[k], strut]}
            outlines = {j: without(one, more[j]) for j, one in plates.items()}
            tried = self._tried(outlines)
            if tried is None:
                continue
            change = (tried.against(state.held) - state.values) @ price
            if change < least - gain:
                found, least, gone = tried, change, more
        count = sum(map(len, gone.values()))
        if found is not None:
            self.tell(f"tried without {count} strut{'s' if count > 1 else ''}")
        return found

    def _tried(self, outlines: Mapping[int, FreeForm]) -> State | None:
        if not all(one.is_valid for one in outlines.values()):
            return None
        try:
            return self.problem.evaluated(outlines, {}, self.state.solutions)
        except (ConvergenceError, InputError):
            return None


def _restored(outlines: Mapping[int, FreeForm], forms: Forms) -> dict[int, FreeForm]:
    """Return what outlines had become, by what was kept of them."""
    return {k: outlines[k].restored(arrays) for k, arrays in forms.items()}


class FreeForm(Protocol):
    """The outline or surface of a part as variables x: moves s = F x along normals, m."""

    STEPS: ClassVar[int]

    def is_worn(self, mesh: Any) -> bool:
        """Whether a mesh that followed is to be made anew."""

    @property
    def part(self) -> Any:
        """That it was made of, with the domain of its arm."""

    @property
    def current(self) -> Part:
        """The part with this form."""

    @property
    def made(self) -> Part:
        """The part with this form, and what is measured of it."""

    @property
    def count(self) -> int:
        """Number of variables."""

    @property
    def size(self) -> float:
        """Area of a plate, m2, or volume, m3."""

    @property
    def is_valid(self) -> bool:
        """Whether it can be a part: nothing crosses."""

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """What `restored` makes it of."""

    def restored(self, arrays: Mapping[str, np.ndarray]) -> FreeForm:
        """Return the form of these `arrays`, of one that this has become."""

    def filtered(self, x: np.ndarray) -> np.ndarray:
        """Return s = F x (count,)."""

    def by_x(self, by_s: np.ndarray) -> np.ndarray:
        """Return derivatives (m, count) by x from those by s."""

    def moved(self, s: np.ndarray) -> FreeForm:
        """Return the form moved outwards by s (count,)."""

    def rounded(self) -> FreeForm:
        """Return the form with concave corners that the tool reaches."""

    def scaled(self, part: Any, factors: np.ndarray) -> FreeForm:
        """Return the form of an arm that repeats this one's design; factors of its sizes."""

    def room(self) -> tuple[np.ndarray, np.ndarray]:
        """Return how far (count,) it may move inwards and outwards in a step, m."""

    def meshed(self, coarser: float, finer: Sequence[np.ndarray]) -> tuple[FreeForm, PartMesh]:
        """Return a new mesh of it, and it: variables may be others then."""

    def followed(self, mesh: Any) -> PartMesh | None:
        """Return the mesh of a form nearby, moved to this one; None where it folds."""

    def by_s(self, mesh: Any, by_nodes: np.ndarray) -> np.ndarray:
        """Return derivatives (count,) by s from those by the places of the nodes of its mesh."""

    def size_by_s(self) -> np.ndarray:
        """Return the derivative (count,) of the size by s."""


# -- the problem at one outline ----------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class State:
    """Outlines, their meshes and what the machine does with them.

    Attributes:
        outlines, bodies: by the arm's place in the chain.
        simulated: the machine.
        limits: of the scene, but for the volume's.
        smooth, held: (k,) smooth value of each of them, and its limit, tightened and scaled so that
            the true value is limited.
        shares: relative constraints of the volumes.
    """

    outlines: Mapping[int, FreeForm]
    bodies: Mapping[int, PartMesh]
    simulated: Simulated
    limits: tuple[Limit, ...]
    smooth: np.ndarray
    held: np.ndarray
    shares: np.ndarray

    @property
    def values(self) -> np.ndarray:
        """What is minimised, and the relative constraints by their true values (1 + m,)."""
        return self.against(self.held)

    def against(self, held: np.ndarray) -> np.ndarray:
        """Return the same by smooth values and the smooth limits of another state."""
        sign = -1.0 if objective_of(self.simulated.scene).turned else 1.0
        objective = sign * self.simulated.evaluation.objective
        return np.concatenate([[objective], self.smooth / held - 1.0, self.shares])

    @property
    def rank(self) -> tuple[float, float]:
        """What orders states, best first: feasible ones by their objective, else by excess."""
        excess = self.values[1:].max(initial=0.0)
        return (excess if excess > EXCESS else 0.0), self.values[0]

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
        hot: places of every part (n, 2), m, near which its mesh is finer, once for every array.
    """

    scene: Scene
    parts: Mapping[int, Part]
    tightened: Mapping[str, float]
    hot: Mapping[int, list[np.ndarray]] = field(default_factory=dict)

    def every(self, outlines: Mapping[int, FreeForm]) -> dict[int, FreeForm]:
        """Return the outlines with those of arms that repeat them."""
        found = dict(outlines)
        for k, pattern in self.scene.patterns.items():
            found[k] = outlines[pattern].scaled(self.parts[k], self._factors(k))
        return {k: found[k] for k in sorted(found)}

    def parts_of(self, outlines: Mapping[int, FreeForm]) -> dict[int, Part]:
        """Return the parts of all arms with these outlines."""
        return {k: one.made for k, one in self.every(outlines).items()}

    def _factors(self, k: int) -> np.ndarray:
        """Return the sizes of an arm over those of the one whose design it repeats."""
        one, other = self.scene.arms[k], self.scene.arms[self.scene.patterns.get(k, k)]
        sizes = [one.length / other.length, one.height / other.height]
        return np.array([*sizes, one.thickness / other.thickness][: self.scene.dimension])

    def evaluated(
        self, outlines: Mapping[int, FreeForm], bodies: Mapping[int, PartMesh], *start: Any
    ) -> State:
        """Return what the machine does; on meshes that are made anew where none are given.

        Raises:
            InputError: an outline cannot be meshed.
            ConvergenceError: the machine cannot be simulated.
        """
        every = self.every(outlines)
        if not bodies:
            anew = {k: one.meshed(SIDES, self.hot.get(k, ())) for k, one in every.items()}
            every = {k: one for k, (one, _) in anew.items()}
            outlines = {k: every[k] for k in outlines}
            bodies = {k: mesh for k, (_, mesh) in anew.items()}
        parts = {k: one.current for k, one in every.items()}
        changes: dict[str, Any] = {"objective": {"gradient": "exact"}}
        if self.scene.constraints.limits.keys() - {STRESS}:
            changes["constraints"] = {STRESS: None}  # of parts it is that of the outline
        simulated = simulate_parts(self.scene, parts, bodies, *start, **changes)
        found, rows = simulated.evaluation, []
        limits = limits_of(simulated.scene, found)
        for one, value, limit in zip(limits, found.constraints, found.smooth_limits, strict=True):
            if one.quantity not in ("volume_fraction", STRESS):
                rows.append((one, (1.0 + value) * limit, limit / self._factor(one)))
        if (limit := self.scene.constraints.limit(STRESS)) is not None:
            stress, analysis = self._outline_stress(simulated, every)
            measured = stress.measure(analysis)
            true, smooth = measured.values[0], measured.smooth[0]
            one = Limit(STRESS, "", true, limit, "Pa")
            rows.append((one, smooth, limit * smooth / true / self._factor(one)))
        known, smooths, held = zip(*rows, strict=True) if rows else ((), (), ())
        shares = [area / most - 1.0 for area, most, _ in self._volumes(outlines)]
        numbers = (np.array(one, dtype=float) for one in (smooths, held, shares))
        return State(outlines, bodies, simulated, tuple(known), *numbers)

    def _factor(self, one: Limit) -> float:
        return self.tightened.get(one.name, 1.0 + RESERVE)

    def _outline_stress(
        self, simulated: Simulated, outlines: Mapping[int, FreeForm]
    ) -> tuple[OutlineStress, Analysis]:
        """Return the stress on the outlines as a response, and what it is computed from."""
        parts = {k: one.current for k, one in outlines.items()}
        one = simulated
        given = one.scene, one.partition, one.arms, one.trajectory, Profile(), by_nodes
        p = max(one.scene.objective.stress_exponent, STRESS_EXPONENT)
        options = one.scene.objective.model_copy(update={"stress_exponent": p})
        return OutlineStress(options, parts), analysis_of(*given)

    def _volumes(
        self, outlines: Mapping[int, FreeForm]
    ) -> list[tuple[float, float, tuple[int, ...]]]:
        """Return area, largest area (m2) and arms of every limit of the volume."""
        share = self.scene.design.volume_fraction
        if share is None:
            return []
        area = {k: one.size for k, one in outlines.items()}
        most = {
            # What the densities have: curves may have begun a little above the limit.
            k: max(share * one.part.domain.whole, one.part.domain.volume)
            for k, one in outlines.items()
        }
        if self.scene.design.shared_volume:
            return [(sum(area.values()), sum(most.values()), tuple(outlines))]
        return [(area[k], most[k], (k,)) for k in outlines]

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
        if self.scene.constraints.limit("stress") is not None:
            stress, analysis = self._outline_stress(one, self.every(state.outlines))
            (row,) = stress.gradients(analysis)
            rows.append({k: g / state.held[len(rows) - 1] for k, g in row.items()})
        parts = [self._by_x(state, rows)]
        volumes = self._volumes(state.outlines)
        if volumes:
            shares = [
                np.concatenate(
                    [
                        o.by_x(o.size_by_s()[None])[0] / most if k in arms else np.zeros(o.count)
                        for k, o in state.outlines.items()
                    ]
                )
                for _, most, arms in volumes
            ]
            parts.append(np.array(shares))
        return np.vstack(parts)

    def _by_x(self, state: State, rows: list[dict[int, np.ndarray]]) -> np.ndarray:
        """Return derivatives (m, n) by x from those by the nodes of the arms' meshes."""
        found = {k: np.zeros((len(rows), one.count)) for k, one in state.outlines.items()}
        for k, body in state.bodies.items():
            owner, factors = self.scene.patterns.get(k, k), self._factors(k)
            mesh = state.simulated.arms[k].mesh
            order = cKDTree(mesh.mesh.geometry.x[:, : mesh.dim]).query(body.points)[1]
            for number, row in enumerate(rows):
                if k in row:
                    by_nodes = row[k][order] * factors
                    found[owner][number] += state.outlines[owner].by_s(body, by_nodes)
        return np.hstack([state.outlines[k].by_x(by_s) for k, by_s in found.items()])

    def prices(self, state: State) -> np.ndarray:
        """Return 1 and the multipliers of the limits (1 + m,), by least squares."""
        slopes, values = self.slopes(state), state.values
        room = np.concatenate([np.minimum(*one.room()) for one in state.outlines.values()])
        free, active = room > 0.0, values[1:] > -ACTIVE
        found = np.zeros(len(values))
        found[0] = 1.0
        if active.any():
            A = slopes[1:][active][:, free].T
            found[1:][active] = nnls(A, -slopes[0][free])[0]
        return found


# -- the steps ---------------------------------------------------------------------------------


class Search:
    """Steps within a trust region from one state on.

    Attributes:
        best: the best state so far: of the feasible ones that with the least objective.
        meshed: the last one whose mesh was made anew.
        passed: outlines of that one and of those since then.
        steps: taken.
    """

    def __init__(self, problem: Problem, state: State):
        """Begin at a state."""
        self.problem, self.state = problem, state
        self.best = self.meshed = state.released
        self.passed = [dict(state.outlines)]
        self.steps, self.radius, self.morphed = 0, 1.0, 0
        self.x = np.zeros(0)
        self.mma: MMAState = initial_state(self.x)
        self.falls: list[float] = []
        self.spent = False  # whether no more iterations were allowed
        self._begin()

    def _begin(self) -> None:
        """Begin the approximation anew where the variables are others."""
        count = sum(one.count for one in self.state.outlines.values())
        if len(self.x) != count:
            self.x = np.zeros(count)
            self.mma = initial_state(self.x)

    def run(self, iterations: int, tell: Tell, first: int) -> str:
        """Take so many steps at most; return why the search ended."""
        self.spent = False
        while self.steps < iterations:
            if not self._step():
                return "no step betters the parts"
            self.steps += 1
            self._keep()
            tell(self._line(first + self.steps))
            if self._settled():
                return "settled"
        self.spent = True
        return f"{first + iterations} iterations"

    def _keep(self) -> None:
        if self.state.rank < self.best.rank:
            self.best = self.state.released
        self.falls.append(self.best.values[0])

    def _settled(self) -> bool:
        if len(self.falls) <= PATIENCE or self.best.values[1:].max(initial=0.0) > EXCESS:
            return False
        fall = self.falls[-1 - PATIENCE] - self.falls[-1]
        return bool(fall < SETTLED * abs(self.falls[-1]))

    def _line(self, number: int) -> str:
        one = self.state
        worst = one.values[1:].max(initial=0.0)
        words = "limits met" if worst <= EXCESS else f"{100.0 * worst:.2g} % over a limit"
        bodies = one.simulated.trajectory.mechanism.bodies
        mass = sum(bodies[k].mass for k in self.problem.parts)
        return (
            f"{number} objective {one.simulated.evaluation.objective:.5g}, mass {mass:.4g} kg, "
            f"{words}, trust region {self.radius:.2g}"
        )

    def _step(self) -> bool:
        """Take a step that lowers the merit; return whether there is one."""
        if self._is_worn():
            if not self._mesh_anew():
                return False
            self._begin()
        slopes = self.problem.slopes(self.state)
        self.state = self.state.released  # for the matrices of those that are tried
        before = self.state
        price = LIMIT_PRICE * (abs(before.values[0]) or 1.0)
        room = {k: one.room() for k, one in before.outlines.items()}
        while self.radius >= LEAST_RADIUS:
            x, after = self._proposed(slopes, price, room)
            tried = self._tried(x, room)
            if tried is None:
                self.radius *= 0.5
                continue
            promised = before.values + slopes @ (x - self.x)
            values = before.values, tried.against(before.held), promised
            accepted, factor = judge_step(*(merit(one, price) for one in values))
            self.radius = min(1.0, factor * self.radius)
            if accepted:
                self.x, self.mma, self.state = x, after, tried
                self.passed.append(dict(tried.outlines))
                self.morphed += 1
                return True
        return False

    def _mesh_anew(self) -> bool:
        """Go on with new meshes, of an earlier state where the last one has none; else end."""
        self.state = self.state.released
        for number, outlines in enumerate(reversed(self.passed)):
            try:
                self.state = self.problem.evaluated(outlines, {}, self.state.solutions)
            except (ConvergenceError, InputError):  # curves, or walls, that all but touch
                self.radius *= 0.5
                continue
            if number:  # those passed over cannot be parts
                self.best = min(self.meshed, self.state.released, key=lambda one: one.rank)
            self.meshed, self.morphed = self.state.released, 0
            self.passed = [dict(self.state.outlines)]
            return True
        self.best = self.meshed
        return False

    def _proposed(
        self,
        slopes: np.ndarray,
        price: float,
        room: Mapping[int, tuple[np.ndarray, np.ndarray]],
    ) -> tuple[np.ndarray, MMAState]:
        low, high = [], []
        for k, one in self.state.outlines.items():
            far = self.radius * FARTHEST * one.part.domain.cell
            low.append(-np.minimum(room[k][0], far))
            high.append(np.minimum(room[k][1], far))
        values = self.state.values
        return mma_step(
            self.x,
            slopes[0],
            values[1:],
            slopes[1:],
            self.x + np.concatenate(low),
            self.x + np.concatenate(high),
            self.mma,
            move=1.0,
            first=FIRST,
            widest=WIDEST,
            prices=np.full(len(values) - 1, price),
        )

    def _tried(
        self, x: np.ndarray, room: Mapping[int, tuple[np.ndarray, np.ndarray]]
    ) -> State | None:
        """Return what a step leads to; None where its outlines cannot be parts."""
        outlines, first = {}, 0
        for k, one in self.state.outlines.items():
            s = one.filtered(x[first : first + one.count] - self.x[first : first + one.count])
            first += one.count
            outlines[k] = one.moved(np.clip(s, -room[k][0], room[k][1])).rounded()
            if not outlines[k].is_valid:
                return None
        try:
            every = self.problem.every(outlines)
            after = {k: one.followed(self.state.bodies[k]) for k, one in every.items()}
            bodies = {k: body for k, body in after.items() if body is not None}
            anew = len(bodies) < len(after)
            return self.problem.evaluated(outlines, {} if anew else bodies, self.state.solutions)
        except (ConvergenceError, InputError):
            return None

    def _is_worn(self) -> bool:
        """Whether meshes have followed too many steps."""
        forms, bodies = self.state.outlines, self.state.bodies
        return any(self.morphed >= o.STEPS or o.is_worn(bodies[k]) for k, o in forms.items())
