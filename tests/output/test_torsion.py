"""What a run says where cells are too few for the torsion of its motion."""

from types import SimpleNamespace

import numpy as np
import pytest

from dolfinopt.output.torsion import torsion_error, torsion_share, torsion_warnings

pytestmark = pytest.mark.serial  # ranks have no part in it

STIFFNESS = 3e5, 2e3  # of bending, N/m, and torsion, N m
# Errors of the torsion constant by Saint-Venant's series, see tests/fem/test_elements.py.
FOUND = {(1, 1): 0.186, (2, 2): 0.186, (3, 3): 0.09, (4, 4): 0.052, (6, 6): 0.024, (6, 4): 0.031}


def bar():
    """Return a body that bends in y and turns about x, and both by its coordinates."""
    outboard = np.zeros((6, 2))
    outboard[1, 0] = outboard[3, 1] = 1.0
    T = np.array([[1.0, 0.4], [-0.3, 1.0]])
    return SimpleNamespace(K=T.T @ np.diag(STIFFNESS) @ T, outboard=outboard @ T), T


def test_share_of_torsion():
    body, T = bar()
    deflections = np.array([[1e-4, 0.0], [2e-4, 3e-3]])
    bending, torsion = (deflections**2 * STIFFNESS).sum(axis=0)
    share = torsion_share(body, deflections @ np.linalg.inv(T).T)
    assert share == pytest.approx(torsion / (bending + torsion))


def test_error_by_cells():
    for cells, error in FOUND.items():
        assert torsion_error(*cells) == pytest.approx(error, rel=0.2)


@pytest.mark.parametrize(
    ("keys", "told"),
    [({}, True), ({"element": "quadratic"}, False), ({"cells": (9, 12, 8)}, False),
     ({"hollow": True}, False)],
)  # fmt: skip
def test_warning(keys, told):
    body, T = bar()
    arm = SimpleNamespace(
        **({"name": "rod", "cells": (9, 3, 3), "hollow": False, "element": None} | keys)
    )
    mechanism = SimpleNamespace(bodies=[body], slices=[slice(0, 2)])
    scene = SimpleNamespace(arms=[arm], dimension=3)
    q = np.array([[0.0, 1e-3]]) @ np.linalg.inv(T).T  # torsion alone
    found = [*torsion_warnings(SimpleNamespace(scene=scene, mechanism=mechanism, q_e=q))]
    assert len(found) == told
    assert all("100 %" in one and "9.6 %" in one and "quadratic" in one for one in found)
