"""What every method of isolation returns, and what some of them must know."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Bool, Float

from jaximp.perturbation.deviations import Deviations, KnownArm
from jaximp.perturbation.trials import Handle
from jaximp.types import Numbers


class Impedance(eqx.Module):
    """Damping and stiffness of the joints, from a method that estimates them itself; of groups of trials, if asked."""

    D: Float[Array, "*G 2 2"]
    """[N m s/rad]"""
    K: Float[Array, "*G 2 2"]
    """Symmetric [N m/rad]."""
    covariance: Float[Array, "*G 7 7"]
    """Of `stiffness.SYMMETRIC_ELEMENTS`."""
    inertia: Float[Array, "*G 3"]
    """Base inertial parameters in Börner's order, as the method improves them [kg m^2]."""
    dof: Float[Array, "*G"]
    """Degrees of freedom: a quantile of Student's t with so many makes the intervals."""
    misfit: Float[Array, "*G"]
    """Mean square of the residuals over what was expected: far above one, something is wrong."""
    converged: Bool[Array, "*G"]
    """Whether the iteration came to rest within its limits."""
    delay: Float[Array, "*G"]
    """Of the motion after the command [s]."""
    trend: Float[Array, "*G 3"]
    """How much the elements 11, 12 and 22 of K change over the window, as a share of their middle."""


class Isolated(eqx.Module):
    """What a method makes of the trials."""

    deviations: Deviations
    cutoff: Numbers | None = None
    """(2,) cut-off frequencies of the high-pass [Hz], where there was one."""
    impedance: Impedance | None = None
    """Where the method estimates it."""


def known_handle(arm: KnownArm) -> Handle:
    """**Raises:** `ValueError` where it is not known."""
    if arm.handle is None:
        raise ValueError(
            "this method must know the mass and the damping that the robot gives its handle: state them in "
            "[trials.handle] of a job, or as KnownArm(handle=...), or use gomi_kawato"
        )
    return arm.handle
