"""The verdict on an estimate as it stands now: the rules of windows, and what only a stream can break."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jaximp.identification.judging import against_other_people
from jaximp.identification.pipeline import Pipeline
from jaximp.least_squares.window import SlidingFit
from jaximp.live.calibration import Calibration
from jaximp.live.estimator import Estimate
from jaximp.models.base import Model
from jaximp.trust.limits import TrustLimits
from jaximp.trust.verdicts import POOR, TRUSTED, WEAK, Rule, Verdict
from jaximp.trust.window_rules import RULES, Windows, measure_windows
from jaximp.types import AnyArray, Numbers

WARMING_UP = "warming up"
"""The verdict before there is an estimate."""
CHANCE = 1e-5
"""Probability below which what was not expected is more than noise."""
MORE = 2.0
"""And so many times the variance that was to be expected, at least: noise is never quite that of another stretch."""
PATH, WINDOW = ESTIMATES = ("track", "window")
"""What can be shown: the path with a band, or the window that trails behind."""


@dataclass(frozen=True)
class Stream(Windows):
    """What is measured of an estimate now."""

    surprise: float = 1.0
    """Variance of what was measured and not expected, over that which was to be expected."""
    surprises: float = 0.0
    """How many rows that comes from."""


STREAM_RULES: tuple[Rule[Any], ...] = (
    *RULES,
    Rule(
        "torque as it is expected",
        POOR,
        lambda s, limits: s.surprise > MORE and _improbable(s),
        lambda s, limits: (
            f"the torque differs from what is expected by {np.sqrt(s.surprise):.2g} times its standard deviation"
        ),
        lambda s, limits: "did the joint change just now, or is the noise no longer that of the calibration?",
    ),
)
"""What is measured of one record only has values that break nothing."""


def _improbable(s: Stream) -> bool:
    from scipy.special import gammaincc

    return s.surprises > 0 and bool(gammaincc(s.surprises / 2, s.surprises * s.surprise / 2) < CHANCE)


@dataclass(frozen=True)
class Judged:
    """A verdict, and what the motion says of each parameter."""

    verdict: Verdict
    advice: str
    """Which motion is missing, where the verdict is that one is; else empty."""
    excitation: Numbers
    """(p,) how far each column rises above what noise of the position alone would build, in the trailing window."""


def judge_now(
    pipeline: Pipeline, calibration: Calibration, length: int, estimate: Estimate, which: str, limits: TrustLimits
) -> Judged:
    """The verdict on one estimate.

    **Arguments:** `length` rows of a full window; `which` of `ESTIMATES`.
    """
    model, window = pipeline.model, estimate.window
    path = which == PATH
    theta, stderr = (estimate.theta, estimate.stderr) if path else (window.theta, window.stderr)
    one = np.zeros(1, int)
    fit = SlidingFit(
        theta=_row(theta), stderr=_row(stderr), dof=_row(np.inf if path else window.dof), cond=_row(window.cond),
        sigma_min=_row(window.sigma_min), excitation=_row(window.excitation), residual_rms=_row(window.residual_rms),
        vaf=_row(window.vaf), samples=_row(window.samples), first=one, last=one,
    )  # fmt: skip
    measured = measure_windows(
        fit, model.names, model.roles, length, calibration.parameter_scale, calibration.column_noise, None, limits
    )
    # Whether the motion tells all parameters is what the window knows; a path always has some numbers.
    measured = replace(measured, determined=np.isfinite(_row(window.theta)).all(axis=1), tested=path)
    measured = against_other_people(measured, model, fit, limits)
    stream = Stream(
        **vars(measured),
        surprise=float(np.nan_to_num(estimate.surprise, nan=1.0)) if path else 1.0,
        surprises=float(estimate.surprises),
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        by_noise = np.sqrt(float(window.samples)) * calibration.column_noise
        excitation = np.where(by_noise > 0, np.asarray(window.excitation) / by_noise, np.inf)
    verdict = _verdict(stream, limits)
    least = next((name for name in model.names if verdict.reason.startswith(f"{name}:")), model.names[0])
    advice = _motion_for(model, least) if verdict.label == WEAK else ""
    return Judged(verdict, advice, np.nan_to_num(excitation, nan=0.0, posinf=np.inf))


MOTION_FOR = (
    ("ddq", "accelerate more: turn round faster"),
    ("sign(dq)", "move both ways, and faster than standstill"),
    ("dq", "move faster"),
    ("1", "hold other positions, or for longer"),
    ("", "move farther"),
)
"""What to do for a parameter, by the column of the model that tells it: the first that fits."""


def _motion_for(model: Model, name: str) -> str:
    column = model.columns[model.names.index(name)] if name in model.names else ""
    return next(words for start, words in MOTION_FOR if column.startswith(start))


def _verdict(stream: Stream, limits: TrustLimits) -> Verdict:
    """The first rule that is broken, of an estimate that stands alone in its arrays."""
    for rule in STREAM_RULES:
        if np.any(rule.broken(stream, limits)):
            one = stream.one(0)
            assert isinstance(one, Stream)
            return Verdict(rule.label, rule.reason(one, limits), rule.remedy(one, limits))
    return Verdict(TRUSTED, "", "")


def _row(value: AnyArray) -> AnyArray:
    return np.asarray(value)[None]
