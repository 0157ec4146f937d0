"""`[[arms.regions]]`."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from dolfinopt.scene.tables.base import Length, Position, Refusal, Table

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

    def covers(self, x: Any, y: Any) -> Any:
        """Return whether points are in the region, with a `BORDER` around it.

        Args:
            x, y: numbers or arrays, m.
        """
        if self.box is not None:
            x0, y0, x1, y1 = self.box
            dx, dy = BORDER * (x1 - x0), BORDER * (y1 - y0)
            return (x >= x0 - dx) & (x <= x1 + dx) & (y >= y0 - dy) & (y <= y1 + dy)
        assert self.circle is not None
        middle_x, middle_y, radius = self.circle
        return (x - middle_x) ** 2 + (y - middle_y) ** 2 <= (radius * (1.0 + BORDER)) ** 2
