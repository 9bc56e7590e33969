"""Sums over the rows of all windows of a chunk: products of columns divided by the chunk's triangle, block by block.

What preconditioning and blocks are says `engine`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaximp.numerics.compilation import keep
from jaximp.numerics.lanes import Rows

BLOCK = 16
"""Rows in a block, at least."""
FEWEST_LANES = 30
"""XLA breaks off the whole process where it compiles the barriers for only a few lanes."""


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
    weighted: bool
    """Whether rows have weights: then they are not their own count."""
    lags: int = 0
    """Lags of the noise's autocovariance, none for white noise; a window has at least `2 reach` rows."""
    predicts: bool = False
    """Whether every window is held against a later one (`Unseen`)."""

    @property
    def reach(self) -> int:
        """Rows over which noise is correlated."""
        return max(self.lags - 1, 0) * self.outputs

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


def features_of(plan: Plan, columns: Array, scale: Array, noise: Array | None) -> tuple[Array, Array]:
    """Everything of which products are summed, (features, rows), and the chunk's triangle R."""
    X, R = _preconditioned(columns)
    if not plan.statistics:
        return X, R
    return keep(jnp.concatenate([X, *_for_statistics(X, columns[-1], scale, plan, noise)])), R


def _preconditioned(columns: Array) -> tuple[Array, Array]:
    """The columns divided by the chunk's triangle R, (p + 1, rows), and R itself.

    The estimates do not depend on R, and neither do their derivatives.
    """
    gram = keep(lax.stop_gradient(columns @ columns.T))
    R = keep(_triangle_of_chunk(gram, columns.shape[1] * float(jnp.finfo(columns.dtype).eps)))
    divided: list[Array] = []
    for j, rest in enumerate(columns):
        for i, column in enumerate(divided):
            rest = rest - R[i, j] * column
        divided.append(keep(rest / R[j, j]))
    return keep(jnp.stack(divided)), R


def _triangle_of_chunk(gram: Array, floor: float) -> Array:
    """Upper triangle R with `R'R` nearly the matrix: no pivot falls below `floor` times its column, or to zero."""

    def add_row(j: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        left, R = state
        pivot = jnp.maximum(left[j, j], floor * gram[j, j])
        pivot = jnp.where(pivot > 0, pivot, 1)
        row = jnp.where(jnp.arange(len(gram)) > j, left[j], 0) / jnp.sqrt(pivot)
        return left - jnp.outer(row, row), R.at[j].set(row.at[j].set(jnp.sqrt(pivot)))

    return lax.fori_loop(0, len(gram), add_row, (gram, jnp.zeros_like(gram)))[1]


def _for_statistics(X: Array, y: Array, scale: Array, plan: Plan, noise: Array | None) -> tuple[Array, ...]:
    """Further features: the torque less its mean over the chunk, and which output a row belongs to.

    For weights also which rows count; for coloured noise the columns convolved with its autocovariance, the root of the
    weights, and the weights and those convolved with the square of it.
    """
    output = jnp.arange(X.shape[1]) % plan.outputs
    counts, scale = scale > 0, scale.astype(X.dtype)
    member = jnp.where(output == jnp.arange(plan.outputs)[:, None], scale, 0)
    mean = (member * y).sum(axis=1) / jnp.maximum((member**2).sum(axis=1), jnp.finfo(y.dtype).tiny)
    further = [(y - mean[output] * scale)[None], member]
    if plan.weighted:
        further.append(counts.astype(X.dtype)[None])
    if noise is None:
        return tuple(further)
    columns, weight = X[:-1] * scale, scale[None] ** 2
    return *further, _convolved(columns, noise, plan) * scale, scale[None], weight, _convolved(weight, noise**2, plan)


def _convolved(x: Array, kernel: Array, plan: Plan) -> Array:
    """Sum over lags of both signs of `kernel` times rows that many samples away; nothing lies beyond the chunk."""
    reach, rows = plan.reach, x.shape[1]
    padded = keep(jnp.pad(x, ((0, 0), (reach, reach))))

    def add(lag: Array, total: Array) -> Array:
        before, behind = (
            lax.dynamic_slice_in_dim(padded, reach + sign * lag * plan.outputs, rows, axis=1) for sign in (-1, 1)
        )
        return keep(total + kernel[lag] * keep(before + behind))

    return lax.fori_loop(1, plan.lags, add, kernel[0] * x)


def in_blocks(x: Array, plan: Plan) -> Array:
    """(features, rows) -> (rows of a block, features, blocks)."""
    return keep(x.reshape(len(x), -1, plan.block).transpose(2, 0, 1))


def products(x: Array, p: int, plan: Plan) -> Rows:
    """All products that are summed over the rows of a window, of features x (features, lanes).

    The upper triangle of [W y]; the square of the centred torque; the rows of each output times all features before
    them; with weights how many rows count; for coloured noise the symmetric parts of `w u'` and `u u'`, and the weight
    times the convolved weights.
    """
    triangle = tuple(x[i] * x[i : p + 1] for i in range(p + 1))
    if not plan.statistics:
        return triangle
    members = p + 2 + plan.outputs
    linear = tuple(member * x[:members] for member in x[p + 2 : members])
    white = (*triangle, x[p + 1] * x[p + 1 : p + 2], *linear, *([x[members][None]] if plan.weighted else []))
    if not plan.lags:
        return white
    w, u, (_, weight, convolved) = x[:p], x[-p - 3 : -3], x[-3:]
    once = tuple((w[i] * u[i:] + u[i] * w[i:]) / 2 for i in range(p))
    twice = tuple(u[i] * u[i:] for i in range(p))
    return (*white, *once, *twice, (weight * convolved)[None])


def first_windows(blocked: Array, plan: Plan, window: Array | int, count: Callable[[Array], Rows]) -> Rows:
    """Sums over the windows that begin with a block: whole blocks, and the first rows of the block behind them."""
    whole, rest = window // plan.block, window % plan.block
    full = sum_of_rows(blocked, count)
    first = _runs_of(keep(jnp.concatenate(full)), whole, plan)

    def with_part(first: Array) -> Array:
        behind = lax.dynamic_slice_in_dim(blocked, whole, plan.lanes, axis=2)
        behind = keep(behind * (jnp.arange(plan.block) < rest)[:, None, None])
        return first + jnp.concatenate(sum_of_rows(behind, count))

    first = lax.cond(rest > 0, with_part, lambda first: first, first)
    ends = np.cumsum([len(group) for group in full])
    return keep(tuple(first[end - len(group) : end] for end, group in zip(ends, full, strict=True)))


def sum_of_rows(blocked: Array, count: Callable[[Array], Rows]) -> Rows:
    """Products of every row of a block, summed, several rows at a time."""
    at_once = min(len(blocked), BLOCK)
    blocked = jnp.pad(blocked, ((0, -len(blocked) % at_once), (0, 0), (0, 0)))

    def add(rows: Array) -> Rows:
        parts = [count(row) for row in rows]
        return keep(tuple(sum(terms[1:], terms[0]) for terms in zip(*parts, strict=True)))

    groups = blocked.reshape(-1, at_once, *blocked.shape[1:])
    if len(groups) == 1:
        return add(groups[0])

    def accumulate(sums: Rows, rows: Array) -> tuple[Rows, None]:
        return keep(tuple(s + more for s, more in zip(sums, add(keep(rows)), strict=True))), None

    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(add, groups[0]))
    return lax.scan(accumulate, nothing, groups)[0]


def _runs_of(blocks: Array, length: Array | int, plan: Plan) -> Array:
    """Sums of `length` blocks in a row, from each of the first `lanes` blocks on, by doubling."""
    total, done = jnp.zeros_like(blocks[:, : plan.lanes]), jnp.zeros((), int)
    for bit in range(plan.room.bit_length()):
        taken = (length >> bit) & 1
        run = keep(lax.dynamic_slice_in_dim(blocks, done, plan.lanes, axis=1))
        total, done = total + jnp.where(taken, run, 0), done + (taken << bit)
        if 2 << bit <= plan.room:
            total, blocks = keep((total, blocks[:, : -(1 << bit)] + blocks[:, 1 << bit :]))
    return total


def squared_norms(sums: Rows, p: int) -> Array:
    """(p, lanes) squared norm of every column."""
    return jnp.stack([sums[i][0] for i in range(p)])
