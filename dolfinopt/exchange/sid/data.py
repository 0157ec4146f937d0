"""What standard input data hold: Taylor expansions in the elastic coordinates, nodes, one body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# What a matrix looks like: readers may skip its entries where they follow from this.
ZERO, DIAGONAL, SYMMETRIC, GENERAL, UNIT = range(5)


@dataclass(frozen=True, eq=False)
class Taylor:
    """A matrix M(q) = M0 + sum_k q_k M1[:, k, :].

    Attributes:
        M0: (nrow, ncol).
        M1: (nrow, nq, ncol), zero for order 0; files of order 0 may have nq = 0.
        order: 0 or 1.
        structure: of M0: 0 zero, 1 diagonal, 2 symmetric, 3 general, 4 unit matrix.
        nqn: dimension of higher orders, which are not read; zero.
    """

    M0: np.ndarray
    M1: np.ndarray
    order: int
    structure: int
    nqn: int = 0

    def at(self, q: np.ndarray) -> np.ndarray:
        """Return M(q) (nrow, ncol)."""
        if self.order == 0:
            return self.M0
        return self.M0 + np.einsum("rkc,k->rc", self.M1, q)


def taylor(M0: np.ndarray, M1: np.ndarray | None = None, *, nq: int, structure: int) -> Taylor:
    """Return the expansion of order 0, or of order 1 where M1 (nrow, nq, ncol) is given.

    A structure that M0 does not have is replaced: one that is zero is called so.
    """
    if not M0.any():
        structure = ZERO
    higher = np.zeros((M0.shape[0], nq, M0.shape[1])) if M1 is None else M1
    return Taylor(M0, higher, 0 if M1 is None else 1, structure)


def structure_of(matrix: np.ndarray) -> int:
    """Return whether a square matrix is diagonal, symmetric or neither."""
    if np.array_equal(matrix, np.diag(np.diag(matrix))):
        return DIAGONAL
    return SYMMETRIC if np.array_equal(matrix, matrix.T) else GENERAL


@dataclass(frozen=True)
class Node:
    """A point of the body where something may be attached.

    Attributes:
        name: number or name.
        rframe: name of the frame its data refer to.
        origin: (3, 1) position, m; its M1 repeats phi.
        phi: (3, nq) translation by each coordinate.
        psi: (3, nq) small rotation by each coordinate.
        AP: (3, 3) orientation, from the node's to the body's frame; M1 = tilde(psi_k).
        sigma: (6, 1) initial stresses, or None.
    """

    name: str
    rframe: str
    origin: Taylor
    phi: Taylor
    psi: Taylor
    AP: Taylor
    sigma: Taylor | None = None


@dataclass(frozen=True)
class StandardInputData:
    """One flexible body; integrals over its mass, r the reference position, Phi the modes.

    Attributes:
        mass: m, kg.
        names: (nq,) of the elastic coordinates.
        nodes: where something may be attached.
        mdCM: (3, 1) int r, kg m.
        J: (6, 1) moments xx, yy, zz, xy, xz, yz of the inertia tensor, or (3, 3); kg m2.
        Ct: (nq, 3) int Phi'.
        Cr: (nq, 3) int (r x Phi_k)'.
        Me: (nq, nq) int Phi' Phi.
        Gr: (3, 3 nq) blocks -2 int tilde(r) tilde(Phi_k).
        Ge: (nq, 3 nq) block l has rows 2 int (Phi_l x Phi_k)'.
        Oe: (nq, 6) int of what w1^2, w2^2, w3^2, w1 w2, w2 w3, w1 w3 do to each coordinate.
        ksigma: (nq, 1) generalised forces of initial stresses.
        Ke, De: (nq, nq) stiffness and damping.
        comment: of the file's first line.
    """

    mass: float
    names: tuple[str, ...]
    nodes: tuple[Node, ...]
    mdCM: Taylor
    J: Taylor
    Ct: Taylor
    Cr: Taylor
    Me: Taylor
    Gr: Taylor
    Ge: Taylor
    Oe: Taylor
    ksigma: Taylor
    Ke: Taylor
    De: Taylor
    comment: str = ""

    @property
    def num_modes(self) -> int:
        """Number nq of elastic coordinates."""
        return len(self.names)

    def inertia(self, q: np.ndarray) -> np.ndarray:
        """Return the inertia tensor J(q) (3, 3) to first order in q, whichever way it is stored."""
        J = self.J.at(q)
        if J.shape == (3, 3):
            return J
        xx, yy, zz, xy, xz, yz = J[:, 0]
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


# Allowed shapes in the file's order: numbers, or multiples of nq.
BODY: dict[str, tuple[tuple[int | str, int | str], ...]] = {
    "mdCM": ((3, 1),),
    "J": ((6, 1), (3, 3)),
    "Ct": (("nq", 3),),
    "Cr": (("nq", 3),),
    "Me": (("nq", "nq"),),
    "Gr": ((3, "3nq"),),
    "Ge": (("nq", "3nq"),),
    "Oe": (("nq", 6),),
    "ksigma": (("nq", 1),),
    "Ke": (("nq", "nq"),),
    "De": (("nq", "nq"),),
}
NODE: dict[str, tuple[tuple[int | str, int | str], ...]] = {
    "origin": ((3, 1),),
    "phi": ((3, "nq"),),
    "psi": ((3, "nq"),),
    "AP": ((3, 3),),
    "sigma": ((6, 1),),
}
HEADER = ("order", "nrow", "ncol", "nq", "nqn", "structure")
