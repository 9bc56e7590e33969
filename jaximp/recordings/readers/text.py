"""CSV and its like: rows separated by comma, semicolon or tab, mostly under a header that names the columns.

Columns are asked for by name, or by number from 1. A file whose first line holds numbers alone has no header.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers.columns import require


def read(path: Path, names: Sequence[str | int]) -> dict[str | int, Any]:
    import pyarrow
    from pyarrow import csv as arrow

    first = _first_line(path)
    if not first:
        raise RecordingError("is empty; the first line must name the columns")
    delimiter = delimiter_of(first)
    raw = next(csv.reader([first], delimiter=delimiter))
    named = not _holds_numbers(raw) or set(names) <= set(map(str.strip, raw))
    columns = raw if named else [str(k + 1) for k in range(len(raw))]
    spelled = {name: _spelled(name, columns, named) for name in names}
    wanted = {column: pyarrow.float64() for column in spelled.values()}
    try:
        table = arrow.read_csv(
            path,
            read_options=arrow.ReadOptions(column_names=None if named else columns),
            parse_options=arrow.ParseOptions(delimiter=delimiter),
            convert_options=arrow.ConvertOptions(column_types=wanted, include_columns=list(wanted)),
        )
    except pyarrow.ArrowInvalid:
        _blame_row(path, delimiter, {column: columns.index(column) for column in wanted}, len(raw), named)
        raise
    return {name: table[column].to_numpy() for name, column in spelled.items()}


def _first_line(path: Path) -> str:
    """That holds something; nothing of an empty file."""
    with path.open(encoding="utf-8-sig") as file:
        return next((line for line in file if line.strip("\r\n")), "").strip("\r\n")


def _holds_numbers(fields: Sequence[str]) -> bool:
    """Whether a line names nothing: all its fields are numbers, or empty."""
    filled = [field.strip() for field in fields if field.strip()]
    return bool(filled) and all(map(_is_numeric, filled))


def _spelled(name: str | int, columns: Sequence[str], named: bool) -> str:
    """A column as the file has it, by its name or its number."""
    if isinstance(name, int):
        if name > len(columns):
            raise RecordingError(f"column {name} is not there: the file has {len(columns)} columns, counted from 1")
        name = columns[name - 1].strip()
    elif not named:
        raise RecordingError(
            f"column {name!r} is not there: the first line holds numbers and no names; give columns by number, such "
            "as position = [2, 3]"
        )
    require(name, [column.strip() for column in columns])
    if [column.strip() for column in columns].count(name) > 1:
        raise RecordingError(f"column {name!r} appears more than once in the header; give each column its own name")
    return next(column for column in columns if column.strip() == name)


def delimiter_of(header: str) -> str:
    """What separates the columns that a header names: comma, semicolon or tab."""
    return max(",;\t", key=header.count)


def _blame_row(path: Path, delimiter: str, wanted: dict[str, int], width: int, named: bool) -> None:
    """Raise for the first data row that has a wrong number of fields, or text where a number is wanted."""
    from pyarrow import csv as arrow

    missing = {text.strip() for text in arrow.ConvertOptions().null_values}
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = filter(None, csv.reader(file, delimiter=delimiter))
        if named:
            next(rows)
        for row, fields in enumerate(rows, start=1):
            if len(fields) != width:
                raise RecordingError(
                    f"row {row} has {len(fields)} fields, the {'header' if named else 'first row'} {width}; repair or "
                    "remove the row"
                )
            for name, i in wanted.items():
                if fields[i].strip() not in missing and not _is_numeric(fields[i]):
                    raise RecordingError(
                        f"column {name.strip()!r}, row {row}: {fields[i]!r} is not a number; write numbers with a "
                        "decimal point and leave missing ones empty"
                    )


def _is_numeric(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text  # Python reads 1_0 as 10, the CSV reader does not


def count(path: Path, names: Sequence[str | int]) -> int:
    """The number of lines, without the header."""
    lines, last = 0, b"\n"
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            lines, last = lines + block.count(b"\n"), block[-1:]
    first = _first_line(path)
    header = not _holds_numbers(next(csv.reader([first], delimiter=delimiter_of(first)), []))
    return max(0, lines - header + (last != b"\n"))
