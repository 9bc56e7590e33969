"""Recursive least squares is weighted least squares of everything seen so far."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray

from factories.regressions import THETA, regression
from jaximp.least_squares.recursive import init, recursive_least_squares, step

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
