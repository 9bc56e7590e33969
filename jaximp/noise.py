"""The noise in rows of least squares, and rows in which it is white.

Filters make the noise of neighbouring rows alike, and what is alike must not count twice. The filters are known, so
the covariance C of the filtered noise is known up to its scale: its autocovariance by lag, a band matrix. With its
Cholesky factor L, the rows of `inv(L) [W y]` have noise that is white: least squares, likelihoods and scores may take
them as independent.

C is singular to rounding: a low-pass leaves nothing far above its cut-off, a high-pass nothing at zero. It is truncated
in two steps. Every n-th row is kept, n the largest for which the noise beyond the new Nyquist frequency has a density
below `NEGLIGIBLE` of the largest: those rows would repeat what the others say, in the last digits. Then `RIDGE` of the
largest density is added to the diagonal. Directions of noise below the ridge count for as much less than one as their
variance is less than the ridge with it: `count` is the sum of lambda/(lambda + ridge) over the eigenvalues of C.

The cost grows with the rows kept times the square of the lags kept, never with the square of the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Num, Shaped

from jaximp.types import AnyArray, Numbers

NEGLIGIBLE = 1e-6
"""Share of the largest spectral density below which noise says nothing that can be believed."""
RIDGE = 1e-8
"""Share of the largest spectral density that is added to all of it, so that the Cholesky factor exists."""
LARGEST_BAND = 200_000_000
"""Numbers that a band matrix may have (1.6 GB)."""
SIGNIFICANCE = 0.01
"""Residuals whose whiteness is less likely than this are given an autoregression."""
LAGS = 20
"""Lags that are tested for whiteness, and at most a fifth of the rows."""
ATTENUATION = 0.25
"""Noise in the regressor is corrected for where it moves an estimate by this many standard errors: 95 % intervals then
hold the truth in 94.3 % of all cases."""
PLAIN = np.ones(1)


@dataclass(frozen=True, eq=False)
class Noise:
    """What is known of the noise of rows, up to its scale."""

    autocovariance: Numbers = field(default_factory=lambda: PLAIN)
    """(L,) by lag, in rows, as `signals.autocovariance` makes it of the filters; a single one if the rows are white."""
    autoregression: tuple[Numbers, ...] = ()
    """For each output the coefficients (k,) by which white rows still follow from those before; none if they do not."""

    def __post_init__(self) -> None:
        r = np.asarray(self.autocovariance, float)
        if r.ndim != 1 or not len(r) or not np.isfinite(r).all() or r[0] <= 0 or np.abs(r).max() > r[0]:
            raise ValueError(
                "noise must be an autocovariance by lag (L,), largest at lag zero: signals.autocovariance makes it of "
                "filters that ran over the recording once (filter.mode = 'once')"
            )
        object.__setattr__(self, "autocovariance", r / r[0])

    @property
    def every(self) -> int:
        """Every so-manieth row is kept."""
        density = _density(self.autocovariance)
        edge = np.flatnonzero(density >= NEGLIGIBLE * density.max())[-1]
        return max(1, (len(density) - 1) // max(1, int(edge)))


@dataclass(frozen=True, eq=False)
class WhiteRows:
    """R rows for n outputs, whose noise is independent and, output by output, of one unknown scale."""

    W: Numbers
    """(R, n, p), zero where `valid` is False."""
    y: Numbers
    """(R, n), zero where `valid` is False. The scale of the noise is what one row of torque had [N m]."""
    valid: np.ndarray
    """(R, n)"""
    count: Numbers
    """(n,) how many independent rows there are."""

    def columns(self) -> Numbers:
        """(n, R, p + 1) regressor and torque, side by side."""
        return np.concatenate([self.W, self.y[..., None]], axis=-1).swapaxes(0, 1)

    def triangles(self) -> Numbers:
        """(n, p + 1, p + 1) upper triangles of thin QR decompositions: all that Gaussian noise needs to know."""
        n, n_rows, p = self.columns().shape
        whole = np.concatenate([self.columns(), np.zeros((n, max(0, p - n_rows), p))], axis=1)
        return np.stack([np.linalg.qr(rows, mode="r") for rows in whole])


def joined(parts: Sequence[WhiteRows]) -> WhiteRows:
    """Rows of trials, or of other stretches whose noise is independent, as those of one."""
    if not parts:
        raise ValueError("there are no rows to join: pass at least one stretch")
    W, y, valid = (np.concatenate([getattr(part, name) for part in parts]) for name in ("W", "y", "valid"))
    return WhiteRows(W, y, valid, np.sum([part.count for part in parts], axis=0))


def whiten(
    W: Num[AnyArray, "S *n p"],
    y: Num[AnyArray, "S *n"],
    noise: Noise | Num[AnyArray, " L"] | None = None,
    valid: Shaped[AnyArray, "S *n"] | None = None,
) -> WhiteRows:
    """Rows whose noise is white, from rows at equal steps of time whose noise is known up to its scale.

    **Arguments:** `W` (S, p) or (S, n, p); `y` (S,) or (S, n) [N m]; `noise`, or its autocovariance by lag, else it is
    taken as white; `valid` False for rows that must not count, whatever they hold. They are cut out, exactly.

    **Raises:** ValueError for an autocovariance whose memory is too long for the rows, and values that are not finite.

    **Source:** generalised least squares (Aitken 1936) by a banded Cholesky factor.
    """
    W, y = np.asarray(W, float), np.asarray(y, float)
    noise = noise if isinstance(noise, Noise) else Noise() if noise is None else Noise(np.asarray(noise))
    valid = np.ones(y.shape, bool) if valid is None else np.asarray(valid, bool)
    if y.ndim == 1:
        W, y, valid = W[:, None], y[:, None], valid[:, None]
    if noise.autoregression and len(noise.autoregression) != y.shape[1]:
        raise ValueError(
            f"noise has {len(noise.autoregression)} autoregressions for {y.shape[1]} outputs: one for each"
        )
    W, y, valid = (x[:: noise.every] for x in (W, y, valid))
    columns = np.where(valid[..., None], np.concatenate([W, y[..., None]], axis=-1), 0)
    if not np.isfinite(columns).all():
        raise ValueError("rows of W or y are not finite: mark them with valid=False, or mend them")
    valid, count, lags = valid.copy(), np.zeros(y.shape[1]), tuple(noise.autocovariance[:: noise.every])
    for k, output in enumerate(columns.swapaxes(0, 1)):
        count[k] = _whitened_in_place(output, valid[:, k], lags)
        if noise.autoregression:
            count[k] -= _predicted_in_place(output, valid[:, k], noise.autoregression[k])
    return WhiteRows(columns[..., :-1], columns[..., -1], valid, count)


def fit_noise(
    W: Num[AnyArray, "S *n p"],
    y: Num[AnyArray, "S *n"],
    noise: Noise | Num[AnyArray, " L"] | None = None,
    valid: Shaped[AnyArray, "S *n"] | None = None,
) -> Noise:
    """What is known of the noise, with the autoregressions that the residuals of the whole record demand.

    Arguments as for `whiten`. The residuals are those of the optimum; with the autoregressions it moves a little, so
    both are found twice, one after the other (Cochrane and Orcutt 1949).
    """
    noise = noise if isinstance(noise, Noise) else Noise() if noise is None else Noise(np.asarray(noise))
    plain = found = replace(noise, autoregression=())
    rows = whiten(W, y, plain, valid)
    for _ in range(2):
        residual = residuals(rows, optimum(whiten(W, y, found, valid)))
        coefficients = tuple(fit_autoregression(residual[:, k], rows.valid[:, k]) for k in range(residual.shape[1]))
        found = replace(plain, autoregression=coefficients if any(len(c) for c in coefficients) else ())
    return found


def optimum(rows: WhiteRows) -> Numbers:
    """(p,) least squares over all outputs, each in units of its own noise."""
    scale = np.ones(len(rows.count))
    for _ in range(3 if len(scale) > 1 else 1):
        theta = np.linalg.lstsq((rows.W / scale[:, None]).reshape(-1, rows.W.shape[-1]), (rows.y / scale).ravel())[0]
        size = np.sqrt((residuals(rows, theta) ** 2).sum(axis=0) / np.maximum(rows.count, 1))
        scale = np.where(size > 0, size, 1)
    return np.asarray(theta)


def residuals(rows: WhiteRows, theta: Num[AnyArray, " p"]) -> Numbers:
    """(R, n) what `theta` leaves of the torque; zero where a row is not valid."""
    return np.asarray(rows.y - rows.W @ np.asarray(theta))


class Whiteness(NamedTuple):
    """A test of Ljung and Box."""

    statistic: float
    p: float
    """Probability of a statistic this large in white noise."""
    lags: int


def whiteness(
    residual: Num[AnyArray, " R"], valid: Shaped[AnyArray, " R"] | None = None, lags: int | None = None, fitted: int = 0
) -> Whiteness:
    """Whether residuals are white: the sum of squared autocorrelations up to `lags`, `LAGS` unless told.

    Pairs of rows count of which both are valid. `fitted` coefficients of an autoregression are taken off the degrees of
    freedom.

    **Source:** Ljung and Box 1978.
    """
    from scipy.stats import chi2

    counts = np.ones(len(residual)) if valid is None else np.asarray(valid, float)
    e, n = np.where(counts > 0, np.asarray(residual, float), 0), counts.sum()
    lags = min(LAGS, int(n) // 5) if lags is None else lags
    if lags <= fitted or not (e @ e) > 0:
        return Whiteness(np.nan, np.nan, lags)
    pairs = np.array([counts[k:] @ counts[:-k] for k in range(1, lags + 1)])
    correlation = np.array([e[k:] @ e[:-k] for k in range(1, lags + 1)]) / (e @ e)
    statistic = float(n * (n + 2) * (correlation**2 / np.maximum(pairs, 1)).sum())
    return Whiteness(statistic, float(chi2.sf(statistic, lags - fitted)), lags)


def fit_autoregression(residual: Num[AnyArray, " R"], valid: Shaped[AnyArray, " R"] | None = None) -> Numbers:
    """(k,) coefficients by which residuals follow from those before; none where `whiteness` is not refuted.

    Refuted is what white noise would do in less than `SIGNIFICANCE` of all records. The order is then the one, up to
    10 log10(R), with the smallest information criterion of Schwarz; the coefficients are those of least squares over
    the rows that have valid rows before them.
    """
    e = np.asarray(residual, float)
    valid = np.ones(len(e), bool) if valid is None else np.asarray(valid, bool)
    test = whiteness(e, valid)
    if not test.p < SIGNIFICANCE:
        return np.zeros(0)
    most = int(10 * np.log10(valid.sum()))
    past, complete = _past(e, most), _history(valid, most)
    if complete.sum() <= 2 * most:
        return np.zeros(0)

    def lost(k: int) -> float:
        rows = past[complete, :k]
        left = e[complete] - rows @ np.linalg.lstsq(rows, e[complete])[0] if k else e[complete]
        return float(complete.sum() * np.log(left @ left) + k * np.log(complete.sum()))

    order = int(np.argmin([lost(k) for k in range(most + 1)]))
    enough = _history(valid, order)
    return np.asarray(np.linalg.lstsq(past[enough, :order], e[enough])[0]) if order else np.zeros(0)


def whitened_covariance(
    difference: Num[AnyArray, "S *n p"],
    noise: Noise | Num[AnyArray, " L"] | None = None,
    valid: Shaped[AnyArray, "S *n"] | None = None,
) -> Numbers:
    """(n, p, p) covariance that errors of the regressor have in the rows that `whiten` makes with the same arguments.

    **Arguments:** `difference` of a regressor with and without such errors (`regression.noisy_columns`).
    """
    difference = np.asarray(difference, float)
    rows = whiten(difference, np.zeros(difference.shape[:-1]), noise, valid)
    return np.einsum("rni,rnj->nij", rows.W, rows.W) / np.maximum(rows.count, 1)[:, None, None]


def attenuation(rows: WhiteRows, column_noise: Num[AnyArray, " p"] | Num[AnyArray, "*n p p"]) -> Numbers:
    """(p,) bias of least squares by noise in the regressor, in standard errors: `-inv(W'W) S Sigma theta`.

    **Source:** Fuller 1987, Measurement error models, section 2.2.
    """
    theta, scale = _optimum_and_scale(rows)
    weight = 1 / scale**2
    p = len(theta)
    gram = np.einsum("rni,rnj,n->ij", rows.W, rows.W, weight)
    lost = np.einsum("nij,n->ij", _covariances(column_noise, len(scale), p), weight * rows.count)
    size = np.sqrt(np.diagonal(gram))
    size = np.where(size > 0, size, 1)
    inverse = np.linalg.pinv(gram / np.outer(size, size)) / np.outer(size, size)
    return np.asarray(-(inverse @ lost @ theta) / np.sqrt(np.diagonal(inverse)))


def corrected(rows: WhiteRows, column_noise: Num[AnyArray, " p"] | Num[AnyArray, "*n p p"]) -> Numbers:
    """(n, p + 1, p + 1) rows that stand for those of a regressor without its noise.

    Their Gram matrix is `W'W - S Sigma`, so that the bias is gone, and what they leave of the torque at the optimum is
    what is left there in truth: the torque's noise and that of the regressor, of variance s^2 + theta' Sigma theta,
    the square of the density's noise. Right up to terms of second order in Sigma.

    **Raises:** ValueError where the noise is as large as the motion.

    **Source:** Fuller 1987, section 2.2; Nakamura 1990 for the corrected likelihood.
    """
    n, p = len(rows.count), rows.W.shape[-1]
    out = np.zeros((n, p + 1, p + 1))
    for k, (sigma, count) in enumerate(zip(_covariances(column_noise, n, p), rows.count, strict=True)):
        W, y = rows.W[:, k], rows.y[:, k]
        size = np.linalg.norm(W, axis=0)
        size = np.where(size > 0, size, 1)
        values, vectors = np.linalg.eigh((W / size).T @ (W / size) - count * sigma / np.outer(size, size))
        if values[0] < -1e-12:
            raise ValueError(
                "the noise of the motion is as large as the motion in some direction of the regressor: excite more, or "
                "lower filter.position_cutoff"
            )
        known = values > 1e-12  # what this output does not depend on is zero
        root = np.sqrt(np.where(known, values, 0))
        along = np.where(known, vectors.T @ (W / size).T @ y / np.where(known, root, 1), 0)
        theta = vectors @ np.where(known, along / np.where(known, root, 1), 0) / size
        out[k, :p, :p], out[k, :p, p] = root[:, None] * vectors.T * size, along
        out[k, p, p] = np.linalg.norm(y - W @ theta)
    return out


def _optimum_and_scale(rows: WhiteRows) -> tuple[Numbers, Numbers]:
    """Least squares, and the scale of the noise in each output."""
    theta = optimum(rows)
    scale = np.linalg.norm(residuals(rows, theta), axis=0) / np.sqrt(np.maximum(rows.count, 1))
    return theta, np.where(scale > 0, scale, 1)


def _covariances(column_noise: AnyArray, n: int, p: int) -> Numbers:
    """(n, p, p), from any way to state it."""
    given = np.asarray(column_noise, float)
    if given.shape not in ((p,), (p, p), (n, p, p)):
        raise ValueError(f"column_noise has the shape {given.shape}: it must be ({p},), ({p}, {p}) or ({n}, {p}, {p})")
    return np.broadcast_to(np.diag(given**2) if given.ndim == 1 else given, (n, p, p))


def _past(x: Numbers, order: int) -> Numbers:
    """(R, order) the rows before each row, the last first; zero before the start."""
    return np.stack([np.r_[np.zeros(k), x[:-k]] for k in range(1, order + 1)], axis=1) if order else x[:, None][:, :0]


def _history(valid: np.ndarray, order: int) -> np.ndarray:
    """(R,) rows that are valid, and so many before them too."""
    return np.asarray(valid & (_past(valid.astype(float), order) > 0).all(axis=1))


def _predicted_in_place(columns: Numbers, valid: np.ndarray, coefficients: Numbers) -> int:
    """Take off the columns what follows from the rows before; returns how many rows lack those and no longer count."""
    complete = _history(valid, len(coefficients))
    columns -= np.stack([_past(column, len(coefficients)) @ coefficients for column in columns.T], axis=1)
    columns[~complete] = 0
    lost = int((valid & ~complete).sum())
    valid[:] = complete
    return lost


def _whitened_in_place(columns: Numbers, valid: np.ndarray, lags: tuple[float, ...]) -> float:
    """Whiten the valid rows (R, k); returns how many independent ones there are."""
    from scipy.linalg.lapack import dtbtrs

    if len(lags) == 1 or not valid.any():
        return float(valid.sum())
    factor, count = _band_factor(lags, valid.tobytes())
    columns[valid] = dtbtrs(factor, columns[valid], uplo="L")[0]
    return count


@lru_cache(maxsize=8)
def _band_factor(lags: tuple[float, ...], valid: bytes) -> tuple[Numbers, float]:
    """Cholesky factor of the covariance of the valid rows, as a band, and how many independent rows they make."""
    from scipy.linalg import cholesky_banded

    place, r = np.flatnonzero(np.frombuffer(valid, bool)), np.asarray(lags)
    n, bands = len(place), min(len(lags), len(place))
    if n * bands > LARGEST_BAND:
        raise ValueError(
            f"the noise of {n} rows has a memory of {bands} rows, too much to whiten: a low-pass before (fewer rows), "
            "a higher high-pass cut-off, or shorter stretches need less"
        )
    band = np.zeros((bands, n))
    for k in range(bands):
        apart = place[k:] - place[: n - k]
        band[k, : n - k] = np.where(apart < len(r), r[np.minimum(apart, len(r) - 1)], 0)
    ridge = RIDGE * float(_density(r).max())

    def factor(times: float) -> Numbers:
        raised = band.copy()
        raised[0] += times * ridge
        return np.asarray(cholesky_banded(raised, overwrite_ab=True, lower=True, check_finite=False))

    # sum of ridge/(lambda + ridge) is the slope of the log determinant along the logarithm of the ridge
    up, down = (2 * np.log(factor(times)[0]).sum() for times in (1.1, 1 / 1.1))
    return factor(1.0), n - float(up - down) / (2 * np.log(1.1))


def _density(r: Numbers) -> Numbers:
    """Spectral density of an autocovariance, from frequency zero to half a cycle per row."""
    n = 1 << max(8, int(np.ceil(np.log2(8 * len(r)))))
    return np.asarray(2 * np.fft.rfft(r, n).real - r[0])
