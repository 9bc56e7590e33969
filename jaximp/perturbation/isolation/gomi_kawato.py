"""The mean of all perturbed trials in place of the unperturbed movement: Gomi and Kawato 1997."""

from __future__ import annotations

import jax
from jaxtyping import Array

from jaximp.perturbation.deviations import Deviations, KnownArm
from jaximp.perturbation.isolation.isolated import Isolated
from jaximp.perturbation.trials import VOLUNTARY_DELAY, Trials, in_window, window_samples


def mean_of_perturbed(
    perturbed: Trials, unperturbed: Trials | None, arm: KnownArm, window: float = VOLUNTARY_DELAY
) -> Isolated:
    """The unperturbed movement is that at the onset plus what all perturbed trials did since on the average.

    Perturbations in all directions cancel in the mean; what the trials differ in, does not.

    **Source:** Gomi and Kawato 1997, as in Börner et al. 2020, 1.1.
    """

    seen = in_window(perturbed, window_samples(perturbed, window))
    return Isolated(Deviations(*map(_deviation, (seen.position, seen.velocity, seen.acceleration, seen.force))))


@jax.jit
def _deviation(x: Array) -> Array:
    return x[:, :1] + (x - x[:, :1]).mean(axis=0) - x
