"""`jaximp monitor`: what goes to which stream, what is kept, and how it ends."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import command_line
from factories.joints import joint
from factories.live import RATE, calibration
from jaximp.live.calibration import load_calibration, save_calibration
from jaximp.recordings.save import save_recording

JOB = """
[recording]
file = "joint.csv"
time = "time_s"
position = { column = "position_rad", unit = "rad" }
torque = { column = "torque_Nm", unit = "N m" }
[model]
human = { joint_name = "other" }
[filter]
position_cutoff = 25
decimation_cutoff = 15
[window]
length = 1.0
step = 0.1
"""


@pytest.fixture
def job(tmp_path: Path) -> Path:
    (tmp_path / "job.toml").write_text(JOB)
    save_recording(joint(np.arange(1600) / RATE), tmp_path / "joint.csv")
    save_calibration(calibration(), tmp_path / "calibration.npz")
    return tmp_path / "job.toml"


@pytest.fixture
def run(capfd: pytest.CaptureFixture[str]) -> Any:
    def program(*arguments: object) -> tuple[int, str, str]:
        status = command_line.jaximp("monitor", *arguments)
        said = capfd.readouterr()
        return status, said.out, said.err

    return program


def replay(job: Path, *more: object) -> tuple[object, ...]:
    return (job, "--speed", "inf", "--calibration", job.parent / "calibration.npz", *more)


def test_json_stands_alone_and_words_go_elsewhere(run: Any, job: Path) -> None:
    status, out, err = run(*replay(job, "--every", "0.5"))
    assert status == 0, err
    updates = [json.loads(line) for line in out.splitlines()]
    assert [one["verdict"] for one in updates[-3:]] == ["trusted"] * 3
    assert updates[-1]["parameters"]["stiffness"]["value"] == pytest.approx(20, rel=0.05)
    assert "1600 samples received, 1600 used" in err
    assert "an estimate is about the instant" in err


def test_words_for_people(run: Any, job: Path) -> None:
    status, out, _ = run(*replay(job, "--words", "--estimate", "window"))
    assert status == 0
    assert "stiffness" in out.splitlines()[-1]
    assert out.splitlines()[-1].endswith("trusted")
    assert "{" not in out


def test_what_is_kept_is_gone_on_from(run: Any, job: Path) -> None:
    kept, folder = job.parent / "kept.npz", job.parent / "log"
    assert run(*replay(job, "--save", kept, "--log", folder))[0] == 0
    assert load_calibration(kept).made_for == calibration().made_for
    (folder / "job.toml").read_text()
    status, out, err = run(folder / "job.toml", "--speed", "inf", "--calibration", kept, "--every", "0")
    assert status == 0, err
    # The clock was set back, to the begin of the recording: what was known before is still known.
    first = json.loads(out.splitlines()[0])
    assert first["parameters"]["stiffness"]["value"] == pytest.approx(20, rel=0.05)
    assert "1 jumps of its clock" in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "monitor needs a job: jaximp monitor JOB.toml, or --demo"),
        (["JOB", "--source", "radio"], "give replay, stdin, tcp:PORT"),
        (["JOB", "--source", "tcp:any"], "give PORT, or HOST:PORT"),
        (["JOB", "--source", "udp:0.0.0.0:0"], "give a token with --token"),
        (["JOB", "--calibration", "none.npz"], "there is no such calibration"),
        (["JOB", "--calibration", "JOB"], "this is no calibration of jaximp"),
        (["JOB", "--estimate", "guess"], "there are: 'track', 'window'"),
        (["JOB", "--every", "-1"], "give numbers above zero"),
        (["JOB", "--speed", "0"], "give a number above zero, or inf"),
    ],
    ids=lambda one: " ".join(one[-2:]) if isinstance(one, list) else "",
)
def test_bad_options_end_in_one_line(run: Any, job: Path, arguments: list[str], message: str) -> None:
    status, out, err = run(*(job if one == "JOB" else one for one in arguments))
    assert status == 1
    assert out == ""
    assert message in " ".join(err.split())
    assert len(err.splitlines()) <= 2


@pytest.mark.slow
@pytest.mark.compiles
def test_a_pipe_and_ctrl_c(job: Path) -> None:
    """A program of its own, whose input stays open until it is interrupted."""
    command = "from jaximp.cli.main import main; main()"
    arguments = [
        str(job),
        "--source",
        "stdin",
        "--sample-rate",
        "200",
        "--calibration",
        str(job.parent / "calibration.npz"),
    ]
    running = subprocess.Popen(
        [sys.executable, "-c", command, "monitor", *arguments, "--log", str(job.parent / "log")],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "JAX_ENABLE_X64": "1"},
    )  # fmt: skip
    assert running.stdin is not None
    assert running.stdout is not None
    running.stdin.write((job.parent / "joint.csv").read_text())
    running.stdin.flush()
    for line in running.stdout:
        if json.loads(line)["time"] > 7.5:
            break
    running.send_signal(signal.SIGINT)
    out, err = running.communicate(timeout=60)
    assert running.returncode == 0, err
    assert [json.loads(line)["verdict"] for line in out.splitlines()] in (
        [],
        ["trusted"],
        ["trusted"] * 2,
        ["trusted"] * 3,
        ["trusted"] * 4,
    )
    assert "1600 samples received, 1600 used" in err
    assert "Traceback" not in err
    assert len((job.parent / "log" / "samples-1.csv").read_text().splitlines()) == 1601
