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
        return (A @ B.reshape(len(B), -1)).reshape(len(A), *B.shape[1:])
    out: np.ndarray = np.einsum("ijn,j...n->i...n", A, B)
    return out


def compose(R: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Return R S of rotations (d, d, n), or one (d, d)."""
    return np.einsum("ijn,jk->ikn", R, S) if S.ndim == 2 < R.ndim else product(R, S)


def transposed_product(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return A' B (j, ..., n) likewise."""
    return product(A.swapaxes(0, 1), B)


class Plane:
    """d = 2: E_c are the identity and the rotation S by 90 degrees."""

    d, r, g, b = 2, 1, 2, 3
    loads = np.array([0, 1, 3, 2])  # of K0's accelerations a_x, a_y, wd, -w^2: in the order of E_c
    trace = np.array([[1.0], [0.0]])  # p'' is the sum of these E_c

    @staticmethod
    def skew(axis: np.ndarray) -> np.ndarray:
        """Return w~ (2, 2) of one angular velocity (1,)."""
        return np.array([[0.0, -axis[0]], [axis[0], 0.0]])

    @staticmethod
    def transposed(x: np.ndarray) -> np.ndarray:
        """Return the entries (g, ..., n) of the transposed matrices."""
        return np.stack([x[0], -x[1]])

    @staticmethod
    def alpha(w: np.ndarray, wd: np.ndarray) -> np.ndarray:
        """Return the entries (g, n) of A."""
        return np.concatenate([-w * w, wd])

    @staticmethod
    def beta(w: np.ndarray) -> np.ndarray:
        """Return the entries (g, n) of 2 Omega."""
        return np.concatenate([np.zeros_like(w), 2.0 * w])

    @staticmethod
    def apply(alpha: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return sum_c alpha_c E_c p (d, ..., n)."""
        x, y = alpha
        out = x * p
        out[0] -= y * p[1]
        out[1] += y * p[0]
        return out

    @staticmethod
    def applied_transposed(alpha: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return sum_c alpha_c E_c' p (d, n)."""
        return Plane.apply(alpha * np.array([[1.0], [-1.0]]), p)

    @staticmethod
    def velocity(w: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return w x p (d, ..., n)."""
        return np.stack([-w[0] * p[1], w[0] * p[0]])

    @staticmethod
    def moment(p: np.ndarray, f: np.ndarray) -> np.ndarray:
        """Return p x f (r, ..., n)."""
        out: np.ndarray = (p[0] * f[1] - p[1] * f[0])[None]
        return out

    @staticmethod
    def commutator(w: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return w x v (r, ..., n) of angular velocities: zero."""
        return np.asarray(0.0 * (w * v))

    @staticmethod
    def by_spin(p: np.ndarray) -> np.ndarray:
        """Return the derivative of w x p by w (d, r, n)."""
        return np.stack([-p[1], p[0]])[:, None]

    @staticmethod
    def centripetal_by_spin(w: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return the derivative of A p by w (d, r, n)."""
        return (-2.0 * w * p)[:, None]

    @staticmethod
    def torque(alpha: np.ndarray, G: np.ndarray) -> np.ndarray:
        """Return the moment (r, ..., n) of accelerations alpha_c E_c by second moments G."""
        out: np.ndarray = (alpha[1] * G[0] - alpha[0] * G[1])[None]
        return out

    @staticmethod
    def axial(G: np.ndarray) -> np.ndarray:
        """Return `torque` of second moments with accelerations themselves."""
        return -G[1:]

    @staticmethod
    def turned(w: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the entries of (w~)' y (g, ..., n), of which `torque` is the adjoint."""
        return np.stack([w[0] * y[1], -w[0] * y[0]])

    @staticmethod
    def torque_by_spin(
        w: np.ndarray, G: np.ndarray, H: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives (r, r, n) of torque(alpha, G) + torque(beta, H) by w and wd."""
        return (2.0 * H[0])[None, None], G[0][None, None]

    @staticmethod
    def contracted_by_spin(
        w: np.ndarray, Y: np.ndarray, Yd: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives (r, q, n) of alpha_c Y_c + beta_c Yd_c by w and wd."""
        return (2.0 * (Yd[1] - w[0] * Y[0]))[None], Y[1:]

    @staticmethod
    def rotated(R: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return angular velocities in other components: the same."""
        return w

    @staticmethod
    def rotation_vector(R: np.ndarray) -> np.ndarray:
        """Return the angles (1, n) of rotations (2, 2, n), from -pi to pi."""
        return np.arctan2(R[1, 0], R[0, 0])[None]

    @staticmethod
    def softness(B: np.ndarray, K: np.ndarray, point: np.ndarray) -> float:
        """Return how far an interface of modes B (3, q) at `point` goes by a unit force across."""
        # Or a third of the arm's length squared times its rotation by a unit moment, which is the
        # same of a cantilever, and not zero of an arm whose frame is its chord.
        soft = B @ np.linalg.solve(K, B.T)
        return max(float(soft[1, 1]), float(soft[2, 2]) * float(point @ point) / 3.0)


_TRANSPOSED = np.arange(9).reshape(3, 3).T.ravel()


class Space:
    """d = 3: E_ab has a one at (a, b)."""

    d, r, g, b = 3, 3, 9, 6
    loads = np.arange(12)
    trace = np.eye(3).reshape(9, 1)

    @staticmethod
    def skew(axis: np.ndarray) -> np.ndarray:
        """Return w~ (3, 3) of one angular velocity (3,), or (3, 3, n)."""
        x, y, z = axis
        out = np.zeros((3, *axis.shape), dtype=axis.dtype)
        out[0, 1], out[0, 2], out[1, 2] = -z, y, -x
        out[1, 0], out[2, 0], out[2, 1] = z, -y, x
        return out

    @staticmethod
    def transposed(x: np.ndarray) -> np.ndarray:
        """Return the entries (9, ..., n) of the transposed matrices."""
        return x[_TRANSPOSED]

    @staticmethod
    def alpha(w: np.ndarray, wd: np.ndarray) -> np.ndarray:
        """Return the entries (9, n) of A."""
        A = w[:, None] * w
        x, y, z = A[0, 0].copy(), A[1, 1].copy(), A[2, 2].copy()
        A[0, 0], A[1, 1], A[2, 2] = -(y + z), -(x + z), -(x + y)
        _add_skew(A, wd)
        return A.reshape(9, -1)

    @staticmethod
    def beta(w: np.ndarray) -> np.ndarray:
        """Return the entries (9, n) of 2 Omega."""
        return Space.skew(2.0 * w).reshape(9, -1)

    @staticmethod
    def apply(alpha: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return A p (3, ..., n)."""
        return product(alpha.reshape(3, 3, -1), p)

    @staticmethod
    def applied_transposed(alpha: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return A' p (3, n)."""
        return transposed_product(alpha.reshape(3, 3, -1), p)

    @staticmethod
    def velocity(w: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return w x p (3, ..., n)."""
        first = w[1] * p[2] - w[2] * p[1]
        out = np.empty((3, *first.shape), dtype=first.dtype)
        out[0] = first
        np.subtract(w[2] * p[0], w[0] * p[2], out=out[1])
        np.subtract(w[0] * p[1], w[1] * p[0], out=out[2])
        return out

    moment = commutator = velocity

    @staticmethod
    def by_spin(p: np.ndarray) -> np.ndarray:
        """Return the derivative of w x p by w (3, 3, n)."""
        return Space.skew(-p)

    @staticmethod
    def centripetal_by_spin(w: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return the derivative of A p by w, w p' + (w . p) 1 - 2 p w' (3, 3, n)."""
        out = w[:, None] * p - 2.0 * (p[:, None] * w)
        out[[0, 1, 2], [0, 1, 2]] += (w * p).sum(axis=0)
        return out

    @staticmethod
    def torque(alpha: np.ndarray, G: np.ndarray) -> np.ndarray:
        """Return the moment axial(G A') (3, ..., n)."""
        A, pairs = alpha.reshape(3, 3, -1), G.reshape(3, 3, *G.shape[1:])
        found = np.einsum("bcn,ac...n->ab...n", A, pairs)
        return Space.axial(found.reshape(9, *found.shape[2:]))

    @staticmethod
    def axial(G: np.ndarray) -> np.ndarray:
        """Return (G_yz - G_zy, G_zx - G_xz, G_xy - G_yx) (3, ..., n)."""
        return np.stack([G[5] - G[7], G[6] - G[2], G[1] - G[3]])

    @staticmethod
    def turned(w: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return (w~)' y (9, ..., n), of which `torque` is the adjoint."""
        rows = y.reshape(3, 3, *y.shape[1:])
        out = Space.velocity(-w, rows)
        return out.reshape(y.shape)

    @staticmethod
    def torque_by_spin(
        w: np.ndarray, G: np.ndarray, H: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives (3, 3, n) of torque(alpha, G) + torque(beta, H) by w and wd."""
        diagonal = [0, 1, 2], [0, 1, 2]
        inertia, trace = -G.reshape(3, 3, -1), G[::4].sum(axis=0)
        inertia[diagonal] += trace
        by_w = Space.velocity(w, inertia)  # of every column
        _add_skew(by_w, -product(inertia, w))
        by_w -= 2.0 * H.reshape(3, 3, -1).swapaxes(0, 1)
        by_w[diagonal] += 2.0 * H[::4].sum(axis=0)
        return by_w, inertia

    @staticmethod
    def contracted_by_spin(
        w: np.ndarray, Y: np.ndarray, Yd: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives (3, q, n) of alpha_c Y_c + beta_c Yd_c by w and wd."""
        rows = Y.reshape(3, 3, *Y.shape[1:])
        by_w = np.einsum("an,abkn->bkn", w, rows + rows.swapaxes(0, 1))
        by_w -= 2.0 * (w[:, None] * Y[::4].sum(axis=0))
        by_w -= 2.0 * Space.axial(Yd)
        return by_w, -Space.axial(Y)

    @staticmethod
    def rotated(R: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return R w (3, ..., n)."""
        return product(R, w)

    @staticmethod
    def rotation_vector(R: np.ndarray) -> np.ndarray:
        """Return the rotation vectors (3, n) of rotations (3, 3, n), at most pi long."""
        from scipy.spatial.transform import Rotation  # takes as long to import as NumPy

        out: np.ndarray = Rotation.from_matrix(np.moveaxis(R, -1, 0)).as_rotvec().T
        return out

    @staticmethod
    def softness(B: np.ndarray, K: np.ndarray, point: np.ndarray) -> float:
        """Return how far an interface of modes B (6, q) goes by a unit force, at most."""
        soft = B[:3] @ np.linalg.solve(K, B[:3].T)
        return float(np.linalg.eigvalsh(0.5 * (soft + soft.T))[-1])


def _add_skew(A: np.ndarray, v: np.ndarray) -> None:
    """Add v~ to matrices (3, 3, n)."""
    A[0, 1] -= v[2]
    A[1, 0] += v[2]
    A[2, 0] -= v[1]
    A[0, 2] += v[1]
    A[1, 2] -= v[0]
    A[2, 1] += v[0]


class PlaneTurning:
    """A rotation by theta (1, n) with its rates, and the motion that they are."""

    def __init__(self, theta: np.ndarray, rate: np.ndarray, second: np.ndarray) -> None:
        """Take the angle and its rates."""
        self.theta, self.velocity, self.acceleration = theta, rate, second

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
        return transposed_product(self.J, x)

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
        turned = Space.velocity(theta, v)
        bent = (along * first) * turned + (along * second) * Space.velocity(theta, turned)
        return self.jacobian_times(self.second) + bent + self._c[3] * Space.velocity(v, turned)

    def by_theta(self, v: np.ndarray, sign: float = 1.0) -> np.ndarray:
        """Return the derivative of J v by theta (3, 3, n); of J' v with `sign` = -1."""
        theta, c = self.theta, self._c
        x, along = (theta * theta).sum(axis=0), (theta * v).sum(axis=0)
        first, second = self._first
        turned = 2.0 * sign * first * Space.velocity(theta, v)
        turned += 2.0 * second * (along * theta - x * v) - 2.0 * c[3] * v
        out = turned[:, None] * theta + (c[3] * theta)[:, None] * v
        out[[0, 1, 2], [0, 1, 2]] += c[3] * along
        _add_skew(out, -sign * c[2] * v)
        return out

    @cached_property
    def acceleration_by_theta(self) -> np.ndarray:
        """Derivative of `acceleration` by theta (3, 3, n)."""
        theta, v, c = self.theta, self.rate, self._c
        x, s, square = (theta * theta).sum(axis=0), (theta * v).sum(axis=0), (v * v).sum(axis=0)
        (d2, d3), (dd2, dd3) = self._first, self._second
        turned, plane = Space.velocity(theta, v), s * theta - x * v
        left = 4.0 * s * (dd2 * turned + dd3 * plane) + 2.0 * d3 * (square * theta - 2.0 * s * v)
        out = self.by_theta(self.second) + left[:, None] * theta
        left = 2.0 * d2 * turned + 2.0 * d3 * (plane + s * theta) - c[3] * v
        out += left[:, None] * v
        out -= (2.0 * d3 * s * v)[:, None] * theta
        out[[0, 1, 2], [0, 1, 2]] += c[3] * square + 2.0 * d3 * s * s
        _add_skew(out, -2.0 * d2 * s * v)
        return out

    @cached_property
    def acceleration_by_rate(self) -> np.ndarray:
        """Derivative of `acceleration` by theta' (3, 3, n): d(J theta')/d theta + J'."""
        theta, v, c = self.theta, self.rate, self._c
        s = (theta * v).sum(axis=0)
        first, second = self._first
        out = self.by_theta(v)
        _add_skew(out, c[2] * v + 2.0 * s * first * theta)
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
    _add_skew(out, c[k] * theta)
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
    found = [np.cos(angle), np.sin(angle) / angle]
    for k in range(orders - 2):
        found.append((1.0 / factorial(k) - found[k]) / x)
    return found


def _series(x: np.ndarray, orders: int) -> list[np.ndarray]:
    last = np.zeros((2, *x.shape), dtype=x.dtype)  # c_(orders-1) and the one before
    column = (2, *(1,) * x.ndim)
    for j in range(SERIES_TERMS - 1, -1, -1):
        first = [1.0 / factorial(2 * j + k) for k in (orders - 1, orders - 2)]
        last = np.reshape(first, column) - x * last
    found = list(last)
    for k in range(orders - 3, -1, -1):
        found.append(1.0 / factorial(k) - x * found[-2])
    return found[::-1]


def _derivative(c: list[np.ndarray], k: int) -> np.ndarray:
    """Return c_k' by x."""
    return 0.5 * (k * c[k + 2] - c[k + 1])


Dimension: TypeAlias = "type[Plane] | type[Space]"
Turning: TypeAlias = "PlaneTurning | SpaceTurning"

DIMENSIONS: dict[int, tuple[Dimension, Callable[..., Turning]]] = {
    2: (Plane, PlaneTurning),
    3: (Space, SpaceTurning),
}
