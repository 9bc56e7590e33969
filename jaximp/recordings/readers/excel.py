"""Excel and OpenDocument tables: the first sheet with rows of numbers, read as a text file is, cell by cell.

A name may begin with a sheet's: `Trial 2!angle`.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers.claims import check_workbook
from jaximp.recordings.readers.columns import require
from jaximp.recordings.readers.found import AS_SEEN, Found, TextOptions
from jaximp.recordings.readers.library import library
from jaximp.recordings.readers.text import read_text, shapes_in_text


def read(path: Path, names: Sequence[str | int], options: TextOptions = AS_SEEN) -> Found:
    book = _opened(path)
    sheets = {str(name).partition("!")[0] for name in names if "!" in str(name)}
    if len(sheets) > 1:
        raise RecordingError(f"columns of the sheets {' and '.join(sorted(sheets))}: take all of them from one sheet")
    for sheet in sheets:
        require(sheet, book.sheet_names, f"sheet {sheet!r}")
    options = replace(options, separator="\t", decimal=".", encoding=None)
    bare = {name: name.partition("!")[2] if isinstance(name, str) and "!" in name else name for name in names}
    name, found = _first_readable(book, list(sheets) or book.sheet_names, list(bare.values()), options)
    notes = list(found.notes)
    if len(book.sheet_names) > 1 and not sheets:
        notes.insert(0, f"the sheet {name!r} is read, one of {len(book.sheet_names)} (name another: 'Sheet2!angle')")
    return Found(
        values={asked: found.values[one] for asked, one in bare.items()},
        names={
            asked: found.names.get(one, str(one)) for asked, one in bare.items() if one in found.names or one != asked
        },
        units={asked: found.units[one] for asked, one in bare.items() if one in found.units},
        angles=found.angles,
        notes=tuple(notes),
    )


def _opened(path: Path) -> Any:
    calamine = library("python_calamine", "python-calamine", path.suffix)
    if path.suffix.lower() == ".xlsx":
        check_workbook(path)
    return calamine.CalamineWorkbook.from_path(path)


def _first_readable(
    book: Any, sheets: Sequence[str], names: Sequence[str | int], options: TextOptions
) -> tuple[str, Found]:
    first: RecordingError | None = None
    for sheet in sheets:
        try:
            return sheet, read_text(_as_text(book, sheet), names, options)
        except RecordingError as error:
            first = first or error
    raise first or RecordingError("holds no sheet")


def _as_text(book: Any, sheet: str) -> memoryview:
    rows = book.get_sheet_by_name(sheet).to_python(skip_empty_area=False)
    return memoryview(("\n".join("\t".join(map(_cell, row)) for row in rows) + "\n").encode())


def shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """What the columns of the first sheet with several of them are called."""
    book = _opened(path)
    for sheet in book.sheet_names:
        with suppress(RecordingError):
            found = shapes_in_text(_as_text(book, sheet))
            if len(found) > 1:
                return found
    raise RecordingError("holds no sheet with columns of numbers")


def _cell(value: Any) -> str:
    """As text that holds the number to its last bit."""
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, datetime.timedelta):
        return repr(value.total_seconds())
    if isinstance(value, datetime.datetime | datetime.time):
        return value.isoformat()
    return " ".join(str(value).split())


def count(path: Path, names: Sequence[str | int]) -> int:
    book = _opened(path)
    return max(book.get_sheet_by_name(name).total_height for name in book.sheet_names)
