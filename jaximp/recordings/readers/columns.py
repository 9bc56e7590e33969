"""What readers share: whether a column is there, how long a variable is that may have several columns, and names of
parts of a variable, as MATLAB and numpy write them: `data(:,2)`, `data[:,1]`, `q[3]`, `data(2).torque`, `log.q`."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaximp.recordings.errors import RecordingError
from jaximp.types import Numbers, nearest

MOST_COLUMNS = 1000
"""A variable that is longer than this along both axes is no recording."""
_STEP = re.compile(r"[./]([^./()\[\]{}]+)|\(([^()]*)\)|\[([^\[\]]*)\]|\{([^{}]*)\}")


@dataclass(frozen=True)
class Index:
    """What stands in brackets behind a name."""

    text: str
    """With its brackets."""
    at: tuple[int | None, ...]
    """Places from 0; None for all along an axis."""
    whole: bool
    """Whether an axis is kept: `(:,2)`. A single number means an element of a struct array, or a column."""


def require(name: str, available: Iterable[str], what: str | None = None) -> None:
    """Refuse a name that a file does not have; the error calls it `what`, or else a column."""
    choices = list(available)
    if name not in choices:
        hint = nearest(name, choices) if choices else "there are none"
        raise RecordingError(f"{what or f'column {name!r}'} is not there; {hint}")


def require_variable(name: str, shapes: Mapping[str, tuple[int, ...]], whole: str) -> None:
    """Refuse a variable that a file does not have; the error says which it has, and their shapes."""
    if name in shapes:
        return
    hint = nearest(name, list(shapes)) if shapes else "there are none"
    if not hint.startswith("did"):
        hint = f"there are: {', '.join(sized(shapes))}" if shapes else hint
    raise RecordingError(f"column {whole!r} is not there; {hint}")


def sized(shapes: Mapping[str, tuple[int, ...]], most: int = 50) -> list[str]:
    """Names of variables with their shapes."""
    out = [f"'{name}' ({' x '.join(map(str, shape))})" if shape else f"'{name}'" for name, shape in shapes.items()]
    return [*out[:most], *["..."] * (len(out) > most)]


def steps_of(name: str) -> tuple[str, list[str | Index]]:
    """A name's head, and the fields and places behind it."""
    head = re.match(r"[./]?[^./()\[\]{}]*", name)
    position, steps = head.end() if head else 0, list[str | Index]()
    while position < len(name):
        found = _STEP.match(name, position)
        if found is None:
            raise RecordingError(f"column {name!r} is not there, and is no name such as data.q, data(:,2) or data(2).q")
        steps.append(found[1] if found[1] is not None else _index(name, found.group(0)))
        position = found.end()
    return name[: head.end() if head else 0], steps


def _index(name: str, text: str) -> Index:
    parts = [part.strip() for part in text[1:-1].split(",")]
    if not all(part == ":" or part.isdecimal() for part in parts):
        raise RecordingError(f"column {name!r}: {text} is not understood; write data(:,2), data[:,1] or data[2]")
    # numpy counts from 0 where it slices; a single number counts from 1, as in all of this project's labels.
    start = 0 if text[0] == "[" and ":" in parts else 1
    at = tuple(None if part == ":" else int(part) - start for part in parts)
    if any(one is not None and one < 0 for one in at):
        zero = f"{name.partition(text)[0]}[:,0]"
        raise RecordingError(f"column {name!r}: columns count from 1; write [1] for the first one, or numpy's {zero}")
    return Index(text, at, None in at)


def pick(value: Any, steps: Sequence[str | Index], name: str, notes: list[str]) -> Any:
    """Part of a variable; what was decided is added to the notes."""
    seen = name
    for step in steps:
        seen = name.partition(step.text if isinstance(step, Index) else step)[0].rstrip("./") or name
        value = _field(value, step, seen, name) if isinstance(step, str) else _place(value, step, seen, name, notes)
    if getattr(value, "dtype", None) is not None and value.dtype == object and value.dtype.names is None:
        raise RecordingError(f"{name!r} is a list of {value.size} variables: name one, such as {name}{{1}}")
    if getattr(value, "dtype", None) is not None and value.dtype.names is not None:
        raise RecordingError(f"{name!r} has fields: name one, such as {name}.{value.dtype.names[0]}")
    return value


def _is_struct(value: Any) -> bool:
    """Whether it is a MATLAB struct (array), and not a table with a field for every column."""
    names = getattr(getattr(value, "dtype", None), "names", None)
    return names is not None and all(value.dtype[field].kind == "O" for field in names)


def _field(value: Any, field: str, seen: str, name: str) -> Any:
    fields = getattr(getattr(value, "dtype", None), "names", None) or ()
    require(field, fields, f"field {field!r} of {name!r}")
    if _is_struct(value):
        if value.size != 1:
            raise RecordingError(f"{seen!r} is an array of {value.size} structs: name one, such as {seen}(1).{field}")
        return value.ravel()[0][field]
    return value[field]


def _place(value: Any, index: Index, seen: str, name: str, notes: list[str]) -> Any:
    array = np.asarray(value)
    if array.dtype == object or _is_struct(array):
        flat = array.ravel(order="F")
        if index.whole or len(index.at) != 1 or index.at[0] is None or index.at[0] >= len(flat):
            raise RecordingError(
                f"{name!r}: {seen} is a list of {len(flat)}; name one, {seen}(1) to {seen}({len(flat)})"
            )
        chosen = flat[index.at[0]]
        return np.asarray(chosen) if not _is_struct(array) else flat[index.at[0] : index.at[0] + 1]
    if not index.whole:
        if index.text[0] != "[" or len(index.at) != 1:
            raise RecordingError(f"{name!r} is one number of {seen}; write {seen}(:,2) for its second column")
        columns = np.atleast_2d(array).T if array.ndim < 2 or array.shape[0] == 1 else array
        index = Index(index.text, (None, index.at[0]), True)
        notes.append(f"{name!r} is column {(index.at[1] or 0) + 1} of {columns.shape[1]}, counted from 1")
        array = columns
    if len(index.at) != array.ndim or index.at.count(None) != 1:
        shape = " x ".join(map(str, array.shape))
        raise RecordingError(f"{name!r}: {seen} is {shape}; give a number for every axis but one, such as {seen}(:,2)")
    for at, size in zip(index.at, array.shape, strict=True):
        if at is not None and at >= size:
            shape = " x ".join(map(str, array.shape))
            raise RecordingError(f"column {name!r} is not there: {seen} is {shape}")
    return array[tuple(slice(None) if at is None else at for at in index.at)]


def head_of(name: str) -> str:
    """The variable that a name begins with."""
    try:
        return steps_of(name)[0]
    except RecordingError:
        return name


def largest(shapes: dict[str, tuple[int, ...]], names: list[str]) -> int:
    """The most numbers along any axis of a variable that is wanted: time is the longest."""
    heads = {head_of(name) for name in names} | set(names)
    wanted = {name: shape for name, shape in shapes.items() if name in heads}
    for name, shape in wanted.items():
        if len(shape) > 1 and sorted(shape)[-2] > MOST_COLUMNS:
            raise RecordingError(f"{name!r} has shape {shape}: a recording has (samples, joints)")
    return max((max(shape, default=0) for shape in wanted.values()), default=0)


def values_at(at: Numbers, stamps: Numbers, values: Numbers, gap: float) -> Numbers:
    """Values at other times, linearly between samples whose `stamps` increase: NaN outside, and in what is longer than
    `gap` usual intervals."""
    found = np.interp(at, stamps, values, left=np.nan, right=np.nan)
    if len(stamps) > 1:
        after = np.clip(np.searchsorted(stamps, at), 1, len(stamps) - 1)
        wide = stamps[after] - stamps[after - 1] > gap * np.median(np.diff(stamps))
        found[wide & (at > stamps[after - 1]) & (at < stamps[after])] = np.nan
    return found
