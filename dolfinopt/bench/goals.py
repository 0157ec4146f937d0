"""The goals: what is wanted of the figures that the diagrams measure, all in `GOALS`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import pandas as pd

from dolfinopt.bench import arms, iterations, motion, optimiser, solid
from dolfinopt.bench.panel import Frame, curves, fastest, fitted_power
from dolfinopt.responses.constraints import EXCESS

Figure = tuple[float, str]  # nan where it was not measured, or not well enough; a remark
FASTER = 50.0  # than SciPy
LARGE = 4e4  # elements per arm up to which the exponent is fitted
SETTLED, DEMO = (math.prod(cells) for cells in (iterations.SETTLED, iterations.DEMO))
FEWEST, MILLION = 15_000, 900_000  # dofs from which on goals of links, and of their memory, hold


class Goal(NamedTuple):
    """What was wanted: a figure of a diagram's frame at most, or at `least`, at a limit."""

    diagram: str
    what: str
    limit: float
    measure: Callable[[Frame], Figure]
    least: bool = False

    def cells(self, frame: Frame) -> tuple[str, str, str, str]:
        """Return goal, limit, measured, met."""
        value, said = self.measure(frame)
        met = value >= self.limit if self.least else value <= self.limit
        verdict = "" if math.isnan(value) else "yes" if met else "no"
        figure = f"{value:.3g}" if verdict else "not measured"
        limit = f"at {'least' if self.least else 'most'} {self.limit:g}"
        return self.what, limit, f"{figure} ({said})" if said else figure, verdict


def goal_table(frames: Mapping[str, Frame]) -> Frame:
    """Return the goals of these diagrams' frames, a row each."""
    rows = [goal.cells(frames[goal.diagram]) for goal in GOALS if goal.diagram in frames]
    return Frame(rows, columns=["goal", "limit", "measured", "met"])


def _at(frame: Frame, **values: object) -> Frame:
    """Return the rows with these values; in names _ stands for a space."""
    for name, value in values.items():
        frame = frame[frame[name.replace("_", " ")] == value]
    return frame


def _ratio(one: float, other: float, unit: str) -> Figure:
    found = one / other
    return found, "" if math.isnan(found) else f"{one:.3g} {unit} over {other:.3g} {unit}"


# -- plane arms ------------------------------------------------------------------------------


def _simulation(coordinates: int, frame: Frame) -> Figure:
    """Return the seconds of a simulation as scenes have it by default, of the slower design."""
    usual = _at(frame, **motion.USUAL, coordinates_per_arm=coordinates)
    cells = usual[["design", motion.SECONDS, motion.ERROR]].itertuples(index=False)
    said = "; ".join(f"{name} {seconds:.3g}, error {e:.1e}" for name, seconds, e in cells)
    return usual[motion.SECONDS].max(), said


def _superiority(coordinates: int, frame: Frame) -> Figure:
    """Return how many times as long SciPy takes to our error, of the less superior design."""
    # A method that did not get there takes longer than its finest setting did: a bound. One that is
    # too low tells nothing.
    here, ratios, shown = _at(frame, coordinates_per_arm=coordinates), [math.inf], []
    for _, ours in _at(here, **motion.USUAL).iterrows():
        theirs = here[here["method"].str.startswith("SciPy") & (here["design"] == ours["design"])]
        found = curves(theirs, motion.SECONDS, motion.ERROR, "method")
        there = fastest(found, ours[motion.ERROR])
        short = [one for one in found.values() if one.iloc[:, 1].min() > ours[motion.ERROR]]
        least = min((points.iloc[-1, 0] for points in short), default=math.inf)
        best = math.inf if there is None else there[1]
        bound = there is None or least < best
        ratios.append(min(best, least) / ours[motion.SECONDS])
        words = " or more: SciPy stopped short of that error" if bound else ""
        shown.append(f"{ours['design']} {ratios[-1]:.0f}{words}")
    worst = min(ratios)
    untold = math.isinf(worst) or (worst < FASTER and "or more" in " ".join(shown))
    return math.nan if untold else worst, "; ".join(shown)


def _demo(frame: Frame) -> Figure:
    """Return the seconds of a whole optimisation, and its iterations: more than of the others."""
    done = _at(frame, ranks=2, elements_per_arm=DEMO)
    done = done[done["iterations"] > iterations.COUNTED]
    said = "; ".join(f"{count:.0f} iterations" for count in done["iterations"])
    return done["all iterations, wall clock [s]"].min(), said


def _worst_error(frame: Frame) -> Figure:
    """Return the largest true error over the tolerance."""
    known = (over := frame["true error [-]"] / frame["tolerance [-]"]).dropna()
    missed, failed = (known > 1.0).sum(), len(over) - len(known)
    said = f"{missed} of {len(known)} random simulations miss it; {failed} failed"
    return known.max(), said


def _over_plain(program: str, column: str, frame: Frame) -> Figure:
    """Return the seconds of a program's iteration over those of plain DOLFINx's."""
    here = _at(frame, task=iterations.ITERATION, elements_per_arm=SETTLED)
    ours, plain = (_at(here, program=name)[column].min() for name in (program, iterations.PLAIN))
    return _ratio(ours, plain, "s")


def _power_of_elements(frame: Frame) -> Figure:
    """Return the power of the elements that an iteration's time on one rank grows with."""
    here = _at(frame, ranks=1)[["elements per arm", "iteration [s]"]]
    here = here[here["elements per arm"] <= LARGE]
    reach = "{} to {} elements".format(*here["elements per arm"].agg(["min", "max"]))
    return fitted_power(here), reach if len(here) else ""


def _least(column: str, scale: float, where: dict[str, Any], frame: Frame) -> Figure:
    """Return the least value of a column in the rows with these values, times `scale`."""
    return scale * _at(frame, **where)[column].min(), ""


# -- solid links -----------------------------------------------------------------------------


def _links(frame: Frame, what: str, ranks: int, fewest: float = FEWEST) -> Frame:
    here = _at(frame, what=what, ranks=ranks)
    return here[here["dofs"] >= fewest]


def _of(rows: Frame, value: float) -> Figure:
    """Return a figure with the range of dofs that it is of."""
    reach = f"{rows['dofs'].min():,} to {rows['dofs'].max():,} dofs" if len(rows) else ""
    return value, reach.replace(",", " ")


def _beside_plain(design: str, ranks: int, frame: Frame) -> Figure:
    """Return the largest ratio of an iteration to plain DOLFINx's of all sizes."""
    ours, plain = (_links(frame, w, ranks) for w in (f"{solid.OURS}, {design}", solid.PLAIN))
    if len(ours) != len(plain):  # some failed
        return math.nan, ""
    return _of(ours, (ours["iteration [s]"] / plain["iteration [s]"].to_numpy()).max())


def _power_of_dofs(design: str, ranks: int, frame: Frame) -> Figure:
    """Return the power of the dofs that time grows with beyond the range of factors."""
    ours, other = (
        _links(frame, f"{who}, {design}", ranks) for who in (solid.OURS, solid.ITERATIVE)
    )
    factored = ours["dofs"][ours["solver"] != solid.ITERATIVE].max()
    rows = _at(pd.concat([ours, other]), solver=solid.ITERATIVE)
    rows = rows[~(rows["dofs"] <= factored)]
    return _of(rows, fitted_power(rows[["dofs", "iteration [s]"]]))


def _memory(frame: Frame) -> Figure:
    rows = _links(frame, f"{solid.OURS}, {solid.COLD}", 2, MILLION)
    return _of(rows, rows["memory [GB]"].max())


# -- the optimiser ---------------------------------------------------------------------------


def _over_the_best(frame: Frame) -> Figure:
    """Return the largest objective of a start over the best one of its problem."""
    made = optimiser.compared(frame[frame["iterations"] > 0])
    if not len(made):
        return math.nan, ""
    worst = made.loc[made[optimiser.OVER].idxmax()]
    return worst[optimiser.OVER], f"{worst['problem']}, {worst['start']}"


def _over_straight(frame: Frame) -> Figure:
    """Return the rod's least mass over that of the straight one."""
    kept = frame[(frame["problem"] == optimiser.ROD) & (frame["largest excess [-]"] <= EXCESS)]
    drawn = kept["start"] == optimiser.BY_HAND
    return _ratio(kept[~drawn]["objective"].min(), kept[drawn]["objective"].min(), "kg")


def _evaluations(frame: Frame) -> Figure:
    made = frame[["evaluations", "iterations"]].sum()
    return made["evaluations"] / (made["iterations"] or math.nan), ""


def _infeasible(frame: Frame) -> Figure:
    made = frame[frame["iterations"] > 0]
    left = made[made["largest excess [-]"] > EXCESS]
    names = "; ".join(f"{one.problem}, {one.start}" for one in left.itertuples())
    return float(len(left)) if len(made) else math.nan, names


# -- the table -------------------------------------------------------------------------------

GOALS = (
    *(Goal("time", f"simulation to 1e-4 from cold, {q} coordinates per arm [s]", limit,
           partial(_simulation, q)) for q, limit in ((4, 0.03), (48, 0.3))),
    *(Goal("time", f"times as fast as solve_ivp at the same error, {q} coordinates per arm [-]",
           FASTER, partial(_superiority, q), least=True) for q in (4, 48)),
    Goal("peers", "dynamic iteration of two arms of 400 x 24 cells over plain DOLFINx's static one "
         "of one arm [-]", 1.6, partial(_over_plain, iterations.DYNAMIC, "seconds [s]")),
    Goal("peers", "the same on two ranks, wall clock [-]", 1.1,
         partial(_over_plain, iterations.TWO_RANKS, "wall clock [s]")),
    Goal("whole", "exponent of an iteration's time, elements up to 40000 per arm, 1 rank [-]", 1.3,
         _power_of_elements),
    Goal("whole", "demos/two_arm.toml on two ranks until it has converged, set-up included, wall "
         "clock [s]", 20.0, _demo),
    Goal("mesh", "error of tip compliance, 50 x 3 cells of the default element [%]", 0.5,
         partial(_least, "error of tip compliance [-]", 100.0, dict(
             element=arms.DEFAULT, cells="{} x {}".format(*arms.CELLS[0])))),
    Goal("tolerance", "largest true error over simulation.tolerance [-]", 1.0, _worst_error),
    Goal("optimiser", "objective from a start over the best of its problem, the largest [-]", 1.05,
         _over_the_best),
    Goal("optimiser", "mass of the rod over the best straight one [-]", 1.0, _over_straight),
    Goal("optimiser", "evaluations for an iteration, mean [-]", 1.3, _evaluations),
    Goal("optimiser", "runs that end without a feasible design", 0.0, _infeasible),
    *(Goal("solid", f"{what}, {ranks} rank{'s' * (ranks > 1)} [-]", limit,
           partial(measure, design, ranks))
      for ranks in (1, 2) for what, limit, measure, design in (
       ("iteration beside plain DOLFINx, the largest of all links", 3.0, _beside_plain, solid.COLD),
       ("with warm starts beside it, the largest of all links", 1.5, _beside_plain, solid.WARM),
       ("exponent of a first design beyond the range of factors", 1.15, _power_of_dofs, solid.COLD),
       ("exponent of a nearby design beyond the range of factors", 1.15, _power_of_dofs,
        solid.WARM),
    )),
    Goal("solid", "memory of a million dofs on two ranks [GB]", 20.0, _memory),
)  # fmt: skip
