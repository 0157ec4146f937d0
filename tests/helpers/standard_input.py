"""Forces of one body by standard input data alone, as a program that reads a file computes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.exchange.sid import StandardInputData

Forces = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class State:
    """Motion of a frame in space and of the coordinates in it, components in the frame."""

    a: np.ndarray
    w: np.ndarray
    g: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray


def random_state(rng: np.random.Generator, q: int, plane: bool = False) -> State:
    """Return any state, or one of motion in x-y."""
    a, w, g = rng.normal(size=(3, 3))
    if plane:
        a[2] = w[0] = w[1] = g[0] = g[1] = 0.0
    return State(a, w, g, *rng.normal(scale=0.5, size=(3, q)))


def forces_of_sid(data: StandardInputData, s: State) -> Forces:
    """Return force, moment about the origin and elastic rows, by the floating frame's equations.

    What the format lacks follows from what it has: half of the first order of Gr is the inertia's
    second order, and geometric stiffness in Ct and Cr is the motion of the second order.
    """
    q, w = len(s.q), s.w
    Gr, Ge = data.Gr.at(s.q).reshape(3, q, 3), data.Ge.at(s.q).reshape(q, q, 3)
    Ct, Cr, Oe = data.Ct.at(s.q), data.Cr.at(s.q), data.Oe.at(s.q)
    centre = data.mdCM.at(s.q)[:, 0] + 0.5 * np.einsum("klc,k,l->c", data.Ct.M1, s.q, s.q)
    quadratic = np.einsum("k,l,ilkj->ij", s.q, s.q, data.Gr.M1.reshape(3, q, q, 3))
    J = data.inertia(s.q) + 0.25 * (quadratic + quadratic.T)
    products = np.array([w[0] ** 2, w[1] ** 2, w[2] ** 2, w[0] * w[1], w[1] * w[2], w[0] * w[2]])
    force = (
        data.mass * s.a
        + np.cross(s.g, centre)
        + np.cross(w, np.cross(w, centre))
        + 2.0 * np.cross(w, Ct.T @ s.qd)
        + Ct.T @ s.qdd
        + np.einsum("klc,k,l->c", data.Ct.M1, s.qd, s.qd)
    )
    moment = (
        np.cross(centre, s.a)
        + J @ s.g
        + np.cross(w, J @ w)
        + np.einsum("ikj,k,j->i", Gr, s.qd, w)
        + Cr.T @ s.qdd
        + np.einsum("klc,k,l->c", data.Cr.M1, s.qd, s.qd)
    )
    rows = (
        Ct @ s.a
        + Cr @ s.g
        + np.einsum("ikj,k,j->i", Ge, s.qd, w)
        + Oe @ products
        + data.Me.at(s.q) @ s.qdd
    )
    return force, moment, rows
