"""Lines of text to samples: JSON objects, or CSV with or without a header."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaximp.live.clock import NOTHING, Batch
from jaximp.recordings.channels import Signal
from jaximp.recordings.mapping import given, joint_types, source_of
from jaximp.recordings.units import to_si
from jaximp.types import Numbers

CHANNELS = ("time", "position", "torque")
MOST_BYTES = 1 << 16
"""Of a line; longer ones are no samples."""


@dataclass(frozen=True)
class Columns:
    """How samples are called, and what brings them to SI units at the joint."""

    name: Mapping[str, str | int] = field(default_factory=dict)
    """Of a channel, its column; channels may always go by their own names, in SI units."""
    factor: Mapping[str, float] = field(default_factory=dict)
    sample_rate: float | None = None
    """Of samples without a time [Hz], which are then counted."""

    def of(self, row: Mapping[str, Any], channel: str) -> tuple[Any, float]:
        """Its value and factor in a row.

        **Raises:** `KeyError` where it is not there."""
        named = str(self.name.get(channel, channel))
        return (row[named], self.factor.get(channel, 1.0)) if named in row else (row[channel], 1.0)


def columns_of(table: Mapping[str, Any]) -> tuple[Columns, tuple[str, ...]]:
    """Columns as a job's `[recording]` table maps them, and the type of the joint.

    **Raises:** `ValueError` for several joints, and for a delay, which is not taken out live.
    """
    names: dict[str, str | int] = {}
    factors: dict[str, float] = {}
    joints = joint_types(table.get("joint", "revolute"), 1)
    for channel in CHANNELS:
        if not given(channel, table.get(channel)):
            continue
        source = source_of(channel, table.get(channel))
        if len(source.columns) != 1:
            raise ValueError(f"monitor identifies one joint, but [recording] maps {len(source.columns)} of {channel}")
        if source.delay != 0:
            raise ValueError(
                f"[recording] {channel}: a delay is not taken out live: set it to 0, or let the sender do so"
            )
        label = str(source.columns[0])
        signal, _ = to_si(channel, Signal((label,), np.ones((1, 1))), source, joints, table.get("gear_ratio", 1.0))
        names[channel], factors[channel] = source.columns[0], float(signal.values[0, 0])
    rate = table.get("sample_rate")
    return Columns(names, factors, float(rate) if isinstance(rate, int | float) else None), joints


@dataclass
class LineReader:
    """Bytes in, samples out. A stream is either JSON or CSV, as its first line is."""

    columns: Columns = field(default_factory=Columns)
    unreadable: int = 0
    """Lines that were none of samples."""
    _rest: bytes = b""
    _header: list[str] | None = None
    _too_long: bool = False
    _counted: int = 0

    def take(self, data: bytes) -> Batch:
        """Samples of all lines that are complete."""
        *lines, rest = (self._rest + data).split(b"\n")
        if self._too_long and lines:
            lines, self._too_long = lines[1:], False
        self._rest = rest
        if len(rest) > MOST_BYTES:
            self._rest, self._too_long = b"", True
            self.unreadable += 1
        return self.samples(lines)

    def finish(self) -> Batch:
        """Samples of a last line without an end."""
        rest, self._rest = self._rest, b""
        return self.samples([rest])

    def samples(self, lines: Sequence[bytes]) -> Batch:
        """Of complete lines."""
        found: list[tuple[Any, ...]] = []
        for raw in lines:
            line = raw.strip(b"\r\n \xef\xbb\xbf")
            if not line:
                continue
            try:
                if len(line) > MOST_BYTES:
                    raise ValueError
                one = self._of_json(line) if line.startswith(b"{") else self._of_csv(line.decode("utf-8"))
            except (ValueError, KeyError, TypeError, RecursionError, OverflowError):
                self.unreadable += 1
                continue
            if one is not None:
                found.append(one)
        if not found:
            return NOTHING
        return Batch(*(np.concatenate(parts) for parts in zip(*found, strict=True)))

    def _of_json(self, line: bytes) -> tuple[Any, ...]:
        row = json.loads(line)
        parts = [np.atleast_1d(np.asarray(_numbers(value), float)) * factor for value, factor in self._channels(row)]
        parts = self._with_time(parts)
        if any(part.ndim != 1 or len(part) != len(parts[0]) for part in parts):
            raise ValueError
        return tuple(parts)

    def _channels(self, row: Mapping[str, Any]) -> list[tuple[Any, float]]:
        """Of time, position and torque; of the last two where time is to be counted."""
        untimed = self.columns.sample_rate is not None and "time" not in row and "time" not in self.columns.name
        return [self.columns.of(row, channel) for channel in CHANNELS[untimed:]]

    def _with_time(self, parts: list[Numbers]) -> list[Numbers]:
        if len(parts) == len(CHANNELS) or self.columns.sample_rate is None:
            return parts
        first, self._counted = self._counted, self._counted + len(parts[0])
        return [np.arange(first, self._counted) / self.columns.sample_rate, *parts]

    def _of_csv(self, line: str) -> tuple[Any, ...] | None:
        delimiter = next((one for one in (";", "\t") if one in line), ",")
        fields = [one.strip() for one in next(csv.reader([line], delimiter=delimiter))]
        if not any(map(_is_number, fields)):
            if not set(map(str, self.columns.name.values())) & set(fields) and not set(CHANNELS[1:]) <= set(fields):
                raise ValueError
            self._header = fields
            return None
        if self._header is not None:
            row: Mapping[str, Any] = dict(zip(self._header, fields, strict=True))
        elif self.columns.name and all(type(column) is int for column in self.columns.name.values()):
            row = {str(k + 1): one for k, one in enumerate(fields)}
        else:
            row = dict(zip(CHANNELS[len(fields) == 2 :], fields, strict=True))
        parts = [np.array([_number(value) * factor]) for value, factor in self._channels(row)]
        return tuple(self._with_time(parts))


def _numbers(value: Any) -> Any:
    """JSON has no NaN: null stands for it."""
    if isinstance(value, list):
        return [_numbers(one) for one in value]
    if isinstance(value, bool) or not isinstance(value, int | float | None):
        raise ValueError
    return np.nan if value is None else value


def _number(text: str) -> float:
    return float(text) if text else np.nan


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
