"""A joint that is watched: verdicts, what faults do to it, who listens, and what is left of it after a kill."""

from __future__ import annotations

import io
import json
import socket
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import Any

import jax
import numpy as np
import pytest

from factories.joints import TRUTH, joint, sines
from factories.live import PIPELINE, RATE, calibration, samples, some
from factories.recordings import matches
from jaximp.jobs.job import read_job
from jaximp.live.alarms import parse_rule
from jaximp.live.calibration import calibrate, live_pipeline, robot_parameters, rows_of, samples_of
from jaximp.live.clock import Batch, Slots
from jaximp.live.front import front_of
from jaximp.live.log import Log, toml_of
from jaximp.live.monitor import Monitor, Update
from jaximp.live.session import Session
from jaximp.live.sinks import MOST_WAITING, Aside, Called, JsonLines, UdpSink
from jaximp.live.sources import Iterated, Replay
from jaximp.models.joint import RobotJoint
from jaximp.trust.verdicts import NO_DATA, POOR, TRUSTED, WEAK, Verdict
from jaximp.types import Recording

PIECE = 16


@pytest.fixture(scope="module")
def compiled() -> None:
    """For the shapes that all tests share."""
    monitor()


def monitor(**settings: Any) -> Monitor:
    settings = {"sample_rate": RATE, "calibration": calibration(), "every": 0.25} | settings
    return Monitor(lambda rate: PIPELINE, **settings)


def batch(recording: Recording) -> Batch:
    return Batch(recording.time, recording.position[:, 0], recording.torque[:, 0])


def fed(watch: Monitor, given: Batch, piece: int = PIECE) -> list[Update]:
    found = []
    for first in range(0, len(given.time), piece):
        found += watch.feed(Batch(*(x[first : first + piece] for x in given)))[1]
    return found


def moving(seconds: float = 8.0, **changes: float) -> Recording:
    return joint(np.arange(round(seconds * RATE)) / RATE, **changes)


# ---- Estimates and verdicts.


@pytest.mark.parametrize("estimate", ["track", "window"])
def test_a_joint_that_moves_is_trusted_and_its_truth_is_inside(compiled: None, estimate: str) -> None:
    updates = fed(monitor(estimate=estimate), batch(moving()))
    assert updates[0].verdict.label == "warming up"
    last = updates[-1]
    assert last.verdict.label == TRUSTED, last.verdict
    assert last.about == pytest.approx(last.time - monitor().delay)
    assert last.value is not None
    assert last.stderr is not None
    np.testing.assert_array_less(np.abs(last.value - list(TRUTH.values())), 4 * last.stderr)


def test_rest_a_gap_and_another_noise_are_said(compiled: None) -> None:
    recording = moving(14.0)
    q, torque = recording.position[:, 0].copy(), recording.torque[:, 0].copy()
    at = recording.time
    q[(at > 4) & (at <= 7)] = q[at > 4][0]
    torque[(at > 4) & (at <= 7)] = 0.0
    q[(at > 9) & (at <= 11)] = np.nan
    torque[at > 12.5] += np.random.default_rng(3).normal(0, 3.0, (at > 12.5).sum())
    updates = fed(monitor(), Batch(at, q, torque))
    said = {round(one.time / 0.25) * 0.25: one.verdict.label for one in updates}
    assert said[3.5] == TRUSTED
    assert said[6.75] == WEAK
    assert said[10.75] == NO_DATA
    assert said[13.75] == POOR


def test_warming_up_says_for_how_long_and_a_bad_stretch_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []

    def calibrated(pipeline: Any, stretch: Any, alone: Any) -> Any:
        tried.append(len(stretch.position))
        if len(tried) == 1:
            raise ValueError("nothing moves")
        return calibration()

    monkeypatch.setattr("jaximp.live.monitor.calibrate", calibrated)
    watch = monitor(calibration=None, seconds=2.0, beside=False)
    updates = fed(watch, batch(moving()))
    assert tried == [400, 400]
    assert "calibrates in" in updates[0].verdict.reason
    assert any("nothing moves" in one.verdict.reason for one in updates)
    assert updates[-1].verdict.label == TRUSTED
    assert watch.counts.used == watch.counts.received == 1600


def test_a_calibration_beside_the_samples_loses_none(monkeypatch: pytest.MonkeyPatch) -> None:
    go = Event()

    def calibrated(*_: Any) -> Any:
        assert go.wait(30)
        return calibration()

    monkeypatch.setattr("jaximp.live.monitor.calibrate", calibrated)
    watch = monitor(calibration=None, seconds=1.0)
    updates = fed(watch, batch(moving()))
    assert updates[-1].verdict.reason == "the calibration is being made"
    assert watch.backlog == 1600
    go.set()
    updates = watch.wait()
    assert watch.backlog == 0
    plain = fed(monitor(), batch(moving()))
    assert [one.time for one in updates] == [one.time for one in plain]
    np.testing.assert_allclose(updates[-1].value, plain[-1].value, rtol=1e-9)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.compiles
def test_a_stretch_calibrates_and_the_drift_of_what_moves_is_larger() -> None:
    given = samples_of(joint(np.arange(4000) / RATE, torque_noise=0.2))
    stays = calibrate(PIPELINE, given)
    stiffness = 20 + np.where(np.arange(4000) < 2000, 0.0, 10.0)
    moved = given._replace(torque=given.torque + (stiffness - 20) * given.position)
    steps = calibrate(PIPELINE, moved)
    assert stays.frozen.torque_noise == pytest.approx(steps.frozen.torque_noise, rel=0.2)
    watch = monitor(calibration=steps, every=1.0)
    last = fed(watch, Batch(np.arange(4000) / RATE, given.position, moved.torque))[-1]
    assert last.value is not None
    assert last.value[2] == pytest.approx(30, rel=0.02)
    with pytest.raises(ValueError, match="calibrate for longer"):
        calibrate(PIPELINE, some(given, 0, 100))


# ---- Faults.


def test_faults_are_counted_and_change_nothing_once_they_are_past(compiled: None) -> None:
    plain = fed(monitor(), batch(moving(16.0)))[-1]
    time, q, torque = batch(moving(16.0))
    time = np.insert(time, 500, time[499])  # twice the same
    q, torque = np.insert(q, 500, q[499]), np.insert(torque, 500, torque[499])
    time[[700, 701]], q[[700, 701]], torque[[700, 701]] = time[[701, 700]], q[[701, 700]], torque[[701, 700]]
    q[800] = np.nan
    keep = np.ones(len(time), bool)
    keep[900:904] = False
    keep[1000:1300] = False
    watch = monitor()
    last = fed(watch, Batch(time[keep], q[keep], torque[keep]))[-1]
    counts = watch.counts
    assert (counts.duplicate, counts.late, counts.not_finite, counts.interruptions) == (1, 1, 1, 1)
    assert counts.missing == 305
    assert counts.received == counts.used + 3 == len(time) - 304
    assert last.verdict.label == TRUSTED
    assert last.value is not None
    assert plain.value is not None
    assert plain.stderr is not None
    np.testing.assert_array_less(np.abs(last.value - plain.value), 3 * plain.stderr)
    assert "1 twice the same" in counts.in_words()


def test_a_clock_that_jumps_goes_on(compiled: None) -> None:
    time, q, torque = batch(moving(12.0))
    time = np.where(time < 6, time, time - 1000)
    watch = monitor()
    updates = fed(watch, Batch(time, q, torque))
    assert watch.counts.clock_jumps == 1
    assert updates[-1].verdict.label == TRUSTED
    assert updates[-1].time < -900


@pytest.mark.slow
@pytest.mark.compiles
def test_the_state_is_as_large_after_ten_minutes_as_before(compiled: None) -> None:
    """120 000 samples: 10 min at 200 Hz."""
    watch = monitor(every=30.0)
    time = np.arange(round(600 * RATE)) / RATE
    q, torque, _ = samples(1200)
    turns = len(time) // 1200
    given = Batch(time, np.tile(q, turns), np.tile(torque, turns))
    fed(watch, Batch(*(x[:4096] for x in given)), 256)
    before = sum(leaf.nbytes for leaf in jax.tree.leaves(watch.state))
    updates = fed(watch, Batch(*(x[4096:] for x in given)), 4096)
    assert sum(leaf.nbytes for leaf in jax.tree.leaves(watch.state)) == before
    assert watch.counts.used == len(time)
    assert watch.backlog == 0
    assert watch._waiting == []
    assert updates[-1].value is not None
    assert updates[-1].value[2] == pytest.approx(20, rel=0.05)


# ---- Sessions, and who listens.


def update(time: float) -> Update:
    return Update(time, time, Verdict(TRUSTED, "", ""), ("stiffness",), ("N m/rad",), *np.full((4, 1), 2.0))


def test_a_slow_reader_misses_updates_and_holds_nobody_up() -> None:
    go, heard = Event(), []
    slow = Aside(Called(lambda one: (go.wait(30), heard.append(one.time))))
    for k in range(MOST_WAITING + 100):
        slow.put(update(k))  # none of these waits
    assert slow.dropped in (99, 100)  # one may be with the reader
    go.set()
    slow.close()
    assert len(heard) + slow.dropped == MOST_WAITING + 100


def test_a_reader_that_has_gone_is_no_error() -> None:
    stream = io.StringIO()
    sink = Aside(JsonLines(stream))
    sink.put(update(1.0))
    sink.close()
    line = json.loads(stream.getvalue())
    assert line["parameters"]["stiffness"] == {"unit": "N m/rad", "value": 2.0, "stderr": 2.0, "low": 2.0, "high": 2.0}
    assert line["residual"] is None
    closed = io.StringIO()
    closed.close()
    gone = Aside(JsonLines(closed))
    gone.put(update(1.0))
    gone.close()
    assert gone.dropped == 1


def test_updates_over_udp() -> None:
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    listener.bind(("127.0.0.1", 0))
    listener.settimeout(10)
    sink = Aside(UdpSink("127.0.0.1", listener.getsockname()[1]))
    sink.put(update(3.0))
    assert json.loads(listener.recv(65536))["time"] == 3.0
    sink.close()
    listener.close()


def test_an_outlet_of_lab_streaming_layer() -> None:
    pylsl = pytest.importorskip("pylsl", reason="pylsl is not installed: pip install 'jaximp[live]'")
    from jaximp.live.lsl import LslSink

    sink = LslSink("jaximp-test-out")
    sink.write(update(1.0))
    inlet = pylsl.StreamInlet(pylsl.resolve_byprop("name", "jaximp-test-out", timeout=10)[0])
    inlet.open_stream(timeout=10)
    sink.write(update(2.0))
    assert inlet.pull_sample(timeout=10)[0] == [2.0, 2.0, 2.0, 1.0]
    inlet.close_stream()
    sink.close()


def test_a_session_says_counts_and_calibration_at_the_end(compiled: None) -> None:
    said: list[str] = []
    heard: list[Update] = []
    sink = Aside(Called(heard.append))
    Session(Replay(moving(), np.inf), monitor(), [sink], say=said.append).run()
    assert heard[-1].verdict.label == TRUSTED
    assert any("white noise of" in line for line in said)
    assert said[-1].startswith("1600 samples received, 1600 used")


def test_a_session_stops_when_it_is_told_to(compiled: None, tmp_path: Path) -> None:
    begun = Event()

    def endless() -> Any:
        for k in range(10**9):
            begun.set()
            yield k / RATE, 0.0, 0.0

    log = Log(tmp_path / "log", {"model": {"human": True}})
    session = Session(Iterated(endless()), monitor(), log=log)
    thread = Thread(target=session.run)
    thread.start()
    assert begun.wait(30)
    session.stop()
    thread.join(60)
    assert not thread.is_alive()
    assert "samples received" in (tmp_path / "log" / "estimates.jsonl").read_text().splitlines()[-1]


def test_what_comes_faster_than_it_is_worked_on_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaximp.live.session.MOST_BATCHES", 3)
    busy, said = Event(), list[str]()

    class Flood:
        lost = unreadable = 0

        def __init__(self) -> None:
            self.pieces = 0

        def read(self, timeout: float) -> Batch | None:
            self.pieces += 1
            if self.pieces > 20:
                busy.set()
                return None
            return Batch(*np.full((3, 10), float(self.pieces)))

        def close(self) -> None:
            pass

    watch = monitor()
    feed, fed_so_far = watch.feed, []

    def slowly(given: Batch) -> Any:
        assert busy.wait(30)
        fed_so_far.append(len(given.time))
        return feed(given)

    monkeypatch.setattr(watch, "feed", slowly)
    Session(Flood(), watch, say=said.append).run()
    lost = 200 - sum(fed_so_far)
    assert lost > 0
    assert f"{lost} samples lost: they came too fast" in said[-1]


def test_pauses_marks_and_alarms(compiled: None, tmp_path: Path) -> None:
    said, marked = list[str](), list[tuple[float, str]]()
    log = Log(tmp_path / "log", {"model": {"human": True}})
    pieces = batch(moving(9.0))

    def source() -> Any:
        for first in range(0, 1800, 50):
            if first == 1200:
                session.mark("pushed")
            yield tuple(x[first : first + 50] for x in pieces)

    session = Session(Iterated(source()), monitor(), log=log, say=said.append)
    session.watch([parse_rule("stiffness > 15 for 1 s with 99 %", PIPELINE.model.names)])
    session.on_mark(lambda time, text: marked.append((time, text)))
    session.run()
    assert session.raised == ["stiffness > 15 for 1 s with 99 %"]
    assert sum(line.startswith("alarm at") for line in said) == 1
    assert [text for _, text in marked] == ["pushed"]
    notes = (tmp_path / "log" / "estimates.jsonl").read_text()
    assert "pushed" in notes
    assert "alarm at" in notes
    again = Session(Iterated(source()), monitor(), say=said.append)
    again.paused = True
    session = again
    again.run()
    assert "1800 left out in pauses" in said[-1]


# ---- A robot that holds the joint.


def test_the_torque_of_a_robot_that_is_known_is_taken_off() -> None:
    t = np.arange(1200) / RATE
    _, dq, ddq = sines(t)
    robot = RobotJoint(gravity=False, coulomb=False)
    theta = np.array([0.7, 0.3])
    of_robot = np.stack([dq, ddq], axis=1) @ theta
    recording = replace(joint(t), torque=of_robot[:, None], name="robot_alone")
    pair = replace(PIPELINE, robot=robot)
    found = robot_parameters(live_pipeline(pair), recording)
    np.testing.assert_allclose(found, theta, rtol=2e-3)
    held = samples_of(joint(t, torque_noise=0.0))
    with_robot = held._replace(torque=held.torque + of_robot)
    W, y, valid = rows_of(front_of(live_pipeline(pair), theta), with_robot)
    human, of_human, counts = rows_of(front_of(live_pipeline(PIPELINE)), held)
    np.testing.assert_array_equal(valid, counts)
    np.testing.assert_allclose(W, human)
    np.testing.assert_allclose(y[valid], of_human[valid], rtol=2e-3, atol=2e-3 * np.abs(of_human[valid]).max())
    with pytest.raises(ValueError, match=matches("needs the recording of the robot alone")):
        robot_parameters(live_pipeline(pair), None)


# ---- The log.

JOB = """
[recording]
file = "none.csv"
position = "q"
torque = "m"
[model]
human = { joint_name = "other" }
[filter]
position_cutoff = 25
decimation_cutoff = 15
[window]
length = 1.0
step = 0.1
"""


def slots(recording: Recording) -> Slots:
    return Slots(recording.time, samples_of(recording))


def test_a_log_is_a_recording_and_goes_on_in_a_new_file_where_the_clock_was_set(tmp_path: Path) -> None:
    tables = {key: value for key, value in tomllib.loads(JOB).items() if key != "recording"}
    log, first, second = Log(tmp_path / "log", tables), moving(4.0), moving(3.0)
    log.add(slots(first), [update(1.0)])
    log.add(slots(second), [])
    log.close()
    job = read_job(tmp_path / "log" / "job.toml")
    assert job.recording["file"] == ["samples-1.csv", "samples-2.csv"]
    loaded = job.load()
    np.testing.assert_array_equal(loaded.position[: len(first)], first.position)
    np.testing.assert_array_equal(loaded.torque[-len(second) :], second.torque)
    assert json.loads((tmp_path / "log" / "estimates.jsonl").read_text())["time"] == 1.0
    with pytest.raises(ValueError, match=matches("exists: choose another --log")):
        Log(tmp_path / "log", tables)


def test_tables_are_written_as_toml() -> None:
    tables = tomllib.loads(JOB) | {"x": 1.5, "a": {"b": [1, 2, "c\n"], 'odd "key"': True, "n": {"m": float("inf")}}}
    assert tomllib.loads(toml_of(tables)) == tables


KILLED = """
import os, signal, sys
import numpy as np
from factories.joints import joint
from jaximp.live.calibration import samples_of
from jaximp.live.clock import Slots
from jaximp.live.front import front_of
from jaximp.live.log import Log
log = Log(sys.argv[1], {"model": {"human": True}, "window": {"length": 1.0}})
for k in range(10):
    recording = joint(k + np.arange(200) / 200)
    log.add(Slots(recording.time, samples_of(recording)), [])
log.add(Slots(np.array([10.0]), samples_of(recording)._replace(
    position=np.zeros(1), torque=np.zeros(1), valid=np.ones(1, bool))), [])
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_log_survives_a_kill_but_for_its_last_second(tmp_path: Path) -> None:
    tests = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path / "log")], cwd=tests, timeout=120, check=False)
    assert done.returncode == -9
    recording = read_job(tmp_path / "log" / "job.toml").load()
    assert recording.time[-1] >= 9.0
    wanted = np.concatenate([joint(k + np.arange(200) / 200).position for k in range(10)])
    np.testing.assert_array_equal(recording.position[:-1], wanted[: len(recording) - 1])
