"""What one rank computes of a study: one design in many scenes, or at samples of their values."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from mpi4py import MPI

from dolfinopt.dynamics.simulation import Trajectory, simulate_batch
from dolfinopt.errors import ConvergenceError
from dolfinopt.output.design import arms_with_design
from dolfinopt.output.run_folder import Simulated
from dolfinopt.profiling import Counts, Profile
from dolfinopt.responses.evaluation import Evaluation, evaluate_batch
from dolfinopt.responses.order_selection import choose_coordinates
from dolfinopt.responses.response import bodies_in
from dolfinopt.scene.load import Scene
from dolfinopt.study import variants

# These values of material and arms scale the integrals of the reduced arms; the thickness in the
# plane alone: in space it is one of the cells' sides.
SCALING = ("young_modulus", "density", "thickness")
APART = (
    "motion",
    "payload",
    "forces",
    "damping",
)  # tables that leave the reduced bodies as they are


def simulate_scenarios(
    scenes: Sequence[Scene], design: Path | None
) -> Iterator[Simulated | ConvergenceError]:
    """Simulate one design in many scenes, on this rank alone; of one that fails yield its error.

    Arms are meshed, assembled and factorised once; neighbours with the same basis share it and are
    simulated in one batch, whose time and counts the first of them bears. Scenes differ in
    `cases.SCENARIO` alone, neighbours also in what `Case.batch_key` allows. No design.npz is the
    initial design; InputError where one does not fit the arms.
    """
    profile = Profile()
    partition, arms, x_phys = arms_with_design(MPI.COMM_SELF, scenes[0], design, profile)
    for _, neighbours in groupby(enumerate(scenes), key=lambda numbered: _basis(*numbered)):
        batch = [scene for _, scene in neighbours]
        arms = {k: arm.under(batch[0]) for k, arm in arms.items()}
        every: Sequence[tuple[Evaluation, Trajectory | None] | ConvergenceError]
        choice = None
        try:
            choice = choose_coordinates(batch[0], partition, arms, x_phys, profile)
            every = evaluate_batch(batch, partition, arms, x_phys, profile)
        except ConvergenceError as error:
            every = [error] * len(batch)
        for scene, found in zip(batch, every, strict=True):
            if isinstance(found, ConvergenceError):
                yield found
            else:
                yield Simulated(scene, partition, arms, x_phys, *found, profile, choice)
            profile.seconds.clear()  # the account of the next scene; the arms know the profile
            profile.counts = Counts()


def _basis(number: int, scene: Scene) -> Any:
    """Return what is equal for scenes with one basis; each has its own where it is chosen."""
    reduction = scene.reduction
    if reduction.coordinates == "auto":
        return number
    return reduction, scene.damping if reduction.method == "balanced" else None


# -- samples ---------------------------------------------------------------------------------


def scales_bodies(scene: Scene, keys: Iterable[str]) -> bool:
    """Return whether one reduction serves all values of these keys."""
    scaling = set(SCALING) - set(scene.arm_sizes)
    parts = [key.split(".") for key in keys]
    return all(
        one[0] in APART or (one[0] in ("material", "arms") and one[-1] in scaling) for one in parts
    )


def with_sample(scene: Scene, changes: Sequence[str], number: int) -> Scene:
    """Return the scene with a sample's values, "key.path=value" each.

    InputError where the scene cannot have them; it names the sample's number.
    """
    with variants.asked_by(f"--random, sample {number} ({', '.join(changes)})"):
        return variants.changed(scene, *changes)


def simulate_samples(
    nominal: Simulated | ConvergenceError | None, scenes: Sequence[Scene], design: Path | None
) -> Iterator[Trajectory | ConvergenceError]:
    """Simulate a design (design.npz, or None, the initial one) in scenes, on this rank alone.

    The bodies are scaled from those of `nominal`, the design in the nominal scene, and every sample
    starts from its solution: the bits depend on no other sample. None: they are reduced anew.
    """
    if nominal is None:
        for scene in scenes:
            (found,) = simulate_scenarios([scene], design)
            trajectory = found if isinstance(found, ConvergenceError) else found.trajectory
            assert trajectory is not None  # on a single rank
            yield trajectory
    elif isinstance(nominal, ConvergenceError):
        yield from [nominal] * len(scenes)
    else:
        assert nominal.trajectory is not None
        owned = {k: nominal.trajectory.mechanism.bodies[k] for k in nominal.arms}
        bodies = [bodies_in(nominal.scene, scene, owned) for scene in scenes]
        # At once: less than half the time of one after the other.
        starts = [nominal.trajectory.solution] * len(scenes)
        yield from simulate_batch(scenes, bodies, Profile(), starts)
