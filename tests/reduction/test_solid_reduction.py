"""Reduction of solid arms against the full model: six interface coordinates."""

import numpy as np
import pytest
import scipy.linalg
from mpi4py import MPI
from remainders import built_of
from runs import ROOT
from solids import DENSITY, HEIGHT, LENGTH, THICKNESS, YOUNG, tensors_of

import dolfinopt as do
from dolfinopt.fem.elasticity import Substructure
from dolfinopt.mesh.arm_mesh import box_arm
from dolfinopt.reduction import METHODS, Options, frame_fields

pytestmark = pytest.mark.serial  # ranks: tests/arms/test_solid_arm.py
BETA = 2e-5  # s, damping D = BETA K


class Full:
    """A graded arm without symmetry, unreduced: dense K, M, responses of interface and frame."""

    def __init__(self):
        mesh = box_arm(MPI.COMM_SELF, "a", (LENGTH, HEIGHT, THICKNESS), (6, 2, 2))
        x = 0.6 + 0.35 * np.sin(mesh.centroid @ [9.0, 170.0, 260.0])
        self.arm = Substructure(tensors_of(mesh, "incompatible")).at(YOUNG * x**3, DENSITY * x)
        unit = np.eye(self.arm.num_dofs)
        T = self.arm.expand(unit[:-6], unit[-6:])
        self.K = np.vstack(self.arm.restrict(self.arm.stiffness_times(T)))
        self.M = np.vstack(self.arm.restrict(self.arm.mass_times(T)))
        loads = np.vstack([np.zeros((len(unit) - 6, 6)), np.eye(6)])
        inertia = np.vstack(self.arm.restrict(self.arm.mass_times(frame_fields(self.arm))))
        self.inputs = np.hstack([loads, inertia])
        self.frequencies = np.sqrt(scipy.linalg.eigvalsh(self.K, self.M)) / (2.0 * np.pi)

    def response(self, frequency):
        """Return H (12, 12), complex, at a frequency in Hz."""
        return _response(self.K, self.M, self.inputs, frequency)


def _response(K, M, inputs, frequency):
    omega = 2.0 * np.pi * frequency
    return inputs.T @ np.linalg.solve((1.0 + 1j * omega * BETA) * K - omega**2 * M, inputs)


@pytest.fixture(scope="module")
def full():
    return Full()


def reduced(arm, basis):
    """Return K, M and the inputs (q, 12) in the basis."""
    M = np.tensordot(basis.V, basis.MV, ((0, 1), (0, 1)))
    inertia = np.tensordot(basis.MV, frame_fields(arm), ((0, 1), (0, 1)))
    return basis.stiffness, M, np.hstack([basis.outboard.T, inertia])


def distance(found, exact):
    """Return the largest difference of two responses, in the units of their diagonal."""
    size = np.sqrt(np.abs(np.diag(exact)))
    return float(np.abs((found - exact) / np.outer(size, size)).max())


# Largest differences, of the responses to 12 inputs up to the first natural frequency and of the
# first four frequencies: twice what was measured. Modal truncation lacks the statics.
CASES = {
    "craig-bampton": (Options(14), 0.023, 7e-4),
    "modal": (Options(14), 0.29, 1e-8),
    "krylov": (Options(12), 5e-5, 6e-3),
    "balanced": (Options(14, band=(0.0, 100.0), damping=BETA), 0.01, 1e-4),
}


@pytest.mark.parametrize("method", CASES)
def test_response_of_the_full_model(full, method):
    """Interface and frame as inputs, up to 1.1 times the first frequency; rigid interfaces."""
    options, allowed, by_frequency = CASES[method]
    basis = METHODS[method].reduce(full.arm, options, None)
    K, M, inputs = reduced(full.arm, basis)
    found = np.sqrt(scipy.linalg.eigvalsh(K, M)[:4]) / (2.0 * np.pi)
    assert found == pytest.approx(full.frequencies[:4], rel=by_frequency)
    assert (found > (1.0 - 1e-8) * full.frequencies[:4]).all()
    errors = [
        distance(_response(K, M, inputs, f), full.response(f))
        for f in full.frequencies[0] * np.array([0.0, 0.5, 0.9, 1.1])
    ]
    assert max(errors) < allowed
    rigid = full.arm.rigid[full.arm.outboard] @ basis.outboard
    assert np.array_equal(basis.V[full.arm.outboard], rigid)
    assert not basis.V[full.arm.inboard].any()


def test_automatic_order_in_space():
    """As few coordinates as a loose tolerance allows, but those of the interface."""
    changes = (*(f"arms.link{k}.cells=[4,1,1]" for k in (1, 2)), "arms.passive=0.1",
               "simulation.sample=0.05", "objective.load_cases=6", "simulation.stiffening=false",
               'reduction.coordinates="auto"', "reduction.tolerance=0.5")  # fmt: skip
    demo = ROOT / "demos" / "spatial_arm.toml"
    for method, fewest in (("modal", 1), ("krylov", 6), ("craig-bampton", 6)):
        scene = do.load_scene(demo, (*changes, f"reduction.method={method}"))
        assert scene.reduction.fewest_of(scene.arms[1]) == fewest
    built = built_of(scene, MPI.COMM_SELF)
    place = scene, built.partition, built.arms
    choice = do.choose_coordinates(*place, built.uniform(), built.profile)
    assert choice is not None and choice.error < 0.5
    assert [count for count, _ in choice.tried] == [6]
