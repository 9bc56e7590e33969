"""A batch gives what `identify` gives for each recording, whatever happens to it on the way."""

from __future__ import annotations

import errno
import gc
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray

from browser import browser, executable
from jaximp.batch import plan as batch_plan
from jaximp.batch import results as batch_results
from jaximp.batch import run as batch
from jaximp.batch.plan import find_items, make_plan, padded_sizes
from jaximp.identification import regression
from jaximp.identification.estimates import Estimates
from jaximp.identification.identify import (
    Prepared,
    _columns_by_joint,
    in_windows,
    prepare,
    share_of_stack,
    solve_windows,
)
from jaximp.identification.solving import Solved, place_windows
from jaximp.jobs.job import Job, parse_job, read_job
from jaximp.jobs.run import identify_recording
from jaximp.least_squares import sliding as windows
from jaximp.least_squares.sliding import Score, score, sliding_least_squares
from jaximp.least_squares.window import SlidingFit
from jaximp.numerics import compilation
from jaximp.recordings import readers
from jaximp.recordings.load import recording_from_arrays, save_recording
from jaximp.types import Recording

JOB = """
[recording]
file = "none.parquet"
time = "time_s"
position = "position_rad"
torque = "torque_Nm"
[model]
human = true
[filter]
position_cutoff = 20
decimation_cutoff = 10
[window]
length = 1
step = 0.05
"""
RATE = 250.0
LENGTHS = (1000, 1000, 1000, 1250, 1250, 1321, 1321, 1321)
LINES = ((0.2, 1.1, 0.0), (0.1, 2.9, 0.5), (0.04, 6.3, 1.0))


def joint(n: int, seed: int = 0, rate: float = RATE, stiffness: float = 20.0) -> Recording:
    """A joint that moves at three frequencies, with noise in torque and position."""
    time, random = np.arange(n) / rate, np.random.default_rng(seed)
    q, dq, ddq = (
        np.asarray(
            sum(a * (2 * np.pi * f) ** k * np.sin(2 * np.pi * f * time + p + k * np.pi / 2) for a, f, p in LINES)
        )
        for k in range(3)
    )
    torque = 0.1 * ddq + 1.5 * dq + stiffness * q - 2 + random.normal(0, 0.2, n)
    return recording_from_arrays(time, q + random.normal(0, 1e-4, n), torque)


def beside(first: Recording, second: Recording) -> Recording:
    """Two joints."""
    both = (np.hstack([getattr(r, name) for r in (first, second)]) for name in ("position", "torque"))
    return recording_from_arrays(first.time, *both)


def spoilt(recording: Recording, part: slice) -> Recording:
    """Without the samples of a stretch."""
    torque = recording.torque.copy()
    torque[part] = np.nan
    return recording_from_arrays(recording.time, recording.position, torque)


def still(recording: Recording, part: slice) -> Recording:
    """Motionless for a stretch, where no window can be solved well."""
    position, torque = recording.position.copy(), recording.torque.copy()
    position[part], torque[part] = position[part][0], torque[part][0]
    return recording_from_arrays(recording.time, position, torque)


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight recordings of several lengths with a manifest, and the job; `reference` holds an undisturbed run."""
    folder = tmp_path_factory.mktemp("study")
    for k, n in enumerate(LENGTHS):
        save_recording(joint(n, k, stiffness=20.0 + k), folder / f"r{k}.parquet")
    subjects = ["S1", "1", "<script>alert(1)</script>", "../x", "01", "S2", "..", ""]
    rows = [f"r{k}.parquet,{subject},{k % 2}" for k, subject in enumerate(subjects)]
    (folder / "study.csv").write_text("file,subject,arm\n" + "\n".join(rows) + "\n")
    (folder / "job.toml").write_text(JOB)
    run(folder, folder / "reference")
    return folder


@pytest.fixture(autouse=True)
def own_folders(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other processes leave nothing in the user's folders."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


def run(folder: Path, out: Path, **options: object) -> batch.Outcome:
    """The study's batch: of three lengths, and so three batches."""
    job = read_job(folder / "job.toml")
    return batch.run(job, out=out, manifest=folder / "study.csv", **options)


def content(out: Path) -> dict[str, object]:
    """All results, run metadata apart."""
    found: dict[str, object] = {}
    for path in sorted(out.rglob("*")):
        name = path.relative_to(out).as_posix()
        if not path.is_file() or name.startswith(("receipts/", "batch.log", ".jaximp")):
            continue
        if name.startswith("recordings/"):
            found[name] = pq.ParquetFile(path).read().drop_columns(list(batch_results.RUN_COLUMNS))
        else:
            found[name] = path.read_bytes()
    return found


# --- what a stack gives -----------------------------------------------------------------------------------------------


def assert_same(found: Estimates, expected: Estimates, rtol: float = 0) -> None:
    """To the last bit, unless a tolerance is given."""
    assert found.names == expected.names
    np.testing.assert_array_equal(found.verdicts.verdict, expected.verdicts.verdict)
    for ours, theirs in zip(jax.tree.leaves(found.fit), jax.tree.leaves(expected.fit), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol)
    np.testing.assert_allclose(found.held_out_vaf, expected.held_out_vaf, rtol)
    np.testing.assert_array_equal(found.start, expected.start)
    np.testing.assert_array_equal(found.end, expected.end)
    assert found.threshold == expected.threshold
    assert found.notes == expected.notes


def assert_near(found: Solved, expected: SlidingFit, unseen: Score, trusted: NDArray[np.bool_]) -> None:
    """To rounding; where the windows hardly determine the parameters, rounding is what conditioning makes of it."""
    for name in ("theta", "stderr", "dof", "cond", "sigma_min", "excitation", "residual_rms", "vaf", "samples"):
        ours, theirs = (np.asarray(getattr(fit, name)) for fit in (found.fit, expected))
        np.testing.assert_allclose(ours[trusted], theirs[trusted], 1e-9, 0, err_msg=name)
        np.testing.assert_allclose(ours, theirs, 1e-4, 1e-9, err_msg=name)
    np.testing.assert_array_equal(found.fit.first, expected.first)
    np.testing.assert_array_equal(found.fit.last, expected.last)
    ours, theirs = np.asarray(found.unseen.vaf), np.asarray(unseen.vaf)
    np.testing.assert_allclose(ours[trusted], theirs[trusted], 1e-9, 1e-9)
    np.testing.assert_array_equal(np.isnan(ours), np.isnan(theirs))


CASES = {
    "lengths and rates": ([joint(1321, 1, 251.3), joint(1390, 2)], "", ""),
    "white noise": ([joint(1321)], "decimation_cutoff = 10", ""),
    "noise with a long memory": ([joint(1321, 2)], "decimation_cutoff = 10", "decimation_cutoff = 8\ndecimate = 1"),
    "steps that miss the next window": ([joint(1321)], "step = 0.05", "step = 0.036"),
    "gaps": ([spoilt(spoilt(joint(1321, 3), slice(600, 700)), slice(10, 12))], "", ""),
    "a still stretch": ([still(joint(1321, 5), slice(500, 1000))], "", ""),
    "slow samples": ([joint(1321, 6)], "step = 0.05", "step = 0.05\nmin_velocity = 0.3"),
    "two joints": ([beside(joint(1321, 8), joint(1321, 9))], "", ""),
    "robot": ([joint(1321, 12)], "human = true", "robot = { gravity = true, offset = true }"),
}


def stacked(job: Job, recordings: list[Recording], padded: int, size: int) -> list[Prepared]:
    """Filtered and solved as a batch does it."""
    measured = [regression.measure(job.pipeline_for(recording), recording) for recording in recordings]
    found = regression.regress_stack(measured, padded, size)
    rows = -(-padded // measured[0].pipeline.filters.decimate)
    return solve_windows([share_of_stack(one, found, k) for k, one in enumerate(measured)], rows, size)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_windows_of_a_stack_are_those_that_are_decomposed_one_by_one(case: str) -> None:
    recordings, old, new = CASES[case]
    job = parse_job(JOB.replace(old, new) if old else JOB)
    prepared = stacked(job, recordings[:1], 1400, 2)[0]
    trusted = in_windows(prepared, curves=False)[0].verdicts.trusted
    assert trusted.any()
    for joint_columns, found in zip(_columns_by_joint(prepared.model), prepared.solved, strict=True):
        rows = prepared.rows if joint_columns is None else prepared.rows.of_joint(*joint_columns)
        place = place_windows(prepared.pipeline, rows)
        given = rows.W, rows.torque
        fit = sliding_least_squares(*given, place.window, place.step, valid=rows.valid, noise=prepared.noise)
        unseen = score(*given, rows.valid, fit.theta, place.next_starts, place.window, place.step)
        assert_near(found, fit, unseen, trusted)


@pytest.mark.parametrize("case", CASES)
def test_a_padded_recording_gives_what_it_gives_alone(case: str) -> None:
    """In a stack of its own length to the last bit, padded to rounding."""
    recordings, old, new = CASES[case]
    job = parse_job(JOB.replace(old, new) if old else JOB)
    for recording in recordings:
        alone = identify_recording(job, recording)[0]
        assert_same(in_windows(stacked(job, [recording], len(recording), 2)[0], curves=False)[0], alone)
        assert_same(in_windows(stacked(job, [recording], 1400, 2)[0], curves=False)[0], alone, 1e-8)


def test_the_members_of_a_stack_do_not_touch_each_other() -> None:
    job = parse_job(JOB)
    recordings = [joint(n, n) for n in (1390, 1000)]
    together = stacked(job, recordings, 1400, 2)
    alone = [stacked(job, [one], 1400, 2)[0] for one in recordings]
    for one, other in zip(together, alone, strict=True):
        np.testing.assert_array_equal(one.solved[0].fit.theta, other.solved[0].fit.theta)
        np.testing.assert_array_equal(one.solved[0].fit.stderr, other.solved[0].fit.stderr)


@pytest.mark.slow
def test_one_window_as_long_as_the_recording() -> None:
    """A program of a few windows only once made XLA break off the process."""
    job = parse_job(JOB.replace("decimation_cutoff = 10", "").replace("length = 1", "length = 4"))
    recording = joint(1000)
    prepared = prepare(job.pipeline_for(recording), recording)
    theta, rows = in_windows(prepared)[0].fit.theta, prepared.rows
    assert len(theta) == 1
    expected = np.linalg.lstsq(rows.W[rows.valid], rows.torque[rows.valid])[0]
    np.testing.assert_allclose(theta[0], expected, 1e-9)


@pytest.mark.slow
def test_the_devices_of_a_host_share_a_stack(study: Path, tmp_path: Path) -> None:
    """Two devices, which XLA makes of one processor, give what one gives, and each has half of the recordings."""
    code = (
        "import jax, sys; jax.config.update('jax_enable_x64', True)\n"
        "from jaximp.batch import run as batch; from jaximp.jobs import job\n"
        "from jaximp.identification import solving\n"
        "program, placed = solving._program, []\n"
        "def seen(*args):\n"
        "    found = program(*args); placed.append(found[0].theta.sharding.device_set); return found\n"
        "solving._program = seen\n"
        "batch.run(job.read_job(sys.argv[1] + '/job.toml'), out=sys.argv[2], manifest=sys.argv[1] + '/study.csv')\n"
        "print(sorted(map(len, placed)))"
    )
    flags = "--xla_force_host_platform_device_count=2"
    done = subprocess.run(
        [sys.executable, "-c", code, str(study), str(tmp_path / "out")],
        env=os.environ | {"XLA_FLAGS": flags}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)[-1] == 2
    for path in (study / "reference/estimates").rglob("*.parquet"):
        expected = pq.ParquetFile(path).read()
        found = pq.ParquetFile(tmp_path / "out" / path.relative_to(study / "reference")).read()
        assert found["verdict"] == expected["verdict"]
        for name in ("stiffness", "stiffness_stderr", "condition_number", "held_out_vaf"):
            np.testing.assert_allclose(found[name], expected[name], 1e-9, err_msg=name)


@pytest.mark.slow
def test_many_lengths_are_few_programs(tmp_path: Path) -> None:
    """A thousand lengths are planned; of these a few dozen are run, at least one for each size."""
    compiled: list[str] = []

    def listen(event: str, seconds: float, **about: object) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(event)

    assert len(padded_sizes(range(1000, 2000))) <= 6
    for k in range(24):
        save_recording(joint(1003 + 17 * k, k), tmp_path / f"r{k:02d}.parquet")
    jax.clear_caches()
    regression._known.clear()
    compilation.options()
    jnp.zeros(())  # small programs that no length has a part in
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        outcome = batch.run(parse_job(JOB, tmp_path), [tmp_path], tmp_path / "out")
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert outcome.exit_status == 0
    assert 0 < len(compiled) <= 6


@pytest.mark.parametrize("most", [1, 2, 5])
def test_as_little_as_possible_is_padded(most: int) -> None:
    """Against all choices of sizes."""
    from itertools import combinations

    lengths = np.random.default_rng(0).choice(np.arange(100, 200), 12, replace=False).tolist()
    lengths += [150, 150]
    chosen = padded_sizes(lengths, most)

    def padded(sizes: list[int]) -> int:
        return sum(min(size for size in sizes if size >= n) for n in lengths)

    choices = combinations(sorted(set(lengths))[:-1], most - 1)
    assert padded(chosen) == min(padded([*some, max(lengths)]) for some in choices)
    assert len(chosen) == most


# --- the results ------------------------------------------------------------------------------------------------------


def test_the_data_set_holds_what_identify_finds(study: Path) -> None:
    out, job = study / "reference", read_job(study / "job.toml")
    recordings = batch.read_recordings(out)
    assert recordings["recording"].to_pylist() == [f"r{k}.parquet" for k in range(8)]
    assert recordings["status"].to_pylist() == ["ok"] * 8
    assert recordings["subject"].to_pylist()[2:4] == ["<script>alert(1)</script>", "../x"]
    assert recordings.schema.field("stiffness_mean").metadata == {b"unit": b"N m/rad"}
    import pyarrow.dataset as ds

    windows = ds.dataset(out / "estimates", format="parquet").to_table()
    stated = dict(zip(recordings["recording"].to_pylist(), recordings["subject"].to_pylist(), strict=True))
    assert {(row["recording"], row["subject"]) for row in windows.to_pylist()} == set(stated.items())
    for k in (0, 2):
        expected = identify_recording(job, joint(LENGTHS[k], k, stiffness=20.0 + k))[0]
        rows = windows.filter(pa.compute.equal(windows["recording"], f"r{k}.parquet")).sort_by("start_s")
        np.testing.assert_allclose(rows["stiffness"], np.asarray(expected.fit.theta)[:, 2], 1e-9)
        np.testing.assert_allclose(rows["stiffness_stderr"], np.asarray(expected.fit.stderr)[:, 2], 1e-9)
        row = {name: recordings[name][k].as_py() for name in ("trusted", "windows", "stiffness_mean")}
        assert row["windows"] == len(expected.start)
        assert row["trusted"] == expected.verdicts.trusted.sum()
        np.testing.assert_allclose(row["stiffness_mean"], expected.mean_over_trusted()[2], 1e-9)


@pytest.mark.parametrize("reader", ["pandas", "polars", "duckdb"])
def test_every_reader_reads_it(study: Path, reader: str) -> None:
    library = pytest.importorskip(reader)
    out = study / "reference"
    expected = batch.read_recordings(out)["windows"].to_pylist()
    if reader == "pandas":
        windows = library.read_parquet(out / "estimates")
        counts = windows.groupby("recording", observed=True).size().sort_index().tolist()
        subjects = set(windows["subject"])
    elif reader == "polars":
        windows = library.read_parquet(out / "estimates")
        counts = windows.group_by("recording").len().sort("recording")["len"].to_list()
        subjects = set(windows["subject"])
    else:
        where = f"'{out}/estimates/**/*.parquet'"
        query = f"SELECT count(*) FROM {where} GROUP BY recording ORDER BY recording"
        counts = [count for (count,) in library.sql(query).fetchall()]
        subjects = {subject for (subject,) in library.sql(f"SELECT DISTINCT subject FROM {where}").fetchall()}
    assert counts == expected
    assert {"S1", "S2", "../x", "..", "<script>alert(1)</script>", "1", "01", ""} == subjects


@pytest.mark.slow
def test_a_human_in_a_robot_takes_the_manifests_robot(tmp_path: Path) -> None:
    """One by one, with the recording of the robot alone that the manifest names."""
    text = JOB.replace("human = true", "human = true\nrobot = { gravity = false, coulomb = false }\nmethods = [1, 3]")
    text += '[robot_recording]\nfile = "none.parquet"\n' + "".join(JOB.splitlines(keepends=True)[3:6])
    save_recording(joint(1000, 1), tmp_path / "held.parquet")
    save_recording(joint(1000, 2, stiffness=0.0), tmp_path / "alone.parquet")
    (tmp_path / "study.csv").write_text("file,robot_file\nheld.parquet,alone.parquet\n")
    job = parse_job(text, tmp_path)
    plan = make_plan(job, find_items([], tmp_path / "study.csv"))
    assert any("one by one" in line for line in plan.in_words(job))
    outcome = batch.run_plan(job, plan, tmp_path / "out")
    assert outcome.failed == []
    expected = identify_recording(job, joint(1000, 1), joint(1000, 2, stiffness=0.0))
    for folder, one in zip(("estimates", "estimates_method3"), expected, strict=True):
        (path,) = (tmp_path / "out" / folder).rglob("*.parquet")
        np.testing.assert_allclose(pq.ParquetFile(path).read()["stiffness"], np.asarray(one.fit.theta)[:, 2], 1e-12)


@pytest.mark.slow
def test_a_study_has_conditions_of_its_own(tmp_path: Path) -> None:
    """Beside the condition number; and no column of the windows can be shadowed by one of the manifest."""
    import pyarrow.dataset as ds

    save_recording(joint(1000), tmp_path / "a.parquet")
    (tmp_path / "study.csv").write_text("file,condition\na.parquet,tense\n")
    job = parse_job(JOB, tmp_path)
    batch.run(job, out=tmp_path / "out", manifest=tmp_path / "study.csv")
    table = ds.dataset(tmp_path / "out/estimates", format="parquet").to_table()
    assert set(table["condition"].to_pylist()) == {"tense"}
    expected = identify_recording(job, joint(1000))[0]
    np.testing.assert_allclose(table["condition_number"], expected.fit.cond, 1e-6)
    assert {*table.column_names} - {"condition"} <= batch_results.reserved_columns(job)


@pytest.mark.slow
@pytest.mark.parametrize("n_joints", [1, 2])
def test_a_reflex_is_what_it_is_alone(tmp_path: Path, n_joints: int) -> None:
    """Recordings of two rates in one table, with gain and delay of every window and the gain in the row of each."""
    text = JOB.replace("human = true", "human = { reflex = { first = 0.05, last = 0.25, count = 3 } }")
    text = text.replace("length = 1\n", "length = 2\n").replace("step = 0.05", "step = 0.2")
    both = {"a": joint(1000, 1), "b": joint(1300, 2, rate=300.0)}
    if n_joints == 2:
        both = {name: beside(one, joint(len(one), 7, one.sample_rate)) for name, one in both.items()}
        text = text.replace('"position_rad"', '["position1_rad", "position2_rad"]')
        text = text.replace('"torque_Nm"', '["torque1_Nm", "torque2_Nm"]')
    for name, one in both.items():
        save_recording(one, tmp_path / f"{name}.parquet")
    (tmp_path / "study.csv").write_text("file,subject\na.parquet,S\nb.parquet,S\n")
    job = parse_job(text, tmp_path)
    assert batch.run(job, out=tmp_path / "out", manifest=tmp_path / "study.csv").exit_status == 0
    alone = [identify_recording(job, one)[0] for one in both.values()]
    (path,) = (tmp_path / "out/estimates").rglob("*.parquet")
    found, rows = pq.ParquetFile(path).read(), batch.read_recordings(tmp_path / "out")
    for k, reflex in enumerate(alone[0].reflexes):
        for what in ("gain", "gain_stderr", "delay"):
            expected = np.concatenate([getattr(one.reflexes[k], what) for one in alone])
            np.testing.assert_allclose(found[f"{reflex.name}_{what}"], expected, 1e-12)
    means = [one.summarised().mean_over_trusted() for one in alone]
    for k, name in enumerate(alone[0].summarised().names):
        np.testing.assert_allclose(rows[f"{name}_mean"].to_numpy(), [mean[k] for mean in means], 1e-12)
    assert f"{alone[0].reflexes[-1].name}_gain_mean" in rows.column_names
    assert np.isfinite(rows[f"{alone[0].names[2]}_mean"].to_numpy()).all()


def test_a_long_recording_goes_in_chunks_without_a_seam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is too long to be stacked gives what `identify` gives, which solves it in overlapping chunks."""
    monkeypatch.setattr(batch_plan, "LONGEST_STACKED", 1200)
    monkeypatch.setattr("jaximp.identification.identify.MOST_ROWS", 200)
    monkeypatch.setattr(windows, "FROM_CHUNKS", 1)
    save_recording(joint(1321), tmp_path / "long.parquet")
    save_recording(joint(1000), tmp_path / "short.parquet")
    job = parse_job(JOB, tmp_path)
    plan = make_plan(job, find_items([str(tmp_path)]))
    assert [one.padded for one in plan.batches] == [1000, 0]
    assert batch.run_plan(job, plan, tmp_path / "out").exit_status == 0
    found = pq.ParquetFile(tmp_path / "out/estimates/batch-00001.parquet").read()
    expected = identify_recording(job, joint(1321))[0]
    np.testing.assert_array_equal(found["stiffness"], np.asarray(expected.fit.theta)[:, 2])


# --- faults -----------------------------------------------------------------------------------------------------------


class Fault:
    """Something that goes wrong in a run, and how it is put right before the run is taken up again."""

    def __init__(self, study: Path, monkeypatch: pytest.MonkeyPatch):
        self.study, self.patch = study, monkeypatch

    def after(self, count: int, then: Callable[[Path], object]) -> None:
        """Do something when so many files of results have been written."""
        written, original = [], batch_results.write_whole

        def write(path: Path, content: bytes) -> None:
            if len(written) == count:
                then(path)
            written.append(path)
            original(path, content)

        self.patch.setattr(batch_results, "write_whole", write)


def full_disk(fault: Fault, out: Path) -> None:
    """Every write fails from some point on, half of the file written."""

    def fail(path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.with_name(f".{path.name}.1{batch_results.UNFINISHED}").write_bytes(b"PAR1")
        raise OSError(errno.ENOSPC, "No space left on device")

    fault.after(4, fail)
    outcome = run(fault.study, out)
    assert outcome.exit_status == 1
    assert "No space left" in outcome.broken[0]


def interrupt(fault: Fault, out: Path) -> None:
    """Ctrl-C between two files of a batch."""
    fault.after(4, lambda path: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        run(fault.study, out)
    assert not list(out.rglob(f"*{batch_results.UNFINISHED}"))


def interrupt_while_garbage_is_collected(fault: Fault, out: Path) -> None:
    """Python drops what a signal raises in a callback of its collector: JAX has one."""

    def lose(phase: str, about: dict[str, int]) -> None:
        gc.callbacks.remove(lose)
        signal.raise_signal(signal.SIGINT)
        for _ in range(10_000):  # a signal is heard between two instructions
            pass

    def collect(event: dict[str, object]) -> None:
        if event["event"] == "batch" and not lost:
            lost.append(event)
            gc.callbacks.append(lose)
            gc.collect()

    lost: list[object] = []
    with pytest.raises(KeyboardInterrupt):
        run(fault.study, out, tell=collect)
    assert lost


def out_of_memory(fault: Fault, out: Path) -> None:
    """A batch does not get its memory."""
    original = batch_results.solve_windows

    def solve(several: list[Prepared], padded: int, size: int) -> object:
        if any(len(one.recording) == 1321 for one in several):
            raise MemoryError("no more")
        return original(several, padded, size)

    fault.patch.setattr(batch_results, "solve_windows", solve)
    assert run(fault.study, out).exit_status == 1


def vanished_file(fault: Fault, out: Path) -> None:
    """A file is gone when its turn comes, and back later."""
    path, plan = fault.study / "r5.parquet", batch.make_plan

    def then_gone(*args: object, **options: object) -> object:
        made = plan(*args, **options)
        path.rename(path.with_suffix(".away"))
        return made

    fault.patch.setattr(batch, "make_plan", then_gone)
    try:
        outcome = run(fault.study, out)
    finally:
        path.with_suffix(".away").rename(path)
    assert outcome.exit_status == 3
    assert [failed["recording"] for failed in outcome.failed] == ["r5.parquet"]


def no_memory_to_read(fault: Fault, out: Path) -> None:
    """A reader's library does not get its memory: that says nothing of the file."""

    def fail(path: Path, names: list[str]) -> object:
        raise pa.ArrowMemoryError("malloc of size 8000 failed")

    fault.patch.setitem(readers._READERS, ".parquet", fail)
    assert run(fault.study, out).exit_status == 1


def too_many_files(fault: Fault, out: Path) -> None:
    """Files cannot be opened for a while."""
    original = readers._READERS[".parquet"]

    def fail(path: Path, names: list[str]) -> object:
        if path.name == "r3.parquet":
            raise OSError(errno.EMFILE, "Too many open files")
        return original(path, names)

    fault.patch.setitem(readers._READERS, ".parquet", fail)
    outcome = run(fault.study, out)
    assert outcome.exit_status == 3
    assert "Too many open files" in outcome.failed[0]["reason"]


def damaged_result(fault: Fault, out: Path) -> None:
    """A file of results is cut, another one is lost."""
    run(fault.study, out)
    first, second = sorted((out / "estimates").rglob("*.parquet"))[:2]
    first.write_bytes(first.read_bytes()[:-100])
    second.unlink()


def damaged_receipt(fault: Fault, out: Path) -> None:
    run(fault.study, out)
    sorted((out / "receipts").iterdir())[1].write_text("{")


def killed_process(fault: Fault, out: Path) -> None:
    """`kill -9` of the whole run, when the first batch is done."""
    command = [sys.executable, "-c", "from jaximp.cli.main import main; main()", "batch", str(fault.study / "job.toml")]
    command += ["--manifest", str(fault.study / "study.csv"), "--out", str(out), "--quiet"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 60
        while not list(out.glob("receipts/*.json")) and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.002)
    finally:
        process.kill()
        process.wait()


FAULTS = [
    full_disk, interrupt, interrupt_while_garbage_is_collected, out_of_memory, no_memory_to_read, vanished_file,
    too_many_files, damaged_result, damaged_receipt, killed_process,
]  # fmt: skip


# The signal's exception that Python drops is what the test is about.
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_nothing_is_lost_and_nothing_differs(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: Callable[[Fault, Path], None]
) -> None:
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        fault(Fault(study, patch), out)
    outcome = run(study, out, resume=True)
    expected = content(study / "reference")
    found = content(out)
    assert outcome.exit_status == 0
    assert set(expected) - set(found) == set(), "lost"
    assert [name for name in found if found[name] != expected.get(name)] == [], "differs"


def test_what_a_batch_did_not_write_stays(study: Path, tmp_path: Path) -> None:
    """But for drafts of reports that were broken off."""
    out = tmp_path / "out"
    shutil.copytree(study / "reference", out)
    own = [out / name for name in ("notes.txt", "recordings_raw/a.parquet", "estimates_old/batch-00000.parquet")]
    own.append(out / "estimates" / "readme.txt")
    for path in own:
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    draft = out / "reports" / ".r0.parquet.x7"
    draft.mkdir(parents=True)
    assert run(study, out, resume=True).skipped == len(LENGTHS)
    assert all(path.read_text() == "mine" for path in own)
    assert not draft.exists()


@pytest.mark.parametrize("name", [".", "..", ".hidden", "a/../..", "x.csv"])
def test_a_report_stands_in_a_folder_of_its_own(tmp_path: Path, name: str) -> None:
    folder = batch_results.report_folder(tmp_path, name)
    assert folder.resolve().parent == tmp_path / "reports"
    assert not folder.name.startswith(".")


def test_results_are_no_recordings(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of an earlier run, in the folder that is searched."""
    monkeypatch.chdir(study)
    for given in (".", str(study), "**/*.parquet"):
        names = {item.name for item in find_items([given])} - {"study.csv"}
        assert names == {f"r{k}.parquet" for k in range(len(LENGTHS))}


def test_a_full_disk_below_the_log_ends_no_run(tmp_path: Path) -> None:
    (tmp_path / "batch.log").symlink_to("/dev/full")
    told: list[dict[str, object]] = []
    with batch._log(tmp_path, told.append) as log:
        log({"event": "plan"})
    assert told == [{"event": "plan"}]


def test_a_new_recording_of_the_robot_is_read(tmp_path: Path) -> None:
    text = JOB.replace("human = true", "human = true\nrobot = { gravity = false, coulomb = false }\nmethods = [1]")
    text += '[robot_recording]\nfile = "alone.parquet"\n' + "".join(JOB.splitlines(keepends=True)[3:6])
    job = parse_job(text)
    item = batch_plan.Item("x", tmp_path / "x.parquet", robot_file=tmp_path / "alone.parquet")
    task = batch_results.Task(job, tmp_path, (), (), (), 1)
    for seed in (1, 2):
        recording = joint(1000, seed)
        save_recording(recording, tmp_path / "alone.parquet")
        found = batch_results._alone(task, item)
        assert found is not None
        np.testing.assert_array_equal(found.torque, recording.torque)


def test_a_design_behind_a_link_belongs_to_the_job(tmp_path: Path) -> None:
    (tmp_path / "design.json").write_text("{}")
    (tmp_path / "link.json").symlink_to("design.json")
    job = replace(parse_job(JOB, tmp_path), design="link.json")
    before = batch_results.job_checksum(job)
    (tmp_path / "design.json").write_text("[]")
    assert batch_results.job_checksum(job) != before


def test_all_recordings_of_a_study_have_the_same_joints(tmp_path: Path) -> None:
    """Two in one variable, where the first recording has one."""
    for k, one in enumerate((joint(1000), beside(joint(1000), joint(1000, 1)))):
        np.savez(tmp_path / f"r{k}.npz", time_s=one.time, position_rad=one.position, torque_Nm=one.torque)
    job = parse_job(JOB, tmp_path)
    plan = make_plan(job, find_items([str(tmp_path)]))
    task = batch_results.Task.of(job, plan, tmp_path)
    found = [batch_results._read(task, plan.batches[0], item) for item in plan.items]
    assert [result.reason[-50:] for result in found if result.reason] == [found[1].reason[-50:]]
    assert "it has 2 joints, but this study 1" in found[1].reason


def test_what_stops_a_stack_is_said_of_its_recordings(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: object) -> object:
        raise ValueError("no such window")

    monkeypatch.setattr(batch_results, "solve_windows", refuse)
    job, recording = parse_job(JOB), joint(1000)
    measured = regression.measure(job.pipeline_for(recording), recording)
    result = batch_results.Result(batch_plan.Item("x", Path("x")), recording=recording)
    result.stacked = (1000, 1, "kind"), measured
    batch_results._solve_stacks(batch_results.Task(job, Path(), (), (), (), 1), [result])
    assert (result.status, result.reason) == (batch_results.FAILED, "no such window")


def test_a_name_that_is_no_text_can_be_told(tmp_path: Path) -> None:
    save_recording(joint(1000), tmp_path / "r0.parquet")
    (tmp_path / "r0.parquet").rename(os.fsdecode(os.fsencode(tmp_path) + b"/r\xff.parquet"))
    items = find_items([str(tmp_path)])
    assert [item.name for item in items] == ["r\\udcff.parquet"]
    told = batch_results.failure(items[0], "damaged")
    assert json.dumps(told).encode("ascii")
    assert batch_results._texts([str(items[0].file)]).to_pylist() == [told["file"]]


def test_a_second_resume_does_nothing_again(study: Path, tmp_path: Path) -> None:
    run(study, tmp_path / "out")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("batch-*.parquet")}
    outcome = run(study, tmp_path / "out", resume=True)
    assert outcome.skipped == 8
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("batch-*.parquet")}


def test_another_job_or_another_content_is_computed_again(study: Path, tmp_path: Path) -> None:
    folder = tmp_path / "study"
    folder.mkdir()
    for name in [*(f"r{k}.parquet" for k in range(8)), "study.csv", "job.toml"]:
        (folder / name).write_bytes((study / name).read_bytes())
    run(folder, tmp_path / "out")
    save_recording(joint(LENGTHS[0], 99), folder / "r0.parquet")
    assert 0 < run(folder, tmp_path / "out", resume=True).skipped < 8
    (folder / "job.toml").write_text(JOB + "\n[trust]\nmin_vaf = 0.8\n")
    assert run(folder, tmp_path / "out", resume=True).skipped == 0


def test_what_fails_is_quarantined_and_the_rest_goes_on(tmp_path: Path) -> None:
    (tmp_path / "bad.csv").write_text("time_s,position_rad,torque_Nm\n0,1,x\n")
    (tmp_path / "cut.parquet").write_bytes(b"PAR1")
    save_recording(joint(100), tmp_path / "short.parquet")
    save_recording(joint(1000), tmp_path / "good.parquet")
    (tmp_path / "link.parquet").symlink_to(tmp_path / "good.parquet")
    os.mkfifo(tmp_path / "pipe.parquet")
    (tmp_path / "job.toml").write_text(JOB)
    command = [sys.executable, "-c", "from jaximp.cli.main import main; main()", "batch", "job.toml", ".", "--json"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 3, done.stderr
    events = [json.loads(line) for line in done.stdout.splitlines()]
    assert events[-1]["event"] == "done"
    assert events[-1]["failed"] == 5
    reasons = {one["recording"]: one["reason"] for one in json.loads((tmp_path / "batch/quarantine.json").read_text())}
    assert set(reasons) == {"bad.csv", "cut.parquet", "short.parquet", "link.parquet", "pipe.parquet"}
    assert reasons["bad.csv"].startswith("column 'torque_Nm', row 1: 'x' is not a number")
    assert "symbolic links" in reasons["link.parquet"]
    assert "no plain file" in reasons["pipe.parquet"]
    table = batch.read_recordings(tmp_path / "batch")
    assert dict(zip(table["recording"].to_pylist(), table["status"].to_pylist(), strict=True))["good.parquet"] == "ok"


REPORTS = [("none", []), ("failed", ["noise.parquet"]), ("all", ["good.parquet", "noise.parquet"])]


@pytest.mark.parametrize(("reports", "expected"), REPORTS)
def test_reports_are_those_that_were_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reports: str, expected: list[str]
) -> None:
    """A recording has failed if none of its windows can be trusted."""
    written: list[str] = []
    monkeypatch.setattr(batch_results, "write_report_of", lambda job, one, alone, folder: written.append(one.name))
    good = joint(1000)
    torque = np.random.default_rng(0).normal(size=(1000, 1))
    save_recording(good, tmp_path / "good.parquet")
    save_recording(recording_from_arrays(good.time, good.position, torque), tmp_path / "noise.parquet")
    assert batch.run(parse_job(JOB), [tmp_path], tmp_path / "out", reports=reports).exit_status == 0
    assert sorted(written) == expected


def test_where_nothing_is_trusted_it_is_said_why(tmp_path: Path) -> None:
    """At the end of a run, taken up or not, and beside the recording."""
    save_recording(joint(1000), tmp_path / "moves.parquet")
    save_recording(still(joint(1000, 1), slice(20, None)), tmp_path / "rests.parquet")
    job, files = parse_job(JOB, tmp_path), [tmp_path / "moves.parquet", tmp_path / "rests.parquet"]
    first, again = (batch.run(job, files, tmp_path / "out", resume=resume) for resume in (False, True))
    reasons = batch.read_recordings(tmp_path / "out")["reason"].to_pylist()
    assert reasons[0] == ""
    assert reasons[1].startswith("no window can be trusted, for example: ")
    for outcome in (first, again):
        assert (outcome.doubted, outcome.doubt) == (1, f"rests.parquet: {reasons[1]}")


def test_other_units_are_noticed(tmp_path: Path) -> None:
    """Of one recording alone nobody could tell; a soft joint among stiff ones is none of these."""
    for k in range(6):
        one = joint(1000, k, stiffness=0.5 if k == 5 else 20.0)
        if k == 0:
            one = recording_from_arrays(one.time, np.degrees(one.position), one.torque)
        save_recording(one, tmp_path / f"r{k}.parquet")
    outcome = batch.run(parse_job(JOB), [tmp_path], tmp_path / "out")
    assert list(outcome.odd) == ["r0.parquet"]
    assert outcome.odd["r0.parquet"].startswith("stiffness is 0.017 times that of the median recording")
    assert "0.017 times" in (tmp_path / "out/overview.html").read_text()
    few = batch.run(parse_job(JOB), [tmp_path / f"r{k}.parquet" for k in range(4)], tmp_path / "few")
    assert few.odd == {}


def test_a_report_can_be_had_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a recording by its name, though its batch is done; the overview links it. A changed recording loses it."""

    def write(job: Job, one: Recording, alone: Recording | None, folder: Path) -> None:
        folder.mkdir(parents=True)
        (folder / "report.html").write_text(one.name)

    monkeypatch.setattr(batch_results, "write_report_of", write)
    for name in ("a", "b"):
        save_recording(joint(1000), tmp_path / f"{name}.parquet")
    job, out = parse_job(JOB), tmp_path / "out"
    files = [tmp_path / "a.parquet", tmp_path / "b.parquet"]
    batch.run(job, files, out)
    assert "reports/" not in (out / "overview.html").read_text()
    assert batch.run(job, files, out, resume=True, reports=["b.parquet"]).skipped == 2
    assert [path.read_text() for path in out.glob("reports/*/report.html")] == ["b.parquet"]
    assert "./reports/b.parquet/report.html" in (out / "overview.html").read_text()
    with pytest.raises(ValueError, match="there is no recording 'c'"):
        batch.run(job, files, out, resume=True, reports=["c"])
    save_recording(joint(1000, 5), tmp_path / "b.parquet")
    batch.run(job, files, out, resume=True)
    assert not list(out.glob("reports/*"))
    assert "reports/" not in (out / "overview.html").read_text()


def test_what_did_not_change_keeps_its_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Though it is done again with those beside it; and what another run leaves out is told."""

    def write(job: Job, one: Recording, alone: Recording | None, folder: Path) -> None:
        folder.mkdir(parents=True)
        (folder / "report.html").write_text(f"{one.name} {job.text.splitlines()[0]}")

    monkeypatch.setattr(batch_results, "write_report_of", write)
    files = [tmp_path / f"{name}.parquet" for name in "abc"]
    for k, file in enumerate(files):
        save_recording(joint(1000, k), file)
    job, out = parse_job(JOB), tmp_path / "out"
    batch.run(job, files, out, reports="all")
    assert (out / "reports/a.parquet/report.html").read_text() == f"a.parquet # recording: {files[0]}"
    save_recording(joint(1000, 9), files[0])
    again = batch.run(job, files, out, resume=True)
    assert (again.skipped, again.outdated, again.dropped) == (0, 1, 0)
    assert sorted(path.name for path in (out / "reports").iterdir()) == ["b.parquet", "c.parquet"]
    assert batch.run(job, files[:2], out, resume=True).dropped == 1
    assert batch.run(parse_job(JOB + "[trust]\nmin_vaf = 0.8\n"), files[:2], out, resume=True).outdated == 1


def test_a_report_that_fails_costs_no_batch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: object) -> None:
        raise RuntimeError("no figure")

    monkeypatch.setattr(batch_results, "write_report_of", fail)
    save_recording(joint(1000), tmp_path / "a.parquet")
    events: list[dict[str, object]] = []
    outcome = batch.run(parse_job(JOB), [tmp_path / "a.parquet"], tmp_path / "out", reports="all", tell=events.append)
    assert outcome.exit_status == 0
    assert {"event": "no report", "recording": "a.parquet", "reason": "RuntimeError: no figure"} in events


def test_the_overview_of_a_study_opens_in_a_browser(study: Path) -> None:
    """All recordings with their series; what a manifest says is text."""
    page = study / "reference/overview.html"
    assert "<script>alert" not in page.read_text()
    if executable() is None:
        pytest.skip("there is no chromium on this machine")
    with browser() as one:
        one.open(page.as_uri())
        one.wait("document.documentElement.dataset.usable")
        cells = one.evaluate("[...document.querySelectorAll('#table tbody :is(th, td)')].map(one => one.textContent)")
        assert {f"r{k}.parquet" for k in range(8)} | {"<script>alert(1)</script>", "../x"} <= set(cells)
        one.evaluate("document.getElementById('panels').scrollIntoView()")
        one.frame()
        one.wait("document.querySelectorAll('#panels svg path').length >= 4")
        assert one.complaints() == []


# --- what a manifest may not do ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", ["../r0.parquet", "/etc/passwd", "away/r0.parquet", "x/../../r0.parquet"])
def test_a_manifest_cannot_leave_its_folder(tmp_path: Path, path: str) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    (inside / "away").symlink_to(tmp_path)
    (inside / "study.csv").write_text(f"file\n{path}\n")
    with pytest.raises(ValueError, match="allow-outside"):
        find_items([], inside / "study.csv")
    assert len(find_items([], inside / "study.csv", allow_outside=True)) == 1


def test_a_recording_that_claims_too_much_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import h5py

    with h5py.File(tmp_path / "huge.h5", "w") as file:
        for name in ("time_s", "position_rad", "torque_Nm"):
            file.create_dataset(name, (10**12,), chunks=(1000,), dtype="f8")
    monkeypatch.setattr(batch_results, "recording_from_mapping", lambda *args: pytest.fail("it was read"))
    outcome = batch.run(parse_job(JOB, tmp_path), [tmp_path], tmp_path / "out")
    assert "claims 1e+12 samples" in outcome.failed[0]["reason"]


def test_a_struct_is_counted_by_what_it_unpacks_to(tmp_path: Path) -> None:
    from scipy.io import savemat

    one = joint(1000)
    data = {"t": one.time, "q": one.position, "tau": one.torque}
    savemat(tmp_path / "s.mat", {"data": data, "other": np.zeros((3, 2000))}, do_compression=True)
    assert readers.count_samples(tmp_path / "s.mat", ["data.t", "data.q", "data.tau"]) == 1000


def test_a_struct_that_unpacks_to_too_much_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from scipy.io import savemat

    savemat(tmp_path / "s.mat", {"data": {"t": np.zeros(200_000)}}, do_compression=True)
    monkeypatch.setattr(readers, "MOST_NUMBERS", 100_000)
    monkeypatch.setattr(readers, "_read_mat", lambda *args: pytest.fail("it was read") if args[1] else {})
    assert readers.count_samples(tmp_path / "s.mat", ["data.t"]) > 100_000


def test_the_variable_of_the_sample_rate_is_counted_too(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "r.npz", q=np.zeros(10), tau=np.zeros(10), fs=np.zeros(20_000))
    table = {"position": "q", "torque": "tau", "sample_rate": "fs"}
    assert readers.count_samples(tmp_path / "r.npz", batch_plan.channel_columns(table)) == 20_000


def square(folder: Path) -> None:
    import h5py

    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("torque_Nm", (9000, 9000), chunks=(1000, 1000), dtype="f8")


def linked(folder: Path) -> None:
    import h5py

    with h5py.File(folder / "elsewhere.hdf", "w") as file:
        file["torque"] = np.arange(1000.0)
    with h5py.File(folder / "a.h5", "w") as file:
        file["torque_Nm"] = h5py.ExternalLink("elsewhere.hdf", "/torque")


def device(folder: Path) -> None:
    import h5py

    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("torque_Nm", (1000,), "f8", external=[("/dev/zero", 0, 8000)])


def virtual(folder: Path) -> None:
    import h5py

    layout = h5py.VirtualLayout((1000,), "f8")
    layout[:] = h5py.VirtualSource(str(folder / "elsewhere.hdf"), "torque", (1000,))
    with h5py.File(folder / "a.h5", "w") as file:
        file.create_virtual_dataset("torque_Nm", layout)


@pytest.mark.parametrize("make", [square, linked, device, virtual], ids=lambda make: make.__name__)
def test_an_hdf5_file_holds_its_own_numbers_and_no_more(tmp_path: Path, make: Callable[[Path], None]) -> None:
    make(tmp_path)
    why = "has shape" if make is square else "lies in another file"
    with pytest.raises(readers.RecordingError, match=why):
        readers.count_samples(tmp_path / "a.h5", ["torque_Nm"])
    if make is not square:
        with pytest.raises(readers.RecordingError, match=why):
            readers.read_columns(tmp_path / "a.h5", ["torque_Nm"])


def test_columns_may_have_the_endings_of_results(study: Path, tmp_path: Path) -> None:
    """Of the page: a mean of somebody's own is text, and no parameter."""
    shutil.copytree(study / "reference", tmp_path / "out")
    for path in (tmp_path / "out" / "recordings").iterdir():
        table = pq.ParquetFile(path).read()
        for name in ("emg_mean", "x_median_stderr"):
            table = table.append_column(name, pa.array(["3"] * len(table), pa.string()))
        pq.write_table(table, path)
    batch.write_page(tmp_path / "out", ("subject", "arm", "emg_mean", "x_median_stderr"))
    page = (tmp_path / "out" / "overview.html").read_text()
    assert "emg_mean" in page
    assert "x_median_stderr" in page


@pytest.mark.parametrize(
    ("manifest", "why"),
    [
        ("file\na.csv\nsub/../a.csv\n", "more than once"),
        ("file,subject, subject\na.csv,1,2\n", "same name"),
        ("subject\nS1\n", "column 'file' .*, but its columns are subject: rename"),
        ("file,File\na.csv,b.csv\n", "same name"),
        ("file\n\n", "has no rows"),
        ("file\na.csv\na.csv\n", "more than once"),
        ("file,subject\na.csv\n", "more or fewer fields"),
        ("file,robot_file\na.csv,b.csv\n", "no \\[robot_recording\\]"),
        ("file,verdict\na.csv,x\n", "name of a result"),
        ("file,stiffness_stderr\na.csv,x\n", "name of a result"),
        ("file,stiffness_mean\na.csv,x\n", "name of a result"),
        ("file,subject\na.csv," + 200 * "x" + "\n", "too long"),
    ],
)
def test_bad_manifests_are_refused(tmp_path: Path, manifest: str, why: str) -> None:
    (tmp_path / "study.csv").write_text(manifest)
    with pytest.raises(ValueError, match=why):
        batch.run(parse_job(JOB), out=tmp_path / "out", manifest=tmp_path / "study.csv")


@pytest.mark.usefixtures("unchecked")
def test_a_job_with_trials_is_refused() -> None:
    job = replace(parse_job(JOB), trials="anything")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="trials"):
        make_plan(job, [])


def test_manifests_are_what_spreadsheets_write(tmp_path: Path) -> None:
    """With a mark at the beginning and semicolons, too; a path from Windows is told what is wrong with it."""
    save_recording(joint(1000), tmp_path / "a b.parquet")
    text = "File;Subject\na b.parquet;1\n.\\a b.parquet;2\n;\n"
    (tmp_path / "study.csv").write_text(text, encoding="utf-8-sig")
    plan = make_plan(parse_job(JOB), find_items([], tmp_path / "study.csv"))
    assert [item.metadata for item in plan.items] == [(("subject", "1"),), (("subject", "2"),)]
    words = plan.in_words(parse_job(JOB))
    assert words[0] == "2 recordings in 2 batches"
    assert words[1].startswith(f"refused: .\\a b.parquet: there is no file {tmp_path}/.\\a b.parquet: check the path")
    assert words[1].endswith("write / between folders")
    assert words[2] == "model: human; windows of 1 s every 0.05 s"
    assert batch.first_trouble(parse_job(JOB), plan) == ""
    trouble = batch.first_trouble(parse_job(JOB.replace("torque_Nm", "torque")), plan)
    assert trouble.startswith("a b.parquet would fail: ")
    assert "'torque_Nm'" in trouble
    (tmp_path / "study.csv").write_text("file,subject\na b.parquet,1\n,2\n")
    with pytest.raises(ValueError, match=r"study.csv, line 3: the column 'file' is empty"):
        find_items([], tmp_path / "study.csv")


def test_a_folder_that_is_there_is_not_touched(study: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").touch()
    with pytest.raises(ValueError, match="exists"):
        run(study, tmp_path / "mine")
    with pytest.raises(ValueError, match="not made by jaximp"):
        run(study, tmp_path / "mine", resume=True)


# --- workers ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_workers_give_the_same_bits_though_one_is_killed(study: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    import psutil

    killed: list[psutil.Process] = []

    def kill(event: dict[str, object]) -> None:
        """`kill -9` of a worker, when the first batch is done and the others are under way."""
        children = psutil.Process().children(recursive=True)
        workers = [child for child in children if "spawn_main" in " ".join(child.cmdline())]
        if event["event"] == "batch" and not killed:
            addresses = {connection.laddr.ip for worker in workers for connection in worker.net_connections("inet")}
            assert addresses <= {"127.0.0.1"}
            killed.append(workers[0])
            workers[0].kill()

    assert run(study, tmp_path / "out", workers=2, tell=kill).exit_status == 0
    assert killed
    assert content(tmp_path / "out") == content(study / "reference")
    assert json.loads((tmp_path / "out/quarantine.json").read_text()) == []


@pytest.mark.slow
def test_somebodys_cluster_gives_the_same(study: Path, tmp_path: Path) -> None:
    """Workers that know nothing of us, but for where we are installed."""
    distributed = pytest.importorskip("distributed")
    options = {"host": "127.0.0.1", "dashboard_address": None, "worker_dashboard_address": None, "silence_logs": 50}
    with distributed.LocalCluster(n_workers=1, threads_per_worker=2, processes=True, **options) as cluster:
        assert run(study, tmp_path / "out", scheduler=cluster.scheduler_address).exit_status == 0
    assert content(tmp_path / "out") == content(study / "reference")


def test_who_cannot_work_is_said_in_a_line(study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="one of the two"):
        run(study, tmp_path / "a", workers=2, scheduler="tcp://127.0.0.1:1")
    pytest.importorskip("distributed")
    monkeypatch.setattr(batch, "PATIENCE", 1.0)
    with pytest.raises(ValueError, match="no Dask scheduler answers at tcp://127"):
        run(study, tmp_path / "b", scheduler="tcp://127.0.0.1:1")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ValueError, match="jaximp\\[batch\\]"):
        run(study, tmp_path / "c", workers=1)


@pytest.mark.slow
def test_sigterm_ends_a_run_cleanly(study: Path, tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-c",
        "from jaximp.cli.main import main; main()",
        "batch",
        str(study / "job.toml"),
        "--quiet",
    ]
    command += ["--quiet", "--manifest", str(study / "study.csv"), "--out", str(tmp_path / "out")]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    while not (tmp_path / "out/batch.log").exists() and process.poll() is None:
        time.sleep(0.01)
    process.terminate()
    error = process.communicate(timeout=60)[1]
    assert process.returncode == 128 + signal.SIGTERM, error
    assert "Traceback" not in error
    assert not list((tmp_path / "out").rglob(f"*{batch_results.UNFINISHED}"))
    assert run(study, tmp_path / "out", resume=True).exit_status == 0
    assert content(tmp_path / "out") == content(study / "reference")
