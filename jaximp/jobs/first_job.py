"""A first job for a recording: its columns by their names, filters and a window by what it shows.

Nothing is guessed where two columns could be meant: that is asked for. What was taken for what stands in the job, line
by line, for its writer to look at.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jaximp.identification.check import WIDEST, Finding, Proposal, propose
from jaximp.jobs.job import Job, WindowJob, parse_job, read_job
from jaximp.recordings.errors import RecordingError
from jaximp.recordings.named_units import unit_in
from jaximp.recordings.readers.contents import columns_in
from jaximp.types import Progress, Recording, listed

WORDS = {
    "time": ("time", "timestamp", "stamp", "t", "zeit", "temps", "seconds", "sec", "clock"),
    "position": (
        "position", "positions", "pos", "angle", "angles", "q", "theta", "winkel", "ang", "encoder", "qpos", "posj",
    ),
    "torque": (
        "torque", "torques", "tau", "moment", "moments", "trq", "effort", "efforts", "drehmoment", "tq", "couple",
    ),
}  # fmt: skip
"""What people call them, in small letters."""
OTHERS = (
    "command", "cmd", "desired", "des", "reference", "ref", "target", "goal", "set", "setpoint", "velocity", "vel",
    "speed", "acceleration", "acc", "current", "temperature", "temp", "filtered", "raw", "external", "ext",
)  # fmt: skip
"""Words that make a column something else, where another is called by the plain word."""
SIGN = "torque: sign"
"""The finding of a torque that is turned round."""


@dataclass(frozen=True)
class Columns:
    """Which columns are which channel; several of position and torque are joints."""

    time: str | None
    position: tuple[str, ...]
    torque: tuple[str, ...]


def words_of(name: str) -> list[str]:
    """In small letters, without units in brackets, numbers, and joins: `JointAngle_2 (deg)` is joint, angle."""
    plain = re.sub(r"[\[(<{].*?[\])>}]", " ", name)
    parts = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[^\W\d_A-Z]+", plain.replace("_", " "))
    return [part.lower() for part in parts]


def find_columns(names: Mapping[str, int], **given: Sequence[str]) -> Columns:
    """The columns of a file by their names, and by those that are `given` for a channel.

    **Arguments:** `names` of columns, each with how many it holds (a variable may hold one for each joint).

    **Raises:** `ValueError` where none or several could be meant.
    """
    found = {channel: tuple(given.get(channel) or _named(names, channel)) for channel in WORDS}
    for channel in ("position", "torque"):
        if not found[channel]:
            raise RecordingError(
                f"no column looks like the {channel}; name it by --{channel} NAME; there are: {', '.join(names)}"
            )
    widths = {channel: sum(names.get(name, 1) for name in found[channel]) for channel in ("position", "torque")}
    if widths["position"] != widths["torque"]:
        told = " and ".join(f"{', '.join(found[channel])} as the {channel}" for channel in ("position", "torque"))
        raise RecordingError(f"the columns do not match ({told}): name them by --position and --torque")
    if len(found["time"]) > 1:
        raise RecordingError(f"{listed(list(found['time']))} could each be the time: name one by --time")
    return Columns(found["time"][0] if found["time"] else None, found["position"], found["torque"])


def _named(names: Mapping[str, int], channel: str) -> list[str]:
    """Those that are called by a word of a channel and by no other word that makes them something else, where there are
    such; several of them only as joints, numbered alike."""
    called = [name for name in names if set(words_of(name)) & set(WORDS[channel])]
    plain = [name for name in called if not set(words_of(name)) & set(OTHERS)] or called
    if len(plain) < 2:
        return plain
    stems = {tuple(words_of(name)) for name in plain}
    if len(stems) > 1:
        by_word = {word: [name for name in plain if word in words_of(name)] for word in WORDS[channel]}
        firsts = [found for found in by_word.values() if found]
        if len(firsts[0]) == 1 and words_of(firsts[0][0]) == [WORDS[channel][0]]:
            return firsts[0]
        raise RecordingError(
            f"{listed(plain)} could each be the {channel}: name one by --{channel}, or several for joints"
        )
    return plain


def first_job(
    path: Path,
    given: Mapping[str, Sequence[str]],
    sample_rate: float | None = None,
    progress: Progress = lambda share: None,
    beyond_doubt: bool = False,
) -> str:
    """The text of a job for a recording, to stand beside it.

    **Arguments:** columns that are `given` for time, position and torque; the `sample_rate` [Hz] of a file without
    time; whether the unit of the position must be `beyond_doubt`.

    **Raises:** `ValueError` with one line that names the cause and the remedy.
    """
    columns = find_columns(columns_in(path), **given)
    if columns.time is None and sample_rate is None:
        raise RecordingError(f"{path}: no column looks like the time; name it by --time NAME, or give --sample-rate HZ")
    job = _Written(path, columns, sample_rate)
    recording = job.load()
    stated = all(map(unit_in, columns.position)) or any(note.startswith("position:") for note in recording.notes)
    if not stated and beyond_doubt:
        raise RecordingError(
            f"{path}: the unit of {', '.join(columns.position)} is not said: run `jaximp init {path}`, look at the job "
            "that it writes, and identify that"
        )
    if not stated:
        job = replace(job, span=float(np.nanmax(np.ptp(recording.position[recording.valid], axis=0))))
        recording = job.load()
    progress(0.2)
    settings = parse_job(job.text(), path.parent)
    assert isinstance(settings, WindowJob)
    pipeline = settings.pipeline(recording.joints, recording.sample_rate)
    findings, proposal = propose(pipeline, recording, progress=lambda share: progress(0.2 + 0.8 * share))
    said = tuple(note for note in recording.notes if "taken as that" in note)
    return replace(job, notes=said, findings=tuple(findings), proposal=proposal).text()


@dataclass(frozen=True)
class _Written:
    """A job, with a comment wherever something was concluded."""

    path: Path
    columns: Columns
    sample_rate: float | None
    span: float | None = None
    """Of the position, where nothing says its unit."""
    notes: tuple[str, ...] = ()
    findings: tuple[Finding, ...] = ()
    proposal: Proposal | None = None

    def load(self) -> Recording:
        job = parse_job(self.text(), self.path.parent)
        assert isinstance(job, WindowJob)
        return job.load()

    def text(self) -> str:
        job, columns = self.path.with_suffix(".toml").name, self.columns
        clock = f"sample_rate = {self.sample_rate:g}  # Hz" if columns.time is None else f"time = {_toml(columns.time)}"
        lines = [
            f"# A first job for {self.path.name}: look at every line, then run",
            f"#   jaximp check {job}",
            f"#   jaximp identify {job}",
            "",
            "[recording]",
            f"file = {json.dumps(self.path.name, ensure_ascii=False)}",
            *(f"# {note}" for note in self.notes),
            clock,
            self._position(),
            self._torque(),
            "",
            "[model]",
            "human = true  # inertia, damping, stiffness, offset; or robot = true",
            "",
            *_proposed(self.proposal, self.findings),
        ]
        return "\n".join(lines) + "\n"

    def _position(self) -> str:
        names = _toml(self.columns.position)
        if self.span is None:
            return f"position = {names}"
        degrees = f'{{ columns = {_toml(self.columns.position, several=True)}, unit = "deg" }}'
        if self.span > WIDEST:
            return (
                f"position = {degrees}  # no unit is said; it spans {self.span:.3g}, and no joint turns so far in rad"
            )
        return f"position = {names}  # in rad, as no unit is said; if it spans {self.span:.3g} degrees: {degrees}"

    def _torque(self) -> str:
        names = self.columns.torque
        if any(one.topic == SIGN for one in self.findings):
            turned = f"{{ columns = {_toml(names, several=True)}, sign = -1 }}"
            return f"torque = {turned}  # with the other sign the inertia is below zero"
        return f"torque = {_toml(names)}  # the torque on the joint; the joint's answer has sign = -1"


def _proposed(proposal: Proposal | None, findings: Sequence[Finding]) -> Iterator[str]:
    if proposal is None:
        return
    yield "[filter]"
    yield f"position_cutoff = {proposal.position_cutoff:g}  # Hz, before differentiation"
    yield f"decimation_cutoff = {proposal.decimation_cutoff:g}  # Hz, of the torque and every column of the regressor"
    yield ""
    yield "[window]"
    if proposal.window is not None:
        yield f"length = {proposal.window:g}  # s; it predicts the next one best"
    else:
        yield f"length = 2  # s; {findings[-1].text if findings else 'no length could be tried'}"


def _toml(names: str | Sequence[str] | None, several: bool = False) -> str:
    """A name, or a list of them; columns without a name have their number."""
    if isinstance(names, str):
        return names if names.isdigit() else json.dumps(names, ensure_ascii=False)
    each = [_toml(name) for name in names or ()]
    return each[0] if len(each) == 1 and not several else f"[{', '.join(each)}]"


def read_job_or_recording(path: Path, progress: Progress = lambda share: None) -> Job:
    """The job of a file; of a recording the first job that its columns make, without writing it.

    **Raises:** `ValueError` as `read_job` and `first_job`.
    """
    if path.suffix.lower() == ".toml":
        return read_job(path)
    return parse_job(first_job(path, {}, progress=progress, beyond_doubt=True), path.parent)
