"""Feed-forward of the tip: what is left, against an independent integrator, tables, gradients."""

from __future__ import annotations

import json

import numpy as np
import pytest
from exact_beams import Beam, TwoBeams
from runs import ROOT
from scipy.integrate import solve_ivp

from dolfinopt import Model
from dolfinopt.dynamics import radau
from dolfinopt.dynamics.feed_forward import (
    Splines,
    corrected,
    graded_knots,
    internal_rates,
    off_path,
)
from dolfinopt.errors import InputError
from dolfinopt.multibody.kinematics import end_effector
from dolfinopt.output.feed_forward import (
    FILE,
    lead_warnings,
    slowest_unstable_rate,
    write_feed_forward,
)
from dolfinopt.profiling import Profile

pytestmark = pytest.mark.serial  # the trajectory belongs to one rank

TIP = 'feed_forward.kind="tip"'
SMALL = "arms.cells=[40,4]", "design.filter_radius=0", "simulation.stiffening=false"


def small(*changes: str, scene: str = "two_arm"):
    """Return the simulated uniform design of a demo."""
    changes = (*SMALL, *changes) if scene in ("two_arm", "three_arm") else changes
    model = Model(ROOT / "demos" / f"{scene}.toml", *changes)
    return model.simulate(model.uniform(0.5)).trajectory


@pytest.fixture(scope="module")
def plain():
    return small()


@pytest.fixture(scope="module")
def moved():
    return small(TIP)


def test_the_tip_stays_on_its_path(plain, moved) -> None:
    """A ten thousandth of the deviation is left; joints bend back what the arms bend."""
    found = moved.feed_forward
    assert found.before == pytest.approx(plain.max_deviation[0], rel=0.05)  # to first order
    assert moved.max_deviation[0] < 1e-4 * plain.max_deviation[0]
    assert [moved.scene.driven[k] for k in found.corrections.joints] == ["arm1", "arm2"]
    # As Seifried's servo constraints have it for this machine: 0.016 and 0.028 rad.
    largest = np.abs(found.corrections.at(moved.t)[0]).max(axis=0)
    assert largest == pytest.approx([0.016, 0.028], rel=0.1)
    assert (moved.drives[0] < plain.drives[0]).all()


def test_against_another_integrator(moved, plain) -> None:
    """The reduced equations by SciPy under the same joints: the tip is as near."""
    system, found = moved.problem, moved.feed_forward
    rest = np.zeros((1, system.num_coordinates))

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        q, qd = np.split(y, 2)
        at = system.at(np.array([t]))
        mass = at.linearise(q[None], qd[None], rest).dense()[0, :, 2 * len(q) :]
        force = at.residual(q[None], qd[None], rest)[0]
        return np.concatenate([qd, -np.linalg.solve(mass, force)])

    end, begin = 0.16, moved.scene.lead
    start = np.zeros(2 * rest.shape[1])
    t = np.linspace(begin, end, 31)
    q = solve_ivp(rate, (0.0, end), start, "Radau", t, rtol=1e-5, atol=1e-9).y[: rest.shape[1]].T
    tip = end_effector(system.mechanism, system.motion(t), q)
    still = end_effector(system.mechanism, system.path(t), 0.0 * q)
    assert np.abs(tip - still).max() < 1e-4 * plain.max_deviation[0]
    # Of the largest in the whole motion the simulation leaves 1e-4.
    assert np.abs(q - found.solution.sample(t)).max() < 1e-3 * np.abs(q).max()


def test_against_geometrically_exact_beams() -> None:
    """Solid bars under the same joints, by another theory, elements and time integration.

    With 16 elements and steps of 1 ms: 6.070 and 6.063 mm, 0.15 % apart at any instant, and 0.0065
    mm with feed-forward. Half as many elements and steps of 4 ms: 0.7 % apart, and 0.012 mm.
    """
    E, G, rho, height, width = 70e9, 70e9 / 2.66, 2700.0, 0.06, 0.01
    area, inertia = height * width, width * height**3 / 12.0
    stiffness = E * area, 5.0 / 6.0 * G * area, E * inertia
    beam = Beam(1.0, stiffness, (rho * area, rho * inertia), damping=2e-4, n=8)
    ends = []
    for kind in ("none", "tip"):
        told = (
            "simulation.stiffening=true",
            "reduction.coordinates=6",
            f'feed_forward.kind="{kind}"',
        )
        model = Model(ROOT / "demos" / "two_arm.toml", *SMALL, *told, "design.volume_fraction=1")
        found = model.simulate(model.uniform(1.0)).trajectory
        found = found.at(np.linspace(0.0, found.t[-1], round(found.t[-1] / 4e-3) + 1))
        joints = np.stack([found.commanded.q, found.commanded.qd, found.commanded.qdd])
        off = TwoBeams(beam, -0.5, 6.0).tip(found.t, joints) - (found.end - found.deviation)
        ends.append((off, found.deviation))
    (plain, own), (left, _) = ends
    largest = np.linalg.norm(own, axis=1).max()
    assert np.abs(plain - own).max() < 0.01 * largest
    assert np.linalg.norm(left, axis=1).max() < 0.003 * largest


LINK = """
name = "flexible link"
material = { young_modulus = 70e9, poisson_ratio = 0.0, density = 2700.0 }
arms = [{ name = "link", length = 1.0, height = 0.02, thickness = 0.005, cells = [200, 4] }]
motion = { path = "joints", file = "link.csv", law = "septic", base = "fixed", horizon = 0.4 }
payload.mass = 0.0
damping.stiffness_proportional = 0.0
feed_forward = { kind = "tip", lead = 0.1 }
simulation = { stiffening = false, tolerance = 1e-5 }
reduction.coordinates = 8
objective.kind = "compliance"
design = { filter_radius = 0.0, volume_fraction = 1.0 }
"""


def test_against_the_inverse_of_a_flexible_link(tmp_path) -> None:
    """The tip of one beam turns by 0.02 rad and rests: inverse dynamics over the frequencies.

    Of beams turned at one end, with b^4 = w^2 rho A L^4 / E I, the joint is b (1 + cos b cosh b) /
    (sin b + sinh b) times the tip over the length, and the tip held the beam has the rates
    +- 2 g^2 / L^2 (E I / rho A)^1/2, tan g = -tanh g (Bayo 1987, doi:10.1002/rob.4620040106).
    Found: 0.05 % of the largest correction apart, the slowest rate by 0.1 %.
    """
    (tmp_path / "link.csv").write_text("link\n0.0\n0.02\n")
    (tmp_path / "link.toml").write_text(LINK)
    model = Model(tmp_path / "link.toml", "motion.duration=0.25")
    found = model.simulate(model.uniform(1.0)).trajectory
    speed = 0.02 * np.sqrt(70e9 / 2700.0 / 12.0)  # (E I / rho A)^1/2, m2/s
    assert slowest_unstable_rate(found.feed_forward) == pytest.approx(2 * 2.36502**2 * speed, 2e-3)
    t = np.arange(-1.0, 1.0, 1e-4)
    septic = np.poly1d([-20.0, 70.0, -84.0, 35.0, 0.0, 0.0, 0.0, 0.0]).deriv(2)
    acceleration = np.where((t > 0.0) & (t < 0.25), 0.02 * septic(t / 0.25) / 0.25**2, 0.0)
    w = 2.0 * np.pi * np.fft.rfftfreq(len(t), 1e-4)[1:]
    b = np.sqrt(w / speed)
    joint = b * (1.0 / np.cosh(b) + np.cos(b)) / (np.sin(b) / np.cosh(b) + np.tanh(b))
    bend = np.fft.rfft(acceleration)[1:] * (joint - 1.0) / -(w**2)
    corrections = np.fft.irfft(np.append(0.0, bend), len(t))
    own = found.feed_forward.corrections.at(t[t > -0.1][:4000] + 0.1)[0][:, 0]
    apart = (own - own[0]) - (corrections - corrections[0])[t > -0.1][:4000]
    assert np.abs(apart).max() < 2e-3 * np.abs(corrections).max()


@pytest.mark.parametrize(
    ("scene", "share", "changes"),
    [
        ("two_arm", 1e-4, ("motion.gravity=[0.0,-9.81]",)),
        ("two_arm", 1e-4, ('feed_forward.joints=["cart","arm1","arm2"]',)),
        ("two_arm", 1e-4, ("reduction.coordinates=8",)),
        ("three_arm", 1e-4, ()),
        ("two_arm", 1e-3, ("feed_forward.lead=0",)),
    ],
)
def test_what_is_left(scene, share, changes) -> None:
    """With gravity, joints in surplus, more coordinates, three arms, and without lead."""
    found = small(TIP, *changes, scene=scene)
    assert found.max_deviation[0] < share * found.feed_forward.before


def test_sag_out_of_the_plane_is_left():
    """The motors of a five-bar in space keep its path in the plane; what gravity bends stays."""
    found = small(TIP, scene="five_bar")
    off = np.abs(found.deviation).max(axis=0)
    assert off[:2].max() < 1e-3 * found.feed_forward.before and off[2] > 1e-3


def test_more_coordinates_keep_the_tip(moved, plain) -> None:
    """The corrections of four coordinates an arm, on the machine with eight."""
    model = Model(ROOT / "demos" / "two_arm.toml", *SMALL, "reduction.coordinates=8")
    finer = model.simulate(model.uniform(0.5)).trajectory.problem
    own = moved.problem
    machine = corrected(
        type(own)(finer.mechanism, own.path, own.breakpoints), moved.feed_forward.corrections
    )
    solution = radau.integrate(machine, 1e-4, 3, Profile())
    left = np.linalg.norm(off_path(machine, solution, moved.t), axis=1).max()
    assert left < 1e-3 * plain.max_deviation[0]


def test_table_repeats_the_run(moved, plain, tmp_path) -> None:
    """feed_forward.csv as motion.file: the same path of the tip."""
    write_feed_forward(tmp_path, moved)
    horizon = moved.sampled.t[-1]
    told = f"motion.file='{tmp_path / FILE}'", f"motion.duration={horizon}"
    again = small('motion.path="joints"', *told, f"motion.horizon={horizon}")
    t = np.linspace(moved.scene.lead, horizon, 301)
    assert np.abs(again.at(t).end - moved.at(t).end).max() < 1e-4 * plain.max_deviation[0]


def test_under_control(plain) -> None:
    """Corrected joints as desired ones and their forces known ahead: what control leaves."""
    told = 'control.feed_forward="tip"', "simulation.tolerance=1e-3", "motion.horizon=2.2"
    found = small(TIP, "control.stiffness=[1e6,2e5,1e5]", "control.damping=[2e3,5e2,2e2]", *told)
    assert found.max_deviation[0] < 1e-3 * plain.max_deviation[0]
    assert not found.solution.is_marched  # it begins from the motion that the forces are made for


def test_what_the_summary_tells(tmp_path, plain) -> None:
    """What a finer model leaves, and what drives take without feed-forward."""
    told = TIP, "simulation.tolerance=1e-3", "motion.horizon=2.0"
    scene = ROOT / "demos" / "controlled_two_arm.toml"
    without = Model(scene, *SMALL, *told[1:]).simulate().trajectory
    Model(scene, *SMALL, *told, 'control.feed_forward="tip"').simulate().save(tmp_path / "out")
    found = json.loads((tmp_path / "out" / "summary.json").read_text())["feed_forward"]
    assert found["deviation_left"] < found["deviation_left_finer"]
    assert found["deviation_left_finer"] < 0.05 * found["deviation_without"]
    assert found["deviation_without"] == pytest.approx(without.max_deviation[0], rel=1e-3)
    drives = without.drives[0][without.scene.driven_columns]
    assert [*found["drive_peak_without"].values()] == pytest.approx(drives, rel=1e-3)


def test_short_leads_are_told(moved) -> None:
    """Where the corrections would begin before the lead does; a grey design has a remedy more."""
    begin = 3.0 / slowest_unstable_rate(moved.feed_forward)
    assert begin < moved.scene.lead and not [*lead_warnings(moved, grey=True)]
    short = small(TIP, f"feed_forward.lead={0.5 * begin}")
    (told,) = lead_warnings(short, grey=False)
    assert "feed_forward.lead" in told and f"{1e3 * begin:.2g} ms" in told
    assert "design.projection" in next(lead_warnings(short, grey=True))


def test_internal_dynamics_mirror_without_damping() -> None:
    """Undamped, what the arms do while the tip is held runs backwards as well as forwards."""
    rates = internal_rates(small(TIP, "damping.stiffness_proportional=0").feed_forward)
    mirrored = np.abs(rates[:, None] + rates).min(axis=1)
    assert (mirrored < 1e-6 * np.abs(rates)).all()
    assert (rates.real > 1.0).any()  # non-minimum phase


def test_splines_rest_at_their_ends() -> None:
    splines = Splines(graded_knots((0.0, 0.1, 1.0), 0.05))
    values = splines.at(np.array([0.0, 1.0]))
    assert np.abs(values[1:]).max() < 1e-9 * np.abs(splines.at(np.array([0.5]))[2]).max()
    assert values[0].sum(axis=1) == pytest.approx([1.0, 1.0])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (("feed_forward.lead=0.1",), 'only with kind = "tip"'),
        (("feed_forward.kind=toe",), 'feed_forward.kind = "toe"'),
        ((TIP, "feed_forward.spacing=0"), "feed_forward.spacing = 0"),
        ((TIP, "feed_forward.lead=-1"), "feed_forward.lead = -1"),
        ((TIP, "feed_forward.joints=3"), "feed_forward.joints = 3"),
        ((TIP, 'feed_forward.joints=["elbow"]'), "expected drives, of cart, arm1, arm2"),
        ((TIP, 'feed_forward.joints=["arm1"]'), "expected at least 2 joints"),
        ((TIP, "control.stiffness=[1,1,1]", "control.damping=[1,1,1]"), "unless control.feed"),
    ],
)
def test_refusals(changes, words) -> None:
    with pytest.raises(InputError, match=words):
        small(*changes)


def test_singular_positions_are_named() -> None:
    """A slider-crank passes its dead centres: no joint moves the slider along the line there."""
    with pytest.raises(InputError, match="cannot move the tip along its path at t = "):
        small(TIP, scene="slider_crank")


@pytest.mark.parametrize(
    ("scene", "changes"),
    [
        ("two_arm", (*SMALL, 'feed_forward.joints=["cart","arm1","arm2"]')),
        ("spatial_arm", ("arms.cells=[12,2,2]", "design.filter_radius=0")),
    ],
)
def test_gradient_with_joints_in_surplus_and_in_space(scene, changes) -> None:
    """Along all densities against a difference, which noise leaves 5e-5 off."""
    told = TIP, "objective.gradient=exact", "objective.kind=integral_compliance"
    model = Model(ROOT / "demos" / f"{scene}.toml", *changes, *told, "simulation.tolerance=1e-7")
    slope = sum(g.sum() for g in model.gradient(model.uniform(0.5)).values())
    h = 1e-3
    values = [model.simulate(model.uniform(0.5 + s * h)).objective for s in (1, -1)]
    assert slope == pytest.approx((values[0] - values[1]) / (2.0 * h), rel=3e-4)
