"""Kernels of UFL forms, compiled by FFCx and run cell by cell; the one file that knows FFCx.

Compiled forms are kept in DOLFINx's folder for them, each in one of its own. A compilation that was
interrupted leaves a folder without the file that says it is complete, and is repeated.
"""

from __future__ import annotations

import fcntl
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cffi
import dolfinx.jit
import ffcx.naming
import numpy as np
import ufl
from mpi4py import MPI

from dolfinopt.mesh.compat import VERSION, form_folder, quiet_compilers
from dolfinopt.progress import log

FFI = cffi.FFI()
Expression = tuple[Any, np.ndarray]  # of UFL, at points (p, d) of the reference cell
# Of coefficients (n_cells or 1, dofs), of constants (..., m, m), one or those of every cell.
Values = dict[Any, np.ndarray]


class Kernel:
    """The kernel of a form with one cell integral, or of an expression at points.

    Attributes:
        shape: of the tensor of a cell: (points, components,) sizes of the arguments.
        coefficients, constants: of UFL in the kernel's order.
    """

    def __init__(self, form: ufl.Form | Expression, compiled: tuple[Any, Any, Any]):
        self._module, kernel = compiled, compiled[0]
        lead: tuple[int, ...] = ()
        if isinstance(form, ufl.Form):
            arguments, every = form.arguments(), form.coefficients()
            self.constants = form.constants()
            kernel = _cell_integral(kernel)
        else:
            expression, points = form
            arguments = ufl.algorithms.extract_arguments(expression)
            every = ufl.algorithms.extract_coefficients(expression)
            self.constants = ufl.algorithms.analysis.extract_constants(expression)
            lead = len(points), int(np.prod(expression.ufl_shape))
        self._run = kernel.tabulate_tensor_float64
        order, count = _coefficient_order(compiled[0]), compiled[0].num_coefficients
        self.coefficients = [every[order[k]] for k in range(count)]
        self.shape = lead + tuple(num_dofs(each.ufl_function_space()) for each in arguments)

    def __call__(self, coordinates: np.ndarray, values: Values) -> np.ndarray:
        """Return the tensors (n_cells, ...) of cells with corners (n_cells, c, 3), m."""
        count, x = len(coordinates), np.ascontiguousarray(coordinates, dtype=np.float64)
        out = np.zeros((count, *self.shape))
        w = _of_cells(count, [values[each] for each in self.coefficients])
        # Constants to the kernel, which may differ from cell to cell nevertheless.
        sizes = [int(np.prod(each.ufl_shape)) for each in self.constants]
        c = [values[each].reshape(-1, n) for each, n in zip(self.constants, sizes, strict=True)]
        c = _of_cells(count, c)
        A, W, X, C = (FFI.cast("double *", each.ctypes.data) for each in (out, w, x, c))
        a, b, d, e = (each.size // max(1, count) for each in (out, w, x, c))
        run, none = self._run, FFI.NULL
        tail = [none] if VERSION >= (0, 10) else []  # FFCx 0.10 hands custom data through
        for k in range(count):
            run(A + k * a, W + k * b, C + k * e, X + k * d, none, none, *tail)
        return out


def _of_cells(count: int, parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return values (1 or n_cells, dofs) side by side, of every cell."""
    rows = [np.broadcast_to(part, (count, part.shape[1])) for part in parts]
    return np.ascontiguousarray(np.hstack([np.zeros((count, 0)), *rows]))


def _cell_integral(compiled: Any) -> Any:
    if hasattr(compiled, "form_integrals"):
        return compiled.form_integrals[compiled.form_integral_offsets[0]]
    return compiled.integrals(0)[0]


def _coefficient_order(compiled: Any) -> Any:
    name = "original_coefficient_position"  # with an s of expressions, of forms from 0.7 on
    return getattr(compiled, name) if hasattr(compiled, name) else getattr(compiled, name + "s")


def num_dofs(space: Any) -> int:
    """Return the number of dofs of a cell."""
    element = space.ufl_element()
    if VERSION < (0, 7):
        from ffcx.element_interface import convert_element

        element = convert_element(element)
    return int(element.dim)


# -- compiling ----------------------------------------------------------------------------------


def compile_kernels(forms: Sequence[ufl.Form | Expression]) -> list[Kernel]:
    """Return the kernels of forms; those that no run has compiled are compiled now.

    One process compiles at a time, others wait for it and then find the forms.
    """
    with _locked(form_folder()) as folder:
        with quiet_compilers():
            folders = [_folder(form) for form in forms]
        missing = [at for at in folders if not _is_complete(at)]
        if missing:
            log.info("compiling %d form%s, once", len(missing), "s" * (len(missing) > 1))
        for at in missing:
            if at.exists():
                log.info("%s: a compilation was interrupted there and is repeated", folder)
                shutil.rmtree(at)
        with quiet_compilers():
            pairs = zip(forms, folders, strict=True)
            return [Kernel(form, _compiled(form, at)) for form, at in pairs]


def is_compiled(form: ufl.Form | Expression) -> bool:
    """Return whether a form is compiled, now or by an earlier run."""
    return _is_complete(_folder(form))


def _is_complete(folder: Path) -> bool:
    return any(folder.glob("*.cached"))


def _folder(form: ufl.Form | Expression) -> Path:
    return form_folder() / f"dolfinopt_{ffcx.naming.compute_signature([form], '')}"


def _compiled(form: ufl.Form | Expression, folder: Path) -> tuple[Any, Any, Any]:
    options = "jit_params" if VERSION < (0, 6) else "jit_options"
    compiled: tuple[Any, Any, Any] = dolfinx.jit.ffcx_jit(
        MPI.COMM_SELF, form, **{options: {"cache_dir": str(folder)}}
    )
    return compiled


@contextmanager
def _locked(folder: Path) -> Iterator[Path]:
    """Hold the folder's lock, which ends with the process; none where it cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = open(folder / "dolfinopt.lock", "w")
    except OSError:
        yield folder
        return
    with lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield folder
