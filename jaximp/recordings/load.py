"""Files and arrays -> `Recording`s: the only way in for measurements.

A file is read in four steps: `mapping` says which columns are which channel, a reader (`readers.formats`) gets them
from the file, `units` brings them to SI at the joint, and `assemble` checks every channel and brings all of them onto
one uniform time grid (`grid`). Whatever was changed on the way is told in `Recording.notes`; whatever cannot be used
is a `ValueError` of one line that names the cause and the remedy.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaximp.recordings.apart import files_apart, found_in, joined, split_apart
from jaximp.recordings.assemble import assemble
from jaximp.recordings.channels import CHANNELS, Signal, check_lengths, stack
from jaximp.recordings.errors import RecordingError
from jaximp.recordings.grid import take_clock
from jaximp.recordings.mapping import Entry, check_mapping, given, is_number, joint_types, source_of, text_options
from jaximp.recordings.readers.formats import read_columns
from jaximp.recordings.readers.found import AS_SEEN, COUNTED_FROM, TextOptions
from jaximp.recordings.units import to_si
from jaximp.types import Recording


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
    rows: Sequence[int] | None = None,
    duplicates: str | None = None,
    header: int | None = None,
    separator: str | None = None,
    decimal: str | None = None,
    encoding: str | None = None,
    bad_lines: str | None = None,
) -> Recording:
    """Read a recording; the keywords are the keys of a job file's `[recording]` table.

    **Arguments:**

    - `path`: text (.csv, .txt, .tsv, .dat, .asc, OpenSim's .sto and .mot, LabVIEW's .lvm; also .gz), .parquet,
      .feather, .jsonl, .mat (v5 or v7.3), .h5, .hdf5, .npz; with the extra `formats` also spreadsheets (.xlsx, .xls,
      .xlsb, .ods), .c3d and ROS bags (.bag, .db3, .mcap). A column is a header's name, a variable (`data.q` inside a
      MATLAB struct) or a dataset's path. Variables may be (N, n), one column per joint; one of them is `data(:,2)` as
      MATLAB counts, `data[:,1]` as numpy does, or `data[2]`, which counts from 1. `data(2).q` is that of an array of
      structs. In text files and spreadsheets a column may also be a number that counts from 1: where no line names
      the columns, they have only numbers.
    - `time` [s] (a column, or `{column, unit}`) or else `sample_rate`: a number [Hz], or a scalar variable in the file.
    - `position`, `torque`, `velocity`, `acceleration`, `force`, `reference`, `command`: a column, a list of columns
      (one per joint), or `{columns = ..., unit = "deg", sign = -1, gain = 2.5}`. Without `unit`, that of the
      column's name (`angle (deg)`, `torque_mNm`) or of a row of units, which is noted; else that of the
      channel: rad, N m, rad/s, rad/s^2 (prismatic: m, N, m/s, m/s^2), force N; `reference` is a position, `command`
      (the perturbation) a torque. A bare `gain` multiplies the column and `unit` is that of the product; with
      `gain = "35.1507 N/V"`, `unit` is that of the column. `delay` [s] says how late a channel was recorded, by a
      filter or another clock: it is moved forward by so much. That of the torque behind the position may be "estimate":
      the model finds it. `noise`, of the position alone and in its unit, is the standard deviation of its sensor, which
      samples that a recorder filtered do not show; estimates are corrected for it. `gain` may be a list with one for
      each column, such as the torques that drives give for their currents. `gain_error`, of the torque alone, is what
      is not known of the gains, as standard deviations in per cent: `3` for each by itself, or
      `{common = 10, each = 3}` with what all have in common; standard errors grow by it.
      A channel other than the position may stand in another file: `{file = "sensor.csv", time = "stamp", column =
      "torque"}` joins it on the recording's time, linearly between its samples, both in seconds of one clock; without
      `time` it has the same rows.
    - `joint`: `revolute` or `prismatic`, or a list of these, one per joint.
    - `gear_ratio`: motor turns per joint turn, if the columns were measured at the motor: position, velocity,
      acceleration and reference are divided by it, torque and command are multiplied; `force` acts at the endpoint and
      stays.
    - `rows`: the first and the last row of the file that count, from 1 (a header is none), both included.
    - `duplicates`: `"drop"` keeps the first of rows with one time stamp; rows that are the same throughout need no key.
    - `header`, `separator`, `decimal`, `encoding`, `bad_lines`, of text alone, where what is seen in the file is not
      what it is: the line that names the columns (0 if none does), `";"` or `"whitespace"`, `","`, `"cp1252"`, and
      `"drop"` for rows that cannot be read, which are refused else. In a channel's table, `despite_name = true` says
      that the column's name is wrong about its unit.

    **Returns:** the recording on a uniform grid; see `recording_from_arrays` for sampling, gaps and NaN.

    **Raises:** `FileNotFoundError`; else `ValueError` with one line that names the file, the cause and the remedy.

    **Example:**

    ```pycon
    >>> columns = {"time": {"column": "t", "unit": "s"}, "position": {"column": "angle", "unit": "deg"}}
    >>> torque = {"column": "moment", "unit": "N m", "sign": -1}
    >>> recording = jaximp.load_recording("examples/ankle.csv", **columns, torque=torque)
    >>> print(recording.sample_rate, np.ptp(recording.position).round(2))
    500.0 0.15

    ```
    """
    entries: dict[str, Any] = {"position": position, "torque": torque, "velocity": velocity, "force": force}
    entries |= {"acceleration": acceleration, "reference": reference, "command": command, "time": time}
    path = _existing(path)
    written = {"header": header, "separator": separator, "decimal": decimal, "encoding": encoding}
    with _named(str(path)):
        options = text_options({**written, "bad_lines": bad_lines})
        own, apart = split_apart(entries)
        signals, joints, notes = _read_signals(path, own, sample_rate, joint, gear_ratio, rows, options)
        clock = take_clock(signals, sample_rate)
        for channel, entry in apart.items():
            signals[channel], said = _read_apart(channel, entry, clock, joints, gear_ratio)
            notes += said
        signals = {channel: signals[channel] for channel in CHANNELS if channel in signals}
        return assemble(clock, signals, joints, _stem(path) if name is None else name, notes, duplicates)


def recording_from_mapping(
    table: Mapping[str, Any], folder: str | os.PathLike[str], where: str = "[recording]"
) -> Recording:
    """The recording that a job file's `[recording]` table describes.

    **Arguments:** `table` the keywords of `load_recording`, and `file`; `folder` where a relative `file` starts; what
    errors call the table (`where`).

    **Raises:** `ValueError` for an unknown or missing key, and as `load_recording`.
    """
    (recording,) = recordings_from_mapping(table, folder, where, several=False)
    return recording


def recordings_from_mapping(
    table: Mapping[str, Any], folder: str | os.PathLike[str], where: str = "[recording]", several: bool = True
) -> list[Recording]:
    """As `recording_from_mapping`, of a table whose `file` may be a list: their columns are the same, and `rows` may
    list a pair for each."""
    check_mapping(table, where, "file")
    if "file" not in table:
        raise RecordingError(f"{where}: 'file' is missing; add it")
    files = table["file"] if isinstance(table["file"], list) and several else [table["file"]]
    if not files or not all(isinstance(file, str) for file in files):
        raise RecordingError(f"{where}: 'file' must be a path in quotes, not {table['file']!r}")
    rows = table.get("rows")
    if not (isinstance(rows, list) and rows and isinstance(rows[0], list)):
        rows = [rows] * len(files)
    if len(rows) != len(files):
        raise RecordingError(f"{where}: rows lists {len(rows)} pairs for {len(files)} files: give one, or one each")
    if len(files) > 1 and files_apart(table):
        raise RecordingError(f"{where}: with channels in other files, 'file' is one recording: write several tables")
    mapping = {key: entry for key, entry in found_in(table, Path(folder)).items() if key not in ("file", "rows")}
    return [load_recording(Path(folder) / file, **mapping, rows=pair) for file, pair in zip(files, rows, strict=True)]


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

    **Example:**

    ```pycon
    >>> t = np.arange(0, 4, 0.005)
    >>> q = 0.1 * np.sin(9 * t)
    >>> recording = jaximp.recording_from_arrays(t, q, torque=20 * q)
    >>> print(recording.position.shape, recording.sample_rate)
    (800, 1) 200.0

    ```
    """
    arrays = zip(CHANNELS, (position, torque, velocity, acceleration, force, reference, command), strict=True)
    signals = {channel: stack((channel,), {channel: values}) for channel, values in arrays if given(channel, values)}
    signals["time"] = stack(("time",), {"time": time})
    joints = joint_types(joint, signals["position"].values.shape[1])
    return assemble(take_clock(signals, None), signals, joints, name)


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
    channels = {key: mapping[key] for key in mapping if key in ("time", *CHANNELS)}
    options = (rate, mapping.get("joint", "revolute"), mapping.get("gear_ratio", 1.0), mapping.get("rows"))
    with _named(str(path)):
        signals, joints, notes = _read_signals(path, channels | {"trial": trial}, *options, text_options(mapping))
        numbers = signals.pop("trial").values[:, 0]
        scalar = {key: signals.pop(key) for key in ("sample_rate",) if key in signals}
        check_lengths([(trial, numbers[:, None]), *((s.labels[0], s.values) for s in signals.values())])
        _, first = np.unique(numbers[~np.isnan(numbers)], return_index=True)
        in_order = numbers[~np.isnan(numbers)][np.sort(first)]
        if not len(in_order):
            raise RecordingError(f"column {trial!r} has no trial number: name the column that tells the trials apart")
    recordings = []
    for number in in_order:
        rows = numbers == number
        with _named(f"{path}, trial {number:g}"):
            part = {key: replace(signal, values=signal.values[rows]) for key, signal in signals.items()} | scalar
            name = f"{_stem(path)}, trial {number:g}"
            recordings.append(assemble(take_clock(part, rate), part, joints, name, notes, mapping.get("duplicates")))
    return recordings


def _read_signals(
    path: Path,
    entries: Mapping[str, Any],
    sample_rate: Any,
    joint: str | Sequence[str],
    gear_ratio: float,
    rows: Sequence[int] | None = None,
    options: TextOptions = AS_SEEN,
) -> tuple[dict[str, Signal], tuple[str, ...], list[str]]:
    """All channels of a file in SI units, the clock among them, the joints, and notes on how the file was understood; a
    `trial` column as it is."""
    if (entries.get("time") is None) == (sample_rate is None):
        raise RecordingError("give either 'time' (a column) or 'sample_rate' (in Hz), one of the two")
    entries = {**entries, "sample_rate": None if is_number(sample_rate) else sample_rate}
    sources = {channel: source_of(channel, entry) for channel, entry in entries.items() if given(channel, entry)}
    found = read_columns(path, [column for source in sources.values() for column in source.columns], options)
    signals = {channel: stack(source.columns, found.values) for channel, source in sources.items()}
    signals = {key: signal if key == "sample_rate" else _cut(signal, rows) for key, signal in signals.items()}
    joints = joint_types(joint, signals["position"].values.shape[1])
    notes = list(found.notes)
    for key, signal in signals.items():
        if key != "trial":
            signals[key], taken = to_si(key, signal, sources[key], joints, gear_ratio, found)
            notes += taken
    return signals, joints, notes


def _read_apart(
    channel: str, entry: dict[str, Any], clock: Signal, joints: tuple[str, ...], gear_ratio: float
) -> tuple[Signal, list[str]]:
    """A channel of another file, in SI units and at the times of the recording, and notes on it."""
    path, time = _existing(entry.pop("file")), entry.pop("time", None)
    with _named(path.name):
        sources = {channel: source_of(channel, entry)}
        if time is not None:
            sources["time"] = source_of("time", time)
        found = read_columns(path, [column for source in sources.values() for column in source.columns], AS_SEEN)
        signals, notes = {}, list(found.notes)
        for key, source in sources.items():
            signals[key], taken = to_si(key, stack(source.columns, found.values), source, joints, gear_ratio, found)
            notes += taken
    if time is None:
        if len(signals[channel].values) != len(clock.values):
            raise RecordingError(
                f"{channel}: {path.name} has {len(signals[channel].values)} samples and the recording "
                f"{len(clock.values)}: name the column with its times as 'time' in the channel's table"
            )
        return signals[channel], [*notes, f"{channel} is that of {path.name}, row by row"]
    if any(COUNTED_FROM in note for note in found.notes) or path.suffix.lower() in (".bag", ".mcap", ".db3"):
        raise RecordingError(
            f"{channel}: the times of {path.name} count from its own beginning: write seconds of the recording's clock"
        )
    if clock.labels == ("sample_rate",):
        raise RecordingError(f"{channel}: {path.name} has times of its own: name the recording's 'time', too")
    signal, said = joined(channel, signals[channel], signals["time"], clock, path)
    return signal, [*notes, *said]


def _stem(path: Path) -> str:
    """The name of a file without its extensions."""
    return path.with_suffix("").stem if path.suffix.lower() == ".gz" else path.stem


def _cut(signal: Signal, rows: Sequence[int] | None) -> Signal:
    """The rows from the first to the last one that are wanted, which count from 1."""
    if rows is None:
        return signal
    if not (isinstance(rows, list | tuple) and len(rows) == 2 and all(type(row) is int for row in rows)):
        raise RecordingError(f"rows must be the first and the last row that count, such as [100, 2500], not {rows!r}")
    first, last = rows
    if not 1 <= first < last:
        raise RecordingError(f"rows = {list(rows)}: the first must be 1 or more, and the last behind it")
    if last > len(signal.values):
        raise RecordingError(f"rows = {list(rows)}: the file has {len(signal.values)} rows; lower the last one")
    return replace(signal, values=signal.values[first - 1 : last])


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
