"""Interactive figures of an arm: deviations of perturbed trials, and ellipses at the hand."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np
from bokeh.models import (
    ColumnDataSource,
    DataRange1d,
    HoverTool,
    Label,
    MultiLine,
    PlainText,
    Range1d,
    Span,
    TapTool,
)
from bokeh.plotting import figure as Plot

from jaximp.models.endpoint import EndpointImpedance, ellipse
from jaximp.models.kinematics import ArmGeometry
from jaximp.plots.arm import ESTIMATES, QUANTITIES, SHARE, elbow_and_hand, limits_of, round_length
from jaximp.plots.interactive import BELOW, GREY, Key, Live, empty_panel, grid_of, label_below, packed
from jaximp.plots.style import BLACK, LINES, cycle
from jaximp.plots.wording import number
from jaximp.types import Numbers

TRIAL_SAMPLES = (20, 30_000)
"""Samples of a trial at least, and of all trials together, if they have as many."""


def deviations(position: Numbers, force: Numbers, sample_rate: float) -> Live:
    """What the perturbations changed at the hand in every trial, from the onset on. A click on a trial marks it.

    **Arguments:** (T, S, 2) differences of the position [m] and of the force [N].
    """
    trials, samples = position.shape[:2]
    few = max(TRIAL_SAMPLES[0], TRIAL_SAMPLES[1] // trials)
    kept = np.unique(np.linspace(0, samples - 1, min(few, samples)).astype(int))
    time = packed(1e3 * kept / sample_rate)
    columns: dict[str, Any] = {"trial": [k + 1 for k in range(trials)], "time": [time] * trials}
    columns["color"] = [color for color, _ in cycle(LINES[:4], trials)]
    quantities = [(f"position {axis} (mm)", 1e3 * position[:, kept, k]) for k, axis in enumerate("xy")]
    quantities += [(f"force {axis} (N)", force[:, kept, k]) for k, axis in enumerate("xy")]
    columns |= {f"y{k}": [packed(row) for row in values] for k, (_, values) in enumerate(quantities)}
    source, x, panels = ColumnDataSource(columns), Range1d(0, float(time[-1])), []
    for k, (label, values) in enumerate(quantities):
        finite = values[np.isfinite(values)]
        low, high = (float(finite.min()), float(finite.max())) if len(finite) else (-1.0, 1.0)
        margin = 0.08 * (high - low) or 1.0
        plot = empty_panel(210 + BELOW * (k > 1), x, Range1d(low - margin, high + margin), label, above=True)
        label_below(plot, "time since the onset (ms)" if k > 1 else "")
        plot.add_layout(Span(location=0, dimension="width", line_color=BLACK, line_width=1))
        lines = plot.multi_line("time", f"y{k}", source=source, color="color", line_width=1.2, line_alpha=0.7)
        lines.hover_glyph = MultiLine(xs="time", ys=f"y{k}", line_color="color", line_width=3)
        lines.selection_glyph = MultiLine(xs="time", ys=f"y{k}", line_color="color", line_width=3)
        lines.nonselection_glyph = MultiLine(xs="time", ys=f"y{k}", line_color=GREY, line_width=1, line_alpha=0.35)
        tooltip = "<div>perturbed trial <b>@trial</b>, $x{0.0} ms</div>"
        plot.add_tools(
            HoverTool(renderers=[lines], tooltips=tooltip, line_policy="nearest"), TapTool(renderers=[lines])
        )
        panels.append(plot)
    return Live(grid_of([panels[:2], panels[2:]]), hint=f"{Live.hint} Click a trial to mark it in all panels.")


def ellipses(geometry: ArmGeometry, q: Numbers, estimates: Mapping[str, EndpointImpedance]) -> Live:
    """Ellipses of inertia, damping and stiffness at the hand, as `plots.ellipses`; both axes have the same scale."""
    elbow, hand = elbow_and_hand(geometry, np.asarray(q))
    corners = np.stack([np.zeros(2), elbow, hand])
    half_axis = SHARE * sum(geometry.lengths)
    low, high = limits_of(corners, half_axis)
    panels = [
        _ellipse_panel(quantity, unit, estimates, corners, half_axis, (low, high))
        for quantity, unit in QUANTITIES.items()
    ]
    dashes = ("line", "dash", "dots", "dash")
    key = [Key(dashes[k % 4], ESTIMATES[k % 4][0], name) for k, name in enumerate(estimates)]
    return Live(grid_of([panels]), [*key, Key("line", GREY, "the arm, from the shoulder to the hand")])


def _ellipse_panel(
    quantity: str,
    unit: str,
    estimates: Mapping[str, EndpointImpedance],
    corners: Numbers,
    half_axis: float,
    limits: tuple[Numbers, Numbers],
) -> Plot:
    plot = empty_panel(
        280, DataRange1d(range_padding=0), DataRange1d(range_padding=0), f"{quantity}, y (m)", above=True
    )
    plot.match_aspect = True
    plot.xaxis.axis_label = "x (m)"
    plot.scatter(*np.stack(limits).T, alpha=0)  # so that all panels show as much
    plot.line(*corners.T, color="#b0b0b0", line_width=4)
    plot.scatter(*corners.T, color="#b0b0b0", size=8)
    found = {name: ellipse(getattr(one, quantity)) for name, one in estimates.items()}
    outlines = {name: np.asarray(one.outline(100)) for name, one in found.items()}
    outlines = {name: line for name, line in outlines.items() if np.isfinite(line).all()}
    largest = max((float(np.hypot(*line.T).max()) for line in outlines.values()), default=1.0)
    scale = half_axis / largest if largest else 1.0
    for k, name in enumerate(estimates):
        if name not in outlines:
            continue
        x, y = (corners[-1] + scale * outlines[name]).T
        told = [name, *(number(float(v), 3) for v in (found[name].major, found[name].minor))]
        told.append(number(float(np.degrees(found[name].orientation)), 3))
        source = ColumnDataSource(
            {"x": packed(x), "y": packed(y)} | {f"t{i}": [text] * len(x) for i, text in enumerate(told)}
        )
        color, dash = ESTIMATES[k % 4][0], ("solid", "dashdot", "dotted", "dashed")[k % 4]
        line = plot.line("x", "y", source=source, color=color, line_dash=dash, line_width=2)
        text = f"<div><b>@t0</b><br>half axes @t1 and @t2 {escape(unit)}<br>the longer one at @t3°</div>"
        plot.add_tools(HoverTool(renderers=[line], tooltips=text))
    size = round_length(largest) if largest else 0.0
    x0, y0 = limits[0] + 0.03
    plot.line([x0, x0 + size * scale], [y0, y0], color=BLACK, line_width=3)
    plot.add_layout(Label(x=x0, y=y0 + 0.012, text=PlainText(f"{size:g} {unit}"), text_font_size="12px"))
    return plot
