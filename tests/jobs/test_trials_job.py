"""The job file of trials: every key and value is checked, and the message says what to do."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from jaximp.jobs.job import Job, TrialsJob, parse_job

JOB = """
[trials]
file = "t.parquet"
time = "time_s"
position = ["x", "y"]
torque = ["fx", "fy"]
command = ["px", "py"]
[model.arm]
lengths = [0.29, 0.34]
"""


def test_a_job_of_trials_has_defaults() -> None:
    job = parse_job(JOB)
    assert isinstance(job, TrialsJob)
    assert (job.trials.task, job.trials.window) == ("movement", 0.115)
    assert job.trials.handle is None
    assert job.arm.geometry().lengths == (0.29, 0.34)
    with pytest.raises(ValueError, match=r"this job has .trials. and no .recording."):
        job.load()


def test_a_job_of_trials_has_settings() -> None:
    text = JOB.replace("[model.arm]", "trigger = { axis = 2, position = 0.4 }\ncutoff = [2, 30]\nonset = [0.5, nan]\n"
                       "method = 'gomi_kawato'\n[trials.handle]\nmass = [4, 6]\ndamping = [20, 20]\n"
                       "[model.arm]\nshoulder = [0.1, -0.2]\n"
                       "inertia = { upper_arm = 0.2, forearm = 0.07, coupling = 0.08 }\n"
                       "inertia_stderr = { upper_arm = 0.01, forearm = 0.02, coupling = 0.03 }")  # fmt: skip
    job = parse_job(text)
    assert isinstance(job, TrialsJob)
    trials, arm = job.trials, job.arm
    assert trials.handle is not None
    assert (trials.cutoff, trials.handle.mass, trials.method) == ([2.0, 30.0], [4.0, 6.0], "gomi_kawato")
    assert trials.trigger is not None
    assert (trials.trigger.axis, trials.trigger.position) == (2, 0.4)
    assert arm.geometry().shoulder == (0.1, -0.2)
    assert arm.known_inertia is not None
    assert arm.known_stderr is not None
    np.testing.assert_allclose(arm.known_inertia.borner, [0.2, 0.07, 0.08])
    np.testing.assert_allclose(arm.known_stderr.borner, [0.01, 0.02, 0.03])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('file = "t.parquet"', "", "needs either 'files' (one a trial) or 'file'"),
        ('file = "t.parquet"', 'file = "a"\nfiles = "b"', "one of the two"),
        ('file = "t.parquet"', 'files = "b"\ntrial = "n"', "leave it out beside 'files'"),
        ('file = "t.parquet"', "files = 3", "trials.files is 3: it must be text or a list of text"),
        ('file = "t.parquet"', "files = []", "needs either 'files'"),
        ("torque", "force", "calls the force on the hand 'torque'"),
        ("torque", "torgue", "unknown key 'torgue': did you mean 'torque'"),
        ("[trials]", "[trial]", "unknown key 'trial': did you mean 'trials'"),
        ("[trials]", "[trials]\ntask = 'movment'", "trials.task is 'movment': did you mean 'movement'"),
        ("[trials]", "[trials]\nwindow = 115", "were milliseconds meant?"),
        ("[trials]", "[trials]\nwindow = -1", "trials.window is -1.0: it must be a number above zero"),
        ("[trials]", "[trials]\ncutoff = 2", "trials.cutoff is 2: it must be a list of numbers"),
        ("[trials]", "[trials]\ncutoff = [2, 3, 4]", "trials.cutoff is [2.0, 3.0, 4.0]: it must be two numbers"),
        ("[trials]", "[trials]\nonset = 'x'", "trials.onset is 'x': it must be a number or a list of numbers"),
        ("[trials]", "[trials]\njoint = 'revolute'", "unknown key 'joint'"),
        ("[trials]", "[trials]\nmapping = {}", "unknown key 'mapping'"),
        (
            "[trials]",
            "[trials]\nhandle = { mas = [1, 2] }",
            "[trials.handle] has an unknown key 'mas': did you mean 'mass'",
        ),
        (
            "[trials]",
            "[trials]\nhandle = { mass = [1], damping = [1, 2] }",
            "trials.handle.mass is [1.0]: it must be two numbers",
        ),
        (
            "[trials]",
            "[trials]\nhandle = { mass = [1, 1], damping = [1, 2], own_mass = -1 }",
            "trials.handle.own_mass is -1.0",
        ),
        ("[trials]", "[trials]\nhandle = { mass = [1, 1] }", "[trials.handle] has no 'damping': add it"),
        ("[trials]", "[trials]\nhandle = 3", "trials.handle is 3: it must be a table"),
        ("[trials]", "[trials]\ntrigger = { axis = 3, position = 0 }", "trials.trigger.axis is 3: it must be 1 or 2"),
        ("[trials]", "[trials]\ntrigger = { axis = 2 }", "[trials.trigger] has no 'position'"),
        ("lengths = [0.29, 0.34]", "length = 0.29", "lengths is [0.29]: it must be two finite numbers"),
        ("lengths = [0.29, 0.34]", "lenths = [0.29, 0.34]", "unknown key 'lenths': did you mean 'lengths'"),
        ("lengths = [0.29, 0.34]", "lengths = [0.29, -1]", "lengths is"),
        ("lengths = [0.29, 0.34]", "", "[model.arm] has no 'lengths'"),
        ("[model.arm]", "[model.arm]\ninertia = [1, 2]", "numbers alone do not say which is which: write inertia = {"),
        (
            "[model.arm]",
            "[model.arm]\ninertia = [0.19, 0.07, 0.08]",
            "write inertia = { upper_arm = 0.19, forearm = 0.07, coupling = 0.08 }, if they are I_1 + m_2 l1^2, I_2, "
            "m_2 c_2 l1 in kg m^2",
        ),
        ("[model.arm]", "[model.arm]\ninertia_stderr = [1, 2, 3]", "write inertia_stderr = { upper_arm = 1,"),
        (
            "[model.arm]",
            "[model.arm]\ninertia_stderr = { upper_arm = 1, forearm = 1, coupling = 1 }",
            "needs model.arm.inertia",
        ),
        (
            "[model.arm]",
            "[model.arm]\ninertia = { upper_arm = 1, forearm = 1, coupling = 0 }",
            "'coupling': 0.0}: all must be numbers above zero",
        ),
        (
            "[model.arm]",
            "[model.arm]\ninertia = { upper_arm = 1, forearm = 1 }",
            "[model.arm.inertia] has no 'coupling': add it",
        ),
        ("[model.arm]", "[model.arm]\ninertia = true", "here write what it is, inertia = { upper_arm"),
        ("[model.arm]", "[model.arm]\ngravity = true", "model.arm.gravity is for a [recording] of the joints"),
        ("[model.arm]", "[model.arm]\nlength = 0.3", "model.arm.length and model.arm.lengths both stand there"),
        ("[model.arm]\nlengths = [0.29, 0.34]", "[model]\nhuman = true", "add [model.arm] with its lengths"),
        ("[model.arm]", "[model]\nhuman = true\n[model.arm]", "unknown key 'human'"),
        ("[trials]", "[window]\nlength = 1\n[trials]", "leave out 'window'"),
        ("[trials]", "[recording]\n[trials]", "leave out 'recording'"),
        ("[trials]", "[trust]\nmin_vaf = 75\n[trials]", "trust.min_vaf is 75.0: it is a share"),
    ],
)
def test_what_is_wrong_in_a_job_is_named(old: str, new: str, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        parse_job(JOB.replace(old, new, 1))
    assert "\n" not in str(caught.value)


def test_files_that_are_not_there_are_named(tmp_path: Path) -> None:
    def job(files: str) -> Job:
        return parse_job(JOB.replace('file = "t.parquet"', f'files = "{files}"'), tmp_path)

    (tmp_path / "empty").mkdir()
    for files, message in {"*.csv": "no file matches", "empty": "has no file of a known kind"}.items():
        with pytest.raises(ValueError, match=message):
            job(files).files()
    missing = job("none.csv")
    assert isinstance(missing, TrialsJob)
    with pytest.raises(FileNotFoundError, match="there is no such file"):
        missing.trials.load()
