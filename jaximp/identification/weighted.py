"""Least squares of several joints, each counted by what is left of it, for models that leave more than noise.

What a robot's model leaves of the torque is friction and elasticity as much as noise. To whiten it would count high
frequencies most, where models are worst. So the estimates are those of filtered rows, and their standard errors come
from the scores as they are: whatever they have in common over time, and however they follow the motion.

**Source:** weighted least squares of robots, Gautier 1997; Newey and West 1987 and Andrews 1991 for the errors, with
the small samples of Kiefer and Vogelsang 2005; residuals by their leverage, MacKinnon and White 1985 (HC2).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaximp.identification.rows import Rows
from jaximp.identification.solving import Placement
from jaximp.least_squares.sliding import score, sliding_least_squares
from jaximp.least_squares.window import SlidingFit
from jaximp.types import Numbers

ROUNDS, SETTLED = 20, 1e-3
"""Sizes are found in at most so many rounds, or where they change by no more than this share."""
LEAST_LEFT = 1e-3
"""A row's residual is taken for such a share of its error at least, however much of it the parameters took."""
LONGEST = 0.25
"""Share of a window's rows over which scores are looked at together, at most."""


def sizes_of_joints(rows: Rows) -> Numbers:
    """(n,) root mean square of what the parameters of the whole recording leave of each torque; one where nothing is
    left."""
    W, torque, valid = (np.asarray(x) for x in (rows.W, rows.torque, rows.valid))
    triangles, size = triangles_of(W, torque, valid), np.ones(torque.shape[1])
    for _ in range(ROUNDS):
        stacked = np.concatenate([R / s for R, s in zip(triangles, size, strict=True)])
        theta = np.linalg.lstsq(stacked[:, :-1], stacked[:, -1])[0]
        left = np.array([np.linalg.norm(R[:, -1] - R[:, :-1] @ theta) for R in triangles])
        before, size = size, left / np.sqrt(np.maximum(valid.sum(axis=0), 1))
        size = np.where(size > 1e-9 * np.abs(torque).max(initial=0.0), size, 1.0)
        if np.abs(size / before - 1).max() < SETTLED:
            break
    return size


def triangles_of(W: Numbers, torque: Numbers, valid: NDArray[np.bool_]) -> list[Numbers]:
    """What least squares needs of each joint's rows: the triangle of its columns and torque, at most (p + 1, p + 1)."""
    whole = np.concatenate([W, torque[..., None]], axis=-1)
    return [np.asarray(np.linalg.qr(whole[valid[:, j], j])[1]) for j in range(torque.shape[1])]


def by_size(rows: Rows, size: Numbers) -> Rows:
    """Rows in units of what is left of each joint."""
    noisy = None if rows.noisy is None else np.asarray(rows.noisy) / size[:, None]
    W, torque = np.asarray(rows.W) / size[:, None], np.asarray(rows.torque) / size
    return replace(rows, W=W, torque=torque, noisy=noisy)


def weighted_fit(rows: Rows, weighted: Rows, place: Placement) -> SlidingFit:
    """All windows. **Arguments:** `rows` as they were filtered, which say how well they are explained, and `weighted`,
    the same `by_size`."""
    valid = jnp.asarray(rows.valid)
    slide = partial(sliding_least_squares, window=place.window, step=place.step, valid=valid)
    fit = slide(jnp.asarray(weighted.W), jnp.asarray(weighted.torque))
    seen = score(rows.W, rows.torque, valid, fit.theta, place.starts, place.window, place.step)
    stderr, dof = np.full(fit.theta.shape, np.nan), np.full(len(fit.theta), np.nan)
    for k in np.flatnonzero(np.isfinite(np.asarray(fit.theta)).all(axis=1)).tolist():
        part = slice(place.starts[k], place.starts[k] + place.window)
        W, torque, counts = (np.asarray(x)[part] for x in (weighted.W, weighted.torque, rows.valid))
        covariance, dof[k] = covariance_of(W, torque, counts)
        stderr[k] = np.sqrt(np.maximum(np.diagonal(covariance), 0))
    found = (stderr, dof, np.asarray(seen.vaf), np.asarray(seen.residual_rms))
    return eqx.tree_at(lambda f: (f.stderr, f.dof, f.vaf, f.residual_rms), fit, found)


def covariance_of(W: Numbers, torque: Numbers, valid: NDArray[np.bool_]) -> tuple[Numbers, float]:
    """Covariance (p, p) of least squares, and its degrees of freedom.

    **Arguments:** rows `W` (S, n, p) and `torque` (S, n) of one window, and which of them are `valid` (S, n).
    """
    rows, p = len(W), W.shape[-1]
    columns = np.where(valid[..., None], W, 0).reshape(-1, p)
    Q, R = np.linalg.qr(columns)
    y = np.where(valid, torque, 0).ravel()
    left = y - Q @ (Q.T @ y)
    error = left / np.sqrt(np.maximum(1 - (Q**2).sum(axis=1), LEAST_LEFT))
    lags = common_lags(left.reshape(valid.shape), valid)
    scores = (Q * error[:, None]).reshape(*valid.shape, p).sum(axis=1)
    spread = scores.T @ scores
    for lag in range(1, lags + 1):
        together = scores[lag:].T @ scores[:-lag]
        spread += (1 - lag / (lags + 1)) * (together + together.T)
    inverse = np.linalg.inv(R)
    share = (lags + 1) / rows
    covariance = inverse @ spread @ inverse.T / (1 - share + share**2 / 3)
    return covariance, min(1.5 / share, float(valid.sum() - p))


def common_lags(left: Numbers, valid: NDArray[np.bool_]) -> int:
    """Lags that count, by how much neighbouring residuals (S, n) have in common."""
    both = valid[1:] & valid[:-1]
    now, before = np.where(both, left[1:], 0), np.where(both, left[:-1], 0)
    common = float((now * before).sum() / max((before**2).sum(), np.finfo(float).tiny))
    common = min(max(common, 0.0), 0.97)
    strength = 4 * common**2 / ((1 - common) * (1 + common)) ** 2
    rows = len(left)
    return int(min(np.ceil(1.1447 * (strength * rows) ** (1 / 3)), LONGEST * rows))
