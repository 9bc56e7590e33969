"""Figure of a designed motion."""

from __future__ import annotations

from textwrap import fill
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaximp.design.excitation import Design
from jaximp.motion.trajectories import FourierSeries
from jaximp.plots.style import BLACK, LINES, WIDTH, draw_line, styled

TITLE = 95
"""Letters of a title's line."""
UNITS = {"position": "rad", "velocity": "rad/s", "acceleration": "rad/s²", "torque": "N m"}


@styled
def design(found: Design) -> Figure:
    """A designed motion with its limits, its spectrum, and the condition number over sliding windows."""
    n, series = found.model.n_joints, found.trajectory
    motion = found.sampled(max(200.0, 40 * float(series.highest_frequency)))
    names = [name for name in ("position", "velocity", "acceleration", "torque") if name in motion]
    figure = Figure(figsize=(WIDTH, 1.5 * len(names) + 4.2))
    *axes, spectrum, condition = figure.subplots(len(names) + 2, 1)
    for axis, name in zip(axes, names, strict=True):
        for j, x in enumerate(motion[name].reshape(len(motion["time"]), n).T):
            color, style = _line(j)
            draw_line(axis, motion["time"], x, color=color, linestyle=style, label=f"joint {j + 1}")
        limit = getattr(found.limits, name)
        ends = limit if name == "position" else (-np.asarray(limit), np.asarray(limit))
        for end in np.broadcast_arrays(*ends):
            _limits(axis, np.broadcast_to(np.ravel(end), n))
        axis.set(ylabel=f"{name}\n({UNITS[name]})", xlim=(0, found.period))
        axis.tick_params(labelbottom=axis is axes[-1])
    title = fill(f"One period; dotted: limits. Reached: {found.limits_reached()}", TITLE)
    axes[0].set_title(title)
    axes[-1].set_xlabel("time (s)")
    if n > 1:
        axes[0].legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    _harmonics(spectrum, series)
    _sliding_condition(condition, found)
    return figure


def _limits(axis: Axes, ends: np.ndarray) -> None:
    """Dotted; each joint's in its own color where they differ."""
    alike = (ends == ends[0]).all()
    for j, value in enumerate(ends[:1] if alike else ends):
        if np.isfinite(value):
            axis.axhline(value, color=BLACK if alike else _line(j)[0], linestyle=":", linewidth=0.8 if alike else 1.1)


def _line(j: int) -> tuple[str, Any]:
    """Color and dashes of a joint; more joints than colors have them again with other dashes."""
    return LINES[j % len(LINES)][0], LINES[(j + j // len(LINES)) % len(LINES)][1]


def _harmonics(panel: Axes, series: FourierSeries) -> None:
    amplitude = np.atleast_2d(np.hypot(series.sine, series.cosine))
    count, period = amplitude.shape[1], float(series.period)
    frequency = np.arange(1, count + 1) / period
    width = 0.8 / len(amplitude) / period
    for j, row in enumerate(amplitude):
        at = frequency + (j - (len(amplitude) - 1) / 2) * width
        panel.bar(at, row, width, color=_line(j)[0], hatch="////" * (j // len(LINES)), edgecolor="white", linewidth=0)
    panel.set(title="Amplitude of the velocity", xlabel="frequency (Hz)", ylabel="velocity (rad/s)")
    panel.set_xlim(0, (count + 1) / period)


def _sliding_condition(panel: Axes, found: Design) -> None:
    lengths = [found.window] if found.window else [found.period / 10, found.period / 5, found.period / 2]
    for k, length in enumerate(lengths):
        color, style = LINES[k % len(LINES)]
        draw_line(panel, *found.sliding_condition(length), color=color, linestyle=style, label=f"{length:g} s")
    panel.axhline(found.condition, color=BLACK, linewidth=0.8, label="whole period")
    panel.set(
        title="Condition number of sliding windows",
        xlabel="end of the window (s)",
        xlim=(0, found.period),
        yscale="log",
    )
    panel.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
