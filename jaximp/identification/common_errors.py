"""What all rows of a recording have in common and is not known, carried into the parameters: gains behind the torques,
and Stribeck's curves."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag

from jaximp.identification.prepared import Prepared
from jaximp.identification.rows import Rows
from jaximp.identification.solving import Placement
from jaximp.least_squares.sliding import sliding_least_squares
from jaximp.least_squares.window import SlidingFit
from jaximp.types import Numbers


def common_covariance(prepared: Prepared, rows: Rows, fit: SlidingFit, place: Placement) -> Numbers:
    """(M, p, p) covariance of the estimates that comes from what is not known of gains and curves; zero without."""
    M, p = np.asarray(fit.theta).shape
    moves, covariances = [np.zeros((0, M, p))], []
    if prepared.recording.gain_covariance is not None:
        moves.append(_by_gain(prepared, rows, fit, place))
        covariances.append(prepared.recording.gain_covariance)
    if prepared.curves is not None:
        moves.append(_by_curve(prepared, prepared.curves.slopes, place))
        covariances.append(prepared.curves.covariance)
    both = np.concatenate(moves)
    covariance = block_diag(*covariances) if covariances else np.zeros((0, 0))
    return np.einsum("jmp,jk,kmq->mpq", both, covariance, both, optimize=True)


def with_common_errors(prepared: Prepared, rows: Rows, fit: SlidingFit, place: Placement) -> SlidingFit:
    """With standard errors that hold it. It is the same in all windows, and no sign of change."""
    if prepared.recording.gain_covariance is None and prepared.curves is None:
        return fit
    variance = np.diagonal(common_covariance(prepared, rows, fit, place), axis1=1, axis2=2)
    return eqx.tree_at(lambda f: f.stderr, fit, jnp.sqrt(jnp.asarray(fit.stderr) ** 2 + variance))


def _by_gain(prepared: Prepared, rows: Rows, fit: SlidingFit, place: Placement) -> Numbers:
    """(n, M, p) derivative of the estimates by the relative gain of each joint's torque.

    Estimates are linear in the torques: it is what they would be if all other torques were zero, with the weights as
    they are.
    """
    theta, n = np.asarray(fit.theta), prepared.recording.n_joints
    if n == 1:
        return theta[None]
    from_white = bool(prepared.white) and not prepared.pipeline.ordinary
    solved = prepared.white[0] if from_white else prepared.weighted or rows
    slide = partial(sliding_least_squares, window=place.window, step=place.step, valid=jnp.asarray(rows.valid))
    W, torque = jnp.asarray(solved.W), np.asarray(solved.torque)
    alone = [np.where(np.arange(n) == j, torque, 0.0) for j in range(n)]
    return np.stack([np.asarray(slide(W, jnp.asarray(one)).theta) for one in alone])


def _by_curve(prepared: Prepared, slopes: Numbers, place: Placement) -> Numbers:
    """(2 n, M, p) derivative of the estimates by the logarithms of Stribeck's curves: they make up for what these do to
    the torque."""
    rows = prepared.weighted or prepared.rows
    counted = prepared.white[0].counted if prepared.weighted else None
    size = 1.0 if counted is None else counted
    slide = partial(sliding_least_squares, window=place.window, step=place.step, valid=jnp.asarray(rows.valid))
    W, shape = jnp.asarray(rows.W), np.shape(rows.torque)
    torques = [-(slopes[..., k] / size).reshape(shape) for k in range(slopes.shape[-1])]
    return np.stack([np.asarray(slide(W, jnp.asarray(one)).theta) for one in torques])
