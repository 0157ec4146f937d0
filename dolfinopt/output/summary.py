"""summary.json: what a run found, what it cost, what it was made with; budget.csv."""

from __future__ import annotations

import json
import platform
import resource
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from dolfinopt.arms.arm import Arm, stiffening_of
from dolfinopt.density.contacts import Contacts
from dolfinopt.density.measured import GREY
from dolfinopt.density.members import Width, Widths, widths_of
from dolfinopt.disk import finite, write_text
from dolfinopt.dynamics.budget import deflection_budget
from dolfinopt.dynamics.build import Trajectory
from dolfinopt.mesh import compat
from dolfinopt.motion.build import forced_rest, loop_start, misfit
from dolfinopt.multibody.loads import Stiffening
from dolfinopt.multibody.measured import STIFFNESS_CHANGE_LIMIT
from dolfinopt.optimization.result import RankResult, Result
from dolfinopt.output.feed_forward import compared, lead_warnings, summary_of_feed_forward
from dolfinopt.output.torsion import torsion_warnings
from dolfinopt.output.trajectory import (
    UNITS,
    by_drive,
    drive_units,
    free_drives,
    joint_limits,
    trajectory_units,
)
from dolfinopt.parallel import Partition, gather_arms, gather_tables, together
from dolfinopt.profiling import Counts
from dolfinopt.responses.constraints import limits_of, summary_of
from dolfinopt.responses.evaluation import Evaluation, Motion
from dolfinopt.responses.order_selection import OrderSelection
from dolfinopt.responses.stress_report import ArmStress, unjudged
from dolfinopt.scene.load import Scene
from dolfinopt.scene.messages import implausible
from dolfinopt.version import __version__

CONTACTS = "pieces", "corners", "edges", "places", "left_out", "remaining"  # of `Contacts`

# Outboard deflection over length up to which an arm deforms little. A beam bent by a tenth of its
# length has a slope of 0.15 to 0.2 at its end and is 0.6 % shorter, which linear elasticity leaves
# out. The rotation tells where soft material at the end gives way: arms fold there, undeflected.
SMALL = 0.1
SMALL_TURN = 0.2  # rad
# Radius of the filter in cells, and erosion of the robust projection, from which on its designs had
# few or no cells that meet in corners or edges alone (docs/pages/develop/decisions.md).
FILTER_CELLS, EROSION = 2.0, 0.25
SOLID = 0.5 - 1e-6  # densities above are; a uniform one of one half is, however the filter rounds
NO_JOINTS = (
    "the design cut at a density of one half joins its interfaces by contacts alone: without them "
    "there is nothing to simulate"
)
FALLS_APART = (
    "the motion of the design cut at a density of one half cannot be simulated: what is left is "
    "too weak; let the optimisation go on (optimizer.max_iterations) until the design is crisp"
)


def summarise(
    run: RankResult, wall: float, stress: Mapping[int, ArmStress] | None = None
) -> dict[str, Any]:
    """Return the content of summary.json on the root, an empty dict elsewhere (collective).

    Args:
        run: the design, what came of it and how it was found.
        wall: seconds since the command began, s.
        stress: of every arm with a design, by its place in the chain, see `stress_report`.
    """
    scene, partition, trajectory = run.scene, run.partition, run.trajectory
    cost = _cost(run, wall)  # without what follows
    traits, comparison = _gather_traits(run), compared(run)
    stiffening = stiffening_of(run.arms)
    with together(partition.world):
        if trajectory is None:  # this is not the root
            return {}
        result = {
            "name": scene.name,
            **_figures(run.evaluation),
            **_machine(trajectory),
            "loop_start": loop_start(scene),
            "feed_forward": summary_of_feed_forward(trajectory, *comparison),
            "deflection_budget": budget_of(trajectory),
            "stress": _stress(scene, stress or {}),
            **_of_designs(run, trajectory, traits),
            **_of_responses(run),
            "simulation_error_estimate": run.evaluation.error,
            "integrator": {
                "method": f"Radau IIA, {len(trajectory.solution.nodes)} stages",
                "strategy": trajectory.solution.strategy.value,
                "steps": len(trajectory.solution.a),
            },
            "reduction": _reduction(scene, run.choice),
            "stiffening": None if stiffening is None else asdict(stiffening),
            "warnings": list(_all_warnings(run, trajectory, traits)),
            "iterations": run.iterations,
            "best_iteration": run.best_iteration,
            "converged": run.converged,
            "stop_code": run.stop_code.value,
            "stop_reason": run.stop_reason,
            "exact_from": run.exact_from,
            "kkt": run.kkt,
            "certificate": None if run.certificate is None else run.certificate.to_dict(),
            **({} if run.bars is None else {"bars": _bars(run)}),
            **cost,
            "units": _units(trajectory),
            "versions": versions(),
            "scene": scene.to_dict(),
        }
        return finite(result)


def figures(run: RankResult, wall: float) -> dict[str, Any]:
    """Return what a table of many simulations needs of summary.json; on one rank alone.

    Args:
        run: the design and what came of it.
        wall: seconds that it took.
    """
    return {
        "name": run.scene.name,
        **_figures(run.evaluation),
        "iterations": run.iterations,
        "stop_reason": run.stop_reason,
        "seconds": {"total": wall},
        "versions": versions(),
        "scene": run.scene.to_dict(),
    }


@dataclass(frozen=True)
class _Traits:
    """What is known of one design beside its motion."""

    # volume_fraction, grayness: of the physical densities
    volume_fraction: float
    grayness: float
    # cell_size, volume: of a cell the longest side, m; of all arms that have the design, m3
    cell_size: float
    volume: float
    notes: Sequence[str]  # of the mesh
    contacts: Contacts  # how the design cut at one half hangs together
    widths: Widths = (None, None)  # of member and gap of the design cut at one half
    # first frequency of the arm by itself, Hz, and by how much that of the reduced model exceeds
    # it, relative; None where it is not reduced
    frequency: float | None = None
    error: float | None = None


def _gather_traits(run: RankResult) -> dict[int, _Traits]:
    """Return the traits of every design, on the root (collective)."""
    partition, counts = run.partition, run.profile.counts
    run.profile.counts = replace(counts)  # nothing of the result depends on what follows
    with together(partition.world):
        mine = {k: _traits(run.scene, k, arm, run.x_phys[k]) for k, arm in run.arms.items()}
    run.profile.counts = counts
    traits = gather_arms(partition, mine)
    if partition.world.bcast(is_grey(run.scene, _grayness(traits)), root=0):
        return traits
    widths = _widths(run.scene, partition, run.arms, run.x_phys)
    return {k: replace(item, widths=widths.get(k, item.widths)) for k, item in traits.items()}


def _of_designs(
    run: RankResult, trajectory: Trajectory, traits: Mapping[int, _Traits]
) -> dict[str, Any]:
    """Return what the designs are like, and the frequencies of the arms, by the arm's name."""
    scene = run.scene
    by_arm = {
        arm.name: traits[owner]
        for arm, owner in zip(scene.arms, scene.owners, strict=True)
        if owner is not None
    }
    flexible = [arm.name for arm in scene.arms if arm.flexible]
    loaded = zip(flexible, run.evaluation.values_of("eigenfrequency"), strict=False)
    return {
        "grayness": _grayness(traits),
        "volume_fraction": {name: item.volume_fraction for name, item in by_arm.items()},
        "connected": max((trait.contacts.pieces for trait in traits.values()), default=0),
        "contacts": {
            name: {key: np.array(getattr(item.contacts, key)).tolist() for key in CONTACTS}
            for name, item in by_arm.items()
        },
        "minimum_member_measured": {name: _size(item.widths[0]) for name, item in by_arm.items()},
        "minimum_gap_measured": {name: _size(item.widths[1]) for name, item in by_arm.items()},
        "too_narrow": [asdict(item) for item in _too_narrow(run, traits)],
        "first_frequency": _first_frequencies(trajectory, by_arm),
        "first_frequency_error": {
            name: item.error for name, item in by_arm.items() if item.error is not None
        },
        "loaded_frequency": dict(loaded),
    }


def _grayness(traits: Mapping[int, _Traits]) -> float:
    """Return the grayness of all designs together."""
    if not traits:
        return 0.0
    every = traits.values()
    return float(np.average([t.grayness for t in every], weights=[t.volume for t in every]))


def _size(width: Width | None) -> float | None:
    return None if width is None else width.size


@dataclass(frozen=True)
class _Narrow:
    """A width that an optimised design misses."""

    arm: str  # its name
    what: str  # "member" or "gap"
    # width, asked: m
    width: float
    asked: float
    place: tuple[float, ...]  # (d,) where it is, m
    to: float  # accuracy of the width, m
    fixed: bool  # whether no design changes what is there

    @property
    def sentence(self) -> str:
        """E.g. "arm 'arm1': its thinnest member, at (0.2, 0.01) m, is 5.6 mm wide ...; raise"."""
        place = ", ".join(f"{x:.4g}" for x in self.place)
        kind = "thinnest member" if self.what == "member" else "narrowest gap"
        key = f"design.minimum_{self.what}"
        cure = f"raise design.sharpness, use finer cells or a larger {key}"
        if self.fixed:
            cure = "it lies in what stays solid or void (arms.passive, arms.regions): widen that"
        return (
            f"arm {self.arm!r}: its {kind}, at ({place}) m, is {1e3 * self.width:.3g} mm wide to "
            f"{1e3 * self.to:.2g} mm, below {key} = {1e3 * self.asked:.4g} mm; "
            f"{cure}"
        )


def _too_narrow(run: RankResult, traits: Mapping[int, _Traits]) -> list[_Narrow]:
    """Return every least width that the design cut at one half misses."""
    design = run.scene.design
    if not (run.iterations and design.controls_widths):
        return []
    return [
        _Narrow(run.scene.arms[k].name, what, width.size, asked, width.place, width.to, width.fixed)
        for k, trait in traits.items()
        for what, width, asked in zip(
            ("member", "gap"), trait.widths, design.least_widths, strict=True
        )
        if width is not None and width.size < asked * (1.0 - 1e-9)
    ]


def _first_frequencies(trajectory: Trajectory, by_arm: Mapping[str, _Traits]) -> dict[str, float]:
    """Return those of flexible arms by name, Hz; of a body from a file, what its modes tell."""
    frequencies = {}
    for arm, body in zip(trajectory.scene.arms, trajectory.mechanism.arms, strict=True):
        own = by_arm[arm.name].frequency if arm.name in by_arm else None
        value = body.first_frequency if own is None else own
        if np.isfinite(value):
            frequencies[arm.name] = value
    return frequencies


def _of_responses(run: RankResult) -> dict[str, Any]:
    """Return the constraints by name, and the figures of scenarios and of the crisp design."""
    scene = run.scene
    return {
        "constraints": summary_of(run.limits),
        "scenarios": [
            {"changes": list(scenario.changes), "weight": scenario.weight, **_figures(motion)}
            for scenario, motion in zip(scene.scenarios, run.evaluation.scenarios, strict=True)
        ],
        **({} if run.crisp is None else {"crisp": _figures(run.crisp)}),
    }


def _bars(run: RankResult) -> dict[str, Any]:
    """Return the figures of straight solid bars of the same mass, and what they make of limits."""
    assert run.bars is not None
    return {**_figures(run.bars), "constraints": summary_of(limits_of(run.scene, run.bars))}


def motion_warnings(run: Result, trajectory: Trajectory) -> Iterator[str]:
    """Yield a sentence on everything of a scene and its motion that puts the figures in doubt."""
    scene = run.scene
    yield from implausible(scene)
    yield from _large_deflections(scene, run.evaluation)
    yield from _too_few(scene, run.choice)
    yield from torsion_warnings(trajectory)
    if beyond := [limit.sentence for limit in joint_limits(trajectory) if not limit.met]:
        yield f"limits exceeded: {', '.join(beyond)}"
    yield from unjudged(scene)
    yield from _on_closures(trajectory)
    yield from filter(None, [forced_rest(scene)])


def _all_warnings(
    run: RankResult, trajectory: Trajectory, traits: Mapping[int, _Traits]
) -> Iterator[str]:
    grey = is_grey(run.scene, _grayness(traits))
    for trait in traits.values():
        yield from trait.notes
    yield from motion_warnings(run, trajectory)
    yield from _unstiffened(stiffening_of(run.arms))
    yield from lead_warnings(trajectory, grey)
    if not grey:
        yield from _contact_warnings(run, traits)
    for item in _too_narrow(run, traits):
        yield item.sentence


def _cost(run: RankResult, wall: float) -> dict[str, Any]:
    """Return seconds by phase, those of the slowest rank, counts, memory and number of ranks.

    On the root, an empty dict elsewhere (collective).
    """
    world = run.partition.world
    counts = (run.counts or run.profile.counts) if run.partition.is_root else Counts()
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    every = world.gather((dict(run.profile.seconds), counts, memory), root=0)
    if every is None:
        return {}
    seconds, counted, memories = zip(*every, strict=True)
    phases = dict.fromkeys(phase for own in seconds for phase in own)
    slowest = {phase: max(own.get(phase, 0.0) for own in seconds) for phase in phases}
    return {
        "seconds": {**slowest, "total": wall},
        "counts": asdict(sum(counted, Counts())),
        "peak_memory_mb": max(memories),
        "ranks": world.size,
    }


def _machine(trajectory: Trajectory) -> dict[str, Any]:
    """Return masses, drives and residual vibration; of machines control errors and reactions."""
    scene, bodies = trajectory.scene, trajectory.mechanism.arms
    peak, rms = trajectory.drives
    masses = {arm.name: body.mass for arm, body in zip(scene.arms, bodies, strict=True)}
    result = {
        "max_rotation": trajectory.max_rotation,
        "settling": trajectory.settling,
        "mass": masses,
        "designed_mass": float(sum(masses[arm.name] for arm in scene.arms if arm.flexible)),
        "drive_peak": by_drive(scene, peak),
        "drive_rms": by_drive(scene, rms),
    }
    limits: dict[str, dict[str, Any]] = {}
    for limit in joint_limits(trajectory):
        entry = asdict(limit)
        limits.setdefault(entry.pop("joint"), {})[entry.pop("quantity")] = entry
    if limits:
        result["joint_limits"] = limits
    if free := free_drives(scene):
        errors = by_drive(scene, np.abs(trajectory.q_r - trajectory.desired.q).max(axis=0))
        result["drive_error_peak"] = {name: errors[name] for name in free}
    if trajectory.closure_sizes:
        result["closure_peak"] = {
            name: {unit: float(size.max()) for unit, size in sizes.items()}
            for name, sizes in trajectory.closure_sizes.items()
        }
    return result


def _on_closures(trajectory: Trajectory) -> Iterator[str]:
    """Yield sentences on closures that hold rigid arms more often than needed."""
    if trajectory.loops is None:
        return
    problem = trajectory.problem
    if problem.num_redundant:
        _, first, last = problem.ends
        yield (
            f"closures: of {last - first} equations {problem.num_redundant} follow from the others "
            "for rigid arms; where no arm resists, the smallest forces are told"
        )
    if (left := misfit(trajectory.scene)) > 0.0:
        yield (
            f"closures: rigid arms leave {left:.3g} m open; closing it would add forces of "
            f"{problem.left_stress():.3g} N, which are left out"
        )


def _stress(scene: Scene, stress: Mapping[int, ArmStress]) -> dict[str, Any] | None:
    """Return the largest stress at element centres, and at Gauss points, too; of every arm."""
    if not stress:
        return None
    place, highest = max(stress.items(), key=lambda item: item[1].peak.value)
    at, other = max(stress.items(), key=lambda item: item[1].peak_at_points.value)
    return {
        **highest.peak.to_dict(scene.arms[place].name),
        "at_gauss_points": other.peak_at_points.to_dict(scene.arms[at].name),
        "by_arm": {scene.arms[k].name: each.peak.value for k, each in stress.items()},
    }


def _units(trajectory: Trajectory) -> dict[str, Any]:
    """Return the unit of every figure, and of every column of history.csv and trajectory.csv."""
    scene, unit = trajectory.scene, trajectory.scene.objective.response.unit
    units: dict[str, Any] = {"objective": unit, **UNITS["summary"]}
    units["certificate"] = {**UNITS["certificate"], "exact_objective": unit}
    units["drive_peak"] = units["drive_rms"] = drive_units(scene)
    if free := free_drives(scene):
        rigid = scene.rigid_units
        units["drive_error_peak"] = {name: rigid[name] for name in free}
    if scene.closures:
        parts = {closure.name: closure.parts(scene.dimension) for closure in scene.closures}
        units["closure_peak"] = {name: {u: u for _, u in own} for name, own in parts.items()}
    units["history.csv"] = {"objective": unit, **UNITS["history"], "multipliers": unit}
    units["trajectory.csv"] = trajectory_units(trajectory)
    return units


def _widths(
    scene: Scene, partition: Partition, arms: Mapping[int, Arm], x_phys: Mapping[int, np.ndarray]
) -> dict[int, Widths]:
    """Return the widths of member and gap of the designs cut at one half; on the root."""
    # Of solid arms where the scene asks for a width: voxels take seconds.
    mine: dict[int, dict[str, np.ndarray]] = {}
    with together(partition.world):
        for k, arm in arms.items():
            mesh = arm.mesh
            if mesh.dim == 3 and not scene.design.controls_widths:
                continue
            points = compat.cell_coordinates(mesh.mesh, mesh.num_cells)[:, :, : mesh.dim]
            table = {"corners": points, "solid": x_phys[k] > SOLID, "fixed": mesh.fixed}
            if scene.arms[k].extruded:  # the same over the thickness: the lowest layer tells
                table["corners"] = points[:, :4, :2]
                lowest = _lowest(mesh.comm, points[:, :4, 2], scene.arms[k].thickness)
                table = {name: values[lowest] for name, values in table.items()}
            mine[k] = table
    tables, asked = gather_tables(partition, mine), max(scene.design.least_widths)
    with together(partition.world):
        return {k: widths_of(**table, asked=asked) for k, table in tables.items()}


def _lowest(comm: MPI.Comm, z: np.ndarray, thickness: float) -> np.ndarray:
    """Return which cells' lower faces (n, 4), m, bound a box from below (collective)."""
    low = comm.allreduce(z.min(initial=np.inf), op=MPI.MIN)
    return z.max(axis=1, initial=-np.inf) <= low + 1e-9 * thickness


def _traits(scene: Scene, index: int, arm: Arm, x_phys: np.ndarray) -> _Traits:
    """Return what needs the design's own cells alone (collective on its ranks)."""
    traits = _Traits(
        arm.volume_fraction(x_phys),
        arm.grayness(x_phys),
        (scene.arms[index].cells and scene.arms[index].cell_size) or arm.mesh.cell_size,
        len(arm.places) * scene.arms[index].depth * arm.mesh.comm.allreduce(arm.mesh.area.sum()),
        arm.mesh.notes,
        arm.contacts(arm.kind.share(x_phys) > SOLID),
    )
    if arm.basis is None:
        return traits
    state = arm.state(x_phys)
    frequency = state.first_frequency
    error = max(0.0, state.body.first_frequency / frequency - 1.0)
    return replace(traits, frequency=frequency, error=error)


def is_grey(scene: Scene, grayness: float) -> bool:
    """Return whether a design is no structure of solid and void, nor meant to be one."""
    return not scene.design.projection and grayness > GREY


def _contact_warnings(run: RankResult, traits: Mapping[int, _Traits]) -> Iterator[str]:
    """Yield a sentence on every arm with contacts, and one where its crisp design falls apart."""
    scene = run.scene
    rated = run.iterations > 0 and bool(scene.design.projection)
    for k, trait in traits.items():
        contacts, arm = trait.contacts, scene.arms[k]
        if not contacts.count:
            continue
        place = ", ".join(f"{x:.4g}" for x in contacts.places[0])
        text = (
            f"cut at a density of 0.5, cells of arm {arm.name!r} meet in {contacts.corners} "
            f"corners and {contacts.edges} edges alone (pieces: {contacts.pieces}), the worst at "
            f"({place}) m: such contacts are stiff in the model, and no joints in a workshop"
        )
        if rated and run.crisp is not None:
            text += f"; crisp leaves them out, and {100.0 * contacts.left_out:.2g} % of the solid"
            if contacts.remaining:
                text += f", but for {contacts.remaining} without which the arm is cut in two"
        yield f"{text}; {_against_contacts(scene, k, trait.cell_size)}"
    if rated and run.crisp is None:
        hanging = any(
            trait.contacts.count and not trait.contacts.joins for trait in traits.values()
        )
        yield NO_JOINTS if hanging else FALLS_APART


def _against_contacts(scene: Scene, index: int, size: float) -> str:
    """Return what keeps contacts out of the next design of an arm."""
    design, radius = scene.design, scene.filter_radius(index)
    least = FILTER_CELLS * size
    result = [] if design.is_robust else ['design.projection = "robust"']
    if result or design.erosion < EROSION:
        result.append(f"design.erosion = {EROSION:g}")
    if radius < least * (1.0 - 1e-9) or not result:
        wider = max(least, radius + 0.5 * size)
        key = "a larger design.minimum_member"
        result.append(key if design.controls_widths else f"design.filter_radius = {wider:.4g}")
    return f"set {', '.join(result)}, or use finer cells"


def _large_deflections(scene: Scene, evaluation: Evaluation) -> Iterator[str]:
    """Yield a sentence on every arm whose deflection is not small, in the scene or a scenario."""
    changes = ["", *(f" with {', '.join(item.changes)}" for item in scene.scenarios)]
    for where, motion in zip(changes, (evaluation, *evaluation.scenarios), strict=True):
        for arm, u, turn in zip(scene.arms, motion.deflections, motion.turns, strict=False):
            if u > SMALL or turn > SMALL_TURN:
                yield (
                    f"arm {arm.name!r} deflects by {100.0 * u:.3g} % of its length and its end "
                    f"turns by {np.degrees(turn):.3g} degrees{where}: beyond {100.0 * SMALL:g} % "
                    f"or {np.degrees(SMALL_TURN):.0f} degrees the model of small deflections is "
                    "inaccurate; stiffen the arm or slow the motion"
                )


def _reduction(scene: Scene, choice: OrderSelection | None) -> dict[str, Any]:
    """Return the number of coordinates and, where it was chosen, by which errors."""
    # For a given number there is no estimate: it would cost a simulation with more coordinates.
    if choice is None:
        return {"coordinates": scene.reduction.coordinates, "error_estimate": None, "tried": []}
    rows = [
        {"coordinates": count, "error_estimate": error}
        for count, error in ((choice.coordinates, choice.error), *choice.tried)
    ]
    return {**rows[0], "tried": rows[1:]}


def _too_few(scene: Scene, choice: OrderSelection | None) -> Iterator[str]:
    """Yield a sentence where the final design would need more coordinates than were chosen."""
    if choice is not None and choice.error > scene.reduction.tolerance:
        yield (
            f"with the {choice.coordinates} coordinates that were chosen for the initial design "
            f"the final one has an estimated error of {choice.error:.2g}, above "
            f"{scene.reduction.tolerance:g}; optimise with reduction.coordinates = "
            f"{2 * choice.coordinates}, or a smaller error"
        )


def _unstiffened(stiffening: Stiffening | None) -> Iterator[str]:
    """Yield a sentence where geometric stiffening is left out and matters."""
    if stiffening is None or stiffening.on:
        return
    if (stiffening.estimate or 0.0) >= STIFFNESS_CHANGE_LIMIT:
        yield (
            f"the loads of the motion change the stiffness of an arm by {stiffening.estimate:.2g} "
            "of it, which simulation.stiffening = false leaves out; set it to true"
        )


def _figures(evaluation: Motion) -> dict[str, float]:
    return {
        "objective": evaluation.objective,
        "compliance": evaluation.compliance,
        "max_deviation": evaluation.max_deviation,
        "max_deviation_time": evaluation.max_deviation_time,
    }


def write_summary(folder: Path, summary: Mapping[str, Any]) -> None:
    """Write summary.json."""
    write_text(folder / "summary.json", json.dumps(summary, indent=2, sort_keys=False) + "\n")


def versions() -> dict[str, str]:
    """Return the versions of everything a result depends on."""
    import scipy
    from petsc4py import PETSc
    from slepc4py import SLEPc

    return {
        "dolfinopt": __version__,
        "dolfinx": compat.dolfinx_version(),
        "petsc": ".".join(map(str, PETSc.Sys.getVersion())),
        "slepc": ".".join(map(str, SLEPc.Sys.getVersion())),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "python": platform.python_version(),
    }


# -- table of the deflection's budget --------------------------------------------------------


def budget_of(trajectory: Trajectory) -> dict[str, Any] | None:
    """Return the budget as summary.json has it; None without a deviation.

    With feed-forward the joints take the arms' part away: there is nothing to share out.
    """
    if trajectory.feed_forward is not None:
        return None
    result = deflection_budget(trajectory)
    return None if result is None else {**asdict(result), "shares": result.shares}


def write_budget(folder: Path, budget: Mapping[str, Any] | None) -> None:
    """Write the parts of a budget as a table (CSV), if there is one."""
    if budget is None:
        return
    rows = [
        f"{item['kind']},{item['name']},{item['deflection']:.10g},{item['share']:.10g}\n"
        for item in budget["parts"]
    ]
    write_text(folder / "budget.csv", "".join(["kind,part,deflection [m],share [-]\n", *rows]))
