"""The job itself: recording + model + filters + windows -> estimates with a verdict each.

`identify` and everything that runs it for many recordings share this module; it reads and writes no files.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from jaximp import signals
from jaximp.identification.regression import (
    Filters,
    Placement,
    Rows,
    check_window,
    column_noise,
    design_filters,
    jumped,
    noise_of_rows,
    regress,
    step_seconds,
    windows_in_rows,
)
from jaximp.identification.separation import METHODS, Regression, Separation, fit_robot, separate
from jaximp.jobs.job import Job
from jaximp.least_squares.sliding import Score, score, sliding_least_squares
from jaximp.least_squares.window import SlidingFit, WindowFit
from jaximp.models import Joints, Model, combine, pathway_of, with_gain
from jaximp.numerics.precision import require_float64
from jaximp.trust.verdicts import Verdicts, fake_change_threshold, judge, worst
from jaximp.types import AnyArray, Progress, Recording, nearest

CLEAR = 2.0
"""A reflex whose gain is so many standard errors from zero has a delay."""
STILL = 1e-3
"""A window whose torque varies by a smaller share of the recording's variance can neither confirm nor refute."""

ReferenceMotion = tuple[AnyArray, AnyArray, AnyArray] | str
"""Position, velocity, acceleration (P, n) of one period of the reference motion, or why there is none."""


@dataclass(frozen=True)
class Reflex:
    """The reflex of one joint in all windows."""

    name: str
    """`reflex`; with several joints `joint1.reflex`."""
    unit: str
    """Of the gain and of the weights."""
    lags: NDArray[np.float64]
    """(k,) [s]."""
    columns: NDArray[np.int64]
    """(k,) where their weights stand among the parameters."""
    gain: NDArray[np.float64]
    """(M,) sum of the weights; above zero where the reflex resists the stretch."""
    gain_stderr: NDArray[np.float64]
    """(M,)."""
    delay: NDArray[np.float64]
    """(M,) mean lag by weight [s]; NaN where the gain is within two standard errors of zero."""


@dataclass(frozen=True)
class Estimates:
    """One model in all windows of one recording."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    window: float
    """Length of the windows [s]."""
    start: NDArray[np.float64]
    """(M,) time of each window's first sample [s]."""
    end: NDArray[np.float64]
    """(M,) time of each window's last sample [s]."""
    fit: SlidingFit
    """Parameters, standard errors and condition of every window."""
    held_out_vaf: NDArray[np.float64]
    """(M,) how well each window's parameters predict the torque of the window after it."""
    verdicts: Verdicts
    threshold: float | None
    """Threshold on the condition number, eq. (16), where a reference trajectory was given."""
    time: NDArray[np.float64]
    """(N,) time of the torque samples below [s]."""
    torque: NDArray[np.float64]
    """(N, n) torque that the model had to explain, filtered [N m]; NaN where it did not count."""
    reconstructed: NDArray[np.float64]
    """(N, n) the model's torque with the parameters of the window around each sample."""
    predicted: NDArray[np.float64]
    """(N, n) the model's torque with parameters that have not seen the sample: those of the last window that ended
    before the block of one window's length in which the sample lies."""
    method: int | None = None
    """Which of the four methods told the human from the robot."""
    robot: WindowFit | None = None
    """The robot's parameters, where a method needed them."""
    robot_names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    """What a reader must know of these numbers, in plain words."""
    reflexes: tuple[Reflex, ...] = ()
    """Of every joint that has one."""

    @property
    def intrinsic(self) -> NDArray[np.int64]:
        """Which parameters are no weights of a reflex."""
        weights = [reflex.columns for reflex in self.reflexes]
        return np.setdiff1d(np.arange(len(self.names)), np.concatenate([[], *weights]))

    def summarised(self) -> Estimates:
        """With the gain of every reflex in place of its weights: what a person wants to see of all parameters."""
        if not self.reflexes:
            return self
        kept, gone = self.intrinsic, np.full((len(self.end), len(self.reflexes)), np.nan)
        found = (
            (self.fit.theta, np.stack([reflex.gain for reflex in self.reflexes], axis=1)),
            (self.fit.stderr, np.stack([reflex.gain_stderr for reflex in self.reflexes], axis=1)),
            (self.fit.excitation, gone),
        )
        columns = tuple(np.concatenate([np.asarray(x)[:, kept], gain], axis=1) for x, gain in found)
        return replace(
            self,
            names=(*(self.names[k] for k in kept), *(f"{reflex.name}_gain" for reflex in self.reflexes)),
            units=(*(self.units[k] for k in kept), *(reflex.unit for reflex in self.reflexes)),
            fit=eqx.tree_at(lambda f: (f.theta, f.stderr, f.excitation), self.fit, columns),
            reflexes=(),
        )

    def mean_over_trusted(self) -> NDArray[np.float64]:
        """(p,) mean of each parameter over the trusted windows; NaN if there are none."""
        theta = np.asarray(self.fit.theta)[self.verdicts.trusted]
        return theta.mean(axis=0) if len(theta) else np.full(len(self.names), np.nan)

    def sd_over_trusted(self) -> NDArray[np.float64]:
        """(p,) standard deviation of each parameter over the trusted windows; NaN if there are none."""
        theta = np.asarray(self.fit.theta)[self.verdicts.trusted]
        return theta.std(axis=0) if len(theta) else np.full(len(self.names), np.nan)


def identify(job: Job, progress: Progress = lambda share: None) -> list[Estimates]:
    """Run a job: one `Estimates` per method (a job without a robot beside the human has one).

    **Raises:** `ValueError` with one line that names the cause and the remedy.
    """
    return identify_recording(job, job.load(), job.load_robot_alone(), progress)


def identify_recording(
    job: Job, recording: Recording, alone: Recording | None = None, progress: Progress = lambda share: None
) -> list[Estimates]:
    """As `identify`, for recordings that are in memory."""
    prepared = prepare(job, recording, alone)
    progress(0.3)
    return in_windows(job, prepared, lambda share: progress(0.3 + 0.7 * share))


@dataclass(frozen=True)
class _Pair:
    """What methods 1 to 4 need beside the rows of the robot with the human."""

    robot: Model
    robot_fit: WindowFit
    alone: Regression
    loaded: Regression


class Moments(NamedTuple):
    """Of all rows that count, whatever the window."""

    torque: AnyArray
    """() variance [N^2 m^2]."""
    columns: AnyArray
    """(p,) mean squares."""

    @property
    def parameter_scale(self) -> NDArray[np.float64]:
        """(p,) what each parameter would be if its column made all of the torque's variation by itself."""
        size = np.sqrt(self.columns)
        return np.sqrt(self.torque) / np.where(size > 0, size, np.inf)


def moments(W: AnyArray, torque: AnyArray, valid: AnyArray) -> Moments:
    """Of (N, *n, p) columns and (N, *n) torques, where they are valid; of JAX's arrays or numpy's."""
    xp = jnp if isinstance(W, Array) else np
    W, torque, valid = W.reshape(-1, W.shape[-1]), torque.ravel(), valid.ravel()
    count = xp.maximum(valid.sum(), 1)
    mean = xp.where(valid, torque, 0).sum() / count
    variance = (xp.where(valid, torque - mean, 0) ** 2).sum() / count
    return Moments(variance, (xp.where(valid[:, None], W, 0) ** 2).sum(axis=0) / count)


class Solved(NamedTuple):
    """What is found in the windows before it is judged."""

    fit: SlidingFit
    unseen: Score
    """How well each window's parameters predict the torque of the window behind it."""
    moments: Moments


@dataclass(frozen=True)
class Prepared:
    """A filtered recording: what windows of any length share (but for filters inside every window)."""

    recording: Recording
    model: Model
    """What is identified in the windows: the human where there is one, else the robot."""
    filters: Filters
    rows: Rows
    noise: Array | None
    """What the filters make of white torque noise, see `noise_of_rows`."""
    column_noise: NDArray[np.float64]
    """(p,) what noise of the position leaves in each column."""
    pair: _Pair | None
    reference: ReferenceMotion
    jumps: NDArray[np.bool_]
    """(N,) where the position jumps."""
    solved: tuple[Solved, ...] = ()
    """One for each joint (of joints side by side), where the windows are solved already, many recordings at a time."""


def prepare(job: Job, recording: Recording, alone: Recording | None = None) -> Prepared:
    """Filter the recordings of a job."""
    robot, human, filters = checked_models(job, recording)
    noise = noise_of_rows(job, recording, filters)
    model = robot if human is None else human
    assert model is not None
    if robot is None or human is None:
        rows, pair = regress(model, recording, job, filters), None
    else:
        rows, pair = _prepare_pair(job, recording, alone, robot, human, filters)
    return Prepared(
        recording, model, filters, rows, noise, column_noise(model, recording, job, filters), pair,
        reference_motion(job, recording), jumped(recording),
    )  # fmt: skip


def checked_models(job: Job, recording: Recording) -> tuple[Model | None, Model | None, Filters]:
    """Robot's and human's model and the filters, for a recording that suits the job."""
    require_float64(recording.position)
    check_window(job, recording)
    robot, human = job.models(recording.joints, recording.sample_rate)
    if job.model.arm is not None:
        _check_elbow(job, recording)
    return robot, human, design_filters(job.filter, recording.sample_rate)


def _check_elbow(job: Job, recording: Recording) -> None:
    """A human's elbow does not turn further than half a turn; degrees that pass for radians do."""
    assert job.model.arm is not None
    farthest = float(np.nanmax(np.abs(recording.position[:, 1])))
    if job.model.arm.equilibrium is not None and farthest > np.pi:
        raise ValueError(
            f"the elbow turns to {farthest:.3g} rad, more than half a turn: are these degrees? Give unit = 'deg'"
        )


def in_windows(
    job: Job,
    prepared: Prepared,
    progress: Progress = lambda share: None,
    longest: float | None = None,
    curves: bool = True,
) -> list[Estimates]:
    """Solve (where that is not done yet) and judge every window of a prepared recording, by every method of the job.

    **Arguments:** `longest` [s], where other lengths of up to so much follow: they will share the compiled code;
    `curves` whether the torques over time are wanted, which only figures need.
    """
    if isinstance(prepared.model, Joints):
        return [_joint_by_joint(job, prepared, progress, longest, curves)]
    rows, noise = prepared.rows, prepared.noise
    place = windows_in_rows(job, prepared.recording, rows, prepared.filters, longest)
    if prepared.solved:
        return [_estimates(job, prepared, rows, prepared.solved[0], place, curves=curves)]
    if prepared.pair is None:
        valid = jnp.asarray(rows.valid)

        def solve(W: Array) -> SlidingFit:
            return sliding_least_squares(
                W, rows.torque, place.window, place.step, valid=valid, noise=noise, room=place.room
            )

        fit = solve(rows.W)
        gain = solve(with_gain(prepared.model, rows.W)) if prepared.model.memory else None
        return [_estimates(job, prepared, rows, _predict(rows, fit, place), place, gain=gain, curves=curves)]
    pair = prepared.pair
    merge = combine(pair.robot, prepared.model).merge
    results = []
    for count, method in enumerate(job.model.methods):

        def solve_pair(alone: Regression, loaded: Regression, method: int = method) -> Separation:
            return separate(method, pair.robot_fit, alone, loaded, merge, place.window, place.step, noise, place.room)

        found, gain = solve_pair(pair.alone, pair.loaded), None
        if prepared.model.memory:
            alone, loaded = (replace(x, human=with_gain(prepared.model, x.human)) for x in (pair.alone, pair.loaded))
            gain = solve_pair(alone, loaded).fit
        n = len(found.torque)
        human = Rows(pair.loaded.human[:n], found.torque, rows.valid[:n], rows.time[:n])
        solved = _predict(human, found.fit, place)
        notes = (METHODS[method], found.warning)
        estimates = _estimates(job, prepared, human, solved, place, method, *notes, gain=gain, curves=curves)
        results.append(replace(estimates, method=method, robot=pair.robot_fit, robot_names=pair.robot.names))
        progress((count + 1) / len(job.model.methods))
    return results


def _joint_by_joint(job: Job, prepared: Prepared, progress: Progress, longest: float | None, curves: bool) -> Estimates:
    """Joints side by side share no parameter and no noise: each is solved and judged by itself."""
    assert isinstance(prepared.model, Joints)
    for name in job.trust.parameters:
        if name not in prepared.model.names:
            hint = nearest(name, list(prepared.model.names))
            raise ValueError(f"trust.parameters has an unknown parameter '{name}': {hint}")
    parts, first = [], 0
    for j, model in enumerate(prepared.model.models):
        columns = slice(first, first + len(model.names))
        tag = f"joint{j + 1}."
        chosen = tuple(name.removeprefix(tag) for name in job.trust.parameters if name.startswith(tag))
        alone = replace(job, trust=replace(job.trust, parameters=chosen))
        one = _one_joint(prepared, j, model, columns)
        parts.append(in_windows(alone, one, longest=longest, curves=curves)[0])
        first = columns.stop
        progress((j + 1) / len(prepared.model.models))
    return _side_by_side(prepared.model, parts)


def _one_joint(prepared: Prepared, j: int, model: Model, columns: slice) -> Prepared:
    """The share of one joint in a prepared recording of several."""
    recording, rows, this = prepared.recording, prepared.rows, slice(j, j + 1)
    return replace(
        prepared,
        recording=replace(
            recording,
            position=recording.position[:, this],
            torque=recording.torque[:, this],
            joints=recording.joints[this],
        ),
        model=model,
        rows=Rows(rows.W[:, j, columns], rows.torque[:, j], rows.valid[:, j], rows.time),
        column_noise=prepared.column_noise[columns],
        reference=_of_joint(prepared.reference, this),
        solved=prepared.solved[this],
    )


def _of_joint(reference: ReferenceMotion, this: slice) -> ReferenceMotion:
    if isinstance(reference, str):
        return reference
    q, dq, ddq = (x[:, this] for x in reference)
    return q, dq, ddq


def _side_by_side(model: Joints, parts: list[Estimates]) -> Estimates:
    """One table of several joints: a window is as good as its worst joint."""
    fits = [part.fit for part in parts]

    def stacked(name: str) -> Array:
        return jnp.stack([getattr(fit, name) for fit in fits])

    def beside(name: str) -> Array:
        return jnp.concatenate([getattr(fit, name) for fit in fits], axis=1)

    fit = SlidingFit(
        theta=beside("theta"),
        stderr=beside("stderr"),
        excitation=beside("excitation"),
        dof=stacked("dof").min(axis=0),
        cond=stacked("cond").max(axis=0),
        sigma_min=stacked("sigma_min").min(axis=0),
        residual_rms=jnp.sqrt((stacked("residual_rms") ** 2).mean(axis=0)),
        vaf=stacked("vaf").min(axis=0),
        samples=stacked("samples").sum(axis=0),
        first=fits[0].first,
        last=fits[0].last,
    )
    thresholds = [part.threshold for part in parts if part.threshold is not None]
    return replace(
        parts[0],
        names=model.names,
        units=model.units,
        fit=fit,
        held_out_vaf=np.min([part.held_out_vaf for part in parts], axis=0),
        verdicts=worst([part.verdicts for part in parts], [f"joint {j + 1}: " for j in range(len(parts))]),
        threshold=max(thresholds, default=None),
        torque=np.concatenate([part.torque for part in parts], axis=1),
        reconstructed=np.concatenate([part.reconstructed for part in parts], axis=1),
        predicted=np.concatenate([part.predicted for part in parts], axis=1),
        notes=tuple(dict.fromkeys(note for part in parts for note in part.notes)),
        reflexes=tuple(_reflexes_side_by_side(parts)),
    )


def _reflexes_side_by_side(parts: list[Estimates]) -> Iterator[Reflex]:
    first = 0
    for j, part in enumerate(parts):
        for reflex in part.reflexes:
            yield replace(reflex, name=f"joint{j + 1}.{reflex.name}", columns=first + reflex.columns)
        first += len(part.names)


def at_other_lengths(
    job: Job,
    prepared: Prepared,
    alone: Recording | None = None,
    factors: tuple[float, ...] = (0.5, 2.0),
    progress: Progress = lambda share: None,
) -> list[Estimates]:
    """The same data with shorter and longer windows, so that the choice of a length can be seen.

    Lengths that the recording or the filters do not allow are left out.
    """

    def identified(factor: float) -> list[Estimates]:
        window = replace(job.window, length=factor * job.window.length, step=step_seconds(job))
        other = replace(job, window=window, model=replace(job.model, methods=job.model.methods[:1]))
        with suppress(ValueError):
            once = job.filter.mode == "once"
            shared = prepared if once else prepare(other, prepared.recording, alone)
            return in_windows(other, shared, longest=max(factors) * job.window.length)
        return []

    found = []
    for count, factor in enumerate(factors):
        found += identified(factor)
        progress((count + 1) / len(factors))
    return found


def regress_both(
    robot: Model, human: Model, recording: Recording, job: Job, filters: Filters
) -> tuple[Regression, Rows]:
    """Rows of the robot's and of the human's model for one recording, apart and stacked."""
    rows = regress(robot + human, recording, job, filters)
    n = len(robot.names)
    return Regression(rows.W[:, :n], rows.W[:, n:], rows.torque, jnp.asarray(rows.valid)), rows


def _prepare_pair(
    job: Job, recording: Recording, alone: Recording | None, robot: Model, human: Model, filters: Filters
) -> tuple[Rows, _Pair]:
    alone = _checked_pair(recording, alone)
    # The robot's own parameters come from its whole recording, which needs no windows.
    once = replace(job, filter=replace(job.filter, mode="once"))
    whole = regress_both(robot, human, alone, once, filters)[0]
    robot_fit = fit_robot(whole, noise_of_rows(once, alone, filters))
    # Methods 1 and 2 need no windows of the robot alone.
    shared = job.filter.mode == "once" or not {3, 4}.intersection(job.model.methods)
    in_windows = whole if shared else regress_both(robot, human, alone, job, filters)[0]
    loaded, rows = regress_both(robot, human, recording, job, filters)
    return rows, _Pair(robot, robot_fit, in_windows, loaded)


def _checked_pair(recording: Recording, alone: Recording | None) -> Recording:
    if alone is None:
        raise ValueError("a human in a robot needs the recording of the robot alone: add a [robot_recording] table")
    if recording.n_joints != 1 or alone.n_joints != 1:
        raise ValueError("methods 1 to 4 work on one joint at a time: map one position and one torque column")
    if abs(alone.sample_rate - recording.sample_rate) > 1e-3 * recording.sample_rate:
        raise ValueError(
            f"the robot alone was sampled at {alone.sample_rate:g} Hz and the robot with the human at "
            f"{recording.sample_rate:g} Hz: resample one of them"
        )
    return alone


def _predict(rows: Rows, fit: SlidingFit, place: Placement) -> Solved:
    """Hold every window's parameters against the window behind it."""
    ahead = place.next_starts[: len(fit.last)]
    valid = jnp.asarray(rows.valid)
    unseen = score(rows.W, rows.torque, valid, fit.theta, ahead, place.window, place.step, place.room)
    return Solved(fit, unseen, moments(*(np.asarray(x) for x in (rows.W, rows.torque, rows.valid))))


def _estimates(
    job: Job,
    prepared: Prepared,
    rows: Rows,
    solved: Solved,
    place: Placement,
    method: int | None = None,
    *notes: str,
    gain: SlidingFit | None = None,
    curves: bool = True,
) -> Estimates:
    """Judge the windows of a fit. `gain`: the fit that `with_gain` makes."""
    recording, model = prepared.recording, prepared.model
    fit, unseen, whole = solved
    starts = place.starts[: len(fit.last)]
    held_out = np.where(np.asarray(unseen.variance) > STILL * whole.torque, np.asarray(unseen.vaf), np.nan)
    if method in (2, 4):  # these solve for more than the human: judge them by the human's torque, as the others
        valid = jnp.asarray(rows.valid)
        seen = score(rows.W, rows.torque, valid, fit.theta, starts, place.window, place.step, place.room)
        quality = (seen.vaf, seen.residual_rms, seen.samples)
        fit = eqx.tree_at(lambda f: (f.vaf, f.residual_rms, f.samples), fit, quality)
    threshold, why_not = _threshold(job, prepared, place, method)
    reflexes = () if gain is None else (_reflex(model, fit, gain),)
    limits = job.trust
    if reflexes and not limits.parameters:
        # Weights of neighbouring lags are uncertain one by one, and nobody asks for them one by one.
        limits = replace(limits, parameters=tuple(np.delete(model.names, reflexes[0].columns).tolist()))
    verdicts = judge(
        fit,
        model.names,
        place.counted * model.n_joints,
        whole.parameter_scale,
        prepared.column_noise,
        threshold,
        limits,
    )
    jumps = jump_note(recording, prepared.jumps)
    reconstructed, predicted, shown = _reconstruct(rows, fit, starts, place, curves)
    measured = np.where(np.asarray(rows.valid), np.asarray(rows.torque), np.nan)[shown]
    return Estimates(
        names=model.names,
        units=model.units,
        window=job.window.length,
        start=rows.time[starts],
        end=rows.time[np.asarray(fit.last)],
        fit=fit,
        held_out_vaf=np.asarray(held_out),
        verdicts=verdicts,
        threshold=threshold,
        time=rows.time[shown],
        torque=measured.reshape(reconstructed.shape),
        reconstructed=reconstructed,
        predicted=predicted,
        notes=(
            *recording.notes,
            *filter(None, (jumps, _literal_note(job), why_not, *notes)),
            *(_reflex_note(reflex, verdicts.trusted) for reflex in reflexes),
        ),
        reflexes=reflexes,
    )


def _reflex(model: Model, fit: SlidingFit, gain: SlidingFit) -> Reflex:
    """Gain and delay in every window, from the weights and from the fit in which the gain is the first of them."""
    pathway = pathway_of(model)
    columns = np.array([model.columns.index(column) for column in pathway.columns])
    theta, lags = np.asarray(fit.theta)[:, columns], np.array(pathway.lags)
    total, stderr = (np.asarray(x)[:, columns[0]] for x in (gain.theta, gain.stderr))
    with np.errstate(invalid="ignore", divide="ignore"):
        delay = np.where(np.abs(total) > CLEAR * stderr, theta @ lags / theta.sum(axis=1), np.nan)
    return Reflex("reflex", model.units[columns[0]], lags, columns, total, stderr, delay)


def _reflex_note(reflex: Reflex, trusted: NDArray[np.bool_]) -> str:
    note = (
        "the verdict does not look at the weights of the reflex one by one (trust.parameters can name some): those of "
        "neighbouring lags are uncertain where their sum, the gain, is not"
    )
    below = reflex.gain[trusted] < -CLEAR * reflex.gain_stderr[trusted]
    if 2 * below.sum() > len(below):
        note += "; the gain is below zero, as of a reflex that helps the stretch: try the other direction"
    return note


def jump_note(recording: Recording, jumps: NDArray[np.bool_]) -> str:
    """Where the position jumps, for people; empty where it does not."""
    at = recording.time[jumps]
    if not len(at):
        return ""
    where = ", ".join(f"{t:.6g} s" for t in at[::2][:5]) + (", ..." if len(at) > 10 else "")
    return f"the position jumps ({where}), as no joint can move: the samples around that are left out"


def _literal_note(job: Job) -> str:
    if job.filter.mode == "once":
        return ""
    dropped = job.filter.drop_transient
    measured = "0.1 (the ends are left out)" if dropped else "2 (filter.drop_transient = true leaves the ends out)"
    return (
        "the filters ran inside every window, where position and torque do not pass the same filters near the ends: "
        f"the inertia is biased, on the simulated rig by {measured} standard deviations; filter.mode = 'once' is not"
    )


def _threshold(job: Job, prepared: Prepared, place: Placement, method: int | None) -> tuple[float | None, str]:
    """Threshold of eq. (16), or why it is not applied."""
    if method in (2, 4):
        return None, (
            f"method {method} solves for robot and human together: the threshold for fake changes (eq. 16) of the "
            "human alone does not fit their condition number and is not applied"
        )
    if isinstance(prepared.reference, str):
        return None, prepared.reference
    q, dq, ddq = (x[:, 0] if prepared.recording.n_joints == 1 else x for x in prepared.reference)
    rate = prepared.recording.sample_rate
    W = prepared.model.over_period(q, dq, ddq, rate).reshape(-1, len(prepared.model.names))
    window = round(job.window.length * rate * place.counted / place.window)
    return float(fake_change_threshold(np.asarray(W), len(q), window)), ""


def reference_motion(job: Job, recording: Recording) -> ReferenceMotion:
    """Position, velocity, acceleration (P, n) of one period of the reference motion, or why there is none."""
    rate, series = recording.sample_rate, job.load_design()
    if series is not None:
        q, dq, ddq = (x.reshape(len(x), -1) for x in series(jnp.arange(round(float(series.period) * rate)) / rate))
        if q.shape[1] != recording.n_joints:
            raise ValueError(f"{job.design} moves {q.shape[1]} joints, but the recording has {recording.n_joints}")
        return q, dq, ddq
    if recording.reference is None or job.reference_period is None:
        missing = "reference position" if recording.reference is None else "reference_period"
        return (
            f"no {missing} was given, so the threshold for fake changes (Tout et al. 2023, eq. 16; for periodic "
            "reference motions) is not applied"
        )
    reference = recording.reference[: round(job.reference_period * rate)]
    if len(reference) < round(job.reference_period * rate) or not np.isfinite(reference).all():
        return "the reference position does not cover one period, so the threshold (eq. 16) is not applied"
    return reference, *signals.central_differences(reference, rate)


def _reconstruct(
    rows: Rows, fit: SlidingFit, starts: NDArray[np.int64], place: Placement, wanted: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """The model's torque with seen and unseen parameters, and which rows it is shown for."""
    W, theta = np.asarray(rows.W), np.asarray(fit.theta)
    times, window = rows.time, place.window
    if not wanted:
        none = np.empty((0, int(np.prod(W.shape[1:-1]))))
        return none, none, np.empty(0, np.int64)
    if place.separate:  # windows hold copies of the same samples: show each sample once, from non-overlapping windows
        chosen, end = [], -np.inf
        for k, first in enumerate(starts):
            if times[first] > end:
                chosen.append(k)
                end = times[first + window - 1]
        shown = np.concatenate([np.arange(starts[k], starts[k] + window) for k in chosen])
        around = np.repeat(chosen, window)
        unseen = np.repeat([-1, *chosen[:-1]], window)
    else:
        shown = np.arange(len(W))
        around = np.searchsorted(starts + window / 2, shown).clip(0, len(starts) - 1)
        unseen = np.searchsorted(starts + window, shown - shown % window, side="right") - 1
    reconstructed = np.einsum("k...p,kp->k...", W[shown], theta[around])
    predicted = np.einsum("k...p,kp->k...", W[shown], theta[unseen])
    predicted[unseen < 0] = np.nan
    return reconstructed.reshape(len(shown), -1), predicted.reshape(len(shown), -1), shown
