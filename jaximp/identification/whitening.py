"""Rows whose noise is white: generalised least squares, by an autoregression of what windows leave of the torque.

The estimates come from white rows; how well they explain the torque is asked of the rows as they were filtered.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaximp.identification.pipeline import Pipeline
from jaximp.identification.rows import Rows
from jaximp.least_squares.autoregression import (
    Autoregression,
    autoregression_of,
    density_of,
    fit_window_noise,
    whiten_rows,
)
from jaximp.least_squares.disjoint import DisjointFit, fit_disjoint
from jaximp.least_squares.sliding import Score
from jaximp.least_squares.window import SlidingFit, WindowFit
from jaximp.types import AnyArray, Numbers

BEYOND = 1.1
"""Rows whose half rate is about so many times the cut-off of the low-pass each say something new."""
FREQUENCIES = 256
"""Of a spectrum that is shown."""
FEWEST_ROWS = 200
"""Independent rows of all windows from which a scatter of their scores is judged."""
AT_ONCE = 1 << 20
"""Numbers of windows' columns that are worked on at once."""
UNUSUAL = 4.0
"""A window whose scores scatter so many times as much as is usual, such as one in which the joint changes, says nothing
of the others."""
LEAST_LEFT = 1e-3
"""A row's residual is taken for such a share of its error at least, however much of it the parameters took."""


@dataclass(frozen=True)
class White:
    """Rows of a recording whose noise is white."""

    W: AnyArray
    """(N, *n, p)"""
    torque: AnyArray
    """(N, *n), in units of each output's own noise where there are several."""
    noisy: AnyArray | None
    """(N, *n, p) what noise of the position leaves in every column."""
    filtered: Autoregression
    """What the filters make of white noise."""
    noise: tuple[Autoregression, ...]
    """Of each output, what is left where that is taken off."""
    size: Numbers
    """(n,) by what each output was divided."""
    windows: DisjointFit
    """Least squares of the white rows in windows side by side, of all outputs together."""
    inflation: Numbers
    """(p,) by what standard errors grow since the noise's size follows the motion; one where it does not."""
    as_filtered: AnyArray | None = None
    """(N, *n, p) columns of the rows as they were filtered, where estimates come from these (`Pipeline.ordinary`)."""
    counted: Numbers | None = None
    """(n,) what these are divided by, where joints are weighed."""

    @property
    def every(self) -> int:
        """So many neighbouring rows say as much as one."""
        return self.filtered.every

    @property
    def column_noise(self) -> Numbers:
        """(p,) root mean square of what noise of the position leaves in every column."""
        assert self.noisy is not None
        return np.sqrt((self.noisy.reshape(-1, self.noisy.shape[-1]) ** 2).mean(axis=0))

    def noise_spectrum(self, row_rate: float, left: AnyArray) -> Numbers:
        """(1 + n, FREQUENCIES) frequency [Hz] and, of each output, one-sided density of the noise as it was filtered.

        **Arguments:** `row_rate` of the rows [Hz]; `left` (N, *n) of the torque by the estimates, NaN where it does not
        count, which has the size of the noise.
        """
        frequency = np.linspace(0, row_rate / self.every / 2, FREQUENCIES)
        squares = np.reshape(left, (len(left), -1)) ** 2
        variance = np.nansum(squares, axis=0) / np.maximum(np.isfinite(squares).sum(axis=0), 1)
        of_filters, found = self.filtered.spectrum(frequency, row_rate), [frequency]
        for noise, size in zip(self.noise, variance, strict=True):
            shape = of_filters * noise.spectrum(frequency, row_rate)
            found.append(shape * size / (shape.sum() * frequency[1]))
        return np.stack(found)

    def autocovariance(self, lags: int) -> Numbers:
        """(n, lags) of each output's noise as it was filtered, by lag in rows, where white rows have unit variance.

        Between rows that say something new the noise is as smooth as its low-pass: nothing is above half their rate.
        """
        found = []
        for noise, size in zip(self.noise, self.size, strict=True):
            density = size**2 * density_of([self.filtered, noise], -(-lags // self.every))
            wide = np.zeros((len(density) - 1) * self.every + 1)
            wide[: len(density)] = density
            found.append(self.every * np.fft.irfft(wide)[:lags])
        return np.stack(found)

    def apply(self, columns: AnyArray, valid: AnyArray, output: int = -1) -> NDArray[np.float64]:
        """Further columns (N, *k) through the same filter, of one output."""
        before = whiten_rows(columns, valid, self.filtered) if self.filtered.order else columns
        return np.asarray(whiten_rows(before, valid, self.noise[output])) / self.size[output]


def rows_apart(pipeline: Pipeline) -> int:
    """How many rows behind each other say something new: after a low-pass not all of them do."""
    cutoff = pipeline.filter.decimation_cutoff
    if cutoff is None:
        return 1
    return max(1, round(pipeline.sample_rate / pipeline.filters.decimate / (2 * BEYOND * cutoff)))


def whiten(pipeline: Pipeline, rows: Rows, beside: AnyArray | None = None) -> White:
    """White rows, by the noise of each output.

    **Arguments:** columns `beside` (N, *n, k) whose parameters came from elsewhere: what their errors leave is
    no noise.
    """
    every, window = rows_apart(pipeline), pipeline.window_rows
    W, y, valid = (np.asarray(x) for x in (rows.W, rows.torque, rows.valid))
    outputs = 1 if y.ndim == 1 else y.shape[1]
    W, y, valid = W.reshape(len(W), outputs, -1), y.reshape(-1, outputs), valid.reshape(-1, outputs)
    known = pipeline.filters.noise
    filtered = Autoregression(every=every) if known is None else autoregression_of(known, every)

    def white(z: AnyArray, noise: Sequence[Autoregression]) -> NDArray[np.float64]:
        found = [whiten_rows(z[:, j], valid[:, j], noise[j]) for j in range(outputs)]
        return found[0][:, None] if outputs == 1 else np.stack(found, axis=1)

    # [W, torque, noisy] are whitened twice: by what the filters do to white noise, then by what is left of the noise.
    p, noisy = W.shape[-1], [] if rows.noisy is None else [rows.noisy.reshape(W.shape)]
    others = [] if beside is None else [np.reshape(beside, (*y.shape, -1))]
    z = white(np.concatenate([W, y[..., None], *noisy, *others], axis=-1), [filtered] * outputs)
    last = p + 1 + p * len(noisy)
    explaining = np.concatenate([z[..., :p], z[..., last:]], axis=-1)
    noise = tuple(fit_window_noise(explaining[:, j], z[:, j, p], valid[:, j], window, every) for j in range(outputs))
    z = white(z[..., :last], noise)
    size = _sizes(z[..., :p], z[..., p], valid, window)
    z = z if outputs == 1 else z / size[:, None]
    W, y, shape = np.ascontiguousarray(z[..., :p]), np.ascontiguousarray(z[..., p]), rows.torque.shape
    flat = W.reshape(-1, p), y.ravel()
    windows = fit_disjoint(*flat, valid.ravel(), window * outputs)
    return White(
        W=W.reshape(*shape, -1),
        torque=y.reshape(shape),
        noisy=z[..., p + 1 :].reshape(*shape, -1) if noisy else None,
        filtered=filtered,
        noise=noise,
        size=size,
        windows=windows,
        inflation=_inflation(flat[0], windows, every),
        as_filtered=np.where(valid.reshape(shape)[..., None], rows.W, 0) if pipeline.ordinary else None,
    )


def _sizes(W: Numbers, y: Numbers, valid: NDArray[np.bool_], window: int) -> Numbers:
    """(n,) of the noise in each output, relative to the first: several outputs with common parameters are weighed."""
    outputs = y.shape[1]
    if outputs == 1:
        return np.ones(1)
    parts = [slice(first, first + window) for first in range(0, len(y) - window + 1, window)]
    left = np.zeros(outputs)
    for part, j in product(parts, range(outputs)):
        left[j] += ((y[part, j] - W[part, j] @ np.linalg.lstsq(W[part, j], y[part, j])[0]) ** 2).sum()
    size = np.sqrt(left / np.maximum(valid.sum(axis=0), 1))
    return np.where(size > 0, size, 1) / (size[0] if size[0] > 0 else 1)


def _inflation(W: Numbers, windows: DisjointFit, every: int, shares: Callable[[int], Numbers] | None = None) -> Numbers:
    """(p,) root of the variance that the scatter of scores gives over the textbook's, of windows side by side.

    **Arguments:** `W` (N, p) white columns; `shares` of a window, (S, p) by which each row counts in the estimates,
    where these are not those of the white rows.

    **Source:** White 1980; residuals scaled by their leverage, MacKinnon and White 1985 (HC2).
    """
    p, freedom = W.shape[1], windows.rows - W.shape[1]
    ratios, chosen = [], np.flatnonzero(windows.sound & (windows.rows >= (p + 2) * every))
    if freedom[chosen].sum() / every < FEWEST_ROWS:
        return np.ones(p)
    for k in chosen.tolist():
        Q, residual = windows.orthonormal(W, slice(k, k + 1))[0], windows.residual[k]
        share = Q @ windows.inverse[k].T if shares is None else shares(k)
        error = residual / np.sqrt(np.maximum(1 - (Q**2).sum(axis=1), LEAST_LEFT))
        plain = (share**2).sum(axis=0) * (residual @ residual) / freedom[k]
        ratios.append(((share * error[:, None]) ** 2).sum(axis=0) / plain)
    usual = np.array(ratios)
    weights = np.where(usual <= UNUSUAL * np.median(usual, axis=0), freedom[chosen, None], 0)
    return np.asarray(np.sqrt((weights * usual).sum(axis=0) / weights.sum(axis=0)))


def from_white(fit: SlidingFit, ordinary: SlidingFit, white: White, seen: Score | None = None) -> SlidingFit:
    """Estimates and errors of white rows; condition, and what the torque says of them, of the rows as they were
    filtered.

    **Arguments:** `fit` of the white rows with the textbook's errors; `ordinary` of the others; `seen`, how the
    estimates explain the torque of their windows (without it that of the ordinary ones stands there).
    """
    stderr, dof = _with_sizes(fit.stderr, fit.dof, fit.samples, white)
    solved = np.isfinite(np.asarray(fit.theta)).all(axis=1)
    vaf, rms = (ordinary.vaf, ordinary.residual_rms) if seen is None else (seen.vaf, seen.residual_rms)
    dof, cond, sigma_min, vaf, rms = (
        np.where(solved, np.asarray(x), np.nan) for x in (dof, ordinary.cond, ordinary.sigma_min, vaf, rms)
    )
    return SlidingFit(
        theta=fit.theta, stderr=stderr, dof=dof, cond=cond, sigma_min=sigma_min, excitation=fit.excitation,
        residual_rms=rms, vaf=vaf, samples=fit.samples, first=fit.first, last=fit.last,
    )  # fmt: skip


def from_filtered(fit: SlidingFit, ordinary: SlidingFit, white: White, columns: AnyArray | None = None) -> SlidingFit:
    """Ordinary estimates of the rows as they were filtered, with errors that know the noise.

    Its shape comes from the whole record, its size from what is left of the window's white rows.

    **Arguments:** `fit` of the white rows with the textbook's errors; `ordinary` of the others; their `columns`
    (N, *n, p), if these are not `white.as_filtered` (the noise's size is then taken as the same for all motion).
    """
    freedom = np.maximum(np.asarray(fit.samples) - white.every * fit.theta.shape[1], 0)
    squares = np.asarray(fit.residual_rms) ** 2 * np.asarray(fit.samples)
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.where(freedom > 0, np.sqrt(squares / freedom), np.nan)
    inflation = np.ones(1) if columns is not None else ordinary_inflation(white)
    columns = np.asarray(white.as_filtered if columns is None else columns)
    window = int(fit.last[0] - fit.first[0]) + 1 if len(fit.first) else 0
    solved = np.isfinite(np.asarray(ordinary.theta)).all(axis=1)
    stderr = ordinary_errors(columns, np.asarray(fit.first)[solved], window, white.autocovariance(window))
    errors = np.full(ordinary.theta.shape, np.nan)
    errors[solved] = stderr * size[solved, None] * inflation
    dof = np.where(solved, freedom / white.every, np.nan)
    return eqx.tree_at(lambda f: (f.stderr, f.dof), ordinary, (errors, dof))


def ordinary_errors(W: AnyArray, starts: NDArray[np.int64], window: int, autocovariance: Numbers) -> Numbers:
    """(M, p) standard errors of ordinary least squares in windows of rows, `root(diag(A S A'))` with A the
    pseudo-inverse of the columns and S the covariance of stationary noise.

    **Arguments:** `W` (N, *n, p), zero in rows that do not count; `starts` (M,) of windows with independent columns;
    `autocovariance` (n, window) of each output's noise, by lag in rows.
    """
    from scipy.fft import next_fast_len

    W = W.reshape(len(W), -1, W.shape[-1])
    _, outputs, p = W.shape
    circle = next_fast_len(2 * window, real=True)
    lags = np.zeros((outputs, circle))
    lags[:, :window], lags[:, circle - window + 1 :] = autocovariance, autocovariance[:, :0:-1]
    density = np.fft.rfft(lags).real.T / circle
    density[1 : (circle + 1) // 2] *= 2  # most frequencies stand for their negative too
    found, around = [np.zeros((0, p))], np.arange(window)
    for some in np.array_split(starts, 1 + len(starts) * window * outputs * p // AT_ONCE):
        columns = W[some[:, None] + around]
        Q, R = np.linalg.qr(columns.reshape(len(some), window * outputs, p))
        answers = (Q @ np.linalg.inv(R).swapaxes(1, 2)).reshape(columns.shape)
        power = np.abs(np.fft.rfft(answers, circle, axis=1)) ** 2
        found.append(np.sqrt(np.einsum("mfjp,fj->mp", power, density)))
    return np.concatenate(found)


def ordinary_inflation(white: White) -> Numbers:
    """(p,) as `White.inflation`, of ordinary least squares: by what every white row adds to the estimates."""
    from scipy.signal import lfilter

    W, windows = np.asarray(white.as_filtered), white.windows
    W = W.reshape(len(W), -1, W.shape[-1])
    outputs, p = W.shape[1:]
    size = windows.residual.shape[1]
    own = fit_disjoint(W.reshape(-1, p), np.zeros(W.size // p), np.ones(W.size // p, bool), size)
    columns = np.asarray(white.W).reshape(-1, p)

    def shares(k: int) -> Numbers:
        answers = (own.orthonormal(W.reshape(-1, p), slice(k, k + 1))[0] @ own.inverse[k].T).reshape(-1, outputs, p)
        for j, noise in enumerate(white.noise):
            for one in (white.filtered, noise):
                back = np.zeros(one.order * one.every + 1)
                back[:: one.every] = one.polynomial
                answers[:, j] = lfilter([1.0], back, answers[::-1, j], axis=0)[::-1]
            answers[:, j] *= white.size[j]
        return answers.reshape(-1, p)

    return _inflation(columns, windows, white.every, shares)


def with_sizes_of_one(fit: WindowFit, white: White) -> WindowFit:
    """The fit of one window of white rows, with the errors of white rows."""
    stderr, dof = _with_sizes(fit.stderr[None], fit.dof[None], fit.samples[None], white)
    grown = stderr[0] / np.asarray(fit.stderr)
    covariance = np.asarray(fit.covariance) * np.outer(grown, grown)
    return eqx.tree_at(
        lambda f: (f.stderr, f.dof, f.covariance),
        fit,
        (jnp.asarray(stderr[0]), jnp.asarray(dof[0]), jnp.asarray(covariance)),
    )


def _with_sizes(stderr: AnyArray, dof: AnyArray, samples: AnyArray, white: White) -> tuple[Numbers, Numbers]:
    """Standard errors (M, p) and degrees of freedom (M,) of white rows, from the textbook's.

    Of rows that repeat each other so many times, the squares of the residuals sum up as often, and say no more.
    """
    p, every = stderr.shape[1], white.every
    freedom = np.asarray(samples) - every * p
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = np.where(freedom > 0, np.sqrt(every * np.asarray(dof) / freedom), np.nan)
    return np.asarray(stderr) * factor[:, None] * white.inflation, np.maximum(freedom / every, 0)
