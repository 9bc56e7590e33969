"""The robot nearest to an estimate, by Newton's method on a barrier: plain numpy, in milliseconds."""

from __future__ import annotations

import numpy as np

from jaximp.consistency.cone import BASIS, Cone, Posed
from jaximp.types import Numbers

WEAK = 1e-3
"""What a link costs that differs from the URDF's by its own size, in squared standard errors."""
CLOSE = 1e-2
"""Relative gap of the squared distance at which the search ends; squared standard errors where that is more."""
STEEPER = 8.0
"""By what factor the weight of the distance grows from one barrier to the next."""
SETTLED = 1e-6
"""Newton's decrement, squared and halved, of a barrier that is minimised."""
MOST_STEPS = 400


def distance_to_robots(posed: Posed) -> float:
    """How far the nearest robot is from an estimate, in its standard errors: every link a real body, no rotor's
    inertia and no friction below zero. Zero if the estimate is that of a robot.

    `consistent_fit` finds the robot as well, to more digits, and with limits of its mass.

    **Source:** Boyd and Vandenberghe 2004, section 11.3 (barrier method), with the logarithm of the determinant of each
    link's pseudo-inertia (Wensing, Kim and Slotine 2018).
    """
    k, inverse = posed.known, np.linalg.inv(posed.map)
    weights = np.where(np.arange(len(inverse)) < k, 1.0, WEAK)
    H = (inverse.T * weights) @ inverse
    x, weight = posed.cone.positive.astype(float), 1.0
    barriers = 4.0 * posed.cone.n_bodies + posed.cone.positive.sum()
    steps = 0
    while True:
        x, taken = _minimised(posed.cone, H, posed.start, x, weight, MOST_STEPS - steps)
        steps += taken
        squared = float((inverse[:k] @ (x - posed.start)) @ (inverse[:k] @ (x - posed.start)))
        gap = 2 * barriers / weight
        if gap <= CLOSE * max(squared, 1.0) or steps >= MOST_STEPS:
            return float(np.sqrt(max(squared - gap, 0.0)))
        weight *= STEEPER


def _minimised(cone: Cone, H: Numbers, start: Numbers, x: Numbers, weight: float, most: int) -> tuple[Numbers, int]:
    """The minimum of `weight (x - start)' H (x - start) / 2 + barrier`, from an x inside of the cone."""
    for step in range(most):
        value, slope, curvature = _barrier(cone, x)
        slope, curvature = slope + weight * H @ (x - start), curvature + weight * H
        towards = -np.linalg.solve(curvature, slope)
        decrement = float(-slope @ towards)
        if decrement / 2 <= SETTLED:
            return x, step + 1
        value += float(weight * (x - start) @ H @ (x - start) / 2)
        length = 1.0
        while True:
            tried = x + length * towards
            found = _barrier_value(cone, tried) + float(weight * (tried - start) @ H @ (tried - start) / 2)
            if found <= value - 0.1 * length * decrement or length < 1e-10:
                break
            length /= 2
        if length < 1e-10:
            return x, step + 1
        x = tried
    return x, most


def _links(cone: Cone, x: Numbers) -> Numbers:
    """(n_b, 4, 4) each link's pseudo-inertia, in its natural size."""
    return np.eye(4) + np.tensordot(x[: 10 * cone.n_bodies].reshape(-1, 10), BASIS, 1)


def _of_joints(cone: Cone, x: Numbers) -> Numbers:
    """What rotors and friction are above zero, in natural sizes."""
    return x[cone.positive] + cone.reference[cone.positive] / np.diag(cone.scale)[cone.positive]


def _barrier_value(cone: Cone, x: Numbers) -> float:
    """Infinite outside of the cone."""
    of_joints = _of_joints(cone, x)
    if (of_joints <= 0).any():
        return np.inf
    try:
        roots = np.linalg.cholesky(_links(cone, x))
    except np.linalg.LinAlgError:
        return np.inf
    return float(-2 * np.log(np.diagonal(roots, axis1=1, axis2=2)).sum() - np.log(of_joints).sum())


def _barrier(cone: Cone, x: Numbers) -> tuple[float, Numbers, Numbers]:
    """Value, slope and curvature."""
    slope, curvature = np.zeros(len(x)), np.zeros((len(x), len(x)))
    of_joints, at = _of_joints(cone, x), np.flatnonzero(cone.positive)
    slope[at], curvature[at, at] = -1 / of_joints, of_joints**-2.0
    inverse = np.linalg.inv(_links(cone, x))
    sides = np.einsum("nij,kjl->nkil", inverse, BASIS)
    slope[: 10 * cone.n_bodies] = -np.trace(sides, axis1=2, axis2=3).ravel()
    blocks = np.einsum("nkij,nlji->nkl", sides, sides)
    for k, block in enumerate(blocks):
        curvature[10 * k : 10 * k + 10, 10 * k : 10 * k + 10] = block
    return _barrier_value(cone, x), slope, curvature
