"""The objective of a scene, where it is one of the motion."""

from __future__ import annotations

from dolfinopt.dynamics.simulation import Trajectory
from dolfinopt.responses.motion import LoadCases, MotionResponse
from dolfinopt.responses.response import objective_of
from dolfinopt.scene.load import Scene


def load_cases(trajectory: Trajectory, scene: Scene) -> LoadCases:
    """Return the instants that make up the scene's objective."""
    return _of_motion(scene).load_cases(trajectory)


def objective(trajectory: Trajectory, scene: Scene, cases: LoadCases | None = None) -> float:
    """Return the scene's objective, at the instants that it chooses or at given ones."""
    response = _of_motion(scene)
    return response.value(trajectory, response.load_cases(trajectory) if cases is None else cases)


def _of_motion(scene: Scene) -> MotionResponse:
    response = objective_of(scene)
    assert isinstance(response, MotionResponse), "an objective without a motion"
    return response
