"""What a perturbation adds to a motion, at the hand and at the joints, where the arm's inertia is known.

Deviations become impedance by `joint_deviations`, whose rows `torque = D velocity + K displacement` are those of
`stiffness.fit_stiffness`: eqs. (19) to (23), (37), (38) of Börner et al. 2020.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaximp.models.arm import rigid_body_torque
from jaximp.models.inertia import BaseInertia, lakatos_from_borner
from jaximp.models.kinematics import ArmGeometry
from jaximp.perturbation.trials import Handle, Trials, in_window
from jaximp.types import AnyArray


def _in_borner_order(inertia: Any) -> Any:
    """As `array_field` makes them."""
    if isinstance(inertia, BaseInertia):
        return inertia.borner
    return inertia if isinstance(inertia, jax.Array) else np.asarray(inertia, np.float64)


class KnownArm(eqx.Module):
    """What is known before the perturbed movements are looked at."""

    geometry: ArmGeometry
    inertia: Float[Any, "3"] = eqx.field(converter=_in_borner_order)
    """Of the arm: a `BaseInertia`, or three numbers **in Börner's order** (eq. (12); `BASE_INERTIA` names them), as
    `static_inertia` gives them [kg m^2]. Kept as these three numbers."""
    handle: Handle | None = None
    """Of the robot: output error and feedback jerk isolation must know what it does."""
    inertia_stderr: Float[Any, "3"] | None = None
    """Of `inertia`, their standard errors in the same order [kg m^2], where a method can use them."""

    def with_inertia(self, inertia: BaseInertia | Num[AnyArray, "3"]) -> KnownArm:
        """The same arm with another inertia, in the same order."""
        return KnownArm(self.geometry, inertia, self.handle, self.inertia_stderr)

    @property
    def xi(self) -> Array:
        """Base inertial parameters in the order of Lakatos et al. 2011 [kg m^2]."""
        return lakatos_from_borner(jnp.asarray(self.inertia))


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


class JointDeviations(eqx.Module):
    """Deviations as the joints feel them: `torque = D velocity + K displacement`."""

    displacement: Float[Array, "*T S 2"]
    """Unperturbed less perturbed angles [rad]."""
    velocity: Float[Array, "*T S 2"]
    """[rad/s]"""
    torque: Float[Array, "*T S 2"]
    """Of the handle on the joints, less what the inertia of the arm takes [N m]."""


@eqx.filter_jit
def joint_deviations(
    perturbed: Trials, deviations: Deviations, arm: KnownArm, linearised: bool = False
) -> JointDeviations:
    """Rows of the impedance model, with the inertia known: eqs. (19) to (23), (37) of Börner et al. 2020.

    **Arguments:** `linearised` takes the change of the inertial torque to first order around the unperturbed movement,
    as Gomi and Kawato 1997 do.
    """
    seen = in_window(perturbed, deviations.position.shape[-2])
    measured = arm.geometry.joint_motion(seen.position, seen.velocity, seen.acceleration)
    unperturbed = arm.geometry.joint_motion(
        seen.position + deviations.position,
        seen.velocity + deviations.velocity,
        seen.acceleration + deviations.acceleration,
    )
    change = jax.tree.map(jnp.subtract, unperturbed, measured)

    def inertial(q: Array, dq: Array, ddq: Array) -> Array:
        return rigid_body_torque(q, dq, ddq, arm.xi)

    to_first_order = jax.jvp(inertial, unperturbed, change)[1]
    body = to_first_order if linearised else inertial(*unperturbed) - inertial(*measured)
    outside = arm.geometry.joint_torque(unperturbed[0], seen.force + deviations.force)
    outside -= arm.geometry.joint_torque(measured[0], seen.force)
    return JointDeviations(change[0], change[1], outside - body)
