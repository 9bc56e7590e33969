"""Parquet and Feather, column by column; a column of lists has a column for each place, `q[2]`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers.columns import head_of, pick, require, steps_of
from jaximp.recordings.readers.found import COUNTED_FROM, Found

NO_MACHINE_HAS = 1 << 44
"""Bytes."""
THREADS_PAY = 200_000
"""Rows of a file from which its columns are read at the same time: to hand over small ones takes longer."""


def read(path: Path, names: Sequence[str]) -> Found:
    from pyarrow import parquet

    with parquet.ParquetFile(path, pre_buffer=False) as file:
        heads = _heads(names, file.schema_arrow)
        table = file.read(columns=list({*heads.values()}), use_threads=file.metadata.num_rows > THREADS_PAY)
    return _columns(table, heads)


def read_feather(path: Path, names: Sequence[str]) -> Found:
    import pyarrow
    from pyarrow import feather

    with pyarrow.memory_map(str(path)) as source:
        try:
            table = feather.read_table(source)
        except pyarrow.ArrowMemoryError as error:
            if max(map(int, re.findall(r"\d+", str(error))), default=0) < NO_MACHINE_HAS:
                raise
            raise RecordingError("says that it holds more than any memory: it is damaged, copy it again") from None
        return columns_of_table(table, names)


def columns_of_table(table: Any, names: Sequence[str]) -> Found:
    """The columns of a table of pyarrow, or parts of them."""
    return _columns(table, _heads(names, table.schema))


def _heads(names: Sequence[str], schema: Any) -> dict[str, str]:
    """The column that each name begins with."""
    heads = {name: name if name in schema.names else head_of(name) for name in names}
    for name, head in heads.items():
        if head not in schema.names:
            require(name, schema.names)
        _check_kind(head, schema.field(head).type)
    return heads


def _check_kind(name: str, kind: Any) -> None:
    from pyarrow import types

    if types.is_struct(kind):
        return
    inner = (
        kind.value_type if types.is_fixed_size_list(kind) or types.is_list(kind) or types.is_large_list(kind) else kind
    )
    if types.is_timestamp(inner) or types.is_duration(inner):
        return
    if not (types.is_integer(inner) or types.is_floating(inner) or types.is_decimal(inner)):
        raise RecordingError(f"column {name!r} holds {kind}, not numbers; store it as numbers in a known unit")


def _columns(table: Any, heads: dict[str, str]) -> Found:
    import pyarrow

    notes: list[str] = []
    values = {}
    for name, head in heads.items():
        steps = [] if name == head else steps_of(name)[1]
        column = table[head].combine_chunks()
        while steps and isinstance(field := steps[0], str):
            steps = steps[1:]
            if not pyarrow.types.is_struct(column.type):
                raise RecordingError(f"column {name!r} is not there: {head!r} has no fields")
            require(field, [one.name for one in column.type], f"field {field!r} of {name!r}")
            column = column.field(field)
        if pyarrow.types.is_timestamp(column.type) and len(column):
            notes.append(f"{name!r} holds time stamps: {COUNTED_FROM} {column[0]}")
        values[name] = pick(_numbers(name, column), steps, name, notes)
    return Found(values, notes=tuple(notes))


def _numbers(name: str, column: Any) -> Any:
    """(N,), or (N, k) of lists that are equally long."""
    import numpy as np
    import pyarrow
    import pyarrow.compute as pc
    from pyarrow import types

    kind = column.type
    if types.is_timestamp(kind) or types.is_duration(kind):
        if len(column) and column.null_count == 0:
            column = pc.cast(pc.subtract(pc.cast(column, "int64"), pc.cast(column[0], "int64")), "int64")
            return np.asarray(column) / {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9}[kind.unit]
        raise RecordingError(f"column {name!r}: a time stamp is missing; remove the row")
    if types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        lengths = pc.unique(pc.list_value_length(column)).to_pylist()
        if len(lengths) != 1 or lengths[0] is None:
            raise RecordingError(f"column {name!r} holds lists of {len(lengths)} lengths; write lists of one length")
        flat = pc.list_flatten(column)
        return np.asarray(pc.cast(flat, pyarrow.float64(), safe=False)).reshape(len(column), lengths[0])
    if types.is_struct(kind):
        raise RecordingError(f"column {name!r} has fields: name one, such as {name}.{kind[0].name}")
    _check_kind(name, kind)
    return column.cast(pyarrow.float64(), safe=False).to_numpy(zero_copy_only=False)


def count(path: Path, names: Sequence[str]) -> int:
    from pyarrow import parquet

    with path.open("rb") as file:
        about = parquet.read_metadata(file)
    # Whoever reads believes the parts, not the whole.
    groups = [about.row_group(k) for k in range(about.num_row_groups)]
    longest = [
        max([group.num_rows, *(group.column(j).num_values for j in range(group.num_columns))]) for group in groups
    ]
    return max(int(about.num_rows), sum(longest))


def shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """The columns of numbers; how many a column of lists holds only its rows say."""
    from pyarrow import parquet

    return shapes_in_schema(parquet.read_schema(path))


def shapes_of_feather(path: Path) -> dict[str, tuple[int, ...]]:
    """The same of a Feather file."""
    from pyarrow import dataset

    return shapes_in_schema(dataset.dataset(path, format="feather").schema)


def shapes_in_schema(schema: Any) -> dict[str, tuple[int, ...]]:
    """Columns of numbers and of time stamps."""
    from pyarrow import types

    return {
        field.name: ()
        for field in schema
        if types.is_integer(field.type) or types.is_floating(field.type) or types.is_timestamp(field.type)
    }


def count_feather(path: Path, names: Sequence[str]) -> int:
    from pyarrow import dataset

    return int(dataset.dataset(path, format="feather").count_rows())
