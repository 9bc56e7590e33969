"""Columns of a file, as they are: CSV, Parquet, MATLAB v5 and v7.3, HDF5, NPZ.

pyarrow, h5py and scipy take long to import and are imported where they are needed. Nothing is ever unpickled.
"""

from __future__ import annotations

import csv
import os
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaximp.types import nearest

MOST_COLUMNS = 1000
"""A variable that is longer than this along both axes is no recording."""
MOST_NUMBERS = 1_000_000_000
"""A struct that holds more numbers than this is not unpacked to count them."""
THREADS_PAY = 200_000
"""Rows of a Parquet file from which its columns are read at the same time: to hand over small ones takes longer."""
COMPRESSED = 15
"""How a MATLAB v5 file marks what it compressed."""


class RecordingError(ValueError):
    """A measurement that cannot be used: one line with the cause and the remedy."""


class UnavailableError(RecordingError):
    """A file that could not be read for now, for a reason that does not lie in its content."""


def read_columns(path: Path, names: list[str]) -> dict[str, Any]:
    """The named columns of a file; whatever a reader's library raises becomes one line."""
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise RecordingError(f"cannot read '{path.suffix}' files; use one of: {', '.join(_READERS)}")
    try:
        return reader(path, list(dict.fromkeys(names)))
    except (RecordingError, MemoryError):
        raise
    except UnicodeDecodeError:
        raise RecordingError("is not UTF-8 text; save it with that encoding") from None
    except Exception as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise UnavailableError(f"cannot be read ({os.strerror(error.errno)}); solve that and try again") from None
        cause = " ".join(str(error).split())[:100] or type(error).__name__
        remedy = "the file is damaged, cut short or of another kind; write it anew"
        raise RecordingError(f"cannot be read as {path.suffix} ({cause}): {remedy}") from None


def count_samples(path: Path, names: list[str]) -> int:
    """How many samples a file says that it holds of some columns, without reading them: zero where it does not say.

    **Raises:** `RecordingError` for a variable that must not be read. What else is wrong, `read_columns` says.
    """
    counter = _COUNTERS.get(path.suffix.lower())
    try:
        return 0 if counter is None else counter(path, names)
    except (RecordingError, MemoryError):
        raise
    except Exception:
        return 0


def _lines(path: Path, names: list[str]) -> int:
    """The number of lines that hold something, without the header."""
    count, last = 0, b"\n"
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            count, last = count + block.count(b"\n"), block[-1:]
    return max(0, count - 1 + (last != b"\n"))


def _parquet_rows(path: Path, names: list[str]) -> int:
    from pyarrow import parquet

    with path.open("rb") as file:
        about = parquet.read_metadata(file)
    # Whoever reads believes the parts, not the whole.
    groups = [about.row_group(k) for k in range(about.num_row_groups)]
    longest = [
        max([group.num_rows, *(group.column(j).num_values for j in range(group.num_columns))]) for group in groups
    ]
    return max(int(about.num_rows), sum(longest))


def _largest(shapes: dict[str, tuple[int, ...]], names: list[str]) -> int:
    """The most numbers along any axis of a variable that is wanted: time is the longest."""
    heads = {name.split(".")[0] for name in names} | set(names)
    wanted = {name: shape for name, shape in shapes.items() if name in heads}
    for name, shape in wanted.items():
        if len(shape) > 1 and sorted(shape)[-2] > MOST_COLUMNS:
            raise RecordingError(f"{name!r} has shape {shape}: a recording has (samples, joints)")
    return max((max(shape, default=0) for shape in wanted.values()), default=0)


def _mat_samples(path: Path, names: list[str]) -> int:
    import h5py

    if h5py.is_hdf5(path):
        return _hdf5_samples(path, [name.replace(".", "/") for name in names])
    from scipy.io import whosmat

    unpacked = _check_complete_mat(path)
    shapes = {name: shape for name, shape, _ in whosmat(path)}
    inside = [name for name in names if "." in name and name.split(".")[0] in shapes]
    if inside and unpacked > 8 * MOST_NUMBERS:
        return unpacked // 8
    # A struct tells its fields' shapes to nobody who does not unpack it.
    return _largest(shapes | {name: np.shape(column) for name, column in _read_mat(path, inside).items()}, names)


def _hdf5_samples(path: Path, names: list[str]) -> int:
    import h5py

    with h5py.File(path, "r") as file:
        return _largest({name: _own(file, name).shape for name in names if name in file}, names)


def _own(file: Any, name: str) -> Any:
    """A dataset whose numbers are in the file itself."""
    import h5py

    found = file[name]
    if isinstance(found, h5py.Dataset) and (found.file != file or found.external or found.is_virtual):
        raise RecordingError(f"{name!r} lies in another file; copy its numbers into this one")
    return found


def _npz_samples(path: Path, names: list[str]) -> int:
    """Read from the headers of the arrays inside; the numbers stay compressed."""
    import zipfile

    shapes = {}
    with zipfile.ZipFile(path) as archive:
        for name in names:
            with archive.open(f"{name}.npy") as member:
                version = np.lib.format.read_magic(member)
                read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
                shapes[name] = read(member)[0]
    return _largest(shapes, names)


_COUNTERS: dict[str, Callable[[Path, list[str]], int]] = {
    **dict.fromkeys((".csv", ".txt", ".tsv"), _lines),
    ".parquet": _parquet_rows,
    ".mat": _mat_samples,
    **dict.fromkeys((".h5", ".hdf5"), _hdf5_samples),
    ".npz": _npz_samples,
}


def _read_csv(path: Path, names: list[str]) -> dict[str, Any]:
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
        _require(name, spelled)
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
        _blame_csv_row(path, delimiter, {name: raw.index(spelled[name]) for name in names}, len(raw))
        raise
    return {name: table[spelled[name]].to_numpy() for name in names}


def delimiter_of(header: str) -> str:
    """What separates the columns that a header names: comma, semicolon or tab."""
    return max(",;\t", key=header.count)


def _blame_csv_row(path: Path, delimiter: str, wanted: dict[str, int], width: int) -> None:
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


def _read_parquet(path: Path, names: list[str]) -> dict[str, Any]:
    import pyarrow
    from pyarrow import parquet

    with parquet.ParquetFile(path, pre_buffer=False) as file:
        schema = file.schema_arrow
        for name in names:
            _require(name, schema.names)
            kind = schema.field(name).type
            if not (
                pyarrow.types.is_integer(kind) or pyarrow.types.is_floating(kind) or pyarrow.types.is_decimal(kind)
            ):
                raise RecordingError(f"column {name!r} holds {kind}, not numbers; store it as numbers in a known unit")
        table = file.read(columns=names, use_threads=file.metadata.num_rows > THREADS_PAY)
    return {name: table[name].cast(pyarrow.float64(), safe=False).to_numpy() for name in names}


def _read_mat(path: Path, names: list[str]) -> dict[str, Any]:
    """MATLAB v5 by scipy; v7.3 is HDF5 with every array transposed and structs as groups."""
    import h5py

    if h5py.is_hdf5(path):
        paths = {name: name.replace(".", "/") for name in names}
        found = _read_hdf5(path, list(paths.values()), matlab=True)
        return {name: np.transpose(found[paths[name]]) for name in names}
    from scipy.io import loadmat, whosmat

    _check_complete_mat(path)
    variables = [name for name, _, _ in whosmat(path)]
    for name in names:
        _require(name.split(".")[0], variables)
    content = loadmat(path, variable_names=[name.split(".")[0] for name in names])
    return {name: _mat_field(content, name) for name in names}


def _check_complete_mat(path: Path) -> int:
    """Follow the variables of a MATLAB v5 file by their lengths: scipy reads a file that was cut as one with fewer.

    **Returns:** how many bytes they say that they unpack to.
    """
    size, unpacked = path.stat().st_size, 0
    with path.open("rb") as file:
        order: Literal["little", "big"] = "little" if file.read(128)[126:128] == b"IM" else "big"
        position = 128
        while position < size:
            file.seek(position)
            kind, length = (int.from_bytes(file.read(4), order) for _ in range(2))
            position += 8 + length
            if kind == COMPRESSED:
                head = zlib.decompressobj().decompress(file.read(min(length, 4096)), 8)
                length = int.from_bytes(head[4:], order)
            unpacked += length
    if position > size:
        raise RecordingError("the file ends in the middle of a variable: it was cut, copy it again")
    return unpacked


def _mat_field(content: dict[str, Any], name: str) -> Any:
    head, *fields = name.split(".")
    value = content[head]
    for field in fields:
        _require(field, value.dtype.names or (), f"field {field!r} of {name!r}")
        value = value[field][0, 0]
    return value


def _read_hdf5(path: Path, names: list[str], matlab: bool = False) -> dict[str, Any]:
    import h5py

    def datasets(file: Any) -> list[str]:
        found: list[str] = []
        file.visititems(lambda key, item: found.append(key) if isinstance(item, h5py.Dataset) else None)
        return [key.replace("/", ".") if matlab else key for key in found if not key.startswith("#")]

    with h5py.File(path, "r") as file:
        for name in names:
            if not isinstance(file.get(name), h5py.Dataset):
                _require(name.replace("/", ".") if matlab else name, datasets(file))
            if _own(file, name).attrs.get("MATLAB_class") == b"char":
                raise RecordingError(f"variable {name!r} holds text, not numbers; name a numeric variable")
        return {name: file[name][()] for name in names}


def _read_npz(path: Path, names: list[str]) -> dict[str, Any]:
    # numpy leaves a file open that it opened itself and could not read.
    with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
        for name in names:
            _require(name, file.files)
        try:
            return {name: file[name] for name in names}
        except ValueError as error:
            if "allow_pickle" not in str(error):
                raise
            raise RecordingError("holds Python objects, which are never unpickled; save plain numeric arrays") from None


_READERS: dict[str, Callable[[Path, list[str]], dict[str, Any]]] = {
    **dict.fromkeys((".csv", ".txt", ".tsv"), _read_csv),
    ".parquet": _read_parquet,
    ".mat": _read_mat,
    **dict.fromkeys((".h5", ".hdf5"), _read_hdf5),
    ".npz": _read_npz,
}


FORMATS = tuple(_READERS)
"""Extensions of files that can be read."""
MATRICES = (".mat", ".h5", ".hdf5", ".npz")
"""Extensions of files in which one variable may hold several columns."""


def _require(name: str, available: Iterable[str], what: str | None = None) -> None:
    choices = list(available)
    if name not in choices:
        hint = nearest(name, choices) if choices else "there are none"
        raise RecordingError(f"{what or f'column {name!r}'} is not there; {hint}")
