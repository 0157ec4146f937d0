"""Surfaces of parts in triangles, watertight: STL, and 3MF in millimetres.

3MF (3D Manufacturing Format, core specification 1.3).
"""

from __future__ import annotations

import io
import zipfile
from xml.sax.saxutils import quoteattr

import numpy as np

from dolfinopt.part.solid.surface import Surface

MM = 1e3  # of a metre


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
    flat = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3]
    twice = (flat[:, 1, 0] - flat[:, 0, 0]) * (flat[:, 2, 1] - flat[:, 0, 1])
    twice -= (flat[:, 2, 0] - flat[:, 0, 0]) * (flat[:, 1, 1] - flat[:, 0, 1])
    flat[twice < 0.0] = flat[twice < 0.0][:, ::-1]
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
