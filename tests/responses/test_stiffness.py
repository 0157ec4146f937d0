"""Stiffness of single arms under given loads: Timoshenko's cantilever, a limit kept."""

from __future__ import annotations

import pytest
from machines import held_link
from remainders import build, built_of

import dolfinopt as do
from dolfinopt.responses.constraints import EXCESS, limits_of

PLANE = "constraints.stiffness=[{arm='arm1', force=[3.0,100.0], moment=-5.0, displacement=1e-4}, "
PLANE += "{arm='arm2', moment=2.0, displacement=1e-4, rotation=2e-3}]"


@pytest.mark.serial
@pytest.mark.parametrize("dim", [2, 3])
def test_timoshenkos_cantilever(dim, tmp_path) -> None:
    """u = F L^3 / (3 EI) + F L / (k G A) + M L^2 / (2 EI), theta = F L^2 / (2 EI) + M L / EI."""
    L, b, h, E, nu, F, M = 1.0, 0.02, 0.1, 70e9, 0.3, 100.0, 20.0
    inertia, area = b * h**3 / 12.0, b * h
    shear = 5.0 / 6.0 * E / (2.0 * (1.0 + nu)) * area
    u = F * L**3 / (3.0 * E * inertia) + F * L / shear + M * L**2 / (2.0 * E * inertia)
    theta = F * L**2 / (2.0 * E * inertia) + M * L / (E * inertia)
    case = {"arm": "link", "displacement": u, "rotation": 0.9 * theta}
    case |= {2: {"force": [0.0, F], "moment": M},
             3: {"force": [0.0, F, 0.0], "moment": [0.0, 0.0, M]}}[dim]  # fmt: skip
    link = {"height": h, "thickness": b, "cells": [60, 6, 1][:dim]}
    tables = {"payload": {"mass": 1.0}, "objective": {"kind": "static"}}
    one = held_link(tmp_path, link, [0.0] * dim, constraints={"stiffness": [case]}, **tables)
    built = built_of(one)
    place, turn = limits_of(one, built.evaluate(built.uniform(1.0))[0])[1:]
    # The clamped edge hinders lateral contraction: measured 0.3 %.
    assert (place.value, turn.value) == pytest.approx((u, theta), rel=5e-3)
    assert (place.name, place.unit) == ("stiffness_link_case1", "m")
    assert (turn.name, turn.unit) == ("stiffness_link_case1_rotation", "rad")
    assert not turn.met and "stiffness of link_case1_rotation" in turn.sentence


@pytest.mark.slow
@pytest.mark.serial
def test_lightest_arms_keep_their_stiffness(tmp_path) -> None:
    """Each case is active that another one does not make needless."""
    told = ("objective.kind=mass", "arms.cells=[30,6]", "design.filter_radius=0",
            "design.initial=0.8", "optimizer.max_iterations=60", "constraints.stiffness=["
            "{arm='arm1', force=[0.0,100.0], displacement=8e-3}, "
            "{arm='arm2', moment=50.0, rotation=2e-2}, "
            "{arm='arm2', force=[1.0,0.0], displacement=1.0}]")  # fmt: skip
    found = do.optimize(build(*told).scene)
    assert not found.violated
    limits = {one.name: one for one in found.limits if one.quantity == "stiffness"}
    active = ["stiffness_arm1_case1", "stiffness_arm2_case2_rotation"]
    for name in active:
        assert limits[name].value == pytest.approx(limits[name].limit, rel=EXCESS)
    assert limits["stiffness_arm2_case3"].excess < -0.9


@pytest.mark.serial
def test_the_plane_pays_no_solve_for_it() -> None:
    """Constraint modes are there in any case; a scene without the key is as before."""
    counts = []
    for told in ((), (PLANE,)):
        built = build("objective.kind=compliance", *told)
        evaluation, trajectory = built.evaluate(built.uniform(0.5))
        counts.append(built.profile.counts.solves)
        if told:
            names = ("arm1_case1", "arm2_case2", "arm2_case2_rotation")
            found = evaluation.responses[-1]
            assert found.arms == names and found.values == found.smooth
        built.constraint_gradients(trajectory)
        assert built.profile.counts.solves == counts[-1]
    assert counts[0] == counts[1]
