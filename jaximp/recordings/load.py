"""Files <-> `Recording`: the only place that reads measurements.

A file is read in three steps: the columns that the mapping names (`readers`), their conversion to SI at the joint
(`_to_si`), and the checks that bring every channel onto one uniform time grid (`_assemble`). Whatever was changed on
the way is told in `Recording.notes`; whatever cannot be used is a `ValueError` of one line that names the cause and
the remedy.
"""

from __future__ import annotations

import inspect
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaximp.recordings.readers import RecordingError, read_columns
from jaximp.types import JOINT_TYPES, Recording, nearest

__all__ = [
    "RecordingError",
    "check_mapping",
    "load_recording",
    "load_trial_table",
    "recording_from_arrays",
    "recording_from_mapping",
    "save_recording",
    "save_trial_table",
]

Entry = str | Sequence[str] | Mapping[str, Any]
"""One channel of the mapping: a column, a list of columns, or `{column, unit, sign, gain}`."""

JITTER = 0.01
"""Stamps that differ from a uniform grid by less than this share of an interval are taken as even."""
GAP = 1.5
"""An interval longer than this many median intervals is a gap."""
LARGEST_GROWTH = 50
"""The uniform grid has at most this many samples for each measured one."""
MOST_GRID = 1_000_000_000
"""Samples of a uniform grid at most."""

_SI = {
    "revolute": {"position": "rad", "velocity": "rad/s", "acceleration": "rad/s^2", "torque": "N m", "command": "N m"},
    "prismatic": {"position": "m", "velocity": "m/s", "acceleration": "m/s^2", "torque": "N", "command": "N"},
}
_CHANNELS = ("position", "torque", "velocity", "acceleration", "force", "reference", "command")
_SUFFIXES = {
    **{unit: unit for unit in ("deg", "mrad", "rad", "mm", "cm", "m", "s", "ms", "us", "N", "V", "Hz", "kHz", "rpm")},
    **{"Nm": "N m", "mNm": "mN m", "rad_s": "rad/s", "deg_s": "deg/s", "m_s": "m/s", "mm_s": "mm/s"},
    **{"rad_s2": "rad/s^2", "deg_s2": "deg/s^2", "m_s2": "m/s^2"},
}
"""What the end of a column's name says about its unit: `knee_deg`. Also names the columns that we write."""


@dataclass(frozen=True)
class _Signal:
    """One channel: `values` (N, k) and a label for each of its columns."""

    labels: tuple[str, ...]
    values: NDArray[np.float64]


@dataclass(frozen=True)
class _Source:
    """Where a channel comes from: `values = sign * gain * columns`, in `unit` (times `gain_unit` if it is given)."""

    columns: tuple[str, ...]
    unit: str | None = None
    sign: float = 1.0
    gain: float | None = None
    gain_unit: str | None = None


# --- the public functions ---------------------------------------------------------------------------------------------


def load_recording(
    path: str | os.PathLike[str],
    *,
    time: Entry | None = None,
    position: Entry,
    torque: Entry,
    velocity: Entry | None = None,
    acceleration: Entry | None = None,
    force: Entry | None = None,
    reference: Entry | None = None,
    command: Entry | None = None,
    sample_rate: float | Entry | None = None,
    joint: str | Sequence[str] = "revolute",
    gear_ratio: float = 1.0,
    name: str | None = None,
) -> Recording:
    """Read a recording; the keywords are the keys of a job file's `[recording]` table.

    **Arguments:**

    - `path`: .csv, .txt or .tsv (comma, semicolon or tab), .parquet, .mat (v5 or v7.3), .h5, .hdf5 or .npz. A column
      is a header's name, a variable (`data.q` inside a MATLAB struct) or a dataset's path; MATLAB, HDF5 and NPZ
      variables may be (N, n), one column per joint.
    - `time` [s] (a column, or `{column, unit}`) or else `sample_rate`: a number [Hz], or a scalar variable in the file.
    - `position`, `torque`, `velocity`, `acceleration`, `force`, `reference`, `command`: a column, a list of columns
      (one per joint), or `{column = ..., unit = "deg", sign = -1, gain = 2.5}`. Without `unit`, that of the channel:
      rad, N m, rad/s, rad/s^2 (prismatic: m, N, m/s, m/s^2), force N; `reference` is a position, `command` (the
      perturbation) a torque. A bare `gain` multiplies the column and `unit` is that of the product; with
      `gain = "35.1507 N/V"`, `unit` is that of the column.
    - `joint`: `revolute` or `prismatic`, or a list of these, one per joint.
    - `gear_ratio`: motor turns per joint turn, if the columns were measured at the motor: position, velocity,
      acceleration and reference are divided by it, torque and command are multiplied; `force` acts at the endpoint and
      stays.

    **Returns:** the recording on a uniform grid; see `recording_from_arrays` for sampling, gaps and NaN.

    **Raises:** `FileNotFoundError`; else `ValueError` with one line that names the file, the cause and the remedy.
    """
    entries: dict[str, Any] = {"position": position, "torque": torque, "velocity": velocity, "force": force}
    entries |= {"acceleration": acceleration, "reference": reference, "command": command, "time": time}
    path = _existing(path)
    with _named(str(path)):
        signals, joints = _read_signals(path, entries, sample_rate, joint, gear_ratio)
        return _assemble(_stamps(signals, sample_rate), signals, joints, path.stem if name is None else name)


def load_trial_table(path: str | os.PathLike[str], trial: str = "trial", **mapping: Any) -> list[Recording]:
    """Read the trials that stand in one file below one another, told apart by the numbers in a column.

    **Arguments:** `path` and `mapping` as in `load_recording`; `trial` the column with the numbers. Rows of one number
    are one trial, and its time may restart or run on; rows without a number (NaN) belong to none.

    **Returns:** one recording each, in the order of first appearance, called `<file>, trial <number>`.

    **Raises:** as `load_recording`, with the trial's number after the file's name.
    """
    check_mapping(mapping, f"the columns of {path}")
    path = _existing(path)
    rate = mapping.get("sample_rate")
    channels = {key: mapping[key] for key in mapping if key not in ("sample_rate", "joint", "gear_ratio", "name")}
    options = (rate, mapping.get("joint", "revolute"), mapping.get("gear_ratio", 1.0))
    with _named(str(path)):
        signals, joints = _read_signals(path, channels | {"trial": trial}, *options)
        numbers = signals.pop("trial").values[:, 0]
        scalar = {key: signals.pop(key) for key in ("sample_rate",) if key in signals}
        _check_lengths([(trial, numbers[:, None]), *((s.labels[0], s.values) for s in signals.values())])
        _, first = np.unique(numbers[~np.isnan(numbers)], return_index=True)
        in_order = numbers[~np.isnan(numbers)][np.sort(first)]
        if not len(in_order):
            raise RecordingError(f"column {trial!r} has no trial number: name the column that tells the trials apart")
    recordings = []
    for number in in_order:
        rows = numbers == number
        with _named(f"{path}, trial {number:g}"):
            part = {key: _Signal(signal.labels, signal.values[rows]) for key, signal in signals.items()} | scalar
            recordings.append(_assemble(_stamps(part, rate), part, joints, f"{path.stem}, trial {number:g}"))
    return recordings


def _existing(path: str | os.PathLike[str]) -> Path:
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file; check the path")
    return path


@contextmanager
def _named(where: str) -> Iterator[None]:
    """Errors begin with the file that they are about."""
    try:
        yield
    except RecordingError as error:
        raise type(error)(f"{where}: {error}") from None


def _read_signals(
    path: Path, entries: Mapping[str, Any], sample_rate: Any, joint: str | Sequence[str], gear_ratio: float
) -> tuple[dict[str, _Signal], tuple[str, ...]]:
    """All channels of a file in SI units, the clock among them, and the joints; a `trial` column as it is."""
    if (entries.get("time") is None) == (sample_rate is None):
        raise RecordingError("give either 'time' (a column) or 'sample_rate' (in Hz), one of the two")
    entries = {**entries, "sample_rate": None if _is_number(sample_rate) else sample_rate}
    sources = {channel: _source(channel, entry) for channel, entry in entries.items() if _given(channel, entry)}
    columns = read_columns(path, [column for source in sources.values() for column in source.columns])
    signals = {channel: _stack(source.columns, columns) for channel, source in sources.items()}
    joints = _joints(joint, signals["position"].values.shape[1])
    converted = {
        key: signal if key == "trial" else _to_si(key, signal, sources[key], joints, gear_ratio)
        for key, signal in signals.items()
    }
    return converted, joints


def recording_from_mapping(table: Mapping[str, Any], folder: str | os.PathLike[str]) -> Recording:
    """The recording that a job file's `[recording]` table describes.

    **Arguments:** `table` the keywords of `load_recording`, and `file`; `folder` where a relative `file` starts.

    **Raises:** `ValueError` for an unknown or missing key, and as `load_recording`.
    """
    check_mapping(table, "[recording]", "file")
    if "file" not in table:
        raise RecordingError("[recording]: 'file' is missing; add it")
    if not isinstance(table["file"], str):
        raise RecordingError(f"[recording]: 'file' must be a path in quotes, not {table['file']!r}")
    return load_recording(Path(folder) / table["file"], **{key: table[key] for key in table if key != "file"})


def check_mapping(table: Mapping[str, Any], where: str, *others: str) -> None:
    """Refuse a mapping of columns with a key that `load_recording` (and `others`) do not know, or without those that it
    needs."""
    known = [*others, *_keywords()]
    for key in table:
        if key not in known:
            raise RecordingError(f"{where}: unknown key {key!r}; {nearest(str(key), known)}")
    for key in ("position", "torque"):
        if key not in table:
            raise RecordingError(f"{where}: '{key}' is missing; add it")


@lru_cache(maxsize=1)
def _keywords() -> tuple[str, ...]:
    return tuple(inspect.signature(load_recording).parameters)[1:]


def recording_from_arrays(
    time: ArrayLike,
    position: ArrayLike,
    torque: ArrayLike,
    *,
    velocity: ArrayLike | None = None,
    acceleration: ArrayLike | None = None,
    force: ArrayLike | None = None,
    reference: ArrayLike | None = None,
    command: ArrayLike | None = None,
    joint: str | Sequence[str] = "revolute",
    name: str = "recording",
) -> Recording:
    """A recording from arrays in SI units, after the same checks as a file.

    **Arguments:** `time` (N,) [s]; the others (N,) or (N, n), `force` (N, k) [N]; `joint` as in `load_recording`.

    **Sampling.** Stamps within 1 % of an interval of a uniform grid (or within their own decimal rounding, which is
    noted) keep their samples unchanged; rows missing from such a grid (fewer than half) become masked samples. Others
    are resampled at the median rate by monotone cubic (PCHIP) interpolation. Grid points strictly inside a gap, an
    interval longer than 1.5 times the median, are masked, and so is a sample with NaN in any channel: False in
    `valid`, NaN in every array. All of this is told in `notes`.

    **Raises:** `ValueError` for stamps that do not increase, infinite values, a signal that is constant or all NaN,
    fewer than 3 samples, shapes that do not match, or a gap that would make the grid 50 times as long as the data.
    """
    arrays = zip(_CHANNELS, (position, torque, velocity, acceleration, force, reference, command), strict=True)
    signals = {channel: _stack((channel,), {channel: values}) for channel, values in arrays if _given(channel, values)}
    signals["time"] = _stack(("time",), {"time": time})
    joints = _joints(joint, signals["position"].values.shape[1])
    return _assemble(_stamps(signals, None), signals, joints, name)


def save_recording(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write a recording as CSV or Parquet, by extension; `load_recording` reads it back equal.

    Columns: `time_s`, `position_rad` (`position1_rad`, ... for several joints; `_m` if prismatic), `torque_Nm`
    (`torque_N`), and the optional channels alike; a masked sample is NaN. The file appears whole or not at all.

    **Raises:** `ValueError` for another extension.
    """
    _write_columns(_named_columns(recording), Path(path))


def save_trial_table(recordings: Sequence[Recording], path: str | os.PathLike[str]) -> None:
    """Write trials below one another into one CSV or Parquet file, which `load_trial_table` reads back equal.

    Columns as in `save_recording`, and `trial`, which counts from 1.

    **Raises:** `ValueError` for another extension, for no trials, and for channels that only some trials have.
    """
    tables = [_named_columns(recording) for recording in recordings]
    if not tables or any(list(table) != list(tables[0]) for table in tables):
        raise RecordingError(f"{path}: the trials must be at least one, and have the same channels: complete them")
    columns = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    numbers = np.repeat(np.arange(1, len(tables) + 1), [len(recording) for recording in recordings])
    _write_columns({"trial": numbers, **columns}, Path(path))


def _write_columns(columns: Mapping[str, NDArray[Any]], path: Path) -> None:
    """A table that appears whole or not at all."""
    import pyarrow
    import pyarrow.csv
    import pyarrow.parquet

    writers = {".csv": pyarrow.csv.write_csv, ".parquet": pyarrow.parquet.write_table}
    if path.suffix.lower() not in writers:
        raise RecordingError(f"{path}: cannot write '{path.suffix}' files; use one of: {', '.join(writers)}")
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.unfinished")
    try:
        with unfinished.open("wb") as file:
            writers[path.suffix.lower()](pyarrow.table(dict(columns)), file)
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def _named_columns(recording: Recording) -> dict[str, NDArray[np.float64]]:
    """Column name -> (N,) values, as `save_recording` describes."""
    suffix_of = {unit: suffix for suffix, unit in _SUFFIXES.items()}
    columns = {"time_s": recording.time}
    for channel in _CHANNELS:
        values = getattr(recording, channel)
        if values is None:
            continue
        for i, column in enumerate(values.T):
            number = str(i + 1) if values.shape[1] > 1 else ""
            unit = _si_unit(channel, recording.joints[min(i, recording.n_joints - 1)])
            columns[f"{channel}{number}_{suffix_of[unit]}"] = np.where(recording.valid, column, np.nan)
    return columns


# --- the mapping: which columns, in which units -----------------------------------------------------------------------


def _source(channel: str, entry: Any) -> _Source:
    """Check one entry of the mapping. Time and sample rate are a single column with a unit, and no more."""
    options = dict(entry) if isinstance(entry, Mapping) else {"column": entry}
    allowed = ["column", "unit"] if channel in ("time", "sample_rate") else ["column", "unit", "sign", "gain"]
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
    if not _is_number(sign) or abs(sign) != 1:
        raise RecordingError(f"{channel}: sign must be 1 or -1, not {sign!r}")
    return _Source(tuple(columns), unit, float(sign), *_gain(channel, options.get("gain")))


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


def _joints(joint: str | Sequence[str], n: int) -> tuple[str, ...]:
    """The type of each of `n` joints."""
    joints = tuple(joint) if isinstance(joint, list | tuple) else (str(joint),) * n
    for kind in joints:
        if kind not in JOINT_TYPES:
            raise RecordingError(f"joint: unknown type {kind!r}; {nearest(str(kind), list(JOINT_TYPES))}")
    if len(joints) != n:
        raise RecordingError(f"joint: {len(joints)} types for {n} position columns; give one type, or one per column")
    return joints


def _to_si(channel: str, signal: _Signal, source: _Source, joints: tuple[str, ...], gear_ratio: float) -> _Signal:
    """The channel in SI units at the joint."""
    if not _is_number(gear_ratio) or not 0 < gear_ratio < math.inf:
        raise RecordingError(f"gear_ratio must be a positive number, not {gear_ratio!r}")
    gear = {"torque": gear_ratio, "command": gear_ratio, "force": 1.0, "time": 1.0, "sample_rate": 1.0}.get(
        channel, 1 / gear_ratio
    )
    # A force may have more columns than there are joints; for the other channels `_assemble` reports a wrong count.
    kinds = [joints[min(i, len(joints) - 1)] for i in range(len(signal.labels))]
    units = [_si_unit(channel, kind) for kind in kinds]
    factors = [_unit_factor(channel, source, *pair) for pair in zip(signal.labels, units, strict=True)]
    with np.errstate(over="ignore"):
        values = signal.values * (np.array(factors) * source.sign * (source.gain or 1.0) * gear)
    return _Signal(signal.labels, values)


def _si_unit(channel: str, joint: str) -> str:
    fixed = {"time": "s", "sample_rate": "Hz", "force": "N"}
    return fixed.get(channel) or _SI[joint]["position" if channel == "reference" else channel]


def _unit_factor(channel: str, source: _Source, label: str, target: str) -> float:
    """What brings a column (times the unit of its gain) to the unit `target`."""
    if source.unit is None and source.gain is None:
        _check_suffix(channel, re.sub(r"\[\d+\]$", "", label), target)
    if source.gain_unit is None:
        return _conversion(channel, target, source.unit or target)
    return _conversion(channel, target, source.unit or "dimensionless", source.gain_unit)


def _check_suffix(channel: str, column: str, target: str) -> None:
    """Refuse to read `knee_deg` in radians because nobody said otherwise."""
    suffix = max((suffix for suffix in _SUFFIXES if column.endswith("_" + suffix)), key=len, default=None)
    if suffix and _SUFFIXES[suffix] != target:
        raise RecordingError(
            f"{channel}: the name of column {column!r} says '{_SUFFIXES[suffix]}', but without a unit it would be read "
            f'in \'{target}\'; state the unit: {channel} = {{column = "{column}", unit = "{_SUFFIXES[suffix]}"}}'
        )


_UNIT = re.compile(r"(1|[A-Za-zµμ°Ω%_]+)((\^|\*\*)-?\d)?([ ·*/]+(1|[A-Za-zµμ°Ω%_]+)((\^|\*\*)-?\d)?)*")


@lru_cache(maxsize=256)
def _conversion(channel: str, target: str, *units: str) -> float:
    """The factor from the product of `units` to `target`. Plain spellings of `target` do not need pint."""
    if len(units) == 1 and units[0].replace("Nm", "N m").replace("N*m", "N m").replace("**", "^") == target:
        return 1.0
    registry = _unit_registry()
    product = registry.Quantity(1.0)
    for unit in units:
        try:
            # The pattern keeps everything but units and small exponents away from pint's expression parser.
            if not _UNIT.fullmatch(re.sub("[()]", "", unit)):
                raise ValueError
            product = product * registry.Quantity(1.0, registry.parse_units(unit))
        except Exception:
            raise RecordingError(
                f"{channel}: unknown unit {unit!r}; expected a unit of '{target}', or one that converts to it"
            ) from None
    # pint counts radians as 1 and would take Hz for rad/s; root units keep the radian and tell them apart.
    if product.to_root_units().units != registry.Quantity(1.0, target).to_root_units().units:
        raise RecordingError(f"{channel}: unit '{' * '.join(units)}' does not convert to '{target}'; correct the unit")
    return float(product.to(target).magnitude)


@lru_cache(maxsize=1)
def _unit_registry() -> Any:
    import pint

    registry: Any = pint.UnitRegistry(cache_folder=None)
    registry.define("Nm = newton * meter")
    return registry


def _given(channel: str, entry: Any) -> bool:
    """Position and torque count as given, so that a None in their place is reported."""
    return entry is not None or channel in ("position", "torque")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


# --- columns -> channels ----------------------------------------------------------------------------------------------


def _stack(columns: Sequence[str], values: Mapping[str, Any]) -> _Signal:
    """The columns of one channel side by side; a 2-D variable brings one column per joint."""
    parts = [(column, _as_columns(column, values[column])) for column in columns]
    _check_lengths(parts)
    labels = [
        column if part.shape[1] == 1 else f"{column}[{i + 1}]" for column, part in parts for i in range(part.shape[1])
    ]
    return _Signal(tuple(labels), np.hstack([part for _, part in parts]))


def _as_columns(label: str, values: Any) -> NDArray[np.float64]:
    """(N, n) float64 from a scalar, a row or column vector, or an (N, n) matrix."""
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise RecordingError(f"{label!r} does not hold real numbers (it is {array.dtype}); name a numeric one")
    if array.ndim > 2:
        raise RecordingError(f"{label!r} has shape {array.shape}; it must be a vector, or (samples, joints)")
    if array.ndim < 2 or array.shape[0] == 1 or not array.size:
        array = array.reshape(-1, 1)
    return array.astype(np.float64)


def _check_lengths(arrays: Sequence[tuple[str, NDArray[np.float64]]]) -> None:
    first, reference = arrays[0]
    for label, array in arrays[1:]:
        if len(array) != len(reference):
            raise RecordingError(
                f"{first!r} has {len(reference)} samples, but {label!r} has {len(array)}; they must be equally long, "
                "with the samples along the first axis and one time base (else resample one of them)"
            )


def _stamps(signals: dict[str, _Signal], sample_rate: Any) -> _Signal:
    """Take the clock out of the signals: (N, 1) time stamps, measured or from a rate (a number, or from the file)."""
    if "time" in signals:
        return signals.pop("time")
    rate = signals.pop("sample_rate").values if "sample_rate" in signals else np.array([[float(sample_rate)]])
    if rate.size != 1 or not 0 < rate.item() < math.inf:
        raise RecordingError(f"sample_rate must be one positive number in Hz, not {rate.ravel()[:3].tolist()}")
    with np.errstate(over="ignore"):
        return _Signal(("sample_rate",), np.arange(len(signals["position"].values))[:, None] / rate)


# --- channels -> a recording on a uniform grid ------------------------------------------------------------------------


def _assemble(clock: _Signal, signals: dict[str, _Signal], joints: tuple[str, ...], name: str) -> Recording:
    """Check every channel and bring all of them onto one uniform grid."""
    _check_shapes(clock, signals, len(joints))
    stamps = clock.values[:, 0]
    _check_stamps(clock.labels[0], stamps)
    labels = [label for signal in signals.values() for label in signal.labels]
    samples = np.hstack([signal.values for signal in signals.values()])
    valid, notes = _complete_rows(labels, samples)
    for channel in ("position", "torque"):
        notes += _check_motion(channel, signals[channel], valid)
    time, samples, valid, sampling_notes = _on_uniform_grid(stamps, samples, valid)
    _check_enough(valid)
    samples[~valid] = np.nan
    borders = np.cumsum([len(signal.labels) for signal in signals.values()])[:-1]
    channels = dict(zip(signals, np.split(samples, borders, axis=1), strict=True))
    arrays = {key: _frozen(array) for key, array in (channels | {"time": time, "valid": valid}).items()}
    return Recording(**arrays, joints=joints, name=name, notes=(*sampling_notes, *notes))


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    array = np.array(array, order="C")
    array.setflags(write=False)
    return array


def _check_shapes(clock: _Signal, signals: dict[str, _Signal], n: int) -> None:
    if len(clock.labels) != 1:
        raise RecordingError(
            f"time has {len(clock.labels)} columns; name a single one (channels with times of their own: resample them)"
        )
    for channel, signal in signals.items():
        if len(signal.labels) != n and channel != "force":
            raise RecordingError(f"{channel} has {len(signal.labels)} columns for {n} joints; give one per joint")
    # A clock that was made of a rate is as long as the position, which is then to be named.
    compared = [*signals.values(), clock] if clock.labels == ("sample_rate",) else [clock, *signals.values()]
    _check_lengths([(signal.labels[0], signal.values) for signal in compared])
    if len(clock.values) < 3:
        raise RecordingError(
            f"has {len(clock.values)} samples; at least 3 are needed, and a useful fit needs many more"
        )


def _check_stamps(label: str, stamps: NDArray[np.float64]) -> None:
    """Time stamps are finite and increase."""
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


def _complete_rows(labels: list[str], samples: NDArray[np.float64]) -> tuple[NDArray[np.bool_], list[str]]:
    """(N,) True where every channel was measured, and a note if that is not everywhere."""
    if np.isfinite(samples).all():
        return np.ones(len(samples), bool), []
    infinite = np.argwhere(np.isinf(samples))
    if len(infinite):
        row, i = infinite[0]
        raise RecordingError(f"column {labels[i]!r}, row {row + 1}: the value is infinite; repair or remove the row")
    missing = np.isnan(samples)
    for label, column in zip(labels, missing.T, strict=True):
        if column.all():
            raise RecordingError(f"column {label!r} is NaN throughout: nothing was measured; name another column")
    valid = np.asarray(~missing.any(axis=1))
    _check_enough(valid)
    if valid.all():
        return valid, []
    counts = [f"{label!r} ({column.sum()})" for label, column in zip(labels, missing.T, strict=True) if column.any()]
    return valid, [f"{(~valid).sum()} of {len(valid)} samples are masked because of NaN in {', '.join(counts)}"]


def _check_enough(valid: NDArray[np.bool_]) -> None:
    if valid.sum() < 3:
        raise RecordingError(
            f"only {valid.sum()} of {len(valid)} samples are usable (no NaN, no gap); record at least 3"
        )


def _check_motion(channel: str, signal: _Signal, valid: NDArray[np.bool_]) -> list[str]:
    """Nothing can be identified from a constant signal; one resting joint of several is worth a note."""
    remark = {"position": "the joint did not move", "torque": "nothing was measured"}[channel]
    measured = signal.values[valid]
    constant = (measured == measured[0]).all(axis=0)
    notes = [
        f"column {label!r} is constant ({value:.6g}): {remark}"
        for label, value in zip(np.array(signal.labels)[constant].tolist(), measured[0, constant], strict=True)
    ]
    if constant.all():
        raise RecordingError("; ".join(notes) + "; name another column or another recording")
    return notes


_Gridded = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_], list[str]]


def _on_uniform_grid(stamps: NDArray[np.float64], samples: NDArray[np.float64], valid: NDArray[np.bool_]) -> _Gridded:
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


def _is_even(stamps: NDArray[np.float64]) -> bool:
    """Whether the stamps are even already, so that nothing is to be done."""
    step = (stamps[-1] - stamps[0]) / (len(stamps) - 1)
    late = stamps - (stamps[0] + step * np.arange(len(stamps)))
    return bool(1e-9 < step < 1e6 and np.abs(late).max() <= 1e-7 * step)


def _placed(
    stamps: NDArray[np.float64], samples: NDArray[np.float64], valid: NDArray[np.bool_], median: float
) -> _Gridded | None:
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
) -> _Gridded:
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
