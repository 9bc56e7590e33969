"""What stands in a file: its columns by name, without their numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers import c3d, excel, hdf5, json_lines, mat, npz, parquet, rosbag, text
from jaximp.recordings.readers.disguise import refuse_disguise
from jaximp.recordings.readers.formats import FORMATS, format_of

SHAPES = {
    text.read: text.shapes, parquet.read: parquet.shapes, mat.read: mat.shapes, hdf5.read: hdf5.shapes,
    npz.read: npz.shapes, parquet.read_feather: parquet.shapes_of_feather, json_lines.read: json_lines.shapes,
    excel.read: excel.shapes, c3d.read: c3d.shapes, rosbag.read: rosbag.shapes,
}  # fmt: skip
"""By the reader of a format."""


def columns_in(path: Path) -> Mapping[str, int]:
    """The columns of a file, each with how many it holds: a variable may hold one for every joint.

    **Raises:** `FileNotFoundError`; `RecordingError` for a file of another kind.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file; check the path")
    kind = format_of(path)
    if kind is None or kind.read not in SHAPES:
        known = [extension for extension, one in FORMATS.items() if one.read in SHAPES]
        raise RecordingError(
            f"{path}: cannot look into '{path.suffix}' files, but into {', '.join(known)}: write the job by hand"
        )
    try:
        refuse_disguise(path)
        found = SHAPES[kind.read](path)
    except (RecordingError, MemoryError) as error:
        raise type(error)(f"{path}: {error}") from None
    except Exception as error:
        raise RecordingError(
            f"{path}: cannot be read as {path.suffix} ({' '.join(str(error).split())[:100]})"
        ) from None
    longest = max((max(shape, default=0) for shape in found.values()), default=0)
    # A file of a channel's numbers may hold settings, too: what is much shorter is no channel.
    return {name: min(shape[:2], default=1) if len(shape) > 1 else 1
            for name, shape in found.items() if not shape or 2 * max(shape) > longest}  # fmt: skip
