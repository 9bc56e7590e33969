"""Whether posteriors mean what they say: 1000 simulated records of the rig, and 1000 of a perturbed arm.

Every posterior is asked with which probability it has a parameter below its true value. Over many records these
probabilities are uniform if posteriors mean what they say: an interval of 95 % then holds the truth in 95 % of all
records, and so for every other, which a chi-squared test of their histogram checks (simulation-based calibration, Talts
et al. 2018; the prior is flat and the truth fixed, with which the exact posterior of a linear model is calibrated as
well). Of draws the probability is the rank of the truth among 199 that are nearly independent, at random within the
rank: uniform as well.

The rig is that of coverage.py: windows of 2 s through the paper's filters, encoder quantised or not, every 1st, 10th,
40th or 80th sample kept. Posteriors of rows that were whitened, and of rows that are taken as independent, as in
textbooks. With torque noise that drifts, of which the filters know nothing: without and with the autoregression
that the residuals of the whole record demand. For one case of the rig, and for the arm with its definite stiffness,
emcee and the sampler of many windows draw from the posteriors of the same records: those that the diagnostics refuse
are counted, and stay in the table. With the paper's letter, filters inside every window, there is a bias instead:
coverage.py has it, and its numbers stand below the table. Writes experiments/results/calibration.json and .md; names of
studies as arguments for these alone.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import coverage
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from coverage import DECIMATIONS, LEVELS, NOISE, PARALLEL_FILTER, POSITIONS, TRUTH, WINDOW, motion, regressor
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import chi2, chisquare
from scipy.stats import t as student

from jaximp import signals
from jaximp.least_squares import Noise, WhiteRows, fit_noise, whiten
from jaximp.posterior import sample_many, sample_posterior
from jaximp.posterior.densities import STIFFNESS, Density, linear_density, stiffness_density

jax.config.update("jax_enable_x64", True)

Numbers = NDArray[np.float64]

RECORDS = coverage.RECORDS
BINS = 20
DRAWS, EFFECTIVE = 199, 400
"""Draws among which the truth is ranked, of so many effective ones."""
SAMPLED = "quantised encoder, every 40"
"""The case of the rig whose posteriors are drawn from as well."""
ARM_SAMPLES, ARM_NOISE = 9200, 0.3
DAMPING, STIFF = np.array([[2.4, 1.2], [1.0, 1.4]]), np.array([[29.05, 14.37], [14.37, 17.08]])
RIG, ARM = (*TRUTH, "log_noise"), (*STIFFNESS, "log_noise")
DRIFT = 0.98
"""Of the drifting noise from sample to sample: below 3 Hz it is larger than above."""


def exact(triangle: Numbers, count: float, truth: Numbers) -> Numbers:
    """(p + 1,) probability that the exact posterior of a linear model gives to values below the true ones.

    The last is that of the noise. It has no draws in it, and needs none.
    """
    p = len(truth) - 1
    inverse = np.linalg.inv(triangle[:p, :p])
    theta, dof, squares = inverse @ triangle[:p, p], count - p, (triangle[p:, p] ** 2).sum()
    stderr = np.linalg.norm(inverse, axis=1) * np.sqrt(squares / dof)
    below = student.cdf((truth[:p] - theta) / stderr, dof)
    return np.append(below, chi2.sf(squares * np.exp(-2 * truth[p]), dof))


def ranks(draws: Numbers, truth: Numbers, generator: np.random.Generator) -> Numbers:
    """(p,) where the truth is among the draws (n, p) of one record, from zero to one; `DRAWS` of them count."""
    kept = draws[np.linspace(0, len(draws) - 1, DRAWS).astype(int)]
    return np.asarray(((kept < truth).sum(axis=0) + generator.uniform(size=len(truth))) / (DRAWS + 1))


def sampled(densities: list[Density], truth: Numbers, generator: np.random.Generator) -> dict[str, tuple[Numbers, int]]:
    """For each sampler the ranks (records, p) of the true elements, and how many posteriors the diagnostics refuse."""
    found, refused = [], 0
    for seed, density in enumerate(densities):
        posterior = sample_posterior(density, ess=EFFECTIVE, seed=seed)
        found.append(ranks(np.asarray(density.elements(posterior.samples)), truth, generator))
        refused += not posterior.ok
    together: Density = jax.tree.map(lambda *x: np.stack(x), *densities)
    modes, covariances = eqx.filter_jit(eqx.filter_vmap(lambda density: density.laplace()))(together)
    many = sample_many(together, modes, covariances, jax.random.key(int(generator.integers(2**31))), ess=EFFECTIVE)
    elements = np.asarray(densities[0].elements(many.samples))
    of_many = np.stack([ranks(draws, truth, generator) for draws in elements])
    return {"emcee": (np.stack(found), refused), "many windows": (of_many, int((~many.ok).sum()))}


def judge(probabilities: Numbers, names: Sequence[str], refused: int = 0) -> dict[str, Any]:
    """Coverage of central intervals and evenness of the ranks, from probabilities (records, p)."""
    out = {}
    for name, u in zip(names, probabilities.T, strict=True):
        histogram = np.histogram(u, BINS, (0, 1))[0]
        out[name] = {f"{level:.0%}": float(np.mean(np.abs(2 * u - 1) < level)) for level in LEVELS}
        out[name] |= {"p of even ranks": float(chisquare(histogram).pvalue), "ranks": histogram.tolist()}
        out[name] |= {"refused": refused}
    return out


def true_values(log_noise: float) -> Numbers:
    return np.append(list(TRUTH.values()), log_noise)


def whitened(W: Numbers, y: Numbers, noise: Noise | Numbers | None) -> list[tuple[Numbers, float]]:
    """Triangle and count of each of k records (S, k) of one motion (S, p)."""
    rows = whiten(np.broadcast_to(W[:, None], (*y.shape, W.shape[1])), y, noise)
    return list(zip(rows.triangles(), rows.count, strict=True))


def windows(n_samples: int, decimate: int) -> list[slice]:
    """The rows of every window."""
    starts = np.linspace(1000, n_samples - WINDOW - 1000, POSITIONS).astype(int)
    return [slice(start, start + WINDOW, decimate) for start in starts]


def rig(
    quantised: bool, decimate: int, generator: np.random.Generator, *, samplers: bool = False, records: int = RECORDS
) -> dict[str, dict[str, Any]]:
    """White torque noise, seen through the filters."""
    q, torque = motion(quantised)
    W = np.asarray(signals.filter_zero_phase(PARALLEL_FILTER, regressor(jnp.asarray(q))))
    ways = {"whitened": signals.autocovariance(PARALLEL_FILTER, decimate), "textbook": None}
    seen: dict[str, list[tuple[Numbers, float]]] = {way: [] for way in ways}
    for rows in windows(len(q), decimate):
        measured = torque[:, None] + NOISE * generator.normal(size=(len(torque), records // POSITIONS))
        y = np.asarray(signals.filter_zero_phase(PARALLEL_FILTER, jnp.asarray(measured)))[rows]
        for way, noise in ways.items():
            seen[way] += whitened(W[rows], y, noise)
    truth = true_values(np.log(NOISE) + np.log(signals.kept_variance(PARALLEL_FILTER)) / 2)
    out = {way: judge(np.stack([exact(R, n, truth) for R, n in found]), RIG) for way, found in seen.items()}
    if samplers:
        drawn = sampled([rig_density(R, n) for R, n in seen["whitened"]], truth, generator)
        out |= {way: judge(u, RIG, refused) for way, (u, refused) in drawn.items()}
    return out


def rig_density(triangle: Numbers, count: float) -> Density:
    n = len(triangle)
    valid, size = np.ones((n, 1), bool), np.ones((n, 1))
    rows = WhiteRows(triangle[:, None, :-1], triangle[:, -1:], valid, np.array([float(count)]), size)
    return linear_density(RIG[:-1], ("kg m^2", "N m s/rad", "N m/rad", "N m"), rows)


def drifting_rig(decimate: int, generator: np.random.Generator) -> dict[str, Any]:
    """Torque noise that drifts, with a quantised encoder; what its size is depends on how it is described."""
    q, torque = motion(True)
    W = np.asarray(signals.filter_zero_phase(PARALLEL_FILTER, regressor(jnp.asarray(q))))
    filtered, truth = Noise(signals.autocovariance(PARALLEL_FILTER, decimate)), true_values(0.0)
    found: dict[str, list[Numbers]] = {"filters only": [], "autoregression": []}
    for rows in windows(len(q), decimate):
        drift = lfilter([1 - DRIFT], [1, -DRIFT], generator.normal(size=(len(torque) + 2000, RECORDS // POSITIONS)), 0)
        measured = torque[:, None] + NOISE * (10 * drift[2000:] + 0.1 * generator.normal(size=drift[2000:].shape))
        y = np.asarray(signals.filter_zero_phase(PARALLEL_FILTER, jnp.asarray(measured)))
        away = slice(400, len(y) - 400)
        for column in y.T:
            whole = fit_noise(W[away][::decimate], column[away][::decimate], filtered)
            for way, noise in (("filters only", filtered), ("autoregression", whole)):
                found[way] += [exact(*one, truth)[:-1] for one in whitened(W[rows], column[rows, None], noise)]
    return {way: judge(np.stack(u), list(TRUTH)) for way, u in found.items()}


def arm(generator: np.random.Generator, *, samplers: bool = False, records: int = RECORDS) -> dict[str, Any]:
    """Perturbed movements of two joints with white noise: their triangles, drawn as the samples would make them.

    The motion's part of the triangle is fixed. The torque along it is Gaussian, what is left across it a Cholesky
    factor of Wishart's distribution (Bartlett 1933). The exact posterior does not know that the stiffness is definite,
    which makes no difference so far from where it is not; samplers draw its factor.
    """
    time = np.arange(ARM_SAMPLES) / 4000
    pulse = np.sin(2 * np.pi * 3 * time[:, None] + np.array([0.0, 1.0])) * 0.03
    displacement = pulse + 0.01 * np.sin(2 * np.pi * 7 * time[:, None] + np.array([2.0, 0.5]))
    velocity = np.gradient(displacement, 1 / 4000, axis=0)
    R = np.linalg.qr(np.hstack([velocity, displacement]), mode="r")
    coefficients, densities = np.vstack([DAMPING.T, STIFF.T]), []
    for _ in range(records):
        triangle = np.zeros((6, 6))
        triangle[:4, :4], triangle[:4, 4:] = R, R @ coefficients + ARM_NOISE * generator.normal(size=(4, 2))
        left = np.sqrt(generator.chisquare([ARM_SAMPLES - 4, ARM_SAMPLES - 5]))
        triangle[4:, 4:] = ARM_NOISE * np.array([[left[0], generator.normal()], [0, left[1]]])
        densities.append(stiffness_density(triangle, ARM_SAMPLES))
    truth = np.r_[DAMPING.ravel(), STIFF[[0, 0, 1], [0, 1, 1]], np.log(ARM_NOISE)]
    given = [density.likelihood for density in densities]
    u = [exact(np.asarray(one.rows[0]), float(one.count[0]), truth) for one in given]
    out = {"whitened": judge(np.stack(u), ARM)}
    if samplers:
        out |= {way: judge(x, ARM, refused) for way, (x, refused) in sampled(densities, truth, generator).items()}
    return out


def summarise(cases: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """For every way and level the mean over cells and the worst of them, in Monte Carlo standard errors."""
    out = {}
    for way in dict.fromkeys(way for case in cases.values() for way in case):
        tables = [case[way] for case in cases.values() if way in case]
        cells = [cell for table in tables for cell in table.values()]
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
            "refused by the diagnostics": sum(next(iter(table.values()))["refused"] for table in tables),
        }
    return out


def markdown(summary: dict[str, Any], literal: dict[str, Any]) -> str:
    names = list(next(iter(next(iter(summary.values())).values())))
    lines = ["| | " + " | ".join(names) + " |", "| --- |" + " --- |" * len(names)]
    for study, ways in summary.items():
        for way, values in ways.items():
            cells = [f"{100 * values[n]:.1f} %" if "coverage" in n else f"{values[n]:.3g}" for n in names]
            lines.append(f"| {study}: {way} | " + " | ".join(cells) + " |")
    lines += ["", f"{RECORDS} records of every case. The rows of the arm are white: the textbook's interval is exact."]
    for way in ("filtered in the window", "filtered in the window, ends dropped"):
        values = literal[way]
        covered = ", ".join(f"{100 * values[f'mean coverage of {level:.0%}']:.1f} %" for level in LEVELS)
        lines.append(
            f"{way.capitalize()} (coverage.py): {covered} of the intervals hold the truth, with a bias of the inertia "
            f"of {values['bias of the inertia, standard deviations']:.1f} standard deviations."
        )
    return "\n".join(lines) + "\n"


def studies() -> dict[str, Callable[[], dict[str, dict[str, Any]]]]:
    """The name of every study, and what makes it: cases, ways, parameters."""
    cases = {f"{'quantised' if q else 'exact'} encoder, every {n}": (q, n) for q in (True, False) for n in DECIMATIONS}
    random = [np.random.default_rng([2024, k]) for k in range(3)]
    return {
        "rig": lambda: {name: rig(*case, random[0], samplers=name == SAMPLED) for name, case in cases.items()},
        "rig, drifting noise": lambda: {"every 40": drifting_rig(40, random[1])},
        "arm": lambda: {"9200 samples": arm(random[2], samplers=True)},
    }


def save(name: str, cases: dict[str, dict[str, Any]]) -> str:
    """Put one study's results among those of the others, and return the table."""
    folder = Path(__file__).parent / "results"
    path = folder / "calibration.json"
    before = json.loads(path.read_text()) if path.exists() else {"summary": {}, "cells": {}}
    cells, summary = before["cells"] | {name: cases}, before["summary"] | {name: summarise(cases)}
    cells, summary = dict(sorted(cells.items())), dict(sorted(summary.items()))
    text = markdown(summary, json.loads((folder / "coverage.json").read_text())["summary"])
    path.write_text(json.dumps({"summary": summary, "cells": cells}, indent=1) + "\n")
    (folder / "calibration.md").write_text(text)
    return text


if __name__ == "__main__":
    for name, study in studies().items():
        if name in (sys.argv[1:] or studies()):
            print(save(name, study()))
