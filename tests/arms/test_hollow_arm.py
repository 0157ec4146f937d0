"""Hollow arms: stiffness against theory of thin walls, gradients by Taylor tests, any ranks."""

import numpy as np
import pytest
from mpi4py import MPI
from remainders import built_of, rates
from runs import ROOT
from solids import DENSITY, POISSON, YOUNG, solid_arm
from statics import deflection, deflection_gradient

import dolfinopt as do
from dolfinopt.responses.evaluation import analysis_of, constraint_gradients
from dolfinopt.responses.sensitivity import static_response

SELF, WORLD = MPI.COMM_SELF, MPI.COMM_WORLD
G = 0.5 * YOUNG / (1.0 + POISSON)
# Unit forces along y, z and x, and a moment about x.
LOADS = np.eye(6)[[1, 2, 0, 3]]


def tube(size):
    """Return the same of a round tube; shear by Cowper, doi:10.1115/1.3625046."""
    L, d, _ = size
    t = d / 40.0
    m = 1.0 - 2.0 * t / d
    A, inertia = 0.25 * np.pi * d**2 * (1.0 - m**2), np.pi / 64.0 * d**4 * (1.0 - m**4)
    both = (1.0 + m * m) ** 2
    shape = 6.0 * (1.0 + POISSON) * both
    shape /= (7.0 + 6.0 * POISSON) * both + (20.0 + 12.0 * POISSON) * m * m
    bending = L**3 / (3.0 * YOUNG * inertia) + L / (G * shape * A)
    return np.array([bending, bending, L / (YOUNG * A), L / (2.0 * G * inertia)])


KEYS = ("wall=0.002", "min_wall=0.001", "max_wall=0.005", "hollow=true")
COARSE = (
    *(f"arms.{link}.{key}" for link in ("link1", "link2") for key in KEYS),
    "arms.link1.cells=[5,2,1]", "arms.link2.cells=[5,2,2]", "arms.link2.hollow=tube",
    "arms.link2.height=0.02", "arms.link2.passive=0", "simulation.tolerance=1e-4",
    "objective.gradient=exact", "design.filter_radius=0.05", "design.initial=0.5",
)  # fmt: skip


@pytest.mark.parametrize(
    "changes",
    [
        ("objective.kind=esl", "constraints.mass=2.0", "constraints.tip_deflection=1e-3"),
        ("objective.kind=esl", "constraints.tip_deflection=1e-3", "arms.link1.angle=0.5",
         "material=CFRP unidirectional", "simulation.stiffening=true"),
        pytest.param(("objective.kind=mass", "constraints.deviation=0.01", "constraints.stress=1e8",
                      "constraints.first_frequency=100"), marks=pytest.mark.slow),
    ],
    ids=["esl", "carbon", "mass"],
)  # fmt: skip
def test_gradients_by_the_wall(changes):
    """Remainders of objective and limits are of second order along a random direction."""
    scene = do.load_scene(ROOT / "demos" / "spatial_arm.toml", (*COARSE, *changes))
    built = built_of(scene, SELF)
    rng = np.random.default_rng(1)
    sizes = {k: arm.mesh.num_cells for k, arm in built.arms.items()}
    x = {k: 0.4 + 0.2 * rng.random(n) for k, n in sizes.items()}
    along = {k: rng.standard_normal(n) for k, n in sizes.items()}
    evaluation, trajectory = built.evaluate(x)
    held = np.array(evaluation.smooth_limits)
    found = [built.gradient(trajectory)]
    found += constraint_gradients(analysis_of(*built.place, trajectory, built.profile))
    slopes = [sum(float(row[k] @ along[k]) for k in row) for row in found]

    def values(h):
        one, _ = built.evaluate({k: x[k] + h * along[k] for k in x})
        smooth = (1.0 + np.array(one.constraints)) * np.array(one.smooth_limits) / held
        return np.append(one.objective, smooth)

    known = {h: values(h) for h in (0.0, 5e-3, 1e-2)}
    for k, slope in enumerate(slopes):
        assert rates(lambda h, k=k: known[h][k], slope, (1e-2, 5e-3)) == pytest.approx(2.0, abs=0.1)


def test_the_same_on_any_ranks():
    """Deflection, mass and gradient of an arm of all ranks are those of one rank alone."""
    found = []
    for comm in (SELF, WORLD):
        arm = solid_arm(comm, cells=(12, 3, 2), hollow=True, wall=0.001, max_wall=0.003)
        y = arm.mesh.centroid[:, 1]
        state = arm.state(arm.physical(0.5 + 8.0 * y))
        response = static_response(state.elastic, LOADS[:2])
        gradient = arm.backward(deflection_gradient(state, response, 4.0))
        parts = np.array([gradient.sum(), gradient @ y, DENSITY * state.mesh.area.sum()])
        found.append([deflection(response, 4.0)[0], *comm.allreduce(parts)])
    assert found[1] == pytest.approx(found[0], rel=1e-8)


def test_a_state_stays_right_when_another_is_made():
    """Nodes of an older design are its own, and so is what it solves for later."""
    arm = solid_arm(SELF, cells=(8, 3, 2), hollow=True, wall=0.001, max_wall=0.003)
    thin = arm.state(arm.uniform(0.1))
    thick = arm.state(arm.uniform(0.9))
    first, other = (static_response(one.elastic, LOADS[:1]).tip[1, 0] for one in (thin, thick))
    again = static_response(arm.state(arm.uniform(0.1)).elastic, LOADS[:1]).tip[1, 0]
    assert first == pytest.approx(again, rel=1e-12)
    assert first > 1.5 * other
