"""What the rotation of second order of a rigid interface adds to the geometric stiffness.

A node of the outboard interface, r from its point of reference, moves by u + (exp(theta~) - 1) r,
theta being the rotation vector. The linear modes hold u + theta x r of it; the reaction R_p of the
interface's nodes to a unit load does work along the rest, theta x (theta x r) / 2:

    K0_p[i, j] gains theta_i' D_p theta_j,   D_p = S_p - tr(S_p) 1,   S_p = sym(sum R_p r').

In the plane theta has one component and D_p is -tr(S_p).

Without it a rotation of the interface would strain the cells beside it, whose stress across the
arm is large, and a moment M at the interface would act on nodes that keep the directions of their
forces: a quasi-tangential moment. With it M works along the rotation vector, as a semi-tangential
one does to second order (Ziegler 1968, Principles of Structural Stability), under which a
cantilever buckles at twice the moment.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from dolfinopt.fem.elasticity import ElasticArm


class FaceRotation:
    """The outboard interfaces of one design of an arm; m of them, c rotations each.

    Of d directions c is 1 in the plane and 3 in space; an interface has d + c coordinates.
    """

    def __init__(self, arm: ElasticArm):
        """Gather the cells beside the interfaces."""
        self.arm = arm
        cells = arm.operators.cells
        self._near = np.flatnonzero(arm.outboard[cells].any(axis=1))
        self._nodes = cells[self._near]
        self._levers = _levers(arm.rigid)

    @cached_property
    def _fit(self) -> np.ndarray:
        """The field (n_nodes, d, (d + c) m) whose products with modes are coordinates, summed."""
        rigid = self.arm.rigid
        rows = rigid[self.arm.outboard].reshape(-1, rigid.shape[2])
        return rigid @ np.linalg.inv(self.arm.comm.allreduce(rows.T @ rows))

    def _rotations(self, V: np.ndarray) -> np.ndarray:
        """Return the rotation vectors (m, c, q) in modes (n_nodes, d, q) (collective)."""
        found = self.arm.comm.allreduce(np.tensordot(self._fit, V, ((0, 1), (0, 1))))
        return found.reshape(len(self._levers), -1, V.shape[2])[:, V.shape[1] :]

    def tensors(self, fields: np.ndarray, accelerations: np.ndarray) -> np.ndarray:
        """Return D (m, p, c, c) of unit loads, N m each (collective).

        Args:
            fields: (n_nodes, d, p) their static fields u_p.
            accelerations: (n_nodes, d, k) of the first k loads, whose inertia loads the nodes.
        """
        arm, nodes = self.arm, self._nodes
        values = fields[nodes] - fields[nodes].mean(axis=1, keepdims=True)
        forces = self._stiffness_times(values)
        inertia = np.einsum("enm,emap->enap", arm.operators.mass[self._near], accelerations[nodes])
        inertia *= arm.density[self._near, None, None, None]
        forces[..., : accelerations.shape[2]] -= inertia
        S = arm.comm.allreduce(np.einsum("enap,ienb->ipab", forces, self._levers[:, nodes]))
        return _deviated(0.5 * (S + S.swapaxes(2, 3)))

    def stiffness(self, D: np.ndarray, V: np.ndarray) -> np.ndarray:
        """Return what K0 (p, q, q) gains in modes V (n_nodes, d, q) (collective)."""
        theta = self._rotations(V)[:, None]
        return (theta.swapaxes(2, 3) @ D @ theta).sum(axis=0)

    def gradient(
        self, D: np.ndarray, V: np.ndarray, by_K0: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Differentiate a function of what K0 gains, given its derivative by it (p, q, q).

        It is sum_p y_p . (K u_p - f_p) with nodal fields y, zero but at the interfaces.

        Returns:
            By the modes (n_nodes, d, q), all held but these; y (n_nodes, d, p); and K y, the
            derivative by the fields; contributions of this rank's cells (collective).
        """
        theta = self._rotations(V)
        symmetric = 0.5 * (by_K0 + by_K0.swapaxes(1, 2))
        dim, c = V.shape[1], theta.shape[1]
        by_theta = np.zeros((len(theta), dim + c, V.shape[2]))
        by_theta[:, dim:] = 2.0 * np.einsum("mpab,mbj,pij->mai", D, theta, symmetric)
        by_S = _by_moments(theta[:, None] @ symmetric @ theta[:, None].swapaxes(2, 3))
        y = np.einsum("mpab,mnb->nap", by_S, self._levers)
        forces = np.zeros_like(y)
        np.add.at(forces, self._nodes, self._stiffness_times(y[self._nodes]))
        return self._fit @ by_theta.reshape(-1, V.shape[2]), y, forces

    def stiffness_products(self, y: np.ndarray, fields: np.ndarray) -> np.ndarray:
        """Return sum_p y_p' k_e u_p (n_cells,) for y that is zero but at the interface."""
        out, nodes = np.zeros_like(self.arm.young), self._nodes
        values = fields[nodes] - fields[nodes].mean(axis=1, keepdims=True)
        forces = self._unit_stiffness_times(values)
        out[self._near] = np.einsum("enap,enap->e", y[nodes], forces)
        return out

    def _stiffness_times(self, values: np.ndarray) -> np.ndarray:
        """Return K times nodal values of the cells beside the interface (cells, n, 3, p)."""
        return self._unit_stiffness_times(values) * self.arm.young[self._near, None, None, None]

    def _unit_stiffness_times(self, values: np.ndarray) -> np.ndarray:
        count, n, dim, p = values.shape
        forces = self.arm.operators.stiffness[self._near] @ values.reshape(count, dim * n, p)
        return forces.reshape(values.shape)


def _levers(rigid: np.ndarray) -> np.ndarray:
    """Return r (m, n_nodes, d) from every interface's point of reference, zero elsewhere.

    Rotations among the unit motions (n_nodes, d, (d + c) m) tell it: theta x r.
    """
    if rigid.shape[1] == 2:
        about_z = rigid[:, :, 2::3]
        return np.stack([about_z[:, 1], -about_z[:, 0]], axis=-1).swapaxes(0, 1)
    about_x, about_y = rigid[:, :, 3::6], rigid[:, :, 4::6]
    return np.stack([-about_y[:, 2], about_x[:, 2], -about_x[:, 1]], axis=-1).swapaxes(0, 1)


def _deviated(S: np.ndarray) -> np.ndarray:
    """Return S - tr(S) 1 of symmetric tensors (..., 3, 3); -tr(S) (..., 1, 1) in the plane."""
    trace = np.trace(S, axis1=-2, axis2=-1)[..., None, None]
    return -trace if S.shape[-1] == 2 else S - trace * np.eye(3)


def _by_moments(by_D: np.ndarray) -> np.ndarray:
    """Return the transpose of `_deviated`: derivatives by S, given those by D (symmetric)."""
    return -by_D * np.eye(2) if by_D.shape[-1] == 1 else _deviated(by_D)
