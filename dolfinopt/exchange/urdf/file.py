"""A URDF file as a `Robot`: read, checked for what a scene can hold; written back."""

from __future__ import annotations

import logging
import math
import os
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.exchange.urdf.robot import (
    MASSLESS,
    MOVABLE,
    Inertia,
    Mimic,
    Robot,
    RobotJoint,
    RobotLink,
    number,
)
from dolfinopt.scene.tables.arms import tensor_problem

if TYPE_CHECKING:
    from trimesh import Trimesh

# What trimesh logs is not printed: errors are told in one line.
logging.getLogger("trimesh").addHandler(logging.NullHandler())
SECTIONS = 64  # flat sides of a cylinder
# Of shapes: attributes, with as many numbers as each has.
SIZES = {
    "box": {"size": "0 0 0"},
    "sphere": {"radius": "0"},
    "cylinder": {"radius": "0", "length": "0"},
}
MOMENTS = "ixx", "ixy", "ixz", "iyy", "iyz", "izz"


def read_robot(file: Path) -> Robot:
    """Read a robot and the surfaces of its links.

    Args:
        file: URDF; packages are looked for as `mesh_path` says.

    Raises:
        InputError: trimesh or lxml are not installed; no such file; not URDF; joints that a scene
            does not have (floating, planar); links that are no tree.
    """
    try:
        import lxml  # noqa: F401
        import trimesh  # noqa: F401
    except ImportError:
        raise InputError(
            f"robots need packages for XML and surfaces: {sys.executable} -m pip install "
            "'trimesh[easy]'"
        ) from None
    root = _parse(file)
    elements = {kind: root.findall(kind) for kind in ("link", "joint")}
    for kind, items in elements.items():
        _check_names(file, kind, [item.get("name", "") for item in items])
    joints = [_joint(file, item) for item in elements["joint"]]
    _check_mimics(file, joints)
    links = {item.get("name"): _link(file, item) for item in elements["link"]}
    first, ordered = _ordered(file, list(links), joints)
    return Robot(root.get("name") or file.stem, file, links, ordered, first)


def safe_xml(file: Path) -> Any:
    """Return the lxml tree of a file, which may not name other files or text that grows.

    Raises:
        InputError: it declares entities.
        OSError, etree.XMLSyntaxError: it cannot be read, or is no XML.
    """
    from lxml import etree

    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False)
    tree = etree.parse(os.fspath(file), parser)
    declared = tree.docinfo.internalDTD
    if declared is not None and any(True for _ in declared.iterentities()):
        raise InputError(f"{file}: declares XML entities, which no robot needs; write them out")
    return tree


def _parse(file: Path) -> Any:
    """Return the root of the file's XML, which is that of a robot."""
    from lxml import etree

    try:
        root = safe_xml(file).getroot()
    except OSError as error:
        reason = error.strerror or "no such file"
        raise InputError(f"{file}: cannot be read ({reason}); name a URDF file") from None
    except etree.XMLSyntaxError as error:
        raise InputError(f"{file}: not XML ({error.msg}); name a URDF file") from None
    _check_expanded(file, root)
    if root.tag != "robot":
        raise InputError(f"{file}: expected an element <robot name=...>, found <{root.tag}>")
    return root


def _check_expanded(file: Path, root: Any) -> None:
    """Refuse elements of xacro; its namespace alone, as xacro leaves it behind, means nothing."""
    for element in root.iter("{*}*"):
        if "xacro" in element.tag.rpartition("}")[0]:
            stem = file.name.removesuffix(".xacro").removesuffix(".urdf")
            new = f"{stem}.urdf" if f"{stem}.urdf" != file.name else f"{stem}-plain.urdf"
            raise InputError(
                f"{file}: line {element.sourceline}: an element of xacro, "
                f"{element.tag.rpartition('}')[2]}; make a URDF of it first: "
                f"xacro {file.name} > {new}"
            )


def _check_names(file: Path, what: str, names: list[str]) -> None:
    if not names and what == "link":
        raise InputError(f"{file}: no links")
    if "" in names:
        raise InputError(f"{file}: a {what} without a name")
    for name, count in Counter(names).items():
        if count > 1:
            raise InputError(f"{file}: {what} {name!r} stands there {count} times")


# -- joints ----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Element:
    """An element of the file, and how messages about it begin."""

    where: str
    xml: Any

    def stated(self, tag: str, name: str, default: str = "") -> str:
        """Return an attribute of a child; the default where there is none."""
        child = self.xml.find(tag)
        return str(default if child is None else child.get(name, default))

    def numbers(self, tag: str, name: str, default: str) -> np.ndarray:
        """Return as many numbers of an attribute of a child as the default has."""
        text, count = self.stated(tag, name, default), len(default.split())
        try:
            values = np.array(text.replace(",", " ").split(), dtype=float)
        except ValueError:
            values = np.full(count, math.nan)
        if text != default and (len(values) != count or not np.isfinite(values).all()):
            raise InputError(
                f"{self.where}: {tag} {name} = {text!r}; expected finite numbers, {count}"
            )
        return values

    def number(self, tag: str, name: str, default: str = "0", least: float = -math.inf) -> float:
        """Return a number that may not be less than the least."""
        value = float(self.numbers(tag, name, default)[0])
        if value < least:
            raise InputError(f"{self.where}: {tag} {name} = {value:g}; expected {least:g} or more")
        return value

    @property
    def pose(self) -> np.ndarray:
        """The pose that its origin states."""
        from trimesh.transformations import euler_matrix

        result = np.asarray(euler_matrix(*self.numbers("origin", "rpy", "0 0 0")))
        result[:3, 3] = self.numbers("origin", "xyz", "0 0 0")
        return result


def _joint(file: Path, xml: Any) -> RobotJoint:
    name, kind = xml.get("name"), xml.get("type")
    joint = _Element(f"{file}: joint {name!r}", xml)
    if kind not in (*MOVABLE, "fixed"):
        raise InputError(
            f"{joint.where}: type {kind!r}; a scene has joints of type {', '.join(MOVABLE)} and "
            "fixed"
        )
    held = name, kind, joint.stated("parent", "link"), joint.stated("child", "link"), joint.pose
    if kind == "fixed":
        return RobotJoint(*held, np.array([1.0, 0.0, 0.0]))
    axis, mimic, lower, upper = joint.numbers("axis", "xyz", "1 0 0"), None, -math.inf, math.inf
    if not axis.any():
        raise InputError(f"{joint.where}: axis {axis.tolist()}; expected three, not all zero")
    if kind != "continuous" and (joint.stated("limit", "lower") or joint.stated("limit", "upper")):
        lower, upper = joint.number("limit", "lower"), joint.number("limit", "upper")
        if lower > upper:
            raise InputError(f"{joint.where}: limit lower = {lower:g} above upper = {upper:g}")
    if xml.find("mimic") is not None:
        factor = joint.number("mimic", "multiplier", "1")
        mimic = Mimic(joint.stated("mimic", "joint"), factor, joint.number("mimic", "offset"))
    # Files that know no limit of rate or effort say 0, or nothing.
    rate = joint.number("limit", "velocity", "inf", 0.0) or math.inf
    effort = joint.number("limit", "effort", "inf", 0.0) or math.inf
    viscous = joint.number("dynamics", "damping", "0", 0.0)
    friction = viscous, joint.number("dynamics", "friction", "0", 0.0)
    unit = axis / np.linalg.norm(axis)
    return RobotJoint(*held, unit, lower, upper, rate, effort, mimic, friction)


def _check_mimics(file: Path, joints: list[RobotJoint]) -> None:
    leading = {item.name for item in joints if item.moves and item.mimic is None}
    for joint in joints:
        if joint.mimic is not None and joint.mimic.joint not in leading:
            raise InputError(
                f"{file}: joint {joint.name!r}: follows {joint.mimic.joint!r}; expected a joint "
                "that moves and follows no other"
            )


def _ordered(
    file: Path, links: list[str], joints: list[RobotJoint]
) -> tuple[str, list[RobotJoint]]:
    """Return the root's name, and the joints with every one behind its parent's."""
    for joint in joints:
        for word, name in (("parent", joint.parent), ("child", joint.child)):
            if name not in links:
                raise InputError(f"{file}: joint {joint.name!r}: no link {name!r}, its {word}")
    for name, count in Counter(joint.child for joint in joints).items():
        if count > 1:
            raise InputError(
                f"{file}: link {name!r} is held by {count} joints; expected a tree: "
                "leave out the joints that close a loop and state it in --closures"
            )
    held = {joint.child for joint in joints}
    roots = [name for name in links if name not in held]
    if len(roots) != 1:
        raise InputError(
            f"{file}: {len(roots)} links that no joint holds ({', '.join(roots) or 'none'}); "
            "expected one, which stands on the ground"
        )
    placed, result, waiting = {roots[0]}, [], list(joints)
    while waiting:
        first = next((joint for joint in waiting if joint.parent in placed), None)
        if first is None:
            raise InputError(f"{file}: joint {waiting[0].name!r} is part of a loop")
        result.append(first)
        placed.add(first.child)
        waiting.remove(first)
    return roots[0], result


# -- links -----------------------------------------------------------------------------------


def _link(file: Path, xml: Any) -> RobotLink:
    name = xml.get("name")
    where, inertia = f"{file}: link {name!r}", MASSLESS
    if (inertial := xml.find("inertial")) is not None:
        own = _Element(f"{where}: inertial", inertial)
        tensor = np.empty((3, 3))
        for key, a, b in zip(MOMENTS, *np.triu_indices(3)):
            tensor[a, b] = tensor[b, a] = own.number("inertia", key)
        mass = own.number("mass", "value")
        inertia = Inertia(mass, np.zeros(3), tensor).posed(own.pose)
    collisions, visuals = (
        [_Element(f"{where}: {kind}", item) for item in xml.findall(kind)]
        for kind in ("collision", "visual")
    )
    shapes, missing = _shapes(file, collisions or visuals)

    def visual() -> list[Trimesh]:
        return _shapes(file, visuals)[0]

    return RobotLink(name, inertia, shapes, missing, visual if collisions and visuals else None)


def _shapes(file: Path, elements: Sequence[_Element]) -> tuple[list[Trimesh], list[str]]:
    """Return the surfaces of a link's elements in its frame, and meshes that cannot be read."""
    shapes, missing = [], []
    for element in elements:
        try:
            shape = _shape(file, element)
        except FileNotFoundError as error:
            missing.append(str(error))
            continue
        shape.apply_transform(element.pose)
        shapes.append(shape)
    return shapes, missing


def _shape(file: Path, element: _Element) -> Trimesh:
    """Return the surface of a shape of a link."""
    from trimesh import creation

    shape = element.xml.find("geometry/*")
    kind = None if shape is None else shape.tag
    if kind == "mesh":
        return _mesh(file, element)
    if kind not in SIZES:
        raise InputError(f"{element.where}: geometry: expected {', '.join(SIZES)} or mesh")
    names = SIZES[kind].items()
    sizes = np.concatenate([element.numbers(f"geometry/{kind}", *item) for item in names])
    if not (sizes > 0.0).all():
        given = ", ".join(f"{x:g}" for x in sizes)
        raise InputError(
            f"{element.where}: size of a {kind}: expected positive numbers, found {given}"
        )
    if kind == "box":
        return creation.box(extents=sizes)
    if kind == "sphere":
        return creation.icosphere(subdivisions=4, radius=sizes[0])
    return creation.cylinder(radius=sizes[0], height=sizes[1], sections=SECTIONS)


def _mesh(file: Path, element: _Element) -> Trimesh:
    import trimesh

    name, tag = element.stated("geometry/mesh", "filename"), "geometry/mesh"
    if not name:
        raise FileNotFoundError("a mesh without a name")
    path = mesh_path(file, name)
    if path is None:
        raise FileNotFoundError(f"mesh {name} not found{_similar(file, name)}")
    try:
        result: Any = trimesh.load_mesh(os.fspath(path))
    except Exception as error:  # every format has its own
        raise FileNotFoundError(f"mesh {name} cannot be read") from error
    if not isinstance(result, trimesh.Trimesh) or not len(result.faces):
        raise FileNotFoundError(f"mesh {name} holds no triangles")
    count = len(element.stated(tag, "scale", "1").split())  # one number, or one for each axis
    result.apply_scale(element.numbers(tag, "scale", "1 1 1" if count > 1 else "1"))
    return result


def _similar(file: Path, name: str) -> str:
    """Name a file in the folder of a missing one whose name differs by capitals alone."""
    inner = Path(name.partition("://")[2] or name)
    for above in _folders_above(file):
        places = sorted((above / inner).parent.glob("*"))
        for place in places:
            if place.name.casefold() == inner.name.casefold():
                return f"; there is {place.name}"
    return ""


def sources_of(file: Path) -> list[Path]:
    """Return the files that a robot is read from: itself and its meshes, where they are found."""
    meshes = [mesh.get("filename", "") for mesh in safe_xml(file).getroot().iter("mesh")]
    result = (mesh_path(file, name) for name in meshes)
    return [file, *(path for path in result if path is not None)]


def mesh_path(file: Path, name: str) -> Path | None:
    """Return where a mesh that a URDF file names lies; None where it is not found.

    "package://ROBOT/meshes/a.stl" is looked for in a folder ROBOT within those of
    ROS_PACKAGE_PATH, in share/ROBOT within those of AMENT_PREFIX_PATH, and in the folders
    above the file, as it is named and where symbolic links lead. Such a folder may be ROBOT itself.
    Last, ROBOT left out, beside the file and in the folders above it.
    """
    scheme, colon, rest = name.partition("://")
    above = _folders_above(file)
    if not colon or scheme == "file":
        places = [folder / (rest or name) for folder in above]  # of an absolute path itself
    else:
        package, _, inner = rest.lstrip("/").partition("/")
        places = [folder / package / inner for folder in [*_workspaces(), *above]]
        places += [folder / inner for folder in above]
    return next((place for place in places if place.is_file()), None)


def _workspaces() -> Iterator[Path]:
    """Yield the folders in which ROS looks for packages."""

    def stated(variable: str) -> list[Path]:
        return [Path(place) for place in os.environ.get(variable, "").split(os.pathsep) if place]

    for folder in stated("ROS_PACKAGE_PATH"):
        yield folder.absolute().parent  # it may be a package itself
        yield folder
        yield from sorted(folder.glob("*/"))  # a workspace of stacks
        yield folder / "share"
    for folder in stated("AMENT_PREFIX_PATH"):
        yield folder / "share"


def _folders_above(file: Path) -> list[Path]:
    """Return a file's folder and those above it, as it is named and without symbolic links."""
    named, real = Path(os.path.abspath(file)), file.resolve()
    return list(dict.fromkeys([*named.parents, *real.parents]))


# -- inertias of a robot that cannot be, as they are common in URDF files: one line each ---------
#
# A rigid body's inertia tensor about its centre is positive definite, and none of its principal
# moments exceeds the sum of the others; radius of gyration and mean density follow from its size.
# Source: Traversaro, Brossette, Escande & Nori, Identification of fully physical consistent
# inertial parameters using optimization on manifolds (2016), doi:10.1109/IROS.2016.7759801.

DENSITIES = (100.0, 20000.0)  # kg/m3: a hollow cover, tungsten
OUTSIDE = 0.1  # of the diagonal of the box around the geometry
SLENDER = 0.03  # least radius of gyration over that diagonal; of a ball it is 0.18


def implausible_inertias(robot: Robot) -> list[str]:
    """Return a sentence for every inertia of a robot that cannot be, or hardly."""
    return [
        f"{robot.file}: link {link.name!r}: {what}"
        for link in robot.links.values()
        for what in _of_link(robot, link)
    ]


def _of_link(robot: Robot, link: RobotLink) -> Iterator[str]:
    mass, tensor = link.inertia.mass, link.inertia.tensor
    for name in link.missing:
        yield f"{name}; the size of the link is not known"
    if mass < 0.0:
        yield f"mass {mass:g} kg is negative"
        return
    if mass == 0.0:
        if link.name != robot.root and robot.holder[link.name].moves and link.shapes:
            yield "no mass, though it has a shape and a joint that moves"
        elif tensor.any():
            yield "an inertia without mass"
        return
    if problem := tensor_problem(tuple(link.inertia.moments)):
        yield problem
    if len(link.points):
        yield from _of_size(link)


def _of_size(link: RobotLink) -> Iterator[str]:
    """Compare mass, centre and inertia with the link's geometry."""
    mass, centre = link.inertia.mass, link.inertia.centre
    first, last = link.points.min(axis=0), link.points.max(axis=0)
    diagonal = float(np.linalg.norm(last - first))
    away = float(np.linalg.norm(np.maximum(0.0, np.maximum(first - centre, centre - last))))
    if away > OUTSIDE * diagonal:
        yield f"its centre of mass is {away:.3g} m outside its geometry, {diagonal:.3g} m across"
    gyration = float(np.sqrt(max(0.0, np.trace(link.inertia.tensor) / 2.0 / mass)))
    if not SLENDER * diagonal <= gyration <= diagonal:
        yield (
            f"its inertia is too {'large' if gyration > diagonal else 'small'}: a radius of "
            f"gyration of {gyration:.3g} m in a geometry {diagonal:.3g} m across"
        )
    density = mass / link.volume if link.volume > 0.0 else np.inf
    if not DENSITIES[0] <= density <= DENSITIES[1]:
        yield (
            f"{mass:.4g} kg in {link.volume:.3g} m3 are {density:.3g} kg/m3; expected "
            f"{DENSITIES[0]:g} to {DENSITIES[1]:g}: mass or unit (mm?) of the geometry is wrong"
        )


# -- the file as it was, with new inertia and meshes of some links -------------------------------

INDENT = "  "


@dataclass(frozen=True, eq=False)
class NewLink:
    """What a link is from now on, in its frame."""

    name: str
    inertia: Inertia
    mesh: str | None = None  # file of its surface, as the URDF file names it; None: shapes stay


def robot_text(file: Path, links: Sequence[NewLink], folder: Path) -> bytes:
    """Return the text of a URDF file in `folder` in which some links are new.

    All else stays, comments and elements of other programs included; names of meshes relative to
    the file become relative to `folder`.

    Raises:
        InputError: the file cannot be read, or has no such link.
    """
    from lxml import etree
    from lxml.builder import E

    try:
        tree = safe_xml(file)
    except (OSError, etree.XMLSyntaxError) as error:
        raise InputError(f"{file}: cannot be read ({error}); export needs the robot") from None
    by_name = {element.get("name"): element for element in tree.getroot().iterfind("link")}
    for mesh in tree.getroot().iter("mesh"):
        name = mesh.get("filename", "")
        if "://" not in name and not os.path.isabs(name):
            path = os.path.relpath(os.path.abspath(file.parent / name), os.path.abspath(folder))
            mesh.set("filename", Path(path).as_posix())
    for link in links:
        if link.name not in by_name:
            raise InputError(f"{file}: no link {link.name!r}; is it the robot of the scene?")
        element = by_name[link.name]
        material = element.find("visual/material")
        _replace(element, _inertial(link.inertia))
        for kind in () if link.mesh is None else ("visual", "collision"):
            new = E(kind, E.geometry(E.mesh(filename=link.mesh)))
            if kind == "visual" and material is not None:
                new.append(material)
            _replace(element, new)
    text: bytes = etree.tostring(tree, xml_declaration=True, encoding="utf-8")
    return text.replace(b"--><", b"-->\n<", 1) + b"\n"  # lxml drops the line's end before the root


def _replace(parent: Any, new: Any) -> None:
    """Put an element in the place of the first of its kind, and remove the others."""
    from lxml import etree

    old = parent.findall(new.tag)
    at = parent.index(old[0]) if old else len(parent)
    for element in old:
        parent.remove(element)
    etree.indent(new, INDENT, level=2)
    new.tail = "\n" + 2 * INDENT
    if not (parent.text or "").strip():
        parent.text = parent.text or "\n" + 2 * INDENT
    parent.insert(at, new)
    parent[-1].tail = "\n" + INDENT  # the end of a link on a line of its own


def _inertial(inertia: Inertia) -> Any:
    from lxml.builder import E

    moments = map(number, inertia.tensor[np.triu_indices(3)])
    return E.inertial(
        E.origin(xyz=" ".join(map(number, inertia.centre)), rpy="0 0 0"),
        E.mass(value=number(inertia.mass)),
        E.inertia(dict(zip(MOMENTS, moments))),
    )
