"""Samples as they come, brought onto an even grid: late ones, missing ones, twice the same, a clock that is set anew.

Nothing is interpolated here. Every sample is used or counted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import NamedTuple

import numpy as np

from jaximp.live.front import Sample
from jaximp.types import Numbers

HALF = 0.5
"""A sample that is so many intervals off its place belongs to the next place."""
FOLLOWS = 0.1
"""Share of a stamp's error by which the grid follows it: a clock that runs 1 % fast stays within a tenth of a step."""
SET_BACK = 1.0
"""Seconds by which a sample can be late; one that is later comes from a clock that was set back."""
PAUSE = 1.0
"""Seconds without a sample that are an interruption."""
IN_A_ROW = 0.1
"""As many seconds of late samples, one after the other, come from such a clock too."""


class Batch(NamedTuple):
    """Samples as a source has them."""

    time: Numbers
    """(k,) stamps [s]."""
    position: Numbers
    """(k,) [rad or m]"""
    torque: Numbers
    """(k,) [N m or N]"""


NOTHING = Batch(np.empty(0), np.empty(0), np.empty(0))


class Slots(NamedTuple):
    """Places of the grid, one after the other."""

    time: Numbers
    """(k,) [s]: stamps, and of a missing sample when it should have come."""
    sample: Sample
    """(k,)"""


@dataclass
class Counts:
    """What became of all samples. Each of those that were received stands in one of the lines below the first."""

    received: int = 0
    used: int = 0
    not_finite: int = field(default=0, metadata={"words": "without a number (NaN)"})
    late: int = field(default=0, metadata={"words": "too late, or out of order"})
    duplicate: int = field(default=0, metadata={"words": "twice the same"})
    unreadable: int = field(default=0, metadata={"words": "lines that could not be read"})
    overload: int = field(default=0, metadata={"words": "lost: they came faster than they could be kept"})
    missing: int = field(default=0, metadata={"words": "missing (never received)"})
    interruptions: int = field(default=0, metadata={"words": "interruptions of the source"})
    clock_jumps: int = field(default=0, metadata={"words": "jumps of its clock"})

    def in_words(self) -> str:
        """One line."""
        others = (
            f"{value} {one.metadata['words']}"
            for one in fields(self)
            if "words" in one.metadata and (value := getattr(self, one.name))
        )
        return "; ".join([f"{self.received} samples received, {self.used} used", *others])


class Clock:
    """The grid of one sample rate, from the first sample on."""

    def __init__(self, sample_rate: float, flush: int, longest: int | None = None):
        """**Arguments:** `sample_rate` [Hz]; after so many missing samples (`flush`) all that was before has left the
        filters: as many part what a clock that was set anew has parted; the `longest` gap that is filled, by default as
        many."""
        self.sample_rate, self.flush, self.longest = sample_rate, flush, flush if longest is None else longest
        self.counts = Counts()
        self.next = math.nan
        """When the next sample should come [s]."""
        self._last, self._behind = math.nan, 0

    def place(self, batch: Batch) -> Slots:
        """The places that a batch fills, with those that are missing before them."""
        found: list[tuple[float, float, float, bool]] = []
        for time, position, torque in zip(*(x.tolist() for x in batch), strict=True):
            self._take(found, time, position, torque)
        if not found:
            return Slots(np.empty(0), Sample(np.empty(0), np.empty(0), np.empty(0, bool)))
        times, q, tau, valid = (np.array(x) for x in zip(*found, strict=True))
        return Slots(times, Sample(q, tau, valid))

    def _take(self, found: list[tuple[float, float, float, bool]], time: float, q: float, torque: float) -> None:
        counts, rate = self.counts, self.sample_rate
        counts.received += 1
        if not math.isfinite(time):
            counts.not_finite += 1
            return
        if math.isnan(self.next):
            self.next = time
        ahead = (time - self.next) * rate
        if ahead < -HALF:
            self._behind += 1
            if -ahead <= SET_BACK * rate and self._behind < max(3, IN_A_ROW * rate):
                counts.duplicate += time == self._last
                counts.late += time != self._last
                return
            counts.clock_jumps += 1
            self._missed(found, self.flush)
            self.next = time
        elif ahead > HALF:
            gone = round(ahead)
            counts.missing += gone
            counts.interruptions += gone > PAUSE * rate
            self._missed(found, min(gone, self.longest))
            self.next = self.next + gone / rate if gone <= self.longest else time
        self._behind, self._last = 0, time
        self.next += 1 / rate + FOLLOWS * (time - self.next)
        valid = math.isfinite(q) and math.isfinite(torque)
        counts.used += valid
        counts.not_finite += not valid
        found.append((time, q if valid else 0.0, torque if valid else 0.0, valid))

    def _missed(self, found: list[tuple[float, float, float, bool]], count: int) -> None:
        found.extend((self.next + k / self.sample_rate, 0.0, 0.0, False) for k in range(count))


def rate_of(time: Numbers) -> float:
    """Samples per second of stamps, to three digits: gaps, and stamps that come in packets, hardly change it.

    **Raises:** `ValueError` for fewer than two stamps that increase.
    """
    steps = np.diff(time[np.isfinite(time)])
    steps = steps[steps > 0]
    if not len(steps):
        raise ValueError("the time stamps do not increase: give the sample rate, and a column of time in seconds")
    usual = np.median(steps)
    return float(f"{1 / steps[steps < 3 * usual].mean():.3g}")
