"""Posteriors of jobs: against the truth of simulated joints, and what is said where they must not be believed."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2
from scipy.stats import t as student

from command_line import jaximp
from factories.joints import JOB, TIME, TRUTH, joint
from jaximp.identification.prepared import prepare
from jaximp.jobs.job import parse_job
from jaximp.jobs.run import infer_recording
from jaximp.models import HumanJoint, Joints, Model, ReflexPathway, RobotJoint
from jaximp.posterior import inference
from jaximp.posterior.draws import Posterior, make_posterior, stacked
from jaximp.posterior.files import load_posterior
from jaximp.posterior.inference import Inference, compare_models, sentences
from jaximp.posterior.predictive import PriorPredictive
from jaximp.recordings.load import recording_from_arrays
from jaximp.recordings.save import save_recording
from jaximp.reports import posterior as posterior_report
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


@pytest.mark.parametrize(("after", "share", "least"), [(1, 0.98, 1), (140, 0.9, 11)], ids=["slow", "echo"])
def test_residuals_are_tested_over_more_lags_than_were_fitted(after: int, share: float, least: int) -> None:
    """Torque noise that follows from itself so many samples before."""
    recording, new = joint(), np.random.default_rng(5).normal(0, 0.1, len(TIME))
    noise = lfilter([1], np.r_[1, np.zeros(after - 1), -share], new)[:, None]
    found = infer_recording(parse_job(JOB), replace(recording, torque=recording.torque + noise))
    fitted, test = len(found.noise.autoregression[0]), found.whiteness[0]
    assert fitted >= least
    assert test.lags == max(20, fitted + 10)
    assert test.p == pytest.approx(chi2.sf(test.statistic, test.lags - fitted))


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


@pytest.mark.slow
def test_windows_contradict_each_other_also_where_no_sampler_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaximp.posterior.inference.find_spec", lambda name: None)
    first, second = joint(seed=1), joint(seed=2, stiffness=40.0)
    torque = np.where(np.arange(len(first))[:, None] < 4000, first.torque, second.torque)
    job = parse_job(JOB + "[posterior]\nheavy_tails = true\ness = 400\n")
    found = infer_recording(job, replace(first, torque=torque))
    assert "the windows contradict each other in stiffness" in found.why
    assert found.windows is not None
    assert found.windows.sampler.startswith("Laplace's normal approximation")
    np.testing.assert_allclose(found.windows.samples[[0, -1], :, 2].mean(axis=1), [20, 40], rtol=0.05)


@pytest.mark.slow
def test_a_prior_pulls_by_its_weight() -> None:
    job = parse_job(JOB + "[posterior.prior]\nstiffness = { mean = 25, sd = 0.01 }\n")
    pulled = infer_recording(job, joint()).whole
    assert abs(pulled["stiffness"].mean() - 25) < 0.1
    assert pulled.sampler.startswith("emcee")


def test_noise_of_the_position_is_corrected_for() -> None:
    recording = joint()
    noise = np.random.default_rng(1).normal(0, 1e-3, recording.position.shape)
    found = infer_recording(
        parse_job(JOB), replace(recording, position=recording.position + noise, position_noise=None)
    )
    assert found.bias[0] < -0.25
    assert found.why == ""
    z = (found.whole.mean[:4] - list(TRUTH.values())) / found.whole.samples.std(axis=0)[:4]
    assert np.abs(z).max() < 4
    assert found.whole.samples[:, 0].std() < 1e-3


@pytest.mark.slow
def test_a_model_that_lacks_something_predicts_worse(found: Inference) -> None:
    without = infer_recording(parse_job(JOB.replace("human = true", "human = { offset = false }")), joint())
    difference, error = compare_models(found, without)
    assert difference > 5 * error > 0
    assert compare_models(without, found)[0] == pytest.approx(-difference)
    assert compare_models(found, found) == (0, 0)
    other = infer_recording(parse_job(JOB.replace("cutoff = 20", "cutoff = 10")), joint())
    with pytest.raises(ValueError, match="through the same filters"):
        compare_models(found, other)


@pytest.mark.slow
def test_draws_of_windows_that_cannot_be_trusted_are_not_believed() -> None:
    """A torque of which the model explains little has a posterior all the same."""
    ordinary = parse_job(JOB.replace("[window]", "[window]\nnoise = 'filtered'"))
    recording = joint()
    drift = 8 * np.cumsum(np.random.default_rng(2).normal(0, 0.1, len(TIME)))[:, None]
    found = infer_recording(ordinary, replace(recording, torque=recording.torque + drift))
    assert not found.good.all()
    assert not {window for one in found.changes for window in one.windows} & set(np.flatnonzero(~found.good))
    nothing = replace(recording, torque=5 * np.sin(2 * np.pi * 4.3 * TIME)[:, None] + 0.1 * recording.torque)
    assert "no window can be trusted" in infer_recording(ordinary, nothing).why


def test_windows_without_samples_are_left_out() -> None:
    recording = joint()
    valid = (TIME < 2.5) | (TIME > 4.5)
    position, torque = (np.where(valid[:, None], x, np.nan) for x in (recording.position, recording.torque))
    found = infer_recording(parse_job(JOB), replace(recording, position=position, torque=torque, valid=valid))
    assert found.why == ""
    assert [line for line in found.left_out if line.startswith("3 s: 0 independent rows cannot determine")]
    assert 3 not in found.start


@pytest.mark.parametrize("measured", [TIME < 3.5, TIME > 4.5], ids=["first half", "second half"])
def test_a_half_without_samples_has_no_score(measured: np.ndarray) -> None:
    recording = joint()
    position, torque = (np.where(measured[:, None], x, np.nan) for x in (recording.position, recording.torque))
    half = replace(recording, position=position, torque=torque, valid=measured)
    found = infer_recording(parse_job(JOB), half)
    assert found.held_out is None
    assert found.score is None
    assert found.why == ""
    with pytest.raises(ValueError, match="half of the record does not determine"):
        compare_models(found, found)


def test_an_output_of_which_no_sample_counts_leaves_the_score_to_others(found: Inference) -> None:
    assert found.held_out is not None
    both = replace(found, held_out=np.column_stack([found.held_out, np.full(len(found.held_out), np.nan)]))
    assert both.score == found.score


def test_torque_without_noise_is_refused_in_one_line() -> None:
    recording = joint()
    with pytest.raises(ValueError, match=r"^.*to the last digit: without noise there is nothing to be unsure of$"):
        infer_recording(parse_job(JOB), replace(recording, torque=0 * recording.torque))


@pytest.mark.slow
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
    # The bands have the tails of the noise, of each joint its own.
    width = np.median(found.bands[-1] - found.bands[0], axis=0)
    scale = [np.exp(found.whole[name]).mean() for name in ("log_noise_1", "log_noise_2")]
    np.testing.assert_allclose(width, 2 * student.ppf(0.975, 4) * np.array(scale), rtol=0.1)


def slow_sum(seed: int, away: float = 0.0) -> Posterior:
    """Two weights that mix well, each by itself, and whose sum hardly moves at all."""
    random = np.random.default_rng(seed)
    fast, slow = random.normal(size=(8, 500)), np.repeat(random.normal(size=(8, 5)), 100, axis=1)
    return make_posterior(
        np.stack([fast + 0.01 * slow, away - fast + 0.01 * slow, random.normal(size=(8, 500))], axis=2),
        ("reflex_040ms", "reflex_080ms", "log_noise"),
    )


def test_a_gain_with_few_draws_is_not_believed(found: Inference) -> None:
    """Of a reflex the gain is shown, and it is the gain whose draws must suffice."""
    assert found.windows is not None
    whole, n = slow_sum(0), len(found.windows)
    assert whole.ok
    windows = stacked([slow_sum(k) for k in range(1, n + 1)])
    assert windows.ok.all()
    by_weight = replace(
        found, whole=whole, windows=windows, bias=np.zeros(2), shift=np.zeros(2), constant=np.zeros(2, bool)
    )
    assert by_weight.why == ""
    assert by_weight.good.any()
    by_gain = replace(by_weight, gains={"reflex_gain": np.ones(2)})
    assert "reflex_gain" in by_gain.why
    assert not by_gain.good.any()
    assert all("reflex_gain" in by_gain.reason(k) for k in range(n))


REFLEX = HumanJoint(reflex=ReflexPathway(100.0, [0.02, 0.075], -1))


@pytest.mark.parametrize(
    ("model", "names"),
    [
        (REFLEX, ["reflex_gain"]),
        (RobotJoint() + REFLEX, ["human.reflex_gain"]),
        (Joints(REFLEX, HumanJoint(), REFLEX), ["joint1.reflex_gain", "joint3.reflex_gain"]),
    ],
    ids=["alone", "pair", "joints"],
)
def test_gains_have_the_names_of_their_weights(model: Model, names: list[str]) -> None:
    found = inference._gains(model)
    assert list(found) == names
    for name, gain in found.items():
        weights = [name.replace("gain", lag) for lag in ("020ms", "075ms")]
        assert [model.names[k] for k in np.flatnonzero(gain)] == weights
        assert set(gain[gain != 0]) == {-1.0}


@pytest.mark.parametrize("method", [3, 4])
def test_a_robot_alone_that_was_recorded_for_less_long_judges_no_window_less(method: int) -> None:
    """Methods 3 and 4 have no rows beyond its end, and the posterior does."""
    held, robot = joint(), "human = true\nrobot = { gravity = false, coulomb = false }"
    noise = np.random.default_rng(4).normal(0, 0.05, len(TIME) // 2)
    q = held.position[: len(noise), 0]
    velocity = np.gradient(q, TIME[: len(noise)])
    alone = recording_from_arrays(TIME[: len(noise)], q, 0.3 * velocity + noise)
    text = JOB.replace("human = true", f"{robot}\nmethods = [{method}]") + "[robot_recording]\nfile = 'in the test'\n"
    job = parse_job(text)
    place, verdicts = inference._judged(prepare(job.pipeline_for(held), held, alone))
    assert len(place.starts) == len(verdicts.verdict) == 8
    assert verdicts.trusted.sum() >= 6


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


def test_the_command_writes_draws_and_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_recording(stiffening(), tmp_path / "<b>.csv")
    columns = "time = 'time_s'\nposition = 'position_rad'\ntorque = 'torque_Nm'\n"
    text = JOB.replace("recording = {}", f"[recording]\nfile = '<b>.csv'\n{columns}")
    (tmp_path / "job.toml").write_text(text)
    assert jaximp("posterior", tmp_path / "job.toml", "--out", tmp_path / "out") == 0
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


@pytest.mark.parametrize(
    ("ratio", "flat", "said"),
    [
        ((0.01, 0.02, 0.05), ("log_noise",), True),
        ((0.01, 0.02, 0.05), ("log_noise_1", "log_noise_2"), True),
        ((0.01, 0.02, 0.05), ("stiffness", "log_noise"), False),  # which may make the rest of the torque
        ((20.0, 30.0, 40.0), ("stiffness", "log_noise"), True),
        ((0.05, 0.5, 20.0), ("log_noise",), False),
    ],
)
def test_a_prior_contradicts_what_flat_parameters_do_not_make(
    found: Inference, ratio: tuple[float, float, float], flat: tuple[str, ...], said: bool
) -> None:
    remarks = posterior_report._remarks(replace(found, prior=PriorPredictive(ratio, flat)), False)
    assert any("they contradict each other" in line for line in remarks) == said


def test_the_torque_is_shown_where_it_was_measured(found: Inference) -> None:
    """The middle of what counts may lie in a gap that is longer than what is shown."""
    torque = np.full_like(found.torque, np.nan)
    n = len(torque)
    torque[: n // 8] = torque[-(n // 8) :] = 1.0
    figure = posterior_report._torque(replace(found, torque=torque), 0.5)
    (panel,) = figure.axes
    assert np.isfinite(panel.lines[-1].get_ydata()).any()
