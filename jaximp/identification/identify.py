"""Recordings in memory: filtered, solved in all windows, judged.

`identify` and everything that runs it for many recordings share this module; it knows no files and no jobs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from jaximp.identification.as_robot import judged_as_robot
from jaximp.identification.estimates import Estimates, Reflex
from jaximp.identification.judging import judge
from jaximp.identification.misfit import find_human_misfits, find_misfits
from jaximp.identification.pipeline import Pipeline, ReferenceMotion
from jaximp.identification.points import Followed, follow, part_of
from jaximp.identification.prepared import Pair, Prepared, columns_by_joint, prepare, whitener, with_windows
from jaximp.identification.residuals import Residuals
from jaximp.identification.robot_changes import OTHER_METHODS, Doubts, Sameness
from jaximp.identification.rows import Rows
from jaximp.identification.separation import METHODS, Regression, Separation, robot_columns, separate
from jaximp.identification.solving import Placement, Solved, Task, moments, place_windows, solve_stack
from jaximp.identification.tip_pairs import TipPair, fit_tip, rest_note
from jaximp.identification.weighted import weighted_fit
from jaximp.identification.whitening import from_filtered, from_white
from jaximp.identification.whole import of_whole_recording
from jaximp.least_squares.sliding import score, sliding_least_squares
from jaximp.least_squares.window import SlidingFit
from jaximp.models.base import Joints, combine
from jaximp.models.chain import Chain
from jaximp.models.reflex import with_gain
from jaximp.trust.score_tests import Misfit
from jaximp.types import Progress, Recording, RobotAlone, nearest


def estimate(
    pipeline: Pipeline,
    recording: Recording | Sequence[Recording],
    alone: RobotAlone = None,
    progress: Progress = lambda share: None,
    held_out: Recording | None = None,
) -> list[Estimates]:
    """Identify a recording in all windows: one `Estimates` for each method (one where there is no pair).

    **Arguments:** `recording`, or several that count as one; `alone`, the recording of the robot without the human,
    where the pipeline has a robot; or two, one before and one after that with the human; `held_out`, one that the
    estimates are to predict.

    **Raises:** `ValueError` with one line that names the cause and the remedy.
    """
    prepared = prepare(pipeline, recording, alone, held_out)
    progress(0.3)
    return in_windows(prepared, lambda share: progress(0.3 + 0.7 * share))


def solve_windows(
    several: Sequence[Prepared], padded: int | None = None, stacked: int = 1, longest: float | None = None
) -> list[Prepared]:
    """All windows of recordings that were filtered alike, joint by joint, in one call each.

    **Arguments:** `padded` rows to which each is filled up, in a stack of so many; `longest` [s], where other lengths
    of up to so much follow: they will share the compiled code.
    """
    first, found = several[0], []
    padded = len(first.rows.time) if padded is None else padded
    for j, columns in enumerate(columns_by_joint(first.model)):
        tasks = [_task(one, one.rows if columns is None else one.rows.of_joint(*columns), j) for one in several]
        found.append(solve_stack(tasks, place_windows(first.pipeline, tasks[0].rows, longest), padded, stacked))
    return [replace(one, solved=solved) for one, solved in zip(several, zip(*found, strict=True), strict=True)]


def _task(prepared: Prepared, rows: Rows, j: int) -> Task:
    """What is to be solved of one joint."""
    if prepared.white:
        return Task(rows, white=prepared.white[j])
    return Task(rows, prepared.pipeline.filters.noise)


def in_windows(
    prepared: Prepared,
    progress: Progress = lambda share: None,
    longest: float | None = None,
    curves: bool = True,
) -> list[Estimates]:
    """Solve (where that is not done yet) and judge every window of a prepared recording, by every method; and see what
    they leave of the torque.

    **Arguments:** `longest` [s], where other lengths of up to so much follow: they will share the compiled code;
    `curves` whether the torques over time are wanted, which only figures need.
    """
    if not prepared.solved and prepared.stackable:
        prepared = solve_windows([prepared], longest=longest)[0]
    found = _in_windows(prepared, progress, longest, curves)
    of_path = prepared.pipeline.track is not None and prepared.held_out is None
    if prepared.pair is not None or not prepared.pipeline.once or of_path:
        return found
    if not curves and not isinstance(prepared.model, Chain):
        return found
    theta = of_whole_recording(prepared, found[0].value)
    if not curves:
        return [judged_as_robot(prepared, found[0], theta)]
    held_out = None if prepared.held_out is None else Residuals.of(prepared.held_out, theta)
    residuals = Residuals.of(prepared.rows, theta)
    return [judged_as_robot(prepared, replace(found[0], residuals=residuals, held_out=held_out), theta)]


def _in_windows(prepared: Prepared, progress: Progress, longest: float | None, curves: bool) -> list[Estimates]:
    """Of windows whose sums are solved, where they can be."""
    if isinstance(prepared.model, Joints):
        return [_joint_by_joint(prepared, prepared.model, progress, longest, curves)]
    rows = prepared.rows
    place = place_windows(prepared.pipeline, rows, longest)
    if prepared.solved:
        solved = prepared.solved[0]
        misfits, followed = _misfits(prepared, solved.fit), _followed(prepared, solved)
        return [judge(prepared, rows, solved, place, curves=curves, misfits=misfits, followed=followed)]
    if prepared.pair is not None:
        return _by_methods(prepared, prepared.pair, place, progress, curves)

    if prepared.weighted is not None:
        fit = weighted_fit(rows, prepared.weighted, place)
        misfits = _misfits(prepared, fit)
        return [judge(prepared, rows, _predict(rows, fit, place), place, curves=curves, misfits=misfits)]
    white, ordinary = prepared.white[0] if prepared.white else None, prepared.pipeline.ordinary
    solve = partial(sliding_least_squares, window=place.window, step=place.step, room=place.given_room)
    solve = partial(solve, valid=jnp.asarray(rows.valid), noise=None if white else prepared.noise)
    W, torque = (jnp.asarray(x) for x in ((white.W, white.torque) if white else (rows.W, rows.torque)))
    fit, beside = solve(W, torque), None
    gain = solve(with_gain(prepared.model, W), torque) if prepared.model.memory else None
    if white:
        as_filtered = solve(jnp.asarray(rows.W), rows.torque)
        if ordinary:
            if gain is not None:
                columns = with_gain(prepared.model, jnp.asarray(white.as_filtered))
                gain = from_filtered(gain, solve(columns, rows.torque), white, columns)
            fit, beside = from_filtered(fit, as_filtered, white), fit
        else:
            seen = score(
                rows.W, rows.torque, rows.valid, fit.theta, place.starts, place.window, place.step, place.given_room
            )
            fit, beside = from_white(fit, as_filtered, white, seen), as_filtered
            gain = None if gain is None else from_white(gain, as_filtered, replace(white, inflation=np.ones(1)))
    solved, misfits = _predict(rows, fit, place)._replace(beside=beside), _misfits(prepared, fit)
    followed = _followed(prepared, solved)
    return [judge(prepared, rows, solved, place, gain=gain, curves=curves, misfits=misfits, followed=followed)]


def _followed(prepared: Prepared, solved: Solved) -> Followed | None:
    """The path of the parameters of one model alone, where it is asked for."""
    settings, model = prepared.pipeline.track, prepared.model
    if settings is None:
        return None
    still = [name in settings.stays for name in model.names]
    found = follow(prepared.pipeline, prepared.white[0], prepared.rows.valid, model.names, model.units, still)
    return Followed(*found, np.asarray(solved.fit.stderr))


def _followed_by_method(prepared: Prepared, found: Separation) -> Followed | None:
    """The path of a human's parameters in a robot's recording, whose own stay as they are."""
    settings, model, white = prepared.pipeline.track, prepared.model, found.white
    if settings is None or white is None:
        return None
    names = [f"robot_{k}" for k in range(white.W.shape[-1])]
    for column, name in zip(found.human, model.names, strict=True):
        names[column] = name
    still = [name not in model.names or name in settings.stays for name in names]
    whole, mixed = follow(prepared.pipeline, white, found.valid, names, [""] * len(names), still)
    human = part_of(whole, found.human, model.names, model.units, np.asarray(found.shared))
    return Followed(human, mixed, np.asarray(found.own))


def _misfits(prepared: Prepared, fit: SlidingFit) -> tuple[Misfit, ...]:
    """What the model of one joint or of an arm lacks; nothing is known without white rows."""
    if not prepared.white:
        return ()
    usual = _usual(fit)
    if usual is None:
        return ()
    recording = prepared.recording if prepared.explained is None else prepared.explained
    own = None if prepared.drive is None else prepared.drive.own
    return find_misfits(prepared.pipeline, recording, prepared.rows, prepared.white[0], usual, own)


def _human_misfits(prepared: Prepared, pair: Pair, found: Separation, method: int) -> tuple[Misfit, ...]:
    """What the model of a human in a robot lacks by one of the methods, or the robot's, if that moves the human's."""
    usual = _usual(found.fit)
    if pair.tests is None or usual is None:
        return ()
    left = partial(robot_columns, method, alone=pair.alone, loaded=pair.loaded)
    return find_human_misfits(prepared.pipeline, prepared.recording, found, usual, left, pair.tests)


def _usual(fit: SlidingFit) -> NDArray[np.float64] | None:
    """(p,) median over the windows that are solved, if there are any."""
    theta = np.asarray(fit.theta)
    known = theta[np.isfinite(theta).all(axis=1)]
    return np.median(known, axis=0) if len(known) else None


def _by_methods(prepared: Prepared, pair: Pair, place: Placement, progress: Progress, curves: bool) -> list[Estimates]:
    """The human in the robot, by every method that is asked for."""
    if pair.tip is not None:
        return _by_methods_at_tip(prepared, pair, pair.tip, place, progress, curves)
    rows, methods = prepared.rows, prepared.pipeline.methods
    noise = None if prepared.pipeline.whitens else prepared.noise
    merge, same = combine(pair.robot, prepared.model).merge, robot_sameness(prepared, pair)
    follow = same is not None and same.differs
    results = []
    for count, method in enumerate(methods):

        def solve_pair(alone: Regression, loaded: Regression, method: int = method) -> Separation:
            given = (merge, place.window, place.step, noise, place.given_room, whitener(prepared.pipeline))
            return separate(method, pair.robot_fit, alone, loaded, *given, pair.change, follow)

        found, gain = solve_pair(pair.alone, pair.loaded), None
        if prepared.model.memory:
            alone, loaded = (replace(x, human=with_gain(prepared.model, x.human)) for x in (pair.alone, pair.loaded))
            gain = solve_pair(alone, loaded).fit
        n = len(found.torque)
        human = Rows(pair.loaded.human[:n], found.torque, rows.valid[:n], rows.time[:n])
        solved = _predict(human, found.fit, place)
        doubts = Doubts.of_method(prepared.model.names, found, same)
        told = (found.warning, pair.tests.note if pair.tests else "", *pair.notes, doubts.note)
        notes, own = (METHODS[method], *told), prepared
        if found.white is not None and rows.noisy is not None and not prepared.pipeline.ordinary:
            noisy = found.white.apply(rows.noisy[:n, len(pair.robot.names) :], rows.valid[:n])
            own = replace(prepared, column_noise=np.sqrt((noisy**2).mean(axis=0)))
        misfits = _human_misfits(prepared, pair, found, method)
        followed = _followed_by_method(prepared, found)
        judged = partial(judge, gain=gain, curves=curves, misfits=misfits, doubts=doubts, followed=followed)
        estimates = judged(own, human, solved, place, method, *notes)
        may_change = np.sqrt(np.diagonal(pair.change))
        of_robot = replace(estimates, robot=pair.robot_fit, robot_names=pair.robot.names, robot_change=may_change)
        results.append(replace(of_robot, method=method))
        progress((count + 1) / len(methods))
    return results


def _by_methods_at_tip(
    prepared: Prepared, pair: Pair, tip: TipPair, place: Placement, progress: Progress, curves: bool
) -> list[Estimates]:
    """The human at the end of the robot, by every method that is asked for. Errors hold those of the gains already."""
    rows, methods, model, results = prepared.rows, prepared.pipeline.methods, prepared.model, []
    own = replace(prepared, recording=replace(prepared.recording, gain_covariance=None))
    both = combine(pair.robot, model) if 2 in methods else None
    for count, method in enumerate(methods):
        found = fit_tip(method, tip, both, place)
        n = found.rows
        human = Rows(tip.loaded.human[:n], jnp.asarray(found.torque), rows.valid[:n], rows.time[:n])
        doubts = Doubts({model.names[k]: why for k, why in (found.doubts or {}).items()}, OTHER_METHODS)
        solved = _predict(human, found.fit, place)
        notes = [METHODS[method], found.note, rest_note(model, found.fit), *pair.notes]
        estimates = judge(own, human, solved, place, method, *notes, curves=curves, doubts=doubts)
        may_change = np.sqrt(np.diagonal(pair.change))
        of_robot = replace(estimates, robot=pair.robot_fit, robot_names=pair.robot.names, robot_change=may_change)
        results.append(replace(of_robot, method=method))
        progress((count + 1) / len(methods))
    return results


def robot_sameness(prepared: Prepared, pair: Pair) -> Sameness | None:
    """What the robot's own parameters say of a change between the recordings; nothing without white rows, or where the
    human holds the end of the robot."""
    whiten, loaded = whitener(prepared.pipeline), pair.loaded
    if whiten is None or pair.tip is not None:
        return None
    torque = loaded.torque - loaded.robot @ pair.robot_fit.theta
    white = whiten(loaded.human, torque, loaded.valid, loaded.robot)
    return Sameness.of(pair.robot, prepared.model, pair.robot_fit, pair.change, loaded, white)


def _joint_by_joint(
    prepared: Prepared, model: Joints, progress: Progress, longest: float | None, curves: bool
) -> Estimates:
    """Joints side by side share no parameter and no noise: each is solved and judged by itself."""
    for name in prepared.pipeline.limits.parameters:
        if name not in model.names:
            hint = nearest(name, list(model.names))
            raise ValueError(f"trust.parameters has an unknown parameter '{name}': {hint}")
    parts = []
    for place in filter(None, columns_by_joint(model)):
        one = _one_joint(prepared, model, *place)
        parts.append(in_windows(one, longest=longest, curves=curves)[0])
        progress(len(parts) / len(model.models))
    return replace(_side_by_side(model, parts), limits=prepared.pipeline.limits)


def _one_joint(prepared: Prepared, model: Joints, j: int, columns: slice) -> Prepared:
    """The share of one joint in a prepared recording of several."""
    recording, pipeline, this = prepared.recording, prepared.pipeline, slice(j, j + 1)
    tag = f"joint{j + 1}."
    chosen = tuple(name.removeprefix(tag) for name in pipeline.limits.parameters if name.startswith(tag))
    track = pipeline.track
    if track is not None:
        track = replace(track, stays=tuple(name.removeprefix(tag) for name in track.stays if name.startswith(tag)))
    return replace(
        prepared,
        recording=recording.of_joint(j),
        pipeline=replace(
            pipeline, model=model.models[j], limits=pipeline.limits.of_joint(j, parameters=chosen), track=track
        ),
        rows=prepared.rows.of_joint(j, columns),
        column_noise=prepared.column_noise[columns],
        reference=_of_joint(prepared.reference, this),
        white=prepared.white[this],
        solved=prepared.solved[this],
        drives=prepared.drives[this],
        explained=None if prepared.explained is None else prepared.explained.of_joint(j),
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
        changed={f"joint{j + 1}.{name}": when for j, part in enumerate(parts) for name, when in part.changed.items()},
        steady=tuple(f"joint{j + 1}.{name}" for j, part in enumerate(parts) for name in part.steady),
        held_out_vaf=np.min([part.held_out_vaf for part in parts], axis=0),
        measured=tuple(windows for part in parts for windows in part.measured),
        threshold=max(thresholds, default=None),
        torque=np.concatenate([part.torque for part in parts], axis=1),
        reconstructed=np.concatenate([part.reconstructed for part in parts], axis=1),
        predicted=np.concatenate([part.predicted for part in parts], axis=1),
        notes=tuple(_notes_side_by_side(parts)),
        reflexes=tuple(_reflexes_side_by_side(parts)),
        tracks=tuple(one for part in parts for one in part.tracks),
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


OTHER_LENGTHS = (0.5, 2.0)
"""Times its own that a window is made, so that the choice of a length can be seen."""


def longest_of(prepared: Prepared) -> float | None:
    """The longest of these windows [s]; none where a window is the whole recording, or a path needs none."""
    pipeline = prepared.pipeline
    return None if _is_whole(prepared) or pipeline.track is not None else max(OTHER_LENGTHS) * pipeline.window.length


def _is_whole(prepared: Prepared) -> bool:
    return prepared.pipeline.window_samples == len(prepared.recording)


def at_other_lengths(
    prepared: Prepared,
    alone: RobotAlone = None,
    factors: tuple[float, ...] = OTHER_LENGTHS,
    progress: Progress = lambda share: None,
) -> list[Estimates]:
    """The same data with shorter and longer windows, by the first method, so that the choice of a length can be seen.

    Lengths that the recording or the filters do not allow are left out; a window that is the whole recording has none,
    nor has a path.
    """
    length = prepared.pipeline.window.length
    if longest_of(prepared) is None:
        return []

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


def _predict(rows: Rows, fit: SlidingFit, place: Placement) -> Solved:
    """Hold every window's parameters against the window behind it."""
    ahead = place.next_starts[: len(fit.last)]
    valid = jnp.asarray(rows.valid)
    unseen = score(rows.W, rows.torque, valid, fit.theta, ahead, place.window, place.step, place.given_room)
    return Solved(fit, unseen, moments(*(np.asarray(x) for x in (rows.W, rows.torque, rows.valid))))
