"""The mapping: which columns of a file are which channel, as a `[recording]` table or `load_recording` names them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaximp.recordings.channels import CHANNELS
from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers.found import TextOptions
from jaximp.types import JOINT_TYPES, nearest

Entry = str | int | Sequence[str | int] | Mapping[str, Any]
"""One channel of the mapping: a column by its name or number, a list of these, or `{columns, unit, sign, gain, delay}`.
"""

TEXT_KEYS = ("header", "separator", "decimal", "encoding", "bad_lines")
"""Keys that say how a text file is written."""
KEYS = ("time", *CHANNELS, "sample_rate", "joint", "gear_ratio", "name", "rows", "duplicates", *TEXT_KEYS)
"""The keys of a mapping, which are the keywords of `load_recording`."""


@dataclass(frozen=True)
class GainError:
    """Standard deviations of gains, as shares: what all columns have in common, and what each has by itself."""

    common: float
    each: tuple[float, ...]
    """One for all columns, or one for each."""

    def covariance(self, n: int) -> NDArray[np.float64]:
        """(n, n) of the relative errors of n columns."""
        return self.common**2 + np.diag(np.broadcast_to(self.each, n) ** 2)


@dataclass(frozen=True)
class Source:
    """Where a channel comes from: `values = sign * gain * columns`, in `unit` (times `gain_unit` if it is given)."""

    columns: tuple[str | int, ...]
    unit: str | None = None
    sign: float = 1.0
    gain: tuple[float, ...] | None = None
    """One for all columns, or one for each."""
    gain_unit: str | None = None
    delay: float | None = 0.0
    """How late it was recorded [s]; None where that is to be estimated."""
    noise: float | None = None
    """Standard deviation of the sensor's error, in `unit`."""
    gain_error: GainError | None = None
    """What is not known of the gain."""
    despite_name: bool = False
    """Whether `unit` holds although the column's name says another."""


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
    own = {"position": ["noise"], "torque": ["gain_error"]}.get(channel, [])
    allowed = ["column", "columns", "unit", "despite_name", *measured, *own]
    for key in options:
        if key == "file":
            raise RecordingError(
                f"{channel}: here all columns come from one file; a channel of [recording] alone, but the position, "
                "may name another"
            )
        if key not in allowed:
            raise RecordingError(f"{channel}: unknown key {key!r}; {nearest(str(key), allowed)}")
    columns, unit, sign = columns_of(options), options.get("unit"), options.get("sign", 1)
    if not columns or ("column" in options) == ("columns" in options):
        raise RecordingError(
            f"{channel}: {entry!r} names no column; give a name (or its number, from 1), a list of these, or "
            "{columns = ...}"
        )
    if unit is not None and not isinstance(unit, str):
        raise RecordingError(f'{channel}: the unit must be text such as "deg", not {unit!r}')
    if not is_number(sign) or abs(sign) != 1:
        raise RecordingError(f"{channel}: sign must be 1 or -1, not {sign!r}")
    gain = _gains(channel, options.get("gain"), len(columns))
    gain_error = _gain_error(channel, options.get("gain_error"), len(columns))
    delay, noise = _delay(channel, options.get("delay", 0.0)), options.get("noise")
    if noise is not None and not (is_number(noise) and 0 < noise < math.inf):
        raise RecordingError(f"{channel}: noise must be the sensor's standard deviation, above 0, not {noise!r}")
    despite_name = options.get("despite_name", False)
    if not isinstance(despite_name, bool):
        raise RecordingError(f"{channel}: despite_name must be true or false, not {despite_name!r}")
    return Source(columns, unit, float(sign), *gain, delay, noise, gain_error, despite_name)


def text_options(given: Mapping[str, Any]) -> TextOptions:
    """What a mapping says of how a text file is written, checked."""
    for key, kind, example in (
        ("header", int, "3, the line of the names"),
        ("separator", str, '";" or "whitespace"'),
        ("decimal", str, '","'),
        ("encoding", str, '"cp1252"'),
        ("bad_lines", str, '"drop"'),
    ):
        value = given.get(key)
        if value is not None and (not isinstance(value, kind) or isinstance(value, bool)):
            raise RecordingError(f"{key} must be such as {example}, not {value!r}")
    if given.get("decimal") not in (None, ".", ","):
        raise RecordingError(f'decimal must be "." or ",", not {given["decimal"]!r}')
    if given.get("bad_lines") not in (None, "drop"):
        raise RecordingError(f'bad_lines must be "drop", not {given["bad_lines"]!r}')
    return TextOptions(**{key: given[key] for key in TEXT_KEYS if given.get(key) is not None})


def columns_of(entry: Any) -> tuple[str | int, ...]:
    """The columns of one entry of a mapping, by name or by number; none where it names none."""
    columns = entry.get("columns", entry.get("column")) if isinstance(entry, Mapping) else entry
    several = tuple(columns) if isinstance(columns, list | tuple) else (columns,)
    numbers = [type(one) is int and one > 0 for one in several]
    names = [isinstance(one, str) and bool(one) for one in several]
    return several if all(a or b for a, b in zip(numbers, names, strict=True)) else ()


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


def _gains(channel: str, gain: Any, columns: int) -> tuple[tuple[float, ...] | None, str | None]:
    """Of all columns, or of each of them."""
    if gain is None:
        return None, None
    several = gain if isinstance(gain, list | tuple) else [gain]
    _check_count(channel, "gain", len(several), columns)
    found = [_gain(channel, one) for one in several]
    units = {unit for _, unit in found}
    if len(units) != 1:
        raise RecordingError(f"{channel}: the gains {gain!r} have different units: give all of them in one")
    return tuple(value for value, _ in found), units.pop()


def _check_count(channel: str, key: str, given: int, columns: int) -> None:
    # A single variable of a file may hold the columns of all joints: how many is seen when it is read.
    if given != 1 and columns != 1 and given != columns:
        raise RecordingError(f"{channel}: {key} lists {given} numbers for {columns} columns: give one, or one for each")


def _gain_error(channel: str, error: Any, columns: int) -> GainError | None:
    """From per cent: one number, or `{ common = 10, each = 3 }`, of which each may be a list."""
    if error is None:
        return None
    parts = dict(error) if isinstance(error, Mapping) else {"each": error}
    for key in parts:
        if key not in ("common", "each"):
            hint = nearest(str(key), ["common", "each"])
            raise RecordingError(f"{channel}: unknown key {key!r} in gain_error; {hint}")
    common, each = parts.get("common", 0), parts.get("each", 0)
    several = each if isinstance(each, list | tuple) else [each]
    _check_count(channel, "gain_error", len(several), columns)
    if not all(is_number(one) and 0 <= one < math.inf for one in (common, *several)):
        raise RecordingError(
            f"{channel}: gain_error is {error!r}: give per cent, zero or more, such as 3 or {{ common = 10, each = 3 }}"
        )
    return GainError(common / 100, tuple(one / 100 for one in several))


def _gain(channel: str, gain: Any) -> tuple[float, str | None]:
    """The number and the unit of `2.5`, "2.5" or "35.1507 N/V"."""
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
