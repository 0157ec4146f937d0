"""Straight members of uniform section in the place of a scene's designed arms, beside the design.

Every section stands in the arms' envelope: with the design's mass in every arm, and, where the
scene has limits, as light as they allow. A member is a scene of its own, with solid arms whose
mesh lies in DIR/sections; it is simulated, judged and kept like any other case.

The lightest members are found by their shares s of the most material that the envelope takes. Each
limited value is taken for a sum of power laws, v = v0 (1 + sum_k a_k / p ((s_k / s_0k)^p - 1)) with
p = sum_k a_k and a from one simulation an arm; the next members are those whose mass is least where
these hold their limits, and so on.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import brentq, minimize

from dolfinopt.data import filled
from dolfinopt.disk import make_folder, write_bytes
from dolfinopt.errors import InputError
from dolfinopt.mesh.hollow import KINDS, Section, member
from dolfinopt.mesh.solid_cells import msh_bytes
from dolfinopt.output.folders import read_record
from dolfinopt.progress import with_unit
from dolfinopt.responses.constraints import EXCESS, Limit
from dolfinopt.scene.load import Scene, scene_from_dict
from dolfinopt.scene.schema import file_digest
from dolfinopt.scene.tables.arms import WALL_KEYS
from dolfinopt.study.cases import Case, Outcome, Steps
from dolfinopt.study.studies import (
    COMPLIANCE,
    DEVIATION,
    Report,
    Rows,
    deviation_panels,
    reported,
    single_design,
    with_failures,
)
from dolfinopt.study.tables import LineFigure, Study, Table

NAME = "sections"  # of the study's files, and of the folder of the members' meshes
DESIGN, LIGHTEST, SAME = "design", "lightest", "same mass"
BAR_CELLS = (4, 8)  # of a bar in place of an arm from a file: over its smaller side, at most
LEAST, MOST = 0.01, 0.95  # shares: thinner walls are foil, thicker ones leave a slit
STEPS = 20  # sets of power laws at most
STEP = 0.03  # relative change of a share from which the exponents are told
MOVE = 1.0  # largest change of ln s by one set of power laws, halved where they do not hold
WORTH = 3e-3  # relative gain of mass below which the search ends
PENALTY = 10.0  # of a relative excess over a relative mass: frequencies take most, m^2 and more
SLIGHT = 0.01  # relative excess of a limit by the design up to which it is told, but no defeat

Shares = tuple[float, ...]  # of every designed arm, in the scene's order
Found = tuple[Shares, bool] | None  # whether they hold; None: no simulation succeeded


# -- members ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Members:
    """Arms of one kind of section.

    Attributes:
        scene: whose designed arms are replaced.
        kind: of the section, in words.
        section: itself.
        folder: of the study; their meshes are in its folder `NAME`.
    """

    scene: Scene
    kind: str
    section: Section
    folder: Path

    @property
    def arms(self) -> tuple[int, ...]:
        """Indices of the arms with a section of their own."""
        return tuple(self.scene.cell_counts)

    def mass(self, arm: int, share: float) -> float:
        """Return the mass of one arm, kg."""
        link = self.scene.arms[arm]
        density = self.scene.material_of(arm).density
        return density * link.length * self.section.area(link.height, link.thickness, share)

    def total_mass(self, shares: Shares) -> float:
        """Return the mass of all arms, those that share another's design too, kg."""
        owners = self.scene.owners
        parts = zip(self.arms, shares, strict=True)
        return sum(owners.count(k) * self.mass(k, share) for k, share in parts)

    @property
    def most(self) -> float:
        """The largest share."""
        return MOST if self.section.plane is not None else 1.0

    def of_mass(self, masses: Mapping[str, float]) -> Shares | None:
        """Return the shares with which every arm has its mass, kg; None where one cannot."""
        result = []
        for k in self.arms:

            def gap(share: float) -> float:
                return self.mass(k, share) - masses[self.scene.arms[k].name]  # noqa: B023

            if gap(LEAST) > 0.0 or gap(self.most) < 0.0:
                return None
            result.append(float(brentq(gap, LEAST, self.most, xtol=1e-9)))
        return tuple(result)

    def sizes(self, shares: Shares) -> str:
        """Return the sizes of every arm in words, in mm."""
        texts = []
        for k, share in zip(self.arms, shares, strict=True):
            arm = self.scene.arms[k]
            size = self.section.measures(arm.height, arm.thickness, share)
            texts.append(f"{arm.name} " + " x ".join(f"{1e3 * length:.4g}" for length in size))
        return ", ".join(texts)

    def case(self, shares: Shares) -> Case:
        """Return the simulation of the members; their meshes are written."""
        data = self.scene.to_tree()
        rows: dict[int | None, dict[str, Any]]
        rows = {k: self._row(k, share) for k, share in zip(self.arms, shares, strict=True)}
        for row, owner in zip(data["arms"], self.scene.owners, strict=True):
            row.update(rows.get(owner, {}))
        data["design"] = {"volume_fraction": 1.0, "initial": 1.0, "filter_radius": 0.0}
        scene = scene_from_dict(data, self.scene.source)
        return Case(scene, label=f"{self.kind}, {self.sizes(shares)} mm")

    def _row(self, index: int, share: float) -> dict[str, Any]:
        """Return the keys of an arm with its section."""
        arm = self.scene.arms[index]
        none = ("mesh", "element", "mesh_size", "cell_shape", "cells", "passive",
                "interface_offset", *WALL_KEYS)  # fmt: skip
        row: dict[str, Any] = dict.fromkeys(none)
        row |= {"symmetric": False, "hollow": False, "mesh_scale": 1.0}
        row |= {"regions": [], "interfaces": [], "design": arm.design if arm.shares else None}
        if self.section.plane is None:
            height, thickness = self.section.measures(arm.height, arm.thickness, share)
            cells = arm.cells or _bar_cells(arm.length, height, thickness, arm.is_solid)
            return row | {"height": height, "thickness": thickness, "cells": cells}
        mesh = member(self.section, arm.length, (arm.height, arm.thickness), share)
        data = msh_bytes(mesh)
        path = self.folder / NAME / f"{hashlib.sha256(data).hexdigest()[:16]}.msh"
        if not path.exists():
            make_folder(path.parent)
            write_bytes(path, data)
        _, height, thickness = map(float, mesh.extents)
        own = {"height": height, "thickness": thickness, "cell_shape": "hexahedron"}
        return row | own | {"mesh": str(path.absolute())}


def _bar_cells(length: float, height: float, thickness: float, solid: bool) -> tuple[int, ...]:
    """Return the cells of a bar in place of an arm from a file."""
    small, most = BAR_CELLS
    sides = (height, thickness) if solid else (height,)
    least = min(sides)
    across = tuple(min(most, round(small * side / least)) for side in sides)
    return max(24, round(2.0 * length / max(sides))), *across


# -- the lightest that hold the limits -----------------------------------------------------------


def limited(outcome: Outcome) -> dict[str, float]:
    """Return ln(value / limit) of every limit that material helps to hold; <= 0 where it is held.

    Of lower limits ln(limit / value).
    """
    return {
        limit.name: math.log(max(1e-9, limit.value / limit.limit)) * (-1.0 if limit.least else 1.0)
        for limit in _limits(outcome)
        if not limit.name.startswith("mass")
    }


def lightest(members: Members) -> Steps[Found]:
    """Search the lightest members that hold the limits.

    Returns:
        Shares, and whether they hold; of members that do not, those that come nearest. None where
        no simulation succeeded.
    """
    shares, move = (members.most,) * len(members.arms), MOVE
    case = members.case(shares)
    base = limited((yield [case])[case])
    tried = {shares: _largest(base)}
    for _ in range(STEPS if base else 0):
        stepped = [_stepped(members, shares, k) for k in range(len(shares))]
        cases = [members.case(item) for item in stepped]
        done = yield cases
        after = _balanced(members, shares, base, stepped, [limited(done[x]) for x in cases], move)
        case = members.case(after)
        excesses = limited((yield [case])[case])
        tried[after] = _largest(excesses)
        gain = _merit(members, shares, tried) - _merit(members, after, tried)
        is_decided = tried[after] > EXCESS or -EXCESS < tried[after] <= 0.0
        if after == shares or (abs(gain) < WORTH and is_decided):
            break
        if gain > 0.0:
            shares, base = after, excesses
        else:  # the power laws hold over less than that
            move *= 0.5
    holding = [item for item, excess in tried.items() if excess <= 0.0]
    if holding:
        return min(holding, key=members.total_mass), True
    nearest = min(tried, key=lambda item: tried[item])
    return (nearest, False) if math.isfinite(tried[nearest]) else None


def _largest(excesses: Mapping[str, float]) -> float:
    """Return the largest excess; of members that cannot be simulated infinity."""
    return max(excesses.values(), default=math.inf)


def _merit(members: Members, shares: Shares, tried: Mapping[Shares, float]) -> float:
    """Return the logarithm of the mass, and what limits are exceeded by, which weighs more."""
    return math.log(members.total_mass(shares)) + PENALTY * max(0.0, tried[shares])


def _stepped(members: Members, shares: Shares, k: int) -> Shares:
    """Return the shares with a little more in one arm, or less where there is no more."""
    more = shares[k] * (1.0 + STEP)
    changed = more if more <= members.most else shares[k] * (1.0 - STEP)
    return (*shares[:k], round(changed, 9), *shares[k + 1 :])


def _balanced(
    members: Members,
    shares: Shares,
    base: Mapping[str, float],
    stepped: Sequence[Shares],
    changed: Sequence[Mapping[str, float]],
    move: float,
) -> Shares:
    """Return the shares of least mass by the power laws through the excesses `base`, `changed`.

    The latter are of `stepped`, with one arm's share changed each; `move` is the largest change of
    a share's logarithm.
    """
    known = pd.DataFrame([base, *changed]).dropna(axis="columns").to_numpy(dtype=float)
    values, start, steps = known[0], np.log(shares), np.log(stepped)
    slopes = (known[1:] - values) / np.diag(steps - start)[:, None]  # (arms, limits)
    exponent = slopes.sum(axis=0) + 1e-9

    def room(z: np.ndarray) -> np.ndarray:
        parts = slopes / exponent * np.expm1(np.outer(z[:-1] - start, exponent))
        return 1.0 - 0.5 * EXCESS + z[-1] - np.exp(values) * (1.0 + parts.sum(axis=0))

    low, high = math.log(LEAST), math.log(members.most)
    bounds = [(max(low, x - move), min(high, x + move)) for x in start]
    result = minimize(  # x, and what is beyond half of the tolerance below the limits
        lambda z: math.log(members.total_mass(tuple(np.exp(z[:-1])))) + PENALTY * z[-1],
        [*start, 0.0],
        method="SLSQP",
        bounds=[*bounds, (0.0, None)],
        constraints={"type": "ineq", "fun": room},
    )
    return tuple(round(float(share), 9) for share in np.exp(result.x[:-1]))


# -- the study -------------------------------------------------------------------------------


def _limits(outcome: Outcome) -> list[Limit]:
    """Return the scene's limits and what becomes of them, without that of the volume."""
    return [
        Limit(name, "", item["value"], item["limit"], item["unit"], item["bound"] == "least")
        for name, item in outcome.summary.get("constraints", {}).items()
        if not name.startswith("volume_fraction")
    ]


def study_sections(scene: Scene, designs: Sequence[Path], folder: Path) -> Steps[Study]:
    """Return the steps of comparing straight members with the design.

    Args:
        scene: whose designed arms are replaced, all by one kind of section.
        designs: design.npz of the design; none: it is optimised.
        folder: of the study, for the members' meshes.

    Raises:
        InputError: the scene's arms cannot be replaced; nothing was computed.
    """
    _check_replaceable(scene)
    label, design = single_design(scene, designs, NAME)
    own = Case(scene, "simulate", design, DESIGN)
    first = (yield [own])[own]
    if first.failure:
        return Study((), (), first.failures)
    kinds = KINDS[scene.dimension].items()
    every = [Members(scene, kind, section, folder) for kind, section in kinds]
    asked: list[tuple[Members, str, Shares]] = []
    for members in every if limited(first) else ():
        if result := (yield from lightest(members)):
            shares, holds = result
            asked.append((members, LIGHTEST if holds else "nearest to the limits", shares))
    asked += [(members, SAME, shares) for members, shares in _as_heavy(every, first)]
    rows: Rows = [({"section": DESIGN, "made": label, "sizes [mm]": ""}, own)]
    for members, sizing, shares in asked:
        sizes = f"{members.section.named}: {members.sizes(shares)}"
        labels = {"section": members.kind, "made": sizing, "sizes [mm]": sizes}
        rows.append((labels, members.case(shares)))
    study = yield from reported(rows, partial(report, scene=scene))
    # A member that is too soft to be simulated is a finding, in its row, and no failure.
    return replace(study, failures=())


def _as_heavy(every: Sequence[Members], outcome: Outcome) -> list[tuple[Members, Shares]]:
    """Return the members that have the masses of what was simulated in every arm."""
    masses = outcome.summary["mass"]
    return [
        (members, shares) for members in every if (shares := members.of_mass(masses)) is not None
    ]


AHEAD = ("solid bar", "rectangular tube", "round tube")  # whose figures come before a design


def ahead(scene: Scene, folder: Path) -> Steps[list[str]]:
    """Return the steps to what straight tubes and bars reach in place of solid links, a line each.

    Those of the links' mass at the start, and the limit that each uses most: three simulations.
    [] of machines in the plane, and where no straight member can take a link's place.
    """
    try:
        _check_replaceable(scene)
    except InputError:
        return []
    if not any(scene.arms[k].is_solid and not scene.arms[k].hollow for k in scene.designed):
        return []
    start = Case(scene, label="start")
    first = (yield [start])[start]
    if first.failure:
        return []
    every = [Members(scene, kind, KINDS[3][kind], folder) for kind in AHEAD]
    cases = {members.case(shares): members for members, shares in _as_heavy(every, first)}
    done = yield [*cases]
    reached = [(item, done[case]) for case, item in cases.items() if not done[case].failure]
    lines = [_reached(scene, *item) for item in reached]
    if any(item.section.plane is not None for item, _ in reached):
        lines.append("with walls, arms.hollow = true, a link keeps a tube's outer surface")
    return lines


def _reached(scene: Scene, members: Members, outcome: Outcome) -> str:
    """Return mass and objective of members in words."""
    response, limits = scene.objective.response, _limits(outcome)
    value = with_unit(f"{response.label} {outcome.objective:.4g}", response.unit)
    if limits:
        most = max(limits, key=lambda limit: limit.excess)
        used = f"{most.words} {most.value:.3g} of {most.limit:.3g}"
        value = f"{value}, {with_unit(used, most.unit)}"
    mass = outcome.summary["designed_mass"]
    return f"a straight {members.kind} of the links' mass at the start, {mass:.3g} kg: {value}"


def _check_replaceable(scene: Scene) -> None:
    """Raise InputError where no straight member can take an arm's place."""
    if not scene.cell_counts:
        raise InputError(f"{scene.source}: sections: expected arms with a design, found none")
    for index, arm in enumerate(scene.arms):
        where, angle = f"{scene.source}: arms.{arm.name}", scene.material_of(index).angle
        if scene.is_spatial and arm.flexible and angle:
            raise InputError(
                f"{where}.angle: sections: expected 0 in space, found {angle} rad; the fibres "
                "of a member are along it"
            )
        if arm.flexible and arm.further_interfaces:
            raise InputError(
                f"{where}.interfaces: sections: expected one outboard interface, found more; a "
                "straight member has one end"
            )


# -- table, sentence, picture ----------------------------------------------------------------


def _bound(limit: Limit) -> str:
    sign = ">=" if limit.least else "<="
    return f"{limit.words} {sign} " + with_unit(f"{limit.limit:g}", limit.unit)


def report(frame: pd.DataFrame, scene: Scene) -> Report:
    """Return the table under the sentence that names the winner, and the deviations over time."""
    objective = f"objective [{scene.objective.response.unit}]"
    known = frame.assign(**{objective: [outcome.objective for outcome in frame["outcome"]]})
    columns = ["section", "made", "sizes [mm]", "mass [kg]", objective, COMPLIANCE, DEVIATION,
               "settling [mm]", "stress [MPa]", "grayness [-]"]  # fmt: skip
    limits = pd.DataFrame(
        {_bound(x): f"{x.value:.4g} {'met' if x.met else 'not met'}" for x in _limits(outcome)}
        for outcome in frame["outcome"]
    )
    shown = frame[frame["failure"] == ""]
    if (light := shown["made"] == LIGHTEST).any():
        shown = shown[light | (shown["section"] == DESIGN)]
    named = [
        replace(outcome, case=replace(outcome.case, label=f"{kind}, {mass:.4g} kg"))
        for kind, mass, outcome in zip(shown["section"], shown["mass [kg]"], shown["outcome"])
    ]
    title = "Deviation with straight members and with the design"
    table = Table("", verdict(scene, frame), with_failures(frame, known[columns].join(limits)))
    return [table], [LineFigure("deviation", title, deviation_panels(named))]


def verdict(scene: Scene, frame: pd.DataFrame) -> str:
    """Return the sentence that says who wins, and what one has to know to read the table.

    By mass where the scene limits what members do, the lightest that hold against the design;
    otherwise by the objective, with the same mass.
    """
    design, *others = frame.to_dict("records")
    is_limited, limits = bool(limited(design["outcome"])), _limits(design["outcome"])
    able = [row for row in others if not row["failure"]]
    if is_limited:
        able = [
            row
            for row in able
            if row["made"] == LIGHTEST and all(limit.met for limit in _limits(row["outcome"]))
        ]
    over = {limit.name: limit.excess for limit in limits if not limit.met}
    kinds = {row["section"] for row in others if row["made"] == SAME}
    text = filled(
        "sections.txt.jinja",
        {},
        limited=is_limited,
        design=design,
        best=min(
            able,
            key=lambda row: row["mass [kg]"] if is_limited else row["outcome"].objective,
            default=None,
        ),
        over=over,
        broken=max(over.values(), default=0.0) > SLIGHT,
        response=scene.objective.response,
        dimension=scene.dimension,
        least=LEAST,
        most=MOST,
        sizes=len(scene.cell_counts),
        missing=[kind for kind in KINDS[scene.dimension] if kind not in kinds],
    )
    return " ".join(text.split())


def sections_of(run: Path) -> Table | None:
    """Return the table of RUN/sections, where a study has compared the run's design with members.

    None where there is none, or of another design.
    """
    folder = run / NAME
    asked = read_record(folder / f"{NAME}.json").get("question")
    try:
        if not asked or asked["designs"] != [file_digest(run / "design.npz")]:
            return None
        title = (folder / f"{NAME}.md").read_text("utf-8").partition("\n")[0]
        return Table(NAME, title, pd.read_csv(folder / f"{NAME}.csv", keep_default_na=False))
    except (OSError, ValueError, KeyError, TypeError, InputError):
        return None
