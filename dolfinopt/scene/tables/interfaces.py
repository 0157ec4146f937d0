"""`[[arms.interfaces]]` and bores: where joints, forces and the payload sit on an arm in space."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

from pydantic import AfterValidator, Field, field_validator

from dolfinopt.scene.tables.base import Length, Loc, Position, Refusal, Table, shown

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene
    from dolfinopt.scene.tables.arms import Arm

INBOARD, OUTBOARD = "inboard", "outboard"
Point = tuple[Position, Position, Position]
Vector = tuple[float, float, float]


def _check_name(name: str) -> str:
    """Return `name` if it can name a group of faces besides those of the arm's ends."""
    if not name.strip() or len(name) > 64 or not name.isprintable():
        raise Refusal("expected 1 to 64 printable characters")
    if name.strip().casefold() in (INBOARD, OUTBOARD):
        raise Refusal(f'expected another name: "{INBOARD}" and "{OUTBOARD}" are the arm\'s ends')
    return name


class Interface(Table):
    """A rigid part of an arm's surface besides its outboard interface."""

    name: Annotated[str, AfterValidator(_check_name)] = Field(
        description="unique name of the arm's interface, also that of its faces in a mesh file and "
        "of its node in a SID file [-]"
    )
    point: Point = Field(
        description="its reference point in the arm's frame; with arms.inboard_bore in the mesh "
        "file's [m]"
    )
    radius: Length | None = Field(
        default=None,
        description="of an arm made of cells: the sides of cells on its surface whose middle is "
        "at most so far from the point are the interface; with axis, of the bore [m]",
    )
    axis: Vector | None = Field(
        default=None,
        description="of an arm with a mesh file: the interface is the bore of this radius about "
        "the line through the point along this direction, of any length, in the point's frame [-]",
    )

    @field_validator("axis")
    @classmethod
    def _check_axis(cls, axis: Vector | None) -> Vector | None:
        return axis if axis is None else check_direction(axis)


def interface_number(arm: Arm, name: str) -> int | None:
    """Return 0 for the outboard interface, 1 ... for `arms.interfaces`; None for another name."""
    names = [OUTBOARD, *(one.name.casefold() for one in arm.interfaces)]
    return names.index(name.casefold()) if name.casefold() in names else None


def refuse_unknown(arm: Arm, name: str, at: Loc) -> None:
    """Refuse a name that none of an arm's interfaces has."""
    if interface_number(arm, name) is None:
        allowed = " | ".join(shown(one) for one in (OUTBOARD, *(x.name for x in arm.interfaces)))
        raise Refusal(f"expected the name of an interface of {arm.name}: {allowed}", at)


def check_interfaces(scene: Scene, index: int) -> None:
    """Refuse interfaces that an arm cannot have, or on which nothing sits."""
    arm, at = scene.arms[index], ("arms", index)
    if not arm.interfaces:
        return
    if not scene.is_spatial:
        raise Refusal(
            "expected none without [[joints]]: an arm in the plane carries the next one at its end",
            (*at, "interfaces"),
        )
    if arm.pattern is not None:
        raise Refusal("expected none with pattern", (*at, "interfaces"), (*at, "pattern"))
    celled = arm.flexible and arm.cells is not None
    known = [one.name.casefold() for one in arm.interfaces]
    for k, one in enumerate(arm.interfaces):
        here = (*at, "interfaces", k)
        if one.name.casefold() in known[:k]:
            raise Refusal("expected a name that no other interface of the arm has", (*here, "name"))
        if one.axis is not None and (arm.mesh is None or not arm.flexible):
            raise Refusal("expected only with a mesh file, whose bore it is", (*here, "axis"))
        if (one.radius is None) == (celled or one.axis is not None):
            made = "a rigid arm" if arm.rigid else "an arm made of cells"
            if arm.sid is not None:
                made = f'a body from a file, which has a node "{one.name}"'
            elif not arm.rigid and arm.cells is None:
                made = f'a mesh file, which has faces in a group "{one.name}"'
            if one.axis is not None:
                made = "the axis of a bore"
            expected = "a number > 0 [m]" if one.radius is None else "none"
            raise Refusal(f"expected {expected} with {made}", (*here, "radius"))


def check_used(scene: Scene) -> None:
    """Refuse interfaces on which nothing sits; those of arms of one design are the same."""
    for index, arm in enumerate(scene.arms):
        if arm.design is not None:
            continue
        sharing = [index, *(k for k, one in enumerate(scene.arms) if one.design == arm.name)]
        for number, one in enumerate(arm.interfaces, start=1):
            if not scene.used_interfaces & {(k, number) for k in sharing}:
                raise Refusal(
                    f'expected a joint with parent_interface = "{one.name}", one of [[closures]], '
                    "the payload or one of [[forces]] there: nothing sits on it",
                    ("arms", index, "interfaces", number - 1, "name"),
                    ("joints",),
                )


# -- interfaces by their bores, and the arm's frame in the mesh file that they give ---------------

# By how much, relative, the distance of the bores may differ from the arm's length.
SAME_LENGTH = 1e-3
ALONG = 1e-3  # sine of the angle from an axis to the arm's, below which they are parallel


def check_direction(axis: Vector) -> Vector:
    """Return a direction unless it has no length."""
    if math.hypot(*axis) < 1e-9:
        raise Refusal("expected a direction, not of length zero")
    return axis


class Bore(Table):
    """The bore that is an interface of an arm with a mesh file, in the file's frame."""

    point: Point = Field(description="the middle of the bore on its axis, in the file's frame [m]")
    axis: Vector = Field(
        description="direction of its axis, of any length, in the file's frame [-]"
    )
    radius: Length = Field(description="its radius [m]")

    @field_validator("axis")
    @classmethod
    def _check_axis(cls, axis: Vector) -> Vector:
        return check_direction(axis)


def check_bores(arm: Arm) -> None:
    """Refuse bores that an arm cannot have, or that are not its length apart.

    Raises:
        Refusal: its keys are paths from the arm.
    """
    bores = {key: getattr(arm, key) for key in ("inboard_bore", "outboard_bore")}
    stated = [key for key, bore in bores.items() if bore is not None]
    if arm.mesh is None or not arm.is_solid:
        used = [*stated, *["mesh_scale"] * (arm.mesh_scale != 1.0)]
        if used:
            raise Refusal("expected only with the mesh file of a solid arm", (used[0],), ("mesh",))
        return
    if len(stated) == 1:
        (other,) = set(bores) - set(stated)
        raise Refusal(f"expected {other} with it: both place the arm's frame", (stated[0],))
    if stated:
        apart = math.dist(arm.inboard_bore.point, arm.outboard_bore.point)  # type: ignore[union-attr]
        if abs(apart - arm.length) > SAME_LENGTH * arm.length:
            raise Refusal(
                f"expected {apart:.6g} [m], the distance of the points of inboard_bore and "
                "outboard_bore",
                ("length",),
                ("outboard_bore",),
            )


def frame_of(arm: Arm) -> tuple[Vector, tuple[Vector, Vector, Vector]] | None:
    """Return origin and axes x, y, z of the arm's frame in its mesh file's; None: they are one.

    The origin is the inboard bore's point, x leads to the outboard one's, and z is the inboard
    bore's axis, as far as it is normal to x. Where it is along x, z is that of the file's axes
    which is normal to it best, as far as it is normal to x.
    """
    if arm.inboard_bore is None or arm.outboard_bore is None:
        return None
    o = arm.inboard_bore.point
    x = _unit(tuple(b - a for a, b in zip(o, arm.outboard_bore.point)))
    z = _unit(arm.inboard_bore.axis)
    if math.hypot(*_cross(x, z)) < ALONG:
        best = min((2, 1, 0), key=lambda k: abs(x[k]))
        z = (float(best == 0), float(best == 1), float(best == 2))
    along = _dot(x, z)
    z = _unit(tuple(b - along * a for a, b in zip(x, z)))
    return o, (x, _cross(z, x), z)


def in_frame(arm: Arm, point: Point) -> Point:
    """Return a point of the mesh file's frame in the arm's, m."""
    if (frame := frame_of(arm)) is None:
        return point
    origin, axes = frame
    apart = tuple(b - a for a, b in zip(origin, point))
    x, y, z = (_dot(axis, apart) for axis in axes)
    return x, y, z


def _dot(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _unit(a: tuple[float, ...]) -> Vector:
    x, y, z = (value / math.hypot(*a) for value in a)
    return x, y, z
