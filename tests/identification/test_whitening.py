"""White rows: several outputs, noise that follows the motion, and further columns through the same filter."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import lfilter

from jaximp.identification.filter_settings import FilterSettings
from jaximp.identification.pipeline import Pipeline, WindowSettings
from jaximp.identification.rows import Rows
from jaximp.identification.whitening import White, rows_apart, whiten
from jaximp.models import HumanJoint

Numbers = NDArray[np.float64]

N, RATE, THETA = 6000, 100.0, np.array([3.0, -1.0, 2.0])
PLAIN = Pipeline(RATE, HumanJoint(), WindowSettings(2.0), FilterSettings())


def columns(random: np.random.Generator, *shape: int) -> Numbers:
    """(N, *shape, 3)"""
    return random.normal(size=(N, *shape, 3))


def made(W: Numbers, noise: Numbers, valid: NDArray[np.bool_] | None = None, pipeline: Pipeline = PLAIN) -> White:
    """White rows of a torque with this noise."""
    valid = np.ones(noise.shape, bool) if valid is None else valid
    return whiten(pipeline, Rows(W, W @ THETA + noise, valid, np.arange(N) / RATE))


def residual(white: White) -> Numbers:
    """(N, *n) of the true parameters."""
    return np.asarray(white.torque - white.W @ THETA)


def test_several_outputs_have_noise_of_their_own_and_weigh_as_much_as_they_are_known() -> None:
    random = np.random.default_rng(1)
    noise = random.normal(size=(N, 2))
    noise[:, 1] = 5 * lfilter([1.0], [1.0, -0.9], noise[:, 1])
    white = made(columns(random, 2), noise)
    assert white.noise[0].order == 0
    assert white.noise[1].polynomial[1] == pytest.approx(-0.9, abs=0.05)
    np.testing.assert_allclose(white.size, [1.0, 5.0], rtol=0.05)
    left = residual(white)
    np.testing.assert_allclose(left.std(axis=0), 1.0, rtol=0.05)
    correlation = (left[1:] * left[:-1]).mean(axis=0)
    assert np.abs(correlation).max() < 3.5 / np.sqrt(N)
    assert np.abs(np.corrcoef(noise[1:, 1], noise[:-1, 1])[0, 1]) > 0.8


def test_rows_that_do_not_count_are_zero_and_the_noise_starts_again_after_them() -> None:
    random = np.random.default_rng(2)
    W, valid = columns(random), np.ones(N, bool)
    valid[1000:1100] = False
    noise = lfilter([1.0], [1.0, -0.8], random.normal(size=N))
    white = made(W, np.where(valid, noise, 1e6), valid)
    left = residual(white)
    assert (white.torque[~valid] == 0).all()
    assert (white.W[~valid] == 0).all()
    assert np.abs(left).max() < 6
    # the first row after a gap is worth less, by what the past would have said of it
    np.testing.assert_allclose(white.W[1100], W[1100] * np.sqrt(np.prod(1 - white.noise[0].reflections ** 2)))


def test_errors_grow_where_the_noise_is_in_proportion_to_the_motion() -> None:
    """Noise as large as a Gaussian column: the fourth moment is three, where the textbook takes one."""
    random = np.random.default_rng(3)
    W, noise = columns(random), random.normal(size=N)
    np.testing.assert_allclose(made(W, noise).inflation, 1.0, atol=0.05)
    np.testing.assert_allclose(made(W, noise * W[:, 0]).inflation ** 2, [3.0, 1.0, 1.0], rtol=0.2)


def test_without_enough_rows_the_textbook_stands() -> None:
    random = np.random.default_rng(4)
    W, valid = columns(random), np.arange(N) < 150
    assert (made(W, random.normal(size=N) * W[:, 0], valid).inflation == 1).all()


def test_a_joint_that_changes_in_one_window_makes_no_other_unsure() -> None:
    """It changes while it moves most, so that what is left stands where it counts most."""
    random = np.random.default_rng(4)
    W, noise, within = columns(random), random.normal(size=N), np.arange(N) % 200
    W[:, 0] *= np.where((within >= 80) & (within < 120), 1.0, 0.05)
    changed = (np.arange(N) // 200 == 7) * np.where(within < 100, -30, 30) * W[:, 0]
    np.testing.assert_allclose(made(W, noise).inflation, 1.0, atol=0.05)
    np.testing.assert_allclose(made(W, noise + changed).inflation, 1.0, atol=0.05)


def test_further_columns_pass_the_filter_of_the_last_output() -> None:
    random = np.random.default_rng(5)
    filtered = Pipeline(RATE, HumanJoint(), WindowSettings(2.0), FilterSettings(decimation_cutoff=20.0, decimate=1))
    W = columns(random, 2)
    valid = np.ones((N, 2), bool)
    valid[300:330] = False
    noise = lfilter([1.0], [1.0, -0.9], random.normal(size=(N, 2)), axis=0) * [1.0, 4.0]
    white = made(W, noise, valid, filtered)
    assert white.filtered.order > 0
    assert white.noise[1].order > 0
    np.testing.assert_allclose(white.apply(W[:, 1], valid[:, 1]), white.W[:, 1], rtol=1e-12)
    np.testing.assert_allclose(white.apply(W[:, 1, 0], valid[:, 1]), white.W[:, 1, 0], rtol=1e-12)


@pytest.mark.parametrize(("cutoff", "decimate", "apart"), [(None, None, 1), (5.0, 1, 9), (5.0, 4, 2), (5.0, 20, 1)])
def test_rows_that_a_low_pass_made_alike_count_once(cutoff: float | None, decimate: int | None, apart: int) -> None:
    filters = FilterSettings(decimation_cutoff=cutoff, decimate=decimate)
    assert rows_apart(Pipeline(RATE, HumanJoint(), WindowSettings(2.0), filters)) == apart
