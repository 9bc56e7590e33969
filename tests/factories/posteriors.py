"""A linear model whose posterior is known exactly, chains that sample it, and whether they agree with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaximp.posterior.draws import Posterior, effective_samples, exact_posterior
from jaximp.posterior.ensemble import sample_posterior


class Linear(eqx.Module):
    """`|R [theta; -1]|^2` with Gaussian noise of unknown size, flat in log(noise)."""

    R: Float[Array, "*M q q"]
    count: Float[Array, "*M"]
    names: tuple[str, ...] = ("a", "b", "c", "log_noise")
    units: tuple[str, ...] = ("kg m^2", "N m s/rad", "N m/rad", "1")

    def __call__(self, theta: Array) -> Array:
        residual = self.R[:, :-1] @ theta[:-1] - self.R[:, -1]
        return -self.count * theta[-1] - (residual**2).sum() / 2 * jnp.exp(-2 * theta[-1])


def triangle_of(seed: int, rows: int = 15) -> np.ndarray:
    """Of correlated columns of unlike units."""
    random = np.random.default_rng(seed)
    W = random.normal(size=(rows, 3)) @ np.array([[1, 0.9, 0], [0, 1, 0], [0, 0, 1]]) * [0.01, 1, 50]
    y = W @ [0.015, 0.7, 60.0] + random.normal(size=rows)
    return np.linalg.qr(np.column_stack([W, y]), mode="r")


def mode_of(R: np.ndarray, count: int) -> np.ndarray:
    return np.append(np.linalg.solve(R[:3, :3], R[:3, 3]), np.log(abs(R[3, 3]) / np.sqrt(count)))


def chain_run(path: Path | None, *, seed: int = 0, offset: float = 0.0, **settings: Any) -> Posterior:
    density = Linear(jnp.asarray(triangle_of(0)) + offset * jnp.eye(4), jnp.asarray(15.0))
    start = mode_of(triangle_of(0), 15)
    covariance = exact_posterior(triangle_of(0), 15).covariance
    return sample_posterior(density, start, covariance=covariance, seed=seed, chain=path, **settings)


def means_agree(posterior: Posterior, mean: np.ndarray, errors: float = 4) -> bool:
    """Within so many Monte Carlo standard errors, from the effective samples of the means themselves."""
    chains = posterior.chains.transpose(2, 0, 1)
    error = posterior.samples.std(axis=0) / np.sqrt(effective_samples(chains))
    return bool((np.abs(posterior.mean - mean) < errors * error).all())


def variances_agree(posterior: Posterior, covariance: np.ndarray, mean: np.ndarray, errors: float = 4) -> bool:
    """All elements of the covariance, each as the mean of a product."""
    away = posterior.chains - mean
    p = len(mean)
    products = np.stack([away[..., i] * away[..., j] for i in range(p) for j in range(i + 1)])
    expected = np.array([covariance[i, j] for i in range(p) for j in range(i + 1)])
    error = products.std(axis=(1, 2)) / np.sqrt(effective_samples(products))
    return bool((np.abs(products.mean(axis=(1, 2)) - expected) < errors * error).all())
