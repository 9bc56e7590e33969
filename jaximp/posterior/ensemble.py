"""Draws from one posterior, by emcee: an ensemble of walkers, from the mode on, until there are enough draws.

What a log density is says `jaximp.posterior`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Num

from jaximp.numerics.precision import require_float64
from jaximp.posterior.draws import ESS_LEAST, RHAT_MOST, Posterior, labels, make_posterior, numbers_apart
from jaximp.posterior.files import Chain, resume_chain, write_chain
from jaximp.types import AnyArray, Numbers, Progress

WALKERS = 32
"""There are at least so many walkers, and at least four for each parameter."""
INDEPENDENT = 0.5
"""Share of emcee's steps that propose from Student's t about the start; the others are differential evolution."""
TAIL_DOF = 5.0
"""Degrees of freedom of that t: its tails must not be lighter than the posterior's."""
TIMES = 50
"""Autocorrelation times that every walker must have gone, for these to be known (emcee's own advice)."""
BURN_IN = 5
"""How many autocorrelation times are dropped from the beginning, and at least a tenth of the chain."""
FIRST_CHECK, CHECK_GROWTH, BLOCK = 300, 1.3, 100
"""Steps before the first check, growth from check to check, and steps between two reports of progress."""
SAVE_EVERY = 30.0
"""Seconds after which the chain's file is written again, whatever the checks say."""
RUNAWAY = 1e6
"""Walkers spread wider than this many times the start's standard deviations find no end: sampling stops."""
FLAT = 1e-12
"""Share of the largest curvature, in units of each parameter's own, below which a direction is flat."""


def sample_posterior(
    log_density: Callable[..., Any],
    start: Num[AnyArray, " p"] | Num[AnyArray, "walkers p"] | None = None,
    *,
    covariance: Num[AnyArray, "p p"] | None = None,
    walkers: int | None = None,
    ess: float = 1000,
    max_steps: int = 20_000,
    seed: int = 0,
    chain: str | Path | None = None,
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> Posterior:
    """Draw from a posterior with emcee, from its mode and the covariance there, until there are enough draws.

    Half of the steps are differential evolution, which needs no tuning, half propose from Student's t about the start,
    which is as good as the Laplace approximation is. Sampling stops when every walker has gone 50 autocorrelation
    times, every parameter has `ess` effective samples (of the bulk and of the tails) and R-hat is small; five
    autocorrelation times, and a tenth of the chain at least, are dropped first. Of what is left every n-th step is
    kept, n a quarter of the shortest autocorrelation time.

    **Arguments:** `log_density` of parameters (p,), written in JAX; `start` its mode (p,), or where the walkers start,
    and without it `log_density.laplace()`; `covariance` there, without it from the second derivatives; `walkers` 32 or
    four for each parameter; `max_steps` after which sampling stops whatever it has, as the result's `ok` says; `seed`
    gives the same draws on the same machine; `chain` an HDF5 file (in emcee's layout) from which an interrupted run
    resumes, with the result of one that was not.

    **Raises:** ValueError for a start without density, too few walkers, a direction in which the density is flat, a log
    density that becomes NaN or infinite, or a file that holds another model's chain, which stays as it is.

    **Source:** Foreman-Mackey et al. 2013; ter Braak 2006; Goodman and Weare 2010 on when to stop.

    **Example:**

    ```pycon
    >>> log_density = lambda theta: -0.5 * ((theta - 2) ** 2).sum()
    >>> found = jaximp.sample_posterior(log_density, np.zeros(1), names=["stiffness"], units=["N m/rad"], ess=200)
    >>> print(found["stiffness"].mean().round(0))
    2.0

    ```
    """
    require_float64(*(() if start is None else (start,)))
    start, covariance = _given(log_density, start, covariance)
    names, units = labels(log_density, start.shape[-1], names, units)
    n = _number_of_walkers(start, walkers)
    evaluate = partial(_checked, _evaluator(log_density, n), names)
    centre, spread = _laplace(log_density, evaluate, start, covariance, names)
    places = start if start.ndim == 2 else _places(evaluate, centre, spread, n, seed)
    density = evaluate(places)
    if not np.isfinite(density).all():
        outside = int((~np.isfinite(density)).sum())
        raise ValueError(f"{outside} of {n} walkers start where the density is zero: move them inside its support")
    moves = f"differential evolution {1 - INDEPENDENT:g}, Student's t {INDEPENDENT:g}"
    random_state: Any = np.random.RandomState(seed).get_state()
    run = Chain(names, f"{n} walkers, seed {seed}, {moves}", centre, spread, places, density, random_state)
    path = None if chain is None else Path(chain)
    if path is not None:
        run = resume_chain(path, run, evaluate)
    return _until_enough(
        _Run(evaluate, run, path), max(ess, ESS_LEAST), max_steps, names, units, progress or (lambda share: None)
    )


def _given(log_density: Any, start: AnyArray | None, covariance: AnyArray | None) -> tuple[Numbers, Numbers | None]:
    """Start and covariance as arrays, from the log density's own approximation where there is no start."""
    if start is None:
        if not hasattr(log_density, "laplace"):
            raise ValueError("there is no start: pass one, such as the parameters of a least squares fit")
        start, own = log_density.laplace()
        covariance = own if covariance is None else covariance
    start = np.asarray(start, float)
    if start.ndim not in (1, 2):
        raise ValueError(f"the start has the shape {start.shape}: it is (parameters,), or (walkers, parameters)")
    if not np.isfinite(start).all():
        raise ValueError("the start is not finite: start at the mode, such as a least squares fit")
    return start, None if covariance is None else np.asarray(covariance, float)


def _number_of_walkers(start: Numbers, walkers: int | None) -> int:
    p = start.shape[-1]
    n = len(start) if start.ndim == 2 else walkers or max(WALKERS, 4 * p)
    if walkers is not None and n != walkers:
        raise ValueError(f"{n} walkers start, and walkers is {walkers}: leave it out, or make them equal")
    if n < max(4, 2 * p) or n % 2:
        raise ValueError(f"{n} walkers for {p} parameters: take an even number, at least {max(4, 2 * p)}")
    return n


def _laplace(
    log_density: Any,
    evaluate: Callable[[Numbers], Numbers],
    start: Numbers,
    covariance: Numbers | None,
    names: Sequence[str],
) -> tuple[Numbers, Numbers]:
    """Centre (p,) and covariance (p, p) of the independent proposals, and of the walkers' start."""
    if start.ndim == 2:
        _check_spread(start, names)
        spread = np.atleast_2d(np.cov(start, rowvar=False)) if covariance is None else covariance
        return start.mean(axis=0), _positive_definite(spread, names)
    value = float(evaluate(start[None])[0])
    if not np.isfinite(value):
        raise ValueError("the density at the start is zero: start inside its support, such as at the mode")
    if covariance is None:
        hessian = np.asarray(_hessian(*numbers_apart(log_density), jnp.asarray(start)))
        return start, _inverse_curvature(-hessian, names)
    return start, _positive_definite(covariance, names)


def _check_spread(places: Numbers, names: Sequence[str]) -> None:
    width = places.std(axis=0)
    if (width == 0).any():
        raise ValueError(
            f"all walkers start at one {names[int((width == 0).argmax())]}: spread them in every direction"
        )
    if len(places) > places.shape[1]:
        singular = np.linalg.svd((places - places.mean(axis=0)) / width, compute_uv=False)
        if singular[-1] < 1e-8 * singular[0]:
            raise ValueError("the walkers start on a plane that they cannot leave: spread them in every direction")


def _inverse_curvature(curvature: Numbers, names: Sequence[str]) -> Numbers:
    """Covariance of the Laplace approximation; flat directions are named."""
    if not np.isfinite(curvature).all():
        raise ValueError("second derivatives of the log density at the start are not finite: pass a covariance")
    diagonal = np.diag(curvature)
    if (diagonal == 0).any():
        raise ValueError(
            f"the log density is flat along {names[int((diagonal == 0).argmax())]}: fix it, or give a prior"
        )
    if (diagonal < 0).any():
        raise ValueError(
            f"the start is no mode, the log density curves upwards along {names[int(diagonal.argmin())]}: "
            "start at a maximum, or pass a covariance"
        )
    unit = 1 / np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(curvature * np.outer(unit, unit))
    if values[0] <= FLAT * values[-1]:
        raise ValueError(
            f"{_direction(vectors[:, 0], names)} cannot be told apart, the log density is flat in one direction: "
            "fix one of them, or give it a prior"
        )
    return (vectors / values) @ vectors.T * np.outer(unit, unit)


def _direction(vector: Numbers, names: Sequence[str]) -> str:
    """The parameters that make up most of a direction."""
    share = np.abs(vector) / np.abs(vector).max()
    return " and ".join(name for name, part in zip(names, share, strict=True) if part > 0.1)


def _positive_definite(covariance: Numbers, names: Sequence[str]) -> Numbers:
    p = len(names)
    if covariance.shape != (p, p):
        raise ValueError(f"the covariance has the shape {covariance.shape}: for {p} parameters it is ({p}, {p})")
    if not np.isfinite(covariance).all():
        bad = ~np.isfinite(np.diag(covariance))
        which = f" of {names[int(bad.argmax())]}" if bad.any() else ""
        raise ValueError(f"the covariance{which} is not finite: the data do not determine it; fix it, or give a prior")
    unit = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    if values[0] <= 0 or values[0] < FLAT * values[-1]:
        raise ValueError(
            f"the covariance is not positive definite along {_direction(vectors[:, 0], names)}: "
            "pass one of full rank, or leave it out"
        )
    return covariance


def _places(evaluate: Callable[[Numbers], Numbers], centre: Numbers, spread: Numbers, n: int, seed: int) -> Numbers:
    """(n, p) drawn from the Laplace approximation, each nearer to its centre until there is density."""
    away = np.random.default_rng(seed).standard_normal((n, len(centre))) @ np.linalg.cholesky(spread).T
    for _ in range(50):
        outside = ~np.isfinite(evaluate(centre + away))
        if not outside.any():
            return centre + away
        away[outside] /= 2
    raise ValueError("the density is zero all around the start: start at the mode, not at the edge of the support")


class _Run:
    """emcee, continued from a chain, and the chain's file."""

    def __init__(self, evaluate: Callable[[Numbers], Numbers], chain: Chain, path: Path | None) -> None:
        import emcee

        self.chain, self.path = chain, path
        self.saved, self.saved_at = len(chain), time.monotonic()
        n, p = chain.start.shape
        about = emcee.moves.MHMove(_about(chain.centre, chain.spread))
        moves = [(emcee.moves.DEMove(), 1 - INDEPENDENT), (about, INDEPENDENT)]
        self.sampler = emcee.EnsembleSampler(n, p, evaluate, vectorize=True, moves=moves)
        self.sampler.log_prob_fn = evaluate  # emcee's wrapper of it would print wherever a run is interrupted

    def block(self, steps: int) -> None:
        """Take so many more steps."""
        import emcee

        places, density = self.chain.last
        state = emcee.State(places, log_prob=density, random_state=self.chain.random_state)
        self.sampler.reset()
        state = self.sampler.run_mcmc(state, steps, skip_initial_state_check=True)
        accepted = self.sampler.backend.accepted
        self.chain.append(self.sampler.get_chain(), self.sampler.get_log_prob(), accepted, state.random_state)

    def to(self, steps: int, report: Progress) -> None:
        """Continue to so many steps; what is done when it breaks off is kept."""
        try:
            while len(self.chain) < steps:
                # Blocks end at the same steps wherever a run was interrupted.
                self.block(min(BLOCK - len(self.chain) % BLOCK, steps - len(self.chain)))
                report(float(len(self.chain)))
                if time.monotonic() - self.saved_at > SAVE_EVERY:
                    self.save()
        finally:
            self.save()

    def has_run_away(self) -> bool:
        width = self.chain.last[0].std(axis=0) / np.sqrt(np.diag(self.chain.spread))
        return bool(width.max() > RUNAWAY)

    def save(self) -> None:
        if self.path is not None and len(self.chain) > self.saved:
            write_chain(self.path, self.chain)
        self.saved, self.saved_at = len(self.chain), time.monotonic()


def _about(centre: Numbers, spread: Numbers) -> Callable[[Numbers, Any], tuple[Numbers, Numbers]]:
    """emcee's proposal that forgets where a walker is: Student's t about a centre."""
    factor = np.linalg.cholesky(spread)
    inverse, p = np.linalg.inv(factor), len(centre)

    def log_t(x: Numbers) -> Numbers:
        # Far from the centre squares overflow, and the proposal is as improbable as can be.
        with np.errstate(over="ignore"):
            return -(TAIL_DOF + p) / 2 * np.log1p((((x - centre) @ inverse.T) ** 2).sum(axis=1) / TAIL_DOF)

    def propose(places: Numbers, random: Any) -> tuple[Numbers, Numbers]:
        normal = random.standard_normal(places.shape)
        there = centre + normal / np.sqrt(random.chisquare(TAIL_DOF, (len(places), 1)) / TAIL_DOF) @ factor.T
        return there, log_t(places) - log_t(there)

    return propose


def _until_enough(
    run: _Run, ess: float, max_steps: int, names: tuple[str, ...], units: tuple[str, ...], progress: Progress
) -> Posterior:
    """Check at steps that do not depend on where a run was interrupted, and so neither does the result."""
    check, most = min(FIRST_CHECK, max_steps), 0.0

    def report(steps: float) -> None:
        nonlocal most
        most = max(most, steps / max_steps)
        progress(min(most, 0.99))

    while True:
        run.to(check, report)
        result, share = _judge(run.chain, check, ess, names, units)
        if share >= 1 or check >= max_steps or run.has_run_away():
            progress(1.0)
            return result
        most = max(most, share)
        check = min(int(CHECK_GROWTH * check), max_steps)


def _judge(
    chain: Chain, steps: int, ess: float, names: tuple[str, ...], units: tuple[str, ...]
) -> tuple[Posterior, float]:
    """The posterior by the first so many steps, and the share that it has of what it must have."""
    from emcee.autocorr import integrated_time

    places, density = chain.first(steps)
    begin = steps // 10
    with np.errstate(divide="ignore", invalid="ignore"):
        times = integrated_time(places[begin:], tol=0, quiet=True)
    times = np.where(np.isfinite(times), np.maximum(times, 1), steps)
    burn_in = min(max(begin, int(np.ceil(BURN_IN * times.max()))), steps // 2)
    every = min(max(1, int(times.min() / 4)), max(1, (steps - burn_in) // 4))
    kept = slice(burn_in + (steps - burn_in - 1) % every, None, every)
    posterior = make_posterior(
        places[kept].swapaxes(0, 1),
        names,
        units,
        log_density=density[kept].T,
        acceptance=chain.acceptance(steps),
        sampler=(
            f"emcee, {chain.settings}, {steps} steps, {burn_in} dropped, one in {every} kept, "
            f"autocorrelation times up to {times.max():.0f} steps"
        ),
    )
    effective = min(posterior.ess.min(), posterior.ess_tail.min())
    share = min(effective / ess, (steps - burn_in) / (TIMES * times.max()), 1.0)
    return posterior, float(share if posterior.rhat.max() < RHAT_MOST else min(share, 0.99))


@partial(jax.jit, static_argnums=1)
def _values(arrays: Any, rest: Any, places: Array) -> Array:
    return jax.vmap(eqx.combine(arrays, rest))(places)


@partial(jax.jit, static_argnums=1)
def _hessian(arrays: Any, rest: Any, place: Array) -> Array:
    return jax.hessian(eqx.combine(arrays, rest))(place)


def _evaluator(log_density: Any, rows: int) -> Callable[[Numbers], Numbers]:
    """The log density of any number of places, by one compiled program for `rows` of them at a time."""
    arrays, rest = numbers_apart(log_density)
    arrays = jax.tree.map(jnp.asarray, arrays)

    def evaluate(places: Numbers) -> Numbers:
        parts = []
        for k in range(0, len(places), rows):
            part = places[k : k + rows]
            full = part if len(part) == rows else np.resize(part, (rows, places.shape[1]))
            parts.append(np.asarray(_values(arrays, rest, full))[: len(part)])
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    return evaluate


def _checked(evaluate: Callable[[Numbers], Numbers], names: Sequence[str], places: Numbers) -> Numbers:
    """Refuse densities that are NaN or infinite."""
    values = evaluate(places)
    bad = np.isnan(values) | (values == np.inf)
    if bad.any():
        k = int(bad.argmax())
        where = ", ".join(f"{name}={x:.4g}" for name, x in zip(names, places[k], strict=True))
        raise ValueError(f"the log density is {values[k]} at {where}: return -inf where there is no density")
    return values
