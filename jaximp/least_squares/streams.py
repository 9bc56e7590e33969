"""Rows that arrive one by one: whitened by their own past, and solved in a window that trails behind.

The window is made of blocks, each of which is kept as the triangle of its QR decomposition. What leaves the window is
forgotten, and never subtracted: after hours the sums are as exact as at the beginning.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaximp.least_squares.autoregression import Autoregression
from jaximp.numerics.linear_algebra import inverse_of_triangle, root
from jaximp.types import AnyArray

INDEPENDENT = 1e-10
"""A column whose own part is a smaller share of it is made of others."""


# ---- White rows.


class Whitener(eqx.Module):
    """An autoregression of order k, as weights of a row and of those before it."""

    table: Float[AnyArray, "k1 k1"]
    """A line for each number of rows before that are known."""

    @property
    def order(self) -> int:
        return len(self.table) - 1


class Past(NamedTuple):
    """The rows before, the latest first."""

    rows: Float[Array, "k f"]
    valid: Bool[Array, " k"]


def whitener(noise: Autoregression) -> Whitener:
    """**Raises:** `ValueError` for an autoregression that looks back in steps of several rows."""
    if noise.every != 1:
        raise ValueError(f"rows come one by one, but the noise looks back in steps of {noise.every}: decimate them")
    order = noise.order
    left = np.append(np.cumprod((1 - noise.reflections**2)[::-1])[::-1], 1.0)
    table, polynomial = np.zeros((order + 1, order + 1)), np.ones(1)
    for k in range(order + 1):
        table[k, : k + 1] = np.sqrt(left[k]) * polynomial
        if k < order:
            longer = np.append(polynomial, 0)
            polynomial = longer + noise.reflections[k] * longer[::-1]
    return Whitener(table)


def no_past(by: Whitener, columns: int) -> Past:
    """Before the first row."""
    return Past(jnp.zeros((by.order, columns)), jnp.zeros(by.order, bool))


def whiten_row(by: Whitener, past: Past, z: Float[Array, " f"], valid: Array) -> tuple[Past, Float[Array, " f"]]:
    """What `whiten_rows` makes of the next row: zero where it does not count."""
    rows = jnp.concatenate([z[None], past.rows])
    known = jnp.cumprod(past.valid).sum()
    weights = jnp.asarray(by.table)[known]
    counting = jnp.concatenate([valid[None], past.valid])
    white = (weights[:, None] * jnp.where(counting[:, None], rows, 0)).sum(axis=0)
    return Past(rows[:-1], counting[:-1]), jnp.where(valid, white, 0)


# ---- A window that trails behind.


class Trailing(eqx.Module):
    """The window: its last estimate is at most a block old."""

    blocks: int = eqx.field(static=True)
    """Of which the window is made."""
    rows: int = eqx.field(static=True)
    """In each block."""

    @property
    def length(self) -> int:
        """Rows of the window."""
        return self.blocks * self.rows


class Ring(NamedTuple):
    """Blocks of a window, as triangles."""

    white: Float[Array, "B f f"]
    """Of white columns and torque."""
    plain: Float[Array, "B f1 f1"]
    """Of columns, a constant, and the torque, as they were filtered."""
    samples: Int[Array, " B"]
    """That count in each block."""
    open_white: Float[Array, "r f"]
    """Rows of the block that is not full yet."""
    open_plain: Float[Array, "r f1"]
    open_valid: Bool[Array, " r"]
    place: Int[Array, ""]
    """Of the next row in that block."""


class TrailingFit(NamedTuple):
    """The estimate of the window's white rows, and how well it explains the torque as it was filtered; NaN where there
    is no unique solution."""

    theta: Float[Array, " p"]
    stderr: Float[Array, " p"]
    dof: Float[Array, ""]
    cond: Float[Array, ""]
    sigma_min: Float[Array, ""]
    excitation: Float[Array, " p"]
    residual_rms: Float[Array, ""]
    """[N m]"""
    vaf: Float[Array, ""]
    samples: Int[Array, ""]


def empty_ring(window: Trailing, p: int) -> Ring:
    """Before the first row."""
    blocks, rows = window.blocks, window.rows
    return Ring(
        jnp.zeros((blocks, p + 1, p + 1)),
        jnp.zeros((blocks, p + 2, p + 2)),
        jnp.zeros(blocks, int),
        jnp.zeros((rows, p + 1)),
        jnp.zeros((rows, p + 2)),
        jnp.zeros(rows, bool),
        jnp.zeros((), int),
    )


def no_fit(p: int) -> TrailingFit:
    """Before the first block."""
    unknown, each = jnp.full((), jnp.nan), jnp.full(p, jnp.nan)
    return TrailingFit(each, each, unknown, unknown, unknown, each, unknown, unknown, jnp.zeros((), int))


def take_row(
    window: Trailing, ring: Ring, white: Float[Array, " f"], plain: Float[Array, " f"], valid: Array
) -> tuple[Ring, Array]:
    """The ring with a further row, and whether that completed a block.

    **Arguments:** columns and torque side by side, white and as they were filtered."""
    with_one = jnp.concatenate([plain[:-1], jnp.ones(1), plain[-1:]])
    k = ring.place
    ring = ring._replace(
        open_white=ring.open_white.at[k].set(jnp.where(valid, white, 0)),
        open_plain=ring.open_plain.at[k].set(jnp.where(valid, with_one, 0)),
        open_valid=ring.open_valid.at[k].set(valid),
        place=k + 1,
    )
    full = k + 1 == window.rows

    def close(ring: Ring) -> Ring:
        return ring._replace(
            white=_rolled(ring.white, _triangle(ring.open_white)),
            plain=_rolled(ring.plain, _triangle(ring.open_plain)),
            samples=_rolled(ring.samples, ring.open_valid.sum()),
            place=jnp.zeros((), int),
        )

    return jax.lax.cond(full, close, lambda ring: ring, ring), full


def solve_trailing(ring: Ring) -> TrailingFit:
    """Least squares of all blocks.

    **Source:** the estimator of Tout et al. 2023, III-B, by the triangles of blocks (Golub and Van Loan, Matrix
    computations, 2013, section 6.5).
    """
    p = ring.white.shape[1] - 1
    whole, samples = _triangle(ring.white.reshape(-1, p + 1)), ring.samples.sum()
    R, size = whole[:p, :p], root((whole[:p, :p] ** 2).sum(axis=0))
    own = jnp.abs(jnp.diagonal(R))
    solvable = (samples > p) & (own > INDEPENDENT * size).all()
    R = jnp.where(solvable, R, jnp.eye(p))
    inverse, singular = inverse_of_triangle(R), jnp.linalg.svd(R, compute_uv=False)
    theta, dof = inverse @ whole[:p, p], (samples - p).astype(float)
    spread = whole[p, p] ** 2 / jnp.maximum(dof, 1)
    plain = _triangle(ring.plain.reshape(-1, p + 2))
    left = plain @ jnp.concatenate([theta, jnp.zeros(1), -jnp.ones(1)])
    torque = plain[:, p + 1]
    # The constant is the last column but one: what stands in its row is what a mean takes.
    total, unexplained = torque @ torque, left @ left
    constant = plain[:, p]
    length = jnp.maximum(constant @ constant, 1)
    about_mean = total - (constant @ torque) ** 2 / length
    vaf = 1 - (unexplained - (constant @ left) ** 2 / length) / jnp.where(about_mean > 0, about_mean, jnp.nan)

    def or_nan(value: Array) -> Array:
        return jnp.where(solvable, value, jnp.nan)

    return TrailingFit(
        theta=or_nan(theta),
        stderr=or_nan(root((inverse**2).sum(axis=1) * spread)),
        dof=or_nan(dof),
        cond=or_nan(singular[0] / singular[-1]),
        sigma_min=or_nan(singular[-1]),
        excitation=or_nan(1 / root((inverse**2).sum(axis=1))),
        residual_rms=or_nan(root(unexplained / jnp.maximum(samples, 1))),
        vaf=or_nan(vaf),
        samples=samples,
    )


def _triangle(rows: Float[Array, "m f"]) -> Float[Array, "f f"]:
    """Upper triangle of a QR decomposition, with lines of zeros where there are fewer rows."""
    R = jnp.linalg.qr(rows, mode="r")
    return jnp.pad(R, ((0, rows.shape[1] - len(R)), (0, 0)))


def _rolled(blocks: Array, new: Array) -> Array:
    """Without the oldest block, with a new one."""
    return jnp.concatenate([blocks[1:], new[None].astype(blocks.dtype)])
