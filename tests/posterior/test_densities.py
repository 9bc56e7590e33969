"""Log densities: against scipy's distributions, with their modes, and what no density can know."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.optimize import minimize
from scipy.stats import multivariate_normal, multivariate_t, norm
from scipy.stats import t as student

from factories.densities import (
    DAMPING,
    LOW_PASS,
    NAMES,
    STIFF,
    THETA,
    UNITS,
    Numbers,
    arm_density,
    gradient,
    pulses,
    record,
    value,
)
from jaximp import signals
from jaximp.least_squares.noise import (
    Noise,
    attenuation,
    corrected,
    joined,
    optimum,
    triangles,
    whiten,
    whitened_covariance,
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
from jaximp.posterior.priors import Normal, make_prior

# Compiled once for all densities that are made alike.


@eqx.filter_jit
def elements(density: Density, theta: Any) -> Any:
    return density.elements(theta)


@eqx.filter_jit
def jacobian(density: Density, theta: Any) -> Any:
    return jax.jacobian(density.elements)(theta)


@eqx.filter_jit
def curvature(density: Density, theta: Any) -> Any:
    return -jax.hessian(density.likelihood.log_likelihood)(theta)


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


# --- what cannot be known ---------------------------------------------------------------------------------------------


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


# --- noise in the regressor -------------------------------------------------------------------------------------------


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
