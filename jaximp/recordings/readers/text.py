"""CSV and its like: a header that names the columns, then rows, separated by comma, semicolon or tab."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers.columns import require


def read(path: Path, names: list[str]) -> dict[str, Any]:
    import pyarrow
    from pyarrow import csv as arrow

    with path.open(encoding="utf-8-sig") as file:
        header = next((line for line in file if line.strip("\r\n")), "").strip("\r\n")
    if not header:
        raise RecordingError("is empty; the first line must name the columns")
    delimiter = delimiter_of(header)
    raw = next(csv.reader([header], delimiter=delimiter))
    spelled = {column.strip(): column for column in raw}
    for name in names:
        require(name, spelled)
        if [column.strip() for column in raw].count(name) > 1:
            raise RecordingError(f"column {name!r} appears more than once in the header; give each column its own name")
    wanted = {spelled[name]: pyarrow.float64() for name in names}
    try:
        table = arrow.read_csv(
            path,
            parse_options=arrow.ParseOptions(delimiter=delimiter),
            convert_options=arrow.ConvertOptions(column_types=wanted, include_columns=list(wanted)),
        )
    except pyarrow.ArrowInvalid:
        _blame_row(path, delimiter, {name: raw.index(spelled[name]) for name in names}, len(raw))
        raise
    return {name: table[spelled[name]].to_numpy() for name in names}


def delimiter_of(header: str) -> str:
    """What separates the columns that a header names: comma, semicolon or tab."""
    return max(",;\t", key=header.count)


def _blame_row(path: Path, delimiter: str, wanted: dict[str, int], width: int) -> None:
    """Raise for the first data row that has a wrong number of fields, or text where a number is wanted."""
    from pyarrow import csv as arrow

    missing = {text.strip() for text in arrow.ConvertOptions().null_values}
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = filter(None, csv.reader(file, delimiter=delimiter))
        next(rows)
        for row, fields in enumerate(rows, start=1):
            if len(fields) != width:
                raise RecordingError(
                    f"row {row} has {len(fields)} fields, the header {width}; repair or remove the row"
                )
            for name, i in wanted.items():
                if fields[i].strip() not in missing and not _is_numeric(fields[i]):
                    raise RecordingError(
                        f"column {name!r}, row {row}: {fields[i]!r} is not a number; write numbers with a decimal "
                        "point and leave missing ones empty"
                    )


def _is_numeric(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text  # Python reads 1_0 as 10, the CSV reader does not


def count(path: Path, names: list[str]) -> int:
    """The number of lines that hold something, without the header."""
    lines, last = 0, b"\n"
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            lines, last = lines + block.count(b"\n"), block[-1:]
    return max(0, lines - 1 + (last != b"\n"))
