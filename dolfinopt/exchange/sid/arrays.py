"""Standard input data as named arrays, and the .npz file of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from dolfinopt.disk import write_atomically
from dolfinopt.errors import InputError
from dolfinopt.exchange.sid.data import BODY, NODE, Node, StandardInputData, Taylor


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
        matrices.update({f"node{k}/{name}": getattr(node, name) for name in NODE})
    for name, matrix in matrices.items():
        if matrix is not None:
            for field in fields(Taylor):
                arrays[f"{name}/{field.name}"] = np.asarray(getattr(matrix, field.name))
    return arrays


def write_sid_npz(path: Path, data: StandardInputData) -> None:
    """Write `sid_arrays` to a file."""
    arrays: dict[str, Any] = dict(sid_arrays(data))
    write_atomically(path, lambda stream: np.savez(stream, **arrays))


def read_sid_npz(path: Path) -> StandardInputData:
    """Read what `write_sid_npz` wrote.

    Raises:
        InputError: the file cannot be read, or an array is missing.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
        return _from_arrays(arrays)
    except KeyError as error:
        raise InputError(f"{path}: the array {error.args[0]!r} is missing") from None
    except Exception as error:  # whatever a foreign file may raise
        problem = getattr(error, "strerror", None) or type(error).__name__
        raise InputError(f"{path}: cannot be read ({problem}); give an .sid.npz file") from None


def _from_arrays(arrays: Mapping[str, np.ndarray]) -> StandardInputData:
    def matrix(name: str) -> Taylor:
        M0, M1, *numbers = (arrays[f"{name}/{field.name}"] for field in fields(Taylor))
        return Taylor(M0, M1, *map(int, numbers))

    nodes = []
    pairs = zip(arrays["node_names"], arrays["node_rframes"], strict=True)
    for k, (name, rframe) in enumerate(pairs, 1):
        parts = {key: matrix(f"node{k}/{key}") for key in NODE if key != "sigma"}
        if f"node{k}/sigma/M0" in arrays:
            parts["sigma"] = matrix(f"node{k}/sigma")
        nodes.append(Node(str(name), str(rframe), **parts))
    return StandardInputData(
        mass=float(arrays["mass"]),
        names=tuple(map(str, arrays["names"])),
        nodes=tuple(nodes),
        comment=str(arrays["comment"]),
        **{name: matrix(name) for name in BODY},
    )
