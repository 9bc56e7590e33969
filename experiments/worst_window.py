"""Windows of half the length, at equal limits: designing for the worst window against designing for the whole period.

Named as future work by Tout et al. 2023, VI. The simulated rig with the stiffness 1e-3 N m/rad at its handle, robot
first (method 1), model with offset. The motion for the whole period is `HUMAN_TRAJECTORY`: 7 harmonics, the least
condition number there is, and all of the handle's range. What it reaches in angle, velocity and torque are the limits
of the others, which have the least standard error of the stiffness in the worst window of 1 s, and more harmonics.
Standard deviation of the stiffness over SEEDS recordings, in windows 50 ms apart: root mean square, and largest, of all
windows. Writes experiments/results/worst_window.json.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaximp import Limits, design_excitation, parse_job, sliding_least_squares
from jaximp.jobs.run import prepare
from jaximp.models import HumanJoint, RobotJoint
from jaximp.motion import FourierSeries
from jaximp.simulation import HUMAN_TRAJECTORY, HumanLoad, Rig
from jaximp.simulation.rig_recordings import rig_recordings

jax.config.update("jax_enable_x64", True)

RESULTS = Path(__file__).parent / "results"
SEEDS = 20
STIFFNESS = 1e-3  # N m/rad at the motor
HANDLE = (-10.5, 10.5)  # rad at the motor
HARMONICS = (7, 10, 15, 20, 30)
LENGTHS = (1.0, 2.0)  # s
JOB = parse_job(
    """
    recording = {}
    robot_recording = {}
    [model]
    robot = { gear_ratio = 15, gravity = true }
    human = { gear_ratio = 15 }
    [filter]
    position_cutoff = 10
    decimation_cutoff = 5
    [window]
    length = 2.0
    """
)


def parameters() -> np.ndarray:
    rig = Rig()
    robot = [rig.gravity_x, rig.gravity_y, rig.viscous_friction, rig.coulomb_friction, rig.inertia]
    return np.array([*(float(x) for x in robot), 0, 0, STIFFNESS, 0])


def deviations(trajectory: FourierSeries) -> dict[str, Any]:
    """Standard deviation of the stiffness in windows of each length, and how far the motion goes."""
    load = HumanLoad(stiffness=STIFFNESS, stiffness_after=STIFFNESS)
    found: dict[float, list[Any]] = {length: [] for length in LENGTHS}
    for seed in range(SEEDS):
        alone, held = rig_recordings(load, seed, trajectory, 20.0)
        prepared = prepare(JOB, held, alone)
        pair, rows = prepared.pair, prepared.rows
        assert pair is not None
        torque = rows.torque - pair.loaded.robot @ pair.robot_fit.theta
        rate = 1 / np.median(np.diff(rows.time))
        for length in LENGTHS:
            fit = sliding_least_squares(pair.loaded.human, torque, length, 0.05, sample_rate=rate, valid=rows.valid)
            found[length].append(np.asarray(fit.theta)[:, 2])
    return {f"{length:g} s": _numbers(np.array(estimates)) for length, estimates in found.items()}


def _numbers(estimates: np.ndarray) -> dict[str, float]:
    estimates = estimates[:, np.isfinite(estimates).all(axis=0)]
    sd, error = np.std(estimates, axis=0, ddof=1), np.mean(estimates, axis=0) - STIFFNESS
    return {
        "rms": float(np.sqrt(np.mean(sd**2))),
        "largest": float(sd.max()),
        "bias_rms": float(np.sqrt(np.mean(error**2))),
    }


def run() -> dict[str, Any]:
    human = HumanJoint(gear_ratio=15)
    moved, theta = RobotJoint(gear_ratio=15) + human, parameters()
    motion = [np.asarray(x) for x in HUMAN_TRAJECTORY(np.arange(0, 10, 1e-3))]
    limits = Limits(HANDLE, np.abs(motion[1]).max(), torque=np.abs(np.asarray(moved.torque(theta, *motion))).max())
    found: dict[str, Any] = {"velocity limit": limits.velocity, "torque limit": limits.torque}
    found["whole period, 7 harmonics"] = deviations(HUMAN_TRAJECTORY)
    for harmonics in HARMONICS:
        design = design_excitation(
            human, moved=moved, parameters=theta, limits=limits, harmonics=harmonics, window=1.0,
            objective="stderr", parameter="stiffness",
        )  # fmt: skip
        numbers = deviations(design.trajectory) | {"limits reached": design.active}
        found[f"worst window of 1 s, {harmonics} harmonics"] = numbers
    return found


if __name__ == "__main__":
    text = json.dumps(run(), indent=1)
    (RESULTS / "worst_window.json").write_text(text + "\n")
    print(text)
