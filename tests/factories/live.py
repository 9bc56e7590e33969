"""One joint, live: a calibration that is written down and not learnt, so that nothing has to be compiled for it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from factories.joints import joint
from jaximp.identification.filter_settings import FilterSettings
from jaximp.identification.pipeline import Pipeline, WindowSettings
from jaximp.least_squares.autoregression import Autoregression
from jaximp.live.calibration import Calibration, live_of, purpose, samples_of
from jaximp.live.estimator import Live
from jaximp.live.front import Sample
from jaximp.models.joint import HumanJoint
from jaximp.tracking.online import Frozen, Kind

RATE = 200.0
PIPELINE = Pipeline(
    sample_rate=RATE,
    model=HumanJoint(),
    window=WindowSettings(length=1.0, step=0.1),
    filter=FilterSettings(position_cutoff=25.0, decimation_cutoff=15.0),
)
"""Rows at 40 Hz."""


@lru_cache
def calibration(jumps: bool = False, order: int = 0) -> Calibration:
    """Two models side by side."""
    p, lanes = 4, 2
    step = np.outer([1e-3, 1e-3, 0.02, 1e-3], [1.0, 2.0])
    walk, slope = (step**2, 0 * step) if order == 0 else (0 * step, step)
    kind = Kind(
        walk, slope, np.full((p, lanes), 30.0), np.array([1.0, 1.3]), np.array(-8.0), np.array(1.0), step.T, order
    )
    theta = np.array([0.1, 1.5, 20.0, 2.0])
    return Calibration(
        filtered=Autoregression(np.array([-0.6, 0.3, -0.1])),
        noise=Autoregression(np.array([0.2])),
        frozen=Frozen(np.array(0.1), theta, kind, 2, 5, jumps),
        column_noise=np.full(p, 1e-4),
        parameter_scale=theta,
        robot_theta=np.zeros(0),
        seconds=10.0,
        sample_rate=RATE,
        made_for=purpose(PIPELINE),
    )


@lru_cache
def live(jumps: bool = False, order: int = 0) -> Live:
    return live_of(PIPELINE, calibration(jumps, order))


@lru_cache
def samples(count: int = 1200, noise: float = 0.2) -> Sample:
    """A joint that moves."""
    return samples_of(joint(np.arange(count) / RATE, torque_noise=noise))


def some(samples: Sample, first: int, last: int) -> Sample:
    """A stretch of them."""
    return Sample(*(x[first:last] for x in samples))
