"""`jaximp reproduce tout2023`: figures 2 and 3 of Tout et al. 2023 and their numbers, from the simulated rig.

The paper's excitation coefficients, noise level and controller are not printed; ours are those of `simulation.rig`.
The windows are filtered inside every window, as the paper writes; filtering once stands beside it.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaximp import plots
from jaximp.identification.estimates import Estimates
from jaximp.identification.filter_settings import FilterSettings
from jaximp.identification.identify import estimate
from jaximp.identification.pipeline import Pipeline, WindowSettings
from jaximp.identification.prepared import noise_of, regress_pair
from jaximp.identification.separation import fit_robot
from jaximp.least_squares.recursive import recursive_least_squares
from jaximp.least_squares.window import variance_accounted_for
from jaximp.models.joint import HumanJoint, RobotJoint
from jaximp.simulation.rig import ROBOT_TRAJECTORY, ElasticBands, HumanLoad, Rig
from jaximp.simulation.rig_recordings import rig_recordings
from jaximp.types import Progress, Recording

GEAR_RATIO = 15.0
WINDOWS = (1.0, 2.0, 4.0)
FORGETTING = (0.995, 0.999, 0.9995, 1.0)
PAPER = {
    "convergence_s": {"model 2, sliding window": 2.0, "model 2, RLS 0.999": 5.3, "model 2, RLS 0.9995": 5.7},
    "vaf_percent": {"model 2, sliding window": 77.02, "model 1, sliding window": 60.697, "RLS 0.999": 61.023},
    "natural_frequency_hz": 0.97,
}
CONVERGED = 0.1
"""An estimate has reached the new value within this share of it; it has settled if it stays for `SETTLED` seconds."""
SETTLED = 1.0

Numbers = NDArray[np.float64]


@dataclass(frozen=True)
class Track:
    """One estimate of the stiffness over time."""

    label: str
    time: Numbers
    stiffness: Numbers


def reproduce(folder: Path, progress: Progress = lambda share: None) -> None:
    """Write the figures, tables.json and tables.md into an existing folder."""
    springs = rig_recordings(HumanLoad(), reference=ROBOT_TRAJECTORY, duration=10.0)
    bands = rig_recordings(ElasticBands())
    by_window = [_identify(springs, offset=False, length=length)[0] for length in WINDOWS]
    progress(0.2)
    by_method = _identify(springs, offset=False, length=2.0, methods=(1, 2, 3, 4))
    once = _identify(springs, offset=False, length=2.0, mode="once")[0]
    recursive = [_recursive(springs, False, forgetting) for forgetting in FORGETTING]
    progress(0.5)
    models = {1: _identify(bands, offset=False, length=2.0)[0], 2: _identify(bands, offset=True, length=2.0)[0]}
    forgotten = {n: [_recursive(bands, n == 2, forgetting) for forgetting in FORGETTING[:3]] for n in (1, 2)}
    progress(0.8)
    causal = {n: _causal_torque(bands, models[n], n == 2) for n in (1, 2)}
    causal_recursive = _causal_torque(bands, forgotten[2][1], True)

    _draw_simulation(folder, by_window, by_method, recursive)
    _draw_bands(folder, models, forgotten, causal)
    tables = {
        "paper": PAPER,
        "measured": {
            "fig2a_windows": {f"{e.window:g} s": _before_and_after(_track(e), 5.0, e.window) for e in by_window},
            "fig2a_windows_filtered_once": {"2 s": _before_and_after(_track(once), 5.0, 2.0)},
            "fig2a_recursive": {t.label: _before_and_after(t, 5.0, 2.0) for t in map(_as_track, recursive)},
            "fig2b_methods": {
                f"method {e.method}": _before_and_after(_track(e), 5.0, 2.0)
                | {"median_condition": float(np.nanmedian(np.asarray(e.fit.cond)))}
                for e in by_method
            },
            "fig3a_convergence_s": _convergence(models, forgotten),
            "fig3b_fake_change": {
                f"model {n}": {
                    "threshold": e.threshold,
                    "share_above": float(np.mean(~(np.asarray(e.fit.cond) < (e.threshold or np.inf)))),
                }
                for n, e in models.items()
            },
            "fig3c_vaf_percent": {
                "model 2, sliding window": causal[2][3],
                "model 1, sliding window": causal[1][3],
                "RLS 0.999": causal_recursive[3],
            },
            "natural_frequency_hz": float(np.sqrt(1.518e-3 * 9.81 / (GEAR_RATIO * 1.9e-5)) / (2 * np.pi)),
        },
        "why_the_numbers_differ": WHY,
    }
    (folder / "tables.json").write_text(json.dumps(tables, indent=1), encoding="utf-8")
    (folder / "tables.md").write_text(_markdown(tables), encoding="utf-8")
    progress(1.0)


WHY = (
    "The paper prints neither its excitation coefficients nor its noise, controller or band geometry. The motion here "
    "is designed by gradient (for the robot's condition number in figure 2, for the human's in figure 3), the noise is "
    "5e-4 N m, and the bands are a simulated stand-in.",
    "The paper does not say what it calls convergence. Reached means here: within 10 % of half the mean value before "
    "the bands were removed; settled: staying there for 1 s, which windows of 2 s with offset are too noisy for.",
    "VAF here is that of the human's torque (motor torque less the robot's model), each sample reconstructed with the "
    "parameters of the window that ends there. The paper does not say which torque it means.",
    "The share of windows above the threshold (16) depends on the excitation: this motion is slow against 2 s, which "
    "makes the column of the offset nearly collinear with that of the stiffness.",
    "The paper states f0 = 0.97 Hz; its own parameters give 1.15 Hz.",
)
"""What a reader must know who compares the two columns."""


def _pipeline(offset: bool, length: float, methods: tuple[int, ...] = (1,), mode: str = "window") -> Pipeline:
    return Pipeline(
        sample_rate=Rig().sample_rate,
        model=HumanJoint(offset, GEAR_RATIO),
        robot=RobotJoint(GEAR_RATIO),
        methods=methods,
        window=WindowSettings(length, step=0.02, min_velocity=0.1, noise="filtered"),  # ordinary, as in the paper
        filter=FilterSettings(
            position_cutoff=10.0,
            decimation_cutoff=5.0,
            mode=mode,
            drop_transient=False,
            decimate=40,
            derivatives="central",
        ),
        reference=10.0,
    )


def _identify(
    recordings: tuple[Recording, Recording],
    offset: bool,
    length: float,
    methods: tuple[int, ...] = (1,),
    mode: str = "window",
) -> list[Estimates]:
    alone, held = recordings
    return estimate(_pipeline(offset, length, methods, mode), held, alone)


@dataclass(frozen=True)
class Recursive:
    """Recursive least squares over a recording: all parameters at every sample."""

    forgetting: float
    time: Numbers
    theta: Numbers


def _recursive(recordings: tuple[Recording, Recording], offset: bool, forgetting: float) -> Recursive:
    W, torque, valid, time = human_rows(recordings, offset)
    fit = recursive_least_squares(W, torque, forgetting, valid=jnp.asarray(valid))
    return Recursive(forgetting, time, np.asarray(fit.theta))


def human_rows(recordings: tuple[Recording, Recording], offset: bool) -> tuple[Numbers, Numbers, Any, Numbers]:
    """Rows of the human's model and its torque by method 1, filtered once, at every sample."""
    alone, held = recordings
    pipeline = _pipeline(offset, 2.0, mode="once")
    pipeline = replace(pipeline, filter=replace(pipeline.filter, decimate=1))
    robot, noise = RobotJoint(GEAR_RATIO), noise_of(pipeline)
    fit = fit_robot(regress_pair(pipeline, robot, alone)[0], None if noise is None else jnp.asarray(noise))
    loaded = regress_pair(pipeline, robot, held)[0]
    torque = loaded.torque - loaded.robot @ fit.theta
    return np.asarray(loaded.human), np.asarray(torque), np.asarray(loaded.valid), held.time


def _causal_torque(
    recordings: tuple[Recording, Recording], source: Estimates | Recursive, offset: bool
) -> tuple[Numbers, Numbers, Numbers, float]:
    """Time, the human's torque, its reconstruction from parameters known at each sample, and the VAF [%]."""
    W, torque, valid, time = human_rows(recordings, offset)
    if isinstance(source, Recursive):
        theta = source.theta
    else:
        known = np.searchsorted(source.end, time + 1e-9) - 1
        theta = np.where(known[:, None] >= 0, np.asarray(source.fit.theta)[known], np.nan)
    reconstructed = (W * theta).sum(axis=1)
    counts = valid & np.isfinite(reconstructed) & (time >= 2.0)
    residual = np.where(counts, torque - reconstructed, 0.0)
    vaf = variance_accounted_for(jnp.asarray(torque), jnp.asarray(residual), jnp.asarray(counts.astype(float)))
    return time, torque, np.where(counts, reconstructed, np.nan), 100 * float(vaf)


def _track(estimates: Estimates) -> Track:
    label = f"window {estimates.window:g} s"
    return Track(label, estimates.end, np.asarray(estimates.fit.theta)[:, estimates.names.index("stiffness")])


def _as_track(source: Recursive) -> Track:
    return Track(f"RLS {source.forgetting:g}", source.time, source.theta[:, 2])


def _before_and_after(track: Track, change: float, memory: float) -> dict[str, float]:
    """Mean and spread of the stiffness before the change and, once it is forgotten, after it."""
    parts = {
        "before": (track.time < change) & (track.time > 1.0),
        "after": track.time > change + memory,
    }
    out: dict[str, float] = {}
    for name, part in parts.items():
        values = track.stiffness[part & np.isfinite(track.stiffness)]
        out |= {f"{name}_mean": float(values.mean()), f"{name}_sd": float(values.std())}
    return out


def _convergence(models: dict[int, Estimates], forgotten: dict[int, list[Recursive]]) -> dict[str, Any]:
    """Seconds after the bands' removal until each estimate stays near half its mean value from before."""
    out: dict[str, Any] = {}
    for n in (1, 2):
        for track in [_track(models[n]), *map(_as_track, forgotten[n])]:
            label = "sliding window" if track.label.startswith("window") else track.label
            out[f"model {n}, {label}"] = {
                "reached": convergence_time(track, 10.0, 0.0),
                "settled": convergence_time(track, 10.0, SETTLED),
            }
    return out


def convergence_time(track: Track, change: float, settled: float) -> float | None:
    """Seconds from `change` until the track is, for `settled` seconds, within 10 % of half its former mean.

    Samples that are NaN are skipped. None if that never happens.
    """
    before = track.stiffness[(track.time > 3.0) & (track.time < change)]
    target = 0.5 * np.nanmean(before)
    unknown = np.isnan(track.stiffness)
    near = unknown | (np.abs(track.stiffness - target) < CONVERGED * target)
    for start in np.flatnonzero(near & ~unknown & (track.time >= change)):
        stay = (track.time >= track.time[start]) & (track.time <= track.time[start] + settled)
        if near[stay].all() and track.time[-1] >= track.time[start] + settled:
            return float(track.time[start] - change)
    return None


def _draw_simulation(
    folder: Path, by_window: list[Estimates], by_method: list[Estimates], recursive: list[Recursive]
) -> None:
    truth = (np.array([0.0, 5.0, 5.0, 10.0]), np.array([1e-3, 1e-3, 2e-3, 2e-3]))
    time, unit = "time [s]", "stiffness [10⁻³ N m/rad]"
    limits = (0.5, 2.6)
    windows = [(t.label, t.time, 1e3 * t.stiffness) for t in map(_track, by_window)]
    forgetting = [(t.label, t.time, 1e3 * t.stiffness) for t in map(_as_track, recursive)]
    true = ("truth", truth[0], 1e3 * truth[1])
    figure = plots.curves(
        [
            plots.Panel("method 1, model 1: sliding windows", time, unit, [true, *windows], limits),
            plots.Panel("method 1, model 1: recursive least squares", time, unit, [true, *forgetting], limits),
        ]
    )
    _save(folder, "figure_2a", figure)
    methods = [(f"method {e.method}", e.end, 1e3 * _track(e).stiffness) for e in by_method]
    panel = plots.Panel("methods 1 to 4, windows of 2 s", time, unit, [true, *methods], limits)
    _save(folder, "figure_2b", plots.curves([panel]))


def _draw_bands(
    folder: Path,
    models: dict[int, Estimates],
    forgotten: dict[int, list[Recursive]],
    causal: dict[int, tuple[Numbers, Numbers, Numbers, float]],
) -> None:
    time, unit = "time [s] (simulated bands)", "stiffness [10⁻³ N m/rad]"
    truth = ("all bands taut", np.array([0.0, 10.0, 10.0, 20.0]), 1.13 * np.array([1.0, 1.0, 0.5, 0.5]))
    panels = []
    for n in (1, 2):
        tracks = [_track(models[n]), *map(_as_track, forgotten[n])]
        lines = [truth, *((t.label, t.time, 1e3 * t.stiffness) for t in tracks)]
        panels.append(plots.Panel(f"model {n} {'with' if n == 2 else 'without'} offset", time, unit, lines, (0.0, 2.0)))
    _save(folder, "figure_3a", plots.curves(panels))

    panels = []
    for n, estimates in models.items():
        threshold = np.full(len(estimates.end), estimates.threshold or np.nan)
        lines = [
            ("condition number", estimates.end, np.asarray(estimates.fit.cond)),
            ("threshold", estimates.end, threshold),
        ]
        panels.append(plots.Panel(f"model {n}", time, "condition number", lines, log=True))
    _save(folder, "figure_3b", plots.curves(panels))

    panels = []
    for n in (1, 2):
        seconds, torque, reconstructed, vaf = causal[n]
        lines = [("measured", seconds, 1e3 * torque), ("reconstructed", seconds, 1e3 * reconstructed)]
        title = f"model {n}: VAF {vaf:.1f} %"
        panels.append(plots.Panel(title, time, "human torque [10⁻³ N m]", lines))
    _save(folder, "figure_3c", plots.curves(panels))


def _save(folder: Path, name: str, figure: Any) -> None:
    (folder / f"{name}.png").write_bytes(plots.png(figure))


def _markdown(tables: dict[str, Any]) -> str:
    """The tables as Markdown."""
    paper, measured = tables["paper"], tables["measured"]
    lines = ["| | paper | here |", "| --- | --- | --- |"]

    def row(name: str, theirs: Any, ours: float | None, form: Callable[[float], str]) -> None:
        lines.append(
            f"| {name} | {'–' if theirs is None else form(theirs)} | {'never' if ours is None else form(ours)} |"
        )

    for name, times in measured["fig3a_convergence_s"].items():
        cells = ("never" if value is None else f"{value:.1f} s" for value in times.values())
        theirs = paper["convergence_s"].get(name)
        lines.append(
            f"| new stiffness reached / settled, {name} | {'–' if theirs is None else f'{theirs:.1f} s'} | "
            f"{' / '.join(cells)} |"
        )
    for name, ours in measured["fig3c_vaf_percent"].items():
        row(f"VAF, {name}", paper["vaf_percent"].get(name), ours, "{:.1f} %".format)
    theirs, ours = paper["natural_frequency_hz"], measured["natural_frequency_hz"]
    row("natural frequency of the rig", theirs, ours, "{:.2f} Hz".format)

    lines += ["", "| stiffness, 10⁻³ N m/rad | before (truth 1) | after (truth 2) |", "| --- | --- | --- |"]
    for group in ("fig2a_windows", "fig2a_windows_filtered_once", "fig2a_recursive", "fig2b_methods"):
        once = ", filtered once" if group.endswith("once") else ""
        for name, values in measured[group].items():
            before, after = (
                f"{1e3 * values[f'{part}_mean']:.3f} ± {1e3 * values[f'{part}_sd']:.3f}" for part in ("before", "after")
            )
            lines.append(f"| {name}{once} | {before} | {after} |")
    return "\n".join([*lines, "", *(f"- {reason}" for reason in tables["why_the_numbers_differ"]), ""])
