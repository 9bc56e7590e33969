"""MATLAB: v5 by scipy; v7.3 is HDF5 with every array transposed and structs as groups."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers import hdf5
from jaximp.recordings.readers.claims import MATRIX, MOST_AXES, check_elements
from jaximp.recordings.readers.columns import head_of, largest, pick, require_variable, steps_of
from jaximp.recordings.readers.found import Found
from jaximp.recordings.readers.matlab_objects import column_of_object

MOST_NUMBERS = 1_000_000_000
"""A struct that holds more numbers than this is not unpacked to count them."""
COMPRESSED = 15
"""How a v5 file marks what it compressed."""
OBJECT, STRUCT, CELL = 17, 2, 1
"""Kinds of variables in a v5 file."""


@dataclass(frozen=True)
class Variable:
    """What a v5 file says of a variable above its numbers."""

    name: str
    kind: int
    shape: tuple[int, ...] = ()
    of: str = ""
    """The class of an object: `table`."""


def read(path: Path, names: Sequence[str]) -> Found:
    """The variables of these names, or parts of them: `data.q`, `data(:,2)`, `data(2).q`."""
    import h5py

    if h5py.is_hdf5(path):
        return hdf5.read(path, names, matlab=True)
    from scipy.io import loadmat

    _, variables = _walk(path)
    heads = {name: steps_of(name) for name in names}
    plain = {one.name: one.shape for one in variables.values() if one.kind != OBJECT and one.name}
    for name, (head, _) in heads.items():
        if head not in variables:
            require_variable(head, plain, name)
    content = loadmat(path, variable_names=[head for head, _ in heads.values() if variables[head].kind != OBJECT])
    notes: list[str] = []
    return Found(
        {
            name: column_of_object(path, head, steps, name, variables[head].of, notes)
            if variables[head].kind == OBJECT
            else pick(content[head], steps, name, notes)
            for name, (head, steps) in heads.items()
        },
        notes=tuple(notes),
    )


def count(path: Path, names: Sequence[str]) -> int:
    import h5py

    if h5py.is_hdf5(path):
        return hdf5.count(path, names, matlab=True)
    unpacked, variables = _walk(path)
    shapes = {name: one.shape for name, one in variables.items() if one.kind not in (OBJECT, STRUCT, CELL)}
    inside = [name for name in names if head_of(name) in variables and variables[head_of(name)].kind in (STRUCT, CELL)]
    if inside and unpacked > 8 * MOST_NUMBERS:
        return unpacked // 8
    # A struct tells its fields' shapes to nobody who does not unpack it.
    return largest(shapes | {name: np.shape(column) for name, column in read(path, inside).values.items()}, list(names))


def _walk(path: Path) -> tuple[int, dict[str, Variable]]:
    """Follow the variables of a MATLAB v5 file by their lengths: scipy reads a file that was cut as one with fewer, and
    its list of variables fails at the first object.

    **Returns:** how many bytes they say that they unpack to, and what they are.
    """
    size, unpacked, variables = path.stat().st_size, 0, dict[str, Variable]()
    with path.open("rb") as file:
        order: Literal["little", "big"] = "little" if file.read(128)[126:128] == b"IM" else "big"
        position = 128
        while position < size:
            file.seek(position)
            kind, length = (int.from_bytes(file.read(4), order) for _ in range(2))
            if position + 8 + length > size:
                raise RecordingError("the file ends in the middle of a variable: it was cut, copy it again")
            if kind == MATRIX:
                check_elements(file, position + 8, position + 8 + length, order)
                file.seek(position + 8)
            position += 8 + length
            head = file.read(min(length, 4096))
            if kind == COMPRESSED:
                head = zlib.decompressobj().decompress(head, 1024)
                length = int.from_bytes(head[4:8], order)
                head = head[8:]
            unpacked += length
            found = _variable(head, order)
            if len(found.shape) > MOST_AXES or not (found.name.isascii() and (found.name + "_").isidentifier()):
                raise RecordingError("the file is damaged: a variable has no name, or no shape; write it anew")
            variables[found.name] = found
    if not variables:
        raise RecordingError("cannot be read as .mat (it holds no variables): write it anew")
    return unpacked, variables


def _variable(head: bytes, order: Literal["little", "big"]) -> Variable:
    """From the elements at the beginning of a variable: its flags, shape and name."""
    elements: list[bytes] = []
    position = 0
    while position + 8 <= len(head) and len(elements) < 4:
        word = int.from_bytes(head[position : position + 4], order)
        if word >> 16:  # a short element has its length in the upper half of its first word
            elements.append(head[position + 4 : position + 4 + (word >> 16)])
            position += 8
            continue
        length = int.from_bytes(head[position + 4 : position + 8], order)
        elements.append(head[position + 8 : position + 8 + length])
        position += 8 + length + -length % 8
    if len(elements) < 3:
        return Variable("", 0)
    kind = int.from_bytes(elements[0][:4], order) & 0xFF
    if kind == OBJECT:
        of = elements[3].decode("latin1") if len(elements) > 3 else "object"
        return Variable(elements[1].decode("latin1"), kind, of=of)
    shape = tuple(int.from_bytes(elements[1][k : k + 4], order) for k in range(0, len(elements[1]), 4))
    return Variable(elements[2].decode("latin1"), kind, shape)


def shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Of every variable of numbers, and of the fields of a struct."""
    import h5py

    if h5py.is_hdf5(path):
        return hdf5.shapes(path, matlab=True)
    from scipy.io import loadmat

    found: dict[str, tuple[int, ...]] = {}
    for one in _walk(path)[1].values():
        if one.kind == STRUCT and int(np.prod(one.shape)) == 1:
            fields = loadmat(path, variable_names=[one.name])[one.name]
            found |= {f"{one.name}.{name}": np.shape(fields[name].item()) for name in fields.dtype.names or ()}
        elif one.kind not in (OBJECT, STRUCT, CELL):
            found[one.name] = one.shape
    return {name: tuple(size for size in shape if size != 1) or (1,) for name, shape in found.items()}
