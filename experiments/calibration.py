"""Whether posteriors mean what they say: 1000 simulated records of the rig, and 1000 of a perturbed arm.

Every posterior is asked with which probability it has a parameter below its true value. Over many records these
probabilities are uniform if posteriors mean what they say: an interval of 95 % then holds the truth in 95 % of all
records, and so for every other, which a chi-squared test of their histogram checks (simulation-based calibration, Talts
et al. 2018; the prior is flat and the truth fixed, with which the exact posterior of a linear model is calibrated as
well).

The rig is that of coverage.py: windows of 2 s through the paper's filters, encoder quantised or not, every 1st, 10th,
40th or 80th sample kept. Posteriors of rows that were whitened, and of rows that are taken as independent, as in
textbooks. Then with torque noise that drifts, of which the filters know nothing: without and with the autoregression
that the residuals of the whole record demand. Writes experiments/results/calibration.json and calibration.md.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import coverage
import jax
import jax.numpy as jnp
import numpy as np
from coverage import DECIMATIONS, LEVELS, NOISE, PARALLEL_FILTER, POSITIONS, TRUTH, WINDOW, motion, regressor
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import chisquare
from scipy.stats import t as student

from jaximp import signals
from jaximp.likelihood import STIFFNESS, stiffness_density
from jaximp.noise import Noise, fit_noise, whiten

jax.config.update("jax_enable_x64", True)

Numbers = NDArray[np.float64]

RECORDS = coverage.RECORDS
BINS = 20
ARM_SAMPLES, ARM_NOISE = 9200, 0.3
DAMPING, STIFF = np.array([[2.4, 1.2], [1.0, 1.4]]), np.array([[29.05, 14.37], [14.37, 17.08]])
DRIFT = 0.98
"""Of the drifting noise from sample to sample: below 3 Hz it is larger than above."""


def exact(triangle: Numbers, count: float, truth: Numbers) -> Numbers:
    """(p,) probability that the exact posterior of a linear model gives to values below the true ones."""
    p = len(truth)
    inverse = np.linalg.inv(triangle[:p, :p])
    theta, dof = inverse @ triangle[:p, p], count - p
    stderr = np.linalg.norm(inverse, axis=1) * np.sqrt((triangle[p:, p] ** 2).sum() / dof)
    return np.asarray(student.cdf((truth - theta) / stderr, dof))


def judge(probabilities: Numbers, names: Sequence[str]) -> dict[str, Any]:
    """Coverage of central intervals and evenness of the ranks, from probabilities (records, p)."""
    out = {}
    for name, u in zip(names, probabilities.T, strict=True):
        histogram = np.histogram(u, BINS, (0, 1))[0]
        out[name] = {f"{level:.0%}": float(np.mean(np.abs(2 * u - 1) < level)) for level in LEVELS}
        out[name] |= {"p of even ranks": float(chisquare(histogram).pvalue), "ranks": histogram.tolist()}
    return out


def probabilities(W: Numbers, y: Numbers, noise: Noise | Numbers | None) -> Numbers:
    """(k, p) of k records (S, k) of one motion (S, p)."""
    rows = whiten(np.broadcast_to(W[:, None], (*y.shape, W.shape[1])), y, noise)
    truth = np.array(list(TRUTH.values()))
    return np.stack([exact(R, n, truth) for R, n in zip(rows.triangles(), rows.count, strict=True)])


def windows(n_samples: int, decimate: int) -> list[slice]:
    """The rows of every window."""
    starts = np.linspace(1000, n_samples - WINDOW - 1000, POSITIONS).astype(int)
    return [slice(start, start + WINDOW, decimate) for start in starts]


def rig(quantised: bool, decimate: int, generator: np.random.Generator) -> dict[str, Any]:
    """White torque noise, seen through the filters."""
    q, torque = motion(quantised)
    W = np.asarray(signals.filter_zero_phase(PARALLEL_FILTER, regressor(jnp.asarray(q))))
    noise, found = signals.autocovariance(PARALLEL_FILTER, decimate), {"whitened": [], "textbook": []}
    for rows in windows(len(q), decimate):
        measured = torque[:, None] + NOISE * generator.normal(size=(len(torque), RECORDS // POSITIONS))
        y = np.asarray(signals.filter_zero_phase(PARALLEL_FILTER, jnp.asarray(measured)))[rows]
        for way, known in (("whitened", noise), ("textbook", None)):
            found[way].append(probabilities(W[rows], y, known))
    return {way: judge(np.concatenate(u), list(TRUTH)) for way, u in found.items()}


def drifting_rig(decimate: int, generator: np.random.Generator) -> dict[str, Any]:
    """Torque noise that drifts, with a quantised encoder."""
    q, torque = motion(True)
    W = np.asarray(signals.filter_zero_phase(PARALLEL_FILTER, regressor(jnp.asarray(q))))
    filtered = Noise(signals.autocovariance(PARALLEL_FILTER, decimate))
    found: dict[str, list[Numbers]] = {"filters only": [], "autoregression": []}
    for rows in windows(len(q), decimate):
        drift = lfilter([1 - DRIFT], [1, -DRIFT], generator.normal(size=(len(torque) + 2000, RECORDS // POSITIONS)), 0)
        measured = torque[:, None] + NOISE * (10 * drift[2000:] + 0.1 * generator.normal(size=drift[2000:].shape))
        y = np.asarray(signals.filter_zero_phase(PARALLEL_FILTER, jnp.asarray(measured)))
        away = slice(400, len(y) - 400)
        for column in y.T:
            whole = fit_noise(W[away][::decimate], column[away][::decimate], filtered)
            found["filters only"].append(probabilities(W[rows], column[rows, None], filtered))
            found["autoregression"].append(probabilities(W[rows], column[rows, None], whole))
    return {way: judge(np.concatenate(u), list(TRUTH)) for way, u in found.items()}


def arm(generator: np.random.Generator) -> dict[str, Any]:
    """Perturbed movements of two joints with white noise: their triangles, drawn as the samples would make them.

    The motion's part of the triangle is fixed. The torque along it is Gaussian, what is left across it a Cholesky
    factor of Wishart's distribution (Bartlett 1933).
    """
    time = np.arange(ARM_SAMPLES) / 4000
    pulse = np.sin(2 * np.pi * 3 * time[:, None] + np.array([0.0, 1.0])) * 0.03
    displacement = pulse + 0.01 * np.sin(2 * np.pi * 7 * time[:, None] + np.array([2.0, 0.5]))
    velocity = np.gradient(displacement, 1 / 4000, axis=0)
    R = np.linalg.qr(np.hstack([velocity, displacement]), mode="r")
    truth, u = np.vstack([DAMPING.T, STIFF.T]), []
    for _ in range(RECORDS):
        triangle = np.zeros((6, 6))
        triangle[:4, :4], triangle[:4, 4:] = R, R @ truth + ARM_NOISE * generator.normal(size=(4, 2))
        left = np.sqrt(generator.chisquare([ARM_SAMPLES - 4, ARM_SAMPLES - 5]))
        triangle[4:, 4:] = ARM_NOISE * np.array([[left[0], generator.normal()], [0, left[1]]])
        likelihood = stiffness_density(triangle, ARM_SAMPLES).likelihood
        expected = np.r_[DAMPING.ravel(), STIFF[[0, 0, 1], [0, 1, 1]]]
        u.append(exact(np.asarray(likelihood.rows[0]), float(likelihood.count[0]), expected))
    return {"whitened": judge(np.stack(u), STIFFNESS)}


def summarise(cases: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """For every way and level the mean over cells and the worst of them, in Monte Carlo standard errors."""
    out = {}
    for way in next(iter(cases.values())):
        cells = [cell for case in cases.values() for cell in case[way].values()]
        row: dict[str, float] = {}
        worst = 0.0
        for level in LEVELS:
            of_level = np.array([cell[f"{level:.0%}"] for cell in cells])
            row[f"mean coverage of {level:.0%}"] = float(of_level.mean())
            worst = max(worst, float(np.abs(of_level - level).max() / np.sqrt(level * (1 - level) / RECORDS)))
        smallest = min(cell["p of even ranks"] for cell in cells)
        out[way] = row | {
            "worst cell, Monte Carlo standard errors": worst,
            "cells": len(cells),
            "p of the least even ranks, times cells": min(1.0, smallest * len(cells)),
        }
    return out


def markdown(summary: dict[str, Any]) -> str:
    names = list(next(iter(next(iter(summary.values())).values())))
    lines = ["| | " + " | ".join(names) + " |", "| --- |" + " --- |" * len(names)]
    for study, ways in summary.items():
        for way, values in ways.items():
            cells = [f"{100 * values[n]:.1f} %" if "coverage" in n else f"{values[n]:.2g}" for n in names]
            lines.append(f"| {study}: {way} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def studies(generator: np.random.Generator) -> dict[str, Callable[[], dict[str, dict[str, Any]]]]:
    return {
        "rig": lambda: {
            f"{'quantised' if quantised else 'exact'} encoder, every {n}": rig(quantised, n, generator)
            for quantised in (True, False)
            for n in DECIMATIONS
        },
        "rig, drifting noise": lambda: {"every 40": drifting_rig(40, generator)},
        "arm": lambda: {"9200 samples": arm(generator)},
    }


if __name__ == "__main__":
    results = {name: study() for name, study in studies(np.random.default_rng(2024)).items()}
    summary = {name: summarise(cases) for name, cases in results.items()}
    folder = Path(__file__).parent / "results"
    (folder / "calibration.json").write_text(json.dumps({"summary": summary, "cells": results}, indent=1) + "\n")
    (folder / "calibration.md").write_text(markdown(summary))
    print(markdown(summary))
