"""One pass down the street: shared designs, rigid arms, own materials, frozen loads, the cost."""

import itertools
from dataclasses import fields

import numpy as np
import pytest
from remainders import beside_volume, build, built_of, rates, tip, uneven, wave
from runs import TWO_ARM, refused

import dolfinopt as do
from dolfinopt.multibody.kinematics import end_effector
from dolfinopt.responses.evaluation import analysis_of, constraint_gradients
from dolfinopt.responses.motion import motion_objective


def same(k, x, y):
    """Return the same design on every arm."""
    return wave(0, x, y)


SHARED = "arms.arm2.design=arm1"
CASES = [
    ["reduction.coordinates=5"],
    ["reduction.method=modal"],
    ["objective.kind=deviation", "objective.gradient=exact"],
    ["objective.kind=deviation"],
    ["objective.kind=integral_compliance", "objective.gradient=exact"],
    ["objective.kind=static"],
    ["objective.kind=eigenfrequency"],
    ["constraints.first_frequency=3.0", "constraints.tip_deflection=1e-6", "objective.kind=static"],
]


@pytest.mark.serial  # ranks: test_every_option_gives_the_same_bits_on_any_number_of_ranks
@pytest.mark.parametrize("overrides", CASES, ids=" ".join)
def test_a_shared_design_is_two_equal_ones(overrides):
    """The same figures, and the sum of both gradients; the work is counted in test_skip."""
    found = []
    for sharing in ([], [SHARED]):
        built = build(*overrides, *sharing)
        evaluation, trajectory = built.evaluate(built.fields(same))
        rows = [built.gradient(trajectory), *built.constraint_gradients()]
        found.append((evaluation, [np.sum([*row.values()], axis=0) for row in rows]))
    (two, two_rows), (one, one_rows) = found
    for field in fields(two):
        # Both arms' numbers are the same ones in the same order; deflections go design by design.
        if field.name not in ("constraints", "smooth_limits", "responses"):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name))
    assert set(beside_volume(one)) == set(beside_volume(two))
    assert set(one.values_of("tip_deflection")) == set(two.values_of("tip_deflection"))
    # Modes' adjoints are iterated to 1e-8, from other right sides here and there; periods go arm
    # by arm, deflections design by design.
    for j, (row, expected) in enumerate(zip(one_rows, two_rows)):
        close = (1e-12 if j else 1e-9) * np.abs(expected).max()
        np.testing.assert_allclose(row, expected, rtol=1e-7 if j else 0.0, atol=close)


RESULTS = "objective", "max_deviation"


@pytest.mark.serial  # ranks have no part in it
def test_a_rigid_arm_is_the_limit_of_stiff_ones():
    """The solid arm beside its stiffer and stiffer twin: the difference falls as 1 / E."""
    quick = ["motion.horizon=2.0", "arms.arm2.young_modulus=70e9", "simulation.tolerance=1e-6"]
    quick += ["simulation.stiffening=false"]  # the other arm bends as far as in the limit

    def solid(k, x, y):
        return np.ones(len(x)) if k == 0 else same(k, x, y)

    rigid = build("arms.arm1.rigid=true", *quick)
    limit, trajectory = rigid.evaluate(rigid.fields(same))
    gaps = []
    for factor in (30.0, 300.0):
        stiff = build(f"arms.arm1.young_modulus={factor * 70e9}", *quick)
        evaluation, moved = stiff.evaluate(stiff.fields(solid))
        gap = [getattr(evaluation, k) / getattr(limit, k) - 1.0 for k in RESULTS]
        apart = moved.at(trajectory.t).joint_forces - trajectory.joint_forces
        gap += list(np.abs(apart).max(axis=0) / np.abs(trajectory.joint_forces).max(axis=0))
        gaps.append(np.abs(gap))
    assert (gaps[1] < 2e-2).all()
    np.testing.assert_allclose(np.log10(gaps[0] / gaps[1]), 1.0, atol=0.15)


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize("overrides", [[], [SHARED], ["arms.arm1.rigid=true"]], ids=str)
@pytest.mark.parametrize("kind", ["esl", "integral_compliance", "deviation"])
def test_frozen_gradient_is_that_of_the_frozen_problem(kind, overrides):
    """Loads f_j = K q_j, modes and instants held: q_j(x) = (V' K(x) V)^-1 f_j, remainders of 2."""
    built = build(f"objective.kind={kind}", "payload.mass=1.0", *overrides)
    x = built.fields(wave)
    _, base = built.evaluate(x)
    slopes, where = built.gradient(base), motion_objective(base).load_cases(base)
    bases = {k: arm.basis for k, arm in built.arms.items()}

    def value(h, d):
        q, total = base.q_e.copy(), 0.0
        parts = zip(base.mechanism.slices, base.mechanism.bodies, built.scene.owners)
        for part, body, owner in parts:
            K = body.K
            if owner is not None:
                arm = built.arms[owner]
                arm.state(x[owner] + h * d[owner])
                K = arm.elastic.energy_matrix(bases[owner].V)
                q[:, part] = np.linalg.solve(K, body.K @ base.q_e[:, part].T).T
            e = q[where.indices, part]
            total += float(where.weights @ np.einsum("ni,ij,nj->n", e, K, e))
        if kind != "deviation":
            return total
        places = [end_effector(base.mechanism, base.motion, x) for x in (q, 0.0 * q)]
        e = np.hypot(*(places[0] - places[1]).T)
        p, share = built.scene.objective.exponent, where.weights / where.weights.sum()
        return float((share @ (e / e.max()) ** p) ** (1.0 / p) * e.max())

    assert value(0.0, x) == pytest.approx(motion_objective(base).of_motion(base), rel=1e-9)
    for direction in (uneven, tip):
        d = built.fields(direction)
        along = built.dot(slopes, d)
        if along != 0.0:
            rate = rates(lambda h, d=d: value(h, d), along, (1e-3, 2.5e-4))
            assert rate == pytest.approx(2.0, abs=0.1)


@pytest.mark.serial  # ranks have no part in it
@pytest.mark.parametrize(("kind", "designs"), [("heaviside", 1), ("robust", 3)])
def test_gradient_by_the_variables_through_a_projection(kind, designs):
    """Symmetry, filter, projection and solid ends: remainders of every design x stands for."""
    keys = "design.filter_radius=0.05", "arms.passive=0.1", "arms.symmetric=true"
    built = build("objective.kind=static", f"design.projection={kind}", *keys, cells=(24, 4))
    x, d, arms = built.fields(wave), built.fields(uneven), built.arms

    def realised(h, variant):
        moved = {k: arm.physical_designs(x[k] + h * d[k], 4.0) for k, arm in arms.items()}
        return {k: found[variant] for k, found in moved.items()}

    values = []
    for variant in range(designs):

        def value(h, variant=variant):
            x_phys = {k: one.x_phys for k, one in realised(h, variant).items()}
            return built.evaluate(x_phys)[0].objective

        values.append(value(0.0))
        slopes, here = built.gradient(), realised(0.0, variant)
        by_x = {k: arm.backward(slopes[k], here[k]) for k, arm in arms.items()}
        rate = rates(value, built.dot(by_x, d), (1e-3, 2.5e-4))
        assert rate == pytest.approx(2.0, abs=0.1)
    if kind == "robust":
        eroded, dilated, nominal = values
        assert dilated < nominal < eroded  # the more material, the stiffer


@pytest.mark.serial  # ranks have no part in it
def test_load_cases_are_the_worst_instants():
    """One an interval, found by going through all samples; the objective sums their compliance."""
    built = build("objective.load_cases=7")
    evaluation, trajectory = built.evaluate(built.fields(wave))
    compliance = trajectory.compliance.sum(axis=1)
    # 3000 samples of 1 ms after the first
    parts = [[i for i in range(1, 3001) if j * 3000 < 7 * i <= (j + 1) * 3000] for j in range(7)]
    chosen = [max(part, key=lambda i: compliance[i]) for part in parts]
    np.testing.assert_array_equal(
        motion_objective(trajectory).load_cases(trajectory).indices, chosen
    )
    assert evaluation.objective == pytest.approx(compliance[chosen].sum(), rel=1e-12)
    assert evaluation.compliance == pytest.approx(compliance[chosen].sum(), rel=1e-12)


@pytest.mark.serial  # ranks have no part in it
def test_the_frequency_bound_is_of_the_first_mode_whatever_is_followed():
    """An arm set on a mode that is not the lowest: the objective follows it, the bound does not."""
    limit = "constraints.first_frequency=1.0"
    built = build("objective.kind=eigenfrequency", "objective.follow=true", limit)
    x = built.fields(wave)
    first, _ = built.evaluate(x)
    for arm in built.arms.values():  # the second mode of both arms was the lowest once
        arm.initial_vectors = [start[:, ::-1] for start in arm.initial_vectors]
        arm.state(np.ones(arm.mesh.num_cells))
    second, _ = built.evaluate(x)
    assert second.objective < 0.5 * first.objective
    np.testing.assert_allclose(second.constraints, first.constraints, rtol=1e-9)


def with_third(value):
    return lambda x: np.where(np.arange(len(x)) == 3, value, x)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (with_third(-0.5), ("density -0.5", "cell 3")),
        (with_third(1.01), ("density 1.01", "cell 3")),
        (with_third(np.nan), ("density nan", "cell 3")),
        (lambda x: x[:-1], ("shape (71,)", "(72,)")),
        (lambda x: x[:, None], ("shape (72, 1)", "(72,)")),
    ],
    ids=["negative", "above one", "nan", "too few", "columns"],
)
def test_densities_that_are_none_are_refused(change, words):
    """On all ranks, although one alone has them."""
    built = build()
    x = built.fields(same)
    if 1 in x:
        x[1] = change(x[1])
    with refused("arm 'arm2'", *words):
        built.evaluate(x)


SPACE = TWO_ARM.parent / "spatial_arm.toml"
MOTIONS = {
    "prescribed": (TWO_ARM, ["arms.cells=[16,2]"], ["objective.kind=esl"]),
    "controlled": (TWO_ARM.parent / "controlled_two_arm.toml", ["arms.cells=[16,2]"], []),
    "closed loop": (TWO_ARM.parent / "slider_crank.toml", ["arms.rod.cells=[16,2]"], []),
    "space": (SPACE, ["arms.cells=[6,2,2]", "simulation.stiffening=false"], []),
}
LIMITED = ["constraints.deviation=0.05", "constraints.settling=0.01", "constraints.effort=1e3"]
LIMITED += ["constraints.compliance=1.0", "constraints.stress=5e7", "objective.gradient=exact"]


def seen(scene_file, *overrides):
    """Return evaluation, gradients and trajectory of the initial design."""
    built = built_of(do.load_scene(scene_file, list(overrides)))
    evaluation, trajectory = built.evaluate({k: a.uniform(0.5) for k, a in built.arms.items()})
    place = built.scene, built.partition, built.arms
    rows = [built.gradient(trajectory)]
    rows += constraint_gradients(analysis_of(*place, trajectory, built.profile))
    return evaluation, rows, trajectory


@pytest.mark.serial  # the instants belong to the root
@pytest.mark.parametrize("name", MOTIONS)
def test_no_result_depends_on_the_interval_of_the_files(name):
    """Values and gradients of every response to the bit, with two output instants and with many."""
    file, quick, asked = MOTIONS[name]
    found = []
    for sample in ("0.7e-3", "0.04"):
        options = [*quick, *asked, *LIMITED, f"simulation.sample={sample}"]
        found.append(seen(file, *options, "simulation.tolerance=1e-3"))
    (fine, fine_rows, _), (coarse, coarse_rows, trajectory) = found
    assert coarse == fine
    for one, other in zip(fine_rows, coarse_rows, strict=True):
        for k, row in one.items():
            np.testing.assert_array_equal(row, other[k])
    assert len(trajectory.sampled.t) < 0.1 * len(trajectory.t)


@pytest.mark.serial  # the trajectory belongs to one rank
def test_extremes_and_load_cases_look_every_millisecond_and_at_the_end():
    """By the definition, from the integrator's interpolant, on a horizon of no whole number."""
    overrides = ["arms.cells=[12,2]", "motion.duration=1.9003", "motion.horizon=1.9003"]
    overrides += ["simulation.sample=0.7", "objective.load_cases=7"]
    evaluation, _, trajectory = seen(TWO_ARM, *overrides)
    horizon = trajectory.scene.motion.horizon
    t = np.linspace(0.0, horizon, 1902)  # 1901 intervals, the fewest of at most 1 ms
    np.testing.assert_allclose(trajectory.t, t, rtol=1e-14)
    q = trajectory.solution.sample(t)
    energy = np.einsum("ni,ij,nj->n", q, trajectory.mechanism.stiffness(), q)
    ends = np.linspace(0.0, horizon, 8)
    expected = sum(
        energy[(t > a + 1e-9) & (t <= b + 1e-9)].max() for a, b in itertools.pairwise(ends)
    )
    assert evaluation.compliance == pytest.approx(expected, rel=1e-10)
    assert trajectory.settling == trajectory.distance[-1]  # the motion ends with the horizon
    assert len(trajectory.sampled.t) == 3  # evenly: 0, 0.7 and 1.4 s
