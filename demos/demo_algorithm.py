"""The algorithm of Seifried, Moghadasi & Held (2015) on one page, of public parts.

An iteration: filter -> K(x), M(x) -> reduced basis -> simulation -> equivalent static loads ->
gradient -> MMA. `dolfinopt.optimize` does the same, with all else that a user may ask for.

Run it on any number of ranks:  mpirun -n 2 python demos/demo_algorithm.py
"""

from pathlib import Path

import numpy as np
from mpi4py import MPI

import dolfinopt as do
from dolfinopt.arms.arm import chain_of
from dolfinopt.multibody.shape_integrals import shape_integrals
from dolfinopt.optimization.measured import DECIMALS
from dolfinopt.optimization.mma import initial_state, mma_step
from dolfinopt.optimization.variables import Variables
from dolfinopt.reduction.methods import craig_bampton
from dolfinopt.responses.motion import worst_instants

HERE = Path(__file__).parent
SETTINGS = ["simulation.stiffening=false", "design.projection=false"]
ITERATIONS = 10


def main(overrides: list[str] = SETTINGS, iterations: int = ITERATIONS) -> list[float]:
    """Return the compliance of the load cases over the iterations, N m."""
    world, profile = MPI.COMM_WORLD, do.Profile()
    scene = do.load_scene(HERE / "two_arm.toml", overrides)

    # Gmsh meshes the arms; DOLFINx and FFCx make the element tensors from UFL forms.
    partition = do.partition_arms(world, scene.cell_counts)
    arms = do.build_arms(scene, partition, profile)

    variables = Variables(scene, partition, arms)  # of all arms as one vector
    x = np.clip(variables.initial, variables.xmin, variables.xmax)
    memory, solution, starts, history = initial_state(x), None, dict.fromkeys(arms), []
    for iteration in range(iterations + 1):
        # The Helmholtz filter makes physical densities; stiffness and mass follow from them:
        # K(x) = sum E(x_e) k_e, M(x) = sum rho(x_e) m_e.
        parts = variables.split(x)
        designs = {k: arm.filtered(parts[k]) for k, arm in arms.items()}
        states = {k: arm.state(designs[k].x_phys) for k, arm in arms.items()}

        # u = V q: the static modes of the interface, and the lowest modes with it held, by SLEPc.
        bases = {
            k: craig_bampton(state.elastic, state.reduction_options, starts[k])
            for k, state in states.items()
        }
        starts = {k: basis.start for k, basis in bases.items()}
        damping = scene.damping.stiffness_proportional  # D = damping K
        bodies = {k: shape_integrals(states[k].elastic, bases[k], damping) for k in arms}

        # The floating frames of all arms on rank 0: q(t), and the instants of the load cases.
        owned, moments, objective = do.gather_arms(partition, bodies), None, None
        if world.rank == 0:
            trajectory = do.simulate(scene, chain_of(scene, owned), profile, solution)
            solution = trajectory.solution
            cases = worst_instants(trajectory, scene.objective.load_cases)
            objective = float(trajectory.compliance[cases].sum())  # sum of q' K q
            q = [trajectory.q_e[cases, part] for part in trajectory.mechanism.slices]
            moments = [own.T @ own for own in q]
        moments, objective = world.bcast((moments, objective), root=0)
        history.append(objective)
        if world.rank == 0:
            print(f"{iteration:3d}  compliance {objective:8.4f} N m")

        # With the equivalent static loads f = K q of the load cases held, compliance f' u changes
        # by -u' dK u: minus the strain energy of every cell.
        by_objective, by_volume, volumes = {}, {}, {}
        for k, arm in arms.items():
            V = bases[k].V
            energy = states[k].elastic.cell_stiffness_products(V @ moments[k], V)
            by_objective[k] = arm.backward(-states[k].young_slope * energy, designs[k])
            volume = arm.mesh.area / (scene.design.volume_fraction * total(arm, arm.mesh.area))
            by_volume[k] = arm.backward(volume, designs[k])
            volumes[k] = total(arm, volume * designs[k].x_phys) - 1.0

        # The method of moving asymptotes, one limit of volume for every arm.
        df0dx = variables.join(by_objective)
        dfdx = np.zeros((len(scene.designed), variables.size))
        for row, k in enumerate(scene.designed):
            own = {i: by * (i == k) for i, by in by_volume.items()}
            dfdx[row] = variables.join(own)
        found = world.allgather(volumes)
        f = np.array([next(one[k] for one in found if k in one) for k in scene.designed])
        bounds = variables.xmin, variables.xmax
        new, memory = mma_step(x, df0dx, f, dfdx, *bounds, memory, move=scene.optimizer.move)
        x = np.clip(new.round(DECIMALS), *bounds)  # forgets what differs by the processor
    return history


def total(arm: do.Arm, values: np.ndarray) -> float:
    """Return the sum over the cells of all ranks that share an arm."""
    return arm.mesh.comm.allreduce(float(values.sum()))


if __name__ == "__main__":
    with do.abort_together(MPI.COMM_WORLD):
        main()
