"""Lab Streaming Layer: samples from a stream, estimates into one. `pip install jaximp[live]` brings it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaximp.live.clock import NOTHING, Batch
from jaximp.live.lines import Columns
from jaximp.live.monitor import Update

MOST = 4096
"""Samples that are taken at once."""


def library() -> Any:
    """**Raises:** `ValueError` in one line where it is missing."""
    try:
        import pylsl
    except ImportError:
        raise ValueError("Lab Streaming Layer needs pylsl: pip install 'jaximp[live]'") from None
    except RuntimeError as error:  # pylsl without its library
        raise ValueError(f"pylsl finds no liblsl ({str(error).splitlines()[0]}): install liblsl") from None
    return pylsl


class LslSource:
    """A stream by its name: channels by their labels, or position and torque in this order."""

    lost = unreadable = 0

    def __init__(self, name: str, columns: Columns | None = None, patience: float = 10.0):
        """**Arguments:** `patience` seconds in which the stream has to appear.

        **Raises:** `ValueError` where it does not, and for channels that do not match."""
        pylsl, columns = library(), columns or Columns()
        found = pylsl.resolve_byprop("name", name, timeout=patience)
        if not found:
            raise ValueError(f"no stream '{name}' was found in {patience:g} s: check its name, and whether it runs")
        self._inlet = pylsl.StreamInlet(found[0], max_buflen=60, processing_flags=pylsl.proc_clocksync)
        labels = _labels(self._inlet.info(timeout=patience))
        self._places, self._factors = _places(name, labels, columns)

    def read(self, timeout: float) -> Batch | None:
        if self._inlet is None:
            return None
        values, stamps = self._inlet.pull_chunk(timeout=timeout, max_samples=MOST)
        if not stamps:
            return NOTHING
        samples = np.asarray(values, float)
        position, torque = (samples[:, k] * f for k, f in zip(self._places, self._factors, strict=True))
        return Batch(np.asarray(stamps, float), position, torque)

    def close(self) -> None:
        if self._inlet is not None:
            self._inlet.close_stream()
        self._inlet = None


def _labels(info: Any) -> list[str]:
    """Of all channels; empty ones where a stream does not name them."""
    channel, found = info.desc().child("channels").child("channel"), []
    for _ in range(info.channel_count()):
        found.append(channel.child_value("label"))
        channel = channel.next_sibling("channel")
    return found


def _places(name: str, labels: Sequence[str], columns: Columns) -> tuple[list[int], list[float]]:
    places, factors = [], []
    for k, channel in enumerate(("position", "torque")):
        named = columns.name.get(channel, channel)
        if named in labels:
            places.append(labels.index(str(named)))
            factors.append(columns.factor.get(channel, 1.0))
        elif channel in labels:
            places.append(labels.index(channel))
            factors.append(1.0)
        elif len(labels) == 2 and not any(labels):
            places.append(k)
            factors.append(1.0)
        else:
            raise ValueError(f"the stream '{name}' has no channel '{named}': it has {', '.join(labels) or 'no labels'}")
    return places, factors


class LslSink:
    """An outlet with value, lower and upper end of each parameter, and whether it is trusted (1 or 0)."""

    def __init__(self, name: str = "jaximp"):
        self._pylsl, self._name = library(), name
        self._outlet: Any = None

    def write(self, update: Update) -> None:
        if update.value is None or update.low is None or update.high is None:
            return
        if self._outlet is None:
            self._open(update)
        sample = [*np.stack([update.value, update.low, update.high], axis=1).ravel(), update.verdict.label == "trusted"]
        self._outlet.push_sample([float(x) for x in sample])

    def _open(self, update: Update) -> None:
        pylsl, count = self._pylsl, 3 * len(update.names) + 1
        about = ("impedance", count, pylsl.IRREGULAR_RATE, "double64", f"jaximp {self._name}")
        info = pylsl.StreamInfo(self._name, *about)
        channels = info.desc().append_child("channels")
        for name, unit in zip(update.names, update.units, strict=True):
            for what in ("", "_low", "_high"):
                channel = channels.append_child("channel")
                channel.append_child_value("label", name + what)
                channel.append_child_value("unit", unit)
        channels.append_child("channel").append_child_value("label", "trusted")
        self._outlet = pylsl.StreamOutlet(info)

    def close(self) -> None:
        self._outlet = None
