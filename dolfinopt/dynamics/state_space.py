"""A machine linearised about its motion at one instant as A, B, C, D.

States are x = (dz, dz'), the independent coordinates of `linearised` and their rates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dolfinopt.dynamics.linearised import Linearised
from dolfinopt.dynamics.machine_system import MachineSystem
from dolfinopt.dynamics.poles import damping_ratios
from dolfinopt.multibody.kinematics import Posed, SiteMotion

OUTPUTS = ("tool", "deflection")
WRENCH = {2: ("fx", "fy", "mz"), 3: ("fx", "fy", "fz", "mx", "my", "mz")}


@dataclass(frozen=True, eq=False)
class StateSpace:
    """dx' = A dx + B du, dy = C dx + D du about a motion at one instant.

    Attributes:
        time: the instant, s.
        A, B, C, D: (n, n), (n, m), (p, n), (p, m).
        states, inputs, outputs: their names.
        input_units, output_units: N, N m; m, rad.
        closed: whether the control acts; otherwise the drives' forces are free inputs.
        accurate_below: frequency below which the poles hold 1 %, Hz; nan where it is not known.
    """

    time: float
    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    closed: bool
    accurate_below: float = np.nan

    @property
    def poles(self) -> np.ndarray:
        """Eigenvalues of A, 1/s, slowest first; of a pair the one above the real axis first."""
        result = np.linalg.eigvals(self.A).astype(complex)
        return result[np.lexsort((-result.imag, np.round(np.abs(result), 9)))]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all of it as arrays by name, as files have it; frequencies in Hz."""
        result = {key: np.asarray(value) for key, value in vars(self).items()}
        poles = self.poles
        return result | {
            "poles": poles,
            "frequencies": np.abs(poles) / (2.0 * np.pi),
            "damping_ratios": damping_ratios(poles),
        }


def linear_model(linearised: Linearised, closed: bool) -> StateSpace:
    """Return a linearised machine with all drives free as A, B, C, D.

    Inputs are the drives' forces, in a closed loop those that are added to the control's, and force
    and moment on the end-effector in the world's directions. Outputs are the drives' coordinates,
    of joints behind springs the motors'; the end-effector's displacement; and the part of it that
    the arms' deformation makes, the rigid coordinates held. `closed`: whether the control acts.
    """
    system, N = linearised.system, linearised.directions[0]
    d, names = system.mechanism.dim.d, system.names
    driven = system.drive_columns[system.drives.driven]
    drives, wrench = np.eye(system.num_coordinates)[:, driven], _wrench(linearised)
    b = N.T @ np.hstack([drives, wrench])
    place = wrench[:, :d].T
    bent = np.zeros_like(place)
    bent[:, system.elastic_columns] = place[:, system.elastic_columns]
    outputs = np.vstack([drives.T, place, bent]) @ N
    every = coordinate_names(system)
    kept = [every[k] for k in linearised.independent]
    units = [names.units[name] for name in names.driven]
    wrench_units = [*["N"] * d, *["N m"] * (wrench.shape[1] - d)]
    return StateSpace(
        time=float(linearised.t[0]),
        A=linearised.A,
        B=np.vstack([np.zeros_like(b), linearised.accelerations(b)]),
        C=np.hstack([outputs, np.zeros_like(outputs)]),
        D=np.zeros((len(outputs), b.shape[1])),
        states=(*kept, *(f"{name} rate" for name in kept)),
        inputs=(*names.driven, *(f"tool {name}" for name in WRENCH[d])),
        outputs=(*names.driven, *(f"{what} {a}" for what in OUTPUTS for a in "xyz"[:d])),
        input_units=(*("N" if unit == "m" else "N m" for unit in units), *wrench_units),
        output_units=(*units, *["m"] * (2 * d)),
        closed=closed,
    )


def coordinate_names(system: MachineSystem) -> list[str]:
    """Return the names of all unknowns of a machine."""
    rigid, arms = list(system.names.units), system.names.arms
    names = [rigid[int(k)] for k in system.drives.free]
    bearings = [joint.name for joint in system.mechanism.joints[len(arms) :]]
    for name, part in zip([*arms, *bearings], system.mechanism.slices, strict=True):
        names += [f"{name} q{k + 1}" for k in range(part.stop - part.start)]
    names += [f"multiplier {k + 1}" for k in range(system.ends[2] - system.ends[1])]
    joints = system.drives.free[system.drives.springs.joints]
    return names + [f"motor of {rigid[int(k)]}" for k in joints]


def _wrench(linearised: Linearised) -> np.ndarray:
    """Return what unit forces and moments on the end-effector are on every unknown (S, d + r)."""
    system, dim, state = linearised.system, linearised.system.mechanism.dim, linearised.state
    posed = Posed(system.mechanism, state.motion.q, state.elastic[0])
    site = SiteMotion(posed, system.mechanism.end, np.zeros(dim.d), np.eye(dim.d))
    result = np.zeros((system.num_coordinates, dim.b))
    result[: system.ends[1]] = site.by[:, system.columns, 0].T
    return result
