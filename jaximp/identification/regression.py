"""From a recording to rows for least squares: filters, derivatives, the model's columns, decimation.

Tout et al. 2023, III-B. The filters run over the recording once, and windows slide over its rows; or, as the paper
writes, inside every window, whose rows then stand one block after another.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from jaximp import signals
from jaximp.jobs.job import FilterSettings, Job
from jaximp.least_squares.chunks import cores
from jaximp.least_squares.sliding import slice_window, window_starts
from jaximp.models import MOTION, Model
from jaximp.types import AnyArray, Recording

LARGEST_BLOCKS = 200_000_000
"""Numbers that filtering inside every window may keep (1.6 GB)."""
CACHED_NUMBERS = 64_000
"""Samples of windows that are filtered at a time: all their columns fit into the cache."""
MOST_BATCHES = 64
"""So many times, in a part that one core works on."""


@dataclass(frozen=True)
class Filters:
    """Designed filters of one recording."""

    position: signals.Sections | None
    """Second-order sections that the position passes before it is differentiated."""
    parallel: signals.Sections | None
    """Second-order sections that the torque and every column pass."""
    decimate: int
    """Every n-th sample is kept."""

    @property
    def reach(self) -> int:
        """Samples beside an end or a gap that the filters spoil."""
        return _reach_of(self, 0.01)

    @property
    def bridge(self) -> int:
        """Samples that a gap may last for the filters to pass over it: one in 32 of those that they reach."""
        return self.reach // 32

    @property
    def ringing(self) -> int:
        """Samples beside a jump of the position until the filters' answer to it has died out."""
        return _reach_of(self, 1e-6)

    @property
    def noise(self) -> NDArray[np.float64] | None:
        """Autocovariance by lag, in rows, of white torque noise after the filters."""
        return None if self.parallel is None else _autocovariance(self)


@lru_cache(maxsize=64)
def _reach_of(filters: Filters, share: float) -> int:
    return sum(signals.reach(sos, share) for sos in (filters.position, filters.parallel) if sos is not None)


@lru_cache(maxsize=64)
def _autocovariance(filters: Filters) -> NDArray[np.float64]:
    assert filters.parallel is not None
    return signals.autocovariance(filters.parallel, filters.decimate)


@dataclass(frozen=True)
class Rows:
    """A filtered recording as least squares sees it; (N, ...) rows after decimation."""

    W: AnyArray
    torque: AnyArray
    valid: NDArray[np.bool_]
    time: NDArray[np.float64]


class Motion(NamedTuple):
    """What a recording measured, with straight lines across its gaps."""

    position: NDArray[np.float64]
    """(N, n)"""
    torque: NDArray[np.float64]
    """(N, n)"""
    velocity: NDArray[np.float64] | None = None
    """(N, n) where it is to serve in place of a derivative, and the acceleration too."""
    acceleration: NDArray[np.float64] | None = None

    @property
    def derivatives(self) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
        return self.velocity, self.acceleration


@lru_cache(maxsize=64)
def design_filters(settings: FilterSettings, sample_rate: float) -> Filters:
    """Butterworth filters for a recording of this sample rate [Hz]."""
    parallel = [
        signals.butterworth(order, cutoff, sample_rate, kind)
        for order, cutoff, kind in (
            (settings.decimation_order, settings.decimation_cutoff, "lowpass"),
            (settings.high_pass_order, settings.high_pass, "highpass"),
        )
        if cutoff is not None
    ]
    decimate = settings.decimate
    if decimate is None:
        cutoff = settings.decimation_cutoff
        decimate = 1 if cutoff is None else max(1, int(sample_rate / (5 * cutoff)))
    position = None
    if settings.position_cutoff is not None:
        position = signals.butterworth(settings.position_order, settings.position_cutoff, sample_rate)
    return Filters(_plain(position), _plain(np.concatenate(parallel)) if parallel else None, decimate)


def _plain(sos: NDArray[np.float64] | None) -> signals.Sections | None:
    """As plain numbers, which make `Filters` hashable: recordings filtered alike share compiled code."""
    return None if sos is None else tuple(tuple(section) for section in sos.tolist())


def regress(model: Model, recording: Recording, job: Job, filters: Filters) -> Rows:
    """Filter a recording and evaluate the model on it, once or inside every window, as the job says."""
    _check_memory(model, recording, job)
    motion = measured_motion(job.filter, recording)
    if job.filter.mode == "window":
        return _regress_in_windows(model, recording, job, filters, motion.position, motion.torque)
    W, y, speed = filtered(model, filters, recording.sample_rate, motion.position, motion.torque, motion.derivatives)
    moving = np.asarray(speed) >= job.window.min_velocity
    return rows_of(recording, filters, W, y, undisturbed(recording, filters, memory=model.memory), moving)


def rows_of(
    recording: Recording,
    filters: Filters,
    W: AnyArray,
    y: AnyArray,
    clean: NDArray[np.bool_],
    moving: NDArray[np.bool_],
) -> Rows:
    """What was filtered in one go, and which of its rows count: `clean` (N,) samples (`undisturbed`), `moving` rows."""
    valid = clean[:: filters.decimate]
    valid = valid & moving if recording.n_joints == 1 else valid[:, None] & moving
    if not valid.any():
        raise ValueError(
            f"no sample is left after filtering ({np.mean(~recording.valid):.0%} were not measured): the recording is "
            "too short for the filters (and the lags of a reflex), has too many gaps, or never moves faster than "
            "window.min_velocity"
        )
    return Rows(W, y, valid, recording.time[:: filters.decimate])


def _check_memory(model: Model, recording: Recording, job: Job) -> None:
    """A model with memory must see the past, and know how many samples it is."""
    if model.sample_rate is None:
        return
    if job.filter.mode == "window":
        raise ValueError(
            "filter.mode = 'window' cuts off the past that a reflex answers to: set filter.mode = 'once', or leave the "
            "reflex out"
        )
    if abs(model.sample_rate - recording.sample_rate) > 1e-3 * recording.sample_rate:
        raise ValueError(
            f"the reflex was made for {model.sample_rate:g} Hz, but the recording has {recording.sample_rate:g} Hz: "
            "give the model the recording's sample rate"
        )


def jumped(recording: Recording) -> NDArray[np.bool_]:
    """(N,) True where the position of some joint jumps."""
    return np.any([signals.jumps(q) for q in recording.position.T], axis=0)


def undisturbed(
    recording: Recording,
    filters: Filters,
    ends: bool = True,
    memory: int = 0,
    jumps: NDArray[np.bool_] | None = None,
) -> NDArray[np.bool_]:
    """(N,) samples whose filtered value comes from measurements, and not from a gap, a jump or (`ends`) an end.

    A gap that is short against the filters is bridged: the straight line across it is as good as a measurement. What a
    gap, a jump or the beginning spoils, a model with a `memory` of so many samples remembers. `jumps` is what `jumped`
    finds, where that is known.
    """
    missing = signals.long_gaps(recording.valid, filters.bridge)
    known = signals.lengthen_gaps(~missing, memory)
    known[: memory if ends else 0] = False
    valid = signals.widen_gaps(known, filters.reach, ends)
    jumps = jumped(recording) if jumps is None else jumps
    if not jumps.any():
        return valid
    return valid & signals.widen_gaps(signals.lengthen_gaps(~jumps, memory), filters.ringing, ends=False)


@eqx.filter_jit
def filtered(
    model: Model,
    filters: Filters,
    sample_rate: float,
    q: AnyArray,
    torque: AnyArray,
    derivatives: tuple[AnyArray | None, AnyArray | None] = (None, None),
) -> tuple[Array, Array, Array]:
    """Regressor, torque and speed of one stretch of samples: parallel filters, then every n-th sample."""

    def filtered_by(sos: signals.Sections | None) -> Callable[[AnyArray], Array]:
        return jnp.asarray if sos is None else partial(signals.filter_zero_phase, sos)

    passes = filtered_by(filters.position), filtered_by(filters.parallel)
    return columns_of(
        model, passes, lambda x: signals.central_differences(x, sample_rate), filters.decimate, q, torque, derivatives
    )


def columns_of(
    model: Model,
    passes: tuple[Callable[[AnyArray], Array], Callable[[AnyArray], Array]],
    differences: Callable[[AnyArray], tuple[Array, Array]],
    decimate: int,
    q: AnyArray,
    torque: AnyArray,
    derivatives: tuple[AnyArray | None, AnyArray | None],
) -> tuple[Array, Array, Array]:
    """Regressor, torque and speed by given filters (of the position; of all columns) and differences."""
    smooth, parallel = passes
    q = smooth(q)
    dq, ddq = differences(q)
    if derivatives[0] is not None:
        dq = smooth(derivatives[0])
        ddq = differences(dq)[0]
    if derivatives[1] is not None:
        ddq = smooth(derivatives[1])
    one_joint = q.shape[1] == 1
    motion = tuple(x[:, 0] if one_joint else x for x in (q, dq, ddq))
    W = model.observation_matrix(*motion)
    if model.memory:  # the filters need numbers; `undisturbed` lets none of these count
        W = W.at[: model.memory].set(jnp.nan_to_num(W[: model.memory]))
    y = jnp.asarray(torque)[:, 0] if one_joint else jnp.asarray(torque)
    both = parallel(jnp.concatenate([W, y[..., None]], axis=-1))
    return both[::decimate, ..., :-1], both[::decimate, ..., -1], jnp.abs(motion[1])[::decimate]


def _regress_in_windows(
    model: Model, recording: Recording, job: Job, filters: Filters, q: NDArray[np.float64], torque: NDArray[np.float64]
) -> Rows:
    """The paper's letter: every window is filtered by itself. The windows' rows stand one block after another."""
    rate = recording.sample_rate
    window = round(job.window.length * rate)
    step = round(step_seconds(job) * rate)
    starts = window_starts(len(recording), window, step)
    kept = np.arange(0, window, filters.decimate)
    if len(starts) * len(kept) * recording.n_joints * len(model.names) > LARGEST_BLOCKS:
        raise ValueError(
            "filtering inside every window makes too many rows here: lengthen window.step or filter.decimate"
        )
    inside = _away_from_ends(window, filters, job.filter)
    if inside.sum() * recording.n_joints < len(model.names):
        raise ValueError(
            f"windows of {job.window.length:g} s are shorter than the filters' transients at both ends "
            f"({2 * filters.reach / rate:.2g} s): lengthen them, or set filter.drop_transient = false"
        )

    if recording.n_joints == 1:
        q, torque = q[:, 0], torque[:, 0]
    W, y, speed = _rows_of_windows(model, filters, rate, *(signals.cut_signal(x, starts, window) for x in (q, torque)))
    index = starts[:, None] + kept
    counts = undisturbed(recording, filters, ends=False)[index] & inside
    valid = counts.reshape(*counts.shape, *(1,) * (y.ndim - 2)) & (speed >= job.window.min_velocity)
    W, y = (x.reshape(-1, *x.shape[2:]) for x in (W, y))
    return Rows(jnp.asarray(W), jnp.asarray(y), valid.reshape(y.shape), recording.time[index].ravel())


def _rows_of_windows(
    model: Model, filters: Filters, sample_rate: float, q: signals.CutSignal, torque: signals.CutSignal
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Regressor (M, rows, *n, p), torque and speed (M, rows, *n) of all windows."""
    if filters.position is not None:
        q = signals.filter_in_windows(filters.position, q)
    dq, ddq = signals.differences_in_windows(q, sample_rate)
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
        sizes = (sample_rate, filters.decimate, step, at_a_time)
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
    whole: AnyArray,
    shapes: Array,
    amounts: AnyArray,
    response: Array | None,
) -> Array:
    """The chosen columns of some windows that begin every `step` samples; `at_a_time` fit into the cache."""

    def one(start: Array, amount: Array) -> Array:
        (samples,) = slice_window((whole,), start, shapes.shape[1])
        q = samples + (amount @ shapes).T
        W = model.observation_matrix(q, *signals.central_differences(q, sample_rate))
        if response is None:
            return W[::decimate, ..., jnp.array(chosen)]
        # Column by column, as they come out of the model: side by side they would first be copied.
        return jnp.stack([response @ W[..., k] for k in chosen], axis=-1)

    starts = jnp.arange(len(amounts)) * step
    return jax.lax.map(lambda window: one(*window), (starts, amounts), batch_size=at_a_time)


def _away_from_ends(window: int, filters: Filters, settings: FilterSettings) -> NDArray[np.bool_]:
    """Which rows of a window that was filtered by itself count."""
    kept = np.arange(0, window, filters.decimate)
    edge = filters.reach if settings.drop_transient else 0
    return (kept >= edge) & (kept < window - edge)


def measured_motion(settings: FilterSettings, recording: Recording) -> Motion:
    """What goes into the filters; the velocity only where the settings ask for it."""
    q, torque = (signals.fill_gaps(x, recording.valid) for x in (recording.position, recording.torque))
    if not settings.measured_derivatives:
        return Motion(q, torque)
    if recording.velocity is None:
        raise ValueError("filter.measured_derivatives needs a velocity column in [recording]")
    if settings.mode == "window":
        raise ValueError("filter.measured_derivatives works with filter.mode = 'once'")
    velocity, acceleration = (
        None if x is None else signals.fill_gaps(x, recording.valid)
        for x in (recording.velocity, recording.acceleration)
    )
    return Motion(q, torque, velocity, acceleration)


def step_seconds(job: Job) -> float:
    return job.window.length / 50 if job.window.step is None else job.window.step


@dataclass(frozen=True)
class Placement:
    """Where windows lie in the rows: sliding over shared rows, or one block of rows after another."""

    window: int
    """Rows in a window."""
    step: int
    """Rows from one window to the next."""
    counted: int
    """Rows of a complete window that count."""
    room: int | None
    """Rows that the compiled code is to have room for, see `windows.sliding_least_squares`."""
    starts: NDArray[np.int64]
    """(M,) first row of each window."""
    next_starts: NDArray[np.int64]
    """(M,) first row of the window that follows without overlap."""
    separate: bool


def check_window(job: Job, recording: Recording) -> None:
    """Refuse a window that is longer than the recording."""
    duration = len(recording) / recording.sample_rate
    if round(job.window.length * recording.sample_rate) > len(recording):
        raise ValueError(
            f"the window of {job.window.length:g} s is longer than the recording of {duration:.4g} s: "
            "shorten window.length"
        )


def windows_in_rows(
    job: Job, recording: Recording, rows: Rows, filters: Filters, longest: float | None = None
) -> Placement:
    """Find the windows of a job in the rows of a recording."""
    check_window(job, recording)
    rate = recording.sample_rate
    if job.filter.mode == "window":
        samples = round(job.window.length * rate)
        block = len(range(0, samples, filters.decimate))
        starts = np.arange(0, len(rows.time), block)
        ahead = -(-samples // round(step_seconds(job) * rate))
        counted = int(_away_from_ends(samples, filters, job.filter).sum())
        return Placement(block, block, counted, None, starts, starts + ahead * block, separate=True)
    window = round(job.window.length * rate / filters.decimate)
    if window * recording.n_joints < rows.W.shape[-1]:
        raise ValueError(
            f"a window of {job.window.length:g} s keeps {window} samples of each joint after decimation by "
            f"{filters.decimate}, which cannot determine {rows.W.shape[-1]} parameters: lengthen window.length"
        )
    step = max(1, round(step_seconds(job) * rate / filters.decimate))
    room = None if longest is None else max(window, round(longest * rate / filters.decimate))
    starts = window_starts(len(rows.time), window, step)
    return Placement(window, step, window, room, starts, starts + window, separate=False)


def noise_of_rows(job: Job, recording: Recording, filters: Filters) -> Array | None:
    """What the filters make of white torque noise: by lag, or for every pair of rows of a window."""
    if job.filter.mode == "once" or filters.parallel is None:
        return None if filters.noise is None else jnp.asarray(filters.noise)
    window = round(job.window.length * recording.sample_rate)
    response = _response(filters, window)
    assert response is not None
    return response @ response.T


def column_noise(model: Model, recording: Recording, job: Job, filters: Filters) -> NDArray[np.float64]:
    """(p,) root mean square of `noisy_columns`."""
    difference = noisy_columns(model, recording, job, filters)
    return np.asarray(np.sqrt((difference.reshape(-1, len(model.names)) ** 2).mean(axis=0)))


def noisy_columns(model: Model, recording: Recording, job: Job, filters: Filters) -> NDArray[np.float64]:
    """(N, *n, p) what noise of the motion leaves in each column: the pipeline, run with noise as well."""
    motion = measured_motion(job.filter, recording)
    noisy, rate = with_noise(motion), recording.sample_rate
    plain = np.asarray(filtered(model, filters, rate, motion.position, motion.torque, motion.derivatives)[0])
    spoilt = np.asarray(filtered(model, filters, rate, noisy.position, noisy.torque, noisy.derivatives)[0])
    return without_jumps(model, spoilt - plain)


def without_jumps(model: Model, noise: NDArray[np.float64]) -> NDArray[np.float64]:
    """Zero for the columns that jump (the sign of the velocity), which say nothing of the joint's excitation."""
    return np.where(["sign" not in column for column in model.columns], noise, 0.0)


def with_noise(motion: Motion, levels: Sequence[float] | None = None) -> Motion:
    """The motion with as much noise again as is in it; `levels` of the positions' noise, where they are known."""
    moving = [motion.velocity, motion.acceleration, motion.position]
    numbers = _normal_numbers(sum(x.size for x in moving if x is not None))
    spoilt, used = [], 0
    for x, known in zip(moving, (None, None, levels), strict=True):
        if x is not None:
            sizes = [signals.noise_level(column) for column in x.T] if known is None else known
            white = numbers[used : used + x.size].reshape(x.shape[::-1]).T
            x, used = x + np.asarray(sizes) * white, used + x.size
        spoilt.append(x)
    velocity, acceleration, position = spoilt
    assert position is not None
    return Motion(position, motion.torque, velocity, acceleration)


def _normal_numbers(n: int) -> NDArray[np.float64]:
    """The first n of a sequence that is always the same."""
    return _normal_sequence(1 << max(n - 1, 1).bit_length())[:n]


@lru_cache(maxsize=2)
def _normal_sequence(n: int) -> NDArray[np.float64]:
    return np.random.default_rng(0).standard_normal(n)
