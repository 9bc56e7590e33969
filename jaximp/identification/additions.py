"""What was added to a robot of n joints, be it a load or a human who holds its end, told from it by least squares.

Errors come from the scores by blocks of time (`block_errors`), and each fit of which an estimate has errors is kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaximp.identification.block_errors import BlockFit, block_fit, of_each
from jaximp.identification.rows import Rows
from jaximp.types import Numbers, Recording


class Separated(NamedTuple):
    """What a method says of `u`, parameters of what was added to a robot."""

    u: Numbers
    """(d,)"""
    sources: tuple[tuple[Numbers, BlockFit], ...]
    """The fits whose errors it has, each with rows (d, p): what the fit's parameters add to `u`."""
    by_joint: Numbers
    """(d, n) what the torques of each joint make of it by themselves; they add up to `u`."""
    left: Numbers
    """(n,)"""
    notes: tuple[str, ...] = ()


def from_the_rest(
    load: Numbers, rows: Rows, robots: Numbers, robot: BlockFit, notes: tuple[str, ...] = ()
) -> tuple[Separated, BlockFit]:
    """What was added to a robot from what the robot's model leaves of a torque; and the fit that says so.

    **Arguments:** columns of the `load` (S, n, d); `rows` whose torque is explained; columns of the robot (S, n, p).
    """
    torque = np.asarray(rows.torque)
    fit = block_fit(Rows(load, torque - robots @ robot.theta, rows.valid, rows.time))
    imitated = fit.solve(robots)
    by_joint = fit.solve(of_each(torque)) - imitated @ robot.by_joint
    sources = (np.eye(len(fit.theta)), fit), (-imitated, robot)
    return Separated(fit.theta, sources, by_joint, fit.size, notes), fit


def together(empty: Rows, full: Rows, load: Numbers) -> tuple[Separated, BlockFit]:
    """What was added to a robot, and the robot, from the rows without and with it; and the fit that says so.

    **Arguments:** columns of the `load` (S, n, d) in the rows with it.
    """
    none = np.zeros((*np.shape(empty.torque), load.shape[-1]))
    W = np.concatenate([np.concatenate([x.W, added], axis=-1) for x, added in ((empty, none), (full, load))])
    torque, valid, time = (
        np.concatenate([getattr(x, key) for x in (empty, full)]) for key in ("torque", "valid", "time")
    )
    fit = block_fit(Rows(W, torque, valid, time))
    of_load = np.eye(W.shape[-1])[empty.W.shape[-1] :]
    return Separated(of_load @ fit.theta, ((of_load, fit),), of_load @ fit.by_joint, fit.size), fit


def gains_of(several: Sequence[Recording]) -> Numbers | None:
    """(n, n) covariance of the relative errors of the drives' gains.

    **Raises:** `ValueError` where recordings state different ones.
    """
    stated = [one.gain_covariance for one in several]
    first = stated[0]
    for other in stated[1:]:
        if (first is None) != (other is None) or (first is not None and not np.array_equal(first, np.asarray(other))):
            raise ValueError("the recordings state different errors of the gains: they are those of the same drives")
    return first
