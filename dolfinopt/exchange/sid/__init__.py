"""Wallrapp's standard input data (SID) of one flexible body, and the text file that carries it.

The file is the one of FEMBS, SIMPACK, MatMorembs, Neweul-M2 and DLR's FlexibleBodies (.SID_FEM):

    part
      new modal =
        refmod ... end refmod                     mass, number and names of the coordinates
        frame new node = 1 ... end node end frame origin, phi, psi, AP (and sigma) of the nodes
        mdCM, J, Ct, Cr, Me, Gr, Ge, Oe, ksigma, Ke, De
      end modal
    end part

Every matrix is a Taylor expansion in the elastic coordinates q, of order 0 or 1: entries
`m0( row, col)` and `m1( row, coordinate, col)`, counted from one; those left out are zero. With
frame acceleration a, angular velocity w and acceleration g, all in the body frame, the inertia
force, moment about the origin and elastic rows are

    F = m a + g x s + w x (w x s) + 2 w x (Ct' qd) + Ct' qdd,  s = mdCM(q)
    T = s x a + J(q) g + w x (J(q) w) + sum_k qd_k Gr_k(q) w + Cr(q)' qdd
    f = Ct a + Cr(q) g + sum_k qd_k Ge_k w + Oe(q) [w1^2 w2^2 w3^2 w1w2 w2w3 w1w3]' + Me qdd

where Gr_k and Ge_k are the k-th blocks of three columns.
Source: Wallrapp, Standardization of flexible body modeling in multibody system codes (1994),
doi:10.1080/08905459408905214; Schwertassek & Wallrapp, Dynamik flexibler Mehrkörpersysteme
(1999).
"""

from dolfinopt.exchange.sid.arrays import read_sid_npz, sid_arrays, write_sid_npz
from dolfinopt.exchange.sid.data import (
    DIAGONAL,
    GENERAL,
    SYMMETRIC,
    UNIT,
    ZERO,
    Node,
    StandardInputData,
    Taylor,
    structure_of,
    taylor,
)
from dolfinopt.exchange.sid.read import read_sid
from dolfinopt.exchange.sid.write import sid_text, write_sid

__all__ = [
    "DIAGONAL",
    "GENERAL",
    "SYMMETRIC",
    "UNIT",
    "ZERO",
    "Node",
    "StandardInputData",
    "Taylor",
    "read_sid",
    "read_sid_npz",
    "sid_arrays",
    "sid_text",
    "structure_of",
    "taylor",
    "write_sid",
    "write_sid_npz",
]
