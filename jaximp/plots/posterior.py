"""Figures of posteriors: parameters pair by pair, over time, and ellipses of stiffness and damping."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from jaximp.plots.style import BLACK, BLUE, VERMILLION, WIDTH, cycle, draw_band, draw_line, styled
from jaximp.plots.style import LINES as STYLES
from jaximp.plots.wording import pretty_unit, words
from jaximp.posterior.draws import Posterior, PosteriorMany, index_of
from jaximp.types import AnyArray, Numbers

BANDS = (0.95, 0.5)
"""Probability within each shade, the palest first."""
SHADES = (0.22, 0.35)
"""Opacity of each shade; they lie on top of each other."""
CELLS = 48
"""Of a histogram, along each parameter."""
SMOOTH = 1.6
"""Cells: standard deviation of what smooths the histogram, so that contours are lines and not islands."""
SPAN, MARGIN = 0.002, 0.15
"""Share of the draws left out at either end of an axis, and how much wider than the others it then is."""
SMALL, ROOM = 5, 7
"""From so many parameters on the letters are smaller, and from so many the figure is larger."""
RAYS = 181
"""Directions in which ellipses are held against each other."""


@styled
def corner(
    posterior: Posterior,
    names: Sequence[str] | None = None,
    *,
    truth: Mapping[str, float] | None = None,
    other: Posterior | None = None,
) -> Figure:
    """Every parameter's marginal, and every pair's regions of highest density that hold 50 and 95 %.

    **Arguments:** `names` of the parameters shown, all without it; `truth` is drawn as black lines; `other` another
    posterior, drawn in outline over it.
    """
    names = list(names or posterior.names)
    columns = [index_of(posterior.names, name) for name in names]
    shown = [posterior.samples[:, columns]]
    if other is not None:
        shown.append(other.samples[:, [index_of(other.names, name) for name in names]])
    limits = np.stack([_limits(draws) for draws in shown])
    limits = np.stack([limits[:, 0].min(axis=0), limits[:, 1].max(axis=0)])
    n = len(names)
    size = WIDTH * max(1, n / ROOM)
    figure = Figure(figsize=(size, size if n > 2 else size * 0.7))
    panels = figure.subplots(n, n, squeeze=False)
    for i in range(n):
        for j in range(n):
            panel = panels[i, j]
            if j > i:
                panel.remove()
                continue
            panel.grid(False)
            for k, draws in enumerate(shown):
                if i == j:
                    _marginal(panel, draws[:, i], filled=k == 0)
                else:
                    _region(panel, draws[:, [j, i]], filled=k == 0)
            panel.set(xlim=tuple(limits[:, j]), ylim=(0, 1.08) if i == j else tuple(limits[:, i]))
            _truths(panel, truth or {}, names[j], names[i] if i != j else None)
            width = 40 if n < SMALL else 14
            labels = [f"{fill(words(names[k]), width)}\n({pretty_unit(posterior.units[columns[k]])})" for k in (j, i)]
            _label(panel, labels, n)
            _outer_only(panel, i, j, n)
    figure.align_labels()
    return figure


def _limits(draws: Numbers) -> Numbers:
    """(2, k) lower and upper ends of the axes of k parameters."""
    low, high = np.quantile(draws, [SPAN, 1 - SPAN], axis=0)
    margin = np.where(high > low, MARGIN * (high - low), 1e-12 + MARGIN * np.abs(high))
    return np.stack([low - margin, high + margin])


def _marginal(panel: Axes, x: Numbers, filled: bool) -> None:
    low, high = _limits(x)
    edges = np.linspace(low, high, CELLS + 1)
    density = gaussian_filter(np.histogram(x, edges)[0].astype(float), SMOOTH, mode="nearest")
    middle, height = (edges[1:] + edges[:-1]) / 2, density / density.max()
    if not filled:
        panel.plot(middle, height, color=VERMILLION, linewidth=1.0, linestyle="--")
        return
    for share, shade in zip(BANDS, SHADES, strict=True):
        ends = np.quantile(x, [0.5 - share / 2, 0.5 + share / 2])
        within = np.linspace(ends[0], ends[1], 99)
        panel.fill_between(within, np.interp(within, middle, height), color=BLUE, alpha=shade, linewidth=0)
    panel.plot(middle, height, color=BLUE, linewidth=1.0)


def _region(panel: Axes, xy: Numbers, filled: bool) -> None:
    """Contours of a smoothed histogram, at the heights above which lie 50 and 95 % of the draws."""
    low, high = _limits(xy)
    edges = [np.linspace(low[k], high[k], CELLS + 1) for k in (0, 1)]
    density = gaussian_filter(np.histogram2d(xy[:, 0], xy[:, 1], bins=edges)[0], SMOOTH, mode="nearest").T
    x, y = ((edge[1:] + edge[:-1]) / 2 for edge in edges)
    falling = np.sort(density, axis=None)[::-1]
    held = np.cumsum(falling) / falling.sum()
    levels = [float(falling[np.searchsorted(held, share)]) for share in BANDS]
    if not 0 < levels[0] < levels[1] < falling[0]:
        panel.plot(*xy.T, ".", color=BLUE, markersize=1)
    elif filled:
        for level, shade in zip(levels, SHADES, strict=True):
            panel.contourf(x, y, density, [level, falling[0]], colors=[BLUE], alpha=shade)
        panel.contour(x, y, density, levels, colors=[BLUE], linewidths=0.8)
    else:
        panel.contour(x, y, density, levels, colors=[VERMILLION], linewidths=0.9, linestyles="--")


def _truths(panel: Axes, truth: Mapping[str, float], x: str, y: str | None) -> None:
    if x in truth:
        panel.axvline(truth[x], color=BLACK, linewidth=0.8)
    if y is not None and y in truth:
        panel.axhline(truth[y], color=BLACK, linewidth=0.8)


def _label(panel: Axes, labels: Sequence[str], n: int) -> None:
    """Three numbers at most, slanted."""
    panel.locator_params(nbins=3)
    panel.ticklabel_format(useOffset=False)
    panel.tick_params(axis="x", rotation=40)
    panel.set_xlabel(labels[0], fontsize=6 if n >= SMALL else None)
    panel.set_ylabel(labels[1], fontsize=6 if n >= SMALL else None)
    if n >= SMALL:
        panel.tick_params(labelsize=6.5)
        for axis in (panel.xaxis, panel.yaxis):
            axis.get_offset_text().set_fontsize(6)


def _outer_only(panel: Axes, i: int, j: int, n: int) -> None:
    if i < n - 1:
        panel.set_xlabel("")
        panel.tick_params(labelbottom=False)
    if i == j:
        panel.set_ylabel("")
        panel.set_yticks([])
        panel.spines["left"].set_visible(False)
    elif j > 0:
        panel.set_ylabel("")
        panel.tick_params(labelleft=False)


@styled
def bands(
    time: Numbers,
    posteriors: PosteriorMany,
    names: Sequence[str] | None = None,
    *,
    truth: Mapping[str, Numbers] | None = None,
    trusted: AnyArray | None = None,
) -> Figure:
    """Parameters over time [s]: medians, with bands that hold 50 and 95 %.

    A window whose draws cannot be trusted is left out, and those that are not `trusted` (M,) for what else is known of
    them. `truth` holds values over the same time, drawn in black.
    """
    names = list(names or posteriors.names)
    trusted = posteriors.ok if trusted is None else posteriors.ok & np.asarray(trusted, bool)
    figure = Figure(figsize=(WIDTH, 1.7 * len(names) + 0.4))
    panels = figure.subplots(len(names), 1, squeeze=False, sharex=True)[:, 0]
    for panel, name in zip(panels, names, strict=True):
        k = index_of(posteriors.names, name)
        draws = np.where(trusted[:, None], posteriors.samples[..., k], np.nan)
        for share, shade in zip(BANDS, SHADES, strict=True):
            ends = np.full((2, len(draws)), np.nan)
            ends[:, trusted] = np.quantile(draws[trusted], [0.5 - share / 2, 0.5 + share / 2], axis=1)
            draw_band(panel, time, *ends, color=BLUE, alpha=shade, linewidth=0, label=f"{share:.0%} band")
        draw_line(panel, time, np.median(draws, axis=1), color=BLUE, label="median")
        if truth is not None and name in truth:
            draw_line(panel, time, truth[name], color=BLACK, linestyle="--", linewidth=0.9, label="truth")
        panel.set_ylabel(f"{words(name)}\n({pretty_unit(posteriors.units[k])})")
    panels[-1].set_xlabel("time (s)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    figure.align_ylabels(panels)
    return figure


@styled
def torque_bands(time: Numbers, torque: Numbers, bands: Numbers) -> Figure:
    """A torque (N,) over time [s], and quantiles (5, N) of what a posterior predicts: 2.5, 25, 50, 75 and 97.5 %."""
    figure = Figure(figsize=(WIDTH, 2.6))
    panel = figure.subplots()
    draw_band(panel, time, bands[0], bands[-1], color=BLUE, alpha=0.25, linewidth=0, label="95 % band")
    draw_line(panel, time, bands[len(bands) // 2], color=BLUE, label="predicted")
    draw_line(panel, time, torque, color=BLACK, linewidth=0.8, label="measured")
    panel.set(xlabel="time (s)", ylabel="torque (N m)", xlim=(time[0], time[-1]))
    figure.legend(*panel.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


@styled
def ellipse_bands(matrices: Mapping[str, Mapping[str, AnyArray]], units: Mapping[str, str] | None = None) -> Figure:
    """Ellipses of stiffness, damping, ... with bands that hold 50 and 95 % of the draws in every direction.

    The ellipse is `K u` of unit displacements u, drawn by its radius in each direction; of matrices that are not
    symmetric the symmetric part.

    **Arguments:** for each quantity, such as `stiffness`, draws (draws, 2, 2) by name, such as the state of the arm;
    `units` by quantity.
    """
    figure = Figure(figsize=(WIDTH, WIDTH / max(2, len(matrices)) + 0.4))
    panels = figure.subplots(1, len(matrices), squeeze=False)[0]
    angle = np.linspace(0, 2 * np.pi, 2 * RAYS - 1)
    rays = np.stack([np.cos(angle), np.sin(angle)])
    handles = {}
    for panel, (quantity, named) in zip(panels, matrices.items(), strict=True):
        largest = 0.0
        for (name, draws), (color, _) in zip(named.items(), cycle(STYLES, len(named)), strict=True):
            radius = _radius(np.asarray(draws), rays)
            for share, shade in zip(BANDS, SHADES, strict=True):
                low, high = np.quantile(radius, [0.5 - share / 2, 0.5 + share / 2], axis=0)
                outline = np.concatenate([rays * high, (rays * low)[:, ::-1]], axis=1)
                panel.fill(*outline, color=color, alpha=shade, linewidth=0)
                largest = max(largest, float(high.max()))
            handles[name] = panel.plot(*(rays * np.median(radius, axis=0)), color=color, label=name)[0]
        unit = f" ({pretty_unit(units[quantity])})" if units and quantity in units else ""
        room = 1.08 * largest
        panel.set(title=quantity, xlabel=f"joint 1{unit}", xlim=(-room, room), ylim=(-room, room), aspect="equal")
    panels[0].set_ylabel("joint 2")
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=max(1, len(handles)))
    return figure


def _radius(draws: Numbers, rays: Numbers) -> Numbers:
    """(draws, directions) how far the ellipse `{K u, |u| = 1}` reaches; zero across a singular matrix."""
    K = (draws + draws.swapaxes(1, 2)) / 2
    determinant = K[:, 0, 0] * K[:, 1, 1] - K[:, 0, 1] ** 2
    adjugate = np.stack([np.stack([K[:, 1, 1], -K[:, 0, 1]], -1), np.stack([-K[:, 0, 1], K[:, 0, 0]], -1)], -2)
    length = np.linalg.norm(adjugate @ rays, axis=1)
    return np.abs(determinant)[:, None] / np.where(length > 0, length, 1)
