"""How good can an excitation be? Lower bounds on the condition number of a period, for motions without any limits.

The Gram matrix of a model that is linear in position, velocity and acceleration is linear in the power spectrum of the
motion. Its condition number is then bounded by a small convex program, and for the human joint in closed form.
"""

from __future__ import annotations

import math
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaximp.models.base import Joints, Model
from jaximp.models.joint import HumanJoint

UNKNOWN = "no bound is known for a model that is not linear in position, velocity and acceleration"


def condition_bound(model: Model, harmonics: int, period: float) -> tuple[float, str]:
    """No motion of so many harmonics has a smaller condition number over its period [s].

    **Returns:** the bound, NaN where none is known, and where it comes from or why there is none.
    """
    if type(model) is HumanJoint:
        # [[S4, 0, -S2], [0, S2, 0], [-S2, 0, S0]] with S0 S4 >= S2^2; the offset's column adds an eigenvalue.
        return math.sqrt(3.0), "closed form: the condition number of [ddq, dq, q] is at least the root of 3"
    parts = [_linear_part(one) for one in (model.models if isinstance(model, Joints) else (model,))]
    if model.n_joints > 1 and not isinstance(model, Joints):
        return math.nan, "no bound is known for joints that share parameters"
    if any(part is None for part in parts):
        return math.nan, UNKNOWN
    if find_spec("cvxpy") is None:
        return math.nan, "the bound is a convex program: pip install 'jaximp[bounds]'"
    return _convex_bound([part for part in parts if part is not None], harmonics, period), "convex program"


def _linear_part(model: Model) -> NDArray[np.float64] | None:
    """(p, 4) coefficients of ddq, dq, q and 1 in every column, or None where a column is not made of them."""
    if model.n_joints != 1 or model.sample_rate is not None:
        return None

    def row(z: Any) -> Any:
        return model.row(z[2], z[1], z[0])

    points = jnp.asarray(np.random.default_rng(0).normal(size=(8, 3)))
    slope = np.asarray(jax.jacobian(row)(points[0]))
    constant = np.asarray(row(points[0])) - slope @ np.asarray(points[0])
    expected = np.asarray(points) @ slope.T + constant
    if not np.allclose(jax.vmap(row)(points), expected, rtol=1e-9, atol=1e-9):
        return None
    return np.concatenate([slope, constant[:, None]], axis=1)


def _convex_bound(parts: list[NDArray[np.float64]], harmonics: int, period: float) -> float:
    """Least t with `I <= G <= t I` over all power spectra; every joint has a spectrum of its own.

    A mean position is one more variable; that its square belongs to it is relaxed to an inequality.
    """
    import cvxpy as cp

    w = 2 * np.pi / period * np.arange(1, harmonics + 1)
    most, length = cp.Variable(), cp.Variable(nonneg=True)
    constraints = []
    for part in parts:
        power, mean, square = cp.Variable(harmonics, nonneg=True), cp.Variable(), cp.Variable()
        S0, S2, S4 = cp.sum(power), w**2 @ power, w**4 @ power
        moments = cp.bmat([[S4, 0, -S2, 0], [0, S2, 0, 0], [-S2, 0, S0 + square, mean], [0, 0, mean, length]])
        gram = part @ moments @ part.T
        identity = np.eye(len(part))
        constraints += [
            gram >> identity,
            gram << most * identity,
            cp.bmat([[square, mean], [mean, length]]) >> 0,
        ]
    problem = cp.Problem(cp.Minimize(most), constraints)
    problem.solve(solver=cp.CLARABEL)
    return math.sqrt(max(1.0, float(problem.value))) if problem.status == "optimal" else math.nan
