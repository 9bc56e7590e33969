"""HDF5: a column is a dataset's path, such as `run/q`, a column of it, `run/q[2]`, or a field of a table, `log/q`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers.columns import Index, head_of, largest, pick, require, require_variable, steps_of
from jaximp.recordings.readers.found import Found
from jaximp.recordings.readers.matlab_objects import column_of_object

OBJECTS = (b"table", b"timetable", b"timeseries", b"string", b"datetime", b"duration")
"""Classes of MATLAB that are no plain arrays."""


def read(path: Path, names: Sequence[str], matlab: bool = False) -> Found:
    """The datasets of these paths, or parts of them; errors write a path as MATLAB does if that wrote the file:
    `data.q`, and its arrays are turned round."""
    import h5py

    notes: list[str] = []
    with h5py.File(path, "r") as file:
        return Found({name: _value(path, file, name, matlab, notes) for name in names}, notes=tuple(notes))


def _value(path: Path, file: Any, name: str, matlab: bool, notes: list[str]) -> Any:
    dataset, steps = _find(file, name, matlab)
    kind = dataset.attrs.get("MATLAB_class")
    if kind == b"char":
        raise RecordingError(f"variable {name!r} holds text, not numbers; name a numeric variable")
    if dataset.attrs.get("MATLAB_object_decode") is not None or kind in OBJECTS:
        of = kind.decode() if isinstance(kind, bytes) else "object"
        return column_of_object(path, head_of(name), steps, name, of, notes)
    value = dataset[()]
    return pick(np.transpose(value) if matlab else value, steps, name, notes)


def _find(file: Any, name: str, matlab: bool) -> tuple[Any, list[str | Index]]:
    """The dataset that a name begins with, and what of it is meant."""
    import h5py

    if isinstance(file.get(name), h5py.Dataset):
        return _own(file, name), []
    head, steps = steps_of(name)
    node, place = file.get(head.lstrip("./")) if head.lstrip("./") else file, None
    _require_node(file, node, name, matlab)
    while steps and isinstance(node, h5py.Group):
        step = steps.pop(0)
        if isinstance(step, Index):
            place = step
            continue
        if step not in node:
            require(step, _datasets(file, matlab) if not matlab else list(node), f"column {name!r}")
        node = node[step]
        if isinstance(node, h5py.Dataset) and matlab and node.dtype == object:
            node, place = _of_array(file, node, place, name), None
    _require_node(file, node, name, matlab)
    if place is not None:
        raise RecordingError(
            f"column {name!r} is not there: it is one struct, and no array of them; leave {place.text}"
        )
    if not isinstance(node, h5py.Dataset):
        require(name, _datasets(file, matlab))
    return _own(file, node.name), steps


def _of_array(file: Any, references: Any, place: Index | None, name: str) -> Any:
    """The dataset of one struct of an array of structs."""
    count = references.size
    if place is None and count != 1:
        before, _, field = name.rpartition(".")
        raise RecordingError(f"{before!r} is an array of {count} structs: name one, such as {before}(1).{field}")
    at = 0 if place is None else place.at[0]
    if at is None or at >= count:
        raise RecordingError(f"column {name!r} is not there: the array has {count} structs")
    return file[references[()].ravel()[at]]


def _require_node(file: Any, node: Any, name: str, matlab: bool) -> None:
    import h5py

    if node is None:
        shapes: dict[str, tuple[int, ...]] = {}
        file.visititems(
            lambda key, item: (
                shapes.update({key: item.shape[:: -1 if matlab else 1]})
                if isinstance(item, h5py.Dataset) and not key.startswith("#")
                else None
            )
        )
        require_variable(name, {key.replace("/", ".") if matlab else key: shape for key, shape in shapes.items()}, name)


def _datasets(file: Any, matlab: bool) -> list[str]:
    import h5py

    found: list[str] = []
    file.visititems(lambda key, item: found.append(key) if isinstance(item, h5py.Dataset) else None)
    return [key.replace("/", ".") if matlab else key for key in found if not key.startswith("#")]


def count(path: Path, names: Sequence[str], matlab: bool = False) -> int:
    import h5py

    shapes = {}
    with h5py.File(path, "r") as file:
        for name in names:
            try:
                dataset, _ = _find(file, name, matlab)
            except RecordingError as error:
                if "lies in another file" in str(error):
                    raise
                continue
            shapes[name] = dataset.shape
    return largest(shapes, list(names))


def _own(file: Any, name: str) -> Any:
    """A dataset whose numbers are in the file itself."""
    import h5py

    found = file[name]
    if isinstance(found, h5py.Dataset) and (found.file != file or found.external or found.is_virtual):
        raise RecordingError(f"{name!r} lies in another file; copy its numbers into this one")
    return found


def shapes(path: Path, matlab: bool = False) -> dict[str, tuple[int, ...]]:
    """Of every dataset."""
    import h5py

    with h5py.File(path, "r") as file:
        names = _datasets(file, matlab)
        own = [file[name.replace(".", "/") if matlab else name] for name in names]
        return {name: one.shape[:: -1 if matlab else 1] for name, one in zip(names, own, strict=True)}
