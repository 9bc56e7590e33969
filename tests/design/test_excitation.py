"""Designed motions: exact gradients, limits that are kept, bounds that hold, and conditions as good as they can be."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray

from jaximp.design import excitation, motions, objectives
from jaximp.design.bounds import condition_bound
from jaximp.design.excitation import Design, design_excitation
from jaximp.design.limits import Limits
from jaximp.design.motions import Encoder
from jaximp.models import HumanJoint, Joints, Model, RobotJoint
from jaximp.motion.trajectories import FourierSeries, jerk
from jaximp.numerics.optimise import METHODS, minimise, onto_polytope

pytestmark = pytest.mark.compiles

Numbers = NDArray[np.float64]
HUMAN, ROBOT = HumanJoint(offset=False), RobotJoint(gear_ratio=15)
HANDLE = Limits(position=(-10.5, 10.5))
PARAMETERS = np.array([1.518e-3, 0, 1.45e-4, 2.479e-3, 1.9e-5])
FLOOR = np.sqrt(3)
# Designs that differ in numbers only are one program: most here have the default harmonics, period and starts.


def fine(design: Design, per_cycle: int = 240) -> tuple[Numbers, ...]:
    """Motion, jerk and time on a grid ten times finer than the design's."""
    count = max(2000, per_cycle * design.trajectory.sine.shape[-1])
    t = np.arange(count) * design.period / count
    return *(np.asarray(x) for x in design.trajectory(t)), np.asarray(jerk(design.trajectory, t)), t


def condition(model: Model, series: FourierSeries, window: float | None = None) -> float:
    """Of the period, or of the worst of a hundred windows, by singular values of the tall matrix."""
    t = np.arange(4000) * float(series.period) / 4000
    W = np.asarray(model.observation_matrix(*series(t)))
    if window is None:
        return float(np.linalg.cond(W))
    n = round(window / float(series.period) * len(W))
    W = np.concatenate([W, W])
    return max(float(np.linalg.cond(W[start : start + n])) for start in range(0, len(t), 40))


@pytest.mark.slow
@pytest.mark.parametrize("offset", [False, True])
def test_nearly_every_start_reaches_the_floor_of_the_human_joint(offset: bool) -> None:
    design = design_excitation(HumanJoint(offset=offset))
    assert design.lower_bound == pytest.approx(FLOOR)
    assert len(design.conditions) == 32
    assert (design.conditions < 1.001 * FLOOR).sum() >= 28
    assert condition(HumanJoint(offset=offset), design.trajectory) == pytest.approx(design.condition, rel=1e-6)


@pytest.mark.slow
def test_the_robot_of_the_paper() -> None:
    design = design_excitation(ROBOT, limits=HANDLE)
    assert design.condition <= 11.5
    assert np.isnan(design.lower_bound)
    assert "no bound is known" in " ".join(design.in_words())
    assert np.abs(fine(design)[0]).max() <= 10.5


@pytest.mark.slow
def test_the_worst_window() -> None:
    design = design_excitation(HUMAN, harmonics=7, window=2.0, starts=8)
    assert design.worst_condition <= 3.8
    assert condition(HUMAN, design.trajectory, 2.0) == pytest.approx(design.worst_condition, rel=0.02)
    assert condition(HUMAN, design.trajectory) == pytest.approx(design.condition, rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "limits",
    [
        pytest.param(Limits(position=(-3, 9), velocity=6), id="position and velocity"),
        pytest.param(Limits(position=(-10.5, 10.5), acceleration=8.0), id="acceleration"),
        pytest.param(Limits(position=(-10.5, 10.5), jerk=20.0), id="jerk"),
        pytest.param(Limits(position=(-10.5, 10.5), torque=0.008), id="torque"),
    ],
)
def test_limits_are_kept_on_a_finer_grid_and_named(limits: Limits) -> None:
    design = design_excitation(ROBOT, limits=limits, parameters=PARAMETERS, starts=8)
    q, dq, ddq, dddq, _ = fine(design)
    torque = np.asarray(ROBOT.torque(PARAMETERS, q, dq, ddq))
    within = 1 + 1e-9
    assert limits.position[0] * within <= q.min()
    assert q.max() <= limits.position[1] * within
    shares = {
        "velocity": np.abs(dq).max() / limits.velocity,
        "acceleration": np.abs(ddq).max() / limits.acceleration,
        "jerk": np.abs(dddq).max() / limits.jerk,
        "torque": np.abs(torque).max() / limits.torque,
    }
    assert max(shares.values()) <= within
    assert {name for name, share in shares.items() if share > 0.9995} <= set(design.active)
    assert design.active


@pytest.mark.slow
def test_joints_have_limits_of_their_own() -> None:
    model = Joints(HUMAN, HUMAN)
    limits = Limits(position=((-0.2, -0.5), (0.2, 1.0)), velocity=(0.3, 1.0))
    design = design_excitation(model, limits=limits, starts=8)
    q, dq, *_ = fine(design)
    assert (np.abs(dq).max(axis=0) <= np.array([0.3, 1.0]) * (1 + 1e-9)).all()
    assert (q.min(axis=0) >= [-0.2 - 1e-9, -0.5 - 1e-9]).all()
    assert all("of joint" in name for name in design.active)
    assert design.sampled(100)["position"].shape == (1000, 2)


@pytest.mark.slow
def test_from_rest_to_rest() -> None:
    design = design_excitation(HUMAN, rest=True, harmonics=5, starts=8, limits=Limits(position=(-0.5, 0.5)))
    q, dq, ddq = (np.asarray(x) for x in design.trajectory(np.array([0.0, design.period])))
    np.testing.assert_allclose(q, design.trajectory.offset, atol=1e-9)
    np.testing.assert_allclose([dq, ddq], 0, atol=1e-9)
    assert design.condition < 2.5


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"limits": Limits(position=(1, -1))}, r"limits.position: the lowest, \[1.0\], is not below"),
        ({"limits": Limits(position=(0, np.inf))}, "limits.position is finite on one side"),
        ({"limits": Limits(velocity=0)}, r"limits.velocity is \[0.0\]: no motion"),
        ({"limits": Limits(velocity=(1, 2))}, "one number, or one for each of 1 joints"),
        ({"limits": Limits(torque=1)}, "limits.torque needs the parameters"),
        ({"limits": Limits(torque=0.001, position=(7, 9)), "parameters": PARAMETERS}, "limits.torque: even at rest"),
        ({"parameters": PARAMETERS[:3]}, "parameters must be 5 finite numbers"),
        ({"objective": "conditon"}, "did you mean 'condition'"),
        ({"objective": "stderr"}, "needs a parameter"),
        ({"objective": "stderr", "parameter": "inertial"}, "did you mean 'inertia'"),
        ({"window": 11.0}, "no longer than the period"),
        ({"harmonics": 0}, "harmonics is 0"),
        ({"rest": True, "harmonics": 2}, "at least 3"),
        ({"period": -1.0}, "period is -1.0"),
        ({"starts": 0}, "starts is 0"),
        ({"method": "newton"}, "there are bfgs"),
        ({"scale": -np.ones(5)}, "scale must be above zero"),
    ],
)
def test_errors_name_the_cause(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        design_excitation(ROBOT, **settings)


@pytest.mark.slow
@pytest.mark.parametrize("window", [None, 3.0])
@pytest.mark.parametrize("objective", ["condition", "determinant", "sigma_min", "stderr"])
def test_gradients_are_central_differences(objective: str, window: float | None) -> None:
    """Through limits of every kind, the torque's root among them."""
    limits = Limits(position=(-10.5, 10.5), velocity=20.0, torque=0.012)
    parameter = "inertia" if objective == "stderr" else None
    problem = excitation._problem(
        ROBOT, ROBOT, harmonics=4, period=10.0, limits=limits, objective=objective, parameter=parameter, window=window,
        parameters=PARAMETERS,
    )  # fmt: skip
    x, t, random = motions.random_starts(problem, 4, 0), problem.instants(), np.random.default_rng(1)

    @jax.jit
    @jax.value_and_grad
    def value(x: jax.Array) -> jax.Array:
        series, _ = motions.feasible_motion(problem, x, t, jnp.asarray(0.1))
        return motions.worth_of(problem, series, t, jnp.asarray(0.1), jnp.asarray(20.0))

    for start in np.asarray(x):
        direction = random.normal(size=len(start))
        gradient = np.asarray(value(start)[1])
        step = 1e-5
        at = {k: float(value(start + k * step * direction)[0]) for k in (-2, -1, 1, 2)}
        expected = (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * step)
        assert gradient @ direction == pytest.approx(expected, rel=1e-6, abs=1e-6 * np.abs(gradient).max())


@jax.jit
@jax.grad
def slope(s: float, gram: jax.Array, change: jax.Array) -> jax.Array:
    return objectives.log_sigma_min((gram + s * change)[None])[0]


@pytest.mark.slow
@pytest.mark.parametrize("gap", [1e-1, 1e-4, 1e-7])
@pytest.mark.parametrize("p", [2, 3, 6])
def test_derivatives_of_nearly_equal_eigenvalues(p: int, gap: float) -> None:
    random = np.random.default_rng(3)
    Q = np.linalg.qr(random.normal(size=(p, p)))[0]
    values = np.sort(np.r_[1.0, 1 + gap, random.uniform(2, 8, p)][:p])
    change = random.normal(size=(p, p))
    gram, change = Q * values @ Q.T, change + change.T

    v = np.linalg.eigh(gram)[1][:, 0]
    assert float(slope(0.0, gram, change)) == pytest.approx(-0.5 * v @ change @ v, rel=1e-6)


def test_objectives_are_what_they_say() -> None:
    W = np.random.default_rng(0).normal(size=(50, 4)) * [1, 2, 3, 4]
    gram = jnp.asarray(W.T @ W)[None]
    singular = np.linalg.svd(W, compute_uv=False)
    assert float(objectives.log_condition(gram)[0]) == pytest.approx(np.log(singular[0] / singular[-1]))
    assert float(objectives.log_sigma_min(gram)[0]) == pytest.approx(-np.log(singular[-1]))
    assert float(objectives.log_volume(gram)[0]) == pytest.approx(-np.log(singular).sum() / 4)
    expected = 0.5 * np.log(np.linalg.inv(W.T @ W)[2, 2])
    assert float(objectives.log_stderr(gram, 2)[0]) == pytest.approx(expected)


@pytest.mark.slow
def test_a_standard_error_is_that_of_the_measurements() -> None:
    design = design_excitation(
        HUMAN, objective="stderr", parameter="stiffness", limits=Limits(position=(-0.5, 0.5)), starts=8, sample_rate=200
    )
    motion = design.sampled(200)
    W = np.asarray(HUMAN.observation_matrix(motion["position"], motion["velocity"], motion["acceleration"]))
    assert design.value == pytest.approx(np.sqrt(np.linalg.inv(W.T @ W)[2, 2]), rel=1e-6)


@pytest.mark.slow
def test_a_design_says_what_it_does_not_do() -> None:
    """Holding still at the highest angle is best for a stiffness alone, and leaves inertia and damping unknown."""
    limits = Limits(position=(-0.5, 0.5))
    still = design_excitation(
        HUMAN, limits=limits, objective="stderr", parameter="stiffness", starts=8, sample_rate=200
    )
    assert any("not all parameters can be told apart" in line for line in still.in_words())
    assert still.in_words()[0].startswith("standard error of stiffness over a period of 10 s")
    assert still.in_words()[0].endswith("N m/rad")
    offset = design_excitation(HumanJoint(), limits=Limits(position=(-5.0, 5.0)))
    assert any("larger motion" in line for line in offset.in_words())
    assert any(line.startswith("at the lower bound 1.732") for line in offset.in_words())


@pytest.mark.slow
def test_a_mean_position_is_kept() -> None:
    limits = Limits(position=(-0.5, 0.5))
    design = design_excitation(HUMAN, limits=limits, window=2.0, mean=0.1, starts=4)
    assert float(np.mean(design.sampled(100)["position"])) == pytest.approx(0.1, abs=1e-12)
    assert np.max(design.sampled(1000)["position"]) <= 0.5
    with pytest.raises(ValueError, match="mean"):
        design_excitation(HUMAN, limits=limits, mean=0.7)


@pytest.mark.slow
def test_condition_over_sliding_windows() -> None:
    """The window that ends at each instant, back across the beginning of the period."""
    design = design_excitation(HUMAN, limits=Limits(position=(-0.5, 0.5)))
    end, found = design.sliding_condition(2.0)
    motion = design.sampled(len(end) / design.period)
    W = np.asarray(HUMAN.observation_matrix(motion["position"], motion["velocity"], motion["acceleration"]))
    W, n = np.concatenate([W, W]), round(2.0 / design.period * len(end))
    for k in (0, 7, len(end) - 1):
        last = len(end) + k
        assert found[k] == pytest.approx(np.linalg.cond(W[last + 1 - n : last + 1]), rel=1e-9)


@pytest.mark.slow
def test_a_slow_encoder_does_not_hide_a_limit() -> None:
    limits = Limits(position=(-0.3, 0.3))
    encoder = Encoder(step=1e-3, sample_rate=3.0, cutoff=1.0, order=2)
    design = design_excitation(HUMAN, limits=limits, encoder=encoder, starts=4)
    assert np.abs(design.sampled(2400)["position"]).max() <= 0.3 * (1 + 1e-6)


@pytest.mark.slow
def test_what_is_moved_may_be_more_than_what_is_identified() -> None:
    """Methods 1 and 3: the robot is known, and yet the motor must carry it."""
    moved, limits = ROBOT + HUMAN, Limits(position=(-10.5, 10.5), torque=0.012)
    parameters = np.concatenate([PARAMETERS, [0.0, 0.0, 1e-3]])
    design = design_excitation(HUMAN, moved=moved, parameters=parameters, limits=limits, starts=4)
    motion = design.sampled(2400)
    q, dq, ddq = (motion[name] for name in ("position", "velocity", "acceleration"))
    np.testing.assert_allclose(motion["torque"], moved.torque(parameters, q, dq, ddq))
    assert 0.99 * 0.012 < np.abs(motion["torque"]).max() < 0.012 * (1 + 1e-4)
    W = np.asarray(HUMAN.observation_matrix(q, dq, ddq))
    assert design.value == pytest.approx(np.linalg.cond(W), rel=1e-6)


@pytest.mark.slow
def test_columns_compared_by_the_torque_that_they_make() -> None:
    scale = np.array([1e-3, 0.05, 2.0])
    design = design_excitation(HUMAN, scale=scale)
    motion = design.sampled(1000)
    W = np.asarray(HUMAN.observation_matrix(motion["position"], motion["velocity"], motion["acceleration"]))
    assert design.value == pytest.approx(np.linalg.cond(W * scale), rel=1e-6)


@pytest.mark.slow
def test_the_encoder_is_in_the_loop() -> None:
    """Tout et al. 2023, V-A: what the encoder makes of the motion is what is judged."""
    encoder = Encoder(step=0.05, sample_rate=100.0, cutoff=5.0)
    limits = Limits(position=(-0.5, 0.5))
    design = design_excitation(HUMAN, limits=limits, encoder=encoder, starts=8, objective="sigma_min")
    t = np.arange(1000) / 100
    series = FourierSeries(*(np.atleast_2d(x) for x in (design.trajectory.sine, design.trajectory.cosine)),
                           np.atleast_1d(design.trajectory.offset), 10.0)  # fmt: skip
    rows = motions.regressor_rows(HUMAN, motions.measured_motion(encoder, series, jnp.asarray(t)), None, 10.0)[:, 0]
    assert design.value == pytest.approx(float(np.linalg.svd(rows, compute_uv=False)[-1]), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "harmonics", "period", "starts"),
    [
        pytest.param(HumanJoint(), 5, 10.0, 32, id="human"),
        pytest.param(Joints(HUMAN, HUMAN), 5, 10.0, 8, id="two joints"),
        pytest.param(RobotJoint(gravity=False, coulomb=False, offset=True), 4, 10.0, 8, id="linear robot"),
    ],
)
def test_no_motion_is_better_than_the_bound(model: Model, harmonics: int, period: float, starts: int) -> None:
    pytest.importorskip("cvxpy")
    bound, _ = condition_bound(model, harmonics, period)
    design = design_excitation(model, harmonics=harmonics, period=period, starts=starts)
    assert design.conditions[0] >= bound * (1 - 1e-6)
    assert design.conditions[0] <= bound * 1.02


def test_the_closed_form_is_the_convex_program() -> None:
    pytest.importorskip("cvxpy")
    from jaximp.design import bounds

    assert bounds._convex_bound([np.eye(4)[:3]], 5, 10.0) == pytest.approx(FLOOR, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_every_optimiser_finds_the_bottom_of_a_bowl(method: str) -> None:
    target = jnp.array([0.3, -0.2, 0.1])
    starts = jnp.asarray(np.random.default_rng(0).normal(size=(3, 3)))
    project = onto_polytope(jnp.concatenate([jnp.eye(3), -jnp.eye(3)]), jnp.full(6, 2.0))
    found = minimise(lambda x: ((x - target) ** 2 * jnp.array([1.0, 4.0, 9.0])).sum(), starts, method, project=project)
    np.testing.assert_allclose(found.x, np.tile(target, (3, 1)), atol=1e-3)


@pytest.mark.slow
def test_same_seed_same_design() -> None:
    one, other = (design_excitation(HUMAN, seed=3) for _ in range(2))
    np.testing.assert_array_equal(one.trajectory.sine, other.trajectory.sine)


@pytest.mark.parametrize("columns", [5, 20], ids=["written out", "left to LAPACK"])
def test_objectives_of_few_and_of_many_columns_are_those_of_numpy(columns: int) -> None:
    W = np.random.default_rng(0).normal(size=(60, columns)) * np.linspace(1, 3, columns)
    gram, sigma = jnp.asarray(W.T @ W), np.linalg.svd(W, compute_uv=False)
    expected = {
        objectives.log_condition: np.log(sigma[0] / sigma[-1]),
        objectives.log_sigma_min: -np.log(sigma[-1]),
        objectives.log_volume: -np.log(sigma).mean(),
        partial(objectives.log_stderr, parameter=2): 0.5 * np.log(np.linalg.inv(W.T @ W)[2, 2]),
    }
    for objective, value in expected.items():
        np.testing.assert_allclose(objective(gram[None]), [value], rtol=1e-9)
        slope = jax.grad(lambda x, of=objective: of(x[None])[0])(gram)
        change = 1e-6 * np.eye(columns)
        difference = (objective(gram[None] + change) - objective(gram[None] - change))[0] / 2
        np.testing.assert_allclose((np.asarray(slope) * change).sum(), difference, rtol=1e-5)
