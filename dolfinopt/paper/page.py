"""What was reproduced as files: figures, their data, and a page that explains them.

The page is one file without anything from elsewhere: pictures are inside, it opens offline.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from dolfinopt.data import page_folder
from dolfinopt.paper.checks import Ends, Measured, ValueSweep, mm, percent
from dolfinopt.paper.reproduction import INITIAL, OPTIMUM, Numbered, Reproduction, cell_sizes
from dolfinopt.study.tables import DesignFigure, LineFigure, Table, as_text

if TYPE_CHECKING:
    from dolfinopt.dynamics.simulation import Trajectory
    from dolfinopt.output.files import ArmView
    from dolfinopt.scene.load import Scene
    from dolfinopt.study.store import Case, Outcome

WIDTH = 900  # px of a picture of the longest arm
FRAMES = 121  # of the animation
SLOWER = 2.0  # than the motion itself
# Headings of the page and the paper's figures that belong under each.
SECTIONS = (
    ("What the arms are made stiff for", (3, 4)),
    ("How the arms are reduced", (5, 6)),
    ("How many coordinates it takes", (7, 8)),
    ("Designs made with modes", (9,)),
    ("Another payload", (10, 11)),
    ("Another path", (12, 13, 14, 15)),
)


def write_reproduction(done: Reproduction, folder: Path, *, plots: bool = True) -> None:
    """Write figNN.csv and .png, measured.json and report.html into the folder (root only).

    Args:
        done: what was reproduced.
        folder: exists.
        plots: False leaves out pictures and page.
    """
    from dolfinopt.output.files import write_text
    from dolfinopt.plots.style import save
    from dolfinopt.study.figures import column_figure, common_looks, draw

    styles = common_looks(numbered.figure for numbered in done.figures)
    write_text(folder / "measured.json", done.measured.json())
    for numbered in done.figures:
        write_text(folder / f"{numbered.name}.csv", numbered.csv())
        if plots:
            figure = numbered.figure
            if isinstance(figure, LineFigure):
                drawn = column_figure(figure, styles)
            else:
                drawn = draw(figure, styles)
            save(drawn, folder / f"{numbered.name}.png")
    if plots:
        write_text(folder / "report.html", page(done, folder))


def page(done: Reproduction, folder: Path) -> str:
    """Return report.html; the figures' pictures lie in the folder."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    used = {number for _, numbers in SECTIONS for number in numbers}
    assert used == {numbered.number for numbered in done.figures}
    gallery, outcomes, scene = _Gallery(done), done.outcomes, done.plan.scene
    optimised = [o for case, o in outcomes.by_case.items() if case.action == "optimize"]
    size = max(cell_sizes(scene).values(), default=0.0)
    templates = Environment(
        loader=FileSystemLoader(page_folder()),
        autoescape=lambda name: str(name).endswith(".html"),
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    text = templates.get_template("report.html").render(
        as_text=as_text,
        measured=done.measured,
        cards=_cards(done),
        player=_player(done),
        checks=done.checks,
        sections=[_section(title, n, done, gallery, folder) for title, n in SECTIONS],
        scene=scene,
        cases=outcomes.by_case,
        optimised=optimised,
        seconds=sum(o.seconds for o in optimised if not o.failure),
        filter_cells=scene.design.radius / size if size else 0.0,
        overridden=_overridden(scene),
        failures=outcomes.failures,
    )
    return text.lstrip()


# -- words and tables ------------------------------------------------------------------------


def _cards(done: Reproduction) -> list[tuple[str, str]]:
    """Return names and values of the figures one looks for first."""
    initial = done.measured.objectives[0]
    best = next(m for m in done.measured.objectives if m.kind == "esl")
    holds = sum(check.holds for check in done.checks)
    return [
        ("compliance", f"{initial.compliance:.4g} → {best.compliance:.4g} N m"),
        ("largest deviation", f"{1e3 * initial.deviation:.3g} → {1e3 * best.deviation:.3g} mm"),
        ("material", percent(done.plan.scene.design.volume_fraction).replace(".0 %", " %")),
        ("of the paper’s statements hold", f"{holds} of {len(done.checks)}"),
    ]


def _section(
    title: str, numbers: Sequence[int], done: Reproduction, gallery: _Gallery, folder: Path
) -> dict[str, Any]:
    """Return one part of the paper: its statements, our figures, tables and designs."""
    plan, measured = done.plan, done.measured
    shown = [numbered for numbered in done.figures if numbered.number in numbers]
    tables = [numbered.table for numbered in shown if numbered.table is not None]
    designs: tuple[str, Iterable[Case]] = ("", ())
    if 4 in numbers:
        designs = "Designs by objective", (plan.initial, *plan.objectives)
        tables.append(_ends_table(measured.ends))
    elif 5 in numbers:
        designs = "Designs by reduction", plan.reductions
        tables.append(_reduction_table(measured))
    elif 10 in numbers:
        tables.append(_loss_table(measured.payload))
    elif 12 in numbers:
        designs = "Designs by path", plan.paths
    return {
        "title": title,
        "checks": [f for f in done.checks if set(f.figures) <= set(numbers)],
        "plots": [
            (n, _png((folder / f"{n.name}.png").read_bytes()), _about(n))
            for n in shown
            if not isinstance(n.figure, DesignFigure)
        ],
        "tables": tables,
        "designs_title": designs[0],
        "designs": gallery.show(designs[1]),
    }


def _about(numbered: Numbered) -> str:
    """Return what a figure shows, for those who do not see it."""
    if not isinstance(numbered.figure, LineFigure):
        return numbered.title
    panels = [panel for row in numbered.figure.rows for panel in row]
    curves = dict.fromkeys(line.label for panel in panels for line in panel.lines)
    axes = f"{panels[0].y_label} over {panels[0].x_label}"
    return f"{numbered.title}: {axes} of {', '.join(curves)}"


def _png(data: bytes) -> dict[str, Any]:
    """Return a PNG as the page embeds it."""
    width, height = (int.from_bytes(data[i : i + 4], "big") for i in (16, 20))  # of its header
    return {"data": base64.b64encode(data).decode(), "width": width, "height": height}


def _reduction_table(measured: Measured) -> Table:
    columns = ["made with", "coordinates", "compliance, own model [N m]", "compliance [N m]",
               "maximal deviation [mm]", "cells on the other side of one half [%]",
               "iterations"]  # fmt: skip
    rows = tuple(
        (r.method, r.coordinates, r.own, r.compliance, 1e3 * r.deviation, 100.0 * r.apart,
         r.iterations)
        for r in measured.reductions
    )  # fmt: skip
    finest = measured.reductions[-1].coordinates
    title = f"Designs by reduction, all simulated with {finest} Craig-Bampton coordinates"
    return Table("", title, pd.DataFrame(rows, columns=columns))


def _ends_table(ends: Ends) -> Table:
    """Return all designs with solid ends, by what they were made for and with."""
    initial = ends.objectives[0].deviation
    columns = ["made for or with", "compliance [N m]", "maximal deviation [mm]",
               "of the initial design's [%]"]  # fmt: skip
    made = [(m.label, m.compliance, m.deviation) for m in ends.objectives]
    made += [(f"{r.method} {r.coordinates}", r.compliance, r.deviation) for r in ends.reductions]
    rows = [(name, c, 1e3 * d, 100.0 * d / initial) for name, c, d in made]
    frame = pd.DataFrame(rows, columns=columns)
    return Table("", f"{ends.words}; nothing else differs", frame)


def _loss_table(sweep: ValueSweep) -> Table:
    labels = [f"{used.made_for:g}" for used in sweep.optima]
    frame = pd.DataFrame({f"made for {sweep.axis}": labels})
    for quantity in ("compliance", "deviation"):
        columns = [f"{quantity} lost at {label} [%]" for label in labels]
        frame[columns] = 100.0 * sweep.loss(quantity)
    return Table("", "Loss against the design made for the payload", frame)


def _overridden(scene: Scene) -> list[str]:
    """Return where the scene is not the paper's, which every figure here is compared with."""
    from dolfinopt.paper.reproduction import load_paper

    theirs, ours = _flat(load_paper().to_dict()), _flat(scene.to_dict())
    return [
        f"{key} = {ours.get(key)} in place of {theirs.get(key)}"
        for key in dict.fromkeys([*theirs, *ours])
        if theirs.get(key) != ours.get(key)
    ]


def _flat(data: Any, key: str = "") -> dict[str, Any]:
    """Return nested tables as one, keys dotted."""
    if isinstance(data, list) and data and isinstance(data[0], dict):
        data = {str(k): row for k, row in enumerate(data)}
    if not isinstance(data, dict):
        return {key: data}
    found: dict[str, Any] = {}
    for name, value in data.items():
        found |= _flat(value, f"{key}.{name}" if key else name)
    return found


# -- designs ---------------------------------------------------------------------------------


class _Gallery:
    """Pictures of designs; owns the arms, which are built once."""

    def __init__(self, done: Reproduction) -> None:
        from mpi4py import MPI

        from dolfinopt.arms.arm import build_arms
        from dolfinopt.parallel import partition_arms
        from dolfinopt.profiling import Profile

        self.outcomes, self.scene = done.outcomes, done.plan.scene
        self.partition = partition_arms(MPI.COMM_SELF, self.scene.cell_counts)
        self.arms = build_arms(self.scene, self.partition, Profile())

    def views(self, outcome: Outcome) -> Sequence[ArmView]:
        """Return the arms of a design."""
        from dolfinopt.output.files import designed, gather_views, read_design

        x_phys = read_design(outcome.design, self.partition, self.arms)
        return designed(gather_views(self.scene, self.partition, self.arms, x_phys))

    def show(self, cases: Iterable[Case]) -> list[dict[str, Any]]:
        """Return the designs, all to one scale; those without a result are left out."""
        items = []
        for case in dict.fromkeys(cases):
            outcome = self.outcomes[case]
            if outcome.failure:
                continue
            views = self.views(outcome)
            lengths = [float(np.ptp(view.corners[..., 0])) for view in views]
            arms = []
            for view, length in zip(views, lengths):
                part = length / max(lengths)
                png = _png(arm_picture(view, round(WIDTH * part)))
                arms.append({"name": view.name, "width": f"{100.0 * part:.4g}", "png": png})
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


@dataclass(frozen=True, eq=False)
class Strip:
    """A moving design as paths of SVG, one a frame.

    Attributes:
        arms: centre lines of all arms.
        tips: (n, 2) m, the end-effector.
        carts: (n,) m.
        deviation: (n,) mm, not magnified.
    """

    arms: list[str]
    tips: np.ndarray
    carts: np.ndarray
    deviation: np.ndarray


def strip(trajectory: Trajectory, at: np.ndarray, magnification: float) -> Strip:
    """Return the frames of a trajectory.

    Between its interfaces an arm is drawn as the cubic that has their places and directions,
    which is how a beam bends without loads between its ends.

    Args:
        trajectory: sampled.
        at: (n,) samples to show.
        magnification: of the deformation.
    """
    from dolfinopt.plots.shapes import chain

    mechanism = trajectory.mechanism
    q = magnification * trajectory.q_e[at]
    place, swing = chain(mechanism, trajectory.q_r[at], q)
    parts = []
    for k, (part, body) in enumerate(zip(mechanism.slices, mechanism.bodies, strict=True)):
        turn = swing[:, k] * np.exp(1j * (q[:, part] @ body.outboard[2]))
        third = np.abs(place[:, k + 1] - place[:, k]) / 3.0
        parts.append(
            (place[:, k] + third * swing[:, k], place[:, k + 1] - third * turn, place[:, k + 1])
        )
    arms = []
    for n in range(len(at)):
        curves = "".join(f"C{' '.join(_point(part[n]) for part in three)}" for three in parts)
        arms.append(f"M{_point(place[n, 0])}{curves}")
    tips = np.stack([place[:, -1].real, place[:, -1].imag], axis=1)
    return Strip(arms, tips, place[:, 0].real, 1e3 * np.hypot(*trajectory.deviation[at].T))


def _point(place: complex) -> str:
    return f"{place.real:.4f},{place.imag:.4f}"


def _player(done: Reproduction) -> dict[str, Any] | None:
    """Return the moving mechanism, initial and optimised design together; None without results."""
    from dolfinopt.plots.animation import round_magnification
    from dolfinopt.study.store import simulate_scenarios

    optimum = done.outcomes[done.plan.optimum]
    if optimum.failure:
        return None
    moved = []
    for design in (None, optimum.design):
        simulated = next(iter(simulate_scenarios([done.plan.scene], design)))
        if isinstance(simulated, Exception) or simulated.trajectory is None:
            return None
        moved.append(simulated.trajectory)
    t = moved[0].t
    at = np.unique(np.round(np.linspace(0, len(t) - 1, FRAMES)).astype(int))
    reach = sum(float(np.hypot(*body.outboard_point)) for body in moved[0].mechanism.bodies)
    largest = float(np.hypot(*moved[0].deviation.T).max())
    magnification = round_magnification(largest, reach)
    before, after = (strip(one, at, magnification) for one in moved)
    rigid = strip(moved[1], at, 0.0)
    return _frames(t[at], before, after, rigid, magnification, moved[0].mechanism.joint_height)


def _frames(
    t: np.ndarray, before: Strip, after: Strip, rigid: Strip, magnification: float, joint: float
) -> dict[str, Any]:
    """Return what player.html shows: complete without its script, which only moves it."""
    places = np.concatenate([s.tips for s in (before, after, rigid)])
    left = float(min(places[:, 0].min(), rigid.carts.min())) - 0.16
    right = float(max(places[:, 0].max(), rigid.carts.max())) + 0.16
    low, high = joint - 0.14, float(places[:, 1].max()) + 0.1
    width, height = right - left, high - low
    here = int(np.argmax(before.deviation))
    frames = {
        "t": [round(float(v), 3) for v in t],
        "cart": [round(float(v), 4) for v in rigid.carts],
        "before": before.arms,
        "after": after.arms,
        "tips": [[round(float(v), 4) for v in (*b, *a)] for b, a in zip(before.tips, after.tips)],
        "mm": [
            [round(float(v), 2) for v in pair] for pair in zip(before.deviation, after.deviation)
        ],
        "delay": 1e3 * SLOWER * float(t[-1] - t[0]) / (len(t) - 1),
    }
    path = "M" + "L".join(_point(complex(x, y)) for x, y in rigid.tips)
    return {
        "box": f"{left:.3f} {-high:.3f} {width:.3f} {height:.3f}",
        "left": f"{left:.3f}",
        "right": f"{right:.3f}",
        "ground": f"{joint - 0.075:.3f}",
        "cart_y": f"{joint - 0.06:.3f}",
        "cart": f"{rigid.carts[here]:.4f}",
        "path": path,
        "before": before.arms[here],
        "after": after.arms[here],
        "bx": f"{before.tips[here, 0]:.4f}",
        "by": f"{before.tips[here, 1]:.4f}",
        "ax": f"{after.tips[here, 0]:.4f}",
        "ay": f"{after.tips[here, 1]:.4f}",
        "last": len(t) - 1,
        "here": here,
        "said": _said(float(t[here]), float(before.deviation[here]), float(after.deviation[here])),
        "magnification": f"{magnification:g}",
        "slower": f"{SLOWER:g}",
        "frames": frames,
        "initial": INITIAL,
        "optimised": OPTIMUM,
    }


def _said(t: float, before: float, after: float) -> str:
    return f"{t:.2f} s: {before:.1f} mm, {after:.1f} mm"
