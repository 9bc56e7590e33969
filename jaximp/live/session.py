"""A source, a monitor and who listens, together: until the source ends, or somebody says stop."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from threading import Event, Thread

import numpy as np

from jaximp.live.alarms import Alarm, Rule
from jaximp.live.clock import Batch
from jaximp.live.log import Log
from jaximp.live.monitor import Monitor, Update
from jaximp.live.sinks import Aside
from jaximp.live.sources import Source

MOST_BATCHES = 20_000
"""Pieces of samples that wait for the estimator at most."""
TIMEOUT = 0.1
"""Seconds for which a source is waited for at a time."""
SILENT = 2.0
"""Seconds without a sample that are told."""


class _Pump(Thread):
    """Reads the source all the time, so that nothing is lost in front of it while the estimator is busy."""

    def __init__(self, source: Source):
        super().__init__(daemon=True)
        self.lost, self.error = 0, ""
        self.stop = Event()
        self._source = source
        self._queue: queue.Queue[Batch | None] = queue.Queue(MOST_BATCHES)

    def run(self) -> None:
        try:
            while not self.stop.is_set() and (batch := self._source.read(TIMEOUT)) is not None:
                if len(batch.time):
                    self._hand_over(batch)
        except (OSError, ValueError) as error:
            self.error = str(error)
        while not self.stop.is_set():
            with suppress(queue.Full):
                self._queue.put(None, timeout=TIMEOUT)
                break

    def _hand_over(self, batch: Batch) -> None:
        waits = getattr(self._source, "waits", False)
        while not self.stop.is_set():
            try:
                self._queue.put(batch, block=waits, timeout=TIMEOUT)
            except queue.Full:
                if waits:
                    continue
                self.lost += len(batch.time)
            break

    def take(self) -> list[Batch | None]:
        """All that is there; waits a little for the first."""
        found: list[Batch | None] = []
        try:
            found.append(self._queue.get(timeout=TIMEOUT))
            while found[-1] is not None and sum(len(one.time) for one in found if one is not None) < 4096:
                found.append(self._queue.get_nowait())
        except queue.Empty:
            pass
        return found


class Session:
    """What runs: `run` returns when the source has ended, or after `stop`."""

    def __init__(
        self,
        source: Source,
        monitor: Monitor,
        sinks: Sequence[Aside] = (),
        log: Log | None = None,
        say: Callable[[str], None] = lambda line: None,
        status_every: float = 10.0,
    ):
        """**Arguments:** `say` takes lines for people, and `status_every` seconds a line on how it goes."""
        self.source, self.monitor, self.sinks, self.log, self.say = source, monitor, sinks, log, say
        self._status_every, self._stopped = status_every, Event()
        self.paused, self.ignored, self.report_wanted = False, 0, False
        """Whether samples are left out now, how many were, and whether somebody asked for the report."""
        self._on_mark: list[Callable[[float, str], None]] = []
        self._alarms: list[Alarm] = []
        self._waits = bool(getattr(source, "waits", False))
        self._marks: queue.Queue[tuple[float, str]] = queue.Queue()
        self.most_backlog = 0
        """Samples that ever waited for the estimator."""

    def stop(self) -> None:
        """End soon; from any thread, or a signal."""
        self._stopped.set()

    def mark(self, text: str) -> None:
        """Note that something happened now."""
        latest = self.monitor.latest
        time = float("nan") if latest is None else latest.time
        self._marks.put((time, text))

    def watch(self, alarms: Sequence[Rule]) -> None:
        """Raise alarms; they are said, and noted in the log."""
        self._alarms += [Alarm(rule) for rule in alarms]

    def on_mark(self, tell: Callable[[float, str], None]) -> None:
        """Call this for every mark."""
        self._on_mark.append(tell)

    @property
    def raised(self) -> list[str]:
        """Alarms as they are now."""
        return [alarm.rule.text for alarm in self._alarms if alarm.raised]

    def run(self) -> None:
        """Until the end; whatever ends it, the log is complete and the counts are said."""
        pump = _Pump(self.source)
        pump.start()
        last_sample = last_status = time.monotonic()
        silent = calibrated = False
        try:
            while not self._stopped.is_set():
                batches = pump.take()
                now = time.monotonic()
                samples = [one for one in batches if one is not None]
                self._note_marks()
                if samples and self.paused:
                    self.ignored += sum(len(one.time) for one in samples)
                    last_sample = now
                elif samples:
                    self._feed(Batch(*(np.concatenate(parts) for parts in zip(*samples, strict=True))))
                    last_sample, silent = now, self._say_back(silent)
                elif not silent and now - last_sample > SILENT:
                    silent = True
                    self.say(f"no sample for {SILENT:g} s: waiting")
                if not calibrated and self.monitor.calibration is not None:
                    calibrated = True
                    self._say_calibration()
                if now - last_status >= self._status_every:
                    last_status = now
                    self.say(self.status(pump.lost))
                if None in batches:
                    self._hand_out(self.monitor.wait())
                    if not calibrated and self.monitor.calibration is not None:
                        self._say_calibration()
                    break
        finally:
            self._end(pump)

    def _feed(self, batch: Batch) -> None:
        slots, updates = self.monitor.feed(batch)
        self.most_backlog = max(self.most_backlog, self.monitor.backlog)
        if self.log is not None:
            self.log.add(slots, [])
        self._hand_out(updates)

    def _note_marks(self) -> None:
        while not self._marks.empty():
            time, text = self._marks.get()
            if self.log is not None:
                self.log.note(f"mark at {time:g} s: {text}")
            for tell in self._on_mark:
                tell(time, text)

    def _look_for_alarms(self, update: Update) -> None:
        for alarm in self._alarms:
            if alarm.take(update):
                line = f"alarm at {update.time:.2f} s: {alarm.rule.text}"
                self.say(line)
                if self.log is not None:
                    self.log.note(line)

    def _hand_out(self, updates: list[Update]) -> None:
        if self.log is not None and updates:
            self.log.add(self.monitor.no_slots, updates)
        for update in updates:
            self._look_for_alarms(update)
        for sink in self.sinks:
            for update in updates:
                sink.put(update, self._waits)

    def _say_back(self, silent: bool) -> bool:
        if silent:
            self.say("samples come again")
        return False

    def _say_calibration(self) -> None:
        calibration, pipeline = self.monitor.calibration, self.monitor.pipeline
        if calibration is None or pipeline is None:
            return
        for line in calibration.in_words(pipeline):
            self.say(line)
            if self.log is not None:
                self.log.note(line)

    def status(self, lost: int = 0) -> str:
        """One line."""
        counts, latest = self.monitor.counts, self.monitor.latest
        verdict = "" if latest is None else f"; {latest.verdict.label}"
        dropped = sum(sink.dropped for sink in self.sinks)
        late = f"; {dropped} updates dropped for slow readers" if dropped else ""
        lost += self.source.lost
        overload = f"; {lost} samples lost: they came too fast" if lost else ""
        unreadable = f"; {self.source.unreadable} messages that could not be read" if self.source.unreadable else ""
        overload += f"; {self.ignored} left out in pauses" if self.ignored else ""
        return counts.in_words() + overload + unreadable + late + verdict

    def _end(self, pump: _Pump) -> None:
        pump.stop.set()
        for sink in self.sinks:
            sink.close()
        line = self.status(pump.lost)
        if self.log is not None:
            self.log.note(line)
            self.log.close()
        pump.join(2 * TIMEOUT + 1)
        self.source.close()
        if pump.error:
            self.say(f"the source broke off: {pump.error}")
        self.say(line)
