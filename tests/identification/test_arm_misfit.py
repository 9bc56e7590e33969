"""Arms in windows, and a human in a robot: intervals in slow noise, and what their models lack."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from jaximp.identification.estimates import Estimates
from jaximp.identification.identify import estimate
from jaximp.identification.misfit import culprits, sizes
from jaximp.identification.pipeline import Pipeline
from jaximp.models import HumanJoint, PlanarArm, RobotJoint
from jaximp.trust.score_tests import FAMILYWISE, significant
from jaximp.types import Recording

RATE, SECONDS, RECORDS = 200.0, 30.0, 6


def identified(
    arms: ModuleType, arm: Any, wrong: Any = None, records: int = RECORDS, noise: str = "estimated"
) -> list[Estimates]:
    """Estimates of records that differ in motion and noise, which is an autoregression."""
    pipeline = arms.pipeline(arm, wrong, rate=RATE, noise=noise)
    generators = [np.random.default_rng((40, k)) for k in range(records)]
    return [
        estimate(pipeline, arms.record(random, arm, "order", wrong, rate=RATE, seconds=SECONDS))[0]
        for random in generators
    ]


def covered(arms: ModuleType, arm: Any, estimates: list[Estimates]) -> float:
    """Share of the intervals of 95 % that hold the truth."""
    truth = np.array(list(arm.truth.values()))
    held = [(one.interval()[0] < truth) & (truth < one.interval()[1]) for one in estimates]
    return float(np.mean(held))


@pytest.mark.slow
def test_intervals_of_an_arm_hold_the_truth_in_slow_noise(arms: ModuleType) -> None:
    estimates = identified(arms, arms.HUMAN)
    count = sum(one.value.size for one in estimates)
    assert covered(arms, arms.HUMAN, estimates) >= 0.95 - 0.02 - 3.5 * np.sqrt(0.95 * 0.05 / count)
    ordinary = identified(arms, arms.HUMAN, noise="filtered")
    assert covered(arms, arms.HUMAN, ordinary) < 0.9
    assert all(one.trusted.all() for one in estimates)
    assert sum(bool(significant(one.misfits)) for one in estimates) <= 1


@pytest.mark.parametrize(
    ("wrong", "words", "off", "spared"),
    [
        ("dry friction of joint 2, 0.2 N m", "dry friction of joint 2", "damping_22", "stiffness_11"),
        pytest.param(
            "torque 1 late by 2 ms",
            "a delay between torque and position of joint 1",
            "damping_11",
            "stiffness_22",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "torque 2 too large by 20 %", "one scale of both joints' torques", "inertia_3", "", marks=pytest.mark.slow
        ),
        pytest.param(
            "robot without dry friction",
            "dry friction of joint 2 and dry friction of joint 1",
            "viscous_friction_1",
            "gravity_1",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "robot without viscous friction",
            "viscous friction of joint 2",
            "coulomb_friction_2",
            "gravity_1",
            marks=pytest.mark.slow,
        ),
    ],
    ids=["friction", "delay", "scale", "robot's dry friction", "robot's viscous friction"],
)
def test_what_an_arm_lacks_is_named_joint_by_joint(
    arms: ModuleType, wrong: str, words: str, off: str, spared: str
) -> None:
    for one in identified(arms, *arms.WRONG[wrong], records=4):
        assert words in culprits(one.misfits)
        assert off in one.lacking
        assert not one.trusted.any()
        assert not one.trusted_in(off).any()
        if spared:
            assert one.trusted_in(spared).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["HUMAN", "ROBOT"])
def test_good_arms_pass(arms: ModuleType, name: str) -> None:
    records = 60
    estimates = identified(arms, getattr(arms, name), records=records)
    alarms = np.mean([bool(significant(one.misfits)) for one in estimates])
    assert alarms <= FAMILYWISE + 0.02 + 3.5 * np.sqrt(FAMILYWISE / records)
    assert np.mean([one.trusted.mean() for one in estimates]) > 0.95


def test_what_couples_two_joints_counts_by_the_size_of_both() -> None:
    arm = PlanarArm((0.0, 1.0))
    usual = np.array([0.3, 0.1, 0.1, 2.0, 0.0, 1.5, 1.0, 36.0, 1.0, 20.0, 16.0])
    found = dict(zip(arm.names, sizes(usual, arm.roles), strict=True))
    assert found["stiffness_12"] == pytest.approx(24.0)
    assert found["damping_12"] == pytest.approx(np.sqrt(2.0))
    assert found["damping_21"] == 1.5
    assert (found["inertia_2"], found["stiffness_22"]) == (0.1, 16.0)


# ---- A human in a robot.

ROBOT = {"inertia": 0.01, "viscous_friction": 0.3, "coulomb_friction": 0.4}


def pair(
    ankles: ModuleType, seed: int, coulomb: bool = True, cubic: float = 0.0, seconds: float = 40.0
) -> list[Estimates]:
    """Methods 1, 3 and 4 on a robot, and on the ankle in it, whose stiffness may rise with the angle."""
    random = np.random.default_rng((50, seed))
    motion = ankles.move(random, rate=RATE, seconds=seconds)
    robot = motion.through(lambda s: ROBOT["inertia"] * s**2 + ROBOT["viscous_friction"] * s)
    robot += ROBOT["coulomb_friction"] * np.sign(motion.velocity)
    human = motion.through(ankles.impedance) + ankles.OFFSET
    human += ankles.STIFFNESS * cubic / ankles.SIZE**2 * motion.position**3

    def recording(torque: Any) -> Recording:
        noise = 0.3 * ankles.NOISES["pink"](random, motion)
        return replace(one, torque=(torque + noise)[:, None])

    one = ankles.record(np.random.default_rng(0), rate=RATE, seconds=seconds)
    one = replace(one, position=motion.position[:, None])
    single = ankles.pipeline(RATE)
    model = RobotJoint(gravity=False, viscous=True, coulomb=coulomb)
    pipeline = Pipeline(RATE, HumanJoint(), single.window, single.filter, robot=model, methods=(1, 3, 4))
    return estimate(pipeline, recording(robot + human), recording(robot))


def of_robot(one: Estimates) -> list[str]:
    """What is said of the robot's model."""
    return [note for note in one.notes if note.startswith("the model of the robot lacks")]


@pytest.mark.slow
def test_the_model_of_a_human_in_a_robot_is_tested_by_every_method(ankles: ModuleType) -> None:
    for good, wrong in zip(pair(ankles, 0), pair(ankles, 0, cubic=0.3), strict=True):
        assert len(good.misfits) >= 5
        assert significant(good.misfits) == []
        assert good.trusted.all()
        assert of_robot(good) == []
        assert "a stiffness that depends on the angle" in wrong.lacking["stiffness"]
        assert "of the robot" not in culprits(wrong.misfits)
        assert not wrong.trusted.any()
        move = max(wrong.misfits, key=lambda test: test.evidence).move[good.names.index("stiffness")]
        off = good["stiffness"].value.mean() - wrong["stiffness"].value.mean()
        assert move == pytest.approx(off, rel=0.3)


def test_a_robot_that_lacks_friction_is_found(ankles: ModuleType) -> None:
    first, third, fourth = pair(ankles, 1, coulomb=False)
    for one in (first, third, fourth):
        assert of_robot(one) == ["the model of the robot lacks dry friction"]
    assert all(test.group != "friction" for test in (*first.misfits, *fourth.misfits))
    # on the same motion the friction of both recordings cancels
    assert third.trusted.all()
