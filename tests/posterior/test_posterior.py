"""Posteriors: samplers against the exact one, diagnostics against ArviZ, files that resume or refuse."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import equinox as eqx
import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Array, Float
from scipy import stats

from factories.posteriors import Linear, chain_run, mode_of, triangle_of
from jaximp import plots
from jaximp.posterior import files as posterior_files
from jaximp.posterior.draws import (
    ESS_LEAST,
    Posterior,
    PosteriorMany,
    derive,
    diagnose,
    effective_samples,
    exact_posterior,
    make_posterior,
    probability_greater,
    summarise,
)
from jaximp.posterior.files import load_posterior, save_posterior
from jaximp.posterior.samplers import sample_many, sample_posterior
from paths import ROOT

EIGHT = ("D11", "D12", "D21", "D22", "l11", "l21", "l22", "log_noise")


class Stiffness(eqx.Module):
    """Damping and the factor of K = L L' by the triangle of their residuals; flat in K."""

    R: Float[Array, "*M 6 6"]
    count: Float[Array, "*M"]

    def __call__(self, theta: Array) -> Array:
        l11, l21, l22 = theta[4:7]
        inside = (l11 > 0) & (l22 > 0)
        K = jnp.array([[l11**2, l11 * l21], [l11 * l21, l21**2 + l22**2]])
        B = jnp.concatenate([theta[:4].reshape(2, 2).T, K])
        squares = ((self.R[:, :4] @ B - self.R[:, 4:]) ** 2).sum()
        volume = 2 * jnp.log(jnp.where(inside, l11, 1)) + jnp.log(jnp.where(inside, l22, 1))
        value = -self.count * theta[7] - squares / 2 * jnp.exp(-2 * theta[7]) + volume
        return jnp.where(inside, value, -jnp.inf)


@cache
def by_emcee() -> tuple[Posterior, Any]:
    R = triangle_of(0)
    density = Linear(jnp.asarray(R), jnp.asarray(15.0))
    return sample_posterior(density, mode_of(R, 15), ess=6000), exact_posterior(R, 15, ("a", "b", "c"))


def soft(seed: int) -> tuple[np.ndarray, int]:
    """Triangle of joints whose second direction has hardly any stiffness: K near singular."""
    random = np.random.default_rng(seed)
    X = random.normal(size=(60, 4))
    B = np.vstack([np.eye(2), [[9.0, 0.0], [0.0, 0.02]]])
    return np.linalg.qr(np.column_stack([X, X @ B + 0.5 * random.normal(size=(60, 2))]), mode="r"), 120


def soft_start(R: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Somewhere inside, with a covariance that is only roughly right."""
    B = np.linalg.solve(R[:4, :4], R[:4, 4:])
    start = np.array([B[0, 0], B[1, 0], B[0, 1], B[1, 1], 3.0, 0.0, 0.3, np.log(0.5)])
    return start, np.diag([0.07, 0.07, 0.07, 0.07, 0.02, 0.02, 0.2, 0.07]) ** 2


def soft_truth(R: np.ndarray, count: int, n: int = 400_000) -> np.ndarray:
    """Draws of (K11, K12, K22), by rejection from the posterior without the demand of definiteness."""
    random = np.random.default_rng(5)
    # Columns D11 D12 D21 D22 K11 K12 K22 of both torques stacked; noise sigma is one.
    W = np.zeros((2, 6, 7))
    W[0, :, 0], W[0, :, 1], W[0, :, 4], W[0, :, 5] = R[:, :4].T
    W[1, :, 2], W[1, :, 3], W[1, :, 5], W[1, :, 6] = R[:, :4].T
    W, y = W.reshape(12, 7), R[:, 4:].T.reshape(12)
    theta, rest = np.linalg.lstsq(W, y, rcond=None)[:2]
    dof = count - 7
    noise = np.sqrt(rest[0] / random.chisquare(dof, n))
    inverse = np.linalg.inv(np.linalg.qr(W, mode="r"))
    K = (theta + noise[:, None] * (random.normal(size=(n, 7)) @ inverse.T))[:, 4:]
    return K[(K[:, 0] > 0) & (K[:, 0] * K[:, 2] > K[:, 1] ** 2)]


def elements(theta: Array) -> Array:
    return jnp.stack([theta[4] ** 2, theta[4] * theta[5], theta[5] ** 2 + theta[6] ** 2])


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


# Exact


def test_exact_posterior_is_students_t() -> None:
    R = triangle_of(3)
    exact = exact_posterior(R, 15, ("a", "b", "c"), ("kg m^2", "N m s/rad", "N m/rad"))
    G = R[:3, :3].T @ R[:3, :3]
    shape = np.linalg.inv(G) * R[3, 3] ** 2 / 12
    oracle = stats.multivariate_t(np.linalg.solve(G, R[:3, :3].T @ R[:3, 3]), shape, df=12)
    np.testing.assert_allclose(exact.mean[:3], oracle.loc, rtol=1e-10)
    np.testing.assert_allclose(exact.covariance[:3, :3], shape * 12 / 10, rtol=1e-9)
    low, high = exact.interval(0.9)
    half = stats.t.ppf(0.95, 12) * np.sqrt(np.diag(shape))
    np.testing.assert_allclose(high[:3] - low[:3], 2 * half, rtol=1e-9)
    precision = stats.gamma(6, scale=2 / R[3, 3] ** 2)  # of 1/s^2
    np.testing.assert_allclose(np.exp([-2 * low[3], -2 * high[3]]), precision.ppf([0.95, 0.05]), rtol=1e-9)
    assert exact.names == ("a", "b", "c", "log_noise")
    assert exact.units[-1] == "1"


def test_draws_from_the_exact_posterior() -> None:
    exact = exact_posterior(triangle_of(3), 15)
    posterior = exact.posterior(jax.random.key(0), 40_000)
    assert posterior.ok
    assert means_agree(posterior, exact.mean)
    assert variances_agree(posterior, exact.covariance, exact.mean)
    low, high = exact.interval(0.8)
    inside = (posterior.samples > low) & (posterior.samples < high)
    assert np.abs(inside.mean(axis=0) - 0.8).max() < 4 * np.sqrt(0.16 / 40_000)
    density = Linear(jnp.asarray(triangle_of(3)), jnp.asarray(15.0))
    values = np.asarray(jax.vmap(density)(jnp.asarray(posterior.samples[:50])))
    np.testing.assert_allclose(posterior.log_density.reshape(-1)[:50], values, rtol=1e-9)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda R: (R, 3), "3 independent rows do not determine 3 parameters"),
        (lambda R: (R * np.nan, 15), "not finite"),
        (lambda R: (R * [1, 0, 1, 1], 15), "b cannot be told"),
        (lambda R: (R * np.array([[1], [1], [1], [0]]), 15), "without any residual"),
    ],
)
def test_exact_posterior_refuses(change: Callable[[np.ndarray], tuple[np.ndarray, int]], line: str) -> None:
    with pytest.raises(ValueError, match=line):
        exact_posterior(*change(triangle_of(0)), ("a", "b", "c"))


# Diagnostics


@pytest.mark.parametrize(("chains", "draws"), [(4, 50), (2, 101), (32, 120), (3, 40)])
def test_diagnostics_are_those_of_arviz(chains: int, draws: int) -> None:
    arviz = posterior_files._arviz()
    random = np.random.default_rng(chains)
    x = random.normal(size=(chains, draws, 12))
    for n in range(1, draws):
        x[:, n] += np.linspace(-0.9, 0.99, 12) * x[:, n - 1]
    x[..., 5] = x[..., 5].round(1)  # ties, as rejected proposals make them
    mine = diagnose(x)
    data = arviz.convert_to_dataset({"x": x})
    for got, there in zip(
        mine, (arviz.ess(data), arviz.ess(data, method="tail", prob=(0.05, 0.95)), arviz.rhat(data)), strict=True
    ):
        values = there["x"].values if "x" in there else there["posterior"]["x"].values
        np.testing.assert_allclose(got, values, rtol=1e-9)


def test_what_never_moves_has_no_effective_samples() -> None:
    x = np.random.default_rng(0).normal(size=(4, 100, 3))
    x[..., 1], x[0, 0, 2] = 2.0, np.nan
    ess, tail, rhat = diagnose(x)
    assert ess[0] > 100
    np.testing.assert_array_equal([ess[1:], tail[1:]], 0)
    np.testing.assert_array_equal(rhat[1:], np.inf)


def chains_of(kind: str) -> Posterior:
    random = np.random.default_rng(1)
    x, acceptance = random.normal(size=(8, 500, 2)), np.full(8, 0.5)
    if kind == "stuck":
        x[3] = x[3, :1]
    elif kind == "apart":
        x[:4, :, 1] += 3
    elif kind == "slow":
        x = np.repeat(random.normal(size=(8, 20, 2)), 25, axis=1)
    elif kind == "flat":
        x = np.cumsum(x, axis=1)
        x[..., 1] = x[..., 0] + 1e-3 * random.normal(size=(8, 500))
    elif kind == "refused":
        acceptance = np.full(8, 0.01)
    elif kind == "nothing":
        x = x * np.nan
    return make_posterior(x, ("damping", "stiffness"), acceptance=acceptance)


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("stuck", "1 of 8 chains never moved: start nearer"),
        ("apart", "R-hat of stiffness is .*, more than 1.05: more steps"),
        ("slow", "damping has 1.. effective samples, fewer than 400: more steps"),
        ("flat", "damping and stiffness cannot be told apart; fix one"),
        ("refused", "1% of the proposals were accepted: reparametrise"),
        ("nothing", "there is no posterior"),
    ],
)
def test_bad_chains_are_marked_with_what_to_do(kind: str, line: str) -> None:
    posterior = chains_of(kind)
    assert not posterior.ok
    with pytest.raises(AssertionError, match=line):
        raise AssertionError(posterior.why)
    assert "\n" not in posterior.why


def test_good_chains_pass_and_few_draws_do_not() -> None:
    good = chains_of("good")
    assert good.ok
    assert good.why == ""
    few = make_posterior(np.random.default_rng(0).normal(size=(4, 60, 1)), ("a",))
    assert f"fewer than {ESS_LEAST}" in few.why


# emcee


def test_emcee_agrees_with_the_exact_posterior() -> None:
    posterior, exact = by_emcee()
    assert posterior.ok
    assert posterior.names == ("a", "b", "c", "log_noise")
    assert posterior.units[0] == "kg m^2"
    assert min(posterior.ess.min(), posterior.ess_tail.min()) >= 6000
    assert means_agree(posterior, exact.mean)
    assert variances_agree(posterior, exact.covariance, exact.mean)
    assert not means_agree(posterior, exact.mean + 0.2 * np.sqrt(np.diag(exact.covariance)))  # it can fail


def test_the_seed_makes_the_chain() -> None:
    density = Linear(jnp.asarray(triangle_of(0)), jnp.asarray(15.0))
    start = mode_of(triangle_of(0), 15)
    one, same, other = (sample_posterior(density, start, seed=seed, max_steps=120) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.chains, same.chains)
    assert (one.chains[:, :50] != other.chains[:, :50]).all()


@pytest.mark.slow
def test_near_singular_stiffness_is_sampled_as_it_is() -> None:
    """The factor's last element piles up at zero; both samplers, from a start and a covariance that are rough."""
    R, count = soft(0)
    K = soft_truth(R, count)
    start, covariance = soft_start(R, count)
    density = Stiffness(jnp.asarray(R), jnp.asarray(float(count)))
    lanes = jax.tree.map(lambda x: x[None], density)
    many = sample_many(lanes, start[None], covariance[None], jax.random.key(0), names=EIGHT)
    for posterior in (sample_posterior(density, start, covariance=covariance, names=EIGHT), many[0]):
        assert posterior.ok, posterior.why
        of_K = derive(posterior, elements, ("K11", "K12", "K22"))
        assert means_agree(of_K, K.mean(axis=0), 4.5)
        low, high = np.quantile(K, [0.05, 0.95], axis=0)
        assert np.abs((of_K.samples < low).mean(axis=0) - 0.05).max() < 0.03
        assert np.abs((of_K.samples > high).mean(axis=0) - 0.05).max() < 0.03
        assert of_K.samples[:, 2].min() > 0


def banana(theta: Array) -> Array:
    return -(theta[0] ** 2) / 2 - ((theta[1] - theta[0] ** 2) / 0.3) ** 2 / 2


@pytest.mark.slow
def test_a_curved_ridge_is_marked_or_sampled_into_its_tails() -> None:
    """emcee with fewer steps than it needs says so; trajectories reach the tails, where they must be short."""
    assert not sample_posterior(banana, np.zeros(2), max_steps=1500).ok
    many = sample_many(banana, np.zeros((16, 2)), np.tile(np.diag([1, 0.09]), (16, 1, 1)), jax.random.key(1))
    assert many.ok.all()
    second = many.samples[..., 1]
    for found, truth in ((second.mean(axis=1), 1.0), (second.var(axis=1), 2.09)):
        assert abs(found.mean() - truth) < 4 * found.std() / np.sqrt(16)
    assert abs(second.var(axis=1).mean() / 2.09 - 1) < 0.1


def test_progress_and_a_posterior_that_is_cut_short() -> None:
    seen: list[float] = []
    density = Linear(jnp.asarray(triangle_of(0)), jnp.asarray(15.0))
    posterior = sample_posterior(density, mode_of(triangle_of(0), 15), max_steps=20, progress=seen.append)
    assert seen[-1] == 1
    assert seen == sorted(seen)
    assert not posterior.ok
    assert "effective samples" in posterior.why or "R-hat" in posterior.why


def normal(theta: Array) -> Array:
    return -(theta**2).sum() / 2


@pytest.mark.parametrize(
    ("density", "settings", "line"),
    [
        (normal, {"start": np.zeros(2), "walkers": 2}, "2 walkers for 2 parameters: take an even number, at least 4"),
        (normal, {"start": np.zeros(2), "walkers": 33}, "33 walkers for 2"),
        (normal, {}, "there is no start"),
        (normal, {"start": np.array([0, np.nan])}, "the start is not finite"),
        (normal, {"start": np.zeros(2), "names": ("a",)}, "1 names for 2 parameters"),
        (normal, {"start": np.zeros(2), "names": ("a", "a")}, "share a name"),
        (normal, {"start": np.zeros((32, 2))}, "all walkers start at one theta1"),
        (normal, {"start": np.arange(64.0).reshape(32, 2)}, "on a plane"),
        (normal, {"start": np.zeros(2), "covariance": np.diag([1, np.inf])}, "covariance of theta2 is not finite"),
        (
            normal,
            {"start": np.zeros(2), "covariance": np.ones((2, 2))},
            "not positive definite along theta1 and",
        ),
        (normal, {"start": np.zeros(2), "covariance": np.eye(3)}, "shape \\(3, 3\\)"),
        (lambda x: jnp.where(x[0] > 1, normal(x), -jnp.inf), {"start": np.zeros(2)}, "density at the start is zero"),
        (lambda x: normal(x) * jnp.nan, {"start": np.zeros(2)}, "log density is nan at theta1=0, theta2=0"),
        (lambda x: normal(x) + jnp.where(x[0] > 2, jnp.nan, 0), {"start": np.zeros(2)}, "return -inf where"),
        (lambda x: -(x[0] ** 2), {"start": np.zeros(2), "names": ("a", "b")}, "flat along b"),
        (lambda x: -((x[0] - x[1]) ** 2), {"start": np.zeros(2), "names": ("a", "b")}, "a and b cannot be told apart"),
        (lambda x: normal(x) + 3 * x[1] ** 2, {"start": np.zeros(2), "names": ("a", "b")}, "upwards along b"),
        (
            lambda x: jnp.where(x[0] > 0, normal(x), -jnp.inf),
            {"start": np.random.default_rng(0).normal(size=(32, 2))},
            "of 32 walkers start where the density is zero",
        ),
    ],
)
def test_emcee_refuses(unchecked: None, density: Callable[[Array], Array], settings: dict[str, Any], line: str) -> None:
    with pytest.raises(ValueError, match=line) as refused:
        sample_posterior(density, settings.pop("start", None), **settings)
    assert "\n" not in str(refused.value)


def test_a_density_without_end_is_marked() -> None:
    """Flat beyond what the covariance says: walkers wander off, and nothing can be said."""
    posterior = sample_posterior(
        lambda x: -((x[0] - x[1]) ** 2) / 2, np.zeros(2), covariance=np.eye(2), names=("a", "b")
    )
    assert not posterior.ok
    assert "a and b cannot be told apart" in posterior.why


def test_laplace_of_the_density_is_the_start() -> None:
    class WithLaplace(Linear):
        def laplace(self) -> tuple[np.ndarray, np.ndarray]:
            exact = exact_posterior(self.R, 15)
            return mode_of(np.asarray(self.R), 15), exact.covariance

    density = WithLaplace(jnp.asarray(triangle_of(0)), jnp.asarray(15.0))
    assert sample_posterior(density).ok


# Chain files


def test_an_interrupted_run_resumes_to_the_same_result(tmp_path: Path) -> None:
    whole = chain_run(None, ess=3000)
    path = tmp_path / "chain.h5"

    class Stop(KeyboardInterrupt):
        pass

    calls = iter(range(10_000))

    def stop(share: float) -> None:
        if next(calls) == 1:
            raise Stop

    with pytest.raises(Stop):
        chain_run(path, ess=3000, progress=stop)
    with h5py.File(path) as file:
        assert len(file["mcmc/chain"]) == 200
    chain_run(path, max_steps=350)  # with fewer steps than before it was interrupted, and then a few more
    resumed = chain_run(path, ess=3000)
    np.testing.assert_array_equal(whole.chains, resumed.chains)
    np.testing.assert_array_equal(whole.log_density, resumed.log_density)
    again = chain_run(path, ess=3000)
    np.testing.assert_array_equal(whole.chains, again.chains)
    assert [file.name for file in tmp_path.iterdir()] == ["chain.h5"]


def test_emcee_reads_the_file(tmp_path: Path) -> None:
    import emcee

    posterior = chain_run(tmp_path / "chain.h5", max_steps=100)
    backend = emcee.backends.HDFBackend(str(tmp_path / "chain.h5"), read_only=True)
    assert backend.iteration == 100
    assert backend.shape == (32, 4)
    kept = backend.get_chain()[-posterior.chains.shape[1] :].swapaxes(0, 1)
    np.testing.assert_array_equal(kept, posterior.chains)
    assert backend.random_state is not None
    assert backend.accepted.sum() > 0


@pytest.mark.slow
def test_a_run_that_is_killed_resumes(tmp_path: Path) -> None:
    """Killed without warning, between or while writing: what is there is whole."""
    program = """
        import sys
        sys.path[:0] = {path!r}
        import jax
        jax.config.update("jax_enable_x64", True)
        from jaximp.posterior import samplers
        samplers.SAVE_EVERY = 0
        from factories.posteriors import chain_run
        from pathlib import Path
        chain_run(Path({file!r}), ess=1e6)
    """
    file = tmp_path / "chain.h5"
    paths = [str(ROOT / "tests"), str(ROOT)]
    code = textwrap.dedent(program.format(path=paths, file=str(file)))
    with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL) as process:
        for _ in range(600):
            time.sleep(0.1)
            if file.exists() or process.poll() is not None:
                break
        assert process.poll() is None
        time.sleep(0.15)
        process.kill()
    for leftover in tmp_path.glob(".chain*"):
        leftover.unlink()
    resumed, whole = chain_run(file, max_steps=300), chain_run(None, max_steps=300)
    np.testing.assert_array_equal(resumed.chains, whole.chains)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"offset": 0.01}, "of other data or another model"),
        ({"seed": 1}, "made with 32 walkers, seed 0"),
        ({"walkers": 34}, "not with 34 walkers"),
        ({"names": ("x", "b", "c", "log_noise")}, "a model with the parameters a, b, c, log_noise"),
    ],
)
def test_chains_of_anything_else_are_refused_untouched(tmp_path: Path, change: dict[str, Any], line: str) -> None:
    path = tmp_path / "chain.h5"
    chain_run(path, max_steps=20)
    before = path.read_bytes()
    with pytest.raises(ValueError, match=line):
        chain_run(path, **change)
    assert path.read_bytes() == before


def test_other_files_are_refused_untouched(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("not a chain")
    with pytest.raises(ValueError, match="holds no chain"):
        chain_run(path)
    assert path.read_text() == "not a chain"
    with pytest.raises(ValueError, match="there is no folder"):
        chain_run(tmp_path / "nowhere" / "chain.h5")


# Many windows


@cache
def windows(n: int = 5) -> PosteriorMany:
    R = np.stack([triangle_of(seed) for seed in range(n)])
    starts = np.stack([mode_of(one, 15) for one in R])
    covariances = np.stack([exact_posterior(one, 15).covariance for one in R])
    covariances[1, 2, 2] = np.nan
    starts[3, 0] = np.nan
    density = Linear(jnp.asarray(R), jnp.full(n, 15.0))
    return sample_many(density, starts, covariances, jax.random.key(3))


@pytest.mark.slow
def test_every_window_has_its_exact_posterior() -> None:
    many = windows()
    np.testing.assert_array_equal(many.ok, [True, False, True, False, True])
    assert many.names == ("a", "b", "c", "log_noise")
    for k in (0, 2, 4):
        exact = exact_posterior(triangle_of(k), 15)
        assert means_agree(many[k], exact.mean)
        assert variances_agree(many[k], exact.covariance, exact.mean, 4.5)
        assert min(many.ess[k].min(), many.ess_tail[k].min()) >= 1000
    for k in (1, 3):
        assert np.isnan(many.samples[k]).all()
        assert "there is no posterior" in many.why[k]


def test_many_refuses(unchecked: None) -> None:
    key = jax.random.key(0)
    with pytest.raises(ValueError, match="covariances have the shape"):
        sample_many(normal, np.zeros((3, 2)), np.ones((2, 2, 2)), key)


# What posteriors say


def gaussian(mean: float, seed: int, n: int = 4000) -> Posterior:
    x = np.random.default_rng(seed).normal(mean, 1, (4, n // 4, 1))
    return make_posterior(x, ("stiffness",), ("N m/rad",))


def test_probability_of_a_change() -> None:
    found, error = probability_greater(gaussian(0.8, 0), gaussian(0.0, 1), "stiffness")
    truth = stats.norm.cdf(0.8 / np.sqrt(2))
    assert abs(found - truth) < 4 * error
    assert 0.002 < error < 0.01
    certain, error = probability_greater(gaussian(30.0, 0), gaussian(0.0, 1), "stiffness")
    assert certain == 1
    assert error > 1e-4


def test_its_error_is_that_of_repetition() -> None:
    """Also where draws depend on one another."""

    def slow(mean: float, seed: int) -> Posterior:
        random = np.random.default_rng(seed)
        x = random.normal(size=(4, 1200, 1))
        x[:, 0] *= 1 / np.sqrt(1 - 0.6**2)
        for n in range(1, 1200):
            x[:, n] += 0.6 * x[:, n - 1]
        return make_posterior(x + mean, ("stiffness",))

    found = np.array([probability_greater(slow(1, 2 * k), slow(0, 2 * k + 1), "stiffness") for k in range(40)])
    assert 0.7 < found[:, 0].std() / found[:, 1].mean() < 1.4


@given(st.lists(st.integers(0, 5), min_size=1, max_size=20), st.lists(st.integers(0, 5), min_size=1, max_size=20))
@settings(deadline=None, max_examples=40)
def test_shares_below_count_every_pair(a: list[int], b: list[int]) -> None:
    from jaximp.posterior.draws import _share_below

    x, y = np.array(a, float), np.array(b, float)
    pairs = (y[:, None] < x).mean(axis=0) + (y[:, None] == x).mean(axis=0) / 2
    np.testing.assert_allclose(_share_below(y, x), pairs, atol=1e-12)


def test_probability_refuses_what_it_cannot_say() -> None:
    a, b = gaussian(0, 0), gaussian(0, 1)
    with pytest.raises(ValueError, match="share samples"):
        probability_greater(a, b, "stiffness", spans=((0.0, 2.0), (1.5, 3.5)))
    assert probability_greater(a, b, "stiffness", spans=((0.0, 2.0), (2.0, 4.0)))[1] > 0
    with pytest.raises(ValueError, match="did you mean 'stiffness'"):
        probability_greater(a, b, "stifness")
    with pytest.raises(ValueError, match="cannot be trusted"):
        probability_greater(a, chains_of("apart"), "stiffness")


def test_summary_has_units_and_quantiles() -> None:
    row = summarise(gaussian(3.0, 0, 40_000))[0]
    assert row["name"] == "stiffness"
    assert row["unit"] == "N m/rad"
    expected = {"mean": 3.0, "sd": 1.0, "2.5%": 3 - 1.96, "25%": 3 - 0.674, "50%": 3.0, "75%": 3.674, "97.5%": 4.96}
    for name, value in expected.items():
        assert abs(row[name] - value) < 0.05, name
    assert abs(row["mean_error"] - 1 / 200) < 0.001


# Files and figures


def test_netcdf_is_read_by_arviz(tmp_path: Path) -> None:
    arviz, posterior = posterior_files._arviz(), by_emcee()[0]
    save_posterior(tmp_path / "one.nc", posterior)
    data = arviz.from_netcdf(str(tmp_path / "one.nc"))
    np.testing.assert_array_equal(data["posterior"]["c"].values, posterior["c"])
    assert data["posterior"]["c"].attrs["units"] == "N m/rad"
    assert data["sample_stats"]["lp"].shape == posterior.log_density.shape
    np.testing.assert_array_equal(data["sample_stats"]["acceptance_rate"].values, posterior.acceptance)
    assert "emcee" in data["posterior"].attrs["sampler"]
    again = load_posterior(tmp_path / "one.nc")
    np.testing.assert_array_equal(again.chains, posterior.chains)
    assert again.names == posterior.names
    assert again.units == posterior.units
    np.testing.assert_allclose(again.rhat, posterior.rhat)
    assert [file.name for file in tmp_path.iterdir()] == ["one.nc"]


def test_netcdf_of_many_windows(tmp_path: Path) -> None:
    save_posterior(tmp_path / "many.nc", windows(), np.arange(5) * 0.5)
    data = posterior_files._arviz().from_netcdf(str(tmp_path / "many.nc"))
    assert data["posterior"]["a"].dims == ("chain", "draw", "window")
    np.testing.assert_array_equal(data["posterior"]["window"].values, np.arange(5) * 0.5)
    np.testing.assert_array_equal(data["posterior"]["a"].values[..., 2], windows()[2]["a"])
    assert "there is no posterior" in data["posterior"].attrs["why_not_trusted"]
    with pytest.raises(ValueError, match="no file with one posterior"):
        load_posterior(tmp_path / "many.nc")


def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "chain.h5"
    chain_run(path, max_steps=20)
    before = path.read_bytes()

    def fail(*_: Any) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(posterior_files.os, "replace", fail)
    with pytest.raises(OSError, match="no space"):
        chain_run(path, max_steps=40)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["chain.h5"]


def test_figures_render() -> None:
    posterior, many = by_emcee()[0], windows()
    random = np.random.default_rng(0)
    K = random.normal(size=(500, 2, 2)) * 0.1 + np.array([[3.0, 1.0], [1.0, 2.0]])
    truth = {"a": 0.015}
    for figure in (
        plots.corner(posterior, truth=truth),
        plots.corner(posterior, ["a", "c"], other=many[0]),
        plots.bands(np.arange(5) * 0.5, many, ["a", "c"]),
        plots.ellipse_bands({"stiffness": {"rest": K, "task": 1.2 * K}}, {"stiffness": "N m/rad"}),
    ):
        assert len(plots.png(figure)) > 10_000
    with pytest.raises(ValueError, match="no parameter is called 'd'"):
        plots.corner(posterior, ["d"])
    panel = plots.corner(posterior, truth=truth).axes[0]
    assert panel.get_lines()[-1].get_xdata()[0] == 0.015


def test_the_ellipse_reaches_where_the_matrix_takes_unit_vectors() -> None:
    from jaximp.plots.posterior import _radius

    K = np.array([[3.0, 1.0], [1.0, 2.0]])
    angle = np.linspace(0, 2 * np.pi, 50)
    reached = K @ np.stack([np.cos(angle), np.sin(angle)])
    length = np.linalg.norm(reached, axis=0)
    np.testing.assert_allclose(_radius(K[None], reached / length)[0], length, rtol=1e-12)
