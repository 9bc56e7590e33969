"""MATLAB: v5 by scipy; v7.3 is HDF5 with every array transposed and structs as groups."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers import hdf5
from jaximp.recordings.readers.columns import largest, require

MOST_NUMBERS = 1_000_000_000
"""A struct that holds more numbers than this is not unpacked to count them."""
COMPRESSED = 15
"""How a v5 file marks what it compressed."""


def read(path: Path, names: list[str]) -> dict[str, Any]:
    """The variables of these names, or the fields of structs: `data.q`."""
    import h5py

    if h5py.is_hdf5(path):
        paths = {name: name.replace(".", "/") for name in names}
        found = hdf5.read(path, list(paths.values()), matlab=True)
        return {name: np.transpose(found[paths[name]]) for name in names}
    from scipy.io import loadmat, whosmat

    _check_complete(path)
    variables = [name for name, _, _ in whosmat(path)]
    for name in names:
        require(name.split(".")[0], variables)
    content = loadmat(path, variable_names=[name.split(".")[0] for name in names])
    return {name: _field(content, name) for name in names}


def _field(content: dict[str, Any], name: str) -> Any:
    head, *fields = name.split(".")
    value = content[head]
    for field in fields:
        require(field, value.dtype.names or (), f"field {field!r} of {name!r}")
        value = value[field][0, 0]
    return value


def count(path: Path, names: list[str]) -> int:
    import h5py

    if h5py.is_hdf5(path):
        return hdf5.count(path, [name.replace(".", "/") for name in names])
    from scipy.io import whosmat

    unpacked = _check_complete(path)
    shapes = {name: shape for name, shape, _ in whosmat(path)}
    inside = [name for name in names if "." in name and name.split(".")[0] in shapes]
    if inside and unpacked > 8 * MOST_NUMBERS:
        return unpacked // 8
    # A struct tells its fields' shapes to nobody who does not unpack it.
    return largest(shapes | {name: np.shape(column) for name, column in read(path, inside).items()}, names)


def _check_complete(path: Path) -> int:
    """Follow the variables of a MATLAB v5 file by their lengths: scipy reads a file that was cut as one with fewer.

    **Returns:** how many bytes they say that they unpack to.
    """
    size, unpacked = path.stat().st_size, 0
    with path.open("rb") as file:
        order: Literal["little", "big"] = "little" if file.read(128)[126:128] == b"IM" else "big"
        position = 128
        while position < size:
            file.seek(position)
            kind, length = (int.from_bytes(file.read(4), order) for _ in range(2))
            position += 8 + length
            if kind == COMPRESSED:
                head = zlib.decompressobj().decompress(file.read(min(length, 4096)), 8)
                length = int.from_bytes(head[4:], order)
            unpacked += length
    if position > size:
        raise RecordingError("the file ends in the middle of a variable: it was cut, copy it again")
    return unpacked
