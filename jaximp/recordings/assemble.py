"""Channels become a `Recording`: checks of every channel, and one uniform grid for all of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaximp.recordings.channels import Signal, check_lengths
from jaximp.recordings.clocks import without_repeats
from jaximp.recordings.delays import without_delay
from jaximp.recordings.errors import RecordingError
from jaximp.recordings.grid import check_stamps, on_uniform_grid
from jaximp.recordings.raw import judge_raw
from jaximp.types import Recording


def assemble(
    clock: Signal,
    signals: dict[str, Signal],
    joints: tuple[str, ...],
    name: str,
    of_file: Sequence[str] = (),
    duplicates: str | None = None,
) -> Recording:
    """Check every channel, mask what is spoilt, take delays out, and bring all channels onto one uniform grid.

    Notes on the file (`of_file`) stand before those on what was done here.
    """
    _check_shapes(clock, signals, len(joints))
    clock, signals, of_clock = without_repeats(clock, signals, duplicates)
    stamps = clock.values[:, 0]
    check_stamps(clock.labels[0], stamps)
    labels = [label for signal in signals.values() for label in signal.labels]
    valid, notes = _complete_rows(labels, _side_by_side(signals))
    for channel in ("position", "torque"):
        notes += _check_motion(channel, signals[channel], valid)
    notes += _same_numbers(signals)
    judged = judge_raw(stamps, signals, valid)
    moved = {channel: without_delay(signal, stamps, judged.valid) for channel, signal in judged.signals.items()}
    notes += [_moved_in_words(channel, signal.delay) for channel, signal in signals.items() if signal.delay]
    samples = _side_by_side(moved)
    usable = judged.valid & np.isfinite(samples).all(axis=1)
    time, samples, valid, of_sampling = on_uniform_grid(stamps, samples, usable)
    _check_enough(valid)
    borders = np.cumsum([len(signal.labels) for signal in signals.values()])[:-1]
    clipped = _clipped(time, stamps, judged.clipped, signals["torque"].delay or 0.0)
    samples = np.where((valid if clipped is None else valid | clipped)[:, None], samples, np.nan)
    channels = dict(zip(signals, np.split(samples, borders, axis=1), strict=True))
    if clipped is not None:  # whoever reads what is saved of this recording must find the limits again
        when = time[clipped] + (signals["torque"].delay or 0.0)
        channels["torque"][clipped] = np.stack([np.interp(when, stamps, x) for x in signals["torque"].values.T], axis=1)
    stated, gains = signals["position"].noise, signals["torque"].gain_covariance
    return Recording(
        time=_frozen(time),
        valid=_frozen(valid),
        **{channel: _frozen(values) for channel, values in channels.items()},
        joints=joints,
        position_noise=_frozen(judged.position_noise),
        stated_noise=None if stated is None else _frozen(np.full(len(joints), stated)),
        delay_unknown=signals["torque"].delay is None,
        gain_covariance=None if gains is None else _frozen(gains),
        clipped=None if clipped is None else _frozen(clipped),
        name=name,
        notes=(*of_file, *of_clock, *of_sampling, *notes, *(fault.text for fault in judged.faults)),
        faults=judged.faults,
    )


def _clipped(
    time: NDArray[np.float64], stamps: NDArray[np.float64], at_limit: NDArray[np.bool_], delay: float
) -> NDArray[np.bool_] | None:
    """(N,) samples of the grid at which the torque, moved by its delay, was at a limit; None if there is none."""
    return np.interp(time + delay, stamps, at_limit) > 0.5 if at_limit.any() else None


def _side_by_side(signals: dict[str, Signal]) -> NDArray[np.float64]:
    return np.hstack([signal.values for signal in signals.values()])


def _moved_in_words(channel: str, delay: float) -> str:
    late = "late" if delay > 0 else "early"
    return f"{channel} was recorded {1e3 * abs(delay):.6g} ms {late}, as the mapping says, and was moved by so much"


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    array = np.array(array, order="C")
    array.setflags(write=False)
    return array


def _check_shapes(clock: Signal, signals: dict[str, Signal], n: int) -> None:
    if len(clock.labels) != 1:
        raise RecordingError(
            f"time has {len(clock.labels)} columns; name a single one (channels with times of their own: resample them)"
        )
    for channel, signal in signals.items():
        if len(signal.labels) != n and channel != "force":
            raise RecordingError(f"{channel} has {len(signal.labels)} columns for {n} joints; give one per joint")
    # A clock that was made of a rate is as long as the position, which is then to be named.
    compared = [*signals.values(), clock] if clock.labels == ("sample_rate",) else [clock, *signals.values()]
    check_lengths([(signal.labels[0], signal.values) for signal in compared])
    if len(clock.values) < 3:
        raise RecordingError(
            f"has {len(clock.values)} samples; at least 3 are needed, and a useful fit needs many more"
        )


def _complete_rows(labels: list[str], samples: NDArray[np.float64]) -> tuple[NDArray[np.bool_], list[str]]:
    """(N,) True where every channel was measured, and a note if that is not everywhere."""
    if np.isfinite(samples).all():
        return np.ones(len(samples), bool), []
    infinite = np.argwhere(np.isinf(samples))
    if len(infinite):
        row, i = infinite[0]
        raise RecordingError(f"column {labels[i]!r}, row {row + 1}: the value is infinite; repair or remove the row")
    missing = np.isnan(samples)
    for label, column in zip(labels, missing.T, strict=True):
        if column.all():
            raise RecordingError(f"column {label!r} is NaN throughout: nothing was measured; name another column")
    valid = np.asarray(~missing.any(axis=1))
    _check_enough(valid)
    if valid.all():
        return valid, []
    counts = [f"{label!r} ({column.sum()})" for label, column in zip(labels, missing.T, strict=True) if column.any()]
    return valid, [f"{(~valid).sum()} of {len(valid)} samples are masked because of NaN in {', '.join(counts)}"]


def _check_enough(valid: NDArray[np.bool_]) -> None:
    if valid.sum() < 3:
        raise RecordingError(
            f"only {valid.sum()} of {len(valid)} samples are usable (no NaN, no gap); record at least 3"
        )


def _same_numbers(signals: dict[str, Signal]) -> list[str]:
    """A note where position and torque are one column: they say nothing of a joint."""
    pairs = list(zip(signals["position"].values.T, signals["torque"].values.T, strict=False))
    same = [bool(np.array_equal(x, y, equal_nan=True) and np.nanmin(x) < np.nanmax(x)) for x, y in pairs]
    of = [f" of joint {k + 1}" if len(pairs) > 1 else "" for k in np.flatnonzero(same)]
    what = "are the same numbers: a stiffness of 1 is all that can come out; name the column of the other"
    return [f"position and torque{one} {what}" for one in of]


def _check_motion(channel: str, signal: Signal, valid: NDArray[np.bool_]) -> list[str]:
    """Nothing can be identified from a constant signal; one resting joint of several is worth a note."""
    remark = {"position": "the joint did not move", "torque": "nothing was measured"}[channel]
    measured = signal.values[valid]
    constant = (measured == measured[0]).all(axis=0)
    notes = [
        f"column {label!r} is constant ({value:.6g}): {remark}"
        for label, value in zip(np.array(signal.labels)[constant].tolist(), measured[0, constant], strict=True)
    ]
    if constant.all():
        raise RecordingError("; ".join(notes) + "; name another column or another recording")
    return notes
