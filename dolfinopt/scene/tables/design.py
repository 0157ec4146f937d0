"""`[design]`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Literal

from pydantic import Field, model_validator

from dolfinopt.scene.tables.base import MAX_ITERATIONS, Loc, Refusal, Table

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

Projection = Literal[False, "heaviside", "robust"]
# Largest distance of a threshold from 1/2 that is chosen for the wider one of member and gap:
# beyond it the eroded design is hardly there, or the dilated one everywhere.
WIDEST = 0.45
MEMBER_CELLS = 3  # in the width of the thinnest member: with fewer one cell more or less decides


class Design(Table):
    """Design variables x of all cells, their limits and their filter."""

    volume_fraction: float | None = Field(
        default=0.5,
        ge=1e-6,
        le=1,
        description="upper limit of the volume fraction of each arm; where mass is objective or "
        "limited: none unless stated [-]",
    )
    shared_volume: bool = Field(
        default=False, description="one volume limit for all arms together [-]"
    )
    initial: float = Field(default=0.5, ge=1e-6, le=1, description="initial x of every cell [-]")
    minimum: float = Field(default=1e-3, ge=1e-9, lt=1, description="lower bound of x [-]")
    filter_radius: float = Field(
        default=0.0075,
        ge=0,
        le=1e4,
        description="radius of the equivalent cone filter; 0: no filter [m]",
    )
    projection: Projection = Field(
        default=False,
        description="projection after the filter: none, Heaviside, or robust (eroded, nominal "
        "and dilated designs together) [-]",
    )
    sharpness: float = Field(
        default=128.0, ge=1, le=1e4, description="final beta of the projection [-]"
    )
    continuation: int = Field(
        default=25,
        ge=1,
        le=MAX_ITERATIONS,
        description="number of iterations after which beta doubles [-]",
    )
    erosion: float = Field(
        default=0.1,
        ge=1e-3,
        le=0.499,
        description="distance of the thresholds of the eroded and dilated designs from 0.5; with "
        "a member and a gap of two widths that of the thinner one's [-]",
    )
    minimum_member: float = Field(
        default=0.0,
        ge=0,
        le=1e4,
        description="smallest width of members with the robust projection; sets the filter "
        "radius (filter_radius stays at its default); 0: no limit, or minimum_gap [m]",
    )
    minimum_gap: float = Field(
        default=0.0,
        ge=0,
        le=1e4,
        description="smallest width of gaps between members alike; 0: minimum_member [m]",
    )

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
        wider = 0.5 - 0.5 / math.cosh(wide / thin * math.acosh(1.0 / (1.0 - 2.0 * self.erosion)))
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
        return thin * math.sqrt(3.0) / math.acosh(1.0 / (1.0 - 2.0 * self.erosion))

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

    @model_validator(mode="after")
    def _check_widths(self) -> Design:
        if not (stated := self.stated_widths):
            return self
        key = next(iter(stated))
        if self.projection != "robust":
            raise Refusal(
                'expected 0, the default, unless design.projection = "robust": the others do not '
                "control the width",
                (key,),
                ("projection",),
            )
        # The width that `WIDEST` gives, in widths of `erosion`.
        ratio = math.acosh(1.0 / (1.0 - 2.0 * WIDEST)) / math.acosh(
            1.0 / (1.0 - 2.0 * self.erosion)
        )
        thin, wide = min(self.least_widths), max(self.least_widths)
        if wide > max(ratio, 1.0) * thin * (1.0 + 1e-9):
            wider = "minimum_member" if self.minimum_member > self.minimum_gap else "minimum_gap"
            other = "minimum_gap" if wider == "minimum_member" else "minimum_member"
            raise Refusal(
                f"expected at most {ratio * thin:.4g} [m], {ratio:.3g} times {other} = {thin}, "
                f"with erosion = {self.erosion}; lower erosion or widen the other",
                (wider,),
                (other,),
                ("erosion",),
            )
        default = type(self).model_fields["filter_radius"].default
        if self.filter_radius not in (default, self.radius):
            raise Refusal(
                f"expected {default}, the default, with {key} = {stated[key]}: "
                f"the radius that gives this width is {self.radius:.6g} [m]",
                ("filter_radius",),
                (key,),
            )
        return self

    @model_validator(mode="after")
    def _check_unused(self) -> Design:
        projected = self.projection is not False
        self.refuse_unused(projected, "projection", "sharpness", "continuation")
        self.refuse_unused(self.projection == "robust", "projection", "erosion")
        self.refuse_unused(self.volume_fraction is not None, "volume_fraction", "shared_volume")
        return self

    @model_validator(mode="after")
    def _check_minimum(self) -> Design:
        if self.minimum >= self.initial:
            raise Refusal(
                f"expected less than initial = {self.initial} [-]", ("minimum",), ("initial",)
            )
        if self.volume_fraction is not None and self.minimum > self.volume_fraction:
            raise Refusal(
                f"expected at most volume_fraction = {self.volume_fraction} [-]",
                ("minimum",),
                ("volume_fraction",),
            )
        return self

    def check_in_scene(self, scene: Scene, at: Loc) -> None:
        """Refuse what the arms, their cells and their solid ends cannot meet."""
        if not scene.cell_counts:
            raise Refusal(
                "expected at least one arm with a design: none is flexible", ("arms", 0, "rigid")
            )
        self._check_member_width(scene)
        longest = max(arm.length for arm in scene.arms)
        if self.filter_radius > longest:
            raise Refusal(
                f"expected at most the length of the longest arm, {longest} [m]: a wider filter "
                "leaves one density for a whole arm",
                ("design", "filter_radius"),
                *(("arms", i, "length") for i in range(len(scene.arms))),
            )
        self._check_volume(scene)

    def _check_member_width(self, scene: Scene) -> None:
        for i in scene.designed if self.controls_widths else ():
            arm, scale = scene.arms[i], scene.smallest_scale(i)
            height = scale * arm.height
            smallest = f'arm "{arm.name}"' if scale == 1.0 else f'what repeats arm "{arm.name}"'
            if arm.cell_size is not None:  # else known with the mesh, see `Arm`
                for key, reason in self.too_narrow(smallest, scale * arm.cell_size):
                    raise Refusal(reason, ("design", key), ("arms", i, "height"))
            member, gap = self.least_widths
            if 2.0 * member + gap > height * (1.0 + 1e-9):
                reason = (
                    f"expected at most a third of the height of {smallest}, {height / 3.0:.4g} "
                    "[m]: two members and a gap"
                )
                if member != gap:
                    reason = (
                        f"expected two members of {member} [m] and a gap of {gap} [m] within the "
                        f"height of {smallest}, {height:.4g} [m]"
                    )
                keys = [("design", key) for key in self.stated_widths]
                raise Refusal(reason, *keys, ("arms", i, "height"))

    def _check_volume(self, scene: Scene) -> None:
        limit = self.volume_fraction
        if limit is None:
            return
        flexible = {i: arm for i, arm in enumerate(scene.arms) if arm.flexible}
        like = scene.patterns
        shares = {i: scene.arms[like.get(i, i)].fixed_shares for i in flexible}
        if self.shared_volume:
            volumes = {i: a.length * a.height * a.thickness for i, a in flexible.items()}
            whole = sum(volumes.values())
            solid, void = (sum(shares[i][k] * volumes[i] for i in shares) / whole for k in (0, 1))
            shares = dict.fromkeys(shares, (solid, void))
        for i, (share, void) in shares.items():
            if share + (1.0 - share - void) * self.minimum > limit:
                if scene.arms[i].regions:
                    raise Refusal(
                        f"expected regions with which volume_fraction = {limit} can be met: they "
                        f"and the solid ends are {share:.4g} of the volume, with design.minimum = "
                        f"{self.minimum} in the rest; make them smaller or raise the volume "
                        "fraction",
                        ("arms", i, "regions"),
                        ("arms", i, "passive"),
                        ("design", "volume_fraction"),
                    )
                raise Refusal(
                    f"expected a length with which volume_fraction = {limit} can be met: the solid "
                    f"ends are {share:.4g} of the volume, with design.minimum = {self.minimum} "
                    "between them; shorten passive (0: no solid ends) or raise the volume fraction",
                    ("arms", i, "passive"),
                    ("arms", i, "length"),
                    ("arms", i, "cells"),
                    ("design", "volume_fraction"),
                    ("design", "minimum"),
                )
