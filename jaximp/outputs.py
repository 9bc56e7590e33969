"""Output folders that are either finished or not there."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

MARK = ".jaximp"
"""A file in every folder that jaximp made: `--force` replaces only such folders."""


@contextmanager
def new_folder(path: str | Path, force: bool = False) -> Iterator[Path]:
    """A folder to write into, which takes its name `path` only when everything in it is written.

    **Raises:** `ValueError` if `path` exists and `force` is off, if it is something that jaximp did not make, or if it
    cannot be written.
    """
    path = Path(path)
    _check_replaceable(path, force)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        draft = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    except OSError as error:
        raise ValueError(f"{path} cannot be written: {error.strerror}; choose another --out") from None
    try:
        draft.chmod(0o777 & ~_umask())
        (draft / MARK).touch()
        yield draft
        _take_name(draft, path)
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise


def _check_replaceable(path: Path, force: bool) -> None:
    if not os.path.lexists(path):
        return
    if not force:
        raise ValueError(f"{path} exists: choose another --out, or pass --force to replace it")
    ours = path.is_dir() and not path.is_symlink() and ((path / MARK).exists() or not any(path.iterdir()))
    if not ours:
        raise ValueError(f"{path} was not made by jaximp, so --force will not replace it: choose another --out")


def _take_name(draft: Path, path: Path) -> None:
    """Rename; an older folder steps aside first and is deleted last."""
    aside = None
    if path.exists():
        aside = Path(tempfile.mkdtemp(prefix=f".{path.name}.old.", dir=path.parent))
        os.replace(path, aside / "old")
    os.replace(draft, path)
    if aside is not None:
        shutil.rmtree(aside, ignore_errors=True)


def _umask() -> int:
    value = os.umask(0)
    os.umask(value)
    return value
