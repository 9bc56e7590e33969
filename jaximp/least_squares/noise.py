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

The cost grows with the rows kept times the square of the lags kept, never with the square of the rows; the memory
needed, of long records, with the square of the lags alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Num, Shaped

from jaximp.numerics.compilation import require_numbers
from jaximp.types import AnyArray, Numbers

NEGLIGIBLE = 1e-6
"""Below this share of the largest spectral density, the noise cannot be relied on."""
RIDGE = 1e-8
"""Share of the largest spectral density that is added to all of it, so that the Cholesky factor exists."""
ROUNDING = 1e-14
"""Share of the largest spectral density with an autoregression below which all is rounding: the ridge is not less."""
LARGEST_BAND = 200_000_000
"""Numbers that a band matrix may have (1.6 GB)."""
FEWEST = 3
"""Rows of a stretch with parameters of its own, for each of them."""
EXACT = 2000
"""Rows of a stretch up to which autoregressions are part of the covariance."""
PIECE, OVERLAP = 6, 4
"""Of long records: rows that are whitened at a time, and rows before them that count as their past, both in bands of
the covariance. With a high-pass of 0.3 Hz this moves estimates by 0.0005 standard errors."""
SIGNIFICANCE = 0.01
"""Residuals get an autoregression where a test gives their whiteness a smaller probability than this."""
LAGS = 20
"""How many lags are tested for whiteness; never more than a fifth of the rows."""
ATTENUATION = 0.25
"""Noise in the regressor is corrected for where it moves an estimate by this many standard errors: 95 % intervals then
hold the truth in 94.3 % of all cases."""
ROUNDS, SETTLED = 8, 0.005
"""How often optimum and autoregressions are found in turns at most, and the change of coefficients that ends it."""
PLAIN = np.ones(1)


@dataclass(frozen=True, eq=False)
class Noise:
    """What is known of the noise in the rows, except its scale."""

    autocovariance: Numbers = field(default_factory=lambda: PLAIN)
    """(L,) autocovariance by lag, in rows, as `signals.autocovariance` computes it from the filters; a single one for
    rows that are white."""
    autoregression: tuple[Numbers, ...] = ()
    """For each output the coefficients (k,) by which the rows that the filters made of it followed from those before:
    what went through the filters was not white. Empty: it was white."""

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
        """Keep every n-th row: this is n."""
        density = _density(self.autocovariance)
        edge = np.flatnonzero(density >= NEGLIGIBLE * density.max())[-1]
        return max(1, (len(density) - 1) // max(1, int(edge)))

    def of_output(self, k: int) -> tuple[Numbers, float]:
        """Autocovariance by lag of the noise in the rows that are kept, lag zero one, and the ridge."""
        r = self.autocovariance[:: self.every]
        ridge = RIDGE * float(_density(r).max())
        if not self.autoregression or not len(self.autoregression[k]):
            return r, ridge
        whole = _with_autoregression(r, self.autoregression[k])
        # What is cut off changes the density by less than the ridge, or the covariance would not be positive definite.
        beyond = 2 * np.cumsum(np.abs(whole[::-1]))[::-1]
        ridge = max(ridge, ROUNDING * float(beyond[0]))
        return whole[: np.count_nonzero(beyond > 0.1 * ridge)] / whole[0], ridge / whole[0]


@dataclass(frozen=True, eq=False)
class WhiteRows:
    """R rows for n outputs, whose noise is independent and, output by output, of one unknown scale."""

    W: Numbers
    """(R, n, p), zero where `valid` is False."""
    y: Numbers
    """(R, n), zero where `valid` is False. The scale of the noise is what one row of torque had [N m]."""
    valid: np.ndarray
    """(R, n) whether a row counts."""
    count: Numbers
    """(n,) how many independent rows each output has."""
    size: Numbers
    """(R, n) by what the part of each row was divided that was new in it: the root of the noise's variance given the
    rows before, where that of a row by itself is one."""

    def columns(self) -> Numbers:
        """(n, R, p + 1) regressor and torque, side by side."""
        return np.concatenate([self.W, self.y[..., None]], axis=-1).swapaxes(0, 1)

    def triangles(self) -> Numbers:
        """(n, p + 1, p + 1) upper triangles of thin QR decompositions: all that Gaussian noise needs to know."""
        n, n_rows, p = self.columns().shape
        whole = np.concatenate([self.columns(), np.zeros((n, max(0, p - n_rows), p))], axis=1)
        return np.stack([np.linalg.qr(rows, mode="r") for rows in whole])


def joined(parts: Sequence[WhiteRows]) -> WhiteRows:
    """Join the rows of trials, or of other stretches whose noise is independent."""
    if not parts:
        raise ValueError("there are no rows to join: pass at least one stretch")
    W, y, valid, size = (np.concatenate([getattr(one, name) for one in parts]) for name in ("W", "y", "valid", "size"))
    return WhiteRows(W, y, valid, np.sum([part.count for part in parts], axis=0), size)


def whiten(
    W: Num[AnyArray, "S *n p"],
    y: Num[AnyArray, "S *n"],
    noise: Noise | Num[AnyArray, " L"] | None = None,
    valid: Shaped[AnyArray, "S *n"] | None = None,
) -> WhiteRows:
    """Rows whose noise is white, from rows at equal steps of time whose noise is known up to its scale.

    **Arguments:** `W` (S, p) or (S, n, p); `y` (S,) or (S, n) [N m]; `noise`, or its autocovariance by lag, else it is
    taken as white; `valid` False for rows that must not count, whatever they hold. They are cut out, exactly.

    Autoregressions join the covariance in stretches of up to `EXACT` rows. In longer ones they follow it, and the first
    rows after every gap, whose past is not known, do not count.

    **Raises:** ValueError for an autocovariance whose memory is too long for the rows, and values that are not finite.

    **Source:** generalised least squares (Aitken 1936) by a banded Cholesky factor.
    """
    require_numbers("whiten", "whiten the rows before", W, y, noise, valid)
    W, y = np.asarray(W, float), np.asarray(y, float)
    noise = noise if isinstance(noise, Noise) else Noise() if noise is None else Noise(np.asarray(noise))
    valid = np.ones(y.shape, bool) if valid is None else np.asarray(valid, bool)
    if y.ndim == 1:
        W, y, valid = W[:, None], y[:, None], valid[:, None]
    if noise.autoregression and len(noise.autoregression) != y.shape[1]:
        raise ValueError(
            f"noise has {len(noise.autoregression)} autoregressions for {y.shape[1]} outputs: one for each"
        )
    if noise.autoregression and len(y) > EXACT * noise.every:
        return _predicted(whiten(W, y, replace(noise, autoregression=()), valid), noise)
    W, y, valid = (x[:: noise.every] for x in (W, y, valid))
    columns = np.where(valid[..., None], np.concatenate([W, y[..., None]], axis=-1), 0)
    if not np.isfinite(columns).all():
        raise ValueError("rows of W or y are not finite: mark them with valid=False, or mend them")
    count, size = np.zeros(y.shape[1]), np.ones(y.shape)
    for k, output in enumerate(columns.swapaxes(0, 1)):
        count[k], size[:, k] = _whitened_in_place(output, valid[:, k], *noise.of_output(k))
    return WhiteRows(columns[..., :-1], columns[..., -1], valid, count, size)


def fit_noise(
    W: Num[AnyArray, "S *n p"],
    y: Num[AnyArray, "S *n"],
    noise: Noise | Num[AnyArray, " L"] | None = None,
    valid: Shaped[AnyArray, "S *n"] | None = None,
    stretch: int | None = None,
) -> Noise:
    """What is known of the noise, with the autoregressions that the residuals of the whole record demand.

    For posteriors; windows of a recording use `autoregression.fit_window_noise`.

    Arguments as for `whiten`; `stretch` rows have parameters of their own, so that what changes from one stretch to the
    next does not pass for noise: without it all rows share theirs. The residuals are those of the optimum; with the
    autoregressions it moves a little, so both are found in turns (Cochrane and Orcutt 1949). The optimum has followed
    some of the slow noise, and what it took is given back: `e e'` is expected to be `r r' + W V W'`, with the residuals
    r and the covariance V of the optimum (expectation maximisation of the restricted likelihood, Laird and Ware 1982).
    """
    require_numbers("fit_noise", "fit the noise before", W, y, noise, valid)
    noise = noise if isinstance(noise, Noise) else Noise() if noise is None else Noise(np.asarray(noise))
    plain = found = replace(noise, autoregression=())
    rows = whiten(W, y, plain, valid)
    length = len(rows.y) if stretch is None else max(1, stretch // noise.every)
    for _ in range(ROUNDS):
        residual, lost = _residuals_by_stretch(rows, found, length)
        coefficients = tuple(
            fit_autoregression(residual[:, k], rows.valid[:, k], lost[:, k]) for k in range(residual.shape[1])
        )
        before, found = found, replace(plain, autoregression=coefficients if any(map(len, coefficients)) else ())
        if _alike(before.autoregression, found.autoregression):
            break
    return found


def _residuals_by_stretch(rows: WhiteRows, noise: Noise, length: int) -> tuple[Numbers, Numbers]:
    """(R, n) residuals of the optimum of every stretch, and (R, n, p) what it took from the noise."""
    predicted, left, lost = _predicted(rows, noise), np.zeros_like(rows.y), np.zeros_like(rows.W)
    length = max(length, FEWEST * rows.W.shape[-1])
    starts = range(0, max(1, len(rows.y) - length + 1), length)
    for first, last in zip(starts, (*starts[1:], len(rows.y)), strict=True):
        part = slice(first, last)
        theta, root = _optimum_and_root(_rows_of(predicted, part))
        left[part], lost[part] = residuals(_rows_of(rows, part), theta), rows.W[part] @ root
    return left, lost


def _rows_of(rows: WhiteRows, part: slice) -> WhiteRows:
    valid = rows.valid[part]
    share = valid.sum(axis=0) / np.maximum(rows.valid.sum(axis=0), 1)
    return WhiteRows(rows.W[part], rows.y[part], valid, rows.count * share, rows.size[part])


def _predicted(rows: WhiteRows, noise: Noise) -> WhiteRows:
    """Rows less what those before say of them, where all of these count; `rows` are white but for autoregressions."""
    from scipy.signal import lfilter

    columns, valid, size = rows.columns(), rows.valid.copy(), rows.size.copy()
    for k, coefficients in enumerate(noise.autoregression):
        order = len(coefficients)
        # The scale of the noise is that of a row, as elsewhere, and not of what is new in it.
        scale = np.sqrt(_with_autoregression(noise.autocovariance[:: noise.every], coefficients)[0])
        columns[k] = scale * lfilter(np.r_[1, -coefficients], 1.0, columns[k], axis=0)
        size[:, k] /= scale
        known = np.cumsum(np.r_[np.zeros(order + 1), rows.valid[:, k]])
        valid[:, k] = known[order + 1 :] - known[: -order - 1] == order + 1
    columns *= valid.T[..., None]
    count = rows.count * valid.sum(axis=0) / np.maximum(rows.valid.sum(axis=0), 1)
    return WhiteRows(columns[..., :-1].swapaxes(0, 1), columns[..., -1].T, valid, count, size)


def _alike(before: tuple[Numbers, ...], after: tuple[Numbers, ...]) -> bool:
    return len(before) == len(after) and all(
        len(a) == len(b) and np.allclose(a, b, rtol=0, atol=SETTLED) for a, b in zip(before, after, strict=True)
    )


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
    """The result of a test of Ljung and Box."""

    statistic: float
    p: float
    """The probability that white noise has a statistic as large as this one."""
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


def fit_autoregression(
    residual: Num[AnyArray, " R"],
    valid: Shaped[AnyArray, " R"] | None = None,
    lost: Num[AnyArray, "R p"] | None = None,
) -> Numbers:
    """(k,) coefficients by which residuals follow from those before; none where `whiteness` is not refuted.

    Refuted is what white noise would do in less than `SIGNIFICANCE` of all records. The order is then the one, up to
    10 log10(R), with the smallest information criterion of Schwarz. `lost` are further series, whose products count
    with those of the residuals: what a fit took from the noise, see `fit_noise`.

    **Source:** Burg 1975, whose coefficients are always those of a stable process; pairs of valid rows count.
    """
    counts = np.ones(len(residual)) if valid is None else np.asarray(valid, float)
    if not whiteness(residual, counts).p < SIGNIFICANCE:
        return np.zeros(0)
    series = np.asarray(residual, float)[:, None] if lost is None else np.column_stack([residual, lost])
    forward = np.where(counts[:, None] > 0, series, 0)
    n, backward, polynomial, power = counts.sum(), forward.copy(), np.ones(1), 1.0
    orders = [(0.0, polynomial)]
    for _ in range(int(min(10 * np.log10(n), n // 3))):
        forward, backward, counts = forward[1:], backward[:-1], counts[1:] * counts[:-1]
        f, b = forward * counts[:, None], backward * counts[:, None]
        reflection = -2 * (f * b).sum() / ((f * f).sum() + (b * b).sum())
        forward, backward = forward + reflection * backward, backward + reflection * forward
        polynomial = np.r_[polynomial, 0] + reflection * np.r_[0, polynomial[::-1]]
        power *= 1 - reflection**2
        orders.append((n * np.log(power) + (len(polynomial) - 1) * np.log(n), polynomial))
    return -min(orders, key=lambda order: order[0])[1][1:]


def whitened_covariance(
    difference: Num[AnyArray, "S *n p"],
    noise: Noise | Num[AnyArray, " L"] | None = None,
    valid: Shaped[AnyArray, "S *n"] | None = None,
) -> Numbers:
    """(n, p, p) covariance that errors of the regressor have in the rows that `whiten` makes with the same arguments.

    **Arguments:** `difference` of a regressor with and without such errors (`identification.rows`).
    """
    difference = np.asarray(difference, float)
    rows = whiten(difference, np.zeros(difference.shape[:-1]), noise, valid)
    return np.einsum("rni,rnj->nij", rows.W, rows.W) / np.maximum(rows.count, 1)[:, None, None]


def disagreement(
    W: Num[AnyArray, "S *n p"],
    y: Num[AnyArray, "S *n"],
    noise: Noise,
    valid: Shaped[AnyArray, "S *n"] | None = None,
    difference: Num[AnyArray, "S *n p"] | None = None,
) -> Numbers:
    """(p,) by how many standard errors of the difference the optimum moves with the autoregressions.

    Arguments as for `whiten`, and of `difference` as for `whitened_covariance`: how far noise of the regressor may move
    either optimum is no disagreement. Both estimates are right where the model is, and weigh frequencies differently;
    what they disagree about is no noise, but something that the model lacks. Zero without autoregressions.

    **Source:** Hausman 1978; the optimum without them has the covariance `inv(M) W' C W inv(M)`, with M = W'W and the
    covariance C of the noise (White 1980).
    """
    from scipy.signal import lfilter

    rows = whiten(W, y, replace(noise, autoregression=()), valid)
    if not noise.autoregression:
        return np.zeros(rows.W.shape[-1])
    theta, scale = _optimum_and_scale(rows)
    predicted = _predicted(rows, noise)
    better, level = _optimum_and_scale(predicted)
    unit = np.linalg.norm(rows.W.reshape(-1, len(theta)), axis=0)
    unit = np.where(unit > 0, unit, 1)
    M, middle, M_better = np.zeros((3, len(theta), len(theta)))
    for k, coefficients in enumerate(noise.autoregression):
        columns, after = rows.W[:, k] / unit, predicted.W[:, k] / unit
        # Every row's share in all rows that follow from it, in units of what is new in a row.
        answers = lfilter([1.0], np.r_[1, -coefficients], columns[::-1], axis=0)
        new = level[k] * (predicted.size[:, k] / rows.size[:, k])[0]
        M += columns.T @ columns / scale[k] ** 2
        middle += answers.T @ answers * (new**2 / scale[k] ** 4)
        M_better += after.T @ after / level[k] ** 2
    inverse, ideal = (np.linalg.pinv(one, hermitian=True) for one in (M, M_better))
    variance, least = np.diagonal(inverse @ middle @ inverse), np.diagonal(ideal)
    apart = np.sqrt(np.maximum(variance - least, 0.01 * least))
    moved = (theta - better) * unit
    if difference is not None:
        plain = whitened_covariance(difference, replace(noise, autoregression=()), valid)
        biases = (
            attenuation(rows, plain) * np.sqrt(np.diagonal(inverse)),
            attenuation(predicted, whitened_covariance(difference, noise, valid)) * np.sqrt(least),
        )
        # The bias is known to first order: what is left of it may be as large as a part of it.
        moved = moved - (biases[0] - biases[1])
        apart = apart + 0.5 * (np.abs(biases[0]) + np.abs(biases[1]))
    return np.asarray(moved / np.where(apart > 0, apart, 1))


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
    stderr = np.sqrt(np.diagonal(inverse))
    return np.asarray(-(inverse @ lost @ theta) / np.where(stderr > 0, stderr, 1))


def triangles(rows: WhiteRows, column_noise: Num[AnyArray, " p"] | Num[AnyArray, "*n p p"] | None = None) -> Numbers:
    """(n, p + 1, p + 1) of the rows; `corrected` where noise in the regressor moves an estimate, see `ATTENUATION`."""
    enough = rows.count.sum() > rows.W.shape[-1]
    if column_noise is None or not enough or (np.abs(attenuation(rows, column_noise)) <= ATTENUATION).all():
        return rows.triangles()
    return corrected(rows, column_noise)


def corrected(rows: WhiteRows, column_noise: Num[AnyArray, " p"] | Num[AnyArray, "*n p p"]) -> Numbers:
    """(n, p + 1, p + 1) triangles of rows that stand for those of a regressor without its noise.

    Their optimum is that of the Gram matrix `M = W'W - S Sigma`, free of the bias. What they leave of the torque there
    is what is left in truth, the noise of the torque and of the regressor, of variance v = s^2 + theta' Sigma theta:
    the square of the density's noise. Their own Gram matrix is v times the inverse of the covariance
    `inv(M) (v M + S (v Sigma + Sigma theta theta' Sigma)) inv(M)`.

    **Raises:** ValueError where the noise is as large as the motion.

    **Source:** Fuller 1987, section 2.2.
    """
    n, p = len(rows.count), rows.W.shape[-1]
    out: list[Numbers] = []
    for k, (sigma, count) in enumerate(zip(_covariances(column_noise, n, p), rows.count, strict=True)):
        size = np.linalg.norm(rows.W[:, k], axis=0)
        size = np.where(size > 0, size, 1)
        W, y, error = rows.W[:, k] / size, rows.y[:, k], count * sigma / np.outer(size, size)
        M = W.T @ W - error
        if np.linalg.eigvalsh(M)[0] < -1e-12:
            raise ValueError(
                "the noise of the motion is as large as the motion in some direction of the regressor: excite more, or "
                "lower filter.position_cutoff"
            )
        if not (y @ y > 0):  # no row of this output counts
            out.append(np.zeros((p + 1, p + 1)))
            continue
        theta = np.linalg.pinv(M, hermitian=True) @ W.T @ y  # an output need not depend on every parameter
        left = y - W @ theta
        lost = error @ theta
        spread = M + error + np.outer(lost, lost) / (left @ left)
        values, vectors = np.linalg.eigh(M @ np.linalg.pinv(spread, hermitian=True) @ M)
        root = np.sqrt(np.maximum(values, 0))[:, None] * vectors.T
        below = np.append(np.zeros(p), np.linalg.norm(left))
        out.append(np.asarray(np.linalg.qr(np.vstack([np.column_stack([root * size, root @ theta]), below]), mode="r")))
    return np.stack(out)


def _optimum_and_scale(rows: WhiteRows) -> tuple[Numbers, Numbers]:
    """Least squares, and the scale of the noise in each output."""
    theta = optimum(rows)
    scale = np.linalg.norm(residuals(rows, theta), axis=0) / np.sqrt(np.maximum(rows.count, 1))
    return theta, np.where(scale > 0, scale, 1)


def _optimum_and_root(rows: WhiteRows) -> tuple[Numbers, Numbers]:
    """Least squares, and a root (p, p) of its covariance: root root'."""
    theta, scale = _optimum_and_scale(rows)
    columns = (rows.W / scale[:, None]).reshape(-1, len(theta))
    size = np.linalg.norm(columns, axis=0)
    size = np.where(size > 0, size, 1)
    below = np.zeros((max(0, len(size) - len(columns)), len(size)))
    return theta, np.linalg.pinv(np.linalg.qr(np.vstack([columns / size, below]), mode="r")) / size[:, None]


def _covariances(column_noise: AnyArray, n: int, p: int) -> Numbers:
    """(n, p, p), from any way to state it."""
    given = np.asarray(column_noise, float)
    if given.shape not in ((p,), (p, p), (n, p, p)):
        raise ValueError(f"column_noise has the shape {given.shape}: it must be ({p},), ({p}, {p}) or ({n}, {p}, {p})")
    return np.broadcast_to(np.diag(given**2) if given.ndim == 1 else given, (n, p, p))


def _whitened_in_place(columns: Numbers, valid: np.ndarray, lags: Numbers, ridge: float) -> tuple[float, Numbers]:
    """Whiten the valid rows (R, k); returns how many independent ones there are, and by what each was divided.

    Long records go piece by piece. A row is then white given the rows from the beginning of its piece, of which the
    first `OVERLAP` bands are only that past.
    """
    from scipy.linalg.lapack import dtbtrs

    n, size, bands = len(valid), np.ones(len(valid)), len(lags)
    if bands == 1 or not valid.any():
        return float(valid.sum()), size
    piece, given, out = (n if n <= 2 * PIECE * bands else PIECE * bands), OVERLAP * bands, np.zeros_like(columns)
    for first in range(0, n, piece):
        begin, end = max(0, first - given), min(n, first + piece)
        counts = valid[begin:end]
        if counts[first - begin :].any():
            factor = _band_factor(lags.tobytes(), ridge, counts.tobytes())
            rows, divisor = np.zeros_like(columns[begin:end]), np.ones(end - begin)
            rows[counts], divisor[counts] = dtbtrs(factor, columns[begin:end][counts], uplo="L")[0], factor[0]
            out[first:end], size[first:end] = rows[first - begin :], divisor[first - begin :]
    columns[:] = out
    # The eigenvalues of a long stretch are as many values of the density (Szegő 1915).
    density = _density(lags)
    return float(valid.sum()) * float(np.mean(density / (density + ridge))), size


@lru_cache(maxsize=8)
def _band_factor(lags: bytes, ridge: float, valid: bytes) -> Numbers:
    """Cholesky factor of the covariance of the valid rows, as a band."""
    from scipy.linalg import cholesky_banded

    place, r = np.flatnonzero(np.frombuffer(valid, bool)), np.frombuffer(lags)
    n, bands = len(place), min(len(r), len(place))
    if n * bands > LARGEST_BAND:
        raise ValueError(
            f"the noise of {n} rows has a memory of {bands} rows, too much to whiten: a low-pass before (fewer rows), "
            "a higher high-pass cut-off, or shorter stretches need less"
        )
    band = np.zeros((bands, n))
    for k in range(bands):
        apart = place[k:] - place[: n - k]
        band[k, : n - k] = np.where(apart < len(r), r[np.minimum(apart, len(r) - 1)], 0)
    band[0] += ridge
    return np.asarray(cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False))


def _with_autoregression(r: Numbers, coefficients: Numbers) -> Numbers:
    """Autocovariance by lag of what the filters, with the autocovariance r, made of noise that followed from itself."""
    polynomial = np.r_[1, -coefficients]
    slowest = min(0.9999, np.abs(np.roots(polynomial)).max(initial=0.5))
    density = _density(r, len(r) + int(np.ceil(-25 / np.log(slowest))))
    whole = np.fft.irfft(density / np.abs(np.fft.rfft(polynomial, 2 * (len(density) - 1))) ** 2)
    return np.asarray(whole[: len(whole) // 2])


def _density(r: Numbers, memory: int = 0) -> Numbers:
    """Spectral density of an autocovariance, from frequency zero to half a cycle per row, fine enough for `memory`."""
    n = 1 << max(8, int(np.ceil(np.log2(8 * max(len(r), memory)))))
    return np.asarray(2 * np.fft.rfft(r, n).real - r[0])
