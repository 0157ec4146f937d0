"""Tables of forces and motions: what a step of the integrator sees of their rows.

A stage of Radau IIA takes of a tabulated load f not its value there, but
    f_j = int f l_j dt / int l_j dt
over the step with the Lagrange polynomials l_j of the nodes, exact over all rows; of a polynomial
of degree s - 1 that is its value at the stage. So is Radau IIA a discontinuous Galerkin method with
exact loads (Hairer & Wanner 1996, II.7), and no row falls between two steps, whatever the length of
either; the error estimate, which has one stage more, sees what the steps miss of a table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from dolfinopt.dynamics.collocation import lagrange
from dolfinopt.errors import InputError
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.scene.csv_table import TIME, read_table
from dolfinopt.scene.duration import stamp

Function = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Table:
    """A polygon through the rows of a file, zero beyond the last one, and a constant.

    Attributes:
        t: (m,) ascending, s.
        values: (m, k).
        constant: (k,) or a number that is added.
    """

    t: np.ndarray
    values: np.ndarray
    constant: np.ndarray | float = 0.0

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """Return the values (n, k) at instants t (n,), s."""
        columns = [np.interp(t, self.t, column) for column in self.values.T]
        return np.stack(columns, axis=1) * (t <= self.t[-1])[:, None] + self.constant

    def at_stages(self, time_grid: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """Return the values (n s, k) at the stages of the steps of a grid, see the module."""
        return stage_values_of(self, self.t, time_grid, nodes)


@dataclass(frozen=True, eq=False)
class LoadedMotion:
    """A rigid motion and the forces that act beside it, at given instants (n,) s.

    Attributes:
        motion: the rigid coordinates.
        loads: force and moment of every applied force of the mechanism, N and N m.
        rows: (m,) instants of the rows of the motion's own table, s; None without.
    """

    motion: Callable[[np.ndarray], RigidMotion]
    loads: tuple[Table, ...] = ()
    rows: np.ndarray | None = None

    def __call__(self, t: np.ndarray) -> RigidMotion:
        """Return motion and forces at instants t (n,), s."""
        return self._loaded(self.motion(t), lambda table: table(t))

    def at_stages(self, time_grid: np.ndarray, nodes: np.ndarray) -> RigidMotion:
        """Return them at the stages of the steps of a grid, see the module."""
        motion = self._motion_at(time_grid, nodes)
        return self._loaded(motion, lambda table: table.at_stages(time_grid, nodes))

    def _motion_at(self, time_grid: np.ndarray, nodes: np.ndarray) -> RigidMotion:
        motion = self.motion(stage_instants(time_grid, nodes))
        if self.rows is None or not len(self.rows):
            return motion
        # The load is linear in the acceleration alone, whose jumps are the sharp ones.
        qdd = stage_values_of(lambda t: self.motion(t).qdd, self.rows, time_grid, nodes)
        return replace(motion, qdd=qdd)

    def _loaded(self, motion: RigidMotion, values: Callable[[Table], np.ndarray]) -> RigidMotion:
        if not self.loads:
            return motion
        applied = np.stack([values(load) for load in self.loads], axis=1)
        return replace(motion, applied=applied)


def motion_at_stages(
    motion: Callable[[np.ndarray], RigidMotion], time_grid: np.ndarray, nodes: np.ndarray
) -> RigidMotion:
    """Return a motion at the stages of the steps of a grid: of tables by their moments."""
    if isinstance(motion, LoadedMotion):
        return motion.at_stages(time_grid, nodes)
    return motion(stage_instants(time_grid, nodes))


def stage_instants(time_grid: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return the instants (n s,) of the nodes (s,) of the steps of a grid (n + 1,), s."""
    return (time_grid[:-1, None] + np.diff(time_grid)[:, None] * nodes).ravel()


def stage_values_of(
    function: Function, rows: np.ndarray, time_grid: np.ndarray, nodes: np.ndarray
) -> np.ndarray:
    """Return the values (n s, k) by which a function counts at the stages, see the module.

    Args:
        function: of instants (m,) s, smooth between the rows.
        rows: instants, s; steps without one inside have the function's values at their stages.
        time_grid: (n + 1,) s.
        nodes: (s,).
    """
    values = function(stage_instants(time_grid, nodes))
    inside = np.setdiff1d(rows[(rows > time_grid[0]) & (rows < time_grid[-1])], time_grid)
    if not len(inside):
        return values
    steps = np.unique(np.searchsorted(time_grid, inside) - 1)
    ends = np.union1d(time_grid, inside)
    step = np.searchsorted(time_grid, ends[:-1], side="right") - 1
    pieces = np.isin(step, steps)
    step, first, last = step[pieces], ends[:-1][pieces], ends[1:][pieces]
    # Exact for splines of degree 5 in methods of three stages and more.
    points, weights = np.polynomial.legendre.leggauss(len(nodes) + 2)
    length = 0.5 * (last - first)[:, None]
    t = first[:, None] + length * (1.0 + points)
    h = np.diff(time_grid)
    tau = (t - time_grid[step][:, None]) / h[step][:, None]
    basis = lagrange(nodes, tau.ravel()).reshape(*t.shape, -1)
    f = function(t.ravel()).reshape(*t.shape, -1)
    parts = basis.swapaxes(1, 2) @ (f * (length * weights)[:, :, None])
    moments = np.add.reduceat(parts, np.searchsorted(step, steps))
    lengths = h[steps, None, None] * lagrange(nodes, np.ones(1), -1)[0][:, None]
    values = values.reshape(len(h), len(nodes), -1)
    values[steps] = moments / lengths
    return values.reshape(-1, values.shape[2])


def read_forces(file: str, columns: tuple[str, ...]) -> Table:
    """Return a file's table of forces; it is kept until the file is written anew."""
    return _read_forces(file, columns, stamp(file))


@lru_cache(maxsize=16)
def _read_forces(file: str, columns: tuple[str, ...], written: int) -> Table:
    """Return what `read_forces` does; `written` tells versions of the file apart."""
    table = read_table(file, columns)
    if table.t is None:
        raise InputError(f"{file}: expected a column {TIME} besides {', '.join(columns)}")
    return Table(table.t, table.rows)
