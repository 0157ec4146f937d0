"""What a response is, and where it is found: one file each, named like its word in the scene.

Objective and constraints of a scene are responses: `objective.kind = "deviation"`, every key of
[constraints] and `design.volume_fraction` name one. To add one, write `responses/NAME.py` with a
subclass of `Response` under `@register`; add NAME to the literal of `objective.kind` in
scene/tables/objective.py and to the keys in scene/tables/constraints.py, and what it needs to
scene/tables/responses.py.

The one rule of aggregation: an extreme over instants, modes, load cases or scenarios has a true
value, which reports show and limits hold for, and a smooth one, its p-mean or p-norm with
`objective.exponent`, which is differentiated. A constraint is the true value over its limit less
1; its gradient is that of smooth value / smooth limit, where the smooth limit is the limit times
smooth / true value of the same design, held: a scale that follows the design and has no memory.
Source: Le, Norato, Bruns, Ha & Tortorelli (2010), doi:10.1007/s00158-009-0440-y.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, ClassVar, TypeVar

import numpy as np

from dolfinopt.parallel import Partition

if TYPE_CHECKING:
    from dolfinopt.arms.design_state import DesignState
    from dolfinopt.dynamics.simulation import Trajectory
    from dolfinopt.profiling import Profile
    from dolfinopt.scene.load import Scene
    from dolfinopt.scene.tables.objective import Direction, Objective
    from dolfinopt.scene.tables.responses import Need

T = TypeVar("T")
R = TypeVar("R", bound="type[Response]")

# (n_cells,) by the arms of this rank; an arm without an entry has no influence.
CellGradient = dict[int, np.ndarray]


@dataclass(frozen=True, eq=False)
class Analysis:
    """What responses are computed from: the designs of the arms, and their motion.

    Attributes:
        scene: says what is asked.
        partition: which ranks do which arm.
        designs: of this rank's arms.
        trajectory: on the root, where a response needs a motion; None elsewhere.
        profile: of this rank.
    """

    scene: Scene
    partition: Partition
    designs: Mapping[int, DesignState]
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
        of_nominal: whether a limit holds for the nominal one of robust designs alone.
        natural: what is sought of the true value as objective, if the scene does not say.
        needs: what must be known beside the densities: the stiffness matrix, the mass matrix, a
            simulated motion, an eigenproblem.
        stands_for: what the true values are, where they are another quantity than the objective.
        options: the scene's [objective], which has the options of all responses.
        limited: whether it is a constraint: scenarios count by the worst one then.
    """

    name: ClassVar[str]
    label: ClassVar[str]
    unit: ClassVar[str]
    limit_unit: ClassVar[str] = ""
    lower: ClassVar[bool] = False
    of_nominal: ClassVar[bool] = False
    natural: ClassVar[Direction] = "minimize"
    needs: ClassVar[frozenset[Need]] = frozenset()
    stands_for: ClassVar[str] = ""

    def __init__(self, options: Objective, limited: bool = False):
        self.options, self.limited = options, limited

    @property
    def turned(self) -> bool:
        """Whether as objective it is sought the other way round: its smooth value maximised."""
        asked = self.options.direction
        return not self.limited and asked is not None and asked != self.natural

    @property
    def guarded(self) -> bool:
        """Whether steps are taken back that spoil it against their forecast.

        Of what is left of vibrations: the gradient tells little of it beyond the next iterate.
        """
        return False

    @classmethod
    def unit_of(cls, value: str) -> str:
        """Return the unit of the true value of that name, and of its limit."""
        return cls.limit_unit or cls.unit

    def restricted(self, limits: Sequence[float | None]) -> tuple[Response, tuple[float, ...]]:
        """Return the response of those values that have a limit, and these limits.

        Args:
            limits: of every value, None where it has none.
        """
        return self, tuple(one for one in limits if one is not None)

    @abstractmethod
    def measure(self, analysis: Analysis) -> Measured:
        """Return the values of a design (collective)."""

    @abstractmethod
    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of every smooth value by the physical densities (collective)."""

    def smooth_limits(
        self, analysis: Analysis, measured: Measured, limits: np.ndarray
    ) -> np.ndarray:
        """Return the limit of every smooth value, in their unit (collective).

        The true limits, times smooth over true value of this design.

        Args:
            analysis: of the design.
            measured: what `measure` returned of it.
            limits: (values,) of the true values.
        """
        true, smooth = np.array(measured.values), np.array(measured.smooth)
        return limits * np.divide(smooth, true, out=np.ones_like(true), where=true > 0.0)


@dataclass(frozen=True, eq=False)
class Constraint:
    """A response and its limit, in the response's `limit_unit`.

    As the optimiser sees it: smooth value / smooth limit - 1 <= 0.

    Attributes:
        name: the key of the scene.
        response: what is limited.
        limit: of all its values, or one for each.
    """

    name: str
    response: Response
    limit: float | tuple[float, ...]

    def limits(self, measured: Measured) -> np.ndarray:
        """Return the limit of every true value (values,)."""
        return np.broadcast_to(np.array(self.limit), len(measured.values))

    def smooth_limits(self, analysis: Analysis, measured: Measured) -> np.ndarray:
        """Return the limit of every smooth value (values,), see there (collective)."""
        return self.response.smooth_limits(analysis, measured, self.limits(measured))


# Limits whose word means another response as objective: the compliance of the whole horizon.
LIMITED = {"compliance": "load_case_compliance"}

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


def find_limited(key: str) -> type[Response]:
    """Return the response that a key of [constraints] limits."""
    return find(LIMITED.get(key, key))


def objective_of(scene: Scene) -> Response:
    """Return what the scene minimises, or maximises."""
    return find(scene.objective.kind)(scene.objective)


def constraints_of(scene: Scene) -> list[Constraint]:
    """Return what the scene limits: the volume, then [constraints] in the order of its keys."""
    volume = scene.design.volume_fraction
    limits = ({} if volume is None else {"volume_fraction": volume}) | scene.constraints.limits
    found = []
    for key, limit in limits.items():
        response = find_limited(key)(scene.objective, limited=True)
        if isinstance(limit, tuple):
            found.append(Constraint(key, *response.restricted(limit)))
        else:
            found.append(Constraint(key, response, limit))
    return found


def asked_of(scene: Scene) -> list[Response]:
    """Return the objective and what is limited."""
    return [objective_of(scene), *(one.response for one in constraints_of(scene))]


def needs(scene: Scene, what: Need) -> bool:
    """Return whether the objective or a constraint of the scene needs that."""
    return any(what in one.needs for one in asked_of(scene))


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
