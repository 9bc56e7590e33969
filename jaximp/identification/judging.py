"""Estimates of the windows of a fit: what is measured of them, what the tests say of the model, what is shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaximp.identification.common_errors import with_common_errors
from jaximp.identification.comparisons import by_frequency, changes, gain_in_words
from jaximp.identification.corrections import corrected
from jaximp.identification.delays import find_delay
from jaximp.identification.estimates import Estimates, Reflex
from jaximp.identification.instruments import MOVED, REMEDY, Drive, belongs_with_later_motion, in_windows_of
from jaximp.identification.misfit import (
    Known,
    by_bands,
    harmless,
    in_words,
    is_delay,
    missing,
    off_by,
    open_moves,
    sizes,
    unnoticed,
)
from jaximp.identification.pipeline import FREELY, Pipeline
from jaximp.identification.points import (
    SURELY,
    Followed,
    courses,
    points_of_path,
    points_of_windows,
    windows_apart,
)
from jaximp.identification.prepared import Prepared, has_instruments
from jaximp.identification.robot_changes import NO_DOUBTS, Doubts
from jaximp.identification.rows import Rows
from jaximp.identification.solving import Placement, Solved
from jaximp.identification.suspects import DRIVE
from jaximp.least_squares.sliding import score
from jaximp.least_squares.window import SlidingFit
from jaximp.models.base import Model
from jaximp.models.chain import Chain
from jaximp.models.determined import sizes_of_chain
from jaximp.models.joint import HumanJoint
from jaximp.models.reflex import pathway_of
from jaximp.tracking.results import Track
from jaximp.trust import plausibility
from jaximp.trust.changes import Course
from jaximp.trust.criteria import fake_change_threshold
from jaximp.trust.limits import TrustLimits
from jaximp.trust.score_tests import Bands, Misfit, compare_bands, significant
from jaximp.trust.window_rules import (
    MASSES,
    Windows,
    excited_windows,
    is_chain,
    judge_together,
    judge_windows,
    judged_names,
    measure_windows,
)
from jaximp.types import Numbers, Recording, listed

CLEAR = 2.0
"""A reflex whose gain is so many standard errors from zero has a delay."""


def judge(
    prepared: Prepared,
    rows: Rows,
    solved: Solved,
    place: Placement,
    method: int | None = None,
    *notes: str,
    gain: SlidingFit | None = None,
    curves: bool = True,
    misfits: tuple[Misfit, ...] = (),
    doubts: Doubts = NO_DOUBTS,
    followed: Followed | None = None,
) -> Estimates:
    """Measure all that the rules look at; `Estimates.verdicts` applies them. `gain`: the fit that `with_gain` makes;
    `doubts` beside what the model lacks; `followed`, a path whose points stand in place of the windows."""
    pipeline, model = prepared.pipeline, prepared.model
    solved = solved._replace(fit=_judged_by_the_human(pipeline, rows, solved.fit, place, method))
    fit, starts = _corrected(prepared, rows, solved.fit, place, followed is None), place.starts[: len(solved.fit.last)]
    threshold, why_not = (None, "") if followed is not None else _threshold(prepared, place, method)
    reflexes = () if gain is None else (_reflex(model, fit, gain),)
    weights = {model.names[k] for reflex in reflexes for k in reflex.columns}
    limits = _limits(pipeline, weights)
    judged = judged_names(model, limits)
    of_model = _OfModel.of(model, solved, misfits, place, judged, pipeline.ordinary, weights)
    of_model = of_model.with_drive(prepared.drive, model.names, judged, fit, place)
    of_model = of_model.with_gain(gain_in_words(model, fit, windows_apart(place)), judged)
    of_model = of_model.with_doubts(doubts, judged)
    sure, fit = fit, with_common_errors(prepared, rows, _with_open_moves(fit, of_model.moves), place)
    if followed is None:
        points = points_of_windows(rows, fit, solved, place, curves)
    else:
        moved = np.asarray(sure.theta) - np.asarray(solved.fit.theta)
        points = points_of_path(rows, fit, moved, solved, place, followed, curves)
    fit, apart = points.fit, points.apart
    full, scale = place.counted * model.n_joints, solved.moments.parameter_scale
    measure = partial(measure_windows, fit, model.names, model.roles, full, scale, prepared.column_noise, threshold)
    measured, doubted = measure(limits), {}
    at_limit = _share_at_limit(prepared.recording, rows.time[starts], rows.time[starts + place.window - 1])
    at_limit = np.broadcast_to(at_limit, starts.shape)[points.window]
    measured = replace(measured, tested=bool(misfits), missing=of_model.why, remedy=of_model.remedy, at_limit=at_limit)
    measured = against_other_people(measured, model, fit, limits)
    if is_chain(model.roles):
        each = {name: measure(replace(limits, parameters=(name,))) for name in model.names}
        each = {
            name: replace(one, tested=bool(misfits), missing=of_model.lacking.get(name, ""))
            for name, one in each.items()
        }
        doubted = {name: judge_windows(one, limits).reason for name, one in each.items()}
    # Points of a path are no independent estimates: they do not speak together of a mass below zero.
    together = model.roles if followed is None else ()
    measured = judge_together(measured, fit, together, points.held_out, apart, limits)
    torque = np.where(np.asarray(rows.valid), np.asarray(rows.torque), np.nan)[points.shown]
    torque = torque.reshape(points.reconstructed.shape)
    start, end = rows.time[np.asarray(fit.first)], rows.time[np.asarray(fit.last)]
    about = (
        jump_note(prepared.recording, prepared.jumps),
        _literal_note(pipeline),
        why_not,
        _likeness(measured, limits),
        *(model.notes if isinstance(model, Chain) else ()),
        *of_model.notes,
        _delay(prepared, rows, misfits),
        *notes,
        _drive_note(prepared, misfits, np.asarray(solved.fit.theta)),
    )
    if followed is not None:
        changed, steady = courses(points.tracks[0], judge_windows(measured, limits).trusted)
        notes = (*notes, _moving_mass(model, points.tracks[0]))
    else:
        side_by_side = apart * np.flatnonzero(excited_windows(measured, limits)[::apart])
        changed, steady = changes(pipeline, sure, side_by_side, start, end)
    estimates = Estimates(
        model=model,
        names=model.names,
        units=model.units,
        window=pipeline.window.length,
        start=start,
        end=end,
        fit=fit,
        held_out_vaf=points.held_out,
        measured=(measured,),
        limits=pipeline.limits,
        threshold=threshold,
        time=rows.time[points.shown],
        torque=torque,
        reconstructed=points.reconstructed,
        predicted=points.predicted,
        notes=(
            *prepared.recording.notes,
            *filter(None, about),
            *_changes_in_words(pipeline, changed, followed is not None),
        ),
        changed=changed,
        steady=steady,
        reflexes=reflexes,
        misfits=misfits,
        bands=of_model.bands,
        frequencies=by_frequency(pipeline, rows, prepared.white) if misfits and curves else (),
        noise=_noise_spectra(prepared, torque - points.reconstructed) if curves else (),
        lacking={name: text for name, text in of_model.lacking.items() if name not in weights},
        doubted=doubted,
        tracks=points.tracks,
    )
    of_reflexes = tuple(_reflex_note(reflex, estimates.verdicts.trusted) for reflex in reflexes)
    return replace(estimates, notes=estimates.notes + of_reflexes) if of_reflexes else estimates


def _judged_by_the_human(
    pipeline: Pipeline, rows: Rows, fit: SlidingFit, place: Placement, method: int | None
) -> SlidingFit:
    """Methods 2 and 4 solve for more than the human, and white rows are other rows: the human's torque judges all."""
    if method is None or not (method in (2, 4) or pipeline.whitens):
        return fit
    starts, valid = place.starts[: len(fit.last)], jnp.asarray(rows.valid)
    seen = score(rows.W, rows.torque, valid, fit.theta, starts, place.window, place.step, place.given_room)
    quality = (seen.vaf, seen.residual_rms, seen.samples)
    return eqx.tree_at(lambda f: (f.vaf, f.residual_rms, f.samples), fit, quality)


def _corrected(prepared: Prepared, rows: Rows, fit: SlidingFit, place: Placement, changing: bool) -> SlidingFit:
    """Where the torque's noise is estimated: without what noise of the position, own motion of a free joint and change
    inside windows do; that not, where they are not `changing` (a path has no windows)."""
    if len(prepared.white) != 1:
        return fit
    solved = (prepared.weighted or rows) if prepared.pipeline.ordinary else prepared.white[0]
    drive = prepared.drive
    if drive is not None and drive.W is not None:
        both = np.concatenate([drive.W, np.asarray(drive.torque)[:, None]], axis=1)
        both = both if prepared.pipeline.ordinary else prepared.white[0].apply(both, rows.valid)
        given = (both[:, :-1], both[:, -1], np.asarray(solved.W), np.asarray(solved.torque))
        fit = in_windows_of(fit, *given, np.asarray(rows.valid))
    return corrected(fit, solved.W, solved.noisy, rows.valid, windows_apart(place) if changing else None)


def _with_open_moves(fit: SlidingFit, moves: Numbers) -> SlidingFit:
    """With standard errors that hold what cannot be excluded; it is the same in all windows, and no sign of change."""
    if not moves.any():
        return fit
    return eqx.tree_at(lambda f: f.stderr, fit, jnp.sqrt(jnp.asarray(fit.stderr) ** 2 + moves**2))


def against_other_people(measured: Windows, model: Model, fit: SlidingFit, limits: TrustLimits) -> Windows:
    """With what a human joint can have; nothing is known of anything else."""
    ranges = plausibility.ranges_of(limits.one_joint_name)
    if ranges is None or not isinstance(model, HumanJoint) or model.units[2] != plausibility.UNITS[2]:
        return measured
    which = [model.names.index(name) for name in plausibility.PARAMETERS]
    factor = np.ones(3) if model.gear_ratio == 1 else np.asarray(model.at_joint(np.ones(len(model.names))))[which]
    theta, stderr = (np.asarray(x)[:, which] * factor for x in (fit.theta, fit.stderr))
    outside = plausibility.times_outside(theta, stderr, ranges, limits.errors_apart)
    return replace(measured, impedance=theta, outside=outside)


def _moving_mass(model: Model, track: Track) -> str:
    """What a mass that moves says of the model; empty where none does."""
    moving = [
        name
        for name, role in zip(model.names, model.roles, strict=True)
        if role in MASSES and track.moves(name) > SURELY
    ]
    if not moving:
        return ""
    return (
        f"{listed(moving)} moves, as no mass does by itself: the model lacks something, or the gain of a sensor "
        "changes; a limb's is known to stay (track.stays)"
    )


def _changes_in_words(pipeline: Pipeline, changed: Mapping[str, Course], of_path: bool) -> list[str]:
    if of_path:
        return [f"{name} moves: {how}" for name, how in changed.items()]
    doubt = "" if pipeline.whitens else "; or its errors are too small, since the noise was taken as white"
    return [f"{name} is not the same in all windows: {when}{doubt}" for name, when in changed.items()]


def _delay(prepared: Prepared, rows: Rows, misfits: tuple[Misfit, ...]) -> str:
    """How long a delay of one joint is, if that is what the model lacks."""
    if (
        len(prepared.white) != 1
        or prepared.model.n_joints > 1
        or not any(is_delay(one.group) for one in significant(misfits))
    ):
        return ""
    found = find_delay(prepared.pipeline, rows)
    if not found.certain:
        return ""
    return (
        f"if what is missing is a delay, the torque {found.in_words()}: delay = {found.seconds:.3g} in the torque's "
        "table of [recording] takes it out; nothing was moved"
    )


def _likeness(measured: Windows, limits: TrustLimits) -> str:
    """Which joints it could be, where nobody said."""
    if limits.joint_name is not None or measured.impedance is None or not measured.determined.any():
        return ""
    return plausibility.likeness(np.median(measured.impedance[measured.determined], axis=0))


def _share_at_limit(recording: Recording, start: Numbers, end: Numbers) -> Numbers | float:
    """(M,) of the samples of windows from `start` to `end` (M,) [s]."""
    if recording.clipped is None:
        return 0.0
    before = np.cumsum(np.r_[0, recording.clipped])
    first, last = np.searchsorted(recording.time, start), np.searchsorted(recording.time, end, side="right")
    return np.asarray((before[last] - before[first]) / np.maximum(last - first, 1))


def _limits(pipeline: Pipeline, weights: set[str]) -> TrustLimits:
    """Weights of neighbouring lags are uncertain one by one, and nobody asks for them one by one."""
    limits, model = pipeline.limits, pipeline.model
    if not weights or limits.parameters:
        return limits
    kept = [name for name, role in zip(model.names, model.roles, strict=True) if role.kind != "offset"]
    return replace(limits, parameters=tuple(name for name in kept if name not in weights))


def _noise_spectra(prepared: Prepared, left: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Of the noise that was estimated, by what the estimates leave (N, n) of the torque."""
    if not prepared.white:
        return ()
    row_rate = prepared.pipeline.sample_rate / prepared.pipeline.filters.decimate
    return (prepared.white[0].noise_spectrum(row_rate, left),)


@dataclass(frozen=True)
class _OfModel:
    """What the tests say of the model."""

    why: str
    """Why parameters that are judged cannot be trusted."""
    remedy: str
    lacking: dict[str, str]
    """Why each parameter cannot be trusted."""
    bands: Bands | None
    moves: Numbers
    """(p,) by how much parameters that stay trusted may be off, in every window alike."""
    notes: tuple[str, ...]

    @classmethod
    def of(
        cls,
        model: Model,
        solved: Solved,
        misfits: tuple[Misfit, ...],
        place: Placement,
        judged: Sequence[str],
        ordinary: bool,
        weights: set[str],
    ) -> _OfModel:
        """**Arguments:** whether the estimates are `ordinary`, and the others beside them are not; `weights` of a
        reflex, of which nothing is said one by one."""
        apart, bands = windows_apart(place), None
        theta, stderr = (np.asarray(x) for x in (solved.fit.theta, solved.fit.stderr))
        size = sizes(np.abs(_middle(theta)), model.roles) if misfits else np.zeros(0)
        if solved.beside is not None and misfits:
            both = np.asarray(solved.beside.theta)[::apart], theta[::apart]
            bands = compare_bands(*(both[::-1] if ordinary else both))
        tests = (misfits, model.names, size, [role.kind for role in model.roles])
        known = Known(_error_of_mean(stderr[::apart]), bands)
        off = off_by(*tests, known)
        why, remedy = missing(misfits, {name: share for name, share in off.items() if name in judged})
        lacking = by_bands(bands, model.names, model.units, ordinary)
        others = [text for name, text in lacking.items() if name in judged and name not in off]
        lacking |= {name: in_words(misfits, {name: share}) for name, share in off.items()}
        why = "; ".join(filter(None, [why, *others]))
        moves, grown = open_moves(*tests, known) if misfits else (np.zeros(len(model.names)), "")
        # Shares of a robot's first moments and products of inertia near zero would mean nothing.
        whole = np.maximum(size, sizes_of_chain(model)) if misfits and isinstance(model, Chain) else size
        unseen = unnoticed(misfits, model.names, whole, tests[-1], spared=weights)
        notes = (harmless(*tests, known), grown, unseen)
        return cls(why, remedy, lacking, bands, moves, notes)

    def with_drive(
        self, drive: Drive | None, names: Sequence[str], judged: Sequence[str], fit: SlidingFit, place: Placement
    ) -> _OfModel:
        """With what is not known of a free joint: what may be off by more than error and a share that matters is
        refused, and the errors of what may be off by less grow."""
        if drive is None or not (drive.failed or drive.off is not None):
            return self
        theta, stderr = (np.asarray(x)[:: windows_apart(place)] for x in (fit.theta, fit.stderr))
        found = drive.off_by(names, np.abs(_middle(theta)), _error_of_mean(stderr))
        lacking = {name: f"{MOVED}: {text}" for name, text in found.items()}
        said = [text for name, text in found.items() if name in judged]
        why = drive.failed or (f"{MOVED}: {', '.join(said)}" if said else "")
        moves = self.moves
        if drive.off is not None:
            spared = np.array([name not in found for name in names])
            moves = np.sqrt(moves**2 + np.where(spared, np.nan_to_num(drive.off), 0) ** 2)
        return replace(
            self,
            why="; ".join(filter(None, [why, self.why])),
            remedy="; ".join(filter(None, [REMEDY if why else "", self.remedy])),
            lacking={**self.lacking, **(dict.fromkeys(names, drive.failed) if drive.failed else lacking)},
            moves=moves,
        )

    def with_doubts(self, doubts: Doubts, judged: Sequence[str]) -> _OfModel:
        """And with what else speaks against parameters."""
        found = dict.fromkeys(text for name, text in doubts.of.items() if name in judged)
        why = "; ".join(filter(None, [self.why, *found]))
        remedy = "; or ".join(dict.fromkeys(filter(None, [self.remedy, doubts.remedy if found else ""])))
        lacking = self.lacking | {
            name: "; ".join(filter(None, [self.lacking.get(name, ""), text])) for name, text in doubts.of.items()
        }
        moves = self.moves if doubts.moves is None else np.hypot(self.moves, doubts.moves)
        return replace(self, why=why, remedy=remedy, lacking=lacking, moves=moves)

    def with_gain(self, changes: str, judged: Sequence[str]) -> _OfModel:
        """With a sensor's gain that changes, in words; as they are where it does not."""
        if not changes:
            return self
        return replace(
            self,
            why="; ".join(filter(None, [changes, self.why])),
            remedy="; ".join(filter(None, ["calibrate the sensor before and after, or let it warm up", self.remedy])),
            lacking={**self.lacking, **dict.fromkeys(judged, changes)},
        )


def _drive_note(prepared: Prepared, misfits: tuple[Misfit, ...], theta: Numbers) -> str:
    """What is taken to move the joint, whose parameters are theta (M, p) by least squares."""
    drive, pipeline = prepared.drive, prepared.pipeline
    if drive is not None and drive.note:
        return drive.note
    if pipeline.drive is None:
        own = next((one for one in misfits if one.group == DRIVE), None)
        if drive is None or own is None:
            return _assumed(prepared, misfits)
        if own not in significant(misfits):
            return f"the motion is taken as imposed, which its {drive.source} does not contradict (model.drive)"
        names, found = prepared.model.names, _middle(theta) + own.move
        values = ", ".join(f"{name} {value:.3g}" for name, value in zip(names, found, strict=True))
        return f"the motion is taken as imposed; instrumental variables by the {drive.source} find {values}"
    if pipeline.drive == FREELY and not has_instruments(pipeline):
        return (
            "model.drive = 'free' changes nothing here: instrumental variables and a bound of the bias are worked out "
            "for joints that share no parameters, without a robot beside the human, and with window.noise = "
            "'estimated' and filter.mode = 'once'"
        )
    return ""


def _assumed(prepared: Prepared, misfits: tuple[Misfit, ...]) -> str:
    """That the motion is taken as imposed, and whether the torque contradicts that."""
    pipeline = prepared.pipeline
    if has_instruments(pipeline) and len(prepared.white) == 1:
        given = (pipeline, prepared.recording, prepared.rows, prepared.white[0], misfits)
        if belongs_with_later_motion(*given):
            return (
                "the motion is taken as imposed, but what is left of the torque belongs with later motion: noise of "
                "the joint's own torque moves it (model.drive = 'free'), or is in the position"
            )
    if not _has_human(prepared.model):  # a robot is moved by its own torque, and everybody knows
        return ""
    return "the motion is taken as imposed; if the joint's own torque moves it too, say model.drive = 'free'"


def _has_human(model: Model) -> bool:
    """Whether something has a stiffness, as a human has, by itself or at the end of a robot."""
    return any(role.kind == "stiffness" for role in model.roles)


def _middle(theta: Numbers) -> Numbers:
    """(p,) median of each parameter over the windows (M, p) that determine it; NaN where none does."""
    known = [column[np.isfinite(column)] for column in theta.T]
    return np.array([np.median(column) if len(column) else np.nan for column in known])


def _error_of_mean(stderr: Numbers) -> Numbers:
    """(p,) of the parameters' mean over windows that share no rows, by their standard errors (K, p); windows that
    hardly move do not count, if they are fewer than half."""
    known = stderr[np.isfinite(stderr).all(axis=1)]
    return np.median(known, axis=0) / np.sqrt(len(known)) if len(known) else np.zeros(stderr.shape[1])


def _reflex(model: Model, fit: SlidingFit, gain: SlidingFit) -> Reflex:
    """Gain and delay in every window, from the weights and from the fit in which the gain is the first of them."""
    pathway = pathway_of(model)
    columns = np.array([model.columns.index(column) for column in pathway.columns])
    theta, lags = np.asarray(fit.theta)[:, columns], np.array(pathway.lags)
    total, stderr = (np.asarray(x)[:, columns[0]] for x in (gain.theta, gain.stderr))
    with np.errstate(invalid="ignore", divide="ignore"):
        delay = np.where(np.abs(total) > CLEAR * stderr, theta @ lags / theta.sum(axis=1), np.nan)
    return Reflex("reflex", model.units[columns[0]], lags, columns, total, stderr, delay)


def _reflex_note(reflex: Reflex, trusted: NDArray[np.bool_]) -> str:
    note = (
        "the verdict does not look at the weights of the reflex one by one (trust.parameters can name some): those of "
        "neighbouring lags are uncertain where their sum, the gain, is not"
    )
    below = reflex.gain[trusted] < -CLEAR * reflex.gain_stderr[trusted]
    if 2 * below.sum() > len(below):
        note += "; the gain is below zero, as of a reflex that helps the stretch: try the other direction"
    return note


def jump_note(recording: Recording, jumps: NDArray[np.bool_]) -> str:
    """Where the position jumps, for people; empty where it does not."""
    at = recording.time[jumps]
    if not len(at):
        return ""
    where = ", ".join(f"{t:.6g} s" for t in at[::2][:5]) + (", ..." if len(at) > 10 else "")
    return f"the position jumps ({where}), as no joint can move: the samples around that are left out"


def _literal_note(pipeline: Pipeline) -> str:
    if pipeline.once:
        return ""
    dropped = pipeline.filter.drop_transient
    measured = "0.1 (the ends are left out)" if dropped else "2 (filter.drop_transient = true leaves the ends out)"
    return (
        "the filters ran inside every window, where position and torque do not pass the same filters near the ends: "
        f"the inertia is biased, on the simulated rig by {measured} standard deviations; filter.mode = 'once' is not"
    )


def _threshold(prepared: Prepared, place: Placement, method: int | None) -> tuple[float | None, str]:
    """Threshold of eq. (16), or why it is not applied."""
    if method in (2, 4):
        return None, (
            f"method {method} solves for robot and human together: the threshold for fake changes (eq. 16) of the "
            "human alone does not fit their condition number and is not applied"
        )
    if isinstance(prepared.reference, str):
        unasked = prepared.pipeline.reference is None and prepared.recording.reference is None
        return None, "" if unasked and not _has_human(prepared.model) else prepared.reference
    q, dq, ddq = (x[:, 0] if prepared.recording.n_joints == 1 else x for x in prepared.reference)
    rate = prepared.recording.sample_rate
    W = prepared.model.over_period(q, dq, ddq, rate).reshape(-1, len(prepared.model.names))
    window = round(prepared.pipeline.window.length * rate * place.counted / place.window)
    return float(fake_change_threshold(np.asarray(W), len(q), window)), ""
