"""Inertias of a robot that cannot be, as they are common in URDF files: one line each.

A rigid body's inertia tensor about its centre is positive definite, and none of its principal
moments exceeds the sum of the others; radius of gyration and mean density follow from its size.
Source: Traversaro, Brossette, Escande & Nori, Identification of fully physical consistent inertial
parameters using optimization on manifolds (2016), doi:10.1109/IROS.2016.7759801.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dolfinopt.exchange.urdf.robot import Robot, RobotLink

DENSITIES = (100.0, 20000.0)  # kg/m3: a hollow cover, tungsten
OUTSIDE = 0.1  # of the diagonal of the box around the geometry
SLENDER = 0.03  # least radius of gyration over that diagonal; of a ball it is 0.18
ROUNDING = 1e-6


def implausible_inertias(robot: Robot) -> list[str]:
    """Return a sentence for every inertia of a robot that cannot be, or hardly."""
    found = []
    for link in robot.links.values():
        found += [f"{robot.file}: link {link.name!r}: {what}" for what in _of_link(robot, link)]
    return found


def _of_link(robot: Robot, link: RobotLink) -> Iterator[str]:
    mass, tensor = link.own.mass, link.own.tensor
    for name in link.missing:
        yield f"mesh {name} cannot be read; its size is not known"
    if mass < 0.0:
        yield f"mass {mass:g} kg is negative"
        return
    if mass == 0.0:
        if link.name != robot.root and robot.holder[link.name].moves and link.shapes:
            yield "no mass, though it has a shape and a joint that moves"
        elif tensor.any():
            yield "an inertia without mass"
        return
    principal = np.linalg.eigvalsh(tensor)
    if principal[0] <= 0.0:
        yield (
            f"its inertia is not positive definite: principal moments {_listed(principal)} kg m2"
        )
    elif principal[2] > (1.0 + ROUNDING) * (principal[0] + principal[1]):
        yield (
            f"its inertia cannot be: of the principal moments {_listed(principal)} kg m2 the "
            "largest exceeds the sum of the others"
        )
    if len(link.points):
        yield from _of_size(link, principal)


def _of_size(link: RobotLink, principal: np.ndarray) -> Iterator[str]:
    """Compare mass, centre and inertia with the link's geometry."""
    mass, centre = link.own.mass, link.own.centre
    low, high = link.points.min(axis=0), link.points.max(axis=0)
    diagonal = float(np.linalg.norm(high - low))
    away = float(np.linalg.norm(np.maximum(0.0, np.maximum(low - centre, centre - high))))
    if away > OUTSIDE * diagonal:
        yield f"its centre of mass is {away:.3g} m outside its geometry, {diagonal:.3g} m across"
    gyration = float(np.sqrt(max(0.0, principal.sum() / 2.0 / mass)))
    if gyration > diagonal:
        yield (
            f"its inertia is too large: a radius of gyration of {gyration:.3g} m in a geometry "
            f"{diagonal:.3g} m across"
        )
    elif gyration < SLENDER * diagonal:
        yield (
            f"its inertia is too small: a radius of gyration of {gyration:.3g} m in a geometry "
            f"{diagonal:.3g} m across"
        )
    density = mass / link.volume if link.volume > 0.0 else np.inf
    if not DENSITIES[0] <= density <= DENSITIES[1]:
        low_density, high_density = DENSITIES
        yield (
            f"{mass:.4g} kg in {link.volume:.3g} m3 are {density:.3g} kg/m3; expected "
            f"{low_density:g} to {high_density:g}: mass or unit of the geometry (mm?) is wrong"
        )


def _listed(values: np.ndarray) -> str:
    return ", ".join(f"{value:.4g}" for value in values)
