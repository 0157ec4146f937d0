"""Rotations in space: rotation vectors with exact derivatives, axes and angles, URDF's frames.

A rotation vector theta, x = theta . theta, turns by
    R = exp(theta~) = 1 + c_1 theta~ + c_2 theta~^2,
and with J = 1 + c_2 theta~ + c_3 theta~^2 the rate theta' is the angular velocity J theta', in the
components of the frame that theta turns away from. c_k(x) = sum_j (-x)^j / (2 j + k)! have the
derivatives c_k' = (k c_(k+2) - c_(k+1)) / 2 without a division: nothing is lost at small angles.
At large ones, where the series cancels, they follow from sine and cosine.
All functions take complex numbers, whose imaginary part is then a derivative.
Source: Stumpff (1959); Simo & Vu-Quoc (1988), doi:10.1016/0045-7825(88)90073-4; Sola, Deray &
Atchuthan (2018), arXiv:1812.01537.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import factorial

import numpy as np

# Terms of the series: 1e-24 at x = 1, and 1e-40 up to x = FAR, where rounding has grown to 1e-15.
TERMS, NEAR = 10, 1.0
MANY_TERMS, FAR = 40, 10.0

ONE: np.ndarray = np.eye(3)
_NEXT, _OTHER = np.array([1, 2, 0]), np.array([2, 0, 1])


def cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return u x v (..., 3)."""
    return u[..., _NEXT] * v[..., _OTHER] - u[..., _OTHER] * v[..., _NEXT]


def skew(v: np.ndarray) -> np.ndarray:
    """Return v~ (..., 3, 3), v~ u = v x u."""
    out = np.zeros((*v.shape, 3), dtype=v.dtype)
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def axial(A: np.ndarray) -> np.ndarray:
    """Return (A_yz - A_zy, A_zx - A_xz, A_xy - A_yx) (..., 3) of matrices (..., 3, 3)."""
    return np.stack([A[..., j, k] - A[..., k, j] for j, k in ((1, 2), (2, 0), (0, 1))], axis=-1)


def dot(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return u . v (...) of vectors (..., 3)."""
    return (u * v).sum(axis=-1)


def times(A: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return A v (n, 3) of matrices (n, 3, 3), or one (3, 3), and vectors (n, 3)."""
    return v @ A.T if A.ndim == 2 else np.einsum("nij,nj->ni", A, v)


def transposed_times(A: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return A' v (n, 3)."""
    return v @ A if A.ndim == 2 else np.einsum("nji,nj->ni", A, v)


def series(x: np.ndarray, orders: int = 8) -> list[np.ndarray]:
    """Return c_0 ... c_(orders-1) at x (n,): by their series, or those of many turns closed."""
    far = np.abs(x) > FAR
    if not far.any():
        return _series(x, orders)
    near = _series(np.where(far, 0.0, x), orders)
    large = _closed(np.where(far, x, FAR), orders)
    return [np.where(far, b, a) for a, b in zip(near, large, strict=True)]


def _closed(x: np.ndarray, orders: int) -> list[np.ndarray]:
    """Return c_0 = cos(angle), c_1 = sin(angle) / angle, c_(k+2) = (1 / k! - c_k) / x."""
    angle = np.sqrt(x)
    found = [np.cos(angle), np.sin(angle) / angle]
    for k in range(orders - 2):
        found.append((1.0 / factorial(k) - found[k]) / x)
    return found


def _series(x: np.ndarray, orders: int) -> list[np.ndarray]:
    terms = TERMS if np.abs(x).max(initial=0.0) <= NEAR else MANY_TERMS
    last = [_horner(x, k, terms) for k in (orders - 1, orders - 2)]
    found = last
    for k in range(orders - 3, -1, -1):
        found.append(1.0 / factorial(k) - x * found[-2])
    return found[::-1]


def _horner(x: np.ndarray, k: int, terms: int) -> np.ndarray:
    value = np.zeros_like(x)
    for j in range(terms - 1, -1, -1):
        value = 1.0 / factorial(2 * j + k) - x * value
    return value


def exponential(theta: np.ndarray) -> np.ndarray:
    """Return R (..., 3, 3) of rotation vectors (..., 3)."""
    c = series(dot(theta, theta), 3)
    A = skew(theta)
    return ONE + c[1][..., None, None] * A + c[2][..., None, None] * (A @ A)


def about(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the rotations (n, 3, 3) about a unit axis (3,) by angles (n,)."""
    A = skew(axis)
    # Of a column NumPy takes other instructions, and another last bit, where the end of its stride
    # touches the memory of the result.
    angle = np.ascontiguousarray(angle)
    s, c = np.sin(angle), np.cos(angle)
    return ONE + s[:, None, None] * A + (1.0 - c)[:, None, None] * (A @ A)


def roll_pitch_yaw(rpy: tuple[float, float, float]) -> np.ndarray:
    """Return the rotation (3, 3) of URDF's fixed-axis roll, pitch, yaw: Rz(y) Ry(p) Rx(r)."""
    x, y, z = (about(ONE[i], np.array([angle]))[0] for i, angle in enumerate(rpy))
    R: np.ndarray = z @ y @ x
    return R


@dataclass(frozen=True, eq=False)
class Turning:
    """A rotation vector and its rates, and the motion they are; arrays over n instants.

    Attributes:
        theta, rate, second: (n, 3) rotation vector, its first and second derivative.
    """

    theta: np.ndarray
    rate: np.ndarray
    second: np.ndarray

    @cached_property
    def _c(self) -> list[np.ndarray]:
        return [c[:, None] for c in series(dot(self.theta, self.theta))]

    @cached_property
    def _first(self) -> tuple[np.ndarray, np.ndarray]:
        """c_2', c_3' (n, 1)."""
        return _derivative(self._c, 2), _derivative(self._c, 3)

    @cached_property
    def _second(self) -> tuple[np.ndarray, np.ndarray]:
        """c_2'', c_3'' (n, 1)."""
        c = self._c
        first = {k: _derivative(c, k) for k in (3, 4, 5)}
        return 0.5 * (2 * first[4] - first[3]), 0.5 * (3 * first[5] - first[4])

    @cached_property
    def R(self) -> np.ndarray:
        """The rotation (n, 3, 3)."""
        A, c = skew(self.theta), self._c
        return ONE + c[1][..., None] * A + c[2][..., None] * (A @ A)

    @cached_property
    def J(self) -> np.ndarray:
        """Angular velocity by the rate (n, 3, 3)."""
        A, c = skew(self.theta), self._c
        return ONE + c[2][..., None] * A + c[3][..., None] * (A @ A)

    @cached_property
    def velocity(self) -> np.ndarray:
        """Angular velocity J theta' (n, 3)."""
        return times(self.J, self.rate)

    @cached_property
    def acceleration(self) -> np.ndarray:
        """Its derivative J theta'' + J' theta' (n, 3)."""
        theta, v, c = self.theta, self.rate, self._c
        along = dot(theta, v)[:, None]
        first, second = self._first
        turned = cross(theta, v)
        bent = 2.0 * along * (first * turned + second * cross(theta, turned))
        return times(self.J, self.second) + bent + c[3] * cross(v, turned)

    def by_theta(self, v: np.ndarray, sign: float = 1.0) -> np.ndarray:
        """Return the derivative of J v by theta (n, 3, 3); of J' v with `sign` = -1."""
        theta, c = self.theta, self._c
        x, along = dot(theta, theta)[:, None], dot(theta, v)[:, None]
        first, second = self._first
        turned = 2.0 * sign * first * cross(theta, v) + 2.0 * second * (along * theta - x * v)
        out = -sign * c[2][..., None] * skew(v) + _outer(turned, theta)
        return out + c[3][..., None] * (
            along[..., None] * ONE + _outer(theta, v) - 2.0 * _outer(v, theta)
        )

    @cached_property
    def acceleration_by_theta(self) -> np.ndarray:
        """Derivative of `acceleration` by theta (n, 3, 3)."""
        theta, v, c = self.theta, self.rate, self._c
        x, s, square = dot(theta, theta)[:, None], dot(theta, v)[:, None], dot(v, v)[:, None]
        (d2, d3), (dd2, dd3) = self._first, self._second
        turned, plane = cross(theta, v), s * theta - x * v
        out = self.by_theta(self.second)
        out = out + _outer(2.0 * d2 * turned + 2.0 * d3 * plane - c[3] * v, v)
        out += _outer(4.0 * s * (dd2 * turned + dd3 * plane), theta)
        out += _outer(2.0 * d3 * (square * theta - s * v), theta)
        out -= (2.0 * d2 * s)[..., None] * skew(v)
        out += (c[3] * square + 2.0 * d3 * s * s)[..., None] * ONE
        return out + (2.0 * d3 * s)[..., None] * (_outer(theta, v) - 2.0 * _outer(v, theta))

    @cached_property
    def acceleration_by_rate(self) -> np.ndarray:
        """Derivative of `acceleration` by theta' (n, 3, 3): d(J theta')/d theta + J'."""
        theta, v, c = self.theta, self.rate, self._c
        A, B = skew(theta), skew(v)
        s = 2.0 * dot(theta, v)[:, None, None]
        first, second = (x[..., None] for x in self._first)
        rate = c[2][..., None] * B + s * (first * A + second * (A @ A))
        return self.by_theta(v) + rate + c[3][..., None] * (A @ B + B @ A)


def _derivative(c: list[np.ndarray], k: int) -> np.ndarray:
    """Return c_k' by x."""
    return 0.5 * (k * c[k + 2] - c[k + 1])


def _outer(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return u v' (n, 3, 3)."""
    return u[..., :, None] * v[..., None, :]
