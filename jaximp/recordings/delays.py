"""Channels that were recorded late are moved to where they belong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from jaximp.recordings.channels import Signal
from jaximp.recordings.errors import RecordingError
from jaximp.types import Numbers, Recording

DEGREE = 5
"""Of the curve through the samples; it needs so many on either side."""


def without_delay(signal: Signal, stamps: Numbers, valid: NDArray[np.bool_]) -> Signal:
    """The signal as it would have been without its delay; NaN where its samples are missing or end."""
    if not signal.delay:
        return signal
    return replace(signal, values=moved(signal.values, stamps, valid, signal.delay), delay=0.0)


def moved_forward(recording: Recording, seconds: float) -> Recording:
    """A recording whose torque came late by so much, put right."""
    torque = moved(recording.torque, recording.time, recording.valid, seconds)
    valid = np.isfinite(torque).all(axis=1) & recording.valid
    position = np.where(valid[:, None], recording.position, np.nan)
    torque = np.where(valid[:, None], torque, np.nan)
    return replace(recording, torque=torque, position=position, valid=valid, delay_unknown=False)


def moved(values: Numbers, stamps: Numbers, valid: NDArray[np.bool_], seconds: float) -> Numbers:
    """Values (N, k) at the stamps plus so much [s]; NaN where these lie in a gap or outside."""
    from scipy.interpolate import make_interp_spline

    known = np.flatnonzero(valid & np.isfinite(values).all(axis=1))
    if len(known) <= DEGREE or abs(seconds) >= stamps[-1] - stamps[0]:
        raise RecordingError(f"the delay of {seconds:.6g} s leaves no sample: correct it")
    at = stamps + seconds
    curve = make_interp_spline(stamps[known], values[known], k=DEGREE)(at.clip(stamps[known[0]], stamps[known[-1]]))
    before = np.searchsorted(stamps, at, side="right") - 1
    inside = (at >= stamps[known[0]]) & (at <= stamps[known[-1]])
    gap = np.ones(len(stamps), bool)
    gap[known] = False
    near = np.convolve(gap, np.ones(DEGREE + 1), mode="same") > 0
    inside &= ~near[before.clip(0, len(stamps) - 1)]
    return np.asarray(np.where(inside[:, None], curve, np.nan))
