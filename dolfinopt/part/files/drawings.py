"""Drawings of a shape for cutters and browsers: DXF and SVG, in millimetres."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from dolfinopt.part.plane.curves import DEGREE, Arc, Curve, Line, Piece, Shape

MM = 1e3  # of a metre
OUTLINE, HOLES = "outline", "holes"  # layers
MARGIN = 5.0  # mm around a picture


def dxf_text(shape: Shape) -> str:
    """Return a DXF of version R2010: lines, arcs, circles and splines on two layers."""
    with _undated():
        document = _document("R2010")
        model = document.modelspace()
        for k, loop in enumerate(shape.loops):
            for piece in loop:
                _draw(model, piece.curve, {"layer": HOLES if k else OUTLINE})
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
            look = {"layer": HOLES if k else OUTLINE}
            if _is_circle(loop):
                _draw(model, loop[0].curve, look)
                continue
            corners = [one for piece in loop for one in _corners(piece.curve, tolerance)]
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
    return document


def _text(document: Any) -> str:
    classes = document.classes
    classes.add_required_classes(document.dxfversion)  # from a set
    classes.classes = dict(sorted(classes.classes.items()))
    stream = io.StringIO()
    document.write(stream)
    return stream.getvalue()


def _is_circle(loop: tuple[Piece, ...]) -> bool:
    return len(loop) == 1 and isinstance(loop[0].curve, Arc) and loop[0].curve.is_circle


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
        pieces = int(np.ceil(abs(curve.sweep) / np.pi))
        places = curve.at(np.arange(pieces) / pieces)
        return [(*_mm(p), float(np.tan(curve.sweep / pieces / 4.0))) for p in places]
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
        f"<title>{_escaped(title)}</title>\n"
        f'<path d="{path}" fill="#b0bec5" fill-rule="evenodd" stroke="#000" stroke-width="0.25"/>\n'
        "</svg>\n"
    )


def _escaped(text: str) -> str:
    from html import escape

    return escape(text, quote=False)


def _path(loop: tuple[Piece, ...]) -> str:
    """Return the commands of a closed path, y downwards."""
    words = [f"M {_xy(loop[0].curve.start)}"]
    for piece in loop:
        curve = piece.curve
        if isinstance(curve, Line):
            words.append(f"L {_xy(curve.end)}")
        elif isinstance(curve, Arc):
            words += _arcs(curve)
        else:
            for _, b, c, d in curve.bezier():
                words.append(f"C {_xy(b)} {_xy(c)} {_xy(d)}")
    return " ".join([*words, "Z"])


def _arcs(arc: Arc) -> list[str]:
    """Return an arc in pieces of half a turn at most, which the format cannot mistake."""
    pieces = int(np.ceil(abs(arc.sweep) / np.pi - 1e-9))
    radius, side = f"{MM * arc.radius:.12g}", int(arc.sweep < 0.0)
    places = arc.at(np.arange(1, pieces + 1) / pieces)
    return [f"A {radius} {radius} 0 0 {side} {_xy(p)}" for p in places]


def _xy(point: np.ndarray) -> str:
    return f"{MM * point[0]:.12g} {-MM * point[1]:.12g}"
