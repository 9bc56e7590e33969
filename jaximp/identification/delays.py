"""How late the torque is against the position, by the model: for all delays at once by FFT."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaximp import signals
from jaximp.identification.pipeline import Pipeline
from jaximp.identification.rows import Rows
from jaximp.identification.whitening import whiten
from jaximp.types import AnyArray, Numbers

LONGEST, REST = 0.05, 0.01
"""Delays that are looked for, and beside one that was found [s]."""
GUARD = 32
"""Rows at either end over which the torque fades out."""
FINER = 8
"""Delays that are looked at between one row and the next, before the best is refined."""
AGAIN, SMALL = 5, 0.3
"""Times that the noise is estimated without the delay that was found before, until less than this share of its standard
error is added."""
STEPS = 20
"""Of the refinement, at most."""


class Delay(NamedTuple):
    """Of the torque behind the position."""

    seconds: float
    """Above zero where the torque lags, below where it leads; NaN where the record is too short."""
    stderr: float
    """[s]; infinite where the best fit is at the longest delay that was looked at."""

    @property
    def certain(self) -> bool:
        """Whether it is not zero, by three standard errors."""
        return bool(abs(self.seconds) > 3 * self.stderr)

    def in_words(self) -> str:
        """`lags the position by 2.31 ms (+-0.05)`."""
        verb = "lags" if self.seconds > 0 else "leads"
        return f"{verb} the position by {1e3 * abs(self.seconds):.3g} ms (+-{1e3 * self.stderr:.2g})"


UNKNOWN = Delay(np.nan, np.inf)


def delay_of(
    W: AnyArray, torque: AnyArray, valid: AnyArray, row_rate: float, every: int = 1, longest: float = LONGEST
) -> Delay:
    """The delay with which least squares of the rows of one joint leave least of the torque.

    The correlation of every column with the torque at all delays is one inverse FFT; that of the parameters does not
    depend on the delay. The standard error comes from the curvature of the residual sum of squares at its minimum
    (Gauss-Newton), and is right where the noise is white.

    **Arguments:** `W` (N, p), `torque` (N,) and `valid` (N,) of rows at `row_rate` [Hz], of which so many (`every`)
    say as much as one; the `longest` delay that is looked for [s].
    """
    most = max(1, int(longest * row_rate))
    # Rows count whose torque is known however late it is, away from the ends, where shifts of a torque ring.
    counts = signals.widen_gaps(np.asarray(valid), most + 1)
    counts[: GUARD + most] = counts[max(0, len(counts) - GUARD - most) :] = False
    if counts.sum() / every - W.shape[1] - 1 < W.shape[1] or not np.asarray(W)[counts].any(axis=0).all():
        return UNKNOWN
    rise = np.minimum(np.arange(len(counts)), np.arange(len(counts))[::-1]).clip(max=GUARD) / GUARD
    search = _Search(np.asarray(W), np.asarray(torque) * np.sin(np.pi / 2 * rise) ** 2, counts, row_rate)
    tried = np.arange(-most * FINER, most * FINER + 1) / (FINER * row_rate)
    best = int(np.argmin(search.left(tried)))
    if best in (0, len(tried) - 1):
        return Delay(float(tried[best]), np.inf)
    found, curvature = _refined(search, float(tried[best]), 1 / (FINER * row_rate))
    left = float(search.left(np.array([found]))[0])
    variance = every * left / counts.sum() * 2 / max(curvature, np.finfo(float).tiny)
    return Delay(found, float(np.sqrt(max(variance, 0))))


def find_delay(pipeline: Pipeline, rows: Rows) -> Delay:
    """The delay of one joint's torque, by rows as they were filtered.

    Ordinary least squares find about where it is. The noise is then what is left without the delay: before, it would
    hold what the delay itself leaves of a motion of few lines.
    """
    row_rate = pipeline.sample_rate / pipeline.filters.decimate
    torque = np.asarray(rows.torque)
    total, found = 0.0, delay_of(rows.W, torque, rows.valid, row_rate)
    for _ in range(AGAIN):
        if not np.isfinite(found.stderr):
            return found
        total += found.seconds
        white = whiten(pipeline, replace(rows, torque=moved_forward(torque, total, row_rate)))
        found = delay_of(white.W, white.torque, rows.valid, row_rate, white.every, REST)
        if abs(found.seconds) < SMALL * found.stderr:
            break
    return Delay(total + found.seconds, found.stderr)


def moved_forward(x: Numbers, seconds: float, rate: float) -> Numbers:
    """A smooth signal (N,) that came late by so much; its ends are repeated."""
    from scipy.interpolate import make_interp_spline

    t = np.arange(len(x)) / rate
    return np.asarray(make_interp_spline(t, x, k=5)((t + seconds).clip(t[0], t[-1])))


class _Search:
    """What the model leaves of the torque, after any shift of the torque."""

    def __init__(self, W: Numbers, y: Numbers, counts: NDArray[np.bool_], rate: float):
        n = 1 << (2 * len(y) - 1).bit_length()
        W = np.where(counts[:, None], W, 0)
        size = np.sqrt((W**2).sum(axis=0))
        self.inverse = np.linalg.pinv((W / size).T @ (W / size))
        self.angular = 2 * np.pi * np.fft.rfftfreq(n, 1 / rate)
        # The last is the sum of squares of the torque itself over the rows that count.
        columns, of = np.concatenate([W / size, counts[:, None]], axis=1), np.stack([*[y] * W.shape[1], y**2], axis=1)
        self.cross = np.conj(np.fft.rfft(columns, n, axis=0)) * np.fft.rfft(of, n, axis=0) / n
        self.cross[1:-1] *= 2
        self.n, self.rate = n, rate

    def left(self, delays: Numbers) -> Numbers:
        """(K,) sum of squares, with the torque moved forward by each delay [s]."""
        found = self._correlations(delays)
        shared = found[:, :-1]
        return np.asarray(found[:, -1] - np.einsum("ki,ij,kj->k", shared, self.inverse, shared))

    def _correlations(self, delays: Numbers) -> Numbers:
        """(K, p + 1) of every column with the torque."""
        if len(delays) < FINER:
            turned = np.exp(1j * self.angular * delays[:, None])
            return np.asarray((turned @ self.cross).real)
        wide = np.zeros((FINER * self.n // 2 + 1, self.cross.shape[1]), complex)
        wide[: len(self.cross)] = self.cross / 2
        wide[0] *= 2
        at = np.fft.irfft(wide, axis=0) * FINER * self.n
        return np.asarray(at[np.round(delays * self.rate * FINER).astype(int)])


def _refined(search: _Search, delay: float, step: float) -> tuple[float, float]:
    """The best delay near another [s], and the second derivative of what is left there."""
    curvature = 0.0
    for _ in range(STEPS):
        before, here, after = search.left(delay + step * np.array([-1.0, 0.0, 1.0]))
        curvature = (before + after - 2 * here) / step**2
        if curvature <= 0:
            return delay, 0.0
        move = float(np.clip((before - after) / (2 * step * curvature), -step, step))
        delay += move
        if abs(move) < 1e-9:
            break
        step = max(step / 2, 1e-5)
    return delay, float(curvature)
