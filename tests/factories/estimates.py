"""Estimates of a joint that stands still for a while: what figures and reports show."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import jax
import numpy as np

from jaximp.identification.estimates import Estimates
from jaximp.jobs.job import parse_job
from jaximp.jobs.run import identify_recording
from jaximp.types import Recording

JOB = """
recording = { file = "made in the test", position = "q", torque = "tau" }
model.human = { offset = true }
window = { length = 2, step = 0.25 }
filter = { position_cutoff = 15, decimation_cutoff = 15 }
"""


def recording(still: tuple[float, float] = (10, 16), name: str = "multisine") -> Recording:
    """A joint of known impedance on several sines of unlike frequency, which stands still for a while."""
    rate = 200.0
    time = np.arange(0, 25, 1 / rate)
    phases = [2 * np.pi * f * time + f**2 for f in (0.4, 1.1, 2.3, 4.7)]
    frequencies = [2 * np.pi * f for f in (0.4, 1.1, 2.3, 4.7)]
    moving = 1 - 1 / (1 + np.exp(-8 * (time - still[0]))) * 1 / (1 + np.exp(8 * (time - still[1])))
    position = 0.05 * moving * sum(np.sin(phase) / w for phase, w in zip(phases, frequencies, strict=True))
    velocity = np.gradient(position, time)
    noise = np.random.default_rng(1).normal(0, 0.005, len(time))
    torque = 0.015 * np.gradient(velocity, time) + 0.7 * velocity + 60 * (position - 0.01) + noise
    measured = position + np.random.default_rng(2).normal(0, 1e-6, len(time))
    return Recording(
        time=time,
        position=measured[:, None],
        torque=torque[:, None],
        valid=np.ones(len(time), bool),
        joints=("revolute",),
        name=name,
    )


@cache
def identified() -> Estimates:
    return identify_recording(parse_job(JOB), recording())[0]


def repeat(estimates: Estimates, windows: int, samples: int) -> Estimates:
    """The same estimates over and over, as a very long recording would have them."""
    k, n = np.arange(windows) % len(estimates.end), np.arange(samples) % len(estimates.time)
    return replace(
        estimates,
        fit=jax.tree.map(lambda x: x[k], estimates.fit),
        start=np.arange(windows) * 0.25,
        end=np.arange(windows) * 0.25 + 2,
        held_out_vaf=estimates.held_out_vaf[k],
        measured=tuple(windows.some(k) for windows in estimates.measured),
        time=np.arange(samples) / 200,
        torque=estimates.torque[n],
        reconstructed=estimates.reconstructed[n],
        predicted=estimates.predicted[n],
    )


def without_trust(estimates: Estimates) -> Estimates:
    return replace(estimates, limits=replace(estimates.limits, max_relative_stderr=0.0))
