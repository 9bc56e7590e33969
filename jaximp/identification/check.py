"""A look at the data before a run: what was recorded, what is wrong with it, and which filters and window suit it."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from jaximp import signals
from jaximp.identification.delays import UNKNOWN, find_delay
from jaximp.identification.estimates import Estimates
from jaximp.identification.identify import estimate, robot_sameness
from jaximp.identification.judging import jump_note
from jaximp.identification.pipeline import NOISE, Pipeline
from jaximp.identification.prepared import columns_by_joint, prepare
from jaximp.identification.robot_changes import NOT_ASKED
from jaximp.identification.rows import jumped, once
from jaximp.models.base import combine
from jaximp.trust.limits import TrustLimits
from jaximp.trust.score_tests import FAMILYWISE
from jaximp.trust.verdicts import NO_DATA, WEAK
from jaximp.trust.window_rules import POSITIVE_INERTIA, is_chain
from jaximp.types import Progress, Recording, RobotAlone

GOOD, LOOK, BAD = "ok", "look", "bad"
FEWEST = 100
"""Samples that spectra can be made of."""
SLOWEST = 20.0
"""A joint's impedance cannot be seen below this sample rate [Hz]."""
WIDEST = 2 * np.pi
"""No human joint turns further than this [rad]."""
MOST_GLITCHES = 1e-3
"""A share of the samples beyond which the recorder should be looked at."""
MOST_NAMED = 5
"""Parameters that are named."""
LONGEST_WINDOW = 5.0
"""In which the noise is looked for before a window is chosen [s]."""


@dataclass(frozen=True)
class Finding:
    """One thing that was checked."""

    topic: str
    verdict: str
    """`ok`, `look` (may matter) or `bad` (will spoil the estimates)."""
    text: str


@dataclass(frozen=True)
class Proposal:
    """Settings that suit the recording, for a job file."""

    position_cutoff: float
    """[Hz]"""
    decimation_cutoff: float
    """[Hz]"""
    window: float | None
    """[s]; None where no length that was tried excites the model, and for a robot from its URDF, whose window is the
    whole recording."""
    why: str


def check_recording(
    pipeline: Pipeline, recording: Recording, alone: RobotAlone = None, progress: Progress = lambda share: None
) -> tuple[list[Finding], Proposal]:
    """Check a recording for the model of a pipeline, and propose cut-offs and a window."""
    if len(recording) < FEWEST:
        raise ValueError(f"the recording has {len(recording)} samples: at least {FEWEST} are needed to check it")
    findings = [_sampling(recording), _gaps(recording)]
    for channel, values in (("position", recording.position), ("torque", recording.torque)):
        for joint in range(recording.n_joints):
            label = channel if recording.n_joints == 1 else f"{channel} {joint + 1}"
            column = values[:, joint]
            findings += [*_faults(recording, label, pipeline.limits), _resolution(label, column)]
            if channel == "position":
                findings += [_saturation(label, column), *_range(label, recording.joints[joint], column)]
    progress(0.1)
    bandwidth = coherent_bandwidth(recording)
    findings.append(
        Finding(
            "bandwidth",
            GOOD,
            f"position and torque belong together (coherence above 0.8, or slow motion) up to {bandwidth:.3g} Hz",
        )
    )
    found, proposal = propose(pipeline, recording, alone, progress)
    return [*findings, *found], proposal


def propose(
    pipeline: Pipeline,
    recording: Recording,
    alone: RobotAlone = None,
    progress: Progress = lambda share: None,
    filters: bool = True,
    windows: bool = True,
) -> tuple[list[Finding], Proposal]:
    """Cut-offs and a window that suit a recording, and what was found with them.

    **Arguments:** whether `filters` are wanted, or those of the pipeline stay; whether `windows` are tried.
    """
    cutoffs = _cutoffs(coherent_bandwidth(recording), recording)
    given = pipeline.filter
    if filters:
        given = replace(given, position_cutoff=cutoffs[0], decimation_cutoff=cutoffs[1], decimate=None)
    pipeline = replace(pipeline, filter=given, track=None)  # windows of several lengths are tried
    why = "decimation_cutoff (low-pass of torque and regressor) at the bandwidth, position_cutoff at twice that"
    if not windows:
        return [], Proposal(*cutoffs, None, why)
    if is_chain(pipeline.model.roles):  # such a robot is identified from the whole recording
        progress(0.3)
        return [_whole(pipeline, recording)], Proposal(*cutoffs, None, why)
    findings = [_delay(pipeline, recording), *_robot(pipeline, recording, alone)]
    progress(0.3)
    window, of_windows = _window(pipeline, recording, alone, progress)
    why += "; the window that predicts the next one best: a longer one is more precise, a shorter one follows changes"
    return [*findings, *of_windows], Proposal(*cutoffs, window, f"{why} sooner")


def coherent_bandwidth(recording: Recording) -> float:
    """Frequency [Hz] up to which some joint's position and torque share four fifths of their variance.

    At least five times the frequency below which 95 % of the position's power lies: a motion of a few lines is coherent
    at those alone.
    """
    from scipy.signal import coherence, welch

    q, torque = (signals.fill_gaps(x, recording.valid) for x in (recording.position, recording.torque))
    rate = recording.sample_rate
    n = int(min(len(recording) // 4, max(256, 8 * rate)))
    frequency, shared = coherence(np.diff(q, axis=0), torque[1:], fs=rate, nperseg=n, axis=0)
    smooth = np.convolve(np.nan_to_num(shared).max(axis=1), np.ones(5) / 5, mode="same")
    together = smooth[1:] > 0.8
    # Only the first stretch counts: hum far above the motion is coherent as well.
    first = int(np.argmax(together))
    length = int(np.argmin(np.r_[together[first:], False]))
    power = np.cumsum(welch(q, fs=rate, nperseg=n, axis=0)[1].sum(axis=1))
    slow = frequency[int(np.searchsorted(power, 0.95 * power[-1]))]
    return float(max(frequency[max(1, first + length)], 5 * slow))


def _sampling(recording: Recording) -> Finding:
    text = f"{len(recording)} samples at {recording.sample_rate:.6g} Hz, {len(recording) / recording.sample_rate:.4g} s"
    if recording.sample_rate < SLOWEST:
        return Finding("sampling", BAD, f"{text}: too slow for a joint; is the time's unit right (ms?)")
    said = {fault.text for fault in recording.faults}
    notes = [note for note in recording.notes if note not in said]
    return Finding("sampling", LOOK if notes else GOOD, "; ".join([text, *notes]))


def _range(label: str, joint: str, x: NDArray[np.float64]) -> list[Finding]:
    """A joint that turns around several times was probably written down in degrees."""
    span = float(np.nanmax(x) - np.nanmin(x))
    if joint != "revolute" or span < WIDEST:
        return []
    return [Finding(f"{label}: range", LOOK, f"{span:.3g} rad: is it the motor's angle, or should unit be 'deg'?")]


def _gaps(recording: Recording) -> Finding:
    missing = 1 - recording.valid.mean()
    text = [f"{missing:.2%} of the samples are missing" if missing else "none", jump_note(recording, jumped(recording))]
    verdict = BAD if missing > 0.05 else LOOK if missing or text[1] else GOOD
    return Finding("gaps", verdict, "; ".join(filter(None, text)))


def _faults(recording: Recording, label: str, limits: TrustLimits) -> list[Finding]:
    """What was masked of the raw samples of a column, in the words of the recording's notes."""
    found = {one.kind: one for one in recording.faults if one.label == label}
    kinds = ["glitches", "held samples", *(["saturation"] if label.startswith("torque") else [])]
    findings = []
    for kind in kinds:
        if kind in found:
            most = limits.max_at_limit if kind == "saturation" else MOST_GLITCHES
            bad = kind != "held samples" and found[kind].share > most
            text = found[kind].text.removeprefix(f"{label}: ")
            findings.append(Finding(f"{label}: {kind}", BAD if bad else LOOK, text))
        elif kind != "held samples":
            findings.append(Finding(f"{label}: {kind}", GOOD, "none seen"))
    return findings


def _saturation(label: str, x: NDArray[np.float64]) -> Finding:
    """A signal that stays at its extreme much longer than just beside it has probably hit a limit."""
    x = x[np.isfinite(x)]
    beside = max(4 * signals.quantisation_step(x), 1e-3 * np.ptp(x))
    for extreme in (x.min(), x.max()):
        at = _longest_run(x == extreme)
        # A smooth turning point of a coarse encoder spends as long again on the steps beside its extreme.
        near = _longest_run(np.abs(x - extreme) <= beside)
        if at >= 5 and near < 1.5 * at:
            text = f"{at} samples in a row at {extreme:.4g}, the end of the range: was a limit hit?"
            return Finding(f"{label}: saturation", LOOK, text)
    return Finding(f"{label}: saturation", GOOD, "none seen")


def _longest_run(mask: NDArray[np.bool_]) -> int:
    edges = np.flatnonzero(np.diff(np.r_[0, mask.astype(int), 0]))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def _resolution(label: str, x: NDArray[np.float64]) -> Finding:
    """Step of the encoder or converter, and noise, against the signal's range."""
    noise, step, span = signals.noise_level(x), signals.quantisation_step(x), float(np.nanmax(x) - np.nanmin(x))
    text = f"noise {noise:.2g} ({noise / span:.1e} of the range)"
    text += f", step {step:.4g}" if step else ", no step visible"
    return Finding(f"{label}: noise", LOOK if noise > 0.05 * span else GOOD, text)


def _cutoffs(bandwidth: float, recording: Recording) -> tuple[float, float]:
    """Position and parallel cut-off [Hz], two digits, below a quarter and an eighth of the sample rate."""
    decimation = min(bandwidth, recording.sample_rate / 8)
    position = min(2 * decimation, recording.sample_rate / 4)
    return float(f"{position:.2g}"), float(f"{decimation:.2g}")


def _delay(pipeline: Pipeline, recording: Recording) -> Finding:
    """Of the torque behind the position; of several joints the one that is surest."""
    found = []
    with suppress(ValueError):  # which says why no window can be tried either
        model = pipeline.model if pipeline.robot is None else combine(pipeline.robot, pipeline.model)
        window = replace(pipeline.window, length=min(pipeline.window.length, LONGEST_WINDOW), noise=NOISE[0])
        own = replace(once(pipeline), model=model, robot=None, window=window)
        prepared = prepare(own, recording)
        for place in columns_by_joint(model):
            rows = prepared.rows if place is None else prepared.rows.of_joint(*place)
            if rows.torque.ndim == 1:
                found.append(find_delay(own, rows))
    best = max(found, key=lambda one: abs(one.seconds) / one.stderr, default=UNKNOWN)
    if not np.isfinite(best.stderr):
        return Finding("delay", GOOD, "the data do not determine a delay between torque and position")
    text = f"the model fits best if the torque {best.in_words()}"
    if not best.certain or abs(best.seconds) < 0.5 / recording.sample_rate:
        return Finding("delay", GOOD, text)
    remedy = f"if the recorder did this, write delay = {best.seconds:.3g} into the torque's table; a cuff looks alike"
    return Finding("delay", LOOK, f"{text} ({best.seconds * recording.sample_rate:.1f} samples): {remedy}")


def _robot(pipeline: Pipeline, recording: Recording, alone: RobotAlone) -> list[Finding]:
    """Whether it is the same in all recordings of a pair."""
    if pipeline.robot is None or alone is None:
        return []
    with suppress(ValueError):  # the windows say why nothing can be tried
        window = replace(pipeline.window, length=min(pipeline.window.length, LONGEST_WINDOW), noise=NOISE[0])
        prepared = prepare(replace(once(pipeline), window=window), recording, alone)
        assert prepared.pair is not None
        same, notes = robot_sameness(prepared, prepared.pair), prepared.pair.notes
        changed = same is not None and same.differs
        said = [same.in_words()] if same is not None else []
        verdict = BAD if changed else LOOK if notes == (NOT_ASKED,) or prepared.pair.agree < FAMILYWISE else GOOD
        return [Finding("robot", verdict, "; ".join([*said, *notes]))]
    return []


def _whole(pipeline: Pipeline, recording: Recording) -> Finding:
    """Which parameters of a robot from its URDF the recording determines, as one window."""
    duration = len(recording) / recording.sample_rate
    try:
        found = estimate(pipeline.with_window(duration, duration), recording)[0]
    except ValueError as error:
        return Finding("excitation", BAD, f"the robot cannot be identified: {error}")
    names, residuals = found.names, found.residuals
    if found.verdicts.verdict[0] == NO_DATA or not np.isfinite(found.value).all():
        return Finding("excitation", BAD, f"nothing is determined: {found.verdicts.reason[0]}")
    loose = found.undetermined()
    left = "" if residuals is None else f", and leaves {residuals.total:.2%} of the torque unexplained"
    text = f"the recording determines {len(names) - len(loose)} of {len(names)} parameters{left}"
    if not loose:
        return Finding("excitation", GOOD, text)
    worst = sorted(loose, key=lambda name: -loose[name])
    more = f" and {len(worst) - MOST_NAMED} more" if len(worst) > MOST_NAMED else ""
    return Finding("excitation", LOOK, f"{text}; not determined: {', '.join(worst[:MOST_NAMED])}{more}")


def _window(
    pipeline: Pipeline, recording: Recording, alone: RobotAlone, progress: Progress
) -> tuple[float | None, list[Finding]]:
    """Of a few lengths in which nine windows of ten are excited, the one that predicts the next window best."""
    duration = len(recording) / recording.sample_rate
    tried = [length for length in (0.5, 1.0, 2.0, 5.0, 10.0) if length <= duration / 3]
    seen, good, signs = [], {}, list[bool]()
    for count, length in enumerate(tried):
        estimates = _trial(pipeline, recording, alone, length)
        progress(0.3 + 0.7 * (count + 1) / len(tried))
        if estimates is None:
            continue
        verdict = estimates.verdicts.verdict
        with_data = verdict != NO_DATA
        share = float((verdict[with_data] != WEAK).mean()) if with_data.any() else 0.0
        signs += (estimates.verdicts.rule[with_data] == POSITIVE_INERTIA).tolist()
        seen.append(f"{length:g} s {share:.0%}")
        predicted = estimates.held_out_vaf[with_data & np.isfinite(estimates.held_out_vaf)]
        if share >= 0.9 and len(predicted):
            good[length] = float(np.mean(predicted))
    return max(good, key=lambda length: good[length], default=None), [
        _excitation(seen, good),
        *([_sign()] if signs and np.mean(signs) > 0.5 else []),
    ]


def _trial(pipeline: Pipeline, recording: Recording, alone: RobotAlone, length: float) -> Estimates | None:
    """Estimates with windows of one length; None where it cannot be tried."""
    step = max(length / 10, len(recording) / recording.sample_rate / 200)
    trial = replace(pipeline.with_window(length, step), methods=pipeline.methods[:1])
    with suppress(ValueError):
        return estimate(trial, recording, alone)[0]
    return None


def _excitation(seen: list[str], good: dict[float, float]) -> Finding:
    if good:
        held_out = ", ".join(f"{length:g} s {f'{vaf:.0%}' if vaf > 0 else 'none'}" for length, vaf in good.items())
        return Finding("excitation", GOOD, f"variance explained in the next, unseen window: {held_out}")
    text = "windows that are excited: " + (", ".join(seen) if seen else "none could be tried")
    return Finding("excitation", BAD, f"{text}: the motion does not excite this model, or the model is too large")


def _sign() -> Finding:
    return Finding("torque: sign", BAD, "the inertia comes out negative: set sign = -1 for the torque")
