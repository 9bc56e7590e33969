"""A load in a stream of samples: the same as of all samples at once, and whether it changes."""

from __future__ import annotations

import numpy as np
import pytest

from factories.chains import SIZES, TWO_JOINTS, motion, truth_of, with_load
from jaximp.identification import FilterSettings, PayloadWindow, Pipeline, identify_robot
from jaximp.identification.payload import load_columns
from jaximp.models import Chain, parse_urdf
from jaximp.models.spatial import about

ARM = Chain(parse_urdf(TWO_JOINTS), friction=True, min_velocity=1e-6)
LOAD = about(0.7, np.array([0.03, 0.02, 0.08]), np.diag([2e-3, 3e-3, 1e-3]))
SEEN = [0, 1, 3, 6]
THETA, NOTHING = truth_of(ARM), np.zeros((len(ARM.names),) * 2)
SECONDS, RATE, CHUNK = 4.0, 100.0, 20


def weigh(**settings: object) -> PayloadWindow:
    return PayloadWindow(ARM, THETA, NOTHING, SECONDS, RATE, size=SIZES, **settings)  # type: ignore[arg-type]


WEIGH = weigh()


def stream(seed: int, seconds: float, change: float = 0.0, at: float = 8.0) -> tuple[np.ndarray, ...]:
    """Motion and torque (N, 2) with white noise; from an instant on the load is another."""
    time, q, dq, ddq = motion(seed, seconds)
    load = np.where((time < at)[:, None], 1.0, 1.0 + change) * LOAD
    theta = THETA + load @ load_columns(ARM).T
    torque = np.einsum("snp,sp->sn", np.asarray(ARM.observation_matrix(q, dq, ddq)), theta)
    return q, dq, ddq, torque + SIZES * np.random.default_rng(seed).normal(size=q.shape)


def passed(samples: tuple[np.ndarray, ...], by: PayloadWindow = WEIGH, chunk: int = CHUNK):  # type: ignore[no-untyped-def]
    state = by.start()
    for k in range(0, len(samples[0]), chunk):
        state = by.update(state, *(x[k : k + chunk] for x in samples))
    return state


def test_it_is_least_squares_of_the_last_seconds() -> None:
    samples = stream(0, 12.0)
    found = WEIGH.estimate(passed(samples))
    q, dq, ddq, torque = (x[-400:] for x in samples)
    W = np.asarray(ARM.observation_matrix(q, dq, ddq))
    columns = ((W @ load_columns(ARM))[..., SEEN] / SIZES[:, None]).reshape(-1, 4)
    rest = ((torque - W @ THETA) / SIZES).ravel()
    theta = np.linalg.lstsq(columns, rest)[0]
    np.testing.assert_allclose(
        found.theta[SEEN], theta, rtol=1e-3, atol=1e-5
    )  # what is thought beforehand weighs little
    assert np.isnan(np.delete(found.theta, SEEN)).all()
    textbook = np.sqrt(np.diagonal(np.linalg.inv(columns.T @ columns)))
    np.testing.assert_allclose(found.stderr[SEEN], textbook, rtol=0.6)
    assert not found.changed


def test_chunks_do_not_matter() -> None:
    samples = tuple(x[:70] for x in stream(1, 1.0))
    at_once, one_by_one = WEIGH.start(), WEIGH.start()
    at_once = WEIGH.update(at_once, *samples)
    for k in range(len(samples[0])):
        one_by_one = WEIGH.update(one_by_one, *(x[k] for x in samples))
    for a, b in zip(at_once, one_by_one, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9)


def test_errors_are_what_they_claim() -> None:
    apart, held, alarms = [], [], 0
    for seed in range(60):
        found = WEIGH.estimate(passed(stream(seed, SECONDS)))
        low, high = found.interval()
        apart.append(((found.theta - LOAD) / found.stderr)[SEEN])
        held.append(((low < LOAD) & (high > LOAD))[SEEN])
        alarms += found.changed
    assert 0.85 < np.sqrt(np.mean(np.square(apart))) < 1.2
    assert 0.91 < np.mean(held) < 0.985
    assert alarms <= 1


def test_a_change_is_noticed_and_when_it_was() -> None:
    """As long as it is inside of the window; then the load is the new one."""
    samples = stream(2, 14.0, change=0.5)
    state, seen = WEIGH.start(), {}
    for k in range(0, 1400, CHUNK):
        state = WEIGH.update(state, *(x[k : k + CHUNK] for x in samples))
        if (k + CHUNK) % 100 == 0:
            seen[(k + CHUNK) / 100] = WEIGH.estimate(state)
    changed = {time for time, found in seen.items() if found.changed}
    assert {9.0, 10.0} <= changed <= {9.0, 10.0, 11.0}
    assert seen[10.0].changed_ago == pytest.approx(2.0, abs=0.3)
    assert seen[8.0].mass.value == pytest.approx(0.7, abs=0.06)
    assert seen[14.0].mass.value == pytest.approx(1.05, abs=0.06)


def test_what_is_missing_does_no_harm() -> None:
    q, dq, ddq, torque = (x.copy() for x in stream(3, SECONDS))
    torque[100:140, 0], q[200], ddq[250] = np.nan, np.inf, np.nan
    found = WEIGH.estimate(passed((q, dq, ddq, torque)))
    assert np.abs((found.theta - LOAD)[SEEN] / found.stderr[SEEN]).max() < 4


def test_at_standstill_nothing_is_known() -> None:
    """And a window that is not half full says nothing either."""
    q, dq, ddq, torque = stream(4, SECONDS)
    at_rest = WEIGH.update(passed((q, dq, ddq, torque)), q[:1] + 0 * q, 0 * dq, 0 * ddq, torque)
    for state in (at_rest, WEIGH.start(), passed(tuple(x[:100] for x in (q, dq, ddq, torque)))):
        found = WEIGH.estimate(state)
        assert np.isnan(found.theta).all()
        assert not found.changed


def test_slow_motion_shows_mass_and_centre_alone() -> None:
    """Where nothing turns fast the inertia is not known, and the mass is no worse for it."""
    time = np.arange(0, 60.0, 1 / RATE)
    q = np.stack([0.8 * np.sin(0.12 * time), 0.9 * np.sin(0.17 * time)], axis=1)
    dq, ddq = np.gradient(q, 1 / RATE, axis=0), np.zeros_like(q)
    slow = PayloadWindow(ARM, THETA, NOTHING, 40.0, RATE, size=SIZES)
    theta = THETA + load_columns(ARM) @ LOAD
    torque = np.asarray(ARM.observation_matrix(q, dq, ddq)) @ theta
    torque = torque + SIZES * np.random.default_rng(5).normal(size=q.shape)
    found = slow.estimate(passed((q, dq, ddq, torque), slow, 600))
    assert np.isnan(found["load.Iyy"].value)
    assert abs(found.mass.value - 0.7) < 4 * found.mass.stderr < 0.2


def test_what_is_not_known_of_robot_and_gains_is_carried() -> None:
    samples = stream(6, SECONDS)
    plain = WEIGH.estimate(passed(samples))
    robot = weigh(gain_covariance=np.full((2, 2), 0.01), by_joint=np.stack([THETA, 0 * THETA], axis=1))
    common = robot.estimate(passed(samples, robot))
    grown = np.sqrt(common.stderr**2 - plain.stderr**2)
    np.testing.assert_allclose(grown[SEEN], 0.1 * np.abs(plain.theta[SEEN]), rtol=1e-3)
    pipeline = Pipeline(RATE, ARM, filter=FilterSettings(position_cutoff=8.0, decimation_cutoff=4.0))
    known = identify_robot(pipeline, with_load(ARM, 60))
    found = PayloadWindow.of(known, SECONDS, RATE)
    assert found.estimate(passed(samples, found)).mass.stderr > plain.mass.stderr


def test_bad_input_is_refused() -> None:
    with pytest.raises(ValueError, match="the chain has 10 base parameters"):
        PayloadWindow(ARM, THETA[:3], NOTHING[:3, :3], SECONDS, RATE)
    with pytest.raises(ValueError, match="it needs 20 at least"):
        PayloadWindow(ARM, THETA, NOTHING, 0.1, RATE)
    with pytest.raises(ValueError, match="both must be above zero"):
        weigh(largest=0.0)
