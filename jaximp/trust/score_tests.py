"""Whether a model lacks something: added columns, tested over all windows of a record at once.

Every window keeps parameters of its own; what is added has one weight in all of them. The weights, and what they do to
the parameters, are those of the fit with the added columns (Frisch, Waugh and Lovell), without fitting it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaximp.least_squares.disjoint import DisjointFit, fit_disjoint
from jaximp.types import Numbers

FAMILYWISE = 0.01
"""Probability that good data fail any of the tests."""
ERRORS, SHARE = 2.0, 0.05
"""A parameter is off where it would move by so many errors of the move, and by such a share of itself."""
ALIKE = 0.85
"""A group that explains such a share of what the best one does looks like it."""
MOST_LEVERAGE = 0.9
"""Of a row that its window's parameters follow closely, by which its residual is scaled."""
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
    weights_stderr: Numbers
    """(g,)"""
    left: float = 0.0
    """Most evidence of another group that is significant with this one in the model; zero where this explains all."""
    ambiguity: float = 0.0
    """By what share parameters differ between torques at which a sensor's scale might be right: nothing tells which."""


class _Sums(NamedTuple):
    """Of all windows that have a say, and of G added columns less what the model's own say of them."""

    gram: Numbers
    """(G, G) of the columns."""
    spread: Numbers
    """(G, G) covariance of the scores, by the residuals of their own rows."""
    score: Numbers
    """(G,)"""
    passed: Numbers
    """(p, G) what a column adds to the parameters, on the mean over the windows."""
    size: Numbers
    """(G,) root of the sum of squares of the columns themselves."""
    freedom: float


def score_groups(
    W: Numbers,
    y: Numbers,
    groups: Mapping[str, Numbers],
    valid: NDArray[np.bool_],
    window: int,
    every: int = 1,
    fit: DisjointFit | None = None,
    moved_in: tuple[Numbers, Mapping[str, Numbers]] | None = None,
    beside: str = "",
) -> list[Misfit]:
    """Test every group of added columns.

    **Arguments:** `W` (N, p) and `y` (N,) rows whose noise is white; `groups` of further columns (N, g) that went
    through the same filters; `valid` (N,); `window` rows side by side, of which `every` neighbours say as much as one;
    `fit` of W and y in these windows, where it is known: rows that do not count are zero then, in all columns;
    `moved_in` columns (N, p) and groups in rows by which the parameters move, where these are not the white ones;
    `beside` a group that is in the model, and is not tested, where `y` is without what it explains.

    **Source:** score test with a covariance that knows nothing of the noise's size row by row (White 1980; residuals
    scaled by their leverage).
    """
    if fit is None:
        W, y = np.where(valid[:, None], W, 0), np.where(valid, y, 0)
        groups = {name: np.where(valid[:, None], columns, 0) for name, columns in groups.items()}
        fit = fit_disjoint(W, y, valid, window)
    sums = _sums(W, list(groups.values()), fit, every)
    if moved_in is not None:
        columns, others = moved_in
        passed = _passed(columns, [others[name] for name in groups], window, with_say(fit, every))
        sums = sums._replace(passed=passed)
    ends = np.cumsum([columns.shape[1] for columns in groups.values()]).tolist()
    places = {name: slice(*ends) for name, ends in zip(groups, zip([0, *ends], ends, strict=False), strict=True)}
    if beside:
        sums = _given(sums, places.pop(beside))
    found = [_test(name, sums, own) for name, own in places.items()]
    return [one for one in found if one is not None]


def added_weights(W: Numbers, columns: Numbers, fit: DisjointFit, every: int = 1) -> tuple[Numbers, Numbers, float]:
    """Weights (g,) of further columns (N, g) by one fit with parameters of their own in all windows, their covariance
    (g, g) and degrees of freedom; arguments as of `score_groups`. Where nothing tells them, the covariance is NaN."""
    sums, g = _sums(W, [columns], fit, every), columns.shape[1]
    size = np.where(sums.size > 0, sums.size, 1)
    gram = sums.gram / size / size[:, None]
    if sums.freedom <= g or np.linalg.eigvalsh(gram)[0] <= LOST:
        return np.zeros(g), np.full((g, g), np.nan), sums.freedom
    inverse = np.linalg.inv(gram) / size / size[:, None]
    return inverse @ sums.score, inverse @ sums.spread @ inverse, sums.freedom


def with_say(fit: DisjointFit, every: int) -> NDArray[np.int64]:
    """Windows that are determined, and move enough against the others that their parameters are not free to go
    anywhere."""
    p = fit.inverse.shape[1]
    sound = np.flatnonzero(fit.sound & (fit.rows / every - p >= max(p, 1)))
    if not len(sound):
        return sound
    usual = np.quantile(fit.excitation[sound], 0.75, axis=0)
    return sound[(fit.excitation[sound] > STILL * usual).all(axis=1)]


def _sums(W: Numbers, groups: Sequence[Numbers], fit: DisjointFit, every: int) -> _Sums:
    p, window, g = W.shape[1], fit.residual.shape[1], sum(columns.shape[1] for columns in groups)
    chosen = with_say(fit, every)
    freedom = fit.rows[chosen] / every - p
    scale = fit.rss[chosen] / (freedom * every)
    gram, spread, score, passed, size = np.zeros((g, g)), np.zeros((g, g)), np.zeros(g), np.zeros((p, g)), np.zeros(g)
    for k, variance in zip(chosen.tolist(), scale.tolist(), strict=True):
        Q, residual = fit.orthonormal(W, slice(k, k + 1))[0], fit.residual[k]
        z = np.concatenate([columns[k * window : (k + 1) * window].T for columns in groups])
        within = z @ Q
        rest = z - within @ Q.T
        gram += rest @ rest.T / variance
        score += rest @ residual / variance
        leverage = np.minimum((Q**2).sum(axis=1), MOST_LEVERAGE)
        rest *= residual / np.sqrt(1 - leverage)
        spread += rest @ rest.T * (every / variance**2)
        passed += fit.inverse[k] @ within.T / len(chosen)
        size += np.einsum("gt,gt->g", z, z) / variance
    return _Sums(gram, spread, score, passed, np.sqrt(size), float(freedom.sum()))


def _given(sums: _Sums, own: slice) -> _Sums:
    """With some of the columns in the model: less what they say of all others (Frisch, Waugh and Lovell)."""
    size = np.where(sums.size[own] > 0, sums.size[own], 1)
    inverse = np.linalg.pinv(sums.gram[own, own] / size / size[:, None], rcond=LOST, hermitian=True)
    rest = np.eye(len(sums.size))
    rest[:, own] -= sums.gram[:, own] @ (inverse / size / size[:, None])
    gram, spread = (rest @ x @ rest.T for x in (sums.gram, sums.spread))
    return sums._replace(gram=gram, spread=spread, score=rest @ sums.score, passed=sums.passed @ rest.T)


def _passed(W: Numbers, groups: Sequence[Numbers], window: int, chosen: NDArray[np.int64]) -> Numbers:
    """(p, G) what each column adds to the parameters by least squares of these rows, on the mean over some windows."""
    z = np.concatenate(groups, axis=1)
    parts = [slice(k * window, (k + 1) * window) for k in chosen.tolist()]
    found = [np.linalg.lstsq(W[part], z[part])[0] for part in parts]
    return np.mean(found, axis=0) if found else np.zeros((W.shape[1], z.shape[1]))


def _test(name: str, sums: _Sums, own: slice) -> Misfit | None:
    from scipy.special import fdtrc

    size = np.where(sums.size[own] > 0, sums.size[own], 1)
    gram, spread = (x[own, own] / size / size[:, None] for x in (sums.gram, sums.spread))
    score, passed, freedom = sums.score[own] / size, sums.passed[:, own] / size, sums.freedom
    values, vectors = np.linalg.eigh(gram)
    kept = vectors[:, values > LOST * max(values[-1], np.finfo(float).tiny)]
    k = kept.shape[1]
    if not k or values[-1] < LOST or freedom <= 2 * k:
        return None
    gram, spread, score, passed = kept.T @ gram @ kept, kept.T @ spread @ kept, kept.T @ score, passed @ kept
    statistic = float(score @ np.linalg.solve(spread, score))
    inverse = np.linalg.inv(gram)
    covariance, weights = inverse @ spread @ inverse, inverse @ score
    return Misfit(
        group=name,
        p=float(fdtrc(k, freedom - k, statistic / k)),
        statistic=statistic,
        evidence=statistic - k * float(np.log(freedom)),
        weights=kept @ weights / size,
        move=-passed @ weights,
        stderr=np.sqrt(np.einsum("ij,jk,ik->i", passed, covariance, passed)),
        weights_stderr=np.sqrt(np.einsum("ij,jk,ik->i", kept, covariance, kept)) / size,
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


def noticed(tests: Sequence[Misfit], level: float = FAMILYWISE) -> float:
    """How many of its errors large the weight of a single column is that every second record shows."""
    from scipy.special import ndtri

    return float(-ndtri(level / 2 / len(tests)))


def p_in_words(p: float) -> str:
    """A probability as papers print it."""
    return "p < 0.001" if p < 0.001 else f"p = {p:.2g}"
