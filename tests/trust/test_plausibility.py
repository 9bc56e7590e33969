"""What no human joint can have is not trusted, and the question that is asked fits the mistake."""

from __future__ import annotations

import numpy as np
import pytest

from jaximp.identification import Estimates, Pipeline, WindowSettings, estimate
from jaximp.identification.filter_settings import FilterSettings
from jaximp.jobs import parse_job
from jaximp.models import HumanJoint
from jaximp.recordings import recording_from_arrays
from jaximp.trust import TrustLimits
from jaximp.trust.plausibility import JOINTS, OTHER, WIDEST, question, ranges_of, times_outside
from jaximp.types import Recording

ANKLE = np.array([0.015, 0.7, 60.0])


@pytest.mark.parametrize(
    ("factors", "asked"),
    [
        (np.full(3, np.pi / 180), "is the angle in degrees"),
        (np.full(3, 1000.0), "is the torque in N mm"),
        (np.full(3, 100.0), "is the torque in N cm"),
        (np.full(3, 1 / 50.0**2), "is a gear of"),
        (np.full(3, 40.0**2), "was a gear_ratio given"),
        (np.array([1e6, 1e3, 1.0]), "does the clock run"),
        (np.array([0.25, 0.5, 1.0]), "times too fast"),
    ],
)
def test_the_question_fits_the_mistake(factors: np.ndarray, asked: str) -> None:
    theta = ANKLE * factors
    assert (times_outside(theta, 0.01 * theta, JOINTS["ankle"], 2.0) != 1).any()
    assert asked in question(theta, JOINTS["ankle"])


def test_a_value_outside_only_by_its_error_is_inside() -> None:
    theta = np.array([0.065, 0.7, 60.0])
    assert (times_outside(theta, 0.01 * theta, JOINTS["ankle"], 2.0) > 1).tolist() == [True, False, False]
    assert (times_outside(theta, 0.05 * theta, JOINTS["ankle"], 2.0) == 1).all()
    below = times_outside(-theta, 0.01 * theta, JOINTS["ankle"], 2.0)
    assert (below < 1).all()


def test_every_joint_is_within_the_widest() -> None:
    for ranges in JOINTS.values():
        for (low, high), (lowest, highest) in zip(ranges.bounds, WIDEST.bounds, strict=True):
            assert lowest <= low < high <= highest
    assert ranges_of(OTHER) is None
    with pytest.raises(ValueError, match="did you mean 'ankle'"):
        ranges_of("ankel")


def joint(factor: float) -> Recording:
    t, random = np.arange(0, 10, 0.002), np.random.default_rng(0)
    q = 0.1 * np.sin(5.65 * t) + 0.06 * np.sin(14.5 * t + 0.5) + 0.03 * np.sin(25.8 * t + 1.1)
    dq = np.gradient(q, t)
    torque = 0.015 * np.gradient(dq, t) + 0.7 * dq + 60 * q + 0.05 * random.normal(size=len(t))
    return recording_from_arrays(t, factor * q + 1e-5 * random.normal(size=len(t)), torque)


@pytest.mark.slow
@pytest.mark.compiles
def test_windows_are_judged_by_the_joint_that_is_named() -> None:
    in_degrees = joint(180 / np.pi)

    def found(name: str | None) -> Estimates:
        settings = FilterSettings(position_cutoff=30, decimation_cutoff=15)
        pipeline = Pipeline(500.0, HumanJoint(), WindowSettings(2.0, 1.0), settings, TrustLimits(joint_name=name))
        return estimate(pipeline, in_degrees)[0]

    ankle = found("ankle")
    assert not ankle.trusted.any()
    assert "times too small for the ankle" in ankle.verdicts.reason[0]
    assert "is the angle in degrees" in ankle.verdicts.reason[0]
    assert found(OTHER).trusted.all()
    nobody = found(None)
    assert any("the impedance is that of" in note and "ankle" not in note for note in nobody.notes)


JOB = """
[recording]
file = "a.csv"
time = "t"
position = "q"
torque = "tau"
[model]
human = { joint_name = "ankle" }
[window]
length = 2
"""


def test_a_job_names_the_joint() -> None:
    pipeline = parse_job(JOB).pipeline(("revolute",), 500.0)
    assert pipeline.limits.joint_name == "ankle"
    with pytest.raises(ValueError, match="joint_name is 'foot'"):
        parse_job(JOB.replace("ankle", "foot"))
    two = parse_job(JOB.replace('"ankle"', '["ankle", "knee"]'))
    assert two.pipeline(("revolute", "revolute"), 500.0).limits.of_joint(1).joint_name == "knee"
    with pytest.raises(ValueError, match="joint_name lists 2 joints, but the recording has 1"):
        two.pipeline(("revolute",), 500.0)
