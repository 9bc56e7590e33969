"""Intervals hold the truth where the position is noisy and where parameters change inside windows."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest

from factories.joints import JOB, TRUTH, joint
from jaximp.identification import Estimates, prepare
from jaximp.identification.corrections import changes_between
from jaximp.identification.identify import in_windows, solve_windows
from jaximp.jobs import parse_job
from jaximp.jobs.run import identify_recording
from jaximp.recordings import recording_from_arrays

JOB = JOB.replace("step = 0.1", "step = 1")


def held(estimates: Estimates, truth: np.ndarray) -> np.ndarray:
    low, high = estimates.interval()
    return ((low <= truth) & (truth <= high)).mean(axis=0)


@pytest.mark.slow
@pytest.mark.compiles
def test_a_steady_change_inside_windows_is_no_bias(ankles: ModuleType) -> None:
    """The stiffness changes by up to a third in every window; intervals are for its mean over each."""
    pipeline, found, without = ankles.pipeline(250.0), [], []
    for seed in range(6):
        random = np.random.default_rng(seed)
        moved = ankles.move(random, "chirp", 250.0, 24.0)
        time = np.arange(moved.samples) / 250.0
        stiffness = ankles.STIFFNESS * (1 + np.abs((time + seed) % 12 - 6) / 6)
        torque = moved.through(ankles.impedance) + (stiffness - ankles.STIFFNESS) * moved.position
        recording = recording_from_arrays(time, moved.position, torque + random.normal(0, 0.2, len(time)))
        prepared = solve_windows([prepare(pipeline, recording)])[0]
        estimates = in_windows(prepared)[0]
        truth = np.tile([ankles.INERTIA, ankles.DAMPING, 0, 0], (len(estimates.start), 1))
        truth[:, 2] = [stiffness[(time >= start) & (time < start + 2)].mean() for start in estimates.start]
        found.append(held(estimates, truth))
        without.append(held(replace(estimates, fit=prepared.solved[0].fit), truth))
    assert np.mean(found, axis=0)[:3].min() > 0.85
    assert np.mean(without, axis=0)[[0, 2]].max() < 0.6


def test_what_noise_of_the_position_takes_is_given_back() -> None:
    """White noise of 3 mrad makes the inertia a few errors too small without correction."""
    off, errors = [], []
    for seed in range(6):
        noisy = joint(seed=seed, torque_noise=0.02, position_noise=3e-3)
        estimates = identify_recording(parse_job(JOB.replace("length = 1", "length = 4")), noisy)[0]
        off.append(np.median(estimates.value[:, 0]) / TRUTH["inertia"] - 1)
        errors.append(held(estimates, np.array(list(TRUTH.values()))))
    assert abs(np.mean(off)) < 0.01
    assert np.mean(errors, axis=0)[:3].min() > 0.85


def test_changes_come_from_windows_that_share_no_rows() -> None:
    theta = np.array([[1.0], [2.0], [3.0], [5.0], [9.0]])
    change, variance = changes_between(theta, np.full((5, 1), 0.1), np.ones(5, bool), 1)
    np.testing.assert_allclose(change[:, 0], [1, 1, 1.5, 3, 4])
    np.testing.assert_allclose(variance[[0, 1, 4], 0], [0.02, 0.005, 0.02])
    assert variance[3, 0] > 0.9  # it bends by two


@pytest.mark.parametrize("known", [[False] * 5, [True, False, True, False, True]])
def test_nothing_changes_where_no_neighbour_is_known(known: list[bool]) -> None:
    theta = np.arange(5.0)[:, None]
    change, variance = changes_between(theta, np.ones((5, 1)), np.array(known), 1)
    assert not change.any()
    assert not variance.any()
