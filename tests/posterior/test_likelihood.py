"""Whitened rows, priors and log densities: against dense covariances, scipy's distributions, and simulated records."""

from __future__ import annotations

import importlib
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import solve_triangular, toeplitz
from scipy.optimize import minimize
from scipy.signal import fftconvolve, lfilter
from scipy.stats import chi2, kstest, lognorm, multivariate_normal, multivariate_t, norm
from scipy.stats import t as student

from jaximp import signals
from jaximp.least_squares.noise import (
    Noise,
    attenuation,
    corrected,
    disagreement,
    fit_autoregression,
    fit_noise,
    joined,
    optimum,
    residuals,
    triangles,
    whiten,
    whitened_covariance,
    whiteness,
)
from jaximp.models import PlanarArm
from jaximp.perturbation.stiffness import fit_triangles, merge_triangles, residual_triangle
from jaximp.posterior.densities import (
    STIFFNESS,
    Density,
    adjusted,
    estimate_density,
    linear_density,
    stiffness_density,
    stiffness_matrices,
    window_densities,
)
from jaximp.posterior.predictive import log_score, log_scores, prior_predictive, torque_bands
from jaximp.posterior.priors import LogNormal, MultivariateNormal, Normal, make_prior
from paths import ROOT

Numbers = NDArray[np.float64]

NAMES, UNITS = ("inertia", "damping", "stiffness"), ("kg m^2", "N m s/rad", "N m/rad")
THETA = np.array([0.1, 1.5, 20.0])
LOW_PASS = signals.butterworth(4, 5.0, 1000.0)
BAND_PASS = np.concatenate([LOW_PASS, signals.butterworth(2, 0.5, 1000.0, "highpass")])
DAMPING, STIFF = np.array([[2.4, 1.2], [1.0, 1.4]]), np.array([[29.05, 14.37], [14.37, 17.08]])


def record(n: int = 60, noise: float = 0.3, seed: int = 0) -> tuple[Numbers, Numbers]:
    """Regressor (n, 3) and torque (n,)."""
    random = np.random.default_rng(seed)
    W = random.normal(size=(n, 3)) * [10, 1, 0.1]
    return W, W @ THETA + noise * random.normal(size=n)


def pulses(seed: int = 0, n: int = 300, noise: float = 0.1) -> tuple[Numbers, Numbers, Numbers]:
    """Displacement, velocity and torque (n, 2)."""
    random = np.random.default_rng(seed)
    displacement, velocity = 0.05 * random.normal(size=(n, 2)), random.normal(size=(n, 2))
    return displacement, velocity, velocity @ DAMPING.T + displacement @ STIFF.T + noise * random.normal(size=(n, 2))


def arm_density(**prior: Any) -> Density:
    return stiffness_density(residual_triangle(*pulses()), 300, make_prior((*STIFFNESS, "log_noise"), prior))


# Compiled once for all densities that are made alike.


@eqx.filter_jit
def value(density: Density, theta: Any) -> Any:
    return density(theta)


@eqx.filter_jit
def gradient(density: Density, theta: Any) -> Any:
    return jax.grad(density)(theta)


@eqx.filter_jit
def elements(density: Density, theta: Any) -> Any:
    return density.elements(theta)


@eqx.filter_jit
def jacobian(density: Density, theta: Any) -> Any:
    return jax.jacobian(density.elements)(theta)


@eqx.filter_jit
def curvature(density: Density, theta: Any) -> Any:
    return -jax.hessian(density.likelihood.log_likelihood)(theta)


# Noise


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


def test_density_of_coloured_noise_is_the_multivariate_normal_distribution() -> None:
    r = signals.autocovariance(LOW_PASS, 80)
    C = toeplitz(np.r_[r, np.zeros(60)][:60])
    W, y = record()
    density = linear_density(NAMES, UNITS, whiten(W, y, r))

    def expected(theta: Numbers) -> float:
        return float(multivariate_normal.logpdf(y, W @ theta[:3], np.exp(2 * theta[3]) * C))

    points = np.r_[THETA, -1.0] * np.array([[1, 1, 1, 1], [1.1, 0.9, 1, 0.5], [0.5, 1, 1.2, -0.3]])
    ours = jax.jit(jax.vmap(density))(jnp.asarray(points))
    theirs = np.array([expected(point) for point in points])
    np.testing.assert_allclose(np.diff(ours), np.diff(theirs), rtol=1e-5)


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


# Densities


@pytest.mark.slow
def test_gaussian_density_needs_no_rows_and_is_students_t() -> None:
    W, y = record()
    density = linear_density(NAMES, UNITS, whiten(W, y))
    assert density.names == (*NAMES, "log_noise")
    assert density.units == (*UNITS, "ln(N m)")
    assert density.likelihood.rows.shape == (1, 4, 4)
    theta = jnp.asarray([*(THETA * 1.02), -1.1])
    np.testing.assert_allclose(value(density, theta), norm.logpdf(y, W @ np.asarray(theta[:3]), np.exp(-1.1)).sum())

    # integrated over the logarithm of the noise
    best = np.linalg.lstsq(W, y)[0]
    scale = ((y - W @ best) ** 2).sum() / 57 * np.linalg.inv(W.T @ W)
    points, grid = (
        best + np.sqrt(np.diag(scale)) * np.array([[0, 0, 0], [1, -1, 2], [3, 1, 0.0]]),
        np.linspace(-3, 1, 4001),
    )
    over_noise = jax.vmap(lambda x, s: density(jnp.append(x, s)), (None, 0))
    values = jax.jit(jax.vmap(over_noise, (0, None)))(points, grid)
    marginal = jax.scipy.special.logsumexp(values, axis=1)
    expected = multivariate_t.logpdf(points, best, scale, 57)
    np.testing.assert_allclose(np.diff(marginal), np.diff(expected), rtol=1e-8)

    mode, covariance = density.laplace()
    np.testing.assert_allclose(mode[:3], best, rtol=1e-9)
    np.testing.assert_allclose(covariance[:3, :3], scale * 57 / 60, rtol=1e-6)
    np.testing.assert_allclose(covariance[3, 3], 1 / 120, rtol=1e-6)


@pytest.mark.slow
def test_two_outputs_have_their_own_noise() -> None:
    arm = PlanarArm(equilibrium=(0.3, 0.4))
    random = np.random.default_rng(0)
    W = np.asarray(jax.vmap(arm.regressor)(*random.normal(size=(3, 400, 2))))
    theta = random.uniform(1, 2, 11)
    y = W @ theta + random.normal(size=(400, 2)) * [0.1, 3.0]
    density = linear_density(arm.names, arm.units, whiten(W, y))
    assert density.names[-2:] == ("log_noise_1", "log_noise_2")
    at = jnp.append(jnp.asarray(theta), jnp.log(jnp.array([0.1, 3.0])))
    np.testing.assert_allclose(value(density, at), norm.logpdf(y, W @ theta, [0.1, 3.0]).sum())
    mode, covariance = density.laplace()
    np.testing.assert_allclose(jnp.exp(mode[-2:]), [0.1, 3.0], rtol=0.15)
    assert (np.abs(mode[:11] - theta) < 5 * np.sqrt(np.diag(covariance)[:11])).all()
    np.testing.assert_allclose(gradient(density, mode) * np.sqrt(np.diag(covariance)), 0, atol=1e-6)


@pytest.mark.slow
def test_heavy_tails_shrug_off_outliers() -> None:
    W, y = record(200)
    y[::20] += 30.0
    rows = whiten(W, y, valid=np.arange(200) != 7)
    density = linear_density(NAMES, UNITS, rows, heavy_tails=True)
    at = np.r_[THETA, -1.0]
    kept = np.arange(200) != 7
    expected = student.logpdf(y - W @ THETA, 4, scale=np.exp(-1.0))[kept].sum()
    np.testing.assert_allclose(value(density, at), expected)
    mode, covariance = density.laplace()
    z = (np.asarray(mode[:3]) - THETA) / np.sqrt(np.diag(covariance)[:3])
    assert np.abs(z).max() < 4
    gaussian = linear_density(NAMES, UNITS, rows).laplace()[0]
    assert abs(gaussian[2] - 20) > 3 * abs(mode[2] - 20)
    found = minimize(
        lambda x: -float(value(density, x)), np.asarray(mode), method="Nelder-Mead", options={"xatol": 1e-7}
    )
    np.testing.assert_allclose(mode, found.x, rtol=1e-4)


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


def test_trials_together_are_one_record() -> None:
    W, y = record(90)
    parts = [whiten(W[k : k + 30], y[k : k + 30]) for k in (0, 30, 60)]
    at = jnp.asarray([*THETA, -1.0])
    whole = linear_density(NAMES, UNITS, whiten(W, y))
    np.testing.assert_allclose(value(linear_density(NAMES, UNITS, joined(parts)), at), value(whole, at))


@pytest.mark.slow
def test_many_windows_are_windows_one_by_one() -> None:
    W, y = record(300)
    W[100:160, 2] = 0
    r = signals.autocovariance(LOW_PASS, 80)
    valid = np.ones(300, bool)
    valid[250:255] = False
    starts = np.arange(0, 250, 50)
    cuts = [slice(start, start + 50) for start in starts]
    parts = [whiten(W[cut], y[cut], r, valid[cut]) for cut in cuts]
    densities, reasons = window_densities(NAMES, UNITS, parts)
    assert [bool(why) for why in reasons] == [False, False, True, False, False]
    assert "stiffness has no effect" in reasons[2]
    at = jnp.asarray([*THETA, -1.0])
    modes, covariances = eqx.filter_jit(eqx.filter_vmap(lambda density: density.laplace()))(densities)
    heavy, _ = window_densities(NAMES, UNITS, parts, heavy_tails=5.0)

    @eqx.filter_jit
    def values(of: Any) -> Any:
        return eqx.filter_vmap(lambda density: density(at))(of)

    each, each_heavy = values(densities), values(heavy)

    for k, rows in enumerate(part for part, why in zip(parts, reasons, strict=True) if not why):
        alone = linear_density(NAMES, UNITS, rows)
        np.testing.assert_allclose(each[k], value(alone, at), rtol=1e-9)
        np.testing.assert_allclose(modes[k], alone.laplace()[0], rtol=1e-6)
        np.testing.assert_allclose(covariances[k], alone.laplace()[1], rtol=1e-5, atol=1e-12)
        np.testing.assert_allclose(
            each_heavy[k], value(linear_density(NAMES, UNITS, rows, heavy_tails=5.0), at), rtol=1e-9
        )


@pytest.mark.slow
def test_stiffness_density_is_flat_in_the_stiffness() -> None:
    displacement, velocity, torque = pulses()
    density = arm_density()
    theta = jnp.asarray([2.3, 1.1, 1.0, 1.3, 5.3, 2.6, 3.1, -2.2])
    D, K = np.asarray(theta[:4]).reshape(2, 2), np.array([[5.3, 0], [2.6, 3.1]])
    residual = torque - velocity @ D.T - displacement @ (K @ K.T)
    likelihood = norm.logpdf(residual, 0, np.exp(-2.2)).sum()
    _, volume = np.linalg.slogdet(jacobian(density, theta))
    np.testing.assert_allclose(value(density, theta), likelihood + volume)
    assert value(density, theta.at[4].set(-5.3)) == value(density, theta.at[6].set(0.0)) == -jnp.inf
    assert np.isfinite(gradient(density, theta.at[6].set(-1.0))).all()
    damping, stiffness = stiffness_matrices(density.elements(theta[None]))
    np.testing.assert_allclose([damping[0], stiffness[0]], [D, K @ K.T])

    fit = fit_triangles(residual_triangle(displacement, velocity, torque)[None], 300)
    mode, covariance = density.laplace()
    np.testing.assert_allclose(elements(density, mode)[:7], fit.theta, rtol=0.01)
    np.testing.assert_allclose(gradient(density, mode) * np.sqrt(np.diag(covariance)), 0, atol=1e-6)


def test_a_mode_is_found_where_the_data_ask_for_an_indefinite_stiffness() -> None:
    random = np.random.default_rng(1)
    displacement, velocity, _ = pulses()
    torque = velocity @ DAMPING.T + displacement @ np.diag([20.0, -1.0]) + random.normal(size=(300, 2))
    density = stiffness_density(residual_triangle(displacement, velocity, torque), 300)
    mode, covariance = density.laplace()
    assert np.isfinite(covariance).all()
    assert mode[6] > 0
    np.testing.assert_allclose(gradient(density, mode) * np.sqrt(np.diag(covariance)), 0, atol=1e-6)


@pytest.mark.slow
def test_adjusted_curvature_is_the_covariance_of_trials() -> None:
    random = np.random.default_rng(0)
    displacement, velocity, _ = (x.reshape(12, 25, 2) for x in pulses())
    error = np.repeat(random.normal(size=(12, 1, 2)), 25, axis=1)  # the same within a trial
    displacement = displacement + 0.05
    torque = velocity @ DAMPING.T + displacement @ STIFF.T + error
    triangles = residual_triangle(displacement, velocity, torque)
    fit = fit_triangles(triangles, 25)
    plain = stiffness_density(merge_triangles(triangles), 300)
    density = adjusted(plain, fit.covariance)
    mode, _ = plain.laplace()
    x = elements(plain, mode)
    H = np.asarray(curvature(density, density.likelihood.mode))
    np.testing.assert_allclose(np.linalg.inv(H)[:7, :7], fit.covariance, rtol=1e-6, atol=1e-9)
    ratio = np.diag(np.linalg.inv(H)) / np.diag(np.linalg.inv(curvature(plain, x)))
    assert ratio[4] > 4  # standard errors of independent residuals are less than half of what they are
    np.testing.assert_allclose(ratio[7], 1, rtol=0.05)
    assert value(density, mode.at[4].set(-1.0)) == -jnp.inf
    with pytest.raises(ValueError, match="fewer than 5"):
        adjusted(plain, fit_triangles(triangles[:4], 25).covariance)


def test_an_estimate_is_students_t_with_a_definite_stiffness() -> None:
    random = np.random.default_rng(0)
    theta = np.r_[DAMPING.ravel(), STIFF[[0, 0, 1], [0, 1, 1]]]
    A = random.normal(size=(7, 7))
    covariance = A @ A.T
    density = estimate_density(STIFFNESS, ("",) * 7, theta, covariance, 9.0)
    assert density.names == (*STIFFNESS[:4], "l11", "l21", "l22")
    at = jnp.asarray([2, 1, 1, 1, 5.0, 2.5, 3.0])
    _, volume = np.linalg.slogdet(jacobian(density, at))
    expected = multivariate_t.logpdf(np.asarray(elements(density, at)), theta, covariance, 9)
    np.testing.assert_allclose(value(density, at), expected + volume)
    assert value(density, at.at[6].set(-3.0)) == -jnp.inf
    plain = estimate_density(NAMES, UNITS, THETA, np.diag([1e-6, 1e-4, 1e-2]), 9.0)
    np.testing.assert_allclose(
        plain(THETA * 1.01), multivariate_t.logpdf(THETA * 1.01, THETA, np.diag([1e-6, 1e-4, 1e-2]), 9)
    )
    with pytest.raises(ValueError, match="standard errors must be known"):
        estimate_density(NAMES, UNITS, THETA, np.full((3, 3), np.nan), 9.0)


# Priors


def test_priors_are_those_of_scipy() -> None:
    A = np.array([[4.0, 1.0], [1.0, 9.0]])
    prior = make_prior(
        ("a", "b", "c", "d", "e"),
        {"a": Normal(1.0, 2.0), "d": LogNormal(3.0, 1.5)},
        [MultivariateNormal(("e", "b"), np.array([1.0, 2.0]), A)],
    )
    x = np.array([0.5, 1.5, 100.0, 2.0, -1.0])
    expected = norm.logpdf(0.5, 1, 2) + lognorm.logpdf(2.0, np.log(1.5), scale=3.0)
    np.testing.assert_allclose(prior.log_density(x), expected + multivariate_normal.logpdf([-1, 1.5], [1, 2], A))
    assert prior.log_density(jnp.asarray(x).at[3].set(-2.0)) == -jnp.inf
    assert np.isfinite(jax.grad(prior.log_density)(jnp.asarray(x).at[3].set(-2.0))).all()
    draws = prior.draws(4000, np.random.default_rng(0))
    assert np.isnan(draws[:, 2]).all()
    assert (draws[:, 3] > 0).all()
    np.testing.assert_allclose(np.median(draws[:, 3]), 3.0, rtol=0.05)
    np.testing.assert_allclose(np.cov(draws[:, [4, 1]].T), A, rtol=0.15, atol=0.5)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"stifness": Normal(1, 1)}, "did you mean 'stiffness'"),
        ({"stiffness": Normal(1, 0)}, "sd must be above zero"),
        ({"stiffness": LogNormal(-1, 2)}, "median must be above zero"),
        ({"stiffness": LogNormal(1, 1)}, "factor above one"),
        ({"log_noise": LogNormal(1, 2)}, "give it a normal prior"),
    ],
)
def test_impossible_priors_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_prior((*NAMES, "log_noise"), given)


def test_impossible_blocks_are_refused() -> None:
    block = MultivariateNormal(("inertia", "damping"), np.zeros(2), np.eye(2))
    with pytest.raises(ValueError, match="two priors"):
        make_prior(NAMES, {"inertia": Normal(0, 1)}, [block])
    for covariance in (-np.eye(2), np.array([[1.0, 0.9], [0.0, 1.0]]), np.ones((2, 2))):
        with pytest.raises(ValueError, match="positive definite"):
            make_prior(NAMES, blocks=[MultivariateNormal(block.names, np.zeros(2), covariance)])
    with pytest.raises(ValueError, match="was there an estimate"):
        make_prior(NAMES, blocks=[MultivariateNormal(block.names, np.zeros(2), np.full((2, 2), np.nan))])
    W, y = record()
    with pytest.raises(ValueError, match="make it for inertia"):
        linear_density(NAMES, UNITS, whiten(W, y), make_prior(NAMES))


def test_a_robot_that_is_known_is_a_prior_of_its_parameters() -> None:
    """The posterior of both recordings one after the other is that of both together, if the noise is known."""
    random = np.random.default_rng(0)
    alone, robot = random.normal(size=(200, 2)), np.array([1.0, 2.0])
    y_alone = alone @ robot + 0.1 * random.normal(size=200)
    both = np.concatenate([random.normal(size=(80, 2)), random.normal(size=(80, 1))], axis=1)
    y_both = both @ np.r_[robot, 5.0] + 0.1 * random.normal(size=80)
    known = Normal(np.log(0.1), 1e-6)
    before = linear_density(("robot.a", "robot.b"), ("", ""), whiten(alone, y_alone))
    estimate = np.linalg.lstsq(alone, y_alone)[0], 0.01 * np.linalg.inv(alone.T @ alone)
    np.testing.assert_allclose(before.laplace()[0][:2], estimate[0], rtol=1e-8)
    names = ("robot.a", "robot.b", "human.k", "log_noise")
    prior = make_prior(names, {"log_noise": known}, [MultivariateNormal(names[:2], *estimate)])
    mode, covariance = linear_density(names[:3], ("",) * 3, whiten(both, y_both), prior).laplace()
    W = np.concatenate([np.c_[alone, np.zeros(200)], both])
    np.testing.assert_allclose(mode[:3], np.linalg.lstsq(W, np.r_[y_alone, y_both])[0], rtol=1e-6)
    np.testing.assert_allclose(covariance[:3, :3], 0.01 * np.linalg.inv(W.T @ W), rtol=1e-4, atol=1e-9)


def test_a_log_normal_prior_keeps_a_parameter_positive() -> None:
    W, y = record()
    prior = make_prior((*NAMES, "log_noise"), {"stiffness": LogNormal(5.0, 2.0)})
    density = linear_density(NAMES, UNITS, whiten(W, -y), prior)
    assert value(density, jnp.asarray([0.1, 1.0, -1.0, 0.0])) == -jnp.inf
    mode, covariance = density.laplace()
    assert mode[2] > 0
    assert np.isfinite(covariance).all()
    np.testing.assert_allclose(gradient(density, mode) * np.sqrt(np.diag(covariance)), 0, atol=1e-6)
    assert float(arm_density(stiffness_11=Normal(10.0, 0.1)).laplace()[0][4] ** 2) < 20


def test_prior_predictive_compares_sizes_and_names_what_is_flat() -> None:
    W, y = record(1000)
    names = (*NAMES, "log_noise")
    sure = prior_predictive(make_prior(names, {"stiffness": Normal(20.0, 0.01)}), W, y)
    np.testing.assert_allclose(sure.ratio[1], np.linalg.norm(W[:, 2] * 20) / np.linalg.norm(y), rtol=1e-3)
    assert sure.flat == ("inertia", "damping", "log_noise")
    wild = prior_predictive(make_prior(names, {"stiffness": Normal(0.0, 1e5)}), W, y)
    assert wild.ratio[0] > 50
    nothing = prior_predictive(make_prior(names), W, y)
    assert np.isnan(nothing.ratio).all()
    assert nothing.flat == names


# What cannot be known


def test_flat_directions_are_named() -> None:
    W, y = record()
    W[:, 0] = -40 * W[:, 2]
    with pytest.raises(ValueError, match="inertia and stiffness cannot be told apart"):
        linear_density(NAMES, UNITS, whiten(W, y))
    known = make_prior((*NAMES, "log_noise"), {"inertia": Normal(0.1, 0.01)})
    assert np.isfinite(linear_density(NAMES, UNITS, whiten(W, y), known).laplace()[1]).all()
    with pytest.raises(ValueError, match="damping has no effect"):
        linear_density(NAMES, UNITS, whiten(record()[0] * [1, 0, 1], y))
    displacement, velocity, torque = pulses()
    displacement[:, 1] = velocity[:, 1] = 0
    with pytest.raises(ValueError, match="stiffness_22 has no effect"):
        stiffness_density(residual_triangle(displacement, velocity, torque), 300)


def test_too_few_rows_and_no_noise_are_refused() -> None:
    W, y = record()
    with pytest.raises(ValueError, match="3 independent rows cannot determine 3 parameters"):
        linear_density(NAMES, UNITS, whiten(W[:3], y[:3]))
    with pytest.raises(ValueError, match="to the last digit"):
        linear_density(NAMES, UNITS, whiten(W, W @ THETA))
    with pytest.raises(ValueError, match="not finite"):
        whiten(np.where(W > 10, np.nan, W), np.append(y[:-1], np.nan))
    with pytest.raises(ValueError, match="no rows to join"):
        joined([])
    with pytest.raises(ValueError, match=r"filter\.mode = 'once'"):
        Noise(np.array([0.5, 1.0]))


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


# Noise in the regressor


def test_correction_removes_the_attenuation() -> None:
    random = np.random.default_rng(1)
    n, sigma, records = 400, np.array([0.0, 0.2, 0.03]), 200
    W, _ = record(n)
    plain, fixed, claimed = [], [], []
    for _ in range(records):
        noisy, y = W + sigma * random.normal(size=W.shape), W @ THETA + 0.3 * random.normal(size=n)
        rows = whiten(noisy, y)
        plain.append(optimum(rows))
        density = linear_density(NAMES, UNITS, rows, column_noise=sigma)
        mode, covariance = density.laplace()
        fixed.append(mode)
        claimed.append(np.sqrt(np.diag(covariance)))
    plain_bias, fixed_bias = np.mean(plain, axis=0) - THETA, np.mean(fixed, axis=0)[:3] - THETA
    spread = np.std(fixed, axis=0)
    error = spread[:3] / np.sqrt(records)
    assert (np.abs(plain_bias[1:]) > 10 * error[1:]).all()
    assert (np.abs(fixed_bias) < 4 * error + 0.1 * np.abs(plain_bias)).all()
    np.testing.assert_allclose(np.mean(claimed, axis=0)[:3], spread[:3], rtol=0.15)
    noise = np.sqrt(0.3**2 + (sigma**2 * THETA**2).sum())
    np.testing.assert_allclose(np.exp(np.mean(fixed, axis=0)[3]), noise, rtol=0.05)
    # the bias that is predicted from one record
    in_units = attenuation(rows, sigma) * np.std(plain, axis=0)
    np.testing.assert_allclose(in_units[1:], plain_bias[1:], rtol=0.3)


def test_small_noise_in_the_regressor_is_left_alone_and_large_noise_refused() -> None:
    W, y = record()
    rows = whiten(W, y)
    at = jnp.asarray([*THETA, -1.0])
    assert linear_density(NAMES, UNITS, rows, column_noise=np.full(3, 1e-6))(at) == linear_density(NAMES, UNITS, rows)(
        at
    )
    with pytest.raises(ValueError, match="as large as the motion"):
        linear_density(NAMES, UNITS, rows, column_noise=np.full(3, 30.0))
    with pytest.raises(ValueError, match="column_noise has the shape"):
        attenuation(rows, np.ones(2))
    given = triangles(rows, np.array([0.0, 0.2, 0.03]))
    assert np.abs(given - rows.triangles()).max() > 1e-3
    np.testing.assert_array_equal(given, np.triu(given))
    difference = np.random.default_rng(0).normal(size=(5000, 3)) @ np.diag([1.0, 2.0, 3.0])
    np.testing.assert_allclose(whitened_covariance(difference)[0], np.diag([1, 4, 9]), atol=0.5)


def test_an_output_of_which_no_row_counts_says_nothing() -> None:
    W, y = record(400)
    sigma, valid = np.array([0.0, 0.2, 0.03]), np.tile([True, False], (400, 1))
    rows = whiten(np.stack([W, W], axis=1), np.stack([y, y], axis=1), valid=valid)
    given = corrected(rows, sigma)
    np.testing.assert_array_equal(given[0], corrected(whiten(W, y), sigma)[0])
    assert not given[1].any()
    with pytest.raises(ValueError, match="independent rows cannot determine 3 parameters and the noise"):
        linear_density(NAMES, UNITS, rows, column_noise=sigma)


# Predictions


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


# Calibration


def test_posteriors_hold_the_truth_and_the_textbooks_do_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "experiments")
    experiment = importlib.import_module("calibration")
    monkeypatch.setattr(experiment, "RECORDS", 400)
    random = np.random.default_rng(11)
    ways = {"rig": experiment.rig(True, 40, random), "arm": experiment.arm(random)}
    for name, found in ways.items():
        for parameter, cell in found["whitened"].items():
            for level in (0.5, 0.8, 0.95):
                allowed = 3.5 * np.sqrt(level * (1 - level) / 400)
                assert abs(cell[f"{level:.0%}"] - level) < allowed, (name, parameter, level)
            assert cell["p of even ranks"] > 1e-4
    for cell in ways["rig"]["textbook"].values():
        assert cell["95%"] < 0.9
        assert cell["p of even ranks"] < 1e-4


@pytest.mark.slow
def test_samplers_rank_the_truth_where_the_exact_posterior_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ranks among draws scatter about the exact probabilities as those of independent draws would."""
    monkeypatch.syspath_prepend(ROOT / "experiments")
    experiment = importlib.import_module("calibration")
    random, truth = np.random.default_rng(3), np.array([0.1, 1.5, 20.0, 0.0, np.log(0.3)])
    W = random.normal(size=(16, 24, 4)) * [10, 1, 0.1, 1]
    y = W @ truth[:4] + 0.3 * random.normal(size=(16, 24))
    triangles = [np.linalg.qr(np.column_stack(rows), mode="r") for rows in zip(W, y, strict=True)]
    below = np.stack([experiment.exact(R, 24.0, truth) for R in triangles])
    drawn = experiment.sampled([experiment.rig_density(R, 24.0) for R in triangles], truth, random)

    def scatter(u: Numbers) -> float:
        return float(np.mean((u - below) ** 2 / (below * (1 - below) / experiment.DRAWS + experiment.DRAWS**-2.0)))

    for way, (u, refused) in drawn.items():
        assert refused == 0, way
        assert 0.6 < scatter(u) < 1.5, way
    # as if every row were two that are independent
    assert scatter(np.stack([experiment.exact(np.sqrt(2) * R, 48.0, truth) for R in triangles])) > 1.5
