"""Files without a header, parts of files, gains of drives, and several recordings as one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factories.recordings import matches
from jaximp.recordings import load_recording
from jaximp.recordings.join import join_recordings
from jaximp.recordings.load import recordings_from_mapping
from jaximp.types import Recording

COLUMNS: dict[str, Any] = {"time": 1, "position": [2, 3], "torque": {"columns": [4, 5], "gain": [10.0, 2.5]}}
rng = np.random.default_rng(1)
TABLE = np.column_stack([0.01 * np.arange(60), rng.normal(size=(60, 4)).cumsum(axis=0)])


def written(path: Path, delimiter: str = ",", header: str = "", table: np.ndarray = TABLE) -> Path:
    np.savetxt(path, table, delimiter=delimiter, header=header, comments="", fmt="%.17g")
    return path


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_columns_by_number_need_no_header(tmp_path: Path, delimiter: str) -> None:
    found = load_recording(written(tmp_path / "a.csv", delimiter), **COLUMNS)
    np.testing.assert_array_equal(found.position, TABLE[:, 1:3])
    np.testing.assert_allclose(found.torque, TABLE[:, 3:] * [10.0, 2.5], rtol=1e-15)


def test_columns_by_number_below_a_header(tmp_path: Path) -> None:
    found = load_recording(written(tmp_path / "a.csv", header="t,q1,q2,i1,i2"), **COLUMNS)
    np.testing.assert_array_equal(found.position, TABLE[:, 1:3])


def test_a_header_of_numbers_is_still_a_header(tmp_path: Path) -> None:
    found = load_recording(written(tmp_path / "a.csv", header="1,2,3,4,5"), time="1", position="2", torque="4")
    np.testing.assert_array_equal(found.position[:, 0], TABLE[:, 1])


def test_rows_count_from_one_and_hold_both_ends(tmp_path: Path) -> None:
    for header in ("", "t,q1,q2,i1,i2"):
        found = load_recording(written(tmp_path / "a.csv", header=header), **COLUMNS, rows=[11, 50])
        np.testing.assert_array_equal(found.position, TABLE[10:50, 1:3])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position": "q"}, "column 'q' is not there: the first line holds numbers and no names"),
        ({"position": [2, 9]}, "column 9 is not there: the file has 5 columns"),
        ({"position": {"column": 2, "columns": [2, 3]}}, "names no column"),
        ({"position": [2, 0]}, "names no column"),
        ({"torque": {"columns": [4, 5], "gain": [1, 2, 3]}}, "gain lists 3 numbers for 2 columns"),
        ({"torque": {"columns": [4, 5], "gain": ["1 N m/A", "2 N m/V"]}}, "different units"),
        ({"torque": {"columns": [4, 5], "gain_error": -1}}, "gain_error is -1: give per cent"),
        ({"torque": {"columns": [4, 5], "gain_error": {"comon": 1}}}, "did you mean 'common'?"),
        ({"rows": [0, 10]}, "the first must be 1 or more"),
        ({"rows": [10, 61]}, "the file has 60 rows"),
        ({"rows": [10]}, "rows must be the first and the last row"),
    ],
)
def test_one_line_for_what_does_not_fit(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=matches(message)):
        load_recording(written(tmp_path / "a.csv"), **{**COLUMNS, **change})


def test_a_broken_row_without_header_is_named(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv")
    lines = path.read_text().splitlines()
    lines[6] = lines[6].rsplit(",", 1)[0]
    path.write_text("\n".join(lines))
    with pytest.raises(ValueError, match=matches("the first is row 7 (it has 4 fields, the others 5")):
        load_recording(path, **COLUMNS)


def test_gain_errors_have_a_common_part(tmp_path: Path) -> None:
    torque = {**COLUMNS["torque"], "gain_error": {"common": 10, "each": [3, 4]}}
    found = load_recording(written(tmp_path / "a.csv"), **{**COLUMNS, "torque": torque}).gain_covariance
    np.testing.assert_allclose(found, [[0.1**2 + 0.03**2, 0.1**2], [0.1**2, 0.1**2 + 0.04**2]], rtol=1e-12)


def joined(folder: Path, gap: int = 7) -> Recording:
    written(folder / "a.csv")
    written(folder / "b.csv", table=TABLE[:40] + np.array([5.0, 0, 0, 0, 0]))
    table = {"file": ["a.csv", "b.csv"], "rows": [[1, 60], [11, 40]], **COLUMNS}
    return join_recordings(recordings_from_mapping(table, folder), gap)


def test_recordings_are_joined_with_a_gap_that_counts_for_nothing(tmp_path: Path) -> None:
    whole = joined(tmp_path)
    assert len(whole) == 60 + 7 + 30
    np.testing.assert_array_equal(whole.valid, np.r_[np.ones(60, bool), np.zeros(7, bool), np.ones(30, bool)])
    np.testing.assert_array_equal(whole.position[67:], TABLE[10:40, 1:3])
    assert np.isnan(whole.torque[60:67]).all()
    np.testing.assert_allclose(np.diff(whole.time), 0.01, rtol=1e-9)


def test_recordings_of_other_rates_are_not_joined(tmp_path: Path) -> None:
    written(tmp_path / "a.csv")
    written(tmp_path / "b.csv", table=TABLE * [2.0, 1, 1, 1, 1])
    both = recordings_from_mapping({"file": ["a.csv", "b.csv"], **COLUMNS}, tmp_path)
    with pytest.raises(ValueError, match="100 Hz and b at 50 Hz: resample one of them"):
        join_recordings(both, 5)
