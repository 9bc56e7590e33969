"""Recursive least squares with a forgetting factor, sample by sample: the rival that Tout et al. 2023 compare with.

The state is the information matrix, not its inverse: it needs no guess of an initial covariance, cannot lose its
symmetry, and its estimate is exactly the exponentially weighted least squares solution. The squares of a sample's
weights are summed as well, from which standard errors follow.

At rest new samples say nothing and old ones are forgotten: what is left is noise, and estimates go anywhere (wind-up).
So the memory is watched, and where it has lost a parameter the last estimate that was known well is held.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num, Shaped

from jaximp.least_squares.sums import FEWEST_LANES
from jaximp.least_squares.window import Fit
from jaximp.numerics.compilation import compiled, is_traced, keep
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
from jaximp.numerics.precision import require_float64
from jaximp.types import AnyArray

SINGULAR = 1e-14
"""What the other columns must leave of a column's square: below, rounding decides."""
STRETCHES, SHORTEST = 1000, 50
"""A recording is cut into so many stretches, of so many samples at least."""
LOST, KNOWN, USUAL = 100.0, 10.0, 2.0
"""A parameter is lost where its column is so many times less excited than at best, and known again where it is so many
times at most, and at most so many times less than of late."""
FADING, OF_LATE = 1e-3, 5e-2
"""The best of the past, and that of late, are forgotten so much more slowly than samples are: no glitch, and no large
motion of long ago, stays the best."""
NO_FREEDOM = 1e-9
"""Share of the weights that residuals must keep."""
ROUNDING = 1e-15
"""Share of the torque's square that rounding leaves where the fit is exact."""


class RecursiveFit(Fit):
    """The estimate after every sample, from the samples that are remembered."""

    held: Bool[AnyArray, "*N"]
    """Whether the memory has lost a parameter, so that all is as it was when it last knew."""
    renewed: Int[AnyArray, "*N"]
    """Index of the last sample that the estimate knows; -1 before the first."""


class RecursiveState(eqx.Module):
    """All that is remembered of the samples seen so far."""

    sums: Rows
    """Weighted sums of products of w, y and 1, and of w with the squares and the cubes of the weights."""
    fit: RecursiveFit
    """The estimate."""
    known: RecursiveFit
    """The last estimate that was known well."""
    best: Float[Array, "2 p"]
    """Largest excitation of every column so far, and of late."""
    count: Int[Array, ""]
    """Samples so far."""


def init(n_parameters: int) -> RecursiveState:
    """The state before the first sample."""
    p = n_parameters
    sums, none = _no_sums(p, 1, jnp.zeros(0).dtype), jnp.array(jnp.nan)
    several = jnp.full(p, jnp.nan)
    nothing = RecursiveFit(
        theta=several, stderr=several, dof=none, cond=none, sigma_min=none, excitation=several, residual_rms=none,
        vaf=none, samples=jnp.zeros((), int), held=jnp.array(False), renewed=jnp.array(-1),
    )  # fmt: skip
    return RecursiveState(sums, nothing, nothing, jnp.zeros((2, p)), jnp.zeros((), int))


def step(
    state: RecursiveState,
    w: Num[AnyArray, " p"],
    y: Num[AnyArray, ""],
    forgetting: float | Array = 1.0,
    noise_variance: float | Array | None = None,
) -> tuple[RecursiveState, Float[Array, " p"]]:
    """Take one sample in, and return the new state and estimate; its errors and the rest are `state.fit`.

    **Arguments:** regressor `w` (p,), torque `y` [N m], and `forgetting`, the weight that a sample loses with every
    new one: after k samples it counts `forgetting**k`. A sample that is not finite changes nothing. `noise_variance` as
    in `recursive_least_squares`.
    """
    w, y = jnp.asarray(w, float), jnp.asarray(y, float)
    valid = jnp.isfinite(w).all() & jnp.isfinite(y)
    row = jnp.where(valid, jnp.concatenate([w, jnp.stack([y, jnp.ones_like(y)])]), 0)
    kept = jnp.where(valid, forgetting, 1.0)
    sums = _absorb(state.sums, row[:, None], kept)
    now = jax.tree.map(lambda x: x[..., 0], _estimate(sums, len(w), noise_variance))
    fit = _as_fit(now, False, jnp.where(valid, state.count, state.fit.renewed))
    excitation = _watched_excitation(now)
    best = jnp.maximum(excitation, state.best * jnp.exp(-jnp.where(valid, _fading(forgetting), 0)))
    known, lost = _known_and_lost(excitation, *best)
    held = ~known & (lost | state.fit.held)
    last_known = _where(known, fit, state.known)
    fit = _where(held, eqx.tree_at(lambda f: f.held, last_known, jnp.array(True)), fit)
    return RecursiveState(sums, fit, last_known, best, state.count + 1), fit.theta


def recursive_least_squares(
    W: Num[AnyArray, "..."],
    y: Num[AnyArray, "..."],
    forgetting: float | Array = 1.0,
    *,
    valid: Shaped[AnyArray, " N"] | None = None,
    noise_variance: float | Array | None = None,
) -> RecursiveFit:
    """Estimates after each of the N samples: `step` run over a recording.

    **Arguments:** `W` (N, p); `y` (N,) [N m]; `forgetting`: after k samples a sample counts `forgetting**k`. A sample
    that is not `valid`, or not finite, changes nothing: neither does it count, nor is anything forgotten for it.
    `noise_variance` of the torque [(N m)^2]; without it it is estimated from the residuals of the samples remembered
    (which are the sum of the squared innovations, each over its expected size), and forgotten as they are.

    **Returns:** a `RecursiveFit`, every field along N. Of weights d and their diagonal matrix D, with `A = W' D W`, the
    covariance is `s^2 A^-1 (W' D^2 W) A^-1` and `s^2 = r' D r / t`, with `t = sum(d) - tr(A^-1 W' D^2 W)`; degrees of
    freedom are Satterthwaite's, at most `(1 + forgetting) / (1 - forgetting)`, and infinite where the noise is known.
    They hold for white noise and constant parameters. `cond`, `sigma_min` and `excitation` are those of the rows, each
    times the root of its weight, and `samples` is the sum of the weights. NaN until the samples determine everything.

    **Rest:** where motion stops, memory fades and noise takes over. Once a column is `LOST` times less excited than at
    best, `held` says so, and everything stays as it was when all columns were last excited about as usual (`KNOWN`
    times less than at best, `USUAL` times less than of late), until they are again. Such an estimate answers for the
    time before (`renewed`). `trust.judge_recursive` makes verdicts of it.

    **Raises:** `ValueError` for shapes that disagree, a forgetting factor outside (0, 1] and a variance below zero.

    **Source:** Tout et al. 2023, section IV-B. What becomes of the covariance without excitation, and what else there
    is against it: Lai and Bernstein 2024 (arXiv 2404.10844). Holding the estimate is the conditional updating of Åström
    and Wittenmark 1995. It leaves all other estimates those of exponential forgetting; directional forgetting does not.

    **Example:**

    ```pycon
    >>> t = np.arange(0, 4, 0.01)
    >>> W = np.column_stack([np.cos(9 * t), np.sin(5 * t)])
    >>> noise = 0.1 * np.random.default_rng(0).normal(size=len(t))
    >>> fit = jaximp.recursive_least_squares(W, W @ [1, 20] + noise, forgetting=0.99)
    >>> print(fit.theta.shape, fit.theta[-1].round(0))
    (400, 2) [ 1. 20.]

    ```
    """
    require_float64(W, y)
    W, y = jnp.asarray(W, float), jnp.asarray(y, float)
    if W.ndim != 2 or y.shape != W.shape[:1]:
        raise ValueError(f"W has shape {W.shape} and y {y.shape}: expected (N, p) and (N,)")
    if not is_traced(forgetting) and not 0 < forgetting <= 1:
        raise ValueError(f"the forgetting factor is {forgetting}: it must lie in (0, 1]")
    if noise_variance is not None and not is_traced(noise_variance) and not noise_variance >= 0:
        raise ValueError(f"noise_variance is {noise_variance}: it must be zero or more, in (N m)^2")
    valid = jnp.ones(len(y), bool) if valid is None else jnp.asarray(valid, bool)
    if valid.shape != y.shape:
        raise ValueError(f"valid has shape {valid.shape}: expected {y.shape}")
    return _run(W, y, forgetting, valid, noise_variance)


class _Now(NamedTuple):
    """What the sums of every lane say; NaN where they determine nothing."""

    theta: Array
    """(p, lanes)"""
    stderr: Array
    """(p, lanes)"""
    excitation: Array
    """(p, lanes)"""
    dof: Array
    cond: Array
    sigma_min: Array
    residual_rms: Array
    vaf: Array
    samples: Array


@compiled
def _run(W: Array, y: Array, forgetting: float | Array, valid: Array, variance: float | Array | None) -> RecursiveFit:
    """All stretches of a recording at a time: their own sums first, which give the sums that each begins with."""
    n_samples, p = W.shape
    length = max(SHORTEST, -(-n_samples // STRETCHES))
    n_stretches = max(FEWEST_LANES, -(-n_samples // length))
    valid &= jnp.isfinite(W).all(axis=1) & jnp.isfinite(y)
    rows = jnp.concatenate([W, y[:, None], jnp.ones_like(y)[:, None]], axis=1)
    columns = jnp.concatenate([jnp.where(valid[:, None], rows, 0), jnp.where(valid, forgetting, 1.0)[:, None]], axis=1)
    behind = n_stretches * length - n_samples
    columns = jnp.pad(columns, ((0, behind), (0, 0)), constant_values=1)
    stretches = keep(columns.reshape(n_stretches, length, p + 3).transpose(1, 2, 0))

    def total(state: tuple[Rows, Array], row: Array) -> tuple[tuple[Rows, Array], None]:
        sums, decay = state
        row = keep(row)
        return (_absorb(sums, row[:-1], row[-1]), keep(decay * row[-1])), None

    def advance(sums: Rows, row: Array) -> tuple[Rows, _Now]:
        row = keep(row)
        sums = _absorb(sums, row[:-1], row[-1])
        return sums, _estimate(sums, p, variance)

    nothing = _no_sums(p, n_stretches, W.dtype)
    (sums, decay), _ = jax.lax.scan(total, (nothing, jnp.ones(n_stretches, W.dtype)), stretches)
    found = jax.lax.scan(advance, _sums_before(sums, decay, p), stretches)[1]
    found = jax.tree.map(lambda x: jnp.moveaxis(x, (-1, 0), (0, 1)).reshape(-1, *x.shape[1:-1])[:n_samples], found)
    return _watched(found, forgetting, valid)


def _no_sums(p: int, lanes: int, dtype: np.dtype) -> Rows:
    sizes = [*range(p + 2, 0, -1), *range(p, 0, -1), *range(p, 0, -1), 1]
    return tuple(jnp.zeros((size, lanes), dtype) for size in sizes)


def _absorb(sums: Rows, row: Array, forgetting: Array) -> Rows:
    """Take in one row of w, y and 1 per lane: p + 2 rows of their products, p of those of w for squared weights and p
    for cubed ones, and the sum of the squared weights."""
    p = len(row) - 2
    products = [row[i] * row[i:] for i in range(p + 2)]
    first, second, third = sums[: p + 2], sums[p + 2 : 2 * p + 2], sums[2 * p + 2 : -1]
    return keep(
        (
            *(forgetting * s + new for s, new in zip(first, products, strict=True)),
            *(forgetting**2 * s + new[:-2] for s, new in zip(second, products[:p], strict=True)),
            *(forgetting**3 * s + new[:-2] for s, new in zip(third, products[:p], strict=True)),
            forgetting**2 * sums[-1] + row[-1:],
        )
    )


def _sums_before(sums: Rows, decay: Array, p: int) -> Rows:
    """What all stretches before each one leave of their sums."""
    flat = jnp.concatenate(sums)
    ends = np.cumsum([len(row) for row in sums])
    power = np.repeat([1, 2, 3, 2], [ends[p + 1], p * (p + 1) // 2, p * (p + 1) // 2, 1])

    def follow(before: Array, stretch: tuple[Array, Array]) -> tuple[Array, Array]:
        own, kept = stretch
        return jnp.stack([jnp.ones_like(kept), kept, kept**2, kept**3])[power] * before + own, before

    before = jax.lax.scan(follow, jnp.zeros_like(flat[:, 0]), (flat.T, decay))[1].T
    return keep(tuple(before[end - len(row) : end] for end, row in zip(ends, sums, strict=True)))


def _estimate(sums: Rows, p: int, variance: float | Array | None) -> _Now:
    """Solution of the normal equations of every lane, and what judges it."""
    first, weight, weight_squared = sums[: p + 2], sums[p + 1][0], sums[-1][0]
    triangle = cholesky(first[: p + 1])
    pivots = jnp.stack([row[0] for row in triangle[:p]])
    solvable = (pivots**2 > SINGULAR * jnp.stack([row[0] for row in first[:p]])).all(axis=0)
    theta = substitute(triangle, p)
    rss = triangle[p][0] ** 2
    rss = jnp.where((triangle[p][0] > 0) & (rss > ROUNDING * first[p][0]), rss, 0)
    # What is not solvable must not make derivatives NaN.
    alone = tuple(jnp.where(solvable, row[: p - i], _of_unit(row[: p - i])) for i, row in enumerate(triangle[:p]))
    inverse = keep(inverse_of_rows(alone))
    given = jnp.stack([jnp.concatenate([jnp.zeros_like(row[:1])] * i + [row]) for i, row in enumerate(alone)])
    sigma_max, sigma_min = extreme_singular_values(given, inverse)

    twice, thrice = symmetric(sums[p + 2 : 2 * p + 2]), symmetric(sums[2 * p + 2 : -1])
    half = keep(jnp.stack([sum_of(twice[i, k] * inverse[k] for k in range(p)) for i in range(p)]))
    shape = keep(jnp.stack([sum_of(inverse[k, i] * half[k] for k in range(i + 1)) for i in range(p)]))
    spread = keep(jnp.stack([sum_of(inverse[i, k] * shape[k] for k in range(i, p)) for i in range(p)]))
    lost = sum_of(shape[i, i] for i in range(p))
    cubes = sum_of((thrice[i] * sum_of(inverse[i, k] * inverse[:, k] for k in range(p))).sum(axis=0) for i in range(p))
    freedom, freedom_squared = weight - lost, weight_squared - 2 * cubes + (shape**2).sum(axis=(0, 1))
    unit, free = root((spread * inverse).sum(axis=1)), solvable & (freedom > NO_FREEDOM * weight)
    freedom, freedom_squared = jnp.where(free, freedom, 1), jnp.where(free, freedom_squared, 1)
    if variance is None:
        stderr, dof = jnp.where(free, unit * root(rss / freedom), jnp.nan), freedom**2 / freedom_squared
    else:
        stderr, dof, free = unit * root(jnp.asarray(variance)), jnp.full_like(weight, jnp.inf), solvable

    left = first[p][1] - sum_of(theta[i] * first[i][p + 1 - i] for i in range(p))
    over = 1 / jnp.where(weight > 0, weight, 1)
    scatter = first[p][0] - first[p][1] ** 2 * over
    vaf = jnp.where(scatter > 0, 1 - (rss - left**2 * over) / jnp.where(scatter > 0, scatter, 1), jnp.nan)

    def or_nan(value: Array, known: Array = solvable) -> Array:
        return jnp.where(known, value, jnp.nan)

    return _Now(
        theta=or_nan(jnp.stack(theta)),
        stderr=or_nan(stderr),
        excitation=or_nan(1 / jnp.sqrt((inverse**2).sum(axis=1))),
        dof=or_nan(dof, free),
        cond=or_nan(divided(sigma_max, sigma_min)),
        sigma_min=or_nan(sigma_min),
        residual_rms=or_nan(root(rss * over)),
        vaf=or_nan(vaf),
        samples=weight,
    )


def _of_unit(row: Array) -> Array:
    """The row of a unit matrix's upper triangle."""
    return jnp.zeros_like(row).at[0].set(1)


def _watched(found: _Now, forgetting: float | Array, valid: Array) -> RecursiveFit:
    """The estimates of all samples (N, ...), those held where the memory has lost a parameter."""
    excitation, faded = _watched_excitation(found), _fading(forgetting)[:, None] * jnp.cumsum(valid)[:, None]
    best = jnp.exp(jax.lax.cummax(jnp.log(excitation) + faded, axis=1) - faded)
    known, lost = _known_and_lost(excitation, *best)
    index = jnp.arange(len(valid))

    def last(which: Array) -> Array:
        return jax.lax.cummax(jnp.where(which, index, -1))

    last_known, last_valid = last(known), last(valid)
    held = last(lost) > last_known
    source = jnp.where(held, last_known, index)
    fit = _as_fit(found, held, last_valid)
    return eqx.tree_at(lambda f: f.held, jax.tree.map(lambda x: x[source], fit), held)


def _watched_excitation(found: _Now) -> Array:
    """(..., p); zero where nothing is determined."""
    excitation = jax.lax.stop_gradient(found.excitation)
    return jnp.where(jnp.isnan(excitation), 0, excitation)


def _fading(forgetting: float | Array) -> Array:
    """(2, 1) logarithms of the factors by which the best excitations fall with every sample."""
    return jnp.array([[FADING], [OF_LATE]]) * (1 - jax.lax.stop_gradient(jnp.asarray(forgetting)))


def _known_and_lost(excitation: Array, best: Array, of_late: Array) -> tuple[Array, Array]:
    """Whether all parameters (..., p) are known well, and whether one of them is lost."""
    known = (excitation > 0) & (KNOWN * excitation >= best) & (USUAL * excitation >= of_late)
    return known.all(axis=-1), (LOST * excitation < best).any(axis=-1)


def _as_fit(found: _Now, held: Array | bool, renewed: Array) -> RecursiveFit:
    """Found after one sample, or after all of them."""
    samples = jnp.round(jax.lax.stop_gradient(found.samples)).astype(int)
    return RecursiveFit(**found._replace(samples=samples)._asdict(), held=jnp.asarray(held), renewed=renewed)


def _where(chosen: Array, yes: RecursiveFit, no: RecursiveFit) -> RecursiveFit:
    return jax.tree.map(lambda a, b: jnp.where(chosen, a, b), yes, no)
