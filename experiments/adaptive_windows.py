"""Windows that are as long as they need, against windows of one length, where a stiffness steps.

The simulated rig of Tout et al. 2023, IV: the stiffness at the handle doubles at one of eight times, and the human's
trajectory excites it better at some times than at others. Torque at 500 Hz without a decimation filter (its noise is
white), robot first (method 1). Noise: root mean square error of the stiffness in the windows that do not reach across
the step. Delay: area between the estimate and the true stiffness after the step, divided by the step's height; where
no window is sure enough the last estimate is kept. Both over all eight recordings.
Writes experiments/results/adaptive_windows.json and .png.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from jaximp import adaptive_least_squares, parse_job, plots, sliding_least_squares
from jaximp.jobs import prepare
from jaximp.least_squares import SlidingFit
from jaximp.simulation import HumanLoad
from jaximp.simulation.rig_recordings import rig_recordings

jax.config.update("jax_enable_x64", True)

RESULTS = Path(__file__).parent / "results"
STEP_TIMES = np.arange(6.0, 14.0)
BEFORE, AFTER = 1e-3, 2e-3  # N m/rad
RATE, STEP = 500.0, 0.01
FIXED = np.array([1.0, 1.25, 1.5, 1.75, 2.0, 2.25, 2.5, 3.0])  # s
WANTED = np.array([2e-4, 1.4e-4, 1e-4, 7e-5, 5e-5, 3.5e-5])  # N m/rad
SHORTEST, LONGEST = 0.25, 4.0  # s
JOB = parse_job(
    """
    recording = {}
    robot_recording = {}
    [model]
    robot = { gear_ratio = 15, gravity = true }
    human = { gear_ratio = 15 }
    [filter]
    position_cutoff = 10
    decimate = 2
    [window]
    length = 2.0
    """
)


class Case(NamedTuple):
    """A recording as rows for least squares."""

    W: Any
    y: Any
    valid: NDArray[np.bool_]
    time: NDArray[np.float64]
    step_time: float


def case(seed: int, step_time: float) -> Case:
    load = HumanLoad(stiffness=BEFORE, stiffness_after=AFTER, step_time=step_time)
    alone, held = rig_recordings(load, seed)
    prepared = prepare(JOB, held, alone)
    pair = prepared.pair
    assert pair is not None
    torque = prepared.rows.torque - pair.loaded.robot @ pair.robot_fit.theta
    return Case(pair.loaded.human, torque, prepared.rows.valid, prepared.rows.time, step_time)


def stiffness(of: Case, fit: SlidingFit) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """First and last instant of every window, and its stiffness; the last one where there is none."""
    K = np.asarray(fit.theta)[:, 2]
    known = np.maximum.accumulate(np.where(np.isfinite(K), np.arange(len(K)), 0))
    return of.time[np.asarray(fit.first)], of.time[np.asarray(fit.last)], K[known]


def noise_and_delay(cases: list[Case], fits: list[SlidingFit]) -> dict[str, float]:
    errors, areas, lengths = [], [], []
    for of, fit in zip(cases, fits, strict=True):
        first, last, K = stiffness(of, fit)
        begun = last > LONGEST  # by then every way has its first estimate
        error = K - np.where(last < of.step_time, BEFORE, AFTER)
        errors.append(error[begun & ((last < of.step_time) | (first >= of.step_time)) & np.isfinite(fit.theta[:, 2])])
        after = (last >= of.step_time) & (last < of.step_time + LONGEST)
        areas.append(np.abs(error[after]).sum() * STEP / (AFTER - BEFORE))
        lengths.append((last - first)[begun])
    return {
        "noise": float(np.sqrt(np.mean(np.concatenate(errors) ** 2))),
        "delay_s": float(np.mean(areas)),
        "mean_length_s": float(np.mean(np.concatenate(lengths))),
    }


def fixed(of: Case, length: float) -> SlidingFit:
    room = round(FIXED.max() * RATE)
    return sliding_least_squares(of.W, of.y, length, STEP, sample_rate=RATE, valid=of.valid, room=room)


def adaptive(of: Case, wanted: float) -> SlidingFit:
    sure = np.array([np.inf, np.inf, wanted, np.inf])
    return adaptive_least_squares(of.W, of.y, sure, SHORTEST, LONGEST, step=STEP, sample_rate=RATE, valid=of.valid)


def figure(found: dict[str, Any], example: Case) -> Any:
    truth = np.where(example.time < example.step_time, BEFORE, AFTER)
    estimated, length = [("truth", example.time, 1e3 * truth)], []
    for name, fit in (("2 s", fixed(example, 2.0)), ("as needed", adaptive(example, 7e-5))):
        first, last, K = stiffness(example, fit)
        estimated.append((name, last, 1e3 * K))
        length.append((name, last, last - first))
    trade = [
        (name, *(np.array([one[key] for one in found[which].values()]) for key in ("noise", "delay_s")))
        for name, which in (("one length", "fixed"), ("as needed", "adaptive"))
    ]
    return plots.curves(
        [
            plots.Panel("Stiffness", "time [s]", "mN m/rad", estimated, limits=(0.5, 2.5)),
            plots.Panel("Length of the window that ends here", "time [s]", "s", length),
            plots.Panel(
                "Delay after the step, over eight recordings",
                "noise of the stiffness [mN m/rad]",
                "s",
                [(name, 1e3 * noise, delay) for name, noise, delay in trade],
            ),
        ]
    )


def run() -> dict[str, Any]:
    cases = [case(seed, float(step_time)) for seed, step_time in enumerate(STEP_TIMES)]
    found: dict[str, Any] = {
        "fixed": {f"{length:g} s": noise_and_delay(cases, [fixed(of, length) for of in cases]) for length in FIXED},
        "adaptive": {f"{one:g}": noise_and_delay(cases, [adaptive(of, one) for of in cases]) for one in WANTED},
    }
    noise, delay = (np.array([one[key] for one in found["fixed"].values()]) for key in ("noise", "delay_s"))
    for one in found["adaptive"].values():
        inside = noise.min() <= one["noise"] <= noise.max()
        order = np.argsort(noise)
        equal = np.interp(np.log(one["noise"]), np.log(noise[order]), delay[order]) if inside else np.nan
        one["delay_of_fixed_windows_at_equal_noise_s"] = float(equal)
    (RESULTS / "adaptive_windows.png").write_bytes(plots.png(figure(found, cases[3])))
    return found


if __name__ == "__main__":
    found = run()
    text = json.dumps(found, indent=1)
    (RESULTS / "adaptive_windows.json").write_text(text + "\n")
    print(text)
