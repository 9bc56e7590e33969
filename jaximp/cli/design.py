"""`jaximp design`."""

from __future__ import annotations

import typer

from jaximp.cli.terminal import Force, JobFile, OutBeside, bar_of, out_beside

POINTS = 50.0
"""Of a robot's path that are drawn [1/s]."""


def design(job_file: JobFile, out: OutBeside = None, force: Force = False) -> None:
    """Design a motion that excites every parameter, within the limits of joint and robot.

    Writes trajectory.csv, trajectory.json, trajectory.yaml (a ROS JointTrajectory), summary.json and the figures.
    """
    from jaximp.design.files import write_design
    from jaximp.jobs.design import read_design_job
    from jaximp.models.chain import Chain
    from jaximp.recordings.outputs import new_folder

    job, out = read_design_job(job_file), out_beside(job_file, out, "design")
    with new_folder(out, force, inputs=[job_file]) as folder, bar_of("designing") as progress:
        found = job.run(lambda share: progress(0.9 * share))
        write_design(folder, found, job.design.sample_rate)
        from jaximp import plots

        (folder / "trajectory.png").write_bytes(plots.png(plots.design(found)))
        moved = found.moved or found.model
        if isinstance(moved, Chain):
            (folder / "robot.png").write_bytes(plots.png(plots.robot(moved, found.sampled(POINTS)["position"])))
        progress(1.0)
    for line in found.in_words():
        typer.echo(line)
    typer.echo(f"motion: {(out / 'trajectory.csv').resolve()}")
