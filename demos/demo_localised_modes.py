"""Spurious local modes of classic SIMP: the windows of a frame, almost void, vibrate on their own.

A solid frame with windows of density 0.001 (the scene's design.minimum) or 0.01, under every
interpolation law; one arm, which one rank does:

    python demos/demo_localised_modes.py
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from mpi4py import MPI

import dolfinopt as do
from dolfinopt.density.interpolation import LAWS, SWITCH

HERE = Path(__file__).parent
VOIDS = (1e-3, 1e-2)  # physical density of the windows
MODES = 6
DRAWN = 3  # modes in the picture
POSTS = (0.0, 0.12, 0.27, 0.45, 0.68, 1.0)  # m, windows of different lengths
POST, FLANGE = 0.013, 0.02  # m: half a post's width, and where the flanges begin

SOLID, VOID, GRID = "#1f5a99", "#fdf6d8", "#999999"


@dataclass(frozen=True)
class Spectrum:
    """The lowest modes of the frame under one law.

    Attributes:
        law, void: of this spectrum.
        frequency: (modes,) Hz, clamped-free with a rigid outboard interface.
        strain, kinetic: (modes,) shares of the energies in cells with density below 0.1.
        x_phys: (n_cells,) the frame.
        corners: (n_cells, 4, 2) of the cells, in order around each, m.
        shapes: (modes, n_cells, 4, 2) their displacements.
    """

    law: str
    void: float
    frequency: np.ndarray
    strain: np.ndarray
    kinetic: np.ndarray
    x_phys: np.ndarray
    corners: np.ndarray
    shapes: np.ndarray

    @property
    def local(self) -> np.ndarray:
        """Which modes (modes,) have most of both energies where there is next to no material."""
        return (self.strain > 0.5) & (self.kinetic > 0.5)


def main(
    folder: Path = Path("results/demo_localised_modes"),
    cells: tuple[int, int] = (200, 12),
    voids: Sequence[float] = VOIDS,
) -> list[Spectrum]:
    """Compute, print and draw the spectra of all laws on the root; return them there."""
    if MPI.COMM_WORLD.rank > 0:
        return []
    spectra = [spectrum(law, void, cells) for void in voids for law in LAWS]
    print("void   law           frequency [Hz] (share of the strain energy below x = 0.1)")
    for one in spectra:
        modes = (f"{f:6.1f} ({s:4.0%})" for f, s in zip(one.frequency, one.strain))
        print(f"{one.void:<6g} {one.law:<13}", *modes)
    folder.mkdir(parents=True, exist_ok=True)
    draw(folder / "localised_modes.png", [one for one in spectra if one.void == voids[0]])
    print(f"picture in {folder}")
    return spectra


def frame(centroid: np.ndarray, void: float) -> np.ndarray:
    """Return the densities (n_cells,) of a frame: flanges along the arm, posts across it."""
    x, y = centroid.T
    to_post = np.abs(x[:, None] - np.array(POSTS)).min(axis=1)
    return np.where((np.abs(y) > FLANGE) | (to_post < POST), 1.0, void)


def spectrum(law: str, void: float, cells: tuple[int, int]) -> Spectrum:
    """Return the lowest modes of the frame under `law`, and where their energies are."""
    overrides = [
        f"interpolation.law={law}",
        "reduction.method=modal",
        f"reduction.coordinates={MODES}",
        f"arms.cells=[{cells[0]}, {cells[1]}]",
    ]
    scene = do.load_scene(HERE / "two_arm.toml", overrides)
    arm = do.Arm(scene, 0, MPI.COMM_SELF, do.Profile())
    x_phys = frame(arm.mesh.centroid, void)
    body = arm.reduce(x_phys)  # of modes with unit modal mass
    assert arm.basis is not None
    strain, kinetic = np.empty(MODES), np.empty(MODES)
    for k in range(MODES):
        mode = arm.basis.V[:, :, [k]]
        stiff = arm.current.material.stiffness * arm.elastic.cell_stiffness_products(mode, mode)
        heavy = arm.current.material.mass * arm.elastic.cell_mass_products(mode, mode)
        strain[k] = stiff[x_phys < SWITCH].sum() / stiff.sum()
        kinetic[k] = heavy[x_phys < SWITCH].sum() / heavy.sum()
    around = arm.elastic.operators.cells[:, [0, 1, 3, 2]]  # from the order of a tensor product
    return Spectrum(
        law,
        void,
        np.sqrt(np.diag(body.K)) / (2.0 * np.pi),
        strain,
        kinetic,
        x_phys,
        arm.elastic.points[around],
        np.moveaxis(arm.basis.V[around], 3, 0),
    )


def draw(path: Path, spectra: Sequence[Spectrum]) -> None:
    """Draw the lowest modes, a row for each law, with a grid over the windows."""
    figure = Figure(figsize=(4.2 * DRAWN, 1.55 * len(spectra)), layout="constrained")
    grid = figure.subplots(len(spectra), DRAWN, sharex=True, sharey=True, squeeze=False)
    for row, one in zip(grid, spectra, strict=True):
        row[0].set_ylabel(f"{one.law}\ny [mm]")
        for k, axes in enumerate(row):
            # Modes have no size: 15 mm at most, of an arm 60 mm high, and up at the free end.
            largest = np.linalg.norm(one.shapes[k], axis=2).max()
            sign = np.sign(one.shapes[k, one.corners[:, 1, 0].argmax(), 1, 1]) or 1.0
            place = one.corners + sign * 0.015 / largest * one.shapes[k]
            face = np.where(one.x_phys < SWITCH, VOID, SOLID)
            edge = np.where(one.x_phys < SWITCH, GRID, SOLID)  # shows how the void moves
            axes.add_collection(
                PolyCollection(place * [1.0, 1e3], facecolors=face, edgecolors=edge, linewidths=0.3)
            )
            axes.set_title(
                f"mode {k + 1}: {one.frequency[k]:.1f} Hz, {one.strain[k]:.0%} of the strain "
                "energy in the void",
                fontsize=9,
                color="#d95f02" if one.local[k] else "black",
            )
            axes.set_xlim(-0.02, 1.04)
            axes.set_ylim(-50.0, 50.0)
    for axes in grid[-1]:
        axes.set_xlabel("x [m]")
    figure.suptitle(
        f"Lowest modes of a solid frame (blue) whose windows (cells drawn) have physical density "
        f"{spectra[0].void:g}; displacements scaled to 15 mm",
        fontsize=11,
    )
    figure.savefig(path, dpi=100)


if __name__ == "__main__":
    with do.abort_together(MPI.COMM_WORLD):
        main()
