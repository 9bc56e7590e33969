"""The mapping: which columns of a file are which channel, as a `[recording]` table or `load_recording` names them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaximp.recordings.channels import CHANNELS
from jaximp.recordings.errors import RecordingError
from jaximp.types import JOINT_TYPES, nearest

Entry = str | Sequence[str] | Mapping[str, Any]
"""One channel of the mapping: a column, a list of columns, or `{column, unit, sign, gain, delay}`."""

KEYS = ("time", *CHANNELS, "sample_rate", "joint", "gear_ratio", "name")
"""The keys of a mapping, which are the keywords of `load_recording`."""


@dataclass(frozen=True)
class Source:
    """Where a channel comes from: `values = sign * gain * columns`, in `unit` (times `gain_unit` if it is given)."""

    columns: tuple[str, ...]
    unit: str | None = None
    sign: float = 1.0
    gain: float | None = None
    gain_unit: str | None = None
    delay: float | None = 0.0
    """How late it was recorded [s]; None where that is to be estimated."""
    noise: float | None = None
    """Standard deviation of the sensor's error, in `unit`."""


def check_mapping(table: Mapping[str, Any], where: str, *others: str) -> None:
    """Refuse a mapping of columns with a key that `load_recording` (and `others`) do not know, or without those that it
    needs."""
    known = [*others, *KEYS]
    for key in table:
        if key not in known:
            raise RecordingError(f"{where}: unknown key {key!r}; {nearest(str(key), known)}")
    for key in ("position", "torque"):
        if key not in table:
            raise RecordingError(f"{where}: '{key}' is missing; add it")


def source_of(channel: str, entry: Any) -> Source:
    """Check one entry of the mapping. Time and sample rate are a single column with a unit, and no more."""
    options = dict(entry) if isinstance(entry, Mapping) else {"column": entry}
    measured = ["sign", "gain", "delay"] if channel not in ("time", "sample_rate") else []
    allowed = ["column", "unit", *measured, *(["noise"] if channel == "position" else [])]
    for key in options:
        if key == "file":
            raise RecordingError(
                f"{channel}: all columns of a recording come from one file and have one time base; resample it at the "
                "times of the others, and write both into one file"
            )
        if key not in allowed:
            raise RecordingError(f"{channel}: unknown key {key!r}; {nearest(str(key), allowed)}")
    columns, unit, sign = options.get("column"), options.get("unit"), options.get("sign", 1)
    columns = [columns] if isinstance(columns, str) else columns
    if not isinstance(columns, list | tuple) or not columns or not all(isinstance(c, str) and c for c in columns):
        raise RecordingError(f"{channel}: {entry!r} names no column; give a name, a list of names or {{column = ...}}")
    if unit is not None and not isinstance(unit, str):
        raise RecordingError(f'{channel}: the unit must be text such as "deg", not {unit!r}')
    if not is_number(sign) or abs(sign) != 1:
        raise RecordingError(f"{channel}: sign must be 1 or -1, not {sign!r}")
    gain = _gain(channel, options.get("gain"))
    delay, noise = _delay(channel, options.get("delay", 0.0)), options.get("noise")
    if noise is not None and not (is_number(noise) and 0 < noise < math.inf):
        raise RecordingError(f"{channel}: noise must be the sensor's standard deviation, above 0, not {noise!r}")
    return Source(tuple(columns), unit, float(sign), *gain, delay, noise)


def _delay(channel: str, delay: Any) -> float | None:
    """Seconds, or None for "estimate"."""
    if delay == "estimate":
        if channel != "torque":
            raise RecordingError(f'{channel}: delay = "estimate" is that of the torque behind the position: move it')
        return None
    if not is_number(delay) or not math.isfinite(delay):
        others = ', or "estimate"' if channel == "torque" else ""
        raise RecordingError(f"{channel}: delay must be a number of seconds{others}, not {delay!r}")
    return float(delay)


def _gain(channel: str, gain: Any) -> tuple[float | None, str | None]:
    """The number and the unit of `2.5`, "2.5" or "35.1507 N/V"."""
    if gain is None:
        return None, None
    number, _, unit = gain.strip().partition(" ") if isinstance(gain, str) else (gain, "", "")
    try:
        value = math.nan if isinstance(number, bool) else float(number)
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value) or value == 0:
        raise RecordingError(f'{channel}: gain must be a number other than 0, not {gain!r}: write 2.5 or "35.15 N/V"')
    return value, unit.strip() or None


def joint_types(joint: str | Sequence[str], n: int) -> tuple[str, ...]:
    """The type of each of `n` joints."""
    joints = tuple(joint) if isinstance(joint, list | tuple) else (str(joint),) * n
    for kind in joints:
        if kind not in JOINT_TYPES:
            raise RecordingError(f"joint: unknown type {kind!r}; {nearest(str(kind), list(JOINT_TYPES))}")
    if len(joints) != n:
        raise RecordingError(f"joint: {len(joints)} types for {n} position columns; give one type, or one per column")
    return joints


def given(channel: str, entry: Any) -> bool:
    """Position and torque count as given, so that a None in their place is reported."""
    return entry is not None or channel in ("position", "torque")


def is_number(value: Any) -> bool:
    """Whether it is a real number, of Python or numpy; True and False are none."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
