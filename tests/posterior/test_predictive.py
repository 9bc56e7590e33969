"""Predictions: scores of unseen rows, and bands of the torque."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.stats import multivariate_normal, norm
from scipy.stats import t as student

from factories.densities import THETA, record
from jaximp.least_squares.noise import whiten
from jaximp.posterior.predictive import log_score, log_scores, torque_bands


def test_score_is_the_log_predictive_density_of_unseen_rows() -> None:
    W, y = record()
    samples = np.array([[*THETA, -1.0], [*(1.1 * THETA), -0.5]])
    rows = whiten(W, y, valid=np.arange(60) > 4)
    each = [norm.pdf(y, W @ s[:3], np.exp(s[3])) for s in samples]
    expected = np.log(np.mean(each, axis=0))
    np.testing.assert_allclose(log_scores(samples, rows)[5:, 0], expected[5:])
    assert not log_scores(samples, rows)[:5].any()
    np.testing.assert_allclose(log_score(samples, rows)[0], expected[5:].mean())
    heavy = np.log(np.mean([student.pdf(y, 4, W @ s[:3], np.exp(s[3])) for s in samples], axis=0))
    np.testing.assert_allclose(log_score(samples, rows, heavy_tails=True)[0], heavy[5:].mean())
    # Whatever made the noise white: of all rows together it is the density of the torque.
    r = 0.8 ** np.arange(50)
    whole = log_scores(samples[:1], whiten(W, y, r)).sum()
    covariance = np.exp(-2.0) * (toeplitz(np.r_[r, np.zeros(10)]) + 1e-8 * 9 * np.eye(60))
    np.testing.assert_allclose(whole, multivariate_normal.logpdf(y, W @ THETA, covariance), rtol=1e-6)
    with pytest.raises(ValueError, match="samples have 3 columns"):
        log_score(samples[:, :3], rows)


def test_bands_hold_their_share_of_the_torque() -> None:
    W, y = record(2000)
    samples = np.tile([*THETA, np.log(0.3)], (400, 1))
    low, middle, high = torque_bands(samples, W, (0.1, 0.5, 0.9))
    assert abs(np.mean((y > low) & (y < high)) - 0.8) < 0.04
    np.testing.assert_allclose(middle, W @ THETA, atol=0.1)
    two = torque_bands(np.c_[samples, samples[:, 3]], np.stack([W, W], axis=1), (0.1, 0.9), noise=False)
    np.testing.assert_allclose(two[0], np.stack([W @ THETA] * 2, axis=1), rtol=1e-9)


@pytest.mark.parametrize(("heavy_tails", "nu"), [(True, 4.0), (3.0, 3.0)])
def test_bands_of_heavy_tails_reach_as_far_as_these(heavy_tails: bool | float, nu: float) -> None:
    W, _ = record(2000)
    y = W @ THETA + 0.3 * np.random.default_rng(1).standard_t(nu, 2000)
    samples = np.tile([*THETA, np.log(0.3)], (400, 1))
    low, high = torque_bands(samples, W, (0.025, 0.975), heavy_tails=heavy_tails)
    assert abs(np.mean((y > low) & (y < high)) - 0.95) < 0.02
    assert abs(np.median(high - low) / (0.6 * student.ppf(0.975, nu)) - 1) < 0.05
    # Those of Gaussian noise of the same scale are too narrow.
    low, high = torque_bands(samples, W, (0.025, 0.975))
    assert np.mean((y > low) & (y < high)) < 0.92
