"""`jaximp check`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from jaximp.cli.terminal import JobFile, bar_of

if TYPE_CHECKING:
    from jaximp.jobs.job import TrialsJob


Write = Annotated[bool, typer.Option("--write", help="Write what is proposed into the job.")]


def check(job_file: JobFile, write: Write = False) -> None:
    """Look at a recording before a run: sampling, gaps, saturation, noise, delay, excitation.

    Proposes cut-off frequencies and a window for the job file. Of perturbation trials it says how many there are, and
    what the sensors allow.
    """
    from jaximp.jobs.job import TrialsJob, read_job
    from jaximp.jobs.run import check as check_recording

    job = read_job(job_file)
    if isinstance(job, TrialsJob):
        if write:
            raise ValueError("of trials nothing is proposed that could be written: leave out --write")
        _check_trials(job)
        return
    with bar_of("checking") as progress:
        findings, proposal = check_recording(job, job.load(), job.load_robot_alone(), progress)
    table = Table("", "checked", "found", box=None, pad_edge=False)
    colour = {"ok": "green", "look": "yellow", "bad": "red"}
    for finding in findings:
        table.add_row(f"[{colour[finding.verdict]}]{finding.verdict}[/]", *map(escape, (finding.topic, finding.text)))
    Console().print(table)
    window = "" if proposal.window is None else f"\n[window]\nlength = {proposal.window:g}"
    typer.echo(
        f"\n# proposed: {proposal.why}\n[filter]\nposition_cutoff = {proposal.position_cutoff:g}\n"
        f"decimation_cutoff = {proposal.decimation_cutoff:g}{window}"
    )
    if write:
        from jaximp.jobs.proposals import with_proposal
        from jaximp.recordings.outputs import write_whole

        write_whole(job_file, with_proposal(job.text, proposal).encode())
        typer.echo(f"written into {job_file}")


def _check_trials(job: TrialsJob) -> None:
    """How many trials were read, and what reading says of them."""
    from jaximp.perturbation.rules import DISAGREEMENT
    from jaximp.perturbation.sensors import handle_disagreement

    for table in job.tables():
        perturbed, unperturbed, notes = table.load()
        kind = "perturbed postures" if table.task == "posture" else "perturbed movements"
        others = 0 if unperturbed is None else len(unperturbed)
        typer.echo(f"{len(perturbed)} {kind}" + (f", {others} unperturbed ones" if table.task != "posture" else ""))
        share, disagreement = handle_disagreement(perturbed, table.known_handle())
        for note in (*notes, *([disagreement] if share > DISAGREEMENT[0] else [])):
            typer.echo(f"- {note}")
