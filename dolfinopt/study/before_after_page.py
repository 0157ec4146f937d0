"""The page of a robot before and after: figures, links in the machine, curves over time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.multibody.end_effector import lengths
from dolfinopt.output.trajectory import drive_units
from dolfinopt.output.views import designed
from dolfinopt.plots.style import look, png
from dolfinopt.scene.load import Scene
from dolfinopt.study.html import embedded, html_page
from dolfinopt.study.tables import Line, LineFigure, Panel, Table
from dolfinopt.study.variants import differences

if TYPE_CHECKING:
    from dolfinopt.multibody.spatial.mechanism import SpatialMechanism
    from dolfinopt.output.views import ArmView

NAME = "before_after.html"
BEFORE, AFTER = "before", "after"
LOOKS = {BEFORE: look(1), AFTER: look(0)}  # as an initial and an optimised design
MM = 1e3  # of a metre
Image = dict[str, Any]  # see `html.embedded`


@dataclass(frozen=True, eq=False)
class Motion:
    """What trajectory.npz holds of a run in space.

    Attributes:
        t: (n,) s.
        q_r: (n, joints) rad or m.
        deviation: (n,) of the tool from where rigid links carry it, m.
        drive_forces: (n,) by the drive's name, N or N m.
    """

    t: np.ndarray
    q_r: np.ndarray
    deviation: np.ndarray
    drive_forces: Mapping[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Side:
    """One of the two runs.

    Attributes:
        folder: of the run, as the user named it.
        scene: its scene.
        summary: content of its summary.json.
        motion: as it was simulated.
        views: of all arms, in the scene's order.
        mechanism: of its bodies.
    """

    folder: Path
    scene: Scene
    summary: Mapping[str, Any]
    motion: Motion
    views: list[ArmView]
    mechanism: SpatialMechanism


def read_motion(run: Path, scene: Scene) -> Motion:
    """Read the motion of a finished run.

    Raises:
        InputError: it has no trajectory.npz, or another machine's.
    """
    path = run / "trajectory.npz"
    try:
        with np.load(path, allow_pickle=False) as data:
            t, q_r, vectors, forces = (
                data[key] for key in ("t", "q_r", "deviation", "joint_forces")
            )
        columns = forces[:, scene.driven_columns].T
        by_drive = dict(zip(scene.driven, columns, strict=True))
    except Exception as error:  # whatever a foreign file may raise
        raise InputError(
            f"{path}: cannot be read ({type(error).__name__}); name a finished run"
        ) from None
    return Motion(t, q_r, lengths(vectors), by_drive)


def before_after_page(before: Side, after: Side, table: Table) -> str:
    """Return the page of two runs of one machine.

    Args:
        before, after: the runs.
        table: of their figures, see `before_after`.
    """
    sides = {BEFORE: before, AFTER: after}
    return html_page(
        NAME,
        title=table.title,
        sides=sides,
        cards=_cards(table),
        machines=[(label, _machine(label, side)) for label, side in sides.items()],
        links=list(_links(sides)),
        curves=list(_curves(sides, table)),
        table=table,
        differing=differences(before.scene, after.scene),
        scene=after.scene,
    )


def _cards(table: Table) -> list[tuple[str, str]]:
    """Return the figures that stand on top: words, and both values."""
    rows = table.frame
    wanted = rows["figure"].str.startswith(("mass of", "largest tool", "first frequency"))
    found = [
        (str(row.figure), f"{row.before:.4g} → {row.after:.4g} {row.unit}")
        for row in rows[wanted & rows["before"].notna() & rows["after"].notna()].itertuples()
    ]
    return [card for card in found if card[0] != "mass of all arms"]


# -- pictures --------------------------------------------------------------------------------


def _machine(label: str, side: Side) -> Image:
    """Return the machine in a few poses along its path."""
    from dolfinopt.plots.solid_machine import solid_machine_figure

    motion = side.motion
    drawn = solid_machine_figure(side.views, side.mechanism, motion.t, motion.q_r, label)
    return embedded(png(drawn))


def _links(sides: Mapping[str, Side]) -> Iterator[tuple[str, Image]]:
    """Yield every link that one of the runs designs, by its name: both to one scale."""
    from dolfinopt.plots.solid_design import solid_design_figure

    names = dict.fromkeys(view.name for side in sides.values() for view in designed(side.views))
    for name in names:
        views, masses = [], {}
        for label, side in sides.items():
            for view in designed(side.views):
                if view.name == name:
                    views.append(replace(view, name=label))
                    masses[label] = side.summary["mass"][name]
        yield name, embedded(png(solid_design_figure(views, name, masses)))


def _curves(sides: Mapping[str, Side], table: Table) -> Iterator[tuple[str, str, Image]]:
    """Yield title, figures in words, and picture of deflection and drive forces over time."""
    deflection = [
        Line(label, side.motion.t, MM * side.motion.deviation) for label, side in sides.items()
    ]
    title = "deflection of the tool"
    words = _words(table, "largest", "largest tool deflection")
    yield title, words, _plot(title, f"{title} [mm]", deflection)
    after = sides[AFTER]
    for drive, unit in drive_units(after.scene).items():
        lines = [
            Line(label, side.motion.t, side.motion.drive_forces[drive])
            for label, side in sides.items()
        ]
        what = "force" if unit == "N" else "torque"
        words = "; ".join(
            _words(table, word, f"{word} of drive {drive}") for word in ("peak", "root mean square")
        )
        yield f"drive {drive}", words, _plot(f"drive {drive}", f"{what} [{unit}]", lines)


def _words(table: Table, word: str, figure: str) -> str:
    """Return a row of the table in words."""
    row = table.frame.set_index("figure").loc[figure]
    change = row["change [%]"]
    ending = f" ({change:+.3g} %)" if np.isfinite(change) and change else ""
    return f"{word} {row['before']:.4g} → {row['after']:.4g} {row['unit']}{ending}"


def _plot(title: str, label: str, lines: list[Line]) -> Image:
    from dolfinopt.study.figures import column_figure

    panel = Panel(title, "time [s]", label, tuple(lines), y_log=False)
    return embedded(png(column_figure(LineFigure("", title, ((panel,),)), LOOKS)))
