"""A link's closed geometry between its joints, as the surface of a solid in the arm's frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.exchange.urdf.bodies import SceneBody
from dolfinopt.exchange.urdf.robot import RobotLink, inverse

if TYPE_CHECKING:
    from trimesh import Trimesh

CENTRED = 0.04  # of the larger side, how far the middle of an end may be from its joint
FLAT = 1e-6  # of the length


class NoSolid(ValueError):
    """A link's geometry is no solid between its joints; the message says why."""


def between_joints(link: RobotLink, body: SceneBody) -> Trimesh:
    """Return a link's geometry from x = 0 to x = length, closed and flat at both ends.

    Shapes are united and what is beyond the joints is cut off.

    Raises:
        NoSolid: there is no geometry, it is open, in several parts, or its ends are not about the
            joints.
    """
    from trimesh import boolean, creation

    if not link.shapes:
        raise NoSolid("it has no geometry")
    if not link.is_closed:
        raise NoSolid("its geometry is not closed")
    shapes = [one.copy() for one in link.shapes]
    far = 10.0 * (body.length + float(np.abs(link.points).max()))
    for one in shapes:
        one.apply_transform(inverse(body.frame))
    box = creation.box(bounds=[[0.0, -far, -far], [body.length, far, far]])
    whole = boolean.union(shapes, engine="manifold") if len(shapes) > 1 else shapes[0]
    found = boolean.intersection([whole, box], engine="manifold")
    if not len(found.faces) or not found.is_watertight:
        raise NoSolid("none of its geometry is between its joints")
    if found.body_count > 1:
        raise NoSolid(f"its geometry is in {found.body_count} parts")
    sides = np.ptp(found.vertices, axis=0)[1:]
    for x, joint in ((0.0, "inboard"), (body.length, "outboard")):
        at = found.vertices[np.abs(found.vertices[:, 0] - x) < FLAT * body.length, 1:]
        if len(at) < 3:
            raise NoSolid(f"its geometry does not reach the {joint} joint")
        middle = 0.5 * (at.min(axis=0) + at.max(axis=0))
        if np.linalg.norm(middle) > CENTRED * sides.max():
            raise NoSolid(f"its geometry is not centred about the {joint} joint")
    return found
