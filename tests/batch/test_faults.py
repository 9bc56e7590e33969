"""Whatever happens to a batch on its way: nothing is lost, nothing differs, and it is said."""

from __future__ import annotations

import errno
import gc
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from factories.studies import JOB, LENGTHS, content, joint, run
from jaximp.batch import results as batch_results
from jaximp.batch import run as batch
from jaximp.batch import tables as batch_tables
from jaximp.batch import task as batch_task
from jaximp.batch.plan import find_items
from jaximp.identification.prepared import Prepared
from jaximp.jobs.job import parse_job
from jaximp.recordings.outputs import UNFINISHED
from jaximp.recordings.readers import formats
from jaximp.recordings.save import save_recording


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
        path.with_name(f".{path.name}.1{UNFINISHED}").write_bytes(b"PAR1")
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
    assert not list(out.rglob(f"*{UNFINISHED}"))


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

    fault.patch.setitem(formats.FORMATS, ".parquet", replace(formats.FORMATS[".parquet"], read=fail))
    assert run(fault.study, out).exit_status == 1


def too_many_files(fault: Fault, out: Path) -> None:
    """Files cannot be opened for a while."""
    original = formats.FORMATS[".parquet"].read

    def fail(path: Path, names: list[str]) -> object:
        if path.name == "r3.parquet":
            raise OSError(errno.EMFILE, "Too many open files")
        return original(path, names)

    fault.patch.setitem(formats.FORMATS, ".parquet", replace(formats.FORMATS[".parquet"], read=fail))
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
        for _ in range(30_000):
            if list(out.glob("receipts/*.json")) or process.poll() is not None:
                break
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


def test_a_full_disk_below_the_log_ends_no_run(tmp_path: Path) -> None:
    (tmp_path / "batch.log").symlink_to("/dev/full")
    told: list[dict[str, object]] = []
    with batch._log(tmp_path, told.append) as log:
        log({"event": "plan"})
    assert told == [{"event": "plan"}]


def test_a_design_behind_a_link_belongs_to_the_job(tmp_path: Path) -> None:
    (tmp_path / "design.json").write_text("{}")
    (tmp_path / "link.json").symlink_to("design.json")
    job = replace(parse_job(JOB, tmp_path), design="link.json")
    before = batch_results.job_checksum(job)
    (tmp_path / "design.json").write_text("[]")
    assert batch_results.job_checksum(job) != before


def test_a_name_that_is_no_text_can_be_told(tmp_path: Path) -> None:
    save_recording(joint(1000), tmp_path / "r0.parquet")
    (tmp_path / "r0.parquet").rename(os.fsdecode(os.fsencode(tmp_path) + b"/r\xff.parquet"))
    items = find_items([str(tmp_path)])
    assert [item.name for item in items] == ["r\\udcff.parquet"]
    told = batch_results.failure(items[0], "damaged")
    assert json.dumps(told).encode("ascii")
    assert batch_tables._texts([str(items[0].file)]).to_pylist() == [told["file"]]


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


@pytest.mark.slow
@pytest.mark.compiles
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
    assert "column 'torque_Nm', row 1: 'x' is not a number" in reasons["bad.csv"]
    assert "symbolic links" in reasons["link.parquet"]
    assert "no plain file" in reasons["pipe.parquet"]
    table = batch.read_recordings(tmp_path / "batch")
    assert dict(zip(table["recording"].to_pylist(), table["status"].to_pylist(), strict=True))["good.parquet"] == "ok"


def test_a_recording_that_claims_too_much_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import h5py

    with h5py.File(tmp_path / "huge.h5", "w") as file:
        for name in ("time_s", "position_rad", "torque_Nm"):
            file.create_dataset(name, (10**12,), chunks=(1000,), dtype="f8")
    monkeypatch.setattr(batch_task, "recording_from_mapping", lambda *args: pytest.fail("it was read"))
    outcome = batch.run(parse_job(JOB, tmp_path), [tmp_path], tmp_path / "out")
    assert "claims 1e+12 samples" in outcome.failed[0]["reason"]


def test_a_folder_that_is_there_is_not_touched(study: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").touch()
    with pytest.raises(ValueError, match="exists"):
        run(study, tmp_path / "mine")
    with pytest.raises(ValueError, match="not made by jaximp"):
        run(study, tmp_path / "mine", resume=True)


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
    log = tmp_path / "out/batch.log"
    while not (log.exists() and "plan" in log.read_text()) and process.poll() is None:
        time.sleep(0.01)
    process.terminate()
    error = process.communicate(timeout=60)[1]
    assert process.returncode == 128 + signal.SIGTERM, error
    assert "Traceback" not in error
    assert re.search(rf"\d of {len(LENGTHS)} recordings are done, and kept: run again with --resume", error)
    assert not list((tmp_path / "out").rglob(f"*{UNFINISHED}"))
    assert run(study, tmp_path / "out", resume=True).exit_status == 0
    assert content(tmp_path / "out") == content(study / "reference")


def test_a_second_run_into_the_folder_is_refused_and_a_dead_one_keeps_nobody_out(study: Path, tmp_path: Path) -> None:
    pytest.importorskip("fcntl")
    out, refused = tmp_path / "out", list[str]()

    def run_again(event: dict[str, Any]) -> None:
        if event["event"] == "plan" and not refused:
            with pytest.raises(ValueError, match="another run writes into") as error:
                run(study, out, resume=True)
            refused.append(str(error.value))

    assert run(study, out, tell=run_again).exit_status == 0
    assert refused == [f"another run writes into {out}: wait for it, or choose another --out"]
    assert run(study, out, resume=True).skipped == len(LENGTHS)


def test_an_unfinished_run_does_not_say_that_all_were_identified(capsys: pytest.CaptureFixture[str]) -> None:
    from jaximp.batch.run import Outcome
    from jaximp.cli import batch as command

    broken = Outcome(recordings=24, done=16, failed=[{"recording": "a", "reason": "b"}], broken=["batch 2: no space"])
    command._say_outcome(broken, Path("out"), resumed=False)
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("15 of 24 recordings identified")
    assert said[1] == "unfinished: 8 recordings are not done; run again with --resume"
