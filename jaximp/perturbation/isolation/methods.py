"""What a perturbation added to a movement: isolation of the deviation from the movement that would have been.

A method takes perturbed trials, unperturbed ones where it needs them, and what is known of arm and handle; it returns
the deviations, `unperturbed - perturbed` throughout, and the impedance with its covariance where the method estimates
that itself (`isolated.Isolated`). A new method is one file, and one row of `METHODS`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import NamedTuple

from jaxtyping import Num

from jaximp.perturbation.deviations import KnownArm
from jaximp.perturbation.isolation.erden_billard import state_at_onset
from jaximp.perturbation.isolation.feedback_jerk import feedback_jerk_isolation
from jaximp.perturbation.isolation.gomi_kawato import mean_of_perturbed
from jaximp.perturbation.isolation.isolated import Isolated
from jaximp.perturbation.isolation.output_error import learned_continuation
from jaximp.perturbation.trials import Trials
from jaximp.types import AnyArray, nearest


class Method(NamedTuple):
    """A way to isolate deviations."""

    short: str
    title: str
    isolate: Callable[..., Isolated]
    linearised: bool = False
    """Whether its authors take the inertia to first order, and leave the stiffness asymmetric."""
    smooth: bool = True
    """Whether it wants position and force smoothed as the derivatives are (`read_trials`), or as measured."""
    estimates: bool = False
    """Whether it estimates the impedance itself, of `groups` of trials."""
    at_rest: bool = False
    """Whether it takes the unperturbed hand to be at rest."""


METHODS = {
    "output_error": Method("OE", "output error (this project)", learned_continuation, smooth=False, estimates=True),
    "feedback_jerk": Method("FJI", "feedback jerk isolation (Börner et al. 2020)", feedback_jerk_isolation),
    "gomi_kawato": Method("GOM", "mean of all perturbed trials (Gomi and Kawato 1997)", mean_of_perturbed, True),
    "erden_billard": Method("ERD", "state at the onset (Erden and Billard 2015)", state_at_onset, at_rest=True),
}


def check_method(method: str) -> None:
    """**Raises:** `ValueError` for a method that does not exist."""
    if method not in METHODS:
        raise ValueError(f"there is no method '{method}': {nearest(method, list(METHODS))}")


def isolate(
    perturbed: Trials,
    unperturbed: Trials | None,
    arm: KnownArm,
    method: str,
    window: float,
    cutoff: Num[AnyArray, "2"] | None = None,
) -> Isolated:
    """Deviations by one of `METHODS`; the `cutoff` (2,) [Hz] is for those that have one.

    **Raises:** `ValueError` for a method that does not exist, and what the method raises.
    """
    check_method(method)
    function = METHODS[method].isolate
    takes = "cutoff" in inspect.signature(function).parameters and cutoff is not None
    return function(perturbed, unperturbed, arm, window, **({"cutoff": cutoff} if takes else {}))
