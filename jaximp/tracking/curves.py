"""A parameter as a function of what is measured beside it: a cubic B-spline whose coefficients do a random walk.

The first coefficient is the parameter itself, which may drift and jump besides; the others are reached from it in
steps, each of which is a column of its own. How large the steps are the likelihood tells, and they may be nothing.

**Source:** Eilers and Marx, Flexible smoothing with B-splines and penalties, 1996.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from jaximp.types import AnyArray, Numbers

INTERVALS, DEGREE = 8, 3
STEPS = INTERVALS + DEGREE - 1
"""From one coefficient to the next."""
SHOWN = 41
"""Values at which a curve is shown."""


@dataclass(frozen=True)
class Curves:
    """Which parameters depend on what."""

    which: tuple[int, ...]
    """The parameters, V of them."""
    values: Numbers
    """(N, V) of what they depend on."""
    low: Numbers
    high: Numbers
    """(V,) between which the values are."""

    @property
    def coefficients(self) -> tuple[int, ...]:
        return (STEPS,) * len(self.which)

    @property
    def owners(self) -> tuple[int, ...]:
        """The parameter of each step."""
        return tuple(i for i in self.which for _ in range(STEPS))

    def of_values(self, values: Numbers) -> Numbers:
        """(M, V, S) how much of each step a parameter has at these values (M, V)."""
        from scipy.interpolate import BSpline

        knots = np.concatenate([np.zeros(DEGREE), np.linspace(0, 1, INTERVALS + 1), np.ones(DEGREE)])
        found = []
        for v, column in enumerate(values.T):
            share = np.clip((column - self.low[v]) / (self.high[v] - self.low[v]), 0, 1)
            splines = BSpline.design_matrix(share, knots, DEGREE).toarray()
            found.append(np.cumsum(splines[:, ::-1], axis=1)[:, ::-1][:, 1:])
        return np.stack(found, axis=1)

    def columns(self, W: Numbers) -> Numbers:
        """(N, n, V S + p): the steps' columns in front of those of the parameters (N, n, p)."""
        shares = self.of_values(self.values)
        steps = [W[..., i, None] * shares[:, None, v] for v, i in enumerate(self.which)]
        return np.concatenate([*steps, W], axis=-1)

    def at_points(self, step: int, points: int, p: int) -> Numbers:
        """(G, p, V S) how much of each step each parameter has, in the mean over the `step` rows of a point."""
        shares = self.of_values(self.values)
        begin = np.minimum(np.arange(points) * step, len(shares) - 1)
        count = np.diff(np.append(begin, len(shares)))
        shares = np.add.reduceat(shares, begin, axis=0) / np.maximum(count, 1)[:, None, None]
        found = np.zeros((points, p, len(self.which), STEPS))
        for v, i in enumerate(self.which):
            found[:, i, v] = shares[:, v]
        return found.reshape(points, p, -1)

    def shown(self, p: int) -> tuple[Numbers, Numbers]:
        """Values (K, V), and (K V, V S + p) what a parameter there has of steps and parameters."""
        at = self.low + np.linspace(0, 1, SHOWN)[:, None] * (self.high - self.low)
        shares, V = self.of_values(at), len(self.which)
        table = np.zeros((SHOWN, V, V * STEPS + p))
        for v, i in enumerate(self.which):
            table[:, v, v * STEPS : (v + 1) * STEPS] = shares[:, v]
            table[:, v, V * STEPS + i] = 1
        return at, table.reshape(SHOWN * V, -1)


def curves_of(varies_with: dict[str, AnyArray], names: tuple[str, ...], counts: Bool[AnyArray, " N"]) -> Curves | None:
    """Of parameters by name; `counts` False where a value does not matter."""
    if not varies_with:
        return None
    unknown = sorted(set(varies_with) - set(names))
    if unknown:
        raise ValueError(f"varies_with names {', '.join(unknown)}: the parameters are {', '.join(names)}")
    columns = []
    for name, given in varies_with.items():
        values, n = np.asarray(given, float), len(counts)
        if values.shape != (n,):
            raise ValueError(f"varies_with[{name!r}] has shape {values.shape}: give one number for each of {n} rows")
        if not np.isfinite(values[counts]).all():
            raise ValueError(f"varies_with[{name!r}] is not finite in rows that count: mark them as not valid")
        inside = values[counts]
        if not inside.max() > inside.min():
            raise ValueError(f"varies_with[{name!r}] is the same in all rows: nothing can vary with it")
        columns.append(np.interp(np.arange(n), np.flatnonzero(counts), inside))
    values = np.stack(columns, axis=1)
    return Curves(tuple(names.index(name) for name in varies_with), values, values.min(axis=0), values.max(axis=0))
