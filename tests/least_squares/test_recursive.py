"""Recursive least squares is weighted least squares of everything seen so far."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray

from factories.regressions import THETA, regression
from jaximp.least_squares.recursive import init, recursive_least_squares, step
from jaximp.least_squares.window import confidence_interval, least_squares

Numbers = NDArray[np.float64]


def weighted(W: Numbers, y: Numbers, forgetting: float) -> Numbers:
    root = np.sqrt(forgetting ** np.arange(len(y) - 1, -1, -1.0))
    return np.linalg.lstsq(W * root[:, None], y * root)[0]


@pytest.mark.parametrize("forgetting", [1.0, 0.999, 0.9, 0.5])
def test_is_weighted_least_squares_of_the_samples_so_far(forgetting: float) -> None:
    W, y = regression(120)
    theta = np.asarray(recursive_least_squares(W, y, forgetting).theta)
    assert theta.shape == (120, 3)
    for k in range(2, 120):
        np.testing.assert_allclose(theta[k], weighted(W[: k + 1], y[: k + 1], forgetting), rtol=1e-7)


@pytest.mark.parametrize("forgetting", [1.0, 0.9])
def test_streamed_steps_are_the_scan(forgetting: float) -> None:
    W, y = regression(40)
    whole = np.asarray(recursive_least_squares(W, y, forgetting).theta)
    state, streamed, take = init(3), [], jax.jit(step)
    for w, torque in zip(W, y, strict=True):
        state, theta = take(state, w, torque, forgetting)
        streamed.append(theta)
    np.testing.assert_allclose(np.stack(streamed), whole, rtol=1e-12)


def late(kind: str) -> tuple[Numbers, int]:
    """Regressors that do not determine all parameters before some sample."""
    W, _ = regression(120)
    match kind:
        case "three samples":
            return W, 2
        case "still at first":
            W[:50] = 0
            return W, 52
        case "one column silent at first":
            W[:50, 1] = 0
            return W, 50
        case "collinear at first":
            W[:50, 2] = W[:50] @ np.array([1.0, 0.3, 0.0])
            return W, 50
    W[:, 2] = 7 * W[:, 0]
    return W, len(W)


@pytest.mark.parametrize("forgetting", [1.0, 0.98])
@pytest.mark.parametrize(
    "kind",
    ["three samples", "still at first", "one column silent at first", "collinear at first", "collinear throughout"],
)
def test_nan_until_the_samples_determine_everything(kind: str, forgetting: float) -> None:
    W, first = late(kind)
    theta = np.asarray(recursive_least_squares(W, W @ THETA[:3], forgetting).theta)
    assert np.isnan(theta[:first]).all()
    np.testing.assert_allclose(theta[first:], np.broadcast_to(THETA[:3], (len(W) - first, 3)), rtol=1e-4)


@pytest.mark.parametrize("hidden", [0.0, 1e6, np.nan], ids=["zero", "huge", "NaN"])
@pytest.mark.parametrize("forgetting", [1.0, 0.95])
def test_a_masked_sample_changes_nothing(forgetting: float, hidden: float) -> None:
    W, y = regression(120)
    valid = np.random.default_rng(1).random(len(y)) < 0.7
    broken = np.where(valid[:, None], W, hidden), np.where(valid, y, hidden)
    theta = np.asarray(recursive_least_squares(*broken, forgetting, valid=valid).theta)
    kept = np.asarray(recursive_least_squares(W[valid], y[valid], forgetting).theta)
    np.testing.assert_allclose(theta[valid], kept, rtol=1e-12)
    for k in np.flatnonzero(~valid)[1:]:
        np.testing.assert_array_equal(theta[k], theta[k - 1])


def test_forgetting_follows_a_step_of_the_stiffness() -> None:
    W, _ = regression(600)
    truth = np.where(np.arange(600)[:, None] < 300, THETA[:3], THETA[:3] * np.array([1, 1, 2]))
    theta = np.asarray(recursive_least_squares(W, (W * truth).sum(axis=1), 0.95).theta)
    np.testing.assert_allclose(theta[299], truth[299], rtol=1e-6)
    np.testing.assert_allclose(theta[599], truth[599], rtol=1e-4)


@pytest.mark.slow
def test_vmap_is_a_loop_and_the_gradient_is_finite_difference() -> None:
    W, y = (np.stack(x) for x in zip(*(regression(30, seed=seed) for seed in range(3)), strict=True))
    batch = jax.vmap(lambda W, y: recursive_least_squares(W, y, 0.9).theta)(W, y)
    for k in range(3):
        np.testing.assert_allclose(batch[k], recursive_least_squares(W[k], y[k], 0.9).theta, rtol=1e-9)

    def last(forgetting: float) -> jax.Array:
        return recursive_least_squares(W[0], y[0], forgetting).theta[-1, 0]

    difference = (float(last(0.9 + 1e-6)) - float(last(0.9 - 1e-6))) / 2e-6
    assert float(jax.grad(last)(0.9)) == pytest.approx(difference, rel=1e-5)


@pytest.mark.parametrize("forgetting", [0.0, -0.5, 1.0001, float("nan")])
def test_a_forgetting_factor_outside_zero_to_one_is_refused(forgetting: float) -> None:
    with pytest.raises(ValueError, match=r"it must lie in \(0, 1\]"):
        recursive_least_squares(*regression(120), forgetting)


@pytest.mark.parametrize(
    ("rows", "torque"), [((10, 3), (9,)), ((10,), (10,)), ((10, 2, 3), (10, 2)), ((10, 3), (10, 1))], ids=str
)
def test_shapes_that_disagree_are_refused(rows: tuple[int, ...], torque: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"expected \(N, p\) and \(N,\)"):
        recursive_least_squares(np.ones(rows), np.ones(torque))


def test_a_mask_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="valid"):
        recursive_least_squares(*regression(120), valid=np.ones(7, bool))


def test_whole_numbers_are_taken() -> None:
    W = np.random.default_rng(0).integers(-9, 9, (30, 3))
    theta = recursive_least_squares(W, W @ np.array([1, 2, 3])).theta
    np.testing.assert_allclose(theta[-1], jnp.array([1.0, 2.0, 3.0]), rtol=1e-10)


def test_float64_off_is_an_error() -> None:
    with jax.enable_x64(False), pytest.raises(ValueError, match="jax_enable_x64"):
        recursive_least_squares(*regression(120))


@pytest.mark.parametrize("forgetting", [1.0, 0.9])
def test_errors_are_those_of_the_weighted_sums(forgetting: float) -> None:
    """Against dense matrices: covariance, noise, degrees of freedom, condition number and the rest."""
    W, y = regression(120)
    y += 5
    fit = recursive_least_squares(W, y, forgetting)
    known = recursive_least_squares(W, y, forgetting, noise_variance=0.04)
    for k in (3, 10, 119):
        rows, torque, d = W[: k + 1], y[: k + 1], forgetting ** np.arange(k, -1, -1.0)
        A = np.linalg.inv(rows.T * d @ rows)
        gain = A @ rows.T * d
        residual = torque - rows @ (gain @ torque)
        kernel = np.diag(d) - (d[:, None] * rows) @ gain
        variance = residual**2 @ d / np.trace(kernel)
        unit = np.sqrt(np.diagonal(gain @ gain.T))
        np.testing.assert_allclose(fit.stderr[k], np.sqrt(variance) * unit, rtol=1e-7)
        np.testing.assert_allclose(known.stderr[k], 0.2 * unit, rtol=1e-7)
        assert fit.dof[k] == pytest.approx(np.trace(kernel) ** 2 / np.trace(kernel @ kernel), rel=1e-7)
        singular = np.linalg.svd(np.sqrt(d)[:, None] * rows, compute_uv=False)
        assert fit.cond[k] == pytest.approx(singular[0] / singular[-1], rel=1e-7)
        assert fit.sigma_min[k] == pytest.approx(singular[-1], rel=1e-7)
        np.testing.assert_allclose(fit.excitation[k], 1 / np.sqrt(np.diagonal(A)), rtol=1e-7)
        mean = (d @ residual) / d.sum(), (d @ torque) / d.sum()
        vaf = 1 - d @ (residual - mean[0]) ** 2 / (d @ (torque - mean[1]) ** 2)
        assert fit.vaf[k] == pytest.approx(vaf, rel=1e-7)
        assert fit.residual_rms[k] == pytest.approx(np.sqrt(d @ residual**2 / d.sum()), rel=1e-7)
        assert fit.samples[k] == round(d.sum())
    assert np.isnan(fit.stderr[:3]).all()
    assert np.isposinf(known.dof[3:]).all()


def test_without_forgetting_errors_are_the_textbook_s() -> None:
    W, y = regression(120)
    fit, whole = recursive_least_squares(W, y), least_squares(W, y)
    for name in ("theta", "stderr", "dof", "cond", "sigma_min", "excitation", "residual_rms", "vaf", "samples"):
        np.testing.assert_allclose(getattr(fit, name)[-1], getattr(whole, name), rtol=1e-7, err_msg=name)


SIZES = np.array([30.0, 3.0, 0.3])


def rest(seed: int, position_noise: float = 1e-4, n: int = 3000) -> tuple[Numbers, Numbers]:
    """Motion in the first and the last fifth; between, noise in the rows and an unknown torque."""
    random = np.random.default_rng(seed)
    moving = (np.arange(n) < n // 5) | (np.arange(n) >= n - n // 5)
    W = np.where(moving[:, None], 1, position_noise) * random.normal(size=(n, 3)) * SIZES
    return W, W @ THETA[:3] + 0.1 * random.normal(size=n) + np.where(moving, 0, 0.5)


@pytest.mark.parametrize("position_noise", [0.0, 1e-9, 1e-4])
def test_rest_holds_what_was_known(position_noise: float) -> None:
    W, y = rest(0, position_noise)
    fit = recursive_least_squares(W, y, 0.98)
    theta, held, renewed = (np.asarray(x) for x in (fit.theta, fit.held, fit.renewed))
    assert np.isfinite(theta[3:]).all()
    assert np.abs(theta[200:] / THETA[:3] - 1).max() < 1.5
    assert held[1100:2400].all()
    assert not held[3:600].any()
    assert not held[2500:].any()
    np.testing.assert_array_equal(theta[1100:2400], np.broadcast_to(theta[1100], (1300, 3)))
    # Until columns are half as much excited, and what is remembered of them a quarter.
    assert 600 < renewed[2399] <= 600 + 50 * np.log(4)
    np.testing.assert_array_equal(theta[2399], theta[renewed[2399]])
    np.testing.assert_array_equal(renewed[3:600], np.arange(3, 600))


@pytest.mark.slow
@pytest.mark.compiles
def test_streamed_steps_are_the_scan_also_at_rest_and_over_gaps() -> None:
    W, y = rest(0, n=600)
    W[[20, 130], 1] = np.nan
    y[40:50] = np.nan
    whole = recursive_least_squares(W, y, 0.9, noise_variance=0.01)
    state, streamed, take = init(3), [], jax.jit(step)
    for w, torque in zip(W, y, strict=True):
        state, _ = take(state, w, torque, 0.9, 0.01)
        streamed.append(state.fit)
    for name, value in vars(whole).items():
        found = np.stack([getattr(fit, name) for fit in streamed])
        np.testing.assert_allclose(found, value, rtol=1e-9, err_msg=name)
    assert np.asarray(whole.held).any()


def test_what_is_not_finite_is_skipped() -> None:
    W, y = regression(120)
    broken = y.copy()
    broken[30:60] = np.nan
    fit = recursive_least_squares(W, broken, 0.95)
    kept = np.isfinite(broken)
    np.testing.assert_allclose(fit.theta[kept], recursive_least_squares(W[kept], y[kept], 0.95).theta, rtol=1e-9)
    assert (np.asarray(fit.renewed)[30:60] == 29).all()


@pytest.mark.slow
@pytest.mark.compiles
@pytest.mark.optimised
def test_intervals_hold_the_truth_in_95_percent() -> None:
    """In motion, as the memory fills, and held through rests: 800 times ten memories of motion and fifteen of rest."""
    random = np.random.default_rng(1)
    moving = np.tile(np.arange(250) < 100, 800)[:, None]
    W = np.where(moving, 1, 1e-6) * random.normal(size=(len(moving), 3)) * SIZES
    y = W @ THETA[:3] + 0.1 * random.normal(size=len(W))
    fit = recursive_least_squares(W, y, 0.9)
    low, high = confidence_interval(fit)
    inside = ((low <= THETA[:3]) & (THETA[:3] <= high)).reshape(800, 250, 3)
    assert np.asarray(fit.held)[249::250].all()
    for k in (20, 99, 249):
        assert 0.93 < inside[1:, k].mean() < 0.97


def test_a_negative_noise_is_refused() -> None:
    with pytest.raises(ValueError, match="noise_variance is -1"):
        recursive_least_squares(*regression(120), noise_variance=-1.0)
