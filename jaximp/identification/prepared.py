"""A recording behind its filters, with rows whose noise is white: what windows of any length share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from jaximp.identification.additions import gains_of
from jaximp.identification.corrections import noise_in_band
from jaximp.identification.delays import find_delay
from jaximp.identification.instruments import Drive, find_drives
from jaximp.identification.literal import noise_in_windows, regress_in_windows
from jaximp.identification.misfit import RobotTests
from jaximp.identification.pipeline import NOISE, Pipeline, ReferenceMotion
from jaximp.identification.robot_changes import (
    NOT_ASKED,
    between,
    compared,
    drift_covariance,
    drift_in_words,
    mean_of_both,
)
from jaximp.identification.rows import Filtered, Measured, Rows, column_noise, measure, once, regress, rows_of
from jaximp.identification.separation import Regression, Whiten, fit_robot
from jaximp.identification.solving import MOST_ROWS, Solved
from jaximp.identification.stribeck import Curves, find_curves
from jaximp.identification.tip_pairs import TipPair, robot_of, window_fit_of
from jaximp.identification.weighted import by_size, sizes_of_joints
from jaximp.identification.whitening import White, whiten
from jaximp.least_squares.window import WindowFit
from jaximp.models.base import Joints, Model, combine
from jaximp.models.chain import Chain
from jaximp.recordings.delays import moved_forward
from jaximp.recordings.join import join_recordings
from jaximp.types import Recording, RobotAlone

CLEARLY_MORE = 1.5
"""Times the variance of the noise that its samples show."""


@dataclass(frozen=True)
class Pair:
    """What methods 1 to 4 need beside the rows of the robot with the human."""

    robot: Model
    robot_fit: WindowFit
    """Of the robot alone; the mean of both, where there are two recordings of it."""
    change: NDArray[np.float64]
    """(r, r) covariance of what the robot's parameters may differ by in the recording with the human, beyond the errors
    of that fit."""
    alone: Regression
    """With the torque of the robot that has the parameters of the fit."""
    loaded: Regression
    tests: RobotTests | None
    """Of the robot's model, where the pipeline whitens."""
    notes: tuple[str, ...] = ()
    """How far the robot may have changed, in words."""
    agree: float = 1.0
    """Probability of a difference as large as that of two recordings of the robot alone, if it did not change."""
    tip: TipPair | None = None
    """Where the human holds the end of a robot of several joints: rows and robot as these methods take them."""


@dataclass(frozen=True)
class Prepared:
    """A filtered recording: what windows of any length share (but for filters inside every window)."""

    recording: Recording
    pipeline: Pipeline
    rows: Rows
    column_noise: NDArray[np.float64]
    """(p,) root mean square of what noise of the position leaves in each column."""
    pair: Pair | None
    reference: ReferenceMotion
    jumps: NDArray[np.bool_]
    """(N,) where the position jumps."""
    white: tuple[White, ...] = ()
    """Rows whose noise is white, of each joint (of joints side by side), where the pipeline whitens."""
    solved: tuple[Solved, ...] = ()
    """One for each joint (of joints side by side), where the windows of the pipeline are solved already."""
    drives: tuple[Drive, ...] = ()
    """What is known of what moves each joint (of joints side by side), where something is."""
    explained: Recording | None = None
    """With the part of the motion that a reference explains, where the rows are those of this part."""
    curves: Curves | None = None
    """Stribeck's curves, where they were to be found."""
    weighted: Rows | None = None
    """In units of what is left of each joint, where joints are weighed (`Pipeline.weighs`)."""
    held_out: Rows | None = None
    """Of a recording that the estimates are to predict."""

    @property
    def drive(self) -> Drive | None:
        """Of one joint."""
        return self.drives[0] if len(self.drives) == 1 else None

    @property
    def model(self) -> Model:
        """What is identified in the windows."""
        return self.pipeline.model

    @property
    def noise(self) -> Array | NDArray[np.float64] | None:
        """What the filters make of white torque noise: by lag in rows, or for every pair of rows of a window."""
        return noise_of(self.pipeline)

    @property
    def stackable(self) -> bool:
        """Whether all its windows are solved in one call, by sums that they share."""
        return can_be_stacked(self.pipeline) and self.weighted is None and len(self.rows.time) <= MOST_ROWS


def can_be_stacked(pipeline: Pipeline) -> bool:
    """Whether recordings go through together: a pair needs two at a time, a reflex a second fit for its gain."""
    return pipeline.once and pipeline.robot is None and not pipeline.model.memory


def has_instruments(pipeline: Pipeline) -> bool:
    """Whether it can be asked what moves a joint: of joints that share nothing, in rows whose noise is white."""
    alone = pipeline.model.n_joints == 1 or isinstance(pipeline.model, Joints)
    return pipeline.whitens and pipeline.robot is None and alone


def noise_of(pipeline: Pipeline) -> Array | NDArray[np.float64] | None:
    """What the filters make of white torque noise: by lag in rows, or for every pair of rows of a window."""
    if pipeline.once or pipeline.filters.parallel is None:
        return pipeline.filters.noise
    return noise_in_windows(pipeline)


def prepare(
    pipeline: Pipeline,
    recording: Recording | Sequence[Recording],
    alone: RobotAlone = None,
    held_out: Recording | None = None,
) -> Prepared:
    """Filter a recording, and that of the robot alone (or both of them) where there is a pair.

    Several recordings are one, in which no filter crosses from one into the next. `held_out` is one that the estimates
    are to predict.

    **Raises:** `ValueError` with one line that names the cause and the remedy.
    """
    if held_out is not None:
        check_held_out(pipeline, recording, held_out)
        prepared = prepare(pipeline, recording, alone)
        rows = regress(measure(prepared.pipeline, without_unknown_delay(pipeline, held_out)))[0]
        return replace(prepared, held_out=rows)
    if not isinstance(recording, Recording):
        recording = join_recordings(recording, pipeline.gap)
    pipeline = pipeline.of_length(len(recording))
    recording = without_unknown_delay(pipeline, recording)
    if pipeline.robot is not None:
        given = () if alone is None else alone if isinstance(alone, tuple) else (alone,)
        several = tuple(without_unknown_delay(pipeline, one) for one in given)
        return _prepare_pair(pipeline, pipeline.robot, recording, several)
    pipeline.check(recording)
    measured = measure(pipeline, recording)
    if isinstance(pipeline.model, Chain) and pipeline.model.stribeck_unknown:
        return _with_curves(measured, pipeline.model)
    if pipeline.once:
        return _prepared(measured, *regress(measured))
    return _prepared(measured, regress_in_windows(pipeline, recording, pipeline.model), column_noise(measured))


def _with_curves(measured: Measured, model: Chain) -> Prepared:
    """With Stribeck's curves that explain the recording best."""
    if not measured.pipeline.ordinary:
        raise ValueError(
            "Stribeck's curves are looked for by ordinary least squares: leave out estimates and noise in [window], "
            "and filter.mode"
        )
    curves = find_curves(measured.pipeline, measured.recording, regress(measured)[0])
    found = model.with_stribeck(curves.velocity, curves.exponent)
    note = curves.in_words(model.joint_names)
    recording = replace(measured.recording, notes=(*measured.recording.notes, note))
    other = replace(measured, recording=recording, pipeline=replace(measured.pipeline, model=found), model=found)
    return replace(_prepared(other, *regress(other)), curves=curves)


def check_held_out(pipeline: Pipeline, recording: Recording | Sequence[Recording], held_out: Recording) -> None:
    """Refuse a recording that the estimates of another one cannot predict."""
    if pipeline.robot is not None or not pipeline.once:
        raise ValueError(
            "a recording can be held out of one model alone, with filter.mode = 'once': leave held_out out"
        )
    first = recording if isinstance(recording, Recording) else recording[0]
    if held_out.joints != first.joints:
        raise ValueError(f"{held_out.name}, which is held out, has other joints than {first.name}: map the same ones")
    if abs(held_out.sample_rate - pipeline.sample_rate) > 1e-3 * pipeline.sample_rate:
        raise ValueError(
            f"{held_out.name}, which is held out, was sampled at {held_out.sample_rate:g} Hz and {first.name} at "
            f"{pipeline.sample_rate:g} Hz: resample one of them"
        )


def without_unknown_delay(pipeline: Pipeline, recording: Recording) -> Recording:
    """With a torque whose delay is to be estimated moved by what is found, and a note; others as they are.

    **Raises:** `ValueError` for several joints.
    """
    if not recording.delay_unknown:
        return recording
    if recording.n_joints > 1:
        raise ValueError('torque: delay = "estimate" works on one joint: give the delay in seconds')
    model = pipeline.model if pipeline.robot is None else combine(pipeline.robot, pipeline.model)
    window = replace(pipeline.window, noise=NOISE[0])
    own = replace(once(pipeline), model=model, robot=None, track=None, window=window)
    as_recorded = replace(recording, delay_unknown=False)
    prepared = prepare(own, as_recorded)
    found = find_delay(own, prepared.rows)
    if not found.certain:
        note = f"the delay of the torque cannot be told from zero ({found.in_words()}): nothing was moved"
        return replace(as_recorded, notes=(*recording.notes, note))
    note = f"the torque {found.in_words()}, as the model finds, and was moved by so much; what yields looks alike"
    moved = moved_forward(as_recorded, found.seconds)
    return replace(moved, notes=(*recording.notes, note))


def share_of_stack(measured: Measured, found: Filtered, k: int) -> Prepared:
    """A recording that was filtered with others, as `prepare` has it.

    **Raises:** `ValueError` where no sample is left.
    """
    return _prepared(measured, *rows_of(measured, found, k))


def with_windows(prepared: Prepared, pipeline: Pipeline) -> Prepared:
    """The same rows for windows of another length, whose noise is estimated from what they leave."""
    white = tuple(whitened(pipeline, prepared.rows)) if prepared.white else ()
    other = replace(prepared, pipeline=pipeline, white=white, solved=())
    return _weighted(other) if pipeline.weighs and other.pair is None else other


def regress_pair(pipeline: Pipeline, robot: Model, recording: Recording) -> tuple[Regression, Rows, Measured]:
    """Rows of the robot's and of the human's model for one recording, apart and stacked."""
    both = robot + pipeline.model
    measured = measure(pipeline, recording, both)
    rows = regress(measured)[0] if pipeline.once else regress_in_windows(pipeline, recording, both)
    n = len(robot.names)
    W, torque = jnp.asarray(rows.W), jnp.asarray(rows.torque)
    return Regression(W[..., :n], W[..., n:], torque, jnp.asarray(rows.valid)), rows, measured


def _prepare_pair(pipeline: Pipeline, robot: Model, recording: Recording, several: tuple[Recording, ...]) -> Prepared:
    """**Arguments:** `several` recordings of the robot alone: one, or one before and one after the human's."""
    pipeline.check(recording)
    _check_pair(recording, several, isinstance(robot, Chain))
    if isinstance(robot, Chain):
        return _prepare_tip(pipeline, robot, recording, several)
    # The robot's own parameters come from its whole recordings, which need no windows.
    whole = [regress_pair(once(pipeline), robot, one)[0] for one in several]
    fits = [_fit_robot(pipeline, one) for one in whole]
    of_rows = whitener(pipeline)
    tests = None if of_rows is None else RobotTests.of(pipeline, several[0], whole[0], of_rows)
    # Methods 1 and 2 need no windows of the robot alone.
    shared = pipeline.once or not {3, 4}.intersection(pipeline.methods)
    in_windows = whole[0] if shared else regress_pair(pipeline, robot, several[0])[0]
    loaded, rows, measured = regress_pair(pipeline, robot, recording)
    noise = column_noise(measured) if rows.noisy is None else np.sqrt((rows.noisy**2).mean(axis=0))
    pair = _pair(pipeline, robot, fits, in_windows, loaded, tests)
    return _prepared(measured, rows, noise[len(robot.names) :], pair)


def _prepare_tip(pipeline: Pipeline, robot: Chain, recording: Recording, several: tuple[Recording, ...]) -> Prepared:
    """Of a human at the end of a robot, whose joints are weighed by what is left of each."""
    if robot.stribeck_unknown:
        raise ValueError("Stribeck's curves are not looked for beside a human: identify the robot alone, and give them")
    if not pipeline.ordinary:
        raise ValueError(
            "a human at the end of a robot is identified by ordinary least squares: leave out estimates and noise in "
            "[window], and filter.mode"
        )
    gains = gains_of([*several, recording])
    whole = [regress_pair(pipeline, robot, one)[0] for one in several]
    loaded, rows, measured = regress_pair(pipeline, robot, recording)
    of_each = [window_fit_of(robot_of(one)) for one in whole]
    alone = jax.tree.map(lambda *parts: jnp.concatenate(parts), *whole)
    pair = _pair(pipeline, robot, of_each, whole[0], loaded, None)
    found = robot_of(alone)
    tip = TipPair(alone, loaded, found, pair.change, gains, len(whole[0].torque))
    assert rows.noisy is not None
    noise = np.sqrt((rows.noisy.reshape(-1, rows.noisy.shape[-1]) ** 2).mean(axis=0))
    pair = replace(pair, robot_fit=window_fit_of(found), tip=tip)
    return _prepared(measured, rows, noise[len(robot.names) :], pair)


def _fit_robot(pipeline: Pipeline, alone: Regression) -> WindowFit:
    of_rows = whitener(pipeline)
    known = None if pipeline.whitens else noise_of(once(pipeline))
    white = None if of_rows is None else of_rows(alone.robot, alone.torque, alone.valid)
    return fit_robot(alone, None if known is None else jnp.asarray(known), white)


def _pair(
    pipeline: Pipeline,
    robot: Model,
    fits: Sequence[WindowFit],
    alone: Regression,
    loaded: Regression,
    tests: RobotTests | None,
) -> Pair:
    """With what is known of changes of the robot. **Arguments:** `fits` of each of its recordings."""
    before, fit, p, of_both = fits[0], fits[0], 1.0, ""
    change = np.zeros((len(robot.names), len(robot.names)))
    if len(fits) > 1:
        fit = mean_of_both(*fits)
        change = between(*fits)
        p, of_both = compared(robot.names, *fits)
        alone = replace(alone, torque=alone.torque + alone.robot @ (fit.theta - before.theta))
    drift = drift_covariance(robot, pipeline.model, fit.theta, pipeline.robot_drift)
    of_drift = drift_in_words(robot, drift, fit.theta)
    unknown = pipeline.robot_drift is None and not of_both
    notes = tuple(filter(None, [of_both, of_drift, NOT_ASKED if unknown else ""]))
    return Pair(robot, fit, change + drift, alone, loaded, tests, notes, p)


def _check_pair(recording: Recording, several: tuple[Recording, ...], at_tip: bool) -> None:
    if not several:
        raise ValueError("a human in a robot needs the recording of the robot alone: add a [robot_recording] table")
    for alone in several:
        if not at_tip and (recording.n_joints != 1 or alone.n_joints != 1):
            raise ValueError("methods 1 to 4 work on one joint at a time: map one position and one torque column")
        if alone.joints != recording.joints:
            raise ValueError(
                f"the robot alone was recorded with {alone.n_joints} joints and with the human with "
                f"{recording.n_joints}, or joints of another kind: map the same ones"
            )
        if abs(alone.sample_rate - recording.sample_rate) > 1e-3 * recording.sample_rate:
            raise ValueError(
                f"the robot alone was sampled at {alone.sample_rate:g} Hz and the robot with the human at "
                f"{recording.sample_rate:g} Hz: resample one of them"
            )


def _prepared(measured: Measured, rows: Rows, noise: NDArray[np.float64], pair: Pair | None = None) -> Prepared:
    recording, pipeline = measured.recording, measured.pipeline
    reference = pipeline.reference_motion(recording)
    drives: tuple[Drive, ...] = ()
    explained = None
    if has_instruments(pipeline) and pair is None:
        rows, drives, explained = find_drives(pipeline, recording, rows, columns_by_joint(pipeline.model))
    white = tuple(whitened(pipeline, rows)) if pipeline.whitens and pair is None else ()
    times = _noise_in_band(rows, white)
    if times > CLEARLY_MORE:
        more, one = np.sqrt(times), white[0]
        rows, noise = replace(rows, noisy=more * np.asarray(rows.noisy)), more * noise
        white = (replace(one, noisy=more * np.asarray(one.noisy)),)
    if white and not pipeline.ordinary:
        noise = np.concatenate([one.column_noise for one in white])
    prepared = Prepared(
        recording, pipeline, rows, noise, pair, reference, measured.jumps, white, drives=drives, explained=explained
    )
    return _weighted(prepared) if pipeline.weighs and pair is None else prepared


def _weighted(prepared: Prepared) -> Prepared:
    """With rows in which each joint counts by what is left of it."""
    rows, white = prepared.rows, prepared.white[0]
    size = sizes_of_joints(rows)
    weighted = by_size(rows, size)
    columns = np.where(np.asarray(rows.valid)[..., None], weighted.W, 0)
    assert weighted.noisy is not None
    noise = np.sqrt((weighted.noisy.reshape(-1, columns.shape[-1]) ** 2).mean(axis=0))
    white = replace(white, as_filtered=columns, counted=size)
    return replace(prepared, weighted=weighted, white=(white,), column_noise=noise)


def _noise_in_band(rows: Rows, white: tuple[White, ...]) -> float:
    """How many times the variance of the noise that its samples show the position has inside the band of one joint."""
    if len(white) != 1 or white[0].noisy is None or rows.torque.ndim > 1:
        return 1.0
    theta = np.linalg.lstsq(white[0].W[rows.valid], white[0].torque[rows.valid])[0]
    return noise_in_band(rows.W, rows.torque, rows.noisy, rows.valid, theta)


def whitened(pipeline: Pipeline, rows: Rows) -> Iterator[White]:
    """White rows of each joint of joints side by side, which share neither parameters nor noise."""
    for columns in columns_by_joint(pipeline.model):
        yield whiten(pipeline, rows if columns is None else rows.of_joint(*columns))


def whitener(pipeline: Pipeline) -> Whiten | None:
    """What makes white rows of any columns, where the noise's shape is to be estimated."""
    if not pipeline.whitens:
        return None
    return lambda W, y, valid, beside=None: whiten(pipeline, Rows(W, y, np.asarray(valid), np.empty(0)), beside)


def columns_by_joint(model: Model) -> list[tuple[int, slice] | None]:
    """Which parameters are those of each joint of joints side by side; None stands for all of another model."""
    if not isinstance(model, Joints):
        return [None]
    ends = np.cumsum([len(part.names) for part in model.models]).tolist()
    return [(j, slice(first, end)) for j, (first, end) in enumerate(zip([0, *ends], ends, strict=False))]
