"""Stribeck's curve of each motor's friction, from a recording: least squares that are linear in all else.

For every curve the other parameters follow by linear least squares. What they leave is a function of the curves alone,
which the method of Levenberg and Marquardt makes small: variable projection, Golub and Pereyra 1973.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array
from numpy.typing import NDArray

from jaximp import signals
from jaximp.identification.pipeline import Pipeline
from jaximp.identification.rows import Rows, measured_motion
from jaximp.identification.weighted import by_size, covariance_of, sizes_of_joints
from jaximp.models.chain import Chain
from jaximp.models.friction import Speed, stribeck
from jaximp.types import AnyArray, Numbers, Recording, listed

CURVE = ".stribeck_friction"
EXPONENTS = (0.3, 6.0)
SLOWEST = 3e-3
"""Velocities of a curve lie between this share of a motor's largest and that itself."""
STARTS = (0.02, 0.1, 0.4)
"""Shares of the largest velocity from which curves are sought."""
STEPS, TOLERANCE = 100, 1e-8
LEAST = 1e-4
"""A curve of which so small a share is seen beside all other columns is not determined."""
UNSURE = 0.5
"""Standard error of a logarithm above which a number is said not to be determined."""


class _Problem(eqx.Module):
    """What the curves are fitted to; rows that do not count are zero."""

    speed: Array
    """(N, n) of the motors, at the recording's own rate."""
    sign: Array
    motors: AnyArray
    parallel: signals.Sections | None = eqx.field(static=True)
    decimate: int = eqx.field(static=True)
    weight: Array
    """(S, n) of the rows, zero where they do not count."""
    others: Array
    """(S n, r) orthonormal columns that all other parameters span."""
    torque: Array
    """(S n,) what these leave of it."""
    low: Array
    """(2 n,) logarithms of the least velocities and exponents."""
    high: Array

    def logs(self, x: Array) -> Array:
        """(2 n,) logarithms of velocities and exponents, within their limits, of any numbers."""
        return self.low + (self.high - self.low) * jax.nn.sigmoid(x)

    def columns(self, logs: Array) -> Array:
        """(S n, n) of the curves, filtered and weighted as the rows are."""
        velocity, exponent = jnp.exp(logs).reshape(2, -1)
        value = stribeck(Speed(self.speed, self.sign, (velocity, exponent), jnp))
        at_joints = _low_passed(self.parallel, value)[:: self.decimate, None, :] * jnp.asarray(self.motors).T
        return (at_joints * self.weight[..., None]).reshape(-1, at_joints.shape[-1])

    def left(self, x: Array, _: None = None) -> Array:
        """(S n,) what the best parameters for these curves leave of the torque."""
        C = self.columns(self.logs(x))
        C = C - self.others @ (self.others.T @ C)
        size = jnp.linalg.norm(C, axis=0)
        Q = jnp.linalg.qr(C / jnp.where(size > 0, size, 1))[0]
        return self.torque - Q @ (Q.T @ self.torque)


class Curves(NamedTuple):
    """Stribeck's curves of n motors, as a recording has them."""

    velocity: Numbers
    """(n,) [rad/s or m/s]."""
    exponent: Numbers
    """(n,)."""
    covariance: Numbers
    """(2 n, 2 n) of the logarithms of velocities, then of exponents. What the recording does not show is as unsure as
    the limits are apart."""
    slopes: Numbers
    """(S, n, 2 n) derivative of the torque by these logarithms, in the rows of the recording [N m or N]."""

    def in_words(self, names: Sequence[str]) -> str:
        """**Arguments:** `names` of the joints."""
        error, n = np.sqrt(np.diagonal(self.covariance)), len(names)
        known = [
            f"{name} at {self.velocity[k]:.2g} ± {self.velocity[k] * error[k]:.1g}, exponent "
            f"{self.exponent[k]:.2g} ± {self.exponent[k] * error[n + k]:.1g}"
            for k, name in enumerate(names)
            if error[k] < UNSURE
        ]
        unknown = [name for k, name in enumerate(names) if not error[k] < UNSURE]
        told = f"Stribeck's curves by this recording: {'; '.join(known)}" if known else ""
        loose = f"the recording does not determine Stribeck's curve of {listed(unknown)}" if unknown else ""
        return "; ".join(filter(None, [told, loose])) + "; standard errors hold what is not known of them"


def find_curves(pipeline: Pipeline, recording: Recording, rows: Rows) -> Curves:
    """The curves that explain a recording best. **Arguments:** its `rows` with any curves.

    **Raises:** `ValueError` where the recording does not determine all other parameters.
    """
    model = pipeline.model
    assert isinstance(model, Chain)
    problem, weighted, size = _problem(pipeline, model, recording, rows)
    found = [_best(problem, _start(problem, share)) for share in STARTS]
    logs = min(found, key=lambda one: float(one[1]))[0]
    of_curves = np.array([k for k, name in enumerate(model.names) if name.endswith(CURVE)])
    W, torque, valid = _with_curves(problem, weighted, of_curves, logs)
    theta = np.linalg.lstsq(W[valid], torque[valid])[0]
    slopes = np.asarray(_slopes(problem, logs, jnp.asarray(theta[of_curves]))).reshape(*valid.shape, -1)
    covariance = _covariance(W, torque, valid, slopes, np.asarray(problem.high - problem.low))
    velocity, exponent = np.exp(np.asarray(logs)).reshape(2, -1)
    return Curves(velocity, exponent, covariance, slopes * size[:, None])


def _problem(pipeline: Pipeline, model: Chain, recording: Recording, rows: Rows) -> tuple[_Problem, Rows, Numbers]:
    filters, n = pipeline.filters, model.n_joints
    motion = measured_motion(pipeline.filter, recording)
    if motion.velocity is None:
        q = _low_passed(filters.position, motion.position)
        dq = signals.differentiate(q, recording.sample_rate, filters.differentiator)[0]
    else:
        dq = _low_passed(filters.position, motion.velocity)
    speed = jnp.asarray(dq).reshape(-1, n) @ jnp.asarray(model.motors).T
    valid = np.asarray(rows.valid).reshape(-1, n)
    shaped = {"W": np.reshape(rows.W, (*valid.shape, -1)), "torque": np.reshape(rows.torque, valid.shape)}
    whole = replace(rows, valid=valid, noisy=None, **shaped)
    size = sizes_of_joints(whole)
    weighted = by_size(whole, size)
    others = [k for k, name in enumerate(model.names) if not name.endswith(CURVE)]
    W = np.where(valid[..., None], weighted.W, 0)[..., others].reshape(-1, len(others))
    Q, R = np.linalg.qr(W)
    if not (np.abs(np.diagonal(R)) > 1e-10 * np.linalg.norm(W, axis=0)).all():
        raise ValueError(
            "the recording does not determine all parameters beside Stribeck's curves: it needs a motion that excites "
            "every joint, or a smaller model"
        )
    torque = np.where(valid, weighted.torque, 0).ravel()
    fastest = np.log(np.abs(np.asarray(speed)).max(axis=0))
    low = np.concatenate([fastest + np.log(SLOWEST), np.full(n, np.log(EXPONENTS[0]))])
    high = np.concatenate([fastest, np.full(n, np.log(EXPONENTS[1]))])
    problem = _Problem(
        speed, model.sign_of(speed), model.motors, filters.parallel, filters.decimate, jnp.asarray(valid / size),
        jnp.asarray(Q), jnp.asarray(torque - Q @ (Q.T @ torque)), jnp.asarray(low), jnp.asarray(high),
    )  # fmt: skip
    return problem, weighted, size


def _low_passed(sections: signals.Sections | None, x: AnyArray) -> AnyArray:
    return x if sections is None else signals.filter_zero_phase(sections, x)


def _start(problem: _Problem, share: float) -> Array:
    n = len(problem.low) // 2
    logs = jnp.concatenate([problem.high[:n] + np.log(share), jnp.full(n, np.log(1.0))])
    inside = (logs - problem.low) / (problem.high - problem.low)
    return jnp.log(inside / (1 - inside))


@eqx.filter_jit
def _best(problem: _Problem, start: Array) -> tuple[Array, Array]:
    """Logarithms of the curves, and the sum of squares that is left."""
    solver: optx.LevenbergMarquardt[Array, Array, None] = optx.LevenbergMarquardt(TOLERANCE, TOLERANCE)
    found: optx.Solution[Array, None] = optx.least_squares(problem.left, solver, start, max_steps=STEPS, throw=False)
    return problem.logs(found.value), (problem.left(found.value) ** 2).sum()


def _with_curves(
    problem: _Problem, weighted: Rows, of_curves: NDArray[np.int64], logs: Array
) -> tuple[Numbers, Numbers, NDArray[np.bool_]]:
    """(S, n, p) weighted rows with these curves, (S, n) torque, and which of them count."""
    W, torque, valid = (np.asarray(x) for x in (weighted.W, weighted.torque, weighted.valid))
    W = W.copy()
    W[..., of_curves] = np.asarray(problem.columns(logs)).reshape(*valid.shape, -1)
    return W, torque, valid


@eqx.filter_jit
def _slopes(problem: _Problem, logs: Array, sizes: Array) -> Array:
    """(S n, 2 n) derivative of the weighted torque by the logarithms, for curves of these sizes."""
    return jax.jacfwd(lambda logs: problem.columns(logs) @ sizes)(logs)


def _covariance(W: Numbers, torque: Numbers, valid: NDArray[np.bool_], slopes: Numbers, apart: Numbers) -> Numbers:
    """(2 n, 2 n) of the logarithms, whose limits are so far `apart`."""
    p = W.shape[-1]
    flat = np.where(valid[..., None], np.concatenate([W, slopes], axis=-1), 0).reshape(-1, p + slopes.shape[-1])
    Q = np.linalg.qr(flat[:, :p])[0]
    beside = flat[:, p:] - Q @ (Q.T @ flat[:, p:])
    seen = np.linalg.norm(beside, axis=0) > LEAST * np.linalg.norm(flat[:, p:], axis=0)
    found = np.diag(apart**2 / 12)
    if seen.any():
        both, _ = covariance_of(np.concatenate([W, slopes[..., seen]], axis=-1), torque, valid)
        # Beside limits as a prior, so that nothing is less sure than they say.
        prior = np.diag(12 / apart[seen] ** 2)
        found[np.ix_(seen, seen)] = np.linalg.inv(np.linalg.inv(both[p:, p:]) + prior)
    return found
