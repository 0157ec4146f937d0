"""The parametric meshes that come with the package, wherever it is installed."""

from pathlib import Path


def mesh_folder() -> Path:
    """Return the folder of the parametric meshes (`*.geo`).

    In a source tree it is a link to the folder `meshes` next to the package.
    """
    return Path(__file__).parent / "meshes"
