"""Geometry files -> a Gmsh model of one arm with the groups this program knows, on the root.

Reads .geo (parametric or not), .msh and .step. The model leaves here with the physical groups of
`groups.py`, made of first-order cells of one kind that have passed `checks.py`.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.mesh.checks import check_mesh, flatten
from dolfinopt.mesh.file_check import open_file
from dolfinopt.mesh.gmsh_session import mesh_surfaces, silent_terminal
from dolfinopt.mesh.groups import find_groups, rename_groups, unknown_names
from dolfinopt.mesh.step_model import read_step
from dolfinopt.scene.tables.arms import SIZE_PARAMETER, Arm

# ONELAB parameters of meshes/*.geo, without the number that orders them.
LENGTH, HEIGHT, SOLID = "length (m)", "height (m)", "solid length at both ends (m)"
SIZE, SHAPE = SIZE_PARAMETER, "cell shape"


def build_model(gmsh: Any, arm: Arm) -> tuple[np.ndarray, tuple[str, ...]]:
    """Make the Gmsh model of an arm with a mesh file: read, mesh, name the groups, check.

    Returns:
        Lines (n, 2, 2) of both interfaces, m, from which `arm.solid_ends` is still to be measured;
        none where the geometry has seen to it. And warnings, a sentence each.

    Raises:
        InputError: one line that names file, arm and remedy. Other errors are this program's.
    """
    assert arm.mesh is not None
    where = f"{arm.mesh}: mesh of arm {arm.name!r}"
    readers = {".geo": _read_geo, ".msh": _read_msh, ".step": read_step, ".stp": read_step}
    unknown: list[str] = []
    try:
        with silent_terminal():
            solid_done = readers[Path(arm.mesh).suffix.lower()](gmsh, arm, unknown)
        groups = find_groups(gmsh, unknown)
        rename_groups(gmsh, groups)
        flat = flatten(gmsh)
        check_mesh(flat, arm)
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except Exception as error:
        if type(error) is not Exception:  # Gmsh raises no other
            raise
        text = " ".join(str(error).split()) or "Gmsh failed"
        raise InputError(f"{where}: {text}; open the file in Gmsh to repair it") from None
    notes = (unknown_names(where, unknown),) if unknown else ()
    if solid_done or arm.solid_ends == 0.0:
        return np.empty((0, 2, 2)), notes
    return flat.points[np.concatenate([flat.inboard, flat.outboard])][:, :, :2], notes


def _read_geo(gmsh: Any, arm: Arm, _: list[str]) -> bool:
    """Mesh the .geo file with those of the scene's values it has parameters for."""
    assert arm.mesh is not None
    open_file(gmsh, arm.mesh)
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
    open_file(gmsh, arm.mesh)
    mesh_surfaces(gmsh, arm.cell_shape)
    return SOLID in names


def _read_msh(gmsh: Any, arm: Arm, _: list[str]) -> bool:
    assert arm.mesh is not None
    open_file(gmsh, arm.mesh)
    return False
