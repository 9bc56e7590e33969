"""Studies of many recordings, for batches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from factories import joints
from jaximp.batch import run as batch
from jaximp.batch import tables as batch_tables
from jaximp.jobs.job import read_job
from jaximp.recordings.load import recording_from_arrays
from jaximp.types import Recording

JOB = """
[recording]
file = "none.parquet"
time = "time_s"
position = "position_rad"
torque = "torque_Nm"
[model]
human = true
[filter]
position_cutoff = 20
decimation_cutoff = 10
[window]
length = 1
step = 0.05
"""
RATE = 250.0
LENGTHS = (1000, 1000, 1000, 1250, 1250, 1321, 1321, 1321)


def joint(n: int, seed: int = 0, rate: float = RATE, stiffness: float = 20.0) -> Recording:
    """A joint that moves at three frequencies, with noise in torque and position."""
    return joints.joint(np.arange(n) / rate, seed=seed, position_noise=1e-4, stiffness=stiffness)


def beside(first: Recording, second: Recording) -> Recording:
    """Two joints."""
    both = (np.hstack([getattr(r, name) for r in (first, second)]) for name in ("position", "torque"))
    return recording_from_arrays(first.time, *both)


def spoilt(recording: Recording, part: slice) -> Recording:
    """Without the samples of a stretch."""
    torque = recording.torque.copy()
    torque[part] = np.nan
    return recording_from_arrays(recording.time, recording.position, torque)


def still(recording: Recording, part: slice) -> Recording:
    """Motionless for a stretch, where no window can be solved well."""
    position, torque = recording.position.copy(), recording.torque.copy()
    position[part], torque[part] = position[part][0], torque[part][0]
    return recording_from_arrays(recording.time, position, torque)


def run(folder: Path, out: Path, **options: object) -> batch.Outcome:
    """The study's batch: of three lengths, and so three batches."""
    job = read_job(folder / "job.toml")
    return batch.run(job, out=out, manifest=folder / "study.csv", **options)


def content(out: Path) -> dict[str, object]:
    """All results, run metadata apart."""
    found: dict[str, object] = {}
    for path in sorted(out.rglob("*")):
        name = path.relative_to(out).as_posix()
        if not path.is_file() or name.startswith(("receipts/", "batch.log", ".jaximp")):
            continue
        if name.startswith("recordings/"):
            found[name] = pq.ParquetFile(path).read().drop_columns(list(batch_tables.RUN_COLUMNS))
        else:
            found[name] = path.read_bytes()
    return found
