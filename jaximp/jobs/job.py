"""The job file: what to identify, from which recording or trials, with which filters and windows.

A job is TOML. `read_job` checks every key and value and names the nearest known key where one is misspelt.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NoReturn

from jaximp.design.files import read_trajectory
from jaximp.identification.filter_settings import FilterSettings, design_filters
from jaximp.identification.pipeline import DRIVES, STRETCH, Pipeline, TrackSettings, WindowSettings, gap_between
from jaximp.identification.separation import METHODS
from jaximp.jobs.arm import ArmSettings, arm_of_joints, arm_of_trials
from jaximp.jobs.chain import ChainSettings, TipSettings
from jaximp.jobs.payload import PayloadSettings, payload_settings
from jaximp.jobs.settings import check_keys, checked, optional, read, settings
from jaximp.jobs.trials import TrialsSettings, trials_settings
from jaximp.models.base import Joints, Model
from jaximp.models.joint import HumanJoint, RobotJoint
from jaximp.models.reflex import ReflexPathway
from jaximp.motion.trajectories import FourierSeries
from jaximp.posterior.inference import PosteriorSettings
from jaximp.posterior.priors import LogNormal, Normal
from jaximp.recordings.apart import files_apart
from jaximp.recordings.join import join_recordings, part_of
from jaximp.recordings.load import recording_from_mapping, recordings_from_mapping
from jaximp.trust import plausibility
from jaximp.trust.limits import TrustLimits
from jaximp.types import Recording, RobotAlone, nearest


@dataclass(frozen=True)
class RobotSettings:
    """Columns of `models.RobotJoint`."""

    gear_ratio: float = 1.0
    """Motor turns per joint turn, where position and torque stay on the motor's side."""
    gravity: bool | None = None
    """Columns of gravity (sine and cosine of the angle); by default they are there for a revolute joint."""
    viscous: bool = True
    """A column of viscous friction."""
    coulomb: bool = True
    """A column of Coulomb friction."""
    inertia: bool = True
    """A column of inertia."""
    offset: bool = False
    """A column of a constant torque."""
    g: float = 9.81
    """Acceleration of gravity [m/s^2]."""

    def make(self, sample_rate: float | None = None, joint: str = "revolute") -> RobotJoint:
        """The model; it does not depend on the sample rate."""
        return RobotJoint(**vars(self), joint=joint)


@dataclass(frozen=True)
class ReflexSettings:
    """Lags of `models.ReflexPathway`, evenly spread; `reflex = true` takes these."""

    first: float = 0.04
    """Shortest lag [s]: the delay of the reflex, at the most."""
    last: float = 0.49
    """Longest lag [s], by which the reflex should have ended."""
    count: int = 31
    """How many lags there are. Much closer than half a period of `filter.decimation_cutoff` they cannot be told apart;
    twice as far apart they miss what is between, and every estimate is biased."""
    direction: int = 1
    """1 where a velocity above zero stretches the muscle, else -1."""

    def lags(self) -> list[float]:
        """[s]."""
        if self.count < 1:
            raise ValueError(f"count is {self.count}: give at least one lag")
        step = (self.last - self.first) / max(1, self.count - 1)
        return [round(self.first + k * step, 9) for k in range(self.count)]


@dataclass(frozen=True)
class HumanSettings:
    """Columns of `models.HumanJoint`."""

    offset: bool = True
    """A column of the offset torque, which is minus the stiffness times the equilibrium angle."""
    gear_ratio: float = 1.0
    """Motor turns per joint turn, where position and torque stay on the motor's side."""
    joint_name: str | list[str] | None = None
    """Which joint it is, as `trust.joint_name`."""
    reflex: bool | ReflexSettings = False
    """The stretch reflex: `true`, or a table with some of its settings."""

    def make(self, sample_rate: float | None = None, joint: str = "revolute") -> HumanJoint:
        """The model, for recordings of a sample rate [Hz], which only a reflex needs."""
        reflex = ReflexSettings() if self.reflex is True else self.reflex
        if not reflex:
            return HumanJoint(self.offset, self.gear_ratio, joint)
        if sample_rate is None:
            raise ValueError("a reflex needs the sample rate of the recording: pass models(joints, sample_rate)")
        try:
            pathway = ReflexPathway(sample_rate, reflex.lags(), reflex.direction)
        except ValueError as error:
            raise ValueError(f"model.human.reflex: {error}") from None
        return HumanJoint(self.offset, self.gear_ratio, joint, pathway)


@dataclass(frozen=True)
class ModelSettings:
    """What is identified: a human joint, a robot joint, or the human in the robot by some of the four methods; or an
    arm of two joints."""

    human: HumanSettings | None = None
    robot: RobotSettings | None = None
    arm: ArmSettings | None = None
    """Whose joints were recorded."""
    chain: ChainSettings | None = None
    """The robot, where its table names a URDF."""
    tip: TipSettings | None = None
    """The human who holds its end, where `human` stands beside a robot from a URDF."""
    methods: tuple[int, ...] = (1,)
    """With a robot and a human: the methods of Tout et al. 2023, III-C. The first makes the report, the others stand
    beside it."""
    drive: str | None = None
    """What moves the joint: `position` where its motion is imposed, whatever torque that takes; `free` where its own
    torque moves it too (it is driven by a torque, or the rig yields). The estimates of a free joint are instrumental
    variables, by the column that `command` or, without it, `reference` maps. Without this key the motion is taken as
    imposed; a note says so."""
    robot_drift: float | dict[str, float] | None = None
    """With a robot and a human: by what share the robot's parameters may have changed between the recordings, as one
    standard deviation. A number is for those that the human has too (viscous friction, inertia), which nothing else can
    tell; a table names parameters, as in `{ viscous_friction = 0.1, inertia = 0 }`. The human's errors grow by it."""


@dataclass(frozen=True)
class WindowJob:
    """Everything that is to be known of a recording, which is identified window by window."""

    recording: Mapping[str, Any]
    """The `[recording]` table: keywords of `load_recording`, and `file`, which may be a list."""
    model: ModelSettings
    window: WindowSettings
    filter: FilterSettings = field(default_factory=FilterSettings)
    trust: TrustLimits = field(default_factory=TrustLimits)
    track: TrackSettings | None = None
    """Parameters that are followed as they move, in place of windows."""
    more_recordings: tuple[Mapping[str, Any], ...] = ()
    """The second and later of several `[[recording]]` tables, which count as one recording with the first."""
    held_out: Mapping[str, Any] | float | None = None
    """A recording that the estimates must predict without having seen it: a table as `[recording]`, whose columns are
    those of `[recording]` where it names none; or the share of the recording at its end that is kept back."""
    robot_recording: Mapping[str, Any] | None = None
    """The recording of the robot alone, for the four methods, or without a load. Its columns are those of `[recording]`
    unless it names position and torque."""
    robot_recording_after: Mapping[str, Any] | None = None
    """A second one, made after the recording with the human."""
    payload: PayloadSettings | None = None
    """What the recording with a load is to tell, beside `robot_recording` without it."""
    reference_period: float | None = None
    """Period of the reference trajectory [s]; the threshold for fake changes needs it and a reference position."""
    design: str | None = None
    """The trajectory.json of the design that the motion followed: it serves in place of both."""
    posterior: PosteriorSettings = field(default_factory=PosteriorSettings)
    left_out: tuple[str, ...] = ()
    """Which of the tables `filter` and `window` the job leaves to what suits the recording (`jobs.run.complete`)."""
    folder: Path = Path()
    """Where relative file names start."""
    text: str = ""
    """The job file as written."""

    @property
    def step_seconds(self) -> float:
        """From one window, or point of a path, to the next [s]."""
        return self.window.step_seconds if self.track is None else self.track.grid

    def load(self) -> Recording:
        """The recording to be identified.

        **Raises:** as `load_recording`.
        """
        return self.without_held_out(self._joined([self.recording, *self.more_recordings]))

    def without_held_out(self, whole: Recording) -> Recording:
        """What is identified of a recording, where its end is held out."""
        return part_of(whole, 0.0, 1 - self.held_out) if isinstance(self.held_out, float) else whole

    def load_held_out(self, whole: Recording | None = None) -> Recording | None:
        """The recording that is to be predicted, where the job has one; or the end of `whole`, by default of the job's
        own recording."""
        if self.held_out is None:
            return None
        if isinstance(self.held_out, float):
            whole = self._joined([self.recording, *self.more_recordings]) if whole is None else whole
            return part_of(whole, 1 - self.held_out, 1.0)
        return self._joined([self.held_out], "[held_out]")

    def _joined(self, tables: list[Mapping[str, Any]], where: str = "[recording]") -> Recording:
        """All recordings of some tables as one, in which the filters do not cross from one into the next."""
        several = [one for table in tables for one in recordings_from_mapping(table, self.folder, where)]
        return join_recordings(several, gap_between(design_filters(self.filter, several[0].sample_rate)))

    def load_robot_alone(self) -> RobotAlone:
        """The recording of the robot alone, where the job has one; both of them where it has two."""
        if self.robot_recording is None or self.payload is not None:
            return None
        before = recording_from_mapping(self.robot_recording, self.folder, "[robot_recording]")
        if self.robot_recording_after is None:
            return before
        return before, recording_from_mapping(self.robot_recording_after, self.folder, "[robot_recording_after]")

    def load_pair(self) -> tuple[list[Recording], list[Recording]]:
        """All recordings of a robot without a load, and all with it, each by itself."""
        assert self.robot_recording is not None
        tables = (self.recording, *self.more_recordings)
        several = [one for table in tables for one in recordings_from_mapping(table, self.folder)]
        return recordings_from_mapping(self.robot_recording, self.folder, "[robot_recording]"), several

    def load_design(self) -> FourierSeries | None:
        """The motion that was designed, where the job names one."""
        return None if self.design is None else read_trajectory(self.folder / self.design)

    def files(self) -> list[Path]:
        """What the job reads."""
        held_out = self.held_out if isinstance(self.held_out, Mapping) else None
        others = (held_out, self.robot_recording, self.robot_recording_after)
        tables = [self.recording, *self.more_recordings, *(table for table in others if table is not None)]
        named = [table["file"] for table in tables if "file" in table]
        names = [str(name) for one in named for name in (one if isinstance(one, list) else [one])]
        names += [name for table in tables for name in files_apart(table)]
        urdf = None if self.model.chain is None else self.model.chain.urdf
        return [self.folder / name for name in (*names, self.design, urdf) if name is not None]

    def models(self, joints: tuple[str, ...], sample_rate: float | None = None) -> tuple[Model | None, Model | None]:
        """Robot and human model for a recording with these joints; several joints stand side by side. An arm, which is
        one model of two joints, stands in the robot's place. A human with a reflex needs the `sample_rate` [Hz]."""
        robot, human = self.model.robot, self.model.human
        human = None if human is None else replace(human, joint_name=None)
        if self.model.chain is not None:
            chain = self.model.chain.make(self.folder)
            self.model.chain.check(chain, joints)
            return chain, None if self.model.tip is None else self.model.tip.make(chain)
        if self.model.arm is not None:
            if joints != ("revolute", "revolute"):
                raise ValueError(
                    f"model.arm has two revolute joints, but the recording {' and '.join(joints)}: map two columns of "
                    "the position and two of the torque"
                )
            return self.model.arm.make(), None
        return _side_by_side(robot, joints, sample_rate), _side_by_side(human, joints, sample_rate)

    def pipeline(self, joints: tuple[str, ...], sample_rate: float) -> Pipeline:
        """What is done with every recording of these joints and this sample rate [Hz]."""
        robot, human = self.models(joints, sample_rate)
        model = robot if human is None else human
        if model is None:
            raise ValueError("[model] is empty: write human = true, or robot = true, or both, or an arm")
        return Pipeline(
            sample_rate=sample_rate,
            model=model,
            window=self.window,
            filter=self.filter,
            limits=self._limits(len(joints)),
            robot=None if human is None else robot,
            methods=self.model.methods,
            robot_drift=self.model.robot_drift,
            reference=self.load_design() or self.reference_period,
            drive=self.model.drive,
            track=self.track,
        )

    def _limits(self, joints: int) -> TrustLimits:
        """With the names of the joints, wherever they stand."""
        human = None if self.model.human is None else self.model.human.joint_name
        name = human if self.trust.joint_name is None else self.trust.joint_name
        if isinstance(name, list) and len(name) != joints:
            raise ValueError(f"joint_name lists {len(name)} joints, but the recording has {joints}: give one for each")
        return replace(self.trust, joint_name=name)

    def pipeline_for(self, recording: Recording) -> Pipeline:
        """What is done with this recording."""
        return self.pipeline(recording.joints, recording.sample_rate).of_length(len(recording))


@dataclass(frozen=True)
class TrialsJob:
    """Everything that is to be known of perturbation trials, from which the impedance of an arm is identified."""

    trials: TrialsSettings
    arm: ArmSettings
    """Whose hand was recorded."""
    trust: TrustLimits = field(default_factory=TrustLimits)
    posterior: PosteriorSettings = field(default_factory=PosteriorSettings)
    text: str = ""
    """The job file as written."""

    def load(self) -> NoReturn:
        """**Raises:** `ValueError`: there is no recording; `trials.load` reads the trials."""
        raise ValueError("this job has [trials] and no [recording]: read them by its trials.load()")

    def tables(self) -> list[TrialsSettings]:
        """`[trials]`, and `[trials.posture]` where the job has it."""
        return [self.trials] if self.trials.posture is None else [self.trials, self.trials.posture]

    def files(self) -> list[Path]:
        """What the job reads."""
        return [path for table in self.tables() for path in table.paths()]


Job = WindowJob | TrialsJob
"""What a job file with measurements says; that of a design is a `DesignJob`.

**Example:**

```pycon
>>> job = jaximp.read_job("examples/ankle.toml")
>>> isinstance(job, jaximp.Job)
True

```
"""


@lru_cache(maxsize=64)
def _side_by_side(
    one: RobotSettings | HumanSettings | None, joints: tuple[str, ...], sample_rate: float | None
) -> Model | None:
    """The model of one joint or several, if there is one; thousands of recordings share it."""
    if one is None:
        return None
    models = [one.make(sample_rate, joint) for joint in joints]
    return models[0] if len(models) == 1 else Joints(*models)


def read_job(path: str | Path) -> Job:
    """Read and check a job file.

    **Raises:** `ValueError` with one line that names the key and the remedy.

    **Example:**

    ```pycon
    >>> job = jaximp.read_job("examples/ankle.toml")
    >>> print(job.window.length, job.filter.position_cutoff)
    2.0 90.0

    ```
    """
    return read(path, parse_job)


def parse_job(text: str, folder: Path = Path()) -> Job:
    """A job from TOML text; relative file names start at `folder`.

    **Example:**

    ```pycon
    >>> job = jaximp.parse_job('''
    ... [recording]
    ... file = "knee.csv"
    ... time = { column = "t", unit = "s" }
    ... position = { column = "q", unit = "deg" }
    ... torque = { column = "tau", unit = "N m" }
    ... [model]
    ... human = true
    ... [window]
    ... length = 1.5
    ... ''')
    >>> job.window.length
    1.5

    ```
    """
    tables = tomllib.loads(text)
    recordings = ["recording", "robot_recording", "robot_recording_after"]
    known = [*recordings, "held_out", "model", "window", "track", "filter", "trust", "reference_period", "design"]
    check_keys(tables, [*known, "payload", "posterior", "trials"], "the job")
    if "trials" in tables:
        return _job_of_trials(tables, folder, text)
    for required in ("recording", "model"):
        if required not in tables:
            raise ValueError(f"the job has no [{required}] table: add one")
    several = tables["recording"] if isinstance(tables["recording"], list) else [tables["recording"]]
    for name, table in [("recording", one) for one in several] + [
        (name, tables.get(name, {})) for name in recordings[1:]
    ]:
        if not isinstance(table, dict):
            raise ValueError(f"[{name}] must be a table")
    model = model_settings(tables["model"])
    track = settings(TrackSettings, tables["track"], "track") if "track" in tables else None
    job = WindowJob(
        recording=several[0],
        more_recordings=tuple(several[1:]),
        held_out=_held_out(tables.get("held_out"), several[0]),
        robot_recording=_of_robot(tables.get("robot_recording"), several[0]),
        robot_recording_after=_of_robot(tables.get("robot_recording_after"), several[0]),
        payload=payload_settings(tables["payload"]) if "payload" in tables else None,
        model=model,
        window=_window(tables.get("window", {}), track),
        track=track,
        filter=settings(FilterSettings, tables.get("filter", {}), "filter"),
        trust=settings(TrustLimits, tables.get("trust", {}), "trust"),
        reference_period=checked(tables.get("reference_period"), float | None, "reference_period"),
        design=checked(tables.get("design"), str | None, "design"),
        posterior=posterior_settings(tables.get("posterior", {})),
        left_out=_left_out(tables, model, track),
        folder=folder,
        text=text,
    )
    _check_values(job)
    return job


def _window(table: Any, track: TrackSettings | None) -> WindowSettings:
    """`[window]`, whose length may be `"all"`, and stands for the stretches beside `[track]`."""
    if track is not None and isinstance(table, dict):
        if "step" in table:
            raise ValueError("window.step has no meaning beside [track]: set track.grid")
        table = {"length": STRETCH, **table}
    given = table.get("length") if isinstance(table, dict) else None
    if given == math.inf:
        raise ValueError("window.length is inf: it must be a number above zero, or 'all'")
    if given == "all":
        return settings(WindowSettings, {**table, "length": math.inf}, "window")
    return settings(WindowSettings, table, "window")


def _left_out(tables: Mapping[str, Any], model: ModelSettings, track: TrackSettings | None) -> tuple[str, ...]:
    """Filters, and the length of windows; of a robot from its URDF these are the whole recording, and a path needs
    none."""
    left_out = ["filter"] if "filter" not in tables else []
    own_length = model.chain is not None or track is not None or "length" in tables.get("window", {})
    return (*left_out, *([] if own_length else ["window"]))


def _inherited(table: Mapping[str, Any], recording: Mapping[str, Any]) -> Mapping[str, Any]:
    """With the columns of `[recording]` where a table names none, but not with a second clock."""
    own = ["file", "rows", "name", *(("time", "sample_rate") if {"time", "sample_rate"} & table.keys() else ())]
    return {**{key: value for key, value in recording.items() if key not in own}, **table}


def _of_robot(table: Mapping[str, Any] | None, recording: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """A table that names position and torque stands for itself: other columns, or a gear, may not be in its file."""
    if table is None or table.keys() >= {"position", "torque"}:
        return table
    return _inherited(table, recording)


def _held_out(value: Any, recording: Mapping[str, Any]) -> Mapping[str, Any] | float | None:
    if value is None:
        return None
    if isinstance(value, dict):
        return _inherited(value, recording)
    share = checked(value, float, "held_out")
    if not 0 < share < 1:
        raise ValueError(f"held_out is {share:g}: it is the share of the recording that is kept back, such as 0.2")
    return float(share)


def _job_of_trials(tables: dict[str, Any], folder: Path, text: str) -> TrialsJob:
    """A job whose trials stand in place of a recording, its filters and its windows."""
    for other in tables:
        if other not in ("trials", "model", "trust", "posterior"):
            raise ValueError(
                f"[trials] stand in place of a recording and have a window of their own: leave out '{other}'"
            )
    model = tables.get("model", {})
    if not isinstance(model, dict) or "arm" not in model:
        raise ValueError("[trials] are those of an arm: add [model.arm] with its lengths")
    check_keys(model, ["arm"], "[model] beside [trials]")
    arm = arm_of_trials(model["arm"])
    trials = trials_settings(tables["trials"], folder, arm.geometry())
    if arm.known_inertia is not None and trials.posture is not None:
        raise ValueError("model.arm.inertia and [trials.posture] both give the arm's inertia: keep one of them")
    trust = settings(TrustLimits, tables.get("trust", {}), "trust")
    _check_limits(trust)
    posterior = posterior_settings(tables.get("posterior", {}))
    if posterior.prior:
        raise ValueError("[posterior.prior] is for jobs with a recording: an arm's impedance has none")
    return TrialsJob(trials, arm, trust, posterior, text)


def posterior_settings(table: Any) -> PosteriorSettings:
    """`[posterior]`, with every key and value checked."""
    if not isinstance(table, dict) or not isinstance(table.get("prior", {}), dict):
        raise ValueError("[posterior] and [posterior.prior] must be tables")
    check_keys(table, list(PosteriorSettings.__dataclass_fields__), "[posterior]")
    prior: dict[str, Normal | LogNormal] = {}
    for name, one in table.get("prior", {}).items():
        where = f"posterior.prior.{name}"
        log_normal = isinstance(one, dict) and "median" in one
        prior[name] = settings(LogNormal, one, where) if log_normal else settings(Normal, one, where)
    plain = settings(PosteriorSettings, {key: value for key, value in table.items() if key != "prior"}, "posterior")
    if not (400 <= plain.ess <= 1e6):
        raise ValueError(f"posterior.ess is {plain.ess:g}: ask for 400 to 1e6 effective samples")
    return replace(plain, prior=prior)


def model_settings(table: Any) -> ModelSettings:
    if not isinstance(table, dict):
        raise ValueError("[model] must be a table")
    check_keys(table, ["human", "robot", "arm", "methods", "drive", "robot_drift"], "[model]")
    chain = _chain(table)
    robot = None if chain else optional(RobotSettings, table.get("robot", False), "model.robot")
    human = None if chain else optional(HumanSettings, table.get("human", False), "model.human")
    tip = optional(TipSettings, table.get("human", False), "model.human") if chain else None
    if chain is not None and tip is None and "methods" in table:
        raise ValueError("model.methods tell a human from a robot: add [model.human], or leave them out")
    arm = None if table.get("arm", False) is False else arm_of_joints(table["arm"])
    if arm is not None:
        if robot is not None or human is not None:
            raise ValueError("model.arm stands alone: leave out model.robot and model.human")
        if "methods" in table:
            raise ValueError("model.methods tell a human from a robot on one joint: leave them out beside model.arm")
    methods = table.get("methods", [1])
    methods = methods if isinstance(methods, list) else [methods]
    if not methods or any(type(method) is not int or method not in METHODS for method in methods):
        raise ValueError(f"model.methods is {methods}: list some of 1, 2, 3 and 4")
    drive = table.get("drive")
    if drive is not None and drive not in DRIVES:
        raise ValueError(f"model.drive is {drive!r}: {nearest(str(drive), DRIVES)}")
    drift = _robot_drift(table.get("robot_drift"), human or tip, robot or chain)
    if tip is not None and isinstance(drift, float) and drift > 0:
        raise ValueError("model.robot_drift: of a robot from a URDF say which parameters may have changed, as a table")
    return ModelSettings(human, robot, arm, chain, tip, tuple(dict.fromkeys(methods)), drive, drift)


def _chain(table: Mapping[str, Any]) -> ChainSettings | None:
    """The robot, where its table names a URDF."""
    robot = table.get("robot")
    if not (isinstance(robot, dict) and "urdf" in robot):
        return None
    if table.get("arm", False) is not False:
        raise ValueError("model.robot has a urdf: leave out model.arm, or describe the arm by a URDF")
    return settings(ChainSettings, robot, "model.robot")


def _robot_drift(value: Any, human: object, robot: object) -> float | dict[str, float] | None:
    """A share, or one for each of some parameters."""
    if value is None:
        return None
    if human is None or robot is None:
        raise ValueError("model.robot_drift is of use only with both model.robot and model.human")
    for name, share in value.items() if isinstance(value, dict) else [("", value)]:
        where = f"model.robot_drift.{name}" if name else "model.robot_drift"
        if not 0 <= checked(share, float, where) < math.inf:
            raise ValueError(f"{where} is {share}: it is a share, such as 0.03, and must be zero or more")
    return {name: float(share) for name, share in value.items()} if isinstance(value, dict) else float(value)


def _check_values(job: WindowJob) -> None:
    if all(part is None for part in (job.model.human, job.model.robot, job.model.arm, job.model.chain)):
        raise ValueError("[model] is empty: write human = true, or robot = true, or both, or an arm")
    both = job.model.tip is not None or (job.model.human is not None and job.model.robot is not None)
    if both and job.robot_recording is None:
        raise ValueError("a human in a robot needs the recording of the robot alone: add a [robot_recording] table")
    if job.payload is not None and (job.model.chain is None or job.robot_recording is None):
        raise ValueError(
            "a [payload] needs a robot with a urdf in [model.robot], and its recording without the load: add a "
            "[robot_recording] table"
        )
    if job.payload is not None and job.model.tip is not None:
        raise ValueError("a [payload] is that of a robot which nobody holds: leave out [model.human]")
    if not both and job.payload is None and job.robot_recording is not None:
        raise ValueError("[robot_recording] is of use only with both model.robot and model.human, or with [payload]")
    if job.robot_recording_after is not None and job.robot_recording is None:
        raise ValueError("[robot_recording_after] is the second of two: add the first as [robot_recording]")
    if job.model.human is not None:
        for names in (job.model.human.joint_name, job.trust.joint_name):
            for name in names if isinstance(names, list) else [names]:
                plausibility.ranges_of(name)
        job.model.human.make(1000.0)  # refuses lags that make no sense
        if job.model.human.reflex and job.filter.mode == "window":
            raise ValueError("filter.mode = 'window' cuts off the past that a reflex answers to: set it to 'once'")
    if job.filter.mode not in ("once", "window"):
        raise ValueError(f"filter.mode is '{job.filter.mode}': it must be 'once' or 'window'")
    positive = {
        "window.length": job.window.length,
        "window.step": job.window.step,
        "track.grid": None if job.track is None else job.track.grid,
        "filter.decimate": job.filter.decimate,
        "filter.position_cutoff": job.filter.position_cutoff,
        "filter.decimation_cutoff": job.filter.decimation_cutoff,
        "filter.high_pass": job.filter.high_pass,
        "reference_period": job.reference_period,
    }
    for name, value in positive.items():
        if value is not None and not (value > 0 and (math.isfinite(value) or name == "window.length")):
            raise ValueError(f"{name} is {value}: it must be a number above zero")
    if not (job.window.min_velocity >= 0 and math.isfinite(job.window.min_velocity)):
        raise ValueError(f"window.min_velocity is {job.window.min_velocity}: it must be zero or more")
    _check_limits(job.trust)
    if job.design is not None and job.reference_period is not None:
        raise ValueError("design and reference_period both say how long a period is: keep one of them")
    _check_gears(job)
    for name in ("position_order", "decimation_order", "high_pass_order"):
        if not 1 <= getattr(job.filter, name) <= 12:
            raise ValueError(f"filter.{name} is {getattr(job.filter, name)}: it must lie between 1 and 12")
    offsets = [part.offset for part in (job.model.human, job.model.robot, job.model.arm, job.model.chain) if part]
    offsets += [] if job.model.tip is None else [job.model.tip.force]
    if job.filter.high_pass is not None and any(offsets):
        raise ValueError("filter.high_pass removes what offset would explain: set offset = false in the model")


def _check_limits(trust: TrustLimits) -> None:
    for name, value in vars(trust).items():
        if isinstance(value, float) and not (value >= 0 and math.isfinite(value)):
            raise ValueError(f"trust.{name} is {value}: it must be zero or more")
    for name in ("min_vaf", "min_valid_share"):
        if (getattr(trust, name) or 0) > 1:
            raise ValueError(f"trust.{name} is {getattr(trust, name)}: it is a share, between 0 and 1")


def _check_gears(job: WindowJob) -> None:
    """A gear counts once: either when the recording is read, or in the models, and there for both alike."""
    ratios = {part.gear_ratio for part in (job.model.robot, job.model.human) if part is not None}
    if len(ratios) > 1:
        raise ValueError(
            f"model.robot and model.human have different gear ratios, {sorted(ratios)}: they share one motor"
        )
    geared = ratios - {1.0} or (job.model.chain is not None and job.model.chain.gear != 1.0)
    if geared and job.recording.get("gear_ratio", 1.0) != 1.0:
        raise ValueError(
            "gear_ratio stands both in [recording], which brings the columns to the joint, and in [model], which "
            "expects them at the motor: keep one of them"
        )
