"""What the sums for coloured noise hold of pairs of rows of which only one is inside the window.

With it, sums over the whole chunk serve its windows: "edges" of `engine`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from jaximp.least_squares.sums import Plan, in_blocks, sum_of_rows
from jaximp.numerics.compilation import keep
from jaximp.numerics.lanes import Rows


def rows_around_ends(features: Array, plan: Plan, p: int) -> Callable[[Array | int], Array]:
    """A function that gives the rows around a row, and around those one block, two blocks, ... behind it.

    (rows from `reach` before to `reach` behind, [w u scale], lanes)
    """
    needed = jnp.concatenate([features[:p], features[-p - 3 : -2]])
    n_blocks = plan.lanes + -(-2 * plan.reach // plan.block)
    padded = jnp.pad(needed, ((0, 0), (plan.reach, plan.reach + plan.block)))

    def around(start: Array | int) -> Array:
        blocks = in_blocks(lax.dynamic_slice_in_dim(padded, start, n_blocks * plan.block, axis=1), plan)
        shifts = range(1 + n_blocks - plan.lanes)
        return keep(jnp.concatenate([blocks[:, :, shift : shift + plan.lanes] for shift in shifts]))

    return around


class Outside(NamedTuple):
    """What rows outside of a window add to the convolutions of the rows inside, (reach, p + 1, lanes), nearest first.

    The last of the p + 1 is that of the squared weights.
    """

    before: Array
    behind: Array


def from_outside(ends: tuple[Array, Array], plan: Plan, noise: Array, p: int) -> Outside:
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


def one_row_on(outside: Outside, ends: tuple[Array, Array], plan: Plan, shift: Array, noise: Array, p: int) -> Outside:
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


def across_ends(ends: tuple[Array, Array], outside: Outside, plan: Plan, shift: Array | int, p: int) -> Rows:
    """What the sums for coloured noise hold of pairs of rows of which only one is inside the window.

    Of the windows that begin `shift` rows behind a block's beginning, and in the order of `products`.
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
    return sum_of_rows(keep(jnp.concatenate(both)), count)
