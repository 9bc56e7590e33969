"""Least squares over all sliding windows at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import chain
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Integer, Num, Shaped
from numpy.typing import NDArray

from jaximp.chunks import Estimated, Piece, lags_for_sums, make_plan, solve_all, solve_pieces, solve_traced
from jaximp.compilation import compiled
from jaximp.least_squares import WindowFit, check_finite, least_squares, variance_accounted_for
from jaximp.signals import require_float64
from jaximp.types import AnyArray

BATCH_NUMBERS = 4_000_000
"""How many numbers of W are gathered at a time (32 MB): windows overlap, so that all together would not fit."""


FROM_CHUNKS = 200_000_000
"""So many numbers in all windows together, and sums that windows share are worth the time they take to compile."""


class SlidingFit(eqx.Module):
    """One estimate per window; a window without a unique solution is NaN throughout, `last` and `samples` apart."""

    theta: Float[AnyArray, "*M p"]
    """Parameters, in the model's units."""
    stderr: Float[AnyArray, "*M p"]
    """Their standard errors."""
    dof: Float[AnyArray, "*M"]
    """Degrees of freedom of the standard errors (see `least_squares.confidence_interval`)."""
    cond: Float[AnyArray, "*M"]
    """Condition number of the window's W."""
    sigma_min: Float[AnyArray, "*M"]
    """Smallest singular value of the window's W."""
    excitation: Float[AnyArray, "*M p"]
    """Norm of each column's part that the other columns cannot imitate."""
    residual_rms: Float[AnyArray, "*M"]
    """Root of the mean squared residual [N m]."""
    vaf: Float[AnyArray, "*M"]
    """Variance accounted for, 1 - var(residual)/var(torque)."""
    samples: Int[AnyArray, "*M"]
    """Torque samples that counted."""
    last: Int[AnyArray, "*M"]
    """Index of each window's last sample."""


def window_starts(n_samples: int, window: int, step: int = 1) -> NDArray[np.int64]:
    """First sample of every window that fits into the recording."""
    for name, value in (("window", window), ("step", step)):
        if not isinstance(value, int | np.integer):
            raise ValueError(f"{name} is {value!r}: it must be a whole number of samples")
        if value <= 0:
            raise ValueError(f"{name} is {value}: it must be at least one sample")
    if window > n_samples:
        raise ValueError(f"the window has {window} samples, but there are only {n_samples}: shorten the window")
    return np.arange(0, n_samples - window + 1, step)


def sliding_least_squares(
    W: Num[AnyArray, "..."],
    y: Num[AnyArray, "..."],
    window: int,
    step: int = 1,
    *,
    valid: Shaped[AnyArray, "..."] | None = None,
    noise: Num[AnyArray, " L"] | Num[AnyArray, "S S"] | None = None,
    room: int | None = None,
) -> SlidingFit:
    """Fit `y = W @ theta` in every window of `window` samples, `step` samples apart.

    **Arguments:** `W` (N, p), or (N, n, p) for n outputs that share the parameters; `y` (N,) or (N, n) [N m];
    `valid` (N,) or (N, n), False for samples that must not count; `noise` the autocovariance by lag of the noise in y
    (`signals.autocovariance` of the filter it went through), or the covariance matrix of a window's rows.
    `room` compiles for windows of up to so many samples: lengths with the same `room` share their compiled code, which
    takes longer to make than a short recording takes to solve.

    **Returns:** a `SlidingFit`. Without `noise` the standard errors are the textbook ones, RSS/(S - p): after a
    low-pass filter they are several times too small.

    **Raises:** `ValueError` for shapes that disagree, a window that is longer than the recording or has fewer samples
    than parameters, and numbers that are not finite where `valid` does not exclude them.

    **Source:** Tout et al. 2023, III-B.
    """
    require_float64(W, y)
    W, y, valid = _checked(W, y, valid, window)
    starts = window_starts(len(W), window, step)
    n_windows = len(starts)
    noise = None if noise is None else jnp.asarray(noise, W.dtype)
    if n_windows * window * math.prod(W.shape[1:]) > FROM_CHUNKS:
        found = _in_chunks(W, y, valid, window, step, noise)
        if found is not None:
            return SlidingFit(**found._asdict(), last=starts + window - 1)
    if room is not None:
        starts = np.pad(starts, (0, len(W) // step + 1 - n_windows), mode="edge")
    fit = _solve_all(W, y, valid, noise, jnp.asarray(starts), window, room or window)
    return fit if room is None else _first_windows(fit, n_windows)


def sliding_theta(
    W: Num[AnyArray, "..."],
    y: Num[AnyArray, "..."],
    window: int,
    step: int = 1,
    *,
    valid: Shaped[AnyArray, "..."] | None = None,
) -> Float[AnyArray, "M p"]:
    """The estimates of `sliding_least_squares` alone, in a third of its time."""
    require_float64(W, y)
    W, y, valid = _checked(W, y, valid, window)
    if len(window_starts(len(W), window, step)) * window * math.prod(W.shape[1:]) > FROM_CHUNKS:
        found = _in_chunks(W, y, valid, window, step, statistics=False)
        if found is not None:
            return found.theta
    return sliding_least_squares(W, y, window, step, valid=valid).theta


def sliding_pieces(pieces: Iterable[tuple[AnyArray, ...]], window: int, step: int = 1) -> Iterator[SlidingFit]:
    """`sliding_least_squares` of a recording that does not fit into memory, part after part.

    **Arguments:** `pieces` (W, y) or (W, y, valid) of consecutive samples, as many or few at a time as there are, read
    when they are needed.

    **Returns:** an iterator over the estimates of consecutive windows: to the last bit those of the whole recording,
    where that has some ten thousand windows. `last` counts from the recording's beginning.

    **Raises:** `ValueError` as `sliding_least_squares`, when it comes to the piece in question.
    """
    window_starts(window, window, step)
    checked = (_checked(W, y, valid[0] if valid else None, window) for W, y, *valid in pieces)
    beginning = next(checked, None)
    if beginning is None:
        raise ValueError("there are no samples: give at least one piece")
    n_outputs, done = math.prod(beginning[1].shape[1:]), 0
    plan = make_plan(window * n_outputs, step * n_outputs, n_outputs, statistics=True)
    flat = (_as_piece(*piece) for piece in chain([beginning], checked))
    for found in solve_pieces(flat, plan, window * n_outputs):
        last = (done + np.arange(len(found.theta))) * step + window - 1
        yield SlidingFit(**found._asdict(), last=last)
        done += len(last)
    if not done:
        raise ValueError(f"the window has {window} samples, but there are fewer: shorten the window")


def _in_chunks(
    W: Array, y: Array, valid: Array, window: int, step: int, noise: Array | None = None, statistics: bool = True
) -> Estimated | None:
    """Many windows, from sums that they share; None where the noise does not allow that."""
    n, n_windows = math.prod(y.shape[1:]), (len(W) - window) // step + 1
    lags = lags_for_sums(noise, window * n, n)
    if lags is None:
        return None
    plan = make_plan(window * n, step * n, n, statistics, n_windows, lags)
    if any(isinstance(x, jax.core.Tracer) for x in (W, y, valid)) or jax.default_backend() != "cpu":
        return solve_traced(
            (W.reshape(-1, W.shape[-1]), y.ravel(), valid.ravel()),
            plan,
            window * n,
            None if noise is None else noise[:lags],
        )
    return solve_all(_as_piece(W, y, valid), plan, window * n, None if noise is None else np.asarray(noise)[:lags])


def _as_piece(W: Array, y: Array, valid: Array) -> Piece:
    return Piece(np.asarray(W).reshape(-1, W.shape[-1]), np.asarray(y).ravel(), np.asarray(valid).ravel())


def _first_windows(tree: Any, n_windows: int) -> Any:
    """Without the windows that were only there to share compiled code; slicing in numpy compiles nothing."""
    return jax.tree.map(lambda x: x[:n_windows] if isinstance(x, jax.core.Tracer) else np.asarray(x)[:n_windows], tree)


@partial(compiled, static_argnames="room")
def _solve_all(
    W: Array, y: Array, valid: Array, noise: Array | None, starts: Array, window: int | Array, room: int
) -> SlidingFit:
    W, y, valid = _with_room((W, y, valid), room)

    def one(start: Array) -> SlidingFit:
        rows, torque, counts = slice_window((W, y, valid), start, room)
        fit = least_squares(rows, torque, _first(counts, window), noise)
        return _as_sliding(fit, start + window - 1)

    return map_windows(one, starts, room * math.prod(W.shape[1:]))


def _with_room(arrays: tuple[Array, ...], room: int) -> tuple[Array, ...]:
    """Zeros (and False) behind the end, so that no window with room to spare is pushed back from it."""
    return tuple(jnp.concatenate([array, jnp.zeros((room, *array.shape[1:]), array.dtype)]) for array in arrays)


def _first(counts: Array, window: int | Array) -> Array:
    """Only the first `window` samples of a window with room for more count."""
    inside = jnp.arange(len(counts)) < window
    return counts & inside.reshape(-1, *(1,) * (counts.ndim - 1))


def map_windows(function: Callable[[Any], Any], starts: Any, numbers_per_window: int) -> Any:
    """Apply a function of a window's start to all windows, as many at a time as memory suggests."""
    n_windows = len(jax.tree.leaves(starts)[0])
    n_batch = max(1, min(256, n_windows, BATCH_NUMBERS // numbers_per_window))
    # Whole batches only: a remainder would be compiled a second time.
    full = jax.tree.map(lambda x: jnp.concatenate([x, jnp.repeat(x[-1:], -n_windows % n_batch, axis=0)]), starts)
    return jax.tree.map(lambda x: x[:n_windows], jax.lax.map(function, full, batch_size=n_batch))


def slice_window(arrays: tuple[Array, ...], start: Array, window: int) -> tuple[Array, ...]:
    """The `window` samples of every array from `start` on."""
    return tuple(jax.lax.dynamic_slice_in_dim(array, start, window) for array in arrays)


def _as_sliding(fit: WindowFit, last: Array) -> SlidingFit:
    """A window's fit without its covariance matrix, which would fill the memory."""
    shared = {name: getattr(fit, name) for name in SlidingFit.__annotations__ if name not in ("last", "stderr")}
    return SlidingFit(stderr=fit.stderr, last=last, **shared)


class Score(eqx.Module):
    """How well parameters explain the torque of one window each, whether they have seen it or not."""

    vaf: Float[Array, "*M"]
    """Variance accounted for; NaN where less than a whole window is there or fewer than half its samples are valid."""
    residual_rms: Float[Array, "*M"]
    """Root of the mean squared residual [N m]."""
    samples: Int[Array, "*M"]
    """Torque samples that counted."""


def score(
    W: Num[AnyArray, "N *n p"],
    y: Num[AnyArray, "N *n"],
    valid: Shaped[AnyArray, "N *n"],
    theta: Num[AnyArray, "M p"],
    start: Integer[AnyArray, " M"],
    window: int,
    step: int,
    room: int | None = None,
) -> Score:
    """Hold parameters against a window of torque.

    **Arguments:** `start` (M,) where the window begins that each `theta` is held against; `window`, `step` and `room`
    as in `sliding_least_squares`.
    """
    n_windows = len(start)
    if room is not None:
        spare = (0, len(W) // step + 1 - n_windows)
        theta, start = np.pad(theta, (spare, (0, 0)), mode="edge"), np.pad(start, spare, mode="edge")
    scored = _score_all(W, y, valid, jnp.asarray(theta), jnp.asarray(start), window, room or window)
    return scored if room is None else _first_windows(scored, n_windows)


@partial(compiled, static_argnames="room")
def _score_all(W: Array, y: Array, valid: Array, theta: Array, start: Array, window: int | Array, room: int) -> Score:
    def one(theta_and_start: tuple[Array, Array]) -> Score:
        parameters, first = theta_and_start
        rows, torque, counts = slice_window(padded, first, room)
        weight = _first(counts, window).astype(rows.dtype)
        residual = jnp.where(weight > 0, torque - rows @ parameters, 0)
        n = weight.sum()
        complete = (first + window <= len(W)) & (n >= 0.5 * window * math.prod(y.shape[1:]))
        vaf = jnp.where(complete, variance_accounted_for(torque, residual, weight), jnp.nan)
        return Score(vaf, jnp.sqrt((residual**2).sum() / n), n.astype(int))

    padded = _with_room((W, y, valid), room)
    return map_windows(one, (theta, start), room * math.prod(W.shape[1:]))


def _checked(W: AnyArray, y: AnyArray, valid: AnyArray | None, window: int) -> tuple[Array, Array, Array]:
    """Arrays of floating point numbers with shapes that agree, or an error that names what does not."""
    W, y = (jnp.asarray(array) for array in (W, y))
    W, y = (array if jnp.issubdtype(array.dtype, jnp.floating) else array.astype(float) for array in (W, y))
    if W.ndim not in (2, 3) or y.shape != W.shape[:-1]:
        raise ValueError(f"W has shape {W.shape} and y {y.shape}: expected (N, p) and (N,), or (N, n, p) and (N, n)")
    if valid is None:
        valid = jnp.ones(y.shape, bool)
    else:
        valid = jnp.asarray(valid, bool)
        if valid.shape not in (y.shape, y.shape[:1]):
            raise ValueError(f"valid has shape {valid.shape}: expected {y.shape} or {y.shape[:1]}")
        valid = jnp.broadcast_to(valid.reshape(valid.shape + (1,) * (y.ndim - valid.ndim)), y.shape)
    if isinstance(window, int | np.integer) and 0 < window * math.prod(y.shape[1:]) < W.shape[-1]:
        raise ValueError(f"a window of {window} samples cannot determine {W.shape[-1]} parameters: lengthen the window")
    check_finite(W, y, valid)
    return W, y, valid
