"""What was measured and what was said, second by second: complete but for the last second whatever ends the program.

Samples stand in `samples-1.csv`, raw and in SI units, a further file wherever the clock was set or the source paused;
`job.toml` identifies them all. Updates stand in `estimates.jsonl`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaximp.live.clock import Slots
from jaximp.live.monitor import Update
from jaximp.recordings.named_units import SUFFIXES
from jaximp.recordings.outputs import MARK, write_whole
from jaximp.recordings.units import si_unit

EVERY = 1.0
"""Seconds between two writes."""
FEWEST = 100
"""Samples of a part that `job.toml` names."""


class Log:
    """A folder that is written while the monitor runs."""

    def __init__(self, folder: str | Path, tables: Mapping[str, Any], joint: str = "revolute", gap: float = 1.0):
        """**Arguments:** `folder` that does not exist yet; the `tables` of the job without its recordings;
        `gap` seconds after which a new part begins.

        **Raises:** `ValueError` for a folder that exists or cannot be written.
        """
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True)
        except FileExistsError:
            raise ValueError(f"{self.folder} exists: choose another --log") from None
        except OSError as error:
            raise ValueError(f"{self.folder} cannot be written ({error.strerror}): choose another --log") from None
        (self.folder / MARK).touch()
        suffix = {unit: name for name, unit in SUFFIXES.items()}
        units = [suffix[si_unit(channel, joint)] for channel in ("time", "position", "torque")]
        self._columns = [
            f"{channel}_{unit}" for channel, unit in zip(("time", "position", "torque"), units, strict=True)
        ]
        self._tables, self._joint, self._gap = dict(tables), joint, gap
        self._parts: list[int] = []
        """Samples of each part."""
        self._named = 0
        self._lines: list[str] = []
        self._updates: list[str] = []
        self._last = self._written = float("nan")

    def add(self, slots: Slots, updates: list[Update]) -> None:
        """Take what came in; it is written when a second is full."""
        q, torque, valid = slots.sample
        for time, position, moment in zip(
            slots.time[valid].tolist(), q[valid].tolist(), torque[valid].tolist(), strict=True
        ):
            if not self._last < time <= self._last + self._gap:
                self.flush()
                self._parts.append(0)
                self._lines.append(",".join(self._columns) + "\n")
                self._written = time
            self._lines.append(f"{time!r},{position!r},{moment!r}\n")
            self._parts[-1] += 1
            self._last = time
            if time - self._written >= EVERY:
                self.flush()
        self._updates += [json.dumps(update.as_json()) + "\n" for update in updates]

    def note(self, what: str) -> None:
        """Something that happened, among the updates."""
        self._updates.append(json.dumps({"note": what}) + "\n")

    def flush(self) -> None:
        """Write what there is: whole lines, at the end of files that are never rewritten."""
        if self._lines:
            _append(self.folder / f"samples-{len(self._parts)}.csv", self._lines)
        if self._updates:
            _append(self.folder / "estimates.jsonl", self._updates)
        self._lines, self._updates, self._written = [], [], self._last
        named = [k + 1 for k, count in enumerate(self._parts) if count >= FEWEST]
        if len(named) != self._named:
            self._write_job([f"samples-{k}.csv" for k in named])
            self._named = len(named)

    def close(self) -> None:
        """Write the end."""
        self.flush()

    def _write_job(self, files: list[str]) -> None:
        time, position, torque = self._columns
        recording = {
            "file": files if len(files) > 1 else files[0],
            "time": time,
            "position": position,
            "torque": torque,
        }
        recording |= {"joint": self._joint} if self._joint != "revolute" else {}
        write_whole(self.folder / "job.toml", toml_of({"recording": recording, **self._tables}).encode())


def _append(path: Path, lines: list[str]) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write("".join(lines))


def toml_of(tables: Mapping[str, Any]) -> str:
    """Tables of plain values as TOML: what stands alone first, one line for each key."""
    alone = [f"{key} = {_inline(value)}" for key, value in tables.items() if not isinstance(value, Mapping)]
    parts = ["\n".join(alone)] if alone else []
    for name, table in tables.items():
        if isinstance(table, Mapping):
            parts.append("\n".join([f"[{name}]", *(f"{_key(key)} = {_inline(value)}" for key, value in table.items())]))
    return "\n\n".join(parts) + "\n"


def _inline(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(key)} = {_inline(one)}" for key, one in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_inline, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float) and not np.isfinite(value):
        return str(value)
    return json.dumps(value) if isinstance(value, str) else repr(value)


def _key(key: str) -> str:
    return key if key.replace("_", "").replace("-", "").isalnum() else json.dumps(key)
