"""Geometry files -> a Gmsh model of one arm with the groups this program knows, on the root.

Reads .geo (parametric or not), .msh and .step. Whatever a user's file calls its groups and
however it numbers them, the model leaves here with the physical groups INBOARD, OUTBOARD, DESIGN
and PASSIVE, made of first-order cells of one kind that have passed the checks.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from scipy.sparse.csgraph import connected_components

from dolfinopt import scene as scenes
from dolfinopt.errors import InputError
from dolfinopt.step import read_shapes

# Physical groups of the model.
INBOARD, OUTBOARD, DESIGN, PASSIVE = 1, 2, 3, 4
NAMES = {INBOARD: "inboard", OUTBOARD: "outboard", DESIGN: "design", PASSIVE: "passive"}

# Gmsh's numbers of straight triangles and quadrilaterals.
TRIANGLE, QUADRILATERAL = 2, 3

# ONELAB parameters of meshes/*.geo, without the number that orders them.
LENGTH, HEIGHT, SOLID = "length (m)", "height (m)", "solid length at both ends (m)"
SIZE, SHAPE = "mesh size (m)", "cell shape"

# How far an interface's middle may be off its joint axis and the mesh's height off `height`,
# relative to `height`: far more than a polygon in place of a circle needs.
FRAME_TOLERANCE = 0.05
CELLS_ACROSS = 12  # of a STEP file without mesh_size


@dataclass(frozen=True, eq=False)
class FlatMesh:
    """The cells and interfaces of a Gmsh model as arrays.

    Attributes:
        points: (n_points, 3) m; may hold points of no cell.
        cells: (n_cells, 3 or 4) points around each cell.
        inboard, outboard: (n, 2) points of the interfaces' lines.
    """

    points: np.ndarray
    cells: np.ndarray
    inboard: np.ndarray
    outboard: np.ndarray


@contextmanager
def gmsh_on_root(comm: MPI.Comm) -> Iterator[Any]:
    """Yield the module gmsh, with a session of it on rank 0 of `comm`."""
    import gmsh

    if comm.rank == 0:
        _begin(gmsh)
    failed = True
    try:
        yield gmsh
        failed = False
    finally:
        if comm.rank == 0:
            gmsh.finalize()
            if failed:
                _finish_reading(gmsh)


def _begin(gmsh: Any) -> None:
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    # Parameters outlive gmsh.finalize: drop those of the mesh before.
    gmsh.onelab.clear()


def _finish_reading(gmsh: Any) -> None:
    """Have Gmsh's parser come to the end of a text it gave up, a statement a session.

    It would go on with the rest of it when it is asked to read the next file.
    """
    with tempfile.TemporaryDirectory() as folder:
        empty = Path(folder) / "empty.geo"
        empty.write_text("\n")
        for _ in range(1000):  # statements: no file of an arm has more
            _begin(gmsh)
            try:
                gmsh.open(str(empty))
                return
            except Exception:  # of the rest of the text
                continue
            finally:
                gmsh.finalize()


def mesh_geo(gmsh: Any, path: Path, parameters: Mapping[str, float]) -> None:
    """Mesh a parametric .geo file; ONELAB `parameters` override its DefineConstant defaults."""
    for name, value in parameters.items():
        gmsh.onelab.setNumber(name, [float(value)])
    gmsh.open(str(path))
    gmsh.model.mesh.generate(2)


def build_model(gmsh: Any, arm: scenes.Arm) -> np.ndarray:
    """Make the Gmsh model of an arm with a mesh file: read, mesh, name the groups, check.

    Returns:
        Lines (n, 2, 2) of both interfaces, m, from which `arm.solid_ends` is still to be measured;
        none where the geometry has seen to it.

    Raises:
        InputError: one line that names file, arm and remedy.
    """
    assert arm.mesh is not None
    where = f"{arm.mesh}: mesh of arm {arm.name!r}"
    readers = {".geo": _read_geo, ".msh": _read_msh, ".step": _read_step, ".stp": _read_step}
    try:
        solid_done = readers[Path(arm.mesh).suffix.lower()](gmsh, arm)
        groups = _groups(gmsh)
        _rename_groups(gmsh, groups)
        flat = flatten(gmsh)
        check_mesh(flat, arm)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except Exception as error:  # Gmsh knows no other
        text = " ".join(str(error).split()) or "Gmsh failed"
        raise InputError(f"{where}: {text}; open the file in Gmsh to mend it") from None
    if solid_done or arm.solid_ends == 0.0:
        return np.empty((0, 2, 2))
    return flat.points[np.concatenate([flat.inboard, flat.outboard])][:, :, :2]


# -- the three kinds of files ----------------------------------------------------------------


def _read_geo(gmsh: Any, arm: scenes.Arm) -> bool:
    """Mesh the .geo file with those of the scene's values it has parameters for."""
    gmsh.open(arm.mesh)
    names = {re.sub(r"^.*/\s*\d*\s*", "", name): name for name in gmsh.onelab.getNames()}
    if arm.mesh_size is not None and SIZE not in names:
        raise InputError(
            f'mesh_size = {arm.mesh_size}, but the file has no parameter "{SIZE}" '
            "(DefineConstant, see meshes/arm_bores.geo); add one or leave mesh_size out"
        )
    values = {LENGTH: arm.length, HEIGHT: arm.height}
    if arm.mesh_size is not None:
        values[SIZE] = arm.mesh_size
    if arm.cell_shape is not None:
        values[SHAPE] = float(arm.cell_shape == "quadrilateral")
    if arm.passive:
        values[SOLID] = arm.passive
    # Defaults computed from other parameters must not stay those of the first reading.
    gmsh.onelab.clear()
    gmsh.clear()
    for key in values.keys() & names.keys():
        gmsh.onelab.setNumber(names[key], [values[key]])
    gmsh.open(arm.mesh)
    _generate(gmsh, arm.cell_shape)
    return SOLID in names


def _read_msh(gmsh: Any, arm: scenes.Arm) -> bool:
    gmsh.open(arm.mesh)
    return False


def _read_step(gmsh: Any, arm: scenes.Arm) -> bool:
    """Mesh the planar faces of a STEP file, whatever its unit, and find the groups.

    Faces are named themselves or by the product they belong to. Few programs name edges: where
    none bears the name of an interface, `_joint_curves` finds it.
    """
    text = Path(str(arm.mesh)).read_bytes().decode("latin-1")
    if not text.lstrip().startswith("ISO-10303-21"):  # Gmsh would complain on the terminal
        raise InputError("it is no STEP file (ISO 10303-21)")
    named_edges, named_faces = read_shapes(text)
    gmsh.option.setString("Geometry.OCCTargetUnit", "M")
    gmsh.open(arm.mesh)
    model = gmsh.model
    if model.getEntities(3):
        raise InputError("it holds a solid body; export the planar face in z = 0")
    faces = model.getEntities(2)
    if not faces:
        raise InputError("it holds no face; export the planar face in z = 0, not its outline")
    everywhere = _ends(model, model.getEntities(1))
    labels = []
    for face in faces:
        outline = model.getBoundary([face], combined=False, oriented=False)
        product = model.getEntityName(*face).rpartition("/")[2].strip().casefold()
        labels.append({product} | named_faces.names_at(_ends(model, outline), everywhere))
    # Faces of different products do not share their common curves unless glued.
    children = model.occ.fragment(faces, [])[1] if len(faces) > 1 else [[face] for face in faces]
    loose = [curve for curve in model.getEntities(1) if not len(model.getAdjacencies(*curve)[0])]
    model.occ.remove(loose, recursive=True)
    model.occ.synchronize()
    model.removePhysicalGroups()
    curves = {
        curve[1]: named_edges.names_at(_ends(model, [curve]), everywhere)
        for curve in model.getEntities(1)
    }
    for tag, x in ((INBOARD, 0.0), (OUTBOARD, arm.length)):
        own = [curve for curve, names in curves.items() if NAMES[tag] in names]
        if NAMES[tag] in named_edges.names and not own:
            raise InputError(f'the edges named "{NAMES[tag]}" are not where the file says')
        model.addPhysicalGroup(1, own or _joint_curves(model, x, arm.height), tag)
        model.setPhysicalName(1, tag, NAMES[tag])
    passive = [f[1] for names, group in zip(labels, children) for f in group if "passive" in names]
    model.addPhysicalGroup(2, passive, PASSIVE)
    model.setPhysicalName(2, PASSIVE, NAMES[PASSIVE])
    gmsh.option.setNumber("Mesh.MeshSizeMax", arm.mesh_size or arm.height / CELLS_ACROSS)
    _generate(gmsh, arm.cell_shape or "quadrilateral")
    return False


def _ends(model: Any, curves: list[tuple[int, int]]) -> np.ndarray:
    """Return the first and last points (2 n, 3) of curves, m."""
    ends = [np.empty((0, 3))]
    for _, tag in curves:
        low, high = (bound[0] for bound in model.getParametrizationBounds(1, tag))
        ends.append(np.reshape(model.getValue(1, tag, [low, high]), (-1, 3)))
    return np.concatenate(ends)


def _joint_curves(model: Any, x: float, height: float) -> list[int]:
    """Return the curves of the interface at the joint axis (x, 0).

    The bore: the smallest full circle about the axis. Where there is none, the end: all straight
    curves on the upright line through it.
    """
    near = 1e-6 * height
    circles: dict[int, list[int]] = {}
    around: dict[int, float] = {}
    upright = []
    for _, tag in model.getEntities(1):
        low, high = (bound[0] for bound in model.getParametrizationBounds(1, tag))
        points = np.reshape(model.getValue(1, tag, np.linspace(low, high, 65)), (-1, 3))[:, :2]
        radius = np.linalg.norm(points - [x, 0.0], axis=1)
        if np.ptp(radius) < near:
            key = round(radius.mean() / (10.0 * near))
            circles.setdefault(key, []).append(tag)
            length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
            around[key] = around.get(key, 0.0) + length / radius.mean()
        if np.abs(points[:, 0] - x).max() < near:
            upright.append(tag)
    full = [key for key, angle in around.items() if angle > 6.2]  # chords of 2 pi, arcs cut short
    if full:
        return circles[min(full)]
    if upright:
        return upright
    raise InputError(
        f"no interface at ({x:g}, 0) m: expected a circular bore about it or a straight end "
        f"on x = {x:g} m; the origin is the inboard joint axis, +x points to the outboard one at "
        "(length, 0)"
    )


def _generate(gmsh: Any, shape: str | None) -> None:
    """Mesh the surfaces of the open model, in cells of `shape` if one is asked for."""
    gmsh.option.setNumber("Mesh.ElementOrder", 1)
    gmsh.model.mesh.generate(2)
    kinds = set(gmsh.model.mesh.getElementTypes(2))
    if shape == "quadrilateral" and kinds - {QUADRILATERAL}:
        gmsh.option.setNumber("Mesh.RecombineAll", 1)
        # Blossom, then all cells divided: the only algorithm that leaves no triangle.
        gmsh.option.setNumber("Mesh.RecombinationAlgorithm", 3)
        gmsh.model.mesh.clear()
        gmsh.model.mesh.generate(2)
    elif shape == "triangle" and QUADRILATERAL in kinds:
        gmsh.model.mesh.splitQuadrangles(2.0)  # those of less than twice the best quality: all


# -- groups ----------------------------------------------------------------------------------


def _groups(gmsh: Any) -> dict[int, list[int]]:
    """Return the curves or surfaces of each of our groups, by the names in the file."""
    model = gmsh.model
    named: dict[tuple[int, str], set[int]] = {}
    for dim, tag in model.getPhysicalGroups():
        key = dim, model.getPhysicalName(dim, tag).strip().casefold()
        named.setdefault(key, set()).update(model.getEntitiesForPhysicalGroup(dim, tag))
    groups = {}
    for tag in (INBOARD, OUTBOARD):
        groups[tag] = named.get((1, NAMES[tag]), set())
        if not any(len(model.mesh.getElements(1, curve)[1]) for curve in groups[tag]):
            raise InputError(_missing(NAMES[tag], named))
    passive = named.get((2, NAMES[PASSIVE]), set())
    every = {tag for _, tag in model.getEntities(2) if len(model.mesh.getElements(2, tag)[1])}
    groups[PASSIVE] = passive & every
    groups[DESIGN] = named.get((2, NAMES[DESIGN]), every - passive) & every
    for a, b in ((INBOARD, OUTBOARD), (DESIGN, PASSIVE)):
        if groups[a] & groups[b]:
            raise InputError(
                f"{'curve' if a == INBOARD else 'surface'} {min(groups[a] & groups[b])} is in "
                f'both groups "{NAMES[a]}" and "{NAMES[b]}"; give each its own geometrical entity'
            )
    return {tag: sorted(int(entity) for entity in entities) for tag, entities in groups.items()}


def _missing(name: str, named: Mapping[tuple[int, str], set[int]]) -> str:
    kinds = {1: "curves", 2: "surfaces"}
    found = [f'{kinds[dim]} "{text}"' for dim, text in sorted(named) if dim in kinds]
    if (1, name) in named:
        return f'the curves of group "{name}" carry no lines; save the mesh of all curves'
    return (
        f'no curves in a group "{name}"; found {", ".join(found) or "no named groups"}; name the '
        f'interface\'s curves so: Physical Curve("{name}") = {{...}}'
    )


def _rename_groups(gmsh: Any, groups: Mapping[int, list[int]]) -> None:
    """Put our groups in place of the file's, after a look at the kinds of cells."""
    model = gmsh.model
    _check_kinds(gmsh, groups[DESIGN] + groups[PASSIVE])
    model.removePhysicalGroups()
    for tag, entities in groups.items():
        if entities:
            dim = 1 if tag in (INBOARD, OUTBOARD) else 2
            entities = [e for e in entities if len(model.mesh.getElements(dim, e)[1])]
            model.addPhysicalGroup(dim, entities, tag)
            model.setPhysicalName(dim, tag, NAMES[tag])
    model.mesh.renumberNodes()  # DOLFINx wants 1, 2, ...


def _check_kinds(gmsh: Any, surfaces: list[int]) -> None:
    mesh = gmsh.model.mesh
    if len(mesh.getElementTypes(3)):
        raise InputError("it is a mesh of a body in 3D; give the mesh of the plane z = 0")
    kinds = {int(kind) for surface in surfaces for kind in mesh.getElements(2, surface)[0]}
    if not kinds:
        raise InputError("it has no cells; mesh its surfaces in 2D")
    if kinds == {TRIANGLE, QUADRILATERAL}:
        raise InputError(
            "it mixes triangles and quadrilaterals; expected one of them: set cell_shape (.geo, "
            ".step), or recombine fully (Mesh.RecombinationAlgorithm = 3)"
        )
    if not kinds <= {TRIANGLE, QUADRILATERAL}:
        found = mesh.getElementProperties(min(kinds - {TRIANGLE, QUADRILATERAL}))[0]
        raise InputError(
            f'it has cells of kind "{found}"; expected straight triangles or quadrilaterals '
            "(Mesh.ElementOrder = 1)"
        )


# -- checks ----------------------------------------------------------------------------------


def flatten(gmsh: Any) -> FlatMesh:
    """Return the cells and the interfaces' lines of a model with our groups."""
    model = gmsh.model
    tags, points, _ = model.mesh.getNodes()
    table = np.zeros((int(tags.max()) + 1, 3))
    table[tags.astype(int)] = points.reshape(-1, 3)

    def elements(dim: int, *groups: int) -> np.ndarray:
        present = [g for g in groups if (dim, g) in model.getPhysicalGroups(dim)]
        rows = []
        for group in present:
            for entity in model.getEntitiesForPhysicalGroup(dim, group):
                _, ids, nodes = model.mesh.getElements(dim, entity)
                rows.append(nodes[0].reshape(len(ids[0]), -1).astype(int))
        return np.concatenate(rows)

    return FlatMesh(
        table, elements(2, DESIGN, PASSIVE), elements(1, INBOARD), elements(1, OUTBOARD)
    )


def check_mesh(flat: FlatMesh, arm: scenes.Arm) -> None:
    """Check that a mesh can be the arm of a scene.

    Raises:
        InputError: not in the plane z = 0; folded cells; several parts; an interface that is no
            side of cells; or not in the arm's frame.
    """
    if flat.inboard.shape[1] != 2:
        raise InputError("its lines are curved; expected straight ones (Mesh.ElementOrder = 1)")
    used = flat.points[np.unique(flat.cells)]
    off = np.abs(used[:, 2]).max()
    if off > 1e-6 * arm.height:
        raise InputError(f"it lies up to {off:.4g} m off the plane z = 0; move it there")
    _check_cells(flat)
    _check_frame(flat, arm, used)


def _check_cells(flat: FlatMesh) -> None:
    corner = flat.points[flat.cells][:, :, :2]
    ahead = np.roll(corner, -1, axis=1) - corner
    back = np.roll(corner, 1, axis=1) - corner
    turn = ahead[..., 0] * back[..., 1] - ahead[..., 1] * back[..., 0]
    size = np.linalg.norm(ahead, axis=2) * np.linalg.norm(back, axis=2)
    bad = ~((turn > 1e-6 * size).all(axis=1) | (turn < -1e-6 * size).all(axis=1))
    if bad.any():
        x, y = corner[bad][0].mean(axis=0)
        raise InputError(
            f"{bad.sum()} cells are folded or flat, the first at ({x:.4g}, {y:.4g}) m; mend the "
            "mesh"
        )
    sides = np.stack([flat.cells, np.roll(flat.cells, -1, axis=1)], axis=2).reshape(-1, 2)
    count = len(flat.points)
    graph = sp.coo_matrix((np.ones(len(sides)), sides.T), (count, count))
    parts = connected_components(graph, directed=False)[1][np.unique(flat.cells)]
    pieces = len(np.unique(parts))
    if pieces > 1:
        raise InputError(
            f"it falls into {pieces} parts; neighbouring surfaces must share their curves and nodes"
        )
    known = np.unique(np.sort(sides, axis=1) @ [count, 1])
    for name, lines in (("inboard", flat.inboard), ("outboard", flat.outboard)):
        if not np.isin(np.sort(lines, axis=1) @ [count, 1], known).all():
            raise InputError(f'group "{name}" has lines that are no sides of cells; mend the mesh')


def _check_frame(flat: FlatMesh, arm: scenes.Arm, used: np.ndarray) -> None:
    tolerance = FRAME_TOLERANCE * arm.height
    for name, lines, x in (("inboard", flat.inboard, 0.0), ("outboard", flat.outboard, arm.length)):
        ends = flat.points[lines.ravel(), :2]
        middle = 0.5 * (ends.min(axis=0) + ends.max(axis=0))
        if np.linalg.norm(middle - [x, 0.0]) > tolerance:
            expected = "(0, 0)" if name == "inboard" else f"(length, 0) = ({x:.6g}, 0)"
            raise InputError(
                f'group "{name}" has its middle at ({middle[0]:.6g}, {middle[1]:.6g}) m, expected '
                f"{expected} m within {tolerance:.3g} m; {_remedy(middle[0], x)}"
            )
    tall = float(np.ptp(used[:, 1]))
    if abs(tall - arm.height) > tolerance:
        raise InputError(
            f"it is {tall:.6g} m high, expected height = {arm.height:.6g} m within "
            f"{tolerance:.3g} m; {_remedy(tall, arm.height)}"
        )


def _remedy(found: float, expected: float) -> str:
    if expected > 0.0 and 900.0 < found / expected < 1100.0:
        return "lengths are in metres, these look like millimetres"
    return "mend the geometry, or length and height in the scene"
