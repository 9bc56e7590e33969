"""Least squares in which symmetric matrices of two by two must be positive semidefinite, by Levenberg and Marquardt.

Small enough to be done by the thousand: written for one problem without LAPACK, and `vmap`ped where it is used.

Symmetric matrices are vectors `(k11, k12, k22)` here.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jaximp.numerics.linear_algebra import back_substitute, triangle

ROUNDS, STEPS = 2, 20
"""Multipliers are renewed so many times, with at most so many steps of the minimiser for each."""
TOLERANCE = 1e-12
"""Of the minimiser, in scaled units."""
OPTIMAL = 1e-9
"""Up to which the conditions of an optimum must hold, as a share of the squared right-hand side."""
LIFT = 0.05
"""What the start's eigenvalues are raised by, as a share of the largest: where a factor's column is zero it has no
slope, wherever the minimum is."""
SINGULAR = 1e-8
"""A matrix is singular whose smallest eigenvalue is this share of what was the largest without the constraint."""
TIMES = np.array([1.0, 2.0, 1.0])
"""How often each number stands in the matrix."""


def eigenvalues(k: Float[Array, "*b 3"]) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Smaller and larger eigenvalue of symmetric matrices."""
    mean, square = (k[..., 0] + k[..., 2]) / 2, ((k[..., 0] - k[..., 2]) / 2) ** 2 + k[..., 1] ** 2
    radius = jnp.sqrt(jnp.where(square > 0, square, 1)) * (square > 0)
    return mean - radius, mean + radius


class Semidefinite(eqx.Module):
    """Where `semidefinite_least_squares` ended: b matrices K = L L'."""

    k: Float[Array, "b 3"]
    """K, as vectors."""
    L: Float[Array, "b 2 2"]
    """Lower triangles with a diagonal of at least zero."""
    singular: Bool[Array, " b"]
    """Whether the constraint holds K, which lacks a direction."""
    optimal: Bool[Array, ""]
    """Whether the conditions of an optimum hold, which are sufficient: the problem is convex."""


def semidefinite_least_squares(C: Float[Array, "n n"], right: Float[Array, " n"]) -> Semidefinite:
    """Minimise `|C k - right|` over b = n/3 positive semidefinite matrices, one after another in `k`.

    Levenberg and Marquardt's method moves factors F of K = F F', whose diagonal is free so that a singular K can be
    reached. But there the slope along F's second column vanishes, and with it the method's model of the curvature,
    unless the residual holds the constraint's multiplier, a matrix G >= 0. With `G = V V'` and `C' w = G`, the squares
    of `C k - right - w` and of `sqrt(2) V' F` have the sum of before, up to a constant, whatever G is; if it is the
    slope at the optimum, as the conditions of Karush, Kuhn and Tucker have it, both vanish there and convergence is
    quadratic. So G is the slope where the last round ended, made positive semidefinite.

    **Arguments:** `C` an upper triangle without a zero on its diagonal.
    """
    # Joint by joint a unit with which columns have length one, so that K = unit k unit, and one for the right-hand side
    unit = 1 / jnp.sqrt(jnp.sqrt((C**2).sum(axis=0)).reshape(-1, 3)[:, ::2])
    size = jnp.sqrt((right**2).sum())
    size = jnp.where(size > 0, size, 1)
    scale = jnp.stack([unit[:, 0] ** 2, unit[:, 0] * unit[:, 1], unit[:, 1] ** 2], axis=1)
    C, right = C * scale.reshape(-1), right / size

    unconstrained = back_substitute(C, right).reshape(-1, 3)
    largest = jnp.abs(jnp.stack(eigenvalues(unconstrained))).max(axis=0)

    def renew(k: Array, _: None) -> tuple[Array, Array]:
        k = jax.lax.stop_gradient(k)
        multiplier = jax.lax.stop_gradient(_raised(_slope(C, right, k)))
        F = _factors_at_minimum(C, right, _raised(k, LIFT * largest), multiplier)
        return _squared(F), F

    k, rounds = jax.lax.scan(renew, _raised(unconstrained), None, length=ROUNDS)
    slope = _slope(C, right, k)
    return Semidefinite(
        k=k * scale * size,
        L=_lower(rounds[-1]) * unit[:, :, None] * jnp.sqrt(size),
        singular=eigenvalues(k)[0] <= SINGULAR * largest,
        optimal=(eigenvalues(slope)[0] > -OPTIMAL).all() & (jnp.abs((slope * k * TIMES).sum()) < OPTIMAL),
    )


class _GramSchmidt(lx.AbstractLinearSolver):
    """Least squares solutions for lineax by `triangle`, for a full rank."""

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> lx.AbstractLinearOperator:
        return operator

    def compute(
        self, state: lx.AbstractLinearOperator, vector: Any, options: dict[str, Any]
    ) -> tuple[Any, lx.RESULTS, dict[str, Any]]:
        right, _ = jax.flatten_util.ravel_pytree(vector)
        R = triangle(jnp.concatenate([state.as_matrix().T, right[None]]))
        solution = back_substitute(R[:-1, :-1], R[:-1, -1])
        _, shaped = jax.flatten_util.ravel_pytree(jax.tree.map(jnp.zeros_like, state.in_structure()))
        return shaped(solution), lx.RESULTS.successful, {}

    def transpose(self, state: lx.AbstractLinearOperator, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return state.T, options

    def conj(self, state: lx.AbstractLinearOperator, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return state, options

    def assume_full_rank(self) -> bool:
        return True


def _factors_at_minimum(C: Array, right: Array, start: Array, multiplier: Array) -> Array:
    """(b, 2, 2) factors for these multipliers, from those of the positive definite matrices `start`."""
    w = back_substitute(C.T[::-1, ::-1], (multiplier * TIMES).reshape(-1)[::-1])[::-1]
    unswapped = jnp.zeros(len(start), bool)
    V = jnp.sqrt(2) * _arranged(_numbers(multiplier, unswapped), unswapped)
    # The larger diagonal element comes first: else the first column could vanish where the second does not.
    swapped = start[:, 2] > start[:, 0]

    def residual(numbers: Array, given: tuple[Array, ...]) -> Array:
        C, right, V, swapped = given
        F = _arranged(numbers, swapped)
        along = (V[:, :, :, None] * F[:, :, None, :]).sum(axis=1)
        return jnp.concatenate([(C * _squared(F).reshape(-1)).sum(axis=1) - right, along.reshape(-1)])

    gram_schmidt = _GramSchmidt()
    minimiser = eqx.tree_at(
        lambda method: method.search,
        optx.LevenbergMarquardt(TOLERANCE, TOLERANCE, linear_solver=gram_schmidt),
        optx.ClassicalTrustRegion(low_cutoff=0.25, high_cutoff=0.75),  # fewer steps than with the cutoffs it comes with
    )
    found: optx.Solution[Array, None] = optx.least_squares(
        residual,
        minimiser,
        _numbers(start, swapped),
        (C, right + w, V, swapped),
        adjoint=optx.ImplicitAdjoint(linear_solver=gram_schmidt),
        max_steps=STEPS,
        throw=False,
    )
    return _arranged(found.value, swapped)


def _slope(C: Array, right: Array, k: Array) -> Array:
    """(b, 3) slope of half the sum of squares along every element of K, as symmetric matrices."""
    residual = (C * k.reshape(-1)).sum(axis=1) - right
    return (C * residual[:, None]).sum(axis=0).reshape(-1, 3) / TIMES


def _raised(k: Array, lift: Array | float = 0.0) -> Array:
    """Symmetric matrices without their negative eigenvalues, and then all eigenvalues raised by `lift`."""
    low, high = eigenvalues(k)
    new_low, new_high = jnp.maximum(low, 0) + lift, jnp.maximum(high, 0) + lift
    apart = jnp.where(high > low, (new_high - new_low) / jnp.where(high > low, high - low, 1), 0)
    return apart[:, None] * k + (new_low - apart * low)[:, None] * jnp.array([1.0, 0.0, 1.0])


def _numbers(k: Array, swapped: Array) -> Array:
    """(b, 3) the numbers of triangular factors, row by row; where `swapped`, of the matrix with its rows exchanged."""
    k = jnp.where(swapped[:, None], k[:, ::-1], k)
    first = jnp.sqrt(jnp.maximum(k[:, 0], 0))
    below = k[:, 1] / jnp.where(first > 0, first, 1)
    return jnp.stack([first, below, jnp.sqrt(jnp.maximum(k[:, 2] - below**2, 0))], axis=1)


def _arranged(numbers: Array, swapped: Array) -> Array:
    """(b, 2, 2) factors from their numbers."""
    first, below, second = numbers[:, 0], numbers[:, 1], numbers[:, 2]
    upper_row = jnp.stack([first, jnp.zeros_like(first)], axis=1)
    F = jnp.stack([upper_row, jnp.stack([below, second], axis=1)], axis=1)
    return jnp.where(swapped[:, None, None], F[:, ::-1], F)


def _squared(F: Array) -> Array:
    """(b, 3) elements of F F'."""
    first, second = F[:, 0], F[:, 1]
    return jnp.stack([(first**2).sum(axis=1), (first * second).sum(axis=1), (second**2).sum(axis=1)], axis=1)


def _lower(F: Array) -> Array:
    """Lower triangular L with L L' = F F' and a diagonal of at least zero: F, turned about."""
    first, second = F[:, 0], F[:, 1]
    square = (first**2).sum(axis=1)
    length = jnp.sqrt(jnp.where(square > 0, square, 1))
    below = (first * second).sum(axis=1) / length
    across = jnp.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / length
    alone = (second**2).sum(axis=1)
    across = jnp.where(square > 0, across, jnp.sqrt(jnp.where(alone > 0, alone, 1)) * (alone > 0))
    diagonal = length * (square > 0), across
    upper_row = jnp.stack([diagonal[0], jnp.zeros_like(length)], axis=1)
    return jnp.stack([upper_row, jnp.stack([below * (square > 0), diagonal[1]], axis=1)], axis=1)
