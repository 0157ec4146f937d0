"""What is possible in a scene, but hardly meant: a sentence each, told before the run.

The tables refuse what the arithmetic cannot do; these ranges hold every structural material
and any machine, so that what lies outside is most likely a wrong unit or a slipped digit.
"""

from __future__ import annotations

from dolfinopt.scene.schema import Scene
from dolfinopt.scene.tables.responses import need_of

# From soft foam and rubber to beyond diamond (1.2e12 Pa); from aerogel to beyond osmium
# (2.26e4 kg/m3).
YOUNG_MODULUS = 1e6, 2e12  # Pa
DENSITY = 1.0, 3e4  # kg/m3
GRAVITY = 30.0  # m/s2: more than on Jupiter
SLENDER = 1e3  # length over height, thickness over height and the like
HEAVY = 1e4  # payload over the mass of all arms


def implausible(scene: Scene) -> list[str]:
    """Return what in a valid scene is most likely a mistake, a sentence each.

    Every sentence names key, value, what is usual, and what follows from it.
    """
    return [*_materials(scene), *_sizes(scene), *_motion(scene), *_solid_ends(scene)]


def _materials(scene: Scene) -> list[str]:
    found: dict[str, None] = {}  # arms mostly have one material: no sentence twice
    for index, arm in enumerate(scene.arms):
        if arm.sid is not None:
            continue
        solid = scene.material_of(index)
        for key, unit, (low, high) in (
            ("young_modulus", "Pa", YOUNG_MODULUS),
            ("density", "kg/m3", DENSITY),
        ):
            value = getattr(solid, key)
            where = f"arms.{arm.name}" if getattr(arm, key) is not None else "material"
            if not low <= value <= high:
                found[
                    f"{where}.{key} = {value:g} {unit} is outside the range of structural "
                    f"materials, {low:g} to {high:g} {unit}; check the unit"
                ] = None
    return list(found)


def _sizes(scene: Scene) -> list[str]:
    found = []
    for index, arm in enumerate(scene.arms):
        radius = scene.filter_radius(index) if arm.designed else 0.0
        if not arm.own:
            continue
        if arm.height > arm.length and arm.interface_offset is None:
            found.append(
                f"arms.{arm.name}: its height, {arm.height:g} m, exceeds its length, "
                f"{arm.length:g} m, which is measured from joint to joint; check both"
            )
        if arm.length > SLENDER * arm.height or arm.thickness > SLENDER * arm.height:
            found.append(
                f"arms.{arm.name}: length {arm.length:g} m, height {arm.height:g} m and thickness "
                f"{arm.thickness:g} m differ by more than a factor of {SLENDER:g}; check the units"
            )
        if radius > arm.height:
            found.append(
                f"design.filter_radius = {radius:g} m exceeds the height of arm {arm.name!r}, "
                f"{arm.height:g} m: its design cannot vary across the arm"
            )
    return found


def _motion(scene: Scene) -> list[str]:
    found = []
    damping, motion = scene.damping.stiffness_proportional, scene.motion
    if need_of(scene, "motion") and damping > motion.duration:
        found.append(
            f"damping.stiffness_proportional = {damping:g} s: deflections relax in that time, "
            f"longer than motion.duration = {motion.duration:g} s, so that the arms hardly "
            "deflect; usual values are 1e-5 to 1e-2 s"
        )
    if max(map(abs, motion.gravity)) > GRAVITY:
        found.append(
            f"motion.gravity = {list(motion.gravity)} m/s2 exceeds {GRAVITY:g} m/s2; that of the "
            "Earth is 9.81"
        )
    mass = sum(
        arm.length * arm.height * arm.thickness * scene.material_of(index).density
        for index, arm in enumerate(scene.arms)
    )
    if scene.payload.mass > HEAVY * mass:
        found.append(
            f"payload.mass = {scene.payload.mass:g} kg is more than {HEAVY:g} times the mass of "
            f"all arms, {mass:.3g} kg"
        )
    return found


def _solid_ends(scene: Scene) -> list[str]:
    """Tell where the default of solid ends comes to nothing."""
    return [
        f"arms.{arm.name}.cells = {list(arm.cells)}: too coarse for the solid ends of "
        f"{arm.solid_ends:.3g} m that are kept by default, so that the joint may end up in void; "
        "take more cells along the arm, or state arms.passive"
        for arm in scene.arms
        if arm.designed and arm.cells is not None and arm.passive is None
        if not arm.passive_columns
    ]
