"""A URDF file as a `Robot`: parsed by yourdfpy, checked for what a scene can hold; written back."""

from __future__ import annotations

import logging
import math
import os
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.exchange.urdf.robot import (
    MOVABLE,
    Inertia,
    Mimic,
    Robot,
    RobotJoint,
    RobotLink,
    number,
)

if TYPE_CHECKING:
    from trimesh import Trimesh

SECTIONS = 64  # flat sides of a cylinder
SIZES = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length")}  # of shapes


def read_robot(file: Path) -> Robot:
    """Read a robot and the surfaces of its links.

    Args:
        file: URDF; packages are looked for as `mesh_path` says.

    Raises:
        InputError: yourdfpy is not installed; no such file; not URDF; joints that a scene does not
            have (floating, planar); links that are no tree.
    """
    try:
        from yourdfpy import URDF
    except ImportError:
        raise InputError(
            f"robots need the package yourdfpy: {sys.executable} -m pip install yourdfpy"
        ) from None
    tree = BytesIO(_parse(file))
    with _quiet():
        try:
            model = URDF.load(tree, build_scene_graph=False, load_meshes=False).robot
        except (AttributeError, KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(
                f"{file}: not a robot that yourdfpy can read ({type(error).__name__}: {error}); "
                "check it with check_urdf"
            ) from None
        _check_names(file, "link", [link.name for link in model.links])
        _check_names(file, "joint", [joint.name for joint in model.joints])
        joints = [_joint(file, item) for item in model.joints]
        _check_mimics(file, joints)
        links = {item.name: _link(file, item) for item in model.links}
    root, ordered = _ordered(file, list(links), joints)
    return Robot(model.name, file, links, ordered, root)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep what yourdfpy and trimesh log to themselves: errors are told in one line."""
    loggers = [logging.getLogger(name) for name in ("yourdfpy", "yourdfpy.urdf", "trimesh")]
    levels = [(logger, logger.level) for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in levels:
            logger.setLevel(level)


def safe_xml(file: Path, **options: Any) -> Any:
    """Return the lxml tree of a file, which may not name other files or text that grows.

    Raises:
        InputError: it declares entities.
        OSError, etree.XMLSyntaxError: it cannot be read, or is no XML.
    """
    from lxml import etree

    parser = etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, **options)
    tree = etree.parse(os.fspath(file), parser)
    declared = tree.docinfo.internalDTD
    if declared is not None and any(True for _ in declared.iterentities()):
        raise InputError(f"{file}: declares XML entities, which no robot needs; write them out")
    return tree


def _parse(file: Path) -> bytes:
    """Return the file's XML, which is that of a robot."""
    from lxml import etree

    try:
        root = safe_xml(file, remove_blank_text=True).getroot()
    except OSError as error:
        reason = error.strerror or "no such file"
        raise InputError(f"{file}: cannot be read ({reason}); name a URDF file") from None
    except etree.XMLSyntaxError as error:
        raise InputError(f"{file}: not XML ({error.msg}); name a URDF file") from None
    _check_expanded(file, root)
    if root.tag != "robot":
        raise InputError(f"{file}: expected an element <robot name=...>, found <{root.tag}>")
    root.set("name", root.get("name") or file.stem)
    text: bytes = etree.tostring(root)
    return text


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
    for name, count in Counter(names).items():
        if count > 1:
            raise InputError(f"{file}: {what} {name!r} stands there {count} times")


# -- joints ----------------------------------------------------------------------------------


def _joint(file: Path, joint: Any) -> RobotJoint:
    where = f"{file}: joint {joint.name!r}"
    if joint.type not in (*MOVABLE, "fixed"):
        raise InputError(
            f"{where}: type {joint.type!r}; a scene has joints of type {', '.join(MOVABLE)} and "
            "fixed"
        )
    _check_finite(f"{where}: origin", _pose(joint.origin))
    axis = np.asarray(joint.axis, dtype=float)
    length = np.linalg.norm(axis) if axis.shape == (3,) else 0.0
    if joint.type != "fixed" and not (math.isfinite(length) and length > 0.0):
        raise InputError(f"{where}: axis {axis.tolist()}; expected three numbers, not all zero")
    limit = joint.limit
    lower, upper = -math.inf, math.inf
    stated = [] if limit is None else [x for x in (limit.lower, limit.upper) if x is not None]
    if stated and joint.type in ("revolute", "prismatic"):
        lower, upper = limit.lower or 0.0, limit.upper or 0.0
        _check_finite(f"{where}: limit", stated)
        if lower > upper:
            raise InputError(f"{where}: limit lower = {lower:g} above upper = {upper:g}")
    rate, effort = (_limit(where, word, limit) for word in ("velocity", "effort"))
    unit = axis / length if length else np.array([1.0, 0.0, 0.0])
    mimic = None if joint.type == "fixed" or joint.mimic is None else _mimic(joint.mimic)
    own = joint.name, joint.type, joint.parent, joint.child, _pose(joint.origin), unit
    return RobotJoint(*own, lower, upper, rate, effort, mimic, _friction(where, joint))


def _friction(where: str, joint: Any) -> tuple[float, float]:
    """Return viscous and Coulomb friction of the element <dynamics>; 0 where nothing is stated."""
    result = []
    for word in ("damping", "friction"):
        value = None if joint.dynamics is None else getattr(joint.dynamics, word)
        value = 0.0 if value is None or joint.type == "fixed" else float(value)
        if not (math.isfinite(value) and value >= 0.0):
            raise InputError(f"{where}: dynamics {word} = {value:g}; expected a number >= 0")
        result.append(value)
    return result[0], result[1]


def _limit(where: str, word: str, limit: Any) -> float:
    """Return a limit of rate or effort; files that know none say 0, or nothing."""
    value = None if limit is None else getattr(limit, word)
    if not value:
        return math.inf
    if math.isnan(value) or value < 0.0:
        raise InputError(f"{where}: limit {word} = {value:g}; expected a positive number")
    return float(value)


def _mimic(mimic: Any) -> Mimic:
    multiplier = 1.0 if mimic.multiplier is None else float(mimic.multiplier)
    return Mimic(mimic.joint, multiplier, 0.0 if mimic.offset is None else float(mimic.offset))


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
) -> tuple[str, tuple[RobotJoint, ...]]:
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
    return roots[0], tuple(result)


# -- links -----------------------------------------------------------------------------------


def _pose(origin: Any) -> np.ndarray:
    return np.eye(4) if origin is None else np.asarray(origin, dtype=float)


def _link(file: Path, link: Any) -> RobotLink:
    shapes, missing = _shapes(file, link.name, link.collisions or link.visuals)

    def visual() -> tuple[Trimesh, ...]:
        with _quiet():
            return _shapes(file, link.name, link.visuals)[0]

    both = link.collisions and link.visuals
    return RobotLink(link.name, _inertia(file, link), shapes, missing, visual if both else None)


def _shapes(
    file: Path, link: str, elements: Sequence[Any]
) -> tuple[tuple[Trimesh, ...], tuple[str, ...]]:
    """Return the surfaces of a link's elements in its frame, and meshes that cannot be read."""
    shapes, missing = [], []
    for element in elements:
        try:
            shape = _shape(file, link, element.geometry)
        except FileNotFoundError as error:
            missing.append(str(error))
            continue
        pose = _pose(element.origin)
        _check_finite(f"{file}: link {link!r}: origin of a shape", pose)
        shape.apply_transform(pose)
        shapes.append(shape)
    return tuple(shapes), tuple(missing)


def _inertia(file: Path, link: Any) -> Inertia | None:
    inertial = link.inertial
    if inertial is None:
        return None
    pose = _pose(inertial.origin)
    tensor = np.zeros((3, 3)) if inertial.inertia is None else inertial.inertia
    mass = 0.0 if inertial.mass is None else float(inertial.mass)
    if not (np.isfinite(tensor).all() and math.isfinite(mass) and np.isfinite(pose).all()):
        raise InputError(f"{file}: link {link.name!r}: inertial holds a number that is not finite")
    R = pose[:3, :3]
    return Inertia(mass, pose[:3, 3], R @ tensor @ R.T)


def _check_finite(where: str, numbers: Any, positive: bool = False) -> None:
    values = np.atleast_1d(np.asarray(numbers, dtype=float))
    if not np.isfinite(values).all() or (positive and (values <= 0.0).any()):
        kind, given = "positive" if positive else "finite", ", ".join(f"{x:g}" for x in values.flat)
        raise InputError(f"{where}: expected {kind} numbers, found {given}")


def _shape(file: Path, link: str, geometry: Any) -> Trimesh:
    """Return the surface of a geometry element of a link."""
    from trimesh import creation

    for kind, names in SIZES.items():
        if (shape := getattr(geometry, kind)) is not None:
            size = np.hstack([getattr(shape, name) for name in names])
            _check_finite(f"{file}: link {link!r}: size of a {kind}", size, positive=True)
    if (shape := geometry.box) is not None:
        return creation.box(extents=shape.size)
    if (shape := geometry.sphere) is not None:
        return creation.icosphere(subdivisions=4, radius=shape.radius)
    if (shape := geometry.cylinder) is not None:
        return creation.cylinder(radius=shape.radius, height=shape.length, sections=SECTIONS)
    return _mesh(file, geometry.mesh)


def _mesh(file: Path, mesh: Any) -> Trimesh:
    import trimesh

    if not mesh.filename:
        raise FileNotFoundError("a mesh without a name")
    path = mesh_path(file, mesh.filename)
    if path is None:
        raise FileNotFoundError(f"mesh {mesh.filename} not found{_similar(file, mesh.filename)}")
    try:
        result: Any = trimesh.load_mesh(os.fspath(path))
    except Exception as error:  # every format has its own
        raise FileNotFoundError(f"mesh {mesh.filename} cannot be read") from error
    if not isinstance(result, trimesh.Trimesh) or not len(result.faces):
        raise FileNotFoundError(f"mesh {mesh.filename} holds no triangles")
    if mesh.scale is not None:
        result.apply_scale(mesh.scale)
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
    if not colon or scheme == "file":
        path = Path(rest if colon else name)
        places = [path] if path.is_absolute() else [above / path for above in _folders_above(file)]
    else:
        package, _, inner = rest.lstrip("/").partition("/")
        places = [root / inner for root in _packages(file, package)]
        places += [folder / inner for folder in _folders_above(file)]
    return next((place for place in places if place.is_file()), None)


def _packages(file: Path, package: str) -> Iterator[Path]:
    """Yield the folders that may be a ROS package."""

    def stated(variable: str) -> list[Path]:
        return [Path(place) for place in os.environ.get(variable, "").split(os.pathsep) if place]

    for folder in stated("ROS_PACKAGE_PATH"):
        if folder.absolute().name == package:
            yield folder
        yield folder / package
        yield from sorted(place / package for place in folder.glob("*/"))  # a workspace of stacks
        yield folder / "share" / package
    for folder in stated("AMENT_PREFIX_PATH"):
        yield folder / "share" / package
    for folder in _folders_above(file):
        if folder.name == package:
            yield folder
        yield folder / package


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
ROUNDING = 1e-6


def implausible_inertias(robot: Robot) -> list[str]:
    """Return a sentence for every inertia of a robot that cannot be, or hardly."""
    return [
        f"{robot.file}: link {link.name!r}: {what}"
        for link in robot.links.values()
        for what in _of_link(robot, link)
    ]


def _of_link(robot: Robot, link: RobotLink) -> Iterator[str]:
    mass, tensor = link.own.mass, link.own.tensor
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
    principal = np.linalg.eigvalsh(tensor)
    told = f"principal moments {', '.join(f'{value:.4g}' for value in principal)} kg m2"
    if principal[0] <= 0.0:
        yield f"its inertia is not positive definite: {told}"
    elif principal[2] > (1.0 + ROUNDING) * (principal[0] + principal[1]):
        yield f"its inertia cannot be: of the {told} the largest exceeds the sum of the others"
    if len(link.points):
        yield from _of_size(link, principal)


def _of_size(link: RobotLink, principal: np.ndarray) -> Iterator[str]:
    """Compare mass, centre and inertia with the link's geometry."""
    mass, centre = link.own.mass, link.own.centre
    first, last = link.points.min(axis=0), link.points.max(axis=0)
    diagonal = float(np.linalg.norm(last - first))
    away = float(np.linalg.norm(np.maximum(0.0, np.maximum(first - centre, centre - last))))
    if away > OUTSIDE * diagonal:
        yield f"its centre of mass is {away:.3g} m outside its geometry, {diagonal:.3g} m across"
    gyration = float(np.sqrt(max(0.0, principal.sum() / 2.0 / mass)))
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
            new = etree.Element(kind)
            etree.SubElement(etree.SubElement(new, "geometry"), "mesh", filename=link.mesh)
            if kind == "visual" and material is not None:
                new.append(material)
            _replace(element, new)
    text: bytes = etree.tostring(tree, xml_declaration=True, encoding="utf-8")
    return text + b"\n"


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
    from lxml import etree

    element = etree.Element("inertial")
    etree.SubElement(element, "origin", xyz=" ".join(map(number, inertia.centre)), rpy="0 0 0")
    etree.SubElement(element, "mass", value=number(inertia.mass))
    pairs = ("xx", "xy", "xz", "yy", "yz", "zz")
    moments = inertia.tensor[np.triu_indices(3)]
    etree.SubElement(element, "inertia", **{f"i{k}": number(x) for k, x in zip(pairs, moments)})
    return element
