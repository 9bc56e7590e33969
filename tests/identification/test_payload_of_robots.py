"""The load of a robot of n joints by four methods, drive gains from a known load, and their errors."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import sqrtm

from factories.chains import FRICTION, TWO_JOINTS, motion, with_load
from factories.real_robots import PENDULUM
from jaximp.identification import FilterSettings, Payload, Pipeline, identify_gains, identify_payload, identify_robot
from jaximp.identification.block_errors import scatter
from jaximp.identification.payload import LOAD_METHODS, load_columns
from jaximp.models import SIX_JOINT_ARM, Chain, HumanJoint, parse_urdf, rigid_body
from jaximp.models.spatial import about, moved, pseudo_inertia
from jaximp.recordings import recording_from_arrays, recordings_from_mapping
from jaximp.types import Recording
from paths import DATA

FILTER = FilterSettings(position_cutoff=8.0, decimation_cutoff=4.0)
ARM = Chain(parse_urdf(TWO_JOINTS), friction=True)
"""It swings in a vertical plane about y: of a load it shows the mass, mc_x, mc_z and Iyy."""
PIPELINE = Pipeline(100.0, ARM, filter=FILTER)
SEEN = [0, 1, 3, 6]
LOAD = about(0.7, np.array([0.03, 0.02, 0.08]), np.diag([2e-3, 3e-3, 1e-3]))
GAINS = np.array([8.0, 3.0])
every_method = pytest.mark.parametrize("method", list(LOAD_METHODS), ids=lambda method: f"method {method}")


def pair(seed: int, method: int = 4, load: np.ndarray = LOAD, **settings: object) -> tuple[Recording, Recording]:
    """The robot alone and with a load, on one motion for method 3."""
    alone = with_load(ARM, 2 * seed, moves=0, **settings)  # type: ignore[arg-type]
    return alone, with_load(ARM, 2 * seed + 1, load, moves=0 if method == 3 else 1, **settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("tip", ["tool", "flange"])
def test_a_load_adds_its_columns(tip: str) -> None:
    """As if it were a part of the last link, in a frame that is turned and shifted."""
    chain = Chain.from_urdf(SIX_JOINT_ARM, tip=tip)
    load = about(2.0, np.array([0.01, -0.02, 0.05]), np.diag([0.01, 0.02, 0.015]))
    links = np.array(chain.links)
    links[chain.tree.tip_body] += moved(load, chain.tree.tip_rotation, chain.tree.tip_position)
    q, dq, ddq = np.random.default_rng(0).normal(size=(3, 20, 6))
    added = rigid_body.inverse_dynamics(chain.tree, links, q, dq, ddq) - chain.inverse_dynamics(q, dq, ddq)
    W = np.asarray(chain.observation_matrix(q, dq, ddq))
    np.testing.assert_allclose(W @ load_columns(chain) @ load, added, atol=1e-10)


@every_method
def test_without_noise_the_load_is_found(method: int) -> None:
    found = identify_payload(PIPELINE, *pair(0, method, noise=0.0), method)
    np.testing.assert_allclose(found.theta[SEEN], LOAD[SEEN], atol=2e-3)
    assert np.isnan(np.delete(found.theta, SEEN)).all()
    np.testing.assert_array_equal(np.flatnonzero(found.determined), SEEN)
    centre = found.centre
    np.testing.assert_allclose(centre.value[[0, 2]], [0.03, 0.08], atol=2e-3)
    assert np.isnan(centre.value[1])
    assert found.inertia_about_centre["load.Iyy_at_centre"].value == pytest.approx(3e-3, abs=1e-3)


@every_method
def test_errors_are_what_they_claim(method: int) -> None:
    runs = [identify_payload(PIPELINE, *pair(seed, method), method) for seed in range(1, 13)]
    apart = np.array([(one.theta - LOAD)[SEEN] / one.stderr[SEEN] for one in runs])
    assert 0.6 < np.sqrt((apart**2).mean()) < 1.4
    held = [(low < LOAD) & (high > LOAD) for low, high in (one.interval() for one in runs)]
    assert np.mean(np.array(held)[:, SEEN]) > 0.85
    centre = np.array([(one.centre.theta[0] - 0.03) / one.centre.stderr[0] for one in runs])
    assert 0.4 < np.sqrt((centre**2).mean()) < 1.6


def test_the_covariance_is_that_of_the_paper() -> None:
    """Bell and McCaffrey 2002, with full matrices: corrected residuals of blocks, and degrees of freedom."""
    rng = np.random.default_rng(3)
    W, y, valid = rng.normal(size=(60, 2, 3)), rng.normal(size=(60, 2)), rng.random((60, 2)) < 0.9
    known = np.array([[2.0, 0.5, 0.0]])
    found = scatter(W, y, valid, known)
    count = len(found.leverage)
    X = np.concatenate([np.where(valid[..., None], W, 0).reshape(-1, 3), known])
    H = X @ np.linalg.inv(X.T @ X) @ X.T
    left = (np.append(np.where(valid, y, 0), 0) - H @ np.append(np.where(valid, y, 0), 0))[:-1]
    ends = 2 * np.round(np.linspace(0, 60, count + 1)).astype(int)
    A, G, spread = np.linalg.inv(X.T @ X), [], known.T @ known
    for first, last in pairwise(ends):
        block = slice(first, last)
        corrected = np.linalg.inv(np.real(sqrtm(np.eye(last - first) - H[block, block])))
        score = X[block].T @ corrected @ left[block]
        spread = spread + np.outer(score, score)
        G.append(((np.eye(len(H)) - H)[block].T @ corrected @ X[block] @ A)[:, 0])
    np.testing.assert_allclose(found.covariance, A @ spread @ A, rtol=1e-8)
    between = np.array(G) @ np.array(G).T
    assert found.dof(np.eye(3))[0] == pytest.approx(np.trace(between) ** 2 / (between**2).sum())


def test_methods_say_what_they_did() -> None:
    """Method 3 takes off what the motions differ by, and method 2 leaves friction to each recording."""
    alone, same = pair(3, 3)
    later = replace(same, **{key: getattr(same, key)[37:] for key in ("time", "position", "torque", "valid")})
    found = identify_payload(PIPELINE, alone, later, 3)
    assert found["load.mass"].value == pytest.approx(identify_payload(PIPELINE, alone, same, 3).mass.value, rel=0.02)
    assert any("begins 0.37 s later in the motion" in note for note in found.notes)
    with pytest.raises(ValueError, match="needs one motion twice"):
        identify_payload(PIPELINE, alone, pair(3)[1], 3)
    dq = motion(1)[2]
    rubs = pair(3, noise=0.0)[1]
    rubs = replace(rubs, torque=rubs.torque + FRICTION["coulomb_friction"] * np.sign(dq))
    clean = pair(3, noise=0.0)[0]
    by_method = [abs(identify_payload(PIPELINE, clean, rubs, method).mass.value - 0.7) for method in (1, 2, 4)]
    assert by_method[1] < 0.003 < 0.1 * min(by_method[0], by_method[2]) + 0.003


def test_gains_are_carried_into_the_mass() -> None:
    """What all have in common scales the load, and leaves the centre as it is; the words say so."""
    alone, loaded = pair(4)
    plain = identify_payload(PIPELINE, alone, loaded)
    common = identify_payload(PIPELINE, *(replace(x, gain_covariance=np.full((2, 2), 0.01)) for x in (alone, loaded)))
    np.testing.assert_allclose(common.theta, plain.theta)
    np.testing.assert_allclose(common.gain_stderr[SEEN], 0.1 * np.abs(plain.theta[SEEN]))
    np.testing.assert_allclose(common.centre.stderr, plain.centre.stderr)
    assert any("common scale, which is known to 10 %: without a known load" in line for line in common.in_words())
    assert any("taken as exact" in line and "without a known load" in line for line in plain.in_words())
    each = identify_payload(PIPELINE, *(replace(x, gain_covariance=np.diag([0, 0.01])) for x in (alone, loaded)))
    scaled = identify_payload(PIPELINE, *(replace(x, torque=x.torque * [1, 1.01]) for x in (alone, loaded)))
    moved_by = 10 * np.abs(scaled.theta - plain.theta)[SEEN]
    np.testing.assert_allclose(each.gain_stderr[SEEN], moved_by, rtol=0.1, atol=1e-4)
    with pytest.raises(ValueError, match="different errors of the gains"):
        identify_payload(PIPELINE, alone, [loaded, replace(loaded, gain_covariance=np.eye(2))])


def test_quite_the_same_motion_leaves_nothing_of_the_robot() -> None:
    """By method 3: then errors are those of the torques alone."""
    alone, loaded = pair(12, 3)
    found = identify_payload(PIPELINE, alone, replace(loaded, position=alone.position), 3)
    low, high = found.mass.interval()
    assert low < 0.7 < high
    assert np.isfinite(found.dof[SEEN]).all()


def test_words_say_what_is_determined() -> None:
    words = identify_payload(PIPELINE, *pair(5, noise=0.3)).in_words()
    assert words[0].startswith("mass 0.")
    assert words[1].startswith("centre of mass in the frame of fore: x ")
    assert "y not determined" in words[1]
    assert words[2] == "determined: mass, mc_x, mc_z and Iyy"
    assert words[3] == "not determined: mc_y, Ixx, Ixy, Ixz, Iyz and Izz"


def test_several_recordings_are_one_fit() -> None:
    alone, loaded = pair(6)
    both = identify_payload(PIPELINE, [alone, with_load(ARM, 40)], [loaded, with_load(ARM, 41, LOAD)])
    assert both.mass.stderr < identify_payload(PIPELINE, alone, loaded).mass.stderr
    assert abs(both.mass.value - 0.7) < 4 * both.mass.stderr
    with pytest.raises(ValueError, match="method 3 compares two recordings"):
        identify_payload(PIPELINE, [alone, alone], loaded, 3)


def test_a_pendulum_shows_no_mass() -> None:
    """A mass at its hinge turns nothing."""
    t = np.arange(2000) / 100
    q, dq, ddq = np.sin(2 * t) + 0.4 * np.sin(5 * t), 2 * np.cos(2 * t) + 2 * np.cos(5 * t), -4 * np.sin(2 * t)
    ddq = ddq - 10 * np.sin(5 * t)
    W = np.asarray(PENDULUM.observation_matrix(q, dq, ddq))
    theta = np.append(PENDULUM.parameters[:3], 0.3)
    noise = 0.01 * np.random.default_rng(0).normal(size=(2, 2000))
    torques = W @ theta + noise[0], W @ (theta + load_columns(PENDULUM) @ LOAD) + noise[1]
    alone, loaded = (recording_from_arrays(t, q, torque) for torque in torques)
    pipeline = Pipeline(100.0, PENDULUM, filter=FILTER)
    found = identify_payload(pipeline, alone, loaded, 1)
    assert np.isnan(found.mass.value)
    assert np.isnan(found.centre.value).all()
    assert found["load.mc_x"].value == pytest.approx(LOAD[1], abs=5 * found["load.mc_x"].stderr)
    with pytest.raises(ValueError, match="give its centre of mass"):
        identify_gains(pipeline, alone, loaded, 0.7)
    halved = (replace(x, torque=x.torque / 2) for x in (alone, loaded))
    gains = identify_gains(pipeline, *halved, 0.7, centre=[0.03, 0.02, 0.08])
    assert gains["joint1.gain"].value == pytest.approx(2, rel=0.02)


# --- gains ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("same_friction", [False, True], ids=["its own friction", "the same friction"])
def test_without_noise_gains_are_found(same_friction: bool) -> None:
    found = identify_gains(PIPELINE, *pair(0, noise=0.0, gain=GAINS), 0.7, same_friction=same_friction)
    np.testing.assert_allclose(found.value, GAINS, rtol=2e-3)
    assert found.names == ("joint1.gain", "joint2.gain")


def test_errors_of_gains_are_what_they_claim() -> None:
    """And those of a load that is weighed with them."""
    other, gains, masses = 1.6 * LOAD, [], []
    for seed in range(20, 32):
        found = identify_gains(PIPELINE, *pair(seed, gain=GAINS), 0.7)
        gains.append((found.theta - GAINS) / found.stderr)
        new = (found.applied(x) for x in pair(seed + 100, load=other, gain=GAINS))
        weighed = identify_payload(PIPELINE, *new, 4)
        masses.append((weighed.mass.value - other[0]) / weighed.mass.stderr)
        assert weighed.gain_stderr[0] > 0.3 * weighed.mass.stderr
    assert 0.6 < np.sqrt(np.mean(np.square(gains))) < 1.4
    assert 0.5 < np.sqrt(np.mean(np.square(masses))) < 1.5


def test_gains_know_the_error_of_the_mass() -> None:
    """A mass that is known to 10 % makes gains that have 10 % in common; the centre, where it is known, helps."""
    recordings = pair(7, gain=GAINS)
    exact, vague = (identify_gains(PIPELINE, *recordings, 0.7, error) for error in (0.0, 0.07))
    np.testing.assert_allclose(exact.theta, vague.theta, rtol=1e-4)
    grown = np.sqrt(np.diagonal(vague.covariance - exact.covariance)) / exact.theta
    np.testing.assert_allclose(grown, 0.1, rtol=0.02)
    centred = identify_gains(PIPELINE, *recordings, 0.7, centre=[0.03, 0.02, 0.08], centre_error=1e-3)
    assert (centred.stderr < exact.stderr).all()
    np.testing.assert_allclose(centred.theta, GAINS, atol=4 * exact.stderr.max())


def test_gains_go_into_a_job(tmp_path: Path) -> None:
    """As `gain` and `gain_error`: a file of currents that is read with them has the torques of `applied`, and nearly
    what it knows of their errors."""
    loaded = pair(8, gain=GAINS)[1]
    found = identify_gains(PIPELINE, *pair(8, gain=GAINS), 0.7)
    applied = found.applied(loaded)
    np.savetxt(tmp_path / "run.csv", np.column_stack([loaded.time, loaded.position, loaded.torque]), delimiter=",")
    torque = {"columns": [4, 5], "gain": found.theta.tolist(), "gain_error": found.gain_error}
    columns = {"file": "run.csv", "time": 1, "position": [2, 3], "torque": torque}
    (read,) = recordings_from_mapping(columns, tmp_path)
    np.testing.assert_allclose(read.torque, applied.torque, rtol=1e-9)
    assert read.gain_covariance is not None
    assert applied.gain_covariance is not None
    np.testing.assert_allclose(read.gain_covariance, applied.gain_covariance, rtol=0.3)
    assert any("known load" in note for note in applied.notes)
    with pytest.raises(ValueError, match="has 1 joints, the gains are of 2"):
        found.applied(loaded.of_joint(0))


def test_bad_input_is_refused() -> None:
    alone, loaded = pair(9, gain=GAINS)
    with pytest.raises(ValueError, match="method is 5"):
        identify_payload(PIPELINE, alone, loaded, 5)
    with pytest.raises(ValueError, match="whose model is a Chain"):
        identify_payload(Pipeline(100.0, HumanJoint()), alone, loaded)
    with pytest.raises(ValueError, match=r"leave out filter\.mode"):
        identify_payload(replace(PIPELINE, filter=replace(FILTER, mode="window")), alone, loaded)
    unknown = Chain(parse_urdf(TWO_JOINTS), friction=["coulomb", "stribeck"], stribeck="estimate")
    with pytest.raises(ValueError, match="Stribeck's curves are not looked for"):
        identify_payload(replace(PIPELINE, model=unknown), alone, loaded)
    with pytest.raises(ValueError, match="the load pulls upwards"):
        identify_gains(PIPELINE, loaded, alone, 0.7)
    with pytest.raises(ValueError, match="mass is 0"):
        identify_gains(PIPELINE, alone, loaded, 0.0)
    with pytest.raises(ValueError, match="three finite coordinates"):
        identify_gains(PIPELINE, alone, loaded, 0.7, centre=[0.0, 1.0])
    still = replace(alone, position=np.zeros_like(alone.position))
    with pytest.raises(ValueError, match="do not determine all of the robot's parameters"):
        identify_payload(PIPELINE, still, loaded, 1)


def test_a_robot_is_known_with_its_covariance() -> None:
    robot = identify_robot(PIPELINE, pair(10)[0])
    np.testing.assert_allclose(robot.by_joint.sum(axis=1), robot.theta)
    assert np.linalg.eigvalsh(robot.covariance).min() > 0


# --- real bodies and real recordings ----------------------------------------------------------------------------------


def test_the_nearest_body_is_real() -> None:
    pytest.importorskip("cvxpy", reason="real bodies need cvxpy: pip install 'jaximp[robots]'")
    from jaximp.consistency import nearest_body

    C = np.diag(np.square([0.01, *[1e-3] * 3, *[1e-3] * 6]))
    kept = nearest_body(LOAD, C)
    assert kept.distance < 0.1
    np.testing.assert_allclose(kept.parameters, LOAD, atol=1e-4)
    wrong = LOAD - np.array([0, 0, 0, 0, 0, 0, 0, 0, 0, 8e-3])
    nearest = nearest_body(wrong, C)
    assert np.linalg.eigvalsh(pseudo_inertia(nearest.parameters)).min() > 0
    assert 3 < nearest.distance < 8
    found: Payload = identify_payload(PIPELINE, *pair(11))
    real = nearest_body(found.theta, found.covariance)
    assert np.linalg.eigvalsh(pseudo_inertia(real.parameters)).min() > 0
    assert real.parameters[0] == pytest.approx(found.mass.value, abs=2 * found.mass.stderr)


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "ur10e").is_dir(), reason=f"no recordings of the arm in {DATA}")
def test_a_real_arm_weighs_its_load() -> None:
    """2.805 kg: with the owners' gains too light, and within their 10 %; with those from one half it is right."""
    folder = DATA / "ur10e"
    chain = Chain.from_urdf(folder / "ur10e.urdf", friction=True, rotor=True, offset=True).with_sign_width(0.005)
    pipeline = Pipeline(100.0, chain, filter=FilterSettings(position_cutoff=10.0, decimation_cutoff=5.0))
    files = {"alone": ("14harm50sec.csv", 195), "loaded": ("14harm50secLoad.csv", 308)}

    def read(which: str, half: int | None = None, **of_torque: object) -> Recording:
        file, first = files[which]
        rows = {None: [first, first + 4763], 0: [first, first + 2381], 1: [first + 2382, first + 4763]}[half]
        torque = {"columns": [14, 15, 16, 17, 18, 19], **of_torque}
        columns = {"time": 1, "position": [2, 3, 4, 5, 6, 7], "torque": torque}
        return recordings_from_mapping({"file": file, "rows": rows, **columns}, folder)[0]

    owners = {"gain": [10.0, 10.70, 8.46, 9.00, 9.48, 10.12], "gain_error": {"common": 10}}
    found = identify_payload(pipeline, read("alone", **owners), read("loaded", **owners))
    low, high = found.mass.interval()
    assert low < 2.805 < high
    assert found.mass.value < 0.95 * 2.805
    assert any("the mass carries the gains' common scale" in line for line in found.in_words())
    gains = identify_gains(pipeline, read("alone", 0), read("loaded", 0), 2.805)
    weighed = identify_payload(pipeline, *(gains.applied(read(which, 1)) for which in files))
    low, high = weighed.mass.interval()
    assert low < 2.805 < high
