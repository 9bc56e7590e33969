"""What a stretch of samples says of noise and of how parameters move: learnt once, frozen, shown, kept in a file."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaximp import signals
from jaximp.identification.pipeline import Pipeline, WindowSettings
from jaximp.identification.rows import FINEST, Rows, without_jumps
from jaximp.identification.solving import moments
from jaximp.identification.whitening import rows_apart, whiten
from jaximp.least_squares.autoregression import Autoregression, whiten_rows
from jaximp.least_squares.streams import Trailing, whitener
from jaximp.least_squares.window import least_squares
from jaximp.live.estimator import Live, State, compiled_rows, init
from jaximp.live.front import Front, Sample, front_of, nothing_held
from jaximp.numerics.precision import require_float64
from jaximp.recordings.outputs import write_whole
from jaximp.tracking.online import Frozen, Kind, learn
from jaximp.types import Numbers, Recording

FINEST_GRID = 0.01
"""Parameters move on a grid that is no finer [s]."""
MOST_BLOCKS = 100
"""Of a trailing window."""
FORMAT = "jaximp calibration 1"


@dataclass(frozen=True)
class Calibration:
    """All that is frozen; with the pipeline that it was made for, a `Live`."""

    filtered: Autoregression
    """What the filters make of white noise."""
    noise: Autoregression
    """What is left of the noise where that is taken off."""
    frozen: Frozen
    column_noise: Numbers
    """(p,) root mean square of what noise of the position leaves in each white column."""
    parameter_scale: Numbers
    """(p,) size of each parameter that would explain the stretch's torque by itself."""
    robot_theta: Numbers
    """Parameters of the robot that holds the joint; none without one."""
    seconds: float
    """How long the stretch was [s]."""
    sample_rate: float
    """[Hz]"""
    made_for: str
    """Model, filters and sample rate, in words: a calibration serves no others."""

    def in_words(self, pipeline: Pipeline) -> list[str]:
        """What was found, a line each: noise, drift, delay."""
        model, kind = pipeline.model, self.frozen.kind
        front, rate = front_of(live_pipeline(pipeline), self.robot_theta), pipeline.sample_rate
        lines = [
            f"calibrated on {self.seconds:.3g} s: white noise of {self.frozen.torque_noise:.3g} N m in a row, after "
            f"autoregressions of order {self.filtered.order} (filters) and {self.noise.order} (what is left)"
        ]
        how = (
            "as a random walk, {} {} in a second",
            "smoothly, its slope by {} {}/s in a second",
            "smoothly, the slope of its slope by {} {}/s^2 in a second",
        )[kind.order]
        size = np.asarray(kind.size).mean(axis=0)
        each = (
            f"{name} {how.format(f'{one:.2g}', unit)}"
            for name, unit, one in zip(model.names, model.units, size, strict=True)
        )
        lines.append(f"parameters move: {'; '.join(each)} (so with {float(kind.probability):.0%})")
        lines.append(
            f"an estimate is about the instant {front.late / rate:.3g} s ago, and the filter behind smears it over "
            f"another {front.causal.late / rate:.2g} s"
        )
        return lines


def live_pipeline(pipeline: Pipeline) -> Pipeline:
    """With rows that each say something new: what a low-pass makes alike is not kept."""
    apart = rows_apart(pipeline)
    settings = replace(pipeline.filter, decimate=apart * pipeline.filters.decimate)
    return replace(pipeline, filter=settings)


def live_of(pipeline: Pipeline, calibration: Calibration) -> Live:
    """What is done with every sample.

    **Raises:** `ValueError` for a calibration of another model, other filters or another sample rate, and as
    `front_of`.
    """
    require_float64()
    if calibration.made_for != purpose(pipeline):
        raise ValueError(
            "the calibration was made for another model, other filters or another sample rate: calibrate anew "
            f"(it is for {calibration.made_for})"
        )
    pipeline = live_pipeline(pipeline)
    front = front_of(pipeline, calibration.robot_theta if pipeline.robot is not None else None)
    return Live(
        front=front,
        filtered=whitener(calibration.filtered),
        noise=whitener(calibration.noise),
        frozen=calibration.frozen,
        window=trailing(pipeline, calibration.seconds),
    )


def trailing(pipeline: Pipeline, otherwise: float) -> Trailing:
    """The job's window as blocks of one step each; `otherwise` [s] where the whole recording is one."""
    settings, row_rate = pipeline.window, pipeline.sample_rate / pipeline.filters.decimate
    if math.isinf(settings.length):
        settings = WindowSettings(length=otherwise)
    length = max(len(pipeline.model.names) + 2, round(settings.length * row_rate))
    rows = max(1, round(settings.step_seconds * row_rate), -(-length // MOST_BLOCKS))
    return Trailing(max(1, round(length / rows)), rows)


def purpose(pipeline: Pipeline) -> str:
    """What a calibration is for, in words."""
    names = ", ".join(pipeline.model.names)
    held = "" if pipeline.robot is None else f", held by a robot with {', '.join(pipeline.robot.names)}"
    filters = live_pipeline(pipeline).filter
    known = {key: value for key, value in vars(filters).items() if value is not None}
    parts = (f"{key}={value:g}" if isinstance(value, float) else f"{key}={value}" for key, value in known.items())
    return f"{names}{held}; {pipeline.sample_rate:g} Hz; {', '.join(parts)}"


def calibrate(
    pipeline: Pipeline, samples: Sample, robot_alone: Recording | None = None, jumps: bool = True, seed: int = 0
) -> Calibration:
    """Learn the noise and how parameters move.

    **Arguments:** `samples` (N,) of a stretch in which the joint moves as it will; `robot_alone`, a recording of the
    robot without the human where the pipeline has a robot, whose parameters are taken as known from then on; with
    `jumps` parameters may jump.

    **Raises:** `ValueError` in one line for a stretch that is too short or in which nothing moves, and as `front_of`.
    """
    require_float64()
    made_for, pipeline = purpose(pipeline), live_pipeline(pipeline)
    seconds = len(samples.position) / pipeline.sample_rate
    theta = None if pipeline.robot is None else robot_parameters(pipeline, robot_alone)
    front = front_of(pipeline, theta)
    W, y, valid = rows_of(front, samples)
    p = W.shape[1]
    if valid.sum() < 10 * p:
        raise ValueError(
            f"{valid.sum()} rows of the {seconds:.3g} s count, too few to calibrate {p} parameters: calibrate for "
            f"longer (the filters take {(front.late + front.causal.settles) / pipeline.sample_rate:.2g} s), and move"
        )
    filtered, noise = _noise(pipeline, W, y, valid)
    white = whitened(filtered, noise, np.column_stack([W, y]), valid)
    row_rate = pipeline.sample_rate / front.decimate
    grid = max(1, round(FINEST_GRID * row_rate))
    frozen = learn(white[:, :p], white[:, p], valid, grid=grid, row_rate=row_rate, jumps=jumps, seed=seed)
    return Calibration(
        filtered=filtered,
        noise=noise,
        frozen=frozen,
        column_noise=_column_noise(front, samples, W, valid, filtered, noise),
        parameter_scale=np.asarray(moments(W, y, valid).parameter_scale),
        robot_theta=np.zeros(0) if theta is None else theta,
        seconds=seconds,
        sample_rate=pipeline.sample_rate,
        made_for=made_for,
    )


def rows_of(front: Front, samples: Sample) -> tuple[Numbers, Numbers, NDArray[np.bool_]]:
    """Columns (M, p), torque (M,) and what counts of all rows that samples (N,) make."""
    row = compiled_rows(front, nothing_held(front), samples)[1]
    due = np.asarray(row.due)
    values = np.asarray(row.values)[due]
    return values[:, :-1], values[:, -1], np.asarray(row.valid)[due]


def whitened(filtered: Autoregression, noise: Autoregression, z: Numbers, valid: NDArray[np.bool_]) -> Numbers:
    """Rows as the estimator whitens them."""
    return np.asarray(whiten_rows(whiten_rows(z, valid, filtered), valid, noise))


def robot_parameters(pipeline: Pipeline, alone: Recording | None) -> Numbers:
    """Of the robot by itself, by least squares of a recording of it.

    **Raises:** `ValueError` without one.
    """
    if alone is None:
        raise ValueError("a human in a robot needs the recording of the robot alone: add a [robot_recording] table")
    assert pipeline.robot is not None
    front = front_of(replace(pipeline, model=pipeline.robot, robot=None))
    W, y, valid = rows_of(front, samples_of(alone))
    fit = least_squares(W, y, jnp.asarray(valid))
    theta = np.asarray(fit.theta)
    if not np.isfinite(theta).all():
        raise ValueError("the recording of the robot alone does not determine its parameters: move it more")
    return theta


def samples_of(recording: Recording) -> Sample:
    """Of one joint."""
    if recording.n_joints != 1:
        raise ValueError(f"monitor identifies one joint, but the recording has {recording.n_joints}: map one of them")
    q, torque = np.nan_to_num(recording.position[:, 0]), np.nan_to_num(recording.torque[:, 0])
    return Sample(q, torque, recording.valid)


def _noise(
    pipeline: Pipeline, W: Numbers, y: Numbers, valid: NDArray[np.bool_]
) -> tuple[Autoregression, Autoregression]:
    """Of the filters, and of what is left, as `identify` finds them in windows of the stretch."""
    if not pipeline.whitens:
        return Autoregression(), Autoregression()
    row_rate = pipeline.sample_rate / pipeline.filters.decimate
    longest = len(y) / row_rate
    length = min(pipeline.window.length, longest)
    white = whiten(pipeline.with_window(length, length / 50), Rows(W, y, valid, np.arange(len(y)) / row_rate))
    return white.filtered, white.noise[0]


def _column_noise(
    front: Front, samples: Sample, W: Numbers, valid: NDArray[np.bool_], *noise: Autoregression
) -> Numbers:
    """From the same samples with as much noise of the position again as there is in them."""
    known = np.asarray(samples.valid)
    q = np.asarray(samples.position)
    level = max(signals.noise_level(np.where(known, q, np.nan)), FINEST * float(np.std(q[known])))
    spoilt = samples._replace(position=q + level * np.random.default_rng(0).standard_normal(len(q)))
    added = without_jumps(front.model, rows_of(front, spoilt)[0] - W)
    white = whitened(noise[0], noise[1], added, valid)[valid]
    return np.sqrt((white**2).mean(axis=0))


# ---- Files.


def save_calibration(
    calibration: Calibration, path: str | os.PathLike[str], state: Mapping[str, Any] | None = None
) -> None:
    """Write it as one .npz file, which appears whole or not at all; `state` as `state_arrays` gives it."""
    path = Path(path)
    frozen = calibration.frozen
    about = {
        "format": FORMAT, "seconds": calibration.seconds,
        "sample_rate": calibration.sample_rate, "made_for": calibration.made_for, "grid": frozen.grid,
        "every": frozen.every, "jumps": frozen.jumps, "order": frozen.kind.order,
    }  # fmt: skip
    arrays: dict[str, Any] = {
        "about": np.array(json.dumps(about)),
        "filtered": calibration.filtered.reflections,
        "noise": calibration.noise.reflections,
        "torque_unit": frozen.noise,
        "theta_unit": frozen.theta,
        "column_noise": calibration.column_noise,
        "parameter_scale": calibration.parameter_scale,
        "robot_theta": calibration.robot_theta,
    }
    arrays |= {f"kind.{name}": np.asarray(getattr(frozen.kind, name)) for name in KIND}
    if frozen.kind.left is not None:
        arrays["kind.left"] = np.asarray(frozen.kind.left)
    arrays |= {} if state is None else dict(state)
    content = BytesIO()
    np.savez(content, **arrays)
    write_whole(path, content.getvalue())


KIND = ("walk", "slope", "memory", "scale", "log_jump", "probability", "size")
"""What is kept of a `Kind`, beside its order."""


def load_calibration(path: str | os.PathLike[str]) -> Calibration:
    """What `save_calibration` wrote.

    **Raises:** `ValueError` for any other file.
    """
    arrays = _arrays(path)
    about = json.loads(str(arrays["about"]))
    kind = Kind(**{name: arrays[f"kind.{name}"] for name in KIND}, order=about["order"], left=arrays.get("kind.left"))
    frozen = Frozen(arrays["torque_unit"], arrays["theta_unit"], kind, about["grid"], about["every"], about["jumps"])
    return Calibration(
        filtered=Autoregression(arrays["filtered"]),
        noise=Autoregression(arrays["noise"]),
        frozen=frozen,
        column_noise=arrays["column_noise"],
        parameter_scale=arrays["parameter_scale"],
        robot_theta=arrays["robot_theta"],
        seconds=about["seconds"],
        sample_rate=about["sample_rate"],
        made_for=about["made_for"],
    )


def state_arrays(state: State, resumes_at: float = math.nan) -> dict[str, Any]:
    """A state as named arrays; `resumes_at` is when its next sample should come [s]."""
    return {"resumes_at": np.array(resumes_at)} | {
        f"state{k}": np.asarray(leaf) for k, leaf in enumerate(jax.tree.leaves(state))
    }


def load_state(path: str | os.PathLike[str], live: Live) -> tuple[State | None, float]:
    """The state that stands beside a calibration, None where none was kept; and when its next sample should come [s].

    **Raises:** `ValueError` for a state of another shape.
    """
    arrays, empty = _arrays(path), init(live)
    leaves, tree = jax.tree.flatten(empty)
    found = [arrays.get(f"state{k}") for k in range(len(leaves))]
    if found[0] is None:
        return None, math.nan
    if f"state{len(leaves)}" in arrays or any(
        one is None or one.shape != leaf.shape or one.dtype != leaf.dtype
        for one, leaf in zip(found, leaves, strict=True)
    ):
        raise ValueError(f"{path}: the state in it is that of other filters or another window: start without it")
    state: State = jax.tree.unflatten(tree, [jnp.asarray(one) for one in found])
    return state, float(arrays.get("resumes_at", math.nan))


def _arrays(path: str | os.PathLike[str]) -> dict[str, Any]:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        if json.loads(str(arrays["about"]))["format"] != FORMAT:
            raise KeyError
    except FileNotFoundError:
        raise ValueError(f"{path}: there is no such calibration; check the path") from None
    except (OSError, ValueError, KeyError, EOFError):
        raise ValueError(f"{path}: this is no calibration of jaximp: make one with --calibrate") from None
    return arrays
