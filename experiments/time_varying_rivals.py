"""Rivals of `track` from the literature, small and in numpy: how they estimate parameters that change.

All take white rows (N, p) and torque (N,) and give parameters (N, p). Those of one record: recursive least squares with
the forgetting factors of Tout et al. 2023, windows as long as needed (this toolkit's), and a basis expansion after
Sanyal et al. 2005 and Guarin and Kearney 2017: the stiffness as a sum of cubic B-splines of time, whose number is that
with the least BIC. Those of an ensemble of trials with the same course: least squares over all trials at each instant,
after Lortie and Kearney 2001, and over short segments of all trials, after Ludvig and Perreault 2012.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from jaximp import adaptive_least_squares, recursive_least_squares

Numbers = NDArray[np.float64]
Rows = tuple[Numbers, Numbers]

FORGETTING = (0.995, 0.999, 0.9995)
"""For each sample at 1 kHz."""
SHORTEST, LONGEST, WANTED = 0.6, 8.0, 6.0
"""Of windows as long as needed [s], and the standard error of the stiffness [N m/rad] that they aim at."""
BASES = (4, 6, 8, 11, 16, 22, 32, 45)
"""How many B-splines are tried."""
TRIALS, ENSEMBLES = 20, 10
"""Of each ensemble, and how many ensembles are drawn from the records."""
INSTANT, SEGMENT = 0.03, 0.2
"""Length of what counts as one instant, and of a short segment [s]."""


def causal(W: Numbers, y: Numbers, rate: float) -> dict[str, Numbers]:
    """What each knows up to each instant."""
    found = {
        f"RLS {factor:g}": np.asarray(recursive_least_squares(W, y, factor ** (1000 / rate)).theta)
        for factor in FORGETTING
    }
    sure = np.array([np.inf] * (W.shape[1] - 1) + [WANTED])
    fit = adaptive_least_squares(W, y, sure, SHORTEST, LONGEST, step=0.02, sample_rate=rate)
    theta, last = np.asarray(fit.theta), np.asarray(fit.first) + np.asarray(fit.samples).astype(int) - 1
    known = np.isfinite(theta[:, 0])
    held = np.clip(np.searchsorted(last[known], np.arange(len(y)), side="right") - 1, 0, None)
    return found | {"window as long as needed": theta[known][held]}


def basis_expansion(W: Numbers, y: Numbers) -> Numbers:
    """The last parameter is a sum of cubic B-splines of time, and the others are constant."""
    t, found = np.linspace(0, 1, len(y)), []
    for count in BASES:
        knots = np.concatenate([np.zeros(3), np.linspace(0, 1, count - 2), np.ones(3)])
        B = BSpline.design_matrix(t, knots, 3).toarray()
        rows = np.column_stack([W[:, :-1], W[:, -1:] * B])
        theta = np.linalg.lstsq(rows, y)[0]
        squares = float(np.sum((y - rows @ theta) ** 2))
        bic = len(y) * np.log(squares) + np.log(len(y)) * rows.shape[1]
        constant = np.broadcast_to(theta[: W.shape[1] - 1], (len(y), W.shape[1] - 1))
        found.append((bic, np.column_stack([constant, B @ theta[W.shape[1] - 1 :]])))
    return min(found, key=lambda one: one[0])[1]


def over_trials(W: Numbers, y: Numbers, length: int) -> Numbers:
    """Least squares over all trials (M, N, p) and a stretch of `length` rows around each instant."""
    first = np.clip(np.arange(W.shape[1]) - length // 2, 0, W.shape[1] - length)

    def sums(x: Numbers) -> Numbers:
        total = np.concatenate([np.zeros((1, *x.shape[1:])), np.cumsum(x, axis=0)])
        return np.asarray(total[first + length] - total[first])

    information = sums(np.einsum("mnp,mnq->npq", W, W))
    return np.asarray(np.linalg.solve(information, sums(np.einsum("mnp,mn->np", W, y))[..., None])[..., 0])


def ensembles(records: list[Rows], rate: float, seed: int = 0) -> dict[str, list[Numbers]]:
    """Estimates from some ensembles, each of other trials."""
    random, found = np.random.default_rng(seed), {}
    trials = min(TRIALS, len(records))
    for name, seconds in ((f"ensemble of {trials}", INSTANT), (f"segments of {trials}", SEGMENT)):
        several: list[Any] = []
        for _ in range(ENSEMBLES):
            chosen = random.choice(len(records), trials, replace=False)
            W, y = (np.stack([records[k][what] for k in chosen]) for what in (0, 1))
            several.append(over_trials(W, y, max(1, round(seconds * rate))))
        found[name] = several
    return found
