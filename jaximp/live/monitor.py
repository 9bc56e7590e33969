"""A joint that is watched: samples in, estimates with verdicts out, from the first sample on.

Until enough was seen to calibrate the verdict is "warming up". The calibration runs beside the samples, which wait for
it; after it they are caught up with.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import jax
import numpy as np

from jaximp.identification.pipeline import Pipeline
from jaximp.live.calibration import Calibration, calibrate, live_of
from jaximp.live.clock import Batch, Clock, Counts, Slots, rate_of
from jaximp.live.estimator import CHUNKS, Estimate, State, Stepper, init
from jaximp.live.front import Sample, front_of
from jaximp.live.judging import ESTIMATES, PATH, WARMING_UP, Judged, judge_now
from jaximp.trust.verdicts import Verdict
from jaximp.types import Numbers, Recording, nearest

LEVEL = 0.95
"""Probability with which an interval holds the truth."""
UNTIL_RATE = 200
"""Samples from which the sample rate is told where nobody gave it."""
MOST_WAITING = 2_000_000
"""Samples that wait for a calibration at most."""
JUDGED_EVERY = 0.05
"""Seconds for which a verdict holds, where updates come faster: words take longer than numbers."""
FORGOTTEN = 30.0
"""Seconds without a sample after which nothing is known of the parameters any more. In shorter pauses they drift on."""


@dataclass(frozen=True)
class Update:
    """What is known at an instant."""

    time: float
    """Stamp of the newest sample [s]."""
    about: float
    """The instant that the estimate is about [s]; NaN before there is one."""
    verdict: Verdict
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    value: Numbers | None = None
    """(p,) parameters; None before there are any."""
    stderr: Numbers | None = None
    low: Numbers | None = None
    """(p,) lower ends of intervals of 95 %."""
    high: Numbers | None = None
    residual: float = float("nan")
    """Root mean square of what the trailing window leaves of the torque [N m]."""
    surprise: float = float("nan")
    """As `Estimate.surprise`."""
    excitation: Numbers | None = None
    """(p,) as `Judged.excitation`."""
    advice: str = ""
    """Which motion is missing, where one is."""

    def as_json(self) -> dict[str, Any]:
        """For a line of JSON; numbers that are not finite are null."""
        keys = ("value", "stderr", "low", "high", "excitation")
        columns = {key: column for key in keys if (column := getattr(self, key)) is not None}
        parameters = {
            name: {"unit": unit, **{key: _number(column[k]) for key, column in columns.items()}}
            for k, (name, unit) in enumerate(zip(self.names, self.units, strict=True))
        }
        return {
            "time": _number(self.time),
            "about": _number(self.about),
            "verdict": self.verdict.label,
            "reason": self.verdict.reason,
            "remedy": self.verdict.remedy,
            "advice": self.advice,
            "parameters": parameters,
            "residual": _number(self.residual),
            "surprise": _number(self.surprise),
        }


def _number(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


Make = Callable[[float], Pipeline]
"""The pipeline for a sample rate [Hz]."""


class Monitor:
    """The state of one joint that is watched. `feed` it; it never waits for anybody."""

    def __init__(
        self,
        make: Make,
        *,
        sample_rate: float | None = None,
        calibration: Calibration | None = None,
        state: State | None = None,
        resumes_at: float = float("nan"),
        seconds: float = 20.0,
        robot_alone: Recording | None = None,
        estimate: str = PATH,
        every: float = 0.1,
        beside: bool = True,
    ):
        """**Arguments:** `make` the pipeline; `sample_rate` [Hz], told from the first stamps without it; a
        `calibration`, or how many `seconds` of samples make one; with it a `state` to go on from, and when
        its next sample should come (`resumes_at`); `robot_alone`, where
        the pipeline has a robot; which `estimate` is shown (`track` or `window`); `every` so many seconds an update (0:
        with every sample); whether calibrations are made `beside` the samples, or in `feed`.

        **Raises:** `ValueError` in one line for what does not fit together.
        """
        if estimate not in ESTIMATES:
            raise ValueError(f"estimate is '{estimate}': {nearest(estimate, list(ESTIMATES))}")
        if not (seconds > 0 and every >= 0):
            raise ValueError("calibrate and every are seconds: give numbers above zero")
        self.calibration = calibration
        self._make, self._given_state, self._seconds, self._robot_alone = make, state, seconds, robot_alone
        self._which, self._every, self._beside = estimate, every, beside
        self._resumes_at = resumes_at
        self._first: list[Batch] = []
        self._waiting: list[Slots] = []
        self._job: Future[tuple[Calibration, Stepper]] | None = None
        self._pool: ThreadPoolExecutor | None = None
        self._stepper: Stepper | None = None
        self._said = self._judged_at = -np.inf
        self._judged: Judged | None = None
        self._failed = ""
        self.backlog = 0
        """Samples that wait."""
        self.clock: Clock | None = None
        self.pipeline: Pipeline | None = None
        self.latest: Update | None = None
        if sample_rate is not None:
            self._begin(sample_rate)

    def _begin(self, sample_rate: float) -> None:
        pipeline = self.pipeline = self._make(sample_rate)
        front = front_of(pipeline, np.zeros(len(pipeline.robot.names)) if pipeline.robot is not None else None)
        reached = front.derivatives.samples + front.bridge + 1
        self.clock = Clock(sample_rate, reached, max(reached, round(FORGOTTEN * sample_rate)))
        self.clock.next = self._now = self._resumes_at
        self._late = front.late + front.causal.late
        if self.calibration is not None:
            self._stepper = _stepper(pipeline, self.calibration, self._given_state)

    @property
    def counts(self) -> Counts:
        """What became of all samples so far."""
        return Counts() if self.clock is None else self.clock.counts

    @property
    def state(self) -> State | None:
        """Of the estimator, to go on from another time; None before it is calibrated."""
        return None if self._stepper is None else self._stepper.state

    @property
    def delay(self) -> float:
        """By how much an estimate is behind the newest sample [s]: the filters look as far ahead."""
        return 0.0 if self.clock is None else self._late / self.clock.sample_rate

    def feed(self, batch: Batch) -> tuple[Slots, list[Update]]:
        """Take samples in.

        **Returns:** the places of the grid that they took, and updates, the latest last.

        **Raises:** `ValueError` where a calibration cannot be made: of another stretch it may.
        """
        if self.clock is None:
            self._first.append(batch)
            time = np.concatenate([one.time for one in self._first])
            if len(time) < UNTIL_RATE:
                return _no_slots(), []
            self._begin(rate_of(time))
            batch = Batch(*(np.concatenate(parts) for parts in zip(*self._first, strict=True)))
            self._first = []
        assert self.clock is not None
        slots = self.clock.place(batch)
        if self._stepper is None:
            return slots, self._warm_up(slots)
        return slots, self._advance(slots)

    @property
    def no_slots(self) -> Slots:
        """What an empty batch takes."""
        return _no_slots()

    def wait(self) -> list[Update]:
        """Until a calibration that is being made is there, and what waited for it is caught up with."""
        if self._job is None:
            return []
        self._job.exception()
        return self._warm_up(_no_slots())

    # ---- Until it is calibrated.

    def _warm_up(self, slots: Slots) -> list[Update]:
        assert self.clock is not None
        assert self.pipeline is not None
        if self.backlog + len(slots.time) > MOST_WAITING:
            self.clock.counts.overload += int(slots.sample.valid.sum())
            self.clock.counts.used -= int(slots.sample.valid.sum())
        elif len(slots.time):
            self._waiting.append(slots)
            self.backlog += len(slots.time)
        needed = round(self._seconds * self.clock.sample_rate)
        if self._job is None and self.backlog >= needed:
            self._job = self._begin_job(Sample(*(x[:needed] for x in _joined(self._waiting).sample)))
        if self._job is None or not self._job.done():
            return self._warming(needed)
        return self._calibrated()

    def _begin_job(self, stretch: Sample) -> Future[tuple[Calibration, Stepper]]:
        pipeline, alone = self.pipeline, self._robot_alone
        assert pipeline is not None

        def work() -> tuple[Calibration, Stepper]:
            found = calibrate(pipeline, stretch, alone)
            return found, _stepper(pipeline, found, None)

        if self._beside:
            self._pool = ThreadPoolExecutor(1)
            return self._pool.submit(work)
        job: Future[tuple[Calibration, Stepper]] = Future()
        try:
            job.set_result(work())
        except ValueError as error:
            job.set_exception(error)
        return job

    def _calibrated(self) -> list[Update]:
        assert self._job is not None
        job, self._job = self._job, None
        if self._pool is not None:
            self._pool.shutdown(wait=False)
        try:
            self.calibration, self._stepper = job.result()
        except ValueError as error:
            # The stretch said too little: the next one may say more.
            self._failed, self._waiting, self.backlog = str(error), [], 0
            return []
        slots, self._waiting, self.backlog = _joined(self._waiting), [], 0
        return self._advance(slots)

    def _warming(self, needed: int) -> list[Update]:
        assert self.clock is not None
        now = self._waiting[-1].time[-1] if self._waiting else np.nan
        if not now >= self._said + max(self._every, 0.2) and now >= self._said:
            return []
        self._said = now
        left = (needed - self.backlog) / self.clock.sample_rate
        reason = f"calibrates in {left:.1f} s" if left > 0 else "the calibration is being made"
        failed = f"; before: {self._failed}" if self._failed else ""
        self.latest = Update(now, np.nan, Verdict(WARMING_UP, reason + failed, "move as you will later"))
        return [self.latest]

    # ---- From then on.

    def _advance(self, slots: Slots) -> list[Update]:
        """From one long pause to the next."""
        found, first = [], 0
        before = np.concatenate([[self._now], slots.time])
        for last in (*np.flatnonzero(np.diff(before) > FORGOTTEN).tolist(), len(slots.time)):
            found += self._follow(Slots(slots.time[first:last], Sample(*(x[first:last] for x in slots.sample))))
            if last < len(slots.time) and self._stepper is not None:
                self._stepper.begin_anew()
            first = last
        self._now = float(before[-1])
        return found

    def _follow(self, slots: Slots) -> list[Update]:
        assert self._stepper is not None
        q, torque, valid = slots.sample
        found, first = [], 0
        while first < len(q):
            last = first + next(size for size in CHUNKS if size <= len(q) - first)
            estimate = self._stepper.many(q[first:last], torque[first:last], valid[first:last])
            found += self._updates(slots.time[first:last], estimate)
            first = last
        return found

    def _updates(self, time: Numbers, estimate: Estimate) -> list[Update]:
        """Those that are due among some samples."""
        found = []
        for k in range(len(time)):
            # A clock that was set back begins anew.
            if self._said <= time[k] < self._said + self._every * (1 - 1e-6):
                continue
            self._said = float(time[k])
            found.append(self._update(self._said, jax.tree.map(lambda x, k=k: x[k], estimate)))
        if found:
            self.latest = found[-1]
        return found

    def _update(self, time: float, estimate: Estimate) -> Update:
        pipeline, calibration = self.pipeline, self.calibration
        assert pipeline is not None
        assert calibration is not None
        assert self._stepper is not None
        judged = self._judged
        if judged is None or not self._judged_at <= time < self._judged_at + JUDGED_EVERY:
            window = self._stepper.live.window.length
            judged = judge_now(pipeline, calibration, window, estimate, self._which, pipeline.limits)
            self._judged, self._judged_at = judged, time
        of_path = self._which == PATH
        value, stderr, half = estimate.theta, estimate.stderr, NormalDist().inv_cdf(0.5 + LEVEL / 2)
        if not of_path:
            value, stderr = estimate.window.theta, estimate.window.stderr
            half = _student(float(estimate.window.dof))
        if not np.isfinite(value).all() or not estimate.surprises > 0:
            return Update(time, np.nan, Verdict(WARMING_UP, "the filters have not seen enough samples yet", ""))
        model = pipeline.model
        return Update(
            time=time,
            about=time - self.delay,
            verdict=judged.verdict,
            names=model.names,
            units=model.units,
            value=np.asarray(value),
            stderr=np.asarray(stderr),
            low=np.asarray(value - half * stderr),
            high=np.asarray(value + half * stderr),
            residual=float(estimate.window.residual_rms),
            surprise=float(estimate.surprise),
            excitation=judged.excitation,
            advice=judged.advice,
        )


def _student(dof: float) -> float:
    from scipy.special import stdtrit

    return float(stdtrit(dof, 0.5 + LEVEL / 2)) if dof > 0 else float("nan")


def _stepper(pipeline: Pipeline, calibration: Calibration, state: State | None) -> Stepper:
    """Compiled for single samples and for many."""
    live = live_of(pipeline, calibration)
    stepper = Stepper(live, init(live) if state is None else state)
    stepper.compile()
    return stepper


def _no_slots() -> Slots:
    return Slots(np.empty(0), Sample(np.empty(0), np.empty(0), np.empty(0, bool)))


def _joined(several: list[Slots]) -> Slots:
    if not several:
        return _no_slots()
    samples = (np.concatenate(parts) for parts in zip(*(one.sample for one in several), strict=True))
    return Slots(np.concatenate([one.time for one in several]), Sample(*samples))
