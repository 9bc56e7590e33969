"""The simulated rig of Tout et al. 2023: physics, alignment of its signals, and its transformations."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaximp.simulation.rig import (
    GRAVITY,
    ROBOT_TRAJECTORY,
    ElasticBands,
    Human,
    HumanLoad,
    Rig,
    RigMotion,
    RigSample,
    RigState,
    Setpoint,
    init,
    record,
    simulate_rig,
    step,
)

TRUTH = {"gravity_x": 1.518e-3, "gravity_y": 0.0, "viscous": 1.45e-4, "coulomb": 2.479e-3, "inertia": 1.9e-5}
FREE = HumanLoad(stiffness=0.0, stiffness_after=0.0)


def setpoint(time: float) -> Setpoint:
    return Setpoint(jnp.asarray(time), *ROBOT_TRAJECTORY(time))


def regressor(q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> np.ndarray:
    return np.stack([GRAVITY * np.sin(q / 15), GRAVITY * np.cos(q / 15), dq, np.sign(dq), ddq], axis=1)


def robot_parameters(q: np.ndarray, dq: np.ndarray, ddq: np.ndarray, torque: np.ndarray) -> dict[str, float]:
    moving = np.abs(dq) > 0.1
    theta, *_ = np.linalg.lstsq(regressor(q, dq, ddq)[moving], torque[moving])
    return dict(zip(TRUTH, theta.tolist(), strict=True))


@pytest.mark.parametrize(
    ("rig", "human", "limit_mrad"),
    [
        pytest.param(Rig(), None, 0.2, id="R"),
        pytest.param(Rig(), HumanLoad(), 4.0, id="RH"),
        pytest.param(Rig(), ElasticBands(), 2.0, id="bands"),
        pytest.param(Rig(feed_forward=False), HumanLoad(), 5.0, id="RH without feed-forward"),
    ],
)
def test_handle_follows_the_reference(rig: Rig, human: Human | None, limit_mrad: float) -> None:
    motion = simulate_rig(rig, ROBOT_TRAJECTORY, 10.0, human)
    error = np.asarray(motion.reference - motion.true_position) / 15 * 1e3
    assert np.abs(error).max() < limit_mrad
    # No transient at the start: the error is that of the later motion (before the stiffness steps), up to one count.
    count_mrad = 2 * np.pi / 2000 / 15 * 1e3
    assert np.abs(error[:100]).max() < np.abs(error[500:4500]).max() + count_mrad


@pytest.mark.parametrize(
    "human", [None, HumanLoad(), HumanLoad(inertia=1e-5, damping=1e-4, equilibrium=0.5), ElasticBands(lever_arm=True)]
)
def test_equation_of_motion_holds_between_the_records(human: Human | None) -> None:
    motion = simulate_rig(Rig(), ROBOT_TRAJECTORY, 10.0, human)
    q, dq, ddq = (np.asarray(x) for x in (motion.true_position, motion.true_velocity, motion.true_acceleration))
    found = robot_parameters(q, dq, ddq, np.asarray(motion.motor_torque - motion.human_torque))
    assert found == pytest.approx(TRUTH, rel=1e-8, abs=1e-12)


def test_positions_and_torques_are_aligned() -> None:
    """With a fine encoder, differences of the recorded positions suffice. One sample of delay must show."""
    motion = simulate_rig(Rig(encoder_step=1e-9), ROBOT_TRAJECTORY, 10.0)
    q, torque = np.asarray(motion.position), np.asarray(motion.torque)
    dq, ddq = (q[2:] - q[:-2]) / 2e-3, (q[2:] - 2 * q[1:-1] + q[:-2]) / 1e-6
    assert robot_parameters(q[1:-1], dq, ddq, torque[1:-1]) == pytest.approx(TRUTH, rel=1e-4, abs=1e-9)
    late = robot_parameters(q[1:-1], dq, ddq, torque[:-2])
    assert abs(late["inertia"] / TRUTH["inertia"] - 1) > 5e-3


def test_human_parameters_are_in_the_human_torque() -> None:
    human = HumanLoad(inertia=1e-5, damping=1e-4, stiffness=1e-3, stiffness_after=1e-3, equilibrium=0.5)
    motion = simulate_rig(Rig(), ROBOT_TRAJECTORY, 10.0, human)
    columns = [motion.true_acceleration, motion.true_velocity, motion.true_position, jnp.ones_like(motion.time)]
    theta, *_ = np.linalg.lstsq(np.stack(columns, axis=1), np.asarray(motion.human_torque))
    np.testing.assert_allclose(theta, [1e-5, 1e-4, 1e-3, -5e-4], rtol=2e-3)


def test_stiffness_steps_at_its_time() -> None:
    motion = simulate_rig(Rig(), ROBOT_TRAJECTORY, 10.0, HumanLoad())
    stiffness = np.asarray(motion.human_torque / motion.true_position)
    np.testing.assert_allclose(stiffness[:5000], 1e-3, rtol=1e-9)
    np.testing.assert_allclose(stiffness[5001:], 2e-3, rtol=1e-9)


@eqx.filter_jit
def swing(rig: Rig, human: Human, position: jax.Array, velocity: jax.Array) -> RigSample:
    """Two seconds of the joint without motor."""
    rig = eqx.tree_at(lambda r: (r.proportional, r.integral, r.derivative), rig, (jnp.zeros(()),) * 3)
    start = RigState(position, velocity, jnp.zeros(()), jnp.zeros(()))
    points = Setpoint(*(jnp.zeros(20_000) for _ in range(4)))
    return jax.lax.scan(lambda s, p: step(rig, human, s, p), start, points)[1]


def coast(velocity: float, **friction: float) -> np.ndarray:
    """Velocities of the joint without motor, gravity and human."""
    rig = Rig(gravity_x=0.0, feed_forward=False, **friction)
    return np.asarray(swing(rig, FREE, jnp.zeros(()), jnp.asarray(velocity)).velocity)


@pytest.mark.parametrize("velocity", [5.0, -5.0])
def test_coulomb_friction_stops_the_joint_and_holds_it(velocity: float) -> None:
    speeds = coast(velocity, viscous_friction=0.0) * np.sign(velocity)
    time_to_rest = 5.0 * TRUTH["inertia"] / TRUTH["coulomb"]
    at_rest = int(np.flatnonzero(speeds == 0.0)[0])
    assert at_rest * 1e-4 == pytest.approx(time_to_rest, abs=2e-4)
    assert np.all(np.diff(speeds[:at_rest]) < 0)
    assert np.all(speeds[at_rest:] == 0.0)


def test_viscous_friction_decays_exponentially() -> None:
    speeds = coast(5.0, coulomb_friction=0.0)[:2000]
    times = 1e-4 * (np.arange(2000) + 0.5)
    np.testing.assert_allclose(speeds, 5.0 * np.exp(-TRUTH["viscous"] / TRUTH["inertia"] * times), rtol=1e-6)


def test_energy_is_kept_without_friction() -> None:
    rig = Rig(viscous_friction=0.0, coulomb_friction=0.0, feed_forward=False)
    human = HumanLoad(stiffness=1e-3, stiffness_after=1e-3)
    truth = swing(rig, human, jnp.asarray(9.0), jnp.zeros(()))
    height = 15 * TRUTH["gravity_x"] * GRAVITY * (1 - jnp.cos(truth.position / 15))
    energy = 0.5 * TRUTH["inertia"] * truth.velocity**2 + height + 0.5e-3 * truth.position**2
    np.testing.assert_allclose(energy, energy[0], rtol=1e-5)


def test_bands_go_slack_and_lose_half_of_their_stiffness() -> None:
    bands = ElasticBands(pretension_plus=6.0, pretension_minus=4.0)
    q = jnp.asarray([-8.0, -1.0, 0.0, 5.0])
    before = np.asarray(bands.torque(jnp.zeros(4), q, jnp.zeros(4)))
    np.testing.assert_allclose(before, 0.565e-3 * np.array([-12.0, 0.0, 2.0, 11.0]), atol=1e-12)
    np.testing.assert_allclose(bands.torque(jnp.full(4, 10.0), q, jnp.zeros(4)), before / 2, atol=1e-12)


def test_lever_arm_of_taut_bands_is_conservative() -> None:
    """While both bundles are taut, their energy is k x^2 / 2 about the equilibrium, with x = 15 sin(q / 15)."""
    q = jnp.linspace(-7.0, 7.0, 9)
    bands = ElasticBands(pretension_plus=9.0, pretension_minus=8.0, lever_arm=True)
    slope = jax.vmap(jax.grad(lambda q: 0.5 * 1.13e-3 * (15 * jnp.sin(q / 15) + 0.5) ** 2))
    np.testing.assert_allclose(bands.torque(jnp.zeros(9), q, jnp.zeros(9)), jax.jit(slope)(q), atol=1e-12)


def test_measurements_are_quantised_and_noisy() -> None:
    motion = simulate_rig(Rig(), ROBOT_TRAJECTORY, 10.0, key=jax.random.key(0))
    counts = np.asarray(motion.position) / (2 * np.pi / 2000)
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
    assert np.abs(motion.position - motion.true_position).max() <= np.pi / 2000 * (1 + 1e-9)
    noise = np.asarray(motion.torque - motion.motor_torque)
    assert noise.std() == pytest.approx(5e-4, rel=0.03)
    assert abs(noise.mean()) < 4 * 5e-4 / 100


@pytest.mark.slow
@pytest.mark.compiles
def test_keys_in_a_batch_equal_a_loop() -> None:
    def torque(key: jax.Array) -> jax.Array:
        return simulate_rig(Rig(), ROBOT_TRAJECTORY, 10.0, key=key).torque

    keys = jax.random.split(jax.random.key(1), 3)
    np.testing.assert_allclose(jax.vmap(torque)(keys), jnp.stack([torque(key) for key in keys]), atol=1e-12)


@pytest.mark.slow
@pytest.mark.compiles
def test_humans_and_references_in_a_batch_equal_a_loop() -> None:
    def motion(stiffness: jax.Array, scale: jax.Array) -> RigMotion:
        reference = eqx.tree_at(lambda s: s.sine, ROBOT_TRAJECTORY, scale * ROBOT_TRAJECTORY.sine)
        return simulate_rig(Rig(), reference, 10.0, HumanLoad(stiffness=stiffness))

    stiffness, scale = jnp.asarray([5e-4, 2e-3]), jnp.asarray([0.5, 1.0])
    batch = jax.vmap(motion)(stiffness, scale)
    for i in range(2):
        one = motion(stiffness[i], scale[i])
        # Rounding decides between two counts of the encoder now and then, after which the loop forgets it.
        np.testing.assert_allclose(batch.position[i], one.position, atol=2 * np.pi / 2000 * (1 + 1e-6))
        np.testing.assert_allclose(batch.human_torque[i], one.human_torque, atol=2e-6)


@pytest.mark.slow
@pytest.mark.compiles
def test_step_with_and_without_jit() -> None:
    rig, human, point = Rig(), HumanLoad(inertia=1e-6), setpoint(0.3)
    plain = step(rig, human, init(rig, human, point), point)
    compiled = eqx.filter_jit(step)(rig, human, eqx.filter_jit(init)(rig, human, point), point)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12), plain, compiled)


def test_scan_of_steps_is_the_simulation() -> None:
    rig, human = Rig(), HumanLoad()
    state, positions, one_step = init(rig, human, setpoint(0.0)), [], eqx.filter_jit(step)
    for i in range(30):
        state, sample = one_step(rig, human, state, setpoint(i * 1e-4))
        positions.append(sample.position)
    motion = simulate_rig(rig, ROBOT_TRAJECTORY, 10.0, human)
    np.testing.assert_allclose(motion.true_position[:3], positions[::10], atol=1e-9)
    np.testing.assert_allclose(motion.time, np.arange(10_000) * 1e-3, atol=1e-12)


def test_recording_holds_what_was_measured() -> None:
    motion = simulate_rig(Rig(), ROBOT_TRAJECTORY, 10.0, key=jax.random.key(2))
    recording = record(motion, "R")
    assert (recording.name, recording.joints, len(recording)) == ("R", ("revolute",), 10_000)
    assert recording.sample_rate == pytest.approx(1000.0)
    assert recording.valid.all()
    assert recording.reference is not None
    np.testing.assert_array_equal(recording.position[:, 0], motion.position)
    np.testing.assert_array_equal(recording.torque[:, 0], motion.torque)
    np.testing.assert_array_equal(recording.reference[:, 0], motion.reference)
