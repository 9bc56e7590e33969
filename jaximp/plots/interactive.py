"""Figures that a reader can zoom, hover over and ask about a window, drawn by Bokeh without any server.

Every function returns `Live` figures by name. Figures over time share one axis of time; a click picks the window whose
middle is nearest, marks it in all of them, cuts its torque out into a figure of its own, and tells the page about it
with the DOM event `jaximp-window`. Callbacks run in the page: no network, no server.
Colours, limits and envelopes are those of the printed figures.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib import resources
from typing import Any

import numpy as np
from bokeh.core.json_encoder import serialize_json
from bokeh.document import Document
from bokeh.events import DoubleTap, MouseLeave, MouseMove, Tap
from bokeh.layouts import gridplot
from bokeh.models import (
    BoxZoomTool,
    ColumnDataSource,
    CustomJS,
    CustomJSTickFormatter,
    DataRange1d,
    GlyphRenderer,
    GridPlot,
    HoverTool,
    Label,
    MultiLine,
    PanTool,
    PlainText,
    Range1d,
    ResetTool,
    SaveTool,
    Span,
    TapTool,
    Title,
    UIElement,
    VStrip,
    WheelZoomTool,
)
from bokeh.plotting import figure
from bokeh.plotting import figure as Plot
from numpy.typing import NDArray

from jaximp.models.endpoint import EndpointImpedance, ellipse
from jaximp.models.kinematics import ArmGeometry
from jaximp.plots.arm import ESTIMATES, QUANTITIES, SHARE, elbow_and_hand, limits_of, round_length
from jaximp.plots.estimates import SHADES, stretches, torque_limits
from jaximp.plots.style import (
    BLACK,
    BLUE,
    LINES,
    ORANGE,
    VERMILLION,
    alone,
    believed,
    beyond,
    bins,
    cycle,
    decade_limits,
    envelope,
)
from jaximp.plots.wording import number, pretty_unit, with_unit, words
from jaximp.trust.verdicts import NO_DATA, TRUSTED
from jaximp.types import AnyArray, Numbers

WINDOWS = 2000
"""Windows that can be picked. Of more, every so many; lines then are the envelope of all."""
SAMPLES = 16_000
"""Torque samples in a page, of all joints together; longer recordings are drawn as envelopes."""
TRIAL_SAMPLES = (20, 30_000)
"""Samples of a trial at least, and of all trials together, if they have as many."""
GREY, HATCH = "#8c8c8c", "#c4c4c4"
MODELS = ((BLUE, "solid"), (VERMILLION, "dashed"))
"""Colour and line of what models make of the torque."""
MARKERS = ("circle", "square", "triangle", "diamond", "inverted_triangle")
SHADE_NAMES = {"/": "rising", "\\": "falling", "x": "crossed", ".": "dotted"}
"""Of the hatches, as the page's style sheet calls them."""
LEFT, BELOW, TOOLBAR = 74, 34, 30
"""Room for the numbers beside an axis, the same for all panels, below the last one, and for the tools [px]."""
FEW = 60
"""Of so many windows each has a dot."""

NEAREST = """
const middle = windows.data.middle, x = cb_obj.x;
let row = 0;
for (let k = 1; k < middle.length; k++) if (Math.abs(middle[k] - x) < Math.abs(middle[row] - x)) row = k;
const start = [windows.data.start[row]], end = [windows.data.end[row]];
"""
PICK = "picked.data = { row: [row], start, end };"
HOVER = "if (hovered.data.start[0] !== start[0] || hovered.data.end[0] !== end[0]) hovered.data = { start, end };"
LEAVE = "hovered.data = { start: [], end: [] };"
SHOW = """
const row = picked.data.row[0], of = windows.data, start = of.start[row], end = of.end[row];
const range = (low, high) => ({ start: low, end: high, reset_start: low, reset_end: high });
x.setv(range(start, end));
sources.forEach((source, k) => {
  const time = source.data.time;
  let first = 0, last = time.length;
  while (first < last && time[first] < start) first++;
  while (last > first && time[last - 1] > end) last--;
  const part = Object.fromEntries(Object.entries(source.data).map(([name, y]) => [name, y.slice(first, last)]));
  let low = Infinity, high = -Infinity;
  for (const value of part.measured) {
    if (Number.isFinite(value)) [low, high] = [Math.min(low, value), Math.max(high, value)];
  }
  const margin = 0.25 * (high - low) || 1;
  ys[k].setv(low <= high ? range(low - margin, high + margin) : range(-1, 1));
  shown[k].data = part;
});
const values = names.map((name, k) => (
  { name, unit: units[k], value: of[`value${k}`][row], low: of[`low${k}`][row], high: of[`high${k}`][row] }
));
const about = { start, end, values, verdict: of.verdict[row], reason: of.reason[row], remark: of.remark[row] };
document.dispatchEvent(new CustomEvent("jaximp-window", { detail: about }));
"""
TICKS = """
const size = Math.abs(tick);
if (size === 0 || (size >= 1e-3 && size < 1e5)) return String(Number(tick.toPrecision(6))).replace("-", "−");
const [mantissa, exponent] = tick.toExponential(3).split("e");
const raised = String(Number(exponent)).replace(/./g, (c) => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(c)]);
return `${String(Number(mantissa)).replace("-", "−")}×10${raised}`;
"""
TOOLTIP = """
<div style="max-width: 22rem; white-space: normal">VALUES<br>window from @start{%.5g} to @end{%.5g} s
<br>@verdict<br><i>@reason</i></div>
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


@dataclass(frozen=True)
class Windows:
    """Parameters in windows, of whatever estimator: what figures over time need to know."""

    names: Sequence[str]
    units: Sequence[str]
    start: Numbers
    """(M,) [s]"""
    end: Numbers
    """(M,) [s]"""
    value: Numbers
    """(M, p)"""
    low: Numbers
    """(M, p) lower end of the 95 % interval."""
    high: Numbers
    verdict: AnyArray
    """(M,) one of `trust.verdicts.VERDICTS`."""
    reason: Sequence[str] | AnyArray
    """(M,) empty where a window is trusted."""
    inner: Sequence[tuple[Numbers, Numbers]] = ()
    """(M, p) ends of narrower intervals, where there are any."""
    rise: Numbers | None = None
    """(M, p) how probable it is that each is greater than in the window before; NaN where that is not known."""
    interval: str = "95 % interval"
    remark: Sequence[str] | AnyArray = ()
    """(M,) what else is told of a window that is picked."""

    @property
    def trusted(self) -> AnyArray:
        return np.asarray(self.verdict) == TRUSTED

    @property
    def middle(self) -> Numbers:
        return (self.start + self.end) / 2


@dataclass(frozen=True)
class Torque:
    """What was measured over time, and what models make of it."""

    time: Numbers
    """(N,) [s]"""
    names: Sequence[str]
    """(n,) of the axes, such as `torque (N m)`."""
    measured: Numbers
    """(N, n) NaN where it does not count."""
    models: Mapping[str, Numbers]
    """(N, n) by name; the first is drawn blue, the second vermillion and dashed."""
    band: tuple[Numbers, Numbers] | None = None
    """(N, n) between which the measured torque should lie; without it what the models leave has a panel of its own."""


@dataclass(frozen=True)
class Quality:
    """How well windows determine their parameters and explain the torque, (M,) each."""

    condition: Numbers
    sigma_min: Numbers
    vaf: Numbers
    held_out_vaf: Numbers
    threshold: float | None = None


# ---- over time -------------------------------------------------------------------------------------------------------


def over_time(windows: Windows, torque: Torque, quality: Quality | None = None) -> dict[str, Live]:
    """Parameters (`parameters`), `torque` and, with a `quality`, `condition` over one axis of time."""
    time = _Time(windows)
    sources = [_torque_source(torque, joint) for joint in range(len(torque.names))]
    found = {"parameters": _parameters(time, _picked(time, torque, sources)), "torque": _torque(time, torque, sources)}
    return found if quality is None else found | {"condition": _condition(time, quality)}


class _Time:
    """The axis of time, the windows on it, and which of them a reader picks: what all figures over time share."""

    def __init__(self, windows: Windows) -> None:
        self.windows = windows
        length = float(np.median(windows.end - windows.start))
        self.shaded, ends = stretches(windows.middle, np.asarray(windows.verdict), length)
        low, high = min(ends[0], float(windows.start.min())), max(ends[1], float(windows.end.max()))
        self.x = Range1d(low, high, bounds=(low, high))
        self.rows = np.arange(0, len(windows.middle), -(-len(windows.middle) // WINDOWS))
        self.source = ColumnDataSource(name="windows")
        self.add(start=windows.start, middle=windows.middle, end=windows.end)
        middle = windows.middle[self.rows]
        between = (middle[:-1] + middle[1:]) / 2  # nearest to each window's middle
        left, right = np.append(low, between), np.append(between, high)
        self.source.data.update({"left": _packed(left), "right": _packed(right)})
        for k in range(len(windows.names)):
            self.add(**{f"{end}{k}": getattr(windows, end)[:, k] for end in ("value", "low", "high")})
        for name in ("verdict", "reason", "remark"):
            texts = getattr(windows, name)
            self.source.data[name] = [str(texts[k]) for k in self.rows] if len(texts) else [""] * len(self.rows)
        trusted = np.flatnonzero(windows.trusted[self.rows])
        row = int(trusted[len(trusted) // 2]) if len(trusted) else len(self.rows) // 2
        at = self.rows[row]
        self.picked = ColumnDataSource(
            {"row": [row], "start": [float(windows.start[at])], "end": [float(windows.end[at])]}, name="picked"
        )
        self.hovered = ColumnDataSource({"start": [], "end": []})

    def add(self, **columns: Numbers) -> None:
        """(M,) values of all windows, to be told of one."""
        self.source.data.update({name: _packed(values[self.rows]) for name, values in columns.items()})

    def lines(self, **columns: Numbers) -> ColumnDataSource:
        """(M,) values over the windows' middles `x`, thinned where there are many."""
        x, values = envelope(self.windows.middle, list(columns.values()), WINDOWS)
        return _columns(x=x, **dict(zip(columns, values, strict=True)))

    def panel(self, height: int, y: Any, label: str, last: bool = False, **style: Any) -> Plot:
        """A panel with the shades of verdicts and the windows that are hovered over and picked; a click picks one."""
        plot = _plot(height + BELOW * last, self.x, y, label, **style)
        _label_below(plot, "time (s)" if last else "")
        for verdict, (left, right) in self.shaded.items():
            grey, hatch = SHADES.get(verdict, SHADES[NO_DATA])
            _strips(
                plot, ColumnDataSource({"start": left, "end": right}), fill_color=_grey(grey), line_color=None,
                hatch_pattern=hatch[0], hatch_color=HATCH, hatch_scale=8.0, hatch_weight=0.6,
            )  # fmt: skip
        _strips(plot, self.hovered, fill_color=BLUE, fill_alpha=0.1, line_color=None)
        _strips(plot, self.picked, fill_color=ORANGE, fill_alpha=0.2, line_color=ORANGE)
        windows = {"windows": self.source}
        plot.js_on_event(Tap, CustomJS(args=windows | {"picked": self.picked}, code=NEAREST + PICK))
        plot.js_on_event(MouseMove, CustomJS(args=windows | {"hovered": self.hovered}, code=NEAREST + HOVER))
        plot.js_on_event(MouseLeave, CustomJS(args={"hovered": self.hovered}, code=LEAVE))
        return plot

    def tell(self, plot: Plot, text: str) -> None:
        """Say a text, with `@` before the names of columns, of the window under the cursor."""
        strips = _strips(plot, self.source, ("left", "right"), fill_alpha=0, line_color=None)
        formatted = {f"@{name}": "printf" for name in self.source.data if f"@{name}{{%" in TOOLTIP + text}
        tooltip = TOOLTIP.replace("VALUES", text)
        plot.add_tools(
            HoverTool(renderers=[strips], point_policy="follow_mouse", tooltips=tooltip, formatters=formatted)
        )

    @property
    def key(self) -> list[Key]:
        """Of the shades and strips."""
        shades = [
            Key(f"shade {SHADE_NAMES[SHADES.get(kind, SHADES[NO_DATA])[1][0]]}", GREY, kind) for kind in self.shaded
        ]
        return [*shades, Key("shade", ORANGE, "picked window")]


def _parameters(time: _Time, beside: UIElement) -> Live:
    windows, trusted, panels = time.windows, time.windows.trusted, []
    for k, (name, unit) in enumerate(zip(windows.names, windows.units, strict=True)):
        value, low, high = (x[:, k] for x in (windows.value, windows.low, windows.high))
        ends = believed(np.stack([low, high])[:, trusted], value)
        last = k == len(windows.names) - 1 and windows.rise is None
        plot = time.panel(150, Range1d(*ends), with_unit(name, unit), last, above=True)
        for one in ((windows.low, windows.high), *windows.inner):
            below, above = (np.where(trusted, end[:, k], np.nan) for end in one)
            _band(plot, windows.middle, below, above)
        shown = np.where(trusted, value, np.nan)
        everything = np.clip(value, *beyond(ends))
        source = time.lines(shown=shown, everything=everything)
        if not trusted.all():
            plot.line("x", "everything", source=source, color=GREY, line_dash=[4, 3])
            _dots(plot, windows.middle, np.where(trusted, np.nan, everything), GREY)
        plot.line("x", "shown", source=source, color=BLUE, line_width=2)
        _dots(plot, windows.middle, shown, BLUE, low, high)
        time.tell(plot, f"<b>@value{k}{{%.4g}}</b>, @low{k}{{%.4g}} to @high{k}{{%.4g}}")
        panels.append(plot)
    key = [Key("line", BLUE, "trusted"), Key("band", BLUE, windows.interval)] if trusted.any() else []
    if windows.inner and trusted.any():
        key.append(Key("band strong", BLUE, "50 % of it"))
    if not trusted.all():
        key.append(Key("dash", GREY, "not trusted"))
    key += time.key
    if windows.rise is not None:
        plot, others = _rises(time, windows.rise)
        panels.append(plot)
        key += others
    return Live(_stacked(panels), key, beside)


def _rises(time: _Time, rise: Numbers) -> tuple[Plot, list[Key]]:
    """Of every window, how probable it is that each parameter is greater than in the one before."""
    plot = time.panel(150, Range1d(-0.06, 1.06), "probability that it rose (1)", True, above=True)
    plot.add_layout(Span(location=0.5, dimension="width", line_color=GREY, line_width=1))
    key = []
    for k, (name, (color, _)) in enumerate(zip(time.windows.names, cycle(LINES, rise.shape[1]), strict=True)):
        known = np.isfinite(rise[:, k])
        data = {"x": _packed(time.windows.middle[known]), "y": _packed(rise[known, k])}
        plot.scatter("x", "y", source=ColumnDataSource(data), color=color, size=8, marker=MARKERS[k % len(MARKERS)])
        key.append(Key(f"mark {MARKERS[k % len(MARKERS)]}", color, f"{words(name)} rose"))
    return plot, key


def _condition(time: _Time, quality: Quality) -> Live:
    columns = {"condition": quality.condition, "sigma": quality.sigma_min, "vaf": quality.vaf,
               "ahead": quality.held_out_vaf}  # fmt: skip
    source = time.lines(**columns)
    time.add(**columns)
    of_condition = Range1d(*decade_limits(quality.condition, quality.threshold))
    condition = time.panel(150, of_condition, "condition number (1)", above=True, log=True)
    smallest = time.panel(
        150, Range1d(*decade_limits(quality.sigma_min)), "smallest singular value (mixed units)", above=True, log=True
    )
    ahead = quality.held_out_vaf[np.isfinite(quality.held_out_vaf)]
    lowest = float(np.clip(np.percentile(np.append(ahead, 0.0), 2), -1, 0))
    vaf = time.panel(150, Range1d(lowest - 0.03, 1.03), "variance accounted for, VAF (1)", True, above=True)
    for plot, name in ((condition, "condition"), (smallest, "sigma"), (vaf, "vaf")):
        plot.line("x", name, source=source, color=BLUE, line_width=2)
    vaf.line("x", "ahead", source=source, color=VERMILLION, line_dash="dashed", line_width=1.5)
    time.tell(condition, "condition number <b>@condition{%.4g}</b>")
    time.tell(smallest, "smallest singular value <b>@sigma{%.4g}</b>")
    time.tell(vaf, "VAF <b>@vaf{%.4g}</b>, in the next window <b>@ahead{%.4g}</b>")
    key = [Key("line", BLUE, "in the window"), Key("dash", VERMILLION, "VAF in the next window, which it has not seen")]
    if quality.threshold is not None:
        line = Span(
            location=quality.threshold, dimension="width", line_color=VERMILLION, line_dash="dotted", line_width=2
        )
        condition.add_layout(line)
        key.append(Key("dots", VERMILLION, f"threshold for fake changes, eq. (16): {number(quality.threshold, 3)}"))
    return Live(_stacked([condition, smallest, vaf]), [*key, *time.key])


# ---- torque ----------------------------------------------------------------------------------------------------------


def _torque_source(torque: Torque, joint: int) -> ColumnDataSource:
    """All that is drawn of a joint; what a model makes far beyond the axis is kept within what can be counted."""
    measured = torque.measured[:, joint]
    counts, far = np.isfinite(measured), beyond(torque_limits(measured))
    models = [np.clip(np.where(counts, x[:, joint], np.nan), *far) for x in torque.models.values()]
    columns = {"measured": measured} | {f"model{k}": x for k, x in enumerate(models)}
    if torque.band is None:
        columns |= {f"residual{k}": measured - x for k, x in enumerate(models)}
    else:
        columns |= {end: x[:, joint] for end, x in zip(("low", "high"), torque.band, strict=True)}
    x, values = envelope(torque.time, list(columns.values()), SAMPLES // len(torque.names))
    return _columns(time=x, **dict(zip(columns, values, strict=True)))


def _torque(time: _Time, torque: Torque, sources: Sequence[ColumnDataSource]) -> Live:
    """Measured and modelled torque of the whole recording, and what the models leave."""
    panels: list[Plot] = []
    for joint, (name, source) in enumerate(zip(torque.names, sources, strict=True)):
        last, ends = joint == len(sources) - 1, torque_limits(torque.measured[:, joint])
        upper = time.panel(230, Range1d(*ends), name, last and torque.band is not None, above=True)
        _draw_torque(upper, source, torque)
        telling = "".join(f"<br>{model} <b>@model{k}{{%.4g}}</b>" for k, model in enumerate(map(escape, torque.models)))
        formatted = {f"@{column}": "printf" for column in source.data}
        upper.add_tools(
            HoverTool(
                renderers=[upper.line("time", "measured", source=source, line_alpha=0)],
                mode="vline",
                line_policy="nearest",
                point_policy="follow_mouse",
                tooltips=f"<div>@time{{%.5g}} s<br>measured <b>@measured{{%.4g}}</b>{telling}</div>",
                formatters=formatted,
            )
        )
        panels.append(upper)
        if torque.band is None:
            lower = time.panel(120, Range1d(*_residual_limits(torque, joint)), f"residual {name}", last, above=True)
            for k, (color, dash) in zip(range(len(torque.models)), MODELS, strict=False):
                lower.line("time", f"residual{k}", source=source, color=color, line_dash=dash)
            panels.append(lower)
    key = [Key("line", BLACK, "measured")]
    for name, (color, dash) in zip(torque.models, MODELS, strict=False):
        key.append(Key("line" if dash == "solid" else "dash", color, name))
    if torque.band is not None:
        key.append(Key("band", BLUE, "should hold 95 % of it"))
    return Live(_stacked(panels), [*key, *time.key])


def _draw_torque(plot: Plot, source: ColumnDataSource, torque: Torque) -> None:
    if torque.band is not None:
        plot.varea("time", "low", "high", source=source, fill_color=BLUE, fill_alpha=0.25)
    plot.line("time", "measured", source=source, color=BLACK, line_width=2)
    for k, (color, dash) in zip(range(len(torque.models)), MODELS, strict=False):
        plot.line("time", f"model{k}", source=source, color=color, line_dash=dash, line_width=1.4)


def _residual_limits(torque: Torque, joint: int) -> tuple[float, float]:
    """In the scale of the torque at most: a model that runs away leaves the panel."""
    low, high = torque_limits(torque.measured[:, joint])
    left = np.abs(np.concatenate([torque.measured[:, joint] - x[:, joint] for x in torque.models.values()]))
    left = left[np.isfinite(left)]
    half = min(1.2 * float(np.percentile(left, 99.9)) if len(left) else 1.0, high - low) or 1.0
    return -half, half


def _picked(time: _Time, torque: Torque, sources: Sequence[ColumnDataSource]) -> UIElement:
    """The torque in the window that is picked. A change of `picked` fills it, and tells the page of the window."""
    x, shown, panels = Range1d(*(time.picked.data[end][0] for end in ("start", "end"))), [], []
    for name, source in zip(torque.names, sources, strict=True):
        part = ColumnDataSource({column: [] for column in source.data})
        plot = _plot(220 if len(sources) == 1 else 160, x, Range1d(-1, 1), name, above=True)
        _draw_torque(plot, part, torque)
        shown.append(part)
        panels.append(plot)
    panels[-1].xaxis.axis_label = "time (s)"
    about = {"names": [words(name) for name in time.windows.names], "units": list(map(pretty_unit, time.windows.units))}
    args = {"windows": time.source, "picked": time.picked, "sources": list(sources), "shown": shown} | about
    args |= {"x": x, "ys": [plot.y_range for plot in panels]}
    time.picked.js_on_change("data", CustomJS(args=args, code=SHOW))
    return _stacked(panels, tools=False)


# ---- arms ------------------------------------------------------------------------------------------------------------


def deviations(position: Numbers, force: Numbers, sample_rate: float) -> Live:
    """What the perturbations changed at the hand in every trial, from the onset on. A click on a trial marks it.

    **Arguments:** (T, S, 2) differences of the position [m] and of the force [N].
    """
    trials, samples = position.shape[:2]
    few = max(TRIAL_SAMPLES[0], TRIAL_SAMPLES[1] // trials)
    kept = np.unique(np.linspace(0, samples - 1, min(few, samples)).astype(int))
    time = _packed(1e3 * kept / sample_rate)
    columns: dict[str, Any] = {"trial": [k + 1 for k in range(trials)], "time": [time] * trials}
    columns["color"] = [color for color, _ in cycle(LINES[:4], trials)]
    quantities = [(f"position {axis} (mm)", 1e3 * position[:, kept, k]) for k, axis in enumerate("xy")]
    quantities += [(f"force {axis} (N)", force[:, kept, k]) for k, axis in enumerate("xy")]
    columns |= {f"y{k}": [_packed(row) for row in values] for k, (_, values) in enumerate(quantities)}
    source, x, panels = ColumnDataSource(columns), Range1d(0, float(time[-1])), []
    for k, (label, values) in enumerate(quantities):
        finite = values[np.isfinite(values)]
        low, high = (float(finite.min()), float(finite.max())) if len(finite) else (-1.0, 1.0)
        margin = 0.08 * (high - low) or 1.0
        plot = _plot(210 + BELOW * (k > 1), x, Range1d(low - margin, high + margin), label, above=True)
        _label_below(plot, "time since the onset (ms)" if k > 1 else "")
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
    return Live(_grid([panels[:2], panels[2:]]), hint=f"{Live.hint} Click a trial to mark it in all panels.")


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
    return Live(_grid([panels]), [*key, Key("line", GREY, "the arm, from the shoulder to the hand")])


def _ellipse_panel(
    quantity: str,
    unit: str,
    estimates: Mapping[str, EndpointImpedance],
    corners: Numbers,
    half_axis: float,
    limits: tuple[Numbers, Numbers],
) -> Plot:
    plot = _plot(280, DataRange1d(range_padding=0), DataRange1d(range_padding=0), f"{quantity}, y (m)", above=True)
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
            {"x": _packed(x), "y": _packed(y)} | {f"t{i}": [text] * len(x) for i, text in enumerate(told)}
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


# ---- what all figures share ------------------------------------------------------------------------------------------


def _plot(height: int, x: Any, y: Any, label: str, above: bool = False, log: bool = False) -> Plot:
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


def _label_below(plot: Plot, label: str) -> None:
    """A label of the x axis, or no numbers where it is that of the panel below."""
    if label:
        plot.xaxis.axis_label = label
    else:
        plot.xaxis.major_label_text_font_size = "0px"


def _stacked(panels: Sequence[Plot], tools: bool = True) -> GridPlot:
    return _grid([[panel] for panel in panels], tools)


def _grid(rows: Sequence[Sequence[Plot]], tools: bool = True) -> GridPlot:
    """Panels side by side, with one bar of tools for all."""
    where = "above" if tools else None
    return gridplot([list(row) for row in rows], sizing_mode="stretch_width", toolbar_location=where,
                    toolbar_options={"logo": None})  # fmt: skip


def _strips(
    plot: Plot, source: ColumnDataSource, ends: tuple[str, str] = ("start", "end"), **style: Any
) -> GlyphRenderer:
    """Strips behind all else, as high as the panel."""
    glyph = VStrip(x0=ends[0], x1=ends[1], **style)
    made = GlyphRenderer(data_source=source, glyph=glyph, level="underlay")
    plot.renderers.append(made)
    return made


def _band(plot: Plot, x: Numbers, low: Numbers, high: Numbers) -> None:
    """An area with gaps where there is no number. An area bridges them: there it gets no height."""
    x, (low, high) = _extremes(x, low, high)
    known = np.isfinite(low) & np.isfinite(high)
    first = np.flatnonzero(known & ~np.append(False, known[:-1]))
    last = np.flatnonzero(known & ~np.append(known[1:], False))
    place = np.concatenate([np.flatnonzero(known), first - 0.5, last + 0.5])
    ends = np.concatenate([first, last])
    middle = (low[ends] + high[ends]) / 2
    order = np.argsort(place, kind="stable")
    closed = {"x": np.append(x[known], x[ends])}
    closed |= {"low": np.append(low[known], middle), "high": np.append(high[known], middle)}
    source = _columns(**{name: values[order] for name, values in closed.items()})
    plot.varea("x", "low", "high", source=source, fill_color=BLUE, fill_alpha=0.25)


def _extremes(x: Numbers, low: Numbers, high: Numbers) -> tuple[Numbers, tuple[Numbers, Numbers]]:
    """The widest band in each of many bins."""
    first = bins(len(x), WINDOWS // 2 if len(x) > WINDOWS else len(x))
    return x[first], (np.fmin.reduceat(low, first), np.fmax.reduceat(high, first))


def _dots(
    plot: Plot, x: Numbers, y: Numbers, color: str, low: Numbers | None = None, high: Numbers | None = None
) -> None:
    """Windows that stand alone, which a line does not show, with their intervals; of a few windows all."""
    shown = np.isfinite(y) if len(y) <= FEW else alone(y)
    plot.scatter("x", "y", source=_columns(x=x[shown], y=y[shown]), color=color, size=5)
    if low is not None and high is not None:
        lonely = alone(y)
        source = _columns(x=x[lonely], low=low[lonely], high=high[lonely])
        plot.segment("x", "low", "x", "high", source=source, color=color, line_width=1.5)


def _columns(**values: AnyArray) -> ColumnDataSource:
    return ColumnDataSource({name: _packed(column) for name, column in values.items()})


def _packed(values: AnyArray) -> NDArray[np.float32]:
    """Half the size of a page; a screen shows no more digits. What is too large for them is infinite."""
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(values, np.float32)


def _grey(level: str) -> str:
    """A colour of the printed figures as a page writes it."""
    return "#" + 3 * f"{round(255 * float(level)):02x}"


# ---- into a page -----------------------------------------------------------------------------------------------------


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
