"""What is still to be known of an optimised design when the iterations have ended.

And designs that it is compared with, which the iterations do not come to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI

from dolfinopt.arms.arm import Arm, uniform_design
from dolfinopt.dynamics.build import Trajectory
from dolfinopt.errors import ConvergenceError
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.parallel import together
from dolfinopt.responses.constraints import Limit, limits_of
from dolfinopt.responses.evaluation import Evaluation, evaluate
from dolfinopt.responses.order_selection import (
    Comparison,
    OrderSelection,
    Reductions,
    choose_coordinates,
)
from dolfinopt.responses.response import constraints_of, needs
from dolfinopt.scene.tables.responses import STATICS, limited_by


@dataclass(frozen=True, eq=False)
class Assessment:
    """The final design with its motion, as `Result` has it.

    Attributes:
        evaluation: of the design, with the motion.
        crisp: of the design cut at x_phys = 1/2 without what hangs on it by contacts alone, see
            `Contacts.kept`; None without a projection, or where the interfaces do not hang together
            or the motion of what is left cannot be simulated.
        initial: trajectory of the uniform initial design where the iterations had no motion.
        selection: of the coordinates, with the error that they make of this design's motion.
    """

    evaluation: Evaluation
    crisp: Evaluation | None
    initial: Trajectory | None
    selection: OrderSelection | None


def assess(
    evaluator: Evaluator,
    x_phys: Mapping[int, np.ndarray],
    evaluation: Evaluation,
    selection: OrderSelection | None,
) -> Assessment:
    """Evaluate what the iterations left out: motions not simulated, and the crisp design.

    Collective; the arms, and `evaluator.trajectory`, are those of the design afterwards.

    Args:
        evaluator: of the iterations.
        x_phys, evaluation: of the final design.
        selection: of the coordinates so far.
    """
    scene, arms = evaluator.scene, evaluator.arms
    moves, place = needs(scene, "motion"), (scene, evaluator.partition, arms, x_phys)
    if not moves:
        selection = choose_coordinates(*place, evaluator.profile)
    elif selection is not None:
        error = np.inf  # of a richer motion that cannot be simulated; the design is not lost for it
        with suppress(ConvergenceError):
            known = Comparison(Reductions(*place, evaluator.profile))
            error = known.error(selection.coordinates)
        selection = replace(selection, error=error)
    # A followed mode is known by those before it: the initial and the crisp design's are not.
    vectors = {k: arm.initial_vectors for k, arm in arms.items()}
    initial = crisp = None
    if not moves:
        uniform = uniform_design(scene, evaluator.partition, arms)
        evaluator.evaluate_densities(uniform, simulated=True)
        initial = evaluator.trajectory
    if scene.design.projection:
        crisp = _crisp(evaluator, x_phys)
    if scene.design.projection or not moves:
        for k, arm in arms.items():
            arm.initial_vectors = vectors[k]
        evaluation = evaluator.evaluate_densities(x_phys, simulated=True)
    return Assessment(evaluation, crisp, initial, selection)


def _crisp(evaluator: Evaluator, x_phys: Mapping[int, np.ndarray]) -> Evaluation | None:
    """Return the evaluation of the design cut at 1/2, contacts opened; None if it falls apart."""
    # The same on all ranks.
    arms = evaluator.arms
    with together(evaluator.partition.world):
        result = {k: arms[k].contacts(x > 0.5) for k, x in x_phys.items()}
    joined = all(item.joins for item in result.values())
    if not evaluator.partition.world.allreduce(joined, MPI.MIN):
        return None
    cut = {k: np.where(item.kept, 1.0, 0.0) for k, item in result.items()}
    with suppress(ConvergenceError), evaluator.bounded():
        return evaluator.evaluate_densities(cut, simulated=True)
    return None


# -- comparison with solid arms and straight bars --------------------------------------------


def evaluated_separately(
    evaluator: Evaluator, x_phys: Mapping[int, np.ndarray]
) -> Evaluation | None:
    """Evaluate another design, of which the run knows nothing afterwards (collective).

    None where its motion cannot be simulated.
    """
    own, scene = evaluator, evaluator.scene
    arms = {k: arm.fresh() for k, arm in own.arms.items()}
    for k, arm in arms.items():
        arm.coordinates = own.arms[k].coordinates
        if (known := own.arms[k].stiffening) is not None:
            arm.set_stiffening(known)
    counts, result = replace(own.profile.counts), None
    with suppress(ConvergenceError):
        result = evaluate(scene, own.partition, arms, x_phys, own.profile, simulated=False)[0]
    own.profile.counts = counts
    return result


def solid_limits(evaluator: Evaluator) -> tuple[Limit, ...]:
    """Return what solid arms make of the limits but those of the material (collective).

    None where there are no others, or where their motion cannot be simulated.
    """
    scene = evaluator.scene
    if all(item.response.declared.of_nominal for item in constraints_of(scene)):
        return ()
    solid = uniform_design(scene, evaluator.partition, evaluator.arms, 1.0)
    result = evaluated_separately(evaluator, solid)
    return () if result is None else tuple(o for o in limits_of(scene, result) if not o.of_mass)


def solid_sentence(limits: Sequence[Limit]) -> str:
    """Say what solid arms make of limits; "cannot be kept" where no lighter ones do better.

    Only loads that no mass adds to tell that: under inertia lighter arms may keep the limit.
    """
    never = [not item.met and limited_by(item.quantity).needs == STATICS for item in limits]
    parts = [item.usage + " (cannot be kept)" * out for item, out in zip(limits, never)]
    return f"solid arms: {', '.join(parts)}"


def straight_bars(
    evaluator: Evaluator, x_phys: Mapping[int, np.ndarray]
) -> dict[int, np.ndarray] | None:
    """Return straight solid bars of the same mass along the arms' axes (collective).

    Their section is the arms' made smaller alike. None where an arm is no box of cells.
    """
    scene, arms = evaluator.scene, evaluator.arms
    if any(scene.arms[k].cells is None or scene.arms[k].hollow for k in scene.cell_counts):
        return None
    with together(evaluator.partition.world):
        return {k: _bar(arm, arm.volume_fraction(x_phys[k])) for k, arm in arms.items()}


def _bar(arm: Arm, fraction: float) -> np.ndarray:
    """Return the densities (n_cells,) of a bar that fills this fraction of an arm's volume."""
    from scipy.optimize import brentq

    away = np.abs(across(arm)).max(axis=1)

    def lack(size: float) -> float:
        return fraction - float(arm.volume_fraction(filled(arm, size - away)))

    size = 0.0 if lack(0.0) <= 0.0 else 1.0 if lack(1.0) >= 0.0 else brentq(lack, 0.0, 1.0)
    return filled(arm, size - away)


def across(arm: Arm) -> np.ndarray:
    """Return how far cells are off the axis (n_cells, d - 1), in half sides of an arm's box."""
    sizes = arm.scene.arms[arm.places[0]]
    return (
        2.0
        * arm.mesh.centroid[:, 1:]
        / np.array([sizes.height, sizes.thickness][: arm.mesh.dim - 1])
    )


def filled(arm: Arm, depth: np.ndarray) -> np.ndarray:
    """Return the densities of cells whose centres lie so deep in material, in half sides.

    Cells that its surface cuts are filled in part.
    """
    cells = arm.scene.arms[arm.places[0]].cells
    assert cells is not None
    return arm.mesh.keep(np.clip(0.5 + 0.5 * depth * min(cells[1:]), arm.scene.design.minimum, 1.0))
