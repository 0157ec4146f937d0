"""Topology optimisation of flexible multibody systems on FEniCSx.

The pipeline in ten lines:

    import dolfinopt as do
    from mpi4py import MPI

    scene = do.load_scene("demos/two_arm.toml")                     # what the user asks for
    share = do.share_arms(MPI.COMM_WORLD, scene.cell_counts)        # which rank does which arm
    arms = do.build_arms(scene, share, ledger := do.Ledger())       # mesh, elements, filter
    x_phys = {k: arm.uniform(0.5) for k, arm in arms.items()}       # physical densities
    evaluation, trajectory = do.evaluate(scene, share, arms, x_phys, ledger)  # reduce, simulate
    slopes = do.gradient(scene, share, arms, trajectory, ledger)    # d objective / d x_phys
    result = do.optimize(scene)                                     # again, until it rests
"""

from __future__ import annotations

# ruff: noqa: F401 - names for type checkers; `__getattr__` imports them at run time
from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
# Raise it with every change that alters results: of the finite elements, reductions, simulation,
# gradients or optimiser, beyond rounding; and with every change of the files that are kept of
# them. What is kept under another number, or another version, is computed anew.
NUMERICS = 1

if TYPE_CHECKING:
    from dolfinopt.arm import Arm, build_arms
    from dolfinopt.coordinates import choose_coordinates
    from dolfinopt.errors import ConvergenceError, InputError
    from dolfinopt.evaluation import Evaluation, evaluate, gradient
    from dolfinopt.files import gather_views
    from dolfinopt.ledger import Ledger
    from dolfinopt.optimization import Result, optimize
    from dolfinopt.parallel import abort_together, gather_arms, share_arms
    from dolfinopt.scene import Scene, load_scene, scene_from_dict
    from dolfinopt.simulation import Trajectory, simulate

_HOME = {
    "Arm": "arm",
    "build_arms": "arm",
    "choose_coordinates": "coordinates",
    "ConvergenceError": "errors",
    "InputError": "errors",
    "Evaluation": "evaluation",
    "evaluate": "evaluation",
    "gradient": "evaluation",
    "gather_views": "files",
    "gather_arms": "parallel",
    "Ledger": "ledger",
    "Result": "optimization",
    "optimize": "optimization",
    "abort_together": "parallel",
    "share_arms": "parallel",
    "Scene": "scene",
    "load_scene": "scene",
    "scene_from_dict": "scene",
    "Trajectory": "simulation",
    "simulate": "simulation",
}

__all__ = [*sorted(_HOME), "__version__"]


def __getattr__(name: str) -> Any:
    """Import public names when they are first used: `dolfinopt --help` needs no DOLFINx."""
    if name not in _HOME:
        raise AttributeError(f"module 'dolfinopt' has no attribute {name!r}")
    return getattr(import_module(f"dolfinopt.{_HOME[name]}"), name)
