"""A human in a robot that may not be the same in all recordings: what is said, and how sure the human's are."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from factories.joints import JOB, TRUTH, sines
from jaximp.identification import check
from jaximp.identification.estimates import Estimates
from jaximp.identification.robot_changes import NOT_ASKED, own_columns
from jaximp.jobs.job import WindowJob, parse_job
from jaximp.jobs.run import identify_recording, prepare
from jaximp.models import HumanJoint, RobotJoint
from jaximp.posterior import inference
from jaximp.recordings.load import recording_from_arrays
from jaximp.reports import estimates as report
from jaximp.types import Recording

TIME = np.arange(16000) * 1e-3
LINES = ((0.2, 1.1, 0.0), (0.1, 2.9, 0.5), (0.04, 6.3, 1.0))
ROBOT = {"viscous_friction": 0.4, "coulomb_friction": 1.0, "inertia": 0.05}
MODEL = "robot = { gravity = false }\nhuman = true\n"
TEXT = JOB.replace("human = true", MODEL) + "[robot_recording]\nfile = 'in the test'\n"


def recorded(seed: int, human: bool = True, motion: float = 1.0, **changes: float) -> Recording:
    """The robot with the human, or alone; every line of the `motion` so many times as large."""
    q, dq, ddq = sines(TIME, tuple((motion * a, f, p + (motion - 1) * k) for k, (a, f, p) in enumerate(LINES)))
    robot = ROBOT | changes
    torque = robot["viscous_friction"] * dq + robot["coulomb_friction"] * np.sign(dq) + robot["inertia"] * ddq
    if human:
        torque = torque + np.stack([ddq, dq, q, np.ones_like(q)], axis=1) @ np.array(list(TRUTH.values()))
    return recording_from_arrays(TIME, q, torque + np.random.default_rng(seed).normal(0, 0.2, len(TIME)))


def job(method: int = 1, drift: str = "") -> WindowJob:
    given = TEXT.replace("human = true\n", f"human = true\nmethods = [{method}]\n{drift}\n")
    found = parse_job(given)
    assert isinstance(found, WindowJob)
    return found


@cache
def usual(method: int) -> Estimates:
    return identify_recording(job(method), recorded(1), recorded(2, human=False))[0]


@pytest.mark.parametrize("method", [1, 3])
def test_a_robot_that_did_not_change_is_assumed_in_plain_words(method: int) -> None:
    assert usual(method).notes.count(NOT_ASKED) == 1
    assert usual(method).trusted.mean() > 0.9
    assert not any("not the same" in note for note in usual(method).notes)


@pytest.mark.parametrize("method", [1, 3])
def test_friction_that_only_the_robot_has_is_compared(method: int) -> None:
    """More Coulomb friction with the human than without: his damping would be wrong, his stiffness not."""
    found = identify_recording(job(method), recorded(1, coulomb_friction=1.6), recorded(2, human=False))[0]
    assert not found.trusted.any()
    assert "the robot is not the same in both recordings (p < 0.001): coulomb_friction by +" in found.lacking["damping"]
    assert "record the robot alone again" in found.verdicts.reason[0]
    off = found.mean_over_trusted()
    assert np.isnan(off[1])
    assert abs(off[2] / TRUTH["stiffness"] - 1) < 0.02
    added = np.mean(found.value[:, 1] - usual(method).value[:, 1])
    said = float(found.lacking["damping"].split("damping by ")[-1].split("%")[0]) / 100
    assert said == pytest.approx(-added / np.median(found.value[:, 1]), abs=0.03)


def test_a_small_change_that_does_not_matter_is_a_note() -> None:
    found = identify_recording(job(), recorded(1, coulomb_friction=1.05), recorded(2, human=False))[0]
    assert any("coulomb_friction by +" in note and "standard errors hold it" in note for note in found.notes)
    assert not any("not the same" in why for why in found.lacking.values())
    assert np.median(found.stderr[:, 1]) > np.median(usual(1).stderr[:, 1])
    low, high = found.interval()
    assert np.mean((low[:, 1] < TRUTH["damping"]) & (TRUTH["damping"] < high[:, 1])) > 0.9


@pytest.mark.parametrize("method", [1, 3, 4])
def test_a_second_recording_of_the_robot_tells_how_far_it_changed(method: int) -> None:
    """Viscous friction rises from 0.4 to 0.6, and is 0.5 with the human, which looks like his damping."""
    alone = recorded(2, human=False), recorded(3, human=False, viscous_friction=0.6)
    held = recorded(1, viscous_friction=0.5)
    found = identify_recording(job(method), held, alone)[0]
    assert any(
        "the robot changed from its recording before to that after (p < 0.001): viscous" in n for n in found.notes
    )
    assert NOT_ASKED not in found.notes
    assert found.robot is not None
    assert found.robot_change is not None
    assert float(found.robot.theta[0]) == pytest.approx(0.5, abs=0.01)
    assert found.robot_change[0] == pytest.approx(0.1, abs=0.01)
    added = found.stderr[:, 1] ** 2 - identify_recording(job(method), held, alone[0])[0].stderr[:, 1] ** 2
    np.testing.assert_allclose(np.median(added), found.robot_change[0] ** 2, rtol=0.2)
    assert abs(np.median(found.value[:, 1]) - TRUTH["damping"]) < 0.05


def test_a_robot_that_was_recorded_twice_and_agrees() -> None:
    found = identify_recording(job(), recorded(1), (recorded(2, human=False), recorded(3, human=False)))[0]
    assert any("the robot's recordings before and after agree" in note for note in found.notes)
    np.testing.assert_allclose(np.median(found.stderr, axis=0), np.median(usual(1).stderr, axis=0), rtol=0.1)


@pytest.mark.parametrize(("drift", "shares"), [("0.1", [0.1, 0.1]), ("{ inertia = 0.2 }", [0.2, 0.0])])
def test_a_stated_drift_is_among_the_errors(drift: str, shares: list[float]) -> None:
    found = identify_recording(job(1, f"robot_drift = {drift}"), recorded(1), recorded(2, human=False))[0]
    np.testing.assert_array_equal(found.value, usual(1).value)
    grown = np.median(found.stderr[:, :2] ** 2 - usual(1).stderr[:, :2] ** 2, axis=0)
    size = np.array([ROBOT["inertia"], ROBOT["viscous_friction"]])
    np.testing.assert_allclose(grown, (np.array(shares) * size) ** 2, rtol=0.05, atol=1e-12)
    assert any("inertia by" in note and "robot_drift" in note for note in found.notes)
    assert NOT_ASKED not in found.notes


def test_a_drift_of_nothing_is_an_answer() -> None:
    found = identify_recording(job(1, "robot_drift = 0"), recorded(1), recorded(2, human=False))[0]
    assert not any("robot_drift" in note for note in found.notes)
    np.testing.assert_array_equal(found.stderr, usual(1).stderr)


@pytest.mark.parametrize("motion", [1.02, 1.05])
def test_what_motions_differ_by_is_taken_off(motion: float) -> None:
    """At 2 % the damping would be 5 % off, and no interval would hold it."""
    found = identify_recording(job(3), recorded(1), recorded(2, human=False, motion=motion))[0]
    assert any("was taken off" in note for note in found.notes)
    truth, (low, high) = np.array(list(TRUTH.values())), found.interval()
    assert (np.mean((low < truth) & (truth < high), axis=0)[:3] > 0.85).all()
    np.testing.assert_allclose(np.median(found.value[:, :3], axis=0), truth[:3], rtol=0.01)


def test_another_motion_is_refused_by_method_3() -> None:
    found = identify_recording(job(3), recorded(1), recorded(2, human=False, motion=3.0))[0]
    assert not found.trusted.any()
    assert "repeat the motion, or use another method" in found.verdicts.reason[0]


def test_check_says_whether_the_robot_is_the_same() -> None:
    held, alone = recorded(1, coulomb_friction=1.2), recorded(2, human=False)
    pipeline = job().pipeline_for(held)
    (found,) = check._robot(pipeline, held, alone)
    assert (found.topic, found.verdict) == ("robot", "bad")
    assert "coulomb_friction by +" in found.text
    (found,) = check._robot(pipeline, recorded(1), alone)
    assert found.verdict == "look"
    assert NOT_ASKED in found.text
    (found,) = check._robot(pipeline, recorded(1), (alone, recorded(3, human=False)))
    assert found.verdict == "ok"
    assert "coulomb_friction agrees in both" in found.text
    (found,) = check._robot(pipeline, recorded(1), (alone, recorded(3, human=False, inertia=0.06)))
    assert found.verdict == "look"
    assert "inertia by +" in found.text


def test_saved_results_say_by_how_much_the_robot_may_have_changed() -> None:
    stated = job(1, "robot_drift = 0.1")
    found = identify_recording(stated, recorded(1), recorded(2, human=False))
    content = report.summary(found, stated, recorded(1))
    robot = content["robot"]
    assert robot["viscous_friction"]["may_change"] == pytest.approx(0.1 * robot["viscous_friction"]["value"])
    assert robot["coulomb_friction"]["may_change"] == 0
    (section,) = report._robot_alone(content)
    assert "May have changed by" in repr(section)


def test_a_posterior_of_a_robot_that_may_have_changed_is_wider() -> None:
    stated = job(1, "robot_drift = 0.1")
    prepared = prepare(stated, recorded(1), recorded(2, human=False))
    assert prepared.pair is not None
    prior = inference._prior(stated.posterior, prepared, prepared.pair.robot + prepared.model, 1)
    variance = np.diagonal(np.linalg.inv(prior.information()[:3, :3]))
    fit = prepared.pair.robot_fit
    expected = np.diagonal(fit.covariance) + (0.1 * np.asarray(fit.theta) * [1, 0, 1]) ** 2
    np.testing.assert_allclose(variance, expected, rtol=1e-6)


def test_columns_that_only_the_robot_has() -> None:
    robot = RobotJoint(offset=True)
    assert [robot.names[k] for k in own_columns(robot, HumanJoint())] == ["gravity_x", "gravity_y", "coulomb_friction"]
    assert "offset_torque" in [robot.names[k] for k in own_columns(robot, HumanJoint(offset=False))]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("human = true", "human = true\nrobot_drift = -0.1", "it is a share, such as 0.03"),
        ("human = true", "human = true\nrobot_drift = { inertia = 'x' }", "it must be a number"),
        ("human = true", "human = true\nrobot_drift = true", "it must be a number"),
        (MODEL, "human = true\nrobot_drift = 0.1\n", "only with both model.robot and model.human"),
        ("[robot_recording]", "[robot_recording_after]", "needs the recording of the robot alone"),
    ],
)
def test_what_cannot_be_is_named(old: str, new: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_job(TEXT.replace(old, new))


def test_a_parameter_that_the_robot_has_not_is_named() -> None:
    with pytest.raises(ValueError, match="did you mean 'inertia'"):
        identify_recording(job(1, "robot_drift = { inertias = 0.1 }"), recorded(1), recorded(2, human=False))


def test_a_job_reads_both_recordings_of_the_robot(tmp_path: Path) -> None:
    from jaximp.recordings.save import save_recording

    table = 'file = "{}.csv"\ntime = "time_s"\nposition = "position_rad"\ntorque = "torque_Nm"\n'
    names = {"recording": "held", "robot_recording": "before", "robot_recording_after": "after"}
    text = "".join(f"[{key}]\n{table.format(name)}" for key, name in names.items())
    for seed, name in enumerate(names.values()):
        save_recording(recorded(seed, human=name == "held"), tmp_path / f"{name}.csv")
    found = parse_job(text + TEXT.split("recording = {}")[1].split("[robot_recording]")[0], tmp_path)
    assert isinstance(found, WindowJob)
    assert [path.name for path in found.files()] == ["held.csv", "before.csv", "after.csv"]
    alone = found.load_robot_alone()
    assert isinstance(alone, tuple)
    assert [one.name for one in alone] == ["before", "after"]
