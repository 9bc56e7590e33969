"""Weighted least squares of all rows of several joints as one window, with the whole covariance.

Each joint counts by what is left of it, as in `weighted`. A robot has many parameters, which take a good part of the
noise of half a minute of motion. So scores are summed over blocks of time, as long as rows have something in common;
each block's residuals are corrected by the block's own leverage; and every parameter has its own degrees of freedom.

**Source:** blocks of time, Carlstein 1986; correction and degrees of freedom, Bell and McCaffrey 2002 (CR2), as
recommended by Imbens and Kolesar 2016 and by Pustejovsky and Tipton 2018.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaximp.identification.rows import Rows
from jaximp.identification.weighted import LEAST_LEFT, by_size, common_lags, sizes_of_joints
from jaximp.types import Numbers

SINGULAR = 1e-9
"""Share of a column that the others must leave."""
FEWEST_BLOCKS, MOST_BLOCKS = 12, 100
"""Blocks of time: more than a load has parameters."""


class Scatter(NamedTuple):
    """The covariance of least squares by blocks of time."""

    covariance: Numbers
    """(p, p), of no higher rank than there are blocks: for variances of a few sums, not to be inverted."""
    inverse: Numbers
    """(p, p) of the triangle of the rows."""
    leverage: Numbers
    """(B, p, p) of each block, in the coordinates in which all of them together are the identity."""
    correction: Numbers
    """(B, p, p) by which the block's scores were multiplied."""

    def dof(self, of: Numbers) -> Numbers:
        """(k,) degrees of freedom of the variances of `of @ parameters`; `of` (k, p)."""
        c = np.asarray(of, float) @ self.inverse
        corrected = np.einsum("bij,kj->bki", self.correction, c)
        seen = np.einsum("bij,bkj->bki", self.leverage, corrected)
        own = np.einsum("bki,bki->kb", corrected, seen)
        between = -np.einsum("bki,cki->kbc", seen, seen)
        between[:, range(len(seen)), range(len(seen))] += own
        total = np.trace(between, axis1=1, axis2=2)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(total**2 / (between**2).sum(axis=(1, 2)))


class BlockFit(NamedTuple):
    """Parameters of all rows."""

    theta: Numbers
    """(p,)"""
    scatter: Scatter
    size: Numbers
    """(n,) what is left of each torque, by which its rows count."""
    information: Numbers
    """(p, p) sum of squares of the weighted rows."""
    by_joint: Numbers
    """(p, n) the parameters that the torque of each joint makes by itself; they add up."""
    solve: Callable[[Numbers], Numbers]
    """(p, k) the parameters of other torques (S, n, k) of the same rows, with the same weights."""


def block_fit(rows: Rows) -> BlockFit:
    """**Raises:** `ValueError` where the rows do not determine all parameters."""
    size, valid = sizes_of_joints(rows), np.asarray(rows.valid)
    weighted = by_size(rows, size)
    Q, R = np.linalg.qr(np.where(valid[..., None], weighted.W, 0).reshape(-1, rows.W.shape[-1]))
    require_rank(R)

    def solve(torque: Numbers) -> Numbers:
        counted = np.where(valid[..., None], torque / size[:, None], 0)
        return np.asarray(np.linalg.solve(R, Q.T @ counted.reshape(len(Q), -1)))

    by_joint = solve(of_each(np.asarray(rows.torque)))
    return BlockFit(by_joint.sum(axis=1), scatter(weighted.W, weighted.torque, valid), size, R.T @ R, by_joint, solve)


def of_each(torque: Numbers) -> Numbers:
    """(S, n, n) the torque (S, n) of each joint by itself."""
    return torque[..., None] * np.eye(torque.shape[-1])


def require_rank(R: Numbers) -> None:
    """**Raises:** `ValueError` for a triangle whose columns depend on each other."""
    length = np.linalg.norm(R, axis=0)
    sizes = np.linalg.svd(R / np.where(length > 0, length, 1), compute_uv=False)
    if len(R) < R.shape[1] or not sizes[-1] > SINGULAR * sizes[0]:
        raise ValueError(
            "the recordings do not determine all of the robot's parameters: move every joint, or take a smaller model"
        )


def scatter(W: Numbers, torque: Numbers, valid: NDArray[np.bool_], known: Numbers | None = None) -> Scatter:
    """The covariance of least squares.

    **Arguments:** rows `W` (S, n, p) and `torque` (S, n), of which those count that are `valid` (S, n), in units of
    their errors; `known` (k, p) rows of what was known of the parameters beforehand, in units of its errors, which the
    estimate meets.
    """
    rows, p = len(W), W.shape[-1]
    columns = np.where(valid[..., None], W, 0).reshape(-1, p)
    beforehand = np.empty((0, p)) if known is None else known
    Q, R = np.linalg.qr(np.concatenate([columns, beforehand]))
    Q, of_known = Q[: len(columns)], Q[len(columns) :]
    y = np.where(valid, torque, 0).ravel()
    left = y - Q @ (Q.T @ y)
    lags = common_lags(left.reshape(valid.shape), valid)
    count = min(max(rows // (lags + 1), FEWEST_BLOCKS), MOST_BLOCKS)
    ends = np.round(np.linspace(0, rows, count + 1)).astype(int) * valid.shape[1]
    leverage, correction, spread = np.zeros((count, p, p)), np.zeros((count, p, p)), of_known.T @ of_known
    for b, (first, last) in enumerate(pairwise(ends)):
        part = Q[first:last]
        leverage[b] = part.T @ part
        values, axes = np.linalg.eigh(np.eye(p) - leverage[b])
        correction[b] = (axes / np.sqrt(np.maximum(values, LEAST_LEFT))) @ axes.T
        score = correction[b] @ (part.T @ left[first:last])
        spread = spread + np.outer(score, score)
    inverse = np.linalg.inv(R)
    return Scatter(inverse @ spread @ inverse.T, inverse, leverage, correction)
