"""Files that were cut, overwritten or that claim more than they hold: one line, or the numbers that were recorded."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factories.recordings import MAPPING, matches, signals
from jaximp.recordings import load_recording
from jaximp.recordings.readers.contents import columns_in
from jaximp.recordings.readers.formats import count_samples

COLUMNS = signals(50)


def mat(path: Path) -> None:
    from scipy.io import savemat

    savemat(path, COLUMNS)


def feather(path: Path) -> None:
    import pyarrow
    from pyarrow.feather import write_feather

    write_feather(pyarrow.table(COLUMNS), path)


def npz(path: Path) -> None:
    np.savez(path, **COLUMNS)


def c3d(path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d", reason="needs ezc3d, of the extra 'formats'")
    file = ezc3d.c3d()
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    file["parameters"]["ANALOG"]["RATE"]["value"] = [100.0]
    file["parameters"]["ANALOG"]["LABELS"]["value"] = list(COLUMNS)
    file["parameters"]["ANALOG"]["UNITS"]["value"] = ["s", "rad", "Nm"]
    file["data"]["points"] = np.zeros((4, 0, 50))
    file["data"]["analogs"] = np.stack(list(COLUMNS.values()))[None]
    file.write(str(path))


WRITERS: dict[str, Callable[[Path], None]] = {"mat": mat, "feather": feather, "npz": npz, "c3d": c3d}


@pytest.fixture(scope="module", params=WRITERS)
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / f"a.{request.param}"
    WRITERS[request.param](path)
    assert len(load_recording(path, **MAPPING).time) == 50
    return path


def attempts(path: Path) -> list[str]:
    """What is said of a file by whoever looks into it."""
    said = []
    uses: list[Callable[[], Any]] = [lambda: columns_in(path), lambda: count_samples(path, list(MAPPING.values()))]
    for use in [*uses, lambda: load_recording(path, **MAPPING)]:
        try:
            use()
        except ValueError as error:
            said.append(str(error))
    return said


@given(place=st.floats(0, 1, exclude_max=True), new=st.binary(min_size=1, max_size=8))
@settings(max_examples=40, deadline=None, derandomize=True)
def test_bytes_that_changed_give_numbers_or_one_line(whole: Path, place: float, new: bytes) -> None:
    content = bytearray(whole.read_bytes())
    at = int(place * len(content))
    content[at : at + len(new)] = new
    damaged = whole.parent / f"damaged{whole.suffix}"
    damaged.write_bytes(content)
    for line in attempts(damaged):
        assert "\n" not in line
        assert len(line) < 600


@given(kept=st.floats(0, 1, exclude_max=True))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_a_file_that_was_cut_gives_all_numbers_or_none(whole: Path, kept: float) -> None:
    content = whole.read_bytes()
    cut = whole.parent / f"cut{whole.suffix}"
    cut.write_bytes(content[: int(kept * len(content))])
    with suppress(ValueError):
        recording = load_recording(cut, **MAPPING)
        np.testing.assert_allclose(recording.position[:, 0], COLUMNS["q"], atol=1e-6)


def test_sizes_that_would_end_python_are_refused(tmp_path: Path) -> None:
    mat(tmp_path / "a.mat")
    content = bytearray((tmp_path / "a.mat").read_bytes())
    assert content[176] == 9  # the kind of numbers of the first variable
    content[177] = 0x40
    (tmp_path / "a.mat").write_bytes(content)
    with pytest.raises(ValueError, match=matches("it holds an element of no known kind")):
        load_recording(tmp_path / "a.mat", **MAPPING)


@pytest.mark.parametrize("name", [b"OFFSET", b"GEN_SCALE"])
def test_a_c3d_file_without_its_scales_is_refused(tmp_path: Path, name: bytes) -> None:
    c3d(tmp_path / "a.c3d")
    content = (tmp_path / "a.c3d").read_bytes()
    assert content.count(name) == 1
    (tmp_path / "a.c3d").write_bytes(content.replace(name, name.lower()[:-1] + b"_"))
    with pytest.raises(ValueError, match=matches(f"it lacks ANALOG:{name.decode()}")):
        load_recording(tmp_path / "a.c3d", **MAPPING)


def test_an_array_that_claims_more_than_it_holds(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        for name in COLUMNS:
            with archive.open(f"{name}.npy", "w") as file:
                about = {"descr": "<f8", "fortran_order": False, "shape": (1 << 40,)}
                np.lib.format.write_array_header_1_0(file, about)
    with pytest.raises(ValueError, match=matches("'t' says that it holds more than the file")):
        load_recording(tmp_path / "a.npz", **MAPPING)


def test_one_cell_far_away_is_no_reason_to_take_all_memory(tmp_path: Path) -> None:
    pytest.importorskip("python_calamine", reason="needs python-calamine, of the extra 'formats'")
    with zipfile.ZipFile(tmp_path / "a.xlsx", "w") as archive:
        cells = '<row r="1"><c r="A1"><v>1</v></c></row><row r="1048576"><c r="XFD1048576"><v>1</v></c></row>'
        archive.writestr("xl/worksheets/sheet1.xml", f"<worksheet><sheetData>{cells}</sheetData></worksheet>")
    with pytest.raises(ValueError, match=matches("a sheet has cells in row 1048576 and in column 16384")):
        load_recording(tmp_path / "a.xlsx", **MAPPING)


def test_records_of_mcap_keep_to_the_file(tmp_path: Path) -> None:
    pytest.importorskip("rosbags", reason="needs rosbags, of the extra 'formats'")
    magic = b"\x89MCAP0\r\n"
    (tmp_path / "a.mcap").write_bytes(magic + b"\x01" + (1 << 60).to_bytes(8, "little") + bytes(40) + magic)
    topic: dict[str, Any] = {"time": "time", "position": "/a.position[1]", "torque": "/a.effort[1]"}
    with pytest.raises(ValueError, match=matches("ends in the middle of a record")):
        load_recording(tmp_path / "a.mcap", **topic)
