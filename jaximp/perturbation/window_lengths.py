"""Estimates of one method from windows of other lengths: whether they depend on the one that was chosen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Num

from jaximp.least_squares.window import confidence_interval
from jaximp.perturbation.deviations import KnownArm
from jaximp.perturbation.isolation.methods import METHODS, isolate
from jaximp.perturbation.stiffness import ELEMENTS, SYMMETRIC_ELEMENTS
from jaximp.perturbation.trial_fits import BATCH, fit_windows, with_torques
from jaximp.perturbation.trials import VOLUNTARY_DELAY, Trials
from jaximp.types import AnyArray, Numbers

SHORTEST, BEYOND, LENGTHS = 0.04, 1.5, BATCH // 4 - 1
"""Windows that are tried beside the chosen one: the shortest [s], the longest as a share of it, and how many."""


@dataclass(frozen=True)
class OtherWindows:
    """Estimates of one method from windows of L lengths."""

    window: Numbers
    """(L,) [s]"""
    names: tuple[str, ...]
    theta: Numbers
    """(L, p)"""
    stderr: Numbers
    """(L, p)"""
    dof: Numbers
    """(L,)"""

    def interval(self, level: float = 0.95) -> tuple[Numbers, Numbers]:
        """(L, p) lower and upper end."""
        return confidence_interval(self.theta, self.stderr, self.dof, level)


def at_other_windows(
    perturbed: Trials,
    unperturbed: Trials | None,
    arm: KnownArm,
    method: str,
    window: float = VOLUNTARY_DELAY,
    cutoff: Num[AnyArray, "2"] | None = None,
) -> OtherWindows | None:
    """Estimates from windows between 40 ms and half as much again as the window, where the trials last so long.

    **Returns:** None for methods that estimate the impedance themselves: they would have to run for each length.
    """
    rate, linearised = perturbed.sample_rate, METHODS[method].linearised
    last = int(np.min(perturbed.position.shape[-2] - np.asarray(perturbed.onset))) - 1
    longest = max(window, min(BEYOND * window, last / rate))
    found = isolate(perturbed, unperturbed, arm, method, longest, cutoff)
    if found.impedance is not None:
        return None
    joint, moved = with_torques(perturbed, found.deviations, arm, linearised)
    lengths = np.linspace(min(SHORTEST, window / 2), longest, LENGTHS)
    lengths = np.unique(np.append(lengths[np.abs(lengths - window) > 1e-3], window))
    inside = np.arange(joint.torque.shape[-2]) <= np.round(lengths * rate)[:, None]
    names = ELEMENTS if linearised else SYMMETRIC_ELEMENTS
    return OtherWindows(lengths, names, *fit_windows(joint, moved, inside, linearised))
