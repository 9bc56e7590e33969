"""Parameters that move from one point of a grid to the next: what is known of them, as equations.

All that is known of a state x stands in rows `R x = z + noise of unit variance` (d, d + 1): the square root of the
information matrix, with the right-hand side as its last column. New rows are taken in by an orthogonal transformation;
what a random step makes less certain is taken off by Potter's formula. Neither subtracts squares: variances cannot
become negative, a condition number enters once, and where nothing is measured nothing is known.

A record that is read backwards is the same, with the steps undone. What both passes know, joined, is the smoother; and
what they disagree about is what a jump between them would explain.

The state holds the p parameters; before them the coefficients of curves, where parameters depend on what is measured;
and before these, where parameters are smooth, what they are integrals of: their slopes, and what the slopes are
integrals of. Coefficients stay as they are.

Several models, of one record or each of its own, stand side by side along the last axis of all arrays: the lanes.
Scales are those of `blocks`: parameters of the order of one, noise of variance one.

**Source:** Kalman 1960; Rauch, Tung and Striebel 1965; square roots: Potter 1963, Bierman, Factorization methods for
discrete sequential estimation, 1977; two passes: Fraser and Potter 1969; jumps: de Jong and Penzer 1998.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaximp.numerics.compilation import keep
from jaximp.numerics.lanes import divided, sum_of
from jaximp.types import AnyArray

T = TypeVar("T")

PRIOR = 100.0
"""Standard deviation of parameters before anything is measured, in their own scale."""
WRITTEN_OUT, FEW_TERMS = 6, 64
"""Loops of so many steps at most are written out, and sums of so many terms: larger ones take long to compile."""
NOTHING = 1e-6
"""Root of the information behind the record. Of none at all a triangle would have no derivative."""


class Motion(eqx.Module):
    """How the parameters of L models move."""

    walk: Float[AnyArray, "p L"]
    """Variance of a parameter's own random step."""
    slope: Float[AnyArray, "p L"]
    """How far a parameter moves in a step for a slope of one. Zero: it stays where it is."""
    memory: Float[AnyArray, "p L"]
    """Points of the grid in which slopes become what they may be before the record."""
    at: Int[AnyArray, "J L"]
    """Point of the grid in front of which a jump is; -1 for none."""
    which: Int[AnyArray, "J L"]
    """Parameter that jumps."""
    order: int = eqx.field(static=True)
    """How many times a random walk, of variance one, is integrated until it is a parameter; without any, parameters do
    a random walk themselves."""
    left: Float[AnyArray, "p L"] | None = None
    """What is left of slopes, and of what they are integrals of, after a step. None: all of it."""
    spread: Float[AnyArray, "c L"] | None = None
    """Standard deviation of the coefficients of curves, of which rows have columns in front of those of parameters."""

    def of_lanes(self, rows: Float[Array, "r f ..."]) -> Array:
        """A block's rows in terms of coefficients that have the variance one."""
        if self.spread is None:
            return rows
        unit = jnp.concatenate([jnp.asarray(self.spread), jnp.ones_like(self.walk)])
        unit = jnp.concatenate([unit, jnp.ones_like(unit[:1])])
        return rows.reshape(*rows.shape, *(1,) * (unit.ndim + 1 - rows.ndim)) * unit

    def jump_variance(self, k: Array) -> Float[Array, "p L"]:
        """Of the jumps in front of point k: they are of the size of the parameter, one."""
        parameters = jnp.arange(len(self.walk))[:, None, None]
        return ((self.at == k) & (self.which == parameters)).sum(axis=1).astype(self.walk.dtype)


class Shocks(NamedTuple):
    """What a jump of one parameter in front of a point would explain: evidence for its size."""

    score: Float[Array, "G p L"]
    information: Float[Array, "G p L"]

    def log_odds(self, scale: Array) -> Float[Array, "G p L"]:
        """Logarithm of the likelihood with a jump of the size of the parameter, over that without; `scale` (L,) squared
        of the noise."""
        wider = 1 + self.information
        return (self.score**2 / wider / scale - jnp.log(wider)) / 2


class Evidence(NamedTuple):
    """The likelihood of a record."""

    log_determinant: Float[Array, " L"]
    """Sum of the logarithms of what data and prior make of a volume."""
    squares: Float[Array, " L"]
    """Of standardised residuals, those inside of blocks not counted."""

    def log_likelihood(self, left: Array, freedom: Array) -> Float[Array, " L"]:
        """For the best scale of the noise; `left` squares inside of blocks, `freedom` rows less parameters."""
        return self.log_determinant - freedom / 2 * jnp.log((self.squares + left) / freedom)


def triangularise(
    rows: Float[Array, "m n *L"], pivots: int, full: int | None = None
) -> tuple[Float[Array, "d n *L"], Float[Array, "m k *L"]]:
    """Upper triangle of the first columns of rows, by modified Gram-Schmidt, and what it leaves of the others.

    Columns need not be independent: a pivot is then zero, or rounding. Rows are a triangle from row `full` on.
    """
    if pivots == 0:
        return rows[:0], rows
    if pivots > WRITTEN_OUT:
        return _triangularise_in_a_loop(rows, pivots)
    triangle: list[Array] = []
    for j in range(pivots):
        begun = len(rows) if full is None else full + j + 1
        column, others = rows[:begun, 0], rows[:begun, 1:]
        unit, pivot = _unit(column)
        along = keep(_summed(unit[:, None], others))
        rows = keep(jnp.concatenate([others - unit[:, None] * along, rows[begun:, 1:]]))
        nothing = jnp.zeros((j, *pivot.shape), rows.dtype)
        triangle.append(jnp.concatenate([nothing, pivot[None], along]))
    return jnp.stack(triangle), rows


def _triangularise_in_a_loop(rows: Array, pivots: int) -> tuple[Array, Array]:
    columns = jnp.arange(rows.shape[1]).reshape(-1, *(1,) * (rows.ndim - 2))

    def eliminate(j: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        rows, triangle = state
        unit, _ = _unit(rows[:, j])
        along = keep(_summed(unit[:, None], rows))
        return keep(rows - unit[:, None] * along), triangle.at[j].set(jnp.where(columns >= j, along, 0))

    start = rows, jnp.zeros((pivots, *rows.shape[1:]), rows.dtype)
    rows, triangle = jax.lax.fori_loop(0, pivots, eliminate, start)
    return triangle, rows[:, pivots:]


def _unit(column: Float[Array, "m *L"]) -> tuple[Float[Array, "m *L"], Float[Array, "*L"]]:
    """The column divided by its length, and this; both zero for no column at all."""
    square = _summed(column, column)
    positive = square > 0
    pivot = jnp.sqrt(jnp.where(positive, square, 1))
    return keep(jnp.where(positive, column / pivot, 0)), jnp.where(positive, pivot, 0)


def _summed(a: Float[Array, "m ..."], b: Float[Array, "m ..."]) -> Array:
    """Sum over the first axis of `a * b`. XLA adds few terms, one after the other, for many lanes at a time."""
    return sum_of(x * y for x, y in zip(a, b, strict=True)) if len(a) <= FEW_TERMS else (a * b).sum(axis=0)


def for_each(count: int, body: Callable[[Any, T], T], state: T) -> T:
    """`body(i, state)` for all i in turn: written out where there are few, and else a loop, which is compiled once."""
    if count > WRITTEN_OUT:
        return jax.lax.fori_loop(0, count, body, state)
    for i in range(count):
        state = body(i, state)
    return state


def start(motion: Motion) -> Float[Array, "d e L"]:
    """What is known before the record: a diagonal."""
    root = [motion.memory ** -(0.5 + k) for k in range(motion.order)]
    curves = [] if motion.spread is None else [jnp.ones_like(motion.spread)]
    diagonal = jnp.concatenate([*root, *curves, jnp.full_like(motion.walk, 1 / PRIOR)])
    d = len(diagonal)
    return jnp.eye(d, d + 1, dtype=diagonal.dtype)[..., None] * diagonal[:, None]


def moved(known: Array, motion: Motion, jumps: Array) -> tuple[Array, Array]:
    """What is known after a step, and twice the logarithm of what it takes off the determinant."""
    known, less = _less_certain(_stepped(known, motion, -1.0), motion, jumps)
    return known, less if motion.left is None else less - 2 * motion.order * jnp.log(motion.left).sum(axis=0)


def _stepped(known: Array, motion: Motion, sign: float) -> Array:
    """In terms of the state a step later (sign -1) or earlier (+1), but for what is random in it.

    Every integral takes up what it is an integral of, as it was before the step.
    """
    p, order = len(motion.walk), motion.order
    own = known.shape[1] - 1 - p
    parts = [*(known[:, k * p : (k + 1) * p] for k in range(order)), known[:, own:-1]]
    left = jnp.ones_like(motion.slope) if motion.left is None else motion.left
    for k in range(order) if sign > 0 else reversed(range(order)):
        taken = (motion.slope if k == order - 1 else jnp.ones_like(motion.slope)) * parts[k + 1]
        parts[k] = left * parts[k] + taken if sign > 0 else (parts[k] - taken) / left
    return jnp.concatenate([*parts[:-1], known[:, order * p : own], parts[-1], known[:, -1:]], axis=1)


def _less_certain(known: Array, motion: Motion, jumps: Array) -> tuple[Array, Array]:
    """Potter's formula for the random part of a step, one state after the other."""
    own, p = motion.walk + jumps, len(motion.walk)

    def widen(first: int, variance: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        def one(i: Any, state: tuple[Array, Array]) -> tuple[Array, Array]:
            known, less = widened(state[0], state[0][:, first + i], variance[i])
            return known, state[1] + less

        return for_each(p, one, state)

    state = known, jnp.zeros_like(known[0, 0])
    first = len(known) - p
    if motion.order == 0:
        return widen(first, own, state)
    state = widen(0, jnp.ones_like(own), state)
    # What is smooth has no random step of its own but for jumps, which are rare.
    return jax.lax.cond((own > 0).any(), lambda state: widen(first, own, state), lambda state: state, state)


def widened(known: Array, column: Array, variance: Array) -> tuple[Array, Array]:
    """What is known once the state of this column has had a random step of this variance, and what that takes off: see
    `moved`."""
    share = 1 / (1 + variance * _summed(column, column))
    gain = variance * share / (1 + jnp.sqrt(share))
    along = keep(gain * _summed(column[:, None], known))
    return keep(known - column[:, None] * along), jnp.log(share)


def with_rows(known: Array, rows: Float[Array, "r f *L"]) -> tuple[Array, Array]:
    """What is known with a block's rows, a triangle, and the squares that it leaves.

    The rows know nothing of slopes, which come first.
    """
    p = rows.shape[1] - 1
    above, rest = triangularise(known, len(known) - p)
    below, left = triangularise(jnp.concatenate([rest, _of_lanes(rows, rest)]), p)
    below = jnp.concatenate([jnp.zeros((p, len(above), *below.shape[2:]), below.dtype), below], axis=1)
    return jnp.concatenate([above, below]), (left[:, 0] ** 2).sum(axis=0)


def _of_lanes(rows: Float[Array, "r f *L"], known: Array) -> Array:
    """A block's rows, for every lane."""
    rows = rows.reshape(*rows.shape, *(1,) * (known.ndim - rows.ndim))
    return jnp.broadcast_to(rows, (len(rows), *known.shape[1:]))


def forward(rows: Float[Array, "G r f *L"], motion: Motion) -> tuple[Evidence, Float[Array, "G d e L"]]:
    """Kalman's filter over the points of the grid: what the record says of the models, and what was known of each point
    before its rows."""
    begin = start(motion)

    def step(carry: tuple[Array, Array, Array], now: tuple[Array, Array]) -> tuple[tuple[Array, Array, Array], Array]:
        (known, lost, squares), (k, block) = carry, now
        before, less = moved(known, motion, motion.jump_variance(k))
        known, left = with_rows(before, motion.of_lanes(block))
        return (known, lost + less, squares + left), before

    nothing = jnp.zeros_like(motion.walk[0])
    (known, lost, squares), before = jax.lax.scan(step, (begin, nothing, nothing), (jnp.arange(len(rows)), rows))
    return Evidence(lost / 2 + log_volume(begin) - log_volume(known), squares), before


def log_volume(triangle: Array) -> Array:
    """(L,) logarithm of the determinant of a triangle with a right-hand side."""
    return jnp.log(jnp.stack([jnp.abs(triangle[i, i]) for i in range(len(triangle))])).sum(axis=0)


def evidence(rows: Float[Array, "G r f *L"], motion: Motion) -> Evidence:
    """What `forward` says of the models, without the path."""
    return forward(rows, motion)[0]


def smoother(
    rows: Float[Array, "G r f *L"],
    motion: Motion,
    before: Float[Array, "G d e L"],
    curves: Float[Array, "G p c"] | None = None,
) -> tuple[Float[Array, "G p L"], Float[Array, "G p p L"]]:
    """Parameters at each point and their covariance, from the whole record; `before` as `forward` gives it, `curves` as
    `seen` takes them."""
    d, f = before.shape[1], rows.shape[2] - 1

    def look(known: Array, earlier: Array, curve: Array | None) -> tuple[Array, Array]:
        whole, _ = triangularise(jnp.concatenate([earlier, known]), d, full=d)
        theta, root = seen(whole[-f:, -f - 1 :], motion, curve)
        return theta, covariance_of(root)

    return _backward(rows, motion, before, look, curves)


def seen(
    triangle: Float[Array, "f g *K"], motion: Motion, curve: Float[Array, "q c"] | None
) -> tuple[Float[Array, "q *K"], Float[Array, "q f *K"]]:
    """Parameters and a root of their covariance, from the triangle of coefficients and parameters.

    **Arguments:** `curve` how much of each coefficient is in each parameter; None where there are none.
    """
    theta, root = moments(triangle)
    if curve is None or motion.spread is None:
        return theta, root
    c = curve.shape[1]
    share = curve.reshape(*curve.shape, *(1,) * (theta.ndim - 1)) * motion.spread
    return (
        theta[c:] + _summed(jnp.moveaxis(share, 1, 0), theta[:c, None]),
        root[c:] + _summed(jnp.moveaxis(share, 1, 0)[:, :, None], root[:c, None]),
    )


def shocks(rows: Float[Array, "G r f *L"], motion: Motion, before: Float[Array, "G d e L"]) -> Shocks:
    """What a jump of each parameter in front of each point would explain; `before` as `forward` gives it."""
    d, p = before.shape[1], len(motion.walk)

    def look(known: Array, earlier: Array, _: Any) -> Shocks:
        # Before a jump by delta, the state was less by it.
        jump = jnp.concatenate([-earlier[:, -p - 1 : -1], jnp.zeros_like(known[:, -p - 1 : -1])])
        both = jnp.concatenate([earlier, known])
        both = jnp.concatenate([both[:, :-1], jump, both[:, -1:]], axis=1)
        _, left = triangularise(both, d, full=d)
        return Shocks((left[:, :p] * left[:, p:]).sum(axis=0), (left[:, :p] ** 2).sum(axis=0))

    return _backward(rows, motion, before, look)


def _backward(
    rows: Float[Array, "G r f *L"],
    motion: Motion,
    before: Float[Array, "G d e L"],
    look: Callable[[Array, Array, Any], T],
    curves: Float[Array, "G p c"] | None = None,
) -> T:
    """The record from its end: `look` sees what the points from each one on know of it, and those before it."""

    def step(behind: Array, now: tuple[Array, Array, Array, Any]) -> tuple[Array, T]:
        k, block, earlier, curve = now
        known, _ = with_rows(behind, motion.of_lanes(block))
        found = look(known, earlier, curve)
        known, _ = _less_certain(known, motion, motion.jump_variance(k))
        return _stepped(known, motion, 1.0), found

    d = before.shape[1]
    nothing = jnp.broadcast_to(NOTHING * jnp.eye(d, d + 1, dtype=rows.dtype)[..., None], before.shape[1:])
    return jax.lax.scan(step, nothing, (jnp.arange(len(rows)), rows, before, curves), reverse=True)[1]


def own_triangle(known: Float[Array, "m e *K"], p: int) -> Float[Array, "p f *K"]:
    """Of the parameters alone, from all that is known of the state."""
    return triangularise(known, known.shape[1] - 1)[0][-p:, -p - 1 :]


def moments(triangle: Float[Array, "p f *K"]) -> tuple[Float[Array, "p *K"], Float[Array, "p p *K"]]:
    """Parameters and a root of their covariance, `root @ root'`, from their triangle."""
    p = len(triangle)
    unit = jnp.broadcast_to(
        jnp.eye(p, dtype=triangle.dtype).reshape(p, p, *(1,) * (triangle.ndim - 2)), triangle[:, 1:].shape
    )
    found = solved(triangle[:, :p], jnp.concatenate([triangle[:, p:], unit], axis=1))
    return found[:, 0], found[:, 1:]


def solved(triangle: Float[Array, "p p *K"], right: Float[Array, "p k *K"]) -> Float[Array, "p k *K"]:
    """`triangle^-1 @ right`, from its last row up."""
    p = len(triangle)

    def substitute(i: Any, found: Array) -> Array:
        k = p - 1 - i
        rest = right[k] - _summed(triangle[k][:, None], found)  # what is not yet found counts as zero
        return found.at[k].set(keep(divided(rest, triangle[k, k])))

    return for_each(p, substitute, jnp.zeros_like(right))


def covariance_of(root: Float[Array, "p f *K"]) -> Float[Array, "p p *K"]:
    """`root @ root'`."""
    return (root[:, None] * root).sum(axis=2)
