"""The estimate with every sample: `init`, `step` for one sample, `run` for many, which gives the same numbers.

All that was decided before stands in a `Live`, all that changes in a `State`. Both are pytrees of fixed size.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaximp.least_squares.streams import (
    Past,
    Ring,
    Trailing,
    TrailingFit,
    Whitener,
    empty_ring,
    no_fit,
    no_past,
    solve_trailing,
    take_row,
    whiten_row,
)
from jaximp.live.front import Front, Held, Row, Sample, nothing_held, take_sample
from jaximp.numerics.compilation import filter_compiled, options
from jaximp.tracking.online import Followers, Frozen, begin_tracking, track_row
from jaximp.types import AnyArray


class Live(eqx.Module):
    """What is done with every sample, and what the calibration said of the noise and of how parameters move."""

    front: Front
    filtered: Whitener
    """What the filters make of white noise."""
    noise: Whitener
    """What is left where that is taken off."""
    frozen: Frozen
    window: Trailing


class State(NamedTuple):
    """All that is kept of the samples so far."""

    held: Held
    past_filtered: Past
    past_noise: Past
    followers: Followers
    ring: Ring
    fit: TrailingFit
    """Of the window when its last block was complete."""


class Estimate(NamedTuple):
    """What is known with a sample; NaN before the first estimate."""

    theta: Float[Array, "*N p"]
    """By the path with a band (`track`)."""
    stderr: Float[Array, "*N p"]
    surprise: Float[Array, "*N"]
    """Variance of what was measured and not expected, of late, over what was to be expected: one if all is right."""
    surprises: Float[Array, "*N"]
    """How many rows that comes from."""
    window: TrailingFit
    """By the window that trails behind."""
    new: Bool[Array, "*N"]
    """Whether this sample changed the path."""
    measured: Bool[Array, "*N"]
    """Whether the row of this sample comes from measurements; True of samples that make none."""


def init(live: Live) -> State:
    """Before the first sample."""
    front, p = live.front, live.front.columns - 1
    return State(
        nothing_held(front),
        no_past(live.filtered, front.columns),
        no_past(live.noise, front.columns),
        begin_tracking(live.frozen),
        empty_ring(live.window, p),
        no_fit(p),
    )


def step(live: Live, state: State, sample: Sample) -> tuple[State, Estimate]:
    """One sample further. Pure: `jit` goes through; a loop of Python is served by `Stepper`.

    **Arguments:** `sample` position [rad or m] and torque [N m or N] at the next instant of the grid, or a missing one.
    """
    held, row = take_sample(live.front, state.held, sample)
    state, new = jax.lax.cond(row.due, lambda s: _with_row(live, s, row), _without, state._replace(held=held))
    at = state.followers
    estimate = Estimate(
        theta=at.theta,
        stderr=jnp.sqrt(jnp.diagonal(at.covariance)),
        surprise=jnp.where(at.surprises > 0, at.squares / jnp.maximum(at.surprises, 1e-300), jnp.nan),
        surprises=at.surprises,
        window=state.fit,
        new=new,
        measured=row.measured | ~row.due,
    )
    return state, estimate


def _without(state: State) -> tuple[State, Array]:
    return state, jnp.zeros((), bool)


def _with_row(live: Live, state: State, row: Row) -> tuple[State, Array]:
    """White rows first, then path and window."""
    past_filtered, between = whiten_row(live.filtered, state.past_filtered, row.values, row.valid)
    past_noise, white = whiten_row(live.noise, state.past_noise, between, row.valid)
    followers, new = track_row(live.frozen, state.followers, white, row.valid)
    ring, full = take_row(live.window, state.ring, white, row.values, row.valid)
    fit = jax.lax.cond(full, lambda _: solve_trailing(ring), lambda fit: fit, state.fit)
    return State(state.held, past_filtered, past_noise, followers, ring, fit), new


def run(live: Live, state: State, samples: Sample) -> tuple[State, Estimate]:
    """N samples further: the numbers of `step`, one after the other."""
    return jax.lax.scan(lambda s, sample: step(live, s, sample), state, samples)


def rows(front: Front, held: Held, samples: Sample) -> tuple[Held, Row]:
    """What `take_sample` makes of N samples: rows before anything is known of noise and motion."""
    return jax.lax.scan(lambda h, sample: take_sample(front, h, sample), held, samples)


def compiled_run(live: Live, state: State, samples: Sample) -> tuple[State, Estimate]:
    """`run`, compiled once for each number of samples."""
    return filter_compiled(run)(live, state, samples)


def compiled_rows(front: Front, held: Held, samples: Sample) -> tuple[Held, Row]:
    """`rows`, compiled."""
    return filter_compiled(rows)(front, held, samples)


CHUNKS = (256, 16, 1)
"""How many samples `Stepper.many` takes at once: it is compiled for these."""


class Stepper:
    """`step`, compiled, with all of the state in one array: most of the time of a step went into handing arrays over.

    The same numbers as `step`. (Whole numbers and truths are kept exactly in an array of doubles.)
    """

    def __init__(self, live: Live, state: State):
        arrays, static = eqx.partition(live, eqx.is_array)
        self.live = live
        self._packed_live, unpack_live = _pack(arrays), _unpacker(arrays)
        self._state, self._unpack_state = _pack(state), _unpacker(state)

        def advance(packed_live: Array, packed: Array, samples: Array) -> tuple[Array, Array]:
            whole = eqx.combine(unpack_live(packed_live), static)

            def one(state: State, x: Array) -> tuple[State, Array]:
                state, estimate = step(whole, state, Sample(x[0], x[1], x[2] > 0))
                return state, _pack(estimate)

            begin = self._unpack_state(packed)
            if len(samples) == 1:
                state, found = one(begin, samples[0])
                return _pack(state), found[None]
            state, found = jax.lax.scan(one, begin, samples)
            return _pack(state), found

        shapes = jax.eval_shape(partial(step, live), state, Sample(0.0, 0.0, True))[1]
        self._advance, self._unpack = jax.jit(advance, donate_argnums=1, compiler_options=options()), _unpacker(shapes)

    def compile(self) -> None:
        """For all `CHUNKS`, so that the first samples need not wait."""
        for count in CHUNKS:
            self._advance(self._packed_live, jnp.array(self._state), np.zeros((count, 3)))

    def __call__(self, position: float, torque: float, valid: bool = True) -> Estimate:
        """What is known with one more sample."""
        return self._taken(np.array([[position, torque, valid]]), 0)

    def many(self, position: AnyArray, torque: AnyArray, valid: AnyArray) -> Estimate:
        """What is known with each of N more samples, N being one of `CHUNKS`."""
        return self._taken(np.stack([position, torque, np.asarray(valid, float)], axis=1), slice(None))

    def _taken(self, samples: AnyArray, which: Any) -> Estimate:
        self._state, found = self._advance(self._packed_live, self._state, samples)
        estimate: Estimate = self._unpack(np.asarray(found)[which])
        return estimate

    def begin_anew(self) -> None:
        """As before the first sample."""
        self._state = _pack(init(self.live))

    @property
    def state(self) -> State:
        """As it is now."""
        state: State = jax.tree.map(jnp.array, self._unpack_state(self._state))
        return state


def _pack(tree: Any) -> Array:
    return jnp.concatenate([jnp.ravel(jnp.asarray(leaf)).astype(float) for leaf in jax.tree.leaves(tree)])


def _unpacker(tree: Any) -> Callable[[Any], Any]:
    """From one array back to a tree like this one; or from several, side by side."""
    leaves, structure = jax.tree.flatten(tree)
    shapes, kinds = [leaf.shape for leaf in leaves], [np.dtype(leaf.dtype) for leaf in leaves]
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes]).tolist()
    pieces = list(zip([0, *ends], ends, shapes, kinds, strict=False))

    def unpack(packed: Any) -> Any:
        several = packed.shape[:-1]
        parts = [packed[..., a:b].reshape((*several, *shape)).astype(kind) for a, b, shape, kind in pieces]
        return jax.tree.unflatten(structure, parts)

    return unpack
