"""Intervals hold the truth in torque noise of any colour: a small run of experiments/coverage.py."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import t as student

from jaximp.identification.identify import estimate

RECORDS, SECONDS, RATE = 60, 24.0, 200.0
ALLOWED = 0.02


def p_values(ankles: ModuleType, colour: str, noise: str, estimates: str = "generalised") -> NDArray[np.float64]:
    """(RECORDS, 3) of the true inertia, damping and stiffness, in the middle window of every record."""
    pipeline, truth, found = (
        ankles.pipeline(RATE, noise=noise, estimates=estimates),
        list(ankles.TRUTH.values())[:3],
        [],
    )
    for k in range(RECORDS):
        recording = ankles.record(np.random.default_rng((19, k)), colour, rate=RATE, seconds=SECONDS)
        one = estimate(pipeline, recording)[0]
        middle = len(one.value) // 2
        z = (one.value[middle, :3] - truth) / one.stderr[middle, :3]
        found.append(2 * student.sf(np.abs(z), one.dof[middle]))
    return np.array(found)


@pytest.mark.parametrize(
    ("colour", "estimates"),
    [
        ("pink", "generalised"),
        pytest.param("AR(1) of 500 ms", "generalised", marks=pytest.mark.slow),
        pytest.param("pink", "ordinary", marks=pytest.mark.slow),
        pytest.param("AR(1) of 500 ms", "ordinary", marks=pytest.mark.slow),
    ],
)
def test_intervals_hold_the_truth_in_coloured_noise(ankles: ModuleType, colour: str, estimates: str) -> None:
    p = p_values(ankles, colour, "estimated", estimates)
    for level in (0.5, 0.8, 0.95):
        held = (p > 1 - level).mean(axis=0)
        assert np.abs(held - level).max() < ALLOWED + 3.5 * np.sqrt(level * (1 - level) / RECORDS), (level, held)


@pytest.mark.slow
def test_intervals_that_take_coloured_noise_as_white_do_not(ankles: ModuleType) -> None:
    """What the test above would find of `window.noise = 'filtered'`."""
    stiffness = p_values(ankles, "pink", "filtered")[:, 2]
    assert (stiffness > 0.05).mean() < 0.95 - ALLOWED - 3.5 * np.sqrt(0.95 * 0.05 / RECORDS)
