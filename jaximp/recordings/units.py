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
from jaximp.types import Numbers

_SI = {
    "revolute": {"position": "rad", "velocity": "rad/s", "acceleration": "rad/s^2", "torque": "N m", "command": "N m"},
    "prismatic": {"position": "m", "velocity": "m/s", "acceleration": "m/s^2", "torque": "N", "command": "N"},
}
SUFFIXES = {
    **{unit: unit for unit in ("deg", "mrad", "rad", "mm", "cm", "m", "s", "ms", "us", "N", "V", "Hz", "kHz", "rpm")},
    **{"Nm": "N m", "mNm": "mN m", "rad_s": "rad/s", "deg_s": "deg/s", "m_s": "m/s", "mm_s": "mm/s"},
    **{"rad_s2": "rad/s^2", "deg_s2": "deg/s^2", "m_s2": "m/s^2"},
}
"""What the end of a column's name says about its unit: `knee_deg`. Also names the columns that we write."""

_UNIT = re.compile(r"(1|[A-Za-zµμ°Ω%_]+)((\^|\*\*)-?\d)?([ ·*/]+(1|[A-Za-zµμ°Ω%_]+)((\^|\*\*)-?\d)?)*")
"""Names of units with small exponents, and what may stand between them."""


def to_si(channel: str, signal: Signal, source: Source, joints: tuple[str, ...], gear_ratio: float) -> Signal:
    """The channel in SI units at the joint."""
    if not is_number(gear_ratio) or not 0 < gear_ratio < math.inf:
        raise RecordingError(f"gear_ratio must be a positive number, not {gear_ratio!r}")
    gear = {"torque": gear_ratio, "command": gear_ratio, "force": 1.0, "time": 1.0, "sample_rate": 1.0}.get(
        channel, 1 / gear_ratio
    )
    # A force may have more columns than there are joints; for the other channels `assemble` reports a wrong count.
    kinds = [joints[min(i, len(joints) - 1)] for i in range(len(signal.labels))]
    units = [si_unit(channel, kind) for kind in kinds]
    factors = [_unit_factor(channel, source, *pair) for pair in zip(signal.labels, units, strict=True)]
    with np.errstate(over="ignore"):
        factor = np.array(factors) * source.sign * _for_each(channel, "gain", source.gain or (1.0,), signal) * gear
        values = signal.values * factor
    error = source.gain_error
    if error is not None:
        _for_each(channel, "gain_error", error.each, signal)
    covariance = None if error is None else error.covariance(len(signal.labels))
    noise = None if source.noise is None else float(source.noise * np.abs(factor).max())
    return Signal(signal.labels, values, source.delay, noise, covariance)


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


def _unit_factor(channel: str, source: Source, label: str, target: str) -> float:
    """What brings a column (times the unit of its gain) to the unit `target`."""
    if source.unit is None and source.gain is None:
        _check_suffix(channel, re.sub(r"\[\d+\]$", "", label), target)
    if source.gain_unit is None:
        return _conversion(channel, target, source.unit or target)
    return _conversion(channel, target, source.unit or "dimensionless", source.gain_unit)


def _check_suffix(channel: str, column: str, target: str) -> None:
    """Refuse to read `knee_deg` in radians because nobody said otherwise."""
    suffix = max((suffix for suffix in SUFFIXES if column.endswith("_" + suffix)), key=len, default=None)
    if suffix and SUFFIXES[suffix] != target:
        raise RecordingError(
            f"{channel}: the name of column {column!r} says '{SUFFIXES[suffix]}', but without a unit it would be read "
            f'in \'{target}\'; state the unit: {channel} = {{column = "{column}", unit = "{SUFFIXES[suffix]}"}}'
        )


@lru_cache(maxsize=256)
def _conversion(channel: str, target: str, *units: str) -> float:
    """The factor from the product of `units` to `target`. Plain spellings of `target` do not need pint."""
    if len(units) == 1 and units[0].replace("Nm", "N m").replace("N*m", "N m").replace("**", "^") == target:
        return 1.0
    registry = _unit_registry()
    product = registry.Quantity(1.0)
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
