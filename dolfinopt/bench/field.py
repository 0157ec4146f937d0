"""The benchmark of the field: published problems, reference values, and our results beside them.

Every folder of `benchmarks` with a file case.toml is a case: a problem in words, a scene (or a
Python program that returns its values), and values with reference, origin and limit. A program that
is not this one needs the words, the scene's figures and the reference tables only.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd
from mpi4py import MPI
from pydantic import ConfigDict, ValidationError
from scipy.linalg import eigh

from dolfinopt.bench.measure import load_program
from dolfinopt.data import benchmark_folder
from dolfinopt.dynamics.build import Trajectory
from dolfinopt.errors import InputError
from dolfinopt.model import Model, SimulationResult
from dolfinopt.multibody.kinematics import Posed
from dolfinopt.scene.tables.base import Table, input_error, problem
from dolfinopt.scene.text import read_toml


class Value(Table):
    """What is compared: a number, or a history with a table of `benchmarks/reference`."""

    model_config = ConfigDict(allow_inf_nan=True)

    what: str
    unit: str  # "" of a share
    quantity: str  # a key of `NUMBERS` or `HISTORIES`, or of what a program returns
    reference: float = np.nan  # of a number
    limit: float  # of the difference, relative to the reference, of a history to its largest value
    way: Literal["near", "most", "least"] = "near"  # within the limit, or on one side up to it
    ours: float  # the published result of this program
    origin: str  # where the reference is from
    table: str = ""  # file of a history
    columns: tuple[str, ...] = ()  # of the file
    until: float = np.inf  # the last instant that counts, s


class Case(Table):
    """One problem: a scene with its design (by default the initial one), or a program."""

    folder: Path  # of its file and of the files that it names
    title: str
    problem: str
    source: str
    scene: str = ""  # of the machine
    overrides: tuple[str, ...] = ()  # "key.path=value" for the scene
    program: str = ""  # Python file, whose `values` returns numbers by their quantities
    records: str = ""  # what the folder of measured records is that the program reads
    design: str = ""
    long: bool = False  # takes more than some ten seconds; runs with --all or by name
    values: tuple[Value, ...]

    @property
    def name(self) -> str:
        """Of its folder."""
        return self.folder.name

    def check_table(self) -> None:
        if bool(self.scene) == bool(self.program):
            raise ValueError("expected either scene or program")
        for value in self.values if self.scene else ():
            known = HISTORIES if value.table else NUMBERS
            if value.quantity not in known:
                raise ValueError(f"quantity {value.quantity}: expected one of {', '.join(known)}")


def read_cases() -> list[Case]:
    """Return all cases of the package's folder, in the order of their names."""
    return [read_case(file) for file in sorted(benchmark_folder().glob("*/case.toml"))]


def read_case(file: Path) -> Case:
    """Return the case of a file; InputError: it is no TOML, lacks a key or has an unknown one."""
    tree = read_toml(str(file), "a case is a TOML file")
    try:
        return Case.model_validate(tree | {"folder": file.parent})
    except ValidationError as error:
        raise input_error(str(file), problem(error)) from None


def chosen_cases(names: Sequence[str], records: bool = False) -> list[Case]:
    """Return the cases of these names; without names the quick ones, of "all" the long ones, too.

    Without records, cases that need some are left out. InputError: there is no such case.
    """
    known = {case.name: case for case in read_cases()}
    if not names or list(names) == ["all"]:
        possible = [case for case in known.values() if records or not case.records]
        return [case for case in possible if names or not case.long]
    for name in names:
        if name not in known:
            expected = " | ".join(["all", *known])
            raise InputError(f"bench field {name}: no such case; expected {expected}")
        if known[name].records and not records:
            raise InputError(f"bench field {name}: name it as {name}=DIR, {known[name].records}")
    return [known[name] for name in dict.fromkeys(names)]


# -- what is compared ------------------------------------------------------------------------


def _trajectory(result: SimulationResult) -> Trajectory:
    assert result.trajectory is not None
    return result.trajectory


def _response(name: str) -> Callable[[SimulationResult], float]:
    """Return the function to the largest value of a response."""
    return lambda result: max(result.evaluation.values_of(name), default=np.nan)


def _frequency(number: int) -> Callable[[SimulationResult], float]:
    """Return the function to a frequency of the machine at its start, joints held, Hz."""

    def value(result: SimulationResult) -> float:
        system = _trajectory(result).problem
        K, M = system.mechanism.stiffness(), system.rest_mass[0]
        squares = eigh(K, M, eigvals_only=True)
        return float(np.sqrt(squares[number - 1]) / (2.0 * np.pi))

    return value


NUMBERS: dict[str, Callable[[SimulationResult], float]] = {
    "mass": lambda result: sum(result.mass[arm.name] for arm in result.scene.arms if arm.flexible),
    "stress": lambda result: result.stress_at_points,
    "settling": _response("settling"),
    "orientation": _response("orientation"),
    "loaded frequency": _response("eigenfrequency"),
    "first frequency": lambda result: _trajectory(result).mechanism.bodies[0].first_frequency,
    "mass of the first arm": lambda result: _trajectory(result).mechanism.bodies[0].mass,
    **{f"frequency {number}": _frequency(number) for number in (1, 2, 3)},
    "deviation": lambda result: result.max_deviation,
    "compliance": lambda result: result.compliance,
}


def _tip(seen: Trajectory) -> np.ndarray:
    """Return the deviation in the frame of a single arm (n, 2): along and across, m."""
    turned = seen.deviation @ [1.0, 1j] * np.exp(-1j * seen.q_r[:, -1])
    return np.stack([turned.real, turned.imag], axis=1)


def _column(seen: Trajectory, name: str, values: np.ndarray) -> np.ndarray:
    """Return the column (n, 1) of a rigid coordinate."""
    return values[:, [list(seen.scene.rigid_units).index(name)]]


def _first_end(seen: Trajectory) -> np.ndarray:
    """Return the place of the first arm's outboard interface across the plane x, y (n, 1), m."""
    return Posed(seen.mechanism, seen.q_r, seen.q_e).interface(0, 0)[0][2][:, None]


# By name: what returns values (n, k) of a motion at instants of a table.
HISTORIES: dict[str, Callable[[Trajectory], np.ndarray]] = {
    "deviation over time": lambda seen: seen.deviation,
    "tip over time": _tip,
    "slide over time": lambda seen: _column(seen, "slide", seen.motion.q),
    "turning rate over time": lambda seen: _column(seen, "turn", seen.motion.qd),
    "first arm's end along z over time": _first_end,
}


def read_table(name: str) -> dict[str, np.ndarray]:
    """Return the columns of a table of `benchmarks/reference` by name, without units."""
    with (benchmark_folder() / "reference" / name).open(encoding="ascii") as lines:
        head, *rows = csv.reader(lines)
    names = [column.split("[")[0].strip() for column in head]
    return dict(zip(names, np.array(rows, dtype=float).T, strict=True))


class Checked(NamedTuple):
    """A value of a case, computed; of a history the largest size of both over time."""

    case: Case
    of: Value
    value: float
    reference: float
    difference: float  # relative; of a history the largest over time, by the reference's largest

    @property
    def met(self) -> bool:
        """Whether the limit holds; never for a value that is none."""
        sign = {"near": abs(self.difference), "most": self.difference, "least": -self.difference}
        return bool(sign[self.of.way] <= self.of.limit)


def check(case: Case, records: Path | None = None) -> list[Checked]:
    """Run a case on this rank; return its values beside their references.

    `records` is the folder of the measured records, for a case that needs them. ConvergenceError:
    it cannot be simulated; InputError: the records are not those of the case.
    """
    if case.program:
        values = load_program(case.folder / case.program).values(records)
        return [_number(case, value, values[value.quantity]) for value in case.values]
    asked = any(value.quantity == "stress" for value in case.values)
    model = Model(case.folder / case.scene, *case.overrides, comm=MPI.COMM_SELF)
    result = model.simulate(case.folder / case.design if case.design else None, stress=asked)
    return [
        _history(case, value, result)
        if value.table
        else _number(case, value, float(NUMBERS[value.quantity](result)))
        for value in case.values
    ]


def _number(case: Case, asked: Value, value: float) -> Checked:
    return Checked(case, asked, value, asked.reference, value / asked.reference - 1.0)


def _history(case: Case, asked: Value, result: SimulationResult) -> Checked:
    table = read_table(asked.table)
    known = table["t"] <= asked.until
    expected = np.stack([table[column] for column in asked.columns], axis=1)[known]
    computed = HISTORIES[asked.quantity](_trajectory(result).at(table["t"][known]))
    value, reference, error = (
        float(np.linalg.norm(x, axis=1).max()) for x in (computed, expected, computed - expected)
    )
    return Checked(case, asked, value, reference, error / reference)


def table_of(checks: Sequence[Checked]) -> pd.DataFrame:
    """Return a row for every value: computed, reference, difference, limit, verdict."""
    sign = {"near": "", "most": "at most +", "least": "at least -"}
    rows = [
        (
            item.case.name,
            item.of.what,
            item.of.unit,
            f"{item.value:.6g}",
            f"{item.reference:.6g}",
            f"{item.difference:.2g}",
            f"{sign[item.of.way]}{item.of.limit:g}",
            "met" if item.met else "MISSED",
        )
        for item in checks
    ]
    columns = "case value unit computed reference difference limit verdict"
    return pd.DataFrame(rows, columns=columns.split())
