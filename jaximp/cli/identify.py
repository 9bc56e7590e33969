"""`jaximp identify`."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

import typer

from jaximp.cli.terminal import Force, JobFile, OutBeside, bar_of, out_beside, say_where

if TYPE_CHECKING:
    from jaximp.identification.estimates import Estimates
    from jaximp.jobs.job import Job, TrialsJob
    from jaximp.perturbation.impedance import ArmImpedance


def identify(job_file: JobFile, out: OutBeside = None, force: Force = False) -> None:
    """Estimate the parameters in every window of a recording, or along a path that follows them, or the impedance of an
    arm from perturbation trials.

    A recording in place of the job is identified as the job that `init` would write for it.

    Writes estimates.parquet (one row per window, or one per method), summary.json, report.html and the figures into
    the folder.
    """
    from jaximp.jobs.first_job import read_job_or_recording
    from jaximp.recordings.outputs import new_folder

    with bar_of("looking into the file") as progress:
        job = read_job_or_recording(job_file, progress)
    if job_file.suffix.lower() != ".toml":
        typer.echo(job.text)
    out = out_beside(job_file, out, "results")
    with new_folder(out, force, inputs=[job_file, *job.files()]) as folder:
        say = identify_into(job, folder)
    say()
    say_where(out)


def identify_into(job: Job, folder: Path) -> Callable[[], None]:
    """Write all results, and return what says them: a terminal that is gone by then must not take the folder along."""
    from jaximp.jobs.job import TrialsJob

    if isinstance(job, TrialsJob):
        return _identify_trials_into(job, folder)
    from jaximp.identification.identify import at_other_lengths, in_windows, longest_of
    from jaximp.jobs.run import CHOSEN, complete, load_pair, prepare, weigh

    # Figures take long to import: that is done while the other core compiles.
    Thread(target=import_module, args=("jaximp.reports.estimates",)).start()
    with bar_of("identifying") as progress:
        recording, alone, held_out, pair = job.load(), job.load_robot_alone(), job.load_held_out(), load_pair(job)
        progress(0.1)
        job, recording = complete(job, recording, alone, lambda share: progress(0.1 + 0.1 * share))
        prepared = prepare(job, recording, alone, held_out)
        progress(0.3)
        estimates = in_windows(prepared, lambda share: progress(0.3 + 0.3 * share), longest_of(prepared))
        others = at_other_lengths(prepared, alone, progress=lambda share: progress(0.6 + 0.2 * share))
        from jaximp.reports.estimates import write_results

        lengths = [] if longest_of(prepared) is None else sorted([estimates[0], *others], key=lambda e: e.window)
        found = weigh(job, pair)
        progress(0.9)
        write_results(folder, estimates, lengths, job, prepared.recording, found)
        progress(1.0)

    def say() -> None:
        for note in (note for note in recording.notes if note.startswith(CHOSEN)):
            typer.echo(note)
        _say_result(estimates[0])
        for line in [] if found is None else found.in_words():
            typer.echo(line)

    return say


def _how_loose(estimates: Estimates, share: float) -> str:
    """Of a parameter, by the share that `Estimates.undetermined` gives."""
    from jaximp.models.chain import Chain

    if not math.isfinite(share):
        return ""
    if isinstance(estimates.model, Chain):
        return f": half of its interval is {share:.0%} of its size"
    times = f"{share:.0%} of it" if share < 1 else f"{share:.2g} times as large"
    return f": its standard error in one {estimates.kind} is {times}"


def _identify_trials_into(job: TrialsJob, folder: Path) -> Callable[[], None]:
    from jaximp.jobs.run_trials import identify_trials

    Thread(target=import_module, args=("jaximp.reports.impedance",)).start()
    with bar_of("identifying") as progress:
        result = identify_trials(job, lambda share: progress(0.8 * share))
        from jaximp.reports.impedance import write_trials_results

        write_trials_results(folder, result, job)
        progress(1.0)

    def say() -> None:
        for estimate in result.estimates:
            _say_impedance(estimate)
        for note in result.notes:
            typer.echo(f"note: {note}")

    return say


def _say_result(estimates: Estimates) -> None:
    counts = {name: count for name, count in estimates.verdicts.counts().items() if count}
    kind = estimates.kind
    typer.echo(f"{kind}s: " + ", ".join(f"{count} {name}" for name, count in counts.items()))
    unpredictive = int(estimates.unpredictive.sum())
    if unpredictive:
        ahead = "of the next window " * (kind == "window") + "worse than a constant would"
        typer.echo(f"of the trusted, {unpredictive} predict the torque {ahead}")
    complaint, shown = estimates.verdicts.complaint(kind), estimates.summarised()
    if complaint:
        typer.echo(complaint)
    for where, found in (("recording", estimates.residuals), ("held out", estimates.held_out)):
        if found is not None and (estimates.held_out is not None or len(found.moving) > 1):
            typer.echo(f"residual, {where}: {found.total:.2%} of the torque of all joints")
    means, sds, loose = shown.mean_over_trusted(), shown.sd_over_trusted(), shown.undetermined()
    if not any(map(math.isfinite, means)):
        return
    one, width = len(shown.end) == 1, max(20, *map(len, shown.names))
    low, high = shown.interval()
    halves = (high[0] - low[0]) / 2
    typer.echo("95 % intervals:" if one else f"mean and standard deviation over the trusted {kind}s:")
    for name, unit, mean, sd, half in zip(shown.names, shown.units, means, sds, halves, strict=True):
        spread = f"± {half:.2g}" if one else f"({sd:.2g})"
        said = f"{mean:11.4g} {spread} {unit}" if math.isfinite(mean) else f"{'-':>11} not to be trusted"
        if name in shown.changed and math.isfinite(mean):
            said = f"{'not one value':>13}: {shown.changed[name]}"
        elif (ends := shown.range_of(name)) is not None and math.isfinite(mean):
            said = f"{'not one value':>13}: between {ends[0]:.3g} and {ends[1]:.3g} {unit} in nine of ten {kind}s"
        elif name in loose:
            said += f", not determined{_how_loose(shown, loose[name])}"
        typer.echo(f"{name:>{width}} {said}")


def _say_impedance(found: ArmImpedance) -> None:
    typer.echo(f"{found.title}: {found.trials} perturbed trials, {1e3 * found.window:g} ms after the onset")
    for name, unit, value, stderr in zip(found.names, found.units, found.theta, found.stderr, strict=True):
        typer.echo(f"{name:>20} {value:11.4g} ({stderr:.2g}) {unit}")
    typer.echo(f"verdict: {found.verdict}" + (f": {found.reason}" if found.reason else ""))
    for warning in found.warnings:
        typer.echo(f"warning: {warning}")
