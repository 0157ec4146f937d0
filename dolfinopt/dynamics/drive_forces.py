"""Derivatives of the drive forces along a trajectory, by its coordinates and by the bodies.

A drive on a prescribed coordinate gives what inverse dynamics asks for, less what the closure's
force does; it depends on coordinates, rates and accelerations, on the multipliers of a loop and on
every shape integral. A drive of a free coordinate follows its law: u = u_ff + Kp (q_d - q) +
Kd (qd_d - qd), of which u_ff is inverse dynamics of the rigid arms of the same bodies.
"""

from __future__ import annotations

import numpy as np

from dolfinopt.dynamics.elastic_system import ElasticSystem
from dolfinopt.dynamics.machine_system import MachineInstants, MachineSystem
from dolfinopt.multibody.body_gradient import body_gradient
from dolfinopt.multibody.interface_jacobian import interface_place, place_gradient
from dolfinopt.multibody.inverse_dynamics import Rates
from dolfinopt.multibody.shape_integrals import ShapeIntegrals, add_integrals
from dolfinopt.multibody.tangent import linearise

CHUNK = 512  # instants whose matrices are in memory at once


def drive_force_gradient(
    system: ElasticSystem | MachineSystem, t: np.ndarray, rates: Rates, weights: np.ndarray
) -> tuple[np.ndarray, list[ShapeIntegrals]]:
    """Return the derivative of sum_n weights_n . forces_n, instants and coordinates held apart.

    Args:
        system: with prescribed or free rigid coordinates.
        t: (n,) instants, s.
        rates: its S coordinates, their rates and accelerations there, each (n, S).
        weights: (n, 1 + arms) of the forces of cart and joints, see `Trajectory.joint_forces`.

    Returns:
        By coordinates, rates and accelerations (3, n, S); and by every body's integrals, the
        coordinates held.
    """
    of_kind = _of_prescribed if isinstance(system, ElasticSystem) else _of_machine
    by_rates, bodies = [], None
    for first in range(0, len(t), CHUNK):
        part = slice(first, first + CHUNK)
        y, yd, ydd = (x[part] for x in rates)
        by, found = of_kind(system, t[part], (y, yd, ydd), weights[part])  # type: ignore[arg-type]
        by_rates.append(by)
        bodies = found if bodies is None else [a + b for a, b in zip(bodies, found, strict=True)]
    assert bodies is not None, "no instants"
    return np.concatenate(by_rates, axis=1), bodies


def _of_prescribed(
    system: ElasticSystem, t: np.ndarray, rates: Rates, weights: np.ndarray
) -> tuple[np.ndarray, list[ShapeIntegrals]]:
    """Return `drive_force_gradient` of inverse dynamics along the prescribed motion."""
    motion, rigid = system.motion(t), weights.shape[1]
    tangent = linearise(system.mechanism, motion, *rates, None, np.arange(rigid))
    none = np.zeros_like(rates[0])
    by = np.stack(tangent.transposed(np.concatenate([weights, none], axis=1)))
    return by[:, :, rigid:], body_gradient(system.mechanism, motion, *rates, none, weights)


def _of_machine(
    system: MachineSystem, t: np.ndarray, rates: Rates, weights: np.ndarray
) -> tuple[np.ndarray, list[ShapeIntegrals]]:
    """Return `drive_force_gradient` of drives by their law, and of those on a given motion."""
    instants, drives = system.at(t), system.drives
    prescribed = weights.copy()
    prescribed[:, drives.free] = 0.0
    by, bodies = _of_prescribed_drives(instants, rates, prescribed)
    y, yd, _ = rates
    passing = drives.passing(instants.ahead, instants.at_drives(y), instants.at_drives(yd))
    passed = passing * weights[:, drives.free]
    by[0][:, system.drive_columns] -= passed * drives.stiffness
    by[1][:, system.drive_columns] -= passed * drives.damping
    return by, system.with_feed_forward(bodies, instants.desired, passed)


def _of_prescribed_drives(
    instants: MachineInstants, rates: Rates, weights: np.ndarray
) -> tuple[np.ndarray, list[ShapeIntegrals]]:
    """Return the part of drives on a given motion: inverse dynamics, less the closure's force."""
    system, (y, yd, ydd) = instants.machine, rates
    mechanism, (_, moving, last) = system.mechanism, system.ends
    motion, rigid = instants.motion(y, yd, ydd), weights.shape[1]
    (_, q, _), (_, qd, _), (_, qdd, multipliers) = (instants.split(x) for x in rates)
    none = np.zeros_like(q)
    bodies = body_gradient(mechanism, motion, q, qd, qdd, none, weights)
    by = np.zeros((3, *y.shape))
    if not weights.any():
        return by, bodies
    tangent = linearise(mechanism, motion, q, qd, qdd, None, np.arange(rigid))
    rows = np.concatenate([weights, none], axis=1)
    by[:, :, :moving] = np.stack(tangent.transposed(rows))[:, :, system.columns]
    if system.closure is None:
        return by, bodies
    here = interface_place(mechanism, motion, q, second=True)
    assert here.hessian is not None
    pull = -system.ground_force(multipliers)
    turned = np.einsum("ni,nic->nc", weights, here.hessian[:, :rigid, system.columns])
    by[0][:, :moving] += (np.conj(pull)[:, None] * turned).real
    J = system.closure.project(here.jacobian[:, :rigid])
    by[2][:, moving:last] -= np.einsum("nmi,ni->nm", J, weights)
    moved = np.concatenate([weights, none], axis=1)
    parts = place_gradient(mechanism, motion, q, np.zeros_like(pull), moved, pull)
    return by, [add_integrals(a, part) for a, part in zip(bodies, parts, strict=True)]
