"""When a perturbation begins."""

from __future__ import annotations

import numpy as np

from jaximp.types import Numbers

NOISE = 6.0
"""A signal has left its steady state where it differs from it by so many standard deviations of its own noise."""
LEADING = 0.05
"""Share of a recording in which it is steady for certain, and ten samples at least."""
SILENT = 0.01
"""A command that stays below such a share of the largest one of all trials is none."""
STARTED = 0.1
"""A command whose first samples differ from its median by such a share of the largest one has begun already."""


def find_onset(signal: Numbers, least: float = 0.0) -> int | None:
    """Index of the last sample at which what moves the hand is still what it was at the beginning of the recording.

    **Arguments:** `signal` (N, n) a commanded force [N], a commanded position [m], or as well a motion that was
    measured; samples that are not finite are passed over. The beginning is its first `LEADING` share of finite samples,
    and the signal has left it where any column is `NOISE` standard deviations of that beginning away (a larger spread
    of one column counts for all), and stays so for three samples: one beyond may be a spike. `least` is what it must
    reach at its farthest, in its own unit.

    **Returns:** an index from 0 to N - 4, one sample before the first that differs; None for a signal that never
    leaves its beginning. An onset within the beginning itself cannot be told: see `starts_at_rest`.
    """
    beginning = _beginning(signal)
    away = np.abs(signal - beginning.mean(axis=0)).max(axis=1)
    left = away > max(NOISE * float(beginning.std(axis=0).max()), 1e-9 * float(np.nanmax(away)))
    left = left & np.append(left[1:], False) & np.append(left[2:], [False, False])
    if not left.any() or not np.nanmax(away) > least:
        return None
    return max(0, int(np.argmax(left)) - 1)


def starts_at_rest(command: Numbers, largest: float) -> bool:
    """Whether a command (N, n) has not begun when the recording does: one that has would pass for its own steady state.

    **Arguments:** `largest` command of all trials.
    """
    return not np.abs(_beginning(command) - np.nanmedian(command, axis=0)).max() > STARTED * largest > 0


def _beginning(signal: Numbers) -> Numbers:
    """What was measured of a signal first."""
    measured = signal[np.isfinite(signal).all(axis=1)]
    return measured[: max(10, round(LEADING * len(signal)))]
