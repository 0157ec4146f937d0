"""Time law, path and inverse kinematics against differences and the forward kinematics."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from bodies import assert_close, derivative

from dolfinopt.errors import InputError
from dolfinopt.motion import RigidMotion, arc, check_motion, quintic, rigid_motion
from dolfinopt.scene import Scene, scene_from_dict

DURATION = 1.9  # s
INSIDE = np.linspace(0.1, 1.8, 18)  # s, where the path is smooth
DIFFERENCES = 1e-10  # relative: the sixth power of a step over the tenths of a second of a turn
DENSE = np.linspace(0.0, 3.0, 601)  # s, over path and rest

# Paths all over the plane: cart still, half way, along and against; links of two lengths.
SCENES = pytest.mark.parametrize(
    "keys",
    [
        {},
        {"elbow": 1},
        {"flattening": 0.0},
        {"flattening": 0.4, "cart_follow": 0.0},
        {"cart_follow": 1.0, "lengths": (1.2, 0.9)},
        {"cart_follow": -0.2, "lengths": (0.8, 1.1), "elbow": 1},
        {"joint_height": 0.3, "cart_follow": 0.0},  # the shoulder's angle passes pi
    ],
    ids=str,
)


def scene(lengths: tuple[float, ...] = (1.0, 1.0), **motion: Any) -> Scene:
    """Return the paper's example with these arms and this motion."""
    section = {"height": 0.06, "thickness": 0.01, "cells": [20, 2]}
    return scene_from_dict(
        {
            "material": {"young_modulus": 70e9, "poisson_ratio": 0.33, "density": 2700.0},
            "arms": [
                {"name": f"arm{k}", "length": length, **section} for k, length in enumerate(lengths)
            ],
            "motion": {"duration": DURATION, "horizon": 3.0, **motion},
        },
        source="test.toml",
    )


def end_points(motion: RigidMotion, of: Scene) -> np.ndarray:
    """Return the rigid chain's end-effector (n, 2)."""
    x, alpha, beta = motion.q.T
    upper, fore = (arm.length for arm in of.arms)
    return np.stack(
        [
            x + upper * np.cos(alpha) + fore * np.cos(alpha + beta),
            of.motion.joint_height + upper * np.sin(alpha) + fore * np.sin(alpha + beta),
        ],
        axis=1,
    )


def test_quintic_rests_before_and_after() -> None:
    """Zero speed and acceleration up to the start and from the end on."""
    s, sd, sdd = quintic(np.array([-1.0, 0.0, DURATION, 5.0]), DURATION)
    assert s.tolist() == [0.0, 0.0, 1.0, 1.0]
    assert not sd.any()
    assert not sdd.any()


def test_quintic_derivatives() -> None:
    """By differences, and the known peaks 15/8 and 10/sqrt(3) of speed and acceleration."""
    s, sd, sdd = quintic(INSIDE, DURATION)
    assert_close(derivative(lambda t: quintic(INSIDE + t, DURATION)[0]), sd, DIFFERENCES)
    assert_close(derivative(lambda t: quintic(INSIDE + t, DURATION)[1]), sdd, DIFFERENCES)
    assert (np.diff(s) > 0.0).all()
    peak = DURATION * (0.5 - np.sqrt(3.0) / 6.0)  # where the jerk is zero
    _, sd, sdd = quintic(np.array([DURATION / 2.0, peak]), DURATION)
    assert_close(sd[0], 15.0 / 8.0 / DURATION, 1e-14)
    assert_close(sdd, [0.0, 10.0 / np.sqrt(3.0) / DURATION**2], 1e-14)


@pytest.mark.parametrize("flattening", [0.0, 0.3, 1.0])
def test_arc_runs_from_left_over_the_top_to_right(flattening: float) -> None:
    """On the ellipse, monotone in x, a straight line when it is flattened altogether."""
    motion = scene(radius=0.9, flattening=flattening).motion
    path = arc(np.array([0.0, DURATION / 2.0, DURATION, 3.0]), motion)
    expected = [[-0.9, 0.0], [0.0, 0.9 * flattening], [0.9, 0.0], [0.9, 0.0]]
    assert_close(path.p, expected, 1e-14)
    path = arc(DENSE, motion)
    height = flattening * np.sqrt(np.maximum(0.9**2 - path.p[:, 0] ** 2, 0.0))
    # The square root of a rounding error at the ends, where x^2 = r^2.
    assert_close(path.p[:, 1], height, 1e-7, 0.9)
    assert (np.diff(path.p[DENSE <= DURATION, 0]) > 0.0).all()


@pytest.mark.parametrize("flattening", [0.0, 0.3, 1.0])
def test_arc_derivatives(flattening: float) -> None:
    """Speed and acceleration by differences."""
    motion = scene(flattening=flattening).motion
    path = arc(INSIDE, motion)
    assert_close(derivative(lambda t: arc(INSIDE + t, motion).p), path.pd, DIFFERENCES)
    assert_close(derivative(lambda t: arc(INSIDE + t, motion).pd), path.pdd, DIFFERENCES)


@SCENES
def test_rigid_chain_traces_the_path(keys: dict[str, Any]) -> None:
    """To rounding, with the elbow on the side asked for and the cart where it should be."""
    of = scene(**keys)
    motion = rigid_motion(DENSE, of)
    path = arc(DENSE, of.motion)
    assert_close(end_points(motion, of), path.p, 1e-14)
    assert (np.sign(motion.q[:, 2]) == of.motion.elbow).all()
    follow = of.motion.cart_follow
    assert np.array_equal(motion.q[:, 0], follow * path.p[:, 0])
    assert np.array_equal(motion.qd[:, 0], follow * path.pd[:, 0])
    assert np.array_equal(motion.qdd[:, 0], follow * path.pdd[:, 0])


@SCENES
def test_rates_are_derivatives(keys: dict[str, Any]) -> None:
    """Of all three coordinates, by differences."""
    of = scene(**keys)
    motion = rigid_motion(INSIDE, of)
    speed = derivative(lambda t: rigid_motion(INSIDE + t, of).q, step=2e-3)
    acceleration = derivative(lambda t: rigid_motion(INSIDE + t, of).qd, step=2e-3)
    assert_close(speed, motion.qd, DIFFERENCES)
    assert_close(acceleration, motion.qdd, DIFFERENCES)


@SCENES
def test_angles_are_continuous_and_rest_at_last(keys: dict[str, Any]) -> None:
    """No jump by 2 pi; nothing moves once the path has ended."""
    motion = rigid_motion(DENSE, scene(**keys))
    steps = np.abs(np.diff(motion.q, axis=0)).max(axis=0)
    assert (steps <= 1.1 * np.abs(motion.qd).max(axis=0) * DENSE[1]).all()
    rest = DENSE >= DURATION
    assert not motion.qd[rest].any()
    assert not motion.qdd[rest].any()
    assert_close(motion.q[rest], np.broadcast_to(motion.q[-1], motion.q[rest].shape), 1e-15)


@pytest.mark.parametrize(
    ("keys", "time", "distance", "word"),
    [
        ({"radius": 4.0}, 0.95, 4.5, "out of reach"),
        ({"joint_height": -1.0}, 0.95, 2.0, "stretched"),  # singular, just reached
        ({"lengths": (1.4, 0.6)}, 0.0, np.sqrt(0.5), "too near"),
        ({"flattening": 0.0, "joint_height": 0.0, "cart_follow": 0.0}, 0.95, 0.0, "folded"),
    ],
    ids=["far", "stretched", "near", "folded"],
)
def test_unreachable_or_singular_path(
    keys: dict[str, Any], time: float, distance: float, word: str
) -> None:
    """The worst instant and the distance there stand in the message."""
    of = scene(**keys)
    with pytest.raises(InputError) as caught:
        rigid_motion(np.linspace(0.0, DURATION, 191), of)
    found = re.fullmatch(
        r"test\.toml: motion: at t = (\S+) s the end-effector is (\S+) m from the shoulder, (.*)",
        str(caught.value),
    )
    assert found
    assert float(found[1]) == pytest.approx(time, abs=5e-4)  # four digits
    assert float(found[2]) == pytest.approx(distance, abs=5e-6)  # six digits
    assert word in found[3]
    with pytest.raises(InputError, match=r"motion\.joint_height"):
        check_motion(of)


def test_path_within_reach_is_accepted() -> None:
    """Close to the stretched position, no message."""
    check_motion(scene(joint_height=-0.999))


@pytest.mark.parametrize("lengths", [(1.0,), (1.0, 1.0, 1.0)])
def test_needs_two_arms(lengths: tuple[float, ...]) -> None:
    """Any other number has no inverse kinematics."""
    with pytest.raises(InputError, match=rf"with {len(lengths)} arm\(s\).*exactly two"):
        rigid_motion(DENSE, scene(lengths))
