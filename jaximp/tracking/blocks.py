"""The rows between two points of the grid, as the triangle of their QR decomposition: all that Gaussian noise needs.

Everything that follows counts in the scales of the record, so that an inertia of 0.01 and a stiffness of 100 are alike:
noise of variance one, and parameters of about the size that they have when they do not move.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaximp.numerics.lanes import divided
from jaximp.tracking.state_space import moments, triangularise
from jaximp.types import AnyArray

TELLING = 20
"""So many rows for each parameter tell the size of the noise, whatever moves between others."""
UNEXCITED = 1e-6
"""A column that is not there at all is given such a share of what would be known of it."""


class Blocks(eqx.Module):
    """Rows of a record, compressed to the G points of a grid."""

    rows: Float[Array, "G r f"]
    """Regressor and torque, side by side; as many rows as parameters, or fewer. Columns of curves come first."""
    left: Float[Array, ""]
    """Squares of the torque that no parameters can explain that stay the same inside of a block."""
    count: Float[Array, ""]
    """Rows that count."""

    def freedom(self, p: int) -> Array:
        """Rows less parameters."""
        return jnp.maximum(self.count - p, 1.0)


class Scales(eqx.Module):
    """Units in which the numbers of a record are of the order of one."""

    noise: Float[Array, ""]
    """Standard deviation of the noise in a row [N m]."""
    theta: Float[Array, " p"]
    """Of parameters, in units of the model."""
    information: Float[Array, " p"]
    """What a point of the grid says of a scaled parameter, in the mean: the inverse of a variance."""


def compress(W: AnyArray, y: AnyArray, valid: AnyArray, grid: int) -> Blocks:
    """**Arguments:** as for `as_blocks`."""
    return merged(as_blocks(W, y, valid, grid), 1)


def as_blocks(W: AnyArray, y: AnyArray, valid: AnyArray, grid: int) -> Blocks:
    """All rows as they are: what is read once need not be compressed, and triangles of rows at rest have no derivative.

    **Arguments:** `W` (N, *n, p), `y` and `valid` (N, *n); `grid` rows from one point to the next.
    """
    counts = jnp.asarray(valid, bool)
    rows = jnp.where(counts[..., None], jnp.concatenate([W, y[..., None]], axis=-1), 0)
    points, columns = -(-len(y) // grid), rows.shape[-1]
    rows = jnp.pad(rows.reshape(len(y), -1, columns), ((0, points * grid - len(y)), (0, 0), (0, 0)))
    return Blocks(rows.reshape(points, -1, columns), jnp.zeros((), rows.dtype), counts.sum().astype(rows.dtype))


def merged(blocks: Blocks, every: int) -> Blocks:
    """Blocks that follow each other taken together, `every` at a time."""
    points, columns = -(-len(blocks.rows) // every), blocks.rows.shape[-1]
    rows = jnp.pad(blocks.rows, ((0, points * every - len(blocks.rows)), (0, 0), (0, 0)))
    rows = rows.reshape(points, -1, columns)
    if rows.shape[1] < columns:
        return eqx.tree_at(lambda b: b.rows, blocks, rows)
    triangle, left = triangularise(jnp.moveaxis(rows, 0, -1), columns - 1)
    return Blocks(jnp.moveaxis(triangle, -1, 0), blocks.left + (left**2).sum(), blocks.count)


def scales(blocks: Blocks) -> Scales:
    """From parameters that do not move, and from what short stretches leave of the torque."""
    points, _, columns = blocks.rows.shape
    p = columns - 1
    each = max(1, math.ceil(TELLING * p * points / max(1, points * blocks.rows.shape[1])))
    stretches = merged(blocks, each)
    freedom = jnp.maximum(blocks.count - p * len(stretches.rows), 1)
    flat = blocks.rows.reshape(-1, columns)
    size = jnp.sqrt((flat**2).sum(axis=0))
    noise = jnp.maximum(jnp.sqrt(stretches.left / freedom), 1e-12 * size[p] / jnp.sqrt(blocks.count))
    noise = jnp.where(noise > 0, noise, 1)
    # Columns of unit length, and a little of what is known of each by itself, where others imitate it.
    length = jnp.where(size[:p] > 0, size[:p], 1)
    whole = jnp.concatenate([flat / jnp.append(length, noise), UNEXCITED * jnp.eye(p, columns)])
    theta, root = moments(triangularise(whole[..., None], p)[0])
    variance = (root[..., 0] ** 2).sum(axis=1)
    largest = divided(size[p], noise)
    scale = jnp.minimum(jnp.sqrt(theta[:, 0] ** 2 + variance), jnp.maximum(largest, 1))
    return Scales(noise, scale * noise / length, scale**2 / variance / points)


def without_curves(blocks: Blocks, p: int) -> Blocks:
    """The same with the columns of p parameters alone."""
    return eqx.tree_at(lambda b: b.rows, blocks, blocks.rows[..., -p - 1 :])


def scaled(blocks: Blocks, by: Scales, owners: tuple[int, ...] = ()) -> Blocks:
    """In these scales; the first columns are of curves of the parameters `owners`."""
    factor = jnp.concatenate([by.theta[jnp.array(owners, int)], by.theta, jnp.ones(1)]) / by.noise
    return Blocks(blocks.rows * factor, blocks.left / by.noise**2, blocks.count)
