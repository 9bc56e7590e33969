"""Who is asked of a joint, and the columns of a play."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest

from jaximp.identification.pipeline import Pipeline
from jaximp.identification.suspects import behind_filters, behind_play, motions, of_one_joint
from jaximp.models import RobotJoint


@pytest.mark.parametrize("half", [0.1, 1.0, 20.0])
@pytest.mark.parametrize("kind", ["walk", "sine", "steps"])
def test_a_play_is_what_it_is_sample_by_sample(kind: str, half: float) -> None:
    walk = np.cumsum(np.random.default_rng(1).normal(size=600))
    q = {"walk": walk, "sine": np.sin(np.arange(600) / 20), "steps": np.repeat(np.round(walk[:200]), 3)}[kind]
    expected, last = np.empty_like(q), q[0]
    for k, position in enumerate(q):
        expected[k] = last = min(max(last, position - half), position + half)
    np.testing.assert_array_equal(behind_play(q, half), expected)


def test_a_machine_without_muscles_is_asked_for_no_reflex(ankles: ModuleType) -> None:
    recording, joint = ankles.record(np.random.default_rng(2), rate=200.0, seconds=10.0), ankles.pipeline(200.0)
    robot = Pipeline(200.0, RobotJoint(gravity=False), joint.window, joint.filter)
    of_machine = dict(of_one_joint(robot, recording))
    of_joint = dict(of_one_joint(joint, recording))
    assert set(of_joint) - set(of_machine) == {"reflex", "stiffness", "play"}
    for name, columns in of_machine.items():
        np.testing.assert_allclose(columns, of_joint[name], rtol=1e-9)


def test_the_sensor_is_asked_by_the_torque_of_the_model(ankles: ModuleType) -> None:
    recording, joint = ankles.record(np.random.default_rng(2), rate=200.0, seconds=10.0), ankles.pipeline(200.0)
    asked, theta = dict(of_one_joint(joint, recording)), np.array([*ankles.TRUTH.values()])
    known = dict(of_one_joint(joint, recording, theta))
    assert set(known) - set(asked) == {"sensor"}
    (motion,) = motions(joint, recording)
    torque = np.stack([motion.ddq, motion.dq, motion.q, np.ones_like(motion.q)], axis=1) @ theta
    expected = behind_filters(joint.filters, [torque**2, torque**3])
    np.testing.assert_allclose(known["sensor"], expected, rtol=1e-9, atol=1e-9)
