"""The job file: every key and value is checked, and the message says what to do."""

import re
from pathlib import Path

import pytest

from jaximp.jobs.job import parse_job, read_job
from jaximp.models import HumanJoint, Joints, PlanarArm, RobotJoint

GOOD = """
[recording]
file = "x.csv"
[model]
human = true
[window]
length = 2
"""


def test_a_small_job_has_defaults() -> None:
    job = parse_job(GOOD)
    assert job.window.length == 2.0
    assert job.filter.mode == "once"
    assert job.model.methods == (1,)
    robot, human = job.models(("revolute",))
    assert robot is None
    assert isinstance(human, HumanJoint)


def test_models_follow_the_joints() -> None:
    job = parse_job(GOOD.replace("human = true", "robot = { offset = true, gravity = false }"))
    robot, _ = job.models(("prismatic",))
    assert isinstance(robot, RobotJoint)
    assert robot.units[-1] == "N"
    both, _ = job.models(("revolute", "revolute"))
    assert isinstance(both, Joints)
    assert both.n_joints == 2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("length = 2", "lenght = 2", "unknown key 'lenght': did you mean 'length'"),
        ("length = 2", 'length = "2 s"', "window.length is '2 s': it must be a number"),
        ("length = 2", "length = 0", "window.length is 0.0: it must be a number above zero"),
        ("length = 2", "length = true", "must be a number"),
        ("length = 2", "length = inf", "window.length is inf: it must be a number above zero"),
        ("length = 2", "length = 2\nmin_velocity = nan", "min_velocity is nan: it must be zero or more"),
        ("[window]", "[trust]\nmin_vaf = 75\n[window]", "trust.min_vaf is 75.0: it is a share"),
        ('file = "x.csv"', 'file = "x.csv"\ngear_ratio = 15\n', "keep one of them"),
        ("human = true", "human = 3", "must be a table"),
        ("human = true", "humen = true", "did you mean 'human'"),
        ("human = true", "human = false", "is empty"),
        ("human = true", "human = true\nrobot = true", "add a [robot_recording] table"),
        ("human = true", "human = true\nmethods = [5]", "list some of 1, 2, 3 and 4"),
        ("human = true", "human = {gear_ratio = 0}", "gear_ratio is 0.0: it must be a positive number"),
        ("[window]", "[trust]\nmin_vaf = 'x'\n[window]", "trust.min_vaf"),
        ("[window]", "[trust]\nparameters = 'x'\n[window]", "must be a list of names"),
        ("[window]", "[filter]\nmode = 'twice'\n[window]", "filter.mode is 'twice'"),
        ("[window]", "[filter]\ndecimate = 2.5\n[window]", "filter.decimate is 2.5: it must be a whole number"),
        ("[window]", "[filter]\nhigh_pass = 1\n[window]", "set offset = false"),
        ("[window]", "[robot_recording]\nfile='y'\n[window]", "of use only with both"),
        ("[recording]", "[recordings]", "unknown key 'recordings': did you mean 'recording'"),
        ("[model]\nhuman = true", "", "has no [model] table"),
        ('[recording]\nfile = "x.csv"', "recording = 3", "must be a table"),
    ],
)
def test_what_is_wrong_is_named(old: str, new: str, message: str) -> None:
    job = GOOD.replace(old, new, 1)
    if "keep one" in message:
        job = job.replace("human = true", "human = { gear_ratio = 15 }")
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        parse_job(job).models(("revolute",))
    assert "\n" not in str(caught.value)


def test_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="there is no such job file"):
        read_job(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("= 3")
    with pytest.raises(ValueError, match="not a TOML file"):
        read_job(tmp_path / "bad.toml")


ARM = GOOD.replace("human = true", "[model.arm]\n")


def arm_of(keys: str) -> PlanarArm:
    model, none = parse_job(ARM.replace("[model.arm]\n", f"[model.arm]\n{keys}\n")).models(("revolute", "revolute"))
    assert isinstance(model, PlanarArm)
    assert none is None
    return model


def test_an_arm_has_one_table_of_keys() -> None:
    """The same as beside [trials], for which see test_trials_job.py; each kind of job says which are not its."""
    assert arm_of("") == PlanarArm(impedance=False)
    assert arm_of("equilibrium = [0.1, 1.0]\ninertia = false") == PlanarArm((0.1, 1.0), inertia=False)
    tied = PlanarArm(impedance=False, gravity=True, length=0.3)
    for lengths in ("lengths = [0.3, 0.25]", "lengths = [0.3]", "length = 0.3"):
        assert arm_of(f"gravity = true\n{lengths}") == tied


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("lengths = [0.3, 0.25]", "model.arm.lengths tie inertia to gravity"),
        ("gravity = true\nlengths = [-0.3]", "length is -0.3: it must be metres, above zero"),
        ("gravity = true\nlengths = []", "lengths is []: give that of the upper arm"),
        ("shoulder = [0.0, 0.0]", "model.arm.shoulder is for [trials] of the hand: leave it out"),
        ("elbow = 'left'", "model.arm.elbow is for [trials] of the hand: leave it out"),
        (
            "inertia = { upper_arm = 0.2, forearm = 0.07, coupling = 0.08 }",
            "model.arm.inertia is known beside [trials]",
        ),
        ("inertia = [0.2, 0.07, 0.08]", "numbers alone do not say which is which"),
        ("inertia = 1", "model.arm.inertia is 1: it must be true or false or a table"),
        ("gravty = true", "[model.arm] has an unknown key 'gravty': did you mean 'gravity'"),
    ],
)
def test_what_is_wrong_with_an_arm_is_named(keys: str, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        arm_of(keys)
