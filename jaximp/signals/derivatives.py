"""Derivatives of sampled signals: central differences, Savitzky and Golay's polynomials; time is axis 0."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Num
from numpy.typing import NDArray

from jaximp.signals.filters import CutSignal
from jaximp.types import AnyArray


def central_differences(
    q: Num[AnyArray, "N *k"], sample_rate: float | Float[AnyArray, ""]
) -> tuple[Float[AnyArray, "N *k"], Float[AnyArray, "N *k"]]:
    """First and second derivative by central differences; the first and last sample take one-sided ones.

    Those of a numpy array are numpy arrays.
    """
    concatenate = np.concatenate if isinstance(q, np.ndarray) else jnp.concatenate
    if q.shape[0] < 3:
        raise ValueError(f"{q.shape[0]} samples have no second difference: at least 3 are needed")
    dq = (q[2:] - q[:-2]) * (sample_rate / 2)
    first = (-3 * q[:1] + 4 * q[1:2] - q[2:3]) * (sample_rate / 2)
    last = (3 * q[-1:] - 4 * q[-2:-1] + q[-3:-2]) * (sample_rate / 2)
    ddq = (q[2:] - 2 * q[1:-1] + q[:-2]) * sample_rate**2
    return concatenate([first, dq, last]), concatenate([ddq[:1], ddq, ddq[-1:]])


def central_differences_padded(
    q: Num[AnyArray, "N k"], sample_rate: Float[AnyArray, ""], n: Int[AnyArray, ""]
) -> tuple[Float[Array, "N k"], Float[Array, "N k"]]:
    """`central_differences` of the first n samples; what stands behind them means nothing, before and after."""
    dq, ddq = central_differences(q, sample_rate)
    end = central_differences(lax.dynamic_slice_in_dim(q, n - 3, 3), sample_rate)
    at_end = (jnp.arange(q.shape[0]) == n - 1)[:, None]
    return jnp.where(at_end, end[0][-1:], dq), jnp.where(at_end, end[1][-1:], ddq)


def differences_in_windows(signal: CutSignal, sample_rate: float) -> tuple[CutSignal, CutSignal]:
    """`central_differences` of every window by itself."""
    starts, x, shapes, amounts = signal
    window = shapes.shape[1]
    of_shapes = central_differences(shapes.T, sample_rate)
    three = np.arange(3)[:, None]
    first, last = starts, starts + window - 1
    one_sided = [central_differences(x[start + three], sample_rate) for start in (first, last - 2)]
    results = []
    for k, whole in enumerate(central_differences(x, sample_rate)):
        ends = np.stack([one_sided[0][k][0] - whole[first], one_sided[1][k][-1] - whole[last]], axis=-1)
        at_ends = np.eye(window)[[0, -1]]
        results.append(
            CutSignal(
                starts, whole, np.concatenate([at_ends, of_shapes[k].T]), np.concatenate([ends, amounts], axis=-1)
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
