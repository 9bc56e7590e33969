"""Figures of a robot from its URDF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Num
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaximp.identification.estimates import Estimates
from jaximp.identification.payload import Payload
from jaximp.identification.quantities import Quantities
from jaximp.models import rigid_body
from jaximp.models.chain import Chain
from jaximp.plots.style import BLACK, BLUE, GREEN, ORANGE, PALE, VERMILLION, WIDTH, Numbers, styled
from jaximp.plots.wording import pretty_unit, with_unit
from jaximp.types import AnyArray

ACROSS = 4
"""Panels side by side, of quantities by several methods."""
POSES = 5
"""Of a motion, that are drawn."""
WIDE = 30.0
"""Where the largest value is so many times the usual one, an axis is logarithmic beyond the usual error."""
KINDS = {
    "link_mass": "masses",
    "first_moment": "first moments",
    "link_inertia": "inertias",
    "rotor_inertia": "rotor inertias",
    "friction": "friction",
    "offset": "constant torques",
}
"""Of the roles of parameters, in the order of the panels."""


@styled
def parameters_against_urdf(estimates: Estimates, level: float = 0.95) -> Figure:
    """Every parameter of a robot with its confidence interval, beside the value of the URDF. What cannot be trusted is
    pale. Where sizes differ widely an axis is logarithmic beyond the usual error.

    **Raises:** `ValueError` for estimates of anything else than a robot from its URDF.
    """
    model = estimates.model
    if not isinstance(model, Chain):
        raise ValueError("these are not the parameters of a robot from its URDF: use parameters_over_time")
    panels = _panels(model)
    rows = [len(which) for _, _, which in panels]
    columns = _in_two_columns(rows)
    heights = [sum(rows[k] + 3 for k in column) for column in columns]
    figure = Figure(figsize=(WIDTH, 0.155 * max(heights) + 0.6))
    low, high = (end.mean(axis=0) for end in estimates.interval(level))
    trusted = np.array([estimates.trusted_in(name).all() for name in estimates.names])
    for side, column in enumerate(columns):
        ratios = [rows[k] + 2 for k in column]
        inner = figure.add_gridspec(1, len(columns))[side].subgridspec(len(column), 1, height_ratios=ratios)
        for place, k in enumerate(column):
            title, unit, which = panels[k]
            panel = figure.add_subplot(inner[place])
            _intervals(panel, estimates, model, which, (low, high), trusted)
            panel.set_title(f"{title} ({pretty_unit(unit)})", loc="left")
    drawn = max(figure.axes, key=lambda panel: len(panel.get_legend_handles_labels()[0]))
    figure.legend(*drawn.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def _panels(model: Chain) -> list[tuple[str, str, list[int]]]:
    """Title, unit, and the parameters of each panel: of one kind and unit."""
    found: dict[tuple[str, str], list[int]] = {}
    for k, (role, unit) in enumerate(zip(model.roles, model.units, strict=True)):
        found.setdefault((KINDS[role.kind], unit), []).append(k)
    order = list(KINDS.values())
    return [(*key, which) for key, which in sorted(found.items(), key=lambda item: order.index(item[0][0]))]


def _in_two_columns(rows: list[int]) -> list[list[int]]:
    """Panels in their order, so shared out that both columns are about as high."""
    if len(rows) == 1:
        return [[0]]
    height = np.cumsum([row + 3 for row in rows])
    split = int(np.argmin(np.abs(height - height[-1] / 2)[:-1])) + 1
    return [list(range(split)), list(range(split, len(rows)))]


def _intervals(
    panel: Axes,
    estimates: Estimates,
    model: Chain,
    which: list[int],
    ends: tuple[Numbers, Numbers],
    trusted: AnyArray,
) -> None:
    """One row for each parameter, the first on top."""
    value, place = estimates.value.mean(axis=0)[which], np.arange(len(which))
    low, high = (end[which] for end in ends)
    for chosen, color, label in (
        (trusted[which], BLUE, "estimate, 95 %"),
        (~trusted[which], PALE, "not to be trusted"),
    ):
        if chosen.any():
            reach = np.stack([value - low, high - value])[:, chosen]
            panel.errorbar(
                value[chosen], place[chosen], xerr=reach, fmt="o", color=color, capsize=2, markersize=3, label=label
            )
    own = model.parameters[which]
    panel.plot(own, place, "d", color=ORANGE, markersize=4, zorder=1.5, label="URDF")
    largest, error = np.abs([value, own]).max(), float(np.nanmedian(high - low)) / 2
    if largest > WIDE * np.median(np.abs(value)) and largest > WIDE * error > 0:
        panel.set_xscale("symlog", linthresh=error, linscale=0.5)
        decades = 10.0 ** np.arange(np.ceil(np.log10(5 * error)), np.ceil(np.log10(largest)) + 1)
        least = min(value.min(), own.min())
        panel.set_xticks([*(-decades[-decades > 2 * least][::-1]), 0, *decades])
    panel.axvline(0, color=PALE, linewidth=0.6)
    panel.set_yticks(place, [model.names[k] for k in which])
    panel.set_ylim(len(which) - 0.4, -0.6)


@styled
def load_by_method(loads: Sequence[Payload]) -> Figure:
    """Mass and centre of mass of a load by several methods, with intervals of 95 %."""
    masses, centres = [_three(load, 0) for load in loads], [load.centre for load in loads]
    panels = {"mass (kg)": np.array(masses)}
    panels |= {f"centre, {axis} (mm)": 1e3 * np.array([_three(c, k) for c in centres]) for k, axis in enumerate("xyz")}
    return _by_method([f"method {load.method}" for load in loads], panels)


@styled
def parameters_by_method(several: Sequence[Estimates]) -> Figure:
    """All parameters of one window by several methods, with intervals of 95 %; pale where they cannot be trusted."""
    named = list(zip(several[0].names, several[0].units, strict=True))
    panels = {
        with_unit(name, unit): np.array([_three(one, (0, k)) for one in several])
        for k, (name, unit) in enumerate(named)
    }
    trusted = np.array([[one.trusted_in(name)[0] for one in several] for name, _ in named])
    return _by_method([f"method {one.method}" for one in several], panels, trusted)


def _three(of: Quantities | Estimates, k: int | tuple[int, int]) -> list[float]:
    """Lower end, value and upper end of one number."""
    low, high = of.interval()
    return [float(x[k]) for x in (low, of.value, high)]


def _by_method(labels: Sequence[str], panels: Mapping[str, Numbers], trusted: AnyArray | None = None) -> Figure:
    """A panel for each quantity, whose rows (methods, 3) are lower end, value and upper end."""
    rows, place = -(-len(panels) // ACROSS), np.arange(len(labels))
    figure = Figure(figsize=(WIDTH, rows * (0.75 + 0.2 * len(labels)) + 0.15))
    axes = figure.subplots(rows, ACROSS, sharey=True, squeeze=False).ravel()
    for k, (panel, (title, ends)) in enumerate(zip(axes, panels.items(), strict=False)):
        sure = np.ones(len(ends), bool) if trusted is None else trusted[k]
        for which, color in ((sure, BLUE), (~sure, PALE)):
            low, value, high = ends[which].T
            reach = np.stack([value - low, high - value])
            panel.errorbar(value, place[which], xerr=reach, fmt="o", color=color, capsize=2, markersize=3)
        panel.set_title(title, loc="left")
        panel.margins(x=0.15)
        panel.locator_params(axis="x", nbins=3)
    for panel in axes[len(panels) :]:
        panel.remove()
    axes[0].set_yticks(place, labels)
    axes[0].set_ylim(len(labels) - 0.4, -0.6)
    return figure


@styled
def robot(model: Chain, q: Num[AnyArray, "*N n"] | None = None) -> Figure:
    """A robot's joints and how its links join them, from the side and from above.

    **Arguments:** `q` (n,) the position to draw [rad or m], all zero by default; or a motion (N, n), of which the path
    of the tip and five positions are drawn, the first of them dark.
    """
    motion = np.atleast_2d(np.zeros(model.n_joints) if q is None else np.asarray(q, float))
    if model.n_joints == 1 and motion.shape[0] == 1:
        motion = motion.T
    shown = np.unique(np.linspace(0, len(motion) - 1, POSES).astype(int))
    origins = np.asarray(rigid_body.body_frames(model.tree, motion)[1])
    path = None if model.tip is None else np.asarray(model.forward_kinematics(motion)[1])
    figure = Figure(figsize=(WIDTH, 0.62 * WIDTH))
    views = figure.subplots(1, 2)
    for panel, up, title in zip(views, (2, 1), ("from the side", "from above"), strict=True):
        for k in shown[::-1]:
            _skeleton(panel, model, origins[k], None if path is None else path[k], up, faded=bool(k != shown[0]))
        if path is not None and len(path) > 1:
            panel.plot(path[:, 0], path[:, up], color=GREEN, linewidth=0.8, label="path of the tip")
        panel.set(xlabel="x (m)", ylabel=f"{'xyz'[up]} (m)", aspect="equal")
        panel.margins(0.1)
        panel.set_title(title, loc="left")
    figure.legend(*views[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def _skeleton(panel: Axes, model: Chain, origins: Numbers, tip: Numbers | None, up: int, faded: bool) -> None:
    """Lines from each joint to those that it bears, in the plane of x and one other axis."""
    look: Any = {"color": PALE if faded else BLACK, "alpha": 0.4 if faded else 1.0, "linewidth": 1.0 if faded else 2.0}
    for k, parent in enumerate(model.tree.parents):
        start = np.zeros(3) if parent < 0 else origins[parent]
        panel.plot([start[0], origins[k][0]], [start[up], origins[k][up]], **look)
    if tip is not None:
        start = np.zeros(3) if model.tree.tip_body < 0 else origins[model.tree.tip_body]
        panel.plot([start[0], tip[0]], [start[up], tip[up]], **look)
        if not faded:
            panel.plot(tip[0], tip[up], "s", color=VERMILLION, label="tip")
    if not faded:
        panel.plot(origins[:, 0], origins[:, up], "o", color=BLUE, label="joint")
