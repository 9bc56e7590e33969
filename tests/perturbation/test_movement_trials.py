"""Recorded movements, perturbed and not: from files to arrays that begin their perturbation at one sample."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from factories.recordings import cut
from jaximp.jobs.job import parse_job
from jaximp.models.kinematics import ArmGeometry
from jaximp.perturbation.onsets import find_onset
from jaximp.perturbation.reading import read_trials
from jaximp.perturbation.sensors import judge_sensors
from jaximp.perturbation.trials import VOLUNTARY_DELAY, Handle, Trials
from jaximp.recordings.load import load_trial_table
from jaximp.recordings.save import save_recording, save_trial_table
from jaximp.signals import savitzky_golay, savitzky_golay_gain
from jaximp.simulation.arm_recordings import Sensors, arm_movements, as_recordings
from jaximp.simulation.neuromuscular import ANGLES, POSTURES, NeuromuscularArm, Reaches, hold_posture
from jaximp.types import Recording

HANDLE = Handle((5.0, 5.0), (20.0, 20.0))
EXACT = Sensors(position_step=0.0)
COLUMNS: dict[str, Any] = {"time": "time_s"}
COLUMNS |= {name: [f"{name}{j}_{unit}" for j in (1, 2)] for name, unit in
            (("position", "m"), ("torque", "N"), ("command", "N"))}  # fmt: skip


@pytest.fixture(scope="module")
def simulated() -> Reaches:
    return arm_movements(NeuromuscularArm(), perturbed=6, unperturbed=4, duration=1.4)


@pytest.fixture(scope="module")
def recorded(simulated: Reaches) -> list[Recording]:
    return as_recordings(simulated.movements, Sensors())


@pytest.fixture(scope="module")
def pushed(simulated: Reaches) -> np.ndarray:
    return np.flatnonzero(np.abs(simulated.movements.command).max(axis=(1, 2)) > 0)


# --- round trips ------------------------------------------------------------------------------------------------------


def shares_of_error(read: Trials, truth: Trials, which: np.ndarray, every: int) -> dict[str, float]:
    """Root mean square error after the onset, as a share of what the perturbations make."""
    first, samples = int(read.onset[0]), round(VOLUNTARY_DELAY * read.sample_rate)
    free = np.flatnonzero(np.abs(truth.command).max(axis=(1, 2)) == 0)
    shares = {}
    for name in ("position", "velocity", "acceleration"):
        values = np.asarray(getattr(truth, name))
        starts = np.asarray(truth.onset) // every * every
        after = np.stack([row[start::every][:samples] for row, start in zip(values, starts, strict=True)])
        error = np.asarray(getattr(read, name))[:, first : first + samples] - after[which]
        made = after[which] - after[free].mean(axis=0)
        shares[name] = float(np.sqrt((error**2).mean() / (made**2).mean()))
    return shares


@pytest.mark.slow
@pytest.mark.parametrize("every", [1, 2])
def test_movements_are_those_of_the_simulation(simulated: Reaches, pushed: np.ndarray, every: int) -> None:
    """The bounds are a little above what was measured; the filter takes that much off the perturbation's spectrum."""
    truth = simulated.movements
    perturbed, unperturbed, notes = read_trials(as_recordings(truth, Sensors(), every=every))
    assert (len(perturbed), len(unperturbed or [])) == (6, 4)
    assert perturbed.sample_rate == 4000 / every
    error = shares_of_error(perturbed, truth, pushed, every)
    assert error["position"] < 0.001
    assert error["velocity"] < 0.008
    assert error["acceleration"] < 0.075
    first = int(perturbed.onset[0])
    command = np.asarray(perturbed.command)
    assert (command[:, : first + 1] == 0).all()
    assert (np.abs(command[:, first + 2]).max(axis=1) > 0).all()
    assert "of the jerk of the perturbations: little enough" in notes[0]


def test_as_measured_nothing_is_filtered(simulated: Reaches, pushed: np.ndarray) -> None:
    truth = simulated.movements
    perturbed, unperturbed, _ = read_trials(as_recordings(truth, EXACT, every=1), smooth=False)
    assert unperturbed is not None
    first, n = int(perturbed.onset[0]), perturbed.position.shape[1]
    for row, k in enumerate(pushed):
        part = slice(int(truth.onset[k]) - first, int(truth.onset[k]) - first + n)
        np.testing.assert_allclose(perturbed.position[row], truth.position[k, part], atol=1e-15)
        np.testing.assert_array_equal(perturbed.force[row], truth.force[k, part])
    # Unperturbed movements begin where the hand passes the place: at most two samples from the simulation's.
    for row, k in enumerate(np.setdiff1d(np.arange(10), pushed)):
        start = int(truth.onset[k]) - first
        apart = np.abs(np.asarray(truth.position[k, start : start + n]) - np.asarray(unperturbed.position[row])).max()
        assert apart < 2.5 * np.abs(truth.velocity[k]).max() / 4000


def test_filtered_alike_the_handle_still_is_one(recorded: list[Recording]) -> None:
    """Smoothing acts on force and motion: what links them stays, but for what the differentiator lacks."""
    perturbed, _, _ = read_trials(recorded)
    force = HANDLE.force(savitzky_golay(np.moveaxis(np.asarray(perturbed.command), 1, 0), 2000.0).swapaxes(0, 1),
                           perturbed.velocity, perturbed.acceleration)  # fmt: skip
    inside = slice(60, -60)
    assert np.abs(force - perturbed.force)[:, inside].max() < 0.15
    assert np.abs(perturbed.force).max() > 20


def test_files_and_a_trial_column_give_the_same(tmp_path: Path, recorded: list[Recording]) -> None:
    files = [tmp_path / f"trial_{k + 1}.csv" for k in range(len(recorded))]
    for file, recording in zip(files, recorded, strict=True):
        save_recording(recording, file)
    save_trial_table(recorded, tmp_path / "table.parquet")
    arm = "[model.arm]\nlengths = [0.29, 0.34]\n[trials]\n" + "\n".join(
        f"{k} = {json.dumps(v)}" for k, v in COLUMNS.items()
    )
    jobs = [parse_job(f"{arm}\n{line}", tmp_path) for line in
            ("file = 'table.parquet'", "files = 'trial_*.csv'", f"files = {[f.name for f in files]}")]  # fmt: skip
    assert jobs[1].files() == files  # trial 10 after trial 9
    (first, free, _), *others = [job.trials.load() for job in jobs if job.trials]
    for perturbed, unperturbed, _ in others:
        np.testing.assert_array_equal(perturbed.position, first.position)
        np.testing.assert_array_equal(perturbed.command, first.command)
        np.testing.assert_array_equal(unperturbed.acceleration, free.acceleration)


def test_trials_of_a_table_may_restart_or_run_on(tmp_path: Path, recorded: list[Recording]) -> None:
    tables = []
    for shift in (0.0, 10.0):
        moved = [replace(r, time=r.time + shift * k) for k, r in enumerate(recorded[:2])]
        save_trial_table(moved, tmp_path / "table.csv")
        tables.append(load_trial_table(tmp_path / "table.csv", joint="prismatic", **COLUMNS))
    for restarted, ran_on in zip(*tables, strict=True):
        np.testing.assert_array_equal(restarted.position, ran_on.position)
    assert tables[1][1].time[0] == 10
    assert tables[1][1].name == "table, trial 2"


def test_trial_table_names_its_trial(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(
        "n,t,q,f\n" + "".join(f"{k},{t},{i},{i % 2}\n" for k in (1, 5) for i, t in enumerate((0, 1, 1, 2)))
    )
    columns: dict[str, Any] = {"time": "t", "position": "q", "torque": "f"}
    with pytest.raises(ValueError, match=r"t\.csv, trial 1: 't', row 3.*repeats"):
        load_trial_table(tmp_path / "t.csv", "n", **columns)
    with pytest.raises(ValueError, match="'trial' is not there"):
        load_trial_table(tmp_path / "t.csv", **columns)
    with pytest.raises(ValueError, match=r"unknown key 'torgue'; did you mean 'torque'"):
        load_trial_table(tmp_path / "t.csv", "n", **columns, torgue="f")


def test_postures_are_read() -> None:
    noise = np.zeros((3, 6000, 6))
    truth = jax.jit(lambda: hold_posture(NeuromuscularArm(), POSTURES[:3], ANGLES[[0, 5, 9]], noise, onset=0.5))()
    recordings = as_recordings(truth, EXACT, static=True)
    postures, none, _ = read_trials(recordings, "posture", geometry=ArmGeometry((0.29, 0.34)))
    assert none is None
    first, n = int(postures.onset[0]), postures.position.shape[1]
    start = 2000 - 2 * first
    for name, bound in (("position", 1e-3), ("velocity", 1e-3), ("acceleration", 0.02)):
        values = np.asarray(getattr(truth, name))[:, start::2][:, :n]
        made = (values - values[:, :1]).std()
        assert (np.asarray(getattr(postures, name)) - values).std() < bound * made, name


def test_without_a_filter_nothing_is_filtered_and_no_end_is_lost() -> None:
    noise = np.zeros((3, 6000, 6))
    truth = jax.jit(lambda: hold_posture(NeuromuscularArm(), POSTURES[:3], ANGLES[[0, 5, 9]], noise, onset=0.5))()
    recordings = as_recordings(truth, EXACT, static=True)
    postures, _, _ = read_trials(recordings, "posture", cutoff=None)
    assert postures.position.shape == (3, len(recordings[0]), 2)
    np.testing.assert_array_equal(postures.position, [recording.position for recording in recordings])
    np.testing.assert_array_equal(postures.force, [recording.torque for recording in recordings])
    assert np.isnan(postures.velocity).all()
    assert np.isnan(postures.acceleration).all()


def test_measured_derivatives_serve(simulated: Reaches) -> None:
    truth = simulated.movements
    read = [
        replace(r, velocity=np.asarray(truth.velocity[k, ::2]), acceleration=np.asarray(truth.acceleration[k, ::2]))
        for k, r in enumerate(as_recordings(truth, EXACT))
    ]
    perturbed, _, notes = read_trials(read, smooth=False)
    assert (
        shares_of_error(perturbed, truth, np.flatnonzero(np.abs(truth.command).max(axis=(1, 2)) > 0), 2)["acceleration"]
        < 1e-12
    )
    assert "acceleration's noise" in notes[0]


# --- onsets -----------------------------------------------------------------------------------------------------------


def test_onsets_may_be_given(simulated: Reaches, recorded: list[Recording], pushed: np.ndarray) -> None:
    onset = np.full(10, np.nan)
    onset[pushed] = [float(x) // 2 / 2000 for x in np.asarray(simulated.movements.onset)[pushed]]
    found, _, _ = read_trials(recorded)
    given, _, _ = read_trials(recorded, onset=onset.tolist())
    np.testing.assert_array_equal(given.position, found.position)
    silent = [replace(r, command=None) for r in recorded]
    by_handle, _, _ = read_trials(silent, onset=onset.tolist(), handle=HANDLE)
    assert np.abs(by_handle.command - found.command).max() < 10  # of 40 N: the filter's transients at the onset
    unknown, free, notes = read_trials(silent, onset=onset.tolist())
    assert np.isnan(unknown.command).any(axis=(1, 2)).all()
    assert free is not None
    assert any("commands are not known" in note for note in notes)


@pytest.mark.parametrize("trigger", [None, (1, 0.4)])
def test_unperturbed_trials_are_aligned_by_place(recorded: list[Recording], trigger: tuple[int, float] | None) -> None:
    _, unperturbed, _ = read_trials(recorded, trigger=trigger)
    assert unperturbed is not None
    place = np.asarray(unperturbed.position)[:, int(unperturbed.onset[0]), 1]
    np.testing.assert_allclose(place, 0.4, atol=4e-4)


def test_onset_is_found_in_a_motion_too() -> None:
    """From its first sample that differs on, and never in the beginning that stands for what is steady."""
    t = np.arange(1000) / 1000
    for begin in (0.06, 0.3, 0.99):
        motion = np.stack([np.clip(t - begin, 0, None) ** 2, 0 * t], axis=1)
        assert find_onset(motion) == round(1000 * begin)
        late = find_onset(motion + 1e-5 * np.random.default_rng(0).normal(size=motion.shape))
        assert (late is None) == (begin == 0.99)
        assert late is None or 0 <= late - 1000 * begin < 20
    assert find_onset(np.zeros((1000, 2))) is None
    spike = np.zeros((1000, 2))
    spike[500:502] = 1.0
    assert find_onset(spike) is None
    assert find_onset(1e-3 * motion, least=1.0) is None


def test_noise_of_a_logged_command_is_no_perturbation(recorded: list[Recording], pushed: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    noisy = [replace(r, command=r.command + 0.05 * rng.normal(size=r.command.shape)) for r in recorded]  # type: ignore
    perturbed, unperturbed, _ = read_trials(noisy)
    assert (len(perturbed), len(unperturbed or [])) == (6, 4)
    found, exact = (find_onset(np.asarray(some[pushed[0]].command)) for some in (noisy, recorded))
    assert found is not None
    assert exact is not None
    assert 0 <= found - exact < 10


# --- what is refused, and what is said --------------------------------------------------------------------------------


def with_gap(recording: Recording, at: slice) -> Recording:
    valid = recording.valid.copy()
    valid[at] = False
    return replace(recording, valid=valid, position=np.where(valid[:, None], recording.position, np.nan))


def at(k: int, change: Callable[[Recording], Recording]) -> Callable[[list[Recording]], list[Recording]]:
    return lambda all_trials: [*all_trials[:k], change(all_trials[k]), *all_trials[k + 1 :]]


def each(change: Callable[[Recording], Recording]) -> Callable[[list[Recording]], list[Recording]]:
    return lambda all_trials: [change(trial) for trial in all_trials]


def along(direction: tuple[float, float], both_ways: bool = False) -> Callable[[list[Recording]], list[Recording]]:
    """Every command as strong as it was, but this way."""

    def turned(trials: list[Recording]) -> list[Recording]:
        sign = [(-1) ** k if both_ways else 1 for k in range(len(trials))]
        return [replace(r, command=s * np.linalg.norm(r.command, axis=1, keepdims=True) * np.array(direction))  # type: ignore
                for s, r in zip(sign, trials, strict=True)]  # fmt: skip

    return turned


@pytest.fixture
def arranged(recorded: list[Recording], pushed: np.ndarray) -> list[Recording]:
    """Perturbed trials first."""
    rest = np.setdiff1d(np.arange(10), pushed)
    return [replace(recorded[k], name="") for k in (*pushed, *rest)]


BAD: dict[str, tuple[Callable[[list[Recording]], list[Recording]], dict[str, Any], str]] = {
    "task": (lambda r: r, {"task": "postur"}, "task is 'postur': did you mean 'posture'"),
    "no trials": (lambda r: [], {}, "there are no trials"),
    "no hand": (at(1, lambda r: replace(r, joints=("revolute",) * 2)), {}, "trial 2 is not a recording of a hand"),
    "sample rate": (at(1, lambda r: cut(r, slice(None, None, 2))), {}, "trial 2 was sampled at 1000 Hz"),
    "time bases": (at(1, lambda r: replace(r, torque=r.torque[::2])), {}, "trial 2: position and force have different"),
    "no command": (at(1, lambda r: replace(r, command=None)), {}, "trial 2: whether it is perturbed, when and in"),
    "late begin": (at(1, lambda r: cut(r, slice(900, None))), {}, "trial 2 lasts from .* record longer"),
    "begun": (at(1, lambda r: cut(r, slice(1400, None))), {}, "trial 2: its command is not at rest when"),
    "early end": (at(1, lambda r: cut(r, slice(1500))), {}, "trial 2 lasts from 0 to 0.7495 s, and its perturbation"),
    "tiny": (at(1, lambda r: cut(r, slice(80))), {}, "trial 2 has 80 samples, but the filter of 50 Hz takes 155"),
    "gap": (at(1, lambda r: with_gap(r, slice(1400, 1404))), {}, "trial 2 has a gap at 0.7 s"),
    "gap, unperturbed": (at(7, lambda r: with_gap(r, slice(1000, 1004))), {}, "trial 8 has a gap at 0.5 s, and its"),
    "one direction": (along((0.6, 0.8)), {}, "directions of 6 perturbed trials are all the same"),
    "one line": (along((0.6, 0.8), True), {}, "are all along one line and do not span the plane"),
    "no perturbation": (each(lambda r: replace(r, command=0 * r.command)), {}, "no trial is perturbed"),  # type: ignore
    "never passes": (at(7, lambda r: cut(r, slice(1000))), {}, "trial 8 is unperturbed and never passes 0.4 m on"),
    "no such place": (lambda r: r, {"trigger": (1, 0.7)}, "never passes 0.7 m on axis 2"),
    "trigger": (lambda r: r, {"trigger": (2, 0.4)}, "the axes of the hand are 0 and 1"),
    "millimetres": (at(1, lambda r: replace(r, position=1e3 * r.position)), {}, r"trial 2: .*reach.*mm\?"),
    "number of onsets": (lambda r: r, {"onset": [0.7, 0.7]}, "onset has 2 numbers for 10 trials"),
    "onset, no command": (lambda r: r, {"onset": [0.7] * 10}, "trial 7 has an onset, but its command stays"),
    "before": (lambda r: r, {"before": 0.1}, "before is 0.1 s: at least 0.3 s"),
    "after": (lambda r: r, {"after": 0.12}, "after is 0.12 s: at least 0.165 s"),
    "long after": (lambda r: r, {"after": 1.2}, "trial 1 lasts from"),
    "window": (lambda r: r, {"window": -1.0}, "window is -1 s"),
    "no time for it": (lambda r: r, {"window": 115.0}, "115 s after it are needed"),
}  # fmt: skip


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("case", BAD)
def test_bad_trials_are_named(arranged: list[Recording], case: str) -> None:
    spoil, options, message = BAD[case]
    with pytest.raises(ValueError, match=message) as caught:
        read_trials(spoil(arranged), geometry=ArmGeometry((0.29, 0.34)), **options)
    assert "\n" not in str(caught.value)


def test_a_gap_elsewhere_shortens_all_trials(arranged: list[Recording]) -> None:
    whole, _, _ = read_trials(arranged)
    shorter, _, _ = read_trials(at(1, lambda r: with_gap(r, slice(2400, 2404)))(arranged))
    n = shorter.position.shape[1]
    assert n < whole.position.shape[1]
    first = int(whole.onset[0])
    assert int(shorter.onset[0]) == first
    np.testing.assert_allclose(shorter.position, whole.position[:, :n], atol=1e-12)


def test_gaps_at_the_beginning_do_not_matter(arranged: list[Recording]) -> None:
    def lose(r: Recording) -> Recording:
        begun = np.arange(len(r))[:, None] >= 200
        return replace(with_gap(r, slice(200)), command=np.where(begun, r.command, np.nan))

    perturbed, unperturbed, _ = read_trials(at(1, lose)(arranged))
    assert (len(perturbed), len(unperturbed or [])) == (6, 4)


def test_what_is_missing_is_said(arranged: list[Recording]) -> None:
    perturbed, unperturbed, notes = read_trials(arranged[:6], window=0.2)
    assert unperturbed is None
    assert len(perturbed) == 6
    assert any("the window of 200 ms is longer than the voluntary delay of 115 ms" in note for note in notes)
    assert any("no trial is unperturbed" in note for note in notes)


@pytest.mark.parametrize(("noise", "says"), [(1e-6, "little enough"), (4e-5, "feedback jerk isolation will not work")])
def test_sensors_are_judged(simulated: Reaches, pushed: np.ndarray, noise: float, says: str) -> None:
    """White noise: its level is found, and its share of the jerk is that of the truth."""
    rng = np.random.default_rng(0)
    read = [
        replace(r, position=r.position + noise * rng.normal(size=r.position.shape))
        for r in as_recordings(simulated.movements, EXACT)
    ]
    perturbed, unperturbed, notes = read_trials(read, smooth=False)
    assert says in notes[0]
    found = judge_sensors(perturbed, unperturbed)
    assert found.level == pytest.approx(noise, rel=0.05)
    exact, free, _ = read_trials(as_recordings(simulated.movements, EXACT), smooth=False)
    assert free is not None
    inside = slice(int(exact.onset[0]), int(exact.onset[0]) + 230)

    def jerk(x: np.ndarray) -> np.ndarray:
        return savitzky_golay(np.moveaxis(np.asarray(x), 1, 0), 2000.0, 3).swapaxes(0, 1)[:, inside]

    made = jerk(exact.position) - jerk(free.position).mean(axis=0)
    expected = noise * savitzky_golay_gain(2000.0, 3) / np.sqrt((made**2).mean())
    assert found.share_of_jerk == pytest.approx(expected, rel=0.05)


def test_coarse_encoders_are_seen(simulated: Reaches) -> None:
    notes = read_trials(as_recordings(simulated.movements, Sensors(1e-4, 0.5)))[2]
    assert "an encoder in steps of 100 um" in notes[0]
    assert "will not work; use output error" in notes[0]
    assert re.search(r"noise of 0.(5|49) N is \d+ % of what they change it by: perturb harder", notes[1])
