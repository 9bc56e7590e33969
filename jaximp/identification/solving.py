"""Where windows lie in the rows of a recording, and all windows of a stack of recordings in one compiled call.

One recording is a stack of one: what it gets does not depend on the others, to the last bit, nor on how far its rows
are padded or on the room for longer windows, to rounding. The arithmetic is `least_squares.engine.solve_chunk`, and
`estimates_of` in `least_squares.fits`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array
from numpy.typing import NDArray

from jaximp.identification.literal import rows_away_from_ends
from jaximp.identification.pipeline import Pipeline
from jaximp.identification.rows import Rows, first_call, on_every_device
from jaximp.identification.whitening import White, from_filtered, from_white
from jaximp.least_squares.chunks import LONGEST_REACH, finish
from jaximp.least_squares.chunks import Task as ChunkTask
from jaximp.least_squares.engine import solve_chunk
from jaximp.least_squares.fits import ChunkFit
from jaximp.least_squares.sliding import Score, score, sliding_least_squares, window_starts
from jaximp.least_squares.sums import BLOCK, FEWEST_LANES, Plan
from jaximp.least_squares.window import SlidingFit, check_finite, variance_accounted_for
from jaximp.numerics.compilation import compiled
from jaximp.types import AnyArray

MOST_ROWS = 400_000
"""Rows of a recording that goes through in one piece; longer ones are cut into chunks."""
STACKED_SAMPLES = 400_000
"""Samples of a stack, padded ones too: its filtered columns take some hundred times as many bytes."""
MOST_IN_STACK = 128
"""Recordings."""
MOST_EMPTY = 4
"""So many times the rows that there are, sums that windows share may look at."""
CALL = 4
"""What a call of a program costs, in recordings."""
MOST_UNROLLED = 16
"""Parameters up to which windows are solved by sums that they share: those are written out term by term, so that
compiling takes ever longer. Each window of a larger model is decomposed by itself."""
LAGS_GRAIN = 16
"""Lags of the noise's autocovariance are filled up with zeros to a multiple: rates that are alike share a program."""


@dataclass(frozen=True)
class Placement:
    """Where windows lie in the rows: sliding over shared rows, or one block of rows after another."""

    window: int
    """Rows in a window."""
    step: int
    """Rows from one window to the next."""
    counted: int
    """Rows of a complete window that count."""
    room: int
    """Rows that the compiled code is to have room for, see `sliding_least_squares`."""
    lengths: bool
    """Whether windows of other lengths follow, which are to share the compiled code."""
    starts: NDArray[np.int64]
    """(M,) first row of each window."""
    next_starts: NDArray[np.int64]
    """(M,) first row of the window that follows without overlap."""
    separate: bool

    @property
    def given_room(self) -> int | None:
        """`room`, where other lengths are to share the compiled code."""
        return self.room if self.lengths else None


def place_windows(pipeline: Pipeline, rows: Rows, longest: float | None = None) -> Placement:
    """Find the windows in the rows of a recording.

    **Arguments:** `longest` [s], where other lengths of up to so much follow: they will share the compiled code.
    """
    filters, n_rows = pipeline.filters, len(rows.time)
    if not pipeline.once:
        samples = pipeline.window_samples
        block = len(range(0, samples, filters.decimate))
        starts = np.arange(0, n_rows, block)
        ahead = -(-samples // pipeline.step_samples)
        counted = int(rows_away_from_ends(samples, filters, pipeline.filter).sum())
        return Placement(block, block, counted, block, False, starts, starts + ahead * block, separate=True)
    window, step, outputs = pipeline.window_rows, pipeline.step_rows, int(np.prod(rows.torque.shape[1:]))
    if window * outputs < rows.W.shape[-1]:
        raise ValueError(
            f"a window of {pipeline.window.length:g} s keeps {window} samples of each joint after decimation by "
            f"{filters.decimate}, which cannot determine {rows.W.shape[-1]} parameters: lengthen window.length"
        )
    room = max(window, round((longest or 0.0) * pipeline.sample_rate / filters.decimate))
    starts = window_starts(n_rows, window, step)
    return Placement(window, step, window, room, longest is not None, starts, starts + window, separate=False)


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
    """What is found in the windows of one recording before it is judged."""

    fit: SlidingFit
    unseen: Score
    """How well each window's parameters predict the torque of the window behind it."""
    moments: Moments
    beside: SlidingFit | None = None
    """Ordinary least squares beside estimates from white rows; or those from white rows, where `fit` is ordinary."""


class Layout(NamedTuple):
    """What the compiled program depends on, beside the shape of the rows."""

    plan: Plan | None
    """How windows are solved by sums that they share; None where the noise does not allow that."""
    window: int
    """Rows of a window; zero where they are an argument, so that lengths share the program."""
    step: int
    lags: int
    """Lags of the noise's autocovariance, zero for white noise."""
    ordinary: bool = False
    """Whether the rows as they were filtered are held against others, and not the white ones."""


def make_layout(rows: int, outputs: int, place: Placement, lags: int, parameters: int = 0) -> Layout:
    """The program for so many padded rows, and windows of up to `place.room` rows."""
    window, step = place.window * outputs, place.step * outputs
    lags = -(-lags // LAGS_GRAIN) * LAGS_GRAIN
    reach = (lags - 1) * outputs
    if parameters > MOST_UNROLLED or (lags and (reach > LONGEST_REACH or 2 * reach > window)):
        return Layout(None, place.window, place.step, lags)
    per_block = max(1, min(BLOCK // step, window // step))
    shortest = 1 if place.lengths else place.window
    lanes = max(FEWEST_LANES, -(-len(window_starts(rows, shortest, place.step)) // per_block))
    room = -(-place.room * outputs // (step * per_block))
    predicts = place.window % place.step == 0
    plan = Plan(step, per_block, lanes, room, outputs, True, False, lags, predicts)
    if plan.rows > MOST_EMPTY * rows * outputs:  # few windows, far apart: each by itself is cheaper
        return Layout(None, place.window, place.step, lags)
    return Layout(plan, 0 if predicts and place.lengths else place.window, place.step, lags)


class _Stack(eqx.Module):
    """Rows of a stack; axis 0 counts the recordings."""

    W: AnyArray
    y: AnyArray
    valid: AnyArray
    noise: AnyArray | None
    white: tuple[AnyArray, AnyArray] | None
    """Columns and torque in rows whose noise is white."""
    window: AnyArray


@dataclass(frozen=True)
class Task:
    """What is to be solved of one recording."""

    rows: Rows
    noise: NDArray[np.float64] | None = None
    """Its autocovariance by lag in rows; None for noise that is white."""
    white: White | None = None
    """The rows that estimates come from, where they are others."""


def solve_stack(several: Sequence[Task], place: Placement, padded: int, stacked: int) -> list[Solved]:
    """All windows of recordings whose windows have the same numbers of rows.

    **Arguments:** `place` of the first, whose window, step and room are those of all; `padded` rows to which each is
    filled up; a stack that is not full is filled with copies of the first.
    """
    for one in several:
        check_finite(one.rows.W, one.rows.torque, one.rows.valid)
    first = several[0]
    lags = max((0 if one.noise is None else len(one.noise)) for one in several)
    outputs = int(np.prod(first.rows.torque.shape[1:]))
    layout = make_layout(padded, outputs, place, lags, first.rows.W.shape[-1])._replace(ordinary=_ordinary(first.white))
    stack = _stacked(several, place, layout, padded, stacked)
    with first_call("solve", layout, *(x.shape for x in jax.tree.leaves(stack))):
        found = jax.tree.map(np.asarray, _program(layout, stack))
    return [_finished(one, jax.tree.map(lambda x, k=k: x[k], found), place, layout) for k, one in enumerate(several)]


def _ordinary(white: White | None) -> bool:
    return white is not None and white.as_filtered is not None


def _stacked(several: Sequence[Task], place: Placement, layout: Layout, padded: int, stacked: int) -> _Stack:
    def together(arrays: Sequence[AnyArray], size: int) -> AnyArray:
        whole = np.zeros((stacked, size, *arrays[0].shape[1:]), arrays[0].dtype)
        for k, array in enumerate(arrays):
            whole[k, : len(array)] = array
        whole[len(arrays) :] = whole[0]
        return whole

    lags = [np.asarray(one.noise) for one in several if one.noise is not None]
    white = [(one.white.W, one.white.torque) for one in several if one.white is not None]
    return _Stack(
        W=together([one.rows.W for one in several], padded),
        y=together([one.rows.torque for one in several], padded),
        valid=together([one.rows.valid for one in several], padded),
        noise=together(lags, layout.lags) if lags else None,
        white=(together([W for W, _ in white], padded), together([y for _, y in white], padded)) if white else None,
        window=np.full(stacked, place.window),
    )


@partial(compiled, static_argnums=0)
def _program(layout: Layout, stack: _Stack) -> Any:
    """Fits and predictions of all windows and moments of all rows, one recording after another."""

    def solve(one: _Stack) -> Any:
        return (*_solved(layout, one), moments(one.W, one.y, one.valid))

    return on_every_device(partial(lax.map, solve), stack, len(stack.window))


def _solved(layout: Layout, one: _Stack) -> tuple[Any, Score, Any]:
    """Fits of all windows of one recording, how they predict, and with white rows ordinary fits and `Held`; or
    ordinary fits, how they predict, and those of white rows."""
    W, y, valid, plan = one.W, one.y, one.valid, layout.plan
    if plan is None:
        return _solved_one_by_one(layout, one)
    window = one.window if layout.window == 0 else layout.window
    rows, ahead = window * plan.outputs, window // layout.step
    if one.white is None:
        found = solve_chunk(plan, *_columns(plan, W, y, valid), rows, one.noise, ahead)
        unseen, beside = found.unseen, None
    elif layout.ordinary:
        found = solve_chunk(plan, *_columns(plan, W, y, valid), rows, None, ahead)
        unseen, beside = (
            found.unseen,
            solve_chunk(plan._replace(predicts=False), *_columns(plan, *one.white, valid), rows),
        )
    else:
        found = solve_chunk(plan._replace(predicts=False), *_columns(plan, *one.white, valid), rows)
        predicting = plan._replace(predicts=True)
        ordinary = solve_chunk(predicting, *_columns(plan, W, y, valid), rows, None, ahead, found.theta)
        unseen, beside = ordinary.unseen, ordinary._replace(unseen=None)
    if plan.predicts:
        assert unseen is not None
        vaf = jnp.where(unseen.samples >= 0.5 * rows, unseen.vaf, jnp.nan)
        nothing = jnp.full_like(vaf, jnp.nan)
        return found._replace(unseen=None), Score(vaf, nothing, unseen.samples.astype(int), unseen.variance), beside
    starts = np.arange(plan.windows) * layout.step
    return found, score(W, y, valid, found.theta, starts + layout.window, layout.window, layout.step), beside


def _solved_one_by_one(layout: Layout, one: _Stack) -> tuple[Any, Score, Any]:
    """The same without sums that windows share."""
    W, y, valid = one.W, one.y, one.valid
    slide = partial(sliding_least_squares, window=layout.window, step=layout.step, valid=valid)
    plain = slide(W, y, noise=one.noise)
    fit = plain if one.white is None or layout.ordinary else slide(*one.white)
    starts = window_starts(len(W), layout.window, layout.step)
    hold = partial(score, W, y, valid, fit.theta, window=layout.window, step=layout.step)
    beside: Any = None
    if one.white is not None:
        beside = slide(*one.white) if layout.ordinary else (plain, hold(start=starts))
    return fit, hold(start=starts + layout.window), beside


def _columns(plan: Plan, W: AnyArray, y: AnyArray, valid: AnyArray) -> tuple[Any, Any]:
    """Rows as `engine` takes them, filled up with nothing."""
    xp: Any = np if isinstance(W, np.ndarray) else jnp
    W, y, scale = W.reshape(-1, W.shape[-1]), y.ravel(), valid.ravel()
    columns = xp.where(scale, xp.concatenate([W.T, y[None]]), 0)
    behind = max(0, plan.rows - len(y))
    return xp.pad(columns, ((0, 0), (0, behind)))[:, : plan.rows], xp.pad(scale, (0, behind))[: plan.rows]


def _finished(task: Task, found: Any, place: Placement, layout: Layout) -> Solved:
    """What the program found in the windows of one recording; a doubtful window is decomposed."""
    rows, white = task.rows, task.white
    starts = window_starts(len(rows.time), place.window, place.step)
    fit, unseen, beside = jax.tree.map(lambda x: x[: len(starts)], found[:3])
    noise = None if task.noise is None else np.pad(task.noise, (0, layout.lags - len(task.noise)))
    doubtful = np.flatnonzero(fit.doubtful) if isinstance(fit, ChunkFit) else np.zeros(0, int)
    if white is None:
        fit, beside = _repaired(fit, layout, place, noise, rows.W, rows.torque, rows.valid), None
    elif layout.ordinary:
        beside = _repaired(beside, layout, place, None, white.W, white.torque, rows.valid)
        ordinary = _repaired(fit, layout, place, None, rows.W, rows.torque, rows.valid)
        fit = from_filtered(beside, ordinary, white)
    else:
        ordinary, seen = _apart(beside)
        ordinary = _repaired(ordinary, layout, place, None, rows.W, rows.torque, rows.valid)
        fit = _repaired(fit, layout, place, None, white.W, white.torque, rows.valid)
        for k in doubtful[np.isfinite(fit.theta[doubtful]).all(axis=1)]:
            seen.vaf[k], seen.residual_rms[k] = _predicted(rows, fit.theta[k], int(starts[k]), place.window)
        fit, beside = from_white(fit, ordinary, white, seen), ordinary
    complete = starts + 2 * place.window <= len(rows.time)
    vaf = np.where(complete & np.isfinite(fit.theta).all(axis=1), unseen.vaf, np.nan)
    for k in doubtful[np.isfinite(vaf[doubtful])]:
        vaf[k] = _predicted(rows, fit.theta[k], int(starts[k]) + place.window, place.window)[0]
    return Solved(fit, eqx.tree_at(lambda score: score.vaf, unseen, vaf), found[3], beside)


def _apart(beside: Any) -> tuple[Any, Score]:
    """Ordinary fits, and how the others explain the windows that they were found in."""
    if not isinstance(beside, ChunkFit):
        return beside[0], Score(*(np.array(x) for x in jax.tree.leaves(beside[1])))
    held = beside.seen
    assert held is not None
    rms = np.sqrt(np.asarray(held.mean_square))
    return beside._replace(seen=None), Score(np.array(held.vaf), rms, np.array(held.samples, int), held.variance)


def _repaired(
    fit: Any, layout: Layout, place: Placement, noise: AnyArray | None, W: AnyArray, y: AnyArray, valid: AnyArray
) -> SlidingFit:
    """With a decomposition of the windows in doubt."""
    if not isinstance(fit, ChunkFit):
        return fit
    assert layout.plan is not None
    task = ChunkTask(layout.plan, place.window * layout.plan.outputs, noise)
    return finish(fit, task, partial(_columns, layout.plan, W, y, valid))


def _predicted(rows: Rows, theta: NDArray[np.float64], start: int, window: int) -> tuple[float, float]:
    """Variance of the torque in a window that these parameters account for, and the root of the mean squared rest."""
    behind = slice(start, start + window)
    W, y, valid = (np.asarray(x[behind]) for x in (rows.W, rows.torque, rows.valid))
    residual = np.where(valid, y - W @ theta, 0)
    explained = float(variance_accounted_for(y, residual, valid.astype(float)))
    return explained, float(np.sqrt((residual**2).sum() / max(valid.sum(), 1)))


def stack_size(padded: int, count: int) -> int:
    """How many of `count` recordings of so many samples are stacked: a power of two; empty places and calls cost."""
    most = max(1, min(MOST_IN_STACK, STACKED_SAMPLES // padded)).bit_length()
    return min((1 << k for k in range(most)), key=lambda size: -(-count // size) * (size + CALL))
