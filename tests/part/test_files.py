"""Files of parts, read by others."""

import errno
import json
import shutil
import xml.etree.ElementTree as ElementTree

import click
import numpy as np
import pytest
from browser import browser, open_browser
from mpi4py import MPI
from parts import folder_with, frame, write_run
from PIL import Image
from runs import TWO_ARM, contents, refused, run, shell, summary_of

import dolfinopt as do
from dolfinopt.data import mesh_folder
from dolfinopt.errors import InputError, OutputError
from dolfinopt.mesh.arm_mesh import arm_mesh
from dolfinopt.mesh.gmsh_session import gmsh_on_root
from dolfinopt.output.folders import remove_stale_parts, stale_parts

pytestmark = pytest.mark.serial

BORES = mesh_folder() / "arm_bores.geo"
PLAIN = ("--no-plots", "--no-check")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folder of parts of a rectangular arm, and of one with bores."""
    base = tmp_path_factory.mktemp("parts")
    run("part", folder_with(base / "plain", frame), *PLAIN)

    def bored(x, y):
        return frame(x, y) | (np.minimum(x, 1.0 - x) < 0.05)

    changes = [f"arms.0.mesh={BORES}", "arms.0.mesh_size=0.006", "arms.0.symmetric=true"]
    run("part", folder_with(base / "bores", bored, *changes), *PLAIN)
    return {name: base / name / "part" for name in ("plain", "bores")}


@pytest.fixture(params=["plain", "bores"])
def part(request, made):
    folder = made[request.param]
    return folder, json.loads((folder / "part.json").read_text())["arms"]["arm1"]


def bores_of(part):
    return 2 if "bores" in str(part[0]) else 0


def test_folder_is_complete(part):
    names = {path.name for path in part[0].iterdir()}
    assert "table" not in json.loads((part[0] / "part.json").read_text())  # without a check
    kinds = (".step", "_face.step", ".dxf", "_r12.dxf", ".svg", ".stl", ".msh")
    assert names == {"part.json", "part.toml", *(f"arm1{kind}" for kind in kinds)}


def test_step_is_one_solid_of_the_volume(part):
    folder, figures = part
    with gmsh_on_root(MPI.COMM_SELF) as gmsh:
        gmsh.option.setString("Geometry.OCCTargetUnit", "MM")
        gmsh.open(str(folder / "arm1.step"))
        ((_, solid),) = gmsh.model.getEntities(3)
        volume = gmsh.model.occ.getMass(3, solid)
        low, high = np.reshape(gmsh.model.getBoundingBox(3, solid), (2, 3))
        plane = [face for face in gmsh.model.getEntities(2) if _is_end(gmsh, face)]
        loops = [_loops(gmsh, face) for face in plane]
    assert volume == pytest.approx(1e9 * figures["volume"], rel=1e-6)
    # The file is accurate to 1e-5 mm, by which Open CASCADE widens the box.
    assert (low[2], high[2]) == pytest.approx((0.0, 10.0), abs=2e-5)
    assert loops == [figures["loops"]] * 2
    text = (folder / "arm1.step").read_text()
    assert "PRODUCT('arm1'" in text and text.count("MANIFOLD_SOLID_BREP(") == 1


def _is_end(gmsh, face):
    low, high = np.reshape(gmsh.model.getBoundingBox(*face), (2, 3))
    return high[2] - low[2] < 1e-3


def _loops(gmsh, face):
    """Count the closed loops around a face."""
    follows = {}
    for curve in gmsh.model.getBoundary([face], oriented=False):
        ends = gmsh.model.getBoundary([curve], oriented=False)
        tags = [tag for _, tag in ends] or [-curve[1]]
        for tag in tags:
            follows.setdefault(tag, set()).update(tags)
    count = 0
    while follows:
        ahead = [next(iter(follows))]
        count += 1
        while ahead:
            ahead += [tag for tag in follows.pop(ahead.pop(), ()) if tag in follows]
    return count


def test_face_is_an_arm_again(part):
    folder, figures = part
    scene = do.load_scene(folder / "part.toml")
    assert scene.arms[0].mesh == str(folder / "arm1.msh")
    assert scene.arms[0].element == "quadratic" and scene.design.radius == 0.0
    as_step = {"mesh": str(folder / "arm1_face.step"), "mesh_size": 0.003}
    for keys, off in (({}, 3e-4), (as_step | {"cell_shape": "triangle"}, 3e-3)):  # straight cells
        arm = arm_mesh(MPI.COMM_SELF, scene.arms[0].unchecked_copy(keys))
        assert arm.area.sum() == pytest.approx(figures["area"], rel=off)
        assert len(arm.inboard_facets) > 4 and len(arm.outboard_facets) > 4
        assert arm.notes == ()
    text = (folder / "arm1_face.step").read_text()
    assert text.count("EDGE_CURVE('inboard'") == text.count("EDGE_CURVE('outboard'") == 1


@pytest.mark.parametrize("name", ["arm1.dxf", "arm1_r12.dxf"])
def test_dxf_is_clean_and_has_two_layers(part, name):
    import ezdxf
    from ezdxf.math import area
    from ezdxf.path import make_path

    folder, figures = part
    document = ezdxf.readfile(folder / name)
    audit = document.audit()
    assert not audit.errors and not audit.fixes
    model = document.modelspace()
    layers = {"outline", "holes"} | ({"bores"} if bores_of(part) else set())
    assert {entity.dxf.layer for entity in model} == layers
    circles = [one for one in model.query("CIRCLE") if one.dxf.layer == "bores"]
    assert [c.dxf.radius for c in circles] == pytest.approx([10.0] * bores_of(part), abs=1e-6)
    if name == "arm1.dxf":
        assert document.dxfversion == "AC1024"
        assert document.header["$INSUNITS"] == 4  # mm
        assert len(model) == figures["curves"]
        assert not model.query("SPLINE")
    else:
        assert document.dxfversion == "AC1009"
        assert {entity.dxftype() for entity in model} <= {"POLYLINE", "CIRCLE"}
        assert len(model) == figures["loops"]
        areas = [area(list(make_path(one).flattening(1e-3))) for one in model]
        assert 2.0 * max(areas) - sum(areas) == pytest.approx(1e6 * figures["area"], rel=1e-3)


def test_stl_is_watertight(part):
    trimesh = pytest.importorskip("trimesh")
    folder, figures = part
    body = trimesh.load(folder / "arm1.stl")
    assert body.is_watertight and body.is_winding_consistent and body.volume > 0.0
    assert body.volume == pytest.approx(1e9 * figures["volume"], rel=2e-3)  # chords
    assert body.body_count == 1


def test_svg_is_to_scale(part):
    folder, figures = part
    root = ElementTree.parse(folder / "arm1.svg").getroot()
    space = "{http://www.w3.org/2000/svg}"
    assert root.tag == f"{space}svg" and root.attrib["width"].endswith("mm")
    left, _, width, _ = map(float, root.attrib["viewBox"].split())
    assert width == pytest.approx(float(root.attrib["width"][:-2]), rel=1e-5)
    assert left < 0.0 and left + width > 1000.0
    path = root.find(f"{space}path").attrib["d"]
    assert path.count("M ") == path.count("Z") == figures["loops"]


def test_browser_draws_the_svg(part, tmp_path):
    if browser() is None:
        pytest.skip("no browser on this machine")
    folder, figures = part
    with open_browser(tmp_path / "profile") as page:
        page.open(folder / "arm1.svg", 4000, 320)  # 96 px are 25.4 mm
        page.value("document.querySelector('path').setAttribute('stroke', 'none')")
        page.photograph(tmp_path / "arm.png")
        assert page.complaints() == []
    shown = np.asarray(Image.open(tmp_path / "arm.png").convert("L"), dtype=float)
    covered = (255.0 - shown).sum() / (255.0 - shown.min())
    assert covered * (25.4 / 96.0) ** 2 == pytest.approx(1e6 * figures["area"], rel=5e-3)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--tolerance", "5e-8"], "--tolerance = 5e-08 m: expected a length of at least 1e-07 m"),
        (["--tolerance", "nan"], "--tolerance = nan m: expected a length"),
        (["--tolerance", "0.5"], "expected at most a cell of arm 'arm1'"),
        (["--tool-radius", "-1"], "--tool-radius = -1 m: expected a length of at least 0 m"),
        (["--iterations", "2"], "--iterations: limits --optimize, which is not asked for"),
        (["--tool-radius", "0.04"], "the tool is as wide as arm 'arm1', which is 0.06 m high"),
    ],
)
def test_bad_values_are_refused(tmp_path, words, reason):
    folder = folder_with(tmp_path / "run", frame)
    with refused(reason):
        run("part", folder, "--no-plots", *words)
    assert not (folder / "part").exists()


def test_parts_of_another_design(tmp_path, capsys):
    """A new design takes its folder's old parts away; those elsewhere are told when read."""
    folder, other = folder_with(tmp_path / "run", frame), tmp_path / "other"
    run("part", folder, *PLAIN)
    run("part", folder, *PLAIN, "--out", other)
    (folder / "part" / "note.txt").write_text("mine")
    assert stale_parts(folder / "part") == stale_parts(other) == ""
    assert remove_stale_parts(folder, folder / "design.npz") == ""
    with np.load(folder / "design.npz") as data:
        arrays = {key: 0.5 * value if "density" in key else value for key, value in data.items()}
    np.savez(folder / "design.npz", **arrays)
    small = ["--set", "simulation.tolerance=1e-1", "--set", "motion.horizon=1.9", "--no-plots"]
    run("simulate", other / "part.toml", *small, "--out", tmp_path / "simulated")
    told = capsys.readouterr().err
    assert f"warning: {other}: parts of another design than {folder / 'design.npz'}" in told
    assert f"dolfinopt part {folder} --overwrite" in told
    run("simulate", other / "part.toml", *small, "--out", folder, "--overwrite")
    assert "removed, its parts were of another design" in capsys.readouterr().err
    assert [path.name for path in (folder / "part").iterdir()] == ["note.txt"]


def test_parts_do_not_replace_what_their_scene_reads(tmp_path):
    """--overwrite would delete the mesh of the arm."""
    (tmp_path / "out").mkdir()
    mesh = shutil.copy(BORES, tmp_path / "out" / "bar.geo")
    folder = folder_with(tmp_path / "run", frame, f"arms.0.mesh={mesh}", "arms.0.mesh_size=0.02")
    summary = summary_of(folder)
    mesh.rename(mesh.with_name("arm1.step"))
    summary["scene"]["arms"][0]["mesh"] = str(mesh.with_name("arm1.step"))
    (folder / "summary.json").write_text(json.dumps(summary))
    with pytest.raises(InputError, match=r"arm1\.step: the scene reads this file \(arms\.0\.mesh"):
        run("part", folder, *PLAIN, "--out", tmp_path / "out", "--overwrite")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["arm1.step"]


def test_folder_without_a_design_is_refused(tmp_path):
    done = shell("part", tmp_path)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "summary.json: cannot be read" in done.stderr
    folder = folder_with(tmp_path / "run", frame)
    (folder / "design.npz").unlink()
    with pytest.raises(InputError, match=r"design\.npz: no design there"):
        run("part", folder)


def test_used_folder_is_refused(made):
    with pytest.raises(InputError, match=r"holds results already.*--overwrite"):
        run("part", made["plain"].parent, "--no-plots")


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("checkpoint.npz", r"not come to its end: go on with .*optimize SCENE --out .* --resume"),
        ("cases/key", "this is a study: name the folder of one of its cases"),
        ("note.txt", "name the folder of a finished optimize or simulate run"),
    ],
)
def test_folder_without_a_run_says_what_to_name(tmp_path, name, reason):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError, match=reason):
        run("part", tmp_path)


def test_damaged_design_is_refused(tmp_path):
    """What other commands read of designs is tested with them; parts ask for more."""
    folder = folder_with(tmp_path / "run", frame)
    with np.load(folder / "design.npz") as data:
        arrays = dict(data) | {"arm1/filtered": np.full(2400, np.nan)}
    np.savez(folder / "design.npz", **arrays)
    with pytest.raises(InputError, match="2400 finite numbers"):
        run("part", folder)
    assert not (folder / "part").exists()


def test_files_are_there_all_or_none(tmp_path, monkeypatch):
    """What a killed command has left goes; a disk that is full leaves no part.json."""
    from dolfinopt.part import folder as files

    made, folder = tmp_path / "made", tmp_path / "part"
    names = ["part.json", "part.toml", "arm1.svg"]
    for place in (made, folder / ".part-left"):
        place.mkdir(parents=True)
        for name in names:
            (place / name).write_text(str(place))
    files.publish(made, folder, names, {"name": "a"}, None)
    found = {path.name: path.read_text() for path in folder.iterdir()}
    assert json.loads(found.pop("part.json")) == {"name": "a", "files": sorted(names)}
    assert found == dict.fromkeys(names[1:], str(made))

    def full(source, target):
        if target.name == "part.toml":
            raise OSError(errno.ENOSPC, "No space left on device")
        replace(source, target)

    replace = files.os.replace
    monkeypatch.setattr(files.os, "replace", full)
    with pytest.raises(OutputError, match="No space left"):
        files.publish(made, folder, names, {}, None)
    assert [path.name for path in folder.iterdir()] == ["arm1.svg"]


def test_interrupted_command_leaves_what_was_there(tmp_path, monkeypatch):
    folder = folder_with(tmp_path / "run", frame)
    (folder / "part").mkdir()
    (folder / "part" / "note.txt").write_text("mine")

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("dolfinopt.part.plane.part.solid_text", interrupted)
    with pytest.raises(click.Abort):
        run("part", folder, "--no-plots", "--no-check")
    assert [path.name for path in (folder / "part").iterdir()] == ["note.txt"]


# -- parts on several processes: the same files  --------------------------------------------------


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
    assert len(lines) == 1 and "arm 'arm2'" in lines[0] and "hang together" in lines[0]
    assert not (folder / "part").exists()  # nor files of the other arm
