"""Noise that follows from its own past: against covariance matrices written out, and against records of known noise."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import block_diag, toeplitz
from scipy.signal import lfilter

from jaximp.least_squares import autoregression
from jaximp.least_squares.autoregression import (
    NEARLY_ONE,
    Autoregression,
    _fit,
    _likelihood,
    _searched,
    _straight,
    _stretches,
    _sums,
    autoregression_of,
    fit_window_noise,
    whiten_rows,
)
from jaximp.signals import autocovariance, butterworth

Numbers = NDArray[np.float64]
NOISE = Autoregression(np.array([-0.8, 0.5, 0.2]))


def rows(n: int, seed: int = 0) -> tuple[Numbers, Numbers]:
    """Columns (n, 3), the last a constant, and a torque."""
    generator = np.random.default_rng(seed)
    W = np.column_stack([generator.normal(size=(n, 2)).cumsum(axis=0) / 5, np.ones(n)])
    return W, generator.normal(size=n)


def sample(noise: Autoregression, n: int, generator: np.random.Generator) -> Numbers:
    """n values of it, at neighbouring rows."""
    e: Numbers = lfilter([1.0], noise.polynomial, generator.normal(size=n + 1000))[1000:]
    return e


def test_the_autocovariance_is_that_of_the_recursion() -> None:
    impulse = lfilter([1.0], NOISE.polynomial, np.eye(1, 4000)[0])
    expected = [impulse[: 4000 - k] @ impulse[k:] for k in range(12)]
    np.testing.assert_allclose(NOISE.autocovariance(12), np.array(expected) / expected[0], atol=1e-12)


def test_the_spectrum_is_that_of_the_autocovariance() -> None:
    r, f = NOISE.autocovariance(400), np.array([0.0, 7.0, 31.0, 49.0])
    expected = 2 / 100 * (1 + 2 * (np.cos(2 * np.pi * f[:, None] * np.arange(1, 400) / 100) @ r[1:]))
    np.testing.assert_allclose(NOISE.spectrum(f, 100.0), expected, rtol=1e-9)


@pytest.mark.parametrize("every", [1, 3])
def test_white_rows_are_those_of_a_cholesky_factor(every: int) -> None:
    n, (W, y) = 40 * every, rows(40 * every)
    noise = Autoregression(NOISE.reflections, every)
    valid = np.ones(n, bool)
    valid[[5, 17 * every, 17 * every + 1]] = False
    found = whiten_rows(np.column_stack([W, y]), valid, noise)
    new = np.prod(1 - noise.reflections**2)
    for phase in range(every):
        index = np.arange(phase, n, every)
        gaps = np.flatnonzero(np.diff(np.flatnonzero(valid[index])) > 1)
        runs = np.split(index[valid[index]], gaps + 1)
        covariance = block_diag(*(toeplitz(noise.autocovariance(len(run))) for run in runs)) / new
        kept = np.concatenate(runs)
        expected = np.linalg.solve(np.linalg.cholesky(covariance), np.column_stack([W, y])[kept])
        np.testing.assert_allclose(found[kept], expected, atol=1e-10)
    assert (found[~valid] == 0).all()


def test_the_restricted_likelihood_is_that_of_the_covariance_matrix() -> None:
    """Differences between two noises: constants that no noise changes are left out."""
    n, window = 90, 30
    (W, y), valid = rows(n), np.ones(n, bool)
    valid[40] = False
    stretches = _stretches(valid, window, 1)
    sums = _sums(np.column_stack([W, y]), stretches, 3)
    assert sums is not None

    def written_out(noise: Autoregression) -> float:
        total = 0.0
        for runs in stretches:
            V = block_diag(*(toeplitz(noise.autocovariance(len(run))) for run in runs))
            V /= np.prod(1 - noise.reflections**2)
            kept = np.concatenate(runs)
            inverse = np.linalg.inv(V)
            gram = W[kept].T @ inverse @ W[kept]
            residual = y[kept] - W[kept] @ np.linalg.solve(gram, W[kept].T @ inverse @ y[kept])
            freedom = len(kept) - W.shape[1]
            total += freedom * np.log(residual @ inverse @ residual)
            total += np.linalg.slogdet(V)[1] + np.linalg.slogdet(gram)[1]
        return total

    def computed(noise: Autoregression) -> float:
        return _likelihood(noise.reflections, sums)[0]

    other = Autoregression(np.array([0.3, -0.6, 0.1]))
    assert computed(NOISE) - computed(other) == pytest.approx(written_out(NOISE) - written_out(other), abs=1e-8)


def test_the_slopes_of_the_likelihood_are_differences() -> None:
    (W, y), reflections = rows(200), np.array([0.4, -0.3, 0.2])
    sums = _sums(np.column_stack([W, y]), _stretches(np.ones(200, bool), 50, 1), 3)
    assert sums is not None
    slopes = _likelihood(reflections, sums)[1]
    for k, unit in enumerate(np.eye(3)):
        high, low = (_likelihood(reflections + sign * 1e-6 * unit, sums)[0] for sign in (1, -1))
        assert slopes[k] == pytest.approx((high - low) / 2e-6, rel=1e-6)


@pytest.mark.parametrize("window", [40, 200])
def test_the_noise_of_a_long_record_is_found(window: int) -> None:
    generator = np.random.default_rng(3)
    W, _ = rows(8000, seed=4)
    y = W @ [3.0, -2.0, 5.0] + sample(NOISE, 8000, generator)
    found = fit_window_noise(W, y, np.ones(8000, bool), window)
    np.testing.assert_allclose(found.polynomial[:4], NOISE.polynomial, atol=0.05)


def test_what_the_parameters_took_is_given_back() -> None:
    """Windows of 30 rows with three parameters take a good part of slow noise; the estimate must not shrink by it."""
    generator, slow = np.random.default_rng(5), Autoregression(np.array([-0.95]))
    found = []
    for seed in range(20):
        W, _ = rows(1500, seed=seed)
        y = sample(slow, 1500, generator)
        valid = np.ones(1500, bool)
        sums = _sums(np.column_stack([W, y]), _stretches(valid, 30, 1), 1)
        assert sums is not None
        grid = np.linspace(-0.99, -0.6, 40)
        found.append(grid[np.argmin([_likelihood(np.array([one]), sums)[0] for one in grid])])
    assert np.mean(found) == pytest.approx(-0.95, abs=0.02)


def test_what_parameters_took_is_not_counted_for_rows_that_neighbours_only_resemble() -> None:
    """A robot's slow columns take a fifth of a window's rows: the white noise that is left must not pass for slow."""
    t = np.arange(500) / 25
    q = 0.7 * np.sin(2 * np.pi * 0.2 * t) + 0.3 * np.sin(2 * np.pi * 0.5 * t)
    dq = np.gradient(q, t)
    W = np.stack([np.cos(q), np.sin(q), dq, np.sign(dq), np.gradient(dq, t)], axis=1)
    valid, generator = np.ones(500, bool), np.random.default_rng(0)
    orders = [fit_window_noise(W, generator.normal(size=500), valid, 50, every=2).order for _ in range(10)]
    assert np.sum(np.array(orders) > 0) <= 2


def test_a_change_of_the_parameters_is_no_noise() -> None:
    generator = np.random.default_rng(6)
    W, _ = rows(4000, seed=7)
    theta = np.where(np.arange(4000)[:, None] < 2000, [1.0, 2.0, 3.0], [9.0, -2.0, 0.0])
    y = (W * theta).sum(axis=1) + generator.normal(size=4000)
    assert fit_window_noise(W, y, np.ones(4000, bool), 200).order == 0
    assert fit_window_noise(W, y, np.ones(4000, bool), 4000 // 20 * 19).order > 0


def test_short_windows_tell_noise_of_a_high_order_though_each_has_parameters_of_its_own() -> None:
    """A tremor takes more terms than a window of 25 rows can tell."""
    noise = Autoregression(np.array([-0.25, 0.9, -0.2, 0.85, 0.1, 0.5, 0.3, -0.4, 0.2, 0.3]))
    generator, window, n = np.random.default_rng(12), 25, 5000
    W = generator.normal(size=(n, 3))
    theta = np.repeat(10 * generator.normal(size=(n // window, 3)), window, axis=0)
    y = (W * theta).sum(axis=1) + sample(noise, n, generator)
    found = fit_window_noise(W, y, np.ones(n, bool), window)
    assert found.order >= noise.order
    f = np.linspace(0, 0.5, 200)
    ratio = found.spectrum(f, 1.0) / noise.spectrum(f, 1.0)
    assert np.exp(np.abs(np.log(ratio)).mean()) < 1.3


def test_white_noise_and_few_rows_need_no_autoregression() -> None:
    generator = np.random.default_rng(8)
    W, _ = rows(60, seed=9)
    assert fit_window_noise(W, generator.normal(size=60), np.ones(60, bool), 12).order == 0
    assert fit_window_noise(W, generator.normal(size=60), np.zeros(60, bool), 12).order == 0


def test_a_long_step_of_the_search_ends_nothing() -> None:
    """Twice differenced, nothing is left of a constant, and of a slow motion little."""
    random, t = np.random.default_rng(0), np.arange(4000) / 100
    W = np.column_stack([np.sin(8.2 * t) + 0.1 * random.normal(size=4000), np.cos(8.2 * t), np.ones(4000)])
    z = np.column_stack([W, random.normal(size=4000)])
    sums = _sums(z, _stretches(np.ones(4000, bool), 200, 1), 8)
    assert sums is not None
    for order in (2, 4, 8):
        for signs in random.choice([-1, 1], size=(40, order)):
            value, slopes, _ = _likelihood(NEARLY_ONE * signs, sums)
            assert np.isfinite([value, *slopes]).all()


def test_newtons_steps_lead_where_the_search_along_lines_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(autoregression, "SETTLED", 1e-8)
    W, _ = rows(4000, seed=14)
    y = W @ [3.0, -2.0, 5.0] + sample(NOISE, 4000, np.random.default_rng(15))
    sums = _sums(np.column_stack([W, y]), _stretches(gaps(50, 70), 200, 1), 8)
    assert sums is not None
    for order in (2, 4, 8):
        near = np.arctanh(np.pad(NOISE.reflections, (0, 5))[:order])
        found, other = _straight(sums, near), _searched(sums, np.zeros(order))
        assert found is not None
        np.testing.assert_allclose(found[0], other[0], atol=1e-6)
        assert found[1] == pytest.approx(other[1], abs=1e-6)


def test_where_newtons_steps_go_astray_the_search_along_lines_takes_over() -> None:
    W, _ = rows(4000, seed=16)
    y = sample(Autoregression(np.array([-0.99, 0.9])), 4000, np.random.default_rng(17))
    sums = _sums(np.column_stack([W, y]), _stretches(np.ones(4000, bool), 200, 1), 2)
    assert sums is not None
    assert _straight(sums, np.zeros(2)) is None
    np.testing.assert_allclose(_fit(sums, np.zeros(2))[0], [-0.99, 0.9], atol=0.03)


def gaps(*lengths: int) -> NDArray[np.bool_]:
    """(4000,) windows of 200 rows that begin with runs of these lengths, a gap of one row after each."""
    one = np.ones(200, bool)
    one[np.cumsum(np.add(lengths, 1)) - 1] = False
    return np.tile(one, 20)


def test_orders_compare_by_the_same_rows() -> None:
    """Short runs serve low orders only; without them the likelihood of a higher order is that of less data."""
    orders = []
    for seed in range(15):
        W, y = rows(4000, seed=100 + seed)
        orders.append(fit_window_noise(W, y, gaps(*[19] * 5), 200).order)
    assert np.mean(np.array(orders) == 0) > 0.6


def test_noise_is_found_between_many_gaps() -> None:
    """No run of 39 rows serves an order of 32, and those of lower orders are not lost by it."""
    generator = np.random.default_rng(12)
    W, _ = rows(4000, seed=13)
    found = fit_window_noise(W, sample(NOISE, 4000, generator), gaps(39, 39, 39, 39, 39), 200)
    np.testing.assert_allclose(found.polynomial[:4], NOISE.polynomial, atol=0.1)


def test_a_window_without_motion_and_one_without_noise_harm_nothing() -> None:
    generator = np.random.default_rng(10)
    W, _ = rows(1200, seed=11)
    W[200:400, :2] = 0
    y = W @ [1.0, 2.0, 3.0] + sample(NOISE, 1200, generator)
    y[600:800] = W[600:800] @ [1.0, 2.0, 3.0]
    found = fit_window_noise(W, y, np.ones(1200, bool), 200)
    assert np.isfinite(found.reflections).all()
    assert (np.abs(found.reflections) < 1).all()


def test_what_filters_made_of_white_noise_is_known() -> None:
    sos = butterworth(4, 20.0, 1000.0)
    known = autoregression_of(autocovariance(sos, 10), every=2)
    r = np.pad(autocovariance(sos, 20), (0, 40))[:40]
    assert known.every == 2
    np.testing.assert_allclose(known.autocovariance(known.order + 1), r[: known.order + 1], atol=1e-9)
    np.testing.assert_allclose(known.autocovariance(20), r[:20], atol=0.02)
