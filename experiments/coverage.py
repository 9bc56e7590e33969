"""How often intervals hold the truth, in two parts.

1000 simulated records of the rig through the paper's filters (`filters`). The model with offset in a window of 2 s,
white torque noise, quantised encoder or not, every 1st, 10th, 40th or 80th sample kept after the filters. Filtered
once, with standard errors that know the filter and with the textbook's; and filtered inside the window, as the paper
writes, with and without the rows at the window's ends that the edges disturb: there the inertia is biased. Writes
experiments/results/coverage.json and coverage.md.

2000 simulated records of an ankle a cell, through `identify` (`noise`): torque noise of every kind, short and long
windows, slow and fast sampling, a high-pass, an encoder, several motions. Of each record one window counts, the middle
one, whatever its verdict. Writes experiments/results/coloured_noise.json and coloured_noise.md. Of ordinary
estimates with errors that know the noise (`--estimates ordinary`) it writes coloured_noise_ordinary.json and
coloured_noise_ordinary.md, with how wide their intervals are against those of generalised least squares.

    python experiments/coverage.py [filters | noise] [--records 2000] [--estimates ordinary] [--cases usual ...]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import ankles
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from jaximp import signals
from jaximp.identification.identify import estimate
from jaximp.identification.pipeline import ESTIMATES
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

FOLDER = Path(__file__).parent / "results"
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


def of_filters() -> None:
    """The first part."""
    generator = np.random.default_rng(2023)
    results = {
        f"{'quantised' if quantised else 'exact'} encoder, every {n}": run(quantised, n, generator)
        for quantised in (True, False)
        for n in DECIMATIONS
    }
    summary = summarise(results)
    (FOLDER / "coverage.json").write_text(json.dumps({"summary": summary, "cells": results}, indent=1) + "\n")
    (FOLDER / "coverage.md").write_text(markdown(summary))
    print(markdown(summary))


# ---- Torque noise of every kind, through `identify`.

NOISE_RECORDS = 2000
CASES: dict[str, dict[str, Any]] = {
    "usual": {},
    "0.5 s": {"window": 0.5},
    "5 s": {"window": 5.0},
    "high-pass of 0.3 Hz": {"high_pass": 0.3},
    "100 Hz": {"rate": 100.0},
    "200 Hz": {"rate": 200.0},
    "2000 Hz": {"rate": 2000.0},
    "encoder of 0.3 mrad": {"encoder": 3e-4},
    "multisine": {"motion": "multisine"},
    "chirp": {"motion": "chirp"},
    "steps": {"motion": "steps"},
    "free swing": {"motion": "free swing"},
}
"""What differs from a random motion at 1 kHz in windows of 2 s."""
PARAMETERS = ("inertia", "damping", "stiffness")
ALLOWED, CLAIMED = 0.02, (0.9, 1.15)
"""Target: coverage within so much and 3.5 Monte Carlo errors, and claimed over true standard deviation."""


def noise_cell(noise: str, case: dict[str, Any], records: int, seed: int, estimates: str) -> dict[str, Any]:
    """Coverage, claimed over true standard deviation and bias of every parameter, of independent records."""
    settings = {"window": 2.0, "rate": ankles.RATE, "high_pass": None} | case
    pipeline = ankles.pipeline(
        *(settings.pop(name) for name in ("rate", "window", "high_pass")), "estimated", estimates
    )
    theta, stderr, dof, trusted = [], [], [], []
    for k in range(records):
        random = np.random.default_rng((seed, k))
        found = estimate(pipeline, ankles.record(random, noise, rate=pipeline.sample_rate, **settings))[0]
        middle = len(found.value) // 2
        theta.append(found.value[middle, :3])
        stderr.append(found.stderr[middle, :3])
        dof.append(found.dof[middle])
        trusted.append(found.trusted[middle])
    truth = np.array([ankles.TRUTH[name] for name in PARAMETERS])
    error, claimed = np.array(theta) - truth, np.array(stderr)
    half = {level: student.ppf(0.5 + level / 2, np.array(dof)) for level in LEVELS}
    parameters = {
        name: {f"{level:.0%}": float(np.mean(np.abs(error[:, k]) < half[level] * claimed[:, k])) for level in LEVELS}
        | {
            "claimed_over_true_sd": float(np.sqrt(np.mean(claimed[:, k] ** 2)) / error[:, k].std()),
            "bias": float(error[:, k].mean() / truth[k]),
            "claimed": float(np.sqrt(np.mean(claimed[:, k] ** 2)) / truth[k]),
            "bias_monte_carlo_error": float(error[:, k].std() / np.sqrt(records) / truth[k]),
        }
        for k, name in enumerate(PARAMETERS)
    }
    return {"records": records, "trusted": float(np.mean(trusted)), "parameters": parameters}


def missed(cell: dict[str, Any]) -> list[str]:
    """Which targets a cell misses, in words."""
    found = []
    for name, values in cell["parameters"].items():
        for level in LEVELS:
            error = np.sqrt(level * (1 - level) / cell["records"])
            if abs(values[f"{level:.0%}"] - level) > ALLOWED + 3.5 * error:
                found.append(f"{name}: {100 * values[f'{level:.0%}']:.0f} in intervals of {level:.0%}")
        ratio, spread = values["claimed_over_true_sd"], 3.5 / np.sqrt(2 * cell["records"])
        if not CLAIMED[0] * (1 - spread) <= ratio <= CLAIMED[1] * (1 + spread):
            found.append(f"{name}: claims {ratio:.2f} of the true standard deviation")
    return found


def noise_table(cells: dict[str, dict[str, Any]]) -> str:
    """A row a noise, over all cases; then coverage case by case; then what misses the targets."""
    records = {cell["records"] for row in cells.values() for cell in row.values()}
    cases = list(next(iter(cells.values())))
    lines = [
        f"{' or '.join(map(str, sorted(records)))} records a cell; inertia / damping / stiffness; the mean over "
        f"{len(cases)} cells a noise, and the range of claimed over true standard deviation.",
        "",
        "| noise of the torque | 50 % | 80 % | 95 % | claimed / true | largest bias | trusted |",
        "| --- |" + " --- |" * 6,
    ]
    for noise, row in cells.items():
        each = [cell["parameters"] for cell in row.values()]
        means = [
            " / ".join(f"{100 * np.mean([one[name][f'{level:.0%}'] for one in each]):.1f}" for name in PARAMETERS)
            for level in LEVELS
        ]
        ratios = [one[name]["claimed_over_true_sd"] for one in each for name in PARAMETERS]
        biases = [one[name]["bias"] for one in each for name in PARAMETERS]
        lines.append(
            f"| {noise} | {' | '.join(means)} | {min(ratios):.2f} to {max(ratios):.2f} | "
            f"{100 * max(biases, key=abs):+.1f} % | {100 * np.mean([c['trusted'] for c in row.values()]):.0f} % |"
        )
    lines += ["", "Intervals of 95 %, case by case:", ""]
    lines += ["| | " + " | ".join(cases) + " |", "| --- |" + " --- |" * len(cases)]
    for noise, row in cells.items():
        shown = [" / ".join(f"{100 * c['parameters'][n]['95%']:.0f}" for n in PARAMETERS) for c in row.values()]
        lines.append(f"| {noise} | " + " | ".join(shown) + " |")
    values = [one for row in cells.values() for cell in row.values() for one in cell["parameters"].values()]
    overall = [f"{np.mean([one[f'{level:.0%}'] for one in values]):.1%}" for level in LEVELS]
    lines += ["", f"The mean over all cells: {', '.join(overall)} of the intervals of 50, 80 and 95 % hold the truth."]
    every = [(f"{noise}, {case}", missed(cell)) for noise, row in cells.items() for case, cell in row.items()]
    bad = [f"- {where}: {'; '.join(words)}" for where, words in every if words]
    allowed = f"{100 * ALLOWED:.0f} points (or a ratio of {CLAIMED[0]} to {CLAIMED[1]}) and 3.5 Monte Carlo errors"
    lines += [
        "",
        f"Of {len(every)} cells {len(bad)} miss a target by more than {allowed}{':' if bad else '.'}",
        "",
        *bad,
    ]
    return "\n".join(lines) + "\n"


def width_table(cells: dict[str, dict[str, Any]], others: dict[str, dict[str, Any]]) -> str:
    """How wide the intervals of ordinary estimates are, by those of generalised ones of the same records."""
    cases = list(next(iter(cells.values())))
    lines = [
        "Standard errors of inertia / damping / stiffness, as multiples of those of generalised least squares:",
        "",
    ]
    lines += ["| | " + " | ".join(cases) + " |", "| --- |" + " --- |" * len(cases)]
    for noise, row in cells.items():
        ratios = [
            " / ".join(
                f"{cell['parameters'][n]['claimed'] / others[noise][case]['parameters'][n]['claimed']:.2f}"
                for n in PARAMETERS
            )
            for case, cell in row.items()
        ]
        lines.append(f"| {noise} | " + " | ".join(ratios) + " |")
    return "\n".join(lines) + "\n"


def of_noise(records: int, estimates: str, cases: Sequence[str]) -> None:
    """The second part; what is done so far stands in the files after every case."""
    kinds = ["generalised", estimates][estimates == "generalised" :]
    cells: dict[str, Any] = {kind: {noise: {} for noise in ankles.NOISES} for kind in kinds}
    file = "coloured_noise" if estimates == "generalised" else f"coloured_noise_{estimates}"
    for c, (name, case) in enumerate(CASES.items()):
        if name not in cases:
            continue
        for k, noise in enumerate(ankles.NOISES):
            for kind in kinds:
                cells[kind][noise][name] = noise_cell(noise, case, records, 100 * c + k, kind)
        table = noise_table(cells[estimates])
        if estimates != "generalised":
            table += "\n" + width_table(cells[estimates], cells["generalised"])
        (FOLDER / f"{file}.json").write_text(json.dumps(cells[estimates], indent=1) + "\n")
        (FOLDER / f"{file}.md").write_text(table)
    print(table)


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("part", nargs="?", choices=("filters", "noise"), help="both where none is named")
    arguments.add_argument("--records", type=int, default=NOISE_RECORDS, help="of every cell of the second part")
    arguments.add_argument("--estimates", choices=ESTIMATES, default=ESTIMATES[0], help="of the second part")
    arguments.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), help="of the second part")
    given = arguments.parse_args()
    if given.part != "noise":
        of_filters()
    if given.part != "filters":
        of_noise(given.records, given.estimates, given.cases)
