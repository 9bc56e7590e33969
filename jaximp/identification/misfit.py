"""What a model lacks: further columns, tested in white rows over the whole record, and what is said of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from jaximp.identification.pipeline import Pipeline
from jaximp.identification.regression import Rows
from jaximp.identification.suspects import of_arm, of_one_joint, remedy, tag, untagged, what
from jaximp.identification.whitening import White
from jaximp.models.base import Role
from jaximp.trust.score_tests import ALIKE, ERRORS, SHARE, Bands, Misfit, score_groups, significant
from jaximp.types import AnyArray, Numbers, Recording, listed

HIDES = {"lag": "stiffness"}
"""Whatever yields in series with a joint makes its stiffness smaller, by as much as no column shows."""


def find_misfits(
    pipeline: Pipeline, recording: Recording, rows: Rows, white: White, theta: Numbers
) -> tuple[Misfit, ...]:
    """Test all suspects of one joint, or of an arm, whose parameters are some theta (p,).

    **Arguments:** `rows` as they were filtered, and `white`.
    """
    if recording.n_joints > 1:
        groups = of_arm(pipeline, recording, rows.W, theta)
        found = _tested(pipeline, white, rows.valid, groups)
        return tuple(_as_delayed(found, [tag("delay", j) for j in range(recording.n_joints)]))
    one_joint = ((name, {0: columns}) for name, columns in of_one_joint(pipeline, recording, len(rows.W)))
    found = _tested(pipeline, white, rows.valid, one_joint)
    late = [_undelayed(one, pipeline.model.roles, theta) if one.group == "delay" else one for one in found]
    return tuple(_as_delayed(late, ["delay"]))


def _tested(
    pipeline: Pipeline, white: White, valid: AnyArray, groups: Iterable[tuple[str, Mapping[int, Numbers]]]
) -> list[Misfit]:
    """Tests of groups whose columns (N, g) act on the torque of some outputs, with those of all outputs in a row."""
    W, torque, counts = (np.asarray(x) for x in (white.W, white.torque, valid))
    outputs = 1 if torque.ndim == 1 else torque.shape[1]
    counts = counts.astype(bool).reshape(-1, outputs)
    whole = {}
    for name, by_output in groups:
        columns = np.zeros((*counts.shape, next(iter(by_output.values())).shape[1]))
        for j, acting in by_output.items():
            columns[:, j] = white.apply(acting, counts[:, j], j)
        whole[name] = columns.reshape(-1, columns.shape[-1])
    W, window = W.reshape(-1, W.shape[-1]), pipeline.window_rows * outputs
    return score_groups(W, torque.ravel(), whole, counts.ravel(), window, white.every)


def _as_delayed(misfits: Sequence[Misfit], delays: Sequence[str]) -> list[Misfit]:
    """To slow motion whatever yields is a delay: that tells what it does to the parameters, its own weights do not."""
    late = {one.group.replace("delay", "lag"): one for one in misfits if one.group in delays}
    return [
        replace(one, move=late[one.group].move, stderr=late[one.group].stderr) if one.group in late else one
        for one in misfits
    ]


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
    hidden = HIDES.get(untagged(_suspected(misfits)[0].group)[0]) if found else None
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
    return " or ".join(dict.fromkeys(what(one.group) for one in _suspected(misfits)))


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
    return (in_words(misfits, off), remedy(significant(misfits)[0].group)) if off else ("", "")


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
    return f"this motion cannot show everything: {what(worst.group)}, say, could move {blinded} unnoticed"
