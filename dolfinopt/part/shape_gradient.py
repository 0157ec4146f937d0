"""The derivative of the objective by the nodes of a part's mesh, of the discrete model."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from dolfinopt.part.body_mesh import BodyMesh
from dolfinopt.part.forms import Simulated
from dolfinopt.profiling import Profile
from dolfinopt.responses.shape_sensitivity import by_nodes


def by_outline(state: Simulated, bodies: Mapping[int, BodyMesh]) -> dict[int, np.ndarray]:
    """Return the objective's derivative (k, 2) by the first node of every side of the bodies.

    Nodes inside follow the outline as in `BodyMesh.morphed`.
    """
    from dolfinopt.responses.evaluation import gradient

    parts = state.scene, state.partition, state.arms, state.trajectory
    by_mesh = gradient(*parts, Profile(), by=by_nodes)
    found = {}
    for k, body in bodies.items():
        # The arm's nodes may be in another order than those of the file.
        places = state.arms[k].mesh.mesh.geometry.x[:, :2]
        order = cKDTree(places).query(body.points)[1]
        found[k] = body.at_outline(by_mesh[k][order])
    return found
