"""What a binary file says of its own parts, held against its length.

Libraries in C believe what they read there: a damaged size ends Python without a word, asks for all of the memory, or
gives fewer samples than were recorded.
"""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np

from jaximp.recordings.errors import RecordingError

BLOCK = 512
"""Bytes of a block of a C3D file."""
NEEDED = {"POINT": ("USED", "SCALE", "RATE"), "ANALOG": ("USED", "SCALE", "OFFSET", "GEN_SCALE", "RATE")}
"""Numbers without which the samples of a C3D file mean nothing."""
ORDERS: dict[int, Literal["little", "big"]] = {84: "little", 85: "little", 86: "big"}
"""Of the processors that wrote C3D files."""
MATRIX, CELL, STRUCT, OBJECT, FUNCTION, OPAQUE = 14, 1, 2, 3, 16, 17
"""An element of a MATLAB v5 file that is a variable, and kinds of variables."""
ELEMENTS = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13, MATRIX, 16, 17, 18}
"""Kinds of elements of a MATLAB v5 file."""
HOLDERS = {CELL, STRUCT, OBJECT, FUNCTION, OPAQUE}
"""Variables that hold others."""
MOST_AXES = 32
"""A variable with more axes than that was not written by MATLAB."""
MOST_TEXT = 1 << 32
"""Bytes that a workbook may unpack to."""
MOST_EMPTY = 20_000_000
"""Cells that a sheet may have, most of them empty: they take half a gigabyte."""
_PLACE = re.compile(rb' r="([A-Z]{0,3})([0-9]{1,9})"')
"""The place of a row, or of a cell."""
MCAP_MAGIC = b"\x89MCAP0\r\n"
CHUNK_INDEX = b"\x08"


def check_c3d(path: Path) -> None:
    """The header, the list of parameters and the length of a C3D file.

    **Raises:** `RecordingError` for a file that is damaged or was cut.
    """
    content = np.memmap(path, "u1", "r") if path.stat().st_size >= 2 * BLOCK else np.zeros(0, "u1")
    start = (int(content[0]) - 1) * BLOCK if len(content) else -1
    if start < BLOCK or len(content) < start + BLOCK or content[1] != 0x50 or int(content[start + 3]) not in ORDERS:
        raise _damaged("c3d", "its header is none of such a file")
    order = ORDERS[int(content[start + 3])]
    header = np.frombuffer(bytes(content[:20]), "<u2" if order == "little" else ">u2").astype(int)
    end = min(len(content), start + max(1, int(content[start + 2])) * BLOCK)
    groups = _parameters(bytes(content[start + 4 : end]), order)
    points, analog, first, last, data = (int(header[k]) for k in (1, 2, 3, 4, 8))
    whole = _is_whole(bytes(content[12:16]), order, int(content[start + 3]) == 85)
    for group, names in NEEDED.items():
        lacking = [name for name in names if groups.get(group, {}).get(name, -1) < 0]
        if lacking and (group == "POINT" or analog):
            raise _damaged("c3d", f"it lacks {group}:{lacking[0]}")
    needed = (data - 1) * BLOCK + max(0, last - first + 1) * (4 * points + analog) * (2 if whole else 4)
    if needed > len(content):
        raise RecordingError(f"has {len(content)} bytes, and its header says {needed}: it was cut, copy it again")


def _is_whole(scale: bytes, order: str, dec: bool) -> bool:
    """Whether the samples are whole numbers: else the scale of the points is negative."""
    sign = scale[1] if dec else scale[3] if order == "little" else scale[0]
    return sign < 0x80


def _parameters(content: bytes, order: Literal["little", "big"]) -> dict[str, dict[str, int]]:
    """Groups and parameters of a C3D file, followed by their lengths, with their kinds: -1 for text, else bytes."""
    found, called = dict[int, dict[str, int]](), dict[int, str]()
    at = 0
    while at + 2 <= len(content) and content[at]:
        length, group = (int.from_bytes(content[k : k + 1], "little", signed=True) for k in (at, at + 1))
        place = at + 2 + abs(length)  # that of a parameter which is locked is negative
        name = content[at + 2 : place].decode("latin1").upper()
        step = int.from_bytes(content[place : place + 2], order)
        body, following = place + 2, place + step if step else len(content)
        if group > 0:
            kind = int.from_bytes(content[body : body + 1], "little", signed=True)
            axes = content[body + 1] if body + 1 < len(content) else MOST_AXES
            if kind not in (-1, 1, 2, 4) or axes > 7:
                raise _damaged("c3d", "its list of parameters cannot be followed")
            body += 2 + axes + math.prod(content[body + 2 : body + 2 + axes]) * abs(kind)
            found.setdefault(group, {})[name] = kind
        else:
            called[-group] = name
        described = content[body] if body < len(content) else 0
        if not at < following <= len(content) or body + 1 + described > following:
            raise _damaged("c3d", "its list of parameters cannot be followed")
        at = following
    return {name: found.get(group, {}) for group, name in called.items()}


def check_workbook(path: Path) -> None:
    """How far the cells of an Excel workbook reach: all cells up to the last row and column are made, empty or not.

    **Raises:** `RecordingError` for one cell far away from the others, and for sheets that unpack to too much.
    """
    with zipfile.ZipFile(path) as archive:
        sheets = [one for one in archive.infolist() if one.filename.startswith("xl/worksheets/")]
        if sum(one.file_size for one in archive.infolist()) > MOST_TEXT:
            raise RecordingError("unpacks to more than 4 GB: save the sheet as CSV")
        for sheet in sheets:
            row, column = _last_cell(archive, sheet)
            if row * column > max(MOST_EMPTY, sheet.file_size):
                raise RecordingError(
                    f"a sheet has cells in row {row} and in column {column}, and hardly any before: delete those that "
                    "stand apart, or save the sheet as CSV"
                )


def _last_cell(archive: zipfile.ZipFile, sheet: zipfile.ZipInfo) -> tuple[int, int]:
    """The last row and column that cells of a sheet name, from 1."""
    row, columns, rest = 0, set[bytes](), b""
    with archive.open(sheet) as file:
        while block := file.read(1 << 20):
            text = rest + block
            for letters, number in set(_PLACE.findall(text)):
                columns.add(letters)
                row = max(row, int(number))
            rest = text[-100:]
    last = max(columns, key=lambda one: (len(one), one), default=b"")
    return row, sum((letter - 64) * 26**place for place, letter in enumerate(reversed(last)))


def check_mcap(path: Path) -> None:
    """The records of an MCAP file, by their lengths.

    **Raises:** `RecordingError` for a file that is damaged or was cut.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(8) != MCAP_MAGIC:
            raise _damaged("mcap", "it does not begin as such a file does")
        at = 8
        while at + 9 <= size - 8:
            file.seek(at)
            kind, length = file.read(1), int.from_bytes(file.read(8), "little")
            if kind == CHUNK_INDEX and _packed(file.read(min(length, size))) > size:
                raise _damaged("mcap", "a part says that it is longer than the file")
            at += 9 + length
        if at != size - 8:
            raise RecordingError("the file ends in the middle of a record: it was cut or is damaged, copy it again")


def _packed(index: bytes) -> int:
    """How many bytes of the file a chunk takes, as its index says."""
    at = 36 + int.from_bytes(index[32:36], "little") + 8  # behind four numbers, a table and its length
    at += 4 + int.from_bytes(index[at : at + 4], "little")  # behind the name of the compression
    return int.from_bytes(index[at : at + 8], "little")


def check_elements(file: BinaryIO, start: int, end: int, order: Literal["little", "big"]) -> None:
    """A variable of a MATLAB v5 file that is not compressed, between two places of the file, and what it holds.

    **Raises:** `RecordingError` for a file that is damaged.
    """
    before: list[bytes] = []
    for kind, at, length in _elements(file, start, end, order):
        if kind not in ELEMENTS or at + length > end:
            raise _damaged("mat", "it holds an element of no known kind")
        if kind == MATRIX:
            if before and _kind(before[0], order) not in HOLDERS:
                raise _damaged("mat", "a variable of numbers holds another one")
            if length:
                check_elements(file, at, at + length, order)
        elif len(before) < 2:
            file.seek(at)
            before.append(file.read(min(length, 4 * MOST_AXES)))
            if len(before) == 2:
                _check_shape(before, length, end - start, order)


def _elements(file: BinaryIO, at: int, end: int, order: Literal["little", "big"]) -> Iterator[tuple[int, int, int]]:
    """Kind, place and length of the elements between two places."""
    while at + 8 <= end:
        file.seek(at)
        kind, length = (int.from_bytes(file.read(4), order) for _ in range(2))
        if kind >> 16:  # a short element has its length in the upper half of its first word
            yield kind & 0xFFFF, at + 4, min(4, kind >> 16)
            at += 8
        else:
            yield kind, at + 8, length
            at += 8 + length + -length % 8


def _kind(flags: bytes, order: Literal["little", "big"]) -> int:
    return int.from_bytes(flags[:4], order) & 0xFF


def _check_shape(before: list[bytes], length: int, size: int, order: Literal["little", "big"]) -> None:
    kind = _kind(before[0], order)
    if kind == OPAQUE:
        return
    shape = [int.from_bytes(before[1][k : k + 4], order) for k in range(0, len(before[1]), 4)]
    least = 8 if kind in (STRUCT, CELL) else 0  # a field of a struct has a head of its own
    if length > 4 * MOST_AXES or math.prod(shape) * least > size:
        raise _damaged("mat", "a variable says that it holds more than the file")


def _damaged(extension: str, cause: str) -> RecordingError:
    return RecordingError(f"cannot be read as .{extension} ({cause}): the file is damaged or of another kind")
