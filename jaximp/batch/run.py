"""Thousands of recordings by one job: the same batches on threads, on local workers or on somebody's cluster.

Nothing is ever lost: a recording that fails is quarantined and the rest goes on; a run that was broken off, in whatever
way, is taken up by `resume`, which skips every batch whose receipt still matches and gives the same bits as a run that
nobody disturbed.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from jaximp.batch.overview import Series, thinned, write_overview
from jaximp.batch.plan import LOG, Batch, Item, Plan, find_items, make_plan, of_recordings
from jaximp.batch.results import (
    Interrupted,
    earlier_inputs,
    finished,
    receipt_path,
    report_folder,
    report_holds,
    report_wanted,
    write_late_report,
    write_suspicions,
)
from jaximp.batch.tables import RUN_COLUMNS, reserved_columns
from jaximp.batch.task import Task, load
from jaximp.batch.workers import Found, solved
from jaximp.jobs.job import Job, WindowJob
from jaximp.numerics.cores import cores
from jaximp.numerics.precision import require_float64
from jaximp.plots.wording import main_parameter
from jaximp.recordings.outputs import MARK, UNFINISHED, write_whole
from jaximp.trust.verdicts import TRUSTED
from jaximp.types import nearest

Tell = Callable[[dict[str, Any]], None]
"""Called with what happens: `{"event": "batch", "done": 64, ...}`."""

FOLDERS = r"estimates(_method\d)?|recordings|receipts"
FILES = rf"batch-\d+\.(parquet|json)|\..*{UNFINISHED}"
"""What a batch writes, and where; all else in a folder of results is somebody's own."""
PAGE = "overview.html"
HIDDEN = (
    "samples", "sample_rate_hz", "threshold", "notes", "model", "filters", "versions", "sha256", "job_sha256",
    *RUN_COLUMNS,
)  # fmt: skip
"""Columns of the recordings that the page leaves out."""
SCALED = ("inertia", "damping", "stiffness")
"""Parameters that a wrong unit of the position makes larger or smaller alike."""
ODD, FEWEST = 20.0, 5
"""How many times larger or smaller than in the median recording they are then (57, if degrees were meant); and of how
many recordings there is a median to speak of."""
MOST_GROUPS = 100
"""Groups whose means the page tells; more are no comparison."""


@dataclass
class Outcome:
    """What became of a study."""

    recordings: int = 0
    windows: int = 0
    trusted: int = 0
    done: int = 0
    """Recordings whose batch is finished, by this run or an earlier one."""
    skipped: int = 0
    """Recordings that an earlier run had done."""
    outdated: int = 0
    """Reports of an earlier run that were removed: the recording, or the job, is another one now."""
    dropped: int = 0
    """Recordings of an earlier run that this one does not have; their results were removed."""
    failed: list[dict[str, Any]] = field(default_factory=list)
    """Recordings in quarantine: `recording`, `file`, `reason`, `metadata`."""
    doubted: int = 0
    """Recordings without a trusted window, and what is said of the first of them."""
    doubt: str = ""
    odd: dict[str, str] = field(default_factory=dict)
    """Recordings whose parameters are of another size than those of the study."""
    broken: list[str] = field(default_factory=list)
    """Batches that could not be finished, and why: `resume` does them again."""

    @property
    def exit_status(self) -> int:
        return 1 if self.broken else 3 if self.failed else 0


def run(
    job: Job,
    files: Sequence[str | Path] = (),
    out: str | Path = "batch",
    *,
    manifest: str | Path | None = None,
    allow_outside: bool = False,
    partitions: Sequence[str] | None = None,
    workers: int = 0,
    scheduler: str | None = None,
    resume: bool = False,
    reports: str | Sequence[str] = "none",
    tell: Tell = lambda event: None,
) -> Outcome:
    """Identify many recordings by one job.

    **Arguments:** `files` recordings, patterns or folders, or else a `manifest` (`batch_plan.find_items`); `out` the
    folder of the results; `partitions` the manifest's columns that results are partitioned by; `workers` processes on
    this machine, or the address of a Dask `scheduler`, whose workers see the same files; `resume` takes up a run that
    was broken off; `reports` of `all` recordings, of those `failed` (without a trusted window), of `none`, or of those
    with these names: with `resume` they are written of recordings that are done, too.

    **Raises:** `ValueError` for what cannot be begun; `KeyboardInterrupt` ends cleanly.
    """
    job = of_recordings(job)
    items = find_items([str(file) for file in files], None if manifest is None else Path(manifest), allow_outside)
    return run_plan(job, make_plan(job, items, partitions), out, workers, scheduler, resume, reports, tell)


def run_plan(
    job: WindowJob,
    plan: Plan,
    out: str | Path,
    workers: int = 0,
    scheduler: str | None = None,
    resume: bool = False,
    reports: str | Sequence[str] = "none",
    tell: Tell = lambda event: None,
) -> Outcome:
    """As `run`, for a plan that is made."""
    require_float64()
    if workers and scheduler is not None:
        raise ValueError("give either workers of this machine or the address of a scheduler, one of the two")
    out = Path(os.path.abspath(out))
    check_metadata(job, plan)
    chosen = _checked_reports(reports, plan)
    _prepare_folder(out, resume, plan.items)
    task, outcome = Task.of(job, plan, out, chosen), Outcome(recordings=len(plan.items))
    with _alone_in(out), _log(out, tell) as log, _signals_heard() as check:
        try:
            log({"event": "plan", "recordings": len(plan.items), "batches": len(plan.batches)})
            left = _sweep(task, plan, outcome, log) if resume else list(plan.batches)
            _follow(solved(task, left, workers, scheduler, check), outcome, log)
            check()
        except (KeyboardInterrupt, SystemExit):
            log({"event": "interrupted", "done": outcome.done, "of": outcome.recordings})
            raise
        outcome.failed.sort(key=lambda failed: str(failed["recording"]))
        write_whole(out / "quarantine.json", (json.dumps(outcome.failed, indent=1) + "\n").encode())
        if len(outcome.broken) < len(plan.batches):
            earlier = {item for batch in {*plan.batches} - {*left} for item in batch.items}
            _write_pages(task, plan, sorted(earlier, key=lambda item: item.name), outcome, log)
        log(
            {"event": "done", "recordings": outcome.recordings, "windows": outcome.windows, "trusted": outcome.trusted,
             "failed": len(outcome.failed), "skipped": outcome.skipped, "broken": len(outcome.broken)}
        )  # fmt: skip
    return outcome


def _follow(batches: Found, outcome: Outcome, log: Tell) -> None:
    """Take up what becomes of each batch, and say it."""
    begin = time.perf_counter()
    for batch, found in batches:
        if isinstance(found, BaseException):
            why = f"{type(found).__name__}: {' '.join(str(found).split())}"
            outcome.broken.append(f"batch {batch.number}: {why}")
            log({"event": "broken", "batch": batch.number, "reason": why})
            continue
        _take_up(outcome, batch, found)
        for failed in found["failed"]:
            log({"event": "failed", **failed})
        for name, why in found["run"]["without_report"].items():
            log({"event": "no report", "recording": name, "reason": why})
        rate = (outcome.done - outcome.skipped) / max(time.perf_counter() - begin, 1e-9)
        log(
            {"event": "batch", "batch": batch.number, "done": outcome.done, "of": outcome.recordings,
             "failed": len(outcome.failed), "per_second": rate}
        )  # fmt: skip


def _write_pages(task: Task, plan: Plan, earlier: Sequence[Item], outcome: Outcome, log: Tell) -> None:
    """Reports that are asked for late, of recordings that were done earlier, and the overview."""
    try:
        _write_late_reports(task, earlier, log)
        outcome.odd = write_page(task.out, plan.metadata, plan.partitions)
        write_suspicions(task.out, outcome.odd)
        for name, why in outcome.odd.items():
            log({"event": "odd", "recording": name, "reason": why})
    except OSError as error:
        outcome.broken.append(f"{PAGE}: {error.strerror or error}")


def _checked_reports(reports: str | Sequence[str], plan: Plan) -> str | tuple[str, ...]:
    if isinstance(reports, str) and reports in ("all", "failed", "none"):
        return reports
    names, known = (reports,) if isinstance(reports, str) else tuple(reports), [item.name for item in plan.items]
    for name in set(names) - set(known):
        if name in ("all", "failed", "none"):
            raise ValueError(f"reports: '{name}' stands alone: give it, or names of recordings")
        hint = nearest(name, known)
        raise ValueError(f"there is no recording '{name}' to report: give all, failed, none or a name; {hint}")
    return names


def check_metadata(job: WindowJob, plan: Plan) -> None:
    """Refuse a manifest whose columns have the names of results."""
    for name in plan.metadata:
        if name in reserved_columns(job):
            raise ValueError(f"the manifest's column '{name}' has the name of a result: rename it")


def first_trouble(job: WindowJob, plan: Plan) -> str:
    """What the first recording that is to be read would fail by, if so: mostly all others would as well."""
    item = next((item for item in plan.items if not item.refused), None)
    if item is not None:
        try:
            recording = load(job.recording, item.file, job.folder)
            job.pipeline_for(recording).check(recording)
        except (ValueError, OSError) as error:
            return f"{item.name} would fail: {error}"
    return ""


def _take_up(outcome: Outcome, batch: Batch, receipt: dict[str, Any]) -> None:
    outcome.done += len(batch.items)
    outcome.failed += receipt["failed"]
    outcome.windows += receipt["windows"]
    outcome.trusted += receipt["trusted"]
    outcome.doubted += receipt["doubted"]
    outcome.doubt = min(filter(None, (outcome.doubt, receipt["doubt"])), default="")


# --- the folder -------------------------------------------------------------------------------------------------------


def _prepare_folder(out: Path, resume: bool, items: Sequence[Item]) -> None:
    if out.exists() and not resume:
        raise ValueError(f"{out} exists: choose another --out, or pass --resume to take up what it holds")
    if out.exists() and not (out / MARK).is_file() and any(out.iterdir()):
        raise ValueError(f"{out} was not made by jaximp: choose another --out")
    if any(out in item.file.parents for item in items):
        raise ValueError(f"{out} holds recordings: choose another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / MARK).touch()
    except OSError as error:
        raise ValueError(f"{out} cannot be written: {error.strerror}; choose another --out") from None


@contextmanager
def _alone_in(out: Path) -> Iterator[None]:
    """No other run writes into the folder meanwhile. The system lets go of the lock, however a run ends; where it has
    none, or the file system, nobody is kept out."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    with (out / MARK).open("a") as mark:
        try:
            fcntl.flock(mark, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ValueError(f"another run writes into {out}: wait for it, or choose another --out") from None
        except OSError:
            pass
        yield


def _sweep(task: Task, plan: Plan, outcome: Outcome, log: Tell) -> list[Batch]:
    """Leave nothing but what complete batches wrote; which batches are to be done."""
    with ThreadPoolExecutor(cores()) as pool:
        receipts = list(pool.map(lambda batch: finished(task, batch), plan.batches))
    earlier = earlier_inputs(task.out)
    outcome.dropped = len(set(earlier) - {item.name for item in plan.items})
    kept, left = set[Path](), []
    for batch, receipt in zip(plan.batches, receipts, strict=True):
        if receipt is None:
            left.append(batch)
            for item in batch.items:
                folder = report_folder(task.out, item.name)
                if folder.is_dir() and not report_holds(task, item, earlier):
                    outcome.outdated += 1
                    shutil.rmtree(folder, ignore_errors=True)
            continue
        kept |= {receipt_path(task.out, batch), *(task.out / name for name in receipt["outputs"])}
        _take_up(outcome, batch, receipt)
        outcome.skipped += len(batch.items)
    for folder in task.out.iterdir():
        if folder.is_symlink() or not folder.is_dir() or not re.fullmatch(FOLDERS, folder.name):
            continue
        for where, _, names in os.walk(folder, topdown=False):
            for path in (Path(where) / name for name in names):
                if path not in kept and re.fullmatch(FILES, path.name):
                    path.unlink()
            with suppress(OSError):
                Path(where).rmdir()  # unless it still holds something
    for path in task.out.glob(f".*{UNFINISHED}"):
        path.unlink()
    for draft in (task.out / "reports").glob(".*"):
        shutil.rmtree(draft, ignore_errors=True)
    log(
        {"event": "resume", "skipped": outcome.skipped, "left": sum(len(batch.items) for batch in left),
         "dropped": outcome.dropped, "reports_removed": outcome.outdated}
    )  # fmt: skip
    return left


@contextmanager
def _log(out: Path, tell: Tell) -> Iterator[Tell]:
    """What happens goes to batch.log as well, a line of JSON each. A full disk must not end a run by its log."""
    file = (out / LOG).open("a", encoding="utf-8")

    def log(event: dict[str, Any]) -> None:
        with suppress(OSError):
            file.write(json.dumps({"time": time.strftime("%Y-%m-%dT%H:%M:%S%z"), **event}) + "\n")
            file.flush()
        tell(event)

    try:
        yield log
    finally:
        with suppress(OSError):
            file.close()


@contextmanager
def _signals_heard() -> Iterator[Callable[[], None]]:
    """A function that raises once more what a signal raised: while garbage is collected, Python drops exceptions."""
    heard: list[int] = []
    handlers: dict[int, Any] = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def hear(number: int, frame: Any) -> None:
        heard.append(number)
        handlers[number](number, frame)

    def check() -> None:
        if heard:
            handlers[heard[0]](heard[0], None)

    ours = [number for number, handler in handlers.items() if callable(handler) and not isinstance(handler, int)]
    if threading.current_thread() is not threading.main_thread():
        ours = []
    for number in ours:
        signal.signal(number, hear)
    try:
        yield check
    finally:
        for number in ours:
            signal.signal(number, handlers[number])


# --- what was found ---------------------------------------------------------------------------------------------------


def read_recordings(out: str | Path) -> pa.Table:
    """One row per recording of a finished batch, in the order of their names."""
    import pyarrow.dataset as ds

    files = sorted(str(path) for path in (Path(out) / "recordings").glob("batch-*.parquet"))
    tables = [ds.dataset(file, format="parquet").to_table() for file in files]
    if not tables:
        raise ValueError(f"{out} holds no recordings: run the batch first")
    return pa.concat_tables(tables, promote_options="permissive").sort_by("recording")


def write_page(out: str | Path, metadata: Sequence[str] = (), groups: Sequence[str] = ()) -> dict[str, str]:
    """The overview of a finished batch (`overview.write_overview`), with links to the reports that there are.

    **Arguments:** `metadata` the manifest's columns, whose empty values are not known; `groups` those whose values are
    compared. Subjects are none: they are what is averaged.

    **Returns:** recordings whose parameters are of another size than those of the study, and what is said of them.
    """
    out = Path(out)
    table = read_recordings(out)
    found = [name for name in table.column_names if name not in metadata]
    parameters = [name.removesuffix("_mean") for name in found if name.endswith("_mean")]
    odd = _odd(table, [name for name in parameters if name.endswith(SCALED)])
    names, reasons = table["recording"].to_pylist(), table["reason"].to_pylist()
    table = _with_texts(table, "reason", [odd.get(name, why) for name, why in zip(names, reasons, strict=True)])
    table = _with_texts(table, "suspicion", [odd.get(name, "") for name in names])
    # One window has no spread, and nothing over time: its interval is told instead.
    several = any(windows > 1 for windows in table["windows"].to_pylist())
    left_out = ("_median_stderr", "_half_width_95" if several else "_sd")
    details = {f"{name}{end}" for name in parameters for end in left_out}
    table = table.select([name for name in table.column_names if name not in {*HIDDEN, *details}])
    for name in metadata:
        table = _with_texts(table, name, [text or None for text in table[name].to_pylist()])
    groups = [name for name in groups if name != "subject"]
    if groups and len(set(zip(*(table[name].to_pylist() for name in groups), strict=True))) > MOST_GROUPS:
        groups = []
    reports = {name: report_folder(out, name) / "report.html" for name in names}
    links = {name: file.relative_to(out).as_posix() for name, file in reports.items() if file.is_file()}
    series = _series(out, main_parameter(parameters)) if parameters and several else {}
    unfinished = out / f".{PAGE}{UNFINISHED}"
    try:
        write_overview(unfinished, table, series, groups, links)
        os.replace(unfinished, out / PAGE)
    finally:
        unfinished.unlink(missing_ok=True)
    return odd


def _with_texts(table: pa.Table, name: str, texts: Sequence[str | None]) -> pa.Table:
    """The table with other texts in a column, or with that column."""
    if name not in table.column_names:
        return table.append_column(pa.field(name, pa.string()), pa.array(texts, pa.string()))
    return table.set_column(table.column_names.index(name), table.schema.field(name), pa.array(texts, pa.string()))


def _odd(table: pa.Table, parameters: Sequence[str]) -> dict[str, str]:
    """Every recording is judged by itself; that one was measured in other units, only the others can tell."""
    if len(parameters) < 2:
        return {}
    sizes = np.abs([table[f"{name}_mean"].to_numpy() for name in parameters])
    known = np.isfinite(sizes).all(axis=0)
    if known.sum() < FEWEST:
        return {}
    with np.errstate(all="ignore"):
        ratios = sizes / np.median(sizes[:, known], axis=1, keepdims=True)
        odd = (ratios > ODD).all(axis=0) | (ratios < 1 / ODD).all(axis=0)
    names, shares = table["recording"].to_pylist(), [f"{parameters[-1]} is {ratio:.2g} times" for ratio in ratios[-1]]
    why = "that of the median recording, and the other parameters likewise: are its units those of the others?"
    return {names[k]: f"{shares[k]} {why}" for k in np.flatnonzero(odd)}


def _series(out: Path, parameter: str) -> dict[str, Series]:
    """One parameter of every recording over time, as much of it as a panel shows; file by file."""
    found: dict[str, Series] = {}
    for file in sorted((out / "estimates").rglob("batch-*.parquet")):
        columns = ["recording", "end_s", parameter, "verdict"]
        table = pq.ParquetFile(file, read_dictionary=["recording", "verdict"]).read(columns=columns).combine_chunks()
        names, ends, values, verdicts = (table[name].chunk(0) for name in columns)
        trusted = np.array([text == TRUSTED for text in verdicts.dictionary.to_pylist()])[verdicts.indices]
        which = names.indices.to_numpy()
        ends_of = np.flatnonzero(np.r_[which[1:] != which[:-1], True]) + 1
        for begin, end in zip([0, *ends_of[:-1]], ends_of, strict=True):
            one = slice(begin, end)
            series = Series(ends.to_numpy()[one], values.to_numpy(zero_copy_only=False)[one], trusted[one])
            found[str(names[int(begin)])] = thinned(series)
    return found


def _write_late_reports(task: Task, items: Sequence[Item], log: Tell) -> None:
    """Reports of recordings that were identified by an earlier run."""
    if task.reports == "none" or not items:
        return
    rows = read_recordings(task.out)
    counts = zip(*(rows[name].to_pylist() for name in ("recording", "windows", TRUSTED)), strict=True)
    wanted = {name for name, windows, trusted in counts if report_wanted(task, name, windows, trusted)}
    for item in items:
        if item.name in wanted and not (report_folder(task.out, item.name) / "report.html").is_file():
            why = write_late_report(task, item)
            if why:
                log({"event": "no report", "recording": item.name, "reason": why})


__all__ = ["Interrupted", "Outcome", "find_items", "make_plan", "read_recordings", "run", "run_plan", "write_page"]
