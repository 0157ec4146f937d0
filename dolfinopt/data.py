"""What comes with the package wherever it is installed: meshes, the paper's scene, its page."""

from pathlib import Path


def mesh_folder() -> Path:
    """Return the folder of the parametric meshes (`*.geo`).

    In a source tree it is a link to the folder `meshes` next to the package.
    """
    return Path(__file__).parent / "meshes"


def paper_scene() -> Path:
    """Return the paper's two-arm manipulator.

    In a source tree it is a link to `demos/two_arm.toml`.
    """
    return Path(__file__).parent / "paper" / "two_arm.toml"


def template_folder() -> Path:
    """Return the folder of the scenes that `dolfinopt init` starts from."""
    return Path(__file__).parent / "scene" / "templates"


def page_folders() -> tuple[Path, ...]:
    """Return the folders of the templates of HTML pages: of all pages, and of report.html."""
    here = Path(__file__).parent
    return here / "study" / "pages", here / "paper" / "pages"


def benchmark_folder() -> Path:
    """Return the folder of the published problems and their reference values.

    In a source tree it is a link to the folder `benchmarks` next to the package.
    """
    return Path(__file__).parent / "benchmarks"
