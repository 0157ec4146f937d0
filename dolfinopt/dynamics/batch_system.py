"""Systems of the same bodies as one: other payloads, motions, gravity, materials side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dolfinopt.dynamics.elastic_system import ElasticInstants, ElasticSystem, static_equilibrium
from dolfinopt.dynamics.modal_coordinates import REFERENCES, Modes, modes_of, proportion
from dolfinopt.dynamics.system import State
from dolfinopt.errors import ConvergenceError
from dolfinopt.multibody.instants import Scale
from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.multibody.motion import RigidMotion
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, proportional, same_geometry


@dataclass(frozen=True, eq=False)
class BatchSystem:
    """R systems whose mechanisms differ by numbers alone, in the vibrations of the first's arms.

    Attributes:
        members: as given.
        modes: of the first; its bodies' D is the damping's shape, see `scales`.
        payload: (R, 4) mass, inertia, g_x, g_y.
        scales: (R, bodies, 3) of mass, stiffness and damping.
    """

    members: tuple[ElasticSystem, ...]
    modes: Modes
    payload: np.ndarray
    scales: np.ndarray

    @property
    def num_coordinates(self) -> int:
        """Number N of elastic coordinates of each."""
        return self.modes.system.num_coordinates

    @property
    def runs(self) -> int:
        """Number R of systems."""
        return len(self.members)

    @property
    def breakpoints(self) -> tuple[float, ...]:
        """Those of the first; the others have as many."""
        return self.members[0].breakpoints

    def chosen(self, runs: np.ndarray) -> BatchSystem:
        """Return some of them, by index."""
        members = tuple(self.members[i] for i in runs)
        return replace(self, members=members, payload=self.payload[runs], scales=self.scales[runs])

    def at(self, t: np.ndarray) -> ElasticInstants:
        """Return all at instants t (R n,), one system after the other, s.

        Those that share motion and instants are asked once.
        """
        known: dict[tuple[int, bytes], RigidMotion] = {}
        motions = []
        for member, own in zip(self.members, t.reshape(self.runs, -1), strict=True):
            key = (id(member.motion), own.tobytes())
            if key not in known:
                known[key] = member.motion(own)
            motions.append(known[key])
        return ElasticInstants(self._mechanism(len(t) // self.runs), _joined(motions))

    def _mechanism(self, times: int) -> Mechanism:
        """Return that of all systems at `times` instants each, one system after the other."""
        payload = np.repeat(self.payload, times, axis=0).T.copy()
        scales = np.repeat(self.scales, times, axis=0).transpose(1, 2, 0).copy()
        return replace(
            self.modes.system.mechanism,
            payload_mass=payload[0],
            payload_inertia=payload[1],
            gravity=(payload[2], payload[3]),
            scales=tuple(Scale(*one) for one in scales),
        )

    def initial_state(self) -> State:
        """Return the static equilibria (R, N) at t = 0.

        Raises:
            ConvergenceError: one of them has none.
        """
        q, found = static_equilibrium(self)
        if not found.all():
            raise ConvergenceError("no static equilibrium")
        return q, np.zeros_like(q)

    def norm(self, q: np.ndarray) -> np.ndarray:
        """Return the largest norms of every arm; the stiffness is one here."""
        return self.modes.system.norm(q)

    def slowest_frequency(self) -> float:
        """Return that of the first system, rad/s."""
        return self.members[0].slowest_frequency()

    def describe(self, q: np.ndarray) -> str:
        """Say how far the first system's arms' ends turn in a motion q (n, N) of it."""
        return self.members[0].describe(q)

    def deflection(self, q: np.ndarray) -> float:
        """Return the largest deflection of an arm in a motion q (n, N) of the first system."""
        return self.members[0].deflection(q)

    def preconditioner(self) -> BatchModes:
        """Return its own coordinates: they are vibrations."""
        size = self.num_coordinates
        shares = np.linspace(0.0, 1.0, REFERENCES)
        t = np.array([member.breakpoints[-1] * shares for member in self.members])
        rest = np.zeros((t.size, size))
        derivative = self.at(t.ravel()).linearise(rest, rest, rest).dense()
        own = np.arange(size)
        mass = derivative[:, own, 2 * size + own].reshape(*t.shape, size).mean(axis=1)
        k, d = np.empty_like(mass), np.empty_like(mass)
        mechanism = self.modes.system.mechanism
        for i, (part, body) in enumerate(zip(mechanism.slices, mechanism.bodies, strict=True)):
            k[:, part] = self.scales[:, i, 1:2] * np.diag(body.K)
            d[:, part] = self.scales[:, i, 2:] * np.diag(body.D)
        return BatchModes(self, (k, d, mass))


@dataclass(frozen=True, eq=False)
class BatchModes:
    """Preconditioner of a batch, whose coordinates are vibrations already."""

    system: BatchSystem
    uncoupled: tuple[np.ndarray, np.ndarray, np.ndarray]
    definite = guided = True

    @property
    def frequencies(self) -> np.ndarray:
        """Those of every system's coordinates (R, N), rad/s."""
        k, _, m = self.uncoupled
        return np.sqrt(k / m)

    def to_modes(self, q: np.ndarray) -> np.ndarray:
        """Return z (..., N) of the first system's coordinates q."""
        return self.system.modes.to_modes(q)

    def from_modes(self, z: np.ndarray) -> np.ndarray:
        """Return the first system's coordinates q (..., N)."""
        return self.system.modes.from_modes(z)

    def chosen(self, runs: np.ndarray) -> BatchModes:
        """Return that of some of the systems, by index."""
        k, d, m = (x[runs] for x in self.uncoupled)
        return BatchModes(self.system.chosen(runs), (k, d, m))


def _joined(motions: Sequence[RigidMotion]) -> RigidMotion:
    """Return several motions one after the other."""
    names = ("q", "qd", "qdd")
    return RigidMotion(*(np.concatenate([getattr(m, name) for m in motions]) for name in names))


def related(systems: Sequence[ElasticSystem]) -> list[np.ndarray | None]:
    """Return every system's `BatchSystem.scales` (bodies, 3) of the first one's bodies, or None.

    None of those with other masses and inertias at their joints, too.

    The damping's shape is the stiffness where it is proportional to it.
    """
    reference = systems[0].mechanism.bodies
    dampers = [_shape_of_damping(body) for body in reference]
    found: list[np.ndarray | None] = []
    for system in systems:
        bodies = system.mechanism.bodies
        scales = None
        if _same_hardware(system, systems[0]) and len(bodies) == len(reference):
            rows = [_scale(a, b, c) for a, b, c in zip(reference, bodies, dampers, strict=True)]
            scales = None if any(row is None for row in rows) else np.array(rows)
        found.append(scales)
    return found


def _same_hardware(system: ElasticSystem, other: ElasticSystem) -> bool:
    """Return whether all is equal that a `BatchSystem` takes from its first system alone."""
    one, two = system.mechanism, other.mechanism
    return (
        one.joints == two.joints
        and one.cart_mass == two.cart_mass
        and one.joint_height == two.joint_height
        and len(system.breakpoints) == len(other.breakpoints)
    )


def _shape_of_damping(body: ShapeIntegrals) -> np.ndarray:
    return body.K if proportion([body.K], [body.D]) is not None else body.D


def _scale(
    body: ShapeIntegrals, other: ShapeIntegrals, damper: np.ndarray
) -> tuple[float, float, float] | None:
    """Return what makes one body the other: of its mass, stiffness, damping; None if nothing."""
    if not same_geometry(body, other):
        return None
    mass = proportion(*proportional(body, other, "mass"))
    stiffness = proportion(*proportional(body, other, "stiffness"))
    damping = proportion([damper], [other.D])
    if mass is None or stiffness is None or damping is None:
        return None
    return mass, stiffness, damping


def batch_of(systems: Sequence[ElasticSystem], scales: Sequence[np.ndarray]) -> BatchSystem:
    """Return systems that are `related`."""
    first = systems[0]
    bodies = tuple(replace(b, D=_shape_of_damping(b)) for b in first.mechanism.bodies)
    modes = modes_of(replace(first, mechanism=replace(first.mechanism, bodies=bodies)))
    payload = [
        (m.payload_mass, m.payload_inertia, *m.gravity) for m in (p.mechanism for p in systems)
    ]
    return BatchSystem(tuple(systems), modes, np.array(payload, dtype=float), np.array(scales))
