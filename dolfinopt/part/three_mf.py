"""3MF (3D Manufacturing Format, core specification 1.3): surfaces of triangles, in millimetres."""

from __future__ import annotations

import io
import zipfile
from xml.sax.saxutils import quoteattr

import numpy as np

from dolfinopt.part.isosurface import Surface
from dolfinopt.part.solid import MM

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
