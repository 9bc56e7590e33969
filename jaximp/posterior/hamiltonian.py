"""Draws from the posteriors of many windows together, by Hamiltonian Monte Carlo.

What a log density is says `jaximp.posterior`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Num, PRNGKeyArray
from numpy.typing import NDArray

from jaximp.numerics.precision import require_float64
from jaximp.posterior.draws import ESS_LEAST, RHAT_MOST, PosteriorMany, diagnose, labels, numbers_apart
from jaximp.types import AnyArray, Numbers, Progress

CHAINS = 4
"""Chains of every window; each adapts a step size of its own."""
LANES = 128
"""How many windows are sampled together: few enough for their numbers to stay in the cache."""
WARM_UP, ACCEPT = 150, 0.95
"""Steps that adapt the step size, and the acceptance that it aims at; larger steps do not enter curved tails."""
LEAPS, LONGEST_STEP, JITTER = 4, 0.45, (0.3, 1.2)
"""Steps of a trajectory, the longest of them in standard deviations, and what they are multiplied by at random. About a
quarter of a normal distribution's period: longer ones come back, and none meets a period or sticks in a tail."""
SHARE = 0.6
"""Draws of each of the four chains, for every effective sample that is asked for: 2.4 draws for each."""
ROUNDS, THIN, LONGER = 4, 4, 2
"""A window that lacks effective samples is drawn again, three times at most, with so many times the trajectories for
each draw that is kept, each of so many times the steps."""


def sample_many(
    log_densities: Callable[..., Any],
    starts: Num[AnyArray, "M p"],
    covariances: Num[AnyArray, "M p p"],
    key: PRNGKeyArray,
    *,
    ess: float = 1000,
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> PosteriorMany:
    """Draw from the posteriors of M windows, each of its own, by Hamiltonian Monte Carlo (blackjax).

    Four chains for each window, in units of the covariance given, so that no matrix is factorised within compiled code;
    each chain adapts its own step size. Windows that lack effective samples are drawn again in units of the covariance
    of their own draws, with four trajectories twice as long for each draw that is kept; and so on, three times at most.

    **Arguments:** `log_densities` one log density whose arrays have a leading axis of windows; `starts` inside the
    support, such as the modes; `covariances` there; `ess` the effective samples that every parameter should have, of
    the bulk and of the tails.

    **Returns:** a `PosteriorMany`, in which a window whose start has no density, or whose covariance is not positive
    definite, is NaN and says so in `why`. Where the log density is NaN, proposals are rejected.

    **Raises:** ValueError for shapes that do not fit, or without blackjax.

    **Source:** Neal 2011; Hoffman and Gelman 2014 for the step size.
    """
    require_float64(starts, covariances)
    if find_spec("blackjax") is None:
        raise ValueError("posteriors of many windows need blackjax: pip install 'jaximp[windows]'")
    starts, covariances = np.asarray(starts, float), np.asarray(covariances, float)
    M, p = starts.shape
    if covariances.shape != (M, p, p):
        raise ValueError(f"covariances have the shape {covariances.shape}: for these starts it is ({M}, {p}, {p})")
    names, units = labels(log_densities, p, names, units)
    windows = _Windows(log_densities, min(LANES, 1 << max(M - 1, 0).bit_length()), -(-int(SHARE * ess) // 10) * 10)
    factors = np.stack([_factor(one) for one in covariances])
    report, drawn, todo = progress or (lambda share: None), _empty(M, windows.draws, p), np.arange(M)
    todo = todo[np.isfinite(factors).all(axis=(1, 2)) & np.isfinite(starts).all(axis=1)]
    todo = todo[windows.have_density(todo, starts)]
    for attempt in range(ROUNDS):
        if not len(todo):
            break
        share = partial(_shared, report, attempt)
        found = windows.draw(
            todo, starts, factors, jax.random.fold_in(key, attempt), (LEAPS * LONGER**attempt, THIN**attempt), share
        )
        for name, values in found.items():
            drawn[name][todo] = values
        lacking = np.minimum(drawn["ess"], drawn["ess_tail"])[todo].min(axis=1) < max(ess, ESS_LEAST)
        todo = todo[lacking | (drawn["rhat"][todo].max(axis=1) > RHAT_MOST)]
        factors = _renewed(drawn["chains"], factors, todo)
    report(1.0)
    about = f"Hamiltonian Monte Carlo, {CHAINS} chains of {windows.draws} draws, blackjax"
    return PosteriorMany(**drawn, names=names, units=units, sampler=about)


def _shared(report: Progress, attempt: int, share: float) -> None:
    """Progress of one attempt, half of what is left."""
    report(1 - 0.5**attempt * (1 - share / 2))


def _empty(M: int, draws: int, p: int) -> dict[str, Numbers]:
    shapes = {"chains": (M, CHAINS, draws, p), "log_density": (M, CHAINS, draws), "acceptance": (M, CHAINS)}
    nothing = {name: np.full(shape, np.nan) for name, shape in shapes.items()}
    return nothing | {"ess": np.zeros((M, p)), "ess_tail": np.zeros((M, p)), "rhat": np.full((M, p), np.inf)}


def _factor(covariance: Numbers) -> NDArray[Any]:
    """Lower triangular factor, by LAPACK on the host; NaN where there is none."""
    try:
        return np.linalg.cholesky(covariance) if np.isfinite(covariance).all() else np.full_like(covariance, np.nan)
    except np.linalg.LinAlgError:
        return np.full_like(covariance, np.nan)


def _renewed(chains: Numbers, factors: Numbers, windows: NDArray[np.int64]) -> Numbers:
    """Factors by the draws of windows that need more of them, where these make a covariance."""
    factors = factors.copy()
    for k in windows:
        draws = chains[k].reshape(-1, chains.shape[-1])
        factor = _factor(np.asarray(np.cov(draws, rowvar=False), float).reshape(factors.shape[1:]))
        if np.isfinite(factor).all():
            factors[k] = factor
    return factors


class _Windows:
    """Draws from windows, `lanes` of them at a time, so that one compiled program serves all."""

    def __init__(self, log_densities: Any, lanes: int, draws: int) -> None:
        self.arrays, self.rest = numbers_apart(log_densities)
        self.lanes, self.draws = lanes, draws

    def batches(self, windows: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Windows in groups of `lanes`, the last filled up with the first ones."""
        whole = -(-len(windows) // self.lanes) * self.lanes
        return list(np.resize(windows, whole).reshape(-1, self.lanes)) if whole else []

    def of(self, batch: NDArray[np.int64]) -> Any:
        return jax.tree.map(lambda array: np.asarray(array)[batch], self.arrays)

    def have_density(self, windows: NDArray[np.int64], starts: Numbers) -> Bool[AnyArray, " M"]:
        values = [_own_values(self.of(batch), self.rest, starts[batch]) for batch in self.batches(windows)]
        return np.isfinite(np.concatenate([np.zeros(0), *values])[: len(windows)])

    def draw(
        self,
        windows: NDArray[np.int64],
        starts: Numbers,
        factors: Numbers,
        key: PRNGKeyArray,
        effort: tuple[int, int],
        report: Progress,
    ) -> dict[str, Numbers]:
        """Draws of these windows with their diagnostics; a window's random numbers do not depend on the others."""
        parts, batches = [], self.batches(windows)
        for k, batch in enumerate(batches):
            keys = jax.vmap(partial(jax.random.fold_in, key))(jnp.asarray(batch))
            found = _hamiltonian(self.of(batch), starts[batch], factors[batch], keys, *effort, self.rest, self.draws)
            parts.append([np.asarray(x) for x in found])
            report((k + 1) / len(batches))
        chains, density, acceptance = (np.concatenate(x)[: len(windows)] for x in zip(*parts, strict=True))
        judged = diagnose(chains.transpose(1, 2, 0, 3))
        return dict(
            zip(
                ("chains", "log_density", "acceptance", "ess", "ess_tail", "rhat"),
                (chains, density, acceptance, *judged),
                strict=True,
            )
        )


@partial(jax.jit, static_argnums=1)
def _own_values(arrays: Any, rest: Any, places: Array) -> Array:
    return jax.vmap(lambda one, place: eqx.combine(one, rest)(place))(arrays, places)


@partial(jax.jit, static_argnums=(6, 7))
def _hamiltonian(
    arrays: Any, centres: Array, factors: Array, keys: Array, leaps: Array, thin: Array, rest: Any, draws: int
) -> tuple[Array, Array, Array]:
    """(B, C, N, p) draws, (B, C, N) their log densities, and (B, C) acceptance."""

    def one_window(arrays: Any, centre: Array, factor: Array, key: Array) -> tuple[Array, Array, Array]:
        density = eqx.combine(arrays, rest)

        def place(z: Array) -> Array:
            return centre + (factor * z).sum(axis=1)

        def log_density(z: Array) -> Array:
            value = density(place(z))
            return jnp.where(jnp.isnan(value), -jnp.inf, value)

        chain = partial(_chain, log_density, len(centre), leaps, thin, draws)
        z, values, acceptance = jax.vmap(chain)(jax.random.split(key, CHAINS))
        return jax.vmap(jax.vmap(place))(z), values, acceptance

    return jax.vmap(one_window)(arrays, centres, factors, keys)


def _chain(
    log_density: Callable[[Array], Array], p: int, leaps: Array, thin: Array, draws: int, key: Array
) -> tuple[Array, Array, Array]:
    """One chain from the standard normal distribution, nearer to zero where there is no density."""
    import blackjax
    from blackjax.adaptation.step_size import dual_averaging_adaptation

    start_key, warm_key, draw_key = jax.random.split(key, 3)
    kernel, (begin, update, final) = blackjax.hmc.build_kernel(), dual_averaging_adaptation(ACCEPT)

    def step(key: Array, state: Any, size: Array) -> tuple[Any, Array]:
        jitter_key, key = jax.random.split(key)
        size *= jax.random.uniform(jitter_key, minval=JITTER[0], maxval=JITTER[1])
        state, info = kernel(key, state, log_density, size, jnp.ones(p), leaps)
        return state, jnp.nan_to_num(info.acceptance_rate)

    def warm(carry: tuple[Any, Any], key: Array) -> tuple[tuple[Any, Any], None]:
        state, adaptation = carry
        state, acceptance = step(key, state, jnp.minimum(jnp.exp(adaptation.log_step_size), LONGEST_STEP))
        return (state, update(adaptation, acceptance)), None

    def draw(state: Any, key: Array) -> tuple[Any, tuple[Array, Array, Array]]:
        def again(k: Array, carry: tuple[Any, Array]) -> tuple[Any, Array]:
            state, acceptance = step(jax.random.fold_in(key, k), carry[0], size)
            return state, carry[1] + acceptance / thin

        state, acceptance = jax.lax.fori_loop(0, thin, again, (state, jnp.zeros(())))
        return state, (state.position, state.logdensity, acceptance)

    z = jax.random.normal(start_key, (p,))
    z = jax.lax.fori_loop(0, 20, lambda _, z: jnp.where(jnp.isfinite(log_density(z)), z, z / 2), z)
    z = jnp.where(jnp.isfinite(log_density(z)), z, 0)
    state = blackjax.hmc.init(z, log_density)
    begun = state, begin(LONGEST_STEP / 10)
    (state, adaptation), _ = jax.lax.scan(warm, begun, jax.random.split(warm_key, WARM_UP))
    size = jnp.minimum(final(adaptation), LONGEST_STEP)
    _, (positions, values, acceptance) = jax.lax.scan(draw, state, jax.random.split(draw_key, draws))
    return positions, values, acceptance.mean()
