"""What a search over shapes leaves on disk at every step, so that one that was killed can go on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.disk import read_arrays, write_arrays
from dolfinopt.errors import InputError
from dolfinopt.output.folders import prepare_folder
from dolfinopt.version import NUMERICS, __version__

if TYPE_CHECKING:
    from dolfinopt.scene.load import Scene
    from dolfinopt.scene.tables.design import Part as Asked

NAME = "shapes.npz"
Forms = Mapping[int, Mapping[str, np.ndarray]]  # arrays of the free form of every part


@dataclass(frozen=True, eq=False)
class Saved:
    """Where the search from one start is.

    Attributes:
        start: its number.
        done: steps taken.
        ending: why it ended; "" while it goes on.
        tightened: factors of limits that finer meshes have asked for.
        forms: with which it goes on.
        best: of those that a finer mesh has judged; empty before.
    """

    start: int
    done: int
    ending: str
    tightened: Mapping[str, float]
    forms: Forms
    best: Forms


@dataclass(frozen=True)
class Checkpoint:
    """The file of a search over shapes.

    Attributes:
        folder: of the parts; made with the first step.
        question: what a search must have in common with it to go on from it.
    """

    folder: Path
    question: str

    def replace(self, searches: Sequence[Saved]) -> None:
        """Write where the searches from all starts so far are."""
        told = [[one.start, one.done, one.ending, dict(one.tightened)] for one in searches]
        arrays = {"question": np.array(self.question), "searches": np.array(json.dumps(told))}
        for one in searches:
            for kind, forms in (("forms", one.forms), ("best", one.best)):
                for k, form in forms.items():
                    arrays |= {f"{one.start}/{kind}/{k}/{name}": a for name, a in form.items()}
        prepare_folder(self.folder)
        write_arrays(self.folder / NAME, arrays)

    def read(self) -> tuple[Saved, ...]:
        """Return where the searches were.

        Raises:
            InputError: there is no checkpoint, or one of another question.
        """
        path, remedy = self.folder / NAME, "start without --resume"
        if not path.exists():
            raise InputError(f"{path}: --resume finds no shapes here; {remedy}")
        arrays = read_arrays(path, remedy)
        if str(arrays.get("question")) != self.question:
            raise InputError(f"{path}: --resume: of another design, or other options; {remedy}")

        def forms(start: int, kind: str) -> Forms:
            found: dict[int, dict[str, np.ndarray]] = {}
            for key, array in arrays.items():
                if key.startswith(f"{start}/{kind}/"):
                    _, _, k, name = key.split("/", 3)
                    found.setdefault(int(k), {})[name] = array
            return found

        return tuple(
            Saved(start, done, ending, tightened, forms(start, "forms"), forms(start, "best"))
            for start, done, ending, tightened in json.loads(str(arrays["searches"]))
        )

    def remove(self) -> None:
        """Remove the file: the search has come to its end."""
        (self.folder / NAME).unlink(missing_ok=True)


def of_search(folder: Path, run: Path, scene: Scene, asked: Asked) -> Checkpoint:
    """Return the checkpoint of a search.

    Args:
        folder: of the parts.
        run: folder of the densities.
        scene: of the run.
        asked: of the parts; steps and starts may be others when it goes on.
    """
    file = run / "design.npz"
    design = hashlib.blake2b(
        file.read_bytes() if file.exists() else b"", digest_size=16
    ).hexdigest()
    curves = asked.model_dump(include={"tool_radius", "tolerance", "curves", "minimum_member"})
    told = [__version__, NUMERICS, design, scene.to_dict(), curves]
    return Checkpoint(folder, json.dumps(told, sort_keys=True))
