"""Polishing: a few steps of shape optimisation of the parts' splines, at constant area.

Where the free outline moves outwards by s, the objective changes by int g s ds. On the mesh along
the curves that is its derivative by the places of the nodes, of the discrete model
(`shape_gradient`). At the optimum g is the same all around; a step goes along -(g - mean g),
smoothed, and a small offset gives the area back. A step counts only if the machine, simulated
anew, is better.
Source: Allaire, Jouve & Toader (2004), doi:10.1016/j.jcp.2003.09.032; smoothing: de Gournay (2006),
doi:10.1137/050624108.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.mesh.gmsh_session import gmsh_on_root
from dolfinopt.part.body_mesh import BodyMesh
from dolfinopt.part.forms import Simulated, simulate_bodies
from dolfinopt.part.mesh import COARSER, Meshes, body_mesh, mesh_parts
from dolfinopt.part.moves import OutlineMoves
from dolfinopt.part.part import Part
from dolfinopt.part.shape import Shape
from dolfinopt.part.shape_gradient import by_outline
from dolfinopt.part.widths import thinnest_member
from dolfinopt.responses.constraints import EXCESS, limits_of
from dolfinopt.responses.response import objective_of
from dolfinopt.scene.load import Scene

MOVE = 0.1  # of the outline in the first step, cells of the design
SPIKE = 2.0  # largest move over that of nine of ten
HALVINGS = 3  # of a step that does not pay
GROWTH = 1.5  # of the next step after one that does
WORTH = 0.01  # relative gain below which the part stays as it was


@dataclass(frozen=True, eq=False)
class Polished:
    """What polishing brought.

    Attributes:
        parts, meshes: polished, or as they were where it was not worth it.
        steps: that made the objective better.
        before, after: the objective.
        farthest: largest move of the outline, m.
        kept: whether the parts are polished.
    """

    parts: dict[int, Part]
    meshes: Meshes
    steps: int
    before: float
    after: float
    farthest: float
    kept: bool

    @property
    def gain(self) -> float:
        """Relative."""
        return 1.0 - self.after / self.before if self.before else 0.0

    @property
    def sentence(self) -> str:
        """What it brought, in one line."""
        words = "1 step makes" if self.steps == 1 else f"{self.steps} steps make"
        found = (
            f"polishing: {words} the objective {100.0 * self.gain:.2g} % better, "
            f"the outline moves by {1e3 * self.farthest:.2g} mm at most"
        )
        if self.kept:
            return found
        return f"{found}: less than {100.0 * WORTH:g} %, left out"

    def to_dict(self) -> dict[str, Any]:
        """Return its entry of part.json."""
        names = ("steps", "before", "after", "gain", "farthest", "kept")
        return {name: getattr(self, name) for name in names}


def polish(scene: Scene, parts: Mapping[int, Part], meshes: Meshes, steps: int) -> Polished:
    """Move the splines' control points for a better objective, on this rank alone.

    Lines, arcs, interfaces, bores and corners stay; ends that are tangent to them stay so. A
    symmetric arm stays symmetric. Limits of the scene that are met stay met.

    Args:
        scene: of the run.
        parts: by their place in the chain.
        meshes: of them.
        steps: at most.

    Raises:
        InputError: the objective is the mass, which the area keeps; curves are arcs.
    """
    if objective_of(scene).name == "mass":
        raise InputError(
            '--polish: objective.kind = "mass": expected another one, polishing keeps the area'
        )
    outlines = {k: OutlineMoves.of(part) for k, part in parts.items()}
    now, bodies = dict(parts), dict(meshes.coarse)
    state, value, excess = _evaluated(scene, now, bodies)
    first, taken, length = value, 0, MOVE
    for _ in range(steps):
        moves = _directions(scene, state, now, bodies, outlines)
        found = None
        for _ in range(HALVINGS + 1):
            found = _tried(scene, now, bodies, outlines, moves, length)
            if found is not None and found.value < value and found.excess <= max(excess, EXCESS):
                break
            found, length = None, 0.5 * length
        if found is None:
            break
        now, bodies, state = found.parts, found.meshes, found.state
        value, excess, taken = found.value, found.excess, taken + 1
        length = min(GROWTH * length, 2.0 * MOVE)
    farthest = max(_moved(parts[k].shape, now[k].shape) for k in parts)
    kept = bool(first - value >= WORTH * abs(first)) and taken > 0
    if not kept:
        return Polished(dict(parts), meshes, taken, first, value, farthest, False)
    done = {k: _measured(part) for k, part in now.items()}
    return Polished(done, mesh_parts(done), taken, first, value, farthest, True)


def _measured(part: Part) -> Part:
    """Return a polished part with the polygon of its own curves, and what is measured of it."""
    import shapely

    outer, *holes = part.shape.polygons(part.outline.chord)
    outline = replace(part.outline, polygon=shapely.Polygon(outer, holes))
    return replace(part, outline=outline, thinnest=thinnest_member(outline))


@dataclass(frozen=True, eq=False)
class _Trial:
    parts: dict[int, Part]
    meshes: dict[int, BodyMesh]
    state: Simulated
    value: float
    excess: float


def _evaluated(
    scene: Scene, parts: Mapping[int, Part], meshes: Mapping[int, BodyMesh]
) -> tuple[Simulated, float, float]:
    """Return the simulated machine, its objective, least best, and the worst limit's excess."""
    state = simulate_bodies(scene, parts, meshes, objective=_exact(scene))
    limits = [
        one for one in limits_of(state.scene, state.evaluation) if one.quantity != "volume_fraction"
    ]
    sign = -1.0 if objective_of(state.scene).turned else 1.0
    worst = max((one.excess for one in limits), default=0.0)
    return state, sign * state.evaluation.objective, worst


def _exact(scene: Scene) -> dict[str, Any]:
    return {"gradient": "exact"}


def _tried(
    scene: Scene,
    parts: Mapping[int, Part],
    meshes: Mapping[int, BodyMesh],
    outlines: Mapping[int, OutlineMoves],
    moves: Mapping[int, np.ndarray],
    length: float,
) -> _Trial | None:
    """Return what a step of a length, cells, leads to; None where its shapes cannot be parts."""
    moved = {}
    for k, part in parts.items():
        shape = outlines[k].stepped(part, length * part.domain.cell * moves[k])
        if shape is None:
            return None
        moved[k] = replace(part, shape=shape)
    try:
        bodies = {k: _followed(meshes[k], part) for k, part in moved.items()}
        return _Trial(moved, bodies, *_evaluated(scene, moved, bodies))
    except ConvergenceError:
        return None


def _followed(mesh: BodyMesh, part: Part) -> BodyMesh:
    """Return the mesh of a part whose curves have moved: the same triangles unless some fold."""
    moved = mesh.morphed(part.shape)
    if not moved.is_folded:
        return moved
    with gmsh_on_root(MPI.COMM_SELF) as gmsh:
        return body_mesh(gmsh, part.shape, part.domain.cell, COARSER)


def _moved(before: Shape, after: Shape) -> float:
    """Return the largest move of a point of the outline, m."""
    t = np.linspace(0.0, 1.0, 101)
    pairs = zip(before.curves, after.curves, strict=True)
    return max(float(np.linalg.norm(b.at(t) - a.at(t), axis=1).max()) for a, b in pairs)


# -- the direction of a step -------------------------------------------------------------------


def _directions(
    scene: Scene,
    state: Simulated,
    parts: Mapping[int, Part],
    meshes: Mapping[int, BodyMesh],
    outlines: Mapping[int, OutlineMoves],
) -> dict[int, np.ndarray]:
    """Return the moves of all unknowns of every arm: nine of ten at most 1, none above `SPIKE`."""
    sign = -1.0 if objective_of(state.scene).turned else 1.0
    pulls = {k: sign * pull for k, pull in by_outline(state, meshes).items()}
    found = {k: outlines[k].descent(parts[k].shape, meshes[k], pulls[k]) for k in parts}
    size = float(np.quantile(np.abs(np.concatenate(list(found.values()))), 0.9))
    return {k: np.clip(one / size, -SPIKE, SPIKE) if size else one for k, one in found.items()}
