"""What readers share: whether a column is there, and how long a variable is that may have several columns."""

from __future__ import annotations

from collections.abc import Iterable

from jaximp.recordings.errors import RecordingError
from jaximp.types import nearest

MOST_COLUMNS = 1000
"""A variable that is longer than this along both axes is no recording."""


def require(name: str, available: Iterable[str], what: str | None = None) -> None:
    """Refuse a name that a file does not have; the error calls it `what`, or else a column."""
    choices = list(available)
    if name not in choices:
        hint = nearest(name, choices) if choices else "there are none"
        raise RecordingError(f"{what or f'column {name!r}'} is not there; {hint}")


def largest(shapes: dict[str, tuple[int, ...]], names: list[str]) -> int:
    """The most numbers along any axis of a variable that is wanted: time is the longest."""
    heads = {name.split(".")[0] for name in names} | set(names)
    wanted = {name: shape for name, shape in shapes.items() if name in heads}
    for name, shape in wanted.items():
        if len(shape) > 1 and sorted(shape)[-2] > MOST_COLUMNS:
            raise RecordingError(f"{name!r} has shape {shape}: a recording has (samples, joints)")
    return max((max(shape, default=0) for shape in wanted.values()), default=0)
