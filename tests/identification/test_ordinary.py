"""Ordinary least squares with errors that know the estimated noise."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import block_diag, toeplitz
from scipy.signal import lfilter, sosfreqz

from jaximp import signals
from jaximp.identification.filter_settings import FilterSettings
from jaximp.identification.identify import estimate, in_windows, solve_windows
from jaximp.identification.pipeline import Pipeline, WindowSettings
from jaximp.identification.prepared import prepare
from jaximp.identification.rows import Rows
from jaximp.identification.whitening import White, ordinary_errors, ordinary_inflation, whiten
from jaximp.least_squares.autoregression import Autoregression, density_of
from jaximp.models import HumanJoint
from jaximp.trust.score_tests import score_groups

Numbers = NDArray[np.float64]

N, RATE, THETA, WINDOW = 6000, 100.0, np.array([3.0, -1.0, 2.0]), 200
PIPELINE = Pipeline(RATE, HumanJoint(), WindowSettings(2.0, estimates="ordinary"), FilterSettings())


def made(W: Numbers, noise: Numbers, pipeline: Pipeline = PIPELINE) -> White:
    """White rows of a torque with this noise."""
    return whiten(pipeline, Rows(W, W @ THETA + noise, np.ones(noise.shape, bool), np.arange(N) / RATE))


@pytest.mark.parametrize("outputs", [1, 2])
def test_errors_are_those_of_the_covariance_of_the_noise_also_around_gaps(outputs: int) -> None:
    random = np.random.default_rng(1)
    W = random.normal(size=(400, outputs, 3))
    W[120:150] = 0  # rows that do not count
    r = np.stack([(1 + j) * (0.97 - 0.1 * j) ** np.arange(80) for j in range(outputs)])
    starts = np.array([0, 70, 100, 320])
    found = ordinary_errors(W[:, 0] if outputs == 1 else W, starts, 80, r)
    for k, start in enumerate(starts):
        rows = W[start : start + 80].swapaxes(0, 1).reshape(-1, 3)
        A = np.linalg.pinv(rows)
        covariance = A @ block_diag(*map(toeplitz, r)) @ A.T
        np.testing.assert_allclose(found[k], np.sqrt(np.diagonal(covariance)), rtol=1e-10)


def test_the_noise_has_the_autocovariance_of_both_autoregressions() -> None:
    one, other = Autoregression(np.array([-0.9])), Autoregression(np.array([0.3, -0.5]))
    density = density_of([one, other], 50)
    spike = np.zeros(2000)
    spike[0] = 1
    answer = lfilter([1.0], np.convolve(one.polynomial, other.polynomial), spike)
    expected = [answer[k:] @ answer[: len(answer) - k] for k in range(50)]
    np.testing.assert_allclose(np.fft.irfft(density)[:50], expected, atol=1e-9 * expected[0])


def test_between_rows_that_say_something_new_noise_is_smooth() -> None:
    random = np.random.default_rng(3)
    pipeline = replace(PIPELINE, filter=FilterSettings(decimation_cutoff=10.0, decimate=1))
    n = 10 * N  # the size of smooth noise is known to 2 %
    noise = lfilter([1.0], [1.0, -0.9], random.normal(size=n + N))[N:]
    sections = pipeline.filters.parallel
    assert sections is not None
    # The columns pass the filter too: rows between them then say nothing new of either.
    columns, torque = (np.asarray(signals.filter_zero_phase(sections, x)) for x in (random.normal(size=(n, 3)), noise))
    white = made(columns, torque, pipeline)
    assert white.every > 1
    r = white.autocovariance(60)[0]
    # Of the noise itself, behind the square of the filter's gain.
    f = np.linspace(0, 0.5, 1 << 14)
    gain = np.abs(sosfreqz(np.array(sections), 2 * np.pi * f)[1]) ** 2
    density = gain**2 / np.abs(1 - 0.9 * np.exp(-2j * np.pi * f)) ** 2
    expected = np.fft.irfft(density)[:60]
    np.testing.assert_allclose(r / r[0], expected / expected[0], atol=0.1)
    size = white.windows.rss.sum() / (white.windows.rows - 3 * white.every).sum()
    assert size * r[0] == pytest.approx(expected[0], rel=0.1)


def test_errors_grow_where_the_noise_is_in_proportion_to_the_motion() -> None:
    random = np.random.default_rng(4)
    W = np.ones((N, 3))
    W[:, 1:] = random.normal(size=(N, 2))
    noise = lfilter([1.0], [1.0, -0.8], random.normal(size=N))
    np.testing.assert_allclose(ordinary_inflation(made(W, noise)), 1.0, atol=0.1)
    # White noise of variance x^2 behind a column x: the score of x has the variance E x^4 = 3, and not 1.
    found = ordinary_inflation(made(W, W[:, 1] * random.normal(size=N)))
    np.testing.assert_allclose(found, [1.0, np.sqrt(3), 1.0], rtol=0.1)


def test_parameters_move_as_ordinary_least_squares_has_them() -> None:
    random = np.random.default_rng(5)
    W, z, added = random.normal(size=(N, 3)), random.normal(size=(N, 2)), random.normal(size=(N, 1))
    valid, other = np.ones(N, bool), random.normal(size=(N, 3))
    plain = random.normal(size=(N, 1))
    y = W @ THETA + 0.5 * added[:, 0] + z[:, 0]
    given = W, y, {"added": added}, valid, WINDOW
    (usual,), (moved,) = score_groups(*given), score_groups(*given, moved_in=(other, {"added": plain}))
    assert moved.statistic == usual.statistic
    parts = [slice(first, first + WINDOW) for first in range(0, N, WINDOW)]
    passed = np.mean([np.linalg.lstsq(other[one], plain[one])[0] for one in parts], axis=0)
    np.testing.assert_allclose(moved.move, -passed @ usual.weights, rtol=1e-9)
    (same,) = score_groups(*given, moved_in=(W, {"added": added}))
    np.testing.assert_allclose(same.move, usual.move, rtol=1e-9)
    np.testing.assert_allclose(same.stderr, usual.stderr, rtol=1e-9)


def test_estimates_are_those_of_the_rows_as_they_were_filtered(ankles: ModuleType) -> None:
    """The degrees of freedom are those of white rows, and so is the test of the model."""
    recording = ankles.record(np.random.default_rng(6), "AR(1) of 500 ms", rate=200.0, seconds=24.0)
    prepared = prepare(ankles.pipeline(200.0, estimates="ordinary"), recording)
    found, other = in_windows(prepared)[0], estimate(ankles.pipeline(200.0), recording)[0]
    rows, size = prepared.rows, prepared.pipeline.window_rows
    solved = solve_windows([prepared])[0].solved[0].fit.theta
    for k, theta in enumerate(np.asarray(solved)[1:-1], 1):
        window = slice(k * size, (k + 1) * size)
        np.testing.assert_allclose(theta, np.linalg.lstsq(rows.W[window], rows.torque[window])[0], rtol=1e-8)
    np.testing.assert_array_equal(found.dof, other.dof)
    assert (found.stderr[:, 2] > 1.5 * other.stderr[:, 2]).all()
    assert [one.p for one in found.misfits] == [one.p for one in other.misfits]
    assert found.bands is not None
    assert other.bands is not None
    np.testing.assert_allclose(found.bands.ordinary, other.bands.ordinary, rtol=1e-8)


def test_another_choice_is_refused(ankles: ModuleType) -> None:
    recording = ankles.record(np.random.default_rng(7), rate=200.0, seconds=10.0)
    with pytest.raises(ValueError, match=r"window\.estimates is 'ordinry': did you mean 'ordinary'"):
        estimate(ankles.pipeline(200.0, estimates="ordinry"), recording)
