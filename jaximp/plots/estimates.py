"""Figures of an identification: parameters, condition and torque over time, spectra, window lengths, methods."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator

from jaximp.identification.estimates import Estimates
from jaximp.identification.separation import METHODS
from jaximp.least_squares.window import confidence_interval
from jaximp.models.chain import Chain
from jaximp.models.joint import parameter_units
from jaximp.models.tip import TipImpedance
from jaximp.plots.style import (
    BLACK,
    BLUE,
    HATCH,
    LINES,
    MEASURED,
    ORANGE,
    PALE,
    STYLE,
    VERMILLION,
    WIDTH,
    Numbers,
    believed,
    beyond,
    bins,
    cycle,
    decades,
    draw_band,
    draw_line,
    mean_of,
    remark,
    styled,
)
from jaximp.plots.wording import main_parameter, number, pretty_unit, with_unit
from jaximp.trust.frequencies import ByFrequency
from jaximp.trust.verdicts import FAKE, NO_DATA, POOR, TRUSTED, WEAK
from jaximp.types import AnyArray

STRETCHES = 1000
"""Shaded stretches are drawn no finer than this share of the axis."""
LONG, EXCERPT = 20.0, 5.0
"""A recording longer than the first is shown as its envelope, beside an excerpt of the second [s]."""

SHADES = {WEAK: ("0.96", "////"), FAKE: ("0.90", "\\\\\\\\"), POOR: ("0.93", "xxxx"), NO_DATA: ("0.98", "....")}
"""Grey and hatch of the stretches that must not be believed."""


@styled
def parameters_over_time(estimates: Estimates, level: float = 0.95) -> Figure:
    """Every parameter in every window, with its confidence interval of the given level."""
    n = len(estimates.names)
    columns = 1 if n <= 4 else 2
    rows = -(-n // columns)
    figure = Figure(figsize=(WIDTH, 1.35 * rows + 0.7))
    panels = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for k in range(n):
        _parameter_panel(panels.flat[k], estimates, k, _limits([estimates], k, level), level)
        panels.flat[k].set_title(with_unit(estimates.names[k], estimates.units[k]), loc="left")
        text, color = _mean_over_trusted(estimates, k, brief=columns > 1)
        panels.flat[k].set_title(text, loc="right", color=color)
    for panel in panels.flat[n:]:
        panel.set_visible(False)
    for panel in panels[-1]:
        panel.set_xlabel(_time_label(estimates))
    _span_of_a_window(panels[-1, 0], estimates)
    _legend(figure, panels.flat[0], [estimates])
    return figure


def _span_of_a_window(panel: Axes, estimates: Estimates) -> None:
    """A bar as long as the windows, over which each estimate is an average; a path has none."""
    first, last = panel.get_xlim()
    if estimates.tracks or estimates.window > (last - first) / 2:
        return
    end = first + 0.02 * (last - first) + estimates.window
    over_axes = panel.get_xaxis_transform()
    panel.plot([end - estimates.window, end], [0.12, 0.12], "|-", color="black", transform=over_axes, linewidth=1)
    panel.annotate(
        f"a window, {estimates.window:g} s", (end, 0.12), (5, 0), xycoords=over_axes, textcoords="offset points",
        verticalalignment="center", fontsize="small",
    )  # fmt: skip


def _time_label(estimates: Estimates) -> str:
    return "time (s)" if estimates.tracks else "middle of the window (s)"


@styled
def condition_over_time(estimates: Estimates) -> Figure:
    """How well each window determines its parameters, and how well they explain the torque."""
    figure = Figure(figsize=(WIDTH, 5.0))
    condition, smallest, vaf = figure.subplots(3, 1, sharex=True)
    middle = middles(estimates)
    draw_line(condition, middle, estimates.fit.cond, color=BLUE)
    condition.set(ylabel="condition number (1)")
    decades(condition, estimates.fit.cond, estimates.threshold)
    if estimates.tracks:
        remark(condition, f"of stretches of {estimates.window:g} s around each point")
    elif estimates.threshold is None:
        remark(condition, "no threshold: it needs a reference position and its period")
    else:
        condition.axhline(estimates.threshold, color=VERMILLION, linestyle=":")
        remark(condition, "dotted: threshold for fake changes, eq. (16)")
    draw_line(smallest, middle, estimates.fit.sigma_min, color=BLUE)
    smallest.set(ylabel="smallest singular\nvalue (mixed units)")
    decades(smallest, estimates.fit.sigma_min)
    inside, outside = (
        ("around it", "by what was known before") if estimates.tracks else ("in the window", "in the next window")
    )
    draw_line(vaf, middle, estimates.fit.vaf, color=BLUE, label=f"VAF {inside}")
    ahead = estimates.held_out_vaf
    draw_line(vaf, middle, ahead, color=VERMILLION, linestyle="--", label=f"VAF {outside}")
    lowest = np.percentile(np.append(ahead[np.isfinite(ahead)], 0.0), 2)
    vaf.set(ylabel="variance accounted\nfor (1)", ylim=(np.clip(lowest, -1, 0) - 0.03, 1.03))
    vaf.set_xlabel(_time_label(estimates))
    for panel in (condition, smallest, vaf):
        _shade(panel, estimates)
    figure.align_ylabels()
    _legend(figure, condition, [estimates], vaf)
    return figure


@styled
def torque(estimates: Estimates, model: str = "model, fitted") -> Figure:
    """Measured torque against the model's, and what is left: one row per joint, an excerpt beside long recordings.

    **Arguments:** `model`, what the legend calls the torque with the parameters that belong to each sample.
    """
    time, n_joints = estimates.time, estimates.torque.shape[1]
    long = time[-1] - time[0] > LONG
    figure = Figure(figsize=(WIDTH, 2.9 * n_joints + 0.5))
    grid = {"height_ratios": (2, 1) * n_joints, "width_ratios": (1, 1.25)[: 1 + long]}
    panels = figure.subplots(2 * n_joints, 1 + long, sharex="col", sharey="row", squeeze=False, gridspec_kw=grid)
    for joint in range(n_joints):
        upper, lower = panels[2 * joint : 2 * joint + 2]
        if long:
            _torque_envelopes(upper[0], lower[0], estimates, joint)
        part = _excerpt(estimates, joint) if long else slice(None)
        _torque_lines(upper[-1], lower[-1], estimates, joint, part, model)
        what, unit = effort(estimates, joint)
        whose = f"joint {joint + 1}: " if n_joints > 1 else ""
        upper[0].set_ylabel(f"{whose}{what} ({unit})")
        lower[0].set_ylabel(f"residual ({unit})")
        _set_torque_limits(upper[0], lower[0], estimates, joint)
    if long:
        panels[0, 0].set_title("whole recording, smallest to largest", loc="left")
        panels[0, 1].set_title(f"{EXCERPT:g} s of it", loc="left")
    for panel in panels[-1]:
        # A clock that began long before says so.
        panel.set_xlabel("time (s)" if time[0] <= time[-1] - time[0] else "time by the recording's clock (s)")
        panel.margins(x=0)
    figure.align_ylabels(panels[:, 0])
    _legend(figure, panels[0, -1], [])
    return figure


@styled
def residual_spectrum(estimates: Estimates) -> Figure:
    """Power spectral density (Welch) of the torque and of the residual, on the longest stretch without a gap."""
    n_joints = estimates.torque.shape[1]
    columns = min(n_joints, 2)
    rows = -(-n_joints // columns)
    figure = Figure(figsize=(WIDTH, 2.8 * rows))
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for panel in panels[n_joints:]:
        panel.set_visible(False)
    for joint, panel in enumerate(panels[:n_joints]):
        unit = effort(estimates, joint)[1]
        whose = f"joint {joint + 1}: " if n_joints > 1 else ""
        panel.set(xlabel="frequency (Hz)", ylabel=f"{whose}power spectral density\n[({unit})²/Hz]")
        _spectra(panel, estimates, joint)
    _legend(figure, max(panels[:n_joints], key=lambda panel: len(panel.get_lines())), [])
    return figure


@styled
def by_frequency(estimates: Estimates, level: float = 0.95) -> Figure:
    """Every parameter by bands of frequencies with its confidence interval of the given level, beside its means over
    windows by ordinary and by generalised least squares; one row per joint.

    **Raises:** `ValueError` for estimates without `frequencies`.
    """
    joints = estimates.frequencies
    if not joints:
        raise ValueError("these estimates were not split by frequency: that needs white rows and several windows")
    most = max(len(found.names) for found in joints)
    columns = min(most, 3)
    rows = -(-most // columns)
    figure = Figure(figsize=(WIDTH, 2.1 * rows * len(joints) + 0.5))
    panels = figure.subplots(rows * len(joints), columns, squeeze=False).reshape(len(joints), -1)
    for of_joint, found in zip(panels, joints, strict=True):
        for k, panel in enumerate(of_joint):
            if k < len(found.names):
                _band_panel(panel, found, k, level)
            else:
                panel.set_visible(False)
    for panel in figure.axes[-columns:]:
        panel.set_xlabel("frequency (Hz)")
    _legend(figure, max(figure.axes, key=lambda panel: len(panel.get_legend_handles_labels()[0])), [])
    return figure


@styled
def reflex_weights(estimates: Estimates, level: float = 0.95) -> Figure:
    """Weight of every lag of each reflex: mean over the trusted windows, its interval in one window, and the spread."""
    figure = Figure(figsize=(WIDTH, 2.6 * len(estimates.reflexes)))
    panels = figure.subplots(len(estimates.reflexes), 1, squeeze=False)[:, 0]
    trusted = estimates.verdicts.trusted
    for panel, reflex in zip(panels, estimates.reflexes, strict=True):
        theta = np.asarray(estimates.fit.theta)[:, reflex.columns]
        half = _interval(estimates, level)[1][:, reflex.columns] - theta
        lags = 1e3 * reflex.lags
        panel.set(xlabel="lag behind the velocity (ms)", ylabel=f"weight ({pretty_unit(reflex.unit)})")
        panel.axhline(0, color=PALE, linewidth=0.8)
        if not trusted.any():
            remark(panel, "no window can be trusted", VERMILLION)
            continue
        mean, spread = theta[trusted].mean(axis=0), theta[trusted].std(axis=0)
        one = np.median(half[trusted], axis=0)
        panel.fill_between(
            lags,
            mean - one,
            mean + one,
            color=BLUE,
            alpha=0.2,
            linewidth=0,
            label=f"{level:.0%} interval of one window",
        )
        panel.errorbar(
            lags, mean, spread, color=BLUE, marker=".", linewidth=1, capsize=2, label="mean, sd over windows"
        )
        whose = reflex.name.removesuffix("reflex").replace(".", ": ")
        title = f"{whose}gain {number(float(reflex.gain[trusted].mean()), 3)} {pretty_unit(reflex.unit)}"
        known = reflex.delay[trusted & np.isfinite(reflex.delay)]
        if len(known):
            title += f", mean delay {number(1e3 * float(np.median(known)), 3)} ms"
        panel.set_title(title, loc="left")
    _legend(figure, panels[0], [])
    return figure


@styled
def window_lengths(several: Sequence[Estimates], parameter: str | None = None) -> Figure:
    """One parameter of the same data at several window lengths, and what each length costs and earns.

    A short window scatters, a long one hides changes: where the spread over the windows is larger than the standard
    error, the parameter truly changes or the model misses something.
    """
    several = sorted(several, key=lambda estimates: estimates.window)
    k = several[0].names.index(parameter or main_parameter(several[0].names))
    name, unit = several[0].names[k], several[0].units[k]
    figure = Figure(figsize=(WIDTH, 4.4))
    panels = figure.subplot_mosaic([["time", "time"], ["spread", "share"]], height_ratios=(1.1, 1))
    over_time, spread, share = panels["time"], panels["spread"], panels["share"]
    for (color, style), estimates in zip(cycle(LINES, len(several)), several, strict=True):
        theta = np.where(estimates.verdicts.trusted, np.asarray(estimates.fit.theta)[:, k], np.nan)
        label = f"window {estimates.window:g} s"
        draw_line(over_time, middles(estimates), theta, color=color, linestyle=style, label=label)
    ends = np.concatenate([middles(estimates)[[0, -1]] for estimates in several])
    over_time.set(xlabel="middle of the window (s)", ylim=_limits(several, k))
    if ends.min() < ends.max():
        over_time.set_xlim(ends.min(), ends.max())
    over_time.set_title(f"{with_unit(name, unit)}, trusted windows", loc="left")
    over_time.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=len(several), borderaxespad=0)

    length = np.array([estimates.window for estimates in several])
    _spread_against_error(spread, length, several, k)
    _share_and_held_out(share, length, several)
    for panel in (spread, share):
        panel.set(xlabel="window length (s)", xticks=length, xticklabels=[f"{value:g}" for value in length])
        panel.set_xlim(0.9 * length[0], 1.05 * length[-1])
        panel.legend(loc="best")
    return figure


@styled
def methods(several: Sequence[Estimates], parameter: str | None = None) -> Figure:
    """One parameter by several methods, one panel each, all with the same axes."""
    k = several[0].names.index(parameter or main_parameter(several[0].names))
    figure = Figure(figsize=(WIDTH, 1.45 * len(several) + 0.7))
    panels = figure.subplots(len(several), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    limits = _limits(several, k)
    for panel, estimates in zip(panels, several, strict=True):
        _parameter_panel(panel, estimates, k, limits)
        if estimates.method is not None:
            panel.set_title(f"method {estimates.method}: {METHODS[estimates.method]}", loc="left")
        text, color = _mean_over_trusted(estimates, k)
        remark(panel, text, color)
    figure.supylabel(with_unit(several[0].names[k], several[0].units[k]), fontsize=STYLE["axes.labelsize"])
    panels[-1].set_xlabel(_time_label(several[0]))
    _legend(figure, panels[int(np.argmax([x.verdicts.trusted.sum() for x in several]))], several)
    return figure


def _parameter_panel(
    panel: Axes, estimates: Estimates, k: int, limits: tuple[float, float], level: float = 0.95
) -> None:
    """Parameter k over time: trusted windows in colour with their interval, the others pale."""
    trusted, theta = estimates.trusted_in(estimates.names[k]), np.asarray(estimates.fit.theta)[:, k]
    low, high = (np.where(trusted, end[:, k], np.nan) for end in _interval(estimates, level))
    middle = middles(estimates)
    _shade(panel, estimates)
    if trusted.any():
        draw_line(panel, middle, np.where(trusted, theta, np.nan), zorder=2.2, color=BLUE, label="trusted")
        band = f"{level:.0%} band" if estimates.tracks else f"{level:.0%} interval"
        draw_band(panel, middle, low, high, color=BLUE, alpha=0.3, linewidth=0, label=band)
    if estimates.tracks:
        known = np.clip(_up_to_then(estimates)[:, k], *beyond(limits))
        draw_line(panel, middle, known, color=VERMILLION, linestyle="--", linewidth=0.8, label="known up to then")
    if not trusted.all():
        draw_line(panel, middle, np.clip(theta, *beyond(limits)), color=PALE, linewidth=0.7, label="not trusted")
    panel.set_ylim(limits)


def _up_to_then(estimates: Estimates) -> Numbers:
    """(M, p) what was known of a path up to each of its points; NaN in the first stretch, in which nothing is."""
    known = np.concatenate([np.asarray(track.filtered.theta) for track in estimates.tracks], axis=1)
    known[estimates.start < estimates.start[0] + estimates.window] = np.nan
    return known


def _mean_over_trusted(estimates: Estimates, k: int, brief: bool = False) -> tuple[str, str]:
    """What to write beside a parameter's panel, and in which colour."""
    if not estimates.trusted_in(estimates.names[k]).any():
        return "none trusted" if brief else f"no {estimates.kind} can be trusted", VERMILLION
    if estimates.names[k] in estimates.changed:
        return estimates.changed[estimates.names[k]].how, BLUE
    ends = estimates.range_of(estimates.names[k])
    if ends is not None:
        return " to ".join(number(end, 3) for end in ends), BLUE
    return f"mean{'' if brief else ' over trusted'} {number(estimates.mean_over_trusted()[k], 3 if brief else 4)}", BLUE


def _interval(estimates: Estimates, level: float = 0.95) -> tuple[Numbers, Numbers]:
    fit = estimates.fit
    return confidence_interval(fit.theta, fit.stderr, fit.dof, level)


def _limits(several: Sequence[Estimates], k: int, level: float = 0.95) -> tuple[float, float]:
    """Range that shows the trusted windows of all: a wild window must not squash the others."""
    ends = [
        np.stack(_interval(estimates, level), axis=-1)[estimates.trusted_in(estimates.names[k]), k]
        for estimates in several
    ]
    theta = [np.asarray(estimates.fit.theta)[:, k] for estimates in several]
    return believed(np.concatenate(ends), np.concatenate(theta))


def _shade(panel: Axes, estimates: Estimates) -> None:
    """Grey and hatch, one kind per verdict, behind the windows that are not trusted."""
    middle = middles(estimates)
    shaded, (low, high) = stretches(middle, estimates.verdicts.verdict, estimates.window)
    for kind, (grey, hatch) in SHADES.items():
        if kind in shaded:
            left, right = shaded[kind]
            panel.broken_barh(
                np.column_stack([left, right - left]),  # type: ignore[arg-type]
                (0, 1),
                transform=panel.get_xaxis_transform(),
                facecolor=grey,
                edgecolor=HATCH,
                linewidth=0,
                hatch=hatch,
                zorder=0,
            )
    panel.set_xlim(low, high)


def middles(estimates: Estimates) -> Numbers:
    """(M,) where estimates are drawn [s]: each is an average over its window."""
    return (estimates.start + estimates.end) / 2


def stretches(
    middle: Numbers, verdict: AnyArray, window: float
) -> tuple[dict[str, tuple[Numbers, Numbers]], tuple[float, float]]:
    """Left and right ends [s] of the stretches with each verdict that must not be believed, and the ends of all."""
    kinds = np.array(list(dict.fromkeys([TRUSTED, *SHADES, *np.asarray(verdict).tolist()])))
    first = bins(len(verdict), STRETCHES)
    most = kinds[np.add.reduceat((np.asarray(verdict)[:, None] == kinds).astype(int), first).argmax(axis=1)]
    half = np.median(np.diff(middle)) / 2 if len(middle) > 1 else window / 2
    border = np.append(middle[first] - half, middle[-1] + half)
    found = {}
    for kind in kinds[1:].tolist():
        mask = np.concatenate([[False], most == kind, [False]])
        change = np.flatnonzero(mask[1:] != mask[:-1])
        if len(change):
            found[kind] = border[change[::2]], border[change[1::2]]
    return found, (float(border[0]), float(border[-1]))


def _legend(figure: Figure, panel: Axes, several: Sequence[Estimates], *others: Axes) -> None:
    """What lines and shades mean, below the panels."""
    handles: list[Artist] = []
    labels: list[str] = []
    for source in (panel, *others):
        found = source.get_legend_handles_labels()
        handles += found[0]
        labels += found[1]
    seen = {verdict for estimates in several for verdict in np.unique(estimates.verdicts.verdict).tolist()}
    for verdict, (grey, hatch) in SHADES.items():
        if verdict in seen:
            handles.append(Patch(facecolor=grey, edgecolor=HATCH, linewidth=0, hatch=hatch))
            labels.append(verdict)
    one_row = sum(8 + len(label) for label in labels) < 110
    columns = len(labels) if one_row else -(-len(labels) // 2)
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, columnspacing=1.5)


def _torque_lines(upper: Axes, lower: Axes, estimates: Estimates, joint: int, part: slice, model: str) -> None:
    time, measured = estimates.time[part], estimates.torque[part, joint]
    seen, unseen = estimates.reconstructed[part, joint], estimates.predicted[part, joint]
    far = beyond(torque_limits(estimates.torque[:, joint]))
    # Wide and pale, so that it shows on both sides of a model that hardly differs.
    draw_line(upper, time, measured, color=MEASURED, linewidth=3.5, label="measured")
    draw_line(upper, time, np.clip(seen, *far), color=BLUE, linewidth=1, label=model)
    draw_line(lower, time, np.clip(measured - seen, *far), color=BLUE, linewidth=1)
    if np.isfinite(unseen).any():
        dashed = {"color": VERMILLION, "linestyle": "--", "linewidth": 0.9}
        before = "model, by what was known before" if estimates.tracks else "model, held out (window before)"
        draw_line(upper, time, np.clip(unseen, *far), label=before, **dashed)
        draw_line(lower, time, np.clip(measured - unseen, *far), **dashed)


def _torque_envelopes(upper: Axes, lower: Axes, estimates: Estimates, joint: int) -> None:
    """Smallest and largest value in every hundredth of the recording: areas for what was measured, and is left."""
    measured = estimates.torque[:, joint]
    first = bins(len(measured), 100)
    time = estimates.time[first]
    far = beyond(torque_limits(estimates.torque[:, joint]))

    def ends(values: Numbers) -> tuple[Numbers, Numbers]:
        values = np.clip(np.where(np.isfinite(measured), values, np.nan), *far)
        return np.fmin.reduceat(values, first), np.fmax.reduceat(values, first)

    upper.fill_between(time, *ends(measured), color="0.8", linewidth=0)
    for end in ends(estimates.reconstructed[:, joint]):
        upper.plot(time, end, color=BLUE, linewidth=0.8)
    lower.fill_between(time, *ends(measured - estimates.reconstructed[:, joint]), color=BLUE, alpha=0.4, linewidth=0)
    for end in ends(measured - estimates.predicted[:, joint]):
        lower.plot(time, end, color=VERMILLION, linestyle="--", linewidth=0.8)


def torque_limits(measured: Numbers) -> tuple[float, float]:
    """Of a panel, by what was measured: a model that runs away leaves it."""
    measured = measured[np.isfinite(measured)]
    if not len(measured):
        return -1.0, 1.0
    low, high = float(measured.min()), float(measured.max())
    margin = 0.1 * (high - low) or 1.0
    return low - margin, high + margin


def _set_torque_limits(upper: Axes, lower: Axes, estimates: Estimates, joint: int) -> None:
    """Both panels in the scale of the measured torque: a model that runs away leaves the panel."""
    limits = torque_limits(estimates.torque[:, joint])
    upper.set_ylim(limits)
    measured = estimates.torque[:, joint]
    residual = np.abs(np.concatenate([measured - x[:, joint] for x in (estimates.reconstructed, estimates.predicted)]))
    residual = residual[np.isfinite(residual)]
    largest = float(np.percentile(residual, 99.9)) if len(residual) else 1.0
    half = min(1.2 * largest or 1.0, limits[1] - limits[0])
    lower.set_ylim(-half, half)


def _excerpt(estimates: Estimates, joint: int) -> slice:
    """The few seconds with the most samples that count and are predicted; of equals, those nearest to the middle."""
    time = estimates.time
    usable = np.isfinite(estimates.torque[:, joint]) & np.isfinite(estimates.predicted[:, joint])
    count = np.concatenate([[0], np.cumsum(usable)])
    stop = np.searchsorted(time, time + EXCERPT)
    full = np.flatnonzero(time + EXCERPT <= time[-1])
    found = (count[stop] - count[:-1])[full]
    best = full[found == found.max()]
    first = int(best[np.abs(time[best] + EXCERPT / 2 - (time[0] + time[-1]) / 2).argmin()])
    return slice(first, int(stop[first]))


def _band_panel(panel: Axes, found: ByFrequency, k: int, level: float) -> None:
    """Parameter k by bands; those that do not determine it are hatched."""
    edges, value = found.edges, found.value[:, k]
    low, high = (end[:, k] for end in found.interval(level))
    lines = ((found.generalised[k], BLUE, "-", "generalised"), (found.ordinary[k], VERMILLION, "--", "ordinary"))
    for mean, color, style, label in lines:
        panel.axhline(mean, color=color, linestyle=style, linewidth=1, label=f"{label} least squares")
    known = np.isfinite(value)
    if known.any():
        across = np.abs(np.stack([edges[:-1], edges[1:]]) - found.middle)[:, known]
        up = np.stack([value - low, high - value])[:, known]
        label = f"in a band, {level:.0%} interval"
        panel.errorbar(found.middle[known], value[known], up, across, color=BLACK, fmt="o", capsize=2, label=label)
    for left, right in zip(edges[:-1][~known], edges[1:][~known], strict=True):
        grey, hatch = SHADES[WEAK]
        label = "not determined" if left == edges[:-1][~known][0] else ""
        panel.axvspan(left, right, facecolor=grey, edgecolor=HATCH, hatch=hatch, linewidth=0, zorder=0, label=label)
    panel.set_title(with_unit(found.names[k], found.units[k]), loc="left")
    panel.set_xscale("log")
    panel.set_xlim(edges[0] / 1.1, edges[-1] * 1.1)
    panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if edges[-1] > 10 * edges[0] else (1, 1.5, 2, 3, 5, 7)))
    panel.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    panel.minorticks_off()


def _longest_stretch(estimates: Estimates, joint: int) -> tuple[list[Numbers], float]:
    """Torque and residuals on the longest run of samples without a gap, and their sample rate [Hz].

    The held-out residual is left out where there is none.
    """
    time, measured = estimates.time, estimates.torque[:, joint]
    fitted, held_out = measured - estimates.reconstructed[:, joint], measured - estimates.predicted[:, joint]
    interval = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    for signals in ([measured, fitted, held_out], [measured, fitted]):
        counts = np.isfinite(signals).all(axis=0)
        # A run ends where a sample is missing, and where the time jumps.
        run = np.cumsum(~counts | (np.diff(time, prepend=time[0]) > 1.5 * interval))
        lengths = np.bincount(run[counts], minlength=1)
        part = counts & (run == lengths.argmax())
        if part.sum() >= 16:
            break
    return [signal[part] for signal in signals], 1 / interval


def _spectra(panel: Axes, estimates: Estimates, joint: int) -> None:
    from scipy.signal import welch

    signals, rate = _longest_stretch(estimates, joint)
    n = len(signals[0])
    if n < 16 or np.ptp(signals[0]) == 0:
        remark(panel, "no stretch without a gap\nis long enough for a spectrum")
        panel.set(xticks=(), yticks=())
        return
    what = effort(estimates, joint)[0]
    lines = ((BLACK, "-", what), (BLUE, "-", "residual, fitted"), (VERMILLION, "--", "residual, held out"))
    spectra = [welch(signal, rate, nperseg=max(16, n // 8)) for signal in signals]
    for (frequency, power), (color, style, label) in zip(spectra, lines, strict=False):
        panel.loglog(frequency[1:], power[1:], color=color, linestyle=style, label=label)
    noise = [(one[0], density) for one in estimates.noise for density in one[1:]]
    if noise:
        frequency, density = (x[1:] for x in noise[joint])
        panel.loglog(frequency, density, color=ORANGE, linewidth=1.6, label="noise, estimated")
    frequency, power = (x[1:] for x in spectra[0])
    shown = frequency[power > 1e-6 * power.max()]  # what the filters removed is not worth the ink
    panel.set(ylim=(power.max() * 1e-6, power.max() * 3), xlim=(frequency[0], max(shown[-1], 2 * frequency[0])))
    panel.set_title(f"longest stretch without a gap, {n / rate:.3g} s", loc="left")
    panel.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.minorticks_off()


def _spread_against_error(panel: Axes, length: Numbers, several: Sequence[Estimates], k: int) -> None:
    summary = np.array([_spread_and_error(estimates, k) for estimates in several])
    panel.plot(length, summary[:, 0], "o-", color=BLUE, label="sd over the windows")
    panel.plot(length, summary[:, 1], "s--", color=VERMILLION, label="median standard error")
    panel.set_ylabel(with_unit(several[0].names[k], several[0].units[k]))
    panel.set_ylim(0, 1.25 * np.fmax.reduce(summary, axis=None, initial=0.0) or 1)


def _share_and_held_out(panel: Axes, length: Numbers, several: Sequence[Estimates]) -> None:
    share = [estimates.verdicts.trusted.mean() for estimates in several]
    held_out = [mean_of(estimates.held_out_vaf[estimates.verdicts.trusted]) for estimates in several]
    panel.plot(length, share, "o-", color=BLUE, label="trusted")
    panel.plot(length, held_out, "s--", color=VERMILLION, label="held-out VAF of these")
    panel.set(ylabel="share of windows, VAF (1)", ylim=(max(-1, np.fmin.reduce(held_out, initial=0.0)) - 0.03, 1.03))


def _spread_and_error(estimates: Estimates, k: int) -> tuple[float, float]:
    """Standard deviation over the trusted windows, and their median standard error."""
    trusted = estimates.verdicts.trusted
    theta, stderr = (np.asarray(x)[trusted, k] for x in (estimates.fit.theta, estimates.fit.stderr))
    return (float(theta.std()), float(np.median(stderr))) if len(theta) else (np.nan, np.nan)


def effort(estimates: Estimates, joint: int) -> tuple[str, str]:
    """Whether the joint has a torque or a force, told by its kind or by the units of its parameters."""
    if isinstance(estimates.model, Chain | TipImpedance):
        return ("force", "N") if estimates.model.joint_kinds[joint] == "prismatic" else ("torque", "N m")
    own = f"joint{joint + 1}."
    units = {u for name, u in zip(estimates.names, estimates.units, strict=True) if not name.startswith("joint")}
    units |= {u for name, u in zip(estimates.names, estimates.units, strict=True) if name.startswith(own)}
    return ("force", "N") if units <= set(parameter_units("prismatic").values()) else ("torque", "N m")
