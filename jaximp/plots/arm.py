"""Figure of the impedance at the hand of an arm: Börner et al. 2020, figure 11."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaximp.models.endpoint import EndpointImpedance, ellipse
from jaximp.models.kinematics import ArmGeometry
from jaximp.plots.style import BLACK, BLUE, GREEN, ORANGE, PALE, VERMILLION, WIDTH, styled
from jaximp.types import Numbers

QUANTITIES = {"inertia": "kg", "damping": "N s/m", "stiffness": "N/m"}
SHARE = 0.45
"""Half axis of the largest ellipse of a panel, as a share of the arm's reach."""
ESTIMATES = ((BLUE, "-"), (VERMILLION, "-."), (GREEN, ":"), (ORANGE, (0, (5, 1, 1, 1, 1, 1))))


@styled
def ellipses(
    geometry: ArmGeometry,
    q: Numbers,
    estimates: Mapping[str, EndpointImpedance],
    truth: EndpointImpedance | None = None,
) -> Figure:
    """Ellipses of inertia, damping and stiffness at the hand of an arm with the shoulder at the origin.

    **Arguments:** `q` (2,) angles of the arm [rad]; `estimates` by name, of one hand each; `truth` is drawn in black
    and dashed. A matrix that is NaN is left out.
    """
    figure = Figure(figsize=(WIDTH, 3.0))
    panels = figure.subplots(1, len(QUANTITIES), sharex=True, sharey=True)
    styles = [ESTIMATES[k % len(ESTIMATES)] for k in range(len(estimates))]
    shown = [(name, one, *style, 1.2) for (name, one), style in zip(estimates.items(), styles, strict=True)]
    if truth is not None:
        shown.append(("truth", truth, BLACK, "--", 0.9))
    elbow, hand = elbow_and_hand(geometry, np.asarray(q))
    corners = np.stack([np.zeros(2), elbow, hand])
    half_axis = SHARE * sum(geometry.lengths)
    low, high = limits_of(corners, half_axis)
    for panel, (quantity, unit) in zip(panels, QUANTITIES.items(), strict=True):
        panel.plot(*corners.T, color=PALE, linewidth=2.5, marker="o", markersize=4, solid_capstyle="round")
        outlines = [np.asarray(ellipse(getattr(one, quantity)).outline()) for _, one, *_ in shown]
        largest = max((float(np.hypot(*x.T).max()) for x in outlines if np.isfinite(x).all()), default=1.0)
        scale = half_axis / largest
        for (name, _, color, line, width), outline in zip(shown, outlines, strict=True):
            panel.plot(*(hand + scale * outline).T, color=color, linestyle=line, linewidth=width, label=name)
        _scale_bar(panel, low, scale, largest, unit)
        panel.set(title=quantity, xlabel="x (m)", xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    panels[0].set_ylabel("y (m)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(shown))
    return figure


def elbow_and_hand(geometry: ArmGeometry, q: Numbers) -> tuple[Numbers, Numbers]:
    """From the shoulder [m]."""
    elbow = geometry.lengths[0] * np.array([np.cos(q[0]), np.sin(q[0])])
    return elbow, np.asarray(geometry.forward(q)) - np.asarray(geometry.shoulder)


def limits_of(corners: Numbers, half_axis: float) -> tuple[Numbers, Numbers]:
    """Lower left and upper right corner of a panel, with room for every ellipse above the scale bar."""
    margin = 0.12 * half_axis
    low = np.minimum(corners.min(axis=0), corners[-1] - half_axis) - margin
    high = np.maximum(corners.max(axis=0), corners[-1] + half_axis) + margin
    return low - [0, 0.45 * half_axis], high


def round_length(largest: float) -> float:
    """One, two or five of the largest decade that fits."""
    decade = 10.0 ** np.floor(np.log10(largest))
    return float(decade * max(digit for digit in (1, 2, 5) if digit * decade <= largest * (1 + 1e-9)))


def _scale_bar(panel: Axes, corner: Numbers, scale: float, largest: float, unit: str) -> None:
    """A line of a round number's length in the lower left corner."""
    size = round_length(largest)
    x, y = corner + 0.03
    panel.plot([x, x + size * scale], [y, y], color=BLACK, linewidth=1.5, solid_capstyle="butt")
    panel.text(x, y + 0.012, f"{size:g} {unit}", va="bottom")
