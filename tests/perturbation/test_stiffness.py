"""Fits of a symmetric, definite stiffness: against a convex solver, scipy and all data together; failures, errors."""

from __future__ import annotations

import warnings
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.stats import t as student

import jaximp
from jaximp.perturbation.stiffness import (
    DAMPING,
    REASONS,
    fit_triangles,
    fit_triangles_linear,
    merge_triangles,
    residual_triangle,
)

Numbers = NDArray[np.float64]

D = np.array([[2.4, 1.2], [1.0, 1.4]])
K = np.array([[29.05, 14.37], [14.37, 17.08]])
every_damping = pytest.mark.parametrize("damping", DAMPING)


def trials(
    batch: int, n_trials: int, stiffness: Numbers = K, noise: float = 0.1, seed: int = 0, samples: int = 40
) -> tuple[Numbers, Numbers, Numbers]:
    """Displacement, velocity and torque (batch, trials, samples, 2) of smooth pulses along six directions."""
    random = np.random.default_rng(seed)
    time = np.linspace(0, 0.2, samples)
    u = time / 0.2
    profile = 10 * u**3 - 15 * u**4 + 6 * u**5
    directions = 0.05 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [1, -1], [-1, 1]])[np.arange(n_trials) % 6]
    amplitude = directions * random.normal(1, 0.2, (batch, n_trials, 1))
    displacement = amplitude[:, :, None] * profile[:, None]
    velocity = amplitude[:, :, None] * np.gradient(profile, time)[:, None]
    error = random.normal(size=displacement.shape)
    for i in range(1, samples):  # noise with a memory of twenty samples
        error[:, :, i] = 0.95 * error[:, :, i - 1] + np.sqrt(1 - 0.95**2) * error[:, :, i]
    torque = velocity @ D.T + displacement @ np.swapaxes(stiffness, -1, -2) + noise * error
    return displacement, velocity, torque


@cache
def indefinite_triangles() -> Numbers:
    """(24, 6, 6) of one trial each, most with data that a definite stiffness does not suit."""
    random = np.random.default_rng(4)
    displacement, velocity, error = random.normal(size=(3, 24, 40, 2))
    stiffness = random.normal(size=(24, 2, 2)) * 20
    torque = displacement @ (stiffness + stiffness.swapaxes(1, 2)) + velocity @ random.normal(size=(24, 2, 2))
    return np.asarray(residual_triangle(displacement, velocity, torque + error))


def sum_of_squares(triangle: Numbers, damping: Numbers, stiffness: Numbers) -> float:
    return float(((triangle @ np.vstack([damping.T, stiffness.T, -np.eye(2)])) ** 2).sum())


@every_damping
def test_optimum_is_that_of_a_convex_solver(damping: str) -> None:
    cvxpy = pytest.importorskip("cvxpy")
    kinds = {"free": {}, "symmetric": {"symmetric": True}, "positive definite": {"PSD": True}}
    triangles = indefinite_triangles()
    fit = fit_triangles(triangles[:, None], 40, damping=damping)
    assert fit.ok.all()
    assert 5 < fit.on_boundary.sum() < 24 or damping == "positive definite"
    for k, triangle in enumerate(triangles):
        size = np.abs(triangle[:, 4:]).max()
        theirs = cvxpy.Variable((2, 2), PSD=True), cvxpy.Variable((2, 2), **kinds[damping])
        left = triangle[:, :2] @ theirs[1].T + triangle[:, 2:4] @ theirs[0] - triangle[:, 4:] / size
        tight = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-13)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # it cannot be sure of so many digits
            cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares(left))).solve(solver="CLARABEL", **tight)
        stiffness, damped = (size * one.value for one in theirs)
        ours = sum_of_squares(triangle, np.asarray(fit.D[k]), np.asarray(fit.K[k]))
        assert ours <= sum_of_squares(triangle, damped, stiffness) * (1 + 1e-11)
        # The sum of squares is flat there: its solver ends anywhere within some 3e-6 of the size, ours does not.
        np.testing.assert_allclose(fit.K[k], stiffness, atol=1e-5 * size)
        np.testing.assert_allclose(fit.D[k], damped, atol=1e-5 * size)


@pytest.mark.slow
def test_minimum_is_that_of_scipy_on_all_samples() -> None:
    displacement, velocity, torque = (x[0] for x in trials(1, 6))

    def residual(p: Numbers) -> Numbers:
        L = np.array([[p[4], 0], [p[5], p[6]]])
        return (velocity @ p[:4].reshape(2, 2).T + displacement @ (L @ L.T) - torque).ravel()

    found = least_squares(residual, [1, 0, 0, 1, 3, 0, 3], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    fit = jaximp.fit_stiffness(displacement, velocity, torque)
    np.testing.assert_allclose([*np.ravel(fit.D), *np.asarray(fit.L)[[0, 1, 1], [0, 0, 1]]], found.x, rtol=1e-6)
    np.testing.assert_allclose(fit.residual_rms, np.sqrt(2 * found.cost / torque.size), rtol=1e-10)
    assert fit.samples == torque.size // 2


@pytest.mark.slow
@pytest.mark.compiles
@every_damping
def test_exact_data_are_recovered(damping: str) -> None:
    displacement, velocity, torque = trials(2, 6, noise=0.0)
    if damping != "free":
        torque = torque - velocity @ (D - (D + D.T) / 2).T
    fit = fit_triangles(residual_triangle(displacement, velocity, torque), 40, damping=damping)
    np.testing.assert_allclose(fit.K[0], K, rtol=1e-9)
    np.testing.assert_allclose(fit.D[0], D if damping == "free" else (D + D.T) / 2, rtol=1e-9)
    np.testing.assert_allclose(fit.L[0] @ fit.L[0].T, K, rtol=1e-9)
    assert (np.diagonal(fit.L[0]) > 0).all()
    assert fit.L[0, 0, 1] == 0


def test_linear_fit_is_that_of_numpy_and_has_no_symmetry() -> None:
    lopsided = np.array([[29.0, 16.0], [12.0, 17.0]])
    displacement, velocity, torque = (x[0] for x in trials(1, 6, lopsided))
    fit = jaximp.perturbation.fit_stiffness_linear(displacement, velocity, torque)
    W = np.concatenate([velocity, displacement], axis=-1).reshape(-1, 4)
    expected = np.linalg.lstsq(W, torque.reshape(-1, 2))[0].T
    np.testing.assert_allclose(np.hstack([fit.D, fit.K]), expected, rtol=1e-9)
    np.testing.assert_allclose(fit.theta, expected[:, [0, 1]].ravel().tolist() + expected[:, [2, 3]].ravel().tolist())


@pytest.mark.slow
def test_merged_trials_are_all_data_together() -> None:
    arrays = [x[0] for x in trials(1, 6)]
    each = residual_triangle(*arrays)
    together = residual_triangle(*(x.reshape(-1, 2) for x in arrays))
    np.testing.assert_allclose(merge_triangles(each), together, rtol=1e-10, atol=1e-13)
    counts = np.array([True, True, True, True, False, True])
    spoilt = np.where(counts[:, None, None], each, np.nan)
    np.testing.assert_allclose(merge_triangles(spoilt, counts), merge_triangles(each[counts]), rtol=1e-10, atol=1e-13)
    fit, few = fit_triangles(spoilt, 40, counts=counts), fit_triangles(each[counts], 40)
    np.testing.assert_allclose(fit.theta, few.theta, rtol=1e-9)
    np.testing.assert_allclose(fit.covariance, few.covariance, rtol=1e-6, atol=1e-12)
    assert fit.samples == few.samples == 200


def test_samples_that_do_not_count_may_hold_anything() -> None:
    arrays = [x[0, 0] for x in trials(1, 6)]
    valid = np.arange(40) % 7 > 0
    spoilt = [np.where(valid[:, None], x, np.nan) for x in arrays]
    expected = residual_triangle(*(x[valid] for x in arrays))
    np.testing.assert_allclose(residual_triangle(*spoilt, valid), expected, rtol=1e-10, atol=1e-13)


def test_triangle_is_accurate_in_every_unit_and_for_columns_that_depend_on_each_other() -> None:
    random = np.random.default_rng(0)
    velocity, displacement, torque = random.normal(size=(3, 460, 2))
    velocity[:, 1] = 3 * velocity[:, 0]
    displacement *= 1e-9
    columns = np.hstack([velocity, displacement, torque])
    R = np.asarray(residual_triangle(displacement, velocity, torque))
    size = np.linalg.norm(columns, axis=0)
    np.testing.assert_allclose(R.T @ R / np.outer(size, size), columns.T @ columns / np.outer(size, size), atol=1e-13)
    assert (np.tril(R, -1) == 0).all()


@pytest.mark.slow
@pytest.mark.compiles
def test_indefinite_data_end_on_the_boundary() -> None:
    displacement, velocity, torque = trials(1, 6, np.array([[29.0, 0.0], [0.0, -5.0]]), noise=0.01)
    fit = jaximp.fit_stiffness(displacement[0], velocity[0], torque[0])
    assert fit.ok
    assert fit.on_boundary
    low, high = np.linalg.eigvalsh(np.asarray(fit.K))
    assert abs(low) < 1e-9 * high
    assert np.isfinite(fit.stderr).all()
    resisting = jaximp.fit_stiffness(displacement[0], velocity[0], torque[0] - 60 * displacement[0])
    assert resisting.ok
    np.testing.assert_allclose(resisting.K, 0, atol=1e-9)


@pytest.mark.slow
def test_a_failed_fit_is_named_and_harms_no_other() -> None:
    displacement, velocity, torque = trials(4, 6)
    displacement[1, ..., 1] = 2 * displacement[1, ..., 0]
    torque[2, 3, 5, 0] = np.nan
    triangles = residual_triangle(displacement, velocity, torque)
    samples = np.full((4, 6), 40)
    samples[3] = [3, 0, 0, 0, 0, 0]
    fit = fit_triangles(triangles, samples)
    assert fit.why().tolist() == ["", REASONS[3], REASONS[1], REASONS[2]]
    assert fit.ok.tolist() == [True, False, False, False]
    assert np.isnan(fit.K[1:]).all()
    assert np.isnan(fit.covariance[1:]).all()
    alone = fit_triangles(triangles[:1], samples[:1])
    np.testing.assert_allclose(fit.theta[0], alone.theta[0], rtol=1e-10)


@cache
def noisy() -> jax.Array:
    return residual_triangle(*trials(256, 8, seed=1))


@pytest.mark.slow
def test_standard_errors_are_those_of_trials() -> None:
    linear = fit_triangles_linear(noisy(), 40)
    for fit, truth in (
        (fit_triangles(noisy(), 40), [*D.ravel(), *K.ravel()[[0, 1, 3]]]),
        (linear, [*D.ravel(), *K.ravel()]),
    ):
        assert fit.ok.all()
        claimed = np.sqrt((fit.stderr**2).mean(axis=0)) / fit.theta.std(axis=0)
        assert (claimed > 0.9).all()
        assert (claimed < 1.3).all()
        inside = np.abs(fit.theta - np.array(truth)) < student.ppf(0.975, fit.dof)[:, None] * fit.stderr
        np.testing.assert_allclose(inside.mean(axis=0), 0.95, atol=0.05)
    # The textbook's, from independent residuals, claim a third of that.
    gram = np.einsum("mtia,mtib->mab", noisy()[..., :4], noisy()[..., :4])
    textbook = np.asarray(linear.residual_rms) * np.sqrt(np.linalg.inv(gram)[:, 2, 2])
    assert np.sqrt((textbook**2).mean()) / linear.theta[:, 4].std() < 0.5


def test_standard_errors_on_the_boundary_are_not_too_small() -> None:
    soft = np.array([[29.0, 0.0], [0.0, 0.0]])
    fit = fit_triangles(residual_triangle(*trials(256, 8, soft, seed=2)), 40)
    assert 0.2 < fit.on_boundary.mean() < 0.8
    claimed = np.sqrt((fit.stderr**2).mean(axis=0)) / fit.theta.std(axis=0)
    assert (claimed > 0.9).all()


@pytest.mark.slow
def test_covariance_is_what_leaving_out_trials_does() -> None:
    triangles = noisy()[0]
    whole = fit_triangles(triangles, 40).theta
    moves = fit_triangles(jnp.broadcast_to(triangles, (8, 8, 6, 6)), 40, counts=~np.eye(8, dtype=bool)).theta - whole
    np.testing.assert_allclose(fit_triangles(triangles, 40).covariance, 7 / 8 * moves.T @ moves, rtol=1e-6, atol=1e-10)
    assert np.isnan(fit_triangles(triangles[:4], 40).covariance).all()


@pytest.mark.slow
def test_derivatives_are_differences_inside_and_on_the_boundary() -> None:
    triangles = jnp.asarray(indefinite_triangles())[:, None]
    boundary = np.asarray(fit_triangles(triangles, 40).on_boundary)
    assert boundary.any()
    assert not boundary.all()
    along = jnp.triu(jnp.asarray(np.random.default_rng(0).normal(size=(6, 6))))

    def stiffness(step: float | jax.Array) -> jax.Array:
        return fit_triangles(triangles + step * along, 40).K

    _, slope = jax.jvp(stiffness, (0.0,), (1.0,))
    np.testing.assert_allclose(slope, (stiffness(1e-5) - stiffness(-1e-5)) / 2e-5, rtol=1e-5, atol=1e-5)


@pytest.mark.usefixtures("unchecked")
def test_wrong_input_is_refused() -> None:
    x = np.ones((5, 2))
    with pytest.raises(ValueError, match=r"shapes \(5, 2\), \(4, 2\) and \(5, 2\)"):
        jaximp.fit_stiffness(x, x[:4], x)
    with pytest.raises(ValueError, match="must be"):
        jaximp.fit_stiffness(x[:, :1], x[:, :1], x[:, :1])
    with pytest.raises(ValueError, match="valid has the shape"):
        jaximp.fit_stiffness(x, x, x, valid=np.ones(4, bool))
    with pytest.raises(ValueError, match="'symmetric', 'positive definite'"):
        jaximp.fit_stiffness(x, x, x, damping="viscous")
