"""Clocks as recorders write them: rows twice, two recordings in a file, rates that change, two columns that are one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factories.recordings import matches
from jaximp.recordings import load_recording, recording_from_arrays

N, RATE = 400, 100.0
t = np.arange(N) / RATE
q, tau = np.sin(6 * t), 20 * np.sin(6 * t + 0.1)


def test_rows_that_were_written_twice_are_left_out() -> None:
    twice = np.sort(np.r_[np.arange(N), np.arange(0, N, 12)])
    recording = recording_from_arrays(t[twice], q[twice], tau[twice])
    np.testing.assert_array_equal(recording.time, t)
    np.testing.assert_array_equal(recording.position[:, 0], q)
    note = "34 rows repeat the time stamp and all values of the one before (first: row 2): left out"
    assert recording.notes == (note,)


def test_one_row_that_was_written_twice_is_left_out_even_where_nothing_was_measured() -> None:
    twice = np.r_[np.arange(10), np.arange(9, N)]
    spoilt = np.where(np.arange(N) == 9, np.nan, q)
    recording = recording_from_arrays(t[twice], spoilt[twice], tau[twice])
    assert len(recording) == N
    assert recording.notes[0].startswith(
        "1 row repeats the time stamp and all values of the one before (first: row 11)"
    )


def test_stamps_that_repeat_with_other_values(tmp_path: Path) -> None:
    stamps = t.copy()
    stamps[[10, 200]] = stamps[[9, 199]]
    np.savez(tmp_path / "a.npz", t=stamps, q=q, tau=tau)
    mapping: dict[str, Any] = {"time": "t", "position": "q", "torque": "tau"}
    with pytest.raises(ValueError, match=matches("row 11: the time stamp 0.09 s repeats the one before, with other")):
        load_recording(tmp_path / "a.npz", **mapping)
    with pytest.raises(ValueError, match=matches("2 such rows")):
        load_recording(tmp_path / "a.npz", **mapping)
    dropped = load_recording(tmp_path / "a.npz", **mapping, duplicates="drop")
    assert (
        "2 rows repeat the time stamp of the one before (first: row 11): left out, as the mapping says" in dropped.notes
    )
    assert np.flatnonzero(~dropped.valid).tolist() == [10, 200]
    with pytest.raises(ValueError, match=matches('duplicates must be "drop"')):
        load_recording(tmp_path / "a.npz", **mapping, duplicates="keep")


def test_a_clock_that_begins_anew_divides_the_file(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t=np.r_[t, t, t[:50]], q=np.r_[q, q, q[:50]], tau=np.r_[tau, tau, tau[:50]])
    mapping: dict[str, Any] = {"time": "t", "position": "q", "torque": "tau"}
    parts = "three recordings stand in this file, in rows 1-400, 401-800 and 801-850; name one with rows = [1, 400]"
    with pytest.raises(ValueError, match=matches(parts)):
        load_recording(tmp_path / "a.npz", **mapping)
    np.testing.assert_array_equal(load_recording(tmp_path / "a.npz", **mapping, rows=[401, 800]).position[:, 0], q)


def test_rows_out_of_order_are_counted() -> None:
    order = np.arange(N)
    order[[50, 51, 90, 91]] = [51, 50, 91, 90]
    with pytest.raises(ValueError, match=matches("row 52: the time stamp 0.5 s steps backwards (and 1 more)")):
        recording_from_arrays(t[order], q[order], tau[order])


@pytest.mark.parametrize("jitter", [0.0, 0.05])
@pytest.mark.parametrize(("first", "then"), [(100, 1000), (1000, 250)])
def test_a_rate_that_changes_is_named(first: int, then: int, jitter: float) -> None:
    count = 1000
    stamps = np.r_[np.arange(count) / first, (count - 1) / first + np.arange(1, 2 * count) / then]
    noise = jitter * np.random.default_rng(0).uniform(-0.5, 0.5, len(stamps)) / max(first, then)
    x = np.sin(6 * stamps)
    message = (
        f"the first 1000 rows were sampled at {first:.5g} Hz, and those after them at {then:.5g} Hz: name one part"
    )
    if jitter:
        message = "name one part with rows = [1, 1000] or rows = [1001, 2999]"
    with pytest.raises(ValueError, match=matches(message)):
        recording_from_arrays(stamps + noise, x, 20 * x)


@pytest.mark.parametrize("seed", range(3))
def test_jitter_and_lost_rows_are_no_other_rate(seed: int) -> None:
    random = np.random.default_rng(seed)
    stamps = np.arange(4000) / 1000 + random.uniform(-3e-4, 3e-4, 4000)
    kept = np.sort(random.permutation(4000)[:3000])
    stamps = np.r_[stamps[kept], 5 + stamps]
    x = np.sin(6 * stamps)
    assert recording_from_arrays(stamps, x, 20 * x).sample_rate == pytest.approx(1000, rel=0.05)


def test_position_and_torque_of_one_column_are_noted() -> None:
    recording = recording_from_arrays(t, q, q)
    assert any("position and torque are the same numbers" in note for note in recording.notes)
