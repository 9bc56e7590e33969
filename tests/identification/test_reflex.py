"""The stretch reflex: its columns against a plain construction, the unknown past, joints with and without it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter

from factories.joints import ankle_job
from jaximp.design import motions
from jaximp.identification import FilterSettings
from jaximp.identification.estimates import Estimates
from jaximp.identification.filter_settings import Filters
from jaximp.identification.identify import in_windows
from jaximp.identification.prepared import prepare
from jaximp.identification.rows import measure, regress, undisturbed
from jaximp.jobs import parse_job
from jaximp.jobs.run import identify, identify_recording
from jaximp.least_squares.window import least_squares
from jaximp.models import (
    HumanJoint,
    Joints,
    Model,
    ReflexPathway,
    RobotJoint,
    combine,
    pathway_of,
    reflex_gain,
    with_gain,
)
from jaximp.recordings.load import recording_from_arrays
from jaximp.reports import estimates as report
from jaximp.types import Recording

Numbers = NDArray[np.float64]

RATE, PERIOD = 500.0, 4.0
TRUTH = {"inertia": 0.015, "damping": 0.7, "stiffness": 60.0, "offset_torque": 0.4}
GAIN, DELAY, POLE = 8.0, 0.04, 25.0
"""A reflex as in the parallel-cascade literature: a delay, then a critically damped low-pass of second order [1/s]."""
JOB = """
recording = {}
[model]
human = { reflex = { count = 25 , last = 0.4 } }
[filter]
position_cutoff = 60
decimation_cutoff = 40
[window]
length = 3
step = 1
"""


def motion(seconds: float = 12.0) -> tuple[Numbers, Numbers, Numbers]:
    """Many sines of random phase, up to 12 Hz; it repeats itself every four seconds."""
    t, k = np.arange(round(seconds * RATE)) / RATE, np.arange(1, 49)
    w, phase = 2 * np.pi * k / PERIOD, np.random.default_rng(3).uniform(0, 2 * np.pi, len(k))
    size = 0.08 / (4 + k)
    waves = [(size * w**n * np.sin(t[:, None] * w + phase + n * np.pi / 2)).sum(axis=1) for n in range(3)]
    return waves[0], waves[1], waves[2]


def reflex_torque(dq: Numbers, direction: int = 1) -> Numbers:
    """By a recursion of its own, from rest."""
    shift = round(DELAY * RATE)
    delayed = np.r_[np.zeros(shift), direction * np.maximum(direction * dq[:-shift], 0)]
    b, a, _ = cont2discrete(([POLE**2], [1, 2 * POLE, POLE**2]), 1 / RATE, method="foh")
    return np.asarray(GAIN * lfilter(b.ravel(), a, delayed))


@cache
def joint(direction: int = 1, seconds: float = 12.0) -> Recording:
    q, dq, ddq = motion(seconds)
    intrinsic = sum(x * y for x, y in zip(TRUTH.values(), (ddq, dq, q, 1.0), strict=True))
    noise = np.random.default_rng(1).normal(0, 0.03, len(q))
    time = np.arange(len(q)) / RATE
    return recording_from_arrays(time, q, intrinsic + reflex_torque(dq, direction) + noise, reference=q)


@cache
def identified(text: str = JOB, direction: int = 1) -> Estimates:
    return identify_recording(parse_job(text), joint(direction))[0]


def delayed(dq: Numbers, lag: float, rate: float, direction: int = 1) -> Numbers:
    """One column, sample by sample."""
    out = np.full(len(dq), np.nan)
    for n in range(len(dq)):
        at = n - lag * rate
        if at >= -1e-9:
            out[n] = max(direction * np.interp(at, np.arange(len(dq)), dq), 0)
    return out


def noise(n: int = 80) -> tuple[Numbers, Numbers, Numbers]:
    x = np.random.default_rng(0).normal(size=(3, n))
    return x[0], x[1], x[2]


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("rate", [100.0, 97.3], ids=["whole samples", "between samples"])
def test_columns_are_the_delayed_and_rectified_velocity(rate: float, direction: int) -> None:
    lags = [0.0, 0.03, 0.1, 0.25]
    pathway = ReflexPathway(rate, lags, direction)
    q, dq, ddq = noise()
    expected = np.stack([delayed(dq, lag, rate, direction) for lag in lags], axis=1)
    W = np.asarray(jax.jit(lambda *x: pathway.observation_matrix(*x))(q, dq, ddq))
    np.testing.assert_allclose(W, expected, atol=1e-12)
    assert pathway.names == ("reflex_000ms", "reflex_030ms", "reflex_100ms", "reflex_250ms")
    assert pathway.memory == np.isnan(expected[:, -1]).sum()
    assert (expected[pathway.memory :] >= 0).all()


def test_lags_between_samples_are_interpolated_before_the_velocity_is_rectified() -> None:
    dq = np.array([-1.0, 3.0, 0.0])
    W = np.asarray(ReflexPathway(100.0, [0.005]).observation_matrix(dq, dq, dq))
    np.testing.assert_allclose(W[1:, 0], [1.0, 1.5])


MEMBER = HumanJoint(reflex=ReflexPathway(100.0, [0.02, 0.075]))


@pytest.mark.parametrize(
    ("model", "parts"),
    [
        (MEMBER, [HumanJoint()]),
        (HumanJoint() + ReflexPathway(100.0, [0.02, 0.075]), [HumanJoint()]),
        (RobotJoint() + MEMBER, [RobotJoint(), HumanJoint()]),
    ],
    ids=["in a human joint", "stacked on one", "human in a robot"],
)
def test_sums_have_the_columns_of_their_members(model: Model, parts: list[Model]) -> None:
    q, dq, ddq = noise()
    reflexes = [delayed(dq, lag, 100.0)[:, None] for lag in (0.02, 0.075)]
    expected = np.concatenate([*(np.asarray(part.regressor(q, dq, ddq)) for part in parts), *reflexes], axis=1)
    np.testing.assert_allclose(model.observation_matrix(q, dq, ddq), expected, atol=1e-12)
    assert len(model.names) == len(set(model.names)) == len(model.units) == expected.shape[1]
    assert model.memory == 8
    assert model.sample_rate == 100
    torque = np.asarray(model.torque(np.arange(expected.shape[1]), q, dq, ddq))
    np.testing.assert_allclose(torque[8:], expected[8:] @ np.arange(expected.shape[1]))
    with pytest.raises(ValueError, match="whole recording"):
        model.regressor(q, dq, ddq)
    with pytest.raises(ValueError, match="whole recording"):
        model.regressor(0.0, 0.0, 0.0)


def test_merged_columns_keep_the_reflex() -> None:
    q, dq, ddq = noise()
    both = combine(RobotJoint(), MEMBER)
    stacked = RobotJoint() + MEMBER
    theta = np.random.default_rng(1).normal(size=len(stacked.names))
    merged = np.asarray(both.observation_matrix(q, dq, ddq)) @ (np.array(both.merge) @ theta)
    np.testing.assert_allclose(merged, stacked.observation_matrix(q, dq, ddq) @ theta, atol=1e-12)


def test_joints_side_by_side_remember_each_its_own_motion() -> None:
    motions = [np.stack([x, x[::-1]], axis=1) for x in noise()]
    W = np.asarray(Joints(MEMBER, HumanJoint(offset=False)).observation_matrix(*motions))
    assert W.shape == (80, 2, 9)
    np.testing.assert_array_equal(W[:, 0, :6], MEMBER.observation_matrix(*(x[:, 0] for x in motions)))
    second = HumanJoint(offset=False).regressor(*(x[:, 1] for x in motions))
    np.testing.assert_array_equal(W[:, 1, 6:], second)
    assert not W[:, 0, 6:].any()
    assert not W[:, 1, :6].any()


def test_of_a_periodic_motion_the_past_is_the_end_of_the_period() -> None:
    q, dq, ddq = (x[: round(PERIOD * RATE)] for x in motion())
    model = HumanJoint(offset=False, reflex=ReflexPathway(1000.0, [0.04, 0.3]))
    expected = np.stack([np.maximum(np.roll(dq, round(lag * RATE)), 0) for lag in (0.04, 0.3)], axis=1)
    W = np.asarray(model.over_period(q, dq, ddq, RATE))
    np.testing.assert_allclose(W[:, 3:], expected, atol=1e-12)
    long = ReflexPathway(1000.0, [1.0]).over_period(dq[:200], dq[:200], dq[:200], RATE)  # more than two periods
    np.testing.assert_allclose(long[:, 0], np.maximum(np.roll(dq[:200], 500), 0))
    designed = motions.regressor_rows(model, tuple(jax.numpy.asarray(x)[:, None] for x in (q, dq, ddq)), None, PERIOD)
    np.testing.assert_allclose(designed[:, 0], W, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ReflexPathway(0.0), "sample_rate"),
        (lambda: ReflexPathway(1000.0, [40.0, 50.0]), "seconds"),
        (lambda: ReflexPathway(1000.0, [-0.01]), "seconds"),
        (lambda: ReflexPathway(1000.0, []), "seconds"),
        (lambda: ReflexPathway(1000.0, [0.04, 0.04]), "millisecond"),
        (lambda: ReflexPathway(1000.0, [0.05, 0.04]), "rise"),
        (lambda: ReflexPathway(1000.0, direction=0), "direction"),
        (lambda: ReflexPathway(1000.0) + ReflexPathway(1000.0), "two different things"),
        (lambda: HumanJoint() + ReflexPathway(1000.0) + MEMBER, "sample rates"),
        (lambda: reflex_gain(HumanJoint(), np.zeros(4), np.eye(4)), "no reflex"),
    ],
)
def test_what_makes_no_sense_is_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("count = 25", "count = 0", "count is 0"),
        ("count = 25", "first = 40", "model.human.reflex: lags .* seconds"),
        ("count = 25", "direction = 2", "direction is 2"),
        ("{ count = 25 , last = 0.4 }", "3", "model.human.reflex is 3"),
        ("[filter]", "[filter]\nmode = 'window'", "cuts off the past"),
        ("length = 3", "length = 0.05", "cannot determine 29 parameters"),
    ],
)
def test_jobs_that_make_no_sense_are_refused(old: str, new: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        identify_recording(parse_job(JOB.replace(old, new)), joint())


def test_a_job_makes_the_model_for_the_recordings_sample_rate() -> None:
    job = parse_job(JOB.replace("{ count = 25 , last = 0.4 }", "true"))
    human = job.models(("revolute",), 250.0)[1]
    assert human is not None
    assert pathway_of(human) == ReflexPathway(250.0)
    with pytest.raises(ValueError, match="sample rate"):
        job.models(("revolute",))
    with pytest.raises(ValueError, match="250 Hz, but the recording has 500 Hz"):
        measure(job.pipeline(("revolute",), 250.0), joint())
    inside = replace(job, filter=FilterSettings(mode="window"))
    with pytest.raises(ValueError, match="cuts off the past"):
        measure(inside.pipeline_for(joint()), joint())


def rows_of(recording: Recording) -> tuple[Numbers, NDArray[np.bool_], int, Filters]:
    job = parse_job(JOB)
    job = replace(job, filter=replace(job.filter, decimate=1))
    pipeline = job.pipeline(("revolute",), RATE)
    rows = regress(measure(pipeline, recording))[0]
    return np.asarray(rows.W), rows.valid, pipeline.model.memory, pipeline.filters


def test_no_row_counts_whose_past_is_not_known() -> None:
    """Against the rows of a recording that began two seconds earlier and has no gap."""
    whole = rows_of(joint())[0][1000:]
    late = joint()
    valid = late.valid.copy()[1000:]
    valid[2000:2200] = False
    position = np.where(valid[:, None], late.position[1000:], np.nan)
    cut = replace(
        late, time=late.time[1000:], position=position, torque=late.torque[1000:], valid=valid, reference=None
    )
    W, counts, memory, filters = rows_of(cut)
    assert memory == 200
    reach, n = filters.reach, len(valid)
    expected = [
        k - memory - reach >= 0 and k + reach < n and valid[k - memory - reach : k + reach + 1].all() for k in range(n)
    ]
    np.testing.assert_array_equal(counts, expected)
    assert counts.sum() > 2000
    away = np.abs(W - whole) / np.abs(whole).max(axis=0)
    assert away[counts].max() < 0.02
    after = slice(2200 + reach, 2200 + reach + memory)
    assert away[: memory + reach].max() > 0.3
    assert away[after].max() > 0.3
    assert away[after, :4].max() < 0.02  # the joint itself has no memory


def test_a_jump_is_remembered() -> None:
    q, *_ = motion()
    jumping = recording_from_arrays(np.arange(len(q)) / RATE, q + np.where(np.arange(len(q)) < 3000, 0, 0.5), q)
    filters = parse_job(JOB).pipeline(("revolute",), RATE).filters
    short, long = (undisturbed(jumping, filters, memory=memory) for memory in (0, 200))
    last = np.flatnonzero(~short[1000:5000])[-1] + 1000
    assert not long[2999 : last + 201].any()
    assert long[last + 201 : last + 1000].all()


@pytest.mark.slow
def test_without_the_reflex_the_stiffness_is_biased_and_with_it_right() -> None:
    with_it, without = (
        identified(),
        identified(JOB.replace("human = { reflex = { count = 25 , last = 0.4 } }", "human = true")),
    )
    truth = np.array(list(TRUTH.values()))
    ok = with_it.verdicts.trusted
    assert ok.sum() >= 6
    theta, stderr = (np.asarray(x)[ok][:, :4] for x in (with_it.fit.theta, with_it.fit.stderr))
    assert np.abs((theta - truth) / stderr).max() < 4.5
    np.testing.assert_allclose(theta[:, :3].mean(axis=0), truth[:3], rtol=0.01)
    stiffness = np.asarray(without.fit.theta)[:, 2]
    assert np.nanmin(stiffness) > 1.1 * TRUTH["stiffness"]
    assert np.nanmean(with_it.held_out_vaf) > 0.99 > 0.9 > np.nanmean(np.asarray(without.fit.vaf))
    (reflex,) = with_it.reflexes
    assert np.abs((reflex.gain[ok] - GAIN) / reflex.gain_stderr[ok]).max() < 4.5
    np.testing.assert_allclose(reflex.gain[ok].mean(), GAIN, rtol=0.02)
    np.testing.assert_allclose(np.median(reflex.delay[ok]), DELAY + 2 / POLE, rtol=0.03)


def test_the_other_direction_is_told_by_the_sign_of_the_gain_and_by_what_is_predicted() -> None:
    other = JOB.replace("count = 25", "count = 25, direction = -1")
    right, wrong = identified(other, -1), identified(other, 1)
    assert right.reflexes[0].gain[right.verdicts.trusted].mean() == pytest.approx(GAIN, rel=0.02)
    assert (np.asarray(right.fit.theta)[right.verdicts.trusted][:, 4:].sum(axis=1) < 0).all()
    assert np.nanmean(wrong.held_out_vaf) < np.nanmean(right.held_out_vaf) - 0.05


@pytest.mark.slow
def test_windows_are_those_of_numpy_and_the_gain_has_its_covariance(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaximp.identification.judging._corrected", lambda prepared, rows, fit, *others: fit)
    job = parse_job(JOB)
    prepared = prepare(job.pipeline_for(joint()), joint())
    estimates = in_windows(prepared)[0]
    rows, (white,), (reflex,) = prepared.rows, prepared.white, estimates.reflexes
    length = round(3 * RATE / prepared.pipeline.filters.decimate)
    for k in (1, 4):
        first = int(np.asarray(estimates.fit.first)[k])
        part = slice(first, first + length)
        counts = rows.valid[part]
        W, y = np.asarray(white.W)[part], np.asarray(white.torque)[part]
        expected = np.linalg.lstsq(W[counts], y[counts], rcond=None)[0]
        np.testing.assert_allclose(np.asarray(estimates.fit.theta)[k], expected, rtol=1e-6, atol=1e-8)
        window = least_squares(W, y, counts)
        # So many neighbouring rows say as much as one, and have so many times the squares of its residual.
        freedom, every = counts.sum(), white.every
        repeated = every * (freedom - W.shape[1]) / (freedom - every * W.shape[1])
        one = reflex_gain(prepared.model, window.theta, repeated * window.covariance)
        np.testing.assert_allclose([reflex.gain[k], reflex.gain_stderr[k]], [one.gain, one.gain_stderr], rtol=1e-6)
        np.testing.assert_allclose(reflex.delay[k], one.delay)
        np.testing.assert_allclose(np.asarray(estimates.fit.cond)[k], np.linalg.cond(rows.W[part][counts]), rtol=1e-6)


def test_gain_and_delay_scatter_as_their_standard_errors_say() -> None:
    """Of weights drawn from their covariance."""
    model = HumanJoint(offset=False, reflex=ReflexPathway(100.0, [0.04, 0.06, 0.1], -1))
    random = np.random.default_rng(5)
    root = 0.02 * random.normal(size=(6, 6))
    theta = np.array([0.1, 1.0, 20.0, -1.0, -2.0, -1.0])
    found = reflex_gain(model, theta, root @ root.T)
    np.testing.assert_allclose([found.gain, found.delay], [4.0, 0.065])
    drawn = theta + random.normal(size=(20_000, 6)) @ root.T
    weights = drawn[:, 3:]
    gains, delays = -weights.sum(axis=1), weights @ [0.04, 0.06, 0.1] / weights.sum(axis=1)
    np.testing.assert_allclose([found.gain_stderr, found.delay_stderr], [gains.std(), delays.std()], rtol=0.03)
    many = reflex_gain(model, drawn[:7], np.broadcast_to(root @ root.T, (7, 6, 6)))
    np.testing.assert_allclose(many.gain, gains[:7])
    assert many.delay_stderr.shape == (7,)
    W = random.normal(size=(9, 6))
    other = np.r_[theta[:3], 4.0, theta[4:]]
    np.testing.assert_allclose(with_gain(model, W) @ other, W @ theta)


@pytest.mark.slow
@pytest.mark.compiles
def test_the_threshold_for_fake_changes_knows_the_past_of_a_period() -> None:
    job = parse_job(f"reference_period = {PERIOD}\n{JOB}")
    recording = joint()
    estimates = identify_recording(job, recording)[0]
    human = job.models(("revolute",), RATE)[1]
    assert human is not None
    n = round(PERIOD * RATE)
    q, dq, ddq = (np.concatenate([x[:n], x[:n]]) for x in motion())
    steady = np.asarray(human.observation_matrix(q, dq, ddq))[n:]
    assert estimates.threshold == pytest.approx(np.linalg.cond(steady) * 4 / 3, rel=0.02)


@pytest.mark.slow
def test_a_human_with_a_reflex_is_told_from_the_robot() -> None:
    """Robot and human together: the gain's standard error takes a fit of its own, by the same method."""
    q, dq, ddq = motion(6)
    time = np.arange(len(q)) / RATE
    scatter = np.random.default_rng(2).normal(0, 0.02, (2, len(q)))
    alone = recording_from_arrays(time, q, 0.01 * ddq + 0.3 * dq + scatter[0])
    held = recording_from_arrays(time, q, 0.01 * ddq + 0.3 * dq + joint(1, 6.0).torque[:, 0] + scatter[1])
    text = JOB.replace("human =", "robot = { gravity = false, coulomb = false }\nmethods = [4]\nhuman =")
    job = parse_job(text.replace("count = 25", "count = 13") + "[robot_recording]\nfile = 'made in the test'\n")
    estimates = identify_recording(job, held, alone)[0]
    ok = estimates.verdicts.trusted
    assert ok.any()
    (reflex,) = estimates.reflexes
    weights = np.asarray(estimates.fit.theta)[:, reflex.columns].sum(axis=1)
    np.testing.assert_allclose(reflex.gain[ok], weights[ok], rtol=1e-6)
    np.testing.assert_allclose(reflex.gain[ok], GAIN, rtol=0.03)
    assert (reflex.gain_stderr[ok] < 0.02 * GAIN).all()


def test_the_report_shows_the_gain_and_not_the_weights_one_by_one(tmp_path: Path) -> None:
    job, recording = parse_job(JOB), joint()
    estimates = identified()
    report.write_results(tmp_path, [estimates], [], job, recording)
    content = json.loads((tmp_path / "summary.json").read_text())
    assert list(content["parameters"]) == [*TRUTH, "reflex_gain"]
    assert content["parameters"]["reflex_gain"]["mean"] == pytest.approx(GAIN, rel=0.02)
    assert content["parameters"]["reflex_gain"]["half_width_95"] > 0
    reflex = content["reflex"]["reflex"]
    assert reflex["delay"]["median"] == pytest.approx(DELAY + 2 / POLE, rel=0.03)
    assert len(reflex["lags_s"]) == len(reflex["weights"]["mean"]) == 25
    assert any("one by one" in note for note in content["notes"])
    page = (tmp_path / "report.html").read_text()
    assert "reflex gain" in page
    assert "reflex mean delay" in page
    assert "reflex 040ms" not in page
    assert (tmp_path / "reflex.png").stat().st_size > 10_000
    table = pq.read_table(tmp_path / "estimates.parquet")
    assert {"reflex_gain", "reflex_gain_stderr", "reflex_delay", "reflex_040ms", "reflex_400ms_stderr"} <= set(
        table.column_names
    )


def test_parameters_that_are_named_are_judged() -> None:
    """By themselves the weights are not; a limit that no weight keeps shows it."""
    strict = parse_job(JOB + "[trust]\nmax_relative_stderr = 0.02\n")
    prepared = prepare(strict.pipeline_for(joint()), joint())
    assert in_windows(prepared)[0].verdicts.trusted.any()
    named = replace(strict, trust=replace(strict.trust, parameters=("reflex_160ms",), max_relative_stderr=1e-4))
    again = replace(prepared, pipeline=named.pipeline_for(joint()), solved=())
    found = in_windows(again)[0].verdicts
    assert not found.trusted.any()
    assert any("reflex_160ms" in reason for reason in found.reason)


@pytest.mark.slow
@pytest.mark.compiles
def test_the_ankle_with_a_reflex_is_explained_by_one(data_folder: Path) -> None:
    reflexes = ("true", "{ direction = -1 }")
    human = "{{ offset = false, reflex = {} }}"
    jobs = {name: ankle_job(data_folder, "z_pf.npz", human.format(name), 2.5) for name in reflexes}
    found = {name: identify(job)[0] for name, job in jobs.items()}
    held_out = {name: float(np.nanmean(estimates.held_out_vaf)) for name, estimates in found.items()}
    assert held_out["true"] > 0.86
    assert held_out["{ direction = -1 }"] < 0.75
    with_it = found["true"]
    # The bank of lags leaves something that looks like a reflex of another kind and, beside it, like something that
    # yields, which moves the damping by 9 %: nothing is spared.
    for name in ("inertia", "damping", "stiffness"):
        assert not with_it.trusted_in(name).any()
        assert f"how far {name} would change cannot be told; it lacks more than that" in with_it.lacking[name]
    inertia, damping, stiffness = np.nanmedian(with_it.value, axis=0)[:3]
    assert inertia == pytest.approx(0.0158, rel=0.06)
    assert damping == pytest.approx(0.70, rel=0.15)
    assert stiffness == pytest.approx(57, rel=0.15)
    assert np.nanmin(with_it.reflexes[0].gain) > 15
