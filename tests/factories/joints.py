"""Joints of known impedance, simulated, and jobs that identify them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from jaximp.jobs.job import Job, parse_job
from jaximp.recordings.load import recording_from_arrays
from jaximp.types import Recording

Numbers = NDArray[np.float64]

TIME = np.arange(8000) * 1e-3
TRUTH = {"inertia": 0.1, "damping": 1.5, "stiffness": 20.0, "offset_torque": -2.0}
MULTISINE = ((0.2, 1.1, 0.0), (0.1, 2.9, 0.5), (0.04, 6.3, 1.0))
"""Amplitude [rad], frequency [Hz] and phase [rad] of each sine."""
JOB = """
recording = {}
[model]
human = true
[filter]
position_cutoff = 40
decimation_cutoff = 20
[window]
length = 1
step = 0.1
"""


def sines(time: Numbers, lines: tuple[tuple[float, float, float], ...] = MULTISINE) -> Numbers:
    """Position, velocity and acceleration (3, N)."""
    derivatives = [
        sum(a * (2 * np.pi * f) ** k * np.sin(2 * np.pi * f * time + p + k * np.pi / 2) for a, f, p in lines)
        for k in range(3)
    ]
    return np.stack(derivatives)


def joint(
    time: Numbers = TIME,
    motion: Numbers | None = None,
    *,
    seed: int = 1,
    torque_noise: float = 0.2,
    position_noise: float = 0.0,
    **changes: float,
) -> Recording:
    """A joint that moves at three frequencies, unless another motion (3, N) is given; the truth may be changed."""
    random, truth = np.random.default_rng(seed), TRUTH | changes
    q, dq, ddq = sines(time) if motion is None else motion
    torque = truth["inertia"] * ddq + truth["damping"] * dq + truth["stiffness"] * q + truth["offset_torque"]
    measured_torque = torque + random.normal(0, torque_noise, len(time))
    return recording_from_arrays(time, q + random.normal(0, position_noise, len(time)), measured_torque)


def ankle_job(folder: Path, file: str, human: str, step: float) -> Job:
    """For the real ankle."""
    time = 'sample_rate = "sample_rate_Hz"' if file.endswith("npz") else 'time = "time_s"'
    return parse_job(
        f"""
        [recording]
        file = "ankle/{file}"
        {time}
        position = "position_rad"
        torque = {{ column = "torque_Nm", sign = -1 }}
        [model]
        human = {human}
        [filter]
        position_cutoff = 45
        decimation_cutoff = 45
        high_pass = 0.3
        [window]
        length = 5
        step = {step}
        """,
        folder,
    )
