"""A simulated robot obeys its equation of motion, follows what it is asked for, and is measured with noise."""

from __future__ import annotations

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from factories.chains import HELD
from factories.robots import TREE
from jaximp.jobs import WindowJob, read_job
from jaximp.models import SIX_JOINT_ARM, Chain, TipImpedance
from jaximp.models.spatial import PARAMETERS
from jaximp.simulation import RobotDrive, RobotRecording, exciting_motion, simulate_robot, true_parameters
from jaximp.simulation.robot_recordings import write_robot_recordings
from jaximp.types import Recording

LOCKED = ("joint_4", "joint_5", "joint_6")


@pytest.fixture(scope="module")
def chain() -> Chain:
    """Three joints of the arm that comes with the package."""
    return Chain.from_urdf(SIX_JOINT_ARM, locked=LOCKED, friction=True, rotor=True)


@pytest.fixture(scope="module")
def recording(chain: Chain) -> RobotRecording:
    return simulate_robot(chain, true_parameters(chain, 3), exciting_motion(chain, 4.0), 4.0, RobotDrive(rate=250), 1)


def test_torque_is_that_of_the_motion(chain: Chain, recording: RobotRecording) -> None:
    rate = 1 / (recording.time[1] - recording.time[0])
    q, torque = recording.true_position, recording.true_torque
    dq, ddq = (q[2:] - q[:-2]) * rate / 2, (q[2:] - 2 * q[1:-1] + q[:-2]) * rate**2
    theta = np.asarray(chain.base.map) @ true_parameters(chain, 3)
    needed = np.asarray(chain.observation_matrix(q[1:-1], dq, ddq)) @ theta
    fast = np.abs(dq) > 0.2  # where friction has turned
    error = (torque[1:-1] - needed)[50:][fast[50:]]
    assert np.sqrt((error**2).mean()) < 0.01 * np.sqrt((torque**2).mean())


def test_a_slow_recorder_sees_the_same_robot(chain: Chain, recording: RobotRecording) -> None:
    slow = simulate_robot(chain, true_parameters(chain, 3), exciting_motion(chain, 4.0), 4.0, RobotDrive(rate=50), 1)
    np.testing.assert_allclose(slow.true_position, recording.true_position[::5], atol=1e-9)
    np.testing.assert_allclose(slow.true_torque, recording.true_torque[::5], atol=1e-6)


@pytest.mark.slow  # compiles a simulation of its own
def test_a_human_who_holds_it_takes_torque(chain: Chain) -> None:
    """What the motors need is the torque of the robot and of the human's impedance."""
    theta, human = np.array([1.0, 2.0, 20.0, 30.0, 150.0, 100.0, -40.0, 10.0]), TipImpedance(chain, "xz")
    parameters, motion = true_parameters(chain, 3), exciting_motion(chain, 4.0)
    made = simulate_robot(chain, parameters, motion, 4.0, RobotDrive(rate=250), 1, (human, theta))
    rate, q = 250, made.true_position
    dq, ddq = (q[2:] - q[:-2]) * rate / 2, (q[2:] - 2 * q[1:-1] + q[:-2]) * rate**2
    of_robot = np.asarray(chain.observation_matrix(q[1:-1], dq, ddq)) @ (np.asarray(chain.base.map) @ parameters)
    of_human = np.asarray(human.observation_matrix(q[1:-1], dq, ddq)) @ theta
    fast = np.abs(dq) > 0.2
    error = (made.true_torque[1:-1] - of_robot - of_human)[50:][fast[50:]]
    assert np.sqrt((error**2).mean()) < 0.02 * np.sqrt((of_human**2).mean())


@pytest.mark.slow  # simulates an arm of two joints twice
def test_recordings_of_a_held_robot_come_with_their_job(tmp_path: Path) -> None:
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(HELD, encoding="utf-8")
    out = tmp_path / "out"
    out.mkdir()
    write_robot_recordings(out, urdf, duration=3.0, held=True)
    job = read_job(out / "job.toml")
    assert isinstance(job, WindowJob)
    alone, held = job.load_robot_alone(), job.load()
    assert isinstance(alone, Recording)
    assert len(alone) == len(held) == 1500
    assert np.abs(held.torque - alone.torque).max() > 5
    truth = json.loads((out / "truth.json").read_text())
    robot, human = job.models(held.joints)
    assert robot is not None
    assert human is not None
    assert set(truth) == {*robot.names, *human.names}
    (tmp_path / "tree.urdf").write_text(TREE, encoding="utf-8")
    with pytest.raises(ValueError, match="nobody knows which end a human would hold"):
        write_robot_recordings(out, tmp_path / "tree.urdf", duration=3.0, held=True)


def test_it_follows_what_it_is_asked_for_within_its_limits(chain: Chain, recording: RobotRecording) -> None:
    motion = exciting_motion(chain, 4.0)
    asked, fast, _ = (np.asarray(x) for x in motion(jnp.asarray(recording.time)))
    assert np.abs(recording.true_position - asked)[100:].max() < 0.02
    assert (asked > chain.limits.lower).all()
    assert (asked < chain.limits.upper).all()
    assert (np.abs(fast) <= chain.limits.velocity).all()


def test_sensors_add_what_they_say(chain: Chain, recording: RobotRecording) -> None:
    step = RobotDrive().encoder_step
    np.testing.assert_allclose(recording.position / step, np.round(recording.position / step), atol=1e-6)
    assert np.abs(recording.position - recording.true_position).max() <= 0.51 * step
    noise = (recording.torque - recording.true_torque).std(axis=0) / chain.limits.effort
    np.testing.assert_allclose(noise, RobotDrive().torque_noise, rtol=0.1)


def test_the_true_robot_is_a_rigid_body_but_not_that_of_its_urdf(chain: Chain) -> None:
    links = true_parameters(chain, 3)[: 10 * chain.tree.n_bodies].reshape(-1, len(PARAMETERS))
    heavier = links[:, :1] / np.asarray(chain.links)[:, :1]
    np.testing.assert_allclose(links, heavier * np.asarray(chain.links))
    assert np.abs(heavier - 1).max() > 0.01


def test_what_cannot_be_simulated_is_refused(chain: Chain) -> None:
    motion, parameters = exciting_motion(chain, 4.0), true_parameters(chain)
    with pytest.raises(ValueError, match="it must last from 1 s to an hour"):
        simulate_robot(chain, parameters, motion, 0.5)
    two = Chain.from_urdf(SIX_JOINT_ARM, locked=("joint_3", *LOCKED))
    with pytest.raises(ValueError, match="the motion is one of"):
        simulate_robot(chain, parameters, exciting_motion(two), 4.0)
