"""Chains of rigid bodies: against pinocchio's numbers, textbook laws, and themselves in other coordinates."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from factories.robots import GANTRY, TREE, joint, link, planar, robot
from jaximp.models import HumanJoint, Joints, combine, rigid_body
from jaximp.models.base import Role
from jaximp.models.base_parameters import find_base
from jaximp.models.chain import Chain
from jaximp.models.urdf import SIX_JOINT_ARM, parse_urdf

GOLDEN = json.loads((Path(__file__).parent / "chain_golden.json").read_text(encoding="utf-8"))
TEXTS = {"tree": TREE, "gantry": GANTRY, "arm": SIX_JOINT_ARM.read_text(encoding="utf-8")}
CHAINS = {name: Chain(parse_urdf(text), tip=GOLDEN[name]["tip"]) for name, text in TEXTS.items()}
ALL = ("viscous", "coulomb", "stribeck")
COUPLED = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 1.0]])
every_robot = pytest.mark.parametrize("name", CHAINS)


def motion(n: int, *batch: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    return tuple(random.normal(size=(3, *batch, n)))  # type: ignore[return-value]


def golden(name: str) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Pinocchio's numbers of all joints, which of them are coordinates, and the joints' motion for each coordinate."""
    numbers = {key: np.array(value) for key, value in GOLDEN[name].items() if key not in ("joints", "tip")}
    joints = GOLDEN[name]["joints"]
    free = [k for k, joint in enumerate(joints) if joint != "right_finger"]
    coordinates = np.eye(len(joints))[:, free]
    if "right_finger" in joints:
        coordinates[joints.index("right_finger"), free.index(joints.index("right_elbow"))] = -0.35
    return numbers, np.array(free), coordinates


@every_robot
def test_dynamics_and_kinematics_are_pinocchios(name: str) -> None:
    chain = CHAINS[name]
    numbers, free, T = golden(name)
    q, dq, ddq = (numbers[key][:, free] for key in ("position", "velocity", "acceleration"))
    R, p = chain.forward_kinematics(q)
    for found, expected in {
        "torque": (chain.inverse_dynamics(q, dq, ddq), numbers["torque"] @ T),
        "gravity": (chain.gravity_torque(q), numbers["gravity"] @ T),
        "mass": (chain.mass_matrix(q), T.T @ numbers["mass"] @ T),
        "rotation": (R, numbers["rotation"]),
        "tip": (p, numbers["tip_position"]),
        "jacobian": (chain.jacobian(q), numbers["jacobian"] @ T),
        "regressor": (
            rigid_body.regressor(chain.tree, q, dq, ddq),
            np.einsum("jn,Njp->Nnp", T, numbers["regressor"]),
        ),
    }.values():
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * np.abs(expected).max())


@every_robot
def test_base_columns_make_the_torque_of_the_file(name: str) -> None:
    chain = CHAINS[name]
    q, dq, ddq = motion(chain.n_joints, 40)
    W, torque = chain.observation_matrix(q, dq, ddq), chain.inverse_dynamics(q, dq, ddq)
    assert W.shape == (40, chain.n_joints, len(chain.names))
    np.testing.assert_allclose(W @ chain.parameters, torque, rtol=0, atol=1e-12 * np.abs(torque).max())


@every_robot
def test_base_columns_are_a_basis(name: str) -> None:
    """As many as the rank of all columns by a singular value decomposition, and well apart."""
    chain = CHAINS[name]
    sample = motion(chain.n_joints, 250, seed=3)
    full = np.asarray(rigid_body.regressor(chain.tree, *sample)).reshape(-1, 10 * chain.tree.n_bodies)
    base = np.asarray(chain.regressor(*sample)).reshape(-1, len(chain.names))
    sizes = np.linalg.svd(full / np.maximum(np.linalg.norm(full, axis=0), 1e-9), compute_uv=False)
    assert (sizes > 1e-9).sum() == len(chain.names)
    assert np.linalg.cond(base / np.linalg.norm(base, axis=0)) < 1e4
    rigid = np.asarray(chain.base.map)
    np.testing.assert_allclose(base @ rigid, full, atol=1e-11 * np.abs(full).max())
    np.testing.assert_allclose(full @ chain.base.null_space, 0, atol=1e-11 * np.abs(full).max())
    np.testing.assert_array_equal(rigid @ chain.base.null_space, 0)
    assert chain.base.null_space.shape == (full.shape[1], full.shape[1] - base.shape[1])
    assert chain.base.residual < 1e-11


@pytest.mark.parametrize(
    ("settings", "count"),
    [
        ({}, 36),
        ({"rotor": True}, 40),
        ({"rotor": True, "friction": True, "offset": True}, 58),
        ({"gravity": (0, 0, 0)}, 34),
    ],
    ids=str,
)
def test_arms_of_six_joints_have_as_many_base_columns_as_everywhere(settings: dict[str, Any], count: int) -> None:
    assert len(Chain.from_urdf(SIX_JOINT_ARM, **settings).names) == count


def test_sums_say_what_counts_together() -> None:
    """Of the planar arm of every textbook: the second mass counts at the end of the first link."""
    sums = Chain(parse_urdf(planar(0.4)), gravity=(0, -9.81, 0), rotor=True).sums
    assert sums == {
        "link1.mc_x": "link1.mc_x + 0.4 link2.mass",
        "link1.mc_y": "link1.mc_y",
        "link1.Izz": "link1.Izz + 0.16 link2.mass + joint1.rotor_inertia",
        "link2.mc_x": "link2.mc_x",
        "link2.mc_y": "link2.mc_y",
        "link2.Izz": "link2.Izz",
        "joint2.rotor_inertia": "joint2.rotor_inertia",
    }


@pytest.mark.parametrize("digits", [12, 9, 6, 4])
def test_rounded_files_have_the_same_base(digits: int) -> None:
    """The first axis is vertical by a quarter turn, so that gravity does not show what is about it."""

    def chain(turn: str, rounding: float = 1e-5) -> Chain:
        joints = (
            joint("one", "base", "first", rpy=f"{turn} 0 0", axis="0 1 0"),
            joint("two", "first", "second", rpy=f"-{turn} 0 0", axis="0 1 0"),
            joint("three", "second", "third", xyz="0.4 0 0", axis="0 1 0"),
        )
        parts = ('<link name="base"/>', *joints, *(link(name) for name in ("first", "second", "third")))
        return Chain(parse_urdf(robot(*parts)), rounding=rounding)

    exact, rounded = chain(repr(np.pi / 2)), chain(f"{np.pi / 2:.{digits}f}")
    assert rounded.names == exact.names
    assert list(rounded.sums.values()) == list(exact.sums.values())
    assert rounded.base.residual < 10 * 0.1**digits
    assert digits > 6 or len(chain(f"{np.pi / 2:.{digits}f}", rounding=0).names) > len(exact.names)


def test_the_base_is_the_same_every_time() -> None:
    again = Chain.from_urdf(SIX_JOINT_ARM, tip="tool")
    np.testing.assert_array_equal(again.base.map, CHAINS["arm"].base.map)
    assert hash(again) == hash(CHAINS["arm"]) != hash(CHAINS["tree"])
    assert again.columns == CHAINS["arm"].columns
    assert not set(again.columns) & set(CHAINS["gantry"].columns)


def test_columns_are_tried_in_order_and_empty_ones_left_out() -> None:
    x, y = np.random.default_rng(0).normal(size=(2, 30))
    W = np.stack([x, y, 2 * x - y, 0 * x, 1e-13 * y], axis=1)
    first = find_base(W, "abcde")
    assert first.names == ("a", "b")
    np.testing.assert_allclose(first.map, [[1, 0, 2, 0, 0], [0, 1, -1, 0, 0]], atol=1e-14)
    assert first.sums == {"a": "a + 2 c", "b": "b - c"}
    assert find_base(W, "abcde", order=[2, 1, 0, 3, 4]).sums == {"b": "b + 0.5 a", "c": "c + 0.5 a"}


@every_robot
def test_torque_is_the_mass_the_coriolis_and_the_gravity_terms(name: str) -> None:
    chain = CHAINS[name]
    q, dq, ddq = motion(chain.n_joints, 5, seed=1)
    M, C, g = chain.mass_matrix(q), chain.coriolis_matrix(q, dq), chain.gravity_torque(q)
    torque = np.einsum("Nij,Nj->Ni", M, ddq) + np.einsum("Nij,Nj->Ni", C, dq) + g
    np.testing.assert_allclose(torque, chain.inverse_dynamics(q, dq, ddq), rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(M, np.swapaxes(M, 1, 2), atol=1e-13)
    assert (np.linalg.eigvalsh(M) > 0).all()
    step = 1e-6
    rate = (np.asarray(chain.mass_matrix(q + step * dq)) - np.asarray(chain.mass_matrix(q - step * dq))) / (2 * step)
    twist = rate - 2 * np.asarray(C)
    np.testing.assert_allclose(twist, -np.swapaxes(twist, 1, 2), atol=1e-7)


@every_robot
def test_jacobian_is_the_tips_finite_difference(name: str) -> None:
    chain, step = CHAINS[name], 1e-6
    q, _, _ = motion(chain.n_joints)
    J = np.asarray(chain.jacobian(q))
    for k in range(chain.n_joints):
        ends = [chain.forward_kinematics(q + s * step * np.eye(chain.n_joints)[k]) for s in (1, -1)]
        (R1, p1), (R2, p2) = ([np.asarray(x) for x in end] for end in ends)
        spin = (R1 - R2) @ ((R1 + R2) / 2).T / (2 * step)
        np.testing.assert_allclose(J[:3, k], (p1 - p2) / (2 * step), atol=1e-8)
        np.testing.assert_allclose(J[3:, k], [spin[2, 1], spin[0, 2], spin[1, 0]], atol=1e-8)


def test_power_is_the_change_of_energy() -> None:
    """Of the kinetic and potential energy, by a derivative of these alone."""
    chain = CHAINS["tree"]
    q, dq, ddq = (jnp.asarray(x) for x in motion(chain.n_joints))

    def kinetic(t: jax.Array) -> jax.Array:
        v = dq + t * ddq
        return v @ chain.mass_matrix(q + t * dq + t**2 / 2 * ddq) @ v / 2

    power = jax.grad(kinetic)(0.0) + chain.gravity_torque(q) @ dq
    np.testing.assert_allclose(chain.inverse_dynamics(q, dq, ddq) @ dq, power, rtol=1e-12)


def test_many_samples_are_as_few() -> None:
    chain = CHAINS["arm"]
    sample = motion(6, rigid_body.ONE_BLOCK + 3)
    many = chain.regressor(*sample)
    pieces = [chain.regressor(*(x[k : k + 79] for x in sample)) for k in range(0, len(sample[0]), 79)]
    np.testing.assert_allclose(many, np.concatenate(pieces), rtol=1e-12, atol=1e-12)
    assert chain.mass_matrix(sample[0].reshape(-1, 1, 6)).shape == (rigid_body.ONE_BLOCK + 3, 1, 6, 6)
    assert chain.jacobian(sample[0][0]).shape == (6, 6)
    with pytest.raises(ValueError, match="with the 6 joints on the last axis"):
        chain.mass_matrix(sample[0][:, :5])


def test_single_precision_stays_single() -> None:
    chain = CHAINS["arm"]
    sample = [jnp.asarray(x, jnp.float32) for x in motion(6, 4)]
    W = chain.regressor(*sample)
    assert W.dtype == jnp.float32
    np.testing.assert_allclose(W, chain.regressor(*motion(6, 4)), atol=1e-4)


def test_condition_number_has_its_gradient() -> None:
    chain = CHAINS["gantry"]
    q, dq, ddq = motion(3, 40)

    @jax.jit
    def log_condition(q: jax.Array) -> jax.Array:
        sizes = jnp.linalg.svd(chain.observation_matrix(q, dq, ddq).reshape(-1, len(chain.names)), compute_uv=False)
        return jnp.log(sizes[0] / sizes[-1])

    slope, step = jax.grad(log_condition)(q), 1e-6
    direction = np.random.default_rng(1).normal(size=q.shape)
    change = (log_condition(q + step * direction) - log_condition(q - step * direction)) / (2 * step)
    np.testing.assert_allclose((slope * direction).sum(), change, rtol=1e-6)


# Coordinates: locked joints, gears, coupled wrists, signs and zeros.


def test_locked_joints_are_joints_that_stay() -> None:
    locked = Chain(parse_urdf(TREE), locked={"right_elbow": 0.7, "left_slide": -0.2})
    assert locked.joint_names == ("waist", "left_wrist")
    assert locked.link_names == (("torso", "box", "left_carriage", "right_arm", "finger"), ("left_hand",))
    q, dq, ddq = motion(2, 40)

    def whole(x: np.ndarray, slide: float, elbow: float) -> np.ndarray:
        return np.stack([x[:, 0], np.full(40, slide), x[:, 1], np.full(40, elbow)], axis=-1)

    torque = CHAINS["tree"].inverse_dynamics(whole(q, -0.2, 0.7), whole(dq, 0, 0), whole(ddq, 0, 0))
    np.testing.assert_allclose(locked.inverse_dynamics(q, dq, ddq), torque[:, [0, 2]], rtol=1e-12, atol=1e-12)


def test_a_chain_may_begin_above_the_root() -> None:
    upper = Chain(parse_urdf(TEXTS["arm"]), base="upper_arm", gravity=(1.0, 2.0, 3.0))
    assert upper.joint_names == ("joint_3", "joint_4", "joint_5", "joint_6")
    assert upper.tip == "flange"
    R, p = upper.forward_kinematics(np.zeros(4))
    np.testing.assert_allclose(p, [0, -0.094 + 0.011 + 0.081 * 0, 0.435 + 0.372 + 0.087 + 0.081], atol=1e-12)
    np.testing.assert_allclose(R, np.eye(3), atol=1e-12)


def test_motors_do_the_work_of_the_joints() -> None:
    """With gears, a coupled wrist, a sign and zeros: the same power, and friction and rotors at the motors."""
    gear, sign, zero = np.array([80.0, -60.0, 50.0]), {"swing": -1.0}, [0.3, -0.2, 0.1]
    geared = Chain(
        parse_urdf(GANTRY), gear=gear, coupling=COUPLED, sign=sign, zero=zero, rotor=True, friction=ALL, offset=True
    )
    joints = np.diag([1.0, -1.0, 1.0]) @ COUPLED @ np.diag(1 / gear)
    q, dq, ddq = motion(3, 40)
    q, dq, ddq = 50 * q, 50 * dq, 50 * ddq
    at_joints = CHAINS["gantry"].inverse_dynamics(q @ joints.T + zero, dq @ joints.T, ddq @ joints.T)
    np.testing.assert_allclose(geared.joint_positions(q), q @ joints.T + zero, rtol=1e-13)
    np.testing.assert_allclose(geared.inverse_dynamics(q, dq, ddq), at_joints @ joints, rtol=1e-11, atol=1e-12)
    theta = dict(zip(geared.base.standard_names, geared.standard_parameters, strict=True))
    own = {name: 0.1 + k for k, name in enumerate(theta) if name.startswith("joint")}
    values = np.array([own.get(name, value) for name, value in theta.items()])
    at_motors = np.stack(
        [
            own[f"joint{k}.rotor_inertia"] * ddq[:, k - 1]
            + own[f"joint{k}.viscous_friction"] * dq[:, k - 1]
            + own[f"joint{k}.coulomb_friction"] * np.sign(dq[:, k - 1])
            + own[f"joint{k}.stribeck_friction"] * np.sign(dq[:, k - 1]) * np.exp(-((dq[:, k - 1] / 0.1) ** 2))
            + own[f"joint{k}.offset_torque"]
            for k in (1, 2, 3)
        ],
        axis=-1,
    )
    W = geared.regressor(q, dq, ddq)
    np.testing.assert_allclose(W @ (geared.base.map @ values), at_joints @ joints + at_motors, rtol=1e-10, atol=1e-9)

    # The same robot, recorded at its joints.
    recorded = Chain(
        parse_urdf(GANTRY), gear=gear, coupling=COUPLED, sign=sign, zero=zero, side="joint", rotor=True, friction=ALL
    )
    drive = COUPLED @ np.diag(1 / gear)
    W = recorded.regressor(q @ drive.T, dq @ drive.T, ddq @ drive.T)
    values = np.array([own.get(name, theta[name]) for name in recorded.base.standard_names])
    without = at_motors - np.array([own[f"joint{k}.offset_torque"] for k in (1, 2, 3)])
    torque = (at_joints @ joints + without) @ np.linalg.inv(drive)
    np.testing.assert_allclose(W @ (recorded.base.map @ values), torque, rtol=1e-9, atol=1e-9 * np.abs(torque).max())
    assert not {column for column in recorded.columns if column.startswith("joint1.d")}


# Friction.


def test_torque_without_columns_is_that_of_the_columns() -> None:
    settings: dict[str, Any] = {"friction": ALL, "rotor": True, "offset": True, "gear": 3.0, "coupling": COUPLED}
    for side in ("motor", "joint"):
        chain = Chain(parse_urdf(GANTRY), side=side, **settings)
        theta = np.random.default_rng(1).normal(size=len(chain.names))
        z, dz, ddz = motion(3, 20)
        expected = chain.observation_matrix(z, dz, ddz) @ theta
        np.testing.assert_allclose(chain.torque(theta, z, dz, ddz), expected, rtol=1e-10, atol=1e-10)
    with pytest.raises(ValueError, match=r"theta has the shape \(2,\)"):
        chain.torque(theta[:2], z, dz, ddz)


def test_friction_of_the_file_comes_with_its_columns() -> None:
    chain = Chain.from_urdf(SIX_JOINT_ARM, friction=True)
    damping, friction = [2.6, 3.1, 1.7, 0.62, 0.55, 0.21], [3.8, 4.9, 2.7, 0.9, 0.85, 0.4]
    q, dq, ddq = motion(6, 40)
    torque = CHAINS["arm"].inverse_dynamics(q, dq, ddq) + damping * dq + friction * np.sign(dq)
    np.testing.assert_allclose(chain.regressor(q, dq, ddq) @ chain.parameters, torque, rtol=1e-11, atol=1e-11)
    geared = Chain.from_urdf(SIX_JOINT_ARM, friction="asymmetric_coulomb", gear=10)
    torque = CHAINS["arm"].inverse_dynamics(q, dq, ddq) / 10 + np.array(friction) / 10 * np.sign(dq)
    W = geared.regressor(10 * q, 10 * dq, 10 * ddq)
    np.testing.assert_allclose(W @ geared.parameters, torque, rtol=1e-11, atol=1e-11)


def test_coulomb_friction_may_differ_between_directions() -> None:
    chain = Chain(parse_urdf(planar()), gravity=(0, 0, 0), friction="asymmetric_coulomb", offset=True)
    names = dict(zip(chain.names, chain.regressor(np.zeros(2), np.array([0.3, -0.2]), np.zeros(2)).T, strict=True))
    np.testing.assert_array_equal(names["joint1.coulomb_forward"], [1, 0])
    np.testing.assert_array_equal(names["joint1.coulomb_backward"], [0, 0])
    np.testing.assert_array_equal(names["joint2.coulomb_backward"], [0, -1])
    # A constant torque is no third parameter of a joint that always moves.
    assert chain.sums["joint1.coulomb_forward"] == "joint1.coulomb_forward + joint1.offset_torque"
    assert chain.sums["joint1.coulomb_backward"] == "joint1.coulomb_backward - joint1.offset_torque"


def test_stribecks_curve_can_be_fitted() -> None:
    """Its column has slopes along both of its numbers, also at rest."""
    chain = Chain(parse_urdf(planar()), friction="stribeck", stribeck=(0.2, 1.5))
    q, dq, ddq = motion(2, 20)
    dq[0] = 0.0

    def total(curve: jax.Array) -> jax.Array:
        return (chain.with_stribeck(curve[0], curve[1]).regressor(q, dq, ddq) ** 2).sum()

    curve, step = jnp.array([0.3, 1.4]), 1e-6
    ends = [[total(curve + s * step * direction) for s in (1, -1)] for direction in jnp.eye(2)]
    np.testing.assert_allclose(jax.grad(total)(curve), [(a - b) / (2 * step) for a, b in ends], rtol=1e-6)


def test_slow_motion_does_not_count_for_friction() -> None:
    chain = Chain(parse_urdf(planar()), friction=True, min_velocity={"elbow": 0.1})
    assert chain.moving(np.array([[0.01, 0.05], [0.0, -0.2]])).tolist() == [[True, False], [True, True]]
    smooth = chain.smoothed(np.array([0.1, 0.2]))
    W = smooth.regressor(np.zeros(2), np.array([0.05, -0.1]), np.zeros(2))
    np.testing.assert_allclose(np.diag(W[:, -2:]), np.tanh([0.5, -0.5]), rtol=1e-14)


# As a model among others.


def test_parameters_have_roles_and_units() -> None:
    chain = Chain(parse_urdf(GANTRY), rotor=True, friction=True, offset=True)
    roles, units = (dict(zip(chain.names, values, strict=True)) for values in (chain.roles, chain.units))
    assert roles["link1.mass"] == Role("link_mass", (1,))
    assert roles["link2.mc_x"] == Role("first_moment", (2,))
    assert roles["link3.Ixy"] == Role("link_inertia", (3,))
    assert roles["joint2.viscous_friction"] == Role("friction", (2,))
    assert roles["joint3.offset_torque"] == Role("offset", (3,))
    assert units["link1.mass"] == "kg"
    assert units["link3.Ixy"] == "kg m^2"
    geared = Chain(parse_urdf(planar()), rotor=True)
    assert geared.roles[geared.names.index("joint2.rotor_inertia")] == Role("rotor_inertia", (2,))
    assert (units["joint1.viscous_friction"], units["joint2.viscous_friction"]) == ("N s/m", "N m s/rad")


def test_a_human_shares_the_columns_of_friction() -> None:
    chain = Chain(parse_urdf(planar()), friction=True, offset=True)
    both = combine(chain, Joints(HumanJoint(), HumanJoint()))
    assert "robot.joint1.viscous_friction+human.joint1.damping" in both.names
    assert "robot.joint2.offset_torque+human.joint2.offset_torque" in both.names


def test_one_joint_is_a_chain_too() -> None:
    """With and without an axis for it."""
    pendulum = Chain(parse_urdf(robot('<link name="wall"/>', joint("hinge", "wall", "bob", axis="0 1 0"), link("bob"))))
    q, dq, ddq = motion(1, 5)
    assert pendulum.regressor(q[:, 0], dq[:, 0], ddq[:, 0]).shape == (5, len(pendulum.names))
    torque = pendulum.inverse_dynamics(q, dq, ddq)
    np.testing.assert_allclose(pendulum.regressor(q, dq, ddq) @ pendulum.parameters, torque, atol=1e-13)
    np.testing.assert_array_equal(pendulum.inverse_dynamics(q[:, 0], dq[:, 0], ddq[:, 0]), torque[:, 0])
    assert pendulum.mass_matrix(q).shape == (5, 1, 1)
    assert pendulum.jacobian(q).shape == (5, 6, 1)
