"""What is known of parameters before the data: nothing, or a normal or log-normal distribution from anatomy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaximp.types import AnyArray, Numbers, nearest


@dataclass(frozen=True)
class Normal:
    """A parameter known as `mean` give or take the standard deviation `sd`, in its own unit."""

    mean: float
    """The most likely value, in the parameter's unit."""
    sd: float
    """The standard deviation, in the parameter's unit."""


@dataclass(frozen=True)
class LogNormal:
    """A positive parameter, with even odds above `median`, and with 68 % within a `factor` of it."""

    median: float
    """The value that the parameter exceeds with even odds, in its unit."""
    factor: float
    """The parameter lies between `median / factor` and `median * factor` with a probability of 68 %."""


@dataclass(frozen=True, eq=False)
class MultivariateNormal:
    """Parameters that were estimated before, such as a robot's from its own recording."""

    names: tuple[str, ...]
    mean: AnyArray
    """(k,)"""
    covariance: AnyArray
    """(k, k)"""


class Prior(eqx.Module):
    """Independent of the data: flat in every parameter that is not `proper`."""

    mean: Float[AnyArray, "*M p"]
    """The mean of the parameters, or of their logarithms."""
    root: Float[AnyArray, "*M p p"]
    """The precision is root' root; a parameter whose row is zero has a flat prior."""
    constant: Float[AnyArray, "*M"]
    """The constant that makes the proper part integrate to one."""
    names: tuple[str, ...] = eqx.field(static=True)
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    """Which parameters are log-normal, and therefore positive."""
    proper: tuple[bool, ...] = eqx.field(static=True)

    def log_density(self, x: Num[AnyArray, " p"]) -> Float[Array, ""]:
        """Log density of the parameters `x`; -inf where one of them is impossible."""
        logarithmic, x = np.array(self.logarithmic), jnp.asarray(x)
        possible = (~logarithmic | (x > 0)).all()
        logs = jnp.log(jnp.where(logarithmic & (x > 0), x, 1))
        distance = (self.root * (jnp.where(logarithmic, logs, x) - self.mean)).sum(axis=1)
        return jnp.where(possible, self.constant - (distance**2).sum() / 2 - logs.sum(), -jnp.inf)

    def information(self) -> Numbers:
        """(p, p) information that the prior adds to that of the data, at the median of parameters that are
        log-normal."""
        mean = np.asarray(self.mean)
        root = np.asarray(self.root) / np.where(self.logarithmic, np.exp(mean), 1)
        return np.asarray(root.T @ root)

    def draws(self, n: int, generator: np.random.Generator) -> Numbers:
        """(n, p) of the proper parameters; NaN of the flat ones."""
        proper = np.flatnonzero(self.proper)
        x = np.full((n, len(self.names)), np.nan)
        root = np.asarray(self.root)[np.ix_(proper, proper)]
        x[:, proper] = np.asarray(self.mean)[proper] + np.linalg.solve(root, generator.normal(size=(len(proper), n))).T
        return np.where(self.logarithmic, np.exp(np.where(self.logarithmic, x, 0)), x)


def make_prior(
    names: Sequence[str],
    given: Mapping[str, Normal | LogNormal] | None = None,
    blocks: Sequence[MultivariateNormal] = (),
) -> Prior:
    """A prior that is flat in all parameters but those that are given one.

    **Raises:** ValueError for a name that does not exist or comes twice, and for impossible distributions.
    """
    given = {} if given is None else given
    names, p = tuple(names), len(names)
    mean, root, constant = np.zeros(p), np.zeros((p, p)), 0.0
    logarithmic, proper = np.zeros(p, bool), np.zeros(p, bool)
    for name, one in given.items():
        k = _free(names, name, proper)
        mean[k], sd = _checked(name, one)
        root[k, k], proper[k], logarithmic[k] = 1 / sd, True, isinstance(one, LogNormal)
        constant -= np.log(sd) + np.log(2 * np.pi) / 2
    for block in blocks:
        index = []
        for name in block.names:
            index.append(_free(names, name, proper))
            proper[index[-1]] = True
        factor = _checked_block(block)
        mean[index], root[np.ix_(index, index)] = np.asarray(block.mean), np.linalg.inv(factor)
        constant -= np.log(np.diagonal(factor)).sum() + len(index) * np.log(2 * np.pi) / 2
    plain = tuple(logarithmic.tolist()), tuple(proper.tolist())
    return Prior(mean, root, np.asarray(constant), names, *plain)


def _free(names: tuple[str, ...], name: str, proper: np.ndarray) -> int:
    if name not in names:
        raise ValueError(f"the prior of '{name}' belongs to no parameter: {nearest(name, list(names))}")
    if proper[names.index(name)]:
        raise ValueError(f"'{name}' has two priors: give it one")
    return names.index(name)


def _checked(name: str, one: Normal | LogNormal) -> tuple[float, float]:
    """Mean and standard deviation, of the logarithm if it is log-normal."""
    if isinstance(one, LogNormal):
        if name.startswith("log_"):
            raise ValueError(f"'{name}' is a logarithm and may be negative: give it a normal prior")
        if not (0 < one.median < np.inf and 1 < one.factor < np.inf):
            raise ValueError(
                f"the log-normal prior of '{name}' has median {one.median:g} and factor {one.factor:g}: the median "
                "must be above zero and the factor above one"
            )
        return float(np.log(one.median)), float(np.log(one.factor))
    if not (np.isfinite(one.mean) and 0 < one.sd < np.inf):
        raise ValueError(f"the normal prior of '{name}' has mean {one.mean:g} and sd {one.sd:g}: sd must be above zero")
    return float(one.mean), float(one.sd)


def _checked_block(block: MultivariateNormal) -> Numbers:
    """Lower Cholesky factor of its covariance."""
    mean, covariance, k = np.asarray(block.mean, float), np.asarray(block.covariance, float), len(block.names)
    these = ", ".join(block.names)
    if mean.shape != (k,) or covariance.shape != (k, k):
        raise ValueError(f"the prior of {these} needs a mean of shape ({k},) and a covariance of ({k}, {k})")
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        raise ValueError(f"the prior of {these} is not finite: was there an estimate?")
    size = np.sqrt(np.abs(np.diagonal(covariance)))  # numpy takes it for singular if units differ much
    size = np.where(size > 0, size, 1)
    try:
        factor = np.linalg.cholesky(covariance / np.outer(size, size))
    except np.linalg.LinAlgError:
        factor = None
    if factor is None or not np.allclose(covariance, covariance.T, rtol=1e-6, atol=0):
        raise ValueError(f"the covariance in the prior of {these} must be symmetric and positive definite")
    return np.asarray(size[:, None] * factor)
