"""Where the hand of a planar arm is, and back: angles and torques of the joints, position and force of the hand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from jaximp.models.arm import two_numbers
from jaximp.models.joint import sine_and_cosine
from jaximp.numerics.compilation import is_traced
from jaximp.numerics.linear_algebra import solve_pair
from jaximp.types import AnyArray

ROUNDING = 16
"""How many roundings beyond the reach, as a share of its square, still count as a straight or a folded arm."""


Pair = tuple[Any, Any]
"""Two numbers, which may be traced."""


class ArmGeometry(eqx.Module):
    """Kinematics of an arm of two links with the angles of `PlanarArm`.

    `x = l1 cos q1 + l2 cos(q1 + q2)`, `y = l1 sin q1 + l2 sin(q1 + q2)`, from the shoulder.

    **Arguments:** `lengths` of upper arm and forearm [m]; `shoulder` where it is in the frame in which the hand is
    measured [m], whose axes must be those of the angles; `elbow` is the side of the line from shoulder to hand on
    which the elbow lies, seen from the shoulder: `right` (`q2 >= 0`, a right arm seen from above) or `left`
    (`q2 <= 0`).
    """

    lengths: tuple[float, float]
    """Of upper arm and forearm [m]."""
    shoulder: tuple[float, float]
    """Position of the shoulder [m]."""
    elbow: str = eqx.field(static=True)
    """`right` (`q2 >= 0`) or `left` (`q2 <= 0`)."""

    def __init__(
        self,
        lengths: Sequence[float] | Num[AnyArray, "2"],
        elbow: str = "right",
        shoulder: Sequence[float] | Num[AnyArray, "2"] = (0.0, 0.0),
    ):
        if elbow not in ("right", "left"):
            raise ValueError(f"elbow is '{elbow}': it must be 'right' or 'left' of the line from shoulder to hand")
        self.lengths = two_numbers("lengths", lengths, lowest=0.0, above=True)
        self.shoulder = two_numbers("shoulder", shoulder)
        self.elbow = elbow

    def forward(self, q: Num[ArrayLike, "... 2"]) -> Float[Array, "... 2"]:
        """Position of the hand [m] at the angles `q` [rad]."""
        (sine1, cosine1), (sine, cosine) = _upper_arm_and_forearm(q)
        l1, l2 = self.lengths
        x, y = self.shoulder
        return jnp.stack([x + l1 * cosine1 + l2 * cosine, y + l1 * sine1 + l2 * sine], axis=-1)

    def jacobian(self, q: Num[ArrayLike, "... 2"]) -> Float[Array, "... 2 2"]:
        """`J` [m/rad] with `dx = J dq`; singular where the arm is straight or folded."""
        return _jacobian(jnp.asarray(q), self.lengths)

    def velocity(self, q: Num[ArrayLike, "... 2"], dq: Num[ArrayLike, "... 2"]) -> Float[Array, "... 2"]:
        """Velocity of the hand [m/s] at the angles `q` [rad] and velocities `dq` [rad/s] of the joints."""
        return (self.jacobian(q) * jnp.asarray(dq)[..., None, :]).sum(axis=-1)

    def hand_motion(
        self, q: Num[ArrayLike, "... 2"], dq: Num[ArrayLike, "... 2"], ddq: Num[ArrayLike, "... 2"]
    ) -> tuple[Float[Array, "... 2"], Float[Array, "... 2"], Float[Array, "... 2"]]:
        """Position of the hand [m], velocity and acceleration from those of the joints [rad]."""
        towards = _centripetal(jnp.asarray(q), jnp.asarray(dq), self.lengths)
        return self.forward(q), self.velocity(q, dq), self.velocity(q, ddq) - towards

    def joint_motion(
        self, x: Num[ArrayLike, "... 2"], v: Num[ArrayLike, "... 2"], a: Num[ArrayLike, "... 2"]
    ) -> tuple[Float[Array, "... 2"], Float[Array, "... 2"], Float[Array, "... 2"]]:
        """Angles [rad], velocities and accelerations of the joints from those of the hand [m].

        **Raises:** as `inverse`.
        """
        q = self.inverse(x)
        return q, *_joint_rates(q, jnp.asarray(v), jnp.asarray(a), self.lengths)

    def joint_torque(self, q: Num[ArrayLike, "... 2"], force: Num[ArrayLike, "... 2"]) -> Float[Array, "... 2"]:
        """Torques of the joints [N m] that a force on the hand [N] makes, `J' force`: Börner et al. 2020, eq. (23)."""
        return _joint_torque(self.jacobian(q), jnp.asarray(force))

    def inverse(self, x: Num[ArrayLike, "... 2"]) -> Float[Array, "... 2"]:
        """Angles [rad] that bring the hand to `x` [m]; a position that is NaN has angles that are NaN.

        The shoulder angle is within a half turn of the x axis. A straight or folded arm (`q2` of 0 or a half turn) is
        found too, but an error of `x` shows there as its square root, and no derivative exists. With the hand on the
        shoulder, which takes links of equal length, any shoulder angle would do and one of them is returned.

        **Raises:** ValueError that gives the reach if a position lies out of it. Inside `jit`, `vmap` and `grad`, where
        values are not known, the angles of such a position are NaN instead.

        **Source:** Börner et al. 2020, eqs. (21) and (22), with the quadrant of every angle.
        """
        side = 1.0 if self.elbow == "right" else -1.0
        angles, unreachable = _angles(jnp.asarray(x), self.shoulder, self.lengths, side)
        if not is_traced(unreachable) and bool(unreachable.any()):
            raise ValueError(self._out_of_reach(np.asarray(x) - self.shoulder, np.asarray(unreachable)))
        return angles

    def _out_of_reach(self, x: np.ndarray, unreachable: np.ndarray) -> str:
        l1, l2 = self.lengths
        first = tuple(np.argwhere(unreachable)[0])
        where = f" (index {', '.join(str(i) for i in first)})" if first else ""
        count = f"{unreachable.sum()} of {unreachable.size} positions" if first else "the position"
        px, py = x[first]
        return (
            f"{count} cannot be reached: ({px:g}, {py:g}) m{where} is {np.hypot(px, py):.6g} m from the shoulder, and "
            f"an arm of {l1:g} m and {l2:g} m reaches from {abs(l1 - l2):.6g} m to {l1 + l2:.6g} m"
        )


@jax.jit
def _jacobian(q: Array, lengths: Pair) -> Array:
    (sine1, cosine1), (sine, cosine) = _upper_arm_and_forearm(q)
    l1, l2 = lengths
    of_x = jnp.stack([-l1 * sine1 - l2 * sine, -l2 * sine], axis=-1)
    of_y = jnp.stack([l1 * cosine1 + l2 * cosine, l2 * cosine], axis=-1)
    return jnp.stack([of_x, of_y], axis=-2)


@jax.jit
def _joint_rates(q: Array, v: Array, a: Array, lengths: Pair) -> tuple[Array, Array]:
    J = _jacobian(q, lengths)
    dq = solve_pair(J, v)
    return dq, solve_pair(J, a + _centripetal(q, dq, lengths))


@jax.jit
def _joint_torque(J: Array, force: Array) -> Array:
    return (J * force[..., :, None]).sum(axis=-2)


@jax.jit
def _centripetal(q: Array, dq: Array, lengths: Pair) -> Array:
    """Acceleration of the hand towards the joints [m/s^2], at constant velocities of the joints: `-dJ/dt dq`."""
    (sine1, cosine1), (sine, cosine) = _upper_arm_and_forearm(q)
    first = dq[..., 0]
    upper, fore = lengths[0] * first**2, lengths[1] * (first + dq[..., 1]) ** 2
    return jnp.stack([upper * cosine1 + fore * cosine, upper * sine1 + fore * sine], axis=-1)


@jax.jit
def _angles(x: Array, shoulder: Pair, lengths: Pair, side: Any) -> tuple[Array, Array]:
    """Angles of `ArmGeometry.inverse`, and which positions have none."""
    x = jnp.stack([x[..., k] - shoulder[k] for k in (0, 1)], axis=-1)
    l1, l2 = lengths
    squared = (x * x).sum(axis=-1)
    beyond, within = (l1 + l2) ** 2 - squared, squared - (l1 - l2) ** 2
    slack = ROUNDING * float(jnp.finfo(jnp.result_type(x, float)).eps) * (l1 + l2) ** 2
    unreachable = (beyond < -slack) | (within < -slack)
    # Twice the forearm in the frame of the upper arm; across it by Heron's formula for the area of the triangle.
    along = (squared - l1**2 - l2**2) / l1
    across = side * jnp.sqrt(jnp.maximum(beyond, 0.0) * jnp.maximum(within, 0.0)) / l1
    hand = 2 * l1 + along
    first = jnp.arctan2(x[..., 1] * hand - x[..., 0] * across, x[..., 0] * hand + x[..., 1] * across)
    angles = jnp.stack([first, jnp.arctan2(across, along)], axis=-1)
    return jnp.where(unreachable[..., None], jnp.nan, angles), unreachable


def _upper_arm_and_forearm(q: ArrayLike) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Sine and cosine of the absolute angle of each link."""
    q = jnp.asarray(q)
    return sine_and_cosine(q[..., 0]), sine_and_cosine(q[..., 0] + q[..., 1])
