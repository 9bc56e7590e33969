"""Rows of windows that are filtered each by itself, against a loop over the windows with scipy's filters."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import sosfiltfilt

from jaximp.identification import FilterSettings, WindowSettings
from jaximp.identification.filter_settings import Filters
from jaximp.identification.literal import noise_in_windows, regress_in_windows
from jaximp.jobs import HumanSettings, ModelSettings, RobotSettings, WindowJob
from jaximp.models import Model
from jaximp.recordings.load import recording_from_arrays
from jaximp.signals import differentiate
from jaximp.types import Recording

RATE = 1000.0


def recording(n_joints: int) -> Recording:
    time = np.arange(900) / RATE
    phase = np.arange(n_joints)
    q = 1 + 2 * np.sin(9 * time[:, None] + phase) + 0.3 * np.sin(40 * time[:, None] + 2 * phase)
    torque = np.cos(7 * time[:, None] + phase) + np.random.default_rng(0).normal(size=q.shape)
    return recording_from_arrays(time, q, torque)


def job(step: float, **filters: float | int | str | None) -> WindowJob:
    settings: dict[str, Any] = {"position_cutoff": 60.0, "position_order": 8, "decimation_cutoff": 20.0} | filters
    return WindowJob(
        recording={},
        model=ModelSettings(HumanSettings(offset="high_pass" not in filters), RobotSettings()),
        window=WindowSettings(0.3, step, min_velocity=0.5),
        filter=FilterSettings(**settings, mode="window", drop_transient=False),
    )


def rows_of(
    model: Model, filters: Filters, q: NDArray[np.float64], torque: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """One window's columns, and its torque as a last one; and the speed."""
    q, torque = (x[:, 0] if x.shape[1] == 1 else x for x in (q, torque))
    if filters.position is not None:
        q = sosfiltfilt(np.array(filters.position), q, axis=0)
    dq, ddq = (np.asarray(x) for x in differentiate(q, RATE, filters.differentiator))
    both = np.concatenate([np.asarray(model.observation_matrix(q, dq, ddq)), torque[..., None]], axis=-1)
    if filters.parallel is not None:
        both = sosfiltfilt(np.array(filters.parallel), both, axis=0)
    return both[:: filters.decimate], np.abs(dq)[:: filters.decimate]


@pytest.mark.parametrize(
    ("n_joints", "step", "filters"),
    [
        (1, 0.002, {}),
        (1, 0.04, {"position_cutoff": None}),
        (1, 0.04, {"decimation_cutoff": None, "decimate": 3}),
        (1, 0.04, {"high_pass": 2.0, "decimate": 1}),
        (2, 0.05, {}),
        (1, 0.7, {}),
        (1, 0.04, {"derivatives": "central"}),
    ],
    ids=["many windows", "position as it is", "no parallel filter", "all rows", "two joints", "one window", "central"],
)
def test_every_window_is_filtered_by_itself(
    n_joints: int, step: float, filters: dict[str, float | int | str | None]
) -> None:
    measured, wanted = recording(n_joints), job(step, **filters)
    robot, human = wanted.models(measured.joints)
    assert robot is not None
    assert human is not None
    model = robot + human
    pipeline = wanted.pipeline_for(measured)
    designed, rows = pipeline.filters, regress_in_windows(pipeline, measured, model)
    starts = np.arange(0, 900 - 300 + 1, round(step * RATE))
    cuts = [slice(start, start + 300) for start in starts]
    expected, speed = (
        np.concatenate(parts)
        for parts in zip(
            *(rows_of(model, designed, measured.position[c], measured.torque[c]) for c in cuts), strict=True
        )
    )
    found = np.concatenate([rows.W, rows.torque[..., None]], axis=-1)
    scale = np.abs(expected).reshape(-1, expected.shape[-1]).max(axis=0)
    assert (np.abs(found - expected) <= 1e-9 * scale).all()
    np.testing.assert_array_equal(rows.valid, speed >= 0.5)
    np.testing.assert_array_equal(rows.time, np.concatenate([measured.time[c][:: designed.decimate] for c in cuts]))


def test_noise_of_a_window_is_the_filters_matrix_times_itself() -> None:
    measured, wanted = recording(1), job(0.05)
    pipeline = wanted.pipeline_for(measured)
    designed = pipeline.filters
    response = sosfiltfilt(np.array(designed.parallel), np.eye(300), axis=0)[:: designed.decimate]
    noise = noise_in_windows(pipeline)
    assert noise is not None
    np.testing.assert_allclose(noise, response @ response.T, atol=1e-12)
