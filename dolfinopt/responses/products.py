"""What a gradient by the design of one arm is made of, whatever the design's variables are.

However long the way from an arm's design to a response is, the adjoint of the way ends in products
of nodal fields with the changes of K and M, and a few terms beside them:

    dJ = sum_k l_k . dK r_k + sum_k l_k . dM r_k + dJ/dK0 . dK0 + ...

What K, M and the others change by a density of a cell is one thing (`by_design.by_densities`), by
the place of a node another (`shape_sensitivity.by_nodes`); the products are the same.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    from dolfinopt.arms.design_state import DesignState
    from dolfinopt.fem.geometric_stiffness import GeometricGradient
    from dolfinopt.fem.prestress import PrestressGradient

Pair = tuple[np.ndarray, np.ndarray]  # l and r, each (n_nodes, d, k)
Interfaces = Callable[[], tuple[np.ndarray, np.ndarray]]
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class StressProduct:
    """dJ = sum by_stress . (d operator) fields, of the operator `fem.stress.stress_operator`.

    Attributes:
        points: (p, d) of the reference cell.
        by_stress: (s, n_cells p, k) derivatives by the stress of unit Young's modulus.
        fields: (n_nodes, d, k) whose stress it is, held.
    """

    points: np.ndarray
    by_stress: np.ndarray
    fields: np.ndarray


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

    def __add__(self, other: Products) -> Products:
        """Return those of the sum of two functions."""
        return Products(
            stiffness=self.stiffness + other.stiffness,
            mass=self.mass + other.mass,
            geometric=_only(self.geometric, other.geometric),
            places=_sum(self.places, other.places),
            interfaces=_both(self.interfaces, other.interfaces),
            densities=_sum(self.densities, other.densities),
            volumes=_sum(self.volumes, other.volumes),
            stress=_only(self.stress, other.stress),
            prestress=_only(self.prestress, other.prestress),
        )


def _sum(one: np.ndarray | None, other: np.ndarray | None) -> np.ndarray | None:
    if one is None or other is None:
        return other if one is None else one
    return np.asarray(one + other)


def _only(one: T | None, other: T | None) -> T | None:
    """Return what one of the two has; both never have it."""
    assert one is None or other is None
    return other if one is None else one


def _both(one: Interfaces | None, other: Interfaces | None) -> Interfaces | None:
    """Return what `Products.interfaces` does of both."""
    if one is None or other is None:
        return other if one is None else one

    def summed() -> tuple[np.ndarray, np.ndarray]:
        (rigid, levers), (more, further) = one(), other()
        return rigid + more, levers + further

    return summed


# From products to a gradient by variables of the design: by its cells, or by its nodes.
By = Callable[["DesignState", Products], np.ndarray]
