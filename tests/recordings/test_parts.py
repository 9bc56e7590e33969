"""Parts of variables, by the names that MATLAB and numpy give them, in every format that has them."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow
import pyarrow.feather
import pyarrow.parquet
import pytest
from scipy.io import savemat

from factories.recordings import matches, signals
from jaximp.recordings import load_recording
from jaximp.recordings.readers.formats import count_samples

COLUMNS = signals()
MATRIX = np.column_stack(list(COLUMNS.values()))
RECORDS = np.array(list(map(tuple, MATRIX)), dtype=[("t", "f8"), ("q", "f8"), ("tau", "f8")])
TRIALS = 3


def trials() -> Any:
    data = np.empty((1, TRIALS), dtype=[("t", "O"), ("q", "O"), ("tau", "O")])
    for k in range(TRIALS):
        data[0, k] = (COLUMNS["t"], (k + 1) * COLUMNS["q"], (k + 1) * COLUMNS["tau"])
    return data


def new_mat(path: Path) -> None:
    """As MATLAB writes v7.3: a matrix that is turned round, and an array of structs as references."""
    with h5py.File(path, "w", userblock_size=512) as file:
        file["data"] = MATRIX.T
        for field in COLUMNS:
            parts = []
            for k in range(TRIALS):
                file[f"#refs#/{field}{k}"] = (1 if field == "t" else k + 1) * COLUMNS[field][None, :]
                parts.append(file[f"#refs#/{field}{k}"].ref)
            file.create_dataset(f"trials/{field}", data=np.array([parts], dtype=object).T, dtype=h5py.ref_dtype)


def write(path: Path) -> None:
    """All that the format can hold."""
    joints = {"t": COLUMNS["t"], "q": MATRIX[:, [0, 1]], "tau": MATRIX[:, [0, 2]]}
    if path.name == "new.mat":
        new_mat(path)
    elif path.suffix == ".mat":
        cube = np.stack([MATRIX, 2 * MATRIX], axis=2)
        cells = np.empty((1, 2), object)
        cells[0, 0], cells[0, 1] = MATRIX[:, 0], MATRIX
        savemat(path, {"data": MATRIX, "wide": MATRIX.T, "trials": trials(), "cube": cube, "run": {"data": MATRIX}})
    elif path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            file["log"], file["run/data"] = RECORDS, MATRIX
    elif path.suffix == ".npz":
        np.savez(path, log=RECORDS, data=MATRIX, **joints)
    else:
        table = pyarrow.table({name: list(x) if x.ndim > 1 else x for name, x in joints.items()})
        (pyarrow.parquet.write_table if path.suffix == ".parquet" else pyarrow.feather.write_feather)(table, path)


@pytest.mark.parametrize(
    ("file", "names", "times"),
    [
        ("a.mat", ("data(:,1)", "data(:,2)", "data(:,3)"), 1),
        ("a.mat", ("data[:,0]", "data[:,1]", "data[:,2]"), 1),
        ("a.mat", ("data[1]", "data[2]", "data[3]"), 1),
        ("a.mat", ("run.data(:, 1)", "run.data(:, 2)", "run.data[3]"), 1),
        ("a.mat", ("wide(1,:)", "wide(2,:)", "wide[2,:]"), 1),
        ("a.mat", ("cube(:,1,1)", "cube(:,2,2)", "cube(:,3,2)"), 2),
        ("a.mat", ("trials(2).t", "trials(2).q", "trials(2).tau"), 2),
        ("a.mat", ("trials[3].t", "trials[3].q", "trials[3].tau"), 3),
        ("new.mat", ("data(:,1)", "data(:,2)", "data[3]"), 1),
        ("new.mat", ("trials(2).t", "trials(2).q", "trials(2).tau"), 2),
        ("a.h5", ("log/t", "log/q", "log.tau"), 1),
        ("a.h5", ("run/data[1]", "run/data(:,2)", "run.data[:,2]"), 1),
        ("a.npz", ("log.t", "log.q", "log/tau"), 1),
        ("a.npz", ("t", "q[2]", "tau[2]"), 1),
        ("a.parquet", ("t", "q[2]", "tau(:,2)"), 1),
        ("a.feather", ("t", "q[2]", "tau[:,1]"), 1),
    ],
)
def test_a_part_is_read_by_its_name(tmp_path: Path, file: str, names: tuple[str, ...], times: int) -> None:
    write(tmp_path / file)
    recording = load_recording(tmp_path / file, time=names[0], position=names[1], torque=names[2])
    np.testing.assert_array_equal(recording.position[:, 0], times * COLUMNS["q"])
    np.testing.assert_array_equal(recording.torque[:, 0], times * COLUMNS["tau"])
    numbered = [name for name in names if name.endswith("]") and ":" not in name]
    for name in numbered:
        assert any(note.startswith(f"{name!r} is column ") and "counted from 1" in note for note in recording.notes)
    if Path(file).suffix != ".feather":
        assert count_samples(tmp_path / file, list(names)) >= len(COLUMNS["t"])


def test_lists_of_a_column_are_joints(tmp_path: Path) -> None:
    write(tmp_path / "a.parquet")
    recording = load_recording(tmp_path / "a.parquet", time="t", position="q", torque="tau")
    np.testing.assert_array_equal(recording.position, MATRIX[:, [0, 1]])


@pytest.mark.parametrize(
    ("file", "name", "message"),
    [
        ("a.mat", "trials.q", "'trials' is an array of 3 structs: name one, such as trials(1).q"),
        ("new.mat", "trials.q", "'trials' is an array of 3 structs: name one, such as trials(1).q"),
        ("a.mat", "trials(4).q", "trials is a list of 3; name one, trials(1) to trials(3)"),
        ("new.mat", "trials(4).q", "the array has 3 structs"),
        ("a.mat", "trials", "'trials' has fields: name one, such as trials.t"),
        ("a.mat", "data(:,4)", "column 'data(:,4)' is not there: data is 50 x 3"),
        ("a.mat", "data(2)", "write data(:,2) for its second column"),
        ("a.mat", "data[0]", "columns count from 1; write [1] for the first one, or numpy's data[:,0]"),
        ("a.mat", "data(:,2", "is not there, and is no name such as"),
        ("a.mat", "data(end)", "(end) is not understood"),
        ("a.mat", "date", "column 'date' is not there; did you mean 'data'?"),
        ("a.mat", "zzz", "there are: 'data' (50 x 3), 'wide' (3 x 50)"),
        ("a.h5", "log", "'log' has fields: name one, such as log.t"),
        ("a.h5", "log/w", "field 'w' of 'log/w' is not there"),
        ("a.npz", "zzz", "'data' (50 x 3)"),
        ("a.npz", "q[3]", "column 'q[3]' is not there: q is 50 x 2"),
        ("a.parquet", "w", "column 'w' is not there"),
    ],
)
def test_a_part_that_is_not_there(tmp_path: Path, file: str, name: str, message: str) -> None:
    write(tmp_path / file)
    with pytest.raises(ValueError, match=matches(message)):
        load_recording(tmp_path / file, sample_rate=100, position=name, torque=name)


# --- objects of MATLAB ------------------------------------------------------------------------------------------------


def element(kind: int, data: bytes) -> bytes:
    return struct.pack("<II", kind, len(data)) + data + b"\0" * (-len(data) % 8)


def opaque(name: bytes, of: bytes) -> bytes:
    inner = element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 6, 1)) + element(1, b"")
    inner = element(14, inner + element(6, struct.pack("<6I", 0xDD000000, 2, 1, 1, 1, 1)))
    head = element(6, struct.pack("<II", 17, 0)) + element(1, name) + element(1, b"MCOS") + element(1, of)
    return element(14, head + inner)


@pytest.mark.parametrize("of", ["table", "timeseries", "MyLog"])
def test_plain_variables_beside_an_object_are_read(tmp_path: Path, of: str) -> None:
    path = tmp_path / "a.mat"
    savemat(path, COLUMNS)
    path.write_bytes(path.read_bytes() + opaque(b"log", of.encode()))
    recording = load_recording(path, time="t", position="q", torque="tau")
    np.testing.assert_array_equal(recording.position[:, 0], COLUMNS["q"])
    with pytest.raises(ValueError, match=matches(f"'log' is a MATLAB {of}, which only MATLAB reads: save ")):
        load_recording(path, time="t", position="log.q", torque="tau")


# --- files that are not what they are called --------------------------------------------------------------------------

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 2012328\n"


@pytest.mark.parametrize("extension", ["csv", "parquet", "mat", "h5", "npz", "feather"])
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (POINTER, "is a Git LFS pointer, not the file (2.0 MB): run git lfs pull"),
        (b"<!DOCTYPE html>\n<html>404: Not Found</html>\n", "is a web page, not the file"),
        (b"", "is empty"),
        (bytes(5000), "holds zeros alone"),
        (b"%PDF-1.7\n" + b"x" * 100, "it is a PDF document, whatever its name says"),
    ],
    ids=["pointer", "page", "empty", "zeros", "pdf"],
)
def test_what_a_file_is_not(tmp_path: Path, extension: str, content: bytes, message: str) -> None:
    (tmp_path / f"a.{extension}").write_bytes(content)
    with pytest.raises(ValueError, match=matches(message)):
        load_recording(tmp_path / f"a.{extension}", time="t", position="q", torque="tau")
