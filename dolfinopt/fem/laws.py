"""Material laws C: stresses by strains, as matrices; what they say of equivalent stress.

Strains are xx, yy, 2 xy in the plane and xx, yy, zz, 2 xy, 2 yz, 2 zx in space, stresses xx, yy, xy
and xx, yy, zz, xy, yz, zx. Forms hold C as a constant: another one compiles nothing. A law of one's
own is a class under `@material_law`, see docs/pages/develop/own-form.md.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import ufl
from scipy.spatial.transform import Rotation

from dolfinopt.scene.tables.arms import declare_law
from dolfinopt.scene.tables.material import LAWS, PAIRS, LawDeclaration

if TYPE_CHECKING:
    from dolfinopt.mesh.arm_mesh import ArmMesh
    from dolfinopt.scene.tables.material import Material

L = TypeVar("L", bound="type[MaterialLaw]")

# Pairs of directions that shear, in the order of strains and stresses.
SHEARS = {2: ((0, 1),), 3: ((0, 1), (1, 2), (2, 0))}

# Where stresses are in their tensor.
ROWS = {2: [[0, 2], [2, 1]], 3: [[0, 3, 5], [3, 1, 4], [5, 4, 2]]}

# Components whose length is von Mises's stress. In the plane
# s^2 = ((xx + yy) / 2)^2 + 3/4 (xx - yy)^2 + 3 xy^2, in space
# s^2 = ((xx - yy)^2 + (yy - zz)^2 + (zz - xx)^2) / 2 + 3 (xy^2 + yz^2 + zx^2), with the first sum
# that of ((xx + yy) / 2 - zz)^2 and 3/4 (xx - yy)^2.
_SHARE = 0.75**0.5
VON_MISES = {
    2: np.array([[0.5, 0.5, 0.0], [_SHARE, -_SHARE, 0.0], [0.0, 0.0, 3.0**0.5]]),
    3: np.zeros((5, 6)),
}
VON_MISES[3][0, :3], VON_MISES[3][1, :2] = (0.5, 0.5, -1.0), (_SHARE, -_SHARE)
VON_MISES[3][2:, 3:] = 3.0**0.5 * np.eye(3)


class MaterialLaw:
    """A kind of material: C of its constants, and the stress by C as UFL.

    The interpolation of densities weighs C as a whole, UFL differentiates the stress by the places
    of nodes: there is nothing else to derive.
    """

    def __init__(self, solid: Material):
        self.solid = solid

    def tensor(self, dim: int) -> np.ndarray:
        """Return C (3, 3) of plane stress or (6, 6) of space, over `Material.modulus`.

        In the material's directions where it has some.
        """
        raise NotImplementedError

    @staticmethod
    def stress(cell: Any, strain: Any) -> Any:
        """Return the stresses of strains as UFL, see `forms.Cell`; they are symmetric in both."""
        return ufl.dot(cell.C, strain)


_known: dict[str, type[MaterialLaw]] = {}


def material_law(kind: str, *, directed: bool = False, **keys: str) -> Callable[[L], L]:
    """Decorate the class of a law; of a kind that scenes do not know, declare it.

    Args:
        kind: the word of material.kind.
        directed: whether it has directions, which material.angle turns.
        **keys: of [material] that it needs beside young_modulus, poisson_ratio and density, and
            what they mean, with the unit.
    """
    if kind not in LAWS:
        declare_law(LawDeclaration(kind, tuple(keys), directed), keys)

    def known(cls: L) -> L:
        _known[kind] = cls
        return cls

    return known


@material_law("isotropic")
class Isotropic(MaterialLaw):
    """The same in all directions."""

    def tensor(self, dim: int) -> np.ndarray:
        """See `isotropic`."""
        return isotropic(dim, self.solid.ratio)


@material_law("orthotropic")
class Orthotropic(MaterialLaw):
    """Three planes of symmetry: e_1 = s_1 / E1 - nu12 s_2 / E1 - nu13 s_3 / E1 and so on."""

    def tensor(self, dim: int) -> np.ndarray:
        """Return the inverse of the compliance."""
        solid, shears = self.solid, len(SHEARS[dim])
        E = np.array(solid.young_modulus)
        E = np.append(E, E[-1])[:dim] / E[0]
        nu, G = (
            np.resize(np.array(item), shears) for item in (solid.poisson_ratio, solid.shear_modulus)
        )
        compliance = np.zeros((dim + shears, dim + shears))
        compliance[range(dim), range(dim)] = 1.0 / E
        for (i, j), ratio in zip(PAIRS[:shears], nu, strict=True):
            compliance[i, j] = compliance[j, i] = -ratio / E[i]
        compliance[dim:, dim:] = np.diag(solid.modulus / G)
        return np.linalg.inv(compliance)


def law_of(solid: Material) -> MaterialLaw:
    """Return the law of a material."""
    return _known[solid.kind](solid)


def isotropic(dim: int, poisson_ratio: float) -> np.ndarray:
    """Return C (3, 3) of plane stress or (6, 6) of space, of unit Young's modulus."""
    directions = np.eye(dim) * (1.0 + poisson_ratio) - poisson_ratio
    shears = len(SHEARS[dim])
    compliance = np.zeros((dim + shears, dim + shears))
    compliance[:dim, :dim] = directions
    compliance[dim:, dim:] = 2.0 * (1.0 + poisson_ratio) * np.eye(shears)
    return np.linalg.inv(compliance)


# -- directions ----------------------------------------------------------------------------------


def stiffness_tensor(mesh: ArmMesh, solid: Material) -> np.ndarray:
    """Return C of an arm in its frame: one, or (n_cells, m, m) of every cell of a hollow arm.

    Without directions there is nothing to turn.
    """
    C = law_of(solid).tensor(mesh.dim)
    return turned(C, directions(mesh, solid)) if solid.law.directed else C


def turned(C: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return C of axes a from that of directions: sum R_ia R_jb R_kc R_ld C_ijkl.

    Args:
        C: (m, m).
        directions: R (..., d, d), a unit vector a row.
    """
    dim = directions.shape[-1]
    rows = np.array(ROWS[dim])
    tensor = C[rows[:, :, None, None], rows[None, None]]
    R = directions
    tensor = np.einsum("...ia,...jb,...kc,...ld,ijkl->...abcd", R, R, R, R, tensor, optimize=True)
    i, j = np.array([(k, k) for k in range(dim)] + list(SHEARS[dim])).T
    return np.asarray(tensor[..., i[:, None], j[:, None], i, j])


def directions(mesh: ArmMesh, solid: Material) -> np.ndarray:
    """Return the directions 1, 2 (, 3) of a material (..., d, d) in the arm's frame, in rows.

    Those of axes turned by `angle`; of a hollow arm direction 3 is the wall's normal from
    within, and 1 the arm's axis along the wall, turned about it.
    """
    angle = solid.angle or 0.0
    turned = angle if isinstance(angle, tuple) else (0.0, 0.0, angle)
    axes = Rotation.from_euler("xyz", turned).as_matrix().T
    if mesh.wall is None:
        return axes[: mesh.dim, : mesh.dim]
    normal = mesh.wall.normals
    along = np.eye(3)[0] - normal[:, :1] * normal
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    frame = np.stack([along, np.cross(normal, along), normal], axis=1)
    return axes @ frame
