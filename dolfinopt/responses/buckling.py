"""Buckling of the arms along the motion: the factor by which the loads of an instant may grow.

mu = 1 / factor is the largest eigenvalue of -K0 phi = mu K phi (`arms.modes`), with K0 by the
static stress of an instant, u = U a: the fields U of all loads (`fem.stress`) times coefficients a.
phi'K phi being 1, mu changes by

    dmu = -phi'(dK0 + mu dK) phi,

K0 by the cells and by u, which goes through the fields' adjoints and the motion as stress does.
Source: Ferrari & Sigmund (2019), doi:10.1007/s00158-019-02253-3.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.signal import find_peaks

from dolfinopt.arms.design_state import DesignState
from dolfinopt.arms.modes import BucklingModes, buckling_modes
from dolfinopt.density.interpolation import interpolate
from dolfinopt.fem.stress import Prestress, PrestressGradient, StressedModulus
from dolfinopt.parallel import on_all_ranks, on_root, together
from dolfinopt.responses.measured import (
    BUCKLING_MODES,
    BUCKLING_PEAKS,
    LARGEST_FACTOR,
    VOID_STRESS_SHARE,
)
from dolfinopt.responses.motion import motions_of
from dolfinopt.responses.products import Pair, Products
from dolfinopt.responses.response import (
    Analysis,
    CellGradient,
    Measured,
    Response,
    p_norm,
    response,
)
from dolfinopt.responses.sensitivity import pairs_at_interfaces
from dolfinopt.responses.stress import ArmGradient, ArmLoads, arm_loads, through_motions

# -- the instants of one arm along one motion at which it comes closest to buckling ---------------


@dataclass(frozen=True, eq=False)
class Pressed:
    """One arm of the chain at one instant.

    Attributes:
        loads: along the motion.
        instant: of it.
        modes: of the nominal stiffness under the stress over `loads.stiffer`.
    """

    loads: ArmLoads
    instant: int
    modes: BucklingModes

    @property
    def a(self) -> np.ndarray:
        """Coefficients (m,) of that stress."""
        return np.asarray(self.loads.coefficients[self.instant] / self.loads.stiffer)


def pressed(state: DesignState, loads: Sequence[ArmLoads]) -> list[Pressed]:
    """Return the instants of all motions that count (collective on the arm's ranks).

    The modes at the extremes of the loads tell at any other instant that mu is at least their Ritz
    value: the instants that count are where that has its peaks.
    """
    every = [(load, n) for load in loads for n in range(len(load.coefficients))]
    a = np.concatenate([load.coefficients / load.stiffer for load in loads])
    fields, modulus = state.load_fields, stressed_modulus(state)

    def modes_at(n: int, least: float) -> BucklingModes:
        stress = Prestress(fields, modulus, a[n : n + 1])
        with state.elastic.profile.phase("buckling"):
            return buckling_modes(stress, BUCKLING_MODES, least)

    first = extreme_instants(a, state.elastic.energy_matrix(fields.columns))
    if not first:
        return []
    peaks = worst_instants(_ritz(state, a, [modes_at(n, np.inf) for n in first]))  # rough modes
    return [Pressed(*every[n], modes_at(n, 1.0 / LARGEST_FACTOR)) for n in peaks]


def extreme_instants(a: np.ndarray, energies: np.ndarray) -> list[int]:
    """Return where the two principal loads of a motion are largest, either way.

    What pulls one member presses another. Strain energy alone, which has no sign, misses members:
    three times the mu in an eroded design of feed_forward.toml.

    Args:
        a: (n, k) coefficients of the loads.
        energies: (k, k) twice the strain energy of a is a' energies a.
    """
    loads = a * np.sqrt(np.diag(energies))
    principal = np.linalg.svd(loads, full_matrices=False)[2][:2]
    ways = np.concatenate([principal, -principal]) @ loads.T
    return sorted({int(way.argmax()) for way in ways if way.max() > 1e-6 * ways.max()})


def worst_instants(values: np.ndarray) -> list[int]:
    """Return the highest peaks of values (n,), largest first."""
    around = np.concatenate([[0.0], np.maximum(values, 0.0), [0.0]])  # the ends may be peaks
    peaks = find_peaks(around)[0] - 1
    return list(map(int, peaks[np.argsort(-values[peaks], kind="stable")][:BUCKLING_PEAKS]))


def stressed_modulus(state: DesignState) -> StressedModulus:
    """Return the modulus of the cells whose stress stiffens.

    With r = E / E_0 less that of void, and e = `VOID_STRESS_SHARE`, s = E_0 r^2 (1 + e) / (r + e):
    Young's where there is material, and less than any share of it towards void.
    """
    law, solid, e = state.scene.interpolation, state.solid.modulus, VOID_STRESS_SHARE
    void = interpolate(np.zeros(1), law.law, law.penalty, law.floor).stiffness
    r = state.elastic.young / solid - void
    share = (1.0 + e) * r / (r + e)
    return StressedModulus(solid * r * share, share * (r + 2.0 * e) / (r + e))


def _ritz(state: DesignState, a: np.ndarray, known: Sequence[BucklingModes]) -> np.ndarray:
    """Return the largest mu (n,) that the known modes show of all instants."""
    arm, fields = state.elastic, state.load_fields
    V = np.concatenate([item.field[:, :, :2] for item in known], axis=2)
    every = Prestress(fields, stressed_modulus(state), np.eye(a.shape[1]))
    K, K0 = arm.energy_matrix(V), every.stiffness(V)

    def largest() -> np.ndarray:
        values, vectors = np.linalg.eigh(K)
        # The same modes of several instants count once.
        kept = values > np.sqrt(np.finfo(float).eps) * values[-1]
        W = vectors[:, kept] / np.sqrt(values[kept])
        of_instants = np.tensordot(a, W.T @ K0 @ W, 1)
        return np.asarray(np.linalg.eigvalsh(-of_instants)[:, -1])

    return on_root(arm.comm, largest)


# -- as objective and as limit -------------------------------------------------------------------


@response("buckling")
class Buckling(Response):
    """p-norm of 1 / factor over arms, their worst instants and modes; true: the factor.

    Instants are peaks over the times of all scenarios, up to three of every arm, of each the four
    lowest modes. That nothing buckles is a factor of 1000, and of no influence.
    """

    def measure(self, analysis: Analysis) -> Measured:
        """Return the least factor and the p-norm (collective)."""
        inverse, smooth, _ = self._values(analysis, self._found(analysis))
        return Measured(self.name, ("",), (1.0 / inverse,), (smooth,))

    def gradients(self, analysis: Analysis) -> list[CellGradient]:
        """Return the gradient of the p-norm, which is always the exact one (collective)."""
        result = self._found(analysis)
        weights = self._values(analysis, result)[2]
        parts = {}
        with together(analysis.partition.world):
            for k, state in analysis.designs.items():
                parts[k] = _gradient_of_arm(state, result[k], weights.get(k, []))
        return [through_motions(analysis, parts)]

    def smooth_of(self, values: np.ndarray) -> np.ndarray:
        """Return the reciprocals of the factors."""
        return 1.0 / values

    def _found(self, analysis: Analysis) -> dict[int, list[Pressed]]:
        """Return the instants of this rank's designs, once for value and gradient (collective)."""
        designs, world = analysis.designs, analysis.partition.world

        def find() -> dict[int, list[Pressed]]:
            every = on_root(world, lambda: arm_loads(analysis.scene, motions_of(analysis.motion)))
            with together(world):
                return {k: pressed(state, every[k]) for k, state in designs.items()}

        return self.once(analysis, find)

    def _values(
        self, analysis: Analysis, pressed: Mapping[int, list[Pressed]]
    ) -> tuple[float, float, dict[int, list[np.ndarray]]]:
        """Return the largest 1 / factor, the p-norm, and by design its derivatives (collective)."""
        mine = {k: [item.modes.inverse for item in each] for k, each in pressed.items()}
        every = on_all_ranks(analysis.partition, mine)
        flat = [each for arm in every.values() for each in arm]
        values = np.maximum(np.concatenate([*flat, [1.0 / LARGEST_FACTOR]]), 0.0)
        smooth, by = p_norm(values, self.options.exponent)
        parts = iter(np.split(by, np.cumsum([len(item) for item in flat])))
        weights = {k: [next(parts) for _ in arm] for k, arm in every.items()}
        return float(values.max()), smooth, weights


def _gradient_of_arm(
    state: DesignState, pressed: Sequence[Pressed], weights: Sequence[np.ndarray]
) -> ArmGradient:
    """Differentiate by what one design's K0 is made of (collective on the arm's ranks)."""
    counted = [(item, by) for item, by in zip(pressed, weights, strict=True) if by.any()]
    if not counted:
        return ArmGradient([], None, (Products(),))
    modes = np.concatenate([item.modes.field for item, _ in counted], axis=2)
    mu = np.concatenate([item.modes.inverse for item, _ in counted])
    by_mu = np.concatenate([by for _, by in counted])
    instant = np.repeat(np.arange(len(counted)), [len(by) for _, by in counted])
    by_K0 = np.zeros((len(counted), len(mu), len(mu)))
    by_K0[instant, range(len(mu)), range(len(mu))] = -by_mu
    a, fields = np.array([item.a for item, _ in counted]), state.load_fields
    load_stress = Prestress(fields, stressed_modulus(state), a).gradient(modes, by_K0)
    pair = (modes * (-by_mu * mu), modes)
    by_loads = [
        replace(each.loads.at([each.instant]), coefficients=by[None] / each.loads.stiffer)
        for (each, _), by in zip(counted, load_stress.by_a, strict=True)
    ]
    products = Products(
        stiffness=(pair, (load_stress.y, load_stress.stress.u)),
        mass=((-load_stress.y, load_stress.stress.inertia),),
        places=load_stress.places,
        interfaces=partial(_at_interfaces, load_stress, pair),
        prestress=load_stress,
    )
    return ArmGradient(by_loads, load_stress.through, (products,))


def _at_interfaces(gradient: PrestressGradient, pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    """Return what `Products.interfaces` does of modes and K0, the fields of loads aside."""
    direct = ((gradient.by_modes, gradient.modes),)
    rigid, _ = pairs_at_interfaces(gradient.stress.arm, (pair,), direct=direct)
    return rigid, gradient.levers
