"""A machine of elastic arms on joints that are prescribed, driven, or follow in closed loops.

Unknowns are y = (e, q, mu, s): the deviation e of the free rigid coordinates from the desired
motion, the elastic coordinates q, for every constraint a coordinate whose second derivative is its
multiplier, and the deviation s of motors that drive their arms through springs. The other rigid
coordinates follow the desired motion exactly; where all do, q alone is unknown. The equations stand
in `machine_instants`.

Closures may hold rigid arms by more equations than joints that follow. P projects on combinations
of equations that none of these joints moves, at the desired pose of every instant; constraints are

    scale (g - g_0) + rho P mu'' = 0

with the gap g_0 that rigid arms leave. What no arm resists then carries no force, as joints that
give way by rho of the softest arm would have it; what arms resist is determined by them. With
constraints this is Radau IIA of index 3, of which positions have order 2 s - 1, velocities s and
multipliers s - 1. Source: Hairer, Lubich & Roche (1989), doi:10.1007/BFb0093947.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from dolfinopt.dynamics.drives import NO_COORDINATES, NOTHING, Drives, Springs
from dolfinopt.dynamics.equilibrium import equilibrium
from dolfinopt.dynamics.known_forces import known_forces
from dolfinopt.dynamics.machine_instants import MachineInstants
from dolfinopt.dynamics.measured import DEFLECTION_LIMIT, EXACT
from dolfinopt.dynamics.modes import modes_of
from dolfinopt.dynamics.system import Preconditioner, State, unchanged
from dolfinopt.dynamics.tables import motion_at_stages, stage_instants
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.closures import Loops
from dolfinopt.multibody.loads import is_loaded_at_rest
from dolfinopt.multibody.ranks import complement
from dolfinopt.multibody.rigid_motion import RigidMotion
from dolfinopt.multibody.shape_integrals import Rates, ShapeIntegrals
from dolfinopt.multibody.tangent import linearise
from dolfinopt.multibody.tree import Friction, Mechanism

PRESCRIBED = Drives(NO_COORDINATES, NOTHING, NOTHING, NOTHING, NO_COORDINATES > 0)


@dataclass(frozen=True)
class Names:
    """What the parts of a machine are called, for messages, tables and files.

    Attributes:
        source: the file that describes it.
        arms: from the base outwards.
        joints: the inboard one of every arm.
        units: "m" or "rad" of every rigid coordinate, by its name.
        driven: rigid coordinates with a drive.
    """

    source: str = ""
    arms: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    driven: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class MachineSystem:
    """See the module.

    Attributes:
        mechanism: N elastic coordinates.
        motion: desired rigid coordinates at given instants (n,) s.
        breakpoints: ascending instants, first 0 and last the horizon, between which the desired
            motion is smooth; steps end there. s.
        drives: of the R free rigid coordinates; the others follow the desired motion exactly.
        loops: closures, m equations; or None.
        path: motion along which rigid arms carry the end-effector, from which it deviates; None:
            the desired one.
        names: of its parts.
    """

    mechanism: Mechanism
    motion: Callable[[np.ndarray], RigidMotion]
    breakpoints: tuple[float, ...]
    drives: Drives = PRESCRIBED
    loops: Loops | None = None
    path: Callable[[np.ndarray], RigidMotion] | None = None
    names: Names = Names()

    # -- unknowns ----------------------------------------------------------------------------

    @cached_property
    def ends(self) -> tuple[int, int, int]:
        """Ends R, R + N, R + N + m of three kinds of unknowns; M motors follow."""
        moving = len(self.drives.free) + self.mechanism.num_coordinates
        constraints = 0 if self.loops is None else self.loops.count
        return len(self.drives.free), moving, moving + constraints

    @property
    def num_coordinates(self) -> int:
        """Number S = R + N + m + M of unknowns."""
        return self.ends[2] + len(self.drives.springs.joints)

    @property
    def is_prescribed(self) -> bool:
        """Whether elastic coordinates alone are unknown."""
        return self.num_coordinates == self.mechanism.num_coordinates

    @property
    def elastic_columns(self) -> slice:
        """Where the elastic coordinates stand among the unknowns."""
        return slice(*self.ends[:2])

    @cached_property
    def body_columns(self) -> tuple[slice, ...]:
        """Where the coordinates of every body stand."""
        first = self.ends[0]
        return tuple(slice(first + x.start, first + x.stop) for x in self.mechanism.slices)

    @property
    def constraint_columns(self) -> slice:
        """Where the constraints' coordinates stand."""
        return slice(*self.ends[1:])

    @property
    def motor_columns(self) -> slice:
        """Where motors behind springs stand."""
        return slice(self.ends[2], self.num_coordinates)

    @cached_property
    def drive_columns(self) -> np.ndarray:
        """Where what the drives act on stands (R,): of joints behind springs their motors."""
        places = np.arange(self.ends[0])
        places[self.drives.springs.joints] = np.arange(self.ends[2], self.num_coordinates)
        return places

    @property
    def motor_joints(self) -> np.ndarray:
        """Rigid coordinates (M,) of the joints behind these springs."""
        return self.drives.free[self.drives.springs.joints]

    @cached_property
    def columns(self) -> np.ndarray:
        """Places of the free and the elastic coordinates among all of the mechanism's."""
        rigid = self.mechanism.num_rigid
        return np.concatenate([self.drives.free, rigid + np.arange(self.mechanism.num_coordinates)])

    @cached_property
    def motor_coordinates(self) -> np.ndarray:
        """The mechanism's coordinates (M,) of motors behind springs that are controlled."""
        return self.mechanism.num_rigid + np.arange(len(self.drives.springs.joints))

    @cached_property
    def freed(self) -> MachineSystem:
        """The same with every rigid coordinate and motor free and no drive: rows are what moves it.

        Its unknowns are those of all rigid coordinates, elastic, constraints, motors.
        """
        every, motors = np.arange(self.mechanism.num_rigid), self.mechanism.motor_joints
        none, still = np.zeros(len(every)), np.zeros(len(motors))
        springs = Springs(motors, still, still, Friction.none(len(motors)))
        drives = Drives(every, none, none, none + np.inf, every >= 0, springs=springs)
        return replace(self, drives=drives)

    @cached_property
    def among_freed(self) -> np.ndarray:
        """Places of the unknowns among those of the same machine freed."""
        rigid, R = self.mechanism.num_rigid, self.ends[0]
        rest = rigid + np.arange(self.num_coordinates - R)
        return np.concatenate([self.drives.free, rest])

    def unknowns_of(self, known: MachineSystem, x: np.ndarray) -> np.ndarray:
        """Return the unknowns (..., S) where this machine moves as another does, of its own x.

        Drives that are free here alone are where the motion has them; so are motors before springs.
        """
        out = np.zeros((*x.shape[:-1], self.num_coordinates))
        free = np.searchsorted(self.drives.free, known.drives.free)
        out[..., free] = x[..., : len(free)]
        out[..., self.elastic_columns] = x[..., known.elastic_columns]
        out[..., self.constraint_columns] = x[..., known.constraint_columns]
        return out

    # -- at instants -------------------------------------------------------------------------

    def at(self, t: np.ndarray) -> MachineInstants:
        """Return the machine at instants t (n,), s."""
        table = self.drives.table
        return self._along(t, self.motion(t), None if table is None else table(t))

    def at_stages(self, time_grid: np.ndarray, nodes: np.ndarray) -> MachineInstants:
        """Return it at the stages of the steps of a grid, see `System.at_stages`."""
        table = self.drives.table
        given = None if table is None else table.at_stages(time_grid, nodes)
        desired = motion_at_stages(self.motion, time_grid, nodes)
        return self._along(stage_instants(time_grid, nodes), desired, given)

    def _along(
        self, t: np.ndarray, desired: RigidMotion, given: np.ndarray | None
    ) -> MachineInstants:
        """Return the machine on a desired motion, with a table's forces (n, R) of its drives."""
        ahead, winding = known_forces(self, desired)
        ahead = ahead if given is None else ahead + given
        closing = desired if self.path is None else self.path(t)
        return MachineInstants(self, desired, ahead, winding, self.redundant_at(closing))

    @cached_property
    def rigid(self) -> Mechanism:
        """The mechanism with rigid arms of the same mass and inertia, and the forces foreseen."""
        return self.mechanism.foreseen.rigid

    # -- closures that hold rigid arms too often ---------------------------------------------

    @property
    def num_redundant(self) -> int:
        """Number of equations that follow from the others for rigid arms."""
        _, moving, last = self.ends
        return last - moving - len(self.drives.dependent)

    def redundant_at(self, desired: RigidMotion) -> tuple[np.ndarray, np.ndarray] | None:
        """Return P (n, m, m) and g_0 = P g (n, m), m, of rigid arms on a desired motion."""
        if self.loops is None or self.num_redundant == 0:
            return None
        dependent, none = self.drives.dependent, np.zeros((len(desired.q), 0))
        here = self.loops.at(self.rigid, desired.q, none)
        P = complement(here.jacobian[:, :, dependent] / self.mechanism.levers[dependent])
        return P, np.einsum("nij,nj->ni", P, here.gap)

    def left_stress(self) -> float:
        """Return the largest force that closing what rigid arms leave open would add at t = 0, N.

        (N' G_e K^-1 G_e' N)^-1 N' g_0, N spanning P: it is told, not summed in.
        """
        result = self.redundant_at(self.motion(np.zeros(1)))
        if result is None:
            return 0.0
        P, left = (x[0] for x in result)
        elastic = self._elastic_jacobian[0]
        softness = P @ elastic @ np.linalg.solve(self.mechanism.stiffness(), elastic.T @ P)
        forces = np.linalg.pinv(softness, rcond=1e-9, hermitian=True) @ left
        return float(np.abs(forces).max(initial=0.0))

    @property
    def _elastic_jacobian(self) -> np.ndarray:
        """Derivative of the closures by the elastic coordinates (1, m, N), undeformed at t = 0."""
        q = np.zeros((1, self.mechanism.num_coordinates))
        if self.loops is None:
            return q[:, None]
        here = self.loops.at(self.mechanism, self.motion(np.zeros(1)).q, q)
        return here.jacobian[:, :, self.mechanism.num_rigid :]

    # -- equilibrium at t = 0 ----------------------------------------------------------------

    def initial_state(self) -> State:
        """Return y, yd (1, S): the equilibrium at t = 0, zero unless something loads the machine.

        A drive without stiffness begins on the desired motion and is held there for it: what else
        is free, in a closed loop the joints that follow, finds its equilibrium about it.

        Raises:
            ConvergenceError: there is no equilibrium near the undeformed state.
        """
        return self._start.copy(), np.zeros_like(self._start)

    @cached_property
    def _start(self) -> np.ndarray:
        """That of `initial_state`: every time grid asks for it."""
        start = self._rest(np.zeros((1, self.num_coordinates)))[0]
        if self.deflection(start) > DEFLECTION_LIMIT:  # Newton's method found arms folded
            raise self._no_equilibrium()
        return start

    @property
    def is_held(self) -> np.ndarray:
        """Where nothing but the start holds a free coordinate (R,): no gain and no loop."""
        return self.drives.driven & (self.drives.stiffness == 0.0)

    @cached_property
    def _at_start(self) -> np.ndarray:
        """Places of the unknowns that the equilibrium at t = 0 determines: all but held drives."""
        return np.setdiff1d(np.arange(self.num_coordinates), self.drive_columns[self.is_held])

    def _rest(self, y: np.ndarray) -> Rates:
        """Return unknowns at rest at t = 0, (1, S) each, near y; multipliers in the last ones."""
        instants, some, ground = self.at(np.zeros(1)), self._at_start, self.constraint_columns

        def states(x: np.ndarray) -> Rates:
            at, yd, ydd = y.copy(), np.zeros_like(y), np.zeros_like(y)
            at[0, some] = x
            ydd[:, ground], at[:, ground] = at[:, ground], 0.0
            return at, yd, ydd

        x = equilibrium(
            lambda x: instants.residual(*states(x))[0, some],
            lambda x: self._stiffness(instants, states(x)),
            y[0, some],
            size=0.0 if self.is_prescribed else 1.0,  # rad: nothing may load a machine
        )
        if x is None:
            raise self._no_equilibrium()
        return states(x)

    def _stiffness(self, instants: MachineInstants, rates: Rates) -> np.ndarray:
        """Return the derivative by the coordinates of `_at_start`, multipliers among them."""
        by_q, _, by_a = np.split(instants.linearise(*rates).dense()[0], 3, axis=1)
        ground, some = self.constraint_columns, self._at_start
        by_q[:, ground] = by_a[:, ground]
        return by_q[np.ix_(some, some)]

    def _no_equilibrium(self) -> ConvergenceError:
        keys = {
            "material.young_modulus": True,
            "interpolation.floor": True,
            "bearing_stiffness": bool(self.mechanism.bearings),
            "gear_stiffness": len(self.drives.springs.joints) > 0,
            "control.limits": bool(np.isfinite(self.drives.limits).any()),
            "control.stiffness": bool(self.drives.stiffness.any()),
        }
        return ConvergenceError(
            "the machine finds no static equilibrium at t = 0: it is too soft, or its drives are "
            "too weak, for gravity or for the acceleration that the motion begins with, or a loop "
            f"cannot be closed; raise {', '.join(key for key, counts in keys.items() if counts)}, "
            "lower motion.gravity, let the motion begin at rest, or leave feed-forward on"
        )

    def start_gradient(self, y: np.ndarray, by_y: np.ndarray) -> list[ShapeIntegrals]:
        """Return the derivative by every body of J through the state y (S,) at t = 0.

        Nothing where nothing loads the bodies there: they are at rest whatever they are.
        """
        if not y.any() and not is_loaded_at_rest(self.mechanism, self.motion(np.zeros(1))):
            return []
        instants, some = self.at(np.zeros(1)), self._at_start
        rates, right = self._rest(y[None]), -by_y
        right[self.constraint_columns] = 0.0
        multipliers = np.zeros((1, len(y)))
        multipliers[0, some] = np.linalg.solve(self._stiffness(instants, rates).T, right[some])
        return instants.state(*rates).body_gradient(multipliers)

    def start_by_command(self, y: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Return the derivative (S, F) of the state y (S,) at t = 0 by desired coordinates."""
        instants, some = self.at(np.zeros(1)), self._at_start
        rates = self._rest(y[None])
        by = instants.state(*rates).by_command(joints)[0, :, :, 0]
        out = np.zeros_like(by)
        out[some] = -np.linalg.solve(self._stiffness(instants, rates), by[some])
        out[self.constraint_columns] = 0.0
        return out

    # -- what integrators measure by ---------------------------------------------------------

    @cached_property
    def gap_scale(self) -> float:
        """Stiffness, N/m, that makes a force of a constraint's gap; it only scales rows."""
        return 1.0 / self._softness

    @cached_property
    def _softness(self) -> float:
        return self.mechanism.softness or 1e-6

    @cached_property
    def rigid_scale(self) -> np.ndarray:
        """Weights (R,), J^(1/2) per m or rad, that make free coordinates comparable to modes.

        The energy that a deflection of the same size as the coordinate's at the chain's end would
        store in the softest arm. Joints that follow in loops of rigid arms have none: they are as
        the others have them, and rounding of theirs is no error beside stiff arms that bear little.
        """
        scale = self.mechanism.levers[self.drives.free] / np.sqrt(self._softness)
        loops_are_rigid = self.loops is not None and not self._elastic_jacobian.any()
        return np.where(self.drives.driven, scale, 0.0) if loops_are_rigid else scale

    def norm(self, y: np.ndarray) -> np.ndarray:
        """Return the largest norm over n instants (..., groups): free coordinates, then arms.

        Of an arm sqrt(q' K q). Multipliers are not measured: their order is lower, and nothing
        depends on them; nor is the rounding of free coordinates, all that is left of rigid arms
        that feed-forward moves.
        """
        arms = self.mechanism.norm(y[..., self.elastic_columns])
        if (R := self.ends[0]) == 0:
            return arms
        scale = self.rigid_scale
        squares = np.square(scale * y[..., :R]).sum(axis=-1)
        motors = scale[self.drives.springs.joints] * y[..., self.motor_columns]
        squares += np.square(motors).sum(axis=-1)
        # rad, or lengths over the reach: a thousand times their own rounding.
        rigid = np.sqrt(squares).max(axis=-1) - 10.0 * EXACT * scale.max()
        return np.concatenate([np.maximum(rigid, 0.0)[..., None], arms], axis=-1)

    def deflection(self, y: np.ndarray) -> float:
        """Return the largest deflection of an arm in a motion y (n, S), over its length."""
        return float(self.mechanism.deflections(y[:, self.elastic_columns])[0].max(initial=0.0))

    @cached_property
    def rest_mass(self) -> np.ndarray:
        """Mass (3, N, N) of the undeformed mechanism at the beginning, middle, end of the motion.

        With 1 to 9 instants modes of their mean are as good.
        """
        t = np.linspace(0.0, self.breakpoints[-1], 3)
        size = self.mechanism.num_coordinates
        rest = np.zeros((len(t), size))
        tangent = linearise(self.mechanism, self.motion(t), rest, rest, rest)
        return tangent.dense()[:, :, 2 * size :]

    def slowest_frequency(self) -> float:
        """Return that of the slowest vibration of the undeformed mechanism at t = 0, rad/s.

        Its rigid coordinates are held; 0 of rigid arms.
        """
        return self.slowest_vibration(0)[0]

    def slowest_vibration(self, place: int) -> tuple[float, float]:
        """Return w, rad/s, and damping ratio of the slowest vibration, rigid coordinates held.

        Args:
            place: of the undeformed mechanism in `rest_mass`: 0 at the beginning, 2 at the end.
        """
        if self.mechanism.num_coordinates == 0:
            return 0.0, 0.0
        K, M = self.mechanism.stiffness(), self.rest_mass[place]
        squares, shapes = np.linalg.eig(np.linalg.solve(K, M))
        slowest = int(np.abs(squares).argmax())
        frequency, shape = np.sqrt(1.0 / np.abs(squares[slowest])), shapes[:, slowest].real
        damping = shape @ self.mechanism.damping() @ shape / (shape @ K @ shape)
        return float(frequency), float(0.5 * damping * frequency)

    def preconditioner(self) -> Preconditioner:
        """Return the arms' vibrations; simulation and adjoint ask for the same.

        Where nothing guides a free coordinate it goes far, and all are treated densely.
        """
        return unchanged(self) if self.is_held.any() else self._modes

    @cached_property
    def _modes(self) -> Preconditioner:
        return modes_of(self)
