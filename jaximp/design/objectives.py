"""What the Gram matrix `W'W` of a regressor says of the estimates: conditioning, volume, standard errors.

Logarithms, the smaller the better, of p by p matrices. Singular values are roots of the eigenvalues. Small matrices
come by the thousand and are written out; those of a robot, with many columns, are left to LAPACK.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaximp.numerics.lanes import as_lanes, as_rows, cholesky, extreme_eigenvalues, substitute

MANY = 12
"""From so many columns on what is written out takes too long to compile."""


def log_condition(gram: Float[Array, "*M p p"]) -> Float[Array, "*M"]:
    """Logarithm of the condition number of W, from its Gram matrix."""
    low, high = _extremes(gram)
    return 0.5 * (jnp.log(high) - jnp.log(low))


def log_volume(gram: Float[Array, "*M p p"]) -> Float[Array, "*M"]:
    """Minus half the logarithm of the determinant of the Gram matrix, per parameter."""
    if gram.shape[-1] >= MANY:
        return -0.5 * jnp.linalg.slogdet(gram)[1] / gram.shape[-1]
    pivots = jnp.stack([row[0] for row in cholesky(as_rows(as_lanes(gram)))])
    return -jnp.log(pivots).mean(axis=0).reshape(gram.shape[:-2])


def log_sigma_min(gram: Float[Array, "*M p p"]) -> Float[Array, "*M"]:
    """Minus the logarithm of the smallest singular value of W."""
    return -0.5 * jnp.log(_extremes(gram)[0])


def log_stderr(gram: Float[Array, "*M p p"], parameter: int) -> Float[Array, "*M"]:
    """Logarithm of the standard error of one parameter for torque noise of 1 N m."""
    p, lanes = gram.shape[-1], as_lanes(gram)
    if p >= MANY:
        return 0.5 * jnp.log(jnp.linalg.inv(gram)[..., parameter, parameter])
    unit = jnp.zeros_like(lanes[0]).at[parameter].set(1)
    variance = substitute(cholesky(as_rows(lanes, unit)), p)[parameter]
    return 0.5 * jnp.log(variance).reshape(gram.shape[:-2])


def _extremes(gram: Float[Array, "*M p p"]) -> tuple[Float[Array, "*M"], Float[Array, "*M"]]:
    """Smallest and largest eigenvalue, none smaller than the rounding of the largest."""
    if gram.shape[-1] >= MANY:
        values = jnp.linalg.eigvalsh(gram)
        return jnp.maximum(values[..., 0], jnp.finfo(gram.dtype).eps * values[..., -1]), values[..., -1]
    low, high = extreme_eigenvalues(as_lanes(gram))
    return low.reshape(gram.shape[:-2]), high.reshape(gram.shape[:-2])
