"""What is not known of the gains behind the torques, carried into the parameters."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaximp.identification.prepared import Prepared
from jaximp.identification.rows import Rows
from jaximp.identification.solving import Placement
from jaximp.least_squares.sliding import sliding_least_squares
from jaximp.least_squares.window import SlidingFit
from jaximp.types import Numbers


def by_gain(prepared: Prepared, rows: Rows, fit: SlidingFit, place: Placement) -> Numbers:
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


def with_gain_errors(prepared: Prepared, rows: Rows, fit: SlidingFit, place: Placement) -> SlidingFit:
    """With standard errors that hold what is not known of the gains, where that is stated. It is the same in all
    windows, and no sign of change."""
    covariance = prepared.recording.gain_covariance
    if covariance is None:
        return fit
    moves = by_gain(prepared, rows, fit, place)
    variance = np.einsum("jmp,jk,kmp->mp", moves, covariance, moves)
    return eqx.tree_at(lambda f: f.stderr, fit, jnp.sqrt(jnp.asarray(fit.stderr) ** 2 + variance))
