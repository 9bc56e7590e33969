"""Where windows lie in the rows of a recording, and all windows of a stack of recordings in one compiled call.

One recording is a stack of one: what it gets does not depend on the others, to the last bit, nor on how far its rows
are padded or on the room for longer windows, to rounding.
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
from jaximp.identification.regression import Rows, first_call, on_every_device
from jaximp.least_squares.chunks import LONGEST_REACH, Task, finish
from jaximp.least_squares.engine import BLOCK, FEWEST_LANES, ChunkFit, Plan, solve_chunk
from jaximp.least_squares.sliding import Score, score, sliding_least_squares, window_starts
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


class Layout(NamedTuple):
    """What the compiled program depends on, beside the shape of the rows."""

    plan: Plan | None
    """How windows are solved by sums that they share; None where the noise does not allow that."""
    window: int
    """Rows of a window; zero where they are an argument, so that lengths share the program."""
    step: int
    lags: int
    """Lags of the noise's autocovariance, zero for white noise."""


def make_layout(rows: int, outputs: int, place: Placement, lags: int) -> Layout:
    """The program for so many padded rows, and windows of up to `place.room` rows."""
    window, step = place.window * outputs, place.step * outputs
    lags = -(-lags // LAGS_GRAIN) * LAGS_GRAIN
    reach = (lags - 1) * outputs
    if lags and (reach > LONGEST_REACH or 2 * reach > window):
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
    window: AnyArray


def solve_stack(
    several: Sequence[Rows],
    noise: Sequence[NDArray[np.float64] | None],
    place: Placement,
    padded: int,
    stacked: int,
) -> list[Solved]:
    """All windows of recordings whose windows have the same numbers of rows.

    **Arguments:** `noise` of each, by lag in rows; `place` of the first, whose window, step and room are those of all;
    `padded` rows to which each is filled up; a stack that is not full is filled with copies of the first.
    """
    for rows in several:
        check_finite(rows.W, rows.torque, rows.valid)
    first = several[0]
    lags = 0 if noise[0] is None else max(len(x) for x in noise if x is not None)
    outputs = int(np.prod(first.torque.shape[1:]))
    layout = make_layout(padded, outputs, place, lags)
    stack = _stacked(several, noise, place, layout, padded, stacked)
    with first_call("solve", layout, *(x.shape for x in jax.tree.leaves(stack))):
        found = jax.tree.map(np.asarray, _program(layout, stack))
    return [
        _finished(rows, own, jax.tree.map(lambda x, k=k: x[k], found), place, layout)
        for k, (rows, own) in enumerate(zip(several, noise, strict=True))
    ]


def _stacked(
    several: Sequence[Rows],
    noise: Sequence[NDArray[np.float64] | None],
    place: Placement,
    layout: Layout,
    padded: int,
    stacked: int,
) -> _Stack:
    def together(arrays: Sequence[AnyArray], size: int) -> AnyArray:
        whole = np.zeros((stacked, size, *arrays[0].shape[1:]), arrays[0].dtype)
        for k, array in enumerate(arrays):
            whole[k, : len(array)] = array
        whole[len(arrays) :] = whole[0]
        return whole

    lags = [np.asarray(one) for one in noise if one is not None]
    return _Stack(
        W=together([rows.W for rows in several], padded),
        y=together([rows.torque for rows in several], padded),
        valid=together([rows.valid for rows in several], padded),
        noise=together(lags, layout.lags) if lags else None,
        window=np.full(stacked, place.window),
    )


@partial(compiled, static_argnums=0)
def _program(layout: Layout, stack: _Stack) -> Any:
    """Fits and predictions of all windows and moments of all rows, one recording after another."""

    def solve(one: _Stack) -> Any:
        return *_solved(layout, one), moments(one.W, one.y, one.valid)

    return on_every_device(partial(lax.map, solve), stack, len(stack.window))


def _solved(layout: Layout, one: _Stack) -> tuple[Any, Score]:
    """Fits of all windows of one recording, and how they predict."""
    W, y, valid, plan = one.W, one.y, one.valid, layout.plan
    if plan is None:
        fit = sliding_least_squares(W, y, layout.window, layout.step, valid=valid, noise=one.noise)
        starts = window_starts(len(W), layout.window, layout.step)
        return fit, score(W, y, valid, fit.theta, starts + layout.window, layout.window, layout.step)
    columns, scale = _columns(plan, W, y, valid)
    window = one.window if layout.window == 0 else layout.window
    found = solve_chunk(plan, columns, scale, window * plan.outputs, one.noise, window // layout.step)
    if found.unseen is not None:
        vaf, samples, variance = found.unseen
        vaf = jnp.where(samples >= 0.5 * window * plan.outputs, vaf, jnp.nan)
        return found._replace(unseen=None), Score(vaf, jnp.full_like(vaf, jnp.nan), samples.astype(int), variance)
    starts = np.arange(plan.windows) * layout.step
    return found, score(W, y, valid, found.theta, starts + layout.window, layout.window, layout.step)


def _columns(plan: Plan, W: AnyArray, y: AnyArray, valid: AnyArray) -> tuple[Any, Any]:
    """Rows as `engine` takes them, filled up with nothing."""
    xp: Any = np if isinstance(W, np.ndarray) else jnp
    W, y, scale = W.reshape(-1, W.shape[-1]), y.ravel(), valid.ravel()
    columns = xp.where(scale, xp.concatenate([W.T, y[None]]), 0)
    behind = max(0, plan.rows - len(y))
    return xp.pad(columns, ((0, 0), (0, behind)))[:, : plan.rows], xp.pad(scale, (0, behind))[: plan.rows]


def _finished(rows: Rows, noise: AnyArray | None, found: Any, place: Placement, layout: Layout) -> Solved:
    """What the program found in the windows of one recording; a doubtful window is decomposed."""
    starts = window_starts(len(rows.time), place.window, place.step)
    fit, unseen = jax.tree.map(lambda x: x[: len(starts)], found[:2])
    doubtful = np.zeros(0, int)
    if isinstance(fit, ChunkFit):
        assert layout.plan is not None
        lags = None if noise is None else np.pad(noise, (0, layout.lags - len(noise)))
        doubtful = np.flatnonzero(fit.doubtful)
        columns = partial(_columns, layout.plan, rows.W, rows.torque, rows.valid)
        fit = finish(fit, Task(layout.plan, place.window * layout.plan.outputs, lags), columns)
    complete = starts + 2 * place.window <= len(rows.time)
    vaf = np.where(complete & np.isfinite(fit.theta).all(axis=1), unseen.vaf, np.nan)
    for k in doubtful[np.isfinite(vaf[doubtful])]:
        vaf[k] = _predicted(rows, fit.theta[k], int(starts[k]) + place.window, place.window)
    return Solved(fit, eqx.tree_at(lambda score: score.vaf, unseen, vaf), found[2])


def _predicted(rows: Rows, theta: NDArray[np.float64], start: int, window: int) -> float:
    """Variance of the torque in a window that these parameters account for."""
    behind = slice(start, start + window)
    W, y, valid = (x[behind] for x in (rows.W, rows.torque, rows.valid))
    residual = y - W @ theta
    return float(variance_accounted_for(y, residual, valid.astype(float)))


def stack_size(padded: int, count: int) -> int:
    """How many of `count` recordings of so many samples are stacked: a power of two; empty places and calls cost."""
    most = max(1, min(MOST_IN_STACK, STACKED_SAMPLES // padded)).bit_length()
    return min((1 << k for k in range(most)), key=lambda size: -(-count // size) * (size + CALL))
