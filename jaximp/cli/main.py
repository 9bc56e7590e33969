"""The command line: `jaximp demo | check | identify | batch | posterior | design | simulate | reproduce`."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from enum import StrEnum
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from jaximp.types import Progress

if TYPE_CHECKING:  # what a command needs is imported when it runs: `--help` must not wait for it
    from jaximp.identification.estimates import Estimates
    from jaximp.jobs.job import Job
    from jaximp.perturbation.impedance import ArmImpedance

app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Identify the mechanical impedance of human joints, and the dynamics of the robots that hold them.\n\n"
    "Begin with `jaximp demo`, then write a job file for your own recording: `jaximp check JOB.toml` looks at the data "
    "and proposes filters and a window, `jaximp identify JOB.toml --out DIR` writes estimates and a report.",
)
console = Console(stderr=True, highlight=False)
MOST_LINES = 50
"""Recordings that failed and are named one by one; quarantine.json has all."""

JobFile = Annotated[Path, typer.Argument(metavar="JOB.toml", help="What to identify, from which recording.")]
Out = Annotated[Path, typer.Option("--out", help="Folder to write; it must not exist yet.")]
Force = Annotated[bool, typer.Option("--force", help="Replace a folder that jaximp wrote earlier.")]
Seed = Annotated[int, typer.Option("--seed", help="Seed of the simulated noise.")]


class What(StrEnum):
    """What can be simulated."""

    rig = "rig"
    arm = "arm"


class Holding(StrEnum):
    """What holds the handle of the simulated rig."""

    spring = "spring"
    bands = "bands"


class Format(StrEnum):
    """What simulated trials are written as."""

    parquet = "parquet"
    csv = "csv"


class Paper(StrEnum):
    """What can be reproduced."""

    tout2023 = "tout2023"
    lakatos2011 = "lakatos2011"
    borner2020 = "borner2020"


def main() -> None:
    """Run the command line; bad input ends in one line and exit status 1."""
    try:
        app()
    except (ValueError, OSError) as error:
        message = " ".join(str(error).split())
        console.print("[bold red]error:[/] ", end="")
        console.print(message, markup=False, soft_wrap=True)
        sys.exit(1)


@app.callback()
def prepare() -> None:
    """Identification needs float64; compiled code is kept for the next run."""
    import jax

    jax.config.update("jax_enable_x64", True)
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaximp"
    with suppress(OSError):
        cache.mkdir(parents=True, exist_ok=True)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ and os.access(cache, os.W_OK):
        jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.05)


@app.command()
def identify(job_file: JobFile, out: Out, force: Force = False) -> None:
    """Estimate the parameters in every window of a recording, or the impedance of an arm from perturbation trials.

    Writes estimates.parquet (one row per window, or one per method), summary.json, report.html and the figures into
    the folder.
    """
    from jaximp.jobs.job import read_job
    from jaximp.recordings.outputs import new_folder

    job = read_job(job_file)
    with new_folder(out, force, inputs=[job_file, *job.files()]) as folder:
        _identify_into(job, folder)
    _say_where(out)


@app.command()
def posterior(job_file: JobFile, out: Out, force: Force = False) -> None:
    """Draw from the posterior of the parameters: of a whole recording and of its windows, or of an arm's impedance.

    Writes the draws as NetCDF for ArviZ, summary.json, report.html and the figures into the folder.
    """
    from jaximp.jobs.job import read_job
    from jaximp.jobs.run import infer, infer_trials
    from jaximp.recordings.outputs import new_folder
    from jaximp.reports.posterior import write_arm_posterior, write_posterior_results

    job = read_job(job_file)
    with new_folder(out, force, inputs=[job_file, *job.files()]) as folder, _progress("sampling") as progress:
        if job.trials is None:
            content = write_posterior_results(folder, infer(job, lambda share: progress(0.9 * share)), job)
        else:
            content = write_arm_posterior(folder, *infer_trials(job, lambda share: progress(0.9 * share)), job)
    for line in [f"not to be trusted: {content['why']}"] if content["why"] else content["sentences"]:
        typer.echo(line)
    _say_where(out)


@app.command()
def demo(
    out: Out = Path("jaximp-demo"),
    force: Force = False,
    seed: Seed = 0,
) -> None:
    """Identify a stiffness that doubles, on a simulated rig, and write the report."""
    from jaximp.jobs.job import read_job
    from jaximp.recordings.outputs import new_folder
    from jaximp.simulation.rig_recordings import write_rig_recordings

    with new_folder(out, force) as folder:
        with _progress("simulating") as progress:
            write_rig_recordings(folder, "spring", seed)
            progress(1.0)
        _identify_into(read_job(folder / "job.toml"), folder)
    _say_where(out)


@app.command()
def check(job_file: JobFile) -> None:
    """Look at a recording before a run: sampling, gaps, saturation, noise, delay, excitation.

    Proposes cut-off frequencies and a window for the job file. Of perturbation trials it says how many there are, and
    what the sensors allow.
    """
    from jaximp.jobs.job import read_job
    from jaximp.jobs.run import check as check_recording

    job = read_job(job_file)
    if job.trials is not None:
        _check_trials(job)
        return
    with _progress("checking") as progress:
        findings, proposal = check_recording(job, job.load(), job.load_robot_alone(), progress)
    table = Table("", "checked", "found", box=None, pad_edge=False)
    colour = {"ok": "green", "look": "yellow", "bad": "red"}
    for finding in findings:
        table.add_row(f"[{colour[finding.verdict]}]{finding.verdict}[/]", finding.topic, finding.text)
    Console().print(table)
    window = "" if proposal.window is None else f"\n[window]\nlength = {proposal.window:g}"
    typer.echo(
        f"\n# proposed: {proposal.why}\n[filter]\nposition_cutoff = {proposal.position_cutoff:g}\n"
        f"decimation_cutoff = {proposal.decimation_cutoff:g}{window}"
    )


@app.command()
def design(job_file: JobFile, out: Out, force: Force = False) -> None:
    """Design a motion that excites every parameter, within the limits of joint and robot.

    Writes trajectory.csv, trajectory.json, trajectory.yaml (a ROS JointTrajectory), summary.json and the figure.
    """
    from jaximp.design.files import write_design
    from jaximp.jobs.design import read_design_job
    from jaximp.recordings.outputs import new_folder

    job = read_design_job(job_file)
    with new_folder(out, force, inputs=[job_file]) as folder, _progress("designing") as progress:
        found = job.run(lambda share: progress(0.9 * share))
        write_design(folder, found, job.design.sample_rate)
        from jaximp import plots

        (folder / "trajectory.png").write_bytes(plots.png(plots.design(found)))
        progress(1.0)
    for line in found.in_words():
        typer.echo(line)
    typer.echo(f"motion: {(out / 'trajectory.csv').resolve()}")


@app.command()
def simulate(
    what: What,
    out: Out,
    force: Force = False,
    seed: Seed = 0,
    holding: Annotated[Holding, typer.Option("--holding", help="rig: what holds the handle.")] = Holding.spring,
    perturbed: Annotated[int, typer.Option("--perturbed", help="arm: how many movements are perturbed.")] = 20,
    unperturbed: Annotated[int, typer.Option("--unperturbed", help="arm: how many are not.")] = 40,
    duration: Annotated[float, typer.Option("--duration", help="arm: of a movement, in s.")] = 2.0,
    position_step: Annotated[float, typer.Option("--position-step", help="arm: step of the encoders, in um.")] = 1.0,
    force_noise: Annotated[float, typer.Option("--force-noise", help="arm: white noise of the force, in N.")] = 0.0,
    format: Annotated[Format, typer.Option("--format", help="arm: of the recordings.")] = Format.parquet,
) -> None:
    """Write simulated recordings, with a job file that `identify` reads.

    `rig`: a rig of one joint, alone and held. `arm`: reaching movements of an arm whose hand is perturbed at times, and
    postures that it keeps; truth.json holds what is to be found.
    """
    from jaximp.recordings.outputs import new_folder

    with new_folder(out, force) as folder, _progress("simulating") as progress:
        if what is What.rig:
            from jaximp.simulation.rig_recordings import write_rig_recordings

            write_rig_recordings(folder, holding.value, seed)
        else:
            from jaximp.simulation.arm_recordings import Sensors, write_arm_recordings

            write_arm_recordings(
                folder, perturbed=perturbed, unperturbed=unperturbed, duration=duration, seed=seed,
                sensors=Sensors(1e-6 * position_step, force_noise), format=format.value, progress=progress,
            )  # fmt: skip
        progress(1.0)
    typer.echo(f"recordings and job: {out}\nnext: jaximp identify {out / 'job.toml'} --out {out.name}-results")


@app.command()
def batch(
    job_file: JobFile,
    files: Annotated[list[str] | None, typer.Argument(metavar="FILES", help="Recordings, patterns or folders.")] = None,
    out: Annotated[Path, typer.Option("--out", help="Folder of the results.")] = Path("batch"),
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
    from jaximp.batch.plan import find_items, make_plan
    from jaximp.batch.run import check_metadata, first_trouble, run_plan
    from jaximp.jobs.job import read_job

    job = read_job(job_file)
    plan = make_plan(job, find_items(files or [], manifest, allow_outside), partition)
    if dry_run:
        check_metadata(job, plan)
        for line in filter(None, [*plan.in_words(job), first_trouble(job, plan)]):
            typer.echo(line)
        return
    chosen = reports[0] if reports and len(reports) == 1 else reports or "none"
    with _interruptible(), _events(len(plan.items), quiet, json_lines) as tell:
        outcome = run_plan(job, plan, out, workers, scheduler, resume, chosen, tell)
    if not json_lines:
        for failed in outcome.failed[:MOST_LINES]:
            console.print(f"failed: {failed['recording']}: {failed['reason']}", markup=False, soft_wrap=True)
        if len(outcome.failed) > MOST_LINES:
            others = len(outcome.failed) - MOST_LINES
            console.print(f"failed: {others} others: {out.resolve() / 'quarantine.json'}", soft_wrap=True)
        for broken in outcome.broken:
            console.print(f"unfinished: {broken}; run again with --resume", markup=False, soft_wrap=True)
    if not (quiet or json_lines):
        done = outcome.recordings - len(outcome.failed)
        typer.echo(
            f"{done} of {outcome.recordings} recordings identified, "
            f"{outcome.trusted} of {outcome.windows} windows trusted"
        )
        if resume:
            typer.echo(f"{outcome.skipped} were done already, {outcome.recordings - outcome.skipped} were done now")
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
    if outcome.exit_status:
        raise typer.Exit(outcome.exit_status)


@app.command()
def reproduce(paper: Paper, out: Out, force: Force = False) -> None:
    """Redraw a paper's figures and tables; tables.json holds the numbers beside the paper's."""
    from jaximp.recordings.outputs import new_folder

    study = import_module(f"jaximp.papers.{paper.value}")
    with new_folder(out, force) as folder, _progress(f"reproducing {paper.value}") as progress:
        study.reproduce(folder, progress)
    typer.echo(f"figures and tables: {out}")


def _identify_into(job: Job, folder: Path) -> None:
    if job.trials is not None:
        _identify_trials_into(job, folder)
        return
    from jaximp.identification.identify import at_other_lengths, in_windows, prepare

    # Figures take long to import: that is done while the other core compiles.
    Thread(target=import_module, args=("jaximp.reports.estimates",)).start()
    with _progress("identifying") as progress:
        recording, alone = job.load(), job.load_robot_alone()
        progress(0.1)
        prepared = prepare(job.pipeline_for(recording), recording, alone)
        progress(0.3)
        estimates = in_windows(prepared, lambda share: progress(0.3 + 0.3 * share), 2 * job.window.length)
        others = at_other_lengths(prepared, alone, progress=lambda share: progress(0.6 + 0.2 * share))
        from jaximp.reports.estimates import write_results

        write_results(folder, estimates, sorted([estimates[0], *others], key=lambda e: e.window), job, recording)
        progress(1.0)
    _say_result(estimates[0])


def _identify_trials_into(job: Job, folder: Path) -> None:
    from jaximp.perturbation.impedance import identify_trials

    Thread(target=import_module, args=("jaximp.reports.impedance",)).start()
    with _progress("identifying") as progress:
        result = identify_trials(job, lambda share: progress(0.8 * share))
        from jaximp.reports.impedance import write_trials_results

        write_trials_results(folder, result, job)
        progress(1.0)
    for estimate in result.estimates:
        _say_impedance(estimate)
    for note in result.main.notes:
        typer.echo(f"note: {note}")


def _say_impedance(found: ArmImpedance) -> None:
    typer.echo(f"{found.title}: {found.trials} perturbed trials, {1e3 * found.window:g} ms after the onset")
    for name, unit, value, stderr in zip(found.names, found.units, found.theta, found.stderr, strict=True):
        typer.echo(f"{name:>20} {value:11.4g} ({stderr:.2g}) {unit}")
    typer.echo(f"verdict: {found.verdict}" + (f": {found.reason}" if found.reason else ""))
    for warning in found.warnings:
        typer.echo(f"warning: {warning}")


def _check_trials(job: Job) -> None:
    """How many trials were read, and what reading says of them."""
    from jaximp.perturbation.impedance import DISAGREEMENT
    from jaximp.perturbation.movement_trials import handle_disagreement

    for table in job.tables_of_trials():
        perturbed, unperturbed, notes = table.load()
        kind = "perturbed postures" if table.task == "posture" else "perturbed movements"
        others = 0 if unperturbed is None else len(unperturbed)
        typer.echo(f"{len(perturbed)} {kind}" + (f", {others} unperturbed ones" if table.task != "posture" else ""))
        share, disagreement = handle_disagreement(perturbed, table.known_handle())
        for note in (*notes, *([disagreement] if share > DISAGREEMENT[0] else [])):
            typer.echo(f"- {note}")


def _say_result(estimates: Estimates) -> None:
    counts = {name: count for name, count in estimates.verdicts.counts().items() if count}
    typer.echo("windows: " + ", ".join(f"{count} {name}" for name, count in counts.items()))
    complaint = estimates.verdicts.complaint()
    if complaint:
        typer.echo(complaint)
        return
    typer.echo("mean and standard deviation over the trusted windows:")
    shown = estimates.summarised()
    found = zip(shown.names, shown.units, shown.mean_over_trusted(), shown.sd_over_trusted(), strict=True)
    for name, unit, mean, sd in found:
        typer.echo(f"{name:>20} {mean:11.4g} ({sd:.2g}) {unit}")


def _say_where(out: Path) -> None:
    typer.echo(f"report: {(out / 'report.html').resolve()}")


@contextmanager
def _interruptible() -> Iterator[None]:
    """SIGTERM ends a batch as Ctrl-C does: what is done stays, `--resume` does the rest."""

    def stop(number: int, frame: object) -> None:
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    except KeyboardInterrupt:
        console.print("interrupted: run again with --resume")
        raise SystemExit(130) from None
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def _events(total: int, quiet: bool, json_lines: bool) -> Iterator[Callable[[dict[str, Any]], None]]:
    """A bar with rate, failures and time left; or lines of JSON; or nothing."""
    import json

    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bar

    columns = (
        TextColumn("identifying"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"),
        TextColumn("{task.fields[failed]} failed"), TimeRemainingColumn(),
    )  # fmt: skip
    hidden = quiet or json_lines or not console.is_terminal
    with Bar(*columns, console=console, transient=True, disable=hidden) as bar:
        name = bar.add_task("", total=total, rate="", failed=0)

        def tell(event: dict[str, Any]) -> None:
            if json_lines:
                typer.echo(json.dumps(event))
            if event["event"] == "resume":
                bar.update(name, completed=event["skipped"])
            if event["event"] == "batch":
                rate = f"{event['per_second']:.3g} a second"
                bar.update(name, completed=event["done"], failed=event["failed"], rate=rate)

        yield tell


@contextmanager
def _progress(task: str) -> Iterator[Progress]:
    """A bar on the terminal, nothing where there is none."""
    from rich.progress import BarColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Bar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        name = bar.add_task(task, total=1.0)
        yield lambda share: bar.update(name, completed=share)
