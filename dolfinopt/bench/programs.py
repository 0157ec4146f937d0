"""Other programs: a static iteration in plain DOLFINx and in pyMOTO, the motion in Exudyn."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.fem import petsc
from petsc4py import PETSc

from dolfinopt.errors import ConvergenceError
from dolfinopt.fem.multigrid import with_rigid_motions
from dolfinopt.mesh import compat
from dolfinopt.mesh.arm_mesh import ArmMesh
from dolfinopt.multibody.motion import rigid_motion
from dolfinopt.scene.load import Scene

PENALTY, FLOOR = 3.0, 1e-6  # of the interpolation
SPECTRAL_RADIUS = 0.8  # of generalised-alpha at infinite frequency, also the scenes' default
# Of Exudyn's residuals, N and m: its own 1e-10, and up to 1e-6, is below what the axial stiffness
# of short beams, times the rounding of places of 1 m, leaves.
RESIDUAL = 1e-5

# Densities (n_cells,) -> compliance under a force across the end, N m, and its gradient.
Iteration = Callable[[np.ndarray], tuple[float, np.ndarray]]


class PlainStatics:
    """Compliance of a cantilever as DOLFINx's own demos would find it, step by step (collective).

    One load at the end, linear elements, no filter. In the plane MUMPS' Cholesky factor; in space
    conjugate gradients with GAMG, from zero.
    """

    def __init__(
        self, arm: ArmMesh, modulus: float, nu: float, area: float, tolerance: float = 1e-7
    ) -> None:
        """Compile the forms.

        Args:
            arm: clamped at its inboard facets.
            modulus: Young's, of density 1; times the thickness in the plane.
            nu: Poisson's ratio.
            area: of the end, on which 1 N is spread; its height in the plane.
            tolerance: of conjugate gradients.
        """
        mesh, d, self.modulus, self.count = arm.mesh, arm.dim, modulus, arm.num_cells
        self.space = space = compat.lagrange_space(mesh, 1, components=d)
        cellwise = getattr(fem, "functionspace", fem.FunctionSpace)(mesh, ("DG", 0))
        self.x, self.u, self.in_plane = fem.Function(cellwise), fem.Function(space), d == 2
        a, b, w = ufl.TrialFunction(space), ufl.TestFunction(space), ufl.TestFunction(cellwise)
        # In the plane the law stands in the form, as one writes it; that doubles what an iteration
        # takes: quadrature allows for x**3.0 as if x varied in a cell. In space x is E itself.
        young = modulus * (FLOOR + (1.0 - FLOOR) * self.x**PENALTY) if d == 2 else self.x
        slope = -modulus * PENALTY * (1.0 - FLOOR) * self.x ** (PENALTY - 1.0) if d == 2 else 1.0
        shear, rest = 1.0 / (1.0 + nu), 1.0 - nu if d == 2 else 1.0 - 2.0 * nu

        def energy(u: Any, v: Any) -> Any:  # of unit stiffness; plane stress in the plane
            strain, other = ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v))
            stress = shear * strain + shear * nu / rest * ufl.tr(strain) * ufl.Identity(d)
            return ufl.inner(stress, other)

        end = ufl.gt(ufl.SpatialCoordinate(mesh)[0], (1.0 - 1e-9) * arm.outboard_point[0])
        load = ufl.conditional(end, 1.0 / area, 0.0) * b[1] * ufl.ds
        self._stiffness = compat.compile_form(young * energy(a, b) * ufl.dx)
        self._gradient = compat.compile_form(slope * energy(self.u, self.u) * w * ufl.dx)
        dofs = fem.locate_dofs_topological(space, d - 1, arm.inboard_facets)
        self._clamp = fem.dirichletbc(np.zeros(d), dofs, space)
        self.load = petsc.assemble_vector(compat.compile_form(load))
        self.load.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
        petsc.set_bc(self.load, [self._clamp])
        self.solution, self.K = self.load.duplicate(), petsc.create_matrix(self._stiffness)
        self._ksp = PETSc.KSP().create(arm.comm)
        self._ksp.setType("preonly" if d == 2 else "cg")
        self._ksp.getPC().setType("cholesky" if d == 2 else "gamg")
        if d == 2:
            self._ksp.getPC().setFactorSolverType("mumps")
        self._ksp.setTolerances(rtol=tolerance)

    def assemble(self, x: np.ndarray) -> None:
        """Assemble K of these densities."""
        young = x if self.in_plane else self.modulus * (FLOOR + x**PENALTY)
        self.x.x.array[: self.count] = young
        compat.scatter_forward(self.x)
        self.K.zeroEntries()
        petsc.assemble_matrix(self.K, self._stiffness, bcs=[self._clamp])
        self.K.assemble()
        if self.in_plane:
            self.K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            self.K.setOption(PETSc.Mat.Option.SPD, True)

    def add_rigid_motions(self) -> None:
        """Tell GAMG what K in space does not resist."""
        owned = self.K.getLocalSize()[0] // 3
        with_rigid_motions(self.K, self.space.tabulate_dof_coordinates()[:owned])

    def factorise(self) -> None:
        """Make the factor, or the hierarchy."""
        self._ksp.setOperators(self.K)
        self._ksp.setUp()

    def solve(self) -> None:
        """Find the displacement."""
        self._ksp.solve(self.load, self.solution)

    def gradient(self) -> np.ndarray:
        """Return the derivative (n_cells,) by every density; in space energies."""
        self.u.x.array[: len(self.solution.array)] = self.solution.array
        compat.scatter_forward(self.u)
        return petsc.assemble_vector(self._gradient).array_r.copy()

    def __call__(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """Do one iteration."""
        self.assemble(x)
        self.factorise()
        self.solve()
        return float(self.load.dot(self.solution)), self.gradient()


def pymoto_iteration(scene: Scene, cells: tuple[int, int]) -> Iteration | None:
    """Return the same of the scene's first arm in pyMOTO, with the solver it chooses; or None.

    Source: pyMOTO, https://github.com/aatmdelissen/pyMOTO, version 1.5.
    """
    try:
        import pymoto as pym
    except ImportError:
        return None
    (along, across), arm, solid = cells, scene.arms[0], scene.material_of(0)
    assert arm.height is not None
    domain = pym.DomainDefinition(
        along, across, unitx=arm.length / along, unity=arm.height / across, unitz=arm.thickness
    )
    rows = np.arange(across + 1)
    left, right = domain.get_nodenumber(0, rows), domain.get_nodenumber(along, rows)
    force, fixed = np.zeros(2 * domain.nnodes), (2 * left[:, None] + np.arange(2)).ravel()
    force[2 * right + 1] = np.where((rows == 0) | (rows == across), 0.5, 1.0) / across
    density, load = pym.Signal("x", np.ones(domain.nel)), pym.Signal("f", force)
    stiff, matrix, u, compliance = (pym.Signal(name) for name in "sKuc")
    elastic = {"e_modulus": solid.young_modulus, "poisson_ratio": solid.poisson_ratio}
    options = {"domain": domain, "bc": fixed, "plane": "stress", **elastic}
    law = f"{FLOOR} + {1.0 - FLOOR} * inp0^{PENALTY:g}"
    network = pym.Network(
        pym.MathGeneral(density, stiff, expression=law),
        pym.AssembleStiffness(stiff, matrix, **options),
        pym.LinSolve([matrix, load], u),
        pym.EinSum([u, load], compliance, expression="i,i->"),
    )

    def iterate(x: np.ndarray) -> tuple[float, np.ndarray]:
        network.reset()
        density.state = x
        network.response()
        compliance.sensitivity = 1.0
        network.sensitivity()
        return float(compliance.state), np.asarray(density.sensitivity)

    return iterate


# -- Exudyn ----------------------------------------------------------------------------------


def exudyn_tip(scene: Scene, elements: int, steps: int) -> np.ndarray:
    """Return instants (s) and the end-effector's place (m), (steps + 1, 3), of the solid arms.

    Geometrically exact planar beams. The cart and the joints' angles follow the scene's rigid
    motion, by constraints on the nodes' coordinates; the angle of an arm counts from the end of the
    one before, bent as it is. Source: Exudyn, https://github.com/jgerstmayr/EXUDYN, version 1.13;
    doi:10.1007/s11044-023-09937-1.

    Args:
        scene: rectangular arms, stiffness-proportional damping, no gravity.
        elements: beams an arm.
        steps: of implicit generalised-alpha over the horizon.

    Raises:
        ConvergenceError: Exudyn gave up.
    """
    import exudyn
    import exudyn.itemInterface as items

    system = exudyn.SystemContainer().AddSystem()
    node, place = _beams(system, scene, elements, steps), exudyn.OutputVariableType.Position
    kept = {"storeInternal": True, "writeToFile": False}
    sensor = system.AddSensor(items.SensorNode(nodeNumber=node, outputVariableType=place, **kept))
    system.Assemble()
    options: Any = exudyn.SimulationSettings()
    time, horizon = options.timeIntegration, scene.motion.horizon
    time.numberOfSteps, time.endTime, time.verboseMode = steps, horizon, 0
    time.generalizedAlpha.spectralRadius = SPECTRAL_RADIUS
    time.adaptiveStep = False  # the steps are what is compared
    time.newton.useModifiedNewton, time.newton.absoluteTolerance = True, RESIDUAL
    options.linearSolverType = exudyn.LinearSolverType.EXUdense
    options.solutionSettings.writeSolutionToFile = False
    options.solutionSettings.sensorsWritePeriod = 0.5 * horizon / steps
    options.displayStatistics = options.displayComputationTime = False
    try:
        done = system.SolveDynamic(options)
    except Exception as error:  # Exudyn's own, of several types
        raise ConvergenceError(f"Exudyn: {error}") from None
    if done is False:
        raise ConvergenceError("Exudyn gave up")
    return np.asarray(system.GetSensorStoredData(sensor))[:, :3]


def _beams(system: Any, scene: Scene, elements: int, steps: int) -> int:
    """Add beams, payload and constraints; return the end-effector's node."""
    import exudyn.itemInterface as items

    # Looked up at the steps' ends, where Exudyn asks: the formulas would cost more than its steps.
    table = rigid_motion(np.linspace(0.0, scene.motion.horizon, steps + 1), scene).q
    offsets = (table - table[0]).T.tolist()

    def offset(column: int, _: Any, t: float, item: int, given: float) -> float:
        return float(offsets[column][round(t / scene.motion.horizon * steps)])

    def marker(node: int, coordinate: int) -> int:
        one = items.MarkerNodeCoordinate(nodeNumber=node, coordinate=coordinate)
        return int(system.AddMarker(one))

    place, angle = np.array([table[0, 0], scene.motion.joint_height]), 0.0
    before, ground = -1, marker(system.AddNode(items.NodePointGround()), 0)
    for index, arm in enumerate(scene.arms):
        angle += float(table[0, 1 + index])
        along = np.array([np.cos(angle), np.sin(angle)]) * arm.length / elements
        nodes = [
            system.AddNode(items.NodeRigidBody2D(referenceCoordinates=[*point, angle]))
            for point in place + np.arange(elements + 1)[:, None] * along
        ]
        beam = _section(scene, index) | {"length": arm.length / elements}
        for pair in pairwise(nodes):
            system.AddObject(items.ObjectBeamGeometricallyExact2D(nodeNumbers=list(pair), **beam))
        drives = partial(offset, 0) if index == 0 else 0, 0, partial(offset, 1 + index)
        for coordinate, drive in enumerate(drives):
            other = marker(before, coordinate) if index else ground
            ends = {"markerNumbers": [other, marker(nodes[0], coordinate)]}
            system.AddObject(items.ObjectConnectorCoordinate(**ends, offsetUserFunction=drive))
        before, place = nodes[-1], place + elements * along
    load = {"mass": scene.payload.mass, "inertia": scene.payload.inertia}
    system.AddObject(items.ObjectRigidBody2D(**load, nodeNumber=before))
    return int(before)


def _section(scene: Scene, index: int) -> dict[str, Any]:
    """Return the keywords of a beam of the solid arm."""
    arm, solid = scene.arms[index], scene.material_of(index)
    assert arm.height is not None
    area, second = arm.height * arm.thickness, arm.thickness * arm.height**3 / 12.0
    E, nu, damping = solid.young_modulus, solid.poisson_ratio, scene.damping.stiffness_proportional
    shear = 10.0 * (1.0 + nu) / (12.0 + 11.0 * nu)  # Cowper (1966), doi:10.1115/1.3625046
    known: dict[str, Any] = {"includeReferenceRotations": False}
    known |= {"massPerLength": solid.density * area, "crossSectionInertia": solid.density * second}
    shears = shear * E / (2.0 * (1.0 + nu)) * area
    for kind, stiffness in (("bending", E * second), ("axial", E * area), ("shear", shears)):
        known |= {f"{kind}Stiffness": stiffness, f"{kind}Damping": damping * stiffness}
    return known
