"""Reference motions of one joint, as functions of time that give position, velocity and acceleration together."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float


def array_field(**options: Any) -> Any:
    """A module's field of which numbers become numpy float64 arrays: `jit` and `vmap` see them as arrays, and a module
    made at import keeps float64 whatever the configuration is then. Annotate it `Float[Any, shape]`: it accepts more
    than it holds."""
    return eqx.field(converter=lambda x: x if isinstance(x, jax.Array) else np.asarray(x, np.float64), **options)


class FourierSeries(eqx.Module):
    """Finite Fourier series of one joint: periodic, smooth, and band-limited to `h / period` hertz.

    `q(t) = offset + sum_k [ a_k / (w k) sin(w k t) - b_k / (w k) cos(w k t) ]`, k = 1 .. h, w = 2 pi / period. The
    division by `w k` makes `a_k`, `b_k` the amplitudes of the velocity, so that all of them have the same unit and
    a similar size, which suits an optimiser.

    **Source:** Swevers et al. 1997, "Optimal robot excitation and identification" (the form that Tout et al. 2023,
    III-A, use).
    """

    sine: Float[Any, " h"] = array_field()
    """(h,) coefficients a_k of sin(w k t) / (w k) [rad/s]."""
    cosine: Float[Any, " h"] = array_field()
    """(h,) coefficients b_k of -cos(w k t) / (w k) [rad/s]."""
    offset: Float[Any, ""] = array_field(default=0.0)
    """Mean position [rad]."""
    period: Float[Any, ""] = array_field(default=10.0)
    """Time after which the motion repeats [s]."""

    def __check_init__(self) -> None:
        if self.sine.shape != self.cosine.shape:
            raise ValueError(
                f"sine has {self.sine.shape[0]} harmonics and cosine {self.cosine.shape[0]}: give both the same number"
            )

    def __call__(
        self, t: Float[ArrayLike, "*batch"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"], Float[Array, "*batch"]]:
        """Position [rad], velocity [rad/s] and acceleration [rad/s^2] at the times `t` [s], each shaped like `t`."""
        time = jnp.asarray(t, float)
        sine, cosine, offset, period = jax.tree.map(jnp.asarray, (self.sine, self.cosine, self.offset, self.period))
        frequency = 2 * jnp.pi / period * jnp.arange(1, sine.shape[0] + 1, dtype=float)
        sin, cos = jnp.sin(frequency * time[..., None]), jnp.cos(frequency * time[..., None])
        position = offset + (sin @ (sine / frequency) - cos @ (cosine / frequency))
        velocity = cos @ sine + sin @ cosine
        acceleration = cos @ (cosine * frequency) - sin @ (sine * frequency)
        return position, velocity, acceleration
