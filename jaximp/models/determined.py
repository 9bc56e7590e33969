"""Whether data determine a parameter of a robot or of a load: one meaning for estimates, ranges and payloads."""

from __future__ import annotations

import numpy as np
from jaxtyping import Num
from numpy.typing import NDArray

from jaximp.models.chain import Chain
from jaximp.models.spatial import NEVER_NEGATIVE, PARAMETERS, largest
from jaximp.types import AnyArray, Numbers

DETERMINED = 0.25
"""Half of a 95 % interval, as a share of the parameter's size, up to which the data determine it."""
SMALL = 1e-9
"""Factors in a sum that are rounding."""


def openness(low: Num[AnyArray, " k"], high: Num[AnyArray, " k"], size: Num[AnyArray, " k"]) -> Numbers:
    """(k,) half of each interval as a share of the parameter's size: of the middle of the interval, or of `size` where
    that is larger. Infinite where an end is missing."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    ended = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(ended, low, 0.0), np.where(ended, high, 1.0)
    size = np.maximum(np.abs(low + high) / 2, size)
    return np.where(ended & (size > 0), (high - low) / 2 / np.where(size > 0, size, 1.0), np.inf)


def determined(low: Num[AnyArray, " k"], high: Num[AnyArray, " k"], size: Num[AnyArray, " k"]) -> NDArray[np.bool_]:
    """(k,) whether half of each interval is at most a quarter of the parameter's size.

    What cannot be negative (a mass, a moment of inertia, friction) compares with itself: its `size` is zero. What can
    be near zero (first moments, products of inertia) compares with the largest value that it can have in a body of that
    mass and these moments of inertia (`spatial.largest`).
    """
    return np.asarray(openness(low, high, size) <= DETERMINED)


def sizes_of_body(parameters: Num[AnyArray, "10"]) -> Numbers:
    """(10,) of a body's parameters, for `determined`."""
    never = np.array([name in NEVER_NEGATIVE for name in PARAMETERS])
    return np.where(never, 0.0, largest(np.asarray(parameters, float)))


def sizes_of_chain(chain: Chain, rows: Num[AnyArray, "k P"] | None = None) -> Numbers:
    """(k,) of sums of the standard parameters of a chain, for `determined`: by its URDF, of each sum the sizes of its
    parts. By default of its base parameters; `np.eye(P)` stands for the standard parameters."""
    rows = np.asarray(chain.base.map if rows is None else rows, float)
    links = np.asarray(chain.links, float)
    most, signed = np.zeros(rows.shape[1]), np.zeros(rows.shape[1], bool)
    most[: links.size] = np.concatenate([largest(link) for link in links])
    signed[: links.size] = np.tile([name not in NEVER_NEGATIVE for name in PARAMETERS], len(links))
    # A sum of what cannot be negative cannot be negative.
    either = (rows < -SMALL).any(axis=1) | (np.abs(rows[:, signed]) > SMALL).any(axis=1)
    return np.where(either, np.abs(rows) @ most, 0.0)
