"""Isolation of deviations, against the twins that only a simulation has; and the traps on the way."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaximp.models.inertia import BaseInertia
from jaximp.papers.arm_experiments import Case, Experiment, normalised_errors, run_case, true_deviations
from jaximp.perturbation.deviations import Deviations, JointDeviations, KnownArm, joint_deviations
from jaximp.perturbation.isolation.erden_billard import state_at_onset
from jaximp.perturbation.isolation.feedback_jerk import cutoff_frequencies, feedback_jerk_isolation
from jaximp.perturbation.isolation.gomi_kawato import mean_of_perturbed
from jaximp.perturbation.isolation.methods import METHODS
from jaximp.perturbation.static import static_inertia
from jaximp.perturbation.trials import Trials, in_window
from jaximp.simulation.neuromuscular import RATE, NeuromuscularArm

ARM = NeuromuscularArm()
KNOWN = KnownArm(ARM.geometry, ARM.inertia, ARM.handle)


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return next(run_case(ARM, Case(), jax.random.split(jax.random.key(77), 1)))


def shares(experiment: Experiment, found: Deviations) -> np.ndarray:
    """Mean errors of position, velocity, acceleration and force [%]."""
    return normalised_errors(true_deviations(experiment), found).mean(axis=(1, 2))


PAPER = {
    "feedback_jerk": [1.33, 1.60, 0.71, 3.04],
    "gomi_kawato": [29.65, 6.47, 1.26, 4.96],
    "erden_billard": [911.10, 551.24, 5.31, 17.77],
}


@pytest.mark.parametrize("name", PAPER)
def test_errors_are_those_of_the_paper(experiment: Experiment, name: str) -> None:
    """One simulation of the ten of table 1 A: within what simulations differ by."""
    found = METHODS[name].isolate(experiment.perturbed, experiment.twins, KNOWN)
    np.testing.assert_allclose(shares(experiment, found.deviations), PAPER[name], rtol=0.45)


def test_cutoff_frequencies_are_those_of_the_paper(experiment: Experiment) -> None:
    found = cutoff_frequencies(experiment.perturbed, experiment.twins)
    np.testing.assert_allclose(found, [1.89, 2.24], atol=0.25)


def test_deviations_have_the_size_that_the_paper_prints(experiment: Experiment) -> None:
    true = true_deviations(experiment)
    size = [1e3 * np.linalg.norm(true.position, axis=-1).max(axis=1), np.linalg.norm(true.force, axis=-1).max(axis=1)]
    np.testing.assert_allclose([x.mean() for x in size], [3.53, 9.48], rtol=0.03)
    np.testing.assert_allclose([x.std(ddof=1) for x in size], [0.34, 3.05], rtol=0.1)


def test_true_stiffness_is_the_paper_s(experiment: Experiment) -> None:
    np.testing.assert_allclose(experiment.stiffness.mean(axis=0), [29.05, 14.37, 17.08], rtol=0.02)


@pytest.mark.slow
@pytest.mark.compiles
def test_inertia_comes_from_the_static_task(experiment: Experiment) -> None:
    assert experiment.postures is not None
    found = static_inertia(experiment.postures, ARM.geometry)
    off = (np.asarray(found.inertia) - ARM.inertia) / np.asarray(found.inertia_stderr)
    assert np.abs(off).max() < 3
    np.testing.assert_allclose(found.inertia, ARM.inertia, rtol=0.06)
    linear = static_inertia(experiment.postures, ARM.geometry, linearised=True)
    np.testing.assert_allclose(linear.inertia, found.inertia, rtol=0.02)


# What is stepped into on the way. Each trap is also set, to see that the test would notice.


def impedance(joint: JointDeviations) -> tuple[np.ndarray, np.ndarray]:
    """Damping and stiffness by plain least squares."""
    X = np.concatenate([joint.velocity, joint.displacement], axis=-1).reshape(-1, 4)
    found = np.linalg.lstsq(X, np.reshape(joint.torque, (-1, 2)), rcond=None)[0].T
    return found[:, :2], found[:, 2:]


def damping_error(experiment: Experiment, found: Deviations, perturbed: Trials | None = None) -> np.ndarray:
    """Of the damping, in percent of its largest element, with the true inertia."""
    D, _ = impedance(joint_deviations(perturbed or experiment.perturbed, found, KNOWN))
    K11, K12, K22 = np.asarray(experiment.stiffness).mean(axis=0)
    return 100 * 12 / K11 * np.abs(D - np.array([[K11, K12], [K12, K22]]) / 12)


def test_true_deviations_give_damping_and_stiffness_back(experiment: Experiment) -> None:
    joint = joint_deviations(experiment.perturbed, true_deviations(experiment), KNOWN)
    D, K = impedance(joint)
    K11, K12, K22 = np.asarray(experiment.stiffness).mean(axis=0)
    true = np.array([[K11, K12], [K12, K22]])
    np.testing.assert_allclose(K, true, atol=0.02 * K11)
    np.testing.assert_allclose(D, true / 12, atol=0.02 * K11 / 12)


def test_force_and_acceleration_of_one_instant_belong_together(experiment: Experiment) -> None:
    aligned = feedback_jerk_isolation(experiment.perturbed, experiment.twins, KNOWN).deviations
    assert damping_error(experiment, aligned).max() < 6
    # The force on the hand is the small difference of the command and what the handle takes of it.
    moved = experiment.perturbed
    force = ARM.handle.force(jnp.roll(moved.command, 1, axis=1), moved.velocity, moved.acceleration)
    late = eqx.tree_at(lambda m: m.force, moved, force)
    found = feedback_jerk_isolation(late, experiment.twins, KNOWN).deviations
    assert damping_error(experiment, found, late)[0, 0] > 20


def test_integration_is_by_trapezia(experiment: Experiment, monkeypatch: pytest.MonkeyPatch) -> None:
    right = feedback_jerk_isolation(experiment.perturbed, experiment.twins, KNOWN)
    assert damping_error(experiment, right.deviations).max() < 6

    def rectangles(x: Any, rate: float) -> Any:
        return jnp.cumsum(x, axis=1) / rate

    monkeypatch.setattr("jaximp.perturbation.isolation.feedback_jerk._integral", rectangles)
    jax.clear_caches()
    wrong = feedback_jerk_isolation(experiment.perturbed, experiment.twins, KNOWN).deviations
    jax.clear_caches()
    assert damping_error(experiment, wrong).max() > 6


def test_integration_starts_at_the_onset(experiment: Experiment) -> None:
    found = feedback_jerk_isolation(experiment.perturbed, experiment.twins, KNOWN).deviations
    assert not np.asarray(found.position[:, 0]).any()
    assert not np.asarray(found.acceleration[:, 0]).any()
    error = shares(experiment, found)[0]
    early = eqx.tree_at(lambda m: m.onset, experiment.perturbed, experiment.perturbed.onset - 40)
    sooner = feedback_jerk_isolation(early, experiment.twins, KNOWN, window=0.125).deviations
    later = jax.tree.map(lambda x: x[:, 40:], sooner)
    assert shares(experiment, later)[0] > 1.2 * error


@pytest.mark.slow
def test_noise_free_jerk_isolation_is_nearly_exact() -> None:
    """Without noise only the movement itself leaks through the filter."""
    quiet = next(run_case(ARM, Case(amplitude=0.0), jax.random.split(jax.random.key(0), 1), static=False))
    found = feedback_jerk_isolation(quiet.perturbed, quiet.twins, KNOWN, cutoff=np.array([1.9, 2.2]))
    assert shares(quiet, found.deviations).max() < 6
    mean = mean_of_perturbed(quiet.perturbed, None, KNOWN)
    assert shares(quiet, mean.deviations).max() < 1.0


def test_a_known_arm_has_borners_order_or_names() -> None:
    plain, xi = np.asarray(ARM.inertia), np.asarray(ARM.xi)
    np.testing.assert_array_equal(KNOWN.inertia, plain)
    np.testing.assert_allclose(KNOWN.xi, xi, rtol=1e-12)
    for named in (BaseInertia.from_borner(plain), BaseInertia.from_lakatos(xi), BaseInertia(*plain)):
        np.testing.assert_allclose(KnownArm(ARM.geometry, named).inertia, plain, rtol=1e-12)
        np.testing.assert_allclose(KNOWN.with_inertia(named).xi, xi, rtol=1e-12)


# What is refused.


def test_postures_moved_along_one_line_tell_no_inertia(experiment: Experiment) -> None:
    postures = experiment.postures
    assert postures is not None
    alike = jax.tree.map(lambda x: jnp.broadcast_to(x[:1], x.shape), postures)
    with pytest.raises(ValueError, match=r"directions of 100 trials are all the same and do not span the plane"):
        static_inertia(alike, ARM.geometry)


def test_jerk_isolation_without_unperturbed_trials_needs_its_cutoff(experiment: Experiment) -> None:
    with pytest.raises(ValueError, match=r"cutoff = \[f1, f2\] in Hz"):
        feedback_jerk_isolation(experiment.perturbed, None, KNOWN)
    given = feedback_jerk_isolation(experiment.perturbed, None, KNOWN, cutoff=np.array([1.9, 2.2]))
    assert shares(experiment, given.deviations)[0] < 3
    assert shares(experiment, mean_of_perturbed(experiment.perturbed, None, KNOWN).deviations)[0] < 60


def test_a_perturbation_that_cannot_be_seen_has_no_cutoff(experiment: Experiment) -> None:
    with pytest.raises(ValueError, match="too small"):
        cutoff_frequencies(experiment.twins, experiment.twins)


@pytest.mark.parametrize("isolate", [feedback_jerk_isolation, mean_of_perturbed, state_at_onset])
def test_a_window_longer_than_the_trial_is_refused(experiment: Experiment, isolate: Any) -> None:
    with pytest.raises(ValueError, match=r"longer than the .* lasts after its onset"):
        isolate(experiment.perturbed, experiment.twins, KNOWN, window=1.5)


def test_a_window_is_cut_at_each_trial_s_own_onset(experiment: Experiment) -> None:
    cut = in_window(experiment.perturbed, 30)
    assert len(set(np.asarray(experiment.perturbed.onset).tolist())) > 5
    for k, first in enumerate(np.asarray(experiment.perturbed.onset)):
        np.testing.assert_array_equal(cut.position[k], experiment.perturbed.position[k, first : first + 30])
    assert float(jnp.abs(cut.command[:, 0]).max()) == 0
    assert float(jnp.abs(cut.command[:, 3]).min()) >= 0
    assert cut.sample_rate == RATE
