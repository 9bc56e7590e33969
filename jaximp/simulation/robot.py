"""A robot of n joints that follows a motion by PID control: rigid links, rotors, friction, encoders, noisy torques."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from jaximp.models.base import Model
from jaximp.models.chain import Chain
from jaximp.models.tip import TipImpedance
from jaximp.motion.trajectories import FourierSeries, at_rest
from jaximp.types import AnyArray, Numbers

Three = tuple[Array, Array, Array]
STEPS, STEP_RATE = 4, 1000
"""Steps of the integration for each sample, at least, and how many a second [Hz], at least."""
GRADUAL = 0.02
"""Velocity around which dry friction turns [rad/s or m/s]; a jump would need smaller steps."""
REACH, SPEED, FARTHEST, FASTEST = 0.6, 0.6, 1.5, 2.0
"""Of an exciting motion: shares of the URDF's limits of position and velocity, and what it never exceeds
[rad, rad/s; m, m/s]."""
UNLIKE, ROTOR = 0.1, 0.1
"""How far links of the real robot are from its URDF, and rotors as a share of what a joint moves on the mean."""


@dataclass(frozen=True)
class RobotDrive:
    """Controller and sensors of every joint."""

    rate: float = 500.0
    """Samples per second, of the controller and of the recording [Hz]."""
    bandwidth: float = 6.0
    """Of the PID loop [Hz]."""
    encoder_step: float = 2 * np.pi / 2**17
    """[rad or m]"""
    torque_noise: float = 0.005
    """Standard deviation of the white noise of each motor's torque, as a share of the URDF's effort limit."""


class RobotRecording(NamedTuple):
    """What is measured, and the truth."""

    time: Float[AnyArray, " N"]
    """[s]"""
    position: Float[AnyArray, "N n"]
    """By the encoders [rad or m]."""
    torque: Float[AnyArray, "N n"]
    """Of the motors, with noise [N m or N]."""
    true_position: Float[AnyArray, "N n"]
    true_torque: Float[AnyArray, "N n"]


def true_parameters(chain: Chain, seed: int = 0) -> Numbers:
    """(P,) standard parameters of a robot like its URDF: links heavier or lighter by some `UNLIKE`, and rotors.

    A link's ten parameters change by one factor, so that a rigid body can have them.
    """
    found = np.array(chain.standard_parameters)
    factor = 1 + UNLIKE * np.random.default_rng(seed).normal(size=chain.tree.n_bodies)
    found[: 10 * len(factor)] *= np.repeat(factor, 10)
    moved = np.diag(np.asarray(chain.mass_matrix(np.zeros(chain.n_joints))))
    names = chain.base.standard_names
    for k, size in enumerate(moved):
        name = f"joint{k + 1}.rotor_inertia"
        if name in names:
            found[names.index(name)] = ROTOR * size
    return found


def exciting_motion(chain: Chain, period: float = 10.0, harmonics: int = 5, seed: int = 0) -> FourierSeries:
    """A random periodic motion of all joints within the URDF's limits, which begins and ends at rest."""
    low, high = (np.clip(x, -FARTHEST / REACH, FARTHEST / REACH) for x in (chain.limits.lower, chain.limits.upper))
    random = np.random.default_rng(seed)
    shape = (chain.n_joints, harmonics)
    series = at_rest(FourierSeries(random.normal(size=shape), random.normal(size=shape), period=period))
    position, velocity, _ = (np.asarray(x) for x in series(jnp.linspace(0, period, 1000)))
    fastest = np.minimum(SPEED * chain.limits.velocity, FASTEST)
    scale = np.minimum(REACH * (high - low) / 2 / np.abs(position).max(axis=0), fastest / np.abs(velocity).max(axis=0))
    middle = (low + high) / 2
    return FourierSeries(series.sine * scale[:, None], series.cosine * scale[:, None], middle, period)


def simulate_robot(
    chain: Chain,
    parameters: Float[AnyArray, " P"],
    motion: FourierSeries,
    duration: float,
    drive: RobotDrive | None = None,
    seed: int = 0,
    human: tuple[TipImpedance, Float[AnyArray, " h"]] | None = None,
) -> RobotRecording:
    """A robot that follows a motion for some `duration` [s].

    **Arguments:** the `chain`, with friction and rotors where the robot has some; its true standard `parameters`
    (`Chain.base.standard_names`); the `motion` that its controller is asked for; the `human` who holds its end, by
    model and parameters, of whom the controller knows nothing.

    **Raises:** `ValueError` for a motion of other joints, and for a duration of less than a second.
    """
    drive = RobotDrive() if drive is None else drive
    if motion.sine.shape[:-1] != (chain.n_joints,):
        raise ValueError(f"the motion is one of {motion.sine.shape[:-1]} joints, the robot has {chain.n_joints}")
    if not 1.0 <= duration <= 3600.0:
        raise ValueError(f"duration is {duration:g} s: it must last from 1 s to an hour")
    time = np.arange(round(duration * drive.rate)) / drive.rate
    theta = np.asarray(chain.base.map) @ np.asarray(parameters)
    steps = max(STEPS, int(np.ceil(STEP_RATE / drive.rate)))
    asked = motion(jnp.asarray(np.arange(steps * len(time)) / (steps * drive.rate)))
    found = _follow(chain, theta, asked, steps * drive.rate, drive.bandwidth, human)
    position, torque = (np.asarray(x)[::steps] for x in found)
    random = np.random.default_rng(seed)
    effort = np.where(np.isfinite(chain.limits.effort), chain.limits.effort, np.abs(torque).max(axis=0))
    noise = drive.torque_noise * effort * random.normal(size=torque.shape)
    read = np.round(position / drive.encoder_step) * drive.encoder_step if drive.encoder_step else position
    return RobotRecording(time, read, torque + noise, position, torque)


def _follow(
    chain: Chain,
    theta: Numbers,
    asked: tuple[Array, ...],
    rate: float,
    bandwidth: float,
    human: tuple[TipImpedance, Numbers] | None,
) -> tuple[Array, Array]:
    """(S, n) position and motor torque at every step, of a controller that expects the URDF's own torque."""
    model, true = chain.smoothed(GRADUAL), jnp.asarray(theta)
    expected = model.observation_matrix(*asked) @ jnp.asarray(chain.parameters)
    if human is not None:
        model, true = model + human[0], jnp.concatenate([true, jnp.asarray(human[1], float)])
    size = _mass_and_rest(model, true, asked[0].mean(axis=0), jnp.zeros(chain.n_joints))[0].diagonal()
    return _followed(model, true, size, (asked[0], asked[1], expected), rate, bandwidth)


@partial(jax.jit, static_argnums=(4, 5))
def _followed(
    model: Model, theta: Array, size: Array, asked: Three, rate: float, bandwidth: float
) -> tuple[Array, Array]:
    """By `rate` steps of semi-implicit Euler a second; the controller is a PID of each joint, and expects a torque."""
    dt, omega = 1 / rate, 2 * jnp.pi * bandwidth
    proportional, integral, derivative = size * omega**2, size * omega**3 / 10, size * 2 * omega

    def step(state: Three, wanted: Three) -> tuple[Three, tuple[Array, Array]]:
        (q, dq, summed), (position, velocity, expected) = state, wanted
        error = position - q
        torque = expected + proportional * error + derivative * (velocity - dq) + integral * summed
        mass, rest = _mass_and_rest(model, theta, q, dq)
        dq = dq + dt * jnp.linalg.solve(mass, torque - rest)
        return (q + dt * dq, dq, summed + dt * error), (q, torque)

    start = (asked[0][0], asked[1][0], jnp.zeros_like(size))
    found: tuple[Array, Array] = lax.scan(step, start, asked)[1]
    return found


def _mass_and_rest(model: Model, theta: Array, q: Array, dq: Array) -> tuple[Array, Array]:
    """(n, n) mass matrix with rotors, and (n,) all other torque, by one look at n + 2 accelerations and velocities."""
    n = len(q)
    at, fast = jnp.broadcast_to(q, (n + 2, n)), jnp.zeros((n + 2, n)).at[n + 1].set(dq)
    torque = model.observation_matrix(at, fast, jnp.eye(n + 2, n)) @ theta
    return (torque[:n] - torque[n]).T, torque[n + 1]
