"""What a reader hands over: columns, and what the file itself says of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Found:
    """Columns of a file, by the names that were asked for."""

    values: Mapping[Any, Any]
    names: Mapping[Any, str] = field(default_factory=dict)
    """What the file calls a column, where that is not how it was asked for: by its number, for example."""
    units: Mapping[Any, str] = field(default_factory=dict)
    """Units that the file states beside a column's name: in a row of units, or an attribute."""
    angles: str | None = None
    """The unit of all angles, where the file states one."""
    notes: tuple[str, ...] = ()
    """How the file was understood, as far as that is not obvious."""


COUNTED_FROM = "seconds are counted from"
"""How the note on a clock ends that begins with the file."""


@dataclass(frozen=True)
class TextOptions:
    """What a mapping says of a text file, in place of what would be seen in it."""

    header: int | None = None
    """The line that names the columns, from 1; 0 if there is none."""
    separator: str | None = None
    decimal: str | None = None
    encoding: str | None = None
    bad_lines: str | None = None
    """`"drop"` leaves out rows that cannot be read; else they are refused."""

    def given(self) -> list[str]:
        """The keys that are set."""
        return [key for key, value in vars(self).items() if value is not None]


AS_SEEN = TextOptions()
"""A text file about which nothing is said."""
