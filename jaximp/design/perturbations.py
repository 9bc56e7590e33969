"""Short perturbations of an arm by gradient: several trials at a time that make one regression well conditioned.

Every trial leaves rest at the onset and passes way points on a chain of minimum jerk (Lakatos et al. 2011, III-B, uses
a single polynomial). The condition number hardly depends on the size of the motion: what the optimiser looks for is
its shape, and the whole set is then scaled to its limits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num, Shaped

from jaximp.design.limits import Limits, room
from jaximp.design.objectives import log_condition
from jaximp.models.arm import PlanarArm, rigid_body_torque
from jaximp.models.inertia import BaseInertia
from jaximp.motion.trajectories import MinimumJerk
from jaximp.numerics.optimise import Found, minimise
from jaximp.numerics.precision import require_float64
from jaximp.types import AnyArray, Numbers

SAMPLES = 120
"""How many instants a trial is judged at."""
FINER = 10
"""The result must keep its limits on a grid that is so many times finer."""
MOST_STEPS = 300
SMALL = 0.01
"""Displacement [rad] of the motions that the optimiser compares: small enough for the arm to be linear."""


@dataclass(frozen=True)
class Perturbations:
    """A set of perturbations, one a trial."""

    points: Numbers
    """(T, k, 2) displacements [rad] at equal times from the onset to the end of the observation; the first is zero."""
    observed: float
    """Length of the observation [s]."""
    condition: float
    """Condition number of all trials together."""
    conditions: Numbers
    """Condition number that every start has reached, the best one first."""

    def motion(self, trial: int, t: Num[AnyArray, " N"]) -> tuple[Array, Array, Array]:
        """Displacement (N, 2) [rad] of a trial, velocity and acceleration at the times `t` [s] after the onset."""
        return _chain(jnp.asarray(self.points[trial]), self.observed)(jnp.asarray(t))


def condition_of(
    model: PlanarArm,
    posture: Num[AnyArray, "2"],
    motions: tuple[AnyArray, AnyArray, AnyArray],
    counts: Shaped[AnyArray, " N"] | None = None,
) -> Float[Array, ""]:
    """Condition number of the regressor over trials, eq. (19) of Lakatos et al. 2011.

    **Arguments:** `posture` at rest [rad]; displacements [rad], velocities and accelerations (T, N, 2); `counts` (N,)
    False for samples outside the observation.
    """
    W = _regressor(model, jnp.asarray(posture), *motions)
    W = W if counts is None else jnp.where(jnp.asarray(counts)[:, None, None], W, 0)
    return jnp.exp(log_condition(_gram(W)[None])[0])


def design_perturbations(
    model: PlanarArm,
    posture: Num[AnyArray, "2"],
    observed: float,
    inertia: BaseInertia | Num[AnyArray, "3"],
    limits: Limits,
    *,
    trials: int = 6,
    way_points: int = 4,
    starts: int = 8,
    seed: int = 0,
) -> Perturbations:
    """Perturbations that tell all parameters of an arm apart in a short observation.

    **Arguments:** `posture` (2,) at rest [rad]; `observed` [s] from the onset on; `inertia` that bounds the torque, a
    `BaseInertia`, or three numbers **in Lakatos's order**, `inertia_1` to `inertia_3` of `PlanarArm` [kg m^2]; `limits`
    of the displacement (`position` [rad], from the posture), velocity, acceleration and inertial torque, one number for
    both joints or one for each; `trials` in the set; `way_points` of each after the onset.

    **Returns:** the best of `starts` sets, as large as the limits allow.

    **Raises:** `ValueError` for settings that make no sense, an inertia that no rigid body has, displacements without a
    limit, and a limit of the jerk.
    """
    require_float64()
    if not observed > 0 or min(trials, way_points, starts) < 1:
        raise ValueError("observed must be above zero, and there must be at least one trial, way point and start")
    posture, xi = np.asarray(posture, float), BaseInertia.from_lakatos(inertia).check().lakatos
    if not (np.abs(posture) < 2 * np.pi).all() or not np.isfinite(xi).all():
        raise ValueError(f"posture {posture} and inertia {xi} must be finite, the posture in radians")
    low, high, most = room(limits, 2)
    if not (low < 0).all() or not (high > 0).all() or not np.isfinite([low, high]).all():
        raise ValueError("limits.position is the displacement from the posture: give both ends, such as (-0.05, 0.05)")
    if np.isfinite(most[2]).any():
        raise ValueError("limits.jerk is not kept by perturbations: leave it out")
    shape = (trials, way_points, 2)
    x = np.random.default_rng(seed).normal(size=(starts, math.prod(shape)))
    found = _descend(model, jnp.asarray(posture, float), jnp.asarray(observed, float), jnp.asarray(x), shape)
    order = np.argsort(np.asarray(found.value))
    points, condition = _scaled(
        model, jnp.asarray(posture, float), jnp.asarray(observed, float), found.x[order[0]].reshape(shape),
        xi, *(jnp.asarray(x) for x in (low, high, most)),
    )  # fmt: skip
    return Perturbations(np.asarray(points), observed, float(condition), np.exp(np.asarray(found.value)[order]))


@eqx.filter_jit
def _descend(model: PlanarArm, posture: Array, observed: Array, x: Array, shape: tuple[int, int, int]) -> Found:
    def objective(x: Array) -> Array:
        away, dq, ddq = _motions(_from_rest(x.reshape(shape)), observed)
        size = SMALL / jnp.sqrt((away**2).max())
        return log_condition(_gram(_regressor(model, posture, size * away, size * dq, size * ddq))[None])[0]

    return minimise(objective, x, max_steps=MOST_STEPS)


@eqx.filter_jit
def _scaled(
    model: PlanarArm,
    posture: Array,
    observed: Array,
    points: Array,
    xi: Array,
    low: Array,
    high: Array,
    most: Array,
) -> tuple[Array, Array]:
    """The set of perturbations made as large as its limits allow, and its condition number."""
    points = _from_rest(points)
    fine = _motions(points, observed, FINER * SAMPLES)
    points = points * _largest_factor(posture, fine, xi, low, high, most)
    return points, condition_of(model, posture, _motions(points, observed))


def _from_rest(points: Array) -> Array:
    return jnp.concatenate([jnp.zeros_like(points[:, :1]), points], axis=1)


def _motions(points: Array, observed: Array, samples: int = SAMPLES) -> tuple[Array, Array, Array]:
    """Displacement, velocity and acceleration (T, samples, 2)."""
    t = observed * jnp.linspace(0.0, 1.0, samples)
    away, dq, ddq = jax.vmap(lambda one: _chain(one, observed)(t))(points)
    return away, dq, ddq


def _chain(points: Array, observed: float | Array) -> MinimumJerk:
    return MinimumJerk(points, observed / (len(points) - 1))


def _regressor(model: PlanarArm, posture: Array, away: AnyArray, dq: AnyArray, ddq: AnyArray) -> Array:
    return model.at(posture).regressor(posture + jnp.asarray(away), jnp.asarray(dq), jnp.asarray(ddq))


def _gram(W: Array) -> Array:
    return jnp.einsum("...np,...nq->pq", W, W)


def _largest_factor(
    posture: Array, motions: tuple[Array, ...], xi: Array, low: Array, high: Array, most: Array
) -> Array:
    """The factor on all displacements that just keeps the limits."""
    away, dq, ddq = motions
    shares = [away / high, away / low, jnp.abs(dq) / most[0], jnp.abs(ddq) / most[1]]
    factor = 1 / jnp.stack([share.max() for share in shares]).max()
    for _ in range(20):  # the torque is nearly linear in the motion
        q, v, a = posture + factor * away, factor * dq, factor * ddq
        torque = (jnp.abs(rigid_body_torque(q, v, a, xi)) / most[3]).max()
        factor = jnp.where(torque > 1, factor / torque, factor)
    return factor
