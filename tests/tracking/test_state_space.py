"""The passes over a record against the joint normal distribution of everything, written out."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal

from jaximp.tracking.blocks import compress, merged
from jaximp.tracking.causal import filtered
from jaximp.tracking.state_space import (
    PRIOR,
    Evidence,
    Motion,
    evidence,
    forward,
    shocks,
    smoother,
)

Numbers = NDArray[np.float64]

POINTS, P, MEMORY = 12, 2, 7.0


class Dense(NamedTuple):
    """Path (G p) and torque (N,) by what is random in them: numbers u of variance one."""

    A: Numbers
    """(G p, u) the path."""
    H: Numbers
    """(N, G p) torque from the path."""

    def given(self, y: Numbers, rows: int) -> tuple[Numbers, Numbers]:
        """Mean and covariance of the path, from the first rows."""
        B = self.H[:rows] @ self.A
        inverse = np.linalg.inv(np.eye(B.shape[1]) + B.T @ B)
        return self.A @ inverse @ B.T @ y[:rows], self.A @ inverse @ self.A.T

    def log_likelihood(self, y: Numbers) -> float:
        B = self.H @ self.A
        return float(multivariate_normal.logpdf(y, np.zeros(len(y)), B @ B.T + np.eye(len(y))))


def dense(
    W: Numbers, walk: Numbers, slope: Numbers, jumps: list[tuple[int, int]], order: int = 0, left: float = 1.0
) -> Dense:
    """Every random number is followed through the record."""
    p, d = P, (order + 1) * P
    F, variance = np.eye(d), np.zeros((POINTS + 1, d))
    variance[0, d - p :], variance[1:, d - p :] = PRIOR**2, walk
    if order:
        F[: d - p, : d - p] *= left
        F[d - p :, d - 2 * p : d - p] = np.diag(slope)
        F[p : d - p, : d - 2 * p] += np.eye(d - 2 * p)
        variance[0, : d - p] = np.repeat(MEMORY ** (2 * np.arange(order) + 1), p)
        variance[1:, :p] = 1
    for k, i in jumps:
        variance[k + 1, d - p + i] += 1
    A = np.zeros((POINTS, p, POINTS + 1, d))
    for source in range(POINTS + 1):
        state = np.diag(np.sqrt(variance[source]))
        for k in range(max(source - 1, 0), POINTS):
            state = F @ state if k >= source else state
            A[k, :, source] = state[d - p :]
    each = len(W) // POINTS
    H = np.zeros((len(W), POINTS * p))
    for n, w in enumerate(W):
        H[n, n // each * p : (n // each + 1) * p] = w
    return Dense(A.reshape(POINTS * p, -1), H)


NONE = np.zeros(2)
KINDS: dict[str, tuple[Any, ...]] = {
    "walk": (np.array([0.3, 0.01]), NONE, [], 0),
    "one stays": (np.array([0.3, 0.0]), NONE, [], 0),
    "all stay": (NONE, NONE, [], 0),
    "jumps": (np.array([0.01, 0.0]), NONE, [(4, 0), (9, 1)], 0),
    "smooth": (NONE, np.array([0.2, 0.01]), [], 1),
    "smooth with a jump": (NONE, np.array([0.2, 0.0]), [(5, 0)], 1),
    "smoother": (NONE, np.array([0.02, 0.001]), [(7, 1)], 2),
    "slopes die away": (NONE, np.array([0.2, 0.01]), [], 1, 0.7),
    "smoother, and slopes die away": (NONE, np.array([0.2, 0.0]), [(5, 1)], 2, 0.8),
}


def rows(kind: str, each: int = 3) -> tuple[Numbers, Numbers]:
    random = np.random.default_rng(3)
    W, y = random.normal(size=(POINTS * each, P)), 2 * random.normal(size=POINTS * each)
    if kind == "rest":
        W[9:24] = 0
    if kind == "collinear":
        W[:, 1] = 3 * W[:, 0]
    return W, y


def motion(
    walk: Numbers, slope: Numbers, jumps: list[tuple[int, int]], order: int = 0, left: float | None = None
) -> Motion:
    """Of two lanes: this model, and another one that must not disturb it."""
    at, which = np.full((3, 2), -1), np.zeros((3, 2), int)
    for j, (k, i) in enumerate(jumps):
        at[j, 0], which[j, 0] = k, i
    both = (jnp.asarray(np.stack([x, x + 1], axis=1)) for x in (walk, slope))
    fading = None if left is None else jnp.full((2, 2), left)
    return Motion(*both, jnp.full((2, 2), MEMORY), jnp.asarray(at), jnp.asarray(which), order, fading)


@jax.jit
def passes(rows: jax.Array, moving: Motion) -> tuple[Evidence, jax.Array, jax.Array, jax.Array]:
    """Evidence, and of every point mean, covariance and the odds of jumps before it."""
    found, before = forward(rows, moving)
    theta, covariance = smoother(rows, moving, before)
    return found, theta, covariance, shocks(rows, moving, before).log_odds(jnp.ones(2))


@pytest.mark.parametrize("data", ["plain", "rest", "collinear"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("each", [1, 3], ids=["rows", "triangles"])
def test_passes_are_those_of_the_joint_distribution(kind: str, data: str, each: int) -> None:
    W, y = rows(data, each)
    oracle, blocks, moving = dense(W, *KINDS[kind]), compress(W, y, np.ones(len(y)), each), motion(*KINDS[kind])
    found, theta, spread, _ = passes(blocks.rows, moving)
    log_likelihood = found.log_determinant - (found.squares + blocks.left) / 2 - len(y) / 2 * np.log(2 * np.pi)
    np.testing.assert_allclose(log_likelihood[0], oracle.log_likelihood(y), rtol=1e-9)
    mean, covariance = oracle.given(y, len(y))
    np.testing.assert_allclose(theta[..., 0].ravel(), mean, rtol=1e-6, atol=1e-7)
    here = np.asarray(spread)[..., 0]
    wanted = np.stack([covariance[k * P : (k + 1) * P, k * P : (k + 1) * P] for k in range(POINTS)])
    np.testing.assert_allclose(here, wanted, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("kind", ["walk", "smooth"])
def test_the_filter_knows_what_came_before(kind: str) -> None:
    W, y = rows("rest")
    oracle, blocks = dense(W, *KINDS[kind]), compress(W, y, np.ones(len(y)), 3)
    theta, covariance = filtered(
        blocks.rows, motion(*KINDS[kind]), jnp.ones(2), jnp.zeros(()), jnp.zeros(0, bool), every=1
    )
    for k in range(POINTS):
        mean, spread = oracle.given(y, 3 * (k + 1))
        own = slice(k * P, (k + 1) * P)
        np.testing.assert_allclose(theta[k, :, 0], mean[own], rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(covariance[k, ..., 0], spread[own, own], rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_odds_of_a_jump_are_ratios_of_likelihoods(kind: str) -> None:
    W, y = rows("plain")
    walk, slope, jumps, *kind_of_motion = KINDS[kind]
    blocks, moving = compress(W, y, np.ones(len(y)), 3), motion(*KINDS[kind])
    odds = passes(blocks.rows, moving)[-1]
    without = dense(W, *KINDS[kind]).log_likelihood(y)
    for k in range(1, POINTS):
        for i in range(P):
            wanted = dense(W, walk, slope, [*jumps, (k, i)], *kind_of_motion).log_likelihood(y) - without
            np.testing.assert_allclose(odds[k, i, 0], wanted, rtol=1e-6, atol=1e-8)


def test_bank_of_filters_is_the_mixture_over_times_of_a_jump() -> None:
    """As long as there are more filters than splits, and only the first is ever the most probable before the jump."""
    W, _ = rows("plain")
    y = W @ np.array([1.0, -1.0]) + 0.01 * np.random.default_rng(0).normal(size=len(W))
    y[18:] += 3 * W[18:, 0]
    blocks, log_jump = compress(W, y, np.ones(len(y)), 3), np.log(1e-3)
    walk = np.full(2, 1e-9)
    theta, _ = filtered(
        blocks.rows * 100, motion(walk, NONE, []), jnp.ones(2), jnp.asarray(log_jump), jnp.array([True, False]), every=1
    )
    np.testing.assert_allclose(theta[5, :, 0], [1.0, -1.0], atol=0.02)
    np.testing.assert_allclose(theta[7:, :, 0], np.tile([4.0, -1.0], (POINTS - 7, 1)), atol=0.03)
    single, _ = filtered(
        blocks.rows * 100, motion(walk, NONE, []), jnp.ones(2), jnp.zeros(()), jnp.zeros(0, bool), every=1
    )
    assert abs(single[7, 0, 0] - 4) > 1


def test_compressed_and_merged_blocks_say_the_same() -> None:
    """Of parameters that stay."""
    W, y = rows("plain")

    def said(each: int, together: int) -> float:
        blocks = merged(compress(W, y, np.ones(len(y)), each), together)
        found = evidence(blocks.rows, motion(NONE, NONE, []))
        return float(found.log_likelihood(blocks.left, blocks.freedom(P))[0])

    wanted = said(36, 1)
    for each, together in ((1, 4), (5, 4)):
        np.testing.assert_allclose(said(each, together), wanted, rtol=1e-9)
