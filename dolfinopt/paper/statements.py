"""The paper's statements, `statements.toml`, checked against the results."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dolfinopt.paper.reproduction import INITIAL, METHODS, OPTIMUM, SOLID, cross_values, loss
from dolfinopt.scene.load import tomllib

MANY = 3.0  # from here on "n times" reads better than per cent
TABLE = tomllib.loads((Path(__file__).parent / "statements.toml").read_text(encoding="utf-8"))
TOLERANCE = TABLE["tolerance"]
TEXTS = ("name", "statement", "paper", "found", "criterion", "reason", "demand")


@dataclass(frozen=True)
class Check:
    """One statement of the paper, see the table: it holds or not; the demand stands or not."""

    name: str
    statement: str
    paper: str
    found: str
    criterion: str
    reason: str
    demand: str
    holds: bool
    stands: bool
    figures: tuple[int, ...]

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        if self.holds:
            return f"Holds: {self.found}."
        return f"Does not hold: {self.found}. {self.reason}".strip()


def check_paper(results: pd.DataFrame) -> list[Check]:
    """Return all checks of the results, see `add_outcomes`, in the order of the paper's figures."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(undefined=StrictUndefined)
    environment.filters |= {"mm": mm, "percent": percent, "Nm": "{:.4g} N m".format}
    environment.filters["listed"] = lambda x: "; ".join(f"{k} {percent(x[k])}" for k in x)
    values = TOLERANCE | quantities(results)

    def verdict(text: str) -> bool:
        return bool(environment.compile_expression(text, False)(values))

    checks = []
    for one in TABLE["statement"]:
        texts = {k: environment.from_string(one.get(k, "")).render(values).strip() for k in TEXTS}
        holds, stands = verdict(one["holds"]), verdict(one.get("stands", "true"))
        checks.append(Check(**texts, holds=holds, stands=stands, figures=tuple(one["figures"])))
    return checks


def failed_checks(checks: Iterable[Check]) -> list[str]:
    """Return what `--check` demands and is not so, one line each."""
    return [f"{c.name}: expected {c.demand}; found {c.found}" for c in checks if not c.stands]


def mm(length: float) -> str:
    """Return a length in mm."""
    return f"{1e3 * length:.2f} mm" if length < 0.1 else f"{1e3 * length:.0f} mm"


def percent(part: float) -> str:
    """Return a part in per cent, or as "n times" where it is large."""
    digits = 2 if abs(part) < 0.1 else 1
    return f"{part:.0f} times" if part >= MANY else f"{100.0 * part:.{digits}f} %"


# -- quantities ------------------------------------------------------------------------------


def quantities(results: pd.DataFrame) -> dict[str, Any]:
    """Return everything that texts and criteria name; nan where a case failed."""
    by = dict(iter(results.groupby("table")))
    curves, reductions = by["coordinates"], by["reductions"].sort_values("x").astype({"x": int})
    cms, modal = (reductions[reductions.kind == method] for method in METHODS)
    ends = {"few_cms": cms.iloc[0], "many_cms": cms.iloc[-1]}
    ends |= {"few_modal": modal.iloc[0], "many_modal": modal.iloc[-1]}
    return ends | {
        "cms_change": abs(cms.compliance.iloc[0] / cms.compliance.iloc[-1] - 1.0),
        "before": _of_coordinates(curves[curves.label == INITIAL]),
        "after": _of_coordinates(curves[curves.label == OPTIMUM]),
        **_of_objectives(by["objectives"]),
        **_of_payloads(by["payload"]),
        **_of_paths(by["path"]),
    }


def _of_objectives(rows: pd.DataFrame) -> dict[str, Any]:
    initial, dynamic = rows.iloc[0], rows[rows.kind == "esl"].iloc[0]
    others = rows[rows.kind.isin(["static", "eigenfrequency"])]
    ratios = others.deviation / initial.deviation
    rivals = [initial.compliance, *others.compliance]
    return {
        "initial": initial.deviation,
        "dynamic": dynamic,
        "dynamic_is_far": (dynamic.deviation < TOLERANCE["far"] * others.deviation).all(),
        "dynamic_is_best": all(dynamic.compliance < c for c in rivals if not math.isnan(c)),
        "fourths": others.kind[ratios.between(*TOLERANCE["fourth"])].nunique(),
        "ratios": dict(zip(others.label, ratios)),
        "best": others.sort_values("compliance").iloc[0],  # nan comes last
    }


def _of_coordinates(rows: pd.DataFrame) -> dict[str, Any]:
    """Return what one design's curves over the number of coordinates do."""
    cms, modal = (rows[rows.kind == method] for method in METHODS)
    c, m = cms.compliance.to_numpy(), modal.compliance.to_numpy()
    climbs = (np.diff(m) >= -TOLERANCE["flat"] * m[-1]).all() and m[-1] > m[0]
    return {
        "level": c[-1],
        "flat": span(c),
        "modal": m[[0, -1]],
        "climbs_below": climbs and m.max() < c.min(),
        "counts": modal.x.iloc[[0, -1]].astype(int).tolist(),
        "apart": np.max(cms.apart.to_numpy()),
        "below": 1.0 - modal.deviation.to_numpy()[[0, -1]] / cms.deviation.iloc[-1],
    }


def _of_payloads(rows: pd.DataFrame) -> dict[str, Any]:
    x, designs = rows.x.unique(), dict(iter(rows.groupby("label")))
    made = rows.dropna(subset="made_for").pivot(index="made_for", columns="x", values="compliance")
    curves = designs[INITIAL].compliance, made.iloc[1]
    return {
        "payloads": x[[0, -1]],
        "made_for": made.index[[0, -1]],
        "bend_deviation": np.max([bend(x, one.deviation) for one in designs.values()]),
        "bend": [bend(x, y) for y in curves],
        "power": [power(x, y) for y in curves],
        "payload_differ": np.max(np.abs(made.iloc[0].to_numpy() / made.iloc[-1].to_numpy() - 1.0)),
        "payload_loss": _losses(rows),
    }


def _of_paths(rows: pd.DataFrame) -> dict[str, Any]:
    designs = {label: one.set_index("x") for label, one in rows.groupby("label")}
    initial, solid = designs[INITIAL], designs[SOLID].deviation
    nominal = rows.dropna(subset="made_for").label.iloc[-1]
    made = cross_values(rows, "deviation")
    own = pd.Series(np.diag(made), made.index)
    ratios = own / initial.deviation[own.index]
    return {
        "change_initial": span(initial.compliance),
        "change_optimum": span(designs[nominal].compliance),
        "path": [ratios.min(), ratios.max(skipna=False)],
        "over_solid": (own / solid[own.index]).max(skipna=False),
        "solid": solid.iloc[-1],
        "solids": (solid / initial.deviation).agg(["min", "max"]).tolist(),
        "path_loss": _losses(rows),
    }


def _losses(rows: pd.DataFrame) -> list[float]:
    """Return the largest losses of compliance and of deviation; nan where a design failed."""
    return [float(np.max(loss(rows, name).to_numpy())) for name in ("compliance", "deviation")]


def span(values: Iterable[float]) -> float:
    """Return (largest - smallest) / largest; nan where a value is."""
    found = np.array([*values])
    return float((found.max() - found.min()) / found.max())


def bend(x: Iterable[float], y: Iterable[float]) -> float:
    """Return the largest distance from the straight line of best fit, relative to the mean."""
    x, y = np.array([*x]), np.array([*y])
    if not np.isfinite(y).all():
        return math.nan
    return float(np.abs(y - np.polyval(np.polyfit(x, y, 1), x)).max() / y.mean())


def power(x: Iterable[float], y: Iterable[float]) -> float:
    """Return p of y ~ x^p between the ends."""
    (x0, *_, x1), (y0, *_, y1) = x, y
    return math.log(y1 / y0) / math.log(x1 / x0)
