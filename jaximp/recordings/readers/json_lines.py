"""JSON lines: one object a line, a column for every key, `wrench.force[2]` for what is nested."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from jaximp.recordings.readers.found import Found
from jaximp.recordings.readers.parquet import columns_of_table, shapes_in_schema


def read(path: Path, names: Sequence[str]) -> Found:
    from pyarrow import json

    with path.open("rb") as file:
        return columns_of_table(json.read_json(file), names)


def shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Keys whose values are numbers."""
    from pyarrow import json

    with path.open("rb") as file:
        return shapes_in_schema(json.read_json(file).schema)


def count(path: Path, names: Sequence[str]) -> int:
    """The number of lines."""
    with path.open("rb") as file:
        return sum(block.count(b"\n") for block in iter(lambda: file.read(1 << 20), b"")) + 1
