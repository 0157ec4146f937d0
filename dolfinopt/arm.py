"""One flexible arm of the scene: design variables in, floating body out."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from dolfinopt import scene as scenes
from dolfinopt.body import FloatingBody, floating_body
from dolfinopt.elasticity import ElasticArm, element_operators
from dolfinopt.filters import HelmholtzFilter
from dolfinopt.ledger import Ledger
from dolfinopt.material import Interpolated, interpolate
from dolfinopt.mesh import structured_arm
from dolfinopt.parallel import ArmShare
from dolfinopt.reduction import METHODS, Basis


class Arm:
    """Owns what lives as long as the run: mesh, element operators, filter, factorisation.

    Cell arrays are (n_cells,) over this rank's owned cells.

    Attributes:
        mesh: see `ArmMesh`.
        elastic: stiffness and mass of the current design.
        basis: of the current design; None before the first `reduce`.
        start: (interior dofs, k) eigenvectors from which the next `reduce` sets out, or None.
    """

    def __init__(self, scene: scenes.Scene, index: int, comm: MPI.Comm, ledger: Ledger):
        """Mesh arm number `index` on the ranks of `comm` (collective there)."""
        arm = scene.arms[index]
        self.scene = scene
        with ledger.phase("mesh"):
            self.mesh = structured_arm(
                comm, arm.name, arm.length, arm.height, arm.cells, arm.passive
            )
        with ledger.phase("element operators"):
            operators = element_operators(self.mesh, arm.thickness, scene.material.poisson_ratio)
            self.elastic = ElasticArm(self.mesh, operators, ledger)
            self.filter = HelmholtzFilter(self.mesh, scene.design.filter_radius)
        self.ledger = ledger
        self.basis: Basis | None = None
        self.start: np.ndarray | None = None
        self._body: FloatingBody | None = None
        self._x_phys = np.empty(0)
        self._material: Interpolated | None = None

    def physical(self, x: np.ndarray) -> np.ndarray:
        """Return the physical densities of design variables x: filtered, passive cells solid."""
        with self.ledger.phase("filter"):
            x_phys = self.filter.forward(np.where(self.mesh.passive, 1.0, x))
        # The filter keeps bounds up to rounding, and only they are in the laws' domain.
        return np.where(self.mesh.passive, 1.0, np.clip(x_phys, 0.0, 1.0))

    def uniform(self, density: float) -> np.ndarray:
        """Return the physical densities of the same design variable in every cell."""
        return self.physical(np.full(self.mesh.num_cells, density))

    def chain(self, slope: np.ndarray) -> np.ndarray:
        """Return the derivative with respect to x from that with respect to x_phys."""
        with self.ledger.phase("filter"):
            return self._active(self.filter.backward(self._active(slope)))

    def _active(self, values: np.ndarray) -> np.ndarray:
        return np.where(self.mesh.passive, 0.0, values)

    def reduce(self, x_phys: np.ndarray) -> FloatingBody:
        """Return the floating body of physical densities in [0, 1] (collective on the arm).

        The modes found before are where the search for the new ones starts. Nothing is done
        twice for the same densities.
        """
        if self._body is not None and np.array_equal(x_phys, self._x_phys):
            return self._body
        options, material = self.scene.interpolation, self.scene.material
        self._material = interpolate(x_phys, options.law, options.penalty, options.floor)
        self.elastic.set_design(
            material.young_modulus * self._material.stiffness,
            material.density * self._material.mass,
        )
        reduction = self.scene.reduction
        with self.ledger.phase("reduction"):
            reduce = METHODS[reduction.method].reduce
            self.basis = reduce(self.elastic, reduction.coordinates, self.start)
        self.start = self.basis.start
        with self.ledger.phase("inertia integrals"):
            damping = self.scene.damping.stiffness_proportional
            self._body = floating_body(self.elastic, self.basis, damping)
        self._x_phys = x_phys.copy()
        return self._body

    @property
    def material(self) -> Interpolated:
        """Interpolated stiffness and mass of the design that was reduced last."""
        assert self._material is not None
        return self._material

    def volume_fraction(self, x_phys: np.ndarray) -> float:
        """Return sum x V / sum V over the whole arm (collective on the arm)."""
        parts = np.array([self.mesh.area @ x_phys, self.mesh.area.sum()])
        volume, total = self.mesh.comm.allreduce(parts)
        return float(volume / total)

    def grayness(self, x_phys: np.ndarray) -> float:
        """Return 4 mean x (1 - x) over the arm's area: 0 is crisp, 1 all grey; eq. (12)."""
        parts = np.array([self.mesh.area @ (4.0 * x_phys * (1.0 - x_phys)), self.mesh.area.sum()])
        grey, total = self.mesh.comm.allreduce(parts)
        return float(grey / total)


def build_arms(scene: scenes.Scene, share: ArmShare, ledger: Ledger) -> dict[int, Arm]:
    """Build this rank's arms, keyed by their index in the scene (collective on `share.comm`)."""
    return {index: Arm(scene, index, share.comm, ledger) for index in share.arms}
