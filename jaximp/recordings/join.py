"""Several recordings of one joint or robot, as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaximp.recordings.channels import CHANNELS
from jaximp.recordings.errors import RecordingError
from jaximp.types import AnyArray, Recording

SAME_RATE = 1e-3
"""Sample rates that differ by a smaller share are one."""


def join_recordings(several: Sequence[Recording], gap: int) -> Recording:
    """The samples of all, one recording behind the other, with `gap` samples between that were not measured.

    A gap that is longer than the filters reach keeps them from crossing from one recording into the next.

    **Raises:** `ValueError` for recordings of other joints, channels or sample rates than the first.
    """
    first = several[0]
    if len(several) == 1:
        return first
    for one in several[1:]:
        _check_alike(first, one)
    total = sum(map(len, several)) + gap * (len(several) - 1)

    def together(arrays: Sequence[AnyArray], empty: float | bool) -> AnyArray:
        whole, start = np.full((total, *arrays[0].shape[1:]), empty), 0
        for array in arrays:
            whole[start : start + len(array)] = array
            start += len(array) + gap
        whole.setflags(write=False)
        return whole

    noise = [one.position_noise for one in several if one.position_noise is not None]
    clipped = [np.zeros(len(one), bool) if one.clipped is None else one.clipped for one in several]
    notes = [f"{one.name}: {note}" for one in several for note in one.notes]
    return replace(
        first,
        time=first.time[0] + np.arange(total) / first.sample_rate,
        valid=together([one.valid for one in several], False),
        **{name: together([getattr(one, name) for one in several], np.nan) for name in _channels(first)},
        position_noise=np.sqrt(np.mean(np.square(noise), axis=0)) if len(noise) == len(several) else None,
        clipped=together(clipped, False) if any(one.clipped is not None for one in several) else None,
        name=" and ".join(one.name for one in several),
        notes=(*notes, f"{len(several)} recordings count as one, with {gap / first.sample_rate:.3g} s between them"),
        faults=tuple(fault for one in several for fault in one.faults),
    )


def part_of(recording: Recording, begin: float, end: float) -> Recording:
    """The samples from one share of a recording to another."""
    here = slice(round(begin * len(recording)), round(end * len(recording)))
    arrays = {name: getattr(recording, name) for name in ("time", "valid", "clipped", *CHANNELS)}
    return replace(recording, **{name: array[here] for name, array in arrays.items() if array is not None})


def _channels(recording: Recording) -> list[str]:
    return [name for name in CHANNELS if getattr(recording, name) is not None]


def _check_alike(first: Recording, other: Recording) -> None:
    if other.joints != first.joints:
        raise RecordingError(f"{other.name} has other joints than {first.name}: recordings of one fit have the same")
    if abs(other.sample_rate - first.sample_rate) > SAME_RATE * first.sample_rate:
        raise RecordingError(
            f"{first.name} was sampled at {first.sample_rate:g} Hz and {other.name} at {other.sample_rate:g} Hz: "
            "resample one of them"
        )
    for name in set(_channels(first)) ^ set(_channels(other)):
        raise RecordingError(f"{name} is in only one of {first.name} and {other.name}: give both, or none")
