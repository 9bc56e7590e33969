"""Numbers, names and units as people read them, in figures, tables and pages."""

from __future__ import annotations

import math
from collections.abc import Sequence

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float, digits: int = 4) -> str:
    """A number for people: `6.33×10⁻⁵` where a computer writes 6.33e-05, and a dash where there is none."""
    if not math.isfinite(value):
        return "–"
    mantissa, _, exponent = f"{value:.{digits}g}".partition("e")
    mantissa = mantissa.replace("-", "−")
    return f"{mantissa}×10{str(int(exponent)).translate(SUPERSCRIPTS)}" if exponent else mantissa


def percent(share: float | None) -> str:
    """A share in per cent, and a dash where there is none."""
    return "–" if share is None else f"{number(100 * share, 3)}\N{NO-BREAK SPACE}%"


def with_unit(name: str, unit: str) -> str:
    """A parameter as figures and tables call it, such as `offset torque (N m)`."""
    return f"{words(name)} ({pretty_unit(unit)})"


def words(name: str) -> str:
    """The name of a parameter without its underscores."""
    return name.replace("_", " ").replace(".", " ")


def pretty_unit(unit: str) -> str:
    """A unit with its exponents raised."""
    return unit.replace("^2", "²")


def main_parameter(names: Sequence[str]) -> str:
    """The parameter that stands for all where only one is shown: the stiffness, else the first."""
    stiffness = [name for name in names if name.endswith("stiffness")]
    return next(iter([*stiffness, *(name for name in names if name.startswith("stiffness_"))]), names[0])
