"""Numbers with names, units and what is not known of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaximp.least_squares.window import confidence_interval
from jaximp.results import Column, Result
from jaximp.types import AnyArray, Numbers


@dataclass(frozen=True, eq=False)
class Quantities(Result):
    """Estimates of p named quantities with their covariance; NaN for those that the data do not determine."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    theta: Numbers
    """(p,)"""
    covariance: Numbers
    """(p, p)"""
    dof: Numbers
    """(p,) degrees of freedom of each standard error, infinite where it is known."""

    @property
    def value(self) -> Numbers:
        """(p,)"""
        return self.theta

    @property
    def stderr(self) -> Numbers:
        """(p,)"""
        return np.sqrt(np.maximum(np.diagonal(self.covariance), 0))

    def interval(self, level: float = 0.95) -> tuple[Numbers, Numbers]:
        """(p,) lower and upper ends of the intervals that hold the truth with probability `level`, each for itself."""
        low, high = confidence_interval(self.theta[:, None], self.stderr[:, None], self.dof, level)
        return low[:, 0], high[:, 0]

    def columns(self) -> list[Column]:
        """A row for each quantity."""
        low, high = self.interval()
        return [
            Column("parameter", "", list(self.names)),
            Column("unit", "", list(self.units)),
            Column("value", "", self.theta),
            Column("stderr", "", self.stderr),
            Column("low", "", low),
            Column("high", "", high),
        ]


def freedom(*parts: tuple[AnyArray, AnyArray]) -> Numbers:
    """(p,) degrees of freedom of a sum of variances, by Welch and Satterthwaite.

    **Arguments:** variances (p,) that are independent, each with its degrees of freedom, which do not matter where a
    variance is zero.
    """
    variances = [(np.asarray(variance, float), np.asarray(dof, float)) for variance, dof in parts]
    total = sum(variance for variance, _ in variances)
    with np.errstate(divide="ignore", invalid="ignore"):
        uncertain = sum(np.where(variance > 0, variance**2 / dof, 0.0) for variance, dof in variances)
        return np.asarray(total**2 / uncertain, float)
