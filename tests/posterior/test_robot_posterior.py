"""The posterior over robots: against a Gaussian, its prior weighted by hand, and densities of scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from factories.real_robots import PENDULUM, another, estimated, is_real
from jaximp.consistency.cone import pose
from jaximp.models.spatial import from_pseudo_inertia, pseudo_inertia
from jaximp.posterior import consistent_posterior, robots

pytest.importorskip("blackjax", reason="the posterior needs blackjax: pip install 'jaximp[robots]'")

SPREAD = 0.5


def triangular(numbers: np.ndarray) -> np.ndarray:
    """(..., 4, 4) V of the log-Cholesky parameters a, d1, d2, d3, s12, s13, s23, t1, t2, t3."""
    V = np.zeros((*numbers.shape[:-1], 4, 4))
    V[..., range(3), range(3)] = np.exp(numbers[..., 1:4])
    V[..., 3, 3] = 1
    V[..., [0, 0, 1, 0, 1, 2], [1, 2, 2, 3, 3, 3]] = numbers[..., 4:]
    return np.exp(numbers[..., :1, None]) * V


def robots_of(numbers: np.ndarray) -> np.ndarray:
    """(N, 10) pendulums by log-Cholesky parameters relative to the URDF's."""
    own = pseudo_inertia(np.asarray(PENDULUM.links[0]))
    T = np.linalg.cholesky(own[::-1, ::-1])[::-1, ::-1] @ triangular(numbers)
    return np.array([from_pseudo_inertia(P) for P in T @ T.swapaxes(-1, -2)])


WIDTHS = np.array([np.log1p(SPREAD) / 2] * 4 + [SPREAD] * 6)


def test_the_density_is_that_of_the_estimate_and_the_prior() -> None:
    """Of normal errors, normal log-Cholesky parameters, and the logarithm of Rayleigh's friction."""
    theta, C = estimated(PENDULUM, PENDULUM.standard_parameters + 0.1, 0.1)
    posed = pose(PENDULUM, theta, C)
    density = robots._density(posed, SPREAD)
    free = np.random.default_rng(0).normal(size=(5, 11)) * 0.5
    links = robots_of(free[:, :10] * WIDTHS)
    size = 40 / 3  # of friction: effort over velocity
    standard = np.column_stack([links, size * np.exp(free[:, 10])])
    found = [posed.cone.reference + posed.cone.scale @ np.asarray(density.coordinates(x)) for x in free]
    np.testing.assert_allclose(found, standard, rtol=1e-9, atol=1e-12)
    expected = stats.multivariate_normal(theta, C).logpdf(standard @ PENDULUM.base.map.T)
    expected = expected + stats.norm.logpdf(free[:, :10]).sum(axis=1)
    expected = expected + stats.rayleigh.logpdf(np.exp(free[:, 10])) + free[:, 10]
    np.testing.assert_allclose(np.diff([density(x) for x in free]), np.diff(expected), rtol=1e-8)


@pytest.mark.slow
def test_far_from_the_boundary_base_parameters_are_as_estimated() -> None:
    truth = another(PENDULUM, 3, 0.2)
    theta, C = estimated(PENDULUM, truth, 0.04)
    found = consistent_posterior(PENDULUM, theta, C, seed=1)
    assert found.ok, found.why
    error = np.sqrt(np.diag(C))
    np.testing.assert_allclose((found.base.mean - theta) / error, 0, atol=0.25)
    np.testing.assert_allclose(found.base.covariance / np.outer(error, error), C / np.outer(error, error), atol=0.15)
    assert all(is_real(PENDULUM, standard) for standard in found.standard.samples)
    np.testing.assert_allclose(found.standard.samples @ PENDULUM.base.map.T, found.base.samples)
    low, _, high = found.quantiles()["link1.mass"]
    assert high > 1.5 * low


@pytest.mark.slow
def test_near_the_boundary_it_is_the_prior_weighted_by_the_likelihood() -> None:
    """By draws of the prior, each with the weight that the estimate gives it."""
    theta, C = estimated(PENDULUM, another(PENDULUM, 3, 0.2), 0.4)
    theta[3] = 0.5 * np.sqrt(C[3, 3])
    found = consistent_posterior(PENDULUM, theta, C, spread=SPREAD)
    assert found.ok, found.why
    random = np.random.default_rng(0)
    links = robots_of(random.normal(size=(30_000, 10)) * WIDTHS)
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
    assert all(is_real(PENDULUM, standard) for standard in found.standard.samples)


@pytest.mark.usefixtures("unchecked")
def test_what_is_wrong_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    given = PENDULUM, PENDULUM.parameters, np.eye(4)
    with pytest.raises(ValueError, match="spread is 0: it must be above zero, such as"):
        consistent_posterior(*given, spread=0)
    with pytest.raises(ValueError, match=r"for the 4 base parameters of this chain they are \(4,\)"):
        consistent_posterior(PENDULUM, np.zeros(3), np.eye(4))
    monkeypatch.setattr(robots, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"posteriors of robots need blackjax: pip install 'jaximp\[robots\]'"):
        consistent_posterior(*given)
