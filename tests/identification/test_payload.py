"""The four methods on a robot and a human written out in numpy: right, and as sure as they should be."""

from __future__ import annotations

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray

from jaximp.identification.separation import METHODS, Regression, Separation, fit_robot, separate
from jaximp.least_squares.window import WindowFit, least_squares
from jaximp.models import HumanJoint, RobotJoint, combine

Numbers = NDArray[np.float64]

RATE, RATIO, G = 100.0, 15.0, 9.81
ROBOT = np.array([1.5e-3, 2e-4, 1.45e-4, 2.5e-3, 1.9e-5])  # gravity x and y, viscous, Coulomb, inertia
HUMAN = np.array([1.0e-5, 1.0e-4, 1.0e-3, -2.0e-3])  # inertia, damping, stiffness, offset
SIGMA, WINDOW, STEP = 5e-4, 400, 20
MERGE = combine(RobotJoint(gear_ratio=RATIO), HumanJoint(gear_ratio=RATIO)).merge
METHOD_IDS = pytest.mark.parametrize("method", list(METHODS), ids=lambda method: f"method {method}")


def rows(phase: float, n: int = 1000) -> tuple[Numbers, Numbers]:
    """Robot's and human's regressor on a Fourier series of the motor's angle."""
    t = np.arange(n) / RATE
    q, dq, ddq = np.zeros(n), np.zeros(n), np.zeros(n)
    for k, amplitude in enumerate((4.0, 3.0, 2.0, 1.5, 0.8), start=1):
        w = 2 * np.pi * 0.3 * k
        q += amplitude * np.sin(w * t + phase * k * k)
        dq += amplitude * w * np.cos(w * t + phase * k * k)
        ddq -= amplitude * w**2 * np.sin(w * t + phase * k * k)
    robot = np.stack([G * np.sin(q / RATIO), G * np.cos(q / RATIO), dq, np.sign(dq), ddq], axis=1)
    return robot, np.stack([ddq, dq, q, np.ones(n)], axis=1)


def recordings(seed: int, phase_loaded: float = 0.7, n: int = 1000) -> tuple[Regression, Regression]:
    """The robot alone, and the robot with the human on a motion of its own (or on the same, at phase 0.3)."""
    random = np.random.default_rng(seed)
    alone_robot, alone_human = rows(0.3, n)
    robot, human = rows(phase_loaded, n)
    white = random.normal(0, SIGMA, (2, n))
    arrays = (
        (alone_robot, alone_human, alone_robot @ ROBOT + white[0]),
        (robot, human, robot @ ROBOT + human @ HUMAN + white[1]),
    )
    alone, loaded = (Regression(*(jnp.asarray(x) for x in part), jnp.ones(n, bool)) for part in arrays)
    return alone, loaded


def phase_for(method: int) -> float:
    """Method 3 needs the same motion twice."""
    return 0.3 if method == 3 else 0.7


def run(method: int, alone: Regression, loaded: Regression, window: int = WINDOW, step: int = STEP) -> Separation:
    return separate(method, fit_robot(alone), alone, loaded, MERGE, window, step)


def test_the_models_write_the_same_rows() -> None:
    robot, human = rows(0.7, 50)
    ddq, dq, q, _ = human.T
    np.testing.assert_allclose(RobotJoint(gear_ratio=RATIO).regressor(q, dq, ddq), robot, rtol=1e-13)
    np.testing.assert_allclose(HumanJoint().regressor(q, dq, ddq), human, rtol=1e-13)


def test_the_robot_alone() -> None:
    fit = fit_robot(recordings(0)[0])
    assert (np.abs(np.asarray(fit.theta) - ROBOT) < 4 * np.asarray(fit.stderr)).all()


@METHOD_IDS
def test_finds_the_human_within_four_standard_errors(method: int) -> None:
    for seed in range(2):
        found = run(method, *recordings(seed, phase_for(method)))
        fit = found.fit
        assert np.isfinite(fit.theta).all()
        assert found.warning == ""
        near = np.abs(np.asarray(fit.theta) - HUMAN) <= 4 * np.asarray(fit.stderr)
        assert near.all(axis=1).mean() >= 0.95, (method, seed, near.mean(axis=0))
        assert fit.theta.shape == ((1000 - WINDOW) // STEP + 1, 4)
        np.testing.assert_array_equal(fit.last, WINDOW - 1 + STEP * np.arange(len(fit.last)))


@METHOD_IDS
def test_is_exact_without_noise(method: int) -> None:
    robot, human = rows(phase_for(method))
    alone, _ = rows(0.3)
    valid = jnp.ones(1000, bool)
    parts = (
        Regression(jnp.asarray(alone), jnp.asarray(human), jnp.asarray(alone @ ROBOT), valid),
        Regression(jnp.asarray(robot), jnp.asarray(human), jnp.asarray(robot @ ROBOT + human @ HUMAN), valid),
    )
    found = run(method, *parts)
    np.testing.assert_allclose(found.fit.theta, np.broadcast_to(HUMAN, found.fit.theta.shape), rtol=1e-6)
    np.testing.assert_allclose(found.torque, human @ HUMAN, atol=1e-12)


SEEDS = 300
MIDDLE = slice(200, 200 + WINDOW)


@cache
def many(method: int) -> tuple[Numbers, Numbers]:
    """(seeds, 4) estimates and standard errors of one window: the same recordings with other noise."""
    phase = phase_for(method)
    parts = [recordings(seed, phase) for seed in range(SEEDS)]
    alone, loaded = parts[0]
    torques = jnp.stack([jnp.stack([a.torque, b.torque]) for a, b in parts])

    def one(torque: jax.Array, robot: WindowFit) -> tuple[jax.Array, jax.Array]:
        R = Regression(alone.robot, alone.human, torque[0], alone.valid)
        RH = Regression(loaded.robot, loaded.human, torque[1], loaded.valid)
        R, RH = (jax.tree.map(lambda x: x[MIDDLE], part) for part in (R, RH))
        fit = separate(method, robot, R, RH, MERGE, WINDOW).fit
        return fit.theta[0], fit.stderr[0]

    def robot_of(torque: jax.Array) -> WindowFit:
        return least_squares(alone.robot, torque[0], alone.valid)

    theta, stderr = jax.jit(jax.vmap(lambda torque: one(torque, robot_of(torque))))(torques)
    return np.asarray(theta), np.asarray(stderr)


@METHOD_IDS
def test_standard_errors_are_honest(method: int) -> None:
    """They include the uncertainty of the robot's parameters."""
    theta, stderr = many(method)
    ratio = stderr.mean(axis=0) / theta.std(axis=0, ddof=1)
    assert ((ratio > 0.85) & (ratio < 1.15)).all(), ratio
    bias = np.abs(theta.mean(axis=0) - HUMAN) / (theta.std(axis=0, ddof=1) / np.sqrt(SEEDS))
    assert (bias < 4).all(), bias


def test_method_3_warns_when_the_motions_differ() -> None:
    found = run(3, *recordings(0, phase_loaded=0.7))
    assert "the two motions differ" in found.warning
    assert run(3, *recordings(0, phase_loaded=0.3)).warning == ""


def test_method_3_does_not_mind_a_difference_that_hardly_matters() -> None:
    assert run(3, *recordings(0, phase_loaded=0.3 + 1e-4)).warning == ""


def test_method_3_on_one_recording_twice_finds_no_human_and_does_not_break() -> None:
    alone, _ = recordings(0)
    found = run(3, alone, alone)
    np.testing.assert_allclose(found.fit.theta, 0.0, atol=1e-15)


def test_method_2_subtracts_what_was_merged() -> None:
    alone, loaded = recordings(0)
    robot, found = fit_robot(alone), run(2, alone, loaded)
    cut = slice(3 * STEP, 3 * STEP + WINDOW)
    # gravity x, y, viscous + damping, Coulomb, inertia + inertia, stiffness, offset
    W = np.concatenate([loaded.robot, loaded.human[:, 2:]], axis=1)[cut]
    both, rss = np.linalg.lstsq(W, loaded.torque[cut])[:2]
    variance = np.diag(np.linalg.inv(W.T @ W)) * rss[0] / (WINDOW - 7)
    alone_theta, alone_variance = np.asarray(robot.theta), np.asarray(robot.stderr) ** 2
    expected = [both[4] - alone_theta[4], both[2] - alone_theta[2], both[5], both[6]]
    inherited = np.array([alone_variance[4], alone_variance[2], 0.0, 0.0])
    np.testing.assert_allclose(found.fit.theta[3], expected, rtol=1e-6)
    np.testing.assert_allclose(found.fit.stderr[3], np.sqrt(variance[[4, 2, 5, 6]] + inherited), rtol=1e-6)


def test_method_4_shares_the_robot_between_both_recordings() -> None:
    alone, loaded = recordings(0)
    found, cut = run(4, alone, loaded), slice(2 * STEP, 2 * STEP + WINDOW)
    W = np.block(
        [[np.asarray(alone.robot)[cut], np.zeros((WINDOW, 4))], [np.asarray(loaded.robot)[cut], loaded.human[cut]]]
    )
    expected = np.linalg.lstsq(W, np.r_[alone.torque[cut], loaded.torque[cut]])[0]
    np.testing.assert_allclose(found.fit.theta[2], expected[5:], rtol=1e-7)
    assert int(found.fit.samples[2]) == 2 * WINDOW


@METHOD_IDS
def test_a_masked_sample_does_not_count_whatever_it_holds(method: int) -> None:
    alone, loaded = recordings(0, phase_for(method))
    random = np.random.default_rng(5)
    good = [random.random(1000) < 0.8 for _ in range(2)]
    results = []
    for hidden in (0.0, np.nan):
        parts = [
            Regression(part.robot, part.human, jnp.where(valid, part.torque, hidden), jnp.asarray(valid))
            for part, valid in zip((alone, loaded), good, strict=True)
        ]
        results.append(run(method, *parts).fit)
    np.testing.assert_allclose(results[1].theta, results[0].theta, rtol=1e-9)
    np.testing.assert_allclose(results[1].stderr, results[0].stderr, rtol=1e-9)


@pytest.mark.parametrize(
    "broken",
    [
        pytest.param(lambda robot: jnp.zeros_like(robot), id="still"),
        pytest.param(lambda robot: robot.at[:, 4].set(0.3 * robot[:, 2]), id="two columns alike"),
        pytest.param(lambda robot: robot.at[:, 3].set(0.0), id="a column silent"),
    ],
)
def test_a_robot_that_was_not_excited_is_refused(broken: object) -> None:
    alone, _ = recordings(0)
    still = Regression(broken(alone.robot), alone.human, alone.torque, alone.valid)  # type: ignore[operator]
    with pytest.raises(ValueError, match="does not determine the robot's parameters"):
        fit_robot(still)


@METHOD_IDS
def test_different_lengths(method: int) -> None:
    alone, loaded = recordings(0, phase_for(method))
    shorter = jax.tree.map(lambda x: x[:700], alone)
    found = run(method, shorter, loaded)
    if method in (1, 2):  # they never compare the two
        assert found.warning == ""
        assert len(found.torque) == 1000
    else:
        assert "differ in length" in found.warning
        assert "700 rows" in found.warning
        assert len(found.torque) == 700
        assert int(found.fit.last[-1]) < 700


@pytest.mark.parametrize("method", [0, 5, -1])
def test_there_is_no_other_method(method: int) -> None:
    alone, loaded = recordings(0)
    with pytest.raises(ValueError, match="methods 1, 2, 3 and 4"):
        separate(method, fit_robot(alone), alone, loaded, MERGE, WINDOW)


def without_noise(phase_loaded: float, robot_lacks: float = 0.0) -> tuple[Regression, Regression]:
    """As `recordings`; `robot_lacks` [N m] of a torque by the cube of the angle, which no column knows."""
    parts = []
    for phase, human in ((0.3, 0 * HUMAN), (phase_loaded, HUMAN)):
        robot, columns = rows(phase)
        torque = robot @ ROBOT + columns @ human + robot_lacks * np.abs(columns[:, 2] / 5) ** 3
        parts.append(Regression(*map(jnp.asarray, (robot, columns, torque)), jnp.ones(1000, bool)))
    return parts[0], parts[1]


@pytest.mark.parametrize("phase", [0.305, 0.32])
def test_method_3_takes_off_what_the_robots_own_torque_differs_by(phase: float) -> None:
    """Of motions that differ a little; without that, the inertia would be off by a tenth and more."""
    alone, loaded = without_noise(phase)
    found = run(3, alone, loaded)
    np.testing.assert_allclose(found.fit.theta, np.broadcast_to(HUMAN, found.fit.theta.shape), rtol=1e-6)
    assert "own torque differs by" in found.warning
    assert "was taken off" in found.warning
    assert not found.doubts
    cut = slice(0, WINDOW)
    plain = np.linalg.lstsq(loaded.human[cut], (loaded.torque - alone.torque)[cut])[0]
    assert np.abs(plain / HUMAN - 1).max() > 0.1


def test_method_3_is_as_sure_as_it_should_be_where_the_motions_differ() -> None:
    """The correction's own error is among the errors: here it is most of them, by a robot that is hardly known."""
    alone, loaded = recordings(0, 0.36)
    short = np.arange(1000) < 150
    random, theta, stderr = np.random.default_rng(4), [], []
    for _ in range(60):
        noise = random.normal(0, SIGMA, (2, 1000))
        torques = alone.robot @ ROBOT + 5 * noise[0], loaded.robot @ ROBOT + loaded.human @ HUMAN + noise[1]
        R, RH = (Regression(p.robot, p.human, y, p.valid) for p, y in zip((alone, loaded), torques, strict=True))
        robot = fit_robot(Regression(R.robot, R.human, R.torque, jnp.asarray(short)))
        fit = separate(3, robot, R, RH, MERGE, 1000).fit
        theta.append(np.asarray(fit.theta[0]))
        stderr.append(np.asarray(fit.stderr[0]))
    spread, claimed = np.std(theta, axis=0), np.sqrt(np.mean(np.square(stderr), axis=0))
    assert ((claimed / spread > 0.75) & (claimed / spread < 1.35)).all(), claimed / spread
    assert (np.abs(np.mean(theta, axis=0) - HUMAN) < 4 * spread / np.sqrt(60)).all()


def test_method_3_doubts_all_of_another_motion() -> None:
    found = run(3, *without_noise(0.7))
    assert list(found.doubts) == [0, 1, 2, 3]
    assert "two motions and not one" in found.doubts[0]
    assert found.doubts[0] in found.warning


def test_method_3_doubts_what_the_robots_model_cannot_take_off() -> None:
    """The share that the model leaves of the robot's torque moves the human's parameters by more than 5 %."""
    found = run(3, *without_noise(0.32, robot_lacks=3e-3))
    assert found.doubts
    assert all("of the robot's torque unexplained" in why for why in found.doubts.values())
    assert not run(3, *without_noise(0.32)).doubts


@METHOD_IDS
def test_a_robot_that_may_have_changed_makes_the_human_less_sure(method: int) -> None:
    """By as much as the columns that both have may have changed; a change of another column hardly looks like these."""
    alone, loaded = recordings(0, phase_for(method))
    sd = np.array([0.0, 0.0, 3e-5, 0.0, 2e-6])
    robot = fit_robot(alone)
    found = separate(method, robot, alone, loaded, MERGE, WINDOW, STEP, change=np.diag(sd**2))
    before = run(method, alone, loaded)
    np.testing.assert_array_equal(found.fit.theta, before.fit.theta)
    grown = np.asarray(found.fit.stderr) ** 2 - np.asarray(before.fit.stderr) ** 2
    np.testing.assert_allclose(grown[:, :2], np.broadcast_to(sd[[4, 2]] ** 2, grown[:, :2].shape), rtol=1e-6)
    np.testing.assert_allclose(np.asarray(found.fit.stderr)[:, 2:], np.asarray(before.fit.stderr)[:, 2:], rtol=1e-6)


@METHOD_IDS
def test_what_the_human_is_moved_by_is_what_a_changed_robot_moves(method: int) -> None:
    """Coulomb friction, which only the robot has."""
    alone, loaded = without_noise(phase_for(method))
    changed = Regression(loaded.robot, loaded.human, loaded.torque + 1e-3 * loaded.robot[:, 3], loaded.valid)
    found = separate(method, fit_robot(alone), alone, loaded, MERGE, WINDOW, STEP, follow=True)
    assert found.passed_on is not None
    moved = run(method, alone, changed).fit.theta - found.fit.theta
    np.testing.assert_allclose(moved, 1e-3 * found.passed_on[3], rtol=1e-5, atol=1e-12)
