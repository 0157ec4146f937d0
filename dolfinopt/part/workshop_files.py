"""Files for the workshop: STEP, DXF and SVG of a shape's curves, STL and 3MF of surfaces.

STEP (ISO 10303-21, AP214), of a shape its face in z = 0, and the solid: a plate needs few kinds of
entities, and only its own file can name edges and have the same bytes for the same shape. 3MF is
the 3D Manufacturing Format, core specification 1.3. All but STL are in millimetres.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from dolfinopt.part.plane.curves import DEGREE, MM, Arc, Curve, Line, Piece, Shape, Spline, is_ring
from dolfinopt.part.solid.surface import Surface

HALF = 0.9 * np.pi  # sweep of an arc from which on it is divided
DATE = "2000-01-01T00:00:00"  # of all files, as in DXF: a shape always gives the same bytes
UP = np.array([0.0, 0.0, 1.0])
NamedCurves = Sequence[tuple[Curve, str]]  # a closed loop, each curve with its name


def face_text(shape: Shape, name: str) -> str:
    """Return a STEP file with the face in z = 0 as product `name`.

    The edges of interfaces are named "inboard" and "outboard": `arms.mesh` reads the file back.
    Splines are cut at their knots, see `solid_text`.
    """
    file = _File()
    loops = [_edges(loop) for loop in shape.loops]
    face = _flat_face(file, loops, 0.0, upwards=True)
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
    loops = [_edges(loop) for loop in shape.loops]
    z0, z1 = MM * bottom, MM * (bottom + thickness)
    faces = [_flat_face(file, loops, z0, upwards=False), _flat_face(file, loops, z1, upwards=True)]
    for loop in loops:
        faces += _walls(file, loop, z0, z1)
    shell = file.add(f"CLOSED_SHELL('',({','.join(faces)}))")
    solid = file.add(f"MANIFOLD_SOLID_BREP({_string(name)},{shell})")
    return file.text(name, f"{name}.step", "ADVANCED_BREP_SHAPE_REPRESENTATION", solid)


# -- STEP: curves ------------------------------------------------------------------------------


def _edges(loop: tuple[Piece, ...]) -> list[tuple[Curve, str]]:
    """Return a loop's curves and their names: arcs below half a turn, splines by polynomials."""
    if is_ring(loop[0].curve):
        return [(loop[0].curve, loop[0].label)]
    return [(curve, piece.label) for piece in loop for curve in _divided(piece.curve)]


def _divided(curve: Curve) -> list[Curve]:
    """Return the polynomials of a spline, or arcs below half a turn, which no format mistakes."""
    if isinstance(curve, Spline):
        knots = np.repeat([0.0, 1.0], DEGREE + 1)
        return [Spline(knots, points) for points in curve.bezier()]
    if not isinstance(curve, Arc):
        return [curve]
    count = int(np.ceil(abs(curve.sweep) / HALF))
    part = curve.sweep / count
    return [Arc(curve.centre, curve.radius, curve.begin + k * part, part) for k in range(count)]


# -- STEP: topology ----------------------------------------------------------------------------


def _edges_at(file: _File, loop: NamedCurves, z: float) -> list[str]:
    """Add a loop's edges at a height, mm, and return them; each ends where the next one begins."""
    corners, result = [file.vertex(curve.start, z) for curve, _ in loop], []
    for (curve, name), a, b in zip(loop, corners, [*corners[1:], corners[0]], strict=True):
        entity, along = file.curve(curve, z)
        result.append(file.add(f"EDGE_CURVE({_string(name)},{a},{b},{entity},{_truth(along)})"))
    return result


def _walls(file: _File, loop: NamedCurves, z0: float, z1: float) -> list[str]:
    """Add the faces between a loop's edges at two heights, mm; outwards is to the right."""
    posts, result = [], []
    for curve, _ in loop:
        a, b = (file.vertex(curve.start, z) for z in (z0, z1))
        line, _ = file.line(curve.start, z0, UP)
        posts.append(file.add(f"EDGE_CURVE('',{a},{b},{line},.T.)"))
    edges = (_edges_at(file, loop, z) for z in (z0, z1))
    for (curve, name), low, high, post, after in zip(
        loop, *edges, posts, [*posts[1:], posts[0]], strict=True
    ):
        sides = [(low, ".T."), (after, ".T."), (high, ".F."), (post, ".F.")]
        bound = _bound(file, sides, ".T.")
        surface, outwards = file.wall(curve, z0)
        sense = _truth(outwards)
        result.append(file.add(f"ADVANCED_FACE({_string(name)},({bound}),{surface},{sense})"))
    return result


def _bound(file: _File, sides: Iterable[tuple[str, str]], sense: str) -> str:
    edges = ",".join(file.add(f"ORIENTED_EDGE('',*,*,{edge},{way})") for edge, way in sides)
    loop = file.add(f"EDGE_LOOP('',({edges}))")
    return file.add(f"FACE_BOUND('',{loop},{sense})")


def _flat_face(file: _File, loops: Sequence[NamedCurves], z: float, upwards: bool) -> str:
    """Add the plane face within loops at a height, material to their left from above."""
    # The other way round, as the faces beside it need these edges.
    way, sense, step = (".F.", ".T.", -1) if upwards else (".T.", ".F.", 1)
    bounds = []
    for loop in loops:
        edges = [(edge, way) for edge in _edges_at(file, loop, z)[::step]]
        bounds.append(_bound(file, edges, ".F."))
    plane = file.add(f"PLANE('',{file.axes(np.zeros(2), z)})")
    return file.add(f"ADVANCED_FACE('',({','.join(bounds)}),{plane},{sense})")


# -- STEP: entities ----------------------------------------------------------------------------


class _File:
    """The entities of a file, numbered from 1; plane points are in m, heights in mm."""

    def __init__(self) -> None:
        self.entities: dict[str, str] = {}

    def add(self, entity: str) -> str:
        """Return the number of an entity, which is added unless it is there."""
        # Points, directions and axes that edges and faces share: half of the file's size.
        return self.entities.setdefault(entity, f"#{len(self.entities) + 1}")

    def point(self, place: np.ndarray, z: float) -> str:
        return self.add(f"CARTESIAN_POINT('',({','.join(map(_length, [*MM * place, z]))}))")

    def vertex(self, place: np.ndarray, z: float) -> str:
        return self.add(f"VERTEX_POINT('',{self.point(place, z)})")

    def direction(self, way: np.ndarray) -> tuple[str, bool]:
        """Add a direction, or the opposite one; return it and whether it is this one.

        Its largest component is 1: parallel sides share it.
        """
        largest = way[np.argmax(np.abs(way))]
        return self.add(f"DIRECTION('',{_reals(way / largest + 0.0)})"), bool(largest > 0.0)

    def line(self, start: np.ndarray, z: float, way: np.ndarray) -> tuple[str, bool]:
        """Add a line from a point; return it and whether it runs this way."""
        direction, along = self.direction(way)
        vector = self.add(f"VECTOR('',{direction},1.)")
        return self.add(f"LINE('',{self.point(start, z)},{vector})"), along

    def axes(self, at: np.ndarray, z: float, directions: str = "$,$") -> str:
        """Add axes; by default with the directions of the file's own."""
        return self.add(f"AXIS2_PLACEMENT_3D('',{self.point(at, z)},{directions})")

    def curve(self, curve: Curve, z: float) -> tuple[str, bool]:
        """Add a curve at a height; return it and whether it runs this way."""
        if isinstance(curve, Line):
            return self.line(curve.start, z, np.append(curve.end - curve.start, 0.0))
        if isinstance(curve, Arc):
            axes = self.axes(curve.centre, z)
            circle = self.add(f"CIRCLE('',{axes},{_length(MM * curve.radius)})")
            return circle, curve.sweep > 0.0
        points = ",".join(self.point(p, z) for p in curve.points)
        knots, counts = np.unique(curve.knots, return_counts=True)
        return self.add(
            f"B_SPLINE_CURVE_WITH_KNOTS('',{DEGREE},({points}),.UNSPECIFIED.,.F.,.F.,"
            f"({','.join(map(str, counts.tolist()))}),{_reals(knots)},.UNSPECIFIED.)"
        ), True

    def wall(self, curve: Curve, z: float) -> tuple[str, bool]:
        """Add the upright surface through a curve; return it and whether it points outwards."""
        if isinstance(curve, Line):
            x, y = curve.end - curve.start
            normal, outwards = self.direction(np.array([y, -x, 0.0]))
            return self.add(f"PLANE('',{self.axes(curve.start, z, f'{normal},$')})"), outwards
        if isinstance(curve, Arc):
            radius = _length(MM * curve.radius)
            surface = f"CYLINDRICAL_SURFACE('',{self.axes(curve.centre, z)},{radius})"
            return self.add(surface), curve.sweep > 0.0
        direction, _ = self.direction(UP)
        upright = self.add(f"VECTOR('',{direction},1.)")
        swept, _ = self.curve(curve, z)
        return self.add(f"SURFACE_OF_LINEAR_EXTRUSION('',{swept},{upright})"), True

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
        origin = self.axes(np.zeros(2), 0.0)
        representation = add(f"{kind}({title},({origin},{item}),{self._units()})")
        add(f"SHAPE_DEFINITION_REPRESENTATION({of},{representation})")
        head = (
            "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION(('a part made by dolfinopt'),'2;1');\n"
            f"FILE_NAME({_string(file)},'{DATE}',(''),(''),'dolfinopt','dolfinopt','');\n"
            "FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));\nENDSEC;\nDATA;\n"
        )
        lines = [f"{number}={entity};" for entity, number in self.entities.items()]
        return head + "\n".join(lines) + "\nENDSEC;\nEND-ISO-10303-21;\n"

    def _units(self) -> str:
        """Add millimetres, radians and the accuracy of coordinates; return the context."""
        length = self.add("(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.))")
        angle = self.add("(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))")
        solid = self.add("(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())")
        accuracy = self.add(
            f"UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-05),{length},"
            "'distance_accuracy_value','accuracy of coordinates')"
        )
        return self.add(
            f"(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT(({accuracy}))"
            f"GLOBAL_UNIT_ASSIGNED_CONTEXT(({length},{angle},{solid}))"
            "REPRESENTATION_CONTEXT('','3D'))"
        )


def _truth(value: bool) -> str:
    return ".T." if value else ".F."


def _real(value: float) -> str:
    """Return a number with a decimal point, as the format wants it, to ten digits."""
    mantissa, *exponent = f"{value:.10g}".split("e")
    mantissa += "" if "." in mantissa else "."
    return "E".join([mantissa, *exponent])


def _length(value: float) -> str:
    """Return a length, mm, to the 1e-5 mm that CAD resolves."""
    return _real(round(value, 5) + 0.0)


def _reals(values: Iterable[float]) -> str:
    return f"({','.join(map(_real, values))})"


def _string(text: str) -> str:
    """Return a string in quotes; letters beyond ASCII by their numbers."""
    coded = "".join(
        item if " " <= item <= "~" else f"\\X2\\{item.encode('utf-16-be').hex().upper()}\\X0\\"
        for item in text.replace("\\", "\\\\").replace("'", "''")
    )
    return f"'{coded}'"


# -- drawings for cutters and browsers: DXF and SVG --------------------------------------------


OUTLINE, HOLES, BORES = "outline", "holes", "bores"  # layers
MARGIN = 5.0  # mm around a picture


def dxf_text(shape: Shape) -> str:
    """Return a DXF of version R2010: lines, arcs, circles and the arm's own splines."""
    with _undated():
        document = _document("R2010")
        model = document.modelspace()
        for k, loop in enumerate(shape.loops):
            for piece in loop:
                _draw(model, piece.curve, {"layer": _layer(k, loop)})
        return _text(document)


def r12_text(shape: Shape, tolerance: float) -> str:
    """Return a DXF of version R12: closed polylines and circles.

    Args:
        shape: m.
        tolerance: of chords in place of splines, m; arcs stay arcs, as bulges.
    """
    with _undated():
        document = _document("R12")
        model = document.modelspace()
        for k, loop in enumerate(shape.loops):
            look = {"layer": _layer(k, loop)}
            if is_ring(loop[0].curve):
                _draw(model, loop[0].curve, look)
                continue
            corners = [corner for piece in loop for corner in _corners(piece.curve, tolerance)]
            model.add_polyline2d(corners, format="xyb", close=True, dxfattribs=look)
        return _text(document)


@contextmanager
def _undated() -> Iterator[None]:
    """Have documents made and written without dates and random numbers: a shape gives its bytes."""
    from ezdxf import options

    before = options.write_fixed_meta_data_for_testing
    options.write_fixed_meta_data_for_testing = True
    try:
        yield
    finally:
        options.write_fixed_meta_data_for_testing = before


def _document(version: str) -> Any:
    import ezdxf
    from ezdxf import units

    # R12 knows no units.
    document = ezdxf.new(version, units=0 if version == "R12" else units.MM)
    document.header["$MEASUREMENT"] = 1
    document.layers.add(OUTLINE, color=7)
    document.layers.add(HOLES, color=1)
    document.layers.add(BORES, color=5)
    return document


def _text(document: Any) -> str:
    classes = document.classes
    classes.add_required_classes(document.dxfversion)  # from a set
    classes.classes = dict(sorted(classes.classes.items()))
    stream = io.StringIO()
    document.write(stream)
    return stream.getvalue()


def _layer(number: int, loop: tuple[Piece, ...]) -> str:
    """Return the layer of a loop: round holes of the arm's own are bores."""
    if number and is_ring(loop[0].curve) and not loop[0].free:
        return BORES
    return HOLES if number else OUTLINE


def _draw(model: Any, curve: Curve, look: dict[str, Any]) -> None:
    if isinstance(curve, Line):
        model.add_line(_mm(curve.start), _mm(curve.end), dxfattribs=look)
    elif isinstance(curve, Arc):
        if curve.is_circle:
            model.add_circle(_mm(curve.centre), MM * curve.radius, dxfattribs=look)
            return
        # Counterclockwise, as the format has them.
        first, last = sorted((curve.begin, curve.begin + curve.sweep))
        angles = np.degrees([first, last])
        model.add_arc(_mm(curve.centre), MM * curve.radius, *angles, dxfattribs=look)
    else:
        spline = model.add_spline(degree=DEGREE, dxfattribs=look)
        spline.control_points = [(*_mm(p), 0.0) for p in curve.points]
        spline.knots = curve.knots.tolist()


def _mm(point: np.ndarray) -> tuple[float, float]:
    return float(MM * point[0]), float(MM * point[1])


def _corners(curve: Curve, tolerance: float) -> list[tuple[float, float, float]]:
    """Return corners of a polyline along a curve, without the last: x, y in mm, and bulge."""
    if isinstance(curve, Arc):
        arcs = [part for part in _divided(curve) if isinstance(part, Arc)]
        return [(*_mm(arc.start), float(np.tan(arc.sweep / 4.0))) for arc in arcs]
    return [(*_mm(p), 0.0) for p in curve.at(curve.parameters(tolerance)[:-1])]


def svg_text(shape: Shape, title: str) -> str:
    """Return an SVG picture to scale: the filled part, its size in millimetres; y points up."""
    points = MM * np.vstack(shape.polygons(1e-5))
    low, high = points.min(axis=0) - MARGIN, points.max(axis=0) + MARGIN
    width, height = high - low
    path = " ".join(_path(loop) for loop in shape.loops)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.6g}mm" height="{height:.6g}mm" '
        f'viewBox="{low[0]:.9g} {-high[1]:.9g} {width:.9g} {height:.9g}">\n'
        f"<title>{escape(title)}</title>\n"
        f'<path d="{path}" fill="#b0bec5" fill-rule="evenodd" stroke="#000" stroke-width="0.25"/>\n'
        "</svg>\n"
    )


def _path(loop: tuple[Piece, ...]) -> str:
    """Return the commands of a closed path, y downwards."""
    words = [f"M {_xy(loop[0].curve.start)}"]
    for curve in (part for piece in loop for part in _divided(piece.curve)):
        if isinstance(curve, Line):
            words.append(f"L {_xy(curve.end)}")
        elif isinstance(curve, Arc):
            radius, side = f"{MM * curve.radius:.12g}", int(curve.sweep < 0.0)
            words.append(f"A {radius} {radius} 0 0 {side} {_xy(curve.end)}")
        else:
            words.append(f"C {' '.join(map(_xy, curve.points[1:]))}")
    return " ".join([*words, "Z"])


def _xy(point: np.ndarray) -> str:
    return f"{MM * point[0]:.12g} {-MM * point[1]:.12g}"


# -- surfaces in triangles, watertight: STL and 3MF --------------------------------------------


def triangle_bytes(corners: np.ndarray, title: str) -> bytes:
    """Return a binary STL of triangles, in single precision.

    Args:
        corners: (n, 3, 3) of every triangle, counterclockwise from outside.
        title: for the header, which is the place to name the unit.
    """
    data = np.zeros(len(corners), dtype=[("n", "<f4", 3), ("p", "<f4", (3, 3)), ("a", "<u2")])
    data["p"] = corners
    a, b, c = (data["p"][:, k].astype(float) for k in range(3))
    normal = np.cross(b - a, c - a)
    data["n"] = normal / np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    head = title.encode("ascii", "replace")[:80].ljust(80)
    return head + np.uint32(len(corners)).tobytes() + data.tobytes()


def extruded_facets(loops: list[np.ndarray], thickness: float) -> np.ndarray:
    """Return the corners (n, 3, 3) of the facets, m, counterclockwise from outside."""
    import shapely

    # As the file will have them: corners that fall together there must not be two here.
    loops = [_rounded(loop) for loop in loops]
    polygon = shapely.Polygon(loops[0], loops[1:])
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(polygon))
    triangles = shapely.orient_polygons(triangles)
    flat = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3]
    top, bottom = _lifted(flat, thickness), _lifted(flat[:, ::-1], 0.0)
    walls = []
    for loop in loops:
        after = np.roll(loop, -1, axis=0)
        a, b = _lifted(loop, 0.0), _lifted(after, 0.0)
        c, d = _lifted(after, thickness), _lifted(loop, thickness)
        walls += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    return np.concatenate([bottom, top, *walls])


def _rounded(loop: np.ndarray) -> np.ndarray:
    """Return a loop's corners as single precision in mm has them, none twice in a row."""
    points = (MM * loop).astype(np.float32).astype(float) / MM
    return points[(points != np.roll(points, 1, axis=0)).any(axis=1)]


def _lifted(points: np.ndarray, z: float) -> np.ndarray:
    return np.concatenate([points, np.full((*points.shape[:-1], 1), z)], axis=-1)


CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
PACKAGE = "http://schemas.openxmlformats.org/package/2006"
HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n'
TYPES = (
    f'{HEAD}<Types xmlns="{PACKAGE}/content-types">'
    '<Default Extension="rels" '
    'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" '
    'ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>'
)
RELATIONS = (
    f'{HEAD}<Relationships xmlns="{PACKAGE}/relationships">'
    '<Relationship Target="/3D/3dmodel.model" Id="rel0" '
    'Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>'
)
FIRST_DAY = (1980, 1, 1, 0, 0, 0)  # of ZIP: the same part gives the same bytes


def three_mf_bytes(surface: Surface, name: str) -> bytes:
    """Return a 3MF file of one object, its corners to 1e-9 mm.

    Args:
        surface: closed, m.
        name: of the object.
    """
    vertices = "".join(
        f'<vertex x="{x:.9f}" y="{y:.9f}" z="{z:.9f}"/>\n'
        for x, y, z in np.asarray(MM * surface.points + 0.0)
    )
    triangles = "".join(
        '<triangle v1="{}" v2="{}" v3="{}"/>\n'.format(*corners)
        for corners in np.asarray(surface.triangles).tolist()
    )
    model = (
        f'{HEAD}<model unit="millimeter" xml:lang="en" xmlns="{CORE}">\n<resources>\n'
        f'<object id="1" type="model" name={quoteattr(name)}><mesh>\n'
        f"<vertices>\n{vertices}</vertices>\n<triangles>\n{triangles}</triangles>\n"
        '</mesh></object>\n</resources>\n<build><item objectid="1"/></build>\n</model>\n'
    )
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        for path, text in (
            ("[Content_Types].xml", TYPES),
            ("_rels/.rels", RELATIONS),
            ("3D/3dmodel.model", model),
        ):
            entry = zipfile.ZipInfo(path, FIRST_DAY)
            file.writestr(entry, text, compress_type=zipfile.ZIP_DEFLATED)
    return stream.getvalue()
