"""The benchmark of the field: published problems, reference values, and our results beside them.

Every folder of `benchmarks` with a file case.toml is a case: a problem in words, a scene (or a
machine of `PROGRAMS`), and values with reference, origin and limit. A program that is not this one
needs the words, the scene's figures and the reference tables only.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from mpi4py import MPI

from dolfinopt.bench.field_machines import crank_values, ur10e_values
from dolfinopt.data import benchmark_folder
from dolfinopt.errors import InputError
from dolfinopt.model import Model, SimulationResult
from dolfinopt.multibody.kinematics import Posed
from dolfinopt.multibody.shape_integrals import ShapeIntegrals

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

WAYS = ("near", "most", "least")


@dataclass(frozen=True)
class Value:
    """What is compared: a number, or a history with a table of `benchmarks/reference`.

    Attributes:
        what, unit: in words; "" for a share.
        quantity: a key of `NUMBERS` or `HISTORIES`, or of what a program returns.
        reference: the number; nan where `table` has a history.
        limit: of the difference, relative to the reference (of a history, to its largest value).
        way: "near" the reference within the limit; a value that shall be "most" or "least" the
            reference may pass it by the limit.
        ours: the published result of this program.
        origin: where the reference is from.
        table, columns, until: file, its columns, and the last instant that counts, s.
    """

    what: str
    unit: str
    quantity: str
    reference: float
    limit: float
    way: str
    ours: float
    origin: str
    table: str = ""
    columns: tuple[str, ...] = ()
    until: float = np.inf


@dataclass(frozen=True)
class Case:
    """One problem.

    Attributes:
        name: of its folder.
        title, problem, source: in words.
        scene: of the machine, or None where `program` makes it.
        overrides: "key.path=value" for the scene.
        program: a key of `PROGRAMS`, or "".
        records: what the folder of the measured records is that `program` reads; "" where it
            needs none.
        design: file of the design, or None for the scene's initial one.
        long: takes more than some ten seconds; runs with --all or by name.
        values: what is compared.
    """

    name: str
    title: str
    problem: str
    source: str
    scene: Path | None
    overrides: tuple[str, ...]
    program: str
    records: str
    design: Path | None
    long: bool
    values: tuple[Value, ...]


@dataclass(frozen=True)
class Checked:
    """A value of a case, computed.

    Attributes:
        value, reference: of a history the largest size of both over time.
        difference: relative; of a history the largest over time, by the reference's largest.
    """

    case: Case
    of: Value
    value: float
    reference: float
    difference: float

    @property
    def met(self) -> bool:
        """Whether the limit holds; never for a value that is none."""
        sign = {"near": abs(self.difference), "most": self.difference, "least": -self.difference}
        return bool(sign[self.of.way] <= self.of.limit)


# -- case files ------------------------------------------------------------------------------


def read_cases(folder: Path | None = None) -> tuple[Case, ...]:
    """Return all cases, in the order of their names.

    Args:
        folder: of the cases; None: the package's.

    Raises:
        InputError: a case file lacks a key or has one that is not known.
    """
    files = sorted((folder or benchmark_folder()).glob("*/case.toml"))
    return tuple(read_case(file) for file in files)


def read_case(file: Path) -> Case:
    """Return the case of a file.

    Raises:
        InputError: it is no TOML, lacks a key or has one that is not known.
    """
    try:
        tree = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: {error}; a case is a TOML file") from None
    rows = tree.pop("values", [])
    here = file.parent
    known = {
        "overrides": (), "scene": "", "program": "", "records": "", "design": "", "long": False,
    }  # fmt: skip
    tree = _with_defaults(file, tree, Case, known, without=("name", "values"))
    values = [_value(file, row) for row in rows]
    paths = {key: here / tree[key] if tree[key] else None for key in ("scene", "design")}
    tree["overrides"] = tuple(tree["overrides"])
    if not values or bool(tree["scene"]) == (tree["program"] in PROGRAMS):
        raise InputError(
            f"{file}: expected [[values]], and either scene or program = "
            f"{' | '.join(map(repr, PROGRAMS))}"
        )
    for one in values if tree["scene"] else ():
        known = HISTORIES if one.table else NUMBERS
        if one.quantity not in known:
            raise InputError(
                f"{file}: quantity {one.quantity!r}: expected {' | '.join(map(repr, known))}"
            )
    return Case(**tree | paths, name=here.name, values=tuple(values))


def _value(file: Path, row: Mapping[str, Any]) -> Value:
    known = {"reference": np.nan, "way": "near", "table": "", "columns": (), "until": np.inf}
    tree = _with_defaults(file, row, Value, known)
    if tree["way"] not in WAYS:
        raise InputError(f"{file}: way {tree['way']!r}: expected {' | '.join(WAYS)}")
    return Value(**tree | {"columns": tuple(tree["columns"])})


def _with_defaults(
    file: Path,
    tree: Mapping[str, Any],
    kind: type[Case] | type[Value],
    known: Mapping[str, Any],
    without: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the keys of a table with the defaults of those that may be absent."""
    names = [one.name for one in fields(kind) if one.name not in without]
    if wrong := sorted(set(tree) - set(names)):
        raise InputError(f"{file}: unknown key {wrong[0]!r}: expected {', '.join(names)}")
    if missing := [name for name in names if name not in tree and name not in known]:
        raise InputError(f"{file}: {missing[0]} is missing; every {kind.__name__.lower()} has it")
    return {name: tree.get(name, known.get(name)) for name in names}


def chosen_cases(
    names: Iterable[str],
    everything: bool,
    records: bool = False,
    cases: Sequence[Case] | None = None,
) -> tuple[Case, ...]:
    """Return the cases of these names; without names the quick ones, or all.

    Args:
        names: of cases.
        everything: the long ones, too.
        records: whether there are measured records; without them cases that need some are left
            out.
        cases: to choose from; None: the package's.

    Raises:
        InputError: there is no such case, or it needs records.
    """
    cases = read_cases() if cases is None else cases
    known = {case.name: case for case in cases}
    if wrong := [name for name in names if name not in known]:
        raise InputError(f"--case {wrong[0]}: no such case; expected {' | '.join(known)}")
    for case in (known[name] for name in names):
        if case.records and not records:
            raise InputError(f"--case {case.name}: give --records DIR, {case.records}")
    wanted = tuple(known[name] for name in dict.fromkeys(names))
    return wanted or tuple(
        case for case in cases if (everything or not case.long) and (records or not case.records)
    )


# -- what is compared ------------------------------------------------------------------------


def _response(name: str) -> Callable[[SimulationResult], float]:
    """Return the function to the largest value of a response."""
    return lambda result: max(result.evaluation.values_of(name), default=np.nan)


def _bodies(result: SimulationResult) -> Sequence[ShapeIntegrals]:
    """Return the arms as floating bodies."""
    assert result.trajectory is not None
    return tuple(result.trajectory.mechanism.bodies)


def _frequency(number: int) -> Callable[[SimulationResult], float]:
    """Return the function to a frequency of the machine at its start, joints held, Hz."""

    def value(result: SimulationResult) -> float:
        assert result.trajectory is not None
        system = result.trajectory.problem
        still = np.zeros((1, system.num_coordinates))
        matrix = system.at(np.zeros(1)).linearise(still, still, still).dense()[0]
        K, _, M = np.split(matrix, 3, axis=1)
        squares = np.sort(np.linalg.eigvals(np.linalg.solve(M, K)).real)
        return float(np.sqrt(squares[number - 1]) / (2.0 * np.pi))

    return value


NUMBERS: dict[str, Callable[[SimulationResult], float]] = {
    "mass": lambda result: sum(
        body.mass
        for arm, body in zip(result.scene.arms, _bodies(result))
        if not arm.rigid and arm.sid is None
    ),
    "stress": lambda result: result.stress_at_points,
    "settling": _response("settling"),
    "orientation": _response("orientation"),
    "loaded frequency": _response("eigenfrequency"),
    "first frequency": lambda result: _bodies(result)[0].first_frequency,
    "mass of the first arm": lambda result: _bodies(result)[0].mass,
    **{f"frequency {number}": _frequency(number) for number in (1, 2, 3)},
    "deviation": lambda result: result.max_deviation,
    "deviation's instant": lambda result: result.evaluation.max_deviation_time,
    "compliance": lambda result: result.compliance,
}
History = Callable[[SimulationResult, np.ndarray], np.ndarray]


def _deviation(result: SimulationResult, t: np.ndarray) -> np.ndarray:
    """Return the flexible less the rigid end-effector (n, d), m."""
    assert result.trajectory is not None
    return result.trajectory.at(t).deviation


def _tip(result: SimulationResult, t: np.ndarray) -> np.ndarray:
    """Return the same in the frame of a single arm (n, 2): along and across, m."""
    assert result.trajectory is not None
    angle = result.trajectory.at(t).q_r[:, -1]
    turned = _deviation(result, t) @ [1.0, 1j] * np.exp(-1j * angle)
    return np.stack([turned.real, turned.imag], axis=1)


def _coordinate(name: str, order: int) -> History:
    """Return the function to a rigid coordinate or its rate (n, 1)."""

    def history(result: SimulationResult, t: np.ndarray) -> np.ndarray:
        assert result.trajectory is not None
        motion = result.trajectory.at(t).motion
        place = list(result.scene.rigid_units).index(name)
        return (motion.q, motion.qd)[order][:, [place]]

    return history


def _first_end(result: SimulationResult, t: np.ndarray) -> np.ndarray:
    """Return the place of the first arm's outboard interface across the plane x, y (n, 1), m."""
    assert result.trajectory is not None
    seen = result.trajectory.at(t)
    return Posed(seen.mechanism, seen.q_r, seen.q_e).interface(0, 0)[0][2][:, None]


HISTORIES: dict[str, History] = {
    "deviation over time": _deviation,
    "tip over time": _tip,
    "slide over time": _coordinate("slide", 0),
    "turning rate over time": _coordinate("turn", 1),
    "first arm's end along z over time": _first_end,
}
# Of the folder of records, where there are some.
PROGRAMS: dict[str, Callable[[Path | None], dict[str, float]]] = {
    "crank": lambda _: crank_values(),
    "ur10e": ur10e_values,
}


def read_table(name: str) -> dict[str, np.ndarray]:
    """Return the columns of a table of `benchmarks/reference` by name, without units."""
    with (benchmark_folder() / "reference" / name).open(encoding="ascii") as lines:
        head, *rows = csv.reader(lines)
    names = [column.split("[")[0].strip() for column in head]
    return dict(zip(names, np.array(rows, dtype=float).T, strict=True))


# -- checking --------------------------------------------------------------------------------


def check(case: Case, records: Path | None = None) -> list[Checked]:
    """Run a case on this rank; return its values beside their references.

    Args:
        case: of the benchmark.
        records: folder of the measured records, for a case that needs them.

    Raises:
        ConvergenceError: it cannot be simulated.
        InputError: the records are not those of the case.
    """
    if case.scene is None:
        found = PROGRAMS[case.program](records)
        return [_number(case, one, found[one.quantity]) for one in case.values]
    asked = any(one.quantity == "stress" for one in case.values)
    model = Model(case.scene, *case.overrides, comm=MPI.COMM_SELF)
    result = model.simulate(case.design, stress=asked)
    return [
        _history(case, one, result)
        if one.table
        else _number(case, one, float(NUMBERS[one.quantity](result)))
        for one in case.values
    ]


def _number(case: Case, one: Value, value: float) -> Checked:
    return Checked(case, one, value, one.reference, value / one.reference - 1.0)


def _history(case: Case, one: Value, result: SimulationResult) -> Checked:
    table = read_table(one.table)
    t = table["t"]
    known = t <= one.until
    expected = np.stack([table[column] for column in one.columns], axis=1)[known]
    found = HISTORIES[one.quantity](result, t[known])
    value, reference, error = (
        float(np.linalg.norm(x, axis=1).max()) for x in (found, expected, found - expected)
    )
    return Checked(case, one, value, reference, error / reference)


def table_of(found: Sequence[Checked]) -> pd.DataFrame:
    """Return a row for every value: computed, reference, difference, limit, verdict."""
    sign = {"near": "", "most": "at most +", "least": "at least -"}
    rows = [
        {
            "case": one.case.name,
            "value": one.of.what,
            "unit": one.of.unit,
            "computed": f"{one.value:.6g}",
            "reference": f"{one.reference:.6g}",
            "difference": f"{one.difference:.2g}",
            "limit": f"{sign[one.of.way]}{one.of.limit:g}",
            "verdict": "met" if one.met else "MISSED",
        }
        for one in found
    ]
    return pd.DataFrame(rows)
