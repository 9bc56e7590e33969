"""`jaximp batch`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from jaximp.cli.terminal import JobFile, console

if TYPE_CHECKING:
    from jaximp.batch.run import Outcome

MOST_LINES = 50
"""Recordings that failed and are named one by one; quarantine.json has all."""


def batch(
    job_file: JobFile,
    files: Annotated[list[str] | None, typer.Argument(metavar="FILES", help="Recordings, patterns or folders.")] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the results.")] = Path("batch"),
    manifest: Annotated[Path | None, typer.Option("--manifest", help="CSV or Parquet, a row per recording.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be done.")] = False,
    workers: Annotated[int, typer.Option("--workers", min=0, help="Processes of a local Dask cluster.")] = 0,
    scheduler: Annotated[str | None, typer.Option("--scheduler", help="Address of a Dask scheduler.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Do what is missing or has changed.")] = False,
    reports: Annotated[
        list[str] | None,
        typer.Option(
            "--reports",
            help="Which get a report: all, none, failed (not a single trusted window), or names (many times).",
        ),
    ] = None,
    partition: Annotated[list[str] | None, typer.Option("--partition", help="Column of the manifest.")] = None,
    allow_outside: Annotated[bool, typer.Option("--allow-outside", help="A manifest may name any path.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Say nothing but what failed.")] = False,
    json_lines: Annotated[bool, typer.Option("--json", help="Say what happens in lines of JSON.")] = False,
) -> None:
    """Identify many recordings by one job, on all cores or on a cluster.

    Writes a Parquet data set, estimates (a row per window) and recordings (a row each), and overview.html over all of
    them. What fails is listed in quarantine.json, and the rest goes on; the exit status is 3 then. A run that was
    broken off goes on with --resume, which also writes reports that are asked for later.
    """
    from jaximp.batch.plan import find_items, make_plan, of_recordings
    from jaximp.batch.run import check_metadata, first_trouble, run_plan
    from jaximp.jobs.job import read_job

    job = of_recordings(read_job(job_file))
    plan = make_plan(job, find_items(files or [], manifest, allow_outside), partition)
    if dry_run:
        check_metadata(job, plan)
        for line in filter(None, [*plan.in_words(job), first_trouble(job, plan)]):
            typer.echo(line)
        return
    chosen = reports[0] if reports and len(reports) == 1 else reports or "none"
    with _events(len(plan.items), quiet, json_lines) as tell:
        outcome = run_plan(job, plan, out, workers, scheduler, resume, chosen, tell)
    if not json_lines:
        _say_failures(outcome, out)
    if not (quiet or json_lines):
        _say_outcome(outcome, out, resume)
    if outcome.exit_status:
        raise typer.Exit(outcome.exit_status)


def _say_failures(outcome: Outcome, out: Path) -> None:
    for failed in outcome.failed[:MOST_LINES]:
        console.print(f"failed: {failed['recording']}: {failed['reason']}", markup=False, soft_wrap=True)
    if len(outcome.failed) > MOST_LINES:
        others = len(outcome.failed) - MOST_LINES
        console.print(f"failed: {others} others: {out.resolve() / 'quarantine.json'}", soft_wrap=True)
    for broken in outcome.broken:
        console.print(f"unfinished: {broken}; run again with --resume", markup=False, soft_wrap=True)


def _say_outcome(outcome: Outcome, out: Path, resumed: bool) -> None:
    identified, left = outcome.done - len(outcome.failed), outcome.recordings - outcome.done
    windows = f"{outcome.trusted} of {outcome.windows} windows trusted"
    typer.echo(f"{identified} of {outcome.recordings} recordings identified, {windows}")
    if left:
        typer.echo(f"unfinished: {left} recordings are not done; run again with --resume")
    if resumed:
        typer.echo(f"{outcome.skipped} were done already, {outcome.done - outcome.skipped} were done now")
    if outcome.dropped:
        typer.echo(f"{outcome.dropped} of an earlier run are not among them: their results were removed")
    if outcome.outdated:
        typer.echo(f"{outcome.outdated} reports of an earlier run were removed: ask for them again with --reports")
    for name, why in list(outcome.odd.items())[:MOST_LINES]:
        typer.echo(f"{name}: {why}")
    if outcome.doubted:
        typer.echo(f"{outcome.doubted} without a trusted window; {outcome.doubt}")
    typer.echo(f"results: {out.resolve()}\noverview: {out.resolve() / 'overview.html'}")
    if (out / "reports").is_dir():
        typer.echo(f"reports: {out.resolve() / 'reports'}")


@contextmanager
def _events(total: int, quiet: bool, json_lines: bool) -> Iterator[Callable[[dict[str, Any]], None]]:
    """A bar with rate, failures and time left; or lines of JSON; or nothing."""
    import json

    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("identifying"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"),
        TextColumn("{task.fields[failed]} failed"), TimeRemainingColumn(),
    )  # fmt: skip
    hidden = quiet or json_lines or not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=hidden) as bar:
        name = bar.add_task("", total=total, rate="", failed=0)

        def tell(event: dict[str, Any]) -> None:
            if json_lines:
                typer.echo(json.dumps(event))
            if event["event"] == "interrupted":
                kept = f"{event['done']} of {event['of']} recordings are done, and kept"
                console.print(f"{kept}: run again with --resume", soft_wrap=True)
            if event["event"] == "resume":
                bar.update(name, completed=event["skipped"])
            if event["event"] == "batch":
                rate = f"{event['per_second']:.3g} a second"
                bar.update(name, completed=event["done"], failed=event["failed"], rate=rate)

        yield tell
