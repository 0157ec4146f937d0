"""Closed loops of rigid arms: equations, joints that follow, rates, branches, what is refused."""

from __future__ import annotations

from collections.abc import Callable
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
from loops import (
    BASE,
    BOOM_TABLE,
    FOOT,
    HEAD,
    LOWER,
    LUG,
    PLATE,
    UPPER,
    boom,
    closed,
    crossed_crank,
    delta,
    five_bar,
    four_bar,
    guided_crank,
    parallelogram,
)
from machines import with_keys
from runs import refused
from scipy.spatial.transform import Rotation

from dolfinopt.dynamics.build import check_motion
from dolfinopt.multibody import motion as motions
from dolfinopt.multibody.closures import Along, Distance, Equation, Facing, Loops, Tie
from dolfinopt.motion.build import rigid_motion
from dolfinopt.multibody.machine import loops_of, skeleton
from dolfinopt.multibody.mechanism import Mechanism
from dolfinopt.multibody.motion import Loop, assembled, rotation
from dolfinopt.paths import Limits, law_for
from dolfinopt.scene.load import Scene

pytestmark = pytest.mark.serial


# -- equations that close loops, against differences: plane and space, rigid and flexible bodies


def equations_of(rng: np.random.Generator, d: int) -> tuple[Equation, ...]:
    u, v = rng.normal(size=(2, d))
    return (*map(Along, np.eye(d)), Facing(u, v, 0.7), Distance(0.3), Distance(0.0, 1))


def mechanism_of(kind: str) -> Mechanism:
    rng = np.random.default_rng(5)
    if kind == "plane":
        return random_chain(np.random.default_rng(7), 3, bent=True).mechanism()
    tree = random_tree(rng, interfaces=2).mechanism()
    bodies = [stiffened(rng, one) if one.num_modes else one for one in tree.bodies]
    return replace(tree, bodies=tuple(bodies)) if kind == "stiffened" else tree


@pytest.mark.parametrize("kind", ["plane", "space", "stiffened"])
def test_derivatives_of_every_equation(kind: str) -> None:
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
    every = Loops.of(ties)
    mixed = rng.normal(size=(every.count - 3, every.count))
    loops = replace(every, weights=mixed, given=rng.normal(size=every.count))
    rigid, size = mechanism.num_rigid, mechanism.num_rigid + mechanism.num_coordinates
    y, virtual = rng.normal(scale=0.4, size=(2, 4, size))
    weights, multipliers = rng.normal(size=(2, 4, loops.count))

    def at(y: np.ndarray, one: Mechanism = mechanism):
        return loops.at(one, y[:, :rigid], y[:, rigid:])

    here = at(y)
    H = here.hessian(multipliers)
    assert_close(H, H.swapaxes(1, 2), 1e-12)
    for c, unit in enumerate(np.eye(size)):
        by = derivative(lambda t, unit=unit: at(y + t * unit).gap)
        assert_close(here.jacobian[:, :, c], by, 1e-10, np.abs(here.jacobian).max())
        by = derivative(lambda t, unit=unit: at(y + t * unit).work(multipliers))
        assert_close(H[:, :, c], by, 1e-9, np.abs(H).max())
    rates = derivative(lambda t: np.einsum("nmc,nc->nm", at(y + t * virtual).jacobian, virtual))
    assert_close(here.acceleration(virtual), rates, 1e-9)
    for k, by in enumerate(here.gradient(weights, multipliers, virtual)):
        for name, gradient in by.items():
            change = change_of(rng, mechanism.bodies[k], name)

            def worth(t: float, k: int = k, name: str = name, x: np.ndarray = change) -> float:
                there = at(y, changed(mechanism, k, name, t * x))
                work = np.einsum("nc,nc->n", there.work(multipliers), virtual)
                return float((weights * there.gap).sum() + work.sum())

            assert_close(np.sum(gradient * change), derivative(worth), 1e-9, 10.0)


# -- joints that follow in closed loops of space: closed forms, branches, rates, what is refused


T = np.linspace(0.0, 1.0, 21)  # s
EXACT = 1e-10  # rad, m: Newton's method to rounding
Law = Callable[[np.ndarray], np.ndarray]


def of_five_bar(q: np.ndarray) -> np.ndarray:
    """The tool, where two circles meet above the line between the knees."""
    a, a2, b, b2 = q.T
    left, right = 0.2 * np.exp(1j * a), 0.3 + 0.2 * np.exp(1j * b)
    away = right - left
    half = 0.5 * np.abs(away)
    tool = left + away * (0.5 + 0.5j * np.sqrt(0.3**2 - half**2) / half)
    return np.stack([np.angle(tool - left) - a - a2, np.angle(tool - right) - b - b2])


def of_parallelogram(q: np.ndarray) -> np.ndarray:
    """The hand stays as it is."""
    return q.sum(axis=1)


def of_boom(q: np.ndarray) -> np.ndarray:
    """The law of cosines in the triangle of head, foot and lug."""
    _, luff, length = q.T
    lug, foot = complex(*LUG[:2]), complex(FOOT[0] - HEAD[0], FOOT[2] - HEAD[2])
    angle = luff + np.angle(lug) - np.angle(foot)
    square = abs(lug) ** 2 + abs(foot) ** 2 - 2.0 * abs(lug) * abs(foot) * np.cos(angle)
    return np.sqrt(square) - length


def of_delta(q: np.ndarray) -> np.ndarray:
    """Its plate does not turn, and is as far as the rods are long from all three elbows."""
    found = [*q[:, 6:].T]
    for k in range(3):
        angle, down = 2.0 * np.pi * k / 3.0, np.array([0.0, 0.0, -1.0])
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        elbow = (BASE + UPPER * np.cos(q[:, k, None])) * out + UPPER * np.sin(q[:, k, None]) * down
        found.append(np.linalg.norm(q[:, 3:6] + PLATE * out - elbow, axis=1) - LOWER)
    return np.stack(found)


def of_four_bar(q: np.ndarray) -> np.ndarray:
    """Coupler and rocker end at the foot."""
    a, b, c = np.cumsum(q, axis=1).T
    return np.abs(0.1 * np.exp(1j * a) + 0.28 * np.exp(1j * b) + 0.25 * np.exp(1j * c) - 0.25)


def of_guided_crank(q: np.ndarray) -> np.ndarray:
    """The block is where the rod reaches the axis, and does not turn."""
    a, b, c = np.cumsum(q, axis=1).T
    end = 0.1 * np.exp(1j * a) + 0.28 * np.exp(1j * b)
    place = 0.1 * np.cos(a) + np.sqrt(0.28**2 - (0.1 * np.sin(a)) ** 2)
    return np.stack([np.abs(end - place), c])


def of_crossed_crank(q: np.ndarray) -> np.ndarray:
    """The slider is as far from the crank's pin as the rod is long."""
    y, z = 0.1 - 0.08 * np.sin(q[:, 0]), 0.12 + 0.08 * np.cos(q[:, 0])
    return q[:, 1] - np.sqrt(0.3**2 - y**2 - z**2)


@pytest.mark.parametrize(
    ("tree", "table", "law"),
    [
        (guided_crank(), "t,turn\n0,0.5\n1,5.5\n", of_guided_crank),
        (crossed_crank(), "t,turn\n0,0\n1,5.5\n", of_crossed_crank),
        (four_bar("pin"), "t,turn\n0,0.5\n1,5.5\n", of_four_bar),
        (five_bar(), "t,a,b\n0,2.0,1.1\n1,1.6,0.8\n", of_five_bar),
        (parallelogram(), "t,shoulder\n0,0.3\n1,1.0\n", of_parallelogram),
        (boom(), BOOM_TABLE, of_boom),
        (delta(), "t,drive0,drive1,drive2\n0,0.5,0.5,0.5\n1,0.9,0.3,0.6\n", of_delta),
    ],
    ids=lambda one: one["name"] if isinstance(one, dict) else "",
)
def test_closed_forms(tmp_path, tree: dict, table: str, law: Law) -> None:
    scene = closed(tmp_path, table, tree)
    motion = rigid_motion(T, scene)
    assert np.abs(law(motion.q)).max() < EXACT
    inner, h = T[2:-2], 1e-3  # of the table's law, which is smooth there
    for key in ("q", "qd"):
        a, b, c, d = (getattr(rigid_motion(inner + k * h, scene), key) for k in (-2, -1, 1, 2))
        by = (a - 8.0 * b + 8.0 * c - d) / (12.0 * h)
        expected = getattr(motion[2:-2], key + "d")
        assert np.abs(by - expected).max() < 1e-8 * (1.0 + np.abs(expected).max())


def at_start(scene: Scene) -> np.ndarray:
    q: np.ndarray = rigid_motion(np.zeros(1), scene).q[0]
    return q


def test_the_guess_chooses_the_branch(tmp_path) -> None:
    """The five-bar's tool on the other side of the line between its knees."""
    table = "t,a,b\n0,2.0,1.1\n1,1.6,0.8\n"
    above = at_start(closed(tmp_path, table, five_bar()))
    guess = {"initial_joints": [2.0, -3.0, 1.1, 3.0]}
    below = at_start(closed(tmp_path, table, five_bar(), motion=guess))
    left, right = 0.2 * np.exp(1j * above[0]), 0.3 + 0.2 * np.exp(1j * above[2])
    tools = [left + 0.3 * np.exp(1j * (q[0] + q[1])) for q in (above, below)]
    mirrored = left + (right - left) * np.conj((tools[0] - left) / (right - left))
    assert abs(tools[1] - mirrored) < EXACT


def test_a_path_of_the_plate_moves_the_drives(tmp_path) -> None:
    """All joints of the delta are unknown: six follow, three drive the plate along points."""
    file = tmp_path / "points.csv"
    file.write_text("t,x,y,z\n0,0,0,-0.4\n0.5,0.05,0.02,-0.42\n1,-0.03,0.04,-0.38\n")
    scene = closed(tmp_path, "", delta(), motion={"path": "points", "file": str(file)})
    q = rigid_motion(np.array([0.0, 0.5, 1.0]), scene).q
    assert np.abs(of_delta(q)).max() < EXACT
    points = np.array([[0, 0, -0.4], [0.05, 0.02, -0.42], [-0.03, 0.04, -0.38]])
    assert np.abs(q[:, 3:6] - points).max() < EXACT


def test_redundant_equations_are_found(tmp_path) -> None:
    """Of a pin's five equations a plane four-bar needs two; rods of the delta all count."""
    for tree, table, counts in (
        (four_bar("pin"), "t,turn\n0,0.5\n1,1.0\n", (2, 3)),
        (four_bar("ball"), "t,turn\n0,0.5\n1,1.0\n", (2, 1)),
        (delta(), "t,drive0,drive1,drive2\n0,0.5,0.5,0.5\n1,0.6,0.5,0.5\n", (6, 0)),
    ):
        scene = closed(tmp_path, table, tree)
        loops = loops_of(scene)
        assert loops is not None
        q = at_start(scene)[None]
        rows = loops.at(skeleton(scene), q, np.zeros((1, 0))).every_row[0]
        found = loops.independent(rows)
        assert (found.count, found.redundant) == counts


TURN = "t,turn\n0,0.5\n1,1.0\n"


def far(tree: dict) -> dict:
    """Return the four-bar with a foot that no rocker reaches."""
    return with_keys(tree, {"closures": [tree["closures"][0] | {"point": [1.0, 0, 0]}]})


def driven(tree: dict) -> dict:
    """Return it with two driven joints, of which the loop leaves one."""
    joints = [dict(one) for one in tree["joints"]]
    del joints[1]["passive"]
    return with_keys(tree, {"joints": joints})


def loose(tree: dict) -> dict:
    """Return it held by a rod, which leaves the coupler to itself."""
    rod = {"name": "foot", "kind": "rod", "between": ["rocker", "ground"], "length": 0.1,
           "point": [0.25, 0.1, 0]}  # fmt: skip
    return with_keys(tree, {"closures": [rod]})


@pytest.mark.parametrize(
    ("tree", "table", "words"),
    [
        (far(four_bar()), TURN, ("closures: at t = 0 s the loop of foot", "initial_joints")),
        (driven(four_bar()), "t,turn,knee\n0,0.5,0.3\n1,1.0,0.2\n",
         ("closures: 2 independent equations hold 1", "turn, knee", "passive = true")),
        (loose(four_bar()), TURN, ("closures: 1 independent equations leave 1", "knee, rock")),
        (boom(), "t,slew,cylinder\n0,0,1.0\n1,0,3.0\n",
         ("closures: at t = 0.", "the loop of cylinder", "motion.file")),
    ],
    ids=["too far", "too many drives", "too few equations", "out of reach"],
)  # fmt: skip
def test_refused(tmp_path, tree: dict, table: str, words: tuple[str, ...]) -> None:
    scene = closed(tmp_path, table, tree)
    with refused(*words):
        check_motion(scene)
        rigid_motion(T, scene)


# -- joints of closed loops of rigid arms: closure, rates, both ways to assemble, dead centres


DURATION, SPEED = 0.05, 150.0  # s, rad/s
SLIDER = Loop((0.15, 0.30), 0.1 + 0.2j, 0.3 + 0.25j, np.exp(0.3j), 1)
PIN = Loop((0.10, 0.28, 0.25), 0.0j, 0.25 + 0.0j, None, -1)


def crank(t: np.ndarray, law: str = "quintic") -> tuple[np.ndarray, ...]:
    """Return angle and rates of the first joint (n, 1)."""
    one = law_for(law, 1.0, Limits(np.inf, np.inf, np.inf), 0.25)
    return tuple(x[:, None] for x in rotation(t, one, SPEED, 0.4, DURATION))


def angles(t: np.ndarray, loop: Loop) -> tuple[np.ndarray, ...]:
    way = assembled(crank(np.zeros(1)), loop, "scene.toml")
    return motions.closed(t, crank(t), loop, way, "scene.toml")


def end(q: np.ndarray, loop: Loop) -> np.ndarray:
    """Return the last arm's end (n,), complex."""
    return loop.base + (np.array(loop.lengths) * np.exp(1j * np.cumsum(q, axis=1))).sum(axis=1)


def test_run_up_of_a_crank() -> None:
    """start + speed duration (2.5 u^4 - 3 u^5 + u^6), then constant speed."""
    t = np.linspace(0.0, 2.0 * DURATION, 41)
    angle, rate, growth = (x[:, 0] for x in crank(t))
    u = t / DURATION
    first = 0.4 + SPEED * DURATION * (2.5 * u**4 - 3.0 * u**5 + u**6)
    later = 0.4 + SPEED * (0.5 * DURATION + t - DURATION)
    np.testing.assert_allclose(angle, np.where(u < 1.0, first, later), rtol=0, atol=1e-13)
    assert rate[-1] == SPEED and growth[-1] == 0.0


@pytest.mark.parametrize("law", ["quintic", "septic", "trapezoidal", "s-curve"])
def test_speed_follows_the_law(law: str) -> None:
    """The angle's derivative is the speed, and the speed's the acceleration, for every law."""
    for instant in (0.31 * DURATION, 0.52 * DURATION, 1.5 * DURATION):
        at = np.array([instant])
        # Differences over a hundredth of the run-up; laws are smooth there.
        for order in (0, 1):
            change = derivative(
                lambda h, k=order, at=at: crank(at + 1e-2 * DURATION * h, law)[k][0, 0]
            )
            expected = crank(at, law)[order + 1][0, 0]
            assert change / (1e-2 * DURATION) == pytest.approx(expected, rel=1e-9, abs=1e-7)


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("loop", [SLIDER, PIN], ids=["slider", "pin"])
def test_loops_are_closed(loop: Loop, side: int) -> None:
    """The end stays on its line, or at its pin, and rates are the angles' derivatives."""
    loop = Loop(loop.lengths, loop.base, loop.point, loop.direction, side)
    t = np.linspace(0.0, 0.1, 101)
    q, _, _ = angles(t, loop)
    gap = end(q, loop) - loop.point
    if loop.direction is not None:
        gap = (np.conj(1j * loop.direction) * gap).real
    assert np.abs(gap).max() < 1e-15 * 10
    last = np.angle(np.exp(1j * q[0, -1]))
    assert np.sign(last) == side
    for instant in (0.02, 0.07):
        at = np.array([instant])
        for order in (0, 1):
            change = derivative(lambda h, k=order, at=at: angles(at + 1e-4 * h, loop)[k][0])
            expected = angles(at, loop)[order + 1][0]
            np.testing.assert_allclose(change / 1e-4, expected, rtol=1e-7, atol=1e-4)


@pytest.mark.parametrize(
    ("loop", "words"),
    [
        (Loop((0.15, 0.10), 0.0j, 0.0j, 1.0 + 0.0j, 1), ("closure: at t = 0.0", "across")),
        (Loop((0.10, 0.10, 0.10), 0.0j, 0.25 + 0.0j, None, 1), ("closure: at t = ", "stretched")),
    ],
)
def test_dead_centres_are_refused_with_their_instant(loop: Loop, words) -> None:
    """A rod shorter than the crank does not reach its line, two short arms not their pin."""
    with refused(*words):
        angles(np.linspace(0.0, 0.1, 101), loop)
