"""What a model of one joint may lack: further columns of its motion, tested in white rows over the whole record."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from jaximp import signals
from jaximp.identification.pipeline import Pipeline
from jaximp.identification.regression import measured_motion
from jaximp.identification.whitening import White
from jaximp.models.base import Role
from jaximp.trust.score_tests import ALIKE, ERRORS, SHARE, Bands, Misfit, score_groups, significant
from jaximp.types import AnyArray, Numbers, Recording, listed

REFLEX_DELAY, MUSCLE = 0.03, (0.0, 0.015, 0.03, 0.06, 0.12)
"""How long the rectified velocity takes to the muscle, and time constants of its torque, which builds up as behind a
critically damped low-pass of second order [s]; in both directions."""
SLOW = 0.3
"""Velocity below which dry friction builds up, as a share of its root mean square."""
YIELDING = (0.01, 0.04)
"""Time constants of what yields between the position and the torque [s]."""


@dataclass(frozen=True)
class Suspect:
    """A group of columns, and what it stands for."""

    what: str
    remedy: str
    columns: Callable[[_Motion], list[Numbers]]


@dataclass(frozen=True)
class _Motion:
    """Of one joint, behind the position's filter, at every sample."""

    t: Numbers
    q: Numbers
    dq: Numbers
    ddq: Numbers
    jerk: Numbers
    snap: Numbers
    rate: float

    def later(self, x: Numbers, seconds: float) -> Numbers:
        """What x was so long ago."""
        lag = round(seconds * self.rate)
        return np.concatenate([np.zeros(lag), x[: len(x) - lag]])

    def yielding(self, x: Numbers, seconds: float) -> Numbers:
        """x behind a first-order lag; of no seconds, x itself."""
        from scipy.signal import lfilter

        a = np.exp(-1 / (seconds * self.rate)) if seconds else 0.0
        return np.asarray(lfilter([1 - a], [1, -a], x))

    def twitch(self, x: Numbers, seconds: float) -> Numbers:
        """The torque of a muscle that is told x."""
        return self.yielding(self.yielding(x, seconds), seconds)


SUSPECTS: Mapping[str, Suspect] = {
    "reflex": Suspect(
        "a stretch reflex",
        "try model.human.reflex = true",
        lambda m: [
            m.twitch(m.later(np.maximum(sign * m.dq, 0), REFLEX_DELAY), seconds)
            for sign in (1, -1)
            for seconds in MUSCLE
        ],
    ),
    "stiffness": Suspect(
        "a stiffness that depends on the angle",
        "move less far, or around one angle at a time",
        lambda m: [(m.q - m.q.mean()) ** 2, (m.q - m.q.mean()) ** 3],
    ),
    "friction": Suspect(
        "dry friction",
        "model it (coulomb), or leave out slow samples (window.min_velocity)",
        lambda m: [np.sign(m.dq), np.tanh(m.dq / (SLOW * np.sqrt(np.mean(m.dq**2)) + 1e-300))],
    ),
    "delay": Suspect(
        "a delay between torque and position",
        "check the clocks and filters of both channels",
        lambda m: [m.jerk],
    ),
    "lag": Suspect(
        "something that yields or filters between position and torque (a cuff, an amplifier)",
        "measure the position where the torque acts, and use one filter for both channels",
        lambda m: [m.snap, *(m.yielding(m.ddq, seconds) for seconds in YIELDING)],
    ),
    "drift": Suspect(
        "a steady change inside the windows",
        "shorten window.length",
        lambda m: [(m.t - m.t.mean()) * m.q, (m.t - m.t.mean()) * m.dq],
    ),
}
"""Who is asked, by name."""
HIDES = {"lag": "stiffness"}
"""Whatever yields in series with a joint makes its stiffness smaller, by as much as no column shows."""


def find_misfits(
    pipeline: Pipeline,
    recording: Recording,
    W: AnyArray,
    torque: AnyArray,
    white: White,
    valid: AnyArray,
    theta: Numbers,
) -> tuple[Misfit, ...]:
    """Test all `SUSPECTS` in the white rows W (N, p) and torque (N,) of one joint, whose parameters are some theta."""
    filters, motion = pipeline.filters, _motion_of(pipeline, recording)
    groups = {}
    for name, suspect in SUSPECTS.items():
        columns = np.stack(suspect.columns(motion), axis=1)
        if filters.parallel is not None:
            from scipy.signal import sosfiltfilt

            columns = sosfiltfilt(np.array(filters.parallel), columns, axis=0)
        groups[name] = white.apply(columns[:: filters.decimate][: len(W)], valid)
    counts = np.asarray(valid, bool)
    found = score_groups(np.asarray(W), np.asarray(torque), groups, counts, pipeline.window_rows, white.every)
    delay = next((_undelayed(one, pipeline.model.roles, theta) for one in found if one.group == "delay"), None)
    if delay is None:
        return tuple(found)
    # To slow motion whatever yields is a delay: that tells what it does to the parameters, its own weights do not.
    late = {"delay": delay, "lag": delay}
    return tuple(
        replace(one, move=late[one.group].move, stderr=late[one.group].stderr) if one.group in late else one
        for one in found
    )


def _undelayed(misfit: Misfit, roles: Sequence[Role], theta: Numbers) -> Misfit:
    """With the move to the parameters without the delay.

    A torque that is late by d has, to first order, a jerk's weight -d inertia, and in place of the inertia and the
    damping what is d damping and d stiffness less.
    """
    place = {role.kind: k for k, role in enumerate(roles) if role.kind in ("inertia", "damping", "stiffness")}
    if "inertia" not in place:
        return misfit
    moved = theta + misfit.move
    late = -misfit.weights[0] / theta[place["inertia"]] if theta[place["inertia"]] else 0.0
    move = misfit.move.copy()
    for of, by in (("damping", "stiffness"), ("inertia", "damping")):
        if of in place and by in place:
            move[place[of]] += late * (moved[place[by]] if by == "stiffness" else theta[place[by]] + move[place[by]])
    relative = np.max(misfit.stderr / np.where(misfit.move != 0, np.abs(misfit.move), np.inf), initial=0.0)
    return replace(misfit, move=move, stderr=relative * np.abs(move))


def _motion_of(pipeline: Pipeline, recording: Recording) -> _Motion:
    from scipy.signal import sosfiltfilt

    filters, rate = pipeline.filters, recording.sample_rate
    q = measured_motion(pipeline.filter, recording).position[:, 0]
    if filters.position is not None:
        q = sosfiltfilt(np.array(filters.position), q)
    dq, ddq = signals.differentiate(q, rate, filters.differentiator)
    jerk, snap = signals.differentiate(ddq, rate, filters.differentiator)
    return _Motion(recording.time, q, dq, ddq, jerk, snap, rate)


def off_by(
    misfits: Sequence[Misfit], names: Sequence[str], size: Numbers, kinds: Sequence[str] = ()
) -> dict[str, float]:
    """Parameters that what is missing moves beyond error and `SHARE` of their `size` (p,), by what share; NaN where it
    may move them so far, but how far cannot be told.

    **Arguments:** `kinds` (p,) of the parameters' roles.
    """
    found: dict[str, float] = {}
    for one in _suspected(misfits):
        for k, name in enumerate(names):
            share, error = (x[k] / size[k] if size[k] > 0 else 0.0 for x in (one.move, ERRORS * one.stderr))
            if abs(share) > max(error, SHARE):
                found.setdefault(name, float(share))
            elif error > SHARE:
                found.setdefault(name, np.nan)
    hidden = HIDES.get(_suspected(misfits)[0].group) if found else None
    for name, kind in zip(names, kinds, strict=False):
        if kind == hidden:
            found.setdefault(name, np.nan)
    return found


def _suspected(misfits: Sequence[Misfit]) -> list[Misfit]:
    """The group that explains most, and those that explain nearly as much; what explains less is not needed."""
    found = significant(misfits)
    return [one for one in found if one.evidence >= ALIKE * found[0].evidence]


def culprits(misfits: Sequence[Misfit]) -> str:
    """What is missing, in words."""
    return " or ".join(SUSPECTS[one.group].what for one in _suspected(misfits))


def in_words(misfits: Sequence[Misfit], off: Mapping[str, float]) -> str:
    """Why these parameters cannot be trusted; empty where none is off."""
    changes = [f"{name} would change by {share:+.0%}" for name, share in off.items() if np.isfinite(share)]
    open_ones = [name for name, share in off.items() if not np.isfinite(share)]
    changes += [f"how far {listed(open_ones)} would change cannot be told"] if open_ones else []
    return f"the model lacks {culprits(misfits)}: {', '.join(changes)}" if off else ""


def by_bands(bands: Bands | None, names: Sequence[str], units: Sequence[str]) -> dict[str, str]:
    """Parameters that depend on the frequencies that least squares weighs, and how, in words."""
    if bands is None:
        return {}
    return {
        name: f"{name} depends on the frequency (ordinary least squares, which counts slow motion more, finds "
        f"{bands.ordinary[k]:.3g} and not {bands.generalised[k]:.3g} {unit})"
        for k, (name, unit) in enumerate(zip(names, units, strict=True))
        if bands.apart(k)
    }


def missing(misfits: Sequence[Misfit], off: Mapping[str, float]) -> tuple[str, str]:
    """Why these parameters cannot be trusted, and what to do; empty where none is off."""
    return (in_words(misfits, off), SUSPECTS[significant(misfits)[0].group].remedy) if off else ("", "")


def harmless(misfits: Sequence[Misfit], names: Sequence[str], size: Numbers, kinds: Sequence[str] = ()) -> str:
    """What is missing, but moves no parameter beyond error and `SHARE`: a note."""
    if not significant(misfits) or off_by(misfits, names, size, kinds):
        return ""
    return f"the model lacks {culprits(misfits)}, which moves no parameter by more than {SHARE:.0%} or beyond error"


def unnoticed(misfits: Sequence[Misfit], names: Sequence[str], size: Numbers, kinds: Sequence[str] = ()) -> str:
    """How far each parameter might be off without any test noticing it: twice the largest error of a move."""
    if not misfits:
        return ""
    blind = ERRORS * np.max([one.stderr for one in misfits], axis=0)
    share: NDArray[np.float64] = blind / np.where(size > 0, size, np.inf)
    worst = misfits[int(np.argmax(np.max([one.stderr / np.where(size > 0, size, np.inf) for one in misfits], axis=1)))]
    blinded = ", ".join(f"{name} by {part:.0%}" for name, part in zip(names, share, strict=True) if part > SHARE)
    if not blinded:
        return ""
    return f"this motion cannot show everything: {SUSPECTS[worst.group].what}, say, could move {blinded} unnoticed"
