"""Still arms must not be believed, moving ones must; every verdict has its reason."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import product

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray

from factories.joints import MULTISINE, TRUTH, joint, sines
from jaximp.identification.estimates import Estimates
from jaximp.jobs.job import parse_job
from jaximp.jobs.run import identify_recording
from jaximp.least_squares.sliding import SlidingFit, sliding_least_squares
from jaximp.models.base import Role
from jaximp.recordings.load import recording_from_arrays
from jaximp.trust.criteria import fake_change_threshold
from jaximp.trust.limits import TrustLimits
from jaximp.trust.verdicts import FAKE, NO_DATA, POOR, TRUSTED, VERDICTS, WEAK
from jaximp.trust.window_rules import RULES, judge_windows, measure_windows

Numbers = NDArray[np.float64]

# ---- The case of NUMERICS.md: the condition number alone does not tell a still arm from a moving one.

TIME = np.arange(6000) / 1000
ONE_FREQUENCY = ((0.2, 1.1, 0.0),)

JOB = """
[recording]
file = "in memory"
[model]
human = {{offset = false}}
[filter]
position_cutoff = 20
position_order = {order}
decimation_cutoff = 20
decimation_order = 2
{decimate}
[window]
length = 0.5
step = 0.01
"""


@cache
def identified(
    lines: tuple[tuple[float, float, float], ...],
    still: bool,
    torque_noise: float = 0.2,
    seed: int = 0,
    decimate: int | None = None,
    position_noise: float = 1e-5,
    order: int = 2,
) -> Estimates:
    moving = ((TIME < 2) | (TIME >= 4)) if still else np.ones(len(TIME), bool)
    noise = {"seed": seed, "torque_noise": torque_noise, "position_noise": position_noise}
    recording = joint(TIME, moving * sines(TIME, lines), **noise, offset_torque=0.0)
    job = parse_job(JOB.format(order=order, decimate="" if decimate is None else f"decimate = {decimate}"))
    return identify_recording(job, recording)[0]


def inside(estimates: Estimates) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Windows wholly in the still stretch, and wholly in motion."""
    start, end = estimates.start, estimates.end
    return (start >= 2 - 1e-9) & (end < 4 - 1e-9), (end < 2 - 1e-9) | (start >= 4 - 1e-9)


def beyond_four_errors(estimates: Estimates) -> NDArray[np.bool_]:
    """Windows whose stiffness is further from the truth than four of its standard errors."""
    theta, stderr = np.asarray(estimates.fit.theta)[:, 2], np.asarray(estimates.fit.stderr)[:, 2]
    return np.abs(theta - TRUTH["stiffness"]) > 4 * stderr


noises = pytest.mark.parametrize(
    "torque_noise",
    [0.2, *(pytest.param(level, marks=pytest.mark.slow) for level in (0.02, 2.0))],
    ids=lambda level: f"torque noise {level:g} N m",
)
seeds = pytest.mark.parametrize("seed", range(2), ids=lambda seed: f"seed {seed}")
decimations = pytest.mark.parametrize("decimate", [None, 1], ids=["decimated", "every sample"])


@noises
@seeds
@decimations
def test_a_still_arm_is_not_believed(torque_noise: float, seed: int, decimate: int | None) -> None:
    estimates = identified(MULTISINE, True, torque_noise, seed, decimate)
    still, _ = inside(estimates)
    trusted = estimates.verdicts.trusted & still
    assert still.sum() > 100
    assert trusted.sum() <= 0.01 * still.sum(), (trusted.sum() / still.sum(), estimates.start[trusted])


@noises
@seeds
@decimations
def test_a_moving_arm_is_believed(torque_noise: float, seed: int, decimate: int | None) -> None:
    estimates = identified(MULTISINE, True, torque_noise, seed, decimate)
    _, motion = inside(estimates)
    assert motion.sum() > 200
    assert estimates.verdicts.trusted[motion].mean() >= 0.95


@pytest.mark.parametrize(
    ("torque_noise", "decimate", "records"),
    [
        (0.2, None, 8),
        *(pytest.param(*one, 24, marks=pytest.mark.slow) for one in [(0.2, 1), *product((0.02, 2.0), (None, 1))]),
    ],
)
def test_what_is_believed_in_motion_is_right(torque_noise: float, decimate: int | None, records: int) -> None:
    # The position's filter of order 2 takes 1 % off the fastest line, and the torque does not pass it: that shows
    # where the noise is small. Order 8 takes nothing. Windows overlap: one record has eight that share no sample, and
    # one of them that is wrong is 5 % of its windows.
    wrong = []
    for seed in range(records):
        estimates = identified(MULTISINE, True, torque_noise, seed, decimate, order=8)
        trusted = estimates.verdicts.trusted & inside(estimates)[1]
        assert trusted.sum() > 200
        wrong += beyond_four_errors(estimates)[trusted].tolist()
    assert np.mean(wrong) <= 0.01


@decimations
def test_a_position_that_is_exactly_zero_while_still_is_not_believed(decimate: int | None) -> None:
    estimates = identified(MULTISINE, True, decimate=decimate, position_noise=0.0)
    still, motion = inside(estimates)
    assert not estimates.verdicts.trusted[still].any(), estimates.start[still & estimates.verdicts.trusted]
    assert estimates.verdicts.trusted[motion].mean() >= 0.95


def test_a_joint_that_never_moves_is_refused() -> None:
    with pytest.raises(ValueError, match="the joint did not move"):
        recording_from_arrays(TIME, np.zeros(len(TIME)), np.random.default_rng(0).normal(size=len(TIME)))


@noises
@decimations
def test_nothing_but_noise_is_not_believed(torque_noise: float, decimate: int | None) -> None:
    estimates = identified(((0.0, 1.0, 0.0),), False, torque_noise, 0, decimate)
    assert estimates.verdicts.trusted.sum() == 0


@noises
@seeds
@decimations
def test_one_frequency_cannot_tell_inertia_from_stiffness(torque_noise: float, seed: int, decimate: int | None) -> None:
    estimates = identified(ONE_FREQUENCY, False, torque_noise, seed, decimate)
    trusted = estimates.verdicts.trusted
    assert trusted.mean() <= 0.01
    if trusted.any():
        assert beyond_four_errors(estimates)[trusted].mean() <= 0.05


@decimations
def test_every_window_that_is_not_trusted_has_a_reason(decimate: int | None) -> None:
    verdicts = identified(MULTISINE, True, decimate=decimate).verdicts
    for verdict, reason in zip(verdicts.verdict, verdicts.reason, strict=True):
        assert verdict in VERDICTS
        assert (reason == "") == (verdict == TRUSTED)
    assert sum(verdicts.counts().values()) == len(verdicts.verdict)
    assert verdicts.counts()[TRUSTED] == verdicts.trusted.sum()


# ---- Which rule comes first.

NAMES = ("inertia", "stiffness")
ROLES = (Role("inertia"), Role("stiffness"))
SAMPLES = 100


@dataclass(frozen=True)
class Window:
    """A window that keeps every rule, unless told otherwise."""

    theta: tuple[float, float] = (0.1, 20.0)
    stderr: tuple[float, float] = (0.001, 0.2)
    excitation: tuple[float, float] = (100.0, 100.0)
    cond: float = 5.0
    vaf: float = 0.99
    samples: int = SAMPLES


def sliding(*windows: Window) -> SlidingFit:
    theta, stderr, excitation, cond, vaf, samples = (
        jnp.asarray([getattr(window, name) for window in windows]) for name in Window.__annotations__
    )
    return SlidingFit(
        theta=theta,
        stderr=stderr,
        dof=samples - 2.0,
        cond=cond,
        sigma_min=1 / cond,
        excitation=excitation,
        residual_rms=0.1 * vaf,
        vaf=vaf,
        samples=samples,
        first=jnp.arange(len(windows)),
        last=jnp.arange(len(windows)),
    )


NAN = (float("nan"), float("nan"))
LOST = {"theta": NAN, "stderr": NAN, "excitation": NAN, "cond": float("nan"), "vaf": float("nan")}
SILENT = {"excitation": (100.0, 0.1)}
LOOSE = {"stderr": (0.001, 9.0)}
ILL = {"cond": 50.0}
BAD = {"vaf": 0.2}
FEW = {"samples": 40}

CASES = [
    pytest.param({}, TRUSTED, "", id="keeps every rule"),
    pytest.param(FEW, NO_DATA, "40 of 100 samples can be used", id="few samples"),
    pytest.param({"samples": 50}, TRUSTED, "", id="half of the samples"),
    pytest.param(LOST, WEAK, "cannot be told apart", id="no solution"),
    pytest.param(SILENT, WEAK, "stiffness: its column is", id="column built by noise"),
    pytest.param(LOOSE, WEAK, "stiffness: its standard error is 45%", id="loose estimate"),
    pytest.param({"stderr": NAN}, WEAK, "standard error", id="no standard error"),
    pytest.param(ILL, FAKE, "condition number 50 is not below the threshold 20", id="ill conditioned"),
    pytest.param({"cond": 20.0}, FAKE, "20 is not below the threshold 20", id="on the threshold"),
    pytest.param({"cond": 19.9}, TRUSTED, "", id="below the threshold"),
    pytest.param(BAD, POOR, "explains 20% of the torque", id="poor fit"),
    pytest.param({"vaf": 0.75}, TRUSTED, "", id="just good enough"),
    pytest.param({"vaf": float("nan")}, POOR, "", id="no VAF"),
    pytest.param(FEW | LOST, NO_DATA, "samples", id="no data before no solution"),
    pytest.param(FEW | SILENT | LOOSE | ILL | BAD, NO_DATA, "samples", id="no data before all"),
    pytest.param(SILENT | LOOSE | ILL | BAD, WEAK, "its column is", id="noise before a loose estimate"),
    pytest.param(LOOSE | ILL | BAD, WEAK, "standard error", id="weak before fake"),
    pytest.param(ILL | BAD, FAKE, "condition", id="fake before poor"),
]


def verdict_of(changes: dict[str, object], threshold: float | None = 20.0, **limits: object) -> tuple[str, str]:
    chosen = TrustLimits(**limits)  # type: ignore[arg-type]
    fit = sliding(Window(), Window(**changes))  # type: ignore[arg-type]
    measured = measure_windows(fit, NAMES, ROLES, SAMPLES, np.zeros(2), np.full(2, 0.1), threshold, chosen)
    verdicts = judge_windows(measured, chosen)
    assert (verdicts.verdict[0], verdicts.reason[0]) == (TRUSTED, "")
    return str(verdicts.verdict[1]), str(verdicts.reason[1])


@pytest.mark.parametrize(("changes", "verdict", "words"), CASES)
def test_the_first_broken_rule_names_the_window(changes: dict[str, object], verdict: str, words: str) -> None:
    found, reason = verdict_of(changes)
    assert found == verdict
    assert words in reason
    assert (reason == "") == (verdict == TRUSTED)


def test_without_a_threshold_no_change_is_fake() -> None:
    assert verdict_of(ILL, threshold=None) == (TRUSTED, "")
    assert verdict_of({"cond": float("inf")}, threshold=None)[0] in (TRUSTED, WEAK)


@pytest.mark.parametrize(
    ("changes", "limits", "verdict"),
    [
        pytest.param(BAD, {"min_vaf": 0.1}, TRUSTED, id="VAF"),
        pytest.param(LOOSE, {"max_relative_stderr": 0.5}, TRUSTED, id="standard error"),
        pytest.param(SILENT, {"min_excitation_ratio": 0.05}, TRUSTED, id="excitation"),
        pytest.param(FEW, {"min_valid_share": 0.3}, TRUSTED, id="valid share"),
        pytest.param(SILENT | LOOSE, {"parameters": ("inertia",)}, TRUSTED, id="the inertia alone matters"),
        pytest.param(SILENT | LOOSE, {"parameters": ("stiffness",)}, WEAK, id="the stiffness alone matters"),
        pytest.param({"samples": 1}, {"min_valid_share": 0.0}, NO_DATA, id="fewer samples than parameters"),
    ],
)
def test_limits_can_be_moved(changes: dict[str, object], limits: dict[str, object], verdict: str) -> None:
    assert verdict_of(changes, **limits)[0] == verdict


def test_a_parameter_near_zero_is_measured_against_what_would_matter() -> None:
    """A damping of zero within a small error is a result, not a weak excitation."""
    fit = sliding(Window(theta=(1e-9, 20.0), stderr=(1e-3, 0.2)))
    for scale, verdict in ((0.0, WEAK), (0.1, TRUSTED)):
        judged = judge_windows(measure_windows(fit, NAMES, ROLES, SAMPLES, np.array([scale, 0.0]), np.zeros(2)))
        assert judged.verdict.tolist() == [verdict]


@pytest.mark.parametrize(("period", "window"), [(4000, 2000), (1000, 1000), (500, 2000)])
def test_fake_change_threshold_is_that_of_eq_16(period: int, window: int) -> None:
    W = np.random.default_rng(0).normal(size=(period, 3)) * np.array([30.0, 3.0, 0.3])
    expected = np.linalg.cond(W) * period / window
    assert float(fake_change_threshold(W, period, window)) == pytest.approx(expected, rel=1e-10)


def test_a_larger_motion_with_its_own_noise_is_no_poor_fit() -> None:
    """The residual grows with the motion, the unexplained share does not: the model is as good as before."""
    random = np.random.default_rng(3)
    loud = 1 + 5 / (1 + np.exp(-10 * (TIME - 3)))
    q = 0.2 * loud * sines(TIME)[0]
    dq, ddq = np.gradient(q, TIME), np.gradient(np.gradient(q, TIME), TIME)
    clean = TRUTH["inertia"] * ddq + TRUTH["damping"] * dq + TRUTH["stiffness"] * q
    torque = clean + 0.02 * loud * np.std(clean[TIME < 3]) * random.normal(size=len(TIME))
    job = parse_job(JOB.format(order=8, decimate=""))
    estimates = identify_recording(job, recording_from_arrays(TIME, q, torque))[0]
    assert estimates.verdicts.trusted.mean() > 0.95


def test_windows_with_hardly_more_samples_than_parameters_are_not_trusted() -> None:
    random = np.random.default_rng(4)
    W = random.normal(size=(200, 3))
    fit = sliding_least_squares(W, W @ [1.0, 2.0, 3.0] + 0.01 * random.normal(size=200), 5)
    others = (Role("other"),) * 3
    verdicts = judge_windows(measure_windows(fit, ("a", "b", "c"), others, 5, np.ones(3), np.zeros(3)))
    assert not verdicts.trusted.any()


def test_nothing_is_trusted_that_was_not_judged() -> None:
    """Who builds estimates gives what was measured; the verdict is no argument."""
    assert not [field.name for field in fields(Estimates) if "verdict" in field.name or "trust" in field.name]
    judged = identified(MULTISINE, False)
    hopeless = replace(judged.limits, min_vaf=1.1)
    assert judged.verdicts.trusted.any()
    assert not replace(judged, limits=hopeless).verdicts.trusted.any()


def test_every_rule_has_a_name_of_its_own_and_a_known_label() -> None:
    assert len({rule.name for rule in RULES}) == len(RULES)
    assert {rule.label for rule in RULES} <= set(VERDICTS) - {TRUSTED}
