"""What standard input data must fulfil to be a body here, in the plane or in space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from dolfinopt.errors import InputError
from dolfinopt.exchange.sid import Node, StandardInputData

# How far matrices that must be symmetric, or zero, may be from it, relative to their largest
# entry: finite elements leave 1e-12, files with six digits 1e-6.
SMALL = 1e-6
# How far the centrifugal matrix may be from that of the mass, relative to Me: lumped masses reach
# 5 %, geometric stiffening by rotation changes the sign of its diagonal for slender bodies.
CENTRIFUGAL = 0.1


def ends(
    data: StandardInputData, inboard: str | None, outboard: str | None, source: str
) -> tuple[Node, Node]:
    """Return the two interface nodes of a body that bends; by default the first and the last."""
    if data.num_modes == 0:
        raise InputError(
            f"{source}: nelastq = 0, a body that does not bend; state rigid = true, mass and "
            "inertia in place of the file"
        )
    names = [node.name for node in data.nodes]
    if len(names) < 2:
        raise InputError(
            f"{source}: lacks an outboard node, its nodes are: {', '.join(names) or 'none'}; an "
            "arm needs an inboard node at the origin and an outboard node"
        )
    for side, name in (("inboard", inboard), ("outboard", outboard)):
        if name is not None and name not in names:
            raise InputError(f"{source}: no {side} node {name!r}; it has {', '.join(names)}")
    first = data.nodes[0 if inboard is None else names.index(inboard)]
    last = data.nodes[-1 if outboard is None else names.index(outboard)]
    if first is last:
        raise InputError(f"{source}: node {first.name} cannot be both inboard and outboard")
    return first, last


def check_deviations(
    checks: Sequence[tuple[Node, str, np.ndarray, float, str]], first: Node, source: str
) -> None:
    """Check rows (node, name, values, scale, "must be ...") whose values must be zero."""
    for node, name, values, scale, must in checks:
        if np.abs(values).max() > SMALL * scale:
            raise InputError(
                f"{source}: {name} of node {node.name} deviates by {np.abs(values).max():.3g}; the "
                f"{'inboard' if node is first else 'outboard'} node must be {must}"
            )


def scales(last: Node) -> tuple[float, float, float]:
    """Return length, displacement and rotation by which the deviations of nodes are judged."""
    length = np.abs(last.origin.M0).max()
    push, turn = np.abs(last.phi.M0).max(), np.abs(last.psi.M0).max()
    # Of the two scales the other follows over the arm's length.
    return length, max(push, length * turn), max(turn, push / length)


def check_definite(data: StandardInputData, numbers: Mapping[str, float], source: str) -> None:
    """Check that a mechanical body may have these masses and stiffnesses; `numbers` are > 0."""
    for name, number in numbers.items():
        if not number > 0.0:
            raise InputError(f"{source}: {name} = {number:g} must be > 0")
    for name, matrix in (("Me", data.Me.M0), ("Ke", data.Ke.M0)):
        if np.linalg.eigvalsh(0.5 * (matrix + matrix.T))[0] <= 0.0:
            raise InputError(
                f"{source}: {name} must be positive definite; the body must be held at its inboard "
                "node and its coordinates be independent"
            )


def check_stresses(data: StandardInputData, source: str) -> None:
    """Check that there are no initial stresses, and that the stiffness is one matrix."""
    for name, values in (("ksigma", data.ksigma.M0), ("m1 of Ke", data.Ke.M1)):
        if values.any():
            raise InputError(
                f"{source}: {name} holds initial stresses or a stiffness that is not constant, "
                "which arms do not have here; write the file without"
            )


def is_stiffened(found: Mapping[str, bool], source: str) -> bool:
    """Return whether matrices hold geometric stiffness: all or none of them.

    A body that its own inertia stiffens, but no load at its outboard node, or the other way round,
    is taken for one whose file lacks matrices.
    """
    if not any(found.values()):
        return False
    if lacking := [name for name, present in found.items() if not present]:
        present = next(name for name in found if found[name])
        raise InputError(
            f"{source}: {present} holds geometric stiffening, which {lacking[0]} lacks; write the "
            "file with that of all accelerations and of the outboard node's forces, or with none"
        )
    return True


def check_symmetric(matrices: Mapping[str, Sequence[np.ndarray]], source: str) -> None:
    """Check that what one load or rotation does to the coordinates (q, q) is symmetric.

    Relative to the largest under the same name: of a load that does nothing rounding is left.
    """
    for name, loads in matrices.items():
        scale = max(np.abs(matrix).max() for matrix in loads)
        for matrix in loads:
            if np.abs(matrix - matrix.T).max() > SMALL * scale:
                raise InputError(
                    f"{source}: m1 of {name} must be symmetric in coordinates and rows or columns: "
                    "it is what one load or rotation does to the stiffness"
                )
