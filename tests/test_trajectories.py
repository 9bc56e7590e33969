"""The finite Fourier series, and the two tables that were designed with it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaximp.simulation.rig import GRAVITY, HUMAN_TRAJECTORY, ROBOT_TRAJECTORY
from jaximp.trajectories import FourierSeries

SERIES = FourierSeries(sine=[0.4, -1.2, 0.3], cosine=[0.7, 0.1, -0.5], offset=0.2, period=4.0)


def test_series_is_the_sum_of_swevers_1997() -> None:
    t, w = np.linspace(0.0, 4.0, 37), 2 * np.pi / 4.0
    expected = np.full_like(t, 0.2)
    for k, (a, b) in enumerate(zip([0.4, -1.2, 0.3], [0.7, 0.1, -0.5], strict=True), start=1):
        expected += a / (w * k) * np.sin(w * k * t) - b / (w * k) * np.cos(w * k * t)
    np.testing.assert_allclose(SERIES(t)[0], expected, atol=1e-13)


def test_velocity_and_acceleration_are_the_gradients_of_position() -> None:
    t = jnp.linspace(0.0, 4.0, 23)
    _, dq, ddq = SERIES(t)
    velocity = jax.grad(lambda x: SERIES(x)[0])
    acceleration = jax.grad(velocity)
    np.testing.assert_allclose(dq, jax.jit(jax.vmap(velocity))(t), atol=1e-12)
    np.testing.assert_allclose(ddq, jax.jit(jax.vmap(acceleration))(t), atol=1e-12)


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_any_batch_of_times(shape: tuple[int, ...]) -> None:
    t = jnp.linspace(0.0, 1.0, int(np.prod(shape))).reshape(shape)
    for values, periodic in zip(SERIES(t), SERIES(t + 4.0), strict=True):
        assert values.shape == shape
        np.testing.assert_allclose(values, periodic, atol=1e-12)


def test_coefficients_are_differentiable_and_batchable() -> None:
    def displacement(sine: jax.Array) -> jax.Array:
        return FourierSeries(sine, jnp.zeros(3), period=4.0)(0.5)[0]

    w = 2 * np.pi / 4.0 * np.arange(1, 4)
    np.testing.assert_allclose(jax.jit(jax.grad(displacement))(jnp.ones(3)), np.sin(w * 0.5) / w, atol=1e-12)
    np.testing.assert_allclose(jax.jit(jax.vmap(displacement))(jnp.eye(3)), np.sin(w * 0.5) / w, atol=1e-12)


def test_unequal_numbers_of_coefficients_are_refused() -> None:
    with pytest.raises(ValueError, match="2 harmonics and cosine 3"):
        FourierSeries(sine=np.zeros(2), cosine=np.zeros(3))


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
