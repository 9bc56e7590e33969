"""Torque noise that follows from its own past, estimated from what windows leave of the torque; rows in which it is
white.

Windows have parameters of their own, so that a change of the joint does not pass for noise; the shape of the noise is
shared by all of them, its size is each window's own. What the windows' parameters take from the noise is accounted for
(restricted likelihood), exactly for stationary noise, however short the windows are.

Rows that a low-pass made alike say nothing new: an autoregression of neighbouring rows would undo the low-pass and
judge by frequencies that it took away. So it looks back in steps of `every` rows, which the low-pass leaves different.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache, reduce
from typing import NamedTuple

import numpy as np
from jaxtyping import Num, Shaped
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from jaximp.types import AnyArray, Numbers

ORDERS = (0, 2, 4, 8, 16, 32)
"""Of autoregressions that are tried, one after the other."""
WORSE = 6.0
"""How much worse the criterion may become before no higher order is tried."""
ROWS_PER_TERM = 4
"""A window has so many independent rows for each term of the autoregression, at least."""
ENOUGH, JOINED, MOST_COLUMNS = 16, 32, 28
"""Windows that are too short to tell an order that is enough for most noise are looked at several in a row: as many as
tell the highest one, up to so many parameters of all."""
FEWEST_WINDOWS = 20
"""Independent rows of all windows together, for each term."""
LOST = 1e-10
"""A direction of a window's columns with a smaller share of their squares is left out: nothing is known of it."""
LONGEST, NOTHING_MORE = 16, 0.001
"""Order of an autoregression of known noise, and the share of the error beyond it that is not worth more terms."""
BLOCK, AT_ONCE = 32, 1 << 14
"""Rows that one row of a product whitens, and numbers that are worked on at once: so many stay at hand."""
MOST_STEPS, LONGEST_STEP, NOTHING_LEFT = 7, 2.0, 1e-8
"""Newton's steps, how far each may go, and twice what the next one may gain of the logarithm of the likelihood when
they end."""
SETTLED = 1e-5
"""Slope of the logarithm of the likelihood, per independent row, at which the search ends."""
ROUNDING = 1e-15
"""Of sums of products: so much is left of a column at least where a long step of the search goes to noise that takes it
away."""
SLOWEST, FORGOTTEN = 0.9999, 1e-11
"""Root of the slowest noise whose density is resolved, and the share of noise that counts as forgotten."""
NEARLY_ONE, FARTHEST_START = 1 - 1e-9, 0.9999
"""Largest reflection coefficient, and that from which a longer autoregression is searched."""


@dataclass(frozen=True)
class Autoregression:
    """Noise e with `e[t] + a[1] e[t - every] + ... + a[k] e[t - k every]` white."""

    reflections: Numbers = field(default_factory=lambda: np.zeros(0))
    """(k,) reflection coefficients, each between -1 and 1: the noise is stationary."""
    every: int = 1
    """Rows from one term to the next."""

    @property
    def order(self) -> int:
        """Terms, k."""
        return len(self.reflections)

    @property
    def polynomial(self) -> Numbers:
        """(k + 1,) 1, a[1], ..., a[k]."""
        return _polynomials(self.reflections)[-1]

    def spectrum(self, frequency: Num[AnyArray, " F"], row_rate: float) -> Numbers:
        """(F,) one-sided density of noise of unit variance, per hertz, up to half of `row_rate / every` [Hz]."""
        step = row_rate / self.every
        turn = np.exp(-2j * np.pi * np.asarray(frequency)[:, None] / step * np.arange(self.order + 1))
        innovation = np.prod(1 - self.reflections**2)
        return np.asarray(2 / step * innovation / np.abs(turn @ self.polynomial) ** 2)

    def autocovariance(self, lags: int) -> Numbers:
        """(lags,) of noise of unit variance, at multiples of `every` rows."""
        polynomials, r = _polynomials(self.reflections), [1.0]
        for k in range(1, lags):
            a = polynomials[min(k, self.order)]
            if k <= self.order:  # Levinson's recursion, backwards: the reflection says what lag k must be
                error = np.prod(1 - self.reflections[: k - 1] ** 2)
                before = polynomials[k - 1]
                r.append(float(-self.reflections[k - 1] * error - before[1:] @ np.array(r[1:][::-1])[: k - 1]))
            else:
                r.append(float(-a[1:] @ np.array(r[: -self.order - 1 : -1])))
        return np.array(r)


def density_of(several: Sequence[Autoregression], lags: int) -> Numbers:
    """(F,) spectral density of noise which autoregressions, one after the other, turn into white noise of unit
    variance: at even steps from zero to half a cycle per term, so fine that its inverse transform is right at so many
    lags."""
    polynomial = reduce(np.convolve, (one.polynomial for one in several), np.ones(1))
    root = min(SLOWEST, np.abs(np.roots(polynomial)).max(initial=0.5))
    memory = 2 * lags + np.log(FORGOTTEN) / np.log(root)
    return np.asarray(1 / np.abs(np.fft.rfft(polynomial, 1 << int(np.ceil(np.log2(memory))))) ** 2)


def autoregression_of(autocovariance: Num[AnyArray, " L"], every: int = 1) -> Autoregression:
    """The autoregression of noise whose autocovariance is known by lag in rows: what filters made of white noise.

    Its order is the lowest, up to `LONGEST`, beyond which the past says nothing more. (Levinson 1947, Durbin 1960.)
    """
    r = np.asarray(autocovariance, float)[::every]
    r = np.pad(r / r[0], (0, max(0, LONGEST + 1 - len(r))))[: LONGEST + 1]
    a, error, reflections, errors = np.ones(1), 1.0, [], [1.0]
    for k in range(1, LONGEST + 1):
        reflection = float(np.clip(-(a @ r[k:0:-1]) / error, -NEARLY_ONE, NEARLY_ONE))
        a = np.append(a, 0) + reflection * np.append(a, 0)[::-1]
        error *= 1 - reflection**2
        reflections.append(reflection)
        errors.append(error)
    order = int(np.argmax(np.array(errors) <= (1 + NOTHING_MORE) * errors[-1]))
    return Autoregression(np.array(reflections[:order]), every)


class _Sums(NamedTuple):
    """What the likelihood of K windows needs to know of their rows, in columns that are orthonormal in each window.

    The quadratic form of an autoregression a is that of the lagged products, as if rows stood before and behind every
    run and were zero, less what these rows would leave of the first and of the last ones.
    """

    lagged: Numbers
    """(P + 1, K, q + 1, q + 1) products of rows some lags apart, either way; at lag zero once."""
    ends: Numbers
    """(P, E, q + 1) the first and the last P rows of every run, from its end inwards."""
    owner: NDArray[np.int64]
    """(E,) the windows that they belong to, in order."""
    missing: Numbers
    """(K, q) one where a direction is left out, else zero."""
    runs: Numbers
    """(K,) stretches without a gap."""
    freedom: Numbers
    """(K,) independent rows less parameters."""


def fit_window_noise(
    W: Num[AnyArray, "N p"],
    y: Num[AnyArray, " N"],
    valid: Shaped[AnyArray, " N"],
    window: int,
    every: int = 1,
) -> Autoregression:
    """The autoregression of the noise in y, from all windows of `window` rows side by side, for windows of a recording.

    Posteriors, whose noise may have other parts, use `noise.fit_noise`.

    **Arguments:** rows at equal steps of time; `valid` False for those that do not count; `every`, see the top of this
    module.

    **Returns:** the order among `ORDERS` with the smallest information criterion of Akaike; none, white noise, where
    windows have too few rows to tell.

    **Source:** restricted likelihood: Patterson and Thompson 1971; the exact likelihood of an autoregression as a
    quadratic form: Box, Jenkins and Reinsel, Time series analysis, appendix A7.5.
    """
    W, window = _joined(np.asarray(W), window, every)
    stretches = _stretches(np.asarray(valid, bool), window, every)
    parameters = W.shape[-1]
    rows = sum(sum(len(run) for run in runs) for runs in stretches) / every
    typical = np.median([sum(map(len, runs)) for runs in stretches]) if stretches else 0
    longest = max(parameters and (typical - parameters) / ROWS_PER_TERM, 0)
    orders = [k for k in ORDERS if k <= min(longest, rows / FEWEST_WINDOWS) and 2 * k < _usual_run(stretches)]
    if len(orders) < 2:
        return Autoregression(every=every)
    z = np.column_stack([W, y])
    sums = _sums(z, stretches, orders[-1])
    if sums is None:
        return Autoregression(every=every)
    best, start = (np.inf, np.zeros(0)), np.zeros(0)
    for order in orders:
        start, value = _fit(sums, np.pad(start, (0, order - len(start))))
        small = rows / (rows - order - 1)  # Hurvich and Tsai 1989, for few rows
        criterion = value / every + 2 * order * small
        if criterion > best[0] + WORSE:
            break
        best = min(best, (criterion, start), key=lambda one: one[0])
    return Autoregression(best[1], every)


def _joined(W: Numbers, window: int, every: int) -> tuple[Numbers, int]:
    """Columns and rows of windows that are long enough to tell the noise: where they are not, of several in a row, each
    with parameters of its own."""
    n, p = W.shape
    told = window / every - p
    if not p or not 0 < told < ROWS_PER_TERM * ENOUGH:
        return W, window
    count = min(-int(-ROWS_PER_TERM * JOINED // told), MOST_COLUMNS // p, n // window)
    if count < 2:
        return W, window
    apart = np.zeros((n, count, p))
    apart[np.arange(n), np.arange(n) // window % count] = W
    return apart.reshape(n, -1), count * window


def whiten_rows(
    z: Num[AnyArray, "N *k"], valid: Shaped[AnyArray, " N"], noise: Autoregression
) -> Num[AnyArray, "N *k"]:
    """Rows less what those before them say of their noise, which is white then; zero where `valid` is False.

    The first rows after a gap are predicted from as many as there are, and weighted as exactly as they are known.
    """
    z, valid, order = np.asarray(z, float), np.asarray(valid, bool), noise.order
    columns = z.reshape(len(z), -1)
    if not order:
        return np.where(valid[:, None], columns, 0).reshape(z.shape)
    white = _convolved(columns, valid, noise.polynomial, noise.every)
    known = np.minimum(_rows_before(valid, noise.every), order)
    first = np.flatnonzero(valid & (known < order))
    table = np.zeros((order, order))
    left = np.cumprod((1 - noise.reflections**2)[::-1])[::-1]
    for k, polynomial in enumerate(_polynomials(noise.reflections)[:-1]):
        table[k, : k + 1] = np.sqrt(left[k]) * polynomial
    behind = noise.every * np.arange(order)
    for some in np.array_split(first, 1 + first.size * order * columns.shape[1] // AT_ONCE):
        before = np.maximum(some[:, None] - behind, 0)
        counting = np.where(valid[before][:, :, None], columns[before], 0)
        white[some] = (table[known[some], None] @ counting)[:, 0]
    return white.reshape(z.shape)


def _convolved(columns: Numbers, valid: NDArray[np.bool_], polynomial: Numbers, every: int) -> Numbers:
    """(N, k) sums of each row and those before it in steps of `every`, weighted; zero where `valid` is False.

    By a product of a matrix with many rows at once, as many as stay at hand.
    """
    (n, k), order = columns.shape, len(polynomial) - 1
    size = max(order, BLOCK)
    reach, all_blocks = order * every, -(-n // (size * every))
    blocks = -(-all_blocks // -(-all_blocks * size * every * k // AT_ONCE))
    weights = np.zeros((order + size, size))
    for behind, weight in enumerate(polynomial):
        np.fill_diagonal(weights[order - behind :], weight)
    padded = np.zeros((k, every, order + blocks * size))
    around = sliding_window_view(padded, order + size, axis=2)[:, :, ::size]
    rows, white, found = np.empty(around.shape), np.empty((k, every, blocks * size)), np.empty((k, n))
    for first in range(0, n, blocks * size * every):
        piece = slice(max(0, first - reach), first + blocks * size * every)
        counting = np.where(valid[piece], columns[piece].T, 0)
        before = reach - min(first, reach)
        for phase in range(every):
            own = counting[:, phase::every]
            padded[:, phase, before // every :][:, : own.shape[1]] = own
            padded[:, phase, before // every + own.shape[1] :] = 0
        np.copyto(rows, around)
        np.matmul(rows.reshape(-1, order + size), weights, out=white.reshape(-1, size))
        for phase in range(every):
            here = slice(first + phase, first + blocks * size * every, every)
            found[:, here] = np.where(valid[here], white[:, phase, : len(valid[here])], 0)
    return found.T


def _rows_before(valid: NDArray[np.bool_], every: int) -> NDArray[np.int64]:
    """(N,) how many rows right before, in steps of `every`, count without a gap."""
    padded = np.pad(valid, (0, -len(valid) % every)).reshape(-1, every)
    index = np.arange(len(padded))[:, None]
    gap = np.maximum.accumulate(np.where(padded, -1, index), axis=0)
    return (index - gap - 1).ravel()[: len(valid)]


def _stretches(valid: NDArray[np.bool_], window: int, every: int) -> list[list[NDArray[np.int64]]]:
    """Of every window the rows that count, in runs without a gap: one window for each row to begin with, in steps of
    `every`. What parameters take from the noise is known in each of them, whatever the others have in common with it.
    """
    found = []
    for first in range(0, len(valid) - window + 1, window):
        for phase in range(every):
            index = np.arange(first + phase, first + window, every)
            counts = valid[index]
            edges = np.flatnonzero(np.diff(np.concatenate([[False], counts, [False]])))
            runs = [index[start:end] for start, end in zip(edges[::2], edges[1::2], strict=True)]
            if runs:
                found.append(runs)
    return found


def _usual_run(stretches: list[list[NDArray[np.int64]]]) -> int:
    """Half of the rows stand in runs of at least so many."""
    lengths = np.sort([len(run) for runs in stretches for run in runs])[::-1]
    return int(lengths[np.searchsorted(np.cumsum(lengths), lengths.sum() / 2)]) if len(lengths) else 0


def _sums(z: Numbers, stretches: list[list[NDArray[np.int64]]], order: int) -> _Sums | None:
    """Of the windows that say something of noise of this order; None where there is none.

    Lower orders are found in them too: orders compare by the same rows only.
    """
    q, kept = z.shape[1] - 1, []
    size = np.sqrt((z**2).mean(axis=0))
    z = z / np.where(size > 0, size, 1)
    for runs in stretches:
        # The quadratic form of the likelihood holds for runs of at least twice the order.
        runs = [run for run in runs if len(run) > 2 * order]
        if sum(map(len, runs)) > 2 * q + order and any(z[run, q].any() for run in runs):
            kept.append(runs)
    if not kept:
        return None
    alike: dict[int, list[tuple[int, NDArray[np.int64]]]] = {}
    for k, runs in enumerate(kept):
        for run in runs:
            alike.setdefault(len(run), []).append((k, run))
    groups = [(np.array([k for k, _ in members]), np.stack([run for _, run in members])) for members in alike.values()]
    gram = np.zeros((len(kept), q, q))
    for owner, index in groups:
        W = z[index, :q]
        np.add.at(gram, owner, W.swapaxes(1, 2) @ W)
    basis = np.zeros((len(kept), q + 1, q + 1))
    basis[:, :q, :q], missing = _orthonormal(gram)
    basis[:, q, q] = 1
    lagged, ends, owner = _of_runs(z, groups, basis, order)
    freedom = np.array([sum(map(len, runs)) for runs in kept]) - q + missing.sum(axis=1)
    return _Sums(lagged, ends, owner, missing, np.array([len(runs) for runs in kept], float), freedom)


def _of_runs(
    z: Numbers, groups: list[tuple[NDArray[np.int64], NDArray[np.int64]]], basis: Numbers, order: int
) -> tuple[Numbers, Numbers, NDArray[np.int64]]:
    """The first three fields of `_Sums`, of groups of runs of one length: their windows (R,) and rows (R, n)."""
    columns, ends, owners = z.shape[1], [], []
    lagged = np.zeros((len(basis), order + 1, columns, columns))
    for owner, index in groups:
        for some in np.array_split(np.arange(len(owner)), 1 + index.size * columns**2 // AT_ONCE):
            rows = z[index[some]] @ basis[owner[some]]
            np.add.at(lagged, owner[some], _lagged_products(rows, order))
            ends += [rows[:, :order], rows[:, : -order - 1 : -1]]
            owners += [owner[some]] * 2
    owner = np.concatenate(owners)
    sorting = np.argsort(owner, kind="stable")
    return (
        np.ascontiguousarray(lagged.swapaxes(0, 1)),
        np.ascontiguousarray(np.concatenate(ends)[sorting].swapaxes(0, 1)),
        owner[sorting],
    )


def _lagged_products(z: Numbers, order: int) -> Numbers:
    """(R, P + 1, q, q) sums over t of z[t] z[t + lag]' and its transpose, of R runs of n rows; at lag zero once.

    From the cross spectra of rows with as many zeros behind them as there are lags.
    """
    q, (frequencies, cosines) = z.shape[2], _cosines(z.shape[1] + order, order)
    spectrum = np.fft.rfft(z, frequencies, axis=1).transpose(2, 0, 1)
    one, other = np.triu_indices(q)
    real, imaginary = spectrum.real.copy(), spectrum.imag.copy()
    products = (real[one] * real[other] + imaginary[one] * imaginary[other]) @ cosines
    found = np.empty((len(z), order + 1, q, q))
    found[..., one, other] = found[..., other, one] = products.transpose(1, 2, 0)
    return found


@lru_cache(maxsize=16)
def _cosines(least: int, order: int) -> tuple[int, Numbers]:
    """A length of Fourier transforms, at least so much, and (F, P + 1) what makes sums by lag of a real spectrum."""
    from scipy.fft import next_fast_len

    size = next_fast_len(least, real=True)
    frequency, lag = np.arange(size // 2 + 1)[:, None], np.arange(order + 1)
    # Most frequencies stand for their negative too, and most lags.
    both = np.where(2 * frequency % size == 0, 1, 2) * np.where(lag == 0, 1, 2)
    return size, both * np.cos(2 * np.pi * (frequency * lag % size) / size) / size


def _orthonormal(gram: Numbers) -> tuple[Numbers, Numbers]:
    """(K, q, q) what makes columns with these products orthonormal, and (K, q) one for a direction that is left out."""
    values, vectors = np.linalg.eigh(gram)
    lost = values <= LOST * np.maximum(values[:, -1:], np.finfo(float).tiny)
    scale = np.where(lost, 0, 1 / np.sqrt(np.where(lost, 1, values)))
    return vectors * scale[:, None], lost.astype(float)


def _fit(sums: _Sums, start: Numbers) -> tuple[Numbers, float]:
    """(k,) reflections with the largest restricted likelihood, and minus twice its logarithm up to a constant."""
    if not len(start):
        return start, _likelihood(start, sums)[0]
    first = np.arctanh(np.clip(start, -FARTHEST_START, FARTHEST_START))
    return _straight(sums, first) or _searched(sums, first)


def _straight(sums: _Sums, u: Numbers) -> tuple[Numbers, float] | None:
    """By Newton's steps in u, Fisher's transform of the reflections; None where they do not lead straight to it."""
    least, last = np.inf, 0.0
    for _ in range(MOST_STEPS):
        reflections = NEARLY_ONE * np.tanh(u)
        value, slope, curvature = _likelihood(reflections, sums, curved=True)
        inside = 1 - reflections**2
        slope, curvature = slope * inside, curvature * inside * inside[:, None]
        if value >= least or not _definite(curvature):
            break
        step = -np.linalg.solve(curvature, slope)
        if np.abs(step).max() > LONGEST_STEP:
            break
        gain, u = float(-slope @ step), u + step
        if gain**2 < NOTHING_LEFT * max(gain, last):  # the next step gains no larger share of this one's
            return NEARLY_ONE * np.tanh(u), value - gain / 2
        least, last = value, gain
    return None


def _definite(curvature: Numbers) -> bool:
    try:
        np.linalg.cholesky(curvature)
    except np.linalg.LinAlgError:
        return False
    return True


def _searched(sums: _Sums, u: Numbers) -> tuple[Numbers, float]:
    """The same by a search along lines."""
    from scipy.optimize import minimize

    count = sums.freedom.sum()

    def objective(u: Numbers) -> tuple[float, Numbers]:
        reflections = NEARLY_ONE * np.tanh(u)
        value, slope, _ = _likelihood(reflections, sums)
        return value / count, slope * NEARLY_ONE * (1 - np.tanh(u) ** 2) / count

    found = minimize(objective, u, jac=True, method="BFGS", options={"maxiter": 200, "gtol": SETTLED})
    return NEARLY_ONE * np.tanh(found.x), float(found.fun * count)


def _likelihood(reflections: Numbers, sums: _Sums, curved: bool = False) -> tuple[float, Numbers, Numbers]:
    """Minus twice the logarithm of the restricted likelihood of all windows, its derivatives, and if wanted the second
    ones, nearly."""
    order, (windows, q) = len(reflections), sums.missing.shape
    a, slopes = _polynomial_and_slopes(reflections)
    lagged, ends = sums.lagged[: order + 1].reshape(order + 1, -1), sums.ends[:order]
    whole = (np.correlate(a, a, "full")[order:] @ lagged).reshape(windows, q + 1, q + 1)
    if order:
        whole -= _left_of_ends(a, ends, sums.owner)
    rounding = ROUNDING * np.abs(a).sum() ** 2
    gram = whole[:, :q, :q] + (sums.missing[:, :, None] + rounding) * np.eye(q)
    inverse = np.linalg.inv(gram)
    theta = (inverse @ whole[:, :q, q:])[..., 0]
    floor = 1e-28 * sums.lagged[0, :, q, q]  # data without noise
    rss = np.maximum(whole[:, q, q] - (whole[:, :q, q] * theta).sum(axis=1), 0) + floor
    runs, lags, inside = sums.runs.sum(), np.arange(1, order + 1), 1 - reflections**2
    value = (sums.freedom * np.log(rss) + np.linalg.slogdet(gram)[1]).sum() - runs * (lags * np.log(inside)).sum()
    residual = np.concatenate([-theta, np.ones((windows, 1))], axis=1)
    share = sums.freedom / rss
    weights = residual[:, :, None] * residual[:, None] * share[:, None, None]
    weights[:, :q, :q] += inverse
    curvature = _weighted(weights, lagged, ends, sums.owner)
    slope = slopes.T @ (curvature @ a) + runs * 2 * lags * reflections / inside
    if not curved:
        return float(value), slope, curvature
    curvature -= _of_windows(a, lagged, residual, inverse, share, rss)
    curvature = slopes.T @ curvature @ slopes + np.diag(runs * 2 * lags * (1 + reflections**2) / inside**2)
    return float(value), slope, curvature


def _of_windows(
    a: Numbers, lagged: Numbers, residual: Numbers, inverse: Numbers, share: Numbers, rss: Numbers
) -> Numbers:
    """(k + 1, k + 1) what second derivatives lose since windows have sizes and parameters of their own."""
    order, q = len(a) - 1, inverse.shape[1]
    lag, padded = np.arange(order + 1), np.concatenate([np.zeros(order), a, np.zeros(order)])
    around = padded[lag[:, None] - lag + order] + padded[lag[:, None] + lag + order]
    slopes = (around @ lagged).reshape(order + 1, -1, q + 1, q + 1)  # of the sums of every window, but for ends of runs
    of_residual = (slopes @ residual[:, :, None])[..., 0]
    of_rss = (of_residual * residual).sum(axis=-1)
    across = (of_residual[:, :, None, :q] @ (2 * share[:, None, None] * inverse))[:, :, 0]
    of_gram = inverse @ slopes[..., :q, :q]
    found = (of_rss * share / rss) @ of_rss.T
    found += of_gram.reshape(order + 1, -1) @ of_gram.swapaxes(2, 3).reshape(order + 1, -1).T
    return found + across.reshape(order + 1, -1) @ of_residual[:, :, :q].reshape(order + 1, -1).T


def _left_of_ends(a: Numbers, ends: Numbers, owner: NDArray[np.int64]) -> Numbers:
    """(K, q + 1, q + 1) products of what an autoregression a would leave of the rows behind every end."""
    order = len(a) - 1
    ahead, steps = np.append(a[1:], np.zeros(order - 1)), np.arange(order)
    left = ahead[steps[:, None] + steps] @ ends.reshape(order, -1)
    left = left.reshape(ends.shape).swapaxes(0, 1)
    first = np.flatnonzero(np.diff(owner, prepend=-1))
    return np.add.reduceat(left.swapaxes(1, 2) @ left, first)


def _weighted(weights: Numbers, lagged: Numbers, ends: Numbers, owner: NDArray[np.int64]) -> Numbers:
    """(k + 1, k + 1) second derivatives, by an autoregression, of its quadratic form with these weights of the sums."""
    order = len(ends)
    by_lag = lagged @ weights.ravel()
    by_lag[0] *= 2
    found = by_lag[np.abs(np.arange(order + 1)[:, None] - np.arange(order + 1))]
    if order:
        of_ends = (ends.swapaxes(0, 1) @ weights[owner]).swapaxes(0, 1).reshape(order, -1) @ ends.reshape(order, -1).T
        # Entry i, j sums all before it along its diagonal: a column, where every row is shifted by one more.
        shifted = np.zeros(2 * order**2)
        diagonals = shifted[order - 1 : -1].reshape(order, -1)[:, :order]
        diagonals[:] = of_ends
        columns = shifted.reshape(order, -1)
        np.cumsum(columns, axis=0, out=columns)
        found[1:, 1:] -= 2 * diagonals
    return found


def _polynomials(reflections: Numbers) -> list[Numbers]:
    """Prediction from none, one, two, ... rows before (Levinson's recursion)."""
    found = [np.ones(1)]
    for reflection in reflections:
        longer = np.append(found[-1], 0)
        found.append(longer + reflection * longer[::-1])
    return found


def _polynomial_and_slopes(reflections: Numbers) -> tuple[Numbers, Numbers]:
    """(k + 1,) the polynomial, and (k + 1, k) its derivatives by the reflections."""
    order = len(reflections)
    found = np.zeros((order + 1, order + 1))
    found[0, order] = 1
    for m, reflection in enumerate(reflections.tolist()):
        longer = found[: m + 2]
        turned = longer[::-1].copy()
        longer += reflection * turned
        longer[:, m] = turned[:, order]
    return found[:, order], found[:, :order]
