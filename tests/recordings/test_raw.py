"""Raw samples are judged before anything touches them: what is masked, what is mended, and what is said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from jaximp.recordings import load_recording, recording_from_arrays, save_recording
from jaximp.types import Recording

Numbers = NDArray[np.float64]
RATE, STIFFNESS = 500.0, 25.0
TIME = np.arange(0, 20, 1 / RATE)


def joint() -> tuple[Numbers, Numbers]:
    """Position and torque, with some noise."""
    random = np.random.default_rng(0)
    q = 0.1 * np.sin(5.65 * TIME) + 0.06 * np.sin(14.5 * TIME + 0.5) + 0.03 * np.sin(25.8 * TIME + 1.1)
    dq = np.gradient(q, TIME)
    torque = 0.03 * np.gradient(dq, TIME) + 0.8 * dq + STIFFNESS * q + 2 + 0.05 * random.normal(size=len(TIME))
    return q + 1e-5 * random.normal(size=len(TIME)), torque


def kinds(recording: Recording) -> dict[str, str]:
    return {f"{one.label}: {one.kind}": one.text for one in recording.faults}


def test_good_samples_are_left_alone() -> None:
    position, torque = joint()
    recording = recording_from_arrays(TIME, position, torque)
    assert recording.faults == recording.notes == ()
    assert recording.clipped is None
    np.testing.assert_array_equal(recording.position[:, 0], position)
    assert recording.position_noise is not None
    np.testing.assert_allclose(recording.position_noise, 1e-5, rtol=0.05)


@pytest.mark.parametrize(
    ("channel", "value"), [("torque", 50.0), ("torque", 9999.0), ("position", -999.0), ("position", 0.0)]
)
def test_single_samples_are_masked(channel: str, value: float) -> None:
    position, torque = joint()
    at = np.arange(len(TIME)) % 199 == 100
    if value == 0:  # a zero is as good as any value where the joint passes zero
        at &= np.abs(position) > 0.02
    spoilt = {"position": position, "torque": torque}
    spoilt[channel] = np.where(at, value, spoilt[channel])
    recording = recording_from_arrays(TIME, **spoilt)
    np.testing.assert_array_equal(~recording.valid, at)
    text = f"{at.sum()} samples stand out from their neighbours by more than 20 times the noise"
    assert kinds(recording)[f"{channel}: glitches"].startswith(f"{channel}: {text} (first at 0.2 s): masked")
    assert recording.notes == (recording.faults[0].text,)


def test_a_sentinel_that_lasts_is_masked() -> None:
    position, torque = joint()
    torque[1000:1080] = torque[5000:5030] = -999.0
    recording = recording_from_arrays(TIME, position, torque)
    assert np.flatnonzero(~recording.valid).tolist() == [*range(1000, 1080), *range(5000, 5030)]


@pytest.mark.parametrize("behind", [0.0, 0.002], ids=["exact", "noise behind"])
def test_a_torque_that_was_cut_off_is_masked(behind: float) -> None:
    position, torque = joint()
    beyond = np.abs(torque - 2) > 2.5
    cut = np.clip(torque, -0.5, 4.5) + behind * np.random.default_rng(1).normal(size=len(TIME))
    recording = recording_from_arrays(TIME, position, cut)
    assert recording.clipped is not None
    assert (recording.clipped & beyond).sum() > 0.98 * beyond.sum()
    assert (recording.clipped & ~beyond).sum() < 0.02 * beyond.sum()
    assert not (recording.valid & recording.clipped).any()
    assert "of the samples lie at a limit (4.5 and -0.5)" in kinds(recording)["torque: saturation"]


@pytest.mark.parametrize(("jitter", "moved"), [(0.0, 0.0), (0.2, 0.05)], ids=["even stamps", "uneven stamps"])
def test_a_torque_that_was_cut_off_is_so_when_it_is_saved_and_read_again(
    jitter: float, moved: float, tmp_path: Path
) -> None:
    position, torque = joint()
    time = TIME + jitter / RATE * np.random.default_rng(2).uniform(-1, 1, len(TIME))
    recording = recording_from_arrays(time, position, np.clip(torque, -0.5, 4.5))
    save_recording(recording, tmp_path / "cut.csv")
    again = load_recording(tmp_path / "cut.csv", time="time_s", position="position_rad", torque="torque_Nm")
    assert recording.clipped is not None
    assert again.clipped is not None
    assert (recording.clipped != again.clipped).mean() <= moved * recording.clipped.mean()


def test_held_samples_are_joined_by_a_smooth_curve() -> None:
    position, torque = joint()
    every = 8
    held = np.repeat(position[::every], every)[: len(TIME)]
    recording = recording_from_arrays(TIME, held, torque)
    assert "changes only every 8 samples" in kinds(recording)["position: held samples"]
    error = (recording.position[:, 0] - position)[recording.valid]
    assert np.abs(error).max() < 1e-4 < 0.02 < np.abs(held - position).max()
    assert (~recording.valid).sum() < every


def test_the_step_of_an_encoder_is_seen_before_uneven_samples_are_resampled() -> None:
    position, torque = joint()
    uneven = TIME + 0.05 / RATE * np.random.default_rng(2).uniform(-1, 1, len(TIME))
    step = 2 * np.pi / 1024
    recording = recording_from_arrays(uneven, step * np.round(position / step), torque)
    assert "uneven" in recording.notes[0]
    assert recording.position_noise is not None
    np.testing.assert_allclose(recording.position_noise, step / np.sqrt(12), rtol=0.02)


def torque_with(name: str) -> Numbers:
    """That of `joint` with what recorders do to samples that were not there in time, or were too small."""
    random, torque = np.random.default_rng(3), joint()[1]
    if name == "bridged":
        kept = np.ones(len(torque), bool)
        for first in random.integers(100, len(torque) - 100, 25):
            kept[first : first + 30] = False
        return np.interp(TIME, TIME[kept], torque[kept])
    if name == "slower":
        slow = np.arange(0, TIME[-1], 1 / 83.0)
        return np.interp(TIME, slow, np.interp(slow, TIME, torque))
    if name == "sent twice":
        for first in random.integers(1000, len(torque) - 200, 12):
            torque[first : first + 40] = torque[first - 200 : first - 160]
        return torque
    away = torque - np.median(torque)
    return np.sign(away) * np.maximum(np.abs(away) - 0.3, 0)


@pytest.mark.parametrize("decimals", [None, 4], ids=["all digits", "four decimals"])
@pytest.mark.parametrize(
    ("name", "kind", "share"),
    [("bridged", "lines", 0.07), ("sent twice", "repeated", 0.045), ("dead zone", "dead zone", 0.07)],
)
def test_what_a_recorder_made_of_the_torque_is_masked(name: str, kind: str, share: float, decimals: int | None) -> None:
    position, torque = joint()[0], torque_with(name)
    recording = recording_from_arrays(TIME, position, torque if decimals is None else np.round(torque, decimals))
    assert list(kinds(recording)) == [f"torque: {kind}"]
    assert (~recording.valid).mean() == pytest.approx(share, rel=0.25)


@pytest.mark.parametrize("seed", range(6))
def test_few_digits_make_no_dead_zone(seed: int) -> None:
    """A robot's friction holds its torque near two values, each of which then stands in the file hundreds of times."""
    random, (position, _) = np.random.default_rng(seed), joint()
    torque = 0.35 * np.sign(np.gradient(position)) + 0.1 * position + 0.05 * random.normal(size=len(TIME))
    recording = recording_from_arrays(TIME, position, np.round(torque, 2))
    assert np.unique(recording.torque, return_counts=True)[1].max() > 0.01 * len(TIME)
    assert recording.valid.all()


@pytest.mark.parametrize("decimals", [None, 4], ids=["all digits", "four decimals"])
def test_a_slower_torque_that_was_joined_by_lines_is_a_smooth_curve_again(decimals: int | None) -> None:
    (position, _), torque = joint(), torque_with("slower")
    recording = recording_from_arrays(TIME, position, torque if decimals is None else np.round(torque, decimals))
    assert list(kinds(recording)) == ["torque: joined samples"]
    assert "one in 6.02, were joined by straight lines" in kinds(recording)["torque: joined samples"]
    assert recording.valid.mean() > 0.99
    apart = (recording.torque[:, 0] - torque)[recording.valid]
    assert 0 < np.abs(apart).max() < 0.5


def test_signals_without_noise_may_lie_on_lines_and_repeat_themselves() -> None:
    position = joint()[0]
    triangle = 3 * np.abs((TIME * 0.7) % 2 - 1) - 1
    periodic = np.tile((25 * np.sin(5.65 * TIME) + 3 * np.sin(11.3 * TIME))[:500], len(TIME) // 500)
    for torque in (triangle, periodic):
        assert recording_from_arrays(TIME, position, torque).valid.all()
