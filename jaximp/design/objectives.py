"""What the Gram matrix `W'W` of a regressor says of the estimates: conditioning, volume, standard errors.

Logarithms, the smaller the better, of p by p matrices by the thousand. Singular values are roots of the eigenvalues,
whose derivative is `v' dG v`: exact for distinct values however close, and one of the subgradients (that of whichever
eigenvectors come out) where they coincide.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaximp.least_squares import engine


@jax.custom_jvp
def extreme_eigenvalues(gram: Float[Array, "*M p p"]) -> tuple[Float[Array, "*M"], Float[Array, "*M"]]:
    """Smallest and largest eigenvalue of positive definite matrices, without LAPACK: its batched calls can block each
    other for ever where several programs run at a time. No smaller than what rounding leaves of the largest."""
    low, high = engine.extreme_eigenvalues(_lanes(gram))
    floor = jnp.finfo(gram.dtype).eps * high
    return jnp.maximum(low, floor).reshape(gram.shape[:-2]), high.reshape(gram.shape[:-2])


@extreme_eigenvalues.defjvp
def _derivative_of_extremes(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Any, Any]:
    (gram,), (change,) = primals, tangents
    low, high = extreme_eigenvalues(gram)
    unit = jnp.eye(gram.shape[-1], dtype=gram.dtype)
    shift = 1e-12 * high
    slopes = []
    for matrix in (
        gram - (low - shift)[..., None, None] * unit,
        (high + shift)[..., None, None] * unit - gram,
    ):
        v = _null_vector(matrix)
        slopes.append(jnp.einsum("...i,...ij,...j->...", v, change, v))
    return (low, high), tuple(slopes)


def _null_vector(matrix: Float[Array, "*M p p"]) -> Float[Array, "*M p"]:
    """Unit vectors that positive semidefinite matrices nearly annihilate, by inverse iteration."""
    p = matrix.shape[-1]
    lanes, shape = _lanes(matrix), matrix.shape[:-2]
    # No eigenvector is orthogonal to this start but by chance.
    v = jnp.asarray(1 + 0.1 * np.sin(np.arange(1.0, p + 1)))[:, None] * jnp.ones_like(lanes[0])
    for _ in range(3):
        x = jnp.stack(engine.substitute(engine.cholesky(_bordered(lanes, v)), p))
        v = x / jnp.sqrt((x**2).sum(axis=0))
    return jnp.moveaxis(v, 0, -1).reshape(*shape, p)


def _lanes(matrices: Float[Array, "*M p p"]) -> Float[Array, "p p lanes"]:
    """Matrices side by side along the last axis, where `engine` works on all of them at a time."""
    p = matrices.shape[-1]
    return jnp.moveaxis(matrices.reshape(-1, p, p), 0, -1)


def _bordered(lanes: Array, column: Array | None = None) -> engine.Rows:
    """Rows of the upper triangle, with one more column for a system of equations."""
    rows = [lanes[i, i:] for i in range(len(lanes))]
    if column is None:
        return tuple(rows)
    return (*(jnp.concatenate([row, column[i][None]]) for i, row in enumerate(rows)), jnp.ones_like(column[:1]))


def log_condition(gram: Float[Array, "*M p p"]) -> Float[Array, "*M"]:
    """Logarithm of the condition number of W, from its Gram matrix."""
    low, high = extreme_eigenvalues(gram)
    return 0.5 * (jnp.log(high) - jnp.log(low))


def log_volume(gram: Float[Array, "*M p p"]) -> Float[Array, "*M"]:
    """Minus half the logarithm of the determinant of the Gram matrix, per parameter."""
    pivots = jnp.stack([row[0] for row in engine.cholesky(_bordered(_lanes(gram)))])
    return -jnp.log(pivots).mean(axis=0).reshape(gram.shape[:-2])


def log_sigma_min(gram: Float[Array, "*M p p"]) -> Float[Array, "*M"]:
    """Minus the logarithm of the smallest singular value of W."""
    return -0.5 * jnp.log(extreme_eigenvalues(gram)[0])


def log_stderr(gram: Float[Array, "*M p p"], parameter: int) -> Float[Array, "*M"]:
    """Logarithm of the standard error of one parameter for torque noise of 1 N m."""
    p, lanes = gram.shape[-1], _lanes(gram)
    unit = jnp.zeros_like(lanes[0]).at[parameter].set(1)
    variance = engine.substitute(engine.cholesky(_bordered(lanes, unit)), p)[parameter]
    return 0.5 * jnp.log(variance).reshape(gram.shape[:-2])


def solve_gram(gram: Float[Array, "p p"], right: Float[Array, "p k"]) -> Float[Array, "p k"]:
    """`gram^-1 @ right` of one positive definite matrix, without LAPACK as above."""
    p, k = right.shape
    lanes = jnp.broadcast_to(gram[:, :, None], (p, p, k))
    return jnp.stack(engine.substitute(engine.cholesky(_bordered(lanes, right)), p))
