"""What differs between the plane and space in the mechanics of moving frames, d = 2 or 3.

Vectors are (d, n) and angular velocities (r, n), r = 1 or 3, the n instants last: NumPy then runs
along them. Between the first axis and the last there may be one of derivatives. A frame with
angular velocity w and acceleration wd accelerates the point p by A p + 2 Omega p' + p'', with

    A = wd~ + w~ w~ = sum_c alpha_c E_c,   2 Omega = 2 w~ = sum_c beta_c E_c

in the matrices E_c of `shape_integrals`: two in the plane, the nine units in space. A moment is
p x f, the adjoint of the velocity w x p. Second moments G_c = int p' E_c q become moments by

    int p x (A p + 2 Omega p' + p'') = torque(alpha, int p' E p) + torque(beta, int p' E p') + ...

A rotation vector theta, x = theta . theta, turns by
    R = exp(theta~) = 1 + c_1 theta~ + c_2 theta~^2,
and with J = 1 + c_2 theta~ + c_3 theta~^2 the rate theta' is the angular velocity J theta', in the
components of the frame that theta turns away from. c_k(x) = sum_j (-x)^j / (2 j + k)! have the
derivatives c_k' = (k c_(k+2) - c_(k+1)) / 2 without a division: nothing is lost at small angles.
At large ones they follow from sine and cosine.
Source: Stumpff (1959); Simo & Vu-Quoc (1988), doi:10.1016/0045-7825(88)90073-4; Sola, Deray &
Atchuthan (2018), arXiv:1812.01537.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from math import factorial
from typing import TypeAlias

import numpy as np

from dolfinopt.multibody.measured import SERIES_LIMIT, SERIES_TERMS


def product(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return A B (i, ..., n) of matrices (i, j, n), or one (i, j), and (j, ..., n)."""
    if A.ndim == 2:
        return A.dot(B.reshape(len(B), -1)).reshape(len(A), *B.shape[1:])  # faster than @
    out: np.ndarray = np.einsum("ijn,j...n->i...n", A, B)
    return out


def compose(R: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Return R S of rotations (d, d, n), or one (d, d)."""
    return np.einsum("ijn,jk->ikn", R, S) if S.ndim == 2 < R.ndim else product(R, S)


class Bilinear:
    """The function sum_jk T_...jk x_j y_k (..., n) of x (j, ..., n) and y (k, ..., n)."""

    def __init__(self, T: np.ndarray) -> None:
        """Take T."""
        self._shape, flat = T.shape, T.reshape(-1, *T.shape[-2:]).swapaxes(1, 2)
        self._rows, self._by_x = len(flat), flat.reshape(-1, T.shape[-2])

    def matrix(self, x: np.ndarray) -> np.ndarray:
        """Return its derivative by y (i, k, ..., n), of T's first axes as one."""
        result = self._by_x.dot(x.reshape(len(x), -1))
        return result.reshape(self._rows, self._shape[-1], *x.shape[1:])

    def __call__(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return its value."""
        out: np.ndarray = np.einsum("ij...,j...->i...", self.matrix(x), y)
        return out.reshape(*self._shape[:-2], *out.shape[1:])


def components(E: np.ndarray) -> np.ndarray:
    """Return the matrices (g, d, d) whose products with a matrix are its components by E_c."""
    return E / np.square(E).sum(axis=(1, 2), keepdims=True)


class Dimension:
    """The plane or space: everything follows from the matrices E_c and S_r, w~ = sum_r w_r S_r.

    Functions of two arguments take and return (., ..., n).

    Attributes:
        d, r, g, b: numbers of entries of vectors, angular velocities, E_c, and of an interface's
            displacement and rotation.
        E: (g, d, d).
        trace: (g, 1) of the identity: p'' is the sum of these E_c.
        loads: of K0's accelerations their places in the order of a and E_c.
        turning: of a rotation by theta.
        velocity: w x p.
        moment: p x f.
        commutator: w x v of angular velocities.
        apply: A p of the entries alpha of A; applied: the same of p and alpha.
        torque: the moment of accelerations alpha by second moments G; torque_of: of G and alpha.
        turned: its adjoint, the entries of (w~)' y.
        spin: (g, r) entries of w~ by w.
    """

    def __init__(
        self, E: np.ndarray, S: np.ndarray, loads: list[int], turning: Callable[..., Turning]
    ) -> None:
        """Take the matrices."""
        self.E, self.loads, self.turning = E, np.array(loads), turning
        self.d, self.r, self.g, self.b = E.shape[1], len(S), len(E), E.shape[1] + len(S)
        in_E = components(E)
        self.spin = np.einsum("cab,rab->cr", in_E, S)
        self._transposed = np.einsum("cab,eba->ce", in_E, E)
        self.trace = np.trace(in_E, axis1=1, axis2=2)[:, None]
        squares = np.einsum("cab,rad,sdb->crs", in_E, S, S)
        torque = np.einsum("eab,rda,cdb->rce", in_E, S, E)
        self._square, self._by_spin = Bilinear(squares), Bilinear(squares + squares.swapaxes(1, 2))
        self.velocity, self.moment = Bilinear(S.swapaxes(0, 1)), Bilinear(S.swapaxes(1, 2))
        self.commutator = Bilinear(np.einsum("tab,rad,sdb->trs", S, S, S))
        self.apply, self.applied = Bilinear(E.swapaxes(0, 1)), Bilinear(E.transpose(1, 2, 0))
        self.torque, self.torque_of = Bilinear(torque), Bilinear(torque.swapaxes(1, 2))
        self.turned = Bilinear(torque.transpose(2, 0, 1))

    def skew(self, w: np.ndarray) -> np.ndarray:
        """Return w~ (d, d, ...) of angular velocities (r, ...)."""
        return self.velocity.matrix(w)

    def by_spin(self, p: np.ndarray) -> np.ndarray:
        """Return the derivative of w x p by w (d, r, n)."""
        return self.moment.matrix(p).swapaxes(0, 1)

    def transposed(self, x: np.ndarray) -> np.ndarray:
        """Return the entries (g, ..., n) of the transposed matrices."""
        return product(self._transposed, x)

    def alpha(self, w: np.ndarray, wd: np.ndarray) -> np.ndarray:
        """Return the entries (g, n) of A."""
        return self._square(w, w) + self.spin.dot(wd)

    def beta(self, w: np.ndarray) -> np.ndarray:
        """Return the entries (g, n) of 2 Omega."""
        return product(self.spin, 2.0 * w)

    def spin_gradient(self, w: np.ndarray, by_alpha: np.ndarray, by_beta: np.ndarray) -> np.ndarray:
        """Return derivatives (2 r, ..., n) by w and wd from those by alpha and beta (g, ..., n)."""
        alpha_by_spin = self._by_spin.matrix(w)
        by_w = product(alpha_by_spin.swapaxes(0, 1), by_alpha) - 2.0 * self.axial(by_beta)
        return np.concatenate([by_w, -self.axial(by_alpha)])

    def axial(self, G: np.ndarray) -> np.ndarray:
        """Return `torque` (r, ..., n) of second moments with accelerations themselves."""
        return product(-self.spin.T, G)

    def rotated(self, R: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return angular velocities (r, ..., n) in other components; in the plane the same."""
        return w if self.r == 1 else product(R, w)

    def turn(self, R: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return vectors and what follows them, angular velocities, in other components."""
        if self.r == 1:
            return np.concatenate([product(R, x[:2]), x[2:]])
        rows = x.reshape(-1, 3, *x.shape[1:])
        out: np.ndarray = np.einsum("ij...,kj...->ki...", R, rows).reshape(x.shape)
        return out

    def shifted(self, p: np.ndarray, load: np.ndarray) -> np.ndarray:
        """Return a load (d + r, n) at p about the origin."""
        out = load.copy()
        out[self.d :] += self.moment(p, load[: self.d])
        return out

    def rotation_vector(self, R: np.ndarray) -> np.ndarray:
        """Return the rotation vectors (r, n) of rotations (d, d, n), at most pi long."""
        from scipy.spatial.transform import Rotation  # takes as long to import as NumPy

        if self.r == 1:
            return np.arctan2(R[1, 0], R[0, 0])[None]
        out: np.ndarray = Rotation.from_matrix(np.moveaxis(R, -1, 0)).as_rotvec().T
        return out

    def softness(self, B: np.ndarray, K: np.ndarray, point: np.ndarray) -> float:
        """Return how far an interface of modes B (b, q) at `point` goes by a unit force, at most.

        In the plane across, or a third of the arm's length squared times its rotation by a unit
        moment, which is the same of a cantilever, and not zero of an arm whose frame is its chord.
        """
        soft = B @ np.linalg.solve(K, B.T)
        if self.r == 1:
            return max(float(soft[1, 1]), float(soft[2, 2]) * float(point @ point) / 3.0)
        return float(np.linalg.eigvalsh(0.5 * (soft + soft.T)[:3, :3])[-1])


class PlaneTurning:
    """A rotation by theta (1, n) with its rates, and the motion that they are."""

    def __init__(self, theta: np.ndarray, rate: np.ndarray, second: np.ndarray) -> None:
        """Take the angle and its rates."""
        self.theta, self.velocity, self.acceleration = theta, rate, second

    J = np.ones((1, 1, 1))

    @cached_property
    def R(self) -> np.ndarray:
        """The rotation (2, 2, n)."""
        out = np.empty((2, 2, self.theta.shape[1]), dtype=self.theta.dtype)
        np.cos(self.theta[0], out=out[0, 0])
        np.sin(self.theta[0], out=out[1, 0])
        out[1, 1], out[0, 1] = out[0, 0], -out[1, 0]
        return out

    def jacobian_times(self, x: np.ndarray) -> np.ndarray:
        """Return J x (r, ..., n): the angular velocity of a rate."""
        return x

    jacobian_transposed = jacobian_times

    def by_theta(self, v: np.ndarray, sign: float = 1.0) -> np.ndarray | None:
        """Return the derivative of J v by theta; of J' v with `sign` = -1. None: zero."""
        return None


class SpaceTurning:
    """A rotation vector theta (3, n) with its rates, and the motion that they are.

    All functions take complex numbers, whose imaginary part is then a derivative.
    """

    def __init__(self, theta: np.ndarray, rate: np.ndarray, second: np.ndarray) -> None:
        """Take the vector and its rates."""
        self.theta, self.rate, self.second = theta, rate, second

    @cached_property
    def _c(self) -> list[np.ndarray]:
        return series((self.theta * self.theta).sum(axis=0))

    @cached_property
    def _first(self) -> tuple[np.ndarray, np.ndarray]:
        """c_2', c_3'."""
        return _derivative(self._c, 2), _derivative(self._c, 3)

    @cached_property
    def _second(self) -> tuple[np.ndarray, np.ndarray]:
        """c_2'', c_3''."""
        first = {k: _derivative(self._c, k) for k in (3, 4, 5)}
        return 0.5 * (2 * first[4] - first[3]), 0.5 * (3 * first[5] - first[4])

    @cached_property
    def R(self) -> np.ndarray:
        """The rotation (3, 3, n)."""
        return rotation(self.theta, self._c, 1)

    @cached_property
    def J(self) -> np.ndarray:
        """Angular velocity by the rate (3, 3, n)."""
        return rotation(self.theta, self._c, 2)

    def jacobian_times(self, x: np.ndarray) -> np.ndarray:
        """Return J x (3, ..., n): the angular velocity of a rate."""
        return product(self.J, x)

    def jacobian_transposed(self, x: np.ndarray) -> np.ndarray:
        """Return J' x (3, ..., n)."""
        return product(self.J.swapaxes(0, 1), x)

    @cached_property
    def velocity(self) -> np.ndarray:
        """Angular velocity J theta' (3, n)."""
        return self.jacobian_times(self.rate)

    @cached_property
    def acceleration(self) -> np.ndarray:
        """Its derivative J theta'' + J' theta' (3, n)."""
        theta, v = self.theta, self.rate
        along = 2.0 * (theta * v).sum(axis=0)
        first, second = self._first
        turned = SPACE.velocity(theta, v)
        bent = (along * first) * turned + (along * second) * SPACE.velocity(theta, turned)
        return self.jacobian_times(self.second) + bent + self._c[3] * SPACE.velocity(v, turned)

    def by_theta(self, v: np.ndarray, sign: float = 1.0) -> np.ndarray:
        """Return the derivative of J v by theta (3, 3, n); of J' v with `sign` = -1."""
        theta, c = self.theta, self._c
        x, along = (theta * theta).sum(axis=0), (theta * v).sum(axis=0)
        first, second = self._first
        turned = 2.0 * sign * first * SPACE.velocity(theta, v)
        turned += 2.0 * second * (along * theta - x * v) - 2.0 * c[3] * v
        out = turned[:, None] * theta + (c[3] * theta)[:, None] * v
        out[[0, 1, 2], [0, 1, 2]] += c[3] * along
        out += SPACE.skew(-sign * c[2] * v)
        return out

    @cached_property
    def acceleration_by_theta(self) -> np.ndarray:
        """Derivative of `acceleration` by theta (3, 3, n)."""
        theta, v, c = self.theta, self.rate, self._c
        x, s, square = (theta * theta).sum(axis=0), (theta * v).sum(axis=0), (v * v).sum(axis=0)
        (d2, d3), (dd2, dd3) = self._first, self._second
        turned, plane = SPACE.velocity(theta, v), s * theta - x * v
        left = 4.0 * s * (dd2 * turned + dd3 * plane) + 2.0 * d3 * (square * theta - 2.0 * s * v)
        out = self.by_theta(self.second) + left[:, None] * theta
        left = 2.0 * d2 * turned + 2.0 * d3 * (plane + s * theta) - c[3] * v
        out += left[:, None] * v
        out -= (2.0 * d3 * s * v)[:, None] * theta
        out[[0, 1, 2], [0, 1, 2]] += c[3] * square + 2.0 * d3 * s * s
        out += SPACE.skew(-2.0 * d2 * s * v)
        return out

    @cached_property
    def acceleration_by_rate(self) -> np.ndarray:
        """Derivative of `acceleration` by theta' (3, 3, n): d(J theta')/d theta + J'."""
        theta, v, c = self.theta, self.rate, self._c
        s = (theta * v).sum(axis=0)
        first, second = self._first
        out = self.by_theta(v)
        out += SPACE.skew(c[2] * v + 2.0 * s * first * theta)
        # theta~ theta~ = theta theta' - x, theta~ v~ + v~ theta~ = v theta' + theta v' - 2 s
        x = (theta * theta).sum(axis=0)
        out += (2.0 * s * second * theta + c[3] * v)[:, None] * theta
        out += (c[3] * theta)[:, None] * v
        out[[0, 1, 2], [0, 1, 2]] -= 2.0 * s * (second * x + c[3])
        return out


def rotation(theta: np.ndarray, c: list[np.ndarray], k: int) -> np.ndarray:
    """Return 1 + c_k theta~ + c_(k+1) theta~^2 (3, 3, n)."""
    out = (c[k + 1] * theta)[:, None] * theta
    out[[0, 1, 2], [0, 1, 2]] += 1.0 - c[k + 1] * (theta * theta).sum(axis=0)
    out += SPACE.skew(c[k] * theta)
    return out


def series(x: np.ndarray, orders: int = 8) -> list[np.ndarray]:
    """Return c_0 ... c_(orders-1) at x (n,): by their series, or those of large angles closed."""
    far = np.abs(x) > SERIES_LIMIT
    if not far.any():
        return _series(x, orders)
    near = _series(np.where(far, 0.0, x), orders)
    large = _closed(np.where(far, x, SERIES_LIMIT), orders)
    return [np.where(far, b, a) for a, b in zip(near, large, strict=True)]


def _closed(x: np.ndarray, orders: int) -> list[np.ndarray]:
    """Return c_0 = cos(angle), c_1 = sin(angle) / angle, c_(k+2) = (1 / k! - c_k) / x."""
    angle = np.sqrt(x)
    result = [np.cos(angle), np.sin(angle) / angle]
    for k in range(orders - 2):
        result.append((1.0 / factorial(k) - result[k]) / x)
    return result


def _series(x: np.ndarray, orders: int) -> list[np.ndarray]:
    last = np.zeros((2, *x.shape), dtype=x.dtype)  # c_(orders-1) and the one before
    column = (2, *(1,) * x.ndim)
    for j in range(SERIES_TERMS - 1, -1, -1):
        first = [1.0 / factorial(2 * j + k) for k in (orders - 1, orders - 2)]
        last = np.reshape(first, column) - x * last
    result = list(last)
    for k in range(orders - 3, -1, -1):
        result.append(1.0 / factorial(k) - x * result[-2])
    return result[::-1]


def _derivative(c: list[np.ndarray], k: int) -> np.ndarray:
    """Return c_k' by x."""
    return 0.5 * (k * c[k + 2] - c[k + 1])


Turning: TypeAlias = "PlaneTurning | SpaceTurning"

_PERMUTED = np.cross(np.eye(3)[:, None], np.eye(3))  # S_r = e_r~, of which this is the transpose
_QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])
PLANE = Dimension(np.stack([np.eye(2), _QUARTER]), _QUARTER[None], [0, 1, 3, 2], PlaneTurning)
SPACE = Dimension(
    np.eye(9).reshape(9, 3, 3), _PERMUTED.swapaxes(1, 2), list(range(12)), SpaceTurning
)
DIMENSIONS = {2: PLANE, 3: SPACE}
