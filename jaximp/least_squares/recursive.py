"""Recursive least squares with a forgetting factor, sample by sample: the rival that Tout et al. 2023 compare with.

The state is the information matrix, not its inverse: it needs no guess of an initial covariance, cannot wind up or
lose its symmetry, and its estimate is exactly the exponentially weighted least squares solution.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num, Shaped

from jaximp.least_squares.window import check_finite
from jaximp.numerics.compilation import compiled, is_traced, keep
from jaximp.numerics.lanes import Rows, cholesky, substitute
from jaximp.numerics.precision import require_float64
from jaximp.types import AnyArray

SINGULAR = 1e-14
"""What the other columns must leave of a column's square: below, rounding decides."""
STRETCHES, SHORTEST = 1000, 50
"""A recording is cut into so many stretches, of so many samples at least."""


class RecursiveState(eqx.Module):
    """All that is remembered of the samples seen so far."""

    information: Float[Array, "p p"]
    """Weighted sum of w w'."""
    moment: Float[Array, " p"]
    """Weighted sum of w y."""


class RecursiveFit(eqx.Module):
    """The estimate after every sample."""

    theta: Float[Array, "N p"]
    """Parameters; NaN until the samples seen determine all of them."""


def init(n_parameters: int) -> RecursiveState:
    """The state before the first sample."""
    return RecursiveState(jnp.zeros((n_parameters, n_parameters)), jnp.zeros(n_parameters))


def step(
    state: RecursiveState, w: Num[AnyArray, " p"], y: Num[AnyArray, ""], forgetting: float | Array = 1.0
) -> tuple[RecursiveState, Float[Array, " p"]]:
    """Take one sample in, and return the new state and estimate.

    **Arguments:** regressor `w` (p,), torque `y` [N m], and `forgetting`, the weight that a sample loses with every
    new one: after k samples it counts `forgetting**k`.
    """
    new = _absorb(state, w, y, forgetting)
    return new, _solve(new)


def recursive_least_squares(
    W: Num[AnyArray, "..."],
    y: Num[AnyArray, "..."],
    forgetting: float | Array = 1.0,
    *,
    valid: Shaped[AnyArray, " N"] | None = None,
) -> RecursiveFit:
    """Estimates after each of the N samples: `step` run over a recording. A sample that is not valid changes nothing.

    **Raises:** `ValueError` for shapes that disagree and a forgetting factor outside (0, 1].

    **Source:** Tout et al. 2023, section IV-B.
    """
    require_float64(W, y)
    W, y = jnp.asarray(W, float), jnp.asarray(y, float)
    if W.ndim != 2 or y.shape != W.shape[:1]:
        raise ValueError(f"W has shape {W.shape} and y {y.shape}: expected (N, p) and (N,)")
    if not is_traced(forgetting) and not 0 < forgetting <= 1:
        raise ValueError(f"the forgetting factor is {forgetting}: it must lie in (0, 1]")
    valid = jnp.ones(len(y), bool) if valid is None else jnp.asarray(valid, bool)
    if valid.shape != y.shape:
        raise ValueError(f"valid has shape {valid.shape}: expected {y.shape}")
    check_finite(W, y, valid)
    return RecursiveFit(_run(W, y, forgetting, valid))


@compiled
def _run(W: Array, y: Array, forgetting: float | Array, valid: Array) -> Array:
    """All stretches of a recording at a time: their own sums first, which give the sums that each begins with."""
    n_samples, p = W.shape
    length = max(SHORTEST, -(-n_samples // STRETCHES))
    n_stretches = -(-n_samples // length)
    rows = jnp.where(valid[:, None], jnp.concatenate([W, y[:, None]], axis=1), 0)
    columns = jnp.concatenate([rows, jnp.where(valid, forgetting, 1.0)[:, None]], axis=1)
    behind = n_stretches * length - n_samples
    columns = jnp.pad(columns, ((0, behind), (0, 0)), constant_values=1)
    stretches = keep(columns.reshape(n_stretches, length, p + 2).transpose(1, 2, 0))

    def absorb(sums: Rows, row: Array) -> Rows:
        return keep(tuple(row[p + 1] * s + row[i] * row[i : p + 1] for i, s in enumerate(sums)))

    def total(state: tuple[Rows, Array], row: Array) -> tuple[tuple[Rows, Array], None]:
        sums, decay = state
        row = keep(row)
        return (absorb(sums, row), keep(decay * row[p + 1])), None

    def advance(sums: Rows, row: Array) -> tuple[Rows, Array]:
        sums = absorb(sums, keep(row))
        return sums, _theta(sums, p)

    nothing = tuple(jnp.zeros((p + 1 - i, n_stretches), W.dtype) for i in range(p))
    (sums, decay), _ = jax.lax.scan(total, (nothing, jnp.ones(n_stretches, W.dtype)), stretches)
    theta = jax.lax.scan(advance, _sums_before(sums, decay), stretches)[1]
    return theta.transpose(2, 0, 1).reshape(-1, p)[:n_samples]


def _sums_before(sums: Rows, decay: Array) -> Rows:
    """What all stretches before each one leave of their sums."""
    flat = jnp.concatenate(sums)

    def follow(before: Array, stretch: tuple[Array, Array]) -> tuple[Array, Array]:
        own, kept = stretch
        return kept * before + own, before

    before = jax.lax.scan(follow, jnp.zeros_like(flat[:, 0]), (flat.T, decay))[1].T
    ends = np.cumsum([len(row) for row in sums])
    return keep(tuple(before[end - len(row) : end] for end, row in zip(ends, sums, strict=True)))


def _theta(sums: Rows, p: int) -> Array:
    """(p, lanes) solution of the normal equations; NaN where they are singular."""
    triangle = cholesky(sums)
    pivots = jnp.stack([row[0] for row in triangle])
    solvable = (pivots**2 > SINGULAR * jnp.stack([row[0] for row in sums])).all(axis=0)
    return jnp.where(solvable, jnp.stack(substitute(triangle, p)), jnp.nan)


def _absorb(state: RecursiveState, w: Array, y: Array, forgetting: float | Array) -> RecursiveState:
    return RecursiveState(forgetting * state.information + jnp.outer(w, w), forgetting * state.moment + w * y)


def _solve(state: RecursiveState) -> Array:
    """Solve with every column scaled to length one; NaN while the information is singular."""
    square = jnp.diagonal(state.information)
    size = jnp.sqrt(jnp.where(square > 0, square, 1))
    scaled = state.information / jnp.outer(size, size)
    solvable = jnp.diagonal(jnp.linalg.cholesky(jax.lax.stop_gradient(scaled))).min() ** 2 > SINGULAR
    # A singular matrix is replaced before it is factored, or its NaN would reach the gradient.
    factor = jnp.linalg.cholesky(jnp.where(solvable, scaled, jnp.eye(len(size))))
    theta = jax.scipy.linalg.cho_solve((factor, True), state.moment / size) / size
    return jnp.where(solvable, theta, jnp.nan)
