"""Whether windows contradict each other beyond their errors: what a parameter that changes over time does."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaximp.trust.score_tests import FAMILYWISE, SHARE
from jaximp.types import Numbers

FEWEST = 3
"""Windows that are compared."""


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
