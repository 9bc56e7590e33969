"""Trials of a hand that holds a handle and is perturbed, in motion or in a posture: what all methods work on."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num

from jaximp.motion.trajectories import array_field
from jaximp.types import AnyArray, Numbers

VOLUNTARY_DELAY = 0.115
"""Before that a subject cannot intervene [s]: Börner et al. 2020, 2.1.1."""
HISTORY = 0.3
"""What a method may look at before the onset [s]: it predicts the movement, and reflexes and filters reach back."""
FLAT = 0.05
"""Smallest over largest singular value of the perturbations from which on they span the plane."""


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


class Trials(eqx.Module):
    """T trials of N samples each, movements or postures, in the frame of the shoulder's geometry; more axes may lead.

    `reading.read_trials` makes them of recordings. A derivative that was neither measured nor asked for is NaN.
    """

    position: Float[Array, "*T N 2"]
    """Of the hand [m]."""
    velocity: Float[Array, "*T N 2"]
    """[m/s]."""
    acceleration: Float[Array, "*T N 2"]
    """[m/s^2]."""
    force: Float[Array, "*T N 2"]
    """Of the handle on the hand [N], `u_ext`."""
    command: Float[Array, "*T N 2"]
    """Perturbing force that was commanded [N]; zero before the onset, and throughout unperturbed trials."""
    onset: Int[Array, "*T"]
    """Index of the sample at which the perturbation begins; in an unperturbed trial, at which it would have."""
    sample_rate: float = eqx.field(static=True)
    """[Hz]."""

    def __len__(self) -> int:
        return self.position.shape[0]


@eqx.filter_jit
def cut_at_onset(x: Num[Array, "T N 2"], onset: Int[Array, " T"], samples: int) -> Float[Array, "T {samples} 2"]:
    """The `samples` of a signal from each onset on, of which it is the first."""
    return jax.vmap(lambda x, first: jax.lax.dynamic_slice_in_dim(x, first, samples))(x, onset)


@eqx.filter_jit
def in_window(trials: Trials, samples: int) -> Trials:
    """The `samples` from each onset on, of which it is the first."""

    signals = (trials.position, trials.velocity, trials.acceleration, trials.force, trials.command)
    x, v, a, force, command = (cut_at_onset(x, trials.onset, samples) for x in signals)
    return Trials(x, v, a, force, command, jnp.zeros_like(trials.onset), trials.sample_rate)


def window_samples(trials: Trials, window: float) -> int:
    """In a window [s] that begins with the onset and has both of its ends.

    **Raises:** `ValueError` for a window that is longer than a trial lasts after its onset.
    """
    samples = round(window * trials.sample_rate) + 1
    left = trials.position.shape[-2] - int(np.max(np.asarray(trials.onset)))
    if samples > left:
        raise ValueError(
            f"a window of {window:g} s is longer than the {left / trials.sample_rate:g} s that a trial lasts after "
            "its onset: make it shorter, or leave that trial out"
        )
    return samples


def window_warning(window: float) -> str:
    """What is to be said of a window [s] that is longer than a subject needs to answer; empty of others."""
    if window <= VOLUNTARY_DELAY + 1e-9:
        return ""
    return (
        f"the window of {1e3 * window:.4g} ms is longer than the voluntary delay of {1e3 * VOLUNTARY_DELAY:g} ms: "
        "the estimates are those of an arm that may already answer at will"
    )


def check_directions(peaks: Numbers, which: str) -> None:
    """**Raises:** `ValueError` for perturbations (T, 2) along one line, which tell nothing of the stiffness across it.
    The error calls them by `which`."""
    singular = np.linalg.svd(peaks, compute_uv=False)
    if len(peaks) > 1 and singular[-1] > FLAT * singular[0]:
        return
    along = peaks @ np.linalg.svd(peaks)[2][0]
    how = "all the same" if (along > 0).all() or (along < 0).all() else "all along one line"
    raise ValueError(
        f"the directions of {which} are {how} and do not span the plane of the two joints: perturb in at least two "
        "directions"
    )


def farthest(x: Numbers) -> Numbers:
    """(T, 2) of (T, N, 2): where each is farthest from zero."""
    return x[np.arange(len(x)), (x**2).sum(axis=-1).argmax(axis=1)]
