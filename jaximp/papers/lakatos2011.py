"""`jaximp reproduce lakatos2011`: how long must an arm be observed until its impedance can be trusted?

The experiment of Lakatos et al. 2011 with a simulated subject (`simulation.held_arm`): 30 perturbations in six
directions, one of them held out; the movement lasts T_k and the observation T_k + 70 ms. The paper prints neither the
subject's impedance nor the noise: both are swept, with the strength of the reflexes, over the ranges below, and every
threshold is the range of what came out of them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray
from numpy.typing import NDArray

from jaximp import plots
from jaximp.design.limits import Limits
from jaximp.design.perturbations import condition_of, design_perturbations
from jaximp.identification.filter_settings import FilterSettings, design_filters
from jaximp.models.arm import PlanarArm, rigid_body_torque
from jaximp.motion.trajectories import MinimumJerk, SixthOrder, Trajectory, jerk
from jaximp.perturbation.regression import TrialRows, fit_trials, joint_trials, predict_trials, regress_trials
from jaximp.simulation.held_arm import DIRECTIONS, HeldArm, HeldTrials, hold, imposed_motion
from jaximp.trust.criteria import confidence, matrix_criteria
from jaximp.trust.limits import TrustLimits
from jaximp.types import Numbers, Progress

ARM = PlanarArm((0.0, 0.0))
"""Every trial has an equilibrium of its own."""
RATE = 1000.0  # Hz
OBSERVED = 0.07
"""By how much the observation is longer than the movement [s]."""
BEFORE, AFTER = 0.15, 0.57
"""Time that is kept before and after the onset [s]."""
REPEATS = 5
HELD_OUT = 29
FILTER = FilterSettings(position_cutoff=100.0, position_order=4, decimation_cutoff=25.0, derivatives="central")
"""The paper says only that its low-pass is without phase."""
SAME = 0.1
"""An estimate is quasi-constant where all of it is within this share of its matrix's norm of the longest window's."""
LIMITS = TrustLimits(min_vaf=0.9, max_asymmetry=0.05, max_relative_stderr=0.1)
"""The limits that the held-out torque, the antisymmetric part and the standard errors must keep here."""
TABULATED = (0.05, 0.1, 0.2, 0.3)
"""T_k of which Table I is printed [s]."""
PAPER: dict[str, Any] = {
    "inertia": [0.391, 0.155, 0.149],
    "thresholds_ms": {
        "positive definite": 320,
        "quasi-symmetric": 370,
        "quasi-constant": 400,
        "known inertia": 300,
    },
}


@dataclass(frozen=True)
class Sweep:
    """What is swept; by default that which `docs/results.md` shows."""

    durations: tuple[float, ...] = tuple(k / 100 for k in range(5, 41))
    """T_k [s]. The paper ends at 0.3, and yet speaks of observations above 0.4."""
    cuffs: tuple[float | None, ...] = (None, 20e3, 5e3)
    """Stiffness between robot and hand [N/m]; none where the hand follows exactly."""
    force_noise: tuple[float, ...] = (0.02, 0.1, 0.5)
    """Standard deviations [N]."""
    position_noise: tuple[float, ...] = (2e-6, 1e-5, 5e-5)
    """Standard deviations [m], each with the noise of the force at the same place."""
    reflex_gains: tuple[float, ...] = (0.0, 0.25, 0.5, 1.0)
    """Shares by which all reflexes together raise stiffness and damping."""
    seeds: int = 2
    """How many times each case is simulated."""
    nominal: tuple[int, int, int, int] = (1, 1, 2, 0)
    """Indices of cuff, noise, gain and seed of the case that is drawn."""
    designed: tuple[float, ...] = (0.12, 0.17, 0.22, 0.27, 0.32, 0.37, 0.42, 0.47)
    """Observations that perturbations are designed for [s]."""
    way_points: int = 4
    """Of every designed perturbation."""

    @property
    def observed(self) -> Numbers:
        """Length of every observation [s]."""
        return np.array(self.durations) + OBSERVED


class Estimate(NamedTuple):
    """One set of parameters; leading axes: cuff, noise, gain, seed, duration."""

    fit: Any
    """The estimate, a `WindowFit`."""
    held_out_vaf: Any
    predicted: Any
    """(N, 2) torque of the held-out trial [N m]."""


class Outcome(NamedTuple):
    """What one experiment with one duration gives."""

    full: Estimate
    reduced: Estimate
    """The estimate where the base inertial parameters are known."""
    measured: Any
    """(N, 2) filtered torque of the held-out trial [N m]."""
    damping: Any
    """(2, 2) mean true damping in the observation."""
    stiffness: Any
    """(2, 2) mean true stiffness."""


def amplitudes(seed: int = 0) -> Numbers:
    """(30, 2) perturbations [rad] in random order, the same directions equally often."""
    return np.random.default_rng(seed).permutation(np.repeat(DIRECTIONS, REPEATS, axis=0))


def rows_of(arm: HeldArm, trials: HeldTrials) -> TrialRows:
    """From what the robot measures to rows for least squares."""
    seen = joint_trials(arm.geometry, trials.position, trials.force, round(BEFORE * RATE), RATE)
    return regress_trials(ARM, seen, FILTER)


def times() -> Numbers:
    return np.arange(-round(BEFORE * RATE), round(AFTER * RATE)) / RATE


@eqx.filter_jit
def sweep(arms: HeldArm, keys: Array, durations: Array, inertia: Array) -> Outcome:
    """Every arm with its key, and every duration: one call."""

    def one(arm: HeldArm, key: PRNGKeyArray, duration: Array) -> Outcome:
        rows = rows_of(arm, hold(arm, amplitudes(), duration, times(), key))
        observed = duration + OBSERVED
        D, K = arm.impedance(jnp.asarray(times()))
        during = jnp.asarray(times() >= 0)[:, None, None] * (times()[:, None, None] <= observed)
        rest = rows.torque - rows.W[..., :3] @ inertia
        reduced = eqx.tree_at(lambda r: (r.W, r.torque), rows, (rows.W[..., 3:], rest))
        return Outcome(
            _estimate(rows, rows, observed, jnp.zeros(0)),
            _estimate(rows, reduced, observed, inertia),
            rows.torque[HELD_OUT],
            (D * during).sum(0) / during.sum(),
            (K * during).sum(0) / during.sum(),
        )

    def all_durations(arm_and_key: tuple[HeldArm, PRNGKeyArray]) -> Outcome:
        return jax.lax.map(lambda duration: one(*arm_and_key, duration), durations, batch_size=6)

    return jax.lax.map(all_durations, (arms, keys))


def _estimate(rows: TrialRows, solved: TrialRows, observed: Array, known: Array) -> Estimate:
    """Parameters from the equations that are `solved`, held against all of the torque with those that are `known`."""
    held_out = jnp.arange(len(rows.torque)) == HELD_OUT
    fit = fit_trials(solved, observed, ~held_out, at_hand=False)  # as the paper
    predicted, vaf = predict_trials(rows, jnp.concatenate([known, fit.theta]), observed, held_out)
    return Estimate(fit, vaf, predicted[HELD_OUT])


def cases(swept: Sweep, cuff: float | None) -> tuple[HeldArm, Array]:
    """Every noise with every strength of the reflexes and every seed, as one batch."""
    noise, gain, _ = np.indices((len(swept.force_noise), len(swept.reflex_gains), swept.seeds)).reshape(3, -1)
    each = ((swept.force_noise, noise), (swept.position_noise, noise), (swept.reflex_gains, gain))
    held: dict[str, Any] = {} if cuff is None else {"yields": True, "cuff_stiffness": cuff}
    arms = eqx.filter_vmap(
        lambda force, position, gain: HeldArm(force_noise=force, position_noise=position, reflex_gain=gain, **held)
    )(*(jnp.asarray(np.array(values)[index]) for values, index in each))
    return arms, jax.vmap(jax.random.key)(jnp.arange(len(noise)))


def run(swept: Sweep, progress: Progress = lambda share: None) -> Outcome:
    """All cases: leading axes cuff, noise, reflex gain, seed, duration."""
    # "Known" is the true inertia. (The paper takes it from its own identification of everything.)
    inertia = jnp.asarray(HeldArm().inertia)
    shape = (len(swept.cuffs), len(swept.force_noise), len(swept.reflex_gains), swept.seeds)
    parts, together = [], swept.seeds
    for cuff in swept.cuffs:
        arms, keys = cases(swept, cuff)
        for first in range(0, len(keys), together):
            some, their = jax.tree.map(lambda x, first=first: x[first : first + together], (arms, keys))
            parts.append(jax.tree.map(np.asarray, sweep(some, their, jnp.asarray(swept.durations), inertia)))
            progress(len(parts) * together / math.prod(shape))
    return jax.tree.map(lambda *x: np.concatenate(x).reshape(shape + x[0].shape[1:]), *parts)


# What is read from it.

CRITERIA = (
    "stiffness positive definite",
    "damping positive definite",
    "stiffness quasi-symmetric",
    "damping quasi-symmetric",
    "standard errors",
    "held-out torque",
    "all quasi-constant",
    "stiffness near the truth",
)


def met(outcome: Outcome, which: str) -> dict[str, NDArray[np.bool_]]:
    """Where each criterion is met: (cuff, noise, gain, seed, duration)."""
    estimate: Estimate = getattr(outcome, which)
    shape, p = estimate.fit.cond.shape, estimate.fit.theta.shape[-1]
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[len(shape) :]), estimate)
    parts = confidence(ARM.names[-p:], flat.fit, flat.held_out_vaf, LIMITS).parts
    theta = estimate.fit.theta
    groups = [slice(p - 4, p), slice(p - 8, p - 4)] + [slice(0, 3)] * (p == 11)
    error = np.linalg.norm(theta[..., -4:] - outcome.stiffness.reshape(*shape, 4), axis=-1)
    parts["all quasi-constant"] = np.all([_as_at_the_end(theta[..., group]) for group in groups], axis=0)
    parts["stiffness near the truth"] = error < SAME * np.linalg.norm(outcome.stiffness, axis=(-2, -1))
    return {name: parts[name].reshape(shape) for name in CRITERIA}


def _as_at_the_end(theta: Numbers) -> NDArray[np.bool_]:
    """Whether an estimate is within a share of that of the longest observation."""
    last = theta[..., -1:, :]
    return np.linalg.norm(theta - last, axis=-1) < SAME * np.linalg.norm(last, axis=-1)


def thresholds(kept: NDArray[np.bool_], observed: Numbers) -> Numbers:
    """Shortest observation [s] from which on a criterion is met for all longer ones; infinite where it never is.

    **Arguments:** `kept` whether it is met, (..., durations); `observed` (durations,) lengths [s], rising.
    """
    later = np.flip(np.logical_and.accumulate(np.flip(kept, axis=-1), axis=-1), axis=-1)
    first = later.argmax(axis=-1)
    return np.where(later.any(axis=-1), observed[first], np.inf)


def table_one(duration: float) -> dict[str, dict[str, Any]]:
    """Table I for t_f = T_k: ratios C_ij of mean squares, eq. (17), by quadrature and in closed form."""
    t, weights = np.polynomial.legendre.leggauss(7)  # exact for these polynomials
    at = jnp.asarray(duration * (t + 1) / 2)
    closed = {"fifth order": (1 / 12, 1 / 504, 1 / 42), "sixth order": (3 / 44, 1 / 792, 1 / 54)}
    motions: dict[str, Trajectory] = {
        "fifth order": MinimumJerk(jnp.array([0.0, 1.0]), duration),
        "sixth order": SixthOrder(0.0, 1.0, duration),
    }
    found = {}
    for name, motion in motions.items():
        first, second, third = (weights @ np.square(x) for x in (*motion(at)[1:], jerk(motion, at)))
        exact = np.array(closed[name]) * duration ** np.array([2, 4, 2])
        numbers = {"C12": first / second, "C13": first / third, "C23": second / third}
        found[name] = {"numbers": numbers, "closed form": dict(zip(numbers, exact.tolist(), strict=True))}
    return found


def noise_free_conditions(durations: Numbers) -> Array:
    """Condition number (19) of the motion alone, over the observation sampled at 1 kHz."""
    t = np.arange(round((durations.max() + OBSERVED) * RATE) + 1) / RATE
    return _noise_free_conditions(jnp.asarray(durations), jnp.asarray(t))


@jax.jit
def _noise_free_conditions(durations: Array, t: Array) -> Array:
    def one(duration: Array) -> Array:
        inside = t < duration + OBSERVED + 0.5 / RATE
        return condition_of(ARM, HeldArm().posture, imposed_motion(DIRECTIONS, duration, t), inside)

    return jax.lax.map(one, durations)


def shorter(swept: Sweep) -> dict[str, Any]:
    """Designed sets against the paper's, at the velocity and torque that its set for 370 ms reaches."""
    subject = HeldArm()
    reference = 0.3
    t = np.linspace(0, reference, 301)
    away, dq, ddq = imposed_motion(DIRECTIONS, reference, t)
    torque = rigid_body_torque(subject.posture + away, dq, ddq, jnp.asarray(subject.inertia))
    limits = Limits((-0.05, 0.05), float(jnp.abs(dq).max()), torque=float(jnp.abs(torque).max()))
    paper = np.asarray(noise_free_conditions(np.array(swept.durations)))
    wanted = float(paper[_nearest(swept, reference)])
    designed = [
        design_perturbations(ARM, subject.posture, observed, subject.inertia, limits, way_points=swept.way_points)
        for observed in swept.designed
    ]
    conditions = np.array([one.condition for one in designed])
    return {
        "limits": {"displacement": 0.05, "velocity": limits.velocity, "inertial_torque": limits.torque},
        "observed": list(swept.designed),
        "designed": conditions.tolist(),
        "agreement_of_starts": [float(one.conditions[-1] / one.conditions[0]) for one in designed],
        "largest_displacement": [float(np.abs(one.points).max()) for one in designed],
        "paper_observed": swept.observed.tolist(),
        "paper": paper.tolist(),
        "condition_of_the_paper_at_370_ms": wanted,
        # Both are straight lines on logarithmic scales.
        "reached_at_s": float(np.exp(np.interp(-np.log(wanted), -np.log(conditions), np.log(swept.designed)))),
    }


def _nearest(swept: Sweep, duration: float) -> int:
    """Index of the duration that is nearest to this one [s]."""
    return int(np.abs(np.array(swept.durations) - duration).argmin())


# Figures and tables.


def reproduce(folder: Path, progress: Progress = lambda share: None, swept: Sweep | None = None) -> None:
    """Write the figures, tables.json and tables.md into an existing folder; of fewer cases if a sweep is given."""
    swept = swept or Sweep()
    outcome = run(swept, lambda share: progress(0.7 * share))
    designed = shorter(swept)
    progress(0.95)
    kept = {which: met(outcome, which) for which in ("full", "reduced")}
    tables = {
        "paper": PAPER,
        "table_1": {f"{1e3 * duration:.0f} ms": table_one(duration) for duration in TABULATED},
        "thresholds_ms": {
            which: {name: _band(thresholds(values, swept.observed)) for name, values in found.items()}
            for which, found in kept.items()
        },
        "by_reflex_gain_ms": _by(swept, kept, 2, [f"{gain:g}" for gain in swept.reflex_gains]),
        "by_cuff_ms": _by(swept, kept, 0, [_cuff_in_words(cuff) for cuff in swept.cuffs]),
        "swept": {
            "force_noise_N": list(swept.force_noise),
            "position_noise_m": list(swept.position_noise),
            "reflex_gain": list(swept.reflex_gains),
            "cuff_N_per_m": list(swept.cuffs),
            "seeds": swept.seeds,
        },
        "shorter": designed,
        "why_the_numbers_differ": WHY,
    }
    (folder / "tables.json").write_text(json.dumps(tables, indent=1), encoding="utf-8")
    (folder / "tables.md").write_text(_markdown(tables), encoding="utf-8")
    _draw(folder, swept, outcome, designed)
    progress(1.0)


def _by(
    swept: Sweep, kept: dict[str, dict[str, NDArray[np.bool_]]], axis: int, labels: Sequence[str]
) -> dict[str, Any]:
    """Thresholds apart for each value of one thing that was swept."""

    def apart(values: NDArray[np.bool_]) -> dict[str, Any]:
        several = np.moveaxis(values, axis, 0)
        return {label: _band(thresholds(one, swept.observed)) for label, one in zip(labels, several, strict=True)}

    return {which: {name: apart(values) for name, values in found.items()} for which, found in kept.items()}


def _cuff_in_words(cuff: float | None) -> str:
    return "hand follows exactly" if cuff is None else f"cuff of {1e-3 * cuff:g} kN/m"


def _band(seconds: Numbers) -> dict[str, float | None]:
    """Shortest, median and longest threshold [ms] over all cases; None where it is never met up to 470 ms."""
    ends = {"shortest": seconds.min(), "median": np.median(seconds), "longest": seconds.max()}
    return {name: round(1e3 * float(x)) if np.isfinite(x) else None for name, x in ends.items()}


def _draw(folder: Path, swept: Sweep, outcome: Outcome, designed: dict[str, Any]) -> None:
    one = jax.tree.map(lambda x: x[swept.nominal], outcome)
    observed = 1e3 * swept.observed
    for name, estimate in (("figure_4", one.full), ("figure_5", one.reduced)):
        _save(folder, name, plots.curves(_panels(observed, estimate, one)))
    time = 1e3 * np.asarray(rows_time())
    panels = []
    for duration in (0.1, 0.2, 0.3):
        k = _nearest(swept, duration)
        for joint in (0, 1):
            series = [(label, time, x[k][:, joint]) for label, x in _predictions(one)]
            title = f"joint {joint + 1}, T_obs = {1e3 * (duration + OBSERVED):.0f} ms"
            panels.append(plots.Panel(title, "time from the onset [ms]", "torque [N m]", series))
    _save(folder, "figure_6", plots.curves(panels))
    _save(folder, "bias", plots.curves(_bias(swept, outcome)))
    lines = [
        ("paper's set", 1e3 * np.array(designed["paper_observed"]), np.array(designed["paper"])),
        ("designed", 1e3 * np.array(designed["observed"]), np.array(designed["designed"])),
    ]
    panel = plots.Panel(
        "The motion alone: paper's six perturbations and designed ones", "observation [ms]", "condition number",
        lines, log=True,
    )  # fmt: skip
    _save(folder, "shorter", plots.curves([panel]))


def rows_time() -> Numbers:
    return times()[:: design_filters(FILTER, RATE).decimate]


def _predictions(one: Outcome) -> list[tuple[str, Numbers]]:
    return [
        ("measured", one.measured),
        ("predicted", one.full.predicted),
        ("predicted, inertia known", one.reduced.predicted),
    ]


def _panels(observed: Numbers, estimate: Estimate, one: Outcome) -> list[plots.Panel]:
    """Condition, stiffness and damping with their eigenvalues, and the inertia, over the observation."""
    x, p = "observation [ms]", estimate.fit.theta.shape[-1]
    panels = [
        plots.Panel("Regressor", x, "condition number", [("condition", observed, estimate.fit.cond)], log=True),
    ]
    for which, letter, first, true, unit in (
        ("stiffness", "K", p - 4, one.stiffness, "N m/rad"),
        ("damping", "D", p - 8, one.damping, "N m s/rad"),
    ):
        lines, bands = [(f"mean truth, {letter}11", observed, true[:, 0, 0])], {}
        for k, element in enumerate(("11", "12", "21", "22")):
            values, error = estimate.fit.theta[:, first + k], 1.96 * estimate.fit.stderr[:, first + k]
            lines.append((element, observed, values))
            bands[element] = (values - error, values + error)
        size = 1.6 * np.abs(true).max()
        panels.append(plots.Panel(which.capitalize(), x, unit, lines, (-0.3 * size, size), bands=bands))
        found = matrix_criteria(ARM.names[-p:], which, estimate.fit.theta, estimate.fit.stderr, estimate.fit.covariance)
        assert found is not None
        truth = np.linalg.eigvalsh(true)
        lines = [("mean truth, smaller", observed, truth[:, 0])]
        bands = {}
        for k, label in enumerate(("smaller", "larger")):
            values, error = found.eigenvalues[:, k], 1.96 * found.eigenvalue_stderr[:, k]
            lines.append((label, observed, values))
            bands[label] = (values - error, values + error)
        top = 1.4 * truth.max()
        panels.append(
            plots.Panel(f"Eigenvalues of the symmetric part: {which}", x, unit, lines, (-0.3 * top, top), bands=bands)
        )
    if p == 11:
        true = HeldArm().inertia
        lines = [("truth, 1", observed, np.full(len(observed), true[0]))]
        lines += [(f"{k + 1}", observed, estimate.fit.theta[:, k]) for k in range(3)]
        panels.append(plots.Panel("Base inertial parameters", x, "kg m²", lines, (0.0, 1.3 * float(true[0]))))
    return panels


def _bias(swept: Sweep, outcome: Outcome) -> list[plots.Panel]:
    """What the paper could not draw: how far the estimate is from the mean of the truth, and from the one before any
    reflex. The mean over seeds at the middle noise."""
    x, y = "observation [ms]", "error of K [% of its norm]"
    panels = []
    before, observed, noise = np.asarray(HeldArm().stiffness), 1e3 * swept.observed, swept.nominal[1]
    for k, cuff in enumerate(swept.cuffs):
        estimate = outcome.full
        K = estimate.fit.theta[k, noise, ..., -4:].mean(axis=1).reshape(len(swept.reflex_gains), -1, 2, 2)
        mean = outcome.stiffness[k, noise].mean(axis=1)
        for against, truth in (("its mean in the observation", mean), ("the one before any reflex", before)):
            share = np.linalg.norm(K - truth, axis=(-2, -1)) / np.linalg.norm(truth, axis=(-2, -1))
            lines = [
                (f"reflexes +{gain:.0%}", observed, 100 * values)
                for gain, values in zip(swept.reflex_gains, share, strict=True)
            ]
            panels.append(
                plots.Panel(f"Stiffness against {against}: {_cuff_in_words(cuff)}", x, y, lines, (0.0, 110.0))
            )
    return panels


def _save(folder: Path, name: str, figure: Any) -> None:
    (folder / f"{name}.png").write_bytes(plots.png(figure))


WHY = (
    "The paper prints neither the subject's impedance nor the noise: the arm is that of Börner et al. 2020, its "
    "stiffness and damping are choices, and each threshold is the range over the noise, reflexes, cuffs and seeds.",
    "Where the hand follows the robot exactly, the stiffness is positive definite and symmetric in every observation, "
    "for all noise and reflexes that were swept. The cuff that yields is this study's addition; the paper's model has "
    "none.",
    "Positive definite means here: by two standard errors of the smallest eigenvalue. "
    "Quasi-symmetric: antisymmetric part at most 5 % of the symmetric one. Standard errors: at most 10 % of "
    "the matrix. Held-out torque: at least 90 % of its variance predicted. Quasi-constant: within 10 % of the estimate "
    "of the longest observation. Near the truth: within 10 % of the mean true stiffness of the observation. The paper "
    "does not say what it means by its words.",
    "With known inertia the true one is taken; the paper takes what it identified itself.",
)
"""What a reader must know who compares the two columns."""


def _markdown(tables: dict[str, Any]) -> str:
    """The tables as Markdown."""
    paper = PAPER["thresholds_ms"]
    theirs = {
        ("full", "stiffness positive definite"): paper["positive definite"],
        ("full", "stiffness quasi-symmetric"): paper["quasi-symmetric"],
        ("full", "damping quasi-symmetric"): paper["quasi-symmetric"],
        ("full", "all quasi-constant"): paper["quasi-constant"],
    }
    lines = ["| from this observation on, ms | paper | here: median (range) | inertia known: paper | here |"]
    lines.append("| --- | --- | --- | --- | --- |")
    for name in CRITERIA:
        full, reduced = (_in_words(tables["thresholds_ms"][which][name]) for which in ("full", "reduced"))
        known = paper["known inertia"] if ("full", name) in theirs else "–"
        lines.append(f"| {name} | {theirs.get(('full', name), '–')} | {full} | {known} | {reduced} |")
    cuffs = [_cuff_in_words(cuff) for cuff in tables["swept"]["cuff_N_per_m"]]
    lines += ["", f"| all parameters, ms | {' | '.join(cuffs)} |", "| --- " * (1 + len(cuffs)) + "|"]
    for name in CRITERIA:
        cells = (_in_words(tables["by_cuff_ms"]["full"][name][cuff]) for cuff in cuffs)
        lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += ["", "| Table I: by quadrature (closed form) | C12 | C13 | C23 |", "| --- | --- | --- | --- |"]
    for duration, rows in tables["table_1"].items():
        for name, row in rows.items():
            cells = (f"{row['numbers'][c]:.4g} ({row['closed form'][c]:.4g})" for c in ("C12", "C13", "C23"))
            lines.append(f"| {name}, t_f = {duration} | {' | '.join(cells)} |")
    one = tables["shorter"]
    lines += [
        "",
        f"The condition number of the paper's 370 ms, {one['condition_of_the_paper_at_370_ms']:.0f}, is reached by "
        f"designed perturbations in {1e3 * one['reached_at_s']:.0f} ms, within the same displacement, velocity and "
        "torque.",
    ]
    return "\n".join([*lines, "", *(f"- {reason}" for reason in tables["why_the_numbers_differ"]), ""])


def _in_words(band: dict[str, float | None]) -> str:
    shortest, median, longest = (band[name] for name in ("shortest", "median", "longest"))
    if shortest is None:
        return "never"
    return f"{median or 'never'} ({shortest} to {longest or 'never'})"
