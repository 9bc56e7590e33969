"""Text files as recorders, spreadsheets, LabVIEW, OpenSim, numpy and C programs write them: read to the last digit, or
refused in one line."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from factories.recordings import MAPPING, matches
from jaximp.recordings import load_recording
from jaximp.recordings.readers.formats import count_samples, read_columns
from jaximp.types import Recording

N = 40
t = np.arange(N) / 100
TABLE = np.round(np.column_stack([t, np.sin(6 * t), 20 * np.cos(6 * t)]), 5)
H = "t,q,tau\n"


def rows(separator: str = ",", form: str = "%.5f") -> str:
    return "".join(separator.join(form % x for x in row) + "\n" for row in TABLE)


def replaced(text: str) -> str:
    """The sixth row with something else in place of its position."""
    lines = rows().splitlines(keepends=True)
    lines[5] = f"{TABLE[5, 0]:.5f},{text},{TABLE[5, 2]:.5f}\n"
    return H + "".join(lines)


def clocked(before: str) -> str:
    return H + "".join(f"{before}{row}\n" for row in rows().splitlines())


OBVIOUS: dict[str, str | bytes] = {
    "comma": H + rows(),
    "semicolon": "t;q;tau\n" + rows(";"),
    "tab": "t\tq\ttau\n" + rows("\t"),
    "windows line ends": (H + rows()).replace("\n", "\r\n"),
    "old mac line ends": (H + rows()).replace("\n", "\r"),
    "byte order mark": (H + rows()).encode("utf-8-sig"),
    "quoted names": '"t","q","tau"\n' + rows(),
    "comma after every row": H + rows().replace("\n", ",\n"),
    "comma after the header": "t,q,tau,\n" + rows(),
    "comma after all lines": "t,q,tau,\n" + rows().replace("\n", ",\n"),
    "an empty column at the end": "t,q,tau,remarks\n" + rows().replace("\n", ",\n"),
    "no line break at the end": H + rows().rstrip("\n"),
    "a column of words": "t,q,tau,phase\n" + rows().replace("\n", ",at rest\n"),
    "an empty line above": "\n\n" + H + rows(),
    "plus signs": H + rows(form="%+.5f"),
    "exponents": H + rows(form="%.10E"),
}
NOTED: dict[str, tuple[str | bytes, str]] = {
    "comment lines": ("# started 12:00\n# kt = 0.11\n" + H + rows(), "2 lines above the numbers were left out"),
    "header behind #": ("# t,q,tau\n" + rows(), "line 1 names the columns"),
    "header behind %": ("% t\tq\ttau\n" + rows("\t"), "line 1 names the columns"),
    "title row": ("Trial 3,,\n" + H + rows(), "1 line above the numbers was left out (line 1: 'Trial 3,,')"),
    "header block": (
        "ID\nversion=1\nnRows=40\ninDegrees=no\nendheader\nt\tq\ttau\n" + rows("\t"),
        "5 lines above the numbers were left out",
    ),
    "units row": (H + "s,rad,Nm\n" + rows(), "a row of units stands below the names (s, rad, Nm)"),
    "bracketed units row": (H + "[s],[rad],[Nm]\n" + rows(), "a row of units stands below the names (s, rad, Nm)"),
    "whitespace": ("t q tau\n" + rows(" "), "the columns are separated by blanks"),
    "aligned columns": ("      t       q     tau\n" + rows(" ", "%9.5f"), "the columns are separated by blanks"),
    "header with commas": (H + rows(" "), "the columns are separated by blanks"),
    "pipe": ("t|q|tau\n" + rows("|"), "the columns are separated by '|'"),
    "spaced pipe": ("t | q | tau\n" + rows(" | "), "the columns are separated by '|'"),
    "decimal comma": ("t;q;tau\n" + rows(";").replace(".", ","), "the numbers have a decimal comma"),
    "decimal comma and tabs": ("t\tq\ttau\n" + rows("\t").replace(".", ","), "the numbers have a decimal comma"),
    "excel's separator line": ("sep=;\nt;q;tau\n" + rows(";"), "1 line above the numbers was left out"),
    "summary row": (H + rows() + "Max,1,20\n", "the last line is no row of numbers and left out ('Max,1,20')"),
    "summary rows": (H + rows() + "\nMean,0.1,3\nStd,1,20\n", "the last 3 lines are no row of numbers"),
    "comment at the end": (H + rows() + "# stopped\n", "the last line is no row of numbers"),
    "comments between": (replaced("0.1").replace("0.10000,", "# paused\n0.10000,"), "1 comment line is among the rows"),
    "utf-16": (("t\tq\ttau\n" + rows("\t")).encode("utf-16"), "the text is not UTF-8 and was read as utf-16-le"),
    "utf-16 without a mark": ((H + rows()).encode("utf-16-be"), "was read as utf-16-be"),
    "cp1252": (
        ("t,q,tau,T [°C]\n" + rows().replace("\n", ",1\n")).encode("cp1252"),
        "the text is not UTF-8 and was read as cp1252",
    ),
    "time of day": (clocked("12:00:0"), "'t' holds times of day: seconds are counted from 12:00:00.00000"),
    "ISO 8601": (clocked("2024-03-01T12:00:0"), "seconds are counted from 2024-03-01T12:00:00.00000"),
    "date and time": (clocked("01.03.2024 12:00:0"), "seconds are counted from 01.03.2024 12:00:00.00000"),
}


def loaded(path: Path, text: str | bytes, **mapping: Any) -> Recording:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_recording(path, **(MAPPING | mapping))


def assert_table(recording: Recording, table: np.ndarray = TABLE, at: Any = slice(None)) -> None:
    np.testing.assert_allclose(recording.time, table[:, 0], atol=1e-12)
    np.testing.assert_array_equal(recording.position[at, 0], table[at, 1])
    np.testing.assert_array_equal(recording.torque[at, 0], table[at, 2])


@pytest.mark.parametrize("name", OBVIOUS)
def test_what_is_obvious_is_read_without_a_note(tmp_path: Path, name: str) -> None:
    recording = loaded(tmp_path / "a.csv", OBVIOUS[name])
    assert_table(recording)
    assert recording.notes == ()


@pytest.mark.parametrize("name", NOTED)
def test_what_was_decided_is_noted(tmp_path: Path, name: str) -> None:
    text, note = NOTED[name]
    recording = loaded(tmp_path / "a.csv", text)
    assert_table(recording, at=np.arange(N) != 5 if name == "comments between" else slice(None))
    assert any(note in one for one in recording.notes), recording.notes


@pytest.mark.parametrize("text", ["", " ", "NaN", "None", "--", "#DIV/0!", "N/A", "-1.#IND"])
def test_what_is_missing_is_masked(tmp_path: Path, text: str) -> None:
    recording = loaded(tmp_path / "a.csv", replaced(text))
    assert_table(recording, at=np.arange(N) != 5)
    assert np.flatnonzero(~recording.valid).tolist() == [5]
    assert "1 of 40 samples are masked because of NaN in 'q' (1)" in recording.notes
    if text in ("None", "--", "#DIV/0!"):
        assert f"'q': {text!r} is taken as missing" in recording.notes


def test_without_a_header_columns_have_numbers(tmp_path: Path) -> None:
    for numbers in ({"time": 1, "position": 2, "torque": 3}, {"time": "1", "position": "2", "torque": "3"}):
        assert_table(loaded(tmp_path / "a.csv", rows(), **numbers))


def test_a_row_that_was_cut_is_left_out(tmp_path: Path) -> None:
    for cut in (3, 9, 18):
        recording = loaded(tmp_path / "a.csv", (H + rows())[:-cut])
        assert_table(recording, TABLE[:-1])
        assert any("the last line was cut by the recorder and is left out" in note for note in recording.notes)


def test_times_of_day_pass_midnight(tmp_path: Path) -> None:
    lines = rows().splitlines()
    stamps = [f"23:59:59.{80 + k}" if k < 20 else f"00:00:00.{k - 20:02d}" for k in range(N)]
    text = H + "\n".join(stamp + line[line.index(",") :] for stamp, line in zip(stamps, lines, strict=True)) + "\n"
    recording = loaded(tmp_path / "a.csv", text)
    assert_table(recording)
    assert any("past midnight 1 times" in note for note in recording.notes)


def test_a_packed_file_is_read(tmp_path: Path) -> None:
    with gzip.open(tmp_path / "a.csv.gz", "wt") as file:
        file.write(H + rows())
    recording = load_recording(tmp_path / "a.csv.gz", **MAPPING)
    assert_table(recording)
    assert recording.name == "a"
    assert count_samples(tmp_path / "a.csv.gz", ["t"]) == N


def test_rows_are_counted_without_the_lines_above(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("Trial 3,,\n" + H + "s,rad,Nm\n" + rows())
    assert count_samples(tmp_path / "a.csv", ["t"]) == N


# --- what is refused --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (rows(), "the first line holds numbers and no names; give columns by number"),
        ("a note\n" + rows(), "no line above the numbers names 3 columns (write header = 3"),
        (H + rows().replace("0.05000,", "0.05000;", 1), "1 line of the file cannot be read; the first is row 6"),
        (replaced("abc").replace("0.09000,", "x,"), "2 lines of the file cannot be read; column 'q', row 6: 'abc'"),
        ("t;q;tau\n" + "1,234;5,678;9,012\n2,345;5,432;8,123\n" * 3, 'decimal = ","'),
        ("t,q,q,tau\n" + "0,1,2,3\n1,2,3,4\n2,1,3,1\n", "'q' appears more than once in the header (columns 2 and 3)"),
        ("t,q\n" + rows().replace(".", ","), "no line above the numbers names 6 columns"),
        ("nothing but words\nand more\n", "has 0 samples"),
    ],
    ids=["no header", "no names", "bad separator", "two bad", "thousands", "twice", "commas of two kinds", "prose"],
)
def test_what_cannot_be_told_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=matches(message)):
        loaded(tmp_path / "a.csv", text)


def test_the_mapping_decides(tmp_path: Path) -> None:
    thousands = "t;q;tau\n1,000;5,678;9,012\n2,000;5,432;8,123\n3,000;5,132;8,523\n"
    assert loaded(tmp_path / "a.csv", thousands, decimal=",").position[0, 0] == 5.678
    two = "a,b,c\n" + H + rows()
    np.testing.assert_array_equal(
        loaded(tmp_path / "a.csv", two, header=1, time="a", position="b", torque="c").torque[:, 0], TABLE[:, 2]
    )
    assert_table(loaded(tmp_path / "a.csv", H + rows(), header=0, time=1, position=2, torque=3))
    assert_table(loaded(tmp_path / "a.csv", "t q tau\n" + rows(" "), separator="whitespace"))
    dropped = loaded(tmp_path / "a.csv", replaced("abc"), bad_lines="drop")
    assert "1 bad line is left out, as the mapping says" in dropped.notes
    assert np.flatnonzero(~dropped.valid).tolist() == [5]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("key", "value"),
    [("decimal", "x"), ("header", "3"), ("separator", "ab"), ("encoding", "utf-99"), ("bad_lines", "keep")],
)
def test_a_key_that_decides_nothing_is_refused(tmp_path: Path, key: str, value: Any) -> None:
    with pytest.raises(ValueError, match=matches(key)):
        loaded(tmp_path / "a.csv", H + rows(), **{key: value})


# --- never another number ---------------------------------------------------------------------------------------------


@st.composite
def files(draw: st.DrawFn) -> tuple[np.ndarray, bytes]:
    """A table, and how some recorder might write it."""
    count = draw(st.integers(4, 12))
    number = st.floats(-1e6, 1e6, allow_nan=False).map(lambda x: x + 0.0) | st.integers(-5000, 5000).map(float)
    values = np.array(draw(st.lists(st.tuples(number, number), min_size=count, max_size=count)))
    table = np.column_stack([np.arange(count) * 0.5, values])
    separator = draw(st.sampled_from([",", ";", "\t", " ", "   ", "|"]))
    form = draw(st.sampled_from([repr, "{:.17g}".format, "{:.3f}".format, "{:+.4e}".format, "{:.0f}".format]))
    written = [[form(float(x)) for x in row] for row in table]
    table = np.array([[float(x) for x in row] for row in written])
    comma = separator != "," and draw(st.booleans())
    lines = [separator.join(row).replace(".", "," if comma else ".") for row in written]
    head = draw(st.sampled_from(["", "# ", "% "])) + (separator if separator != "   " else " ").join(["t", "q", "tau"])
    above = draw(st.lists(st.sampled_from(["# made by hand", "Trial 3", "rate = 100 Hz", ""]), max_size=3))
    below = draw(st.sampled_from([[], ["Max" + separator + "1" + separator + "2"], ["# end"]]))
    text = draw(st.sampled_from(["\n", "\r\n"])).join(
        [*above, head, *lines, *below, *draw(st.sampled_from([[""], []]))]
    )
    return table, text.encode(draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16"])))


@given(files())
@settings(max_examples=120, deadline=None, derandomize=True)
def test_a_number_is_read_as_it_is_written_or_not_at_all(
    tmp_path_factory: pytest.TempPathFactory, made: tuple[np.ndarray, bytes]
) -> None:
    table, content = made
    assume((np.diff(table[:, 0]) > 0).all())
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_bytes(content)
    thousands = False
    try:
        found = read_columns(path, ["t", "q", "tau"])
    except ValueError as error:
        thousands = "in the thousands?" in str(error) and "\n" not in str(error)
        if not thousands:
            raise
    if thousands:
        return
    columns = np.column_stack([found.values[name] for name in ("t", "q", "tau")])
    kept = len(columns)
    assert kept == len(table) or (kept == len(table) - 1 and any("was cut" in note for note in found.notes))
    np.testing.assert_array_equal(columns, table[:kept])
