"""Parts on several processes: the same files."""

import json

import numpy as np
import pytest
from parts import frame, write_run
from runs import TWO_ARM, contents, run, shell

import dolfinopt as do

pytestmark = pytest.mark.serial  # starts ranks itself

CHANGES = ("arms.0.cells=[50, 6]", "arms.1.cells=[50, 6]", "design.projection=robust")
WORDS = ("--no-plots", "--tolerance", 5e-4)


def two_arms(path):
    """Write a run of two arms."""
    designs = (lambda x, y, at=at: frame(x, y) | (np.abs(x - at) < 0.02) for at in (0.3, 0.7))
    return write_run(path, do.load_scene(TWO_ARM, CHANGES), *designs)


@pytest.mark.slow
def test_two_ranks_write_the_same_bytes(tmp_path):
    folder = two_arms(tmp_path / "run")
    run("part", folder, "--out", tmp_path / "one", *WORDS)
    done = shell("part", folder, "--out", tmp_path / "two", *WORDS, ranks=2)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("arm1: ") == done.stdout.count("arm2: ") == 1
    here, there = (contents(tmp_path / name) for name in ("one", "two"))
    assert here.keys() == there.keys() and len(here) == 16
    assert [name for name in here if here[name] != there[name]] == []
    # The search for the level sets out from solid cells, whatever rounding does to the volume.
    rows = json.loads(here["part.json"])["arms"]
    assert [row["loops"] for row in rows.values()] == [6, 6]


def test_bad_design_ends_two_ranks_with_one_line(tmp_path):
    """The arm of the second rank is the one that no part can be made of."""
    folder = two_arms(tmp_path / "run")
    with np.load(folder / "design.npz") as data:
        arrays = dict(data)
    arrays["arm2/density"] = (np.abs(arrays["arm2/centroid"][:, 0] - 0.5) > 0.1).astype(float)
    np.savez(folder / "design.npz", **arrays)
    done = shell("part", folder, *WORDS, ranks=2)
    assert done.returncode == 2
    lines = [line for line in done.stderr.splitlines() if line.startswith("dolfinopt")]
    assert "only files of arm1" in lines[0]
    assert len(lines) == 2 and "arm 'arm2'" in lines[1] and "hang together" in lines[1]
    assert {path.stem.split("_")[0] for path in (folder / "part").glob("arm*")} == {"arm1"}
