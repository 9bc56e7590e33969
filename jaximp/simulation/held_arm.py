"""An arm in the hand of a position-controlled robot that perturbs it: Lakatos et al. 2011, IV-A and IV-B.

The robot imposes the motion, so that it is known exactly and only the force on the hand answers: rigid body, and the
damping and stiffness of the muscles, which rise when reflexes set in. Or a cuff that yields stands between robot and
hand: then the robot knows its own position, not that of the hand. Where the paper gives no number (impedance, noise,
strength of the reflexes, cuff) the defaults are a **choice**, meant to be swept.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num, PRNGKeyArray

from jaximp.models.arm import mass_matrix, rigid_body_torque
from jaximp.models.kinematics import ArmGeometry
from jaximp.motion.trajectories import MinimumJerk, array_field
from jaximp.numerics.linear_algebra import solve_pair
from jaximp.types import AnyArray

DIRECTIONS = np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [1, -1], [-1, 1]]) * 0.05
"""(6, 2) perturbation amplitudes [rad] of Lakatos et al. 2011, IV-B."""
LATENCIES = (0.025, 0.05, 0.11)
"""When the stretch reflex, the spinal reflex and the long-latency reflexes set in [s], ibid., I-B."""


class HeldArm(eqx.Module):
    """The subject's arm, and what the robot measures with."""

    lengths: tuple[float, float] = eqx.field(static=True, default=(0.29, 0.34))
    """Lengths of upper arm and forearm [m]."""
    inertia: Float[Any, "3"] = array_field(default=(0.26815, 0.08375, 0.07367))
    """Base inertial parameters in the order of Lakatos et al. 2011 [kg m^2]: the arm of Börner et al. 2020."""
    damping: Float[Any, "2 2"] = array_field(default=((2.42, 1.20), (1.20, 1.42)))
    """Damping before any reflex [N m s/rad]: a choice, a twelfth of the stiffness."""
    stiffness: Float[Any, "2 2"] = array_field(default=((29.05, 14.37), (14.37, 17.08)))
    """Stiffness before any reflex [N m/rad]: a choice, the mean of Börner et al. 2020."""
    posture: Float[Any, "2"] = array_field(default=(0.08, 1.0))
    """Angles at rest [rad]."""
    hand_force: Float[Any, "2"] = array_field(default=(5.0, 0.0))
    """Force with which the subject presses at rest [N]; its torque stays the same throughout."""
    reflex_gain: Float[Any, ""] = array_field(default=0.5)
    """Share by which stiffness and damping have risen when all reflexes have set in; each brings a third. A choice."""
    rise: Float[Any, ""] = array_field(default=0.02)
    """Time in which each reflex comes in [s]. A choice."""
    yields: bool = eqx.field(static=True, default=False)
    """Whether there is a cuff that yields between robot and hand, and flesh under it."""
    cuff_stiffness: Float[Any, ""] = array_field(default=10e3)
    """Stiffness of the cuff along both axes [N/m], if it yields. A choice."""
    cuff_damping: Float[Any, ""] = array_field(default=40.0)
    """Damping of the cuff [N s/m]. A choice."""
    force_noise: Float[Any, ""] = array_field(default=0.05)
    """Standard deviation of the white noise of each force [N]. A choice."""
    position_noise: Float[Any, ""] = array_field(default=1e-5)
    """Standard deviation of the white noise of each position of the hand [m]. A choice."""

    @property
    def geometry(self) -> ArmGeometry:
        return ArmGeometry(self.lengths)

    def impedance(self, t: Num[AnyArray, "*t"]) -> tuple[Float[Array, "*t 2 2"], Float[Array, "*t 2 2"]]:
        """Damping and stiffness at the time `t` [s] after the onset."""
        set_in = jnp.asarray(t)[..., None] - jnp.asarray(LATENCIES)
        factor = 1 + self.reflex_gain * jnp.clip(set_in / self.rise, 0, 1).mean(axis=-1)
        factor = factor[..., None, None]
        return factor * self.damping, factor * self.stiffness


class HeldTrials(eqx.Module):
    """What the robot measures in T trials of N samples, and the truth behind it."""

    time: Float[Array, " N"]
    """Time from the onset of the perturbation [s]."""
    position: Float[Array, "T N 2"]
    """Measured position of the hand [m]."""
    force: Float[Array, "T N 2"]
    """Measured force on the hand [N]."""
    angles: Float[Array, "T N 2"]
    """True angles of the joints [rad]."""
    velocities: Float[Array, "T N 2"]
    """True velocities of the joints [rad/s]."""
    accelerations: Float[Array, "T N 2"]
    """True accelerations of the joints [rad/s^2]."""
    torque: Float[Array, "T N 2"]
    """True torque of the outside force on the joints [N m]."""


def hold(
    arm: HeldArm,
    amplitudes: Num[AnyArray, "T 2"],
    duration: float | Num[AnyArray, ""],
    time: Num[AnyArray, " N"],
    key: PRNGKeyArray | None = None,
) -> HeldTrials:
    """The robot moves the joints by each of the `amplitudes` [rad], on a polynomial of fifth order.

    A pure function: `vmap` over durations, arms and noise keys.

    **Arguments:** `duration` of the movement [s], from the onset on; `time` [s] of the samples, evenly spaced, the
    onset at zero and the beginning before it; `key` draws the noise, None leaves it out.

    **Source:** Lakatos et al. 2011, eqs. (9), (16), IV-B.
    """
    t = jnp.asarray(time)
    imposed = imposed_motion(amplitudes, duration, t)
    position = arm.geometry.forward(arm.posture + imposed[0])
    if arm.yields:
        q, dq = _through_the_cuff(arm, jnp.asarray(amplitudes), jnp.asarray(duration, float), t)
        force = _cuff_force(arm, q, dq, position, arm.geometry.velocity(arm.posture + imposed[0], imposed[1]))
        torque = arm.geometry.joint_torque(q, force)
        ddq = _acceleration(arm, t, q, dq, torque)
    else:
        q, dq, ddq = arm.posture + imposed[0], *imposed[1:]
        torque = rigid_body_torque(q, dq, ddq, jnp.asarray(arm.inertia)) + _muscles(arm, t, q, dq)
        force = solve_pair(arm.geometry.jacobian(q).swapaxes(-1, -2), torque)
    if key is not None:
        keys = jax.random.split(key)
        position += arm.position_noise * jax.random.normal(keys[0], position.shape)
        force += arm.force_noise * jax.random.normal(keys[1], force.shape)
    return HeldTrials(t, position, force, q, dq, ddq, torque)


def imposed_motion(
    amplitudes: Num[AnyArray, "T 2"], duration: float | Num[AnyArray, ""], t: Num[AnyArray, " N"]
) -> tuple[Array, Array, Array]:
    """Displacement [rad], velocity and acceleration (T, N, 2) of the joints if the hand follows the robot: eq. (16)."""
    profile = MinimumJerk(jnp.array([0.0, 1.0]), jnp.asarray(duration, float))(jnp.asarray(t))
    away, dq, ddq = (jnp.multiply.outer(x, jnp.asarray(amplitudes)).swapaxes(0, 1) for x in profile)
    return away, dq, ddq


def _muscles(arm: HeldArm, t: Array, q: Array, dq: Array) -> Array:
    """Torque [N m] that holds against damping, stiffness, and what the subject presses with."""
    D, K = arm.impedance(t)
    pressed = arm.geometry.joint_torque(arm.posture, arm.hand_force)
    return (D * dq[..., None, :] + K * (q - arm.posture)[..., None, :]).sum(axis=-1) + pressed


def _acceleration(arm: HeldArm, t: Array, q: Array, dq: Array, torque: Array) -> Array:
    """Acceleration of the joints under the torque of an outside force [rad/s^2]."""
    xi = jnp.asarray(arm.inertia)
    left = torque - _muscles(arm, t, q, dq) - rigid_body_torque(q, dq, jnp.zeros_like(dq), xi)
    return solve_pair(mass_matrix(q, xi), left)


def _cuff_force(arm: HeldArm, q: Array, dq: Array, robot: Array, robot_velocity: Array) -> Array:
    """Force on the hand [N] of a spring and a damper between it and the robot; at rest that of the subject."""
    apart = robot - arm.geometry.forward(q)
    slip = robot_velocity - arm.geometry.velocity(q, dq)
    return arm.hand_force + arm.cuff_stiffness * apart + arm.cuff_damping * slip


def _through_the_cuff(arm: HeldArm, amplitudes: Array, duration: Array, t: Array) -> tuple[Array, Array]:
    """Angles and velocities (T, N, 2) of an arm that the cuff drags along: Runge and Kutta's method, one step a sample.

    The robot's motion is needed between the samples as well; the acceleration of the arm is not.
    """
    h = t[1] - t[0]

    def rate(t: Array, state: tuple[Array, Array]) -> tuple[Array, Array]:
        q, dq = state
        away, velocity, _ = (x[:, 0] for x in imposed_motion(amplitudes, duration, t[None]))
        robot = arm.geometry.forward(arm.posture + away), arm.geometry.velocity(arm.posture + away, velocity)
        torque = arm.geometry.joint_torque(q, _cuff_force(arm, q, dq, *robot))
        return dq, _acceleration(arm, t, q, dq, torque)

    def step(state: tuple[Array, Array], t: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        def moved(by: Array, slope: tuple[Array, Array]) -> tuple[Array, Array]:
            return state[0] + by * slope[0], state[1] + by * slope[1]

        first = rate(t, state)
        second = rate(t + h / 2, moved(h / 2, first))
        third = rate(t + h / 2, moved(h / 2, second))
        fourth = rate(t + h, moved(h, third))
        slopes = zip(first, second, third, fourth, strict=True)
        mean = [(k1 + 2 * k2 + 2 * k3 + k4) / 6 for k1, k2, k3, k4 in slopes]
        return moved(h, (mean[0], mean[1])), state

    rest = jnp.broadcast_to(jnp.asarray(arm.posture), amplitudes.shape)
    q, dq = jax.lax.scan(step, (rest, jnp.zeros_like(rest)), t)[1]
    return q.swapaxes(0, 1), dq.swapaxes(0, 1)
