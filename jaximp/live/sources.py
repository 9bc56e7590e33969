"""Where samples come from. A source is read in pieces, and never waits for longer than it is told to."""

from __future__ import annotations

import os
import queue
import select
import time
from collections.abc import Iterable, Iterator
from typing import Any, Protocol, runtime_checkable

import numpy as np

from jaximp.live.clock import NOTHING, Batch
from jaximp.live.lines import Columns, LineReader
from jaximp.types import Recording

PIECE = 256
"""Samples that are replayed at once where nothing has to wait."""
FINEST = 0.005
"""Seconds of samples that are replayed at once, at least."""
MOST_PUSHED = 1_000_000
"""Samples that wait to be read at most."""
READ = 1 << 16


@runtime_checkable
class Source(Protocol):
    """What a monitor listens to."""

    @property
    def lost(self) -> int:
        """Samples that it had to drop since they came too fast."""

    @property
    def unreadable(self) -> int:
        """Messages that were no samples."""

    def read(self, timeout: float) -> Batch | None:
        """What came within so many seconds, at most; empty if nothing did, None at the end."""

    def close(self) -> None:
        """Give back what it holds; nothing is read any more."""


class Replay:
    """A recording of one joint, at its own speed, faster, or (infinite) as fast as it is read."""

    lost = unreadable = 0

    def __init__(self, recording: Recording, speed: float = 1.0):
        if recording.n_joints != 1:
            raise ValueError(f"monitor identifies one joint, but {recording.name} has {recording.n_joints}: map one")
        self.waits = np.isinf(speed)
        """Whether it can be held up, and nothing is lost by that."""
        if not speed > 0:
            raise ValueError(f"the speed is {speed:g}: give a number above zero, or inf")
        self._samples = Batch(recording.time, recording.position[:, 0], recording.torque[:, 0])
        self._speed, self._next, self._begun = speed, 0, float("nan")

    def read(self, timeout: float) -> Batch | None:
        times = self._samples.time
        if self._next >= len(times):
            return None
        if np.isinf(self._speed):
            return self._up_to(self._next + PIECE)
        now = time.monotonic()
        if np.isnan(self._begun):
            self._begun = now
        due = times[min(self._next + int(FINEST * self._speed / (times[1] - times[0])), len(times) - 1)]
        time.sleep(max(0.0, min(timeout, self._begun + (due - times[0]) / self._speed - now)))
        played = times[0] + (time.monotonic() - self._begun) * self._speed
        return self._up_to(int(np.searchsorted(times, played, side="right")))

    def _up_to(self, last: int) -> Batch:
        first, self._next = self._next, max(last, self._next)
        return Batch(*(x[first:last] for x in self._samples))

    def close(self) -> None:
        self._next = len(self._samples.time)


class Iterated:
    """Whatever Python makes: an iterator of `(time, position, torque)`, each a number or equally long arrays."""

    lost = unreadable = 0
    waits = True

    def __init__(self, samples: Iterable[tuple[Any, Any, Any]]):
        self._samples: Iterator[tuple[Any, Any, Any]] = iter(samples)

    def read(self, timeout: float) -> Batch | None:
        one = next(self._samples, None)
        return None if one is None else Batch(*(np.atleast_1d(np.asarray(x, float)) for x in one))

    def close(self) -> None:
        self._samples = iter(())


class Pushed:
    """Samples that a callback hands over, from any thread; it returns at once."""

    unreadable = 0

    def __init__(self) -> None:
        self.lost = 0
        self._queue: queue.Queue[tuple[float, float, float] | None] = queue.Queue(MOST_PUSHED)
        self._ended = False

    def push(self, time: float, position: float, torque: float) -> None:
        """One sample: stamp [s], position [rad or m], torque [N m or N]."""
        try:
            self._queue.put_nowait((time, position, torque))
        except queue.Full:
            self.lost += 1

    def read(self, timeout: float) -> Batch | None:
        if self._ended:
            return None
        found = []
        try:
            found.append(self._queue.get(timeout=timeout))
            while found[-1] is not None and len(found) < PIECE:
                found.append(self._queue.get_nowait())
        except queue.Empty:
            pass
        self._ended = bool(found) and found[-1] is None
        samples = np.array([one for one in found if one is not None], float).reshape(-1, 3)
        return None if self._ended and not len(samples) else Batch(*samples.T)

    def close(self) -> None:
        self._queue.put(None)


class Piped:
    """Lines from a file descriptor, such as that of the standard input."""

    lost = 0

    def __init__(self, descriptor: int, columns: Columns | None = None):
        self._descriptor = descriptor
        self._lines = LineReader(columns or Columns())
        self._ended = False

    @property
    def unreadable(self) -> int:
        return self._lines.unreadable

    def read(self, timeout: float) -> Batch | None:
        if self._ended:
            return None
        if not select.select([self._descriptor], [], [], timeout)[0]:
            return NOTHING
        data = os.read(self._descriptor, READ)
        if data:
            return self._lines.take(data)
        self._ended = True
        return self._lines.finish()

    def close(self) -> None:
        self._ended = True
