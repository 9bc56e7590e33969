"""Windows side by side: against least squares one by one, with rows that do not count and windows that say nothing."""

from __future__ import annotations

import numpy as np

from jaximp.least_squares.disjoint import fit_disjoint

WINDOW = 50


def test_windows_are_those_of_least_squares_one_by_one() -> None:
    random = np.random.default_rng(1)
    W, valid = random.normal(size=(5 * WINDOW + 7, 3)) * [100.0, 1.0, 0.01], random.random(5 * WINDOW + 7) > 0.1
    W[:, 2] += 1e-3 * W[:, 0]
    y = W @ [1.0, 2.0, 3.0] + random.normal(size=len(W))
    W[~valid], y[~valid] = 0, 0
    fit = fit_disjoint(W, y, valid, WINDOW)
    assert fit.sound.tolist() == [True] * 5
    orthonormal = fit.orthonormal(W)
    for k in range(5):
        part = slice(k * WINDOW, (k + 1) * WINDOW)
        theta = np.linalg.lstsq(W[part], y[part])[0]
        np.testing.assert_allclose(fit.residual[k], y[part] - W[part] @ theta, atol=1e-11)
        np.testing.assert_allclose(fit.inverse[k] @ fit.inverse[k].T, np.linalg.inv(W[part].T @ W[part]), rtol=1e-8)
        np.testing.assert_allclose(orthonormal[k].T @ orthonormal[k], np.eye(3), atol=1e-10)
        assert fit.rows[k] == valid[part].sum()
    np.testing.assert_allclose(fit.rss, (fit.residual**2).sum(axis=1))
    assert not fit.residual.ravel()[~valid[: 5 * WINDOW]].any()
    np.testing.assert_array_equal(fit.orthonormal(W, slice(2, 4)), orthonormal[2:4])


def test_windows_that_say_nothing_are_not_sound() -> None:
    random = np.random.default_rng(2)
    W, valid = random.normal(size=(4 * WINDOW, 2)), np.ones(4 * WINDOW, bool)
    y = random.normal(size=len(W))
    W[:WINDOW, 1] = 2 * W[:WINDOW, 0]  # dependent
    valid[WINDOW + 1 : 2 * WINDOW] = False  # too few rows
    y[2 * WINDOW : 3 * WINDOW] = 0  # no torque
    W[~valid], y[~valid] = 0, 0
    assert fit_disjoint(W, y, valid, WINDOW).sound.tolist() == [False, False, False, True]
    assert fit_disjoint(W[:20], y[:20], valid[:20], WINDOW).sound.tolist() == []
