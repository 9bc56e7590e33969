"""Reference motions of one or several joints, as functions of time that give position, velocity and acceleration.

All of them are called alike, `q, dq, ddq = trajectory(t)`: times (*t) in, three arrays (*t, *n) out, in which n is the
number of joints, or nothing for a single one whose parameters are plain numbers. They are written for revolute joints
[rad]; positions in metres work as well. Everything can be compiled, batched and differentiated, in time and in the
parameters. A motion that begins, does so at t = 0; call it with `t - onset`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

Motion = tuple[Float[Array, "*out"], Float[Array, "*out"], Float[Array, "*out"]]
"""Position [rad], velocity [rad/s] and acceleration [rad/s^2], each (*t, *n)."""

Trajectory = Callable[[Array], tuple[Array, Array, Array]]
"""What the modules below are, once made."""


def array_field(**options: Any) -> Any:
    """A module's field of which numbers become numpy float64 arrays: `jit` and `vmap` see them as arrays, and a module
    made at import keeps float64 whatever the configuration is then. Annotate it `Float[Any, shape]`: it accepts more
    than it holds."""
    return eqx.field(converter=lambda x: x if isinstance(x, jax.Array) else np.asarray(x, np.float64), **options)


def jerk(trajectory: Trajectory, t: Float[ArrayLike, "*t"]) -> Float[Array, "*out"]:
    """Third derivative (*t, *n) [rad/s^3] at the times `t`; where it jumps, that of the piece which `t` belongs to."""
    time = jnp.asarray(t, float)
    return jax.jvp(lambda time: trajectory(time)[2], (time,), (jnp.ones_like(time),))[1]


class FourierSeries(eqx.Module):
    """Finite Fourier series: periodic, smooth, and band-limited to `h / period` hertz.

    `q(t) = offset + sum_k [ a_k / (w k) sin(w k t) - b_k / (w k) cos(w k t) ]`, k = 1 .. h, w = 2 pi / period. The
    division by `w k` makes `a_k`, `b_k` the amplitudes of the velocity, so that all of them have the same unit and
    a similar size, which suits an optimiser.

    **Source:** Swevers et al. 1997, "Optimal robot excitation and identification" (the form that Tout et al. 2023,
    III-A, use).
    """

    sine: Float[Any, "*n h"] = array_field()
    """(*n, h) coefficients a_k of sin(w k t) / (w k) [rad/s]."""
    cosine: Float[Any, "*n h"] = array_field()
    """(*n, h) coefficients b_k of -cos(w k t) / (w k) [rad/s]."""
    offset: Float[Any, "*#n"] = array_field(default=0.0)
    """(*n) mean position [rad], or one for all joints."""
    period: Float[Any, ""] = array_field(default=10.0)
    """Time after which the motion repeats [s]."""

    def __check_init__(self) -> None:
        sine, cosine, offset = self.sine.shape, self.cosine.shape, self.offset.shape
        if not sine or not cosine or sine[:-1] != cosine[:-1] or offset not in ((), sine[:-1]):
            raise ValueError(
                f"sine is {sine}, cosine {cosine}, offset {offset}: give coefficients (harmonics,) and one offset, "
                "or coefficients (joints, harmonics) and offsets (joints,)"
            )
        if sine != cosine:
            raise ValueError(f"sine has {sine[-1]} harmonics and cosine {cosine[-1]}: give both the same number")
        _require_positive(period=self.period)

    @property
    def highest_frequency(self) -> Float[Any, ""]:
        """Frequency of the last harmonic [Hz]."""
        return self.sine.shape[-1] / self.period

    def __call__(self, t: Float[ArrayLike, "*t"]) -> Motion:
        time = jnp.asarray(t, float)
        sine, cosine, offset, period = jax.tree.map(jnp.asarray, (self.sine, self.cosine, self.offset, self.period))
        frequency = 2 * jnp.pi / period * jnp.arange(1, sine.shape[-1] + 1, dtype=float)
        sin, cos = jnp.sin(frequency * time[..., None]), jnp.cos(frequency * time[..., None])
        over_harmonics = partial(jnp.tensordot, axes=(-1, -1))
        position = offset + (over_harmonics(sin, sine / frequency) - over_harmonics(cos, cosine / frequency))
        velocity = over_harmonics(cos, sine) + over_harmonics(sin, cosine)
        acceleration = over_harmonics(cos, cosine * frequency) - over_harmonics(sin, sine * frequency)
        return position, velocity, acceleration


def at_rest(series: FourierSeries) -> FourierSeries:
    """The nearest series, in its coefficients, that begins and ends a period at its offset and at rest.

    At t = 0 the position is the offset if `sum b_k / k = 0`, the velocity is zero if `sum a_k = 0` and the acceleration
    if `sum k b_k = 0`; the coefficients are projected onto these conditions. They leave h - 1 sines and h - 2 cosines
    free: nothing of a single harmonic, which is refused, and only sines of two.
    """
    harmonics = series.sine.shape[-1]
    if harmonics < 2:
        raise ValueError("one harmonic cannot begin at rest: give the series at least 2, or 3 to keep cosines as well")
    k = np.arange(1.0, harmonics + 1)
    conditions = np.linalg.qr(np.stack([1 / k, k], axis=1))[0]
    sine = series.sine - series.sine.mean(axis=-1, keepdims=True)
    cosine = series.cosine - (series.cosine @ conditions) @ conditions.T
    return FourierSeries(sine, cosine, series.offset, series.period)


def _require_positive(**values: Any) -> None:
    for name, value in values.items():
        known = not isinstance(value, jax.core.Tracer)
        if known and not np.all(np.isfinite(value) & (np.asarray(value) > 0)):
            raise ValueError(f"{name} is {np.asarray(value).tolist()}: it must be positive and finite")
