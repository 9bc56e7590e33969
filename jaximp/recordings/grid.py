"""Time stamps, and the uniform grid that all channels are brought onto: gaps are masked, uneven stamps resampled."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaximp.recordings.channels import Signal
from jaximp.recordings.errors import RecordingError

JITTER = 0.01
"""Stamps that differ from a uniform grid by less than this share of an interval are taken as even."""
PACKET, OFTEN, FEWEST_PACKETS = 5.0, 0.02, 10
"""Stamps come in packets if so large a share of the intervals, and so many, are so many times the usual one, and most
of the time."""
GAP = 1.5
"""An interval longer than this many median intervals is a gap."""
LARGEST_GROWTH = 50
"""The uniform grid has at most this many samples for each measured one."""
MOST_GRID = 1_000_000_000
"""Samples of a uniform grid at most."""

Gridded = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_], list[str]]
"""Time, samples, validity, and notes on what was done."""


def take_clock(signals: dict[str, Signal], sample_rate: Any) -> Signal:
    """Take the clock out of the signals: (N, 1) time stamps, measured or from a rate (a number, or from the file)."""
    if "time" in signals:
        return signals.pop("time")
    rate = signals.pop("sample_rate").values if "sample_rate" in signals else np.array([[float(sample_rate)]])
    if rate.size != 1 or not 0 < rate.item() < math.inf:
        raise RecordingError(f"sample_rate must be one positive number in Hz, not {rate.ravel()[:3].tolist()}")
    with np.errstate(over="ignore"):
        return Signal(("sample_rate",), np.arange(len(signals["position"].values))[:, None] / rate)


def check_stamps(label: str, stamps: NDArray[np.float64]) -> None:
    """Time stamps are finite, and increase: what can be said of those that do not, `clocks` has said."""
    unusable = np.flatnonzero(~np.isfinite(stamps))
    if len(unusable):
        row = unusable[0] + 1
        raise RecordingError(f"{label!r}, row {row}: the time stamp is {stamps[row - 1]}; repair or remove the row")
    late = np.flatnonzero(stamps[1:] <= stamps[:-1])
    if len(late):
        row = late[0] + 2
        fault = "repeats the one before" if stamps[row - 1] == stamps[row - 2] else "steps backwards"
        raise RecordingError(
            f"{label!r}, row {row}: the time stamp {stamps[row - 1]:.10g} s {fault}; remove the row, or give "
            "'sample_rate' instead of 'time' if the stamps are only rounded too coarsely"
        )


def on_uniform_grid(stamps: NDArray[np.float64], samples: NDArray[np.float64], valid: NDArray[np.bool_]) -> Gridded:
    """Time, samples and validity on the grid, and what was done: masked if rows are missing, resampled if uneven."""
    if _is_even(stamps):
        return stamps, samples, valid, []
    with np.errstate(all="ignore"):
        intervals = np.diff(stamps)
        # The lower median is an interval that occurs; the mean of two could fall between one and two steps.
        middle = (len(intervals) - 1) // 2
        median = np.partition(intervals, middle)[middle]
        growth = (stamps[-1] - stamps[0]) / median / len(stamps)
    if not 1e-9 < median < 1e6:
        raise RecordingError(f"the median interval of {median:.3g} s is no sampling interval; correct the unit of time")
    _refuse_packets(intervals, median)
    longest = int(np.argmax(intervals))
    if not growth <= LARGEST_GROWTH or growth * len(stamps) > MOST_GRID:
        raise RecordingError(
            f"the gap of {intervals[longest]:.6g} s after row {longest + 1} would fill the uniform grid with "
            f"{growth:.3g} times as many samples as were measured; split the recording there, or repair the stamps"
        )
    time, samples, valid, notes = _placed(stamps, samples, valid, median) or _resampled(stamps, samples, valid, median)
    gaps = int((intervals > GAP * median).sum())
    if gaps:
        what = f"{gaps} {'gap' if gaps == 1 else 'gaps'} in the time stamps"
        where = f"longest {intervals[longest]:.6g} s, after row {longest + 1}"
        # Single missing rows are also what stamps look like that were rounded to about the sampling interval.
        hint = "" if intervals[longest] > 2.5 * median else " (if stamps are only rounded, give 'sample_rate' instead)"
        notes.append(f"{what} ({where}): the samples inside are masked{hint}")
    return time, samples, valid, notes


def _refuse_packets(intervals: NDArray[np.float64], median: float) -> None:
    """Refuse stamps of when samples arrived, and not of when they were measured."""
    waits = intervals > PACKET * median
    if waits.sum() >= FEWEST_PACKETS and waits.mean() > OFTEN and intervals[waits].sum() > 0.5 * intervals.sum():
        wait, rate = float(np.median(intervals[waits])), len(intervals) / intervals.sum()
        raise RecordingError(
            f"the time stamps come in packets ({1 / waits.mean():.2g} samples at once, then nothing for "
            f"{1e3 * wait:.3g} ms): they say when samples arrived, not when they were measured; give sample_rate = "
            f"{rate:.4g} (or the rate that was set) in place of time"
        )


def _is_even(stamps: NDArray[np.float64]) -> bool:
    """Whether the stamps are even already, so that nothing is to be done."""
    step = (stamps[-1] - stamps[0]) / (len(stamps) - 1)
    late = stamps - (stamps[0] + step * np.arange(len(stamps)))
    return bool(1e-9 < step < 1e6 and np.abs(late).max() <= 1e-7 * step)


def _placed(
    stamps: NDArray[np.float64], samples: NDArray[np.float64], valid: NDArray[np.bool_], median: float
) -> Gridded | None:
    """The samples as measured, on the grid that their stamps follow apart from missing rows; None if there is none."""
    intervals = np.diff(stamps)
    # The mean of the whole intervals is not misled by rounded stamps, whose median is one of the rounded values.
    step = intervals[intervals <= GAP * median].mean()
    strides = np.rint(intervals / step).astype(np.int64)
    if strides.min() < 1:
        return None
    index = np.concatenate([[0], np.cumsum(strides)])
    centred = index - index.mean()
    step = centred @ (stamps - stamps[0]) / (centred @ centred)
    start = stamps.mean() - step * index.mean()
    deviation = np.abs(stamps - start - step * index).max()
    digit = _rounding(stamps)
    # Rounding moves a stamp by half a digit, and the fitted line by a little.
    if deviation > max(JITTER * step, 0.6 * digit):
        return None
    time = start + step * np.arange(index[-1] + 1)
    if deviation <= max(1e-6 * step, 4 * np.spacing(np.abs(stamps).max())):
        time[index] = stamps
    if len(time) > len(stamps):
        full, measured = np.full((len(time), samples.shape[1]), np.nan), np.zeros(len(time), bool)
        full[index], measured[index] = samples, valid
        samples, valid = full, measured
    rounded = f"the time stamps are rounded to {digit:g} s; taken as evenly spaced at {1 / step:.6g} Hz"
    return time, samples, valid, [rounded] if deviation > JITTER * step else []


def _rounding(stamps: NDArray[np.float64]) -> float:
    """The decimal digit (1, 0.1, ... 1e-9 s) that all stamps are multiples of; 0 if there is none."""
    for digits in range(10):
        with np.errstate(all="ignore"):
            scaled = stamps * 10.0**digits
            multiple = np.abs(scaled - np.rint(scaled)).max() < 1e-3
        if multiple:
            return float(10.0**-digits)
    return 0.0


def _resampled(
    stamps: NDArray[np.float64], samples: NDArray[np.float64], valid: NDArray[np.bool_], median: float
) -> Gridded:
    """The samples interpolated at the median rate; inside gaps, and outside the valid samples, there is nothing."""
    from scipy.interpolate import PchipInterpolator

    time = stamps[0] + median * np.arange(int((stamps[-1] - stamps[0]) / median) + 1)
    known = stamps[valid]
    with np.errstate(all="ignore"):
        values = PchipInterpolator(known, samples[valid], extrapolate=False)(time)
    after = np.clip(np.searchsorted(known, time, side="left"), 1, len(known) - 1)
    in_gap = (known[after] - known[after - 1] > GAP * median) & (known[after - 1] < time) & (time < known[after])
    usable = ~in_gap & np.isfinite(values).all(axis=1)
    intervals = np.diff(stamps)
    note = (
        f"the sampling is uneven ({len(intervals)} intervals from {intervals.min():.6g} to {intervals.max():.6g} s): "
        f"resampled at the median rate of {1 / median:.6g} Hz"
    )
    return time, values, usable, [note]
