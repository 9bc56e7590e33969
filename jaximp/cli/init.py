"""`jaximp init`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jaximp.cli.terminal import bar_of

RecordingFile = Annotated[Path, typer.Argument(metavar="FILE", help="A recording, as it was written.")]
Time = Annotated[str | None, typer.Option("--time", help="The column of the time.")]
Position = Annotated[list[str] | None, typer.Option("--position", help="That of the position; one for each joint.")]
Torque = Annotated[list[str] | None, typer.Option("--torque", help="That of the torque; one for each joint.")]
SampleRate = Annotated[float | None, typer.Option("--sample-rate", help="Of a file without a time, in Hz.")]


def init(
    file: RecordingFile,
    time: Time = None,
    position: Position = None,
    torque: Torque = None,
    sample_rate: SampleRate = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the job that stands there.")] = False,
) -> None:
    """Write a first job beside a recording: its columns by their names, filters and a window by what it shows.

    Where several columns could be meant it says so, and they are named by options. Look at every line of the job.
    """
    from jaximp.jobs.first_job import first_job
    from jaximp.recordings.outputs import write_whole

    job_file = file.with_suffix(".toml")
    if job_file.exists() and not force:
        raise ValueError(f"{job_file} exists: pass --force to replace it")
    given = {"time": [time] if time else [], "position": position or [], "torque": torque or []}
    with bar_of("looking into the file") as progress:
        text = first_job(file, given, sample_rate, progress)
    write_whole(job_file, text.encode())
    typer.echo(text)
    typer.echo(f"written: {job_file}; look at it, then run: jaximp identify {job_file}")
