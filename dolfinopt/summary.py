"""summary.json: what a run found, what it cost, and what it was made with."""

from __future__ import annotations

import resource
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinopt.arm import Arm
from dolfinopt.evaluation import Evaluation
from dolfinopt.files import versions
from dolfinopt.ledger import Counts, Ledger
from dolfinopt.parallel import ArmShare, gather_bodies
from dolfinopt.scene import Scene


def summarise(
    scene: Scene,
    share: ArmShare,
    arms: Mapping[int, Arm],
    x_phys: Mapping[int, np.ndarray],
    evaluation: Evaluation,
    ledger: Ledger,
    *,
    wall: float,
    iterations: int = 0,
    converged: bool = True,
    stop_reason: str = "simulated",
) -> dict[str, Any]:
    """Return the content of summary.json on the root, an empty dict elsewhere (collective).

    Args:
        scene, share, arms, x_phys, evaluation: of the design the summary is about.
        ledger: this rank's.
        wall: seconds since the command began, s.
        iterations, converged, stop_reason: of the optimisation.
    """
    volumes = gather_bodies(share, {k: a.volume_fraction(x_phys[k]) for k, a in arms.items()})
    areas = gather_bodies(share, {k: float(_total_area(a)) for k, a in arms.items()})
    greys = gather_bodies(share, {k: a.grayness(x_phys[k]) for k, a in arms.items()})
    seconds = _slowest(share.world, ledger.seconds)
    counts = share.world.gather(ledger.counts if share.leads else Counts(), root=0)
    memory = share.world.gather(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0, root=0)
    if counts is None or memory is None:
        return {}
    return {
        "name": scene.name,
        "objective": evaluation.objective,
        "compliance": evaluation.compliance,
        "max_deviation": evaluation.max_deviation,
        "max_deviation_time": evaluation.max_deviation_time,
        "grayness": float(np.average(greys, weights=areas)),
        "volume_fraction": {
            arm.name: value for arm, value in zip(scene.arms, volumes, strict=True)
        },
        "first_frequency": {
            arm.name: value
            for arm, value in zip(scene.arms, evaluation.first_frequencies, strict=True)
        },
        "simulation_error_estimate": evaluation.error,
        "iterations": iterations,
        "converged": converged,
        "stop_reason": stop_reason,
        "seconds": {**seconds, "total": wall},
        "counts": asdict(sum(counts, Counts())),
        "peak_memory_mb": max(memory),
        "ranks": share.world.size,
        "versions": versions(),
        "scene": scene.to_dict(),
    }


def _total_area(arm: Arm) -> float:
    return arm.mesh.comm.allreduce(arm.mesh.area.sum())


def _slowest(world: MPI.Comm, seconds: Mapping[str, float]) -> dict[str, float]:
    """Return the largest time of any rank by phase."""
    slowest: dict[str, float] = {}
    for one in world.allgather(dict(seconds)):
        for phase, value in one.items():
            slowest[phase] = max(slowest.get(phase, 0.0), value)
    return slowest
