"""The filters of a recording: settings, and what they are at one sample rate.

Tout et al. 2023, III-B.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from jaximp import signals
from jaximp.types import nearest

KINDS = ["wideband", "central"]
"""Of derivatives."""
OPEN_BAND = 0.8
"""Where no filter limits the position: up to where derivatives are right, as a share of half the sample rate."""


@dataclass(frozen=True)
class FilterSettings:
    """Filters of Tout et al. 2023, III-B; all are Butterworth filters run forward and backward."""

    position_cutoff: float | None = None
    """Low-pass of the position before it is differentiated [Hz]; the paper's f_c, above ten natural frequencies. The
    torque does not pass it, so whatever it takes off the motion biases the estimates: leave room above the motion."""
    position_order: int = 8
    """Order of that low-pass, which runs forward and backward."""
    decimation_cutoff: float | None = None
    """Low-pass of the torque and of every column of the regressor [Hz]; the paper's f_cd, above two natural
    frequencies."""
    decimation_order: int = 4
    """Order of that low-pass."""
    high_pass: float | None = None
    """High-pass of the torque and of every column [Hz], which takes slow drift out of both sides."""
    high_pass_order: int = 2
    """Order of that high-pass."""
    decimate: int | None = None
    """Keep every n-th sample after the filters; by default five samples per period of `decimation_cutoff`."""
    mode: str = "once"
    """`once` filters the recording and then slides; `window` filters inside every window, as the paper writes."""
    drop_transient: bool = True
    """With `mode = "window"`: leave out the rows at both ends of the window that its edges disturb. Kept, they biased
    the inertia by 2.2 standard deviations on the simulated rig; left out, by 0.1 (experiments/coverage.py)."""
    derivatives: str = "wideband"
    """`wideband` differentiates the position with an error below 0.1 % up to its cut-off, at any sample rate (without a
    cut-off up to 0.8 of half the rate); `central` takes the paper's central differences, which are 2 % off at a ninth
    of half the sample rate."""
    measured_derivatives: bool = False
    """Use the recording's velocity (and acceleration, where it has one) in place of differences of the position."""


@dataclass(frozen=True)
class Filters:
    """Designed filters of one recording."""

    position: signals.Sections | None
    """Second-order sections that the position passes before it is differentiated."""
    parallel: signals.Sections | None
    """Second-order sections that the torque and every column pass."""
    decimate: int
    """Every n-th sample is kept."""
    band: float | None = None
    """Share of half the sample rate up to which derivatives are right; None stands for central differences."""

    @property
    def differentiator(self) -> signals.Differentiator:
        """What makes velocity and acceleration of the position."""
        return signals.CENTRAL if self.band is None else signals.design_differentiator(self.band)

    @property
    def reach(self) -> int:
        """Samples beside an end or a gap that the filters spoil."""
        return _reach_of(self, 0.01)

    @property
    def bridge(self) -> int:
        """Samples that a gap may last for the filters to pass over it: one in 32 of those that they reach."""
        return self.reach // 32

    @property
    def ringing(self) -> int:
        """Samples beside a jump of the position until the filters' answer to it has died out."""
        return _reach_of(self, 1e-6)

    @property
    def noise(self) -> NDArray[np.float64] | None:
        """Autocovariance by lag, in rows, of white torque noise after the filters."""
        return None if self.parallel is None else _autocovariance(self)


@lru_cache(maxsize=64)
def _reach_of(filters: Filters, share: float) -> int:
    reach = sum(signals.reach(sos, share) for sos in (filters.position, filters.parallel) if sos is not None)
    return reach if filters.band is None else reach + filters.differentiator.half


@lru_cache(maxsize=64)
def _autocovariance(filters: Filters) -> NDArray[np.float64]:
    assert filters.parallel is not None
    return signals.autocovariance(filters.parallel, filters.decimate)


@lru_cache(maxsize=64)
def design_filters(settings: FilterSettings, sample_rate: float) -> Filters:
    """Butterworth filters for a recording of this sample rate [Hz]."""
    parallel = [
        signals.butterworth(order, cutoff, sample_rate, kind)
        for order, cutoff, kind in (
            (settings.decimation_order, settings.decimation_cutoff, "lowpass"),
            (settings.high_pass_order, settings.high_pass, "highpass"),
        )
        if cutoff is not None
    ]
    decimate = settings.decimate
    if decimate is None:
        cutoff = settings.decimation_cutoff
        decimate = 1 if cutoff is None else max(1, int(sample_rate / (5 * cutoff)))
    position = None
    if settings.position_cutoff is not None:
        position = signals.butterworth(settings.position_order, settings.position_cutoff, sample_rate)
    return Filters(
        _plain(position),
        _plain(np.concatenate(parallel)) if parallel else None,
        decimate,
        _band(settings, sample_rate),
    )


def _band(settings: FilterSettings, sample_rate: float) -> float | None:
    """Up to where derivatives must be right, as a share of half the sample rate."""
    if settings.derivatives == "central":
        return None
    if settings.derivatives != "wideband":
        raise ValueError(f"filter.derivatives is '{settings.derivatives}': {nearest(settings.derivatives, KINDS)}")
    return OPEN_BAND if settings.position_cutoff is None else 2 * settings.position_cutoff / sample_rate


def _plain(sos: NDArray[np.float64] | None) -> signals.Sections | None:
    """As plain numbers, which make `Filters` hashable: recordings filtered alike share compiled code."""
    return None if sos is None else tuple(tuple(section) for section in sos.tolist())
