"""`jaximp demo`."""

from __future__ import annotations

from pathlib import Path

import typer

from jaximp.cli.identify import identify_into
from jaximp.cli.terminal import Force, Out, Seed, bar_of, say_where


def demo(out: Out = Path("jaximp-demo"), force: Force = False, seed: Seed = 0) -> None:
    """Identify a simulated ankle whose stiffness doubles, write the report, and say what the truth is."""
    from jaximp.jobs.job import read_job
    from jaximp.recordings.outputs import new_folder
    from jaximp.simulation.ankle import truth_in_words, write_ankle_recording

    with new_folder(out, force) as folder:
        with bar_of("simulating") as progress:
            write_ankle_recording(folder, seed)
            progress(1.0)
        say = identify_into(read_job(folder / "job.toml"), folder)
    say()
    typer.echo(f"the truth: {'; '.join(truth_in_words())}")
    say_where(out)
