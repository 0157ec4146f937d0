"""Buckling of plane parts: by which factor the loads of an instant may grow until a part buckles.

The static stress of an instant stiffens the part by K0 or softens it, where it is pressure. With
all loads grown by a factor, their directions kept, the lowest positive lambda of

    (K + lambda K0) v = 0

is the factor at which it is no longer stable. All finite elements of the part count: a strut
between two holes buckles by itself, which no mode of the reduced model shows. The part is clamped
at its inboard interface; the outboard one is rigid and moves freely, as in the reduction. Nothing
else in the chain holds it: what is beyond only loads it, so that a uniform rod with pins at both
ends, pressed there, has four times the factor found here. Buckling out of the plane is not
looked at.

Source: Cook, Malkus, Plesha & Witt, Concepts and Applications of Finite Element Analysis (2002),
ch. 18; Wallrapp & Schwertassek (1991), doi:10.1002/nme.1620320818.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp
from scipy.signal import find_peaks
from scipy.sparse.linalg import LinearOperator, eigsh, splu

from dolfinopt.fem.geometric_stiffness import FaceRotation
from dolfinopt.fem.stress import moved
from dolfinopt.responses.stress import arm_loads, motions_of

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm
    from dolfinopt.dynamics.simulation import Trajectory
    from dolfinopt.fem.elasticity import ElasticArm
    from dolfinopt.fem.stress import LoadFields

PEAKS = 3  # instants of an arm that are looked at, those of its largest strain energy
PROMINENCE = 0.1  # of the largest energy, by which peaks stand out
LARGEST = 1e3  # factors above, which tell nothing of a machine, are infinite
# Of 1 / factor: pressure far below what buckles, as across a tie, has many nearly equal ones.
ACCURACY = 1e-7


@dataclass(frozen=True)
class Buckling:
    """What buckles first.

    Attributes:
        factor: of the loads; infinite where nothing buckles.
        place: of the arm in the chain.
        instant: s.
    """

    factor: float
    place: int
    instant: float


def lowest_buckling(arms: Mapping[int, Arm], trajectory: Trajectory) -> Buckling | None:
    """Return the lowest factor of all plane parts at their worst instants, on this rank alone.

    The instants are peaks of the strain energy under the loads of the motion, up to `PEAKS` of
    every arm and scenario. None of parts that nothing loads.

    Args:
        arms: of solid material, reduced.
        trajectory: of these arms; of scenarios the worst counts.
    """
    scene = next(iter(arms.values())).scene
    motions, found = motions_of(trajectory), list[Buckling]()
    for k, loads in arm_loads(scene, motions).items():
        state = arms[k].current
        fields = state.load_fields
        energies = state.elastic.energy_matrix(fields.columns)
        for one in loads:
            a, motion = one.coefficients, motions[one.motion]
            stiffer = 1.0
            if motion.scene is not scene:  # K0 of the nominal thickness has the scenario's stress
                other = motion.scene.material_of(k).young_modulus
                stiffer = other / scene.material_of(k).young_modulus
            for n in worst_instants(np.einsum("nk,kl,nl->n", a, energies, a)):
                factor = stiffer * buckling_factor(state.elastic, *loaded(fields, a[n]))
                found.append(Buckling(factor, one.place, float(motion.t[n])))
    return min(found, key=lambda one: one.factor, default=None)


def worst_instants(energies: np.ndarray) -> np.ndarray:
    """Return the highest peaks (at most `PEAKS`) of strain energies (n,), the largest first."""
    around = np.concatenate([[0.0], energies, [0.0]])  # the ends may be peaks
    peaks = find_peaks(around, prominence=PROMINENCE * energies.max())[0] - 1
    return np.asarray(peaks[np.argsort(-energies[peaks], kind="stable")][:PEAKS])


def loaded(fields: LoadFields, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return displacements and the accelerations that load the nodes (n_nodes, d) by coefficients.

    Args:
        fields: of a design.
        a: of `LoadFields.columns`.
    """
    frame = fields.loads.accelerations
    _, unit, elastic = fields.split(a)
    inertia = frame @ unit[: frame.shape[2]] + moved(fields.V) @ elastic
    return fields.columns @ a, inertia


def buckling_factor(arm: ElasticArm, u: np.ndarray, inertia: np.ndarray) -> float:
    """Return the lowest positive lambda of (K + lambda K0) v = 0; infinite above `LARGEST`.

    Args:
        arm: in the plane, on one rank.
        u: (n_nodes, 2) displacements whose stress makes K0, m.
        inertia: (n_nodes, 2) accelerations whose inertia is among the loads, see
            `FaceRotation.tensors`.
    """
    motions = free_motions(arm)
    K = (motions.T @ arm.K.matrix @ motions).tocsc()
    K0 = geometric_stiffness(arm, motions, u, inertia)
    # mu = 1 / lambda is the largest of -K0 v = mu K v. Shifted by 1, ARPACK's relative tolerance
    # is one of mu itself.
    inverse = LinearOperator(K.shape, splu(K).solve, dtype=float)
    start = np.random.default_rng(0).standard_normal(K.shape[0])
    found = eigsh(K - K0, 1, M=K, Minv=inverse, which="LA", v0=start, tol=ACCURACY)
    mu = float(found[0][0]) - 1.0
    return 1.0 / mu if mu * LARGEST > 1.0 else float("inf")


def geometric_stiffness(
    arm: ElasticArm, motions: sp.csr_matrix, u: np.ndarray, inertia: np.ndarray
) -> sp.csc_matrix:
    """Return K0 = int t sigma(u)_ab d_a v . d_b w dA (free + b, free + b), N/m.

    With what the rotation of the rigid interfaces adds to it, see `FaceRotation`.

    Args:
        arm, u, inertia: see `buckling_factor`.
        motions: `free_motions` of the arm.
    """
    points, cells = arm.substructure.quadrature, arm.operators.cells
    count, n = cells.shape
    D = points.derivatives.reshape(count, -1, 2, n)
    s = np.einsum("ekj,ej->ek", points.stress, u[cells].reshape(count, -1))
    s = (s * arm.young[:, None]).reshape(count, -1, 3)
    sigma = s[:, :, [0, 2, 2, 1]].reshape(count, -1, 2, 2)
    elements = np.einsum("epan,epab,epbm->enm", D, sigma, D, optimize=True)
    rows, columns = np.repeat(cells, n, axis=1).ravel(), np.tile(cells, n).ravel()
    nodes = sp.coo_matrix((elements.ravel(), (rows, columns)), 2 * (len(u),))
    K0 = motions.T @ sp.kron(nodes, sp.identity(2), format="csr") @ motions
    turning = np.zeros(K0.shape[0])
    face = FaceRotation(arm).tensors(u[:, :, None], inertia[:, :, None])
    turning[len(turning) - 3 * len(face) + 2 :: 3] = face[:, 0, 0, 0]
    return (K0 + sp.diags(turning)).tocsc()


def free_motions(arm: ElasticArm) -> sp.csr_matrix:
    """Return how free nodes, and last the rigid outboard interfaces, move (dofs, free + b)."""
    held = np.repeat(arm.inboard | arm.outboard, 2)
    free = sp.identity(len(held), format="csc")[:, np.flatnonzero(~held)]
    rigid = sp.csc_matrix(arm.rigid.reshape(len(held), -1))
    return sp.hstack([free, rigid], format="csr")
