"""What one rank computes of a study: one design in many scenes, or at samples of their values."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dolfinopt.dynamics.simulation import Trajectory, simulate_batch
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.profiling import Counts, Profile
from dolfinopt.responses.response import bodies_in
from dolfinopt.scene.load import Scene
from dolfinopt.study import variants

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm
    from dolfinopt.output.run_folder import Simulated
    from dolfinopt.parallel import Partition
    from dolfinopt.responses.evaluation import Evaluation

MODES = 3  # natural modes that `compare` looks at
# Keys that leave the reduced bodies as they are, or scale them: in plane stress mass and stiffness
# are linear in the thickness.
SCALING = r"(motion|payload|damping)\..+|(material|arms|arms\..+)\.(young_modulus|density)"
THICKNESS = r"arms\.(.+\.)?thickness"


def simulate_scenarios(
    scenes: Sequence[Scene], design: Path | None
) -> Iterator[Simulated | ConvergenceError]:
    """Simulate one design in many scenes, on this rank alone.

    Arms are meshed, assembled and factorised once; neighbours with the same `reduction` share it
    and are simulated in one batch, whose time and counts the first of them bears.

    Args:
        scenes: that differ in `cases.SCENARIO` alone; neighbours also in what `Case.batch_key`
            allows.
        design: design.npz, or None, the initial one.

    Returns:
        In the scenes' order; of one that fails its error.

    Raises:
        InputError: the design does not fit the arms.
    """
    from dolfinopt.output.run_folder import Simulated
    from dolfinopt.responses.evaluation import evaluate_batch
    from dolfinopt.responses.order_selection import choose_coordinates

    profile = Profile()
    partition, arms, x_phys = _posed(scenes[0], design, profile)
    for batch in _neighbours(scenes):
        arms = {k: arm.under(batch[0]) for k, arm in arms.items()}
        every: Sequence[tuple[Evaluation, Trajectory | None] | ConvergenceError]
        choice = None
        try:
            choice = choose_coordinates(batch[0], partition, arms, x_phys, profile)
            every = evaluate_batch(batch, partition, arms, x_phys, profile)
        except ConvergenceError as error:
            every = [error]
        for scene, found in zip(batch, every, strict=True):
            if isinstance(found, ConvergenceError):
                yield found
            else:
                yield Simulated(scene, partition, arms, x_phys, *found, profile, choice)
            _clear(profile)


def _neighbours(scenes: Sequence[Scene]) -> Iterator[list[Scene]]:
    """Yield neighbours with one basis; where it is chosen, "auto", each scene alone."""
    for reduction, group in groupby(scenes, key=lambda scene: scene.reduction):
        if reduction.coordinates == "auto":
            yield from ([scene] for scene in group)
        else:
            yield list(group)


@dataclass(frozen=True)
class BasisFigures:
    """What one arm's basis misses, see `reduction.BasisErrors`; first `MODES` modes.

    Attributes:
        arm: its name.
        frequency: relative excess of the natural frequencies.
        mac: modal assurance criterion of the modes that belong to them.
        compliance: relative loss under unit loads at the outboard interface, F_x, F_y, moment; in
            space three forces and three moments.
        angle: rad, between the reference's modes and the basis.
    """

    arm: str
    frequency: Sequence[float]
    mac: Sequence[float]
    compliance: Sequence[float]
    angle: Sequence[float]


def compare(
    scenes: Sequence[Scene], design: Path | None
) -> Iterator[tuple[BasisFigures, ...] | ConvergenceError]:
    """Compare one design's bases with those of `variants.REFERENCE` coordinates, on this rank.

    Args:
        scenes: that differ in `cases.SCENARIO` alone; their reduction counts.
        design: design.npz, or None, the initial one.

    Raises:
        InputError: the design does not fit the arms.
    """
    from dolfinopt.reduction import METHODS, Options, basis_errors
    from dolfinopt.responses.order_selection import choose_coordinates

    profile = Profile()
    partition, arms, x_phys = _posed(scenes[0], design, profile)
    richer = {}
    for k, arm in arms.items():
        arm.set_design(x_phys[k])
        most = min(variants.REFERENCE, arm.elastic.num_dofs)
        richer[k] = METHODS[variants.REFERENCE_METHOD].reduce(arm.elastic, Options(most), None)
    for scene in scenes:
        figures = []
        try:
            arms = {k: arm.under(scene) for k, arm in arms.items()}
            choose_coordinates(scene, partition, arms, x_phys, profile)
            for k, arm in arms.items():
                arm.reduce(x_phys[k])
                assert arm.basis is not None
                errors = basis_errors(arm.elastic, arm.basis, richer[k], MODES)
                values = (errors.frequency, errors.mac, errors.compliance, errors.angle)
                figures.append(BasisFigures(scene.arms[k].name, *(list(v) for v in values)))
        except ConvergenceError as error:
            yield error
        else:
            yield tuple(figures)


# -- samples ---------------------------------------------------------------------------------


def scales_bodies(scene: Scene, keys: Iterable[str]) -> bool:
    """Return whether one reduction serves all values of these keys."""
    known = SCALING if scene.is_spatial else f"{SCALING}|{THICKNESS}"
    return all(re.fullmatch(known, key) for key in keys)


def with_sample(scene: Scene, changes: Sequence[str], number: int) -> Scene:
    """Return the scene with a sample's values.

    Args:
        changes: "key.path=value" each; none: the nominal scene.
        number: of the sample, for messages.

    Raises:
        InputError: the scene cannot have them.
    """
    try:
        return variants.changed(scene, *changes)
    except InputError as error:
        raise InputError(f"--random, sample {number} ({', '.join(changes)}): {error}") from None


def simulate_samples(
    nominal: Simulated | ConvergenceError | None,
    scenes: Sequence[Scene],
    design: Path | None,
    scaled: bool,
) -> Iterator[Trajectory | ConvergenceError]:
    """Simulate a design in scenes, on this rank alone.

    Every sample starts from the nominal scene's solution: its bits depend on no other sample.

    Args:
        nominal: the design in the nominal scene; None unless `scaled`.
        scenes: the samples'.
        design: design.npz, or None, the initial one.
        scaled: whether the nominal bodies are scaled, or reduced anew in every scene.
    """
    if not scaled:
        for scene in scenes:
            (found,) = simulate_scenarios([scene], design)
            trajectory = found if isinstance(found, ConvergenceError) else found.trajectory
            assert trajectory is not None  # on a single rank
            yield trajectory
    elif isinstance(nominal, ConvergenceError):
        yield from [nominal] * len(scenes)
    else:
        assert nominal is not None and nominal.trajectory is not None
        owned = {k: nominal.trajectory.mechanism.bodies[k] for k in nominal.arms}
        bodies = [bodies_in(nominal.scene, scene, owned) for scene in scenes]
        # At once: less than half the time of one after the other.
        starts = [nominal.trajectory.solution] * len(scenes)
        yield from simulate_batch(scenes, bodies, Profile(), starts)


# -- arms ------------------------------------------------------------------------------------


def _posed(
    scene: Scene, design: Path | None, profile: Profile
) -> tuple[Partition, dict[int, Arm], dict[int, np.ndarray]]:
    """Build the arms on this rank; return them with the physical densities of the design."""
    from mpi4py import MPI

    from dolfinopt.arms.arm import build_arms, uniform_design
    from dolfinopt.output.design import read_design
    from dolfinopt.parallel import partition_arms

    partition = partition_arms(MPI.COMM_SELF, scene.cell_counts)
    arms = build_arms(scene, partition, profile)
    if design is not None:
        return partition, arms, read_design(design, partition, arms)
    return partition, arms, uniform_design(scene, partition, arms, scene.design.initial)


def _clear(profile: Profile) -> None:
    """Begin the account of the next scene; its profile is known to the arms."""
    profile.seconds.clear()
    profile.counts = Counts()
