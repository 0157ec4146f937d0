"""The same motion in Exudyn: solid arms as geometrically exact planar beams.

Source: Exudyn, https://github.com/jgerstmayr/EXUDYN, version 1.13; doi:10.1007/s11044-023-09937-1.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.motion import rigid_motion
from dolfinopt.scene.load import Scene

SPECTRAL_RADIUS = 0.8  # of generalised-alpha at infinite frequency, also the scenes' default
# Of the residuals, N and m: Exudyn's 1e-10, and up to 1e-6, is below what the axial stiffness of
# short beams, times the rounding of places of 1 m, leaves.
RESIDUAL = 1e-5


def exudyn_available() -> bool:
    """Return whether Exudyn can be imported."""
    try:
        import exudyn  # noqa: F401
    except ImportError:
        return False
    return True


def exudyn_tip(scene: Scene, elements: int, steps: int) -> np.ndarray:
    """Return instants (s) and the end-effector's place (m), (steps + 1, 3), of the solid arms.

    The cart and the joints' angles follow the scene's rigid motion, by constraints on the nodes'
    coordinates; the angle of an arm counts from the end of the one before, bent as it is.

    Args:
        scene: rectangular arms, stiffness-proportional damping, no gravity.
        elements: beams an arm.
        steps: of implicit generalised-alpha over the horizon.

    Raises:
        ConvergenceError: Exudyn gave up.
    """
    import exudyn

    horizon = scene.motion.horizon
    system = exudyn.SystemContainer().AddSystem()
    sensor = _tip_sensor(system, _build(system, scene, elements, steps))
    system.Assemble()
    options: Any = exudyn.SimulationSettings()
    options.timeIntegration.numberOfSteps = steps
    options.timeIntegration.endTime = horizon
    options.timeIntegration.generalizedAlpha.spectralRadius = SPECTRAL_RADIUS
    options.timeIntegration.verboseMode = 0
    options.timeIntegration.adaptiveStep = False  # the steps are what is compared
    options.timeIntegration.newton.useModifiedNewton = True
    options.timeIntegration.newton.absoluteTolerance = RESIDUAL
    options.linearSolverType = exudyn.LinearSolverType.EXUdense
    options.solutionSettings.writeSolutionToFile = False
    options.solutionSettings.sensorsWritePeriod = 0.5 * horizon / steps
    options.displayStatistics = False
    options.displayComputationTime = False
    try:
        done = system.SolveDynamic(options)
    except Exception as error:  # Exudyn's own, of several types
        raise ConvergenceError(f"Exudyn: {error}") from None
    if done is False:
        raise ConvergenceError("Exudyn gave up")
    return np.asarray(system.GetSensorStoredData(sensor))[:, :3]


def _build(system: Any, scene: Scene, elements: int, steps: int) -> int:
    """Add beams, payload and constraints; return the end-effector's node."""
    import exudyn.itemInterface as items

    horizon = scene.motion.horizon
    table = rigid_motion(np.linspace(0.0, horizon, steps + 1), scene).q
    start = table[0]
    drive = partial(_drive, scene, table)
    place, angle = np.array([start[0], scene.motion.joint_height]), 0.0
    ground = system.AddNode(items.NodePointGround())
    fixed = system.AddMarker(items.MarkerNodeCoordinate(nodeNumber=ground, coordinate=0))
    before: int | None = None
    for index, arm in enumerate(scene.arms):
        angle += float(start[1 + index])
        along = np.array([np.cos(angle), np.sin(angle)]) * arm.length / elements
        nodes = [
            system.AddNode(
                items.NodeRigidBody2D(referenceCoordinates=[*(place + i * along), angle])
            )
            for i in range(elements + 1)
        ]
        section = _section(scene, index)
        for first, second in pairwise(nodes):
            system.AddObject(
                items.ObjectBeamGeometricallyExact2D(
                    nodeNumbers=[first, second],
                    length=arm.length / elements,
                    includeReferenceRotations=False,
                    **section,
                )
            )
        drives = drive(0) if index == 0 else 0, 0, drive(1 + index)
        for coordinate, offset in enumerate(drives):
            own = items.MarkerNodeCoordinate(nodeNumber=nodes[0], coordinate=coordinate)
            other = fixed
            if before is not None:
                there = items.MarkerNodeCoordinate(nodeNumber=before, coordinate=coordinate)
                other = system.AddMarker(there)
            system.AddObject(
                items.ObjectConnectorCoordinate(
                    markerNumbers=[other, system.AddMarker(own)],
                    offsetUserFunction=offset,
                )
            )
        before, place = nodes[-1], place + elements * along
    assert before is not None
    mass = items.ObjectRigidBody2D(
        mass=scene.payload.mass, inertia=scene.payload.inertia, nodeNumber=before
    )
    system.AddObject(mass)
    return before


def _section(scene: Scene, index: int) -> dict[str, float]:
    """Return the keywords of a beam of the solid arm."""
    arm, solid = scene.arms[index], scene.material_of(index)
    assert arm.height is not None
    area, second = arm.height * arm.thickness, arm.thickness * arm.height**3 / 12.0
    nu = solid.poisson_ratio
    shear = 10.0 * (1.0 + nu) / (12.0 + 11.0 * nu)  # Cowper (1966), doi:10.1115/1.3625046
    stiffness = {
        "bending": solid.young_modulus * second,
        "axial": solid.young_modulus * area,
        "shear": shear * solid.young_modulus / (2.0 * (1.0 + nu)) * area,
    }
    damping = scene.damping.stiffness_proportional
    return {
        "massPerLength": solid.density * area,
        "crossSectionInertia": solid.density * second,
        **{f"{kind}Stiffness": value for kind, value in stiffness.items()},
        **{f"{kind}Damping": damping * value for kind, value in stiffness.items()},
    }


def _drive(scene: Scene, table: np.ndarray, column: int) -> Callable[..., float]:
    """Return the prescribed change of a rigid coordinate, as Exudyn calls it.

    Args:
        scene: whose motion it is.
        table: (steps + 1, 1 + arms) rigid coordinates at the steps' ends: looked up there, as the
            motion's own formulas would cost more than Exudyn's steps.
        column: which coordinate.
    """
    steps = len(table) - 1
    known = {k: float(value) for k, value in enumerate(table[:, column] - table[0, column])}

    def offset(system: Any, t: float, item: int, given: float) -> float:
        place = t / scene.motion.horizon * steps
        near = round(place)
        if abs(place - near) < 1e-9:
            return known[near]
        return float(rigid_motion(np.array([t]), scene).q[0, column] - table[0, column])

    return offset


def _tip_sensor(system: Any, node: int) -> int:
    import exudyn
    import exudyn.itemInterface as items

    kind = exudyn.OutputVariableType.Position
    return int(
        system.AddSensor(
            items.SensorNode(
                nodeNumber=node, outputVariableType=kind, storeInternal=True, writeToFile=False
            )
        )
    )
