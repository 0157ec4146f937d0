"""Finite elements: one file each, of `base.Element`'s protocol; `ELEMENTS` lists them by name.

`element_of` chooses one for a mesh.
"""

from __future__ import annotations

from dolfinopt.errors import InputError
from dolfinopt.fem.elements.base import (
    Element,
    ElementOperators,
    elasticity,
    plane_stress,
    strains,
)
from dolfinopt.fem.elements.geometry import gauss_points
from dolfinopt.fem.elements.incompatible import IncompatibleElement
from dolfinopt.fem.elements.lagrange import LagrangeElement
from dolfinopt.fem.elements.quadrature import Quadrature, quadrature
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.scene.tables.arms import DEFAULT_ELEMENT, CellShape

__all__ = [
    "ELEMENTS",
    "Element",
    "ElementOperators",
    "IncompatibleElement",
    "LagrangeElement",
    "Quadrature",
    "elasticity",
    "element_of",
    "gauss_points",
    "plane_stress",
    "quadrature",
    "strains",
]

ELEMENTS: dict[str, Element] = {
    "incompatible": IncompatibleElement(),
    "linear": LagrangeElement(1),
    "quadratic": LagrangeElement(2),
}


CELL_SHAPES: dict[tuple[int, int], CellShape] = {
    (2, 3): "triangle",
    (2, 4): "quadrilateral",
    (3, 4): "tetrahedron",
    (3, 8): "hexahedron",
}
SIMPLICES = {"triangle": "triangles", "tetrahedron": "tetrahedra"}


def element_of(mesh: ArmMesh, name: str | None) -> Element:
    """Return the element called `name`, or the default of the mesh's cells where it is None.

    Raises:
        InputError: there is no such element of these cells; the same on all ranks.
    """
    shape = CELL_SHAPES[mesh.dim, compat.cell_corner_count(mesh.mesh)]
    name = name or DEFAULT_ELEMENT[shape]
    if name == "incompatible" and shape in SIMPLICES:
        raise InputError(
            f'arms.{mesh.name}.element = "incompatible": expected "linear" or "quadratic", the '
            f"mesh has {SIMPLICES[shape]}"
        )
    return ELEMENTS[name]
