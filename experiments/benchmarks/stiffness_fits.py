"""Fits of damping and of a symmetric, definite stiffness: how long they take, beside scipy on the samples.

Everything in one run, compiled before it is timed, the best of several. Writes results/stiffness_fits.json and .md.
"""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.optimize import least_squares

jax.config.update("jax_enable_x64", True)

from jaximp.perturbation import fit_triangles, residual_triangle  # noqa: E402

RESULTS = Path(__file__).parents[1] / "results"
FITS, TRIALS, SAMPLES, REPEATS = 10_000, 20, 460, 7
D, K = np.array([[2.42, 1.20], [1.20, 1.42]]), np.array([[29.05, 14.37], [14.37, 17.08]])
SOFT = np.array(
    [[29.05, 0.0], [0.0, 0.0]]
)  # on the boundary, where estimates without the constraint are often indefinite


def trials(stiffness: np.ndarray, seed: int) -> tuple[np.ndarray, ...]:
    """Displacement, velocity and torque (trials, samples, 2) of pulses along six directions."""
    random = np.random.default_rng(seed)
    u = np.linspace(0, 1, SAMPLES)
    pulse, rate = 64 * u**3 * (1 - u) ** 3, 192 * u**2 * (1 - u) ** 2 * (1 - 2 * u) / 0.46
    directions = 0.05 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [1, -1], [-1, 1]])[np.arange(TRIALS) % 6]
    amplitude = directions * random.normal(1, 0.1, (TRIALS, 1))
    displacement, velocity = (amplitude[:, None] * profile[:, None] for profile in (pulse, rate))
    noise = random.normal(0, 0.3, displacement.shape)
    return displacement, velocity, velocity @ D.T + displacement @ stiffness.T + noise


def scipy_fit(displacement: np.ndarray, velocity: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """Of eq. (38) of Börner et al. 2020 as it is written, on all samples."""
    q, dq, tau = (x.reshape(-1, 2) for x in (displacement, velocity, torque))

    def residual(p: np.ndarray) -> np.ndarray:
        L = np.array([[p[4], 0.0], [p[5], p[6]]])
        return (dq @ p[:4].reshape(2, 2).T + q @ (L @ L.T) - tau).ravel()

    p = least_squares(residual, [1, 0, 0, 1, 3, 0, 3]).x
    L = np.array([[p[4], 0.0], [p[5], p[6]]])
    return L @ L.T


def best(work: Callable[[], Any]) -> float:
    """Seconds, after a first call."""
    work()
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        jax.block_until_ready(work())
        times.append(time.perf_counter() - begin)
    return min(times)


def resampled(stiffness: np.ndarray, n: int) -> np.ndarray:
    """(n, TRIALS, 6, 6) triangles of trials drawn with replacement, as a bootstrap has them."""
    each = np.asarray(residual_triangle(*trials(stiffness, 0)))
    return each[np.random.default_rng(1).integers(0, TRIALS, (n, TRIALS))]


def measured() -> dict[str, Any]:
    found: dict[str, Any] = {"fits": FITS, "trials": TRIALS, "samples": SAMPLES}
    arrays = trials(K, 0)
    found["triangles_of_trials_s"] = best(lambda: residual_triangle(*arrays))
    for name, stiffness in (("interior", K), ("boundary", SOFT)):
        data, batch = trials(stiffness, 0), resampled(stiffness, FITS)
        merged = np.stack([np.linalg.qr(one.reshape(-1, 6))[1] for one in batch])[:, None]
        scipy_s = best(lambda data=data: scipy_fit(*data))
        fits_s = best(lambda merged=merged: fit_triangles(merged, TRIALS * SAMPLES))
        trials_s = best(lambda batch=batch: fit_triangles(batch, SAMPLES))
        one = fit_triangles(residual_triangle(*data), SAMPLES)
        found[name] = {
            "merged_s": fits_s,
            "from_trials_s": trials_s,
            "scipy_s": scipy_s,
            "ratio_merged": scipy_s / (fits_s / FITS),
            "ratio_from_trials": scipy_s / (trials_s / FITS),
            "on_boundary": float(np.asarray(fit_triangles(merged, TRIALS * SAMPLES).on_boundary).mean()),
            "apart_from_scipy": float(np.abs(np.asarray(one.K) - scipy_fit(*data)).max() / np.abs(stiffness).max()),
        }
    return found


def table(found: dict[str, Any]) -> list[str]:
    lines = ["| what | stiffness definite | most fits at its boundary |", "| --- | --- | --- |"]
    rows = {
        f"{FITS} fits from merged triangles [s]": ("merged_s", ".2f"),
        f"{FITS} fits of {TRIALS} trials each, from the triangles of the trials, with covariance [s]": (
            "from_trials_s",
            ".2f",
        ),
        f"one fit of {TRIALS} trials of {SAMPLES} samples with scipy's least_squares [ms]": ("scipy_s", ".1f"),
        "scipy's time over that of one fit from merged triangles": ("ratio_merged", ".0f"),
        "scipy's time over that of one fit from trials, with covariance": ("ratio_from_trials", ".0f"),
        "fits at the boundary [1]": ("on_boundary", ".2f"),
        "K apart from scipy's, relative [1]": ("apart_from_scipy", ".0e"),
    }
    for text, (key, form) in rows.items():
        factor = 1e3 if "[ms]" in text else 1
        cells = [format(factor * found[name][key], form) for name in ("interior", "boundary")]
        lines.append(f"| {text} | {' | '.join(cells)} |")
    once = 1e3 * found["triangles_of_trials_s"]
    return [*lines, "", f"The triangles of {TRIALS} trials, computed once, take {once:.1f} ms."]


def machine() -> str:
    model = next((line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")), "")
    return f"{os.cpu_count()} cores, {model.split(':')[-1].strip() or platform.processor()}"


if __name__ == "__main__":
    found = measured()
    text = "\n".join([machine() + "\n", *table(found)])
    (RESULTS / "stiffness_fits.json").write_text(json.dumps({"machine": machine()} | found, indent=1) + "\n")
    (RESULTS / "stiffness_fits.md").write_text(text + "\n")
    print(text)
