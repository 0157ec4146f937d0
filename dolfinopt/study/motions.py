"""What joints can do about arms that bend: one machine on several motions, side by side.

The joints on the rigid machine's path, the same command through input shapers, joints with
feed-forward, and feed-forward with arms that were designed for it. Every motion is simulated with
the machine that it was made for, and with machines that differ from it: payload, stiffness,
damping.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from mpi4py import MPI

from dolfinopt.arms.arm import chain_of
from dolfinopt.disk import make_folder, write_table
from dolfinopt.dynamics.build import build_system, desired_motion
from dolfinopt.motion.input_shaper import InputShaper, ShaperKind, input_shaper
from dolfinopt.output.design import arms_with_design
from dolfinopt.output.feed_forward import finer_deviation, with_feed_forward
from dolfinopt.output.trajectory import drive_units
from dolfinopt.scene.load import Scene, scene_from_dict
from dolfinopt.study.cases import Case, Outcome, Steps
from dolfinopt.study.studies import (
    DEVIATION,
    Report,
    Rows,
    deviation_panels,
    reported,
    single_design,
    with_failures,
)
from dolfinopt.study.tables import LineFigure, Study, Table

NAME = "motions"  # of the study's files, and of the folder of the shaped joints
LONGER, FINER = "longer by [s]", "finer model [mm]"
RIGID, FORWARD = "joints on the rigid path", "feed-forward"
DESIGNED = "feed-forward, arms designed for it"
SHAPERS: dict[ShaperKind, str] = {
    "zv": "input shaper ZV",
    "zvd": "input shaper ZVD",
    "ei": "input shaper EI",
}
# Keys of [motion] that a table of joints keeps.
KEPT = ("base", "cart_mass", "joint_height", "gravity", "initial_joints")
ROWS = 2000  # of a table of shaped joints
TEN_PERCENT, FIVE_PERCENT = 1.1, 0.95


def study_motions(scene: Scene, designs: Sequence[Path], folder: Path) -> Steps[Study]:
    """Return the steps of comparing motions of a scene's machine.

    Args:
        scene: whose arms move.
        designs: design.npz of the arms; none: they are optimised, for the rigid path and again for
            feed-forward.
        folder: of the study, for tables of shaped joints.

    Raises:
        InputError: the scene's motion cannot be corrected or shaped; nothing was computed.
    """
    _, design = single_design(scene, designs, NAME)
    forward = with_feed_forward(scene, "tip")  # refused where the motion cannot be corrected
    files: list[Any] = [design]
    if isinstance(design, Case):
        searched = [design, Case(forward, "optimize", label=DESIGNED)]
        result = yield searched
        if result.failures:
            return Study((), (), result.failures)
        files = [result[item].design for item in searched]
    rows = _motions(scene, files, folder / NAME)
    return (yield from reported(rows, partial(report, scene=scene)))


def machines(scene: Scene) -> dict[str, str]:
    """Return what differs in the machines that motions do not know, by their names."""
    material, damping = scene.material, scene.damping.stiffness_proportional
    result = {}
    if scene.payload.mass > 0.0:
        result["payload + 10 %"] = f"payload.mass={TEN_PERCENT * scene.payload.mass!r}"
    if isinstance(material.young_modulus, float):
        result["E - 5 %"] = f"material.young_modulus={FIVE_PERCENT * material.young_modulus!r}"
    if damping > 0.0:
        result["half the damping"] = f"damping.stiffness_proportional={0.5 * damping!r}"
    return result


def _motions(scene: Scene, designs: Sequence[Path | None], folder: Path) -> Rows:
    """Return the motions with the first design, and feed-forward with the second."""
    rigid, forward = (_judged(with_feed_forward(scene, kind)) for kind in ("none", "tip"))
    first = designs[0]
    place = arms_with_design(MPI.COMM_SELF, rigid, first)
    finer = finer_deviation(place, None) if rigid.reduction.count else None
    labels = {LONGER: 0.0, FINER: 1e3 * (finer or math.nan)}
    rows: Rows = [(labels, Case(rigid, "simulate", first, RIGID))]
    chain = chain_of(rigid, place.bodies())
    frequency, damping_ratio = build_system(rigid, chain).slowest_vibration(2)
    if frequency > 0.0 and scene.motion.table_ends == "rest":
        for kind, label in SHAPERS.items():
            shaper = input_shaper(kind, frequency, damping_ratio)
            shaped = write_shaped(rigid, shaper, folder / f"{kind}.csv")
            rows.append(({LONGER: shaper.longer}, Case(shaped, "simulate", first, label)))
    for label, design in zip((FORWARD, DESIGNED), designs, strict=False):
        case = Case(forward, "simulate", design, label)
        rows.append(({LONGER: 2.0 * forward.lead}, case))
    return rows


def _judged(scene: Scene) -> Scene:
    """Return the scene with the machines that it does not know as its scenarios."""
    data = scene.to_tree()
    data["scenarios"] = [{"changes": [change]} for change in machines(scene).values()]
    return scene_from_dict(data, scene.source)


def write_shaped(scene: Scene, shaper: InputShaper, file: Path) -> Scene:
    """Write the joints of a scene's shaped motion as a table; return the scene that follows it."""
    motion = desired_motion(scene)
    joints = scene.driven_columns
    end = scene.motion.duration + shaper.longer
    t = np.linspace(0.0, end, ROWS)
    shaped = shaper.shaped(lambda t: motion(t).q[:, joints], t)
    make_folder(file.parent)
    write_table(file, ["t", *scene.driven], [t, shaped], 15)
    data = scene.to_tree()
    keys = (*KEPT, "elbow") if scene.closures else KEPT  # which way a loop is closed
    kept = {key: data["motion"][key] for key in keys if key in data["motion"]}
    if len(kept.get("initial_joints") or ()) == 1 and scene.motion.path == "rotation":
        del kept["initial_joints"]  # where the rotation began, which the table says
    horizon = scene.motion.horizon + shaper.longer
    table = {"path": "joints", "file": str(file.absolute()), "duration": end, "horizon": horizon}
    return scene_from_dict(data | {"motion": kept | table}, scene.source)


# -- table, sentence, picture ----------------------------------------------------------------


def report(frame: pd.DataFrame, scene: Scene) -> Report:
    """Return the table under a sentence, and the deviations over time."""
    able = [outcome for outcome in frame["outcome"] if not outcome.failure]
    columns = ["motion", "mass [kg]", LONGER, DEVIATION, FINER, "settling [mm]"]
    frame[FINER] = frame[FINER].fillna(frame["outcome"].map(_finer))
    frame = frame.rename(columns={"label": "motion"})
    further = pd.DataFrame(_further(scene, outcome.summary) for outcome in frame["outcome"])
    table = Table(
        "", f"{_verdict(able)} {NOTE}", with_failures(frame, frame[columns].join(further))
    )
    title = "Deviation of the tip from the path of each motion"
    return [table], [LineFigure("deviation", title, deviation_panels(able))]


def _finer(outcome: Outcome) -> float:
    """Return the deviation in a finer model that moves with the corrections, mm; nan without."""
    told = outcome.summary.get("feed_forward") or {}
    return 1e3 * (told.get("deviation_left_finer") or math.nan)


NOTE = (
    "Deviations are from the path that rigid arms would take with the same command; a shaped "
    "command's own path is rounder and later than the scene's. Machines that a motion does not "
    "know move with the same joints. The finer model has twice the coordinates and geometric "
    "stiffness. The settling is the largest deviation after the motion."
)


def _verdict(able: Sequence[Outcome]) -> str:
    """Return how far the tip is off with the first motion and with the best."""
    if not able:
        return "No motion can be simulated."
    first, best = able[0], min(able, key=lambda item: item.max_deviation)
    return (
        f"With {first.case.label} the tip is off by {1e3 * first.max_deviation:.4g} mm, with "
        f"{best.case.label} by {1e3 * best.max_deviation:.4g} mm."
    )


def _further(scene: Scene, summary: Mapping[str, Any]) -> dict[str, float]:
    """Return by column what other machines do with a motion, and the largest forces of drives."""
    others = zip(machines(scene), summary.get("scenarios", ()), strict=False)
    cells = {f"{name} [mm]": 1e3 * result["max_deviation"] for name, result in others}
    peaks = summary.get("drive_peak", {})
    for name, unit in drive_units(scene).items():
        cells[f"peak {name} [{unit}]"] = peaks.get(name, math.nan)
    return cells
