"""STEP files of a shape, by Gmsh's Open CASCADE kernel: the solid and its face, in millimetres."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dolfinopt.mesh.step_names import read_shapes
from dolfinopt.part.curves import DEGREE, Arc, Curve, Line, Spline
from dolfinopt.part.shape import Piece, Shape

MM = 1e3  # of a metre
HALF = 0.9 * np.pi  # sweep of an arc from which on its ends and centre might mean another one
NEAR = 1e-6  # mm, of vertices in a file from where they were put


def write_step(gmsh: Any, folder: Path, shape: Shape, thickness: float, name: str) -> None:
    """Write NAME_face.step and NAME.step into a folder.

    The face lies in z = 0, its interfaces' edges are named "inboard" and "outboard": `arms.mesh`
    reads it back. The solid goes from there to the thickness; both are products of that name.

    Args:
        gmsh: with a session on this process that uses millimetres.
        folder: exists.
        shape: m.
        thickness: m.
        name: of the arm.
    """
    face, solid = folder / f"{name}_face.step", folder / f"{name}.step"
    _face(gmsh, shape, whole=True)
    _write(gmsh, face, name)
    text = face.read_text(encoding="latin-1")
    face.write_text(_with_names(text, shape.pieces), encoding="latin-1")
    surface = _face(gmsh, shape, whole=False)
    gmsh.model.occ.extrude([(2, surface)], 0.0, 0.0, MM * thickness)
    _write(gmsh, solid, name)


def use_millimetres(gmsh: Any, folder: Path) -> None:
    """Have Open CASCADE write coordinates as they are.

    It keeps the unit of what this process has read last, and converts what it writes from there.
    """
    probe = folder / "unit.step"
    gmsh.clear()
    gmsh.model.occ.addRectangle(0.0, 0.0, 0.0, 1.0, 1.0)
    gmsh.model.occ.synchronize()
    gmsh.write(str(probe))
    gmsh.clear()
    gmsh.option.setString("Geometry.OCCTargetUnit", "MM")
    gmsh.open(str(probe))
    gmsh.clear()
    probe.unlink()


def _face(gmsh: Any, shape: Shape, whole: bool) -> int:
    """Return the plane surface of a shape, mm.

    Args:
        gmsh: with an open session.
        shape: m.
        whole: leave splines whole; or cut them at their knots. Open CASCADE, and what is built on
            it, integrates over an edge by one rule of Gauss: exact for a polynomial, off by up to a
            per cent for a spline of many.
    """
    occ = gmsh.model.occ
    gmsh.clear()
    gmsh.model.add("part")
    loops = []
    spare: list[tuple[int, int]] = []  # points that are no vertices
    for k, loop in enumerate(shape.loops):
        pieces = [one for piece in loop for one in _cut(piece.curve, whole)]
        if k:  # it takes holes for what lies to the left of their curves, too
            pieces = [one.reversed() for one in reversed(pieces)]
        if len(pieces) == 1 and isinstance(pieces[0], Arc):
            curves = [_circle(occ, pieces[0])]
        else:
            # The end of one curve is the beginning of the next.
            corners = [_point(occ, one.start) for one in pieces]
            ends = [*corners[1:], corners[0]]
            curves = [_curve(occ, one, a, b, spare) for one, a, b in zip(pieces, corners, ends)]
        loops.append(occ.addCurveLoop(curves))
    occ.remove(spare)  # or they would be points of the part
    return occ.addPlaneSurface(loops)


def _cut(curve: Curve, whole: bool) -> list[Curve]:
    """Return a curve in pieces: splines cut at their knots or whole, arcs below half a turn."""
    if isinstance(curve, Spline) and not whole:
        knots = np.repeat([0.0, 1.0], DEGREE + 1)
        return [Spline(knots, points) for points in curve.bezier()]
    if isinstance(curve, Arc) and not curve.is_circle and abs(curve.sweep) > HALF:
        count = int(np.ceil(abs(curve.sweep) / HALF))
        part = curve.sweep / count
        return [Arc(curve.centre, curve.radius, curve.begin + k * part, part) for k in range(count)]
    return [curve]


def _point(occ: Any, place: np.ndarray) -> int:
    return occ.addPoint(MM * place[0], MM * place[1], 0.0)


def _circle(occ: Any, arc: Arc) -> int:
    return occ.addCircle(MM * arc.centre[0], MM * arc.centre[1], 0.0, MM * arc.radius)


def _curve(occ: Any, curve: Curve, start: int, end: int, spare: list[tuple[int, int]]) -> int:
    """Return a curve between two points of the model; add its other points to `spare`."""
    if isinstance(curve, Line):
        return occ.addLine(start, end)
    if isinstance(curve, Arc):
        centre = _point(occ, curve.centre)
        spare.append((0, centre))
        return occ.addCircleArc(start, centre, end)
    inner = [_point(occ, p) for p in curve.points[1:-1]]
    spare += [(0, tag) for tag in inner]
    knots, counts = np.unique(curve.knots, return_counts=True)
    return occ.addBSpline(
        [start, *inner, end],
        degree=DEGREE,
        weights=[1.0] * len(curve.points),
        knots=knots.tolist(),
        multiplicities=counts.tolist(),
    )


def _write(gmsh: Any, path: Path, name: str) -> None:
    gmsh.model.occ.synchronize()
    gmsh.write(str(path))
    text = path.read_text(encoding="latin-1")
    text = re.sub(r"'Open CASCADE STEP translator[^']*'", f"'{name}'", text)
    text = text.replace("'Open CASCADE Shape Model'", f"'{path.name}'").replace("'Author'", "''")
    path.write_text(text, encoding="latin-1")


def _with_names(text: str, pieces: Iterable[Piece]) -> str:
    """Return the text of a STEP file in which the edges of interfaces bear their names."""
    wanted = [(_vertices(piece.curve), piece.label) for piece in pieces if piece.label]
    # Its own number as name of every edge, to learn where it is.
    marked = re.sub(r"#(\d+)(\s*=\s*)EDGE_CURVE\(''", r"#\1\2EDGE_CURVE('\1'", text)
    edges, _ = read_shapes(marked)
    names = {
        number: _name_at(vertices[:, :2], wanted)
        for number, vertices in zip(edges.names, edges.vertices, strict=True)
    }
    return re.sub(
        r"EDGE_CURVE\('(\d+)'", lambda found: f"EDGE_CURVE('{names.get(found[1], '')}'", marked
    )


def _vertices(curve: Curve) -> np.ndarray:
    """Return the vertices of a curve in a file (1 or 2, 2), mm."""
    if isinstance(curve, Arc) and curve.is_circle:
        return MM * (curve.centre + np.array([[curve.radius, 0.0]]))
    return MM * np.array([curve.start, curve.end])


def _name_at(vertices: np.ndarray, wanted: Sequence[tuple[np.ndarray, str]]) -> str:
    for points, label in wanted:
        if len(points) == len(vertices):
            apart = np.linalg.norm(points[:, None] - vertices, axis=2)
            if apart.min(axis=0).max() < NEAR and apart.min(axis=1).max() < NEAR:
                return label
    return ""
