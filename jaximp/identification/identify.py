"""Recordings in memory: filtered, solved in all windows, judged.

`identify` and everything that runs it for many recordings share this module; it knows no files and no jobs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from jaximp.identification.comparisons import by_frequency, changes
from jaximp.identification.estimates import Estimates, Reflex
from jaximp.identification.literal import noise_in_windows, regress_in_windows
from jaximp.identification.misfit import (
    RobotTests,
    by_bands,
    find_human_misfits,
    find_misfits,
    harmless,
    in_words,
    missing,
    off_by,
    sizes,
    unnoticed,
)
from jaximp.identification.pipeline import Pipeline, ReferenceMotion
from jaximp.identification.regression import Filtered, Measured, Rows, column_noise, measure, once, regress, rows_of
from jaximp.identification.separation import METHODS, Regression, Separation, Whiten, fit_robot, robot_columns, separate
from jaximp.identification.solving import (
    MOST_ROWS,
    Placement,
    Solved,
    Task,
    moments,
    place_windows,
    solve_stack,
)
from jaximp.identification.whitening import White, from_white, whiten
from jaximp.least_squares.sliding import score, sliding_least_squares
from jaximp.least_squares.window import SlidingFit, WindowFit
from jaximp.models.base import Joints, Model, combine
from jaximp.models.reflex import pathway_of, with_gain
from jaximp.trust.criteria import fake_change_threshold
from jaximp.trust.limits import TrustLimits
from jaximp.trust.score_tests import Bands, Misfit, compare_bands
from jaximp.trust.window_rules import excited_windows, judge_together, judged_names, measure_windows
from jaximp.types import Progress, Recording, nearest

CLEAR = 2.0
"""A reflex whose gain is so many standard errors from zero has a delay."""
STILL = 1e-3
"""A window whose torque varies by a smaller share of the recording's variance can neither confirm nor refute."""


def estimate(
    pipeline: Pipeline,
    recording: Recording,
    alone: Recording | None = None,
    progress: Progress = lambda share: None,
) -> list[Estimates]:
    """Identify a recording in all windows: one `Estimates` for each method (one where there is no pair).

    **Arguments:** `alone`, the recording of the robot without the human, where the pipeline has a robot.

    **Raises:** `ValueError` with one line that names the cause and the remedy.
    """
    prepared = prepare(pipeline, recording, alone)
    progress(0.3)
    return in_windows(prepared, lambda share: progress(0.3 + 0.7 * share))


@dataclass(frozen=True)
class _Pair:
    """What methods 1 to 4 need beside the rows of the robot with the human."""

    robot: Model
    robot_fit: WindowFit
    alone: Regression
    loaded: Regression
    tests: RobotTests | None
    """Of the robot's model, where the pipeline whitens."""


@dataclass(frozen=True)
class Prepared:
    """A filtered recording: what windows of any length share (but for filters inside every window)."""

    recording: Recording
    pipeline: Pipeline
    rows: Rows
    column_noise: NDArray[np.float64]
    """(p,) root mean square of what noise of the position leaves in each column."""
    pair: _Pair | None
    reference: ReferenceMotion
    jumps: NDArray[np.bool_]
    """(N,) where the position jumps."""
    white: tuple[White, ...] = ()
    """Rows whose noise is white, of each joint (of joints side by side), where the pipeline whitens."""
    solved: tuple[Solved, ...] = ()
    """One for each joint (of joints side by side), where the windows of the pipeline are solved already."""

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
        return can_be_stacked(self.pipeline) and len(self.rows.time) <= MOST_ROWS


def can_be_stacked(pipeline: Pipeline) -> bool:
    """Whether recordings go through together: a pair needs two at a time, a reflex a second fit for its gain."""
    return pipeline.once and pipeline.robot is None and not pipeline.model.memory


def noise_of(pipeline: Pipeline) -> Array | NDArray[np.float64] | None:
    """What the filters make of white torque noise: by lag in rows, or for every pair of rows of a window."""
    if pipeline.once or pipeline.filters.parallel is None:
        return pipeline.filters.noise
    return noise_in_windows(pipeline)


def prepare(pipeline: Pipeline, recording: Recording, alone: Recording | None = None) -> Prepared:
    """Filter a recording, and that of the robot alone where there is a pair."""
    if pipeline.robot is not None:
        return _prepare_pair(pipeline, pipeline.robot, recording, alone)
    pipeline.check(recording)
    measured = measure(pipeline, recording)
    if pipeline.once:
        return _prepared(measured, *regress(measured))
    return _prepared(measured, regress_in_windows(pipeline, recording, pipeline.model), column_noise(measured))


def share_of_stack(measured: Measured, found: Filtered, k: int) -> Prepared:
    """A recording that was filtered with others, as `prepare` has it.

    **Raises:** `ValueError` where no sample is left.
    """
    return _prepared(measured, *rows_of(measured, found, k))


def _prepared(measured: Measured, rows: Rows, noise: NDArray[np.float64], pair: _Pair | None = None) -> Prepared:
    recording, pipeline = measured.recording, measured.pipeline
    reference = pipeline.reference_motion(recording)
    white = tuple(_whitened(pipeline, rows)) if pipeline.whitens and pair is None else ()
    if white:
        noise = np.concatenate([one.column_noise for one in white])
    return Prepared(recording, pipeline, rows, noise, pair, reference, measured.jumps, white)


def _whitened(pipeline: Pipeline, rows: Rows) -> Iterator[White]:
    """White rows of each joint of joints side by side, which share neither parameters nor noise."""
    for columns in _columns_by_joint(pipeline.model):
        yield whiten(pipeline, rows if columns is None else rows.of_joint(*columns))


def solve_windows(
    several: Sequence[Prepared], padded: int | None = None, stacked: int = 1, longest: float | None = None
) -> list[Prepared]:
    """All windows of recordings that were filtered alike, joint by joint, in one call each.

    **Arguments:** `padded` rows to which each is filled up, in a stack of so many; `longest` [s], where other lengths
    of up to so much follow: they will share the compiled code.
    """
    first, found = several[0], []
    padded = len(first.rows.time) if padded is None else padded
    for j, columns in enumerate(_columns_by_joint(first.model)):
        tasks = [_task(one, one.rows if columns is None else one.rows.of_joint(*columns), j) for one in several]
        found.append(solve_stack(tasks, place_windows(first.pipeline, tasks[0].rows, longest), padded, stacked))
    return [replace(one, solved=solved) for one, solved in zip(several, zip(*found, strict=True), strict=True)]


def _task(prepared: Prepared, rows: Rows, j: int) -> Task:
    """What is to be solved of one joint."""
    if prepared.white:
        return Task(rows, white=prepared.white[j])
    return Task(rows, prepared.pipeline.filters.noise)


def _columns_by_joint(model: Model) -> list[tuple[int, slice] | None]:
    """Which parameters are those of each joint of joints side by side; None stands for all of another model."""
    if not isinstance(model, Joints):
        return [None]
    ends = np.cumsum([len(part.names) for part in model.models]).tolist()
    return [(j, slice(first, end)) for j, (first, end) in enumerate(zip([0, *ends], ends, strict=False))]


def in_windows(
    prepared: Prepared,
    progress: Progress = lambda share: None,
    longest: float | None = None,
    curves: bool = True,
) -> list[Estimates]:
    """Solve (where that is not done yet) and judge every window of a prepared recording, by every method.

    **Arguments:** `longest` [s], where other lengths of up to so much follow: they will share the compiled code;
    `curves` whether the torques over time are wanted, which only figures need.
    """
    if not prepared.solved and prepared.stackable:
        prepared = solve_windows([prepared], longest=longest)[0]
    if isinstance(prepared.model, Joints):
        return [_joint_by_joint(prepared, prepared.model, progress, longest, curves)]
    rows = prepared.rows
    place = place_windows(prepared.pipeline, rows, longest)
    if prepared.solved:
        misfits = _misfits(prepared, prepared.solved[0].fit)
        return [_estimates(prepared, rows, prepared.solved[0], place, curves=curves, misfits=misfits)]
    if prepared.pair is not None:
        return _by_methods(prepared, prepared.pair, place, progress, curves)

    white = prepared.white[0] if prepared.white else None
    solve = partial(sliding_least_squares, window=place.window, step=place.step, room=_room(place))
    solve = partial(solve, valid=jnp.asarray(rows.valid), noise=None if white else prepared.noise)
    W, torque = (jnp.asarray(x) for x in ((white.W, white.torque) if white else (rows.W, rows.torque)))
    fit = solve(W, torque)
    gain = solve(with_gain(prepared.model, W), torque) if prepared.model.memory else None
    ordinary = None
    if white:
        ordinary = solve(jnp.asarray(rows.W), rows.torque)
        seen = score(rows.W, rows.torque, rows.valid, fit.theta, place.starts, place.window, place.step, _room(place))
        fit = from_white(fit, ordinary, white, seen)
        gain = None if gain is None else from_white(gain, ordinary, replace(white, inflation=np.ones(1)))
    solved, misfits = _predict(rows, fit, place)._replace(ordinary=ordinary), _misfits(prepared, fit)
    return [_estimates(prepared, rows, solved, place, gain=gain, curves=curves, misfits=misfits)]


def _misfits(prepared: Prepared, fit: SlidingFit) -> tuple[Misfit, ...]:
    """What the model of one joint or of an arm lacks; nothing is known without white rows."""
    if not prepared.white:
        return ()
    usual = _usual(fit)
    if usual is None:
        return ()
    return find_misfits(prepared.pipeline, prepared.recording, prepared.rows, prepared.white[0], usual)


def _human_misfits(prepared: Prepared, pair: _Pair, found: Separation, method: int) -> tuple[Misfit, ...]:
    """What the model of a human in a robot lacks by one of the methods, or the robot's, if that moves the human's."""
    usual = _usual(found.fit)
    if pair.tests is None or usual is None:
        return ()
    left = partial(robot_columns, method, loaded=pair.loaded)
    return find_human_misfits(prepared.pipeline, prepared.recording, found, usual, left, pair.tests)


def _usual(fit: SlidingFit) -> NDArray[np.float64] | None:
    """(p,) median over the windows that are solved, if there are any."""
    theta = np.asarray(fit.theta)
    known = theta[np.isfinite(theta).all(axis=1)]
    return np.median(known, axis=0) if len(known) else None


def _room(place: Placement) -> int | None:
    return place.room if place.lengths else None


def _by_methods(prepared: Prepared, pair: _Pair, place: Placement, progress: Progress, curves: bool) -> list[Estimates]:
    """The human in the robot, by every method that is asked for."""
    rows, methods = prepared.rows, prepared.pipeline.methods
    noise = None if prepared.pipeline.whitens else prepared.noise
    merge = combine(pair.robot, prepared.model).merge
    results = []
    for count, method in enumerate(methods):

        def solve_pair(alone: Regression, loaded: Regression, method: int = method) -> Separation:
            given = (merge, place.window, place.step, noise, _room(place), _whitener(prepared.pipeline))
            return separate(method, pair.robot_fit, alone, loaded, *given)

        found, gain = solve_pair(pair.alone, pair.loaded), None
        if prepared.model.memory:
            alone, loaded = (replace(x, human=with_gain(prepared.model, x.human)) for x in (pair.alone, pair.loaded))
            gain = solve_pair(alone, loaded).fit
        n = len(found.torque)
        human = Rows(pair.loaded.human[:n], found.torque, rows.valid[:n], rows.time[:n])
        solved = _predict(human, found.fit, place)
        notes, own = (METHODS[method], found.warning, pair.tests.note if pair.tests else ""), prepared
        if found.white is not None and rows.noisy is not None:
            noisy = found.white.apply(rows.noisy[:n, len(pair.robot.names) :], rows.valid[:n])
            own = replace(prepared, column_noise=np.sqrt((noisy**2).mean(axis=0)))
        misfits = _human_misfits(prepared, pair, found, method)
        estimates = _estimates(own, human, solved, place, method, *notes, gain=gain, curves=curves, misfits=misfits)
        results.append(replace(estimates, method=method, robot=pair.robot_fit, robot_names=pair.robot.names))
        progress((count + 1) / len(methods))
    return results


def _whitener(pipeline: Pipeline) -> Whiten | None:
    """What makes white rows of any columns, where the noise's shape is to be estimated."""
    if not pipeline.whitens:
        return None
    return lambda W, y, valid: whiten(pipeline, Rows(W, y, np.asarray(valid), np.empty(0)))


def _joint_by_joint(
    prepared: Prepared, model: Joints, progress: Progress, longest: float | None, curves: bool
) -> Estimates:
    """Joints side by side share no parameter and no noise: each is solved and judged by itself."""
    for name in prepared.pipeline.limits.parameters:
        if name not in model.names:
            hint = nearest(name, list(model.names))
            raise ValueError(f"trust.parameters has an unknown parameter '{name}': {hint}")
    parts = []
    for place in filter(None, _columns_by_joint(model)):
        one = _one_joint(prepared, model, *place)
        parts.append(in_windows(one, longest=longest, curves=curves)[0])
        progress(len(parts) / len(model.models))
    return replace(_side_by_side(model, parts), limits=prepared.pipeline.limits)


def _one_joint(prepared: Prepared, model: Joints, j: int, columns: slice) -> Prepared:
    """The share of one joint in a prepared recording of several."""
    recording, pipeline, this = prepared.recording, prepared.pipeline, slice(j, j + 1)
    tag = f"joint{j + 1}."
    chosen = tuple(name.removeprefix(tag) for name in pipeline.limits.parameters if name.startswith(tag))
    return replace(
        prepared,
        recording=replace(
            recording,
            position=recording.position[:, this],
            torque=recording.torque[:, this],
            joints=recording.joints[this],
        ),
        pipeline=replace(pipeline, model=model.models[j], limits=replace(pipeline.limits, parameters=chosen)),
        rows=prepared.rows.of_joint(j, columns),
        column_noise=prepared.column_noise[columns],
        reference=_of_joint(prepared.reference, this),
        white=prepared.white[this],
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
        model=model,
        names=model.names,
        units=model.units,
        fit=fit,
        noise=tuple(one for part in parts for one in part.noise),
        frequencies=tuple(one.of_joint(j) for j, part in enumerate(parts) for one in part.frequencies),
        misfits=tuple(
            replace(one, group=f"joint {j + 1}: {one.group}") for j, part in enumerate(parts) for one in part.misfits
        ),
        lacking={f"joint{j + 1}.{name}": why for j, part in enumerate(parts) for name, why in part.lacking.items()},
        held_out_vaf=np.min([part.held_out_vaf for part in parts], axis=0),
        measured=tuple(windows for part in parts for windows in part.measured),
        threshold=max(thresholds, default=None),
        torque=np.concatenate([part.torque for part in parts], axis=1),
        reconstructed=np.concatenate([part.reconstructed for part in parts], axis=1),
        predicted=np.concatenate([part.predicted for part in parts], axis=1),
        notes=tuple(_notes_side_by_side(parts)),
        reflexes=tuple(_reflexes_side_by_side(parts)),
    )


def _notes_side_by_side(parts: list[Estimates]) -> Iterator[str]:
    """What is said of every joint once, and of the others with a label."""
    shared = set.intersection(*(set(part.notes) for part in parts))
    yield from (note for note in parts[0].notes if note in shared)
    for j, part in enumerate(parts):
        yield from (f"joint {j + 1}: {note}" for note in part.notes if note not in shared)


def _reflexes_side_by_side(parts: list[Estimates]) -> Iterator[Reflex]:
    first = 0
    for j, part in enumerate(parts):
        for reflex in part.reflexes:
            yield replace(reflex, name=f"joint{j + 1}.{reflex.name}", columns=first + reflex.columns)
        first += len(part.names)


def at_other_lengths(
    prepared: Prepared,
    alone: Recording | None = None,
    factors: tuple[float, ...] = (0.5, 2.0),
    progress: Progress = lambda share: None,
) -> list[Estimates]:
    """The same data with shorter and longer windows, by the first method, so that the choice of a length can be seen.

    Lengths that the recording or the filters do not allow are left out.
    """
    length = prepared.pipeline.window.length

    def identified(factor: float) -> list[Estimates]:
        other = prepared.pipeline.with_window(factor * length)
        other = replace(other, methods=other.methods[:1])
        with suppress(ValueError):
            other.check(prepared.recording)
            shared = with_windows(prepared, other) if other.once else prepare(other, prepared.recording, alone)
            return in_windows(shared, longest=max(factors) * length, curves=False)
        return []

    found = []
    for count, factor in enumerate(factors):
        found += identified(factor)
        progress((count + 1) / len(factors))
    return found


def with_windows(prepared: Prepared, pipeline: Pipeline) -> Prepared:
    """The same rows for windows of another length, whose noise is estimated from what they leave."""
    white = tuple(_whitened(pipeline, prepared.rows)) if prepared.white else ()
    return replace(prepared, pipeline=pipeline, white=white, solved=())


def regress_pair(pipeline: Pipeline, robot: Model, recording: Recording) -> tuple[Regression, Rows, Measured]:
    """Rows of the robot's and of the human's model for one recording, apart and stacked."""
    both = robot + pipeline.model
    measured = measure(pipeline, recording, both)
    rows = regress(measured)[0] if pipeline.once else regress_in_windows(pipeline, recording, both)
    n = len(robot.names)
    W, torque = jnp.asarray(rows.W), jnp.asarray(rows.torque)
    return Regression(W[:, :n], W[:, n:], torque, jnp.asarray(rows.valid)), rows, measured


def _prepare_pair(pipeline: Pipeline, robot: Model, recording: Recording, alone: Recording | None) -> Prepared:
    pipeline.check(recording)
    alone = _checked_pair(recording, alone)
    # The robot's own parameters come from its whole recording, which needs no windows.
    whole_record = once(pipeline)
    whole = regress_pair(whole_record, robot, alone)[0]
    known = None if pipeline.whitens else noise_of(whole_record)
    whitener = _whitener(pipeline)
    white = None if whitener is None else whitener(whole.robot, whole.torque, whole.valid)
    robot_fit = fit_robot(whole, None if known is None else jnp.asarray(known), white)
    tests = None if whitener is None else RobotTests.of(pipeline, alone, whole, whitener)
    # Methods 1 and 2 need no windows of the robot alone.
    shared = pipeline.once or not {3, 4}.intersection(pipeline.methods)
    in_windows = whole if shared else regress_pair(pipeline, robot, alone)[0]
    loaded, rows, measured = regress_pair(pipeline, robot, recording)
    noise = column_noise(measured) if rows.noisy is None else np.sqrt((rows.noisy**2).mean(axis=0))
    pair = _Pair(robot, robot_fit, in_windows, loaded, tests)
    return _prepared(measured, rows, noise[len(robot.names) :], pair)


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
    unseen = score(rows.W, rows.torque, valid, fit.theta, ahead, place.window, place.step, _room(place))
    return Solved(fit, unseen, moments(*(np.asarray(x) for x in (rows.W, rows.torque, rows.valid))))


def _estimates(
    prepared: Prepared,
    rows: Rows,
    solved: Solved,
    place: Placement,
    method: int | None = None,
    *notes: str,
    gain: SlidingFit | None = None,
    curves: bool = True,
    misfits: tuple[Misfit, ...] = (),
) -> Estimates:
    """Judge the windows of a fit. `gain`: the fit that `with_gain` makes."""
    pipeline, model = prepared.pipeline, prepared.model
    solved = solved._replace(fit=_judged_by_the_human(pipeline, rows, solved.fit, place, method))
    fit, starts = solved.fit, place.starts[: len(solved.fit.last)]
    held_out = _held_out(solved)
    threshold, why_not = _threshold(prepared, place, method)
    reflexes = () if gain is None else (_reflex(model, fit, gain),)
    weights = {model.names[k] for reflex in reflexes for k in reflex.columns}
    limits = _limits(pipeline, weights)
    of_model = _OfModel.of(model, solved, misfits, place, judged_names(model, limits))
    full, scale = place.counted * model.n_joints, solved.moments.parameter_scale
    measured = measure_windows(fit, model.names, model.roles, full, scale, prepared.column_noise, threshold, limits)
    measured = replace(measured, tested=bool(misfits), missing=of_model.why, remedy=of_model.remedy)
    measured = judge_together(measured, fit, model.roles, held_out, _apart(place), limits)
    side_by_side = _apart(place) * np.flatnonzero(excited_windows(measured, limits)[:: _apart(place)])
    reconstructed, predicted, shown = _reconstruct(rows, fit, starts, place, curves)
    torque = np.where(np.asarray(rows.valid), np.asarray(rows.torque), np.nan)[shown].reshape(reconstructed.shape)
    about = (jump_note(prepared.recording, prepared.jumps), _literal_note(pipeline), why_not, *of_model.notes, *notes)
    estimates = Estimates(
        model=model,
        names=model.names,
        units=model.units,
        window=pipeline.window.length,
        start=rows.time[starts],
        end=rows.time[np.asarray(fit.last)],
        fit=fit,
        held_out_vaf=held_out,
        measured=(measured,),
        limits=pipeline.limits,
        threshold=threshold,
        time=rows.time[shown],
        torque=torque,
        reconstructed=reconstructed,
        predicted=predicted,
        notes=(*prepared.recording.notes, *filter(None, about), *changes(pipeline, fit, side_by_side)),
        reflexes=reflexes,
        misfits=misfits,
        bands=of_model.bands,
        frequencies=by_frequency(pipeline, rows, prepared.white) if misfits and curves else (),
        noise=_noise_spectra(prepared, torque - reconstructed) if curves else (),
        lacking={name: text for name, text in of_model.lacking.items() if name not in weights},
    )
    of_reflexes = tuple(_reflex_note(reflex, estimates.verdicts.trusted) for reflex in reflexes)
    return replace(estimates, notes=estimates.notes + of_reflexes) if of_reflexes else estimates


def _judged_by_the_human(
    pipeline: Pipeline, rows: Rows, fit: SlidingFit, place: Placement, method: int | None
) -> SlidingFit:
    """Methods 2 and 4 solve for more than the human, and white rows are other rows: the human's torque judges all."""
    if method is None or not (method in (2, 4) or pipeline.whitens):
        return fit
    starts, valid = place.starts[: len(fit.last)], jnp.asarray(rows.valid)
    seen = score(rows.W, rows.torque, valid, fit.theta, starts, place.window, place.step, _room(place))
    quality = (seen.vaf, seen.residual_rms, seen.samples)
    return eqx.tree_at(lambda f: (f.vaf, f.residual_rms, f.samples), fit, quality)


def _held_out(solved: Solved) -> NDArray[np.float64]:
    """(M,) how each window predicts the next; NaN where that one hardly has a torque."""
    unseen = solved.unseen
    return np.where(np.asarray(unseen.variance) > STILL * solved.moments.torque, np.asarray(unseen.vaf), np.nan)


def _limits(pipeline: Pipeline, weights: set[str]) -> TrustLimits:
    """Weights of neighbouring lags are uncertain one by one, and nobody asks for them one by one."""
    limits, model = pipeline.limits, pipeline.model
    if not weights or limits.parameters:
        return limits
    kept = [name for name, role in zip(model.names, model.roles, strict=True) if role.kind != "offset"]
    return replace(limits, parameters=tuple(name for name in kept if name not in weights))


def _apart(place: Placement) -> int:
    """Windows so far from each other share no rows."""
    if place.separate:
        return max(1, int(place.next_starts[0] // place.window))
    return -(-place.window // place.step)


def _noise_spectra(prepared: Prepared, left: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Of the noise that was estimated, by what the estimates leave (N, n) of the torque."""
    if not prepared.white:
        return ()
    row_rate = prepared.pipeline.sample_rate / prepared.pipeline.filters.decimate
    return (prepared.white[0].noise_spectrum(row_rate, left),)


@dataclass(frozen=True)
class _OfModel:
    """What the tests say of the model."""

    why: str
    """Why parameters that are judged cannot be trusted."""
    remedy: str
    lacking: dict[str, str]
    """Why each parameter cannot be trusted."""
    bands: Bands | None
    notes: tuple[str, str]

    @classmethod
    def of(
        cls, model: Model, solved: Solved, misfits: tuple[Misfit, ...], place: Placement, judged: Sequence[str]
    ) -> _OfModel:
        theta = np.asarray(solved.fit.theta)
        size = sizes(np.abs(np.nanmedian(theta, axis=0)), model.roles) if misfits else np.zeros(0)
        tests = (misfits, model.names, size, [role.kind for role in model.roles])
        off, bands = off_by(*tests), None
        why, remedy = missing(misfits, {name: share for name, share in off.items() if name in judged})
        if solved.ordinary is not None and misfits:
            apart = _apart(place)
            bands = compare_bands(np.asarray(solved.ordinary.theta)[::apart], theta[::apart])
        lacking = by_bands(bands, model.names, model.units)
        others = [text for name, text in lacking.items() if name in judged and name not in off]
        lacking |= {name: in_words(misfits, {name: share}) for name, share in off.items()}
        why = "; ".join(filter(None, [why, *others]))
        return cls(why, remedy, lacking, bands, (harmless(*tests), unnoticed(*tests)))


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


def _literal_note(pipeline: Pipeline) -> str:
    if pipeline.once:
        return ""
    dropped = pipeline.filter.drop_transient
    measured = "0.1 (the ends are left out)" if dropped else "2 (filter.drop_transient = true leaves the ends out)"
    return (
        "the filters ran inside every window, where position and torque do not pass the same filters near the ends: "
        f"the inertia is biased, on the simulated rig by {measured} standard deviations; filter.mode = 'once' is not"
    )


def _threshold(prepared: Prepared, place: Placement, method: int | None) -> tuple[float | None, str]:
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
    window = round(prepared.pipeline.window.length * rate * place.counted / place.window)
    return float(fake_change_threshold(np.asarray(W), len(q), window)), ""


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
