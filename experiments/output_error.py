"""How well output error finds the impedance of a simulated reaching arm, and how often its intervals hold the truth.

Experiments of Börner et al. 2020 on the simulated arm: 60 perturbed trials and 120 other unperturbed ones, and the
static task from which the inertia comes. Groups of 20 trials as in the paper; the truth is the mean stiffness in the
window of the group's trials without their perturbation. Errors are means over the 41 sliding groups, in per cent of the
largest element of the true matrix; intervals are counted over the three groups that share no trial (but the learned
prior and the static inertia of their experiment). Choices were made on seeds 0 to 9; seeds here begin at 1000.

The simulated arm is the fitted model: rigid, linear in the window, noise that ends at 2 Hz, no soft tissue, drift or
fatigue; it is integrated by the method and the step of the fit, and the commanded force is really applied.

Writes experiments/results/output_error.json and output_error.md; titles of cases as arguments for these alone; with
--quick, a few simulations and no file.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, savgol_filter, sosfilt

from jaximp.models import ArmGeometry
from jaximp.perturbation.isolation.output_error import OutputErrorFit, output_error
from jaximp.perturbation.static import static_inertia
from jaximp.perturbation.trials import Trials
from jaximp.simulation.neuromuscular import (
    ANGLES,
    POSTURES,
    RATE,
    NeuromuscularArm,
    Reach,
    Reaches,
    hold_posture,
    neural_noise,
    perturbing_forces,
    reach,
)

jax.config.update("jax_enable_x64", True)

Numbers = NDArray[np.float64]
FIRST_SEED, TRIALS, OTHERS, WINDOW = 1000, 60, 120, 460
ARM = NeuromuscularArm()
GEOMETRY = ArmGeometry((0.29, 0.34))
SLIDING = np.arange(41)[:, None] + np.arange(20)
DISJOINT = np.arange(60).reshape(3, 20)
BEFORE, AFTER = 2000, 700
"""Samples around the onset that are kept."""
ELEMENTS = ("K11", "K12", "K22", "D11", "D12", "D21", "D22")


@eqx.filter_jit
def simulate(key: jax.Array, duration: float, extra: jax.Array | None = None) -> Reaches:
    """60 perturbed trials, the same without the perturbation, and 120 others; `extra` noise of the first and last."""
    of_force, of_noise, of_others, _ = jax.random.split(key, 4)
    samples = round(duration * RATE) + 1
    noise = jnp.concatenate([neural_noise(of_noise, TRIALS, samples), neural_noise(of_others, OTHERS, samples)])
    noise = noise if extra is None else noise + extra
    still = jnp.zeros((TRIALS + OTHERS, 2))
    forces = jnp.concatenate([perturbing_forces(of_force), still])
    return reach(ARM, Reach(duration=duration), forces, jnp.concatenate([noise[:TRIALS], noise]))


@eqx.filter_jit
def postures(key: jax.Array) -> Trials:
    """100 trials of the static task."""
    noise = neural_noise(jax.random.split(key, 4)[3], 100, round(1.5 * RATE))
    return hold_posture(ARM, np.repeat(POSTURES, 20, axis=0), np.tile(ANGLES, 5), noise)


class Simulated(NamedTuple):
    """One experiment."""

    perturbed: Trials
    unperturbed: Trials
    K: Numbers
    """(60, 3) mean true stiffness in the window."""


def experiment(seed: int, duration: float, tremor: float = 0.0) -> Simulated:
    """Simulated, and cut around the onset. `tremor`: standard deviation of more noise, between 7 and 9 Hz."""
    extra = None
    if tremor:
        white = np.random.default_rng(seed).normal(size=(TRIALS + OTHERS, round(duration * RATE) + 1, 6))
        shaken = sosfilt(butter(2, (7.0, 9.0), "bandpass", fs=RATE, output="sos"), white, axis=1)
        extra = jnp.asarray(tremor * shaken / shaken[:, -1000:].std())
    found = jax.tree.map(np.asarray, simulate(jax.random.key(seed), duration, extra))
    m, onset = found.movements, found.movements.onset
    trial = np.arange(len(onset))[:, None]
    kept = np.clip(onset[:, None] + np.arange(-BEFORE, AFTER), 0, m.position.shape[1] - 1)
    signals = [x[trial, kept] for x in (m.position, m.velocity, m.acceleration, m.force, m.command)]
    within = onset[TRIALS : 2 * TRIALS, None] + np.arange(WINDOW + 1)
    K = found.stiffness[trial[TRIALS : 2 * TRIALS], within].mean(axis=1)

    def some(which: slice) -> Trials:
        return Trials(*(x[which] for x in signals), np.full(len(onset[which]), BEFORE, np.int32), RATE)

    return Simulated(some(slice(0, TRIALS)), some(slice(2 * TRIALS, None)), K)


# What is done to the trials before the fit.

Change = Callable[[Simulated, np.random.Generator], Simulated]


def as_simulated(trials: Simulated, generator: np.random.Generator) -> Simulated:
    return trials


def fewer(n: int) -> Change:
    return lambda trials, generator: trials._replace(unperturbed=jax.tree.map(lambda x: x[:n], trials.unperturbed))


def measured(deviation: float = 0.0, step: float = 0.0, width: int = 161) -> Change:
    """White noise of the position or rounding to a step [m]; velocity and acceleration are derived from what is left,
    by polynomials of fifth order over `width` samples."""

    def of(movements: Trials, generator: np.random.Generator) -> Trials:
        x = movements.position + deviation * generator.normal(size=movements.position.shape)
        x = np.round(x / step) * step if step else x
        v, a = (savgol_filter(x, width, 5, deriv=d, delta=1 / RATE, axis=1) for d in (1, 2))
        return eqx.tree_at(lambda m: (m.position, m.velocity, m.acceleration), movements, (x, v, a))

    return lambda trials, generator: trials._replace(
        perturbed=of(trials.perturbed, generator), unperturbed=of(trials.unperturbed, generator)
    )


def commanded(change: Callable[[Numbers], Numbers]) -> Change:
    """The command that is written down is not the one that was applied."""
    return lambda trials, generator: trials._replace(
        perturbed=eqx.tree_at(lambda m: m.command, trials.perturbed, change(trials.perturbed.command))
    )


class Case(NamedTuple):
    title: str
    simulations: int
    duration: float = 2.0
    change: Change = as_simulated
    sensor_noise: float = 0.0
    tremor: float = 0.0


CASES = (
    Case("2 s", 70),
    Case("1 s", 34, 1.0),
    Case("3 s", 34, 3.0),
    Case("10 unperturbed trials", 16, change=fewer(10)),
    Case("30 unperturbed trials", 16, change=fewer(30)),
    Case("10 unperturbed trials, 1 s", 8, 1.0, fewer(10)),
    Case("10 unperturbed trials, 3 s", 8, 3.0, fewer(10)),
    Case("position rounded to 1 um", 6, change=measured(step=1e-6)),
    Case("position noise 10 um", 34, change=measured(1e-5), sensor_noise=1e-5),
    Case("position noise 50 um", 10, change=measured(5e-5), sensor_noise=5e-5),
    Case("position noise 50 um, not told", 6, change=measured(5e-5)),
    Case("tremor at 8 Hz", 8, tremor=0.1),
    Case("command one sample early", 6, change=commanded(lambda u: np.roll(u, -1, axis=1))),
    Case("command 1 % too large", 6, change=commanded(lambda u: 1.01 * u)),
)


class Outcome(NamedTuple):
    """Of one simulation."""

    errors: Numbers
    """(7,) of K and D, mean over sliding groups [%]."""
    hits: NDArray[np.bool_]
    """(3, 7) whether the interval of a disjoint group holds the truth."""
    z: Numbers
    """(3, 7) errors in standard errors."""
    margins: Numbers
    """(7,) half width of an interval, of the largest element [%]."""
    chi2: Numbers
    """(3,)"""
    ok: NDArray[np.bool_]
    """(3,)"""
    delay: float
    seconds: float


def judge(fit: OutputErrorFit, K: Numbers, seconds: float) -> Outcome:
    true_K = K[np.concatenate([SLIDING, DISJOINT])].mean(axis=1)
    true_D = true_K[:, [0, 1, 1, 2]] * ARM.damping_time
    truth = np.concatenate([true_K, true_D], axis=1)
    largest = np.repeat([true_K.max(axis=1), true_D.max(axis=1)], [3, 4], axis=0).T

    def elements(D: Numbers, K: Numbers) -> Numbers:
        return np.concatenate([K.reshape(-1, 4)[:, [0, 1, 3]], D.reshape(-1, 4)], axis=1)

    error = elements(fit.D, fit.K) - truth
    margin = elements(*fit.margin())
    stderr = fit.stderr[:, [4, 5, 6, 0, 1, 2, 3]]
    return Outcome(
        100 * np.abs(error / largest)[:41].mean(axis=0), (np.abs(error) < margin)[41:], (error / stderr)[41:],
        100 * (margin / largest)[41:].mean(axis=0), fit.chi2[41:], fit.ok[41:], float(fit.delay[:41].mean()), seconds,
    )  # fmt: skip


def run(cases: tuple[Case, ...]) -> dict[str, Any]:
    """Every simulation once, for all cases that want it."""
    found: dict[str, list[Outcome]] = {case.title: [] for case in cases}
    inertia: dict[int, Numbers] = {}
    for k in range(max(case.simulations for case in cases)):
        seed = FIRST_SEED + k
        inertia[k] = np.asarray(static_inertia(postures(jax.random.key(seed)), GEOMETRY).inertia)
        trials: dict[tuple[float, float], Simulated] = {}
        for case in (case for case in cases if k < case.simulations):
            kind = case.duration, case.tremor
            if kind not in trials:
                trials[kind] = experiment(seed, *kind)
            given = case.change(trials[kind], np.random.default_rng(seed))
            start = time.perf_counter()
            fit = output_error(
                given.perturbed, given.unperturbed, GEOMETRY, ARM.handle, inertia[k],
                sensor_noise=case.sensor_noise, groups=np.concatenate([SLIDING, DISJOINT]),
            )  # fmt: skip
            found[case.title].append(judge(fit, given.K, time.perf_counter() - start))
    return {case.title: summary(found[case.title]) for case in cases}


def summary(outcomes: list[Outcome]) -> dict[str, Any]:
    errors, hits, z, margins, chi2, ok, delay, seconds = (np.array(x) for x in zip(*outcomes, strict=True))
    hits, z = hits.reshape(-1, 7), z.reshape(-1, 7)
    each = lambda x: dict(zip(ELEMENTS, (float(f"{v:.3g}") for v in x), strict=True))  # noqa: E731
    return {
        "seeds": [FIRST_SEED, FIRST_SEED + len(errors) - 1],
        "groups": len(hits),
        "error_percent": each(errors.mean(axis=0)),
        "error_percent_sd_over_simulations": each(errors.std(axis=0)),
        "margin_percent": each(margins.mean(axis=0)),
        "coverage_percent": each(100 * hits.mean(axis=0)),
        "rms_z": each(np.sqrt((z**2).mean(axis=0))),
        "mean_z": each(z.mean(axis=0)),
        "chi2": [float(f"{v:.3g}") for v in (chi2.min(), np.median(chi2), chi2.max())],
        "ok_percent": float(100 * ok.mean()),
        "delay_us": float(f"{1e6 * delay.mean():.3g}"),
        "seconds": float(f"{np.median(seconds):.3g}"),
    }


def markdown(results: dict[str, Any]) -> str:
    """Errors and coverage, one line a case."""
    lines = [
        "Simulated arm, which is the fitted model (see experiments/output_error.py for the limits). Errors, half "
        "widths of 95 % intervals: per cent of the largest element; mean over groups of 20 trials.",
        "",
        "| | simulations | K11 / K12 / K22 | D11 / D12 / D21 / D22 | half width of K | K inside, % of groups | "
        "D inside, % | groups | chi2 | ok, % |",
        "| --- |" + " --- |" * 9,
    ]
    for title, r in results.items():
        K, D = ELEMENTS[:3], ELEMENTS[3:]

        def some(name: str, elements: tuple[str, ...], digits: int = 1, r: dict[str, Any] = r) -> str:
            return " / ".join(f"{r[name][e]:.{digits}f}" for e in elements)

        first, last = r["seeds"]
        cells = [
            title, str(last - first + 1), some("error_percent", K), some("error_percent", D), some("margin_percent", K),
            some("coverage_percent", K, 0), some("coverage_percent", D, 0), str(r["groups"]), f"{r['chi2'][1]:.2f}",
            f"{r['ok_percent']:.0f}",
        ]  # fmt: skip
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def save(results: dict[str, Any]) -> None:
    """Put some cases' results among those of the others."""
    folder = Path(__file__).parent / "results"
    path = folder / "output_error.json"
    known = (json.loads(path.read_text()) if path.exists() else {}) | results
    ordered = {case.title: known[case.title] for case in CASES if case.title in known}
    path.write_text(json.dumps(ordered, indent=1) + "\n")
    (folder / "output_error.md").write_text(markdown(ordered))


if __name__ == "__main__":
    quick, titles = "--quick" in sys.argv, [x for x in sys.argv[1:] if x != "--quick"]
    cases = tuple(case for case in CASES if not titles or case.title in titles)
    results = run(tuple(case._replace(simulations=2) for case in cases) if quick else cases)
    if not quick:
        save(results)
    print(markdown(results))
