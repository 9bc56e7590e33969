"""Times of day and dates (ISO 8601 and its like) -> seconds from the first one."""

from __future__ import annotations

import datetime
import re
from collections.abc import Sequence

import numpy as np

from jaximp.recordings.errors import RecordingError
from jaximp.recordings.readers.found import COUNTED_FROM
from jaximp.types import Numbers

_TIME = re.compile(
    r"(?:(?P<date>\S+)[ T])?(?P<hour>\d{1,2}):(?P<minute>\d{2})(?::(?P<second>\d{1,2}))?"
    r"(?:[.,](?P<fraction>\d{1,9})\d*)?"
    r" ?(?P<half>[AaPp])?\.?(?:[Mm]\.?)?(?P<zone>Z|[+-]\d{2}:?\d{2})?"
)
DAY = 86400 * 10**9
HALF_DAY = DAY // 2


def is_time(text: str) -> bool:
    return _TIME.fullmatch(text) is not None


def seconds_of(label: str, texts: Sequence[str | None]) -> tuple[Numbers, str]:
    """(N,) seconds from the first time, NaN where there is none, and a note.

    Nanoseconds are counted as whole numbers, so that every stamp is as exact as it is written. A time of day without a
    date that falls by more than half a day has passed midnight.
    """
    stamps = [None if text is None else _nanoseconds(label, text) for text in texts]
    known = [stamp for stamp in stamps if stamp is not None]
    if not known:
        return np.full(len(texts), np.nan), ""
    first, days, before = known[0], 0, known[0]
    seconds = np.full(len(texts), np.nan)
    dated = any(text is not None and (" " in text.strip() or "T" in text) for text in texts[:1])
    for k, stamp in enumerate(stamps):
        if stamp is None:
            continue
        if not dated and stamp < before - HALF_DAY:
            days += 1
        before = stamp
        seconds[k] = (stamp - first + days * DAY) / 1e9
    midnight = f", past midnight {days} times" if days else ""
    start = next(text for text in texts if text is not None)
    return seconds, f"{label!r} holds times of day: {COUNTED_FROM} {start}{midnight}"


def _nanoseconds(label: str, text: str) -> int:
    found = _TIME.fullmatch(text)
    if found is None:
        raise RecordingError(
            f"column {label!r}: {text!r} is no time of day as the first one is; repair or remove the row"
        )
    hour, minute = int(found["hour"]), int(found["minute"])
    if found["second"] is None:
        # 02:13.5 are minutes and seconds; 12:30 may be either.
        if found["fraction"] is None:
            raise RecordingError(
                f"column {label!r}: {text!r} has no seconds (or are these minutes and seconds?); write 12:30:00.000, "
                "or give sample_rate in place of time"
            )
        hour, minute, second = 0, hour, minute
    else:
        second = int(found["second"])
    if found["half"]:
        hour = hour % 12 + 12 * (found["half"] in "Pp")
    if hour > 24 or minute > 59 or second > 60:
        raise RecordingError(f"column {label!r}: {text!r} is no time of day; repair or remove the row")
    fraction = int((found["fraction"] or "0").ljust(9, "0"))
    return ((hour * 60 + minute) * 60 + second) * 10**9 + fraction + DAY * _day(label, found["date"]) - _shift(found)


def _shift(found: re.Match[str]) -> int:
    """What an offset from UTC adds to the clock."""
    zone = found["zone"]
    if not zone or zone == "Z":
        return 0
    minutes = int(zone[1:3]) * 60 + int(zone[-2:])
    return (-1 if zone[0] == "-" else 1) * minutes * 60 * 10**9


def _day(label: str, date: str | None) -> int:
    """Of a date. Of one whose day and month cannot be told apart only the order of days matters, which is refused."""
    if not date:
        return 0
    iso = re.fullmatch(r"(\d{4})[-/.](\d{1,2})[-/.](\d{1,2})", date)
    german = re.fullmatch(r"(\d{1,2})\.(\d{1,2})\.(\d{4})", date)
    slashed = re.fullmatch(r"(\d{1,2})/(\d{1,2})/(\d{4})", date)
    try:
        if iso:
            return datetime.date(*map(int, iso.groups())).toordinal()
        if german:
            return datetime.date(*map(int, reversed(german.groups()))).toordinal()
        if slashed:
            one, other, year = map(int, slashed.groups())
            # A recording lasts minutes: across midnight the day changes by one, whichever number it is.
            return datetime.date(year, 1, 1).toordinal() + (one + other)
    except ValueError:
        pass
    raise RecordingError(f"column {label!r}: the date {date!r} is not understood; write 2024-03-01T12:00:00.000")
