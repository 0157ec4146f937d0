"""STEP files as Gmsh models: the planar face of an arm, or the end face of its solid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.mesh.checks import remedy
from dolfinopt.mesh.file_check import check_start, open_file
from dolfinopt.mesh.gmsh_session import mesh_surfaces
from dolfinopt.mesh.groups import DESIGN, INBOARD, NAMES, OUTBOARD, PASSIVE, group_named
from dolfinopt.mesh.step_names import read_shapes
from dolfinopt.scene.tables.arms import Arm

UNNAMED = "Open CASCADE STEP translator"  # and numbers: what Open CASCADE calls nameless products
THICKNESS_TOLERANCE = 1e-3  # relative, of a solid: sheet metal is made no closer
NEAR = 1e-6  # of the arm's height: coordinates in a file have seven digits or more
NORMAL = 1e-9  # 1 - cosine to z of an end face's normal: rounding of plane surfaces
ALONG = 1e-6  # cosine to z of a side face's normal: rounding of splines


def read_step(gmsh: Any, arm: Arm, unknown: list[str]) -> bool:
    """Mesh the planar faces of a STEP file, whatever its unit, and find the groups.

    Of a prismatic solid that is the end face nearest to z = 0, moved there. Faces are named
    themselves or by the product they belong to. Few programs name edges: where none bears the name
    of an interface, `_joint_curves` finds it.
    """
    path = Path(str(arm.mesh))
    check_start(path)
    named_edges, named_faces = read_shapes(path.read_bytes().decode("latin-1"))
    gmsh.option.setString("Geometry.OCCTargetUnit", "M")
    open_file(gmsh, path)
    model = gmsh.model
    everywhere = _ends(model, model.getEntities(1))
    faces, owners, level = model.getEntities(2), model.getEntities(2), 0.0
    if model.getEntities(3):
        faces, owners, level = _prism_faces(model, arm)
    if not faces:
        raise InputError("it holds no face; export the planar face in z = 0, not its outline")
    labels, products = [], []
    for face, owner in zip(faces, owners, strict=True):
        outline = model.getBoundary([face], combined=False, oriented=False)
        product = model.getEntityName(*owner).rpartition("/")[2].strip()
        products.append("" if product.startswith(UNNAMED) else product)
        names = {products[-1]} | named_faces.names_at(_ends(model, outline), everywhere)
        labels.append({group_named(name, PASSIVE, DESIGN) for name in names})
    if len(set(products)) > 1:  # a single one bears the name of the part
        unknown += [p for p, groups in zip(products, labels, strict=True) if groups == {None} and p]
    if level or model.getEntities(3):
        _keep_faces(model, faces, level)
    # Faces of different products do not share their common curves unless glued.
    children = model.occ.fragment(faces, [])[1] if len(faces) > 1 else [[face] for face in faces]
    loose = [curve for curve in model.getEntities(1) if not len(model.getAdjacencies(*curve)[0])]
    model.occ.remove(loose, recursive=True)
    model.occ.synchronize()
    model.removePhysicalGroups()
    lift = np.array([0.0, 0.0, level])  # to where the file has them
    curves = {
        curve[1]: named_edges.names_at(_ends(model, [curve]) + lift, everywhere)
        for curve in model.getEntities(1)
    }
    for tag, x in ((INBOARD, 0.0), (OUTBOARD, arm.length)):
        own = [c for c, names in curves.items() if any(group_named(n, tag) for n in names)]
        if any(group_named(name, tag) for name in named_edges.names) and not own:
            raise InputError(f'the edges named "{NAMES[tag]}" are not where the file says')
        model.addPhysicalGroup(1, own or _joint_curves(model, x, arm.height), tag)
        model.setPhysicalName(1, tag, NAMES[tag])
    passive = [f[1] for found, group in zip(labels, children) for f in group if PASSIVE in found]
    model.addPhysicalGroup(2, passive, PASSIVE)
    model.setPhysicalName(2, PASSIVE, NAMES[PASSIVE])
    gmsh.option.setNumber("Mesh.MeshSizeMax", arm.cell_size)
    mesh_surfaces(gmsh, arm.cell_shape or "quadrilateral")
    return False


def _prism_faces(
    model: Any, arm: Arm
) -> tuple[list[tuple[int, int]], list[tuple[int, int]], float]:
    """Return the end faces of prismatic solids nearest to z = 0, the solid of each, and their z, m.

    Raises:
        InputError: a solid whose section is not constant along z, or not `arm.thickness` thick.
    """
    near = NEAR * arm.height
    found: list[tuple[float, float, list[tuple[tuple[int, int], float]], tuple[int, int]]] = []
    for solid in model.getEntities(3):
        flat = []
        for face in model.getBoundary([solid], oriented=False):
            low, high = model.getParametrizationBounds(*face)
            grid = np.stack(np.meshgrid(*np.linspace(low, high, 5).T), axis=2).ravel()
            points = np.reshape(model.getValue(*face, grid), (-1, 3))
            upright = np.abs(np.reshape(model.getNormal(face[1], grid), (-1, 3))[:, 2])
            if (upright > 1.0 - NORMAL).all():
                flat.append((face, float(points[:, 2].mean())))
            elif not (upright < ALONG).all():
                x, y, z = model.occ.getCenterOfMass(*face)
                raise InputError(
                    f"it holds a solid whose face about ({x:.4g}, {y:.4g}, {z:.4g}) m is neither "
                    "normal to z nor along it; expected a section that is constant along z, or "
                    "the planar face in z = 0"
                )
        levels = [z for _, z in flat]
        bottom, top = min(levels), max(levels)
        steps = [z for z in levels if bottom + near < z < top - near]
        if steps:
            raise InputError(
                f"it holds a solid with a step at z = {steps[0]:.6g} m between its end faces at "
                f"{bottom:.6g} and {top:.6g} m; expected a section that is constant along z, or "
                "the planar face in z = 0"
            )
        if abs(top - bottom - arm.thickness) > THICKNESS_TOLERANCE * arm.thickness:
            raise InputError(
                f"its solid is {top - bottom:.6g} m thick along z, expected arms.thickness = "
                f"{arm.thickness:.6g} m; {remedy(top - bottom, arm.thickness, 'thickness')}"
            )
        found.append((bottom, top, flat, solid))
    bottoms = np.array([bottom for bottom, _, _, _ in found])
    if np.ptp(bottoms) > near:
        raise InputError(
            f"its solids begin at z = {bottoms.min():.6g} to {bottoms.max():.6g} m; expected them "
            "side by side, in one plane"
        )
    level = min(found[0][:2], key=abs)
    pairs = [
        (face, solid) for _, _, flat, solid in found for face, z in flat if abs(z - level) < near
    ]
    return [face for face, _ in pairs], [solid for _, solid in pairs], level


def _keep_faces(model: Any, faces: list[tuple[int, int]], level: float) -> None:
    """Remove all but `faces` from the model and move them from z = `level` to 0."""
    model.occ.remove(model.getEntities(3))
    model.occ.remove([face for face in model.getEntities(2) if face not in faces])
    model.occ.synchronize()
    loose = [curve for curve in model.getEntities(1) if not len(model.getAdjacencies(*curve)[0])]
    model.occ.remove(loose, recursive=True)
    model.occ.translate(faces, 0.0, 0.0, -level)
    model.occ.synchronize()


def _ends(model: Any, curves: list[tuple[int, int]]) -> np.ndarray:
    """Return the first and last points (2 n, 3) of curves, m."""
    ends = [np.empty((0, 3))]
    for _, tag in curves:
        low, high = (bound[0] for bound in model.getParametrizationBounds(1, tag))
        ends.append(np.reshape(model.getValue(1, tag, [low, high]), (-1, 3)))
    return np.concatenate(ends)


def _joint_curves(model: Any, x: float, height: float) -> list[int]:
    """Return the curves of the interface at the joint axis (x, 0).

    The bore: the smallest full circle about the axis. Where there is none, the end: all straight
    curves on the upright line through it.
    """
    near = NEAR * height
    arcs: list[tuple[float, float, int]] = []  # radius, angle, curve
    upright = []
    for _, tag in model.getEntities(1):
        low, high = (bound[0] for bound in model.getParametrizationBounds(1, tag))
        points = np.reshape(model.getValue(1, tag, np.linspace(low, high, 65)), (-1, 3))[:, :2]
        radius = np.linalg.norm(points - [x, 0.0], axis=1)
        if np.ptp(radius) < near:
            length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
            arcs.append((float(radius.mean()), float(length / radius.mean()), tag))
        if np.abs(points[:, 0] - x).max() < near:
            upright.append(tag)
    arcs.sort()
    smallest: list[tuple[float, float, int]] = []
    for arc in arcs:
        # Arcs of one circle by a tolerance: their radii differ by rounding.
        smallest = [*smallest, arc] if smallest and arc[0] - smallest[0][0] < near else [arc]
        if sum(angle for _, angle, _ in smallest) > 6.2:  # chords of 2 pi
            return [tag for _, _, tag in smallest]
    if upright:
        return upright
    raise InputError(
        f"no interface at ({x:g}, 0) m: expected a circular bore about it or a straight end "
        f"on x = {x:g} m; the origin is the inboard joint axis, +x points to the outboard one at "
        "(length, 0)"
    )
