"""Buckling: Euler's and Greenhill's columns, void that does not buckle, worst instants, limits."""

import numpy as np
import pytest
from machines import held_link
from mpi4py import MPI
from remainders import arm_of, build, built_of, wave
from runs import scene

import dolfinopt as do
from dolfinopt.arms.arm import build_arms
from dolfinopt.arms.modes import buckling_modes
from dolfinopt.fem.stress import Prestress, StressedModulus
from dolfinopt.parallel import partition_arms
from dolfinopt.profiling import Profile
from dolfinopt.responses.buckling import pressed, stressed_modulus, worst_instants
from dolfinopt.responses.constraints import limits_of
from dolfinopt.responses.stress import ArmLoads

LENGTH, HEIGHT, THICKNESS = 1.0, 0.03, 0.01
ALONG_X, FORCE, ACROSS = 0, 4, 5  # unit loads: acceleration, and forces at the outboard interface
BAR = f"""Point(1) = {{0, {-HEIGHT / 2}, 0}}; Point(2) = {{{LENGTH}, {-HEIGHT / 2}, 0}};
Point(3) = {{{LENGTH}, {HEIGHT / 2}, 0}}; Point(4) = {{0, {HEIGHT / 2}, 0}};
Line(1) = {{1, 2}}; Line(2) = {{2, 3}}; Line(3) = {{3, 4}}; Line(4) = {{4, 1}};
Curve Loop(1) = {{1, 2, 3, 4}}; Plane Surface(1) = {{1}};
Transfinite Curve {{1, 3}} = 41; Transfinite Curve {{2, 4}} = 3; Transfinite Surface {{1}};
Physical Curve("inboard") = {{4}}; Physical Curve("outboard") = {{2}};
"""


@pytest.fixture(scope="module")
def bar(tmp_path_factory):
    """A straight slender bar of quadratic triangles, and EI."""
    path = tmp_path_factory.mktemp("bar") / "bar.geo"
    path.write_text(BAR)
    one = scene(
        f"arms.0.mesh='{path}'", "arms.0.element=quadratic", f"arms.0.thickness={THICKNESS}",
        f"arms.0.height={HEIGHT}", "arms.1.rigid=true", "design.filter_radius=0",
    )  # fmt: skip
    arm = build_arms(one, partition_arms(MPI.COMM_SELF, one.cell_counts), Profile())[0]
    arm.state(np.ones(arm.mesh.num_cells))
    young = one.material_of(0).young_modulus
    return arm.current, young * THICKNESS * HEIGHT**3 / 12.0


def under(state, load, size, modulus=None):
    """Return the stress of a unit load times a size."""
    a = np.zeros((1, state.load_fields.columns.shape[2]))
    a[0, state.basis.V.shape[2] + load] = size
    return Prestress(state.load_fields, modulus or stressed_modulus(state), a)


def factor_of(state, load, size):
    return 1.0 / buckling_modes(under(state, load, size), 1).inverse[0]


@pytest.mark.serial
def test_bar_under_its_inertia_buckles_at_the_known_acceleration(bar):
    """q L = 7.837 EI / L^2 of a column under its own weight (Greenhill 1881)."""
    state, bending = bar
    mass = state.elastic.density[0] * LENGTH * HEIGHT * THICKNESS
    a = 7.8373 * bending / LENGTH**2 / mass / 10.0
    # Static fields are those of inertia forces -M a: the unit load is M a itself.
    assert factor_of(state, ALONG_X, -a) == pytest.approx(10.0, rel=0.01)


@pytest.mark.serial
def test_geometric_stiffness_is_that_of_the_reduction(bar):
    """Of any motions, rotations of the outboard interface included, and of every unit load."""
    state = bar[0]
    elastic, loads = state.elastic, state.unit_loads
    rng = np.random.default_rng(1)
    V = elastic.expand(rng.standard_normal((elastic.num_interior, 2)), rng.normal(size=(3, 2)))
    solid = StressedModulus(elastic.young, np.ones_like(elastic.young))
    for load, expected in enumerate(loads.geometric_stiffness(V)):
        stress = under(state, load, 1.0, solid)
        assert stress.stiffness(V)[0] == pytest.approx(expected, rel=1e-9)
        flat = np.einsum("nak,nm,mal->kl", V, stress.matrix().toarray(), V)
        theta = elastic.substructure.T.coordinates(V)[2:]
        assert flat + theta.T @ stress.rotation[0, 0] @ theta == pytest.approx(expected, rel=1e-6)


def rows():
    """Return an arm, and for each of its cells where it is along it and in which row."""
    arm = arm_of((60, 12), "arms.passive=0.0")
    x, y = arm.mesh.centroid.T
    return arm, x, np.round((y - y.min()) / (y.max() - y.min()) * 11)


@pytest.mark.serial
def test_void_in_a_closing_gap_does_not_buckle():
    """A tongue that nothing loads beside a beam that bends towards it, void between them."""
    arm, x, row = rows()
    solid = (row >= 8) | ((row >= 2) & (row <= 6) & (x < 0.9)) | (x < 0.02)

    def first(light, modulus=None):
        """Return the factor, and the share of the mode's energy in solid."""
        arm.state(np.where(solid, 1.0, light))
        one = arm.current
        phi = buckling_modes(under(one, ACROSS, -100.0, modulus), 1)
        energy = one.elastic.cell_stiffness_products(phi.field, phi.field) * one.elastic.young
        return 1.0 / phi.inverse[0], energy[solid].sum() / energy.sum()

    empty, share = first(0.0)
    assert share > 0.5
    assert first(0.01)[0] == pytest.approx(empty, rel=0.3)  # what is there is stiff, too
    young = arm.current.elastic.young
    spurious, share = first(0.01, StressedModulus(young, np.ones_like(young)))
    assert share < 0.2 and spurious < 0.02 * empty


def test_worst_instants_are_peaks():
    t = np.linspace(0.0, 5.0, 501)
    values = np.sin(np.pi * t) ** 2 * (1.0 + t)
    assert t[worst_instants(values)] == pytest.approx([4.5, 3.5, 2.5], abs=0.03)
    assert worst_instants(np.array([3.0, 1.0, 2.0])) == [0, 2]  # ends count
    assert worst_instants(np.zeros(3)) == worst_instants(-np.ones(3)) == []


@pytest.mark.serial
def test_pressure_is_found_between_stronger_tension(bar):
    """Its peak has a tenth of the energy of four others, of which three are looked at first."""
    state = bar[0]
    t = np.linspace(0.0, 1.0, 101)
    size = 3e3 * np.sin(4.0 * np.pi * t) ** 2 * np.where((t > 0.5) & (t < 0.75), -0.3, 1.0)
    a = size[:, None] * under(state, FORCE, 1.0).a
    found = pressed(state, [ArmLoads(0, 0, a, 1.0, t)])
    assert [t[one.instant] for one in found] == pytest.approx([0.63], abs=0.011)
    assert found[0].modes.inverse[0] == pytest.approx(1.0 / factor_of(state, FORCE, size.min()))
    # Twice as stiff under the same stress: half as near to buckling.
    (stiffer,) = pressed(state, [ArmLoads(0, 0, a, 2.0, t)])
    assert stiffer.modes.inverse[0] == pytest.approx(0.5 * found[0].modes.inverse[0])


@pytest.mark.serial
def test_member_that_weaker_loads_press_is_found():
    """A beam of two flanges: four peaks press the stronger one, one of half the other."""
    arm, x, row = rows()
    arm.state(np.where((row >= 9) | (row == 0) | (np.round(60 * x) % 10 == 0), 1.0, 1e-3))
    t = np.linspace(0.01, 0.99, 50)
    size = np.sin(5.0 * np.pi * t) ** 2 * np.where((t > 0.4) & (t < 0.6), -0.5, 1.0)
    a = 100.0 * size[:, None] * under(arm.current, ACROSS, 1.0).a
    found = pressed(arm.current, [ArmLoads(0, 0, a, 1.0, t)])
    every = [1.0 / factor_of(arm.current, ACROSS, 100.0 * item) for item in size]
    assert found[0].modes.inverse[0] == pytest.approx(max(every))


YOUNG, MASS, GRAVITY = 70e9, 3.7, 981.0  # SI; the arm has no weight
SECTION = {"height": 0.04, "thickness": 0.02}
CELLS = {"plane": [30, 6], "space": [20, 2, 2]}


def column(kind, folder, *changes):
    """Return a cantilever under a mass that presses it along its axis, held still."""
    gravity = [-GRAVITY] + [0.0] * (len(CELLS[kind]) - 1)
    tables = {"payload": {"mass": MASS}, "simulation": {"stiffening": False}}
    return held_link(folder, SECTION | {"cells": CELLS[kind]}, gravity, changes,
                     constraints={"buckling": 2.0}, **tables)  # fmt: skip


@pytest.mark.serial
@pytest.mark.parametrize("kind", CELLS)
def test_column_under_a_payload(kind, tmp_path):
    """pi^2 EI / (4 L^2) over m g; a plane arm in its plane, a solid across its thickness."""
    told = "design.initial=1.0", "design.volume_fraction=1.0", "design.filter_radius=0"
    one = column(kind, tmp_path, *told)
    a, b = sorted(SECTION.values(), reverse=kind == "plane")
    euler = np.pi**2 * YOUNG * b * a**3 / 12.0 / (4.0 * LENGTH**2) / (MASS * GRAVITY)
    limit = limits_of(one, do.Model(one).simulate().evaluation)[-1]
    assert (limit.name, limit.unit, limit.met) == ("buckling", "-", bool(euler > 2.0))
    # The clamped edge hinders lateral contraction: 0.1 % and 0.8 %, with two cells across it.
    assert limit.value == pytest.approx(euler, rel=0.01)
    up = [GRAVITY, *one.motion.gravity[1:]]
    pulled = column(kind, tmp_path, *told, f"motion.gravity={up}")
    assert limits_of(pulled, do.Model(pulled).simulate().evaluation)[-1].value == 1000.0


def test_an_arm_cut_in_two(monkeypatch):
    """The same on the ranks that share an arm, or have an arm each."""
    told = ("objective.kind=buckling", "motion.horizon=2.2", "simulation.sample=0.01",
            "arms.passive=0", "design.filter_radius=0")  # fmt: skip
    one = do.load_scene(build().scene.source, ("arms.cells=[20,3]", *told))

    def factor(world):
        built = built_of(one, world)
        return built.evaluate(built.fields(wave))[0].responses[0].values[0]

    alone = factor(MPI.COMM_SELF)
    assert factor(MPI.COMM_WORLD) == pytest.approx(alone, rel=1e-7)
    monkeypatch.setattr("dolfinopt.parallel.SPLIT_CELLS", 1)
    assert factor(MPI.COMM_WORLD) == pytest.approx(alone, rel=1e-7)
