"""`Recording`s -> files that read back equal: the columns are called by channel and unit."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaximp.recordings.channels import CHANNELS
from jaximp.recordings.errors import RecordingError
from jaximp.recordings.named_units import SUFFIXES
from jaximp.recordings.units import si_unit
from jaximp.types import Recording


def save_recording(recording: Recording, path: str | os.PathLike[str]) -> None:
    """Write a recording as CSV or Parquet, by extension; `load_recording` reads it back equal.

    Columns: `time_s`, `position_rad` (`position1_rad`, ... for several joints; `_m` if prismatic), `torque_Nm`
    (`torque_N`), and the optional channels alike; a masked sample is NaN, unless the torque was at its limit there,
    which whoever reads it must see. The file appears whole or not at all.

    **Raises:** `ValueError` for another extension.

    **Example:**

    ```pycon
    >>> import tempfile
    >>> from pathlib import Path
    >>> t = np.arange(0, 4, 0.005)
    >>> recording = jaximp.recording_from_arrays(t, np.sin(t), np.cos(t))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     jaximp.save_recording(recording, Path(folder, "knee.csv"))
    ...     print(Path(folder, "knee.csv").read_text().splitlines()[0])
    ...
    "time_s","position_rad","torque_Nm"

    ```
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


def _named_columns(recording: Recording) -> dict[str, NDArray[np.float64]]:
    """Column name -> (N,) values, as `save_recording` describes."""
    suffix_of = {unit: suffix for suffix, unit in SUFFIXES.items()}
    columns = {"time_s": recording.time}
    clipped = False if recording.clipped is None else recording.clipped
    for channel in CHANNELS:
        values = getattr(recording, channel)
        if values is None:
            continue
        for i, column in enumerate(values.T):
            number = str(i + 1) if values.shape[1] > 1 else ""
            unit = si_unit(channel, recording.joints[min(i, recording.n_joints - 1)])
            columns[f"{channel}{number}_{suffix_of[unit]}"] = np.where(recording.valid | clipped, column, np.nan)
    return columns


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
