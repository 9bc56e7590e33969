"""Estimates by bands of frequencies: what they find where it is known, level and coverage, and what is left out."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.fft import idct

from jaximp.trust.frequencies import BANDS, ByFrequency, estimate_by_frequency

Numbers = NDArray[np.float64]

WINDOW, WINDOWS, RATE = 80, 20, 40.0
PARAMETERS = {0: ("inertia", "kg m^2"), 1: ("stiffness", "N m/rad")}
THETA = np.array([2.0, -5.0, 0.5])


def found(W: Numbers, y: Numbers, valid: Numbers | None = None, every: int = 1, window: int = WINDOW) -> ByFrequency:
    counts = np.ones(len(y), bool) if valid is None else valid.astype(bool)
    estimates = estimate_by_frequency((W, y), (W, y), counts, window, every, RATE, PARAMETERS, 0.2)
    assert estimates is not None
    return estimates


def of_cosines(columns: Numbers) -> Numbers:
    """Rows of windows (K, F, ...) given by their cosines."""
    return idct(columns, axis=1, norm="ortho").reshape(-1, *columns.shape[2:])


def test_parameters_of_each_band_are_found() -> None:
    """Windows that move alike at all frequencies, with other parameters in each quarter of them."""
    random = np.random.default_rng(1)
    columns = np.tile(random.choice([-1.0, 1.0], (1, WINDOW, 2)), (WINDOWS, 1, 1))
    truth = np.repeat(THETA[:2] * np.array([[1.0, 1.0], [1.0, 1.2], [1.0, 1.4], [1.0, 0.9]]), WINDOW // BANDS, axis=0)
    y = (columns * truth).sum(axis=2) + 1e-6 * random.normal(size=(WINDOWS, WINDOW))
    bands = found(of_cosines(columns), of_cosines(y))
    np.testing.assert_allclose(bands.value, truth[:: WINDOW // BANDS], atol=1e-5)
    np.testing.assert_allclose(bands.edges[1:-1], RATE / 2 * np.array([0.25, 0.5, 0.75]), atol=RATE / WINDOW)
    assert bands.depends(1)
    assert not bands.depends(0)


def test_lines_are_the_means_over_windows() -> None:
    random = np.random.default_rng(2)
    W = random.normal(size=(WINDOWS * WINDOW, 3))
    y = W @ THETA + random.normal(size=len(W))
    filtered = W + 0.1 * random.normal(size=W.shape)
    valid = np.ones(len(y), bool)
    bands = estimate_by_frequency((W, y), (filtered, y), valid, WINDOW, 1, RATE, PARAMETERS, 0.2)
    assert bands is not None

    def mean(x: Numbers) -> Numbers:
        parts = zip(np.split(x, WINDOWS), np.split(y, WINDOWS), strict=True)
        return np.mean([np.linalg.lstsq(*part)[0] for part in parts], axis=0)[:2]

    np.testing.assert_allclose(bands.generalised, mean(W), rtol=1e-10)
    np.testing.assert_allclose(bands.ordinary, mean(filtered), rtol=1e-10)


@pytest.mark.slow
@pytest.mark.compiles
@pytest.mark.parametrize(
    ("every", "changes", "uneven"),
    [(1, 0.0, False), (1, 0.5, False), (2, 0.0, False), (1, 0.0, True)],
    ids=["plain", "parameters that change", "rows that repeat", "windows that differ, and gaps"],
)
def test_level_and_coverage_of_constant_parameters(every: int, changes: float, uneven: bool) -> None:
    """A change from window to window is no dependence on the frequency, and makes no interval longer."""
    random, records = np.random.default_rng(3), 100
    p, held, lengths = [], [], []
    for _ in range(records):
        W = random.normal(size=(WINDOWS, WINDOW, 3))
        W[..., 2] = 1.0
        valid = np.ones((WINDOWS, WINDOW))
        if uneven:
            W *= random.lognormal(0, 0.4, (WINDOWS, 1, 1))
            valid[::3, 10:15] = 0
        theta = THETA * (1 + changes * random.normal(size=(WINDOWS, 1, 1)))
        y = (W * theta).sum(axis=2) + random.normal(size=(WINDOWS, WINDOW))
        rows, torque, counts = (np.repeat(x.reshape(-1, *x.shape[2:]), every, axis=0) for x in (W, y, valid))
        bands = found(rows, torque, counts, every, WINDOW * every)
        low, high = bands.interval(0.8)
        p.append(bands.p)
        held.append((low < theta.mean(axis=0)[:, :2].mean(axis=0)) & (theta[..., :2].mean(axis=(0, 1)) < high))
        lengths.append((high - low).mean(axis=0))
    for level in (0.05, 0.5):
        below = (np.array(p) < level).mean(axis=0)
        assert np.abs(below - level).max() < 3.5 * np.sqrt(level * (1 - level) / records), (level, below)
    assert np.mean(held) == pytest.approx(0.8, abs=0.045)
    usual = np.sqrt(BANDS / (WINDOWS * WINDOW)) * 2 * 1.33
    if not uneven:
        np.testing.assert_allclose(np.mean(lengths, axis=0), usual, rtol=0.15)


def test_what_a_band_does_not_determine_is_left_out() -> None:
    """The second column moves slowly, beside a first that moves at all frequencies."""
    random = np.random.default_rng(4)
    columns = random.normal(size=(WINDOWS, WINDOW, 2))
    columns[:, WINDOW // 4 :, 1] *= 1e-4
    y = (columns * THETA[:2]).sum(axis=2) + random.normal(size=(WINDOWS, WINDOW))
    bands = found(of_cosines(columns), of_cosines(y))
    assert np.isfinite(bands.value[:, 0]).all()
    assert np.isfinite(bands.value[0, 1])
    assert np.isnan(bands.value[-1, 1])
    columns[..., 1] = 0
    columns[:, :10, 1] = random.normal(size=(WINDOWS, 10))
    y = (columns * THETA[:2]).sum(axis=2) + random.normal(size=(WINDOWS, WINDOW))
    nothing = found(of_cosines(columns), of_cosines(y))
    assert np.isnan(nothing.value[-1, 1])
    assert np.isnan(nothing.p[1]) or np.isfinite(nothing.value[:, 1]).sum() >= 2


def test_few_windows_are_cut_and_too_few_rows_give_nothing() -> None:
    random = np.random.default_rng(5)
    W = random.normal(size=(4 * WINDOW, 3))
    y = W @ THETA + 0.1 * random.normal(size=len(W))
    assert found(W, y).dof == 7
    every_row = np.ones(len(y), bool)
    assert estimate_by_frequency((W, y), (W, y), every_row & False, WINDOW, 1, RATE, PARAMETERS, 0.2) is None
    assert (
        estimate_by_frequency((W[:12], y[:12]), (W[:12], y[:12]), every_row[:12], 12, 1, RATE, PARAMETERS, 0.2) is None
    )


def test_one_frequency_has_no_bands() -> None:
    columns = np.zeros((WINDOWS, WINDOW, 1))
    columns[:, 12] = 10.0
    W = of_cosines(columns)
    y = 2 * W[:, 0] + np.random.default_rng(6).normal(size=len(W))
    valid = np.ones(len(y), bool)
    assert estimate_by_frequency((W, y), (W, y), valid, WINDOW, 1, RATE, {0: ("damping", "")}, 0.2) is None
