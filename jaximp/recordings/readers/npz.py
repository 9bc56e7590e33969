"""NPZ, numpy's archive of arrays. Nothing is ever unpickled."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers.columns import largest, require


def read(path: Path, names: list[str]) -> dict[str, Any]:
    # numpy leaves a file open that it opened itself and could not read.
    with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
        for name in names:
            require(name, file.files)
        try:
            return {name: file[name] for name in names}
        except ValueError as error:
            if "allow_pickle" not in str(error):
                raise
            raise RecordingError("holds Python objects, which are never unpickled; save plain numeric arrays") from None


def count(path: Path, names: list[str]) -> int:
    """Read from the headers of the arrays inside; the numbers stay compressed."""
    import zipfile

    shapes = {}
    with zipfile.ZipFile(path) as archive:
        for name in names:
            with archive.open(f"{name}.npy") as member:
                first = npy.read_magic(member) == (1, 0)
                read_header = npy.read_array_header_1_0 if first else npy.read_array_header_2_0
                shapes[name] = read_header(member)[0]
    return largest(shapes, names)
