"""The look at the data before a run."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from factories.chains import RATE, chain_in, recording
from factories.joints import JOB, TIME, joint
from jaximp.identification import check as check_module
from jaximp.identification.check import BAD, LOOK, check_recording, coherent_bandwidth
from jaximp.identification.pipeline import Pipeline
from jaximp.jobs.job import parse_job
from jaximp.jobs.run import check, identify_recording
from jaximp.recordings.load import recording_from_arrays
from jaximp.trust.verdicts import NO_DATA, TRUSTED


@pytest.mark.slow
@pytest.mark.compiles
def test_a_clean_recording_is_found_clean_and_its_proposal_works() -> None:
    job, recording = parse_job(JOB), joint()
    findings, proposal = check(job, recording)
    verdicts = {finding.topic: finding.verdict for finding in findings}
    assert set(verdicts.values()) == {"ok"}, findings
    assert 6.3 < proposal.decimation_cutoff < proposal.position_cutoff < 500
    assert proposal.window is not None


@pytest.mark.slow
def test_a_wrong_sign_is_named_and_never_trusted() -> None:
    recording = joint()
    wrong = replace(recording, torque=-recording.torque)
    found = {finding.topic: finding for finding in check(parse_job(JOB), wrong)[0]}
    assert found["torque: sign"].verdict == BAD
    verdicts = identify_recording(parse_job(JOB), wrong)[0].verdicts
    assert not verdicts.trusted.any()
    assert "sign = -1" in verdicts.reason[10]


@pytest.mark.parametrize(
    ("time", "angle", "topic"), [(1000.0, 1.0, "sampling"), (1.0, 180 / np.pi, "position: range")], ids=["ms", "deg"]
)
def test_a_wrong_unit_is_noticed(time: float, angle: float, topic: str) -> None:
    recording = joint()
    wrong = recording_from_arrays(time * TIME, angle * recording.position[:, 0], recording.torque[:, 0])
    found = {finding.topic: finding for finding in check(parse_job(JOB), wrong)[0]}
    assert found[topic].verdict in (LOOK, BAD)
    assert found[topic].text.endswith("?") or found[topic].text.endswith("(ms?)")


def test_bandwidth_ends_where_the_motion_ends() -> None:
    assert 6.0 < coherent_bandwidth(joint()) < 20.0


@pytest.mark.slow
def test_what_a_recorder_spoilt_is_said() -> None:
    """Lost values that were written as zeros, and a slow encoder whose values are held."""
    recording = joint()
    torque = recording.torque[:, 0].copy()
    torque[150::199] = 9999.0
    held = np.repeat(recording.position[::5, 0], 5)[: len(torque)]
    found = {one.topic: one for one in check(parse_job(JOB), recording_from_arrays(TIME, held, torque))[0]}
    lost = len(torque[150::199])
    assert found["torque: glitches"].verdict == BAD
    assert found["torque: glitches"].text.startswith(f"{lost} samples stand out")
    assert f"first at {TIME[150]:.6g} s" in found["torque: glitches"].text
    assert "every 5 samples" in found["position: held samples"].text
    assert "torque: held samples" not in found


@pytest.mark.slow
def test_what_is_wrong_is_seen() -> None:
    recording = joint()
    clipped = np.clip(recording.torque, -4.0, None)
    coarse = np.round(recording.position / 0.01) * 0.01
    lost = next(k for k in range(4000, len(TIME)) if clipped[k - 20 : k + 20].min() > -3)
    coarse[lost:] += 0.5  # the encoder lost counts
    broken = recording_from_arrays(TIME, coarse, clipped)
    found = {finding.topic: finding for finding in check(parse_job(JOB), broken)[0]}
    assert found["torque: saturation"].verdict in (LOOK, BAD)
    assert "-4" in found["torque: saturation"].text
    assert found["position: saturation"].verdict == "ok"
    assert "step 0.01" in found["position: noise"].text
    assert f"the position jumps ({TIME[lost - 1]:.6g} s)" in found["gaps"].text


def test_a_robot_is_looked_at_as_one_window(tmp_path: Path) -> None:
    """As it is identified: no window is proposed, and nothing is predicted from windows that are too short."""
    chain = chain_in(tmp_path, offset=True)
    findings, proposal = check_recording(Pipeline(RATE, chain), recording(chain, 0))
    assert proposal.window is None
    assert "window" not in proposal.why
    found = {finding.topic: finding for finding in findings}
    assert "delay" not in found
    text = found["excitation"].text
    assert re.match(rf"the recording determines \d+ of {len(chain.names)} parameters, and leaves ", text)
    assert ("not determined: " in text) == (found["excitation"].verdict == LOOK)


def test_a_recording_without_data_is_said_to_have_none_without_a_warning(tmp_path: Path) -> None:
    """No window counts: there is nothing to take a mean of, and no library complains."""
    robot = recording(chain_in(tmp_path), 0)
    gaps = replace(robot, valid=np.arange(len(robot)) % 200 < 30)
    limit = np.arange(len(robot)) % 100 < 5
    cut_off = replace(robot, clipped=limit, valid=~limit)
    for own in (gaps, cut_off):
        found = {one.topic: one for one in check_recording(Pipeline(RATE, chain_in(tmp_path)), own)[0]}
        assert found["excitation"].verdict == BAD
        assert "nan" not in found["excitation"].text


@pytest.mark.parametrize("verdict", [NO_DATA, TRUSTED])
def test_windows_without_data_are_said_to_have_none_without_a_warning(
    verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor do windows that predict no other, as where a single one counts."""
    of_one = SimpleNamespace(verdict=np.array([verdict]), rule=np.array([""]))
    tried = SimpleNamespace(verdicts=of_one, held_out_vaf=np.array([np.nan]))
    monkeypatch.setattr(check_module, "_trial", lambda *args: tried)
    findings, proposal = check(parse_job(JOB), joint())
    found = {one.topic: one for one in findings}
    assert proposal.window is None
    assert found["excitation"].verdict == BAD
    assert "nan" not in found["excitation"].text
