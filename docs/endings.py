"""Whether runs end alike on other processors and ranks: a table of their iterations, in Markdown.

    python docs/endings.py [--coarse] [SCENE ...]

OpenBLAS chooses its kernel by the processor, and sums round otherwise with each. Every scene is
optimised with the kernels that this processor can run, and on one, two and three ranks; with
--coarse on meshes, and to projections, that take a minute instead of an hour.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from dolfinopt.bench.measure import mpirun

DEMOS = Path(__file__).parent.parent / "demos"
SHORT = ["design.sharpness=8", "design.continuation=10"]
COARSE = {
    "two_arm.toml": ["arms.cells=[100,6]", "design.filter_radius=0.02"],
    "lightest_two_arm.toml": ["arms.cells=[80,6]", "design.filter_radius=0.025", *SHORT],
    "spatial_arm.toml": ["arms.cells=[30,4,3]", "design.filter_radius=0.03"],
}
KERNELS = {"Haswell": "avx2", "SkylakeX": "avx512f", "Zen": "avx2", "Nehalem": "sse4_2"}
RANKS = 1, 2, 3


def kernels() -> list[str]:
    """Return the kernels whose instructions this processor has."""
    flags = Path("/proc/cpuinfo").read_text().split()
    return [name for name, flag in KERNELS.items() if flag in flags]


def ending(scene: str, settings: list[str], kernel: str, ranks: int) -> dict[str, Any]:
    """Return the summary of an optimisation with a kernel, on so many ranks."""
    command = [sys.executable, "-m", "dolfinopt", "optimize", scene, "--no-plots"]
    command += [word for one in settings for word in ("--set", one)] + ["--out"]
    if ranks > 1:
        command = [str(mpirun()), "-n", str(ranks), *command]
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "OPENBLAS_CORETYPE": kernel, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            [*command, folder, "--overwrite"], env=environment, capture_output=True, text=True
        )
        summary = Path(folder) / "summary.json"
        if not summary.is_file():
            raise SystemExit(f"{scene}, {kernel}, {ranks} ranks: {done.stderr.strip()}")
        found: dict[str, Any] = json.loads(summary.read_text("utf-8"))
        return found


def main() -> None:
    """Print a line a run."""
    print("| scene | kernel | ranks | iterations | ending | objective |\n|---|---|---|---|---|---|")
    known, asked = kernels(), sys.argv[1:]
    coarse = "--coarse" in asked
    runs = [(kernel, 1) for kernel in known] + [(known[0], ranks) for ranks in RANKS[1:]]
    for name in [one for one in asked if one != "--coarse"] or COARSE:
        scene = str(DEMOS / name) if (DEMOS / name).is_file() else name
        for kernel, ranks in runs:
            one = ending(scene, COARSE.get(name, []) if coarse else [], kernel, ranks)
            words = one["iterations"], one["stop_code"], f"{one['objective']:.7g}"
            print("|", " | ".join(map(str, [name, kernel, ranks, *words])), "|", flush=True)


if __name__ == "__main__":
    main()
