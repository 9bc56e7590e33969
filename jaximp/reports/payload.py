"""A table of a load, or of gains by a known load, beside a report."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from jaximp.identification.drive_gains import DriveGains
from jaximp.identification.payload import Payload
from jaximp.identification.quantities import Quantities


def write_load(folder: str | Path, found: Payload | DriveGains) -> None:
    """Write `payload.json` (or `gains.json`) into an existing folder: each parameter with its unit, interval and
    standard error, and all in words. What is not determined is null."""
    content: dict[str, Any] = {"words": found.in_words(), "parameters": _table(found)}
    if isinstance(found, Payload):
        content |= {"frame": found.frame, "method": found.method, "recordings": found.recording_notes}
        content["determined"] = dict(zip(found.names, found.determined.tolist(), strict=True))
        content["parameters"] |= _table(found.centre) | _table(found.inertia_about_centre)
    else:
        content["gain_error_percent"] = found.gain_error
    name = "payload.json" if isinstance(found, Payload) else "gains.json"
    (Path(folder) / name).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _table(found: Quantities) -> dict[str, dict[str, Any]]:
    names, *columns = found.columns()
    rows = zip(*(column.values for column in columns), strict=True)
    keys = [column.name for column in columns]
    return {name: dict(zip(keys, map(_plain, row), strict=True)) for name, row in zip(names.values, rows, strict=True)}


def _plain(value: Any) -> Any:
    """As JSON has it, which knows no NaN."""
    return value if isinstance(value, str) else float(value) if np.isfinite(value) else None
