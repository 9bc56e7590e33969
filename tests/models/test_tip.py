"""A human at the tip of a robot, and what cannot be told apart from the robot."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from factories.robots import planar
from jaximp.models import Chain, HumanJoint, Joints, TipImpedance, combine, parse_urdf, read_urdf
from jaximp.models.urdf import SIX_JOINT_ARM

ARM = Chain(read_urdf(SIX_JOINT_ARM), tip="tool", friction=True, rotor=True)


def motion(n: int, rows: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(3, rows, n))


def power(q: jax.Array, dq: jax.Array) -> jax.Array:
    """Kinetic energy of masses 1, 2, 3 kg along x, y, z at the tip."""
    v = ARM.jacobian(q)[:3] @ dq
    return 0.5 * (jnp.array([1.0, 2.0, 3.0]) * v**2).sum()


def test_its_torque_is_that_of_lagrange() -> None:
    """Masses by Lagrange's equations, springs and dampers by virtual work."""
    model = TipImpedance(ARM)
    theta = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 70.0, 80.0, 90.0, -10.0, 11.0, -12.0])
    for q, dq, ddq in zip(*motion(6, 4), strict=True):
        inertial = jax.jvp(lambda q, dq: jax.grad(power, 1)(q, dq), (q, dq), (dq, ddq))[1] - jax.grad(power)(q, dq)
        J, x = ARM.jacobian(q)[:3], ARM.forward_kinematics(q)[1]
        force = theta[3:6] * (J @ dq) + theta[6:9] * x + theta[9:]
        np.testing.assert_allclose(model.torque(theta, q, dq, ddq), inertial + J.T @ force, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(model.equilibrium(theta), -theta[9:] / theta[6:9])


def test_full_matrices_are_symmetric_in_directions_of_ones_own() -> None:
    turned = np.array([[1.0, 1.0, 0.0], [-2.0, 2.0, 0.0]])
    model = TipImpedance(ARM, turned, full=True, mass=False)
    assert model.names == ("damping_1", "damping_12", "damping_2", "stiffness_1", "stiffness_12", "stiffness_2",
                           "force_1", "force_2")  # fmt: skip
    assert model.units[-1] == "N"
    q, dq, ddq = motion(6, 1, 3)[:, 0]
    theta = np.array([1.0, 0.3, 2.0, 50.0, 20.0, 80.0, 5.0, -6.0])
    D, K = np.array([[1, 0.3], [0.3, 2]]), np.array([[50, 20], [20, 80.0]])
    J = turned / np.linalg.norm(turned, axis=1)[:, None] @ np.asarray(ARM.jacobian(q)[:3])
    x = turned / np.linalg.norm(turned, axis=1)[:, None] @ np.asarray(ARM.forward_kinematics(q)[1])
    np.testing.assert_allclose(model.torque(theta, q, dq, ddq), J.T @ (D @ (J @ dq) + K @ x + theta[6:]), rtol=1e-10)
    rest = np.asarray(model.equilibrium(theta))
    np.testing.assert_allclose(K @ rest + theta[6:], 0, atol=1e-12)


@pytest.mark.slow  # compiles three models of six joints
def test_mass_in_all_directions_and_a_force_upwards_are_the_robots() -> None:
    human = TipImpedance(ARM)
    both = combine(ARM, human)
    assert len(both.names) == len(ARM.names) + len(human.names) - 1
    assert "human.force_z" not in both.names
    theta = np.random.default_rng(0).normal(size=len(ARM.names) + len(human.names))
    sample = motion(6, 20, 1)
    np.testing.assert_allclose(
        both.torque(np.array(both.merge) @ theta, *sample), (ARM + human).torque(theta, *sample), rtol=1e-8, atol=1e-8
    )
    W = np.asarray(both.regressor(*motion(6, 200, 2))).reshape(-1, len(both.names))
    assert np.linalg.matrix_rank(W / np.linalg.norm(W, axis=0)) == len(both.names)
    assert any("human.force_z" in text for text in both.sums.values())
    assert len(both.roles) == len(both.names)


def test_a_human_in_an_exoskeleton_adds_to_rotors_and_friction() -> None:
    robot = Chain(parse_urdf(planar()), gravity=(0, -9.81, 0), rotor=True, friction=True)
    human = Joints(HumanJoint(), HumanJoint())
    both = combine(robot, human)
    assert "robot.joint2.rotor_inertia+human.joint2.inertia" in both.names
    assert "robot.joint1.viscous_friction+human.joint1.damping" in both.names
    assert "human.joint1.stiffness" in both.names
    assert "human.joint1.inertia" in " ".join(
        both.sums.values()
    )  # with the first link's, which has no rotor of its own
    theta, sample = np.random.default_rng(0).normal(size=len(robot.names) + 8), motion(2, 20, 1)
    merged = np.array(both.merge) @ theta
    np.testing.assert_allclose(
        both.torque(merged, *sample), (robot + human).torque(theta, *sample), rtol=1e-8, atol=1e-8
    )


def test_one_joint_and_no_mass() -> None:
    door = Chain(parse_urdf(planar()), locked=["elbow"], tip="fore")
    model = TipImpedance(door, "x", mass=False)
    q, dq, ddq = motion(1, 5)[..., 0]
    W = model.observation_matrix(q, dq, ddq)
    J, x = np.asarray(door.jacobian(q[:, None]))[:, 0, 0], np.asarray(door.forward_kinematics(q[:, None])[1])[:, 0]
    np.testing.assert_allclose(W, np.stack([J * J * dq, J * x, J], axis=1), rtol=1e-10, atol=1e-12)
    with pytest.raises(ValueError, match="an equilibrium needs stiffness and force"):
        TipImpedance(door, "x", stiffness=False).equilibrium(np.zeros(3))


@pytest.mark.parametrize(
    ("directions", "message"),
    [
        ("xw", "directions has 'w'"),
        ("xx", "an axis twice"),
        ([[1.0, 0.0]], "vectors of three numbers each"),
        ([[0.0, 0.0, 0.0]], "not all zero"),
        ([[1.0, 0.0, 0.0], [1.0, 1.0, 0.0]], "must be orthogonal"),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_directions_are_checked(directions: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        TipImpedance(ARM, directions)  # type: ignore[arg-type]


def test_a_robot_needs_a_tip() -> None:
    from factories.robots import TREE

    tree = Chain(parse_urdf(TREE))
    with pytest.raises(ValueError, match="has no tip: set tip"):
        TipImpedance(tree)
