"""Extremes: every outcome is right by an independent path, or one of the two named errors."""

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
from machines import distance
from remainders import arm_of, build, uneven, wave
from runs import TWO_ARM, overrides, run, summary_of

import dolfinopt as do
from dolfinopt.dynamics import radau
from dolfinopt.dynamics.system import relative_error
from dolfinopt.errors import ConvergenceError
from dolfinopt.fem.interface import rounding_error
from dolfinopt.multibody.newton_euler import inverse_dynamics
from dolfinopt.reduction.eigenproblem import Pencil, lowest_eigenpairs

pytestmark = pytest.mark.serial  # one rank shows all there is

EXTENDED = pytest.mark.skipif(
    np.finfo(np.longdouble).eps > 1e-18, reason="long double is no longer than double here"
)


def alone(*overrides, cells=(16, 3)):
    """Build the two-arm scene on few cells."""
    return build("simulation.stiffening=false", *overrides, cells=cells)


def one_arm(*overrides, cells=(12, 3)):
    """Build the first arm of that scene."""
    return arm_of(cells, "simulation.stiffening=false", *overrides)


DESIGNS = {
    "solid": lambda k, x, y: np.ones_like(x),
    "void": lambda k, x, y: np.zeros_like(x),
    # By lot, in the same places on any partition.
    "checkerboard": lambda k, x, y: 1.0 * (uneven(k, np.round(x, 6), np.round(y, 6)) > 0.0),
    "tip cut off": lambda k, x, y: np.where(x > 0.8, 0.0, 1.0),
    "gap": lambda k, x, y: np.where(np.abs(x - 0.5) < 0.05, 0.0, 1.0),
    "islands": lambda k, x, y: 1.0 * (np.floor(12.0 * x) % 2.0 == 0.0),
}


def windows(arm, count, density):
    """Return a frame with equal windows."""
    x, y = arm.mesh.centroid.T / arm.mesh.outboard_point[0]
    place = (x * count) % 1.0
    half = 0.5 * arm.scene.arms[0].height
    inside = (np.abs(y) < 0.55 * half) & (place > 0.15) & (place < 0.85)
    return np.where(inside, density, 1.0)


def quadrilateral(a, b, nu):
    """Return the plane stress matrix (8, 8) of a rectangle a by b, E = t = 1, in long double."""
    # Incompatible modes (QM6), which are orthogonal on a rectangle. Nodes (0, 0), (a, 0), (0, b),
    # (a, b); its null space is that of a rigid body to 1e-19.
    one = np.longdouble(1.0)
    nu, a, b = one * nu, one * a, one * b
    C = np.array([[1, nu, 0], [nu, 1, 0], [0, 0, (1 - nu) / 2]], dtype=np.longdouble) / (1 - nu**2)
    K = np.zeros((12, 12), dtype=np.longdouble)
    g = 1 / np.sqrt(3 * one)
    for s in (-g, g):
        for r in (-g, g):
            dx = np.array([-(1 - r), 1 - r, -(1 + r), 1 + r]) / (2 * a)
            dy = np.array([-(1 - s), -(1 + s), 1 - s, 1 + s]) / (2 * b)
            B = np.zeros((3, 12), dtype=np.longdouble)
            dx, dy = np.append(dx, [-4 * s / a, 0]), np.append(dy, [0, -4 * r / b])
            B[0, 0::2], B[1, 1::2], B[2, 0::2], B[2, 1::2] = dx, dy, dy, dx
            K += a * b / 4 * B.T @ C @ B
    return K[:8, :8] - (K[:8, 8:] / np.diag(K)[8:]) @ K[8:, :8]


def exact_compliance(arm):
    """Return S^-1 (3, 3) of a rectangular arm from a dense factorisation in long double."""
    keys = arm.scene.arms[0]
    (nx, ny), length, height = keys.cells, keys.length, keys.height
    element = keys.thickness * quadrilateral(length / nx, height / ny, arm.solid.poisson_ratio)
    x, y = arm.mesh.centroid.T
    column, row = (x / length * nx).astype(int), ((y / height + 0.5) * ny).astype(int)
    node = column * (ny + 1) + row
    nodes = node[:, None] + np.array([0, ny + 1, 1, ny + 2])
    dofs = (2 * nodes[:, :, None] + np.arange(2)).reshape(len(nodes), 8)
    size = 2 * (nx + 1) * (ny + 1)
    K = np.zeros((size, size), dtype=np.longdouble)
    young = arm.elastic.young.astype(np.longdouble)
    for where, scale in zip(dofs, young, strict=True):
        K[np.ix_(where, where)] += scale * element
    edge = 2 * (ny + 1)
    interior = np.arange(edge, size - edge)
    T = np.zeros((size, len(interior) + 3), dtype=np.longdouble)
    T[interior, np.arange(len(interior))] = 1.0
    heights = np.linspace(-0.5, 0.5, ny + 1) * height
    T[size - edge :: 2, -3] = 1.0
    T[size - edge + 1 :: 2, -2] = 1.0
    T[size - edge :: 2, -1] = -heights
    A = T.T @ (K @ T)
    n = len(A)
    for k in range(n):  # Cholesky's lower triangle in place
        A[k:, k] /= np.sqrt(A[k, k])
        A[k + 1 :, k + 1 :] -= np.outer(A[k + 1 :, k], A[k + 1 :, k])
    L = np.tril(A[-3:, -3:]).astype(float)  # the interface comes last: S = L L'
    inverse = np.linalg.inv(L)
    return inverse.T @ inverse


def compliance_error(arm):
    """Return the largest relative error of S^-1 under any load."""
    found = np.linalg.inv(arm.elastic.constraint_modes.stiffness)
    exact = exact_compliance(arm)
    inverse = np.linalg.inv(np.linalg.cholesky(exact))
    return float(np.linalg.norm(inverse @ (found - exact) @ inverse.T, 2))


@EXTENDED
@pytest.mark.parametrize("name", DESIGNS)
def test_contrast(name):
    """Voids of 1e-3 to 1e-24 of solid: right to 4e-3, or an error that names the remedy."""
    # Nothing that hangs together, or floats in a void of 1e-9 and more, is refused. Where solids
    # float, the bound of rounding exceeds the error.
    for law, power in (("two-material", 1.0), ("simp", 2.0)):
        for floor in (1e-3, 1e-9, 1e-10, 1e-12):
            arm = one_arm(f"interpolation.law={law}", f"interpolation.floor={floor}")
            arm.state(DESIGNS[name](0, *arm.mesh.centroid.T))
            contrast = floor**power
            try:
                error = compliance_error(arm)
            except ConvergenceError as refusal:
                assert "interpolation.floor" in str(refusal) and "\n" not in str(refusal)
                assert contrast < 0.9e-9
                continue
            # Rounding of the element matrices holds floating solids with 1e-16 of their stiffness:
            # 2e-14 to 1.3e-13 over the contrast, by OpenBLAS' kernels; 2.2e-13 on Debian 13.
            floating = name not in ("solid", "void", "tip cut off")
            if floating:
                assert error < rounding_error(arm.elastic, arm.elastic.constraint_modes)
            assert error < (max(1e-8, 4e-13 / contrast) if floating else 1e-8)
            assert error < 4e-3  # a hundredth of the bound from which on designs are refused


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -1.0])
def test_a_stiffness_that_is_none_is_named(monkeypatch, wrong):
    """Neither NaN nor a negative stiffness ends in an error of linear algebra."""
    arm = one_arm("interpolation.floor=1e-9")
    for field in ("solid", "islands"):
        arm.state(DESIGNS[field](0, *arm.mesh.centroid.T))
        with monkeypatch.context() as patch:
            patch.setattr(arm.elastic, "energy_matrix", lambda u: np.full((3, 3), wrong))
            with pytest.raises(ConvergenceError, match=r"interpolation\.floor"):
                _ = arm.elastic.constraint_modes


@EXTENDED
@pytest.mark.parametrize(
    ("height", "cells"),
    [
        *[(1.0, (5, 5)), (2.0, (4, 8)), (0.1, (1, 1)), (0.06, (1, 4)), (0.06, (2, 1))],
        *[(0.01, (30, 2)), (1e-3, (40, 1)), (1e-4, (40, 1)), (0.06, (40, 1)), (0.06, (2, 30))],
    ],
)
def test_shapes(height, cells):
    """Arms of aspect 1/2 to 1e4, cells of 1/50 to 200: statics right to what K's digits allow."""
    # Bending stiffness is (height / length)^2 of the axial one: 1e-8 at 1e4. A cell that bends has
    # (height / length)^2 of the stiffness to its shear, which its matrix is the difference of. At
    # an aspect of 1e4 one digit is left: 0.02 to 0.18 of error, by the rounding of the design.
    arm = one_arm(f"arms.height={height}", "reduction.coordinates=3", cells=cells)
    arm.state(np.full(arm.mesh.num_cells, 0.7))
    slender = height / cells[1] * cells[0]  # height over length of a cell
    assert compliance_error(arm) < max(1e-9 / min(height, 1.0), 5e-14 / (slender * height) ** 2)


def dense_eigenvalues(arm, count):
    """Return the lowest eigenvalues of the interior: the largest of L^-1 M L^-T, K = L L'."""
    pencil, unit = Pencil(arm), np.eye(arm.num_interior)
    K, M = pencil.stiffness(unit), pencil.mass(unit)
    return 1.0 / scipy.linalg.eigh(M, K, eigvals_only=True)[: -count - 1 : -1]


@pytest.mark.parametrize(
    ("count", "density", "floor"), [(5, 1e-3, 1e-6), (6, 1e-6, 1e-12), (10, 1e-5, 1e-12)]
)
def test_equal_windows(count, density, floor):
    """Bundles of modes, equal to 1e-7 or to 1e-13: none fails, none of them is passed over."""
    arm = one_arm("interpolation.law=simp", f"interpolation.floor={floor}", cells=(40, 6))
    arm.state(windows(arm, count, density))
    elastic = arm.elastic
    M = Pencil(elastic).mass(np.eye(elastic.num_interior))
    exact = dense_eigenvalues(elastic, 12)
    assert exact[1] / exact[0] - 1.0 < 1e-6
    for modes in (1, 2, 3, 4, 6, 9, 12):
        values, vectors = lowest_eigenpairs(Pencil(elastic), modes, None)
        # Contrasts of 1e-9 to 1e-15 leave so many digits in the dense eigenvalues.
        np.testing.assert_allclose(values, exact[:modes], rtol=1e-7)
        gram = vectors.T @ M @ vectors
        np.testing.assert_allclose(gram, np.eye(modes), atol=1e-10)
        # From modes of a nearby design, too, of which there may be as many or fewer.
        for start in (vectors, vectors[:, :1], vectors[:, ::-1]):
            warm, _ = lowest_eigenpairs(Pencil(elastic), modes, start)
            np.testing.assert_allclose(warm, exact[:modes], rtol=1e-7)


def moved(*overrides, field=DESIGNS["solid"], cells=(12, 2)):
    """Simulate."""
    built = alone(*overrides, cells=cells)
    _, trajectory = built.evaluate(built.fields(field), simulated=True)
    assert trajectory is not None
    return trajectory


@pytest.mark.slow
@pytest.mark.parametrize(
    "overrides",
    [
        ["motion.duration=0.2", "motion.horizon=0.3"],
        ["motion.duration=20.0", "motion.horizon=22.0", "simulation.sample=0.01"],
        ["payload.mass=0.0"],
        ["payload.mass=1e3", "motion.horizon=1.9"],  # deflections of 46 % of the length
        ["payload.inertia=1e3"],
        ["material.young_modulus=2e9"],  # 21 %
        ["material.young_modulus=1.5e9", "motion.horizon=1.9"],  # 28 %
        ["material.density=1e-6"],
        ["damping.stiffness_proportional=0.0"],
        ["damping.stiffness_proportional=1.0"],
        ["damping.stiffness_proportional=1e3"],
        ["motion.joint_height=-0.9999", "motion.horizon=1.9"],  # 1e-4 m from stretched
        # Folded.
        ["motion.radius=1e-4", "motion.joint_height=0", "motion.cart_follow=0", "motion.horizon=2"],
        ["motion.gravity=[0.0,-9.81]"],
    ],
    ids=" ".join,
)
def test_motions(overrides):
    """The tolerance is met, measured by a method of other order on other, finer steps."""
    trajectory = moved(*overrides)
    fine = radau.integrate(trajectory.problem, 1e-5, 5, do.Profile())
    assert np.isfinite(trajectory.deviation).all() and np.isfinite(trajectory.joint_forces).all()
    assert distance(trajectory.problem, trajectory.solution, fine, 5000) < 1.1e-4


def quasi_static(problem, t):
    """Return K^-1 (- rows of the undeformed mechanism) at instants t."""
    rest = np.zeros((len(t), problem.mechanism.num_coordinates))
    rows = inverse_dynamics(problem.mechanism, problem.motion(t), rest, rest, rest)[0]
    return -np.linalg.solve(problem.mechanism.stiffness(), rows.T).T


@pytest.mark.parametrize("young_modulus", [1e14, 1e15])
def test_stiff_arms_follow_their_loads(young_modulus):
    """q + beta qd is the static deflection, off by (slowest frequency x time of the motion)^-2."""
    times = ["motion.duration=0.5", "motion.horizon=0.5"]
    trajectory = moved(f"material.young_modulus={young_modulus}", *times)
    t = np.linspace(0.0, 0.5, 1001)
    solution = trajectory.solution
    q = solution.sample(t) + 2e-4 * solution.sample(t, 1)
    static = quasi_static(trajectory.problem, t)
    assert relative_error(trajectory.mechanism, q - static, static) < 2e-4 + 6e11 / young_modulus


MILLIMETRES = [  # mm, t, s, N
    *("material.young_modulus=70e3", "material.density=2.7e-9", "payload.mass=6e-3"),
    *("arms.length=1000.0", "arms.height=60.0", "arms.thickness=10.0", "design.filter_radius=7.5"),
    *("motion.radius=1000.0", "motion.joint_height=-500.0"),
]


@pytest.mark.parametrize(
    ("overrides", "in_metres", "in_millimetres"),
    [
        ([], ["motion.gravity=[0.5,-9.81]"], ["motion.gravity=[500.0,-9810.0]"]),
        (["objective.gradient=exact"], ["payload.inertia=0.01"], ["payload.inertia=10.0"]),
        (["reduction.method=modal"], [], []),
        (["reduction.method=krylov", "reduction.coordinates=8"], [], []),
        (["reduction.method=balanced", "reduction.coordinates=6"], [], []),
        (["objective.kind=eigenfrequency"], [], []),
        (["objective.kind=deviation", "objective.gradient=exact"], [], []),
        (["objective.kind=static"], *(
            [f"objective.loads=[[0.0,1.0,0.0],[0.0,0.0,{unit}]]"] for unit in (1.0, 1000.0)
        )),
    ],
    ids=str,
)  # fmt: skip
def test_millimetres_and_tonnes(overrides, in_metres, in_millimetres):
    """The same figures as in metres and kilograms, to what Newton's iteration leaves."""
    found = []
    for own in (in_metres, [*MILLIMETRES, *in_millimetres]):
        built = alone(*overrides, *own)
        evaluation, trajectory = built.evaluate(built.fields(wave))
        frequencies = [arm.current.first_frequency for arm in built.arms.values()]
        found.append((evaluation, built.gradient(trajectory), frequencies))
    (si, si_slopes, expected), (mm, mm_slopes, frequencies) = found
    factor = 1.0 if "objective.kind=eigenfrequency" in overrides else 1e3
    assert mm.objective == pytest.approx(factor * si.objective, rel=1e-8)
    np.testing.assert_allclose(frequencies, expected, rtol=1e-9)
    np.testing.assert_allclose(mm.deflections, si.deflections, rtol=1e-7)
    for k, slopes in si_slopes.items():
        scale = np.abs(slopes).max()
        # Adjoints of modes and trajectory are iterated to 1e-8 and 1e-7.
        np.testing.assert_allclose(mm_slopes[k] / factor, slopes, atol=3e-6 * scale)


def test_large_deflections_are_warned_of(tmp_path, capsys):
    """A tenth of an arm's length: in summary.json and on standard error, arm by arm."""
    heavy = ["payload.mass=40", "arms.arm2.young_modulus=1e12"]
    for name, more in (("small", []), ("large", [*heavy, "simulation.stiffening=false"])):
        changes = overrides("arms.cells=[12,2]", *more)
        run("simulate", TWO_ARM, "--no-plots", "--out", tmp_path / name, *changes)
        printed = capsys.readouterr().err
        warnings = summary_of(tmp_path / name)["warnings"]
        assert [f"dolfinopt: warning: {w}" for w in warnings] == printed.splitlines()
        assert warnings or name == "small"
    trajectory = moved(*heavy, field=lambda k, x, y: 0.5 * np.ones_like(x))
    body = trajectory.mechanism.bodies[0]
    tip = trajectory.q_e[:, trajectory.mechanism.slices[0]] @ body.outboard.T
    ratio = np.linalg.norm(tip[:, :2], axis=1).max()  # of 1 m
    assert ratio > 0.1 > trajectory.deflections[1]
    deflection, stiffening = warnings
    assert f"'arm1' deflects by {100.0 * ratio:.3g} %" in deflection
    assert "simulation.stiffening = false" in stiffening
