"""What parameters predict: scores on data that were not seen, bands of torque, and what a prior alone expects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, Num

from jaximp.least_squares.noise import WhiteRows
from jaximp.posterior.priors import Prior
from jaximp.types import AnyArray, Numbers

NU = 4.0
"""Degrees of freedom of heavy-tailed noise, where none are given."""
BLOCKS = 30
"""The standard error of a mean score comes from the means of so many stretches of time."""


def log_score(
    samples: Num[AnyArray, "draws P"], rows: WhiteRows, *, heavy_tails: bool | float = False
) -> tuple[float, float]:
    """Mean log predictive density per row of data that the samples have not seen, and its standard error.

    For the comparison of models: the larger the better. Scores of the same torque through the same filters compare. A
    difference of scores is much surer than either: `mean_score` of the differences of `log_scores` row by row.
    """
    return mean_score(log_scores(samples, rows, heavy_tails=heavy_tails)[rows.valid])


def mean_score(scores: Num[AnyArray, " R"]) -> tuple[float, float]:
    """Mean of scores that follow each other in time, and its standard error by the means of `BLOCKS` stretches.

    Neighbouring scores are alike where a model lacks something, and rows by themselves would say too much.
    """
    scores = np.asarray(scores, float)
    means = np.array([part.mean() for part in np.array_split(scores, min(BLOCKS, len(scores)))])
    return float(scores.mean()), float(means.std(ddof=1) / np.sqrt(len(means)))


def log_scores(samples: Num[AnyArray, "draws P"], rows: WhiteRows, *, heavy_tails: bool | float = False) -> Numbers:
    """(R, n) log of the predictive density of every row, given the rows before it; zero where it is not valid.

    It is that of the torque itself, whatever made its noise white, so that models with noise of their own compare.

    **Source:** the pointwise predictive density of Gelman, Hwang and Vehtari 2014.
    """
    samples, p = np.asarray(samples, float), rows.W.shape[-1]
    if samples.shape[1] != p + len(rows.count):
        raise ValueError(
            f"samples have {samples.shape[1]} columns: give {p} parameters and {len(rows.count)} logarithms of noise"
        )
    nu = jnp.asarray(NU if heavy_tails is True else float(heavy_tails))
    out = np.zeros(rows.y.shape)
    for k, log_noise in enumerate(samples[:, p:].T):
        for first in range(0, len(out), 1000):
            part = slice(first, first + 1000)
            z = (rows.y[part, k, None] - rows.W[part, k] @ samples[:, :p].T) * np.exp(-log_noise)
            one = np.asarray(student(jnp.asarray(z), nu)) if heavy_tails else -(z**2 + np.log(2 * np.pi)) / 2
            out[part, k] = np.logaddexp.reduce(one - log_noise, axis=1) - np.log(len(samples))
    return np.where(rows.valid, out - np.log(rows.size), 0)


def torque_bands(
    samples: Num[AnyArray, "draws P"],
    W: Num[AnyArray, "S *n p"],
    levels: Sequence[float] = (0.025, 0.25, 0.5, 0.75, 0.975),
    *,
    noise: bool = True,
    heavy_tails: bool | float = False,
    seed: int = 0,
) -> Numbers:
    """(levels, S, *n) quantiles of the torque [N m] that samples predict for a motion, row by row.

    **Arguments:** `W` rows that are not whitened; `heavy_tails` as for the density; `noise` adds that of a row, for
    bands that hold so much of the measured torque. (Of one row: neighbouring rows share their noise, which the bands do
    not show.)
    """
    W, samples = np.asarray(W, float), np.asarray(samples, float)
    p, generator = W.shape[-1], np.random.default_rng(seed)
    shape, out = W.shape[:-1], []
    scale, nu = np.exp(samples[:, p:]), NU if heavy_tails is True else float(heavy_tails)
    for first in range(0, shape[0], 1000):
        torque = W[first : first + 1000] @ samples[:, :p].T
        if noise:
            drawn = generator.standard_t(nu, torque.shape) if nu else generator.normal(size=torque.shape)
            torque = torque + (scale[:, 0] if W.ndim == 2 else scale.T) * drawn
        out.append(np.quantile(torque, levels, axis=-1))
    return np.concatenate(out, axis=1)


@dataclass(frozen=True)
class PriorPredictive:
    """The torque that a prior expects, compared with the measured one."""

    ratio: tuple[float, float, float]
    """Root mean square of the torque that the prior expects over that of the measured one: 5, 50 and 95 % of draws.
    NaN where all is flat. Far from one on both sides of it, the prior and the recording contradict each other."""
    flat: tuple[str, ...]
    """Parameters about which the prior says nothing; they are left out."""


def prior_predictive(
    prior: Prior,
    W: Num[AnyArray, "S *n p"],
    torque: Num[AnyArray, "S *n"],
    draws: int = 1000,
    seed: int = 0,
) -> PriorPredictive:
    """The size of the torque that the proper part of a prior implies for a recorded motion.

    **Arguments:** `W` (S, p) or (S, n, p) for the first p parameters of the prior; the measured torque (S,) or (S, n).
    """
    W = np.asarray(W, float)
    p = W.shape[-1]
    flat = tuple(name for name, proper in zip(prior.names, prior.proper, strict=True) if not proper)
    known = np.flatnonzero(prior.proper[:p])
    if not len(known):
        return PriorPredictive((np.nan, np.nan, np.nan), flat)
    x = prior.draws(draws, np.random.default_rng(seed))[:, known]
    R = np.asarray(np.linalg.qr(W.reshape(-1, p)[:, known], mode="r"))
    size = np.linalg.norm(x @ R.T, axis=1) / np.linalg.norm(torque)
    low, middle, high = (float(q) for q in np.quantile(size, [0.05, 0.5, 0.95]))
    return PriorPredictive((low, middle, high), flat)


def student(z: Array, nu: Array) -> Array:
    """Log density of Student's t."""
    scale = gammaln((nu + 1) / 2) - gammaln(nu / 2) - jnp.log(nu * jnp.pi) / 2
    return scale - (nu + 1) / 2 * jnp.log1p(z**2 / nu)
