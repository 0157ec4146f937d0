"""Gradients of one arm's functions by its design, over this rank's cells.

By default by the physical densities; all end in `Products`, of which gradients by other variables
are made as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from dolfinopt.arms.design_state import DesignState
from dolfinopt.arms.modes import LoadedModes
from dolfinopt.fem.assembly import combine
from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.fem.geometric_stiffness import GeometricGradient
from dolfinopt.fem.stress import DisplacementGradient
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, by_modal_loads, mass_partners
from dolfinopt.reduction import METHODS, AdjointFields, by_frame_fields, frame_fields
from dolfinopt.responses.products import By, Pair, Products, by_design


def esl_gradient(state: DesignState, A: np.ndarray, by: By = by_design) -> np.ndarray:
    """Return the derivative by the design of one arm with the equivalent static loads frozen.

    dJ/dE_e = -sum_j lambda_j' V_e' k_e V_e q_j = -trace(V_e' k_e V_e A'): as many energy fields as
    coordinates, however many load cases. For the compliance lambda_j = q_j.
    Source: Seifried, Moghadasi & Held (2015), eq. (11), doi:10.1016/j.piutam.2015.01.018.

    Args:
        state: of the arm.
        A: (q, q) see `motion.MotionResponse.load_case_moments`.
        by: what it is the derivative by.

    Returns:
        (n_cells,) over this rank's cells, or what `by` returns.
    """
    with state.elastic.profile.phase("gradient"):
        V = state.basis.V
        return by(state, of_pairs(state.elastic, ((combine(V, -A), V),)))


def exact_gradient(
    state: DesignState,
    cotangents: ShapeIntegrals,
    displaced: DisplacementGradient | None = None,
    by: By = by_design,
) -> np.ndarray:
    """Return the derivative by the design of one arm of a function of its floating body.

    Every integral is a product u . M v or u . K v of modes and rigid motions, so its derivative
    has a part by M and K, cell by cell, and one by the modes V; the latter goes through
    `Method.adjoint`. Exact for the discrete model.

    Args:
        state: of the arm.
        cotangents: the function's derivatives by the body's integrals; those by D join K's.
        displaced: its derivatives by displacements, where it depends on these, too.
        by: what it is the derivative by.

    Returns:
        (n_cells,) over this rank's cells, or what `by` returns.
    """
    with state.elastic.profile.phase("gradient"):
        return by(state, _body_products(state, cotangents, displaced))


def _body_products(
    state: DesignState, cotangents: ShapeIntegrals, displaced: DisplacementGradient | None
) -> Products:
    """Return what carries a change of one arm's design to a function of its body (collective)."""
    elastic, basis = state.elastic, state.basis
    V = basis.V
    damping = state.scene.damping.stiffness_proportional
    by_K = cotangents.K + damping * cotangents.D
    by_modes = cotangents.along_modes
    if len(by_modes):
        cotangents, by_modes = by_modal_loads(state.body, cotangents)
    partners = mass_partners(elastic.points, V, cotangents)
    by_V = elastic.mass_times(partners.by_modes)
    by_V += elastic.stiffness_times(combine(V, by_K + by_K.T))
    if displaced is not None:
        by_V += displaced.by_modes
    geometric = None
    if cotangents.is_stiffened:
        by_K0 = np.concatenate([cotangents.K0, by_modes, cotangents.K0_outboard])
        geometric = state.stiffening_loads.gradient(V, by_K0)
        by_V += geometric.by_modes
    interior, outboard = elastic.restrict(by_V)
    method = METHODS[state.scene.reduction.method]
    assert method.adjoint is not None  # the scene refuses the others
    rows = interior, outboard + cotangents.outboard
    fields = method.adjoint(elastic, basis, state.reduction_options, rows)
    partners.left[:, :, 1:-1] += fields.mass
    places = partners.by_points
    stiffness: list[Pair] = [(combine(V, by_K.T) - fields.stiffness, V)]
    for item in (geometric, displaced):
        if item is not None:
            # The partners of X and 1_x stand at the ends, those of the modes between them.
            partners.left[:, :, [-1, 0]] += item.by_inertia
            places = places + item.by_inertia[:, :, 1]
            partners.left[:, :, 1:-1] += item.by_modal_inertia
    if displaced is not None:
        stiffness.append((displaced.adjoint, displaced.static))
    interfaces = partial(_at_interfaces, state, by_V, fields, geometric, displaced)
    mass: list[Pair] = [(partners.left, partners.right)]
    if fields.frame is not None:
        mass.append((fields.frame, frame_fields(elastic)))
        places = places + by_frame_fields(fields.frame)
    return Products(tuple(stiffness), tuple(mass), geometric, places, interfaces)


def _at_interfaces(
    state: DesignState,
    by_V: np.ndarray,
    fields: AdjointFields,
    geometric: GeometricGradient | None,
    displaced: DisplacementGradient | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return what `Products.interfaces` does of a function of a body (collective)."""
    # Modes and all other fields are T times what they are solved for, and so are their adjoints;
    # what either are multiplied by in the Lagrangian, T aside, is zero within T's range alone.
    elastic, basis = state.elastic, state.basis
    T, V = elastic.substructure.T, basis.V
    by_V = by_V - elastic.stiffness_times(fields.stiffness) + elastic.mass_times(fields.mass)
    if geometric is not None:
        by_V -= geometric.face.by_modes  # the rotations are coordinates, whatever T
    rigid = by_V @ basis.outboard.T
    rigid -= elastic.stiffness_times(V) @ T.coordinates(fields.stiffness).T
    rigid += basis.MV @ T.coordinates(fields.mass).T
    if fields.frame is not None:
        weighted = elastic.mass_times(frame_fields(elastic))
        rigid += weighted @ T.coordinates(fields.frame).T
    levers = np.zeros_like(elastic.points)
    if geometric is not None:
        more, levers = geometric.at_interfaces()
        rigid += more
    if displaced is not None:
        rigid += displaced.at_interfaces()
    return rigid, levers


def pairs_at_interfaces(
    elastic: ElasticArm,
    stiffness: Sequence[Pair],
    mass: Sequence[Pair] = (),
    direct: Sequence[Pair] = (),
) -> tuple[np.ndarray, np.ndarray]:
    """Return what `Products.interfaces` does of pairs of fields that T makes (collective).

    Args:
        elastic: the design.
        stiffness, mass: as in `Products`.
        direct: derivatives by nodal values, contributions of this rank's cells, and the field.
    """
    T, rigid = elastic.substructure.T, np.zeros_like(elastic.rigid)
    for by, field in direct:
        rigid += by @ T.coordinates(field).T
    for pairs, times in ((stiffness, elastic.stiffness_times), (mass, elastic.mass_times)):
        for left, right in pairs:
            rigid += times(left) @ T.coordinates(right).T + times(right) @ T.coordinates(left).T
    return rigid, np.zeros_like(elastic.points)


def of_pairs(
    elastic: ElasticArm,
    stiffness: tuple[Pair, ...],
    mass: tuple[Pair, ...] = (),
    direct: tuple[Pair, ...] = (),
) -> Products:
    """Return what pairs of fields that T makes carry, see `pairs_at_interfaces`."""
    interfaces = partial(pairs_at_interfaces, elastic, stiffness, mass, direct)
    return Products(stiffness, mass, interfaces=interfaces)


def tip_gradient(
    state: DesignState, left: np.ndarray, right: np.ndarray, by: By = by_design
) -> np.ndarray:
    """Differentiate a function of the displacements under outboard loads by the design of one arm.

    dJ = sum_k left_k . dtip_k = -sum_k u(left_k)' dK u(right_k), by one adjoint load a case.

    Args:
        state: of the arm.
        left: (b, k) derivatives by the displacements and rotations of its interfaces.
        right: (b, k) the loads, N, N m.
        by: what it is the derivative by.
    """
    fields = state.elastic.static_fields(np.hstack([right, left]))
    with state.elastic.profile.phase("gradient"):
        of_left, of_right = (combine(fields.field, fields.amplitudes(f)) for f in (-left, right))
        return by(state, of_pairs(state.elastic, ((of_left, of_right),)))


def period_gradient(
    state: DesignState, modes: LoadedModes, by_values: np.ndarray, by: By = by_design
) -> tuple[np.ndarray, np.ndarray]:
    """Differentiate a function of one arm's eigenvalues, given its derivative by them (k,).

    d lambda = phi' (dK - lambda dM) phi, phi of unit mass.

    Returns:
        (n_cells,) by its own physical densities, or by other variables of its design, what it
        carries held; (b, b) by the matrix of what it carries.
    """
    with state.elastic.profile.phase("gradient"):
        weighted = modes.field * by_values
        pairs = ((weighted, modes.field),), ((weighted * -modes.values, modes.field),)
        own = by(state, of_pairs(state.elastic, *pairs))
        return own, -(modes.outboard * (by_values * modes.values)) @ modes.outboard.T


def rigid_gradient(state: DesignState, by_rigid: ShapeIntegrals, by: By = by_design) -> np.ndarray:
    """Return the derivative by x_phys of a function of one arm's rigid integrals (n_cells,).

    Or by other variables of the design, see `Products`.
    """
    points = state.elastic.points
    partners = mass_partners(points, np.empty((*points.shape, 0)), by_rigid)
    # Arms that are not outboard are not felt.
    mass = ((partners.left, partners.right),) * bool(partners.left.any())
    return by(state, Products(mass=mass, places=partners.by_points))


@dataclass(frozen=True, eq=False)
class Tip:
    """What static loads do to one arm whose inboard interface is clamped; k load cases.

    Attributes:
        loads: (3, k) force (N) and moment (N m) at the outboard interface; of solids (6, k), of
            those with several interfaces (b, k), zero at the others.
        tip: likewise displacements (m) and rotations (rad).
    """

    loads: np.ndarray
    tip: np.ndarray


def static_response(arm: ElasticArm, loads: np.ndarray) -> Tip:
    """Load the outboard interface of one arm (collective on its ranks).

    By `ElasticArm.static_fields`; neither the mass matrix nor a reduced model is needed.

    Args:
        arm: of the design.
        loads: (k, 3) F_x, F_y (N) and moment (N m) of every case; of a solid arm (k, 6).
    """
    columns = np.array(loads, dtype=float).T
    free = arm.rigid.shape[2] - len(columns)  # further interfaces are
    columns = np.concatenate([columns, np.zeros((free, columns.shape[1]))])
    fields = arm.static_fields(columns)
    return Tip(columns, fields.tip @ fields.amplitudes(columns))
