"""Filters for samples that arrive one by one.

What makes velocity and acceleration of the position must have no phase, or a model that is not linear in the motion
would be wrong: it looks as far ahead as back, and its answer comes by so much later. What the torque and all columns of
the regressor pass alike needs no such care: it runs forward only, twice, which has the gain of a pass forward and
backward.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaximp.signals.derivatives import Differentiator
from jaximp.signals.filters import Sections, padded_filter, zero_phase_response
from jaximp.types import AnyArray, Numbers

TAIL = 1e-3
"""Share of a filter's (absolute) impulse response that is cut off, so that the answer need not wait for it: gains
within the band are off by about as much."""
SETTLED = 0.1
"""Share of the response that is still to come when a causal filter counts as settled. It began at rest with the torque
and all columns alike, which biases nothing; only the noise has not its usual size yet."""
SLOWEST = 1 << 17
"""Samples after which a causal filter counts as settled in any case."""


class Derivatives(eqx.Module):
    """Weights of the last T samples for the position, velocity and acceleration in their middle."""

    taps: Float[AnyArray, "3 T"]
    """From the oldest sample on, per second and per second squared."""

    @property
    def samples(self) -> int:
        """How many samples it sees, T."""
        return int(self.taps.shape[1])

    @property
    def late(self) -> int:
        """How many samples its answer is behind the newest."""
        return self.samples // 2

    def __call__(self, q: Float[Array, " T"]) -> Float[Array, "3"]:
        """Smooth position, velocity and acceleration in the middle of the samples, of which none is missing."""
        middle = q[self.late]
        found: Array = self.taps @ (q - middle)  # a large constant would cost digits
        return found.at[0].add(middle)


def design_derivatives(sos: Sections | None, by: Differentiator, sample_rate: float, tail: float = TAIL) -> Derivatives:
    """A zero-phase low-pass, or none, and a differentiator in one go.

    **Arguments:** `sos` of the low-pass; `sample_rate` [Hz]; `tail` as `TAIL`.
    """
    smooth = np.ones(1) if sos is None else _cut(zero_phase_response(sos), tail)
    first, second = (np.asarray(x, float) for x in (by.first, by.second))
    nothing = np.zeros(by.half)
    weights = (
        np.concatenate([nothing, [1.0], nothing]),
        np.concatenate([-first[::-1], [0.0], first]) * sample_rate,
        np.concatenate([second[::-1], [-2 * second.sum()], second]) * sample_rate**2,
    )
    return Derivatives(np.stack([np.convolve(smooth, one) for one in weights]))


def _cut(response: Numbers, tail: float) -> Numbers:
    """Both sides of a symmetric response (from its middle on) without their tails; its sum is one."""
    size = np.abs(response)
    beyond = 2 * np.cumsum(size[::-1])[::-1]
    half = max(1, int(np.argmax(beyond <= tail * (2 * size.sum() - size[0]))))
    whole = np.concatenate([response[half - 1 : 0 : -1], response[:half]])
    return np.asarray(whole / whole.sum())


class Causal(eqx.Module):
    """A filter that runs forward, twice."""

    sos: Float[AnyArray, "k 6"]
    rest: Float[AnyArray, "k 2"]
    """State of a unit input that has lasted for ever; of a high-pass, the output is then zero."""
    settles: int = eqx.field(static=True)
    """Samples until it has forgotten how it began."""
    late: float = eqx.field(static=True)
    """Group delay of what passes it, at low frequencies of its pass band [samples]."""


class Passed(NamedTuple):
    """States of both passes."""

    first: Float[Array, "k 2 f"]
    second: Float[Array, "k 2 f"]


def design_causal(sos: Sections | None) -> Causal:
    """The filter of torque and columns; without sections it passes all as it is."""
    if sos is None:
        return Causal(np.zeros((0, 6)), np.zeros((0, 2)), 0, 0.0)
    from scipy.signal import sos2zpk, sosfilt, sosfreqz

    plain = tuple(tuple(float(x) for x in section) for section in np.asarray(sos).tolist())
    found, sections = padded_filter(plain), np.asarray(sos, float)
    slowest = np.abs(sos2zpk(sections)[1]).max()
    length = int(min(SLOWEST, max(64, np.ceil(20 / -np.log(slowest))))) if slowest < 1 else SLOWEST
    answer = np.abs(sosfilt(sections, sosfilt(sections, np.eye(1, length)[0])))
    settles = int(np.argmax(np.cumsum(answer) >= (1 - SETTLED) * answer.sum())) + 1
    w = np.pi * np.geomspace(1e-5, 1, 4000)
    gain = sosfreqz(sections, w)[1]
    slope = -np.gradient(np.unwrap(np.angle(gain)), w)
    passing = np.abs(gain) ** 2 > 0.5 * np.abs(gain).max() ** 2
    return Causal(found.sos, found.rest, settles, float(2 * np.median(slope[passing])))


def begin_causal(by: Causal, z: Float[Array, " f"]) -> Passed:
    """As if these values had lasted for ever."""
    first = jnp.asarray(by.rest)[..., None] * z
    for b0, b1, b2, _, a1, a2 in by.sos:
        z = z * (b0 + b1 + b2) / (1 + a1 + a2)
    return Passed(first, jnp.asarray(by.rest)[..., None] * z)


def pass_causal(by: Causal, state: Passed, z: Float[Array, " f"]) -> tuple[Passed, Float[Array, " f"]]:
    """One sample of several signals through both passes."""
    first, z = _once(by.sos, state.first, z)
    second, z = _once(by.sos, state.second, z)
    return Passed(first, second), z


def _once(sos: AnyArray, state: Array, z: Array) -> tuple[Array, Array]:
    """Second-order sections in transposed direct form II."""
    following = []
    for section, (z1, z2) in zip(sos, state, strict=True):
        b0, b1, b2, _, a1, a2 = section
        out = b0 * z + z1
        following.append(jnp.stack([b1 * z - a1 * out + z2, b2 * z - a2 * out]))
        z = out
    return (jnp.stack(following) if following else state), z
