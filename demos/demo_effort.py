"""What stiffness costs the drives: the least effort at the same accuracy.

Arms of least compliance use all the material they may, and every drive carries it along. Here the
drives' effort, the root mean square of their forces, is minimised instead, while the end-effector
may deviate as far as it does with the arms of least compliance. Takes some minutes, on any number
of ranks:

    mpirun -n 2 python demos/demo_effort.py
"""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from mpi4py import MPI

import dolfinopt as do
from dolfinopt.model import SimulationResult

HERE = Path(__file__).parent
PAYLOAD = 0.5  # kg: light, so that the arms' own mass is what the drives feel
DRIVES = ("cart [N]", "shoulder [N m]", "elbow [N m]")
LOOKS = {"least compliance": ("#d95f02", "--"), "least effort": ("#1f5a99", "-")}

Row = dict[str, Any]


def main(
    folder: Path = Path("results/demo_effort"),
    cells: tuple[int, int] = (200, 12),
    iterations: int = 100,
) -> list[Row]:
    """Optimise for stiffness, then for effort; print, write and draw on the root."""
    common = [
        f"payload.mass={PAYLOAD}",
        f"arms.cells=[{cells[0]}, {cells[1]}]",
        f"optimizer.max_iterations={iterations}",
    ]
    stiff = do.Model(HERE / "two_arm.toml", *common).optimize()
    kept = f"constraints.deviation={stiff.max_deviation}"
    lazy = do.Model(HERE / "two_arm.toml", *common, "objective.kind=effort", kept).optimize()
    results = dict(zip(LOOKS, (stiff, lazy), strict=True))
    if MPI.COMM_WORLD.rank != 0:
        return []
    rows = [figures(name, result) for name, result in results.items()]
    for row in rows:
        print(", ".join(f"{key} {row[key]:.4g}" if key != "design" else row[key] for key in row))
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "effort.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    draw(folder / "effort.png", results)
    print(f"table and picture in {folder}")
    return rows


def figures(name: str, result: SimulationResult) -> Row:
    """Return what a design does, and what it takes of the drives."""
    trajectory = result.trajectory
    assert trajectory is not None
    peak, rms = trajectory.drives
    row: Row = {
        "design": name,
        "effort": float(np.linalg.norm(rms)),
        "deviation [mm]": 1e3 * result.max_deviation,
        "mass [kg]": float(sum(body.mass for body in trajectory.mechanism.bodies)),
    }
    return row | {f"largest {one}": float(p) for one, p in zip(DRIVES, peak, strict=True)}


def draw(path: Path, results: dict[str, SimulationResult]) -> None:
    """Draw both designs, and the forces of their drives over time."""
    figure = Figure(figsize=(9.0, 8.0), layout="constrained")
    grid = figure.subplot_mosaic([["least compliance", "least effort"], *[[k, k] for k in DRIVES]])
    for name, result in results.items():
        draw_arms(grid[name], result)
        grid[name].set_title(name)
        trajectory = result.trajectory
        assert trajectory is not None
        colour, line = LOOKS[name]
        for drive, force in zip(DRIVES, trajectory.joint_forces.T, strict=True):
            grid[drive].plot(trajectory.t, force, line, color=colour, label=name)
    for drive in DRIVES:
        grid[drive].set_ylabel(drive)
        grid[drive].grid(alpha=0.3)
        grid[drive].margins(x=0.0)
    grid[DRIVES[0]].legend(frameon=False, loc="upper right")
    grid[DRIVES[-1]].set_xlabel("time [s]")
    figure.savefig(path, dpi=120)


def draw_arms(axes: Any, result: SimulationResult) -> None:
    """Draw the arms below each other, stretched across, dark where they are solid."""
    from matplotlib.collections import PolyCollection

    drop = 0.0
    for view in result.views:
        corners: Sequence[np.ndarray] = view.corners - [0.0, drop]
        cells = PolyCollection(corners, array=view.density, cmap="Greys", clim=(0.0, 1.0))
        axes.add_collection(cells)
        axes.text(0.0, 0.04 - drop, view.name, fontsize=9)
        drop += 0.12
    axes.autoscale_view()
    axes.axis("off")


if __name__ == "__main__":
    with do.abort_together(MPI.COMM_WORLD):
        main()
