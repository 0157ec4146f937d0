"""Comparison of pictures with ones that were looked at."""

from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.testing.compare import compare_images
from matplotlib.testing.decorators import remove_ticks_and_titles

TOLERANCE = 3.0  # RMS of 255: antialiasing differs; a curve that is 1 % off is above


def bare(figure: Figure, path: Path) -> Path:
    """Write a figure without its words, which depend on fonts, 50 px per inch; return its path."""
    remove_ticks_and_titles(figure)
    figure.set_layout_engine("none")
    for axes in figure.axes:
        axes.set(xlabel="", ylabel="")
    for text in [*figure.texts, *(text for axes in figure.axes for text in axes.texts)]:
        text.remove()
    figure.savefig(path, dpi=50)
    return path


def difference(expected: Path, figure: Figure, folder: Path) -> float:
    """Return the RMS by which a figure differs from a picture, 0 below the tolerance."""
    drawn = bare(figure, folder / expected.name)
    found = compare_images(str(expected), str(drawn), TOLERANCE, in_decorator=True)
    return float(found["rms"]) if found else 0.0
