"""Reference motions: what all of them promise, what each is the best of, and the two tables of Fourier series."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaximp.simulation.rig import GRAVITY, HUMAN_TRAJECTORY, ROBOT_TRAJECTORY
from jaximp.trajectories import FourierSeries, at_rest, jerk

SERIES = FourierSeries(sine=[0.4, -1.2, 0.3], cosine=[0.7, 0.1, -0.5], offset=0.2, period=4.0)
TWO_SERIES = FourierSeries(
    sine=[[0.4, -1.2, 0.3], [0.1, 0.2, -0.9]],
    cosine=[[0.7, 0.1, -0.5], [0.3, 0.0, 1.1]],
    offset=[0.2, -0.4],
    period=4.0,
)

TRAJECTORIES = {
    "series": SERIES,
    "two series at rest": at_rest(TWO_SERIES),
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


def test_series_is_periodic() -> None:
    for values, later in zip(TWO_SERIES(TIMES), TWO_SERIES(TIMES + 4.0), strict=True):
        np.testing.assert_allclose(values, later, atol=1e-12)


def test_coefficients_are_differentiable_and_batchable() -> None:
    def displacement(sine: jax.Array) -> jax.Array:
        return FourierSeries(sine, jnp.zeros(3), period=4.0)(0.5)[0]

    w = 2 * np.pi / 4.0 * np.arange(1, 4)
    np.testing.assert_allclose(jax.jit(jax.grad(displacement))(jnp.ones(3)), np.sin(w * 0.5) / w, atol=1e-12)
    np.testing.assert_allclose(jax.jit(jax.vmap(displacement))(jnp.eye(3)), np.sin(w * 0.5) / w, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FourierSeries(np.zeros(2), np.zeros(3)), "2 harmonics and cosine 3: give both the same number"),
        (lambda: FourierSeries(0.0, 0.0), r"sine is \(\), .* give coefficients \(harmonics,\)"),
        (lambda: FourierSeries(np.zeros(2), 0.0), r"cosine \(\), .* give coefficients \(harmonics,\)"),
        (lambda: FourierSeries(np.zeros((2, 3)), np.zeros(3)), r"sine is \(2, 3\), cosine \(3,\), .* \(joints,\)"),
        (lambda: FourierSeries(np.zeros(3), np.zeros(3), np.zeros(2)), r"offset \(2,\): .* one offset"),
        (lambda: FourierSeries(np.zeros(3), np.zeros(3), period=0.0), "period is 0.0: it must be positive"),
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
