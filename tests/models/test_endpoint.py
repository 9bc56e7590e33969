"""Impedance at the hand: against numerical derivatives of force along position, and ellipses that are known."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaximp.models import (
    ArmGeometry,
    ellipse,
    endpoint_damping,
    endpoint_impedance,
    endpoint_inertia,
    endpoint_stiffness,
    mass_matrix,
    propagated_stderr,
)

ARM = ArmGeometry((0.29, 0.34), shoulder=(0.1, -0.2))
Q = np.array([0.3, 1.4])
XI = np.array([0.268, 0.084, 0.074])
D = np.array([[2.4, 1.2], [1.0, 1.4]])
K = np.array([[29.0, 14.0], [12.0, 17.0]])


@pytest.mark.parametrize("force", [(0.0, 0.0), (12.0, -30.0)], ids=["no force", "force"])
def test_stiffness_is_the_slope_of_the_force_along_the_position(force: tuple[float, float]) -> None:
    held = ARM.joint_torque(Q, np.array(force))

    def force_at(x: jax.Array) -> jax.Array:
        """That holds the hand at x, against springs of the joints."""
        q = ARM.inverse(x)
        return jnp.linalg.solve(ARM.jacobian(q).T, held + K @ (q - Q))

    x, step = ARM.forward(Q), 1e-5
    slopes = [(force_at(x + step * e) - force_at(x - step * e)) / (2 * step) for e in np.eye(2)]
    found = endpoint_stiffness(ARM, Q, K, np.array(force))
    np.testing.assert_allclose(found, np.stack(slopes, axis=1), rtol=1e-6)
    same = np.allclose(found, endpoint_stiffness(ARM, Q, K))
    assert same == (force == (0.0, 0.0))


def test_force_of_the_hand_does_the_work_of_the_joints() -> None:
    J = np.asarray(ARM.jacobian(Q))
    inverse = np.linalg.inv(J)
    np.testing.assert_allclose(endpoint_damping(ARM, Q, D), inverse.T @ D @ inverse, rtol=1e-12)
    np.testing.assert_allclose(endpoint_inertia(ARM, Q, XI), inverse.T @ mass_matrix(Q, XI) @ inverse, rtol=1e-12)
    many = endpoint_impedance(ARM, np.stack([Q, Q + 0.1]), XI, D, np.stack([K, 2 * K]))
    np.testing.assert_allclose(many.stiffness[1], endpoint_stiffness(ARM, Q + 0.1, 2 * K), rtol=1e-12)
    assert many.inertia.shape == many.damping.shape == (2, 2, 2)


@pytest.mark.parametrize("angle", [-1.5, -0.4, 0.0, 0.9, np.pi / 2])
@pytest.mark.parametrize("sign", [1, -1])
def test_ellipse_of_a_rotated_diagonal_matrix(angle: float, sign: int) -> None:
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    matrix = sign * turn @ np.diag([300.0, 100.0]) @ turn.T + np.array([[0, 7.0], [-7.0, 0]])
    found = ellipse(matrix)
    np.testing.assert_allclose([found.major, found.minor, found.shape], [300, 100, 3])
    np.testing.assert_allclose(found.size, np.pi * 3e4)
    np.testing.assert_allclose(np.sin(found.orientation - angle), 0, atol=1e-12)
    assert -np.pi / 2 - 1e-12 < found.orientation <= np.pi / 2 + 1e-12
    unit = np.stack([np.cos(np.linspace(0, 7, 9)), np.sin(np.linspace(0, 7, 9))])
    reached = ((matrix + matrix.T) / 2 @ unit).T
    distance = np.linalg.norm(np.asarray(found.outline(20_000))[None] - reached[:, None], axis=-1).min(axis=1)
    assert distance.max() < 0.1


def test_ellipse_of_an_indefinite_matrix_has_the_sizes_of_its_eigenvalues() -> None:
    found = ellipse(np.diag([2.0, -5.0]))
    np.testing.assert_allclose([found.major, found.minor, found.orientation], [5, 2, np.pi / 2])


@pytest.mark.slow
@pytest.mark.compiles
def test_standard_errors_of_an_ellipse_are_those_of_many_draws() -> None:
    theta = np.array([29.0, 13.0, 17.0])
    factor = np.array([[0.3, 0, 0], [0.1, 0.2, 0], [-0.1, 0.1, 0.2]])

    def of(theta: jax.Array) -> object:
        stiffness = jnp.stack([theta[..., :2], theta[..., 1:]], axis=-2)
        return ellipse(endpoint_stiffness(ARM, Q, stiffness))

    draws = of(theta + np.random.default_rng(0).normal(size=(20_000, 3)) @ factor.T)
    claimed = propagated_stderr(of, jnp.asarray(theta), jnp.asarray(factor @ factor.T))
    for one, many in zip(jax.tree.leaves(claimed), jax.tree.leaves(draws), strict=True):
        np.testing.assert_allclose(one, many.std(), rtol=0.03)
