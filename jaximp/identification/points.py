"""Where estimates stand: in windows, or at the points of a path, beside each of which stands what a window measures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import numpy as np
from numpy.typing import NDArray

from jaximp.identification.pipeline import Pipeline
from jaximp.identification.rows import Rows
from jaximp.identification.solving import Placement, Solved
from jaximp.identification.whitening import White
from jaximp.least_squares.window import SlidingFit
from jaximp.tracking.paths import track
from jaximp.tracking.results import Path, Track
from jaximp.trust.changes import Course
from jaximp.types import AnyArray, Numbers

STILL = 1e-3
"""A window whose torque varies by a smaller share of the recording's variance can neither confirm nor refute."""
SURELY, MOST_LEVELS = 0.95, 5
"""How probable it is that a parameter moves which is said to, and of how few levels all are named."""
FLAT = 0.1
"""What moves less between jumps, as a share of all its change, has levels."""
DIES_OUT = 2.0
"""Periods of its cut-off in which a low-pass's answer dies out."""
UNEXPLAINED = 4.0
"""A row near a jump that is off by more standard deviations of the noise is no fair sample of either side."""


@dataclass(frozen=True)
class Followed:
    """A path of the parameters of one recording."""

    track: Track
    """Of white rows."""
    mixed: NDArray[np.bool_]
    """(N,) rows in which a parameter jumps, as far as filters blur that."""
    own: Numbers
    """(M, p) what white rows alone make of the standard errors of windows. What their errors hold beyond it, such as
    those of a robot, the path's hold too."""


@dataclass(frozen=True)
class Points:
    """M estimates in a recording, and the torque that they explain at K of its rows."""

    fit: SlidingFit
    window: NDArray[np.int64]
    """(M,) which window each of them is, or stands in."""
    held_out: Numbers
    """(M,) how they predict what they have not seen; NaN where that hardly has a torque."""
    apart: int
    """Estimates so far from each other share no rows."""
    shown: NDArray[np.int64]
    """(K,) which rows."""
    reconstructed: Numbers
    """(K, n) the model's torque with the parameters around each row."""
    predicted: Numbers
    """(K, n) with parameters that have not seen it."""
    tracks: tuple[Track, ...] = ()


def points_of_windows(rows: Rows, fit: SlidingFit, solved: Solved, place: Placement, curves: bool) -> Points:
    """Windows as they are. **Arguments:** `curves` whether the torque over time is wanted."""
    starts = place.starts[: len(fit.last)]
    reconstructed, predicted, shown = _reconstruct(rows, fit, starts, place, curves)
    held_out = np.where(_moving(solved), np.asarray(solved.unseen.vaf), np.nan)
    return Points(fit, np.arange(len(starts)), held_out, windows_apart(place), shown, reconstructed, predicted)


def windows_apart(place: Placement) -> int:
    """Windows so far from each other share no rows."""
    if place.separate:
        return max(1, int(place.next_starts[0] // place.window))
    return -(-place.window // place.step)


def _moving(solved: Solved) -> NDArray[np.bool_]:
    """(M,) behind which windows there is a torque."""
    return np.asarray(np.asarray(solved.unseen.variance) > STILL * solved.moments.torque)


def rows_between(pipeline: Pipeline, every: int) -> int:
    """Rows from one point of the path to the next: a multiple of those that say something new."""
    assert pipeline.track is not None
    apart = pipeline.track.grid * pipeline.sample_rate / pipeline.filters.decimate
    return every * max(1, round(apart / every))


def follow(
    pipeline: Pipeline, white: White, valid: Any, names: Sequence[str], units: Sequence[str], still: Sequence[bool]
) -> tuple[Track, NDArray[np.bool_]]:
    """The path of parameters along white rows, and which of the rows (N,) are a mixture: a parameter jumps in them.

    **Arguments:** `valid` (N, *n); names and units of the columns (p), and which are `still`: stay where they are.
    """
    settings, every = pipeline.track, white.every
    assert settings is not None
    rate, apart = pipeline.sample_rate / pipeline.filters.decimate, rows_between(pipeline, every)
    W, torque, counts = (np.asarray(x)[::every] for x in (white.W, white.torque, valid))
    look = partial(
        track,
        W,
        torque,
        grid=apart / rate,
        sample_rate=rate / every,
        drift=np.where(still, 0.0, np.nan),
        jumps=settings.jumps,
        names=names,
        units=units,
    )
    found = look(valid=counts)
    reach = 0.0 if pipeline.filter.decimation_cutoff is None else DIES_OUT / pipeline.filter.decimation_cutoff
    reach += max(noise.order for noise in (white.filtered, *white.noise)) * every / rate
    point = np.minimum(np.arange(len(W)) // (apart // every), len(found.time) - 1)
    near = _near_jumps(found, reach)[point]
    left = np.abs(torque - np.einsum("k...p,kp->k...", W, found.value[point])) / found.noise
    blurred = near.reshape(-1, *(1,) * (left.ndim - 1)) & (left > UNEXPLAINED)
    if blurred.any():
        found = look(valid=counts & ~blurred)
    mixed = np.repeat(near & blurred.any(), every)[: len(white.torque)]
    grown = np.outer(white.inflation, white.inflation)
    paths = (Path(path.theta, np.asarray(path.covariance) * grown) for path in (found.path, found.filtered))
    return eqx.tree_at(lambda t: (t.path, t.filtered), found, tuple(paths)), mixed


def _near_jumps(found: Track, reach: float) -> NDArray[np.bool_]:
    """(G,) points that are a mixture of before and behind a jump: those in which it may lie, and as far as filters
    reach [s]."""
    time = np.asarray(found.time)
    near = np.zeros(len(time), bool)
    for name in found.names:
        for jump in found.jumps(name):
            near |= np.abs(time - jump.time) <= reach + (time[1] - time[0])
    return near


def part_of(found: Track, columns: Sequence[int], names: Sequence[str], units: Sequence[str], less: Numbers) -> Track:
    """Some parameters of a path, less what is known to be another's.

    **Arguments:** `columns` (h,) of the path, with their new names and units; `less` (h,).
    """
    which = np.asarray(columns)

    def some(path: Path) -> Path:
        covariance = np.asarray(path.covariance)[:, which[:, None], which]
        return Path(np.asarray(path.theta)[:, which] - less, covariance)

    drift = eqx.tree_at(lambda d: d.size, found.drift, np.asarray(found.drift.size)[:, which])
    changed = (some(found.path), some(found.filtered), np.asarray(found.jumped)[:, which], drift)
    found = eqx.tree_at(lambda t: (t.path, t.filtered, t.jumped, t.drift), found, changed)
    return replace(found, names=tuple(names), units=tuple(units))


def points_of_path(
    rows: Rows, windows: SlidingFit, moved: Numbers, solved: Solved, place: Placement, followed: Followed, curves: bool
) -> Points:
    """The points of a path, and what the windows around them measure.

    **Arguments:** `windows` with all that their errors hold; `moved` (M, p), by how much noise of the position is known
    to move estimates; `solved` of the windows.
    """
    found, n_rows = followed.track, len(rows.time)
    apart = round((found.time[1] - found.time[0]) / (rows.time[1] - rows.time[0])) if len(found.time) > 1 else n_rows
    first = apart * np.arange(len(found.time))
    last = np.minimum(first + apart, n_rows) - 1
    middle = (first + last) / 2
    around = _nearest(place.starts[: len(windows.last)] + (place.window - 1) / 2, middle)
    more = np.maximum(np.asarray(windows.stderr) ** 2 - followed.own**2, 0)
    pooled = _pooled(followed.own, found.path.stderr, around, windows_apart(place))
    moved, more = pooled(moved), pooled(more)
    whole, causal = (with_more(path, moved, more) for path in (found.path, found.filtered))
    found = eqx.tree_at(lambda t: (t.path, t.filtered, t.time), found, (whole, causal, found.time + rows.time[0]))
    theta, ahead = np.asarray(whole.theta), np.asarray(causal.theta)
    before = np.concatenate([np.full_like(ahead[:1], np.nan), ahead[:-1]])
    before[first < place.window] = np.nan  # a filter that has seen nothing yet predicts nothing
    point = np.minimum(np.arange(n_rows) // apart, len(theta) - 1)
    reconstructed, predicted = (np.einsum("k...p,kp->k...", np.asarray(rows.W), x[point]) for x in (theta, before))
    of_windows = _Stretches(rows, ~followed.mixed[:n_rows], place, len(windows.last))
    explained, left = of_windows.explained(reconstructed)
    unseen = of_windows.explained(predicted)[0]
    unseen = np.where(of_windows.variance > STILL * solved.moments.torque, unseen, np.nan)
    fit = jax.tree.map(lambda x: np.asarray(x)[around], windows)
    freedom = np.full(len(theta), max(float(np.asarray(rows.valid).sum()) - theta.shape[1], 1.0))
    fit = eqx.tree_at(
        lambda f: (f.theta, f.stderr, f.dof, f.vaf, f.residual_rms, f.first, f.last),
        fit,
        (theta, np.asarray(whole.stderr), freedom, explained[around], left[around], first, last),
    )
    shown = np.arange(n_rows if curves else 0)
    reconstructed, predicted = (x.reshape(n_rows, -1)[shown] for x in (reconstructed, predicted))
    separate = -(-place.window // apart)
    return Points(fit, around, unseen[around], separate, shown, reconstructed, predicted, (found,))


def courses(track: Track, trusted: NDArray[np.bool_]) -> tuple[dict[str, Course], tuple[str, ...]]:
    """Parameters that surely move, in levels where they only jump; and those that surely do not.

    **Arguments:** which points (M,) are `trusted`.
    """
    found: dict[str, Course] = {}
    theta, time = np.where(trusted[:, None], track.value, np.nan), np.asarray(track.time)
    for k, name in enumerate(track.names):
        p, jumps, known = track.moves(name), track.jumps(name), np.isfinite(theta[:, k])
        if p < SURELY or not known.any():
            continue
        parts = np.searchsorted([jump.time for jump in jumps], time)
        levels = [theta[known & (parts == part), k] for part in range(len(jumps) + 1)]
        ends = [np.quantile(level, [0.05, 0.95]) if len(level) else np.array([0, np.inf]) for level in levels]
        flat = all(np.ptp(end) < FLAT * np.ptp(theta[known, k]) for end in ends)
        if jumps and flat and len(jumps) < MOST_LEVELS:
            values, at = tuple(float(np.median(level)) for level in levels), tuple(jump.time for jump in jumps)
        else:
            values, at = (float(theta[known, k].min()), float(theta[known, k].max())), ()
        found[name] = Course(values, at, track.units[k], f"probability {p:.3g}")
    return found, tuple(name for name in track.names if track.moves(name) < 1 - SURELY)


def _pooled(own: Numbers, stderr: AnyArray, around: NDArray[np.int64], apart: int) -> Callable[[Numbers], Numbers]:
    """What takes values of windows (M, p) to points of a path (G, p): means over so many windows around each as know
    together what the path knows of a parameter there, by what each of them knows.

    **Arguments:** `own` (M, p) standard errors of windows, `stderr` (G, p) of the path; `around` (G,) the window at
    each point; windows `apart` of each other share no rows.
    """
    known = np.where(np.isfinite(own) & (own > 0), 1 / np.maximum(own, np.finfo(float).tiny) ** 2, 0) / apart
    wanted = 1 / np.maximum(np.asarray(stderr), np.finfo(float).tiny) ** 2
    low, high = around[:, None].repeat(own.shape[1], axis=1), around[:, None].repeat(own.shape[1], axis=1) + 1
    columns, total = np.arange(own.shape[1]), np.concatenate([np.zeros((1, own.shape[1])), np.cumsum(known, axis=0)])
    half = 1
    while (less := total[high, columns] - total[low, columns] < wanted).any() and half < 2 * len(own):
        low = np.where(less, np.maximum(around[:, None] - half, 0), low)
        high = np.where(less, np.minimum(around[:, None] + half + 1, len(own)), high)
        half *= 2

    def mean(values: Numbers) -> Numbers:
        sums = np.concatenate([np.zeros((1, own.shape[1])), np.cumsum(known * np.nan_to_num(values), axis=0)])
        weight = total[high, columns] - total[low, columns]
        found = (sums[high, columns] - sums[low, columns]) / np.where(weight > 0, weight, 1)
        return np.asarray(np.where(weight > 0, found, 0))

    return mean


def with_more(path: Path, moved: Numbers, more: Numbers) -> Path:
    """A path moved by so much (G, p), with variances larger by `more` (G, p)."""
    p = np.shape(path.theta)[1]
    return Path(np.asarray(path.theta) + moved, np.asarray(path.covariance) + more[:, None] * np.eye(p))


def _nearest(values: NDArray[Any], to: NDArray[Any]) -> NDArray[np.int64]:
    """(M,) which of these values, in order, is nearest to each."""
    behind = np.searchsorted(values, to).clip(0, len(values) - 1)
    before = (behind - 1).clip(0)
    return np.asarray(np.where(np.abs(to - values[before]) <= np.abs(values[behind] - to), before, behind))


class _Stretches:
    """Sums over the rows of windows that are `fair`, of one output or several together."""

    def __init__(self, rows: Rows, fair: NDArray[np.bool_], place: Placement, count: int) -> None:
        self.start, self.window = place.starts[:count], place.window
        self.torque, self.valid = np.asarray(rows.torque), np.asarray(rows.valid)
        self.valid = self.valid & fair.reshape(-1, *(1,) * (self.valid.ndim - 1))
        self.variance = self._variance(self.torque)[0]
        """(M,) of the torque."""

    def _mean(self, x: Numbers) -> Numbers:
        def over(z: Numbers) -> Numbers:
            total = np.concatenate([[0.0], np.cumsum(z.reshape(len(z), -1).sum(axis=1))])
            return np.asarray(total[self.start + self.window] - total[self.start])

        with np.errstate(invalid="ignore", divide="ignore"):
            return over(np.where(self.valid, x, 0)) / over(self.valid.astype(float))

    def _variance(self, x: Numbers) -> tuple[Numbers, Numbers]:
        """(M,) variance, and mean square; NaN where there is no row, or one that is not known."""
        seen = self.valid & np.isfinite(x)
        middle = float(x[seen].mean()) if seen.any() else 0.0
        unknown = self._mean(np.isnan(x).astype(float)) > 0
        x = np.nan_to_num(x - middle)
        square, mean = self._mean(x**2), self._mean(x)
        blank = np.where(unknown, np.nan, 0.0)
        return np.maximum(square - mean**2, 0) + blank, square + 2 * middle * mean + middle**2 + blank

    def explained(self, model: Numbers) -> tuple[Numbers, Numbers]:
        """(M,) share of the torque's variance that the model's torque explains, and root mean square of the rest."""
        variance, square = self._variance(self.torque - model)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(self.variance > 0, 1 - variance / self.variance, np.nan), np.sqrt(np.maximum(square, 0))


def _reconstruct(
    rows: Rows, fit: SlidingFit, starts: NDArray[np.int64], place: Placement, wanted: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """The model's torque with seen and unseen parameters, and which rows it is shown for."""
    W, theta = np.asarray(rows.W), np.asarray(fit.theta)
    times, window = rows.time, place.window
    if not wanted:
        none = np.empty((0, int(np.prod(W.shape[1:-1]))))
        return none, none, np.empty(0, np.int64)
    if place.separate:  # windows hold copies of the same samples: show each sample once, from non-overlapping windows
        chosen, end = [], -np.inf
        for k, first in enumerate(starts):
            if times[first] > end:
                chosen.append(k)
                end = times[first + window - 1]
        shown = np.concatenate([np.arange(starts[k], starts[k] + window) for k in chosen])
        around = np.repeat(chosen, window)
        unseen = np.repeat([-1, *chosen[:-1]], window)
    else:
        shown = np.arange(len(W))
        around = np.searchsorted(starts + window / 2, shown).clip(0, len(starts) - 1)
        unseen = np.searchsorted(starts + window, shown - shown % window, side="right") - 1
    reconstructed = np.einsum("k...p,kp->k...", W[shown], theta[around])
    predicted = np.einsum("k...p,kp->k...", W[shown], theta[unseen])
    predicted[unseen < 0] = np.nan
    return reconstructed.reshape(len(shown), -1), predicted.reshape(len(shown), -1), shown
