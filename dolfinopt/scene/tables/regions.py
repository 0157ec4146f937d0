"""`[[arms.regions]]`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, model_validator

from dolfinopt.scene.tables.base import Length, Loc, Position, Refusal, Table

if TYPE_CHECKING:
    from dolfinopt.scene.tables.arms import Arm

RegionKind = Literal["solid", "void"]
# A centroid so near to the border of a region, in sizes of it, counts as inside: whether a cell
# belongs to it must not depend on the mesher's last digits.
BORDER = 1e-6


class Region(Table):
    """A part of an arm that stays solid or void whatever the design."""

    kind: RegionKind = Field(description="what the region stays: solid or void [-]")
    box: tuple[Position, Position, Position, Position] | None = Field(
        default=None,
        description="[x0, y0, x1, y1] in the arm's frame, x along from the inboard joint axis, y "
        "across from the middle [m]",
    )
    circle: tuple[Position, Position, Length] | None = Field(
        default=None, description="[x, y, radius] of a disc in place of box [m]"
    )
    depth: tuple[Position, Position] | None = Field(
        default=None,
        description="[z0, z1] over which it extends in a solid arm, z along the thickness from the "
        "middle; default: through the whole thickness [m]",
    )

    @model_validator(mode="after")
    def _check_shape(self) -> Region:
        if (self.box is None) == (self.circle is None):
            raise Refusal(
                "expected one of box = [x0, y0, x1, y1] and circle = [x, y, radius] "
                f"{'beside' if self.box is None else 'alone, not both, beside'} kind",
                ("kind",),
                *(() if self.box is None else (("box",), ("circle",))),
            )
        if self.box is not None and not (self.box[0] < self.box[2] and self.box[1] < self.box[3]):
            raise Refusal("expected [x0, y0, x1, y1] with x0 < x1 and y0 < y1 [m]", ("box",))
        if self.depth is not None and not self.depth[0] < self.depth[1]:
            raise Refusal("expected [z0, z1] with z0 < z1 [m]", ("depth",))
        return self

    @property
    def shape(self) -> Literal["box", "circle"]:
        """The key that gives the shape."""
        return "circle" if self.box is None else "box"

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Return x0, y0, x1, y1 of the smallest box around the region, m."""
        if self.box is not None:
            return self.box
        assert self.circle is not None
        x, y, radius = self.circle
        return x - radius, y - radius, x + radius, y + radius

    def covers(self, x: Any, y: Any, z: Any = 0.0) -> Any:
        """Return whether points are in the region, with a `BORDER` around it.

        Args:
            x, y: numbers or arrays, m.
            z: alike; what it is matters only with `depth`.
        """
        inside = self._covers_outline(x, y)
        if self.depth is None:
            return inside
        z0, z1 = self.depth
        dz = BORDER * (z1 - z0)
        return inside & (z >= z0 - dz) & (z <= z1 + dz)

    def _covers_outline(self, x: Any, y: Any) -> Any:
        if self.box is not None:
            x0, y0, x1, y1 = self.box
            dx, dy = BORDER * (x1 - x0), BORDER * (y1 - y0)
            return (x >= x0 - dx) & (x <= x1 + dx) & (y >= y0 - dy) & (y <= y1 + dy)
        assert self.circle is not None
        middle_x, middle_y, radius = self.circle
        return (x - middle_x) ** 2 + (y - middle_y) ** 2 <= (radius * (1.0 + BORDER)) ** 2


def check_regions(arm: Arm, at: Loc) -> None:
    """Refuse a region outside a rectangular arm; other things the mesh must tell.

    Args:
        arm: at this place of the scene.
        at: the place.

    Raises:
        Refusal: its keys are paths from the scene.
    """
    if not arm.regions or arm.cells is None:
        return
    for number, region in enumerate(arm.regions):
        _check_place(region, arm, (*at, "regions", number), at)
    from dolfinopt.scene.regions import MOST_CELLS, grid_regions  # NumPy

    problem = grid_regions(arm)[1] if arm.n_cells <= MOST_CELLS else None
    if problem is not None:
        number, reason = problem
        shape = arm.regions[number].shape
        raise Refusal(reason, (*at, "regions", number, shape), (*at, "passive"), (*at, "cells"))


def _check_place(region: Region, arm: Arm, key: Loc, at: Loc) -> None:
    """Refuse a region beside a box, or above or below it."""
    x0, y0, x1, y1 = region.bounds
    half, deep = 0.5 * arm.height, 0.5 * arm.thickness
    if x0 >= arm.length or x1 <= 0.0 or y0 >= half or y1 <= -half:
        raise Refusal(
            f"expected a place in the arm, x from 0 to {arm.length} and y from {-half:g} "
            f"to {half:g} [m]",
            (*key, region.shape),
            (*at, "length"),
            (*at, "height"),
        )
    if region.depth is not None and (region.depth[0] >= deep or region.depth[1] <= -deep):
        raise Refusal(
            f"expected a place in the arm, z from {-deep:g} to {deep:g} [m]",
            (*key, "depth"),
            (*at, "thickness"),
        )
