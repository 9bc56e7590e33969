"""Who listens to the estimates. Nobody may hold them up: who reads too slowly misses some, and that is counted."""

from __future__ import annotations

import json
import queue
import socket
from collections.abc import Callable
from contextlib import suppress
from threading import Thread
from typing import Any, Protocol, runtime_checkable

from jaximp.live.monitor import Update

MOST_WAITING = 2000
"""Updates that wait for a slow reader."""
PATIENCE = 2.0
"""Seconds that it has at the end."""


@runtime_checkable
class Sink(Protocol):
    """What takes updates, in a thread of its own."""

    def write(self, update: Update) -> None:
        """Take one. It may block, and may raise `OSError` when nobody reads any more."""

    def close(self) -> None:
        """After the last one."""


class Aside:
    """A sink that never holds up whoever writes to it."""

    def __init__(self, sink: Sink):
        self.dropped, self.gone = 0, False
        self._sink = sink
        self._queue: queue.Queue[Update | None] = queue.Queue(MOST_WAITING)
        self._thread = Thread(target=self._work, daemon=True)
        self._thread.start()

    def put(self, update: Update, waits: bool = False) -> None:
        """Hand over, or count what cannot be; of what is replayed, and `waits` for its readers, nothing is left out."""
        try:
            self._queue.put(update, block=waits and not self.gone, timeout=PATIENCE)
        except queue.Full:
            self.dropped += 1

    def _work(self) -> None:
        while (update := self._queue.get()) is not None:
            try:
                if not self.gone:
                    self._sink.write(update)
                else:
                    self.dropped += 1
            except (OSError, ValueError):
                self.gone = True
                self.dropped += 1
        self._sink.close()

    def close(self) -> None:
        """Wait a little for a slow reader, and go."""
        try:
            self._queue.put(None, timeout=PATIENCE)
        except queue.Full:
            return
        self._thread.join(PATIENCE)


class JsonLines:
    """One line of JSON for each update, on a stream of text."""

    def __init__(self, stream: Any):
        self._stream = stream

    def write(self, update: Update) -> None:
        self._stream.write(json.dumps(update.as_json()) + "\n")
        self._stream.flush()

    def close(self) -> None:
        """The stream is somebody else's."""


class Called:
    """A function that is called with each update."""

    def __init__(self, function: Callable[[Update], None]):
        self._function = function

    def write(self, update: Update) -> None:
        self._function(update)

    def close(self) -> None:
        """There is nothing to give back."""


class UdpSink:
    """A datagram of JSON for each update."""

    def __init__(self, host: str, port: int):
        self._to = (host, port)
        self._socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)

    def write(self, update: Update) -> None:
        with suppress(ConnectionRefusedError):  # nobody listens yet
            self._socket.sendto(json.dumps(update.as_json()).encode(), self._to)

    def close(self) -> None:
        self._socket.close()
