"""A scene as an object to work with in scripts and notebooks.

    from dolfinopt import Model

    model = Model("demos/two_arm.toml", "payload.mass=4", "optimizer.max_iterations=20")
    before = model.simulate()            # the initial design
    result = model.optimize()
    print(f"{1e3 * before.max_deviation:.1f} mm before, {1e3 * result.max_deviation:.1f} mm after")
    result.plot().savefig("design.png")
    table = model.study("payload.mass=2:6:3", designs=[result])  # a pandas DataFrame

Everything runs alike under `mpirun -n N python script.py`: all ranks call the same methods with the
same arguments (they are collective). Figures of one number are then known on all ranks; arrays,
tables of the history and pictures belong to rank 0, other ranks get empty ones, or None.
"""

from __future__ import annotations

import io
import os
import time
from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from functools import partial
from html import escape
from math import nan
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple, get_args

import numpy as np
from mpi4py import MPI

from dolfinopt.arms.arm import Arm, build_arms, uniform_design
from dolfinopt.disk import write_arrays
from dolfinopt.errors import InputError
from dolfinopt.loading import load_scene
from dolfinopt.mesh.budget import check_budget
from dolfinopt.optimization.result import RankResult, Result
from dolfinopt.optimization.state import HistoryRow
from dolfinopt.output.design import (
    ArmView,
    Designed,
    canonical_order,
    designed,
    gather_views,
    physical,
    read_design,
    under_law_of,
)
from dolfinopt.output.folders import check_unused, working_alone
from dolfinopt.parallel import Partition, gather_cells, on_root, partition_arms, together
from dolfinopt.profiling import Profile
from dolfinopt.progress import with_unit
from dolfinopt.responses.constraints import limits_of
from dolfinopt.responses.evaluation import (
    analysis_of,
    constraint_gradients,
    evaluate,
    gradient,
    objective_gradient,
)
from dolfinopt.responses.order_selection import choose_coordinates
from dolfinopt.responses.response import needs
from dolfinopt.responses.stress_report import stress_report
from dolfinopt.scene.law_variables import LAW, law_values, with_law
from dolfinopt.scene.load import Scene
from dolfinopt.scene.tables.base import toml_value
from dolfinopt.scene.tables.objective import GradientKind

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from dolfinopt.dynamics.budget import Budget
    from dolfinopt.dynamics.state_space import StateSpace
    from dolfinopt.part.check import Check
    from dolfinopt.part.part import Curves, Part
    from dolfinopt.study.studies import Preset

Densities = Mapping[str, np.ndarray]


class Responses(NamedTuple):
    """Objective and limits of a design, and their gradients by the physical densities.

    Attributes:
        values: by name: "objective" in the scene's unit; every limit, e.g. "deviation" or
            "first_frequency_arm2", relative: kept where it is at most 0.
        gradients: of the values by the densities (n_cells,) of every arm, as a design is given;
            with patterns, of the arms whose design others repeat; empty but on rank 0. Limits of
            extremes are differentiated by their smooth value, its ratio to the extreme held
            (Le, Norato, Bruns, Ha & Tortorelli 2010, doi:10.1007/s00158-009-0440-y).
    """

    values: dict[str, float]
    gradients: dict[str, dict[str, np.ndarray]]


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class SimulationResult(Result):
    """One design, simulated; draws itself where it is the last expression of a notebook's cell.

    Attributes:
        design: physical densities (n_cells,) of every arm with a design of its own, by its name;
            cells in the order of `Model.centroids`. On rank 0, empty elsewhere.
        views: cells, densities and modes of all arms, for pictures; empty but on rank 0.
        filtered: what an optimised, projected design was projected from, as `design`; else empty.
        stress_at_points: largest von Mises stress at the elements' Gauss points along the motion,
            Pa, where `Model.simulate` was asked for it; else, and on other ranks than 0, nan.
    """

    design: dict[str, np.ndarray]
    views: list[ArmView]
    filtered: dict[str, np.ndarray] = field(default_factory=dict)
    stress_at_points: float = nan

    @property
    def objective(self) -> float:
        """Value of the scene's objective, in `unit`."""
        return self.evaluation.objective

    @property
    def unit(self) -> str:
        """Unit of the objective."""
        return self.scene.objective.response.unit

    @property
    def compliance(self) -> float:
        """Sum of the load cases' compliance, N m."""
        return self.evaluation.compliance

    @property
    def max_deviation(self) -> float:
        """Largest distance of the end-effector from its rigid path, m."""
        return self.evaluation.max_deviation

    @property
    def max_stress(self) -> float:
        """Largest von Mises stress along the motion at an element's centre, Pa.

        nan where it was not asked for, see `Model.simulate`, and on other ranks than 0.
        """
        return max((float(v.stress.max()) for v in self.views if v.stress is not None), default=nan)

    @property
    def budget(self) -> Budget | None:
        """What links, bearings, gears and control contribute to the largest deviation.

        None where there is none, and but on rank 0.
        """
        from dolfinopt.dynamics.budget import deflection_budget

        return None if self.trajectory is None else deflection_budget(self.trajectory)

    def to_frame(self) -> DataFrame | None:
        """Return deviation (m) and compliance of every arm (N m) every `simulation.sample`.

        The index is the time, s. Rank 0; None elsewhere.
        """
        if self.trajectory is None:
            return None
        from pandas import DataFrame, Index

        motion = self.trajectory.sampled
        columns = {f"deviation_{axis}": d for axis, d in zip("xyz", motion.deviation.T)}
        columns["deviation"] = motion.distance
        arms = zip(self.scene.arms, motion.compliance.T, strict=True)
        columns |= {f"compliance_{arm.name}": values for arm, values in arms}
        return DataFrame(columns, index=Index(motion.t, name="t"))

    def plot(self) -> Figure | None:
        """Return the figure of the deviation over time; None but on rank 0, as all figures."""
        return self.plot_deviation()

    def plot_deviation(self) -> Figure | None:
        """Return the figure of the end-effector's distance from its rigid path over time."""
        from dolfinopt.plots.curves import deviation_figure

        return (
            None
            if self.trajectory is None
            else deviation_figure(self.trajectory, self.initial_deviation)
        )

    def plot_design(self) -> Figure | None:
        """Return the figure of the arms' densities; of solids, of what is denser than 0.5."""
        from dolfinopt.plots.design import design_figure

        arms = designed(self.views)
        return design_figure(arms, self.scene.name) if arms else None

    def plot_stress(self) -> Figure | None:
        """Return the figure of every cell's largest stress; None if not asked for."""
        from dolfinopt.plots.design import stress_figure

        known = [view for view in self.views if view.stress is not None]
        return stress_figure(known, self.scene.name) if known else None

    def plot_machine(self) -> Figure | None:
        """Return the figure of the machine in a few poses along its path."""
        from dolfinopt.plots.machine import machine_figure

        if self.trajectory is None:
            return None
        return machine_figure(self.views, self.trajectory, self.scene.name)

    def plot_drives(self) -> Figure | None:
        """Return the figure of the drives' errors and forces, and of what holds a closed loop."""
        from dolfinopt.plots.curves import drives_figure

        return None if self.trajectory is None else drives_figure(self.trajectory)

    def state_space(self, t: float) -> StateSpace | None:
        """Return the machine linearised about its motion at an instant t, s; None but on rank 0.

        Raises:
            InputError: the instant is not within the motion.
        """
        from dolfinopt.dynamics.build import state_space

        return None if self.trajectory is None else state_space(self.trajectory, t)

    def __repr__(self) -> str:
        objective = with_unit(f"{self.objective:.4g}", self.unit)
        return (
            f"{type(self).__name__}({self.scene.name!r}, objective={objective}, "
            f"max_deviation={1e3 * self.max_deviation:.4g} mm)"
        )

    @property
    def mass(self) -> dict[str, float]:
        """Mass of every arm, kg, by its name; empty but on rank 0."""
        if self.trajectory is None:
            return {}
        bodies = self.trajectory.mechanism.bodies
        return {a.name: float(b.mass) for a, b in zip(self.scene.arms, bodies, strict=True)}

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence on everything of the scene and the motion that puts the figures in doubt.

        Those on the shape of the design, which take longer, are in the summary that `save` writes.
        Empty but on rank 0.
        """
        from dolfinopt.output.summary import motion_warnings

        return () if self.trajectory is None else tuple(motion_warnings(self, self.trajectory))

    def save(self, folder: str | Path, *, overwrite: bool = False) -> None:
        """Write the files of `dolfinopt simulate` or `optimize`, but for pictures (collective).

        Args:
            folder: where; made if need be.
            overwrite: replace the results that the folder holds.

        Raises:
            InputError: the folder holds results, and `overwrite` is not set.
        """
        Model(self.scene).save(self, folder, overwrite=overwrite)

    def _repr_png_(self) -> bytes | None:
        """Return the picture that notebooks show."""
        if (figure := self.plot()) is None:
            return None
        stream = io.BytesIO()
        figure.savefig(stream, format="png")
        return stream.getvalue()

    def _repr_html_(self) -> str | None:
        """Return picture and figures as notebooks show them; None but on rank 0."""
        if (picture := self._repr_png_()) is None:
            return None
        rows = {
            "objective": with_unit(f"{self.objective:.4g}", self.unit),
            "largest deviation": f"{1e3 * self.max_deviation:.4g} mm",
            "mass": f"{sum(self.mass.values()):.4g} kg",
            **{limit.words: limit.usage.removeprefix(limit.words) for limit in self.limits},
        }
        cells = "".join(
            f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>"
            for name, value in rows.items()
        )
        data = b64encode(picture).decode()
        return f'<img src="data:image/png;base64,{data}"/><table>{cells}</table>'


class OptimizationResult(SimulationResult):
    """An optimised design, and how it came about."""

    @property
    def history(self) -> DataFrame | None:
        """The columns of history.csv by iteration (the index); None but on rank 0."""
        if not self.rows:
            return None
        from pandas import DataFrame

        return DataFrame([row.figures for row in self.rows]).set_index("iteration")

    def plot(self) -> Figure | None:
        """Return the figure of the optimised arms; None but on rank 0, as all figures."""
        return self.plot_design()

    def plot_history(self) -> Figure | None:
        """Return the figure of the objective and other figures over the iterations."""
        from dolfinopt.plots.curves import history_figure

        return history_figure(self) if self.rows else None


Design = Densities | SimulationResult | str | Path | None


class Model:
    """A scene to simulate, differentiate, optimise and study; see the example in this module.

    Designs are physical densities in [0, 1], a mapping from the name of every arm with a design of
    its own to its (n_cells,) values in the order of `centroids`, as design.npz holds them. Methods
    take them, a result, or the path of a design.npz; without one, the scene's initial design.

    Args:
        scene: path of a scene file, its content as nested dictionaries, or a `Scene`.
        *overrides: "key.path=value", as given to --set, or mappings {"key.path": value}.
        comm: the ranks that work on it; by default all.

    Raises:
        InputError: the scene is not valid; on all ranks, as all errors.
    """

    def __init__(
        self,
        scene: str | os.PathLike[str] | Mapping[str, Any] | Scene,
        *overrides: str | Mapping[str, Any],
        comm: MPI.Comm | None = None,
    ):
        self._world = MPI.COMM_WORLD if comm is None else comm
        self.scene: Scene = on_root(self._world, _load, scene, overrides)
        check_budget(self._world, self.scene)
        self._profile = Profile()
        self._built: tuple[Partition, dict[int, Arm]] | None = None
        self._order: dict[int, np.ndarray] = {}
        self._centroids: dict[str, np.ndarray] = {}

    def __repr__(self) -> str:
        arms = ", ".join(arm.name for arm in self.scene.arms)
        return f"Model({self.scene.name!r}, arms: {arms})"

    def __reduce__(self) -> tuple[Callable[[Scene, bool], Model], tuple[Scene, bool]]:
        """Pickle the scene: arms are built again, on all ranks or on the one that reads it."""
        return _model_of, (self.scene, self._world.size == 1)

    @property
    def centroids(self) -> dict[str, np.ndarray]:
        """Centroids (n_cells, 2 or 3) of every designed arm's cells, m; empty but on rank 0."""
        self._arms()
        return self._centroids

    def uniform(self, density: float) -> dict[str, np.ndarray]:
        """Return the design of one density everywhere, solid where the scene says so.

        Args:
            density: of the design variables, in [0, 1].

        Raises:
            InputError: it is no such number.
        """
        if not 0.0 <= density <= 1.0:
            raise InputError(f"density {density}: expected a number >= 0 and <= 1")
        return self._gathered(self._uniform(density))

    def simulate(self, x: Design = None, *, stress: bool = False) -> SimulationResult:
        """Simulate a design.

        Args:
            x: the design, see the class; None: the initial one.
            stress: whether the stress of all cells is to be known, too.

        Raises:
            InputError: it does not fit the scene's arms.
            ConvergenceError: the motion could not be simulated; the message says what to try.
        """
        place = self._prepared(x)
        scene, partition, arms, x_phys = place
        choice = choose_coordinates(*place, self._profile)
        evaluation, trajectory = evaluate(*place, self._profile)
        result = stress_report(partition, arms, trajectory, self._profile) if stress else None
        views = gather_views(*place, result)
        points = [item.peak_at_points.value for item in (result or {}).values()]
        return SimulationResult(
            scene=scene,
            evaluation=evaluation,
            trajectory=trajectory,
            limits=limits_of(scene, evaluation),
            choice=choice,
            design=self._gathered(x_phys),
            views=views,
            stress_at_points=max(points, default=nan),
        )

    def gradient(self, x: Design = None, kind: str | None = None) -> dict[str, np.ndarray]:
        """Return the objective's gradient by the physical densities, as a design is given.

        Args:
            x: the design, see the class; None: the initial one.
            kind: "esl" freezes the equivalent static loads, "exact" follows the whole dynamics;
                None: the scene's objective.gradient.

        Raises:
            InputError, ConvergenceError: as `simulate` does.
        """
        if kind not in (None, *get_args(GradientKind)):
            raise InputError(f"kind {kind!r}: expected one of {', '.join(get_args(GradientKind))}")
        self.scene.check_designed()
        scene, partition, arms, x_phys = self._prepared(x)
        if kind is not None:
            objective = scene.objective.unchecked_copy({"gradient": kind})
            scene = scene.unchecked_copy({"objective": objective})
        if needs(scene, "motion"):
            choose_coordinates(scene, partition, arms, x_phys, self._profile)
        _, trajectory = evaluate(scene, partition, arms, x_phys, self._profile, simulated=False)
        zero = {k: np.zeros_like(x_phys[k]) for k in arms}
        result = gradient(scene, partition, arms, trajectory, self._profile)
        return self._gathered(zero | result)

    def evaluate(self, x: Design = None) -> Responses:
        """Return objective and limits of a design with their gradients, for a loop of one's own.

        Args:
            x: the design, see the class; None: the initial one.

        Raises:
            InputError, ConvergenceError: as `simulate` does.
        """
        self.scene.check_designed()
        scene, partition, arms, x_phys = place = self._prepared(x)
        if needs(scene, "motion"):
            choose_coordinates(*place, self._profile)
        evaluation, trajectory = evaluate(*place, self._profile, simulated=False)
        analysis = analysis_of(scene, partition, arms, trajectory, self._profile)
        rows = constraint_gradients(analysis, evaluation.responses)
        by_cells = [objective_gradient(analysis), *rows]
        zero = {k: np.zeros_like(x_phys[k]) for k in arms}
        names = ["objective", *(limit.name for limit in limits_of(scene, evaluation))]
        values = [evaluation.objective, *evaluation.constraints]
        return Responses(
            dict(zip(names, values, strict=True)),
            {
                name: self._gathered(zero | dict(cell))
                for name, cell in zip(names, by_cells, strict=True)
            },
        )

    def state_space(self, t: float, x: Design = None, *, below: float | None = None) -> StateSpace:
        """Return the machine linearised about its motion at an instant.

        Args:
            t: the instant, s.
            x: the design, see the class; None: the initial one.
            below: frequency below which the poles are to hold 1 %, Hz: the arms take as many
                coordinates as that needs. None: those of the scene; `StateSpace.accurate_below`
                tells up to where they do.

        Raises:
            InputError: the instant is not within the motion, or as `simulate` does.
            ConvergenceError: no number of coordinates does; or as `simulate` does.
        """
        from dolfinopt.responses.linearised_machine import linearised_machine

        place = self._prepared(x)
        choose_coordinates(*place, self._profile)
        return linearised_machine(*place, t, self._profile, below=below)

    def optimize(
        self,
        folder: str | Path | None = None,
        *,
        resume: bool = False,
        overwrite: bool = False,
        x0: Densities | SimulationResult | None = None,
        callback: Callable[[HistoryRow], None] | None = None,
    ) -> OptimizationResult:
        """Optimise the scene's arms.

        Args:
            folder: for the files of `dolfinopt optimize` but for pictures: history.csv and the
                checkpoint while it goes on, the others in the end; None: nothing is written.
            resume: go on from the folder's checkpoint.
            overwrite: replace the results that the folder holds.
            x0: design variables to begin with, before filter and projection, or a result, whose
                densities they are; None: the scene's initial design.
            callback: called on rank 0 with every row of the history.

        Raises:
            InputError: there is no fitting checkpoint to go on from; the folder holds results, and
                neither `resume` nor `overwrite` is set; another run works there.
            ConvergenceError: a simulation failed.
        """
        from dolfinopt.output.run_folder import optimize, views_of, write_result

        begun, place = time.perf_counter(), None if folder is None else Path(folder)
        partition, arms = self._arms()
        first = None if x0 is None else self._prepared(x0).x_phys
        built = partition, {k: arm.fresh() for k, arm in arms.items()}
        result = optimize(
            self.scene,
            place,
            resume=resume,
            overwrite=overwrite,
            world=self._world,
            report=callback,
            built=built,
            x0=first,
        )
        if place is not None:
            write_result(place, result, time.perf_counter() - begun)
        return OptimizationResult(
            **_fields(result),
            design=self._gathered(result.x_phys, result.partition),
            views=views_of(result)[0],
            filtered=self._gathered(result.x_filtered or {}, result.partition),
        )

    def save(
        self, result: SimulationResult, folder: str | Path, *, overwrite: bool = False
    ) -> None:
        """Write a result of this scene, see `SimulationResult.save` (collective)."""
        from dolfinopt.output.run_folder import write_result  # with the optimiser

        begun, place = time.perf_counter(), Path(folder)
        check = None if overwrite else partial(check_unused, place)
        _, partition, arms, x_phys = self._prepared(result)
        filtered = self._prepared(result.filtered).x_phys if result.filtered else None
        with together(self._world):
            for k, arm in arms.items():
                arm.state(x_phys[k])
        run = RankResult(
            **_fields(result),
            partition=partition,
            arms=arms,
            x_phys=x_phys,
            x_filtered=filtered,
            profile=self._profile,
        )
        with working_alone(self._world, place, check):
            write_result(place, run, time.perf_counter() - begun)

    def check_parts(
        self,
        x: Densities | SimulationResult,
        *,
        tool_radius: float | None = None,
        tolerance: float | None = None,
    ) -> Check | None:
        """Simulate the machine with the parts of a design, beside its densities.

        Args:
            x, tool_radius, tolerance: as for `make_parts`.

        Returns:
            With `table()`, a data frame; None but on rank 0.

        Raises:
            InputError: no part can be made of the design.
            ConvergenceError: the motion of the densities or of the parts cannot be simulated.
        """
        from dolfinopt.part.check import check_parts
        from dolfinopt.part.part import make_parts, mesh_parts

        with self._folder(None) as place:
            self._design_file(x, place / "design.npz")
            parts = make_parts(self.scene, place, self._curves(tool_radius, tolerance), self._world)
            with together(self._world):
                if self._world.rank == 0:
                    return check_parts(self.scene, place, parts, mesh_parts(parts))
        return None

    def make_parts(
        self,
        x: Densities | SimulationResult,
        folder: str | Path | None = None,
        *,
        tool_radius: float | None = None,
        tolerance: float | None = None,
        optimize: bool | None = None,
    ) -> dict[str, Part]:
        """Make parts for the workshop of a design, as `dolfinopt part` does.

        Args:
            x: a result or its design.
            folder: for the files of `dolfinopt part`, but for the picture; None: none are written.
            tool_radius: least of concave corners, m; None: the scene's, or 3 mm. Like the next, of
                solids for those alone whose design is the same over the thickness.
            tolerance: how far sides may lie from the densities' outline, m; None: the scene's, or
                a cell.
            optimize: whether to optimise the parts' shape; None: as the scene's [part] says.

        Returns:
            The parts by the names of the arms with a design of their own; empty but on rank 0.

        Raises:
            InputError: no part can be made of the design, or the folder holds files already.
        """
        from dolfinopt.output.folders import check_sources, check_unused, prepare_folder
        from dolfinopt.part.folder import file_names, write_parts
        from dolfinopt.part.optimize import optimize_parts
        from dolfinopt.part.part import make_parts, mesh_parts

        self.scene.check_designed()
        out = None if folder is None else Path(folder)
        if out is not None:
            on_root(self._world, check_sources, out, file_names(self.scene), self.scene)
            on_root(self._world, check_unused, out, file_names(self.scene))
        with self._folder(None) as place:
            self._design_file(x, place / "design.npz")
            curves = self._curves(tool_radius, tolerance)
            result = make_parts(self.scene, place, curves, self._world)
        asked = self.scene.part
        with together(self._world):
            if self._world.rank == 0:
                if asked.optimize if optimize is None else optimize:
                    given = self.scene, result, asked.iterations, lambda _: None, asked.starts
                    result = optimize_parts(*given).best.parts
                if out is not None:
                    prepare_folder(out)
                    meshes = mesh_parts(result, coarse=False).fine
                    write_parts(out, self.scene, result, meshes)
        return {self.scene.arms[k].name: part for k, part in result.items()}

    def _curves(self, tool_radius: float | None, tolerance: float | None) -> Curves:
        """Return what is asked of the parts' curves, by the scene where nothing else is."""
        from dolfinopt.part.part import Curves

        asked = self.scene.part
        tool = asked.tool_radius if tool_radius is None else tool_radius
        return Curves(tool, asked.tolerance if tolerance is None else tolerance)

    def study(
        self,
        *vary: str,
        preset: Preset | None = None,
        designs: Sequence[Densities | SimulationResult | str | Path] = (),
        reoptimize: bool = False,
        folder: str | Path | None = None,
        shown: bool = False,
    ) -> DataFrame:
        """Simulate designs for a range of scene values; return the table, on all ranks.

        Args:
            *vary: "key.path=start:stop:count" or "key.path=a,b,c"; two make a grid.
            preset: "payload", "flattening" or "coordinates" for their usual ranges; "objective" or
                "reduction" to compare all of them.
            designs: to simulate, in place of the initial and the optimised one.
            reoptimize: optimise a design for every value, too.
            folder: where all cases are kept, so that a study that grows takes them from there;
                None: nowhere.
            shown: draw the progress.

        Raises:
            InputError: something asked for is not possible.
        """
        from dolfinopt.study.cases import Runner  # with pandas: a third of the import's time
        from dolfinopt.study.studies import study

        with self._folder(folder) as place:
            paths = [
                self._design_file(design, place / f"design{k}.npz")
                for k, design in enumerate(designs, 1)
            ]
            runner = Runner(place, self._world, shown)
            steps = study(self.scene, preset, vary, paths, reoptimize=reoptimize)
            frame: DataFrame = runner.follow(steps).tables[0].frame
        return frame

    # -- designs over the ranks ----------------------------------------------------------------

    def _arms(self) -> tuple[Partition, dict[int, Arm]]:
        """Return which ranks do which arm, and this rank's, meshed at first use (collective)."""
        if self._built is None:
            plane = self.scene.dimension == 2
            partition = partition_arms(self._world, self.scene.cell_counts, undivided=plane)
            arms = build_arms(self.scene, partition, self._profile)
            centroids = gather_cells(partition, {k: arm.mesh.centroid for k, arm in arms.items()})
            self._order = {k: canonical_order(points) for k, points in centroids.items()}
            names = self.scene.arms
            self._centroids = {names[k].name: centroids[k][o] for k, o in self._order.items()}
            self._built = partition, arms
        return self._built

    def _uniform(self, density: float | None = None) -> dict[int, np.ndarray]:
        partition, arms = self._arms()
        return uniform_design(self.scene, partition, arms, density)

    def _prepared(self, x: Design) -> Designed:
        """Return the scene under a design's law, and the arms, which forget earlier designs."""
        # A search for modes that set out from another design's would end in other last digits.
        partition, arms = self._arms()
        for arm in arms.values():
            arm.forget()
        return Designed(self._under_law(x), partition, arms, self._densities(x))

    def _densities(self, x: Design) -> dict[int, np.ndarray]:
        """Return the densities of this rank's cells."""
        partition, arms = self._arms()
        if x is None:
            return self._uniform()
        if isinstance(x, SimulationResult):
            x = x.design
        if isinstance(x, (str, os.PathLike)):
            return read_design(Path(x), partition, arms)
        checked = on_root(self._world, self._checked, x)
        sizes = {k: partition.comm.allgather(arm.mesh.num_cells) for k, arm in arms.items()}
        parts = {k: np.cumsum([0, *size])[partition.comm.rank :] for k, size in sizes.items()}
        return {k: checked[k][part[0] : part[1]] for k, part in parts.items()}

    def _under_law(self, x: Design) -> Scene:
        """Return the scene, with the law of a design that has one."""
        if isinstance(x, SimulationResult):
            return with_law(self.scene, law_values(x.scene))
        path = Path(x) if isinstance(x, (str, os.PathLike)) else None
        return on_root(self._world, under_law_of, self.scene, path)

    def _checked(self, x: Densities) -> dict[int, np.ndarray]:
        """Return a user's densities in the order of the ranks' cells (root only)."""
        names = [self.scene.arms[k].name for k in self._order]
        if not isinstance(x, Mapping) or sorted(x) != sorted(names):
            result = ", ".join(map(str, x)) if isinstance(x, Mapping) else type(x).__name__
            raise InputError(f"design: expected densities of {', '.join(names)}, found {result}")
        checked = {}
        for (k, order), name in zip(self._order.items(), names, strict=True):
            values = np.asarray(x[name])
            if values.shape != order.shape:
                raise InputError(
                    f"design: arm {name!r}: expected densities of shape {order.shape}, "
                    f"found {values.shape}"
                )
            values = physical(f"design: density of arm {name!r}", values)
            checked[k] = np.empty_like(values)
            checked[k][order] = values
        return checked

    def _gathered(
        self, cells: Mapping[int, np.ndarray], partition: Partition | None = None
    ) -> dict[str, np.ndarray]:
        """Return whole arrays by the arms' names on the root, empty elsewhere (collective).

        Derivatives by the variables of the motion's law are called "motion".
        """
        of_arms = {k: cell for k, cell in cells.items() if k != LAW}
        gathered = gather_cells(partition or self._arms()[0], of_arms)
        result = {self.scene.arms[k].name: item[self._order[k]] for k, item in gathered.items()}
        return result | {"motion": cells[LAW]} if gathered and LAW in cells else result

    @contextmanager
    def _folder(self, folder: str | Path | None) -> Iterator[Path]:
        """Hand out a folder, or one that is removed in the end (collective)."""
        if folder is not None:
            yield Path(folder)
            return
        held: list[TemporaryDirectory[str]] = []

        def make() -> Path:
            held.append(TemporaryDirectory(prefix="dolfinopt-"))
            return Path(held[0].name)

        try:
            yield on_root(self._world, make)
            self._world.barrier()
        finally:
            for item in held:
                item.cleanup()

    def _design_file(self, x: Densities | SimulationResult | str | Path, path: Path) -> Path:
        """Return the path of a file with the design, this one if it is in none yet (collective)."""
        if isinstance(x, (str, os.PathLike)):
            return Path(x)
        self._arms()

        def write() -> Path:
            values = x.design if isinstance(x, SimulationResult) else x
            self._checked(values)
            path.parent.mkdir(parents=True, exist_ok=True)
            arrays = {f"{name}/density": np.asarray(value) for name, value in values.items()}
            arrays |= {f"{name}/centroid": centroid for name, centroid in self._centroids.items()}
            if isinstance(x, SimulationResult):
                arrays |= {f"{name}/filtered": item for name, item in x.filtered.items()}
            write_arrays(path, arrays)
            return path

        return on_root(self._world, write)


def _load(
    scene: str | os.PathLike[str] | Mapping[str, Any] | Scene,
    changes: Sequence[str | Mapping[str, Any]],
) -> Scene:
    """Read and check a scene (root only)."""
    overrides = [text for change in changes for text in _texts(change)]
    if isinstance(scene, Scene) and not overrides:
        return scene
    return load_scene(scene, overrides)


def _model_of(scene: Scene, alone: bool) -> Model:
    """Return the model of a scene that was pickled."""
    return Model(scene, comm=MPI.COMM_SELF if alone else None)


def _texts(change: str | Mapping[str, Any]) -> list[str]:
    """Return changes of a scene as they are given to --set."""
    if isinstance(change, str):
        return [change]
    return [f"{key}={toml_value(value)}" for key, value in change.items()]


def _fields(result: Result) -> dict[str, Any]:
    """Return the fields that every result has, by their names."""
    return {field.name: getattr(result, field.name) for field in fields(Result)}
