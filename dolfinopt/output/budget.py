"""The budget of the largest deviation: in summary.json, as a table, and in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dolfinopt.disk import write_text
from dolfinopt.dynamics.budget import deflection_budget

if TYPE_CHECKING:
    from dolfinopt.dynamics.simulation import Trajectory

BUDGET_FILE = "budget.csv"


def budget_of(trajectory: Trajectory | None) -> dict[str, Any] | None:
    """Return the budget as summary.json has it; None without a motion or a deviation."""
    found = None if trajectory is None else deflection_budget(trajectory)
    return None if found is None else {**asdict(found), "shares": found.shares}


def write_budget(folder: Path, budget: Mapping[str, Any] | None) -> None:
    """Write the parts of a budget as a table (CSV), if there is one."""
    if budget is None:
        return
    rows = [
        f"{one['kind']},{one['name']},{one['deflection']:.10g},{one['share']:.10g}\n"
        for one in budget["parts"]
    ]
    write_text(folder / BUDGET_FILE, "".join(["kind,part,deflection [m],share [-]\n", *rows]))


def sentence(budget: Mapping[str, Any]) -> str:
    """Return the shares of all kinds of parts in a line, the links' first."""
    links, *others = [f"{name} {100.0 * x:.3g} %" for name, x in budget["shares"].items()]
    held = links.replace("links ", "links hold ", 1)
    return f"{held} of the deflection{''.join(f', {one}' for one in others)}"


def table(budget: Mapping[str, Any]) -> list[str]:
    """Return the parts as lines of a table."""
    head = (
        f"at {budget['instant']:.3f} s, {1e3 * budget['linear']:.4g} mm to first order "
        f"({1e3 * budget['deviation']:.4g} mm simulated):"
    )
    width = max(len(one["name"]) for one in budget["parts"])
    return [
        head,
        *(
            f"  {one['kind']:<8} {one['name']:<{width}} {1e3 * one['deflection']:>10.4g} mm "
            f"{100.0 * one['share']:>6.1f} %"
            for one in budget["parts"]
        ),
    ]
