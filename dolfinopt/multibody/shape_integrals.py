"""The inertia shape integrals (standard input data) of one flexible body, in the plane or in space.

With reference positions X and modes Phi of d components the point p of a body is p = N eta with
N = [X, Phi_1 ... Phi_q] and eta = (1, q). All that its inertia needs are integrals over the mass

    m = int 1,   w_a = int N_a,   W_c = int N' E_c N

with the matrices E_c that a frame's angular velocity and acceleration are made of: the identity and
the rotation by 90 degrees in the plane, the nine units in space. What every integral is multiplied
by in a denser, stiffer or more damped material, and which of its axes run over the coordinates,
stands beside it in one table: scaling, change of basis, addition and gradients follow from it.
Source: Wallrapp (1994), doi:10.1080/08905459408905214; Schwertassek & Wallrapp (1999).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.multibody.dimension import DIMENSIONS, components

if TYPE_CHECKING:
    from dolfinopt.fem.elasticity import ElasticArm
    from dolfinopt.fem.geometric_stiffness import UnitLoads
    from dolfinopt.reduction import Basis


@dataclass(frozen=True)
class Integral:
    """What one field of `ShapeIntegrals` is.

    Attributes:
        name: of the field.
        scale: "mass", "stiffness" or "damping", which it is proportional to; None: geometry.
        modes: axes that run over the q coordinates.
        rigid: those axes have 1 + q entries, the first one for the reference position.
    """

    name: str
    scale: str | None = None
    modes: tuple[int, ...] = ()
    rigid: bool = False


# A further integral is a field of `ShapeIntegrals` and a line here.
TABLE = (
    Integral("mass", "mass"),
    Integral("w", "mass", modes=(1,), rigid=True),
    Integral("W", "mass", modes=(1, 2), rigid=True),
    Integral("K", "stiffness", modes=(0, 1)),
    Integral("D", "damping", modes=(0, 1)),
    Integral("outboard", modes=(1,)),
    Integral("outboard_point"),
    Integral("K0", "mass", modes=(1, 2)),
    Integral("K0_outboard", modes=(1, 2)),
    Integral("further_points"),
    Integral("along_modes", modes=(0, 1, 2)),
)

STIFFENING = ("K0", "K0_outboard", "along_modes")


@dataclass(frozen=True, eq=False)
class ShapeIntegrals:
    """One body reduced to q elastic coordinates in its tangent frame at the inboard joint.

    d is 2 and g, the number of E_c, 2 in the plane; 3 and 9 in space. The derivatives of a scalar
    by these integrals are kept in the same form (`Mechanism`'s adjoint): entry by entry, so that
    the sum of products with a change of the integrals is the change of the scalar.

    Attributes:
        mass: m, kg.
        w: (d, 1 + q) int N_a; kg m for X in m.
        W: (g, 1 + q, 1 + q) int N' E_c N; kg m2.
        K: (q, q) stiffness Phi' K Phi.
        D: (q, q) damping.
        outboard: (b, q) displacement and rotation of the outboard interfaces in each mode: b is 3
            in the plane, in space 6 of every interface.
        outboard_point: (d,) reference position of the first of them, m.
        K0: (d + g, q, q) geometric stiffness by the inertia of unit accelerations of the frame:
            a_x, a_y, wd and -w^2 in the plane, kg and kg m; (0, q, q) of a body that is linear.
        K0_outboard: (b, q, q) that of unit forces and moments at the outboard interfaces, 1/m and
            1 for modes in m; (0, q, q) likewise.
        further_points: (i, d) reference positions of the others, m; none in the plane.
        along_modes: (q, q, q) L of the displacement of second order along the modes, M^-1 times
            the geometric stiffness by the modes' inertia, see `body`; (0, q, q) where
            it is not known, as of bodies from files.
    """

    mass: float
    w: np.ndarray
    W: np.ndarray
    K: np.ndarray
    D: np.ndarray
    outboard: np.ndarray
    outboard_point: np.ndarray
    K0: np.ndarray
    K0_outboard: np.ndarray
    further_points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    along_modes: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 0)))

    @property
    def points(self) -> np.ndarray:
        """Reference positions of all outboard interfaces in space (1 + i, 3), m."""
        return np.concatenate([self.outboard_point[None], self.further_points])

    @property
    def num_modes(self) -> int:
        """Number q of elastic coordinates."""
        return len(self.K)

    def __add__(self, other: ShapeIntegrals) -> ShapeIntegrals:
        """Return the sum of derivatives, integral by integral."""
        return add_integrals(self, integrals_of(other))

    @property
    def is_stiffened(self) -> bool:
        """Whether geometric stiffness is known."""
        return len(self.K0) > 0

    @cached_property
    def M(self) -> np.ndarray:
        """Int Phi_k . Phi_l (q, q)."""
        return np.tensordot(DIMENSIONS[len(self.w)].trace[:, 0], self.W[:, 1:, 1:], 1)

    def inertia_about_centre(self) -> tuple[np.ndarray, np.ndarray]:
        """Return centre (3,), m, and inertia (3, 3) about it, kg m2, undeformed and in space."""
        centre = self.w[:, 0] / self.mass if self.mass else np.zeros(3)
        second = self.W[:, 0, 0].reshape(3, 3) - self.mass * np.outer(centre, centre)
        return centre, np.trace(second) * np.eye(3) - second

    # -- the same body otherwise -----------------------------------------------------------------

    def in_basis(self, T: np.ndarray) -> ShapeIntegrals:
        """Return the body in the coordinates z with q = T z; T is (q, q')."""
        changed: dict[str, Any] = {}
        for item in TABLE:
            if item.modes:
                first = 1 if item.rigid else 0
                value = getattr(self, item.name)
                changed[item.name] = _transformed(value, T, len(item.modes), first)
        return replace(self, **changed)

    @property
    def rigid_part(self) -> ShapeIntegrals:
        """The body with its elastic coordinates held at zero."""
        return linear_part(self).in_basis(np.zeros((self.num_modes, 0)))

    def padded(self, like: ShapeIntegrals) -> ShapeIntegrals:
        """Return derivatives by a `rigid_part` as those by the whole body: zero by its modes."""
        integrals = self.in_basis(np.zeros((0, like.num_modes)))
        zero: dict[str, Any] = {name: np.zeros_like(getattr(like, name)) for name in STIFFENING}
        return replace(integrals, **zero)

    @property
    def first_frequency(self) -> float:
        """Lowest natural frequency of the reduced clamped-free body, Hz; inf if rigid."""
        if self.num_modes == 0:
            return float("inf")
        inverse = np.linalg.inv(np.linalg.cholesky(self.M))
        values = np.linalg.eigvalsh(inverse @ self.K @ inverse.T)
        return float(np.sqrt(max(values[0], 0.0)) / (2.0 * np.pi))


# -- what follows from the table -------------------------------------------------------------


def scaled(body: ShapeIntegrals, mass: float, stiffness: float, damping: float) -> ShapeIntegrals:
    """Return a body (or derivatives) with every integral times the factor of its kind."""
    factors = {"mass": mass, "stiffness": stiffness, "damping": damping}
    changed = {i.name: factors[i.scale] * getattr(body, i.name) for i in TABLE if i.scale}
    return replace(body, **changed)


def integrals_of(body: ShapeIntegrals) -> dict[str, Any]:
    """Return all integrals, or derivatives by them, under their names."""
    return {item.name: getattr(body, item.name) for item in TABLE}


def add_integrals(body: ShapeIntegrals, more: Mapping[str, Any]) -> ShapeIntegrals:
    """Return derivatives by a body's integrals plus those by some of them, under their names."""
    return replace(body, **{name: getattr(body, name) + value for name, value in more.items()})


def of_material(
    body: ShapeIntegrals, mass: float, stiffness: float, damping: float
) -> ShapeIntegrals:
    """Return the body of a denser, stiffer material.

    Args:
        body: reduced; its basis is that of the other material, too.
        mass, stiffness: factors.
        damping: beta in D = beta K of the result, s.
    """
    other = scaled(body, mass, stiffness, 1.0)
    return replace(other, D=damping * other.K)


def _transformed(value: np.ndarray, T: np.ndarray, rank: int, first: int) -> np.ndarray:
    """Return x T or T' x T in the last `rank` axes behind their `first` entries, which stay."""
    # Of three axes the first one is that of coordinates themselves: T^-1 x.
    if rank == 3:
        if len(value) == 0:
            return np.zeros((0, T.shape[1], T.shape[1]))
        return np.tensordot(np.linalg.pinv(T), _transformed(value, T, 2, first), 1)
    every = np.zeros((first + T.shape[0], first + T.shape[1]))
    every[range(first), range(first)], every[first:, first:] = 1.0, T
    out = value @ every
    return out if rank == 1 else every.T @ out


# -- from finite elements --------------------------------------------------------------------


def by_modal_loads(body: ShapeIntegrals, by: ShapeIntegrals) -> tuple[ShapeIntegrals, np.ndarray]:
    """Return derivatives by integrals without L, and those by the K0 that it is made of.

    Args:
        body: whose L is M^-1 K0.
        by: derivatives by its integrals.

    Returns:
        The derivatives, those by L among those by M, and those by K0 (q, q, q).
    """
    L, W = body.along_modes, by.W.copy()
    by_K0 = np.linalg.solve(body.M, by.along_modes.reshape(len(L), -1)).reshape(L.shape)
    diagonal = DIMENSIONS[len(by.w)].trace[:, 0] > 0.0
    W[diagonal, 1:, 1:] -= np.tensordot(by_K0, L, ((1, 2), (1, 2)))
    return replace(by, W=W), by_K0


def shape_integrals(
    arm: ElasticArm,
    basis: Basis,
    stiffness_proportional: float,
    loads: UnitLoads | None = None,
) -> ShapeIntegrals:
    """Integrate the body's inertia over its current design (collective on the arm's ranks).

    Args:
        arm: with its design set.
        basis: of that design.
        stiffness_proportional: beta in D = beta K, s.
        loads: of that design, whose stress stiffens the body; None of a linear body.
    """
    q = basis.V.shape[2]
    dim = DIMENSIONS[arm.points.shape[1]]
    mass, w, W = integrated(arm, basis, dim.E)
    K0 = by_modes = by_outboard = np.zeros((0, q, q))
    if loads is not None:
        ends = [loads.num_frame, loads.num_inertial]
        K0, by_modes, by_outboard = np.split(loads.geometric_stiffness(basis.V), ends)
    if len(by_modes):
        M = np.tensordot(dim.trace[:, 0], W[:, 1:, 1:], 1)
        by_modes = np.linalg.solve(M, by_modes.reshape(q, -1)).reshape(by_modes.shape)
    return ShapeIntegrals(
        mass=mass,
        w=w,
        W=W,
        K=basis.stiffness,
        D=stiffness_proportional * basis.stiffness,
        outboard=basis.outboard,
        outboard_point=arm.mesh.outboard_point,
        K0=K0,
        K0_outboard=by_outboard,
        further_points=arm.mesh.further_points,
        along_modes=by_modes,
    )


def integrated(
    arm: ElasticArm, basis: Basis, E: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return m, w and W of the design by the matrices E (collective on the arm's ranks)."""
    X, V, MV = arm.points, basis.V, basis.MV
    q = V.shape[2]
    rigid = arm.rigid_inertia  # M [1, X], per component
    MX, MV_flat = rigid[:, :, 1], MV.reshape(X.size, q)
    EX, EV = _applied(E, X), _applied(E, V).reshape(len(E), X.size, q)
    parts = (
        rigid[:, 0, 0].sum(),
        MX.sum(axis=0),
        MV.sum(axis=0),
        np.array([np.sum(item * MX) for item in EX]),
        np.array([np.einsum("ni,nik->k", item, MV) for item in EX]),
        MV_flat.T @ EV,
    )
    mass, moment, C, second, first, modes = map(arm.comm.allreduce, parts)
    return float(mass), np.column_stack([moment, C]), _assembled(E, second, first, modes)


def _applied(E: np.ndarray, field: np.ndarray) -> np.ndarray:
    """Return E_c times every node's vectors (c, n, d, ...); E is sparse."""
    out = np.zeros((len(E), *field.shape))
    for c, a, b in np.argwhere(E):
        out[c, :, a] += E[c, a, b] * field[:, b]
    return out


def _assembled(
    E: np.ndarray, second: np.ndarray, first: np.ndarray, modes: np.ndarray
) -> np.ndarray:
    """Return W (g, 1 + q, 1 + q) of int X' E_c X, int Phi' E_c X and int Phi' E_c Phi."""
    # The integral with E_c' is the transposed one: exactly, so that rounding goes.
    partners = np.einsum("cab,eba->ce", components(E), E)
    q = first.shape[1]
    W = np.empty((len(E), 1 + q, 1 + q))
    W[:, 0, 0] = 0.5 * (second + partners @ second)
    W[:, 1:, 0] = first
    W[:, 0, 1:] = partners @ first
    W[:, 1:, 1:] = 0.5 * (modes + np.tensordot(partners, modes.swapaxes(1, 2), 1))
    return W


@dataclass(frozen=True, eq=False)
class MassPartners:
    """Nodal fields through which a function of the integrals feels the mass matrix; n nodes.

    With dJ = sum_k left_k . dM right_k and, by the modes, dJ = sum_k (M by_modes)_k . dV_k; by the
    nodes' places likewise.

    Attributes:
        left, right: (n, d, 2 + q).
        by_modes: (n, d, q).
        by_points: (n, d).
    """

    left: np.ndarray
    right: np.ndarray
    by_modes: np.ndarray
    by_points: np.ndarray


def mass_partners(points: np.ndarray, V: np.ndarray, by: ShapeIntegrals) -> MassPartners:
    """Return the fields that carry derivatives by the integrals to the mass of the cells.

    Of sum_c Wbar_c,kl int N_k . E_c N_l the left factor is Y_l = sum_c,k E_c' N_k Wbar_c,kl.

    Args:
        points: (n, d) nodes, m.
        V: (n, d, q) modes.
        by: derivatives by the integrals.
    """
    N, E = np.concatenate([points[:, :, None], V], axis=2), DIMENSIONS[points.shape[1]].E
    unit = np.zeros_like(N[:, :, :1])
    unit[:, 0] = 1.0  # m = int 1_x . 1_x
    quadratic = np.einsum("cab,nak,ckl->nbl", E, N, by.W, optimize=True)
    transposed = np.einsum("cab,nbk,clk->nal", E, N, by.W, optimize=True)
    left = np.concatenate([quadratic + by.w, by.mass * unit], axis=2)
    by_N = quadratic + transposed + by.w
    right = np.concatenate([N, unit], axis=2)
    return MassPartners(left, right, by_modes=by_N[:, :, 1:], by_points=by_N[:, :, 0])


# -- single bodies ---------------------------------------------------------------------------


def rigid_body(
    mass: float, moment: np.ndarray, inertia: float, outboard_point: np.ndarray
) -> ShapeIntegrals:
    """Return a plane body without elastic coordinates, or the derivatives by one.

    Args:
        mass: kg.
        moment: (2,) first moment about the frame's origin, kg m.
        inertia: about it, kg m2.
        outboard_point: (2,) m.
    """
    return _rigid(mass, moment, 0.5 * inertia * np.eye(2), outboard_point[None])


def _rigid(
    mass: float, moment: np.ndarray, second: np.ndarray, points: np.ndarray
) -> ShapeIntegrals:
    """Return a rigid body of moments int X (d,) and int X X' (d, d), interfaces at `points`."""
    dim, square, none = DIMENSIONS[len(moment)], np.zeros((0, 0)), np.zeros((0, 0, 0))
    W = np.einsum("cab,ab->c", dim.E, second)[:, None, None]
    modes = np.zeros((dim.b * len(points), 0))
    return ShapeIntegrals(
        float(mass), moment[:, None], W, square, square, modes, points[0], none, none, points[1:]
    )


def rigid_spatial_body(
    mass: float,
    centre: np.ndarray | tuple[float, ...],
    inertia: np.ndarray | tuple[float, ...],
    outboard_point: np.ndarray | tuple[float, ...] = (0.0, 0.0, 0.0),
    further_points: np.ndarray | tuple[tuple[float, ...], ...] = (),
) -> ShapeIntegrals:
    """Return a spatial body without elastic coordinates.

    Args:
        mass: kg.
        centre: (3,) of mass, m.
        inertia: (6,) xx, yy, zz, xy, xz, yz of the inertia tensor about the centre, as in URDF,
            kg m2.
        outboard_point: (3,) of its outboard interface, m.
        further_points: (i, 3) of others, m.
    """
    r, tensor = np.asarray(centre, dtype=float), inertia_tensor(inertia)
    # int x_a x_b = tr(I)/2 delta - I about the centre, and m r r' more about the frame's origin.
    second = 0.5 * np.trace(tensor) * np.eye(3) - tensor + mass * np.outer(r, r)
    points = np.reshape([outboard_point, *further_points], (-1, 3)).astype(float)
    return _rigid(mass, mass * r, second, points)


def inertia_tensor(inertia: np.ndarray | tuple[float, ...]) -> np.ndarray:
    """Return the tensor (3, 3) of xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = inertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], dtype=float)


def rigid_bar(
    length: float, height: float, mass: float, inertia: float | None = None
) -> ShapeIntegrals:
    """Return a bar without elastic coordinates, its centre halfway.

    Args:
        length, height: m.
        mass: kg.
        inertia: about its centre, kg m2; None: of a rectangular bar.
    """
    if inertia is None:
        inertia = mass * (length**2 + height**2) / 12.0
    inertia += mass * length**2 / 4.0
    return rigid_body(mass, np.array([0.5 * mass * length, 0.0]), inertia, np.array([length, 0.0]))


def linear_part(body: ShapeIntegrals) -> ShapeIntegrals:
    """Return the body without geometric stiffness."""
    linear: Any = np.zeros((0, body.num_modes, body.num_modes))
    return replace(body, **dict.fromkeys(STIFFENING, linear))


Rates = tuple[np.ndarray, np.ndarray, np.ndarray]  # q, qd, qdd
