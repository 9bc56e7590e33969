"""Recursive estimates: still arms, gaps, changes and coloured noise must not be believed, good records must."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from jaximp.least_squares.recursive import RecursiveFit, recursive_least_squares
from jaximp.models.joint import HumanJoint
from jaximp.trust.limits import TrustLimits
from jaximp.trust.streams import STREAM_RULES, judge_recursive
from jaximp.trust.verdicts import NO_DATA, POOR, TRUSTED, WEAK, Verdicts

Numbers = NDArray[np.float64]

RATE, FORGETTING = 200.0, 0.99
TRUTH = np.array([0.1, 1.5, 40.0, 0.5])
LINES = ((0.05, 1.1), (0.03, 2.7), (0.02, 4.3), (0.01, 6.9))
TIME = np.arange(4000) / RATE
MODEL = HumanJoint(offset=True)


def record(seed: int = 0, still: bool = False, change: float = 1.0) -> tuple[Numbers, Numbers]:
    """Rows and torque of 20 s with 0.2 N m of noise; still between 8 and 16 s, or stiffer from 10 s on."""
    random = np.random.default_rng(seed)
    phase = random.uniform(0, 2 * np.pi, len(LINES))
    q = sum(size * np.sin(2 * np.pi * f * TIME + p) for (size, f), p in zip(LINES, phase, strict=True))
    if still:
        q = q * np.clip(np.maximum(8 - TIME, TIME - 16), 0, 1)
    dq = np.gradient(q, TIME)
    W = np.stack([np.gradient(dq, TIME), dq, q, np.ones_like(q)], axis=1)
    truth = TRUTH * np.where(TIME[:, None] < 10, 1, np.array([1, 1, change, 1]))
    return W, (W * truth).sum(axis=1) + 0.2 * random.normal(size=len(q))


def judged(W: Numbers, y: Numbers, **settings: object) -> tuple[RecursiveFit, Verdicts]:
    fit = recursive_least_squares(W, y, FORGETTING)
    return fit, judge_recursive(fit, MODEL, W, y, FORGETTING, **settings)  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", range(5))
def test_a_good_record_is_trusted_once_the_memory_has_filled(seed: int) -> None:
    _, verdicts = judged(*record(seed))
    assert verdicts.trusted[100:].all(), set(verdicts.reason[100:])
    assert verdicts.verdict[0] == NO_DATA


def test_rest_is_weak_excitation() -> None:
    fit, verdicts = judged(*record(still=True))
    resting, moving = (TIME > 13) & (TIME < 15.9), (TIME > 2) & (TIME < 7)
    assert (verdicts.verdict[resting] == WEAK).all()
    assert np.asarray(fit.held)[resting].all()
    assert verdicts.trusted[moving | (TIME > 17.5)].all()
    assert "motion has been too small for" in verdicts.reason[int(15 * RATE)]


def test_a_gap_longer_than_the_memory_is_no_data() -> None:
    W, y = record()
    y[1000:1500] = np.nan
    fit, verdicts = judged(W, y)
    assert (verdicts.verdict[1110:1500] == NO_DATA).all()
    assert verdicts.trusted[[1050, *range(1500, 4000)]].all()
    np.testing.assert_allclose(fit.theta[1499], fit.theta[999], rtol=1e-12)
    assert "nothing was measured for 400 samples" in verdicts.reason[1399]


def test_after_a_change_it_is_doubtful_until_it_is_forgotten() -> None:
    fit, verdicts = judged(*record(change=1.5))
    step = int(10 * RATE)
    assert verdicts.trusted[[*range(100, step), *range(step + 900, len(TIME))]].all()
    assert (verdicts.verdict[step + 60 : step + 400] == POOR).all()
    assert "stiffness has changed by" in verdicts.reason[step + 60]
    # Before the memory has forgotten, its mixture is far from either value.
    error = np.abs(np.asarray(fit.theta)[:, 2] - 1.5 * TRUTH[2]) / np.asarray(fit.stderr)[:, 2]
    assert error[step + 60] > 4
    assert error[step + 900 :].max() < 5


@pytest.mark.slow
def test_coloured_noise_is_doubtful() -> None:
    W, y = record()
    mean_of_eight = np.ones(8) / 8
    W = np.stack([np.convolve(column, mean_of_eight, "same") for column in W.T], axis=1)
    y = np.convolve(y, mean_of_eight, "same")
    verdicts = judged(W, y)[1]
    assert (verdicts.rule[200:] == "noise that is white").all()
    assert "say as much as one: errors are" in verdicts.reason[-1]
    y[np.arange(len(y)) % 8 > 0] = np.nan
    assert judged(W, y)[1].trusted[1000:].all()


@pytest.mark.slow
def test_columns_that_position_noise_alone_would_build_are_weak() -> None:
    W, y = record()
    size = np.sqrt((W**2).mean(axis=0)) * np.array([1, 1, 1, 0])
    assert judged(W, y, column_noise=size / 20)[1].trusted[200:].mean() > 0.9
    verdicts = judged(W, y, column_noise=size / 2)[1]
    assert (verdicts.rule[200:] == "columns above the position's noise").all()


def test_every_nth_has_the_verdict_of_all() -> None:
    W, y = record(change=1.5)
    fit, verdicts = judged(W, y)
    some = judge_recursive(fit, MODEL, W, y, FORGETTING, every=50)
    # What residuals are usual is that of the samples that are judged.
    np.testing.assert_array_equal(some.verdict, verdicts.verdict[::50])
    assert set(some.verdict) > {TRUSTED, POOR}


def test_without_forgetting_nothing_is_out_of_date() -> None:
    W, y = record()
    fit = recursive_least_squares(W, y)
    assert judge_recursive(fit, MODEL, W, y, 1.0).trusted[100:].all()


@pytest.mark.slow
@pytest.mark.compiles
def test_limits_are_those_of_windows() -> None:
    W, y = record()
    verdicts = judged(W, y, limits=TrustLimits(max_relative_stderr=1e-4))[1]
    assert (verdicts.rule[200:] == "small standard errors").all()
    names = [rule.name for rule in STREAM_RULES]
    assert len(names) == len(set(names))
