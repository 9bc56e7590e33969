"""Designs the two excitation trajectories that `jaximp.simulation.rig` stores as tables, and prints them.

Tout et al. 2023, III-A: a finite Fourier series whose coefficients minimise the condition number of an observation
matrix over one period, while the handle stays within 0.7 rad. For the simulation (IV) that is the robot's, eq. (18);
for the rubber bands (V) the human's, eq. (19), whose condition number does not depend on the amplitude: the motion is
then scaled to the handle's range. Gradient descent from many random starts; sign(dq) is smoothed for the gradient
only, the printed condition numbers use the sign itself.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from jaximp.motion import FourierSeries

jax.config.update("jax_enable_x64", True)

GEAR_RATIO, GRAVITY = 15.0, 9.81
LIMIT = 0.7 * GEAR_RATIO
PERIOD = 10.0

Sign = Callable[[jax.Array], jax.Array]
Columns = Callable[[FourierSeries, jax.Array, Sign], list[jax.Array]]


def series(x: jax.Array | np.ndarray, order: int) -> FourierSeries:
    """The design vector is (offset, sine coefficients, cosine coefficients)."""
    return FourierSeries(sine=x[1 : order + 1], cosine=x[order + 1 :], offset=x[0], period=PERIOD)


def robot_columns(trajectory: FourierSeries, t: jax.Array, sign: Sign) -> list[jax.Array]:
    q, dq, ddq = trajectory(t)
    return [GRAVITY * jnp.sin(q / GEAR_RATIO), GRAVITY * jnp.cos(q / GEAR_RATIO), dq, sign(dq), ddq]


def human_columns(trajectory: FourierSeries, t: jax.Array, sign: Sign) -> list[jax.Array]:
    q, dq, ddq = trajectory(t)
    return [ddq, dq, q]


def log_condition(columns: Columns, trajectory: FourierSeries, t: jax.Array, sign: Sign) -> jax.Array:
    """Log condition number of the observation matrix; half that of its small Gram matrix, much cheaper than an SVD."""
    W = jnp.stack(columns(trajectory, t, sign), axis=1)
    eigenvalues = jnp.linalg.eigvalsh(W.T @ W)
    return 0.5 * jnp.log(eigenvalues[-1] / eigenvalues[0])


def design(columns: Columns, order: int, starts: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Best design vector, rounded as printed, and the condition number that each start reached."""
    t = jnp.arange(400) * (PERIOD / 400)

    @jax.jit
    @jax.value_and_grad
    def cost(x: jax.Array) -> jax.Array:
        trajectory = series(x, order)
        excess = jnp.maximum(jnp.abs(trajectory(t)[0]) - 0.999 * LIMIT, 0.0)
        smooth = log_condition(columns, trajectory, t, lambda dq: jnp.tanh(dq / 0.3))
        return smooth + 10 * jnp.sum(excess**2)

    rng = np.random.default_rng(seed)
    found = []
    for _ in range(starts):
        x0 = np.concatenate([rng.normal(0.0, 2.0, 1), rng.normal(0.0, 4.0, 2 * order)])
        x = minimize(cost, x0, jac=True, method="L-BFGS-B", options={"maxiter": 2000, "maxfun": 3000}).x
        if columns is human_columns:
            x *= 0.999 * LIMIT / float(jnp.max(jnp.abs(series(x, order)(t)[0])))
        found.append(np.round(x, 5))
    raw = np.array([condition(columns, series(x, order)) for x in found])
    return found[int(np.argmin(raw))], raw


def condition(columns: Columns, trajectory: FourierSeries) -> float:
    """Condition number over one period at 1 kHz, with the true sign; infinite if the handle leaves its range."""
    t = jnp.arange(10_000) * (PERIOD / 10_000)
    within = jnp.max(jnp.abs(trajectory(t)[0])) <= LIMIT
    return float(jnp.where(within, jnp.exp(log_condition(columns, trajectory, t, jnp.sign)), jnp.inf))


if __name__ == "__main__":
    for name, columns, order in (("ROBOT_TRAJECTORY", robot_columns, 5), ("HUMAN_TRAJECTORY", human_columns, 7)):
        best, reached = design(columns, order, starts=100, seed=0)
        at_best = condition(columns, series(best, order))
        print(f"{name}: condition {at_best:.3f}, median {np.median(reached):.3f} of 100 starts")
        print(f"    offset={best[0]}\n    sine={best[1 : order + 1].tolist()}\n    cosine={best[order + 1 :].tolist()}")
