"""What a gradient by the design of one arm is made of, whatever the design's variables are.

However long the way from an arm's design to a response is, the adjoint of the way ends in products
of nodal fields with the changes of K and M, and a few terms beside them:

    dJ = sum_k l_k . dK r_k + sum_k l_k . dM r_k + dJ/dK0 . dK0 + ...

What K, M and the others change by a density of a cell is one thing (`by_densities`), by the place
of a node another (`by_nodes`); the products are the same.

Nodes: with the shape functions of a cell held in its reference cell, a design depends on the place
of a node by k_e and m_e of the cells around it, by their stress and geometric stiffness, by their
volumes, and by the lever arms of inertia. `responses.evaluation.gradient` and
`constraint_gradients` give the derivative by all of it at once, exact for the discrete model:

    gradient(scene, partition, arms, trajectory, profile, by=by_nodes)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from dolfinopt.arms.design_state import DesignState
    from dolfinopt.fem.geometric_stiffness import GeometricGradient
    from dolfinopt.fem.stress import PrestressGradient

Pair = tuple[np.ndarray, np.ndarray]  # l and r, each (n_nodes, d, k)
Interfaces = Callable[[], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class StressProduct:
    """dJ = sum by_stress . (d operator) fields, of the operator `fem.stress.stress_operator`.

    Attributes:
        points: (p, d) of the reference cell.
        by_stress: (s, n_cells p, k) derivatives by the stress of unit Young's modulus.
        fields: returns those (n_nodes, d, k) whose stress it is, held.
    """

    points: np.ndarray
    by_stress: np.ndarray
    fields: Callable[[], np.ndarray]


@dataclass(frozen=True, eq=False)
class Products:
    """What carries a change of one arm's design to a response; without parts there is none.

    Attributes:
        stiffness: pairs of l . dK r.
        mass: pairs of l . dM r.
        geometric: of K0, whose modes are the right fields of the first pair of `stiffness`.
        places: (n_nodes, d) field p by which the nodes are felt as lever arms: p . M dX; None: 0.
        interfaces: returns the derivatives by the rigid motions of the outboard interfaces' nodes
            (n_nodes, d, b), in which all fields move them, and by these nodes as other lever arms
            (n_nodes, d); contributions of this rank's cells; None: 0.
        densities: (n_cells,) by the physical densities otherwise than by K and M; None: 0.
        volumes: (n_cells,) by the cells' areas, in space volumes, likewise; None: 0.
        stress: of stress, whose operator depends on the cells' shape.
        prestress: of K0 of the full mesh, whose pairs of fields are among `stiffness` and `mass`.
    """

    stiffness: tuple[Pair, ...] = ()
    mass: tuple[Pair, ...] = ()
    geometric: GeometricGradient | None = None
    places: np.ndarray | None = None
    interfaces: Interfaces | None = None
    densities: np.ndarray | None = None
    volumes: np.ndarray | None = None
    stress: StressProduct | None = None
    prestress: PrestressGradient | None = None


# From products to a gradient by variables of the design: by its cells, or by its nodes.
By = Callable[["DesignState", Products], np.ndarray]


# -- by the design, by nodes -----------------------------------------------------------------


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
        (left, _), *pairs = pairs
        energies += products.geometric.by_young(left)
    for left, right in pairs:
        energies += elastic.cell_stiffness_products(left, right)
    for left, right in products.mass:
        masses += elastic.cell_mass_products(left, right)
    if products.prestress is not None:
        energies += products.prestress.direct
    result = state.young_slope * energies + state.density_slope * masses
    return result if products.densities is None else result + products.densities


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
    by_corners = np.zeros_like(elastic.operators.corners)
    if products.volumes is not None:
        by_corners += shape.volume(products.volumes)
    geometric = products.geometric
    if geometric is not None:
        stiffness += geometric.stiffness
        if len(geometric.by_K0):
            parts = geometric.loads.fields, geometric.modes, geometric.by_K0
            by_corners += shape.geometric_stiffness(*parts, young)
    if stiffness:
        left, right = (np.concatenate(fields, axis=2) for fields in zip(*stiffness, strict=True))
        by_corners += shape.stiffness(left, right, young)
    for left, right in mass:
        by_corners += shape.mass(left, right, elastic.density)
    if (stress := products.stress) is not None:
        by_corners += shape.stress(stress.points, stress.by_stress, stress.fields())
    if (prestress := products.prestress) is not None:
        by_corners += shape.geometric_stiffness(
            prestress.stress.u, prestress.modes, prestress.by_K0, prestress.stress.modulus.value
        )
    by_points = np.zeros_like(elastic.points)
    if products.places is not None:
        by_points += elastic.mass_times(products.places[:, :, None])[:, :, 0]
    if products.interfaces is not None:
        by_rigid, by_levers = products.interfaces()
        by_points += elastic.substructure.T.by_points(by_rigid) + by_levers
    return shape.total(shape.at_nodes(by_corners) + shape.from_points(by_points))
