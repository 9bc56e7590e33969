"""Which kinds of files can be read, and by what: the table of the readers, and the only way to them.

A new kind of file is one module beside this one and one row of `FORMATS`. Libraries that take long to import are
imported in the function that needs them. Nothing is ever unpickled.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaximp.recordings.errors import RecordingError, UnavailableError
from jaximp.recordings.readers import c3d, excel, hdf5, json_lines, mat, npz, parquet, rosbag, text
from jaximp.recordings.readers.disguise import refuse_disguise
from jaximp.recordings.readers.found import AS_SEEN, Found, TextOptions


@dataclass(frozen=True)
class Format:
    """A kind of file, and how it is read."""

    read: Callable[..., Found]
    """The named columns of a file. What its library raises, `read_columns` puts into words."""
    count: Callable[[Path, list[Any]], int]
    """How many samples a file says that it holds of some columns, without reading them; zero where it does not say."""
    matrices: bool = False
    """Whether one variable may hold several columns, one per joint."""
    text: bool = False
    """Whether columns can be asked for by number, from 1, and `read` takes `TextOptions`."""


FORMATS = {
    **dict.fromkeys((".csv", ".txt", ".tsv"), Format(text.read, text.count, text=True)),
    **dict.fromkeys((".dat", ".asc", ".sto", ".mot", ".lvm"), Format(text.read, text.count, text=True)),
    **dict.fromkeys((".xlsx", ".xls", ".xlsb", ".ods"), Format(excel.read, excel.count, text=True)),
    **dict.fromkeys((".jsonl", ".ndjson"), Format(json_lines.read, json_lines.count, matrices=True)),
    ".parquet": Format(parquet.read, parquet.count, matrices=True),
    ".feather": Format(parquet.read_feather, parquet.count_feather, matrices=True),
    ".mat": Format(mat.read, mat.count, matrices=True),
    **dict.fromkeys((".h5", ".hdf5"), Format(hdf5.read, hdf5.count, matrices=True)),
    ".c3d": Format(c3d.read, c3d.count, matrices=True),
    **dict.fromkeys((".bag", ".mcap", ".db3"), Format(rosbag.read, rosbag.count, matrices=True)),
    ".npz": Format(npz.read, npz.count, matrices=True),
}
"""By the extension of the file, in small letters."""
MATRICES = tuple(extension for extension, kind in FORMATS.items() if kind.matrices)
"""Extensions of files in which one variable may hold several columns."""


def format_of(path: Path) -> Format | None:
    """By its extension, which stands before `.gz` where a text file was packed."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    if suffixes[-1:] == [".gz"]:
        inner = FORMATS.get(suffixes[-2]) if len(suffixes) > 1 else FORMATS[".txt"]
        return inner if inner is not None and inner.text else None
    return FORMATS.get(path.suffix.lower())


def read_columns(path: Path, names: Sequence[str | int], options: TextOptions = AS_SEEN) -> Found:
    """The named columns of a file; whatever a reader's library raises becomes one line."""
    kind = format_of(path)
    if kind is None:
        raise RecordingError(f"cannot read '{path.suffix}' files; use one of: {', '.join(FORMATS)}")
    if options.given() and not kind.text:
        raise RecordingError(
            f"{options.given()[0]}: this key is for text files, and '{path.suffix}' is none; remove it"
        )
    numbers = [name for name in names if isinstance(name, int)]
    if numbers and not kind.text:
        raise RecordingError(f"column {numbers[0]}: numbers are for text files, give its name")
    try:
        refuse_disguise(path)
        wanted = list(dict.fromkeys(names))
        return kind.read(path, wanted, options) if kind.text else kind.read(path, wanted)
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


def count_samples(path: Path, names: Sequence[str | int]) -> int:
    """How many samples a file says that it holds of some columns, without reading them: zero where it does not say.

    **Raises:** `RecordingError` for a variable that must not be read. What else is wrong, `read_columns` says.
    """
    kind = format_of(path)
    try:
        return 0 if kind is None else kind.count(path, list(names))
    except (RecordingError, MemoryError):
        raise
    except Exception:
        return 0
