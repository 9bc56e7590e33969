"""What noise of the position and change inside windows do to estimates, to first order, and its correction.

The rows of a window have columns W = W0 + N, where N comes from noise of the position: least squares finds
(W'W)^-1 (W'W - N'N) theta. And where the parameters change steadily around their mean, by b over the window, it finds
theta + (W'W)^-1 W'(s W) b, where s runs from -1/2 to 1/2.

**Source:** errors in variables, Fuller, Measurement Error Models (1987), 1.2; N'N is that of noise which is made alike.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import numpy as np
from numpy.typing import NDArray

from jaximp.least_squares.window import SlidingFit
from jaximp.types import AnyArray, Numbers

UNSURE = 0.2
"""What is known of the noise of the position is known to such a share of its variance."""
DEPENDENT = 1e-12
"""Smallest eigenvalue of W'W with columns of unit size."""
SURE = 3.0
"""A window tells how another changes if none of its standard errors is so many times larger."""
LEAST_LEFT = 0.5
"""Where noise makes more than half of a column, to first order nothing can be corrected."""


SEGMENT, FEWEST_SEGMENTS = 256, 8
"""Rows of a piece of which a spectrum is made, and how many there must be."""
LEAST_SEEN = 1e-3
"""Beyond the low-pass of all columns, where noise is this share of what it is elsewhere, nothing can be seen."""
MORE, UNRELATED, FEWEST_LINES = 3.0, 0.3, 5
"""The motion asks for so many times the torque that there is, of which it shares less than this with it, at so many
frequencies at least: that is no motion."""


def noise_in_band(W: AnyArray, torque: AnyArray, noisy: AnyArray, valid: AnyArray, theta: Numbers) -> float:
    """How many times the variance of the noise that is assumed in the position is seen inside the filters' band.

    Noise that a recorder filtered hides from differences of its samples. It shows at frequencies where the joint,
    with parameters near `theta` (p,), would need far more torque than there is, and torque and motion have nothing in
    common. One where it does not show.

    **Arguments:** rows of one output as they were filtered: `W` (N, p), `torque` (N,), `valid` (N,), and `noisy`
    (N, p), what the noise that is assumed makes of the columns.
    """
    counts = np.asarray(valid)
    if counts.sum() < FEWEST_SEGMENTS * SEGMENT or counts.mean() < 0.5 or not np.asarray(noisy).any():
        return 1.0
    needed, there, of_noise = (
        np.where(counts, x - x[counts].mean(), 0)
        for x in (np.asarray(W) @ theta, np.asarray(torque), np.asarray(noisy) @ theta)
    )
    lines_of = _segments_by_frequency(np.stack([needed, there, of_noise]))
    asked, given, alone = (np.abs(lines_of) ** 2).mean(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        shared = np.abs((lines_of[0].conj() * lines_of[1]).mean(axis=0)) ** 2 / (asked * given)
    lines = (asked > MORE * given) & (shared < UNRELATED) & (alone > LEAST_SEEN * alone.max())
    if lines.sum() < FEWEST_LINES:
        return 1.0
    return max(1.0, float(np.median((asked - given)[lines] / alone[lines])))


def _segments_by_frequency(x: Numbers) -> NDArray[np.complex128]:
    """(k, segments, lines) of signals (k, N), of segments that overlap by half (Welch 1967), without zero frequency."""
    segments = np.lib.stride_tricks.sliding_window_view(x, SEGMENT, axis=1)[:, :: SEGMENT // 2]
    taper = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(SEGMENT) / SEGMENT)
    return np.fft.rfft((segments - segments.mean(axis=2, keepdims=True)) * taper)[..., 1:-1]


class Sums(NamedTuple):
    """Over the rows of M windows."""

    gram: Numbers
    """(M, p, p) W'W."""
    moment: Numbers
    """(M, p, p) W'(s W)."""
    rows: Numbers
    """(M,) how many count."""


def window_sums(W: AnyArray, valid: AnyArray, fit: SlidingFit) -> Sums:
    """Of rows (N, *n, p), those of all outputs together, in the windows of a fit."""
    p, length = W.shape[-1], len(W)
    W, valid = np.asarray(W).reshape(length, -1, p), np.asarray(valid).reshape(length, -1)
    start, end = np.asarray(fit.first), np.asarray(fit.last) + 1
    middle, span = (start + end - 1) / 2, end - start
    t = np.arange(length, dtype=float)
    W = np.where(valid[..., None], W, 0)

    def over_windows(x: Numbers) -> Numbers:
        before = np.concatenate([np.zeros(1), np.cumsum(x)])
        return before[end] - before[start]

    gram, moment = np.empty((len(start), p, p)), np.empty((len(start), p, p))
    for i in range(p):
        for j in range(i, p):
            product = (W[..., i] * W[..., j]).sum(axis=1)
            gram[:, i, j] = gram[:, j, i] = total = over_windows(product)
            moment[:, i, j] = moment[:, j, i] = (over_windows(product * t) - middle * total) / span
    return Sums(gram, moment, over_windows(valid.sum(axis=1).astype(float)))


def corrected(fit: SlidingFit, W: AnyArray, noisy: AnyArray | None, valid: AnyArray, apart: int | None) -> SlidingFit:
    """Estimates and standard errors without what is known to move them.

    **Arguments:** rows `W` (N, *n, p) of the `fit`, and what noise of the position makes of them, `noisy` (N, *n, p);
    `valid` (N, *n); windows `apart` of each other share no rows (None leaves change inside of them as it is).
    """
    sums = window_sums(W, valid, fit)
    known = np.isfinite(np.asarray(fit.theta)).all(axis=1) & (np.asarray(fit.stderr) > 0).all(axis=1)
    known &= _well_conditioned(sums.gram)
    if not known.any():
        return fit
    theta, stderr = np.array(fit.theta), np.array(fit.stderr)
    if noisy is not None:
        theta[known], stderr[known] = _without_noise(theta[known], stderr[known], _some(sums, known), noisy, valid)
    if apart is not None:
        moved, variance = _without_change(theta, stderr, sums, known, apart, _share_of_distance(fit, apart))
        theta, stderr = theta - moved, np.sqrt(stderr**2 + variance)
    return eqx.tree_at(lambda f: (f.theta, f.stderr), fit, (theta, stderr))


def _well_conditioned(gram: Numbers) -> NDArray[np.bool_]:
    """(M,) whether columns are there and independent, in any units."""
    size = np.sqrt(np.einsum("kii->ki", gram))
    there = (size > 0).all(axis=1) & np.isfinite(size).all(axis=1)
    size = np.where(there[:, None], size, 1)
    return np.asarray(there & (np.linalg.eigvalsh(gram / (size[:, :, None] * size[:, None]))[:, 0] > DEPENDENT))


def _share_of_distance(fit: SlidingFit, apart: int) -> float:
    """How long a window is, as a share of the distance to the next one that shares no rows with it."""
    first, last = np.asarray(fit.first), np.asarray(fit.last)
    return float((last[0] + 1 - first[0]) / (first[apart] - first[0])) if len(first) > apart else 1.0


def _some(sums: Sums, which: NDArray[np.bool_]) -> Sums:
    return Sums(*(x[which] for x in sums))


def _without_noise(
    theta: Numbers, stderr: Numbers, sums: Sums, noisy: AnyArray, valid: AnyArray
) -> tuple[Numbers, Numbers]:
    """Errors in variables: estimates (K, p) and their standard errors."""
    N = np.where(np.asarray(valid)[..., None], noisy, 0).reshape(-1, theta.shape[1])
    of_noise = N.T @ N / max(float(np.asarray(valid).sum()), 1.0)
    if not of_noise.any():
        return theta, stderr
    size = np.sqrt(np.einsum("kii->ki", sums.gram))
    scale = size[:, :, None] * size[:, None]
    gram, noise = sums.gram / scale, sums.rows[:, None, None] * of_noise / scale
    inverse = np.linalg.inv(gram)
    # Noise beyond what can be corrected is left: the rules refuse such windows.
    share = np.linalg.eigvals(inverse @ noise).real.max(axis=1, initial=0.0)
    noise = np.where((share < LEAST_LEFT)[:, None, None], noise, 0)
    without = np.linalg.inv(gram - noise)
    found = (without @ (gram @ (theta * size)[..., None]))[..., 0] / size
    variance, plain = (np.einsum("kii->ki", x) for x in (without @ gram @ without, inverse))
    grown = stderr**2 * np.maximum(variance / plain, 1)
    return found, np.sqrt(grown + (UNSURE * (found - theta)) ** 2)


def _without_change(
    theta: Numbers, stderr: Numbers, sums: Sums, known: NDArray[np.bool_], apart: int, share: float
) -> tuple[Numbers, Numbers]:
    """(M, p) by how much a steady change inside moves estimates from the mean over their windows, and its variance.

    The change is that between the windows on both sides, which share no rows with the one between.
    """
    change, variance = changes_between(theta, stderr, known, apart)
    mixing = np.zeros_like(sums.gram)
    size = np.sqrt(np.einsum("kii->ki", sums.gram[known]))
    scale = size[:, :, None] * size[:, None]
    mixing[known] = np.linalg.solve(sums.gram[known] / scale, sums.moment[known] / scale)
    mixing[known] *= size[:, None] / size[:, :, None]
    mixing *= share
    return np.einsum("kij,kj->ki", mixing, change), np.einsum("kij,kj->ki", mixing**2, variance)


def changes_between(theta: Numbers, stderr: Numbers, known: NDArray[np.bool_], apart: int) -> tuple[Numbers, Numbers]:
    """(M, p) change of every parameter from one window to the next that shares no rows with it, and its variance, from
    the windows on both sides; zero where there are none."""
    place = np.arange(len(theta))
    before, after = place - apart, place + apart
    has_before, has_after = before >= 0, after < len(theta)
    before, after = before.clip(0), after.clip(max=len(theta) - 1)
    has_before &= known[before] & known & (stderr[before] < SURE * stderr).all(axis=1)
    has_after &= known[after] & known & (stderr[after] < SURE * stderr).all(axis=1)
    value, square = np.where(known[:, None], theta, 0), np.where(known[:, None], stderr**2, 0)
    earlier, later = value - value[before], value[after] - value
    earlier_square, later_square = square + square[before], square + square[after]
    both, first, last = has_before & has_after, has_after & ~has_before, has_before & ~has_after
    change, variance = np.zeros_like(value), np.zeros_like(value)
    change[both] = (earlier + later)[both] / 2
    bend = (later - earlier) ** 2 - square[before] - square[after] - 4 * square
    variance[both] = ((square[before] + square[after] + np.maximum(bend, 0)) / 4)[both]
    for only, step, step_square in ((first, later, later_square), (last, earlier, earlier_square)):
        change[only], variance[only] = step[only], step_square[only]
    return change, variance
