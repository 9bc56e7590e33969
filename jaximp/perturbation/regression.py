"""Perturbed postures of an arm by one linear regression: inertia, damping and stiffness together.

Lakatos et al. 2011, IV-C: joint angles by inverse kinematics, joint torques by `J' F`, both less their steady state
before the perturbation, filters without phase, derivatives; eqs. (12) to (14).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num

from jaximp.identification.filter_settings import FilterSettings, design_filters
from jaximp.identification.rows import filtered
from jaximp.least_squares.window import WindowFit, least_squares, variance_accounted_for
from jaximp.models.arm import PlanarArm
from jaximp.models.kinematics import ArmGeometry
from jaximp.numerics.lanes import solve_definite
from jaximp.numerics.linear_algebra import solve_pair
from jaximp.perturbation.onsets import NOISE
from jaximp.perturbation.reading import read_trials
from jaximp.perturbation.trials import check_directions
from jaximp.recordings.load import load_recording
from jaximp.signals.filters import kept_variance
from jaximp.types import AnyArray

STEADY = 0.005
"""Before the onset the hand drifts by no more than such a share of what it moves after it."""
STRAIGHT = 0.05
"""Angle of the elbow [rad] below which an arm counts as straight."""


class JointTrials(eqx.Module):
    """T perturbed postures at the joints, of one length, with the perturbation beginning at the same sample."""

    angles: Float[Array, "T N 2"]
    """Of the joints [rad]."""
    torque: Float[Array, "T N 2"]
    """Of the outside force on the joints, less its mean before the onset [N m]."""
    equilibrium: Float[Array, "T 2"]
    """Mean angles before the onset [rad]."""
    jacobian: Float[Array, "T 2 2"]
    """Of the hand's position there [m/rad]."""
    onset: int = eqx.field(static=True)
    """Index of the sample at which the perturbation begins."""
    sample_rate: float = eqx.field(static=True)
    """[Hz]."""

    def __len__(self) -> int:
        return len(self.angles)


class TrialRows(eqx.Module):
    """Trials as least squares sees them, trial after trial."""

    W: Float[Array, "T N 2 p"]
    torque: Float[Array, "T N 2"]
    """[N m]."""
    time: Float[Array, " N"]
    """From the onset [s]."""
    peaks: Float[Array, "T 2"]
    """Displacement of the joints [rad] where each trial is farthest from its equilibrium."""
    jacobian: Float[Array, "T 2 2"]
    """See `JointTrials`."""
    noise: Float[Array, " L"]
    """What the filters make of white noise of the torque: its autocovariance by lag, in rows."""
    kept: float = eqx.field(static=True)
    """Share of that noise's variance that the filters leave."""
    baseline: int = eqx.field(static=True)
    """Samples before the onset whose mean was taken off the torque."""

    def at_hand(self) -> TrialRows:
        """The same equations as forces on the hand: there the noise of both axes is alike, which that of the joints'
        torques is not. (The Jacobian is taken as constant during a trial.)"""
        transposed = self.jacobian.swapaxes(-1, -2)[:, None]
        W = solve_pair(transposed[:, :, None], self.W.swapaxes(-1, -2)).swapaxes(-1, -2)
        return eqx.tree_at(lambda rows: (rows.W, rows.torque), self, (W, solve_pair(transposed, self.torque)))


def joint_trials(
    geometry: ArmGeometry,
    position: Num[AnyArray, "T N 2"],
    force: Num[AnyArray, "T N 2"],
    onset: int,
    sample_rate: float,
) -> JointTrials:
    """Angles and torques of the joints from the position of the hand [m] and the force on it [N].

    **Arguments:** positions and forces in the frame of the `geometry`, which says where the shoulder is; all trials
    begin their perturbation at the sample `onset`, and what is before it is the steady state.

    **Raises:** `ValueError` for positions out of reach, for an elbow that is nearly straight or folded, for numbers
    that are not finite, and for a trial that moves before its onset.

    **Source:** Lakatos et al. 2011, IV-C.
    """
    position, force = jnp.asarray(position, float), jnp.asarray(force, float)
    _check_trials(position, force, onset)
    q = geometry.inverse(position)
    _check_elbow(q)
    torque = geometry.joint_torque(q, force)
    steady = slice(0, onset)
    equilibrium = q[:, steady].mean(axis=1)
    away = torque - torque[:, steady].mean(axis=1, keepdims=True)
    return JointTrials(q, away, equilibrium, geometry.jacobian(equilibrium), onset, sample_rate)


def load_trials(
    files: Sequence[str | os.PathLike[str]],
    geometry: ArmGeometry,
    model: PlanarArm,
    settings: FilterSettings,
    *,
    onset: float | Sequence[float] | None = None,
    before: float = 0.2,
    after: float = 0.5,
    **mapping: Any,
) -> TrialRows:
    """From trial files to rows for least squares, in one call.

    **Arguments:** `mapping` says where the columns are, as in `load_recording`: `time` or `sample_rate`, `position` of
    the hand [m] and `torque` for the force on it [N], two columns each, and `reference` for the position that was
    commanded, or `command` for the force. `onset`, `before` and `after` as in `read_trials`; the mean of `before` is
    the steady state. The rest as in `joint_trials` and `regress_trials`.

    **Raises:** as those four.
    """
    recordings = [load_recording(file, joint="prismatic", **mapping) for file in files]
    # The filters come later: they are those of the regression, on both of its sides alike.
    read, _, _ = read_trials(
        recordings, "posture", onset=onset, before=before, after=after, geometry=geometry, cutoff=None
    )
    trials = joint_trials(geometry, read.position, read.force, int(read.onset[0]), read.sample_rate)
    return regress_trials(model, trials, settings)


def regress_trials(model: PlanarArm, trials: JointTrials, settings: FilterSettings) -> TrialRows:
    """Filter every trial and evaluate the model on it, with the trial's own equilibrium in place of the model's.

    **Raises:** `ValueError` for a model without impedance, and for filters that do not suit trials: they need a
    `decimation_cutoff`, or the noise of the acceleration would bias everything, and no high-pass.

    **Source:** Lakatos et al. 2011, eqs. (12), (13).
    """

    if model.equilibrium is None:
        raise ValueError("trials tell of damping and stiffness: make the arm with PlanarArm((0, 0)) or without inertia")
    if settings.decimation_cutoff is None or settings.high_pass is not None or settings.mode != "once":
        raise ValueError(
            "trials need filter.decimation_cutoff (such as 25 Hz), without which noise of the position biases "
            "everything, and neither a high-pass nor filters inside windows"
        )
    filters = design_filters(settings, trials.sample_rate)

    def one(q: Array, torque: Array, equilibrium: Array) -> tuple[Array, Array]:
        return filtered(model.at(equilibrium), filters, trials.sample_rate, q, torque)[:2]

    W, torque = eqx.filter_jit(jax.vmap(one))(trials.angles, trials.torque, trials.equilibrium)
    n = trials.angles.shape[1]
    time = (jnp.arange(n)[:: filters.decimate] - trials.onset) / trials.sample_rate
    away = trials.angles - trials.equilibrium[:, None]
    farthest = jnp.argmax((away**2).sum(axis=-1), axis=1)
    assert filters.parallel is not None
    return TrialRows(
        W, torque, time, away[jnp.arange(len(away)), farthest], trials.jacobian, jnp.asarray(filters.noise),
        kept_variance(filters.parallel), trials.onset,
    )  # fmt: skip


def fit_trials(
    rows: TrialRows,
    observed: float | Num[AnyArray, ""],
    counts: Bool[AnyArray, " T"] | None = None,
    at_hand: bool = True,
) -> WindowFit:
    """One set of parameters from the first `observed` seconds after the onset of all trials, eq. (14).

    **Arguments:** `counts` (T,) False for trials that are held out. The noise is that of the force: `at_hand` weighs
    the equations accordingly. Without it the joints' torques count alike, as in the paper, and the standard errors are
    those of noise that is alike in both joints, which it is not.

    **Returns:** a `WindowFit` whose standard errors include that of the steady state, which all samples of a trial have
    in common. At the hand its `cond`, `vaf` and `residual_rms` [N] are those of the hand's equations;
    the paper's condition number (19) is that without `at_hand`.

    **Raises:** `ValueError` for fewer rows than parameters, and for directions that do not span the plane.
    """
    T, N, n, p = rows.W.shape
    if counts is not None and np.shape(counts) != (T,):
        raise ValueError(f"counts has shape {np.shape(counts)}: give True or False for each of {T} trials")
    if T * N * n < p:
        raise ValueError(f"{T} trials of {N} samples cannot determine {p} parameters: record more, or observe longer")
    if not any(isinstance(x, jax.core.Tracer) for x in (rows.peaks, counts, observed)):
        longest = float(rows.time[-1])
        if not 0 < float(observed) <= longest + 1.5 * float(rows.time[1] - rows.time[0] if N > 1 else 0):
            raise ValueError(f"observed is {float(observed):g} s, but the trials last {longest:.4g} s after the onset")
        peaks = np.asarray(rows.peaks)[slice(None) if counts is None else np.asarray(counts, bool)]
        check_directions(peaks, f"{len(peaks)} trials")
    rows = rows.at_hand() if at_hand else rows
    shape = (T * N, n)
    counted = _observed(rows, observed, counts)
    valid = jnp.broadcast_to(counted.reshape(-1, 1), shape)
    fit = least_squares(rows.W.reshape(*shape, p), rows.torque.reshape(shape), valid, rows.noise)
    return _with_error_of_the_baseline(fit, rows, counted)


def _with_error_of_the_baseline(fit: WindowFit, rows: TrialRows, counted: Array) -> WindowFit:
    """White noise of variance s^2 leaves s^2 / baseline in the mean that was taken off each trial and axis; the
    parameters inherit it through the sum of what each sample contributes to them."""
    W = jnp.where(counted[..., None, None], rows.W, 0)
    p = W.shape[-1]
    passed_on = solve_definite(jnp.einsum("tnap,tnaq->pq", W, W), W.sum(axis=1).reshape(-1, p).T)
    rows_left = fit.samples - p
    white = fit.residual_rms**2 * fit.samples / jnp.where(rows_left > 0, rows_left, jnp.nan) / rows.kept
    covariance = fit.covariance + white / rows.baseline * passed_on @ passed_on.T
    stderr = jnp.sqrt(jnp.diagonal(covariance))
    return eqx.tree_at(lambda fit: (fit.covariance, fit.stderr), fit, (covariance, stderr))


def predict_trials(
    rows: TrialRows,
    theta: Num[AnyArray, " p"],
    observed: float | Num[AnyArray, ""],
    counts: Bool[AnyArray, " T"] | None = None,
) -> tuple[Float[Array, "T N 2"], Float[Array, ""]]:
    """Torques [N m] that parameters predict, and the variance that they account for in trials they have not seen.

    **Arguments:** `observed` [s] after the onset count; `counts` (T,) True for the trials that were held out.
    """
    predicted = rows.W @ jnp.asarray(theta)
    weight = jnp.broadcast_to(_observed(rows, observed, counts)[..., None], predicted.shape).astype(float)
    flat = [x.reshape(-1, 2) for x in (rows.torque, rows.torque - predicted, weight)]
    return predicted, variance_accounted_for(*flat)


def _observed(rows: TrialRows, observed: float | AnyArray, counts: AnyArray | None) -> Array:
    """(T, N) samples from the onset to the end of the observation, of the trials that count."""
    # Half a sample of grace: times are multiples of the sampling interval only up to rounding.
    grace = (rows.time[1] - rows.time[0]) / 2 if len(rows.time) > 1 else 0.0
    inside = (rows.time >= -grace) & (rows.time < observed + grace)
    return jnp.broadcast_to(inside, rows.W.shape[:2]) & (True if counts is None else jnp.asarray(counts)[:, None])


def _check_trials(position: Array, force: Array, onset: int) -> None:
    """Shapes, numbers, and a steady state before the onset."""
    if position.ndim != 3 or position.shape[-1] != 2 or force.shape != position.shape:
        raise ValueError(
            f"position has shape {position.shape} and force {force.shape}: both must be (trials, samples, 2)"
        )
    if not 4 <= onset < position.shape[1] - 1:
        raise ValueError(
            f"onset is sample {onset} of {position.shape[1]}: it must leave a steady state of four before it"
        )
    if isinstance(position, jax.core.Tracer) or isinstance(force, jax.core.Tracer):
        return
    for name, x in (("position", np.asarray(position)), ("force", np.asarray(force))):
        bad = np.flatnonzero(~np.isfinite(x).all(axis=(1, 2)))
        if len(bad):
            raise ValueError(f"trial {bad[0] + 1}: its {name} is not finite everywhere: leave it out")
    x, quarter = np.asarray(position), max(2, onset // 4)
    first, last = x[:, :quarter], x[:, onset - quarter : onset]
    drift = np.abs(last.mean(axis=1) - first.mean(axis=1)).max(axis=1)
    noise = np.sqrt((first.var(axis=1) + last.var(axis=1)).max(axis=1) / quarter)
    farthest = np.abs(x[:, onset:] - x[:, :onset].mean(axis=1, keepdims=True)).max(axis=(1, 2))
    moving = np.flatnonzero((drift > STEADY * farthest) & (drift > NOISE * noise))
    if len(moving):
        k = moving[0]
        raise ValueError(
            f"trial {k + 1} moves before its onset, by {drift[k]:.2g} m of {farthest[k]:.2g} m: the onset is late, or "
            "the hand was not at rest; pass an earlier onset="
        )


def _check_elbow(q: Array) -> None:
    if isinstance(q, jax.core.Tracer):
        return
    bend = np.abs(np.sin(np.asarray(q)[..., 1])).min(axis=1)
    if (bend < STRAIGHT).any():
        worst = int(np.nanargmin(bend))
        raise ValueError(
            f"trial {worst + 1}: the elbow comes within {bend[worst]:.2g} rad of straight or folded, where the hand "
            "does not tell the angles of the joints: choose another posture, or check the lengths of the arm"
        )
