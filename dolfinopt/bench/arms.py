"""Error of one arm's elements, and of its reduced model, against CPU seconds and size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinopt.bench.measure import DESIGNS, Cells, Plan, bodies_of, designs, tidy, timed
from dolfinopt.bench.panel import Diagram, Panel, Rows, Steps
from dolfinopt.dynamics.simulation import Trajectory, simulate
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.fem.elasticity import ElasticArm, Substructure
from dolfinopt.fem.elements import IncompatibleElement, LagrangeElement
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, shape_integrals
from dolfinopt.profiling import Profile
from dolfinopt.reduction import METHODS, Options
from dolfinopt.scene.load import Scene
from dolfinopt.study.variants import changed, reduced

CELLS = (50, 3), (100, 6), (200, 12), (400, 24), (800, 48), (1600, 96)
# Of third degree, one order above the elements compared, and graded towards the corners.
REFERENCE, QUICK_REFERENCE = (240, 32), (120, 16)
MOST_DOFS = 700_000  # of an element compared; more does not fit small machines
LARGE = 100_000  # degrees of freedom of a design that is timed twice only
COORDINATES = 12  # Craig-Bampton: the first frequency is then right to 1e-6 of the mesh's
DEFAULT = "QM6, incompatible modes"
EXACTLY = "simulation.tolerance=1e-6", "simulation.stages=5"  # below the errors of all meshes
COUNTS, QUICK_COUNTS = (3, 4, 5, 6, 8, 12, 16, 24, 32, 48), (3, 4, 6, 12)
# More coordinates than any method compared has, and of the kind that converges surely.
MOST, QUICK_MOST = 100, 32
# The steps come out alike, so that what they leave cancels in the differences: methods were seen
# to agree to 1e-10.
ALIKE = "simulation.tolerance=1e-7", "simulation.stages=5"


# -- elements --------------------------------------------------------------------------------


def grid_arm(
    length: float, height: float, cells: Cells, triangles: bool = False, graded: bool = False
) -> ArmMesh:
    """Mesh a rectangular arm by DOLFINx's own grid, on this rank alone.

    Lines of a `graded` grid crowd at all edges, u -> u^3 (10 - 15 u + 6 u^2): stresses are singular
    at the corners of a clamped end.
    """
    from dolfinx import mesh as meshes

    low, size = np.array([0.0, -0.5 * height]), np.array([length, height])
    kind = meshes.CellType.triangle if triangles else meshes.CellType.quadrilateral
    mesh = meshes.create_rectangle(MPI.COMM_SELF, [low, low + size], list(cells), kind)
    if graded:
        u = (mesh.geometry.x[:, :2] - low) / size
        mesh.geometry.x[:, :2] = low + size * u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    mesh.topology.create_connectivity(1, 2)
    count, _ = compat.local_cell_counts(mesh)
    points = compat.cell_coordinates(mesh, count)[:, :, :2]
    return ArmMesh(
        name="arm",
        comm=MPI.COMM_SELF,
        mesh=mesh,
        centroid=points.mean(axis=1),
        area=np.ptp(points, axis=1).prod(axis=1) * (0.5 if triangles else 1.0),
        passive=np.zeros(count, dtype=bool),
        void=np.zeros(count, dtype=bool),
        inboard_facets=compat.facets_on(mesh, 0.0, 1e-9 * length),
        outboard_facets=compat.facets_on(mesh, length, 1e-9 * length),
        outboard_point=np.array([length, 0.0]),
    )


@dataclass(frozen=True)
class Element:
    """A finite element: its name, its matrices, its shape, and whether its grid is graded."""

    name: str
    operators: Callable[[ArmMesh, float, float], Any]
    nodes: int = 1  # a cell, of a large grid
    triangles: bool = False
    graded: bool = False

    def arm(self, scene: Scene, cells: Cells) -> Substructure:
        """Mesh the scene's first arm, see `grid_arm`, and lay down its matrices."""
        arm = scene.arms[0]
        assert arm.height is not None
        mesh = grid_arm(arm.length, arm.height, cells, self.triangles, self.graded)
        operators = self.operators(mesh, arm.thickness, scene.material_of(0).poisson_ratio)
        return Substructure(mesh, operators, Profile())


ELEMENTS = (
    Element("Q1", LagrangeElement(1).operators),
    Element(DEFAULT, IncompatibleElement().operators),
    Element("Q2", LagrangeElement(2).operators, nodes=4),
    Element("P1 triangles", LagrangeElement(1).operators, triangles=True),
    Element("P2 triangles", LagrangeElement(2).operators, nodes=4, triangles=True),
)
FINER = Element("graded Q3, half the reference", LagrangeElement(3).operators, graded=True)


def solid(scene: Scene, substructure: Substructure, scale: float = 1.0) -> ElasticArm:
    """Return the arm solid, stiffness and mass times `scale`."""
    ones, material = np.ones(substructure.mesh.num_cells), scene.material_of(0)
    return substructure.at(scale * material.young_modulus * ones, scale * material.density * ones)


def solid_body(scene: Scene, substructure: Substructure) -> ShapeIntegrals:
    """Reduce the solid arm to `COORDINATES`."""
    elastic = solid(scene, substructure)
    basis = METHODS["craig-bampton"].reduce(elastic, Options(COORDINATES), None)
    return shape_integrals(elastic, basis, scene.damping.stiffness_proportional)


def respond(
    scene: Scene, element: Element, cells: Cells, repeats: int = 1
) -> tuple[np.ndarray, int, float, float]:
    """Discretise the scene's first arm, solid, reduce it, and move a mechanism of such arms.

    Returns:
        Deflection of the tip by a unit force across, m/N, first frequency, clamped-free, Hz, and
        maximal deviation of a mechanism of such arms, m; degrees of freedom; CPU seconds of a
        design, and of what is done once a run.
    """
    setup, _, substructure = timed(partial(element.arm, scene, cells))
    dofs, seconds = substructure.T.num_dofs, np.inf
    # The first one analyses the matrix for the whole run.
    for _ in range(2 if dofs > LARGE else repeats + 1):
        solid(scene, substructure, 0.5)
        now, _, body = timed(partial(solid_body, scene, substructure))
        seconds = min(seconds, now)
    flexibility = np.linalg.inv(solid(scene, substructure).constraint_modes().stiffness)
    far = simulate(scene, [body] * len(scene.arms), Profile()).max_deviation[0]
    return np.array([flexibility[1, 1], body.first_frequency, far]), dofs, seconds, setup


def _meshes(plan: Plan) -> Steps:
    scene = changed(plan.scene, *EXACTLY, f"reduction.coordinates={COORDINATES}")
    best = QUICK_REFERENCE if plan.quick else REFERENCE
    right = cache(partial(respond, scene, FINER, best))

    def row(element: Element, cells: Cells) -> Rows:
        tidy()
        found, *sizes = respond(scene, element, cells, plan.repeats)
        errors = np.abs(found / right()[0] - 1.0)
        yield element.name, f"{cells[0]} x {cells[1]}", *sizes, *errors.tolist()

    cases = [(one, cells) for one in ELEMENTS for cells in CELLS[: 3 if plan.quick else None]]
    for element, cells in [*cases, (FINER, (best[0] // 2, best[1] // 2))]:
        if 2 * element.nodes * cells[0] * cells[1] <= MOST_DOFS:
            yield f"{element.name}, {cells[0]} x {cells[1]}", partial(row, element, cells)


QUANTITIES = "tip compliance", "first frequency", "maximal deviation"
MESHES = Diagram(
    "mesh",
    "Finite elements: error against time and degrees of freedom",
    "element | cells | degrees of freedom | seconds [s] | set-up [s] | "
    + " | ".join(f"error of {what} [-]" for what in QUANTITIES),
    _meshes,
    tuple(
        Panel(x, f"error of {what} [-]", "element", errors=(1e-2, 1e-3) if "[s]" in x else ())
        for x in ("seconds [s]", "degrees of freedom")
        for what in QUANTITIES
    ),
    f"Reference: Q3 on {REFERENCE} cells (quick: {QUICK_REFERENCE}), graded towards the corners, "
    "which are singular and limit every order on uniform grids. Seconds of one design of the solid "
    f"arm: assembly, factorisation, {COORDINATES} coordinates, integrals.",
)


# -- reductions ------------------------------------------------------------------------------


def errors(found: Trajectory, right: Trajectory) -> tuple[float, float]:
    """Return relative errors of the largest compliance, and of the deviation in time."""
    one, other = (each.compliance.sum(axis=1).max() for each in (found, right))
    far = np.linalg.norm(found.deviation - right.deviation, axis=1).max()
    return float(abs(one / other - 1.0)), float(far / right.distance.max())


def _reductions(plan: Plan) -> Steps:
    counts, most = (QUICK_COUNTS, QUICK_MOST) if plan.quick else (COUNTS, MOST)
    base = changed(plan.scene, *ALIKE)

    def trajectory(design: str, method: str, count: int) -> Trajectory:
        scene = reduced(base, method, count)
        return simulate(scene, bodies_of(scene, *designs(plan)[design]), Profile()).sampled

    right = cache(partial(trajectory, method="craig-bampton", count=most))

    def row(design: str, method: str, count: int) -> Rows:
        arms, x_phys = designs(plan)[design]
        seconds = np.inf
        try:
            scene = reduced(base, method, count)
            for _ in range(plan.repeats):
                for arm in arms.values():  # what was factorised is forgotten
                    arm.set_design(np.full(arm.mesh.num_cells, 0.25))
                seconds = min(seconds, timed(partial(bodies_of, scene, arms, x_phys))[0])
            found = trajectory(design, method, count)
        except (ConvergenceError, InputError):
            return  # not possible with so few or many
        yield design, method, count, seconds, *errors(found, right(design))

    for design in DESIGNS:
        for method in METHODS:
            for count in counts:
                yield f"{method}, q = {count}, {design}", partial(row, design, method, count)


REDUCTIONS = Diagram(
    "reduction",
    "Reducing the arms: error against coordinates and time",
    "design | method | coordinates per arm | seconds [s] | error of compliance [-] | "
    "error of deviation [-]",
    _reductions,
    (
        Panel("coordinates per arm", "error of compliance [-]", "method", each=("design",)),
        Panel("coordinates per arm", "error of deviation [-]", "method", each=("design",)),
        Panel("seconds [s]", "error of deviation [-]", "method", each=("design",),
              errors=(1e-2, 1e-3, 1e-4, 1e-6)),
    ),
    f"Reference: Craig-Bampton with {MOST} coordinates per arm (quick: {QUICK_MOST}). Errors of "
    "the largest compliance, and of the deviation, largest in time over the largest value. Seconds "
    "of both arms from cold: assembly, factorisation, basis, inertia integrals.",
)  # fmt: skip
