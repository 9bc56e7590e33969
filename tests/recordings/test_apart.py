"""Channels in files of their own: joined on the recording's time, or row by row, and refused where that cannot be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaximp.batch.plan import of_recordings
from jaximp.jobs.job import parse_job
from jaximp.recordings.load import load_recording, recordings_from_mapping
from jaximp.types import Recording

RATE, SECONDS = 500.0, 4.0
TIME = np.arange(round(RATE * SECONDS)) / RATE
SENSOR = {"file": "sensor.csv", "time": "stamp", "column": "torque_mNm"}
MAPPING = {"file": "robot.csv", "time": "t", "position": "q", "torque": SENSOR}


def q(t: np.ndarray) -> np.ndarray:
    return 0.1 * np.sin(9 * t) + 0.05 * np.sin(23 * t)


def tau(t: np.ndarray) -> np.ndarray:
    return 20 * q(t) + 0.3 * np.cos(9 * t)


def write(folder: Path, stamps: np.ndarray, start: float = 100.0, clock: str = "stamp") -> Path:
    """A robot's file that begins at so many seconds, and a sensor's with stamps of its own."""
    rows = np.column_stack([start + TIME, q(TIME)])
    np.savetxt(folder / "robot.csv", rows, "%.9g", ",", header="t,q", comments="")
    rows = np.column_stack([start + stamps, 1000 * tau(stamps)])
    np.savetxt(folder / "sensor.csv", rows, "%.9g", ",", header=f"{clock},torque_mNm", comments="")
    return folder


def load(folder: Path, **other: Any) -> Recording:
    (recording,) = recordings_from_mapping(MAPPING | other, folder)
    return recording


def test_a_sensor_with_a_clock_of_its_own_is_joined(tmp_path: Path) -> None:
    """It runs twice as fast, begins later and ends earlier; its unit is that of the column's name."""
    stamps = np.arange(0.5, 3.5, 0.001)
    recording = load(write(tmp_path, stamps))
    inside = (TIME >= 0.5) & (stamps[-1] >= TIME)
    np.testing.assert_array_equal(recording.valid, inside)
    np.testing.assert_allclose(recording.torque[inside, 0], tau(TIME[inside]), atol=2e-5)
    np.testing.assert_allclose(recording.position[inside, 0], q(TIME[inside]), atol=1e-9)
    assert any(note.startswith("torque is that of sensor.csv, joined on the time") for note in recording.notes)


def test_a_slower_sensor_says_what_it_cannot_hold_and_gaps_stay_gaps(tmp_path: Path) -> None:
    stamps = np.arange(0, 4.001, 0.01)
    stamps = stamps[(stamps < 1.0) | (stamps > 1.5)]
    recording = load(write(tmp_path, stamps))
    assert "torque comes at 100 Hz and the recording at 500 Hz: nothing above 50 Hz is in it, and filters must cut" in (
        " ".join(recording.notes)
    )
    assert not recording.valid[(TIME > 1.0) & (TIME < 1.5)].any()
    assert recording.valid[((TIME > 0.05) & (TIME < 0.95)) | ((TIME > 1.55) & (TIME < 3.95))].all()


def test_without_times_the_rows_are_the_same(tmp_path: Path) -> None:
    write(tmp_path, TIME)
    by_row = {key: SENSOR[key] for key in ("file", "column")}
    recording = load(tmp_path, torque=by_row)
    np.testing.assert_allclose(recording.torque[:, 0], tau(TIME), atol=1e-8)
    write(tmp_path, TIME[:-1])
    with pytest.raises(ValueError, match=r"sensor\.csv has 1999 samples and the recording 2000: name the column"):
        load(tmp_path, torque=by_row)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position": {"file": "sensor.csv", "column": "q"}}, "position: it is in the recording's own file"),
        ({"torque": SENSOR | {"file": 3}}, "'file' must be a path in quotes"),
        ({"torque": SENSOR | {"file": "none.csv"}}, "none.csv: there is no such file"),
        ({"torque": SENSOR | {"column": "tua"}}, "sensor.csv: column 'tua' is not there"),
        ({"file": ["robot.csv", "robot.csv"]}, "'file' is one recording"),
    ],
)
def test_what_cannot_be_joined_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    write(tmp_path, TIME)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        load(tmp_path, **change)


def test_clocks_that_do_not_meet_are_refused(tmp_path: Path) -> None:
    write(tmp_path, TIME + 50)
    with pytest.raises(
        ValueError, match=r"sensor\.csv is from 150 to 153\.998 s and the recording from 100 to 103\.998 s"
    ):
        load(tmp_path)
    rows = [f"2026-03-01T10:00:{second:09.6f},{value}" for second, value in zip(TIME, 1000 * tau(TIME), strict=True)]
    (tmp_path / "sensor.csv").write_text("\n".join(["stamp,torque_mNm", *rows]))
    with pytest.raises(ValueError, match=r"the times of sensor\.csv count from its own beginning"):
        load(tmp_path)
    write(tmp_path, TIME)
    with pytest.raises(ValueError, match=r"sensor\.csv has times of its own: name the recording's 'time', too"):
        load_recording(tmp_path / "robot.csv", sample_rate=RATE, position="q",
                       torque=SENSOR | {"file": str(tmp_path / "sensor.csv")})  # fmt: skip


def test_a_job_names_all_of_its_files(tmp_path: Path) -> None:
    text = """
        [recording]
        file = "robot.csv"
        time = "t"
        position = "q"
        torque = { file = "sensor.csv", time = "stamp", column = "torque_mNm" }
        [model]
        human = true
        [filter]
        position_cutoff = 20
        [window]
        length = 1
    """
    job = parse_job(text, write(tmp_path, TIME))
    assert job.files() == [tmp_path / "robot.csv", tmp_path / "sensor.csv"]
    assert job.load().valid.all()
    with pytest.raises(ValueError, match="a batch reads one file per recording"):
        of_recordings(job)
