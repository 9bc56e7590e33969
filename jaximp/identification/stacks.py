"""Many recordings in one compiled call: stacked, padded to one length, filtered, solved.

What comes out is what `identify.prepare` and the solver behind `identify.in_windows` make of each of them alone, to
rounding; from there on (`in_windows`) it is the same code. The compiled program depends on the padded length and on
the windows in rows alone: filters, sample rates and the noise's autocovariance are arrays.

The filters run over all recordings of a stack side by side, for a step of a filter is far too little work by itself;
then one recording after another is solved, whose numbers stay in the cache.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from threading import Lock
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array
from numpy.typing import NDArray

from jaximp import signals
from jaximp.identification.identify import Prepared, Solved, checked_models, moments, reference_motion
from jaximp.identification.regression import (
    Filters,
    Motion,
    Rows,
    columns_of,
    measured_motion,
    rows_of,
    step_seconds,
    undisturbed,
    with_noise,
    without_jumps,
)
from jaximp.jobs.job import Job
from jaximp.least_squares.chunks import LONGEST_REACH, Task, finish
from jaximp.least_squares.engine import BLOCK, FEWEST_LANES, ChunkFit, Plan, solve_chunk
from jaximp.least_squares.sliding import Score, score, sliding_least_squares, window_starts
from jaximp.least_squares.window import variance_accounted_for
from jaximp.models import Joints, Model
from jaximp.numerics.compilation import compiled
from jaximp.types import AnyArray, Recording

STACKED_SAMPLES = 400_000
"""Samples of a stack, padded ones too: its filtered columns take some hundred times as many bytes."""
MOST_IN_STACK = 128
CALL = 4
"""What a call of a program costs, in recordings."""
LAGS_GRAIN = 16
"""Lags of the noise's autocovariance are filled up with zeros to a multiple: rates that are alike share a program."""


def stackable(job: Job) -> str:
    """Why the recordings of a job have to be identified one by one, or nothing."""
    if job.filter.mode == "window":
        return "filter.mode = 'window' filters inside every window"
    if job.model.robot is not None and job.model.human is not None:
        return "a human in a robot needs two recordings at a time"
    if job.model.human is not None and job.model.human.reflex:
        return "a reflex remembers the past, and its gain is a fit of its own"
    return ""


def stack_size(padded: int, count: int) -> int:
    """How many of `count` recordings of so many samples are stacked: a power of two; empty places and calls cost."""
    most = max(1, min(MOST_IN_STACK, STACKED_SAMPLES // padded)).bit_length()
    return min((1 << k for k in range(most)), key=lambda size: -(-count // size) * (size + CALL))


class Layout(NamedTuple):
    """What a compiled program depends on, beside the model."""

    padded: int
    """Samples."""
    stacked: int
    """Recordings."""
    decimate: int
    window: int
    """Rows of a window, and from one to the next."""
    step: int
    lags: int
    """Lags of the noise's autocovariance, zero for white noise."""

    @property
    def rows(self) -> int:
        return -(-self.padded // self.decimate)


@dataclass(frozen=True)
class Measured:
    """One recording before it is stacked: what is worked out on the host."""

    recording: Recording
    model: Model
    filters: Filters
    motion: Motion
    noisy: Motion
    jumps: NDArray[np.bool_]
    clean: NDArray[np.bool_]
    reference: Any

    def layout(self, job: Job, padded: int, stacked: int) -> Layout:
        """The program that solves it, padded to so many samples in a stack of so many recordings."""
        rate, n = self.recording.sample_rate, self.filters.decimate
        window = round(job.window.length * rate / n)
        step = max(1, round(step_seconds(job) * rate / n))
        noise = self.filters.noise
        lags = 0 if noise is None else -(-len(noise) // LAGS_GRAIN) * LAGS_GRAIN
        return Layout(padded, stacked, n, window, step, lags)


def measure(job: Job, recording: Recording) -> Measured:
    """Check a recording and look for its gaps, jumps and noise.

    **Raises:** `ValueError` as `identify.prepare`.
    """
    robot, human, filters = checked_models(job, recording)
    model = robot if human is None else human
    assert model is not None
    for sos in (filters.position, filters.parallel):
        if sos is not None:
            signals.check_long_enough(sos, len(recording))
    motion = measured_motion(job.filter, recording)
    levels = [signals.noise_level(q) for q in motion.position.T]
    known = levels if motion.position is recording.position else [None] * len(levels)
    jumps = np.any([signals.jumps(q, level) for q, level in zip(recording.position.T, known, strict=True)], axis=0)
    clean = undisturbed(recording, filters, jumps=jumps)
    noisy = with_noise(motion, levels)
    return Measured(recording, model, filters, motion, noisy, jumps, clean, reference_motion(job, recording))


class _Stack(eqx.Module):
    """The arrays of a stack; axis 0 counts the recordings."""

    motion: tuple[Any, ...]
    noisy: tuple[Any, ...]
    clean: AnyArray
    samples: AnyArray
    sample_rate: AnyArray
    position: signals.PaddedFilter | None
    parallel: signals.PaddedFilter | None
    noise: AnyArray | None
    min_velocity: AnyArray


class _Found(eqx.Module):
    """What a program finds."""

    W: AnyArray
    y: AnyArray
    moving: AnyArray
    column_noise: AnyArray
    solved: tuple[Any, ...]
    """For each joint (of joints side by side) the fits and predictions of all windows, and the moments of all rows."""


def solve_stack(job: Job, several: Sequence[Measured], layout: Layout) -> list[Prepared | ValueError]:
    """Filter and solve recordings of one layout; a stack that is not full is filled with copies of the first.

    **Returns:** for each what `identify.in_windows` judges, or why nothing is left of it.
    """
    filled = [*several, *[several[0]] * (layout.stacked - len(several))]
    stack, model = _stacked(job, filled, layout), several[0].model
    with _first_call(layout, model):
        found = jax.tree.map(np.asarray, _program(layout, model, stack))
    results: list[Prepared | ValueError] = []
    for k, one in enumerate(several):
        try:
            results.append(_prepared(one, jax.tree.map(lambda x, k=k: x[k], found), layout))
        except ValueError as error:
            results.append(error)
    return results


_lock, _known = Lock(), set[Any]()


@contextmanager
def _first_call(*program: Any) -> Iterator[None]:
    """A program is compiled once, however many threads need it at the same time."""
    if program in _known:
        yield
        return
    with _lock:
        yield
        _known.add(program)


def _stacked(job: Job, several: Sequence[Measured], layout: Layout) -> _Stack:
    def padded(arrays: Sequence[AnyArray | None]) -> AnyArray | None:
        if arrays[0] is None:
            return None
        whole = np.zeros((len(arrays), layout.padded, *arrays[0].shape[1:]), arrays[0].dtype)
        for k, array in enumerate(arrays):
            assert array is not None
            whole[k, : len(array)] = array
        return whole

    def filters(which: str) -> Any:
        sos = [getattr(one.filters, which) for one in several]
        return None if sos[0] is None else jax.tree.map(lambda *x: np.stack(x), *map(signals.padded_filter, sos))

    noise = None
    if layout.lags:
        lags = [np.asarray(one.filters.noise) for one in several]
        noise = np.stack([np.pad(x, (0, layout.lags - len(x))) for x in lags])
    return _Stack(
        motion=tuple(padded(x) for x in zip(*(one.motion for one in several), strict=True)),
        noisy=tuple(padded(x) for x in zip(*(one.noisy for one in several), strict=True)),
        clean=padded([one.clean for one in several]),
        samples=np.array([len(one.recording) for one in several]),
        sample_rate=np.array([one.recording.sample_rate for one in several]),
        position=filters("position"),
        parallel=filters("parallel"),
        noise=noise,
        min_velocity=np.full(len(several), job.window.min_velocity),
    )


@partial(compiled, static_argnums=(0, 1))
def _program(layout: Layout, model: Model, stack: _Stack) -> _Found:
    """Everything of a stack that is not judged; the recordings are shared out to the devices of this host."""
    count = math.gcd(layout.stacked, jax.local_device_count())
    if count == 1:
        return _on_device(layout, model, stack)
    mesh, share = Mesh(np.array(jax.local_devices()[:count]), ("recordings",)), PartitionSpec("recordings")
    solve = partial(_on_device, layout, model)
    found: _Found = jax.shard_map(solve, mesh=mesh, in_specs=share, out_specs=share, check_vma=False)(stack)
    return found


def _on_device(layout: Layout, model: Model, stack: _Stack) -> _Found:
    """Of the share of one device: one after another, so that a recording's numbers stay at hand."""

    def solve(one: _Stack) -> _Found:
        W, y, moving, column_noise = _filtered(layout, model, one)
        valid = one.clean[:: layout.decimate]
        valid = valid[:, None] & moving if moving.ndim == 2 else valid & moving
        results, first = [], 0
        for j, part in enumerate(model.models if isinstance(model, Joints) else (model,)):
            columns = slice(first, first + len(part.names))
            own = (W[:, j, columns], y[:, j], valid[:, j]) if isinstance(model, Joints) else (W, y, valid)
            results.append((*_solved(layout, *own, one.noise), moments(*own)))
            first = columns.stop
        return _Found(W, y, moving, column_noise, tuple(results))

    found: _Found = lax.map(solve, stack)
    return found


def _filtered(layout: Layout, model: Model, one: _Stack) -> tuple[Array, Array, Array, Array]:
    """Regressor, torque, what moves, and the noise of the columns, of one recording."""

    def filtered_by(filters: signals.PaddedFilter | None) -> Any:
        return jnp.asarray if filters is None else partial(_filter_columns, filters, one.samples)

    passes = filtered_by(one.position), filtered_by(one.parallel)
    differences = partial(signals.central_differences_padded, sample_rate=one.sample_rate, n=one.samples)

    def columns(motion: tuple[Any, ...]) -> tuple[Array, Array, Array]:
        return columns_of(model, passes, differences, layout.decimate, motion[0], motion[1], motion[2:])

    both = jax.vmap(columns)(jax.tree.map(lambda *x: jnp.stack(x), one.motion, one.noisy))
    W, y, speed = (x[0] for x in both)
    inside = jnp.arange(layout.rows) * layout.decimate < one.samples
    difference = jnp.where(inside.reshape(-1, *(1,) * (W.ndim - 1)), both[0][1] - W, 0)
    squares = (difference**2).reshape(-1, W.shape[-1]).sum(axis=0)
    count = inside.sum() * (W.shape[1] if W.ndim == 3 else 1)
    return W, y, speed >= one.min_velocity, jnp.sqrt(squares / count)


def _filter_columns(filters: signals.PaddedFilter, n: Array, x: AnyArray) -> Array:
    columns = jnp.asarray(x).reshape(x.shape[0], -1)
    return signals.filter_zero_phase_padded(filters, columns, n).reshape(x.shape)


def _plan(layout: Layout, outputs: int, p: int) -> Plan | None:
    """How all windows of a recording are solved by sums that they share; None where the noise does not allow that."""
    window, step, reach = layout.window * outputs, layout.step * outputs, (layout.lags - 1) * outputs
    if layout.lags and (reach > LONGEST_REACH or 2 * reach > window):
        return None
    per_block = max(1, min(BLOCK // step, window // step))
    lanes = max(FEWEST_LANES, -(-len(window_starts(layout.rows, layout.window, layout.step)) // per_block))
    room = -(-window // (step * per_block))
    ahead = window // step if window % step == 0 else 0
    return Plan(step, per_block, lanes, room, outputs, True, False, layout.lags, ahead)


def _solved(layout: Layout, W: Array, y: Array, valid: Array, noise: Array | None) -> Any:
    """Fits of all windows of one recording, and how they predict."""
    outputs = 1 if y.ndim == 1 else y.shape[1]
    plan = _plan(layout, outputs, W.shape[-1])
    starts = window_starts(layout.rows, layout.window, layout.step)
    if plan is None:
        fit = sliding_least_squares(W, y, layout.window, layout.step, valid=valid, noise=noise)
        return fit, score(W, y, valid, fit.theta, starts + layout.window, layout.window, layout.step)
    columns, scale = _columns(plan, W, y, valid)
    found = solve_chunk(plan, columns, scale, layout.window * outputs, noise)
    found = jax.tree.map(lambda x: x[: len(starts)], found)
    if found.unseen is not None:
        vaf, samples, variance = found.unseen
        vaf = jnp.where(samples >= 0.5 * layout.window * outputs, vaf, jnp.nan)
        return found._replace(unseen=None), Score(vaf, jnp.full_like(vaf, jnp.nan), samples.astype(int), variance)
    return found, score(W, y, valid, found.theta, starts + layout.window, layout.window, layout.step)


def _columns(plan: Plan, W: AnyArray, y: AnyArray, valid: AnyArray) -> tuple[Any, Any]:
    """Rows as `engine` takes them, filled up with nothing."""
    xp: Any = np if isinstance(W, np.ndarray) else jnp
    W, y, scale = W.reshape(-1, W.shape[-1]), y.ravel(), valid.ravel()
    columns = xp.where(scale, xp.concatenate([W.T, y[None]]), 0)
    behind = max(0, plan.rows - len(y))
    return xp.pad(columns, ((0, 0), (0, behind)))[:, : plan.rows], xp.pad(scale, (0, behind))[: plan.rows]


def _prepared(one: Measured, found: _Found, layout: Layout) -> Prepared:
    """The share of one recording, without what it was padded with."""
    recording, filters, model = one.recording, one.filters, one.model
    n = -(-len(recording) // layout.decimate)
    rows = rows_of(recording, filters, found.W[:n], found.y[:n], one.clean, found.moving[:n])
    noise = None if filters.noise is None else filters.noise
    solved, first = [], 0
    for j, part in enumerate(model.models if isinstance(model, Joints) else (model,)):
        columns = slice(first, first + len(part.names))
        own = rows if not isinstance(model, Joints) else _of_joint(rows, j, columns)
        solved.append(_finished(own, noise, found.solved[j], layout))
        first = columns.stop
    return Prepared(
        recording=recording,
        model=model,
        filters=filters,
        rows=rows,
        noise=None,  # the windows are solved
        column_noise=without_jumps(model, found.column_noise),
        pair=None,
        reference=one.reference,
        jumps=one.jumps,
        solved=tuple(solved),
    )


def _of_joint(rows: Rows, j: int, columns: slice) -> Rows:
    return replace(rows, W=rows.W[:, j, columns], torque=rows.torque[:, j], valid=rows.valid[:, j])


def _finished(rows: Rows, noise: AnyArray | None, found: Any, layout: Layout) -> Solved:
    """What the program found in the windows of one recording; a doubtful window is decomposed."""
    starts = window_starts(len(rows.time), layout.window, layout.step)
    fit, unseen = jax.tree.map(lambda x: x[: len(starts)], found[:2])
    doubtful = np.zeros(0, int)
    if isinstance(fit, ChunkFit):
        outputs = 1 if rows.torque.ndim == 1 else rows.torque.shape[1]
        plan = _plan(layout, outputs, rows.W.shape[-1])
        assert plan is not None
        lags = None if noise is None else np.pad(noise, (0, layout.lags - len(noise)))
        doubtful = np.flatnonzero(fit.doubtful)
        columns = partial(_columns, plan, *(np.asarray(x) for x in (rows.W, rows.torque, rows.valid)))
        fit = finish(fit, Task(plan, layout.window * outputs, lags), columns)
    complete = starts + 2 * layout.window <= len(rows.time)
    vaf = np.where(complete & np.isfinite(fit.theta).all(axis=1), unseen.vaf, np.nan)
    for k in doubtful[np.isfinite(vaf[doubtful])]:
        vaf[k] = _predicted(rows, fit.theta[k], starts[k] + layout.window, layout.window)
    return Solved(fit, eqx.tree_at(lambda score: score.vaf, unseen, vaf), found[2])


def _predicted(rows: Rows, theta: NDArray[np.float64], start: int, window: int) -> float:
    """Variance of the torque in a window that these parameters account for."""
    behind = slice(start, start + window)
    W, y, valid = (np.asarray(x)[behind] for x in (rows.W, rows.torque, rows.valid))
    residual = y - W @ theta
    return float(variance_accounted_for(y, residual, valid.astype(float)))
