"""Machines linearised: closed forms, differences of the nonlinear equations, loops, files."""

import numpy as np
import pytest
from machines import controlled, loop_tree, trajectory_of, two_arm
from runs import ROOT, refusal

import dolfinopt as do
from dolfinopt.dynamics.build import free_machine, state_space
from dolfinopt.dynamics.poles import poles_of
from dolfinopt.responses.linearised_machine import accurate_below
from dolfinopt.scene.load import scene_from_dict

pytestmark = pytest.mark.serial


def machine_at(trajectory, t):
    return free_machine(trajectory, t)


def accelerations(one, x):
    """Return z'' (n,) for independent coordinates and rates x (2 n,), by the equations alone."""
    system, instants = one.system, one.system.at(one.t)
    _, moving, last = system.ends
    every = np.concatenate([np.arange(moving), np.arange(last, system.num_coordinates)])
    dependent = np.flatnonzero(~system.drives.driven) if system.loops else np.zeros(0, dtype=int)
    independent = np.setdiff1d(every, dependent)
    y, yd, rest = (x * one.rates[k, None] for k, x in enumerate((1.0, 1.0, 0.0)))
    n = len(independent)
    y[0, independent], yd[0, independent] = x[:n], x[n:]

    def jacobian(y, yd):
        state = instants.state(y, yd, rest)
        here, speeds = state.closed, np.hstack([state.motion.qd, state.elastic[1]])[0]
        bias = [
            speeds @ here.hessian(one[None])[0] @ speeds for one in np.eye(len(here.jacobian[0]))
        ]
        return here.jacobian[0][:, system.columns], np.array(bias)

    if system.loops is not None:
        for _ in range(8):
            gap = instants.state(y, yd, rest).closed.gap[0]
            y[0, dependent] -= np.linalg.solve(jacobian(y, yd)[0][:, dependent], gap)
        J = jacobian(y, yd)[0]
        free = np.setdiff1d(np.arange(moving), dependent)
        swept = J[:, free] @ yd[0, free]
        swept += J[:, : system.ends[0]] @ instants.desired.qd[0, system.drives.free]
        yd[0, dependent] = -np.linalg.solve(J[:, dependent], swept)
    # The residual is linear in y''; multipliers stand there, too. What the simulation leaves at
    # the instant itself, forces of free drives above all, is an input that is held.
    r = instants.residual(y, yd, rest)[0] - instants.residual(*one.rates[:, None])[0]
    units = np.eye(system.num_coordinates)
    matrix = np.stack([instants.residual(y, yd, u[None])[0] for u in units], axis=1)
    matrix -= instants.residual(y, yd, rest)[0][:, None]
    if system.loops is not None:
        (J, bias), ydd = jacobian(y, yd), one.rates[2, :moving]
        J0, bias0 = jacobian(*one.rates[:2, None])
        desired = instants.desired.qdd[0, system.drives.free]
        size = len(desired)
        matrix[moving:last, :moving] = J
        r[moving:last] = bias - bias0 - J0 @ ydd + (J - J0)[:, :size] @ desired
    return np.linalg.solve(matrix, -r)[independent]


def open_two_arm():
    return trajectory_of(scene_from_dict(two_arm("arms.cells=[16,2]", "motion.gravity=[0,-9.81]")))


def soft_two_arm():
    soft = {"joint_stiffness": 3e4, "joint_damping": 30.0, "rotor_inertia": 2e-5}
    changes = [f"arms.{key}={value}" for key, value in (*soft.items(), ("gear_ratio", 100.0))]
    return trajectory_of(controlled(*changes, "simulation.stiffening=true"))


def geared_two_arm():
    """Return arms on gears and bearings, with friction, whose drives nothing controls."""
    keys = {"gear_stiffness": 3e4, "gear_damping": 30.0, "rotor_inertia": 2e-5, "gear_ratio": 100.0,
            "bearing_stiffness": [1e7, 1e7, 0, 0, 0, 0], "friction": [5.0, 2.0]}  # fmt: skip
    changes = [f"arms.{key}={value}" for key, value in keys.items()]
    changes += ["motion.cart_mass=5.0"]  # a cart without mass before a bearing has no acceleration
    return trajectory_of(scene_from_dict(two_arm("arms.cells=[16,2]", *changes)))


def slider(**tables):
    return trajectory_of(scene_from_dict(loop_tree(**tables, simulation={"tolerance": 1e-6})))


MACHINES = {
    "open, two arms": (open_two_arm, 0.8),
    "closed, two arms": (lambda: trajectory_of(controlled("motion.gravity=[0,-9.81]")), 0.8),
    "closed, motors behind springs": (soft_two_arm, 0.5),
    "open, gears, bearings and friction": (geared_two_arm, 0.7),
    "open, slider-crank": (slider, 0.03),
    "closed, slider-crank": (
        lambda: slider(control={"stiffness": [2e3], "damping": [20.0]}), 0.07
    ),
    "closed, four-bar": (
        lambda: slider(kind="pin", control={"stiffness": [2e3], "damping": [20.0]}), 0.06
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", MACHINES)
def test_matrix_is_the_derivative_of_the_nonlinear_equations(kind):
    """By central differences of accelerations that are solved for, loops closed anew each time."""
    make, t = MACHINES[kind]
    trajectory = make()
    found, one = state_space(trajectory, t), machine_at(trajectory, t)
    independent = one.independent
    x = one.rates[:2, independent].ravel()
    n = len(independent)
    # By the coordinates' own masses, so that a step, and what it does, is J^(1/2).
    scale = np.sqrt(np.abs(np.diag(one.M)[independent]))
    columns = []
    chosen = np.random.default_rng(1).permutation(2 * n)[:8]  # all of them take four times as long
    for k in chosen:
        step = np.zeros(2 * n)
        step[k] = 1e-5 / scale[k % n]
        ends = [accelerations(one, x + sign * step) for sign in (1.0, -1.0)]
        columns.append((ends[0] - ends[1]) / (2.0 * step[k]))
    differences = scale[:, None] * np.stack(columns, axis=1)
    exact = scale[:, None] * found.A[n:, chosen]
    assert np.array_equal(found.A[:n], np.eye(n, 2 * n, n))
    size = np.maximum(np.abs(exact).max(axis=0), 1e-9 * np.abs(exact).max())
    assert (np.abs(exact - differences).max(axis=0) / size).max() < 3e-5


def test_inputs_and_outputs_answer_each_other():
    """Places move by what forces there do: the gains of tool and drives are symmetric."""
    # Without control and motion the machine is conservative.
    found = state_space(open_two_arm(), 0.0)
    s = 3.0
    gain = found.C @ np.linalg.solve(s * np.eye(len(found.A)) - found.A, found.B)
    block = gain[:5, :5]  # cart, two joints, tool x and y by the forces there
    assert np.abs(block - block.T).max() < 1e-3 * np.abs(block).max()


def test_least_damping_follows_the_control():
    """More derivative gain, more damping; the limit is met or not, and told so."""
    ratios = []
    for factor in (0.5, 1.0):
        scene = controlled(f"control.damping_factor={factor}", "constraints.damping_ratio=0.05")
        result = do.Model(scene).simulate()
        again = result.state_space(1.0)
        assert again is not None and np.array_equal(again.A, state_space(result.trajectory, 1.0).A)
        poles = [
            poles_of(machine_at(result.trajectory, t)).values
            for t in scene.constraints.pole_instants(scene.motion)
        ]
        every = np.concatenate(poles)
        (measured,) = result.evaluation.values_of("damping_ratio")
        assert measured == pytest.approx((-every.real / np.abs(every)).min(), rel=1e-9)
        assert (result.evaluation.constraints[-1] <= 0.0) == (measured >= 0.05)
        ratios.append(measured)
    assert ratios[1] > 1.2 * ratios[0]


# -- closed loops of rigid arms, linearised by hand ------------------------------------------------


def of_second_order(M, D, K):
    """Return the poles (2 n,) of M z'' + D z' + K z = 0, sorted."""
    n = len(M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    return np.sort_complex(np.linalg.eigvals(A))


def bar(name, length):
    """Return a rigid arm in space that weighs nothing."""
    return {"name": name, "rigid": True, "length": length, "mass": 0.0, "inertia": [0.0] * 6}


def test_poles_of_a_loop_in_the_plane():
    """A slider-crank in motion: (J + m x'^2) of its angle, with the slider's place x."""
    J, m, r, rod = 0.01, 0.5, 0.15, 0.3
    tree = loop_tree(control={"stiffness": [2e3], "damping": [20.0]}, payload={"mass": m})
    tree["arms"] = [
        {**tree["arms"][0], "inertia": J},
        {**tree["arms"][1], "rigid": True, "mass": 0.0, "inertia": 0.0},
    ]
    trajectory = trajectory_of(scene_from_dict(tree))
    motion = trajectory.at(np.array([0.03])).motion
    angle, speed, rate = (float(x[0, 1]) for x in (motion.q, motion.qd, motion.qdd))

    def inertia(z):
        slope = -r * np.sin(z) - r * r * np.sin(z) * np.cos(z) / np.sqrt(
            rod * rod - r * r * np.sin(z) ** 2
        )
        return J + m * slope**2

    h = 1e-3
    before, here, after = (float(inertia(angle + k * h)) for k in (-1.0, 0.0, 1.0))
    slope, curvature = (after - before) / (2.0 * h), (after - 2.0 * here + before) / (h * h)
    exact = of_second_order(
        np.array([[here]]),
        np.array([[20.0 + slope * speed]]),
        np.array([[2e3 + slope * rate + 0.5 * curvature * speed**2]]),
    )
    found = np.sort_complex(state_space(trajectory, 0.03).poles)
    assert np.abs(found - exact).max() < 1e-5 * np.abs(exact).max()  # of the differences


# -- how many coordinates the poles need -----------------------------------------------------------


def largest_error(poles, exact, below, slowest):
    """Return the largest relative distance of a pole below a frequency, Hz, from its partner."""
    found = [0.0]
    for one, other in ((poles, exact), (exact, poles)):
        for pole in one[np.abs(one) < 2.0 * np.pi * below]:
            found.append(np.abs(pole - other).min() / max(abs(pole), slowest))
    return max(found)


@pytest.mark.parametrize(
    ("name", "t", "below", "many"),
    [("controlled_two_arm", 1.0, 500.0, 24), ("spatial_arm", 0.3, 100.0, 16),
     ("four_bar", 0.1, 1000.0, 20)],
)  # fmt: skip
def test_poles_hold_what_is_said(name, t, below, many):
    """Of the demos, one a loop, against far more coordinates: as they are, and as asked for."""
    coarse = ["arms.cells=[20,4,4]"] if name == "spatial_arm" else []
    model = do.Model(ROOT / "demos" / f"{name}.toml", *coarse)
    exact = do.Model(model.scene, f"reduction.coordinates={many}").simulate().state_space(t).poles
    slowest = 1.0 / model.scene.motion.horizon
    few, enough = model.state_space(t), model.state_space(t, below=below)
    assert few.accurate_below < below <= enough.accurate_below
    for found in (few, enough):
        assert largest_error(found.poles, exact, found.accurate_below, slowest) < 0.01
        # Some pole is no better above.
        assert largest_error(found.poles, exact, np.inf, slowest) > 0.01
    assert len(few.poles) < len(enough.poles) < len(exact)


def test_as_many_coordinates_as_there_are(monkeypatch):
    """Of few cells all poles are those of the finite elements; far too many are not tried."""
    few = two_arm("arms.cells=[8,2]", "arms.passive=0", "design.filter_radius=0")
    assert do.Model(scene_from_dict(few)).state_space(1.0, below=1e9).accurate_below == np.inf
    monkeypatch.setattr("dolfinopt.responses.linearised_machine.COORDINATES_LIMIT", 6)
    with pytest.raises(do.ConvergenceError, match=r"--below 1e.09: with 6 coordinates"):
        do.Model(scene_from_dict(few)).state_space(1.0, below=1e9)


def test_frequency_below_which_poles_are_pairs():
    """The first one that is 0.5 % off, in either set; near zero they are measured by a rate."""
    exact = np.array([1e-4, -1.0 + 99.0j, -200.0, 300.0j])
    assert accurate_below(exact, exact, 1.0) == np.inf
    for changed, first in (
        ([-1e-3, *exact[1:]], np.inf), ([1e-4, -1.0 + 98.0j, *exact[2:]], 98.0051),
        ([*exact[:2], -201.5, 300j], 200.0), (exact[:3], 300.0), ([*exact, 150.0], 150.0),
    ):  # fmt: skip
        found = accurate_below(np.array(changed), exact, 1.0)
        assert found == pytest.approx(0.99 * first / (2.0 * np.pi), rel=1e-5)


def test_instant_within_the_motion():
    refusal(lambda: state_space(open_two_arm(), 4.0), "4 s", "motion.horizon = 3")
