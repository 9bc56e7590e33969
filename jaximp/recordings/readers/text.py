"""CSV and its like, as recorders, spreadsheets, LabVIEW, OpenSim and C programs write them.

`sniff` sees how a file is laid out; pyarrow reads its rows. Columns are asked for by name, or by number from 1; a file
in which no line names the columns has only numbers. A number is what is written or the file is refused: rows that
cannot be read are counted and the first is named.
"""

from __future__ import annotations

import codecs
import gzip
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers import times
from jaximp.recordings.readers.columns import require
from jaximp.recordings.readers.found import AS_SEEN, Found, TextOptions
from jaximp.recordings.readers.sniff import (
    COMMENT,
    HEAD,
    MISSING,
    NUMBER,
    TAIL,
    Layout,
    fits,
    is_missing,
    is_value,
    layout_of,
    shortened,
    split,
)

BYTES_OF_HEAD = 1 << 18
"""Of a file, from which its first lines are taken."""
DEGREES = re.compile(r"inDegrees\s*=\s*(yes|true|1)", re.IGNORECASE)
"""What OpenSim writes above angles in degrees."""
MARKS = {codecs.BOM_UTF8: "utf-8", codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}
CONTROL = bytes(sorted({*range(32), 127} - {*b"\t\n\r\f\v\x1a"}))
"""What no text holds."""


def read(path: Path, names: Sequence[str | int], options: TextOptions = AS_SEEN) -> Found:
    content, notes = _decoded(_bytes_of(path), options)
    return read_text(content, names, options, notes)


def read_text(
    content: memoryview, names: Sequence[str | int], options: TextOptions, notes: Sequence[str] = ()
) -> Found:
    """The columns of a file's content, in UTF-8."""
    lines = _first_lines(content)
    if not any(line.strip() for line in lines):
        raise RecordingError("is empty; the first line must name the columns")
    layout = _with_numbers_for_names(lines, layout_of(lines, options), names)
    body, left_out = _without_tail(content[_start(content, layout.first) :], layout)
    columns = {name: _column(name, layout) for name in names}
    table = _Table(body, layout, sorted(set(columns.values())), options)
    return Found(
        values={name: table.values[i] for name, i in columns.items()},
        names={name: layout.names[i] for name, i in columns.items() if layout.names and isinstance(name, int)},
        units={name: layout.units[i] for name, i in columns.items() if layout.units and layout.units[i]},
        angles="deg" if any(DEGREES.fullmatch(line.strip()) for line in lines[: layout.first]) else None,
        notes=(*notes, *layout.notes, *left_out, *table.notes),
    )


# --- bytes and lines --------------------------------------------------------------------------------------------------


def _bytes_of(path: Path) -> memoryview:
    if path.suffix.lower() == ".gz":
        with gzip.open(path) as file:
            return memoryview(file.read())
    return memoryview(path.read_bytes())


def _decoded(content: memoryview, options: TextOptions) -> tuple[memoryview, list[str]]:
    """The content in UTF-8, and how it was encoded where that is not UTF-8."""
    marked = next((mark for mark in MARKS if bytes(content[:3]).startswith(mark)), b"")
    encoding = options.encoding or MARKS.get(marked) or _unmarked(content)
    content = content[len(marked) :]
    try:
        if encoding == "utf-8":
            _refuse_control(content)
            try:
                str(content, "utf-8")
                return content, []
            except UnicodeDecodeError:
                if options.encoding or marked:
                    raise
                encoding = "cp1252"
        text = str(content, encoding)
    except LookupError:
        raise RecordingError(f'encoding: {encoding!r} is not known; write "utf-8", "utf-16" or "cp1252"') from None
    except UnicodeDecodeError:
        raise RecordingError(
            f'is not {encoding} text, nor UTF-8; save it with that encoding, or name its own: encoding = "cp1252"'
        ) from None
    decoded = memoryview(text.encode())
    _refuse_control(decoded)
    return decoded, [] if options.encoding else [f"the text is not UTF-8 and was read as {encoding}"]


def _unmarked(content: memoryview) -> str:
    """UTF-16 without a mark has a zero in every second byte."""
    head = bytes(content[:1000])
    if len(head) > 3 and head.count(0) > len(head) / 3:
        return "utf-16-le" if head[1::2].count(0) > head[::2].count(0) else "utf-16-be"
    return "utf-8"


def _refuse_control(content: memoryview) -> None:
    head = bytes(content[:BYTES_OF_HEAD])
    if len(head.translate(None, CONTROL)) < len(head):
        raise RecordingError("is not UTF-8 text, nor any other: it holds bytes of another kind of file; rename it")


def _first_lines(content: memoryview) -> list[str]:
    head = bytes(content[:BYTES_OF_HEAD])
    whole = head if len(content) <= len(head) else head[: head.rfind(b"\n") + 1] or head
    return whole.decode(errors="replace").replace("\r\n", "\n").replace("\r", "\n").split("\n")[:HEAD]


def _start(content: memoryview, line: int) -> int:
    """Where a line begins."""
    head, position = bytes(content[:BYTES_OF_HEAD]), 0
    for _ in range(line):
        ends = [end for end in (head.find(b"\n", position), head.find(b"\r", position)) if end >= 0]
        position = min(ends) + 1
        if head[position - 1 : position + 1] == b"\r\n":
            position += 1
    return position


def _without_tail(body: memoryview, layout: Layout) -> tuple[memoryview, list[str]]:
    """The rows without what at the end is none: a summary, a comment, a line that was cut."""
    tail = bytes(body[-BYTES_OF_HEAD // 4 :])
    stripped = tail.rstrip(b"\r\n \x1a\x00")
    ended = len(stripped) < len(tail)
    end = len(body) - len(tail) + len(stripped)
    lines = stripped.decode(errors="replace").replace("\r\n", "\n").replace("\r", "\n").split("\n")
    notes: list[str] = []
    if len(lines) > 2 and not ended and _is_cut(lines, layout):
        notes.append(f"the last line was cut by the recorder and is left out ({shortened(lines[-1])})")
        end -= len(lines.pop().encode()) + 1
    summary: list[str] = []
    while len(lines) > 2 and len(summary) < TAIL and _is_summary(lines[-1], layout):
        summary.insert(0, lines.pop())
    if summary:
        end = len(body) - len(tail) + _end_of_line(stripped, len(lines), len(lines) + len(summary))
        count = f"the last {len(summary)} lines are" if len(summary) > 1 else "the last line is"
        notes.append(f"{count} no row of numbers and left out ({shortened(next(filter(str.strip, summary), ''))})")
    return body[:end], notes


def _end_of_line(text: bytes, kept: int, total: int) -> int:
    """Where the lines that are kept end, of so many."""
    lines = text.splitlines(keepends=True)
    return sum(map(len, lines[: kept + len(lines) - total])) if len(lines) >= total else len(text)


def _is_cut(lines: Sequence[str], layout: Layout) -> bool:
    """Whether the last line, which has no end, has fewer fields or fewer digits than those before it."""
    last, before = (split(line, layout.separator) for line in (lines[-1], lines[-2]))
    if len(last) != len(before):
        return len(last) < len(before)
    if not is_value(last[-1], layout.decimal) and layout.numeric[layout.width - 1 :] == (True,):
        return True
    others = [split(line, layout.separator)[-1] for line in lines[-100:-1] if fits(line, layout)]
    places = {len(other.rpartition(layout.decimal)[2]) if layout.decimal in other else -1 for other in others}
    own = len(last[-1].rpartition(layout.decimal)[2]) if layout.decimal in last[-1] else -1
    # Numbers of a fixed number of decimals; others may well be shorter at the end.
    return len(others) > 1 and len(places) == 1 and own < places.pop()


def _is_summary(line: str, layout: Layout) -> bool:
    """Whether a line holds words where the rows hold numbers."""
    if not line.strip() or COMMENT.match(line):
        return True
    if fits(line, layout):
        return False
    fields = split(line, layout.separator)
    first = next(i for i, numeric in enumerate(layout.numeric) if numeric)
    lettered = len(fields) > first and fields[first][:1].isalpha() and not is_value(fields[first], layout.decimal)
    return lettered or (len(fields) <= first and line.strip()[:1].isalpha())


# --- columns ----------------------------------------------------------------------------------------------------------


def _with_numbers_for_names(lines: Sequence[str], layout: Layout, names: Sequence[str | int]) -> Layout:
    """A first line of 1, 2, 3 ... (or 0, 1, 2 ...) names columns, if these are asked for."""
    fields = split(lines[layout.first], layout.separator)[: layout.width]
    counted = [[str(k + start) for k in range(layout.width)] for start in (0, 1)]
    if layout.names is None and fields in counted and all(isinstance(name, str) and name in fields for name in names):
        from dataclasses import replace

        return replace(layout, names=tuple(fields), header=layout.first, first=layout.first + 1)
    return layout


def _column(name: str | int, layout: Layout) -> int:
    """The place of a column, from 0, by its name or its number."""
    if isinstance(name, int):
        if name > layout.width:
            raise RecordingError(f"column {name} is not there: the file has {layout.width} columns, counted from 1")
        return name - 1
    if layout.names is None:
        if name.isdecimal() and 1 <= int(name) <= layout.width:
            return int(name) - 1
        raise RecordingError(
            f"column {name!r} is not there: {layout.why_unnamed}; give columns by number, such as position = [2, 3]"
        )
    require(name, [one for one in layout.names if one])
    if layout.names.count(name) > 1:
        where = [str(i + 1) for i, one in enumerate(layout.names) if one == name]
        raise RecordingError(
            f"column {name!r} appears more than once in the header (columns {' and '.join(where)}); give each column "
            "its own name, or give its number"
        )
    return layout.names.index(name)


@dataclass
class _Table:
    """The rows of a file, of some of its columns."""

    body: memoryview
    layout: Layout
    wanted: Sequence[int]
    options: TextOptions
    values: dict[int, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        import pyarrow

        self.body, self.separator = _one_separator(self.body, self.layout)
        self.fields = self._fields()
        try:
            table = self._read(pyarrow.float64(), lambda row: "error")
            self.values = {i: table[str(i)].to_numpy() for i in self.wanted}
        except pyarrow.ArrowInvalid:
            self._read_carefully()

    def label(self, i: int) -> str:
        return self.layout.names[i] if self.layout.names else str(i + 1)

    def _fields(self) -> int:
        """Of a row as it is written, with the empty one behind a trailing separator."""
        head = bytes(self.body[:BYTES_OF_HEAD]).decode(errors="replace").splitlines()[: HEAD // 10]
        widths = [len(split(line, self.separator)) for line in head if line.strip()]
        return max(set(widths), key=widths.count, default=self.layout.width) if widths else self.layout.width

    def _read(self, kind: Any, on_bad_row: Any, threads: bool = True) -> Any:
        import pyarrow
        from pyarrow import csv as arrow

        return arrow.read_csv(
            pyarrow.BufferReader(pyarrow.py_buffer(self.body)),
            read_options=arrow.ReadOptions(
                column_names=[str(i) for i in range(max(self.fields, self.layout.width))], use_threads=threads
            ),
            parse_options=arrow.ParseOptions(delimiter=self.separator, invalid_row_handler=on_bad_row),
            convert_options=arrow.ConvertOptions(
                column_types={str(i): kind for i in self.wanted},
                include_columns=[str(i) for i in self.wanted],
                decimal_point=self.layout.decimal,
                strings_can_be_null=False,
            ),
        )

    def _read_carefully(self) -> None:
        """Row by row where something is no plain number: missing values, times of day, comments, bad rows."""
        import pyarrow

        bad, comments, short = [], [0], [0]

        def on_bad_row(row: Any) -> str:
            if COMMENT.match(row.text):
                comments[0] += 1
            elif row.text.strip(f" {self.separator}"):
                bad.append(
                    (row.number or 0, f"it has {row.actual_columns} fields, the others {self.layout.width}", row.text)
                )
            else:
                short[0] += 1
            return "skip"

        table = self._read(pyarrow.string(), on_bad_row, threads=False)
        texts = {i: _trimmed(table[str(i)]) for i in self.wanted}
        first = texts[self.wanted[0]]
        marked = [k for k, text in enumerate(first.to_pylist()) if COMMENT.match(text or "")] if self.wanted else []
        keep = np.ones(len(first), bool)
        keep[marked] = False
        comments[0] += len(marked)
        wrong: dict[int, tuple[int, str]] = {}
        for i in self.wanted:
            self.values[i], faults = self._numbers(i, texts[i])
            for k in faults[keep[faults]]:
                wrong.setdefault(int(k), (i, texts[i][int(k)].as_py()))
        self._judge(bad, wrong, keep)
        if comments[0]:
            self.notes.append(f"{_counted(comments[0], 'comment line')} among the rows left out")

    def _numbers(self, i: int, texts: Any) -> tuple[Any, Any]:
        """Numbers of one column, NaN where none were measured, and the places of what is neither."""
        import pyarrow.compute as pc

        missing = pc.is_in(pc.utf8_lower(texts), value_set=_tokens())
        if all(map(times.is_time, _some(texts, missing))):
            values, note = times.seconds_of(
                self.label(i),
                [None if gone else t for t, gone in zip(texts.to_pylist(), missing.to_pylist(), strict=True)],
            )
            self.notes += [note] if note else []
            return values, np.array([], int)
        plain = pc.replace_substring(texts, ",", ".") if self.layout.decimal == "," else texts
        proper = pc.match_substring_regex(plain, f"^(?i:{NUMBER.pattern})$")
        if self.layout.decimal == ",":
            proper = pc.and_(proper, pc.invert(pc.match_substring(texts, ".")))
        neither = np.flatnonzero(~pc.or_(missing, proper).to_numpy(zero_copy_only=False).astype(bool))
        usable = pc.if_else(proper, pc.replace_substring_regex(plain, r"^\+", ""), None)
        words = sorted({text for text in pc.unique(pc.filter(texts, missing)).to_pylist() if text})
        words = [word for word in words if word.lower() not in ("nan", "null", "na", "n/a", "#n/a")]
        if words:
            self.notes.append(f"{self.label(i)!r}: {', '.join(map(repr, words))} is taken as missing")
        return pc.cast(usable, "float64").to_numpy(zero_copy_only=False), neither

    def _judge(self, bad: list[tuple[int, str, str]], wrong: dict[int, tuple[int, str]], keep: Any) -> None:
        """Refuse rows that cannot be read, or leave them out if the mapping says so."""
        total = len(bad) + len(wrong)
        if total and self.options.bad_lines != "drop":
            raise RecordingError(self._first_bad(bad, wrong, total))
        keep[list(wrong)] = False
        if not keep.all():
            self.values = {i: values[keep] for i, values in self.values.items()}
        if total:
            self.notes.append(f"{_counted(total, 'bad line')} left out, as the mapping says")

    def _first_bad(self, bad: list[tuple[int, str, str]], wrong: dict[int, tuple[int, str]], total: int) -> str:
        what = "1 line of the file cannot be read" if total == 1 else f"{total} lines of the file cannot be read"
        remedy = 'repair or remove the row, or write bad_lines = "drop" into the mapping'
        first_bad = bad[0][0] if bad else 0
        if bad and (not wrong or first_bad <= min(wrong)):
            return f"{what}; the first is row {first_bad} ({bad[0][1]}: {shortened(bad[0][2])}): {remedy}"
        row = min(wrong)
        i, text = wrong[row]
        row += 1 + sum(number <= row for number, _, _ in bad)
        return f"{what}; column {self.label(i)!r}, row {row}: {text!r} is not a number: {remedy}"


def _counted(count: int, what: str) -> str:
    return f"{count} {what}s are" if count > 1 else f"1 {what} is"


def _trimmed(column: Any) -> Any:
    import pyarrow.compute as pc

    return pc.utf8_trim_whitespace(column.combine_chunks())


def _tokens() -> Any:
    import pyarrow

    return pyarrow.array(sorted(MISSING))


def _some(texts: Any, missing: Any) -> list[str]:
    """The first values of a column that are not missing."""
    import pyarrow.compute as pc

    found = pc.filter(texts.slice(0, HEAD), pc.invert(missing.slice(0, HEAD))).to_pylist()
    return found[:3] or ["none"]


def _one_separator(body: memoryview, layout: Layout) -> tuple[memoryview, str]:
    """Rows that any number of blanks separate, separated by one; others as they are."""
    if layout.separator != " ":
        return body, layout.separator
    lines = bytes(body).splitlines()
    return memoryview(b"\n".join(b"\t".join(line.split()) for line in lines) + b"\n"), "\t"


# --- counting ---------------------------------------------------------------------------------------------------------


def count(path: Path, names: Sequence[str | int]) -> int:
    """The number of lines, without those above the rows."""
    lines, last = 0, b"\n"
    opened = gzip.open if path.suffix.lower() == ".gz" else open
    with opened(path, "rb") as file:
        head = file.read(BYTES_OF_HEAD)
        file.seek(0)
        while block := file.read(1 << 20):
            lines, last = lines + block.count(b"\n"), block[-1:]
    content, _ = _decoded(memoryview(head), AS_SEEN)
    first = layout_of(_first_lines(content), AS_SEEN).first
    return max(0, lines - first + (last != b"\n"))


def shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """What the columns of a file are called: names, or numbers from 1 where it has no header."""
    return shapes_in_text(_bytes_of(path))


def shapes_in_text(raw: Any) -> dict[str, tuple[int, ...]]:
    """The same of a file's bytes."""
    content, _ = _decoded(raw, AS_SEEN)
    layout = layout_of(_first_lines(content), AS_SEEN)
    names = layout.names or tuple(map(str, range(1, layout.width + 1)))
    return dict.fromkeys(names, ())


def delimiter_of(header: str) -> str:
    """What separates the columns that a header names: comma, semicolon or tab."""
    return max(",;\t", key=header.count)


__all__ = ["count", "delimiter_of", "is_missing", "read", "read_text"]
