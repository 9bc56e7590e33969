"""Raw samples are judged before anything is interpolated or filtered: what a sensor or a recorder spoiled is masked,
and told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaximp import signals
from jaximp.recordings.channels import Signal
from jaximp.types import Fault, Numbers, listed

MEASURED = ("position", "torque", "velocity", "acceleration", "force")
"""Channels that a sensor measured; a reference and a command may leap."""
ROUGH = "torque"
"""The channel with noise, which neither lies on lines nor repeats itself; a position is smooth, and does."""
SPLINE = 5
"""Degree of what is laid through the measured samples of a signal that was held between them."""


@dataclass(frozen=True)
class Judged:
    """Samples as they can be used."""

    signals: dict[str, Signal]
    valid: NDArray[np.bool_]
    """(N,) without those that are masked."""
    clipped: NDArray[np.bool_]
    """(N,) where a torque was cut off at a limit."""
    position_noise: Numbers
    """(n,) standard deviation of the white noise that is seen in the position of each joint."""
    faults: tuple[Fault, ...]


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def judge_raw(stamps: Numbers, given: Mapping[str, Signal], valid: NDArray[np.bool_]) -> Judged:
    """Look for glitches, lost values, held samples and limits of the torque.

    **Arguments:** `stamps` (N,) [s] as they were recorded; `valid` (N,) where all channels have a number.
    """
    kept, faults, found = valid.copy(), [], dict(given)
    noise: dict[str, list[float]] = {}
    for channel in filter(given.__contains__, MEASURED):
        values = np.where(valid[:, None], given[channel].values, np.nan)
        for k, x in enumerate(values.T):
            label = channel if values.shape[1] == 1 else f"{channel} {k + 1}"
            one = _judge_samples(label, channel, x, stamps)
            noise.setdefault(channel, []).append(one.noise)
            faults += one.faults
            kept &= ~one.spoilt & np.isfinite(one.values)
            values[:, k] = one.values
        found[channel] = replace(given[channel], values=values)
    clipped = np.zeros(len(valid), bool)
    positions = np.where(kept[:, None], found["position"].values, np.nan)
    rate = (len(stamps) - 1) / (stamps[-1] - stamps[0])
    for k, x in enumerate(found["torque"].values.T):
        limits = signals.torque_limits(np.where(kept, x, np.nan), positions, rate, noise["torque"][k])
        label = "torque" if len(noise["torque"]) == 1 else f"torque {k + 1}"
        if limits:
            faults.append(_limits(label, limits))
            clipped |= np.any([one.at for one in limits], axis=0)
        value = signals.crowded_value(np.where(kept, x, np.nan))
        if value is not None:
            faults.append(_dead_zone(label, value, float(np.mean(x == value))))
            clipped |= x == value
    return Judged(found, kept & ~clipped, clipped, np.array(noise["position"]), tuple(faults))


class _Samples(NamedTuple):
    """Those of one signal."""

    values: Numbers
    """(N,) with a smooth curve in place of what a recorder made of a slower signal."""
    spoilt: NDArray[np.bool_]
    noise: float
    faults: list[Fault]


def _judge_samples(label: str, channel: str, x: Numbers, stamps: Numbers) -> _Samples:
    updates = signals.held_updates(x)
    slower = signals.corners(x) if updates is None and channel == ROUGH else None
    if slower is not None:
        places, values = slower
        at = np.interp(places, np.arange(len(stamps)), stamps)
        curve, nothing = _through(at, values, stamps, np.isnan(x)), np.zeros(len(x), bool)
        return _Samples(curve, nothing, signals.noise_level(values), [_joined(label, places, len(x))])
    known = x if updates is None else x[updates]
    level = signals.noise_level(known)
    wrong = signals.glitches(known, level) | signals.dropouts(known, level)
    if updates is None:
        traces = _traces(label, channel, x)
        spoilt, faults = np.any([wrong, *(at for _, at in traces)], axis=0), [fault for fault, _ in traces]
    else:
        wrong, measured = _until_next(updates, wrong, len(x)), updates[~wrong & np.isfinite(known)]
        x = _through(stamps[measured], x[measured], stamps, np.isnan(x))
        spoilt, faults = wrong, [_held(label, updates, len(x))]
    if wrong.any():
        faults.append(_glitches(label, wrong, stamps))
    # Uneven stamps make leaps of a motion, which no glitch must be told by, and which are no noise.
    even = (
        signals.noise_level(known, stamps if updates is None else stamps[updates]) if channel == "position" else level
    )
    return _Samples(x, spoilt, even, faults)


def _until_next(updates: NDArray[np.int64], wrong: NDArray[np.bool_], count: int) -> NDArray[np.bool_]:
    """(N,) all samples that repeat a wrong one."""
    ends = np.r_[updates[1:], count]
    out = np.zeros(count, bool)
    for first, last in zip(updates[wrong], ends[wrong], strict=True):
        out[first:last] = True
    return out


def _traces(label: str, channel: str, x: Numbers) -> list[tuple[Fault, NDArray[np.bool_]]]:
    """What a recorder did to samples that no noise does, and (N,) where."""
    if channel != ROUGH:
        return []
    kinds = [
        ("lines", signals.bridged(x), "lie on straight lines to the last digit, as if drawn over lost samples"),
        ("repeated", signals.repeated(x), "repeat earlier ones to the last digit, as of a buffer sent twice"),
    ]
    return [
        (Fault(label, kind, float(at.mean()), f"{label}: {at.mean():.1%} of the samples {what}: masked"), at)
        for kind, at, what in kinds
        if at.any()
    ]


def _through(at: Numbers, values: Numbers, stamps: Numbers, missing: NDArray[np.bool_]) -> Numbers:
    """(N,) a smooth curve through what was measured; nothing where it would run on beyond that."""
    from scipy.interpolate import make_interp_spline

    curve = np.asarray(make_interp_spline(at, values, k=SPLINE)(stamps))
    return np.where(missing | (stamps < at[0]) | (stamps > at[-1]), np.nan, curve)


def _glitches(label: str, wrong: NDArray[np.bool_], stamps: Numbers) -> Fault:
    count = f"{wrong.sum()} samples stand" if wrong.sum() > 1 else "1 sample stands"
    text = (
        f"{count} out from their neighbours by more than {signals.STANDS_OUT:g} times the noise (first at "
        f"{stamps[wrong][0]:.6g} s): masked"
    )
    return Fault(label, "glitches", float(wrong.mean()), f"{label}: {text}")


def _held(label: str, updates: NDArray[np.int64], count: int) -> Fault:
    every = int(np.median(np.diff(updates)))
    text = (
        f"changes only every {every} samples, as a slower signal that is held until its next value: a smooth curve is "
        "laid through the first sample of each value"
    )
    return Fault(label, "held samples", 1 - len(updates) / count, f"{label}: {text}")


def _joined(label: str, places: Numbers, count: int) -> Fault:
    text = (
        f"is a slower signal whose samples, one in {np.median(np.diff(places)):.3g}, were joined by straight lines: a "
        "smooth curve is laid through them"
    )
    return Fault(label, "joined samples", 1 - len(places) / count, f"{label}: {text}")


def _dead_zone(label: str, value: float, share: float) -> Fault:
    text = f"{share:.1%} of the samples are exactly {value:.4g}, as of a sensor with a dead zone: masked"
    return Fault(label, "dead zone", share, f"{label}: {text}")


def _limits(label: str, limits: tuple[signals.Limit, ...]) -> Fault:
    share = np.any([one.at for one in limits], axis=0).mean()
    where = listed([f"{one.value:.4g}" for one in limits])
    text = f"{share:.1%} of the samples lie at a limit ({where}) where the motion asks for more: masked"
    return Fault(label, "saturation", float(share), f"{label}: {text}")
