"""What the batches of a run have in common, what becomes of each of its recordings, and checksums of what went in."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from jaximp.batch.plan import MOST_SAMPLES, Batch, Item, Plan, channel_columns, why_refused
from jaximp.identification.estimates import Estimates
from jaximp.identification.rows import Measured
from jaximp.jobs.job import WindowJob
from jaximp.recordings.errors import RecordingError
from jaximp.recordings.load import recording_from_mapping
from jaximp.recordings.mapping import columns_of
from jaximp.recordings.readers.formats import MATRICES, count_samples
from jaximp.reports.pages import versions
from jaximp.types import Recording

OK, FAILED = "ok", "failed"


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
        job = replace(job, folder=Path(os.path.abspath(job.folder)))  # workers may start elsewhere
        return cls(job, out, plan.metadata, plan.partitions, plan.sizes, joints_of(job, plan.items), reports)

    def key(self, batch: Batch) -> str:
        """Checksum of everything that a batch's results depend on, its inputs' content apart."""
        members = [
            (item.name, item.metadata, str(item.robot_file or ""), str(item.robot_file_after or ""), item.refused)
            for item in batch.items
        ]
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
    held_out: Recording | None = None
    """What the estimates of the recording are to predict, where the job says so."""
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
        return self.estimates[0].verdicts.complaint(self.estimates[0].kind) if self.estimates else self.reason


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
    """Of the job file, and of all that it names beside its recording: the design, recordings of the robot, the URDF,
    and what is held out."""
    others = replace(job, recording={}, more_recordings=()).files()
    found = [file_checksum(path.resolve()) for path in others]
    return checksum("\n".join([job.text, *found]).encode())


def input_checksum(item: Item) -> str:
    alone = ["+" + file_checksum(file) for file in (item.robot_file, item.robot_file_after) if file is not None]
    return "".join([file_checksum(item.file), *alone])


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


def joints_of(job: WindowJob, items: Sequence[Item]) -> int:
    """Joints of a study: as many as the job names, or, where a variable may hold several, those of the first recording
    that can be read."""
    named = named_joints(job)
    for item in items if named == 1 else ():
        if item.file.suffix.lower() not in MATRICES:
            return named
        with suppress(ValueError, OSError, MemoryError):
            return load(job.recording, item.file, job.folder).n_joints
    return named


def named_joints(job: WindowJob) -> int:
    return len(columns_of(job.recording.get("position"))) or 1
