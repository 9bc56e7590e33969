"""The look at the data before a run."""

from dataclasses import replace

import numpy as np
import pytest

from factories.joints import JOB, TIME, joint
from jaximp.identification.check import BAD, LOOK, coherent_bandwidth
from jaximp.jobs.job import parse_job
from jaximp.jobs.run import check, identify_recording
from jaximp.recordings.load import recording_from_arrays


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
