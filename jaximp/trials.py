"""Perturbation trials of an arm: from the position of the hand and the force on it to rows for least squares.

Lakatos et al. 2011, IV-C: joint angles by inverse kinematics, joint torques by `J' F`, both less their steady state
before the perturbation, filters without phase, derivatives.
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

from jaximp.job import FilterSettings
from jaximp.least_squares import WindowFit, least_squares, variance_accounted_for
from jaximp.models import ArmGeometry, PlanarArm
from jaximp.recordings import load_recording
from jaximp.regression import design_filters, filtered
from jaximp.types import AnyArray, Numbers, Recording

STEADY = 0.02
"""A command has left its steady state where it differs from it by such a share of its largest difference."""


STRAIGHT = 0.05
"""Angle of the elbow [rad] below which an arm counts as straight."""
FLAT = 0.05
"""Smallest over largest singular value of the perturbations from which on they span the plane."""


class Trials(eqx.Module):
    """T trials of one length, cut so that the perturbation begins at the same sample in all of them."""

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
    """See `Trials`."""
    noise: Float[Array, " L"] | None
    """What the filters make of white noise of the torque: its autocovariance by lag, in rows."""

    def at_hand(self) -> TrialRows:
        """The same equations as forces on the hand: there the noise of both axes is alike, which that of the joints'
        torques is not. (The Jacobian is taken as constant during a trial.)"""
        (a, c), (b, d) = self.jacobian[..., 0].T, self.jacobian[..., 1].T
        inverse = jnp.stack([jnp.stack([d, -c], axis=-1), jnp.stack([-b, a], axis=-1)], axis=-2)
        inverse = (inverse / (a * d - b * c)[:, None, None])[:, None]
        W, torque = (inverse[..., None] * self.W[:, :, None]).sum(axis=3), (inverse * self.torque[:, :, None]).sum(-1)
        return TrialRows(W, torque, self.time, self.peaks, self.jacobian, self.noise)


def joint_trials(
    geometry: ArmGeometry,
    position: Num[AnyArray, "T N 2"],
    force: Num[AnyArray, "T N 2"],
    onset: int,
    sample_rate: float,
) -> Trials:
    """Angles and torques of the joints from the position of the hand [m] and the force on it [N].

    **Arguments:** all trials begin their perturbation at the sample `onset`; what is before it is the steady state.

    **Raises:** `ValueError` for positions out of reach, and for an elbow that is nearly straight or folded.

    **Source:** Lakatos et al. 2011, IV-C.
    """
    q = geometry.inverse(position)
    _check_elbow(q)
    torque = geometry.joint_torque(q, force)
    steady = slice(0, onset)
    equilibrium = q[:, steady].mean(axis=1)
    away = torque - torque[:, steady].mean(axis=1, keepdims=True)
    return Trials(q, away, equilibrium, geometry.jacobian(equilibrium), onset, sample_rate)


def read_trials(
    recordings: Sequence[Recording],
    geometry: ArmGeometry,
    onset: float | Sequence[float] | None = None,
    before: float = 0.1,
    after: float = 0.5,
) -> Trials:
    """Trials from recordings of the hand, one each: joints `("prismatic", "prismatic")`, positions [m], forces [N].

    **Arguments:** `onset` of the perturbation [s] in each recording's own time; where it is not given it is found in
    the `reference` of the recording, the position or force that was commanded. `before` and `after` [s] are kept around
    it; the mean of `before` is the steady state.

    **Raises:** `ValueError` that names the trial, for one that has no onset, is too short around it, has gaps there, is
    no recording of a hand in a plane, or was sampled at another rate.
    """
    if not recordings:
        raise ValueError("there are no trials: give at least one recording")
    rate = recordings[0].sample_rate
    onsets = np.broadcast_to(np.nan if onset is None else np.asarray(onset, float), len(recordings))
    n_before, n_after = round(before * rate), round(after * rate)
    if n_before < 2 or n_after < 2:
        raise ValueError(f"{before:g} s before the onset and {after:g} s after it are no two samples each: keep more")
    position, force = [], []
    for k, (recording, given) in enumerate(zip(recordings, onsets, strict=True)):
        name = f"trial {k + 1} ({recording.name})" if recording.name else f"trial {k + 1}"
        _check_hand(name, recording, rate)
        start = recording.time[0]
        first = find_onset(name, recording) if np.isnan(given) else round((given - start) * rate)
        part = slice(first - n_before, first + n_after)
        if part.start < 0 or part.stop > len(recording):
            raise ValueError(
                f"{name} lasts from {recording.time[0]:g} to {recording.time[-1]:g} s, but {before:g} s before and "
                f"{after:g} s after its onset at {start + first / rate:g} s are wanted: keep less, or leave it out"
            )
        if not recording.valid[part].all():
            raise ValueError(f"{name} has a gap around its onset at {start + first / rate:g} s: leave it out")
        position.append(recording.position[part])
        force.append(recording.torque[part])
    return joint_trials(geometry, np.stack(position), np.stack(force), n_before, rate)


def load_trials(
    files: Sequence[str | os.PathLike[str]],
    geometry: ArmGeometry,
    model: PlanarArm,
    settings: FilterSettings,
    *,
    onset: float | Sequence[float] | None = None,
    before: float = 0.1,
    after: float = 0.5,
    **mapping: Any,
) -> TrialRows:
    """From trial files to rows for least squares, in one call.

    **Arguments:** `mapping` says where the columns are, as in `load_recording`: `time` or `sample_rate`, `position` of
    the hand [m] and `torque` for the force on it [N], two columns each, and `reference` for what was commanded. The
    rest as in `read_trials` and `regress_trials`.

    **Raises:** as those three.
    """
    recordings = [load_recording(file, joint="prismatic", **mapping) for file in files]
    return regress_trials(model, read_trials(recordings, geometry, onset, before, after), settings)


def find_onset(name: str, recording: Recording) -> int:
    """Index of the last sample at which the commanded position or force is still what it was at the beginning."""
    command = recording.reference
    if command is None:
        raise ValueError(
            f"{name}: its onset is not known: pass onset=, or map the commanded position or force as the reference"
        )
    away = np.abs(command - command[0]).max(axis=1)
    if not (away > 0).any():
        raise ValueError(f"{name}: no perturbation was found, its command is constant: leave it out, or pass onset=")
    return max(0, int(np.argmax(away > STEADY * away.max())) - 1)


def _check_hand(name: str, recording: Recording, rate: float) -> None:
    if recording.joints != ("prismatic", "prismatic"):
        raise ValueError(
            f"{name} is not a recording of a hand in a plane: load it with joint='prismatic', two columns of the "
            "position and two of the force"
        )
    if abs(recording.sample_rate - rate) > 1e-3 * rate:
        raise ValueError(
            f"{name} was sampled at {recording.sample_rate:g} Hz and trial 1 at {rate:g} Hz: resample one of them"
        )


def regress_trials(model: PlanarArm, trials: Trials, settings: FilterSettings) -> TrialRows:
    """Filter every trial and evaluate the model on it, with the trial's own equilibrium in place of the model's.

    **Source:** Lakatos et al. 2011, eqs. (12), (13).
    """

    filters = design_filters(settings, trials.sample_rate)

    def one(q: Array, torque: Array, equilibrium: Array) -> tuple[Array, Array]:
        return filtered(model.at(equilibrium), filters, trials.sample_rate, q, torque)[:2]

    W, torque = eqx.filter_jit(jax.vmap(one))(trials.angles, trials.torque, trials.equilibrium)
    n = trials.angles.shape[1]
    time = (jnp.arange(n)[:: filters.decimate] - trials.onset) / trials.sample_rate
    away = trials.angles - trials.equilibrium[:, None]
    farthest = jnp.argmax((away**2).sum(axis=-1), axis=1)
    noise = None if filters.noise is None else jnp.asarray(filters.noise)
    return TrialRows(W, torque, time, away[jnp.arange(len(away)), farthest], trials.jacobian, noise)


def fit_trials(
    rows: TrialRows,
    observed: float | Num[AnyArray, ""],
    counts: Bool[AnyArray, " T"] | None = None,
    at_hand: bool = True,
) -> WindowFit:
    """One set of parameters from the first `observed` seconds after the onset of all trials, eq. (14).

    **Arguments:** `counts` (T,) False for trials that are held out. The noise is that of the force: `at_hand` weighs
    the equations accordingly. Without it the joints' torques count alike, as in the paper, and standard errors are up
    to 1.4 times too small or too large.

    **Raises:** `ValueError` for fewer rows than parameters, and for directions that do not span the plane.
    """
    T, N, n, p = rows.W.shape
    if T * N * n < p:
        raise ValueError(f"{T} trials of {N} samples cannot determine {p} parameters: record more, or observe longer")
    if not isinstance(rows.peaks, jax.core.Tracer) and not isinstance(counts, jax.core.Tracer):
        _check_directions(np.asarray(rows.peaks)[slice(None) if counts is None else np.asarray(counts, bool)])
    rows = rows.at_hand() if at_hand else rows
    shape = (T * N, n)
    valid = jnp.broadcast_to(_observed(rows, observed, counts).reshape(-1, 1), shape)
    return least_squares(rows.W.reshape(*shape, p), rows.torque.reshape(shape), valid, rows.noise)


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


def _check_directions(peaks: Numbers) -> None:
    """Perturbations along one line tell nothing of the stiffness across it."""
    singular = np.linalg.svd(peaks, compute_uv=False)
    if len(peaks) < 2 or not singular[-1] > FLAT * singular[0]:
        raise ValueError(
            f"the directions of {len(peaks)} trials do not span the plane of the two joints: perturb in at least two "
            "directions"
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
