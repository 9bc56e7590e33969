"""What recorders and sensors do to samples: glitches, values at a limit, values that are held. Plain numpy, on samples
as they were measured, before anything is interpolated or filtered."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaximp.signals.samples import jumps, noise_level, quantisation_step
from jaximp.types import Numbers

LONGEST_GLITCH, SIDE = 6, 3
"""Samples from the first to the last of a glitch (of more than three those between may be good), and how far beside it
the signal must be smooth."""
STANDS_OUT, SMOOTH = 20.0, 6.0
"""A glitch is so many times the noise from its neighbours, and so many times as far as these are from each other."""
CROWDED, FEWEST_CROWDED = 2.0, 10
"""So many times the samples of the band below may crowd at a limit. (At a turning point it is up to 2.4 times.)"""
EXACT = 5
"""Values that repeat to the last digit at the end of a signal's range and nowhere else."""
MOTION_CUTOFF = 20.0
"""Of the motion that the torque at a limit is predicted from [Hz]."""


def glitches(x: Numbers, noise: float | None = None) -> NDArray[np.bool_]:
    """Single samples, up to three in a row or two near each other, that stand out from neighbours that are smooth (N,).

    A transmission error, a sentinel such as -999, a lost value written as 0. Both ends of a glitch are far from the
    cubic through two good samples on either side, farther than that cubic is from a straight line and than samples
    beside it are from cubics of their own. `noise` is the `noise_level`, where it is known.
    """
    known = np.flatnonzero(np.isfinite(x))
    z, out = x[known], np.zeros(len(x), bool)
    margin = SIDE + 3
    if len(z) < 2 * margin + LONGEST_GLITCH:
        return out
    level = noise_level(z) if noise is None else noise
    rough = np.zeros(len(z))
    rough[2:-2] = np.abs(z[2:-2] - (4 * (z[1:-3] + z[3:-1]) - z[:-4] - z[4:]) / 6)
    suspected = np.flatnonzero(rough > STANDS_OUT * max(level, np.finfo(float).tiny))
    found = np.zeros(len(z), bool)
    for m in range(1, LONGEST_GLITCH + 1):
        first = suspected[(suspected >= margin) & (suspected < len(z) - m - margin)]
        run = first[:, None] + np.arange(m)
        off, bend = _from_cubic(z, first, m)
        # Between two levels every sample lies on one of them.
        levels = np.abs(z[run[:, [0, -1]], None] - z[first[:, None, None] + np.array([-1, m])]).min(axis=(1, 2))
        beside = rough[first[:, None] + np.r_[-3 - np.arange(SIDE), m + 2 + np.arange(SIDE)]].max(axis=1)
        ends = np.minimum(off[:, 0], off[:, -1])
        wrong = (
            (ends > STANDS_OUT * level)
            & (ends > SMOOTH * np.maximum(bend, beside))
            & (levels > 0.5 * ends)
            & ~found[run].any(axis=1)
        )
        if m > 3:
            wrong &= off[:, 1:-1].max(axis=1) < 0.3 * ends
        found[run[wrong]] = True
    out[known[found]] = True
    return out


def _from_cubic(z: Numbers, first: NDArray[np.int64], m: int) -> tuple[Numbers, Numbers]:
    """(K, m) distances of runs from the cubic through two samples on either side, and (K,) of that from a line."""
    cubic_weights, line_weights = _weights(m)
    around = z[first[:, None] + np.array([-2, -1, m, m + 1])]
    cubic, line = around @ cubic_weights, around @ line_weights
    return np.abs(z[first[:, None] + np.arange(m)] - cubic), np.abs(cubic - line).max(axis=1)


@lru_cache(maxsize=LONGEST_GLITCH)
def _weights(m: int) -> tuple[Numbers, Numbers]:
    """(4, m) of the samples at -2, -1, m and m + 1: Lagrange's polynomials, and a straight line."""
    nodes, inside = np.array([-2.0, -1, m, m + 1]), np.arange(m)
    cubic = np.array([
        np.prod([(inside - other) / (node - other) for other in nodes if other != node], axis=0) for node in nodes
    ])  # fmt: skip
    share = (inside + 1) / (m + 1)
    return cubic, np.stack([np.zeros(m), 1 - share, share, np.zeros(m)])


class Limit(NamedTuple):
    """A limit that a torque ran into."""

    value: float
    at: NDArray[np.bool_]
    """(N,) samples that lie there."""


def torque_limits(
    torque: Numbers, position: Numbers, sample_rate: float, noise: float | None = None
) -> tuple[Limit, ...]:
    """Limits at which a torque (N,) was cut off while the joint at `position` (N,) would have asked for more.

    Samples crowd at the end of a range that is cut off, also where noise was added behind the limit; so they do where a
    joint is held, or accelerates evenly. The torque that linear dynamics, found from all other samples, predicts for
    them tells: beyond the limit it was cut off.
    """
    level = noise_level(torque) if noise is None else noise
    step = quantisation_step(torque)
    ends = ((sign, _crowd(sign * torque, level, step)) for sign in (1, -1))
    crowds = [(sign, at) for sign, at in ends if at is not None]
    if not crowds:
        return ()
    free = np.isfinite(torque) & np.isfinite(position) & ~np.any([at for _, at in crowds], axis=0)
    columns = _linear_dynamics(position, sample_rate)
    if free.sum() < 4 * columns.shape[1]:
        return ()
    theta = np.linalg.lstsq(columns[free], torque[free])[0]
    left, found = torque - columns @ theta, []
    scatter = left[free].std()
    for sign, at in crowds:
        beyond = -sign * left[at & np.isfinite(left)]
        if np.mean(beyond > 0) > 0.6 and beyond.mean() > 0.5 * scatter:
            found.append(Limit(float(np.median(torque[at])), at))
    return tuple(found)


def _crowd(x: Numbers, level: float, step: float) -> NDArray[np.bool_] | None:
    """(N,) samples that crowd at the upper end of the range, in the band that shows it best; None where none do."""
    top = float(np.nanmax(x))
    below = top - x
    span = float(np.nanmax(below))
    exact = below <= 1e-9 * span
    if step == 0 and exact.sum() >= EXACT:
        return exact
    width = max(1.01 * step, 1e-3 * span)
    most, best, widest = 0, 0.0, min(max(8 * level, width), 0.2 * span)
    while width <= widest:
        first = int((below < width).sum())
        second = int((below < 2 * width).sum()) - first
        if first >= FEWEST_CROWDED and first > CROWDED * max(second, 1) and first - second > most:
            most, best = first - second, width
        width *= 1.3
    return below < best if best else None


def _linear_dynamics(position: Numbers, rate: float) -> Numbers:
    """(N, 5) columns of a smoothed motion that does not jump, and of friction."""
    from scipy.signal import butter, sosfiltfilt

    known = np.isfinite(position)
    q = np.interp(np.arange(len(position)), np.flatnonzero(known), position[known])
    leaps = jumps(q)
    q = np.cumsum(np.where(leaps & np.roll(leaps, 1), 0, np.diff(q, prepend=q[0])))
    q = sosfiltfilt(butter(2, min(MOTION_CUTOFF, rate / 8), fs=rate, output="sos"), q)
    dq = np.gradient(q, 1 / rate)
    ddq = np.gradient(dq, 1 / rate)
    return np.stack([np.ones_like(q), q, dq, ddq, np.sign(dq)], axis=1)


def held_for(x: Numbers) -> int:
    """For how many samples a recorder holds each value of a slower signal (N,); 1 where it does not.

    A slow encoder repeats values as well, but not for whole multiples of one number of samples.
    """
    changes = np.flatnonzero(np.diff(x[np.isfinite(x)]) != 0)
    between = np.diff(changes)
    if len(between) < 20 or not (between > 1).all():
        return 1
    k = int(np.bincount(between).argmax())
    return k if np.mean(between % k == 0) > 0.98 else 1
