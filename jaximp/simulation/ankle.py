"""A simulated ankle whose stiffness doubles: the recording of `jaximp demo`, and of examples/ankle.csv.

An actuator moves a tensed ankle by a few degrees. Halfway through the subject pushes harder, and the stiffness doubles.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from jaximp.recordings.outputs import write_whole
from jaximp.types import Numbers

INERTIA = 0.015
"""[kg m^2]"""
DAMPING = 0.7
"""[N m s/rad]"""
STIFFNESS = (60.0, 120.0)
"""Before and after the change [N m/rad]."""
EQUILIBRIUM = 0.05
"""The angle at which the ankle would rest [rad]."""
CHANGE = 12.0
"""When the stiffness doubles [s]."""
DURATION = 24.0
"""[s]"""
RATE = 500
"""Samples per second."""
HIGHEST = 25.0
"""The perturbation holds every frequency up to this one [Hz]: slow ones show the stiffness, fast ones the inertia."""
AMPLITUDE = 1.5
"""Of the perturbation, root mean square [deg]."""
TORQUE_NOISE = 0.3
"""White, standard deviation [N m]."""
ENCODER_STEP = 0.005
"""[deg]"""


def ankle_motion(t: Numbers, rng: np.random.Generator) -> tuple[Numbers, ...]:
    """Angle [rad], velocity and acceleration of the perturbation: a sum of sines with random phases.

    Up to 5 Hz all are equally large, and above that they fall with the square of the frequency, as an actuator of
    limited acceleration makes them.
    """
    period = DURATION / 2
    w = 2 * np.pi * np.arange(1, round(HIGHEST * period) + 1) / period
    amplitude = 1 / (1 + (w / (2 * np.pi * 5)) ** 2)
    amplitude *= np.radians(AMPLITUDE) / np.sqrt(np.sum(amplitude**2) / 2)
    angle = t[:, None] * w + rng.uniform(0, 2 * np.pi, len(w))
    return np.sin(angle) @ amplitude, np.cos(angle) @ (amplitude * w), -np.sin(angle) @ (amplitude * w**2)


def ankle_recording(seed: int = 1) -> Numbers:
    """Columns t [s], angle [deg] and moment [N m], as a laboratory would have logged them."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(DURATION * RATE)) / RATE
    q, dq, ddq = ankle_motion(t, rng)
    stiffness = np.where(t < CHANGE, *STIFFNESS)
    torque = INERTIA * ddq + DAMPING * dq + stiffness * (q - EQUILIBRIUM)
    moment = -torque + TORQUE_NOISE * rng.normal(size=len(t))  # the ankle's answer, hence the sign
    angle = ENCODER_STEP * np.round(np.degrees(q) / ENCODER_STEP)
    return np.column_stack([t, angle, moment])


JOB = """\
# Inertia, damping and stiffness of a simulated ankle, whose stiffness doubles halfway (make_ankle.py made ankle.csv).

[recording]
file = "ankle.csv"                                      # also .parquet, .mat, .h5, .npz
time = { column = "t", unit = "s" }                     # or sample_rate = 500
position = { column = "angle", unit = "deg" }
torque = { column = "moment", unit = "N m", sign = -1 } # the torque on the joint; if it was logged as the joint's answer, -1

[model]
human = true                                            # inertia, damping, stiffness, offset

[filter]
position_cutoff = 90                                    # Hz, before differentiation; `jaximp check` proposes both
decimation_cutoff = 45                                  # Hz, for the torque and every column of the regressor

[window]
length = 2                                              # s
"""  # noqa: E501


def truth_in_words() -> list[str]:
    """What an identification is to find, a line for each parameter."""
    before, after = STIFFNESS
    return [
        f"inertia {INERTIA:g} kg m^2",
        f"damping {DAMPING:g} N m s/rad",
        f"stiffness {before:g} until {CHANGE:g} s, then {after:g} N m/rad",
        f"offset_torque {-before * EQUILIBRIUM:g} until {CHANGE:g} s, then {-after * EQUILIBRIUM:g} N m",
    ]


def write_ankle_csv(path: Path, seed: int = 1) -> None:
    """The recording as a file, with a head."""
    lines = [f"{t:.3f},{angle:.3f},{moment:.3f}" for t, angle, moment in ankle_recording(seed)]
    write_whole(path, ("\n".join(["t,angle,moment", *lines]) + "\n").encode())


def write_ankle_recording(folder: Path, seed: int = 1) -> None:
    """Write ankle.csv, job.toml, and truth.json with what is to be found."""
    write_ankle_csv(folder / "ankle.csv", seed)
    (folder / "job.toml").write_text(JOB, encoding="utf-8")
    truth = {
        "inertia": INERTIA, "damping": DAMPING, "stiffness": STIFFNESS, "equilibrium": EQUILIBRIUM, "change_s": CHANGE,
    }  # fmt: skip
    (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
