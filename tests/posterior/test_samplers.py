"""Samplers against the exact posterior; what is refused; files and figures of what they drew."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from factories.posteriors import Linear, means_agree, mode_of, triangle_of, variances_agree
from jaximp import plots
from jaximp.posterior import files as posterior_files
from jaximp.posterior.draws import Posterior, PosteriorMany, derive, exact_posterior
from jaximp.posterior.ensemble import sample_posterior
from jaximp.posterior.files import load_posterior, save_posterior
from jaximp.posterior.hamiltonian import sample_many

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


# --- emcee ------------------------------------------------------------------------------------------------------------


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


# --- many windows -----------------------------------------------------------------------------------------------------


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


# --- files and figures ------------------------------------------------------------------------------------------------


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
