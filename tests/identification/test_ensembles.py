"""What the windows of a record say together: masses below zero, parameters that no window determines, windows that do
not predict the next one, and parameters that change."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from factories.joints import TRUTH, joint
from jaximp.cli.identify import _say_result
from jaximp.identification.estimates import Estimates
from jaximp.identification.filter_settings import FilterSettings
from jaximp.identification.identify import estimate
from jaximp.identification.pipeline import Pipeline, WindowSettings
from jaximp.models import HumanJoint, RobotJoint
from jaximp.recordings.load import recording_from_arrays
from jaximp.trust.verdicts import POOR, WEAK
from jaximp.types import Recording

Numbers = NDArray[np.float64]

RATE = 500.0
TIME = np.arange(0, 40, 1 / RATE)


def two_sines(w: tuple[float, float], size: float, other: float, time: Numbers = TIME) -> tuple[Numbers, ...]:
    """Position, velocity and acceleration."""
    parts = zip((size, other), w, (0.0, 1.0), strict=True)
    phases = [(a, f, f * time + p) for a, f, p in parts]
    return (
        sum((a * np.sin(x) for a, _, x in phases), np.zeros(len(time))),
        sum((a * f * np.cos(x) for a, f, x in phases), np.zeros(len(time))),
        sum((-a * f**2 * np.sin(x) for a, f, x in phases), np.zeros(len(time))),
    )


def robot_of(recording: Recording, noise: str) -> Estimates:
    """Inertia and frictions, in windows of 5 s."""
    settings = FilterSettings(position_cutoff=20, decimation_cutoff=10)
    windows = WindowSettings(5.0, step=0.5, noise=noise)
    return estimate(Pipeline(RATE, RobotJoint(gravity=False, offset=True), windows, settings), recording)[0]


@cache
def presliding(noise: str) -> Estimates:
    """A wrist on a harmonic drive, whose friction is that of Dahl: a spring before it slides."""
    random = np.random.default_rng(0)
    q, dq, ddq = two_sines((2 * np.pi * 0.21, 2 * np.pi * 0.47), 1.0, 0.4)
    coulomb, slide = 0.22, 0.05
    friction = np.zeros(len(TIME))
    for k in range(len(TIME) - 1):
        friction[k + 1] = friction[k] + (dq[k] - abs(dq[k]) * friction[k] / coulomb) * coulomb / slide / RATE
    measured = q + 2e-5 * random.normal(size=len(TIME))
    torque = 0.003 * ddq + 0.05 * dq + friction + 0.3 * random.normal(size=len(TIME))
    return robot_of(recording_from_arrays(TIME, measured, torque), noise)


@pytest.mark.parametrize("noise", ["estimated", pytest.param("filtered", marks=pytest.mark.slow)])
def test_masses_below_zero_in_most_windows_are_not_trusted(noise: str) -> None:
    """Hardly a window is far enough below zero to be refused for itself; all together are."""
    estimates = presliding(noise)
    k = estimates.names.index("inertia")
    assert (estimates.value[:, k] < 0).mean() > 0.5
    assert (estimates.measured[0].negative_inertia > estimates.limits.max_negative_inertia).mean() < 0.2
    assert not estimates.trusted.any()
    assert not estimates.trusted_in("inertia").any()
    assert (estimates.verdicts.verdict == POOR).all()
    alone = replace(estimates, measured=tuple(replace(x, mass_below_zero=-np.inf) for x in estimates.measured))
    assert alone.trusted.any() == (noise == "filtered")  # else a test of the model has found the friction too


@cache
def light() -> Estimates:
    """A robot whose inertia hardly matters in this motion."""
    random = np.random.default_rng(0)
    q, dq, ddq = two_sines((1.3, 2.9), 1.0, 0.4)
    torque = 0.003 * ddq + 0.05 * dq + 0.22 * np.sign(dq) + 0.4 * random.normal(size=len(TIME))
    return robot_of(recording_from_arrays(TIME, q + 1e-5 * random.normal(size=len(TIME)), torque), "estimated")


def test_a_parameter_that_is_not_determined_is_said_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    """Its error is small against what would explain the torque, and so the window is trusted; not against itself."""
    estimates = light()
    assert estimates.trusted.all()
    found = estimates.undetermined()
    assert "inertia" in found
    assert "coulomb_friction" not in found
    k = estimates.names.index("inertia")
    size = np.average(estimates.value[:, k], weights=1 / estimates.stderr[:, k] ** 2)
    assert found["inertia"] == pytest.approx(np.median(estimates.stderr[:, k]) / size)
    _say_result(estimates)
    said = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line.startswith("  ")}
    assert "not determined: its standard error in one window is" in said["inertia"]
    assert "not determined" not in said["coulomb_friction"]


# ---- A human who drifts slowly.

SLOW_RATE, SLOW_TRUTH = 200.0, (0.08, 0.8, 10.0)


@cache
def drifting(position_cutoff: float = 20.0, noise: str = "estimated") -> Estimates:
    """Torque that wanders below 0.5 Hz, beside a motion at 0.7 and 1.3 Hz."""
    random, time = np.random.default_rng(0), np.arange(0, 60, 1 / SLOW_RATE)
    q, dq, ddq = two_sines((4.4, 8.2), 0.2, 0.1, time)
    drift = sosfiltfilt(butter(2, 0.5, fs=SLOW_RATE, output="sos"), random.normal(size=len(time)))
    inertia, damping, stiffness = SLOW_TRUTH
    torque = inertia * ddq + damping * dq + stiffness * q + 2.5 * drift / drift.std()
    torque += 0.02 * random.normal(size=len(time))
    recording = recording_from_arrays(time, q + 1e-5 * random.normal(size=len(time)), torque)
    settings = FilterSettings(position_cutoff=position_cutoff, decimation_cutoff=10)
    return estimate(Pipeline(SLOW_RATE, HumanJoint(), WindowSettings(2.0, step=0.5, noise=noise), settings), recording)[
        0
    ]


@pytest.mark.slow
@pytest.mark.compiles
def test_beside_a_slow_drift_noise_of_the_position_is_named_and_the_remedy_helps() -> None:
    """Frequencies without drift count more, where the encoder's noise builds the columns. The bias of inertia and
    stiffness is taken off as far as it is known; the reason names the noise, and a lower cut-off of the position needs
    no correction."""
    estimates = drifting()
    assert (estimates.verdicts.verdict == WEAK).all()
    assert all("position noise alone builds" in reason for reason in estimates.verdicts.reason)
    assert all("filter.position_cutoff" in reason for reason in estimates.verdicts.reason)

    def biased(of: Estimates) -> Numbers:
        """How far the mean of windows side by side is from the truth, in its errors."""
        value, stderr = of.value[::4, :3], of.stderr[::4, :3]
        return (value.mean(axis=0) - SLOW_TRUTH) / np.sqrt((stderr**2).sum(axis=0)) * len(value)

    mended = drifting(position_cutoff=5.0)
    assert np.abs(biased(estimates)).max() < 3
    assert np.abs(biased(mended)).max() < 2
    # Few windows can be trusted in the stiffness, those where it comes out large: all of them are asked.
    relative = np.median(mended.stderr, axis=0) / np.abs(mended.value.mean(axis=0))
    assert relative[[0, 2]].min() > 2 * mended.limits.max_relative_stderr
    assert "inertia" in mended.undetermined()
    assert "damping" not in mended.undetermined()


def test_windows_that_do_not_predict_the_next_are_counted(capsys: pytest.CaptureFixture[str]) -> None:
    """With the noise taken as white windows are trusted that the drift has spoiled; it is said of how many."""
    estimates = drifting(noise="filtered")
    count = int((estimates.trusted & (estimates.held_out_vaf < 0)).sum())
    assert count > 10
    assert estimates.unpredictive.sum() == count
    _say_result(estimates)
    said = f"of the trusted, {count} predict the torque of the next window worse than a constant would"
    assert said in capsys.readouterr().out
    assert not light().unpredictive.any()


# ---- Parameters that change.


def test_a_stiffness_that_changes_is_noted_and_a_constant_one_is_not() -> None:
    """It is no verdict: stiffness may change."""
    steady, time = joint(seed=3), np.arange(8000) * 1e-3
    stiffer = joint(seed=3, stiffness=2 * TRUTH["stiffness"])
    torque = np.where(time < 4, steady.torque[:, 0], stiffer.torque[:, 0])
    stepped = recording_from_arrays(time, steady.position[:, 0], torque)
    settings = FilterSettings(position_cutoff=40, decimation_cutoff=20)

    def notes(recording: Recording) -> list[str]:
        found = estimate(Pipeline(1000.0, HumanJoint(), WindowSettings(1.0, step=0.1), settings), recording)[0]
        assert found.trusted.mean() > 0.7
        return [note for note in found.notes if "not the same" in note]

    assert notes(steady) == []
    (note,) = notes(stepped)
    found = re.fullmatch(
        r"stiffness is not the same in all windows: (\S+) until (\S+) s, then (\S+) N m/rad, p < 0.001", note
    )
    assert found is not None, note
    low, when, high = map(float, found.groups())
    assert low == pytest.approx(20, abs=1.5)
    assert high == pytest.approx(40, abs=1.5)
    assert 3 < when < 5


def test_of_several_joints_it_is_said_which_one_changes() -> None:
    from jaximp.identification.identify import _notes_side_by_side

    one, other = (replace(light(), notes=("of both", text)) for text in ("a", "b"))
    assert list(_notes_side_by_side([one, other])) == ["of both", "joint 1: a", "joint 2: b"]


def test_where_the_noise_is_taken_as_white_errors_may_be_too_small() -> None:
    """A drift scatters windows further than errors of white noise allow."""
    found = [note for note in drifting(noise="filtered").notes if "not the same" in note]
    assert len(found) >= 2
    assert all(note.endswith("; or its errors are too small, since the noise was taken as white") for note in found)
    assert not [note for note in light().notes if "not the same" in note]
