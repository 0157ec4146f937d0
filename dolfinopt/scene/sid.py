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
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from dolfinopt.data import filled
from dolfinopt.disk import write_text
from dolfinopt.errors import InputError

Items = dict[str, Callable[[], Any]]  # how the items of a block are read
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
        M1: (nrow, nq, ncol), zero for order 0; files of order 0 may have nq = 0.
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
        if self.order == 0:
            return self.M0
        return self.M0 + np.einsum("rkc,k->rc", self.M1, q)


def taylor(M0: np.ndarray, M1: np.ndarray | None = None, *, nq: int, structure: int) -> Taylor:
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


def sid_arrays(data: StandardInputData) -> dict[str, np.ndarray]:
    """Return the data as named arrays, for an .npz file.

    `mass`, `names`, `comment`, `node_names`, `node_rframes`; of every matrix `Ct/M0` (nrow, ncol),
    `Ct/M1` (nrow, nq, ncol), `Ct/order`, `Ct/structure`, `Ct/nqn`; of a node's `node1/phi/M0`.
    """
    arrays = {
        "mass": np.array(data.mass),
        "names": np.array(data.names, dtype=str),
        "comment": np.array(data.comment, dtype=str),
        "node_names": np.array([node.name for node in data.nodes], dtype=str),
        "node_rframes": np.array([node.rframe for node in data.nodes], dtype=str),
    }
    matrices = {name: getattr(data, name) for name in BODY}
    for k, node in enumerate(data.nodes, 1):
        matrices |= {f"node{k}/{name}": getattr(node, name) for name in NODE}
    for name, matrix in matrices.items():
        if matrix is not None:
            arrays |= {f"{name}/{key}": np.asarray(value) for key, value in vars(matrix).items()}
    return arrays


# -- writing the text file ---------------------------------------------------------------------


def write_sid(path: Path, data: StandardInputData) -> None:
    """Write the text file; `read_sid` gets the same bits back."""
    write_text(path, sid_text(data))


def sid_text(data: StandardInputData) -> str:
    """Return the content of the text file, numbers with 17 digits and Fortran's exponent."""
    return filled(
        "body.sid.jinja",
        {"number": _number, "written": _written},
        data=data,
        comment=" ".join(data.comment.split()),
        of_node=NODE,
        of_body=BODY,
    )


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


def read_sid(path: Path) -> StandardInputData:
    """Read the text file.

    Spacing and case do not matter, blocks may come in any order, zeros may be left out, as well
    as the half of a symmetric and the entries of a unit matrix; `begin of x` and `end of x` are
    as good as `x` and `end x`.

    Raises:
        InputError: one line with the file, the line, what was found and what was expected.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); name an SID file") from None
    return _Reader(path, text).part()


class _Reader:
    """A file's lines, one looked at at a time."""

    def __init__(self, path: Path, text: str):
        self.path = path
        self.lines = text.splitlines()
        self.number = 0  # of the line looked at, from one
        self.text = ""
        self.end: str | None = None  # the block that ends here
        self.name = ""  # of the item that stands here, in lower case
        self.indices: str | None = None
        self.value: str | None = None

    def fail(self, expected: str) -> InputError:
        shown = self.text if len(self.text) <= 60 else self.text[:57] + "..."
        return InputError(f"{self.path}, line {self.number}: found {shown!r}, expected {expected}")

    def next(self, expected: str) -> None:
        """Go to the next line that is not empty."""
        while self.number < len(self.lines):
            self.text = self.lines[self.number].strip()
            self.number += 1
            if not self.text:
                continue
            end, item = _END.match(self.text), _ITEM.match(self.text)
            self.end = end[1].lower() if end else None
            self.name, self.indices, self.value = "", None, None
            if item and not end:
                self.name, self.indices = item[1].lower(), item[2]
                self.value = None if item[3] is None else item[3].strip()
            return
        raise InputError(f"{self.path}, line {len(self.lines)}: the file ends, expected {expected}")

    def block(self, name: str, once: Items, often: Items, items: dict[str, Any]) -> dict[str, Any]:
        """Read the items of a block up to its end; into `found` those that may stand once."""
        choices = ", ".join(map(repr, [*once, *often, f"end {name}"]))
        known = {key.lower(): key for key in (*once, *often)}
        while True:
            self.next(choices)
            if self.end == name.lower():
                return items
            if (key := known.get(self.name)) is None:
                raise self.fail(choices)
            if key in items:
                raise self.fail(f"{key!r} only once")
            value = (once[key] if key in once else often[key])()
            if key in once:
                items[key] = value

    def complete(self, items: Mapping[str, Any], names: Iterable[str], told: str) -> None:
        for name in names:
            if name not in items:
                raise self.fail(f"{name!r} {told}")

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

    def integer(self, low: int, high: int) -> int:
        value = self.value or ""
        if not re.fullmatch(r"[+-]?\d+", value) or not low <= int(value) <= high:
            raise self.fail(f"= and an integer from {low} to {high}")
        return int(value)

    def place(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Return the indices in parentheses, counted from zero."""
        parts = (self.indices or "").split(",")
        counted = len(parts) == len(shape) and all(re.fullmatch(r"\s*\d+\s*", x) for x in parts)
        if not counted or not all(1 <= int(x) <= n for x, n in zip(parts, shape, strict=True)):
            raise self.fail(f"indices ({', '.join(f'1..{n}' for n in shape)})")
        return tuple(int(x) - 1 for x in parts)

    def part(self) -> StandardInputData:
        """Read the whole file: a comment, then the part."""
        while self.name != "part" or self.value is not None:
            self.next("'part'")
        comment = self.lines[0].split("modes:", 1)[-1].strip() if self.number > 1 else ""
        result = self.block("part", {"modal": self.modal}, {}, {})
        if not result:
            raise self.fail("'new modal' before")
        return replace(result["modal"], comment=comment)

    def modal(self) -> StandardInputData:
        result: dict[str, Any] = {}
        nodes: dict[str, Node] = {}

        def number() -> int:
            if not result:
                raise self.fail("'refmod' first, which has the number of coordinates")
            return len(result["refmod"][1])

        def node() -> None:
            name = self.value or ""
            if not name or name in nodes:
                raise self.fail("'new node =' and a name of its own")
            nodes[name] = self.node(name, number())

        def frame() -> None:
            number()
            self.block("frame", {}, {"node": node}, {})

        once: Items = {"refmod": self.refmod}
        once |= {key: partial(lambda name: self.taylor(name, number()), key) for key in BODY}
        self.block("modal", once, {"frame": frame}, result)
        self.complete(result, ("refmod", *BODY), "before")
        mass, names = result.pop("refmod")
        return StandardInputData(mass, names, tuple(nodes.values()), **result)

    def refmod(self) -> tuple[float, tuple[str, ...]]:
        """Return the mass and the names of the coordinates."""
        result: dict[str, Any] = {}
        names: dict[int, str] = {}

        def name() -> None:
            if "nelastq" not in result:
                raise self.fail("'nelastq' before the names")
            (k,) = self.place((result["nelastq"],))
            names[k] = self.value or ""

        once: Items = {"mass": self.real, "nelastq": partial(self.integer, 0, MOST)}
        self.block("refmod", once, {"ielastq": name}, result)
        self.complete(result, once, "before")
        return result["mass"], tuple(names.get(k, "") for k in range(result["nelastq"]))

    def node(self, name: str, nq: int) -> Node:
        rframe = [""]
        once: Items = {key: partial(self.taylor, key, nq) for key in NODE}
        often: Items = {"rframe": lambda: rframe.append(self.value or "")}
        result = self.block("node", once, often, {})
        self.complete(result, (key for key in NODE if key != "sigma"), f"of node {name} before")
        return Node(name, rframe[-1], **result)

    def taylor(self, name: str, nq: int) -> Taylor:
        """Read one matrix, check its dimensions and fill it."""
        header: dict[str, Any] = {}
        entries: dict[str, dict[tuple[int, ...], float]] = {"m0": {}, "m1": {}}

        def put() -> None:
            self.complete(header, HEADER, "before the entries")
            known = entries[self.name]
            keys = ("nrow", "ncol") if self.name == "m0" else ("nrow", "nq", "ncol")
            index = self.place(tuple(header[key] for key in keys))
            if index in known:
                raise self.fail("every entry only once")
            known[index] = self.real()

        limits = {"order": 1, "nqn": 0, "structure": UNIT}
        once: Items = {key: partial(self.integer, 0, limits.get(key, 10_000_000)) for key in HEADER}
        self.block(name, once, {"m0": put, "m1": put}, header)
        self.complete(header, HEADER, f"of {name} before")
        size: dict[Any, int] = {"nq": nq, "3nq": 3 * nq}
        allowed = [tuple(size.get(n, n) for n in shape) for shape in (BODY | NODE)[name]]
        order, *shape, count, nqn, structure = (header[key] for key in HEADER)
        if tuple(shape) not in allowed:
            choices = " or ".join(f"{rows} x {cols}" for rows, cols in allowed)
            raise self.fail(f"{name} of {choices}, not {shape[0]} x {shape[1]}, for nelastq = {nq}")
        if count != nq and (order > 0 or count != 0):
            raise self.fail(f"nq = {nq} of {name}, not {count}")
        first, second = entries["m0"], entries["m1"]
        if second and order == 0:
            raise self.fail(f"no m1 in {name}, which is of order 0")
        if first and structure == ZERO:
            raise self.fail(f"no m0 in {name}, whose structure 0 says zero")
        M0 = np.eye(*shape) if structure == UNIT and not first else np.zeros(shape)
        M1 = np.zeros((shape[0], count, shape[1]))
        if structure == SYMMETRIC and shape[0] == shape[1]:
            first = {index[::-1]: value for index, value in first.items()} | first
        for array, values in ((M0, first), (M1, second)):
            for index, value in values.items():
                array[index] = value
        return Taylor(M0, M1, order, structure, nqn)
