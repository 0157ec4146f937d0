"""What the responses that a scene can name need; `dolfinopt.responses` computes them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from dolfinopt.scene.schema import Scene

# What must be known beside the densities.
Need = Literal["stiffness", "mass", "motion", "eigenproblem"]
MOTION: frozenset[Need] = frozenset({"stiffness", "mass", "motion"})
VIBRATION: frozenset[Need] = frozenset({"stiffness", "mass", "eigenproblem"})
STATICS: frozenset[Need] = frozenset({"stiffness"})
NEEDS: Mapping[str, frozenset[Need]] = {
    "mass": frozenset(),
    "esl": MOTION,
    "compliance": MOTION,
    "deviation": MOTION,
    "settling": MOTION,
    "stress": MOTION,
    "static": STATICS,
    "eigenfrequency": VIBRATION,
    "first_frequency": VIBRATION,
    "tip_deflection": STATICS,
    "effort": MOTION,
    "peak_force": MOTION,
}
# Those that no equivalent static load tells anything of: their gradient is always the exact one.
EXACT_ONLY = frozenset({"effort", "peak_force"})
# What uses an option of [objective]: as objective, and under [constraints].
OPTIONS: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "worst": (("esl",), ("esl",)),
    "stress_exponent": (("stress",), ("stress",)),
    "loads": (("static", "tip_deflection"), ("tip_deflection",)),
    "effort_weights": (("effort", "peak_force"), ("effort",)),
    "attached": (("eigenfrequency", "first_frequency"), ("first_frequency",)),
    "elbow_angle": (("eigenfrequency", "first_frequency"), ("first_frequency",)),
    "modes": (("eigenfrequency", "first_frequency"), ("first_frequency",)),
    "follow": (("eigenfrequency",), ()),
}
# Those that fall with the mass, down to that of no arm at all.
LIGHTER = frozenset({"mass", "effort", "peak_force"})


def asked(scene: Scene) -> list[str]:
    """Return the words of the objective and of everything under [constraints]."""
    return [scene.objective.kind, *scene.constraints.limits]


def unused_options(kind: str, limited: Collection[str]) -> list[str]:
    """Return the options of [objective] that nothing uses.

    Args:
        kind: the objective.
        limited: keys under [constraints].
    """
    return [
        key
        for key, (objectives, limits) in OPTIONS.items()
        if kind not in objectives and not set(limits) & set(limited)
    ]


def freezes(scene: Scene) -> bool:
    """Return whether a gradient of the scene differs with frozen loads from the exact one."""
    return bool(set(need_of(scene, "motion")) - EXACT_ONLY)


def needs_alone(scene: Scene, what: Collection[Need]) -> bool:
    """Return whether nothing of `asked` needs anything else; of unknown words nothing is known."""
    known = [NEEDS.get(name) for name in asked(scene)]
    return all(needs is not None and needs <= frozenset(what) for needs in known)


def need_of(scene: Scene, what: Need) -> list[str]:
    """Return those of `asked` that need that; of words that are no scene's nothing is known."""
    return [name for name in asked(scene) if what in NEEDS.get(name, ())]
