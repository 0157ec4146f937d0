"""Folders of results: one run each. What an earlier run left is never mixed with a new one."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dolfinopt.disk import FULL, make_folder, unwritten, working_in, write_bytes, writing
from dolfinopt.errors import InputError
from dolfinopt.interrupt import interrupted_later
from dolfinopt.scene.load import Scene
from dolfinopt.scene.schema import file_digest, named_files

if TYPE_CHECKING:
    from mpi4py import MPI


CHECKPOINT = "checkpoint.npz"


# All files that a run writes, the one that says a run is complete first; nothing else is removed.
RUN_FILES = (
    "summary.json",
    "history.csv",
    "trajectory.npz",
    "trajectory.csv",
    "feed_forward.csv",
    "budget.csv",
    "design.npz",
    "design.xdmf",  # of earlier versions
    "design.vtu",
    "design.png",
    "history.png",
    "limits.png",
    "deviation.png",
    "drives.png",
    "law.png",
    "motion.gif",
    "machine.png",
    "stress.png",
    CHECKPOINT,
)


# The parts of a run's design, and the file there that lists them.
PARTS, PARTS_LIST = "part", "part.json"
WRITTEN = ".results"  # folder of results until all are written


def prepare_folder(folder: Path) -> None:
    """Create the output folder and make sure that it can be written.

    Raises:
        InputError: it cannot.
        OutputError: the disk is full.
    """
    probe = folder / f".write-test-{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        reason = unwritten(folder, error)
        raise reason if error.errno in FULL else InputError(str(reason)) from None


@contextmanager
def working_alone(
    world: MPI.Comm, folder: Path, check: Callable[[], object] | None = None
) -> Iterator[None]:
    """Keep other runs out of a folder until the block ends; create it first (collective).

    A new folder in which nothing is then goes.

    Args:
        world: all ranks.
        folder: of the run.
        check: on the root once no other run can write there any more.

    Raises:
        InputError: another run works there, or it cannot be written; what `check` raises.
    """
    from dolfinopt.parallel import on_root

    def leave() -> None:
        with suppress(OSError):
            folder.rmdir()

    with ExitStack() as held:

        def enter() -> None:
            if not folder.exists():
                held.callback(leave)
            prepare_folder(folder)
            held.enter_context(working_in(folder))
            if check is not None:
                check()

        on_root(world, enter)
        yield


def check_sources(folder: Path, names: Iterable[str], scene: Scene) -> None:
    """Raise InputError if results would replace a file that the scene reads."""
    written = {(folder / name).resolve() for name in names}
    for key, row, name in named_files(scene.to_dict()):
        if Path(row[name]).resolve() in written:
            raise InputError(
                f"{row[name]}: the scene reads this file ({key}), and the results would replace "
                "it; name another --out"
            )


def check_unused(folder: Path, names: Collection[str] = RUN_FILES, *, resume: str = "") -> None:
    """Raise InputError if the folder holds a file of these names.

    Args:
        folder: need not exist.
        names: what the command would write.
        resume: file with which the command's option --resume goes on; "" where there is none.
    """
    result = [name for name in names if (folder / name).exists()]
    if result:
        more = f" and {len(result) - 1} more files" if len(result) > 1 else ""
        others = "--resume to go on, " if resume and (folder / resume).exists() else ""
        raise InputError(
            f"{folder}: holds results already ({result[0]}{more}); {others}--overwrite to replace "
            "them, or another --out"
        )


def remove_stale(folder: Path, names: Iterable[str] = RUN_FILES) -> None:
    """Remove what an earlier run left; other files stay.

    Raises:
        InputError: a file cannot be removed.
    """
    for name in names:
        try:
            with suppress(FileNotFoundError):
                (folder / name).unlink()
        except OSError as error:
            raise InputError(
                f"{folder / name}: cannot be replaced ({error.strerror}); name another --out"
            ) from None


@contextmanager
def written_together(folder: Path, last: str = RUN_FILES[0]) -> Iterator[Path]:
    """Yield a folder for files that get into `folder` together at the end, or not at all.

    One is the last, by default the summary. Ctrl-C waits while they get their places.

    Raises:
        OutputError: the disk is full, for instance.
    """
    place = folder / WRITTEN
    shutil.rmtree(place, ignore_errors=True)  # of a run that was killed
    make_folder(place)
    try:
        yield place
        paths = sorted(place.iterdir(), key=lambda path: path.name == last)
        with interrupted_later(), writing(folder):
            for path in paths:
                os.replace(path, folder / path.name)
    finally:
        shutil.rmtree(place, ignore_errors=True)


def check_new(files: Iterable[Path], hint: str = "") -> None:
    """Raise InputError if one of the files exists; `hint` ends the message."""
    for path in files:
        if path.exists():
            raise InputError(
                f"{path}: exists already and stays as it is; give another name or folder{hint}"
            )


def write_files(folder: Path, files: Mapping[str, str | bytes]) -> None:
    """Write files, which get into the folder together, the last of all the last.

    Raises:
        InputError: the folder cannot be written.
    """
    prepare_folder(folder)
    with written_together(folder, [*files][-1]) as place:
        for name, content in files.items():
            write_bytes(place / name, content if isinstance(content, bytes) else content.encode())


def record_of_parts(design: Path | None, folder: Path, files: Iterable[str]) -> dict[str, Any]:
    """Return the entries of part.json that tell the files, and the design they were made of."""
    record: dict[str, Any] = {"files": sorted(files)}
    if design is not None:
        place = Path(os.path.relpath(design, folder.absolute())).as_posix()
        record["design"] = {"file": place, "sha256": file_digest(design)}
    return record


def stale_parts(folder: Path, now: Path | None = None) -> str:
    """Return why a folder's parts are not those of the design beside them; "" if they may be.

    `now` is the file of a design that is to take that one's place.
    """
    made_of = read_record(folder / PARTS_LIST).get("design")
    if not isinstance(made_of, dict) or not isinstance(made_of.get("file"), str):
        return ""
    design = Path(os.path.normpath(folder / made_of["file"]))
    now = now or design
    if not now.is_file() or file_digest(now) == made_of.get("sha256"):
        return ""
    return (
        f"{folder}: parts of another design than {design} holds now; make them anew: dolfinopt "
        f"part {design.parent} --overwrite"
    )


def remove_stale_parts(run: Path, design: Path) -> str:
    """Remove a run's parts unless they are of its new design; return what was done."""
    folder = run / PARTS
    if not stale_parts(folder, design):
        return ""
    remove_stale(folder, [PARTS_LIST, *listed_files(folder / PARTS_LIST)])
    with suppress(OSError):  # something of the user's is in it
        folder.rmdir()
    return f"{folder}: removed, its parts were of another design; new ones: dolfinopt part {run}"


def listed_files(record: Path) -> list[str]:
    """Return the names of the files that a record lists, all of its own folder."""
    names = read_record(record).get("files", [])
    return [name for name in names if isinstance(name, str) and Path(name).name == name]


def read_record(path: Path) -> dict[str, Any]:
    """Return the content of a JSON file, nothing if it holds no table."""
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}
