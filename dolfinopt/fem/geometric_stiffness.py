"""Geometric stiffness of one arm by the stress of every unit load that acts on a moving body.

A body in its tangent frame is loaded by seven unit loads ("pushes"): the inertia of unit
accelerations a_x, a_y of the frame, of its angular acceleration and of -w^2, and unit forces and
moment at the outboard interface. In space they are 18: three accelerations, the nine entries A_ab
of the accelerations A X by rotation, three forces and three moments. Each has a static field u_p,
K u_p = f_p, whose stress stiffens the body in its modes:

    K0_p[i, j] = int t sigma(u_p)_ab (d_a phi_i . d_b phi_j) dA

with p unit loads, d directions and b outboard coordinates. The rigid interface's rotation of second
order adds to it, see `face_rotation`. The inertia of the modes themselves, M phi_k, loads the body,
too: `UnitLoads.with_modes` has these q loads between the other inertial ones and the interface's.

Source: Wallrapp & Schwertassek, Int. J. Numer. Methods Eng. 32 (1991) 1751-1766,
doi:10.1002/nme.1620320818; Schwertassek & Wallrapp (1999).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.fem.assembly import StiffenedModes, combine, of_cells
from dolfinopt.fem.frames import (
    NUM_INERTIAL,
    SECOND_TURNS,
    TURNS,
    accelerations,
    by_inertia,
    by_rigid_motions,
)

if TYPE_CHECKING:
    from dolfinopt.fem.elasticity import ElasticArm


@dataclass(frozen=True, eq=False)
class UnitLoads:
    """Static fields of the unit loads on one design of an arm.

    Attributes:
        arm: the design.
        fields: (n_nodes, d, p) u_p, m per unit load: m/s2, 1/s2, N, N m.
        modes: (n_nodes, d, k) whose inertia are loads, too; none by default.
    """

    arm: ElasticArm
    fields: np.ndarray
    modes: np.ndarray | None = None

    @property
    def num_frame(self) -> int:
        """Number of those by the arm's own inertia in its frame's acceleration."""
        return NUM_INERTIAL[self.fields.shape[1]]

    @property
    def num_inertial(self) -> int:
        """Number of those by the arm's own inertia, that of the modes included."""
        return self.num_frame + (0 if self.modes is None else self.modes.shape[2])

    def with_modes(self, V: np.ndarray, MV: np.ndarray) -> UnitLoads:
        """Return these loads and the inertia of modes: q more solves (collective).

        Args:
            V: (n_nodes, d, q) modes.
            MV: mass matrix times V, contributions of this rank's cells.
        """
        modal = self.arm.static_response(*self.arm.restrict(MV))
        parts = [self.fields[:, :, : self.num_frame], modal, self.fields[:, :, self.num_frame :]]
        return UnitLoads(self.arm, np.concatenate(parts, axis=2), V)

    def geometric_stiffness(self, V: np.ndarray) -> np.ndarray:
        """Return K0 (p, q, q) in modes V (n_nodes, d, q) (collective on the arm's ranks)."""
        arm = self.arm
        own = self.stiffened(V).stiffness()
        K0 = own if arm.comm.size == 1 else arm.comm.allreduce(own)
        return K0 + self._face.stiffness(self._face_tensors, V)

    @cached_property
    def _face(self) -> FaceRotation:
        return FaceRotation(self.arm)

    @cached_property
    def _face_tensors(self) -> np.ndarray:
        """D (m, p, c, c) of `FaceRotation` (collective)."""
        return self._face.tensors(self.fields, self.accelerations)

    @property
    def accelerations(self) -> np.ndarray:
        """The fields (n_nodes, d, k) whose inertia the first k loads are."""
        points = self.arm.points
        result = accelerations(np.ones_like(points), points)
        return result if self.modes is None else np.concatenate([result, self.modes], axis=2)

    @cached_property
    def residual(self) -> np.ndarray:
        """K u_p - f_p (n_nodes, d, p) but for what loads interfaces, of this rank's cells."""
        result = self.arm.stiffness_times(self.fields)
        result[:, :, : self.num_inertial] -= self.arm.mass_times(self.accelerations)
        return result

    def by_levers(self, face: FaceGradient) -> np.ndarray:
        """Return the derivatives (n_nodes, d) by the interfaces' nodes, see `FaceRotation`."""
        return self._face.by_levers(face.by_S, self.fields, self.accelerations)

    @cached_property
    def _last(self) -> dict[str, tuple[np.ndarray, StiffenedModes]]:
        return {}

    def stiffened(self, V: np.ndarray) -> StiffenedModes:
        """Return what is known of these modes; for the last ones the same."""
        known = self._last.get("modes")
        if known is None or known[0] is not V:
            cells = self.arm.substructure.cells
            known = self._last["modes"] = V, StiffenedModes(cells, self.fields, self.arm.young, V)
        return known[1]

    def gradient(self, V: np.ndarray, by_K0: np.ndarray) -> GeometricGradient:
        """Differentiate a function of K0 by modes and material (collective on the arm's ranks).

        The stresses' part goes through one static solve a load, the adjoint of u_p.

        Args:
            V: (n_nodes, d, q) as given to `geometric_stiffness`, and to `with_modes` if that was.
            by_K0: (p, q, q) derivatives.
        """
        arm = self.arm
        by_V, forces, direct = self.stiffened(V).gradient(by_K0)
        face = self._face.gradient(self._face_tensors, V, by_K0)
        direct = direct + self._face.stiffness_products(face.y, self.fields)
        forces = forces + face.by_fields
        adjoint = arm.static_response(*arm.restrict(forces))
        by_V = by_V + face.by_modes
        result = GeometricGradient(self, V, by_K0, by_V, direct, forces, adjoint, face)
        if self.modes is None:
            return result
        return replace(result, by_modes=by_V + arm.mass_times(result.by_modal_inertia))


@dataclass(frozen=True, eq=False)
class GeometricGradient:
    """Derivatives of a function of K0.

    Attributes:
        loads: whose stress it is.
        modes, by_K0: (n_nodes, d, q) and (p, q, q), as given.
        by_modes: (n_nodes, d, q) by the modes, contributions of this rank's cells.
        direct: (n_cells,) by Young's modulus, modes and fields held.
        by_fields: (n_nodes, d, p) by the fields of the loads, contributions of this rank's cells.
        adjoint: (n_nodes, d, p) of these fields.
        face: of the interfaces' rotations.
    """

    loads: UnitLoads
    modes: np.ndarray
    by_K0: np.ndarray
    by_modes: np.ndarray
    direct: np.ndarray
    by_fields: np.ndarray
    adjoint: np.ndarray
    face: FaceGradient

    def by_young(self, left: np.ndarray) -> np.ndarray:
        """Return the derivative by Young's modulus, plus sum_k left_k' k_e V_k (n_cells,).

        Args:
            left: (n_nodes, d, q), by which the modes V follow it.
        """
        self.loads.arm.profile.counts.energy_fields += left.shape[2] + self.adjoint.shape[2]
        known = self.loads.stiffened(self.modes)
        return self.direct + known.stiffness_products(left, self.adjoint)

    @property
    def stiffness(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Fields l and r of l . dK r, modes held, but for what stiffens the cells themselves."""
        return [(self.face.y - self.adjoint, self.loads.fields)]

    def at_interfaces(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives by the outboard interfaces' shape, modes held (collective).

        By `InterfaceTransformation.rigid` (n_nodes, d, b), in which the fields and their adjoints
        move the interfaces' nodes; and by the nodes' places as lever arms (n_nodes, d).
        """
        loads, arm = self.loads, self.loads.arm
        T = arm.substructure.T
        by_fields = self.by_fields - arm.stiffness_times(self.adjoint)
        rigid = by_fields @ T.coordinates(loads.fields).T
        rigid -= loads.residual @ T.coordinates(self.adjoint).T
        return rigid, loads.by_levers(self.face)

    @cached_property
    def _by_loads(self) -> np.ndarray:
        """By the loads f_p that are inertia (n_nodes, d, k)."""
        return np.asarray((self.adjoint - self.face.y)[:, :, : self.loads.num_inertial])

    @property
    def by_inertia(self) -> np.ndarray:
        """Fields whose products with dM 1_x and dM X are the part by the mass (n_nodes, d, 2)."""
        return by_inertia(self._by_loads[:, :, : self.loads.num_frame])

    @property
    def by_modal_inertia(self) -> np.ndarray:
        """Fields whose products with d(M V) are the modal loads' part (n_nodes, d, q)."""
        return self._by_loads[:, :, self.loads.num_frame :]


def unit_loads(arm: ElasticArm) -> UnitLoads:
    """Return the static fields of the unit loads: four solves with the factor at hand.

    Twelve in space.
    Collective on the arm's ranks.
    """
    ones, places = np.moveaxis(arm.rigid_inertia, 2, 0)
    inertial = arm.static_response(*arm.restrict(accelerations(ones, places)))
    return UnitLoads(arm, np.concatenate([inertial, interface_fields(arm)], axis=2))


def interface_fields(arm: ElasticArm) -> np.ndarray:
    """Return the static fields (n_nodes, d, b) of unit loads of the outboard interfaces."""
    modes = arm.constraint_modes
    return combine(modes.field, np.linalg.inv(modes.stiffness))


# -- what the rotation of second order of a rigid interface adds to the geometric stiffness ------
#
# A node of the outboard interface, r from its point of reference, moves by u + (exp(theta~) - 1) r,
# theta being the rotation vector. The linear modes hold u + theta x r of it; the reaction R_p of
# the interface's nodes to a unit load does work along the rest, theta x (theta x r) / 2:
#
#     K0_p[i, j] gains theta_i' D_p theta_j,   D_kl = S : S_k S_l,   S = sym(sum R_p r'),
#
# with the rotations S_k of `frames`: S - tr(S) 1 in space, -tr(S) in the plane.
#
# Without it a rotation of the interface would strain the cells beside it, whose stress across the
# arm is large, and a moment M at the interface would act on nodes that keep the directions of their
# forces: a quasi-tangential moment. With it M works along the rotation vector, as a semi-tangential
# one does to second order (Ziegler 1968, Principles of Structural Stability), under which a
# cantilever buckles at twice the moment.


@dataclass(frozen=True, eq=False)
class FaceGradient:
    """Derivatives of a function of what the interfaces' rotations add to K0.

    Attributes:
        by_modes: (n_nodes, d, q), all held but these.
        by_S: (m, p, d, d) by the moments of the reactions.
        y: (n_nodes, d, p) fields whose products with K u_p - f_p they are.
        by_fields: (n_nodes, d, p) K y, contributions of this rank's cells.
    """

    by_modes: np.ndarray
    by_S: np.ndarray
    y: np.ndarray
    by_fields: np.ndarray


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
        operators = arm.operators
        self._stiffness = of_cells(operators.stiffness, self._near)
        self._mass = np.broadcast_to(
            of_cells(operators.mass, self._near), (len(self._near), *operators.mass.shape[1:])
        )
        self._levers = _levers(arm.rigid)

    def _rotations(self, V: np.ndarray) -> np.ndarray:
        """Return the rotation vectors (m, c, q) in modes (n_nodes, d, q) (collective)."""
        result = self.arm.substructure.T.coordinates(V)
        return result.reshape(len(self._levers), -1, V.shape[2])[:, V.shape[1] :]

    def tensors(self, fields: np.ndarray, accelerations: np.ndarray) -> np.ndarray:
        """Return D (m, p, c, c) of unit loads, N m each (collective).

        Args:
            fields: (n_nodes, d, p) their static fields u_p.
            accelerations: (n_nodes, d, k) of the first k loads, whose inertia loads the nodes.
        """
        forces, levers = self._reactions(fields, accelerations), self._levers[:, self._nodes]
        S = self.arm.comm.allreduce(np.einsum("enap,ienb->ipab", forces, levers))
        return np.einsum("klab,ipab->ipkl", SECOND_TURNS[S.shape[3]], 0.5 * (S + S.swapaxes(2, 3)))

    def _reactions(self, fields: np.ndarray, accelerations: np.ndarray) -> np.ndarray:
        """Return K u_p - f_p of the cells beside the interfaces (cells, n, d, p)."""
        arm, nodes = self.arm, self._nodes
        forces = self._stiffness_times(_strained(fields[nodes]))
        inertia = np.einsum("enm,emap->enap", self._mass, accelerations[nodes])
        inertia *= arm.density[self._near, None, None, None]
        forces[..., : accelerations.shape[2]] -= inertia
        return forces

    def by_levers(
        self, by_S: np.ndarray, fields: np.ndarray, accelerations: np.ndarray
    ) -> np.ndarray:
        """Return the derivatives (n_nodes, d) by the interfaces' nodes as lever arms.

        Args:
            by_S: (m, p, d, d) by the moments of the reactions.
            fields, accelerations: see `tensors`.
        """
        forces, result = self._reactions(fields, accelerations), np.zeros_like(self.arm.points)
        for at, by in zip(self.arm.substructure.T.ends, by_S, strict=True):
            own = np.einsum("enap,pab->enb", forces, by) * at[self._nodes][:, :, None]
            np.add.at(result, self._nodes, own)
        return result

    def stiffness(self, D: np.ndarray, V: np.ndarray) -> np.ndarray:
        """Return what K0 (p, q, q) gains in modes V (n_nodes, d, q) (collective)."""
        theta = self._rotations(V)[:, None]
        return (theta.swapaxes(2, 3) @ D @ theta).sum(axis=0)

    def gradient(self, D: np.ndarray, V: np.ndarray, by_K0: np.ndarray) -> FaceGradient:
        """Differentiate a function of what K0 gains, given its derivative by it (p, q, q).

        It is sum_p y_p . (K u_p - f_p) with nodal fields y, zero but at the interfaces.
        Collective.
        """
        theta = self._rotations(V)
        symmetric = 0.5 * (by_K0 + by_K0.swapaxes(1, 2))
        dim, c = V.shape[1], theta.shape[1]
        by_theta = np.zeros((len(theta), dim + c, V.shape[2]))
        by_theta[:, dim:] = 2.0 * np.einsum("mpab,mbj,pij->mai", D, theta, symmetric)
        by_D = theta[:, None] @ symmetric @ theta[:, None].swapaxes(2, 3)
        by_S = np.einsum("klab,mpkl->mpab", SECOND_TURNS[dim], by_D)
        y = np.einsum("mpab,mnb->nap", by_S, self._levers)
        forces = np.zeros_like(y)
        np.add.at(forces, self._nodes, self._stiffness_times(y[self._nodes]))
        by_modes = self.arm.substructure.T.by_coordinates(by_theta.reshape(-1, V.shape[2]))
        return FaceGradient(by_modes, by_S, y, forces)

    def stiffness_products(self, y: np.ndarray, fields: np.ndarray) -> np.ndarray:
        """Return sum_p y_p' k_e u_p (n_cells,) for y that is zero but at the interface."""
        out, nodes = np.zeros_like(self.arm.young), self._nodes
        forces = self._unit_stiffness_times(_strained(fields[nodes]))
        out[self._near] = np.einsum("enap,enap->e", y[nodes], forces)
        return out

    def _stiffness_times(self, values: np.ndarray) -> np.ndarray:
        """Return K times nodal values of the cells beside the interface (cells, n, 3, p)."""
        return self._unit_stiffness_times(values) * self.arm.young[self._near, None, None, None]

    def _unit_stiffness_times(self, values: np.ndarray) -> np.ndarray:
        count, n, dim, p = values.shape
        forces = self._stiffness @ values.reshape(count, dim * n, p)
        return forces.reshape(values.shape)


def _strained(values: np.ndarray) -> np.ndarray:
    """Return nodal values (cells, n, d, p) less their mean, which does not strain a cell."""
    return values - values.mean(axis=1, keepdims=True)


def _levers(rigid: np.ndarray) -> np.ndarray:
    """Return r (m, n_nodes, d) from every interface's point of reference, zero elsewhere."""
    # Of its rotations S_k r, sum_k S_k' S_k = (d - 1) 1.
    d = rigid.shape[1]
    ends = np.split(rigid, rigid.shape[2] // (d + len(TURNS[d])), axis=2)
    return np.stack([by_rigid_motions(end) for end in ends]) / (d - 1)
