"""HDF5: a column is a dataset's path, such as `run/q`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers.columns import largest, require


def read(path: Path, names: list[str], matlab: bool = False) -> dict[str, Any]:
    """The datasets of these paths; errors write a path as MATLAB does if that wrote the file: `data.q`."""
    import h5py

    def datasets(file: Any) -> list[str]:
        found: list[str] = []
        file.visititems(lambda key, item: found.append(key) if isinstance(item, h5py.Dataset) else None)
        return [key.replace("/", ".") if matlab else key for key in found if not key.startswith("#")]

    with h5py.File(path, "r") as file:
        for name in names:
            if not isinstance(file.get(name), h5py.Dataset):
                require(name.replace("/", ".") if matlab else name, datasets(file))
            if _own(file, name).attrs.get("MATLAB_class") == b"char":
                raise RecordingError(f"variable {name!r} holds text, not numbers; name a numeric variable")
        return {name: file[name][()] for name in names}


def count(path: Path, names: list[str]) -> int:
    import h5py

    with h5py.File(path, "r") as file:
        return largest({name: _own(file, name).shape for name in names if name in file}, names)


def _own(file: Any, name: str) -> Any:
    """A dataset whose numbers are in the file itself."""
    import h5py

    found = file[name]
    if isinstance(found, h5py.Dataset) and (found.file != file or found.external or found.is_virtual):
        raise RecordingError(f"{name!r} lies in another file; copy its numbers into this one")
    return found
