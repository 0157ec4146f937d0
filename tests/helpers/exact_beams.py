"""Two arms as geometrically exact beams: a model of their motion that shares nothing with ours.

Reissner's plane beam: with r' the slope of the centre line, e and n the section's axes, theta its
rotation, the strains r' . e - 1, r' . n and theta' have the stiffness EA, GA and EI, and viscous
forces by their rates. Elements have two nodes and one point of integration, masses are lumped.
Source: Simo & Vu-Quoc (1986), doi:10.1115/1.3171870; in time the generalised-alpha method, Chung &
Hulbert (1993), doi:10.1115/1.2900803.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

RADIUS = 0.9  # spectral radius at high frequencies
DIFFERENCE = 1e-7  # of coordinates, m and rad


@dataclass(frozen=True)
class Beam:
    """A straight beam of n elements.

    Attributes:
        length: m.
        stiffness: EA (N), GA (N), EI (N m2).
        inertia: mass (kg/m) and rotary inertia (kg m) a length.
        damping: viscous forces over elastic ones, s.
        n: number of elements.
    """

    length: float
    stiffness: tuple[float, float, float]
    inertia: tuple[float, float]
    damping: float
    n: int

    def forces(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the forces (..., n, 6) of elements with the coordinates u and their rates v."""
        size, C = self.length / self.n, np.array(self.stiffness)
        slope, rate = (u[..., 3:] - u[..., :3]) / size, (v[..., 3:] - v[..., :3]) / size
        theta, spin = 0.5 * (u[..., 2] + u[..., 5]), 0.5 * (v[..., 2] + v[..., 5])
        along = _turned(slope, theta)
        turning = np.stack([along[..., 1], -along[..., 0], np.zeros_like(spin)], axis=-1)
        rates = _turned(rate, theta) + turning * spin[..., None]
        force = C * (along - [1.0, 0.0, 0.0] + self.damping * rates)
        pull, twist = _turned(force, -theta), 0.5 * size * (force * turning).sum(axis=-1)
        found = np.concatenate([-pull, pull], axis=-1)
        found[..., [2, 5]] += twist[..., None]
        return found

    def tangent(self, u: np.ndarray, v: np.ndarray, of_rates: bool) -> np.ndarray:
        """Return the derivatives (n, 6, 6) of the forces by u, or by v, by central differences."""
        steps = DIFFERENCE * np.eye(6)[:, None]
        ends = [(u, v + x) if of_rates else (u + x, v) for x in (steps, -steps)]
        plus, minus = (
            self.forces(*(np.broadcast_to(x, (6, *u.shape)) for x in end)) for end in ends
        )
        return np.moveaxis(plus - minus, 0, -1) / (2.0 * DIFFERENCE)


def _turned(x: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Return (x, y, z) in axes turned by theta about z."""
    c, s = np.cos(theta), np.sin(theta)
    return np.stack(
        [c * x[..., 0] + s * x[..., 1], c * x[..., 1] - s * x[..., 0], x[..., 2]], axis=-1
    )


@dataclass(frozen=True, eq=False)
class TwoBeams:
    """Two beams on a cart; unknown are all nodes (x, y, theta) but the inboard ones.

    Attributes:
        beam: both.
        height: y of the joint on the cart, m.
        payload: at the outboard end, kg.
    """

    beam: Beam
    height: float
    payload: float

    def tip(self, t: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Return the places (m, 2) of the outboard end, m, of a machine that begins at rest.

        Args:
            t: (m,) equally spaced instants, s.
            joints: (3, m, 3) cart (m), first angle, second angle against the first beam's end
                (rad), and two derivatives.
        """
        A, mass, h = self._nodes(), self._mass(), t[1] - t[0]
        given = np.zeros((3, len(t), len(A)))
        half = 3 * (self.beam.n + 1)
        given[:, :, 0], given[:, :, 2] = joints[:, :, 0], joints[:, :, 1]
        given[0, :, 1], given[:, :, half + 2] = self.height, joints[:, :, 2]
        am, af = (2.0 * RADIUS - 1.0) / (RADIUS + 1.0), RADIUS / (RADIUS + 1.0)
        gamma, beta = 0.5 - am + af, 0.25 * (1.0 - am + af) ** 2
        z, v, a = self._straight(joints[0, 0]), np.zeros(A.shape[1]), np.zeros(A.shape[1])
        places = [z[-3:-1]]
        for k in range(1, len(t)):
            old, inverse, b = (z, v, a), None, (1 - af) * given[:, k] + af * given[:, k - 1]
            b[2] = (1 - am) * given[2, k] + am * given[2, k - 1]
            z, v = z + h * v + 0.5 * h * h * a, v + h * a
            for _ in range(20):
                u, rate = (A @ ((1 - af) * new + af * x) + y for new, x, y in zip((z, v), old, b))
                acceleration = A @ ((1 - am) * a + am * old[2]) + b[2]
                residual = A.T @ (mass * acceleration + self._forces(u, rate))
                if inverse is None:
                    K, D = (A.T @ self._matrix(u, rate, of_rates) @ A for of_rates in (False, True))
                    M = A.T @ (mass[:, None] * A)
                    inverse = np.linalg.inv(
                        (1 - am) * M + (1 - af) * h * (gamma * D + beta * h * K)
                    )
                change = -inverse @ residual
                z, v, a = z + beta * h * h * change, v + gamma * h * change, a + change
                if np.abs(change).max() * h * h < 1e-12:
                    break
            places.append(z[-3:-1])
        return np.array(places)

    def _nodes(self) -> np.ndarray:
        """Return what all nodes of both beams are by the unknowns."""
        half = 3 * (self.beam.n + 1)
        A = np.zeros((2 * half, 2 * half - 6))
        A[3:half, : half - 3] = A[half + 3 :, half - 3 :] = np.eye(half - 3)
        A[half : half + 3, half - 6 : half - 3] = np.eye(3)
        return A

    def _straight(self, joints: np.ndarray) -> np.ndarray:
        """Return the unknowns of straight beams."""
        cart, first, second = joints
        start, found = np.array([cart, self.height]), []
        for angle in (first, first + second):
            s = np.linspace(0.0, self.beam.length, self.beam.n + 1)[1:]
            place = start + np.outer(s, [np.cos(angle), np.sin(angle)])
            found.append(np.column_stack([place, np.full(len(s), angle)]))
            start = place[-1]
        return np.concatenate(found).ravel()

    def _mass(self) -> np.ndarray:
        mass, inertia = self.beam.inertia
        share = np.full(self.beam.n + 1, self.beam.length / self.beam.n)
        share[[0, -1]] *= 0.5
        own = np.outer(share, [mass, mass, inertia])
        whole = np.concatenate([own, own])
        whole[-1, :2] += self.payload
        return whole.ravel()

    def _elements(self) -> np.ndarray:
        """Return the places (2 n, 6) of the elements' coordinates."""
        first = np.arange(self.beam.n)
        return 3 * np.concatenate([first, first + self.beam.n + 1])[:, None] + np.arange(6)

    def _forces(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        places, out = self._elements(), np.zeros_like(u)
        np.add.at(out, places, self.beam.forces(u[places], v[places]))
        return out

    def _matrix(self, u: np.ndarray, v: np.ndarray, of_rates: bool) -> np.ndarray:
        places, out = self._elements(), np.zeros((len(u), len(u)))
        own = self.beam.tangent(u[places], v[places], of_rates)
        np.add.at(out, (places[:, :, None], places[:, None]), own)
        return out
