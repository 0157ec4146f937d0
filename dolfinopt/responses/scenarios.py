"""One design under several scenarios: other payloads, paths, damping, other batches of material.

They all share the reduced bodies: a denser or stiffer material scales their integrals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.arms.arm import fixed_body
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, of_material, scaled
from dolfinopt.responses.p_norm import p_norm
from dolfinopt.scene.load import Scene


@dataclass(frozen=True)
class Factors:
    """What a scenario's material, and thickness, make of one arm's body.

    Attributes:
        mass, stiffness: relative to the scene's.
        damping: beta in D = beta K, s.
    """

    mass: float
    stiffness: float
    damping: float


def factors(scene: Scene, other: Scene, index: int) -> Factors:
    """Return what makes the body of arm `index` in `scene` that of the same design in `other`."""
    here, there = scene.material_of(index), other.material_of(index)
    thicker = 1.0
    if not scene.is_spatial:  # in plane stress
        thicker = other.arms[index].thickness / scene.arms[index].thickness
    return Factors(
        thicker * there.density / here.density,
        thicker * there.young_modulus / here.young_modulus,
        other.damping.stiffness_proportional,
    )


def bodies_in(
    scene: Scene, other: Scene, owned: Mapping[int, ShapeIntegrals]
) -> list[ShapeIntegrals]:
    """Return the bodies from the cart outwards in scenario `other` of `scene`.

    Args:
        scene: in which the bodies were reduced.
        other: one of its scenarios.
        owned: bodies of the arms with a design of their own.
    """
    bodies = []
    for index, owner in enumerate(scene.owners):
        if owner is None:
            bodies.append(fixed_body(other, index))
        else:
            f = factors(scene, other, owner)
            bodies.append(of_material(owned[owner], f.mass, f.stiffness, f.damping))
    return bodies


def cotangents_of_scene(cotangents: ShapeIntegrals, f: Factors, weight: float) -> ShapeIntegrals:
    """Return weighted derivatives by the scene's body from those by the scenario's, see `scaled`.

    Those of D join K's.
    """
    by_K = cotangents.K + f.damping * cotangents.D
    back = replace(
        cotangents,
        K=by_K,
        D=np.zeros_like(cotangents.D),
        outboard=weight * cotangents.outboard,
        K0_outboard=weight * cotangents.K0_outboard,
    )
    return scaled(back, weight * f.mass, weight * f.stiffness, 1.0)


def worst_of(
    values: Sequence[float], exponent: float, least: bool = False
) -> tuple[float, list[float]]:
    """Return (sum f^p)^(1/p) of positive values and its derivatives; a single value is itself.

    With `least` the smallest one made smooth, (sum f^-p)^(-1/p).

    The largest, made smooth; with p = 20 it is 6 % above the largest of three equal ones:
    Kreisselmeier and Steinhauser's function of the logarithms.
    Source: Kreisselmeier & Steinhauser (1979), doi:10.1016/S1474-6670(17)65584-8.
    """
    if len(values) == 1 or max(values) == 0.0:
        return max(values), [1.0] * len(values)
    if least and min(values) == 0.0:
        return 0.0, [0.0] * len(values)
    f = 1.0 / np.array(values) if least else np.array(values)
    worst, by_values = p_norm(f, exponent)
    if least:  # of 1 / worst by 1 / f
        worst, by_values = 1.0 / worst, by_values * (f / worst) ** 2
    return worst, [float(by) for by in by_values]


def combined(
    scene: Scene, values: Sequence[float], least: bool = False
) -> tuple[float, list[float]]:
    """Return the objective of all scenarios from their own, and its derivatives.

    "sum": sum w f. "worst": the smooth largest of w f, with `objective.exponent`; or with `least`,
    of what is maximised, the smooth smallest.
    """
    weights = [one.weight for one in scene.scenarios]
    if scene.objective.scenarios == "sum":
        return sum(w * f for w, f in zip(weights, values, strict=True)), weights
    scaled_values = [w * f for w, f in zip(weights, values, strict=True)]
    worst, by_values = worst_of(scaled_values, scene.objective.exponent, least)
    return worst, [s * w for s, w in zip(by_values, weights, strict=True)]
