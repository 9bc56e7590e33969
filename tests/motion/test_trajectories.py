"""Reference motions: what all of them promise, what each is the best of, and the two tables of Fourier series."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import cumulative_simpson

from jaximp.motion.trajectories import FourierSeries, MinimumJerk, RaisedSine, SixthOrder, at_rest, jerk
from jaximp.simulation.rig import GRAVITY, HUMAN_TRAJECTORY, ROBOT_TRAJECTORY

SERIES = FourierSeries(sine=[0.4, -1.2, 0.3], cosine=[0.7, 0.1, -0.5], offset=0.2, period=4.0)
TWO_SERIES = FourierSeries(
    sine=[[0.4, -1.2, 0.3], [0.1, 0.2, -0.9]],
    cosine=[[0.7, 0.1, -0.5], [0.3, 0.0, 1.1]],
    offset=[0.2, -0.4],
    period=4.0,
)
WAY_POINTS = np.array([[0.1, 0.0], [1.0, -0.5], [0.4, 0.2], [0.6, 0.9]])
DURATIONS = np.array([0.3, 0.2, 0.5])
IN_MOTION = MinimumJerk([0.1, 0.6], 0.5, end_velocities=[1.0, -2.0], end_accelerations=[3.0, 4.0])
STATIC_TASK = RaisedSine.of_displacement(0.008, 0.16)

TRAJECTORIES = {
    "series": SERIES,
    "two series at rest": at_rest(TWO_SERIES),
    "in motion": IN_MOTION,
    "two chains": MinimumJerk(WAY_POINTS, DURATIONS, end_velocities=[[0.0, 0.2], [0.3, 0.0]]),
    "sixth order": SixthOrder(0.1, 0.6, 0.5),
    "two raised sines": RaisedSine([1.5, -2.0], 0.16),
}
every_trajectory = pytest.mark.parametrize("trajectory", TRAJECTORIES.values(), ids=TRAJECTORIES.keys())
TIMES = jnp.array([[-0.1, 0.0, 0.03, 0.08, 0.11, 0.16, 0.27, 0.28], [0.3, 0.39, 0.4, 0.5, 0.7, 1.0, 1.3, 4.0]])
"""Among them the borders of all pieces of the motions above."""


@jax.jit
def motion(trajectory: Any, t: jax.Array) -> tuple[jax.Array, ...]:
    """Position, velocity, acceleration, jerk."""
    return (*trajectory(t), jerk(trajectory, t))


@every_trajectory
def test_each_value_is_the_derivative_of_the_one_before_at_any_batch_of_times(trajectory: Any) -> None:
    @jax.jit
    @jax.vmap
    def position_and_derivatives(t: jax.Array) -> list[jax.Array]:
        f, found = lambda t: trajectory(t)[0], []
        for _ in range(4):
            found.append(f(t))
            f = jax.jacfwd(f)
        return found

    for values, expected in zip(motion(trajectory, TIMES), position_and_derivatives(TIMES.ravel()), strict=True):
        assert values.shape == TIMES.shape + expected.shape[1:]
        assert values.dtype == np.float64
        np.testing.assert_allclose(values, expected.reshape(values.shape), rtol=1e-10, atol=1e-10)


@every_trajectory
def test_gradients_are_right_between_the_borders_and_finite_everywhere(trajectory: Any) -> None:
    @jax.jit
    def some_number(trajectory: Any, t: jax.Array) -> jax.Array:
        values = jnp.stack(trajectory(t))
        return jnp.vdot(jnp.cos(jnp.arange(values.size)), values)

    gradient = jax.jit(jax.grad(some_number, argnums=(0, 1)))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient(trajectory, TIMES)))

    where = (trajectory, TIMES + 0.013)
    leaves, structure = jax.tree.flatten(where)
    for i, slope in enumerate(jax.tree.leaves(gradient(*where))):
        step = 1e-6 * np.sin(1.0 + np.arange(slope.size).reshape(slope.shape))
        ends = [
            some_number(*structure.unflatten([*leaves[:i], leaves[i] + s, *leaves[i + 1 :]])) for s in (step, -step)
        ]
        np.testing.assert_allclose(ends[0] - ends[1], 2 * np.vdot(step, slope), rtol=1e-5, atol=1e-9)


def test_series_of_several_joints_are_those_of_each() -> None:
    for j in range(2):
        alone = FourierSeries(TWO_SERIES.sine[j], TWO_SERIES.cosine[j], TWO_SERIES.offset[j], 4.0)
        for together, value in zip(motion(TWO_SERIES, TIMES), motion(alone, TIMES), strict=True):
            np.testing.assert_allclose(together[..., j], value, atol=1e-12)
    assert TWO_SERIES.highest_frequency == SERIES.highest_frequency == 0.75


def test_series_at_rest_is_the_nearest_one() -> None:
    rest = at_rest(TWO_SERIES)
    ends = np.stack(motion(rest, TIMES)[:3])[:, np.isin(TIMES, [0.0, 4.0])]
    for value, expected in zip(ends, ([0.2, -0.4], 0.0, 0.0), strict=True):
        np.testing.assert_allclose(value, np.broadcast_to(expected, (2, 2)), atol=1e-13)

    def beginning(x: jax.Array) -> jax.Array:
        return jnp.stack(FourierSeries(sine=x[:3], cosine=x[3:], period=4.0)(0.0))

    conditions = np.asarray(jax.jacobian(beginning)(jnp.zeros(6)))
    for j in range(2):
        x = np.concatenate([TWO_SERIES.sine[j], TWO_SERIES.cosine[j]])
        nearest = x - np.linalg.pinv(conditions) @ conditions @ x
        np.testing.assert_allclose(np.concatenate([rest.sine[j], rest.cosine[j]]), nearest, atol=1e-13)


def test_two_harmonics_at_rest_keep_only_sines() -> None:
    rest = at_rest(FourierSeries(sine=[1.0, 0.0], cosine=[1.0, 2.0]))
    np.testing.assert_allclose(rest.sine, [0.5, -0.5])
    np.testing.assert_allclose(rest.cosine, 0.0, atol=1e-15)
    with pytest.raises(ValueError, match="at least 2, or 3 to keep cosines"):
        at_rest(FourierSeries(sine=[1.0], cosine=[1.0]))


def least_jerk(
    start: tuple[float, float, float], conditions: list[tuple[int, float, float]], ease: Callable[[np.ndarray], Any]
) -> tuple[np.ndarray, np.ndarray]:
    """Jerk in 4000 cells of one second whose square, over `ease`, has the least sum: eq. (15) of Lakatos et al. 2011.

    A condition is (order, time, value) of a derivative. All of them are linear in the jerk.
    """
    t = (np.arange(4000) + 0.5) / 4000
    rows, values = [], []
    for order, time, value in conditions:
        q, dq, ddq = start
        left = np.maximum(time - t, 0.0)
        rows.append(np.stack([left**2 / 2, left, left > 0])[order] / 4000)
        values.append(value - [q + dq * time + ddq * time**2 / 2, dq + ddq * time, ddq][order])
    A, eased = np.stack(rows), np.stack(rows) * ease(t)
    return t, eased.T @ np.linalg.solve(A @ eased.T, np.array(values))


REST = [(0, 1.0, 0.6), (1, 1.0, 0.0), (2, 1.0, 0.0)]


@pytest.mark.parametrize(
    ("trajectory", "start", "conditions", "ease"),
    [
        pytest.param(MinimumJerk([0.1, 0.6], 1.0), (0.1, 0.0, 0.0), REST, np.ones_like, id="fifth order"),
        pytest.param(
            MinimumJerk([0.1, 0.6], 1.0, IN_MOTION.end_velocities, IN_MOTION.end_accelerations),
            (0.1, 1.0, 3.0),
            [(0, 1.0, 0.6), (1, 1.0, -2.0), (2, 1.0, 4.0)],
            np.ones_like,
            id="in motion",
        ),
        pytest.param(
            MinimumJerk([0.1, 1.0, 0.4, 0.6], DURATIONS),
            (0.1, 0.0, 0.0),
            [(0, 0.3, 1.0), (0, 0.5, 0.4), *REST],
            np.ones_like,
            id="chain",
        ),
        pytest.param(
            MinimumJerk([0.0, 0.05, 0.0], 0.5),
            (0.0, 0.0, 0.0),
            [(0, 0.5, 0.05), (0, 1.0, 0.0), *REST[1:]],
            np.ones_like,
            id="out and back",
        ),
        pytest.param(SixthOrder(0.1, 0.6, 1.0), (0.1, 0.0, 0.0), REST, lambda t: 1 - t, id="sixth order"),
    ],
)
def test_polynomials_minimise_the_squared_jerk(
    trajectory: Any,
    start: tuple[float, float, float],
    conditions: list[tuple[int, float, float]],
    ease: Callable[[np.ndarray], Any],
) -> None:
    t, best = least_jerk(start, conditions, ease)
    values = np.stack(motion(trajectory, np.append(t, [time for _, time, _ in conditions])))
    found, ends = values[3, : len(t)], values[:, len(t) :]
    np.testing.assert_allclose(found, best, atol=1e-5 * np.abs(best).max())
    assert np.sum(found**2 / ease(t)) == pytest.approx(np.sum(best**2 / ease(t)), rel=1e-5)
    for i, (order, _, value) in enumerate(conditions):
        assert ends[order, i] == pytest.approx(value, abs=1e-12)


def test_sixth_order_has_more_jerk_than_motions_that_drop_it_just_before_the_end() -> None:
    _, dropped = least_jerk((0.1, 0.0, 0.0), REST, lambda t: t < 0.999)
    assert dropped[-1] == 0
    assert np.mean(dropped**2) == pytest.approx(720 * 0.5**2, rel=0.02)
    _, eased = least_jerk((0.1, 0.0, 0.0), REST, lambda t: 1 - t)
    assert np.mean(eased**2) == pytest.approx((720 + 3600 / 7) * 0.5**2, rel=1e-5)


def test_sixth_order_ends_without_jerk_and_is_less_balanced() -> None:
    t_f = 0.3
    t, weights = np.polynomial.legendre.leggauss(7)

    def ratios(trajectory: Any) -> np.ndarray:
        """Eq. (17); seven points are exact for these polynomials."""
        squares = [weights @ np.square(x) for x in motion(trajectory, t_f * (t + 1) / 2)[1:]]
        return np.array([squares[0] / squares[1], squares[0] / squares[2], squares[1] / squares[2]])

    fifth, sixth = ratios(MinimumJerk([0.0, 0.05], t_f)), ratios(SixthOrder(0.0, 0.05, t_f))
    assert motion(SixthOrder(0.0, 0.05, t_f), np.full(7, t_f))[3] == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(fifth, [t_f**2 / 12, t_f**4 / 504, t_f**2 / 42], rtol=1e-9)
    np.testing.assert_allclose(sixth, [3 * t_f**2 / 44, t_f**4 / 792, t_f**2 / 54], rtol=1e-9)
    assert (sixth < fifth).all()
    assert (fifth < 1).all()


def test_chain_of_unlike_durations_is_smooth_to_the_fourth_derivative() -> None:
    durations = np.array([2.0, 0.02, 10.0])
    chain = MinimumJerk(WAY_POINTS, durations)
    borders = np.cumsum(durations)[:-1]

    @jax.jit
    def with_snap(t: jax.Array) -> tuple[jax.Array, ...]:
        return (*chain(t), *jax.jvp(lambda t: jerk(chain, t), (t,), (jnp.ones_like(t),)))

    before, after = np.split(np.stack(with_snap(np.concatenate([borders * (1 - 1e-13), borders]))), 2, axis=1)
    np.testing.assert_allclose(after[0], WAY_POINTS[1:-1], atol=1e-12)
    for left, right in zip(before, after, strict=True):
        np.testing.assert_allclose(left, right, rtol=1e-7, atol=1e-7 * np.abs(right).max())


def test_chains_of_several_joints_are_those_of_each() -> None:
    together = TRAJECTORIES["two chains"]
    for j, velocities in enumerate([[0.0, 0.3], [0.2, 0.0]]):
        alone = MinimumJerk(WAY_POINTS[:, j], DURATIONS, end_velocities=velocities)
        for values, value in zip(motion(together, TIMES), motion(alone, TIMES), strict=True):
            np.testing.assert_allclose(values[..., j], value, atol=1e-10)


def test_outside_the_motion_rests_or_goes_straight_on() -> None:
    before, after = TIMES < 0, TIMES > 0.5
    for rests, jerks in ((MinimumJerk([0.1, 0.6], 0.5), [240.0, 240.0]), (SixthOrder(0.1, 0.6, 0.5), [480.0, 0.0])):
        q, dq, ddq, dddq = motion(rests, TIMES)
        np.testing.assert_allclose(dddq[(TIMES == 0.0) | (TIMES == 0.5)], jerks, atol=1e-10)
        np.testing.assert_array_equal(q[before], 0.1)
        np.testing.assert_array_equal(q[after], 0.6)
        np.testing.assert_array_equal([dq[before | after], ddq[before | after]], 0.0)
    q, dq, ddq, _ = motion(IN_MOTION, TIMES)
    np.testing.assert_allclose(q[before], 0.1 + TIMES[before], atol=1e-14)
    np.testing.assert_allclose(q[after], 0.6 - 2 * (TIMES[after] - 0.5), atol=1e-14)
    np.testing.assert_array_equal(dq[after], -2.0)
    np.testing.assert_array_equal(ddq[before | after], 0.0)
    np.testing.assert_allclose([ddq[TIMES == 0.0], ddq[TIMES == 0.5]], [[3.0], [4.0]], atol=1e-12)


def test_raised_sine_is_the_profile_of_boerner_2020_and_its_integrals() -> None:
    def profile(t: np.ndarray, amplitude: float, duration: float) -> np.ndarray:
        wave = amplitude / 2 * (np.sin(4 * np.pi * t / duration + 3 * np.pi / 2) + 1)
        return np.where((t < 0) | (t > duration), 0.0, np.where(t < duration / 2, wave, -wave))

    t, step = np.linspace(0.0, 0.5, 50_001, retstep=True)
    acceleration = profile(t, 2.5, 0.16) + profile(t - 0.16, -4 / 9 * 2.5, 0.24)
    velocity = cumulative_simpson(acceleration, dx=step, initial=0)
    q, dq, ddq, _ = motion(STATIC_TASK, t)
    np.testing.assert_allclose(ddq, acceleration, atol=1e-13)
    np.testing.assert_allclose(dq, velocity, atol=1e-12)
    np.testing.assert_allclose(q, cumulative_simpson(velocity, dx=step, initial=0), atol=1e-12)


def test_raised_sine_reaches_what_it_is_asked_for_and_returns() -> None:
    assert STATIC_TASK.amplitude == pytest.approx(2.5, rel=1e-14)
    static = np.stack(motion(STATIC_TASK, np.append(np.linspace(0.0, 0.4, 5001), [-2.0, 0.4 + 1e-9, 100.0]))[:3])
    assert np.argmax(static[0]) == 2000
    assert static[0, 2000] == pytest.approx(0.008, rel=1e-14)
    np.testing.assert_allclose(static[:, 5000], 0.0, atol=1e-16)
    np.testing.assert_array_equal(static[:, 5001:], 0.0)

    dynamic_task = RaisedSine.of_force(40 * np.array([0.6, 0.8]), 0.07, inertia=5.0, damping=20.0)
    dynamic = np.stack(motion(dynamic_task, np.append(np.linspace(0.0, 0.035, 5001), [-0.1, 0.175 + 1e-9]))[:3])
    np.testing.assert_allclose(np.max(5 * dynamic[2] + 20 * dynamic[1], axis=0), [24.0, 32.0], rtol=1e-6)
    np.testing.assert_array_equal(dynamic[:, 5001:], 0.0)


def test_series_is_periodic() -> None:
    for values, later in zip(TWO_SERIES(TIMES), TWO_SERIES(TIMES + 4.0), strict=True):
        np.testing.assert_allclose(values, later, atol=1e-12)


def test_coefficients_are_differentiable_and_batchable() -> None:
    def displacement(sine: jax.Array) -> jax.Array:
        return FourierSeries(sine, jnp.zeros(3), period=4.0)(0.5)[0]

    w = 2 * np.pi / 4.0 * np.arange(1, 4)
    np.testing.assert_allclose(jax.jit(jax.grad(displacement))(jnp.ones(3)), np.sin(w * 0.5) / w, atol=1e-12)
    np.testing.assert_allclose(jax.jit(jax.vmap(displacement))(jnp.eye(3)), np.sin(w * 0.5) / w, atol=1e-12)


def test_trajectories_are_made_inside_compiled_and_batched_functions() -> None:
    @jax.jit
    @jax.vmap
    def halfway(duration: jax.Array) -> list[jax.Array]:
        made = [MinimumJerk([0, 1], duration), SixthOrder(0, 1, duration), RaisedSine.of_displacement(1, duration)]
        return [trajectory(duration / 2)[0] for trajectory in made]

    for positions, expected in zip(halfway(jnp.array([0.1, 2.0])), [0.5, 0.65625, 0.5], strict=True):
        np.testing.assert_allclose(positions, expected, atol=1e-14)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FourierSeries(np.zeros(2), np.zeros(3)), "2 harmonics and cosine 3: give both the same number"),
        (lambda: FourierSeries(0.0, 0.0), r"sine is \(\), .* give coefficients \(harmonics,\)"),
        (lambda: FourierSeries(np.zeros(2), 0.0), r"cosine \(\), .* give coefficients \(harmonics,\)"),
        (lambda: FourierSeries(np.zeros((2, 3)), np.zeros(3)), r"sine is \(2, 3\), cosine \(3,\), .* \(joints,\)"),
        (lambda: FourierSeries(np.zeros(3), np.zeros(3), np.zeros(2)), r"offset \(2,\): .* one offset"),
        (lambda: FourierSeries(np.zeros(3), np.zeros(3), period=0.0), "period is 0.0: it must be positive"),
        (lambda: MinimumJerk(0.5, 1.0), "give at least a start and an end"),
        (lambda: MinimumJerk([0.5], 1.0), "give at least a start and an end"),
        (lambda: MinimumJerk([0, 1, 2], [1.0, -1.0]), r"durations is \[1.0, -1.0\]: it must be positive"),
        (lambda: MinimumJerk([0, 1], np.inf), "durations is inf: it must be positive and finite"),
        (lambda: MinimumJerk([0, 1, 2], [1, 1, 1]), r"durations is \(3,\): points \(3,\) need \(2,\) or one number"),
        (lambda: MinimumJerk(np.zeros((3, 2)), 1, [0, 1]), r"end_velocities is \(2,\): .* need \(2, 2\) or one number"),
        (lambda: MinimumJerk([0, 1], 1, 0, [0, 1, 2]), r"end_accelerations is \(3,\): .* need \(2,\) or one number"),
        (lambda: SixthOrder(0.0, [1.0, 2.0], 1.0), r"start is \(\) and end \(2,\): give both the same joints"),
        (lambda: SixthOrder(0.0, 1.0, -1.0), "duration is -1.0: it must be positive"),
        (lambda: RaisedSine(1.0, 0.0), "duration is 0.0: it must be positive"),
        (lambda: RaisedSine(1.0, 0.1, np.nan), "ratio is nan: it must be positive"),
    ],
)
def test_wrong_parameters_are_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as refused:
        make()
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("trajectory", "order", "condition"),
    [pytest.param(ROBOT_TRAJECTORY, 5, 11.5, id="paper"), pytest.param(HUMAN_TRAJECTORY, 7, 1.733, id="bands")],
)
def test_tables_excite_what_they_are_for_within_the_range_of_the_handle(
    trajectory: FourierSeries, order: int, condition: float
) -> None:
    t = np.arange(100_000) * 1e-4
    q, dq, ddq = (np.asarray(x) for x in trajectory(t))
    robot = np.stack([GRAVITY * np.sin(q / 15), GRAVITY * np.cos(q / 15), dq, np.sign(dq), ddq], axis=1)
    human = np.stack([ddq, dq, q], axis=1)
    assert trajectory.sine.shape == (order,)
    assert trajectory.period == 10.0
    assert np.linalg.cond(robot if trajectory is ROBOT_TRAJECTORY else human) <= condition
    assert np.abs(q).max() <= 10.5
    # The paper drops samples with |dq| < 0.1 rad/s: only few may be lost.
    assert np.mean(np.abs(dq) < 0.1) < 0.03
