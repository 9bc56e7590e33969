"""Priors: those of scipy, what is refused, and what they do to an estimate."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import lognorm, multivariate_normal, norm

from factories.densities import NAMES, UNITS, arm_density, gradient, record, value
from jaximp.least_squares.noise import whiten
from jaximp.posterior.densities import linear_density
from jaximp.posterior.predictive import prior_predictive
from jaximp.posterior.priors import LogNormal, MultivariateNormal, Normal, make_prior


def test_priors_are_those_of_scipy() -> None:
    A = np.array([[4.0, 1.0], [1.0, 9.0]])
    prior = make_prior(
        ("a", "b", "c", "d", "e"),
        {"a": Normal(1.0, 2.0), "d": LogNormal(3.0, 1.5)},
        [MultivariateNormal(("e", "b"), np.array([1.0, 2.0]), A)],
    )
    x = np.array([0.5, 1.5, 100.0, 2.0, -1.0])
    expected = norm.logpdf(0.5, 1, 2) + lognorm.logpdf(2.0, np.log(1.5), scale=3.0)
    np.testing.assert_allclose(prior.log_density(x), expected + multivariate_normal.logpdf([-1, 1.5], [1, 2], A))
    assert prior.log_density(jnp.asarray(x).at[3].set(-2.0)) == -jnp.inf
    assert np.isfinite(jax.grad(prior.log_density)(jnp.asarray(x).at[3].set(-2.0))).all()
    draws = prior.draws(4000, np.random.default_rng(0))
    assert np.isnan(draws[:, 2]).all()
    assert (draws[:, 3] > 0).all()
    np.testing.assert_allclose(np.median(draws[:, 3]), 3.0, rtol=0.05)
    np.testing.assert_allclose(np.cov(draws[:, [4, 1]].T), A, rtol=0.15, atol=0.5)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"stifness": Normal(1, 1)}, "did you mean 'stiffness'"),
        ({"stiffness": Normal(1, 0)}, "sd must be above zero"),
        ({"stiffness": LogNormal(-1, 2)}, "median must be above zero"),
        ({"stiffness": LogNormal(1, 1)}, "factor above one"),
        ({"log_noise": LogNormal(1, 2)}, "give it a normal prior"),
    ],
)
def test_impossible_priors_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_prior((*NAMES, "log_noise"), given)


def test_impossible_blocks_are_refused() -> None:
    block = MultivariateNormal(("inertia", "damping"), np.zeros(2), np.eye(2))
    with pytest.raises(ValueError, match="two priors"):
        make_prior(NAMES, {"inertia": Normal(0, 1)}, [block])
    for covariance in (-np.eye(2), np.array([[1.0, 0.9], [0.0, 1.0]]), np.ones((2, 2))):
        with pytest.raises(ValueError, match="positive definite"):
            make_prior(NAMES, blocks=[MultivariateNormal(block.names, np.zeros(2), covariance)])
    with pytest.raises(ValueError, match="was there an estimate"):
        make_prior(NAMES, blocks=[MultivariateNormal(block.names, np.zeros(2), np.full((2, 2), np.nan))])
    W, y = record()
    with pytest.raises(ValueError, match="make it for inertia"):
        linear_density(NAMES, UNITS, whiten(W, y), make_prior(NAMES))


def test_a_robot_that_is_known_is_a_prior_of_its_parameters() -> None:
    """The posterior of both recordings one after the other is that of both together, if the noise is known."""
    random = np.random.default_rng(0)
    alone, robot = random.normal(size=(200, 2)), np.array([1.0, 2.0])
    y_alone = alone @ robot + 0.1 * random.normal(size=200)
    both = np.concatenate([random.normal(size=(80, 2)), random.normal(size=(80, 1))], axis=1)
    y_both = both @ np.r_[robot, 5.0] + 0.1 * random.normal(size=80)
    known = Normal(np.log(0.1), 1e-6)
    before = linear_density(("robot.a", "robot.b"), ("", ""), whiten(alone, y_alone))
    estimate = np.linalg.lstsq(alone, y_alone)[0], 0.01 * np.linalg.inv(alone.T @ alone)
    np.testing.assert_allclose(before.laplace()[0][:2], estimate[0], rtol=1e-8)
    names = ("robot.a", "robot.b", "human.k", "log_noise")
    prior = make_prior(names, {"log_noise": known}, [MultivariateNormal(names[:2], *estimate)])
    mode, covariance = linear_density(names[:3], ("",) * 3, whiten(both, y_both), prior).laplace()
    W = np.concatenate([np.c_[alone, np.zeros(200)], both])
    np.testing.assert_allclose(mode[:3], np.linalg.lstsq(W, np.r_[y_alone, y_both])[0], rtol=1e-6)
    np.testing.assert_allclose(covariance[:3, :3], 0.01 * np.linalg.inv(W.T @ W), rtol=1e-4, atol=1e-9)


def test_a_log_normal_prior_keeps_a_parameter_positive() -> None:
    W, y = record()
    prior = make_prior((*NAMES, "log_noise"), {"stiffness": LogNormal(5.0, 2.0)})
    density = linear_density(NAMES, UNITS, whiten(W, -y), prior)
    assert value(density, jnp.asarray([0.1, 1.0, -1.0, 0.0])) == -jnp.inf
    mode, covariance = density.laplace()
    assert mode[2] > 0
    assert np.isfinite(covariance).all()
    np.testing.assert_allclose(gradient(density, mode) * np.sqrt(np.diag(covariance)), 0, atol=1e-6)
    assert float(arm_density(stiffness_11=Normal(10.0, 0.1)).laplace()[0][4] ** 2) < 20


def test_prior_predictive_compares_sizes_and_names_what_is_flat() -> None:
    W, y = record(1000)
    names = (*NAMES, "log_noise")
    sure = prior_predictive(make_prior(names, {"stiffness": Normal(20.0, 0.01)}), W, y)
    np.testing.assert_allclose(sure.ratio[1], np.linalg.norm(W[:, 2] * 20) / np.linalg.norm(y), rtol=1e-3)
    assert sure.flat == ("inertia", "damping", "log_noise")
    wild = prior_predictive(make_prior(names, {"stiffness": Normal(0.0, 1e5)}), W, y)
    assert wild.ratio[0] > 50
    nothing = prior_predictive(make_prior(names), W, y)
    assert np.isnan(nothing.ratio).all()
    assert nothing.flat == names
