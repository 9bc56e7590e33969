"""Runs the main job on the real recordings and writes the numbers of the README's table.

The recordings are not part of this project: they are looked for in the folder named by JAXIMP_DATA, else in
../shared/data beside the checkout. Writes experiments/results/real_recordings.json.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaximp import identify, parse_job
from jaximp.least_squares import least_squares
from jaximp.regression import design_filters, noise_of_rows, regress

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


def emps() -> dict[str, Any]:
    """Whole recording and windows of 5 s against the published parameters."""
    job = parse_job(EMPS, DATA)
    recording = job.load()
    model = job.models(recording.joints)[0]
    assert model is not None
    filters = design_filters(job.filter, recording.sample_rate)
    rows = regress(model, recording, job, filters)
    whole = least_squares(rows.W, rows.torque, rows.valid, noise_of_rows(job, recording, filters))
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
        }
    }


def ankle(text: str) -> dict[str, Any]:
    """Mean and spread over windows of 5 s."""
    estimates = identify(parse_job(text, DATA))[0]
    theta = np.asarray(estimates.fit.theta)
    solved = np.asarray(estimates.verdicts.verdict) != "no data"
    return {
        name: {"mean": float(theta[solved, k].mean()), "sd": float(theta[solved, k].std()), "unit": unit}
        for k, (name, unit) in enumerate(zip(estimates.names, estimates.units, strict=True))
    } | {
        "mean_vaf": float(np.nanmean(np.asarray(estimates.fit.vaf)[solved])),
        "mean_held_out_vaf": float(np.nanmean(estimates.held_out_vaf)),
        "verdicts": estimates.verdicts.counts(),
    }


if __name__ == "__main__":
    if not DATA.is_dir():
        print(f"skipped: no real recordings in {DATA.name!r}; set JAXIMP_DATA to their folder")
        sys.exit(0)
    results = {"emps": emps(), "ankle z_df2": ankle(ANKLE), "ankle z_pf": ankle(REFLEX)}
    text = json.dumps(results, indent=1)
    (HERE / "results" / "real_recordings.json").write_text(text + "\n")
    print(text)
