"""Geometric stiffness of one arm's full mesh by the stress of given displacements.

K0 = int s sigma(u)_ab d_a v . d_b w dV, sigma of unit Young's modulus, with what the rotation of
the rigid interfaces adds, see `geometric_stiffness.FaceRotation`. `UnitLoads` has the same in few
modes and of every unit load; here all nodes count, so that a strut buckles by itself.

The modulus s of the cells falls faster towards void than Young's: void would buckle by itself, in
modes that no part has.
Source: Neves, Rodrigues & Guedes, Struct. Optim. 10 (1995) 71-78; Gao & Ma, Comput. Struct. 157
(2015) 142-152; Ferrari & Sigmund (2019), doi:10.1007/s00158-019-02253-3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from dolfinopt.fem.assembly import combine
from dolfinopt.fem.elasticity import ElasticArm
from dolfinopt.fem.geometric_stiffness import FaceRotation, by_inertia
from dolfinopt.fem.stress import DisplacementGradient, LoadFields, moved_back, moved_products

TENSOR = {2: [0, 2, 2, 1], 3: [0, 3, 5, 3, 1, 4, 5, 4, 2]}  # places of sigma_ab in `elasticity`'s


@dataclass(frozen=True, eq=False)
class StressedModulus:
    """The modulus s of cells whose stress stiffens them.

    Attributes:
        value: (n_cells,) s, Pa.
        slope: (n_cells,) ds / dE.
    """

    value: np.ndarray
    slope: np.ndarray


@dataclass(frozen=True, eq=False)
class Prestress:
    """Displacements of one design at p instants, whose stress stiffens or softens it.

    Attributes:
        fields: of all loads on the design.
        modulus: of the cells.
        a: (p, m) coefficients of modes and loads, see `LoadFields.split`.
    """

    fields: LoadFields
    modulus: StressedModulus
    a: np.ndarray

    @property
    def arm(self) -> ElasticArm:
        """The design."""
        return self.fields.arm

    @cached_property
    def u(self) -> np.ndarray:
        """The displacements (n_nodes, d, p), m."""
        return self.fields.displacements(self.a)

    @cached_property
    def inertia(self) -> np.ndarray:
        """The accelerations (n_nodes, d, p) whose inertia is among the loads, m/s2."""
        return self.fields.inertia(self.a)

    @cached_property
    def _face(self) -> FaceRotation:
        return FaceRotation(self.arm)

    @cached_property
    def rotation(self) -> np.ndarray:
        """D (m, p, c, c) of the m outboard interfaces' rotations, N m (collective)."""
        return self._face.tensors(self.u, self.inertia)

    def matrix(self, instant: int = 0) -> sp.csr_matrix:
        """Return K0 (n_nodes, n_nodes) but for `rotation`, of any direction, N/m; of this rank."""
        arm, u = self.arm, self.u[:, :, instant]
        points, cells, dim = arm.substructure.quadrature, arm.operators.cells, arm.mesh.dim
        count, n = cells.shape
        D = points.derivatives.reshape(count, -1, dim, n)
        s = np.einsum("ekj,ej->ek", points.stress, u[cells].reshape(count, -1))
        s = (s * self.modulus.value[:, None]).reshape(count, D.shape[1], -1)
        sigma = s[:, :, TENSOR[dim]].reshape(count, -1, dim, dim)
        elements = D.swapaxes(2, 3) @ (sigma @ D)
        rows, columns = np.repeat(cells, n, axis=1).ravel(), np.tile(cells, n).ravel()
        entries = elements.sum(axis=1).ravel()
        return sp.coo_matrix((entries, (rows, columns)), 2 * (len(u),)).tocsr()

    def stiffness(self, V: np.ndarray) -> np.ndarray:
        """Return K0 (p, q, q) in motions V (n_nodes, d, q) (collective on the arm's ranks)."""
        tensor, arm = self.arm.substructure.stress_tensor, self.arm
        own = arm.comm.allreduce(tensor.of(self.u, self.modulus.value, V).stiffness())
        return own + self._face.stiffness(self.rotation, V)

    def gradient(self, V: np.ndarray, by_K0: np.ndarray) -> PrestressGradient:
        """Differentiate a function of K0 in modes V (collective on the arm's ranks).

        Args:
            V: (n_nodes, d, q).
            by_K0: (p, q, q).
        """
        arm, fields = self.arm, self.fields
        known = arm.substructure.stress_tensor.of(self.u, self.modulus.value, V)
        by_modes, by_u, direct, _ = known.gradient(by_K0)
        face = self._face.gradient(self.rotation, V, by_K0)
        by_u = by_u + face.by_fields
        through = fields.gradient(self.a, by_u)
        # y . (K u - M w) of the interface's nodes, w being the inertia.
        by_w = -arm.mass_times(face.y)
        _, frame, outboard, elastic = fields.split(self.a)
        by_parts = [
            np.zeros((len(self.a), fields.V.shape[2])),
            np.tensordot(by_w, fields.accelerations, ((0, 1), (0, 1))),
            np.zeros(outboard.shape),
            moved_products(by_w, fields.V),
        ]
        return PrestressGradient(
            stress=self,
            modes=V,
            by_K0=by_K0,
            direct=direct * self.modulus.slope,
            by_modes=by_modes,
            through=replace(through, by_modes=through.by_modes + moved_back(by_w, elastic)),
            by_a=through.by_a + arm.comm.allreduce(np.hstack(by_parts)),
            y=face.y,
            places=by_inertia(combine(-face.y, frame))[:, :, 1],
            levers=self._face.by_levers(face.by_S, self.u, self.inertia),
        )


@dataclass(frozen=True, eq=False)
class PrestressGradient:
    """Derivatives of a function of K0; contributions of this rank's cells.

    Attributes:
        stress: whose K0 it is.
        modes, by_K0: (n_nodes, d, q) and (p, q, q), as given.
        direct: (n_cells,) by Young's modulus through s, modes and fields held.
        by_modes: (n_nodes, d, q) by the modes, interfaces' coordinates aside.
        through: by the displacements, and by the modes otherwise than as `modes`.
        by_a: (p, m) by their coefficients; of all ranks.
        y: (n_nodes, d, p) fields of y . (dK u - dM w) at the interfaces, w being `inertia`.
        places: (n_nodes, d) p of p . M dX.
        levers: (n_nodes, d) by the interfaces' nodes as lever arms.
    """

    stress: Prestress
    modes: np.ndarray
    by_K0: np.ndarray
    direct: np.ndarray
    by_modes: np.ndarray
    through: DisplacementGradient
    by_a: np.ndarray
    y: np.ndarray
    places: np.ndarray
    levers: np.ndarray
