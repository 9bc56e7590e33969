"""A reaching arm of two links and six muscles that holds a perturbing handle: Börner et al. 2020, 2.3.

Muscles are tense by activation and by their own springs and dampers, which pull the arm towards the movement that it
plans (eqs. 2, 3, 39 to 41). Activation is feedforward (the least that balances the planned movement), delayed feedback
and noise that grows with activation. The handle follows an admittance. `simulate` is a scan over the pure functions
`init` and `step`, by Heun's method at the sample rate of 4 kHz; position, velocity, acceleration and command of a
sample belong to the same instant.

The paper prints few constants. What it does not print is marked here: **calibrated** to a number that it does print, or
a **choice**. The moment arms and K1 are those of Selen, Franklin, Wolpert 2009, Table 1.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num, PRNGKeyArray

from jaximp.models.arm import coriolis_matrix, mass_matrix, rigid_body_torque
from jaximp.models.inertia import lakatos_from_borner
from jaximp.models.kinematics import ArmGeometry
from jaximp.motion.trajectories import MinimumJerk, RaisedSine, array_field
from jaximp.numerics.linear_algebra import solve_pair
from jaximp.perturbation.trials import VOLUNTARY_DELAY, Handle, Trials
from jaximp.signals.filters import butterworth, filter_from_zero
from jaximp.types import AnyArray

MUSCLES = (
    "shoulder flexor",
    "shoulder extensor",
    "elbow flexor",
    "elbow extensor",
    "biarticular flexor",
    "biarticular extensor",
)
RATE = 4000.0
"""Samples per second [Hz]; inferred from the paper's BIC less its AIC."""
ANGLES = np.array([k for k in range(1, 25) if k % 6]) * np.pi / 12
"""(20,) directions of the perturbations [rad]."""
POSTURES = np.array([[0.0, 0.35], [-0.1, 0.45], [0.0, 0.55], [0.1, 0.45], [0.0, 0.45]])
"""(5, 2) positions of the static task [m]. The paper prints -10 and 10 for the second and fourth x: read as 0.10 m."""
NEWTON_STEPS = 20
"""Enough for the feedforward: the muscles that pull change a few times and then no more."""


class NeuromuscularArm(eqx.Module):
    """The arm, its muscles, its nerves and the handle. Defaults: the paper's subject. `vmap` over any field."""

    lengths: Float[Any, "2"] = array_field(default=(0.29, 0.34))
    """Lengths of upper arm and forearm [m]."""
    inertia: Float[Any, "3"] = array_field(default=(0.1945, 0.0737, 0.0838))
    """Base inertial parameters in the order of the paper's eq. (12), `BASE_INERTIA` [kg m^2]: those that it prints."""
    moment_arms: Float[Any, "6 2"] = array_field(
        default=((0.0536, 0), (-0.0536, 0), (0, 0.0316), (0, -0.0267), (0.0386, 0.0427), (-0.0388, -0.0300))
    )
    """Moment arms of `MUSCLES` at shoulder and elbow [m], positive where they flex."""
    intrinsic_stiffness: Float[Any, "6"] = array_field(default=(1526, 1526, 961, 961, 4289, 4289))
    """Stiffness of a muscle without activation, K0 [N/m]. Calibrated: the mean stiffness during the perturbation is the
    paper's."""
    stiffness_per_force: Float[Any, ""] = array_field(default=75.0)
    """Stiffness that an activation of 1 N adds, K1 [1/m]."""
    damping_time: Float[Any, ""] = array_field(default=1 / 12)
    """Damping of a muscle over its stiffness [s]."""
    feedback_gain: Float[Any, ""] = array_field(default=0.3)
    """Gain of the delayed feedback, as a share of K0. A choice; 0 to 0.6 moves Table 1 by less than a tenth."""
    feedback_delay: float = eqx.field(static=True, default=VOLUNTARY_DELAY)
    """Delay of the feedback [s]; the paper's variation, equal to the voluntary delay."""
    noise_floor: Float[Any, ""] = array_field(default=4.4)
    """Activation noise of a muscle that is not active [N], times `neural_noise`. Calibrated."""
    noise_per_force: Float[Any, ""] = array_field(default=0.05)
    """What an activation of 1 N adds to that noise. Calibrated."""
    handle: Handle = Handle((5.0, 5.0), (20.0, 20.0))

    @property
    def geometry(self) -> ArmGeometry:
        # By `tree_at`: lengths may be traced, which the checks of the constructor do not take.
        return eqx.tree_at(lambda g: g.lengths, ArmGeometry((1.0, 1.0)), (self.lengths[0], self.lengths[1]))

    @property
    def xi(self) -> Array:
        """Base inertial parameters in the order of Lakatos et al. 2011 [kg m^2]."""
        return lakatos_from_borner(jnp.asarray(self.inertia))


class Reach(eqx.Module):
    """A straight movement of the hand between two rests, and when it is perturbed."""

    start: Float[Any, "2"] = array_field(default=(0.0, 0.30))
    """[m]"""
    goal: Float[Any, "2"] = array_field(default=(0.0, 0.55))
    """[m]"""
    duration: float = eqx.field(static=True, default=2.0)
    """Duration of the trial, T_mov [s]."""
    moving: Float[Any, ""] = array_field(default=1.241 / 2)
    """Share of it, in its middle, in which the hand moves, with least jerk. Calibrated to the peak speeds that the
    paper prints, which are 1.6 times those of a movement that takes all of the time."""
    trigger: Float[Any, ""] = array_field(default=0.40)
    """The perturbation begins at the first sample at which the hand is this far along the second axis [m]."""
    push_duration: float = eqx.field(static=True, default=0.07)
    """T_p,1 of the perturbation [s]; all of it lasts 2.5 times as long."""

    def __call__(self, t: Num[AnyArray, " N"]) -> tuple[Array, Array, Array]:
        """The planned motion of the hand (N, 2): position [m], velocity, acceleration."""
        duration = self.moving * self.duration
        motion = MinimumJerk(jnp.stack([jnp.asarray(self.start), jnp.asarray(self.goal)]), duration)
        return motion(jnp.asarray(t) - (self.duration - duration) / 2)


# One step is taken for all trials at a time: they are the last axis of every array, so that a processor works on
# several of them in one instruction.


class Drive(NamedTuple):
    """What the nerves intend at one instant."""

    q: Float[Array, "2 *#T"]
    """Planned angles of the joints [rad]."""
    dq: Float[Array, "2 *#T"]
    """[rad/s]"""
    activation: Float[Array, "6 *#T"]
    """Feedforward activation of the muscles [N]."""
    noise: Float[Array, "6 *T"]
    """See `neural_noise`."""


class ArmState(NamedTuple):
    """The state of the arm between two samples."""

    q: Float[Array, "2 *T"]
    """[rad]"""
    dq: Float[Array, "2 *T"]
    """[rad/s]"""
    onset: Int[Array, "*T"]
    """Sample of the perturbation's onset; the largest integer before it."""
    errors: Float[Array, "L 2 *T"]
    """Ring of the last errors of the joints (plus `damping_time` of their rates), which feedback has not seen yet."""


class ArmSample(NamedTuple):
    """What is recorded of one instant."""

    position: Float[Array, "2 *T"]
    """Position of the hand [m]."""
    velocity: Float[Array, "2 *T"]
    """Velocity of the hand [m/s]."""
    acceleration: Float[Array, "2 *T"]
    """Acceleration of the hand [m/s^2]."""
    command: Float[Array, "2 *T"]
    """Perturbing force [N]."""
    stiffness: Float[Array, "3 *T"]
    """True K11, K12, K22 of the joints [N m/rad]."""


class Push(NamedTuple):
    """When the perturbations begin, and how large they are."""

    trigger: Float[Array, ""]
    """Position along the second axis of the hand at which the perturbation begins [m]."""
    force: Float[Array, "2 *T"]
    """First peak [N]; zero in an unperturbed trial."""
    profile: Float[Array, " P"]
    """The force of a perturbation with a first peak of 1 N, sample by sample from the onset on; zero at its end."""


def perturbing_forces(key: PRNGKeyArray, repeats: int = 3, amplitude: float = 40.0) -> Float[Array, "T 2"]:
    """First peaks [N] of the perturbations of the dynamic task: all `ANGLES`, `repeats` times, in random order."""
    angles = jax.random.permutation(key, jnp.tile(ANGLES, repeats))
    return amplitude * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)


def neural_noise(
    key: PRNGKeyArray,
    trials: int,
    samples: int,
    amplitude: float | Num[AnyArray, ""] = 12.5,
    cutoff: float = 2.0,
) -> Float[Array, "T N 6"]:
    """Noise of the six muscles: normal numbers times `amplitude`, through a fifth-order low-pass that starts from rest.

    Its standard deviation is 0.40 once the filter has settled. (The paper gives filter and amplitude, not the unit:
    `noise_floor` and `noise_per_force` make an activation of it.)
    """
    low_pass = butterworth(5, cutoff, RATE)

    def of_trial(key: PRNGKeyArray) -> Array:
        return filter_from_zero(low_pass, amplitude * jax.random.normal(key, (samples, len(MUSCLES))))

    return jax.vmap(of_trial)(jax.random.split(key, trials))


def feedforward(
    arm: NeuromuscularArm, q: Num[AnyArray, "*N 2"], dq: Num[AnyArray, "*N 2"], ddq: Num[AnyArray, "*N 2"]
) -> Float[Array, "*N 6"]:
    """Least non-negative activations [N], in the sum of their squares, that move arm and handle as planned.

    They are `max(0, A nu)` with the moment arms A and two multipliers nu: the root of a monotone, piecewise linear
    equation, found by Newton's method. No co-contraction: a choice.
    """
    q, dq, ddq = (jnp.asarray(x) for x in (q, dq, ddq))
    geometry, A = arm.geometry, jnp.asarray(arm.moment_arms)
    held = arm.handle.force(jnp.zeros_like(q), *geometry.hand_motion(q, dq, ddq)[1:])
    torque = rigid_body_torque(q, dq, ddq, arm.xi) - geometry.joint_torque(q, held)

    def improve(_: Any, nu: Array) -> Array:
        pull = nu @ A.T
        active = (pull > 0).astype(pull.dtype)
        slope = jnp.einsum("...m,mi,mj->...ij", active, A, A) + 1e-12 * jnp.eye(2)
        return nu + solve_pair(slope, torque - (active * pull) @ A)

    nu = jax.lax.fori_loop(0, NEWTON_STEPS, improve, torque / (A**2).sum(axis=0))
    return jnp.maximum(nu @ A.T, 0)


def init(arm: NeuromuscularArm, drive: Drive) -> ArmState:
    """The state at the planned start, where the feedback has seen no error yet."""
    delay, trials = round(arm.feedback_delay * RATE), drive.noise.shape[1:]
    never = jnp.full(trials, np.iinfo(np.int32).max, jnp.int32)
    q, dq = (jnp.broadcast_to(x, (2, *trials)) for x in (drive.q, drive.dq))
    return ArmState(q, dq, never, jnp.zeros((delay + 1, 2, *trials), q.dtype))


def step(
    arm: NeuromuscularArm, push: Push, state: ArmState, k: Int[Array, ""], now: Drive, then: Drive
) -> tuple[ArmState, ArmSample]:
    """From sample k to the next by Heun's method. Returns the next state and what sample k is like."""
    q, dq = state.q, state.dq
    hand = arm.geometry.forward(jnp.moveaxis(q, 0, -1))
    onset = jnp.where((hand[..., 1] >= push.trigger) & (state.onset > k), k.astype(jnp.int32), state.onset)

    # One slot more than the delay: nothing is read before the ring is written, which then happens in place.
    slots = state.errors.shape[0]
    errors = state.errors.at[k % slots].set(now.q - q + arm.damping_time * (now.dq - dq))
    seen, seen_next = errors[(k + 1) % slots], errors[(k + 2) % slots]

    h = 1 / RATE
    command = _command(push, k - onset)
    ddq, activation = _acceleration(arm, q, dq, now, seen, command)
    ahead, velocity = q + h * dq, dq + h * ddq
    next_ddq, _ = _acceleration(arm, ahead, velocity, then, seen_next, _command(push, k + 1 - onset))
    motion = (jnp.moveaxis(x, 0, -1) for x in (q, dq, ddq))
    x, v, a = (jnp.moveaxis(x, -1, 0) for x in arm.geometry.hand_motion(*motion))
    sample = ArmSample(x, v, a, command, _stiffness(arm, activation))
    return ArmState(q + h / 2 * (dq + velocity), dq + h / 2 * (ddq + next_ddq), onset, errors), sample


def _command(push: Push, since: Array) -> Array:
    """Perturbing force [N], a number of samples after the onset."""
    return push.force * push.profile[jnp.clip(since, 0, len(push.profile) - 1)]


def _stiffness(arm: NeuromuscularArm, activation: Array) -> Array:
    """K11, K12, K22."""
    A = jnp.asarray(arm.moment_arms)
    products = jnp.stack([A[:, 0] ** 2, A[:, 0] * A[:, 1], A[:, 1] ** 2])
    stiffness = arm.intrinsic_stiffness[:, None] + arm.stiffness_per_force * activation
    return jnp.tensordot(products, stiffness, 1)


def _muscle_torque(arm: NeuromuscularArm, planned: Array, noise: Array, error: Array) -> tuple[Array, Array]:
    """Torque on the joints [N m], eqs. (2), (39) to (41), and the activation [N] with its noise.

    **Arguments:** `planned` activation, of which the noise depends; `error` of the joints plus `damping_time` of its
    rate.
    """
    A = jnp.asarray(arm.moment_arms)
    activation = planned + (arm.noise_floor + arm.noise_per_force * planned) * noise
    stiffness = arm.intrinsic_stiffness[:, None] + arm.stiffness_per_force * activation
    return jnp.tensordot(A.T, activation + stiffness * jnp.tensordot(A, error, 1), 1), activation


def _acceleration(
    arm: NeuromuscularArm, q: Array, dq: Array, drive: Drive, seen: Array, command: Array
) -> tuple[Array, Array]:
    """Acceleration of the joints [rad/s^2], and the activation of the muscles [N]."""
    gain = (arm.feedback_gain * arm.intrinsic_stiffness)[:, None]
    planned = drive.activation + gain * jnp.tensordot(jnp.asarray(arm.moment_arms), seen, 1)
    error = drive.q - q + arm.damping_time * (drive.dq - dq)
    torque, activation = _muscle_torque(arm, planned, drive.noise, error)

    return accelerate(arm, q, dq, torque, command), activation


def accelerate(
    arm: NeuromuscularArm,
    q: Float[Array, "2 *T"],
    dq: Float[Array, "2 *T"],
    torque: Float[Array, "2 *T"],
    command: Float[Array, "2 *T"],
) -> Float[Array, "2 *T"]:
    """Acceleration of the joints [rad/s^2] of arm and handle under the muscles' torque [N m] and a command [N]."""
    angles, rates, handle = jnp.moveaxis(q, 0, -1), jnp.moveaxis(dq, 0, -1), arm.handle
    J, M = arm.geometry.jacobian(angles), mass_matrix(angles, arm.xi)
    C = coriolis_matrix(angles, rates, arm.xi)
    _, v, centripetal = arm.geometry.hand_motion(angles, rates, jnp.zeros_like(rates))
    outside = handle.force(jnp.moveaxis(command, 0, -1), v, centripetal)
    carried = handle.mass + handle.own_mass  # the handle moves with the hand
    # Sums of two written out, as a reduction over so short an axis costs more than all the rest.
    left = [
        torque[i] - sum(C[..., i, j] * dq[j] for j in (0, 1)) + sum(J[..., k, i] * outside[..., k] for k in (0, 1))
        for i in (0, 1)
    ]
    (a, b), (_, d) = (
        [M[..., i, j] + sum(carried[k] * J[..., k, i] * J[..., k, j] for k in (0, 1)) for j in (0, 1)] for i in (0, 1)
    )
    return jnp.stack([d * left[0] - b * left[1], a * left[1] - b * left[0]]) / (a * d - b * b)


class Reaches(eqx.Module):
    """Simulated movements and the truth behind them."""

    movements: Trials
    stiffness: Float[Array, "*T N 3"]
    """K11, K12, K22 of the joints [N m/rad]; the damping is the arm's `damping_time` of it."""


def reach(arm: NeuromuscularArm, task: Reach, forces: Num[AnyArray, "T 2"], noise: Num[AnyArray, "T N 6"]) -> Reaches:
    """T movements, each with its perturbing force and its noise.

    A pure function: `vmap` over arms and tasks; trials of many simulations go in as one.

    **Arguments:** `forces` (T, 2) first peaks of the perturbations [N], as `perturbing_forces` gives; zero leaves a
    movement unperturbed, and the same noise then gives its twin. `noise` (T, N, 6) as `neural_noise` gives, N samples
    at 4 kHz; zero for none.

    **Source:** Börner et al. 2020, 2.3.1 and 2.3.2 (dynamic task).
    """
    noise = jnp.asarray(noise, float)
    time = jnp.arange(noise.shape[1]) / RATE
    q, dq, ddq = arm.geometry.joint_motion(*task(time))
    push = Push(jnp.asarray(task.trigger), jnp.asarray(forces, float).T, _force_profile(arm, task))
    activation = feedforward(arm, q, dq, ddq)
    drives = Drive(q[..., None], dq[..., None], activation[..., None], jnp.moveaxis(noise, 0, -1))
    first = jax.tree.map(lambda x: x[0], drives)
    # The last sample has no next one: its own drive does.
    later = jax.tree.map(lambda x: jnp.concatenate([x[1:], x[-1:]]), drives)

    def advance(carry: tuple[ArmState, Drive], x: tuple[Array, Drive]) -> tuple[tuple[ArmState, Drive], ArmSample]:
        state, sample = step(arm, push, carry[0], x[0], carry[1], x[1])
        return (state, x[1]), sample

    (state, _), samples = jax.lax.scan(advance, (init(arm, first), first), (jnp.arange(len(time)), later))
    x, v, a, command, stiffness = (jnp.moveaxis(x, -1, 0) for x in samples)
    return Reaches(Trials(x, v, a, arm.handle.force(command, v, a), command, state.onset, RATE), stiffness)


def hold_posture(
    arm: NeuromuscularArm,
    postures: Num[AnyArray, "T 2"],
    angles: Num[AnyArray, " T"],
    noise: Num[AnyArray, "T N 6"],
    onset: float = 1.0,
    displacement: float = 0.008,
    duration: float = 0.16,
) -> Trials:
    """The arm keeps a posture while the handle moves out and back, whatever the force: the static task of 2.3.2.

    The subject does not intervene: no feedback, and no activation but noise.

    **Arguments:** `postures` (T, 2) of the hand [m] and `angles` (T,) of the perturbations [rad]; the handle moves by
    `displacement` [m] with the profile's first part of `duration` [s], from `onset` [s] on (a choice: the noise starts
    at zero and must settle). `noise` as in `reach`.
    """
    noise = jnp.asarray(noise, float)
    time = jnp.arange(noise.shape[1]) / RATE - onset
    out = RaisedSine.of_displacement(displacement, duration)(time)
    direction = jnp.stack([jnp.cos(jnp.asarray(angles)), jnp.sin(jnp.asarray(angles))], axis=-1)[:, None]
    x, v, a = (profile[:, None] * direction for profile in out)
    x = jnp.asarray(postures)[:, None] + x
    q, dq, ddq = arm.geometry.joint_motion(x, v, a)
    rest = arm.geometry.inverse(jnp.asarray(postures))[:, None]
    lanes = jnp.moveaxis(rest - q - arm.damping_time * dq, -1, 0).reshape(2, -1)
    by_muscle = jnp.moveaxis(noise, -1, 0).reshape(len(MUSCLES), -1)
    torque = jnp.moveaxis(_muscle_torque(arm, jnp.zeros(()), by_muscle, lanes)[0].reshape(2, *q.shape[:2]), 0, -1)
    transposed = arm.geometry.jacobian(q).swapaxes(-1, -2)
    force = solve_pair(transposed, rigid_body_torque(q, dq, ddq, arm.xi) - torque)
    first = jnp.full(len(x), round(onset * RATE), jnp.int32)
    return Trials(x, v, a, force, jnp.zeros_like(x), first, RATE)


def _force_profile(arm: NeuromuscularArm, task: Reach) -> Array:
    """The force that the handle alone would follow, eqs. (27) to (29), for a first peak of 1 N."""
    mass, damping = arm.handle.mass[0], arm.handle.damping[0]
    t = np.arange(round(2.5 * task.push_duration * RATE) + 2) / RATE
    _, v, a = RaisedSine.of_force(1.0, task.push_duration, mass, damping)(t)
    return mass * a + damping * v
