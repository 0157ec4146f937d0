"""What a response is, and where it is found: one file each, named like its word in the scene.

Objective and constraints of a scene are responses: `objective.kind = "deviation"` and every key of
[constraints] name one. To add one, write `responses/NAME.py` with a subclass of `Response` under
`@register`, and add NAME to the literal of `objective.kind` in scene/tables/objective.py or to the
keys in scene/tables/constraints.py.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, ClassVar, Literal, TypeVar

import numpy as np

if TYPE_CHECKING:
    from dolfinopt.arms.arm import Arm
    from dolfinopt.dynamics.simulation import Trajectory
    from dolfinopt.parallel import Partition
    from dolfinopt.profiling import Profile
    from dolfinopt.scene.load import Scene
    from dolfinopt.scene.tables.objective import Objective

T = TypeVar("T")
R = TypeVar("R", bound="type[Response]")

Need = Literal["motion", "mass", "eigenproblem"]
CellGradient = dict[int, np.ndarray]  # (n_cells,) of every arm of this rank


@dataclass(frozen=True, eq=False)
class Analysis:
    """What responses are computed from: the arms with one design set, and its motion.

    Attributes:
        scene: says what is asked.
        partition: which ranks do which arm.
        arms: this rank's.
        trajectory: on the root, where a response needs a motion; None elsewhere.
        profile: of this rank.
    """

    scene: Scene
    partition: Partition
    arms: Mapping[int, Arm]
    trajectory: Trajectory | None
    profile: Profile


@dataclass(frozen=True)
class Measured:
    """Values of a response, one an arm, or one of the whole machine; the same on all ranks.

    Attributes:
        response: its name.
        arms: whose they are; "" of the machine.
        values: true ones, in `Response.limit_unit`; what a limit is compared with in reports.
        smooth: differentiable ones, in `Response.unit`; what the optimiser works with.
    """

    response: str
    arms: tuple[str, ...]
    values: tuple[float, ...]
    smooth: tuple[float, ...]

    @property
    def total(self) -> float:
        """Sum of the smooth values: the objective."""
        return float(np.sum(self.smooth))


class Response(ABC):
    """A quantity of a design with its gradient; as objective, the sum of its values is minimised.

    Attributes:
        name: in scene and files.
        label: in words.
        unit: of the smooth values and the objective.
        limit_unit: of the true values and of a limit; "" where it is `unit`.
        lower: whether a limit is a lower one.
        needs: what must be known beside stiffness and design: a simulated motion, the mass matrix,
            an eigenproblem.
        stands_for: what the true values are, where they are another quantity than the objective.
        options: the scene's [objective], which has the options of all responses.
    """

    name: ClassVar[str]
    label: ClassVar[str]
    unit: ClassVar[str]
    limit_unit: ClassVar[str] = ""
    lower: ClassVar[bool] = False
    needs: ClassVar[frozenset[Need]] = frozenset()
    stands_for: ClassVar[str] = ""

    def __init__(self, options: Objective):
        self.options = options

    @abstractmethod
    def measure(self, analysis: Analysis) -> Measured:
        """Return the values of a design (collective)."""

    @abstractmethod
    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of every smooth value by the physical densities (collective)."""

    def constraint(self, smooth: np.ndarray, limit: float) -> np.ndarray:
        """Return the constraints, relative and kept where <= 0, from smooth values."""
        return smooth / limit - 1.0

    def constraint_gradient(self, gradient: np.ndarray, limit: float) -> np.ndarray:
        """Return the gradient of a constraint from that of its smooth value."""
        return gradient / limit


@dataclass(frozen=True, eq=False)
class Constraint:
    """A response and its limit, in the response's `limit_unit`."""

    response: Response
    limit: float


_known: dict[str, type[Response]] = {}


def register(response: R) -> R:
    """Make a response known under its name; decorates the class."""
    _known[response.name] = response
    return response


def find(name: str) -> type[Response]:
    """Return the response of that name, imported from the file of that name at first use."""
    if name not in _known:
        import_module(f"dolfinopt.responses.{name}")
    return _known[name]


def objective_of(scene: Scene) -> Response:
    """Return what the scene minimises."""
    return find(scene.objective.kind)(scene.objective)


def constraints_of(scene: Scene) -> list[Constraint]:
    """Return what the scene limits beside the volume, in the order of its keys."""
    limits = {key: limit for key, limit in vars(scene.constraints).items() if limit is not None}
    return [Constraint(find(key)(scene.objective), limit) for key, limit in limits.items()]


def needs(scene: Scene, what: Need) -> bool:
    """Return whether the objective or a constraint of the scene needs that."""
    asked = [objective_of(scene), *(one.response for one in constraints_of(scene))]
    return any(what in one.needs for one in asked)


def by_owner(scene: Scene, parts: Sequence[T]) -> dict[int, T]:
    """Add up what belongs to the arms of one design; rigid arms and those from files have none.

    Args:
        scene: with the arms.
        parts: one an arm, from the cart outwards.

    Returns:
        A sum a design, by the index of the arm that owns it.
    """
    total: dict[int, T] = {}
    for owner, part in zip(scene.owners, parts, strict=True):
        if owner is not None:
            total[owner] = total[owner] + part if owner in total else part  # type: ignore[operator]
    return total


def occurrences(scene: Scene) -> dict[int, int]:
    """Return how many arms have each design."""
    return by_owner(scene, [1] * len(scene.arms))


def on_all_ranks(partition: Partition, mine: Mapping[int, T]) -> dict[int, T]:
    """Return one object an arm on all ranks, in the arms' order (collective)."""
    from dolfinopt.parallel import gather_arms

    return partition.world.bcast(gather_arms(partition, mine), root=0)
