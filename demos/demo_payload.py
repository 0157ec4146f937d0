"""What freezing the loads costs: light payloads, where the arms' own inertia is the load.

The ESL gradient holds the equivalent static loads although material that is removed takes its
inertia load with it. Takes some minutes, on any number of ranks:

    mpirun -n 2 python demos/demo_payload.py
"""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator, PercentFormatter
from mpi4py import MPI

import dolfinopt as do

HERE = Path(__file__).parent
PAYLOADS = (6.0, 2.0, 1.0, 0.5, 0.2)  # kg
ITERATIONS = 200
COLUMNS = {
    "payload [kg]": "g",
    "gradient": "s",
    "compliance [N m]": ".5g",
    "max deviation [mm]": ".3f",
    "material [-]": ".3f",
    "iterations": "d",
}
LOOKS = {"esl": ("#d95f02", "s--"), "exact": ("#1f5a99", "o-")}

Row = dict[str, Any]


def main(
    folder: Path = Path("results/demo_payload"),
    cells: tuple[int, int] = (200, 12),
    payloads: Sequence[float] = PAYLOADS,
    iterations: int = ITERATIONS,
) -> list[Row]:
    """Optimise for every payload with both gradients; print, write and draw on the root."""
    world, rows = MPI.COMM_WORLD, []
    if world.rank == 0:
        print("  ".join(COLUMNS), flush=True)
    for payload in payloads:
        for kind in LOOKS:
            overrides = [
                f"payload.mass={payload}",
                f"objective.gradient={kind}",
                f"arms.cells=[{cells[0]}, {cells[1]}]",
                f"optimizer.max_iterations={iterations}",
            ]
            result = do.optimize(do.load_scene(HERE / "two_arm.toml", overrides), world=world)
            mine = {k: arm.volume_fraction(result.x_phys[k]) for k, arm in result.arms.items()}
            fractions = list(do.gather_arms(result.partition, mine).values())
            if world.rank == 0:
                end = result.evaluation
                values = (payload, kind, end.compliance, 1e3 * end.max_deviation)
                values = (*values, sum(fractions) / len(fractions), result.iterations)
                rows.append(dict(zip(COLUMNS, values, strict=True)))
                print("  ".join(shown(rows[-1]).values()), flush=True)
    if world.rank == 0:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "payload.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(rows)
        draw(folder / "payload.png", rows)
        print(f"table and picture in {folder}")
    return rows


def shown(row: Row) -> dict[str, str]:
    """Return the row's values as they are printed, below their names."""
    return {name: f"{row[name]:>{len(name)}{form}}" for name, form in COLUMNS.items()}


def draw(path: Path, rows: Sequence[Row]) -> None:
    """Draw compliance, the exact gradient's relative to the ESL's, and material by payload."""
    both = {kind: [row for row in rows if row["gradient"] == kind] for kind in LOOKS}
    payloads = [row["payload [kg]"] for row in both["esl"]]
    frozen = [row["compliance [N m]"] for row in both["esl"]]
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    above, below = figure.subplots(2, sharex=True)
    for kind, (colour, line) in LOOKS.items():
        label = f"{'exact' if kind == 'exact' else 'ESL'} gradient"
        values = [row["compliance [N m]"] for row in both[kind]]
        relative = [a / b for a, b in zip(values, frozen, strict=True)]
        above.plot(payloads, relative, line, color=colour, label=label)
        material = [row["material [-]"] for row in both[kind]]
        below.plot(payloads, material, line, color=colour, label=label)
    above.set_ylabel("compliance relative to\nthat with the ESL gradient")
    below.set_ylabel("material used,\nshare of the arms' volume")
    below.set_xlabel("payload [kg]")
    below.set_xscale("log")
    below.set_xticks(payloads, [f"{payload:g}" for payload in payloads])
    below.xaxis.set_minor_locator(NullLocator())
    for axes in (above, below):
        axes.set_ylim(0.0, 1.05 * axes.dataLim.ymax)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        axes.grid(alpha=0.3)
    above.legend(frameon=False, loc="lower right")
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    with do.abort_together(MPI.COMM_WORLD):
        main()
