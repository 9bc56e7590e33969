"""The job on recordings: the real ones where they are at hand, and a simulated joint everywhere."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from factories.joints import JOB, TIME, TRUTH, ankle_job, joint
from jaximp.identification.identify import in_windows
from jaximp.identification.prepared import prepare, with_windows
from jaximp.jobs.job import parse_job
from jaximp.jobs.run import identify, identify_recording
from jaximp.least_squares.window import confidence_interval
from jaximp.models import PlanarArm
from jaximp.recordings.load import recording_from_arrays
from jaximp.types import Recording


def test_finds_a_simulated_joint_and_predicts_what_it_has_not_seen() -> None:
    estimates = identify_recording(parse_job(JOB), joint())[0]
    z = (np.asarray(estimates.fit.theta) - list(TRUTH.values())) / np.asarray(estimates.fit.stderr)
    assert estimates.names == tuple(TRUTH)
    assert estimates.verdicts.trusted.mean() > 0.95
    assert np.abs(z).max() < 5
    assert np.nanmin(estimates.held_out_vaf) > 0.99
    later = np.isfinite(estimates.predicted[:, 0]) & np.isfinite(estimates.torque[:, 0])
    residual = (estimates.torque - estimates.predicted)[later]
    assert residual.std() < 0.05 * estimates.torque[later].std()
    assert any("eq. 16" in note for note in estimates.notes)


def test_a_gap_is_left_out_and_the_rest_unharmed() -> None:
    recording = joint()
    valid = recording.valid.copy()
    valid[3000:3100] = False
    position, torque = recording.position.copy(), recording.torque.copy()
    position[~valid] = torque[~valid] = np.nan
    holed = replace(recording, position=position, torque=torque, valid=valid)
    whole, without = (identify_recording(parse_job(JOB), r)[0] for r in (recording, holed))
    away = (whole.end < 2.8) | (whole.start > 3.3)
    np.testing.assert_allclose(np.asarray(without.fit.theta)[away], np.asarray(whole.fit.theta)[away], rtol=1e-3)
    near = ~away
    assert (np.asarray(without.fit.samples)[near] < np.asarray(whole.fit.samples)[near]).all()


def test_single_missing_samples_are_bridged() -> None:
    recording = joint()
    valid = np.random.default_rng(8).random(len(TIME)) > 0.01
    torque = np.where(valid[:, None], recording.torque, np.nan)
    holed = replace(recording, torque=torque, valid=valid)
    estimates = identify_recording(parse_job(JOB), holed)[0]
    assert estimates.verdicts.trusted.mean() > 0.95
    np.testing.assert_allclose(np.asarray(estimates.fit.theta)[:, 2], TRUTH["stiffness"], rtol=0.03)


@pytest.mark.parametrize("mode", ["once", "window"])
def test_a_gap_spoils_no_window_in_either_mode(mode: str) -> None:
    recording = joint()
    valid = (TIME < 3.0) | (TIME > 3.1)
    torque = np.where(valid[:, None], recording.torque, np.nan)
    text = JOB.replace("[filter]", f'[filter]\nmode = "{mode}"\n')
    estimates = identify_recording(parse_job(text), replace(recording, torque=torque, valid=valid))[0]
    trusted = estimates.verdicts.trusted
    assert trusted.sum() > 30
    np.testing.assert_allclose(np.asarray(estimates.fit.theta)[trusted, 2], TRUTH["stiffness"], rtol=0.04)


@pytest.mark.parametrize("drop", [True, False], ids=["ends dropped", "ends kept"])
def test_the_literal_mode_filters_every_window_by_itself(drop: bool) -> None:
    text = JOB.replace("[filter]", f'[filter]\nmode = "window"\ndrop_transient = {str(drop).lower()}\n')
    estimates = identify_recording(parse_job(text), joint())[0]
    assert len(estimates.end) == 71
    assert estimates.end[0] == pytest.approx(0.99, abs=0.02)
    np.testing.assert_allclose(np.median(np.asarray(estimates.fit.theta), axis=0)[2], 20.0, rtol=0.02)
    assert any("the inertia is biased" in note for note in estimates.notes)


def test_other_lengths_share_the_filtered_recording() -> None:
    job, recording = parse_job(JOB), joint()
    prepared = prepare(job.pipeline_for(recording), recording)
    half = replace(job, window=replace(job.window, length=0.5))
    shared = in_windows(with_windows(prepared, prepared.pipeline.with_window(0.5)), longest=2.0)[0]
    alone = identify_recording(half, recording)[0]
    np.testing.assert_allclose(shared.fit.theta, alone.fit.theta, 1e-10)
    np.testing.assert_allclose(shared.fit.stderr, alone.fit.stderr, 1e-10)
    np.testing.assert_allclose(shared.held_out_vaf, alone.held_out_vaf, 1e-10)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("length = 1", "length = 100", "the window of 100 s is longer than the recording of 8 s"),
        ("length = 1", "length = 0.02", "cannot determine 4 parameters"),
        ("position_cutoff = 40", "position_cutoff = 600", "must lie between 0 and 500 Hz"),
        ("step = 0.1", "step = 0.1\nmin_velocity = 1000", "no sample is left"),
        ("human = true", 'human = true\n[trust]\nparameters = ["stifness"]', "did you mean 'stiffness'"),
        ("[filter]", "[filter]\nmeasured_derivatives = true", "needs a velocity column"),
        ("[filter]", '[filter]\nmode = "window"', "shorter than the filters' transients"),
    ],
)
def test_what_cannot_be_done_is_said(old: str, new: str, message: str) -> None:
    text = JOB.replace(old, new, 1)
    if 'mode = "window"' in text:
        text = text.replace("length = 1", "length = 0.2")
    with pytest.raises(ValueError, match=message):
        identify_recording(parse_job(text), joint())


def test_measured_derivatives_are_used() -> None:
    recording = joint()
    velocity = np.gradient(recording.position, 1e-3, axis=0)
    measured = replace(recording, velocity=velocity, position=recording.position + 0.0)
    text = JOB.replace("[filter]", "[filter]\nmeasured_derivatives = true\n")
    plain, fed = identify_recording(parse_job(JOB), recording)[0], identify_recording(parse_job(text), measured)[0]
    np.testing.assert_allclose(fed.fit.theta[:, 2], plain.fit.theta[:, 2], rtol=1e-2)
    wrong = identify_recording(parse_job(text), replace(measured, velocity=2 * velocity))[0]
    np.testing.assert_allclose(wrong.fit.theta[:, 1], plain.fit.theta[:, 1] / 2, rtol=0.05)


def test_joints_side_by_side_are_solved_and_judged_each_by_itself() -> None:
    good = joint()
    unrelated = np.random.default_rng(2).normal(size=good.torque.shape).cumsum(axis=0)
    both = replace(
        good,
        position=np.concatenate([good.position, 2 * good.position], axis=1),
        position_noise=None,
        torque=np.concatenate([good.torque, unrelated], axis=1),
        joints=("revolute", "revolute"),
    )
    alone, paired = (identify_recording(parse_job(JOB), recording)[0] for recording in (good, both))
    assert paired.names[:2] == ("joint1.inertia", "joint1.damping")
    np.testing.assert_allclose(np.asarray(paired.fit.theta)[:, :4], alone.fit.theta)
    np.testing.assert_allclose(np.asarray(paired.fit.stderr)[:, :4], alone.fit.stderr)
    assert alone.verdicts.trusted.mean() > 0.95
    assert paired.verdicts.trusted.mean() < 0.05
    assert all("joint 2: " in reason for reason in paired.verdicts.reason if reason)


@pytest.mark.slow
def test_emps_is_the_published_joint(data_folder: Path) -> None:
    job = parse_job(
        """
        [recording]
        file = "emps/DATA_EMPS.mat"
        joint = "prismatic"
        time = "t"
        position = "qm"
        torque = { column = "vir", unit = "V", gain = "35.1507 N/V" }
        [model]
        robot = { offset = true }
        [filter]
        position_cutoff = 100
        decimation_cutoff = 20
        [window]
        length = 5
        step = 0.2
        noise = "filtered"
        """,
        data_folder,
    )
    prepared = prepare(job.pipeline_for(job.load()), job.load())
    windows = in_windows(prepared)[0]
    whole = in_windows(replace(prepared, pipeline=prepared.pipeline.with_window(24.8)))[0]
    published = {"inertia": 95.1089, "viscous_friction": 203.5034, "coulomb_friction": 20.3935}
    found = dict(zip(whole.names, np.asarray(whole.fit.theta)[0], strict=True))
    assert found["inertia"] == pytest.approx(published["inertia"], rel=0.01)
    assert found["viscous_friction"] == pytest.approx(published["viscous_friction"], rel=0.02)
    assert found["coulomb_friction"] == pytest.approx(published["coulomb_friction"], rel=0.02)
    mass = np.asarray(windows.fit.theta)[:, windows.names.index("inertia")]
    np.testing.assert_allclose(mass, published["inertia"], rtol=0.02)


def test_the_ankle_is_right_but_for_a_reflex(data_folder: Path) -> None:
    estimates = identify(ankle_job(data_folder, "z_df2.csv", "{ offset = false }", 0.5))[0]
    median = dict(zip(estimates.names, np.nanmedian(estimates.value, axis=0), strict=True))
    # Ordinary least squares weighs slow motion more, and finds 64 N m/rad and 0.72 N m s/rad.
    assert median["stiffness"] == pytest.approx(69, abs=3)
    assert median["damping"] == pytest.approx(0.62, abs=0.06)
    assert median["inertia"] == pytest.approx(0.0146, abs=0.0006)
    assert np.nanmean(estimates.held_out_vaf) > 0.9
    assert "a stretch reflex" in estimates.lacking["stiffness"]
    assert "stiffness would change by -" in estimates.lacking["stiffness"]
    assert not estimates.verdicts.trusted.any()
    # Beside a reflex the record shows something that yields: the reflex alone does not say what it spares.
    assert "how far inertia would change cannot be told; it lacks more than that" in estimates.lacking["inertia"]
    for name, mean in zip(estimates.names, estimates.mean_over_trusted(), strict=True):
        assert np.isfinite(mean) == (name not in estimates.lacking) == (estimates.trusted_in(name).mean() > 0.9)


def test_the_ankle_with_a_strong_reflex_lacks_one(data_folder: Path) -> None:
    estimates = identify(ankle_job(data_folder, "z_pf.npz", "{ offset = false }", 0.5))[0]
    counts = estimates.verdicts.counts()
    assert counts["trusted"] == 0
    assert counts["poor fit"] > 0.9 * sum(counts.values())
    assert "a stretch reflex" in estimates.lacking["stiffness"]


PENDULUM = """
[recording]
file = "double_pendulum/20220812-060440-PM_measured.csv"
time = "time"
position = ["pos1", "pos2"]
torque = ["tau1", "tau2"]
[model.arm]
gravity = true
zero = "hanging"
lengths = [0.3]
rotor = true
viscous = true
coulomb = true
[filter]
position_cutoff = 20
position_order = 4
decimation_cutoff = 10
[window]
length = 5
step = 0.5
min_velocity = 0.1
"""


@pytest.mark.slow
def test_the_double_pendulum_is_near_its_owners_own_fit(data_folder: Path) -> None:
    """Windows of one file by ordinary least squares; all four together stand in experiments/real_recordings.py."""
    estimates = identify(parse_job(PENDULUM + 'noise = "filtered"', data_folder))[0]
    found = dict(zip(estimates.names, estimates.mean_over_trusted(), strict=True))
    assert estimates.verdicts.trusted.mean() > 0.7
    assert found["inertia_1"] - found["inertia_3"] == pytest.approx(0.1106, rel=0.15)
    assert found["gravity_2"] == pytest.approx(0.1111, rel=0.15)
    assert found["inertia_3"] == pytest.approx(0.0239, rel=0.15)
    assert found["gravity_1"] == pytest.approx(0.3491, rel=0.15)
    assert estimates.torque.shape[1] == 2


@pytest.mark.slow
def test_the_friction_of_the_double_pendulum_is_not_what_its_model_says(data_folder: Path) -> None:
    """Joint 2 hardly moves in this file, and its friction is larger than its torque."""
    estimates = identify(parse_job(PENDULUM, data_folder))[0]
    assert not estimates.trusted.any()
    assert "gravity_2" in estimates.lacking
    assert "dry friction of joint 2" in estimates.lacking["gravity_2"]


def arm_recording(stiffness: np.ndarray, noise: float = 0.01) -> Recording:
    """An arm that a robot moves for 12 s, each joint with frequencies of its own."""
    t = np.arange(0, 12, 0.002)
    q = np.stack([0.1 * np.sin(9 * t) + 0.05 * np.sin(21 * t), 1 + 0.1 * np.sin(13 * t) + 0.05 * np.sin(29 * t)], 1)
    dq = np.stack([0.9 * np.cos(9 * t) + 1.05 * np.cos(21 * t), 1.3 * np.cos(13 * t) + 1.45 * np.cos(29 * t)], 1)
    ddq = -np.stack([8.1 * np.sin(9 * t) + 22.05 * np.sin(21 * t), 16.9 * np.sin(13 * t) + 42.05 * np.sin(29 * t)], 1)
    theta = np.concatenate([[0.27, 0.08, 0.07, 2.4, 1.2, 1.2, 1.4], np.ravel(stiffness)])
    torque = np.asarray(PlanarArm((0.0, 1.0)).torque(theta, q, dq, ddq))
    torque = torque + noise * np.random.default_rng(0).normal(size=torque.shape)
    return recording_from_arrays(time=t, position=q, torque=torque)


ARM = """
recording = {}
[model]
arm = { equilibrium = [0, 1] }
[filter]
decimation_cutoff = 20
[window]
length = 3
step = 0.5
"""


@pytest.mark.slow
def test_an_arm_is_identified_in_windows() -> None:
    stiffness = np.array([[29.0, 14.4], [14.4, 17.1]])
    estimates = identify_recording(parse_job(ARM), arm_recording(stiffness))[0]
    assert estimates.verdicts.trusted.all()
    np.testing.assert_allclose(estimates.mean_over_trusted()[-4:], np.ravel(stiffness), rtol=0.02)
    low, high = confidence_interval(estimates.fit.theta, estimates.fit.stderr, estimates.fit.dof)
    covered = (low[:, -4:] < np.ravel(stiffness)) & (np.ravel(stiffness) < high[:, -4:])
    assert covered.mean() > 0.8


@pytest.mark.parametrize(
    ("stiffness", "why"),
    [
        pytest.param(
            np.array([[29.0, 40.0], [40.0, 17.1]]), "not positive definite", id="indefinite", marks=pytest.mark.slow
        ),
        pytest.param(np.array([[29.0, 20.0], [2.0, 17.1]]), "not symmetric", id="asymmetric"),
    ],
)
def test_an_impossible_stiffness_is_not_trusted(stiffness: np.ndarray, why: str) -> None:
    verdicts = identify_recording(parse_job(ARM), arm_recording(stiffness))[0].verdicts
    assert (verdicts.verdict == "poor fit").all()
    assert all(why in reason for reason in verdicts.reason)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (ARM.replace("arm = { equilibrium = [0, 1] }", "arm = { equilibrium = [0] }"), "equilibrium"),
        (ARM.replace("arm =", "human = true\narm ="), "stands alone"),
        (ARM.replace("[0, 1]", '"zero"'), "a list of numbers"),
    ],
    ids=["one angle", "arm and human", "words"],
)
def test_bad_arms_are_refused(text: str, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        parse_job(text)


def test_degrees_and_swapped_joints_are_not_believed() -> None:
    good = arm_recording(np.array([[29.0, 14.4], [14.4, 17.1]]))
    with pytest.raises(ValueError, match="degrees"):
        identify_recording(parse_job(ARM), replace(good, position=np.rad2deg(good.position)))
    with pytest.raises(ValueError, match="degrees"):
        parse_job(ARM.replace("[0, 1]", "[0, 57]"))
    swapped = replace(good, position=good.position[:, ::-1], torque=good.torque[:, ::-1])
    verdicts = identify_recording(parse_job(ARM.replace("[0, 1]", "[1, 0]")), swapped)[0].verdicts
    assert not verdicts.trusted.any()


def test_an_arm_needs_two_joints() -> None:
    one = arm_recording(np.eye(2))
    one = replace(one, position=one.position[:, :1], torque=one.torque[:, :1], joints=("revolute",))
    with pytest.raises(ValueError, match="two revolute joints"):
        identify_recording(parse_job(ARM), one)
