"""What all figures share: their style, lines and bands for long signals, words and numbers for people."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import wraps
from io import BytesIO
from typing import Any, ParamSpec, TypeVar

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from jaximp.types import Numbers

P = ParamSpec("P")
R = TypeVar("R")

WIDTH = 17 / 2.54
"""Width of every figure [inch]."""
POINTS = 4000
"""A line of more points than this is drawn as its envelope."""
# Okabe and Ito: told apart by every kind of colour vision, and by lightness in print.
BLACK = "#000000"
BLUE = "#0072B2"
VERMILLION = "#D55E00"
GREEN = "#009E73"
ORANGE = "#E69F00"
PALE, HATCH = "0.55", "0.75"
MEASURED = "0.68"
"""A wide line under that of a model."""
LINES = ((BLUE, "-"), (VERMILLION, "--"), (GREEN, "-."), (ORANGE, ":"), (BLACK, (0, (5, 1, 1, 1, 1, 1))))
STYLE: Any = {
    "figure.constrained_layout.use": True,
    "figure.dpi": 150,
    "font.size": 8.5,
    "axes.titlesize": 8.5,
    "axes.labelsize": 8.5,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "lines.markersize": 4.5,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "0.88",
    "grid.linewidth": 0.5,
    "hatch.linewidth": 0.4,
}
"""Settings of matplotlib (`rcParams`) that all figures share."""


def styled(function: Callable[P, R]) -> Callable[P, R]:
    """Run with the style of these figures, and leave the caller's settings alone."""

    @wraps(function)
    def with_style(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.rc_context(STYLE):
            return function(*args, **kwargs)

    return with_style


@styled
def png(figure: Figure) -> bytes:
    """The figure as a PNG file of 256 colours, half as large as one of all colours.

    Ticks are made while rendering, so that the style is needed here as well. (`savefig` would draw everything twice.)
    """
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    stream = BytesIO()
    dots = (figure.dpi, figure.dpi)
    image.quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(stream, "PNG", optimize=True, dpi=dots)
    return stream.getvalue()


def draw_line(panel: Axes, x: Numbers, y: Any, **style: Any) -> None:
    """A line, thinned where it is long; the small dots show windows that stand alone."""
    x, (y,) = envelope(np.asarray(x), [np.asarray(y, float)])
    dotted = len(x) <= POINTS and bool(alone(y).any())
    panel.plot(x, y, marker="." if dotted else "", markersize=2, **style)


def alone(y: Numbers) -> NDArray[np.bool_]:
    """Points between two gaps, which a line does not show."""
    counts = np.isfinite(y)
    return counts & ~np.append(False, counts[:-1]) & ~np.append(counts[1:], False)


def draw_band(panel: Axes, x: Numbers, low: Numbers, high: Numbers, **style: Any) -> None:
    first = bins(len(x), POINTS // 2)
    panel.fill_between(x[first], np.fmin.reduceat(low, first), np.fmax.reduceat(high, first), **style)


def envelope(x: Numbers, several: Sequence[Numbers], points: int = POINTS) -> tuple[Numbers, list[Numbers]]:
    """The same lines over x; of more than `points`, the smallest and the largest value of each of half as many bins."""
    if len(x) <= points:
        return x, list(several)
    first = bins(len(x), points // 2)
    ends = [np.column_stack([np.fmin.reduceat(y, first), np.fmax.reduceat(y, first)]).ravel() for y in several]
    return np.repeat(x[first], 2), ends


def bins(n: int, limit: int) -> NDArray[np.int64]:
    """First index of each of at most `limit` equal groups of n values."""
    return np.linspace(0, n, min(n, limit), endpoint=False).astype(np.int64)


def cycle(items: Sequence[R], n: int) -> list[R]:
    return [items[k % len(items)] for k in range(n)]


def mean_of(values: Numbers) -> float:
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else float("nan")


def decades(panel: Axes, values: Any, *others: float | None) -> None:
    """A logarithmic axis over whole decades, so that noise does not look like a change."""
    panel.set_yscale("log")
    panel.set_ylim(decade_limits(values, *others))
    panel.minorticks_off()


def decade_limits(values: Any, *others: float | None) -> tuple[float, float]:
    """Whole decades that hold all values, from 1 to 10 where there is none."""
    shown = np.append(np.asarray(values, float), [other for other in others if other is not None])
    shown = shown[np.isfinite(shown) & (shown > 0)].clip(1e-16, 1e16)  # beyond, it is rounding
    if not len(shown):
        return 1.0, 10.0
    low, high = np.log10(shown.min()), np.log10(shown.max())
    return float(10 ** np.floor(low - 0.1)), float(10 ** np.ceil(high + 0.1))


def believed(ends: Numbers, values: Numbers) -> tuple[float, float]:
    """Range that shows the `ends` of trusted intervals, or else most values: a wild one must not squash the others."""
    shown, share = ends[np.isfinite(ends)], (0.5, 99.5)
    if not len(shown):
        shown, share = values[np.isfinite(values)], (5, 95)
    if not len(shown):
        return -1.0, 1.0
    low, high = np.percentile(shown, share)
    margin = 0.15 * (high - low) or 0.1 * abs(high) or 1.0
    return float(low - margin), float(high + margin)


def beyond(limits: tuple[float, float]) -> tuple[float, float]:
    """Far outside of a panel, and yet within what a renderer can count."""
    span = 100 * (limits[1] - limits[0])
    return limits[0] - span, limits[1] + span


def remark(panel: Axes, text: str, color: str = "0.3") -> None:
    """A few words in the upper left corner, readable on any shade."""
    frame = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5}
    panel.text(0.01, 0.95, text, transform=panel.transAxes, va="top", color=color, bbox=frame, zorder=5)


@dataclass(frozen=True)
class Panel:
    """A set of curves in one pair of axes."""

    title: str
    x: str
    y: str
    lines: Sequence[tuple[str, Numbers, Numbers]]
    """Label, x and y of each; the first is drawn in black, as what the others are held against."""
    limits: tuple[float, float] | None = None
    log: bool = False
    bands: Mapping[str, tuple[Numbers, Numbers]] = field(default_factory=dict)
    """Lower and upper end beside the line of a label."""


@styled
def curves(panels: Sequence[Panel], columns: int = 1) -> Figure:
    """Panels row by row, with a legend of several lines beside each; of several columns, beside the last."""
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(WIDTH, 2.2 * rows + 0.3))
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes[len(panels) :]:
        axis.remove()
    for k, (axis, panel) in enumerate(zip(axes[: len(panels)], panels, strict=True)):
        beside = (k + 1) % columns == 0 and len(panel.lines) > 1
        for i, (label, x, y) in enumerate(panel.lines):
            color, style = (BLACK, "-") if i == 0 else LINES[:4][(i - 1) % 4]
            draw_line(axis, x, y, label=label, color=color, linestyle=style, linewidth=0.9 if i else 1.3)
            if label in panel.bands:
                draw_band(axis, x, *panel.bands[label], color=color, alpha=0.2, linewidth=0)
        if panel.limits is not None:
            axis.set_ylim(*panel.limits)
        if panel.log:
            axis.set_yscale("log")
        axis.set(title=panel.title, xlabel=panel.x, ylabel=panel.y)
        if beside:
            axis.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure
