"""What the links of a robot are worth beside its gears and bearings, before and after optimising.

`geared_robot.toml`: the budget of the largest deflection of links with walls of 4 mm, of the
lightest links that deflect by a tenth more, and of both where the motors turn ahead of their joints
by what the gears give. Takes a minute, on any number of ranks:

    python demos/demo_geared_robot.py
"""

import csv
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from mpi4py import MPI

import dolfinopt as do
from dolfinopt.model import SimulationResult

HERE = Path(__file__).parent
SCENE = HERE / "geared_robot.toml"
WOUND = "control.feed_forward=elastic"
COLOURS = {
    "links": "#1f5a99",
    "bearings": "#8c96a3",
    "gears": "#d95f02",
    "control error": "#c9b458",
}

Row = dict[str, Any]


def main(folder: Path = Path("results/demo_geared_robot"), iterations: int = 30) -> list[Row]:
    """Simulate and optimise, write table and picture; return the rows on the root."""
    first = do.Model(SCENE)
    before = first.simulate()
    after = do.Model(SCENE, f"optimizer.max_iterations={iterations}").optimize()
    wound = do.Model(SCENE, WOUND)
    results = {
        "walls of 4 mm": before,
        "lightest links": after,
        "walls of 4 mm, motors ahead": wound.simulate(),
        "lightest links, motors ahead": wound.simulate(after.design),
    }
    if MPI.COMM_WORLD.rank != 0:
        return []
    rows = [figures(name, result) for name, result in results.items()]
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "budget.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    draw(folder / "budget.png", rows)
    for row in rows:
        print(", ".join(f"{key} {x:.4g}" if key != "machine" else x for key, x in row.items()))
    print(f"table and picture in {folder}")
    return rows


def figures(name: str, result: SimulationResult) -> Row:
    """Return mass of the links, largest deflection and what it consists of, mm."""
    budget, trajectory = result.budget, result.trajectory
    assert budget is not None and trajectory is not None
    links = [k for k, arm in enumerate(result.scene.arms) if arm.designed]
    row: Row = {
        "machine": name,
        "mass of links [kg]": sum(trajectory.mechanism.bodies[k].mass for k in links),
        "deflection [mm]": 1e3 * budget.deviation,
    }
    return row | {f"{kind} [mm]": 1e3 * x * budget.linear for kind, x in budget.shares.items()}


def draw(path: Path, rows: list[Row]) -> None:
    """Draw a bar for every machine, its pieces what the parts contribute."""
    figure = Figure(figsize=(8.0, 3.2), layout="constrained")
    axes = figure.subplots()
    for place, row in enumerate(rows):
        left = 0.0
        for kind, colour in COLOURS.items():
            width = row[f"{kind} [mm]"]
            label = kind if place == 0 else None
            axes.barh(place, width, left=left, color=colour, height=0.6, label=label)
            if abs(width) > 0.4:
                axes.text(left + 0.5 * width, place, f"{width:.1f}", va="center", ha="center",
                          color="white", fontsize=9)  # fmt: skip
            left += width
        mass = row["mass of links [kg]"]
        axes.text(left + 0.08, place, f"links of {mass:.2f} kg", va="center", fontsize=9)
    axes.set_yticks(range(len(rows)), [row["machine"] for row in rows])
    axes.invert_yaxis()
    axes.set_xlim(right=1.22 * max(row["deflection [mm]"] for row in rows))
    axes.set_xlabel("largest deflection of the tool [mm]")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=4, frameon=False)
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    with do.abort_together(MPI.COMM_WORLD):
        main()
