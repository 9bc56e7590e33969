"""What a text file of numbers is like: its separator, its decimal mark, its header, its units, where its rows begin and
end.

Nothing is guessed silently: what is not obvious is said in `Layout.notes`, and what could be read in two ways is
refused with the key that decides it.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers.found import TextOptions

HEAD = 1000
"""Lines from which a file is judged; the rows of numbers begin within them."""
TAIL = 10
"""Lines at the end that may hold no samples: a summary, or a row that was cut."""
SEPARATORS = {"\t": "tabs", ";": "semicolons", ",": "commas", "|": "'|'", " ": "blanks"}
"""In the order in which they are believed, and their names."""
SPELLED = {"tab": "\t", "comma": ",", "semicolon": ";", "pipe": "|", "whitespace": " ", "blank": " ", "space": " "}
MISSING = frozenset(
    [
        *("", "nan", "-nan", "+nan", "na", "n/a", "<na>", "null", "none", "nil", "missing", "-", "--", "---", "?", "."),
        *("#n/a", "#na", "#div/0!", "#value!", "#num!", "#ref!", "#name?", "#null!", "#nv", "#wert!", "#zahl!"),
        *("1.#qnan", "-1.#qnan", "1.#ind", "-1.#ind", "1.#ind00", "-1.#ind00", "nan(ind)", "-nan(ind)", "1.#nan"),
    ]
)
"""What stands where nothing was measured, in small letters."""
NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?|[+-]?inf(inity)?", re.IGNORECASE)
CLOCK = re.compile(r"(\S+[ T])?\d{1,2}:\d{2}(:\d{1,2})?([.,]\d+)?( ?(Z|[+-]\d{2}:?\d{2}|[AaPp]\.?[Mm]\.?))?")
"""A time of day, perhaps behind a date."""
COMMENT = re.compile(r"\s*(#+|%+|//+|!+)")
UNIT = re.compile(
    r"[\[({]?\s*(1|-|%|°|deg(rees?)?|rad(ians?)?|mrad|rev|turns?|counts?|ticks?|s|sec(onds?)?|m?sec|[mµμu]s|min|Hz|kHz|rpm|"
    r"[mck]?N\s?[·.*]?\s?[mc]?m|[mk]?N|[mcµμu]?m|m?V|m?A|g|k?g|a\.?u\.?|bool|#|"
    r"(°|deg|rad|m|mm|cm|rev)/s(\^?2|²)?)\s*[\])}]?",
)
"""What a row of units may hold."""


@dataclass(frozen=True)
class Layout:
    """How a text file is laid out."""

    separator: str
    decimal: str
    width: int
    """Fields of a row."""
    numeric: tuple[bool, ...]
    """(width,) the columns that hold numbers."""
    first: int
    """The line of the first row, from 0."""
    trailing: bool = False
    """Whether a separator, or an empty column, stands behind the last field of a row."""
    names: tuple[str, ...] | None = None
    """(width,) of the columns; None where no line names them."""
    header: int = -1
    """The line that names the columns, from 0; below 0 if there is none."""
    units: tuple[str, ...] | None = None
    """(width,) from a row of units."""
    why_unnamed: str = "the first line holds numbers and no names"
    notes: tuple[str, ...] = ()


def split(line: str, separator: str) -> list[str]:
    """The fields of a line, without the blanks around them."""
    if separator == " ":
        return line.split()
    try:
        fields = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [""])
    except csv.Error:
        fields = line.split(separator)
    return [field.strip() for field in fields]


def is_number(field: str, decimal: str = ".") -> bool:
    if decimal == ",":
        if "." in field:
            return False
        field = field.replace(",", ".")
    return NUMBER.fullmatch(field) is not None


def is_missing(field: str) -> bool:
    return field.lower() in MISSING


def is_value(field: str, decimal: str = ".") -> bool:
    """Whether it is what a column of numbers may hold."""
    return is_number(field, decimal) or is_missing(field) or CLOCK.fullmatch(field) is not None


def layout_of(lines: Sequence[str], options: TextOptions) -> Layout:
    """How a file is laid out, by its first lines (at most `HEAD`)."""
    best: tuple[float, Layout] | None = None
    for separator in _separators(options):
        for decimal in [options.decimal] if options.decimal else [".", ","]:
            judged = _judged(lines, separator, decimal)
            if judged and (best is None or judged[0] > best[0] + 1e-9):
                best = judged
    if best is None:
        raise RecordingError(
            "has 0 samples; at least 3 are needed: no rows of numbers are seen in its first lines (the keys separator, "
            "decimal and encoding of the mapping say how it is to be read)"
        )
    found = best[1]
    if not options.decimal:
        _refuse_thousands(lines, found)
    return _with_names(lines, found, options)


def _separators(options: TextOptions) -> list[str]:
    if options.separator is None:
        return list(SEPARATORS)
    separator = SPELLED.get(options.separator.lower(), options.separator)
    if len(separator) != 1:
        raise RecordingError(f"separator must be one character, or one of {', '.join(SPELLED)}, not {separator!r}")
    return [separator]


def _judged(lines: Sequence[str], separator: str, decimal: str) -> tuple[float, Layout] | None:
    """How much of a file makes sense in this way, and its layout."""
    rows = [split(line, separator) if line.strip() else [] for line in lines]
    counts: dict[int, int] = {}
    for row in rows:
        if any(is_number(field, decimal) or CLOCK.fullmatch(field) for field in row):
            width = _width(row)
            counts[width] = counts.get(width, 0) + 1
    if not counts:
        return None
    width = max(counts, key=lambda one: (counts[one], one))
    alike = [row for row in rows if _width(row) == width]
    alike = alike[len(alike) // 2 :]  # lines above the numbers do not count
    share = [_numeric_share([row[i] for row in alike], decimal) for i in range(width)]
    numeric = tuple(one is not None and one >= 0.5 for one in share)
    known = [one for one in share if one is not None]
    first = next((k for k in range(len(rows)) if _fits(rows[k], width, numeric, decimal)), None)
    if first is None or not known:
        return None
    # A wrong separator or decimal mark leaves pieces of numbers among few that are whole.
    return sum(known) / len(known), Layout(separator, decimal, width, numeric, first, len(rows[first]) > width)


def _width(row: Sequence[str]) -> int:
    """Fields of a row, without the empty one behind a trailing separator."""
    return len(row) - (len(row) > 1 and not row[-1])


def _numeric_share(fields: Sequence[str], decimal: str) -> float | None:
    """Of those that are not missing; None if all are."""
    filled = [field for field in fields if not is_missing(field)]
    if not filled:
        return None
    return sum(is_value(field, decimal) for field in filled) / len(filled)


def _fits(row: Sequence[str], width: int, numeric: Sequence[bool], decimal: str) -> bool:
    """Whether a line can be a row of the table."""
    if _width(row) != width:
        return False
    fields = [field for field, wanted in zip(row, numeric, strict=False) if wanted]
    return all(is_value(field, decimal) for field in fields) and not all(map(is_missing, fields))


def fits(line: str, layout: Layout) -> bool:
    """Whether a line can be a row of the table."""
    return _fits(split(line, layout.separator), layout.width, layout.numeric, layout.decimal)


def _refuse_thousands(lines: Sequence[str], layout: Layout) -> None:
    """`1,234` may be a thousand or one and a bit: only numbers that cannot be thousands decide."""
    if layout.decimal != ",":
        return
    rows = (split(line, layout.separator) for line in lines[layout.first :])
    marked = [field for row in rows for field in row if "," in field and is_number(field, ",")]
    if marked and all(re.fullmatch(r"[+-]?[1-9]\d{0,2},\d{3}", field) for field in marked):
        raise RecordingError(
            f"line {layout.first + 1}: is {marked[0]!r} a number with a decimal comma, or in the thousands? Write "
            'decimal = "," into the mapping, or take the thousands separators out of the file'
        )


# --- names ------------------------------------------------------------------------------------------------------------


def _with_names(lines: Sequence[str], layout: Layout, options: TextOptions) -> Layout:
    """The names above the rows, the units between, and notes on all that is not obvious."""
    above = [k for k in range(layout.first) if lines[k].strip()]
    units, taken = None, set()
    if options.header is not None:
        header, names, layout = _stated_header(lines, layout, options.header)
        above = [k for k in above if k <= header]
    else:
        header, names, units = _header_above(lines, layout, above)
    if header >= 0:
        taken.add(header)
        below = [k for k in range(header + 1, layout.first) if lines[k].strip()]
        units = units or next(filter(None, (_units(lines[k], layout) for k in below)), None)
    left_out = [k for k in range(layout.first) if lines[k].strip() and k not in taken]
    why = layout.why_unnamed
    if names is None and above:
        why = f"no line above the numbers names {layout.width} columns"
        why += " (write header = 3, say, into the mapping if line 3 does, or header = 0)"
    return replace(
        layout,
        names=names,
        header=header,
        units=units,
        why_unnamed=why,
        notes=tuple(_in_words(lines, layout, header, units, left_out)),
    )


def _stated_header(lines: Sequence[str], layout: Layout, stated: int) -> tuple[int, tuple[str, ...] | None, Layout]:
    if stated == 0:
        return -1, None, layout
    if not 1 <= stated <= len(lines):
        raise RecordingError(f"header = {stated}: the line is not there, or beyond the first {HEAD}")
    names = names_in(lines[stated - 1], layout)
    if names is None:
        count = len(split(lines[stated - 1], layout.separator))
        raise RecordingError(f"header = {stated}: that line has {count} names, and the rows have {layout.width} fields")
    return stated - 1, names, replace(layout, first=max(layout.first, stated))


def _header_above(
    lines: Sequence[str], layout: Layout, above: Sequence[int]
) -> tuple[int, tuple[str, ...] | None, tuple[str, ...] | None]:
    """The line nearest above the rows that names as many columns, where it is no row of units."""
    units = None
    for k in reversed(above):
        names = names_in(lines[k], layout)
        if names is None:
            continue
        found = _units(lines[k], layout)
        if units is None and found is not None and _named_above(lines, layout, above, k):
            units = found
            continue
        return k, names, units
    return -1, None, None


def _named_above(lines: Sequence[str], layout: Layout, above: Sequence[int], k: int) -> bool:
    """Whether a line names columns, so that one below it may be a row of units."""
    return any(j < k and names_in(lines[j], layout) is not None for j in above)


def names_in(line: str, layout: Layout) -> tuple[str, ...] | None:
    """The names in a line: as many as a row has fields, whatever separates them and whatever marks a comment."""
    bare = COMMENT.sub("", line, count=1)
    for text in dict.fromkeys([line, bare] if not COMMENT.match(line) else [bare, line]):
        for separator in dict.fromkeys([layout.separator, *SEPARATORS]):
            if separator == " " and layout.separator not in " \t":
                continue  # the blanks of a sentence
            fields = _names(text, separator)
            # LabVIEW names a comment behind the last column, which the rows do not have.
            spare = fields and (layout.trailing or fields[-1] in ("", "Comment"))
            for names in [fields, fields[:-1] if spare else None, [*fields, ""]]:
                if names is None or len(names) != layout.width or (names == [*fields, ""] and any(layout.numeric[-1:])):
                    continue
                if _plausible(names, layout):
                    return tuple(names)
    return None


def _names(text: str, separator: str) -> list[str]:
    if separator == " " and re.search(r"\S {2,}\S", text.strip()):
        wide = [field.strip() for field in re.split(r" {2,}|\t", text.strip())]
        if len(wide) > 1:
            return wide if any(" " in field for field in wide) else text.split()
    return split(text.strip() if separator == " " else text.strip("\r\n "), separator)


def _plausible(names: Sequence[str], layout: Layout) -> bool:
    """Names are text, above columns of numbers at least; a title beside empty fields names nothing."""
    filled = [name for name, numeric in zip(names, layout.numeric, strict=True) if numeric]
    named = [name for name in filled if name and not is_value(name, layout.decimal)]
    return len(named) > 0 and 2 * len(named) > len(filled) and len(named) > len(filled) - 3


def _units(line: str, layout: Layout) -> tuple[str, ...] | None:
    names = names_in(line, layout)
    if names is None or not all(UNIT.fullmatch(name) for name in names if name) or not any(names):
        return None
    return tuple(re.sub(r"^[\[({]\s*|\s*[\])}]$", "", name) for name in names)


def _in_words(
    lines: Sequence[str], layout: Layout, header: int, units: Sequence[str] | None, left_out: Sequence[int]
) -> list[str]:
    """What was decided, as far as it is not obvious."""
    notes = []
    rest = [k for k in left_out if units is None or _units(lines[k], layout) is None]
    if rest:
        count = f"{len(rest)} lines above the numbers were" if len(rest) > 1 else "1 line above the numbers was"
        notes.append(f"{count} left out (line {rest[0] + 1}: {shortened(lines[rest[0]])})")
    if header >= 0 and (rest or COMMENT.match(lines[header])):
        notes.append(f"line {header + 1} names the columns")
    if units is not None:
        notes.append(f"a row of units stands below the names ({', '.join(units)})")
    if layout.separator in "| ":
        notes.append(f"the columns are separated by {SEPARATORS[layout.separator]}")
    if layout.decimal == ",":
        notes.append("the numbers have a decimal comma")
    return notes


def shortened(line: str) -> str:
    text = " ".join(line.split())
    return repr(text if len(text) <= 40 else text[:37] + "...")
