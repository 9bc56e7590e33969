"""From a design's job file to files that controllers, ROS and `identify` read."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from jaximp import identify_recording, parse_job, recording_from_arrays
from jaximp.cli.main import app
from jaximp.design.files import read_trajectory
from jaximp.jobs.design import parse_design_job, read_design_job
from jaximp.trust.criteria import fake_change_threshold

JOB = """
[model]
robot = { gear_ratio = 15 }
[parameters]
gravity_x = 1.518e-3
gravity_y = 0
viscous_friction = 1.45e-4
coulomb_friction = 2.479e-3
inertia = 1.9e-5
[limits]
position = [-10.5, 10.5]
velocity = 12
torque = 0.02
[design]
harmonics = 4
starts = 4
sample_rate = 250
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    base = tmp_path_factory.mktemp("design")
    (base / "job.toml").write_text(JOB)
    result = CliRunner().invoke(app, ["design", str(base / "job.toml"), "--out", str(base / "out")])
    assert result.exit_code == 0, result.output
    assert "condition number over a period of 10 s" in result.output
    assert "limits reached" in result.output
    return base / "out"


def test_files_hold_the_same_motion(folder: Path) -> None:
    series = read_trajectory(folder / "trajectory.json")
    header, *lines = (folder / "trajectory.csv").read_text().splitlines()
    rows = np.array(list(csv.reader(lines)), float)
    assert header == "time_s,position_rad,velocity_rad_s,acceleration_rad_s2,torque_Nm"
    time = np.arange(2500) / 250
    expected = np.stack([time, *(np.asarray(x) for x in series(time))], axis=1)
    np.testing.assert_allclose(rows[:, :4], expected, rtol=1e-10, atol=1e-10)
    assert np.abs(rows[:, 4]).max() <= 0.02
    table = json.loads((folder / "trajectory.json").read_text())
    np.testing.assert_allclose(np.array(table["velocity"])[:, 0], rows[:, 2], atol=1e-10)
    ros = yaml.safe_load((folder / "trajectory.yaml").read_text())
    assert ros["joint_names"] == ["joint1"]
    assert len(ros["points"]) == 2500
    point = ros["points"][251]
    assert point["time_from_start"] == {"sec": 1, "nanosec": 4_000_000}
    np.testing.assert_allclose([point["positions"][0], point["effort"][0]], rows[251, [1, 4]], atol=1e-10)
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["lower_bound"] is None
    assert summary["limits"]["jerk"] is None
    assert (folder / "trajectory.png").stat().st_size > 10_000


@pytest.mark.slow
def test_identify_takes_the_design_as_its_reference(folder: Path) -> None:
    series, rate = read_trajectory(folder / "trajectory.json"), 100.0
    time = np.arange(1500) / rate
    q, dq, ddq = (np.asarray(x) for x in series(time))
    recording = recording_from_arrays(time, q, 0.1 * ddq + dq + 5 * q + 0.01 * np.sin(40 * time))
    text = f"""
        recording = {{}}
        design = "{(folder / "trajectory.json").as_posix()}"
        [model]
        human = {{ offset = false }}
        [window]
        length = 2.0
    """
    threshold = identify_recording(parse_job(text), recording)[0].threshold
    W = np.stack([ddq, dq, q], axis=1)[:1000]
    assert threshold == pytest.approx(float(fake_change_threshold(W, 1000, 200)), rel=1e-6)
    with pytest.raises(ValueError, match="keep one of them"):
        parse_job(text.replace("[model]", "reference_period = 10\n[model]", 1))
    with pytest.raises(ValueError, match=r"no such file; give the trajectory\.json"):
        identify_recording(parse_job(text.replace("trajectory.json", "lost.json")), recording)


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"format": "jaximp trajectory, version 1"}'])
def test_what_is_no_design_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "other.json").write_text(text)
    with pytest.raises(ValueError, match="not a trajectory that jaximp designed"):
        read_trajectory(tmp_path / "other.json")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[model]", "[modl]", "did you mean 'model'"),
        ("robot = { gear_ratio = 15 }", "", "is empty"),
        ("harmonics = 4", "harmonic = 4", "did you mean 'harmonics'"),
        ("harmonics = 4", 'harmonics = "4"', "design.harmonics is '4': it must be a whole number"),
        ("harmonics = 4", 'method = "bgfs"', "did you mean 'bfgs'"),
        ("[-10.5, 10.5]", "10.5", "write .lowest, highest."),
        ("velocity = 12", 'velocity = "fast"', "limits.velocity is 'fast': it must be a number"),
        ("inertia = 1.9e-5\n", "", "has no 'inertia'"),
        ("inertia = 1.9e-5", "mass = 1", "unknown key 'mass'"),
    ],
)
def test_a_wrong_job_names_the_key(old: str, new: str, message: str) -> None:
    assert old in JOB
    with pytest.raises(ValueError, match=message):
        parse_design_job(JOB.replace(old, new)).run()


def test_a_missing_job_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="there is no such job file"):
        read_design_job(tmp_path / "none.toml")


@pytest.mark.slow
def test_the_human_in_a_known_robot() -> None:
    text = JOB.replace(
        "robot = { gear_ratio = 15 }", "robot = { gear_ratio = 15 }\nhuman = { gear_ratio = 15, offset = false }"
    )
    text = text.replace("viscous_friction = ", '"robot.viscous_friction+human.damping" = ')
    text = text.replace("inertia = 1.9e-5", '"robot.inertia+human.inertia" = 1.9e-5\n"human.stiffness" = 1e-3')
    for name in ("gravity_x", "gravity_y", "coulomb_friction"):
        text = text.replace(f"{name} = ", f'"robot.{name}" = ')
    text = text.replace("velocity = 12", "").replace("torque = 0.02", "torque = 0.012")
    design = parse_design_job(text + 'identify = "human"').run()
    assert design.model.names == ("inertia", "damping", "stiffness")
    assert 0.99 * 0.012 < np.abs(design.sampled(2400)["torque"]).max() < 0.012 * (1 + 1e-4)
    with pytest.raises(ValueError, match="identify"):
        parse_design_job(JOB + 'identify = "human"')


@pytest.mark.parametrize(
    ("position", "found"),
    [
        ("[-0.3, 0.5]", (-0.3, 0.5)),
        ("{ low = [-0.3, 0.1], high = [0.3, 1.5] }", ((-0.3, 0.1), (0.3, 1.5))),
        ("[[-0.3, 0.3], [0.1, 1.5]]", None),
        ("{ low = -0.3 }", None),
    ],
    ids=["all joints", "each joint", "ambiguous", "one end"],
)
def test_limits_of_several_joints_say_which_end_they_are(position: str, found: object) -> None:
    text = f"[model]\nhuman = true\n[limits]\nposition = {position}"
    if found is None:
        with pytest.raises(ValueError, match="low = "):
            parse_design_job(text)
    else:
        assert parse_design_job(text).limits.position == found
