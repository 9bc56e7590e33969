"""`jaximp export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from jaximp.cli.terminal import JobFile, bar_of

Urdf = Annotated[Path, typer.Option("--urdf", help="URDF to write; a table of its numbers is written beside it.")]


def export(
    job_file: JobFile,
    urdf: Urdf,
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there.")] = False,
) -> None:
    """Write a robot's URDF with identified links: the file of the job, with the inertias of the nearest real bodies.

    A comment in it, and a table beside it, say which numbers the data determined and which are the file's.
    """
    from jaximp.jobs.export import export_robot
    from jaximp.jobs.job import read_job

    job, table = read_job(job_file), urdf.with_suffix(".csv")
    for path in (urdf, table):
        if path.exists() and not force:
            raise ValueError(f"{path} exists: choose another --urdf, or pass --force to replace it")
        if path.resolve() in [name.resolve() for name in job.files()]:
            raise ValueError(f"{path} is an input of the job: choose another --urdf")
    with bar_of("identifying") as progress:
        found = export_robot(job, urdf, progress)
    found.write_table(table)
    for line in found.in_words():
        typer.echo(line)
    typer.echo(f"written: {urdf.resolve()}, {table.name}")
