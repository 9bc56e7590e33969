"""Figures that a reader can zoom and hover over, drawn by Bokeh without any server: what all of them share.

Callbacks run in the page: no network, no server. `interactive_windows` and `interactive_arm` draw them. Colours, limits
and envelopes are those of the printed figures.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np
from bokeh.core.json_encoder import serialize_json
from bokeh.document import Document
from bokeh.events import DoubleTap
from bokeh.layouts import gridplot
from bokeh.models import (
    BoxZoomTool,
    CustomJS,
    CustomJSTickFormatter,
    GridPlot,
    PanTool,
    PlainText,
    ResetTool,
    SaveTool,
    Title,
    UIElement,
    WheelZoomTool,
)
from bokeh.plotting import figure
from bokeh.plotting import figure as Plot
from numpy.typing import NDArray

from jaximp.types import AnyArray

GREY = "#8c8c8c"
LEFT, BELOW, TOOLBAR = 74, 34, 30
"""Room for the numbers beside an axis, the same for all panels, below the last one, and for the tools [px]."""

TICKS = """
const size = Math.abs(tick);
if (size === 0 || (size >= 1e-3 && size < 1e5)) return String(Number(tick.toPrecision(6))).replace("-", "−");
const [mantissa, exponent] = tick.toExponential(3).split("e");
const raised = String(Number(exponent)).replace(/./g, (c) => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(c)]);
return `${String(Number(mantissa)).replace("-", "−")}×10${raised}`;
"""


@dataclass(frozen=True)
class Key:
    """One entry of a figure's key: a `line`, `dash`, `dots`, `band` or `shade`, its colour and what it stands for."""

    kind: str
    color: str
    text: str


@dataclass(frozen=True)
class Live:
    """A figure for a page."""

    root: GridPlot
    key: Sequence[Key] = ()
    beside: UIElement | None = None
    """The torque of the window that was picked."""
    hint: str = "Drag to zoom, double-click to zoom out, or turn the wheel with Ctrl."

    @property
    def height(self) -> int:
        """[px]"""
        rows = {row: plot.height for plot, row, _ in self.root.children}
        return sum(rows.values()) + TOOLBAR


def empty_panel(height: int, x: Any, y: Any, label: str, above: bool = False, log: bool = False) -> Plot:
    """An empty panel as wide as there is room; a label that is long stands above it."""
    plot = figure(
        height=height, sizing_mode="stretch_width", x_range=x, y_range=y, y_axis_type="log" if log else "linear",
        tools="", toolbar_location=None, min_border_left=LEFT, min_border_right=12, min_border_top=4,
    )  # fmt: skip
    if above:
        plot.add_layout(Title(text=PlainText(label), text_font_size="13px", text_font_style="normal"), "above")
    else:
        plot.yaxis.axis_label = PlainText(label)
    plot.axis.axis_label_text_font_style = "normal"
    plot.axis.axis_label_text_font_size = plot.axis.major_label_text_font_size = "12px"
    plot.axis.axis_line_color = plot.axis.major_tick_line_color = "#555555"
    plot.axis.minor_tick_line_color = None
    plot.grid.grid_line_color = "#e2e2e2"
    plot.outline_line_color = None
    if not log:
        plot.yaxis.ticker.desired_num_ticks = 4
        plot.yaxis.formatter = CustomJSTickFormatter(code=TICKS)
    zoom, wheel = BoxZoomTool(), WheelZoomTool(modifiers={"ctrl": True})
    plot.add_tools(zoom, PanTool(), wheel, ResetTool(), SaveTool())
    plot.toolbar.active_drag, plot.toolbar.active_scroll = zoom, wheel
    plot.js_on_event(DoubleTap, CustomJS(args={"plot": plot}, code="plot.reset.emit()"))
    return plot


def label_below(plot: Plot, label: str) -> None:
    """A label of the x axis, or no numbers where it is that of the panel below."""
    if label:
        plot.xaxis.axis_label = label
    else:
        plot.xaxis.major_label_text_font_size = "0px"


def grid_of(rows: Sequence[Sequence[Plot]], tools: bool = True) -> GridPlot:
    """Panels side by side, with one bar of tools for all."""
    where = "above" if tools else None
    return gridplot([list(row) for row in rows], sizing_mode="stretch_width", toolbar_location=where,
                    toolbar_options={"logo": None})  # fmt: skip


def packed(values: AnyArray) -> NDArray[np.float32]:
    """Half the size of a page; a screen shows no more digits. What is too large for them is infinite."""
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(values, np.float32)


def document(figures: Mapping[str, Live]) -> tuple[dict[str, Any], dict[str, str]]:
    """What BokehJS makes the figures of, and the root of each place: `NAME`, and `NAME-beside` where there is one."""
    made, places = Document(), {}
    for name, live in figures.items():
        for place, root in ((name, live.root), (f"{name}-beside", live.beside)):
            if root is not None:
                made.add_root(root)
                places[place] = root.id
    return json.loads(serialize_json(made.to_json(deferred=False))), places


def script() -> str:
    """BokehJS itself, without its extra bundles."""
    return resources.files("bokeh").joinpath("server", "static", "js", "bokeh.min.js").read_text(encoding="utf-8")
