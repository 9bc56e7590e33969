"""What a model leaves of the torque of each joint, in motion and near standstill."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jaximp.identification.rows import Rows
from jaximp.types import Numbers


@dataclass(frozen=True)
class Residuals:
    """Of n joints, over the rows of one recording."""

    moving: Numbers
    """(n,) root mean square in rows that count: those at least at `min_velocity` [N m or N]."""
    still: Numbers
    """(n,) in slower ones; NaN where there are none."""
    relative: Numbers
    """(n,) root of the sum of squares of both over that of the torque."""
    relative_moving: Numbers
    """(n,) the same, of rows that count."""
    total: float
    """`relative` of all joints together."""
    total_moving: float
    """`relative_moving` of all joints together."""
    time: Numbers
    """(N,) [s]."""
    torque: Numbers
    """(N, n) as it was filtered; NaN where it was not measured."""
    predicted: Numbers
    """(N, n) by the model."""

    @classmethod
    def of(cls, rows: Rows, theta: Numbers) -> Residuals:
        """**Arguments:** the parameters `theta` (p,) of a model with these rows."""
        W, count = np.asarray(rows.W), len(rows.time)
        torque, predicted = (np.reshape(x, (count, -1)) for x in (rows.torque, W @ theta))
        moving = np.asarray(rows.valid).reshape(torque.shape)
        measured = moving if rows.clean is None else np.broadcast_to(rows.clean[:, None], torque.shape)
        torque = np.where(measured, torque, np.nan)
        left = torque - predicted
        return cls(
            moving=_root_mean_square(left, moving),
            still=_root_mean_square(left, measured & ~moving),
            relative=_share(left, torque, measured, axis=0),
            relative_moving=_share(left, torque, moving, axis=0),
            total=float(_share(left, torque, measured, axis=None)),
            total_moving=float(_share(left, torque, moving, axis=None)),
            time=rows.time,
            torque=torque,
            predicted=predicted,
        )


def _squares(x: Numbers, which: NDArray[np.bool_], axis: int | None) -> Numbers:
    return np.asarray((np.where(which, x, 0.0) ** 2).sum(axis=axis))


def _root_mean_square(left: Numbers, which: NDArray[np.bool_]) -> Numbers:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(_squares(left, which, 0) / which.sum(axis=0)))


def _share(left: Numbers, torque: Numbers, which: NDArray[np.bool_], axis: int | None) -> Numbers:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(_squares(left, which, axis) / _squares(torque, which, axis)))
