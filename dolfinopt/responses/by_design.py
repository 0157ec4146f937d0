"""Gradients by the physical design x_phys of an arm, whatever its kind."""

from __future__ import annotations

import numpy as np

from dolfinopt.arms.design_state import DesignState
from dolfinopt.responses.products import Products
from dolfinopt.responses.shape_sensitivity import by_nodes


def by_design(state: DesignState, products: Products) -> np.ndarray:
    """Return the gradient by x_phys (n_cells,), over this rank's cells (collective)."""
    wall = state.kind.wall
    if wall is None:
        return by_densities(state, products)
    return wall.backward(by_nodes(state, products))


def by_densities(state: DesignState, products: Products) -> np.ndarray:
    """Return the gradient by the physical densities (n_cells,), over this rank's cells."""
    elastic, pairs = state.elastic, products.stiffness
    energies, masses = np.zeros((2, len(state.x_phys)))
    if products.geometric is not None:
        (left, V), *pairs = pairs
        energies += products.geometric.by_young_beside(left, V)
    for left, right in pairs:
        energies += elastic.cell_stiffness_products(left, right)
    for left, right in products.mass:
        masses += elastic.cell_mass_products(left, right)
    if products.prestress is not None:
        energies += products.prestress.direct
    found = state.young_slope * energies + state.density_slope * masses
    return found if products.densities is None else found + products.densities
