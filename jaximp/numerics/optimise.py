"""One face for the optimisers: many starts at a time, minimised in one compiled call.

optimistix is the rule. jaxopt, which is no longer maintained, adds two ways that it lacks; nothing else imports it.
One way is driven from Python: it compiles the objective once, where the others have several copies of it in one
program, which a robot's regressor makes minutes of. Which of them is the default for what was measured:
experiments/benchmarks/excitation.py and chain_excitation.py.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from jaximp.types import Numbers

Objective = Callable[[Array], Array]
Projection = Callable[[Array], Array]

METHODS = {
    "bfgs": "optimistix BFGS",
    "conjugate_gradient": "optimistix nonlinear conjugate gradient",
    "lbfgsb": "jaxopt bounded limited-memory BFGS",
    "projected_gradient": "jaxopt projected gradient; the projection solves a quadratic program",
    "python": "BFGS driven from Python",
}

ENOUGH = 1e-4
"""A step must lower the value by such a share of what the slope promises."""
STEEP = 0.9
"""A step is too short where the value still falls by more than this share of the slope at its beginning."""
SHORTEST = 1e-10
"""Steps that are cut shorter lead nowhere."""


class Found(NamedTuple):
    """The minimum that each start has led to."""

    x: Float[Array, "m d"]
    value: Float[Array, " m"]
    steps: Int[Array, " m"]


def minimise(
    objective: Objective,
    starts: Float[Array, "m d"],
    method: str = "bfgs",
    max_steps: int = 500,
    tolerance: float = 1e-9,
    bound: float = jnp.inf,
    project: Projection | None = None,
) -> Found:
    """Follow the objective down from every start. Steps that do not converge end after `max_steps`, where they are.

    **Arguments:** `objective` (d,) -> (); `starts` (m, d); `method` one of `METHODS`; `bound` on the size of every
    number, which `lbfgsb` keeps; `project` (d,) -> (d,) onto a convex set, which `projected_gradient` needs.

    **Raises:** `ValueError` for a method that does not exist, or lacks its projection.
    """
    if method not in METHODS:
        raise ValueError(f"method is '{method}': there are {', '.join(METHODS)}")
    if method == "python":
        return descend_from_python(jax.jit(jax.value_and_grad(objective)), starts, max_steps, tolerance)
    if method in ("bfgs", "conjugate_gradient"):
        one = partial(_optimistix, objective, method, max_steps, tolerance)
    else:
        one = partial(_jaxopt, objective, method, max_steps, tolerance, bound, project)
    return jax.vmap(one)(starts)


def _optimistix(objective: Objective, method: str, max_steps: int, tolerance: float, start: Array) -> Found:
    solvers: dict[str, Callable[..., optx.AbstractMinimiser]] = {
        "bfgs": optx.BFGS,
        "conjugate_gradient": optx.NonlinearCG,
    }
    solver = solvers[method](rtol=tolerance, atol=tolerance)
    solution: optx.Solution[Array, None] = optx.minimise(
        lambda x, _: objective(x), solver, start, max_steps=max_steps, throw=False
    )
    return Found(solution.value, objective(solution.value), solution.stats["num_steps"])


def descend_from_python(
    value_and_slope: Callable[[Array], tuple[Array, Array]],
    starts: Float[Array, "m d"],
    max_steps: int = 500,
    tolerance: float = 1e-9,
) -> Found:
    """BFGS from one start after the other; `value_and_slope` is compiled already.

    It ends where a step lowers the value by less than the `tolerance`, or where none does. Starts do not run side by
    side: two compiled programs that decompose batches of matrices can wait for each other for ever.
    """

    def both(x: Numbers) -> tuple[float, Numbers]:
        value, slope = value_and_slope(jnp.asarray(x))
        return float(value), np.asarray(slope)

    found = [_bfgs(both, start, max_steps, tolerance) for start in np.asarray(starts)]
    x, values, steps = zip(*found, strict=True)
    return Found(jnp.asarray(np.array(x)), jnp.asarray(values), jnp.asarray(steps))


def _bfgs(
    both: Callable[[Numbers], tuple[float, Numbers]], x: Numbers, max_steps: int, tolerance: float
) -> tuple[Numbers, float, int]:
    """Nocedal and Wright 2006, algorithm 6.1, with steps that are cut until they lower the value enough.

    scipy's multiplies matrices at every step, for which threads wait for each other from a hundred numbers on. Sums of
    einsum, as here, are those of one thread.
    """
    value, slope = both(x)
    inverse: Numbers | None = None  # of the second derivatives
    for step in range(max_steps):
        if inverse is None:
            direction = -slope / max(1.0, float(np.linalg.norm(slope)))
        else:
            direction = -np.einsum("ij,j->i", inverse, slope)
        length, ahead, slope_ahead = _step(both, x, value, direction, float(slope @ direction))
        if length == 0:
            return x, value, step
        gone, change, gain = length * direction, slope_ahead - slope, value - ahead
        x, value, slope = x + gone, ahead, slope_ahead
        if gain < tolerance:
            return x, value, step + 1
        bend = float(gone @ change)
        if bend > 1e-10 * float(np.linalg.norm(gone) * np.linalg.norm(change)):
            if inverse is None:
                inverse = bend / float(change @ change) * np.eye(len(x))
            image = np.einsum("ij,j->i", inverse, change)
            mixed = np.multiply.outer(gone, image / bend)
            inverse += (1 + float(change @ image) / bend) / bend * np.multiply.outer(gone, gone) - mixed - mixed.T
    return x, value, max_steps


def _step(
    both: Callable[[Numbers], tuple[float, Numbers]], x: Numbers, value: float, direction: Numbers, along: float
) -> tuple[float, float, Numbers]:
    """How far to go, and value and slope there: cut until the value is low enough, or doubled while it falls steeply.

    Zero where no step lowers the value.
    """
    length = 1.0
    ahead, slope = both(x + direction)
    while not ahead <= value + ENOUGH * length * along:
        # The bottom of the parabola through both values and the slope.
        cut = -along * length / (2 * (ahead - value - along * length)) if np.isfinite(ahead) else 0.0
        length *= min(max(cut, 0.1), 0.5)
        if not length > SHORTEST:
            return 0.0, value, slope
        ahead, slope = both(x + length * direction)
    while length >= 1 and slope @ direction < STEEP * along:
        farther, slope_farther = both(x + 2 * length * direction)
        if not farther < min(ahead, value + ENOUGH * 2 * length * along):
            break
        length, ahead, slope = 2 * length, farther, slope_farther
    return length, ahead, slope


def _jaxopt(
    objective: Objective,
    method: str,
    max_steps: int,
    tolerance: float,
    bound: float,
    project: Projection | None,
    start: Array,
) -> Found:
    jaxopt = _imported_jaxopt()
    if method == "lbfgsb":
        solver = jaxopt.LBFGSB(objective, maxiter=max_steps, tol=tolerance)
        found, state = solver.run(start, bounds=(jnp.full_like(start, -bound), jnp.full_like(start, bound)))
    else:
        if project is None:
            raise ValueError("projected_gradient needs a projection: there are no linear limits to project onto")
        solver = jaxopt.ProjectedGradient(
            objective, lambda x, _: project(x), maxiter=max_steps, tol=tolerance, implicit_diff=False
        )
        found, state = solver.run(start)
    return Found(found, objective(found), state.iter_num)


def onto_polytope(A: Float[Array, "k d"], b: Float[Array, " k"]) -> Projection:
    """Projection onto `A x <= b`, as a quadratic program that is solved by operator splitting (jaxopt's OSQP)."""
    d = A.shape[1]
    solver = _imported_jaxopt().BoxOSQP(
        tol=1e-4, maxiter=200, implicit_diff=False, check_primal_dual_infeasability=False
    )
    low = jnp.full_like(b, -jnp.inf)

    def project(x: Array) -> Array:
        solution = solver.run(params_obj=(jnp.eye(d, dtype=x.dtype), -x), params_eq=A, params_ineq=(low, b))
        return solution.params.primal[0]

    return project


def _imported_jaxopt() -> ModuleType:
    """jaxopt warns on import that it is no longer maintained; this is known here, and the warning is kept from the
    user."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        import jaxopt
    return jaxopt
