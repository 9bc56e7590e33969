"""Joints that their own torque moves: instrumental variables, and what is said without a reference."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from factories import joints
from factories.joints import TRUTH
from factories.studies import run
from jaximp.identification.estimates import Estimates
from jaximp.identification.instruments import explained_motion, moved_by
from jaximp.jobs import parse_job
from jaximp.jobs.run import identify_recording
from jaximp.recordings import recording_from_arrays, save_recording
from jaximp.types import Recording

RATE, SAMPLES = 500.0, 12000
NAMES = ("inertia", "damping", "stiffness")
TRUE = np.array([TRUTH[name] for name in NAMES])
JOB = joints.JOB.replace("length = 1", "length = 3").replace("step = 0.1", "step = 0.5")
FREE = JOB.replace("human = true", 'human = true\ndrive = "free"')
IMPOSED = JOB.replace("human = true", 'human = true\ndrive = "position"')


def band(random: np.random.Generator, low: float, high: float) -> np.ndarray:
    """A signal of unit variance between two frequencies [Hz], as its spectrum."""
    f = np.fft.rfftfreq(SAMPLES, 1 / RATE)
    lines = (random.normal(size=len(f)) + 1j * random.normal(size=len(f))) * ((f > low) & (f < high))
    return lines / np.fft.irfft(lines, SAMPLES).std()


def driven(seed: int, own: float = 0.8, softer: float = 1.0) -> Recording:
    """A joint and a rig with a third of its inertia and stiffness, driven by a torque of 4 N m, and by one of its own
    of `own` N m, which turns as slowly as a muscle's. Its stiffness may change in the middle."""
    random, s = np.random.default_rng(seed), 2j * np.pi * np.fft.rfftfreq(SAMPLES, 1 / RATE)
    command, e = 4 * band(random, 0.4, 7), band(random, 0.0, 200) / (1 + 0.05 * s)
    e *= own / np.fft.irfft(e, SAMPLES).std()
    halves = []
    for stiffness in (TRUE[2], softer * TRUE[2]):
        joint, rig = TRUE[0] * s**2 + TRUE[1] * s + stiffness, (TRUE[0] * s**2 + TRUE[2]) / 3
        q = (command - e) / (joint + rig)
        halves.append([np.fft.irfft(x, SAMPLES) for x in (q, command - rig * q)])
    first = np.arange(SAMPLES) < SAMPLES / 2
    q, torque = (np.where(first, *both) for both in zip(*halves, strict=True))
    torque += TRUTH["offset_torque"] + 0.3 * random.normal(size=SAMPLES)
    return recording_from_arrays(np.arange(SAMPLES) / RATE, q, torque, command=np.fft.irfft(command, SAMPLES))


def found(job: str, recording: Recording) -> Estimates:
    return identify_recording(parse_job(job), recording)[0]


def off(estimates: Estimates) -> np.ndarray:
    return np.median(estimates.value[:, :3], axis=0) / TRUE - 1


def said(estimates: Estimates, words: str) -> bool:
    return any(words in note for note in estimates.notes)


def test_instrumental_variables_are_right_where_least_squares_are_not() -> None:
    inside = []
    for seed in range(4):
        recording = driven(seed)
        assert off(found(IMPOSED, recording)).min() < -0.1
        estimates = found(FREE, recording)
        assert estimates.trusted.mean() > 0.9
        assert said(estimates, "estimates are instrumental variables by the command; least squares would be off")
        low, high = (x[::6, :3] for x in estimates.interval())  # windows side by side
        inside.append((low <= TRUE) & (high >= TRUE))
    assert 0.9 < np.mean(inside) < 1


def test_a_stiffness_that_changes_keeps_its_instruments() -> None:
    """One half of the record tells nothing wrong of the other."""
    estimates = found(FREE, driven(1, own=0.4, softer=0.5))
    low, high = estimates.interval()
    middle = SAMPLES / RATE / 2
    for which, stiffness in ((estimates.end < middle, TRUE[2]), (estimates.start > middle, TRUE[2] / 2)):
        assert np.mean((low[which, 2] <= stiffness) & (stiffness <= high[which, 2])) > 0.8
        assert np.median(estimates.value[which, 2]) == pytest.approx(stiffness, rel=0.08)


def test_a_command_speaks_where_nothing_was_declared() -> None:
    estimates = found(JOB, driven(3))
    assert not estimates.trusted.any()
    assert "the motion that the joint's own torque makes" in estimates.lacking["stiffness"]
    assert "model.drive = 'free'" in estimates.verdicts.complaint()
    assert said(estimates, "instrumental variables by the command find inertia 0.")
    harmless = found(JOB, driven(3, own=1e-3))
    assert harmless.trusted.all()


def test_declared_and_assumed_motion() -> None:
    recording = replace(driven(3, own=1e-3), command=None)
    assert said(found(JOB, recording), "the motion is taken as imposed; if the joint's own torque")
    assert not said(found(IMPOSED, recording), "imposed")
    with pytest.raises(ValueError, match=r"model.drive is 'torque': there are: 'position', 'free'"):
        parse_job(JOB.replace("human = true", 'human = true\ndrive = "torque"'))


def test_later_motion_tells_of_own_torque_where_nothing_is_known() -> None:
    words = "what is left of the torque belongs with later motion"
    assert said(found(JOB, replace(driven(1), command=None)), words)
    quiet = replace(driven(3, own=1e-3), command=None)
    late = replace(quiet, torque=np.roll(quiet.torque, 3, axis=0))
    estimates = found(JOB, late)
    assert not estimates.trusted.any()
    assert not said(estimates, words)


def test_weak_instruments_are_refused() -> None:
    recording = driven(3)
    unrelated = np.random.default_rng(1).normal(size=recording.position.shape)
    estimates = found(FREE, replace(recording, command=unrelated))
    assert not estimates.trusted.any()
    assert not any(estimates.trusted_in(name).any() for name in NAMES)
    assert "the command explains too little of the motion" in estimates.verdicts.complaint()


def test_a_free_joint_without_a_reference_is_told_its_bias() -> None:
    """As much as least squares are off where nothing but the joint itself resists its torque, and more elsewhere."""
    recording = replace(driven(3), command=None)
    estimates = found(FREE, recording)
    assert not any(estimates.trusted_in(name).any() for name in NAMES)
    assert "the joint is free, and noise of its torque may move it" in estimates.lacking["inertia"]
    assert "map a command or reference" in estimates.verdicts.complaint()
    quiet = found(FREE, replace(driven(2, own=1e-3), command=None))
    assert quiet.trusted.all()


def test_a_joint_moves_by_its_own_torque_as_newton_says() -> None:
    torque = np.fft.irfft(band(np.random.default_rng(3), 0.5, 5), SAMPLES)
    inside = np.hanning(SAMPLES)
    acceleration, velocity, position = moved_by(torque * inside, TRUE, RATE).T
    back = TRUE @ np.stack([acceleration, velocity, position])
    np.testing.assert_allclose(back, -torque * inside, atol=1e-9)
    np.testing.assert_allclose(np.gradient(position, 1 / RATE)[5:-5], velocity[5:-5], atol=2e-3 * velocity.std())


def test_what_follows_the_command_is_explained_and_nothing_else() -> None:
    recording = driven(0, own=0.0)
    explained = explained_motion(recording, "command")
    inner = slice(1000, -1000)
    left = (recording.position - explained)[inner].std() / recording.position[inner].std()
    assert left < 0.1
    unrelated = replace(recording, command=np.random.default_rng(0).normal(size=recording.position.shape))
    assert explained_motion(unrelated, "command").std() < 0.2 * recording.position.std()


def test_joints_side_by_side_have_instruments_of_their_own() -> None:
    one, two = driven(3), driven(1)
    both = {
        name: np.concatenate([getattr(one, name), getattr(two, name)], axis=1)
        for name in ("position", "torque", "command")
    }
    together = found(FREE, recording_from_arrays(one.time, **both))
    alone = found(FREE, two)
    np.testing.assert_allclose(together.value[:, 4:], alone.value, rtol=1e-6)


def test_where_there_are_no_instruments_it_is_said() -> None:
    filtered = FREE.replace("length = 3", 'length = 3\nnoise = "filtered"')
    assert said(found(filtered, driven(3)), "model.drive = 'free' changes nothing here")


@pytest.mark.slow
def test_a_batch_finds_the_same(tmp_path: Path) -> None:
    """From files, whose command is a column like any other."""
    mapping = '[recording]\nfile = "none.parquet"\ntime = "time_s"\nposition = "position_rad"\ntorque = "torque_Nm"'
    job = FREE.replace("recording = {}", f'{mapping}\ncommand = "command_Nm"')
    for seed in range(2):
        save_recording(driven(seed), tmp_path / f"{seed}.parquet")
    (tmp_path / "study.csv").write_text("file\n0.parquet\n1.parquet\n")
    (tmp_path / "job.toml").write_text(job)
    assert run(tmp_path, tmp_path / "out").failed == []
    windows = pd.read_parquet(tmp_path / "out" / "estimates")
    for seed, (_, table) in enumerate(windows.groupby("recording", observed=True)):
        expected = found(FREE, driven(seed))
        assert table["verdict"].tolist() == expected.verdicts.verdict.tolist()
        np.testing.assert_allclose(table["stiffness"], expected.value[:, 2], rtol=1e-12)
