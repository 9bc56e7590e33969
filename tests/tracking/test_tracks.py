"""Parameters that move: what `track` finds, against plain least squares, known paths, and what must not matter."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from jaximp import recursive_least_squares, sliding_least_squares
from jaximp.least_squares.autoregression import Autoregression
from jaximp.least_squares.noise import Noise
from jaximp.tracking import Path, Track, smoothed_path, smoothed_paths, track
from jaximp.tracking.state_space import PRIOR

Numbers = NDArray[np.float64]

N, P, GRID = 600, 2, 3
"""All tests share these shapes, which are what is compiled for."""
NOISE = 0.3


def path(kind: str) -> Numbers:
    """(N, p) true parameters; the second one stays."""
    t = np.arange(N) / N
    moving = {
        "stays": np.full(N, 2.0),
        "sine": 2 + np.sin(4 * np.pi * t),
        "step": np.where(t < 0.5, 1.0, 3.0),
    }
    return np.column_stack([moving[kind], np.full(N, -1.0)])


def record(kind: str, seed: int = 0) -> tuple[Numbers, Numbers]:
    random = np.random.default_rng(seed)
    W = random.normal(size=(N, P))
    return W, (W * path(kind)).sum(axis=1) + NOISE * random.normal(size=N)


def points(x: Numbers) -> Numbers:
    """What the rows of each point of the grid have in the mean."""
    return x.reshape(N // GRID, GRID, -1).mean(axis=1)


def followed(W: Any, y: Any, **settings: Any) -> Track:
    return track(W, y, grid=GRID, **settings)


# ---- Known drift sizes.


@jax.jit
def known_path(W: Any, y: Any, drift: Any) -> tuple[Path, jax.Array]:
    return smoothed_path(W, y, grid=GRID, drift=drift, noise=NOISE)


def path_by_hand(W: Numbers, y: Numbers, drift: Numbers) -> tuple[Numbers, float]:
    """The mean of all paths given the torque, and the logarithm of its density, from the joint distribution."""
    unit = np.linalg.norm(y) / np.linalg.norm(W, axis=0)
    k = np.arange(N // GRID)
    path = np.einsum("i,kl->kli", drift**2, 1 + np.minimum(k[:, None], k)) + (PRIOR * unit) ** 2
    path = np.einsum("kli,ij->kilj", path, np.eye(P)).reshape(N // GRID * P, -1)
    H = np.zeros((N, N // GRID, P))
    H[np.arange(N), np.arange(N) // GRID] = W
    H = H.reshape(N, -1)
    torque = H @ path @ H.T + NOISE**2 * np.eye(N)
    mean = path @ H.T @ np.linalg.solve(torque, y)
    return mean.reshape(-1, P), float(multivariate_normal.logpdf(y, np.zeros(N), torque))


def test_path_and_likelihood_are_those_of_the_joint_distribution() -> None:
    W, y = record("sine")
    drift = np.array([0.05, 0.01])
    found, log_likelihood = known_path(W, y, drift)
    mean, wanted = path_by_hand(W, y, drift)
    np.testing.assert_allclose(found.theta, mean, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(log_likelihood, wanted, rtol=1e-7)


@pytest.mark.parametrize("order", [0, 2])
def test_derivatives_are_those_of_differences(order: int) -> None:
    W, y = record("sine")

    def log_likelihood(x: jax.Array) -> jax.Array:
        drift, noise = jnp.exp(x[:2]) * jnp.array([1.0, 0.0]), jnp.exp(x[2])
        return smoothed_path(W, y, grid=GRID, drift=drift, noise=noise, order=order)[1]

    at = jnp.log(jnp.array([0.0002 if order else 0.05, 0.01, 0.25]))
    both = jax.jit(jax.value_and_grad(log_likelihood))
    slope = both(at)[1]
    for i, unit in enumerate(1e-5 * np.eye(3)):
        np.testing.assert_allclose(slope[i], (both(at + unit)[0] - both(at - unit)[0]) / 2e-5, rtol=1e-5, atol=1e-5)
    assert slope[1] == 0


def test_lanes_are_a_loop() -> None:
    several = [record("sine", seed) for seed in range(3)]
    drift = np.array([0.05, 0.0])
    together = jax.vmap(known_path, (0, 0, None))(*(np.stack(x) for x in zip(*several, strict=True)), drift)
    side_by_side = smoothed_paths(*map(np.stack, zip(*several, strict=True)), grid=GRID, drift=drift, noise=NOISE)
    for a, b in zip(jax.tree.leaves(side_by_side), jax.tree.leaves(together), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-14)
    for k, (W, y) in enumerate(several):
        for a, b in zip(jax.tree.leaves(known_path(W, y, drift)), jax.tree.leaves(together), strict=True):
            np.testing.assert_allclose(a, b[k], rtol=1e-9)


def test_without_drift_the_filter_is_recursive_least_squares_and_the_smoother_that_of_all_rows() -> None:
    W, y = record("stays")
    found = followed(W, y, drift=np.zeros(P), order=0)
    plain = recursive_least_squares(W, y)
    last = slice(GRID - 1, None, GRID)
    np.testing.assert_allclose(found.filtered.theta[3:], np.asarray(plain.theta)[last][3:], rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(found.theta, np.tile(plain.theta[-1], (N // GRID, 1)), rtol=1e-5)
    np.testing.assert_allclose(found.stderr, np.tile(plain.stderr[-1], (N // GRID, 1)), rtol=1e-3)
    assert (np.asarray(found.drift.size) == 0).all()
    np.testing.assert_allclose(found.jumped, 0)


# ---- Drift sizes from the likelihood.


def test_what_stays_is_known_from_the_whole_record() -> None:
    W, y = record("stays")
    found, plain = followed(W, y), recursive_least_squares(W, y)
    assert (found.drift.moves < 0.5).all()
    np.testing.assert_allclose(found.stderr.mean(axis=0), plain.stderr[-1], rtol=0.3)
    np.testing.assert_allclose(found.noise, NOISE, rtol=0.1)
    np.testing.assert_allclose(np.mean(np.square(found.innovations)), 1, atol=0.1)


def test_a_step_stays_a_step() -> None:
    W, y = record("step")
    found = followed(W, y, names=("stiffness", "damping"), units=("N m/rad", "N m s/rad"))
    true, middle = points(path("step")), N // GRID // 2
    assert found.jumped[middle - 2 : middle + 3, 0].sum() > 0.8
    assert found.jumped[:, 1].sum() < 0.5
    value, apart = np.asarray(found["stiffness"].value), np.abs(np.arange(N // GRID) - middle) > 5
    assert np.abs(value - true[:, 0])[apart].max() < 0.25
    known = np.asarray(found.filtered.theta)[:, 0]
    assert (known[middle + 8 :] > 2.6).all()
    assert (known[5 : middle - 1] < 1.4).all()
    low, high = found["stiffness"].interval()
    assert ((low <= true[:, 0]) & (true[:, 0] <= high)).mean() > 0.9
    assert found["stiffness"].unit == "N m/rad"


@pytest.mark.parametrize(("kind", "near", "least"), [("sine", 200, 0.935), ("step", 12, 0.88)])
def test_bands_hold_what_moves_with_less_error_than_windows(kind: str, near: int, least: float) -> None:
    """Of windows the length with the least error, chosen knowing the truth; bands `near` points around the middle,
    where there is a step whose time is not known, and which windows do not know of."""
    true, middle = points(path(kind))[:, 0], N // GRID // 2
    around = np.abs(np.arange(N // GRID) - middle + 0.5) < near
    covered, errors = [], []
    windows: dict[int, list[tuple[float, float]]] = {length: [] for length in (12, 24, 36, 48)}
    for seed in range(6):
        W, y = record(kind, 100 + seed)
        found = followed(W, y)
        low, high = (end[:, 0] for end in found.interval(0.95))
        covered.append(((low <= true) & (true <= high))[around].mean())
        errors.append(np.mean((found.value[:, 0] - true) ** 2))
        for length, several in windows.items():
            fit = sliding_least_squares(W, y, length, GRID)
            first = length // 2
            error = np.asarray(fit.theta)[:, 0] - path(kind)[first::GRID, 0][: len(fit.theta)]
            inside = np.abs(error) < 1.96 * np.asarray(fit.stderr)[:, 0]
            there = np.abs((first + GRID * np.arange(len(error))) / GRID - middle) < near
            several.append((np.mean(error**2), inside[there].mean()))
    best = min(windows, key=lambda length: np.mean([square for square, _ in windows[length]]))
    assert np.mean(errors) < 0.8 * np.mean([square for square, _ in windows[best]])
    assert least < np.mean(covered) < 0.995
    if kind == "step":
        assert np.mean([inside for _, inside in windows[best]]) < 0.8


def test_kind_and_drift_are_found() -> None:
    sine, step = (followed(*record(kind)) for kind in ("sine", "step"))
    assert sine.smooth > 0.99 > 0.9 > step.smooth
    assert sine.drift.moves[0] > 0.99 > 0.5 > sine.drift.moves[1]
    assert sine.log_likelihood > followed(*record("sine"), order=0).log_likelihood
    size, spread = sine.drift.mean(order=2), sine.drift.stderr(order=2)
    assert 0.05 < spread[0] / size[0] < 0.5


# ---- What depends on what is measured.


def depending(seed: int) -> tuple[Numbers, Numbers, Numbers, Numbers]:
    """Rows, torque, what the first parameter depends on, and this parameter: it changes fivefold."""
    random = np.random.default_rng(seed)
    at = 0.3 * np.sin(6 * np.pi * np.arange(N) / N)
    theta = 3 + 2 * np.sin(5 * at)
    W = random.normal(size=(N, P))
    return W, W[:, 0] * theta - W[:, 1] + NOISE * random.normal(size=N), at, theta


@pytest.fixture(scope="module")
def with_curve() -> tuple[Track, Numbers]:
    W, y, at, theta = depending(0)
    return followed(W, y, varies_with={"stiffness": at}, names=("stiffness", "damping"), order=0), theta


def test_a_parameter_that_depends_on_position_is_found_as_a_curve(with_curve: tuple[Track, Numbers]) -> None:
    found, theta = with_curve
    (curve,) = found.curves
    low, high = curve.interval(0.999)
    true = 3 + 2 * np.sin(5 * np.asarray(curve.at))
    assert ((low < true) & (true < high)).all()
    assert true.max() > 4.9 > 1.1 > true.min()
    assert np.asarray(curve.stderr).max() < 0.3
    for path, most in ((found.path, 0.08), (found.filtered, 0.4)):
        error = np.asarray(path.theta)[20:, 0] - points(theta)[20:, 0]
        assert np.sqrt(np.mean(error**2)) < most
    low, high = found.path.interval()
    assert ((low[:, 0] < points(theta)[:, 0]) & (points(theta)[:, 0] < high[:, 0])).mean() > 0.9
    assert (found.drift.moves < 0.5).all()
    assert np.ptp(found.value[:, 1]) < np.asarray(found.stderr)[:, 1].mean()


def test_knowing_what_a_parameter_depends_on_pays_only_where_it_does(with_curve: tuple[Track, Numbers]) -> None:
    W, y, at, theta = depending(0)
    alone = followed(W, y, order=0)
    assert with_curve[0].log_likelihood > alone.log_likelihood + 5
    assert np.mean((alone.value[:, 0] - points(theta)[:, 0]) ** 2) > 2 * np.mean(
        (with_curve[0].value[:, 0] - points(theta)[:, 0]) ** 2
    )
    W, y = record("stays")
    free, plain = followed(W, y, varies_with={"theta_0": at}, order=0), followed(W, y, order=0)
    assert free.log_likelihood < plain.log_likelihood
    assert np.ptp(np.asarray(free.curves[0].theta)) < 0.1
    np.testing.assert_allclose(free.stderr.mean(axis=0), plain.stderr.mean(axis=0), rtol=0.5)


# ---- What must not matter, and where nothing is known.


@pytest.fixture(scope="module")
def with_gap() -> tuple[Numbers, Numbers, NDArray[np.bool_], Track]:
    W, y = record("sine")
    valid = np.ones(N, bool)
    valid[300:390] = False
    valid[::7] = False
    return W, y, valid, followed(W, y, valid=valid)


@pytest.mark.parametrize("hidden", [1e6, np.nan], ids=["huge", "NaN"])
def test_masked_rows_say_nothing(hidden: float, with_gap: tuple[Any, ...]) -> None:
    W, y, valid, wanted = with_gap
    found = followed(np.where(valid[:, None], W, hidden), np.where(valid, y, hidden), valid=valid)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_array_equal(a, b)


def test_bands_are_wide_where_nothing_is_measured(with_gap: tuple[Any, ...]) -> None:
    found = with_gap[-1]
    assert found.stderr[115, 0] > 2 * np.median(found.stderr[:90, 0])
    true = points(path("sine"))
    assert np.abs(found.value - true)[115, 0] < 3 * found.stderr[115, 0]


@pytest.mark.parametrize("kind", ["at rest", "collinear", "one column silent"])
def test_what_nothing_tells_gets_a_wide_band(kind: str) -> None:
    W, y = record("stays")
    if kind == "at rest":
        W[100:] = 0
    if kind == "collinear":
        W[:, 1] = 1e3 * W[:, 0]
    if kind == "one column silent":
        W[:, 1] = 0
    y = (W * path("stays")).sum(axis=1) + NOISE * np.random.default_rng(1).normal(size=N)
    found = followed(W, y)
    for one in (found.path, found.filtered):
        assert np.isfinite(one.theta).all()
        assert (np.linalg.eigvalsh(np.asarray(one.covariance)) > 0).all()
        assert (np.asarray(one.stderr) > 0).all()
    if kind != "at rest":
        assert (found.stderr[:, 1] > 10 * np.abs(found.value[:, 1])).all()


@pytest.mark.parametrize("kind", ["sine", "step"])
def test_units_do_not_matter(kind: str) -> None:
    W, y = record(kind)
    unit, newton = np.array([1e-4, 1e4]), 1e3
    one, other = followed(W, y), followed(W * unit, y * newton, sample_rate=None)
    np.testing.assert_allclose(other.value, one.value / unit * newton, rtol=1e-5)
    np.testing.assert_allclose(other.stderr, one.stderr / unit * newton, rtol=1e-5)
    np.testing.assert_allclose(other.drift.moves, one.drift.moves, atol=1e-6)


def test_seconds_and_given_drift_sizes() -> None:
    W, y = record("sine")
    rows = followed(W, y, drift=np.array([0.07, 0.0]), order=0, jumps=False)
    seconds = track(W, y, grid=0.03, sample_rate=100.0, drift=np.array([0.7, 0.0]), order=0, jumps=False)
    np.testing.assert_allclose(seconds.value, rows.value, rtol=1e-9)
    np.testing.assert_allclose(seconds.drift.size, np.tile([0.7, 0.0], (16, 1)), rtol=2e-3)
    np.testing.assert_allclose(seconds.time[:2], [0.01, 0.04])
    plain, _ = smoothed_path(W, y, grid=GRID, drift=np.array([0.07, 0.0]) * np.sqrt(GRID), noise=rows.noise)
    np.testing.assert_allclose(rows.value, plain.theta, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(rows.stderr, plain.stderr, rtol=1e-3)


def test_outputs_are_weighed_by_their_noise() -> None:
    """Half of the rows as a second output, which is a hundred times as noisy, says next to nothing."""
    random = np.random.default_rng(5)
    W, y = record("stays")
    worse = (W * path("stays")).sum(axis=1) + 100 * NOISE * random.normal(size=N)
    both = track(np.stack([W, W], axis=1), np.stack([y, worse], axis=1), grid=GRID)
    alone = followed(W, y)
    np.testing.assert_allclose(both.value.mean(axis=0), alone.value.mean(axis=0), atol=2e-3)
    np.testing.assert_allclose(both.stderr.mean(axis=0), alone.stderr.mean(axis=0), rtol=0.2)


def test_coloured_rows_are_made_white() -> None:
    """By an autoregression, or by what filters make of white noise: bands are then as wide as they must be."""
    from scipy.signal import lfilter

    random = np.random.default_rng(6)
    W = random.normal(size=(N, P))
    y = (W * path("stays")).sum(axis=1) + lfilter([1.0], [1.0, -0.9], NOISE * random.normal(size=N))
    found = followed(W, y, noise=[Autoregression(np.array([-0.9]))])
    assert (np.abs(found.value - points(path("stays"))) < 4 * found.stderr).all()
    assert found.stderr.mean() < 0.7 * followed(W, y).stderr.mean()
    lags = 0.9 ** np.arange(150)
    other = followed(W, y, noise=Noise(lags))
    np.testing.assert_allclose(other.value, found.value, atol=0.01)


def test_table_has_a_row_for_each_point() -> None:
    W, y = record("stays")
    found = followed(W, y, drift=np.zeros(P), order=0)
    frame = found.to_pandas()
    assert list(frame) == ["row", "theta_0", "theta_0_stderr", "theta_1", "theta_1_stderr"]
    assert len(frame) == N // GRID


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"grid": 0}, "grid is 0 rows"),
        ({"grid": 2.5}, "whole number"),
        ({"drift": [1.0]}, "drift has shape"),
        ({"drift": [-1.0, 0.0]}, "from zero up"),
        ({"valid": np.zeros(N, bool)}, "0 rows count"),
        ({"valid": np.ones(3, bool)}, "valid has shape"),
        ({"names": ("a",)}, "one for each"),
        ({"order": 3}, "order is 3"),
        ({"noise": [Autoregression()] * 2}, "one for each"),
        ({"varies_with": {"stiffness": np.arange(N)}}, "the parameters are theta_0"),
        ({"varies_with": {"theta_1": np.arange(3)}}, "give one number for each of 600 rows"),
        ({"varies_with": {"theta_1": np.full(N, np.inf)}}, "not finite"),
        ({"varies_with": {"theta_1": np.ones(N)}}, "nothing can vary with it"),
        ({"W": np.ones((N, P, 1, 1))}, "W has shape"),
        ({"y": np.full(N, np.nan)}, "not finite"),
    ],
)
def test_bad_input_gets_a_clear_line(settings: dict[str, Any], message: str) -> None:
    W, y = record("stays")
    with pytest.raises(ValueError, match=message):
        track(**{"W": W, "y": y, "grid": GRID, **settings})


def test_numbers_are_needed() -> None:
    with pytest.raises(ValueError, match="smoothed_path"):
        jax.jit(lambda y: followed(record("stays")[0], y).theta)(record("stays")[1])
