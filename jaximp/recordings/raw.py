"""Raw samples are judged before anything is interpolated or filtered: what a sensor or a recorder spoiled is masked,
and told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from jaximp import signals
from jaximp.recordings.channels import Signal
from jaximp.types import Fault, Numbers, listed

MEASURED = ("position", "torque", "velocity", "acceleration", "force")
"""Channels that a sensor measured; a reference and a command may leap."""
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
            updates = signals.held_updates(x)
            known = x if updates is None else x[updates]
            level = signals.noise_level(known)
            noise.setdefault(channel, []).append(level)
            wrong = signals.glitches(known, level) | signals.dropouts(known, level)
            if updates is None:
                spoilt = wrong
            else:
                spoilt = _until_next(updates, wrong, len(x))
                values[:, k] = _between(stamps, x, updates[~wrong])
                faults.append(_held(label, updates, len(x)))
            if spoilt.any():
                faults.append(_glitches(label, spoilt, stamps))
            kept &= ~spoilt & np.isfinite(values[:, k])
        found[channel] = replace(given[channel], values=values)
    clipped = np.zeros(len(valid), bool)
    positions = np.where(kept[:, None], found["position"].values, np.nan)
    rate = (len(stamps) - 1) / (stamps[-1] - stamps[0])
    for k, x in enumerate(found["torque"].values.T):
        limits = signals.torque_limits(np.where(kept, x, np.nan), positions, rate, noise["torque"][k])
        if limits:
            faults.append(_limits("torque" if len(noise["torque"]) == 1 else f"torque {k + 1}", limits))
            clipped |= np.any([one.at for one in limits], axis=0)
    return Judged(found, kept & ~clipped, clipped, np.array(noise["position"]), tuple(faults))


def _until_next(updates: NDArray[np.int64], wrong: NDArray[np.bool_], count: int) -> NDArray[np.bool_]:
    """(N,) all samples that repeat a wrong one."""
    ends = np.r_[updates[1:], count]
    out = np.zeros(count, bool)
    for first, last in zip(updates[wrong], ends[wrong], strict=True):
        out[first:last] = True
    return out


def _between(stamps: Numbers, x: Numbers, updates: NDArray[np.int64]) -> Numbers:
    """(N,) a smooth curve through the samples that were measured; nothing where it would run on beyond them."""
    from scipy.interpolate import make_interp_spline

    known = updates[np.isfinite(x[updates])]
    curve = np.asarray(make_interp_spline(stamps[known], x[known], k=SPLINE)(stamps))
    outside = (stamps < stamps[known[0]]) | (stamps > stamps[known[-1]])
    return np.where(np.isnan(x) | outside, np.nan, curve)


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


def _limits(label: str, limits: tuple[signals.Limit, ...]) -> Fault:
    share = np.any([one.at for one in limits], axis=0).mean()
    where = listed([f"{one.value:.4g}" for one in limits])
    text = f"{share:.1%} of the samples lie at a limit ({where}) where the motion asks for more: masked"
    return Fault(label, "saturation", float(share), f"{label}: {text}")
