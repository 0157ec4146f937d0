"""`[design]`, `[[arms.regions]]`, `[interpolation]`, `[optimizer]` and `[part]`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from dolfinopt.scene.tables.base import (
    MAX_ITERATIONS,
    Extent,
    Length,
    Position,
    Refusal,
    Table,
)

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

Projection = Literal[False, "heaviside", "robust", "robust-eroded"]
# Largest distance of a threshold from 1/2 that is chosen for the wider one of member and gap:
# beyond it the eroded design is hardly there, or the dilated one everywhere.
WIDEST = 0.45
MEMBER_CELLS = 3  # in the width of the thinnest member: with fewer one cell more or less decides


def _width(erosion: float) -> float:
    """Return the width of a member that the erosion leaves, over 2 r, see `Design.radius`."""
    return math.acosh(1.0 / (1.0 - 2.0 * erosion))


class Design(Table):
    """Design variables x of all cells, their limits and their filter."""

    volume_fraction: float | None = Field(default=0.5, ge=1e-6, le=1)
    shared_volume: bool = False
    initial: float = Field(default=0.5, ge=1e-6, le=1)
    minimum: float = Field(default=1e-3, ge=1e-9, lt=1)
    filter_radius: Extent = 0.0075
    projection: Projection = False
    sharpness: float = Field(default=16.0, ge=1, le=1e4)
    continuation: int = Field(default=25, ge=1, le=MAX_ITERATIONS)
    erosion: float = Field(default=0.1, ge=1e-3, le=0.499)
    minimum_member: Extent = 0.0
    minimum_gap: Extent = 0.0

    @property
    def is_robust(self) -> bool:
        """Whether an eroded, a nominal and a dilated design are optimised together."""
        return self.projection in ("robust", "robust-eroded")

    @property
    def limits_nominal(self) -> bool:
        """Whether limits hold for the nominal design alone."""
        return self.projection != "robust-eroded"

    @property
    def controls_widths(self) -> bool:
        """Whether members and gaps have a least width."""
        return max(self.minimum_member, self.minimum_gap) > 0.0

    @property
    def least_widths(self) -> tuple[float, float]:
        """Least widths of members and of gaps, m; one that is not stated is the other's."""
        return self.minimum_member or self.minimum_gap, self.minimum_gap or self.minimum_member

    @property
    def erosions(self) -> tuple[float, float]:
        """Distances from 1/2 of the thresholds of the eroded and of the dilated design.

        Both are `erosion` where members and gaps may be equally thin. Else that is the thinner
        one's, and the other's is what gives its width with the same filter, see `radius`.
        """
        member, gap = self.least_widths
        if member == gap:
            return self.erosion, self.erosion
        thin, wide = min(member, gap), max(member, gap)
        wider = 0.5 - 0.5 / math.cosh(wide / thin * _width(self.erosion))
        return (self.erosion, wider) if member < gap else (wider, self.erosion)

    @property
    def is_solid(self) -> bool:
        """Whether arms are solid from the start, and may stay so: as those of parts."""
        return self.initial == 1.0 and self.volume_fraction == 1.0

    @property
    def radius(self) -> float:
        """Radius of the cone filter: `filter_radius`, or what the least widths ask for, m.

        Filtered by exp(-|s| / r) / (2 r), a strip of solid of width 2 a has the density
        1 - exp(-a / r) cosh(s / r) within. Its middle reaches the eroded design's threshold
        1/2 + erosion where exp(-a / r) = 1/2 - erosion; the nominal design is then as wide as
        2 r arcosh(1 / (1 - 2 erosion)), and no member that survives the erosion is thinner.
        By symmetry the same holds for gaps and the dilated design, with its own distance from 1/2
        if gaps are to have another width. The radius is 2 sqrt(3) r.
        After Wang, Lazarov & Sigmund (2011), doi:10.1007/s00158-010-0602-y, and Trillet, Duysinx &
        Fernandez (2021), doi:10.1007/s00158-021-02998-w, for the Helmholtz filter's kernel.
        """
        if not self.controls_widths:
            return self.filter_radius
        thin = min(self.least_widths)
        return thin * math.sqrt(3.0) / _width(self.erosion)

    @property
    def stated_widths(self) -> dict[str, float]:
        """Least widths that the scene states, m, by their keys."""
        keys = ("minimum_member", "minimum_gap")
        return {key: getattr(self, key) for key in keys if getattr(self, key)}

    def too_narrow(self, where: str, size: float) -> Iterator[tuple[str, str]]:
        """Yield every stated width with too few cells of `size`, m, and what is expected."""
        least = MEMBER_CELLS * size
        for key, width in self.stated_widths.items():
            if width < least * (1.0 - 1e-9):
                what = key.removeprefix("minimum_")
                yield (
                    key,
                    f"expected at least {MEMBER_CELLS} cells of {where}, {least:.4g} [m]; choose a "
                    f"wider {what} or finer cells",
                )

    def _check_widths(self) -> None:
        if not (stated := self.stated_widths):
            return
        key = next(iter(stated))
        # The width that `WIDEST` gives, in widths of `erosion`.
        ratio = _width(WIDEST) / _width(self.erosion)
        thin, wide = min(self.least_widths), max(self.least_widths)
        if wide > max(ratio, 1.0) * thin * (1.0 + 1e-9):
            other, wider = sorted(("minimum_gap", "minimum_member"), key=vars(self).__getitem__)
            raise Refusal(
                f"expected at most {ratio * thin:.4g} [m], {ratio:.3g} times {other} = {thin}, "
                f"with erosion = {self.erosion}; lower erosion or widen the other",
                wider,
                other,
                "erosion",
            )
        default = type(self).model_fields["filter_radius"].default
        if self.filter_radius not in (default, self.radius):
            raise Refusal(
                f"expected {default}, the default, with {key} = {stated[key]}: "
                f"the radius that gives this width is {self.radius:.6g} [m]",
                "filter_radius",
                key,
            )

    def check_table(self) -> None:
        """Refuse widths that one filter cannot give, and a least density above others."""
        self._check_widths()
        if self.minimum >= self.initial:
            raise Refusal(f"expected less than initial = {self.initial} [-]", "minimum", "initial")
        if self.volume_fraction is not None and self.minimum > self.volume_fraction:
            raise Refusal(
                f"expected at most volume_fraction = {self.volume_fraction} [-]",
                "minimum",
                "volume_fraction",
            )

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse what the arms, their cells and their solid ends cannot meet."""
        if scene.cell_counts:  # there is something to design
            self._check_hollow(scene)
            self._check_member_width(scene)

    def _check_hollow(self, scene: Scene) -> None:
        """Refuse what walls have no use for."""
        hollow = [i for i in scene.designed if scene.arms[i].hollow]
        if not hollow:
            return
        at = f"arms.{hollow[0]}.hollow"
        self.refuse_stated(".projection", "with a hollow arm: a wall may have any thickness", at)
        if len(hollow) < len(scene.designed):
            return
        for key in type(scene.interpolation).model_fields:
            reason = "where all arms are hollow: cells are solid"
            scene.interpolation.refuse_stated(f"interpolation.{key}", reason, at)
        reason = "where all arms are hollow: arms.wall is the initial thickness"
        self.refuse_stated(".initial", reason, at)

    def _check_member_width(self, scene: Scene) -> None:
        for i in scene.designed if self.controls_widths else ():
            arm, scale = scene.arms[i], scene.smallest_scale(i)
            height = scale * arm.height
            smallest = f'arm "{arm.name}"' if scale == 1.0 else f'what repeats arm "{arm.name}"'
            if arm.cell_size is not None:  # else known with the mesh, see `Arm`
                for key, reason in self.too_narrow(smallest, scale * arm.cell_size):
                    raise Refusal(reason, f"design.{key}", f"arms.{i}.height")
            member, gap = self.least_widths
            if 2.0 * member + gap > height * (1.0 + 1e-9):
                raise Refusal(
                    f"expected two members of {member:.4g} [m] and a gap of {gap:.4g} [m] within "
                    f"the height of {smallest}, {height:.4g} [m]",
                    *(f".{key}" for key in self.stated_widths),
                    f"arms.{i}.height",
                )


# -- `[[arms.regions]]` --------------------------------------------------------------------------

RegionKind = Literal["solid", "void"]
# A centroid so near to the border of a region, in sizes of it, counts as inside: whether a cell
# belongs to it must not depend on the mesher's last digits.
BORDER = 1e-6


def _lies_within(x: Any, low: float, high: float) -> Any:
    """Return whether numbers lie from `low` to `high`, with a `BORDER` around it."""
    border = BORDER * (high - low)
    return (x >= low - border) & (x <= high + border)


class Region(Table):
    """A part of an arm that stays solid or void whatever the design."""

    kind: RegionKind
    box: tuple[Position, Position, Position, Position] | None = None
    circle: tuple[Position, Position, Length] | None = None
    depth: tuple[Position, Position] | None = None

    def check_table(self) -> None:
        if (self.box is None) == (self.circle is None):
            raise Refusal(
                "expected one of box = [x0, y0, x1, y1] and circle = [x, y, radius] beside kind, "
                "not both",
                "kind",
                "box",
                "circle",
            )
        if self.box is not None and not (self.box[0] < self.box[2] and self.box[1] < self.box[3]):
            raise Refusal("expected [x0, y0, x1, y1] with x0 < x1 and y0 < y1 [m]", "box")
        if self.depth is not None and not self.depth[0] < self.depth[1]:
            raise Refusal("expected [z0, z1] with z0 < z1 [m]", "depth")

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
        x0, y0, x1, y1 = self.bounds
        inside = _lies_within(x, x0, x1) & _lies_within(y, y0, y1)
        if self.circle is not None:
            middle_x, middle_y, radius = self.circle
            far = (x - middle_x) ** 2 + (y - middle_y) ** 2
            inside = far <= (radius * (1.0 + BORDER)) ** 2
        return inside if self.depth is None else inside & _lies_within(z, *self.depth)


# -- `[interpolation]` ---------------------------------------------------------------------------

Law = Literal["two-material", "simp", "pedersen", "du-olhoff", "ramp"]


class Interpolation(Table):
    """How stiffness and mass follow from the design variable x of a cell."""

    law: Law = "two-material"
    penalty: float = Field(default=3.0, ge=1, le=20)
    floor: float = Field(default=1e-6, ge=1e-12, lt=1)


# -- `[optimizer]` -------------------------------------------------------------------------------


class Optimizer(Table):
    """When the optimiser stops and how far it moves at once."""

    max_iterations: int = Field(default=1000, ge=0, le=MAX_ITERATIONS)
    move: float = Field(default=0.2, ge=1e-6, le=1)
    tolerance: float = Field(default=1e-3, ge=0, le=1)
    kkt_tolerance: float = Field(default=2e-2, ge=0, le=1e6)


# -- [part]: what `dolfinopt part` makes of a result, unless its options say otherwise ----------


STEPS = 80  # of the curves, unless stated


class Part(Table):
    """Parts for the workshop."""

    tool_radius: Extent | None = None
    tolerance: Length | None = None
    minimum_member: Length | None = None
    optimize: bool | Annotated[int, Field(ge=1, le=MAX_ITERATIONS)] = False
    starts: int = Field(default=0, ge=0, le=100)

    @property
    def iterations(self) -> int:
        """Largest number of steps of the curves from every start."""
        return STEPS if isinstance(self.optimize, bool) else self.optimize
