"""Delays between channels: found with their errors, said right, and taken out where a job says so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from factories.joints import JOB, TIME, TRUTH, joint
from jaximp.identification import prepare
from jaximp.identification.check import LOOK
from jaximp.identification.delays import Delay, find_delay
from jaximp.jobs import parse_job
from jaximp.jobs.run import check, identify, identify_recording
from jaximp.types import Recording


def late(recording: Recording, seconds: float) -> Recording:
    """With a torque that comes so much later; the motion is periodic enough for its ends not to matter."""
    f = np.fft.rfftfreq(len(recording), TIME[1])
    turned = np.fft.rfft(recording.torque[:, 0]) * np.exp(-2j * np.pi * f * seconds)
    return replace(recording, torque=np.fft.irfft(turned, len(recording))[:, None])


@pytest.mark.parametrize("seconds", [-0.004, 0.0, 0.0005, 0.012])
def test_a_delay_is_found_within_its_error(seconds: float) -> None:
    pipeline = parse_job(JOB).pipeline(("revolute",), 1000.0)
    errors = []
    for seed in range(4):
        prepared = prepare(pipeline, late(joint(seed=seed), seconds))
        found = find_delay(pipeline, prepared.rows)
        assert 1e-6 < found.stderr < 5e-4
        errors.append((found.seconds - seconds) / found.stderr)
    assert np.sqrt(np.mean(np.square(errors))) < 2


def test_leads_and_lags_are_said_right() -> None:
    assert Delay(0.00231, 0.00005).in_words() == "lags the position by 2.31 ms (+-0.05)"
    assert Delay(-0.01, 0.0001).in_words() == "leads the position by 10 ms (+-0.1)"
    assert not Delay(0.001, 0.0005).certain
    assert not Delay(0.1, np.inf).certain


def test_identify_and_check_say_how_long_it_is() -> None:
    job, recording = parse_job(JOB), late(joint(), 0.008)
    estimates = identify_recording(job, recording)[0]
    assert not estimates.trusted_in("inertia").any()
    assert "a delay between torque and position" in estimates.lacking["inertia"]
    assert any("if what is missing is a delay, the torque lags the position by" in note for note in estimates.notes)
    finding = next(one for one in check(job, recording)[0] if one.topic == "delay")
    assert finding.verdict == LOOK
    assert "the torque lags the position by" in finding.text


JOB_WITH_FILE = JOB.replace(
    "recording = {}",
    """[recording]
file = "late.csv"
time = "t"
position = "q"
torque = { column = "tau", delay = DELAY }""",
)


@pytest.mark.parametrize("delay", ["0.008", '"estimate"'])
def test_a_job_takes_a_delay_out(tmp_path: Path, delay: str) -> None:
    recording = late(joint(), 0.008)
    table = {"t": TIME, "q": recording.position[:, 0], "tau": recording.torque[:, 0]}
    pd.DataFrame(table).to_csv(tmp_path / "late.csv", index=False)
    estimates = identify(parse_job(JOB_WITH_FILE.replace("DELAY", delay), tmp_path))[0]
    assert estimates.trusted.mean() > 0.9
    found = np.median(estimates.value, axis=0)
    np.testing.assert_allclose(found, list(TRUTH.values()), atol=3 * np.median(estimates.stderr, axis=0).max())
    said = "was recorded 8 ms late, as the mapping says" if delay == "0.008" else "as the model finds, and was moved"
    assert any(said in note for note in estimates.notes)


@pytest.mark.parametrize(
    ("entry", "problem"),
    [
        ('torque = { column = "tau", delay = "guess" }', "a number of seconds, or \"estimate\", not 'guess'"),
        ('position = { column = "q", delay = "estimate" }', "that of the torque behind the position"),
        ('torque = { column = "tau", delay = 100 }', "the delay of 100 s leaves no sample"),
        ('position = { column = "q", noise = -1 }', "noise must be the sensor's standard deviation"),
        ('torque = { column = "tau", noise = 1 }', "unknown key 'noise'"),
    ],
)
def test_what_makes_no_sense_is_refused(tmp_path: Path, entry: str, problem: str) -> None:
    recording = joint()
    table = {"t": TIME, "q": recording.position[:, 0], "tau": recording.torque[:, 0]}
    pd.DataFrame(table).to_csv(tmp_path / "late.csv", index=False)
    name = entry.split(" ")[0]
    lines = [
        entry if line.startswith(f"{name} =") else line for line in JOB_WITH_FILE.replace("DELAY", "0.0").splitlines()
    ]
    with pytest.raises(ValueError, match=problem):
        identify(parse_job("\n".join(lines), tmp_path))
