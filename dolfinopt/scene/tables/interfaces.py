"""`[[arms.interfaces]]`: where further joints or the payload sit on an arm in space."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import AfterValidator, Field

from dolfinopt.scene.spelling import shown
from dolfinopt.scene.tables.base import Length, Loc, Position, Refusal, Table

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene
    from dolfinopt.scene.tables.arms import Arm

INBOARD, OUTBOARD = "inboard", "outboard"


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
    point: tuple[Position, Position, Position] = Field(
        description="its reference point in the arm's frame [m]"
    )
    radius: Length | None = Field(
        default=None,
        description="of an arm made of cells: the sides of cells on its surface whose middle is "
        "at most so far from the point are the interface [m]",
    )


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
    meshed = arm.flexible and arm.cells is not None
    known = [one.name.casefold() for one in arm.interfaces]
    for k, one in enumerate(arm.interfaces):
        here = (*at, "interfaces", k)
        if one.name.casefold() in known[:k]:
            raise Refusal("expected a name that no other interface of the arm has", (*here, "name"))
        if (one.radius is None) == meshed:
            made = "a rigid arm" if arm.rigid else "an arm made of cells"
            if arm.sid is not None:
                made = f'a body from a file, which has a node "{one.name}"'
            elif not arm.rigid and arm.cells is None:
                made = f'a mesh file, which has faces in a group "{one.name}"'
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
                    f'expected a joint with parent_interface = "{one.name}", or the payload '
                    "there: nothing sits on it",
                    ("arms", index, "interfaces", number - 1, "name"),
                    ("joints",),
                )
