"""The tables of a study: a row per window, and a row per recording."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from jaximp.batch.plan import Item, printable
from jaximp.batch.task import About, Result, Task, job_checksum, named_joints
from jaximp.identification.filter_settings import design_filters
from jaximp.jobs.job import WindowJob
from jaximp.least_squares.window import confidence_interval
from jaximp.models.base import Joints, Model
from jaximp.models.reflex import pathway_of
from jaximp.reports.contents import estimates_table, sums_of
from jaximp.reports.pages import table_of, versions
from jaximp.trust.verdicts import VERDICTS

RUN_COLUMNS = ("seconds",)
"""Columns of the recordings' table that differ from run to run."""
WINDOW_COLUMNS = (
    "recording", "start_s", "end_s", "equilibrium", "condition_number", "sigma_min", "residual_rms", "vaf",
    "held_out_vaf", "dof", "samples", "verdict", "reason", "reflex_gain", "reflex_gain_stderr", "reflex_delay",
)  # fmt: skip
"""Columns of the windows beside the parameters."""
ANY_RATE = 1000.0
"""Of recordings that could not be read [Hz]: a model's names do not depend on it."""


def windows_table(task: Task, results: Sequence[Result], k: int = 0) -> pa.Table:
    """One row per window of all recordings: the columns of `estimates.parquet`, behind the recording's name and the
    manifest's columns.

    `condition` is called `condition_number` here: a study has conditions of its own, which partition its results.
    """
    several, job = [result.estimates[k] for result in results], task.job
    about = results[0].about
    assert about is not None
    table = estimates_table(several, job)
    about_table = table.schema.metadata
    table = table.rename_columns({"condition": "condition_number"})
    which = pa.array(np.repeat(np.arange(len(results)), [len(one.start) for one in several]))
    metadata = [dict(result.item.metadata) for result in results]
    columns = {"recording": [result.item.name for result in results]}
    columns |= {name: [row.get(name, "") for row in metadata] for name in task.metadata}
    for place, (name, texts) in enumerate(columns.items()):
        field = pa.field(name, pa.string(), metadata={"unit": ""})
        table = table.add_column(place, field, _texts(texts).take(which))
    return table.replace_schema_metadata(about_table)


def recordings_table(task: Task, results: Sequence[Result]) -> pa.Table:
    """One row per recording: where it comes from, what was found, and what made it."""
    job, model = task.job, _model_of(task.job, results)
    named = [] if model is None else _summarised(model)
    columns: list[tuple[str, str, Any]] = [
        ("recording", "", _texts(result.item.name for result in results)),
        ("file", "", _texts(str(result.item.file) for result in results)),
    ]
    metadata = [dict(result.item.metadata) for result in results]
    columns += [(name, "", _texts(row.get(name, "") for row in metadata)) for name in task.metadata]
    measured = [result.about for result in results]
    columns += [
        ("status", "", _texts(result.status for result in results)),
        ("reason", "", _texts(result.remark for result in results)),
        ("suspicion", "", _texts("" for _ in results)),  # what the others say of it, when all are there
        ("samples", "1", np.array([0 if r is None else r.samples for r in measured])),
        ("sample_rate_hz", "Hz", _numbers(r and r.sample_rate for r in measured)),
        ("duration_s", "s", _numbers(r and r.duration for r in measured)),
        ("valid_share", "1", _numbers(r and r.valid_share for r in measured)),
        ("windows", "1", np.array([len(r.estimates[0].start) if r.estimates else 0 for r in results])),
    ]
    counts = [r.estimates[0].verdicts.counts() if r.estimates else dict.fromkeys(VERDICTS, 0) for r in results]
    columns += [(name, "1", np.array([count[name] for count in counts])) for name in VERDICTS]
    columns += _residuals(job, results)
    parameters = _over_trusted(results, len(named))
    for k, (name, unit) in enumerate(named):
        columns += [(f"{name}_{what}", unit, _numbers(found[:, k])) for what, found in parameters.items()]
    columns += [
        ("threshold", "1", _numbers(r.estimates[0].threshold if r.estimates else None for r in results)),
        ("notes", "", _texts("\n".join(r.estimates[0].notes) if r.estimates else "" for r in results)),
        ("model", "", _texts("" if model is None else model.label for _ in results)),
        ("filters", "", _texts(_filters(job, r) for r in measured)),
        ("versions", "", _texts([json.dumps(versions())] * len(results))),
        ("sha256", "", _texts(r.sha256 for r in results)),
        ("job_sha256", "", _texts([job_checksum(job)] * len(results))),
        ("seconds", "s", np.array([r.seconds for r in results])),
    ]
    return table_of(columns, job.text, **sums_of(model))


def tells_residuals(job: WindowJob) -> bool:
    """Whether recordings have columns for what is left of their torques: of robots, and where something is held out."""
    return job.model.chain is not None or job.held_out is not None


def _residuals(job: WindowJob, results: Sequence[Result]) -> list[tuple[str, str, Any]]:
    """What is left of the torque of all joints, as a share of it; and of that which was held out."""
    if not tells_residuals(job):
        return []
    firsts = [result.estimates[0] if result.estimates else None for result in results]
    columns = {"residual": [None if one is None else one.residuals for one in firsts]}
    if job.held_out is not None:
        columns["held_out_residual"] = [None if one is None else one.held_out for one in firsts]
    return [
        (name, "1", _numbers(None if one is None else one.total for one in found)) for name, found in columns.items()
    ]


def _over_trusted(results: Sequence[Result], p: int) -> dict[str, NDArray[np.float64]]:
    """(R, p) mean and spread of the parameters over the trusted windows of each recording.

    Windows overlap, so that their mean is hardly surer than one of them: the interval, `mean - half_width_95` to `mean
    + half_width_95`, is that of a window with the median standard error and degrees of freedom. Of a reflex it is the
    gain.
    """
    found = {what: np.full((len(results), p), np.nan) for what in ("mean", "sd", "median_stderr", "half_width_95")}
    dof = np.full(len(results), np.nan)
    for k, result in enumerate(results):
        if result.estimates and result.estimates[0].verdicts.trusted.any():
            fit, trusted = result.estimates[0].summarised().fit, result.estimates[0].verdicts.trusted
            theta = np.asarray(fit.theta)[trusted]
            found["mean"][k], found["sd"][k] = theta.mean(axis=0), theta.std(axis=0)
            errors = np.column_stack([fit.stderr, fit.dof])[trusted]
            *found["median_stderr"][k], dof[k] = np.median(errors, axis=0)
    low, high = confidence_interval(0 * found["median_stderr"], found["median_stderr"], dof)
    found["half_width_95"] = (high - low) / 2
    return found


def reserved_columns(job: WindowJob) -> set[str]:
    """Names that a manifest's columns cannot have: those of the results."""
    nothing = [Result(Item("", Path()))]
    table, model = recordings_table(Task(job, Path(), (), (), (), 0), nothing), _model_of(job, nothing)
    parameters = () if model is None else model.names
    return {*table.column_names, *WINDOW_COLUMNS, *parameters, *(f"{name}_stderr" for name in parameters)}


def _model_of(job: WindowJob, results: Sequence[Result]) -> Model | None:
    """What is identified: of the recordings that could be read, or as the job's columns suggest."""
    first = next((result.about for result in results if result.about is not None), None)
    joints = None if first is None else first.joints
    rate = ANY_RATE if first is None else first.sample_rate
    if joints is None:
        joint = job.recording.get("joint", "revolute")
        joints = tuple(joint) if isinstance(joint, list) else (joint,) * named_joints(job)
    try:
        robot, human = job.models(joints, rate)
    except (ValueError, KeyError):
        return None
    return robot if human is None else human


def _summarised(model: Model) -> list[tuple[str, str]]:
    """Name and unit of what a recording's row tells, in the order of `Estimates.summarised`."""
    parts = model.models if isinstance(model, Joints) else (model,)
    tags = [f"joint{j + 1}." if isinstance(model, Joints) else "" for j in range(len(parts))]
    kept, gains = list[tuple[str, str]](), list[tuple[str, str]]()
    for tag, part in zip(tags, parts, strict=True):
        weights = pathway_of(part).columns if part.memory else ()
        units = dict(zip(part.columns, part.units, strict=True))
        named = zip(part.names, part.columns, strict=True)
        kept += [(tag + name, units[column]) for name, column in named if column not in weights]
        gains += [(f"{tag}reflex_gain", units[weights[0]])] if weights else []
    return [*kept, *gains]


def _filters(job: WindowJob, about: About | None) -> str:
    rate = None if about is None else about.sample_rate
    try:
        decimate = job.filter.decimate if rate is None else design_filters(job.filter, rate).decimate
    except ValueError:
        decimate = job.filter.decimate
    return json.dumps(asdict(job.filter) | {"decimate": decimate})


def _texts(values: Any) -> Any:
    return pa.array([printable(text) for text in values], pa.string())


def _numbers(values: Any) -> Any:
    """What there is no number for is null."""
    return pa.array([np.nan if value is None else float(value) for value in values], pa.float64(), from_pandas=True)
