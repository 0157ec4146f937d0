"""Topology optimisation of flexible multibody systems on FEniCSx.

    from dolfinopt import Model

    model = Model("demos/two_arm.toml", "payload.mass=4")
    result = model.optimize()
    result.plot().savefig("design.png")

The same step by step, with ranks and profile in hand:

    import dolfinopt as do
    from mpi4py import MPI

    scene = do.load_scene("demos/two_arm.toml")  # what the user asks for
    partition = do.partition_arms(MPI.COMM_WORLD, scene.cell_counts)  # which rank does which arm
    arms = do.build_arms(scene, partition, profile := do.Profile())  # mesh, elements, filter
    x_phys = {k: arm.uniform(0.5) for k, arm in arms.items()}  # physical densities
    # Reduce and simulate; d objective / d x_phys.
    evaluation, trajectory = do.evaluate(scene, partition, arms, x_phys, profile)
    gradient = do.gradient(scene, partition, arms, trajectory, profile)
    result = do.optimize(scene)  # again, until it converges
"""

from __future__ import annotations

# ruff: noqa: F401 - names for type checkers; `__getattr__` imports them at run time
from importlib import import_module
from typing import TYPE_CHECKING, Any

from dolfinopt.version import __version__

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm, build_arms
    from dolfinopt.dynamics.build import Trajectory, simulate
    from dolfinopt.errors import ConvergenceError, InputError
    from dolfinopt.loading import load_scene
    from dolfinopt.model import Model, OptimizationResult, SimulationResult
    from dolfinopt.optimization.result import Result
    from dolfinopt.output.design import gather_views
    from dolfinopt.output.run_folder import optimize
    from dolfinopt.parallel import abort_together, gather_arms, partition_arms
    from dolfinopt.profiling import Profile
    from dolfinopt.responses.evaluation import Evaluation, evaluate, gradient
    from dolfinopt.responses.order_selection import choose_coordinates
    from dolfinopt.scene.load import Scene, scene_from_dict

_HOME = {
    "Arm": "arms.arm",
    "build_arms": "arms.arm",
    "choose_coordinates": "responses.order_selection",
    "ConvergenceError": "errors",
    "InputError": "errors",
    "Evaluation": "responses.evaluation",
    "evaluate": "responses.evaluation",
    "gradient": "responses.evaluation",
    "gather_views": "output.design",
    "gather_arms": "parallel",
    "Profile": "profiling",
    "Model": "model",
    "OptimizationResult": "model",
    "SimulationResult": "model",
    "Result": "optimization.result",
    "optimize": "output.run_folder",
    "abort_together": "parallel",
    "partition_arms": "parallel",
    "Scene": "scene.load",
    "load_scene": "loading",
    "scene_from_dict": "scene.load",
    "Trajectory": "dynamics.build",
    "simulate": "dynamics.build",
}

__all__ = [*sorted(_HOME), "__version__"]


def __getattr__(name: str) -> Any:
    """Import public names when they are first used: `dolfinopt --help` needs no DOLFINx."""
    if name not in _HOME:
        raise AttributeError(f"module 'dolfinopt' has no attribute {name!r}")
    return getattr(import_module(f"dolfinopt.{_HOME[name]}"), name)
