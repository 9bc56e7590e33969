"""Whether a model lacks something: added columns, tested over all windows of a record at once.

Every window keeps parameters of its own; what is added has one weight in all of them. The weights, and what they do to
the parameters, are those of the fit with the added columns (Frisch, Waugh and Lovell), without fitting it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaximp.types import Numbers

FAMILYWISE = 0.01
"""Probability that good data fail any of the tests."""
ERRORS, SHARE = 2.0, 0.05
"""A parameter is off where it would move by so many errors of the move, and by such a share of itself."""
ALIKE = 0.85
"""A group that explains such a share of what the best one does looks like it."""
FEWEST_COMPARED = 6
"""Windows side by side whose estimates by ordinary and by generalised least squares are compared."""
STILL = 0.1
"""A window whose columns are excited by a smaller share of what is usual has no say."""
LOST = 1e-9
"""A direction of added columns with a smaller share of their squares is the model's already."""


@dataclass(frozen=True)
class Misfit:
    """What a group of added columns says of the model."""

    group: str
    p: float
    """Probability of a statistic as large as this where nothing is missing."""
    statistic: float
    """Chi-squared of the group."""
    evidence: float
    """That, less what as many idle columns would explain by Schwarz's criterion: groups of any size compare by it."""
    weights: Numbers
    """(g,) of the columns, on the mean over the windows."""
    move: Numbers
    """(p,) by how much the parameters would change, on the mean over the windows, if the columns were in the model."""
    stderr: Numbers
    """(p,) of that."""


class _Window(NamedTuple):
    """One window's fit."""

    part: NDArray[np.int64]
    Q: Numbers
    inverse: Numbers
    residual: Numbers
    scale: float
    weight: Numbers
    freedom: float
    excitation: Numbers


def score_groups(
    W: Numbers, y: Numbers, groups: Mapping[str, Numbers], valid: NDArray[np.bool_], window: int, every: int = 1
) -> list[Misfit]:
    """Test every group of added columns.

    **Arguments:** `W` (N, p) and `y` (N,) rows whose noise is white; `groups` of further columns (N, g) that went
    through the same filters; `valid` (N,); `window` rows side by side, of which `every` neighbours say as much as one.

    **Source:** score test with a covariance that knows nothing of the noise's size row by row (White 1980; residuals
    scaled by their leverage).
    """
    windows = _excited(list(_windows(W, y, valid, window, every)))
    found = (_test(name, columns, windows, every, W.shape[1]) for name, columns in groups.items())
    return [one for one in found if one is not None]


def _windows(W: Numbers, y: Numbers, valid: NDArray[np.bool_], window: int, every: int) -> Iterator[_Window]:
    p = W.shape[1]
    for first in range(0, len(y) - window + 1, window):
        part = first + np.flatnonzero(valid[first : first + window])
        freedom = len(part) / every - p
        if freedom < p:
            continue
        Q, R = np.linalg.qr(W[part])
        diagonal = np.abs(np.diagonal(R))
        residual = y[part] - Q @ (Q.T @ y[part])
        scale = float(residual @ residual) / (freedom * every)
        if diagonal.min() <= 1e-10 * diagonal.max() or scale <= 0:
            continue
        leverage = np.minimum((Q**2).sum(axis=1), 0.9)
        yield _Window(part, Q, np.linalg.inv(R), residual, scale, 1 / np.sqrt(1 - leverage), freedom, diagonal)


def _excited(windows: list[_Window]) -> list[_Window]:
    """Without those that move so little against the others that their parameters are free to go anywhere."""
    if not windows:
        return []
    usual = np.quantile([one.excitation for one in windows], 0.75, axis=0)
    return [one for one in windows if (one.excitation > STILL * usual).all()]


def _test(name: str, columns: Numbers, windows: Sequence[_Window], every: int, p: int) -> Misfit | None:
    from scipy.stats import f

    size = np.sqrt(sum((columns[one.part] ** 2).sum(axis=0) / one.scale for one in windows))
    columns = columns / np.where(size > 0, size, 1)
    g = columns.shape[1]
    gram, spread, score, passed = np.zeros((g, g)), np.zeros((g, g)), np.zeros(g), np.zeros((p, g))
    for one in windows:
        z = columns[one.part]
        within = one.Q.T @ z
        rest = z - one.Q @ within
        gram += rest.T @ rest / one.scale
        score += rest.T @ one.residual / one.scale
        rows = rest * (one.residual * one.weight / one.scale)[:, None]
        spread += rows.T @ rows * every
        passed += one.inverse @ within / len(windows)
    values, vectors = np.linalg.eigh(gram)
    kept = vectors[:, values > LOST * max(values[-1], np.finfo(float).tiny)] if len(windows) else vectors[:, :0]
    freedom, k = sum(one.freedom for one in windows), kept.shape[1]
    if not k or values[-1] < LOST or freedom <= 2 * k:
        return None
    gram, spread, score, passed = kept.T @ gram @ kept, kept.T @ spread @ kept, kept.T @ score, passed @ kept
    statistic = float(score @ np.linalg.solve(spread, score))
    inverse = np.linalg.inv(gram)
    covariance, weights = inverse @ spread @ inverse, inverse @ score
    return Misfit(
        group=name,
        p=float(f.sf(statistic / k, k, freedom - k)),
        statistic=statistic,
        evidence=statistic - k * np.log(freedom),
        weights=kept @ weights / np.where(size > 0, size, 1),
        move=-passed @ weights,
        stderr=np.sqrt(np.einsum("ij,jk,ik->i", passed, covariance, passed)),
    )


@dataclass(frozen=True)
class Bands:
    """Ordinary against generalised least squares, which weigh frequencies differently, over windows side by side."""

    ordinary: Numbers
    """(p,) mean over the windows."""
    generalised: Numbers
    """(p,)"""
    stderr: Numbers
    """(p,) of the difference."""
    p: Numbers
    """(p,) probability of a difference as large as this where the model is right at all frequencies."""

    def apart(self, k: int) -> bool:
        """Whether a parameter differs beyond error, of all of them together, and by a share that matters."""
        share = abs(self.ordinary[k] / self.generalised[k] - 1) if self.generalised[k] else 0.0
        return bool(self.p[k] < FAMILYWISE / len(self.p) and share > SHARE)


def compare_bands(ordinary: Numbers, generalised: Numbers) -> Bands | None:
    """Compare the estimates (K, p) of windows that share no rows; None for fewer than `FEWEST_COMPARED`.

    The error of the mean difference is that of its scatter between the windows: it needs no model of the noise, where
    the difference of two covariances does (Hausman 1978).
    """
    from scipy.stats import t

    known = np.isfinite(ordinary).all(axis=1) & np.isfinite(generalised).all(axis=1)
    ordinary, generalised = ordinary[known], generalised[known]
    count = len(ordinary)
    if count < FEWEST_COMPARED:
        return None
    difference = ordinary - generalised
    stderr = difference.std(axis=0, ddof=1) / np.sqrt(count)
    size = np.abs(difference.mean(axis=0)) / np.where(stderr > 0, stderr, np.inf)
    return Bands(ordinary.mean(axis=0), generalised.mean(axis=0), stderr, 2 * t.sf(size, count - 1))


def significant(tests: Sequence[Misfit], level: float = FAMILYWISE) -> list[Misfit]:
    """Those that good data would fail, in any of the tests, with a smaller probability than `level`; the best first.

    **Source:** Holm 1979.
    """
    ordered = sorted(tests, key=lambda one: one.p)
    found = []
    for k, one in enumerate(ordered):
        if one.p > level / (len(ordered) - k):
            break
        found.append(one)
    return sorted(found, key=lambda one: -one.evidence)
