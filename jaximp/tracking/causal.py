"""What is known of the parameters up to each instant, where they may jump at any time.

A bank of Kalman filters stands side by side: one has seen no jump of late, others that one parameter jumped at such a
point. From time to time the most probable of them splits, and those that explain least make room. After a jump the
filter that knows of it needs a few rows to prevail, however slowly the parameters drift otherwise.

**Source:** Gaussian sums: Alspach and Sorenson 1972; splitting and pruning: Bar-Shalom, Li and Kirubarajan, Estimation
with applications to tracking and navigation, 2001, chapter 11.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaximp.tracking.state_space import (
    Motion,
    covariance_of,
    log_volume,
    moved,
    seen,
    start,
    widened,
    with_rows,
)

BANK = 32
"""Filters of each model, at least."""


class Bank(NamedTuple):
    known: Float[Array, "d e H L"]
    evidence: Float[Array, "H L"]
    """Of each filter, but for what it knows at present."""
    log_weight: Float[Array, "H L"]


def filtered(
    rows: Float[Array, "G r f"],
    motion: Motion,
    scale: Array,
    log_jump: Array,
    moving: Array,
    every: int,
    curves: Float[Array, "G p c"] | None = None,
) -> tuple[Float[Array, "G p L"], Float[Array, "G p p L"]]:
    """Mean and covariance at each point.

    **Arguments:** `motion` of L models, whose jumps are left out of account; `scale` (L,) square of the noise's;
    `log_jump` logarithm of the probability that a parameter jumps within `every` points, which lie between two splits,
    and `moving` (p,) which may: without any a single filter runs for each model; `curves` of `state_space.seen`."""
    points, p, f = len(rows), len(motion.walk), rows.shape[-1] - 1
    bank = max(BANK, 2 * p) if len(moving) else 1
    wide = jax.tree.map(lambda x: x[:, None], motion)
    known = start(motion)
    known = jnp.broadcast_to(known[:, :, None], (*known.shape[:2], bank, known.shape[2]))
    one = jnp.where(jnp.arange(bank) == 0, 0.0, -1e6)[:, None] + jnp.zeros_like(scale)

    def step(at: Bank, now: tuple[Array, Array, Any]) -> tuple[Bank, tuple[Array, Array]]:
        k, block, curve = now
        before, less = moved(at.known, wide, jnp.zeros_like(wide.walk))
        at = at._replace(known=before, evidence=at.evidence + less / 2)
        if len(moving):
            at = jax.lax.cond(k % every == 0, lambda at: split(at, moving, log_jump), lambda at: at, at)
        known, left = with_rows(at.known, wide.of_lanes(block))
        evidence = at.evidence - left / (2 * scale)
        log_weight = evidence - log_volume(known)
        theta, root = seen(known[-f:, -f - 1 :], wide, curve)
        weight = jax.nn.softmax(log_weight, axis=0)
        return Bank(known, evidence, log_weight), over_filters(theta, covariance_of(root) * scale, weight)

    return jax.lax.scan(step, Bank(known, one, one), (jnp.arange(points), rows, curves))[1]


def over_filters(
    theta: Float[Array, "p H L"], covariance: Float[Array, "p p H L"], weight: Float[Array, "H L"]
) -> tuple[Float[Array, "p L"], Float[Array, "p p L"]]:
    """Mean and covariance over the filters of each model."""
    mean = (weight * theta).sum(axis=1)
    apart = theta - mean[:, None]
    return mean, (weight * (covariance + apart[:, None] * apart)).sum(axis=2)


def split(at: Bank, moving: Array, log_jump: Array) -> Bank:
    """The most probable filter, with a jump of each parameter, in the place of the least probable ones."""
    known, evidence, log_weight = at
    p, d, lanes = len(moving), len(known), jnp.arange(evidence.shape[1])
    best, place = jnp.argmax(log_weight, axis=0), (jnp.argsort(log_weight, axis=0)[:p], lanes)
    parent = known[:, :, best, lanes]
    child, less = widened(parent[:, :, None], parent[:, d - p : d], jnp.asarray(moving, known.dtype)[:, None])
    gone = log_jump + jnp.where(moving[:, None], less / 2, -1e6)
    return Bank(
        known.at[:, :, *place].set(child),
        evidence.at[place].set(evidence[best, lanes] + gone),
        log_weight.at[place].set(log_weight[best, lanes] + gone),
    )
