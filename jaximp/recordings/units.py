"""Units at the border: channels become SI at the joint when they are read, and are SI from then on."""

from __future__ import annotations

import math
import re
from functools import lru_cache
from typing import Any

import numpy as np

from jaximp.recordings.channels import Signal
from jaximp.recordings.errors import RecordingError
from jaximp.recordings.mapping import Source, is_number
from jaximp.recordings.named_units import Said, spelled, unit_in
from jaximp.recordings.readers.found import Found
from jaximp.types import Numbers

_SI = {
    "revolute": {"position": "rad", "velocity": "rad/s", "acceleration": "rad/s^2", "torque": "N m", "command": "N m"},
    "prismatic": {"position": "m", "velocity": "m/s", "acceleration": "m/s^2", "torque": "N", "command": "N"},
}
_UNIT = re.compile(r"(1|[A-Za-zµμ°Ω%_]+)((\^|\*\*)-?\d)?([ ·*/]+(1|[A-Za-zµμ°Ω%_]+)((\^|\*\*)-?\d)?)*")
"""Names of units with small exponents, and what may stand between them."""


def to_si(
    channel: str,
    signal: Signal,
    source: Source,
    joints: tuple[str, ...],
    gear_ratio: float,
    found: Found | None = None,
) -> tuple[Signal, list[str]]:
    """The channel in SI units at the joint, and notes on units that were taken from the file (`found`)."""
    if not is_number(gear_ratio) or not 0 < gear_ratio < math.inf:
        raise RecordingError(f"gear_ratio must be a positive number, not {gear_ratio!r}")
    gear = {"torque": gear_ratio, "command": gear_ratio, "force": 1.0, "time": 1.0, "sample_rate": 1.0}.get(
        channel, 1 / gear_ratio
    )
    # A force may have more columns than there are joints; for the other channels `assemble` reports a wrong count.
    kinds = [joints[min(i, len(joints) - 1)] for i in range(len(signal.labels))]
    units = [si_unit(channel, kind) for kind in kinds]
    columns = [
        _Column(channel, label, unit, found or Found({})) for label, unit in zip(signal.labels, units, strict=True)
    ]
    factors, notes = zip(*(_unit_factor(source, column) for column in columns), strict=True)
    with np.errstate(over="ignore", invalid="ignore"):
        factor = np.array(factors) * source.sign * _for_each(channel, "gain", source.gain or (1.0,), signal) * gear
        values = signal.values * factor
    error = source.gain_error
    if error is not None:
        _for_each(channel, "gain_error", error.each, signal)
    covariance = None if error is None else error.covariance(len(signal.labels))
    noise = None if source.noise is None else float(source.noise * np.abs(factor).max())
    return Signal(signal.labels, values, source.delay, noise, covariance), list(dict.fromkeys(filter(None, notes)))


def _for_each(channel: str, key: str, given: tuple[float, ...], signal: Signal) -> Numbers:
    """Of every column, where there is one number for all or one for each."""
    if len(given) not in (1, len(signal.labels)):
        raise RecordingError(
            f"{channel}: {key} lists {len(given)} numbers for {len(signal.labels)} columns: give one, or one for each"
        )
    return np.broadcast_to(given, len(signal.labels))


def si_unit(channel: str, joint: str) -> str:
    """The unit of a channel (or of `time`, `sample_rate`) at a joint of this type."""
    fixed = {"time": "s", "sample_rate": "Hz", "force": "N"}
    return fixed.get(channel) or _SI[joint]["position" if channel == "reference" else channel]


class _Column:
    """One column, the unit that it shall have, and what the file says of the one it has."""

    def __init__(self, channel: str, label: str, target: str, found: Found) -> None:
        self.channel, self.target = channel, target
        bare = re.sub(r"\[\d+\]$", "", label)
        asked = {str(key): key for key in (*found.values, *found.names, *found.units)}
        key = asked.get(label, asked.get(bare, bare))
        self.column = key
        self.name = found.names.get(key, bare)
        text = found.units.get(key, "")
        self.where = f"the file gives column {self.name!r} in" if text else f"the name of column {self.name!r} says"
        self.said = Said(text, spelled(text)) if text.strip(" -1#") else unit_in(self.name)
        if found.angles and self.said is None and channel in ANGULAR and target.startswith("rad"):
            unit = target.replace("rad", found.angles)
            self.said, self.where = Said(unit, unit), "the file says that its angles are in"

    def line(self, rest: str) -> str:
        """What to write into the mapping."""
        column = self.column if isinstance(self.column, int) else f'"{self.column}"'
        return f"{self.channel} = {{column = {column}, {rest}}}"


ANGULAR = ("position", "velocity", "acceleration", "reference")
"""Channels that are angles, or their derivatives, at a revolute joint."""


def _unit_factor(source: Source, column: _Column) -> tuple[float, str]:
    """What brings a column (times the unit of its gain) to the unit that it shall have, and a note."""
    channel, target, said = column.channel, column.target, column.said
    if source.unit is not None and source.gain is None:
        factor = _conversion(channel, target, source.unit)
        _refuse_contradiction(source, column, factor)
        return factor, ""
    if source.gain_unit is not None:
        named = said.unit if source.unit is None and said is not None else None
        if named is not None:
            try:
                return _conversion(channel, target, named, source.gain_unit), _taken(column, named)
            except RecordingError:
                pass
        return _conversion(channel, target, source.unit or "dimensionless", source.gain_unit), ""
    if source.unit is not None or said is None or said.unit == target or source.despite_name:
        return _conversion(channel, target, source.unit or target), ""
    return _by_name(source, column, said)


def _by_name(source: Source, column: _Column, said: Said) -> tuple[float, str]:
    """The factor of the unit that a name says, and a note; refused where that cannot be meant."""
    channel, target = column.channel, column.target
    if said.unit is None:
        if len(said.text) > 3 and said.text.replace(" ", "").isalpha():
            return (
                1.0,
                f"{channel}: '{said.text}' of column {column.name!r} is taken for no unit: it is read in '{target}'",
            )
        raise RecordingError(
            f"{channel}: {column.where} '{said.text}', which is no unit that is known; state it: "
            + column.line(f'unit = "{target}"')
        )
    if source.gain is not None:
        raise RecordingError(
            f"{channel}: {column.where} '{said.unit}', and a gain without a unit gives what? State the unit "
            "of the product: " + column.line(f'gain = {source.gain[0]:g}, unit = "{target}"')
        )
    try:
        factor = _conversion(channel, target, said.unit)
    except RecordingError:
        how = f'gain = "0.00153 {target}"' if said.unit == "count" else f'gain = "1.5 ({target})/{said.unit}"'
        remedy = column.line(f'unit = "{said.unit}"') if _same_kind(said.unit, target) else column.line(how)
        raise RecordingError(
            f"{channel}: {column.where} '{said.unit}', but without a unit it would be read in '{target}'; state the "
            f'unit ("{target}"), or how much one is: {remedy}'
        ) from None
    return factor, _taken(column, said.unit)


def _same_kind(unit: str, target: str) -> bool:
    return unit.startswith(target[:3])


def _taken(column: _Column, unit: str) -> str:
    return f"{column.channel}: {column.where} '{unit}': taken as that"


def _refuse_contradiction(source: Source, column: _Column, factor: float) -> None:
    """A name that says degrees and a mapping that says radians: one of them is wrong."""
    said = column.said
    if said is None or said.unit is None or source.despite_name:
        return
    try:
        named = _conversion(column.channel, column.target, said.unit)
    except RecordingError:
        return
    if not math.isclose(named, factor, rel_tol=1e-9):
        raise RecordingError(
            f"{column.channel}: {column.where} '{said.unit}', and the mapping '{source.unit}'; write "
            f'unit = "{said.unit}", or if the name is wrong: '
            + column.line(f'unit = "{source.unit}", despite_name = true')
        )


@lru_cache(maxsize=256)
def _conversion(channel: str, target: str, *units: str) -> float:
    """The factor from the product of `units` to `target`. Plain spellings of `target` do not need pint."""
    units = tuple(spelled(unit) or unit for unit in units)
    if len(units) == 1 and units[0].replace("Nm", "N m").replace("N*m", "N m").replace("**", "^") == target:
        return 1.0
    registry = _unit_registry()
    product = registry.Quantity(1.0)
    if units == ("count",):
        raise RecordingError(f'{channel}: how much is a count? Write it as a gain: gain = "0.00153 {target}"')
    for unit in units:
        try:
            # The pattern keeps everything but units and small exponents away from pint's expression parser.
            if not _UNIT.fullmatch(re.sub("[()]", "", unit)):
                raise ValueError
            product = product * registry.Quantity(1.0, registry.parse_units(unit))
        except Exception:
            raise RecordingError(
                f"{channel}: unknown unit {unit!r}; expected a unit of '{target}', or one that converts to it"
            ) from None
    # pint counts radians as 1 and would take Hz for rad/s; root units keep the radian and tell them apart.
    if product.to_root_units().units != registry.Quantity(1.0, target).to_root_units().units:
        raise RecordingError(f"{channel}: unit '{' * '.join(units)}' does not convert to '{target}'; correct the unit")
    return float(product.to(target).magnitude)


@lru_cache(maxsize=1)
def _unit_registry() -> Any:
    import pint

    registry: Any = pint.UnitRegistry(cache_folder=None)
    registry.define("Nm = newton * meter")
    return registry
