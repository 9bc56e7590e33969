"""Output folders that are either finished or not there."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

MARK = ".jaximp"
"""A file in every folder that jaximp made: `--force` replaces only such folders."""
UNFINISHED = ".unfinished"
"""How the name of a file ends until it is whole."""


def write_whole(path: Path, content: bytes) -> None:
    """A file that appears whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.{os.getpid()}{UNFINISHED}")
    try:
        with unfinished.open("wb") as file:
            file.write(content)
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


@contextmanager
def new_folder(path: str | Path, force: bool = False, inputs: Sequence[Path] = ()) -> Iterator[Path]:
    """A folder to write into, which takes its name `path` only when everything in it is written.

    **Arguments:** `force` replaces a folder that jaximp made; `inputs` are files that it must not hold then.

    **Raises:** `ValueError` if `path` exists and `force` is off, if it is something that jaximp did not make or that
    holds an input, or if it cannot be written.
    """
    path = Path(path)
    _check_replaceable(path, force, inputs)
    made = [parent for parent in path.absolute().parents if not parent.exists()]
    draft = None
    try:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            draft = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        except OSError as error:
            raise ValueError(f"{path} cannot be written: {error.strerror}; choose another --out") from None
        draft.chmod(0o777 & ~_umask())
        (draft / MARK).touch()
        yield draft
        _check_replaceable(path, force, inputs)  # it may have appeared meanwhile
        _take_name(draft, path)
    except BaseException:
        if draft is not None:
            shutil.rmtree(draft, ignore_errors=True)
        with suppress(OSError):
            for parent in made:
                parent.rmdir()
        raise


def _check_replaceable(path: Path, force: bool, inputs: Sequence[Path]) -> None:
    if not os.path.lexists(path):
        return
    if not force:
        raise ValueError(f"{path} exists: choose another --out, or pass --force to replace it")
    ours = path.is_dir() and not path.is_symlink() and ((path / MARK).exists() or not any(path.iterdir()))
    if not ours:
        raise ValueError(f"{path} was not made by jaximp, so --force will not replace it: choose another --out")
    for name in inputs:
        if path.resolve() in name.resolve().parents:
            raise ValueError(
                f"{path} holds the input {name.name}, so --force will not replace it: choose another --out"
            )


def _take_name(draft: Path, path: Path) -> None:
    """Rename; an older folder steps aside first and is deleted last."""
    aside = None
    if path.exists():
        aside = Path(tempfile.mkdtemp(prefix=f".{path.name}.old.", dir=path.parent))
        os.replace(path, aside / "old")
    try:
        os.replace(draft, path)
    except OSError:
        if aside is not None:
            os.replace(aside / "old", path)
            aside.rmdir()
        raise
    if aside is not None:
        shutil.rmtree(aside, ignore_errors=True)


def _umask() -> int:
    value = os.umask(0)
    os.umask(value)
    return value
