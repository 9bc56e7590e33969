"""What raw samples are like: gaps, jumps, noise, the step of the encoder. Plain numpy, before anything is filtered."""

from __future__ import annotations

from functools import lru_cache, partial
from math import comb

import numpy as np
from numpy.typing import NDArray

DIFFERENCES, FEWEST_DIFFERENCES = (4, 6, 8, 12), 20
"""Orders of differences in which noise is looked for, and how many times as many samples there must be."""


EVEN = 0.01
"""Share of a step by which stamps may differ from even ones for differences to be those of even ones."""
SHORT = 3
"""Missing samples across which a leap is told from motion."""


def fill_gaps(x: NDArray[np.float64], valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Straight lines across the samples that are not valid, so that a filter can pass; (N, k) or (N,)."""
    if valid.all():
        return x
    index = np.arange(len(x))
    columns = x.reshape(len(x), -1)
    filled = np.stack([np.interp(index, index[valid], column[valid]) for column in columns.T], axis=1)
    return filled.reshape(x.shape)


def long_gaps(valid: NDArray[np.bool_], longest: int) -> NDArray[np.bool_]:
    """True in the gaps of more than `longest` samples, and in those at the ends."""
    out = ~valid
    if not out.any():
        return out
    edges = np.flatnonzero(np.diff(np.r_[False, out, False].astype(np.int8)))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if last - first <= longest and first > 0 and last < len(valid):
            out[first:last] = False
    return out


def widen_gaps(valid: NDArray[np.bool_], by: int, ends: bool = True) -> NDArray[np.bool_]:
    """Also invalidate `by` samples on both sides of every gap, and at both ends: where a filter saw no measurement."""
    if valid.all():
        inside = np.ones(len(valid), bool)
        if ends:
            inside[:by] = inside[max(0, len(valid) - by) :] = False
        return inside
    gone = np.cumsum(np.r_[np.zeros(by + 1), ends, ~valid, ends, np.zeros(by)])
    near = gone[2 * by + 1 :] - gone[: -2 * by - 1]
    return np.asarray(near == 0)[1:-1]


def lengthen_gaps(valid: NDArray[np.bool_], by: int) -> NDArray[np.bool_]:
    """Also invalidate `by` samples after every gap: where a memory reaches back into it."""
    if by == 0:
        return valid.copy()
    gone = np.cumsum(np.r_[np.zeros(by + 1), ~valid])
    return np.asarray(gone[by + 1 :] == gone[: len(valid)])


def jumps(x: NDArray[np.float64], noise: float | None = None) -> NDArray[np.bool_]:
    """Where a signal (N,) leaps between two samples as no joint can move; both samples are True.

    A leap is a difference that exceeds six times all those nearby and twenty times the noise: a recorder that was
    switched, an encoder that lost counts, a trial that was cut. A filter would ring there, and the ringing would pass
    for an excitation that the torque never saw. `noise` is the `noise_level`, where it is known.
    """
    from scipy.ndimage import maximum_filter1d

    size = np.abs(np.diff(_held_over_gaps(x)))
    size = np.where(np.isfinite(size), size, 0.0)
    leap = size > 20 * (noise_level(x) if noise is None else noise)
    if not leap.any():
        return np.zeros(len(x), bool)
    nearby = maximum_filter1d(np.pad(size, 6), 5)
    before, after = (nearby[6 + shift : 6 + shift + len(size)] for shift in (-3, 3))
    leap &= size > 6 * np.maximum(before, after)
    return np.r_[leap, False] | np.r_[False, leap]


def _held_over_gaps(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """With the last value kept for up to `SHORT` missing samples, so that a leap beside them is one."""
    missing = ~np.isfinite(x)
    if not missing.any():
        return x
    at = np.arange(len(x))
    last = np.maximum.accumulate(np.where(missing, 0, at))
    return np.where(missing & (at - last <= SHORT), x[last], x)


def noise_level(x: NDArray[np.float64], stamps: NDArray[np.float64] | None = None) -> float:
    """Standard deviation of the white noise in a smooth signal (N,), from its fourth to twelfth differences.

    A motion vanishes in them, a fast one in the higher ones alone: the smallest estimate counts. The median keeps
    jumps from counting. A coarse encoder leaves at least the noise of its rounding, step/sqrt(12).

    **Arguments:** `stamps` (N,) of samples that are not evenly spaced: motion vanishes in their divided differences.
    """
    level = _level_of_differences if stamps is None or _even(stamps) else partial(_level_of_divided, stamps)
    levels = [level(x, order) for order in DIFFERENCES if len(x) > FEWEST_DIFFERENCES * order]
    known = [one for one in levels or [level(x, 4)] if np.isfinite(one)]
    if not known:
        return 0.0
    return float(max(min(known), quantisation_step(x) / np.sqrt(12.0)))


def _level_of_differences(x: NDArray[np.float64], order: int) -> float:
    """Standard deviation of white noise with differences as large as these; NaN where there are none."""
    found = np.diff(x, order)
    found = found[np.isfinite(found)]
    return 1.4826 * float(np.median(np.abs(found))) / np.sqrt(comb(2 * order, order)) if len(found) else np.nan


def _even(stamps: NDArray[np.float64]) -> bool:
    steps = np.diff(stamps)
    return bool(np.abs(steps - np.median(steps)).max(initial=0.0) <= EVEN * np.median(steps))


def _level_of_divided(stamps: NDArray[np.float64], x: NDArray[np.float64], order: int) -> float:
    """As `_level_of_differences`, of divided differences, each times what makes its weights those of unit variance."""
    if len(x) <= order:
        return np.nan
    t, values = (np.lib.stride_tricks.sliding_window_view(z, order + 1) for z in (stamps, x))
    t = t / np.median(np.diff(stamps))
    apart = t[:, :, None] - t[:, None, :] + np.eye(order + 1)
    weights = 1 / apart.prod(axis=2)
    found = np.abs((weights * values).sum(axis=1)) / np.sqrt((weights**2).sum(axis=1))
    found = found[np.isfinite(found)]
    return 1.4826 * float(np.median(found)) if len(found) else np.nan


def quantisation_step(x: NDArray[np.float64]) -> float:
    """Step of the encoder or converter that made a signal (N,), or zero where none can be seen.

    The step is the smallest difference between distinct values, provided that all differences are whole multiples of
    it and values repeat often; a finely resolved signal has no such step.
    """
    known = x[np.isfinite(x)]
    # If N samples take N / 2 values, about a hundred pairs among 10 sqrt(N) of them are equal: without any, no step.
    some = _some(len(known))
    if len(_distinct(known[some])) == len(some):
        return 0.0
    values = _distinct(known)
    if len(values) < 3 or len(x) < 2 * len(values):
        return 0.0
    gaps = np.diff(values)
    multiples = gaps / gaps.min()
    fits = np.abs(multiples - np.round(multiples)) < 0.05
    return float(np.median((gaps / np.round(multiples))[fits])) if fits.mean() > 0.9 else 0.0


@lru_cache(maxsize=32)
def _some(count: int) -> NDArray[np.int64]:
    """About 10 sqrt(N) of so many indices, drawn once."""
    return np.unique(np.random.default_rng(0).integers(max(count, 1), size=int(10 * count**0.5)))


def _distinct(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rising values; sums of steps differ in their last digits, and are one value."""
    values = np.sort(x)
    return values[np.diff(values, prepend=-np.inf) > 1e-9 * np.abs(values[[0, -1]]).max()] if len(values) else values
