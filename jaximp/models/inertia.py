"""Base inertial parameters of an arm of two links, by name and in the two orders that papers use.

With `I_i` the moment of inertia of link i about its own joint, `m_i` its mass, `c_i` the distance of its centre of mass
from that joint, and `l1` the length of the upper arm, an arm without gravity is known by three numbers [kg m^2]:

| name here            | what it is       | Börner et al. 2020, eq. (12) | Lakatos et al. 2011, eq. (13) |
| -------------------- | ---------------- | ---------------------------- | ----------------------------- |
| `upper_arm_inertia`  | `I_1 + m_2 l1^2` | first                        | first, with the forearm's on top |
| `forearm_inertia`    | `I_2`            | second                       | third                         |
| `coupling_inertia`   | `m_2 c_2 l1`     | third                        | second                        |

So the same number has another place, and the first is another number. `PlanarArm` calls Lakatos's three `inertia_1` to
`inertia_3`; Börner's are never numbered here, but called by these names. In signatures `xi` is always Lakatos's order
and `pi` Börner's.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaximp.types import AnyArray

BASE_INERTIA = {
    "upper_arm_inertia": "I_1 + m_2 l1^2",
    "forearm_inertia": "I_2",
    "coupling_inertia": "m_2 c_2 l1",
}
"""Börner's three base inertial parameters [kg m^2], in his order, and what they are made of: their names in every
table, summary and message."""


class BaseInertia(eqx.Module):
    """Base inertial parameters of an arm, each by its name: what to pass where an order might be mixed up.

    `BaseInertia(upper_arm, forearm, coupling)`, or `from_lakatos(xi)`, such as the first three estimates of a
    `PlanarArm`, or `from_borner(pi)`, such as those of `static_inertia`. All of them are in kg m^2.
    """

    upper_arm: Float[Any, "*M"]
    """`I_1 + m_2 l1^2`: of the upper arm about the shoulder, with the forearm's mass at the elbow."""
    forearm: Float[Any, "*M"]
    """`I_2`: of the forearm (with the hand) about the elbow."""
    coupling: Float[Any, "*M"]
    """`m_2 c_2 l1`: by which the motion of one joint is felt at the other."""

    def __init__(self, upper_arm: Any, forearm: Any, coupling: Any):
        self.upper_arm, self.forearm, self.coupling = (jnp.asarray(x, float) for x in (upper_arm, forearm, coupling))

    @classmethod
    def from_lakatos(cls, xi: BaseInertia | Num[AnyArray, "*M 3"]) -> BaseInertia:
        """From `(I_1 + m_2 l1^2 + I_2, m_2 c_2 l1, I_2)`: `inertia_1` to `inertia_3` of `PlanarArm`."""
        return xi if isinstance(xi, BaseInertia) else cls.from_borner(borner_from_lakatos(xi))

    @classmethod
    def from_borner(cls, pi: BaseInertia | Num[AnyArray, "*M 3"]) -> BaseInertia:
        """From `(I_1 + m_2 l1^2, I_2, m_2 c_2 l1)`: eq. (12) of Börner et al. 2020."""
        if isinstance(pi, BaseInertia):
            return pi
        pi = jnp.asarray(pi)
        return cls(pi[..., 0], pi[..., 1], pi[..., 2])

    @property
    def borner(self) -> Float[Array, "*M 3"]:
        """In the order of Börner et al. 2020, eq. (12), which is that of `BASE_INERTIA`."""
        return jnp.stack([self.upper_arm, self.forearm, self.coupling], axis=-1)

    @property
    def lakatos(self) -> Float[Array, "*M 3"]:
        """In the order of Lakatos et al. 2011, eq. (13)."""
        return lakatos_from_borner(self.borner)

    def check(self) -> BaseInertia:
        """The same, if some rigid body has this inertia.

        **Raises:** ValueError if none has: where a number is not above zero, or the mass matrix of a straight arm not
        positive definite. (Not every mixed up order is impossible.) Traced values are not looked at.
        """
        if any(isinstance(x, jax.core.Tracer) for x in (self.upper_arm, self.forearm, self.coupling)):
            return self
        upper_arm, forearm, coupling = (np.asarray(x) for x in (self.upper_arm, self.forearm, self.coupling))
        with np.errstate(invalid="ignore"):
            possible = (np.minimum(np.minimum(upper_arm, forearm), coupling) > 0) & (upper_arm * forearm > coupling**2)
        if not possible.all():
            k = tuple(np.argwhere(~possible)[0])
            raise ValueError(
                f"no rigid body has the inertia upper_arm = {upper_arm[k]:.4g}, forearm = {forearm[k]:.4g}, coupling = "
                f"{coupling[k]:.4g} kg m^2 (I_1 + m_2 l1^2, I_2, m_2 c_2 l1): all must be above zero, and the first "
                "times the second above the square of the third; if they came as three numbers, check their order: "
                "BaseInertia.from_lakatos and BaseInertia.from_borner take different ones"
            )
        return self


def borner_from_lakatos(xi: Num[AnyArray, "*M 3"]) -> Float[Array, "*M 3"]:
    """Base inertial parameters [kg m^2] as Börner et al. 2020, eq. (12), order them, from those of Lakatos et al."""
    xi = jnp.asarray(xi)
    return jnp.stack([xi[..., 0] - xi[..., 2], xi[..., 2], xi[..., 1]], axis=-1)


def lakatos_from_borner(pi: Num[AnyArray, "*M 3"]) -> Float[Array, "*M 3"]:
    """Base inertial parameters [kg m^2] as in eq. (13) of Lakatos et al. 2011, from those of Börner et al. 2020."""
    pi = jnp.asarray(pi)
    return jnp.stack([pi[..., 0] + pi[..., 1], pi[..., 2], pi[..., 1]], axis=-1)
