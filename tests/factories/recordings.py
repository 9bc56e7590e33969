"""Recordings and the files that hold them."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from jaximp.types import Recording

CHANNELS = ("position", "torque", "velocity", "acceleration", "force", "reference", "command")
MAPPING = {"time": "t", "position": "q", "torque": "tau"}


def signals(n: int = 50, rate: float = 100.0) -> dict[str, np.ndarray]:
    t = np.arange(n) / rate
    return {"t": t, "q": np.sin(5 * t), "tau": np.cos(3 * t) - 0.5}


def write_csv(path: Path, columns: dict[str, Any], delimiter: str = ",") -> Path:
    rows = zip(*columns.values(), strict=True)
    lines = [delimiter.join(columns), *(delimiter.join(str(value) for value in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def matches(text: str) -> str:
    """A pattern for an error that consists of one line and contains `text`."""
    return rf"\A[^\n]*{re.escape(text)}[^\n]*\Z"


def assert_equal(one: Recording, other: Recording) -> None:
    assert one.joints == other.joints
    for channel in ("time", "valid", *CHANNELS):
        np.testing.assert_array_equal(getattr(one, channel), getattr(other, channel), err_msg=channel)


def cut(recording: Recording, part: slice) -> Recording:
    """Some of the samples, of every channel."""
    channels = {field.name: getattr(recording, field.name) for field in fields(recording)}
    return replace(recording, **{name: x[part] for name, x in channels.items() if isinstance(x, np.ndarray)})
