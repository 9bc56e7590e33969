"""What is done with a recording, resolved once: model, filters, windows, noise, limits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import jax.numpy as jnp
import numpy as np

from jaximp import signals
from jaximp.identification.filter_settings import Filters, FilterSettings, design_filters
from jaximp.models.arm import PlanarArm
from jaximp.models.base import Model
from jaximp.motion.trajectories import FourierSeries
from jaximp.numerics.precision import require_float64
from jaximp.trust.limits import TrustLimits
from jaximp.types import AnyArray, Numbers, Recording, nearest

NOISE = ["estimated", "filtered"]
"""Choices of `WindowSettings.noise`."""
ESTIMATES = ["generalised", "ordinary"]
"""Choices of `WindowSettings.estimates`."""
IMPOSED, FREELY = DRIVES = ["position", "free"]
"""Choices of `Pipeline.drive`."""
STRETCH = 2.0
"""Length of the stretches in which motion and noise are judged around each point of a path, where none is given [s]."""
ReferenceMotion = tuple[AnyArray, AnyArray, AnyArray] | str
"""Position, velocity, acceleration (P, n) of one period of the reference motion, or why there is none."""


@dataclass(frozen=True)
class WindowSettings:
    """Windows and the samples that count in them."""

    length: float = math.inf
    """Length of the sliding window [s]. `"all"` takes the whole recording as one window, which is the default for
    robots from a URDF; others need a length."""
    step: float | None = None
    """From one window to the next [s]; by default a fiftieth of the length."""
    noise: str = "estimated"
    """Of the torque: `estimated` from what windows leave of it, whatever its colour; `filtered` takes it as white
    before the filters, for ordinary least squares as in the paper."""
    estimates: str | None = None
    """How noise that is estimated is used. `generalised` least squares count every frequency as much as its noise
    allows; `ordinary` ones count the torque as it was filtered, with standard errors that know the noise. By default
    generalised, and ordinary for robots from a URDF, whose models leave more than noise: their joints are weighed by
    what is left of each."""
    min_velocity: float = 0.0
    """Samples that move slower are left out [rad/s or m/s]: near standstill dry friction is not what the model says.
    Of several joints only the rows of those that are slow."""

    @property
    def step_seconds(self) -> float:
        """From one window to the next [s]."""
        return self.length / 50 if self.step is None else self.step


@dataclass(frozen=True)
class TrackSettings:
    """Parameters that are followed as they move (`jaximp.track`), in place of windows.

    How fast each of them moves comes from the recording: not at all, smoothly, or in jumps.
    """

    grid: float = 0.05
    """From one point of the path to the next [s]."""
    stays: tuple[str, ...] = ()
    """Parameters that are known not to move, such as the inertia of a limb."""
    jumps: bool = True
    """Whether parameters may also change at once."""


@dataclass(frozen=True)
class Pipeline:
    """From a recording to verdicts: all that is decided before its first sample is looked at.

    A job and the sample rate of its recording make one; so does anybody who has no job file.
    """

    sample_rate: float
    """Of the recordings [Hz]."""
    model: Model
    """What is identified in the windows."""
    window: WindowSettings = field(default_factory=WindowSettings)
    filter: FilterSettings = field(default_factory=FilterSettings)
    limits: TrustLimits = field(default_factory=TrustLimits)
    robot: Model | None = None
    """The robot that holds the human whom `model` describes; None where there is no such pair."""
    methods: tuple[int, ...] = (1,)
    """Which of the four methods tell the human from the robot."""
    robot_drift: float | Mapping[str, float] | None = None
    """Standard deviation of what the robot's parameters may have changed by between recordings, as a share of each: a
    number for those that the human shares, or some by name. None: nobody knows."""
    reference: FourierSeries | float | None = None
    """The motion that was designed, or the period of the recorded reference [s]: for the threshold of fake changes."""
    drive: str | None = None
    """`position` where the motion is imposed; `free` where the joint's own torque moves it too; None takes the first,
    and says so."""
    track: TrackSettings | None = None
    """Whether parameters are followed as they move. Windows are then the stretches around each point in which the noise
    is estimated and the motion judged."""

    @property
    def filters(self) -> Filters:
        """Designed for the sample rate."""
        return design_filters(self.filter, self.sample_rate)

    @property
    def gap(self) -> int:
        """Samples between recordings that count as one."""
        return gap_between(self.filters)

    @property
    def once(self) -> bool:
        """Whether the filters run over the recording once, and not inside every window."""
        return self.filter.mode == "once"

    @property
    def whitens(self) -> bool:
        """Whether the noise is estimated, and windows are solved in rows where it is white."""
        return self.once and self.window.noise == "estimated"

    @property
    def ordinary(self) -> bool:
        """Whether the noise is estimated, but only the standard errors of ordinary least squares use it."""
        usual = ESTIMATES[1] if self.model.regroups else ESTIMATES[0]
        return self.whitens and (self.window.estimates or usual) == "ordinary"

    @property
    def weighs(self) -> bool:
        """Whether ordinary least squares of several joints weigh each by what is left of it."""
        return self.ordinary and self.model.regroups and self.model.n_joints > 1

    @property
    def min_velocity(self) -> Numbers:
        """() or (n,): slower rows of a joint do not count [rad/s or m/s]."""
        slowest = 0.0 if self.robot is None else self.robot.min_velocity
        return np.asarray(np.maximum(np.maximum(self.window.min_velocity, self.model.min_velocity), slowest))

    @property
    def whole(self) -> bool:
        """Whether a recording is one window."""
        return math.isinf(self.window.length)

    def of_length(self, samples: int) -> Pipeline:
        """With the window of a recording of so many samples, where it is the whole recording.

        **Raises:** `ValueError` where parameters are to be followed in it.
        """
        if self.whole and self.track is not None:
            raise ValueError("window.length = 'all' leaves no stretches that [track] could judge: give seconds")
        return self.with_window(samples / self.sample_rate, samples / self.sample_rate) if self.whole else self

    @property
    def window_samples(self) -> int:
        """Samples of a window before decimation."""
        return round(self.window.length * self.sample_rate)

    @property
    def step_samples(self) -> int:
        """Samples from one window to the next before decimation."""
        return round(self.step_seconds * self.sample_rate)

    @property
    def window_rows(self) -> int:
        """Rows of a window after decimation."""
        return round(self.window.length * self.sample_rate / self.filters.decimate)

    @property
    def step_rows(self) -> int:
        """Rows from one window to the next after decimation."""
        return max(1, round(self.step_seconds * self.sample_rate / self.filters.decimate))

    @property
    def step_seconds(self) -> float:
        """From one window to the next, which is that from one point of a path to the next where there is one [s]."""
        return self.window.step_seconds if self.track is None else self.track.grid

    def with_window(self, length: float, step: float | None = None) -> Pipeline:
        """With windows of another length, and by default the same step [s]."""
        step = self.window.step_seconds if step is None else step
        return replace(self, window=replace(self.window, length=length, step=step))

    def check(self, recording: Recording) -> None:
        """**Raises:** `ValueError` for a recording that is too short, of another sample rate, or in degrees, and for
        filters that its sample rate does not allow."""
        require_float64(recording.position)
        if self.model.regroups and self.model.n_joints != recording.n_joints:
            raise ValueError(
                f"the robot has {self.model.n_joints} joints, but the recording {recording.n_joints}: map a column of "
                "position and torque for each, or lock the others"
            )
        duration = len(recording) / recording.sample_rate
        if round(self.window.length * recording.sample_rate) > len(recording):
            raise ValueError(
                f"the window of {self.window.length:g} s is longer than the recording of {duration:.4g} s: "
                "shorten window.length"
            )
        self.check_memory(recording)
        if abs(self.sample_rate - recording.sample_rate) > 1e-3 * recording.sample_rate:
            raise ValueError(
                f"the pipeline is for {self.sample_rate:g} Hz, but the recording has {recording.sample_rate:g} Hz: "
                "make one for its sample rate"
            )
        if self.window.noise not in NOISE:
            raise ValueError(f"window.noise is '{self.window.noise}': {nearest(self.window.noise, NOISE)}")
        if self.window.estimates not in (None, *ESTIMATES):
            assert self.window.estimates is not None
            hint = nearest(self.window.estimates, ESTIMATES)
            raise ValueError(f"window.estimates is '{self.window.estimates}': {hint}")
        if self.drive is not None and self.drive not in DRIVES:
            raise ValueError(f"model.drive is '{self.drive}': {nearest(self.drive, DRIVES)}")
        design_filters(self.filter, self.sample_rate)
        if self.track is not None:
            self._check_track(self.track)
        if isinstance(self.model, PlanarArm) and self.model.equilibrium is not None:
            _check_elbow(recording)

    def _check_track(self, track: TrackSettings) -> None:
        """**Raises:** `ValueError` for what parameters cannot be followed through."""
        if not self.whitens:
            raise ValueError(
                "[track] follows parameters through white rows: leave out window.noise and filter.mode, or [track]"
            )
        if self.ordinary or self.model.memory:
            what = "a reflex" if self.model.memory else "this kind of estimates, or a robot from a URDF,"
            raise ValueError(f"{what} is identified in windows: leave out [track]")
        if self.drive == FREELY:
            raise ValueError("a free joint (model.drive) is identified in windows: leave out [track]")
        for name in track.stays:
            if name not in self.model.names:
                hint = nearest(name, list(self.model.names))
                raise ValueError(f"track.stays has an unknown parameter '{name}': {hint}")

    def check_memory(self, recording: Recording) -> None:
        """A model with memory must see the past, and know how many samples it is."""
        if self.model.sample_rate is None:
            return
        if not self.once:
            raise ValueError(
                "filter.mode = 'window' cuts off the past that a reflex answers to: set filter.mode = 'once', or leave "
                "the reflex out"
            )
        if abs(self.model.sample_rate - recording.sample_rate) > 1e-3 * recording.sample_rate:
            raise ValueError(
                f"the reflex was made for {self.model.sample_rate:g} Hz, but the recording has "
                f"{recording.sample_rate:g} Hz: give the model the recording's sample rate"
            )

    def reference_motion(self, recording: Recording) -> ReferenceMotion:
        """One period of the motion that the joint was to make, or why none is known."""
        rate = self.sample_rate
        if isinstance(self.reference, FourierSeries):
            series = self.reference
            q, dq, ddq = (x.reshape(len(x), -1) for x in series(jnp.arange(round(float(series.period) * rate)) / rate))
            if q.shape[1] != recording.n_joints:
                raise ValueError(f"the design moves {q.shape[1]} joints, but the recording has {recording.n_joints}")
            return q, dq, ddq
        if recording.reference is None or self.reference is None:
            missing = "reference position" if recording.reference is None else "reference_period"
            return (
                f"no {missing} was given, so the threshold for fake changes (Tout et al. 2023, eq. 16; for periodic "
                "reference motions) is not applied"
            )
        reference = recording.reference[: round(self.reference * rate)]
        if len(reference) < round(self.reference * rate) or not np.isfinite(reference).all():
            return "the reference position does not cover one period, so the threshold (eq. 16) is not applied"
        return reference, *signals.differentiate(reference, rate, self.filters.differentiator)


def gap_between(filters: Filters) -> int:
    """Samples between recordings that count as one: what one of them does to the filters has died out by then."""
    return 2 * filters.reach


def _check_elbow(recording: Recording) -> None:
    """A human's elbow does not turn further than half a turn; degrees that pass for radians do."""
    farthest = float(np.nanmax(np.abs(recording.position[:, 1])))
    if farthest > np.pi:
        raise ValueError(
            f"the elbow turns to {farthest:.3g} rad, more than half a turn: are these degrees? Give unit = 'deg'"
        )
