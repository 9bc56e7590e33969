"""Whether estimates depend on the frequency: each parameter in bands of equal excitation, over all windows at once.

A window's white rows are turned into as many cosines, which keeps their noise white and the model linear: any set of
frequencies gives an estimate without bias. What a window's own parameters leave is what bands can differ by, so that a
change from window to window does not pass for a dependence on the frequency.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from jaximp.least_squares.disjoint import DisjointFit, fit_disjoint
from jaximp.trust.score_tests import FAMILYWISE, FEWEST_COMPARED, SHARE, with_say
from jaximp.types import Numbers

BANDS = 4
"""Bands of frequencies with an equal share of the excitation."""
LEAST = 0.1
"""Share of the excitation of a band; what has less goes to its neighbour."""
ENDS = 0.03
"""Share of the excitation that is left out at either end where a band is drawn."""
LOST = 1e-9
"""A direction of a band's columns with a smaller share of their squares is not determined."""


@dataclass(frozen=True)
class ByFrequency:
    """Estimates of k parameters of one joint in B bands of frequencies, beside those of the whole windows."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    edges: Numbers
    """(B + 1,) of the bands [Hz]."""
    middle: Numbers
    """(B,) half of a band's excitation lies below [Hz]."""
    value: Numbers
    """(B, k) mean over the windows, NaN where the band does not determine the parameter."""
    stderr: Numbers
    """(B, k), which does not grow where the parameter changes from window to window."""
    dof: float
    """Degrees of freedom of the standard errors."""
    ordinary: Numbers
    """(k,) mean over the same windows, by least squares of the rows as they were filtered."""
    generalised: Numbers
    """(k,) the same of white rows."""
    p: Numbers
    """(k,) probability of differences between the bands as large as these where there are none; NaN where fewer than
    two bands determine the parameter."""

    def interval(self, level: float = 0.95) -> tuple[Numbers, Numbers]:
        """(B, k) lower and upper ends of the intervals that hold the truth with probability `level`."""
        from scipy.special import stdtrit

        half = stdtrit(self.dof, 0.5 + level / 2) * self.stderr
        return self.value - half, self.value + half

    def of_joint(self, j: int) -> ByFrequency:
        """With the names that the parameters have beside those of other joints."""
        return replace(self, names=tuple(f"joint{j + 1}.{name}" for name in self.names))

    def depends(self, k: int) -> bool:
        """Whether a parameter differs between bands beyond error, of all of them together, and by a share that
        matters."""
        known = self.value[np.isfinite(self.value[:, k]), k]
        return bool(self.p[k] < FAMILYWISE / len(self.p) and np.ptp(known) > SHARE * abs(self.generalised[k]))


def estimate_by_frequency(
    white: tuple[Numbers, Numbers],
    filtered: tuple[Numbers, Numbers],
    valid: NDArray[np.bool_],
    window: int,
    every: int,
    row_rate: float,
    parameters: dict[int, tuple[str, str]],
    largest_error: float,
    inflation: Numbers | None = None,
) -> ByFrequency | None:
    """Split the excitation into `BANDS`, and estimate the parameters in each of them.

    **Arguments:** `white` and `filtered` columns (N, p) and torque (N,), in rows whose noise is white and as they were
    filtered; `valid` (N,); `window` rows side by side, of which `every` neighbours say as much as one; `row_rate` [Hz];
    `parameters`, name and unit of those that may differ between the bands, by column; `largest_error`, as a share of a
    parameter, with which a band determines it; `inflation` (p,) by what the windows' standard errors grow.

    **Returns:** None where fewer than `FEWEST_COMPARED` windows are excited, which are cut into shorter ones where they
    are too few, or a single frequency excites them.

    **Source:** band spectrum regression, Engle 1974; errors from leaving out one window after the other;
    differences between bands by Hotelling's test.
    """
    (W, y), as_filtered = ((np.where(valid[:, None], W, 0), np.where(valid, y, 0)) for W, y in (white, filtered))
    fit = fit_disjoint(W, y, valid, window)
    chosen = with_say(fit, every)
    if 0 < len(chosen) < FEWEST_COMPARED:
        window //= -(-FEWEST_COMPARED // len(chosen))
        fit = fit_disjoint(W, y, valid, window)
        chosen = with_say(fit, every)
    count = len(chosen)
    if count < FEWEST_COMPARED:
        return None
    shown = np.array(list(parameters))
    scale = fit.rss[chosen] / (fit.rows[chosen] - every * W.shape[1])
    columns, residual = _cosines(_cut(W, window)[chosen], fit.residual[chosen], scale, every)
    step = row_rate / every / (2 * columns.shape[1])
    squares = (columns[..., shown] ** 2).sum(axis=(0, 2))
    excitation = (squares / squares.sum(axis=0)).mean(axis=1)
    cumulated = np.cumsum(excitation)
    bands = _split(excitation)
    if bands[-1] == 0:
        return None

    own = _parameters(fit, W, y)[chosen][:, shown]
    ordinary = _parameters(fit_disjoint(*as_filtered, valid, window), *as_filtered)[chosen][:, shown]
    errors = scale[:, None] * every * (fit.inverse[chosen][:, shown] ** 2).sum(axis=2)
    errors *= 1.0 if inflation is None else inflation[shown] ** 2
    whole = own.mean(axis=0)
    found = [_band(columns[:, bands == b][..., shown], residual[:, bands == b]) for b in range(bands[-1] + 1)]
    apart, influence, promised = (np.stack(x) for x in zip(*found, strict=True))
    # Not by the scatter, which is small by luck where few windows are: what is chosen for that would be too sure.
    known = every * promised <= (largest_error * whole) ** 2
    known &= np.isfinite(influence).all(axis=1)  # nor what a single window tells
    scatter = (1 - 1 / count) * (influence**2).sum(axis=1)
    # What is left of the windows says nothing of their own parameters: the errors of both add up (Hausman 1978).
    stderr = np.sqrt(scatter + errors.sum(axis=0) / count**2)
    edges, middle = _frequencies(cumulated, bands, step)
    return ByFrequency(
        names=tuple(name for name, _ in parameters.values()),
        units=tuple(unit for _, unit in parameters.values()),
        edges=edges,
        middle=middle,
        value=np.where(known, whole + apart, np.nan),
        stderr=np.where(known, stderr, np.nan),
        dof=count - 1.0,
        ordinary=ordinary.mean(axis=0),
        generalised=whole,
        p=np.array([_same(apart[known[:, k], k], influence[known[:, k], :, k]) for k in range(len(shown))]),
    )


def _split(excitation: Numbers) -> NDArray[np.int64]:
    """(F,) the band of each frequency, from its share in the excitation; of a few lines there are fewer bands."""
    band = np.minimum((BANDS * (np.cumsum(excitation) - excitation / 2)).astype(int), BANDS - 1)
    labels, label, filled = [], 0, 0.0
    for share in np.bincount(band, excitation, BANDS):
        labels.append(label)
        filled += share
        if filled >= LEAST:
            label, filled = label + 1, 0.0
    return np.minimum(labels, max(label - 1, 0))[band]


def _cut(x: Numbers, window: int) -> Numbers:
    """(K, S, ...) windows of (N, ...) rows."""
    count = len(x) // window
    return x[: count * window].reshape(count, window, *x.shape[1:])


def _parameters(fit: DisjointFit, W: Numbers, y: Numbers) -> Numbers:
    """(K, p) of every window."""
    torque = _cut(y, fit.residual.shape[1])[..., None]
    return (fit.inverse @ (fit.orthonormal(W).swapaxes(1, 2) @ torque))[..., 0]


def _cosines(columns: Numbers, residual: Numbers, scale: Numbers, every: int) -> tuple[Numbers, Numbers]:
    """Columns (K, F, every, p) and residuals (K, F, every) of K windows at F frequencies, divided by their noise, whose
    variance is `scale` (K,)."""
    from scipy.fft import dct

    windows, rows, p = columns.shape
    behind = -rows % every
    z = np.concatenate([columns, residual[..., None]], axis=2) / np.sqrt(scale)[:, None, None]
    z = np.pad(z, ((0, 0), (0, behind), (0, 0))).reshape(windows, -1, every, p + 1)
    found = dct(z, axis=1, norm="ortho")
    return found[..., :-1], found[..., -1]


def _band(columns: Numbers, residual: Numbers) -> tuple[Numbers, Numbers, Numbers]:
    """(k,) by how much the parameters in a band differ from the windows' own, (K, k) by how much that changes without
    each of the windows, and (k,) the variance that white noise alone would give; NaN or infinite where the columns that
    are left do not tell."""
    gram = np.einsum("kfea,kfeb->kab", columns, columns)
    score = np.einsum("kfea,kfe->ka", columns, residual)
    total = gram.sum(axis=0)
    inverse, without = _inverse(total), _inverse(total - gram)
    apart = inverse @ score.sum(axis=0)
    influence = (without @ (score - gram @ np.nan_to_num(apart))[..., None])[..., 0]
    return apart, influence, np.diagonal(inverse)


def _inverse(gram: Numbers) -> Numbers:
    """Of (..., k, k); NaN in the rows of what is not determined."""
    size = np.sqrt(np.diagonal(gram, axis1=-2, axis2=-1))
    size = np.where(size > 0, size, 1)
    values, vectors = np.linalg.eigh(gram / (size[..., :, None] * size[..., None, :]))
    kept = values > LOST
    found = (vectors * np.where(kept, 1 / np.where(kept, values, 1), 0)[..., None, :]) @ vectors.swapaxes(-1, -2)
    lost = ((np.abs(vectors) > LOST) & ~kept[..., None, :]).any(axis=-1)
    return np.where(lost[..., None], np.nan, found / (size[..., :, None] * size[..., None, :]))


def _same(apart: Numbers, influence: Numbers) -> float:
    """Hotelling's test that one parameter is the same in B bands; their differences (B,) and each window's share in
    them (B, K)."""
    from scipy.special import fdtrc

    count, contrasts = influence.shape[1], len(apart) - 1
    if contrasts < 1:
        return float("nan")
    difference, shares = np.diff(apart), np.diff(influence, axis=0)
    spread = (1 - 1 / count) * shares @ shares.T
    statistic = float(difference @ np.linalg.pinv(spread, hermitian=True) @ difference)
    freedom = count - contrasts
    return float(fdtrc(contrasts, freedom, statistic * freedom / ((count - 1) * contrasts)))


def _frequencies(cumulated: Numbers, bands: NDArray[np.int64], step: float) -> tuple[Numbers, Numbers]:
    """(B + 1,) edges and (B,) middles of the bands [Hz], from the excitation up to each frequency."""
    frequency = step * np.arange(len(bands))

    def at(share: float) -> float:
        return float(frequency[min(int(np.searchsorted(cumulated, share)), len(frequency) - 1)])

    first = np.flatnonzero(np.diff(bands)) + 1
    upto = cumulated[first - 1]
    inner = (frequency[first] + frequency[first - 1]) / 2
    ends = np.array([0.0, *upto, cumulated[-1]])
    edges = np.array([max(at(ENDS) - step / 2, step / 2), *inner, at(1 - ENDS) + step / 2])
    return edges, np.array([at(half) for half in (ends[1:] + ends[:-1]) / 2])
