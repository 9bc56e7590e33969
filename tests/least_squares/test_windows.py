"""Every window is the least squares of its slice, whatever the other windows hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray

from factories.regressions import THETA, regression
from jaximp.least_squares.sliding import score, sliding_least_squares, sliding_theta, window_starts
from jaximp.least_squares.window import Fit, SlidingFit, WindowFit, least_squares

Numbers = NDArray[np.float64]

fit_of: Callable[..., WindowFit] = jax.jit(least_squares)


def assert_windows_are_slices(
    fit: SlidingFit,
    W: Numbers,
    y: Numbers,
    window: int,
    step: int = 1,
    valid: NDArray[np.bool_] | None = None,
    noise: Numbers | None = None,
) -> None:
    starts = range(0, len(W) - window + 1, step)
    valid = np.ones(y.shape, bool) if valid is None else valid
    assert len(fit.theta) == len(starts)
    for m, start in enumerate(starts):
        cut = slice(start, start + window)
        expected = fit_of(W[cut], y[cut], valid[cut], noise)
        assert (int(fit.first[m]), int(fit.last[m])) == (start, start + window - 1)
        for field in fields(Fit):
            reference = np.asarray(getattr(expected, field.name))
            atol = 1e-12 * np.abs(np.nan_to_num(reference)).max()
            np.testing.assert_allclose(
                getattr(fit, field.name)[m], reference, 1e-9, atol, err_msg=f"{field.name} of {m}"
            )


@pytest.mark.parametrize(
    ("window", "step", "noise"),
    [
        pytest.param(40, 1, None, id="dense"),
        pytest.param(40, 7, 0.8 ** np.arange(12), id="coloured"),
        pytest.param(3, 50, None, id="as short as can be"),
        pytest.param(300, 9, None, id="the whole recording"),
    ],
)
def test_every_window_is_the_fit_of_its_slice(window: int, step: int, noise: Numbers | None) -> None:
    W, y = regression(300)
    assert_windows_are_slices(sliding_least_squares(W, y, window, step, noise=noise), W, y, window, step, noise=noise)


@pytest.mark.parametrize("mask", ["none", "samples", "outputs"])
def test_several_outputs_and_masks(mask: str) -> None:
    W, y = regression(120, 3, (2,))
    random = np.random.default_rng(4)
    given = {"none": None, "samples": random.random(120) < 0.6, "outputs": random.random((120, 2)) < 0.6}[mask]
    full = None if given is None else np.broadcast_to(given.reshape(120, -1), (120, 2))
    fit = sliding_least_squares(W, y, 20, 5, valid=given)
    assert_windows_are_slices(fit, W, y, 20, 5, full)


def test_one_output_with_a_mask_over_what_is_not_finite() -> None:
    W, y = regression(120)
    valid = np.random.default_rng(4).random(120) < 0.6
    broken = np.where(valid[:, None], W, np.nan), np.where(valid, y, np.inf)
    fit = sliding_least_squares(*broken, 20, 5, valid=valid)
    assert_windows_are_slices(fit, W, y, 20, 5, valid)


def test_noise_as_a_matrix_is_noise_by_lag() -> None:
    W, y = regression(90)
    lags = np.r_[1.0, 0.6, 0.2]
    matrix = np.eye(30) + sum(r * (np.eye(30, k=k) + np.eye(30, k=-k)) for k, r in ((1, 0.6), (2, 0.2)))
    by_lag, by_matrix = (sliding_least_squares(W, y, 30, noise=noise) for noise in (lags, matrix))
    np.testing.assert_allclose(by_lag.stderr, by_matrix.stderr, rtol=1e-10)
    np.testing.assert_allclose(by_lag.dof, by_matrix.dof, rtol=1e-10)


def test_against_statsmodels() -> None:
    rolling = pytest.importorskip("statsmodels.regression.rolling")
    W, y = regression(400)
    rival, fit = rolling.RollingOLS(y, W, window=50).fit(), sliding_least_squares(W, y, 50)
    np.testing.assert_allclose(fit.theta, rival.params[49:], rtol=1e-9)
    np.testing.assert_allclose(fit.stderr, rival.bse[49:], rtol=1e-9)


def test_a_collinear_stretch_is_nan_and_harms_no_other_window() -> None:
    W, y = regression(300)
    bent = W.copy()
    bent[100:160, 2] = 2 * bent[100:160, 0] - bent[100:160, 1]
    bent[200:250, 1] = 0
    fit = sliding_least_squares(bent, y, 20)
    starts = np.arange(281)
    inside = ((starts >= 100) & (starts + 20 <= 160)) | ((starts >= 200) & (starts + 20 <= 250))
    for name in ("theta", "stderr", "dof", "cond", "sigma_min", "excitation", "residual_rms", "vaf"):
        lost = np.isnan(np.asarray(getattr(fit, name)).reshape(281, -1))
        np.testing.assert_array_equal(lost, np.broadcast_to(inside[:, None], lost.shape), err_msg=name)
    assert_windows_are_slices(fit, bent, y, 20)


@pytest.mark.parametrize("drop", [1e6, 1e-6])
def test_a_change_of_amplitude_leaves_no_trace(drop: float) -> None:
    W, _ = regression(200)
    W[100:] /= drop
    fit = sliding_least_squares(W, W @ THETA[:3], 20)
    np.testing.assert_allclose(fit.theta[100:], np.broadcast_to(THETA[:3], (81, 3)), rtol=1e-11)
    np.testing.assert_allclose(fit.theta[:81], np.broadcast_to(THETA[:3], (81, 3)), rtol=1e-11)


def test_whole_numbers_are_taken() -> None:
    W = np.random.default_rng(0).integers(-50, 50, (100, 3))
    y = W @ np.array([2, -1, 3])
    fit = sliding_least_squares(W, y, 20)
    np.testing.assert_allclose(fit.theta, np.broadcast_to([2.0, -1.0, 3.0], (81, 3)), rtol=1e-11)


def with_nan(count: int) -> tuple[Numbers, Numbers]:
    W, y = regression(300)
    W[5 : 5 + count, 1] = np.nan
    return W, y


@pytest.mark.parametrize(
    ("call", "message"),
    [
        pytest.param(lambda W, y: (W, y, 301), "has 301 samples, but there are only 300", id="longer than recording"),
        pytest.param(lambda W, y: (W, y, 0), "window is 0: it must be at least one", id="window zero"),
        pytest.param(lambda W, y: (W, y, -5), "window is -5: it must be at least one", id="window negative"),
        pytest.param(lambda W, y: (W, y, 20, 0), "step is 0: it must be at least one", id="step zero"),
        pytest.param(lambda W, y: (W, y, 20, -1), "step is -1: it must be at least one", id="step negative"),
        pytest.param(lambda W, y: (W, y[:-1], 20), r"\(300, 3\) and y \(299,\)", id="other length"),
        pytest.param(lambda W, y: (W, y[:, None], 20), r"\(300, 3\) and y \(300, 1\)", id="torque with an axis"),
        pytest.param(lambda W, y: (W[:, 0], y, 20), r"W has shape \(300,\)", id="W without parameters"),
        pytest.param(lambda W, y: (W[:, None, None], y, 20), r"W has shape \(300, 1, 1, 3\)", id="W of four axes"),
        pytest.param(lambda W, y: (W, y, 2), "2 samples cannot determine 3 parameters", id="p larger than window"),
        pytest.param(lambda W, y: (*with_nan(1), 20), "^1 samples of W or y are not finite", id="one NaN"),
        pytest.param(lambda W, y: (*with_nan(7), 20), "^7 samples of W or y are not finite", id="seven NaN"),
        pytest.param(lambda W, y: (W, np.where(y > 0, y, np.inf), 20), "not finite: mark them", id="infinite torque"),
        pytest.param(lambda W, y: (W[:0], y[:0], 20), "20 samples, but there are only 0", id="empty recording"),
    ],
)
def test_errors_name_the_cause(call: Callable[[Numbers, Numbers], tuple[object, ...]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        sliding_least_squares(*call(*regression(300)))


@pytest.mark.parametrize("arguments", [(20.0,), (20, 1.5)], ids=["window", "step"])
def test_a_fraction_of_a_sample_is_refused(arguments: tuple[float, ...]) -> None:
    """By the function's own error, or under test by the check of its annotations before it."""
    with pytest.raises((ValueError, TypeError), match=r"whole number|int"):
        sliding_least_squares(*regression(300), *arguments)  # type: ignore[arg-type]


def test_seconds_without_a_sample_rate_are_told_what_is_missing(unchecked: None) -> None:
    with pytest.raises(ValueError, match=r"window is 2\.0: .* pass sample_rate to give it in seconds"):
        sliding_least_squares(*regression(300), 2.0)


@pytest.mark.parametrize("shape", [(299,), (300, 1), (300, 2), ()], ids=str)
def test_a_mask_of_another_shape_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="valid has shape"):
        sliding_least_squares(*regression(300), 20, valid=np.ones(shape, bool))


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf])
def test_weights_that_make_no_sense_are_refused(bad: float) -> None:
    weights = np.ones(300)
    weights[7] = bad
    with pytest.raises(ValueError, match="finite and not negative"):
        sliding_least_squares(*regression(300), 20, weights=weights)
    with pytest.raises(ValueError, match="weights has shape"):
        sliding_least_squares(*regression(300), 20, weights=weights[:9])


def test_lengths_in_seconds() -> None:
    W, y = regression(300)
    expected, fit = sliding_least_squares(W, y, 20, 5), sliding_least_squares(W, y, 0.2, 0.05, sample_rate=100.0)
    for field in fields(SlidingFit):
        np.testing.assert_array_equal(getattr(fit, field.name), getattr(expected, field.name))
    np.testing.assert_array_equal(sliding_theta(W, y, 0.2, sample_rate=100.0), sliding_least_squares(W, y, 20).theta)
    with pytest.raises(ValueError, match=r"window is 0\.002 s, less than one sample at 100 Hz"):
        sliding_least_squares(W, y, 0.002, sample_rate=100.0)


def test_window_starts() -> None:
    assert window_starts(10, 4, 3).tolist() == [0, 3, 6]
    assert window_starts(10, 10, 3).tolist() == [0]


def test_float64_off_is_an_error() -> None:
    W, y = regression(300)
    with jax.enable_x64(False), pytest.raises(ValueError, match="jax_enable_x64"):
        sliding_least_squares(W, y, 20)


def test_vmap_over_recordings_is_a_loop() -> None:
    several = [regression(80, seed=seed) for seed in range(3)]
    W, y = (np.stack(x) for x in zip(*several, strict=True))
    batch = jax.vmap(lambda W, y: sliding_least_squares(W, y, 20, 9))(W, y)
    for k in range(3):
        one = sliding_least_squares(W[k], y[k], 20, 9)
        for name in (field.name for field in fields(SlidingFit)):
            np.testing.assert_allclose(getattr(batch, name)[k], getattr(one, name), rtol=1e-9, err_msg=name)


def test_gradient_through_the_estimates_is_finite_difference() -> None:
    W, y = regression(60)
    direction, step = np.random.default_rng(8).normal(size=W.shape), 1e-6

    @jax.jit
    def loss(amount: float) -> jax.Array:
        fit = sliding_least_squares(jnp.asarray(W + amount * direction), jnp.asarray(y), 20, 7)
        return (fit.theta**2).sum()

    difference = (float(loss(step)) - float(loss(-step))) / (2 * step)
    assert float(jax.grad(loss)(0.0)) == pytest.approx(difference, rel=1e-6)


@pytest.mark.parametrize("outputs", [(), (2,)], ids=["one output", "two outputs"])
@pytest.mark.parametrize("room", [None, 33])
def test_score_is_a_loop(outputs: tuple[int, ...], room: int | None) -> None:
    W, y = regression(150, 3, outputs)
    random = np.random.default_rng(6)
    valid = random.random(y.shape) < 0.7
    valid[60:100] = False
    theta = THETA[:3] + random.normal(size=(13, 3))
    start = np.r_[np.arange(0, 120, 10), 131]
    held_out = score(*(jnp.asarray(x) for x in (W, y, valid, theta, start)), 20, 10, room).vaf
    for m, first in enumerate(start):
        cut = slice(first, first + 20)
        counts = valid[cut].reshape(len(valid[cut]), -1)
        if first + 20 > 150 or counts.mean() < 0.5:
            assert np.isnan(held_out[m])
            continue
        scatter = [0.0, 0.0]
        for which, x in enumerate((y[cut] - W[cut] @ theta[m], y[cut])):
            for column, good in zip(x.reshape(len(counts), -1).T, counts.T, strict=True):
                scatter[which] += ((column[good] - column[good].mean()) ** 2).sum()
        assert float(held_out[m]) == pytest.approx(1 - scatter[0] / scatter[1], rel=1e-9)
    assert np.isfinite(held_out).sum() >= 6
    assert np.isnan(held_out[-1])


@pytest.mark.parametrize("noise", [None, np.array([1.0, 0.5, 0.2])], ids=["white", "coloured"])
def test_room_to_spare_changes_nothing(noise: Numbers | None) -> None:
    random = np.random.default_rng(5)
    W, y = random.normal(size=(200, 3)), random.normal(size=200)
    plain = sliding_least_squares(W, y, 30, 7, noise=noise)
    roomy = sliding_least_squares(W, y, 30, 7, noise=noise, room=80)
    for name in ("theta", "stderr", "dof", "cond", "vaf", "last", "samples"):
        np.testing.assert_allclose(getattr(roomy, name), getattr(plain, name), rtol=1e-9)
