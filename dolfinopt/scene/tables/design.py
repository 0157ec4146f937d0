"""`[design]`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

from pydantic import Field, model_validator

from dolfinopt.scene.tables.base import MAX_ITERATIONS, Loc, Refusal, Table

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

Projection = Literal[False, "heaviside", "robust"]
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
        description="distance of the thresholds of the eroded and dilated designs from 0.5 [-]",
    )
    minimum_member: float = Field(
        default=0.0,
        ge=0,
        le=1e4,
        description="smallest width of members and gaps with the robust projection; sets the "
        "filter radius (filter_radius stays at its default); 0: no limit [m]",
    )

    @property
    def radius(self) -> float:
        """Radius of the cone filter: `filter_radius`, or what `minimum_member` asks for, m.

        Filtered by exp(-|s| / r) / (2 r), a strip of solid of width 2 a has the density
        1 - exp(-a / r) cosh(s / r) within. Its middle reaches the eroded design's threshold
        1/2 + erosion where exp(-a / r) = 1/2 - erosion; the nominal design is then as wide as
        2 r arcosh(1 / (1 - 2 erosion)), and no member that survives the erosion is thinner.
        By symmetry the same holds for gaps and the dilated design. The radius is 2 sqrt(3) r.
        After Wang, Lazarov & Sigmund (2011), doi:10.1007/s00158-010-0602-y, and Trillet, Duysinx &
        Fernandez (2021), doi:10.1007/s00158-021-02998-w, for the Helmholtz filter's kernel.
        """
        if not self.minimum_member:
            return self.filter_radius
        return self.minimum_member * math.sqrt(3.0) / math.acosh(1.0 / (1.0 - 2.0 * self.erosion))

    @model_validator(mode="after")
    def _check_member(self) -> Design:
        if not self.minimum_member:
            return self
        if self.projection != "robust":
            raise Refusal(
                'expected 0, the default, unless design.projection = "robust": the others do not '
                "control the width",
                ("minimum_member",),
                ("projection",),
            )
        default = type(self).model_fields["filter_radius"].default
        if self.filter_radius not in (default, self.radius):
            raise Refusal(
                f"expected {default}, the default, with minimum_member = {self.minimum_member}: "
                f"the radius that gives this width is {self.radius:.6g} [m]",
                ("filter_radius",),
                ("minimum_member",),
            )
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
        width = self.minimum_member
        for i in scene.cell_counts if width else ():
            arm, keys = scene.arms[i], (("design", "minimum_member"), ("arms", i, "height"))
            size = arm.cell_size
            if size is not None and width < MEMBER_CELLS * size * (1.0 - 1e-9):
                raise Refusal(
                    f'expected at least {MEMBER_CELLS} cells of arm "{arm.name}", '
                    f"{MEMBER_CELLS * size:.4g} [m]; choose a wider member or finer cells",
                    *keys,
                )
            if 3.0 * width > arm.height * (1.0 + 1e-9):
                raise Refusal(
                    f'expected at most a third of the height of arm "{arm.name}", '
                    f"{arm.height / 3.0:.4g} [m]: two members and a gap",
                    *keys,
                )

    def _check_volume(self, scene: Scene) -> None:
        limit = self.volume_fraction
        if limit is None:
            return
        flexible = {i: arm for i, arm in enumerate(scene.arms) if arm.flexible}
        shares = {i: arm.passive_share for i, arm in flexible.items()}
        if self.shared_volume:
            volumes = {i: a.length * a.height * a.thickness for i, a in flexible.items()}
            together = sum(shares[i] * volumes[i] for i in shares) / sum(volumes.values())
            shares = dict.fromkeys(shares, together)
        for i, share in shares.items():
            if share + (1.0 - share) * self.minimum > limit:
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
