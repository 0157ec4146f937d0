"""Shape optimisation of the parts: the scene's objective within its limits, on their own mesh.

Variables are the sides, fillets and circles of plates (`plane.free_sides`); the machine is that of
the parts on meshes along them, and gradients are those by the places of the nodes
(`responses.products`). What a search found is judged on a finer mesh; limits that are not kept
there are tightened by what is missing, and a few more steps meet them.
Source: Allaire, Jouve & Toader (2004), doi:10.1016/j.jcp.2003.09.032.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from dolfinopt.arms.arm import stiffening_of
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.part.check import Column, refined
from dolfinopt.part.folder import Forms, Saved
from dolfinopt.part.part import Meshes, mesh_parts
from dolfinopt.part.plane.free_sides import FreeSides
from dolfinopt.part.plane.layouts import trusses_of
from dolfinopt.part.plane.limits import limits_of_part
from dolfinopt.part.plane.part import PlanePart
from dolfinopt.part.problem import Problem
from dolfinopt.part.search import Search
from dolfinopt.part.solid.part import SolidPart
from dolfinopt.responses.constraints import Limit
from dolfinopt.responses.response import objective_of
from dolfinopt.scene.load import Scene

if TYPE_CHECKING:
    from dolfinopt.part.part import Part

REPAIRS = 5  # times that limits missed in the end are met by further steps
TRUSSES = "trusses"  # what the names of starts that are no densities begin with

Outlines = Mapping[int, FreeSides]
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
        missed = [limit.usage for limit in self.limits if not limit.met]
        kept = "; ".join(missed) if missed else "all limits kept"
        return f"{self.iterations} iterations ({self.ending}), objective {self.value:.4g}, {kept}"

    def to_dict(self) -> dict[str, Any]:
        """Return its entry of part.json."""
        names = ("start", "iterations", "value", "ending")
        met = all(limit.met for limit in self.limits)
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
        rest = [f"not kept: from {other.start}: {other.sentence}" for other in self.others]
        return [f"{first}: {self.best.sentence}", *rest]

    def to_dict(self) -> dict[str, Any]:
        """Return its entry of part.json."""
        best = self.best
        return {
            "iterations": best.iterations,
            "before": self.before,
            "after": best.value,
            "ending": best.ending,
            "start": best.start,
            "others": [other.to_dict() for other in self.others],
        }


def optimize_parts(
    scene: Scene,
    parts: Mapping[int, Part],
    iterations: int,
    tell: Tell = print,
    starts: int = 0,
    keep: Keep | None = None,
    known: Sequence[Saved] = (),
    before: Column | None = None,
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
        before: what the parts do; None: it is not known.

    Raises:
        ConvergenceError: the machine with the parts cannot be simulated.
        InputError: parts have no free curves.
    """
    gc.collect()
    gc.freeze()  # what is there already need not be looked through after each evaluation
    owned = {k: part for k, part in parts.items() if k not in scene.patterns}
    column = _judged(scene, dict(parts)) if before is None else before
    given = Found(
        "the parts themselves", dict(parts), 0, column.objective, column.limits, "as they were"
    )
    outlines: Outlines = {k: _free(scene, k, part) for k, part in owned.items()}
    if not any(outline.count for outline in outlines.values()):
        raise InputError("--optimize: the parts have no free curves: nothing can move")
    result: list[Found] = []
    interrupted = False
    saved = {item.start: item for item in known}

    def kept(search: Saved) -> None:
        saved[search.start] = search
        if keep is not None:
            keep(tuple(saved.values()))

    for number in range(1 + starts):
        name = f"{TRUSSES} {number}" if number else "the densities' parts"
        descent = None
        try:
            if number:
                plates = {k: item for k, item in owned.items() if isinstance(item, PlanePart)}
                trusses = trusses_of(plates, number - 1)
                outlines = {k: _free(scene, k, part) for k, part in trusses.items()}
            if starts:
                tell(f"from {name}")
            earlier = saved.get(number)
            descent = Descent(
                Problem(scene, parts, {}), outlines, iterations, tell, number, kept, earlier
            )
            result.append(descent.found(name))
        except (ConvergenceError, InputError) as error:  # the parts as they were remain
            tell(f"from {name}: {error}")
        except KeyboardInterrupt:
            interrupted = True
            if descent is not None:
                tell("interrupted: the best so far is judged and kept; once more gives it up")
                result.append(descent.so_far(name))
            break
    gc.unfreeze()
    best = min([given, *result], key=lambda item: _rank(scene, item))
    others = tuple(item for item in result if item is not best)
    return Optimized(best, others, mesh_parts(best.parts), given.value, interrupted)


def _free(scene: Scene, k: int, part: Part) -> FreeSides:
    """Return the sides of a part."""
    # No thinner than arms that repeat it smaller allow.
    repeating = [scene.arms[j] for j, pattern in scene.patterns.items() if pattern == k]
    arm = scene.arms[k]
    sizes = [s for a in repeating for s in (a.length / arm.length, a.height / arm.height)]
    flat = part.flat if isinstance(part, SolidPart) else part
    if not isinstance(flat, PlanePart):
        raise InputError(
            f"--optimize: the surface of arm {part.name!r} has no sides that could move: its part "
            "is what dolfinopt optimize has made of it; leave --optimize out, or make a plate of "
            'it (arms.symmetric = "extruded")'
        )
    smallest, tool = min([1.0, *sizes]), flat.outline.tool_radius
    limits = limits_of_part(flat.domain, tool, scene.design.minimum_gap, smallest)
    free = FreeSides(flat, flat.sides, limits, part.domain if isinstance(part, SolidPart) else None)
    result = free.nearest()
    return free if result is None else result[0]


def _rank(scene: Scene, result: Found) -> tuple[float, float]:
    """Return what orders designs, best first: feasible ones by their objective, else by excess."""
    excess = max((0.0 if limit.met else limit.excess for limit in result.limits), default=0.0)
    return excess, -result.value if objective_of(scene).turned else result.value


def _judged(scene: Scene, parts: dict[int, Part]) -> Column:
    """Return what parts do on refined meshes."""
    refines = any(part.REFINEMENTS for part in parts.values())
    meshes = {} if refines else mesh_parts(parts, coarse=False).fine
    return refined(scene, parts, meshes, None)[1]


# -- from one start ----------------------------------------------------------------------------


class Descent:
    """The search from one start: steps, and limits tightened by what finer meshes show.

    Attributes:
        problem: with limits as tight as finer meshes ask for.
        search: that goes on.
        best: of what finer meshes have judged, and `forms` its outlines.
    """

    def __init__(
        self,
        problem: Problem,
        outlines: Outlines,
        iterations: int,
        tell: Tell,
        number: int,
        keep: Callable[[Saved], None],
        known: Saved | None,
    ):
        """Begin at outlines, or where a search from them is known to have been."""
        self.iterations, self.tell, self.number, self.keep = iterations, tell, number, keep
        self.best: Found | None = None
        self.forms: Outlines = {}
        self.ending, done = "", 0
        if known is not None:
            problem = replace(problem, tightened=known.tightened)
            outlines, self.forms = _restored(outlines, known.forms), _restored(outlines, known.best)
            self.ending, done = known.ending, known.done
        state = problem.evaluated(outlines, {})
        decided = stiffening_of(state.simulated.arms)
        problem = replace(problem, stiffening=decided.on if decided else None)
        self.search = Search(problem, state, done)

    def found(self, start: str) -> Found:
        """Search to the end, and return the best of what finer meshes have judged."""
        if self.forms:  # by an earlier call
            result = self._judged(start, self.forms)
            if self.ending:
                return result
        self.ending = self.search.run(self.iterations, self._told)
        for repairs in range(1 + REPAIRS):
            result = self._judged(start, self.search.state.outlines, self.search.meshed)
            if repairs == REPAIRS or all(limit.met for limit in result.limits):
                break
            self._repair(start, result.limits)
        self._keep()
        assert self.best is not None
        return replace(self.best, iterations=self.search.steps, ending=self.ending)

    def _keep(self) -> None:
        """Say where the search is."""
        forms, best = (
            {k: item.sides for k, item in some.items()}
            for some in (self.search.state.outlines, self.forms)
        )
        tightened = self.search.problem.tightened
        self.keep(Saved(self.number, self.search.steps, self.ending, tightened, forms, best))

    def _told(self, line: str) -> None:
        """Tell of a step, which is kept first."""
        self._keep()
        self.tell(line)

    def so_far(self, start: str) -> Found:
        """Return the best so far of a search that was interrupted."""
        self.ending = "interrupted"
        self._judged(start, self.search.state.outlines, self.search.meshed)
        assert self.best is not None
        return self.best

    def _judged(self, start: str, *tried: Outlines) -> Found:
        """Return what finer meshes say of the first outlines that can be meshed."""
        scene = self.search.problem.scene
        for outlines in tried:  # sides that all but touch cannot
            parts = self.search.problem.parts_of(outlines)
            with suppress(ConvergenceError, InputError):
                column = _judged(scene, parts)
                break
        else:
            raise ConvergenceError("no parts of this search can be simulated")
        steps, value, limits = self.search.steps, column.objective, column.limits
        result = Found(start, parts, steps, value, limits, self.ending)
        if self.best is None or _rank(scene, result) < _rank(scene, self.best):
            self.best, self.forms = result, outlines
        return result

    def _repair(self, start: str, limits: tuple[Limit, ...]) -> None:
        """Take a few more steps, which meet limits that are tighter by what is missed.

        They are judged one by one: with all three a rod was 3 % further than its stress asks.
        """
        missed = [limit for limit in limits if not limit.met]
        self.tell("tightened by what finer meshes show: " + ", ".join(item.name for item in missed))
        search = self.search
        self.search = Search(search.problem.tighter(missed), search.state, search.steps)

        def met() -> bool:
            result = self._judged(start, self.search.state.outlines, self.search.meshed)
            return all(limit.met for limit in result.limits)

        self.search.restore(self._told, met)


def _restored(outlines: Outlines, forms: Forms) -> dict[int, FreeSides]:
    """Return what outlines had become, by what was kept of them."""
    return {k: replace(outlines[k], sides=sides) for k, sides in forms.items()}
