"""`dolfinopt export`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from dolfinopt.cli.shared import (
    PATH,
    claim,
    design_option,
    load,
    out_option,
    overwrite_option,
    prepare,
    scene_argument,
    scene_of,
    set_option,
    start,
    tell,
    warn,
)
from dolfinopt.errors import InputError

if TYPE_CHECKING:
    from mpi4py import MPI

    from dolfinopt.arms.arm import Arm
    from dolfinopt.dynamics.state_space import StateSpace
    from dolfinopt.scene.load import Scene


KINDS = (".sid", ".sid.npz", ".fem")


@click.command()
@scene_argument
@design_option
@out_option("the bodies; default: results/SCENE-bodies")
@overwrite_option
@set_option
@click.option(
    "--urdf",
    is_flag=True,
    help="instead, with the folder of a finished run as SCENE: the robot that its scene was "
    "imported from, with the run's links; default folder: SCENE/urdf",
)
@click.option(
    "--state-space",
    "instant",
    type=float,
    metavar="T",
    help="instead: the machine linearised about its motion at T seconds, as A, B, C, D (.npz and "
    ".mat); SCENE is a scene's file or the folder of a finished run; default folder: "
    "RUN/state-space or results/SCENE-state-space",
)
@click.option(
    "--before",
    type=PATH,
    metavar="DIR",
    help="with --urdf: an earlier run of the robot, for a table and a page of both",
)
def export(
    scene: Path,
    design: Path | None,
    out: Path | None,
    overwrite: bool,
    overrides: tuple[str, ...],
    urdf: bool,
    instant: float | None,
    before: Path | None,
) -> None:
    """Write the reduced arms of SCENE for other multibody codes, or its linearised machine.

    Each arm as standard input data (ARM.sid, the same as ARM.sid.npz) and for MBDyn (ARM.fem), with
    geometric stiffness where simulation.stiffening is true, or "auto" and the motion asks for it.
    With [[joints]] in space; of rigid arms the screen tells mass, centre and inertia.
    """
    if instant is not None:
        if urdf or before is not None:
            raise InputError("--state-space: expected no --urdf and no --before with it")
        _export_state_space(scene, instant, design, out, overwrite, overrides)
        return
    if urdf:
        if design is not None or overrides:
            raise InputError("--urdf: expected no --design and no --set, they are the run's")
        # Imports NumPy, which the help of commands does without.
        from dolfinopt.cli.robots import export_robot

        export_robot(scene, out, overwrite, before)
        return
    if before is not None:
        raise InputError("--before: expected --urdf with it")
    if scene.is_dir():
        raise InputError(
            f"{scene}: a folder; name a scene file, or add --urdf for a robot's run, or "
            "--state-space T"
        )
    world, loaded = load(scene, overrides)
    folder = out or Path("results") / f"{scene.stem}-bodies"
    from dolfinopt.exchange.mbdyn import write_fem
    from dolfinopt.exchange.sid import write_sid, write_sid_npz
    from dolfinopt.output.design import arms_with_design
    from dolfinopt.parallel import gather_arms, together
    from dolfinopt.profiling import Profile
    from dolfinopt.responses.evaluation import decide_stiffening
    from dolfinopt.responses.order_selection import choose_coordinates
    from dolfinopt.scene.load import pose_scenarios

    names = [f"{arm.name}{kind}" for arm in loaded.arms for kind in KINDS]
    claim(world, folder, overwrite, names, scene=loaded)
    partition, arms, x_phys = arms_with_design(world, loaded, design, Profile())
    prepare(world, folder)
    tell(world, choose_coordinates(loaded, partition, arms, x_phys, Profile()))
    with together(world):
        for k, arm in arms.items():
            arm.set_design(x_phys[k])
    decide_stiffening([loaded, *pose_scenarios(loaded)], partition, arms)
    exported = {k: _exported(arm, loaded.arms[k].thickness, x_phys[k]) for k, arm in arms.items()}
    bodies = gather_arms(partition, exported)
    if world.rank != 0:
        return
    for index, (arm, owner) in enumerate(zip(loaded.arms, loaded.owners, strict=True)):
        if owner is None:
            click.echo(f"{arm.name}: not exported, {_why(loaded, index)}")
            continue
        data, element = bodies[owner]
        write_sid(folder / f"{arm.name}.sid", data)
        write_sid_npz(folder / f"{arm.name}.sid.npz", data)
        write_fem(folder / f"{arm.name}.fem", element)
        stiffness = ", geometric stiffness" if len(element.loads) else ""
        click.echo(
            f"{arm.name}: {data.mass:.6g} kg, {data.num_modes} coordinates, "
            f"{len(element.labels)} nodes{stiffness}; in {folder / arm.name}.sid, .sid.npz, .fem"
        )


STATE_SPACE = ("state_space.npz", "state_space.mat")
POLES_SHOWN = 5  # on the screen


def _export_state_space(
    source: Path,
    instant: float,
    design: Path | None,
    out: Path | None,
    overwrite: bool,
    overrides: tuple[str, ...],
) -> None:
    """Write a scene's machine, or a run's, linearised at an instant, s."""
    folder = out or Path("results") / f"{source.stem}-state-space"
    if source.is_dir():
        if design is not None:
            raise InputError("--design: expected none with the folder of a run, which has its own")
        design, folder = source / "design.npz", out or source / "state-space"
    world, loaded = _machine(source, overrides)
    if not 0.0 <= instant <= loaded.motion.horizon:
        raise InputError(
            f"--state-space {instant:g}: expected an instant from 0 to motion.horizon = "
            f"{loaded.motion.horizon:g} [s]"
        )
    claim(world, folder, overwrite, STATE_SPACE, scene=loaded)
    from dolfinopt.dynamics.simulation import Trajectory
    from dolfinopt.dynamics.state_space import state_space
    from dolfinopt.output.design import arms_with_design
    from dolfinopt.parallel import on_root, together
    from dolfinopt.profiling import Profile
    from dolfinopt.responses.evaluation import evaluate
    from dolfinopt.responses.order_selection import choose_coordinates

    profile = Profile()
    partition, arms, x_phys = arms_with_design(world, loaded, design, profile)
    tell(world, choose_coordinates(loaded, partition, arms, x_phys, profile))
    trajectory: Trajectory | None = evaluate(loaded, partition, arms, x_phys, profile)[1]

    def found() -> StateSpace:
        assert trajectory is not None
        return state_space(trajectory, instant)

    model = on_root(world, found)
    prepare(world, folder)
    with together(world):
        if world.rank == 0:
            _write_state_space(folder, model)


def _machine(source: Path, overrides: tuple[str, ...]) -> tuple[MPI.Comm, Scene]:
    """Return all ranks, and the scene of a file or of a run's folder (collective)."""
    if not source.is_dir():
        return load(source, overrides)
    if overrides:
        raise InputError("--set: expected none with the folder of a run, whose scene it is")
    world = start()
    from dolfinopt.parallel import on_root

    return world, on_root(world, scene_of, source)


def _write_state_space(folder: Path, model: StateSpace) -> None:
    """Write both files and say what they hold (root only)."""
    import numpy as np
    from scipy.io import savemat

    from dolfinopt.disk import write_arrays, write_atomically

    arrays, npz, mat = model.arrays(), *(folder / name for name in STATE_SPACE)
    # MATLAB has cell arrays for words of several lengths.
    cells = {k: x.astype(object) if x.dtype.kind == "U" else x for k, x in arrays.items()}
    write_atomically(mat, lambda stream: savemat(stream, cells, oned_as="column"))
    write_arrays(npz, arrays)
    kind = "with its control" if model.closed else "drives free"
    click.echo(
        f"{kind}, at {model.time:g} s: {len(model.states)} states, {len(model.inputs)} inputs, "
        f"{len(model.outputs)} outputs; in {npz}, {mat.name}"
    )
    poles = [pole for pole in model.poles if pole.imag >= 0.0]
    for pole in poles[:POLES_SHOWN]:
        size = abs(pole)
        damping = -pole.real / size if size > 0.0 else 0.0
        click.echo(f"  pole {pole:.5g} 1/s: {size / (2.0 * np.pi):.4g} Hz, damping {damping:.3g}")
    worst = max(poles, key=lambda pole: float(pole.real))
    if model.closed and worst.real > 0.0:
        warn(
            [
                f"linearised at {model.time:g} s the closed loop has an unstable pole, {worst:.4g} "
                "1/s; see whether it stays where the machine rests, at 0 or motion.horizon"
            ]
        )


def _why(scene: Scene, index: int) -> str:
    """Return why an arm has no files; of a rigid one what another program needs of it."""
    if not scene.arms[index].rigid:
        return "it comes from a file"
    from dolfinopt.arms.arm import fixed_body
    from dolfinopt.multibody.shape_integrals import in_space

    body = in_space(fixed_body(scene, index))
    centre, tensor = body.inertia_about_centre()
    place = ", ".join(f"{x:.6g}" for x in centre)
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = tensor
    moments = ", ".join(f"{x:.6g}" for x in (xx, yy, zz, xy, xz, yz))
    return (
        f"it is rigid: {body.mass:.6g} kg, centre ({place}) m, xx, yy, zz, xy, xz, yz about it "
        f"{moments} kg m2"
    )


def _exported(arm: Arm, thickness: float, x_phys: Any) -> Any:
    """Return an arm's SID and MBDyn element on the first of its ranks (collective there)."""
    from dolfinopt.multibody.shape_integrals import in_space, plate_moments
    from dolfinopt.multibody.standard_input import lumped_nodes, modal_element, to_sid

    body = arm.reduce(x_phys)
    title = f"{arm.mesh.name} of {arm.scene.name}"
    nodes = None
    if arm.mesh.dim == 2:
        assert arm.basis is not None
        body = in_space(body, plate_moments(arm.elastic, arm.basis, thickness))
        nodes = lumped_nodes(arm.elastic, arm.basis, thickness)
    if arm.elastic.comm.rank != 0:
        return None
    return to_sid(body, title), modal_element(body, nodes)
