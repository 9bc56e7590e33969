"""Figures of a robot from its URDF."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaximp.identification.estimates import Estimates
from jaximp.models.chain import Chain
from jaximp.plots.style import BLUE, ORANGE, PALE, WIDTH, Numbers, styled
from jaximp.plots.wording import pretty_unit
from jaximp.types import AnyArray

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
