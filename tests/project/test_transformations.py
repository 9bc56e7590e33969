"""What `jit`, `vmap`, `grad` and `jvp` work on: the table of docs/transformations.md, held against the functions.

Compiled as uncompiled, a batch as a loop, derivatives as central differences and finite everywhere; or one clear error.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaximp
from factories import robots
from jaximp import models, signals, tracking
from jaximp.design import objectives
from jaximp.least_squares import chunks, sliding
from jaximp.models import arm as planar
from jaximp.models.endpoint import ellipse, endpoint_impedance
from jaximp.perturbation.stiffness import merge_triangles, residual_triangle
from jaximp.posterior.densities import estimate_density, linear_density, stiffness_density
from jaximp.simulation.rig import HumanLoad, Rig, simulate_rig
from paths import ROOT

PAGE = ROOT / "docs" / "transformations.md"
QUICK = {"xla_backend_optimization_level": 0}
"""To compile, not to run."""

random = np.random.default_rng(0)
W = random.normal(size=(40, 2))
W[10:20] = 0.0  # a window without a solution, which must not make derivatives of others NaN
Y = W @ np.array([1.0, 2.0]) + 0.1 * random.normal(size=40)
MOTION = random.normal(size=(6, 3))
TRIALS = random.normal(size=(3, 20, 6))
TRIALS[..., 4:] += TRIALS[..., :2] @ np.array([[2.0, 0.3], [0.1, 1.0]])
TRIALS[..., 4:] += TRIALS[..., 2:4] @ np.array([[30.0, 5.0], [5.0, 20.0]])
R = random.normal(size=(5, 3))
LOW_PASS = signals.butterworth(2, 20.0, 200.0)
WIDE = signals.design_differentiator(0.6)
NOISE = np.array([1.0, 0.5, 0.2])
ARM = models.ArmGeometry((0.3, 0.35))
XI = np.array([0.3, 0.1, 0.12])
CHAIN = models.Chain(models.parse_urdf(robots.planar()), friction="viscous")
K, D = np.array([[30.0, 5.0], [5.0, 20.0]]), np.array([[2.0, 0.3], [0.1, 1.0]])
ANGLES = np.array([[0.4, 1.1], [0.2, 0.9]])
T = np.array([0.03, 0.21, 0.37])


@dataclass(eq=False)
class Case:
    """A public function, as one of an array."""

    name: str
    function: Callable[[jax.Array], Any]
    x: np.ndarray
    of: str
    slope: bool = True
    """Whether its derivative is one; if not, it must be finite all the same."""
    note: str = ""
    still: Callable[[np.ndarray], np.ndarray] = np.ones_like
    """Zero where the array must stay as it is."""

    def __call__(self, x: jax.Array) -> jax.Array:
        leaves = [jnp.ravel(leaf) for leaf in jax.tree.leaves(self.function(x)) if jnp.issubdtype(leaf.dtype, float)]
        return jnp.concatenate(leaves)

    @cached_property
    def compiled(self) -> Callable[[jax.Array], jax.Array]:
        return jax.jit(self.__call__, compiler_options=QUICK)

    def objective(self, x: jax.Array) -> jax.Array:
        return weighted(self(x))


def weighted(values: Any) -> Any:
    weights = 1 + 0.5 * np.sin(np.arange(1.0, len(values) + 1))
    return jnp.where(jnp.isfinite(values), values * weights, 0).sum()


def nonzero(x: np.ndarray) -> np.ndarray:
    return (x != 0).astype(float)


def model(one: models.Model) -> Callable[[jax.Array], Any]:
    return lambda x: one.observation_matrix(x, MOTION[: len(x), 1], MOTION[: len(x), 2])


def small_chunks(function: Callable[[jax.Array], Any]) -> Callable[[jax.Array], Any]:
    """From the sums that windows share, which are for long recordings."""

    def call(x: jax.Array) -> Any:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sliding, "FROM_CHUNKS", 0)
            patch.setattr(chunks, "LANES", {True: 30, False: 30})
            return function(x)

    return call


def stiffness(fit: Any) -> tuple[Any, ...]:
    return fit.D, fit.K, fit.stderr


def density(make: Callable[[], Any], x: np.ndarray, name: str) -> Case:
    one = make()
    return Case(name, lambda theta: one(theta)[None], x, "the parameters of the density")


CASES = [
    Case("least_squares", lambda x: jaximp.least_squares.least_squares(x, Y), W, "W", still=nonzero),
    Case("least_squares, noise", lambda y: jaximp.least_squares.least_squares(W, y, noise=NOISE), Y, "y"),
    Case(
        "least_squares, weights", lambda w: jaximp.least_squares.least_squares(W, Y, weights=w), 1 + Y**2, "the weights"
    ),
    Case("sliding_least_squares", lambda x: jaximp.sliding_least_squares(x, Y, 8, 4), W, "W", still=nonzero),
    Case(
        "sliding_theta, from shared sums",
        small_chunks(lambda x: jaximp.least_squares.sliding_theta(x, Y, 8, 4)),
        W,
        "W",
        still=nonzero,
    ),
    Case(
        "adaptive_least_squares",
        small_chunks(lambda x: jaximp.adaptive_least_squares(x, Y, np.full(2, 0.05), 8, 12, step=4)),
        W,
        "W",
        still=nonzero,
        note="the lengths of the windows are those that were found",
    ),
    Case(
        "tracking.smoothed_path",
        lambda x: tracking.smoothed_path(x, Y, grid=4, drift=np.array([0.1, 0.0]), noise=0.1),
        W,
        "W",
    ),
    Case("recursive_least_squares", lambda x: jaximp.recursive_least_squares(x, Y, 0.9), W, "W", still=nonzero),
    Case("signals.filter_zero_phase", lambda x: signals.filter_zero_phase(LOW_PASS, x), W, "the signal"),
    Case("signals.filter_from_zero", lambda x: signals.filter_from_zero(LOW_PASS, x), W, "the signal"),
    Case("signals.central_differences", lambda x: signals.central_differences(x, 200.0), W, "the signal"),
    Case("signals.differentiate", lambda x: signals.differentiate(x, 200.0, WIDE), W, "the signal"),
    Case("signals.savitzky_golay", lambda x: signals.savitzky_golay(x, 200.0, 1, 40.0, 5), W, "the signal"),
    Case("models.HumanJoint", model(models.HumanJoint(offset=True)), MOTION[:, 0], "the position"),
    Case("models.RobotJoint", model(models.RobotJoint(15.0)), MOTION[:, 0], "the position"),
    Case(
        "models.ReflexPathway",
        lambda x: models.ReflexPathway(100.0, (0.01, 0.025)).observation_matrix(MOTION[:, 0], x, MOTION[:, 2]),
        MOTION[:, 1],
        "the velocity",
        note="NaN where the past of a row is before the first sample",
    ),
    Case(
        "models.PlanarArm",
        lambda x: models.PlanarArm(equilibrium=(0.4, 1.1)).observation_matrix(x, MOTION[:2, :2], MOTION[2:4, :2]),
        ANGLES,
        "the angles",
    ),
    Case(
        "models.Chain",
        lambda x: CHAIN.observation_matrix(x, MOTION[:2, :2], MOTION[2:4, :2]),
        ANGLES,
        "the positions",
    ),
    Case("Chain.inverse_dynamics", lambda x: CHAIN.inverse_dynamics(x, ANGLES, ANGLES), ANGLES, "the positions"),
    Case("Chain.mass_matrix, .jacobian", lambda x: (CHAIN.mass_matrix(x), CHAIN.jacobian(x)), ANGLES, "the positions"),
    Case("models.mass_matrix", lambda x: planar.mass_matrix(x, XI), ANGLES, "the angles"),
    Case("ArmGeometry.forward, .jacobian", lambda x: (ARM.forward(x), ARM.jacobian(x)), ANGLES, "the angles"),
    Case(
        "ArmGeometry.inverse",
        ARM.inverse,
        np.asarray(ARM.forward(ANGLES)),
        "the hand",
        note="no derivative of a straight or folded arm",
    ),
    Case("endpoint_impedance", lambda x: endpoint_impedance(ARM, x, XI, D, K), ANGLES, "the angles"),
    Case("ellipse", ellipse, K[None], "the matrix", note="no derivative of a circle's orientation"),
    Case(
        "FourierSeries", lambda x: jaximp.motion.FourierSeries(x[0], x[1], 0.1, 2.0)(T), MOTION[:2], "the coefficients"
    ),
    Case("MinimumJerk", lambda x: jaximp.motion.MinimumJerk(x, 0.2)(T), MOTION[:3, 0], "the way points"),
    Case("SixthOrder", lambda x: jaximp.motion.SixthOrder(x[0], x[1], 0.4)(T), MOTION[:2], "both ends"),
    Case("RaisedSine", lambda x: jaximp.motion.RaisedSine(x, 0.2)(T), MOTION[0], "the amplitude"),
    Case("residual_triangle", lambda x: residual_triangle(x[:, :2], x[:, 2:4], x[:, 4:]), TRIALS[0], "all samples"),
    Case("merge_triangles", merge_triangles, TRIALS[:, :6], "the triangles"),
    Case(
        "fit_stiffness",
        lambda x: stiffness(jaximp.fit_stiffness(x[..., :2], x[..., 2:4], x[..., 4:])),
        np.concatenate([TRIALS[..., 2:4], TRIALS[..., :2], TRIALS[..., 4:]], axis=-1),
        "all samples",
    ),
    Case(
        "fit_stiffness_linear",
        lambda x: stiffness(jaximp.perturbation.fit_stiffness_linear(x[..., :2], x[..., 2:4], x[..., 4:])),
        np.concatenate([TRIALS[..., 2:4], TRIALS[..., :2], TRIALS[..., 4:]], axis=-1),
        "all samples",
    ),
    density(
        lambda: linear_density(("a", "b"), ("1", "1"), jaximp.least_squares.whiten(W, Y)),
        np.array([1.1, 1.9, -2.0]),
        "linear_density",
    ),
    density(
        lambda: estimate_density(("a", "b"), ("1", "1"), np.ones(2), 0.1 * np.eye(2), 8.0),
        np.array([1.1, 0.9]),
        "estimate_density",
    ),
    density(
        lambda: stiffness_density(residual_triangle(TRIALS[0, :, :2], TRIALS[0, :, 2:4], TRIALS[0, :, 4:]), 20),
        np.array([2.0, 0.1, 0.3, 1.0, 5.0, 1.0, 4.0, -0.5]),
        "stiffness_density",
    ),
    Case("objectives.log_condition", lambda x: objectives.log_condition(x.T @ x)[None], R, "the root of a Gram matrix"),
    Case("objectives.log_sigma_min", lambda x: objectives.log_sigma_min(x.T @ x)[None], R, "the root of a Gram matrix"),
    Case("objectives.log_volume", lambda x: objectives.log_volume(x.T @ x)[None], R, "the root of a Gram matrix"),
    Case("objectives.log_stderr", lambda x: objectives.log_stderr(x.T @ x, 1)[None], R, "the root of a Gram matrix"),
    Case(
        "simulate_rig",
        lambda x: (
            simulate_rig(
                Rig(),
                jaximp.motion.FourierSeries(np.array([3.0]), np.array([1.0]), 0.0, 0.5),
                0.01,
                HumanLoad(stiffness=x[0]),
            ).torque
        ),
        np.array([1e-3]),
        "the stiffness of the human",
        slope=False,
        note="its encoder counts steps, which have no slope",
    ),
]

REFUSED: list[tuple[str, Callable[[jax.Array], Any], np.ndarray, str]] = [
    (
        "confidence_interval",
        lambda x: jaximp.confidence_interval(x, 0.1 * x, x[..., 0]),
        W[:2],
        "Student's quantile is scipy's: call it on the results",
    ),
    (
        "sliding_pieces",
        lambda x: next(jaximp.sliding_pieces([(x, Y)], 8)).theta,
        W,
        "reads when it needs: pass the whole recording to sliding_least_squares",
    ),
    ("whiten", lambda x: jaximp.least_squares.whiten(x, Y).W, W, "LAPACK's band matrices: whiten the rows before"),
    ("fit_noise", lambda x: jaximp.least_squares.fit_noise(x, Y).autocovariance, W, "as whiten"),
]
"""Functions that need numbers, and why."""

each_case = pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])


def table() -> str:
    rows = ["| function | of | `jit` | `vmap` | `grad` | `jvp` | |", "|---|---|---|---|---|---|---|"]
    for case in CASES:
        slope = "yes" if case.slope else "finite"
        rows.append(f"| {case.name} | {case.of} | yes | yes | {slope} | {slope} | {case.note} |")
    rows += [f"| {name} | | error | error | error | error | {why} |" for name, _, _, why in REFUSED]
    return "\n".join(rows) + "\n"


def test_the_page_holds_this_table() -> None:
    assert PAGE.read_text(encoding="utf-8").endswith(table())


@pytest.mark.slow
@each_case
def test_compiled_as_uncompiled_and_a_batch_as_a_loop(case: Case) -> None:
    x = jnp.asarray(case.x)
    both = jnp.stack([x, x * 1.01])
    loop = np.stack([case.compiled(element) for element in both])
    batch = jax.jit(jax.vmap(case.__call__), compiler_options=QUICK)(both)
    scale = np.nanmax(np.abs(loop))
    assert np.isfinite(loop).any()
    np.testing.assert_allclose(loop[0], case(x), rtol=1e-7, atol=1e-11 * scale)
    np.testing.assert_allclose(batch, loop, rtol=1e-7, atol=1e-11 * scale)


@pytest.mark.slow
@each_case
def test_derivatives_are_central_differences(case: Case) -> None:
    x = jnp.asarray(case.x)
    way = jnp.asarray(np.random.default_rng(1).normal(size=x.shape) * case.still(case.x))

    def slopes(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.grad(case.objective)(x), jax.jvp(case.objective, (x,), (way,))[1]

    gradient, forward = jax.jit(slopes, compiler_options=QUICK)(x)
    assert np.isfinite(gradient).all()
    assert np.isfinite(forward)
    if case.slope:
        step = 1e-6 * float(jnp.abs(x).max())
        above, below = (float(weighted(case.compiled(x + sign * step * way))) for sign in (1, -1))
        expected = (above - below) / (2 * step)
        close = pytest.approx(expected, rel=1e-5, abs=1e-14 * (1 + abs(above)) / step)
        assert expected != 0
        assert float((gradient * way).sum()) == close
        assert float(forward) == close


@pytest.mark.parametrize(("name", "function", "x", "why"), REFUSED, ids=[name for name, *_ in REFUSED])
@pytest.mark.parametrize("transformation", [jax.jit, jax.vmap, jax.jacrev, jax.jacfwd])
def test_what_needs_numbers_says_so(
    name: str, function: Callable[[jax.Array], Any], x: np.ndarray, why: str, transformation: Any, unchecked: None
) -> None:
    given = jnp.asarray(x)[None] if transformation is jax.vmap else jnp.asarray(x)
    with pytest.raises(ValueError, match=f"^{re.escape(name)} needs numbers") as raised:
        transformation(function)(given)
    assert "\n" not in str(raised.value)


@pytest.mark.slow
@pytest.mark.compiles
def test_what_a_window_must_reach_may_be_an_argument_of_compiled_code() -> None:
    fit = small_chunks(lambda stderr: jaximp.adaptive_least_squares(W, Y, stderr, 8, 12, step=4).theta)
    wanted = np.full(2, 0.05)
    np.testing.assert_allclose(jax.jit(fit, compiler_options=QUICK)(wanted), fit(wanted), rtol=1e-9)


if __name__ == "__main__":
    print(table())
