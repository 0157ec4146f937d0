"""Designs of arms: their state, and arms that repeat another's design, scaled."""

import numpy as np
import pytest
from mpi4py import MPI
from runs import STATED, TWO_ARM, overrides, refused, run, summary_of

import dolfinopt as do
from dolfinopt.arms.arm import Arm, Patterns
from dolfinopt.optimization.evaluator import Evaluator
from dolfinopt.output.design import read_design
from dolfinopt.parallel import Partition

WORLD = MPI.COMM_WORLD
SMALL = ("arms.cells=[40,4]", "arms.passive=0.05", "optimizer.max_iterations=4")
REPEATED = ("arms.arm2.design=arm1", "arms.arm2.length=0.8", "arms.arm2.height=0.045")
SCALED = (*SMALL, *REPEATED, "arms.arm2.thickness=0.012", "arms.arm2.density=2500.0")
REGIONS = ('arms.arm1.regions=[{kind="void", circle=[0.5, 0.0, 0.016]}, '
           '{kind="solid", box=[0.2, -0.03, 0.3, -0.01]}]')  # fmt: skip


def built(*changes, world=WORLD):
    scene = do.load_scene(TWO_ARM, (*SMALL, *changes))
    partition = do.partition_arms(world, scene.cell_counts)
    return scene, partition, do.build_arms(scene, partition, do.Profile())


def by_place(scene, arms, k, values):
    """Return values of an arm's cells as an array (along, across); of a whole arm."""
    along, across = scene.arms[k].cells
    found = np.empty(along * across)
    x, y = arms[k].mesh.centroid.T / [[scene.arms[k].length], [scene.arms[k].height]]
    i, j = np.round(x * along - 0.5).astype(int), np.round((y + 0.5) * across - 0.5).astype(int)
    found[i * across + j] = values
    return found


def waves(arm):
    x, y = arm.mesh.centroid.T
    return 0.5 + 0.4 * np.sin(7.0 * x + 60.0 * y)


@pytest.mark.parametrize("projection", ["false", "heaviside", "robust"])
def test_cells_have_the_densities_of_their_partners(projection):
    scene, partition, arms = built(*REPEATED, REGIONS, f"design.projection={projection}")
    evaluator = Evaluator(scene, partition, arms, do.Profile())
    assert evaluator.variables.size == 160
    x = evaluator.variables.join({k: waves(arms[k]) for k in arms if k == 0})
    evaluator.projection.beta = 4.0
    for design in evaluator.physical_designs(x):
        mine = {k: by_place(scene, arms, k, one.x_phys) for k, one in design.items()}
        known = {k: v for part in WORLD.allgather(mine) for k, v in part.items()}
        assert np.array_equal(known[0], known[1])
        assert 0.0 in known[0] and 1.0 in known[0]  # regions and solid ends, too


def test_any_number_of_ranks_ends_in_the_same_design():
    scene = do.load_scene(TWO_ARM, SCALED)
    together, alone = do.optimize(scene), do.optimize(scene, world=MPI.COMM_SELF)
    for k, x_phys in together.x_phys.items():
        assert np.array_equal(x_phys, alone.x_phys[k])
    rows = WORLD.bcast([row.objective for row in together.history], root=0)
    assert rows == [row.objective for row in alone.history]


def test_an_arm_on_two_ranks_has_partners_on_both():
    """Parts of both arms everywhere: densities and gradients find their cells."""
    scene = do.load_scene(TWO_ARM, SCALED)
    partition = Partition(world=WORLD, comm=WORLD, arms=(0, 1))
    arms = do.build_arms(scene, partition, do.Profile())
    patterns = Patterns(scene, partition, arms)
    x, y = arms[0].mesh.centroid.T
    scale = [1.0 / 0.8, 0.06 / 0.045]
    spread = patterns.spread({0: x + 10.0 * y})[1]
    np.testing.assert_allclose(spread, arms[1].mesh.centroid * scale @ [1.0, 10.0], rtol=1e-9)
    u, v = arms[1].mesh.centroid.T
    [back] = patterns.collect({1: u - v}).items()
    assert back[0] == 0
    np.testing.assert_allclose(back[1], x * 0.8 - y * 0.75, rtol=1e-9, atol=1e-12)


@pytest.mark.serial  # ranks: test_any_number_of_ranks_ends_in_the_same_design
def test_a_run_resumes_to_the_same_bits(shared_tmp_path):
    folders = [shared_tmp_path / name for name in ("whole", "parts")]
    options = ["--no-plots", *overrides(*SCALED, REGIONS)]
    run("optimize", TWO_ARM, "--out", folders[0], *options)
    run("optimize", TWO_ARM, "--out", folders[1], *options, "--set", "optimizer.max_iterations=2")
    run("optimize", TWO_ARM, "--out", folders[1], *options, "--resume")
    whole, parts = (np.load(folder / "design.npz") for folder in folders)
    names = (f"arm{k}/{v}" for k in (1, 2) for v in ("centroid", "density"))
    assert sorted(whole) == sorted(["units", *names])
    for key in whole:
        assert np.array_equal(whole[key], parts[key]), key
    assert np.array_equal(whole["arm1/density"], whole["arm2/density"])
    scale = whole["arm2/centroid"] / whole["arm1/centroid"]
    np.testing.assert_allclose(scale, np.broadcast_to([0.8, 0.75], scale.shape), rtol=1e-6)
    one = summary_of(folders[0])
    share = one["volume_fraction"]
    assert share["arm1"] == pytest.approx(share["arm2"], rel=1e-12)
    ratio = 0.8 * 0.75 * 1.2 * 2500.0 / 2700.0
    assert one["mass"]["arm2"] == pytest.approx(ratio * one["mass"]["arm1"], rel=1e-9)
    assert list(one["constraints"]) == ["volume_fraction_arm1"]
    # The design simulates alike; one that holds the pattern alone is enough.
    for arms in (("arm1", "arm2"), ("arm1",)):
        path = shared_tmp_path / "one.npz"
        np.savez(path, **{key: whole[key] for key in whole if key.startswith(arms)})
        scene, partition, built_arms = built(*SCALED, REGIONS)
        x_phys = read_design(path, partition, built_arms)
        evaluation, _ = do.evaluate(scene, partition, built_arms, x_phys, do.Profile())
        # As the optimisation saw it, but for the steps in time, which set out from elsewhere.
        assert evaluation.compliance == pytest.approx(one["compliance"], rel=1e-4)


OF_FIRST, SHORTER = "arms.arm2.design=arm1", "arms.arm2.length=0.8"


@pytest.mark.serial
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (["arms.arm2.pattern=arm3"], ("arms.1.design (arm2)", "arm3", '"arm1"')),
        (["arms.arm1.pattern=arm2"], ("arms.0.design (arm1)", "no arm before it")),
        (["arms.arm1.rigid=true", OF_FIRST], ("arms.1.design (arm2)", "no arm before it")),
        ([OF_FIRST, "arms.arm2.cells=[20,4]"], ("arms.arm2.cells", "[20, 4]", "[40, 4]", "arm1")),
        ([OF_FIRST, "arms.arm2.mesh=meshes/arm.geo"], ("arms.1.design", "arm2 has mesh")),
        (["arms.arm1.mesh=meshes/arm.geo", OF_FIRST], ("arms.1.design", "arm1 has mesh")),
        ([OF_FIRST, "arms.arm2.rigid=true"], ("design and rigid",)),
        ([OF_FIRST, "arms.arm2.passive=0.1"], ("arms.arm2.passive", "0.1", "none", "arm1")),
        ([OF_FIRST, SHORTER, "arms.arm2.symmetric=true"], ("arms.arm2.symmetric", "none", "arm1")),
    ],
)
def test_what_cannot_be_a_pattern(changes, words):
    with refused(*words):
        do.load_scene(TWO_ARM, (*SMALL, *changes))


@pytest.mark.serial
def test_a_pattern_of_a_pattern_is_refused():
    three = [{"name": "arm1", "length": 1.0, "height": 0.06, "thickness": 0.01}]
    three += [{"name": "arm2", "pattern": "arm1", "length": 0.9}]
    three += [{"name": "arm3", "pattern": "arm2", "length": 0.8}]
    data = {"material": "POM", "arms": three}
    with refused("arms.2.design (arm3)", "arm2", "arm1"):
        do.scene_from_dict(STATED | data)
    # Identical arms may share the mesh of one that repeats another's design.
    three[2] = {"name": "arm3", "design": "arm2"}
    scene = do.scene_from_dict(STATED | data)
    assert scene.owners == (0, 1, 1) and scene.patterns == {1: 0} and scene.designed == (0,)


@pytest.mark.serial
def test_an_arm_takes_from_its_pattern_not_from_the_arm_before():
    one = {"name": "arm1", "length": 1.0, "height": 0.06, "thickness": 0.01, "passive": 0.03}
    one |= {"symmetric": True, "regions": [{"kind": "void", "circle": [0.5, 0.0, 0.01]}]}
    other = {"name": "arm2", "passive": 0.1, "symmetric": False, "regions": []}
    data = {
        "material": "POM",
        "arms": [one, other, {"name": "arm3", "design": "arm1", "length": 0.9}],
    }
    third = do.scene_from_dict(STATED | data).arms[2]
    assert third.passive is None and not third.symmetric and third.regions == ()


# -- states of one arm: computed once, unmoved by later ones  -------------------------------------


def small_arm():
    scene = do.load_scene(TWO_ARM, ["arms.cells=[16,3]"])
    return Arm(scene, 0, MPI.COMM_SELF, do.Profile())


@pytest.mark.serial
def test_a_state_is_computed_once_and_lasts():
    arm = small_arm()
    counts = arm.profile.counts
    x, other = arm.uniform(0.5), arm.uniform(0.7)
    state = arm.state(x)
    assert arm.state(x.copy()) is state is arm.current
    assert counts.assemblies == 0 and not state.is_reduced  # nothing before it is asked for
    assert state.body is arm.reduce(x) is state.body
    assert (counts.assemblies, counts.factorisations, counts.reductions) == (2, 1, 1)
    K = state.elastic.constraint_modes.stiffness.copy()
    arm.reduce(other)
    assert counts.factorisations == 2
    assert state.body.K is not arm.current.body.K  # the older one keeps what it has
    assert np.array_equal(state.elastic.constraint_modes.stiffness, K)
    assert counts.factorisations == 2
    # Solves with its matrix need the factor, which gave way to the newer one's.
    right = np.ones((state.elastic.num_interior, 1))
    u = state.elastic.solve(right)
    assert counts.factorisations == 3
    field = state.elastic.expand(u, np.zeros((3, 1)))
    residual = state.elastic.restrict(state.elastic.stiffness_times(field))[0] - right
    assert np.abs(residual).max() < 1e-8  # of forces of 1 N
    with pytest.raises(ValueError, match="read-only"):
        state.x_phys[0] = 0.0


@pytest.mark.serial
def test_an_arm_without_a_design_says_so():
    arm = small_arm()
    assert arm.basis is None
    with pytest.raises(RuntimeError, match=r"no design yet: call state"):
        _ = arm.current
