"""Posteriors of jobs: against the truth of simulated joints, and what is said where they must not be believed."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_identify import JOB, TIME, TRUTH, joint

from jaximp import cli
from jaximp.inference import Inference, compare_models, infer_recording, sentences
from jaximp.job import parse_job
from jaximp.posterior_files import load_posterior
from jaximp.recordings import save_recording
from jaximp.types import Recording


@pytest.fixture(scope="module")
def found() -> Inference:
    return infer_recording(parse_job(JOB), joint())


def stiffening() -> Recording:
    """A joint that is half as stiff again in the second half of the record."""
    recording, soft = joint(), TRUTH["stiffness"]
    harder = np.where(TIME[len(TIME) // 2] < TIME, 0.5 * soft, 0.0)[:, None]
    return replace(recording, torque=recording.torque + harder * recording.position)


def test_the_truth_is_within_the_draws(found: Inference) -> None:
    assert found.whole.names == (*TRUTH, "log_noise")
    assert found.whole.ok
    assert found.why == ""
    z = (found.whole.mean[:4] - list(TRUTH.values())) / found.whole.samples.std(axis=0)[:4]
    assert np.abs(z).max() < 4
    assert np.exp(found.whole.mean[4]) < 0.2
    assert found.windows is not None
    assert found.windows.ok.sum() >= 6
    assert (np.diff(found.start) >= 0.99).all()
    # A window tells less than the record: with an eighth of the rows by the root of eight.
    k = list(TRUTH).index("stiffness")
    wider = found.windows.samples[..., k].std(axis=1) / found.whole.samples[:, k].std()
    assert 2 < np.median(wider) < 4


def test_torque_lies_within_its_band(found: Inference) -> None:
    assert 0.9 < found.inside < 0.99
    assert found.score is not None
    assert found.whiteness[0].p > 1e-3


def test_without_a_change_its_probability_is_near_one_half(found: Inference) -> None:
    of_stiffness = [one.probability for one in found.changes if one.parameter == "stiffness"]
    assert len(of_stiffness) >= 5
    assert 0.2 < np.mean(of_stiffness) < 0.8
    assert max(of_stiffness) < 0.999


def test_windows_that_contradict_each_other_are_said() -> None:
    found = infer_recording(parse_job(JOB), stiffening())
    assert "the windows contradict each other in stiffness" in found.why
    steps = {one.windows: one.probability for one in found.changes if one.parameter == "stiffness"}
    assert max(steps, key=lambda windows: steps[windows]) == (3, 4)
    assert steps[3, 4] > 0.95


def test_a_prior_pulls_by_its_weight() -> None:
    job = parse_job(JOB + "[posterior.prior]\nstiffness = { mean = 25, sd = 0.01 }\n")
    pulled = infer_recording(job, joint()).whole
    assert abs(pulled["stiffness"].mean() - 25) < 0.1
    assert pulled.sampler.startswith("emcee")


def test_noise_of_the_position_is_corrected_for() -> None:
    recording = joint()
    noise = np.random.default_rng(1).normal(0, 1e-3, recording.position.shape)
    found = infer_recording(parse_job(JOB), replace(recording, position=recording.position + noise))
    assert found.bias[0] < -0.25
    assert found.why == ""
    z = (found.whole.mean[:4] - list(TRUTH.values())) / found.whole.samples.std(axis=0)[:4]
    assert np.abs(z).max() < 4
    assert found.whole.samples[:, 0].std() < 1e-3


def test_a_model_that_lacks_something_predicts_worse(found: Inference) -> None:
    without = infer_recording(parse_job(JOB.replace("human = true", "human = { offset = false }")), joint())
    difference, error = compare_models(found, without)
    assert difference > 5 * error > 0
    assert compare_models(without, found)[0] == pytest.approx(-difference)
    assert compare_models(found, found) == (0, 0)
    other = infer_recording(parse_job(JOB.replace("cutoff = 20", "cutoff = 10")), joint())
    with pytest.raises(ValueError, match="through the same filters"):
        compare_models(found, other)


def test_draws_of_windows_that_cannot_be_trusted_are_not_believed() -> None:
    """A torque of which the model explains little has a posterior all the same."""
    recording = joint()
    drift = 8 * np.cumsum(np.random.default_rng(2).normal(0, 0.1, len(TIME)))[:, None]
    found = infer_recording(parse_job(JOB), replace(recording, torque=recording.torque + drift))
    assert not found.good.all()
    assert not {window for one in found.changes for window in one.windows} & set(np.flatnonzero(~found.good))
    nothing = replace(recording, torque=5 * np.sin(2 * np.pi * 4.3 * TIME)[:, None] + 0.1 * recording.torque)
    assert "no window can be trusted" in infer_recording(parse_job(JOB), nothing).why


def test_windows_without_samples_are_left_out() -> None:
    recording = joint()
    valid = (TIME < 2.5) | (TIME > 4.5)
    position, torque = (np.where(valid[:, None], x, np.nan) for x in (recording.position, recording.torque))
    found = infer_recording(parse_job(JOB), replace(recording, position=position, torque=torque, valid=valid))
    assert found.why == ""
    assert [line for line in found.left_out if line.startswith("3 s: 0 independent rows")]
    assert 3 not in found.start


def test_joints_side_by_side_with_heavy_tails() -> None:
    soft, stiff = joint(), joint(stiffness=35.0)
    outliers = np.random.default_rng(3).random(stiff.torque.shape) < 0.005
    both = Recording(
        time=soft.time,
        position=np.hstack([soft.position, stiff.position]),
        torque=np.hstack([soft.torque, np.where(outliers, 20.0, stiff.torque)]),
        valid=soft.valid,
        joints=("revolute", "revolute"),
    )
    found = infer_recording(parse_job(JOB + "[posterior]\nheavy_tails = true\ness = 400\n"), both)
    assert found.whole.ok
    assert found.windows is not None
    assert found.whole.names[:2] == ("joint1.inertia", "joint1.damping")
    for name, truth in (("joint1.stiffness", 20.0), ("joint2.stiffness", 35.0)):
        assert abs(found.whole[name].mean() - truth) < 4 * found.whole[name].std()
    assert found.bands.shape == (5, *found.torque.shape)
    assert found.torque.shape[1] == 2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[window]", "mode = 'window'\n[window]", "set filter.mode = 'once'"),
        ("[window]", "[posterior.prior]\nstifness = { mean = 1, sd = 1 }\n[window]", "did you mean 'stiffness'"),
        ("[window]", "[posterior.prior]\nstiffness = { mean = 1, sd = 0 }\n[window]", "sd must be above zero"),
        ("[window]", "[posterior.prior]\nstiffness = { mean = 1 }\n[window]", "has no 'sd': add it"),
        ("[window]", "[posterior.prior]\nstiffness = 3\n[window]", "must be a table"),
        ("[window]", "[posterior]\ness = 10\n[window]", "ask for 400 to 1e6"),
        ("[window]", "[posterior]\nsteps = 10\n[window]", "unknown key 'steps'"),
    ],
)
def test_what_cannot_be_is_named(old: str, new: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        infer_recording(parse_job(JOB.replace(old, new, 1)), joint())


def test_sentences_are_for_a_paper(found: Inference) -> None:
    (line,) = sentences(found.whole, ["stiffness"])
    assert line.startswith("stiffness 20")
    assert "N m/rad (95 % credible interval 19." in line or "N m/rad (95 % credible interval 20." in line


def test_the_command_writes_draws_and_a_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    save_recording(stiffening(), tmp_path / "<b>.csv")
    columns = "time = 'time_s'\nposition = 'position_rad'\ntorque = 'torque_Nm'\n"
    text = JOB.replace("recording = {}", f"[recording]\nfile = '<b>.csv'\n{columns}")
    (tmp_path / "job.toml").write_text(text)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "")
    monkeypatch.setattr(
        sys, "argv", ["jaximp", "posterior", str(tmp_path / "job.toml"), "--out", str(tmp_path / "out")]
    )
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code in (0, None)
    names = {path.name for path in (tmp_path / "out").iterdir()}
    figures = {"corner.png", "torque.png", "bands.png"}
    assert names == {"posterior.nc", "windows.nc", "summary.json", "report.html", ".jaximp"} | figures
    assert "not to be trusted: the windows contradict each other" in capsys.readouterr().out
    drawn, content = (
        load_posterior(tmp_path / "out" / "posterior.nc"),
        json.loads((tmp_path / "out/summary.json").read_text()),
    )
    assert drawn.names == (*TRUTH, "log_noise")
    by_name = {row["name"]: row for row in content["parameters"]}
    assert by_name["stiffness"]["50%"] == pytest.approx(np.median(drawn["stiffness"]))
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "What is behind these draws cannot be trusted" in page
    assert "&lt;b&gt;.csv" in page
    assert "For a paper" not in page
