"""Windows that share their sums are as good as windows that are decomposed one by one."""

from __future__ import annotations

from dataclasses import fields
from fractions import Fraction
from itertools import pairwise
from operator import itemgetter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import toeplitz

from jaximp.least_squares import sliding as windows
from jaximp.least_squares.chunks import lags_for_sums
from jaximp.least_squares.sliding import adaptive_least_squares, sliding_least_squares, sliding_pieces, sliding_theta
from jaximp.least_squares.window import SlidingFit, confidence_interval

pytestmark = pytest.mark.compiles

Numbers = NDArray[np.float64]


@pytest.fixture(autouse=True)
def shared_sums(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also for few windows, where one would not take them."""
    monkeypatch.setattr(windows, "FROM_CHUNKS", 0)


def one_by_one(*arguments: object, **settings: object) -> SlidingFit:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(windows, "FROM_CHUNKS", 10**18)
        return sliding_least_squares(*arguments, **settings)  # type: ignore[arg-type]


def recording(n: int, p: int = 3, outputs: tuple[int, ...] = (), seed: int = 0) -> tuple[Numbers, Numbers]:
    random = np.random.default_rng(seed)
    W = random.normal(size=(n, *outputs, p)) @ random.normal(size=(p, p)) * np.geomspace(30, 0.3, p)
    return W, W @ np.arange(1.0, p + 1) + 0.1 * random.normal(size=(n, *outputs))


def assert_same(fit: SlidingFit, expected: SlidingFit, torque: Numbers, rtol: float = 1e-9) -> None:
    for name in (field.name for field in fields(SlidingFit)):
        reference = np.asarray(getattr(expected, name), float)
        atol = 1e-12 * np.nanmax(np.abs(reference), initial=0.0)
        if name == "residual_rms":  # a square root: where nothing is left, half of the digits are
            atol = 1e-8 * float(np.sqrt(np.mean(torque**2)))
        np.testing.assert_allclose(getattr(fit, name), reference, rtol, atol, err_msg=name)


@pytest.mark.parametrize(
    ("n", "window", "step", "p", "outputs"),
    [
        pytest.param(1500, 100, 1, 3, (), id="every window"),
        pytest.param(1500, 97, 1, 4, (), id="of a prime length", marks=pytest.mark.slow),
        pytest.param(1200, 3, 1, 3, (), id="as short as can be"),
        pytest.param(900, 64, 5, 3, (), id="some rows apart"),
        pytest.param(4000, 300, 47, 2, (), id="many rows apart", marks=pytest.mark.slow),
        pytest.param(900, 20, 31, 3, (), id="with gaps between them", marks=pytest.mark.slow),
        pytest.param(700, 700, 3, 3, (), id="the whole recording"),
        pytest.param(600, 50, 1, 1, (), id="one column", marks=pytest.mark.slow),
        pytest.param(500, 40, 1, 3, (2,), id="two outputs", marks=pytest.mark.slow),
        pytest.param(500, 41, 7, 3, (3,), id="three outputs, some samples apart"),
    ],
)
def test_windows_are_those_of_the_qr_decomposition(
    n: int, window: int, step: int, p: int, outputs: tuple[int, ...]
) -> None:
    W, y = recording(n, p, outputs)
    valid = np.random.default_rng(3).random(y.shape) < 0.9
    for mask in (None, valid)[: 1 + (window > 10)]:
        expected = one_by_one(W, y, window, step, valid=mask)
        fit = sliding_least_squares(W, y, window, step, valid=mask)
        assert_same(fit, expected, y)
        np.testing.assert_allclose(sliding_theta(W, y, window, step, valid=mask), expected.theta, 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "window", "step", "p", "outputs", "lags"),
    [
        pytest.param(900, 60, 1, 3, (), 13, id="every window"),
        pytest.param(700, 41, 1, 2, (), 21, id="as long as they may be"),
        pytest.param(2000, 80, 33, 3, (), 13, id="some rows apart"),
        pytest.param(500, 60, 1, 2, (2,), 9, id="two outputs"),
    ],
)
def test_coloured_noise(n: int, window: int, step: int, p: int, outputs: tuple[int, ...], lags: int) -> None:
    W, y = recording(n, p, outputs)
    valid = np.random.default_rng(3).random(y.shape) < 0.9
    noise = 0.8 ** np.arange(lags) * np.cos(0.5 * np.arange(lags))
    assert lags_for_sums(noise, window * y[0].size, y[0].size) == lags
    for mask in (None, valid):
        fit = sliding_least_squares(W, y, window, step, valid=mask, noise=noise)
        assert_same(fit, one_by_one(W, y, window, step, valid=mask, noise=noise), y)


@pytest.mark.slow
@pytest.mark.parametrize("outputs", [(), (2,)], ids=["one output", "two outputs"])
@pytest.mark.parametrize("noise", [None, 0.7 ** np.arange(9)], ids=["white", "coloured"])
def test_weights(outputs: tuple[int, ...], noise: Numbers | None) -> None:
    W, y = recording(600, 2, outputs)
    random = np.random.default_rng(4)
    weights = np.where(random.random(y.shape) < 0.8, random.exponential(size=y.shape), 0.0)
    valid = random.random(y.shape) < 0.9
    W[~valid] = np.nan
    fit = sliding_least_squares(W, y, 50, valid=valid, weights=weights, noise=noise)
    assert_same(fit, one_by_one(W, y, 50, valid=valid, weights=weights, noise=noise), y)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [None, 0.8 ** np.arange(9)], ids=["white", "coloured"])
@pytest.mark.parametrize("outputs", [(), (2,)], ids=["one output", "two outputs"])
def test_the_shortest_window_that_is_sure_enough(outputs: tuple[int, ...], noise: Numbers | None) -> None:
    W, y = recording(1500, 2, outputs)
    W[600:900] *= 0.1  # poor motion
    y = W @ np.array([1.0, 2.0]) + 0.1 * np.random.default_rng(1).normal(size=y.shape)
    wanted = np.array([np.inf, np.median(one_by_one(W, y, 80, noise=noise, room=300).stderr[:, 1])])
    fit = adaptive_least_squares(W, y, wanted, 40, 300, step=10, noise=noise)
    length = np.asarray(fit.last - fit.first) + 1
    assert (fit.last == np.arange(39, 1500, 10)).all()
    complete = np.asarray(fit.first) > 0  # what reaches back to the beginning is cut off there
    lengths = np.unique(length[complete])
    assert len(lengths) > 5
    assert lengths[-1] == 300
    # What each window is, and that the next shorter length is not enough.
    found = {n: one_by_one(W, y, int(n), noise=noise, room=300) for n in lengths}
    level = noise_around(W, y, noise, 40, 300)

    def enough(n: int, start: int) -> bool:
        expected = np.sqrt(level[(start + n - 1) // 40]) * unit_stderr(W[start : start + n], noise)[1]
        surprise = np.sqrt(1 + 3 * np.sqrt(2 / found[n].dof[start]))
        return bool(expected <= wanted[1] and found[n].stderr[start, 1] <= surprise * wanted[1])

    for m in np.flatnonzero(complete):
        n, start = int(length[m]), int(fit.first[m])
        if np.isnan(fit.theta[m]).any():
            assert n == 300
            assert not enough(n, start)
            continue
        assert_same(jax.tree.map(itemgetter(m), fit), jax.tree.map(itemgetter(start), found[n]), y)
        assert enough(n, start)
        for shorter in lengths[lengths < n][-1:]:
            assert not enough(int(shorter), start + n - int(shorter))


def covariance_of_rows(noise: Numbers | None, samples: int, outputs: int) -> Numbers:
    lags = np.pad([1.0] if noise is None else noise, (0, samples))[:samples]
    return np.kron(toeplitz(lags), np.eye(outputs))


def unit_stderr(W: Numbers, noise: Numbers | None) -> Numbers:
    """Of the estimates of a window, for noise of just this autocovariance."""
    C = covariance_of_rows(noise, len(W), W[0].size // W.shape[-1])
    A = np.linalg.pinv(W.reshape(len(C), -1))
    return np.sqrt(np.diag(A @ C @ A.T))


def noise_around(W: Numbers, y: Numbers, noise: Numbers | None, piece: int, around: int) -> Numbers:
    """Of every piece, the noise's variance from the residuals of the pieces around it."""
    squares, expected = [], []
    for start in range(0, len(W) - piece + 1, piece):
        rows, torque = W[start : start + piece].reshape(-1, W.shape[-1]), y[start : start + piece].ravel()
        M = np.eye(len(rows)) - rows @ np.linalg.pinv(rows)
        squares.append(((M @ torque) ** 2).sum())
        expected.append(np.trace(M @ covariance_of_rows(noise, piece, len(rows) // piece)))
    near, level = -(-around // piece), []
    for k in range(len(squares)):
        some = slice(max(k - near, 0), k + near + 1)
        each, of = np.array(squares[some]), np.array(expected[some])
        usual = each / of <= 4 * np.median(each / of)
        level.append(each[usual].sum() / of[usual].sum())
    return np.array([*level, level[-1]])


def test_the_shortest_windows_are_as_sure_as_they_say() -> None:
    """Were a window's own residuals asked, intervals of the shortest tenth would hold the truth in 84 %."""
    random, n, truth = np.random.default_rng(5), 60_000, np.array([1.0, 2.0])
    W = random.normal(size=(n, 2))
    fit = adaptive_least_squares(W, W @ truth + random.normal(size=n), np.full(2, 0.3), 8, 80, step=2)
    found = jax.tree.map(lambda x: np.asarray(x)[40::10], fit)
    assert np.isfinite(found.dof).all()
    length = found.last - found.first
    shortest = np.argsort(length, kind="stable")[: len(length) // 10]
    low, high = confidence_interval(found)
    held = (low <= truth) & (truth <= high)
    assert 0.91 < held[shortest].mean() < 0.98  # 600 intervals: four standard deviations below
    assert 0.94 < held.mean() < 0.96


def test_no_window_reaches_far_across_a_change() -> None:
    random, n = np.random.default_rng(6), 3000
    W, after = random.normal(size=(n, 2)), np.arange(n) >= 1500
    y = W[:, 0] + np.where(after, 16.0, 1.0) * W[:, 1] + random.normal(size=n)
    fit = adaptive_least_squares(W, y, np.full(2, 0.3), 8, 80, step=2)
    share = (fit.last - 1499) / (fit.last - fit.first + 1)
    far = (share > 0.25) & (share < 0.75) & np.isfinite(fit.dof)
    assert not far.any()
    assert np.isfinite(fit.theta[(fit.last >= 1530) & (fit.last < 1540)]).all()


@pytest.mark.slow
def test_shortest_windows_under_jit_and_where_the_motion_changes_in_kind() -> None:
    W, y = recording(1200, 2)
    W[500:] = 1e-4 * W[500:] @ np.array([[1.0, 0.5], [-0.2, 1.0]])
    y = W @ np.array([1.0, 2.0]) + 1e-5 * np.random.default_rng(1).normal(size=1200)
    fit = adaptive_least_squares(W, y, np.array([0.1, 0.1]), 40, 100, cond=1e4)
    assert np.isfinite(fit.theta).all()
    inside = jax.jit(lambda W, y: adaptive_least_squares(W, y, np.array([0.1, 0.1]), 40, 100, cond=1e4))(W, y)
    assert_same(inside, fit, y)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        pytest.param({"stderr": np.ones(3)}, "stderr has shape", id="shape"),
        pytest.param({"stderr": np.zeros(2)}, "above zero", id="zero"),
        pytest.param({"longest": 10}, "lengthen the longest", id="lengths"),
        pytest.param({"shortest": 2000}, "there are only 300", id="too long"),
        pytest.param({"noise": 0.99 ** np.arange(200)}, "decimate the rows", id="noise"),
    ],
)
def test_errors_of_adaptive_windows(settings: dict[str, object], message: str) -> None:
    W, y = recording(300, 2)
    given = {"stderr": np.ones(2), "shortest": 20, "longest": 2000} | settings
    with pytest.raises(ValueError, match=message):
        adaptive_least_squares(W, y, **given)  # type: ignore[arg-type]


@pytest.mark.parametrize("coloured", [False, True], ids=["white", "coloured"])
def test_piece_by_piece_is_the_same_to_the_last_bit(coloured: bool) -> None:
    W, y = recording(20_000)
    noise = 0.5 ** np.arange(4) if coloured else None
    whole = sliding_least_squares(W, y, 60, noise=noise)
    borders = [0, 7, 8, 5000, 17_000, 20_000]
    pieces = ((W[a:b], y[a:b]) for a, b in pairwise(borders))
    parts = list(sliding_pieces(pieces, 60, noise=noise))
    assert len(parts) > 1
    for name in (field.name for field in fields(SlidingFit)):
        np.testing.assert_array_equal(np.concatenate([getattr(part, name) for part in parts]), getattr(whole, name))


@pytest.mark.parametrize("pieces", [[], [(np.ones((30, 2)), np.ones(30))]], ids=["none", "too few"])
def test_too_little_in_pieces(pieces: list[tuple[Numbers, Numbers]]) -> None:
    with pytest.raises(ValueError, match=r"no samples|has 60 samples, but there are fewer"):
        list(sliding_pieces(pieces, 60))


def test_a_stretch_that_determines_nothing_harms_no_other_window() -> None:
    W, y = recording(3000)
    W[500:900, 2] = 2 * W[500:900, 0] - W[500:900, 1]
    W[1500:2500, 1] = 0
    fit, start = sliding_least_squares(W, y, 100), np.arange(2901)
    inside = ((start >= 500) & (start <= 800)) | ((start >= 1500) & (start <= 2400))
    np.testing.assert_array_equal(np.isnan(fit.theta).all(axis=1), inside)
    assert_same(fit, one_by_one(W, y, 100), y)


@pytest.mark.slow
def test_inside_jit_vmap_and_grad() -> None:
    W, y = (np.stack(x) for x in zip(recording(500, seed=1), recording(500, seed=2), strict=True))
    W[0, 250:] *= 1e-6  # some windows here need a QR decomposition
    y[0, 250:] *= 1e-6
    both = jax.jit(jax.vmap(lambda W, y: sliding_least_squares(W, y, 40, 3)))(W, y)
    for k in range(2):
        assert_same(jax.tree.map(itemgetter(k), both), one_by_one(W[k], y[k], 40, 3), y[k], rtol=1e-8)
    direction = np.random.default_rng(8).normal(size=W.shape[1:])

    def loss(amount: float) -> jax.Array:
        return (sliding_theta(W[1] + amount * direction, jnp.asarray(y[1]), 40, 3) ** 2).sum()

    slope = jax.jit(jax.grad(loss))(0.0)
    assert float(slope) == pytest.approx((float(loss(1e-6)) - float(loss(-1e-6))) / 2e-6, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("traced", [False, True])
def test_single_precision_stays_and_costs_no_more_than_its_rounding(traced: bool) -> None:
    """At condition 1000: the sums over 2000 rows lose next to nothing."""
    random = np.random.default_rng(5)
    U, _, V = np.linalg.svd(random.normal(size=(8, 8)))
    W = (random.normal(size=(6000, 8)) @ (U * np.geomspace(1, 1e-3, 8) @ V)).astype(np.float32)
    y = (W @ np.arange(1.0, 9.0) + 0.1 * random.normal(size=6000)).astype(np.float32)
    solve = jax.jit(sliding_least_squares, static_argnums=(2, 3)) if traced else sliding_least_squares
    fit, exact = solve(W, y, 2000, 9), sliding_least_squares(W.astype(float), y.astype(float), 2000, 9)
    for name in ("theta", "stderr", "cond", "sigma_min", "excitation", "residual_rms", "vaf"):
        found, expected = np.asarray(getattr(fit, name)), np.asarray(getattr(exact, name))
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max(), rtol=0, err_msg=name)


def exact_solution(W: Numbers, y: Numbers) -> Numbers:
    """Least squares in whole numbers: without any rounding."""
    p = W.shape[1]
    rows = [[Fraction(float(x)) for x in row] for row in np.c_[W, y]]
    gram = [[sum(row[i] * row[j] for row in rows) for j in range(p + 1)] for i in range(p)]
    for i in range(p):
        for j in range(p):
            if j != i:
                factor = gram[j][i] / gram[i][i]
                gram[j] = [a - factor * b for a, b in zip(gram[j], gram[i], strict=True)]
    return np.array([float(row[p] / row[i]) for i, row in enumerate(gram)])


@pytest.mark.parametrize("case", ["1", "1e3", "1e5", "1e7", "units", "drop"])
def test_as_accurate_as_the_qr_decomposition(case: str) -> None:
    """Against the exact solution: LAPACK's QR and SVD begin with the same reduction, and share its rounding."""
    random = np.random.default_rng(11)
    U, _, V = np.linalg.svd(random.normal(size=(4, 4)))
    collinear = 1.0 if case in ("units", "drop") else float(case)
    W = random.normal(size=(3000, 4)) @ (U * np.geomspace(1, 1 / collinear, 4) @ V)
    W *= np.geomspace(1, 1e-7, 4) if case == "units" else 1
    W[1000:] *= 1e-6 if case == "drop" else 1
    y = W @ np.arange(1.0, 5.0)
    y += 0.1 * y.std() * random.normal(size=3000) * (np.abs(W).max(axis=1) if case == "drop" else 1)
    theta = sliding_theta(W, y, 150)
    ours, theirs = [], []
    for start in random.choice(2851, 12, replace=False):
        rows = slice(start, start + 150)
        exact = exact_solution(W[rows], y[rows])
        Q, R = np.linalg.qr(W[rows])
        for errors, found in ((ours, theta[start]), (theirs, np.linalg.solve(R, Q.T @ y[rows]))):
            errors.append(np.linalg.norm(found - exact) / np.linalg.norm(exact))
    assert max(ours) < 10 * max(theirs)
