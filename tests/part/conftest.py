"""Designs whose parts are known, without an optimisation."""

from functools import lru_cache

import numpy as np
import pytest
from mpi4py import MPI
from runs import scene

from dolfinopt.arms.arm import build_arms
from dolfinopt.parallel import partition_arms
from dolfinopt.part.domain import domain_of
from dolfinopt.profiling import Profile

ONE = ("arms.1.rigid=true", "design.projection=robust", "arms.0.passive=0.015")


@lru_cache(maxsize=8)
def built(*changes):
    """Return a scene and its only arm with a design."""
    one = scene(*changes)
    partition = partition_arms(MPI.COMM_SELF, one.cell_counts)
    return one, build_arms(one, partition, Profile())[0]


@pytest.fixture
def design():
    """Return a function that makes the domain of a density given by x and y, m."""

    def make(density, *changes):
        one, arm = built(*ONE, *changes)
        values = np.asarray(density(*arm.mesh.centroid.T), dtype=float)
        return domain_of(one, 0, arm.mesh, arm.mesh.keep(values))

    return make
