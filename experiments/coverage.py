"""How often intervals hold the truth: 1000 simulated records of the rig through the paper's filters.

The model with offset in a window of 2 s, white torque noise, quantised encoder or not, every 1st, 10th, 40th or 80th
sample kept after the filters. Filtered once, with standard errors that know the filter and with the textbook's; and
filtered inside the window, as the paper writes, with and without the rows at the window's ends that the edges disturb:
there the inertia is biased. Writes experiments/results/coverage.json and coverage.md.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from jaximp import signals
from jaximp.least_squares import WindowFit, least_squares
from jaximp.models import HumanJoint
from jaximp.simulation import ROBOT_TRAJECTORY, HumanLoad, Rig, simulate_rig

jax.config.update("jax_enable_x64", True)

RECORDS, POSITIONS = 1000, 40
RATE, WINDOW, NOISE = 1000.0, 2000, 5e-4
LEVELS = (0.5, 0.8, 0.95)
DECIMATIONS = (1, 10, 40, 80)
TRUTH = {"inertia": 2e-6, "damping": 3e-5, "stiffness": 1e-3, "offset_torque": 0.0}
POSITION_FILTER = signals.butterworth(8, 10.0, RATE)
PARALLEL_FILTER = signals.butterworth(4, 5.0, RATE)

Numbers = NDArray[np.float64]


def motion(quantised: bool) -> tuple[Numbers, Numbers]:
    """Measured position (N,) and the human's true torque (N,)."""
    human = HumanLoad(stiffness=1e-3, stiffness_after=1e-3, inertia=2e-6, damping=3e-5)
    simulated = simulate_rig(Rig(), ROBOT_TRAJECTORY, 12.0, human)
    return np.asarray(simulated.position if quantised else simulated.true_position), np.asarray(simulated.human_torque)


def regressor(q: jax.Array) -> jax.Array:
    """Columns before the parallel filter, from one stretch of positions (S,)."""
    smooth = signals.filter_zero_phase(POSITION_FILTER, q)
    return HumanJoint().observation_matrix(smooth, *signals.central_differences(smooth, RATE))


@jax.jit
def fit_all(W: jax.Array, y: jax.Array, valid: jax.Array, noise: jax.Array | None) -> WindowFit:
    """The same rows against many torques, (S, k)."""
    return jax.vmap(lambda column: least_squares(W, column, valid, noise), in_axes=1)(y)


def errors(fits: list[WindowFit]) -> tuple[Numbers, Numbers, Numbers]:
    """Errors in standard errors (k, p), their degrees of freedom (k,), and absolute errors (k, p)."""
    theta, stderr, dof = (
        np.concatenate([np.asarray(getattr(f, name)) for f in fits]) for name in ("theta", "stderr", "dof")
    )
    error = theta - np.array(list(TRUTH.values()))
    return error / stderr, dof, error


def table(fits: list[WindowFit]) -> dict[str, Any]:
    """Coverage of every interval, and bias, for every parameter."""
    z, dof, error = errors(fits)
    half = {level: student.ppf(0.5 + level / 2, dof)[:, None] for level in LEVELS}
    return {
        name: {f"{level:.0%}": float(np.mean(np.abs(z[:, k]) < half[level][:, 0])) for level in LEVELS}
        | {
            "bias_in_standard_deviations": bias(error[:, k]),
            "claimed_over_true_sd": float(np.sqrt(np.mean((error[:, k] / z[:, k]) ** 2)) / error[:, k].std()),
        }
        for k, name in enumerate(TRUTH)
    }


def bias(error: Numbers) -> float:
    """Root mean square over the windows of each window's bias, in standard deviations of its own noise."""
    by_window = error.reshape(POSITIONS, -1)
    z = by_window.mean(axis=1) / by_window.std(axis=1, ddof=1)
    return float(np.sqrt(max(0.0, np.mean(z**2) - 1 / by_window.shape[1])))


def run(quantised: bool, decimate: int, generator: np.random.Generator) -> dict[str, dict[str, Any]]:
    """All ways to fit, each over the same records."""
    q, torque = motion(quantised)
    starts = np.linspace(1000, len(q) - WINDOW - 1000, POSITIONS).astype(int)
    per_start = RECORDS // POSITIONS
    measured = torque[:, None] + NOISE * generator.normal(size=(len(torque), RECORDS))
    W_once = signals.filter_zero_phase(PARALLEL_FILTER, regressor(jnp.asarray(q)))
    y_once = signals.filter_zero_phase(PARALLEL_FILTER, jnp.asarray(measured))
    by_lag = jnp.asarray(signals.autocovariance(PARALLEL_FILTER, decimate))
    response = signals.filter_zero_phase(PARALLEL_FILTER, jnp.eye(WINDOW))[::decimate]
    inside = response @ response.T

    kept = np.arange(0, WINDOW, decimate)
    edge = signals.reach(POSITION_FILTER) + signals.reach(PARALLEL_FILTER)
    everything = jnp.ones(len(kept), bool)
    without_ends = jnp.asarray((kept >= edge) & (kept < WINDOW - edge))

    fits: dict[str, list[WindowFit]] = {
        "filtered once": [],
        "filtered once, textbook": [],
        "filtered in the window": [],
        "filtered in the window, ends dropped": [],
    }
    for k, start in enumerate(starts):
        columns = slice(k * per_start, (k + 1) * per_start)
        cut = slice(start, start + WINDOW)
        W, y = W_once[cut][::decimate], y_once[cut, columns][::decimate]
        fits["filtered once"].append(fit_all(W, y, everything, by_lag))
        fits["filtered once, textbook"].append(fit_all(W, y, everything, None))
        W = signals.filter_zero_phase(PARALLEL_FILTER, regressor(jnp.asarray(q[cut])))[::decimate]
        y = signals.filter_zero_phase(PARALLEL_FILTER, jnp.asarray(measured[cut, columns]))[::decimate]
        fits["filtered in the window"].append(fit_all(W, y, everything, inside))
        fits["filtered in the window, ends dropped"].append(fit_all(W, y, without_ends, inside))
    return {name: table(found) for name, found in fits.items()}


def summarise(results: dict[str, Any]) -> dict[str, Any]:
    """What the README states: worst cell in Monte Carlo standard errors, and the mean over cells, for each way."""
    out: dict[str, Any] = {}
    for way in next(iter(results.values())):
        worst, means = 0.0, {}
        for level in LEVELS:
            cells = [results[case][way][name][f"{level:.0%}"] for case in results for name in TRUTH]
            spread = np.sqrt(level * (1 - level) / RECORDS)
            worst = max(worst, float(np.max(np.abs(np.array(cells) - level)) / spread))
            means[f"mean coverage of {level:.0%}"] = float(np.mean(cells))
        inertia = [results[case][way]["inertia"]["bias_in_standard_deviations"] for case in results]
        out[way] = means | {
            "worst cell, Monte Carlo standard errors": worst,
            "bias of the inertia, standard deviations": float(np.mean(inertia)),
        }
    return out


def markdown(summary: dict[str, Any]) -> str:
    names = list(next(iter(summary.values())))
    lines = ["| | " + " | ".join(names) + " |", "| --- |" + " --- |" * len(names)]
    for way, values in summary.items():
        cells = [f"{100 * values[n]:.1f} %" if "coverage" in n else f"{values[n]:.1f}" for n in names]
        lines.append(f"| {way} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    generator = np.random.default_rng(2023)
    results = {
        f"{'quantised' if quantised else 'exact'} encoder, every {n}": run(quantised, n, generator)
        for quantised in (True, False)
        for n in DECIMATIONS
    }
    summary = summarise(results)
    folder = Path(__file__).parent / "results"
    (folder / "coverage.json").write_text(json.dumps({"summary": summary, "cells": results}, indent=1) + "\n")
    (folder / "coverage.md").write_text(markdown(summary))
    print(markdown(summary))
