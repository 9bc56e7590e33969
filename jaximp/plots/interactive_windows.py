"""Interactive figures over time: parameters, torque and quality of windows, which a reader can ask about.

Figures share one axis of time; a click picks the window whose middle is nearest, marks it in all of them, cuts its
torque out into a figure of its own, and tells the page about it with the DOM event `jaximp-window`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from bokeh.events import MouseLeave, MouseMove, Tap
from bokeh.models import (
    ColumnDataSource,
    CustomJS,
    GlyphRenderer,
    GridPlot,
    HoverTool,
    Range1d,
    Span,
    UIElement,
    VStrip,
)
from bokeh.plotting import figure as Plot

from jaximp.plots.estimates import SHADES, stretches, torque_limits
from jaximp.plots.interactive import BELOW, GREY, Key, Live, empty_panel, grid_of, label_below, packed
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
HATCH = "#c4c4c4"
MODELS = ((BLUE, "solid"), (VERMILLION, "dashed"))
"""Colour and line of what models make of the torque."""
MARKERS = ("circle", "square", "triangle", "diamond", "inverted_triangle")
SHADE_NAMES = {"/": "rising", "\\": "falling", "x": "crossed", ".": "dotted"}
"""Of the hatches, as the page's style sheet calls them."""
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
TOOLTIP = """
<div style="max-width: 22rem; white-space: normal">VALUES<br>window from @start{%.5g} to @end{%.5g} s
<br>@verdict<br><i>@reason</i></div>
"""


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
    unseen: str = "in the next window"
    """Where, or by what, the torque is predicted that was held out."""


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
        self.source.data.update({"left": packed(left), "right": packed(right)})
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
        self.source.data.update({name: packed(values[self.rows]) for name, values in columns.items()})

    def lines(self, **columns: Numbers) -> ColumnDataSource:
        """(M,) values over the windows' middles `x`, thinned where there are many."""
        x, values = envelope(self.windows.middle, list(columns.values()), WINDOWS)
        return _columns(x=x, **dict(zip(columns, values, strict=True)))

    def panel(self, height: int, y: Any, label: str, last: bool = False, **style: Any) -> Plot:
        """A panel with the shades of verdicts and the windows that are hovered over and picked; a click picks one."""
        plot = empty_panel(height + BELOW * last, self.x, y, label, **style)
        label_below(plot, "time (s)" if last else "")
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
        data = {"x": packed(time.windows.middle[known]), "y": packed(rise[known, k])}
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
    time.tell(vaf, f"VAF <b>@vaf{{%.4g}}</b>, {quality.unseen} <b>@ahead{{%.4g}}</b>")
    key = [Key("line", BLUE, "in the window"), Key("dash", VERMILLION, f"VAF {quality.unseen}, which it has not seen")]
    if quality.threshold is not None:
        line = Span(
            location=quality.threshold, dimension="width", line_color=VERMILLION, line_dash="dotted", line_width=2
        )
        condition.add_layout(line)
        key.append(Key("dots", VERMILLION, f"threshold for fake changes, eq. (16): {number(quality.threshold, 3)}"))
    return Live(_stacked([condition, smallest, vaf]), [*key, *time.key])


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
        plot = empty_panel(220 if len(sources) == 1 else 160, x, Range1d(-1, 1), name, above=True)
        _draw_torque(plot, part, torque)
        shown.append(part)
        panels.append(plot)
    panels[-1].xaxis.axis_label = "time (s)"
    about = {"names": [words(name) for name in time.windows.names], "units": list(map(pretty_unit, time.windows.units))}
    args = {"windows": time.source, "picked": time.picked, "sources": list(sources), "shown": shown} | about
    args |= {"x": x, "ys": [plot.y_range for plot in panels]}
    time.picked.js_on_change("data", CustomJS(args=args, code=SHOW))
    return _stacked(panels, tools=False)


def _stacked(panels: Sequence[Plot], tools: bool = True) -> GridPlot:
    return grid_of([[panel] for panel in panels], tools)


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
    return ColumnDataSource({name: packed(column) for name, column in values.items()})


def _grey(level: str) -> str:
    """A colour of the printed figures as a page writes it."""
    return "#" + 3 * f"{round(255 * float(level)):02x}"
