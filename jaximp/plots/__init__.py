"""Figures: the only part that draws.

Every function takes results and returns a `Figure` of a printed page's width; `png` renders it. Nothing is kept
between calls, and the settings of a caller's own matplotlib stay as they are. Long recordings are thinned to
envelopes, so that a million samples cost as much as a few thousand.
"""

from jaximp.plots.arm import ellipses
from jaximp.plots.design import design
from jaximp.plots.estimates import (
    condition_over_time,
    effort,
    methods,
    parameters_over_time,
    reflex_weights,
    residual_spectrum,
    torque,
    window_lengths,
)
from jaximp.plots.impedance import deviations, impedance_methods, impedance_windows, jerk_spectra, joint_torques
from jaximp.plots.posterior import bands, corner, ellipse_bands, torque_bands
from jaximp.plots.style import Panel, curves, main_parameter, number, png, pretty_unit, with_unit, words

__all__ = [
    "Panel",
    "bands",
    "condition_over_time",
    "corner",
    "curves",
    "design",
    "deviations",
    "effort",
    "ellipse_bands",
    "ellipses",
    "impedance_methods",
    "impedance_windows",
    "jerk_spectra",
    "joint_torques",
    "main_parameter",
    "methods",
    "number",
    "parameters_over_time",
    "png",
    "pretty_unit",
    "reflex_weights",
    "residual_spectrum",
    "torque",
    "torque_bands",
    "window_lengths",
    "with_unit",
    "words",
]
