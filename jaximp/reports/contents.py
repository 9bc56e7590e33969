"""What estimates say, as plain dictionaries and tables: what is written to disk, and what pages are made of."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaximp.identification.estimates import Estimates, HumanPart, Reflex
from jaximp.identification.filter_settings import design_filters
from jaximp.identification.residuals import Residuals
from jaximp.identification.separation import METHODS
from jaximp.jobs.job import WindowJob
from jaximp.least_squares.window import confidence_interval
from jaximp.models.base import Model
from jaximp.models.chain import Chain
from jaximp.reports.headline import headline
from jaximp.reports.pages import table_of, versions, without_nan
from jaximp.trust.changes import Course
from jaximp.types import Recording

if TYPE_CHECKING:
    import pyarrow as pa


def summary(
    estimates_list: Sequence[Estimates], job: WindowJob, recording: Recording, lengths: Sequence[Estimates] = ()
) -> dict[str, Any]:
    """Everything worth knowing, as plain dictionaries, lists, numbers and text; None where there is no number.

    The main method's results stand at the top level, those of further methods under `further_methods` and those of
    several window lengths under `window_lengths`, in the same form.
    """
    robot = job.models(recording.joints, recording.sample_rate)[0]
    main = estimates_list[0]
    found = without_nan(_result(main))
    content = {
        "headline": headline(found),
        **found,
        "further_methods": [_result(estimates) for estimates in estimates_list[1:]],
        "window_lengths": [_result(estimates) for estimates in lengths],
        "robot": _robot(main, robot),
        "recording": {
            "name": recording.name,
            "sample_rate_hz": recording.sample_rate,
            "duration_s": float(recording.time[-1] - recording.time[0]),
            "samples": len(recording),
            "valid_share": float(recording.valid.mean()),
            "joints": list(recording.joints),
        },
        "filters": asdict(job.filter) | {"decimate": design_filters(job.filter, recording.sample_rate).decimate},
        "trust_limits": asdict(job.trust),
        "min_velocity": np.max(job.pipeline_for(recording).min_velocity).item(),
        "versions": versions(),
        "job": job.text,
    }
    return without_nan(content)


def estimates_table(estimates: Estimates | Sequence[Estimates], job: WindowJob | None = None) -> pa.Table:
    """One row per window, of one recording or of several. A column's unit is its field's metadata `unit`; the job's
    text is in the schema's, and what the parameters of a robot from its URDF stand for, as JSON in `sums`."""
    several = [estimates] if isinstance(estimates, Estimates) else estimates
    columns = [
        (same[0].name, same[0].unit, np.concatenate([np.asarray(column.values) for column in same]))
        for same in zip(*(one.columns() for one in several), strict=True)
    ]
    return table_of(columns, "" if job is None else job.text, **sums_of(several[0].model))


def sums_of(model: Model | None) -> dict[str, str]:
    """What a table's metadata say of a robot from its URDF: what each of its parameters stands for, as JSON."""
    return {"sums": json.dumps(model.sums)} if isinstance(model, Chain) else {}


def _result(estimates: Estimates) -> dict[str, Any]:
    """What one method (or one window length) found."""
    trusted, vaf = estimates.verdicts.trusted, np.asarray(estimates.fit.vaf)
    parts = estimates.human_joints
    step = np.diff(estimates.start)
    return {
        "kind": estimates.kind,
        "path": _path(estimates),
        "method": estimates.method,
        "method_description": None if estimates.method is None else METHODS[estimates.method],
        "window_s": estimates.window,
        "step_s": float(np.median(step)) if len(step) else None,
        "parameters": _parameters(estimates, np.ones(len(estimates.names))),
        "equilibrium": _equilibria(parts, trusted, geared=False),
        "reflex": {reflex.name: _reflex(reflex, estimates) for reflex in estimates.reflexes},
        "at_joint": _at_joint(estimates, parts),
        "windows": {
            "count": len(trusted),
            "trusted": int(trusted.sum()),
            "trusted_share": float(trusted.mean()),
            "unpredictive": int(estimates.unpredictive.sum()),
            "verdicts": {
                verdict: {"count": count, "share": count / len(trusted)}
                for verdict, count in estimates.verdicts.counts().items()
            },
        },
        "mean_vaf": _mean(vaf[trusted]),
        "mean_held_out_vaf": _mean(estimates.held_out_vaf[trusted]),
        "mean_vaf_of_all_windows": _mean(vaf),
        "threshold": estimates.threshold,
        "tests": [
            {
                "group": one.group,
                "p": one.p,
                "chi_squared": one.statistic,
                "evidence": one.evidence,
                "move": dict(zip(estimates.names, map(float, one.move), strict=False)),
                "move_stderr": dict(zip(estimates.names, map(float, one.stderr), strict=False)),
            }
            for one in estimates.misfits
        ],
        "lacking": dict(estimates.lacking),
        "residuals": _of_residuals(estimates.residuals),
        "held_out": _of_residuals(estimates.held_out),
        "notes": list(estimates.notes),
    }


def _at_joint(estimates: Estimates, parts: list[HumanPart]) -> dict[str, Any] | None:
    """The same parameters on the joint's side of the gear, where there is one."""
    if all(part.model.gear_ratio == 1 for part in parts):
        return None
    factor = np.ones(len(estimates.names))
    for part in parts:
        factor[part.columns] = part.factor
    equilibrium = _equilibria(parts, estimates.verdicts.trusted, geared=True)
    reflex = {reflex.name: _reflex(reflex, estimates, factor) for reflex in estimates.reflexes}
    parameters = _parameters(estimates, factor)
    return {"kind": estimates.kind, "parameters": parameters, "equilibrium": equilibrium, "reflex": reflex}


def _path(estimates: Estimates) -> dict[str, Any] | None:
    """How parameters move, where they were followed."""
    if not estimates.tracks:
        return None
    found, k = {}, 0
    for track in estimates.tracks:
        for name in track.names:
            value = estimates.value[estimates.trusted_in(estimates.names[k]), k]
            found[estimates.names[k]] = {
                "unit": estimates.units[k],
                "moves": track.moves(name),
                "lowest": float(value.min()) if len(value) else math.nan,
                "highest": float(value.max()) if len(value) else math.nan,
                "jumps": [{"time_s": jump.time, "probability": jump.probability} for jump in track.jumps(name)],
            }
            k += 1
    return found


def _parameters(estimates: Estimates, factor: NDArray[np.float64]) -> dict[str, dict[str, Any]]:
    """Every parameter over the trusted windows, times a factor; of a reflex its gain."""
    factor = np.append(factor[estimates.intrinsic], [factor[reflex.columns[0]] for reflex in estimates.reflexes])
    estimates = estimates.summarised()
    fit, found, loose = estimates.fit, {}, estimates.undetermined()
    theta, stderr = np.asarray(fit.theta) * factor, np.asarray(fit.stderr) * factor
    low, high = confidence_interval(theta, stderr, fit.dof)
    for k, (name, unit) in enumerate(zip(estimates.names, estimates.units, strict=True)):
        trusted, ends = estimates.trusted_in(name), estimates.range_of(name)
        found[name] = {
            "unit": unit,
            "trusted_share": float(trusted.mean()),
            "determined": name not in loose,
            "steady": name in estimates.steady,
            "changed": _course(estimates.changed.get(name), factor[k]),
            "mean": _mean(theta[trusted, k]),
            "sd": _spread(theta[trusted, k]),
            "from_to_90": None if ends is None else [factor[k] * end for end in ends],
            "median_stderr": _median(stderr[trusted, k]),
            "half_width_95": _median((high - low)[trusted, k] / 2),
        } | _of_chain(estimates, k)
    return found


def _course(found: Course | None, factor: float) -> dict[str, Any] | None:
    """How a parameter changes, times a factor."""
    if found is None:
        return None
    return {"values": [factor * value for value in found.values], "at_s": list(found.at), "evidence": found.sure}


def _of_chain(estimates: Estimates, k: int) -> dict[str, Any]:
    """Of a robot from its URDF: what a parameter stands for, what the file says it is, and why it cannot be trusted."""
    if not isinstance(estimates.model, Chain):
        return {}
    name = estimates.names[k]
    reasons = [reason for reason in estimates.doubted.get(name, ()) if reason]
    doubt = reasons[len(reasons) // 2] if 2 * len(reasons) > len(estimates.end) else ""
    own = float(estimates.model.parameters[k])
    return {"stands_for": estimates.model.sums[name], "urdf": own, "doubt": doubt}


def _of_residuals(found: Residuals | None) -> dict[str, Any] | None:
    """Without the torques over time."""
    if found is None:
        return None
    joints = {name: getattr(found, name).tolist() for name in ("moving", "still", "relative", "relative_moving")}
    return joints | {"total": found.total, "total_moving": found.total_moving}


def _reflex(reflex: Reflex, estimates: Estimates, factor: NDArray[np.float64] | None = None) -> dict[str, Any]:
    """Delay and weights of a reflex over the trusted windows. The delay is a quotient: its median is told, no error."""
    trusted, scale = estimates.verdicts.trusted, 1.0 if factor is None else factor[reflex.columns[0]]
    theta, stderr = (scale * np.asarray(x)[:, reflex.columns] for x in (estimates.fit.theta, estimates.fit.stderr))
    low, high = confidence_interval(jnp.asarray(theta), jnp.asarray(stderr), estimates.fit.dof)
    delay = reflex.delay[trusted]
    return {
        "delay": {"unit": "s", "median": _median(delay[np.isfinite(delay)]), "sd": _spread(delay[np.isfinite(delay)])},
        "lags_s": reflex.lags.tolist(),
        "weights": {
            "names": [estimates.names[k] for k in reflex.columns],
            "unit": reflex.unit,
            "mean": [_mean(column) for column in theta[trusted].T],
            "sd": [_spread(column) for column in theta[trusted].T],
            "half_width_95": [_median(column) for column in (high - low)[trusted].T / 2],
        },
    }


def _equilibria(parts: list[HumanPart], trusted: NDArray[np.bool_], geared: bool) -> dict[str, dict[str, Any]]:
    """The equilibrium position of every joint with an offset: a quotient, so that its median is told and no error."""
    found = {}
    for part in parts:
        if part.model.offset:
            position = part.equilibrium()[trusted] / (part.model.gear_ratio if geared else 1)
            found[f"{part.prefix}equilibrium"] = {
                "unit": part.position_unit,
                "median": _median(position),
                "sd": _spread(position),
            }
    return found


def _robot(estimates: Estimates, robot: Model | None) -> dict[str, dict[str, Any]] | None:
    """Parameters of the robot alone, where a method estimated them."""
    if estimates.robot is None or robot is None:
        return None
    values = zip(
        estimates.robot_names,
        robot.units,
        np.asarray(estimates.robot.theta),
        np.asarray(estimates.robot.stderr),
        np.zeros(len(robot.names)) if estimates.robot_change is None else estimates.robot_change,
        strict=True,
    )
    return {
        name: {"unit": unit, "value": theta, "stderr": stderr, "may_change": change}
        for name, unit, theta, stderr, change in values
    }


def _mean(values: NDArray[np.float64]) -> float:
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else math.nan


def _median(values: NDArray[np.float64]) -> float:
    return float(np.median(values)) if len(values) else math.nan


def _spread(values: NDArray[np.float64]) -> float:
    """Standard deviation; one window has none."""
    return float(values.std(ddof=1)) if len(values) > 1 else math.nan
