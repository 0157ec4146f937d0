"""`[part]`: what `dolfinopt part` makes of a result unless its options say otherwise."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from dolfinopt.scene.tables.base import MAX_ITERATIONS, Length, Loc, Refusal, Table

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

MAX_STARTS = 100


class Part(Table):
    """Parts for the workshop."""

    tool_radius: float | None = Field(
        default=None,
        ge=0,
        le=1e4,
        description="least radius of concave corners; default: a fifth of a cell [m]",
    )
    tolerance: Length | None = Field(
        default=None,
        description="largest distance of the curves from the outline; default: 0.1 mm or a tenth "
        "of a cell, the smaller [m]",
    )
    minimum_member: Length | None = Field(
        default=None,
        description="smallest width of members of a part; default: design.minimum_member [m]",
    )
    curves: Literal["splines", "arcs"] = Field(
        default="splines", description="free curves: splines, or lines and arcs alone [-]"
    )
    simplify: bool = Field(
        default=False,
        description="straight lines and fillets in place of splines, sides of struts parallel [-]",
    )
    optimize: bool = Field(
        default=False,
        description="optimise the parts' free curves, too: the scene's objective within its limits "
        "[-]",
    )
    iterations: int = Field(
        default=80,
        ge=1,
        le=MAX_ITERATIONS,
        description="largest number of steps of the curves from every start [-]",
    )
    starts: int = Field(
        default=0,
        ge=0,
        le=MAX_STARTS,
        description="trusses that the curves start from besides the result of the densities [-]",
    )

    def check_in_scene(self, scene: Scene, at: Loc) -> None:
        """Refuse to optimise lines and arcs."""
        if self.optimize and self.curves == "arcs":
            raise Refusal(
                'expected "splines" with part.optimize = true, which moves their control points',
                (*at, "curves"),
                (*at, "optimize"),
            )
