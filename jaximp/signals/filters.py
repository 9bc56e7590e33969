"""Butterworth filters forward and backward: of a whole signal, of one with padding, inside every window.

scipy designs the filters. Applying them is written here in JAX, with scipy's edge treatment, differentiable and
vmappable. What many windows of one recording share (`CutSignal`) is worked out in numpy. Time is axis 0.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Integer, Num
from numpy.typing import NDArray

from jaximp.numerics.precision import require_float64
from jaximp.types import AnyArray

Sections = NDArray[np.float64] | tuple[tuple[float, ...], ...]
"""Second-order sections (k, 6): an array, or plain numbers by which compiled code can be found again."""
BLOCK = 64
"""Samples that a filter takes in one product."""
DECIMATED = 160
"""Samples of which one product makes what is kept of them, about."""
SLOW = 5.0
"""Sample rate at which nobody records a motion [Hz]: milliseconds that were read as seconds."""


def butterworth(order: int, cutoff: float, sample_rate: float, kind: str = "lowpass") -> NDArray[np.float64]:
    """Second-order sections (k, 6) of a Butterworth filter of `order` with `cutoff` [Hz]; `lowpass` or `highpass`.

    Applied forward and backward (`filter_zero_phase`) its amplitude at the cut-off is 1/2.
    """
    from scipy.signal import butter

    if not (isinstance(order, int | np.integer) and order > 0):
        raise ValueError(f"the filter's order is {order}: it must be a whole number above zero")
    if not 0 < cutoff < sample_rate / 2:
        slow = "; is the time in ms? Then give its unit" if sample_rate <= SLOW else ""
        raise ValueError(
            f"the {kind} cut-off of {cutoff:g} Hz must lie between 0 and {sample_rate / 2:g} Hz, half the sample rate"
            + slow
        )
    return np.asarray(butter(order, cutoff, kind, fs=sample_rate, output="sos"))


def filter_zero_phase(sos: Sections, x: Num[AnyArray, "N *k"]) -> Float[Array, "N *k"]:
    """Run the sections forward and backward over axis 0, with an odd extension at both ends.

    The same numbers as `scipy.signal.sosfiltfilt(sos, x, axis=0)`.

    **Raises:** `ValueError` if there are too few samples for the extension.
    """
    require_float64(x)
    x, sos = _floating(x), np.asarray(sos, np.float64)
    edge = _edge_within(sos, x.shape[0])
    by = padded_filter(tuple(map(tuple, sos.tolist())))
    return _both_ways(jnp.asarray(by.sos, x.dtype), jnp.asarray(by.rest, x.dtype), x, edge)


def filter_zero_phase_padded(
    filters: PaddedFilter, x: Num[AnyArray, "N k"], n: Int[AnyArray, ""]
) -> Float[Array, "N k"]:
    """`filter_zero_phase` of the first n samples; what stands behind them means nothing, before and after.

    The extension is made at the true end, and the pass backward begins there: the numbers do not depend on how many
    samples follow, to the last bit.
    """
    edge, rows = filters.edge, x.shape[0] + filters.edge
    start = 2 * x[:1] - x[edge:0:-1]
    behind = jnp.concatenate([x, jnp.zeros((edge, x.shape[1]), x.dtype)])
    end = lax.dynamic_slice_in_dim(behind, n - 1 - edge, edge + 1)
    end = lax.dynamic_update_slice_in_dim(behind, 2 * end[-1:] - end[-2::-1], n, 0)

    def reversed_from_end(y: Array) -> Array:
        """The first n + edge samples in reverse order, and something behind them; its own inverse."""
        turned = jnp.concatenate([y[::-1], jnp.zeros_like(y)])
        return lax.dynamic_slice_in_dim(turned, rows - n - edge, rows)

    y = _filter(filters.sos, filters.rest, jnp.concatenate([start, end]), backward=False)[edge:]
    y = _filter(filters.sos, filters.rest, reversed_from_end(y), backward=False)
    return reversed_from_end(y)[:-edge]


def filter_zero_phase_decimated(sos: Sections, x: Num[AnyArray, "k N"], every: int) -> Float[AnyArray, "k M"]:
    """Every so many samples of `filter_zero_phase` of signals with time on axis 1, by numpy.

    What stands between them is worked out nowhere: a block of samples makes, by one matrix, what is kept of it and
    what it leaves in the filter, forward and backward.

    **Raises:** `ValueError` if there are too few samples for the extension.
    """
    from scipy.signal import sosfilt

    sections = np.asarray(sos, np.float64)
    sos = tuple(map(tuple, sections.tolist()))
    rest = padded_filter(sos).rest
    edge = _edge_within(sections, x.shape[1])
    start, end = 2 * x[:, :1] - x[:, edge:0:-1], 2 * x[:, -1:] - x[:, -2 : -edge - 2 : -1]
    by = _decimation(sos, every)
    blocks = x.shape[1] // by.size
    tail = np.concatenate([x[:, blocks * by.size :], end], axis=1)

    def at_rest(first: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.multiply.outer(rest, first).swapaxes(1, 2)

    m, states = by.after.shape[0], sosfilt(sections, start, zi=at_rest(start[:, 0]))[1]
    of_blocks = (x[:, : blocks * by.size].reshape(len(x), blocks, by.size) @ by.of_samples).swapaxes(0, 1)
    states, forward = states.swapaxes(0, 1).reshape(-1, m), np.empty((blocks, len(x), m))
    for k in range(blocks):
        forward[k], states = states, states @ by.after + of_blocks[k, :, :m]
    of_blocks[..., m:] += forward @ by.of_forward
    states = states.reshape(-1, len(sections), 2).swapaxes(0, 1)
    tail = sosfilt(sections, tail, zi=states)[0][:, ::-1]
    tail, states = sosfilt(sections, tail, zi=at_rest(tail[:, 0]))
    states, backward = states.swapaxes(0, 1).reshape(-1, m), np.empty((blocks, len(x), m))
    for k in range(blocks)[::-1]:
        backward[k], states = states, states @ by.after + of_blocks[k, :, m : 2 * m]
    kept = (of_blocks[..., 2 * m :] + backward @ by.of_backward).swapaxes(0, 1).reshape(len(x), -1)
    return np.concatenate([kept, tail[:, : edge - 1 : -1][:, ::every]], axis=1)


class _Decimation(NamedTuple):
    """Matrices of a filter with m states that runs over blocks of `size` samples, forward and then backward."""

    size: int
    of_samples: NDArray[np.float64]
    """(size, m + m + kept) what the samples of a block leave in the states, forward and backward, and in what is kept
    of the block."""
    of_forward: NDArray[np.float64]
    """(m, m + kept) what the states before a block leave in those of the way back, and in what is kept."""
    of_backward: NDArray[np.float64]
    """(m, kept) what the states behind a block leave in what is kept."""
    after: NDArray[np.float64]
    """(m, m) what becomes of states over a block."""


@lru_cache(maxsize=64)
def _decimation(sos: tuple[tuple[float, ...], ...], every: int) -> _Decimation:
    from scipy.signal import sosfilt

    sections = np.asarray(sos, np.float64)
    size, m = every * max(1, DECIMATED // every), 2 * len(sections)

    def run(x: NDArray[np.float64], states: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        y, left = sosfilt(sections, x, zi=states.reshape(len(x), -1, 2).swapaxes(0, 1))
        return y, left.swapaxes(0, 1).reshape(len(x), m)

    samples, states = run(np.eye(size), np.zeros((size, m)))
    decay, after = run(np.zeros((m, size)), np.eye(m))
    places = np.arange(size - 1, -1, -every)  # of what is kept, on the way back
    leaves = np.concatenate([states, samples[:, places]], axis=1)
    return _Decimation(
        size,
        np.concatenate([states, samples[:, ::-1] @ leaves], axis=1),
        decay[:, ::-1] @ leaves,
        decay[:, places],
        after,
    )


class PaddedFilter(eqx.Module):
    """Second-order sections as arrays: recordings of other rates share the compiled code."""

    sos: Float[AnyArray, "*B k 6"]
    rest: Float[AnyArray, "*B k 2"]
    """State of a unit input that lasts for ever."""
    edge: int = eqx.field(static=True)
    """Samples of the extension."""


@lru_cache(maxsize=256)
def padded_filter(sos: tuple[tuple[float, ...], ...]) -> PaddedFilter:
    """The arrays of `filter_zero_phase_padded`."""
    from scipy.signal import sosfilt_zi

    sections = np.asarray(sos, np.float64)
    return PaddedFilter(sections, np.asarray(sosfilt_zi(sections)), edge_samples(sections))


def check_long_enough(sos: Sections, n: int) -> None:
    """Refuse a recording of n samples that is too short for the extension."""
    _edge_within(np.asarray(sos, np.float64), n)


def filter_from_zero(sos: Sections, x: Num[AnyArray, "N *k"]) -> Float[Array, "N *k"]:
    """Run the sections forward over axis 0, as if all had been zero before: `scipy.signal.sosfilt(sos, x, axis=0)`."""
    require_float64(x)
    x, sections = _floating(x), jnp.asarray(sos)
    return _filter(sections, jnp.zeros((len(sections), 2), x.dtype), x, backward=False)


def _floating(x: AnyArray) -> Array:
    x = jnp.asarray(x)
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(float)


def edge_samples(sos: NDArray[np.float64]) -> int:
    """How many samples scipy extends a signal by at each end."""
    taps = 2 * len(sos) + 1 - min(int((sos[:, 2] == 0).sum()), int((sos[:, 5] == 0).sum()))
    return 3 * taps


def _edge_within(sos: NDArray[np.float64], n: int) -> int:
    """`edge_samples`, of which n samples must be able to make an extension."""
    edge = edge_samples(sos)
    if n <= edge:
        raise ValueError(
            f"{n} samples are too few for this filter, which needs more than {edge}: "
            "use a longer window or recording, or a lower order"
        )
    return edge


@partial(jax.jit, static_argnames="edge")
def _both_ways(sos: Array, rest: Array, x: Array, edge: int) -> Array:
    """Each pass starts as if the sample it meets first had lasted for ever."""
    start, end = 2 * x[:1] - x[edge:0:-1], 2 * x[-1:] - x[-2 : -edge - 2 : -1]
    y = _filter(sos, rest, jnp.concatenate([start, x, end]), backward=False)
    return _filter(sos, rest, y, backward=True)[edge:-edge]


@partial(jax.jit, static_argnames="backward")
def _filter(sos: Array, rest: Array, x: Array, backward: bool) -> Array:
    """One pass over axis 0; `rest` (k, 2) is the state of a unit input that lasts for ever.

    A cascade of recursions is linear in its input and in its state. So `BLOCK` samples are a product with one matrix,
    and only the states from block to block are a recursion: short enough to cost next to nothing.

    The coefficients are arguments, so that filters with the same number of sections share their compiled code.
    """
    n, signals = len(x), (x[::-1] if backward else x).reshape(len(x), -1).T
    size = min(BLOCK, n)
    blocks = jnp.pad(signals, ((0, 0), (0, -n % size))).reshape(len(signals), -1, size)
    of_impulse, of_states, states, after = _responses(sos, size)
    lag = jnp.arange(size) - jnp.arange(size)[:, None]
    within = jnp.where(lag >= 0, of_impulse[lag], 0)  # (from, to) inside a block
    entering = _product(blocks, states[::-1])

    def to_next(state: Array, added: Array) -> tuple[Array, Array]:
        return _product(state, after) + added, state

    first = signals[:, :1] * rest.reshape(-1)
    before = lax.scan(to_next, first, jnp.moveaxis(entering, 1, 0))[1]
    y = _product(blocks, within) + _product(jnp.moveaxis(before, 0, 1), of_states)
    y = y.reshape(len(signals), -1)[:, :n].T.reshape(x.shape)
    return y[::-1] if backward else y


def _responses(sos: Array, size: int) -> tuple[Array, Array, Array, Array]:
    """What an impulse at the first of `size` samples, and each of the m states before it, lead to.

    In transposed direct form II. Output of the impulse (size,) and of the states (m, size); the states that follow
    every sample of the impulse (size, m), and those that each state leads to after the last sample (m, m).
    """
    m = 2 * len(sos)

    def step(state: Array, value: Array) -> tuple[Array, tuple[Array, Array]]:
        following = []
        for (b0, b1, b2, _, a1, a2), (z1, z2) in zip(sos, state.reshape(len(sos), 2, -1), strict=True):
            out = b0 * value + z1
            following += [b1 * value - a1 * out + z2, b2 * value - a2 * out]
            value = out
        state = jnp.stack(following)
        return state, (value, state[:, 0])

    begin = jnp.eye(m, m + 1, 1, dtype=sos.dtype)
    impulse = jnp.zeros((size, m + 1), sos.dtype).at[0, 0].set(1)
    last, (outputs, states) = lax.scan(step, begin, impulse)
    return outputs[:, 0], outputs[:, 1:].T, states, last[:, 1:].T


_product = partial(jnp.matmul, precision=lax.Precision.HIGHEST)


class CutSignal(NamedTuple):
    """A signal that every window has a version of its own of: in window k `whole[start:][:S] + amounts[k] @ shapes`.

    What is linear, and done inside every window, makes another `CutSignal` of it: it is done once to the recording and
    once to each shape, and what it does differently at the ends of a window becomes another few shapes.
    """

    starts: NDArray[np.int64]
    """(M,) first sample of each window."""
    whole: NDArray[np.float64]
    """(N, *n) what all windows share, where they overlap."""
    shapes: NDArray[np.float64]
    """(r, S) what windows of S samples differ by."""
    amounts: NDArray[np.float64]
    """(M, *n, r) how much of each shape every window has."""

    def at(self, samples: NDArray[np.int64]) -> NDArray[np.float64]:
        """These samples (L,), counted from a window's start, of every window: (M, L, *n)."""
        added = np.moveaxis(self.amounts @ self.shapes[:, samples], -1, 1)
        return self.whole[self.starts[:, None] + samples] + added


def cut_signal(x: Num[AnyArray, "N *n"], starts: Integer[AnyArray, " M"], window: int) -> CutSignal:
    """The windows of `window` samples, as they are in the recording."""
    require_float64(x)
    x = np.asarray(x, np.float64)
    return CutSignal(np.asarray(starts), x, np.zeros((0, window)), np.zeros((len(starts), *x.shape[1:], 0)))


def filter_in_windows(sos: Sections, signal: CutSignal) -> CutSignal:
    """`filter_zero_phase` of every window by itself, for little more than the price of one pass over the recording.

    All that a filter knows of the past is its state. So a window differs from the recording, filtered in one go, only
    by what the filter does if left to itself, after it came into the window in another state: forward at the window's
    start, backward at its end. These states come from the extensions, filtered for all windows at a time.

    **Raises:** `ValueError` if a window has too few samples for the extension.
    """
    from scipy.signal import sosfilt, sosfiltfilt

    starts, x, shapes, amounts = signal
    sos, window, ends = np.asarray(sos, np.float64), shapes.shape[1], starts + shapes.shape[1]
    near = np.arange(_edge_within(sos, window) + 1)[:, None]
    forward, forward_states = _pass_with_states(sos, x)
    backward, backward_states = _pass_with_states(sos, forward[::-1])
    n_states = 2 * len(sos)
    every_state = np.eye(n_states).reshape(len(sos), 2, n_states)
    free, left = sosfilt(sos, np.zeros((window, n_states)), axis=0, zi=every_state)
    free_both_ways = [sosfilt(sos, free[::-1], axis=0)[::-1].T, free[::-1].T]
    filtered = sosfiltfilt(sos, shapes) if len(shapes) else shapes

    def flat(states: NDArray[np.float64]) -> NDArray[np.float64]:
        return states.reshape(n_states, *states.shape[2:])

    first = x[starts + near]  # (edge + 1, M, *n), from the start of every window on
    before = 2 * first[0] - first[:0:-1]
    entering = flat(sosfilt(sos, before, axis=0, zi=_rest(sos, before[0]))[1] - forward_states[:, :, starts])
    last = x[ends - 1 - near]  # from its end backwards
    leaving = forward_states[:, :, ends] + np.tensordot(left, entering, 1)
    after = sosfilt(sos, 2 * last[0] - last[1:], axis=0, zi=leaving)[0][::-1]
    returning = flat(sosfilt(sos, after, axis=0, zi=_rest(sos, after[0]))[1] - backward_states[:, :, len(x) - ends])
    of_states = np.moveaxis(np.concatenate([entering, returning]), 0, -1)
    return CutSignal(
        starts,
        backward[::-1],
        np.concatenate([*free_both_ways, filtered]),
        np.concatenate([of_states, amounts], axis=-1),
    )


def _rest(sos: NDArray[np.float64], x: AnyArray) -> NDArray[np.float64]:
    """States (k, 2, ...) as if the sample x (...) had lasted for ever."""
    from scipy.signal import sosfilt_zi

    return np.multiply.outer(sosfilt_zi(sos), x)


def _pass_with_states(
    sos: NDArray[np.float64], x: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """One pass from rest over x (N, ...), and the states (k, 2, N + 1, ...) before every sample and after the last."""
    from scipy.signal import sosfilt

    states = np.repeat(_rest(sos, x[0])[:, :, None], len(x) + 1, axis=2)
    for section, (z1, z2) in zip(sos, states, strict=True):
        _, b1, b2, _, a1, a2 = section
        y = sosfilt(section[None], x, axis=0, zi=np.stack([z1[0], z2[0]])[None])[0]
        z2[1:] = b2 * x - a2 * y
        z1[1:] = b1 * x - a1 * y + z2[:-1]
        x = y
    return x, states


def zero_phase_matrix(sos: Sections, n: int, every: int = 1) -> NDArray[np.float64]:
    """The matrix (ceil(n / every), n) that filters n samples to zero phase and keeps every `every`-th of them.

    **Raises:** `ValueError` if n samples are too few for the extension.
    """
    # Its columns are impulses, filtered: the windows that slide over a single one.
    impulse = np.eye(1, 2 * n - 1, n - 1)[0]
    return filter_in_windows(sos, cut_signal(impulse, np.arange(n)[::-1], n)).at(np.arange(0, n, every)).T


def autocovariance(sos: Sections, every: int = 1, tolerance: float = 1e-9) -> NDArray[np.float64]:
    """Autocovariance of white noise that was filtered to zero phase and then kept every n-th sample, as (L,).

    Lag zero is one. The lags end where they stay below `tolerance`. This is what standard errors need to know of the
    filter: neighbouring residuals are no longer independent.
    """
    density = _zero_phase_gain(sos) ** 2
    r = np.fft.irfft(density)[: len(density) // 2] / kept_variance(sos)
    r = r[::every]
    beyond = np.flatnonzero(np.abs(r) > tolerance)
    return r[: beyond[-1] + 1]


def kept_variance(sos: Sections) -> float:
    """Share of the variance of white noise that the zero-phase filter leaves."""
    density = _zero_phase_gain(sos) ** 2
    return float(np.mean(np.r_[density, density[1:-1]]))


def reach(sos: Sections, share: float = 0.01) -> int:
    """Samples within which the zero-phase filter gathers all but `share` of its (absolute) impulse response.

    That far from an end or a gap its output is made of measured samples, not of the extension.
    """
    response = np.abs(np.fft.irfft(_zero_phase_gain(sos)))
    one_side = np.cumsum(response[len(response) // 2 : 0 : -1])
    outside = 2 * one_side <= share * response.sum()
    return len(response) // 2 - int(outside.sum())


def zero_phase_response(sos: Sections) -> NDArray[np.float64]:
    """The impulse response of the forward and backward filter, from its middle on until it has died out."""
    response = np.fft.irfft(_zero_phase_gain(sos))
    return response[: len(response) // 2]


def _zero_phase_gain(sos: Sections) -> NDArray[np.float64]:
    """Amplitude of the forward and backward filter, on a grid fine enough for its slowest pole to die out."""
    from scipy.signal import freqz_sos

    sos = np.asarray(sos, np.float64)
    slowest = np.abs(np.concatenate([np.roots(section[3:]) for section in sos])).max()
    decay = int(np.ceil(40 / -np.log(slowest))) if slowest < 1 else 1 << 20
    n = 1 << min(22, max(10, int(np.ceil(np.log2(4 * decay)))))
    return np.abs(freqz_sos(sos, worN=np.linspace(0, np.pi, n // 2 + 1))[1]) ** 2
