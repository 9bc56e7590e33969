"""The arm of two links: equations of motion against Lagrange's and pinocchio's, kinematics against their inverse."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray

from jaximp.models import (
    BASE_INERTIA,
    ArmGeometry,
    ArmLinks,
    BaseInertia,
    PlanarArm,
    RobotJoint,
    borner_from_lakatos,
    coriolis_matrix,
    gravity_torque,
    lakatos_from_borner,
    mass_matrix,
    rigid_body_torque,
)

Numbers = NDArray[np.float64]

BORNER = ArmLinks(lengths=(0.29, 0.34), masses=(1.93, 1.52), centres=(0.165, 0.19), inertias=(0.0141, 0.0188))
"""An arm with the base parameters that Börner et al. 2020 simulate."""
REST = (0.08, 1.0)
IMPEDANCE = np.array([1.1, 0.3, 0.4, 0.9, 29.05, 14.37, 14.0, 17.08])
"""Damping and stiffness, row by row."""
GEOMETRIES = [ArmGeometry(lengths, elbow) for lengths in [(0.29, 0.34), (0.4, 0.4)] for elbow in ("right", "left")]
every_geometry = pytest.mark.parametrize("geometry", GEOMETRIES, ids=lambda one: f"{one.elbow}, {one.lengths}")


def motion(n: int = 40, seed: int = 0) -> tuple[Numbers, Numbers, Numbers]:
    random = np.random.default_rng(seed)
    return random.uniform(-3, 3, (n, 2)), random.normal(size=(n, 2)) * 2, random.normal(size=(n, 2)) * 10


def lagrangian(links: ArmLinks, q: jax.Array, dq: jax.Array, g: float) -> jax.Array:
    """Kinetic less potential energy, from where the centres of mass are; gravity along -y."""

    def bodies(q: jax.Array) -> tuple[jax.Array, jax.Array]:
        angles = jnp.stack([q[0], q[0] + q[1]])
        directions = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
        elbow = links.lengths[0] * directions[0]
        return jnp.stack([links.centres[0] * directions[0], elbow + links.centres[1] * directions[1]]), angles

    (centres, _), (speeds, turning) = jax.jvp(bodies, (q,), (dq,))
    masses, inertias = jnp.array(links.masses), jnp.array(links.inertias)
    kinetic = (masses * (speeds**2).sum(axis=-1) + inertias * turning**2).sum() / 2
    return kinetic - g * (masses * centres[:, 1]).sum()


def euler_lagrange(links: ArmLinks, q: Numbers, dq: Numbers, ddq: Numbers, g: float) -> jax.Array:
    """d/dt of dL/d(dq), less dL/dq."""

    def one(q: jax.Array, dq: jax.Array, ddq: jax.Array) -> jax.Array:
        momentum = jax.grad(lagrangian, argnums=2)
        rate = jax.jvp(lambda q, dq: momentum(links, q, dq, g), (q, dq), (dq, ddq))[1]
        return rate - jax.grad(lagrangian, argnums=1)(links, q, dq, g)

    return jax.jit(jax.vmap(one))(q, dq, ddq)


@pytest.mark.parametrize("g", [0.0, 9.81], ids=["horizontal", "vertical"])
def test_torque_is_lagranges(g: float) -> None:
    q, dq, ddq = motion()
    D, K = IMPEDANCE.reshape(2, 2, 2)
    xi, gravity = BORNER.base_parameters(), BORNER.gravity_parameters()
    rigid = euler_lagrange(BORNER, q, dq, ddq, g)
    np.testing.assert_allclose(rigid_body_torque(q, dq, ddq, xi, gravity, g), rigid, rtol=1e-12, atol=1e-12)
    arm = PlanarArm(REST, gravity=True, g=g)
    theta = np.concatenate([xi, IMPEDANCE, gravity])
    expected = rigid + dq @ D.T + (q - np.array(REST)) @ K.T
    np.testing.assert_allclose(arm.torque(theta, q, dq, ddq), expected, rtol=1e-12, atol=1e-11)


def test_a_hanging_arm_is_a_horizontal_one_turned_by_a_quarter() -> None:
    q, dq, ddq = motion()
    hanging, horizontal = (PlanarArm(impedance=False, gravity=True, zero=zero) for zero in ("hanging", "horizontal"))
    turned = q - np.array([np.pi / 2, 0])
    np.testing.assert_allclose(hanging.regressor(q, dq, ddq), horizontal.regressor(turned, dq, ddq), atol=1e-11)


def test_a_known_length_ties_inertia_to_gravity() -> None:
    q, dq, ddq = motion()
    length = BORNER.lengths[0]
    tied = PlanarArm(impedance=False, gravity=True, length=length, rotor=True)
    assert tied.names == ("inertia_1", "inertia_3", "gravity_1", "gravity_2", "rotor_inertia_2")
    xi, gravity = np.asarray(BORNER.base_parameters()), np.asarray(BORNER.gravity_parameters())
    expected = np.asarray(rigid_body_torque(q, dq, ddq, xi, gravity)) + np.stack([0 * ddq[:, 1], 0.02 * ddq[:, 1]], 1)
    found = tied.torque(np.concatenate([xi[[0, 2]], gravity, [0.02]]), q, dq, ddq)
    np.testing.assert_allclose(found, expected, atol=1e-11)


def test_torque_is_the_mass_the_coriolis_and_the_gravity_terms() -> None:
    q, dq, ddq = motion()
    xi, gravity = BORNER.base_parameters(), BORNER.gravity_parameters()
    terms = (mass_matrix(q, xi) @ ddq[..., None] + coriolis_matrix(q, dq, xi) @ dq[..., None])[..., 0]
    np.testing.assert_allclose(rigid_body_torque(q, dq, ddq, xi), terms, rtol=1e-12, atol=1e-12)
    weight = rigid_body_torque(q, dq, ddq, xi, gravity) - rigid_body_torque(q, dq, ddq, xi)
    np.testing.assert_allclose(weight, gravity_torque(q, gravity), atol=1e-12)
    limp = PlanarArm(impedance=False, gravity=True)
    np.testing.assert_allclose(
        limp.torque(np.concatenate([xi, gravity]), q, dq, ddq),
        rigid_body_torque(q, dq, ddq, xi, gravity),
        rtol=1e-12,
        atol=1e-12,
    )


def test_mass_matrix_is_positive_and_its_rate_less_twice_the_coriolis_matrix_skew() -> None:
    (q, dq, _), xi = motion(), BORNER.base_parameters()
    mass, rate = jax.jvp(lambda q: mass_matrix(q, xi), (jnp.asarray(q),), (jnp.asarray(dq),))
    skew = np.asarray(rate - 2 * coriolis_matrix(q, dq, xi))
    np.testing.assert_allclose(skew, -np.swapaxes(skew, -1, -2), atol=1e-14)
    assert (np.linalg.eigvalsh(mass) > 0).all()


@pytest.mark.slow
def test_matrix_functions_take_batches_of_any_shape_and_differentiate() -> None:
    (q, dq, ddq), xi = motion(6), BORNER.base_parameters()
    shaped = [x.reshape(2, 3, 2) for x in (q, dq, ddq)]
    flat = rigid_body_torque(q, dq, ddq, xi)
    np.testing.assert_array_equal(rigid_body_torque(*shaped, xi).reshape(6, 2), flat)
    np.testing.assert_allclose(jax.jit(jax.vmap(rigid_body_torque, (0, 0, 0, None)))(q, dq, ddq, xi), flat, rtol=1e-13)
    assert mass_matrix(q[0], xi).shape == coriolis_matrix(q[0], dq[0], xi).shape == (2, 2)
    # Linear in the base parameters: the derivative is the regressor.
    by_xi = jax.jacfwd(rigid_body_torque, argnums=3)(q, dq, ddq, xi)
    np.testing.assert_allclose(by_xi, PlanarArm(impedance=False).regressor(q, dq, ddq), rtol=1e-12, atol=1e-12)


def test_base_parameters_are_the_papers_in_both_conventions() -> None:
    xi = BORNER.base_parameters()
    np.testing.assert_allclose(borner_from_lakatos(xi), [0.1945, 0.0737, 0.0838], atol=5e-5)
    np.testing.assert_allclose(xi, lakatos_from_borner(np.array([0.1945, 0.0737, 0.0838])), atol=1e-4)
    random = np.random.default_rng(0).normal(size=(4, 5, 3))
    np.testing.assert_allclose(lakatos_from_borner(borner_from_lakatos(random)), random, atol=1e-15)
    np.testing.assert_allclose(borner_from_lakatos(lakatos_from_borner(random)), random, atol=1e-15)


def test_base_inertia_has_names_in_place_of_an_order() -> None:
    xi = BORNER.base_parameters()
    named = BaseInertia.from_lakatos(xi)
    (m1, m2), (c1, c2), (I1, I2), l1 = BORNER.masses, BORNER.centres, BORNER.inertias, BORNER.lengths[0]
    assert named.upper_arm == pytest.approx(I1 + m1 * c1**2 + m2 * l1**2)
    assert named.forearm == pytest.approx(I2 + m2 * c2**2)
    assert named.coupling == pytest.approx(m2 * c2 * l1)
    np.testing.assert_allclose(named.lakatos, xi, rtol=1e-12)
    np.testing.assert_allclose(named.borner, borner_from_lakatos(xi), rtol=1e-12)
    again = BaseInertia.from_borner(named.borner)
    np.testing.assert_allclose(again.lakatos, xi, rtol=1e-12)
    # What has names already is not read in any order again.
    assert BaseInertia.from_borner(named) is named
    assert BaseInertia.from_lakatos(named) is named
    assert [f"{name}_inertia" for name in vars(named)] == list(BASE_INERTIA)
    assert not set(BASE_INERTIA) & set(PlanarArm(REST).names)
    batch = BaseInertia.from_lakatos(np.stack([xi, 2 * xi]))
    np.testing.assert_allclose(batch.lakatos, [xi, 2 * xi], rtol=1e-12)


@pytest.mark.parametrize("named", [BORNER.base_parameters(), np.stack([BORNER.base_parameters()] * 2)], ids=["", "two"])
def test_a_body_that_can_be_is_let_through(named: Numbers) -> None:
    found = BaseInertia.from_lakatos(named)
    assert found.check() is found
    assert jax.jit(lambda xi: BaseInertia.from_lakatos(xi).check().forearm)(named).shape == np.shape(named)[:-1]


HEAVY_FOREARM = BaseInertia(upper_arm=0.1, forearm=0.09, coupling=0.01)


@pytest.mark.parametrize(
    "inertia",
    [
        pytest.param(lambda: BaseInertia.from_borner(HEAVY_FOREARM.lakatos), id="Lakatos's order as Borner's"),
        pytest.param(lambda: BaseInertia.from_lakatos(np.array([0.05, 0.01, 0.09])), id="forearm above both"),
        pytest.param(lambda: BaseInertia(0.1, 0.05, 0.08), id="indefinite"),
        pytest.param(lambda: BaseInertia(0.1, 0.05, -0.01), id="negative"),
        pytest.param(lambda: BaseInertia(0.1, np.nan, 0.01), id="not a number"),
    ],
)
def test_no_body_has_such_an_inertia(inertia: Callable[[], BaseInertia]) -> None:
    with pytest.raises(ValueError, match=r"no rigid body has the inertia upper_arm = .*check their order"):
        inertia().check()


def test_torque_is_that_of_borners_regressor() -> None:
    """Eq. (13) of Börner et al. 2020, whose second column both joints feel alike."""
    (q, dq, ddq), pi = motion(), np.array([0.1945, 0.0737, 0.0838])
    lakatos = np.asarray(PlanarArm(impedance=False).regressor(q, dq, ddq))
    both = ddq.sum(axis=1)
    zero = np.zeros(len(q))
    borner = np.stack([np.stack([ddq[:, 0], zero], 1), np.stack([both, both], 1), lakatos[:, :, 1]], axis=2)
    np.testing.assert_allclose(rigid_body_torque(q, dq, ddq, lakatos_from_borner(pi)), borner @ pi, atol=1e-12)


@pytest.mark.parametrize("g", [0.0, 9.81], ids=["horizontal", "vertical"])
def test_regressor_is_pinocchios(g: float) -> None:
    pinocchio = pytest.importorskip("pinocchio")
    model = pinocchio.Model()
    model.gravity.linear = np.array([0.0, -g, 0.0])
    upper = model.addJoint(0, pinocchio.JointModelRZ(), pinocchio.SE3.Identity(), "shoulder")
    at_elbow = pinocchio.SE3(np.eye(3), np.array([BORNER.lengths[0], 0.0, 0.0]))
    fore = model.addJoint(upper, pinocchio.JointModelRZ(), at_elbow, "elbow")
    for joint, mass, centre, inertia in zip((upper, fore), BORNER.masses, BORNER.centres, BORNER.inertias, strict=True):
        body = pinocchio.Inertia(mass, np.array([centre, 0.0, 0.0]), np.diag([0.01, 0.02, inertia]))
        model.appendBodyToJoint(joint, body, pinocchio.SE3.Identity())
    data, sample = model.createData(), motion()
    theirs = np.stack(
        [pinocchio.computeJointTorqueRegressor(model, data, *x).copy() for x in zip(*sample, strict=True)]
    )
    ours = np.asarray(PlanarArm(impedance=False, gravity=True, g=g).regressor(*sample))
    xi1, xi2, xi3, gravity1, gravity2 = np.moveaxis(ours, -1, 0)
    # Theirs per body: mass, three first moments, six second moments about the joint, of which Izz is the last.
    mx, izz, second = 1, 9, 10
    l1 = BORNER.lengths[0]
    close = {"rtol": 1e-10, "atol": 1e-10}
    np.testing.assert_allclose(theirs[..., izz], xi1, **close)
    np.testing.assert_allclose(theirs[..., mx], gravity1, **close)
    np.testing.assert_allclose(theirs[..., second], l1**2 * xi1 + l1 * gravity1, **close)
    np.testing.assert_allclose(theirs[..., second + mx], l1 * xi2 + gravity2, **close)
    np.testing.assert_allclose(theirs[..., second + izz], xi1 + xi3, **close)
    phi = np.concatenate([inertia.toDynamicParameters() for inertia in model.inertias[1:]])
    theta = np.concatenate([BORNER.base_parameters(), BORNER.gravity_parameters()])
    np.testing.assert_allclose(ours @ theta, theirs @ phi, **close)


def test_names_and_units_are_lakatos_eleven_in_his_order() -> None:
    arm = PlanarArm(equilibrium=np.array(REST))
    entries = ("11", "12", "21", "22")
    assert arm.names == (
        *("inertia_1", "inertia_2", "inertia_3"),
        *(f"damping_{ij}" for ij in entries),
        *(f"stiffness_{ij}" for ij in entries),
    )
    assert arm.units == ("kg m^2",) * 3 + ("N m s/rad",) * 4 + ("N m/rad",) * 4
    robot = PlanarArm(impedance=False, gravity=True, viscous=True, coulomb=True, offset=True)
    names = ("gravity", "viscous_friction", "coulomb_friction", "offset_torque")
    assert robot.names[3:] == tuple(f"{name}_{i}" for name in names for i in (1, 2))
    assert robot.units[3:] == tuple(unit for unit in ("kg m", "N m s/rad", "N m", "N m") for _ in (1, 2))
    assert (arm.label, arm.n_joints) == ("arm", 2)


def test_columns_with_the_same_text_are_the_same_numbers_and_others_are_not() -> None:
    arms = [
        PlanarArm(rest, gravity=True, coulomb=True, offset=True, g=g)
        for rest in [(0.0, 0.0), (0.5, -0.25), (0.5, 0.0), (0.5000001, 0.0)]
        for g in (9.81, 1.62)
    ]
    sample, by_text = motion(), {}
    for arm in arms:
        for text, column in zip(arm.columns, np.moveaxis(np.asarray(arm.regressor(*sample)), -1, 0), strict=True):
            np.testing.assert_array_equal(by_text.setdefault(text, column), column, err_msg=text)
    columns = np.stack(list(by_text.values())).reshape(len(by_text), -1)
    assert len(np.unique(columns, axis=0)) == len(by_text)


def test_known_inertia_moves_to_the_other_side() -> None:
    """Eqs. (23) to (25) of Lakatos et al. 2011 give the impedance that all eleven parameters give."""
    q, dq, ddq = motion()
    xi = BORNER.base_parameters()
    full, reduced = PlanarArm(REST), PlanarArm(REST, inertia=False)
    torque = np.asarray(full.torque(np.concatenate([xi, IMPEDANCE]), q, dq, ddq))
    left = torque - np.asarray(rigid_body_torque(q, dq, ddq, xi))
    for model, y, expected in [(full, torque, np.r_[xi, IMPEDANCE]), (reduced, left, IMPEDANCE)]:
        W = np.asarray(model.observation_matrix(q, dq, ddq)).reshape(-1, len(model.names))
        np.testing.assert_allclose(np.linalg.lstsq(W, y.ravel())[0], expected, atol=1e-11)


def test_smoothed_signs_change_gradually_with_a_width_per_joint() -> None:
    arm = PlanarArm(REST, coulomb=True)
    q, dq, ddq = motion()
    smooth = np.asarray(arm.smoothed(np.array([0.1, 0.5])).regressor(q, dq, ddq))[..., -2:]
    np.testing.assert_allclose(np.diagonal(smooth, axis1=1, axis2=2), np.tanh(dq / [0.1, 0.5]), rtol=1e-14)
    np.testing.assert_array_equal(smooth[:, [0, 1], [1, 0]], 0.0)
    one = arm.smoothed(0.1).regressor(q, dq, ddq)
    np.testing.assert_array_equal(one, arm.smoothed(np.array([0.1, 0.1])).regressor(q, dq, ddq))
    robot = RobotJoint(gravity=False).smoothed(0.5).regressor(q[:, 1], dq[:, 1], ddq[:, 1])
    np.testing.assert_array_equal(smooth[:, 1, 1], robot[:, 1])


def test_single_precision_stays_single() -> None:
    arm = PlanarArm(REST, gravity=True, coulomb=True, offset=True)
    sample = [x.astype(np.float32) for x in motion()]
    W = arm.regressor(*sample)
    assert W.dtype == np.float32
    np.testing.assert_allclose(W, arm.regressor(*motion()), rtol=1e-5, atol=1e-4)
    for geometry in GEOMETRIES:
        x = geometry.forward(sample[0])
        back = geometry.inverse(x)
        assert x.dtype == back.dtype == np.float32
        np.testing.assert_allclose(geometry.forward(back), x, atol=1e-5)


def angles(geometry: ArmGeometry, n: int = 200) -> Numbers:
    """Over the whole plane, with the elbow on its side and away from straight and folded."""
    random = np.random.default_rng(3)
    bend = random.uniform(0.1, np.pi - 0.1, n) * (1 if geometry.elbow == "right" else -1)
    return np.stack([random.uniform(-np.pi, np.pi, n), bend], axis=-1)


@every_geometry
def test_inverse_undoes_forward(geometry: ArmGeometry) -> None:
    q = angles(geometry)
    x = geometry.forward(q)
    l1, l2 = geometry.lengths
    total = q.sum(axis=1)
    expected = np.stack([l1 * np.cos(q[:, 0]) + l2 * np.cos(total), l1 * np.sin(q[:, 0]) + l2 * np.sin(total)], axis=1)
    np.testing.assert_allclose(x, expected, atol=1e-15)
    np.testing.assert_allclose(geometry.inverse(x), q, atol=1e-12)
    np.testing.assert_allclose(jax.jit(geometry.inverse)(x), q, atol=1e-12)
    np.testing.assert_allclose(jax.vmap(geometry.inverse)(x), q, atol=1e-12)
    assert geometry.inverse(x[0]).shape == (2,)
    # The elbow is on its side of the line from shoulder to hand.
    elbow = l1 * np.stack([np.cos(q[:, 0]), np.sin(q[:, 0])], axis=1)
    left = np.asarray(x)[:, 0] * elbow[:, 1] - np.asarray(x)[:, 1] * elbow[:, 0] > 0
    assert (left == (geometry.elbow == "left")).all()


@every_geometry
def test_jacobian_is_the_derivative_and_keeps_the_power(geometry: ArmGeometry) -> None:
    q = angles(geometry, 30)
    random = np.random.default_rng(4)
    dq, force = random.normal(size=(2, 30, 2))
    jacobian = geometry.jacobian(q)
    np.testing.assert_allclose(jacobian, jax.vmap(jax.jacfwd(geometry.forward))(q), atol=1e-15)
    dx = (np.asarray(jacobian) @ dq[..., None])[..., 0]
    power = (np.asarray(geometry.joint_torque(q, force)) * dq).sum(axis=1)
    np.testing.assert_allclose(power, (force * dx).sum(axis=1), atol=1e-14)
    # The derivative of the inverse is the inverse of the derivative.
    by_x = jax.vmap(jax.jacfwd(geometry.inverse))(geometry.forward(q))
    np.testing.assert_allclose(by_x, np.linalg.inv(jacobian), rtol=1e-10, atol=1e-10)


@every_geometry
@pytest.mark.parametrize("bend", [0.0, np.pi], ids=["straight", "folded"])
def test_straight_and_folded_arms_have_one_solution(geometry: ArmGeometry, bend: float) -> None:
    """The hand's rounding shows in the elbow as its root."""
    side = 1.0 if geometry.elbow == "right" else -1.0
    q = np.stack([np.linspace(-3, 3, 50), np.full(50, side * bend)], axis=1)
    x = geometry.forward(q)
    back = np.asarray(geometry.inverse(x))
    np.testing.assert_allclose(back[:, 1], side * bend, atol=1e-6)
    np.testing.assert_allclose(geometry.forward(back), x, atol=1e-14)
    if geometry.lengths[0] != geometry.lengths[1] or bend == 0.0:
        np.testing.assert_allclose(back[:, 0], q[:, 0], atol=1e-6)


def test_the_hand_on_the_shoulder_folds_the_elbow() -> None:
    for geometry, bend in zip(GEOMETRIES[2:], (np.pi, -np.pi), strict=True):
        back = geometry.inverse(np.zeros(2))
        assert float(back[1]) == bend
        np.testing.assert_allclose(geometry.forward(back), 0.0, atol=1e-15)


def test_positions_out_of_reach_are_an_error_that_gives_the_reach_or_nan_where_traced() -> None:
    geometry = GEOMETRIES[0]
    x = np.array([[0.2, 0.3], [0.5, 0.5], [0.03, 0.0]])
    message = (
        r"2 of 3 positions cannot be reached: \(0.5, 0.5\) m \(index 1\) is 0.707107 m from the shoulder, and an arm "
        r"of 0.29 m and 0.34 m reaches from 0.05 m to 0.63 m"
    )
    with pytest.raises(ValueError, match=message):
        geometry.inverse(x)
    with pytest.raises(ValueError, match=r"the position cannot be reached: \(0.03, 0\) m is 0.03 m from"):
        geometry.inverse(x[2])
    traced = np.asarray(jax.jit(geometry.inverse)(x))
    np.testing.assert_array_equal(np.isnan(traced), [[False] * 2, [True] * 2, [True] * 2])
    np.testing.assert_allclose(traced[0], geometry.inverse(x[0]), rtol=1e-14)
    assert np.isnan(eqx.filter_jit(lambda arm, x: arm.inverse(x))(geometry, x[1])).all()


def test_a_gap_in_the_positions_is_a_gap_in_the_angles() -> None:
    x = np.array([[0.2, 0.3], [np.nan, np.nan]])
    back = np.asarray(GEOMETRIES[0].inverse(x))
    assert np.isfinite(back[0]).all()
    assert np.isnan(back[1]).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        pytest.param(lambda: PlanarArm(), r"pass equilibrium=\(q1, q2\)", id="no equilibrium"),
        pytest.param(lambda: PlanarArm((0.1,)), "equilibrium is .* two finite numbers", id="one angle"),
        pytest.param(lambda: PlanarArm((0.1, np.nan)), "equilibrium is .* two finite numbers", id="NaN angle"),
        pytest.param(lambda: PlanarArm(REST, impedance=False), "only the stiffness", id="equilibrium of no impedance"),
        pytest.param(lambda: PlanarArm(REST, viscous=True), "viscous friction already", id="damping twice"),
        pytest.param(lambda: PlanarArm(impedance=False, inertia=False), "switch at least one", id="no column left"),
        pytest.param(lambda: PlanarArm(REST, zero="up"), "zero is 'up'", id="unknown zero"),
        pytest.param(lambda: PlanarArm(REST, length=0.3), "needs inertia and gravity", id="length without gravity"),
        pytest.param(lambda: PlanarArm(REST) + PlanarArm(REST), "both models are called 'arm'", id="arm + arm"),
        pytest.param(lambda: PlanarArm(REST) + RobotJoint(), "2 and 1 joints", id="arm + one joint"),
        pytest.param(lambda: PlanarArm(REST).regressor(*[np.ones((4, 3))] * 3), "has 2 joints", id="three joints"),
        pytest.param(lambda: ArmGeometry((0.3, 0.3), elbow="up"), "elbow is 'up'", id="unknown side"),
        pytest.param(lambda: ArmGeometry((0.3, 0.0)), "lengths is .* above 0, one for each", id="no forearm"),
        pytest.param(lambda: ArmGeometry((0.3, 0.3, 0.1)), "lengths is .* two finite", id="three links"),
        pytest.param(
            lambda: ArmLinks((0.3, 0.3), (1.0, -1.0), (0.1, 0.1), (0.01, 0.01)), "masses is .* above 0", id="mass"
        ),
        pytest.param(
            lambda: ArmLinks((0.3, 0.3), (1.0, 1.0), (0.1, 0.1), (0.01, -0.01)), "inertias is .* least 0", id="inertia"
        ),
    ],
)
def test_errors_name_the_cause(make: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
