"""`jaximp simulate`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from jaximp.cli.terminal import Force, Out, Seed, bar_of


class What(StrEnum):
    """What can be simulated."""

    rig = "rig"
    arm = "arm"
    robot = "robot"


class Holding(StrEnum):
    """What holds the handle of the simulated rig."""

    spring = "spring"
    bands = "bands"


class Format(StrEnum):
    """What simulated trials are written as."""

    parquet = "parquet"
    csv = "csv"


def simulate(
    what: What,
    out: Out,
    force: Force = False,
    seed: Seed = 0,
    holding: Annotated[Holding, typer.Option("--holding", help="rig: what holds the handle.")] = Holding.spring,
    perturbed: Annotated[int, typer.Option("--perturbed", help="arm: how many movements are perturbed.")] = 20,
    unperturbed: Annotated[int, typer.Option("--unperturbed", help="arm: how many are not.")] = 40,
    duration: Annotated[
        float | None, typer.Option("--duration", help="arm, robot: of a movement, in s; by default 2 and 30.")
    ] = None,
    position_step: Annotated[float, typer.Option("--position-step", help="arm: step of the encoders, in um.")] = 1.0,
    force_noise: Annotated[float, typer.Option("--force-noise", help="arm: white noise of the force, in N.")] = 0.0,
    format: Annotated[Format, typer.Option("--format", help="arm: of the recordings.")] = Format.parquet,
    urdf: Annotated[
        Path | None, typer.Option("--urdf", help="robot: its URDF; by default an arm of six joints.")
    ] = None,
    human: Annotated[bool, typer.Option("--human", help="robot: somebody holds its end.")] = False,
) -> None:
    """Write simulated recordings, with a job file that `identify` reads.

    `rig`: a rig of one joint, alone and held. `arm`: reaching movements of an arm whose hand is perturbed at times, and
    postures that it keeps; truth.json holds what is to be found. `robot`: an arm that is like its URDF, but not quite,
    and with --human an arm whose end is held, beside the same alone.
    """
    from jaximp.recordings.outputs import new_folder

    with new_folder(out, force) as folder, bar_of("simulating") as progress:
        if what is What.rig:
            from jaximp.simulation.rig_recordings import write_rig_recordings

            write_rig_recordings(folder, holding.value, seed)
        elif what is What.robot:
            from jaximp.simulation.robot_recordings import write_robot_recordings

            write_robot_recordings(folder, urdf, 30.0 if duration is None else duration, seed, progress, human)
        else:
            from jaximp.simulation.arm_recordings import Sensors, write_arm_recordings

            write_arm_recordings(
                folder, perturbed=perturbed, unperturbed=unperturbed, seed=seed,
                duration=2.0 if duration is None else duration,
                sensors=Sensors(1e-6 * position_step, force_noise), format=format.value, progress=progress,
            )  # fmt: skip
        progress(1.0)
    typer.echo(f"recordings and job: {out}\nnext: jaximp identify {out / 'job.toml'} --out {out.name}-results")
