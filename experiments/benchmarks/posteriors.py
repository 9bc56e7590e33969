"""Draws from posteriors: effective samples per second beside plain emcee, and 1000 windows at once.

One posterior: damping, the factor of a stiffness and the noise, 8 parameters, from 9200 samples of two torques.
`sample_posterior` against emcee as one would use it without this toolkit: 32 walkers, its stretch move, and a log
density in numpy that goes over the samples. Effective samples are ArviZ's, of the parameter with the fewest. Of plain
emcee only the time of the steps that are kept counts; of ours all, from the mode to the diagnostics.

Many posteriors: 1000 windows of a record of the rig, and 1000 stiffness posteriors of simulated arms, 1000 effective
samples of every parameter asked for, of the bulk and of the tails. Compiled before it is timed, except where stated;
plain emcee and ours in one run. Needs the extra `windows` (blackjax). Writes results/posteriors.json and .md; `one` or
`many` as an argument for one half alone.
"""

from __future__ import annotations

import json
import os
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import emcee
import equinox as eqx
import jax
import numpy as np
from numpy.typing import NDArray

jax.config.update("jax_enable_x64", True)
sys.path.insert(0, str(Path(__file__).parents[1]))

import coverage  # noqa: E402
from stiffness_fits import D, K, machine, trials  # noqa: E402

from jaximp import signals  # noqa: E402
from jaximp.perturbation import merge_triangles, residual_triangle  # noqa: E402
from jaximp.posterior import (  # noqa: E402
    Density,
    PosteriorMany,
    exact_posterior,
    sample_many,
    sample_posterior,
    stiffness_density,
    window_densities,
)

with warnings.catch_warnings():
    warnings.simplefilter("ignore", FutureWarning)
    import arviz

Numbers = NDArray[np.float64]

RESULTS = Path(__file__).parents[1] / "results"
WINDOWS, ESS = 1000, 1000
WALKERS, PLAIN_STEPS, PLAIN_DROPPED = 32, 6000, 600
SAMPLES = 9200
EVERY = 40
REPEATS = 3
"""Of one posterior the median, of many the best."""


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    begin = time.perf_counter()
    result = work()
    return time.perf_counter() - begin, result


def fewest(chains: Numbers, method: str) -> float:
    """ArviZ's effective samples of the parameter with the fewest, from (chains, draws, p)."""
    found = arviz.ess(arviz.convert_to_dataset({"x": chains}), method=method)
    return float(found["x"].values.min())


def plain_log_density(displacement: Numbers, velocity: Numbers, torque: Numbers) -> Callable[[Numbers], float]:
    """Of eq. (38) of Börner et al. 2020 with Gaussian noise, flat in K; the samples as they are."""
    q, dq, tau = (x.reshape(-1, 2) for x in (displacement, velocity, torque))

    def log_density(theta: Numbers) -> float:
        l11, l21, l22, log_noise = theta[4:]
        if l11 <= 0 or l22 <= 0:
            return -np.inf
        L = np.array([[l11, 0.0], [l21, l22]])
        residual = dq @ theta[:4].reshape(2, 2).T + q @ (L @ L.T) - tau
        squares = np.vdot(residual, residual)
        log_det = np.log(4 * l11**2 * l22)
        return float(-squares / 2 * np.exp(-2 * log_noise) - tau.size * log_noise + log_det)

    return log_density


def one_posterior() -> dict[str, Any]:
    """Plain emcee and ours, in turns."""
    data = trials(K, 0)
    density = stiffness_density(merge_triangles(residual_triangle(*data)), SAMPLES)
    compile_s, _ = timed(lambda: sample_posterior(density, seed=100))
    log_density = plain_log_density(*data)
    mode, covariance = (np.asarray(x) for x in density.laplace())
    away = [np.zeros(8), np.sqrt(np.diag(covariance))]
    differences = [log_density(mode + x) - float(density(mode + x)) for x in away]
    np.testing.assert_allclose(np.diff(differences), 0, atol=1e-6)  # one density, up to a constant
    found: dict[str, Any] = {"first_call_s": compile_s, "runs": []}
    for seed in range(REPEATS):
        run = {"plain": plain(log_density, mode, covariance, seed)}
        for ess in (1000, 10_000):
            seconds, posterior = timed(lambda ess=ess, seed=seed: sample_posterior(density, ess=ess, seed=seed))
            run[f"ours_{ess}"] = rates(posterior.chains, seconds) | {
                "steps": posterior.sampler,
                "ok": posterior.ok,
                "means_apart_sd": apart(run["plain"]["mean"], posterior.mean, covariance),
            }
        found["runs"].append(run)
    for name in ("plain", "ours_1000", "ours_10000"):
        for rate in ("bulk_per_s", "tail_per_s"):
            found[f"{name}_{rate}"] = float(np.median([run[name][rate] for run in found["runs"]]))
    for ours in ("ours_1000", "ours_10000"):
        found[f"{ours}_over_plain"] = float(
            np.median([run[ours]["bulk_per_s"] / run["plain"]["bulk_per_s"] for run in found["runs"]])
        )
    return found


def apart(mean: list[float], other: Numbers, covariance: Numbers) -> float:
    """Largest distance of two means, in standard deviations of the posterior."""
    return float((np.abs(np.array(mean) - other) / np.sqrt(np.diag(covariance))).max())


def plain(log_density: Callable[[Numbers], float], mode: Numbers, covariance: Numbers, seed: int) -> dict[str, Any]:
    random = np.random.default_rng(seed)
    start = random.multivariate_normal(mode, covariance, WALKERS)
    sampler = emcee.EnsembleSampler(WALKERS, len(mode), log_density)
    np.random.seed(seed)  # noqa: NPY002 emcee's own way
    state = sampler.run_mcmc(start, PLAIN_DROPPED)
    sampler.reset()
    seconds, _ = timed(lambda: sampler.run_mcmc(state, PLAIN_STEPS))
    chains = sampler.get_chain().swapaxes(0, 1)
    return rates(chains, seconds) | {"steps": PLAIN_STEPS, "mean": chains.mean(axis=(0, 1)).tolist()}


def rates(chains: Numbers, seconds: float) -> dict[str, float]:
    bulk, tail = fewest(np.asarray(chains), "bulk"), fewest(np.asarray(chains), "tail")
    return {"seconds": seconds, "bulk": bulk, "tail": tail, "bulk_per_s": bulk / seconds, "tail_per_s": tail / seconds}


def rig_windows() -> Density:
    """Windows of 2 s of one record of the rig, filtered once, every 40th sample: inertia to offset, and the noise."""
    q, torque = coverage.motion(quantised=True)
    measured = torque + coverage.NOISE * np.random.default_rng(0).normal(size=len(torque))
    W, y = (
        np.asarray(signals.filter_zero_phase(coverage.PARALLEL_FILTER, x))
        for x in (coverage.regressor(jax.numpy.asarray(q)), jax.numpy.asarray(measured))
    )
    noise = signals.autocovariance(coverage.PARALLEL_FILTER, EVERY)
    length = coverage.WINDOW
    starts = np.linspace(1000, len(y) - length - 1000, WINDOWS).astype(int)
    rows = starts[:, None] + np.arange(0, length, EVERY)
    kept = rows.shape[1]
    densities, why = window_densities(
        list(coverage.TRUTH),
        ("kg m^2", "N m s/rad", "N m/rad", "N m"),
        W[rows].reshape(-1, 4),
        y[rows].ravel(),
        np.arange(WINDOWS) * kept,
        kept,
        noise,
    )
    assert not any(why)
    return densities


def arm_windows() -> Density:
    """Stiffness posteriors of perturbed arms, 9200 samples each, every one with noise of its own."""
    densities = []
    for seed in range(WINDOWS):
        displacement, velocity, torque = trials(K, 0)
        noise = np.random.default_rng(seed).normal(0, 0.3, torque.shape)
        exact = velocity @ D.T + displacement @ K.T
        triangle = merge_triangles(residual_triangle(displacement, velocity, exact + noise))
        densities.append(stiffness_density(triangle, SAMPLES))
    return jax.tree.map(lambda *x: np.stack(x), *densities)


def many_posteriors(densities: Density) -> tuple[dict[str, Any], PosteriorMany]:
    laplace = eqx.filter_jit(eqx.filter_vmap(lambda density: density.laplace()))
    jax.block_until_ready(laplace(densities))

    def work() -> PosteriorMany:
        modes, covariances = (np.asarray(x) for x in laplace(densities))
        return sample_many(densities, modes, covariances, jax.random.key(0), ess=ESS)

    first, _ = timed(work)
    seconds, many = min((timed(work) for _ in range(REPEATS)), key=lambda one: one[0])
    whole = [fewest(np.asarray(many.chains[k]), "bulk") for k in range(0, WINDOWS, 100)]
    np.testing.assert_allclose(whole, many.ess[::100].min(axis=1), rtol=1e-6)  # ours are ArviZ's
    return {
        "parameters": many.chains.shape[-1],
        "seconds": seconds,
        "first_call_s": first,
        "draws_each": int(np.prod(many.chains.shape[1:3])),
        "fewest_bulk": float(many.ess.min()),
        "fewest_tail": float(many.ess_tail.min()),
        "median_bulk": float(np.median(many.ess.min(axis=1))),
        "median_tail": float(np.median(many.ess_tail.min(axis=1))),
        "largest_rhat": float(many.rhat.max()),
        "pass_the_gate": int(many.ok.sum()),
        "enough_bulk": int((many.ess.min(axis=1) >= ESS).sum()),
        "enough_tail": int((many.ess_tail.min(axis=1) >= ESS).sum()),
    }, many


def exact_posteriors(densities: Density, many: PosteriorMany) -> dict[str, Any]:
    """The same windows without a sampler, and how far the sampler is from them."""
    rows, count = np.asarray(densities.likelihood.rows)[:, 0], np.asarray(densities.likelihood.count)[:, 0]
    keys = list(jax.random.split(jax.random.key(1), WINDOWS))

    def work() -> Any:
        exact = [exact_posterior(R, n) for R, n in zip(rows, count, strict=True)]
        return exact, [np.asarray(one.samples(key, ESS)) for one, key in zip(exact, keys, strict=True)]

    work()
    seconds, (exact, _) = timed(work)
    sd = np.sqrt([np.diag(one.covariance) for one in exact])
    away = (many.samples.mean(axis=1) - [one.mean for one in exact]) / sd * np.sqrt(many.ess)
    return {
        "seconds": seconds,
        "mean_square_of_means_apart_in_monte_carlo_errors": float((away**2).mean()),
        "sd_over_exact": float((many.samples.std(axis=1) / sd).mean()),
    }


def measured_one() -> dict[str, Any]:
    return {"one": one_posterior()}


def measured_many() -> dict[str, Any]:
    densities = rig_windows()
    of_rig, many = many_posteriors(densities)
    return {"rig": of_rig, "exact": exact_posteriors(densities, many), "arm": many_posteriors(arm_windows())[0]}


def table(found: dict[str, Any]) -> list[str]:
    one, exact = found["one"], found["exact"]
    lines = [f"One stiffness posterior, 8 parameters, {found['samples']} samples (median of {REPEATS}):", ""]
    lines += [
        "| | effective samples per second, bulk | tails | times plain emcee |",
        "| --- | --- | --- | --- |",
        f"| plain emcee, numpy on all samples | {one['plain_bulk_per_s']:.0f} | {one['plain_tail_per_s']:.0f} | 1 |",
    ]
    for ess in (1000, 10_000):
        name = f"ours_{ess}"
        lines.append(
            f"| `sample_posterior(ess={ess})` | {one[f'{name}_bulk_per_s']:.0f} | {one[f'{name}_tail_per_s']:.0f} "
            f"| {one[f'{name}_over_plain']:.0f} |"
        )
    lines += [
        "",
        f"The first call, which compiles, takes {one['first_call_s']:.1f} s.",
        "",
    ]
    asked = f"{ESS} effective samples of every parameter asked for"
    lines += [f"{WINDOWS} posteriors, {asked}, `sample_many` (best of {REPEATS}):", ""]
    rows = {
        "parameters": ("parameters", ".0f"),
        "seconds": ("seconds", ".1f"),
        "seconds of a first call, which compiles": ("first_call_s", ".1f"),
        "draws of each": ("draws_each", ".0f"),
        "effective samples, bulk: fewest": ("fewest_bulk", ".0f"),
        "tails: fewest": ("fewest_tail", ".0f"),
        "posteriors with as many as asked for, bulk": ("enough_bulk", ".0f"),
        "tails": ("enough_tail", ".0f"),
        "posteriors that pass the diagnostics": ("pass_the_gate", ".0f"),
    }
    lines += ["| | rig, windows of 2 s | arm, 9200 samples |", "| --- | --- | --- |"]
    for text, (key, form) in rows.items():
        cells = [format(found[name][key], form) for name in ("rig", "arm")]
        lines.append(f"| {text} | {' | '.join(cells)} |")
    lines += [
        "",
        f"The exact posteriors of the rig's windows, {ESS} independent draws each, take {exact['seconds']:.1f} s. "
        "Means of `sample_many` differ from theirs by "
        f"{np.sqrt(exact['mean_square_of_means_apart_in_monte_carlo_errors']):.2f} Monte Carlo standard errors (root "
        f"mean square), standard deviations are {exact['sd_over_exact']:.3f} of theirs.",
    ]
    return lines


if __name__ == "__main__":
    path = RESULTS / "posteriors.json"
    found = json.loads(path.read_text()) if path.exists() else {}
    found |= {"machine": machine(), "samples": SAMPLES, "windows": WINDOWS, "ess": ESS}
    for name, part in (("one", measured_one), ("many", measured_many)):
        if name in (sys.argv[1:] or ("one", "many")):
            found |= part() | {f"load_after_{name}": os.getloadavg()[0]}
    text = "\n".join([machine() + "\n", *table(found)])
    path.write_text(json.dumps(found, indent=1) + "\n")
    (RESULTS / "posteriors.md").write_text(text + "\n")
    print(text)
