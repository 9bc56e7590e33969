"""Glitches, limits and held samples: all that were put in are found, and none in good signals."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import chirp

from jaximp.signals.faults import glitches, held_updates, torque_limits

Numbers = NDArray[np.float64]
RATE = 500.0
TIME = np.arange(0, 30, 1 / RATE)


def joint(seed: int) -> tuple[Numbers, Numbers]:
    """Position (N,) and torque (N,) of a joint that moves at random lines below 5 Hz."""
    random = np.random.default_rng(seed)
    lines = zip(random.uniform(0.3, 5, 6), random.uniform(0, 6, 6), random.normal(0, 0.05, 6), strict=True)
    q = sum((size * np.sin(2 * np.pi * f * TIME + phase) for f, phase, size in lines), np.zeros(len(TIME)))
    dq = np.gradient(q, 1 / RATE)
    return q, 0.03 * np.gradient(dq, 1 / RATE) + 0.8 * dq + 40 * q + 2


def noise(size: float, seed: int) -> Numbers:
    return size * np.random.default_rng((1, seed)).normal(size=len(TIME))


@pytest.mark.parametrize("rate", [3e-4, 3e-3, 1e-2])
@pytest.mark.parametrize("value", [9999.0, 0.0, None], ids=["sentinel", "zero", "spike"])
@pytest.mark.parametrize("channel", ["position", "torque"])
def test_glitches_are_found(channel: str, value: float | None, rate: float) -> None:
    position, torque = joint(3)
    good = position + noise(1e-5, 1) if channel == "position" else torque + noise(0.05, 2)
    random = np.random.default_rng(4)
    at = random.uniform(size=len(TIME)) < rate
    at[:8] = at[-8:] = False
    spoilt = np.where(at, good + random.choice([-1, 1], len(TIME)) * good.std() if value is None else value, good)
    # In a cluster of three or more neither side is smooth; what is as small as the noise does no harm.
    clear = at & (np.abs(spoilt - good) > 40 * (1e-5 if channel == "position" else 0.05))
    found = glitches(spoilt)
    assert (found & clear).sum() >= 0.93 * clear.sum()
    assert (found & ~at).sum() <= 0.12 * at.sum()


@pytest.mark.parametrize(
    "good",
    [
        pytest.param(joint(5)[1] + noise(0.05, 5), id="torque"),
        pytest.param(np.round(joint(6)[0] / 1e-3) * 1e-3, id="coarse encoder"),
        pytest.param(chirp(TIME, 0.5, 30, 60), id="chirp without noise"),
        pytest.param(np.sign(np.sin(5 * TIME)) + noise(1e-3, 7), id="steps"),
        pytest.param(np.where(TIME % 2 < 0.05, 1.0, 0.0) + noise(1e-3, 8), id="pulses of 25 samples"),
    ],
)
def test_good_signals_have_no_glitches(good: Numbers) -> None:
    assert not glitches(good).any()


def test_gaps_are_no_glitches() -> None:
    torque = joint(8)[1] + noise(0.05, 8)
    torque[1000:1010] = torque[2000] = np.nan
    torque[5000] += 30
    assert np.flatnonzero(glitches(torque)).tolist() == [5000]


@pytest.mark.parametrize("before", [0.002, 0.03], ids=["little noise", "noise"])
@pytest.mark.parametrize("behind", [0.0, 0.002, 0.02], ids=["exact", "2 mN m behind", "noise behind"])
@pytest.mark.parametrize("limit", [0.5, 1.0, 1.5])
def test_limits_are_found(limit: float, behind: float, before: float) -> None:
    position, torque = joint(9)
    size = torque.std()
    measured = torque - 2 + size * noise(before, 9)
    cut = np.clip(measured, -limit * size, limit * size) + size * noise(behind, 10)
    found = torque_limits(cut, position + noise(1e-5, 11), RATE)
    at = np.any([one.at for one in found], axis=0)
    beyond = np.abs(measured) >= limit * size
    assert (at & beyond).sum() > 0.9 * beyond.sum()
    assert at.mean() < beyond.mean() + 0.08
    np.testing.assert_allclose(np.abs([one.value for one in found]), limit * size, rtol=0.05)


ON = 5 * np.pi > TIME
"""For whole periods of three radians a second."""


SLOW = 0.3 * np.sin(0.2 * np.pi * TIME)


def held_positions() -> Numbers:
    """Steps of half a second between two angles, with a rest at each."""
    phase = np.clip((TIME % 2) / 0.5, 0, 1)
    rise = phase**3 * (10 - 15 * phase + 6 * phase**2)
    return np.where(TIME // 2 % 2 == 0, rise, 1 - rise)


@pytest.mark.parametrize(
    ("position", "torque"),
    [
        pytest.param(joint(12)[0], joint(12)[1] + noise(0.05, 12), id="nothing"),
        pytest.param(SLOW, 40 * SLOW - 150 * SLOW**3 + noise(0.05, 12), id="three peaks of a softening spring"),
        pytest.param(np.sin(3 * TIME), 20 * np.sin(3 * TIME), id="sine without noise"),
        pytest.param(held_positions(), 40 * held_positions() + noise(0.05, 13), id="a joint that is held"),
        pytest.param(
            np.cumsum(np.cumsum(np.sign(np.sin(3 * TIME + 1e-9)))) / RATE**2,
            5 * np.sign(np.sin(3 * TIME + 1e-9)) + noise(0.02, 14),
            id="even acceleration",
        ),
        pytest.param(np.sin(3 * TIME) * ON, 20 * (np.sin(3 * TIME) + 1) * ON, id="motor off"),
    ],
)
def test_good_torques_have_no_limits(position: Numbers, torque: Numbers) -> None:
    assert torque_limits(torque, position, RATE) == ()


def test_held_samples_are_told_from_a_slow_encoder() -> None:
    position = joint(15)[0]
    found = held_updates(np.repeat(position[::10], 10))
    assert found is not None
    np.testing.assert_array_equal(found, np.arange(0, len(position), 10))
    assert held_updates(position) is None
    assert held_updates(np.round(position / 5e-3) * 5e-3) is None


def test_real_recordings_have_few_glitches_and_no_limit(data_folder: object) -> None:
    table = np.loadtxt(f"{data_folder}/ankle/z_df2.csv", delimiter=",", skiprows=1)
    for column in (1, 2):
        assert glitches(table[:, column]).mean() < 1e-3
    assert torque_limits(table[:, 2], table[:, 1], 1000.0) == ()


@pytest.mark.parametrize("levels", [3, 4, 5, 6])
def test_converters_of_few_levels_are_judged(levels: int) -> None:
    position, torque = joint(6)
    step = np.ptp(torque) / (levels - 1)
    for limit in torque_limits(step * np.round(torque / step), position, RATE):
        assert limit.at.any()
