"""Jobs, run: a job and its files -> results in memory."""

from __future__ import annotations

from jaximp.identification.check import Finding, Proposal, check_recording
from jaximp.identification.drive_gains import DriveGains
from jaximp.identification.estimates import Estimates
from jaximp.identification.identify import estimate
from jaximp.identification.payload import required_chain
from jaximp.identification.pipeline import Pipeline
from jaximp.identification.prepared import Prepared
from jaximp.identification.prepared import prepare as prepare_recording
from jaximp.jobs.job import Job, TrialsJob, WindowJob
from jaximp.jobs.payload import Weighed
from jaximp.jobs.run_trials import identify_trials, infer_trials
from jaximp.perturbation.trials_result import TrialsResult
from jaximp.posterior.arm import ArmInference
from jaximp.posterior.inference import Inference, posterior_of
from jaximp.types import Progress, Recording, RobotAlone


def identify(job: Job, progress: Progress = lambda share: None) -> list[Estimates] | TrialsResult:
    """Run a job: a sequence of results, one per method (a job without a robot beside the human has one).

    **Returns:** `Estimates` of a recording's windows, or, of a job with `[trials]`, what `identify_trials` does.

    **Raises:** `ValueError` with one line that names the cause and the remedy.
    """
    if isinstance(job, TrialsJob):
        return identify_trials(job, progress)
    return identify_recording(job, job.load(), job.load_robot_alone(), progress, job.load_held_out())


def identify_recording(
    job: WindowJob,
    recording: Recording,
    alone: RobotAlone = None,
    progress: Progress = lambda share: None,
    held_out: Recording | None = None,
) -> list[Estimates]:
    """As `identify`, for recordings that are in memory; `alone` may be two, before and after the human's."""
    return estimate(job.pipeline_for(recording), recording, alone, progress, held_out)


def load_pair(job: WindowJob) -> tuple[list[Recording], list[Recording]] | None:
    """The recordings that `weigh` needs, without and with a load, where a job has a `[payload]`.

    **Raises:** `ValueError` as `weigh` for what is wrong before anything is computed.
    """
    if job.payload is None:
        return None
    alone, loaded = job.load_pair()
    required_chain(_pipeline_of(job, loaded))
    return alone, loaded


def weigh(job: WindowJob, pair: tuple[list[Recording], list[Recording]] | None = None) -> Weighed | DriveGains | None:
    """What a job with `[payload]` asks for: the load, or by a known load the gains of the drives; from a pair of
    recordings that was read already, or from the job's.

    **Raises:** `ValueError` with one line that names the cause and the remedy.
    """
    pair = load_pair(job) if pair is None else pair
    if job.payload is None or pair is None:
        return None
    return job.payload.found(_pipeline_of(job, pair[1]), *pair)


def _pipeline_of(job: WindowJob, loaded: list[Recording]) -> Pipeline:
    return job.pipeline(loaded[0].joints, loaded[0].sample_rate)


def prepare(
    job: WindowJob, recording: Recording | None = None, alone: RobotAlone = None, held_out: Recording | None = None
) -> Prepared:
    """Read the recordings of a job (or take these) and filter them: rows for least squares, windows still to come."""
    if recording is None:
        recording, alone, held_out = job.load(), job.load_robot_alone(), job.load_held_out()
    return prepare_recording(job.pipeline_for(recording), recording, alone, held_out)


def check(
    job: WindowJob, recording: Recording, alone: RobotAlone = None, progress: Progress = lambda share: None
) -> tuple[list[Finding], Proposal]:
    """Look at a recording for the model of a job, and propose cut-offs and a window."""
    return check_recording(job.pipeline_for(recording), recording, alone, progress)


def infer(job: Job, progress: Progress = lambda share: None) -> Inference | ArmInference:
    """Posteriors of a job: `Inference` of a recording and its windows, or, of a job with `[trials]`, `ArmInference`.

    **Raises:** `ValueError` with one line that names the cause and the remedy: filters inside every window, parameters
    that the data leave undetermined, an impossible prior, an impedance without standard errors, and as `identify`.
    """
    if isinstance(job, TrialsJob):
        return infer_trials(job, progress)
    return infer_recording(job, job.load(), job.load_robot_alone(), progress)


def infer_recording(
    job: WindowJob, recording: Recording, alone: RobotAlone = None, progress: Progress = lambda share: None
) -> Inference:
    """As `infer`, for recordings that are in memory."""
    if job.model.tip is not None:
        raise ValueError("a human at the end of a robot has no posterior: leave out [model.human], or run identify")
    if job.track is not None:
        raise ValueError(
            "posteriors are those of windows, and the bands of [track] hold what is not known already: leave out "
            "[track], or run identify"
        )
    return posterior_of(job.pipeline_for(recording), job.posterior, recording, alone, progress)
