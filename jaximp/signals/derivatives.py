"""Derivatives of sampled signals: differentiators, Savitzky and Golay's polynomials; time is axis 0."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Num
from numpy.typing import NDArray

from jaximp.signals.filters import CutSignal
from jaximp.types import AnyArray

WORST_GAIN = 5e-4
"""Largest relative error of a derivative's amplitude within the band that was asked for."""
HALF_LENGTHS = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256)
"""Samples on either side that a differentiator may use: few sizes, so that sample rates share compiled code."""
UNROLLED = 8
"""Longer differentiators run in a loop: written out they would take long to compile."""


class Differentiator(eqx.Module):
    """Weights for first and second derivatives of samples, from L samples on either side."""

    first: AnyArray
    """(L,) of q[i + k] - q[i - k], for k = 1 to L."""
    second: AnyArray
    """(L,) of q[i + k] - 2 q[i] + q[i - k]."""
    ends: AnyArray
    """(2, L, 2 L + 1) both derivatives at the first L samples, from the first 2 L + 1."""

    @property
    def half(self) -> int:
        """Samples on either side, L."""
        return int(self.first.shape[0])


@lru_cache(maxsize=64)
def design_differentiator(band: float) -> Differentiator:
    """A differentiator whose amplitude is right to `WORST_GAIN` from 0 to `band`, a share of half the sample rate.

    Constants, straight lines and parabolas are differentiated exactly. Within `half` samples of an end fewer samples
    are used, down to central differences, and one-sided ones at the very end.

    **Raises:** `ValueError` for a band that would take too many samples.
    """
    if not 0 < band < 1:
        raise ValueError(f"the band of the derivatives is {band:g} of half the sample rate: it must be between 0 and 1")
    for half in HALF_LENGTHS:
        (first, error), (second, other_error) = (_wide_band(band, half, order) for order in (1, 2))
        if max(error, other_error) <= WORST_GAIN:
            shorter = [[_wide_band(band, k, order)[0] for k in range(1, half)] for order in (1, 2)]
            return _with_ends(first, second, shorter)
    raise ValueError(
        f"derivatives up to {band:.2%} of half the sample rate would take more than {HALF_LENGTHS[-1]} samples on "
        "either side: lower filter.position_cutoff"
    )


def _wide_band(band: float, half: int, order: int) -> tuple[NDArray[np.float64], float]:
    """(half,) weights of the first or second derivative, and the worst relative error of its amplitude in the band.

    Least squares of the relative error over the band, among all weights that are exact at frequency zero.
    """
    k = np.arange(1, half + 1)

    def gains(points: int) -> NDArray[np.float64]:
        w = (np.arange(points) + 1)[:, None] * (np.pi * band / points)
        return 2 * np.sin(k * w) / w if order == 1 else (2 * np.sin(k * w / 2) / w) ** 2

    at_zero = 2.0 * k if order == 1 else k**2.0
    exact = at_zero / (at_zero @ at_zero)
    free = np.linalg.svd(at_zero[None])[2][1:].T
    A = gains(8 * half + 64)
    weights = exact + free @ np.linalg.lstsq(A @ free, 1 - A @ exact, rcond=None)[0] if half > 1 else exact
    return weights, float(np.abs(gains(32 * half + 256) @ weights - 1).max())


def _with_ends(
    first: NDArray[np.float64], second: NDArray[np.float64], shorter: Sequence[Sequence[NDArray[np.float64]]] = ((), ())
) -> Differentiator:
    """With what serves near the ends: `shorter` weights of 1 to L - 1 samples on either side."""
    half = len(first)
    ends = np.zeros((2, half, 2 * half + 1))
    ends[:, 0, :3] = [-1.5, 2, -0.5], [1, -2, 1]
    for i in range(1, half):
        slope, curvature = (weights[i - 1] for weights in shorter)
        ends[0, i, : 2 * i + 1] = np.concatenate([-slope[::-1], [0], slope])
        ends[1, i, : 2 * i + 1] = np.concatenate([curvature[::-1], [-2 * curvature.sum()], curvature])
    return Differentiator(first, second, ends)


CENTRAL = _with_ends(np.array([0.5]), np.array([1.0]))
"""Central differences: their amplitude is sin(w h)/(w h) of the true one, 2 % too small at a ninth of half the rate."""


def differentiate(
    q: Num[AnyArray, "N *k"], sample_rate: float | Float[AnyArray, ""], by: Differentiator = CENTRAL
) -> tuple[Float[AnyArray, "N *k"], Float[AnyArray, "N *k"]]:
    """First and second derivative; near the ends fewer samples are used.

    Those of a numpy array are numpy arrays.

    **Raises:** `ValueError` for fewer than 2 L + 1 samples.
    """
    xp: Any = np if isinstance(q, np.ndarray) else jnp
    half = by.half
    if q.shape[0] < 2 * half + 1:
        raise ValueError(f"{q.shape[0]} samples are too few for derivatives: at least {2 * half + 1} are needed")
    inside = _inside(q, by)
    start, end = _at_ends(q[: 2 * half + 1], q[-2 * half - 1 :], by)
    dq, ddq = (xp.concatenate(parts) for parts in zip(start, inside, end, strict=True))
    return dq * sample_rate, ddq * sample_rate**2


def _inside(q: AnyArray, by: Differentiator) -> tuple[AnyArray, AnyArray]:
    """Both derivatives per sample of all samples that have L neighbours on either side."""
    half, inner = by.half, q.shape[0] - 2 * by.half
    middle = q[half : half + inner]

    def add(k: Any, sums: Any) -> Any:
        if isinstance(k, int):
            before, behind = q[half - k : half - k + inner], q[half + k : half + k + inner]
        else:
            before, behind = (lax.dynamic_slice_in_dim(q, half + shift, inner) for shift in (-k, k))
        slope, curvature = behind - before, (behind - middle) - (middle - before)
        return sums[0] + by.first[k - 1] * slope, sums[1] + by.second[k - 1] * curvature

    sums: Any = add(1, (0.0, 0.0))
    if isinstance(q, np.ndarray) or half <= UNROLLED:
        for k in range(2, half + 1):
            sums = add(k, sums)
        return sums[0], sums[1]
    by = jax.tree.map(jnp.asarray, by)
    found: tuple[Array, Array] = lax.fori_loop(2, half + 1, add, sums)
    return found


def _at_ends(first: AnyArray, last: AnyArray, by: Differentiator) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Both derivatives per sample at the first and the last L samples, from the first and last 2 L + 1."""
    xp: Any = np if isinstance(first, np.ndarray) else jnp
    slope, curvature = (xp.tensordot(weights, first, 1) for weights in by.ends)
    falling, bent = (xp.tensordot(weights, last[::-1], 1)[::-1] for weights in by.ends)
    return (slope, curvature), (-falling, bent)


def central_differences(
    q: Num[AnyArray, "N *k"], sample_rate: float | Float[AnyArray, ""]
) -> tuple[Float[AnyArray, "N *k"], Float[AnyArray, "N *k"]]:
    """First and second derivative by central differences; the first and last sample take one-sided ones.

    Those of a numpy array are numpy arrays.

    **Raises:** `ValueError` for fewer than 3 samples.
    """
    return differentiate(q, sample_rate)


def differentiate_padded(
    q: Num[AnyArray, "N k"], sample_rate: Float[AnyArray, ""], n: Int[AnyArray, ""], by: Differentiator = CENTRAL
) -> tuple[Float[Array, "N k"], Float[Array, "N k"]]:
    """`differentiate` of the first n samples; what stands behind them means nothing, before and after."""
    half = by.half
    last = lax.dynamic_slice_in_dim(q, n - 2 * half - 1, 2 * half + 1)
    at_end = _at_ends(last, last, by)[1]
    whole, scales = differentiate(jnp.asarray(q), sample_rate, by), (sample_rate, sample_rate**2)
    dq, ddq = (
        lax.dynamic_update_slice_in_dim(x, end * scale, n - half, 0)
        for x, end, scale in zip(whole, at_end, scales, strict=True)
    )
    return dq, ddq


def differentiate_in_windows(
    signal: CutSignal, sample_rate: float, by: Differentiator = CENTRAL
) -> tuple[CutSignal, CutSignal]:
    """`differentiate` of every window by itself."""
    starts, x, shapes, amounts = signal
    window, half = shapes.shape[1], by.half
    of_shapes = differentiate(shapes.T, sample_rate, by)
    near, inner = np.arange(2 * half + 1)[:, None], np.arange(half)[:, None]
    first, last = starts, starts + window - 2 * half - 1
    at_start, at_end = _at_ends(x[first + near], x[last + near], by)
    unit = np.eye(window)
    at_ends = np.concatenate([unit[:half], unit[-half:]])
    results = []
    for k, whole in enumerate(differentiate(x, sample_rate, by)):
        start, end = (ends[k] * sample_rate ** (k + 1) for ends in (at_start, at_end))
        ends = np.concatenate([start - whole[first + inner], end - whole[starts + window - half + inner]])
        results.append(
            CutSignal(
                starts,
                whole,
                np.concatenate([at_ends, of_shapes[k].T]),
                np.concatenate([np.moveaxis(ends, 0, -1), amounts], axis=-1),
            )
        )
    return results[0], results[1]


def savitzky_golay_half_length(sample_rate: float, cutoff: float = 50.0, order: int = 7) -> int:
    """Half length M of the Savitzky-Golay filter (2 M + 1 samples) with this `cutoff` [Hz].

    From `f_c = (n + 1) / (3.2 M - 4.6)`, with the order n of the polynomial and f_c in halves of the sample rate. With
    order 7 and 50 Hz, the velocity is down by 3 dB at 50 Hz, the position at 46 Hz (its order is in fact 6: odd powers
    vanish in the middle), and the acceleration at 41 Hz.

    **Raises:** `ValueError` for a cut-off that would take no more samples than the polynomial has coefficients.

    **Source:** Schafer 2011 (IEEE Signal Processing Magazine 28(4)), a fit that holds for M of at least 25.
    """
    if not 0 < cutoff < sample_rate / 2:
        raise ValueError(f"the cut-off of {cutoff:g} Hz must lie between 0 and {sample_rate / 2:g} Hz, half the rate")
    half = round(((order + 1) * sample_rate / (2 * cutoff) + 4.6) / 3.2)
    if 2 * half <= order:
        raise ValueError(
            f"a cut-off of {cutoff:g} Hz at {sample_rate:g} Hz leaves {2 * half + 1} samples for a polynomial of order "
            f"{order}: lower one of them"
        )
    return half


def savitzky_golay(
    x: Num[AnyArray, "N *k"], sample_rate: float, derivative: int = 0, cutoff: float = 50.0, order: int = 7
) -> Float[AnyArray, "N *k"]:
    """A derivative of a sampled signal, of polynomials that are fitted around every sample; `derivative=0` smooths.

    At both ends the polynomial of the first or last whole window is evaluated off its middle, which passes much noise:
    leave out `savitzky_golay_half_length` samples there, and around gaps. That of a numpy array is a numpy array.

    The numbers are those of `scipy.signal.savgol_filter`, which cannot be used here: it fits powers of the sample's
    index, and with order 7 and 203 samples (50 Hz at 4 kHz) its least squares cuts off the highest of them.

    **Raises:** `ValueError` if the signal is shorter than the filter, and as `savitzky_golay_half_length`.

    **Source:** Savitzky and Golay 1964; order and cut-off as in Börner et al. 2020, 2.4.1.
    """
    half = savitzky_golay_half_length(sample_rate, cutoff, order)
    if len(x) < 2 * half + 1:
        raise ValueError(f"{len(x)} samples are too few for this filter, which has {2 * half + 1}: record longer")
    weights = _polynomial_weights(half, order, derivative) * (sample_rate / half) ** derivative
    concatenate: Any
    convolve: Any
    if isinstance(x, jax.Array):
        one = partial(jax.scipy.signal.fftconvolve, mode="valid")
        concatenate, convolve = jnp.concatenate, jax.vmap(one, in_axes=(1, None), out_axes=1)
        weights = weights.astype(jnp.result_type(x, float))
    else:
        from scipy.signal import oaconvolve

        x, concatenate, convolve = np.asarray(x), np.concatenate, lambda x, w: oaconvolve(x, w[:, None], "valid", 0)
    columns = x.reshape(len(x), -1).astype(weights.dtype)
    shift = columns[:1] if derivative else 0.0  # a large constant would cost digits
    middle = convolve(columns - shift, weights[half][::-1])
    start, end = (weights[part] @ (ends - shift) for part, ends in (
        (slice(None, half), columns[: 2 * half + 1]), (slice(half + 1, None), columns[-2 * half - 1 :])
    ))  # fmt: skip
    return concatenate([start, middle, end]).reshape(x.shape)


def savitzky_golay_gain(sample_rate: float, derivative: int, cutoff: float = 50.0, order: int = 7) -> float:
    """Standard deviation that `savitzky_golay` makes of white noise of unit standard deviation, away from the ends."""
    half = savitzky_golay_half_length(sample_rate, cutoff, order)
    weights = _polynomial_weights(half, order, derivative)[half]
    return float(np.linalg.norm(weights) * (sample_rate / half) ** derivative)


@lru_cache(maxsize=32)
def _polynomial_weights(half: int, order: int, derivative: int) -> NDArray[np.float64]:
    """(2 half + 1, 2 half + 1) from samples at -1 to 1 to the derivative there of the polynomial that fits them all."""
    from numpy.polynomial import legendre

    # Legendre polynomials are almost orthogonal over the samples; powers are far from it.
    t = np.linspace(-1, 1, 2 * half + 1)
    basis, unit = legendre.legvander(t, order), np.eye(order + 1)
    derived = np.stack([legendre.legval(t, legendre.legder(row, derivative)) for row in unit], axis=1)
    return np.asarray(derived @ np.linalg.pinv(basis))
