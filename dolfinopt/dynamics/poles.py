"""Poles of a linearised machine, and their derivatives by its motion and its bodies.

Source: Tisseur & Meerbergen (2001), doi:10.1137/S0036144500381988.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.dynamics.linearised import DIFFERENCES, OFFSETS, Linearised
from dolfinopt.dynamics.measured import POLE_STEP
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, add_integrals


def damping_ratios(poles: np.ndarray) -> np.ndarray:
    """Return -Re / |pole|; of a pole at zero 0."""
    size = np.abs(poles)
    return np.divide(-poles.real, size, out=np.zeros_like(size), where=size > 0.0)


@dataclass(frozen=True, eq=False)
class Poles:
    """Solutions of w^T N^T (M p'' + D p' + K p) = 0 for all w of a machine, P of them.

    p = N v, p' = lambda p + N' v and p'' = lambda^2 p + 2 lambda N' v + N'' v are a vibration's
    displacements, rates and accelerations; the latter hold the multipliers' changes, too.

    Attributes:
        one: the machine.
        values: lambda (P,) complex, 1/s, those above the real axis or on it.
        vibrations: p, p', p'' (3, S, P).
        left: N w (S, P), w being scaled so that w^T d(N^T (M p'' + D p' + K p)) / dlambda = 1.
        constraint_weights: (3, m, P) of g, g' and g'': what their derivatives, changed, make of
            lambda through N.
    """

    linear: Linearised
    values: np.ndarray
    vibrations: np.ndarray
    left: np.ndarray
    constraint_weights: np.ndarray

    def gradient(self, by_values: np.ndarray) -> tuple[np.ndarray, list[ShapeIntegrals]]:
        """Differentiate a real function of the poles.

        dlambda = -d(left . r + constraint_weights . (g, g', g'')), each linearised along the
        vibration, by all that they depend on: central differences along it of their derivatives.

        Args:
            by_values: (P,) complex, dJ = Re(sum by_values dlambda).

        Returns:
            By the system's coordinates and their rates (3, 1, S), and by every body's integrals.
        """
        # With no pole one of no weight: what follows has an instant at least.
        used = np.flatnonzero(by_values) if by_values.any() else np.zeros(1, dtype=int)
        S, system = len(self.left), self.linear.system
        along = _real_parts(self.vibrations[:, :, used])
        left = _real_parts(-by_values[used] * self.left[:, used], conjugate=True)
        held = _real_parts(-by_values[used] * self.constraint_weights[:, :, used], conjugate=True)
        reach = self.linear.to_rates[0][-1] @ np.stack([self.linear.size(np.abs(x)) for x in along])
        steps = POLE_STEP / np.where(reach > 0.0, reach, 1.0)
        offsets = np.multiply.outer(OFFSETS, steps)  # (7, k)
        shares = np.multiply.outer(DIFFERENCES[1], 1.0 / steps)
        change = (along[..., None, :] * offsets).reshape(3, S, -1).transpose(0, 2, 1)
        rows = (left[:, None, :] * shares).reshape(S, -1).T.copy()
        rates = self.linear.rates[:, None] + change
        instants = system.at(np.repeat(self.linear.t, len(rows)))
        tangent = instants.linearise(*rates)
        by_rates = np.stack([x.sum(axis=0) for x in tangent.transposed(rows)])
        by_bodies = instants.state(*rates).body_gradient(rows)
        if system.loops is not None:
            held = (held[:, :, None, :] * shares).reshape(*held.shape[:2], -1)
            own, parts = self._by_constraints(change, held.transpose(0, 2, 1))
            by_rates[:, : system.ends[1]] += own
            by_bodies = [add_integrals(a, b) for a, b in zip(by_bodies, parts, strict=True)]
        return by_rates[:, None], by_bodies

    def _by_constraints(
        self, change: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, list[dict[str, np.ndarray]]]:
        """Return the slopes of sum_kn weights_kn . d^k g_n / dt^k by rates (3, R + N), and bodies.

        Args:
            change: (3, n, S) of the rates, of every motion along which g is differentiated.
            weights: (3, n, m).
        """
        linear, columns, moving = (
            self.linear,
            self.linear.system.columns,
            self.linear.system.ends[1],
        )
        move, differentiate = linear.to_rates
        poses = np.repeat((move @ linear.motion)[:, None], change.shape[1], axis=1)
        poses[:, :, columns] += np.tensordot(move, change[:, :, :moving], 1)
        here = linear.loops(poses.reshape(-1, poses.shape[2]))
        by_gap = np.tensordot(differentiate.T, weights, 1).reshape(-1, weights.shape[2])
        by_pose = np.einsum("nm,nmc->nc", by_gap, here.jacobian)[:, columns]
        by_rates = move.T @ by_pose.reshape(len(move), -1, moving).sum(axis=1)
        none = np.zeros_like(by_gap), np.zeros((len(by_gap), poses.shape[2]))
        return by_rates, here.gradient(by_gap, *none)


def _real_parts(x: np.ndarray, conjugate: bool = False) -> np.ndarray:
    """Return the real parts (..., 2 P) of x (..., P) and of what is left: Re(a b) by products."""
    return np.concatenate([x.real, -x.imag if conjugate else x.imag], axis=-1)


def poles_of(linearised: Linearised) -> Poles:
    """Return the poles of a machine.

    Raises:
        InputError: a coordinate has no mass.
    """
    from scipy.linalg import eig

    _, D, M = linearised.reduced
    n, (_, moving, last) = len(M), linearised.system.ends
    values, left, right = eig(linearised.A, left=True, right=True)
    above = np.flatnonzero(values.imag >= 0.0)
    values, v = values[above], right[:n, above]
    w = np.linalg.solve(M.T, np.conj(left[n:, above]))
    w = w / np.einsum("ip,ip->p", w, 2.0 * values * (M @ v) + D @ v)
    N, Nd, Ndd = linearised.directions
    p, W = N @ v, N @ w
    vibrations = np.stack(
        [p, values * p + Nd @ v, values**2 * p + 2.0 * values * (Nd @ v) + Ndd @ v]
    )
    forces = (
        linearised.K @ vibrations[0] + linearised.D @ vibrations[1] + linearised.M @ vibrations[2]
    )
    rows = np.setdiff1d(np.arange(len(N)), np.arange(moving, last))
    vibrations[2, moving:last] = -np.linalg.pinv(linearised.M[rows, moving:last]) @ forces[rows]
    # W weighs changes of p, p' and p'' of the dependent coordinates, which changes of G make.
    G, Gd, Gdd = linearised.constraints[:, :, linearised.dependent].swapaxes(1, 2)
    K, D, M = (x[:, linearised.dependent].T @ W for x in (linearised.K, linearised.D, linearised.M))
    inverse = np.linalg.pinv(G)
    third = inverse @ M
    second = inverse @ (D - 2.0 * Gd @ third)
    first = inverse @ (K - Gd @ second - Gdd @ third)
    return Poles(linearised, values, vibrations, W, -np.stack([first, second, third]))
