"""Recursive least squares with a forgetting factor, sample by sample: the rival that Tout et al. 2023 compare with.

The state is the information matrix, not its inverse: it needs no guess of an initial covariance, cannot wind up or
lose its symmetry, and its estimate is exactly the exponentially weighted least squares solution.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Num, Shaped

from jaximp.least_squares import check_finite
from jaximp.signals import require_float64
from jaximp.types import AnyArray


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
    if not isinstance(forgetting, jax.core.Tracer) and not 0 < forgetting <= 1:
        raise ValueError(f"the forgetting factor is {forgetting}: it must lie in (0, 1]")
    valid = jnp.ones(len(y), bool) if valid is None else jnp.asarray(valid, bool)
    if valid.shape != y.shape:
        raise ValueError(f"valid has shape {valid.shape}: expected {y.shape}")
    check_finite(W, y, valid)
    return RecursiveFit(_run(W, y, forgetting, valid))


@jax.jit
def _run(W: Array, y: Array, forgetting: float | Array, valid: Array) -> Array:
    def advance(state: RecursiveState, sample: tuple[Array, Array, Array]) -> tuple[RecursiveState, RecursiveState]:
        w, torque, counts = sample
        new = _absorb(state, w, torque, forgetting)
        new = jax.tree.map(lambda fresh, old: jnp.where(counts, fresh, old), new, state)
        return new, new

    states = jax.lax.scan(advance, init(W.shape[1]), (W, y, valid))[1]
    return jax.vmap(_solve)(states)


def _absorb(state: RecursiveState, w: Array, y: Array, forgetting: float | Array) -> RecursiveState:
    return RecursiveState(forgetting * state.information + jnp.outer(w, w), forgetting * state.moment + w * y)


def _solve(state: RecursiveState) -> Array:
    """Solve with every column scaled to length one; NaN while the information is singular."""
    square = jnp.diagonal(state.information)
    size = jnp.sqrt(jnp.where(square > 0, square, 1))
    scaled = state.information / jnp.outer(size, size)
    solvable = jnp.diagonal(jnp.linalg.cholesky(jax.lax.stop_gradient(scaled))).min() > 1e-7
    # A singular matrix is replaced before it is factored, or its NaN would reach the gradient.
    factor = jnp.linalg.cholesky(jnp.where(solvable, scaled, jnp.eye(len(size))))
    theta = jax.scipy.linalg.cho_solve((factor, True), state.moment / size) / size
    return jnp.where(solvable, theta, jnp.nan)
