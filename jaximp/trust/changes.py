"""Whether windows contradict each other beyond their errors: what a parameter that changes over time does."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from jaximp.trust.score_tests import FAMILYWISE, SHARE
from jaximp.types import Numbers

MOST_LEVELS, MOST_COMPARED = 4, 200
"""Levels that a summary names, and windows among which they are sought."""
FEWEST = 3
"""Windows that are compared."""
BLOCKS, SELDOM, AGREE = 6, 0.003, 3.0
"""Stretches of a record between which a gain is compared, with what probability a constant mass seems to change, and
how well all parameters must agree on a common factor, by chi-squared per degree of freedom."""


@dataclass(frozen=True)
class Course:
    """How a parameter changes over a record, as people tell it."""

    values: tuple[float, ...]
    """Levels, one after another; or the two ends between which it moves."""
    at: tuple[float, ...]
    """When one level ends and the next begins [s]; empty where it moves otherwise."""
    unit: str
    sure: str
    """How sure it is that it changes, in words."""

    @property
    def how(self) -> str:
        """`40 until 150 s, then 80`, or `between 40 and 80`."""
        told = [f"{value:.3g}" for value in self.values]
        if not self.at:
            return f"between {told[0]} and {told[1]}"
        until = [f"{value} until {time:.4g} s" for value, time in zip(told, self.at, strict=False)]
        return ", then ".join([*until, told[-1]])

    def __str__(self) -> str:
        return f"{self.how} {self.unit}, {self.sure}"


class Change(NamedTuple):
    """One parameter over windows that share no rows."""

    low: float
    """Smallest value, less what scatter from its error alone would add."""
    high: float
    """Largest value."""
    p: float
    """Probability of a scatter as large as this where the parameter does not change."""

    @property
    def matters(self) -> bool:
        """Whether the values differ by a share that matters."""
        return self.high - self.low > SHARE * max(abs(self.low), abs(self.high))


def same_in_all(value: Numbers, stderr: Numbers, dof: Numbers) -> Change:
    """Compare K independent estimates of one quantity, all arguments (K,).

    The ends are those of the estimates after each was drawn to their mean, as far as its error says.

    **Source:** Cochran 1937. Errors are known with few degrees of freedom: each Student's t counts as the normal
    deviate that is as rare, which holds for any number of windows. (The F of Welch 1951 takes 300 constant windows of 8
    degrees of freedom for a change at 1 % in 7 % of all cases.) The variance of the change is that of DerSimonian and
    Laird 1986.
    """
    from scipy.special import chdtrc, ndtri, stdtr

    weight = 1 / stderr**2
    share = weight / weight.sum()
    mean = float(share @ value)
    own = 1 - share
    t = np.abs(value - mean) / (stderr * np.sqrt(own))
    deviate = ndtri(np.maximum(stdtr(dof, -t), np.finfo(float).tiny))
    p = float(chdtrc(len(value) - 1, own @ deviate**2))
    scatter = float(weight @ (value - mean) ** 2)
    variance = max(scatter - (len(value) - 1), 0) / float(weight @ own)
    drawn = mean + variance / (variance + stderr**2) * (value - mean)
    return Change(float(drawn.min()), float(drawn.max()), p)


def find_changes(value: Numbers, stderr: Numbers, dof: Numbers) -> dict[int, Change]:
    """The parameters that are not the same in all windows, by column; constant ones are among them with a probability
    of `FAMILYWISE`, all together.

    **Arguments:** estimates and errors (K, p) of windows that share no rows, and degrees of freedom (K,).
    """
    known = np.isfinite(value).all(axis=1) & (stderr > 0).all(axis=1) & (dof > 0)
    if known.sum() < FEWEST:
        return {}
    value, stderr, dof = value[known], stderr[known], dof[known]
    found = {k: same_in_all(value[:, k], stderr[:, k], dof) for k in range(value.shape[1])}
    return {k: one for k, one in found.items() if one.p < FAMILYWISE / len(found) and one.matters}


def common_gain(value: Numbers, stderr: Numbers, dof: Numbers, mass: int) -> Change | None:
    """By what factor all parameters change together, as where the gain of a sensor changes; None where they do not.

    A mass does not change by itself. Where it does, and all others by the same share, it is the sensor.

    **Arguments:** estimates and errors (K, p) of windows that share no rows, in the order of time, and degrees of
    freedom (K,); `mass`, the column of a mass or an inertia.
    """
    known = np.isfinite(value).all(axis=1) & (stderr > 0).all(axis=1) & (dof > 0)
    if known.sum() < BLOCKS * FEWEST:
        return None
    parts = np.array_split(np.flatnonzero(known), BLOCKS)
    weight = np.array([(1 / stderr[part] ** 2).sum(axis=0) for part in parts])
    mean = np.array([(value[part] / stderr[part] ** 2).sum(axis=0) for part in parts]) / weight
    whole = (mean * weight).sum(axis=0) / weight.sum(axis=0)
    sure = weight * whole**2
    gain, error = (sure * mean / whole).sum(axis=1) / sure.sum(axis=1), 1 / np.sqrt(sure.sum(axis=1))
    left = (weight * (mean - gain[:, None] * whole) ** 2).sum() / ((BLOCKS - 1) * (value.shape[1] - 1))
    many = np.full(BLOCKS, np.inf)
    of_mass = same_in_all(mean[:, mass], 1 / np.sqrt(weight[:, mass]), many)
    together = same_in_all(gain, error, many)
    return together if of_mass.p < SELDOM and left < AGREE and together.high - together.low > SHARE else None


class Level(NamedTuple):
    """Windows in a row with one value."""

    first: int
    last: int
    value: float


def levels(value: Numbers, stderr: Numbers) -> list[Level]:
    """The fewest levels, one after another, that leave no more scatter than the errors of K estimates (K,) explain;
    none where even `MOST_LEVELS` do not, as of a parameter that changes steadily.

    **Source:** optimal partitions by dynamic programming, Fisher 1958.
    """
    from scipy.special import chdtrc

    count, every = len(value), -(-len(value) // MOST_COMPARED)
    value, stderr = value[::every], stderr[::every]
    weight = 1 / stderr**2
    sums = [np.concatenate([np.zeros(1), np.cumsum(x)]) for x in (weight, weight * value, weight * value**2)]
    w, wv, wvv = (x[None, :] - x[:, None] for x in sums)
    with np.errstate(invalid="ignore", divide="ignore"):
        cost = np.where(w > 0, wvv - wv**2 / w, np.inf)  # of one level from the first index up to the second
    best, cuts = cost[0], []
    for parts in range(1, MOST_LEVELS + 1):
        if parts > 1:
            whole = best[:, None] + cost
            cuts.append(whole.argmin(axis=0))
            best = whole.min(axis=0)
        free = len(value) - parts
        if free > 0 and chdtrc(free, max(float(best[-1]), 0)) > FAMILYWISE:
            ends = [len(value)]
            for cut in reversed(cuts):
                ends.append(int(cut[ends[-1]]))
            edges = [0, *ends[::-1]]
            means = [float(wv[a, b] / w[a, b]) for a, b in pairwise(edges)]
            last = [min(every * b, count) - 1 for b in edges[1:]]
            return [Level(every * a, b, mean) for a, b, mean in zip(edges, last, means, strict=False)]
    return []
