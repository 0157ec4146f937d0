"""What was reproduced as files: figures, their data, and a page that explains them.

The page is one file without anything from elsewhere: pictures are inside, it opens offline.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from dolfinopt.paper.figures import LABELS, Numbered, all_figures
from dolfinopt.paper.reproduction import (
    INITIAL,
    OPTIMUM,
    SWEEPS,
    Plan,
    as_json,
    cell_sizes,
    load_paper,
    loss,
    setting_of,
)
from dolfinopt.paper.statements import Check, mm
from dolfinopt.study.tables import DesignFigure, LineFigure, embedded, html_page
from dolfinopt.study.variants import differences

if TYPE_CHECKING:
    from dolfinopt.dynamics.simulation import Trajectory
    from dolfinopt.output.views import ArmView
    from dolfinopt.scene.load import Scene
    from dolfinopt.study.cases import Case, Outcomes

WIDTH = 900  # px of a picture of the longest arm
FRAMES = 121  # of the animation
SLOWER = 2.0  # than the motion itself
# Headings of the page, the paper's figures that belong under each, and whose designs are shown.
SECTIONS = (
    ("What the arms are made stiff for", (3, 4), "objectives"),
    ("How the arms are reduced", (5, 6), "reductions"),
    ("How many coordinates it takes", (7, 8), ""),
    ("Designs made with modes", (9,), ""),
    ("Another payload", (10, 11), "payload"),
    ("Another path", (12, 13, 14, 15), "path"),
)


def write_reproduction(
    plan: Plan,
    results: pd.DataFrame,
    outcomes: Outcomes,
    checks: Sequence[Check],
    folder: Path,
    *,
    plots: bool = True,
) -> None:
    """Write figNN.csv and .png, measured.json and report.html into the folder (root only).

    Args:
        plan, results, outcomes: see `reproduction.reproduce`.
        checks: of the results.
        folder: exists.
        plots: False leaves out pictures and page.
    """
    from dolfinopt.disk import write_text
    from dolfinopt.plots.style import save
    from dolfinopt.study.figures import column_figure, common_looks, draw

    figures = all_figures(results, outcomes)
    styles = common_looks(numbered.figure for numbered in figures)
    write_text(folder / "measured.json", as_json(plan, results))
    for numbered in figures:
        write_text(folder / f"{numbered.name}.csv", numbered.csv())
        if plots:
            if isinstance(numbered.figure, LineFigure):
                drawn = column_figure(numbered.figure, styles)
            else:
                drawn = draw(numbered.figure, styles)
            save(drawn, folder / f"{numbered.name}.png")
    if plots:
        text = page(plan, results, outcomes, checks, figures, folder)
        write_text(folder / "report.html", text)


def page(
    plan: Plan,
    results: pd.DataFrame,
    outcomes: Outcomes,
    checks: Sequence[Check],
    figures: Sequence[Numbered],
    folder: Path,
) -> str:
    """Return report.html; the figures' pictures lie in the folder."""
    scene, objectives = plan.scene, results[results.table == "objectives"]
    optimised = [o for case, o in outcomes.by_case.items() if case.action == "optimize"]
    size = max(cell_sizes(scene).values(), default=0.0)
    return html_page(
        "report.html",
        setting=setting_of(scene),
        initial=objectives.iloc[0],
        best=objectives[objectives.kind == "esl"].iloc[0],
        player=_player(plan, outcomes),
        checks=checks,
        sections=_sections(results, outcomes, checks, figures, folder),
        scene=scene,
        cells=scene.arms[0].cells or (),
        cases=outcomes.by_case,
        optimised=optimised,
        seconds=sum(o.seconds for o in optimised if not o.failure),
        filter_cells=scene.design.radius / size if size else 0.0,
        overridden=_overridden(scene),
        failures=outcomes.failures,
    )


def _sections(
    results: pd.DataFrame,
    outcomes: Outcomes,
    checks: Sequence[Check],
    figures: Sequence[Numbered],
    folder: Path,
) -> list[dict[str, Any]]:
    """Return the page's sections: statements, plots, tables and designs of each."""
    by = dict(iter(results.groupby("table")))
    tables = {
        "objectives": _ends_table(by["ends objectives"], by["ends reductions"]),
        "reductions": _reduction_table(by["reductions"]),
        "payload": _loss_table(by["payload"]),
    }
    designs = {name: by[name].made for name in ("objectives", "reductions")}
    designs["path"] = by["path"].made[by["path"].made_for.notna()]
    sections = []
    for title, numbers, name in SECTIONS:
        shown = [numbered for numbered in figures if numbered.number in numbers]
        of_figures = [(one.title, one.table.frame) for one in shown if one.table is not None]
        sections.append(
            {
                "title": title,
                "checks": [check for check in checks if set(check.figures) <= set(numbers)],
                "plots": [
                    (one, embedded((folder / f"{one.name}.png").read_bytes()), _about(one))
                    for one in shown
                    if not isinstance(one.figure, DesignFigure)
                ],
                "tables": of_figures + [tables[key] for key in tables if key == name],
                "designs_title": f"Designs by {name.removesuffix('s')}",
                "designs": _gallery(designs.get(name, ()), outcomes),
            }
        )
    return sections


# -- words and tables ------------------------------------------------------------------------


def _about(numbered: Numbered) -> str:
    """Return what a figure shows, for those who do not see it."""
    if not isinstance(numbered.figure, LineFigure):
        return numbered.title
    panels = [panel for row in numbered.figure.rows for panel in row]
    curves = dict.fromkeys(line.label for panel in panels for line in panel.lines)
    axes = f"{panels[0].y_label} over {panels[0].x_label}"
    return f"{numbered.title}: {axes} of {', '.join(curves)}"


def _reduction_table(rows: pd.DataFrame) -> tuple[str, pd.DataFrame]:
    columns = {
        "made with": rows.kind,
        "coordinates": rows.x.astype(int),
        "compliance, own model [N m]": rows.own,
        LABELS["compliance"]: rows.compliance,
        LABELS["deviation"]: 1e3 * rows.deviation,
        "cells on the other side of one half [%]": 100.0 * rows.apart,
        "iterations": rows.iterations,
    }
    title = f"Designs by reduction, all simulated with {rows.x.max():g} Craig-Bampton coordinates"
    return title, pd.DataFrame(columns)


def _ends_table(objectives: pd.DataFrame, reductions: pd.DataFrame) -> tuple[str, pd.DataFrame]:
    """Return all designs with solid ends, by what they were made for and with."""
    rows = pd.concat([objectives, reductions])
    columns = {
        "made for or with": rows.label,
        LABELS["compliance"]: rows.compliance,
        LABELS["deviation"]: 1e3 * rows.deviation,
        "of the initial design's [%]": 100.0 * rows.deviation / objectives.deviation.iloc[0],
    }
    length = 1e3 * objectives.case.iloc[0].scene.arms[0].passive
    title = f"With {length:.0f} mm of solid material at both ends of the arms; nothing else differs"
    return title, pd.DataFrame(columns)


def _loss_table(rows: pd.DataFrame) -> tuple[str, pd.DataFrame]:
    parts = []
    for quantity in LABELS:
        part = 100.0 * loss(rows, quantity)
        parts.append(part.rename(columns=lambda x: f"{quantity} lost at {x:g} [%]"))  # noqa: B023
    frame = pd.concat(parts, axis=1)
    frame.insert(0, f"made for {SWEEPS['payload'][1]}", [f"{x:g}" for x in frame.index])
    return "Loss against the design made for the payload", frame


def _overridden(scene: Scene) -> list[str]:
    """Return where the scene is not the paper's, which every figure here is compared with."""
    differing = differences(load_paper(), scene).items()
    return [f"{key} = {ours} in place of {theirs}" for key, (theirs, ours) in differing]


# -- designs ---------------------------------------------------------------------------------


def _gallery(cases: Iterable[Case], outcomes: Outcomes) -> list[dict[str, Any]]:
    """Return the designs, all to one scale; those without a result are left out."""
    from dolfinopt.output.design import read_views
    from dolfinopt.output.views import designed

    items = []
    for case in dict.fromkeys(cases):
        outcome = outcomes[case]
        if outcome.failure:
            continue
        views = designed(read_views(case.scene, outcome.design))
        lengths = [float(np.ptp(view.corners[..., 0])) for view in views]
        parts = [length / max(lengths) for length in lengths]
        arms = [
            {
                "name": view.name,
                "width": f"{100.0 * part:.4g}",
                "png": embedded(arm_picture(view, round(WIDTH * part))),
            }
            for view, part in zip(views, parts)
        ]
        figures = f"{outcome.compliance:.4g} N m, {mm(outcome.max_deviation)}"
        items.append({"label": case.label, "figures": figures, "arms": arms})
    return items


def arm_picture(view: ArmView, width: int) -> bytes:
    """Return an arm's densities as PNG, to scale.

    Args:
        view: of the arm.
        width: px.
    """
    from matplotlib import colormaps
    from PIL import Image, ImageDraw

    from dolfinopt.plots.style import COLOURS

    low = view.corners.min(axis=(0, 1))
    size = view.corners.max(axis=(0, 1)) - low
    scale = width / size[0]
    picture = Image.new("RGB", (width, max(1, round(scale * size[1]))), "white")
    brush = ImageDraw.Draw(picture)
    colours = (255.0 * colormaps[COLOURS](view.density)[:, :3]).astype(int)
    points = scale * (view.corners - low)
    points[..., 1] = picture.height - points[..., 1]
    for corners, colour in zip(points, colours, strict=True):
        brush.polygon([(float(x), float(y)) for x, y in corners], fill=tuple(map(int, colour)))
    stream = io.BytesIO()
    picture.convert("P", palette=Image.Palette.ADAPTIVE).save(stream, "PNG", optimize=True)
    return stream.getvalue()


# -- the animation ---------------------------------------------------------------------------


def centre_lines(trajectory: Trajectory, at: np.ndarray, magnification: float) -> np.ndarray:
    """Return the arms' centre lines as cubic Bezier curves (n, 1 + 3 arms), m, complex x + i y.

    Between its interfaces an arm is drawn as the cubic that has their places and directions,
    which is how a beam bends without loads between its ends. The first point is the shoulder, the
    last the end-effector.

    Args:
        trajectory: sampled.
        at: (n,) samples to show.
        magnification: of the deformation.
    """
    from dolfinopt.plots.shapes import chain

    mechanism = trajectory.mechanism
    q = magnification * trajectory.q_e[at]
    place, swing = chain(mechanism, trajectory.q_r[at], q)
    points = [place[:, 0]]
    for k, (part, body) in enumerate(zip(mechanism.slices, mechanism.bodies, strict=True)):
        turn = swing[:, k] * np.exp(1j * (q[:, part] @ body.outboard[2]))
        third = np.abs(place[:, k + 1] - place[:, k]) / 3.0
        inner = place[:, k] + third * swing[:, k], place[:, k + 1] - third * turn
        points += [*inner, place[:, k + 1]]
    return np.stack(points, axis=1)


def svg_path(points: Iterable[complex]) -> str:
    """Return cubic curves as a path of SVG."""
    first, *others = (f"{point.real:.4f},{point.imag:.4f}" for point in points)
    return f"M{first}C{' '.join(others)}"


def _player(plan: Plan, outcomes: Outcomes) -> dict[str, Any] | None:
    """Return the moving mechanism, initial and optimised design together; None without results.

    The page is complete without its script, which only moves the picture.
    """
    from dolfinopt.plots.animation import round_magnification
    from dolfinopt.study.simulate import simulate_scenarios

    optimum = outcomes[plan.optimum]
    if optimum.failure:
        return None
    moved = []
    for design in (None, optimum.design):
        simulated = next(iter(simulate_scenarios([plan.scene], design)))
        if isinstance(simulated, Exception) or simulated.trajectory is None:
            return None
        moved.append(simulated.trajectory)
    t, mechanism = moved[0].t, moved[0].mechanism
    at = np.unique(np.round(np.linspace(0, len(t) - 1, FRAMES)).astype(int))
    reach = sum(float(np.hypot(*body.outboard_point)) for body in mechanism.bodies)
    deviation = 1e3 * np.stack([np.hypot(*one.deviation.T) for one in moved], axis=1)  # mm
    magnification = round_magnification(1e-3 * deviation[:, 0].max(), reach)
    lines = [centre_lines(one, at, magnification) for one in moved]
    rigid = centre_lines(moved[1], at, 0.0)
    tips = np.stack([line[:, -1] for line in lines], axis=1)
    every = np.concatenate([*tips.T, rigid[:, -1], rigid[:, 0]])
    return {
        "left": every.real.min() - 0.16,
        "right": every.real.max() + 0.16,
        "low": mechanism.joint_height - 0.14,
        "high": every.imag.max() + 0.1,
        "joint": mechanism.joint_height,
        "path": "M" + "L".join(f"{p.real:.4f},{p.imag:.4f}" for p in rigid[:, -1]),
        "here": int(np.argmax(deviation[at, 0])),
        "magnification": magnification,
        "slower": SLOWER,
        "initial": INITIAL,
        "optimised": OPTIMUM,
        "frames": {
            "t": np.round(t[at], 3).tolist(),
            "cart": np.round(rigid[:, 0].real, 4).tolist(),
            "before": [svg_path(points) for points in lines[0]],
            "after": [svg_path(points) for points in lines[1]],
            "tips": np.round(tips.view(float), 4).tolist(),
            "mm": np.round(deviation[at], 2).tolist(),
            "delay": 1e3 * SLOWER * float(t[-1] - t[0]) / (len(at) - 1),
        },
    }
