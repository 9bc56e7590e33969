"""Time stamps: even, rounded, uneven, with gaps; and samples that are missing."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factories.recordings import matches
from jaximp.recordings.load import recording_from_arrays


@given(
    size=st.integers(10, 200),
    rate=st.sampled_from([1.0, 60.0, 1000.0, 1024.0, 2000 / 3]),
    start=st.sampled_from([0.0, -3.3, 1.7e9]),
    data=st.data(),
)
@settings(max_examples=60, deadline=None, derandomize=True)
def test_missing_rows_are_masked_and_the_others_unchanged(
    size: int, rate: float, start: float, data: st.DataObject
) -> None:
    inner = st.integers(1, size - 2)
    missing = data.draw(st.sets(inner, max_size=size // 4))
    kept = np.setdiff1d(np.arange(size), list(missing))
    t, q = start + np.arange(size) / rate, np.random.default_rng(0).normal(size=size)
    recording = recording_from_arrays(t[kept], q[kept], -q[kept])
    assert len(recording) == size
    np.testing.assert_allclose(recording.time, t, rtol=0, atol=1e-3 / rate)
    np.testing.assert_array_equal(np.flatnonzero(recording.valid), kept)
    np.testing.assert_array_equal(recording.position[kept, 0], q[kept])
    assert np.isnan(recording.torque[~recording.valid]).all()
    assert len(recording.notes) == bool(missing)


@pytest.mark.parametrize(
    ("rate", "digits", "noted"),
    [
        pytest.param(1000, 3, False, id="1kHz-to-ms"),
        pytest.param(1024, 6, False, id="1024Hz-to-us"),
        pytest.param(1024, 4, True, id="1024Hz-to-0.1ms"),
        pytest.param(100.4, 3, True, id="100.4Hz-to-ms"),
        pytest.param(600, 3, True, id="600Hz-to-ms"),
    ],
)
def test_rounded_stamps_are_even(rate: float, digits: int, noted: bool) -> None:
    t = np.arange(100_000) / rate
    recording = recording_from_arrays(np.round(t, digits), np.sin(t), np.cos(t))
    np.testing.assert_array_equal(recording.position[:, 0], np.sin(t))
    assert recording.sample_rate == pytest.approx(rate, rel=1e-6)
    assert recording.valid.all()
    assert [note for note in recording.notes if "rounded to" in note] == list(recording.notes)
    assert len(recording.notes) == noted


def test_stamps_rounded_until_they_repeat_point_to_the_sample_rate() -> None:
    t = np.arange(1000) / 1024
    with pytest.raises(ValueError, match=matches("row 23: the time stamp 0.021 s repeats the one before")) as caught:
        recording_from_arrays(np.round(t, 3), np.sin(t), np.cos(t))
    assert "give sample_rate = 1024 (or the rate that was set) in place of time" in str(caught.value)


def test_stamps_of_when_packets_arrived_point_to_the_sample_rate() -> None:
    count = 3000
    arrived = np.repeat(np.arange(0, count, 12), 12)[:count] / 1000 + 1e-5 * (np.arange(count) % 12)
    q = np.sin(np.arange(count) / 100)
    with pytest.raises(ValueError, match=r"come in packets \(12 samples at once, .* give sample_rate = 100\d"):
        recording_from_arrays(arrived, q, -q)


def test_small_jitter_is_not_interpolated() -> None:
    k = np.arange(1000)
    t = 0.005 * k + np.random.default_rng(0).uniform(-4e-5, 4e-5, 1000)
    recording = recording_from_arrays(t, np.sin(t), np.cos(t))
    np.testing.assert_array_equal(recording.position[:, 0], np.sin(t))
    np.testing.assert_allclose(np.diff(recording.time), recording.time[1] - recording.time[0], rtol=1e-9)
    assert recording.notes == ()


def test_uneven_sampling_is_interpolated_and_gaps_are_masked() -> None:
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.8e-3, 1.2e-3, 5000))
    t[3000:] += 0.5
    recording = recording_from_arrays(t, np.sin(8 * t), np.cos(8 * t))
    grid, valid = recording.time, recording.valid
    median = np.median(np.diff(t))
    np.testing.assert_allclose(np.diff(grid), median, rtol=1e-3)
    np.testing.assert_array_equal(valid, (grid <= t[2999]) | (grid >= t[3000]))
    error = np.abs(recording.position[:, 0] - np.sin(8 * grid))[valid]
    assert np.quantile(error, 0.99) < 1e-5
    assert error.max() < 2e-3  # beside the gap, where the slope is not known
    uneven, gap = recording.notes
    assert re.match(
        r"the sampling is uneven \(4999 intervals from 0\.0008\S* to 0\.50\S* s\): resampled .* Hz$", uneven
    )
    assert re.match(
        r"1 gap in the time stamps \(longest 0\.50\S* s, after row 3000\): the samples inside are masked$", gap
    )


@pytest.mark.parametrize("jitter", [0.0, 2e-4], ids=["even", "uneven"])
def test_nan_is_masked_and_counted(jitter: float) -> None:
    t = np.arange(100) / 100 + jitter * np.sin(np.arange(100))
    q, tau = np.sin(5 * t), np.cos(5 * t)
    q[[0, 50]], tau[50:53] = np.nan, np.nan
    recording = recording_from_arrays(t, q, tau)
    grid = recording.time
    unmeasured = (grid < t[1] - 1e-9) | ((grid > t[49] + 1e-9) & (grid < t[53] - 1e-9))
    np.testing.assert_array_equal(~recording.valid, unmeasured)
    assert np.isnan(recording.torque[unmeasured]).all()
    assert "4 of 100 samples are masked because of NaN in 'position' (2), 'torque' (3)" in recording.notes
    assert len(recording.notes) == 1 + (jitter > 0)


def test_one_resting_joint_is_noted() -> None:
    t = np.arange(100) / 100
    recording = recording_from_arrays(t, np.c_[np.sin(t), 0.3 + 0 * t], np.c_[np.sin(2 * t), np.cos(t)])
    assert recording.notes == ("column 'position[2]' is constant (0.3): the joint did not move",)
