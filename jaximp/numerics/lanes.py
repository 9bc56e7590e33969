"""Linear algebra of many small matrices side by side, which are lanes along the last axis.

Every formula is written out over the lanes: no small matrix is ever handed to a library, and Cholesky's triangle,
substitution and the two ends of the spectrum cost a few operations a matrix. Under `compilation.compiled`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaximp.numerics.compilation import keep

WELL_CONDITIONED = 4e7
"""Ratio of a Gram matrix's eigenvalues, in units of rounding, down to which the smaller is accurate enough."""
MOST_ITERATIONS = 40
"""Of Laguerre's method: it converges cubically, but where two eigenvalues nearly coincide."""
APART = 1e-12
"""By this share of the largest eigenvalue a matrix is shifted, so that inverse iteration for its end converges."""

Rows = tuple[Array, ...]
"""Upper triangle of a symmetric matrix per lane: entry i holds row i from the diagonal on, (p - i, lanes)."""


def as_lanes(matrices: Float[Array, "*M p p"]) -> Float[Array, "p p lanes"]:
    """Matrices side by side along the last axis."""
    p = matrices.shape[-1]
    return jnp.moveaxis(matrices.reshape(-1, p, p), 0, -1)


def as_rows(lanes: Float[Array, "p p lanes"], right: Float[Array, "p lanes"] | None = None) -> Rows:
    """Rows of the upper triangle, with one more column for a system of equations."""
    rows = [lanes[i, i:] for i in range(len(lanes))]
    if right is None:
        return tuple(rows)
    return (*(jnp.concatenate([row, right[i][None]]) for i, row in enumerate(rows)), jnp.ones_like(right[:1]))


def sum_of(terms: Iterable[Array]) -> Array:
    """Sum of some arrays, one after another."""
    first, *others = terms
    return sum(others, first)


def cholesky(sums: Rows) -> Rows:
    """Upper triangle with `R'R` the given matrix, row by row.

    The row of a pivot that is not positive is meaningless, but finite.
    """
    triangle: list[Array] = []
    for j, row in enumerate(sums):
        rest = row
        for i, above in enumerate(triangle):
            rest = rest - above[j - i] * above[j - i :]
        triangle.append(keep(rest * lax.rsqrt(jnp.where(rest[0] > 0, rest[0], 1))))
    return tuple(triangle)


def divided(x: Array | float, pivot: Array) -> Array:
    """`x / pivot`, and x where the pivot is zero: meaningless there, but finite, and so is its derivative."""
    return x / jnp.where(pivot == 0, 1, pivot)


def substitute(triangle: Rows, p: int) -> list[Array]:
    """Back through a triangle of p rows whose last column is the right-hand side: the p unknowns."""
    inner: list[Array] = list(triangle[:p])
    for i in reversed(range(p)):
        rest = triangle[i][p - i]
        for k in range(i + 1, p):
            rest = rest - triangle[i][k - i] * inner[k]
        inner[i] = keep(divided(rest, triangle[i][0]))
    return inner


def inverse_of_rows(triangle: Rows) -> Float[Array, "p p lanes"]:
    """Inverse of a square triangle."""
    p = len(triangle)
    inverse = list(jnp.eye(p, dtype=triangle[0].dtype)[:, :, None] * jnp.ones_like(triangle[0][0]))
    for i in reversed(range(p)):
        rest = inverse[i]
        for k in range(i + 1, p):
            rest = rest - triangle[i][k - i] * inverse[k]
        inverse[i] = keep(divided(rest, triangle[i][0]))
    return jnp.stack(inverse)


def symmetric(triangle: Rows) -> Float[Array, "p p lanes"]:
    """The whole matrix from the rows of its upper triangle."""
    above = [[triangle[k][i - k][None] for k in range(i)] for i in range(len(triangle))]
    return keep(jnp.stack([jnp.concatenate([*left, row]) for left, row in zip(above, triangle, strict=True)]))


def solve_definite(matrix: Float[Array, "p p"], right: Float[Array, "p k"]) -> Float[Array, "p k"]:
    """`matrix^-1 @ right` of one positive definite matrix."""
    p, k = right.shape
    lanes = jnp.broadcast_to(matrix[:, :, None], (p, p, k))
    return jnp.stack(substitute(cholesky(as_rows(lanes, right)), p))


@jax.custom_jvp
def extreme_eigenvalues(
    matrix: Float[Array, "p p lanes"],
) -> tuple[Float[Array, " lanes"], Float[Array, " lanes"]]:
    """Smallest and largest eigenvalue of positive semidefinite matrices, no smaller than the rounding of the largest.

    Their derivative is `v' dA v`: exact for distinct values however close, and one of the subgradients (that of
    whichever eigenvectors come out) where they coincide.
    """
    diagonal, squares = _tridiagonal(matrix)
    high = _largest_root(diagonal, squares, _upper_bound(diagonal, squares))
    low = -_largest_root(-diagonal, squares, jnp.zeros_like(high))
    return jnp.maximum(low, jnp.finfo(matrix.dtype).eps * high), high


@extreme_eigenvalues.defjvp
def _derivative_of_extremes(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Any, Any]:
    (matrix,), (change,) = primals, tangents
    low, high = extreme_eigenvalues(matrix)
    unit = jnp.eye(len(matrix), dtype=matrix.dtype)[:, :, None]
    vectors = null_vectors(matrix - (low - APART * high) * unit), _of_largest(matrix, high)
    return (low, high), tuple((v * (change * v).sum(axis=1)).sum(axis=0) for v in vectors)


def _of_largest(matrix: Array, high: Array) -> Array:
    """(p, lanes) eigenvectors of the largest eigenvalue."""
    return null_vectors((high + APART * high) * jnp.eye(len(matrix), dtype=matrix.dtype)[:, :, None] - matrix)


def null_vectors(matrix: Float[Array, "p p lanes"]) -> Float[Array, "p lanes"]:
    """Unit vectors that positive semidefinite matrices nearly annihilate, by inverse iteration."""
    p = len(matrix)
    # No eigenvector is orthogonal to this start but by chance.
    v = jnp.asarray(1 + 0.1 * np.sin(np.arange(1.0, p + 1)), matrix.dtype)[:, None] * jnp.ones_like(matrix[0])
    for _ in range(3):
        x = jnp.stack(substitute(cholesky(as_rows(matrix, v)), p))
        v = divided(x, jnp.sqrt((x**2).sum(axis=0)))
    return v


@jax.custom_jvp
def extreme_singular_values(
    triangle: Float[Array, "p p lanes"], inverse: Float[Array, "p p lanes"]
) -> tuple[Float[Array, " lanes"], Float[Array, " lanes"]]:
    """Largest and smallest singular value of upper triangles, as eigenvalues of their Gram matrices.

    The smallest of these drowns in rounding where the matrix is ill conditioned; there it is found as the largest of
    the inverse, which does not. What a lane gets does not depend on the others. The derivative is `u' dA v`.
    """
    rounding = jnp.finfo(triangle.dtype).eps

    def drowned(largest: Array, smallest: Array) -> Array:
        return smallest < WELL_CONDITIONED * rounding * largest

    def unfinished(state: tuple[Array, Array, Array]) -> Array:
        count, largest, smallest = state
        return (count == 0) | ((count == 1) & drowned(largest, smallest).any())

    def find(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        count, largest, smallest = state
        gram = lax.cond(count == 0, lambda: _gram(triangle), lambda: _inverse_gram(inverse))
        low, high = extreme_eigenvalues(keep(gram))
        again = jnp.where(drowned(largest, smallest), 1 / high, smallest)
        return keep((count + 1, jnp.where(count == 0, high, largest), jnp.where(count == 0, low, again)))

    nothing = jnp.zeros_like(triangle[0, 0])
    _, largest, smallest = lax.while_loop(unfinished, find, (jnp.zeros((), int), nothing, nothing))
    return jnp.sqrt(largest), jnp.sqrt(smallest)


@extreme_singular_values.defjvp
def _derivative_of_singular_values(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Any, Any]:
    (triangle, inverse), (change, _) = primals, tangents
    high, low = extreme_singular_values(triangle, inverse)
    right = _of_largest(_gram(triangle), high**2), _of_largest(_inverse_gram(inverse), divided(1.0, low**2))
    left = divided((triangle * right[0]).sum(axis=1), high), (inverse * right[1][:, None]).sum(axis=0) * low
    slopes = [(u * (change * v).sum(axis=1)).sum(axis=0) for u, v in zip(left, right, strict=True)]
    return (high, low), (slopes[0], slopes[1])


def _gram(triangle: Array) -> Array:
    """`R'R` of upper triangles R."""
    p = len(triangle)
    return jnp.stack([sum_of(triangle[k, i] * triangle[k] for k in range(i + 1)) for i in range(p)])


def _inverse_gram(inverse: Array) -> Array:
    """`(R'R)^-1`, from the inverse of R."""
    p = len(inverse)
    return jnp.stack([sum_of(inverse[i, k] * inverse[:, k] for k in range(i, p)) for i in range(p)])


def _tridiagonal(matrix: Array) -> tuple[Array, Array]:
    """Diagonal (p, lanes) and squared off-diagonal of Householder's tridiagonal form of symmetric (p, p, lanes)."""
    diagonal, squares = [], []
    while len(matrix) > 2:
        diagonal.append(matrix[0, 0])
        x = matrix[1:, 0]
        square = (x**2).sum(axis=0)
        squares.append(square)
        head = -jnp.copysign(jnp.sqrt(square), x[0])
        half = square - head * x[0]  # half the squared length of the reflected vector
        over = jnp.where(half > 0, 1 / jnp.where(half > 0, half, 1), 0)
        v, over = keep((jnp.concatenate([x[:1] - head, x[1:]]), over))
        rest = matrix[1:, 1:]
        image = keep(sum_of(rest[k] * v[k] for k in range(len(v))) * over)
        w = keep(image - (over / 2) * (v * image).sum(axis=0) * v)
        matrix = keep(rest - v[:, None] * w - w[:, None] * v)
    diagonal += [matrix[k, k] for k in range(len(matrix))]
    squares += [matrix[0, 1] ** 2] if len(matrix) == 2 else []
    return keep((jnp.stack(diagonal), jnp.stack([*squares, jnp.zeros_like(diagonal[0])])))


def _upper_bound(diagonal: Array, squares: Array) -> Array:
    """Frobenius's norm: no eigenvalue is larger."""
    return jnp.sqrt((diagonal**2).sum(axis=0) + 2 * squares.sum(axis=0)) * (1 + 8 * jnp.finfo(diagonal.dtype).eps)


def _largest_root(diagonal: Array, squares: Array, start: Array) -> Array:
    """Largest eigenvalue of a tridiagonal matrix: Laguerre's iteration falls to it from above and never passes it.

    A step of the size of rounding is not taken: a lane that has converged stays as it is while others go on.
    """
    p = len(diagonal)
    small = 4 * jnp.finfo(diagonal.dtype).eps

    def unfinished(state: tuple[Array, Array, Array]) -> Array:
        _, step, count = state
        return (step > 0).any() & (count < MOST_ITERATIONS)

    def improve(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        value, _, count = state
        first = second = slope = curve = coupling = jnp.zeros_like(value)
        above = jnp.ones(value.shape, bool)
        for i in range(p):
            # q = p_i / p_(i-1) by Sturm's recurrence, slope = q'/q, curve = q''/q
            q = value - diagonal[i] - coupling
            above &= q > 0
            over = 1 / jnp.where(q > 0, q, 1)
            slope, curve = (1 + coupling * slope) * over, coupling * (curve - 2 * slope**2) * over
            coupling = squares[i] * over
            first, second = first + slope, second + slope**2 - curve
        root = jnp.sqrt(jnp.maximum((p - 1) * (p * second - first**2), 0))
        step = p / (first + root)
        step = jnp.where(above & (step > small * jnp.abs(value)), step, 0)
        return keep((value - step, step, count + 1))

    return lax.while_loop(unfinished, improve, (start, jnp.full_like(start, jnp.inf), jnp.zeros((), int)))[0]
