"""The choice of coordinates: what the estimate is worth, and that every use of a scene keeps it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from mpi4py import MPI
from remainders import Built, build, wave
from runs import TWO_ARM, overrides, refused, run, summary_of

import dolfinopt as do
from dolfinopt.cli.shared import scene_of
from dolfinopt.dynamics.build import simulate
from dolfinopt.optimization import assessment, measured
from dolfinopt.output.run_folder import write_result
from dolfinopt.responses import order_selection as coordinates
from dolfinopt.responses.order_selection import Comparison, Reductions

WORLD = MPI.COMM_WORLD
AUTO = 'reduction.coordinates="auto"'
SHORT = "motion.horizon=1.9"


def auto(*overrides, tolerance=1e-2, cells=(24, 3)):
    linear = "simulation.stiffening=false"  # what is estimated here is the number of modes alone
    reduced = f"reduction.coordinates={tolerance}"
    return build(reduced, SHORT, linear, *overrides, cells=cells)


def error(built, x, count):
    return Comparison(Reductions(*built.place, x, built.profile)).error(count)


def choose(built, x):
    choice = do.choose_coordinates(built.scene, built.partition, built.arms, x, built.profile)
    assert choice is not None
    return choice


def clouds(seed, crisp):
    """Return smooth random densities in [0.1, 1], or void and solid, as a function of place."""

    def field(k, x, y):
        rng = np.random.default_rng([seed, k])
        total = np.zeros_like(x)
        for _ in range(12):
            along, across, phase = rng.uniform((2.0, -60.0, 0.0), (40.0, 60.0, 7.0))
            total += rng.normal() * np.cos(along * x + across * y + phase)
        grey = 0.55 + 0.45 * np.tanh(total / 3.0)
        # Solid edges, so that what a crisp design carries does not hang in void.
        edge = np.abs(y) > 0.02
        return np.where((grey > 0.55) | edge, 1.0, 0.1) if crisp else grey

    return field


DESIGNS = {
    "uniform": lambda k, x, y: np.full_like(x, 0.5),
    "wave": wave,
    "random 1": clouds(1, False),
    "random 2": clouds(2, False),
    "crisp 3": clouds(3, True),
    "crisp 4": clouds(4, True),
}
CELLS = (30, 4)
# Vibrations near resonance, whose errors a static estimate would miss.
SHAKEN = ("damping.stiffness_proportional=1e-5", "payload.mass=2", "motion.duration=1.2")


def moved(built, count, method):
    """Return scene and arms by a number of coordinates, to be integrated more finely."""
    data = built.scene.to_dict()
    data["reduction"] |= {"coordinates": count, "method": method}
    data["simulation"]["tolerance"] = 3e-5
    scene = do.scene_from_dict(data)
    return scene, {k: arm.under(scene) for k, arm in built.arms.items()}


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize(
    ("name", "method", "overrides"),
    [
        *(("wave", method, ()) for method in ("modal", "krylov", "balanced")),
        *(pytest.param(name, "craig-bampton", (), marks=pytest.mark.slow) for name in DESIGNS),
        ("uniform", "craig-bampton", SHAKEN),
    ],
)
def test_estimate_is_the_error(name, method, overrides):
    """Node by node, the energy of what two motions differ by: against 48 coordinates."""
    # Those that the estimate compares with, 24, leave less than a tenth of what 4 do.
    built = auto(f"reduction.method={method}", *overrides, cells=CELLS)
    x = built.fields(DESIGNS[name])
    estimate = error(built, x, 4)
    motions, fields = [], []
    for kind, count in ((method, 4), ("craig-bampton", 48)):
        scene, arms = moved(built, count, kind)
        motions.append(simulate(scene, [arm.reduce(x[k]) for k, arm in arms.items()], do.Profile()))
        fields.append({k: arm.basis.V for k, arm in arms.items()})
    worst = []
    for k, arm in built.arms.items():
        u, richer = (
            V[k] @ one.q_e[::5, one.mechanism.slices[k]].T for V, one in zip(fields, motions)
        )
        norms = [
            np.sqrt(np.sum(w * arm.elastic.stiffness_times(w), axis=(0, 1)).max())
            for w in (u - richer, richer)
        ]
        worst.append(norms[0] / norms[1])
    # Every fifth instant finds the maxima to some percent.
    assert estimate == pytest.approx(max(worst), rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "tolerance"),
    [
        ([], 1e-2),
        (["arms.arm1.rigid=true"], 1e-3),
        ([], 3e-4),
        (["reduction.method=krylov", "reduction.shifts=[0.0,20.0]"], 1e-3),
        (["reduction.method=balanced"], 1e-2),
        (["reduction.method=modal"], 0.4),
    ],
)
def test_fewest_that_meet_the_tolerance(overrides, tolerance):
    built = auto(*overrides, tolerance=tolerance)
    x = built.fields(lambda k, *at: wave(0, *at))
    choice = choose(built, x)
    assert choice.error == dict(choice.tried)[choice.coordinates] <= tolerance
    # Beside a basis that may be richer: the richer one for many coordinates is kept.
    assert choice.error == pytest.approx(error(built, x, choice.coordinates), rel=0.1)
    fewest = built.scene.reduction.fewest
    if choice.coordinates > fewest:
        assert dict(choice.tried)[choice.coordinates - 1] > tolerance
    assert [count for count, _ in choice.tried] == sorted({count for count, _ in choice.tried})
    for k, arm in built.arms.items():
        assert arm.reduce(x[k]).num_modes == choice.coordinates


def test_a_given_number_costs_nothing():
    built = build("reduction.coordinates=5", SHORT)
    before = replace(built.profile.counts)
    place = built.scene, built.partition, built.arms, built.fields(wave), built.profile
    assert do.choose_coordinates(*place) is None
    assert built.profile.counts == before
    assert all(arm.coordinates == 5 and arm.basis is None for arm in built.arms.values())


def test_none_is_enough(monkeypatch):
    monkeypatch.setattr(coordinates, "COORDINATES_LIMIT", 6)
    built = auto("reduction.method=modal", tolerance=1e-3)
    words = "up to 6 coordinates", "above 0.001"
    with refused(*words, error=do.ConvergenceError):
        choose(built, built.fields(wave))


def test_unresolved():
    """Nothing takes an error for a number."""
    built = auto()
    for k, arm in built.arms.items():
        with refused("reduction.coordinates = ", "choose_coordinates"):
            arm.reduce(built.fields(wave)[k])


def small(*overrides, iterations=3):
    settings = ["arms.cells=[24,3]", "motion.horizon=1.9", f"optimizer.max_iterations={iterations}"]
    return do.load_scene(TWO_ARM, (*settings, "reduction.coordinates=0.01", *overrides))


@pytest.mark.serial  # ranks: test_any_number_of_ranks
def test_optimises_with_the_choice():
    """As with the number; the choice is looked at again in the end."""
    found = do.optimize(small())
    count = found.choice.coordinates
    same = do.optimize(small(f"reduction.coordinates={count}"))
    assert same.choice is None
    for k in found.x_phys:
        np.testing.assert_array_equal(found.x_phys[k], same.x_phys[k])
    assert dict(found.choice.tried)[count] <= 0.01 / measured.COORDINATE_RESERVE_FACTOR
    built = Built(small(), found.partition, dict(found.arms), do.Profile())
    assert found.choice.error == error(built, found.x_phys, count)
    assert found.choice.error != dict(found.choice.tried)[count]


@pytest.mark.serial  # ranks: test_any_number_of_ranks
def test_resumes_in_the_same_bits(shared_tmp_path):
    whole = do.optimize(small(iterations=2))
    do.optimize(small(iterations=1), shared_tmp_path)
    resumed = do.optimize(small(iterations=2), shared_tmp_path, resume=True)
    assert resumed.choice == whole.choice
    assert str(resumed.evaluation) == str(whole.evaluation)
    for k in whole.x_phys:
        np.testing.assert_array_equal(resumed.x_phys[k], whole.x_phys[k])


def test_without_a_motion_the_final_design_decides():
    """Nothing is simulated before the iterations end."""
    found = do.optimize(small("objective.kind=static"))
    assert found.counts.simulations == 0
    assert found.choice.error == dict(found.choice.tried)[found.choice.coordinates] <= 0.01


@pytest.mark.skipif(WORLD.size == 1, reason="needs more than one rank")
def test_any_number_of_ranks():
    together = do.optimize(small(iterations=1))
    alone = do.optimize(small(iterations=1), world=MPI.COMM_SELF)
    assert together.choice == alone.choice
    assert str(together.evaluation) == str(alone.evaluation)


def test_summary_warns_of_too_few(monkeypatch, shared_tmp_path):
    known = SimpleNamespace(error=lambda count: 0.02)
    monkeypatch.setattr(assessment, "Comparison", lambda *_: known)
    scene = small(iterations=1)
    summary = write_result(shared_tmp_path, do.optimize(scene), 1.0, paraview=False)
    if summary is not None:
        assert summary["reduction"]["error_estimate"] == 0.02
        (warning,) = (w for w in summary["warnings"] if "filter" not in w)
        assert "estimated error of 0.02, above 0.01" in warning


@pytest.mark.serial
def test_commands(tmp_path, capsys):
    """Each says what it chose; a picture drawn anew takes the number from the summary."""

    def said(*words):
        run(*words, *overrides("arms.cells=[24,3]", AUTO))
        return capsys.readouterr().out

    sentence = "reduction: "
    assert sentence in said("simulate", TWO_ARM, "--no-plots", "--out", tmp_path / "s")
    summary = summary_of(tmp_path / "s")
    found = summary["reduction"]
    assert found["error_estimate"] <= 1e-3
    assert summary["scene"]["reduction"]["coordinates"] == "auto"
    assert found["tried"][0]["coordinates"] == 3
    with np.load(tmp_path / "s" / "trajectory.npz") as data:
        assert data["q_e"].shape[1] == 2 * found["coordinates"]
    chosen = f"{sentence}{found['coordinates']} "
    assert chosen in said("export", TWO_ARM, "--out", tmp_path / "e")
    assert sentence in said("gradient", TWO_ARM, "--out", tmp_path / "g.npz")
    assert scene_of(tmp_path / "s").reduction.coordinates == found["coordinates"]
