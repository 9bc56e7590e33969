"""What is known of parameters up to now, row by row: the bank of filters of `causal`, with models that are frozen.

A stretch of rows tells how fast parameters move, how often they jump and how large the noise is (`learn`). From then on
`track_row` takes one row after the other, in constant time and memory, for as long as it likes.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num, Shaped

from jaximp.tracking.blocks import compress
from jaximp.tracking.causal import BANK, Bank, over_filters, split
from jaximp.tracking.drift import NONE, step_of
from jaximp.tracking.following import CAUSAL, Found, find
from jaximp.tracking.paths import found_in, kinds_of
from jaximp.tracking.state_space import Motion, covariance_of, log_volume, moments, moved, start, with_rows
from jaximp.types import AnyArray

SURPRISED = 25.0
"""Points of the grid over which innovations are averaged."""
MOST_SURPRISE = 9.0
"""Square of an innovation that counts at most, so that a single leap is forgotten soon; of noise it takes off 2 %."""


class Kind(eqx.Module):
    """Models of one kind of motion, side by side."""

    walk: Float[AnyArray, "p L"]
    """As in `Motion`, in scales of the record."""
    slope: Float[AnyArray, "p L"]
    memory: Float[AnyArray, "p L"]
    scale: Float[AnyArray, " L"]
    """Square of the noise's."""
    log_jump: Float[AnyArray, ""]
    """Logarithm of the probability that a parameter jumps between two splits of the bank."""
    probability: Float[AnyArray, ""]
    """Of this kind among all."""
    size: Float[AnyArray, "L p"]
    """As `Drift.size`, to be shown."""
    order: int = eqx.field(static=True)
    left: Float[AnyArray, "p L"] | None = None
    """As in `Motion`."""

    @property
    def motion(self) -> Motion:
        """Without jumps, of which the bank takes care."""
        none = jnp.full((0, self.walk.shape[1]), NONE)
        walk, slope, memory = (jnp.asarray(x) for x in (self.walk, self.slope, self.memory))
        left = None if self.left is None else jnp.asarray(self.left)
        return Motion(walk, slope, memory, none, none, self.order, left)


class Frozen(eqx.Module):
    """How parameters move: what a stretch of rows said of it."""

    noise: Float[AnyArray, ""]
    """Unit of the torque [N m]: about the standard deviation of a white row."""
    theta: Float[AnyArray, " p"]
    """Units of the parameters."""
    kind: Kind
    """The most probable one: several side by side would take as many times as long."""
    grid: int = eqx.field(static=True)
    """Rows from one point to the next, at which parameters may move."""
    every: int = eqx.field(static=True)
    """Points from one split of the bank to the next."""
    jumps: bool = eqx.field(static=True)
    """Whether parameters may jump."""

    @property
    def torque_noise(self) -> float:
        """Standard deviation of a white row [N m]."""
        return float(self.noise * np.sqrt(np.mean(self.kind.scale)))


class Followers(NamedTuple):
    """The bank, and what it says."""

    bank: Bank
    points: Int[Array, ""]
    """So far."""
    rows: Float[Array, "g f"]
    """Of the point that is not complete yet, in scales of the record."""
    place: Int[Array, ""]
    """Of the next row among them."""
    theta: Float[Array, " p"]
    """In units of the model."""
    covariance: Float[Array, "p p"]
    squares: Float[Array, ""]
    """Of innovations, standardised, with a memory of `SURPRISED` points."""
    surprises: Float[Array, ""]
    """How many of them."""


def learn(
    W: Num[AnyArray, "N p"],
    y: Num[AnyArray, " N"],
    valid: Shaped[AnyArray, " N"],
    *,
    grid: int,
    row_rate: float,
    jumps: bool = True,
    seed: int = 0,
) -> Frozen:
    """Drift sizes, jumps and noise by the likelihood of a stretch of white rows, as `track` finds them.

    No parameter is taken as at rest: a stretch cannot tell rest from a drift that is slower than itself, and whoever
    goes on for longer must not rely on it. So none is remembered for longer than the stretch.

    **Arguments:** `grid` rows from one point to the next; `row_rate` [Hz].

    **Raises:** `ValueError` where fewer rows count than there are parameters.
    """
    W, y, valid = np.asarray(W, float), np.asarray(y, float), np.asarray(valid, bool)
    W, y = np.where(valid[:, None], W, 0), np.where(valid, y, 0)
    if valid.sum() <= W.shape[1]:
        raise ValueError(f"{valid.sum()} rows count, for {W.shape[1]} parameters: calibrate for longer, and move")
    blocks = _compress(W[:, None], y[:, None], valid[:, None], grid)
    sizes = np.full(W.shape[1], np.nan)
    look = partial(find, sizes=sizes, jumps=jumps, apart=grid / row_rate, coefficients=(), seed=seed)
    kinds = kinds_of(W.shape[1])
    by, fine, found = found_in(blocks, sizes, (), lambda *scaled: [look(*scaled, order=kind) for kind in kinds])
    evidence = np.array([one.drawn.log_evidence for one in found])
    shares = np.exp(evidence - np.logaddexp.reduce(evidence))
    best = int(shares.argmax())
    kind = _kind(found[best], shares[best], len(fine.rows))
    noise, theta = np.asarray(by.noise, float), np.asarray(by.theta, float)
    return Frozen(noise, theta, kind, grid, found[0].every, jumps)


_compress = jax.jit(compress, static_argnums=3)


def _kind(found: Found, probability: float, points: int) -> Kind:
    """Some of its models, each as often as it weighs, on the fine grid."""
    search, drawn, lanes = found.search, found.drawn, found.drawn.some(CAUSAL)
    models = drawn.models.finer(found.every, np.zeros(drawn.models.at.shape, int))[lanes]
    rate = np.maximum(models.rate, 1 / points)
    information, scale = search.information / found.every, drawn.scale[lanes]
    motion = jax.tree.map(np.asarray, replace(models, rate=rate).motion(information, search.order))
    size = (step_of(rate, information[:, None], search.order) * np.sqrt(scale)).T / found.unit
    log_jump, chance = np.asarray(search.log_jump), np.asarray(probability)
    steps = motion.walk, motion.slope, motion.memory
    return Kind(*steps, scale, log_jump, chance, size, search.order, motion.left)


def begin_tracking(frozen: Frozen) -> Followers:
    """Before the first row: parameters are zero within a hundred times the size that the stretch suggested."""
    p = len(frozen.theta)
    bank = max(BANK, 2 * p) if frozen.jumps else 1
    known = start(frozen.kind.motion)
    known = jnp.broadcast_to(known[:, :, None], (*known.shape[:2], bank, known.shape[2]))
    one = jnp.where(jnp.arange(bank) == 0, 0.0, -1e6)[:, None] + jnp.zeros(known.shape[-1])
    nothing, count = jnp.zeros(()), jnp.zeros((), int)
    unknown = jnp.full(p, jnp.nan), jnp.full((p, p), jnp.nan)
    return Followers(Bank(known, one, one), count, jnp.zeros((frozen.grid, p + 1)), count, *unknown, nothing, nothing)


def track_row(frozen: Frozen, at: Followers, row: Float[Array, " f"], valid: Array) -> tuple[Followers, Array]:
    """What is known with one more white row, columns and torque side by side, and whether it completed a point of the
    grid: only then the estimate is a new one."""
    units = jnp.append(jnp.asarray(frozen.theta), 1.0) / frozen.noise
    at = at._replace(rows=at.rows.at[at.place].set(jnp.where(valid, row * units, 0)), place=at.place + 1)
    full = at.place == frozen.grid
    return jax.lax.cond(full, partial(_next_point, frozen), lambda at: at, at), full


def _next_point(frozen: Frozen, at: Followers) -> Followers:
    bank, theta, covariance, squares = _advanced(frozen, at.bank, at.rows, at.points)
    units, keeps, rows = jnp.asarray(frozen.theta), 1 - 1 / SURPRISED, (at.rows != 0).any(axis=1).sum()
    return Followers(
        bank=bank,
        points=at.points + 1,
        rows=jnp.zeros_like(at.rows),
        place=jnp.zeros_like(at.place),
        theta=theta * units,
        covariance=covariance * units[:, None] * units,
        squares=keeps * at.squares + jnp.minimum(squares, MOST_SURPRISE * rows),
        surprises=keeps * at.surprises + rows,
    )


def _advanced(
    frozen: Frozen, bank: Bank, rows: Float[Array, "g f"], point: Array
) -> tuple[Bank, Float[Array, " p"], Float[Array, "p p"], Array]:
    """One step of `causal.filtered`: the bank, mean and covariance over all its models, and the square of what the rows
    say that was not expected."""
    kind, p = frozen.kind, len(frozen.theta)
    scale = jnp.asarray(kind.scale)
    wide = jax.tree.map(lambda x: x[:, None], kind.motion)
    before, less = moved(bank.known, wide, jnp.zeros_like(wide.walk))
    bank = bank._replace(known=before, evidence=bank.evidence + less / 2)
    if frozen.jumps:
        after_split = partial(split, moving=jnp.ones(p, bool), log_jump=jnp.asarray(kind.log_jump))
        bank = jax.lax.cond(point % frozen.every == 0, after_split, lambda bank: bank, bank)
    expected = jax.nn.softmax(bank.evidence - log_volume(bank.known), axis=0)
    known, left = with_rows(bank.known, rows)
    evidence = bank.evidence - left / (2 * scale)
    log_weight = evidence - log_volume(known)
    theta, root = moments(known[-p:, -p - 1 :])
    mean, covariance = over_filters(theta, covariance_of(root) * scale, jax.nn.softmax(log_weight, axis=0))
    # Logarithms that grow for hours would lose their digits.
    largest = log_weight.max(axis=0)
    bank = Bank(known, evidence - largest, log_weight - largest)
    surprise = (expected * left).sum(axis=0) / scale
    theta = mean.mean(axis=1)
    apart = mean - theta[:, None]
    return bank, theta, covariance.mean(axis=2) + apart @ apart.T / len(scale), surprise.mean()
