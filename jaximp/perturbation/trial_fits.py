"""Standard errors of an arm: its damping and stiffness from all trials, from halves, and with another inertia.

The fits of all trials, of both halves, and for an inertia that is one standard error larger go in one batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from jaximp.perturbation.deviations import Deviations, JointDeviations, KnownArm, joint_deviations
from jaximp.perturbation.isolation.isolated import Impedance
from jaximp.perturbation.isolation.output_error import DELAYS
from jaximp.perturbation.stiffness import (
    LinearFit,
    StiffnessFit,
    fit_triangles,
    fit_triangles_linear,
    residual_triangle,
)
from jaximp.perturbation.trials import Trials
from jaximp.types import AnyArray, Numbers

BATCH = 68
"""Fits that go together: four of each length of the window that is tried."""
LATE = f"the motion seems to lag its command by {1e3 * DELAYS:g} ms or more"
NOT_FINITE = "a number is not finite"
NOT_CONVERGED = "did not converge"


@dataclass(frozen=True)
class Fitted:
    """What was made of the deviations."""

    theta: Numbers
    """(p,) elements of damping and stiffness, see `ArmEstimate`."""
    covariance: Numbers
    dof: float
    failure: str
    """Why there is no estimate."""
    on_boundary: bool = False
    vaf: float = np.nan
    held_out_vaf: float = np.nan
    asked: float = np.nan
    """See `Evidence`."""


def with_torques(
    perturbed: Trials, deviations: Deviations, arm: KnownArm, linearised: bool
) -> tuple[JointDeviations, list[Array]]:
    """Deviations of the joints, and the torques for an inertia that is one standard error larger in each parameter."""
    stderr = np.zeros(3) if arm.inertia_stderr is None else np.asarray(arm.inertia_stderr, float)
    tried = np.asarray(arm.inertia, float) + np.vstack([np.zeros(3), np.diag(stderr)])
    joint, *moved = (
        joint_deviations(perturbed, deviations, KnownArm(arm.geometry, jnp.asarray(inertia), arm.handle), linearised)
        for inertia in tried
    )
    return joint, [one.torque for one in moved]


def as_given(own: Impedance) -> Fitted:
    """By a method that estimates it itself."""
    D, K, covariance = (np.asarray(x) for x in (own.D, own.K, own.covariance))
    failure = "" if own.converged else LATE if abs(float(own.delay)) >= DELAYS else NOT_CONVERGED
    if not np.isfinite([D, K]).all():
        failure = NOT_FINITE
    theta = np.concatenate([D.ravel(), K[[0, 0, 1], [0, 1, 1]]])
    return Fitted(theta, covariance, float(own.dof), failure, asked=smallest_eigenvalue(K))


def fit_deviations(joint: JointDeviations, moved: Sequence[Array], linearised: bool) -> Fitted:
    """All trials with the given inertia and with others, and both halves of the trials.

    **Arguments:** as `with_torques` returns them; `linearised` for a stiffness of four free numbers.
    """
    trials, samples = joint.torque.shape[:2]
    triangles = _triangles(joint, moved, np.ones(samples, bool))
    halves = np.arange(trials) % 2 == np.arange(2)[:, None]
    counts = np.concatenate([np.ones((4, trials), bool), halves])
    batch = np.asarray(triangles)[[0, 1, 2, 3, 0, 0]]
    fit = _fit_batch(batch, np.full(len(counts), samples), counts, linearised)
    D, K, own = np.asarray(fit.D), np.asarray(fit.K), np.asarray(triangles[0])
    singular = isinstance(fit, StiffnessFit) and bool(fit.on_boundary[0])
    unseen = [_left_over(own[~half], D[4 + k], K[4 + k]) for k, half in enumerate(halves)]
    theta = np.asarray(fit.theta)
    return Fitted(
        theta=theta[0],
        covariance=np.asarray(fit.covariance)[0] + _of_inertia(theta[:4]),
        dof=float(fit.dof[0]),
        failure=str(fit.why()[0]),
        on_boundary=singular,
        vaf=_vaf(*_left_over(own, D[0], K[0])),
        held_out_vaf=_vaf(*np.sum(unseen, axis=0)),
        asked=_asked_for(triangles, samples) if singular else smallest_eigenvalue(K[0]),
    )


def fit_windows(
    joint: JointDeviations, moved: Sequence[Array], inside: NDArray[np.bool_], linearised: bool
) -> tuple[Numbers, Numbers, Numbers]:
    """Estimates (L, p), standard errors and degrees of freedom (L,) for windows of the (L, S) samples `inside`."""
    trials = joint.torque.shape[0]
    batch = jax.vmap(lambda some: _triangles(joint, moved, some))(jnp.asarray(inside)).reshape(-1, trials, 6, 6)
    samples = np.repeat(inside.sum(axis=1), 4)
    fit = _fit_batch(batch, samples, np.ones((len(samples), trials), bool), linearised)
    theta = np.asarray(fit.theta).reshape(len(inside), 4, -1)
    added = np.diagonal(_of_inertia(theta), axis1=1, axis2=2)
    variance = np.asarray(fit.stderr)[::4] ** 2 + added
    return theta[:, 0], np.sqrt(variance), np.asarray(fit.dof)[::4]


def smallest_eigenvalue(K: Numbers) -> float:
    """Of the symmetric part."""
    return float(np.linalg.eigvalsh((K + K.T) / 2)[0]) if np.isfinite(K).all() else np.nan


def _triangles(joint: JointDeviations, moved: Sequence[Array], inside: Bool[AnyArray, " S"]) -> Float[Array, "4 T 6 6"]:
    """Of the samples `inside` of the trials, with the torque for the given inertia first."""
    torque = np.stack([joint.torque, *moved])
    displacement, velocity = (np.broadcast_to(x, torque.shape) for x in (joint.displacement, joint.velocity))
    return residual_triangle(displacement, velocity, torque, jnp.broadcast_to(inside, torque.shape[:-1]))


def _of_inertia(theta: Numbers) -> Numbers:
    """(..., p, p) covariance that the standard errors of the inertia add to the first of estimates (..., 4, p)."""
    moves = theta[..., 1:, :] - theta[..., :1, :]
    return np.asarray(np.swapaxes(moves, -1, -2) @ moves)


def _fit_batch(
    triangles: Float[AnyArray, "B T 6 6"], samples: NDArray[np.int64], counts: NDArray[np.bool_], linearised: bool
) -> LinearFit:
    """Fits of a batch, which is filled up to one size: all of them share their compiled code."""
    filled = np.resize(np.arange(len(samples)), BATCH)
    fit = fit_triangles_linear if linearised else fit_triangles
    found = fit(np.asarray(triangles)[filled], samples[filled, None], counts=counts[filled])
    return jax.tree.map(lambda x: np.asarray(x)[: len(samples)], found)


def _left_over(triangles: Numbers, D: Numbers, K: Numbers) -> tuple[float, float]:
    """Sums of squares of the torque that is not accounted for, and of all of it, over the trials of (T, 6, 6)."""
    torque = triangles[..., 4:]
    left = torque - triangles[..., :2] @ D.T - triangles[..., 2:4] @ K.T
    return float((left**2).sum()), float((torque**2).sum())


def _vaf(left: float, torque: float) -> float:
    return float(1 - left / torque) if torque > 0 else np.nan


def _asked_for(triangles: Float[Array, "4 T 6 6"], samples: int) -> float:
    """Smaller eigenvalue of the stiffness that the data ask for, without the demand that it be definite [N m/rad]."""
    trials = triangles.shape[1]
    free = _fit_batch(triangles[:1], np.array([samples]), np.ones((1, trials), bool), True)
    return smallest_eigenvalue(np.asarray(free.K)[0])
