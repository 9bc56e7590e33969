"""Draws: exact ones, diagnostics against ArviZ, and what they say of parameters."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from factories.posteriors import Linear, means_agree, triangle_of, variances_agree
from jaximp.posterior import files as posterior_files
from jaximp.posterior.draws import (
    ESS_LEAST,
    Posterior,
    diagnose,
    exact_posterior,
    make_posterior,
    probability_greater,
    summarise,
)

# --- exact ------------------------------------------------------------------------------------------------------------


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


# --- diagnostics ------------------------------------------------------------------------------------------------------


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


# --- what posteriors say ----------------------------------------------------------------------------------------------


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
