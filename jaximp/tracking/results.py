"""What is known of parameters that move: a path with a band, and how they move."""

from __future__ import annotations

from statistics import NormalDist
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaximp.numerics.compilation import require_numbers
from jaximp.numerics.linear_algebra import root
from jaximp.results import Column, Result
from jaximp.types import AnyArray, Numbers


class Path(eqx.Module):
    """Parameters at the G points of a grid, of one record or of several (R, G, ...)."""

    theta: Float[AnyArray, "*R G p"]
    """In units of the model."""
    covariance: Float[AnyArray, "*R G p p"]
    """Of theta."""

    @property
    def stderr(self) -> Float[AnyArray, "*R G p"]:
        """Standard deviations."""
        return root(jnp.diagonal(jnp.asarray(self.covariance), axis1=-2, axis2=-1))

    def interval(self, level: float = 0.95) -> tuple[Numbers, Numbers]:
        """(G, p): lower and upper ends of the bands that hold the truth with probability `level` at each point."""
        require_numbers("interval", "call it on the results", self, level)
        if not 0 < level < 1:
            raise ValueError(f"the level is {level}: it must be a probability between 0 and 1, such as 0.95")
        half = NormalDist().inv_cdf(0.5 + level / 2) * np.asarray(self.stderr)
        return np.asarray(self.theta) - half, np.asarray(self.theta) + half


class Drift(eqx.Module):
    """How fast parameters move, by L models with their weights: what is not known of it, too."""

    size: Float[AnyArray, "L p"]
    """Standard deviation of what a random walk does in one second (without a sample rate, in one row): of a parameter,
    of its slope, or of the slope's slope, in their units. Zero: the parameter stays where it is."""
    order: Int[AnyArray, " L"]
    """Which of them that is: how often it is integrated until it is the parameter."""
    weight: Float[AnyArray, " L"]
    """They sum to one."""

    def mean(self, order: int) -> Numbers:
        """(p,) of the models of one kind; NaN where it is out of the question."""
        return self._moment(order, 1)

    def stderr(self, order: int) -> Numbers:
        """(p,) standard deviation over the models of one kind."""
        return np.sqrt(np.maximum(self._moment(order, 2) - self.mean(order) ** 2, 0))

    def _moment(self, order: int, power: int) -> Numbers:
        chosen = np.asarray(self.order) == order
        weight = np.asarray(self.weight)[chosen]
        if not chosen.any():
            return np.full(np.shape(self.size)[1], np.nan)
        return np.asarray(weight @ np.asarray(self.size)[chosen] ** power / weight.sum())

    @property
    def moves(self) -> Numbers:
        """(p,) probability that a parameter drifts at all."""
        return np.asarray(np.asarray(self.weight) @ (np.asarray(self.size) > 0))


LIKELY = 0.5
"""A jump that is more probable than this is told."""
AROUND = 10
"""Points on both sides of a jump that its probability may be spread over."""


class Jump(NamedTuple):
    """Where a parameter jumps."""

    name: str
    time: float
    """As `Track.time`."""
    probability: float


class Curve(eqx.Module):
    """A parameter as a function of what it depends on, at K values; where it drifts besides, as it is in the end."""

    at: Float[AnyArray, " K"]
    theta: Float[AnyArray, " K"]
    """In units of the model."""
    stderr: Float[AnyArray, " K"]
    """Standard deviation of theta."""
    name: str = eqx.field(static=True)
    """Of the parameter."""
    unit: str = eqx.field(static=True)

    def interval(self, level: float = 0.95) -> tuple[Numbers, Numbers]:
        """(K,): lower and upper ends of the bands that hold the truth with probability `level` at each value."""
        covariance = np.asarray(self.stderr)[:, None, None] ** 2
        low, high = Path(np.asarray(self.theta)[:, None], covariance).interval(level)
        return low[:, 0], high[:, 0]


class Track(eqx.Module, Result):
    """Parameters along a record, with what is known of how they move."""

    time: Float[AnyArray, " G"]
    """Middle of the rows that belong to each point [s]; without a sample rate, as an index of rows."""
    path: Path
    """What the whole record says (the smoother)."""
    filtered: Path
    """What was known up to each point (the filter); drift sizes, and the size of the noise, are those of the record."""
    jumped: Float[AnyArray, "G p"]
    """Probability that a parameter jumped in front of this point."""
    drift: Drift
    smooth: float
    """Probability that parameters move smoothly: that what does a random walk is not they themselves, but their slopes
    or the slopes' slopes."""
    noise: float
    """Standard deviation of the noise in a white row [N m]; in units of each output's own, where there are several."""
    log_likelihood: float
    """Of all models together, each with its best scale of the noise."""
    innovations: Float[AnyArray, "G r"]
    """What each block says that was not known before, of the most probable model: independent and of unit variance."""
    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    seconds: bool = eqx.field(static=True)
    curves: tuple[Curve, ...] = ()
    """Parameters as functions of what they depend on, where `varies_with` says so."""

    @property
    def theta(self) -> Float[AnyArray, "G p"]:
        """Parameters, from the whole record."""
        return self.path.theta

    @property
    def covariance(self) -> Float[AnyArray, "G p p"]:
        """Of theta."""
        return self.path.covariance

    @property
    def value(self) -> Numbers:
        """(G, p) parameters, from the whole record."""
        return np.asarray(self.path.theta)

    @property
    def stderr(self) -> Numbers:
        """(G, p) standard deviations of theta."""
        return np.asarray(self.path.stderr)

    def interval(self, level: float = 0.95) -> tuple[Numbers, Numbers]:
        """(G, p): lower and upper ends of the bands that hold the truth with probability `level` at each point."""
        return self.path.interval(level)

    def jumps(self, name: str, least: float = LIKELY) -> list[Jump]:
        """Where one parameter jumps, in the order of time, with a probability of at least so much each."""
        found: list[Jump] = []
        time = np.asarray(self.time)
        between = (time + np.append(time[:1], time[:-1])) / 2  # a jump is in front of its point
        left = np.array(self.jumped)[:, self.names.index(name)]
        while True:
            sums = np.convolve(left, np.ones(2 * AROUND + 1), "same")
            middle = int(sums.argmax())
            if not sums[middle] >= least:
                return sorted(found, key=lambda one: one.time)
            near = slice(max(0, middle - AROUND), middle + AROUND + 1)
            at = float((left[near] * between[near]).sum() / left[near].sum())
            found.append(Jump(name, at, min(1.0, float(sums[middle]))))
            left[near] = 0

    def moves(self, name: str) -> float:
        """The probability that a parameter moves at all, by drifting or in jumps."""
        drifts = float(self.drift.moves[self.names.index(name)])
        return max([drifts, *(one.probability for one in self.jumps(name, least=0.01))])

    def columns(self) -> list[Column]:
        """A row for each point of the grid."""
        columns = [Column("time_s", "s", self.time) if self.seconds else Column("row", "1", self.time)]
        for k, (name, unit) in enumerate(zip(self.names, self.units, strict=True)):
            columns += [Column(name, unit, self.value[:, k]), Column(f"{name}_stderr", unit, self.stderr[:, k])]
        return columns
