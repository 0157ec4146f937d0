"""The forearm of a robot that is sold, as a thin-walled link: lighter than the tube it could be.

Universal Robots' UR10, from the URDF file in the wheel of example-robot-data (131 MB,
`pip install --no-deps example-robot-data`), moves 10 kg from a conveyor to a pallet. Its forearm
becomes a hollow link of aluminium with the extents of its own geometry, 121 x 137 mm; a straight
tube of these extents with walls of 2.858 mm deviates and turns as far as the design may. Takes half
a minute, on any number of ranks:

    python demos/demo_ur10_forearm.py
"""

from importlib import metadata
from pathlib import Path
from typing import Any

from mpi4py import MPI

import dolfinopt as do
from dolfinopt.cli import commands
from dolfinopt.model import SimulationResult

HERE = Path(__file__).parent
LINK, FILE = "forearm_link", "ur10_robot.urdf"
WALL = 0.002858  # m
CELLS = [20, 5, 7]  # along, over the height, over the thickness
# What lies within a limit by the optimiser's tolerance, a thousandth, lies within the tube's.
SPARE = 0.999

Row = dict[str, Any]


def robot_file() -> Path:
    """Return the robot's URDF file in the wheel.

    Raises:
        metadata.PackageNotFoundError: example-robot-data is not installed.
    """
    files = metadata.files("example-robot-data") or []
    return next(Path(str(one.locate())) for one in files if one.name == FILE)


def main(folder: Path = Path("results/demo_ur10_forearm"), iterations: int = 40) -> list[Row]:
    """Import the robot, simulate the tube, optimise within what it does; print on the root."""
    scene = imported(folder)
    keys = {"cells": CELLS, "hollow": "true", "wall": WALL, "min_wall": 0.001, "max_wall": 0.008,
            "passive": 0.0}  # fmt: skip
    link = [f"arms.{LINK}.{key}={value}" for key, value in keys.items()] + ["payload.mass=10"]
    limits = ["constraints.deviation=1", "constraints.orientation=1"]  # none that binds
    tube = do.Model(scene, *link, *limits).simulate()
    [turn] = tube.evaluation.values_of("orientation")
    limits = [f"constraints.deviation={SPARE * tube.max_deviation}",
              f"constraints.orientation={SPARE * turn}"]  # fmt: skip
    told = [*link, *limits, "objective.kind=mass", f"optimizer.max_iterations={iterations}"]
    design = do.Model(scene, *told).optimize()
    if MPI.COMM_WORLD.rank != 0:
        return []
    rows = [figures("tube, wall of 2.858 mm", tube), figures("hollow link", design)]
    for row in rows:
        print(", ".join(f"{key} {row[key]:.4g}" if key != "link" else row[key] for key in row))
    return rows


def imported(folder: Path) -> Path:
    """Return the scene of the robot with its forearm to be designed (collective)."""
    scene = folder / "robot" / f"{Path(FILE).stem}.toml"
    motion = folder / "motion.csv"
    if MPI.COMM_WORLD.rank == 0:
        folder.mkdir(parents=True, exist_ok=True)
        _, names, *rows = (HERE / "robot_motion.csv").read_text(encoding="utf-8").splitlines()
        joints = [f"{name.strip()}_joint" for name in names.split(",")[1:]]  # the UR10's names
        motion.write_text("\n".join([",".join(["t", *joints]), *rows]) + "\n", encoding="utf-8")
    MPI.COMM_WORLD.barrier()
    told = ["import", robot_file(), motion, LINK, "--boxes", "--out", scene.parent]
    commands.main([str(word) for word in told], standalone_mode=False, obj=MPI.COMM_WORLD)
    if MPI.COMM_WORLD.rank == 0:
        # A wall has no density to begin with, and its volume is what is minimised.
        lines = scene.read_text(encoding="utf-8").splitlines(keepends=True)
        kept = [line for line in lines if not line.startswith(("volume_fraction", "initial"))]
        scene.write_text("".join(kept), encoding="utf-8")
    MPI.COMM_WORLD.barrier()
    return scene


def figures(name: str, result: SimulationResult) -> Row:
    """Return what a link weighs, and by how much the tool is off."""
    trajectory = result.trajectory
    assert trajectory is not None
    place = [arm.name for arm in result.scene.arms].index(LINK)
    [turn] = result.evaluation.values_of("orientation")
    return {
        "link": name,
        "mass [kg]": float(trajectory.mechanism.bodies[place].mass),
        "deviation [um]": 1e6 * result.max_deviation,
        "orientation [mrad]": 1e3 * turn,
    }


if __name__ == "__main__":
    main()
