"""NPZ, numpy's archive of arrays, and NPY, one of them. Nothing is ever unpickled."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers.columns import head_of, largest, pick, require_variable, steps_of
from jaximp.recordings.readers.found import Found


def read(path: Path, names: Sequence[str]) -> Found:
    notes: list[str] = []
    # numpy leaves a file open that it opened itself and could not read.
    with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
        heads = {name: (name, []) if name in file.files else steps_of(name) for name in names}
        for name, (head, _) in heads.items():
            if head not in file.files:
                require_variable(head, _shapes(path), name)
        _shapes(path, {head for head, _ in heads.values()})
        try:
            arrays = {head: file[head] for head, _ in heads.values()}
        except ValueError as error:
            if "allow_pickle" not in str(error):
                raise
            raise RecordingError("holds Python objects, which are never unpickled; save plain numeric arrays") from None
    return Found(
        {name: pick(arrays[head], steps, name, notes) for name, (head, steps) in heads.items()}, notes=tuple(notes)
    )


def count(path: Path, names: Sequence[str]) -> int:
    """Read from the headers of the arrays inside; the numbers stay compressed."""
    return largest(_shapes(path, {*names, *map(head_of, names)}), list(names))


def _shapes(path: Path, wanted: Any = None) -> dict[str, tuple[int, ...]]:
    import zipfile

    shapes = {}
    with zipfile.ZipFile(path) as archive:
        for member in archive.namelist():
            name = member.removesuffix(".npy")
            if wanted is not None and name not in wanted:
                continue
            with archive.open(member) as opened:
                first = npy.read_magic(opened) == (1, 0)
                read_header = npy.read_array_header_1_0 if first else npy.read_array_header_2_0
                shape, _, kind = read_header(opened)
                held = archive.getinfo(member).file_size
                if not kind.hasobject and math.prod(shape) * kind.itemsize > held:
                    raise RecordingError(f"{name!r} says that it holds more than the file: write it anew")
                shapes[name] = tuple(shape)
    return shapes


def shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Of every array."""
    return _shapes(path)
