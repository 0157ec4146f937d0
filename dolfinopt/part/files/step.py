"""STEP files (ISO 10303-21, AP214) of a shape: its face in z = 0, and the solid; in millimetres.

A plate needs few kinds of entities, and only its own file can name edges and have the same bytes
for the same shape.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from dolfinopt.part.plane.curves import DEGREE, Arc, Curve, Line, Piece, Shape, Spline

MM = 1e3  # of a metre
HALF = 0.9 * np.pi  # sweep of an arc from which on it is divided
DATE = "2000-01-01T00:00:00"  # of all files, as in DXF: a shape always gives the same bytes
UP = (0.0, 0.0, 1.0)


def face_text(shape: Shape, name: str) -> str:
    """Return a STEP file with the face in z = 0 as product `name`.

    The edges of interfaces are named "inboard" and "outboard": `arms.mesh` reads the file back.
    """
    file = _File()
    loops = [_Loop(file, _whole(loop)) for loop in shape.loops]
    edges = [loop.edges(0.0) for loop in loops]
    face = _flat_face(file, edges, 0.0, upwards=True)
    shell = file.add(f"OPEN_SHELL('',({face}))")
    model = file.add(f"SHELL_BASED_SURFACE_MODEL({_string(name)},({shell}))")
    return file.text(name, f"{name}_face.step", "MANIFOLD_SURFACE_SHAPE_REPRESENTATION", model)


def solid_text(shape: Shape, thickness: float, name: str, bottom: float = 0.0) -> str:
    """Return a STEP file with one solid from z = `bottom` over a thickness, m, as product `name`.

    Splines are cut at their knots: Open CASCADE, and what is built on it, integrates over an edge
    by one rule of Gauss. It is exact for a polynomial, and off by up to some per cent for a spline
    of many.
    """
    file = _File()
    loops = [_Loop(file, _cut(loop)) for loop in shape.loops]
    z0, z1 = MM * bottom, MM * (bottom + thickness)
    below = [loop.edges(z0) for loop in loops]
    above = [loop.edges(z1) for loop in loops]
    faces = [
        _flat_face(file, below, z0, upwards=False),
        _flat_face(file, above, z1, upwards=True),
    ]
    for loop, low, high in zip(loops, below, above, strict=True):
        faces += loop.walls(low, high)
    shell = file.add(f"CLOSED_SHELL('',({','.join(faces)}))")
    solid = file.add(f"MANIFOLD_SOLID_BREP({_string(name)},{shell})")
    return file.text(name, f"{name}.step", "ADVANCED_BREP_SHAPE_REPRESENTATION", solid)


# -- curves ------------------------------------------------------------------------------------


def _whole(loop: Iterable[Piece]) -> list[tuple[Curve, str]]:
    """Return a loop's curves and their names; arcs, but for circles, below half a turn."""
    return [(one, piece.label) for piece in loop for one in _arcs(piece.curve)]


def _arcs(curve: Curve) -> list[Curve]:
    if not isinstance(curve, Arc) or curve.is_circle or abs(curve.sweep) <= HALF:
        return [curve]
    count = int(np.ceil(abs(curve.sweep) / HALF))
    part = curve.sweep / count
    return [Arc(curve.centre, curve.radius, curve.begin + k * part, part) for k in range(count)]


def _cut(loop: Iterable[Piece]) -> list[tuple[Curve, str]]:
    """Return a loop's curves, every one a line, an arc or a single polynomial."""
    knots = np.repeat([0.0, 1.0], DEGREE + 1)
    return [
        (one, name)
        for curve, name in _whole(loop)
        for one in (
            [Spline(knots, points) for points in curve.bezier()]
            if isinstance(curve, Spline)
            else [curve]
        )
    ]


# -- topology ----------------------------------------------------------------------------------


class _Loop:
    """A closed loop of curves, its edges at any height, and the walls between two of them."""

    def __init__(self, file: _File, curves: Sequence[tuple[Curve, str]]):
        self.file, self.curves = file, curves
        self.vertices: dict[float, list[str]] = {}

    def edges(self, z: float) -> list[str]:
        """Add the edges at a height, mm, and return them; each ends where the next one begins."""
        file = self.file
        corners = [file.vertex(curve.start, z) for curve, _ in self.curves]
        self.vertices[z] = corners
        found = []
        for k, (curve, name) in enumerate(self.curves):
            ends = f"{corners[k]},{corners[(k + 1) % len(corners)]}"
            sense = ".F." if isinstance(curve, Arc) and curve.sweep < 0.0 else ".T."
            found.append(
                file.add(f"EDGE_CURVE({_string(name)},{ends},{file.curve(curve, z)},{sense})")
            )
        return found

    def walls(self, low: Sequence[str], high: Sequence[str]) -> list[str]:
        """Add the faces between edges at two heights and return them; outwards is to the right."""
        (z, below), (_, above) = self.vertices.items()
        file = self.file
        posts = []
        for (curve, _), a, b in zip(self.curves, below, above, strict=True):
            line = f"LINE('',{file.point(curve.start, z)},{file.vector(UP)})"
            posts.append(file.add(f"EDGE_CURVE('',{a},{b},{file.add(line)},.T.)"))
        found = []
        for k, (curve, name) in enumerate(self.curves):
            after = posts[(k + 1) % len(posts)]
            sides = [(low[k], ".T."), (after, ".T."), (high[k], ".F."), (posts[k], ".F.")]
            bound = _bound(file, sides)
            surface, sense = file.wall(curve, z)
            found.append(file.add(f"ADVANCED_FACE({_string(name)},({bound}),{surface},{sense})"))
        return found


def _bound(file: _File, sides: Iterable[tuple[str, str]]) -> str:
    edges = ",".join(file.add(f"ORIENTED_EDGE('',*,*,{edge},{sense})") for edge, sense in sides)
    loop = file.add(f"EDGE_LOOP('',({edges}))")
    return file.add(f"FACE_BOUND('',{loop},.T.)")


def _flat_face(file: _File, loops: Sequence[Sequence[str]], z: float, upwards: bool) -> str:
    """Add the plane face within loops of edges, whose material is to their left from above."""
    bounds = [
        _bound(
            file, [(e, ".T.") for e in loop] if upwards else [(e, ".F.") for e in reversed(loop)]
        )
        for loop in loops
    ]
    plane = file.add(f"PLANE('',{file.axes(np.zeros(2), z, UP, (1.0, 0.0, 0.0))})")
    sense = ".T." if upwards else ".F."
    return file.add(f"ADVANCED_FACE('',({','.join(bounds)}),{plane},{sense})")


# -- entities ----------------------------------------------------------------------------------


class _File:
    """The entities of a file, numbered from 1; plane points are in m, heights in mm."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def add(self, entity: str) -> str:
        """Add an entity and return its number."""
        self.lines.append(f"#{len(self.lines) + 1} = {entity};")
        return f"#{len(self.lines)}"

    def point(self, place: np.ndarray, z: float) -> str:
        return self.add(f"CARTESIAN_POINT('',{_reals((MM * place[0], MM * place[1], z))})")

    def vertex(self, place: np.ndarray, z: float) -> str:
        return self.add(f"VERTEX_POINT('',{self.point(place, z)})")

    def direction(self, along: Sequence[float]) -> str:
        return self.add(f"DIRECTION('',{_reals(along)})")

    def vector(self, along: Sequence[float]) -> str:
        return self.add(f"VECTOR('',{self.direction(along)},1.)")

    def axes(self, at: np.ndarray, z: float, up: Sequence[float], ahead: Sequence[float]) -> str:
        origin, axis, first = self.point(at, z), self.direction(up), self.direction(ahead)
        return self.add(f"AXIS2_PLACEMENT_3D('',{origin},{axis},{first})")

    def curve(self, curve: Curve, z: float) -> str:
        """Add a curve at a height; circles counterclockwise."""
        if isinstance(curve, Line):
            return self.add(f"LINE('',{self.point(curve.start, z)},{self.vector(_along(curve))})")
        if isinstance(curve, Arc):
            axes = self.axes(curve.centre, z, UP, (1.0, 0.0, 0.0))
            return self.add(f"CIRCLE('',{axes},{_real(MM * curve.radius)})")
        points = ",".join(self.point(p, z) for p in curve.points)
        knots, counts = np.unique(curve.knots, return_counts=True)
        return self.add(
            f"B_SPLINE_CURVE_WITH_KNOTS('',{DEGREE},({points}),.UNSPECIFIED.,.F.,.F.,"
            f"({','.join(map(str, counts.tolist()))}),{_reals(knots)},.UNSPECIFIED.)"
        )

    def wall(self, curve: Curve, z: float) -> tuple[str, str]:
        """Add the upright surface through a curve; return it and whether it points outwards."""
        if isinstance(curve, Line):
            x, y, _ = _along(curve)
            axes = self.axes(curve.start, z, (y, -x, 0.0), (x, y, 0.0))
            return self.add(f"PLANE('',{axes})"), ".T."
        if isinstance(curve, Arc):
            axes = self.axes(curve.centre, z, UP, (1.0, 0.0, 0.0))
            surface = self.add(f"CYLINDRICAL_SURFACE('',{axes},{_real(MM * curve.radius)})")
            return surface, ".T." if curve.sweep > 0.0 else ".F."
        swept = self.curve(curve, z)
        return self.add(f"SURFACE_OF_LINEAR_EXTRUSION('',{swept},{self.vector(UP)})"), ".T."

    def text(self, name: str, file: str, kind: str, item: str) -> str:
        """Return the file of a product with one representation item."""
        add, title = self.add, _string(name)
        application = add("APPLICATION_CONTEXT('automotive design')")
        add(
            "APPLICATION_PROTOCOL_DEFINITION('international standard','automotive_design',2000,"
            f"{application})"
        )
        context = add(f"PRODUCT_CONTEXT('',{application},'mechanical')")
        product = add(f"PRODUCT({title},{title},'',({context}))")
        add(f"PRODUCT_RELATED_PRODUCT_CATEGORY('part','',({product}))")
        formation = add(f"PRODUCT_DEFINITION_FORMATION('','',{product})")
        stage = add(f"PRODUCT_DEFINITION_CONTEXT('part definition',{application},'design')")
        definition = add(f"PRODUCT_DEFINITION('design','',{formation},{stage})")
        of = add(f"PRODUCT_DEFINITION_SHAPE('','',{definition})")
        origin = self.axes(np.zeros(2), 0.0, UP, (1.0, 0.0, 0.0))
        representation = add(f"{kind}({title},({origin},{item}),{self._units()})")
        add(f"SHAPE_DEFINITION_REPRESENTATION({of},{representation})")
        head = (
            "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION(('a part made by dolfinopt'),'2;1');\n"
            f"FILE_NAME({_string(file)},'{DATE}',(''),(''),'dolfinopt','dolfinopt','');\n"
            "FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));\nENDSEC;\nDATA;\n"
        )
        return head + "\n".join(self.lines) + "\nENDSEC;\nEND-ISO-10303-21;\n"

    def _units(self) -> str:
        """Add millimetres, radians and the accuracy of coordinates; return the context."""
        length = self.add("(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.))")
        angle = self.add("(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))")
        solid = self.add("(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())")
        accuracy = self.add(
            f"UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-06),{length},"
            "'distance_accuracy_value','accuracy of coordinates')"
        )
        return self.add(
            f"(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT(({accuracy}))"
            f"GLOBAL_UNIT_ASSIGNED_CONTEXT(({length},{angle},{solid}))"
            "REPRESENTATION_CONTEXT('','3D'))"
        )


def _along(line: Line) -> tuple[float, float, float]:
    x, y = line.end - line.start
    size = float(np.hypot(x, y))
    return float(x) / size, float(y) / size, 0.0


def _real(value: float) -> str:
    """Return a number with a decimal point, as the format wants it."""
    mantissa, *exponent = f"{value:.15g}".split("e")
    mantissa += "" if "." in mantissa else "."
    return "E".join([mantissa, *exponent])


def _reals(values: Iterable[float]) -> str:
    return f"({','.join(map(_real, values))})"


def _string(text: str) -> str:
    """Return a string in quotes; letters beyond ASCII by their numbers."""
    coded = "".join(
        one if " " <= one <= "~" else f"\\X2\\{one.encode('utf-16-be').hex().upper()}\\X0\\"
        for one in text.replace("\\", "\\\\").replace("'", "''")
    )
    return f"'{coded}'"
