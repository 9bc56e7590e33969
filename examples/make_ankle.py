"""Makes ankle.csv, the sample recording of this folder: run `python examples/make_ankle.py`.

An actuator moves a tensed ankle by a few degrees. Halfway through the subject pushes harder, and the stiffness doubles.
The truth is known, so that anybody can compare what `jaximp identify examples/ankle.toml` finds with it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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


def motion(t: NDArray[np.float64], rng: np.random.Generator) -> tuple[NDArray[np.float64], ...]:
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


def recording(seed: int = 1) -> NDArray[np.float64]:
    """Columns t [s], angle [deg] and moment [N m], as a laboratory would have logged them."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(DURATION * RATE)) / RATE
    q, dq, ddq = motion(t, rng)
    stiffness = np.where(t < CHANGE, *STIFFNESS)
    torque = INERTIA * ddq + DAMPING * dq + stiffness * (q - EQUILIBRIUM)
    moment = -torque + TORQUE_NOISE * rng.normal(size=len(t))  # the ankle's answer, hence the sign
    angle = ENCODER_STEP * np.round(np.degrees(q) / ENCODER_STEP)
    return np.column_stack([t, angle, moment])


if __name__ == "__main__":
    np.savetxt(
        Path(__file__).with_name("ankle.csv"), recording(), fmt=("%.3f", "%.3f", "%.3f"), delimiter=",",
        header="t,angle,moment", comments="",
    )  # fmt: skip
