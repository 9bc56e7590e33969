"""Whether each parameter of a joint is the same at all frequencies, for a figure, and in all windows, for a note."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from jaximp.identification.pipeline import Pipeline
from jaximp.identification.rows import Rows
from jaximp.identification.whitening import White
from jaximp.least_squares.window import SlidingFit
from jaximp.models.base import Model
from jaximp.models.reflex import pathway_of
from jaximp.trust.changes import FEWEST, Change, Course, common_gain, find_changes, levels
from jaximp.trust.frequencies import ByFrequency, estimate_by_frequency
from jaximp.trust.score_tests import p_in_words
from jaximp.types import Numbers


def compared(model: Model) -> list[int]:
    """Columns of the parameters that are compared: not a constant torque, nor the weights of a reflex one by one."""
    weights = set(pathway_of(model).columns) if model.memory else set()
    return [
        k
        for k, (column, role) in enumerate(zip(model.columns, model.roles, strict=True))
        if role.kind != "offset" and column not in weights
    ]


def by_frequency(pipeline: Pipeline, rows: Rows, several: Sequence[White]) -> tuple[ByFrequency, ...]:
    """What differs between frequencies, of one joint; parameters that are not compared keep what each window finds.
    Empty for joints that share parameters, and where there is too little to compare."""
    model, limits = pipeline.model, pipeline.limits
    if not several or model.n_joints > 1:
        return ()
    (white,) = several
    of_white, as_filtered = ((np.asarray(x.W), np.asarray(x.torque)) for x in (white, rows))
    rate = pipeline.sample_rate / pipeline.filters.decimate
    parameters = {k: (model.names[k], model.units[k]) for k in compared(model)}
    found = estimate_by_frequency(
        of_white,
        as_filtered,
        np.asarray(rows.valid),
        pipeline.window_rows,
        white.every,
        rate,
        parameters,
        limits.max_relative_stderr,
        white.inflation,
    )
    return () if found is None else (found,)


def changes(
    pipeline: Pipeline, fit: SlidingFit, which: NDArray[np.int64], start: Numbers, end: Numbers
) -> tuple[dict[str, Course], tuple[str, ...]]:
    """Parameters that are not the same in windows that share no rows, and those of which no change was found.

    **Arguments:** `which` these windows are; `start` and `end` (M,) of all [s].
    """
    model, columns = pipeline.model, compared(pipeline.model)
    value, stderr, dof = (np.asarray(x)[which] for x in (fit.theta, fit.stderr, fit.dof))
    known = np.isfinite(value).all(axis=1) & (stderr > 0).all(axis=1)
    value, stderr, dof, which = value[known], stderr[known], dof[known], which[known]
    found = {
        model.names[columns[k]]: _course(
            one, value[:, columns[k]], stderr[:, columns[k]], start[which], end[which], model.units[columns[k]]
        )
        for k, one in find_changes(value[:, columns], stderr[:, columns], dof).items()
    }
    asked = [model.names[k] for k in columns] if len(which) >= FEWEST else []
    return found, tuple(name for name in asked if name not in found)


def gain_in_words(model: Model, fit: SlidingFit, apart: int) -> str:
    """How the gain of a sensor of one joint changes over the record; empty where it does not. Windows `apart` of each
    other share no rows."""
    columns = compared(model)
    masses = [place for place, k in enumerate(columns) if model.roles[k].kind == "inertia"]
    if model.n_joints > 1 or not masses or len(columns) < 3:
        return ""
    value, stderr, dof = (np.asarray(x)[::apart] for x in (fit.theta, fit.stderr, fit.dof))
    found = common_gain(value[:, columns], stderr[:, columns], dof, masses[0])
    if found is None:
        return ""
    return (
        f"all parameters change by the same share, between {found.low:.0%} and {found.high:.0%} of their mean, inertia "
        "too: the gain of a sensor changes"
    )


def _course(change: Change, value: Numbers, stderr: Numbers, start: Numbers, end: Numbers, unit: str) -> Course:
    """In levels, where there are any; else between which values it changes."""
    found, sure = levels(value, stderr), p_in_words(change.p)
    if len(found) < 2:
        return Course((change.low, change.high), (), unit, sure)
    at = (float(end[one.last] + start[after.first]) / 2 for one, after in pairwise(found))
    return Course(tuple(one.value for one in found), tuple(at), unit, sure)
