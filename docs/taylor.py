"""Write the table of exact gradients into the page on verification: `python docs/taylor.py`."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from mpi4py import MPI

import dolfinopt as do
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.optimization.gradient_check import TaylorTest, taylor_test
from dolfinopt.scene.tables.objective import Constraints
from dolfinopt.scene.tables.responses import DECLARED

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "pages" / "validation" / "verification.md"
SCENE = ["arms.cells=[24,4]", "design.filter_radius=0.05", "simulation.sample=0.01"]


def tested(name: str) -> TaylorTest:
    """Return the test of the response that a scene knows by that word."""
    scene = do.load_scene(ROOT / "demos" / "two_arm.toml", SCENE)
    objective = scene.objective.model_copy(update={"kind": name, "gradient": "exact"})
    scene = scene.model_copy(update={"objective": objective, "constraints": Constraints()})
    profile = do.Profile()
    partition = do.partition_arms(MPI.COMM_WORLD, scene.cell_counts)
    arms = do.build_arms(scene, partition, profile)
    x = {}
    for k, arm in arms.items():
        along, across = arm.mesh.centroid.T / arm.mesh.outboard_point[0]
        x[k] = 0.5 + 0.3 * np.sin(7.0 * along + k) + 2.0 * across
    return taylor_test(Evaluator(scene, partition, arms, profile), x)


def row(name: str, test: TaylorTest) -> str:
    """Return a row of the table."""
    rates = [one.rate for one in test.rows]
    low, high = (f"{value:.2f}" for value in (min(rates), max(rates)))
    shown = "linear" if np.isinf(rates).all() else low if low == high else f"{low} to {high}"
    angle = f"{test.angle:.1f} degrees" if np.isfinite(test.angle) else ""
    return f"| `{name}` | {shown} | {angle} |"


def main() -> None:
    """Replace the rows of the table."""
    head = "| response | rates | frozen loads off by |\n|---|---|---|\n"
    rows = "".join(f"{row(name, tested(name))}\n" for name in DECLARED if DECLARED[name].objective)
    text = PAGE.read_text(encoding="utf-8")
    pattern = re.escape(head) + r"(?:(?:\|.*|TAYLOR)\n)*"
    PAGE.write_text(re.sub(pattern, lambda _: head + rows, text), encoding="utf-8")


if __name__ == "__main__":
    main()
