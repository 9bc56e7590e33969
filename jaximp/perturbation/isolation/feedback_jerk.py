"""Feedback jerk isolation: Börner et al. 2020, 2.2.1."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaximp.perturbation.deviations import Deviations, KnownArm
from jaximp.perturbation.isolation.isolated import Isolated, known_handle
from jaximp.perturbation.trials import VOLUNTARY_DELAY, Handle, Trials, cut_at_onset, in_window, window_samples
from jaximp.signals.derivatives import central_differences
from jaximp.signals.filters import butterworth, filter_zero_phase
from jaximp.types import AnyArray, Numbers

FILTER_ORDER = 10
LOWEST_CUTOFF = 0.5
"""Below it the spectra are those of the movement and its surroundings [Hz]. A choice."""
HIGHEST_CUTOFF = 50.0
"""Where the search for a cut-off ends [Hz]."""
RESOLUTION = 0.02
"""Of the spectra [Hz]."""


@jax.jit
def jerk(movements: Trials) -> Float[Array, "T N 2"]:
    """Derivative of the acceleration [m/s^3] by central differences."""
    return jax.vmap(lambda a: central_differences(a, movements.sample_rate)[0])(movements.acceleration)


def energy_spectra(perturbed: Trials, unperturbed: Trials) -> tuple[Numbers, Numbers, Numbers]:
    """Mean energy spectral densities of the jerk, eq. (24), with the feedback's as what perturbed trials have more.

    **Returns:** frequencies (F,) up to 50 Hz, and densities (F, 2) of unperturbed and perturbed trials [m^2/s^4].
    """
    from scipy.fft import next_fast_len

    rate = perturbed.sample_rate
    # Means of short blocks say all that there is to say of frequencies so low.
    block = max(1, int(rate / (8 * HIGHEST_CUTOFF)))
    n = next_fast_len(round(rate / block / RESOLUTION), real=True)
    frequency = np.fft.rfftfreq(n, block / rate)
    spectra = []
    for movements in (unperturbed, perturbed):
        x = np.swapaxes(jerk(movements), 1, 2)
        x = x[..., : x.shape[-1] // block * block].reshape(len(x), 2, -1, block).mean(axis=-1)
        density = np.abs(np.fft.rfft(x, n) * block / rate) ** 2
        spectra.append(density.mean(axis=0).T[frequency <= HIGHEST_CUTOFF])
    return np.asarray(frequency[frequency <= HIGHEST_CUTOFF], float), spectra[0], spectra[1]


def cutoff_frequencies(perturbed: Trials, unperturbed: Trials) -> Numbers:
    """(2,) first frequency [Hz] at which the feedback's jerk has more energy than that of unperturbed trials: 2.2.1.

    **Raises:** `ValueError` where it never has: the perturbation is too small, or the trials are not of one task.
    """
    frequency, without, with_it = energy_spectra(perturbed, unperturbed)
    above = (with_it - without > without) & (frequency >= LOWEST_CUTOFF)[:, None]
    if not above.any(axis=0).all():
        raise ValueError(
            "perturbed movements have no more jerk than unperturbed ones at any frequency up to "
            f"{HIGHEST_CUTOFF:g} Hz: the perturbation is too small, or the trials are not of the same task"
        )
    return frequency[above.argmax(axis=0)]


def feedback_jerk_isolation(
    perturbed: Trials,
    unperturbed: Trials | None,
    arm: KnownArm,
    window: float = VOLUNTARY_DELAY,
    cutoff: Num[AnyArray, "2"] | None = None,
) -> Isolated:
    """The deviation's jerk is what a high-pass without phase leaves of the jerk of the perturbed trial.

    It is integrated three times, from the onset on and from zero there. The unperturbed force is that of the handle
    on the unperturbed movement.

    **Arguments:** `cutoff` (2,) of the high-pass along both axes [Hz]; without it that of `cutoff_frequencies`, for
    which unperturbed trials are needed.

    **Raises:** `ValueError` without unperturbed trials and without a cut-off, and as `cutoff_frequencies`.

    **Source:** Börner et al. 2020, 2.2.1, figure 3.
    """
    handle = known_handle(arm)
    if cutoff is None:
        if unperturbed is None:
            raise ValueError(
                "feedback jerk isolation finds its cut-off frequency from unperturbed trials, and there are none: "
                "give two cut-off frequencies, cutoff = [f1, f2] in Hz, such as [1.9, 2.2], or use another method"
            )
        cutoff = cutoff_frequencies(perturbed, unperturbed)
    cutoff = np.broadcast_to(np.asarray(cutoff, float), 2)
    of_all = jerk(perturbed)
    high = [
        filter_zero_phase(butterworth(FILTER_ORDER, float(f), perturbed.sample_rate, "highpass"), of_all[..., axis].T).T
        for axis, f in enumerate(cutoff)
    ]
    samples = window_samples(perturbed, window)
    return Isolated(_integrated(perturbed, jnp.stack(high, axis=-1), handle, samples), cutoff)


@eqx.filter_jit
def _integrated(perturbed: Trials, high: Array, handle: Handle, samples: int) -> Deviations:
    """From the jerk of the feedback, over whole trials, to deviations in the window."""
    seen = in_window(perturbed, samples)
    acceleration = _integral(-cut_at_onset(high, perturbed.onset, samples), perturbed.sample_rate)
    velocity = _integral(acceleration, perturbed.sample_rate)
    position = _integral(velocity, perturbed.sample_rate)
    unperturbed = handle.force(jnp.zeros_like(velocity), seen.velocity + velocity, seen.acceleration + acceleration)
    return Deviations(position, velocity, acceleration, unperturbed - seen.force)


def _integral(x: Array, rate: float) -> Array:
    """By trapezia from the first sample on, which is zero. (Rectangles bias the damping by a tenth.)"""
    return jnp.pad(jnp.cumsum((x[:, 1:] + x[:, :-1]) / (2 * rate), axis=1), ((0, 0), (1, 0), (0, 0)))
