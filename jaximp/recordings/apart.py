"""Channels that stand in files of their own, with one clock or each with its own, joined on the recording's time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jaximp.recordings.channels import CHANNELS, Signal
from jaximp.recordings.errors import RecordingError
from jaximp.recordings.grid import GAP, check_stamps
from jaximp.recordings.readers.columns import values_at

FEWEST = 3
"""Samples that a channel shares with the recording, at least."""


def split_apart(entries: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """The entries of a mapping of the recording's own file, and those of channels that name another `file`.

    **Raises:** `RecordingError` for a position, which is what all others are joined on.
    """
    apart = {
        channel: dict(entry)
        for channel, entry in entries.items()
        if channel in CHANNELS and isinstance(entry, Mapping) and "file" in entry
    }
    if "position" in apart:
        raise RecordingError(
            "position: it is in the recording's own file; name that one as 'file', and another one in the tables of "
            "the channels that are elsewhere"
        )
    for channel, entry in apart.items():
        if not isinstance(entry["file"], str):
            raise RecordingError(f"{channel}: 'file' must be a path in quotes, not {entry['file']!r}")
    return {channel: entry for channel, entry in entries.items() if channel not in apart}, apart


def files_apart(table: Mapping[str, Any]) -> list[str]:
    """Files of single channels that a `[recording]` table names, as they are written."""
    entries = [table.get(channel) for channel in CHANNELS]
    named = [entry["file"] for entry in entries if isinstance(entry, Mapping) and "file" in entry]
    return list(dict.fromkeys(str(name) for name in named))


def found_in(table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The mapping with files of single channels that start at the job's folder."""

    def found(entry: Any) -> Any:
        inside = isinstance(entry, Mapping) and isinstance(entry.get("file"), str)
        return {**entry, "file": str(folder / entry["file"])} if inside else entry

    return {key: found(entry) if key in CHANNELS else entry for key, entry in table.items()}


def joined(channel: str, signal: Signal, own: Signal, clock: Signal, path: Path) -> tuple[Signal, list[str]]:
    """A channel at the times of the recording, linearly between its samples; NaN where it has none.

    **Arguments:** its `own` time stamps, and those of the recording (`clock`), in seconds of one clock.

    **Returns:** the channel, and notes on what was done.

    **Raises:** `RecordingError` where the two do not overlap.
    """
    stamps, at = own.values[:, 0], clock.values[:, 0]
    check_stamps(f"time of {path.name}", stamps)
    if len(stamps) != len(signal.values):
        raise RecordingError(f"{path.name}: its time has {len(stamps)} samples, its {channel} {len(signal.values)}")
    inside = (at >= stamps[0]) & (at <= stamps[-1])
    if inside.sum() < FEWEST:
        raise RecordingError(
            f"{channel}: {path.name} is from {stamps[0]:.6g} to {stamps[-1]:.6g} s and the recording from {at[0]:.6g} "
            f"to {at[-1]:.6g} s: both need times of one clock (a delay = ... in the table would move the channel)"
        )
    values = np.column_stack([values_at(at, stamps, column, GAP) for column in signal.values.T])
    interval, usual = np.median(np.diff(stamps)), np.median(np.diff(at))
    note = f"{channel} is that of {path.name}, joined on the time of the recording, linearly between its samples"
    notes = [f"{note}; they share {at[inside][-1] - at[inside][0]:.6g} s"]
    if interval > GAP * usual:
        notes.append(
            f"{channel} comes at {1 / interval:.4g} Hz and the recording at {1 / usual:.4g} Hz: nothing above "
            f"{0.5 / interval:.3g} Hz is in it, and filters must cut below"
        )
    return replace(signal, values=values), notes
