"""Movements of a hand that holds a handle, some of them perturbed: what isolation works on."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Num

from jaximp.motion.trajectories import array_field
from jaximp.types import AnyArray

VOLUNTARY_DELAY = 0.115
"""Before that a subject cannot intervene [s]: Börner et al. 2020, 2.1.1."""
HISTORY = 0.3
"""What a method may look at before the onset [s]: it predicts the movement, and reflexes and filters reach back."""


class Handle(eqx.Module):
    """A handle that an admittance controller moves as if it had a mass and a damping of its own.

    The force that it puts on the hand is `command - (mass + own_mass) a - damping v`, where `command` is the
    perturbation: Börner et al. 2020, eqs. (25), (26).
    """

    mass: Float[Any, "2"] = array_field()
    """Of the admittance, along both axes [kg]."""
    damping: Float[Any, "2"] = array_field()
    """Of the admittance [N s/m]."""
    own_mass: Float[Any, ""] = array_field(default=0.0)
    """Between force sensor and hand [kg]; nothing where the force is computed and not measured."""

    def force(
        self, command: Num[AnyArray, "*N 2"], velocity: Num[AnyArray, "*N 2"], acceleration: Num[AnyArray, "*N 2"]
    ) -> Float[Array, "*N 2"]:
        """Force of the handle on the hand [N]: `u_ext` of eq. (25)."""
        moved = (self.mass + self.own_mass) * jnp.asarray(acceleration) + self.damping * jnp.asarray(velocity)
        return jnp.asarray(command) - moved


class Movements(eqx.Module):
    """T movements of N samples each, in the frame of the shoulder's geometry; more axes may lead."""

    position: Float[Array, "*T N 2"]
    """Of the hand [m]."""
    velocity: Float[Array, "*T N 2"]
    """[m/s]."""
    acceleration: Float[Array, "*T N 2"]
    """[m/s^2]."""
    force: Float[Array, "*T N 2"]
    """Of the handle on the hand [N], `u_ext`."""
    command: Float[Array, "*T N 2"]
    """Perturbing force that was commanded [N]; zero before the onset, and throughout unperturbed movements."""
    onset: Int[Array, "*T"]
    """Index of the sample at which the perturbation begins; in an unperturbed movement, at which it would have."""
    sample_rate: float = eqx.field(static=True)
    """[Hz]."""

    def __len__(self) -> int:
        return self.position.shape[0]


@eqx.filter_jit
def cut_at_onset(x: Num[Array, "T N 2"], onset: Int[Array, " T"], samples: int) -> Float[Array, "T {samples} 2"]:
    """The `samples` of a signal from each onset on, of which it is the first."""
    return jax.vmap(lambda x, first: jax.lax.dynamic_slice_in_dim(x, first, samples))(x, onset)


class Deviations(eqx.Module):
    """Unperturbed less perturbed, from the onset on; the first sample is that of the onset."""

    position: Float[Array, "*T S 2"]
    """Of the hand [m]."""
    velocity: Float[Array, "*T S 2"]
    """[m/s]"""
    acceleration: Float[Array, "*T S 2"]
    """[m/s^2]"""
    force: Float[Array, "*T S 2"]
    """Of the handle on the hand [N]."""
