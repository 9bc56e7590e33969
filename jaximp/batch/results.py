"""One batch: its recordings are read, solved and judged, and its results written whole or not at all.

A batch writes one Parquet file of windows for every partition, one of recordings, and last of all a receipt: the
checksums of what went in and what came out. Every file is written under a temporary name and then renamed, so that
whatever breaks off a batch leaves either its receipt or nothing that counts.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from jaximp.batch.plan import MOST_SAMPLES, Batch, Item, Plan, channel_columns, printable, why_refused
from jaximp.identification.estimates import Estimates
from jaximp.identification.filter_settings import design_filters
from jaximp.identification.identify import Prepared, in_windows, prepare, share_of_stack, solve_windows
from jaximp.identification.regression import Measured, measure, regress_stack
from jaximp.identification.solving import LAGS_GRAIN
from jaximp.jobs.job import WindowJob
from jaximp.least_squares.window import confidence_interval
from jaximp.models.base import Joints, Model
from jaximp.models.reflex import pathway_of
from jaximp.recordings.errors import RecordingError, UnavailableError
from jaximp.recordings.load import recording_from_mapping
from jaximp.recordings.readers.formats import MATRICES, count_samples
from jaximp.reports.estimates import estimates_table
from jaximp.reports.pages import table_of, versions
from jaximp.trust.verdicts import VERDICTS
from jaximp.types import Recording

UNFINISHED = ".unfinished"
"""End of a temporary name."""
RUN_COLUMNS = ("seconds",)
"""Columns of the recordings' table that differ from run to run."""
WINDOW_COLUMNS = (
    "recording", "start_s", "end_s", "equilibrium", "condition_number", "sigma_min", "residual_rms", "vaf",
    "held_out_vaf", "dof", "samples", "verdict", "reason", "reflex_gain", "reflex_gain_stderr", "reflex_delay",
)  # fmt: skip
"""Columns of the windows beside the parameters."""
OK, FAILED = "ok", "failed"
ANY_RATE = 1000.0
"""Of recordings that could not be read [Hz]: a model's names do not depend on it."""

_one_at_a_time = Lock()
"""What may use LAPACK or draws figures: such programs can block each other (experiments/lapack_threads.py)."""


class Interrupted(Exception):
    """The batch was asked to stop before it wrote anything."""


@dataclass(frozen=True)
class Task:
    """What every batch of a run has in common; it travels to workers."""

    job: WindowJob
    out: Path
    metadata: tuple[str, ...]
    partitions: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    joints: int
    """Of every recording."""
    reports: str | tuple[str, ...] = "none"
    """`all`, `failed` (recordings without a trusted window), `none`, or the names of some."""

    @classmethod
    def of(cls, job: WindowJob, plan: Plan, out: Path, reports: str | tuple[str, ...] = "none") -> Task:
        return cls(job, out, plan.metadata, plan.partitions, plan.sizes, joints_of(job, plan.items), reports)

    def key(self, batch: Batch) -> str:
        """Checksum of everything that a batch's results depend on, its inputs' content apart."""
        members = [(item.name, item.metadata, str(item.robot_file or ""), item.refused) for item in batch.items]
        study = [job_checksum(self.job), versions(), self.partitions, self.metadata, self.sizes, self.joints]
        about = [*study, batch.padded, members]
        return checksum(json.dumps(about, sort_keys=True).encode())


class About(NamedTuple):
    """Of a recording that could be read."""

    joints: tuple[str, ...]
    samples: int
    sample_rate: float
    duration: float
    """[s]"""
    valid_share: float

    @classmethod
    def of(cls, one: Recording) -> About:
        duration = float(one.time[-1] - one.time[0])
        return cls(one.joints, len(one), one.sample_rate, duration, float(one.valid.mean()))


@dataclass
class Result:
    """What became of one recording."""

    item: Item
    estimates: list[Estimates] = field(default_factory=list)
    """One for each method; none where it failed."""
    recording: Recording | None = None
    about: About | None = None
    """What remains of the recording."""
    stacked: tuple[Any, Measured] | None = None
    """The program that solves it, and what goes into that; nothing where it is identified by itself."""
    reason: str = ""
    seconds: float = 0.0
    sha256: str = ""

    @property
    def status(self) -> str:
        return OK if self.estimates else FAILED

    @property
    def remark(self) -> str:
        """Why it failed, or else why none of its windows can be trusted."""
        return self.estimates[0].verdicts.complaint() if self.estimates else self.reason


def checksum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def file_checksum(path: Path | None) -> str:
    """SHA-256 of a file, or nothing where it cannot be read."""
    if path is None or why_refused(path):
        return ""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""


def job_checksum(job: WindowJob) -> str:
    """Of the job file, and of the design and the robot's recording that it names."""
    design = "" if job.design is None else file_checksum((job.folder / job.design).resolve())
    robot = (job.robot_recording or {}).get("file")
    alone = "" if robot is None else file_checksum((job.folder / str(robot)).resolve())
    return checksum("\n".join([job.text, design, alone]).encode())


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
            result.recording = None  # what is identified by itself may be long
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


def input_checksum(item: Item) -> str:
    alone = "" if item.robot_file is None else "+" + file_checksum(item.robot_file)
    return file_checksum(item.file) + alone


def write_whole(path: Path, content: bytes) -> None:
    """A file that appears whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}{UNFINISHED}")
    try:
        with unfinished.open("wb") as file:
            file.write(content)
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


# --- reading and solving ----------------------------------------------------------------------------------------------


def _read(task: Task, batch: Batch, item: Item) -> Result:
    """A recording, and what is measured of it while its numbers are at hand."""
    begin = time.perf_counter()
    result = Result(item, sha256=input_checksum(item), reason=item.refused)
    if not result.reason:
        with _reasons(result):
            recording = load(task.job.recording, item.file, task.job.folder)
            if recording.n_joints != task.joints:
                raise ValueError(
                    f"{item.file}: it has {recording.n_joints} joints, but this study {task.joints}: name the columns "
                    "of each joint, or make a study of its own"
                )
            result.recording, result.about = recording, About.of(recording)
            size = next((size for size in task.sizes if size[0] >= len(recording)), None)
            if batch.padded and size is not None:
                pipeline = task.job.pipeline_for(recording)
                pipeline.check(recording)
                found = measure(pipeline, recording)
                result.stacked = (*size, _kind_of(found)), found
    result.seconds = time.perf_counter() - begin
    return result


def load(table: Mapping[str, Any], file: Path, folder: Path) -> Recording:
    """A recording of reasonable size, from a plain file."""
    refused = why_refused(file)
    if refused:
        raise RecordingError(f"{file}: {refused}")
    try:
        samples = count_samples(file, channel_columns(table))
    except RecordingError as error:
        raise RecordingError(f"{file}: {error}") from None
    if samples > MOST_SAMPLES:
        raise RecordingError(f"{file}: it claims {samples:.3g} samples, above {MOST_SAMPLES:.3g}: cut it into parts")
    return recording_from_mapping({**table, "file": os.path.abspath(file)}, folder)


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
            prepared = prepare(pipeline, result.recording, _alone(task, result.item))
            result.estimates = in_windows(prepared, curves=False)
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
    return found.model, filters.decimate, half, pipeline.window_rows, pipeline.step_rows, lags


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


def joints_of(job: WindowJob, items: Sequence[Item]) -> int:
    """Joints of a study: as many as the job names, or, where a variable may hold several, those of the first recording
    that can be read."""
    named = _named_joints(job)
    for item in items if named == 1 else ():
        if item.file.suffix.lower() not in MATRICES:
            return named
        with suppress(ValueError, OSError):
            return load(job.recording, item.file, job.folder).n_joints
    return named


def _named_joints(job: WindowJob) -> int:
    position = job.recording.get("position")
    position = position.get("column") if isinstance(position, Mapping) else position
    return 1 if isinstance(position, str) else len(position or "1")


def _alone(task: Task, item: Item) -> Recording | None:
    """The recording of the robot alone: the manifest's, or the job's."""
    table = task.job.robot_recording
    if table is None:
        return None
    file = item.robot_file or task.job.folder / str(table["file"])
    return _robot_alone(json.dumps(dict(table), sort_keys=True), file, task.job.folder, file_checksum(file))


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
        buffer = pa.BufferOutputStream()
        texts = [column.name for column in table.schema if column.type == pa.string()]
        pq.write_table(table, buffer, use_dictionary=texts, compression="zstd")
        content = buffer.getvalue().to_pybytes()
        write_whole(task.out / path, content)
        written[path] = checksum(content)
    return written


def windows_table(task: Task, results: Sequence[Result], k: int = 0) -> pa.Table:
    """One row per window of all recordings: the columns of `estimates.parquet`, behind the recording's name and the
    manifest's columns.

    `condition` is called `condition_number` here: a study has conditions of its own, which partition its results.
    """
    several, job = [result.estimates[k] for result in results], task.job
    about = results[0].about
    assert about is not None
    table = estimates_table(several, job)
    table = table.rename_columns({"condition": "condition_number"})
    which = pa.array(np.repeat(np.arange(len(results)), [len(one.start) for one in several]))
    metadata = [dict(result.item.metadata) for result in results]
    columns = {"recording": [result.item.name for result in results]}
    columns |= {name: [row.get(name, "") for row in metadata] for name in task.metadata}
    for place, (name, texts) in enumerate(columns.items()):
        field = pa.field(name, pa.string(), metadata={"unit": ""})
        table = table.add_column(place, field, _texts(texts).take(which))
    return table


def recordings_table(task: Task, results: Sequence[Result]) -> pa.Table:
    """One row per recording: where it comes from, what was found, and what made it."""
    job, model = task.job, _model_of(task.job, results)
    named = [] if model is None else _summarised(model)
    columns: list[tuple[str, str, Any]] = [
        ("recording", "", _texts(result.item.name for result in results)),
        ("file", "", _texts(str(result.item.file) for result in results)),
    ]
    metadata = [dict(result.item.metadata) for result in results]
    columns += [(name, "", _texts(row.get(name, "") for row in metadata)) for name in task.metadata]
    measured = [result.about for result in results]
    columns += [
        ("status", "", _texts(result.status for result in results)),
        ("reason", "", _texts(result.remark for result in results)),
        ("samples", "1", np.array([0 if r is None else r.samples for r in measured])),
        ("sample_rate_hz", "Hz", _numbers(r and r.sample_rate for r in measured)),
        ("duration_s", "s", _numbers(r and r.duration for r in measured)),
        ("valid_share", "1", _numbers(r and r.valid_share for r in measured)),
        ("windows", "1", np.array([len(r.estimates[0].start) if r.estimates else 0 for r in results])),
    ]
    counts = [r.estimates[0].verdicts.counts() if r.estimates else dict.fromkeys(VERDICTS, 0) for r in results]
    columns += [(name, "1", np.array([count[name] for count in counts])) for name in VERDICTS]
    parameters = _over_trusted(results, len(named))
    for k, (name, unit) in enumerate(named):
        columns += [(f"{name}_{what}", unit, _numbers(found[:, k])) for what, found in parameters.items()]
    columns += [
        ("threshold", "1", _numbers(r.estimates[0].threshold if r.estimates else None for r in results)),
        ("notes", "", _texts("\n".join(r.estimates[0].notes) if r.estimates else "" for r in results)),
        ("model", "", _texts("" if model is None else model.label for _ in results)),
        ("filters", "", _texts(_filters(job, r) for r in measured)),
        ("versions", "", _texts([json.dumps(versions())] * len(results))),
        ("sha256", "", _texts(r.sha256 for r in results)),
        ("job_sha256", "", _texts([job_checksum(job)] * len(results))),
        ("seconds", "s", np.array([r.seconds for r in results])),
    ]
    return table_of(columns, job.text)


def _over_trusted(results: Sequence[Result], p: int) -> dict[str, NDArray[np.float64]]:
    """(R, p) mean and spread of the parameters over the trusted windows of each recording.

    Windows overlap, so that their mean is hardly surer than one of them: the interval, `mean - half_width_95` to `mean
    + half_width_95`, is that of a window with the median standard error and degrees of freedom. Of a reflex it is the
    gain.
    """
    found = {what: np.full((len(results), p), np.nan) for what in ("mean", "sd", "median_stderr", "half_width_95")}
    dof = np.full(len(results), np.nan)
    for k, result in enumerate(results):
        if result.estimates and result.estimates[0].verdicts.trusted.any():
            fit, trusted = result.estimates[0].summarised().fit, result.estimates[0].verdicts.trusted
            theta = np.asarray(fit.theta)[trusted]
            found["mean"][k], found["sd"][k] = theta.mean(axis=0), theta.std(axis=0)
            errors = np.column_stack([fit.stderr, fit.dof])[trusted]
            *found["median_stderr"][k], dof[k] = np.median(errors, axis=0)
    low, high = confidence_interval(0 * found["median_stderr"], found["median_stderr"], dof)
    found["half_width_95"] = (high - low) / 2
    return found


def reserved_columns(job: WindowJob) -> set[str]:
    """Names that a manifest's columns cannot have: those of the results."""
    nothing = [Result(Item("", Path()))]
    table, model = recordings_table(Task(job, Path(), (), (), (), 0), nothing), _model_of(job, nothing)
    parameters = () if model is None else model.names
    return {*table.column_names, *WINDOW_COLUMNS, *parameters, *(f"{name}_stderr" for name in parameters)}


def _model_of(job: WindowJob, results: Sequence[Result]) -> Model | None:
    """What is identified: of the recordings that could be read, or as the job's columns suggest."""
    first = next((result.about for result in results if result.about is not None), None)
    joints = None if first is None else first.joints
    rate = ANY_RATE if first is None else first.sample_rate
    if joints is None:
        joint = job.recording.get("joint", "revolute")
        joints = tuple(joint) if isinstance(joint, list) else (joint,) * _named_joints(job)
    try:
        robot, human = job.models(joints, rate)
    except (ValueError, KeyError):
        return None
    return robot if human is None else human


def _summarised(model: Model) -> list[tuple[str, str]]:
    """Name and unit of what a recording's row tells, in the order of `Estimates.summarised`."""
    parts = model.models if isinstance(model, Joints) else (model,)
    tags = [f"joint{j + 1}." if isinstance(model, Joints) else "" for j in range(len(parts))]
    kept, gains = list[tuple[str, str]](), list[tuple[str, str]]()
    for tag, part in zip(tags, parts, strict=True):
        weights = pathway_of(part).columns if part.memory else ()
        units = dict(zip(part.columns, part.units, strict=True))
        named = zip(part.names, part.columns, strict=True)
        kept += [(tag + name, units[column]) for name, column in named if column not in weights]
        gains += [(f"{tag}reflex_gain", units[weights[0]])] if weights else []
    return [*kept, *gains]


def _filters(job: WindowJob, about: About | None) -> str:
    rate = None if about is None else about.sample_rate
    try:
        decimate = job.filter.decimate if rate is None else design_filters(job.filter, rate).decimate
    except ValueError:
        decimate = job.filter.decimate
    return json.dumps(asdict(job.filter) | {"decimate": decimate})


def _texts(values: Any) -> Any:
    return pa.array([printable(text) for text in values], pa.string())


def _numbers(values: Any) -> Any:
    """What there is no number for is null."""
    return pa.array([np.nan if value is None else float(value) for value in values], pa.float64(), from_pandas=True)


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
            why = _write_report(task, result.item, result.recording)
            unwritten |= {result.item.name: why} if why else {}
    return unwritten


def write_late_report(task: Task, item: Item) -> str:
    """The report of a recording that was identified before, and nothing; or why there is none."""
    found = Result(item)
    with _reasons(found):
        found.recording = load(task.job.recording, item.file, task.job.folder)
    return found.reason if found.recording is None else _write_report(task, item, found.recording)


def _write_report(task: Task, item: Item, recording: Recording) -> str:
    """Nothing, or why it could not be written: a report that fails must not cost a batch."""
    found = Result(item)
    with _one_at_a_time, _reasons(found):
        about = {"recording": str(item.file), **dict(item.metadata)}
        lines = [printable(f"# {name}: {' '.join(value.split())}\n") for name, value in about.items()]
        job = replace(task.job, text="".join(lines) + task.job.text)
        named = replace(recording, name=item.name)
        write_report_of(job, named, _alone(task, item), report_folder(task.out, item.name))
    return found.reason


def write_report_of(job: WindowJob, recording: Recording, alone: Recording | None, folder: Path) -> None:
    """What `identify` writes, for one recording."""
    from jaximp.identification.identify import at_other_lengths
    from jaximp.recordings.outputs import new_folder
    from jaximp.reports.estimates import write_results

    prepared = prepare(job.pipeline_for(recording), recording, alone)
    estimates = in_windows(prepared, longest=2 * job.window.length)
    others = at_other_lengths(prepared, alone)
    with new_folder(folder, force=True) as draft:
        write_results(draft, estimates, sorted([estimates[0], *others], key=lambda e: e.window), job, recording)
