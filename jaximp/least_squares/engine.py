"""Least squares of all windows of a chunk of a recording: the mathematics of `sliding_least_squares`.

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

**Edges.** Noise of known autocovariance c needs sums over pairs of rows, `W'CW` and `(CW)'CW` with C the Toeplitz
matrix of the window. With `u = c * w`, the convolution over the whole chunk, they are sums over rows again, less what
reaches across the window's two ends; that is a product with a small Hankel matrix of c.

**Barriers.** XLA would recompute a row of the triangle wherever it is used; `keep` makes it write the row once
(if compiled by `compilation.compiled`; without it the result is the same, slower).

Windows that the shared triangle does not suit (`doubtful`: the motion there differs in kind from the chunk's) are left
to the QR decomposition of `least_squares`, one by one.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaximp.numerics.compilation import keep
from jaximp.numerics.lanes import Rows, cholesky, divided, extreme_singular_values, substitute, sum_of
from jaximp.numerics.linear_algebra import root

BLOCK = 16
"""Rows in a block, at least."""
FEWEST_LANES = 30
"""XLA breaks off the whole process where it compiles the barriers for only a few lanes."""
DOUBT = 1e-2
"""A pivot below this share of its column leaves the window's estimate to a QR decomposition."""


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


class ChunkFit(NamedTuple):
    """What is found for the K windows of a chunk; without statistics only the first three."""

    theta: Array
    """(K, p), meaningless where `solvable` is False."""
    solvable: Array
    """(K,) False where there is no unique solution."""
    share: Array
    """(K,) what the other columns leave of the one that they imitate best, squared and in the chunk's coordinates."""
    statistics: Statistics | None = None
    seen: Held | None = None
    """How well parameters that were given explain each window."""
    unseen: Held | None = None
    """How well each window's parameters, or those that were given, predict the one `ahead` windows on."""

    @property
    def doubtful(self) -> Any:
        """(K,) True where the numbers may be wrong and a QR decomposition must decide."""
        return self.solvable & (self.share <= DOUBT)


class Statistics(NamedTuple):
    """What judges an estimate, as in `least_squares.WindowFit`; (K,) but where said."""

    stderr: Array
    """(K, p)"""
    dof: Array
    inverse_norm: Array
    """(K, p) norm of each row of the inverse triangle: reciprocal excitation."""
    sigma_max: Array
    sigma_min: Array
    mean_square: Array
    """Of the residual."""
    vaf: Array
    samples: Array


class Held(NamedTuple):
    """How well parameters explain the torque of a window; (K,), nothing where that is beyond the chunk."""

    vaf: Array
    mean_square: Array
    """Of the residual."""
    samples: Array
    variance: Array
    """Of the torque."""


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
    features, R = _features(plan, columns, scale, noise)
    count = partial(_products, p=p, plan=plan)
    blocked = _in_blocks(features, plan)
    tail = _in_blocks(lax.dynamic_slice_in_dim(features, window, plan.advance, axis=1), plan)
    ends = None
    if plan.lags:
        around = _ends(features, plan, p)
        ends = around(0), around(window)
    first = _first_windows(blocked, plan, window, count)

    def solve(sums: Rows, peak: Array, outside: Outside | None, shift: Array | int) -> tuple[ChunkFit, Array]:
        across = None if ends is None or outside is None else _across(ends, outside, plan, shift, p)
        return _solve(plan, p, R, sums, peak, noise, across), _for_prediction(sums, p, plan)

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
                outside = _one_row_on(outside, ends, plan, shift + row, noise, p)
        return (sums, jnp.maximum(peak, _diagonal(sums, p)), outside), found

    outside = None if ends is None or noise is None else _outside(ends, plan, noise, p)
    state = first, _diagonal(first, p), outside
    if plan.per_block == 1:
        found, later = jax.tree.map(lambda x: x[None], solve(*state, 0))
        return _in_given_units(_with_predictions(found, later, R, plan, ahead, held), R, plan)
    leaving, entering = (
        x[:, :, : plan.lanes].reshape(plan.per_block, plan.step, len(features), plan.lanes) for x in (blocked, tail)
    )
    found, later = lax.scan(advance, state, (leaving, entering, jnp.arange(plan.per_block) * plan.step))[1]
    return _in_given_units(_with_predictions(found, later, R, plan, ahead, held), R, plan)


class Wanted(NamedTuple):
    """What a window must reach to be long enough."""

    blocks: Any
    """(m,) lengths to choose from, rising, in blocks."""
    stderr: Any
    """(p,) largest standard errors."""
    cond: Any
    """() largest condition number."""


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
        features, self.R = _features(plan, columns, scale, noise)
        groups = _sum_of_rows(_in_blocks(features, plan), partial(_products, p=self.p, plan=plan))
        self.blocks, self.split = keep(jnp.concatenate(groups)), np.cumsum([len(group) for group in groups])[:-1]
        self.ends = _ends(features, plan, self.p) if plan.lags else None
        self.last = self.ends(plan.room * plan.block) if self.ends else jnp.zeros(0)

    def block(self, before: Array) -> Array:
        """Of every lane the block so many before the last."""
        return keep(lax.dynamic_slice_in_dim(self.blocks, self.plan.room - 1 - before, self.plan.lanes, axis=1))

    def across(self, length: Array) -> Rows | None:
        """What coloured noise adds at the ends of windows of so many blocks."""
        if self.ends is None or self.noise is None:
            return None
        both = self.ends((self.plan.room - length) * self.plan.block), self.last
        return _across(both, _outside(both, self.plan, self.noise, self.p), self.plan, 0, self.p)

    def fit(self, total: Array, across: Rows | None) -> ChunkFit:
        sums = keep(tuple(jnp.split(total, self.split)))
        return _solve(self.plan, self.p, self.R, sums, _diagonal(sums, self.p), self.noise, across)

    def finished(self, found: ChunkFit, taken: Array) -> ChunkFit:
        found = found._replace(solvable=taken > 0)
        return _in_given_units(jax.tree.map(lambda x: x[None], found), self.R, self.plan)


def _search(growing: _Growing, wanted: Wanted) -> tuple[ChunkFit, Array]:
    """Every length in turn, until all lanes have found theirs."""
    lanes = growing.plan.lanes

    def grow(before: Array, total: Array) -> Array:
        return total + growing.block(before)

    def fit_of(length: Array, total: Array) -> ChunkFit:
        return growing.fit(total, growing.across(length))

    def unfinished(state: tuple[Array, Array, Array, ChunkFit]) -> Array:
        return (state[0] < len(wanted.blocks)) & (state[2] == 0).any()

    def lengthen(state: tuple[Array, Array, Array, ChunkFit]) -> tuple[Array, Array, Array, ChunkFit]:
        k, total, taken, found = state
        length = wanted.blocks[k]
        total = keep(lax.fori_loop(jnp.where(k > 0, wanted.blocks[k - 1], 0), length, grow, total))
        fit = fit_of(length, total)
        better = (taken == 0) & _meets(fit, wanted)
        found = jax.tree.map(lambda new, old: jnp.where(better, new, old), fit, found)
        return keep((k + 1, total, jnp.where(better, length, taken), found))

    none, total = jnp.zeros((), wanted.blocks.dtype), jnp.zeros_like(growing.blocks[:, :lanes])
    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(fit_of, none, total))
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
    return growing.finished(growing.fit(total, lax.scan(choose, across, lengths)[0]), taken)


def _meets(fit: ChunkFit, wanted: Wanted) -> Array:
    """Whether a window is long enough, and its standard error more than rounding."""
    assert fit.statistics is not None
    accurate = fit.share > jnp.sqrt(jnp.finfo(fit.theta.dtype).eps)
    sure = (fit.statistics.stderr <= wanted.stderr[:, None]).all(axis=0)
    return fit.solvable & accurate & sure & (fit.statistics.sigma_max <= wanted.cond * fit.statistics.sigma_min)


def _features(plan: Plan, columns: Array, scale: Array, noise: Array | None) -> tuple[Array, Array]:
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


def _in_blocks(x: Array, plan: Plan) -> Array:
    """(features, rows) -> (rows of a block, features, blocks)."""
    return keep(x.reshape(len(x), -1, plan.block).transpose(2, 0, 1))


def _products(x: Array, p: int, plan: Plan) -> Rows:
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


def _first_windows(blocked: Array, plan: Plan, window: Array | int, count: Callable[[Array], Rows]) -> Rows:
    """Sums over the windows that begin with a block: whole blocks, and the first rows of the block behind them."""
    whole, rest = window // plan.block, window % plan.block
    full = _sum_of_rows(blocked, count)
    first = _runs_of(keep(jnp.concatenate(full)), whole, plan)

    def with_part(first: Array) -> Array:
        behind = lax.dynamic_slice_in_dim(blocked, whole, plan.lanes, axis=2)
        behind = keep(behind * (jnp.arange(plan.block) < rest)[:, None, None])
        return first + jnp.concatenate(_sum_of_rows(behind, count))

    first = lax.cond(rest > 0, with_part, lambda first: first, first)
    ends = np.cumsum([len(group) for group in full])
    return keep(tuple(first[end - len(group) : end] for end, group in zip(ends, full, strict=True)))


def _sum_of_rows(blocked: Array, count: Callable[[Array], Rows]) -> Rows:
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


def _diagonal(sums: Rows, p: int) -> Array:
    """(p, lanes) squared norm of every column."""
    return jnp.stack([sums[i][0] for i in range(p)])


def _ends(features: Array, plan: Plan, p: int) -> Callable[[Array | int], Array]:
    """A function that gives the rows around a row, and around those one block, two blocks, ... behind it.

    (rows from `reach` before to `reach` behind, [w u scale], lanes)
    """
    needed = jnp.concatenate([features[:p], features[-p - 3 : -2]])
    n_blocks = plan.lanes + -(-2 * plan.reach // plan.block)
    padded = jnp.pad(needed, ((0, 0), (plan.reach, plan.reach + plan.block)))

    def around(start: Array | int) -> Array:
        blocks = _in_blocks(lax.dynamic_slice_in_dim(padded, start, n_blocks * plan.block, axis=1), plan)
        shifts = range(1 + n_blocks - plan.lanes)
        return keep(jnp.concatenate([blocks[:, :, shift : shift + plan.lanes] for shift in shifts]))

    return around


class Outside(NamedTuple):
    """What rows outside of a window add to the convolutions of the rows inside, (reach, p + 1, lanes), nearest first.

    The last of the p + 1 is that of the squared weights.
    """

    before: Array
    behind: Array


def _outside(ends: tuple[Array, Array], plan: Plan, noise: Array, p: int) -> Outside:
    """Of the windows that begin with a block."""
    kernels = _kernels(plan, noise)
    distance = np.add.outer(np.arange(plan.reach), np.arange(plan.reach))
    near = distance < plan.reach
    hankels = [jnp.where(near, kernel[np.minimum(distance, plan.reach - 1)], 0) for kernel in kernels]

    def added(rows: Array, mirrored: bool) -> Array:
        outside = rows[plan.reach : 2 * plan.reach] if mirrored else rows[: plan.reach][::-1]
        weighted = _weighted(outside, p)
        columns, weights = jnp.tensordot(hankels[0], weighted[:, :p], 1), jnp.tensordot(hankels[1], weighted[:, p:], 1)
        return keep(jnp.concatenate([columns, weights], 1))

    return Outside(added(ends[0], False), added(ends[1], True))


def _one_row_on(outside: Outside, ends: tuple[Array, Array], plan: Plan, shift: Array, noise: Array, p: int) -> Outside:
    """The same for windows one row on: one row leaves them and is outside, one that was outside is in them."""
    kernels = _kernels(plan, noise)
    kernel = jnp.stack([*[kernels[0]] * p, kernels[1]], axis=1)[:, :, None]
    leaving, entering = (_weighted(lax.dynamic_slice_in_dim(rows, shift + plan.reach, 1), p) for rows in ends)
    next_ones = _weighted(lax.dynamic_slice_in_dim(ends[1], shift + 1 + plan.reach, plan.reach), p)
    before = jnp.concatenate([outside.before[1:], jnp.zeros_like(leaving)]) + kernel * leaving
    nearest = (kernel * next_ones).sum(axis=0, keepdims=True)
    behind = jnp.concatenate([nearest, (outside.behind - kernel * entering)[:-1]])
    return Outside(*keep((before, behind)))


def _kernels(plan: Plan, noise: Array) -> tuple[Array, Array]:
    """Autocovariance by distance in rows, from one to `reach`, and its square."""
    distance = np.arange(1, plan.reach + 1)
    kernel = jnp.where(distance % plan.outputs == 0, noise[distance // plan.outputs], 0)
    return kernel, kernel**2


def _weighted(rows: Array, p: int) -> Array:
    """Columns times the root of their weight, and the weight, of rows [w u scale]."""
    scale = rows[:, 2 * p :]
    return jnp.concatenate([rows[:, :p] * scale, scale**2], 1)


def _across(ends: tuple[Array, Array], outside: Outside, plan: Plan, shift: Array | int, p: int) -> Rows:
    """What the sums for coloured noise hold of pairs of rows of which only one is inside the window.

    Of the windows that begin `shift` rows behind a block's beginning, and in the order of `_products`.
    """

    def lost(rows: Array, added: Array, mirrored: bool) -> Array:
        start = shift if mirrored else shift + plan.reach
        inside = lax.dynamic_slice_in_dim(rows, start, plan.reach)
        inside = keep(inside[::-1] if mirrored else inside)
        scale = inside[:, 2 * p :]
        columns, weights = added[:, :p] * scale, added[:, p:] * scale**2
        return jnp.concatenate([inside[:, :p], inside[:, p : 2 * p] - columns / 2, columns, weights], 1)

    def count(x: Array) -> Rows:
        w, u, e = x[:p], x[p : 2 * p], x[2 * p : 3 * p]
        once = tuple((w[i] * e[i:] + e[i] * w[i:]) / 2 for i in range(p))
        twice = tuple(u[i] * e[i:] + e[i] * u[i:] for i in range(p))
        return (*once, *twice, x[3 * p :])

    both = lost(ends[0], outside.before, False), lost(ends[1], outside.behind, True)
    return _sum_of_rows(keep(jnp.concatenate(both)), count)


def _solve(plan: Plan, p: int, R: Array, sums: Rows, peak: Array, noise: Array | None, across: Rows | None) -> ChunkFit:
    """Estimates of one window in every lane, from its sums."""
    triangle = cholesky(sums[: p + 1])
    pivots = jnp.stack([row[0] for row in triangle[:p]])
    inner = substitute(triangle, p)
    theta, solvable = jnp.stack(inner), _solvable(pivots, sums, R, plan.rows)
    share = (pivots**2 / jnp.where(peak > 0, peak, 1)).min(axis=0)
    if not plan.statistics:
        return ChunkFit(theta, solvable, share)
    rss = (R[p, p] * triangle[p][0]) ** 2
    weight, vaf, _, samples = _residuals(plan, rss, inner, R, sums)
    alone = tuple(row[: p - i] for i, row in enumerate(triangle[:p]))
    own_inverse, given, inverse = _triangle_and_inverses(alone, R[:p, :p])
    sigma_max, sigma_min = extreme_singular_values(given, inverse)
    norm = jnp.sqrt((inverse**2).sum(axis=1))
    if across is None or noise is None:
        dof = samples - p
        stderr = jnp.where(dof > 0, norm * root(rss / jnp.where(dof > 0, dof, 1)), jnp.nan)
    else:
        stderr, dof = _coloured(plan, sums, across, noise, own_inverse, inverse, rss, weight)
    statistics = Statistics(stderr, dof, norm, sigma_max, sigma_min, divided(rss, weight), vaf, samples)
    return ChunkFit(theta, solvable, share, statistics)


def _solvable(pivots: Array, sums: Rows, R: Array, rows: int) -> Array:
    """Whether what the other columns leave of every column is more than rounding.

    Only where they leave next to nothing of a column in the whole chunk can this be known from the sums.
    """
    p, rounding = len(pivots), rows * jnp.finfo(R.dtype).eps
    diagonal, size = jnp.diagonal(R)[:p], jnp.sqrt((R[:, :p] ** 2).sum(axis=0))
    suspect = diagonal**2 <= 4 * rounding * size**2

    def compare() -> Array:
        # In the given units: pivots against the columns themselves, term by term as they were rounded.
        bound = jnp.abs(R[:p, :p]).T @ jnp.sqrt(_diagonal(sums, p))
        return ~(suspect[:, None] & (pivots * diagonal[:, None] <= rounding * bound)).any(axis=0)

    return lax.cond(suspect.any(), compare, lambda: jnp.ones(pivots.shape[1], bool))


def _in_given_units(found: ChunkFit, R: Array, plan: Plan) -> ChunkFit:
    """Estimates of all windows of the chunk, one after another: back through the chunk's triangle."""
    p = len(R) - 1
    theta = [found.theta[:, i] for i in range(p)]
    for i in reversed(range(p)):
        rest = R[i, p] + R[p, p] * theta[i]
        for k in range(i + 1, p):
            rest = rest - R[i, k] * theta[k]
        theta[i] = keep(rest / R[i, i])
    found = found._replace(theta=jnp.stack(theta, axis=1))
    return jax.tree.map(lambda x: _one_after_another(x, plan), found)


def _one_after_another(x: Array, plan: Plan) -> Array:
    """(windows of a block, ..., blocks) -> (windows, ...)"""
    return jnp.moveaxis(x, (-1, 0), (0, 1)).reshape(plan.windows, *x.shape[1:-1])


def _for_prediction(sums: Rows, p: int, plan: Plan) -> Array:
    """The sums by which other parameters are held against a window, (k, lanes)."""
    if not plan.predicts:
        return jnp.zeros((0, sums[0].shape[-1]), sums[0].dtype)
    return keep(jnp.concatenate(sums[: p + 2 + plan.outputs + plan.weighted]))


def _with_predictions(
    found: ChunkFit, sums: Array, R: Array, plan: Plan, ahead: Array | int, held: Array | None
) -> ChunkFit:
    """Hold every window's parameters, or others, against the sums of a later window."""
    if not plan.predicts:
        return found
    p = len(R) - 1
    if held is None:
        return found._replace(unseen=_held(_one_after_another(found.theta, plan).T, sums, R, plan, ahead))
    inner = ((held @ R[:p, :p].T - R[:p, p]) / R[p, p]).T
    return found._replace(seen=_held(inner, sums, R, plan, 0), unseen=_held(inner, sums, R, plan, ahead))


def _held(theta: Array, sums: Array, R: Array, plan: Plan, ahead: Array | int) -> Held:
    """Hold parameters (p, K), in the chunk's coordinates, against the sums of the windows `ahead` of theirs."""
    p = len(theta)
    assert plan.statistics
    sizes = [*range(p + 1, 0, -1), 1, *[p + 2 + plan.outputs] * plan.outputs, *[1] * plan.weighted]
    later = jnp.roll(_one_after_another(sums, plan), -ahead, axis=0).T
    rows = tuple(jnp.split(keep(later), np.cumsum(sizes)[:-1]))
    inner = list(keep(theta))
    # The residual is this combination of the chunk's columns; its sum of squares, a quadratic form of theirs.
    along = [*(-one for one in inner), jnp.ones_like(inner[0])]
    square = sum_of(
        along[i] * ((1 if i == k else 2) * along[k]) * row[k - i]
        for i, row in enumerate(rows[: p + 1])
        for k in range(i, p + 1)
    )
    rss = R[p, p] ** 2 * jnp.maximum(square, 0)
    weight, vaf, total, samples = _residuals(plan, rss, inner, R, rows)
    whole = jnp.arange(plan.windows) < plan.windows - ahead
    found = (
        jnp.where(whole, vaf, jnp.nan),
        divided(rss, weight),
        jnp.where(whole, samples, 0),
        total / jnp.maximum(samples, 1),
    )
    return Held(*(x.reshape(plan.lanes, plan.per_block).T for x in found))


def _residuals(plan: Plan, rss: Array, inner: list[Array], R: Array, sums: Rows) -> tuple[Array, Array, Array, Array]:
    """Sum of the weights, variance accounted for, the torque's squares about its mean, and how many samples counted.

    Of parameters `inner`, in the chunk's coordinates, which leave `rss`, the sum of squared residuals.
    """
    p, members = len(inner), sums[len(inner) + 2 :]
    total, left, whole = sums[p + 1][0], rss, jnp.zeros_like(rss)
    for output, row in enumerate(members[: plan.outputs]):
        weight = row[p + 2 + output]
        residual = R[p, p] * (row[p] - sum(theta * column for theta, column in zip(inner, row, strict=False)))
        over = 1 / jnp.where(weight > 0, weight, 1)
        total, left, whole = total - row[p + 1] ** 2 * over, left - residual**2 * over, whole + weight
    samples = members[plan.outputs][0] if plan.weighted else whole
    vaf = jnp.where(total > 0, 1 - left / jnp.where(total > 0, total, 1), jnp.nan)
    return whole, vaf, total, samples


def _triangle_and_inverses(triangle: Rows, R: Array) -> tuple[Array, Array, Array]:
    """Inverse of the window's triangle, the triangle in the given units, and the inverse of that; (p, p, lanes)."""
    p, scale = len(R), R[:, :, None]
    given = keep(jnp.stack([sum_of(row[k - i] * scale[k] for k in range(i, p)) for i, row in enumerate(triangle)]))
    own = list(jnp.eye(p, dtype=R.dtype)[:, :, None] * jnp.ones_like(given[0, 0]))
    for i in reversed(range(p)):
        rest = own[i]
        for k in range(i + 1, p):
            rest = rest - triangle[i][k - i] * own[k]
        own[i] = keep(divided(rest, triangle[i][0]))
    inverse = list(own)
    for i in reversed(range(p)):
        rest = own[i]
        for k in range(i + 1, p):
            rest = rest - R[i, k] * inverse[k]
        inverse[i] = keep(rest / R[i, i])
    own_inverse, given_inverse = keep((jnp.stack(own), jnp.stack(inverse)))
    return own_inverse, given, given_inverse


def _coloured(
    plan: Plan, sums: Rows, across: Rows, noise: Array, own: Array, inverse: Array, rss: Array, weight: Array
) -> tuple[Array, Array]:
    """Standard errors and degrees of freedom for noise of this autocovariance, as `least_squares` has them."""
    p = len(own)
    within = keep(tuple(all_ - lost for all_, lost in zip(sums[-len(across) :], across, strict=True)))
    once, twice, (squares,) = _full(within[:p]), _full(within[p : 2 * p]), within[2 * p]
    half = keep(jnp.stack([sum_of(once[i, k] * own[k] for k in range(p)) for i in range(p)]))
    shape = keep(jnp.stack([sum_of(own[k, i] * half[k] for k in range(i + 1)) for i in range(p)]))
    gram = jnp.stack([sum_of(own[i, k] * own[:, k] for k in range(i, p)) for i in range(p)])
    trace = noise[0] * weight - sum_of(shape[i, i] for i in range(p))
    square = squares - 2 * (twice * gram).sum(axis=(0, 1)) + (shape * shape).sum(axis=(0, 1))
    spread = keep(jnp.stack([sum_of(inverse[i, k] * shape[k] for k in range(i, p)) for i in range(p)]))
    variance = (spread * inverse).sum(axis=1) * (rss / jnp.where(trace > 0, trace, 1))
    return jnp.where(trace > 0, root(variance), jnp.nan), divided(trace**2, square)


def _full(triangle: Rows) -> Array:
    """Symmetric (p, p, lanes) from the rows of its upper triangle."""
    above = [[triangle[k][i - k][None] for k in range(i)] for i in range(len(triangle))]
    return keep(jnp.stack([jnp.concatenate([*left, row]) for left, row in zip(above, triangle, strict=True)]))
