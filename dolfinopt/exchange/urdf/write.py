"""A robot written back: the URDF file as it was, with new inertia and meshes of some links."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dolfinopt.errors import InputError
from dolfinopt.exchange.urdf.read import safe_xml
from dolfinopt.exchange.urdf.robot import Inertia

INDENT = "  "
SHOWN = ("visual", "collision")


@dataclass(frozen=True, eq=False)
class NewLink:
    """What a link is from now on.

    Attributes:
        name: of the link.
        inertia: in the link's frame.
        mesh: file of its surface in the link's frame, as the URDF file is to name it; None leaves
            its shapes as they are.
    """

    name: str
    inertia: Inertia
    mesh: str | None = None


def robot_text(file: Path, links: Sequence[NewLink], folder: Path) -> bytes:
    """Return the text of a URDF file in `folder` in which some links are new.

    All else stays, comments and elements of other programs included; names of meshes relative to
    the file become relative to `folder`.

    Raises:
        InputError: the file cannot be read, or has no such link.
    """
    from lxml import etree

    try:
        tree = safe_xml(file)
    except (OSError, etree.XMLSyntaxError) as error:
        raise InputError(f"{file}: cannot be read ({error}); --urdf needs the robot") from None
    by_name = {one.get("name"): one for one in tree.getroot().iterfind("link")}
    for mesh in tree.getroot().iter("mesh"):
        mesh.set("filename", _from_folder(mesh.get("filename", ""), file, folder))
    for link in links:
        if link.name not in by_name:
            raise InputError(f"{file}: no link {link.name!r}; is it the robot of the scene?")
        _renew(by_name[link.name], link)
    text: bytes = etree.tostring(tree, xml_declaration=True, encoding="utf-8")
    return text + b"\n"


def _renew(element: Any, link: NewLink) -> None:
    """Put a link's new inertia, and its mesh if it has one, in the place of the old."""
    materials = [one for one in element.iterfind("visual/material")]
    _replace(element, "inertial", _inertial(link.inertia))
    if link.mesh is None:
        return
    for kind in SHOWN:
        new = _shape(kind, link.mesh)
        if kind == "visual" and materials:
            new.append(materials[0])
        _replace(element, kind, new)
    _close(element)


def _replace(parent: Any, tag: str, new: Any) -> None:
    """Put an element in the place of the first of its kind, and remove the others."""
    from lxml import etree

    old = parent.findall(tag)
    at = parent.index(old[0]) if old else len(parent)
    for one in old:
        parent.remove(one)
    etree.indent(new, INDENT, level=2)
    new.tail = "\n" + 2 * INDENT
    if not (parent.text or "").strip():
        parent.text = parent.text or "\n" + 2 * INDENT
    parent.insert(at, new)
    _close(parent)


def _close(parent: Any) -> None:
    """Put the end of a link on a line of its own."""
    if len(parent):
        parent[-1].tail = "\n" + INDENT


def _inertial(inertia: Inertia) -> Any:
    from lxml import etree

    element = etree.Element("inertial")
    etree.SubElement(element, "origin", xyz=_numbers(inertia.centre), rpy="0 0 0")
    etree.SubElement(element, "mass", value=_number(inertia.mass))
    axes = "xyz"
    moments = {
        f"i{axes[i]}{axes[j]}": _number(inertia.tensor[i, j]) for i in range(3) for j in range(i, 3)
    }
    etree.SubElement(element, "inertia", **moments)
    return element


def _shape(kind: str, mesh: str) -> Any:
    from lxml import etree

    element = etree.Element(kind)
    geometry = etree.SubElement(element, "geometry")
    etree.SubElement(geometry, "mesh", filename=mesh)
    return element


def _from_folder(name: str, file: Path, folder: Path) -> str:
    """Return a mesh's name as a file in `folder` has to say it."""
    if "://" in name or os.path.isabs(name):
        return name
    path = os.path.relpath(os.path.abspath(file.parent / name), os.path.abspath(folder))
    return Path(path).as_posix()


def _numbers(values: Any) -> str:
    return " ".join(map(_number, values))


def _number(value: float) -> str:
    return repr(float(value) + 0.0)
