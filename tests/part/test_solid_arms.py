"""Solid arms have no outline: parts of them are refused, before anything is meshed."""

from __future__ import annotations

import pytest
from mpi4py import MPI
from solids import solid_scene

from dolfinopt.errors import InputError
from dolfinopt.part.domain import read_domains


def test_parts_of_solids_are_refused(tmp_path):
    with pytest.raises(InputError, match="arm 'arm1' is a solid"):
        read_domains(solid_scene(), tmp_path, MPI.COMM_WORLD)
