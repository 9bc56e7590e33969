"""One battery for every model: regressor @ parameters is the paper's torque; it differentiates, batches and jits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray

from factories.robots import planar
from jaximp.models import (
    MOTION,
    Chain,
    HumanJoint,
    Joints,
    Model,
    PlanarArm,
    RobotJoint,
    combine,
    parameter_units,
    parse_urdf,
)
from jaximp.models.joint import sine_and_cosine

Numbers = NDArray[np.float64]
Torque = Callable[[Numbers, Numbers, Numbers, Numbers], Numbers]


def eq18(
    q: Numbers,
    dq: Numbers,
    ddq: Numbers,
    ratio: float = 1.0,
    mx: float = 0.0,
    my: float = 0.0,
    fv: float = 0.0,
    fc: float = 0.0,
    inertia: float = 0.0,
    constant: float = 0.0,
    g: float = 9.81,
) -> Numbers:
    """Eq. (18) of Tout et al. 2023, and a constant torque."""
    friction = fv * dq + fc * np.sign(dq)
    return inertia * ddq + friction + mx * g * np.sin(q / ratio) + my * g * np.cos(q / ratio) + constant


def eq20(
    q: Numbers, dq: Numbers, ddq: Numbers, inertia: float, damping: float, stiffness: float, gamma: float = 0.0
) -> Numbers:
    """Eq. (20) of Tout et al. 2023; with gamma zero eq. (19)."""
    return inertia * ddq + damping * dq + stiffness * q - gamma


def robot15(b: Numbers, q: Numbers, dq: Numbers, ddq: Numbers) -> Numbers:
    return eq18(q, dq, ddq, 15.0, *b)


def human_offset(b: Numbers, q: Numbers, dq: Numbers, ddq: Numbers) -> Numbers:
    return eq20(q, dq, ddq, b[0], b[1], b[2], -b[3])


def human_plain(b: Numbers, q: Numbers, dq: Numbers, ddq: Numbers) -> Numbers:
    return eq20(q, dq, ddq, *b)


def merged(b: Numbers, q: Numbers, dq: Numbers, ddq: Numbers) -> Numbers:
    """Robot and human with common damping and inertia: mx, my, fv + B, fc, J_r + J_h, K, offset."""
    robot = eq18(q, dq, ddq, 15.0, b[0], b[1], b[2], b[3], b[4])
    return robot + b[5] * q + b[6]


def side_by_side(*parts: tuple[Torque, int]) -> Torque:
    def torque(b: Numbers, q: Numbers, dq: Numbers, ddq: Numbers) -> Numbers:
        out, first = [], 0
        for joint, (part, p) in enumerate(parts):
            out.append(part(b[first : first + p], q[..., joint], dq[..., joint], ddq[..., joint]))
            first += p
        return np.stack(out, axis=-1)

    return torque


def eq13(b: Numbers, q: Numbers, dq: Numbers, ddq: Numbers) -> Numbers:
    """Inertial torque of eq. (13) of Lakatos et al. 2011."""
    (_, q2), (v1, v2), (a1, a2) = (np.moveaxis(x, -1, 0) for x in (q, dq, ddq))
    first = b[0] * a1 + b[1] * ((2 * a1 + a2) * np.cos(q2) - (2 * v1 * v2 + v2**2) * np.sin(q2)) + b[2] * a2
    second = b[1] * (a1 * np.cos(q2) + v1**2 * np.sin(q2)) + b[2] * (a1 + a2)
    return np.stack([first, second], axis=-1)


def spring_and_damper(b: Numbers, q: Numbers, dq: Numbers, ddq: Numbers, rest: tuple[float, float]) -> Numbers:
    """Eq. (8) of Lakatos et al. 2011: D, then K, row by row."""
    return dq @ b[:4].reshape(2, 2).T + (q - np.array(rest)) @ b[4:].reshape(2, 2).T


def arm_weight(b: Numbers, q: Numbers, g: float = 9.81) -> Numbers:
    """Torque that holds an arm in the vertical plane, whose first angle is from the horizontal."""
    forearm = b[1] * g * np.cos(q[..., 0] + q[..., 1])
    return np.stack([b[0] * g * np.cos(q[..., 0]) + forearm, forearm], axis=-1)


def arm(b: Numbers, q: Numbers, dq: Numbers, ddq: Numbers) -> Numbers:
    return eq13(b[:3], q, dq, ddq) + spring_and_damper(b[3:], q, dq, ddq, (0.08, 1.0))


def arm_robot(b: Numbers, q: Numbers, dq: Numbers, ddq: Numbers) -> Numbers:
    friction = b[5:7] * dq + b[7:9] * np.sign(dq)
    return eq13(b[:3], q, dq, ddq) + arm_weight(b[3:5], q, 1.62) + friction + b[9:11]


def planar_chain(b: Numbers, q: Numbers, dq: Numbers, ddq: Numbers, length: float = 0.4, g: float = 9.81) -> Numbers:
    """Lagrange's equations of two links in the vertical x-y plane, with the moments of each about its joint."""
    (q1, q2), (v1, v2), (a1, a2) = (np.moveaxis(x, -1, 0) for x in (q, dq, ddq))
    along, across = (b[3] * np.cos(q2) - b[4] * np.sin(q2)), (b[3] * np.sin(q2) + b[4] * np.cos(q2))
    coupling = length * ((2 * a1 + a2) * along - (2 * v1 * v2 + v2**2) * across)
    weight = g * (b[3] * np.cos(q1 + q2) - b[4] * np.sin(q1 + q2))
    first = b[2] * a1 + b[5] * (a1 + a2) + coupling + g * (b[0] * np.cos(q1) - b[1] * np.sin(q1)) + weight
    second = b[5] * (a1 + a2) + length * (a1 * along + v1**2 * across) + weight
    return np.stack([first, second], axis=-1)


def geared_chain(b: Numbers, q: Numbers, dq: Numbers, ddq: Numbers) -> Numbers:
    """With a rotor (the first counts with the link), friction and a constant."""
    rotor = b[6] * ddq * np.array([0.0, 1.0])
    return planar_chain(b, q, dq, ddq) + rotor + b[7:9] * dq + b[9:11] * np.sign(dq) + b[11:13]


def added(first: Torque, p: int, second: Torque) -> Torque:
    return lambda b, q, dq, ddq: first(b[:p], q, dq, ddq) + second(b[p:], q, dq, ddq)


@dataclass(frozen=True)
class Case:
    id: str
    model: Model
    torque: Torque
    p: int


ROBOT, HUMAN = RobotJoint(gear_ratio=15.0), HumanJoint(gear_ratio=15.0)
ARM = PlanarArm(equilibrium=(0.08, 1.0))
ARM_ROBOT = PlanarArm(impedance=False, gravity=True, viscous=True, coulomb=True, offset=True, g=1.62)
CHAIN = Chain(parse_urdf(planar()), gravity=(0.0, -9.81, 0.0))
GEARED_CHAIN = Chain(parse_urdf(planar()), gravity=(0.0, -9.81, 0.0), rotor=True, friction=True, offset=True)
TWO_ROBOTS, TWO_HUMANS = Joints(ROBOT, ROBOT), Joints(HUMAN, HumanJoint(offset=False))
CASES = [
    Case("robot", ROBOT, robot15, 5),
    Case("robot without gear", RobotJoint(), lambda b, q, dq, ddq: eq18(q, dq, ddq, 1.0, *b), 5),
    Case("robot with offset", RobotJoint(gear_ratio=15.0, offset=True), robot15, 6),
    Case("robot on the moon", RobotJoint(g=1.62), lambda b, q, dq, ddq: eq18(q, dq, ddq, 1.0, *b, g=1.62), 5),
    Case(
        "robot without gravity", RobotJoint(gravity=False), lambda b, q, dq, ddq: eq18(q, dq, ddq, 1.0, 0.0, 0.0, *b), 3
    ),
    Case(
        "robot friction only",
        RobotJoint(gravity=False, inertia=False),
        lambda b, q, dq, ddq: eq18(q, dq, ddq, fv=b[0], fc=b[1]),
        2,
    ),
    Case(
        "prismatic robot",
        RobotJoint(joint="prismatic", offset=True),
        lambda b, q, dq, ddq: eq18(q, dq, ddq, 1.0, 0.0, 0.0, *b),
        4,
    ),
    Case("human", HumanJoint(), human_offset, 4),
    Case("human without offset", HumanJoint(offset=False), human_plain, 3),
    Case("human behind a gear", HUMAN, human_offset, 4),
    Case("prismatic human", HumanJoint(joint="prismatic"), human_offset, 4),
    Case("robot + human", ROBOT + HUMAN, added(robot15, 5, human_offset), 9),
    Case("combine(robot, human)", combine(ROBOT, HUMAN), merged, 7),
    Case("one joint in Joints", Joints(HUMAN), human_offset, 4),
    Case("Joints", TWO_HUMANS, side_by_side((human_offset, 4), (human_plain, 3)), 7),
    Case(
        "Joints + Joints",
        TWO_ROBOTS + TWO_HUMANS,
        added(side_by_side((robot15, 5), (robot15, 5)), 10, side_by_side((human_offset, 4), (human_plain, 3))),
        17,
    ),
    Case(
        "combine(Joints, Joints)",
        combine(TWO_ROBOTS, TWO_HUMANS),
        lambda b, q, dq, ddq: np.stack(
            [
                merged(np.r_[b[:5], b[10], b[11]], q[..., 0], dq[..., 0], ddq[..., 0]),
                merged(np.r_[b[5:10], b[12], 0.0], q[..., 1], dq[..., 1], ddq[..., 1]),
            ],
            axis=-1,
        ),
        13,
    ),
    Case("arm", ARM, arm, 11),
    Case("arm as a robot", ARM_ROBOT, arm_robot, 11),
    Case(
        "arm of known inertia",
        PlanarArm(equilibrium=(-0.5, 0.0), inertia=False),
        lambda b, q, dq, ddq: spring_and_damper(b, q, dq, ddq, (-0.5, 0.0)),
        8,
    ),
    Case(
        "combine(Joints, arm)",
        combine(TWO_ROBOTS, ARM),
        # Merged: viscous friction with damping_11 and _22, the first inertia with inertia_1.
        lambda b, q, dq, ddq: (
            side_by_side((robot15, 5), (robot15, 5))(b[:10], q, dq, ddq)
            + arm(np.r_[0.0, b[10:12], 0.0, b[12:14], 0.0, b[14:18]], q, dq, ddq)
        ),
        18,
    ),
    Case("chain", CHAIN, planar_chain, 6),
    Case("chain with motors", GEARED_CHAIN, geared_chain, 13),
    Case(
        "chain + Joints",
        CHAIN + TWO_HUMANS,
        added(planar_chain, 6, side_by_side((human_offset, 4), (human_plain, 3))),
        13,
    ),
]

every_model = pytest.mark.parametrize("case", [pytest.param(case, id=case.id) for case in CASES])


def motion(model: Model, *batch: int, seed: int = 0) -> tuple[Numbers, Numbers, Numbers]:
    """Position, velocity (away from zero, where its sign jumps) and acceleration."""
    shape = batch if model.n_joints == 1 else (*batch, model.n_joints)
    random = np.random.default_rng(seed)
    dq = random.uniform(0.1, 3.0, shape) * random.choice([-1.0, 1.0], shape)
    return random.normal(size=shape), dq, random.normal(size=shape) * 5


def parameters(case: Case, seed: int = 1) -> Numbers:
    return np.random.default_rng(seed).normal(size=case.p)


@every_model
def test_regressor_times_parameters_is_the_papers_torque(case: Case) -> None:
    theta, sample = parameters(case), motion(case.model, 40)
    expected = case.torque(theta, *sample)
    np.testing.assert_allclose(case.model.regressor(*sample) @ theta, expected, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(case.model.torque(theta, *sample), expected, rtol=1e-13, atol=1e-13)


@every_model
def test_gradient_is_finite_difference(case: Case) -> None:
    theta, sample, step = jnp.asarray(parameters(case)), motion(case.model), 1e-5
    weights = np.random.default_rng(2).normal(size=sample[0].shape)

    @jax.jit
    def scalar(*motion: jax.Array) -> jax.Array:
        return (weights * case.model.torque(theta, *motion)).sum()

    gradients = jax.grad(scalar, argnums=(0, 1, 2))(*(jnp.asarray(x) for x in sample))
    for which, gradient in enumerate(gradients):
        for index in np.ndindex(sample[which].shape):
            ends = []
            for sign in (1, -1):
                moved = [np.array(x) for x in sample]
                moved[which][index] += sign * step
                ends.append(float(scalar(*moved)))
            assert float(gradient[index]) == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-7, abs=1e-7)


@every_model
def test_vmap_is_a_loop_and_jit_changes_nothing(case: Case) -> None:
    sample = motion(case.model, 6)
    loop = np.stack([case.model.regressor(*(x[k] for x in sample)) for k in range(6)])
    for name, function in {
        "batch": case.model.regressor,
        "vmap": jax.vmap(case.model.regressor),
        "jit": jax.jit(case.model.regressor),
        "jit over the model": lambda *motion: eqx.filter_jit(lambda model, *m: model.regressor(*m))(
            case.model, *motion
        ),
    }.items():
        np.testing.assert_allclose(function(*sample), loop, rtol=1e-14, atol=1e-14, err_msg=name)


@every_model
def test_every_column_has_one_name_and_one_unit(case: Case) -> None:
    model = case.model
    assert len(model.names) == len(model.units) == len(model.columns) == case.p
    assert len(set(model.names)) == case.p
    assert model.regressor(*motion(model)).shape[-1] == case.p


@every_model
def test_columns_called_as_the_motion_are_the_motion(case: Case) -> None:
    q, dq, ddq = motion(case.model, 20)
    W = case.model.regressor(q, dq, ddq)
    for k, column in enumerate(case.model.columns):
        if column in MOTION and case.model.n_joints == 1:
            expected = dict(zip(MOTION, (q, dq, ddq, np.ones(20)), strict=True))[column]
            np.testing.assert_array_equal(W[:, k], expected)


@every_model
@pytest.mark.parametrize("batch", [(), (6,), (2, 1, 3), (0,)], ids=str)
def test_batches_of_any_shape(case: Case, batch: tuple[int, ...]) -> None:
    """Shapes only, so that nothing need be compiled."""
    joints = () if case.model.n_joints == 1 else (case.model.n_joints,)
    sample = motion(case.model, *batch)
    assert jax.eval_shape(case.model.regressor, *sample).shape == (*batch, *joints, case.p)
    assert jax.eval_shape(case.model.torque, parameters(case), *sample).shape == (*batch, *joints)


def test_a_batch_of_batches_is_its_samples() -> None:
    sample = motion(ROBOT + HUMAN, 2, 3)
    batch = (ROBOT + HUMAN).regressor(*sample)
    flat = (ROBOT + HUMAN).regressor(*(x.ravel() for x in sample))
    np.testing.assert_array_equal(batch.reshape(6, -1), flat)


@every_model
def test_observation_matrix_is_the_stacked_regressor(case: Case) -> None:
    sample = motion(case.model, 7)
    stacked = np.stack([case.model.regressor(*(x[k] for x in sample)) for k in range(7)])
    np.testing.assert_allclose(case.model.observation_matrix(*sample), stacked, rtol=1e-14, atol=1e-14)


@every_model
def test_a_motion_of_another_shape_is_refused(case: Case) -> None:
    q, dq, ddq = motion(case.model, 5)
    with pytest.raises(ValueError, match="differ in shape"):
        case.model.regressor(q, dq[:4], ddq)


@pytest.mark.parametrize(
    ("robot", "human"),
    [
        pytest.param(ROBOT, HUMAN, id="robot, human"),
        pytest.param(ROBOT, HumanJoint(offset=False), id="robot, human without offset"),
        pytest.param(RobotJoint(offset=True), HumanJoint(), id="both with offset"),
        pytest.param(RobotJoint(inertia=False, viscous=False), HumanJoint(), id="nothing shared"),
        pytest.param(RobotJoint(joint="prismatic"), HumanJoint(joint="prismatic"), id="prismatic"),
        pytest.param(TWO_ROBOTS, TWO_HUMANS, id="two joints"),
        pytest.param(TWO_ROBOTS, ARM, id="two robots, arm"),
        pytest.param(
            Joints(*[RobotJoint(offset=True)] * 2),
            PlanarArm((0.0, 0.0), gravity=True, offset=True),
            id="two robots, arm under gravity",
        ),
    ],
)
def test_combine_merges_equal_columns_and_keeps_the_torque(robot: Model, human: Model) -> None:
    stacked, combined = robot + human, combine(robot, human)
    theta = np.random.default_rng(0).normal(size=len(stacked.names))
    merge, sample = np.array(combined.merge), motion(stacked, 30)
    np.testing.assert_allclose(combined.torque(merge @ theta, *sample), stacked.torque(theta, *sample), rtol=1e-12)
    assert merge.shape == (len(combined.names), len(stacked.names))
    assert set(np.unique(merge)) <= {0.0, 1.0}
    np.testing.assert_array_equal(merge.sum(axis=0), 1)
    assert combined.names == tuple(
        "+".join(name for name, used in zip(stacked.names, row, strict=True) if used) for row in merge
    )
    # What is merged could not be told apart, what is left can.
    columns = np.asarray(combined.regressor(*motion(combined, 200))).reshape(-1, len(combined.names))
    assert np.linalg.matrix_rank(columns) == len(combined.names)


def test_names_units_and_order_follow_the_paper() -> None:
    both = ROBOT + HUMAN
    assert both.names == (
        *("robot.gravity_x", "robot.gravity_y", "robot.viscous_friction", "robot.coulomb_friction", "robot.inertia"),
        *("human.inertia", "human.damping", "human.stiffness", "human.offset_torque"),
    )
    assert both.units == (
        *("kg m", "kg m", "N m s/rad", "N m", "kg m^2"),
        *("kg m^2", "N m s/rad", "N m/rad", "N m"),
    )
    slide = RobotJoint(joint="prismatic") + HumanJoint(joint="prismatic")
    assert slide.units == ("N s/m", "N", "kg", "kg", "N s/m", "N/m", "N")
    assert combine(ROBOT, HUMAN).names == (
        "robot.gravity_x",
        "robot.gravity_y",
        "robot.viscous_friction+human.damping",
        "robot.coulomb_friction",
        "robot.inertia+human.inertia",
        "human.stiffness",
        "human.offset_torque",
    )
    assert Joints(HumanJoint(offset=False), HumanJoint()).names[2:4] == ("joint1.stiffness", "joint2.inertia")


@pytest.mark.parametrize(
    "model",
    [
        pytest.param(HumanJoint(), id="human"),
        pytest.param(HumanJoint(gear_ratio=15.0), id="human behind a gear"),
        pytest.param(RobotJoint(offset=True), id="robot"),
        pytest.param(RobotJoint(offset=True, joint="prismatic"), id="prismatic robot"),
    ],
)
def test_the_column_of_the_offset_torque_is_plus_one(model: Model) -> None:
    column = model.regressor(*motion(model, 9))[:, model.names.index("offset_torque")]
    np.testing.assert_array_equal(column, 1.0)


@pytest.mark.parametrize("offset", [True, False], ids=["offset", "no offset"])
@pytest.mark.parametrize("ratio", [1.0, 15.0, 0.5])
def test_at_joint_gives_the_impedance_behind_the_gear(ratio: float, offset: bool) -> None:
    human = HumanJoint(offset=offset, gear_ratio=ratio)
    theta = np.random.default_rng(3).normal(size=(6, 3 + offset))
    at_joint = human.at_joint(theta)
    np.testing.assert_allclose(at_joint, theta * np.array([ratio**2] * 3 + [ratio] * offset), rtol=1e-14)
    # The same physics on both sides: q_joint = q/N1, torque_joint = N1 * torque.
    motor = motion(human, 20)
    for row, behind in zip(theta, np.asarray(at_joint), strict=True):
        joint_torque = human.torque(behind, *(x / ratio for x in motor))
        np.testing.assert_allclose(joint_torque, ratio * human.torque(row, *motor), rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("ratio", [1.0, 15.0])
def test_equilibrium_is_where_the_elastic_torque_vanishes(ratio: float) -> None:
    human = HumanJoint(gear_ratio=ratio)
    theta = np.array([[0.1, 1.5, 20.0, -4.0], [0.2, 1.0, 5.0, 2.0]])
    rest = np.asarray(human.equilibrium(theta))
    np.testing.assert_allclose(rest, [0.2, -0.4], rtol=1e-14)
    for row, q in zip(theta, rest, strict=True):
        assert float(human.torque(row, q, 0.0, 0.0)) == pytest.approx(0.0, abs=1e-14)
    np.testing.assert_allclose(human.equilibrium(human.at_joint(theta)), rest / ratio, rtol=1e-13)
    np.testing.assert_array_equal(HumanJoint(offset=False).equilibrium(theta[:, :3]), 0.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        pytest.param(lambda: HumanJoint(gear_ratio=-1.0), "gear_ratio is -1.0: it must be", id="negative gear ratio"),
        pytest.param(lambda: RobotJoint(gear_ratio=0.0), "gear_ratio is 0.0: it must be", id="gear ratio zero"),
        pytest.param(lambda: RobotJoint(gear_ratio=np.nan), "gear_ratio is nan", id="gear ratio NaN"),
        pytest.param(lambda: HumanJoint(joint="spherical"), "'revolute' or 'prismatic'", id="human of unknown type"),
        pytest.param(lambda: RobotJoint(joint="Revolute"), "'revolute' or 'prismatic'", id="robot of unknown type"),
        pytest.param(lambda: parameter_units("ball"), "'revolute' or 'prismatic'", id="units of unknown type"),
        pytest.param(lambda: RobotJoint(joint="prismatic", gravity=True), "no gravity", id="gravity on prismatic"),
        pytest.param(
            lambda: RobotJoint(gravity=False, viscous=False, coulomb=False, inertia=False),
            "switch at least one",
            id="no column left",
        ),
        pytest.param(lambda: HUMAN + HumanJoint(offset=False), "both models are called 'human'", id="human + human"),
        pytest.param(lambda: combine(ROBOT, ROBOT), "both models are called 'robot'", id="combine(robot, robot)"),
        pytest.param(lambda: TWO_ROBOTS + HUMAN, "2 and 1 joints", id="two joints + one"),
        pytest.param(lambda: Joints(), "one model of one joint", id="Joints of nothing"),
        pytest.param(lambda: Joints(TWO_ROBOTS), "one model of one joint", id="Joints of Joints"),
        pytest.param(lambda: TWO_ROBOTS.regressor(*[np.ones((4, 3))] * 3), "has 2 joints", id="wrong last axis"),
        pytest.param(lambda: TWO_ROBOTS.regressor(1.0, 1.0, 1.0), "has 2 joints", id="no last axis"),
        pytest.param(lambda: HUMAN.regressor(np.ones(3), np.ones(3), np.ones(2)), "differ in shape", id="shapes"),
    ],
)
def test_errors_name_the_cause(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("largest", [1.0, 30.0, 1e6])
def test_sine_and_cosine_are_the_c_librarys(largest: float) -> None:
    quarters = np.linspace(-largest, largest, 101) // (np.pi / 4) * (np.pi / 4)
    x = np.concatenate([np.random.default_rng(0).uniform(-largest, largest, 10_000), quarters])
    sine, cosine = sine_and_cosine(jnp.asarray(x))
    np.testing.assert_allclose(sine, np.sin(x), rtol=0, atol=4e-16)
    np.testing.assert_allclose(cosine, np.cos(x), rtol=0, atol=4e-16)


def test_sine_and_cosine_differentiate_and_take_single_precision() -> None:
    at = jnp.asarray(2.5)
    np.testing.assert_allclose(jax.jacobian(sine_and_cosine)(at), [np.cos(2.5), -np.sin(2.5)], rtol=1e-15)
    np.testing.assert_allclose(jax.hessian(sine_and_cosine)(at), [-np.sin(2.5), -np.cos(2.5)], rtol=1e-15)
    single = sine_and_cosine(at.astype(jnp.float32))
    assert {part.dtype for part in single} == {np.dtype(np.float32)}
    np.testing.assert_allclose(single, [np.sin(2.5), np.cos(2.5)], rtol=1e-6)
