"""Settings from TOML: every key and value is checked, and a misspelt key gets the nearest known one named."""

from __future__ import annotations

import tomllib
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

from jaximp.types import nearest

T = TypeVar("T")


def read(path: str | Path, parse: Callable[[str, Path], T]) -> T:
    path = Path(path)
    try:
        return parse(path.read_text(encoding="utf-8"), path.parent)
    except FileNotFoundError:
        raise ValueError(f"{path}: there is no such job file; check the path") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: this is not a TOML file: {error}") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def optional(kind: type[T], value: Any, where: str) -> T | None:
    """`true` is the model as it comes, a table the model with some settings, `false` none."""
    if value is False:
        return None
    return settings(kind, {} if value is True else value, where)


def settings(kind: type[T], table: Any, where: str) -> T:
    """Make a dataclass from a TOML table, with every key and type checked."""
    if not isinstance(table, dict):
        raise ValueError(f"[{where}] must be a table")
    hints = typing.get_type_hints(kind)
    check_keys(table, list(hints), f"[{where}]")
    for setting in fields(kind):  # type: ignore[arg-type]
        if setting.default is MISSING and setting.default_factory is MISSING and setting.name not in table:
            raise ValueError(f"[{where}] has no '{setting.name}': add it")
    return kind(**{key: checked(value, hints[key], f"{where}.{key}") for key, value in table.items()})


def checked(value: Any, hint: Any, where: str) -> Any:
    """The value with the type that is wanted: whole numbers pass as floats, nothing else is converted."""
    if typing.get_origin(hint) is tuple:
        if isinstance(value, list) and all(type(item) is str for item in value):
            return tuple(value)
        raise ValueError(f"{where} is {value!r}: it must be a list of names")
    choices = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    for choice in choices:
        if typing.get_origin(choice) is list and isinstance(value, list):
            return [checked(item, typing.get_args(choice)[0], where) for item in value]
        if typing.get_origin(choice) is dict and isinstance(value, dict):
            kind = typing.get_args(choice)[1]
            return {key: checked(item, kind, f"{where}.{key}") for key, item in value.items()}
        if is_dataclass(choice) and isinstance(value, dict):
            return settings(typing.cast(type, choice), value, where)
        if type(value) is choice:
            return value
        if choice is float and type(value) is int:
            return float(value)
    expected: dict[Any, str | None] = {
        float: "a number",
        list[float]: "a list of numbers",
        list[int]: "a list of whole numbers",
        list[list[float]]: "a list of vectors",
        list[str]: "a list of text",
        dict[str, float]: "a table of numbers",
        int: "a whole number",
        bool: "true or false",
        str: "text",
        type(None): None,
    }
    names = " or ".join(name for choice in choices if (name := expected.get(choice, "a table")))
    raise ValueError(f"{where} is {value!r}: it must be {names}")


def check_keys(table: Mapping[str, Any], known: list[str], where: str) -> None:
    for key in table:
        if key not in known:
            raise ValueError(f"{where} has an unknown key '{key}': {nearest(key, known)}")
