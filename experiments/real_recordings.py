"""Runs the main job on the real recordings and writes the numbers of the README's table.

The recordings are not part of this project: they are looked for in the folder named by JAXIMP_DATA, else in
../shared/data beside the checkout. Writes experiments/results/real_recordings.json.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.stats import chi2

from jaximp import identify, parse_job
from jaximp.jobs import prepare
from jaximp.least_squares import least_squares

jax.config.update("jax_enable_x64", True)

HERE = Path(__file__).parent
DATA = Path(os.environ.get("JAXIMP_DATA") or HERE / "../../shared/data")

EMPS = """
[recording]
file = "emps/DATA_EMPS.mat"
joint = "prismatic"
time = "t"
position = "qm"
torque = { column = "vir", unit = "V", gain = "35.1507 N/V" }
[model]
robot = { offset = true }
[filter]
position_cutoff = 100
decimation_cutoff = 20
[window]
length = 5
step = 0.1
"""
ANKLE = """
[recording]
file = "ankle/z_df2.csv"
time = "time_s"
position = "position_rad"
torque = { column = "torque_Nm", sign = -1 }
[model]
human = { offset = false }
[filter]
position_cutoff = 45
decimation_cutoff = 45
high_pass = 0.3
[window]
length = 5
"""
REFLEX = ANKLE.replace('"ankle/z_df2.csv"', '"ankle/z_pf.npz"').replace(
    'time = "time_s"', 'sample_rate = "sample_rate_Hz"'
)


PENDULUM = """
[recording]
file = "double_pendulum/FILE"
time = "time"
position = ["pos1", "pos2"]
torque = ["tau1", "tau2"]
[model.arm]
gravity = true
zero = "hanging"
lengths = [0.3]
rotor = true
viscous = true
coulomb = true
[filter]
position_cutoff = 20
position_order = 4
decimation_cutoff = 10
[window]
length = 5
min_velocity = 0.1
"""
OWNERS = {"I1 + m2 l1^2 + rotor": 0.1106, "m2 r2": 0.1111, "I2": 0.0239, "m1 r1 + m2 l1": 0.3491}
"""The owners' own fit."""


def emps() -> dict[str, Any]:
    """Whole recording and windows of 5 s against the published parameters."""
    job = parse_job(EMPS, DATA)
    recording = job.load()
    prepared = prepare(job, recording)
    model, rows = prepared.model, prepared.rows
    whole = least_squares(rows.W, rows.torque, rows.valid, prepared.noise)
    estimates = identify(job)[0]
    mass = np.asarray(estimates.fit.theta)[:, model.names.index("inertia")]
    published = {
        "inertia": 95.1089,
        "viscous_friction": 203.5034,
        "coulomb_friction": 20.3935,
        "offset_torque": -3.1648,
    }
    return {
        name: {
            "published": published[name],
            "measured": float(whole.theta[k]),
            "standard_error": float(whole.stderr[k]),
            "relative_difference": float(whole.theta[k] / published[name] - 1),
        }
        for k, name in enumerate(model.names)
    } | {
        "windows_of_5_s": {
            "largest_relative_difference_of_the_mass": float(np.nanmax(np.abs(mass / published["inertia"] - 1))),
            "verdicts": estimates.verdicts.counts(),
            "lacking": dict(estimates.lacking),
        },
        "side_by_side": {noise: side_by_side(EMPS, noise) for noise in ("estimated", "filtered")},
    }


def side_by_side(text: str, noise: str) -> dict[str, Any]:
    """Windows of 5 s that share no sample: do they scatter as their own errors say?"""
    job = parse_job(text, DATA)
    estimates = identify(replace(job, window=replace(job.window, step=5.0, noise=noise)))[0]
    known = np.isfinite(estimates.value).all(axis=1)
    value, stderr = estimates.value[known], estimates.stderr[known]
    mean = (value / stderr**2).sum(axis=0) / (1 / stderr**2).sum(axis=0)
    squares, freedom = (((value - mean) / stderr) ** 2).sum(axis=0), len(value) - 1
    return {"windows": len(value)} | {
        name: {
            "mean": float(value[:, k].mean()),
            "sd": float(value[:, k].std(ddof=1)),
            "claimed": float(np.median(stderr[:, k])),
            "chi_squared_per_degree": float(squares[k] / freedom),
            "p": float(chi2.sf(squares[k], freedom)),
        }
        for k, name in enumerate(estimates.names)
    }


def ankle(text: str, noise: str = "estimated") -> dict[str, Any]:
    """Mean and spread over windows of 5 s."""
    job = parse_job(text, DATA)
    estimates = identify(replace(job, window=replace(job.window, noise=noise)))[0]
    theta = np.asarray(estimates.fit.theta)
    solved = np.asarray(estimates.verdicts.verdict) != "no data"
    return {
        name: {"mean": float(theta[solved, k].mean()), "sd": float(theta[solved, k].std()), "unit": unit}
        for k, (name, unit) in enumerate(zip(estimates.names, estimates.units, strict=True))
    } | {
        "mean_vaf": float(np.nanmean(np.asarray(estimates.fit.vaf)[solved])),
        "mean_held_out_vaf": float(np.nanmean(estimates.held_out_vaf)),
        "verdicts": estimates.verdicts.counts(),
        "lacking": dict(estimates.lacking),
        "side_by_side": side_by_side(text, noise),
    }


def pendulum() -> dict[str, Any]:
    """All four files together, and each predicted from the other three."""
    files = sorted(path.name for path in (DATA / "double_pendulum").glob("*.csv"))
    parts = []
    for name in files:
        job = parse_job(PENDULUM.replace("FILE", name), DATA)
        recording = job.load()
        prepared = prepare(job, recording)
        model, rows = prepared.model, prepared.rows
        parts.append((np.asarray(rows.W), np.asarray(rows.torque), rows.valid))
    noise = prepared.noise

    def fit(chosen: list[int]) -> Any:
        W, torque, valid = (np.concatenate([parts[k][i] for k in chosen]) for i in range(3))
        return least_squares(W, torque, valid, noise)

    together = fit(list(range(len(files))))
    theta = dict(zip(model.names, np.asarray(together.theta), strict=True))
    combined = {
        "I1 + m2 l1^2 + rotor": {"inertia_1": 1.0, "inertia_3": -1.0},
        "m2 r2": {"gravity_2": 1.0},
        "I2": {"inertia_3": 1.0},
        "m1 r1 + m2 l1": {"gravity_1": 1.0},
    }
    weights = {name: np.array([of.get(own, 0.0) for own in model.names]) for name, of in combined.items()}
    held_out = {}
    for k, name in enumerate(files):
        W, torque, valid = parts[k]
        residual = torque - W @ np.asarray(fit([j for j in range(len(files)) if j != k]).theta)
        held_out[name] = float(np.linalg.norm(residual[valid]) / np.linalg.norm(torque[valid]))
    estimates = identify(job)[0]
    residual = np.concatenate([(torque - W @ np.asarray(together.theta))[valid] for W, torque, valid in parts])
    return {
        name: {
            "owners": OWNERS[name],
            "measured": float(w @ together.theta),
            "standard_error": float(np.sqrt(w @ np.asarray(together.covariance) @ w)),
            "relative_difference": float(w @ together.theta / OWNERS[name] - 1),
        }
        for name, w in weights.items()
    } | {
        "parameters": {name: float(x) for name, x in theta.items()},
        "stderr": dict(zip(model.names, np.asarray(together.stderr).tolist(), strict=True)),
        "residual": float(np.linalg.norm(residual) / np.linalg.norm(np.concatenate([t[v] for _, t, v in parts]))),
        "residual_of_the_file_that_was_held_out": held_out,
        "windows_of_5_s_of_the_last_file": estimates.verdicts.counts(),
        "lacking": dict(estimates.lacking),
    }


if __name__ == "__main__":
    if not DATA.is_dir():
        print(f"skipped: no real recordings in {DATA.name!r}; set JAXIMP_DATA to their folder")
        sys.exit(0)
    results = {
        "emps": emps(),
        "ankle z_df2": ankle(ANKLE),
        "ankle z_df2, ordinary least squares": ankle(ANKLE, "filtered"),
        "ankle z_pf": ankle(REFLEX),
        "double pendulum": pendulum(),
    }
    text = json.dumps(results, indent=1)
    (HERE / "results" / "real_recordings.json").write_text(text + "\n")
    print(text)
