"""`jaximp posterior`."""

from __future__ import annotations

import typer

from jaximp.cli.terminal import Force, JobFile, OutBeside, bar_of, out_beside, say_where


def posterior(job_file: JobFile, out: OutBeside = None, force: Force = False) -> None:
    """Draw from the posterior of the parameters: of a whole recording and of its windows, or of an arm's impedance.

    Writes the draws as NetCDF for ArviZ, summary.json, report.html and the figures into the folder.
    """
    from jaximp.jobs.job import TrialsJob, read_job
    from jaximp.jobs.run import complete, infer_recording
    from jaximp.jobs.run_trials import infer_trials
    from jaximp.recordings.outputs import new_folder
    from jaximp.reports.posterior import write_arm_posterior, write_posterior_results

    job, out = read_job(job_file), out_beside(job_file, out, "posterior")
    with new_folder(out, force, inputs=[job_file, *job.files()]) as folder, bar_of("sampling") as progress:
        if isinstance(job, TrialsJob):
            content = write_arm_posterior(folder, infer_trials(job, lambda share: progress(0.9 * share)), job)
        else:
            alone = job.load_robot_alone()
            job, recording = complete(job, job.load(), alone)
            found = infer_recording(job, recording, alone, lambda share: progress(0.9 * share))
            content = write_posterior_results(folder, found, job)
    for line in [f"not to be trusted: {content['why']}"] if content["why"] else content["sentences"]:
        typer.echo(line)
    say_where(out)
