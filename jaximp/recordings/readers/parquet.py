"""Parquet, column by column."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers.columns import require

THREADS_PAY = 200_000
"""Rows of a file from which its columns are read at the same time: to hand over small ones takes longer."""


def read(path: Path, names: list[str]) -> dict[str, Any]:
    import pyarrow
    from pyarrow import parquet

    with parquet.ParquetFile(path, pre_buffer=False) as file:
        schema = file.schema_arrow
        for name in names:
            require(name, schema.names)
            kind = schema.field(name).type
            if not (
                pyarrow.types.is_integer(kind) or pyarrow.types.is_floating(kind) or pyarrow.types.is_decimal(kind)
            ):
                raise RecordingError(f"column {name!r} holds {kind}, not numbers; store it as numbers in a known unit")
        table = file.read(columns=names, use_threads=file.metadata.num_rows > THREADS_PAY)
    return {name: table[name].cast(pyarrow.float64(), safe=False).to_numpy() for name in names}


def count(path: Path, names: list[str]) -> int:
    from pyarrow import parquet

    with path.open("rb") as file:
        about = parquet.read_metadata(file)
    # Whoever reads believes the parts, not the whole.
    groups = [about.row_group(k) for k in range(about.num_row_groups)]
    longest = [
        max([group.num_rows, *(group.column(j).num_values for j in range(group.num_columns))]) for group in groups
    ]
    return max(int(about.num_rows), sum(longest))
