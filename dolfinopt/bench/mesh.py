"""Error of one arm's discretisation against CPU seconds and degrees of freedom, by element."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinopt.bench.common import Diagram, Goal, Plan, Row, Tell, curves, tidy, timed
from dolfinopt.dynamics.simulation import simulate
from dolfinopt.fem.elasticity import ElasticArm, Substructure
from dolfinopt.fem.elements import ElementOperators, IncompatibleElement, LagrangeElement
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.mesh.compat import cell_coordinates, local_cell_counts
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, first_frequency, shape_integrals
from dolfinopt.profiling import Profile
from dolfinopt.reduction import METHODS, Options
from dolfinopt.scene.load import Scene
from dolfinopt.study.tables import Panel
from dolfinopt.study.variants import changed

CELLS = (50, 3), (100, 6), (200, 12), (400, 24), (800, 48), (1600, 96)
QUICK = (50, 3), (100, 6), (200, 12)
# Of third degree, one order above the elements compared, and graded towards the corners.
REFERENCE, QUICK_REFERENCE = (240, 32), (120, 16)
MOST_DOFS = 700_000  # of an element compared; more does not fit small machines
LARGE = 100_000  # degrees of freedom of a design that is timed twice only
COORDINATES = 12  # Craig-Bampton: the first frequency is then right to 1e-6 of the mesh's
GOALS = 1e-2, 1e-3, 1e-4  # errors that the notes give the cheapest element for
DEFAULT, COMPLIANCE = "QM6, incompatible modes", 0.5  # %, its error on the coarsest cells at most
TOLERANCE, STAGES = 1e-6, 5  # of the motions: below the errors of all meshes


def diagram() -> Diagram:
    """Return the diagram of the finite elements."""
    return Diagram(
        "mesh",
        "Finite elements: error against time and degrees of freedom",
        (
            "element",
            "cells",
            "degrees of freedom",
            "seconds [s]",
            "set-up [s]",
            "error of tip compliance [-]",
            "error of first frequency [-]",
            "error of maximal deviation [-]",
        ),
        _measure,
        _panels,
        _notes,
        abreast=3,
        goals=_goals,
    )


# -- elements --------------------------------------------------------------------------------


def grid_arm(
    length: float,
    height: float,
    cells: tuple[int, int],
    triangles: bool = False,
    graded: bool = False,
) -> ArmMesh:
    """Mesh a rectangular arm by DOLFINx's own grid, on this rank alone.

    Args:
        length, height: m.
        cells: along and across; each is cut into two `triangles` if asked for.
        graded: whether lines crowd at all edges, u -> u^3 (10 - 15 u + 6 u^2): stresses are
            singular at the corners of a clamped end.
    """
    from dolfinx import mesh as meshes

    corners = [np.array([0.0, -0.5 * height]), np.array([length, 0.5 * height])]
    kind = meshes.CellType.triangle if triangles else meshes.CellType.quadrilateral
    mesh = meshes.create_rectangle(MPI.COMM_SELF, corners, list(cells), kind)
    if graded:
        low, size = corners[0], corners[1] - corners[0]
        u = (mesh.geometry.x[:, :2] - low) / size
        mesh.geometry.x[:, :2] = low + size * u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    mesh.topology.create_connectivity(1, 2)
    count, _ = local_cell_counts(mesh)
    points = cell_coordinates(mesh, count)[:, :, :2]

    def at(x: float) -> Any:
        return meshes.locate_entities_boundary(mesh, 1, lambda p: np.isclose(p[0], x))

    return ArmMesh(
        name="arm",
        comm=MPI.COMM_SELF,
        mesh=mesh,
        centroid=points.mean(axis=1),
        area=np.ptp(points, axis=1).prod(axis=1) * (0.5 if triangles else 1.0),
        passive=np.zeros(count, dtype=bool),
        void=np.zeros(count, dtype=bool),
        inboard_facets=at(0.0),
        outboard_facets=at(length),
        outboard_point=np.array([length, 0.0]),
    )


Operators = Callable[[ArmMesh, float, float], ElementOperators]


@dataclass(frozen=True)
class Element:
    """A finite element: its name, its shape, its matrices, and whether its grid is graded."""

    name: str
    triangles: bool
    operators: Operators
    graded: bool = False

    def arm(self, length: float, height: float, cells: tuple[int, int]) -> ArmMesh:
        """Mesh a rectangular arm, see `grid_arm`."""
        return grid_arm(length, height, cells, self.triangles, self.graded)


ELEMENTS = (
    Element("Q1", False, LagrangeElement(1).operators),
    Element(DEFAULT, False, IncompatibleElement().operators),
    Element("Q2", False, LagrangeElement(2).operators),
    Element("P1 triangles", True, LagrangeElement(1).operators),
    Element("P2 triangles", True, LagrangeElement(2).operators),
)
FINER = Element("Q3", False, LagrangeElement(3).operators, graded=True)


# -- measuring -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Response:
    """What a discretised solid arm does.

    Attributes:
        compliance: deflection of the tip by a unit force across, m/N.
        frequency: first, clamped-free, Hz.
        deviation: maximal, of a mechanism of such arms, m.
        dofs: degrees of freedom.
        seconds, setup: CPU time of a design and of what is done once a run.
    """

    compliance: float
    frequency: float
    deviation: float
    dofs: int
    seconds: float
    setup: float


def respond(scene: Scene, element: Element, cells: tuple[int, int], repeats: int = 1) -> Response:
    """Discretise the scene's first arm, solid, reduce it, and move a mechanism of such arms."""
    arm, solid = scene.arms[0], scene.material_of(0)

    def set_up() -> Substructure:
        mesh = element.arm(arm.length, arm.height, cells)
        operators = element.operators(mesh, arm.thickness, solid.poisson_ratio)
        return Substructure(mesh, operators, Profile())

    setup, substructure = timed(set_up, 1)
    ones = np.ones(substructure.mesh.num_cells)
    damping = scene.damping.stiffness_proportional

    def at(scale: float) -> ElasticArm:
        return substructure.at(scale * solid.young_modulus * ones, scale * solid.density * ones)

    def reduce() -> ShapeIntegrals:
        elastic = at(1.0)
        basis = METHODS["craig-bampton"].reduce(elastic, Options(COORDINATES), None)
        return shape_integrals(elastic, basis, damping)

    seconds = np.inf
    # The first one analyses the matrix for the whole run.
    dofs = substructure.T.num_dofs
    for _ in range(2 if dofs > LARGE else repeats + 1):
        at(0.5)
        now, body = timed(reduce, 1)
        seconds = min(seconds, now)
    flexibility = np.linalg.inv(at(1.0).constraint_modes().stiffness)
    trajectory = simulate(scene, [body] * len(scene.arms), Profile())
    return Response(
        float(flexibility[1, 1]),
        first_frequency(body),
        trajectory.max_deviation[0],
        dofs,
        seconds,
        setup,
    )


def _measure(plan: Plan, tell: Tell) -> list[Row]:
    scene = changed(
        plan.scene,
        f"simulation.tolerance={TOLERANCE}",
        f"simulation.stages={STAGES}",
        f"reduction.coordinates={COORDINATES}",
    )
    best = QUICK_REFERENCE if plan.quick else REFERENCE
    tell("reference")
    right = respond(scene, FINER, best)
    rows: list[Row] = []
    half = (best[0] // 2, best[1] // 2)
    cases = [(one, cells) for one in ELEMENTS for cells in (QUICK if plan.quick else CELLS)]
    for element, cells in [*cases, (FINER, half)]:
        nodes = (4 if element.name.endswith("2") or "P2" in element.name else 1) * np.prod(cells)
        if 2 * nodes > MOST_DOFS:
            continue
        tell(f"{element.name}, {cells[0]} x {cells[1]}")
        tidy()
        found = respond(scene, element, cells, plan.repeats)
        rows.append(
            (
                element.name if element is not FINER else "graded Q3, half the reference",
                f"{cells[0]} x {cells[1]}",
                found.dofs,
                found.seconds,
                found.setup,
                abs(found.compliance / right.compliance - 1.0),
                abs(found.frequency / right.frequency - 1.0),
                abs(found.deviation / right.deviation - 1.0),
            )
        )
    return rows


# -- presented -------------------------------------------------------------------------------


def _panels(rows: Sequence[Row]) -> tuple[Panel, ...]:
    return tuple(
        Panel(what, x, f"error of {what} [-]", curves(rows, 0, at, column))
        for x, at in (("CPU time of a design [s]", 3), ("degrees of freedom [-]", 2))
        for what, column in (
            ("tip compliance", 5),
            ("first frequency", 6),
            ("maximal deviation", 7),
        )
    )


def _goals(rows: Sequence[Row]) -> list[Goal]:
    coarse = _by(CELLS[0])
    found = [100.0 * float(row[5]) for row in rows if (row[0], row[1]) == (DEFAULT, coarse)]
    what = f"error of tip compliance, {coarse} cells of the default element [%]"
    return [Goal(what, COMPLIANCE, found[0] if found else np.nan)]


def _by(cells: tuple[int, int]) -> str:
    return f"{cells[0]} x {cells[1]}"


def _notes(rows: Sequence[Row]) -> list[str]:
    notes = [
        f"Reference: Q3 on {_by(REFERENCE)} cells ({_by(QUICK_REFERENCE)} in a quick bench), one "
        "order above the elements compared, on a grid graded towards the corners of the "
        "clamped end, which are singular and limit every order on the uniform grids that are "
        "compared; how far it is to be trusted shows in the same with half as many cells either "
        "way. Solid arms.",
        f"Q2 and P2 on {_by(CELLS[-1])} cells, above {MOST_DOFS:,} degrees of freedom, are left "
        "out: minutes and gigabytes for less than 0.01 %, which coarser ones reach.",
        "Seconds of one design: assembly, factorisation, Craig-Bampton basis of "
        f"{COORDINATES} coordinates, inertia integrals.",
    ]
    compared = [row for row in rows if "Q3" not in str(row[0])]
    for goal in GOALS:
        met = [row for row in compared if max(float(e) for e in row[5:8]) <= goal]
        if met:
            best = min(met, key=lambda row: float(row[3]))
            notes.append(
                f"All three to {100 * goal:g} %: cheapest is {best[0]}, {best[1]} cells, "
                f"{best[2]} degrees of freedom, {float(best[3]):.3g} s."
            )
        else:
            notes.append(f"All three to {100 * goal:g} %: none of these meshes.")
    return notes
