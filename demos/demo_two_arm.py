"""The paper's two-arm manipulator, from mesh to picture.

Run it on any number of ranks:  mpirun -n 2 python demos/demo_two_arm.py
"""

from pathlib import Path

from mpi4py import MPI

import dolfinopt as do
from dolfinopt.plots.curves import deviation_figure, history_figure
from dolfinopt.plots.design import design_figure
from dolfinopt.plots.style import save

HERE = Path(__file__).parent
ITERATIONS = 30


def main(folder: Path = Path("results/demo_two_arm")) -> do.Result:
    """Optimise for a few iterations and draw before and after; return the result."""
    world = MPI.COMM_WORLD
    scene = do.load_scene(
        HERE / "two_arm.toml", overrides=[f"optimizer.max_iterations={ITERATIONS}"]
    )

    # Mesh, elements and filter of every arm, on the ranks that own it.
    profile = do.Profile()
    partition = do.partition_arms(world, scene.cell_counts)
    arms = do.build_arms(scene, partition, profile)

    # Reduce and simulate the initial design.
    x_phys = {k: arm.uniform(scene.design.initial) for k, arm in arms.items()}
    initial, _ = do.evaluate(scene, partition, arms, x_phys, profile)

    # Optimise: filter, reduce, simulate, load cases, gradient, MMA; again and again.
    result = do.optimize(scene, world=world)
    final, views = result.evaluation, do.gather_views(scene, partition, result.arms, result.x_phys)

    # Plot on the root, which alone has the whole arms and the motion.
    if world.rank == 0:
        folder.mkdir(parents=True, exist_ok=True)
        save(design_figure(views, scene.name), folder / "design.png")
        save(history_figure(result), folder / "history.png")
        figure = deviation_figure(result.trajectory, result.initial_deviation)
        save(figure, folder / "deviation.png")
        for name, one in (("initial", initial), ("optimised", final)):
            print(
                f"{name:>9}: compliance {one.objective:6.3f} N m, "
                f"maximal deviation {1e3 * one.max_deviation:5.2f} mm"
            )
        print(f"pictures in {folder}")
    return result


if __name__ == "__main__":
    with do.abort_together(MPI.COMM_WORLD):
        main()
