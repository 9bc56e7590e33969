"""`jaximp reproduce lakatos2011`: how long must an arm be observed until its impedance can be trusted?

The experiment of Lakatos et al. 2011 with a simulated subject (`simulation.held_arm`): 30 perturbations in six
directions, one of them held out; the movement lasts T_k and the observation T_k + 70 ms. The paper prints neither the
subject's impedance nor the noise: both are swept, with the strength of the reflexes, over the ranges below, and every
threshold is the range of what came out of them.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from jaximp.job import FilterSettings
from jaximp.least_squares import variance_accounted_for
from jaximp.models import PlanarArm
from jaximp.regression import Filters, design_filters
from jaximp.simulation.held_arm import DIRECTIONS, HeldArm, HeldTrials, hold
from jaximp.trials import TrialRows, fit_trials, joint_trials, regress_trials
from jaximp.types import Numbers, Progress

RATE = 1000.0  # Hz
DURATIONS = np.arange(5, 41) / 100
"""T_k [s]. The paper ends at 0.3, and yet speaks of observations above 0.4."""
OBSERVED = 0.07
"""Longer than the movement the observation is [s]."""
BEFORE, AFTER = 0.15, 0.57
"""Kept around the onset [s]."""
REPEATS = 5
HELD_OUT = 29
FILTER = FilterSettings(position_cutoff=100.0, position_order=4, decimation_cutoff=25.0)
"""The paper says only that its low-pass is without phase."""
FORCE_NOISE = np.array([0.02, 0.05, 0.1])  # N
POSITION_NOISE = np.array([2e-6, 5e-6, 1e-5])  # m, with the noise of the force at the same place
REFLEX_GAINS = np.array([0.0, 0.25, 0.5, 1.0])
SEEDS = 3
NOMINAL = (1, 2, 0)
"""Noise, gain and seed of the case that is drawn."""
SAME = 0.1
"""An estimate is quasi-constant where all of it is within this share of its matrix's norm of the longest window's."""
MIN_VAF = 0.9
"""Of the held-out trial's torque."""
PAPER = {
    "inertia": [0.391, 0.155, 0.149],
    "thresholds_ms": {
        "positive definite": 320,
        "quasi-symmetric": 370,
        "quasi-constant": 400,
        "known inertia": 300,
    },
}


class Estimate(NamedTuple):
    """One set of parameters; leading axes: noise, gain, seed, duration."""

    theta: Array
    stderr: Array
    covariance: Array
    cond: Array
    held_out_vaf: Array
    predicted: Array
    """(N, 2) torque of the held-out trial [N m]."""


class Outcome(NamedTuple):
    """What one experiment with one duration gives."""

    full: Estimate
    reduced: Estimate
    """With the base inertial parameters known."""
    measured: Array
    """(N, 2) filtered torque of the held-out trial [N m]."""
    damping: Array
    """(2, 2) mean true damping in the observation."""
    stiffness: Array
    """(2, 2) mean true stiffness."""


def amplitudes(seed: int = 0) -> Numbers:
    """(30, 2) perturbations [rad] in random order, the same directions equally often."""
    return np.random.default_rng(seed).permutation(np.repeat(DIRECTIONS, REPEATS, axis=0))


def filters() -> Filters:
    return design_filters(FILTER, RATE)


def rows_of(arm: HeldArm, trials: HeldTrials) -> TrialRows:
    """From what the robot measures to rows for least squares."""
    seen = joint_trials(arm.geometry, trials.position, trials.force, round(BEFORE * RATE), RATE)
    return regress_trials(PlanarArm((0.0, 0.0)), seen, filters())  # every trial has an equilibrium of its own


def times() -> Numbers:
    return np.arange(-round(BEFORE * RATE), round(AFTER * RATE)) / RATE


@eqx.filter_jit
def sweep(arms: HeldArm, keys: PRNGKeyArray, durations: Array, inertia: Array) -> Outcome:
    """Every arm with its key, and every duration: one call."""

    def one(arm: HeldArm, key: PRNGKeyArray, duration: Array) -> Outcome:
        rows = rows_of(arm, hold(arm, amplitudes(), duration, times(), key))
        observed = duration + OBSERVED
        D, K = arm.impedance(jnp.asarray(times()))
        during = jnp.asarray(times() >= 0)[:, None, None] * (times()[:, None, None] <= observed)
        full = _estimate(rows, observed, 0)
        rigid = rows.W[..., :3] @ inertia
        reduced = _estimate(TrialRows(rows.W[..., 3:], rows.torque - rigid, rows.time), observed, 3)
        reduced = reduced._replace(predicted=reduced.predicted + rigid[HELD_OUT])
        return Outcome(
            full, reduced, rows.torque[HELD_OUT], (D * during).sum(0) / during.sum(), (K * during).sum(0) / during.sum()
        )

    def all_durations(arm_and_key: tuple[HeldArm, PRNGKeyArray]) -> Outcome:
        return jax.lax.map(lambda duration: one(*arm_and_key, duration), durations, batch_size=6)

    return jax.lax.map(all_durations, (arms, keys))


def _estimate(rows: TrialRows, observed: Array, known: int) -> Estimate:
    noise = filters().noise
    assert noise is not None
    fit = fit_trials(rows, observed, jnp.arange(len(rows.torque)) != HELD_OUT, noise)
    W, torque = rows.W[HELD_OUT], rows.torque[HELD_OUT]
    inside = ((rows.time >= 0) & (rows.time <= observed)).astype(float)
    predicted = W @ fit.theta
    vaf = variance_accounted_for(torque, torque - predicted, jnp.broadcast_to(inside[:, None], torque.shape))
    return Estimate(fit.theta, fit.stderr, fit.covariance, fit.cond, vaf, predicted)


def cases() -> tuple[HeldArm, PRNGKeyArray]:
    """Every noise with every strength of the reflexes and every seed, as one batch."""
    index = np.indices((len(FORCE_NOISE), len(REFLEX_GAINS), SEEDS)).reshape(3, -1)
    arms = eqx.filter_vmap(
        lambda force, position, gain: HeldArm(force_noise=force, position_noise=position, reflex_gain=gain)
    )(*(jnp.asarray(x) for x in (FORCE_NOISE[index[0]], POSITION_NOISE[index[0]], REFLEX_GAINS[index[1]])))
    return arms, jax.vmap(jax.random.key)(jnp.arange(index.shape[1]))


def run(progress: Progress = lambda share: None) -> tuple[Outcome, Outcome, Numbers]:
    """All cases, those without any noise and reflex, and the inertia that the paper would have called known."""
    arms, keys = cases()
    durations = jnp.asarray(DURATIONS)
    # As in the paper, the inertia comes from an identification of everything: here that of T_k = 300 ms without reflexes.
    quiet = eqx.filter_vmap(lambda gain: HeldArm(reflex_gain=gain, force_noise=0.0, position_noise=0.0))(jnp.zeros(1))
    known = HeldArm().inertia
    clean = sweep(quiet, keys[:1], durations, known)
    progress(0.1)
    shape = (len(FORCE_NOISE), len(REFLEX_GAINS), SEEDS)
    found = sweep(arms, keys, durations, known)
    return jax.tree.map(lambda x: np.asarray(x).reshape(shape + x.shape[1:]), found), clean, np.asarray(known)
