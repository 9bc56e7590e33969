"""`jaximp demo`."""

from __future__ import annotations

from pathlib import Path

from jaximp.cli.identify import identify_into
from jaximp.cli.terminal import Force, Out, Seed, bar_of, say_where


def demo(out: Out = Path("jaximp-demo"), force: Force = False, seed: Seed = 0) -> None:
    """Identify a stiffness that doubles, on a simulated rig, and write the report."""
    from jaximp.jobs.job import read_job
    from jaximp.recordings.outputs import new_folder
    from jaximp.simulation.rig_recordings import write_rig_recordings

    with new_folder(out, force) as folder:
        with bar_of("simulating") as progress:
            write_rig_recordings(folder, "spring", seed)
            progress(1.0)
        identify_into(read_job(folder / "job.toml"), folder)
    say_where(out)
