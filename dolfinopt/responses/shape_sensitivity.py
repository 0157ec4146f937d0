"""Gradients of responses by the places of the nodes of the arms' meshes.

With the shape functions of a cell held in its reference cell, a design depends on the place of a
node by k_e and m_e of the cells around it, by their stress and geometric stiffness, by their
volumes, and by the lever arms of inertia. `responses.evaluation.gradient` and
`constraint_gradients` give the derivative by all of it at once, exact for the discrete model:

    gradient(scene, partition, arms, trajectory, profile, by=by_nodes)
"""

from __future__ import annotations

import numpy as np

from dolfinopt.arms.design_state import DesignState
from dolfinopt.responses.products import Products


def by_nodes(state: DesignState, products: Products) -> np.ndarray:
    """Return the derivative (n, d) by the places of the nodes of an arm's mesh, per m (collective).

    Nodes are those of `mesh.geometry`, corners of cells, ghosts included; nodes on the sides of
    quadratic cells follow these. Interfaces' points of reference and the physical densities of the
    cells are held, and so is which cells count as too near to an interface
    (`objective.stress_margin`).

    Args:
        state: the design of an arm on this rank.
        products: what carries a change of the design to the response.
    """
    elastic = state.elastic
    shape, young = elastic.substructure.shape_derivative, elastic.young
    stiffness, mass = list(products.stiffness), list(products.mass)
    by_corners = np.zeros_like(shape.corners)
    if products.volumes is not None:
        by_corners += shape.volume(products.volumes)
    geometric = products.geometric
    if geometric is not None:
        stiffness += geometric.stiffness
        if len(geometric.by_K0):
            parts = geometric.loads.fields, geometric.modes, geometric.by_K0
            by_corners += shape.geometric_stiffness(*parts, young)
    for left, right in stiffness:
        by_corners += shape.stiffness(left, right, young)
    for left, right in mass:
        by_corners += shape.mass(left, right, elastic.density)
    if (stress := products.stress) is not None:
        by_corners += shape.stress(stress.points, stress.by_stress, stress.fields)
    if (one := products.prestress) is not None:
        by_corners += shape.geometric_stiffness(
            one.stress.u, one.modes, one.by_K0, one.stress.modulus.value
        )
    by_points = np.zeros_like(elastic.points)
    if products.places is not None:
        by_points += elastic.mass_times(products.places[:, :, None])[:, :, 0]
    if products.interfaces is not None:
        by_rigid, by_levers = products.interfaces()
        by_points += elastic.substructure.T.by_points(by_rigid) + by_levers
    return shape.total(shape.at_nodes(by_corners) + shape.from_points(by_points))
