"""Least squares of all windows of a chunk of a recording: the mathematics of `sliding_least_squares`.

Window k needs the sums over its rows of all products of two columns of `X = [W y]`: its Gram matrix. Neighbours share
nearly all rows, so that the sums cost the same for every window length. `sums` makes them, `edges` adds what coloured
noise needs, `fits` turns them into estimates. The tricks, each named once:

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

**Edges.** Noise of known autocovariance c needs sums over pairs of rows, `W'CW` and `(CW)'CW` with C the Toeplitz
matrix of the window. With `u = c * w`, the convolution over the whole chunk, they are sums over rows again, less what
reaches across the window's two ends; that is a product with a small Hankel matrix of c.

**Barriers.** XLA would recompute a row of the triangle wherever it is used; `keep` makes it write the row once
(if compiled by `compilation.compiled`; without it the result is the same, slower).

Windows that the shared triangle does not suit (`doubtful`: the motion there differs in kind from the chunk's) are left
to the QR decomposition of `least_squares`, one by one.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaximp.least_squares.edges import Outside, across_ends, from_outside, one_row_on, rows_around_ends
from jaximp.least_squares.fits import ChunkFit, estimates_of, for_prediction, in_given_units, with_predictions
from jaximp.least_squares.sums import Plan, features_of, first_windows, in_blocks, products, squared_norms, sum_of_rows
from jaximp.numerics.compilation import keep
from jaximp.numerics.lanes import Rows
from jaximp.numerics.linear_algebra import root

SURPRISE = 3.0
"""Standard deviations by which the variance of a window's residuals may lie above what is wanted: one window in a few
hundred does so by chance."""


def solve_chunk(
    plan: Plan,
    columns: Array,
    scale: Array,
    window: Array | int,
    noise: Array | None = None,
    ahead: Array | int = 0,
    held: Array | None = None,
) -> ChunkFit:
    """Fit every window of a chunk.

    **Arguments:** `columns` (p + 1, rows) of W and y, with the rows of several outputs in turn, multiplied by `scale`
    (rows,): zero where a row does not count, else the root of its weight; `window` its length in rows, at most
    `plan.room` blocks; `noise` (lags,) its autocovariance; `ahead`, how many windows on the one lies that each is held
    against, where the plan `predicts`, by its own parameters or by those in `held` (K, p).
    """
    p = len(columns) - 1
    features, R = features_of(plan, columns, scale, noise)
    count = partial(products, p=p, plan=plan)
    blocked = in_blocks(features, plan)
    tail = in_blocks(lax.dynamic_slice_in_dim(features, window, plan.advance, axis=1), plan)
    ends = None
    if plan.lags:
        around = rows_around_ends(features, plan, p)
        ends = around(0), around(window)
    first = first_windows(blocked, plan, window, count)

    def solve(sums: Rows, peak: Array, outside: Outside | None, shift: Array | int) -> tuple[ChunkFit, Array]:
        across = None if ends is None or outside is None else across_ends(ends, outside, plan, shift, p)
        return estimates_of(plan, p, R, sums, peak, noise, across)[0], for_prediction(sums, p, plan)

    def advance(
        state: tuple[Rows, Array, Outside | None], step: tuple[Array, Array, Array]
    ) -> tuple[tuple[Rows, Array, Outside | None], tuple[ChunkFit, Array]]:
        sums, peak, outside = state
        leaving, entering, shift = keep(step)
        found = solve(sums, peak, outside, shift)
        for old, new in zip(leaving, entering, strict=True):
            sums = tuple(s - less + more for s, less, more in zip(sums, count(old), count(new), strict=True))
        sums = keep(sums)
        if ends is not None and outside is not None and noise is not None:
            for row in range(plan.step):
                outside = one_row_on(outside, ends, plan, shift + row, noise, p)
        return (sums, jnp.maximum(peak, squared_norms(sums, p)), outside), found

    outside = None if ends is None or noise is None else from_outside(ends, plan, noise, p)
    state = first, squared_norms(first, p), outside
    if plan.per_block == 1:
        found, later = jax.tree.map(lambda x: x[None], solve(*state, 0))
        return in_given_units(with_predictions(found, later, R, plan, ahead, held), R, plan)
    leaving, entering = (
        x[:, :, : plan.lanes].reshape(plan.per_block, plan.step, len(features), plan.lanes) for x in (blocked, tail)
    )
    found, later = lax.scan(advance, state, (leaving, entering, jnp.arange(plan.per_block) * plan.step))[1]
    return in_given_units(with_predictions(found, later, R, plan, ahead, held), R, plan)


class Wanted(NamedTuple):
    """What a window must reach to be long enough."""

    blocks: Any
    """(m,) lengths to choose from, rising, in blocks."""
    stderr: Any
    """(p,) largest standard errors."""
    cond: Any
    """() largest condition number."""
    level: Any
    """(K,) variance of the noise around the end of every window."""


def solve_shortest(
    plan: Plan, columns: Array, scale: Array, wanted: Wanted, noise: Array | None = None
) -> tuple[ChunkFit, Array]:
    """Fit, up to the end of every block from `plan.room - 1` on, the shortest window that meets what is wanted.

    Windows grow back in time block by block, so that the sums of a length are those of the one before it and a few
    more. A plan for this has one window in a block. Arguments as in `solve_chunk`.

    The derivatives are those of the windows that were found: what is wanted has none.

    **Returns:** the fits, and how many blocks each took: none where no length sufficed.
    """

    @jax.custom_jvp
    def solve(columns: Array, scale: Array, noise: Array | None, wanted: Wanted) -> tuple[ChunkFit, Array]:
        return _search(_Growing(plan, columns, scale, noise), wanted)

    @solve.defjvp
    def derivative(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
        found, taken = solve(*primals)

        def again(columns: Array, scale: Array, noise: Array | None) -> ChunkFit:
            return _of_lengths(_Growing(plan, columns, scale, noise), taken, primals[3].blocks)

        slope = jax.jvp(again, primals[:3], tangents[:3])[1]
        return (found, taken), (slope, np.zeros(taken.shape, jax.dtypes.float0))

    return solve(columns, scale, *jax.tree.map(jnp.asarray, (noise, wanted)))


class _Growing:
    """Sums of the blocks of a chunk, from which windows of any length up to a block are put together."""

    def __init__(self, plan: Plan, columns: Array, scale: Array, noise: Array | None) -> None:
        self.plan, self.noise, self.p = plan, noise, len(columns) - 1
        features, self.R = features_of(plan, columns, scale, noise)
        groups = sum_of_rows(in_blocks(features, plan), partial(products, p=self.p, plan=plan))
        self.blocks, self.split = keep(jnp.concatenate(groups)), np.cumsum([len(group) for group in groups])[:-1]
        self.ends = rows_around_ends(features, plan, self.p) if plan.lags else None
        self.last = self.ends(plan.room * plan.block) if self.ends else jnp.zeros(0)

    def block(self, before: Array) -> Array:
        """Of every lane the block so many before the last."""
        return keep(lax.dynamic_slice_in_dim(self.blocks, self.plan.room - 1 - before, self.plan.lanes, axis=1))

    def across(self, length: Array) -> Rows | None:
        """What coloured noise adds at the ends of windows of so many blocks."""
        if self.ends is None or self.noise is None:
            return None
        both = self.ends((self.plan.room - length) * self.plan.block), self.last
        return across_ends(both, from_outside(both, self.plan, self.noise, self.p), self.plan, 0, self.p)

    def fit(self, total: Array, across: Rows | None) -> tuple[ChunkFit, Array]:
        sums = keep(tuple(jnp.split(total, self.split)))
        return estimates_of(self.plan, self.p, self.R, sums, squared_norms(sums, self.p), self.noise, across)

    def finished(self, found: ChunkFit, taken: Array) -> ChunkFit:
        found = found._replace(solvable=taken > 0)
        return in_given_units(jax.tree.map(lambda x: x[None], found), self.R, self.plan)


def _search(growing: _Growing, wanted: Wanted) -> tuple[ChunkFit, Array]:
    """Every length in turn, until all lanes have found theirs."""
    lanes = growing.plan.lanes

    def grow(before: Array, total: Array) -> Array:
        return total + growing.block(before)

    def fit_of(length: Array, total: Array) -> tuple[ChunkFit, Array]:
        return growing.fit(total, growing.across(length))

    def unfinished(state: tuple[Array, Array, Array, ChunkFit]) -> Array:
        return (state[0] < len(wanted.blocks)) & (state[2] == 0).any()

    def lengthen(state: tuple[Array, Array, Array, ChunkFit]) -> tuple[Array, Array, Array, ChunkFit]:
        k, total, taken, found = state
        length = wanted.blocks[k]
        total = keep(lax.fori_loop(jnp.where(k > 0, wanted.blocks[k - 1], 0), length, grow, total))
        fit, variance = fit_of(length, total)
        better = (taken == 0) & _meets(fit, variance, wanted)
        found = jax.tree.map(lambda new, old: jnp.where(better, new, old), fit, found)
        return keep((k + 1, total, jnp.where(better, length, taken), found))

    none, total = jnp.zeros((), wanted.blocks.dtype), jnp.zeros_like(growing.blocks[:, :lanes])
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(fit_of, none, total)[0])
    state = none, total, jnp.zeros(lanes, wanted.blocks.dtype), nothing
    _, _, taken, found = lax.while_loop(unfinished, lengthen, state)
    return growing.finished(found, taken), taken


def _of_lengths(growing: _Growing, taken: Array, lengths: Array) -> ChunkFit:
    """The same fits, each lane's of the length that it took: loops of fixed length, which run backwards too."""

    def grow(before: Array, total: Array) -> Array:
        return total + jnp.where(before < taken, growing.block(before), 0)

    def choose(chosen: Rows | None, length: Array) -> tuple[Rows | None, None]:
        return jax.tree.map(lambda new, old: jnp.where(taken == length, new, old), growing.across(length), chosen), None

    total = lax.fori_loop(0, growing.plan.room, grow, jnp.zeros_like(growing.blocks[:, : growing.plan.lanes]))
    across = jax.tree.map(jnp.zeros_like, growing.across(lengths[0]))
    return growing.finished(growing.fit(total, lax.scan(choose, across, lengths)[0])[0], taken)


def _meets(fit: ChunkFit, variance: Array, wanted: Wanted) -> Array:
    """Whether a window is long enough, and its standard error more than rounding.

    Its motion and the noise around it decide. Its own residuals do not (the first window that they make look sure is
    one whose residuals are small by chance), unless they are so large that the model changes within it.
    """
    assert fit.statistics is not None
    accurate = fit.share > jnp.sqrt(jnp.finfo(fit.theta.dtype).eps)
    limit, stderr, dof = wanted.stderr[:, None], fit.statistics.stderr, jnp.maximum(fit.statistics.dof, 1)
    expected = stderr * root(wanted.level) <= limit * root(variance)
    sure = (expected & (stderr <= limit * jnp.sqrt(1 + SURPRISE * jnp.sqrt(2 / dof)))).all(axis=0)
    return fit.solvable & accurate & sure & (fit.statistics.sigma_max <= wanted.cond * fit.statistics.sigma_min)
