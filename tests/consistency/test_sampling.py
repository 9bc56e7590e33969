"""The posterior over robots: against a Gaussian, its prior weighted by hand, and automatic derivatives."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from factories.real_robots import PENDULUM, another, estimated, is_real
from jaximp.consistency import consistent_posterior, sampling
from jaximp.consistency.cone import ELEMENTS, pose
from jaximp.models.spatial import from_pseudo_inertia, pseudo_inertia

pytest.importorskip("blackjax", reason="the posterior needs blackjax: pip install 'jaximp[robots]'")

SPREAD = 0.5


def factor(numbers: jax.Array) -> jax.Array:
    """V of the log-Cholesky parameters a, d1, d2, d3, s12, s13, s23, t1, t2, t3."""
    a, d1, d2, d3, s12, s13, s23, t1, t2, t3 = numbers
    one = jnp.ones(())
    upper = [[jnp.exp(d1), s12, s13, t1], [0, jnp.exp(d2), s23, t2], [0, 0, jnp.exp(d3), t3], [0, 0, 0, one]]
    return jnp.exp(a) * jnp.array(upper)


def triangle(numbers: jax.Array) -> jax.Array:
    V = factor(numbers)
    S = V @ V.T
    return jnp.stack([S[i, j] for i, j in ELEMENTS])


def test_the_priors_density_is_that_of_its_parameters() -> None:
    """Normal in them, and divided by the volume that they stretch to, by automatic derivatives."""
    draws = np.random.default_rng(0).normal(size=(6, 10)) * 0.4
    widths = np.array([np.log1p(SPREAD) / 2] * 4 + [SPREAD] * 6)
    expected = [
        stats.norm(0, widths).logpdf(x).sum() - np.linalg.slogdet(jax.jacobian(triangle)(jnp.asarray(x)))[1] for x in draws
    ]
    S = jnp.stack([triangle(jnp.asarray(x)) for x in draws])
    found = np.asarray(sampling._log_prior(S, widths[0], widths[-1]))
    np.testing.assert_allclose(np.diff(found), np.diff(expected), rtol=1e-9)


def test_there_is_no_density_outside_the_cone() -> None:
    posed = pose(PENDULUM, *estimated(PENDULUM, PENDULUM.standard_parameters + 0.1, 0.1))
    density = sampling._density(posed, SPREAD)
    for standard in (another(PENDULUM, 1), another(PENDULUM, 1) * np.r_[-1, np.ones(10)]):
        y = np.linalg.solve(posed.map, posed.cone.coordinates(standard) - posed.start)
        assert np.isfinite(density(y)) == is_real(PENDULUM, standard)


def test_far_from_the_boundary_base_parameters_are_as_estimated() -> None:
    truth = another(PENDULUM, 3, 0.2)
    theta, C = estimated(PENDULUM, truth, 0.01)
    found = consistent_posterior(PENDULUM, theta, C, seed=1)
    assert found.ok, found.why
    error = np.sqrt(np.diag(C))
    np.testing.assert_allclose(found.base.mean, theta, atol=0.2 * error.min())
    np.testing.assert_allclose(found.base.covariance / np.outer(error, error), C / np.outer(error, error), atol=0.15)
    assert all(is_real(PENDULUM, standard) for standard in found.standard.samples)
    np.testing.assert_allclose(found.standard.samples @ PENDULUM.base.map.T, found.base.samples)
    low, _, high = found.quantiles()["link1.mass"]
    assert high > 1.5 * low


def test_near_the_boundary_it_is_the_prior_weighted_by_the_likelihood() -> None:
    """By draws of the prior, each with the weight that the estimate gives it."""
    theta, C = estimated(PENDULUM, another(PENDULUM, 3, 0.2), 0.4)
    theta[3] = 0.5 * np.sqrt(C[3, 3])
    found = consistent_posterior(PENDULUM, theta, C, spread=SPREAD, ess=1000)
    assert found.ok, found.why
    random = np.random.default_rng(0)
    draws = random.normal(size=(100_000, 10)) * np.array([np.log1p(SPREAD) / 2] * 4 + [SPREAD] * 6)
    own = pseudo_inertia(np.asarray(PENDULUM.links[0]))
    T = np.linalg.cholesky(own[::-1, ::-1])[::-1, ::-1] @ np.moveaxis(jax.vmap(factor)(jnp.asarray(draws)), 0, 0)
    links = np.array([from_pseudo_inertia(P) for P in T @ T.swapaxes(1, 2)])
    # Rayleigh's distribution of friction, with weights where the estimate is, as hardly a draw comes near it.
    friction = 6 * np.sqrt(C[3, 3]) * random.random(len(links))
    standard = np.column_stack([links, friction])
    d = standard @ PENDULUM.base.map.T - theta
    weight = friction * np.exp(-np.einsum("ki,ij,kj->k", d, np.linalg.inv(C), d) / 2)
    weight /= weight.sum()
    mean = weight @ standard
    deviation = np.sqrt(weight @ (standard - mean) ** 2)
    np.testing.assert_allclose((found.standard.mean - mean) / deviation, 0, atol=0.15)
    np.testing.assert_allclose(found.standard.samples.std(axis=0) / deviation, 1, atol=0.15)


@pytest.mark.usefixtures("unchecked")
def test_what_is_wrong_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    given = PENDULUM, PENDULUM.parameters, np.eye(4)
    with pytest.raises(ValueError, match="spread is 0: it must be above zero, such as 0.5 for 50 %"):
        consistent_posterior(*given, spread=0)
    with pytest.raises(ValueError, match=r"for the 4 base parameters of this chain they are \(4,\)"):
        consistent_posterior(PENDULUM, np.zeros(3), np.eye(4))
    monkeypatch.setattr(sampling, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"posteriors of robots need blackjax: pip install 'jaximp\[robots\]'"):
        consistent_posterior(*given)
