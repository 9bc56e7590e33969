"""A stiffness that moves, followed through the whole pipeline in place of windows."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from factories.joints import sines
from jaximp.identification.estimates import Estimates
from jaximp.jobs.job import WindowJob, parse_job
from jaximp.jobs.run import identify_recording, infer_recording
from jaximp.recordings.load import recording_from_arrays
from jaximp.reports import estimates as report
from jaximp.trust.verdicts import TRUSTED, WEAK
from jaximp.types import Recording

RATE, SECONDS, CHANGE = 200.0, 16.0, 7.3
REST, FADE = (10.0, 14.0), 0.8  # s
INERTIA, DAMPING, BEFORE, AFTER = 0.02, 1.0, 60.0, 110.0
JOB = """
[recording]
file = "in the test"
[model]
human = { offset = false }
[filter]
position_cutoff = 40
decimation_cutoff = 30
"""


def stiffness(time: np.ndarray) -> np.ndarray:
    return np.where(time < CHANGE, BEFORE, AFTER)


def recorded(seed: int = 0) -> Recording:
    """Lines of five frequencies, at rest for a while: they come and go by a raised sine."""
    time, random = np.arange(round(SECONDS * RATE)) / RATE, np.random.default_rng(seed)
    s, ds, dds = sines(time, tuple((0.02 / f**0.5, f, random.uniform(0, 2 * np.pi)) for f in (0.9, 1.7, 3.1, 5.3, 8.3)))
    still = np.clip(np.minimum(time - REST[0], REST[1] - time) / FADE + 1, 0, 1) * np.pi
    fading = np.where((still > 0) & (still < np.pi), 1.0, 0.0)
    sign = np.where(time < np.mean(REST), 1, -1) * np.pi / FADE
    m, dm, ddm = (1 + np.cos(still)) / 2, -fading * sign * np.sin(still) / 2, -fading * sign**2 * np.cos(still) / 2
    q, dq, ddq = m * s, m * ds + dm * s, m * dds + 2 * dm * ds + ddm * s
    torque = INERTIA * ddq + DAMPING * dq + stiffness(time) * q + random.normal(0, 0.02, len(time))
    return recording_from_arrays(time, q, torque)


def job(tables: str, text: str = JOB) -> WindowJob:
    found = parse_job(text + tables)
    assert isinstance(found, WindowJob)
    return found


@cache
def followed() -> Estimates:
    return identify_recording(job('[track]\ngrid = 0.1\nstays = ["inertia"]\n'), recorded())[0]


def middle() -> np.ndarray:
    return (followed().start + followed().end) / 2


def test_a_path_follows_a_step_that_windows_blur() -> None:
    time = middle()
    near = (np.abs(time - CHANGE) < 1.0) & (np.abs(time - CHANGE) > 0.15)
    path, truth = followed()["stiffness"], stiffness(time)
    low, high = path.interval()
    assert ((low <= truth) & (truth <= high))[near].mean() > 0.9
    assert np.abs(path.value - truth)[near].max() < 0.1 * (AFTER - BEFORE)
    assert (followed().verdicts.verdict[near] == TRUSTED).all()

    windows = identify_recording(job("[window]\nlength = 2.0\nstep = 0.1\n"), recorded())[0]
    around = (windows.start < CHANGE - 0.3) & (windows.end > CHANGE + 0.3)
    blurred = np.abs(windows["stiffness"].value - stiffness((windows.start + windows.end) / 2))
    assert blurred[around].max() > 0.2 * (AFTER - BEFORE)


def test_what_moves_is_told_and_when_it_jumps() -> None:
    assert set(followed().changed) == {"stiffness"}
    course = followed().changed["stiffness"]
    assert course.values == pytest.approx((BEFORE, AFTER), rel=0.02)
    assert course.at == pytest.approx((CHANGE,), abs=0.15)
    assert followed().steady[0] == "inertia"
    assert "stiffness" not in followed().steady
    (track,) = followed().tracks
    (jump,) = track.jumps("stiffness")
    assert abs(jump.time - CHANGE) < 0.15
    assert jump.probability > 0.9
    assert track.moves("inertia") == 0


def test_a_parameter_that_stays_is_one_value() -> None:
    assert np.ptp(followed()["inertia"].value) < 1e-9
    low, high = followed()["inertia"].interval()
    assert low[0] < INERTIA < high[0]


def test_at_rest_points_are_not_trusted() -> None:
    resting = (middle() > REST[0] + 1.2) & (middle() < REST[1] - 1.2)  # the stretch around them is, too
    assert (followed().verdicts.verdict[resting] == WEAK).all()
    assert followed().trusted[middle() < 9].mean() > 0.9


def test_a_row_of_the_table_is_a_point() -> None:
    table = report.estimates_table(followed()).to_pandas()
    np.testing.assert_allclose(np.diff(table["start_s"]), 0.105)  # whole rows that say something new
    assert len(table) == np.ceil(SECONDS / 0.105)
    known = table["stiffness_filtered"][table["start_s"] > 3]
    assert (known - stiffness(table["start_s"][known.index])).abs().median() < 2
    assert table["stiffness_jump"].sum() > 0.9
    # What is known of a point is more than what was known when it had just passed.
    assert (table["stiffness_stderr"] < table["stiffness_filtered_stderr"] * 1.05).mean() > 0.9


@pytest.mark.parametrize(
    ("tables", "text", "message"),
    [
        ("[track]\n[window]\nstep = 1.0\n", JOB, "window.step has no meaning beside"),
        ('[track]\n[window]\nlength = "all"\n', JOB, "give seconds"),
        ('[track]\nstays = ["mass"]\n', JOB, "track.stays has an unknown parameter 'mass'"),
        ('[track]\n[window]\nnoise = "filtered"\n', JOB, "leave out window.noise"),
        ("[track]\ngrid = 0\n", JOB, "track.grid is 0"),
        ("[track]\n", JOB.replace("offset = false", "reflex = true"), "a reflex is identified in windows"),
        ("[track]\n", JOB.replace("[model]", '[model]\ndrive = "free"'), "a free joint"),
    ],
)  # fmt: skip
def test_what_cannot_be_followed_is_refused(tables: str, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        identify_recording(job(tables, text), recorded())


def test_a_delay_is_found_before_the_path() -> None:
    whole = recorded()
    late = replace(whole, torque=np.roll(whole.torque, 3, axis=0), delay_unknown=True)
    notes = identify_recording(job('[track]\ngrid = 0.1\nstays = ["inertia"]\n'), late)[0].notes
    assert any("was moved by so much" in note for note in notes)


def test_posteriors_are_those_of_windows() -> None:
    with pytest.raises(ValueError, match="leave out \\[track\\]"):
        infer_recording(job("[track]\n"), recorded())


def test_the_report_speaks_of_points(tmp_path: Path) -> None:
    content = report.summary([followed()], job("[track]\n"), recorded())
    assert content["kind"] == "point"
    assert content["path"]["stiffness"]["jumps"][0]["time_s"] == pytest.approx(CHANGE, abs=0.15)
    report.write_results(tmp_path, [followed()], [], job("[track]\n"), recorded())
    text = (tmp_path / "report.html").read_text()
    assert "How parameters move" in text
    assert "points can be trusted" in text
    assert (tmp_path / "parameters.png").is_file()


@pytest.mark.slow
@pytest.mark.compiles
def test_joints_side_by_side_have_a_path_each() -> None:
    one, other = recorded(), recorded(1)
    both = recording_from_arrays(
        one.time, np.hstack([one.position, 0.5 * other.position]), np.hstack([one.torque, 0.5 * other.torque])
    )
    found = identify_recording(job('[track]\ngrid = 0.1\nstays = ["joint1.inertia", "joint2.inertia"]\n'), both)[0]
    assert found.names[2] == "joint1.stiffness"
    assert len(found.tracks) == 2
    np.testing.assert_allclose(found.value[:, :3], followed().value, rtol=1e-6)
    assert set(found.changed) == {"joint1.stiffness", "joint2.stiffness"}
    columns = report.estimates_table(found).column_names
    assert {"joint1.stiffness_jump", "joint2.damping_filtered"} <= set(columns)


@pytest.mark.slow
@pytest.mark.compiles
@pytest.mark.parametrize("method", [1, 2, 3, 4])
def test_a_human_in_a_robot_is_followed_by_every_method(method: int) -> None:
    held, alone = (with_robot(recorded(seed), human) for seed, human in ((0, True), (0, False)))
    text = JOB.replace("[model]", f"[model]\nrobot = {{ gravity = false, coulomb = false }}\nmethods = [{method}]")
    text += '[robot_recording]\nfile = "in the test"\n'
    found = identify_recording(job('[track]\ngrid = 0.1\nstays = ["inertia"]\n', text), held, alone)[0]
    assert found.method == method
    time = (found.start + found.end) / 2
    far = np.abs(time - CHANGE) > 0.5
    low, high = found["stiffness"].interval()
    truth = stiffness(time)
    assert ((low <= truth) & (truth <= high))[far & found.trusted].mean() > 0.8
    assert np.median(high - low) < 0.1 * (AFTER - BEFORE)
    assert (found["inertia"].interval()[0] <= INERTIA).all()
    assert (found["inertia"].interval()[1] >= INERTIA).all()


def with_robot(human: Recording, held: bool) -> Recording:
    """The robot that holds the joint, or makes the same motion alone."""
    q = human.position[:, 0]
    dq = np.gradient(q, human.time)
    robot = 0.05 * np.gradient(dq, human.time) + 0.7 * dq
    noise = np.random.default_rng(7).normal(0, 0.02, len(q))
    return recording_from_arrays(human.time, q, robot + (human.torque[:, 0] if held else noise))
