"""Jobs, run: a job and its files -> results in memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from jaximp.identification.check import Finding, Proposal, check_recording, propose
from jaximp.identification.drive_gains import DriveGains
from jaximp.identification.estimates import Estimates
from jaximp.identification.filter_settings import FilterSettings
from jaximp.identification.identify import estimate
from jaximp.identification.payload import required_chain
from jaximp.identification.pipeline import Pipeline, WindowSettings
from jaximp.identification.prepared import Prepared
from jaximp.identification.prepared import prepare as prepare_recording
from jaximp.jobs.job import Job, TrialsJob, WindowJob
from jaximp.jobs.payload import Weighed
from jaximp.jobs.run_trials import identify_trials, infer_trials
from jaximp.models.base import Model
from jaximp.perturbation.trials_result import TrialsResult
from jaximp.posterior.arm import ArmInference
from jaximp.posterior.inference import Inference, posterior_of
from jaximp.trust.window_rules import is_chain
from jaximp.types import Progress, Recording, RobotAlone

CHOSEN = "chosen by what the recording shows"
"""How the note begins on what a job leaves out."""


def identify(
    job: Job | Recording,
    progress: Progress = lambda share: None,
    *,
    model: Model | None = None,
    window_s: float | None = None,
    position_cutoff: float | None = None,
    decimation_cutoff: float | None = None,
) -> list[Estimates] | TrialsResult:
    """Run a job, or identify a recording: a sequence of results, one per method (one without a robot beside the human).

    **Arguments:** a job, or a recording in memory and the `model` that is to explain its torque. Of a recording
    `window_s` is the length of the windows [s], and the cut-offs [Hz] are those of `[filter]`; what is left out is what
    `check` proposes, and a note says what was chosen.

    **Returns:** `Estimates` of a recording's windows, or, of a job with `[trials]`, what `identify_trials` does.

    **Raises:** `ValueError` with one line that names the cause and the remedy.

    **Example:**

    ```pycon
    >>> recording = jaximp.read_job("examples/ankle.toml").load()
    >>> model, filters = jaximp.models.HumanJoint(), {"position_cutoff": 90, "decimation_cutoff": 45}
    >>> (found,) = jaximp.identify(recording, model=model, window_s=2, **filters)
    >>> print(found.changed["stiffness"].how)
    60 until 12 s, then 120

    ```
    """
    if isinstance(job, Recording):
        given = FilterSettings(position_cutoff=position_cutoff, decimation_cutoff=decimation_cutoff)
        return _identify_alone(job, model, window_s, given, progress)
    if model is not None or window_s is not None or position_cutoff is not None or decimation_cutoff is not None:
        raise ValueError("a job says what its model, windows and filters are: pass it alone, or pass a recording")
    if isinstance(job, TrialsJob):
        return identify_trials(job, progress)
    return identify_recording(job, job.load(), job.load_robot_alone(), progress, job.load_held_out())


def _identify_alone(
    recording: Recording, model: Model | None, window: float | None, given: FilterSettings, progress: Progress
) -> list[Estimates]:
    if model is None:
        raise ValueError("a recording needs a model: pass model=jaximp.models.HumanJoint(), or another")
    if window is not None and not 0 < window < math.inf:
        raise ValueError(f"window_s is {window}: it must be a number of seconds above zero")
    pipeline = Pipeline(recording.sample_rate, model, WindowSettings(math.inf if window is None else window), given)
    open_filters = given == FilterSettings()
    left_out = [name for name, is_open in (("filter", open_filters), ("window", window is None)) if is_open]
    pipeline, said = completed(pipeline, left_out, recording, progress=progress)
    return estimate(pipeline, _with_note(recording, said), progress=progress)


def completed(
    pipeline: Pipeline,
    left_out: Sequence[str],
    recording: Recording,
    alone: RobotAlone = None,
    progress: Progress = lambda share: None,
) -> tuple[Pipeline, str]:
    """A pipeline with filters and windows that suit a recording, and what was chosen, in words.

    **Arguments:** `left_out`, which of `filter` and `window` are open.

    **Raises:** `ValueError` where no length of the windows that was tried excites the model.
    """
    if not left_out:
        return pipeline, ""
    windows = "window" in left_out and not is_chain(pipeline.model.roles)
    findings, found = propose(pipeline, recording, alone, progress, filters="filter" in left_out, windows=windows)
    said = []
    if "filter" in left_out:
        position, decimation = found.position_cutoff, found.decimation_cutoff
        chosen = replace(pipeline.filter, position_cutoff=position, decimation_cutoff=decimation)
        pipeline = replace(pipeline, filter=chosen)
        said.append(f"[filter] position_cutoff = {position:g}, decimation_cutoff = {decimation:g}")
    if windows:
        if found.window is None:
            raise ValueError(f"no window can be proposed ({findings[-1].text}): give length in [window]")
        pipeline = replace(pipeline, window=replace(pipeline.window, length=found.window))
        said.append(f"[window] length = {found.window:g}")
    return pipeline, f"{CHOSEN}: {'; '.join(said)}" if said else ""


def complete(
    job: WindowJob, recording: Recording, alone: RobotAlone = None, progress: Progress = lambda share: None
) -> tuple[WindowJob, Recording]:
    """A job with filters and windows that suit its recording, where it leaves them out, and the recording with a note
    of what was chosen.

    **Raises:** as `completed`.
    """
    if not job.left_out:
        return job, recording
    open_pipeline = job.pipeline(recording.joints, recording.sample_rate)
    pipeline, said = completed(open_pipeline, job.left_out, recording, alone, progress)
    job = replace(job, filter=pipeline.filter, window=pipeline.window, left_out=())
    return job, _with_note(recording, said)


def _with_note(recording: Recording, said: str) -> Recording:
    return replace(recording, notes=(*recording.notes, said)) if said else recording


def identify_recording(
    job: WindowJob,
    recording: Recording,
    alone: RobotAlone = None,
    progress: Progress = lambda share: None,
    held_out: Recording | None = None,
) -> list[Estimates]:
    """As `identify`, for recordings that are in memory; `alone` may be two, before and after the human's.

    **Example:**

    ```pycon
    >>> job = jaximp.read_job("examples/ankle.toml")
    >>> (found,) = jaximp.identify_recording(job, job.load())
    >>> print(found.names, found.trusted.mean().round(1))
    ('inertia', 'damping', 'stiffness', 'offset_torque') 0.9

    ```
    """
    job, recording = complete(job, recording, alone, progress)
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
    job = complete(job, pair[1][0])[0]
    assert job.payload is not None
    return job.payload.found(_pipeline_of(job, pair[1]), *pair)


def _pipeline_of(job: WindowJob, loaded: list[Recording]) -> Pipeline:
    return job.pipeline(loaded[0].joints, loaded[0].sample_rate)


def prepare(
    job: WindowJob, recording: Recording | None = None, alone: RobotAlone = None, held_out: Recording | None = None
) -> Prepared:
    """Read the recordings of a job (or take these) and filter them: rows for least squares, windows still to come."""
    if recording is None:
        recording, alone, held_out = job.load(), job.load_robot_alone(), job.load_held_out()
    job, recording = complete(job, recording, alone)
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

    **Example:**

    ```pycon
    >>> found = jaximp.infer(jaximp.read_job("examples/ankle.toml"))  # doctest: +SKIP
    >>> print(found.whole["stiffness"].mean().round(-1), "not one value" if found.why else "")  # doctest: +SKIP

    ```
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
    job, recording = complete(job, recording, alone, progress)
    return posterior_of(job.pipeline_for(recording), job.posterior, recording, alone, progress)
