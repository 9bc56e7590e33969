"""Files that are not what they are called: pointers, web pages, empty ones, files of another kind."""

from __future__ import annotations

import os
import re
from pathlib import Path

from jaximp.recordings.errors import RecordingError, UnavailableError

LOOK = 4096
"""Bytes that show what a file is."""
KINDS = {
    b"\x89HDF\r\n\x1a\n": ("an HDF5 file", (".h5", ".hdf5", ".mat", ".nc", ".hdf")),
    b"PAR1": ("a Parquet file", (".parquet",)),
    b"ARROW1": ("a Feather file", (".feather", ".arrow")),
    b"MATLAB 5.0": ("a MATLAB file", (".mat",)),
    b"PK\x03\x04": ("a ZIP archive (or an Excel workbook)", (".npz", ".xlsx", ".xlsm", ".ods", ".zip")),
    b"\xd0\xcf\x11\xe0": ("an old Excel workbook", (".xls",)),
    b"\x1f\x8b": ("a gzip archive", (".gz",)),
    b"\x93NUMPY": ("one array of numpy", (".npy",)),
    b"%PDF": ("a PDF document", (".pdf",)),
    b"\x89PNG": ("a picture", (".png",)),
    b"#ROSBAG": ("a ROS bag", (".bag",)),
    b"\x89MCAP": ("an MCAP file", (".mcap",)),
    b"SQLite format 3": ("a database", (".db3", ".sqlite", ".db")),
}
"""By their first bytes: what they are, and how they are called."""


def refuse_disguise(path: Path) -> None:
    """**Raises:** `RecordingError` for a file that cannot be of the kind that its name says."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(LOOK)
    if head.startswith(b"version https://git-lfs.github.com/spec"):
        claimed = re.search(rb"\nsize (\d+)", head)
        of = f" ({int(claimed[1]) / 1e6:.1f} MB)" if claimed else ""
        raise UnavailableError(f"is a Git LFS pointer, not the file{of}: run git lfs pull")
    if head.startswith(b"../.git/annex/") or b"/annex/objects/" in head[:200]:
        raise UnavailableError("is a git-annex pointer, not the file: run git annex get")
    start = head.lstrip(b"\xef\xbb\xbf \r\n\t").lower()
    if start.startswith((b"<!doctype html", b"<html", b"<head")):
        raise RecordingError("is a web page, not the file: the download gave an error or asks to sign in; load it anew")
    if size == 0:
        if path.suffix.lower() not in (".csv", ".txt", ".tsv"):
            raise RecordingError(f"cannot be read as {path.suffix}: it is empty (0 bytes); write or copy it anew")
        return
    if size > 16 and not head.strip(b"\0"):
        raise RecordingError("holds zeros alone: it was not written to the end (or not downloaded yet); copy it anew")
    _refuse_other_kind(path, head)


def _refuse_other_kind(path: Path, head: bytes) -> None:
    extension = path.suffix.lower()
    for mark, (what, called) in KINDS.items():
        if head.startswith(mark) and extension not in called:
            raise RecordingError(
                f"cannot be read as {path.suffix}: it is {what}, whatever its name says; call it "
                f"{os.path.basename(path.with_suffix(called[0]))} or export it as CSV"
            )
