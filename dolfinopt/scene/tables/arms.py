"""`[[arms]]`."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeGuard

from pydantic import AfterValidator, Field, PrivateAttr, model_validator
from pydantic.fields import FieldInfo

from dolfinopt.scene.tables.base import (
    NAMES_FILE,
    Extent,
    FileName,
    Inertia,
    Length,
    Position,
    Refusal,
    Six,
    Three,
    TwoOrThree,
    shown,
    table_in,
)
from dolfinopt.scene.tables.design import Region
from dolfinopt.scene.tables.joints import (
    DRIVE_KEYS,
    GROUND,
    Drive,
    Interface,
    Point,
    check_bores,
    check_interfaces,
    check_motor,
    in_frame,
)
from dolfinopt.scene.tables.material import (
    LAWS,
    CatalogueName,
    LawDeclaration,
    Material,
    Quantity,
    material_keys,
)

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene


# -- inertia of rigid bodies in space, as URDF states it -----------------------------------------

Tensor = Six[Annotated[float, Field(ge=-1e9, le=1e9)]]  # xx, yy, zz, xy, xz, yz
# By how much, over the largest, rounded moments may miss the triangle inequality.
ROUNDED = 1e-6


def tensor_problem(inertia: float | tuple[float, ...] | None) -> str:
    """Return why no body has this inertia tensor, "" for one that a body may have.

    Its principal moments are int y^2 + z^2 and so on: none is negative, or more than the sum of
    the two others.
    """
    if not isinstance(inertia, tuple) or not any(inertia):
        return ""
    import numpy as np  # which scenes in the plane do not need

    xx, yy, zz, xy, xz, yz = inertia
    low, middle, high = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    moments = f"its principal moments are {low:.4g}, {middle:.4g} and {high:.4g} kg m2"
    if low < -ROUNDED * max(abs(low), high):
        return f"expected the inertia of a body: {moments}, and none can be negative"
    if low + middle < (1.0 - ROUNDED) * high:
        return (
            f"expected the inertia of a body: {moments}, and none can exceed the sum of the two "
            "others"
        )
    return ""


# -- `[[arms]]` ----------------------------------------------------------------------------------

CellShape = Literal["quadrilateral", "triangle", "hexahedron", "tetrahedron"]
ElementName = Literal["incompatible", "linear", "quadratic"]
DEFAULT_ELEMENT: dict[CellShape, ElementName] = {
    "quadrilateral": "incompatible",
    "triangle": "quadratic",
    "hexahedron": "incompatible",
    "tetrahedron": "quadratic",
}
SIMPLICES = ("triangle", "tetrahedron")
SOLID_SHAPES = ("hexahedron", "tetrahedron")
SHORTEST = 1e-6  # m
MAX_CELLS = 100_000  # along one direction: far beyond use, stops a typing error before the mesher
SECTIONS = ("box", "tube")
SectionOrFile = Annotated[str, NAMES_FILE, Field(json_schema_extra={"examples": list(SECTIONS)})]
WALL_KEYS = ("wall", "min_wall", "max_wall")
# Points round a hollow arm's section: with more, a factor's band would be too wide.
MOST_AROUND = 150
CellCount = Annotated[int, Field(ge=1, le=MAX_CELLS)]
MAX_ARMS = 1000  # every arm is checked beside all others
PART_FILES = ("_face", "_r12")  # behind an arm's name in files of its part
STEP_FILES = (".step", ".stp")
SID_FILES = (".sid", ".sid_fem")  # of this program and FEMBS, see `scene.sid`
SIZE_KEYS = ("mesh_size", "cell_shape")
# What files in place of cells say themselves.
MESH_FILES: dict[str, tuple[str, ...]] = {
    ".geo": (),
    ".msh": SIZE_KEYS,
    ".inp": SIZE_KEYS,
    **dict.fromkeys(STEP_FILES, ("mesh_scale",)),
    **dict.fromkeys(SID_FILES, (*SIZE_KEYS, "mesh_scale", "interface_offset")),
}

# What sits at an arm's ends; arms of one design may differ in it.
JOINT_KEYS = ("joint_mass", "joint_inertia", *DRIVE_KEYS)
# What an arm is meshed from: one that states `cells` takes none of the others from the arm before.
MESH_KEYS = ("cells", "mesh", *SIZE_KEYS, "interface_offset", "mesh_scale")
# What an arm with a mesh of its own does not take.
OF_OTHER_MESHES = ("cells", "interface_offset", "mesh_scale")
SIZE_PARAMETER = "mesh size (m)"  # its name in a .geo file
CELLS_ACROSS = 12  # the height of an arm from a STEP file without mesh_size
SOLID_CELLS_ACROSS = 4  # the smaller of height and thickness of a solid one
# never taken from the arm before
OWN_KEYS = (
    "name", "design", "rigid", "mass", "inertia", "centre", "interfaces",
)  # fmt: skip
# What an arm with another's design, scaled, has from there.
PATTERN_KEYS = ("passive", "symmetric", "regions")


def is_sid(file: object) -> TypeGuard[str]:
    """Return whether a file in place of cells holds a body as standard input data."""
    return isinstance(file, str) and Path(file).suffix.lower() in SID_FILES


def check_arm_name(name: str) -> str:
    """Return `name` if it can be a file name and the key of an array in a .npz file."""
    if not re.fullmatch(r"[A-Za-z0-9_](?:[A-Za-z0-9_ -]{0,62}[A-Za-z0-9_-])?", name):
        raise Refusal(
            "expected 1 to 64 letters, digits, _, - or spaces, first neither - nor space, "
            "last no space"
        )
    if name.isdigit():  # "arms.1.length" would be ambiguous
        raise Refusal("expected at least one character that is not a digit")
    return name


class Arm(Drive):
    """One flexible arm; a key left out in a scene is taken from the arm before."""

    name: Annotated[str, AfterValidator(check_arm_name)]
    length: Extent
    height: Length
    thickness: Length
    cells: TwoOrThree[CellCount] | None = (200, 12)
    mesh: FileName | None = None
    mesh_size: Length | None = None
    cell_shape: CellShape | None = None
    interface_offset: Length | None = None
    mesh_scale: float = Field(default=1.0, ge=1e-9, le=1e9)
    element: ElementName | None = None
    passive: Extent | None = None
    symmetric: bool | Literal["z", "yz", "extruded", "y-extruded"] = False
    hollow: bool | SectionOrFile = False
    wall: Length | None = None
    min_wall: Length | None = None
    max_wall: Length | None = None
    design: str | None = None
    rigid: bool = False
    mass: Inertia | None = None
    inertia: Inertia | Tensor | None = None
    centre: Three[Position] | None = None
    joint_mass: Inertia = 0.0
    joint_inertia: Inertia = 0.0
    material: CatalogueName | None = None
    regions: tuple[Region, ...] = ()
    interfaces: tuple[Interface, ...] = ()

    _scaled: bool = PrivateAttr(False)

    def check_table(self) -> None:
        """Refuse what does not make an arm of one kind."""
        self._check_kind()
        self._check_thickness()
        self._check_hollow()
        super().check_table()
        self._check_ends()
        self._check_mesh()

    def _check_kind(self) -> None:
        kinds = {"design": self.design, "rigid": self.rigid, "mesh": self.sid}
        stated = [key for key, value in kinds.items() if value]
        if len(stated) > 1:
            raise Refusal(
                "expected only one of design, rigid and a body from a file, found "
                f"{' and '.join(stated)}",
                *stated,
            )
        if self.regions and not self.flexible:
            raise Refusal(
                f"expected none with {stated[0]}: only an arm with cells has regions",
                "regions",
                stated[0],
            )

    def _check_thickness(self) -> None:
        plane = isinstance(self.symmetric, str) and not self.is_solid
        expected = "expected only with a solid arm, cells = [nx, ny, nz]"
        if plane or (self.extruded and self.cells is None):
            raise Refusal(expected, "symmetric", "mesh")
        for number, region in enumerate(self.regions):
            key = f"regions.{number}.depth"
            if region.depth is not None and not self.is_solid:
                raise Refusal(expected, key)
            if region.depth is not None and self.extruded:
                raise Refusal(
                    f'expected none with symmetric = "{self.symmetric}": the design is the same '
                    "through the thickness",
                    key,
                    "symmetric",
                )

    def _check_hollow(self) -> None:
        if not self.hollow or not self.flexible:
            return
        if self.cells is None or len(self.cells) != 3:
            raise Refusal(
                "expected false without cells = [nx, ny, nz]: the hull of a hollow arm is a box "
                "or a tube",
                "hollow",
                *(["mesh"] if self.mesh is not None else []),
            )
        self.need("wall", "hollow")
        if self.extruded:
            raise Refusal("expected another value with hollow = true", "symmetric", "hollow")
        for key in ("regions", "interfaces"):
            self.refuse_stated(key, "with hollow = true", "hollow")
        if self.element not in (None, "incompatible"):
            raise Refusal(
                'expected "incompatible" with hollow = true: others lock in a wall of one layer',
                "element",
                "hollow",
            )
        if (around := self.cells_around) > MOST_AROUND:
            raise Refusal(
                f"expected at most {MOST_AROUND} cells round the section with hollow = true, "
                f"2 (ny + nz), found {around}",
                "cells",
            )
        self._check_wall()

    def _check_wall(self) -> None:
        """Refuse limits of the wall that leave no room or no hollow."""
        least, most = self.wall_limits
        if self.hull is not None and Path(self.hull).suffix.lower() != ".msh":
            words = " | ".join(map(shown, (True, *SECTIONS)))
            raise Refusal(f"expected {words}, or a file that ends in .msh", "hollow")
        if self.hollow == "tube" and self.height != self.thickness:
            raise Refusal(
                f'expected thickness = {self.thickness} [m], the diameter, with hollow = "tube"',
                "height",
                "thickness",
            )
        half = 0.5 * min(self.height, self.thickness)
        if most >= half:
            raise Refusal(
                f"expected less than half the section's smaller side, {half:.6g} [m], found "
                f"{most:.6g}",
                "max_wall" if self.max_wall is not None else "wall",
                "height",
                "thickness",
            )
        if least >= most:
            raise Refusal(f"expected less than max_wall = {most:.6g} [m]", "min_wall", "max_wall")
        assert self.wall is not None
        if not least <= self.wall <= most:
            raise Refusal(
                f"expected a number from min_wall = {least:.6g} to max_wall = {most:.6g} [m]",
                "wall",
                "min_wall",
                "max_wall",
            )

    @property
    def hull(self) -> str | None:
        """Mesh file of the solid whose outer surface a hollow arm has; None of a box or a tube."""
        is_file = isinstance(self.hollow, str) and self.hollow not in SECTIONS
        return str(self.hollow) if is_file else None

    @property
    def wall_limits(self) -> tuple[float, float]:
        """Least and largest thickness of a hollow arm's wall, m."""
        assert self.wall is not None
        least = 0.5 * self.wall if self.min_wall is None else self.min_wall
        return least, 2.0 * self.wall if self.max_wall is None else self.max_wall

    def wall_at(self, x: Any) -> Any:
        """Return the thickness of a hollow arm's wall for x in [0, 1], m; None of another arm."""
        if not self.hollow:
            return None
        least, most = self.wall_limits
        return least + (most - least) * x

    @property
    def cells_around(self) -> int:
        """Count the cells round the section of a box of cells: 2 (ny + nz)."""
        assert self.cells is not None
        return 2 * sum(self.cells[1:])

    @property
    def own(self) -> bool:
        """Whether the arm has a mesh and a body of its own."""
        return self.flexible and not self.shares

    @property
    def shares(self) -> bool:
        """Whether the arm has mesh and body of the arm whose design it has."""
        return self.design is not None and not self._scaled

    @property
    def pattern(self) -> str | None:
        """Name of the arm whose design this one repeats, scaled; None of others."""
        return self.design if self._scaled else None

    def like(self, owner: Arm | None) -> Arm:
        """Return this arm as one that has its owner's design, shared or scaled."""
        scaled = owner is not None and bool(self.differences(owner))
        if scaled == self._scaled:
            return self
        result = self.unchecked_copy({})
        result._scaled = scaled
        return result

    def differences(self, owner: Arm) -> list[str]:
        """Return the keys in which it differs from another arm, joints and names aside."""
        keys = [key for key in Arm.model_fields if key not in ("name", "design", *JOINT_KEYS)]
        return [key for key in keys if getattr(self, key) != getattr(owner, key)]

    @property
    def designed(self) -> bool:
        """Whether the arm has design variables of its own."""
        return self.flexible and self.design is None

    @property
    def flexible(self) -> bool:
        """Whether the arm is meshed and reduced here, alone or with the arm it shares with."""
        return not self.rigid and self.sid is None

    @property
    def sid(self) -> str | None:
        """Standard input data that the arm's body is read from; None of others."""
        return self.mesh if is_sid(self.mesh) else None

    def _check_ends(self) -> None:
        if self.length < SHORTEST and not (self.rigid and self.length == 0.0):
            raise Refusal(f"expected a number >= {SHORTEST:g} and <= 10000 [m]", "length")
        if self.rigid and self.length == 0.0:
            return
        if 2.0 * self.solid_ends >= self.length:
            raise Refusal(
                f"expected less than half of length = {self.length} [m]", "passive", "length"
            )

    @model_validator(mode="before")
    @classmethod
    def _mesh_or_cells(cls, data: Any) -> Any:
        """Let a mesh take the place of the default of `cells`."""
        if not isinstance(data, dict):
            return data
        if data.get("mesh") is not None:
            return {"cells": None} | data
        return {key: value for key, value in data.items() if (key, value) != ("cells", None)}

    def _check_mesh(self) -> None:
        check_bores(self)
        if self.mesh is None:
            if self.hull is None:
                self.refuse_stated("interface_offset", "without mesh: an arm of cells has no file")
            return
        if self.interface_offset is not None and not self.is_solid:
            raise Refusal("expected only with the mesh of a solid arm", "interface_offset")
        if self.cells is not None:
            raise Refusal(
                "expected either cells (a rectangular arm) or mesh (a file), not both",
                "mesh",
                "cells",
            )
        if self.mesh_size is not None and self.mesh_size > self.height:
            raise Refusal(
                f"expected at most height = {self.height} [m]: a cell must fit into the arm",
                "mesh_size",
                "height",
            )
        kind = Path(self.mesh).suffix.lower()
        if kind not in MESH_FILES:
            raise Refusal(f"expected a file that ends in {', '.join(MESH_FILES)}", "mesh")
        for key in MESH_FILES[kind]:
            if key != "cell_shape" or not self.is_solid or self.sid:
                self.refuse_stated(key, f"with a {kind} file, which says it itself", "mesh")
        if kind == ".inp" and not self.is_solid:
            raise Refusal(
                'expected "tetrahedron" or "hexahedron" with a .inp file, whose cells are solid',
                "cell_shape",
                "mesh",
            )
        if self.element == "incompatible" and self.cell_shape in SIMPLICES:
            cells = f"cell_shape = {shown(self.cell_shape)}"
            raise Refusal(f'expected "linear" or "quadratic" with {cells}', "element", "cell_shape")

    @property
    def is_solid(self) -> bool:
        """Whether the arm is a solid in space; otherwise it is in plane stress."""
        if self.cells is not None:
            return len(self.cells) == 3
        return self.cell_shape in SOLID_SHAPES

    @property
    def symmetric_about(self) -> tuple[bool, bool]:
        """Whether the design is symmetric about y = 0 and about z = 0."""
        return self.symmetric in (True, "yz", "y-extruded"), self.symmetric in ("z", "yz")

    @property
    def extruded(self) -> bool:
        """Whether the design is the same over the thickness."""
        return self.symmetric in ("extruded", "y-extruded")

    @property
    def depth(self) -> float:
        """What the area or volume of a cell is multiplied by to have its volume: m, or 1."""
        return 1.0 if self.is_solid else self.thickness

    @property
    def shape(self) -> CellShape:
        """Shape of the cells, as far as the scene tells."""
        if self.cell_shape is not None:
            return self.cell_shape
        return "hexahedron" if self.is_solid else "quadrilateral"

    @property
    def n_cells(self) -> int:
        """Number of cells; of a mesh file an estimate, 0 where there is nothing to go by."""
        if self.cells is not None:
            if self.hollow:
                return self.cells[0] * self.cells_around
            return math.prod(self.cells)
        if (size := self.cell_size) is None:
            return 0
        sizes = (self.length, self.height, self.thickness)[: 3 if self.is_solid else 2]
        simplices = {"tetrahedron": 6.0, "triangle": 2.0}.get(self.shape, 1.0)
        return round(simplices * math.prod(sizes) / size ** len(sizes))

    @property
    def nodes_per_cell(self) -> float:
        """Nodes of a large mesh over its cells, as far as the scene tells their shape.

        Four quadrilaterals meet at a corner, or six triangles; eight hexahedra, or some 24
        tetrahedra, whose edges are 7/6 of them.
        """
        element = self.element or DEFAULT_ELEMENT[self.shape]
        corners = {"triangle": 0.5, "tetrahedron": 1.0 / 6.0}.get(self.shape, 1.0)
        if self.hollow:
            return 2.0  # one layer of cells between two surfaces of nodes
        if element != "quadratic":
            return corners
        return (8.0 if self.is_solid else 4.0) * corners

    @property
    def solid_ends(self) -> float:
        """Return the length kept solid around both interfaces, m: `passive`, or its default.

        The edges at the ends are rigid and the joint axes lie on them: without solid cells there
        an optimised design may hold its joint in void. 0 for a mesh file, which has its own groups.
        """
        if self.passive is not None:
            return self.passive
        return 0.0 if self.cells is None else min(self.height / 4.0, self.length / 10.0)

    @property
    def passive_columns(self) -> int:
        """Count the columns of cells at each end with centroids nearer to it than `solid_ends`.

        0 for a mesh file, whose solid cells are known when it is read.
        """
        if self.cells is None:
            return 0
        # The expression of `mesh.arm_mesh.box_arm`, so that rounding cannot tell the two apart.
        return math.ceil(self.solid_ends / self.length * self.cells[0] - 0.5)

    @property
    def cell_size(self) -> float | None:
        """Longest side of a cell, m; None for a mesh file that says it itself."""
        if self.cells is None:
            if self.mesh_size is None and Path(str(self.mesh)).suffix.lower() in STEP_FILES:
                if self.is_solid:
                    return min(self.height, self.thickness) / SOLID_CELLS_ACROSS
                return self.height / CELLS_ACROSS
            return self.mesh_size
        sizes = self.length, self.height, self.thickness
        return max(size / count for size, count in zip(sizes, self.cells, strict=False))

    @property
    def n_reducible(self) -> int | None:
        """Count the dofs a reduction can keep: interior nodes, 3 or 6 outboard coordinates.

        None for a mesh file.
        """
        if self.cells is None:
            return None
        halves = 2 if self.element == "quadratic" else 1  # nodes are also halfway
        if self.hollow:
            return 6 * (self.cells[0] - 1) * self.cells_around + self.num_outboard
        along, *across = (halves * count for count in self.cells)
        nodes = (along - 1) * math.prod(count + 1 for count in across)
        return 3 * nodes + self.num_outboard if self.is_solid else 2 * nodes + 3

    @property
    def num_outboard(self) -> int:
        """Count the coordinates of the arm's outboard interfaces: 3, in space 6 of each."""
        return 6 * (1 + len(self.further_interfaces)) if self.is_solid else 3

    @property
    def further_interfaces(self) -> tuple[Interface, ...]:
        """Return the outboard interfaces besides the arm's end."""
        return tuple(interface for interface in self.interfaces if not interface.is_end)

    def end_bore(self, name: str) -> Interface | None:
        """Return the bore at an end of a mesh file's arm, "inboard" or "outboard"; None: none."""
        return next((interface for interface in self.interfaces if interface.is_end == name), None)

    @property
    def interface_points(self) -> tuple[Point, ...]:
        """Return the reference points of all outboard interfaces in the arm's frame, m."""
        return (self.length, 0.0, 0.0), *(
            in_frame(self, interface.point) for interface in self.further_interfaces
        )

    def check_in_scene(self, scene: Scene) -> None:
        """Refuse files of one name, and what does not fit the arm whose design it has."""
        index = scene.places[self.name]
        before = scene.arms[:index]
        if scene.is_spatial:
            self._check_in_space(scene)
        else:
            self._check_in_plane(scene, index)
        if self.flexible:
            self._check_material(scene, index)
        if problem := tensor_problem(self.inertia):
            raise Refusal(problem, ".inertia")
        check_interfaces(scene, index)
        check_motor(scene, index)
        if self.design is not None:
            self._check_design(before)

    def _check_material(self, scene: Scene, index: int) -> None:
        """Refuse an own material, or the scene's, that this arm cannot be made of."""
        solid = scene.material_of(index)
        if self.hollow and isinstance(solid.angle, tuple):
            raise Refusal(
                "expected a number with hollow = true: the angle turns about the wall's normal",
                ".angle" if vars(self)["angle"] is not None else "material.angle",
                ".hollow",
            )
        try:
            solid.check_law(3 if self.is_solid else 2)
        except Refusal as refusal:
            own = self.material is not None or vars(self)["kind"] is not None
            keys = (
                f".{key}" if own or getattr(self, key) is not None else f"material.{key}"
                for (key,) in refusal.keys
            )
            raise Refusal(refusal.reason, *keys) from None

    def _check_in_space(self, scene: Scene) -> None:
        """Refuse an arm that no joint holds, or with cells of the plane."""
        if self.name == GROUND:
            raise Refusal(
                'expected another name: with [[joints]] "ground" is what the machine stands on',
                ".name",
            )
        if self.name not in [joint.child for joint in scene.joints]:
            raise Refusal("expected one of [[joints]] whose child it is", ".name", "joints")
        if self.flexible and not self.is_solid:
            raise Refusal(
                "expected three integers (along, over the height, over the thickness) with "
                "[[joints]]: an arm that moves in space is a solid, or rigid = true",
                ".cells",
                "joints",
            )

    def _check_in_plane(self, scene: Scene, index: int) -> None:
        """Refuse what moves in space alone, and names with which files of parts would be one."""
        self.check_plane_bearing()
        self._check_springs(scene, index)
        if self.length == 0.0:
            reason = "expected more than 0 without [[joints]]: the machine moves in the plane"
            raise Refusal(reason, ".length")
        if self.is_solid and self.flexible:
            raise Refusal(
                "expected two integers (along, across) of an arm in plane stress: a solid arm "
                "moves in space, and needs [[joints]]",
                ".cells" if self.cells is not None else ".cell_shape",
            )
        own = self.name.casefold()  # as a_face.step
        for other in (arm.name.casefold() for arm in scene.arms[:index]):
            for longer, shorter in ((own, other), (other, own)):
                if longer.removeprefix(shorter) in PART_FILES:
                    raise Refusal(
                        f"expected a name that is not another arm's with {' or '.join(PART_FILES)} "
                        "behind it: files of both parts would have one name",
                        ".name",
                    )

    def _check_springs(self, scene: Scene, index: int) -> None:
        """Refuse springs at joints of a loop in the plane: between drive and arm without a drive.

        And those of a bearing.
        """
        follows = index >= len(scene.arms) - scene.dependent_joints
        if follows and self.gear_stiffness > 0.0:
            raise Refusal(
                f"expected 0: the joint of {self.name} follows from the others in the closed "
                "loop and has no drive",
                ".gear_stiffness",
                "closures.0.kind",
            )
        if scene.closures and self.bearing_stiffness is not None:
            raise Refusal(
                "expected none with [[closures]] without [[joints]]: state [[joints]] about "
                "the plane's normal, or leave it out",
                ".bearing_stiffness",
                "closures.0.kind",
            )

    def _check_design(self, before: tuple[Arm, ...]) -> None:
        """Refuse a design of no arm before it, or whose cells are not this arm's one by one."""
        owners = {arm.name: arm for arm in before if (arm.designed if self.pattern else arm.own)}
        if (owner := owners.get(str(self.design))) is None:
            origin = next((arm.design for arm in before if arm.name == self.design), None)
            hint = f"; {self.design} itself has that of {origin}" if origin else ""
            allowed = " | ".join(map(shown, owners)) or "no arm before it has one"
            raise Refusal(
                f"expected the name of an earlier arm with a design of its own: {allowed}{hint}",
                ".design",
            )
        if self.pattern is None:
            return
        for arm, key in product((owner, self), ("mesh", "hollow", "interfaces")):
            if getattr(arm, key):
                same = ", ".join(self.differences(owner))
                raise Refusal(
                    f"expected the same {same} as {owner.name} has: {arm.name} has {key}, and only "
                    "arms of cells, without further interfaces, are scaled",
                    ".design",
                    f".{key}",
                )
        for key in ("cells", *PATTERN_KEYS):
            theirs = getattr(owner, key)
            if getattr(self, key) not in (theirs, Arm.model_fields[key].default):
                words = shown(theirs) if key == "cells" else "that"
                raise Refusal(
                    f"expected none, or {words} as {owner.name} has, whose design this arm "
                    "repeats, scaled",
                    f".{key}",
                    ".design",
                )


# -- an arm's own material -----------------------------------------------------------------------


def _add_material_keys() -> None:
    """Let an arm state every key of [material] for itself."""
    for key in material_keys():
        field = Material.model_fields[key]
        words, unit = str(field.description).rsplit(" [", 1)
        kind: Any = field.annotation
        kind = Annotated[(kind, *field.metadata)] if field.metadata else kind
        Arm.model_fields[key] = FieldInfo(
            annotation=kind | None,
            default=None,
            description=f"of this arm: {words}; default: material.{key} [{unit}",
        )
    fields = Arm.model_fields
    for key in [key for key, field in fields.items() if table_in(field.annotation)]:
        fields[key] = fields.pop(key)  # keys are told before the tables below them


_add_material_keys()


def declare_law(law_declaration: LawDeclaration, words: Mapping[str, str]) -> None:
    """Let scenes that are read from now on name a kind of material, and keys of its own.

    Args:
        law_declaration: of the kind.
        words: what its keys mean, with the unit; of those that [material] has they say nothing.
    """
    from dolfinopt.scene.schema import Scene

    LAWS[law_declaration.kind] = law_declaration
    fields = Material.model_fields
    fields["kind"].annotation = Literal[tuple(LAWS)]  # type: ignore[assignment]
    for key in words.keys() - fields.keys():
        fields[key] = FieldInfo(annotation=Quantity | None, default=None, description=words[key])
    _add_material_keys()
    for table in (Material, Arm, Scene):
        table.model_rebuild(force=True)
