"""Compiling forms: once, told in one line; what an interrupted run has left is compiled anew."""

import logging
from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI

from dolfinopt.fem import forms, kernels
from dolfinopt.fem.forms import Cell
from dolfinopt.fem.kernels import compile_kernels
from dolfinopt.fem.tensors import reference_corners
from dolfinopt.mesh import compat

pytestmark = pytest.mark.serial  # ranks have no part in it

TRIANGLE = Cell("triangle", "linear")


def area(factor):
    return factor * forms.dx_stiffness(TRIANGLE)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return an empty folder for compiled forms."""
    monkeypatch.setattr(kernels, "form_folder", lambda: tmp_path)
    return tmp_path


def told(caplog):
    """Return the lines since the last call."""
    lines = [record.getMessage() for record in caplog.records]
    caplog.clear()
    return lines


def test_forms_are_compiled_once(folder, caplog):
    caplog.set_level(logging.INFO, "dolfinopt.progress")
    corners = np.zeros((2, 3, 3))
    corners[:, :, :2] = reference_corners(TRIANGLE) * [3.0, 0.5]
    for lines in (["compiling 2 forms, once"], []):
        first, second = compile_kernels([area(2.0), area(4.0)])
        assert told(caplog) == lines
        assert np.allclose([first(corners, {}), second(corners, {})], [[1.5] * 2, [3.0] * 2])


def test_an_interrupted_compilation(folder, caplog):
    """A file in C without what tells that it was compiled: told by its folder, and repeated."""
    caplog.set_level(logging.INFO, "dolfinopt.progress")
    compile_kernels([area(1.0)])
    [done] = folder.glob("dolfinopt_*/*.cached")
    done.unlink()
    told(caplog)
    compile_kernels([area(1.0)])
    assert any(str(folder) in line and "interrupted" in line for line in told(caplog))
    assert done.exists()


def test_an_interrupted_element(tmp_path, monkeypatch):
    """DOLFINx gives up waiting for a file that is never finished; ours is removed, others stay."""
    monkeypatch.setattr(compat, "form_folder", lambda: tmp_path)
    for name in ("left.c", "done.c", "done.c.cached"):
        (tmp_path / name).touch()
    space, calls = object(), []

    def once(*arguments):
        calls.append(arguments)
        if len(calls) == 1:
            raise TimeoutError
        return space

    monkeypatch.setattr(compat, "_lagrange_space", once)
    assert compat.lagrange_space(SimpleNamespace(comm=MPI.COMM_SELF), 1) is space
    assert sorted(path.name for path in tmp_path.iterdir()) == ["done.c", "done.c.cached"]
