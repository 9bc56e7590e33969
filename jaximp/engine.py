"""Least squares of all windows of a chunk of a recording: the mathematics of `windows.sliding_least_squares`.

Window k needs the sums over its rows of all products of two columns of `X = [W y]`: its Gram matrix. Neighbours share
nearly all rows, so that the sums cost the same for every window length. The tricks, each named once:

**Preconditioning.** Gram matrices square the condition number. So the columns are first divided by the triangle R of
the chunk, `R'R = X'X`: in these coordinates a window is nearly orthonormal, squaring costs nothing, and what comes out
is as accurate as a QR decomposition (it is Cholesky QR with a preconditioner that many windows share; R itself need not
be accurate). The last column becomes the residual of the chunk's own fit, so that no residual is a difference of large
numbers. The estimates, `theta = R_w^-1 (z + rho theta~)`, come back by substitution.

**Blocks.** Rows are summed in blocks, runs of m blocks by doubling, `s_2k(i) = s_k(i) + s_k(i + k)`: nothing is ever
subtracted, so that nothing cancels after a large motion. Windows between two blocks are reached in at most `BLOCK`
steps from the one at the block's beginning; only these steps take rows out again, and a window that has lost nearly all
of its weight on the way is `doubtful`.

**Lanes.** Blocks lie along the last axis, and every formula is written out over it: no small matrix is ever handed to
a library. Cholesky, substitution, the two ends of the spectrum (Householder's tridiagonal form and Laguerre's
iteration from above) cost a few operations a window.

**Barriers.** XLA would recompute a row of the triangle wherever it is used; `_keep` makes it write the row once.
(`COMPILER_OPTIONS` keep the barriers until the code is cut into loops; without them the result is the same, slower.)

Windows that the shared triangle does not suit (`doubtful`: the motion there differs in kind from the chunk's) are left
to the QR decomposition of `least_squares`, one by one.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

COMPILER_OPTIONS: dict[str, Any] = {"xla_disable_hlo_passes": "cse_barrier_expander"}
BLOCK = 16
"""Rows in a block, at least."""
DOUBT = 1e-2
"""A pivot below this share of its column leaves the window's estimate to a QR decomposition."""
WELL_CONDITIONED = 1e-8
"""Ratio of a Gram matrix's eigenvalues down to which the smaller is accurate enough."""
MOST_ITERATIONS = 40
"""Of Laguerre's method: it converges cubically, but where two eigenvalues nearly coincide."""

Rows = tuple[Array, ...]
"""Upper triangle of a symmetric matrix per lane: entry i holds row i from the diagonal on, (p - i, lanes)."""


class Plan(NamedTuple):
    """What the compiled code of a chunk depends on; all of it static."""

    step: int
    """Rows from one window to the next."""
    per_block: int
    """Windows that begin in a block."""
    lanes: int
    """Blocks in a chunk."""
    room: int
    """Blocks of the longest window, rounded up."""
    outputs: int
    """Rows of one sample."""
    statistics: bool
    """Whether more than theta is wanted."""

    @property
    def block(self) -> int:
        """Rows in a block."""
        return self.step * self.per_block

    @property
    def windows(self) -> int:
        """Windows in a chunk."""
        return self.per_block * self.lanes

    @property
    def advance(self) -> int:
        """Rows from one chunk to the next."""
        return self.block * self.lanes

    @property
    def rows(self) -> int:
        """Rows that a chunk looks at."""
        return self.block * (self.lanes + self.room)


class ChunkFit(NamedTuple):
    """What is found for the K windows of a chunk; without statistics only the first three."""

    theta: Array
    """(K, p), meaningless where `solvable` is False."""
    solvable: Array
    """(K,) False where there is no unique solution."""
    doubtful: Array
    """(K,) True where the numbers may be wrong and a QR decomposition must decide."""
    statistics: Statistics | None = None


class Statistics(NamedTuple):
    """What judges an estimate, as in `least_squares.WindowFit`; (K,) but for `inverse_norm`."""

    inverse_norm: Array
    """(K, p) norm of each row of the inverse triangle: reciprocal excitation, standard error for noise of size one."""
    sigma_max: Array
    sigma_min: Array
    rss: Array
    """Residual sum of squares."""
    vaf: Array
    samples: Array


def solve_chunk(plan: Plan, columns: Array, valid: Array, window: Array | int) -> ChunkFit:
    """Fit every window of a chunk.

    **Arguments:** `columns` (p + 1, rows) of W and y, zero where `valid` (rows,) is False, with the rows of several
    outputs in turn; `window` its length in rows, at least a block and at most `plan.room` blocks.
    """
    p = len(columns) - 1
    X, R = _preconditioned(columns)
    features = X if not plan.statistics else _with_statistics(X, columns[p], valid, plan.outputs)
    blocked = _in_blocks(features, plan)
    tail = _in_blocks(lax.dynamic_slice_in_dim(features, window, plan.advance, axis=1), plan)
    first = _first_windows(blocked, plan, window, p + 1)
    solve = partial(_solve, plan, p, R)

    def advance(
        state: tuple[Rows, Array], leaving_and_entering: tuple[Array, Array]
    ) -> tuple[tuple[Rows, Array], ChunkFit]:
        sums, peak = state
        found = solve(sums, peak)
        leaving, entering = _keep(leaving_and_entering)
        for old, new in zip(leaving, entering, strict=True):
            less, more = _products(old, p + 1), _products(new, p + 1)
            sums = tuple(s - a + b for s, a, b in zip(sums, less, more, strict=True))
        sums = _keep(sums)
        return (sums, jnp.maximum(peak, _diagonal(sums, p))), found

    state = first, _diagonal(first, p)
    if plan.per_block == 1:
        return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), solve(*state))
    leaving, entering = (
        x[:, :, : plan.lanes].reshape(plan.per_block, plan.step, len(features), plan.lanes) for x in (blocked, tail)
    )
    found = lax.scan(advance, state, (leaving, entering))[1]
    return jax.tree.map(lambda x: jnp.moveaxis(x, (-1, 0), (0, 1)).reshape(plan.windows, *x.shape[1:-1]), found)


def _keep(x: Any) -> Any:
    """Write these numbers to memory: whoever needs them must not compute them again."""
    return lax.optimization_barrier(x)


def _preconditioned(columns: Array) -> tuple[Array, Array]:
    """The columns divided by the chunk's triangle R, (p + 1, rows), and R itself.

    The estimates do not depend on R, and neither do their derivatives.
    """
    gram = _keep(lax.stop_gradient(columns @ columns.T))
    R = _keep(_triangle_of_chunk(gram, columns.shape[1] * float(jnp.finfo(columns.dtype).eps)))
    divided: list[Array] = []
    for j, rest in enumerate(columns):
        for i, column in enumerate(divided):
            rest = rest - R[i, j] * column
        divided.append(_keep(rest / R[j, j]))
    return _keep(jnp.stack(divided)), R


def _triangle_of_chunk(gram: Array, floor: float) -> Array:
    """Upper triangle R with `R'R` nearly the matrix: no pivot falls below `floor` times its column, or to zero."""

    def add_row(j: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        left, R = state
        pivot = jnp.maximum(left[j, j], floor * gram[j, j])
        pivot = jnp.where(pivot > 0, pivot, 1)
        row = jnp.where(jnp.arange(len(gram)) > j, left[j], 0) / jnp.sqrt(pivot)
        return left - jnp.outer(row, row), R.at[j].set(row.at[j].set(jnp.sqrt(pivot)))

    return lax.fori_loop(0, len(gram), add_row, (gram, jnp.zeros_like(gram)))[1]


def _with_statistics(X: Array, y: Array, valid: Array, outputs: int) -> Array:
    """Further rows: the torque less its mean over the chunk, and which output each row belongs to."""
    output = jnp.arange(X.shape[1]) % outputs
    member = (output == jnp.arange(outputs)[:, None]) & valid
    mean = (member * y).sum(axis=1) / jnp.maximum(member.sum(axis=1), 1)
    centred = jnp.where(valid, y - mean[output], 0)
    return _keep(jnp.concatenate([X, centred[None], member.astype(X.dtype)]))


def _in_blocks(x: Array, plan: Plan) -> Array:
    """(features, rows) -> (rows of a block, features, blocks)."""
    return _keep(x.reshape(len(x), -1, plan.block).transpose(2, 0, 1))


def _products(x: Array, n_products: int) -> Rows:
    """All products that are summed over the rows of a window, of features x (features, lanes).

    The upper triangle of the first `n_products` features; of those behind, the first (the centred torque) with itself,
    and each other (the rows of one output) with all features.
    """
    triangle = tuple(x[i] * x[i:n_products] for i in range(n_products))
    if len(x) == n_products:
        return triangle
    return (*triangle, x[n_products] * x[n_products : n_products + 1], *(member * x for member in x[n_products + 1 :]))


def _first_windows(blocked: Array, plan: Plan, window: Array | int, n_products: int) -> Rows:
    """Sums over the windows that begin with a block: whole blocks, and the first rows of the block behind them."""
    whole, rest = window // plan.block, window % plan.block
    full = _sum_of_rows(blocked, n_products)
    first = _runs_of(_keep(jnp.concatenate(full)), whole, plan)

    def with_part(first: Array) -> Array:
        behind = lax.dynamic_slice_in_dim(blocked, whole, plan.lanes, axis=2)
        behind = _keep(behind * (jnp.arange(plan.block) < rest)[:, None, None])
        return first + jnp.concatenate(_sum_of_rows(behind, n_products))

    first = lax.cond(rest > 0, with_part, lambda first: first, first)
    ends = np.cumsum([len(group) for group in full])
    return _keep(tuple(first[end - len(group) : end] for end, group in zip(ends, full, strict=True)))


def _sum_of_rows(blocked: Array, n_products: int) -> Rows:
    """Products of every row of a block, summed, several rows at a time."""
    at_once = next(n for n in range(BLOCK, 0, -1) if len(blocked) % n == 0)

    def add(rows: Array) -> Rows:
        parts = [_products(row, n_products) for row in rows]
        return _keep(tuple(sum(terms[1:], terms[0]) for terms in zip(*parts, strict=True)))

    groups = blocked.reshape(-1, at_once, *blocked.shape[1:])
    if len(groups) == 1:
        return add(groups[0])

    def accumulate(sums: Rows, rows: Array) -> tuple[Rows, None]:
        return _keep(tuple(s + more for s, more in zip(sums, add(_keep(rows)), strict=True))), None

    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(add, groups[0]))
    return lax.scan(accumulate, nothing, groups)[0]


def _runs_of(blocks: Array, length: Array | int, plan: Plan) -> Array:
    """Sums of `length` blocks in a row, from each of the first `lanes` blocks on, by doubling."""
    total, done = jnp.zeros_like(blocks[:, : plan.lanes]), jnp.zeros((), int)
    for bit in range(plan.room.bit_length()):
        taken = (length >> bit) & 1
        run = _keep(lax.dynamic_slice_in_dim(blocks, done, plan.lanes, axis=1))
        total, done = total + jnp.where(taken, run, 0), done + (taken << bit)
        if 2 << bit <= plan.room:
            total, blocks = _keep((total, blocks[:, : -(1 << bit)] + blocks[:, 1 << bit :]))
    return total


def _diagonal(sums: Rows, p: int) -> Array:
    """(p, lanes) squared norm of every column."""
    return jnp.stack([sums[i][0] for i in range(p)])


def _solve(plan: Plan, p: int, R: Array, sums: Rows, peak: Array) -> ChunkFit:
    """Estimates of one window in every lane, from its sums."""
    triangle = _cholesky(sums[: p + 1])
    pivots = jnp.stack([row[0] for row in triangle[:p]])
    # What the other columns leave of a column, in the given units, against the column itself and its rounding.
    rounding = plan.rows * jnp.finfo(R.dtype).eps
    bound = jnp.abs(R[:p, :p]).T @ jnp.sqrt(_keep(_diagonal(sums, p)))
    solvable = (pivots * jnp.diagonal(R)[:p, None] > rounding * bound).all(axis=0)
    doubtful = solvable & (pivots**2 <= DOUBT * peak).any(axis=0)
    inner = _substitute(triangle, p)
    theta = jnp.stack(_theta(inner, R, p))
    if not plan.statistics:
        return ChunkFit(theta, solvable, doubtful)
    return ChunkFit(theta, solvable, doubtful, _statistics(plan, triangle, inner, R, sums))


def _cholesky(sums: Rows) -> Rows:
    """Upper triangle with `R'R` the given matrix, row by row; a pivot that is not positive becomes one."""
    triangle: list[Array] = []
    for j, row in enumerate(sums):
        rest = row
        for i, above in enumerate(triangle):
            rest = rest - above[j - i] * above[j - i :]
        triangle.append(_keep(rest * lax.rsqrt(jnp.where(rest[0] > 0, rest[0], 1))))
    return tuple(triangle)


def _substitute(triangle: Rows, p: int) -> list[Array]:
    """Back through the window's triangle: the estimate in the chunk's coordinates."""
    inner: list[Array] = list(triangle[:p])
    for i in reversed(range(p)):
        rest = triangle[i][p - i]
        for k in range(i + 1, p):
            rest = rest - triangle[i][k - i] * inner[k]
        inner[i] = _keep(rest / triangle[i][0])
    return inner


def _theta(inner: list[Array], R: Array, p: int) -> list[Array]:
    """Back through the chunk's triangle: the estimate in the given units."""
    theta = list(inner)
    for i in reversed(range(p)):
        rest = R[i, p] + R[p, p] * inner[i]
        for k in range(i + 1, p):
            rest = rest - R[i, k] * theta[k]
        theta[i] = _keep(rest / R[i, i])
    return theta


def _statistics(plan: Plan, triangle: Rows, inner: list[Array], R: Array, sums: Rows) -> Statistics:
    p = len(inner)
    constant = tuple(lax.stop_gradient(row[: p - i]) for i, row in enumerate(triangle[:p]))
    given, inverse = _triangle_and_inverse(constant, R[:p, :p])
    sigma_max, sigma_min = _extreme_singular_values(given, inverse)
    rss = (R[p, p] * triangle[p][0]) ** 2
    square, by_output = sums[p + 1][0], sums[p + 2 :]
    total, left, samples = square, rss, jnp.zeros_like(square)
    for output, row in enumerate(by_output):
        count = row[p + 2 + output]
        residual = R[p, p] * (row[p] - sum(theta * column for theta, column in zip(inner, row, strict=False)))
        total = total - row[p + 1] ** 2 / jnp.maximum(count, 1)
        left = left - residual**2 / jnp.maximum(count, 1)
        samples = samples + count
    vaf = jnp.where(total > 0, 1 - left / jnp.where(total > 0, total, 1), jnp.nan)
    return Statistics(jnp.sqrt((inverse**2).sum(axis=1)), sigma_max, sigma_min, rss, vaf, samples)


def _triangle_and_inverse(triangle: Rows, R: Array) -> tuple[Array, Array]:
    """The window's triangle in the given units, and its inverse; (p, p, lanes)."""
    p, scale = len(R), R[:, :, None]
    given = _keep(jnp.stack([_total(row[k - i] * scale[k] for k in range(i, p)) for i, row in enumerate(triangle)]))
    unit = jnp.eye(p, dtype=R.dtype)[:, :, None] * jnp.ones_like(given[0, 0])
    rows = list(unit)
    for i in reversed(range(p)):
        rest = unit[i]
        for k in range(i + 1, p):
            rest = rest - given[i, k] * rows[k]
        rows[i] = _keep(rest / given[i, i])
    return given, _keep(jnp.stack(rows))


def _extreme_singular_values(given: Array, inverse: Array) -> tuple[Array, Array]:
    """Largest and smallest singular value of the triangle `given`, as eigenvalues of its Gram matrix.

    The smallest of these drowns in rounding where the matrix is ill conditioned; if any is, it is found as the largest
    of the inverse, which does not.
    """
    p = len(given)

    def gram() -> Array:
        return jnp.stack([_total(given[k, i] * given[k] for k in range(i + 1)) for i in range(p)])

    def inverse_gram() -> Array:
        return jnp.stack([_total(inverse[i, k] * inverse[:, k] for k in range(i, p)) for i in range(p)])

    def unfinished(state: tuple[Array, Array, Array]) -> Array:
        count, largest, smallest = state
        return (count == 0) | ((count == 1) & (smallest < WELL_CONDITIONED * largest).any())

    def find(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        count, largest, _ = state
        diagonal, squares = _tridiagonal(_keep(lax.cond(count == 0, gram, inverse_gram)))
        high = _largest_root(diagonal, squares, _upper_bound(diagonal, squares))
        low = -_largest_root(-diagonal, squares, jnp.zeros_like(high))
        return _keep((count + 1, jnp.where(count == 0, high, largest), jnp.where(count == 0, low, 1 / high)))

    nothing = jnp.zeros_like(given[0, 0])
    _, largest, smallest = lax.while_loop(unfinished, find, (jnp.zeros((), int), nothing, nothing))
    return jnp.sqrt(largest), jnp.sqrt(smallest)


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
        v, over = _keep((jnp.concatenate([x[:1] - head, x[1:]]), over))
        rest = matrix[1:, 1:]
        image = _keep(_total(rest[k] * v[k] for k in range(len(v))) * over)
        w = _keep(image - (over / 2) * (v * image).sum(axis=0) * v)
        matrix = _keep(rest - v[:, None] * w - w[:, None] * v)
    diagonal += [matrix[k, k] for k in range(len(matrix))]
    squares += [matrix[0, 1] ** 2] if len(matrix) == 2 else []
    return _keep((jnp.stack(diagonal), jnp.stack([*squares, jnp.zeros_like(diagonal[0])])))


def _upper_bound(diagonal: Array, squares: Array) -> Array:
    """Frobenius's norm: no eigenvalue is larger."""
    return jnp.sqrt((diagonal**2).sum(axis=0) + 2 * squares.sum(axis=0)) * (1 + 8 * jnp.finfo(diagonal.dtype).eps)


def _largest_root(diagonal: Array, squares: Array, start: Array) -> Array:
    """Largest eigenvalue of a tridiagonal matrix: Laguerre's iteration falls to it from above and never passes it."""
    p = len(diagonal)
    small = 4 * jnp.finfo(diagonal.dtype).eps

    def unfinished(state: tuple[Array, Array, Array]) -> Array:
        value, step, count = state
        return (step > small * jnp.abs(value)).any() & (count < MOST_ITERATIONS)

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
        step = jnp.where(above, p / (first + root), 0)
        return _keep((value - step, step, count + 1))

    return lax.while_loop(unfinished, improve, (start, jnp.full_like(start, jnp.inf), jnp.zeros((), int)))[0]


def _total(terms: Iterable[Array]) -> Array:
    first, *others = terms
    return sum(others, first)
