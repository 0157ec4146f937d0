"""What a response is, and what several scenarios make of its values.

Objective and constraints of a scene are responses: `objective.kind = "deviation"`, every key of
[constraints] and `design.volume_fraction` name one. To add one, decorate a class by `@response`,
which says what the scene must know of it; see docs/pages/develop/add-response.md.

The one rule of aggregation: an extreme over instants, modes, load cases or scenarios has a true
value, which reports show and limits hold for, and a smooth one, its p-mean or p-norm with
`objective.exponent`, which is differentiated. A constraint is the true value over its limit less
1; its gradient is that of smooth value / smooth limit, where the smooth limit is the limit times
smooth / true value of the same design, held. The optimiser's scale remembers earlier designs, see
`optimization.iterate`.
Source: Le, Norato, Bruns, Ha & Tortorelli (2010), doi:10.1007/s00158-009-0440-y.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from dolfinopt.arms.arm import fixed_body
from dolfinopt.multibody.kinematics import lengths
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, of_material, scaled
from dolfinopt.parallel import Partition
from dolfinopt.responses.products import By, by_design
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.objective import declare
from dolfinopt.scene.tables.responses import (
    DECLARED,
    VOLUME,
    Declaration,
    Limited,
    Need,
    limited_by,
    need_of,
)

if TYPE_CHECKING:
    from dolfinopt.arms.design_state import DesignState
    from dolfinopt.dynamics.build import Trajectory
    from dolfinopt.profiling import Profile
    from dolfinopt.scene.tables.objective import Objective

T = TypeVar("T")
R = TypeVar("R", bound="type[Response]")

# (n_cells,) by the arms of this rank; an arm without an entry has no influence. Where it is the
# gradient by other variables, see `Analysis.by`, arrays have their shape.
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
        by: what gradients are by: the physical densities, or other variables of the designs.
    """

    scene: Scene
    partition: Partition
    designs: Mapping[int, DesignState]
    trajectory: Trajectory | None
    profile: Profile
    by: By = by_design

    @property
    def motion(self) -> Trajectory:
        """The trajectory, on the root, where there is one."""
        assert self.trajectory is not None
        return self.trajectory


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
        return sum(self.smooth)


class Response(ABC):
    """A quantity of a design with its gradient; as objective, the sum of its values is minimised.

    Attributes:
        declared: what the scene knows of it.
        options: the scene's [objective], which has the options of all responses.
        limited: whether it is a constraint: scenarios count by the worst one then.
    """

    declared: ClassVar[Declaration]

    def __init__(self, options: Objective, limited: bool = False):
        self.options, self.limited = options, limited

    @property
    def name(self) -> str:
        """The word of the scene."""
        return self.declared.name

    @property
    def turned(self) -> bool:
        """Whether as objective it is sought the other way round: its smooth value maximised."""
        asked = self.options.direction
        return not self.limited and asked is not None and asked != self.declared.natural

    @classmethod
    def unit_of(cls, value: str) -> str:
        """Return the unit of the true value of that name, and of its limit."""
        return cls.declared.limit_unit

    def restricted(self, limits: Sequence[Any]) -> tuple[Response, tuple[float, ...]]:
        """Return the response of those values that have a limit, and these limits.

        Args:
            limits: of every value, None where it has none; or what the scene states in place of
                one number.
        """
        return self, tuple(limit for limit in limits if limit is not None)

    @abstractmethod
    def measure(self, analysis: Analysis) -> Measured:
        """Return the values of a design (collective)."""

    @abstractmethod
    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of every smooth value by the physical densities (collective).

        Or by other variables of the designs, as `Analysis.by` says.
        """

    def once(self, analysis: Analysis, find: Callable[[], Mapping[int, T]]) -> dict[int, T]:
        """Return what is found of this rank's designs, once for value and gradient (collective)."""
        states, trajectory = analysis.designs, analysis.trajectory
        known = [state.kept.get(self.name) for state in states.values()]
        hit = all(item is not None and item[0] is trajectory for item in known)
        # The root, which has an arm and the trajectory, speaks for all: they work in step.
        if not analysis.partition.world.bcast(hit, root=0):
            for k, result in find().items():
                states[k].kept[self.name] = trajectory, result
        return {k: state.kept[self.name][1] for k, state in states.items()}

    def smooth_of(self, values: np.ndarray) -> np.ndarray:
        """Return what the smooth value is of single true values, but for a factor.

        By default themselves; of what has a lower limit it falls as the true value grows.
        """
        return values


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

    def smooth_limits(self, measured: Measured) -> np.ndarray:
        """Return the limit of every smooth value (values,), in their unit.

        The true limits, times smooth over true value of this design.
        """
        smooth, true = np.array(measured.smooth), self.response.smooth_of(np.array(measured.values))
        share = np.divide(smooth, true, out=np.ones_like(true), where=true > 0.0)
        return self.response.smooth_of(self.limits(measured)) * share


_known: dict[str, type[Response]] = {}


def response(
    name: str, *, label: str = "", unit: str = "", limit: Limited | str | None = None, **more: Any
) -> Callable[[R], R]:
    """Decorate the class of a response; with a unit, declare it to scenes, too.

    Args:
        name: the word of objective.kind.
        label: the value in words; default: the name.
        unit: of the value; "" of what `scene.tables.responses` declares already.
        limit: what [constraints] says of it, or that in words with the unit.
        **more: further attributes of `Declaration`.
    """
    if unit:
        limit = Limited(limit) if isinstance(limit, str) else limit
        words = label or name.replace("_", " ")
        declare(Declaration(name, words, unit, limit=limit, **more))

    def known(cls: R) -> R:
        cls.declared = VOLUME if name == VOLUME.name else DECLARED[name]
        _known[name] = cls
        return cls

    return known


def find(name: str) -> type[Response]:
    """Return the response of that name, whose file is imported at first use."""
    if name not in _known:
        declared = VOLUME if name == VOLUME.name else DECLARED[name]
        import_module(f"dolfinopt.responses.{declared.file}")
    return _known[name]


def find_limited(key: str) -> type[Response]:
    """Return the response that a key of [constraints] limits."""
    return find(limited_by(key).name)


def objective_of(scene: Scene) -> Response:
    """Return what the scene minimises, or maximises."""
    return find(scene.objective.kind)(scene.objective)


def constraints_of(scene: Scene) -> list[Constraint]:
    """Return what the scene limits: the volume, then [constraints] in the order of its keys."""
    volume = scene.design.volume_fraction if scene.designed else None
    limits = ({} if volume is None else {"volume_fraction": volume}) | scene.limits
    result = []
    for key, limit in limits.items():
        response = find_limited(key)(scene.objective, limited=True)
        if isinstance(limit, tuple):
            result.append(Constraint(key, *response.restricted(limit)))
        else:
            result.append(Constraint(key, response, limit))
    return result


def needs(scene: Scene, what: Need) -> bool:
    """Return whether the objective or a constraint of the scene needs that."""
    return bool(need_of(scene, what))


def by_owner(scene: Scene, parts: Sequence[T]) -> dict[int, T]:
    """Add up what belongs to the arms of one design; rigid arms and those from files have none.

    Args:
        scene: with the arms.
        parts: one an arm, from the cart outwards; what is behind them, of bearings, has no design.

    Returns:
        A sum a design, by the index of the arm that owns it.
    """
    return sums((owner, part) for owner, part in zip(scene.owners, parts) if owner is not None)


def sums(parts: Iterable[tuple[int, T]]) -> dict[int, T]:
    """Add up what has the same index, in the order given."""
    total: dict[int, T] = {}
    for k, part in parts:
        total[k] = total[k] + part if k in total else part  # type: ignore[operator]
    return total


def occurrences(scene: Scene) -> dict[int, int]:
    """Return how many arms have each design."""
    return by_owner(scene, [1] * len(scene.arms))


# -- one design under several scenarios: other payloads, paths, damping, other batches of
# material
#
# They all share the reduced bodies: a denser or stiffer material scales their integrals.


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
    if other is scene:
        return Factors(1.0, 1.0, scene.damping.stiffness_proportional)
    here, there = scene.material_of(index), other.material_of(index)
    # Only of plane arms may it differ: solid ones would be other bodies.
    thicker = other.arms[index].thickness / scene.arms[index].thickness
    return Factors(
        thicker * there.density / here.density,
        thicker * there.modulus / here.modulus,
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
    values: Sequence[float] | np.ndarray, exponent: float, least: bool = False
) -> tuple[float, np.ndarray]:
    """Return (sum f^p)^(1/p) of positive values and its derivatives; a single value is itself.

    With `least` the smallest one made smooth, (sum f^-p)^(-1/p).

    The largest, made smooth; with p = 20 it is 6 % above the largest of three equal ones:
    Kreisselmeier and Steinhauser's function of the logarithms.
    Source: Kreisselmeier & Steinhauser (1979), doi:10.1016/S1474-6670(17)65584-8.
    """
    if len(values) == 1:  # of either sign, or none
        return float(values[0]), np.ones(1)
    return p_norm(np.asarray(values), -exponent if least else exponent)


def combined(
    scene: Scene, values: Sequence[float], least: bool = False
) -> tuple[float, np.ndarray]:
    """Return the objective of all scenarios from their own, and its derivatives.

    "sum": sum w f. "worst": the smooth largest of w f, with `objective.exponent`; or with `least`,
    of what is maximised, the smooth smallest.
    """
    weights = np.array([scenario.weight for scenario in scene.scenarios] or [1.0])
    if scene.objective.scenarios == "sum":
        return float(weights @ values), weights
    worst, by_values = worst_of(weights * values, scene.objective.exponent, least)
    return worst, weights * by_values


# -- the p-norm: the largest of several values, made smooth --------------------------------------


def p_norm(
    values: np.ndarray, exponent: float, weights: np.ndarray | float = 1.0
) -> tuple[float, np.ndarray]:
    """Return (sum_k w_k f_k^p)^(1/p) of f >= 0 and its derivative by f (n,).

    With w = 1 at least the largest value and at most n^(1/p) times it; with weights that add up to
    1 a p-mean, at most the largest; with p < 0 the smallest, made smooth. Powers are those of f
    over its largest, or smallest, so that they do not overflow. Where that is zero: 0 and no
    derivative.

    Args:
        values: (n,) f.
        exponent: p, |p| >= 1.
        weights: (n,) w >= 0, or the same for all.
    """
    largest = values.max() if exponent > 0.0 else values.min()
    if largest == 0.0:
        return 0.0, np.zeros_like(values)
    relative = values / largest
    total = float(np.sum(weights * relative**exponent))
    by_values = weights * relative ** (exponent - 1.0) * total ** (1.0 / exponent - 1.0)
    return float(largest * total ** (1.0 / exponent)), by_values


def p_norm_of_lengths(
    vectors: np.ndarray, exponent: float, weights: np.ndarray | float = 1.0
) -> tuple[float, np.ndarray]:
    """Return the p-norm of the lengths |e_k| and its derivative by the vectors (n, d).

    Args:
        vectors: (n, d) e.
        exponent: p >= 2.
        weights: as for `p_norm`.
    """
    distances = lengths(vectors)
    value, by_lengths = p_norm(distances, exponent, weights)
    share = np.divide(by_lengths, distances, out=by_lengths, where=distances > 0.0)
    return value, share[:, None] * vectors
