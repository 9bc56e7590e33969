"""The paper's letter: every window is filtered by itself (Tout et al. 2023, III-B).

The windows' rows stand one block after another. It is biased at the windows' ends, where position and torque do not
pass the same filters, and serves to reproduce the paper.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from jaximp import signals
from jaximp.identification.filter_settings import Filters, FilterSettings
from jaximp.identification.pipeline import Pipeline
from jaximp.identification.rows import Rows, measured_motion, undisturbed
from jaximp.least_squares.sliding import slice_window, window_starts
from jaximp.models.base import MOTION, Model
from jaximp.numerics.cores import cores
from jaximp.types import AnyArray, Recording

LARGEST_BLOCKS = 200_000_000
"""Numbers that filtering inside every window may keep (1.6 GB)."""
CACHED_NUMBERS = 64_000
"""Samples of windows that are filtered at a time: all their columns fit into the cache."""
MOST_BATCHES = 64
"""So many times, in a part that one core works on."""


def regress_in_windows(pipeline: Pipeline, recording: Recording, model: Model) -> Rows:
    """Filter every window of a recording by itself and evaluate the model on it."""
    filters, rate = pipeline.filters, recording.sample_rate
    q, torque = measured_motion(pipeline.filter, recording)[:2]
    window, step = pipeline.window_samples, pipeline.step_samples
    starts = window_starts(len(recording), window, step)
    kept = np.arange(0, window, filters.decimate)
    if len(starts) * len(kept) * recording.n_joints * len(model.names) > LARGEST_BLOCKS:
        raise ValueError(
            "filtering inside every window makes too many rows here: lengthen window.step or filter.decimate"
        )
    inside = rows_away_from_ends(window, filters, pipeline.filter)
    if inside.sum() * recording.n_joints < len(model.names):
        raise ValueError(
            f"windows of {pipeline.window.length:g} s are shorter than the filters' transients at both ends "
            f"({2 * filters.reach / rate:.2g} s): lengthen them, or set filter.drop_transient = false"
        )

    if recording.n_joints == 1:
        q, torque = q[:, 0], torque[:, 0]
    W, y, speed = _rows_of_windows(model, filters, rate, *(signals.cut_signal(x, starts, window) for x in (q, torque)))
    index = starts[:, None] + kept
    counts = undisturbed(recording, filters, ends=False)[index] & inside
    valid = counts.reshape(*counts.shape, *(1,) * (y.ndim - 2)) & (speed >= pipeline.window.min_velocity)
    W, y = (x.reshape(-1, *x.shape[2:]) for x in (W, y))
    return Rows(jnp.asarray(W), jnp.asarray(y), valid.reshape(y.shape), recording.time[index].ravel())


def _rows_of_windows(
    model: Model, filters: Filters, sample_rate: float, q: signals.CutSignal, torque: signals.CutSignal
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Regressor (M, rows, *n, p), torque and speed (M, rows, *n) of all windows."""
    if filters.position is not None:
        q = signals.filter_in_windows(filters.position, q)
    dq, ddq = signals.differentiate_in_windows(q, sample_rate, filters.differentiator)
    speed = np.abs(dq.at(np.arange(0, q.shapes.shape[1], filters.decimate)))
    one = signals.cut_signal(np.ones_like(q.whole), q.starts, q.shapes.shape[1])
    motion = dict(zip(MOTION, (q, dq, ddq, one), strict=True)) if model.n_joints == 1 else {}
    others = tuple(k for k, column in enumerate(model.columns) if column not in motion)
    W = np.empty((*speed.shape, len(model.names)))

    with ThreadPoolExecutor(1) as beside:
        made = beside.submit(_other_columns, model, others, filters, sample_rate, q) if others else None
        for column in motion.keys() & model.columns:
            rows = _filtered_rows(filters, motion[column])
            for k in np.flatnonzero(np.array(model.columns) == column):
                W[..., k] = rows
        y = _filtered_rows(filters, torque)
        if made is not None:
            W[..., others] = made.result()
    return W, y, speed


def _filtered_rows(filters: Filters, signal: signals.CutSignal) -> NDArray[np.float64]:
    """The rows of every window that are kept, after the parallel filter: (M, rows, *n)."""
    if filters.parallel is not None:
        signal = signals.filter_in_windows(filters.parallel, signal)
    return signal.at(np.arange(0, signal.shapes.shape[1], filters.decimate))


@lru_cache(maxsize=1)
def _response(filters: Filters, window: int) -> Array | None:
    """The matrix (rows, S) that takes a window's samples through the parallel filter to the rows that are kept.

    All columns of all recordings pass it, and the noise.
    """
    if filters.parallel is None:
        return None
    if len(range(0, window, filters.decimate)) * window > LARGEST_BLOCKS:
        raise ValueError(
            f"windows of {window} samples are too long to be filtered one by one: shorten window.length, or set "
            "filter.mode = 'once'"
        )
    return jnp.asarray(signals.zero_phase_matrix(filters.parallel, window, filters.decimate))


def _other_columns(
    model: Model, chosen: tuple[int, ...], filters: Filters, sample_rate: float, q: signals.CutSignal
) -> NDArray[np.float64]:
    """The chosen columns, which are not linear in the motion: made and filtered in every window, (M, rows, *n, k).

    All cores work on parts of one size: recordings of any length share the compiled code.
    """
    n_windows, window = len(q.starts), q.shapes.shape[1]
    step = int(q.starts[1]) if n_windows > 1 else 1
    at_a_time = max(1, min(n_windows, CACHED_NUMBERS // (window * model.n_joints)))
    per_part = at_a_time * min(MOST_BATCHES, -(-n_windows // (at_a_time * cores())))
    behind = -n_windows % per_part
    whole, amounts = _zeros_behind(q.whole, behind * step), _zeros_behind(q.amounts, behind)
    shapes, response = jnp.asarray(q.shapes), _response(filters, window)

    found = np.empty((n_windows, len(range(0, window, filters.decimate)), *q.whole.shape[1:], len(chosen)))

    def put(first: int) -> None:
        part = slice(first, first + per_part)
        samples = whole[first * step :][: (per_part - 1) * step + window]
        sizes = (sample_rate, filters.decimate, step, at_a_time, filters.differentiator)
        found[part] = _columns(model, chosen, *sizes, samples, shapes, amounts[part], response)[: n_windows - first]

    with ThreadPoolExecutor(cores()) as pool:
        list(pool.map(put, range(0, n_windows, per_part)))
    return found


def _zeros_behind(x: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    return np.concatenate([x, np.zeros((n, *x.shape[1:]))])


@eqx.filter_jit
def _columns(
    model: Model,
    chosen: tuple[int, ...],
    sample_rate: float,
    decimate: int,
    step: int,
    at_a_time: int,
    differentiator: signals.Differentiator,
    whole: AnyArray,
    shapes: Array,
    amounts: AnyArray,
    response: Array | None,
) -> Array:
    """The chosen columns of some windows that begin every `step` samples; `at_a_time` fit into the cache."""

    def one(start: Array, amount: Array) -> Array:
        (samples,) = slice_window((whole,), start, shapes.shape[1])
        q = samples + (amount @ shapes).T
        W = model.observation_matrix(q, *signals.differentiate(q, sample_rate, differentiator))
        if response is None:
            return W[::decimate, ..., jnp.array(chosen)]
        # Column by column, as they come out of the model: side by side they would first be copied.
        return jnp.stack([response @ W[..., k] for k in chosen], axis=-1)

    starts = jnp.arange(len(amounts)) * step
    return jax.lax.map(lambda window: one(*window), (starts, amounts), batch_size=at_a_time)


def rows_away_from_ends(window: int, filters: Filters, settings: FilterSettings) -> NDArray[np.bool_]:
    """Which rows of a window that was filtered by itself count."""
    kept = np.arange(0, window, filters.decimate)
    edge = filters.reach if settings.drop_transient else 0
    return (kept >= edge) & (kept < window - edge)


def noise_in_windows(pipeline: Pipeline) -> Array | None:
    """(rows, rows) covariance of white torque noise in a window that was filtered by itself."""
    response = _response(pipeline.filters, pipeline.window_samples)
    return None if response is None else response @ response.T
