"""How pictures look: colours and lines by name, figures and their files.

One name has one look in all pictures that belong together, and every curve has the same width.
Matplotlib is imported where it is used: most commands draw nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from dolfinopt.disk import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = "YlGnBu"  # void is light, solid is dark, lightness falls evenly between
DENSITY = "physical density [-]"
# Okabe and Ito's colours, told apart by colour-blind readers too.
PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#000000", "#e69f00", "#56b4e9")
# Seven colours and four dashes have no common divisor: 28 looks, and neighbours differ in both, so
# that of curves which coincide the lower one shows through the gaps of the upper one.
DASHES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1.2, 1.4)), (0, (6, 1.6, 1.2, 1.6)))
MARKERS = "osD^vPX"
BLUE, ORANGE, GREY = PALETTE[0], PALETTE[1], "#6e6e6e"
INITIAL, OPTIMISED = "initial design", "optimised design"
KNOWN = {OPTIMISED: 0, INITIAL: 1}  # the same in all pictures of all runs
LONGEST = 60  # characters of a name in a legend
FEW_POINTS = 40  # of a line, which gets markers
MILLI = 1e3
SOLID_FROM = 0.05  # density from which a cell is drawn where void is left open

Box = tuple[np.ndarray, np.ndarray]  # lowest and highest corner


def look(number: int) -> dict[str, Any]:
    """Return colour, dashes, marker and order of a curve; all have one width and marker size."""
    return {
        "color": PALETTE[number % len(PALETTE)],
        "linestyle": DASHES[number % len(DASHES)],
        "marker": MARKERS[number % len(MARKERS)],
        "zorder": 2.0 + 0.1 * (number % len(DASHES)),  # what has gaps lies above what has none
    }


def looks(groups: Iterable[Sequence[str]]) -> dict[str, dict[str, Any]]:
    """Return how the curve of every label looks: the same wherever it occurs.

    Args:
        groups: the labels that are seen together in one figure; 28 of all are told apart, and
            seven that follow each other by their colours.
    """
    numbers = dict(KNOWN)
    for label in chain.from_iterable(groups):
        numbers.setdefault(label, len(numbers))
    return {label: look(number) for label, number in numbers.items()}


# -- names -----------------------------------------------------------------------------------


def shortened(name: str) -> str:
    """Return a curve's name without its beginning where it is too long: of paths the end tells."""
    return name if len(name) <= LONGEST else "..." + name[3 - LONGEST :]


# -- scales ----------------------------------------------------------------------------------


def log_scale(axes: Axes, values: np.ndarray) -> None:
    """Make y logarithmic for positive values, labelled with plain numbers."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

    axes.set_yscale("log")
    ratio = np.max(values) / np.min(values)
    # A short axis would otherwise have one number, or none.
    subs = [1.0, 2.0, 5.0] if ratio < 50.0 else [1.0]
    short = MaxNLocator(5, steps=[1, 2, 2.5, 5, 10])
    axes.yaxis.set_major_locator(short if ratio < 5.0 else LogLocator(subs=subs))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())


def log2_scale(axes: Axes) -> None:
    """Make x logarithmic with powers of two in full: numbers that are doubled, not added to."""
    from matplotlib.ticker import NullLocator

    axes.set_xscale("log", base=2)
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_locator(NullLocator())


def round_number(value: float) -> float:
    """Return the number 1, 2 or 5 times a power of ten that is nearest in ratio to `value` > 0."""
    decade = 10.0 ** np.floor(np.log10(value))
    choices = decade * np.array([1.0, 2.0, 5.0, 10.0])
    return float(choices[np.argmin(np.abs(np.log(choices / value)))])


def round_marks(largest: float) -> np.ndarray:
    """Return at most six round numbers, evenly spaced, from 0 to the largest value or above."""
    from matplotlib.ticker import MaxNLocator

    return np.asarray(MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(0.0, largest or 1.0))


def mixed(colour: str, strength: float) -> str:
    """Return a share `strength` of a colour, the rest white."""
    from matplotlib.colors import to_hex, to_rgb

    red, green, blue = (1.0 - strength * (1.0 - part) for part in to_rgb(colour))
    return to_hex((red, green, blue))


def decimals(t: np.ndarray) -> int:
    """Return how many decimals tell the instants (n,), s, of a motion of that length: 2 or more."""
    span = np.ptp(t)
    return 2 if span == 0.0 else max(2, 2 - int(np.floor(np.log10(span))))


# -- figures and files -----------------------------------------------------------------------

# What all figures share, in Matplotlib's own words; words are text, no formulas.
DPI = 110  # px per inch
STYLE: Any = {
    "figure.dpi": DPI,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "axes.titley": 1.0,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "lines.markersize": 5.0,
    "text.parse_math": False,
}
TITLE = 12  # points, of what stands above a whole figure
WIDTH, HEIGHT, NARROW = 13.0, 16.0, 8.0  # inches: most of stacked axes, least of a figure
LEFT, RIGHT, HEAD = 0.85, 0.5, 0.5  # inches beside and above axes, for labels and the title
# Of a machine: most inches of its axes, and inches above and below them.
FRAME: Any = {"most": (7.5, 7.0), "above": 0.25, "below": 0.0, "foot": 0.85}

Drawing = TypeVar("Drawing", bound=Callable[..., Any])


def styled(draw: Drawing) -> Drawing:
    """Let a function that makes a figure draw in `STYLE`."""

    @wraps(draw)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        from matplotlib import rc_context

        with rc_context(STYLE):
            return draw(*args, **kwargs)

    return wrapped  # type: ignore[return-value]


def new_figure(width: float, height: float, *, laid_out: bool = False) -> Figure:
    """Return an empty figure, inches, that no global state knows of.

    Args:
        width, height: inches.
        laid_out: let Matplotlib place the axes.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=DPI)
    if laid_out:
        figure.set_layout_engine("constrained", w_pad=0.08, h_pad=0.08)
    FigureCanvasAgg(figure)
    return figure


def headline(figure: Figure, title: str, left: float) -> None:
    """Write as much of a title above a figure as fits; `left` of it, inches."""
    width, height = figure.get_size_inches()
    most = int(8.0 * (width - left))  # letters
    words = title if len(title) <= most else title[: max(0, most - 3)] + "..."
    figure.text(left / width, 1.0 - 0.12 / height, words, va="top", fontsize=TITLE, weight="bold")


def stacked_axes(
    boxes: Sequence[Box],
    title: str,
    *,
    above: float = 0.3,
    below: float = 0.3,
    foot: float = 0.0,
    least: float = 0.0,
    sides: tuple[float, float] = (LEFT, RIGHT),
    most: tuple[float, float] = (WIDTH - LEFT - RIGHT, HEIGHT),
) -> tuple[Figure, list[Axes]]:
    """Return a figure with axes below each other, to one scale and with one range of x.

    Args:
        boxes: lowest and highest (x, y) that each shows, in any unit of length.
        title: above them.
        above, below: room for words at each, inches.
        foot: room below all of them, inches.
        least: height of axes, inches.
        sides: room left and right of them, inches; more where the title needs it.
        most: width and height that all of them take, inches.
    """
    lows, highs = (np.array(ends, dtype=float) for ends in zip(*boxes, strict=True))
    left, right = lows[:, 0].min(), highs[:, 0].max()
    tall = (highs - lows)[:, 1]
    scale = min(most[0] / (right - left), most[1] / tall.sum())
    heights, wide = np.maximum(scale * tall, least), scale * (right - left)
    width, head = max(NARROW, wide + sum(sides)), HEAD if title else 0.0
    height = head + foot + float((heights + above + below).sum())
    figure = new_figure(width, height)
    headline(figure, title, sides[0])
    beside = sides[0] + 0.5 * (width - wide - sum(sides))
    rows, top = [], height - head
    for middle, inches in zip(0.5 * (lows + highs)[:, 1], heights, strict=True):
        top -= above + inches
        axes = figure.add_axes((beside / width, top / height, wide / width, inches / height))
        half = 0.5 * inches / scale
        axes.set(xlim=(left, right), ylim=(middle - half, middle + half))
        rows.append(axes)
        top -= below
    return figure, rows


def colour_scale(
    figure: Figure, label: str, colours: str, marks: Sequence[float] | np.ndarray
) -> None:
    """Draw a scale of colours from 0 to the last of its marks at the foot of a figure."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    width, height = figure.get_size_inches()
    axes = figure.add_axes((0.5 - 2.5 / width, 0.55 / height, 5.0 / width, 0.15 / height))
    shown = ScalarMappable(Normalize(0.0, marks[-1]), colours)
    figure.colorbar(shown, cax=axes, orientation="horizontal", ticks=marks, label=label)


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG; return its path."""
    write_atomically(path, lambda stream: figure.savefig(stream, format="png"))
    return path
