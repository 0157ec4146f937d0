"""The paper's statements, `statements.toml`, checked against the results."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dolfinopt.density.interpolation import interpolate
from dolfinopt.paper.reproduction import (
    INITIAL,
    METHODS,
    OPTIMUM,
    SOLID,
    SOLID_ENDS,
    cross_values,
    loss,
)
from dolfinopt.scene.load import Scene

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MANY = 3.0  # from here on "n times" reads better than per cent
TABLE = tomllib.loads((Path(__file__).parent / "statements.toml").read_text(encoding="utf-8"))
TOLERANCE = TABLE["tolerance"]


@dataclass(frozen=True)
class Check:
    """One statement of the paper and what is found here.

    Attributes:
        name: short, of messages.
        figures: the paper's numbers.
        statement: in words.
        paper, found: figures beside each other.
        criterion, holds: what makes it hold, whether it does.
        reason: why it does not, "" if that is not known.
        demand, stands: what `--check` demands, "" for nothing; whether that is so.
    """

    name: str
    figures: tuple[int, ...]
    statement: str
    paper: str
    found: str
    criterion: str
    holds: bool
    reason: str
    demand: str
    stands: bool

    @property
    def sentence(self) -> str:
        """The verdict in words."""
        if self.holds:
            return f"Holds: {self.found}."
        return f"Does not hold: {self.found}. {self.reason}".strip()


def check_paper(results: pd.DataFrame, scene: Scene) -> list[Check]:
    """Return all checks of the results, see `add_outcomes`, in the order of the paper's figures."""
    from jinja2 import Environment, StrictUndefined

    environment = Environment(undefined=StrictUndefined)
    environment.filters |= {"mm": mm, "percent": percent, "Nm": "{:.4g} N m".format}
    environment.filters["listed"] = lambda x: "; ".join(f"{k} {percent(x[k])}" for k in x)
    values = TOLERANCE | quantities(results, scene)

    def filled(text: str) -> str:
        return environment.from_string(text).render(values).strip()

    def true(expression: str) -> bool:
        return bool(environment.compile_expression(expression, False)(values))

    texts = ("name", "statement", "paper", "found", "criterion", "reason", "demand")
    return [
        Check(
            figures=tuple(one["figures"]),
            holds=true(one["holds"]),
            stands=true(one.get("stands", "true")),
            **{key: filled(one.get(key, "")) for key in texts},
        )
        for one in TABLE["statement"]
    ]


def failed_checks(checks: Iterable[Check]) -> list[str]:
    """Return what `--check` demands and is not so, one line each."""
    return [f"{c.name}: expected {c.demand}; found {c.found}" for c in checks if not c.stands]


def mm(length: float) -> str:
    """Return a length in mm."""
    return f"{1e3 * length:.2f} mm" if length < 0.1 else f"{1e3 * length:.0f} mm"


def percent(part: float) -> str:
    """Return a part in per cent, or as "n times" where it is large."""
    if part >= MANY:
        return f"{part:.0f} times"
    return f"{100.0 * part:.2f} %" if abs(part) < 0.1 else f"{100.0 * part:.1f} %"


# -- quantities ------------------------------------------------------------------------------


def quantities(results: pd.DataFrame, scene: Scene) -> dict[str, Any]:
    """Return everything that texts and criteria name; nan where a case failed."""
    by = dict(iter(results.groupby("table")))
    curves = by["coordinates"]
    return {
        **_of_objectives(by["objectives"]),
        **_of_solid_ends(by["ends objectives"], by["ends reductions"]),
        **_of_reductions(by["reductions"]),
        "before": _of_coordinates(curves[curves.label == INITIAL]),
        "after": _of_coordinates(curves[curves.label == OPTIMUM]),
        **_of_payloads(by["payload"]),
        **_of_paths(by["path"]),
        **_of_stiffness(scene),
    }


def _of_objectives(rows: pd.DataFrame) -> dict[str, Any]:
    initial, dynamic = rows.iloc[0], rows[rows.kind == "esl"].iloc[0]
    others = rows[rows.kind.isin(["static", "eigenfrequency"])]
    ratios = others.deviation / initial.deviation
    best = others.sort_values("compliance").iloc[0]  # nan comes last
    rivals = [initial.compliance, *others.compliance]
    return {
        "initial": initial.deviation,
        "dynamic": dynamic.deviation,
        "dynamic_ratio": dynamic.deviation / initial.deviation,
        "dynamic_compliance": dynamic.compliance,
        "dynamic_is_far": (dynamic.deviation < TOLERANCE["far"] * others.deviation).all(),
        "dynamic_is_best": all(dynamic.compliance < c for c in rivals if not math.isnan(c)),
        "fourths": others.kind[ratios.between(*TOLERANCE["fourth"])].nunique(),
        "ratios": dict(zip(others.label, ratios)),
        **dict(zip(("low", "high"), ratios.agg(["min", "max"]))),
        **dict(zip(("best", "best_label"), best[["compliance", "label"]])),
    }


def _of_solid_ends(objectives: pd.DataFrame, reductions: pd.DataFrame) -> dict[str, Any]:
    initial, made = objectives.iloc[0].deviation, objectives.iloc[1:]
    worst = made.sort_values("deviation", na_position="first").iloc[-1]
    ends = f"With {1e3 * SOLID_ENDS:.0f} mm of solid material at both ends of the arms"
    cms = reductions.iloc[0]
    behind = " and ".join(
        f"{percent(one.compliance / cms.compliance - 1.0)} compliance and "
        f"{percent(one.deviation / cms.deviation - 1.0)} deviation with {one.x:g}"
        for one in reductions.iloc[1:].itertuples()
    )
    return {
        "ends": ends,
        "ends_ratios": dict(zip(made.label, made.deviation / initial)),
        "ends_dynamic": made[made.kind == "esl"].iloc[0].deviation,
        **dict(zip(("ends_worst", "ends_worst_label"), worst[["deviation", "label"]])),
        "ends_modal": f"{ends} designs made with modes lose {behind} coordinates.",
    }


def _of_reductions(rows: pd.DataFrame) -> dict[str, Any]:
    ordered = rows.sort_values("x").astype({"x": int})
    cms, modal = (ordered[ordered.kind == method] for method in METHODS)
    return {
        **{"few_cms": cms.iloc[0], "many_cms": cms.iloc[-1]},
        **{"few_modal": modal.iloc[0], "many_modal": modal.iloc[-1]},
        "cms_change": abs(cms.compliance.iloc[0] / cms.compliance.iloc[-1] - 1.0),
    }


def _of_coordinates(rows: pd.DataFrame) -> dict[str, Any]:
    """Return what one design's curves over the number of coordinates do."""
    cms, modal = (rows[rows.kind == method] for method in METHODS)
    c, m = cms.compliance.to_numpy(), modal.compliance.to_numpy()
    climbs = (np.diff(m) >= -TOLERANCE["flat"] * m[-1]).all() and m[-1] > m[0]
    return {
        "level": c[-1],
        "flat": span(c),
        **dict(zip(("modal_first", "modal_last"), m[[0, -1]])),
        "climbs_below": climbs and m.max() < c.min(),
        **dict(zip(("first", "last"), modal.x.iloc[[0, -1]].astype(int))),
        "apart": np.max(cms.apart.to_numpy()),
        "below": 1.0 - modal.deviation.to_numpy()[[0, -1]] / cms.deviation.iloc[-1],
    }


def _of_payloads(rows: pd.DataFrame) -> dict[str, Any]:
    x, made_for = rows.x.unique(), rows.made_for.dropna().unique()
    designs = dict(iter(rows.groupby("label")))
    initial = designs[INITIAL].compliance
    made = rows.pivot(index="made_for", columns="x", values="compliance").loc[made_for].to_numpy()
    return {
        **dict(zip(("lightest", "heaviest"), x[[0, -1]])),
        **dict(zip(("light", "heavy"), made_for[[0, -1]])),
        "bend_deviation": np.max([bend(x, one.deviation) for one in designs.values()]),
        **{"bend_initial": bend(x, initial), "bend_optimum": bend(x, made[1])},
        **{"power_initial": power(x, initial), "power_optimum": power(x, made[1])},
        "payload_differ": np.max(np.abs(made[0] / made[-1] - 1.0)),
        "payload_loss": _losses(rows),
    }


def _of_paths(rows: pd.DataFrame) -> dict[str, Any]:
    designs = {label: one.set_index("x") for label, one in rows.groupby("label")}
    initial, solid = designs[INITIAL], designs[SOLID].deviation
    nominal = rows.dropna(subset="made_for").label.iloc[-1]
    made = cross_values(rows, "deviation")
    own = pd.Series(np.diag(made), made.index)
    ratios, solid_ratios = own / initial.deviation[own.index], solid / initial.deviation
    return {
        "change_initial": span(initial.compliance),
        "change_optimum": span(designs[nominal].compliance),
        **{"path_low": ratios.min(), "path_high": ratios.max(skipna=False)},
        "over_solid": (own / solid[own.index]).max(skipna=False),
        "solid": solid.iloc[-1],
        **dict(zip(("solid_low", "solid_high"), solid_ratios.agg(["min", "max"]))),
        "path_loss": _losses(rows),
    }


def _losses(rows: pd.DataFrame) -> list[float]:
    """Return the largest losses of compliance and of deviation; nan where a design failed."""
    return [float(np.max(loss(rows, name).to_numpy())) for name in ("compliance", "deviation")]


def _of_stiffness(scene: Scene) -> dict[str, Any]:
    """Return what flanges allow: those of a part V of the material have 1 - (1 - V)^3 of EI."""
    law, x, volume = scene.interpolation, scene.design.initial, scene.design.volume_fraction or 1.0
    stiffness = interpolate(np.array([x]), law.law, law.penalty, law.floor).stiffness
    words = "with q = {:g} of RAMP" if law.law == "ramp" else "to the power {:g}"
    return {
        "stiffness": round(float(stiffness[0]), 4),
        "interpolation": f"{x:g} {words.format(law.penalty)}",
        "volume": volume,
        "flanges": 1.0 - (1.0 - volume) ** 3,
        "more": "twice the material" if volume == 0.5 else f"{1.0 / volume:.3g} times the material",
    }


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
