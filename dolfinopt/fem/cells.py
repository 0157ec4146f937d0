"""Nodal fields on cells, and energies cell by cell: derivatives by the material of each cell.

d is the number of directions.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from dolfinopt.fem.elements import ElementOperators


def cell_values(operators: ElementOperators, field: np.ndarray) -> np.ndarray:
    """Return the cells' nodal values (n_cells, dn, k) less their mean, which has no energy.

    Rounding is then relative to the differences within a cell, not to its displacement.

    Args:
        operators: of the arm.
        field: (n_nodes, d, k).
    """
    num_cells, num_nodes = operators.cells.shape
    flat = field.reshape(len(field), -1)
    # Node by node: rows are contiguous, which a mean over the nodes' axis is not.
    corners = [flat[nodes] for nodes in operators.cells.T]
    mean = corners[0].copy()
    for corner in corners[1:]:
        mean += corner
    mean /= num_nodes
    values = np.empty((num_cells, num_nodes, flat.shape[1]))
    for k, corner in enumerate(corners):
        np.subtract(corner, mean, out=values[:, k])
    return values.reshape(num_cells, field.shape[1] * num_nodes, field.shape[2])


def combine(field: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Return nodal fields (n_nodes, d, k) times coefficients (k, m), as one matrix product."""
    flat = field.reshape(field.shape[0] * field.shape[1], field.shape[2]) @ coefficients
    return flat.reshape(*field.shape[:2], coefficients.shape[1])


def sum_at_nodes(operators: ElementOperators, forces: np.ndarray) -> np.ndarray:
    """Return the nodal field (n_nodes, d, k) of the cells' forces (n_cells, n, d, k)."""
    cells, shape = operators.cells, forces.shape[2:]
    corners = sp.csr_matrix(
        (np.ones(cells.size), cells.ravel(), np.arange(cells.size + 1)),
        shape=(cells.size, len(operators.points)),
    )
    return (corners.T @ forces.reshape(cells.size, -1)).reshape(-1, *shape)


def stiffness_products(
    operators: ElementOperators, left: np.ndarray, right: np.ndarray
) -> np.ndarray:
    """Return sum_k left_k' k_e right_k (n_cells,) for nodal fields (n_nodes, d, k)."""
    return _products(
        operators.stiffness, cell_values(operators, left), cell_values(operators, right)
    )


def mass_products(operators: ElementOperators, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return sum_k left_k' m_e right_k (n_cells,) for nodal fields (n_nodes, d, k)."""
    cells = operators.cells
    shape = (*cells.shape, -1)  # all components and columns alike
    return _products(operators.mass, left[cells].reshape(shape), right[cells].reshape(shape))


def _products(elements: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return sum_k left' A_e right (n_cells,) for (n_cells, n, n) and (n_cells, n, k)."""
    return np.einsum("eik,eik->e", left, elements @ right)
