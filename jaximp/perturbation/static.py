"""Inertia of an arm from perturbed postures, the static task: Börner et al. 2020, 2.2.3."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaximp.models.arm import PlanarArm
from jaximp.models.inertia import borner_from_lakatos
from jaximp.models.kinematics import ArmGeometry
from jaximp.numerics.lanes import solve_definite
from jaximp.perturbation.trials import Trials, check_directions, farthest, in_window, window_samples
from jaximp.types import AnyArray

_INERTIA = PlanarArm(impedance=False)


class StaticFit(eqx.Module):
    """What perturbed postures tell of the arm."""

    inertia: Float[Array, "3"]
    """Base inertial parameters in Börner's order (`BASE_INERTIA`) [kg m^2]."""
    inertia_stderr: Float[Array, "3"]
    """[kg m^2], from how much the trials contradict each other."""
    theta: Float[Array, "11"]
    """All parameters, in the order and units of `PlanarArm`."""


def static_inertia(trials: Trials, geometry: ArmGeometry, window: float = 0.4, linearised: bool = False) -> StaticFit:
    """Base inertial parameters from perturbed postures, with damping and stiffness: eqs. (30) to (35).

    All 11 parameters are solved for over all trials together. The unperturbed state is that of the onset. Within a
    trial residuals are anything but independent, so that the standard errors count trials and not samples.

    **Arguments:** `linearised` takes the inertial torque to first order, as Gomi and Kawato 1997 do.

    **Raises:** `ValueError` for a window longer than the trials, and for perturbations that do not span the plane.

    **Source:** Börner et al. 2020, 2.2.3.
    """
    seen = in_window(trials, window_samples(trials, window))
    x = np.asarray(seen.position)
    check_directions(farthest(x - x[:, :1]), f"{len(trials)} trials")
    return static_fit(seen, geometry, jnp.ones(seen.position.shape[1], bool), jnp.asarray(linearised))


@eqx.filter_jit
def static_fit(
    seen: Trials, geometry: ArmGeometry, inside: Bool[AnyArray, " S"], linearised: Bool[Array, ""]
) -> StaticFit:
    """`static_inertia` from trials that were cut to their window, of the samples `inside` a shorter one."""
    model = PlanarArm((0.0, 0.0))

    def normal_equations(trial: Trials) -> tuple[Array, Array]:
        q, dq, ddq = geometry.joint_motion(trial.position, trial.velocity, trial.acceleration)
        # To first order the body is where it was, and does not move.
        body = jnp.where(linearised, q[0], q), jnp.where(linearised, 0, dq), ddq
        W = jnp.concatenate([_INERTIA.regressor(*body), model.at(q[0]).regressor(q, dq, ddq)[..., 3:]], axis=-1)
        W = jnp.where(inside[:, None, None], W, 0)
        torque = geometry.joint_torque(q, trial.force)
        return jnp.einsum("snp,snq->pq", W, W), jnp.einsum("snp,sn->p", W, torque - torque[:1])

    grams, moments = jax.vmap(normal_equations)(seen)
    # Units of radians and their derivatives differ by orders of magnitude: the columns are scaled.
    size = jnp.sqrt(jnp.diagonal(grams.sum(axis=0)))
    grams, moments = grams / jnp.multiply.outer(size, size), moments / size
    gram = grams.sum(axis=0)
    theta = solve_definite(gram, moments.sum(axis=0)[:, None])[:, 0]
    influence = solve_definite(gram, (moments - grams @ theta).T) * jnp.sqrt(len(moments) / (len(moments) - 1))
    # The inertia in the order of eq. (12) is a linear function of the parameters.
    of_inertia = jax.vmap(borner_from_lakatos, 1, 1)((influence / size[:, None])[:3])
    theta = theta / size
    return StaticFit(borner_from_lakatos(theta[:3]), jnp.sqrt((of_inertia**2).sum(axis=1)), theta)
