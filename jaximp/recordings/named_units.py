"""Units that stand in a column's name, as people write them there: `angle (deg)`, `torque [mNm]`, `Time (ms)`,
`knee_deg`, `angleDeg`."""

from __future__ import annotations

import re
from dataclasses import dataclass

SUFFIXES = {
    **{unit: unit for unit in ("deg", "mrad", "rad", "mm", "cm", "m", "s", "ms", "us", "N", "V", "Hz", "kHz", "rpm")},
    **{
        "Nm": "N m",
        "mNm": "mN m",
        "kNm": "kN m",
        "Nmm": "N mm",
        "Ncm": "N cm",
        "rad_s": "rad/s",
        "deg_s": "deg/s",
        "m_s": "m/s",
        "mm_s": "mm/s",
    },
    **{"rad_s2": "rad/s^2", "deg_s2": "deg/s^2", "m_s2": "m/s^2"},
}
"""What the end of a column's name says about its unit: `knee_deg`. Also names the columns that we write."""
SPELLINGS = {
    **dict.fromkeys(("deg", "degree", "degrees", "°", "º", "degs"), "deg"),
    **dict.fromkeys(("rad", "radian", "radians", "rads"), "rad"),
    **dict.fromkeys(("rev", "revs", "turn", "turns", "revolution", "revolutions", "rot"), "turn"),
    **dict.fromkeys(("count", "counts", "cts", "tick", "ticks", "lsb", "pulses", "inc", "increments"), "count"),
    **dict.fromkeys(("Nm", "N m", "N.m", "N·m", "N⋅m", "N*m", "N-m", "Newton-meter", "Newton meters", "NM"), "N m"),
    **dict.fromkeys(("mNm", "mN m", "mN.m", "mN·m", "mN*m", "mN-m"), "mN m"),
    **dict.fromkeys(("Nmm", "N mm", "N.mm", "N·mm", "N*mm", "N-mm"), "N mm"),
    **dict.fromkeys(("Ncm", "N cm", "N.cm", "N·cm", "N*cm", "N-cm"), "N cm"),
    **dict.fromkeys(("kNm", "kN m", "kN·m", "kN*m"), "kN m"),
    **dict.fromkeys(("ft-lb", "ft-lbs", "ft lb", "ft.lb", "lbf ft", "lb-ft", "ft*lbf", "ft-lbf"), "foot * force_pound"),
    **dict.fromkeys(("in-lb", "in-lbs", "lbf in", "in lb", "lb-in", "in-lbf"), "inch * force_pound"),
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("us", "µs", "μs", "usec", "microseconds"), "us"),
    **dict.fromkeys(("ns", "nsec", "nanoseconds"), "ns"),
    **dict.fromkeys(("min", "minutes"), "min"),
    **dict.fromkeys(("°/s", "deg/s", "degrees/s", "deg/sec", "deg s^-1", "dps", "deg.s-1"), "deg/s"),
    **dict.fromkeys(("rad/s", "rad/sec", "rad s^-1", "rad·s^-1", "rad.s-1"), "rad/s"),
    **dict.fromkeys(("°/s^2", "°/s²", "deg/s^2", "deg/s2", "deg/s²", "deg/s/s"), "deg/s^2"),
    **dict.fromkeys(("rad/s^2", "rad/s2", "rad/s²", "rad/s/s"), "rad/s^2"),
    **dict.fromkeys(("m/s^2", "m/s2", "m/s²"), "m/s^2"),
    **dict.fromkeys(("N", "Newton", "newtons"), "N"),
    **dict.fromkeys(("lbf", "lb", "lbs"), "force_pound"),
    **{
        one: one
        for one in ("m", "mm", "cm", "mrad", "m/s", "mm/s", "kN", "mN", "V", "mV", "A", "mA", "Hz", "kHz", "rpm")
    },
    **{"um": "um", "µm": "um", "μm": "um", "%": "percent", "g": "g", "kg": "kg"},
}
"""How units are written in files, and what pint calls them."""
_CAMEL = re.compile(
    r"(?<=[a-z0-9])(Ms)$|(?<=[a-z0-9_.\-/:])([Dd]egrees|[Dd]egree|Deg|[Rr]adians|[Rr]adian|Rad|mNm|kNm|Nmm|Ncm|Nm|Rpm)$"
)
"""The unit begins where the name of the quantity ends: the Nm of `torque_mNm` are no newton metres."""
_WORDS = ("deg", "degrees", "rad", "radians", "Nm", "mNm", "kNm", "Nmm", "Ncm", "ms", "rpm", "seconds", "milliseconds")


@dataclass(frozen=True)
class Said:
    """What a name (or a row of units) says of a column's unit."""

    text: str
    """As it is written."""
    unit: str | None
    """As pint writes it; None where it is no unit that is known."""


def spelled(text: str) -> str | None:
    """A unit as pint writes it; None if it is not one of the usual spellings."""
    text = text.strip()
    return SPELLINGS.get(text) or SPELLINGS.get(text.lower() if len(text) > 2 else text)


def unit_in(name: str) -> Said | None:
    """What a column's name says of its unit; None if it says nothing."""
    brackets = [
        text.strip() for pair in re.findall(r"\[([^\[\]]*)\]|\(([^()]*)\)", name) for text in pair if text.strip()
    ]
    brackets = [text for text in brackets if not re.fullmatch(r"[\d:, ]+", text)]
    for text in reversed(brackets):
        if spelled(text):
            return Said(text, spelled(text))
    if brackets and name.rstrip().endswith(("]", ")")):
        return Said(brackets[-1], None)
    if name.rstrip().endswith("°"):
        return Said("°", "deg")
    behind = re.search(r"\s[/,]\s*(\S+)$|\s(\S+)$", name)
    word = (behind[1] or behind[2]) if behind else ""
    if word and (spelled(word) if behind and behind[1] else word in _WORDS):
        return Said(word, spelled(word))
    camel = _CAMEL.search(name)
    if camel:
        text = camel[1] or camel[2]
        return Said(text, spelled(text) or spelled(text.lower()))
    suffix = max((suffix for suffix in SUFFIXES if name.endswith("_" + suffix)), key=len, default=None)
    return Said(SUFFIXES[suffix], SUFFIXES[suffix]) if suffix else None
