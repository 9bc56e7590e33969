"""What recorders do to time stamps: rows written twice, clocks that begin anew, rates that change in a file."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from jaximp.recordings.channels import Signal
from jaximp.recordings.errors import RecordingError
from jaximp.types import Numbers, listed

SHORTEST_PART, MOST_PARTS = 20, 50
"""A clock that begins anew divides a file into parts of so many rows at least, and so few."""
BLOCKS, OTHER_RATE = 40, 1.5
"""The rate has changed where the median intervals of neighbouring blocks of rows differ by more than this factor."""

Rows = tuple[Signal, dict[str, Signal], list[str]]
"""Clock, channels, and notes on what was done."""


def without_repeats(clock: Signal, signals: dict[str, Signal], duplicates: str | None) -> Rows:
    """The rows without those whose time stamp repeats the one before, where they say the same (or `duplicates` is
    `"drop"`).

    **Raises:** `RecordingError` for stamps that repeat with other values, for a clock that begins anew, and for a rate
    that changes.
    """
    if duplicates not in (None, "drop"):
        raise RecordingError(f'duplicates must be "drop", not {duplicates!r}')
    stamps = clock.values[:, 0]
    if not np.isfinite(stamps).all():
        return clock, signals, []
    repeats = np.r_[False, stamps[1:] == stamps[:-1]]
    notes = []
    if repeats.any():
        notes = [_repeats(clock.labels[0], stamps, repeats, _identical(signals), duplicates)]
        clock = replace(clock, values=clock.values[~repeats])
        signals = {channel: replace(one, values=one.values[~repeats]) for channel, one in signals.items()}
    kept = np.flatnonzero(~repeats)
    _refuse_restarts(clock.labels[0], clock.values[:, 0], kept)
    _refuse_two_rates(clock.labels[0], clock.values[:, 0], kept)
    return clock, signals, notes


def _identical(signals: dict[str, Signal]) -> NDArray[np.bool_]:
    """(N,) rows that say the same as the one before."""
    samples = np.hstack([signal.values for signal in signals.values()])
    same = (samples[1:] == samples[:-1]) | (np.isnan(samples[1:]) & np.isnan(samples[:-1]))
    return np.r_[False, same.all(axis=1)]


def _repeats(
    label: str, stamps: Numbers, repeats: NDArray[np.bool_], identical: NDArray[np.bool_], duplicates: str | None
) -> str:
    """The note on rows that are left out; refused where that would lose samples."""
    count, first = int(repeats.sum()), int(np.flatnonzero(repeats)[0]) + 1
    rows = f"{count} rows repeat" if count > 1 else "1 row repeats"
    if (identical | ~repeats).all():
        return f"{rows} the time stamp and all values of the one before (first: row {first}): left out"
    if duplicates == "drop":
        return f"{rows} the time stamp of the one before (first: row {first}): left out, as the mapping says"
    rate = (len(stamps) - 1) / (stamps[-1] - stamps[0]) if stamps[-1] > stamps[0] else 0.0
    such = f"{count} such rows" if count > 1 else "1 such row"
    remedy = f"sample_rate = {rate:.4g} (or the rate that was set)" if rate > 0 else "'sample_rate'"
    stamp = f"{stamps[first - 1]:.10g} s"
    raise RecordingError(
        f"{label!r}, row {first}: the time stamp {stamp} repeats the one before, with other values ({such}); if the "
        f"stamps are only rounded too coarsely, give {remedy} in place of "
        'time; if rows were written twice, duplicates = "drop" keeps the first of each'
    )


def _refuse_restarts(label: str, stamps: Numbers, kept: NDArray[np.int64]) -> None:
    """Several recordings in one file are told by their clock, which begins anew."""
    back = np.flatnonzero(np.diff(stamps) < 0) + 1
    if not len(back):
        return
    borders = np.r_[0, back, len(stamps)]
    steps = stamps[back - 1] - stamps[back]
    far = steps.min() > SHORTEST_PART / 2 * np.median(np.abs(np.diff(stamps)))
    if far and len(back) < MOST_PARTS and np.diff(borders).min() >= SHORTEST_PART:
        rows = np.r_[kept, kept[-1] + 1] + 1
        parts = [f"{rows[a]}-{rows[b] - 1}" for a, b in pairwise(borders)]
        shown = listed(parts if len(parts) <= 5 else [*parts[:3], "..."])
        first = parts[0].replace("-", ", ")
        raise RecordingError(
            f"{label!r}, row {kept[back[0]] + 1}: the clock steps backwards: {_number(len(parts))} recordings stand in "
            f"this file, in rows {shown}; name one with rows = [{first}], or several with the file and its rows once "
            "for each"
        )
    others = f" (and {len(back) - 1} more)" if len(back) > 1 else ""
    raise RecordingError(
        f"{label!r}, row {kept[back[0]] + 1}: the time stamp {stamps[back[0]]:.10g} s steps backwards{others}; sort or "
        "remove the rows, or give 'sample_rate' instead of 'time' if the stamps are of no use"
    )


def _number(count: int) -> str:
    return {2: "two", 3: "three", 4: "four", 5: "five"}.get(count, str(count))


def _refuse_two_rates(label: str, stamps: Numbers, kept: NDArray[np.int64]) -> None:
    """A recorder that was switched to another rate on the way; gaps and jitter do not change a block's median."""
    if len(stamps) < BLOCKS * SHORTEST_PART:
        return
    intervals = np.array_split(np.diff(stamps), BLOCKS)
    medians = np.array([np.median(block) for block in intervals])
    steady = [np.mean(np.abs(block - m) < 0.1 * m) > 0.8 for block, m in zip(intervals, medians, strict=True)]
    ratio = medians[1:] / medians[:-1]
    changes = np.flatnonzero(np.maximum(ratio, 1 / ratio) > OTHER_RATE)
    # The block in which it happened may be of either rate.
    if not len(changes) or changes[-1] - changes[0] > 1 or np.mean(steady) < 0.9:
        return
    before, after = np.median(medians[: changes[0] + 1]), np.median(medians[changes[-1] + 1 :])
    if max(before / after, after / before) < OTHER_RATE:
        return
    split = 1 + _change(np.diff(stamps), float(np.sqrt(before * after)), bool(before > after))
    raise RecordingError(
        f"{label!r}: the first {kept[split - 1] + 1} rows were sampled at {1 / before:.5g} Hz, and those after them at "
        f"{1 / after:.5g} Hz: name one part with rows = [1, {kept[split - 1] + 1}] or rows = [{kept[split - 1] + 2}, "
        f"{kept[-1] + 1}]"
    )


def _change(intervals: Numbers, border: float, falls: bool) -> int:
    """Where the intervals change from one side of a border to the other: what leaves the fewest on the wrong side."""
    low = intervals < border
    wrong_before = np.r_[0, np.cumsum(low if falls else ~low)]
    wrong_after = np.r_[np.cumsum((~low if falls else low)[::-1])[::-1], 0]
    return int(np.argmin(wrong_before + wrong_after))
