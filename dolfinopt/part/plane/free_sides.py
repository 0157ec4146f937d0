"""The sides of a part as variables of its optimisation, with their limits and its mesh."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.mesh.solid_cells import Tetrahedra
from dolfinopt.part.domain import SolidDomain
from dolfinopt.part.mesh import BodyMesh, PlateMesh, extruded
from dolfinopt.part.plane.curves import Line, angle_of, left, unit
from dolfinopt.part.plane.limits import Limits, rounded_radii
from dolfinopt.part.plane.part import PlanePart
from dolfinopt.part.plane.sides import (
    BrokenError,
    Loop,
    Side,
    Sides,
)
from dolfinopt.part.plane.simpler import simplifications
from dolfinopt.part.plane.struts import with_struts
from dolfinopt.part.solid.part import SolidPart, plate_part

# Shape of a triangle, 1 where it is equilateral, below which a new mesh is due, and over the worst.
WORN, WORSE = 0.12, 0.7
Mesh = BodyMesh | Tetrahedra  # of a plate in space a `PlateMesh`


@dataclass(frozen=True, eq=False)
class FreeSides:
    """The sides of one plane part, or of a plate in space.

    Attributes:
        part: that it was made of.
        sides: its outline.
        limits: that they keep.
        solid: the arm in space of a plate; None in the plane.
        repeated: (n, count) of q by the variables of the arm whose design this one repeats; None:
            it has its own.
    """

    part: PlanePart
    sides: Sides
    limits: Limits
    solid: SolidDomain | None = None
    repeated: np.ndarray | None = None

    @property
    def cell(self) -> float:
        """Size of the design's cells, m."""
        return self.limits.cell

    @property
    def count(self) -> int:
        """Number of variables."""
        return self.sides.count

    @cached_property
    def plane(self) -> PlanePart:
        """The part in the plane with these sides."""
        return replace(self.part, sides=self.sides)

    @property
    def current(self) -> PlanePart | SolidPart:
        """The part with these sides."""
        return self.plane if self.solid is None else plate_part(self.solid, self.plane)

    def drawn(self) -> FreeSides:
        """Return it with radii of whole half millimetres, if they are asked for."""
        if not self.part.rounds:
            return self
        return replace(self, sides=rounded_radii(self.sides, self.limits))

    def simpler(self) -> list[FreeSides]:
        """Return it without what its limits hold at its least, every one without a thing more."""
        result = [self]
        while True:
            last = result[-1]
            for sides in simplifications(last.sides, self.limits, self.part.domain.outer_edges):
                near = replace(last, sides=sides).nearest()
                if near and 0 < near[0].count < last.count:
                    result.append(near[0])
                    break
            else:
                return result[1:]

    def tied(self) -> FreeSides:
        """Return it with the sides of all struts tied, if there are more of them than before."""
        with suppress(BrokenError):
            near = replace(self, sides=with_struts(self.sides)).nearest()
            if near and near[0].count < self.count:
                return near[0]
        return self

    def moved(self, x: np.ndarray) -> FreeSides:
        """Return it after a step x.

        Raises:
            BrokenError: its sides do not close.
        """
        return replace(self, sides=self.sides.moved(self.sides.ties @ x))

    def nearest(self) -> tuple[FreeSides, np.ndarray] | None:
        """Return the nearest one that keeps the limits, and the step to it; None: there is none."""
        result = self.limits.nearest(self.sides)
        return None if result is None else (replace(self, sides=result[0]), result[1])

    def meshed(self, finer: Sequence[np.ndarray]) -> Mesh:
        """Return a new mesh of it, see `PlanePart.mesh`."""
        return self.current.mesh(finer=finer)

    def followed(self, mesh: Mesh) -> Mesh | None:
        """Return a mesh of sides nearby, moved to these; None where its triangles are spoilt."""
        if isinstance(mesh, PlateMesh):
            face = self.followed(mesh.face)
            if not isinstance(face, BodyMesh):
                return None
            return replace(extruded(face, mesh.thickness, mesh.layers), further=mesh.further)
        assert isinstance(mesh, BodyMesh)
        if len(mesh.shape.pieces) != len(self.sides.shape.pieces):
            return None
        result = mesh.morphed(self.sides.shape)
        least = min(WORN, WORSE * mesh.quality.min())
        return None if result.quality.min() < least else result

    def by_x(self, mesh: Mesh, by_nodes: np.ndarray) -> np.ndarray:
        """Return derivatives (m, count) by x from those (m, n, d) by the nodes of its mesh."""
        if isinstance(mesh, PlateMesh):
            flat = np.array([mesh.at_face(row) for row in by_nodes])
            return self.by_x(mesh.face, flat)
        assert isinstance(mesh, BodyMesh)
        g = mesh.at_outline(by_nodes)
        result = np.zeros((len(g), self.sides.numbers[0]))
        for number, item in enumerate(self.sides.placed):
            here = np.flatnonzero(mesh.piece == number)
            result += item.pull(mesh.span[here, 0], g[:, here], len(here))
        return result @ (self.sides.ties if self.repeated is None else self.repeated)

    def scaled(self, part: PlanePart, factors: np.ndarray) -> FreeSides:
        """Return the sides of a part that repeats this one's design, stretched by (2,) factors.

        Raises:
            InputError: circles would become ellipses, or the arm is a solid.
        """
        own = [side.curve for loop in self.sides.loops for side in loop.sides]
        curves = [*own, *(piece.curve for ring in self.sides.fixed for piece in ring)]
        if self.solid is not None or not all(c is None or isinstance(c, Line) for c in curves):
            raise InputError(
                f"--optimize: arm {part.name!r} repeats a design with circles, or of a solid "
                "(arms.design), which it would stretch; leave --optimize out"
            )
        ratio = np.ones(self.sides.numbers[0])
        loops = []
        for i, loop in enumerate(self.sides.loops):
            sides = []
            for k, side in enumerate(loop.sides):
                image = _stretched(side, factors)
                sides.append(image)
                if (at := self.sides.numbers[1].get((i, k))) is not None:
                    along = factors * unit(side.angle)
                    out = factors * -left(unit(side.angle))
                    ratio[at] = out @ -left(unit(image.angle))
                    ratio[at + 1] = factors.prod() / (along @ along)
            corners = [replace(c, place=c.place * factors) for c in loop.corners]
            loops.append(Loop(tuple(sides), tuple(corners)))
        circles = tuple(replace(c, centre=c.centre * factors) for c in self.sides.circles)
        for k in range(len(circles)):
            at = self.sides.of_circles + 3 * k
            ratio[at : at + 2] = factors
        # Not centred: its sides turn about the images of the other's middles.
        image = replace(self.sides, loops=tuple(loops), circles=circles)
        return replace(self, part=part, sides=image, repeated=ratio[:, None] * self.sides.ties)


def _stretched(side: Side, factors: np.ndarray) -> Side:
    """Return a straight side stretched by (2,) factors."""
    if side.curve is None:
        angle = angle_of(factors * unit(side.angle))
        return replace(side, point=side.point * factors, angle=angle)
    assert isinstance(side.curve, Line)
    curve = Line(side.curve.start * factors, side.curve.end * factors)
    return replace(side, point=side.point * factors, curve=curve)
