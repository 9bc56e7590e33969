"""Ctrl-C and SIGTERM end a command, whatever swallows exceptions on the way, and everything unfinished is removed."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

PATIENCE = 0.5
"""So long an exception may be on its way before it is asked whether it still is [s]."""

_ended = threading.Event()


class Stopped(SystemExit):
    """A signal asked to end; the exit status is 128 and its number, as shells have it."""


@contextmanager
def signals_heard() -> Iterator[None]:
    """Raise `Stopped` on SIGINT and SIGTERM; a signal that is ignored stays so, as in a job in the background. What was
    done with signals before is done again afterwards."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    _ended.clear()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    say = sys.unraisablehook
    # One that is dropped is raised again, and nobody need read of it.
    sys.unraisablehook = lambda about: None if isinstance(about.exc_value, Stopped) else say(about)
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, _stop)
    try:
        yield
    finally:
        _ended.set()
        sys.unraisablehook = say
        for number, handler in before.items():
            signal.signal(number, handler)


def _stop(number: int, frame: Any) -> None:
    stopped = Stopped(128 + number)
    threading.Thread(target=_insist, args=(weakref.ref(stopped), number), daemon=True).start()
    try:
        raise stopped
    finally:
        del stopped  # or this frame would keep it alive


def _insist(stopped: weakref.ref[Stopped], number: int) -> None:
    """Python drops an exception that is raised while garbage is collected, and so do callbacks of libraries: one that
    is gone while the program is still there is raised again."""
    while not _ended.wait(PATIENCE):
        if stopped() is None:
            _thread.interrupt_main(signal.Signals(number))
            return
