"""Objects of MATLAB: tables are read by mat-io where that is installed; of others it is said how to save them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers.columns import Index, pick, require

SAVED = {
    "table": "s = table2struct({0}, 'ToScalar', true)",
    "timetable": "s = table2struct(timetable2table({0}), 'ToScalar', true)",
    "timeseries": "{0}.Time and {0}.Data as variables of their own",
    "string": "char({0})",
    "datetime": "seconds({0} - {0}(1))",
    "duration": "seconds({0})",
}
"""What to save in place of an object."""


def column_of_object(
    path: Path, head: str, steps: Sequence[str | Index], name: str, kind: str, notes: list[str]
) -> Any:
    """A column of a table, or of a timetable.

    **Raises:** `RecordingError` that says what to save in its place, where it cannot be read.
    """
    table = _table(path, head) if kind in ("table", "timetable") else None
    if table is None:
        how = SAVED.get(kind, "its numbers as plain variables").format(head)
        raise RecordingError(f"{head!r} is a MATLAB {kind}, which only MATLAB reads: save {how}")
    names = [str(one) for one in table.columns]
    if not steps or not isinstance(steps[0], str):
        raise RecordingError(f"{name!r} has fields: name one, such as {head}.{names[0]}")
    field = steps[0]
    if kind == "timetable" and field in ("Time", str(table.index.name)) and field not in names:
        return (table.index - table.index[0]).total_seconds().to_numpy()
    require(field, names, f"field {field!r} of {name!r}")
    return pick(np.asarray(table[field]), steps[1:], name, notes)


def _table(path: Path, head: str) -> Any:
    """A table of pandas; None where it cannot be had."""
    try:
        import matio

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            table = matio.load_from_mat(str(path), variable_names=[head])[head]
        return table if hasattr(table, "columns") else None
    except MemoryError:
        raise
    except Exception:
        return None
