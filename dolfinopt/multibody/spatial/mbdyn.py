"""A body in space as MBDyn's modal element, see `dolfinopt.exchange.mbdyn`.

Its nodes are the interfaces alone, and the invariants are those of the finite elements' mass. So
the joint must not say `use invariant 9`, which is for lumped masses.
"""

from __future__ import annotations

import numpy as np

from dolfinopt.exchange.mbdyn import Invariants, ModalElement
from dolfinopt.multibody.shape_integrals import ShapeIntegrals
from dolfinopt.multibody.spatial.kinematics import PERMUTATION
from dolfinopt.multibody.spatial.mechanism import ONE, inertia_about_centre
from dolfinopt.multibody.spatial.standard_input import (
    centrifugal,
    outboard_interfaces,
    turning,
)


def modal_element(body: ShapeIntegrals) -> ModalElement:
    """Return the element: node 1 is the inboard joint, then follow the outboard interfaces.

    Args:
        body: reduced, in space.
    """
    q = body.num_modes
    points, modes, K0 = zip(*outboard_interfaces(body), strict=True)
    centre, inertia = inertia_about_centre(body)
    loads, stiffening = _stiffening(body, np.concatenate(K0))
    return ModalElement(
        labels=tuple(str(k) for k in range(1, len(points) + 2)),
        points=np.stack([np.zeros(3), *points]),
        modes=np.stack([np.zeros((6, q)), *modes]),
        M=body.M,
        K=body.K,
        D=body.D,
        lumped=None,
        mass=body.mass,
        centre=centre,
        inertia=inertia,
        loads=loads,
        stiffening=stiffening,
        invariants=_invariants(body),
    )


def _invariants(body: ShapeIntegrals) -> Invariants:
    q = body.num_modes
    W = body.W.reshape(3, 3, 1 + q, 1 + q)
    first, mixed = W[:, :, 0, 1:], W[:, :, 1:, 1:]  # int X_a Phi_b, int Phi_a Phi_b
    return Invariants(
        three=body.w[:, 1:],
        four=np.einsum("cab,abj->cj", PERMUTATION, first),
        five=np.einsum("cab,abjk->cjk", PERMUTATION, mixed),
        eight=-_double_cross(first),
        nine=_double_cross(mixed),
    )


def _double_cross(moments: np.ndarray) -> np.ndarray:
    """Return int u~ v~ = int v u' - u . v of the integrals int u_a v_b (3, 3, ...)."""
    trace = np.einsum("aa...,ij->ij...", moments, ONE)
    return moments.swapaxes(0, 1) - trace


def _stiffening(body: ShapeIntegrals, outboard: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return places (k,) and matrices (k, q, q) of group 19; k = 0 of a linear body."""
    q = body.num_modes
    if not body.is_stiffened:
        return np.zeros(0, dtype=int), np.zeros((0, q, q))
    rotation = body.K0[3:].reshape(3, 3, q, q)
    inertial = [centrifugal(rotation), turning(rotation), body.K0[:3].transpose(1, 2, 0)]
    matrices = [0.0 - np.moveaxis(one, -1, 0) for one in inertial]
    found = np.concatenate([*matrices, outboard])
    return np.arange(1, len(found) + 1), found
