"""Linear algebra of one small matrix, to be `vmap`ped over thousands: no LAPACK, derivatives of every order.

A batch of small LAPACK calls costs microseconds a matrix, where the same formula written out over whole arrays is
SIMD; many matrices side by side on the last axis, at the highest speed, are `lanes`. And compiled programs that call
LAPACK can block each other for ever where several threads run them on few cores: with jax 0.10.2, four threads on two
cores stop after a few calls where several decompositions are in one program, and after a thousand with QR alone
(experiments/lapack_threads.py).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num

from jaximp.numerics.compilation import keep

SWEEPS = 10
"""Times that every pair of columns is turned against each other; the error falls with its square every time."""


def root(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square root, whose derivative at zero is zero instead of infinite."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), jnp.where(x == 0, 0, jnp.nan))


def solve_pair(matrix: Num[Any, "*#N 2 2"], right: Num[Any, "*#N 2"]) -> Float[Array, "*N 2"]:
    """`x` with `matrix @ x = right`, by Cramer's rule."""
    (a, b), (c, d) = (matrix[..., 0, 0], matrix[..., 0, 1]), (matrix[..., 1, 0], matrix[..., 1, 1])
    first, second = right[..., 0], right[..., 1]
    return jnp.stack([d * first - b * second, a * second - c * first], axis=-1) / (a * d - b * c)[..., None]


def orthonormal(rows: Float[Array, "S p"]) -> tuple[Float[Array, "S p"], Float[Array, "p p"], Bool[Array, ""]]:
    """`Q, R` with rows = Q R by Gram-Schmidt, every column orthogonalised twice, and whether the rank is full.

    Twice is enough for orthogonality to rounding. A column whose independent part is lost in rounding makes the rank
    deficient, whatever its unit.
    """
    p = rows.shape[1]
    negligible = rows.shape[0] * jnp.finfo(rows.dtype).eps

    def add_column(j: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        Q, R, independent = state
        column = rest = rows[:, j]
        along = jnp.zeros(p, rows.dtype)
        for _ in range(2):
            part = Q.T @ rest
            rest, along = rest - Q @ part, along + part
        left = root((rest * rest).sum())
        independent &= left > negligible * jnp.linalg.norm(column)
        return (
            Q.at[:, j].set(rest / jnp.where(left > 0, left, 1)),
            R.at[:, j].set(along.at[j].set(left)),
            independent,
        )

    empty = jnp.zeros_like(rows), jnp.zeros((p, p), rows.dtype), jnp.array(True)
    return jax.lax.fori_loop(0, p, add_column, empty)


def triangle(columns: Float[Array, "p N"]) -> Float[Array, "p p"]:
    """Upper triangle R of a thin QR decomposition of p columns, by modified Gram-Schmidt; without Q, in half the time.

    The columns need not be independent: a pivot is then zero, or rounding. R is as accurate as Householder's, column by
    column, whatever becomes of the Q that is not returned (Björck 1967).
    """
    p = len(columns)

    def add_row(j: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        columns, R = state
        square = (columns[j] ** 2).sum()
        pivot = jnp.sqrt(jnp.where(square > 0, square, 1)) * (square > 0)
        unit = columns[j] / jnp.where(square > 0, pivot, 1)
        along = jnp.where(jnp.arange(p) > j, (columns * unit).sum(axis=1), 0)
        return keep((columns - along[:, None] * unit, R.at[j].set(along.at[j].set(pivot))))

    return jax.lax.fori_loop(0, p, add_row, (columns, jnp.zeros((p, p), columns.dtype)))[1]


def cholesky(H: Float[Array, "p p"]) -> tuple[Float[Array, "p p"], Bool[Array, ""]]:
    """Upper triangle R with `R' R = H`, and whether H is positive definite; where it is not, R is not to be used."""
    p = len(H)

    def add_row(j: Array, state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        left, R, definite = state
        positive = left[j, j] > 0
        row = jnp.where(jnp.arange(p) >= j, left[j], 0) / jnp.sqrt(jnp.where(positive, left[j, j], 1))
        return keep((left - row[:, None] * row, R.at[j].set(row), definite & positive))

    return jax.lax.fori_loop(0, p, add_row, (H, jnp.zeros_like(H), jnp.array(True)))[1:]


def back_substitute(R: Float[Array, "p p"], right: Float[Array, " p"]) -> Float[Array, " p"]:
    """`x` with `R x = right`, from the upper triangle alone; zero where a pivot is."""
    p = len(right)

    def add_row(k: Array, x: Array) -> Array:
        i = p - 1 - k
        pivot = R[i, i]
        return x.at[i].set(jnp.where(pivot == 0, 0, (right[i] - (R[i] * x).sum()) / jnp.where(pivot == 0, 1, pivot)))

    return jax.lax.fori_loop(0, p, add_row, jnp.zeros_like(right))


def inverse_of_triangle(R: Float[Array, "p p"]) -> Float[Array, "p p"]:
    """Inverse of an upper triangle without a zero on its diagonal, by back substitution."""
    p = R.shape[0]
    unit = jnp.eye(p, dtype=R.dtype)

    def add_row(k: Array, X: Array) -> Array:
        i = p - 1 - k
        return X.at[i].set((unit[i] - R[i] @ X) / R[i, i])

    return jax.lax.fori_loop(0, p, add_row, jnp.zeros_like(R))


@jax.custom_jvp
def singular_values(A: Float[Array, "p p"]) -> Float[Array, " p"]:
    """Singular values, largest first, accurate for the small ones too.

    Their derivative is `u' dA v`: exact for distinct values, and one of the subgradients where they coincide.
    """
    return jnp.sort(jnp.linalg.norm(_turned(A), axis=0))[::-1][: len(A)]


@singular_values.defjvp
def _derivative_of_singular_values(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Any, Any]:
    U, _, V = singular_value_decomposition(*primals)
    return singular_values(*primals), (U * (tangents[0] @ V)).sum(axis=0)


@jax.custom_jvp
def singular_value_decomposition(
    A: Float[Array, "p p"],
) -> tuple[Float[Array, "p p"], Float[Array, " p"], Float[Array, "p p"]]:
    """`U, s, V` with `A = U diag(s) V'`, largest first; the columns of U that belong to zero are zero."""
    p = len(A)
    turned = _turned(A, jnp.eye(p, dtype=A.dtype))
    s = jnp.linalg.norm(turned[:p], axis=0)
    turned, s = turned[:, jnp.argsort(-s)[:p]], jnp.sort(s)[::-1][:p]
    return turned[:p] / jnp.where(s > 0, s, 1), s, turned[p:]


@singular_value_decomposition.defjvp
def _derivative_of_decomposition(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Any, Any]:
    U, s, V = singular_value_decomposition(*primals)
    inner = U.T @ tangents[0] @ V
    gap = s**2 - s[:, None] ** 2
    over = jnp.where(gap == 0, 0, 1 / jnp.where(gap == 0, 1, gap))
    dU, dV = U @ (over * (inner * s + s[:, None] * inner.T)), V @ (over * (s[:, None] * inner + inner.T * s))
    return (U, s, V), (dU, jnp.diagonal(inner), dV)


def _turned(A: Array, below: Array | None = None) -> Array:
    """One-sided Jacobi rotations: columns are turned until they are orthogonal, and what stands below them with them.

    Half of the columns meet the other half at a time. An odd number of columns is filled with a zero one.
    """
    p = A.shape[0]
    half = (p + 1) // 2
    whole = A if below is None else jnp.concatenate([A, below])
    if p == 1:
        return whole

    def rotate(_: Array, whole: Array) -> Array:
        a, b = whole[:p, :half], whole[:p, half:]
        overlap = (a * b).sum(axis=0)
        ratio = ((b * b).sum(axis=0) - (a * a).sum(axis=0)) / (2 * jnp.where(overlap == 0, 1, overlap))
        tangent = jnp.where(ratio < 0, -1, 1) / (jnp.abs(ratio) + jnp.sqrt(1 + ratio**2))
        tangent = jnp.where(overlap == 0, 0, tangent)
        cosine = 1 / jnp.sqrt(1 + tangent**2)
        a, b = whole[:, :half], whole[:, half:]
        a, b = cosine * (a - tangent * b), cosine * (b + tangent * a)
        # As in a tournament: the first stays, the others move on by one place, until everyone has met everyone.
        return jnp.concatenate([a[:, :1], b[:, :1], a[:, 1:-1], b[:, 1:], a[:, 1:][:, -1:]], axis=1)

    even = jnp.pad(whole, ((0, 0), (0, 2 * half - p)))
    return jax.lax.fori_loop(0, SWEEPS * (2 * half - 1), rotate, even)
