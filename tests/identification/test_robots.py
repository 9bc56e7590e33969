"""Robots from a URDF: weights of joints, intervals, gains, held-out recordings, several recordings, standstill."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest

from factories.chains import RATE, TWO_JOINTS, chain_in, motion, recording, truth_of, urdf_in
from factories.robots import joint, link
from jaximp.consistency import consistent_ranges
from jaximp.identification.estimates import Estimates
from jaximp.identification.filter_settings import FilterSettings
from jaximp.identification.identify import estimate
from jaximp.identification.pipeline import Pipeline, WindowSettings
from jaximp.identification.weighted import covariance_of
from jaximp.models import Chain, TipImpedance, combine
from jaximp.recordings import recording_from_arrays, recordings_from_mapping
from jaximp.trust.verdicts import POOR
from jaximp.types import Recording
from paths import DATA

FILTER = FilterSettings(position_cutoff=8.0, decimation_cutoff=4.0)


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Chain:
    return chain_in(tmp_path_factory.mktemp("urdf"))


@pytest.fixture(scope="module")
def pipeline(chain: Chain) -> Pipeline:
    return Pipeline(100.0, chain, filter=FILTER)


@pytest.fixture(scope="module")
def runs(chain: Chain, pipeline: Pipeline) -> list[Estimates]:
    return [estimate(pipeline, recording(chain, seed))[0] for seed in range(12)]


def test_a_recording_is_one_window_by_default(runs: list[Estimates]) -> None:
    assert len(runs[0].end) == 1
    assert runs[0].end[0] - runs[0].start[0] > 19.5


def test_a_robot_is_told_nothing_of_human_joints(runs: list[Estimates]) -> None:
    assert not [note for note in runs[0].notes if "eq. 16" in note or "imposed" in note]


def test_the_truth_is_found_and_the_intervals_hold_it(chain: Chain, runs: list[Estimates]) -> None:
    truth = truth_of(chain)
    apart = np.array([(one.value[0] - truth) / one.stderr[0] for one in runs])
    assert 0.75 < np.sqrt((apart**2).mean()) < 1.3
    held = [(low[0] <= truth) & (truth <= high[0]) for low, high in (one.interval() for one in runs)]
    assert 0.88 < np.mean(held) <= 1


def test_errors_know_what_rows_have_in_common() -> None:
    """Of white noise they are the textbook's; slow noise leaves a constant three times as unsure."""
    rng = np.random.default_rng(0)
    W = np.concatenate([np.ones((400, 2, 1)), rng.normal(size=(400, 2, 2))], axis=-1)
    white, valid = rng.normal(size=(400, 2)), np.ones((400, 2), bool)
    textbook = np.sqrt(np.diagonal(np.linalg.inv(W.reshape(-1, 3).T @ W.reshape(-1, 3))))
    of_white, dof = covariance_of(W, white, valid)
    np.testing.assert_allclose(np.sqrt(np.diagonal(of_white)), textbook, rtol=0.25)
    slow = np.repeat(rng.normal(size=(40, 2)), 10, axis=0)
    of_slow, fewer = covariance_of(W, slow, valid)
    assert np.sqrt(of_slow[0, 0]) > 2 * textbook[0]
    assert fewer < dof


def test_determined_means_the_same_for_an_estimate_and_for_the_robots_within_its_errors(
    chain: Chain, runs: list[Estimates]
) -> None:
    """A first moment near zero whose interval is narrow is determined, though its relative error is large."""
    alone = [name for name in chain.names if chain.sums[name] == name]
    stderr, theta = np.array(runs[0].stderr), np.array(runs[0].value)
    for name, value, error in (("link2.mc_x", 0.001, 0.006), ("link2.mc_z", 0.1, 0.05)):
        k = chain.names.index(name)
        theta[:, k], stderr[:, k] = value, error
    found = replace(runs[0], fit=eqx.tree_at(lambda fit: (fit.theta, fit.stderr), runs[0].fit, (theta, stderr)))
    ranges = consistent_ranges(chain, theta[0], np.diag(stderr[0] ** 2), alone)
    loose = {name for name, known in zip(alone, ranges.determined, strict=True) if not known}
    assert set(found.undetermined()) & set(alone) == loose
    assert "link2.mc_z" in loose
    assert "link2.mc_x" not in loose


def test_joints_count_by_their_noise(chain: Chain, runs: list[Estimates]) -> None:
    """The elbow is ten times as quiet: its friction is as much surer."""
    stderr = {name: np.median([one.stderr[0, k] for one in runs]) for k, name in enumerate(chain.names)}
    assert 5 < stderr["joint1.viscous_friction"] / stderr["joint2.viscous_friction"] < 25


def test_errors_of_gains_are_carried(chain: Chain, pipeline: Pipeline, runs: list[Estimates]) -> None:
    """A gain that all torques have in common scales all parameters."""
    plain, known = runs[0], recording(chain, 0)
    common = replace(known, gain_covariance=np.full((2, 2), 0.1**2))
    found = estimate(pipeline, common)[0]
    np.testing.assert_allclose(found.value, plain.value, rtol=1e-9)
    grown = np.sqrt(found.stderr**2 - plain.stderr**2)
    np.testing.assert_allclose(grown, 0.1 * np.abs(plain.value), rtol=0.01, atol=1e-6)


def test_a_gain_of_one_joint_moves_what_it_moves(chain: Chain, pipeline: Pipeline, runs: list[Estimates]) -> None:
    """As if this torque were 1 % larger, with the same weights."""
    plain, known = runs[1], recording(chain, 1)
    found = estimate(pipeline, replace(known, gain_covariance=np.diag([0.0, 0.01**2])))[0]
    grown = np.sqrt(np.maximum(found.stderr**2 - plain.stderr**2, 0))[0]
    scaled = replace(known, torque=known.torque * [1.0, 1.01])
    moved = np.abs(estimate(pipeline, scaled)[0].value - plain.value)[0]
    np.testing.assert_allclose(grown, moved, rtol=0.1, atol=2e-4)


def test_what_is_held_out_is_predicted(chain: Chain, pipeline: Pipeline) -> None:
    (found,) = estimate(pipeline, recording(chain, 2), held_out=recording(chain, 3))
    assert found.held_out is not None
    torque, predicted = found.held_out.torque, found.held_out.predicted
    known = np.isfinite(torque)
    left = np.where(known, torque - predicted, 0)
    whole = np.where(known, torque, 0)
    assert found.held_out.total == pytest.approx(np.sqrt((left**2).sum() / (whole**2).sum()), rel=1e-9)
    assert found.held_out.total < 0.1
    wrong = replace(recording(chain, 3), joints=("revolute", "prismatic"))
    with pytest.raises(ValueError, match="has other joints than run 2"):
        estimate(pipeline, recording(chain, 2), held_out=wrong)


def test_several_recordings_are_one_fit(chain: Chain, pipeline: Pipeline, runs: list[Estimates]) -> None:
    """They say as much as both by themselves, or more, and when the second was made does not count."""
    first, second = recording(chain, 0), recording(chain, 1)
    (both,) = estimate(pipeline, [first, second])
    together = 1 / np.sqrt(1 / runs[0].stderr ** 2 + 1 / runs[1].stderr ** 2)
    assert 0.5 < np.median(both.stderr / together) < 1.2
    leap = replace(second, time=second.time + 100)
    np.testing.assert_allclose(estimate(pipeline, [first, leap])[0].value, both.value, rtol=1e-9)
    assert any("2 recordings count as one" in note for note in both.notes)


def test_standstill_counts_for_the_joint_that_rests_alone(tmp_path: Path) -> None:
    chain = chain_in(tmp_path, min_velocity=[0.3, 0.0])
    found = estimate(Pipeline(100.0, chain, filter=FILTER), recording(chain, 0))[0].residuals
    dq = motion(0)[2]
    assert found is not None
    assert 0.1 < np.mean(np.abs(dq[:, 0]) < 0.3) < 0.9
    assert np.isfinite(found.still[0])
    assert np.isnan(found.still[1])
    assert (found.moving < [0.3, 0.04]).all()


def test_parameters_have_verdicts_of_their_own(chain: Chain, pipeline: Pipeline) -> None:
    """A joint that hardly moves says nothing of its own friction; the window is none the worse for the other joint."""
    _, q, dq, ddq = (x * np.array([1.0, 2e-5]) if x.ndim > 1 else x for x in motion(4))
    torque = np.asarray(chain.observation_matrix(q, dq, ddq)) @ truth_of(chain)
    known = recording(chain, 4)
    noise = 1e-5 * np.random.default_rng(7).normal(size=(2, *q.shape))
    resting = replace(known, position=q + noise[0], torque=torque + 1e4 * noise[1], position_noise=np.full(2, 1e-5))
    found = estimate(pipeline, resting)[0]
    assert set(found.doubted) == set(chain.names)
    assert found.doubted["joint2.viscous_friction"][0] != ""
    assert not found.trusted_in("joint2.viscous_friction")[0]
    assert found.trusted_in("joint1.viscous_friction")[0]


@pytest.mark.parametrize("mistake", ["order", "torques", "sign of a position", "gravity", "degrees"])
def test_a_robot_that_cannot_be_is_not_trusted(chain: Chain, pipeline: Pipeline, tmp_path: Path, mistake: str) -> None:
    """What users get wrong leaves a robot whose links cannot be, or that explains little."""
    known, turned = recording(chain, 1), slice(None, None, -1)
    recorded = {
        "order": {"position": known.position[:, turned], "torque": known.torque[:, turned]},
        "torques": {"torque": known.torque[:, turned]},
        "sign of a position": {"position": known.position * [1.0, -1.0]},
        "degrees": {"position": np.degrees(known.position)},
    }
    model = chain_in(tmp_path, gravity=(0.0, 0.0, 9.81)) if mistake == "gravity" else chain
    (found,) = estimate(replace(pipeline, model=model), replace(known, **recorded.get(mistake, {})))
    assert found.verdicts.verdict[0] == POOR
    reason = {"degrees": "lets it move from", "gravity": "the other way round than by the masses"}
    assert re.search(
        reason.get(mistake, "parameters of a robot|the model explains|the other way round"), found.verdicts.reason[0]
    )


def test_a_robot_that_can_be_is_trusted(runs: list[Estimates]) -> None:
    assert all(one.verdicts.trusted.all() for one in runs)
    assert {one.measured[0].unreal for one in runs} == {0.0}
    assert all(one.measured[0].of_robot for one in runs)


def test_a_held_out_recording_of_something_else_is_noticed(chain: Chain, pipeline: Pipeline) -> None:
    """Twice the load on the shoulder: the fit itself is good."""
    other = recording(chain, 3)
    (found,) = estimate(pipeline, recording(chain, 2), held_out=replace(other, torque=other.torque * [2.5, 1.0]))
    assert found.verdicts.verdict[0] == POOR
    assert "of the squared torque of the held-out recording" in found.verdicts.reason[0]


def test_a_position_a_little_out_of_reach_is_said(chain: Chain, pipeline: Pipeline) -> None:
    """Limits of URDFs are often set too narrowly: that alone refuses nothing."""
    known = recording(chain, 1)
    moved = replace(known, position=known.position + np.array([2.5, 0.0]))
    (found,) = estimate(pipeline, moved)
    assert any("shoulder was recorded at" in note and "to 2.5 only" in note for note in found.notes)
    assert "lets it move" not in found.verdicts.reason[0]


def test_positions_of_motors_are_within_reach_by_their_joints(chain: Chain, tmp_path: Path) -> None:
    """Motors turn fifty times as far as the joints, one of them backwards and from another zero."""
    known, geared = recording(chain, 1), {"gear": 50.0, "side": "motor", "sign": [1, -1], "zero": [0.0, 0.4]}
    at_motors = (known.position - [0.0, 0.4]) * [50.0, -50.0]
    turned = replace(known, position=at_motors, torque=known.torque * [0.02, -0.02], position_noise=None)
    (found,) = estimate(Pipeline(100.0, chain_in(tmp_path, **geared), filter=FILTER), turned)
    assert found.verdicts.trusted.all()
    assert not any("lets it move" in note for note in found.notes)


def test_windows_of_a_length_slide_over_a_chain(chain: Chain) -> None:
    sliding = Pipeline(100.0, chain, WindowSettings(8.0, 4.0), FILTER)
    found = estimate(sliding, recording(chain, 5))[0]
    assert len(found.end) == 4
    apart = (found.value - truth_of(chain)) / found.stderr
    assert 0.4 < np.sqrt((apart**2).mean()) < 1.7


def test_a_human_holds_the_tip_of_a_robot(tmp_path: Path) -> None:
    """Both are identified from one recording, each joint counted by what is left of it."""
    hand = joint("wrist", "fore", "hand", "fixed", "0.02 0 0.25") + link("hand", 0.2)
    path = urdf_in(tmp_path)
    path.write_text(TWO_JOINTS.replace("</robot>", f"{hand}</robot>"), encoding="utf-8")
    robot = Chain.from_urdf(path, tip="hand", friction=True)
    model = combine(robot, TipImpedance(robot, "xz"))
    human = [1.2, 0.8, 6.0, 9.0, 150.0, 90.0, 12.0, -8.0]  # masses, damping, stiffness, force
    theta = np.concatenate([truth_of(robot), human])
    truth = np.array(model.merge) @ theta
    time, q, dq, ddq = motion(0, 30.0)
    torque = np.asarray(model.observation_matrix(q, dq, ddq)) @ truth
    noisy = recording_from_arrays(time, q, torque + 0.05 * np.random.default_rng(0).normal(size=q.shape))
    found = estimate(Pipeline(RATE, model, filter=FILTER), noisy)[0]
    assert np.abs((found.value[0] - truth) / found.stderr[0]).max() < 4
    assert found["human.stiffness_x"].value[0] == pytest.approx(150, rel=0.05)
    assert found.trusted_in("human.stiffness_x").all(), found.verdicts.reason


def test_generalised_estimates_can_be_asked_for(chain: Chain) -> None:
    generalised = Pipeline(100.0, chain, WindowSettings(estimates="generalised"), FILTER)
    found = estimate(generalised, recording(chain, 6))[0]
    apart = (found.value - truth_of(chain)) / found.stderr
    assert np.sqrt((apart**2).mean()) < 2


def test_recordings_of_other_joints_are_refused(chain: Chain, pipeline: Pipeline) -> None:
    one: Recording = recording(chain, 0).of_joint(0)
    with pytest.raises(ValueError, match="has 2 joints, but the recording 1"):
        estimate(pipeline, one)


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "ur10e").is_dir(), reason=f"no recordings of the arm in {DATA}")
def test_a_real_arm_is_predicted() -> None:
    """Point to point, with its standstill, by two exciting motions; other toolkits leave 4.75 to 4.80 %."""
    arm, folder = Chain.from_urdf(DATA / "ur10e" / "ur10e.urdf", friction=True, rotor=True, offset=True), DATA / "ur10e"
    gain = [10.0, 10.70, 8.46, 9.00, 9.48, 10.12]
    torque = {"columns": [14, 15, 16, 17, 18, 19], "gain": gain}
    columns = {"time": 1, "position": [2, 3, 4, 5, 6, 7], "torque": torque}
    files = {"file": ["30sec_12harm.csv", "40sec_12harm.csv"], "rows": [[635, 3510], [500, 4460]]}
    seen = recordings_from_mapping({**files, **columns}, folder)
    (unseen,) = recordings_from_mapping({"file": "ptp_10_points.csv", "rows": [700, 4200], **columns}, folder)
    filters = FilterSettings(position_cutoff=10.0, decimation_cutoff=5.0)
    (found,) = estimate(Pipeline(100.0, arm.with_sign_width(0.005), filter=filters), seen, held_out=unseen)
    assert found.held_out is not None
    assert found.held_out.total < 0.0475
    assert found.verdicts.trusted.all()
