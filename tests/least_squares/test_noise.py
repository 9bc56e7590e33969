"""Noise of a record: whitened rows against dense covariances, autoregressions, and tests of what is left."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from scipy.linalg import solve_triangular, toeplitz
from scipy.signal import fftconvolve, lfilter
from scipy.stats import chi2, kstest

from factories.densities import BAND_PASS, LOW_PASS, THETA, Numbers, record
from jaximp import signals
from jaximp.least_squares.noise import (
    Noise,
    disagreement,
    fit_autoregression,
    fit_noise,
    optimum,
    residuals,
    whiten,
    whiteness,
)


@pytest.mark.parametrize("gap", [False, True])
@pytest.mark.parametrize("every", [40, 80])
def test_whitened_rows_are_those_of_the_dense_covariance(every: int, gap: bool) -> None:
    r = signals.autocovariance(LOW_PASS, every)
    random = np.random.default_rng(1)
    W, y, valid = random.normal(size=(100, 3)), random.normal(size=100), np.ones(100, bool)
    if gap:
        valid[[3, 4, 5, 40, 41, 99]] = False
        W[4], y[41] = np.nan, np.inf
    rows = whiten(W, y, r, valid)
    ridge = 1e-8 * np.abs(np.fft.fft(np.r_[r, np.zeros(4000), r[:0:-1]])).max()
    C = toeplitz(np.r_[r, np.zeros(100)][:100])[np.ix_(valid, valid)]
    expected = solve_triangular(np.linalg.cholesky(C + ridge * np.eye(len(C))), W[valid], lower=True)
    np.testing.assert_allclose(rows.W[valid, 0], expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())
    assert not rows.W[~valid].any()
    values = np.linalg.eigvalsh(C)
    np.testing.assert_allclose(rows.count, (values / (values + ridge)).sum(), atol=0.05)


@pytest.mark.parametrize("sos", [LOW_PASS, BAND_PASS], ids=["low-pass", "band-pass"])
def test_thinned_rows_lose_next_to_nothing(sos: Numbers) -> None:
    """Of rows at the full rate, and of those that a user decimated."""
    random = np.random.default_rng(3)
    t = np.arange(6000) / 1000
    q = sum(
        np.sin(2 * np.pi * f * t + phase) for f, phase in zip((0.7, 1.9, 3.1), random.uniform(0, 6, 3), strict=True)
    )
    W = np.asarray(signals.filter_zero_phase(sos, np.stack([np.gradient(q, t), q], axis=1)))[1500:4500]
    found = []
    for every in (1, 10, 40):
        rows = whiten(W[::every], W[::every] @ [1.0, 2.0], signals.autocovariance(sos, every))
        assert 60 <= len(rows.y) <= 80
        assert len(rows.y) - 3 < rows.count[0] <= len(rows.y)
        R = rows.triangles()[0, :2, :2] * np.sqrt(signals.kept_variance(sos)) ** -1
        found.append(np.linalg.inv(R.T @ R))
    C = toeplitz(np.r_[signals.autocovariance(sos, 10), np.zeros(300)][:300])
    values, vectors = np.linalg.eigh(C)
    kept = values > 1e-6 * values[-1]
    projected = (vectors[:, kept] / np.sqrt(values[kept])).T @ W[::10]
    dense = np.linalg.inv(projected.T @ projected) * signals.kept_variance(sos)
    for covariance in found:
        np.testing.assert_allclose(np.diag(covariance), np.diag(dense), rtol=0.08)


def test_long_records_do_not_need_dense_matrices() -> None:
    r, n = signals.autocovariance(LOW_PASS, 40), 100_000
    rows = whiten(np.ones((n, 1)), np.zeros(n), r)
    assert len(rows.y) == n
    with pytest.raises(ValueError, match="too much to whiten"):
        whiten(np.ones((n, 1)), np.zeros(n), 0.9999 ** np.arange(40_000))


def test_whiteness_is_that_of_statsmodels_and_knows_gaps() -> None:
    statsmodels = pytest.importorskip("statsmodels.stats.diagnostic")
    random = np.random.default_rng(0)
    e = random.normal(size=400)
    e -= e.mean()
    expected = statsmodels.acorr_ljungbox(e, lags=[20])
    test = whiteness(e)
    np.testing.assert_allclose([test.statistic, test.p], [expected.lb_stat.iloc[0], expected.lb_pvalue.iloc[0]])
    valid = random.uniform(size=400) > 0.2
    statistics = [whiteness(np.where(valid, x, np.nan), valid).statistic for x in random.normal(size=(300, 400))]
    assert kstest(statistics, chi2(20).cdf).pvalue > 1e-3
    # Coefficients that were fitted to the residuals are taken off the degrees of freedom.
    expected = statsmodels.acorr_ljungbox(e, lags=[25], model_df=6)
    np.testing.assert_allclose(whiteness(e, lags=25, fitted=6).p, expected.lb_pvalue.iloc[0])
    assert np.isnan(whiteness(e, lags=6, fitted=6).p)


def test_autoregression_is_found_where_the_residuals_demand_it() -> None:
    random = np.random.default_rng(0)
    e = lfilter([1], [1, -0.7, 0.3], random.normal(size=4000))
    np.testing.assert_allclose(fit_autoregression(e), [0.7, -0.3], atol=0.05)
    valid = np.ones(4000, bool)
    valid[1000:1100] = valid[2500:2505] = False
    np.testing.assert_allclose(fit_autoregression(np.where(valid, e, np.nan), valid), [0.7, -0.3], atol=0.05)
    found = [len(fit_autoregression(x)) for x in random.normal(size=(200, 300))]
    assert np.mean(np.array(found) > 0) < 0.05


def test_rows_with_an_autoregression_are_those_of_the_dense_covariance() -> None:
    random = np.random.default_rng(0)
    W, y = random.normal(size=(50, 2)), random.normal(size=50)
    r = 0.8 ** np.arange(50)
    rows = whiten(W, y, Noise(autoregression=(np.array([0.8]),)))
    expected = solve_triangular(np.linalg.cholesky(toeplitz(r)), W, lower=True)
    np.testing.assert_allclose(rows.W[:, 0], expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(rows.count, 50, rtol=1e-6)


@pytest.mark.parametrize("poles", [[0.9, 0.9], [0.999]])
def test_slow_noise_in_filters_that_keep_much_of_it_can_be_whitened(poles: list[float]) -> None:
    """Its largest variance is so far above the least that little may be cut off from either."""
    n, r = 400, signals.autocovariance(signals.butterworth(4, 40.0, 500.0), 2)
    polynomial = np.poly(poles)
    answer = lfilter([1], polynomial, np.r_[1, np.zeros(20_000)])
    whole = fftconvolve(fftconvolve(answer, answer[::-1]), np.r_[r[:0:-1], r])
    lags = whole[len(whole) // 2 :][:n]
    ridge = 1e-8 * np.abs(np.fft.fft(np.r_[r, np.zeros(4000), r[:0:-1]])).max()
    C = toeplitz(lags) + ridge * np.eye(n)
    columns = np.random.default_rng(0).normal(size=(n, 2))
    W, y = (np.linalg.cholesky(C / lags[0]) @ columns).T
    rows = whiten(W[:, None], y, Noise(r, (-polynomial[1:],)))
    np.testing.assert_allclose(rows.count, (1 - ridge / np.linalg.eigvalsh(C)).sum(), rtol=0.02)
    np.testing.assert_allclose(np.column_stack([rows.W[:, 0], rows.y]), columns, atol=0.05)


def test_noise_of_a_record_is_fitted_output_by_output() -> None:
    random = np.random.default_rng(0)
    W = random.normal(size=(3000, 2, 3))
    e = random.normal(size=(3000, 2))
    e[:, 1] = 5 * lfilter([1], [1, -0.8], e[:, 1])
    noise = fit_noise(W, W @ THETA + e)
    assert len(noise.autoregression[0]) == 0
    np.testing.assert_allclose(noise.autoregression[1], [0.8], atol=0.05)
    rows = whiten(W, W @ THETA + e, noise)
    assert whiteness((rows.y - rows.W @ optimum(rows))[:, 1]).p > 0.01
    with pytest.raises(ValueError, match="2 autoregressions for 1 outputs"):
        whiten(W[:, 0], e[:, 0], noise)


def test_noise_that_the_fit_followed_is_given_back() -> None:
    """Slow columns take slow noise with them; what is left of it looks faster than it was."""
    random, t = np.random.default_rng(0), np.linspace(0, np.pi, 150)
    W = np.cos(np.outer(t, np.arange(8)))
    mended, naive, ideal = [], [], []
    for _ in range(60):
        y = lfilter([1], [1, -0.7], random.normal(size=350))[200:]
        rows = whiten(W, y)
        naive.append(fit_autoregression(residuals(rows, optimum(rows))[:, 0])[0])
        mended.append(fit_noise(W, y).autoregression[0][0])
        ideal.append(fit_autoregression(y)[0])
    gap = np.mean(ideal) - np.mean(naive)
    assert gap > 0.08
    assert abs(np.mean(mended) - np.mean(ideal)) < 0.3 * gap


def test_stretches_have_rows_enough_for_their_parameters() -> None:
    """With fewer, their parameters would follow all noise, and nothing of it be left to be seen."""
    random = np.random.default_rng(0)
    W, e = random.normal(size=(2000, 8)), lfilter([1], [1, -0.7], random.normal(size=2000))
    for stretch in (1, 4, 8, 24):
        np.testing.assert_allclose(fit_noise(W, e, stretch=stretch).autoregression[0], [0.7], atol=0.06)
    # Too few rows for two stretches are one.
    whole = fit_noise(W[:47], e[:47]).autoregression
    np.testing.assert_array_equal(fit_noise(W[:47], e[:47], stretch=1).autoregression, whole)
    assert whole
    assert not fit_noise(W[:5], e[:5]).autoregression  # fewer than parameters


@pytest.mark.slow
def test_long_records_are_whitened_piece_by_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    r = signals.autocovariance(BAND_PASS, 20)
    W, y = (np.asarray(signals.filter_zero_phase(BAND_PASS, x))[::20] for x in record(20 * 30 * len(r)))
    n, valid = len(y), np.ones(len(y), bool)
    valid[n // 2 : n // 2 + 40] = False
    pieces = whiten(W, y, r, valid)
    monkeypatch.setattr(importlib.import_module("jaximp.least_squares.noise"), "PIECE", 10**6)
    whole = whiten(W, y, r, valid)
    assert np.abs(pieces.W - whole.W).max() > 0
    left, same = (residuals(rows, optimum(rows)) for rows in (pieces, whole))
    stderr = np.linalg.norm(np.linalg.inv(whole.triangles()[0, :3, :3]), axis=1) * same.std()
    assert (np.abs(optimum(pieces) - optimum(whole)) < 0.01 * stderr).all()
    np.testing.assert_allclose(left.std(), same.std(), rtol=1e-3)
    np.testing.assert_allclose(pieces.size, whole.size, rtol=1e-3)
    np.testing.assert_array_equal(pieces.count, whole.count)


def test_noise_that_is_noise_does_not_move_the_estimate() -> None:
    """Standard normal where the model is right; beyond all errors where it lacks something."""
    r, moved = signals.autocovariance(LOW_PASS, 20), {"noise": [], "lack": []}
    for seed in range(40):
        random = np.random.default_rng(seed)
        u = random.normal(size=(20000, 3)) * [10, 1, 0.1]
        noise = lfilter([1], [1, -0.995], random.normal(size=20000))
        lack = 100 * np.roll(u[:, 2], 40)
        for case, torque in (("noise", u @ THETA + 0.3 * noise), ("lack", u @ THETA + 0.3 * noise + lack)):
            rows = np.asarray(signals.filter_zero_phase(LOW_PASS, np.column_stack([u, torque])))[::20]
            found = fit_noise(rows[:, :3], rows[:, 3], r)
            assert found.autoregression
            moved[case].append(disagreement(rows[:, :3], rows[:, 3], found))
    z = np.array(moved["noise"])
    assert (np.abs(z.mean(axis=0)) < 4 * z.std(axis=0) / np.sqrt(len(z))).all()
    assert ((z.std(axis=0) > 0.7) & (z.std(axis=0) < 1.35)).all()
    assert np.median(np.abs(moved["lack"]), axis=0)[2] > 4
    assert not disagreement(rows[:, :3], rows[:, 3], Noise(r)).any()


def test_a_change_from_stretch_to_stretch_is_no_noise() -> None:
    W, y = record(4000, noise=1.0)
    motion = 0.3 * np.sin(np.arange(4000) / 10)
    W[:, 2] = motion
    y = W @ THETA + np.where(np.arange(4000) < 2000, 0, 10) * motion + np.random.default_rng(1).normal(size=4000)
    assert fit_noise(W, y).autoregression
    assert not fit_noise(W, y, stretch=500).autoregression
