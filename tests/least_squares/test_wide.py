"""Windows of many columns, from sums that they share, are those that are decomposed one by one."""

from __future__ import annotations

from dataclasses import fields

import jax
import numpy as np
import pytest

from jaximp.least_squares import sliding, wide
from jaximp.least_squares.window import SlidingFit

P, ROWS, WINDOW = 10, 900, 120


def rows(seed: int, outputs: int) -> tuple[np.ndarray, np.ndarray]:
    """Neighbouring lags of one signal, as a reflex has them; a torque that is far from zero."""
    random = np.random.default_rng(seed)
    signal = np.convolve(random.normal(size=ROWS + P), np.ones(4), "same")
    W = np.stack([signal[k : k + ROWS] for k in range(P)], axis=-1)
    if outputs:
        W = W[:, None] * random.normal(size=(outputs, P)) + 0.1 * random.normal(size=(ROWS, outputs, P))
    return W, W @ random.normal(size=P) + random.normal(size=W.shape[:-1]) + 3


def one_by_one(monkeypatch: pytest.MonkeyPatch, *given: object, **settings: object) -> SlidingFit:
    with monkeypatch.context() as patch:
        patch.setattr(wide, "FEWEST_COLUMNS", P + 1)
        return sliding.sliding_least_squares(*given, **settings)  # type: ignore[arg-type]


def assert_same(found: SlidingFit, expected: SlidingFit, tolerance: float = 1e-11) -> None:
    for name in (field.name for field in fields(SlidingFit)):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), tolerance, 1e-12, err_msg=name)


@pytest.mark.parametrize(("outputs", "step", "weighted"), [(0, 20, False), (0, 7, True), (2, 50, True)])
def test_they_are_those_of_a_decomposition(
    monkeypatch: pytest.MonkeyPatch, outputs: int, step: int, weighted: bool
) -> None:
    W, y = rows(1, outputs)
    random = np.random.default_rng(2)
    settings = {"valid": random.random(y.shape) > 0.2} | ({"weights": random.random(y.shape)} if weighted else {})
    found = sliding.sliding_least_squares(W, y, WINDOW, step, **settings)
    assert_same(found, one_by_one(monkeypatch, W, y, WINDOW, step, **settings))


def test_a_drop_of_the_amplitude_costs_no_digits(monkeypatch: pytest.MonkeyPatch) -> None:
    W, y = rows(3, 0)
    W[ROWS // 2 :] *= 1e-5
    y = W @ np.arange(1.0, P + 1)
    found = sliding.sliding_least_squares(W, y, WINDOW, 30)
    np.testing.assert_allclose(found.theta, np.broadcast_to(np.arange(1.0, P + 1), found.theta.shape), 1e-8)
    np.testing.assert_allclose(found.cond, one_by_one(monkeypatch, W, y, WINDOW, 30).cond, 1e-8)


def test_windows_at_rest_have_no_estimate_and_windows_of_another_kind_are_decomposed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    W, y = rows(4, 0)
    W[200:450] = 0
    W[500:, 1] = W[500:, 0] + 1e-6 * W[500:, 1]  # two columns that are told apart in the first half alone
    _, doubtful = wide.solve_wide(W[:, None], y[:, None], np.ones((ROWS, 1)), WINDOW, np.arange(0, 781, 30))
    assert doubtful[-1]
    whole = sliding.sliding_least_squares(W, y, WINDOW, 30)
    assert np.isnan(np.asarray(whole.theta)[8:10]).all()
    assert_same(whole, one_by_one(monkeypatch, W, y, WINDOW, 30), 1e-8)  # the condition number is 1e7 at the end


def test_long_recordings_and_compiled_programs_go_elsewhere() -> None:
    assert wide.pays(1000, P, 1)
    assert not wide.pays(1_000_000, P, 1)
    assert not wide.pays(1000, P - 2, 1)
    W, y = rows(5, 0)
    plain = sliding.sliding_least_squares(W, y, WINDOW, 30)
    traced = jax.jit(lambda W, y: sliding.sliding_least_squares(W, y, WINDOW, 30))(W, y)
    np.testing.assert_allclose(traced.theta, plain.theta, 1e-10)
