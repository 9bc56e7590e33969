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

    **Source:** Cochran 1937 for the statistic, Welch 1951 for its distribution where errors are known with few degrees
    of freedom; DerSimonian and Laird 1986 for the variance of the change.
    """
    from scipy.special import fdtrc

    count, weight = len(value), 1 / stderr**2
    share = weight / weight.sum()
    mean = float(share @ value)
    scatter = float(weight @ (value - mean) ** 2)
    lost = float(((1 - share) ** 2 / dof).sum())
    statistic = scatter / (count - 1) / (1 + 2 * (count - 2) / (count**2 - 1) * lost)
    p = float(fdtrc(count - 1, (count**2 - 1) / (3 * lost), statistic))
    variance = max(scatter - (count - 1), 0) / float(weight.sum() * (1 - share @ share))
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
