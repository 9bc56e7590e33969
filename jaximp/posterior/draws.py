"""Posteriors: their samples, whether these can be trusted, and what can be said with them.

A log density is any callable of parameters (p,), written in JAX, whose value is the logarithm of the posterior density
up to a constant, -inf outside its support. It may know its `names` and `units`, and with `laplace()` where its mode is
and the covariance there. `ensemble` and `hamiltonian` draw from it. Where the model is linear and the noise Gaussian
no sampler is needed: `exact_posterior`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from numpy.typing import NDArray

from jaximp.numerics.precision import require_float64
from jaximp.types import AnyArray, Numbers, nearest

RHAT_MOST = 1.05
"""Largest R-hat of chains that have converged. Vehtari et al. ask for 1.01 from a few long chains; an ensemble whose
walkers are fifty autocorrelation times long has 1.02 for its length alone."""
ESS_LEAST = 400
"""With fewer effective samples, of the bulk or of the tails, neither an interval nor R-hat means much (Vehtari)."""
ACCEPTANCE_LEAST = 0.05
"""Smallest share of accepted proposals; below it the proposals do not fit the posterior."""
CORRELATED = 0.99
"""Where sampling failed, pairs of parameters with a larger correlation are named as a likely reason."""
QUANTILES = (0.025, 0.25, 0.5, 0.75, 0.975)
CHUNK = 2_000_000
"""How many numbers are diagnosed at a time, so that diagnosing needs little memory."""


class Posterior(eqx.Module):
    """Draws from a posterior by C chains (or walkers) of N draws each, with what says whether they can be trusted.

    **Example:**

    ```pycon
    >>> log_density = lambda theta: -0.5 * ((theta - 2) ** 2).sum()
    >>> found = jaximp.sample_posterior(log_density, np.zeros(1), names=["stiffness"], units=["N m/rad"], ess=200)
    >>> print(found.names, found.chains.shape[2])
    ('stiffness',) 1

    ```
    """

    chains: Float[AnyArray, "C N p"]
    """Draws of the parameters, in `units`."""
    log_density: Float[AnyArray, "C N"]
    """Log density of every draw, up to a constant."""
    acceptance: Float[AnyArray, " C"]
    """Accepted share of each chain's proposals."""
    ess: Float[AnyArray, " p"]
    """Effective samples of the bulk, as ArviZ computes them."""
    ess_tail: Float[AnyArray, " p"]
    """Effective samples of the 5 % and 95 % quantiles: the smaller of the two numbers."""
    rhat: Float[AnyArray, " p"]
    """Rank-normalised split R-hat: it is near one where all halves of all chains agree."""
    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    sampler: str = eqx.field(static=True, default="")
    """Which sampler made the draws, and how, in words."""

    @property
    def samples(self) -> Float[AnyArray, "draws p"]:
        """All draws, chain after chain."""
        return np.asarray(self.chains).reshape(-1, len(self.names))

    @property
    def mean(self) -> Numbers:
        return self.samples.mean(axis=0)

    @property
    def covariance(self) -> Numbers:
        return np.atleast_2d(np.cov(self.samples, rowvar=False))

    @property
    def ok(self) -> bool:
        """Whether the diagnostics pass: else intervals from these draws mean nothing yet."""
        return not self.why

    @property
    def why(self) -> str:
        """Why the draws cannot be trusted, and what to do, in one line; empty where they can."""
        return _why(self)

    def __getitem__(self, name: str) -> Numbers:
        """(C, N) the draws of one parameter."""
        return np.asarray(self.chains)[..., index_of(self.names, name)]


def credible_interval(samples: Float[AnyArray, "draws p"], level: float = 0.95) -> tuple[Numbers, Numbers]:
    """(p,) lower and upper ends of the intervals that hold `level` of the draws, with as many on either side.

    **Raises:** `ValueError` for a level that does not lie between 0 and 1.
    """
    if not 0 < level < 1:
        raise ValueError(f"level is {level}: it must lie between 0 and 1")
    low, high = np.quantile(samples, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return low, high


class PosteriorMany(eqx.Module):
    """The posteriors of M windows, one for each; `posteriors[k]` is that of window k. A window that failed is NaN."""

    chains: Float[AnyArray, "M C N p"]
    log_density: Float[AnyArray, "M C N"]
    acceptance: Float[AnyArray, "M C"]
    ess: Float[AnyArray, "M p"]
    ess_tail: Float[AnyArray, "M p"]
    rhat: Float[AnyArray, "M p"]
    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    sampler: str = eqx.field(static=True, default="")

    @property
    def samples(self) -> Float[AnyArray, "M draws p"]:
        chains = np.asarray(self.chains)
        return chains.reshape(len(chains), -1, chains.shape[-1])

    @property
    def ok(self) -> Bool[AnyArray, " M"]:
        return np.array([not line for line in self.why], bool)

    @property
    def why(self) -> list[str]:
        """For each window, why its draws cannot be trusted, as in `Posterior.why`."""
        return [one.why for one in self]

    def __len__(self) -> int:
        return len(self.chains)

    def __getitem__(self, k: int) -> Posterior:
        fields = {name: getattr(self, name)[k] for name in Posterior.__dataclass_fields__ if name not in SHARED}
        return Posterior(**fields, **{name: getattr(self, name) for name in SHARED})

    def __iter__(self) -> Iterator[Posterior]:
        return (self[k] for k in range(len(self)))


SHARED = ("names", "units", "sampler")


def make_posterior(
    chains: Float[AnyArray, "C N p"],
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
    *,
    log_density: Float[AnyArray, "C N"] | None = None,
    acceptance: Float[AnyArray, " C"] | None = None,
    sampler: str = "",
) -> Posterior:
    """Make a `Posterior` from chains of any sampler, and compute its diagnostics."""
    chains = np.asarray(chains)
    names, units = labels(None, chains.shape[-1], names, units)
    ess, ess_tail, rhat = diagnose(chains)
    unknown = np.full(chains.shape[:2], np.nan)
    return Posterior(
        chains=chains,
        log_density=unknown if log_density is None else np.asarray(log_density),
        acceptance=unknown[:, 0] if acceptance is None else np.asarray(acceptance),
        ess=ess,
        ess_tail=ess_tail,
        rhat=rhat,
        names=names,
        units=units,
        sampler=sampler,
    )


def stacked(posteriors: Sequence[Posterior]) -> PosteriorMany:
    """Stack posteriors of the same parameters, with equally many draws each, into one `PosteriorMany`."""
    first = posteriors[0]
    fields = [name for name in Posterior.__dataclass_fields__ if name not in SHARED]
    arrays = {name: np.stack([np.asarray(getattr(one, name)) for one in posteriors]) for name in fields}
    return PosteriorMany(**arrays, names=first.names, units=first.units, sampler=first.sampler)


def derive(
    posterior: Posterior | PosteriorMany,
    function: Callable[[Float[Array, " p"]], Float[Array, " k"]],
    names: Sequence[str],
    units: Sequence[str] | None = None,
) -> Any:
    """The posterior of what `function` makes of the parameters, such as the elements of K = L L'; of each if many.

    Its density is not known, and `log_density` stays that of the parameters.
    """
    if isinstance(posterior, PosteriorMany):
        function = jax.jit(function)
        return stacked([derive(one, function, names, units) for one in posterior])
    chains = np.asarray(jax.jit(jax.vmap(jax.vmap(function)))(jnp.asarray(posterior.chains)))
    log_density, acceptance = posterior.log_density, posterior.acceptance
    settings: dict[str, Any] = {"log_density": log_density, "acceptance": acceptance, "sampler": posterior.sampler}
    return make_posterior(chains, names, units, **settings)


def labels(
    log_density: Any, p: int, names: Sequence[str] | None, units: Sequence[str] | None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units as given, else as the log density has them, else numbers.

    **Raises:** ValueError where there are not p of them, or two names are the same.
    """
    own_names, own_units = getattr(log_density, "names", None), getattr(log_density, "units", None)
    names = tuple(names or own_names or (f"theta{k + 1}" for k in range(p)))
    units = tuple(units or own_units or ("1",) * p)
    for what, given in (("names", names), ("units", units)):
        if len(given) != p:
            raise ValueError(f"{len(given)} {what} for {p} parameters: give one for each")
    if len(set(names)) < p:
        raise ValueError(f"parameters share a name: {', '.join(names)}; give each its own")
    return names, units


def numbers_apart(log_density: Any) -> tuple[Any, Any]:
    """Its arrays, and all else: log densities that differ in their numbers only share compiled code."""
    return eqx.partition(log_density, lambda leaf: isinstance(leaf, jax.Array | np.ndarray))


def index_of(names: Sequence[str], name: str) -> int:
    if name not in names:
        raise ValueError(f"no parameter is called '{name}': {nearest(name, list(names))}")
    return list(names).index(name)


# Diagnostics


def diagnose(chains: Float[AnyArray, "C N *p"]) -> tuple[Numbers, Numbers, Numbers]:
    """Effective samples of the bulk and of the tails, and R-hat, of every parameter.

    The numbers of ArviZ, computed for thousands of parameters at a time. A chain that never moves, or is not finite,
    has no effective samples and an R-hat of infinity.

    **Raises:** ValueError for fewer than four draws.

    **Source:** Vehtari, Gelman, Simpson, Carpenter, Bürkner 2021, with Geyer's initial monotone sequence.
    """
    chains = np.asarray(chains, float)
    C, N = chains.shape[:2]
    if N < 4:
        raise ValueError(f"{N} draws of each chain cannot be judged: draw four at least")
    columns = chains.reshape(C, N, -1).transpose(2, 0, 1)  # (parameters, chains, draws)
    size = max(1, CHUNK // (C * N))
    parts = [_diagnose_some(np.ascontiguousarray(columns[k : k + size])) for k in range(0, len(columns), size)]
    return tuple(np.concatenate(x).reshape(chains.shape[2:]) for x in zip(*parts, strict=True))  # type: ignore[return-value]


def effective_samples(chains: Float[AnyArray, "K C N"]) -> Numbers:
    """(K,) effective samples of the means of K quantities, each drawn by C chains, none of them split."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return _effective(np.asarray(chains, float))


def _diagnose_some(x: Numbers) -> tuple[Numbers, Numbers, Numbers]:
    """Of (K, C, N)."""
    usable = np.atleast_1d(np.isfinite(x).all(axis=(1, 2)))
    x = np.where(usable[:, None, None], x, 0)
    usable &= x.max(axis=(1, 2)) > x.min(axis=(1, 2))
    halves = _halves(x)
    normal = _normal_scores(halves)
    folded = _normal_scores(np.abs(halves - np.median(halves, axis=(1, 2), keepdims=True)))
    low, high = np.quantile(x, [0.05, 0.95], axis=(1, 2))[..., None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        bulk = _effective(normal)
        tail = np.fmin(_effective(_halves(x <= low)), _effective(_halves(x <= high)))
        rhat = np.maximum(_rhat(normal), _rhat(folded))
    return np.where(usable, bulk, 0), np.where(usable, tail, 0), np.where(usable, rhat, np.inf)


def _halves(x: NDArray[Any]) -> Numbers:
    half = x.shape[-1] // 2
    return np.concatenate([x[..., :half], x[..., -half:]], axis=1).astype(float)


def _normal_scores(x: Numbers) -> Numbers:
    """Ranks among all chains, as quantiles of the normal distribution (Blom 1958)."""
    from scipy.special import ndtri
    from scipy.stats import rankdata

    flat = x.reshape(len(x), -1)
    scores = ndtri((np.arange(2, 2 * flat.shape[1] + 1) / 2 - 3 / 8) / (flat.shape[1] + 1 / 4))
    return scores[(2 * rankdata(flat, axis=1)).astype(int) - 2].reshape(x.shape)


def _rhat(x: Numbers) -> Numbers:
    n = x.shape[-1]
    between, within = n * x.mean(axis=-1).var(axis=-1, ddof=1), x.var(axis=-1, ddof=1).mean(axis=-1)
    return np.sqrt((between / within + n - 1) / n)


def _effective(x: Numbers) -> Numbers:
    """Effective samples of the mean of (K, C, N), from the autocorrelation over all chains."""
    from scipy.fft import irfft, next_fast_len, rfft

    C, N = x.shape[1:]
    spectrum = rfft(x - x.mean(axis=-1, keepdims=True), n=next_fast_len(2 * N, real=True), axis=-1)
    power = (spectrum.real**2 + spectrum.imag**2).mean(axis=1)
    covariance = irfft(power, n=next_fast_len(2 * N, real=True), axis=-1)[:, :N] / N
    within = covariance[:, :1] * N / (N - 1)
    total = covariance[:, :1] + (x.mean(axis=-1).var(axis=-1, ddof=1)[:, None] if C > 1 else 0)
    rho = 1 - (within - covariance) / total
    rho[:, 0] = 1
    # Geyer: sums of neighbours are positive and fall; what comes after the first that is not positive is noise.
    most = max(0, (N - 3) // 2)
    even, pairs = rho[:, : 2 * most + 1 : 2], rho[:, : 2 * most + 1 : 2] + rho[:, 1 : 2 * most + 2 : 2]
    positive = pairs > 0
    last = np.where(positive.all(axis=1), most, positive.argmin(axis=1))
    falling = np.where(np.arange(most + 1) < last[:, None], np.minimum.accumulate(pairs, axis=1), 0).sum(axis=1)
    end = np.take_along_axis(even, last[:, None], axis=1)[:, 0]
    end = np.where((end > 0) | (np.take_along_axis(pairs, last[:, None], axis=1)[:, 0] >= 0), end, 0)
    time = np.maximum(-1 + 2 * falling + end, 1 / np.log10(C * N))
    return np.where(np.isfinite(time), C * N / time, 0)


def _why(posterior: Posterior) -> str:
    names, chains = posterior.names, np.asarray(posterior.chains)
    if not np.isfinite(chains).all():
        return "there is no posterior: the start has no density, or its covariance is not positive definite"
    stuck = int((chains == chains[:, :1]).all(axis=(1, 2)).sum())
    if stuck:
        return f"{stuck} of {len(chains)} chains never moved: start nearer to the mode, or with a smaller covariance"
    acceptance = float(np.mean(posterior.acceptance))
    if acceptance < ACCEPTANCE_LEAST:
        return f"{acceptance:.0%} of the proposals were accepted: reparametrise, or start from a better covariance"
    rhat, ess = np.asarray(posterior.rhat), np.minimum(posterior.ess, posterior.ess_tail)
    if rhat.max() > RHAT_MOST:
        trouble = f"R-hat of {names[int(rhat.argmax())]} is {rhat.max():.2f}, more than {RHAT_MOST}"
    elif ess.min() < ESS_LEAST:
        trouble = f"{names[int(ess.argmin())]} has {ess.min():.0f} effective samples, fewer than {ESS_LEAST}"
    else:
        return ""
    return f"{trouble}: {_remedy(names, posterior.samples)}"


def _remedy(names: Sequence[str], samples: Numbers) -> str:
    if len(names) > 1:
        with np.errstate(divide="ignore", invalid="ignore"):
            correlation = np.nan_to_num(np.triu(np.corrcoef(samples, rowvar=False), 1))
        i, j = (int(k) for k in np.unravel_index(np.abs(correlation).argmax(), correlation.shape))
        if abs(correlation[i, j]) > CORRELATED:
            return f"{names[i]} and {names[j]} cannot be told apart; fix one, or give it a prior"
    return "more steps; if they do not help, reparametrise, or give a prior where the data leave a direction flat"


# Exact


class ExactPosterior(eqx.Module):
    """Student's t of parameters with `dof` degrees of freedom, and the logarithm of the noise last.

    `(theta - location)' R' R (theta - location) / (p scale^2)` is F-distributed, and `dof scale^2 / s^2` chi-squared.
    """

    R: Float[AnyArray, "k k"]
    """Upper triangle of the QR decomposition, for the columns of the k = p - 1 parameters."""
    location: Float[AnyArray, " k"]
    scale: Float[AnyArray, ""]
    """The square root of the residual sum of squares over `dof` [N m]."""
    dof: Float[AnyArray, ""]
    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)

    @property
    def mean(self) -> Numbers:
        """(p,) also where too few degrees of freedom leave the parameters none: then it is their mode."""
        from scipy.special import digamma

        half = float(self.dof) / 2
        log_noise = np.log(float(self.scale)) + (np.log(half) - digamma(half)) / 2
        return np.append(np.asarray(self.location), log_noise)

    @property
    def covariance(self) -> Numbers:
        """(p, p), infinite with two degrees of freedom or fewer."""
        from scipy.special import polygamma

        k, dof = len(self.location), float(self.dof)
        inverse = np.linalg.inv(np.asarray(self.R))
        result = np.zeros((k + 1, k + 1))
        spread = float(self.scale) ** 2 * dof / (dof - 2) if dof > 2 else np.inf
        result[:k, :k] = inverse @ inverse.T * spread
        result[k, k] = polygamma(1, dof / 2) / 4
        return result

    def interval(self, level: float = 0.95) -> tuple[Numbers, Numbers]:
        """Lower and upper ends (p,) that hold each parameter with probability `level`, as much on either side."""
        from scipy.stats import chi2, t

        dof = float(self.dof)
        stderr = float(self.scale) * np.linalg.norm(np.linalg.inv(np.asarray(self.R)), axis=1)
        half = t.ppf(0.5 + level / 2, dof) * stderr
        ends = np.log(float(self.scale)) + 0.5 * np.log(dof / chi2.ppf([0.5 + level / 2, 0.5 - level / 2], dof))
        middle = np.asarray(self.location)
        return np.append(middle - half, ends[0]), np.append(middle + half, ends[1])

    def samples(self, key: PRNGKeyArray, n: int) -> Float[Array, "n p"]:
        """Draw independent samples."""
        return _draw_exact(self, key, n)

    def posterior(self, key: PRNGKeyArray, n: int = 4000) -> Posterior:
        """As `Posterior`, of four chains of n/4 independent draws each."""
        draws = np.asarray(self.samples(key, 4 * max(4, n // 4)))
        middle, R = np.asarray(self.location), np.asarray(self.R)
        across = ((draws[:, :-1] - middle) @ R.T) ** 2
        squares = across.sum(axis=1) + float(self.dof * self.scale**2)
        count = float(self.dof) + len(middle)
        density = -count * draws[:, -1] - squares / 2 * np.exp(-2 * draws[:, -1])
        chains = draws.reshape(4, -1, draws.shape[1])
        settings: dict[str, Any] = {"log_density": density.reshape(4, -1), "acceptance": np.ones(4)}
        return make_posterior(chains, self.names, self.units, **settings, sampler="exact, independent draws")


def exact_posterior(
    triangle: Float[AnyArray, "q q"],
    count: float,
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
) -> ExactPosterior:
    """Posterior of a linear model with Gaussian noise of unknown size, flat in the parameters and in log(noise).

    **Arguments:** `triangle` upper triangle of a QR decomposition of `[W, y]`, whose rows have white noise; `count` how
    many independent rows it stands for; `names` and `units` of the columns of W. The last parameter of the result is
    `log_noise`, the logarithm of the noise's standard deviation [N m].

    **Raises:** ValueError where rows are too few, numbers not finite, or columns of W dependent on others.

    **Source:** Gelman et al., Bayesian Data Analysis, 3rd ed., section 14.2, in log(s) rather than s^2.
    """
    require_float64(triangle)
    R = np.asarray(triangle)
    k = len(R) - 1
    names, units = labels(None, k, names, units)
    if not np.isfinite(R).all():
        raise ValueError("the triangle is not finite: leave out the rows that are not")
    if count <= k:
        raise ValueError(f"{count:g} independent rows do not determine {k} parameters and the noise: use more samples")
    columns = np.linalg.norm(R[:k, :k], axis=0)
    loose = np.abs(np.diag(R)[:k]) <= max(count, k) * np.finfo(float).eps * columns
    if loose.any():
        raise ValueError(
            f"{names[int(loose.argmax())]} cannot be told from the parameters before it: fix it, or give it a prior"
        )
    dof = count - k
    location = np.linalg.solve(R[:k, :k], R[:k, k])
    scale = np.abs(R[k, k]) / np.sqrt(dof)
    if scale == 0:
        raise ValueError("the model fits without any residual: the noise has no posterior")
    return ExactPosterior(
        R=R[:k, :k],
        location=location,
        scale=np.float64(scale),
        dof=np.float64(dof),
        names=(*names, "log_noise"),
        units=(*units, "1"),
    )


@eqx.filter_jit
def _draw_exact(posterior: ExactPosterior, key: PRNGKeyArray, n: int) -> Array:
    from jaximp.numerics.linear_algebra import back_substitute

    normal_key, chi_key = jax.random.split(key)
    dof, scale = jnp.asarray(posterior.dof), jnp.asarray(posterior.scale)
    chi_squared = 2 * jax.random.gamma(chi_key, dof / 2, (n,), dtype=dof.dtype)
    noise = scale * jnp.sqrt(dof / chi_squared)
    normal = jax.random.normal(normal_key, (n, len(posterior.location)), dtype=dof.dtype)
    R = jnp.asarray(posterior.R)
    away = jax.vmap(lambda z: back_substitute(R, z))(normal)
    theta = jnp.asarray(posterior.location) + noise[:, None] * away
    return jnp.concatenate([theta, jnp.log(noise)[:, None]], axis=1)


# What posteriors say


def summarise(posterior: Posterior) -> list[dict[str, Any]]:
    """One row for each parameter: name, unit, mean, its Monte Carlo standard error, sd, quantiles and diagnostics."""
    samples = posterior.samples
    quantiles = np.quantile(samples, QUANTILES, axis=0)
    sd = samples.std(axis=0, ddof=1)
    return [
        {"name": name, "unit": posterior.units[k], "mean": float(samples[:, k].mean()), "sd": float(sd[k])}
        | {f"{100 * level:g}%": float(quantiles[i, k]) for i, level in enumerate(QUANTILES)}
        | {"mean_error": float(sd[k] / np.sqrt(max(posterior.ess[k], 1)))}
        | {"ess": float(posterior.ess[k]), "ess_tail": float(posterior.ess_tail[k]), "rhat": float(posterior.rhat[k])}
        for k, name in enumerate(posterior.names)
    ]


def probability_greater(
    a: Posterior,
    b: Posterior,
    name: str,
    *,
    spans: tuple[tuple[float, float], tuple[float, float]] | None = None,
) -> tuple[float, float]:
    """Probability that a parameter is greater in one window than in another, and its Monte Carlo standard error.

    The windows must not share samples: posteriors of windows that overlap, or that saw one noise, are not independent,
    and the probability would claim too little or too much. Every draw of one is held against every draw of the other.
    Where none crosses, the error is that of one effective draw that does.

    **Arguments:** `spans` when each window begins and ends [s].

    **Raises:** ValueError where the spans overlap, no parameter is called so, or draws cannot be trusted.
    """
    if spans is not None and max(spans[0][0], spans[1][0]) < min(spans[0][1], spans[1][1]):
        raise ValueError(
            f"windows {spans[0][0]:g} to {spans[0][1]:g} s and {spans[1][0]:g} to {spans[1][1]:g} s share samples: "
            "compare windows that do not overlap"
        )
    for one in (a, b):
        if not one.ok:
            raise ValueError(f"a posterior cannot be trusted: {one.why}")
    x, y = a[name], b[name]
    below, above = _share_below(y, x), 1 - _share_below(x, y)
    probability = float(below.mean())
    variance = 0.0
    for part in (below, above):
        draws = float(np.clip(effective_samples(part[None])[0], 1, part.size)) if np.ptp(part) > 0 else part.size
        variance += float(part.var()) / draws
    smallest = 1 / float(min(a.ess.min(), b.ess.min()))
    return probability, max(float(np.sqrt(variance)), smallest)


def _share_below(of: Numbers, than: Numbers) -> Numbers:
    """For each number of `than`: the share of `of` that is smaller, where equal numbers count half."""
    ordered = np.sort(of, axis=None)
    counts = np.searchsorted(ordered, than, "left") + np.searchsorted(ordered, than, "right")
    return counts / (2 * ordered.size)
