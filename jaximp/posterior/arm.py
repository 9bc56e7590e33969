"""An arm's impedance in draws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaximp.perturbation.trials_result import TrialsResult
from jaximp.posterior.draws import Posterior, credible_interval
from jaximp.results import Column, Result
from jaximp.trust.verdicts import TRUSTED, UNCONVERGED
from jaximp.types import Numbers


@dataclass(frozen=True)
class ArmInference(Result):
    """An arm's impedance in draws around its main estimate."""

    identified: TrialsResult
    """What the draws stand around."""
    posterior: Posterior
    """Of damping, stiffness and all that follows from them."""

    @property
    def names(self) -> tuple[str, ...]:
        return self.posterior.names

    @property
    def units(self) -> tuple[str, ...]:
        return self.posterior.units

    @property
    def value(self) -> Numbers:
        """(p,) means of the draws."""
        return self.posterior.mean

    @property
    def stderr(self) -> Numbers:
        """(p,) standard deviations of the draws."""
        return np.sqrt(np.diagonal(self.posterior.covariance))

    @property
    def covariance(self) -> Numbers:
        """(p, p) of the draws."""
        return self.posterior.covariance

    @property
    def dof(self) -> float:
        """Intervals are quantiles of the draws: no distribution is assumed."""
        return np.inf

    def interval(self, level: float = 0.95) -> tuple[Numbers, Numbers]:
        """(p,) lower and upper ends of credible intervals, with equal probability on both sides."""
        return credible_interval(self.posterior.samples, level)

    @property
    def why(self) -> str:
        """Why the draws, or the estimate that they stand around, cannot be trusted; empty where they can."""
        found = self.identified.main
        return self.posterior.why or ("" if found.verdict == TRUSTED else f"{found.verdict}: {found.reason}")

    @property
    def trusted(self) -> bool:
        """Whether nothing speaks against the draws, see `why`."""
        return not self.why

    def columns(self) -> list[Column]:
        """One row: mean and standard deviation of the draws, verdict and reason."""
        columns = [
            Column(f"{name}{tail}", unit, number)
            for name, unit, *numbers in zip(self.names, self.units, self.value, self.stderr, strict=True)
            for tail, number in zip(("", "_stderr"), numbers, strict=True)
        ]
        verdict = self.identified.main.verdict if not self.posterior.why else UNCONVERGED
        return [*columns, Column("verdict", "", verdict), Column("reason", "", self.why)]
