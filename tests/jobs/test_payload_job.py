"""Jobs that weigh a load, or find gains by a load that is known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from command_line import jaximp
from factories.chains import chain_in, with_load
from jaximp.batch.plan import of_recordings
from jaximp.identification import DriveGains, Payload
from jaximp.jobs import WindowJob, parse_job
from jaximp.jobs.run import weigh
from jaximp.models.spatial import about
from jaximp.reports.payload import write_load

LOAD = about(0.7, np.array([0.03, 0.02, 0.08]), np.diag([2e-3, 3e-3, 1e-3]))
GAINS = np.array([8.0, 3.0])
COLUMNS = "time = 1\nposition = [2, 3]\ntorque = { columns = [4, 5], gain = [8, 3], gain_error = { common = 10 } }\n"
JOB = f"""
[recording]
file = ["with_a.csv", "with_b.csv"]
{COLUMNS}
[robot_recording]
file = "without.csv"
{COLUMNS}
[model.robot]
urdf = "two_joints.urdf"
friction = true
[filter]
position_cutoff = 8.0
decimation_cutoff = 4.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("payload")
    chain = chain_in(found)
    runs = {"without": (50, None), "with_a": (51, LOAD), "with_b": (52, LOAD)}
    for name, (seed, load) in runs.items():
        run = with_load(chain, seed, load, gain=GAINS)
        np.savetxt(found / f"{name}.csv", np.column_stack([run.time, run.position, run.torque]), delimiter=",")
    return found


def job_of(more: str, folder: Path) -> WindowJob:
    job = parse_job(JOB + more, folder)
    assert isinstance(job, WindowJob)
    return job


def test_a_job_weighs_its_load(folder: Path, tmp_path: Path) -> None:
    found = weigh(job_of("[payload]\nmethod = 1\n", folder))
    assert isinstance(found, Payload)
    assert found.method == 1
    assert abs(found.mass.value - 0.7) < 4 * found.mass.stderr
    assert found.gain_stderr[0] == pytest.approx(0.1 * found.mass.value, rel=1e-6)
    write_load(tmp_path, found)
    content = json.loads((tmp_path / "payload.json").read_text())
    assert content["parameters"]["load.mass"]["value"] == pytest.approx(found.mass.value)
    assert content["parameters"]["load.centre_y"]["value"] is None
    assert content["determined"]["load.mass"] is bool(found.determined[0])
    assert content["words"] == found.in_words()


def test_a_job_finds_gains_by_a_known_load(folder: Path, tmp_path: Path) -> None:
    """What was made torques by nominal gains is off by one."""
    found = weigh(job_of("[payload]\nmass = 0.7\nmass_error = 0.001\n", folder))
    assert isinstance(found, DriveGains)
    assert (np.abs(found.theta - 1) < 4 * found.stderr).all()
    write_load(tmp_path, found)
    content = json.loads((tmp_path / "gains.json").read_text())
    assert content["gain_error_percent"]["common"] == pytest.approx(found.gain_error["common"])
    assert content["words"][-2].startswith("gain = [")
    assert content["words"][-1].startswith("gain_error = { common = ")


def test_a_job_without_a_payload_weighs_nothing(folder: Path) -> None:
    text = JOB.replace("[robot_recording]", "[held_out]")
    job = parse_job(text, folder)
    assert isinstance(job, WindowJob)
    assert weigh(job) is None


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("[payload]\nmethod = 5\n", "payload.method is 5"),
        ("[payload]\nmehtod = 1\n", "did you mean 'method'"),
        ("[payload]\ncentre = [0.0, 0.0, 0.1]\n", "payload.centre is of use only with a payload.mass"),
        ("[payload]\nmethod = 1\nmass = 0.7\n", "payload.method is of no use with a payload.mass"),
        ("", "robot_recording.* is of use only with .* or with .payload"),
    ],
)
def test_keys_are_checked(more: str, message: str, folder: Path) -> None:
    with pytest.raises(ValueError, match=message):
        parse_job(JOB + more, folder)


def test_a_payload_needs_a_robot_and_its_recording(folder: Path) -> None:
    with pytest.raises(ValueError, match="needs a robot with a urdf"):
        parse_job(JOB.replace("[robot_recording]", "[held_out]") + "[payload]\n", folder)
    with pytest.raises(ValueError, match="one pair of recordings"):
        of_recordings(job_of("[payload]\n", folder))


@pytest.mark.slow  # compiles the programs of two lengths, and draws a report
def test_the_command_line_says_what_the_load_is(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "job.toml").write_text(JOB + "[payload]\n", encoding="utf-8")
    out = folder / "out"
    assert jaximp("identify", folder / "job.toml", "--out", out) == 0
    said = capsys.readouterr().out
    assert "mass 0." in said
    assert "centre of mass in the frame of fore: x" in said
    assert (out / "payload.json").is_file()
    assert (out / "report.html").is_file()
