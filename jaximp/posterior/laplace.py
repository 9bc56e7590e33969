"""Normal approximations of the posteriors of windows at their modes, where no sampler is at hand."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np

from jaximp.posterior.draws import PosteriorMany
from jaximp.types import AnyArray

CHAINS = 4
SAMPLER = "Laplace's normal approximation at the mode; blackjax draws from the posterior: pip install 'jaximp[windows]'"


def normal_many(
    starts: AnyArray, covariances: AnyArray, key: AnyArray, *, ess: float, names: Sequence[str], units: Sequence[str]
) -> PosteriorMany:
    """Independent draws from normal distributions at the modes `starts` (M, p), with `covariances` (M, p, p).

    **Arguments:** `ess` how many draws there are at least, in `CHAINS` parts.

    **Returns:** a `PosteriorMany`, in which a window whose covariance is not positive definite is NaN and says so.

    **Source:** Laplace's method; MacKay, Information Theory, Inference, and Learning Algorithms (2003), 27.
    """
    M, p = np.shape(starts)
    draws = -(-int(ess) // CHAINS)
    z = np.array(jax.random.normal(key, (M, CHAINS, draws, p)))
    chains = np.full_like(z, np.nan)
    for k, (start, covariance) in enumerate(zip(np.asarray(starts), np.asarray(covariances), strict=True)):
        if np.isfinite(start).all() and np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0:
            chains[k] = start + z[k] @ np.linalg.cholesky(covariance).T
    known = np.isfinite(chains).all(axis=(1, 2, 3))
    size = np.where(known, float(CHAINS * draws), 0.0)[:, None] * np.ones(p)
    return PosteriorMany(
        chains=chains,
        log_density=np.where(known[:, None, None], -0.5 * (z**2).sum(axis=-1), np.nan),
        acceptance=np.where(known, 1.0, np.nan)[:, None] * np.ones(CHAINS),
        ess=size,
        ess_tail=size,
        rhat=np.where(known, 1.0, np.inf)[:, None] * np.ones(p),
        names=tuple(names),
        units=tuple(units),
        sampler=SAMPLER,
    )
