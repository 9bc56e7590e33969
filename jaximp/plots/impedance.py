"""Figures of the impedance of an arm from perturbed movements: deviations, spectra, torques, windows, methods."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaximp.perturbation.impedance import ArmImpedance
from jaximp.perturbation.isolation.methods import METHODS
from jaximp.perturbation.stiffness import ELEMENTS, MATRICES, MATRIX_OF
from jaximp.perturbation.trials import VOLUNTARY_DELAY
from jaximp.perturbation.window_lengths import OtherWindows
from jaximp.plots.style import BLACK, BLUE, LINES, ORANGE, PALE, VERMILLION, WIDTH, draw_line, styled
from jaximp.plots.wording import pretty_unit
from jaximp.types import Numbers

SHOWN = 4
"""Trials whose torque is drawn."""
HIGHEST = 12.0
"""Of the spectra [Hz]: a movement, its surroundings, and where the high-pass cuts."""


@styled
def deviations(found: ArmImpedance) -> Figure:
    """What the perturbations changed of the hand's position and force, of all trials."""
    figure = Figure(figsize=(WIDTH, 3.6))
    panels = figure.subplots(2, 2, sharex=True)
    quantities = (("position", 1e3, "mm"), ("force", 1.0, "N"))
    for row, (name, scale, unit) in zip(panels, quantities, strict=True):
        for k, (panel, axis) in enumerate(zip(row, "xy", strict=True)):
            values = scale * np.asarray(getattr(found.curves.deviations, name), np.float64)[..., k]
            time = _milliseconds(values.shape[1], found)
            for j, trial in enumerate(values):
                color, style = LINES[j % 4]
                draw_line(panel, time, trial, color=color, linestyle=style, linewidth=0.7, alpha=0.7)
            panel.axhline(0, color=BLACK, linewidth=0.6)
            panel.set(ylabel=f"{name} {axis} ({unit})", xlim=(0, time[-1]))
    for panel in panels[-1]:
        panel.set_xlabel("time since the onset (ms)")
    panels[0, 0].set_title(f"unperturbed less perturbed, {found.trials} trials", loc="left")
    figure.align_ylabels()
    return figure


@styled
def jerk_spectra(spectra: tuple[Numbers, Numbers, Numbers], cutoff: Numbers | None) -> Figure:
    """Energy of the jerk of unperturbed trials, and what perturbed trials have more, with the cut-off frequencies."""
    frequency, without, with_it = spectra
    shown = (frequency > 0) & (frequency <= HIGHEST)
    figure = Figure(figsize=(WIDTH, 2.6))
    panels = figure.subplots(1, 2, sharey=True)
    largest = float(max(without[shown].max(), with_it[shown].max()))
    for k, (panel, axis) in enumerate(zip(panels, "xy", strict=True)):
        more = with_it[shown, k] - without[shown, k]
        panel.semilogy(frequency[shown], without[shown, k], color=BLACK, label="unperturbed")
        panel.semilogy(
            frequency[shown], np.where(more > 0, more, np.nan), color=BLUE, label="perturbed less unperturbed"
        )
        if cutoff is not None:
            panel.axvline(cutoff[k], color=VERMILLION, linestyle="--", label="cut-off")
            panel.set_title(f"axis {axis}: high-pass from {cutoff[k]:.3g} Hz on", loc="left")
        panel.set(xlabel="frequency (Hz)", xlim=(0, HIGHEST), ylim=(1e-6 * largest, 3 * largest))
        panel.minorticks_off()
    panels[0].set_ylabel("energy spectral density\nof the jerk (m²/s⁴)")
    _legend_below(figure, panels[0])
    return figure


@styled
def joint_torques(found: ArmImpedance) -> Figure:
    """Isolated torque of both joints against that of damping and stiffness, in a few trials."""
    torque, model = np.asarray(found.curves.joint.torque), found.curves.model_torque(found.D, found.K)
    trials = np.unique(np.linspace(0, len(torque) - 1, SHOWN).astype(int))
    figure = Figure(figsize=(WIDTH, 3.6))
    panels = figure.subplots(2, len(trials), sharex=True, sharey="row", squeeze=False)
    time = _milliseconds(torque.shape[1], found)
    for column, trial in enumerate(trials):
        for joint in range(2):
            panel = panels[joint, column]
            draw_line(panel, time, torque[trial, :, joint], color=BLACK, linewidth=1.4, label="isolated")
            draw_line(panel, time, model[trial, :, joint], color=VERMILLION, linestyle="--", label="model")
            panel.set_xlim(0, time[-1])
        panels[0, column].set_title(f"perturbed trial {trial + 1}", loc="left")
    for joint, panel in enumerate(panels[:, 0]):
        panel.set_ylabel(f"torque of joint {joint + 1} (N m)")
    for panel in panels[-1]:
        panel.set_xlabel("since the onset (ms)")
    figure.align_ylabels()
    _legend_below(figure, panels[0, 0])
    return figure


@styled
def impedance_windows(windows: OtherWindows, chosen: float, level: float = 0.95) -> Figure:
    """Every element from windows of other lengths, with its interval; lines mark the job's and the voluntary delay."""
    figure = Figure(figsize=(WIDTH, 3.8))
    panels = _element_panels(figure, windows.names)
    low, high = windows.interval(level)
    length = 1e3 * windows.window
    for k, name in enumerate(windows.names):
        panel, theta = panels[name], windows.theta[:, k]
        panel.fill_between(
            length, low[:, k], high[:, k], color=BLUE, alpha=0.25, linewidth=0, label=f"{level:.0%} interval"
        )
        draw_line(panel, length, theta, color=BLUE, label="estimate")
        panel.axvline(1e3 * VOLUNTARY_DELAY, color=VERMILLION, linestyle="--", label="voluntary delay")
        if abs(chosen - VOLUNTARY_DELAY) > 1e-3:
            panel.axvline(1e3 * chosen, color=ORANGE, linestyle=":", label="window of the job")
        at_chosen = int(np.abs(windows.window - chosen).argmin())
        panel.set(xlim=(length[0], length[-1]), ylim=_limits(theta, low[:, k], high[:, k], at_chosen))
    for name in windows.names:
        if MATRIX_OF[name] == "stiffness":
            panels[name].set_xlabel("window (ms)")
    _legend_below(figure, panels[windows.names[0]])
    return figure


@styled
def impedance_methods(several: Sequence[ArmImpedance], level: float = 0.95) -> Figure:
    """Every element by several methods, with its interval; pale where the estimate is not trusted."""
    names = [name for name in ELEMENTS if any(name in one.names for one in several)]
    figure = Figure(figsize=(WIDTH, 3.8))
    panels = _element_panels(figure, names)
    for name in names:
        for place, one in enumerate(several):
            if name not in one.names:
                continue
            k = one.names.index(name)
            low, high = (end[k] for end in one.interval(level))
            color = BLUE if one.trusted else PALE
            panels[name].plot(place, one.theta[k], "o", color=color, markerfacecolor=color if one.trusted else "white")
            if np.isfinite([low, high]).all():
                panels[name].plot([place, place], [low, high], color=color)
        shorts = [METHODS[one.method].short for one in several]
        panels[name].set(xticks=range(len(several)), xticklabels=shorts, xlim=(-0.6, len(several) - 0.4))
        panels[name].grid(visible=False, axis="x")
    return figure


def _milliseconds(samples: int, found: ArmImpedance) -> Numbers:
    """Since the onset."""
    return np.asarray(1e3 * np.arange(samples) / found.curves.sample_rate, np.float64)


def _element_panels(figure: Figure, names: Sequence[str]) -> dict[str, Axes]:
    """A row of the elements of the damping above one of the stiffness's."""
    columns = 4
    panels = figure.subplots(2, columns, sharex=True)
    found: dict[str, Axes] = {}
    for row, (matrix, unit) in zip(panels, MATRICES.items(), strict=True):
        wanted = [name for name in ELEMENTS if name in names and MATRIX_OF[name] == matrix]
        for panel, name in zip(row, wanted, strict=False):
            panel.set_title(name.replace("_", " "), loc="left")
            found[name] = panel
        for panel in row[len(wanted) :]:
            panel.remove()
        row[0].set_ylabel(f"{matrix} ({pretty_unit(unit)})")
        if len(wanted) < columns:  # the panel above the missing one has the ticks of its column
            panels[0, -1].tick_params(labelbottom=True)
    figure.align_ylabels()
    return found


def _limits(theta: Numbers, low: Numbers, high: Numbers, chosen: int) -> tuple[float, float] | None:
    """What shows all estimates, and no more of the intervals of short windows than is of use."""
    if not np.isfinite(theta[chosen]):
        return None
    half = 4 * (high[chosen] - low[chosen]) if np.isfinite(high[chosen] - low[chosen]) else np.inf
    near = np.abs(theta - theta[chosen]) <= half
    ends: Any = np.concatenate([theta[near], [low[chosen], high[chosen]], theta[chosen] + np.array([-0.1, 0.1])])
    ends = ends[np.isfinite(ends)]
    margin = 0.25 * (ends.max() - ends.min())
    return float(ends.min() - margin), float(ends.max() + margin)


def _legend_below(figure: Figure, panel: Axes) -> None:
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), columnspacing=1.5)
