"""From the hand's position and force to an arm's impedance."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from factories.recordings import cut
from jaximp import load_recording, recording_from_arrays, save_recording
from jaximp.identification import FilterSettings
from jaximp.least_squares.window import WindowFit
from jaximp.models.arm import PlanarArm
from jaximp.models.kinematics import ArmGeometry
from jaximp.perturbation.reading import read_trials
from jaximp.perturbation.regression import (
    JointTrials,
    fit_trials,
    joint_trials,
    load_trials,
    predict_trials,
    regress_trials,
)
from jaximp.simulation.held_arm import DIRECTIONS, LATENCIES, HeldArm, HeldTrials, hold
from jaximp.trust.criteria import confidence
from jaximp.trust.limits import TrustLimits
from jaximp.types import Recording

RATE = 1000.0
TIME = np.arange(-150, 420) / RATE
QUIET = HeldArm(reflex_gain=0.0)
ARM = PlanarArm((0.0, 0.0))
TRUTH = np.concatenate([QUIET.inertia, np.ravel(QUIET.damping), np.ravel(QUIET.stiffness)])


FILTER = FilterSettings(position_cutoff=100.0, position_order=4, decimation_cutoff=25.0)
fit_compiled = jax.jit(fit_trials)


def recordings(trials: HeldTrials) -> list[Recording]:
    """As a robot would log them: the command is the smooth motion itself, which hardly leaves rest at the onset."""
    u = np.clip(TIME / 0.2, 0, 1)
    commanded = (u**3 * (10 - 15 * u + 6 * u**2))[:, None] * np.ones(2)
    return [
        recording_from_arrays(
            time=TIME - TIME[0],
            position=np.asarray(x),
            torque=np.asarray(force),
            reference=commanded,
            joint="prismatic",
            name=f"{k}",
        )
        for k, (x, force) in enumerate(zip(trials.position, trials.force, strict=True))
    ]


@pytest.fixture(scope="module")
def held() -> HeldTrials:
    return jax.jit(lambda: hold(QUIET, DIRECTIONS, 0.2, TIME, jax.random.key(0)))()


@pytest.fixture(scope="module")
def logged(held: HeldTrials) -> list[Recording]:
    return recordings(held)


@pytest.fixture(scope="module")
def fitted(held: HeldTrials) -> WindowFit:
    return fit_compiled(rows_of(held.position, held.force), 0.27)


@jax.jit
def rows_of(position: Any, force: Any) -> Any:
    return regress_trials(ARM, joint_trials(QUIET.geometry, position, force, 150, RATE), FILTER)


@pytest.mark.slow
@pytest.mark.compiles
def test_the_robot_feels_what_the_arm_is() -> None:
    """Noise-free: the torque is the regressor times the truth, and the hand's force does its work."""
    clean = hold(QUIET, DIRECTIONS, 0.2, TIME)
    model = PlanarArm(tuple(float(x) for x in QUIET.posture))
    pressed = np.asarray(QUIET.geometry.joint_torque(QUIET.posture, QUIET.hand_force))
    expected = model.torque(TRUTH, clean.angles, clean.velocities, clean.accelerations) + pressed
    np.testing.assert_allclose(clean.torque, expected, atol=1e-12)
    np.testing.assert_allclose(QUIET.geometry.joint_torque(clean.angles, clean.force), clean.torque, atol=1e-12)
    np.testing.assert_allclose(QUIET.geometry.inverse(clean.position), clean.angles, atol=1e-12)
    np.testing.assert_allclose(clean.angles[:, -1] - clean.angles[:, 0], DIRECTIONS, atol=1e-15)


@pytest.mark.slow
def test_a_cuff_that_hardly_yields_is_none_and_a_soft_one_hides_the_hand() -> None:
    def through(stiffness: float) -> HeldTrials:
        arm = HeldArm(reflex_gain=0.0, yields=True, cuff_stiffness=stiffness)
        return jax.jit(lambda: hold(arm, DIRECTIONS[:2], 0.15, TIME))()

    exact, hard, soft = hold(QUIET, DIRECTIONS[:2], 0.15, TIME), through(2e6), through(5e3)
    np.testing.assert_allclose(hard.angles, exact.angles, atol=1e-4)
    np.testing.assert_allclose(hard.torque, exact.torque, atol=0.05 * np.abs(exact.torque).max())
    np.testing.assert_allclose(soft.position, exact.position, atol=1e-15)  # the robot knows its own
    assert np.abs(soft.angles - exact.angles).max() > 5e-3
    # The motion is that of an arm under the measured force.
    model = PlanarArm(tuple(float(x) for x in QUIET.posture))
    pressed = np.asarray(QUIET.geometry.joint_torque(QUIET.posture, QUIET.hand_force))
    expected = model.torque(TRUTH, soft.angles, soft.velocities, soft.accelerations) + pressed
    np.testing.assert_allclose(soft.torque, expected, atol=1e-9)
    np.testing.assert_allclose(np.gradient(soft.angles, 1 / RATE, axis=1)[:, 1:-1], soft.velocities[:, 1:-1], atol=2e-3)
    np.testing.assert_allclose(
        np.gradient(soft.velocities, 1 / RATE, axis=1)[:, 200:-1], soft.accelerations[:, 200:-1], atol=0.2
    )


def test_reflexes_set_in_one_after_the_other() -> None:
    arm = HeldArm(reflex_gain=0.6, rise=0.01)
    t = np.array([0.0, *LATENCIES, 0.2]) - 1e-9
    D, K = arm.impedance(t)
    np.testing.assert_allclose(np.asarray(K)[:, 0, 0] / arm.stiffness[0, 0], [1, 1, 1.2, 1.4, 1.6], atol=1e-6)
    np.testing.assert_allclose(np.asarray(D) / np.asarray(K), np.broadcast_to(arm.damping / arm.stiffness, D.shape))


def test_trials_give_back_inertia_damping_and_stiffness(fitted: WindowFit) -> None:
    np.testing.assert_allclose(fitted.theta[:3], TRUTH[:3], rtol=0.01)
    np.testing.assert_allclose(fitted.theta[3:], TRUTH[3:], rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("position_noise", "least"), [(0.0, 0.6), (1e-5, 0.1)], ids=["force", "and position"])
def test_standard_errors_are_not_too_small(position_noise: float, least: float) -> None:
    """Over noise keys. Noise of the position is differentiated twice and looks like much noise of the torque, of which
    little is where the estimates are: the errors are then on the safe side."""
    arm = HeldArm(reflex_gain=0.0, position_noise=position_noise)

    def one(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        noisy = hold(arm, DIRECTIONS, 0.2, TIME, key)
        fit = fit_trials(rows_of(noisy.position, noisy.force), 0.27)
        return fit.theta, fit.stderr

    theta, stderr = jax.jit(lambda keys: jax.lax.map(one, keys, batch_size=8))(jax.random.split(jax.random.key(1), 150))
    spread, claimed = np.std(theta, axis=0, ddof=1), np.median(stderr, axis=0)
    assert (spread < 1.2 * claimed).all()
    assert (spread > least * claimed).all()
    np.testing.assert_allclose(np.mean(theta, axis=0), TRUTH, rtol=0.01)


@pytest.mark.slow
def test_trial_files_are_read_cut_and_fitted(tmp_path: Path, logged: list[Recording], fitted: WindowFit) -> None:
    files = [tmp_path / f"trial_{recording.name}.csv" for recording in logged]
    for file, recording in zip(files, logged, strict=True):
        save_recording(recording, file)
    columns: dict[str, Any] = {"time": "time_s"}
    for channel, unit in (("position", "m"), ("torque", "N"), ("reference", "m")):
        columns[channel] = [f"{channel}{j}_{unit}" for j in (1, 2)]
    rows = load_trials(files, QUIET.geometry, ARM, FILTER, before=0.15, after=0.4, **columns)
    read = [load_recording(file, joint="prismatic", **columns) for file in files]
    trials = at_joints(read, before=0.15, after=0.4)
    assert trials.onset == 150
    np.testing.assert_array_equal(rows.W, regress_trials(ARM, trials, FILTER).W)
    again = fit_compiled(rows, 0.27)
    np.testing.assert_allclose(again.theta, fitted.theta, rtol=2e-3)  # the end of the trial is elsewhere
    given = at_joints(read, onset=0.15, before=0.15, after=0.4)
    np.testing.assert_array_equal(given.angles, trials.angles)


def at_joints(recordings: list[Recording], **options: Any) -> JointTrials:
    """As measured."""
    read, _, _ = read_trials(recordings, "posture", geometry=QUIET.geometry, cutoff=None, **options)
    return joint_trials(QUIET.geometry, read.position, read.force, int(read.onset[0]), read.sample_rate)


def test_unseen_trials_are_predicted(held: HeldTrials) -> None:
    rows, held_out = rows_of(held.position, held.force), np.arange(6) == 5
    fit = fit_compiled(rows, 0.27, ~held_out)
    predicted, vaf = predict_trials(rows, fit.theta, 0.27, held_out)
    inside = (np.asarray(rows.time) > -1e-3) & (np.asarray(rows.time) < 0.271)
    seen, unseen = np.asarray(rows.torque)[5, inside], np.asarray(predicted)[5, inside]
    expected = 1 - (seen - unseen).var(axis=0).sum() / seen.var(axis=0).sum()
    assert float(vaf) == pytest.approx(expected, rel=1e-9)
    assert vaf > 0.99


def test_steady_state_is_taken_off(held: HeldTrials) -> None:
    trials = joint_trials(QUIET.geometry, held.position, held.force + np.array([3.0, -2.0]), 150, RATE)
    np.testing.assert_allclose(trials.torque[:, :150].mean(axis=1), 0, atol=1e-12)
    np.testing.assert_allclose(trials.equilibrium, np.broadcast_to(QUIET.posture, (6, 2)), atol=1e-5)
    assert len(trials) == 6


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        pytest.param(
            lambda r: [r[0], replace(r[1], reference=None)], "trial 2 .1.: its onset is not known", id="onset"
        ),
        pytest.param(
            lambda r: [replace(r[0], reference=np.zeros((len(r[0]), 2)))], "trial 1 .0.: no perturbation", id="command"
        ),
        pytest.param(lambda r: [r[0], cut(r[1], slice(300))], "trial 2 .1. lasts from 0 to 0.299 s", id="too short"),
        pytest.param(
            lambda r: [replace(r[0], joints=("revolute", "revolute"))], "not a recording of a hand", id="hand"
        ),
        pytest.param(lambda r: [r[0], cut(r[1], slice(None, None, 2))], "sampled at 500 Hz", id="rate"),
        pytest.param(lambda r: [gap(r[0])], "trial 1 .0. has a gap at 0.2 s, and its perturb", id="gap"),
        pytest.param(lambda r: [], "no trials", id="none"),
        pytest.param(lambda r: [r[0], late(r[1], 0.05)], "trial 2 moves before its onset", id="late onset"),
        pytest.param(lambda r: [moved(r[0], 1.0)], "reach", id="out of reach"),
        pytest.param(lambda r: [moved(r[0], 0.0, straight=True)], "trial 1: the elbow", id="straight elbow"),
    ],
)
def test_bad_trials_are_named(logged: list[Recording], spoil: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        at_joints(spoil(logged), before=0.15, after=0.35)


def late(recording: Recording, by: float) -> Recording:
    """The command is logged so much later than it acts."""
    assert recording.reference is not None
    n = round(by * RATE)
    shifted = np.concatenate([np.repeat(recording.reference[:1], n, axis=0), recording.reference[:-n]])
    both = {name: np.concatenate([getattr(recording, name), np.repeat(getattr(recording, name)[-1:], 100, axis=0)])
            for name in ("position", "torque", "valid")}  # fmt: skip
    time = np.arange(len(recording) + 100) / RATE
    shifted = np.concatenate([shifted, np.repeat(shifted[-1:], 100, axis=0)])
    return replace(recording, time=time, reference=shifted, **both)


def gap(recording: Recording) -> Recording:
    valid = recording.valid.copy()
    valid[200] = False
    return replace(recording, valid=valid)


def moved(recording: Recording, by: float, straight: bool = False) -> Recording:
    position = recording.position + by
    if straight:
        position = np.zeros_like(position) + np.array([sum(QUIET.lengths) - 1e-9, 0.0])
    return replace(recording, position=position)


@pytest.mark.slow
@pytest.mark.compiles
@pytest.mark.usefixtures("unchecked")
def test_too_little_data_is_refused(held: HeldTrials) -> None:
    def rows(amplitudes: np.ndarray, samples: slice) -> Any:
        trials = hold(QUIET, amplitudes, 0.2, TIME, jax.random.key(0))
        trials = joint_trials(QUIET.geometry, trials.position[:, samples], trials.force[:, samples], 150, RATE)
        return regress_trials(ARM, trials, FILTER)

    line = rows(np.array([[0.05, -0.05], [-0.05, 0.05], [0.02, -0.02]]), slice(None))
    with pytest.raises(ValueError, match="do not span the plane"):
        fit_trials(line, 0.27)
    both = rows(DIRECTIONS[:3], slice(None))
    with pytest.raises(ValueError, match="directions of 1 trials"):
        fit_trials(both, 0.27, counts=np.array([True, False, False]))
    few = jax.tree.map(lambda x: x, both)
    few = type(few)(
        few.W[:, :1], few.torque[:, :1], few.time[:1], few.peaks, few.jacobian, few.noise, few.kept, few.baseline
    )
    with pytest.raises(ValueError, match="cannot determine 11 parameters"):
        fit_trials(few, 0.27)


def test_equations_at_the_hand_are_those_of_the_joints(held: HeldTrials) -> None:
    trials = joint_trials(QUIET.geometry, held.position, held.force, 150, RATE)
    rows = regress_trials(ARM, trials, FILTER)
    there = rows.at_hand()
    J = np.asarray(QUIET.geometry.jacobian(trials.equilibrium))
    for k in (0, 3):
        np.testing.assert_allclose(there.torque[k] @ J[k], rows.torque[k], atol=1e-10)
        np.testing.assert_allclose(np.einsum("nap,aj->njp", there.W[k], J[k]), rows.W[k], atol=1e-10)


def test_confidence_is_one_verdict_with_its_parts(fitted: WindowFit) -> None:
    found = confidence(ARM.names, fitted, 0.99)
    assert found.trusted.all()
    assert found.in_words()[-1] == "trusted"
    eigenvalues = np.linalg.eigvalsh(
        np.asarray(fitted.theta[7:]).reshape(2, 2) / 2 + np.asarray(fitted.theta[7:]).reshape(2, 2).T / 2
    )
    np.testing.assert_allclose(found.stiffness.eigenvalues[0], eigenvalues)
    # Errors of first order, against draws from the covariance.
    draws = np.random.default_rng(0).multivariate_normal(fitted.theta, fitted.covariance, 4000)
    K = draws[:, 7:].reshape(-1, 2, 2)
    spread = np.linalg.eigvalsh((K + K.swapaxes(1, 2)) / 2).std(axis=0)
    np.testing.assert_allclose(found.stiffness.eigenvalue_stderr[0], spread, rtol=0.1)
    difference = (K[:, 0, 1] - K[:, 1, 0]).std() / (np.sqrt(2) * np.linalg.norm((K[0] + K[0].T) / 2))
    np.testing.assert_allclose(found.stiffness.asymmetry_stderr[0], difference, rtol=0.1)


@pytest.mark.parametrize(
    ("change", "limits", "held_out", "part"),
    [
        pytest.param({10: -1.0}, TrustLimits(), 0.99, "stiffness positive definite", id="indefinite"),
        pytest.param({3: -1.0}, TrustLimits(), 0.99, "damping positive definite", id="negative damping"),
        pytest.param({8: 30.0}, TrustLimits(), 0.99, "stiffness quasi-symmetric", id="asymmetric"),
        pytest.param({1: -0.03}, TrustLimits(), 0.99, "inertia of a rigid body", id="impossible body"),
        pytest.param({1: 0.3}, TrustLimits(), 0.99, "inertia of a rigid body", id="indefinite mass matrix"),
        pytest.param({}, TrustLimits(min_dof=1e6), 0.99, "standard errors", id="degrees of freedom"),
        pytest.param({}, TrustLimits(min_vaf=0.9999999), 1.0, "explained torque", id="explained"),
        pytest.param({}, TrustLimits(max_condition=10.0), 0.99, "condition", id="condition"),
        pytest.param({}, TrustLimits(max_relative_stderr=1e-6), 0.99, "standard errors", id="errors"),
        pytest.param({}, TrustLimits(), 0.5, "held-out torque", id="held out"),
    ],
)
def test_every_criterion_can_fail(
    fitted: WindowFit, change: dict[int, float], limits: TrustLimits, held_out: float, part: str
) -> None:
    theta = np.array(fitted.theta)
    for k, value in change.items():
        theta[k] = value
    spoilt = jax.tree.map(lambda x: x, fitted)
    object.__setattr__(spoilt, "theta", jnp.asarray(theta))
    found = confidence(ARM.names, spoilt, held_out, limits)
    assert not found.trusted[0]
    assert not found.parts[part][0]
    assert part in found.in_words()[-1]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("call", "message"),
    [
        pytest.param(lambda x, f: joint_trials(QUIET.geometry, x, f, 0, RATE), "onset is sample 0", id="no baseline"),
        pytest.param(lambda x, f: joint_trials(QUIET.geometry, x, f, 5000, RATE), "onset is sample 5000", id="late"),
        pytest.param(lambda x, f: joint_trials(QUIET.geometry, x[0], f[0], 150, RATE), "must be .trials", id="shape"),
        pytest.param(
            lambda x, f: joint_trials(QUIET.geometry, x.at[2, 7].set(np.nan), f, 150, RATE), "trial 3: its position",
            id="NaN",
        ),
        pytest.param(
            lambda x, f: regress_trials(ARM, joint_trials(QUIET.geometry, x, f, 150, RATE), FilterSettings()),
            "decimation_cutoff", id="no filter",
        ),
        pytest.param(
            lambda x, f: regress_trials(
                PlanarArm(impedance=False), joint_trials(QUIET.geometry, x, f, 150, RATE), FILTER
            ),
            "damping and stiffness", id="no impedance",
        ),
        pytest.param(lambda x, f: fit_trials(rows_of(x, f), 300.0), "observed is 300 s", id="milliseconds"),
        pytest.param(lambda x, f: fit_trials(rows_of(x, f), 0.2, np.array([0, 1])), "each of 6 trials", id="counts"),
    ],
)  # fmt: skip
def test_wrong_use_is_refused(held: HeldTrials, call: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(held.position, held.force)


def test_observations_are_a_batch(held: HeldTrials) -> None:
    rows = rows_of(held.position, held.force)
    together = jax.jit(jax.vmap(lambda observed: fit_trials(rows, observed).theta))(jnp.array([0.2, 0.27]))
    np.testing.assert_allclose(together[1], fit_compiled(rows, 0.27).theta, rtol=1e-9)


@pytest.mark.slow
def test_the_shoulder_may_be_anywhere(held: HeldTrials, fitted: WindowFit) -> None:
    moved = ArmGeometry(QUIET.lengths, shoulder=(0.4, -0.2))
    trials = joint_trials(moved, held.position + np.array([0.4, -0.2]), held.force, 150, RATE)
    np.testing.assert_allclose(fit_trials(regress_trials(ARM, trials, FILTER), 0.27).theta, fitted.theta, rtol=1e-8)


def test_confidence_needs_an_arm(fitted: WindowFit) -> None:
    with pytest.raises(ValueError, match="damping and stiffness"):
        confidence([f"x{k}" for k in range(11)], fitted, 1.0)


def test_trials_are_a_pytree(held: HeldTrials) -> None:
    trials = joint_trials(QUIET.geometry, held.position, held.force, 150, RATE)
    traced = jax.jit(lambda x, f: joint_trials(QUIET.geometry, x, f, 150, RATE))(held.position, held.force)
    assert isinstance(traced, JointTrials)
    np.testing.assert_allclose(traced.torque, trials.torque, atol=1e-12)
