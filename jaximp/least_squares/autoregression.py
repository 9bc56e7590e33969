"""Torque noise that follows from its own past, estimated from what windows leave of the torque; rows in which it is
white.

Windows have parameters of their own, so that a change of the joint does not pass for noise; the shape of the noise is
shared by all of them, its size is each window's own. What the windows' parameters take from the noise is accounted for
(restricted likelihood), exactly for stationary noise, however short the windows are.

Rows that a low-pass made alike say nothing new: an autoregression of neighbouring rows would undo the low-pass and
judge by frequencies that it took away. So it looks back in steps of `every` rows, which the low-pass leaves different.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Num, Shaped
from numpy.typing import NDArray

from jaximp.types import AnyArray, Numbers

ORDERS = (0, 2, 4, 8, 16, 32)
"""Of autoregressions that are tried, one after the other."""
FIRST_ORDERS, WORSE = 4, 6.0
"""Order up to which sums are prepared at first, and how much worse the criterion may become before no higher order is
tried."""
ROWS_PER_TERM = 4
"""A window has so many independent rows for each term of the autoregression, at least."""
FEWEST_WINDOWS = 20
"""Independent rows of all windows together, for each term."""
LOST = 1e-10
"""A direction of a window's columns with a smaller share of their squares is left out: nothing is known of it."""
LONGEST, NOTHING_MORE = 16, 0.001
"""Order of an autoregression of known noise, and the share of the error beyond it that is not worth more terms."""
SETTLED = 1e-5
"""Slope of the logarithm of the likelihood, per independent row, at which the search ends."""
ROUNDING = 1e-15
"""Of sums of products: so much is left of a column at least where a long step of the search goes to noise that takes it
away."""
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
    """What the likelihood of K windows needs to know of their rows."""

    products: Numbers
    """(K, P + 1, P + 1, q + 1, q + 1) of rows some lags apart, in coordinates in which columns are orthonormal."""
    missing: Numbers
    """(K, q) one where a direction is left out, else zero."""
    runs: Numbers
    """(K,) stretches without a gap."""
    freedom: Numbers
    """(K,) independent rows less parameters."""

    @property
    def order(self) -> int:
        """Highest order that they serve, P."""
        return self.products.shape[1] - 1


def fit_window_noise(
    W: Num[AnyArray, "N p"],
    y: Num[AnyArray, " N"],
    valid: Shaped[AnyArray, " N"],
    window: int,
    every: int = 1,
) -> Autoregression:
    """The autoregression of the noise in y, from all windows of `window` rows side by side.

    **Arguments:** rows at equal steps of time; `valid` False for those that do not count; `every`, see the top of this
    module.

    **Returns:** the order among `ORDERS` with the smallest information criterion of Akaike; none, white noise, where
    windows have too few rows to tell.

    **Source:** restricted likelihood: Patterson and Thompson 1971; the exact likelihood of an autoregression as a
    quadratic form: Box, Jenkins and Reinsel, Time series analysis, appendix A7.5.
    """
    stretches = _stretches(np.asarray(valid, bool), window, every)
    parameters = W.shape[-1]
    rows = sum(sum(len(run) for run in runs) for runs in stretches) / every
    typical = np.median([sum(map(len, runs)) for runs in stretches]) / every if stretches else 0
    longest = max(parameters and (typical - parameters) / ROWS_PER_TERM, 0)
    orders = [k for k in ORDERS if k <= min(longest, rows / FEWEST_WINDOWS) and 2 * k < _usual_run(stretches)]
    if len(orders) < 2:
        return Autoregression(every=every)
    z = np.column_stack([W, y])
    sums, best, start = None, (np.inf, np.zeros(0)), np.zeros(0)
    for order in orders:
        if sums is None or sums.order < order:
            sums = _sums(z, stretches, min(orders[-1], max(4 * order, FIRST_ORDERS)), every, orders[-1])
        if sums is None:
            break
        start, value = _fit(sums, np.pad(start, (0, order - len(start))))
        small = rows / (rows - order - 1)  # Hurvich and Tsai 1989, for few rows
        criterion = value + 2 * order * small
        if criterion > best[0] + WORSE:
            break
        best = min(best, (criterion, start), key=lambda one: one[0])
    return Autoregression(best[1], every)


def whiten_rows(
    z: Num[AnyArray, "N *k"], valid: Shaped[AnyArray, " N"], noise: Autoregression
) -> Num[AnyArray, "N *k"]:
    """Rows less what those before them say of their noise, which is white then; zero where `valid` is False.

    The first rows after a gap are predicted from as many as there are, and weighted as exactly as they are known.
    """
    valid = np.asarray(valid, bool)
    z = np.where(valid.reshape(-1, *(1,) * (np.ndim(z) - 1)), np.asarray(z, float), 0)
    if not noise.order:
        return z
    known = np.minimum(_rows_before(valid, noise.every), noise.order)
    table = np.zeros((noise.order + 1, noise.order + 1))
    left = np.append(np.cumprod((1 - noise.reflections**2)[::-1])[::-1], 1)
    for k, polynomial in enumerate(_polynomials(noise.reflections)):
        table[k, : k + 1] = np.sqrt(left[k]) * polynomial
    white = np.zeros_like(z)
    for j in range(noise.order + 1):
        behind = j * noise.every
        if behind >= len(z):
            break
        weight = np.where(valid, table[known, j], 0)[behind:]
        white[behind:] += weight.reshape(-1, *(1,) * (z.ndim - 1)) * z[: len(z) - behind]
    return white


def _rows_before(valid: NDArray[np.bool_], every: int) -> NDArray[np.int64]:
    """(N,) how many rows right before, in steps of `every`, count without a gap."""
    padded = np.pad(valid, (0, -len(valid) % every)).reshape(-1, every)
    index = np.arange(len(padded))[:, None]
    gap = np.maximum.accumulate(np.where(padded, -1, index), axis=0)
    return (index - gap - 1).ravel()[: len(valid)]


def _stretches(valid: NDArray[np.bool_], window: int, every: int) -> list[list[NDArray[np.int64]]]:
    """Of every window the rows that count, in runs without a gap `every` rows apart."""
    found = []
    for first in range(0, len(valid) - window + 1, window):
        runs = []
        for phase in range(every):
            index = np.arange(first + phase, first + window, every)
            counts = valid[index]
            edges = np.flatnonzero(np.diff(np.concatenate([[False], counts, [False]])))
            runs += [index[start:end] for start, end in zip(edges[::2], edges[1::2], strict=True)]
        if runs:
            found.append(runs)
    return found


def _usual_run(stretches: list[list[NDArray[np.int64]]]) -> int:
    """Half of the rows stand in runs of at least so many."""
    lengths = np.sort([len(run) for runs in stretches for run in runs])[::-1]
    return int(lengths[np.searchsorted(np.cumsum(lengths), lengths.sum() / 2)]) if len(lengths) else 0


def _sums(
    z: Numbers, stretches: list[list[NDArray[np.int64]]], order: int, every: int, highest: int = 0
) -> _Sums | None:
    """Of the windows that say something of noise of this order; None where there is none.

    Orders compare by the same rows only: `highest` is the last that will be tried, if it is above this one.
    """
    highest = max(order, highest)
    q, kept = z.shape[1] - 1, []
    size = np.sqrt((z**2).mean(axis=0))
    z = z / np.where(size > 0, size, 1)
    for runs in stretches:
        # The quadratic form of the likelihood holds for runs of at least twice the order.
        runs = [run for run in runs if len(run) > 2 * highest]
        if sum(map(len, runs)) > (2 * q + highest) * every and any(z[run, q].any() for run in runs):
            kept.append(runs)
    if not kept:
        return None
    products = np.zeros((len(kept), order + 1, order + 1, q + 1, q + 1))
    by_length: dict[int, list[tuple[int, NDArray[np.int64]]]] = {}
    for k, runs in enumerate(kept):
        for run in runs:
            by_length.setdefault(len(run), []).append((k, run))
    for members in by_length.values():
        owners, index = zip(*members, strict=True)
        np.add.at(products, list(owners), _lagged_products(z[np.stack(index)], order))
    rows = np.array([sum(map(len, runs)) for runs in kept]) / every
    to_orthonormal, missing = _orthonormal(products[:, 0, 0, :q, :q])
    basis = np.zeros((len(kept), q + 1, q + 1))
    basis[:, :q, :q], basis[:, q, q] = to_orthonormal, 1
    across = basis[:, None, None]
    products = across.swapaxes(-1, -2) @ products @ across
    freedom = rows - q + missing.sum(axis=1)
    return _Sums(products, missing, np.array([len(runs) for runs in kept], float) / every, freedom)


def _lagged_products(z: Numbers, order: int) -> Numbers:
    """(K, P + 1, P + 1, q, q) sums over t of z[i + t] z[j + t]' with t from 0 to n - 1 - i - j, of K runs of n rows."""
    runs, n, q = z.shape
    found = np.zeros((runs, order + 1, order + 1, q, q))
    for lag in range(order + 1):
        total = np.einsum("kta,ktb->kab", z[:, : n - lag], z[:, lag:])
        for i in range(order + 1 - lag):
            found[:, i, i + lag] = total
            found[:, i + lag, i] = total.swapaxes(1, 2)
            for first in (i, n - 1 - i - lag):  # the outermost pair at either end leaves
                total = total - z[:, first, :, None] * z[:, first + lag, None, :]
    return found


def _orthonormal(gram: Numbers) -> tuple[Numbers, Numbers]:
    """(K, q, q) what makes columns with these products orthonormal, and (K, q) one for a direction that is left out."""
    values, vectors = np.linalg.eigh(gram)
    lost = values <= LOST * np.maximum(values[:, -1:], np.finfo(float).tiny)
    scale = np.where(lost, 0, 1 / np.sqrt(np.where(lost, 1, values)))
    return vectors * scale[:, None], lost.astype(float)


def _fit(sums: _Sums, start: Numbers) -> tuple[Numbers, float]:
    """(k,) reflections with the largest restricted likelihood, and minus twice its logarithm up to a constant."""
    from scipy.optimize import minimize

    order = len(start)
    products = sums.products[:, : order + 1, : order + 1]
    if not order:
        return start, _likelihood(start, products, sums)[0]
    count = sums.freedom.sum()

    def objective(u: Numbers) -> tuple[float, Numbers]:
        reflections = NEARLY_ONE * np.tanh(u)
        value, slope = _likelihood(reflections, products, sums)
        return value / count, slope * NEARLY_ONE * (1 - np.tanh(u) ** 2) / count

    first = np.arctanh(np.clip(start, -FARTHEST_START, FARTHEST_START))
    found = minimize(objective, first, jac=True, method="BFGS", options={"maxiter": 200, "gtol": SETTLED})
    return NEARLY_ONE * np.tanh(found.x), float(found.fun * count)


def _likelihood(reflections: Numbers, products: Numbers, sums: _Sums) -> tuple[float, Numbers]:
    """Minus twice the logarithm of the restricted likelihood of all windows, and its derivatives."""
    q = products.shape[-1] - 1
    a, slopes = _polynomial_and_slopes(reflections)
    half = np.tensordot(products, a, (2, 0))
    whole = np.tensordot(half, a, (1, 0))
    rounding = ROUNDING * np.abs(a).sum() ** 2
    gram = whole[:, :q, :q] + (sums.missing[:, :, None] + rounding) * np.eye(q)
    inverse = np.linalg.inv(gram)
    theta = (inverse @ whole[:, :q, q:])[..., 0]
    floor = 1e-28 * products[:, 0, 0, q, q]  # data without noise
    rss = np.maximum(whole[:, q, q] - (whole[:, :q, q] * theta).sum(axis=1), 0) + floor
    residual = np.concatenate([-theta, np.ones((len(theta), 1))], axis=1)
    of_rss = 2 * ((half @ residual[:, None, :, None])[..., 0] * residual[:, None]).sum(axis=-1)
    of_gram = 2 * (inverse[:, None] * half[:, :, :q, :q]).sum(axis=(-1, -2))
    lags = np.arange(1, len(reflections) + 1)
    value = (sums.freedom * np.log(rss) + np.linalg.slogdet(gram)[1]).sum()
    value -= sums.runs.sum() * (lags * np.log1p(-(reflections**2))).sum()
    slope = (of_rss * (sums.freedom / rss)[:, None] + of_gram).sum(axis=0) @ slopes
    return float(value), slope + sums.runs.sum() * 2 * lags * reflections / (1 - reflections**2)


def _polynomials(reflections: Numbers) -> list[Numbers]:
    """Prediction from none, one, two, ... rows before (Levinson's recursion)."""
    found = [np.ones(1)]
    for reflection in reflections:
        longer = np.append(found[-1], 0)
        found.append(longer + reflection * longer[::-1])
    return found


def _polynomial_and_slopes(reflections: Numbers) -> tuple[Numbers, Numbers]:
    """(k + 1,) the polynomial, and (k + 1, k) its derivatives by the reflections."""
    a, slopes = np.ones(1), np.zeros((1, len(reflections)))
    for m, reflection in enumerate(reflections):
        longer, steeper = np.append(a, 0), np.vstack([slopes, np.zeros(len(reflections))])
        a, slopes = longer + reflection * longer[::-1], steeper + reflection * steeper[::-1]
        slopes[:, m] += longer[::-1]
    return a, slopes
