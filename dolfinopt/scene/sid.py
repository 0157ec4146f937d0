"""Wallrapp's standard input data (SID) of one flexible body, and the text file that carries it.

The file is the one of FEMBS, SIMPACK, MatMorembs, Neweul-M2 and DLR's FlexibleBodies (.SID_FEM):

    part
      new modal =
        refmod ... end refmod                     mass, number and names of the coordinates
        frame new node = 1 ... end node end frame origin, phi, psi, AP (and sigma) of the nodes
        mdCM, J, Ct, Cr, Me, Gr, Ge, Oe, ksigma, Ke, De
      end modal
    end part

Every matrix is a Taylor expansion in the elastic coordinates q, of order 0 or 1: entries
`m0( row, col)` and `m1( row, coordinate, col)`, counted from one; those left out are zero. With
frame acceleration a, angular velocity w and acceleration g, all in the body frame, the inertia
force, moment about the origin and elastic rows are

    F = m a + g x s + w x (w x s) + 2 w x (Ct' qd) + Ct' qdd,  s = mdCM(q)
    T = s x a + J(q) g + w x (J(q) w) + sum_k qd_k Gr_k(q) w + Cr(q)' qdd
    f = Ct a + Cr(q) g + sum_k qd_k Ge_k w + Oe(q) [w1^2 w2^2 w3^2 w1w2 w2w3 w1w3]' + Me qdd

where Gr_k and Ge_k are the k-th blocks of three columns.
Source: Wallrapp, Standardization of flexible body modeling in multibody system codes (1994),
doi:10.1080/08905459408905214; Schwertassek & Wallrapp, Dynamik flexibler Mehrkörpersysteme
(1999).
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dolfinopt.data import filled
from dolfinopt.disk import write_text
from dolfinopt.errors import InputError
from dolfinopt.scene.tables.base import cut

MOST = 500  # coordinates: every matrix is kept with its derivative by all of them

_END = re.compile(r"end\s+(?:of\s+)?(\w+)\s*$", re.IGNORECASE)
_ITEM = re.compile(
    r"(?:begin\s+of\s+|new\s+)?([a-z]\w*)\s*(?:\(([^()]*)\))?\s*(?:=(.*))?$", re.IGNORECASE
)


# What a matrix looks like: readers may skip its entries where they follow from this.
ZERO, DIAGONAL, SYMMETRIC, GENERAL, UNIT = range(5)


@dataclass(frozen=True, eq=False)
class Taylor:
    """A matrix M(q) = M0 + sum_k q_k M1[:, k, :].

    Attributes:
        M0: (nrow, ncol).
        M1: (nrow, nq, ncol), zero for order 0.
        order: 0 or 1.
        structure: of M0: 0 zero, 1 diagonal, 2 symmetric, 3 general, 4 unit matrix.
        nqn: dimension of higher orders, which are not read; zero.
    """

    M0: np.ndarray
    M1: np.ndarray
    order: int
    structure: int
    nqn: int = 0

    def at(self, q: np.ndarray) -> np.ndarray:
        """Return M(q) (nrow, ncol)."""
        return self.M0 + np.einsum("rkc,k->rc", self.M1, q)


def taylor(
    nq: int, M0: np.ndarray, M1: np.ndarray | None = None, structure: int = GENERAL
) -> Taylor:
    """Return the expansion of order 0, or of order 1 where M1 (nrow, nq, ncol) is given.

    A structure that M0 does not have is replaced: one that is zero is called so.
    """
    if not M0.any():
        structure = ZERO
    higher = np.zeros((M0.shape[0], nq, M0.shape[1])) if M1 is None else M1
    return Taylor(M0, higher, 0 if M1 is None else 1, structure)


def structure_of(matrix: np.ndarray) -> int:
    """Return whether a square matrix is diagonal, symmetric or neither."""
    if np.array_equal(matrix, np.diag(np.diag(matrix))):
        return DIAGONAL
    return SYMMETRIC if np.array_equal(matrix, matrix.T) else GENERAL


@dataclass(frozen=True)
class Node:
    """A point of the body where something may be attached.

    Attributes:
        name: number or name.
        rframe: name of the frame its data refer to.
        origin: (3, 1) position, m; its M1 repeats phi.
        phi: (3, nq) translation by each coordinate.
        psi: (3, nq) small rotation by each coordinate.
        AP: (3, 3) orientation, from the node's to the body's frame; M1 = tilde(psi_k).
        sigma: (6, 1) initial stresses, or None.
    """

    name: str
    rframe: str
    origin: Taylor
    phi: Taylor
    psi: Taylor
    AP: Taylor
    sigma: Taylor | None = None


@dataclass(frozen=True)
class StandardInputData:
    """One flexible body; integrals over its mass, r the reference position, Phi the modes.

    Attributes:
        mass: m, kg.
        names: (nq,) of the elastic coordinates.
        nodes: where something may be attached.
        mdCM: (3, 1) int r, kg m.
        J: (6, 1) moments xx, yy, zz, xy, xz, yz of the inertia tensor, or (3, 3); kg m2.
        Ct: (nq, 3) int Phi'.
        Cr: (nq, 3) int (r x Phi_k)'.
        Me: (nq, nq) int Phi' Phi.
        Gr: (3, 3 nq) blocks -2 int tilde(r) tilde(Phi_k).
        Ge: (nq, 3 nq) block l has rows 2 int (Phi_l x Phi_k)'.
        Oe: (nq, 6) int of what w1^2, w2^2, w3^2, w1 w2, w2 w3, w1 w3 do to each coordinate.
        ksigma: (nq, 1) generalised forces of initial stresses.
        Ke, De: (nq, nq) stiffness and damping.
        comment: of the file's first line.
    """

    mass: float
    names: tuple[str, ...]
    nodes: tuple[Node, ...]
    mdCM: Taylor
    J: Taylor
    Ct: Taylor
    Cr: Taylor
    Me: Taylor
    Gr: Taylor
    Ge: Taylor
    Oe: Taylor
    ksigma: Taylor
    Ke: Taylor
    De: Taylor
    comment: str = ""

    @property
    def num_modes(self) -> int:
        """Number nq of elastic coordinates."""
        return len(self.names)

    def inertia(self, q: np.ndarray) -> np.ndarray:
        """Return the inertia tensor J(q) (3, 3) to first order in q, whichever way it is stored."""
        J = self.J.at(q)
        if J.shape == (3, 3):
            return J
        xx, yy, zz, xy, xz, yz = J[:, 0]
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


# Allowed shapes in the file's order: numbers, or multiples of nq.
Shapes = tuple[tuple[int | str, int | str], ...]
BODY: dict[str, Shapes] = {
    "mdCM": ((3, 1),),
    "J": ((6, 1), (3, 3)),
    "Ct": (("nq", 3),),
    "Cr": (("nq", 3),),
    "Me": (("nq", "nq"),),
    "Gr": ((3, "3nq"),),
    "Ge": (("nq", "3nq"),),
    "Oe": (("nq", 6),),
    "ksigma": (("nq", 1),),
    "Ke": (("nq", "nq"),),
    "De": (("nq", "nq"),),
}
NODE: dict[str, Shapes] = {
    "origin": ((3, 1),),
    "phi": ((3, "nq"),),
    "psi": ((3, "nq"),),
    "AP": ((3, 3),),
    "sigma": ((6, 1),),
}
HEADER = ("order", "nrow", "ncol", "nq", "nqn", "structure")


# -- named arrays, and the .npz file of them ---------------------------------------------------


def sid_arrays(data: StandardInputData) -> dict[str, Any]:
    """Return the data as named arrays, numbers and texts, for an .npz file.

    `mass`, `names`, `comment`, `node_names`, `node_rframes`; of every matrix `Ct/M0` (nrow, ncol),
    `Ct/M1` (nrow, nq, ncol), `Ct/order`, `Ct/structure`, `Ct/nqn`; of a node's `node1/phi/M0`.
    """
    arrays = {
        "mass": data.mass,
        "names": data.names,
        "comment": data.comment,
        "node_names": [node.name for node in data.nodes],
        "node_rframes": [node.rframe for node in data.nodes],
    }
    matrices = {name: getattr(data, name) for name in BODY}
    for k, node in enumerate(data.nodes, 1):
        matrices |= {f"node{k}/{name}": getattr(node, name) for name in NODE}
    for name, matrix in matrices.items():
        if matrix is not None:
            arrays |= {f"{name}/{key}": value for key, value in vars(matrix).items()}
    return arrays


# -- writing the text file ---------------------------------------------------------------------


def write_sid(path: Path, data: StandardInputData) -> None:
    """Write the text file, numbers with 17 digits; `read_sid` gets the same bits back."""
    text = filled(
        "body.sid.jinja",
        {"number": _number, "written": _written},
        data=data,
        comment=" ".join(data.comment.split()),
        of_node=NODE,
        of_body=BODY,
    )
    write_text(path, text)


def _number(value: float) -> str:
    return f"{value: .16E}".replace("E", "D")


def _written(matrix: Taylor) -> tuple[dict[str, int], list[tuple[str, float]]]:
    """Return header and entries of a matrix: what a reader would not guess from a missing one."""
    (nrow, ncol), nq, structure = matrix.M0.shape, matrix.M1.shape[1], matrix.structure
    entries = _filled(matrix.M0)
    if structure == SYMMETRIC and nrow == ncol:
        entries |= entries.T  # a half left out would be taken from the other
    if structure == UNIT and np.array_equal(matrix.M0, np.eye(nrow, ncol)):
        entries[:] = False
    elif structure in (ZERO, UNIT):
        structure = GENERAL if entries.any() else ZERO
    header = (matrix.order, nrow, ncol, nq, matrix.nqn, structure)
    higher = _filled(matrix.M1) & (matrix.order > 0)
    values = [
        (f"{name}( {', '.join(str(i + 1) for i in place)})", array[tuple(place)])
        for name, array, shown in (("m0", matrix.M0, entries), ("m1", matrix.M1, higher))
        for place in np.argwhere(shown)
    ]
    return dict(zip(HEADER, header, strict=True)), values


def _filled(values: np.ndarray) -> np.ndarray:
    """Return True for everything but +0, which is what a missing entry means."""
    return (values != 0.0) | np.signbit(values)


# -- reading it --------------------------------------------------------------------------------

HEADER_LIMITS = {"order": 1, "nqn": 0, "structure": UNIT}  # largest numbers
# What stands in every block, and which of it may stand there more than once.
MATRICES = BODY | NODE
ITEMS: dict[str, tuple[str, ...]] = {
    "part": ("modal",),
    "modal": ("refmod", *BODY, "frame"),
    "refmod": ("mass", "nelastq", "ielastq"),
    "frame": ("node",),
    "node": (*NODE, "rframe"),
    **dict.fromkeys(MATRICES, (*HEADER, "m0", "m1")),
}
MANY = ("frame", "ielastq", "node", "rframe", "m0", "m1")


def read_sid(path: Path) -> StandardInputData:
    """Read the text file.

    Spacing and case do not matter, blocks and their items may come in any order, zeros may be left
    out, as well as the half of a symmetric and the entries of a unit matrix; `begin of x` and
    `end of x` are as good as `x` and `end x`.

    Raises:
        InputError: one line with the file, the line, what was found and what was expected.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); name an SID file") from None
    lines = _lines(path, text)
    part = next(line for line in lines if line.is_part or not line.text)
    if not part.is_part:
        raise part.fail("'part'")
    first = text.splitlines()[0] if part.number > 1 else ""
    modal = part.with_items("part", lines).one("modal")
    refmod = modal.one("refmod")
    nq = refmod.one("nelastq").integer(MOST)
    names = [""] * nq
    for item in refmod.items["ielastq"]:
        names[item.place((nq,))[0]] = item.value or ""
    return StandardInputData(
        refmod.one("mass").real(),
        tuple(names),
        _nodes(modal, nq),
        **{name: _taylor(modal.one(name), name, nq) for name in BODY},
        comment=first.split("modes:", 1)[-1].strip(),
    )


def _nodes(modal: _Item, nq: int) -> tuple[Node, ...]:
    """Return the nodes of all frames."""
    nodes: dict[str, Node] = {}
    for item in (node for frame in modal.items["frame"] for node in frame.items["node"]):
        name = item.value or ""
        if not name or name in nodes:
            raise item.fail("'new node =' and a name of its own")
        rframe = [frame.value or "" for frame in item.items["rframe"]]
        matrices = {
            key: _taylor(item.one(key, f"of node {name}"), key, nq)
            for key in NODE
            if key != "sigma" or key in item.items
        }
        nodes[name] = Node(name, rframe[-1] if rframe else "", **matrices)
    return tuple(nodes.values())


def _taylor(block: _Item, name: str, nq: int) -> Taylor:
    """Return one matrix, its dimensions checked."""
    order, *shape, count, nqn, structure = (
        block.one(key, f"of {name}").integer(HEADER_LIMITS.get(key, 10_000_000)) for key in HEADER
    )
    size: dict[Any, int] = {"nq": nq, "3nq": 3 * nq}
    allowed = [[size.get(n, n) for n in dimensions] for dimensions in MATRICES[name]]
    if shape not in allowed:
        choices = " or ".join(f"{rows} x {cols}" for rows, cols in allowed)
        found = f"{shape[0]} x {shape[1]}, for nelastq = {nq}"
        raise block.end.fail(f"{name} of {choices}, not {found}")
    if count != nq and (order > 0 or count != 0):
        raise block.end.fail(f"nq = {nq} of {name}, not {count}")
    M0 = np.zeros(shape)
    M1 = np.zeros((shape[0], nq, shape[1]))
    first, second = block.entries("m0", M0.shape), block.entries("m1", M1.shape)
    if second and order == 0:
        raise block.end.fail(f"no m1 in {name}, which is of order 0")
    if first and structure == ZERO:
        raise block.end.fail(f"no m0 in {name}, whose structure 0 says zero")
    if structure == UNIT and not first:
        np.fill_diagonal(M0, 1.0)
    if structure == SYMMETRIC and shape[0] == shape[1]:
        first = {index[::-1]: value for index, value in first.items()} | first
    for array, values in ((M0, first), (M1, second)):
        for index, value in values.items():
            array[index] = value
    return Taylor(M0, M1, order, structure, nqn)


@dataclass
class _Item:
    """A line of a file that is not empty; of a block what stands in it, and the line of its end.

    Attributes:
        path, number: of the file, and of the line from one.
        text: of the line; "" behind the file's last one.
        name: of what stands there, in lower case; "end" and the name at the end of a block.
        indices, value: in parentheses, and behind the equals sign; None without.
        items: of a block, by their names.
    """

    path: Path
    number: int
    text: str = ""
    name: str = ""
    indices: str | None = None
    value: str | None = None
    items: dict[str, list[_Item]] = field(default_factory=lambda: defaultdict(list))

    @property
    def is_part(self) -> bool:
        """Whether all that is read begins here."""
        return self.name == "part" and self.value is None

    @property
    def end(self) -> _Item:
        """The line of a block's end."""
        return self.items["end"][0]

    def fail(self, expected: str) -> InputError:
        found = f"found {cut(self.text)!r}" if self.text else "the file ends"
        return InputError(f"{self.path}, line {self.number}: {found}, expected {expected}")

    def with_items(self, name: str, lines: Iterator[_Item]) -> _Item:
        """Return this block with the items up to its end."""
        known = {key.lower(): key for key in ITEMS[name]}
        choices = ", ".join(map(repr, [*ITEMS[name], f"end {name}"]))
        for item in lines:
            if item.name == f"end {name.lower()}":
                self.items["end"].append(item)
                break
            if (key := known.get(item.name)) is None:
                raise item.fail(choices)
            if key in self.items and key not in MANY:
                raise item.fail(f"{key!r} only once")
            self.items[key].append(item.with_items(key, lines) if key in ITEMS else item)
        return self

    def one(self, key: str, told: str = "") -> _Item:
        """Return the item of a block that it must have."""
        if key not in self.items:
            raise self.end.fail(" ".join(filter(None, (repr(key), told, "before"))))
        return self.items[key][0]

    def entries(self, key: str, shape: tuple[int, ...]) -> dict[tuple[int, ...], float]:
        """Return the numbers of a block by their indices."""
        result: dict[tuple[int, ...], float] = {}
        for item in self.items[key]:
            if (index := item.place(shape)) in result:
                raise item.fail("every entry only once")
            result[index] = item.real()
        return result

    def real(self) -> float:
        value = (self.value or "").lower().replace("d", "e")
        value = re.sub(r"(?<=[\d.])([+-]\d{3})$", r"e\1", value)  # Fortran prints 1.0-100
        try:
            number = float(value)
        except ValueError:
            raise self.fail("= and a number") from None
        if not np.isfinite(number) or "_" in value:
            raise self.fail("= and a finite number")
        return number

    def integer(self, high: int) -> int:
        value = self.value or ""
        if not re.fullmatch(r"[+-]?\d+", value) or not 0 <= int(value) <= high:
            raise self.fail(f"= and an integer from 0 to {high}")
        return int(value)

    def place(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Return the indices in parentheses, counted from zero."""
        parts = (self.indices or "").split(",")
        counted = len(parts) == len(shape) and all(re.fullmatch(r"\s*\d+\s*", x) for x in parts)
        if not counted or not all(1 <= int(x) <= n for x, n in zip(parts, shape, strict=True)):
            raise self.fail(f"indices ({', '.join(f'1..{n}' for n in shape)})")
        return tuple(int(x) - 1 for x in parts)


def _lines(path: Path, text: str) -> Iterator[_Item]:
    """Yield the lines that are not empty, and one behind them."""
    lines = text.splitlines()
    for number, line in enumerate(map(str.strip, lines), 1):
        if end := _END.match(line):
            yield _Item(path, number, line, f"end {end[1].lower()}")
        elif item := _ITEM.match(line):
            value = item[3] and item[3].strip()
            yield _Item(path, number, line, item[1].lower(), item[2], value)
        elif line:
            yield _Item(path, number, line)
    yield _Item(path, len(lines))
