"""Equations that close loops, against differences: plane and space, rigid and flexible bodies."""

from dataclasses import replace

import numpy as np
import pytest
from bodies import (
    assert_close,
    change_of,
    changed,
    derivative,
    random_chain,
    random_tree,
    stiffened,
)
from scipy.spatial.transform import Rotation

from dolfinopt.multibody.closures import Along, Distance, Facing, Loops, Tie
from dolfinopt.multibody.ranks import complement, least_norm

pytestmark = pytest.mark.serial


def equations_of(rng, d):
    u, v = rng.normal(size=(2, d))
    return (*map(Along, np.eye(d)), Facing(u, v, 0.7), Distance(0.3), Distance(0.0, 1))


def mechanism_of(kind):
    rng = np.random.default_rng(5)
    machine = random_chain(rng, 3) if kind == "plane" else random_tree(rng, interfaces=2)
    bodies = [stiffened(rng, one) if one.num_modes else one for one in machine.mechanism.bodies]
    stiff = replace(machine.mechanism, bodies=tuple(bodies))
    return machine.mechanism if kind == "space" else stiff


@pytest.mark.parametrize("kind", ["plane", "space", "stiffened"])
def test_derivatives_of_every_equation(kind):
    """Rows, the change of their forces, and both by outboard modes and their stiffness."""
    mechanism, rng = mechanism_of(kind), np.random.default_rng(8)
    d = mechanism.dim.d
    ends, rotation = ((1, 0), (2, 0)), np.eye(2)
    if d == 3:
        ends = (2, 0), (4, 1)
        rotation = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    # Long rods: their derivatives of high order, which differences feel, stay small.
    ties = [
        Tie(f"tie {k}", ends[0], b, 2.0 + rng.normal(size=d), rotation, equations_of(rng, d))
        for k, b in enumerate((ends[1], None))
    ]
    loops = Loops(tuple(ties))
    rigid, size = mechanism.num_rigid, mechanism.num_rigid + mechanism.num_coordinates
    y, virtual = rng.normal(scale=0.4, size=(2, 4, size))
    weights, multipliers = rng.normal(size=(2, 4, loops.count))

    def at(y, one=mechanism):
        return loops.at(one, y[:, :rigid], y[:, rigid:])

    here = at(y)
    H = here.hessian(multipliers)
    assert_close(H, H.swapaxes(1, 2), 1e-12)
    for c, unit in enumerate(np.eye(size)):
        by = derivative(lambda t, unit=unit: at(y + t * unit).gap)
        assert_close(here.jacobian[:, :, c], by, 1e-10, np.abs(here.jacobian).max())
        by = derivative(lambda t, unit=unit: at(y + t * unit).generalised_force(multipliers))
        assert_close(H[:, :, c], by, 1e-9, np.abs(H).max())
    links, none = mechanism.rigid, np.zeros((4, 0))

    def moved(t):
        return loops.at(links, y[:, :rigid] + t * virtual[:, :rigid], none)

    rates = derivative(lambda t: np.einsum("nmc,nc->nm", moved(t).jacobian, virtual[:, :rigid]))
    assert_close(moved(0.0).acceleration(virtual[:, :rigid]), rates, 1e-9)
    for k, by in enumerate(here.gradient(weights, multipliers, virtual)):
        for name, gradient in by.items():
            change = change_of(rng, mechanism.bodies[k], name)

            def worth(t, k=k, name=name, x=change):
                there = at(y, changed(mechanism, k, name, t * x))
                work = np.einsum("nc,nc->n", there.generalised_force(multipliers), virtual)
                return float((weights * there.gap).sum() + work.sum())

            assert_close(np.sum(gradient * change), derivative(worth), 1e-9, 10.0)


@pytest.mark.parametrize("shape", [(4, 4), (7, 4), (4, 7)])
def test_least_norm_is_the_pseudoinverse(shape):
    rng = np.random.default_rng(3)
    G, b = rng.normal(size=(5, *shape)), rng.normal(size=(5, shape[0]))
    expected = np.einsum("nuk,nk->nu", np.linalg.pinv(G), b)
    assert_close(least_norm(G, b), expected, 1e-12)


def test_complement_is_what_columns_leave():
    G = np.random.default_rng(4).normal(size=(3, 6, 2))
    P = complement(G)
    assert_close(P @ P, P, 1e-13)
    assert np.abs(P @ G).max() < 1e-14 and np.allclose(np.trace(P, axis1=1, axis2=2), 4.0)
