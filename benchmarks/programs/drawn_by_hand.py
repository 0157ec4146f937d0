"""Straight members drawn by hand in an arm's cells, which optimised designs are to beat."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from dolfinopt.arms.arm import Arm
from dolfinopt.bench.iterations import posed, problems
from dolfinopt.bench.measure import arms_of, timed
from dolfinopt.bench.panel import Rows
from dolfinopt.errors import ConvergenceError
from dolfinopt.optimization.assessment import across, filled
from dolfinopt.parallel import partition_arms
from dolfinopt.profiling import Profile
from dolfinopt.responses.constraints import EXCESS, limits_of
from dolfinopt.responses.evaluation import evaluate
from dolfinopt.responses.response import objective_of

STRIDE, HALVINGS = 0.05, 6  # of their sizes, of the height; of the stride


def drawn(arm: Arm, kind: str, size: float) -> np.ndarray:
    """Return the densities (n_cells,) of a straight solid member within an arm's box of cells.

    A "bar" is the arm's section times `size`, from 0 to 1; a "tube" has walls of `size` half
    heights, in the plane flanges; a "truss" such flanges, and as thick diagonals of 45 degrees.
    """
    off = across(arm)
    away = np.abs(off).max(axis=1)
    if kind != "truss":
        return filled(arm, size - away if kind == "bar" else size - (1.0 - away))
    phase = np.mod(arm.mesh.centroid[:, 0] / arm.scene.arms[arm.places[0]].height, 2.0)
    diagonal = 1.0 - 2.0 * np.abs(phase - 1.0)
    flanges = size - (1.0 - np.abs(off[:, 0]))
    braces = 0.5 * size - np.abs(off[:, 0] - diagonal) / np.sqrt(2.0)
    return filled(arm, np.maximum(flanges, braces))


def drawn_by_hand(name: str, kind: str) -> Rows:
    """Measure the best straight member of a kind that keeps a problem's limits, all arms alike."""
    scene = posed(problems()[name], "half", 0)
    arms, partition = arms_of(scene), partition_arms(MPI.COMM_SELF, scene.cell_counts)
    sign = -1.0 if objective_of(scene).turned else 1.0

    def judged(size: float) -> tuple[bool, float, float, float]:
        """Return whether limits are broken, what is minimised, the excess, and the size."""
        x = {k: drawn(arm, kind, size) for k, arm in arms.items()}
        if not scene.design.projection:  # grey at the edges, as what is optimised
            x = {k: arms[k].physical(densities) for k, densities in x.items()}
        try:
            result, _ = evaluate(scene, partition, arms, x, Profile(), simulated=False)
        except ConvergenceError:
            return True, np.inf, np.inf, size
        excess = max((limit.excess for limit in limits_of(scene, result)), default=0.0)
        return excess > EXCESS, sign * result.objective, excess, size

    def best() -> tuple[bool, float, float, float]:
        result = min(map(judged, np.linspace(STRIDE, 1.0, round(1.0 / STRIDE))))
        for k in range(1, HALVINGS + 1):
            near = (result[3] + side * STRIDE / 2**k for side in (-1.0, 1.0))
            result = min(result, *(judged(size) for size in near if 0.0 < size <= 1.0))
        return result

    seconds, _, (_, value, excess, size) = timed(best)
    words = f"{100.0 * size:.1f} % of the height"
    yield name, kind, 0, 0, 0, sign * value, excess, 0, seconds, words
