"""The models of one kind: found on a coarse grid, and followed through the record on the fine one."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from jaximp.numerics.compilation import compiled
from jaximp.tracking.blocks import Blocks, Scales, merged
from jaximp.tracking.causal import filtered
from jaximp.tracking.drift import NONE, Drawn, Search, decays, rate_of, rates, step_of
from jaximp.tracking.state_space import (
    Motion,
    forward,
    moments,
    own_triangle,
    smoother,
    solved,
    triangularise,
    with_rows,
)
from jaximp.types import AnyArray, Numbers

SEARCHED = 1500
"""Drift sizes are found on a grid of so many points at most; the path has all of them."""
SHOWN, CAUSAL = 16, 4
"""How many models of each kind are followed through the record, and how many of them forward only."""


class Moments(eqx.Module):
    """Mean and covariance at each point."""

    theta: Float[AnyArray, "G p"]
    covariance: Float[AnyArray, "G p p"]


class Shapes(eqx.Module):
    """What parameters have of the steps of curves: see `Curves`."""

    points: Float[AnyArray, "G p c"] | None
    shown: Float[AnyArray, "Q f"]


class Followed(eqx.Module):
    """The models of one kind, in scales of the record."""

    path: Moments
    filtered: Moments
    jumped: NDArray[np.float64]
    """(G, p)"""
    size: NDArray[np.float64]
    """(L, p) as `Drift.size`."""
    innovations: AnyArray
    """(G, r) of the most probable model."""
    curves: Moments
    """At the end of the record, see `Curves.shown`: (Q,) and (Q, 1, 1)."""


@dataclass(frozen=True)
class Found:
    """Models of one kind, which were found on a coarse grid."""

    search: Search
    drawn: Drawn
    every: int
    """Points of the fine grid for one of the coarse one."""
    unit: Numbers
    """(p,) what a size of one (`Drift.size`) does in a step of the fine grid, in the scales of the record."""


def find(
    fine: Blocks,
    by: Scales,
    sizes: Numbers,
    jumps: bool,
    apart: float,
    coefficients: tuple[int, ...],
    seed: int,
    order: int,
) -> Found:
    """**Arguments:** `fine` scaled blocks; `sizes` (p,) as `Drift.size`, NaN where they are to be found; `apart` time
    between two points [s]; `coefficients` of each curve."""
    every, information = -(-len(fine.rows) // SEARCHED), np.asarray(by.information)
    coarse, unit = _merged(fine, every), apart ** (order + 0.5) / np.asarray(by.theta)
    given, tried = rate_of(sizes * unit, information, order) * every, rates(len(coarse.rows))
    choices = tuple(tried if np.isnan(rate) else np.array([rate]) for rate in given)
    slopes = decays(len(coarse.rows), order)
    search = Search(coarse, information * every, order, choices, slopes, coefficients, jumps)
    return Found(search, search.drawn(seed), every, unit)


def follow(fine: Blocks, found: Found, shapes: Shapes, seed: int) -> Followed:
    """Their paths on the fine grid."""
    search, drawn, every = found.search, found.drawn, found.every
    inside = np.random.default_rng(seed).integers(0, every, drawn.models.at.shape)
    models, information = drawn.models.finer(every, inside), search.information / every

    def motion(lanes: NDArray[np.int64]) -> tuple[Motion, Array]:
        return models[lanes].motion(information, search.order, search.coefficients), jnp.asarray(drawn.scale[lanes])

    shown, moving = drawn.some(SHOWN), search.moving & search.jumping
    best = jnp.asarray(np.argmax(drawn.log_weight[shown]))
    theta, covariance, innovations, *at_end = _path(fine.rows, *motion(shown), best, shapes)
    causal = _filtered(
        fine.rows, *motion(drawn.some(CAUSAL)), jnp.asarray(search.log_jump),
        jnp.asarray(moving if moving.any() else moving[:0]), every=every, curves=shapes.points,
    )  # fmt: skip
    step = step_of(models.rate[:, shown], information[:, None], search.order) * np.sqrt(drawn.scale[shown])
    jumped = np.repeat(_jump_probability(drawn, search.points), every, axis=0)[: len(fine.rows)] / every
    return Followed(
        path=mixed(theta, covariance, np.full(SHOWN, 1 / SHOWN)),
        filtered=mixed(*causal, np.full(CAUSAL, 1 / CAUSAL)),
        jumped=jumped,
        size=step.T / found.unit,
        innovations=innovations,
        curves=mixed(at_end[0][:, None], at_end[1][:, None, None], np.full(SHOWN, 1 / SHOWN)),
    )


def mixed(theta: AnyArray, covariance: AnyArray, weight: Numbers) -> Moments:
    """Of a mixture of L models: (G, p, L), (G, p, p, L) and (L,)."""
    theta, covariance = np.asarray(theta), np.asarray(covariance)
    mean = theta @ weight
    apart = theta - mean[..., None]
    return Moments(mean, covariance @ weight + np.einsum("gil,gjl,l->gij", apart, apart, weight))


def _jump_probability(drawn: Drawn, points: int) -> Numbers:
    """(G, p) probability of a jump of each parameter in front of each point."""
    found = np.zeros((points, len(drawn.models.rate)))
    for at, which in zip(drawn.models.at, drawn.models.which, strict=True):
        np.add.at(found, (np.maximum(at, 0), which), np.where(at == NONE, 0, drawn.weight))
    return np.minimum(found, 1)


@compiled
def _path(
    rows: Array, motion: Motion, scale: Array, best: Array, shapes: Shapes
) -> tuple[
    Float[Array, "G p L"], Float[Array, "G p p L"], Float[Array, "G r"], Float[Array, "Q L"], Float[Array, "Q L"]
]:
    """What each model makes of the whole record, the innovations of the best one, and curves with their variance."""
    before = forward(rows, motion)[1]
    theta, covariance = smoother(rows, motion, before, shapes.points)
    own, f = jax.tree.map(lambda x: x[:, best, None], motion), rows.shape[-1] - 1
    innovations = _innovations(own.of_lanes(jnp.moveaxis(rows, 0, -1)), jnp.moveaxis(before, 0, 2)[..., best])
    last, root = moments(with_rows(before[-1], motion.of_lanes(rows[-1]))[0][-f:, -f - 1 :])
    unit = (
        jnp.ones_like(last)
        if motion.spread is None
        else jnp.ones_like(last).at[: len(motion.spread)].set(motion.spread)
    )
    shown = jnp.einsum("qf,fl,fl->ql", shapes.shown, unit, last)
    spread = jnp.einsum("qf,fl,fgl->qgl", shapes.shown, unit, root)
    return theta, covariance * scale, innovations / jnp.sqrt(scale[best]), shown, (spread**2).sum(axis=1) * scale


def _innovations(block: Float[Array, "r f G"], before: Float[Array, "d e G"]) -> Float[Array, "G r"]:
    """What each row of a block says that was not known before, standardised by what was expected of it."""
    theta, root = moments(own_triangle(before, block.shape[1] - 1))
    regressor, r = block[:, :-1], len(block)
    surprise = block[:, -1] - (regressor * theta).sum(axis=1)
    spread = (regressor[:, :, None] * root).sum(axis=1)
    # Rows of `[1 spread]` have the covariance that was expected: its triangle standardises them, one after the other.
    whole = jnp.concatenate([jnp.eye(r)[..., None] + jnp.zeros_like(surprise), spread], axis=1)
    upper, _ = triangularise(jnp.moveaxis(whole, 1, 0), r)
    last_first = jnp.swapaxes(upper, 0, 1)[::-1, ::-1]
    return solved(last_first, surprise[::-1, None])[::-1, 0].T


_merged = compiled(merged, static_argnums=1)
_filtered = compiled(filtered, static_argnames=("every",))
