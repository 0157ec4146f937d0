"""How bases of the same arm differ: modal assurance criterion, angles, frequencies, compliance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.reduction.basis import Basis
from dolfinopt.reduction.subspace import dot, ritz


def mac(arm: ElasticArm, V: np.ndarray, W: np.ndarray) -> np.ndarray:
    """Return the mass-weighted modal assurance criterion (k, l) of two sets of modes.

    (v_i' M w_j)^2 / (v_i' M v_i  w_j' M w_j): 1 where two modes are the same, 0 where orthogonal.
    Source: Allemang & Brown (1982), Proc. 1st Int. Modal Analysis Conf., 110-116.

    Args:
        arm: with its design set.
        V, W: (n_nodes, 2, k) and (n_nodes, 2, l).
    """
    MW = arm.mass_times(W)
    v = np.diag(dot(arm, V, arm.mass_times(V)))
    w = np.diag(dot(arm, W, MW))
    return dot(arm, V, MW) ** 2 / np.outer(v, w)


@dataclass(frozen=True, eq=False)
class BasisErrors:
    """What a basis misses of a richer one.

    Attributes:
        frequency: (k,) relative excess of its first natural frequencies, clamped-free.
        mac: (k,) of the modes that belong to them.
        compliance: (3,) or (6,) relative loss of the outboard interface's compliance under unit
            loads.
        angle: (k,) rad, between the richer basis' first modes and the span.
    """

    frequency: np.ndarray
    mac: np.ndarray
    compliance: np.ndarray
    angle: np.ndarray


def basis_errors(arm: ElasticArm, basis: Basis, reference: Basis, count: int) -> BasisErrors:
    """Compare the natural modes of a reduced arm with those of a richer basis (collective).

    Args:
        arm: with the design set for which both were made.
        basis, reference: by any method.
        count: k, modes to compare; fewer where the basis has fewer coordinates.
    """
    ours, theirs = ritz(arm, basis.V), ritz(arm, reference.V)
    k = min(count, ours.V.shape[2], theirs.V.shape[2])
    first = theirs.V[:, :, :k]
    ratio = np.diag(ours.stiffness)[:k] / np.diag(theirs.stiffness)[:k]
    rest = first - ours.V @ dot(arm, ours.MV, first)
    missed = np.sqrt(np.maximum(np.diag(dot(arm, rest, arm.mass_times(rest))), 0.0))
    return BasisErrors(
        frequency=np.sqrt(ratio) - 1.0,
        mac=np.diag(mac(arm, ours.V[:, :, :k], first)),
        compliance=1.0 - tip_compliance(basis) / tip_compliance(reference),
        angle=np.arcsin(np.minimum(missed, 1.0)),
    )


def tip_compliance(basis: Basis) -> np.ndarray:
    """Return displacement by load (3,) of the outboard interface: m/N, m/N, rad/(N m).

    In space (6,): three in m/N, three in rad/(N m).
    """
    return np.diag(basis.outboard @ np.linalg.solve(basis.stiffness, basis.outboard.T))
