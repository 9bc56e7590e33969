"""The one-joint rig of Tout et al. 2023, section IV: a geared motor moves a handle that a human, or rubber bands, hold.

All angles, torques and parameters are those of the motor side; the handle turns by `q / gear_ratio`. A human at the
handle with impedance {J_h, B_h, K_h} appears here divided by `gear_ratio**2`, eqs. (19) and (20).

`simulate_rig` is a scan over the pure functions `init` and `step`. The joint is integrated at
`sample_rate * substeps` (10 kHz) and recorded at `sample_rate` (1 kHz). Position, velocity, acceleration and torque of
a record belong to the same instant: eq. (18) holds between them to rounding while the joint moves.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaximp.motion.trajectories import FourierSeries, array_field
from jaximp.types import Recording

GRAVITY = 9.81
"""Gravitational acceleration [m/s^2]."""

ROBOT_TRAJECTORY = FourierSeries(
    sine=np.array([-7.1616, -0.00156, -2.93474, 0.00127, -0.69249]),
    cosine=np.array([1.76787, 0.00031, 2.60642, -0.00122, 1.83504]),
    offset=-0.20653,
    period=10.0,
)
"""A motion that excites the robot, for the simulation of Tout et al. 2023, IV-B: order 5, 10 s, within 0.7 rad.

The paper does not print its coefficients. These come from `experiments/rig_trajectory.py`; the observation matrix of
the robot, eq. (18), has the condition number 11.41 over one period."""

HUMAN_TRAJECTORY = FourierSeries(
    sine=np.array([5.43693, 2.31497, 1.75894, 2.01806, -0.13565, -1.10232, 0.47234]),
    cosine=np.array([2.07337, -2.71132, 0.51375, 1.03478, 0.51381, -0.45768, -0.71195]),
    offset=3.10464,
    period=10.0,
)
"""A motion that excites the human, for the bands of Tout et al. 2023, V-A: order 7, 10 s, within 0.7 rad.

The observation matrix of the human, eq. (19), has the condition number 1.732 over one period, which is its lower bound.
(The paper designs on quantised signals; the encoder's step is small against this motion and is left out.)"""


Scalar = Float[Any, ""]
"""One parameter of a module; see `array_field`."""


class Human(eqx.Module):
    """Whatever holds the handle: an inertia that moves with the motor, and a torque that opposes the motion."""

    inertia: eqx.AbstractVar[Scalar]
    """Inertia at the motor side [kg m^2]."""

    @abstractmethod
    def torque(
        self, t: Float[Array, "*batch"], q: Float[Array, "*batch"], dq: Float[Array, "*batch"]
    ) -> Float[Array, "*batch"]:
        """Elastic and damping torque [N m] that the robot applies on the human, at the motor side.

        **Arguments:** `t` time [s], `q` motor angle [rad], `dq` motor velocity [rad/s].
        """


class HumanLoad(Human):
    """Inertia, damping and a stiffness that steps once: `B dq + K(t) (q - equilibrium)` and `J ddq`.

    **Source:** Tout et al. 2023, eq. (20); the defaults are the ground truth of IV-B, a massless human whose stiffness
    doubles after half a period of 10 s.
    """

    stiffness: Scalar = array_field(default=1e-3)
    """Stiffness before `step_time` [N m/rad]."""
    stiffness_after: Scalar = array_field(default=2e-3)
    """Stiffness from `step_time` on [N m/rad]."""
    damping: Scalar = array_field(default=0.0)
    """[N m s/rad]."""
    inertia: Scalar = array_field(default=0.0)
    """[kg m^2]."""
    step_time: Scalar = array_field(default=5.0)
    """[s]."""
    equilibrium: Scalar = array_field(default=0.0)
    """Motor angle at which the elastic torque vanishes [rad]."""

    def torque(
        self, t: Float[Array, "*batch"], q: Float[Array, "*batch"], dq: Float[Array, "*batch"]
    ) -> Float[Array, "*batch"]:
        stiffness = jnp.where(t < self.step_time, self.stiffness, self.stiffness_after)
        return self.damping * dq + stiffness * (q - self.equilibrium)


class ElasticBands(Human):
    """Two bundles of rubber bands that pull the handle in opposite directions and go slack, Tout et al. 2023, V-A.

    `torque = k_plus relu(x + p_plus) - k_minus relu(p_minus - x)`, x = q. Bands of one side resist positive motion and
    go slack at q = -p_plus; those of the other side go slack at q = p_minus.

    From the paper: the stiffness 1.13e-3 N m/rad of all four bands, two on each side, of which two are removed (its
    Fig. 3 shows this at 10 s). **Assumed here:** one band is removed on each side, so that both stiffnesses halve; the
    pretensions, of which the paper says only that they were slightly unequal (these keep every band taut over the whole
    range of the handle; smaller ones let one side go slack); no damping.
    """

    stiffness_plus: Scalar = array_field(default=0.565e-3)
    """Stiffness of the bundle that resists positive motion [N m/rad]."""
    stiffness_minus: Scalar = array_field(default=0.565e-3)
    """Stiffness of the bundle that resists negative motion [N m/rad]."""
    pretension_plus: Scalar = array_field(default=14.0)
    """Stretch of the first bundle at q = 0, as a motor angle [rad]."""
    pretension_minus: Scalar = array_field(default=11.0)
    """Stretch of the second bundle at q = 0, as a motor angle [rad]."""
    fraction_after: Scalar = array_field(default=0.5)
    """Share of both stiffnesses that is left from `step_time` on."""
    step_time: Scalar = array_field(default=10.0)
    """[s]."""
    damping: Scalar = array_field(default=0.0)
    """[N m s/rad]."""
    inertia: Scalar = array_field(default=0.0)
    """[kg m^2]."""
    gear_ratio: Scalar = array_field(default=15.0)
    """Motor angle per handle angle; used by `lever_arm` only."""
    lever_arm: bool = eqx.field(static=True, default=False)
    """True: the bands pull along a fixed direction, so that stretch and lever arm follow the sine and cosine of the
    handle's angle (x = gear_ratio sin(q / gear_ratio), torque times cos(q / gear_ratio)). The paper names the shrinking
    lever arm as the reason why it underestimates the stiffness, without giving the geometry."""

    def torque(
        self, t: Float[Array, "*batch"], q: Float[Array, "*batch"], dq: Float[Array, "*batch"]
    ) -> Float[Array, "*batch"]:
        handle = q / self.gear_ratio
        stretch = self.gear_ratio * jnp.sin(handle) if self.lever_arm else q
        plus = self.stiffness_plus * jnp.maximum(stretch + self.pretension_plus, 0.0)
        minus = self.stiffness_minus * jnp.maximum(self.pretension_minus - stretch, 0.0)
        elastic = jnp.where(t < self.step_time, 1.0, self.fraction_after) * (plus - minus)
        return self.damping * dq + (elastic * jnp.cos(handle) if self.lever_arm else elastic)


class Rig(eqx.Module):
    """Motor, handle, encoder and controller.

    The dynamics are eq. (18) of Tout et al. 2023 with the values of its IV-A. The paper gives no gains of its PID
    controller: those below are a **choice**, as is the noise. They make the loop cross over at 15.5 Hz with a phase
    margin of 45 degrees; on `ROBOT_TRAJECTORY` the handle stays within 0.2 mrad of the reference when free and
    4 mrad (0.6 mrad rms) when held by the default `HumanLoad`, most of it just after the stiffness steps. Stiffer
    gains follow better, but turn the encoder's quantisation into a torque ripple beyond the noise of the torque.
    """

    gravity_x: Scalar = array_field(default=1.518e-3)
    """First moment, torque `gravity_x g sin(q / gear_ratio)` [kg m]."""
    gravity_y: Scalar = array_field(default=0.0)
    """First moment, torque `gravity_y g cos(q / gear_ratio)` [kg m]."""
    viscous_friction: Scalar = array_field(default=1.45e-4)
    """[N m s/rad]."""
    coulomb_friction: Scalar = array_field(default=2.479e-3)
    """[N m]."""
    inertia: Scalar = array_field(default=1.9e-5)
    """Motor shaft and handle [kg m^2]."""
    gear_ratio: Scalar = array_field(default=15.0)
    """Motor angle per handle angle."""

    encoder_step: Scalar = array_field(default=2 * np.pi / 2000)
    """Quantisation of the measured motor angle [rad]; 0 is not allowed."""
    torque_noise: Scalar = array_field(default=5e-4)
    """Standard deviation of the white noise of a torque sample [N m]."""

    proportional: Scalar = array_field(default=0.08)
    """Proportional gain of the controller [N m/rad]."""
    integral: Scalar = array_field(default=1.2)
    """Integral gain of the controller [N m/(rad s)]."""
    derivative: Scalar = array_field(default=1.6e-3)
    """[N m s/rad]."""
    derivative_time: Scalar = array_field(default=4.5e-3)
    """Time constant of the first-order filter on the derivative [s]."""
    feed_forward: bool = eqx.field(static=True, default=True)
    """Whether eq. (18) of the reference is added to the controller's torque."""

    sample_rate: float = eqx.field(static=True, default=1000.0)
    """Records per second [Hz]."""
    substeps: int = eqx.field(static=True, default=10)
    """Integration steps per record."""

    @property
    def time_step(self) -> float:
        """Integration step [s]."""
        return 1.0 / (self.sample_rate * self.substeps)

    def gravity_torque(self, q: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Torque [N m] that holds the handle at the motor angle `q` [rad]."""
        handle = q / self.gear_ratio
        return GRAVITY * (self.gravity_x * jnp.sin(handle) + self.gravity_y * jnp.cos(handle))

    def inverse_dynamics(
        self, q: Float[Array, "*batch"], dq: Float[Array, "*batch"], ddq: Float[Array, "*batch"]
    ) -> Float[Array, "*batch"]:
        """Motor torque [N m] of the motion (q [rad], dq [rad/s], ddq [rad/s^2]) with a free handle, eq. (18)."""
        friction = self.viscous_friction * dq + self.coulomb_friction * jnp.sign(dq)
        return self.inertia * ddq + friction + self.gravity_torque(q)


class Setpoint(NamedTuple):
    """What the controller is asked to do at one instant (or at many, when stacked)."""

    time: Float[Array, "*batch"]
    """[s]."""
    position: Float[Array, "*batch"]
    """[rad]."""
    velocity: Float[Array, "*batch"]
    """[rad/s]."""
    acceleration: Float[Array, "*batch"]
    """[rad/s^2]."""


class RigState(NamedTuple):
    """Joint and controller between two integration steps."""

    position: Float[Array, ""]
    """Motor angle [rad] at this step."""
    velocity: Float[Array, ""]
    """Motor velocity [rad/s], half a step earlier."""
    integral_torque: Float[Array, ""]
    """[N m]."""
    filtered_error: Float[Array, ""]
    """Low-passed tracking error of the derivative [rad]."""


class RigSample(NamedTuple):
    """The truth at one integration step."""

    encoder: Float[Array, ""]
    """Quantised motor angle [rad]."""
    position: Float[Array, ""]
    """[rad]."""
    velocity: Float[Array, ""]
    """[rad/s]."""
    acceleration: Float[Array, ""]
    """[rad/s^2]."""
    motor_torque: Float[Array, ""]
    """[N m]."""
    human_torque: Float[Array, ""]
    """[N m]."""


class RigMotion(eqx.Module):
    """What the rig measures, and the truth behind it. Every array has one value for each of the N records."""

    time: Float[Array, " N"]
    """Time from zero on [s]."""
    position: Float[Array, " N"]
    """Measured: quantised motor angle [rad]."""
    torque: Float[Array, " N"]
    """Measured: motor torque with noise [N m]."""
    reference: Float[Array, " N"]
    """Motor angle that the controller was asked to follow [rad]."""
    true_position: Float[Array, " N"]
    """[rad]."""
    true_velocity: Float[Array, " N"]
    """[rad/s]."""
    true_acceleration: Float[Array, " N"]
    """[rad/s^2]."""
    motor_torque: Float[Array, " N"]
    """Motor torque without noise [N m]."""
    human_torque: Float[Array, " N"]
    """Torque that the robot applies on the human, its inertia included, at the motor side [N m]."""


def init(rig: Rig, human: Human, setpoint: Setpoint) -> RigState:
    """The joint moves as the setpoint says, and the integrator holds the torque for that: no transient at the start."""
    position = setpoint.position
    velocity = setpoint.velocity - 0.5 * rig.time_step * setpoint.acceleration
    error = setpoint.position - _encode(rig, position)
    human_torque = human.torque(setpoint.time, position, setpoint.velocity) + human.inertia * setpoint.acceleration
    torque = rig.inverse_dynamics(*setpoint[1:]) + human_torque
    return RigState(position, velocity, torque - _feed_forward(rig, setpoint) - rig.proportional * error, error)


def step(rig: Rig, human: Human, state: RigState, setpoint: Setpoint) -> tuple[RigState, RigSample]:
    """One integration step: encoder, controller, joint. Returns the next state and the truth at this one.

    The velocity lives between the steps (semi-implicit Euler, read as a leapfrog), so that the recorded velocity and
    acceleration are the central differences of the position, without a shift against the torque. Viscous friction acts
    on the mean of the velocities before and after the step. The damping of the human acts on the one before, which
    looks like an inertia of -damping * time_step / 2 (5e-5 s times the damping). The impulse of Coulomb friction takes
    at most all of the momentum that the step would otherwise end with: it stops the joint, holds it, and never
    reverses it.
    """
    h = rig.time_step
    encoder = _encode(rig, state.position)
    torque, integral_torque, filtered_error = _controller(rig, state, setpoint, encoder)

    inertia = rig.inertia + human.inertia
    resistance = human.torque(setpoint.time, state.position, state.velocity)
    drag = 0.5 * h * rig.viscous_friction
    momentum = (inertia - drag) * state.velocity
    momentum += h * (torque - rig.gravity_torque(state.position) - resistance)
    stopping = h * rig.coulomb_friction
    velocity = (momentum - jnp.clip(momentum, -stopping, stopping)) / (inertia + drag)

    acceleration = (velocity - state.velocity) / h
    sample = RigSample(
        encoder=encoder,
        position=state.position,
        velocity=0.5 * (state.velocity + velocity),
        acceleration=acceleration,
        motor_torque=torque,
        human_torque=resistance + human.inertia * acceleration,
    )
    return RigState(state.position + h * velocity, velocity, integral_torque, filtered_error), sample


def _encode(rig: Rig, position: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.round(position / rig.encoder_step) * rig.encoder_step


def _feed_forward(rig: Rig, setpoint: Setpoint) -> Float[Array, ""]:
    if not rig.feed_forward:
        return jnp.zeros(())
    return rig.inverse_dynamics(setpoint.position, setpoint.velocity, setpoint.acceleration)


def _controller(
    rig: Rig, state: RigState, setpoint: Setpoint, encoder: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """PID torque [N m], the integrator's next torque [N m] and the next filtered error [rad]."""
    error = setpoint.position - encoder
    rate = (error - state.filtered_error) / rig.derivative_time
    torque = rig.proportional * error + rig.derivative * rate + state.integral_torque + _feed_forward(rig, setpoint)
    h = rig.time_step
    return torque, state.integral_torque + h * rig.integral * error, state.filtered_error + h * rate


@eqx.filter_jit
def simulate_rig(
    rig: Rig,
    reference: Callable[[Array], tuple[Array, Array, Array]],
    duration: float,
    human: Human | None = None,
    key: PRNGKeyArray | None = None,
) -> RigMotion:
    """The rig follows `reference`, with a free handle (data R) or held by a human (data RH).

    A pure function: `jit` and `vmap` work over the parameters of rig and human, the coefficients of the reference and
    the noise key. Many keys for the same motion cost one simulation, since the noise does not act back.

    **Arguments:** `reference` gives motor angle [rad], velocity and acceleration at a time, e.g. `FourierSeries`;
    `duration` [s], a plain number; `human` holds the handle, None leaves it free; `key` draws the torque noise, None
    leaves it out.

    **Returns:** `RigMotion` of N = duration * sample_rate records, the first at 0 s.
    """
    if human is None:
        human = HumanLoad(stiffness=0.0, stiffness_after=0.0)
    n_records = round(duration * rig.sample_rate)

    def setpoints(record: Float[Array, ""]) -> Setpoint:
        time = (record * rig.substeps + jnp.arange(rig.substeps, dtype=float)) * rig.time_step
        return Setpoint(time, *reference(time))

    def one_record(state: RigState, record: Float[Array, ""]) -> tuple[RigState, tuple[Array, Array, RigSample]]:
        points = setpoints(record)
        state, samples = jax.lax.scan(lambda s, point: step(rig, human, s, point), state, points)
        return state, (points.time[0], points.position[0], jax.tree.map(lambda x: x[0], samples))

    start = init(rig, human, jax.tree.map(lambda x: x[0], setpoints(jnp.zeros(()))))
    _, (time, position, truth) = jax.lax.scan(one_record, start, jnp.arange(n_records, dtype=float))
    noise = 0.0 if key is None else rig.torque_noise * jax.random.normal(key, (n_records,))
    return RigMotion(
        time=time,
        position=truth.encoder,
        torque=truth.motor_torque + noise,
        reference=position,
        true_position=truth.position,
        true_velocity=truth.velocity,
        true_acceleration=truth.acceleration,
        motor_torque=truth.motor_torque,
        human_torque=truth.human_torque,
    )


def record(motion: RigMotion, name: str) -> Recording:
    """The measured part of a simulation, and the reference, as the recording of one revolute joint."""
    time, position, torque, reference = (
        np.asarray(x, np.float64) for x in (motion.time, motion.position, motion.torque, motion.reference)
    )
    return Recording(
        time=time,
        position=position[:, None],
        torque=torque[:, None],
        valid=np.ones(len(time), bool),
        joints=("revolute",),
        reference=reference[:, None],
        name=name,
    )
