"""C3D, of motion capture: analog channels by their labels, points with three columns each (`LKneeAngles.x`), and
`time`.

Points and analog channels have rates of their own: asked for together, a point is held until its next frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers.claims import check_c3d
from jaximp.recordings.readers.columns import pick, require, steps_of
from jaximp.recordings.readers.found import Found
from jaximp.recordings.readers.library import library

AXES = {"x": 0, "y": 1, "z": 2}
KINDS = {"ANGLES": "ANGLE_UNITS", "MOMENTS": "MOMENT_UNITS", "FORCES": "FORCE_UNITS", "POWERS": "POWER_UNITS"}
"""Parameters that list which points are no markers, and those with their units."""


def read(path: Path, names: Sequence[str]) -> Found:
    file = _opened(path)
    points, analogs = _labels(file, "POINT"), _labels(file, "ANALOG")
    of = {name: _place(name, points, analogs) for name in names}
    kinds = {kind for kind, _, _ in of.values()} - {"time"}
    rate = file["parameters"]["POINT"]["RATE"]["value"][0]
    analog = file["data"]["analogs"][0]
    frames = file["data"]["points"].shape[2]
    ratio = analog.shape[1] // frames if frames and "analog" in kinds else 1
    if "analog" in kinds and not frames:
        rate, ratio, frames = file["parameters"]["ANALOG"]["RATE"]["value"][0], 1, analog.shape[1]
    notes = []
    if kinds == {"point", "analog"} and ratio > 1:
        notes.append(f"points come at {rate:g} Hz and analog channels at {ratio * rate:g} Hz: each point is held")
    values: dict[str, Any] = {}
    for name, (kind, label, steps) in of.items():
        if kind == "time":
            values[name] = np.arange(frames * ratio) / (rate * ratio)
        elif kind == "analog":
            values[name] = analog[analogs.index(label)]
        else:
            block = file["data"]["points"][:3, points.index(label)].T
            picked = pick(block, steps, name, notes) if steps else block
            values[name] = np.repeat(picked, ratio, axis=0)
    units = {name: _unit(file, kind, label, analogs) for name, (kind, label, _) in of.items()}
    return Found(values, units={name: unit for name, unit in units.items() if unit}, notes=tuple(notes))


def _opened(path: Path) -> Any:
    ezc3d = library("ezc3d", "ezc3d", path.suffix)
    check_c3d(path)
    return ezc3d.c3d(str(path))


def _place(name: str, points: Sequence[str], analogs: Sequence[str]) -> tuple[str, str, list[Any]]:
    """What kind of column a name is, its label, and which part of it."""
    if name in points:
        return "point", name, []
    if name in analogs:
        if analogs.count(name) > 1:
            raise RecordingError(f"column {name!r} appears more than once among the analog channels")
        return "analog", name, []
    if name == "time":
        return "time", name, []
    head, _, axis = name.rpartition(".")
    if head in points and axis in AXES:
        return "point", head, steps_of(f"p(:,{AXES[axis] + 1})")[1]
    head, steps = steps_of(name)
    if head in points and steps:
        return "point", head, steps
    require(name, ["time", *analogs, *(f"{point}.{axis}" for point in points for axis in AXES)])
    raise AssertionError


def _labels(file: Any, group: str) -> list[str]:
    labels: list[str] = []
    parameters = file["parameters"].get(group, {})
    for key in ("LABELS", *(f"LABELS{k}" for k in range(2, 10))):
        labels += [str(one) for one in parameters.get(key, {}).get("value", [])]
    return labels


def _unit(file: Any, kind: str, label: str, analogs: Sequence[str]) -> str:
    """As the file states it; nothing where it does not."""
    point, analog = (file["parameters"].get(group, {}) for group in ("POINT", "ANALOG"))
    if kind == "analog":
        units = analog.get("UNITS", {}).get("value", [])
        at = analogs.index(label)
        return str(units[at]).strip() if at < len(units) else ""
    if kind == "point":
        for listing, unit in KINDS.items():
            if label in point.get(listing, {}).get("value", []):
                return str(next(iter(point.get(unit, {}).get("value", [])), "")).strip()
        return str(next(iter(point.get("UNITS", {}).get("value", [])), "")).strip()
    return ""


def shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Channels by their labels, and of each point its three columns."""
    file = _opened(path)
    points = [f"{point}.{axis}" for point in _labels(file, "POINT") for axis in AXES]
    return dict.fromkeys(["time", *_labels(file, "ANALOG"), *points], ())


def count(path: Path, names: Sequence[str]) -> int:
    """From the header, which is as long as a block."""
    with path.open("rb") as file:
        words = np.frombuffer(file.read(20), "<u2")
    frames = int(words[4]) - int(words[3]) + 1
    return max(0, frames) * max(1, int(words[9]))
