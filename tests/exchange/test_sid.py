"""Standard input data: the text file as other programs write it, round trips, damaged files."""

import io
import re
from contextlib import redirect_stdout
from dataclasses import fields

import numpy as np
import pytest
from bodies import beam
from hypothesis import strategies as st
from mpi4py import MPI
from readers import check_npz, read_as_mbdyn_does
from runs import ROOT, overrides, refusal, run, tomllib

import dolfinopt as do
from dolfinopt.errors import InputError
from dolfinopt.exchange.in_space import in_space
from dolfinopt.exchange.standard_input import load_body, to_sid
from dolfinopt.loading import doubts_of_files
from dolfinopt.multibody.shape_integrals import rigid_bar
from dolfinopt.scene.sid import (
    Node,
    Taylor,
    read_sid,
    write_sid,
)

# A bar of 3 kg and 2 m that swings about its end by v = (x / 2)^2 q in the manner of FEMBS, by
# hand: Fortran's exponents, ragged columns, zeros left out, half of a symmetric matrix.
BAR = """    2    2    :No. nodes, No. modes:a bar
 part
      new modal                                 =
           refmod
                mass                            = 3.00000000000D+00
                nelastq                         =   2
                ielastq (   1)                  =Eigen Mode    1 :        1.135 Hz
                ielastq (   2)                  = Eigen Mode    2 :        2.557 Hz
           end refmod
           frame
                new node                        =       17
                     rframe                     = body ref
                     origin
                          order                 =   1
                          nrow                  =   3
                          ncol                  =   1
                          nq                    =   2
                          nqn                   =   0
                          structure             =   0
                     end origin
                     {nodal}
                end node
           end frame
           {matrices}
      end modal
 end part
"""


def block(name, order, nrow, ncol, structure, *entries):
    lines = [name, f"order = {order}", f"nrow = {nrow}", f"ncol={ncol}", "nq = 2", "nqn = 0"]
    return "\n".join([*lines, f"structure = {structure}", *entries, f"end {name}"])


NODAL = [
    block("phi", 0, 3, 2, 3, "m0( 2, 1)             = 1.00000000000D+00", "m0(2,2)=-.5D-1"),
    block("psi", 0, 3, 2, 3, "m0( 3, 1)             = 1.00000000000D+00"),
    block("AP", 1, 3, 3, 4, "m1( 1, 1, 2)          =-1.0D+00", "m1( 2, 1, 1)          = 1.0D+00"),
]
BLOCKS = [
    block("mdCM", 1, 3, 1, 3, "m0( 1, 1) = 3.0D+00", "m1( 2, 1, 1) = 1.0D+00"),
    block("J", 1, 6, 1, 3, "m0(2,1) = 4.D+00", "m0(3,1) = 4.0D0", "m1( 4, 1, 1) = -1.5e+00"),
    block("Ct", 0, 2, 3, 3, "m0( 1, 2) = 1.0D+00"),
    block("Cr", 1, 2, 3, 3, "m0( 1, 3) = 1.5D+00", "m1( 1, 2, 3) = 0.25", "m1( 2, 1, 3) =-0.25"),
    block("Me", 0, 2, 2, 4),
    block("Gr", 0, 3, 6, 3, "m0( 3, 6) = 0.125"),
    block("Ge", 0, 2, 6, 3, "m0( 1, 6) = 0.5"),
    block("Oe", 1, 2, 6, 3, "m1( 1, 1, 3) = -1.0D+00", "m1( 2, 2, 3) = -1.0D+00"),
    block("ksigma", 0, 2, 1, 0),
    block("Ke", 0, 2, 2, 2, "m0( 1, 1) = 50.0", "m0( 2, 1) = 3.0D-01", "m0( 2, 2) = 2.6D+02"),
    block("De", 0, 2, 2, 1, "m0( 1, 1) = 0.5", "m0( 2, 2) = 0.75"),
]


def bar(blocks=BLOCKS, nodal=NODAL):
    return BAR.format(nodal="\n".join(nodal), matrices="\n".join(blocks))


def read(tmp_path, text):
    (tmp_path / "bar.SID_FEM").write_text(text)
    return read_sid(tmp_path / "bar.SID_FEM")


def bits(data):
    """Return everything the data hold, arrays as bytes with their shapes."""

    def of(value):
        if isinstance(value, Taylor):
            numbers = (value.order, value.structure, value.nqn)
            arrays = (value.M0, value.M1)
            return numbers, [(a.shape, np.ascontiguousarray(a).tobytes()) for a in arrays]
        if isinstance(value, Node):
            return [of(getattr(value, f.name)) for f in fields(value)]
        return value if not isinstance(value, tuple) else [of(v) for v in value]

    return {f.name: of(getattr(data, f.name)) for f in fields(data)}


def matrix(*shape, **entries):
    """Return a matrix with entries such as r12=3.0, counted from one."""
    out = np.zeros(shape)
    for place, value in entries.items():
        out[tuple(int(digit) - 1 for digit in place[1:])] = value
    return out


@pytest.mark.serial
def test_a_file_in_the_manner_of_fembs(tmp_path):
    data = read(tmp_path, bar())
    assert data.mass == 3.0 and data.num_modes == 2 and data.comment == "a bar"
    assert data.names == ("Eigen Mode    1 :        1.135 Hz", "Eigen Mode    2 :        2.557 Hz")
    [node] = data.nodes
    assert (node.name, node.rframe, node.sigma) == ("17", "body ref", None)
    expected = {
        "mdCM": (matrix(3, 1, r11=3.0), matrix(3, 2, 1, r211=1.0)),
        "J": (matrix(6, 1, r21=4.0, r31=4.0), matrix(6, 2, 1, r411=-1.5)),
        "Cr": (matrix(2, 3, r13=1.5), matrix(2, 2, 3, r123=0.25, r213=-0.25)),
        "Me": (np.eye(2), matrix(2, 2, 2)),  # structure 4: the unit matrix, without entries
        "Oe": (matrix(2, 6), matrix(2, 2, 6, r113=-1.0, r223=-1.0)),
        "Ke": (np.array([[50.0, 0.3], [0.3, 260.0]]), matrix(2, 2, 2)),  # the half left out
    }
    for name, (M0, M1) in expected.items():
        assert np.array_equal(getattr(data, name).M0, M0), name
        assert np.array_equal(getattr(data, name).M1, M1), name
    assert [getattr(data, name).order for name in expected] == [1, 1, 1, 0, 1, 0]
    assert np.array_equal(node.phi.M0, matrix(3, 2, r21=1.0, r22=-0.05))
    assert np.array_equal(node.psi.M0, matrix(3, 2, r31=1.0))
    assert np.array_equal(node.AP.M0, np.eye(3))
    assert np.array_equal(node.AP.M1, matrix(3, 2, 3, r112=-1.0, r211=1.0))
    assert np.array_equal(node.origin.M1, np.zeros((3, 2, 1)))
    # Evaluated: J_xy = -1.5 q_1, mdCM = (3, q_1, 0).
    q = np.array([0.5, 7.0])
    assert np.array_equal(data.inertia(q), [[0, -0.75, 0], [-0.75, 4, 0], [0, 0, 4]])
    assert np.array_equal(data.mdCM.at(q)[:, 0], [3.0, 0.5, 0.0])


@pytest.mark.serial
def test_spacing_case_and_order_do_not_matter(tmp_path):
    reference = bits(read(tmp_path, bar()))
    unspaced = re.sub(r"[ ]*([=(),])[ ]*", r"\1", bar()).replace("nodes,No", "nodes, No")
    begins = re.sub(r"^ *(mdCM|[JA]P?|refmod|phi)$", r"begin of \1", bar(), flags=re.MULTILINE)
    variants = {
        "tabs": re.sub(r"^ +", "\t", bar(), flags=re.MULTILINE).replace("a bar", "a bar  "),
        "unspaced": unspaced,
        "blank lines": bar().replace("\n", "\n\n").replace("a bar\n\n", "a bar\n"),
        "Windows": bar().replace("\n", "\r\n"),
        "upper case": re.sub(r"^(?!.*(Eigen|body ref|:)).*$", lambda m: m[0].upper(), bar(),
                             flags=re.MULTILINE),
        "begin of, end of": re.sub(r"\bend (\w)", r"end of \1", begins),
        "backwards": bar(BLOCKS[::-1]),
    }  # fmt: skip
    for name, text in variants.items():
        assert text != bar(), name
        assert bits(read(tmp_path, text)) == reference, name


numbers = st.floats(allow_nan=False, allow_infinity=False)


@pytest.mark.serial
def test_what_other_programs_write(tmp_path):
    """nq = 0 where nothing depends on q, and numbers in many ways."""
    lines = bar().splitlines()
    lines[lines.index("nq = 2", lines.index("Ge"))] = "nq = 0"
    data = read(tmp_path, "\n".join(lines))
    assert data.Ge.M1.shape == (2, 2, 6)
    write_sid(tmp_path / "b.sid", data)
    assert bits(read_sid(tmp_path / "b.sid")) == bits(data)
    numbers = {"1.5": 1.5, "-.5d0": -0.5, "+2E1": 20.0, "4": 4.0, "1.0-100": 1e-100}
    for text, value in numbers.items():
        assert read(tmp_path, edited("= 0.125", f"= {text}")).Gr.M0[2, 5] == value


def edited(old, new):
    assert old in bar()
    return bar().replace(old, new, 1)


def without(name):
    return bar([text for text in BLOCKS if not text.startswith(name)])


DAMAGED = {
    "empty": ("", ["line 0", "'part'"]),
    "no number": (edited("3.00000000000D+00", "three"), ["line 5", "mass", "a number"]),
    "nan": (edited("3.00000000000D+00", "nan"), ["line 5", "finite"]),
    "no integer": (edited("nelastq                         =   2", "nelastq = 2.5"), ["line 6"]),
    "too many": (edited("nelastq                         =   2", "nelastq = 501"), ["0 to 500"]),
    "no refmod": (edited("           refmod\n", ""), ["line 4", "'refmod'"]),
    "unknown block": (edited("\nCt\n", "\nCx\n"), ["Cx", "'Ct'", "'end modal'"]),
    "missing block": (without("Oe"), ["'Oe' before", "end modal"]),
    "twice": (bar([*BLOCKS, BLOCKS[2]]), ["'Ct'", "only once"]),
    "row": (edited("m0( 1, 2) = 1.0", "m0( 3, 2) = 1.0"), ["m0( 3, 2)", "(1..2, 1..3)"]),
    "entry twice": (edited("m0( 2, 2) = 2.6", "m0( 2, 1) = 2.6"), ["only once"]),
    "no structure": (edited("structure = 4\nend Me", "end Me"), ["'structure' of Me"]),
    "m1 of order 0": (edited("m0( 3, 6) = 0.125", "m1( 3, 1, 6) = 1"), ["m1", "order 0"]),
    "m0 of a zero": (edited("structure = 0\nend ks", "structure=0\nm0(1,1)=1\nend ks"), ["zero"]),
    "dimension": (edited("nrow = 6", "nrow = 5"), ["end J", "6 x 1 or 3 x 3", "5 x 1"]),
    "coordinates": (bar([BLOCKS[0].replace("nq = 2", "nq = 3")]), ["nq = 2 of mdCM, not 3"]),
    "node without phi": (bar(nodal=NODAL[1:]), ["'phi' of node 17 before", "end node"]),
    "node without a name": (edited("=       17", "="), ["line 11", "a name of its own"]),
    "no modal": (" part\n end part\n", ["line 2", "'modal'"]),
}


@pytest.mark.serial
@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_file(tmp_path, name):
    text, words = DAMAGED[name]
    refusal(lambda: read(tmp_path, text), f"{tmp_path / 'bar.SID_FEM'}, line ", *words)


@pytest.mark.serial
def test_no_damage_goes_unsaid(tmp_path):
    """A file that ends anywhere is refused; so is one with a line of nonsense anywhere."""
    lines = bar().splitlines()
    nonsense = ("m0( 1, 1", "= 3", "end", "\x00\ufffd")
    for cut in range(len(lines)):
        with pytest.raises(InputError, match=f"line {cut}: .*the file ends"):
            read(tmp_path, "\n".join(lines[:cut]))
        if cut < 2:  # still the comment
            continue
        with pytest.raises(InputError, match=f"line {cut + 1}: "):
            read(tmp_path, "\n".join([*lines[:cut], nonsense[cut % 4], *lines[cut:]]))
    refusal(lambda: read_sid(tmp_path / "none.sid"), "none.sid", "cannot be read", "SID")


# -- `dolfinopt export` of a machine in space, and scenes that take its files  --------------------


COMM = MPI.COMM_WORLD
DEMO = ROOT / "demos" / "spatial_arm.toml"
CELLS = {"link1": [8, 2, 2], "link2": [6, 2, 2]}
LENGTHS = {"link1": 0.5, "link2": 0.45}
COARSE = overrides(*(f"arms.{name}.cells={cells}" for name, cells in CELLS.items()))
SETTINGS = overrides("simulation.stiffening=true", "arms.column.mass=2.0")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of the links' files, the same on all ranks; what was told."""
    out = COMM.bcast(tmp_path_factory.mktemp("space") / "bodies")
    with redirect_stdout(io.StringIO()) as told:
        run("export", DEMO, *COARSE, *SETTINGS, "--out", out)
    return out, told.getvalue()


def test_files_of_every_link(folder):
    """Masses and inertias of boxes of half density; the geometric stiffness of all loads."""
    out, told = folder
    kinds = (".sid", ".sid.npz", ".fem")
    assert {path.name for path in out.iterdir()} == {f"{n}{k}" for n in CELLS for k in kinds}
    if COMM.rank == 0:
        assert "column: not exported, it is rigid: 2 kg, centre (0, 0, 0) m" in told
        assert "6 coordinates, 2 nodes, geometric stiffness" in told
    for name, length in LENGTHS.items():
        path = out / f"{name}.sid"
        body = load_body(path, 3, length)
        groups = read_as_mbdyn_does(path.with_suffix(".fem").read_text())
        check_npz(out / f"{name}.sid.npz", read_sid(path))
        mass = 0.6 * 2700.0 * length * 0.04 * 0.02
        assert body.mass == groups[12][0] == pytest.approx(mass, rel=1e-5)  # void: 1e-6 of solid
        assert groups[12][1:4] == pytest.approx([0.5 * length, 0.0, 0.0], abs=1e-9)
        sizes = np.array([length, 0.04, 0.02]) ** 2
        expected = np.diag(mass / 12.0 * (sizes.sum() - sizes))
        assert np.abs(groups[12][4:].reshape(3, 3) - expected).max() < 1e-5 * expected.max()
        assert body.K0.shape == (12, 6, 6) and body.K0_outboard.shape == (6, 6, 6)
        assert [load for load, _ in groups[19]] == list(range(1, 19))
        data = read_sid(path)
        assert np.array_equal(groups[9], data.Me.M0) and np.array_equal(groups[10], body.K)
        assert np.abs(body.M - groups[9]).max() < 1e-12 * np.abs(groups[9]).max()
        assert [node.name for node in data.nodes] == ["1", "2"]


def meshed():
    """Return the demo as a dictionary, coarse and short, every arm with all of its keys."""
    scene = tomllib.loads(DEMO.read_text())
    scene["motion"]["file"] = str(DEMO.with_suffix(".csv"))
    scene["simulation"] = {"stiffening": True, "sample": 0.02}
    for arm in scene["arms"][1:]:
        arm |= {"cells": CELLS[arm["name"]], "height": 0.04, "thickness": 0.02}
    return scene


@pytest.mark.serial
def test_motion_with_a_link_of_a_file(folder):
    """The machine moves as with the link's mesh, but for what the inertia of its modes stiffens."""
    expected = do.Model(meshed()).simulate().trajectory.deviation
    scene = meshed()
    scene["arms"][1] = {"name": "link1", "sid": str(folder[0] / "link1.sid")}
    found = do.Model(scene).simulate().trajectory.deviation
    assert np.abs(found - expected).max() < 1e-4 * np.abs(expected).max()  # measured 3e-5


@pytest.mark.serial
def test_links_of_files_that_cannot_be(folder, tmp_path):
    """Stiffness that cannot be left out; bodies that do not bend, or in the plane alone."""
    scene = meshed()
    scene["simulation"]["stiffening"] = False
    scene["arms"][2] = {"name": "link2", "sid": str(folder[0] / "link2.sid")}
    refusal(lambda: do.Model(scene), "link2.sid", "geometric stiffness")
    write_sid(tmp_path / "bar.sid", to_sid(in_space(rigid_bar(0.45, 0.04, 0.9))))
    scene["arms"][2]["sid"] = str(tmp_path / "bar.sid")
    refusal(lambda: do.Model(scene), "bar.sid", "nelastq = 0", "rigid = true, mass")
    write_sid(tmp_path / "beam.sid", to_sid(in_space(beam().body())))
    scene = meshed()
    scene["arms"][2] = {"name": "link2", "sid": str(tmp_path / "beam.sid")}
    stiffening, plane = doubts_of_files(do.scene_from_dict(scene))
    assert "beam.sid" in stiffening and "geometric stiffness" in stiffening
    assert "'link2'" in plane and "rigid" in plane
