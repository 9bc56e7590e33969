"""Filters against scipy, derivatives against parabolas, gaps against a loop, noise levels against known noise."""

from __future__ import annotations

import inspect
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import sosfiltfilt

from jaximp.numerics.precision import require_float64
from jaximp.signals import (
    autocovariance,
    butterworth,
    central_differences,
    cut_signal,
    design_differentiator,
    differentiate,
    differentiate_in_windows,
    differentiate_padded,
    fill_gaps,
    filter_in_windows,
    filter_zero_phase,
    filter_zero_phase_decimated,
    jumps,
    noise_level,
    quantisation_step,
    reach,
    widen_gaps,
    zero_phase_matrix,
)

RATE = 1000.0
HALF = 4000  # one side of the impulse responses below


def noise(shape: tuple[int, ...] | int, seed: int = 0) -> NDArray[np.float64]:
    return np.random.default_rng(seed).normal(size=shape)


def impulse_response(sos: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of the zero-phase filter, lags -HALF to HALF."""
    impulse = np.zeros(2 * HALF + 1)
    impulse[HALF] = 1
    return sosfiltfilt(sos, impulse)


FILTERS = [
    pytest.param(butterworth(1, 50, RATE), id="order 1"),
    pytest.param(butterworth(2, 20, RATE), id="order 2"),
    pytest.param(butterworth(4, 20, RATE), id="order 4"),
    pytest.param(butterworth(8, 100, RATE), id="order 8"),
    pytest.param(butterworth(3, 30, RATE, "highpass"), id="high-pass"),
    pytest.param(np.concatenate([butterworth(2, 60, RATE), butterworth(2, 5, RATE, "highpass")]), id="band-pass"),
]


@pytest.mark.slow
@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    order=st.integers(1, 10),
    cutoff=st.floats(0.02, 0.95),
    kind=st.sampled_from(["lowpass", "highpass"]),
    shape=st.sampled_from([(64,), (301, 2, 3)]),
    seed=st.integers(0, 1000),
)
def test_filter_is_scipys(order: int, cutoff: float, kind: str, shape: tuple[int, ...], seed: int) -> None:
    sos = butterworth(order, cutoff * RATE / 2, RATE, kind)
    x = 3 + noise(shape, seed).cumsum(axis=0)
    expected = sosfiltfilt(sos, x, axis=0)
    assert np.abs(filter_zero_phase(sos, x) - expected).max() <= 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("sos", FILTERS)
@pytest.mark.parametrize(("samples", "every"), [(1000, 10), (961, 7), (60, 10), (500, 1), (320, 160)])
def test_what_is_kept_of_every_so_many_samples_is_scipys(sos: NDArray[np.float64], samples: int, every: int) -> None:
    x = 3 + noise((3, samples)).cumsum(axis=1)
    expected = sosfiltfilt(sos, x)[:, ::every]
    found = filter_zero_phase_decimated(sos, x, every)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10 * np.abs(x).max())


@pytest.mark.parametrize("sos", FILTERS[1::2])
def test_whole_numbers_are_filtered_like_scipy_or_refused(sos: NDArray[np.float64]) -> None:
    """Encoder counts, on the function as users have it: without the check of annotations."""
    counts = np.round(100 * noise(200).cumsum()).astype(int)
    try:
        filtered = inspect.unwrap(filter_zero_phase)(sos, counts)
    except (ValueError, TypeError):
        return
    np.testing.assert_allclose(filtered, sosfiltfilt(sos, counts), rtol=1e-9, atol=1e-7)


@pytest.mark.parametrize("sos", FILTERS)
@pytest.mark.parametrize(
    ("shape", "window", "step"),
    [((700,), 300, 1), ((700, 2), 300, 37), ((700,), 28, 11), ((700,), 700, 1), ((700, 2), 60, 90)],
    ids=["sliding", "two joints", "short windows", "all of it", "windows apart"],
)
def test_filtering_in_windows_is_scipys_in_each(
    sos: NDArray[np.float64], shape: tuple[int, ...], window: int, step: int
) -> None:
    x = 3 + noise(shape).cumsum(axis=0)
    starts = np.arange(0, shape[0] - window + 1, step)
    found = filter_in_windows(sos, cut_signal(x, starts, window)).at(np.arange(window))
    expected = np.stack([sosfiltfilt(sos, x[start : start + window], axis=0) for start in starts])
    assert np.abs(found - expected).max() <= 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("shape", [(300,), (300, 2)])
def test_what_is_done_in_windows_can_be_done_one_after_another(shape: tuple[int, ...]) -> None:
    """Filter, differences, and filter again: of every window, and of every other sample in it."""
    position, parallel = butterworth(8, 100, RATE), butterworth(4, 60, RATE)
    x, starts, window = 3 + noise(shape).cumsum(axis=0), np.arange(0, 201, 20), 100
    every_other = np.arange(0, window, 2)
    q = filter_in_windows(position, cut_signal(x, starts, window))
    for k, derivative in enumerate(differentiate_in_windows(q, RATE)):
        found = filter_in_windows(parallel, derivative).at(every_other)
        cuts = (sosfiltfilt(position, x[start : start + window], axis=0) for start in starts)
        expected = np.stack([sosfiltfilt(parallel, central_differences(cut, RATE)[k], axis=0)[::2] for cut in cuts])
        assert np.abs(found - expected).max() <= 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("sos", FILTERS)
@pytest.mark.parametrize(("n", "every"), [(28, 1), (400, 7)])
def test_the_matrix_of_a_filter_is_what_scipy_makes_of_impulses(sos: NDArray[np.float64], n: int, every: int) -> None:
    np.testing.assert_allclose(
        zero_phase_matrix(sos, n, every), sosfiltfilt(sos, np.eye(n), axis=0)[::every], atol=1e-9
    )


@pytest.mark.slow
@pytest.mark.parametrize("sos", FILTERS[::3])
def test_filter_vmap_is_a_loop(sos: NDArray[np.float64]) -> None:
    x = noise((5, 100, 2))
    loop = np.stack([filter_zero_phase(sos, one) for one in x])
    np.testing.assert_allclose(jax.vmap(lambda one: filter_zero_phase(sos, one))(x), loop, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(jax.jit(lambda one: filter_zero_phase(sos, one))(x[0]), loop[0], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("sos", FILTERS[1::3])
def test_filter_gradient_is_finite_difference(sos: NDArray[np.float64]) -> None:
    x, target, step = noise(80), noise(80, 1), 1e-4

    @jax.jit
    def loss(x: jax.Array) -> jax.Array:
        return ((filter_zero_phase(sos, x) - target) ** 2).sum()

    gradient = jax.grad(loss)(jnp.asarray(x))
    for k in (0, 1, 37, 78, 79):
        move = step * (np.arange(80) == k)
        difference = (float(loss(x + move)) - float(loss(x - move))) / (2 * step)
        assert float(gradient[k]) == pytest.approx(difference, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("order", [1, 3, 8])
def test_amplitude_at_the_cutoff_is_a_half(order: int) -> None:
    t = np.arange(8000) / RATE
    filtered = np.asarray(filter_zero_phase(butterworth(order, 20, RATE), np.sin(2 * np.pi * 20 * t)))
    assert np.sqrt(2 * (filtered[3000:5000] ** 2).mean()) == pytest.approx(0.5, rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        pytest.param((0, 20, RATE), "order is 0: it must be a whole number above zero", id="order zero"),
        pytest.param((-2, 20, RATE), "order is -2", id="negative order"),
        pytest.param((2, 500, RATE), "between 0 and 500 Hz, half the sample rate", id="at Nyquist"),
        pytest.param((2, 700, RATE), "cut-off of 700 Hz", id="above Nyquist"),
        pytest.param((2, 0, RATE), "cut-off of 0 Hz", id="zero"),
        pytest.param((2, -3, RATE), "cut-off of -3 Hz", id="negative"),
        pytest.param((2, float("nan"), RATE), "cut-off of nan Hz", id="NaN"),
        pytest.param((2, 600, RATE, "highpass"), "highpass cut-off of 600 Hz", id="high-pass"),
    ],
)
def test_a_filter_that_cannot_be_is_refused(arguments: tuple[float, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        butterworth(*arguments)


def test_a_fractional_order_is_refused() -> None:
    """By the function's own error, or under test by the check of its annotations before it."""
    with pytest.raises((ValueError, TypeError), match=r"whole number|int"):
        butterworth(2.5, 20, RATE)  # type: ignore[arg-type]


@pytest.mark.parametrize("order", [1, 2, 5, 8])
def test_a_signal_too_short_for_the_filter_is_refused(order: int) -> None:
    sos = butterworth(order, 20, RATE)
    shortest = next(n for n in range(1, 100) if _scipy_filters(sos, n))
    filter_zero_phase(sos, noise(shortest))
    with pytest.raises(ValueError, match=f"{shortest - 1} samples are too few for this filter, which needs more than"):
        filter_zero_phase(sos, noise(shortest - 1))


def _scipy_filters(sos: NDArray[np.float64], n: int) -> bool:
    try:
        sosfiltfilt(sos, noise(n))
    except ValueError:
        return False
    return True


def test_float64_off_is_one_clear_error() -> None:
    sos = butterworth(2, 20, RATE)
    with jax.enable_x64(False), pytest.raises(ValueError, match="jax_enable_x64"):
        require_float64()
    with jax.enable_x64(False):
        with pytest.raises(ValueError, match="jax_enable_x64"):
            filter_zero_phase(sos, noise(100))
        with pytest.raises(ValueError, match="jax_enable_x64"):
            require_float64(noise(3).astype(np.float32), noise(3))
        require_float64(noise(3).astype(np.float32))
        single = filter_zero_phase(sos, noise(100).astype(np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, sosfiltfilt(sos, noise(100)), atol=1e-4)
    require_float64(noise(3))


@pytest.mark.parametrize("n", [3, 4, 5, 50])
@pytest.mark.parametrize("columns", [(), (2,)], ids=str)
def test_central_differences_are_exact_for_parabolas_to_the_ends(n: int, columns: tuple[int, ...]) -> None:
    a, b, c = noise((3, *columns))
    t = (np.arange(n) / RATE).reshape(-1, *(1 for _ in columns))
    dq, ddq = central_differences(a + b * t + c * t**2, RATE)
    np.testing.assert_allclose(dq, b + 2 * c * t, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(ddq, np.broadcast_to(2 * c, (n, *columns)), rtol=1e-4, atol=1e-7)


def test_central_differences_of_a_sine_and_their_gradient() -> None:
    t = np.arange(2000) / RATE
    dq, ddq = central_differences(np.sin(5 * t), RATE)
    np.testing.assert_allclose(dq, 5 * np.cos(5 * t), atol=2e-4)
    np.testing.assert_allclose(ddq[1:-1], -25 * np.sin(5 * t)[1:-1], atol=1e-3)
    matrix = jax.jacobian(lambda q: central_differences(q, RATE)[0])(jnp.asarray(np.sin(t[:6])))
    np.testing.assert_allclose(matrix @ t[:6], 1.0, rtol=1e-9)


BANDS = [0.02, 0.2, 0.5, 0.8, 0.95]
"""Of half the sample rate."""


@pytest.mark.parametrize("band", BANDS)
def test_derivatives_are_right_up_to_the_end_of_their_band(band: float) -> None:
    by, t = design_differentiator(band), np.arange(2000) / RATE
    inside = slice(by.half, -by.half)
    for share in (0.01, 0.3, 0.7, 0.95, 1.0):
        w = 2 * np.pi * share * band * RATE / 2
        dq, ddq = differentiate(np.sin(w * t + 0.3), RATE, by)
        assert np.abs(dq - w * np.cos(w * t + 0.3))[inside].max() < 1e-3 * w
        assert np.abs(ddq + w**2 * np.sin(w * t + 0.3))[inside].max() < 1e-3 * w**2


def test_central_differences_are_not() -> None:
    w, t = 2 * np.pi * 0.2 * RATE / 2, np.arange(2000) / RATE
    dq, ddq = (x[1:-1] for x in central_differences(np.sin(w * t), RATE))
    np.testing.assert_allclose(dq, np.sin(w / RATE) * RATE * np.cos(w * t[1:-1]), atol=1e-6)
    np.testing.assert_allclose(ddq, -((2 * np.sin(w / RATE / 2) * RATE) ** 2) * np.sin(w * t[1:-1]), atol=1e-3)


@pytest.mark.parametrize("band", BANDS)
def test_a_parabola_is_differentiated_exactly_to_the_ends(band: float) -> None:
    a, b, c = noise((3, 2))
    t = (np.arange(300) / RATE)[:, None]
    dq, ddq = differentiate(a + b * t + c * t**2, RATE, design_differentiator(band))
    np.testing.assert_allclose(dq, b + 2 * c * t, atol=1e-9)
    np.testing.assert_allclose(ddq, np.broadcast_to(2 * c, (300, 2)), atol=1e-5)


@pytest.mark.parametrize("band", [0.2, 0.8])
def test_derivatives_are_the_same_padded_in_windows_and_in_jax(band: float) -> None:
    by, x = design_differentiator(band), noise((500, 2)).cumsum(axis=0)
    expected = differentiate(x, RATE, by)
    behind = np.concatenate([x, np.full((77, 2), 1e3)])
    padded = jax.jit(differentiate_padded)(behind, RATE, 500, by)
    starts = np.array([0, 20, 399])
    in_windows = differentiate_in_windows(cut_signal(x, starts, 101), RATE, by)
    for k, whole in enumerate(expected):
        largest = np.abs(whole).max()
        np.testing.assert_allclose(differentiate(jnp.asarray(x), RATE, by)[k], whole, atol=1e-12 * largest)
        np.testing.assert_allclose(padded[k][:500], whole, atol=1e-12 * largest)
        cuts = np.stack([differentiate(x[start : start + 101], RATE, by)[k] for start in starts])
        np.testing.assert_allclose(in_windows[k].at(np.arange(101)), cuts, atol=1e-12 * largest)


def test_derivatives_that_cannot_be_had_are_refused() -> None:
    with pytest.raises(ValueError, match=r"lower filter\.position_cutoff"):
        design_differentiator(0.9999)
    with pytest.raises(ValueError, match="32 samples are too few for derivatives: at least 33 are needed"):
        differentiate(np.zeros(32), RATE, design_differentiator(0.8))


@pytest.mark.parametrize("sos", FILTERS)
@pytest.mark.parametrize("every", [1, 7, 40])
def test_autocovariance_is_that_of_the_impulse_response(sos: NDArray[np.float64], every: int) -> None:
    response = impulse_response(sos)
    lags = np.correlate(response, response, "full")[2 * HALF :]
    expected = (lags / lags[0])[::every]
    r = autocovariance(sos, every)
    assert r[0] == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(r, expected[: len(r)], atol=1e-8)
    assert np.abs(expected[len(r) :]).max(initial=0) < 1e-8


def test_autocovariance_is_that_of_filtered_noise() -> None:
    sos = butterworth(2, 60, RATE)
    filtered = np.asarray(filter_zero_phase(sos, noise((2000, 400))))[500:1500]
    r = autocovariance(sos)
    measured = [(filtered[: 1000 - k] * filtered[k:]).mean() for k in range(30)]
    np.testing.assert_allclose(np.array(measured) / measured[0], r[:30], atol=0.01)


@pytest.mark.parametrize("sos", FILTERS)
@pytest.mark.parametrize("share", [0.3, 0.01, 1e-4])
def test_reach_holds_all_but_a_share_of_the_impulse_response(sos: NDArray[np.float64], share: float) -> None:
    size = np.abs(impulse_response(sos))
    lag = np.abs(np.arange(-HALF, HALF + 1))
    r = reach(sos, share)
    assert size[lag > r].sum() <= share * size.sum() * (1 + 1e-6)
    assert size[lag > r - 1].sum() > share * size.sum() * (1 - 1e-6)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_reach_and_autocovariance_at_a_quarter_of_the_sample_rate(order: int) -> None:
    """There a pole lies at zero: the response is (nearly) finite."""
    sos = butterworth(order, RATE / 4, RATE)
    response = impulse_response(sos)
    assert 1 <= reach(sos) < 20
    lags = np.correlate(response, response, "full")[2 * HALF :]
    r = autocovariance(sos)
    np.testing.assert_allclose(r, (lags / lags[0])[: len(r)], atol=1e-8)


def test_fill_gaps_draws_straight_lines() -> None:
    x = np.arange(12.0).reshape(6, 2)
    valid = np.array([True, False, False, True, True, False])
    broken = np.where(valid[:, None], x, np.nan)
    filled = fill_gaps(broken, valid)
    np.testing.assert_allclose(filled[:5], x[:5], rtol=1e-14)
    np.testing.assert_array_equal(filled[5], x[4])
    np.testing.assert_allclose(fill_gaps(broken[:, 0], valid), filled[:, 0])
    np.testing.assert_array_equal(fill_gaps(x, np.ones(6, bool)), x)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(valid=st.lists(st.booleans(), min_size=1, max_size=40), by=st.integers(0, 60))
def test_widen_gaps_is_a_loop(valid: list[bool], by: int) -> None:
    gone = [-1, *(k for k, good in enumerate(valid) if not good), len(valid)]
    expected = [all(abs(k - g) > by for g in gone) for k in range(len(valid))]
    widened = widen_gaps(np.array(valid), by)
    assert widened.tolist() == expected


SLOW = 0.4 * np.sin(2 * np.pi * 1.1 * np.arange(20000) / RATE)


@pytest.mark.parametrize("sigma", [1e-6, 1e-3, 5.0])
@pytest.mark.parametrize("slow", [0.0, 1.0], ids=["alone", "on a slow motion"])
def test_noise_level_of_white_noise(sigma: float, slow: float) -> None:
    x = slow * SLOW + sigma * noise(len(SLOW))
    assert noise_level(x) == pytest.approx(sigma, rel=0.03)


@pytest.mark.parametrize("missing", [0, 1, 3])
def test_a_jump_beside_missing_samples_is_one(missing: int) -> None:
    x = np.sin(np.arange(2000) / 100)
    x[1000:] += 0.3
    x[1000 : 1000 + missing] = np.nan
    assert np.flatnonzero(jumps(x, 1e-6)).tolist() == [999 + missing, 1000 + missing]
    assert not jumps(np.where(np.arange(2000) // 3 % 50 == 0, np.nan, np.sin(np.arange(2000) / 100)), 1e-6).any()


def test_noise_level_ignores_jumps_and_gaps() -> None:
    x = 1e-3 * noise(20000) + SLOW + np.where(np.arange(20000) > 7000, 3.0, 0.0)
    x[[100, 5000, 9000]] = np.nan
    assert noise_level(x) == pytest.approx(1e-3, rel=0.03)


def test_noise_level_of_nothing_and_of_a_clean_motion() -> None:
    assert noise_level(np.zeros(4)) == 0.0
    assert noise_level(np.full(100, np.nan)) == 0.0
    assert noise_level(SLOW) < 1e-9


@pytest.mark.parametrize("counts", [200, 2000])
def test_a_coarse_encoder_leaves_at_least_its_rounding_noise(counts: int) -> None:
    step = 2 * np.pi / counts
    assert noise_level(step * np.round(SLOW / step)) >= step / np.sqrt(12) * (1 - 1e-9)


@pytest.mark.parametrize("step", [1e-5, 2 * np.pi / 2000, 0.1])
@pytest.mark.parametrize("offset", [0.0, 0.123], ids=["from zero", "shifted"])
def test_quantisation_step_of_an_encoder(step: float, offset: float) -> None:
    x = step * np.round((SLOW + 0.2 * step * noise(len(SLOW))) / step) + offset
    assert quantisation_step(x) == pytest.approx(step, rel=1e-6)


@pytest.mark.parametrize(
    "x",
    [
        pytest.param(SLOW + 1e-3 * noise(len(SLOW)), id="noise"),
        pytest.param(np.zeros(100), id="constant"),
        pytest.param(np.array([0.0, 1.0] * 50), id="two values"),
        pytest.param(np.linspace(0, 1, 1000), id="ramp without repeats"),
        pytest.param(np.full(10, np.nan), id="nothing"),
    ],
)
def test_no_quantisation_step_where_none_can_be_seen(x: NDArray[np.float64]) -> None:
    assert quantisation_step(x) == 0.0


def test_slow_filters_of_fast_recordings_warn_of_nothing() -> None:
    """Their coefficients are tiny: nothing but their poles is asked for."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = reach(butterworth(8, 4.0, 1000.0), 0.01)
    assert 0.3 * 250 < found < 4 * 250
