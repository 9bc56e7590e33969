"""Least squares over all sliding windows at once."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields
from functools import partial
from itertools import chain
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Integer, Num, Shaped
from numpy.typing import NDArray

from jaximp.least_squares.chunks import (
    Piece,
    Task,
    lags_for_sums,
    make_adaptive_task,
    make_task,
    solve_all,
    solve_pieces,
    solve_traced,
)
from jaximp.least_squares.wide import pays, solve_wide
from jaximp.least_squares.window import (
    Fit,
    SlidingFit,
    check_finite,
    root_of_weights,
    scatter,
    solve_window,
    squares_left,
    variance_accounted_for,
)
from jaximp.numerics.compilation import compiled, is_traced, require_numbers
from jaximp.numerics.precision import require_float64
from jaximp.types import AnyArray

BATCH_NUMBERS = 4_000_000
"""How many numbers of W are gathered at a time (32 MB): windows overlap, so that all together would not fit."""


FROM_CHUNKS = 200_000_000
"""So many numbers in all windows together, and sums that windows share are worth the time they take to compile."""


ALIKE = 64
"""Windows that are decomposed one by one are filled up to multiples of this many."""


FEWEST_ROWS = 4
"""For each parameter: from fewer a piece of the recording tells little of the noise."""


CHANGES = 4.0
"""How many times the median of its neighbours a piece's variance must be to tell nothing of the noise."""


def window_starts(n_samples: int, window: int, step: int = 1) -> NDArray[np.int64]:
    """First sample of every window that fits into the recording."""
    for name, value in (("window", window), ("step", step)):
        if not isinstance(value, int | np.integer):
            raise ValueError(
                f"{name} is {value!r}: it must be a whole number of samples; pass sample_rate to give it in seconds"
            )
        if value <= 0:
            raise ValueError(f"{name} is {value}: it must be at least one sample")
    if window > n_samples:
        raise ValueError(f"the window has {window} samples, but there are only {n_samples}: shorten the window")
    return np.arange(0, n_samples - window + 1, step)


def sliding_least_squares(
    W: Num[AnyArray, "..."],
    y: Num[AnyArray, "..."],
    window: float,
    step: float | None = None,
    *,
    sample_rate: float | None = None,
    valid: Shaped[AnyArray, "..."] | None = None,
    weights: Num[AnyArray, "..."] | None = None,
    noise: Num[AnyArray, " L"] | Num[AnyArray, "S S"] | None = None,
    room: int | None = None,
) -> SlidingFit:
    """Fit `y = W @ theta` in every window of `window` samples, `step` samples apart.

    **Arguments:** `W` (N, p), or (N, n, p) for n outputs that share the parameters; `y` (N,) or (N, n) [N m];
    `window` and `step` in seconds where a `sample_rate` [Hz] is given, else in samples; by default every window.
    `valid` (N,) or (N, n), False for samples that must not count; `weights` (N,) or (N, n) of the squared residuals, in
    inverse proportion to the noise's variance; `noise` the autocovariance by lag of the noise in y
    (`signals.autocovariance` of the filter it went through), or the covariance matrix of a window's rows.
    `room` compiles for windows of up to so many samples: lengths with the same `room` share their compiled code, which
    takes longer to make than a short recording takes to solve.

    **Returns:** a `SlidingFit`. Without `noise` the standard errors are the textbook ones, RSS/(S - p): after a
    low-pass filter they are several times too small.

    **Raises:** `ValueError` for shapes that disagree, a window that is longer than the recording or has fewer samples
    than parameters, and numbers that are not finite where `valid` does not exclude them.

    **Source:** Tout et al. 2023, III-B.

    **Example:**

    ```pycon
    >>> t = np.arange(0, 4, 0.01)
    >>> W = np.column_stack([np.cos(9 * t), np.sin(5 * t)])
    >>> noise = 0.1 * np.random.default_rng(0).normal(size=len(t))
    >>> y = W[:, 0] + np.where(t < 2, 20, 30) * W[:, 1] + noise
    >>> fit = jaximp.sliding_least_squares(W, y, window=1.0, step=1.0, sample_rate=100)
    >>> print(fit.theta.shape, fit.last, fit.theta[:, 1].round(0))
    (4, 2) [ 99 199 299 399] [20. 20. 30. 30.]

    ```
    """
    given = _given(W, y, window, step, sample_rate, valid, weights)
    known: Any = noise if noise is None or is_traced(noise) else np.asarray(noise, given.W.dtype)
    found = _many_columns(given, known, room) or _in_chunks(given, known)
    if found is not None:
        return found
    starts, n_windows = given.starts, len(given.starts)
    if room is not None:
        starts = np.pad(starts, (0, len(given.W) // given.step + 1 - n_windows), mode="edge")
    fit = _solve_all(*given[:3], known, jnp.asarray(starts), given.window, room or given.window)
    return fit if room is None else _first_windows(fit, n_windows)


def sliding_theta(
    W: Num[AnyArray, "..."],
    y: Num[AnyArray, "..."],
    window: float,
    step: float | None = None,
    *,
    sample_rate: float | None = None,
    valid: Shaped[AnyArray, "..."] | None = None,
    weights: Num[AnyArray, "..."] | None = None,
) -> Float[AnyArray, "M p"]:
    """The estimates of `sliding_least_squares` alone, in a third of its time."""
    given = _given(W, y, window, step, sample_rate, valid, weights)
    found = _in_chunks(given, statistics=False)
    if found is not None:
        return found
    return _solve_all(*given[:3], None, jnp.asarray(given.starts), given.window, given.window).theta


def sliding_pieces(
    pieces: Iterable[tuple[AnyArray, ...]],
    window: float,
    step: float | None = None,
    *,
    sample_rate: float | None = None,
    noise: Num[AnyArray, " L"] | None = None,
) -> Iterator[SlidingFit]:
    """`sliding_least_squares` of a recording that does not fit into memory, part after part.

    **Arguments:** `pieces` (W, y) or (W, y, valid) of consecutive samples, as many or few at a time as there are, read
    when they are needed; `window`, `step`, `sample_rate` and `noise` as there.

    **Returns:** an iterator over the estimates of consecutive windows: to the last bit those of the whole recording,
    where that has some ten thousand windows. `first` and `last` count from the recording's beginning.

    **Raises:** `ValueError` as `sliding_least_squares`, when it comes to the piece in question.

    **Example:**

    ```pycon
    >>> t = np.arange(0, 4, 0.01)
    >>> W = np.column_stack([np.cos(9 * t), np.sin(5 * t)])
    >>> noise = 0.1 * np.random.default_rng(0).normal(size=len(t))
    >>> pieces = zip(np.split(W, 4), np.split(W @ [1, 20] + noise, 4))
    >>> for part in jaximp.sliding_pieces(pieces, window=1.0, step=1.0, sample_rate=100):
    ...     print(part.theta[:, 1].round(0))
    ...
    [20. 20. 20. 20.]

    ```
    """
    window, step = in_samples("window", window, sample_rate), in_samples("step", step, sample_rate)
    window_starts(window, window, step)
    checked = (_checked_piece(window, *piece) for piece in pieces)
    beginning = next(checked, None)
    if beginning is None:
        raise ValueError("there are no samples: give at least one piece")
    n, done = math.prod(beginning[1].shape[1:]), 0
    task = make_task(window * n, step * n, n, _noise_in_sums(noise, window, n, "sliding_least_squares"))
    for found in solve_pieces((_as_piece(*piece) for piece in chain([beginning], checked)), task):
        yield found
        done += len(found.theta)
    if not done:
        raise ValueError(f"the window has {window} samples, but there are fewer: shorten the window")


def adaptive_least_squares(
    W: Num[AnyArray, "..."],
    y: Num[AnyArray, "..."],
    stderr: Num[AnyArray, " p"],
    shortest: float,
    longest: float,
    *,
    cond: float | AnyArray = np.inf,
    step: float | None = None,
    sample_rate: float | None = None,
    valid: Shaped[AnyArray, "..."] | None = None,
    weights: Num[AnyArray, "..."] | None = None,
    noise: Num[AnyArray, " L"] | None = None,
) -> SlidingFit:
    """Fit, up to every instant, the shortest window that is sure enough: short in good motion, long in poor.

    **Arguments:** `W`, `y`, `sample_rate`, `valid`, `weights` and `noise` as in `sliding_least_squares`; `stderr` (p,)
    the largest standard errors, infinite where one does not care, and `cond` the largest condition number that a window
    may have; `shortest` and `longest` length of a window, and `step` from one instant to the next (by default a
    twentieth of the shortest), in seconds where a `sample_rate` [Hz] is given, else in samples. Lengths are multiples
    of the step, and rise by a twentieth or one step.

    **Returns:** a `SlidingFit` whose windows end `step` apart and differ in `first`; NaN where none of them is sure
    enough. A window is as long as its motion and the noise around it demand; its own residuals have no say, as the
    first window that they make look sure is one whose residuals happen to be small, and its interval too narrow. So
    `stderr` is met in the mean, and a single window's may lie above it. Where it does by more than chance would have it
    (three standard deviations) the window is not taken: a change of the joint within a window spoils the fit, so that a
    window rarely reaches back across one.

    **Raises:** `ValueError` as `sliding_least_squares`, and for noise that is correlated over too many samples.

    **Source:** named as future work by Tout et al. 2023, VI.

    **Example:**

    ```pycon
    >>> t = np.arange(0, 4, 0.01)
    >>> W = np.column_stack([np.cos(9 * t), np.sin(5 * t)])
    >>> noise = 0.1 * np.random.default_rng(0).normal(size=len(t))
    >>> y, stderr = W @ [1, 20] + noise, np.array([0.05, 0.05])
    >>> fit = jaximp.adaptive_least_squares(W, y, stderr, shortest=0.2, longest=2.0, sample_rate=100)
    >>> print(fit.theta[-1].round(0))
    [ 1. 20.]

    ```
    """
    require_float64(W, y)
    shortest, longest = (in_samples(*x, sample_rate) for x in (("shortest", shortest), ("longest", longest)))
    step = max(1, shortest // 20) if step is None else in_samples("step", step, sample_rate)
    W, y, scale = _checked(W, y, valid, weights, shortest)
    window_starts(len(W), shortest, step)
    if longest < shortest:
        raise ValueError(f"longest is {longest} samples and shortest {shortest}: lengthen the longest window")
    stderr, cond = (x if is_traced(x) else np.asarray(x, W.dtype) for x in (stderr, cond))
    shape, p = np.shape(stderr), W.shape[-1]
    if shape != (p,) or not (is_traced(stderr) or (stderr > 0).all()):
        raise ValueError(f"stderr has shape {shape}: give {p} numbers above zero, one per parameter")
    n, few, most = math.prod(y.shape[1:]), -(-shortest // step), -(-longest // step)
    count = 1 + math.ceil(math.log(most / few) / math.log(1.05))
    lengths = np.unique(np.geomspace(few, most, count).round().astype(int))
    noise = _noise_in_sums(noise, shortest, n, "a fixed window")
    piece = min(len(W), max(few * step, -(-FEWEST_ROWS * p // n)))
    level = _noise_level(W, y, scale, noise, jnp.arange(len(W) // step), piece, most * step, step)
    task = make_adaptive_task(lengths, step * n, n, (stderr, cond, _numbers(level)), noise, scale.dtype != bool)
    return jax.tree.map(lambda x: x[few - 1 :], _from_shared_sums(W, y, scale, task))


@partial(compiled, static_argnames=("piece", "around", "step"))
def _noise_level(
    W: Array, y: Array, scale: Array, noise: AnyArray | None, ends: Array, piece: int, around: int, step: int
) -> Array:
    """Variance of the noise up to `around` samples before and after the end of every step, in units of `noise`.

    From pieces of the recording with parameters of their own, as a change of the joint is no noise.
    """
    known = None if noise is None else jnp.asarray(noise)

    def one(start: Array) -> tuple[Array, Array]:
        rows, torque, counts = slice_window((W, y, scale), start, piece)
        return squares_left(rows, torque, counts, known)

    starts = jnp.arange(0, len(W) - piece + 1, piece)
    squares, expected = map_windows(one, starts, piece * math.prod(W.shape[1:]))
    near = -(-around // piece)
    some = jnp.arange(len(starts))[:, None] + np.arange(-near, near + 1)
    inside = (some >= 0) & (some < len(starts))
    squares, expected = (jnp.where(inside, x[some % len(starts)], 0) for x in (squares, expected))
    variance = jnp.where(expected > 0, squares / jnp.where(expected > 0, expected, 1), jnp.nan)
    # A piece in which the joint changes stands out.
    usual = variance <= CHANGES * jnp.nanmedian(variance, axis=1, keepdims=True)
    squares, expected = (jnp.where(usual, x, 0).sum(axis=1) for x in (squares, expected))
    level = jnp.where(expected > 0, squares / jnp.where(expected > 0, expected, 1), jnp.inf)
    return level[jnp.minimum(((ends + 1) * step - 1) // piece, len(starts) - 1)]


def _numbers(x: Array) -> Any:
    """In numpy's memory, outside of compiled programs."""
    return x if is_traced(x) else np.asarray(x)


def in_samples(name: str, value: float | None, sample_rate: float | None) -> int:
    """A length as a whole number of samples; none is one sample."""
    if value is None:
        return 1
    if sample_rate is None:
        return value  # type: ignore[return-value]  # `window_starts` refuses what is no whole number
    if not 0.5 < value * sample_rate < np.inf:
        raise ValueError(f"{name} is {value:g} s, less than one sample at {sample_rate:g} Hz: give seconds, and hertz")
    return round(value * sample_rate)


def _noise_in_sums(noise: AnyArray | None, window: int, outputs: int, instead: str) -> NDArray[Any] | None:
    """The lags of the noise's autocovariance that count, where only the shared sums can serve."""
    require_numbers("noise", "its lags decide what is compiled, so pass it as a constant", noise)
    lags = lags_for_sums(None if noise is None else np.asarray(noise), window * outputs, outputs)
    if lags is None:
        raise ValueError(
            "this noise is correlated over too many samples of such a window: decimate the rows, or use " + instead
        )
    return None if noise is None else np.asarray(noise)[:lags]


class _Given(NamedTuple):
    """What all kinds of sliding windows are asked for, checked."""

    W: Array
    y: Array
    scale: Array
    window: int
    step: int
    starts: NDArray[np.int64]


def _given(
    W: AnyArray,
    y: AnyArray,
    window: float,
    step: float | None,
    sample_rate: float | None,
    valid: AnyArray | None,
    weights: AnyArray | None,
) -> _Given:
    require_float64(W, y)
    window, step = in_samples("window", window, sample_rate), in_samples("step", step, sample_rate)
    arrays = _checked(W, y, valid, weights, window)
    return _Given(*arrays, window, step, window_starts(len(arrays[0]), window, step))


def _in_chunks(given: _Given, noise: AnyArray | None = None, statistics: bool = True) -> Any:
    """Many windows, from sums that they share; None where they are few, or the noise does not allow that."""
    W, y, scale, window, step, starts = given
    n, n_windows = math.prod(y.shape[1:]), len(starts)
    if n_windows * window * math.prod(W.shape[1:]) <= FROM_CHUNKS:
        return None
    lags = lags_for_sums(noise, window * n, n)
    if lags is None:
        return None
    noise = None if noise is None else noise[:lags]
    weighted = scale.dtype != bool
    task = make_task(window * n, step * n, n, noise, statistics, weighted, n_windows)
    return _from_shared_sums(W, y, scale, task)


def _many_columns(given: _Given, noise: AnyArray | None, room: int | None) -> SlidingFit | None:
    """Windows of many columns, without anything that takes long to compile; None where that is not how to solve them.

    Windows that the sums do not suit are decomposed one by one.
    """
    W, y, scale, window, _, starts = given
    p, n = W.shape[-1], math.prod(y.shape[1:])
    known = not is_traced(W, y, scale, noise) and noise is None and jax.default_backend() == "cpu"
    if not known or W.dtype != np.float64 or not pays(len(starts), p, n):
        return None
    arrays = np.asarray(W).reshape(-1, n, p), np.asarray(y).reshape(-1, n), np.asarray(scale).reshape(-1, n)
    fit, doubtful = solve_wide(*arrays, window, starts)
    which = np.flatnonzero(doubtful)
    if len(which):
        some = np.pad(starts[which], (0, -len(which) % ALIKE), mode="edge")  # few sizes share compiled code
        exact = _solve_all(W, y, scale, None, jnp.asarray(some), window, room or window)
        for whole, part in zip(jax.tree.leaves(fit), jax.tree.leaves(exact), strict=True):
            whole[which] = np.asarray(part)[: len(which)]
    return fit


def _from_shared_sums(W: Array, y: Array, scale: Array, task: Task) -> Any:
    """All windows of a task, on all cores in numpy's memory, or inside somebody's compiled program."""
    if is_traced(W, y, scale, task.wanted) or jax.default_backend() != "cpu":
        return solve_traced(_rows(W, y, scale), task)
    return solve_all(_as_piece(W, y, scale), task)


def _rows(W: AnyArray, y: AnyArray, scale: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
    """The rows of several outputs in turn."""
    return W.reshape(-1, W.shape[-1]), y.ravel(), scale.ravel()


def _as_piece(W: Array, y: Array, scale: Array) -> Piece:
    return Piece(*_rows(np.asarray(W), np.asarray(y), np.asarray(scale)))


def _first_windows(tree: Any, n_windows: int) -> Any:
    """Without the windows that were only there to share compiled code; slicing in numpy compiles nothing."""
    return jax.tree.map(lambda x: x[:n_windows] if is_traced(x) else np.asarray(x)[:n_windows], tree)


@partial(compiled, static_argnames="room")
def _solve_all(
    W: Array, y: Array, scale: Array, noise: Array | None, starts: Array, window: int | Array, room: int
) -> SlidingFit:
    W, y, scale = _with_room((W, y, scale), room)

    def one(start: Array) -> SlidingFit:
        rows, torque, counts = slice_window((W, y, scale), start, room)
        fit = solve_window(rows, torque, _first(counts, window), noise)
        each = {field.name: getattr(fit, field.name) for field in fields(Fit)}
        return SlidingFit(**each, first=start, last=start + window - 1)  # a covariance each would fill the memory

    return map_windows(one, starts, room * math.prod(W.shape[1:]))


def _with_room(arrays: tuple[Array, ...], room: int) -> tuple[Array, ...]:
    """Zeros (and False) behind the end, so that no window with room to spare is pushed back from it."""
    return tuple(jnp.concatenate([array, jnp.zeros((room, *array.shape[1:]), array.dtype)]) for array in arrays)


def _first(counts: Array, window: int | Array) -> Array:
    """Only the first `window` samples of a window with room for more count."""
    inside = jnp.arange(len(counts)) < window
    return jnp.where(inside.reshape(-1, *(1,) * (counts.ndim - 1)), counts, 0)


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


class Score(eqx.Module):
    """How well parameters explain the torque of one window each, whether they have seen it or not."""

    vaf: Float[AnyArray, "*M"]
    """Variance accounted for; NaN where less than a whole window is there or fewer than half its samples are valid."""
    residual_rms: Float[AnyArray, "*M"]
    """Root of the mean squared residual [N m]."""
    samples: Int[AnyArray, "*M"]
    """Torque samples that counted."""
    variance: Float[AnyArray, "*M"]
    """Of the torque [N^2 m^2]."""


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
        rms = jnp.sqrt((residual**2).sum() / n)
        return Score(vaf, rms, n.astype(int), scatter(torque, weight) / jnp.maximum(n, 1))

    padded = _with_room((W, y, valid), room)
    return map_windows(one, (theta, start), room * math.prod(W.shape[1:]))


def _checked_piece(window: int, W: AnyArray, y: AnyArray, valid: AnyArray | None = None) -> tuple[Array, Array, Array]:
    require_numbers("sliding_pieces", "pass the whole recording to sliding_least_squares", W, y, valid)
    return _checked(W, y, valid, None, window)


def _checked(
    W: AnyArray, y: AnyArray, valid: AnyArray | None, weights: AnyArray | None, window: int
) -> tuple[Array, Array, Array]:
    """Arrays of floating point numbers with shapes that agree, or an error that names what does not.

    The third says what an equation is multiplied by: False where it does not count, or the root of its weight.
    """
    W, y = (jnp.asarray(array) for array in (W, y))
    W, y = (array if jnp.issubdtype(array.dtype, jnp.floating) else array.astype(float) for array in (W, y))
    if W.ndim not in (2, 3) or y.shape != W.shape[:-1]:
        raise ValueError(f"W has shape {W.shape} and y {y.shape}: expected (N, p) and (N,), or (N, n, p) and (N, n)")

    def like_y(name: str, x: Array) -> Array:
        if x.shape not in (y.shape, y.shape[:1]):
            raise ValueError(f"{name} has shape {x.shape}: expected {y.shape} or {y.shape[:1]}")
        return jnp.broadcast_to(x.reshape(x.shape + (1,) * (y.ndim - x.ndim)), y.shape)

    scale = jnp.ones(y.shape, bool) if valid is None else like_y("valid", jnp.asarray(valid, bool))
    if isinstance(window, int | np.integer) and 0 < window * math.prod(y.shape[1:]) < W.shape[-1]:
        raise ValueError(f"a window of {window} samples cannot determine {W.shape[-1]} parameters: lengthen the window")
    check_finite(W, y, scale)
    if weights is not None:
        weights = like_y("weights", jnp.asarray(weights, W.dtype))
        if not is_traced(weights, scale) and not bool((jnp.isfinite(weights) & (weights >= 0))[scale].all()):
            raise ValueError("weights must be finite and not negative: give zero to a sample that is not to count")
        scale = root_of_weights(weights, scale)
    return W, y, scale
