"""From the sums of windows to their estimates, and to what judges these: one window a lane."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaximp.least_squares.sums import Plan, squared_norms
from jaximp.numerics.compilation import keep
from jaximp.numerics.lanes import (
    Rows,
    cholesky,
    divided,
    extreme_singular_values,
    inverse_of_rows,
    substitute,
    sum_of,
    symmetric,
)
from jaximp.numerics.linear_algebra import root

DOUBT = 1e-2
"""A pivot below this share of its column leaves the window's estimate to a QR decomposition."""


class ChunkFit(NamedTuple):
    """What is found for the K windows of a chunk; without statistics only the first three."""

    theta: Array
    """(K, p), meaningless where `solvable` is False."""
    solvable: Array
    """(K,) False where there is no unique solution."""
    share: Array
    """(K,) what the other columns leave of the one that they imitate best, squared and in the chunk's coordinates."""
    statistics: Statistics | None = None
    seen: Held | None = None
    """How well parameters that were given explain each window."""
    unseen: Held | None = None
    """How well each window's parameters, or those that were given, predict the one `ahead` windows on."""

    @property
    def doubtful(self) -> Any:
        """(K,) True where the numbers may be wrong and a QR decomposition must decide."""
        return self.solvable & (self.share <= DOUBT)


class Statistics(NamedTuple):
    """What judges an estimate, as in `least_squares.WindowFit`; (K,) but where said."""

    stderr: Array
    """(K, p)"""
    dof: Array
    inverse_norm: Array
    """(K, p) norm of each row of the inverse triangle: reciprocal excitation."""
    sigma_max: Array
    sigma_min: Array
    mean_square: Array
    """Of the residual."""
    vaf: Array
    samples: Array


class Held(NamedTuple):
    """How well parameters explain the torque of a window; (K,), nothing where that is beyond the chunk."""

    vaf: Array
    mean_square: Array
    """Of the residual."""
    samples: Array
    variance: Array
    """Of the torque."""


def estimates_of(
    plan: Plan, p: int, R: Array, sums: Rows, peak: Array, noise: Array | None, across: Rows | None
) -> tuple[ChunkFit, Array]:
    """Estimates of one window in every lane, from its sums, and the variance of the noise that the residuals show."""
    triangle = cholesky(sums[: p + 1])
    pivots = jnp.stack([row[0] for row in triangle[:p]])
    inner = substitute(triangle, p)
    theta, solvable = jnp.stack(inner), _solvable(pivots, sums, R, plan.rows)
    share = (pivots**2 / jnp.where(peak > 0, peak, 1)).min(axis=0)
    if not plan.statistics:
        return ChunkFit(theta, solvable, share), jnp.zeros_like(share)
    rss = (R[p, p] * triangle[p][0]) ** 2
    weight, vaf, _, samples = _residuals(plan, rss, inner, R, sums)
    alone = tuple(row[: p - i] for i, row in enumerate(triangle[:p]))
    own_inverse, given, inverse = _triangle_and_inverses(alone, R[:p, :p])
    sigma_max, sigma_min = extreme_singular_values(given, inverse)
    norm = jnp.sqrt((inverse**2).sum(axis=1))
    if across is None or noise is None:
        dof = trace = samples - p
        stderr = jnp.where(dof > 0, norm * root(rss / jnp.where(dof > 0, dof, 1)), jnp.nan)
    else:
        stderr, dof, trace = _coloured(plan, sums, across, noise, own_inverse, inverse, rss, weight)
    statistics = Statistics(stderr, dof, norm, sigma_max, sigma_min, divided(rss, weight), vaf, samples)
    return ChunkFit(theta, solvable, share, statistics), divided(rss, trace)


def _solvable(pivots: Array, sums: Rows, R: Array, rows: int) -> Array:
    """Whether what the other columns leave of every column is more than rounding.

    Only where they leave next to nothing of a column in the whole chunk can this be known from the sums.
    """
    p, rounding = len(pivots), rows * jnp.finfo(R.dtype).eps
    diagonal, size = jnp.diagonal(R)[:p], jnp.sqrt((R[:, :p] ** 2).sum(axis=0))
    suspect = diagonal**2 <= 4 * rounding * size**2

    def compare() -> Array:
        # In the given units: pivots against the columns themselves, term by term as they were rounded.
        bound = jnp.abs(R[:p, :p]).T @ jnp.sqrt(squared_norms(sums, p))
        return ~(suspect[:, None] & (pivots * diagonal[:, None] <= rounding * bound)).any(axis=0)

    return lax.cond(suspect.any(), compare, lambda: jnp.ones(pivots.shape[1], bool))


def in_given_units(found: ChunkFit, R: Array, plan: Plan) -> ChunkFit:
    """Estimates of all windows of the chunk, one after another: back through the chunk's triangle."""
    p = len(R) - 1
    theta = [found.theta[:, i] for i in range(p)]
    for i in reversed(range(p)):
        rest = R[i, p] + R[p, p] * theta[i]
        for k in range(i + 1, p):
            rest = rest - R[i, k] * theta[k]
        theta[i] = keep(rest / R[i, i])
    found = found._replace(theta=jnp.stack(theta, axis=1))
    return jax.tree.map(lambda x: _one_after_another(x, plan), found)


def _one_after_another(x: Array, plan: Plan) -> Array:
    """(windows of a block, ..., blocks) -> (windows, ...)"""
    return jnp.moveaxis(x, (-1, 0), (0, 1)).reshape(plan.windows, *x.shape[1:-1])


def for_prediction(sums: Rows, p: int, plan: Plan) -> Array:
    """The sums by which other parameters are held against a window, (k, lanes)."""
    if not plan.predicts:
        return jnp.zeros((0, sums[0].shape[-1]), sums[0].dtype)
    return keep(jnp.concatenate(sums[: p + 2 + plan.outputs + plan.weighted]))


def with_predictions(
    found: ChunkFit, sums: Array, R: Array, plan: Plan, ahead: Array | int, held: Array | None
) -> ChunkFit:
    """Hold every window's parameters, or others, against the sums of a later window."""
    if not plan.predicts:
        return found
    p = len(R) - 1
    if held is None:
        return found._replace(unseen=_held(_one_after_another(found.theta, plan).T, sums, R, plan, ahead))
    inner = ((held @ R[:p, :p].T - R[:p, p]) / R[p, p]).T
    return found._replace(seen=_held(inner, sums, R, plan, 0), unseen=_held(inner, sums, R, plan, ahead))


def _held(theta: Array, sums: Array, R: Array, plan: Plan, ahead: Array | int) -> Held:
    """Hold parameters (p, K), in the chunk's coordinates, against the sums of the windows `ahead` of theirs."""
    p = len(theta)
    assert plan.statistics
    sizes = [*range(p + 1, 0, -1), 1, *[p + 2 + plan.outputs] * plan.outputs, *[1] * plan.weighted]
    later = jnp.roll(_one_after_another(sums, plan), -ahead, axis=0).T
    rows = tuple(jnp.split(keep(later), np.cumsum(sizes)[:-1]))
    inner = list(keep(theta))
    # The residual is this combination of the chunk's columns; its sum of squares, a quadratic form of theirs.
    along = [*(-one for one in inner), jnp.ones_like(inner[0])]
    square = sum_of(
        along[i] * ((1 if i == k else 2) * along[k]) * row[k - i]
        for i, row in enumerate(rows[: p + 1])
        for k in range(i, p + 1)
    )
    rss = R[p, p] ** 2 * jnp.maximum(square, 0)
    weight, vaf, total, samples = _residuals(plan, rss, inner, R, rows)
    whole = jnp.arange(plan.windows) < plan.windows - ahead
    found = (
        jnp.where(whole, vaf, jnp.nan),
        divided(rss, weight),
        jnp.where(whole, samples, 0),
        total / jnp.maximum(samples, 1),
    )
    return Held(*(x.reshape(plan.lanes, plan.per_block).T for x in found))


def _residuals(plan: Plan, rss: Array, inner: list[Array], R: Array, sums: Rows) -> tuple[Array, Array, Array, Array]:
    """Sum of the weights, variance accounted for, the torque's squares about its mean, and how many samples counted.

    Of parameters `inner`, in the chunk's coordinates, which leave `rss`, the sum of squared residuals.
    """
    p, members = len(inner), sums[len(inner) + 2 :]
    total, left, whole = sums[p + 1][0], rss, jnp.zeros_like(rss)
    for output, row in enumerate(members[: plan.outputs]):
        weight = row[p + 2 + output]
        residual = R[p, p] * (row[p] - sum(theta * column for theta, column in zip(inner, row, strict=False)))
        over = 1 / jnp.where(weight > 0, weight, 1)
        total, left, whole = total - row[p + 1] ** 2 * over, left - residual**2 * over, whole + weight
    samples = members[plan.outputs][0] if plan.weighted else whole
    vaf = jnp.where(total > 0, 1 - left / jnp.where(total > 0, total, 1), jnp.nan)
    return whole, vaf, total, samples


def _triangle_and_inverses(triangle: Rows, R: Array) -> tuple[Array, Array, Array]:
    """Inverse of the window's triangle, the triangle in the given units, and the inverse of that; (p, p, lanes)."""
    p, scale = len(R), R[:, :, None]
    given = keep(jnp.stack([sum_of(row[k - i] * scale[k] for k in range(i, p)) for i, row in enumerate(triangle)]))
    own = inverse_of_rows(triangle)
    inverse = list(own)
    for i in reversed(range(p)):
        rest = own[i]
        for k in range(i + 1, p):
            rest = rest - R[i, k] * inverse[k]
        inverse[i] = keep(rest / R[i, i])
    own_inverse, given_inverse = keep((own, jnp.stack(inverse)))
    return own_inverse, given, given_inverse


def _coloured(
    plan: Plan, sums: Rows, across: Rows, noise: Array, own: Array, inverse: Array, rss: Array, weight: Array
) -> tuple[Array, Array, Array]:
    """Standard errors and degrees of freedom for noise of this autocovariance, as `least_squares` has them, and what
    the residuals' sum of squares would be for noise of just this autocovariance."""
    p = len(own)
    within = keep(tuple(all_ - lost for all_, lost in zip(sums[-len(across) :], across, strict=True)))
    once, twice, (squares,) = symmetric(within[:p]), symmetric(within[p : 2 * p]), within[2 * p]
    half = keep(jnp.stack([sum_of(once[i, k] * own[k] for k in range(p)) for i in range(p)]))
    shape = keep(jnp.stack([sum_of(own[k, i] * half[k] for k in range(i + 1)) for i in range(p)]))
    gram = jnp.stack([sum_of(own[i, k] * own[:, k] for k in range(i, p)) for i in range(p)])
    trace = noise[0] * weight - sum_of(shape[i, i] for i in range(p))
    square = squares - 2 * (twice * gram).sum(axis=(0, 1)) + (shape * shape).sum(axis=(0, 1))
    spread = keep(jnp.stack([sum_of(inverse[i, k] * shape[k] for k in range(i, p)) for i in range(p)]))
    variance = (spread * inverse).sum(axis=1) * (rss / jnp.where(trace > 0, trace, 1))
    return jnp.where(trace > 0, root(variance), jnp.nan), divided(trace**2, square), trace
