"""Lines of text: what are samples, what are none, and that a stranger cannot fill the memory."""

from __future__ import annotations

import json

import numpy as np
import pytest

from jaximp.live.lines import MOST_BYTES, Columns, LineReader, columns_of

DEGREES = columns_of(
    {
        "time": {"column": "t", "unit": "ms"},
        "position": {"column": "angle", "unit": "deg", "sign": -1},
        "torque": "tau",
        "gear_ratio": 2.0,
    }
)[0]


def read(data: bytes, columns: Columns | None = None) -> tuple[list[list[float]], int]:
    reader = LineReader(columns or Columns())
    found = [reader.take(data[k : k + 11]) for k in range(0, len(data), 11)] + [reader.finish()]
    return np.concatenate([np.column_stack(one) for one in found]).tolist(), reader.unreadable


@pytest.mark.parametrize(
    "data",
    [
        b"time,position,torque\n0.5,1,2\n0.6,3,4\n",
        b"0.5,1,2\n0.6,3,4",
        b"torque;time;position;more\r\n2;0.5;1;x\r\n4;0.6;3;x\r\n",
        b'{"time": 0.5, "position": 1, "torque": 2}\n{"torque": 4, "time": 0.6, "position": 3, "other": "x"}\n',
        b'{"time": [0.5, 0.6], "position": [1, 3], "torque": [2, 4]}\n',
    ],
    ids=["csv", "csv without a header", "semicolons", "json", "json of several samples"],
)
def test_samples_in_si_units(data: bytes) -> None:
    assert read(data) == ([[0.5, 1.0, 2.0], [0.6, 3.0, 4.0]], 0)


def test_columns_are_those_of_the_job() -> None:
    wanted = [[0.5, -np.pi / 4, 6.0]]
    for data in (b"t,angle,tau\n500,90,3\n", b'{"t": 500, "angle": 90, "tau": 3}\n'):
        found, unreadable = read(data, DEGREES)
        np.testing.assert_allclose(found, wanted)
        assert unreadable == 0
    # Their own names are in SI units.
    assert read(b'{"time": 0.5, "position": 1, "torque": 2}\n', DEGREES)[0] == [[0.5, 1.0, 2.0]]


def test_numbered_columns_of_the_job() -> None:
    numbered = columns_of({"time": 2, "position": 1, "torque": 4})[0]
    assert read(b"1,0.5,9,2\n", numbered) == ([[0.5, 1.0, 2.0]], 0)


def test_samples_without_a_time_are_counted_where_the_job_gives_a_rate() -> None:
    untimed = columns_of({"position": "q", "torque": "m", "sample_rate": 2})[0]
    wanted = [[0.0, 1.0, 2.0], [0.5, 3.0, 4.0]]
    for data in (
        b"q,m\n1,2\n3,4\n",
        b"1,2\n3,4\n",
        b'{"q": [1, 3], "m": [2, 4]}\n',
        b'{"q": 1, "m": 2}\n{"q": 3, "m": 4}\n',
    ):
        assert read(data, untimed) == (wanted, 0)
    assert read(b'{"time": 7, "position": 1, "torque": 2}\n', untimed)[0] == [[7.0, 1.0, 2.0]]
    reader = LineReader(Columns())
    assert len(reader.take(b'{"position": 1, "torque": 2}\n').time) == 0
    assert reader.unreadable == 1


def test_no_number_is_nan() -> None:
    found, unreadable = read(b'{"time": 0.5, "position": null, "torque": 2}\n')
    np.testing.assert_array_equal(found, [[0.5, np.nan, 2]])
    np.testing.assert_array_equal(
        read(b"time,position,torque\n0.5,,2\n0.6,nan,2\n")[0], [[0.5, np.nan, 2], [0.6, np.nan, 2]]
    )
    assert unreadable == 0


@pytest.mark.parametrize(
    "line",
    [
        b"hello", b"1,2", b"{", b"{}", b'{"time": 1, "position": "2", "torque": 3}',
        b'{"time": true, "position": 1, "torque": 3}',
        b'{"time": [1, 2], "position": [1], "torque": [3, 4]}', b"\xff\xfe\x00,1,2", b"[" * 9000, b'{"time": ' * 5000,
    ],
    ids=["words", "two numbers", "half", "empty", "text", "truth", "lengths", "bytes", "brackets", "nested"],
)  # fmt: skip
def test_what_is_no_sample_is_counted_and_nothing_breaks(line: bytes) -> None:
    found, unreadable = read(line + b"\n" + json.dumps({"time": 1, "position": 2, "torque": 3}).encode() + b"\n")
    assert found[-1] == [1.0, 2.0, 3.0]
    assert unreadable >= 1


def test_a_line_without_an_end_is_not_kept() -> None:
    reader = LineReader(Columns())
    for _ in range(100):
        assert len(reader.take(b"x" * 5000).time) == 0
        assert len(reader._rest) <= MOST_BYTES
    found = reader.take(b"\n1,2,3\n")
    np.testing.assert_array_equal(np.column_stack(found), [[1, 2, 3]])
    assert reader.unreadable >= 1


def test_what_monitor_does_not_do_is_said() -> None:
    with pytest.raises(ValueError, match="a delay is not taken out live"):
        columns_of({"time": "t", "position": "q", "torque": {"column": "tau", "delay": 0.01}})
    with pytest.raises(ValueError, match="maps 2 of position"):
        columns_of({"time": "t", "position": ["a", "b"], "torque": ["c", "d"]})
