"""The simulated arm of Börner et al. 2020: its mechanics, its nerves, and the numbers that it was calibrated to."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import nnls

from jaximp.models import mass_matrix
from jaximp.papers.arm_experiments import subject
from jaximp.perturbation.trials import Handle
from jaximp.simulation.neuromuscular import (
    RATE,
    Drive,
    NeuromuscularArm,
    Push,
    Reach,
    Reaches,
    feedforward,
    hold_posture,
    init,
    neural_noise,
    perturbing_forces,
    reach,
    step,
)

ARM, TASK = NeuromuscularArm(), Reach()
SAMPLES = round(TASK.duration * RATE) + 1
QUIET = np.zeros((4, SAMPLES, 6))
PUSHES = np.array([[0.0, 0.0], [40.0, 0.0], [-40.0, 0.0], [0.0, 40.0]])
simulate, hold = eqx.filter_jit(reach), eqx.filter_jit(hold_posture)


@pytest.fixture(scope="module")
def quiet() -> Reaches:
    """Without noise: unperturbed, and pushed in three directions."""
    return simulate(ARM, TASK, PUSHES, QUIET)


@pytest.mark.slow
@pytest.mark.parametrize("arm", [ARM, subject(3)], ids=["paper", "another build"])
def test_without_noise_and_perturbation_the_arm_moves_as_planned(arm: NeuromuscularArm) -> None:
    moved = simulate(arm, TASK, PUSHES, QUIET).movements  # the first is not pushed
    x, v, _ = TASK(np.arange(SAMPLES) / RATE)
    np.testing.assert_allclose(moved.position[0], x, atol=1e-6)
    np.testing.assert_allclose(moved.velocity[0], v, atol=1e-5)


def test_samples_belong_together(quiet: Reaches) -> None:
    """Velocity and acceleration are the derivatives of the position, and the force is that of the handle."""
    moved = quiet.movements
    rate = np.gradient(moved.position, 1 / RATE, axis=1)[:, 1:-1]
    np.testing.assert_allclose(rate, moved.velocity[:, 1:-1], atol=1e-5)
    rate = np.gradient(moved.velocity, 1 / RATE, axis=1)[:, 1:-1]
    np.testing.assert_allclose(rate, moved.acceleration[:, 1:-1], atol=2e-3)
    expected = moved.command - 5 * moved.acceleration - 20 * moved.velocity
    np.testing.assert_allclose(moved.force, expected, atol=1e-12)


def test_a_push_begins_when_the_hand_arrives_and_ends_with_zero(quiet: Reaches) -> None:
    moved = quiet.movements
    assert len(set(np.asarray(moved.onset).tolist())) == 1
    k = int(moved.onset[0])
    assert float(moved.position[0, k - 1, 1]) < 0.40 <= float(moved.position[0, k, 1])
    command = np.asarray(moved.command[1, :, 0])
    assert not command[: k + 1].any()
    assert not command[k + round(0.175 * RATE) + 1 :].any()
    assert command.max() == pytest.approx(40.0, rel=1e-3)
    assert not np.asarray(moved.command[0]).any()


def test_small_opposite_pushes_move_the_arm_oppositely(quiet: Reaches) -> None:
    weak = simulate(ARM, TASK, 0.01 * PUSHES, QUIET).movements.position
    there, back = weak[1] - weak[0], weak[2] - weak[0]
    np.testing.assert_allclose(there, -back, atol=2e-4 * float(jnp.abs(there).max()))


@pytest.mark.slow
def test_work_of_a_push_becomes_kinetic_energy() -> None:
    """Muscles without springs, handle without damping: the energy of arm and handle is what the command has done."""
    limp = NeuromuscularArm(
        intrinsic_stiffness=np.zeros(6), stiffness_per_force=0.0, handle=Handle((5.0, 5.0), (0.0, 0.0))
    )
    still = Reach(goal=(0.0, 0.3001), trigger=0.30)
    moved = simulate(limp, still, PUSHES[1:], QUIET[1:, :2000]).movements
    q, dq, _ = limp.geometry.joint_motion(moved.position, moved.velocity, moved.acceleration)
    arm = (dq[..., None, :] @ mass_matrix(q, limp.xi) @ dq[..., None])[..., 0, 0] / 2
    energy = arm + 5 * (moved.velocity**2).sum(axis=-1) / 2
    power = (moved.command * moved.velocity).sum(axis=-1)
    work = np.concatenate([np.zeros((3, 1)), np.cumsum((power[:, 1:] + power[:, :-1]) / 2 / RATE, axis=1)], axis=1)
    assert float(energy.max()) > 0.03
    np.testing.assert_allclose(energy, work, atol=2e-4 * float(energy.max()))


def test_feedforward_is_the_least_activation_that_balances() -> None:
    random = np.random.default_rng(0)
    q, dq, ddq = (random.normal(size=(20, 2)) * size + shift for size, shift in ((0.3, 1.0), (1.0, 0.0), (8.0, 0.0)))
    found = np.asarray(feedforward(ARM, q, dq, ddq))
    torque = found @ ARM.moment_arms
    for activation, wanted in zip(found, torque, strict=True):
        weight = 1e4
        system = np.concatenate([weight * ARM.moment_arms.T, np.eye(6)])
        least = nnls(system, np.r_[weight * wanted, np.zeros(6)])[0]
        np.testing.assert_allclose(activation, least, atol=1e-3 * activation.max())


def test_feedback_comes_after_its_delay() -> None:
    fast, without = (NeuromuscularArm(feedback_gain=gain, feedback_delay=0.05) for gain in (0.6, 0.0))
    one, other = (simulate(arm, TASK, PUSHES[1:2], QUIET[:1]).movements for arm in (fast, without))
    k, delay = int(one.onset[0]), round(0.05 * RATE)
    apart = np.abs(np.asarray(one.acceleration - other.acceleration)).max(axis=-1)[0]
    # Before the push only the integration's rounding is there to be fed back.
    assert apart[: k + delay].max() < 1e-4
    assert apart[k + delay + 40] > 1e-2


@pytest.mark.slow
def test_steps_one_by_one_are_the_scan(quiet: Reaches) -> None:
    time = np.arange(60) / RATE
    q, dq, ddq = ARM.geometry.joint_motion(*TASK(time))
    drives = Drive(q[..., None], dq[..., None], feedforward(ARM, q, dq, ddq)[..., None], jnp.zeros((60, 6, 1)))
    push = Push(jnp.asarray(0.4), jnp.zeros((2, 1)), jnp.zeros(2))
    now = jax.tree.map(lambda x: x[0], drives)
    state = init(ARM, now)
    one = eqx.filter_jit(step)
    for k in range(50):
        then = jax.tree.map(lambda x, k=k: x[k + 1], drives)
        state, sample = one(ARM, push, state, jnp.asarray(k), now, then)
        now = then
        np.testing.assert_allclose(sample.position[:, 0], quiet.movements.position[0, k], atol=1e-12)


@pytest.mark.slow
def test_trials_do_not_disturb_each_other() -> None:
    noise = neural_noise(jax.random.key(0), 3, 2000)
    forces = perturbing_forces(jax.random.key(1))[:3]
    together = simulate(ARM, TASK, forces, noise)
    alone = simulate(ARM, TASK, forces[1:2], noise[1:2])
    np.testing.assert_allclose(together.movements.position[1], alone.movements.position[0], atol=1e-13)


def test_noise_has_the_size_that_it_was_calibrated_with() -> None:
    noise = np.asarray(neural_noise(jax.random.key(0), 40, SAMPLES))
    assert noise[:, 4000:].std() == pytest.approx(0.40, rel=0.05)
    assert np.abs(noise[:, :40]).max() < 1e-3, "it starts from rest"


def test_a_slow_displacement_is_met_by_the_true_stiffness() -> None:
    """Of the muscles at rest, from K0 and the moment arms alone."""
    A, K0 = ARM.moment_arms, ARM.intrinsic_stiffness
    posture = np.array([[0.0, 0.45], [0.1, 0.45]])
    held = hold(ARM, posture, np.array([0.3, 1.9]), np.zeros((2, 24000, 6)), 0.5, 1e-4, 2.0)
    k = round(2.5 * RATE)  # farthest away: the velocity is zero, the acceleration small
    q = ARM.geometry.inverse(held.position[:, k])
    torque = ARM.geometry.joint_torque(q, held.force[:, k])
    away = q - ARM.geometry.inverse(posture)
    np.testing.assert_allclose(torque, away @ (A.T * K0) @ A, rtol=2e-3)


def test_noise_moves_the_posture_by_force_alone() -> None:
    held = hold(ARM, np.array([[0.0, 0.45]]), np.array([0.0]), neural_noise(jax.random.key(2), 1, 6000))
    before = np.asarray(held.force[0, 3000:4000])
    assert 0.1 < np.abs(before).max() < 20
    assert np.ptp(np.asarray(held.position[0, :4000]), axis=0).max() == 0
