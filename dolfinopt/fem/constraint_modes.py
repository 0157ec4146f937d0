"""Static fields of the outboard interface, by displacement and load; what rounding does there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.errors import ConvergenceError
from dolfinopt.fem.cells import cell_values, sum_at_nodes
from dolfinopt.fem.floating import HARMLESS, extremes
from dolfinopt.parallel import on_root

if TYPE_CHECKING:
    from dolfinopt.fem.elasticity import ElasticArm

# Largest relative error that rounding may make in the stiffness of a design in which solids float:
# a tenth of what an optimiser's step changes. Against long double errors are 0.03 to 0.35 of the
# estimate.
MOST_ROUNDING = 1e-3
# Part of a cell's displacement as a rigid translation in that estimate. The energy does not know
# translations, the assembled matrix does: where they are lost in it, refinement fails.
TRANSLATION = 0.03
POWER_STEPS = 6  # of the estimate; four give two digits
ROUNDED = 1e-8  # part of a deflection that may come of rounding, by factors of long arms


@dataclass(frozen=True, eq=False)
class ConstraintModes:
    """One arm under unit displacements of its outboard interface: b of them, 3 or 6 in space.

    Attributes:
        interior: (num_interior, b) owned interior rows.
        field: (n_nodes, d, b) nodal field.
        stiffness: (b, b) S, force and moment at the interface by its displacement.
        coupling: (num_interior, b) K_Ib.
        corner: (b, b) K_bb.
    """

    interior: np.ndarray
    field: np.ndarray
    stiffness: np.ndarray
    coupling: np.ndarray
    corner: np.ndarray


def static_modes(arm: ElasticArm) -> ConstraintModes:
    """Return Psi = [-K_II^-1 K_Ib; I] and S = Psi' K Psi: b solves with the factor at hand.

    Collective on the arm's ranks.

    Raises:
        ConvergenceError: the contrast between solid and void is too large for this design.
    """
    floating = floats(arm)
    if not floating:  # of a machine that moves after static loads
        arm.substructure.release_extended()
    coupling, corner = arm.restrict(arm.substructure.rigid_forces(arm.young))
    # With the interior at rest the interface's motion has up to 1e5 of the modes' energy.
    interior = arm.solve(-coupling, "constraint modes", np.diag(corner))
    modes = _with_energies(arm, interior, coupling, corner)
    if floating:
        modes = _refined(arm, modes)
    if not _is_stiffness(modes.stiffness):
        raise _lost_in_rounding(arm)
    return modes


@dataclass(frozen=True, eq=False)
class StaticFields:
    """m static fields of one arm, which span those of the loads that were asked for.

    Of the fields U a, with the tip's displacement T a, that of a load f has the least energy
    a' U'KU a / 2 - a' T'f: errors of U make one of second order in the displacement under it.

    Attributes:
        directions: (b, m) orthonormal, of the loads; b of them need no more fields.
        field: (n_nodes, d, m) U.
        tip: (b, m) T, displacements and rotations of the outboard interfaces.
        stiffness: (m, m) U'KU.
    """

    directions: np.ndarray
    field: np.ndarray
    tip: np.ndarray
    stiffness: np.ndarray

    def amplitudes(self, loads: np.ndarray) -> np.ndarray:
        """Return a (m, k) of loads (b, k)."""
        return np.linalg.solve(self.stiffness, self.tip.T @ loads)


def static_fields(arm: ElasticArm, loads: np.ndarray, known: StaticFields | None) -> StaticFields:
    """Return the static fields of loads (b, k): one solve for each that others do not make up.

    Constraint modes where these are known, or take no longer.
    Collective on the arm's ranks.

    Args:
        arm: of the design.
        loads: forces and moments at its outboard interfaces, N, N m.
        known: of earlier loads, which are kept.

    Raises:
        ConvergenceError: as of `static_modes`.
    """
    b = len(loads)
    if known is None:
        known = StaticFields(*(np.empty((*n, 0)) for n in ((b,), arm.points.shape, (b,), (0,))))
    extended = arm.substructure.extended
    # What a symmetric design's deflection has across the load is an error of the fields.
    error = extended.tolerance if extended and extended.is_iterative else ROUNDED
    new = on_root(arm.comm, _new_directions, known.directions, loads, error)
    if new.shape[1] == 0:
        return known
    if arm.has_constraint_modes or extended is None or floats(arm):
        modes = arm.constraint_modes()
        return StaticFields(np.eye(b), modes.field, np.eye(b), modes.stiffness)
    purpose = "adjoint loads" if known.directions.shape[1] else "static loads"
    interior, tip = arm.solve_loads(new, purpose)
    field = np.concatenate([known.field, arm.expand(interior, tip)], axis=2)
    found = StaticFields(
        np.hstack([known.directions, new]),
        field,
        np.hstack([known.tip, tip]),
        arm.energy_matrix(field),
    )
    if not _is_stiffness(found.stiffness):
        raise _lost_in_rounding(arm)
    return found


def _new_directions(known: np.ndarray, loads: np.ndarray, tolerance: float) -> np.ndarray:
    """Return an orthonormal basis (b, j) of what loads (b, k) have beside that of known ones.

    In the order of the loads, so that unit loads stay what they are. Less than the tolerance of
    a load is nothing.
    """
    basis = known
    for load in loads.T:
        rest = load
        for _ in range(2):  # once leaves rounding of the part that is taken off
            rest = rest - basis @ (basis.T @ rest)
        length = np.linalg.norm(rest)
        if length > tolerance * np.linalg.norm(load):
            basis = np.column_stack([basis, rest / length])
    return basis[:, known.shape[1] :]


def floats(arm: ElasticArm) -> bool:
    """Return whether void that is softer by orders of magnitude holds solid cells (collective)."""
    low, high = extremes(arm.comm, arm.young)
    return low < 0.1 / HARMLESS * high and arm.connectivity.floats(arm.young)


def _with_energies(
    arm: ElasticArm, interior: np.ndarray, coupling: np.ndarray, corner: np.ndarray
) -> ConstraintModes:
    field = arm.expand(interior, np.eye(len(corner)))
    return ConstraintModes(interior, field, arm.energy_matrix(field), coupling, corner)


def _refined(arm: ElasticArm, modes: ConstraintModes) -> ConstraintModes:
    """Return constraint modes after one step of iterative refinement, if rounding allows.

    Solids that float in void, as checkerboards and islands do, rest on stiffnesses far below
    the rounding of their own. The residual is summed cell by cell without rigid motion, which
    knows them better than the assembled matrix.

    Raises:
        ConvergenceError: the void's stiffness is lost in the rounding of the solid's.
    """
    if not _is_stiffness(modes.stiffness):
        raise _lost_in_rounding(arm)
    operators = arm.operators
    values = cell_values(operators, modes.field)
    forces = (operators.stiffness @ values) * arm.young[:, None, None]
    forces = forces.reshape(*operators.cells.shape, *modes.field.shape[1:])
    residual, _ = arm.restrict(sum_at_nodes(operators, forces))
    better = modes.interior - arm.solve(residual)
    refined = _with_energies(arm, better, modes.coupling, modes.corner)
    if not (_is_stiffness(refined.stiffness) and rounding_error(arm, refined) <= MOST_ROUNDING):
        raise _lost_in_rounding(arm)
    return refined


def rounding_error(arm: ElasticArm, modes: ConstraintModes) -> float:
    """Return an estimate of the relative error of S by rounding.

    An element matrix is known to eps times its diagonal D_e, so the energy of any field is to
    eps u' D u, and relative to it to eps times the largest eigenvalue of D u = mu T'KT u.
    Inverse iteration finds it from random numbers: void that holds solids sets it
    orders of magnitude apart from all others. What it returns is too small only where mu
    exceeds 1 / eps, far beyond `MOST_ROUNDING`, because the factorised matrix is off by then.
    """
    operators = arm.operators
    diagonal = np.einsum("eii->ei", operators.stiffness) * arm.young[:, None]
    diagonal = diagonal.reshape(*operators.cells.shape, arm.mesh.dim, 1)

    def weighted(field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return T' D T u."""
        values = field[operators.cells]
        forces = diagonal * (values - kept * values.mean(axis=1, keepdims=True))
        forces -= kept * forces.mean(axis=1, keepdims=True)
        return arm.restrict(sum_at_nodes(operators, forces))

    kept = 1.0 - TRANSLATION
    places = arm.points.T / arm.mesh.outboard_point[0]
    # By place, so that numbers are random and yet the same on any number of ranks.
    line = sum(factor * x for factor, x in zip((1e4, 7e4, 3e4), places, strict=False)) + 1.0
    noise = np.sin(np.outer(line, [12.9898, 78.233, 37.719][: len(places)])) * 43758.5453
    guess = (np.modf(np.abs(noise))[0] - 0.5)[:, :, None]
    loads, outboard = weighted(
        arm.expand(guess[arm.interior_nodes].reshape(-1, 1), np.full((len(modes.corner), 1), 0.5))
    )
    ratio = np.inf
    for _ in range(POWER_STEPS):
        lift = arm.comm.allreduce(modes.interior.T @ loads)
        tip = np.linalg.solve(modes.stiffness, outboard + lift)
        interior = arm.solve(loads) + modes.interior @ tip
        work = arm.comm.allreduce(np.sum(interior * loads)) + np.sum(tip * outboard)
        loads, outboard = weighted(arm.expand(interior, tip))
        energy = arm.comm.allreduce(np.sum(interior * loads)) + np.sum(tip * outboard)
        ratio = abs(float(energy / work))
        scale = max(energy, np.finfo(float).tiny) ** -0.5
        loads, outboard = scale * loads, scale * outboard
    return ratio * float(np.finfo(float).eps)


def _lost_in_rounding(arm: ElasticArm) -> ConvergenceError:
    low, high = extremes(arm.comm, arm.young)
    return ConvergenceError(
        f"arm {arm.mesh.name!r}: solid parts of the design are connected by void alone, "
        f"{low / high:.1g} times as stiff: too soft for double precision; raise "
        "interpolation.floor or design.minimum, or connect the design to both interfaces"
    )


def _is_stiffness(matrix: np.ndarray) -> bool:
    """Return whether a symmetric matrix is finite and positive definite."""
    if not np.isfinite(matrix).all():
        return False
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True
