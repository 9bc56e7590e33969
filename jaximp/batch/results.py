"""One batch: its recordings are read, solved and judged, and its results written whole or not at all.

A batch writes one Parquet file of windows for every partition, one of recordings, and last of all a receipt: the
checksums of what went in and what came out. Every file is written under a temporary name and then renamed, so that
whatever breaks off a batch leaves either its receipt or nothing that counts.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any
from urllib.parse import quote

import pyarrow as pa
import pyarrow.parquet as pq

from jaximp.batch.plan import Batch, Item, printable
from jaximp.batch.tables import recordings_table, tells_residuals, windows_table
from jaximp.batch.task import FAILED, About, Result, Task, checksum, file_checksum, input_checksum, job_checksum, load
from jaximp.identification.identify import in_windows, solve_windows
from jaximp.identification.prepared import Prepared, prepare, share_of_stack, without_unknown_delay
from jaximp.identification.rows import Measured, measure, regress_stack
from jaximp.identification.solving import LAGS_GRAIN
from jaximp.jobs.job import WindowJob
from jaximp.recordings.errors import UnavailableError
from jaximp.recordings.outputs import write_whole
from jaximp.types import Recording, RobotAlone

_one_at_a_time = Lock()
"""What may use LAPACK or draws figures: such programs can block each other (experiments/lapack_threads.py)."""


class Interrupted(Exception):
    """The batch was asked to stop before it wrote anything."""


def solve_batch(task: Task, batch: Batch, stopped: Callable[[], bool] = lambda: False) -> dict[str, Any]:
    """Read, solve, judge and write a batch.

    **Returns:** its receipt, which is on disk too.

    **Raises:** `Interrupted` if it is to stop, `OSError` where results cannot be written. What is wrong with a
    recording raises nothing: the receipt says it.
    """
    begin, key = time.perf_counter(), task.key(batch)
    results, unwritten = list[Result](), dict[str, str]()
    for item in batch.items:
        result = _read(task, batch, item)
        if result.stacked is None and result.recording is not None:
            _solve_alone(task, result)
            unwritten |= _write_reports(task, [result])
            result.recording = result.held_out = None  # what is identified by itself may be long
        results.append(result)
        if stopped():
            raise Interrupted
    _solve_stacks(task, results)
    if stopped():
        raise Interrupted
    unwritten |= _write_reports(task, results)
    outputs = _write_tables(task, batch, results)
    doubts = [f"{result.item.name}: {result.remark}" for result in results if result.estimates and result.remark]
    receipt = {
        "batch": batch.number,
        "key": key,
        "job": job_checksum(task.job),
        "inputs": {result.item.name: result.sha256 for result in results},
        "outputs": outputs,
        "failed": [failure(result.item, result.reason) for result in results if result.status == FAILED],
        "doubted": len(doubts),
        "doubt": min(doubts, default=""),
        "windows": sum(len(result.estimates[0].start) for result in results if result.estimates),
        "trusted": sum(int(result.estimates[0].verdicts.trusted.sum()) for result in results if result.estimates),
        "run": {"seconds": time.perf_counter() - begin, "without_report": unwritten},
    }
    write_whole(receipt_path(task.out, batch), (json.dumps(receipt, indent=1) + "\n").encode())
    return receipt


def failure(item: Item, reason: str) -> dict[str, Any]:
    """One line of the quarantine."""
    about = {"recording": item.name, "file": printable(str(item.file)), "reason": printable(reason)}
    return about | {"metadata": dict(item.metadata)}


def receipt_path(out: Path, batch: Batch) -> Path:
    return out / "receipts" / f"batch-{batch.number:05d}.json"


def finished(task: Task, batch: Batch) -> dict[str, Any] | None:
    """The receipt of a batch that is complete and still matches its inputs, the job and its own files."""
    try:
        receipt: dict[str, Any] = json.loads(receipt_path(task.out, batch).read_text(encoding="utf-8"))
        if receipt["key"] != task.key(batch):
            return None
        if any(receipt["inputs"][item.name] != input_checksum(item) for item in batch.items):
            return None
        if any(file_checksum(task.out / name) != found for name, found in receipt["outputs"].items()):
            return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return receipt


def earlier_inputs(out: Path) -> dict[str, tuple[str, str]]:
    """Of every recording that has results: the checksums of the job and of the input that they were made from."""
    found: dict[str, tuple[str, str]] = {}
    for path in (out / "receipts").glob("batch-*.json"):
        with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
            receipt = json.loads(path.read_text(encoding="utf-8"))
            found |= {name: (receipt["job"], sha256) for name, sha256 in receipt["inputs"].items()}
    return found


def report_holds(task: Task, item: Item, earlier: Mapping[str, tuple[str, str]]) -> bool:
    """Whether the report of an earlier run is still that of this recording."""
    return earlier.get(item.name) == (job_checksum(task.job), input_checksum(item))


# --- reading and solving ----------------------------------------------------------------------------------------------


def _read(task: Task, batch: Batch, item: Item) -> Result:
    """A recording, and what is measured of it while its numbers are at hand."""
    begin = time.perf_counter()
    result = Result(item, sha256=input_checksum(item), reason=item.refused)
    if not result.reason:
        with _reasons(result):
            whole = load(task.job.recording, item.file, task.job.folder)
            recording, result.held_out = task.job.without_held_out(whole), task.job.load_held_out(whole)
            if recording.n_joints != task.joints:
                raise ValueError(
                    f"{item.file}: it has {recording.n_joints} joints, but this study {task.joints}: name the columns "
                    "of each joint, or make a study of its own"
                )
            pipeline = task.job.pipeline_for(recording)
            recording = without_unknown_delay(pipeline, recording)
            result.recording, result.about = recording, About.of(recording)
            size = next((size for size in task.sizes if size[0] >= len(recording)), None)
            if batch.padded and size is not None:
                pipeline.check(recording)
                found = measure(pipeline, recording)
                result.stacked = (*size, _kind_of(found)), found
    result.seconds = time.perf_counter() - begin
    return result


class _reasons:
    """Whatever goes wrong with a recording becomes the reason why it failed; to run out of memory does not."""

    def __init__(self, result: Result):
        self.result = result

    def __enter__(self) -> None: ...

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> bool:
        if not isinstance(error, Exception) or isinstance(error, MemoryError):
            return False
        if "RESOURCE_EXHAUSTED" in str(error):
            return False  # XLA's way to say it
        if isinstance(error, OSError | UnavailableError):
            self.result.sha256 = ""  # another run is to try again
        expected = isinstance(error, ValueError | OSError)
        text = str(error).removeprefix(f"{self.result.item.file}: ")
        text = " ".join(text.removeprefix(f"{os.path.abspath(self.result.item.file)}: ").split())
        self.result.reason = text if expected else f"{type(error).__name__}: {text}"
        self.result.estimates = []
        return True


def _solve_alone(task: Task, result: Result) -> None:
    """Estimates of a recording that is not stacked, or the reason why there are none."""
    begin = time.perf_counter()
    if result.recording is not None and not result.reason:
        with _reasons(result), _one_at_a_time:
            pipeline = task.job.pipeline_for(result.recording)
            prepared = prepare(pipeline, result.recording, _alone(task, result.item), result.held_out)
            result.estimates = in_windows(prepared, curves=tells_residuals(task.job))
    result.seconds += time.perf_counter() - begin


def _solve_stacks(task: Task, results: Sequence[Result]) -> None:
    """Estimates of every recording that is stacked, or the reason why there are none."""
    stacks = dict[Any, list[tuple[Result, Measured]]]()
    for result in results:
        if result.stacked is not None:
            kind, found = result.stacked
            stacks.setdefault(kind, []).append((result, found))
    for (padded, stacked, _), members in stacks.items():
        begin = time.perf_counter()
        prepared: Sequence[Prepared | ValueError]
        try:
            prepared = _prepared([found for _, found in members], padded, stacked)
        except ValueError as error:
            prepared = [error] * len(members)
        share = (time.perf_counter() - begin) / len(members)
        for (result, _), one in zip(members, prepared, strict=True):
            begin = time.perf_counter()
            with _reasons(result):
                if isinstance(one, ValueError):
                    raise one
                result.estimates = in_windows(one, curves=False)
            result.seconds += share + time.perf_counter() - begin


def _kind_of(found: Measured) -> tuple[Any, ...]:
    """What recordings must have in common to be solved by one program."""
    pipeline, filters = found.pipeline, found.pipeline.filters
    lags = 0 if filters.noise is None else -(-len(filters.noise) // LAGS_GRAIN)
    half = filters.differentiator.half
    return found.model, filters.decimate, half, pipeline.window_rows, pipeline.step_rows, lags, pipeline.ordinary


def _prepared(several: Sequence[Measured], padded: int, stacked: int) -> list[Prepared | ValueError]:
    """Filtered and solved as one stack; or why nothing is left of a recording."""
    found, results = regress_stack(several, padded, stacked), list[Prepared | ValueError]()
    for k, one in enumerate(several):
        try:
            results.append(share_of_stack(one, found, k))
        except ValueError as error:
            results.append(error)
    left = [one for one in results if isinstance(one, Prepared)]
    rows = -(-padded // several[0].pipeline.filters.decimate)
    solved = iter(solve_windows(left, rows, stacked) if left else [])
    return [next(solved) if isinstance(one, Prepared) else one for one in results]


def _alone(task: Task, item: Item) -> RobotAlone:
    """The recording of the robot alone, or both: the manifest's, or the job's."""
    job, several = task.job, []
    for table, named in ((job.robot_recording, item.robot_file), (job.robot_recording_after, item.robot_file_after)):
        if table is not None:
            file = named or job.folder / str(table["file"])
            several.append(_robot_alone(json.dumps(dict(table), sort_keys=True), file, job.folder, file_checksum(file)))
    if len(several) == 2:
        return several[0], several[1]
    return several[0] if several else None


@lru_cache(maxsize=4)
def _robot_alone(table: str, file: Path, folder: Path, content: str) -> Recording:
    """A file of this content is read once."""
    return load(json.loads(table), file, folder)


# --- tables -----------------------------------------------------------------------------------------------------------


def _write_tables(task: Task, batch: Batch, results: Sequence[Result]) -> dict[str, str]:
    """Write windows and recordings; the checksum of each file by its path below the output."""
    name, written = f"batch-{batch.number:05d}.parquet", {}
    tables = {f"recordings/{name}": recordings_table(task, results)}
    groups: dict[str, list[Result]] = {}
    for result in results:
        if result.estimates:
            groups.setdefault(result.item.partition(task.partitions), []).append(result)
    for partition, members in groups.items():
        for k, first in enumerate(members[0].estimates):
            folder = "estimates" if k == 0 else f"estimates_method{first.method}"
            path = "/".join(filter(None, (folder, partition, name)))
            tables[path] = windows_table(task, members, k)
    for path, table in tables.items():
        written[path] = _write_table(task.out / path, table)
    return written


def _write_table(path: Path, table: pa.Table) -> str:
    """Returns the file's checksum."""
    buffer = pa.BufferOutputStream()
    texts = [column.name for column in table.schema if column.type == pa.string()]
    pq.write_table(table, buffer, use_dictionary=texts, compression="zstd")
    content = buffer.getvalue().to_pybytes()
    write_whole(path, content)
    return checksum(content)


def write_suspicions(out: Path, suspicions: Mapping[str, str]) -> None:
    """Say in the recordings' tables what only all of them together tell; receipts hold the new checksums.

    A run that is broken off in between finds a table that is not that of its receipt, and does the batch again.
    """
    for path in sorted((out / "recordings").glob("batch-*.parquet")):
        table = pq.ParquetFile(path).read()
        if "suspicion" not in table.column_names:  # of a version that did not have it
            continue
        said = [suspicions.get(name, "") for name in table["recording"].to_pylist()]
        if said == table["suspicion"].to_pylist():
            continue
        place = table.column_names.index("suspicion")
        table = table.set_column(place, table.schema.field(place), pa.array(said, pa.string()))
        sha256 = _write_table(path, table)
        receipt_file = out / "receipts" / f"{path.stem}.json"
        receipt = json.loads(receipt_file.read_text(encoding="utf-8"))
        receipt["outputs"][f"recordings/{path.name}"] = sha256
        write_whole(receipt_file, (json.dumps(receipt, indent=1) + "\n").encode())


# --- reports ----------------------------------------------------------------------------------------------------------


def report_folder(out: Path, name: str) -> Path:
    """Where the report of a recording stands; what is no plain letter in its name is percent-encoded."""
    plain = quote(name, safe="")
    plain = plain.replace(".", "%2E", plain.startswith("."))
    return out / "reports" / (plain if len(plain) < 200 else checksum(name.encode()))


def report_wanted(task: Task, name: str, windows: int, trusted: int) -> bool:
    """Whether a recording gets a report; of one that could not be identified there is none."""
    if not windows or isinstance(task.reports, tuple):
        return windows > 0 and name in task.reports
    return task.reports == "all" or (task.reports == "failed" and not trusted)


def _write_reports(task: Task, results: Sequence[Result]) -> dict[str, str]:
    """The reports that were asked for, as `identify` writes them; why there is none of some recordings."""
    unwritten: dict[str, str] = {}
    for result in results:
        if result.recording is None or not result.estimates:
            continue
        trusted = result.estimates[0].verdicts.trusted
        if report_wanted(task, result.item.name, len(trusted), int(trusted.sum())):
            why = _write_report(task, result.item, result.recording, result.held_out)
            unwritten |= {result.item.name: why} if why else {}
    return unwritten


def write_late_report(task: Task, item: Item) -> str:
    """The report of a recording that was identified before, and nothing; or why there is none."""
    found = Result(item)
    with _reasons(found):
        whole = load(task.job.recording, item.file, task.job.folder)
        found.held_out, found.recording = task.job.load_held_out(whole), task.job.without_held_out(whole)
    return found.reason if found.recording is None else _write_report(task, item, found.recording, found.held_out)


def _write_report(task: Task, item: Item, recording: Recording, held_out: Recording | None) -> str:
    """Nothing, or why it could not be written: a report that fails must not cost a batch."""
    found = Result(item)
    with _one_at_a_time, _reasons(found):
        about = {"recording": str(item.file), **dict(item.metadata)}
        lines = [printable(f"# {name}: {' '.join(value.split())}\n") for name, value in about.items()]
        job = replace(task.job, text="".join(lines) + task.job.text)
        named = replace(recording, name=item.name)
        write_report_of(job, named, _alone(task, item), report_folder(task.out, item.name), held_out)
    return found.reason


def write_report_of(
    job: WindowJob, recording: Recording, alone: RobotAlone, folder: Path, held_out: Recording | None = None
) -> None:
    """What `identify` writes, for one recording."""
    from jaximp.identification.identify import at_other_lengths, longest_of
    from jaximp.recordings.outputs import new_folder
    from jaximp.reports.estimates import write_results

    prepared = prepare(job.pipeline_for(recording), recording, alone, held_out)
    estimates = in_windows(prepared, longest=longest_of(prepared))
    others = at_other_lengths(prepared, alone)
    with new_folder(folder, force=True) as draft:
        lengths = [] if longest_of(prepared) is None else sorted([estimates[0], *others], key=lambda e: e.window)
        write_results(draft, estimates, lengths, job, recording)
