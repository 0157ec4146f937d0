"""A plane body in space, as files of spatial codes hold it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, integrated
from dolfinopt.reduction import Basis


def in_space(body: ShapeIntegrals, W: np.ndarray | None = None) -> ShapeIntegrals:
    """Return a plane body as one in space: the same motion in x-y, none out of it.

    A body in space is returned as it is.

    Geometric stiffness of the seven loads is spread over the eighteen,

        K0_yx = -K0_xy = K0_wd / 2,   K0_xx = K0_yy = -K0_zz = K0_-ww / 2,

    so that no rows feel rotation about x and y, of which a plane body does not know: neither of
    what a_z, F_z, T_x and T_y do. The moment about x and y does feel K0_wd, by way of Gr.

    Args:
        body: in the plane.
        W: (9, 1 + q, 1 + q) of the body, see `plate_moments`. By default a guess from the planar
            integrals, all mass on the x axis: out of the plane a thin bar.
    """
    if len(body.w) == 3:
        return body
    q = body.num_modes
    w, point, loads, outboard = np.zeros((3, 1 + q)), np.zeros(3), body.K0, body.K0_outboard
    w[:2], point[:2] = body.w, body.outboard_point
    if W is None:
        W = np.zeros((9, 1 + q, 1 + q))
        W[0], W[1], W[3] = body.W[0], -0.5 * body.W[1], 0.5 * body.W[1]
    if body.is_stiffened:
        loads, outboard = np.zeros((12, q, q)), _with_rows(outboard)
        loads[:2], turn, spin = body.K0[:2], 0.5 * body.K0[2], 0.5 * body.K0[3]
        loads[[4, 6]] = -turn, turn  # K0_xy, K0_yx
        loads[[3, 7, 11]] = spin, spin, -spin  # K0_xx, K0_yy, K0_zz
    return replace(
        body,
        w=w,
        W=W,
        outboard=_with_rows(body.outboard),
        outboard_point=point,
        K0=loads,
        K0_outboard=outboard,
        further_points=np.zeros((0, 3)),
    )


def _with_rows(plane: np.ndarray) -> np.ndarray:
    """Return what stands along x, y and about z among all six."""
    out = np.zeros((6, *plane.shape[1:]))
    out[[0, 1, 5]] = plane
    return out


def plate_moments(arm: ElasticArm, basis: Basis, thickness: float) -> np.ndarray:
    """Return W (9, 1 + q, 1 + q) of a plane arm's design (collective on the arm's ranks).

    Args:
        arm: with its design set.
        basis: of that design.
        thickness: t, m; int z^2 = m t^2 / 12.
    """
    mass, _, plane = integrated(arm, basis, np.eye(4).reshape(4, 2, 2))
    size = plane.shape[1]
    W = np.zeros((3, 3, size, size))
    W[:2, :2] = plane.reshape(2, 2, size, size)
    W[2, 2, 0, 0] = mass * thickness**2 / 12.0
    return W.reshape(9, size, size)
