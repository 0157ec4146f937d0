"""Geometry files -> a Gmsh model of one arm with the groups this program knows, on the root.

Reads .geo (parametric or not), .msh and .step. Whatever a user's file calls its groups and
however it numbers them, the model leaves here with the physical groups INBOARD, OUTBOARD, DESIGN
and PASSIVE, made of first-order cells of one kind that have passed the checks.
"""

from __future__ import annotations

import ctypes
import os
import re
import signal
import sys
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
from scipy.spatial import cKDTree

from dolfinopt.errors import InputError
from dolfinopt.mesh.step import read_shapes
from dolfinopt.parallel import together
from dolfinopt.scene import load as scenes

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
THICKNESS_TOLERANCE = 1e-3  # relative, of a solid in a STEP file


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
    """Yield the module gmsh, with a session of it on rank 0 of `comm` (collective)."""
    with together(comm), _interrupts_kept():
        import gmsh

        if comm.rank == 0:
            _begin(gmsh)
    failed = True
    try:
        yield gmsh
        failed = False
    finally:
        if comm.rank == 0:
            with _interrupts_kept():
                gmsh.finalize()
                if failed:
                    _finish_reading(gmsh)


@contextmanager
def _interrupts_kept() -> Iterator[None]:
    """Keep what Ctrl-C does: Gmsh would have it kill the process without a word.

    4.8 from its import, which takes 0.2 s, until a session ends, which only the root has; later
    ones during a session.
    """
    change = signal.signal

    def keep(number: int, handler: Any) -> Any:
        return signal.getsignal(number) if number == signal.SIGINT else change(number, handler)

    signal.signal = keep  # type: ignore[assignment]
    try:
        yield
    finally:
        signal.signal = change


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


@contextmanager
def _silent_terminal() -> Iterator[None]:
    """Keep off the terminal what Open CASCADE writes there itself, past Gmsh's options."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = [os.dup(1), os.dup(2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        yield
    finally:
        ctypes.CDLL(None).fflush(None)  # what C has buffered belongs there, too
        for target, copy in enumerate(kept, start=1):
            os.dup2(copy, target)
            os.close(copy)
        os.close(nowhere)


def build_model(gmsh: Any, arm: scenes.Arm) -> tuple[np.ndarray, tuple[str, ...]]:
    """Make the Gmsh model of an arm with a mesh file: read, mesh, name the groups, check.

    Returns:
        Lines (n, 2, 2) of both interfaces, m, from which `arm.solid_ends` is still to be measured;
        none where the geometry has seen to it. And warnings, a sentence each.

    Raises:
        InputError: one line that names file, arm and remedy. Other errors are this program's.
    """
    assert arm.mesh is not None
    where = f"{arm.mesh}: mesh of arm {arm.name!r}"
    readers = {".geo": _read_geo, ".msh": _read_msh, ".step": _read_step, ".stp": _read_step}
    unknown: list[str] = []
    try:
        with _silent_terminal():
            solid_done = readers[Path(arm.mesh).suffix.lower()](gmsh, arm, unknown)
        groups = _groups(gmsh, unknown)
        _rename_groups(gmsh, groups)
        flat = flatten(gmsh)
        check_mesh(flat, arm)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except Exception as error:
        if type(error) is not Exception:  # Gmsh raises no other
            raise
        text = " ".join(str(error).split()) or "Gmsh failed"
        raise InputError(f"{where}: {text}; open the file in Gmsh to mend it") from None
    notes = (_unknown_names(where, unknown),) if unknown else ()
    if solid_done or arm.solid_ends == 0.0:
        return np.empty((0, 2, 2)), notes
    return flat.points[np.concatenate([flat.inboard, flat.outboard])][:, :, :2], notes


def _unknown_names(where: str, names: list[str]) -> str:
    listed = ", ".join(f'"{name}"' for name in sorted(set(names)))
    return (
        f"{where}: surfaces named {listed} are no group of their own: names that count begin with "
        "passive (stays solid) or design; all others are designed, or left out where one is design"
    )


def _group_named(name: str, *groups: int) -> int | None:
    """Return which of `groups` a name in a file means: "Passive2" begins with passive."""
    for group in groups:
        if name.strip().casefold().startswith(NAMES[group]):
            return group
    return None


# -- the three kinds of files ----------------------------------------------------------------


def _read_geo(gmsh: Any, arm: scenes.Arm, _: list[str]) -> bool:
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


def _read_msh(gmsh: Any, arm: scenes.Arm, _: list[str]) -> bool:
    gmsh.open(arm.mesh)
    return False


def _read_step(gmsh: Any, arm: scenes.Arm, unknown: list[str]) -> bool:
    """Mesh the planar faces of a STEP file, whatever its unit, and find the groups.

    Of a prismatic solid that is the end face nearest to z = 0, moved there. Faces are named
    themselves or by the product they belong to. Few programs name edges: where none bears the name
    of an interface, `_joint_curves` finds it.
    """
    text = Path(str(arm.mesh)).read_bytes().decode("latin-1")
    if not text.lstrip().startswith("ISO-10303-21"):  # Gmsh would complain on the terminal
        raise InputError("it is no STEP file (ISO 10303-21)")
    named_edges, named_faces = read_shapes(text)
    gmsh.option.setString("Geometry.OCCTargetUnit", "M")
    gmsh.open(arm.mesh)
    model = gmsh.model
    everywhere = _ends(model, model.getEntities(1))
    faces, owners, level = model.getEntities(2), model.getEntities(2), 0.0
    if model.getEntities(3):
        faces, owners, level = _prism_faces(model, arm)
    if not faces:
        raise InputError("it holds no face; export the planar face in z = 0, not its outline")
    labels, products = [], []
    for face, owner in zip(faces, owners, strict=True):
        outline = model.getBoundary([face], combined=False, oriented=False)
        products.append(model.getEntityName(*owner).rpartition("/")[2].strip())
        names = {products[-1]} | named_faces.names_at(_ends(model, outline), everywhere)
        labels.append({_group_named(name, PASSIVE, DESIGN) for name in names})
    if len(set(products)) > 1:  # a single one bears the name of the part
        unknown += [p for p, groups in zip(products, labels, strict=True) if groups == {None} and p]
    if level or model.getEntities(3):
        _keep_faces(model, faces, level)
    # Faces of different products do not share their common curves unless glued.
    children = model.occ.fragment(faces, [])[1] if len(faces) > 1 else [[face] for face in faces]
    loose = [curve for curve in model.getEntities(1) if not len(model.getAdjacencies(*curve)[0])]
    model.occ.remove(loose, recursive=True)
    model.occ.synchronize()
    model.removePhysicalGroups()
    lift = np.array([0.0, 0.0, level])  # to where the file has them
    curves = {
        curve[1]: named_edges.names_at(_ends(model, [curve]) + lift, everywhere)
        for curve in model.getEntities(1)
    }
    for tag, x in ((INBOARD, 0.0), (OUTBOARD, arm.length)):
        own = [c for c, names in curves.items() if any(_group_named(n, tag) for n in names)]
        if any(_group_named(name, tag) for name in named_edges.names) and not own:
            raise InputError(f'the edges named "{NAMES[tag]}" are not where the file says')
        model.addPhysicalGroup(1, own or _joint_curves(model, x, arm.height), tag)
        model.setPhysicalName(1, tag, NAMES[tag])
    passive = [f[1] for found, group in zip(labels, children) for f in group if PASSIVE in found]
    model.addPhysicalGroup(2, passive, PASSIVE)
    model.setPhysicalName(2, PASSIVE, NAMES[PASSIVE])
    gmsh.option.setNumber("Mesh.MeshSizeMax", arm.mesh_size or arm.height / CELLS_ACROSS)
    _generate(gmsh, arm.cell_shape or "quadrilateral")
    return False


def _prism_faces(
    model: Any, arm: scenes.Arm
) -> tuple[list[tuple[int, int]], list[tuple[int, int]], float]:
    """Return the end faces of prismatic solids nearest to z = 0, the solid of each, and their z, m.

    Raises:
        InputError: a solid whose section is not constant along z, or not `arm.thickness` thick.
    """
    near = 1e-6 * arm.height
    found: list[tuple[float, float, list[tuple[tuple[int, int], float]], tuple[int, int]]] = []
    for solid in model.getEntities(3):
        flat = []
        for face in model.getBoundary([solid], oriented=False):
            low, high = model.getParametrizationBounds(*face)
            grid = np.stack(np.meshgrid(*np.linspace(low, high, 5).T), axis=2).ravel()
            points = np.reshape(model.getValue(*face, grid), (-1, 3))
            upright = np.abs(np.reshape(model.getNormal(face[1], grid), (-1, 3))[:, 2])
            if (upright > 1.0 - 1e-9).all():
                flat.append((face, float(points[:, 2].mean())))
            elif not (upright < 1e-6).all():
                x, y, z = model.occ.getCenterOfMass(*face)
                raise InputError(
                    f"it holds a solid whose face about ({x:.4g}, {y:.4g}, {z:.4g}) m is neither "
                    "normal to z nor along it; expected a section that is constant along z, or "
                    "the planar face in z = 0"
                )
        levels = [z for _, z in flat]
        bottom, top = min(levels), max(levels)
        steps = [z for z in levels if bottom + near < z < top - near]
        if steps:
            raise InputError(
                f"it holds a solid with a step at z = {steps[0]:.6g} m between its end faces at "
                f"{bottom:.6g} and {top:.6g} m; expected a section that is constant along z, or "
                "the planar face in z = 0"
            )
        if abs(top - bottom - arm.thickness) > THICKNESS_TOLERANCE * arm.thickness:
            raise InputError(
                f"its solid is {top - bottom:.6g} m thick along z, expected arms.thickness = "
                f"{arm.thickness:.6g} m; {_remedy(top - bottom, arm.thickness, 'thickness')}"
            )
        found.append((bottom, top, flat, solid))
    bottoms = np.array([bottom for bottom, _, _, _ in found])
    if np.ptp(bottoms) > near:
        raise InputError(
            f"its solids begin at z = {bottoms.min():.6g} to {bottoms.max():.6g} m; expected them "
            "side by side, in one plane"
        )
    level = min(found[0][:2], key=abs)
    pairs = [
        (face, solid) for _, _, flat, solid in found for face, z in flat if abs(z - level) < near
    ]
    return [face for face, _ in pairs], [solid for _, solid in pairs], level


def _keep_faces(model: Any, faces: list[tuple[int, int]], level: float) -> None:
    """Remove all but `faces` from the model and move them from z = `level` to 0."""
    model.occ.remove(model.getEntities(3))
    model.occ.remove([face for face in model.getEntities(2) if face not in faces])
    model.occ.synchronize()
    loose = [curve for curve in model.getEntities(1) if not len(model.getAdjacencies(*curve)[0])]
    model.occ.remove(loose, recursive=True)
    model.occ.translate(faces, 0.0, 0.0, -level)
    model.occ.synchronize()


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
    arcs: list[tuple[float, float, int]] = []  # radius, angle, curve
    upright = []
    for _, tag in model.getEntities(1):
        low, high = (bound[0] for bound in model.getParametrizationBounds(1, tag))
        points = np.reshape(model.getValue(1, tag, np.linspace(low, high, 65)), (-1, 3))[:, :2]
        radius = np.linalg.norm(points - [x, 0.0], axis=1)
        if np.ptp(radius) < near:
            length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
            arcs.append((float(radius.mean()), float(length / radius.mean()), tag))
        if np.abs(points[:, 0] - x).max() < near:
            upright.append(tag)
    arcs.sort()
    smallest: list[tuple[float, float, int]] = []
    for arc in arcs:
        # Arcs of one circle by a tolerance: their radii differ by rounding.
        smallest = [*smallest, arc] if smallest and arc[0] - smallest[0][0] < near else [arc]
        if sum(angle for _, angle, _ in smallest) > 6.2:  # chords of 2 pi
            return [tag for _, _, tag in smallest]
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


def _groups(gmsh: Any, unknown: list[str]) -> dict[int, list[int]]:
    """Return the curves or surfaces of each of our groups, by how the names in the file begin.

    Other names of surfaces are added to `unknown`.
    """
    model = gmsh.model
    named: dict[tuple[int, str], set[int]] = {}
    for dim, tag in model.getPhysicalGroups():
        name = model.getPhysicalName(dim, tag).strip()
        group = _group_named(name, *((INBOARD, OUTBOARD) if dim == 1 else (PASSIVE, DESIGN)))
        if dim == 2 and group is None and name:
            unknown.append(name)
        key = dim, NAMES[group] if group else name.casefold()
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
        InputError: not in the plane z = 0; folded or overlapping cells; several parts; an
            interface that is no side of cells; or not in the arm's frame.
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
    _check_overlap(flat, corner)
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


def _check_overlap(flat: FlatMesh, corner: np.ndarray) -> None:
    """Raise InputError where cells, convex each, cover a place twice.

    The way round a cell does not tell: surfaces may be oriented either way. But neighbours lie on
    different sides of what they share, the angles about a point add up to a full turn at most, and
    then a connected mesh overlaps only where its outline crosses itself or cells lie in others.

    Args:
        corner: (n_cells, 3 or 4, 2) m.
    """
    count, around = flat.cells.shape
    centre = corner.mean(axis=1)
    sides = np.sort(np.stack([flat.cells, np.roll(flat.cells, -1, axis=1)], axis=2), axis=2)
    ends, which, times = np.unique(
        sides.reshape(-1, 2), axis=0, return_inverse=True, return_counts=True
    )
    which = which.ravel()
    cell = np.repeat(np.arange(count), around)
    a, b = flat.points[ends[which, 0], :2], flat.points[ends[which, 1], :2]
    side = np.sign(_turn(a, b, centre[cell]))
    same = np.abs(np.bincount(which, side)) > 1.5  # two cells on one side of it
    bad = (same | (times > 2))[which]
    ahead, back = np.roll(corner, -1, axis=1) - corner, np.roll(corner, 1, axis=1) - corner
    sine = np.abs(ahead[..., 0] * back[..., 1] - ahead[..., 1] * back[..., 0])
    angle = np.bincount(flat.cells.ravel(), np.arctan2(sine, (ahead * back).sum(axis=2)).ravel())
    bad |= (angle > 2.0 * np.pi + 1e-6)[flat.cells].ravel()
    if not bad.any():
        crossed = np.zeros(len(ends), dtype=bool)
        crossed[times == 1] = _crossings(flat.points[ends[times == 1], :2])
        bad = crossed[which]
    if not bad.any():
        bad = np.repeat(_covered(centre, corner), around)
    if bad.any():
        found = np.unique(cell[bad])
        x, y = centre[found[0]]
        raise InputError(
            f"{len(found)} cells overlap others, the first at ({x:.4g}, {y:.4g}) m: inverted "
            "cells, or surfaces on top of each other; mend the mesh"
        )


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return twice the signed area (n,) of the triangles a b c, each (n, 2)."""
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])


def _crossings(lines: np.ndarray) -> np.ndarray:
    """Return (n,) True for each of lines (n, 2, 2) that crosses another one, not at its ends."""
    a, b = lines[:, 0], lines[:, 1]
    reach = np.linalg.norm(b - a, axis=1).max()
    pairs = cKDTree(0.5 * (a + b)).query_pairs(reach, output_type="ndarray")
    i, j = pairs.T
    tiny = 1e-9 * reach * reach
    first = _turn(a[i], b[i], a[j]), _turn(a[i], b[i], b[j])
    second = _turn(a[j], b[j], a[i]), _turn(a[j], b[j], b[i])
    cross = np.minimum(*map(np.abs, first)) > tiny
    cross &= np.minimum(*map(np.abs, second)) > tiny
    cross &= (first[0] * first[1] < 0.0) & (second[0] * second[1] < 0.0)
    crossed = np.zeros(len(lines), dtype=bool)
    crossed[pairs[cross]] = True
    return crossed


def _covered(centre: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Return (n,) True for cells whose centre (n, 2) lies in one of the cells near it."""
    near = cKDTree(centre).query(centre, k=min(9, len(centre)))[1].reshape(len(centre), -1)
    covered = np.zeros(len(centre), dtype=bool)
    here = np.arange(len(centre))
    for other in near.T:
        a = corner[other]
        turns = np.stack(
            [_turn(a[:, k - 1], a[:, k], centre) for k in range(corner.shape[1])], axis=1
        )
        inside = (turns > 0.0).all(axis=1) | (turns < 0.0).all(axis=1)
        covered |= inside & (other != here)
    return covered


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


def _remedy(found: float, expected: float, keys: str = "length and height") -> str:
    if expected > 0.0 and 900.0 < found / expected < 1100.0:
        return "lengths are in metres, these look like millimetres"
    return f"mend the geometry, or {keys} in the scene"
