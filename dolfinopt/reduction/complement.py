"""The linear systems of the modes' derivatives."""

from __future__ import annotations

import numpy as np

from dolfinopt.errors import ConvergenceError
from dolfinopt.reduction.eigenproblem import Pencil
from dolfinopt.reduction.lobpcg import Operators

# Relative residual of the modes' adjoints, in the energy of K^-1; gradients are then right to it,
# which leaves more digits than an optimiser can use.
ADJOINT_TOLERANCE = 1e-8
MAX_ADJOINT = 500  # steps of conjugate gradients for one mode


def complement_solve(
    pencil: Pencil, modes: np.ndarray, values: np.ndarray, right: np.ndarray
) -> np.ndarray:
    """Solve (K - lambda_k M) mu_k = right_k in the M-complement of the modes, for every k.

    The adjoint of the eigenproblem, less its part within the modes' span. A reduced model depends
    on nothing but that span, so what the modes do among themselves has no influence: neither close
    nor repeated eigenvalues divide by zero. In the complement K - lambda_k M is positive definite,
    and conjugate gradients with the factor of K converge as 1 - lambda_k / lambda_next allows.
    K times a direction follows from the residual that the direction was solved for. Where no factor
    is at hand, multigrid cycles take its place, for all modes at once.

    Args:
        pencil: K and M.
        modes: (rows, k) all modes below the complement, M-orthonormal.
        values: (k,) their eigenvalues, rad2/s2.
        right: (rows, k).

    Returns:
        mu (rows, k).

    Raises:
        ConvergenceError: the next eigenvalue is too close to the last.
    """
    if pencil.operators is not None:
        return _without_factor(pencil, pencil.operators, modes, values, right)
    weighted = np.column_stack([pencil.mass(mode) for mode in modes.T])

    def conditioned(residual: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return z = K^-1 r less its part in the modes, K z, and z . r."""
        z = pencil.inverse(residual)
        part = pencil.total(weighted.T @ z)
        z -= modes @ part
        return z, residual - weighted @ (values * part), float(pencil.total(residual @ z))

    out = np.zeros_like(right)
    for k, value in enumerate(values):
        residual = right[:, k] - weighted @ pencil.total(modes.T @ right[:, k])
        step, K_step, energy = conditioned(residual)
        image = K_step - value * pencil.mass(step)
        goal = ADJOINT_TOLERANCE**2 * energy
        for _ in range(MAX_ADJOINT):
            if energy <= goal:
                break
            if not np.isfinite(energy):
                raise _too_close(pencil, k)
            length = energy / float(pencil.total(step @ image))
            out[:, k] += length * step
            residual -= length * image
            previous = energy
            z, K_z, energy = conditioned(residual)
            image = K_z - value * pencil.mass(z) + (energy / previous) * image
            step = z + (energy / previous) * step
        else:
            raise _too_close(pencil, k)
    return out


def _without_factor(
    pencil: Pencil, operators: Operators, modes: np.ndarray, values: np.ndarray, right: np.ndarray
) -> np.ndarray:
    """Do what `complement_solve` does with an approximation of K^-1 alone.

    Conjugate gradients for each mode's own matrix; products and cycles work on all of them.
    """
    weighted = operators.mass(modes)

    def lengths(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return operators.total(np.einsum("nk,nk->k", one, other))

    def conditioned(R: np.ndarray) -> np.ndarray:
        """Return P B P' r, with P the projection into the complement; r becomes P' r."""
        R -= weighted @ operators.total(modes.T @ R)
        Z = operators.precondition(R)
        return Z - modes @ operators.total(weighted.T @ Z)

    out, here = np.zeros_like(right), np.arange(len(values))
    R = right.copy(order="F")
    Z = conditioned(R)
    P, energy = Z, lengths(R, Z)
    goal = ADJOINT_TOLERANCE**2 * energy
    for _ in range(MAX_ADJOINT):
        if not np.isfinite(energy).all():
            break
        more = energy > goal[here]
        if not more.any():
            return out
        if not more.all():
            here, energy = here[more], energy[more]
            R, P = R[:, more], P[:, more]
        image = operators.stiffness(P) - operators.mass(P) * values[here]
        step = energy / lengths(P, image)
        out[:, here] += P * step
        R -= image * step
        Z = conditioned(R)
        before, energy = energy, lengths(R, Z)
        P = Z + P * (energy / before)
    raise _too_close(pencil, int(here[np.argmin(np.isfinite(energy))]))


def _too_close(pencil: Pencil, k: int) -> ConvergenceError:
    return ConvergenceError(
        f"arm {pencil.arm.mesh.name!r}: the derivatives of mode {k + 1} do not converge, "
        "the next mode's frequency is too close; change reduction.coordinates by one"
    )
