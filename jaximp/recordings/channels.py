"""The channels of a recording on their way from columns: values side by side, each column with its label."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaximp.recordings.errors import RecordingError

CHANNELS = ("position", "torque", "velocity", "acceleration", "force", "reference", "command")
"""What a recording may hold beside its time; position and torque are needed."""


@dataclass(frozen=True)
class Signal:
    """One channel: `values` (N, k) and a label for each of its columns."""

    labels: tuple[str, ...]
    values: NDArray[np.float64]
    delay: float | None = 0.0
    """How late it was recorded [s]; None where that is to be estimated."""
    noise: float | None = None
    """Standard deviation of the sensor's error, where it is stated."""
    gain_covariance: NDArray[np.float64] | None = None
    """(k, k) of the relative errors of the gains that made the columns, where these are stated."""


def stack(columns: Sequence[str | int], values: Mapping[Any, Any]) -> Signal:
    """The columns of one channel side by side; a 2-D variable brings one column per joint."""
    parts = [(str(column), _as_columns(str(column), values[column])) for column in columns]
    check_lengths(parts)
    labels = [
        column if part.shape[1] == 1 else f"{column}[{i + 1}]" for column, part in parts for i in range(part.shape[1])
    ]
    return Signal(tuple(labels), np.hstack([part for _, part in parts]))


def _as_columns(label: str, values: Any) -> NDArray[np.float64]:
    """(N, n) float64 from a scalar, a row or column vector, or an (N, n) matrix."""
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise RecordingError(f"{label!r} does not hold real numbers (it is {array.dtype}); name a numeric one")
    if array.ndim > 2:
        raise RecordingError(f"{label!r} has shape {array.shape}; it must be a vector, or (samples, joints)")
    if array.ndim < 2 or array.shape[0] == 1 or not array.size:
        array = array.reshape(-1, 1)
    return array.astype(np.float64)


def check_lengths(arrays: Sequence[tuple[str, NDArray[np.float64]]]) -> None:
    """All arrays, each with its label, are as long as the first."""
    first, reference = arrays[0]
    for label, array in arrays[1:]:
        if len(array) != len(reference):
            raise RecordingError(
                f"{first!r} has {len(reference)} samples, but {label!r} has {len(array)}; they must be equally long, "
                "with the samples along the first axis and one time base (else resample one of them)"
            )
