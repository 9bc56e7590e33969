"""Formats of files: the same recording from each, and one line for what is damaged, hostile or too large."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st

from factories.recordings import MAPPING, assert_equal, matches, signals, write_csv
from factories.studies import joint
from jaximp.recordings.errors import RecordingError
from jaximp.recordings.load import load_recording, recording_from_arrays
from jaximp.recordings.readers import formats, mat


def nested_mat(path: Path, columns: dict[str, np.ndarray]) -> dict[str, Any]:
    scipy.io.savemat(path, {"data": {"inner": columns}})
    return {key: f"data.inner.{column}" for key, column in MAPPING.items()}


def row_vector_mat(path: Path, columns: dict[str, np.ndarray]) -> dict[str, Any]:
    scipy.io.savemat(path, columns, oned_as="row")
    return MAPPING


def new_mat(path: Path, columns: dict[str, np.ndarray]) -> dict[str, Any]:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in columns.items():
            file[f"data/{name}"] = values[None, :]  # MATLAB's (N, 1) is (1, N) in HDF5
    return {key: f"data.{column}" for key, column in MAPPING.items()}


def hdf5(path: Path, columns: dict[str, np.ndarray]) -> dict[str, Any]:
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[f"run/{name}"] = values
    return {key: f"run/{column}" for key, column in MAPPING.items()}


def npz(path: Path, columns: dict[str, np.ndarray]) -> dict[str, Any]:
    np.savez(path, **columns)
    return MAPPING


def parquet(path: Path, columns: dict[str, np.ndarray]) -> dict[str, Any]:
    pyarrow.parquet.write_table(pyarrow.table({**columns, "comment": ["x"] * len(columns["t"])}), path)
    return MAPPING


def text_file(delimiter: str) -> Callable[[Path, dict[str, np.ndarray]], dict[str, Any]]:
    def write(path: Path, columns: dict[str, np.ndarray]) -> dict[str, Any]:
        write_csv(path, {f" {name}": values for name, values in columns.items()}, delimiter)
        return MAPPING

    return write


@pytest.mark.parametrize(
    ("file", "write"),
    [
        pytest.param("a.csv", text_file(","), id="csv-comma"),
        pytest.param("a.txt", text_file(";"), id="txt-semicolon"),
        pytest.param("a.TSV", text_file("\t"), id="tsv-tab"),
        pytest.param("a.parquet", parquet, id="parquet"),
        pytest.param("a.mat", nested_mat, id="mat-v5-struct"),
        pytest.param("a.mat", row_vector_mat, id="mat-v5-row-vectors"),
        pytest.param("a.mat", new_mat, id="mat-v7.3"),
        pytest.param("a.h5", hdf5, id="hdf5"),
        pytest.param("a.npz", npz, id="npz"),
    ],
)
def test_every_format_gives_the_same_recording(tmp_path: Path, file: str, write: Callable[..., dict[str, Any]]) -> None:
    columns = signals()
    mapping = write(tmp_path / file, columns)
    recording = load_recording(tmp_path / file, **mapping)
    assert_equal(recording, recording_from_arrays(columns["t"], columns["q"], columns["tau"]))
    assert recording.name == "a"
    assert recording.notes == ()
    for channel in ("time", "position", "torque", "valid"):
        array = getattr(recording, channel)
        assert array.flags.c_contiguous
        assert not array.flags.writeable


def write_matrix_mat(path: Path, values: dict[str, np.ndarray]) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, array in values.items():
            file[name] = np.atleast_2d(array).T


@pytest.mark.parametrize(
    ("file", "write"),
    [
        pytest.param("a.mat", scipy.io.savemat, id="mat-v5"),
        pytest.param("a.mat", write_matrix_mat, id="mat-v7.3"),
        pytest.param("a.npz", lambda path, values: np.savez(path, **values), id="npz"),
    ],
)
def test_matrix_is_a_channel_of_several_joints_and_the_rate_is_a_variable(
    tmp_path: Path, file: str, write: Callable[..., None]
) -> None:
    q = np.random.default_rng(0).normal(size=(20, 2))
    write(tmp_path / file, {"q": q, "tau": 3 * q, "fs": np.array(0.25)})
    rate = {"column": "fs", "unit": "kHz"}
    recording = load_recording(tmp_path / file, sample_rate=rate, position="q", torque=["tau"])
    np.testing.assert_array_equal(recording.position, q)
    np.testing.assert_array_equal(recording.torque, 3 * q)
    np.testing.assert_allclose(recording.time, np.arange(20) / 250, rtol=1e-14)
    assert recording.sample_rate == pytest.approx(250)
    assert recording.joints == ("revolute", "revolute")


def test_integer_columns_become_float64(tmp_path: Path) -> None:
    path = write_csv(tmp_path / "a.csv", {"t": range(5), "q": [1, 2, 3, 2, 1], "tau": [0, 1, 0, 1, 0]})
    recording = load_recording(path, **MAPPING, name="integers")
    assert recording.position.dtype == np.float64
    assert recording.name == "integers"


# --- what is damaged or hostile ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("file", "write"),
    [("a.parquet", parquet), ("a.mat", row_vector_mat), ("a.mat", new_mat), ("a.h5", hdf5), ("a.npz", npz)],
    ids=["parquet", "mat-v5", "mat-v7.3", "hdf5", "npz"],
)
@pytest.mark.parametrize("kept", [0.0, 0.1, 0.7])
def test_damaged_files(tmp_path: Path, file: str, write: Callable[..., dict[str, Any]], kept: float) -> None:
    path = tmp_path / file
    mapping = write(path, signals(2000))
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    # A MATLAB v5 file that ends early can look like one with fewer variables.
    with pytest.raises(ValueError, match=r"\A[^\n]*(cannot be read as|is not there|it was cut)[^\n]*\Z") as caught:
        load_recording(path, **mapping)
    assert str(caught.value).startswith(f"{path}: ")


def test_pickled_objects_are_never_loaded(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", **signals() | {"q": np.array([{}] * 50)})
    with pytest.raises(ValueError, match=matches("holds Python objects, which are never unpickled")):
        load_recording(tmp_path / "a.npz", **MAPPING)


def test_other_bad_files(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=matches("there is no such file")):
        load_recording(tmp_path / "absent.csv", **MAPPING)
    (tmp_path / "a.doc").write_bytes(b"")
    with pytest.raises(ValueError, match=matches("use one of: .csv, .txt, .tsv, ")):
        load_recording(tmp_path / "a.doc", **MAPPING)
    (tmp_path / "empty.csv").write_bytes(b"")
    with pytest.raises(ValueError, match=matches("is empty; the first line must name the columns")):
        load_recording(tmp_path / "empty.csv", **MAPPING)
    (tmp_path / "noise.csv").write_bytes(bytes(range(256)))
    with pytest.raises(ValueError, match=matches("is not UTF-8 text")):
        load_recording(tmp_path / "noise.csv", **MAPPING)
    (tmp_path / "neither.csv").write_bytes(b"t,q\x81,tau\n0,1,2\n")
    with pytest.raises(ValueError, match=matches("is not cp1252 text, nor UTF-8; save it with that encoding")):
        load_recording(tmp_path / "neither.csv", **MAPPING)
    (tmp_path / "twice.csv").write_text("t,q,q,tau\n0,1,2,3\n")
    with pytest.raises(ValueError, match=matches("column 'q' appears more than once")):
        load_recording(tmp_path / "twice.csv", **MAPPING)
    pyarrow.parquet.write_table(pyarrow.table({"t": ["a"], "q": [1], "tau": [1]}), tmp_path / "text.parquet")
    with pytest.raises(ValueError, match=matches("column 't' holds string, not numbers")):
        load_recording(tmp_path / "text.parquet", **MAPPING)


EXTENSIONS = ["csv", "parquet", "feather", "jsonl", "mat", "h5", "npz", "xlsx", "bag"]


@given(content=st.binary(max_size=200), extension=st.sampled_from(EXTENSIONS))
@settings(max_examples=150, deadline=None, derandomize=True)
def test_arbitrary_bytes_give_one_line(
    tmp_path_factory: pytest.TempPathFactory, content: bytes, extension: str
) -> None:
    path = tmp_path_factory.getbasetemp() / f"noise.{extension}"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"\A[^\n]*\Z"):
        load_recording(path, **MAPPING)


# --- what a file claims to hold ---------------------------------------------------------------------------------------


def test_a_struct_is_counted_by_what_it_unpacks_to(tmp_path: Path) -> None:
    from scipy.io import savemat

    one = joint(1000)
    data = {"t": one.time, "q": one.position, "tau": one.torque}
    savemat(tmp_path / "s.mat", {"data": data, "other": np.zeros((3, 2000))}, do_compression=True)
    assert formats.count_samples(tmp_path / "s.mat", ["data.t", "data.q", "data.tau"]) == 1000


def test_a_struct_that_unpacks_to_too_much_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from scipy.io import savemat

    savemat(tmp_path / "s.mat", {"data": {"t": np.zeros(200_000)}}, do_compression=True)
    monkeypatch.setattr(mat, "MOST_NUMBERS", 100_000)
    monkeypatch.setattr(mat, "read", lambda *args: pytest.fail("it was read") if args[1] else {})
    assert formats.count_samples(tmp_path / "s.mat", ["data.t"]) > 100_000


def square(folder: Path) -> None:
    import h5py

    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("torque_Nm", (9000, 9000), chunks=(1000, 1000), dtype="f8")


def linked(folder: Path) -> None:
    import h5py

    with h5py.File(folder / "elsewhere.hdf", "w") as file:
        file["torque"] = np.arange(1000.0)
    with h5py.File(folder / "a.h5", "w") as file:
        file["torque_Nm"] = h5py.ExternalLink("elsewhere.hdf", "/torque")


def device(folder: Path) -> None:
    import h5py

    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("torque_Nm", (1000,), "f8", external=[("/dev/zero", 0, 8000)])


def virtual(folder: Path) -> None:
    import h5py

    layout = h5py.VirtualLayout((1000,), "f8")
    layout[:] = h5py.VirtualSource(str(folder / "elsewhere.hdf"), "torque", (1000,))
    with h5py.File(folder / "a.h5", "w") as file:
        file.create_virtual_dataset("torque_Nm", layout)


@pytest.mark.parametrize("make", [square, linked, device, virtual], ids=lambda make: make.__name__)
def test_an_hdf5_file_holds_its_own_numbers_and_no_more(tmp_path: Path, make: Callable[[Path], None]) -> None:
    make(tmp_path)
    why = "has shape" if make is square else "lies in another file"
    with pytest.raises(RecordingError, match=why):
        formats.count_samples(tmp_path / "a.h5", ["torque_Nm"])
    if make is not square:
        with pytest.raises(RecordingError, match=why):
            formats.read_columns(tmp_path / "a.h5", ["torque_Nm"])
