"""One window against numpy, statsmodels and explicit formulas; intervals against the noise they speak of."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import toeplitz
from scipy.stats import t as student

from factories.regressions import THETA, regression
from jaximp.least_squares.window import (
    DENSE_ROWS,
    WindowFit,
    confidence_interval,
    least_squares,
    variance_accounted_for,
)

Numbers = NDArray[np.float64]

fit_of: Callable[..., WindowFit] = jax.jit(least_squares)


def all_fields(fit: WindowFit) -> dict[str, Numbers]:
    return {name: np.asarray(getattr(fit, name)) for name in (field.name for field in fields(WindowFit))}


def assert_same(fit: WindowFit, other: WindowFit, rtol: float = 1e-9) -> None:
    for name, value in all_fields(fit).items():
        reference = all_fields(other)[name]
        np.testing.assert_allclose(value, reference, rtol, 1e-11 * np.abs(reference).max(), err_msg=name)


def assert_nan(fit: WindowFit) -> None:
    for name, value in all_fields(fit).items():
        if name != "samples":
            assert np.isnan(value).all(), name


@pytest.mark.parametrize(("n", "p"), [(5, 4), (60, 1), (700, 4)], ids=str)
def test_everything_against_numpy(n: int, p: int) -> None:
    W, y = regression(n, p)
    fit = fit_of(W, y)
    theta, rss, _, singular = np.linalg.lstsq(W, y)
    np.testing.assert_allclose(fit.theta, theta, rtol=1e-10)
    np.testing.assert_allclose(fit.cond, singular[0] / singular[-1], rtol=1e-10)
    np.testing.assert_allclose(fit.sigma_min, np.linalg.svd(W, compute_uv=False)[-1], rtol=1e-10)
    covariance = np.linalg.inv(W.T @ W) * rss[0] / (n - p)
    np.testing.assert_allclose(fit.covariance, covariance, rtol=1e-8, atol=1e-12 * np.abs(covariance).max())
    np.testing.assert_allclose(fit.stderr, np.sqrt(np.diag(covariance)), rtol=1e-8)
    np.testing.assert_allclose(fit.residual_rms, np.sqrt(rss[0] / n), rtol=1e-8)
    np.testing.assert_allclose(fit.vaf, 1 - np.var(y - W @ theta) / np.var(y), rtol=1e-9)
    assert (float(fit.dof), int(fit.samples)) == (n - p, n)
    for column in range(p):
        others = np.delete(W, column, axis=1)
        imitation = others @ np.linalg.lstsq(others, W[:, column])[0] if p > 1 else 0.0
        assert float(fit.excitation[column]) == pytest.approx(np.linalg.norm(W[:, column] - imitation), rel=1e-9)


def test_parameters_and_standard_errors_are_those_of_statsmodels() -> None:
    api = pytest.importorskip("statsmodels.api")
    W, y = regression(200, 4)
    ols, fit = api.OLS(y, W).fit(), fit_of(W, y)
    np.testing.assert_allclose(fit.theta, ols.params, rtol=1e-10)
    np.testing.assert_allclose(fit.stderr, ols.bse, rtol=1e-10)
    low, high = confidence_interval(fit.theta, fit.stderr, fit.dof)
    np.testing.assert_allclose(np.stack([low, high], axis=1), ols.conf_int(), rtol=1e-9)


@pytest.mark.parametrize("condition", [1e4, 1e8, 1e11])
def test_the_condition_number_enters_once(condition: float) -> None:
    random = np.random.default_rng(0)
    U = np.linalg.qr(random.normal(size=(100, 3)))[0]
    V = np.linalg.qr(random.normal(size=(3, 3)))[0]
    W = U * np.array([1.0, 1.0, 1 / condition]) @ V
    fit = fit_of(W, W @ THETA[:3])
    assert float(fit.cond) == pytest.approx(condition, rel=1e-4)
    np.testing.assert_allclose(fit.theta, THETA[:3], atol=1e-14 * condition * np.abs(THETA).max())


@pytest.mark.parametrize("hidden", [0.0, np.nan, np.inf, 1e300], ids=["zero", "NaN", "infinite", "huge"])
@pytest.mark.parametrize("noise", [None, "known"], ids=["white", "coloured"])
def test_a_mask_deletes_rows_whatever_they_hold(hidden: float, noise: str | None) -> None:
    W, y = regression(80, 4)
    valid = np.random.default_rng(1).random(80) < 0.7
    covariance = toeplitz(0.8 ** np.arange(80))
    known = (None, None) if noise is None else (covariance, covariance[np.ix_(valid, valid)])
    broken_W, broken_y = np.where(valid[:, None], W, hidden), np.where(valid, y, hidden)
    assert_same(fit_of(broken_W, broken_y, valid, known[0]), fit_of(W[valid], y[valid], noise=known[1]))


def test_a_mask_hides_nan_without_jit_too() -> None:
    W, y = regression(80, 4)
    valid = np.random.default_rng(1).random(80) < 0.7
    broken_W, broken_y = np.where(valid[:, None], W, np.nan), np.where(valid, y, np.nan)
    assert_same(least_squares(jnp.asarray(broken_W), jnp.asarray(broken_y), valid), fit_of(W[valid], y[valid]))


@pytest.mark.parametrize("masked", [False, True], ids=["all samples", "masked"])
def test_several_outputs_are_stacked_rows(masked: bool) -> None:
    W, y = regression(50, 4, (3,))
    valid = np.random.default_rng(1).random((50, 3)) < (0.6 if masked else 2)
    assert_same_but_vaf(fit_of(W, y, valid), fit_of(W[valid], y[valid]))
    vaf = fit_of(W, y, valid).vaf
    residual = y - W @ np.asarray(fit_of(W, y, valid).theta)
    scatter = [
        sum(((x[valid[:, k], k] - x[valid[:, k], k].mean()) ** 2).sum() for k in range(3)) for x in (residual, y)
    ]
    assert float(vaf) == pytest.approx(1 - scatter[0] / scatter[1], rel=1e-12)


def assert_same_but_vaf(fit: WindowFit, other: WindowFit) -> None:
    """The mean torque is taken output by output, the rest knows no outputs."""
    for name, value in all_fields(fit).items():
        if name != "vaf":
            reference = all_fields(other)[name]
            np.testing.assert_allclose(value, reference, 1e-9, 1e-12 * np.abs(reference).max(), err_msg=name)


def deficient(kind: str) -> tuple[Numbers, Numbers, NDArray[np.bool_]]:
    W, y = regression(60, 4)
    valid = np.ones(60, bool)
    match kind:
        case "equal columns":
            W[:, 2] = W[:, 0]
        case "a multiple":
            W[:, 2] = -1e-7 / 3 * W[:, 1]
        case "a sum":
            W[:, 3] = W[:, 0] + 0.1 * W[:, 1] - 7 * W[:, 2]
        case "a zero column":
            W[:, 1] = 0
        case "the first column zero":
            W[:, 0] = 0
        case "all zero":
            W[:] = 0
        case "constant motion":
            W[:] = W[0]
        case "masked to equal columns":
            valid[30:] = False
            W[:30, 2] = W[:30, 0]
        case "fewer samples than parameters":
            valid[3:] = False
        case "no sample":
            valid[:] = False
    return W, y, valid


@pytest.mark.parametrize(
    "kind",
    [
        "equal columns",
        "a multiple",
        "a sum",
        "a zero column",
        "the first column zero",
        "all zero",
        "constant motion",
        "masked to equal columns",
        "fewer samples than parameters",
        "no sample",
    ],
)
@pytest.mark.parametrize("noise", [None, 0.9 ** np.arange(20)], ids=["white", "coloured"])
def test_without_a_unique_solution_everything_is_nan(kind: str, noise: Numbers | None) -> None:
    W, y, valid = deficient(kind)
    fit = fit_of(W, y, valid, noise)
    assert_nan(fit)
    assert int(fit.samples) == valid.sum()


def test_fewer_rows_than_parameters_is_nan_not_an_error() -> None:
    W, y = regression(3, 4)
    assert_nan(fit_of(W, y))


@pytest.mark.parametrize("noise", [None, np.array([1.0, 0.4])], ids=["white", "coloured"])
def test_as_many_samples_as_parameters_leave_no_degrees_of_freedom(noise: Numbers | None) -> None:
    W, y = regression(4, 4)
    fit = fit_of(W, y, noise=noise)
    np.testing.assert_allclose(fit.theta, np.linalg.solve(W, y), rtol=1e-9)
    assert np.isnan(fit.stderr).all()
    assert float(fit.dof) == 0


@pytest.mark.parametrize("masked", [False, True], ids=["all samples", "masked"])
def test_white_noise_is_the_textbook_result(masked: bool) -> None:
    W, y = regression(90, 4)
    valid = np.random.default_rng(2).random(90) < (0.5 if masked else 2)
    textbook = fit_of(W, y, valid)
    assert_same(fit_of(W, y, valid, np.array([1.0])), textbook)
    assert_same(fit_of(W, y, valid, np.array([17.0])), textbook)
    assert_same(fit_of(W, y, valid, 3.0 * np.eye(90)), textbook)


@pytest.mark.parametrize("n", [120, DENSE_ROWS + 1])
@pytest.mark.parametrize("masked", [False, True], ids=["all samples", "masked"])
@pytest.mark.parametrize("outputs", [(), (2,)], ids=["one output", "two outputs"])
def test_coloured_noise_is_the_explicit_formula(n: int, masked: bool, outputs: tuple[int, ...]) -> None:
    W, y = regression(n, 4, outputs)
    valid = np.random.default_rng(2).random(y.shape) < (0.7 if masked else 2)
    lags = np.convolve(np.ones(15), np.ones(15))[14:] * np.cos(0.1 * np.arange(15))
    covariance = toeplitz(np.r_[lags, np.zeros(n - 15)])

    # Outputs have independent noise: the covariance of all rows is the Kronecker product with the identity.
    rows = np.kron(covariance, np.eye(*outputs * 2 if outputs else (1,)))[np.ix_(valid.ravel(), valid.ravel())]
    kept, torque = W[valid], y[valid]
    A = np.linalg.pinv(kept)
    M = np.eye(len(kept)) - kept @ A
    G = M @ rows @ M
    residual = torque - kept @ (A @ torque)
    expected = residual @ residual / np.trace(G) * A @ rows @ A.T
    dof = np.trace(G) ** 2 / np.trace(G @ G)

    for given_as in (lags, covariance):
        fit = fit_of(W, y, valid, given_as)
        np.testing.assert_allclose(fit.theta, A @ torque, rtol=1e-9)
        np.testing.assert_allclose(fit.covariance, expected, rtol=1e-8, atol=1e-11 * np.abs(expected).max())
        assert float(fit.dof) == pytest.approx(dof, rel=1e-9)


@pytest.mark.slow
def test_noise_may_reach_further_than_the_window() -> None:
    """In a process of its own: XLA's simplifier aborted here."""
    program = """
import jax
import numpy as np
from scipy.linalg import toeplitz
jax.config.update("jax_enable_x64", True)
from jaximp.least_squares.window import least_squares
for n, more in ((100, 0), (100, 500), (700, 0), (700, 500)):
    W = np.random.default_rng(0).normal(size=(n, 2))
    y, lags = W.sum(axis=1) + np.random.default_rng(1).normal(size=n), 0.99 ** np.arange(n + more)
    by_lag, by_matrix = (jax.jit(least_squares)(W, y, noise=noise) for noise in (lags, toeplitz(lags[:n])))
    np.testing.assert_allclose(by_lag.stderr, by_matrix.stderr, rtol=1e-8)
    np.testing.assert_allclose(by_lag.dof, by_matrix.dof, rtol=1e-8)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[:500]


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """White noise through a known moving average; the textbook interval does not see that neighbours are alike."""
    n, taps, seeds = 200, np.hanning(17)[1:-1], 400
    t = np.arange(n) / 100
    W = np.stack([np.sin(2 * np.pi * 1.1 * t), np.cos(2 * np.pi * 2.3 * t + 0.4), t, np.ones(n)], axis=1)
    white = np.random.default_rng(5).normal(size=(seeds, n + len(taps) - 1))
    noise = np.stack([np.convolve(row, taps, "valid") for row in white])
    lags = np.correlate(taps, taps, "full")[len(taps) - 1 :]

    one_in_twenty = 3.5 * np.sqrt(0.95 * 0.05 / seeds)
    coverage = {}
    for name, known in (("coloured", jnp.asarray(lags)), ("textbook", None)):
        fit = jax.jit(jax.vmap(lambda y, known=known: least_squares(jnp.asarray(W), y, noise=known)))(W @ THETA + noise)
        low, high = confidence_interval(fit.theta, fit.stderr, fit.dof)
        coverage[name] = ((low <= THETA) & (high >= THETA)).mean(axis=0)
        if known is not None:
            np.testing.assert_allclose(fit.stderr.mean(axis=0) / fit.theta.std(axis=0), 1.0, atol=0.15)
    assert (np.abs(coverage["coloured"] - 0.95) < one_in_twenty).all(), coverage
    assert (coverage["textbook"] < 0.8).all(), coverage


@pytest.mark.parametrize("level", [0.5, 0.95, 0.999])
def test_confidence_interval_is_students(level: float) -> None:
    theta, stderr, dof = np.array([[1.0, -2.0], [3.0, np.nan]]), np.array([[0.1, 2.0], [0.3, np.nan]]), [5.0, 1e6]
    low, high = confidence_interval(theta, stderr, np.array(dof), level)
    for m in range(2):
        for k in range(2):
            expected = student.interval(level, dof[m], theta[m, k], stderr[m, k])
            np.testing.assert_allclose((low[m, k], high[m, k]), expected, rtol=1e-9)
    assert np.isnan(low[1, 1])
    assert np.isnan(confidence_interval(theta[0], stderr[0], np.array(np.nan), level)[0]).all()


def test_confidence_interval_of_a_fit_is_that_of_its_numbers() -> None:
    fit = least_squares(*regression(60, 4))
    for level in (0.5, 0.95):
        expected = confidence_interval(fit.theta, fit.stderr, fit.dof, level)
        np.testing.assert_array_equal(confidence_interval(fit, level), expected)
    np.testing.assert_array_equal(confidence_interval(fit), expected)
    np.testing.assert_array_equal(confidence_interval(fit, level=0.95), expected)
    with pytest.raises(ValueError, match="the level is 95: it must be a probability"):
        confidence_interval(fit, 95)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(powers=st.lists(st.integers(-9, 9), min_size=4, max_size=4), torque=st.integers(-9, 9), seed=st.integers(0, 99))
def test_units_do_not_matter(powers: list[int], torque: int, seed: int) -> None:
    """Columns in other units scale the parameters inversely, torque in other units scales them too."""
    W, y = regression(60, 4, seed=seed)
    scale, unit = 10.0 ** np.array(powers), 10.0**torque
    plain, scaled = fit_of(W, y), fit_of(W * scale, y * unit)
    np.testing.assert_allclose(scaled.theta * scale, plain.theta * unit, rtol=1e-9)
    np.testing.assert_allclose(scaled.stderr * scale, plain.stderr * unit, rtol=1e-9)
    np.testing.assert_allclose(scaled.excitation / scale, plain.excitation, rtol=1e-9)
    np.testing.assert_allclose(scaled.residual_rms, plain.residual_rms * unit, rtol=1e-9)
    np.testing.assert_allclose(scaled.vaf, plain.vaf, rtol=1e-9)


def test_variance_accounted_for_earns_nothing_with_a_constant() -> None:
    y, weight = np.array([1.0, 2.0, 4.0, np.nan]), np.array([1.0, 1.0, 1.0, 0.0])
    assert float(variance_accounted_for(y, 0 * y, weight)) == 1
    assert float(variance_accounted_for(y, y - 5, weight)) == pytest.approx(0)
    assert float(variance_accounted_for(y, 2 * y, weight)) == pytest.approx(-3)


@pytest.mark.slow
@pytest.mark.compiles
def test_gradient_through_the_fit_is_finite_difference() -> None:
    W, y = regression(30, 4)
    direction, lags, step = np.random.default_rng(3).normal(size=W.shape), 0.5 ** np.arange(5.0), 1e-6

    @jax.jit
    def loss(amount: float) -> jax.Array:
        fit = least_squares(jnp.asarray(W + amount * direction), jnp.asarray(y), noise=jnp.asarray(lags))
        return (fit.theta**2).sum() + jnp.log(fit.stderr).sum() + jnp.log(fit.cond)

    difference = (float(loss(step)) - float(loss(-step))) / (2 * step)
    assert float(jax.grad(loss)(0.0)) == pytest.approx(difference, rel=1e-6)


@pytest.mark.parametrize("coloured", [False, True], ids=["white", "coloured"])
def test_weights_are_a_row_multiplied(coloured: bool) -> None:
    W, y = regression(40, 3)
    random = np.random.default_rng(2)
    weights = np.where(random.random(40) < 0.8, random.exponential(size=40), 0.0)
    root, kept = np.sqrt(weights), weights > 0
    covariance = toeplitz(0.6 ** np.arange(40))
    fit = least_squares(W, y, weights=weights, noise=covariance if coloured else None)
    rows, torque = W * root[:, None], y * root
    inverse = np.linalg.pinv(rows)
    residual = torque - rows @ inverse @ torque
    spread, dof = np.eye(40), kept.sum() - 3.0
    variance = residual @ residual / dof
    if coloured:
        spread = root[:, None] * covariance * root
        left = (np.eye(40) - rows @ inverse) @ spread
        variance, dof = residual @ residual / np.trace(left), np.trace(left) ** 2 / np.trace(left @ left)
    np.testing.assert_allclose(fit.theta, inverse @ torque, rtol=1e-9)
    np.testing.assert_allclose(fit.covariance, inverse @ spread @ inverse.T * variance, rtol=1e-8)
    assert float(fit.dof) == pytest.approx(dof)
    assert float(fit.residual_rms) == pytest.approx(np.sqrt(residual @ residual / weights.sum()))
    plain = y - W @ np.asarray(fit.theta)
    scatter = [(weights * (x - (weights @ x) / weights.sum()) ** 2).sum() for x in (plain, y)]
    assert float(fit.vaf) == pytest.approx(1 - scatter[0] / scatter[1])
    assert int(fit.samples) == kept.sum()
