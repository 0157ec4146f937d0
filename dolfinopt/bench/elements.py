"""Error of finite elements against CPU seconds: how far the tip of a solid arm bends."""

from __future__ import annotations

from functools import cache, partial
from typing import get_args

import numpy as np
from mpi4py import MPI

from dolfinopt.arms.arm import Arm
from dolfinopt.bench.measure import Cells, Plan, timed
from dolfinopt.bench.panel import Diagram, Rows, Steps
from dolfinopt.profiling import Profile
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.arms import ElementName
from dolfinopt.study.variants import changed

CELLS = (50, 3), (100, 6), (200, 12), (400, 24)
DEFAULT, FINEST = "incompatible", "quadratic"
REFERENCE = 800, 48  # cells of the finest element
ERROR = "error of tip compliance [-]"


def tip_compliance(scene: Scene, element: str, cells: Cells) -> tuple[float, int, float]:
    """Return the first arm's deflection by force across, solid, m/N; its dofs; CPU seconds."""
    other = changed(scene, f"arms.element={element}", f"arms.cells={list(cells)}")
    arm = Arm(other, 0, MPI.COMM_SELF, Profile())

    def solve(density: float) -> np.ndarray:
        state = arm.state(np.full(arm.mesh.num_cells, density))
        return np.asarray(state.elastic.constraint_modes().stiffness)

    solve(0.5)  # the first one analyses the matrix for the whole run
    seconds, _, stiffness = timed(partial(solve, 1.0))
    return float(np.linalg.inv(stiffness)[1, 1]), arm.substructure.T.num_dofs, seconds


def _steps(plan: Plan) -> Steps:
    right = cache(partial(tip_compliance, plan.scene, FINEST, REFERENCE))

    def row(element: str, cells: Cells) -> Rows:
        found, dofs, seconds = tip_compliance(plan.scene, element, cells)
        yield element, f"{cells[0]} x {cells[1]}", dofs, seconds, abs(found / right()[0] - 1.0)

    for element in get_args(ElementName):
        for cells in CELLS[: 2 if plan.quick else None]:
            yield f"{element}, {cells[0]} x {cells[1]} cells", partial(row, element, cells)


DIAGRAM = Diagram(
    "mesh",
    "Finite elements: error against time",
    f"element | cells | degrees of freedom | seconds [s] | {ERROR}",
    _steps,
    "seconds [s]",
    (ERROR,),
    "element",
    f"Reference: {FINEST} elements on {REFERENCE[0]} x {REFERENCE[1]} cells. Seconds of one "
    "design of the solid arm: assembly, factorisation, constraint modes.",
)
