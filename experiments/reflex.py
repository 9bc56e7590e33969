"""Does a bank of lags explain a stretch reflex, and does it give back the intrinsic stiffness?

Two recordings of a human ankle under imposed perturbations (`real_recordings.py` says where they are looked for):
`z_pf` with a strong stretch reflex, `z_df2` as a control with little of one; and a simulated joint whose reflex is a
delay of 40 ms, rectified velocity and a low-pass of second order, 40 noise seeds.
Of each recording: parameters from all of it, how well those of its first half predict its second, and windows of 5 s.
Writes experiments/results/reflex.json and, with the ankle's kernels, reflex.png.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray
from real_recordings import ANKLE, DATA, REFLEX
from scipy.signal import butter, cont2discrete, lfilter, sosfiltfilt

from jaximp import parse_job, plots
from jaximp.identification.prepared import Prepared
from jaximp.jobs import Job, identify_recording, prepare
from jaximp.least_squares import confidence_interval, least_squares
from jaximp.models import pathway_of, reflex_gain
from jaximp.recordings import recording_from_arrays
from jaximp.types import Recording

jax.config.update("jax_enable_x64", True)

RESULTS = Path(__file__).parent / "results"
MODELS = {
    "no reflex": "false",
    "stretch when the velocity is above zero": "true",
    "stretch when the velocity is below zero": "{ direction = -1 }",
}
BANKS = {
    "30 lags from 1 to 291 ms": "{ first = 0.001, last = 0.291, count = 30 }",
    "27 lags from 40 to 300 ms": "{ first = 0.04, last = 0.3, count = 27 }",
    "37 lags from 40 to 400 ms": "{ first = 0.04, last = 0.4, count = 37 }",
    "31 lags from 40 to 490 ms (default)": "true",
    "46 lags from 40 to 490 ms": "{ first = 0.04, last = 0.49, count = 46 }",
    "16 lags from 40 to 490 ms": "{ first = 0.04, last = 0.49, count = 16 }",
    "51 lags from 40 to 790 ms": "{ first = 0.04, last = 0.79, count = 51 }",
}
SEEDS = 40
TRUTH = {"inertia": 0.015, "damping": 0.7, "stiffness": 60.0}
GAIN, DELAY, POLE = 8.0, 0.04, 25.0  # N m s/rad, s, 1/s


def job_of(text: str, reflex: str) -> Job:
    return parse_job(text.replace("offset = false", f"offset = false, reflex = {reflex}"), DATA)


def fit(prepared: Prepared, part: slice = slice(None)) -> Any:
    rows = prepared.rows
    return jax.jit(least_squares)(rows.W[part], rows.torque[part], rows.valid[part], prepared.noise)


def predicted(prepared: Prepared) -> float:
    """VAF of the second half with the parameters of the first."""
    rows, half = prepared.rows, len(prepared.rows.time) // 2
    theta = fit(prepared, slice(0, half)).theta
    unseen = np.flatnonzero(rows.valid[half:]) + half
    torque = np.asarray(rows.torque)[unseen]
    residual = torque - np.asarray(rows.W)[unseen] @ np.asarray(theta)
    return float(1 - residual.var() / torque.var())


def whole(prepared: Prepared) -> dict[str, Any]:
    """Parameters from all of a recording."""
    found = fit(prepared)
    size = np.linalg.norm(np.asarray(prepared.rows.W)[prepared.rows.valid], axis=0)
    names = prepared.model.names
    result: dict[str, Any] = {
        name: {"estimate": float(found.theta[names.index(name)]), "stderr": float(found.stderr[names.index(name)])}
        for name in TRUTH
    }
    result |= {"vaf": float(found.vaf), "vaf_of_second_half_predicted_by_first": predicted(prepared)}
    scaled = np.asarray(prepared.rows.W)[prepared.rows.valid] / size
    result["condition_of_columns_of_equal_norm"] = float(np.linalg.cond(scaled))
    if prepared.model.memory:
        one = reflex_gain(prepared.model, found.theta, found.covariance)
        result |= {
            "reflex_gain": {"estimate": float(one.gain), "stderr": float(one.gain_stderr)},
            "reflex_delay_s": {"estimate": float(one.delay), "stderr": float(one.delay_stderr)},
        }
    return result


def in_windows_of_5_s(job: Job, recording: Recording) -> dict[str, Any]:
    estimates = identify_recording(job, recording)[0].summarised()
    known = estimates.verdicts.verdict != "no data"
    theta, stderr = (np.asarray(x)[known] for x in (estimates.fit.theta, estimates.fit.stderr))
    return {
        name: {"mean": float(theta[:, k].mean()), "sd": float(theta[:, k].std()), "stderr": float(stderr[:, k].mean())}
        for k, name in enumerate(estimates.names)
    } | {
        "mean_vaf": float(np.nanmean(np.asarray(estimates.fit.vaf)[known])),
        "mean_held_out_vaf": float(np.nanmean(estimates.held_out_vaf[known])),
        "verdicts": estimates.verdicts.counts(),
    }


def ankle(text: str) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, reflex in MODELS.items():
        job = job_of(text, reflex)
        recording = job.load()
        found[name] = {
            "whole": whole(prepare(job, recording)),
            "windows": in_windows_of_5_s(job, recording),
        }
    found["banks"] = {
        name: whole(prepare(job_of(text, reflex), recording)) | {"next_window_vaf": next_window(job_of(text, reflex))}
        for name, reflex in BANKS.items()
    }
    return found


def next_window(job: Job) -> float:
    """VAF of the 5 s after windows of 5 s."""
    prepared = prepare(job)
    rows, length = prepared.rows, round(5 * prepared.recording.sample_rate / prepared.pipeline.filters.decimate)
    W, torque, valid = np.asarray(rows.W), np.asarray(rows.torque), rows.valid
    known = np.flatnonzero(valid)
    shares = []
    for start in range(int(known[0]), int(known[-1]) - 2 * length, length // 2):
        theta = np.linalg.lstsq(W[start : start + length], torque[start : start + length], rcond=None)[0]
        ahead = slice(start + length, start + 2 * length)
        shares.append(1 - (torque[ahead] - W[ahead] @ theta).var() / torque[ahead].var())
    return float(np.mean(shares))


def simulated(seed: int, rate: float = 1000.0, seconds: float = 12.0) -> Recording:
    """A joint that a filtered noise moves, with white noise of the torque."""
    random, n = np.random.default_rng(seed), round(seconds * rate)
    q = sosfiltfilt(butter(4, 8.0, fs=rate, output="sos"), random.normal(size=n))
    q *= 0.03 / q.std()
    dq = np.gradient(q, 1 / rate)
    ddq = np.gradient(dq, 1 / rate)
    shift = round(DELAY * rate)
    b, a, _ = cont2discrete(([POLE**2], [1, 2 * POLE, POLE**2]), 1 / rate, method="foh")
    reflex = GAIN * lfilter(b.ravel(), a, np.r_[np.zeros(shift), np.maximum(dq[:-shift], 0)])
    intrinsic = sum(size * x for size, x in zip(TRUTH.values(), (ddq, dq, q), strict=True))
    torque = intrinsic + reflex + random.normal(0, 0.1, n)
    return recording_from_arrays(np.arange(n) / rate, q, torque)


def simulation() -> dict[str, Any]:
    text = ANKLE[ANKLE.index("[model]") :].replace("high_pass = 0.3", "")
    text = "recording = {}\n" + text.replace("offset = false", "reflex = REFLEX")
    truth = np.array([*TRUTH.values(), 0.0])
    found: dict[str, Any] = {}
    for name, reflex in (("without", "false"), ("with", "true")):
        job = parse_job(text.replace("REFLEX", reflex))
        theta, inside, gains, delays = [], [], [], []
        for seed in range(SEEDS):
            prepared = prepare(job, simulated(seed))
            one = fit(prepared)
            theta.append(np.asarray(one.theta)[:4])
            low, high = (x[:4] for x in confidence_interval(one.theta, one.stderr, one.dof))
            inside.append((low <= truth) & (truth <= high))
            if prepared.model.memory:
                both = reflex_gain(prepared.model, one.theta, one.covariance)
                gains.append([float(both.gain), float(both.gain_stderr)])
                delays.append([float(both.delay), float(both.delay_stderr)])
        found[name] = {
            parameter: {
                "truth": float(truth[k]),
                "mean": float(np.mean(theta, axis=0)[k]),
                "sd": float(np.std(theta, axis=0, ddof=1)[k]),
                "share_of_95_percent_intervals_that_hold_the_truth": float(np.mean(inside, axis=0)[k]),
            }
            for k, parameter in enumerate(prepared.model.names[:4])
        }
        for what, values, right in (("reflex_gain", gains, GAIN), ("reflex_delay_s", delays, DELAY + 2 / POLE)):
            if values:
                numbers = np.array(values)
                found[name][what] = {
                    "truth": right,
                    "mean": float(numbers[:, 0].mean()),
                    "sd": float(numbers[:, 0].std(ddof=1)),
                    "mean_stderr": float(numbers[:, 1].mean()),
                }
    return {"seeds": SEEDS, **found}


def kernels() -> Any:
    """Weights from all of each recording, with 95 % intervals; and what the reflex leaves of the torque of z_pf."""
    lines, bands = [], {}
    for name, text in (("z_pf", REFLEX), ("z_df2", ANKLE)):
        job = job_of(text, "true")
        prepared = prepare(job)
        found, lags = fit(prepared), 1e3 * np.array(pathway_of(prepared.model).lags)
        low, high = confidence_interval(found.theta, found.stderr, found.dof)
        lines.append((name, lags, np.asarray(found.theta)[3:]))
        bands[name] = (low[3:], high[3:])
    return plots.curves(
        [
            plots.Panel("Weights of the lags, from all of the recording", "lag [ms]", "N m s/rad", lines, bands=bands),
            plots.Panel("Torque of z_pf, 2 s of it", "time [s]", "N m", torque_lines()),
        ]
    )


def torque_lines() -> list[tuple[str, NDArray[np.float64], NDArray[np.float64]]]:
    lines: list[tuple[str, NDArray[np.float64], NDArray[np.float64]]] = []
    for label, reflex in (("without", "false"), ("with reflex", "true")):
        job = job_of(REFLEX, reflex)
        prepared = prepare(job)
        rows = prepared.rows
        part = (rows.time >= 40) & (rows.time < 42)
        if not lines:
            lines.append(("measured", rows.time[part], np.asarray(rows.torque)[part]))
        lines.append((label, rows.time[part], np.asarray(rows.W @ fit(prepared).theta)[part]))
    return lines


def run() -> dict[str, Any]:
    found: dict[str, Any] = {"simulated joint": simulation()}
    if DATA.is_dir():
        found |= {"ankle z_pf": ankle(REFLEX), "ankle z_df2": ankle(ANKLE)}
        (RESULTS / "reflex.png").write_bytes(plots.png(kernels()))
    else:
        print(
            f"no real recordings in {DATA.name!r}: set JAXIMP_DATA to their folder; the simulation alone is not written"
        )
    return found


if __name__ == "__main__":
    results = run()
    text = json.dumps(results, indent=1)
    if "ankle z_pf" in results:
        (RESULTS / "reflex.json").write_text(text + "\n")
    print(text)
