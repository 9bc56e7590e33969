"""The filter that differentiates: against scipy, polynomials, and what white noise becomes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import savgol_filter

from jaximp.signals import savitzky_golay, savitzky_golay_gain, savitzky_golay_half_length


def test_length_of_the_filter_follows_from_its_cutoff() -> None:
    """50 Hz at 4 kHz are 203 samples, and there the velocity is down by 3 dB."""
    half = savitzky_golay_half_length(4000.0, 50.0, 7)
    assert half == 101
    t = np.arange(8000) / 4000
    passed = savitzky_golay(np.sin(2 * np.pi * 50 * t), 4000.0, 1)[half:-half].std() * np.sqrt(2) / (2 * np.pi * 50)
    assert 20 * np.log10(passed) == pytest.approx(-3, abs=0.1)


@pytest.mark.parametrize("derivative", [0, 1, 2, 3])
def test_filter_is_that_of_scipy_where_scipy_is_sound(derivative: int) -> None:
    x = np.random.default_rng(0).normal(size=(200, 2))
    half = savitzky_golay_half_length(500.0, 50.0, 5)
    expected = savgol_filter(x, 2 * half + 1, 5, deriv=derivative, delta=1 / 500, axis=0)
    np.testing.assert_allclose(
        savitzky_golay(x, 500.0, derivative, order=5), expected, atol=1e-8 * np.abs(expected).max()
    )


@pytest.mark.parametrize("derivative", [0, 1, 2, 3])
def test_polynomials_are_differentiated_exactly_also_at_the_ends(derivative: int) -> None:
    """With 203 samples, for which scipy's powers of the index are too many digits apart."""
    t = np.arange(1000) / 4000
    polynomial = np.polynomial.Polynomial([1.0, -2, 30, 4, -500, 60, 7, -800])
    found = savitzky_golay(polynomial(t), 4000.0, derivative)
    expected = polynomial.deriv(derivative)(t) if derivative else polynomial(t)
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


def test_gain_is_what_white_noise_becomes() -> None:
    noise = np.random.default_rng(0).normal(size=400_000)
    for derivative in (0, 3):
        found = savitzky_golay(noise, 4000.0, derivative)[200:-200].std()
        assert found == pytest.approx(savitzky_golay_gain(4000.0, derivative), rel=0.05)


def test_filters_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="between 0 and 2000"):
        savitzky_golay_half_length(4000.0, 2500.0)
    with pytest.raises(ValueError, match="lower one of them"):
        savitzky_golay_half_length(4000.0, 1900.0, order=15)
    with pytest.raises(ValueError, match="too few"):
        savitzky_golay(np.zeros(100), 4000.0)
