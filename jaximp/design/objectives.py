"""What the Gram matrix `W'W` of a regressor says of the estimates: conditioning, volume, standard errors.

Logarithms, the smaller the better, of p by p matrices by the thousand. Singular values are roots of the eigenvalues.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaximp.numerics.lanes import as_lanes, as_rows, cholesky, extreme_eigenvalues, substitute


def log_condition(gram: Float[Array, "*M p p"]) -> Float[Array, "*M"]:
    """Logarithm of the condition number of W, from its Gram matrix."""
    low, high = extreme_eigenvalues(as_lanes(gram))
    return (0.5 * (jnp.log(high) - jnp.log(low))).reshape(gram.shape[:-2])


def log_volume(gram: Float[Array, "*M p p"]) -> Float[Array, "*M"]:
    """Minus half the logarithm of the determinant of the Gram matrix, per parameter."""
    pivots = jnp.stack([row[0] for row in cholesky(as_rows(as_lanes(gram)))])
    return -jnp.log(pivots).mean(axis=0).reshape(gram.shape[:-2])


def log_sigma_min(gram: Float[Array, "*M p p"]) -> Float[Array, "*M"]:
    """Minus the logarithm of the smallest singular value of W."""
    return -0.5 * jnp.log(extreme_eigenvalues(as_lanes(gram))[0]).reshape(gram.shape[:-2])


def log_stderr(gram: Float[Array, "*M p p"], parameter: int) -> Float[Array, "*M"]:
    """Logarithm of the standard error of one parameter for torque noise of 1 N m."""
    p, lanes = gram.shape[-1], as_lanes(gram)
    unit = jnp.zeros_like(lanes[0]).at[parameter].set(1)
    variance = substitute(cholesky(as_rows(lanes, unit)), p)[parameter]
    return 0.5 * jnp.log(variance).reshape(gram.shape[:-2])
