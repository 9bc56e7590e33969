"""What a batch will do, before it does anything: which recordings, how long they are, and which are solved together.

The plan follows from the job, the list of recordings and their sizes alone, never from what is done already: that is
why a batch that was broken off and resumed gives the same bits as one that was not. Sizes are learnt from what a file
says of itself (`formats.count_samples`); nothing is decoded here.

A manifest is data from elsewhere: its paths must stay inside its folder, and only plain files are read.
"""

from __future__ import annotations

import csv
import glob
import math
import os
import re
import stat
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from jaximp.identification.solving import stack_size
from jaximp.jobs.job import Job, TrialsJob, WindowJob
from jaximp.recordings.apart import files_apart
from jaximp.recordings.errors import RecordingError
from jaximp.recordings.mapping import columns_of, is_number
from jaximp.recordings.outputs import MARK
from jaximp.recordings.readers.formats import FORMATS, count_samples, format_of
from jaximp.recordings.readers.text import delimiter_of
from jaximp.types import listed

MOST_SIZES = 3
"""Padded lengths of a plan: each is compiled once, and a study should need no more than six programs."""
LONGEST_STACKED = 400_000
"""Samples; longer recordings are identified one by one."""
MOST_SAMPLES = 100_000_000
"""A recording that claims more is refused before anything is read (2.4 GB of time, position and torque)."""
FILES_IN_BATCH = 16
"""Recordings of a batch whose recordings are not stacked."""
PARTITIONS = ("subject", "session", "condition")
"""Columns of a manifest that partition the results, where nothing else is said."""
MISSING = "missing"
"""An empty value in a folder's name."""
FILES = ("file", "robot_file", "robot_file_after")
KNOWN = (*FILES, *PARTITIONS)
"""Columns of a manifest that mean something, in whatever case they are written."""
MOST_NAMED = 20
"""Recordings that are refused and named one by one by the plan."""
LOG = "batch.log"
LONGEST_NAME = 120
"""Letters of a value in a folder's name, after encoding."""


@dataclass(frozen=True)
class Item:
    """One recording of a study."""

    name: str
    """By which the results know it; unique."""
    file: Path
    robot_file: Path | None = None
    """The recording of the robot alone, in place of the job's."""
    robot_file_after: Path | None = None
    """The one after that with the human, likewise."""
    metadata: tuple[tuple[str, str], ...] = ()
    samples: int = 0
    """As the file says; zero where it cannot be read, which is found out when it is its turn."""
    refused: str = ""
    """Why it will not be read."""

    def partition(self, columns: Sequence[str]) -> str:
        """Its folder below the results, such as `subject-001`.

        The values themselves stand in the files: from `subject=001` every reader would make a number of its own.
        """
        values = dict(self.metadata)
        return "/".join(f"{column}-{_encoded(values.get(column, ''))}" for column in columns)


@dataclass(frozen=True)
class Batch:
    """Recordings that are solved together, and whose results stand in one file for each partition."""

    number: int
    padded: int
    """Samples that each is filled up to; zero where they are identified one by one."""
    stacked: int
    """Recordings of a full stack."""
    items: tuple[Item, ...]


@dataclass(frozen=True)
class Plan:
    """All batches of a study."""

    batches: tuple[Batch, ...]
    metadata: tuple[str, ...]
    """Columns of the manifest."""
    partitions: tuple[str, ...]
    one_by_one: str
    """Why recordings are not stacked, if so."""

    @property
    def items(self) -> list[Item]:
        return [item for batch in self.batches for item in batch.items]

    @property
    def sizes(self) -> tuple[tuple[int, int], ...]:
        """Padded lengths, rising, and how many recordings are stacked."""
        return tuple(sorted({(batch.padded, batch.stacked) for batch in self.batches if batch.padded}))

    def in_words(self, job: WindowJob) -> list[str]:
        """The plan, a line each."""
        items = self.items
        refused = [item for item in items if item.refused]
        lines = [f"{_counted(len(items), 'recording')} in {_counted(len(self.batches), 'batch', 'batches')}"]
        lines += [f"refused: {item.name}: {item.refused}" for item in refused[:MOST_NAMED]]
        lines += [f"refused: {len(refused) - MOST_NAMED} others"] if len(refused) > MOST_NAMED else []
        model = job.model
        named = {"robot": model.robot, "human": model.human, "arm": model.arm}
        which = [name for name, settings in named.items() if settings is not None]
        which += [] if model.chain is None else [f"robot of {model.chain.urdf}"]
        which += [] if model.tip is None else ["human who holds its end"]
        methods = f", methods {', '.join(map(str, model.methods))}" if len(which) == 2 else ""
        every = f"windows of {job.window.length:g} s every {job.step_seconds:g} s"
        if job.track is not None:
            every = f"followed at points every {job.step_seconds:g} s"
        windows = "each recording as one window" if math.isinf(job.window.length) else every
        lines.append(f"model: {' and '.join(which)}{methods}; {windows}")
        counts = Counter((batch.padded, batch.stacked) for batch in self.batches for _ in batch.items)
        for (size, stacked), count in sorted(counts.items()):
            if size:
                lines.append(f"{count} of up to {size} samples, stacked {stacked} at a time")
            else:
                lines.append(f"{count} one by one" + (f": {self.one_by_one}" * bool(self.one_by_one)))
        lines.append(f"partitioned by {', '.join(self.partitions)}" if self.partitions else "not partitioned")
        return [*lines, f"results: about {_in_bytes(expected_bytes(job, self))}"]


def _counted(count: int, one: str, several: str = "") -> str:
    return f"{count} {one if count == 1 else several or one + 's'}"


def expected_bytes(job: WindowJob, plan: Plan) -> float:
    """Size of the results, as it was measured; windows are counted at the rate that the job states, or at 1 kHz."""
    rate = job.recording.get("sample_rate")
    rate = float(rate) if isinstance(rate, int | float) else 1000.0
    length, step = job.window.length, job.step_seconds
    many = sum(max(0, (item.samples / rate - length) / step + 1) for item in plan.items if math.isfinite(length))
    windows = many if math.isfinite(length) else len(plan.items)
    files = sum(len({item.partition(plan.partitions) for item in batch.items}) for batch in plan.batches)
    return 120.0 * windows + 16_000.0 * files + 30_000.0 * len(plan.batches) + 2000.0 * len(plan.items)


def _in_bytes(size: float) -> str:
    for unit in ("B", "kB", "MB", "GB"):
        if size < 1000:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"


# --- which recordings -------------------------------------------------------------------------------------------------


def find_items(files: Sequence[str], manifest: Path | None = None, allow_outside: bool = False) -> list[Item]:
    """The recordings that a command line or a manifest names, in a fixed order.

    **Arguments:** `files` paths, patterns such as `data/*.csv`, and folders, which are searched for known formats;
    `manifest` a CSV or Parquet file with a column `file`, relative to its folder, perhaps
    `robot_file` and `robot_file_after`, and metadata; `allow_outside` lets its paths leave its folder.

    **Raises:** `ValueError` with one line that names the cause and the remedy.
    """
    if (manifest is None) == (not files):
        raise ValueError("give either recordings or --manifest FILE, one of the two")
    items = _from_manifest(manifest, allow_outside) if manifest is not None else _from_paths(files)
    listed = Counter(str(item.file) for item in items)
    doubled = [item.name for item in items if listed[str(item.file)] > 1]
    doubled += [name for name, count in Counter(item.name for item in items).items() if count > 1]
    if doubled:
        raise ValueError(f"{doubled[0]} is listed more than once: every recording is to be identified once")
    return sorted(items, key=lambda item: item.name)


def _from_paths(files: Sequence[str]) -> list[Item]:
    found: dict[str, Path] = {}
    for given in files:
        matches = [given]
        if not os.path.lexists(given):
            matches = [path for path in sorted(glob.glob(given, recursive=True)) if not _in_results(Path(path))]
        if not matches:
            raise ValueError(f"{given}: there is no such file; check the path")
        for match in matches:
            inside = _recordings_in(Path(match)) if os.path.isdir(match) else [Path(match)]
            if not inside:
                raise ValueError(f"{match}: no recording in this folder; known are {', '.join(FORMATS)}")
            found |= {os.path.abspath(path): path for path in inside}
    common = os.path.commonpath([os.path.dirname(path) for path in found])
    return [Item(printable(Path(path).relative_to(common).as_posix()), Path(path)) for path in found]


def printable(text: str) -> str:
    """A file's name may be no text at all; then the bytes that are none are written out."""
    return text.encode("utf-8", "backslashreplace").decode()


def _recordings_in(folder: Path) -> list[Path]:
    """Files of a known format, at any depth; what is hidden, and what a batch wrote, is left out."""

    def unreadable(error: OSError) -> None:
        raise ValueError(f"{error.filename}: {error.strerror}; give its recordings by name, or leave it out")

    paths = [Path(where) / name for where, _, names in os.walk(folder, onerror=unreadable) for name in names]
    paths = [path for path in paths if not _in_results(path, folder)]
    shown = [path for path in paths if not any(part.startswith(".") for part in path.relative_to(folder).parts)]
    return sorted(path for path in shown if format_of(path) is not None)


def _in_results(path: Path, below: Path = Path()) -> bool:
    """Whether a batch wrote this file."""
    return any((folder / LOG).is_file() and (folder / MARK).is_file() for folder in path.parents if folder != below)


def _from_manifest(manifest: Path, allow_outside: bool) -> list[Item]:
    rows = _manifest_rows(manifest)
    folder = Path(os.path.abspath(manifest)).parent
    items = []
    for where, row in rows.items():
        if not row.get("file"):
            raise ValueError(f"{where}: the column 'file' is empty; name a recording, or delete the row")
        file, robot, after = (
            None if not row.get(column) else _inside(folder, row[column], where, allow_outside) for column in FILES
        )
        assert file is not None
        metadata = tuple((key, value) for key, value in row.items() if key not in FILES)
        items.append(Item(Path(row["file"]).as_posix(), file, robot, after, metadata))
    return items


def _manifest_rows(manifest: Path) -> dict[str, dict[str, str]]:
    """Rows as text, whatever their kind, by where they stand; a spreadsheet's empty rows are left out."""
    if not manifest.is_file():
        raise ValueError(f"{manifest}: there is no such manifest; check the path")
    if manifest.suffix.lower() == ".parquet":
        from pyarrow import parquet

        try:
            with manifest.open("rb") as opened:
                table = parquet.read_table(opened)
            table = table.rename_columns(_header(table.column_names))
            found = {f"row {k}": row for k, row in enumerate(table.to_pylist(), start=1)}
        except (ValueError, OSError, csv.Error) as error:
            raise ValueError(f"{manifest}: this is not a Parquet file of a manifest: {error}") from None
    elif manifest.suffix.lower() == ".csv":
        found = _csv_rows(manifest)
    else:
        raise ValueError(f"{manifest}: a manifest is a .csv or a .parquet file: export it as one")
    # NaN is what pandas writes where there is nothing.
    texts = {
        where: {key: "" if value is None or value != value else str(value) for key, value in row.items()}
        for where, row in found.items()
    }
    rows = {f"{manifest}, {where}": row for where, row in texts.items() if any(row.values())}
    first = next(iter(rows.values()), {})
    if "file" not in first:
        there = f"its columns are {', '.join(first)}: rename that of the recordings" if first else "it has no rows"
        raise ValueError(f"{manifest}: a manifest has a column 'file' and a row for every recording, but {there}")
    return rows


def _csv_rows(manifest: Path) -> dict[str, dict[str, str]]:
    """By the line in which they end; the header is the first line."""
    try:
        with manifest.open(encoding="utf-8-sig", newline="") as text:
            delimiter = delimiter_of(text.readline())
            text.seek(0)
            lines = csv.DictReader(text, delimiter=delimiter, strict=True)
            lines.fieldnames = _header(lines.fieldnames or ())
            rows = {f"line {lines.line_num}": row for row in lines}
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{manifest}: this is not a CSV file in UTF-8: {error}; save it as one") from None
    for where, row in rows.items():
        if None in row or None in row.values():
            raise ValueError(f"{manifest}, {where}: it has more or fewer fields than the header; repair it")
    return rows


def _header(names: Sequence[str]) -> list[str]:
    """`Subject` is `subject`: in the wrong case it would not count people."""
    stripped = [name.strip() for name in names]
    header = [name.lower() if name.lower() in KNOWN else name for name in stripped]
    if len(set(header)) < len(header):
        raise csv.Error("two columns have the same name")
    return header


def _inside(folder: Path, name: str, where: str, allow_outside: bool) -> Path:
    """A manifest's path, which must not leave the manifest's folder, be it by a link on the way."""
    path = Path(os.path.abspath(folder / name))
    resolved = Path(os.path.realpath(path.parent)) / path.name
    if not allow_outside and not resolved.is_relative_to(os.path.realpath(folder)):
        raise ValueError(f"{where}: {name} lies outside of the manifest's folder; move it, or pass --allow-outside")
    return path


def why_refused(path: Path) -> str:
    """Why a path is not read: it is no plain file, or a link to one. Nothing if it is."""
    try:
        mode = path.lstat().st_mode
    except OSError as error:
        if isinstance(error, FileNotFoundError):
            windows = "; it looks like one of Windows: write / between folders" if "\\" in str(path) else ""
            return f"there is no file {path}: check the path (a manifest's begin at its own folder){windows}"
        return f"{error.strerror or error}: check the path"
    except ValueError:
        return "this is no path: name a recording"
    if stat.S_ISLNK(mode):
        return "symbolic links are not followed: name the file itself"
    return "" if stat.S_ISREG(mode) else "this is no plain file: name a recording"


# --- which are solved together ----------------------------------------------------------------------------------------


def why_alone(job: WindowJob) -> str:
    """Why the recordings of a job have to be identified one by one, or nothing."""
    if job.filter.mode == "window":
        return "filter.mode = 'window' filters inside every window"
    if job.model.robot is not None and job.model.human is not None:
        return "a human in a robot needs two recordings at a time"
    if job.model.human is not None and job.model.human.reflex:
        return "a reflex remembers the past, and its gain is a fit of its own"
    if job.model.chain is not None:
        return "the joints of a robot are weighed by what is left of each"
    if job.held_out is not None:
        return "each predicts what is held out"
    return ""


def of_recordings(job: Job) -> WindowJob:
    """The job, if it is one for many recordings.

    **Raises:** `ValueError` for a job with trials, with a payload, or that leaves filters or windows to what suits its
    recording.
    """
    if isinstance(job, TrialsJob):
        raise ValueError("a job with [trials] is one study by itself: batch works on jobs with [recording]")
    if job.payload is not None:
        raise ValueError("a job with [payload] is about one pair of recordings: run `jaximp identify` on it")
    if files_apart(job.recording):
        raise ValueError("a batch reads one file per recording, and this job names others for single channels")
    if job.left_out:
        tables = listed([f"[{name}]" for name in job.left_out])
        none = " (an empty [filter] is none)" if "filter" in job.left_out else ""
        raise ValueError(
            f"the job leaves out {tables}, and a batch treats all recordings alike: `jaximp check` proposes what to "
            f"write{none}"
        )
    return job


def make_plan(job: WindowJob, items: Sequence[Item], partitions: Sequence[str] | None = None) -> Plan:
    """Look at every file's size and form batches.

    **Arguments:** `partitions` columns of the manifest; by default those of `PARTITIONS` that it has.

    **Raises:** `ValueError` for a robot's recordings that the job cannot read, and for partitions that cannot be
    folders.
    """
    if job.robot_recording is None and any(item.robot_file is not None for item in items):
        raise ValueError("the manifest has a robot_file, but the job no [robot_recording] to read it by: add the table")
    if job.robot_recording_after is None and any(item.robot_file_after is not None for item in items):
        raise ValueError(
            "the manifest has a robot_file_after, but the job no [robot_recording_after] to read it by: add the table"
        )
    metadata = tuple(dict.fromkeys(key for item in items for key, _ in item.metadata))
    chosen = tuple(partitions) if partitions is not None else tuple(name for name in PARTITIONS if name in metadata)
    _check_partitions(chosen, metadata, items)
    columns = channel_columns(job.recording)
    sized = sorted((_sized(item, columns) for item in items), key=lambda item: (item.partition(chosen), item.name))
    why = why_alone(job)
    stacked = [item for item in sized if 0 < item.samples <= LONGEST_STACKED and not why]
    sizes = padded_sizes([item.samples for item in stacked])
    groups: dict[int, list[Item]] = {size: [] for size in (*sizes, 0)}
    for item in sized:
        fits = 0 < item.samples <= LONGEST_STACKED and not why
        groups[next(size for size in sizes if size >= item.samples) if fits else 0].append(item)
    batches: list[Batch] = []
    for size, members in groups.items():
        together = stack_size(size, len(members)) if size else FILES_IN_BATCH
        for first in range(0, len(members), together):
            batches.append(Batch(len(batches), size, together, tuple(members[first : first + together])))
    return Plan(tuple(batches), metadata, chosen, why)


def padded_sizes(samples: Sequence[int], most: int = MOST_SIZES) -> list[int]:
    """The few lengths that recordings are filled up to, rising, such that as little as possible is added."""
    lengths, counts = np.unique(np.asarray(samples, np.int64), return_counts=True)
    if len(lengths) <= most:
        return [int(length) for length in lengths]
    if len(lengths) > 400:  # the best of so many is found among fewer
        grain = -(-int(lengths[-1]) // 400)
        coarse = -(-np.repeat(lengths, counts) // grain) * grain
        return padded_sizes(coarse.tolist(), most)
    # cost[j] of covering the j shortest with k sizes; the last of a group is its size.
    total = np.concatenate([[0], np.cumsum(counts)])
    cost, choices = np.where(np.arange(len(total)) == 0, 0.0, np.inf), []
    for _ in range(most):
        through = cost[:-1, None] + lengths[None, :] * (total[None, 1:] - total[:-1, None])
        through = np.where(np.tri(len(lengths), dtype=bool).T, through, np.inf)
        choices.append(through.argmin(axis=0))
        cost = np.concatenate([[np.inf], through.min(axis=0)])
    sizes, end = [], len(lengths) - 1
    for best in reversed(choices):
        sizes.append(int(lengths[end]))
        end = int(best[end]) - 1
    return sizes[::-1]


def _sized(item: Item, columns: Sequence[str | int]) -> Item:
    """The item with its number of samples, or with why it is refused."""
    files = [file for file in (item.file, item.robot_file, item.robot_file_after) if file is not None]
    refused = next(filter(None, map(why_refused, files)), "")
    if refused:
        return replace(item, refused=refused)
    try:
        samples = count_samples(item.file, list(columns))
    except (RecordingError, OSError):
        return item  # whoever reads it will say it better
    if samples > MOST_SAMPLES:
        return replace(item, refused=f"it claims {samples:.3g} samples, above {MOST_SAMPLES:.3g}: cut it into parts")
    return replace(item, samples=samples)


def channel_columns(table: Mapping[str, Any]) -> list[str | int]:
    """The columns of every channel that a `[recording]` table names, as far as that can be told."""
    names: list[str | int] = []
    channels = "position", "torque", "velocity", "acceleration", "force", "reference", "command", "time", "sample_rate"
    for channel in channels:
        names += columns_of(table.get(channel)) if channel != "sample_rate" or not is_number(table.get(channel)) else ()
    return names


def _check_partitions(chosen: Sequence[str], metadata: Sequence[str], items: Sequence[Item]) -> None:
    for column in chosen:
        if column not in metadata:
            raise ValueError(f"the results cannot be partitioned by '{column}': the manifest has no such column")
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]{0,60}", column):
            raise ValueError(f"the results cannot be partitioned by '{column}': rename it to plain letters")
    for item in items:
        for part in item.partition(chosen).split("/"):
            if len(part) > LONGEST_NAME + 64:
                raise ValueError(f"{item.name}: '{part[:40]}...' is too long for a folder's name: shorten the value")


def _encoded(value: str) -> str:
    """A value as part of a folder's name: everything but plain letters is percent-encoded."""
    return quote(value, safe="") or MISSING
